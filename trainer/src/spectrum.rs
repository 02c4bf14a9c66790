//! Koopman eigenvalues, eigenfunctions and modes of an operator, and the eigenvalues of a model's
//! linearised one-step map.
//!
//! An operator K acts on row vectors, Ψ(x⁺) = Ψ(x) K. With K ξₙ = λₙ ξₙ, wₙ* K = λₙ wₙ* and
//! wₙ* ξₙ = 1 the eigenfunctions are φₙ(x) = Ψ(x) ξₙ, the modes of observables g = Ψ B are
//! vₙ = (wₙ* B)ᵀ, and g(x⁺) = Σ vₙ λₙ φₙ(x) = Ψ(x) K B (Williams, Kevrekidis & Rowley 2015; Shi &
//! Karydis 2021, equations 1 and 4). Complex numbers are pairs (real, imaginary).

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, c64};
use firmware_core::model::{Model, ModelError};
use firmware_core::{Predictor, PredictorState};

/// An eigenvalue with a larger [condition](Decomposition::conditions) is reported as defective or
/// nearly so. Rounding in K moves such an eigenvalue by more than 1e6 ε = 2e-10 of K, and that times
/// a few is the error of a reconstruction: below this limit it stays under 1e-9. A double eigenvalue
/// with a single eigenvector shows as 1/√ε = 7e7, a triple one as 3e10.
pub const DEFECTIVE: f64 = 1e6;

/// Eigenvalues in question whose distance is below this fraction of the spectral radius are one
/// cluster: rounding spreads an m-fold defective eigenvalue by ε^(1/m), 1e-2 for m = 8.
const CLUSTER: f64 = 1e-2;
/// Among these, the distance may be this many times what rounding moves the eigenvalues by.
const SPREAD: f64 = 1e4;
/// A cluster of m eigenvalues around λ has m eigenvectors, whatever their computed directions say,
/// when K − λ I has m singular values up to this fraction of ‖K‖: rounding and the noise of a fit
/// to exact data, and far below the 1e-9 that a reconstruction is held to.
const SEMISIMPLE: f64 = 1e-11;
/// Eigenvalues no further apart than this fraction of ‖K‖ may be one in that sense.
const EQUAL: f64 = 10.0 * SEMISIMPLE;
/// Moduli and angles that differ by less than this are equal when eigenvalues are put in order.
const SAME: f64 = 1e-9;

/// Why a matrix has no decomposition.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SpectrumError {
    /// The matrix does not have as many rows and columns as there are scales, or there are none.
    #[error("expected a matrix of {expected} entries and at least one, found {found}")]
    Dimension {
        /// Scales, squared.
        expected: usize,
        /// Entries of the matrix.
        found: usize,
    },
    /// An entry, with terms measured in their own sizes, is not finite or its square is not, or a
    /// scale is not positive.
    #[error(
        "the operator has entries that are too large: its terms differ too much in size, or the \
         inputs are far beyond the data"
    )]
    NotFinite,
    /// The QR iteration did not end.
    #[error("the eigenvalues of the operator were not found: the iteration does not converge")]
    NoConvergence,
}

/// Eigenvalues that do not have an eigenvector each, to within rounding.
#[derive(Clone, Debug, PartialEq)]
pub struct Defect {
    /// Indices of the eigenvalues.
    pub eigenvalues: Vec<usize>,
    /// The largest condition among them.
    pub condition: f64,
}

/// The eigenvalues of an operator with their right and left eigenvectors.
///
/// Eigenvalues are in order of falling modulus, then of rising frequency |arg λ|; of a conjugate
/// pair, the one with the positive imaginary part comes first and the other one next. Right
/// eigenvectors have unit norm in terms of their own size (Σ |ξᵢ sᵢ|² = 1 with the scales sᵢ), and
/// their largest entry, so measured, is real and positive.
///
/// ```
/// use trainer::spectrum::Decomposition;
/// // x1⁺ = 0.5 x1, x2⁺ = 0.8 x2 + 0.1 x1: K = [[0.5, 0.1], [0, 0.8]] for Ψ = [x1, x2].
/// let spectrum = Decomposition::new(&[0.5, 0.1, 0.0, 0.8], &[1.0, 1.0]).unwrap();
/// assert_eq!(spectrum.eigenvalues(), [(0.8, 0.0), (0.5, 0.0)]);
/// // φ₁ is along x1 + 3 x2, φ₂ along x1.
/// let phi = spectrum.eigenfunctions(&[3.0, -1.0]);
/// assert!(phi[0].0.abs() < 1e-15 && (phi[1].0 - 3.0).abs() < 1e-15);
/// let identity = [1.0, 0.0, 0.0, 1.0];
/// assert!(spectrum.reconstruction_residual(&identity) < 1e-15 && spectrum.defects().is_empty());
/// ```
#[derive(Clone, Debug)]
pub struct Decomposition {
    /// D K D⁻¹ with the scales D: terms divided by their sizes.
    matrix: Mat<f64>,
    scale: Vec<f64>,
    eigenvalues: Vec<(f64, f64)>,
    basis: Basis,
}

