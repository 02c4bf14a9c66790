//! Soft pneumatic leg with a bending and an extension chamber.
//!
//! **An invented plant.** The paper's leg was never published as equations or as data. This one has
//! its parts (two chambers, each behind a normally closed solenoid valve, one pump for pressure and
//! one for vacuum) and magnitudes that such a leg could have; no number was identified from a real
//! one. Good figures on it say that a method copes with dead-bands, hidden pressures and
//! hysteresis, not that it predicts the paper's leg.
//!
//! Inputs: the signed voltages u of the bending and the extension valve, −12 V to 12 V. The sign
//! chooses the pump (+ pressure, − vacuum), the size opens the valve. Outputs: the tip (y, z) (mm),
//! measured from where it idles, y towards the side it bends to under pressure, z up: bending lifts
//! the tip, extension lowers it. Everything else is hidden.
//!
//! Per chamber, with the signed opening v, the gauge pressure p (kPa), the hysteretic pressure
//! h (kPa) and the pressure w (kPa) that the material has yielded to:
//!
//! ```text
//! a(u) = sign(u) min(max(|u| − u_0, 0) / (u_1 − u_0), 1)      dead-band u_0, fully open at u_1
//! v'   = (a(u) − v) / T_v                                     valve and pump lag
//! p'   = k |v| f(p_s − p) − p / T_l,  f(q) = q / √(1 + |q|/q_0)
//!                                     p_s: supply where v > 0, vacuum where v < 0; leak T_l
//! h'   = p' − (|p'| h + p' |h|) / (2 H)                       Bouc-Wen, |h| ≤ H
//! w'   = (p − κ h − w) / T_w                                  Kelvin-Voigt lag
//! ```
//!
//! f is the flow through an orifice, a square root of the pressure difference above q_0 and laminar
//! (linear) below. The hysteresis is the model of Y.-K. Wen, "Method for random vibration of
//! hysteretic systems", J. Eng. Mech. Div. ASCE 102(2), 1976, with n = 1 and β = γ = 1/(2H), for
//! which h stays inside ±H and unloading is elastic.
//!
//! The tip follows from constant curvature (R. J. Webster and B. A. Jones, "Design and kinematic
//! modeling of constant curvature continuum robots: a review", Int. J. Robotics Research 29(13),
//! 2010): an arc of length ℓ = ℓ_0 + e tanh(w_ext / p_e) bent by b = B tanh(w_bend / p_b),
//!
//! ```text
//! y = ℓ (1 − cos b)/b,   z = ℓ_0 − ℓ sin(b)/b
//! ```
//!
//! so the tip never leaves the disc of radius ℓ_0 + e around the hip at (0, ℓ_0). With u = 0 the
//! valves close and the leg comes to rest as the chambers leak out, at a tip that remembers, within
//! κH, how it was loaded.
//!
//! Integrated by RK4. The fastest lag is T_v = 30 ms: keep sub-steps at or below 10 ms.

use crate::integrate::Numerical;
use crate::plant::{Plant, Variable};
use crate::sinc::sinc;
use std::num::NonZeroU32;

/// What fixes a soft leg; pairs are (bending, extension).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SoftLegParameters {
    /// Voltage u_0 below which a valve stays closed (V).
    pub dead_band_volt: f64,
    /// Voltage u_1 from which a valve is fully open (V).
    pub full_open_volt: f64,
    /// Lag T_v of valve and pump (s).
    pub valve_lag_s: f64,
    /// Gauge pressure that the input pump reaches (kPa).
    pub supply_kpa: f64,
    /// Gauge pressure that the exhaust pump reaches, below 0 (kPa).
    pub vacuum_kpa: f64,
    /// Pressure difference q_0 below which the flow is laminar (kPa).
    pub laminar_kpa: f64,
    /// Flow constants k of the fully open valves (1/s).
    pub flow_per_s: [f64; 2],
    /// Time constant T_l of the leak (s).
    pub leak_s: f64,
    /// Bound H of the hysteretic pressure (kPa).
    pub hysteresis_kpa: f64,
    /// Share κ of the hysteretic pressure that is lost, from 0 to 1.
    pub hysteresis_share: f64,
    /// Viscoelastic lags T_w (s).
    pub viscous_lag_s: [f64; 2],
    /// Length ℓ_0 of the idle leg (mm).
    pub rest_length_mm: f64,
    /// Largest extension e (mm), below ℓ_0.
    pub extension_mm: f64,
    /// Largest bending angle B (rad).
    pub bend_rad: f64,
    /// Pressures p_b, p_e that give 76 % (tanh 1) of the largest bend and extension (kPa).
    pub stiffness_kpa: [f64; 2],
}

