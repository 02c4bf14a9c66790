//! Small dense factorisations whose bits do not depend on the machine.
//!
//! The coefficients of a blob come from here, and the same log has to give the same bytes on every
//! x86-64 machine; a linear-algebra library that picks its vector instructions at run time rounds
//! differently on different machines. All matrices are row-major slices.

/// A diagonal entry of a factor that is this small (times the number of columns), relative to a
/// column of unit norm, is rounding noise: the column depends on those before it. Squared norms are
/// compared, so the entries themselves are compared with the square root.
const DEPENDENT: f64 = 64.0 * f64::EPSILON;

/// The Cholesky factor L of a positive definite matrix, shape `[n, n]`, G = L Lᵀ (lower part; the
/// upper one is zero).
///
/// # Errors
/// The indices of the columns that depend on the columns before them, if there are any; `gram` is
/// taken to have a unit diagonal (a column of zeros is dependent, too).
pub fn cholesky(gram: &[f64], n: usize) -> Result<Vec<f64>, Vec<usize>> {
    let floor = DEPENDENT * n as f64;
    let mut l = vec![0.0; n * n];
    let mut dependent = Vec::new();
    for j in 0..n {
        let (above, rest) = l.split_at_mut(j * n);
        let row = &mut rest[..n];
        row[..j].copy_from_slice(&gram[j * n..][..j]);
        let mut square = gram[j * n + j];
        for k in 0..j {
            let other = &above[k * n..][..n];
            // A dependent column has no direction of its own: it is left out of the factor.
            if other[k] == 0.0 {
                row[k] = 0.0;
                continue;
            }
            let product = dot(&row[..k], &other[..k]);
            row[k] = (row[k] - product) / other[k];
        }
        square -= dot(&row[..j], &row[..j]);
        if square > floor {
            row[j] = square.sqrt();
        } else {
            dependent.push(j);
        }
    }
    if dependent.is_empty() { Ok(l) } else { Err(dependent) }
}

/// Solves L Lᵀ X = B in place; `b` has shape `[n, m]`.
pub fn solve_cholesky(l: &[f64], b: &mut [f64], n: usize, m: usize) {
    for i in 0..n {
        for k in 0..i {
            subtract_row(b, m, i, k, l[i * n + k]);
        }
        divide_row(b, m, i, l[i * n + i]);
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            subtract_row(b, m, i, k, l[k * n + i]);
        }
        divide_row(b, m, i, l[i * n + i]);
    }
}

/// Solves R X = B in place for an upper triangular R of shape `[n, n]` with rows `stride` apart.
pub fn solve_upper(r: &[f64], stride: usize, b: &mut [f64], n: usize, m: usize) {
    for i in (0..n).rev() {
        for k in i + 1..n {
            subtract_row(b, m, i, k, r[i * stride + k]);
        }
        divide_row(b, m, i, r[i * stride + i]);
    }
}

fn subtract_row(b: &mut [f64], m: usize, i: usize, k: usize, factor: f64) {
    for j in 0..m {
        b[i * m + j] -= factor * b[k * m + j];
    }
}

