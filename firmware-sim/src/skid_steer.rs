//! The wheels and the body of the skid-steered robot, driven by the voltages on its motors.
//!
//! [`Rosbot`](crate::rosbot::Rosbot) is this behind speed controllers, and describes how much of it
//! is invented. Sides are ordered right, left.
//!
//! # Wheels
//!
//! ```text
//! T ω' = K (U − b ω − U_c sign ω) − ω        moving
//! ω' = 0 while |U| ≤ U_b                     at rest: the dead-band of stiction
//! ```
//!
//! K is the speed per volt without friction, T the lag, b ω the viscous and U_c the Coulomb friction
//! as voltages, U_b ≥ U_c what it takes to break loose. Under a held voltage this has a closed
//! solution, which is what is used, stops and restarts included.
//!
//! # Body
//!
//! The tyres of a side pull in proportion to how fast they slide, so the ground speed g of a side
//! follows its wheels with a lag, and slides in proportion to the acceleration; at speed a share of
//! the way is lost besides, and more of it on ice:
//!
//! ```text
//! T_g g' = r ω − g,   s = g (1 − c |g|) (1 − slip)      for each side
//! v = (s_r + s_l)/2,  φ' = (s_r − s_l)/(λ L)
//! x' = v cos φ − w sin φ,   y' = v sin φ + w cos φ,   w = −T_w v φ'
//! ```
//!
//! λ > 1 is the effective track of skid steering, in nominal tracks: the robot turns less than r/L
//! says. w is the sideways drift out of a bend, in proportion to the centripetal acceleration; it
//! moves the instantaneous centre of rotation T_w v ahead of the axle's line. Left and right are
//! alike. slip is 0 but for a fault. How a turn loads the motors is left out: controllers would hide
//! it.

use crate::integrate::Numerical;
use crate::rosbot::{RosbotError, RosbotParameters};
use std::num::NonZeroU32;

/// The wheels of one side.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wheel {
    /// Speed ω (rad/s).
    pub speed_radps: f64,
    /// Angle turned since the start (rad).
    pub angle_rad: f64,
}

/// All that moves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// The wheels of the right and the left side.
    pub wheels: [Wheel; 2],
    /// Ground speeds g of the sides (m/s).
    pub ground_mps: [f64; 2],
    /// x (m), y (m), φ (rad), counter-clockwise and unwrapped.
    pub pose: [f64; 3],
}

/// A robot without controllers that starts at rest at the origin with φ = 0.
///
/// ```
/// use firmware_sim::skid_steer::SkidSteer;
///
/// let mut robot = SkidSteer::new(Default::default())?;
/// for _ in 0..200 {
///     robot.step([6.0, 6.0], [0.0, 0.0], 0.01);
/// }
/// // (6 V − 0.6 V) · 2.2 rad/s/V / 1.044.
/// let [right, left] = robot.motion().wheels;
/// assert!((right.speed_radps - 11.379).abs() < 1e-3);
/// assert_eq!(right, left);
/// # Ok::<(), firmware_sim::rosbot::RosbotError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SkidSteer {
    parameters: RosbotParameters,
    motion: Motion,
}

impl SkidSteer {
    /// Of the body. Its lag is 30 ms: one step per 10 ms stays within a tenth of the sensor's noise.
    const METHOD: Numerical = Numerical::Rk4 { substeps: NonZeroU32::MIN };

    /// A robot at rest at the origin.
    ///
    /// # Errors
    ///
    /// [`RosbotError::OutOfRange`] for a parameter with which the equations make no sense.
    pub fn new(parameters: RosbotParameters) -> Result<Self, RosbotError> {
        parameters.check()?;
        Ok(Self { parameters, motion: Motion::default() })
    }

    /// What fixes the robot.
    pub fn parameters(&self) -> &RosbotParameters {
        &self.parameters
    }

    /// Where everything is now, and how fast.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// Advances by `dt_s` seconds, at most 0.01 for the accuracy promised, with held voltages on the
    /// motors (V) and these shares of the ground speeds lost, from 0 to 1.
    pub fn step(&mut self, volts: [f64; 2], slip: [f64; 2], dt_s: f64) {
        self.motion = self.motion.after(&self.parameters, volts, slip, dt_s, Self::METHOD);
    }
}

