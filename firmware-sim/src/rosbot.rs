//! Skid-steered robot with four wheels, a stand-in for a physical ROSbot 2.0.
//!
//! **An invented plant.** The paper's measurements of its ROSbot were never published. This one has
//! the robot's nominal dimensions and the parts that set such a robot apart from [`Drive`]: wheels
//! that take time to follow a command, encoders that count, and tyres that slip. Its magnitudes are
//! plausible; no number was identified from a real one. Good figures on it say that a method copes
//! with such effects, not that it predicts the paper's robot.
//!
//! Inputs: the commanded speeds ω_r, ω_l (rad/s) of the wheels on the right and on the left; the two
//! wheels of a side turn as one. Outputs: x, y (m), φ (rad), counter-clockwise and unwrapped.
//! Everything else is hidden from a camera; the robot's own computer sees the encoder counts.
//!
//! # Speed controllers
//!
//! Every 10 ms, from time 0 on, each side's PI controller takes the command that holds then, reads
//! its encoder (whole counts, [`i32`], wrapping) and sets a voltage for the next 10 ms:
//!
//! ```text
//! ω̂ = 2π/N (n_k − n_{k−1}) / 10 ms         N counts per turn of the wheel
//! e = ω_commanded − ω̂
//! U = min(max(k_p e + I, −U_s), U_s),  I ← I + k_i e · 10 ms   unless that drives U further into ±U_s
//! ```
//!
//! One count is 0.385 rad/s of ω̂, so that held speeds ripple.
//!
//! What the voltages do is in [`skid_steer`](crate::skid_steer).
//!
//! The body is integrated by RK4 in two steps from the last controller tick, however time is cut
//! into steps: splitting a step changes nothing but rounding.
//!
//! [`Drive`]: crate::drive::Drive

use crate::integrate::Numerical;
use crate::plant::{Plant, Variable};
use crate::skid_steer::{Motion, Wheel};
use std::f64::consts::TAU;
use std::num::NonZeroU32;

/// Period of the speed controllers (s).
const TICK_S: f64 = 0.01;
/// Times closer to a controller tick than this are at it: far above the rounding of sums of
/// durations, far below what moves the robot by a measurable amount.
const TICK_TOLERANCE_S: f64 = 1e-10;
/// Of the body, over one controller tick.
const METHOD: Numerical = Numerical::Rk4 { substeps: NonZeroU32::new(2).unwrap() };

/// What fixes a [`Rosbot`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RosbotParameters {
    /// Wheel radius r (m).
    pub wheel_radius_m: f64,
    /// Nominal distance L between the wheels of the two sides (m).
    pub track_m: f64,
    /// Effective track λ in nominal ones, above 1.
    pub track_ratio: f64,
    /// Lag T_g of the ground speed of a side (s).
    pub slide_lag_s: f64,
    /// Share c of the way that is lost to slip, per ground speed (s/m); below the value at which
    /// the fastest wheel would gain nothing from turning faster.
    pub slip_s_per_m: f64,
    /// Sideways drift T_w per centripetal acceleration (s).
    pub drift_s: f64,
    /// Supply voltage U_s (V).
    pub supply_volt: f64,
    /// Speed K of a frictionless wheel per voltage (rad/s/V).
    pub speed_per_volt: f64,
    /// Lag T of a frictionless wheel (s).
    pub motor_lag_s: f64,
    /// Viscous friction b (V s/rad).
    pub viscous_volt_s: f64,
    /// Coulomb friction U_c of a turning wheel (V), below the break-away voltage.
    pub coulomb_volt: f64,
    /// Voltage U_b above which a resting wheel breaks loose (V), below the supply.
    pub break_away_volt: f64,
    /// Encoder counts N per turn of the wheel.
    pub counts_per_turn: NonZeroU32,
    /// Proportional gain k_p of the speed controllers (V s/rad).
    pub proportional_gain: f64,
    /// Integral gain k_i of the speed controllers (V/rad).
    pub integral_gain: f64,
}