impl Default for SoftLegParameters {
    /// Plausible values: 12 V valves that open at 2.5 V, +60 and −30 kPa, a leg of 65 mm that bends
    /// by up to 1.2 rad and extends by up to 20 mm.
    fn default() -> Self {
        Self {
            dead_band_volt: 2.5,
            full_open_volt: 12.0,
            valve_lag_s: 0.03,
            supply_kpa: 60.0,
            vacuum_kpa: -30.0,
            laminar_kpa: 5.0,
            flow_per_s: [9.0, 6.0],
            leak_s: 10.0,
            hysteresis_kpa: 6.0,
            hysteresis_share: 0.6,
            viscous_lag_s: [0.10, 0.15],
            rest_length_mm: 65.0,
            extension_mm: 20.0,
            bend_rad: 1.2,
            stiffness_kpa: [40.0, 40.0],
        }
    }
}

/// Why a [`SoftLeg`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SoftLegError {
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

/// A soft leg that starts idle: no pressure, tip at (0, 0).
///
/// ```
/// use firmware_sim::{Plant, soft_leg::SoftLeg};
///
/// let mut leg = SoftLeg::new(Default::default(), 200.try_into()?)?;
/// leg.step(&[2.0, -2.0], 1.0); // inside the dead-band
/// assert_eq!(leg.observe(), [0.0, 0.0]);
/// leg.step(&[6.0, 0.0], 1.0); // bend
/// let [y, z] = leg.observe();
/// assert!((y - 24.819).abs() < 1e-3 && (z - 6.820).abs() < 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SoftLeg {
    parameters: SoftLegParameters,
    method: Numerical,
    state: [f64; STATES],
}

/// What is around the chambers of a leg: as it should be, but for a fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surroundings {
    /// Share of its pressure that each source reaches: the input pump, the exhaust pump. `None` for
    /// a pump that is off: its line is shut and nothing flows.
    pub sources: [Option<f64>; 2],
    /// By how much faster than usual the bending and the extension chamber leak, from 1.
    pub leaks: [f64; 2],
}

impl Default for Surroundings {
    /// Both pumps run, nothing leaks more than usual.
    fn default() -> Self {
        Self { sources: [Some(1.0); 2], leaks: [1.0; 2] }
    }
}

/// v, p, h, w of the bending chamber, then of the extension chamber.
const STATES: usize = 2 * PER_CHAMBER;
const PER_CHAMBER: usize = 4;

impl SoftLeg {
    /// An idle leg, advanced by RK4 with `substeps` equal sub-steps per step.
    ///
    /// # Errors
    ///
    /// [`SoftLegError::OutOfRange`] for a parameter with which the equations make no sense.
    pub fn new(parameters: SoftLegParameters, substeps: NonZeroU32) -> Result<Self, SoftLegError> {
        let p = &parameters;
        const MOST: f64 = f64::INFINITY;
        for (field, value, above, below) in [
            ("dead_band_volt", p.dead_band_volt, 0.0, p.full_open_volt),
            ("full_open_volt", p.full_open_volt, 0.0, MOST),
            ("valve_lag_s", p.valve_lag_s, 0.0, MOST),
            ("supply_kpa", p.supply_kpa, 0.0, MOST),
            ("vacuum_kpa", p.vacuum_kpa, -MOST, 0.0),
            ("laminar_kpa", p.laminar_kpa, 0.0, MOST),
            ("flow_per_s[0]", p.flow_per_s[0], 0.0, MOST),
            ("flow_per_s[1]", p.flow_per_s[1], 0.0, MOST),
            ("leak_s", p.leak_s, 0.0, MOST),
            ("hysteresis_kpa", p.hysteresis_kpa, 0.0, MOST),
            ("hysteresis_share", p.hysteresis_share, 0.0, 1.0),
            ("viscous_lag_s[0]", p.viscous_lag_s[0], 0.0, MOST),
            ("viscous_lag_s[1]", p.viscous_lag_s[1], 0.0, MOST),
            ("rest_length_mm", p.rest_length_mm, 0.0, MOST),
            ("extension_mm", p.extension_mm, 0.0, p.rest_length_mm),
            ("bend_rad", p.bend_rad, 0.0, std::f64::consts::PI),
            ("stiffness_kpa[0]", p.stiffness_kpa[0], 0.0, MOST),
            ("stiffness_kpa[1]", p.stiffness_kpa[1], 0.0, MOST),
        ] {
            if !(value > above && value < below) {
                return Err(SoftLegError::OutOfRange { field, value, above, below });
            }
        }
        Ok(Self { parameters, method: Numerical::Rk4 { substeps }, state: [0.0; STATES] })
    }