impl Decomposition {
    /// Decomposes K, shape `[n, n]`, row-major.
    ///
    /// `scale`, shape `[n]`, holds the sizes of the terms, best their root mean squares over the
    /// data: the decomposition is that of the operator on terms divided by them, in which its
    /// rounding errors and conditions mean something, and is brought back.
    ///
    /// # Errors
    /// [`SpectrumError`].
    pub fn new(matrix: &[f64], scale: &[f64]) -> Result<Self, SpectrumError> {
        let n = scale.len();
        if n == 0 || matrix.len() != n * n {
            return Err(SpectrumError::Dimension { expected: n * n, found: matrix.len() });
        }
        let scaled = Mat::from_fn(n, n, |i, j| matrix[i * n + j] * (scale[i] / scale[j]));
        let usable = scale.iter().all(|s| s.is_finite() && *s > 0.0);
        if !usable || !scaled.squared_norm_l2().is_finite() {
            return Err(SpectrumError::NotFinite);
        }
        faer::set_global_parallelism(faer::Par::Seq);
        let eigen = scaled.eigen().map_err(|_| SpectrumError::NoConvergence)?;
        let values: Vec<c64> = eigen.S().column_vector().iter().copied().collect();
        let mut units = Vec::with_capacity(n);
        // The other one of a pair is its conjugate, exactly.
        for (j, value) in values.iter().enumerate().filter(|(_, value)| value.im >= 0.0) {
            // A zero without a sign, or the angle of a negative number is −π.
            let value = c64::new(value.re, value.im.abs());
            let mut vector: Vec<c64> = eigen.U().col(j).iter().copied().collect();
            // The substitution that faer 0.24 finds them by overflows for long Jordan blocks.
            if !vector.iter().all(|z| z.re.is_finite() && z.im.is_finite()) {
                vector = null_vectors(&scaled, value, 0.0)?.pop().unwrap_or_default();
            }
            units.push(Unit { value, vector });
        }
        let mut units = in_order(units)?;
        let mut basis = Basis::new(&units, n)?;
        if let Some(mended) = mend(&scaled, &units, &basis)? {
            let better = Basis::new(&mended, n)?;
            let gains = better.worst() < basis.worst() || !exact(&scaled, &units);
            if gains && exact(&scaled, &mended) {
                (units, basis) = (mended, better);
            }
        }
        if !exact(&scaled, &units) {
            return Err(SpectrumError::NoConvergence);
        }
        let eigenvalues = units.iter().flat_map(Unit::values).map(|z| (z.re, z.im)).collect();
        Ok(Self { matrix: scaled, scale: scale.to_vec(), eigenvalues, basis })
    }

    /// λ, shape `[n]`.
    pub fn eigenvalues(&self) -> &[(f64, f64)] {
        &self.eigenvalues
    }

    /// The largest modulus.
    pub fn radius(&self) -> f64 {
        radius(&self.eigenvalues).unwrap_or(0.0)
    }

    /// The right eigenvectors ξ, shape `[n, n]`: row k is ξₖ over the terms.
    pub fn right(&self) -> Vec<Vec<(f64, f64)>> {
        let entry = |i: usize, k: usize| self.basis.right[(i, k)] / self.scale[i];
        self.complex(|k| (0..self.scale.len()).map(|i| entry(i, k)).collect(), 1.0)
    }

    /// The left eigenvectors as rows w*, shape `[n, n]`: row k is wₖ* over the terms, with
    /// wₖ* ξₖ = 1.
    pub fn left(&self) -> Vec<Vec<(f64, f64)>> {
        let entry = |k: usize, i: usize| self.basis.left[(k, i)] * self.scale[i];
        self.complex(|k| (0..self.scale.len()).map(|i| entry(k, i)).collect(), -1.0)
    }

    /// φ(x) = Ψ(x) ξ, shape `[n]`, for the terms Ψ(x), shape `[n]`.
    pub fn eigenfunctions(&self, lifted: &[f64]) -> Vec<(f64, f64)> {
        let scaled: Vec<f64> = lifted.iter().zip(&self.scale).map(|(x, s)| x / s).collect();
        let column = |k: usize| self.basis.right.col(k).iter().zip(&scaled);
        let values = |k: usize| vec![column(k).map(|(r, x)| r * x).sum()];
        self.complex(values, 1.0).into_iter().map(|v| v[0]).collect()
    }

    /// The Koopman modes v = (w* B)ᵀ of the observables Ψ B, shape `[n, m]`, for B of shape
    /// `[n, m]`, row-major.
    pub fn modes(&self, b: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let modes = &self.basis.left * &self.weights(b);
        self.complex(|k| modes.row(k).iter().copied().collect(), -1.0)
    }

    /// Σ ξ λ w* B, shape `[n, m]`, row-major, which is K B unless K is defective: the next
    /// observables are Ψ times it (equation 1).
    pub fn reconstruct(&self, b: &[f64]) -> Vec<f64> {
        let sum = self.sum(&self.weights(b));
        let rows = sum.row_iter().zip(&self.scale);
        rows.flat_map(|(row, s)| row.iter().map(move |x| x / s)).collect()
    }

    /// ‖Σ ξ λ w* B − K B‖ / ‖K B‖ of the observable (column of B) for which it is largest, with
    /// terms measured in their own sizes. A column with K B = 0 is compared with B.
    pub fn reconstruction_residual(&self, b: &[f64]) -> f64 {
        let b = self.weights(b);
        let (sum, exact) = (self.sum(&b), &self.matrix * &b);
        let columns = (0..b.ncols()).map(|j| {
            let size = [exact.col(j).norm_l2(), b.col(j).norm_l2()].into_iter().find(|s| *s > 0.0);
            (sum.col(j) - exact.col(j)).norm_l2() / size.unwrap_or(1.0)
        });
        columns.fold(0.0, largest)
    }