fn divide_row(b: &mut [f64], m: usize, i: usize, divisor: f64) {
    for x in &mut b[i * m..][..m] {
        *x /= divisor;
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// The R factor of the rows pushed into it, extended by the right-hand sides: after N rows
/// (ψ, z), Rᵀ R = ΣψᵀΨ and Rᵀ C = ΣψᵀZ, found by Householder reflections block by block without
/// ever forming the products (Golub & Van Loan, "Matrix Computations", algorithm 5.2.1, applied to
/// R on top of the next block of rows).
#[derive(Clone, Debug)]
pub struct RFactor {
    columns: usize,
    width: usize,
    /// Shape `[columns, width]`: R and C beside it.
    r: Vec<f64>,
    /// Shape `[≤ BLOCK, width]`.
    block: Vec<f64>,
}

/// Rows that are reflected at once.
const BLOCK: usize = 128;

impl RFactor {
    /// For rows of `columns` lifted terms and `outputs` targets.
    pub fn new(columns: usize, outputs: usize) -> Self {
        let width = columns + outputs;
        let block = Vec::with_capacity(BLOCK * width);
        Self { columns, width, r: vec![0.0; columns * width], block }
    }

    /// Adds a row.
    pub fn push(&mut self, lifted: &[f64], targets: &[f64]) {
        self.block.extend_from_slice(lifted);
        self.block.extend_from_slice(targets);
        if self.block.len() == BLOCK * self.width {
            self.reduce();
        }
    }

    fn reduce(&mut self) {
        let width = self.width;
        let mut sums = vec![0.0; width];
        for j in 0..self.columns {
            let below: f64 = self.block.chunks_exact(width).map(|row| row[j] * row[j]).sum();
            if below == 0.0 {
                continue;
            }
            let pivot = &mut self.r[j * width..][..width];
            let norm = (pivot[j] * pivot[j] + below).sqrt();
            let alpha = if pivot[j] > 0.0 { -norm } else { norm };
            // v = (pivot − alpha, block[:, j]), H = I − 2 v vᵀ / vᵀv.
            let head = pivot[j] - alpha;
            let scale = 2.0 / (head * head + below);
            for k in j..width {
                sums[k] = head * pivot[k];
            }
            for row in self.block.chunks_exact(width) {
                let v = row[j];
                for (sum, x) in sums[j..].iter_mut().zip(&row[j..]) {
                    *sum += v * x;
                }
            }
            for k in j..width {
                sums[k] *= scale;
                pivot[k] -= head * sums[k];
            }
            pivot[j] = alpha;
            for row in self.block.chunks_exact_mut(width) {
                let v = row[j];
                for (x, sum) in row[j..].iter_mut().zip(&sums[j..]) {
                    *x -= v * sum;
                }
            }
        }
        self.block.clear();
    }

    /// R, shape `[columns, columns]`, upper triangular, and C, shape `[columns, outputs]`.
    pub fn finish(mut self) -> (Vec<f64>, Vec<f64>) {
        self.reduce();
        let split = |part: fn(&[f64], usize) -> &[f64]| {
            let rows = self.r.chunks_exact(self.width.max(1));
            rows.flat_map(|row| part(row, self.columns)).copied().collect()
        };
        let mut r: Vec<f64> = split(|row, n| &row[..n]);
        for i in 0..self.columns {
            r[i * self.columns..][..i].fill(0.0);
        }
        (r, split(|row, n| &row[n..]))
    }
}

/// The columns of an upper triangular R, shape `[n, n]`, with columns of unit norm, that depend on
/// the columns before them.
pub fn dependent_columns(r: &[f64], n: usize) -> Vec<usize> {
    // Rounding in R itself, not in its square: a tighter floor than that of the Gram matrix.
    let floor = DEPENDENT * n as f64;
    (0..n).filter(|j| r[j * n + j].abs() <= floor).collect()
}

/// The singular value decomposition R = U Σ Vᵀ of a square matrix, shape `[n, n]`, by one-sided
/// Jacobi rotations (Hestenes 1958; relative accuracy: Demmel & Veselić 1992).
#[derive(Clone, Debug)]
pub struct Svd {
    n: usize,
    /// U Σ, transposed: row k is σₖ uₖ.
    us: Vec<f64>,
    /// Vᵀ: row k is vₖ.
    v: Vec<f64>,
    /// Singular values, in no particular order.
    pub sigma: Vec<f64>,
}

impl Svd {
    /// Decomposes a matrix.
    pub fn new(r: &[f64], n: usize) -> Self {
        let mut us = vec![0.0; n * n];
        let mut v = vec![0.0; n * n];
        for i in 0..n {
            v[i * n + i] = 1.0;
            for j in 0..n {
                us[j * n + i] = r[i * n + j];
            }
        }
        // Columns that are rounding noise beside the largest ones have no direction to find.
        let noise = n as f64 * f64::EPSILON * f64::EPSILON * dot(&us, &us);
        // Rotations converge quadratically: a handful of sweeps; the bound is for the pathological.
        for _ in 0..60 {
            let mut rotated = false;
            for p in 0..n {
                for q in p + 1..n {
                    let (a, b) = (&us[p * n..][..n], &us[q * n..][..n]);
                    let (alpha, beta, gamma) = (dot(a, a), dot(b, b), dot(a, b));
                    if gamma.abs() <= f64::EPSILON * (alpha * beta).sqrt()
                        || alpha.min(beta) <= noise
                    {
                        continue;
                    }
                    rotated = true;
                    let zeta = (beta - alpha) / (2.0 * gamma);
                    let t = 1.0_f64.copysign(zeta) / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
                    let c = 1.0 / (1.0 + t * t).sqrt();
                    rotate(&mut us, n, p, q, c, c * t);
                    rotate(&mut v, n, p, q, c, c * t);
                }
            }
            if !rotated {
                break;
            }
        }
        let sigma = us.chunks_exact(n.max(1)).map(|row| dot(row, row).sqrt()).collect();
        Self { n, us, v, sigma }
    }

    /// The least-squares solution of R X = C, shape `[n, m]`, keeping singular values above
    /// `truncation` times the largest one, with ridge `lambda` on their squares; and how many were
    /// kept.
    pub fn solve(&self, c: &[f64], m: usize, truncation: f64, lambda: f64) -> (Vec<f64>, usize) {
        let n = self.n;
        let largest = self.sigma.iter().fold(0.0_f64, |max, s| max.max(*s));
        let mut x = vec![0.0; n * m];
        let mut kept = 0;
        for (k, sigma) in self.sigma.iter().enumerate() {
            if *sigma <= truncation.max(f64::EPSILON) * largest {
                continue;
            }
            kept += 1;
            let (us, v) = (&self.us[k * n..][..n], &self.v[k * n..][..n]);
            for j in 0..m {
                let projected: f64 = us.iter().enumerate().map(|(i, u)| u * c[i * m + j]).sum();
                let weight = projected / (sigma * sigma + lambda);
                for (i, v) in v.iter().enumerate() {
                    x[i * m + j] += weight * v;
                }
            }
        }
        (x, kept)
    }
}

fn rotate(rows: &mut [f64], n: usize, p: usize, q: usize, c: f64, s: f64) {
    let (head, tail) = rows.split_at_mut(q * n);
    for (a, b) in head[p * n..][..n].iter_mut().zip(&mut tail[..n]) {
        (*a, *b) = (c * *a - s * *b, s * *a + c * *b);
    }
}

/// Largest over smallest singular value of a factor R, shape `[n, n]`; infinite when R is singular.
/// A figure for reports: it comes from faer and is not part of any blob.
pub fn condition(r: &[f64], n: usize) -> f64 {
    faer::set_global_parallelism(faer::Par::Seq);
    let matrix = faer::MatRef::from_row_major_slice(r, n, n);
    match matrix.singular_values() {
        Ok(sigma) if !sigma.is_empty() && sigma[n - 1] > 0.0 => sigma[0] / sigma[n - 1],
        _ => f64::INFINITY,
    }
}