    /// Gauge pressures of the bending and the extension chamber (kPa), which the leg's own sensor
    /// cannot see.
    pub fn pressures_kpa(&self) -> [f64; 2] {
        [self.state[1], self.state[PER_CHAMBER + 1]]
    }

    /// Signed openings v of the valves now, from −1 to 1: above 0 towards the pressure line.
    pub fn openings(&self) -> [f64; 2] {
        [self.state[0], self.state[PER_CHAMBER]]
    }

    /// Signed opening a(u), from −1 to 1, that a held voltage (V) leads to.
    pub fn opening(&self, volt: f64) -> f64 {
        let SoftLegParameters { dead_band_volt, full_open_volt, .. } = self.parameters;
        let size = (volt.abs() - dead_band_volt) / (full_open_volt - dead_band_volt);
        size.clamp(0.0, 1.0).copysign(volt)
    }

    /// (v', p', h', w') of one chamber at (v, p, h, w).
    fn chamber_rate(
        &self,
        chamber: usize,
        [v, p, h, w]: [f64; PER_CHAMBER],
        opening: f64,
        around: &Surroundings,
    ) -> [f64; PER_CHAMBER] {
        let c = &self.parameters;
        let (kpa, source) = if v > 0.0 {
            (c.supply_kpa, around.sources[0])
        } else {
            (c.vacuum_kpa, around.sources[1])
        };
        let flow = source.map_or(0.0, |share| {
            let difference = share * kpa - p;
            difference / libm::sqrt(1.0 + difference.abs() / c.laminar_kpa)
        });
        let leak = p / c.leak_s * around.leaks[chamber];
        let pressure_rate = c.flow_per_s[chamber] * v.abs() * flow - leak;
        [
            (opening - v) / c.valve_lag_s,
            pressure_rate,
            bouc_wen_rate(pressure_rate, h, c.hysteresis_kpa),
            (p - c.hysteresis_share * h - w) / c.viscous_lag_s[chamber],
        ]
    }

    /// Advances by `dt_s` seconds towards these signed openings of the valves, from −1 to 1.
    pub fn step_towards(&mut self, openings: [f64; 2], around: &Surroundings, dt_s: f64) {
        let [bend, extend] = openings;
        let rate = |&[v1, p1, h1, w1, v2, p2, h2, w2]: &[f64; STATES]| {
            let [a, b, c, d] = self.chamber_rate(0, [v1, p1, h1, w1], bend, around);
            let [e, f, g, h] = self.chamber_rate(1, [v2, p2, h2, w2], extend, around);
            [a, b, c, d, e, f, g, h]
        };
        self.state = self.method.integrate(self.state, dt_s, rate);
    }
}

/// h' = p' − (|p'| h + p' |h|) / (2 H).
fn bouc_wen_rate(p_rate: f64, h: f64, bound: f64) -> f64 {
    p_rate - (p_rate.abs() * h + p_rate * h.abs()) / (2.0 * bound)
}

impl Plant<2, 2> for SoftLeg {
    fn outputs(&self) -> [Variable; 2] {
        ["y", "z"].map(|name| Variable { name, unit: "mm" })
    }

    fn inputs(&self) -> [Variable; 2] {
        ["bending", "extension"].map(|name| Variable { name, unit: "V" })
    }

    fn reset(&mut self) {
        self.state = [0.0; STATES];
    }

    fn step(&mut self, input: &[f64; 2], dt_s: f64) {
        let openings = input.map(|volt| self.opening(volt));
        self.step_towards(openings, &Surroundings::default(), dt_s);
    }