    /// The largest |K ξ − λ ξ| and |w* K − λ w*| over all entries, terms measured in their own
    /// sizes; w* is divided by its norm.
    pub fn eigenvector_residuals(&self) -> (f64, f64) {
        let Basis { right, left, conditions, .. } = &self.basis;
        let blocks = self.blocks();
        let right = &self.matrix * right - right * &blocks;
        let left = left * &self.matrix - blocks * left;
        let columns = self.complex(|k| right.col(k).iter().copied().collect(), 1.0);
        let rows = self.complex(|k| left.row(k).iter().copied().collect(), -1.0);
        let modulus = |z: &(f64, f64)| libm::hypot(z.0, z.1);
        let worst = |v: &Vec<(f64, f64)>| v.iter().map(modulus).fold(0.0, largest);
        let rows = rows.iter().zip(conditions).map(|(row, norm)| worst(row) / norm);
        (columns.iter().map(worst).fold(0.0, largest), rows.fold(0.0, largest))
    }

    /// The condition of every eigenvalue, 1/|w* ξ| for w and ξ of unit norm (terms in their own
    /// sizes), shape `[n]`: a change of K by δ moves the eigenvalue by up to this times δ.
    pub fn conditions(&self) -> &[f64] {
        &self.basis.conditions
    }

    /// Condition of the matrix of the right eigenvectors: largest over smallest singular value.
    pub fn condition(&self) -> f64 {
        self.basis.condition
    }

    /// How far rounding in K may have moved an eigenvalue.
    pub fn uncertainty(&self, eigenvalue: usize) -> f64 {
        8.0 * f64::EPSILON * self.matrix.norm_l2() * self.basis.conditions[eigenvalue]
    }

    /// The eigenvalues whose condition is beyond [`DEFECTIVE`], near ones together. They have fewer
    /// eigenvectors than their number, or nearly: their eigenfunctions and modes are large, cancel
    /// each other, and mean nothing one by one.
    pub fn defects(&self) -> Vec<Defect> {
        let condition = |i: usize| self.basis.conditions[i];
        let values: Vec<c64> = self.eigenvalues.iter().map(|(re, im)| c64::new(*re, *im)).collect();
        let defect = |eigenvalues: Vec<usize>| Defect {
            condition: eigenvalues.iter().map(|i| condition(*i)).fold(0.0, largest),
            eigenvalues,
        };
        let (radius, norm) = (self.radius(), self.matrix.norm_l2());
        let in_question = (0..values.len()).filter(|i| condition(*i) > DEFECTIVE).collect();
        let near = |a: usize, b: usize| {
            let moved = SPREAD * f64::EPSILON * norm * condition(a).max(condition(b));
            distance(values[a], values[b]) <= moved.min(CLUSTER * radius)
        };
        clusters(in_question, near).into_iter().map(defect).collect()
    }

    /// B in terms of the terms' sizes, shape `[n, m]`.
    fn weights(&self, b: &[f64]) -> Mat<f64> {
        let m = b.len() / self.scale.len();
        Mat::from_fn(self.scale.len(), m, |i, j| b[i * m + j] * self.scale[i])
    }

    /// Σ ξ λ w* B for a B that [`weights`](Self::weights) has made.
    fn sum(&self, b: &Mat<f64>) -> Mat<f64> {
        &self.basis.right * (self.blocks() * (&self.basis.left * b))
    }

    /// Λ in real form: K [Re ξ, Im ξ] = [Re ξ, Im ξ] [[a, b], [−b, a]] for λ = a + i b.
    fn blocks(&self) -> Mat<f64> {
        Mat::from_fn(self.scale.len(), self.scale.len(), |i, k| {
            let (a, b) = self.eigenvalues[i];
            let partner = if b > 0.0 { i.checked_add(1) } else { i.checked_sub(1) };
            if i == k {
                a
            } else if b != 0.0 && partner == Some(k) {
                b
            } else {
                0.0
            }
        })
    }

    /// Complex vectors from their real form: parts √2 Re z and √2 Im z · `sign` in the places of a
    /// pair.
    fn complex(&self, part: impl Fn(usize) -> Vec<f64>, sign: f64) -> Vec<Vec<(f64, f64)>> {
        let join = |(k, (_, im)): (usize, &(f64, f64))| -> Vec<(f64, f64)> {
            if *im == 0.0 {
                return part(k).into_iter().map(|re| (re, 0.0)).collect();
            }
            let first = if *im > 0.0 { k } else { k - 1 };
            let (root, sign) = (0.5_f64.sqrt(), sign.copysign(sign * im));
            part(first)
                .iter()
                .zip(part(first + 1))
                .map(|(a, b)| (a * root, sign * b * root))
                .collect()
        };
        self.eigenvalues.iter().enumerate().map(join).collect()
    }
}

fn largest(max: f64, x: f64) -> f64 {
    // NaN counts as the worst.
    if x <= max { max } else { x }
}

/// A real eigenvalue with its eigenvector, or one of a conjugate pair, imaginary part positive.
#[derive(Clone, Debug)]
struct Unit {
    value: c64,
    vector: Vec<c64>,
}

impl Unit {
    /// The eigenvalue, and its conjugate.
    fn values(&self) -> impl Iterator<Item = c64> {
        let conjugate = (self.value.im > 0.0).then(|| self.value.conj());
        [self.value].into_iter().chain(conjugate)
    }

    /// Unit norm, the largest entry (the first of those that are as large) real and positive.
    fn normalise(&mut self) -> Result<(), SpectrumError> {
        let moduli: Vec<f64> = self.vector.iter().map(|z| libm::hypot(z.re, z.im)).collect();
        let max = moduli.iter().copied().fold(0.0, largest);
        let norm = max * moduli.iter().map(|m| (m / max) * (m / max)).sum::<f64>().sqrt();
        let pivot = moduli.iter().position(|m| *m >= (1.0 - SAME) * max);
        let (Some(pivot), true) = (pivot, norm.is_finite() && max > 0.0) else {
            return Err(SpectrumError::NoConvergence);
        };
        let turn = c64::new(
            self.vector[pivot].re / moduli[pivot] / norm,
            -self.vector[pivot].im / moduli[pivot] / norm,
        );
        for z in &mut self.vector {
            *z *= turn;
        }
        self.vector[pivot].im = 0.0;
        Ok(())
    }
}

