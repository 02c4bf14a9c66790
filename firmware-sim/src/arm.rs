//! Rigid arm of two revolute joints in a vertical plane, the paper's system (arm).
//!
//! ```text
//! θ'' = M(θ)⁻¹ (τ − c(θ, θ') − g(θ))
//!
//! M = [ m1 L1² + m2 (L1² + 2 L1 L2 cos θ2 + L2²)   m2 (L1 L2 cos θ2 + L2²) ]
//!     [ m2 (L1 L2 cos θ2 + L2²)                    m2 L2²                  ]
//! c = [ −m2 L1 L2 sin θ2 (2 θ1' θ2' + θ2'²) ]
//!     [  m2 L1 L2 θ1'² sin θ2               ]
//! g = [ (m1 + m2) L1 g cos θ1 + m2 g L2 cos(θ1 + θ2) ]
//!     [ m2 g L2 cos(θ1 + θ2)                         ]
//! ```
//!
//! Point masses at the ends of weightless links. θ1 is measured from the horizontal,
//! counter-clockwise, θ2 from the first link; both are unwrapped. State and outputs: θ1, θ2 (rad),
//! θ1', θ2' (rad/s). Inputs: the joint torques τ1, τ2 (N m). No friction.
//!
//! M is inverted in closed form with det M = m2 L1² L2² (m1 + m2 sin² θ2), a sum of positive terms
//! where the textbook's difference of products would cancel.

use crate::integrate::Numerical;
use crate::plant::{Plant, Variable};
use nalgebra::{Matrix2, Vector2};

/// What fixes an arm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmParameters {
    /// Masses m1, m2 at the ends of the links (kg).
    pub mass_kg: [f64; 2],
    /// Lengths L1, L2 of the links (m).
    pub length_m: [f64; 2],
    /// Gravitational acceleration g, pointing to θ1 = −π/2 (m/s²); 0 for an arm that lies flat.
    pub gravity_mps2: f64,
}

impl Default for ArmParameters {
    /// m1 = m2 = 0.1 kg, L1 = L2 = 1 m, g = 9.8 m/s².
    fn default() -> Self {
        Self { mass_kg: [0.1; 2], length_m: [1.0; 2], gravity_mps2: 9.8 }
    }
}

/// Why an [`Arm`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ArmError {
    /// A mass or a length is not a finite number above zero.
    #[error("{field} must be finite and above 0, not {value}")]
    NotPositive {
        /// The parameter's name.
        field: &'static str,
        /// What was given.
        value: f64,
    },
    /// Gravity is not finite.
    #[error("gravity_mps2 must be finite, not {value}")]
    GravityNotFinite {
        /// What was given.
        value: f64,
    },
}

/// An arm that starts stretched out horizontally, θ = 0, at rest.
///
/// ```
/// use firmware_sim::{Plant, arm::Arm, integrate::Numerical};
///
/// // Let go from the horizontal, the second joint lags behind: θ1'' = −g/L1, θ2'' = g/L1.
/// let mut arm = Arm::new(Default::default(), Numerical::RK4)?;
/// arm.step(&[0.0, 0.0], 1e-3);
/// let [theta1, theta2, dtheta1, dtheta2] = arm.observe();
/// assert!((theta1 + 9.8 / 2.0 * 1e-6).abs() < 1e-12);
/// assert!((theta2 - 9.8 / 2.0 * 1e-6).abs() < 1e-12);
/// assert!((dtheta1 + 9.8e-3).abs() < 1e-9);
/// assert!((dtheta2 - 9.8e-3).abs() < 1e-9);
/// # Ok::<(), firmware_sim::arm::ArmError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Arm {
    parameters: ArmParameters,
    method: Numerical,
    /// θ1, θ2 (rad), θ1', θ2' (rad/s).
    state: [f64; 4],
}