impl Default for RosbotParameters {
    /// Plausible values: the paper's r = 0.062 m and L = 0.228 m, turns 3 % wider than nominal, 12 V
    /// motors with 24 rad/s at most, encoders with 1632 counts per turn.
    fn default() -> Self {
        Self {
            wheel_radius_m: 0.062,
            track_m: 0.228,
            track_ratio: 1.03,
            slide_lag_s: 0.03,
            slip_s_per_m: 0.015,
            drift_s: 0.02,
            supply_volt: 12.0,
            speed_per_volt: 2.2,
            motor_lag_s: 0.08,
            viscous_volt_s: 0.02,
            coulomb_volt: 0.6,
            break_away_volt: 0.9,
            // 48 counts per turn of the motor, geared down 34 : 1.
            counts_per_turn: NonZeroU32::new(1632).unwrap(),
            proportional_gain: 0.7,
            integral_gain: 9.0,
        }
    }
}

impl RosbotParameters {
    /// Refuses what the equations make no sense with.
    pub(crate) fn check(&self) -> Result<(), RosbotError> {
        let p = self;
        const MOST: f64 = f64::INFINITY;
        let fastest_mps = p.wheel_radius_m * p.speed_per_volt * p.supply_volt;
        for (field, value, above, below) in [
            ("wheel_radius_m", p.wheel_radius_m, 0.0, MOST),
            ("track_m", p.track_m, 0.0, MOST),
            ("track_ratio", p.track_ratio, 1.0, MOST),
            ("slide_lag_s", p.slide_lag_s, 0.0, MOST),
            ("supply_volt", p.supply_volt, 0.0, MOST),
            ("speed_per_volt", p.speed_per_volt, 0.0, MOST),
            ("slip_s_per_m", p.slip_s_per_m, 0.0, 0.5 / fastest_mps),
            ("drift_s", p.drift_s, 0.0, MOST),
            ("motor_lag_s", p.motor_lag_s, 0.0, MOST),
            ("viscous_volt_s", p.viscous_volt_s, 0.0, MOST),
            ("break_away_volt", p.break_away_volt, 0.0, p.supply_volt),
            ("coulomb_volt", p.coulomb_volt, 0.0, p.break_away_volt),
            ("proportional_gain", p.proportional_gain, 0.0, MOST),
            ("integral_gain", p.integral_gain, 0.0, MOST),
        ] {
            if !(value > above && value < below) {
                return Err(RosbotError::OutOfRange { field, value, above, below });
            }
        }
        Ok(())
    }
}

/// Why a [`Rosbot`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RosbotError {
    /// A parameter lies outside its range.
    #[error("{field} must lie strictly between {above} and {below}, not at {value}")]
    OutOfRange {
        /// The parameter's name.
        field: &'static str,
        /// What was given.
        value: f64,
        /// Bound that the value must exceed.
        above: f64,
        /// Bound that the value must stay below.
        below: f64,
    },
}

/// A skid-steered robot that starts at rest at the origin with φ = 0.
///
/// ```
/// use firmware_sim::{Plant, rosbot::Rosbot};
///
/// // The paper's circle. The nominal equations turn by 1.470 rad in the first second, and by 1.470
/// // in the second one.
/// let mut rosbot = Rosbot::new(Default::default())?;
/// rosbot.step(&[12.1369, 6.7310], 1.0);
/// let [_, _, phi] = rosbot.observe();
/// assert!((phi - 1.301).abs() < 5e-4);
/// rosbot.step(&[12.1369, 6.7310], 1.0);
/// let [_, _, later] = rosbot.observe();
/// assert!((later - phi - 1.402).abs() < 5e-4);
/// # Ok::<(), firmware_sim::rosbot::RosbotError>(())
/// ```
///
/// A non-finite command or duration, or a negative duration, makes the pose NaN until the next
/// [`reset`](Plant::reset).
#[derive(Debug, Clone, PartialEq)]
pub struct Rosbot {
    parameters: RosbotParameters,
    /// As of the last controller tick.
    motion: Motion,
    /// Of the right and the left side.
    controllers: [SpeedController; 2],
    /// Time since the last controller tick (s). From [`TICK_S`] on, the next tick is due: it takes
    /// the command of the step that goes on from there.
    since_tick_s: f64,
}

