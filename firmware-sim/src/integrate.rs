//! Integration of x' = f(x) over a held input.

use std::fmt;
use std::num::NonZeroU32;
use std::str::FromStr;

/// How a plant advances over a held input.
///
/// Written and read as `exact`, `rk4`, `rk4:N`, `euler` and `euler:N`, with N equal sub-steps per
/// step; `rk4` alone means 10 sub-steps, `euler` alone one (as in the paper).
///
/// ```
/// use firmware_sim::Integrator;
/// assert_eq!("rk4".parse::<Integrator>()?.to_string(), "rk4:10");
/// assert_eq!("euler".parse::<Integrator>()?.to_string(), "euler:1");
/// assert_eq!(
///     "heun".parse::<Integrator>().unwrap_err().to_string(),
///     "unknown integrator `heun`: expected exact, rk4, rk4:N, euler or euler:N with N from 1",
/// );
/// # Ok::<(), firmware_sim::integrate::ParseIntegratorError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Integrator {
    /// The closed solution, where the plant has one.
    Exact,
    /// Step by step, for any plant.
    Numerical(Numerical),
}

/// A method for any x' = f(x).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Numerical {
    /// The classical Runge-Kutta method of order 4.
    Rk4 {
        /// Equal sub-steps per step.
        substeps: NonZeroU32,
    },
    /// The explicit Euler method.
    Euler {
        /// Equal sub-steps per step.
        substeps: NonZeroU32,
    },
}

impl Numerical {
    /// RK4 with the 10 sub-steps that `rk4` alone means.
    pub const RK4: Self = Self::Rk4 { substeps: NonZeroU32::new(10).unwrap() };
    /// One Euler step per sample, as in the paper.
    pub const EULER: Self = Self::Euler { substeps: NonZeroU32::MIN };

    /// The state `dt` after `x`, for x' = `rate`(x) with the held input inside it.
    ///
    /// ```
    /// use firmware_sim::integrate::Numerical;
    /// // x' = -x over one unit of time.
    /// let [x] = Numerical::EULER.integrate([1.0], 1.0, |&[x]| [-x]);
    /// assert_eq!(x, 0.0);
    /// let [x] = Numerical::RK4.integrate([1.0], 1.0, |&[x]| [-x]);
    /// assert!((x - (-1.0_f64).exp()).abs() < 4e-7);
    /// ```
    pub fn integrate<const N: usize>(
        self,
        x: [f64; N],
        dt: f64,
        rate: impl Fn(&[f64; N]) -> [f64; N],
    ) -> [f64; N] {
        match self {
            Self::Rk4 { substeps } => rk4(x, dt, substeps, rate),
            Self::Euler { substeps } => euler(x, dt, substeps, rate),
        }
    }
}

impl fmt::Display for Integrator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exact => write!(f, "exact"),
            Self::Numerical(Numerical::Rk4 { substeps }) => write!(f, "rk4:{substeps}"),
            Self::Numerical(Numerical::Euler { substeps }) => write!(f, "euler:{substeps}"),
        }
    }
}

/// The text names no integrator.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown integrator `{text}`: expected exact, rk4, rk4:N, euler or euler:N with N from 1")]
pub struct ParseIntegratorError {
    /// What was given.
    pub text: String,
}

impl FromStr for Integrator {
    type Err = ParseIntegratorError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let parsed = match text.split_once(':') {
            None => match text {
                "exact" => Some(Self::Exact),
                "rk4" => Some(Self::Numerical(Numerical::RK4)),
                "euler" => Some(Self::Numerical(Numerical::EULER)),
                _ => None,
            },
            Some((method, count)) => match (method, count.parse()) {
                ("rk4", Ok(substeps)) => Some(Self::Numerical(Numerical::Rk4 { substeps })),
                ("euler", Ok(substeps)) => Some(Self::Numerical(Numerical::Euler { substeps })),
                _ => None,
            },
        };
        parsed.ok_or_else(|| ParseIntegratorError { text: text.into() })
    }
}

fn rk4<const N: usize>(
    mut x: [f64; N],
    dt: f64,
    substeps: NonZeroU32,
    rate: impl Fn(&[f64; N]) -> [f64; N],
) -> [f64; N] {
    let h = dt / f64::from(substeps.get());
    for _ in 0..substeps.get() {
        let k1 = rate(&x);
        let k2 = rate(&along(&x, h / 2.0, &k1));
        let k3 = rate(&along(&x, h / 2.0, &k2));
        let k4 = rate(&along(&x, h, &k3));
        for i in 0..N {
            x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
        }
    }
    x
}

fn euler<const N: usize>(
    mut x: [f64; N],
    dt: f64,
    substeps: NonZeroU32,
    rate: impl Fn(&[f64; N]) -> [f64; N],
) -> [f64; N] {
    let h = dt / f64::from(substeps.get());
    for _ in 0..substeps.get() {
        x = along(&x, h, &rate(&x));
    }
    x
}

fn along<const N: usize>(x: &[f64; N], h: f64, rate: &[f64; N]) -> [f64; N] {
    std::array::from_fn(|i| x[i] + h * rate[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(n: u32) -> NonZeroU32 {
        NonZeroU32::new(n).unwrap()
    }

    #[test]
    fn rk4_integrates_a_cubic_in_time_exactly() {
        // x' = 4 t³ as an autonomous system: RK4 reduces to Simpson's rule, exact here.
        let [t, x] = rk4([0.0, 1.0], 2.0, count(1), |&[t, _]| [1.0, 4.0 * t * t * t]);
        assert_eq!([t, x], [2.0, 17.0]);
    }

    #[test]
    fn errors_fall_with_the_order_of_the_method() {
        let exact = libm::exp(-1.0);
        let rk4_error = |n| (rk4([1.0], 1.0, count(n), |&[x]| [-x])[0] - exact).abs();
        let euler_error = |n| (euler([1.0], 1.0, count(n), |&[x]| [-x])[0] - exact).abs();
        let order = |coarse: f64, fine: f64| libm::log2(coarse / fine);
        assert!((order(rk4_error(20), rk4_error(40)) - 4.0).abs() < 0.05);
        assert!((order(euler_error(200), euler_error(400)) - 1.0).abs() < 0.05);
    }

    #[test]
    fn integrators_are_read_back_as_written() {
        for text in ["exact", "rk4:1", "rk4:10", "rk4:4294967295", "euler:7"] {
            assert_eq!(text.parse::<Integrator>().unwrap().to_string(), text);
        }
        for text in ["", "RK4", "rk4:", "rk4:0", "rk4:-1", "exact:2", "euler:1.5"] {
            assert!(text.parse::<Integrator>().is_err(), "{text}");
        }
    }
}