impl Arm {
    /// An arm at rest at θ = 0.
    ///
    /// # Errors
    ///
    /// If a mass or a length is not a finite number above zero, or gravity is not finite.
    pub fn new(parameters: ArmParameters, method: Numerical) -> Result<Self, ArmError> {
        let ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], gravity_mps2 } = parameters;
        for (field, value) in
            [("mass_kg[0]", m1), ("mass_kg[1]", m2), ("length_m[0]", l1), ("length_m[1]", l2)]
        {
            if !(value.is_finite() && value > 0.0) {
                return Err(ArmError::NotPositive { field, value });
            }
        }
        if !gravity_mps2.is_finite() {
            return Err(ArmError::GravityNotFinite { value: gravity_mps2 });
        }
        Ok(Self { parameters, method, state: [0.0; 4] })
    }

    /// Puts the arm at θ1, θ2 (rad), θ1', θ2' (rad/s).
    pub fn set_state(&mut self, state: [f64; 4]) {
        self.state = state;
    }

    /// Kinetic plus potential energy (J), 0 at rest at θ = 0.
    ///
    /// ½ θ'ᵀ M θ' + (m1 + m2) g L1 sin θ1 + m2 g L2 sin(θ1 + θ2). Without torque it is conserved; a
    /// torque held from one instant to another adds τ · Δθ to it.
    ///
    /// ```
    /// use firmware_sim::{arm::Arm, integrate::Numerical};
    /// let mut arm = Arm::new(Default::default(), Numerical::RK4)?;
    /// arm.set_state([std::f64::consts::FRAC_PI_2, 0.0, 0.0, 0.0]);
    /// assert!((arm.energy_joule() - 0.1 * 9.8 * (1.0 + 2.0)).abs() < 1e-15);
    /// # Ok::<(), firmware_sim::arm::ArmError>(())
    /// ```
    pub fn energy_joule(&self) -> f64 {
        let ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], gravity_mps2: g } =
            self.parameters;
        let [theta1, theta2, dtheta1, dtheta2] = self.state;
        let velocity = Vector2::new(dtheta1, dtheta2);
        velocity.dot(&(self.mass_matrix(theta2) * velocity)) / 2.0
            + (m1 + m2) * g * l1 * libm::sin(theta1)
            + m2 * g * l2 * libm::sin(theta1 + theta2)
    }

    /// M(θ) (kg m²).
    fn mass_matrix(&self, theta2: f64) -> Matrix2<f64> {
        let ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], .. } = self.parameters;
        let cos2 = libm::cos(theta2);
        let coupling = m2 * (l1 * l2 * cos2 + l2 * l2);
        Matrix2::new(
            m1 * l1 * l1 + m2 * (l1 * l1 + 2.0 * l1 * l2 * cos2 + l2 * l2),
            coupling,
            coupling,
            m2 * l2 * l2,
        )
    }

    /// x' = f(x, τ) for x = (θ1, θ2, θ1', θ2').
    fn rate(&self, &[theta1, theta2, dtheta1, dtheta2]: &[f64; 4], torque: &[f64; 2]) -> [f64; 4] {
        let ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], gravity_mps2: g } =
            self.parameters;
        let sin2 = libm::sin(theta2);
        let coriolis = m2
            * l1
            * l2
            * sin2
            * Vector2::new(-(2.0 * dtheta1 * dtheta2 + dtheta2 * dtheta2), dtheta1 * dtheta1);
        let outer_weight = m2 * g * l2 * libm::cos(theta1 + theta2);
        let gravity =
            Vector2::new((m1 + m2) * l1 * g * libm::cos(theta1) + outer_weight, outer_weight);
        let force = Vector2::from(*torque) - coriolis - gravity;
        let m = self.mass_matrix(theta2);
        let adjugate = Matrix2::new(m.m22, -m.m12, -m.m21, m.m11);
        let determinant = m2 * (l1 * l1) * (l2 * l2) * (m1 + m2 * sin2 * sin2);
        let acceleration = adjugate * force / determinant;
        [dtheta1, dtheta2, acceleration.x, acceleration.y]
    }
}

impl Plant<4, 2> for Arm {
    fn outputs(&self) -> [Variable; 4] {
        [("theta1", "rad"), ("theta2", "rad"), ("dtheta1", "radps"), ("dtheta2", "radps")]
            .map(|(name, unit)| Variable { name, unit })
    }

    fn inputs(&self) -> [Variable; 2] {
        ["tau1", "tau2"].map(|name| Variable { name, unit: "Nm" })
    }

    fn reset(&mut self) {
        self.state = [0.0; 4];
    }

    fn step(&mut self, input: &[f64; 2], dt_s: f64) {
        let rate = |state: &[f64; 4]| self.rate(state, input);
        self.state = self.method.integrate(self.state, dt_s, rate);
    }

    fn observe(&self) -> [f64; 4] {
        self.state
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, SQRT_2, TAU};

    fn arm(method: Numerical) -> Arm {
        Arm::new(ArmParameters::default(), method).unwrap()
    }

    fn rk4(substeps: u32) -> Numerical {
        Numerical::Rk4 { substeps: substeps.try_into().unwrap() }
    }