/// The PI controller of one side.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct SpeedController {
    /// Voltage U until the next tick.
    volt: f64,
    /// Integral part I (V).
    integral: f64,
    /// Encoder count seen last.
    count: i32,
}

impl SpeedController {
    /// One tick: the command (rad/s) and the encoder count now.
    fn tick(self, p: &RosbotParameters, command: f64, count: i32) -> Self {
        let turns = f64::from(count.wrapping_sub(self.count)) / f64::from(p.counts_per_turn.get());
        let error = command - TAU * turns / TICK_S;
        let wanted = p.proportional_gain * error + self.integral;
        let volt = wanted.clamp(-p.supply_volt, p.supply_volt);
        let winds_up = volt != wanted && error * wanted > 0.0;
        let integral =
            if winds_up { self.integral } else { self.integral + p.integral_gain * error * TICK_S };
        Self { volt, integral, count }
    }
}

impl Rosbot {
    /// A robot at rest at the origin.
    ///
    /// # Errors
    ///
    /// [`RosbotError::OutOfRange`] for a parameter with which the equations make no sense.
    pub fn new(parameters: RosbotParameters) -> Result<Self, RosbotError> {
        parameters.check()?;
        Ok(Self {
            parameters,
            motion: Motion::default(),
            controllers: Default::default(),
            since_tick_s: TICK_S,
        })
    }

    /// Speeds of the right and the left wheels now (rad/s), as they are and not as their encoders
    /// measure them.
    pub fn wheel_speeds_radps(&self) -> [f64; 2] {
        self.now().wheels.map(|wheel| wheel.speed_radps)
    }

    /// Encoder counts of the right and the left wheels now, 0 at the start, wrapping.
    pub fn encoder_counts(&self) -> [i32; 2] {
        self.now().wheels.map(|wheel| self.count(wheel))
    }

    /// Whole counts nearest to the angle of a wheel, modulo 2³²: rounded, not floored, so that
    /// forwards and backwards are alike.
    fn count(&self, wheel: Wheel) -> i32 {
        let counts = wheel.angle_rad / TAU * f64::from(self.parameters.counts_per_turn.get());
        libm::round(counts) as i64 as i32
    }

    fn now(&self) -> Motion {
        self.after_tick(self.since_tick_s.clamp(0.0, TICK_S))
    }

    /// The motion `t` seconds after the last controller tick, `t` up to [`TICK_S`].
    fn after_tick(&self, t: f64) -> Motion {
        let volts = self.controllers.map(|controller| controller.volt);
        self.motion.after(&self.parameters, volts, [0.0; 2], t, METHOD)
    }
}

impl Plant<3, 2> for Rosbot {
    fn outputs(&self) -> [Variable; 3] {
        [("x", "m"), ("y", "m"), ("phi", "rad")].map(|(name, unit)| Variable { name, unit })
    }

    fn inputs(&self) -> [Variable; 2] {
        ["omega_r", "omega_l"].map(|name| Variable { name, unit: "radps" })
    }

    fn reset(&mut self) {
        self.motion = Motion::default();
        self.controllers = Default::default();
        self.since_tick_s = TICK_S;
    }

    fn step(&mut self, input: &[f64; 2], dt_s: f64) {
        if !(input.iter().all(|command| command.is_finite())
            && (0.0..f64::INFINITY).contains(&dt_s))
        {
            self.motion.pose = [f64::NAN; 3];
            return;
        }
        let mut left_s = dt_s;
        while left_s > 0.0 {
            if self.since_tick_s >= TICK_S - TICK_TOLERANCE_S {
                self.motion = self.after_tick(TICK_S);
                let counts = self.motion.wheels.map(|wheel| self.count(wheel));
                for (side, controller) in self.controllers.iter_mut().enumerate() {
                    *controller = controller.tick(&self.parameters, input[side], counts[side]);
                }
                self.since_tick_s -= TICK_S;
            }
            let to_tick_s = TICK_S - self.since_tick_s;
            if left_s <= to_tick_s + TICK_TOLERANCE_S {
                self.since_tick_s += left_s;
                break;
            }
            self.since_tick_s = TICK_S;
            left_s -= to_tick_s;
        }
    }

