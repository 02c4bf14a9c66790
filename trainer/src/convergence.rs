//! How the estimate converges to the Koopman operator as samples and terms grow (Shi & Karydis
//! 2021, theorem 3.1), on a nonlinear map whose operator is known:
//!
//! ```text
//! x⁺ = 2 asinh(λ sinh(x/2)),  x ~ N(0, 1)
//! ```
//!
//! sinh(x/2) is an eigenfunction with the eigenvalue λ, its powers with the powers of λ; none of them is
//! a polynomial, so that no finite Hermite dictionary holds them. Under N(0, 1) the polynomials are
//! orthogonal, and every observable used here is square-integrable.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::full_operator::FullOperator;
use crate::robot::{Robot, RobotError};
use crate::trajectory::{InMemory, Trajectory};

/// λ.
pub const EIGENVALUE: f64 = 0.8;

/// Samples M, orders of the Hermite polynomials (N = order + 1 terms) and repetitions.
const SAMPLES: [usize; 7] = [30, 100, 300, 1000, 3000, 10_000, 30_000];
const ORDERS: [u8; 5] = [1, 3, 5, 7, 9];
const DRAWS: u64 = 10;
/// The integral under the Gaussian weight is a sum over this many points in ±[`REACH`]: beyond, the
/// weight is below 1e-22.
const POINTS: i32 = 2001;
const REACH: f64 = 10.0;

/// The study: rows are numbers of samples, columns numbers of terms.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Convergence {
    /// λ.
    pub eigenvalue: f64,
    /// M.
    pub samples: Vec<usize>,
    /// Independent draws of M samples; errors are root mean squares over them.
    pub draws: u64,
    /// One per dictionary.
    pub columns: Vec<Column>,
}

/// One dictionary.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Column {
    /// Terms N.
    pub terms: usize,
    /// Distance from λ to the nearest eigenvalue of the estimate, for each M; `None` where M samples
    /// do not determine it.
    pub eigenvalue_error: Vec<Option<f64>>,
    /// The error of the predicted next x under the Gaussian weight, √∫ |Ψ K B − x⁺|² w, for each M.
    pub prediction_error: Vec<Option<f64>>,
}

fn map(x: f64) -> f64 {
    2.0 * libm::asinh(EIGENVALUE * libm::sinh(x / 2.0))
}

/// One sample of N(0, 1) (Box & Muller 1958).
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    // In (0, 1]: the logarithm is finite.
    let radius = libm::sqrt(-2.0 * libm::log(1.0 - rng.random::<f64>()));
    radius * libm::cos(std::f64::consts::TAU * rng.random::<f64>())
}

/// Runs the study.
///
/// # Errors
/// [`RobotError`] does not occur: the description of the map is built in.
pub fn study(seed: u64) -> Result<Convergence, RobotError> {
    let stream = |number: u64| {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number);
        rng
    };
    let most = SAMPLES[SAMPLES.len() - 1];
    let draws: Vec<Vec<Trajectory>> = (0..DRAWS)
        .map(|draw| {
            let mut rng = stream(draw);
            let pair = |x| Trajectory { states: vec![x, map(x)], inputs: Vec::new() };
            (0..most).map(|_| pair(normal(&mut rng))).collect()
        })
        .collect();
    let mut columns = Vec::new();
    for order in ORDERS {
        let text = format!(
            "name = \"map\"\nsample_time_s = 1\nstates = [{{ name = \"x\", space = \"R\" }}]\n\
             [dictionary]\norder = {order}\nstandardise = false\n"
        );
        let robot = Robot::parse(&text, Path::new("built-in robot.toml"))?;
        let mut column =
            Column { terms: 0, eigenvalue_error: Vec::new(), prediction_error: Vec::new() };
        for samples in SAMPLES {
            let mut squares = (0.0, 0.0);
            let mut determined = true;
            for draw in &draws {
                let Some((terms, errors)) = errors(&robot, &draw[..samples]) else {
                    determined = false;
                    break;
                };
                column.terms = terms;
                squares.0 += errors.0 * errors.0;
                squares.1 += errors.1 * errors.1;
            }
            let root = |sum: f64| determined.then(|| libm::sqrt(sum / DRAWS as f64));
            column.eigenvalue_error.push(root(squares.0));
            column.prediction_error.push(root(squares.1));
        }
        columns.push(column);
    }
    Ok(Convergence { eigenvalue: EIGENVALUE, samples: SAMPLES.to_vec(), draws: DRAWS, columns })
}

/// Terms, and the errors of the eigenvalue and of the prediction, of the estimate from some pairs.
fn errors(robot: &Robot, pairs: &[Trajectory]) -> Option<(usize, (f64, f64))> {
    let source = InMemory { trajectories: pairs, states: 1, inputs: 0 };
    let full = FullOperator::fit(robot, &source, &|_| {}).ok()?;
    let spectrum = full.spectrum(&[]).ok()?;
    let distance = |(re, im): &(f64, f64)| libm::hypot(re - EIGENVALUE, *im);
    let eigenvalue = spectrum.eigenvalues().iter().map(distance).fold(f64::INFINITY, f64::min);
    let (n, m) = (full.terms(), full.columns.len());
    let k = full.held(&[]).ok()?;
    let column: Vec<f64> =
        (0..n).map(|i| (0..n).map(|j| k[i * n + j] * full.b[j * m]).sum()).collect();
    // The trapezoidal rule converges geometrically for what decays like a Gaussian.
    let step = 2.0 * REACH / f64::from(POINTS - 1);
    let weighted_square = |i: i32| {
        let x = f64::from(i) * step - REACH;
        let predicted: f64 = full.lift(&[x]).iter().zip(&column).map(|(psi, c)| psi * c).sum();
        let weight = libm::exp(-x * x / 2.0) / libm::sqrt(std::f64::consts::TAU);
        weight * step * (predicted - map(x)) * (predicted - map(x))
    };
    let integral: f64 = (0..POINTS).map(weighted_square).sum();
    Some((n, (eigenvalue, libm::sqrt(integral))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_fall_with_samples_and_terms() {
        let study = study(1).unwrap();
        assert_eq!(study.columns.iter().map(|c| c.terms).collect::<Vec<_>>(), [2, 4, 6, 8, 10]);
        let last = |values: &[Option<f64>]| values[values.len() - 1].unwrap();
        for pair in study.columns.windows(2) {
            assert!(last(&pair[1].prediction_error) < 0.7 * last(&pair[0].prediction_error));
            assert!(last(&pair[1].eigenvalue_error) < 0.7 * last(&pair[0].eigenvalue_error));
        }
        for column in &study.columns[1..] {
            let first = column.prediction_error.iter().flatten().next().unwrap();
            assert!(last(&column.prediction_error) < 0.7 * first, "{column:?}");
        }
    }

    #[test]
    fn sinh_is_an_eigenfunction_of_the_map() {
        for x in [-3.0, -0.1, 0.0, 0.7, 5.0] {
            let (after, before) = (libm::sinh(map(x) / 2.0), libm::sinh(x / 2.0));
            assert!((after - EIGENVALUE * before).abs() <= 1e-12 * before.abs());
        }
    }
}