    fn distance(a: [f64; 4], b: [f64; 4]) -> f64 {
        (0..4).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn hangs_still() {
        let mut arm = arm(Numerical::RK4);
        arm.set_state([-FRAC_PI_2, 0.0, 0.0, 0.0]);
        arm.step(&[0.0, 0.0], 1.0);
        assert!(distance(arm.observe(), [-FRAC_PI_2, 0.0, 0.0, 0.0]) < 1e-14);
    }

    #[test]
    fn small_oscillations_have_the_periods_of_the_double_pendulum() {
        // Equal masses and lengths: ω² = (g/L)(2 ∓ √2), the absolute angles in the ratio ±√2.
        for sign in [1.0, -1.0] {
            let amplitude = 1e-5;
            let start = [-FRAC_PI_2 + amplitude, (sign * SQRT_2 - 1.0) * amplitude, 0.0, 0.0];
            let period = TAU / libm::sqrt(9.8 * (2.0 - sign * SQRT_2));
            let mut arm = arm(rk4(400));
            arm.set_state(start);
            arm.step(&[0.0, 0.0], period / 2.0);
            let mirrored = [-FRAC_PI_2 - amplitude, -(sign * SQRT_2 - 1.0) * amplitude, 0.0, 0.0];
            // The next term of the expansion is of the order of the amplitude cubed.
            assert!(distance(arm.observe(), mirrored) < 1e-12);
            arm.step(&[0.0, 0.0], period / 2.0);
            assert!(distance(arm.observe(), start) < 1e-12);
        }
    }

    #[test]
    fn energy_is_conserved_to_the_fourth_order() {
        // The largest drift over a 2 s trial of 0.1 s stretches.
        let drift = |substeps: u32| {
            let mut arm = arm(rk4(substeps));
            (0..20)
                .map(|_| {
                    arm.step(&[0.0, 0.0], 0.1);
                    arm.energy_joule().abs()
                })
                .fold(0.0, f64::max)
        };
        // The logs' own step of 1 ms.
        assert!(drift(100) < 1e-9, "{}", drift(100));
        let order = libm::log2(drift(20) / drift(40));
        assert!(order > 3.8, "{order}");
    }

    #[test]
    fn rk4_converges_with_order_four() {
        let end = |substeps: u32| {
            let mut arm = arm(rk4(substeps));
            arm.step(&[0.3, -0.2], 1.0);
            arm.observe()
        };
        let truth = end(20_000);
        let order = libm::log2(distance(end(200), truth) / distance(end(400), truth));
        assert!((order - 4.0).abs() < 0.2, "{order}");
    }

    #[test]
    fn one_euler_step_moves_the_angles_by_the_old_velocities() {
        let mut arm = arm(Numerical::EULER);
        arm.set_state([0.1, 0.2, 3.0, -4.0]);
        arm.step(&[0.0, 0.0], 0.01);
        let [theta1, theta2, ..] = arm.observe();
        assert_eq!([theta1, theta2], [0.1 + 0.01 * 3.0, 0.2 - 0.01 * 4.0]);
    }

    #[test]
    fn impossible_arms_are_refused() {
        let massless = ArmParameters { mass_kg: [0.1, 0.0], ..Default::default() };
        assert_eq!(
            Arm::new(massless, Numerical::RK4).unwrap_err(),
            ArmError::NotPositive { field: "mass_kg[1]", value: 0.0 }
        );
        let weight = ArmParameters { gravity_mps2: f64::INFINITY, ..Default::default() };
        assert!(Arm::new(weight, Numerical::RK4).is_err());
    }

    proptest! {
        #[test]
        fn acceleration_solves_the_papers_equation(
            theta1 in -4.0..4.0, theta2 in -4.0..4.0, w1 in -9.0..9.0, w2 in -9.0..9.0,
            tau1 in -3.0..3.0, tau2 in -3.0..3.0,
            m1 in 0.05..2.0, m2 in 0.05..2.0, l1 in 0.2..2.0, l2 in 0.2..2.0,
        ) {
            let parameters = ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], gravity_mps2: 9.8 };
            let arm = Arm::new(parameters, Numerical::RK4).unwrap();
            let [_, _, a1, a2] = arm.rate(&[theta1, theta2, w1, w2], &[tau1, tau2]);
            let (s2, c2) = (libm::sin(theta2), libm::cos(theta2));
            let m11 = m1 * l1 * l1 + m2 * (l1 * l1 + 2.0 * l1 * l2 * c2 + l2 * l2);
            let m12 = m2 * (l1 * l2 * c2 + l2 * l2);
            let m22 = m2 * l2 * l2;
            let g2 = m2 * 9.8 * l2 * libm::cos(theta1 + theta2);
            let g1 = (m1 + m2) * l1 * 9.8 * libm::cos(theta1) + g2;
            let c1 = -m2 * l1 * l2 * s2 * (2.0 * w1 * w2 + w2 * w2);
            let c2 = m2 * l1 * l2 * w1 * w1 * s2;
            let scale = 1.0 + m11 * a1.abs() + m12.abs() * (a1.abs() + a2.abs()) + m22 * a2.abs();
            prop_assert!((m11 * a1 + m12 * a2 + c1 + g1 - tau1).abs() < 1e-11 * scale);
            prop_assert!((m12 * a1 + m22 * a2 + c2 + g2 - tau2).abs() < 1e-11 * scale);
        }

        #[test]
        fn torque_adds_its_work_to_the_energy(
            theta1 in -4.0..4.0, theta2 in -4.0..4.0, w1 in -3.0..3.0, w2 in -3.0..3.0,
            tau1 in -1.0..1.0, tau2 in -1.0..1.0,
        ) {
            let mut arm = arm(rk4(1000));
            arm.set_state([theta1, theta2, w1, w2]);
            let energy = arm.energy_joule();
            arm.step(&[tau1, tau2], 0.5);
            let [end1, end2, ..] = arm.observe();
            let work = tau1 * (end1 - theta1) + tau2 * (end2 - theta2);
            prop_assert!((arm.energy_joule() - energy - work).abs() < 1e-8);
        }
    }
}