    fn observe(&self) -> [f64; 3] {
        self.now().pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CIRCLE: [f64; 2] = [12.1369, 6.7310];
    /// Two encoder counts in one controller period, as a speed (rad/s): what held speeds ripple by.
    const RIPPLE: f64 = 2.0 * TAU / 1632.0 / TICK_S;
    /// What time differences of [`TICK_TOLERANCE_S`] and rounding move over a few seconds at speeds
    /// and rates up to 5 (m/s, rad/s), amplified by turns.
    const SPLITTING: f64 = 1e-8;

    fn at_rest() -> Rosbot {
        Rosbot::new(RosbotParameters::default()).unwrap()
    }

    fn hold(rosbot: &mut Rosbot, input: [f64; 2], samples: u32) {
        for _ in 0..samples {
            rosbot.step(&input, 0.1);
        }
    }

    fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
        (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn wheels_settle_at_the_commanded_speed_within_a_quarter_of_a_second() {
        for command in [3.0, 6.7310, 12.1369, 20.0, -3.0, -20.0] {
            let mut rosbot = at_rest();
            rosbot.step(&[command; 2], 0.04);
            let early = rosbot.wheel_speeds_radps()[0] / command;
            assert!(early < 0.7, "motors lag: {early}");
            rosbot.step(&[command; 2], 0.21);
            let mut mean = 0.0;
            for _ in 0..1000 {
                rosbot.step(&[command; 2], 0.002);
                let [right, left] = rosbot.wheel_speeds_radps();
                assert_eq!(right, left);
                let band = f64::max(0.05 * f64::abs(command), RIPPLE);
                assert!((right - command).abs() < band, "{command}: {right}");
                mean += right / 1000.0;
            }
            // The count of 2 s is good to one, and the approach is a little below.
            assert!((mean / command - 1.0).abs() < 0.005, "{command}: {mean}");
        }
    }

    #[test]
    fn faster_than_the_supply_allows_ends_at_the_motors_limit() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, [40.0, -40.0], 30);
        let limit = (12.0 - 0.6) * 2.2 / (1.0 + 2.2 * 0.02);
        let [right, left] = rosbot.wheel_speeds_radps();
        assert!((right - limit).abs() < 1e-9 && (left + limit).abs() < 1e-9, "{right} {left}");
        // Nothing has wound up: it follows a new command as quickly as ever.
        rosbot.step(&[10.0, -10.0], 0.3);
        let [right, left] = rosbot.wheel_speeds_radps();
        assert!((right - 10.0).abs() < 0.6 && (left + 10.0).abs() < 0.6, "{right} {left}");
    }