/// Falling modulus, then rising frequency; eigenvalues that are equal but for rounding by their
/// largest terms.
fn in_order(mut units: Vec<Unit>) -> Result<Vec<Unit>, SpectrumError> {
    for unit in &mut units {
        unit.normalise()?;
    }
    let modulus = |u: &Unit| libm::hypot(u.value.re, u.value.im);
    let radius = units.iter().map(modulus).fold(0.0, largest);
    let steps = |x: f64, unit: f64| if unit > 0.0 { (x / unit / SAME).round() } else { 0.0 };
    let key = |u: &Unit| {
        let angle = libm::atan2(u.value.im, u.value.re);
        let pivot = u.vector.iter().enumerate().fold((0, 0.0), |(p, max), (i, z)| {
            let m = libm::hypot(z.re, z.im);
            if m > max * (1.0 + SAME) { (i, m) } else { (p, max) }
        });
        (steps(-modulus(u), radius), steps(angle, 1.0), pivot.0)
    };
    units.sort_by(|a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2))
    });
    Ok(units)
}

/// Right eigenvectors and the inverse of their matrix, in real form: a pair has √2 Re ξ and √2 Im ξ
/// in its two columns. That is Ξ times a unitary matrix, with its singular values.
#[derive(Clone, Debug)]
struct Basis {
    right: Mat<f64>,
    /// The rows of a pair are √2 Re w and √2 Im w.
    left: Mat<f64>,
    conditions: Vec<f64>,
    condition: f64,
}

impl Basis {
    fn new(units: &[Unit], n: usize) -> Result<Self, SpectrumError> {
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(n);
        for unit in units {
            if unit.value.im > 0.0 {
                let root = 2.0_f64.sqrt();
                columns.push(unit.vector.iter().map(|z| z.re * root).collect());
                columns.push(unit.vector.iter().map(|z| z.im * root).collect());
            } else {
                columns.push(unit.vector.iter().map(|z| z.re).collect());
            }
        }
        if columns.len() != n {
            return Err(SpectrumError::NoConvergence);
        }
        let right = Mat::from_fn(n, n, |i, j| columns[j][i]);
        let svd = right.svd().map_err(|_| SpectrumError::NoConvergence)?;
        let sigma: Vec<f64> = svd.S().column_vector().iter().copied().collect();
        let condition = sigma[0] / sigma[n - 1];
        let left = if condition < 1.0 / f64::EPSILON {
            // The inverse, and one step of Newton's iteration on it (Schulz 1933).
            let inverse = right.partial_piv_lu().inverse();
            let rest = Mat::<f64>::identity(n, n) - &right * &inverse;
            &inverse + &inverse * &rest
        } else {
            // There is none: directions without a length get one of ε, so that the conditions show
            // which eigenvectors lack one, and the others are right.
            let floor = sigma[0] * f64::EPSILON;
            let shrunk = Mat::from_fn(n, n, |i, k| svd.V()[(i, k)] / sigma[k].max(floor));
            shrunk * svd.U().transpose()
        };
        let squares: Vec<f64> = left.row_iter().map(|row| row.squared_norm_l2()).collect();
        let mut conditions = Vec::with_capacity(n);
        for unit in units {
            let k = conditions.len();
            let pair = unit.value.im > 0.0;
            let square = if pair { (squares[k] + squares[k + 1]) / 2.0 } else { squares[k] };
            // At least 1 by Cauchy and Schwarz; rounding may say less.
            conditions.extend(unit.values().map(|_| square.sqrt().max(1.0)));
        }
        Ok(Self { right, left, conditions, condition })
    }

    fn worst(&self) -> f64 {
        self.conditions.iter().copied().fold(0.0, largest)
    }
}

fn distance(a: c64, b: c64) -> f64 {
    libm::hypot(a.re - b.re, a.im - b.im)
}

/// Indices put together that are near each other, directly or through others.
fn clusters(mut rest: Vec<usize>, near: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
    let mut found = Vec::new();
    while !rest.is_empty() {
        let mut cluster = vec![rest.remove(0)];
        let mut next = 0;
        while next < cluster.len() {
            let (joined, others): (Vec<usize>, Vec<usize>) =
                rest.iter().partition(|i| near(cluster[next], **i));
            cluster.extend(joined);
            rest = others;
            next += 1;
        }
        cluster.sort_unstable();
        found.push(cluster);
    }
    found
}

/// The largest |K ξ − λ ξ| of an eigenvector of unit norm.
fn residual(matrix: &Mat<f64>, unit: &Unit) -> f64 {
    let rows = matrix.row_iter().zip(&unit.vector);
    let entry = |(row, z): (faer::RowRef<'_, f64>, &c64)| {
        let product: c64 = row.iter().zip(&unit.vector).map(|(k, x)| x * *k).sum();
        distance(product, unit.value * z)
    };
    rows.map(entry).fold(0.0, largest)
}

/// Whether every eigenvector is one.
fn exact(matrix: &Mat<f64>, units: &[Unit]) -> bool {
    let norm = matrix.norm_l2();
    units.iter().all(|unit| residual(matrix, unit) <= 2.0 * SEMISIMPLE * norm)
}