impl Motion {
    /// The motion `t` seconds later under held voltages.
    pub(crate) fn after(
        &self,
        p: &RosbotParameters,
        volts: [f64; 2],
        slip: [f64; 2],
        t: f64,
        method: Numerical,
    ) -> Self {
        let Self { wheels, ground_mps: [right, left], pose: [x, y, phi] } = *self;
        let rate = |&[t, right, left, _, _, phi]: &[f64; 6]| {
            let lag = |side: usize, ground: f64| {
                let speed = wheels[side].after(p, volts[side], t).speed_radps;
                (p.wheel_radius_m * speed - ground) / p.slide_lag_s
            };
            let gripping = [right * (1.0 - slip[0]), left * (1.0 - slip[1])];
            let [vx, vy, turn_rate] = p.twist(gripping, phi);
            [1.0, lag(0, right), lag(1, left), vx, vy, turn_rate]
        };
        let [_, right, left, x, y, phi] = method.integrate([0.0, right, left, x, y, phi], t, rate);
        Self {
            wheels: [wheels[0].after(p, volts[0], t), wheels[1].after(p, volts[1], t)],
            ground_mps: [right, left],
            pose: [x, y, phi],
        }
    }
}

impl RosbotParameters {
    /// (x', y', φ') for the ground speeds of the sides and the heading.
    pub(crate) fn twist(&self, ground_mps: [f64; 2], phi: f64) -> [f64; 3] {
        let [right, left] = ground_mps.map(|g| g * (1.0 - self.slip_s_per_m * g.abs()));
        let forward = (right + left) / 2.0;
        let turn_rate = (right - left) / (self.track_ratio * self.track_m);
        let sideways = -self.drift_s * forward * turn_rate;
        let (sin, cos) = (libm::sin(phi), libm::cos(phi));
        [forward * cos - sideways * sin, forward * sin + sideways * cos, turn_rate]
    }
}