    fn observe(&self) -> [f64; 2] {
        let c = &self.parameters;
        let [_, _, _, w_bend, _, _, _, w_extend] = self.state;
        let length = c.rest_length_mm + c.extension_mm * libm::tanh(w_extend / c.stiffness_kpa[1]);
        let bend = c.bend_rad * libm::tanh(w_bend / c.stiffness_kpa[0]);
        [
            // (1 − cos b)/b = sin(b/2)·sinc(b/2), which does not cancel at small angles.
            length * libm::sin(bend / 2.0) * sinc(bend / 2.0),
            c.rest_length_mm - length * sinc(bend),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Sub-steps of 5 ms for a sample of 50 ms.
    fn leg() -> SoftLeg {
        leg_with(10)
    }

    fn leg_with(substeps: u32) -> SoftLeg {
        SoftLeg::new(SoftLegParameters::default(), NonZeroU32::new(substeps).unwrap()).unwrap()
    }

    fn hold(leg: &mut SoftLeg, input: [f64; 2], seconds: f64) {
        for _ in 0..(seconds * 20.0) as usize {
            leg.step(&input, 0.05);
        }
    }

    #[test]
    fn stays_idle_inside_the_dead_band() {
        let mut leg = leg();
        for input in [[0.0, 0.0], [2.5, -2.5], [-0.0, 2.4]] {
            hold(&mut leg, input, 2.0);
            assert_eq!(leg.observe(), [0.0, 0.0]);
        }
    }

    #[test]
    fn opening_grows_with_the_voltage_up_to_full() {
        let leg = leg();
        assert_eq!(leg.opening(2.5), 0.0);
        assert_eq!(leg.opening(7.25), 0.5);
        assert_eq!(leg.opening(-7.25), -0.5);
        assert_eq!(leg.opening(12.0), 1.0);
        assert_eq!(leg.opening(-40.0), -1.0);
    }

    #[test]
    fn directions_are_those_of_the_docs() {
        let tip_after = |input| {
            let mut leg = leg();
            hold(&mut leg, input, 2.0);
            leg.observe()
        };
        let [y, z] = tip_after([8.0, 0.0]);
        assert!(y > 25.0 && z > 5.0, "pressure bends to +y and lifts: {y} {z}");
        let [y, z] = tip_after([-8.0, 0.0]);
        assert!(y < -15.0 && z > 2.0, "vacuum bends to -y and lifts: {y} {z}");
        let [y, z] = tip_after([0.0, 8.0]);
        assert!(y == 0.0 && z < -12.0, "pressure extends: {y} {z}");
        let [y, z] = tip_after([0.0, -8.0]);
        assert!(y == 0.0 && z > 7.0, "vacuum shortens: {y} {z}");
    }

    #[test]
    fn held_voltage_settles_where_flow_and_leak_balance() {
        let mut leg = leg();
        hold(&mut leg, [12.0, -12.0], 60.0);
        let [bending, extension] = leg.pressures_kpa();
        let balance = |k: f64, source: f64, p: f64| {
            let q = source - p;
            k * q / (1.0 + q.abs() / 5.0).sqrt() - p / 10.0
        };
        assert!(balance(9.0, 60.0, bending).abs() < 1e-9);
        assert!(balance(6.0, -30.0, extension).abs() < 1e-9);
        assert!((59.0..60.0).contains(&bending) && (-30.0..-29.0).contains(&extension));
        let settled = leg.observe();
        hold(&mut leg, [12.0, -12.0], 1.0);
        assert!((0..2).all(|i| (leg.observe()[i] - settled[i]).abs() < 1e-9));
    }

    #[test]
    fn comes_to_rest_without_input_and_remembers_the_load() {
        let rest_after = |volt| {
            let mut leg = leg();
            hold(&mut leg, [volt, volt], 3.0);
            hold(&mut leg, [0.0, 0.0], 300.0);
            let before = leg.observe();
            hold(&mut leg, [0.0, 0.0], 1.0);
            let after = leg.observe();
            assert!((0..2).all(|i| (after[i] - before[i]).abs() < 1e-9));
            assert!(leg.pressures_kpa().iter().all(|p| p.abs() < 1e-9));
            after
        };
        // Released pressure leaves some bend, vacuum the opposite, both below κH = 3.6 kPa.
        let share = (3.6_f64 / 40.0).tanh();
        let [from_pressure, _] = rest_after(12.0);
        let [from_vacuum, _] = rest_after(-12.0);
        assert!(from_pressure > 1.0 && from_vacuum < -1.0);
        let most = (65.0 + 20.0 * share) * 1.2 * share / 2.0;
        assert!(from_pressure.abs() < most && from_vacuum.abs() < most);
    }

    #[test]
    fn hysteresis_loop_has_the_area_of_the_model() {
        // Pressure between ±60 kPa, quasi-static. Unloading from h = H is elastic until h = 0, then
        // h tends to −H exponentially: ∮ h dp = 4 P H − 5 H² up to H² exp(1 − 2P/H).
        const P: f64 = 60.0;
        const H: f64 = 6.0;
        const STEPS: usize = 60_000;
        let mut h = 0.0;
        let mut area = 0.0;
        let dp = 2.0 * P / STEPS as f64;
        for (cycle, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)] {
            for _ in 0..STEPS {
                let [next] = Numerical::RK4.integrate([h], dp, |&[h]| [bouc_wen_rate(sign, h, H)]);
                if cycle == 1 {
                    area += sign * dp * (h + next) / 2.0;
                }
                h = next;
            }
        }
        assert!((area / (4.0 * P * H - 5.0 * H * H) - 1.0).abs() < 1e-6, "{area}");
    }

    #[test]
    fn tip_at_the_same_pressure_depends_on_the_direction() {
        // The bend at 30 kPa on the way up and on the way down from 50 kPa.
        let mut leg = leg();
        let mut bend_once = |volt: f64, beyond: fn(f64) -> bool| {
            let passed = (0..2000).any(|_| {
                leg.step(&[volt, 0.0], 0.01);
                beyond(leg.pressures_kpa()[0])
            });
            assert!(passed, "{volt} V never brings the chamber there");
            leg.observe()[0]
        };
        let up = bend_once(3.5, |p| p >= 30.0);
        bend_once(5.0, |p| p >= 50.0);
        let down = bend_once(-3.0, |p| p <= 30.0);
        assert!(down > up + 1.0, "{up} {down}");
    }

    #[test]
    fn sub_steps_of_5_ms_are_converged_to_the_sensor() {
        let end = |substeps| {
            let mut leg = leg_with(substeps);
            for input in [[7.0, -5.0], [-4.0, 12.0], [0.0, 3.0], [-12.0, -12.0]] {
                hold(&mut leg, input, 0.6);
            }
            leg.observe()
        };
        let (coarse, fine) = (end(10), end(1000));
        // A hundredth of the 0.1 mm of measurement noise.
        assert!((0..2).all(|i| (coarse[i] - fine[i]).abs() < 1e-3));
    }

    #[test]
    fn a_shut_line_supplies_nothing_and_the_leak_still_acts() {
        let mut leg = leg();
        hold(&mut leg, [12.0, -12.0], 1.0);
        let off = Surroundings { sources: [None; 2], ..Default::default() };
        let before = leg.pressures_kpa();
        (0..20).for_each(|_| leg.step_towards([1.0, -1.0], &off, 0.05));
        // One second of the leak's 10 s; RK4 is good to far below this.
        let left = libm::exp(-0.1);
        for (before, after) in before.into_iter().zip(leg.pressures_kpa()) {
            assert!((after / before - left).abs() < 1e-9, "{before} {after}");
        }
        let leaking = Surroundings { leaks: [10.0, 1.0], ..off };
        let before = leg.pressures_kpa();
        (0..20).for_each(|_| leg.step_towards([1.0, -1.0], &leaking, 0.05));
        assert!((leg.pressures_kpa()[0] / before[0] - libm::exp(-1.0)).abs() < 1e-9);
    }

    #[test]
    fn a_weak_pump_reaches_its_share() {
        let mut leg = leg();
        let weak = Surroundings { sources: [Some(0.5), Some(1.0)], ..Default::default() };
        (0..1200).for_each(|_| leg.step_towards([1.0, 0.0], &weak, 0.05));
        let [bending, _] = leg.pressures_kpa();
        assert!((29.0..30.0).contains(&bending), "{bending}");
    }

    #[test]
    fn reset_goes_back_to_idle() {
        let mut used = leg();
        hold(&mut used, [12.0, 12.0], 1.0);
        assert_ne!(used, leg());
        used.reset();
        assert_eq!(used, leg());
    }

    #[test]
    fn impossible_legs_are_refused() {
        let new = |parameters| SoftLeg::new(parameters, NonZeroU32::MIN);
        let error =
            new(SoftLegParameters { dead_band_volt: 12.0, ..Default::default() }).unwrap_err();
        assert_eq!(
            error.to_string(),
            "dead_band_volt must lie strictly between 0 and 12, not at 12"
        );
        assert!(new(SoftLegParameters { leak_s: f64::NAN, ..Default::default() }).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn tip_and_pressures_stay_in_their_bounds(
            inputs in prop::collection::vec((-12.0..=12.0, -12.0..=12.0, 1usize..40), 1..40),
        ) {
            let mut leg = leg();
            for (bend, extend, samples) in inputs {
                for _ in 0..samples {
                    leg.step(&[bend, extend], 0.05);
                    let [y, z] = leg.observe();
                    prop_assert!(y.hypot(z - 65.0) <= 85.0);
                    prop_assert!(y.abs() <= 85.0 * 0.54);
                    for p in leg.pressures_kpa() {
                        prop_assert!((-30.0..=60.0).contains(&p), "{}", p);
                    }
                    for h in [leg.state[2], leg.state[6]] {
                        prop_assert!(h.abs() <= 6.0, "{}", h);
                    }
                }
            }
        }
    }
}