    #[test]
    fn circle_is_wider_than_nominal() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, CIRCLE, 10);
        let start = rosbot.observe();
        hold(&mut rosbot, CIRCLE, 50);
        let end = rosbot.observe();
        let turn_rate = (end[2] - start[2]) / 5.0;
        // s_r − s_l = (g_r − g_l)(1 − c (g_r + g_l)), over the effective track: 4.6 % less turn.
        let less = (1.0 - 0.015 * 0.062 * (CIRCLE[0] + CIRCLE[1])) / 1.03;
        assert!((less - 0.954).abs() < 5e-4);
        let nominal = 0.062 / 0.228 * (CIRCLE[0] - CIRCLE[1]);
        // A few counts in 5 s.
        assert!((turn_rate / nominal - less).abs() < 2e-3, "{}", turn_rate / nominal);

        // The chord 2 R sin(φ/2) gives the radius, 3.9 % above the nominal 0.398 m.
        let chord = f64::hypot(end[0] - start[0], end[1] - start[1]);
        let radius = chord / 2.0 / libm::sin((end[2] - start[2]) / 2.0).abs();
        let nominal = 0.031 * (CIRCLE[0] + CIRCLE[1]) / nominal;
        assert!((radius / nominal - 1.039).abs() < 2e-3, "{}", radius / nominal);
    }

    #[test]
    fn one_turn_strays_from_the_nominal_equations_by_decimetres() {
        use crate::drive::{Drive, DriveParameters};
        use crate::integrate::Integrator;
        let mut rosbot = at_rest();
        let mut drive = Drive::new(DriveParameters::default(), Integrator::Exact).unwrap();
        hold(&mut rosbot, CIRCLE, 43);
        (0..43).for_each(|_| drive.step(&CIRCLE, 0.1));
        let ([x, y, phi], [x0, y0, phi0]) = (rosbot.observe(), drive.observe());
        let astray = f64::hypot(x - x0, y - y0);
        assert!((0.1..0.2).contains(&astray), "{astray}");
        assert!((0.3..0.45).contains(&(phi0 - phi)), "{}", phi0 - phi);
    }

    #[test]
    fn bends_push_outwards_and_straight_lines_do_not() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, CIRCLE, 10);
        let motion = rosbot.now();
        let [vx, vy, turn_rate] = rosbot.parameters.twist(motion.ground_mps, motion.pose[2]);
        let (sin, cos) = (libm::sin(motion.pose[2]), libm::cos(motion.pose[2]));
        let (forward, sideways) = (vx * cos + vy * sin, vy * cos - vx * sin);
        assert!((sideways + 0.02 * forward * turn_rate).abs() < 1e-15);
        assert!((-0.018..-0.014).contains(&sideways), "{sideways}");

        let mut straight = at_rest();
        hold(&mut straight, [10.0, 10.0], 20);
        let [x, y, phi] = straight.observe();
        assert_eq!([y, phi], [0.0, 0.0]);
        // 1.24 m by the nominal equations; the start costs 5 cm, slip 1 % of the rest.
        assert!((1.16..1.20).contains(&x), "{x}");
    }

    #[test]
    fn ground_speed_lags_behind_the_wheels() {
        let mut rosbot = at_rest();
        rosbot.step(&[10.0, 10.0], 0.05);
        let [right, _] = rosbot.now().ground_mps;
        let wheel = 0.062 * rosbot.wheel_speeds_radps()[0];
        assert!(right < 0.8 * wheel && right > 0.4 * wheel, "{right} {wheel}");
        hold(&mut rosbot, [10.0, 10.0], 20);
        let [right, _] = rosbot.now().ground_mps;
        assert!((right - 0.62).abs() < 0.062 * RIPPLE, "{right}");
    }

    #[test]
    fn stays_at_rest_without_a_command() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, [0.0, -0.0], 100);
        assert_eq!(rosbot.observe(), [0.0; 3]);
        assert_eq!(rosbot.wheel_speeds_radps(), [0.0; 2]);
        assert_eq!(rosbot.encoder_counts(), [0; 2]);
    }

    #[test]
    fn comes_to_rest_after_a_command() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, [15.0, 5.0], 10);
        hold(&mut rosbot, [0.0, 0.0], 20);
        let before = rosbot.observe();
        hold(&mut rosbot, [0.0, 0.0], 50);
        assert_eq!(rosbot.wheel_speeds_radps(), [0.0; 2]);
        // The ground speeds fade by e every 30 ms.
        assert!(distance(before, rosbot.observe()) < 1e-9);
    }

    #[test]
    fn slow_commands_wait_for_the_integrator() {
        // A slow command moves nothing until the controller has integrated up to 0.9 V:
        // 0.7 · 0.5 + 9 · 0.5 · t = 0.9 at t = 0.122 s.
        let mut slow = at_rest();
        slow.step(&[0.5, 0.5], 0.11);
        assert_eq!(slow.observe(), [0.0; 3]);
        slow.step(&[0.5, 0.5], 0.1);
        assert!(slow.observe()[0] > 0.0);
    }

    #[test]
    fn encoders_count_the_turns_of_the_wheels() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, [10.0, -5.0], 20);
        let [right, left] = rosbot.now().wheels.map(|wheel| wheel.angle_rad);
        let counts = [right, left].map(|angle| libm::round(angle / TAU * 1632.0) as i32);
        assert_eq!(rosbot.encoder_counts(), counts);
        // 2 s at the commanded speeds, less what the start costs.
        assert!((4900..5195).contains(&counts[0]) && (-2598..-2400).contains(&counts[1]));
    }

    #[test]
    fn encoders_wrap_around_and_the_controllers_do_not_notice() {
        let mut fresh = at_rest();
        let mut old = at_rest();
        let counts = i32::MAX - 200;
        for side in 0..2 {
            old.motion.wheels[side].angle_rad = f64::from(counts) / 1632.0 * TAU;
            old.controllers[side].count = counts;
        }
        hold(&mut fresh, CIRCLE, 10);
        hold(&mut old, CIRCLE, 10);
        let [right, left] = old.encoder_counts();
        assert!(right < 0 && left < 0, "{right} {left}");
        for (old, fresh) in old.encoder_counts().into_iter().zip(fresh.encoder_counts()) {
            assert!((old.wrapping_sub(counts) - fresh).abs() <= 1);
        }
        // Angles of 8e6 rad are good to 1e-9 rad: single counts may fall on the other side.
        assert!(distance(old.observe(), fresh.observe()) < 1e-2);
    }

    #[test]
    fn a_command_acts_from_the_beginning_of_its_step() {
        // Tenths of seconds are no whole sums of hundredths in f64; ticks must not slip over them.
        let commands = [[10.0, 10.0], [9.0, -1.0], [-3.0, 14.0], [0.0, 0.0], [20.0, 4.0]];
        let (mut tenths, mut hundredths) = (at_rest(), at_rest());
        for command in commands.iter().cycle().take(500) {
            tenths.step(command, 0.1);
            (0..10).for_each(|_| hundredths.step(command, 0.01));
            assert!(distance(tenths.observe(), hundredths.observe()) < SPLITTING);
            assert_eq!(tenths.encoder_counts(), hundredths.encoder_counts());
        }
        // The first command moves the robot within the first period.
        let mut rosbot = at_rest();
        rosbot.step(&[10.0, 10.0], 0.005);
        assert!(rosbot.wheel_speeds_radps()[0] > 0.5);
        // A change in the middle of a period waits for the next tick.
        let mut changed = rosbot.clone();
        changed.step(&[-10.0, -10.0], 0.005);
        rosbot.step(&[10.0, 10.0], 0.005);
        assert_eq!(changed, rosbot);
        changed.step(&[-10.0, -10.0], 0.005);
        rosbot.step(&[10.0, 10.0], 0.005);
        assert!(changed.wheel_speeds_radps()[0] < rosbot.wheel_speeds_radps()[0]);
    }

    #[test]
    fn no_time_changes_nothing() {
        let mut rosbot = at_rest();
        hold(&mut rosbot, CIRCLE, 3);
        let before = rosbot.clone();
        rosbot.step(&[-10.0, 3.0], 0.0);
        assert_eq!(rosbot, before);
    }

    #[test]
    fn what_is_not_finite_or_runs_backwards_gives_nan_until_reset() {
        for (input, dt_s) in [
            ([f64::NAN, 1.0], 0.1),
            ([1.0, f64::INFINITY], 0.1),
            ([1.0, 1.0], f64::NAN),
            ([1.0, 1.0], f64::INFINITY),
            ([1.0, 1.0], -0.1),
        ] {
            let mut rosbot = at_rest();
            rosbot.step(&input, dt_s);
            hold(&mut rosbot, [1.0, 1.0], 3);
            assert!(rosbot.observe().iter().all(|value| value.is_nan()));
            rosbot.reset();
            assert_eq!(rosbot, at_rest());
        }
    }

    #[test]
    fn impossible_robots_are_refused() {
        let new = |change: fn(&mut RosbotParameters)| {
            let mut parameters = RosbotParameters::default();
            change(&mut parameters);
            Rosbot::new(parameters).map_err(|error| error.to_string())
        };
        assert_eq!(
            new(|p| p.track_ratio = 1.0).unwrap_err(),
            "track_ratio must lie strictly between 1 and inf, not at 1"
        );
        assert_eq!(
            new(|p| p.coulomb_volt = 0.9).unwrap_err(),
            "coulomb_volt must lie strictly between 0 and 0.9, not at 0.9"
        );
        let bad: [fn(&mut RosbotParameters); 12] = [
            |p| p.wheel_radius_m = 0.0,
            |p| p.track_m = -0.2,
            |p| p.slide_lag_s = f64::NAN,
            // 0.5 / (0.062 · 2.2 · 12) = 0.305.
            |p| p.slip_s_per_m = 0.31,
            |p| p.drift_s = f64::INFINITY,
            |p| p.supply_volt = 0.5,
            |p| p.speed_per_volt = 0.0,
            |p| p.motor_lag_s = 0.0,
            |p| p.viscous_volt_s = -0.1,
            |p| p.break_away_volt = 12.0,
            |p| p.proportional_gain = 0.0,
            |p| p.integral_gain = f64::NEG_INFINITY,
        ];
        for (number, change) in bad.into_iter().enumerate() {
            assert!(new(change).is_err(), "case {number}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn splitting_a_step_changes_nothing(
            steps in prop::collection::vec(
                (-25.0..25.0, -25.0..25.0, prop::collection::vec(0.0..1.0, 1..6)), 1..20,
            ),
        ) {
            let (mut whole, mut split) = (at_rest(), at_rest());
            for (right, left, shares) in steps {
                let input = [right, left];
                let sum: f64 = shares.iter().sum::<f64>() + 1e-3;
                whole.step(&input, 0.1);
                for share in &shares {
                    split.step(&input, 0.1 * share / sum);
                }
                split.step(&input, 0.1 * 1e-3 / sum);
                prop_assert!(distance(whole.observe(), split.observe()) < SPLITTING);
                prop_assert_eq!(whole.encoder_counts(), split.encoder_counts());
            }
        }

        #[test]
        fn mirrored_commands_give_the_mirrored_path(
            commands in prop::collection::vec((-25.0..25.0, -25.0..25.0), 1..30),
        ) {
            let (mut rosbot, mut swapped, mut reversed) = (at_rest(), at_rest(), at_rest());
            for (right, left) in commands {
                rosbot.step(&[right, left], 0.1);
                swapped.step(&[left, right], 0.1);
                reversed.step(&[-right, -left], 0.1);
                let [x, y, phi] = rosbot.observe();
                prop_assert_eq!(swapped.observe(), [x, -y, -phi]);
                prop_assert_eq!(reversed.observe(), [-x, y, -phi]);
            }
        }

        #[test]
        fn speeds_stay_in_their_bounds(
            commands in prop::collection::vec((-60.0..60.0, -60.0..60.0, 0.0..0.3), 1..60),
        ) {
            let mut rosbot = at_rest();
            // (12 V − 0.6 V) · 2.2 / 1.044.
            let fastest = 24.023;
            for (right, left, seconds) in commands {
                let [x0, y0, phi0] = rosbot.observe();
                rosbot.step(&[right, left], seconds);
                let [x, y, phi] = rosbot.observe();
                prop_assert!(rosbot.wheel_speeds_radps().iter().all(|w| w.abs() <= fastest));
                let [g_r, g_l] = rosbot.now().ground_mps;
                prop_assert!(g_r.abs() <= 0.062 * fastest && g_l.abs() <= 0.062 * fastest);
                prop_assert!(rosbot.controllers.iter().all(|side| side.volt.abs() <= 12.0));
                // Forward and, in the sharpest bend, sideways: at most 2 % · 13 rad/s of it.
                let most = 0.062 * fastest * 1.04 * seconds + 1e-12;
                prop_assert!(f64::hypot(x - x0, y - y0) <= most);
                prop_assert!((phi - phi0).abs() <= 2.0 * 0.062 * fastest / 0.228 * seconds + 1e-12);
            }
        }
    }
}
