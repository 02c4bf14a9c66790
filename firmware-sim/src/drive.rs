//! Differential drive, the paper's system (drive).
//!
//! ```text
//! x'   = r/2 (ω_r + ω_l) cos φ
//! y'   = r/2 (ω_r + ω_l) sin φ
//! φ'   = r/L (ω_r − ω_l)
//! ```
//!
//! State and outputs: x, y (m), φ (rad), counter-clockwise and unwrapped. Inputs: ω_r, ω_l
//! (rad/s), the speeds of the right and the left wheel.
//!
//! # Exact motion
//!
//! Under held inputs the robot moves on an arc. With the path length d = r/2 (ω_r + ω_l) Δt and
//! the turn δ = r/L (ω_r − ω_l) Δt, its chord has the length d·sin(δ/2)/(δ/2) and the direction
//! φ + δ/2. In this form nothing cancels and the straight line is not a special case.

use crate::integrate::Integrator;
use crate::plant::{Plant, Variable};
use crate::sinc::sinc;

/// What fixes a differential drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveParameters {
    /// Wheel radius r (m).
    pub wheel_radius_m: f64,
    /// Distance L between the wheels (m).
    pub track_m: f64,
}

impl Default for DriveParameters {
    /// The paper's ROSbot 2.0: r = 0.062 m, L = 0.228 m.
    fn default() -> Self {
        Self { wheel_radius_m: 0.062, track_m: 0.228 }
    }
}

/// Why a [`Drive`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DriveError {
    /// A length is not a finite number above zero.
    #[error("{field} must be finite and above 0, not {value}")]
    NotPositive {
        /// The parameter's name.
        field: &'static str,
        /// What was given.
        value: f64,
    },
}

/// A differential drive that starts at the origin with φ = 0.
///
/// ```
/// use firmware_sim::{Integrator, Plant, drive::Drive};
/// use std::f64::consts::{FRAC_PI_2, TAU};
///
/// // The right wheel alone: a circle of radius L/2 around the left wheel.
/// let mut drive = Drive::new(Default::default(), Integrator::Exact)?;
/// let quarter_turn_s = FRAC_PI_2 / (0.062 / 0.228 * 3.0);
/// drive.step(&[3.0, 0.0], quarter_turn_s);
/// let [x, y, phi] = drive.observe();
/// assert!((x - 0.114).abs() < 1e-15);
/// assert!((y - 0.114).abs() < 1e-15);
/// assert!((phi - TAU / 4.0).abs() < 1e-15);
/// # Ok::<(), firmware_sim::drive::DriveError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Drive {
    parameters: DriveParameters,
    integrator: Integrator,
    /// x (m), y (m), φ (rad).
    pose: [f64; 3],
}

impl Drive {
    /// A drive at the origin.
    ///
    /// # Errors
    ///
    /// [`DriveError::NotPositive`] if a length is not a finite number above zero.
    pub fn new(parameters: DriveParameters, integrator: Integrator) -> Result<Self, DriveError> {
        for (field, value) in
            [("wheel_radius_m", parameters.wheel_radius_m), ("track_m", parameters.track_m)]
        {
            if !(value.is_finite() && value > 0.0) {
                return Err(DriveError::NotPositive { field, value });
            }
        }
        Ok(Self { parameters, integrator, pose: [0.0; 3] })
    }

    /// Puts the robot at the pose x (m), y (m), φ (rad).
    pub fn set_pose(&mut self, pose: [f64; 3]) {
        self.pose = pose;
    }

    /// Forward speed (m/s) and turn rate (rad/s) for the wheel speeds ω_r, ω_l (rad/s).
    fn twist(&self, [right, left]: [f64; 2]) -> [f64; 2] {
        let DriveParameters { wheel_radius_m: r, track_m: l } = self.parameters;
        [r / 2.0 * (right + left), r / l * (right - left)]
    }
}

impl Plant<3, 2> for Drive {
    fn outputs(&self) -> [Variable; 3] {
        [("x", "m"), ("y", "m"), ("phi", "rad")].map(|(name, unit)| Variable { name, unit })
    }

    fn inputs(&self) -> [Variable; 2] {
        ["omega_r", "omega_l"].map(|name| Variable { name, unit: "radps" })
    }

    fn reset(&mut self) {
        self.pose = [0.0; 3];
    }

    fn step(&mut self, input: &[f64; 2], dt_s: f64) {
        let [speed, turn_rate] = self.twist(*input);
        let rate =
            |&[_, _, phi]: &[f64; 3]| [speed * libm::cos(phi), speed * libm::sin(phi), turn_rate];
        self.pose = match self.integrator {
            Integrator::Exact => {
                let [x, y, phi] = self.pose;
                let turn = turn_rate * dt_s;
                let chord = speed * dt_s * sinc(turn / 2.0);
                let direction = phi + turn / 2.0;
                [x + chord * libm::cos(direction), y + chord * libm::sin(direction), phi + turn]
            }
            Integrator::Numerical(method) => method.integrate(self.pose, dt_s, rate),
        };
    }

    fn observe(&self) -> [f64; 3] {
        self.pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_4, TAU};

    /// A hundred additions of numbers of order one, each good to half a unit in the last place.
    const ROUNDING: f64 = 1e-13;

    fn drive(integrator: &str) -> Drive {
        Drive::new(DriveParameters::default(), integrator.parse().unwrap()).unwrap()
    }

    fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
        (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn circle_closes() {
        let input = [12.1369, 6.7310];
        let mut drive = drive("exact");
        let period = TAU / drive.twist(input)[1];
        for _ in 0..100 {
            drive.step(&input, period / 100.0);
        }
        assert!(distance(drive.observe(), [0.0, 0.0, TAU]) < ROUNDING);
    }

    #[test]
    fn half_circle_lies_one_diameter_to_the_left() {
        let input = [12.1369, 6.7310];
        let mut drive = drive("exact");
        let [speed, turn_rate] = drive.twist(input);
        drive.step(&input, TAU / 2.0 / turn_rate);
        let diameter = 2.0 * speed / turn_rate;
        assert!(distance(drive.observe(), [0.0, diameter, TAU / 2.0]) < ROUNDING);
    }

    #[test]
    fn equal_wheels_drive_straight() {
        let mut drive = drive("exact");
        drive.set_pose([1.0, 2.0, FRAC_PI_4]);
        drive.step(&[10.0, 10.0], 0.5);
        let side = 0.31 * std::f64::consts::FRAC_1_SQRT_2;
        assert!(distance(drive.observe(), [1.0 + side, 2.0 + side, FRAC_PI_4]) < 1e-15);
    }

    #[test]
    fn small_turns_tend_to_the_straight_line() {
        // Sideways offset of an arc: d·δ/2 to first order, with d = 0.62 m.
        for turn in [1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-200] {
            let mut drive = drive("exact");
            let half_difference = turn * 0.228 / 0.062 / 2.0;
            // Two steps with the turn in the first only: no rounding of 10 ± difference.
            drive.step(&[half_difference, -half_difference], 1.0);
            drive.step(&[10.0, 10.0], 1.0);
            let [x, y, phi] = drive.observe();
            assert!((phi / turn - 1.0).abs() < 1e-15);
            assert!((x - 0.62 * libm::cos(turn)).abs() < 1e-15);
            assert!((y / (0.62 * turn) - 1.0).abs() < 1e-6);
        }
        let mut arc = drive("exact");
        let mut straight = arc.clone();
        arc.step(&[10.0 + 1e-12, 10.0 - 1e-12], 1.0);
        straight.step(&[10.0, 10.0], 1.0);
        assert!(distance(arc.observe(), straight.observe()) < 1e-12);
    }

    #[test]
    fn one_euler_step_is_the_papers_formula() {
        let mut drive = drive("euler");
        drive.set_pose([0.5, -0.25, 1.0]);
        drive.step(&[7.0, 5.0], 0.1);
        let expected = [
            0.5 + 0.1 * (0.031 * 12.0 * libm::cos(1.0)),
            -0.25 + 0.1 * (0.031 * 12.0 * libm::sin(1.0)),
            1.0 + 0.1 * (0.062 / 0.228 * 2.0),
        ];
        assert!(distance(drive.observe(), expected) < 1e-15);
    }

    #[test]
    fn lengths_must_be_above_zero() {
        for bad in [0.0, -0.1, f64::NAN, f64::INFINITY] {
            let parameters = DriveParameters { track_m: bad, ..Default::default() };
            let error = Drive::new(parameters, Integrator::Exact).unwrap_err();
            assert!(error.to_string().starts_with("track_m must be finite"));
        }
    }

    proptest! {
        #[test]
        fn all_integrators_agree(
            right in -32.0..32.0, left in -32.0..32.0, phi in -10.0..10.0, dt in 0.0..0.2,
        ) {
            let end = |integrator: &str| {
                let mut drive = drive(integrator);
                drive.set_pose([0.3, -0.7, phi]);
                drive.step(&[right, left], dt);
                drive.observe()
            };
            // RK4 at steps of at most 10 ms and turns of at most 0.18 rad; Euler at 20 µs.
            prop_assert!(distance(end("exact"), end("rk4:20")) < 1e-7);
            prop_assert!(distance(end("exact"), end("euler:10000")) < 1e-3);
        }

        #[test]
        fn splitting_a_step_or_going_back_changes_nothing(
            right in -32.0..32.0, left in -32.0..32.0, dt in 0.0..1.0, share in 0.0..1.0,
        ) {
            let mut whole = drive("exact");
            whole.step(&[right, left], dt);
            let mut split = drive("exact");
            split.step(&[right, left], dt * share);
            split.step(&[right, left], dt * (1.0 - share));
            prop_assert!(distance(whole.observe(), split.observe()) < ROUNDING);
            whole.step(&[-right, -left], dt);
            prop_assert!(distance(whole.observe(), [0.0; 3]) < ROUNDING);
        }

        #[test]
        fn motion_does_not_depend_on_where_the_robot_stands(
            right in -32.0..32.0, left in -32.0..32.0, x in -5.0..5.0, y in -5.0..5.0, phi in -3.0..3.0,
        ) {
            let mut at_origin = drive("exact");
            at_origin.step(&[right, left], 0.1);
            let [dx, dy, dphi] = at_origin.observe();
            let mut moved = drive("exact");
            moved.set_pose([x, y, phi]);
            moved.step(&[right, left], 0.1);
            let (sin, cos) = (libm::sin(phi), libm::cos(phi));
            let expected = [x + cos * dx - sin * dy, y + sin * dx + cos * dy, phi + dphi];
            prop_assert!(distance(moved.observe(), expected) < ROUNDING);
        }
    }
}