/// Better eigenvectors for equal eigenvalues. Where rounding alone tells eigenvalues apart, their
/// computed eigenvectors may have any direction in the space that they span, nearly parallel ones
/// too, or (faer 0.24, two equal pairs) none in it: an orthonormal basis of the space takes their
/// place. `None` when there is nothing to mend.
fn mend(
    matrix: &Mat<f64>,
    units: &[Unit],
    basis: &Basis,
) -> Result<Option<Vec<Unit>>, SpectrumError> {
    let norm = matrix.norm_l2();
    let wrong: Vec<bool> =
        units.iter().map(|unit| residual(matrix, unit) > SEMISIMPLE * norm).collect();
    let owners: Vec<(usize, c64)> =
        units.iter().enumerate().flat_map(|(u, unit)| unit.values().map(move |z| (u, z))).collect();
    let suspect = |i: usize| wrong[owners[i].0] || basis.conditions[i] > DEFECTIVE;
    if !(0..owners.len()).any(suspect) {
        return Ok(None);
    }
    let near = |a: usize, b: usize| distance(owners[a].1, owners[b].1) <= EQUAL * norm;
    let mut mended = units.to_vec();
    let mut dropped = vec![false; units.len()];
    for cluster in clusters((0..owners.len()).collect(), near) {
        let value = |i: &usize| owners[*i].1;
        // A cluster on the real axis holds pairs whole; one below it mirrors one above.
        if !cluster.iter().any(|i| suspect(*i)) || cluster.iter().all(|i| value(i).im < 0.0) {
            continue;
        }
        let mean = cluster.iter().map(value).sum::<c64>() / cluster.len() as f64;
        let upper = cluster.iter().all(|i| value(i).im > 0.0);
        let centre = if upper { mean } else { c64::new(mean.re, 0.0) };
        let vectors = null_vectors(matrix, centre, SEMISIMPLE * norm)?;
        if vectors.len() == cluster.len() {
            for i in &cluster {
                dropped[owners[*i].0] = true;
            }
            mended.extend(vectors.into_iter().map(|vector| Unit { value: centre, vector }));
        } else {
            for i in cluster.iter().filter(|i| wrong[owners[**i].0] && value(i).im >= 0.0) {
                let vector = null_vectors(matrix, value(i), 0.0)?.pop();
                if let Some(vector) = vector {
                    mended[owners[*i].0].vector = vector;
                }
            }
        }
    }
    let mut dropped = dropped.into_iter();
    mended.retain(|_| !dropped.next().unwrap_or(false));
    in_order(mended).map(Some)
}

/// An orthonormal basis of the vectors that K − λ I all but annihilates: right singular vectors
/// with singular values up to `floor`, at least the one with the smallest; it comes last.
fn null_vectors(matrix: &Mat<f64>, value: c64, floor: f64) -> Result<Vec<Vec<c64>>, SpectrumError> {
    let n = matrix.nrows();
    let shift = |i: usize, j: usize| if i == j { value } else { c64::new(0.0, 0.0) };
    let shifted = |i: usize, j: usize| c64::new(matrix[(i, j)], 0.0) - shift(i, j);
    let (sigma, v): (Vec<f64>, Mat<c64>) = if value.im == 0.0 {
        // Real arithmetic, so that the vectors of a real eigenvalue are real.
        let real = Mat::from_fn(n, n, |i, j| shifted(i, j).re);
        let svd = real.svd().map_err(|_| SpectrumError::NoConvergence)?;
        let sigma = svd.S().column_vector().iter().copied().collect();
        (sigma, Mat::from_fn(n, n, |i, j| c64::new(svd.V()[(i, j)], 0.0)))
    } else {
        let svd = Mat::from_fn(n, n, shifted).svd().map_err(|_| SpectrumError::NoConvergence)?;
        (svd.S().column_vector().iter().map(|s| s.re).collect(), svd.V().to_owned())
    };
    let first = sigma.iter().position(|s| *s <= floor).unwrap_or(n - 1);
    Ok((first..n).map(|k| v.col(k).iter().copied().collect()).collect())
}

/// The eigenvalues, as (real, imaginary), of the one-step map linearised at a sample with its
/// history: the largest modulus says whether small deviations grow. A pose that is predicted by
/// increments contributes eigenvalues of 1.
///
/// `states` has shape `[lag + 1, states]`, `inputs` `[lag + 1, inputs]`, oldest first. Empty when
/// the model does not predict from there.
///
/// # Errors
/// [`ModelError`], which a blob that has been parsed does not give.
pub fn eigenvalues(
    model: &Model<'_>,
    states: &[f32],
    inputs: &[f32],
) -> Result<Vec<(f64, f64)>, ModelError> {
    let coefficients: Vec<f64> = model.coefficients().iter().copied().map(f64::from).collect();
    let structure = model.structure().clone();
    let model = match model.terms() {
        Some(terms) => Model::new_sparse(structure, terms.entries(), &coefficients, None)?,
        None => Model::new(structure, &coefficients, None)?,
    };
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let states: Vec<f64> = states.iter().copied().map(f64::from).collect();
    let inputs: Vec<f64> = inputs.iter().copied().map(f64::from).collect();
    let next = |states: &[f64]| -> Option<Vec<f64>> {
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let mut applied: &[f64] = &[];
        let mut rows = inputs.chunks_exact(m.max(1));
        for x in states.chunks_exact(n) {
            predictor.observe(&mut state, applied, x).ok()?;
            applied = rows.next().unwrap_or(&[]);
        }
        predictor.step(&mut state, applied).ok()?;
        let mut out = vec![0.0; n];
        predictor.coordinates(&state, &mut out).ok()?;
        Some(out)
    };
    // Companion form: (xₖ₋ₗ, …, xₖ) to (xₖ₋ₗ₊₁, …, xₖ₊₁).
    let size = states.len();
    let mut jacobian = Mat::<f64>::zeros(size, size);
    for i in n..size {
        jacobian[(i - n, i)] = 1.0;
    }
    for j in 0..size {
        let step = 1e-5 * states[j].abs().max(1.0);
        let (mut high, mut low) = (states.clone(), states.clone());
        high[j] += step;
        low[j] -= step;
        let (Some(high), Some(low)) = (next(&high), next(&low)) else { return Ok(Vec::new()) };
        for i in 0..n {
            let change = structure.states()[i].space.difference(high[i], low[i]);
            jacobian[(size - n + i, j)] = change / (2.0 * step);
        }
    }
    faer::set_global_parallelism(faer::Par::Seq);
    let values = jacobian.eigenvalues().unwrap_or_default();
    Ok(values.into_iter().map(|z| (z.re, z.im)).collect())
}