impl Wheel {
    /// The wheel `t` seconds later under a held voltage.
    fn after(mut self, p: &RosbotParameters, volt: f64, mut t: f64) -> Self {
        let damping = 1.0 + p.speed_per_volt * p.viscous_volt_s;
        let lag_s = p.motor_lag_s / damping;
        // Where the speed would end, for friction against this direction.
        let end = |direction: f64| {
            (volt - p.coulomb_volt.copysign(direction)) * p.speed_per_volt / damping
        };
        let approach = |wheel: Self, end: f64, t: f64| {
            let gap = wheel.speed_radps - end;
            let fallen = -libm::expm1(-t / lag_s);
            Self {
                speed_radps: wheel.speed_radps - gap * fallen,
                angle_rad: wheel.angle_rad + end * t + gap * lag_s * fallen,
            }
        };
        if self.speed_radps != 0.0 {
            let end = end(self.speed_radps);
            let stop_s = if end * self.speed_radps < 0.0 {
                lag_s * libm::log1p(-self.speed_radps / end)
            } else {
                f64::INFINITY
            };
            if t < stop_s {
                return approach(self, end, t);
            }
            self = Self { speed_radps: 0.0, ..approach(self, end, stop_s) };
            t -= stop_s;
        }
        if volt.abs() <= p.break_away_volt { self } else { approach(self, end(volt), t) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Plant;
    use crate::rosbot::Rosbot;

    #[test]
    fn wheels_break_loose_only_above_the_dead_band() {
        let p = RosbotParameters::default();
        let after = |volt, speed_radps| Wheel { speed_radps, angle_rad: 0.0 }.after(&p, volt, 0.01);
        assert_eq!(after(0.9, 0.0), Wheel::default());
        assert_eq!(after(-0.9, 0.0).speed_radps, 0.0);
        // Once loose, only the smaller Coulomb friction holds it back.
        assert!((after(0.9 + 1e-9, 0.0).speed_radps - 0.3 * 2.2 / 0.08 * 0.01).abs() < 0.01);
        assert!(after(0.8, 0.1).speed_radps > 0.1);
        // A slow wheel stops within the 10 ms and stays.
        let stopped = after(0.0, 0.1);
        assert_eq!(stopped.speed_radps, 0.0);
        assert!(stopped.angle_rad > 0.0 && stopped.angle_rad < 0.1 * 0.01);
    }

    #[test]
    fn closed_solution_of_the_wheel_solves_its_equation() {
        const STEPS: u32 = 200_000;
        // Through a stop into the other direction, into rest, towards a standstill, and away.
        for (speed, volt) in [(2.0, -6.0), (-2.0, 6.0), (0.3, 0.5), (4.0, 0.7), (0.0, -3.0)] {
            let wheel = Wheel { speed_radps: speed, angle_rad: 0.0 };
            let h = 0.02 / f64::from(STEPS);
            let (mut w, mut angle) = (speed, 0.0);
            for _ in 0..STEPS {
                let direction = if w == 0.0 { volt } else { w };
                let loose = w != 0.0 || volt.abs() > 0.9;
                let torque = 2.2 * (volt - 0.02 * w - 0.6_f64.copysign(direction)) - w;
                let next = if loose { w + h / 0.08 * torque } else { 0.0 };
                let next = if next * w < 0.0 { 0.0 } else { next };
                angle += h * (w + next) / 2.0;
                w = next;
            }
            let end = wheel.after(&RosbotParameters::default(), volt, 0.02);
            // Euler's error at steps of 0.1 µs and rates up to 200 rad/s².
            assert!((end.speed_radps - w).abs() < 1e-4, "{speed} {volt}: {end:?} {w}");
            assert!((end.angle_rad - angle).abs() < 1e-6, "{speed} {volt}: {end:?} {angle}");
        }
    }

    #[test]
    fn one_step_per_10_ms_is_converged_to_the_sensor() {
        let end = |steps: u32| {
            let mut robot = SkidSteer::new(RosbotParameters::default()).unwrap();
            for tick in 0..1_000_u32 {
                // Full reversals, pivots and bends, a second each.
                let volts = [[12.0, -12.0], [-12.0, 12.0], [9.0, 5.0], [-3.0, -7.0], [0.0, 0.0]];
                let volts = volts[(tick / 100 % 5) as usize];
                (0..steps).for_each(|_| robot.step(volts, [0.0; 2], 0.01 / f64::from(steps)));
            }
            robot.motion().pose
        };
        let (coarse, fine) = (end(1), end(50));
        // A tenth of the sensor's noise (1 mm, 1 mm, 2 mrad), after 10 s.
        let most = [1e-4, 1e-4, 2e-4];
        assert!((0..3).all(|i| (coarse[i] - fine[i]).abs() < most[i]), "{coarse:?} {fine:?}");
    }

    #[test]
    fn slip_keeps_the_wheels_and_loses_the_way() {
        let after = |slip| {
            let mut robot = SkidSteer::new(RosbotParameters::default()).unwrap();
            (0..100).for_each(|_| robot.step([6.0, 6.0], slip, 0.01));
            *robot.motion()
        };
        let (gripping, slipping) = (after([0.0, 0.0]), after([0.5, 0.5]));
        assert_eq!(gripping.wheels, slipping.wheels);
        // Half the ground speed; the quadratic loss is then smaller, too.
        assert!((0.5..0.51).contains(&(slipping.pose[0] / gripping.pose[0])));
        assert!(after([0.3, 0.0]).pose[2] < -0.1, "turns towards the side that slips");
    }

    #[test]
    fn is_the_rosbot_without_its_controllers() {
        // At its limit the controller holds the supply voltage.
        let mut rosbot = Rosbot::new(RosbotParameters::default()).unwrap();
        let mut robot = SkidSteer::new(RosbotParameters::default()).unwrap();
        for _ in 0..100 {
            rosbot.step(&[100.0, -100.0], 0.01);
            robot.step([12.0, -12.0], [0.0; 2], 0.01);
        }
        assert_eq!(rosbot.wheel_speeds_radps(), robot.motion().wheels.map(|w| w.speed_radps));
    }
}