/// The largest modulus.
///
/// ```
/// assert_eq!(trainer::spectrum::radius(&[(0.6, 0.8), (-0.5, 0.0)]), Some(1.0));
/// ```
pub fn radius(eigenvalues: &[(f64, f64)]) -> Option<f64> {
    eigenvalues.iter().map(|(re, im)| libm::hypot(*re, *im)).reduce(f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// What a reconstruction has to hold.
    const RECONSTRUCTED: f64 = 1e-9;
    /// Rounding in well-conditioned problems of a few dozen entries of order one.
    const EXACT: f64 = 1e-13;

    fn identity(n: usize) -> Vec<f64> {
        (0..n * n).map(|k| f64::from(u8::from(k % (n + 1) == 0))).collect()
    }

    fn product(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
        let m = b.len() / n;
        let entry = |k: usize| (0..n).map(|i| a[k / m * n + i] * b[i * m + k % m]).sum();
        (0..a.len() / n * m).map(entry).collect()
    }

    /// S J S⁻¹ for the unit lower triangular S with entries 1/2, whose inverse is known.
    fn hidden(j: &[f64], n: usize) -> Vec<f64> {
        let mut s = identity(n);
        let mut inverse = identity(n);
        for i in 1..n {
            s[i * n + i - 1] = 0.5;
            for k in 0..i {
                inverse[i * n + k] = (-0.5_f64).powi((i - k) as i32);
            }
        }
        product(&product(&s, j, n), &inverse, n)
    }

    fn decompose(k: &[f64], n: usize) -> Decomposition {
        Decomposition::new(k, &vec![1.0; n]).unwrap()
    }

    #[track_caller]
    fn near(found: f64, expected: f64, tolerance: f64) {
        assert!((found - expected).abs() <= tolerance, "{found:e} instead of {expected:e}");
    }

    #[test]
    fn damped_oscillator() {
        let (decay, angle) = (0.9_f64, 0.3_f64);
        let (sin, cos) = (decay * angle.sin(), decay * angle.cos());
        // x⁺ = decay · (x cos + y sin), y⁺ = decay · (y cos − x sin), and a slow term of its own.
        let k = [cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 0.95];
        let spectrum = decompose(&k, 3);
        let values = spectrum.eigenvalues();
        assert_eq!(values[0], (0.95, 0.0));
        for (value, sign) in [(values[1], 1.0), (values[2], -1.0)] {
            near(value.0, cos, EXACT);
            near(value.1, sign * sin, EXACT);
        }
        assert_eq!(values[1].1, -values[2].1);
        near(spectrum.radius(), 0.95, EXACT);
        // Real numbers from complex modes and eigenfunctions, in conjugate pairs.
        let lifted = [0.7, -0.2, 1.5];
        let (phi, modes) = (spectrum.eigenfunctions(&lifted), spectrum.modes(&identity(3)));
        let next = product(&lifted, &k, 3);
        for j in 0..3 {
            let (mut re, mut im) = (0.0, 0.0);
            for ((v, l), p) in modes.iter().map(|v| v[j]).zip(values).zip(&phi) {
                let z = c64::new(v.0, v.1) * c64::new(l.0, l.1) * c64::new(p.0, p.1);
                (re, im) = (re + z.re, im + z.im);
            }
            near(re, next[j], EXACT);
            near(im, 0.0, EXACT);
        }
        for (a, b) in modes[1].iter().zip(&modes[2]) {
            assert_eq!((a.0, a.1), (b.0, -b.1));
        }
        let condition = spectrum.condition();
        near(condition, 1.0, EXACT); // a normal matrix
    }

    #[test]
    fn vectors_are_what_they_are_called() {
        let scale = [1.0, 40.0, 1e-3, 2.0];
        let k = [
            0.9, 8.0, 1e-4, 0.3, //
            -0.01, 0.5, -2e-5, 0.0, //
            90.0, 2e3, 0.7, -200.0, //
            0.1, 0.0, 5e-4, -0.4,
        ];
        let spectrum = Decomposition::new(&k, &scale).unwrap();
        let (right, left) = (spectrum.right(), spectrum.left());
        let complex = |z: (f64, f64)| c64::new(z.0, z.1);
        let size = |z: c64| libm::hypot(z.re, z.im);
        for (n, value) in spectrum.eigenvalues().iter().enumerate() {
            let mut norm = 0.0;
            for i in 0..4 {
                let (mut xi, mut w) = (c64::new(0.0, 0.0), c64::new(0.0, 0.0));
                for j in 0..4 {
                    xi += complex(right[n][j]) * k[i * 4 + j];
                    w += complex(left[n][j]) * k[j * 4 + i];
                }
                let right_error = size(xi - complex(*value) * complex(right[n][i])) * scale[i];
                let left_error = size(w - complex(*value) * complex(left[n][i])) / scale[i];
                assert!(
                    right_error < EXACT && left_error < EXACT,
                    "{right_error:e} {left_error:e}"
                );
                norm += (size(complex(right[n][i])) * scale[i]).powi(2);
            }
            near(norm, 1.0, EXACT);
            for (m, xi) in right.iter().enumerate() {
                let pairs = left[n].iter().zip(xi);
                let w_xi: c64 = pairs.map(|(w, xi)| complex(*w) * complex(*xi)).sum();
                near(w_xi.re, if n == m { 1.0 } else { 0.0 }, EXACT);
                near(w_xi.im, 0.0, EXACT);
            }
            let largest = right[n].iter().zip(&scale).map(|(z, s)| size(complex(*z)) * s);
            let largest = largest.fold(0.0, f64::max);
            let pivot = right[n]
                .iter()
                .zip(&scale)
                .find(|(z, s)| size(complex(**z)) * *s > largest * 0.999);
            let (pivot, _) = pivot.unwrap();
            assert!(pivot.0 > 0.0 && pivot.1 == 0.0, "{pivot:?}");
        }
        let (right, left) = spectrum.eigenvector_residuals();
        assert!(right < EXACT && left < EXACT, "{right:e} {left:e}");
        assert!(spectrum.reconstruction_residual(&identity(4)) < EXACT);
    }

    #[test]
    fn residuals_see_wrong_vectors() {
        let k = [0.5, 0.1, -0.1, 0.8];
        let mut spectrum = decompose(&k, 2);
        spectrum.basis.left[(0, 0)] += 1e-6;
        assert!(spectrum.reconstruction_residual(&identity(2)) > 1e-8);
        assert!(spectrum.eigenvector_residuals().1 > 1e-8);
        spectrum.basis.right[(0, 0)] += 1e-6;
        assert!(spectrum.eigenvector_residuals().0 > 1e-8);
    }

    #[test]
    fn order_of_eigenvalues() {
        // Modulus 1: 1, ±i and −1 by frequency, whatever their last bits; then 0.5.
        let mut k = vec![0.0; 25];
        for (i, x) in [0.5, 0.0, 0.0, -1.0, 1.0].into_iter().enumerate() {
            k[i * 6] = x;
        }
        (k[7], k[11]) = (1.0, -1.0);
        let spectrum = decompose(&k, 5);
        let rounded: Vec<(f64, f64)> =
            spectrum.eigenvalues().iter().map(|(a, b)| (a.round(), b.round())).collect();
        assert_eq!(rounded[..4], [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (-1.0, 0.0)]);
        near(spectrum.eigenvalues()[4].0, 0.5, EXACT);
    }

    #[test]
    fn jordan_blocks_are_reported() {
        let n = 4;
        // λ = 0.5 twice with one eigenvector, and two eigenvalues that have their own.
        let mut j = vec![0.0; n * n];
        for (i, x) in [0.5, 0.5, 0.9, -0.3].into_iter().enumerate() {
            j[i * n + i] = x;
        }
        j[1] = 1.0;
        for k in [j.clone(), hidden(&j, n)] {
            let spectrum = decompose(&k, n);
            let defects = spectrum.defects();
            assert_eq!(defects.len(), 1, "{defects:?}");
            assert_eq!(defects[0].eigenvalues, [1, 2], "{:?}", spectrum.eigenvalues());
            assert!(defects[0].condition > DEFECTIVE && spectrum.condition() > DEFECTIVE);
            // The others are as good as ever.
            assert!(spectrum.conditions()[0] < 100.0 && spectrum.conditions()[3] < 100.0);
            near(spectrum.eigenvalues()[0].0, 0.9, 1e-12);
            near(spectrum.eigenvalues()[1].0, 0.5, 1e-6);
            assert!(spectrum.modes(&identity(n)).iter().flatten().all(|v| v.0.is_finite()));
        }
        // Three in one.
        let triple = [0.5, 1.0, 0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.5];
        for k in [triple.to_vec(), hidden(&triple, 3)] {
            let defects = decompose(&k, 3).defects();
            assert_eq!(defects.len(), 1, "{defects:?}");
            assert_eq!(defects[0].eigenvalues, [0, 1, 2]);
        }
        // Thirty in one: rounding spreads them far apart.
        let mut long = vec![0.0; 900];
        for i in 0..30 {
            long[i * 31] = 0.5;
            if i > 0 {
                long[i * 31 - 1] = 1.0;
            }
        }
        for k in [long.clone(), hidden(&long, 30)] {
            let defects = decompose(&k, 30).defects();
            assert!(!defects.is_empty() && defects[0].condition > DEFECTIVE);
        }
        // A complex pair twice: a resonance, and its mirror image.
        let (c, s) = (0.6, 0.5);
        let mut k = vec![0.0; 16];
        for b in [0, 2] {
            (k[b * 5], k[b * 5 + 1], k[b * 5 + 4], k[b * 5 + 5]) = (c, s, -s, c);
        }
        (k[2], k[7]) = (1.0, 1.0);
        let spectrum = decompose(&hidden(&k, 4), 4);
        let involved: usize = spectrum.defects().iter().map(|d| d.eigenvalues.len()).sum();
        assert_eq!((spectrum.defects().len(), involved), (2, 4), "{:?}", spectrum.defects());
    }

    #[test]
    fn nearly_defective() {
        // Eigenvalues a gap apart under a coupling of 1 have a condition of 1 / gap.
        for gap in [1e-2, 1e-4, 1e-5, 1e-7, 1e-8] {
            let spectrum = decompose(&[0.5, 1.0, 0.0, 0.5 + gap], 2);
            near(spectrum.conditions()[0] * gap, 1.0, 0.02);
            let defects = spectrum.defects();
            if 1.0 / gap > DEFECTIVE {
                assert_eq!(defects.len(), 1);
                assert_eq!(defects[0].eigenvalues, [0, 1]);
            } else {
                assert_eq!(defects, []);
                assert!(spectrum.reconstruction_residual(&identity(2)) <= RECONSTRUCTED);
            }
        }
    }

    #[test]
    fn repeated_eigenvalues_with_all_eigenvectors() {
        let n = 4;
        let mut j = identity(n);
        j[15] = 0.25;
        let mut zeros = vec![0.0; 16];
        zeros[0] = 1.0;
        let (c, s) = (0.6, 0.8);
        let oscillators = [c, s, 0.0, 0.0, -s, c, 0.0, 0.0, 0.0, 0.0, c, s, 0.0, 0.0, -s, c];
        // Equal but for the noise of a fit, which alone would couple them.
        let mut noisy = identity(n);
        (noisy[1], noisy[6]) = (1e-13, -2e-13);
        for k in [identity(n), hidden(&j, n), vec![0.0; 16], hidden(&zeros, n), noisy]
            .into_iter()
            .chain([oscillators.to_vec(), hidden(&oscillators, n)])
        {
            let spectrum = decompose(&k, n);
            assert_eq!(spectrum.defects(), [], "{k:?}");
            let residual = spectrum.reconstruction_residual(&identity(n));
            let (right, left) = spectrum.eigenvector_residuals();
            assert!(residual <= 1e-11 && right <= 1e-11 && left <= 1e-11, "{residual:e} of {k:?}");
        }
        let spectrum = decompose(&identity(n), n);
        assert_eq!(spectrum.reconstruction_residual(&identity(n)), 0.0);
        assert_eq!((spectrum.radius(), spectrum.condition()), (1.0, 1.0));
    }

    #[test]
    fn terms_of_very_different_sizes() {
        // A well-behaved operator on terms that differ by up to 1e12, in their own units.
        let scale: Vec<f64> = (0..6).map(|i| 10.0_f64.powi(4 * (i % 4) - 6)).collect();
        let mut seed = 1_u64;
        let plain: Vec<f64> = (0..36).map(|_| uniform(&mut seed)).collect();
        let k: Vec<f64> = (0..36).map(|i| plain[i] * scale[i % 6] / scale[i / 6]).collect();
        let (own, reference) = (Decomposition::new(&k, &scale).unwrap(), decompose(&plain, 6));
        for (a, b) in own.eigenvalues().iter().zip(reference.eigenvalues()) {
            near(a.0, b.0, 1e-12);
            near(a.1, b.1, 1e-12);
        }
        let b: Vec<f64> = (0..12).map(|_| uniform(&mut seed)).collect();
        assert!(own.reconstruction_residual(&b) < 1e-12);
        let (sum, exact) = (own.reconstruct(&b), product(&k, &b, 6));
        for (i, (a, b)) in sum.iter().zip(&exact).enumerate() {
            let largest = exact.iter().skip(i % 2).step_by(2).zip(&scale);
            let largest = largest.fold(0.0_f64, |max, (x, s)| max.max((x * s).abs()));
            near((a - b) * scale[i / 2], 0.0, 1e-12 * largest);
        }
    }

    #[test]
    fn bad_matrices() {
        let error = |k: &[f64], s: &[f64]| Decomposition::new(k, s).unwrap_err();
        assert_eq!(error(&[], &[]), SpectrumError::Dimension { expected: 0, found: 0 });
        assert_eq!(error(&[1.0; 3], &[1.0; 2]), SpectrumError::Dimension { expected: 4, found: 3 });
        assert_eq!(error(&[f64::NAN], &[1.0]), SpectrumError::NotFinite);
        assert_eq!(error(&[1.0], &[0.0]), SpectrumError::NotFinite);
        assert_eq!(error(&[1.0; 4], &[1e300, 1e-300]), SpectrumError::NotFinite);
    }

    /// In [-1, 1): a linear congruential generator (Knuth's MMIX), high bits.
    fn uniform(seed: &mut u64) -> f64 {
        *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (*seed >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]
        #[test]
        fn any_matrix_is_put_together_again(n in 1_usize..14, seed in any::<u64>(), m in 1_usize..4) {
            let mut seed = seed;
            let k: Vec<f64> = (0..n * n).map(|_| uniform(&mut seed)).collect();
            let scale: Vec<f64> = (0..n).map(|_| 1.5 + uniform(&mut seed)).collect();
            let b: Vec<f64> = (0..n * m).map(|_| uniform(&mut seed)).collect();
            let spectrum = Decomposition::new(&k, &scale).unwrap();
            prop_assert!(spectrum.defects().is_empty());
            let residual = spectrum.reconstruction_residual(&b);
            prop_assert!(residual <= RECONSTRUCTED, "{:e}", residual);
            let size = k.iter().map(|x| x * x).sum::<f64>().sqrt();
            for (found, exact) in spectrum.reconstruct(&b).iter().zip(product(&k, &b, n)) {
                prop_assert!((found - exact).abs() <= RECONSTRUCTED * size);
            }
            let trace: f64 = (0..n).map(|i| k[i * n + i]).sum();
            let (re, im) = spectrum.eigenvalues().iter().fold((0.0, 0.0), |(a, b), z| (a + z.0, b + z.1));
            prop_assert!((re - trace).abs() <= 1e-12 * size && im == 0.0);
            let moduli: Vec<f64> = spectrum.eigenvalues().iter().map(|z| z.0.hypot(z.1)).collect();
            prop_assert!(moduli.is_sorted_by(|a, b| *a >= b - 1e-8));
            for pair in spectrum.eigenvalues().windows(2).filter(|p| p[0].1 > 0.0) {
                prop_assert_eq!(pair[0], (pair[1].0, -pair[1].1));
            }
        }
    }
}
