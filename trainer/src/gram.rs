//! The normal equations G = ΣΨᵀΨ, A = ΣΨᵀZ of all snapshot pairs, in constant memory.
//!
//! A product of two terms of one Kronecker block is, factor by factor, a product of two basis
//! functions of the same observable: a polynomial of degree up to 2p, or a Fourier series up to
//! harmonic 2p. So G has only Π(2pᵢ + 1) distinct moments (Π(4pᵢ + 1) for Fourier factors): 729
//! instead of 2,080 for six factors of order 1. They are summed as one small matrix product
//! (moments of the first factors × moments of the last factors) and spread over G at the end.
//!
//! The order of all sums is fixed and every operation, the fused multiply-add among them, is exactly
//! rounded, so that vector units of any width give the same bits. (A machine without fused
//! multiply-add emulates it: slow, and the same.)

use firmware_core::capacity::MAX_BASIS;
use firmware_core::dictionary::{Basis, Dictionary, Factor, fourier};
use firmware_core::{Lanes, Number};
use pulp::{Simd, WithSimd};

use crate::terms::distinct_terms;

/// Samples side by side.
const LANES: usize = 8;
/// Groups of samples that are lifted and summed at once: the buffers of a chunk stay in the cache.
const CHUNK: usize = 16;
/// Columns of the left and right matrix in a register tile.
const TILE: (usize, usize) = (3, 3);

/// Highest Hermite order whose products are summed as powers: from powers of 2p back to Hermite
/// polynomials, G loses digits (about 2e-12 of it at order 6, 2e-9 at order 9, on normal data).
const MAX_POWERS: u8 = 5;

/// One number of [`LANES`] samples.
type Lane = Lanes<f64, LANES>;

/// G and A of a number of pairs.
#[derive(Clone, Debug, PartialEq)]
pub struct NormalEquations {
    /// Terms of the dictionary, n.
    pub terms: usize,
    /// Outputs, m.
    pub outputs: usize,
    /// Snapshot pairs summed.
    pub pairs: u64,
    /// ΣΨᵀΨ, shape `[n, n]`.
    pub gram: Vec<f64>,
    /// ΣΨᵀZ, shape `[n, m]`.
    pub cross: Vec<f64>,
}

/// Sums normal equations.
#[derive(Clone, Debug)]
pub struct GramAccumulator {
    dictionary: Dictionary,
    arch: pulp::Arch,
    distinct: Vec<usize>,
    outputs: usize,
    pairs: u64,
    filled: usize,
    observables: usize,
    /// Shape `[CHUNK, observables]`.
    values: Vec<Lane>,
    /// Shape `[CHUNK, outputs]`.
    targets: Vec<Lane>,
    /// Shape `[CHUNK, terms]`.
    lifted: Vec<Lane>,
    dense: Vec<Lane>,
    moments: Option<Moments>,
    /// Shape `[terms, terms]`, upper tiles; without moments.
    gram: Vec<f64>,
    /// Shape `[outputs, terms]`.
    cross: Vec<Lane>,
}

/// The distinct moments of a single block, split into a slow and a fast half.
#[derive(Clone, Debug)]
struct Moments {
    factors: Vec<Factor>,
    split: usize,
    /// Shape `[CHUNK, slow moments]`.
    slow: Vec<Lane>,
    /// Shape `[CHUNK, fast moments]`.
    fast: Vec<Lane>,
    /// Shape `[slow, fast]`.
    sums: Vec<Lane>,
}

/// Number of distinct products of two basis functions of a factor.
fn products(factor: Factor) -> usize {
    2 * factor.radix() - 1
}

fn size(factors: &[Factor]) -> usize {
    factors.iter().map(|f| products(*f)).product()
}

impl Moments {
    /// `None` where summing the moments costs more than summing the upper half of G itself.
    fn new(dictionary: &Dictionary, terms: usize) -> Option<Self> {
        let mut blocks = dictionary.blocks();
        let (_, factors) = blocks.next()?;
        let high = factors.iter().any(|f| f.basis == Basis::Hermite && f.order > MAX_POWERS);
        if blocks.next().is_some() || high || 2 * size(factors) > terms * terms {
            return None;
        }
        // The nearer the halves, the fewer numbers are made per sample.
        let made = |split: &usize| size(&factors[..*split]) + size(&factors[*split..]);
        let split = (0..=factors.len()).min_by_key(made)?;
        let (p, q) = (size(&factors[..split]), size(&factors[split..]));
        Some(Self {
            factors: factors.to_vec(),
            split,
            slow: vec![Lane::ZERO; CHUNK * p],
            fast: vec![Lane::ZERO; CHUNK * q],
            sums: vec![Lane::ZERO; p * q],
        })
    }

    #[inline(always)]
    fn add<S: Simd>(
        &mut self,
        simd: S,
        values: &[Lane],
        observables: usize,
        groups: usize,
        empty: usize,
    ) {
        let (slow, fast) = self.factors.split_at(self.split);
        let (p, q) = (size(slow), size(fast));
        let samples = values.chunks_exact(observables).take(groups);
        let buffers = self.slow.chunks_exact_mut(p).zip(self.fast.chunks_exact_mut(q));
        for (values, (s, f)) in samples.zip(buffers) {
            moments(slow, values, s);
            moments(fast, values, f);
        }
        if let Some(last) = groups.checked_sub(1) {
            blank(&mut self.slow[last * p..][..p], empty);
        }
        add_product(simd, groups, (&self.slow, p), (&self.fast, q), &mut self.sums, false);
    }

    /// Spreads the sums over `[dense terms, dense terms]`.
    fn gram(&self) -> Vec<f64> {
        let mut tensor: Vec<f64> = self.sums.iter().copied().map(total).collect();
        // One axis after the other, from moments to pairs of basis functions.
        let mut after: usize = tensor.len();
        for factor in &self.factors {
            let (d, r) = (products(*factor), factor.radix());
            after /= d;
            let spread = product_table(*factor);
            let mut next = Vec::with_capacity(tensor.len() / d * r * r);
            for slab in tensor.chunks_exact(d * after) {
                for pair in &spread {
                    let start = next.len();
                    next.resize(start + after, 0.0);
                    for (weight, moment) in pair.iter().zip(slab.chunks_exact(after)) {
                        if *weight != 0.0 {
                            for (to, x) in next[start..].iter_mut().zip(moment) {
                                *to += weight * x;
                            }
                        }
                    }
                }
            }
            tensor = next;
        }
        // From [(a₁, b₁), (a₂, b₂), …] to [(a₁, a₂, …), (b₁, b₂, …)].
        let n: usize = self.factors.iter().map(|f| f.radix()).product();
        let mut gram = vec![0.0; n * n];
        for (index, value) in tensor.iter().enumerate() {
            let (mut rest, mut stride, mut a, mut b) = (index, 1, 0, 0);
            for factor in self.factors.iter().rev() {
                let r = factor.radix();
                a += rest / r % r * stride;
                b += rest % r * stride;
                rest /= r * r;
                stride *= r;
            }
            gram[a * n + b] = *value;
        }
        gram
    }
}

/// Sets the last `empty` lanes to 0.
fn blank(row: &mut [Lane], empty: usize) {
    for lanes in row {
        lanes.0[LANES - empty..].fill(0.0);
    }
}

/// The kron over factors of the functions that products of two basis functions are made of: powers
/// up to 2p, harmonics up to 2p.
#[inline(always)]
fn moments(factors: &[Factor], values: &[Lane], out: &mut [Lane]) {
    let mut functions = [Lane::ZERO; 2 * MAX_BASIS];
    out[0] = Lane::ONE;
    let mut len = 1;
    for factor in factors.iter().rev() {
        let v = values[usize::from(factor.observable)];
        let count = products(*factor);
        match factor.basis {
            Basis::Hermite => {
                let mut power = Lane::ONE;
                for f in &mut functions[..count] {
                    *f = power;
                    power = power * v;
                }
            }
            Basis::Fourier => {
                let cos = values[usize::from(factor.observable) + 1];
                fourier(v, cos, &mut functions[..count]);
            }
        }
        let (inner, outer) = out.split_at_mut(len);
        for (chunk, f) in outer.chunks_exact_mut(len).zip(&functions[1..count]) {
            for (to, x) in chunk.iter_mut().zip(&*inner) {
                *to = *f * *x;
            }
        }
        len *= count;
    }
}

/// For every pair (a, b) of basis functions, `a · radix + b`, the weights of their product in the
/// functions of [`moments`].
fn product_table(factor: Factor) -> Vec<Vec<f64>> {
    let (r, d) = (factor.radix(), products(factor));
    let mut table = Vec::with_capacity(r * r);
    for a in 0..r {
        for b in 0..r {
            let mut weights = vec![0.0; d];
            match factor.basis {
                Basis::Hermite => {
                    for (i, x) in hermite_powers(a).iter().enumerate() {
                        for (j, y) in hermite_powers(b).iter().enumerate() {
                            weights[i + j] += x * y;
                        }
                    }
                }
                Basis::Fourier => {
                    // sin(±n) and cos(n) as an index and a sign.
                    let mut add = |sine: bool, n: isize, weight: f64| {
                        let index = 2 * n.unsigned_abs();
                        match (sine, n) {
                            (true, 0) => {}
                            (true, _) => weights[index - 1] += weight * n.signum() as f64,
                            (false, _) => weights[index] += weight,
                        }
                    };
                    let (m, n) = (a.div_ceil(2) as isize, b.div_ceil(2) as isize);
                    match (a % 2 == 1, b % 2 == 1) {
                        (true, true) => {
                            add(false, m - n, 0.5);
                            add(false, m + n, -0.5);
                        }
                        (true, false) => {
                            add(true, m + n, 0.5);
                            add(true, m - n, 0.5);
                        }
                        (false, true) => {
                            add(true, n + m, 0.5);
                            add(true, n - m, 0.5);
                        }
                        (false, false) => {
                            add(false, m - n, 0.5);
                            add(false, m + n, 0.5);
                        }
                    }
                }
            }
            table.push(weights);
        }
    }
    table
}

/// Coefficients of Hⁿ in powers, lowest first.
///
/// ```
/// assert_eq!(trainer::gram::hermite_powers(4), [3.0, 0.0, -6.0, 0.0, 1.0]);
/// ```
pub fn hermite_powers(n: usize) -> Vec<f64> {
    let (mut previous, mut current) = (Vec::new(), vec![1.0]);
    for k in 0..n {
        let mut next = vec![0.0; k + 2];
        for (i, c) in current.iter().enumerate() {
            next[i + 1] += c;
        }
        for (i, c) in previous.iter().enumerate() {
            next[i] -= k as f64 * c;
        }
        previous = std::mem::replace(&mut current, next);
    }
    current
}

/// `out += leftᵀ right`, summed over `groups` groups of samples; `left` and `right` come with their
/// numbers per sample p and q, `out` has shape `[p, q]`. With `upper`, tiles wholly below the
/// diagonal are left alone.
#[inline(always)]
fn add_product<S: Simd, A: Accumulate>(
    simd: S,
    groups: usize,
    (left, p): (&[Lane], usize),
    (right, q): (&[Lane], usize),
    out: &mut [A],
    upper: bool,
) {
    let (left, right) = (&left[..groups * p], &right[..groups * q]);
    for i in (0..p).step_by(TILE.0) {
        for j in (0..q).step_by(TILE.1) {
            if upper && j + TILE.1 <= i {
                continue;
            }
            let mut sums = [[Lane::ZERO; TILE.1]; TILE.0];
            // As many lanes as the machine has side by side; each lane is summed on its own.
            for part in 0..LANES / S::F64_LANES {
                let mut tile = [[simd.splat_f64s(0.0); TILE.1]; TILE.0];
                for (l, r) in left.chunks_exact(p).zip(right.chunks_exact(q)) {
                    let (mut a, mut b) = ([tile[0][0]; TILE.0], [tile[0][0]; TILE.1]);
                    // Beyond the edge the last column is multiplied again and not used.
                    for (k, a) in a.iter_mut().enumerate() {
                        *a = S::as_simd_f64s(&l[(i + k).min(p - 1)].0).0[part];
                    }
                    for (k, b) in b.iter_mut().enumerate() {
                        *b = S::as_simd_f64s(&r[(j + k).min(q - 1)].0).0[part];
                    }
                    for (tile, a) in tile.iter_mut().zip(a) {
                        for (sum, b) in tile.iter_mut().zip(b) {
                            *sum = simd.mul_add_f64s(a, b, *sum);
                        }
                    }
                }
                for (sums, tile) in sums.iter_mut().zip(tile) {
                    for (sum, part_sum) in sums.iter_mut().zip(tile) {
                        S::as_mut_simd_f64s(&mut sum.0).0[part] = part_sum;
                    }
                }
            }
            for (out, sums) in out[i * q..].chunks_exact_mut(q).zip(sums) {
                for (to, sum) in out[j..].iter_mut().zip(sums) {
                    to.add(sum);
                }
            }
        }
    }
}

/// Where the sums of a chunk go: lane by lane where there is room, added up where there is not.
trait Accumulate {
    fn add(&mut self, sums: Lane);
}

impl Accumulate for Lane {
    #[inline(always)]
    fn add(&mut self, sums: Lane) {
        *self = *self + sums;
    }
}

impl Accumulate for f64 {
    #[inline(always)]
    fn add(&mut self, sums: Lane) {
        *self += total(sums);
    }
}

/// The sum over the lanes, by halves.
#[inline(always)]
fn total(Lanes([a, b, c, d, e, f, g, h]): Lane) -> f64 {
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

/// The work on a chunk, compiled once for every vector unit.
struct AddChunk<'g>(&'g mut GramAccumulator);

impl WithSimd for AddChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        self.0.add_chunk(simd);
    }
}

impl GramAccumulator {
    /// Sums for `outputs` targets over the distinct terms of `dictionary`.
    pub fn new(dictionary: &Dictionary, outputs: usize) -> Self {
        let distinct = distinct_terms(dictionary);
        let (n, m, observables) = (distinct.len(), outputs, dictionary.observables().len());
        let moments = Moments::new(dictionary, n);
        let gram = if moments.is_some() { 0 } else { n * n };
        Self {
            dictionary: dictionary.clone(),
            arch: pulp::Arch::new(),
            outputs,
            pairs: 0,
            filled: 0,
            observables,
            values: vec![Lane::ZERO; CHUNK * observables],
            targets: vec![Lane::ZERO; CHUNK * m],
            lifted: vec![Lane::ZERO; CHUNK * n],
            dense: vec![Lane::ZERO; dictionary.dense_terms()],
            moments,
            gram: vec![0.0; gram],
            cross: vec![Lane::ZERO; m * n],
            distinct,
        }
    }

    /// Adds a snapshot pair: values of the observables and targets.
    #[inline]
    pub fn push(&mut self, values: &[f64], targets: &[f64]) {
        let (group, lane) = (self.filled / LANES, self.filled % LANES);
        let group_values = &mut self.values[group * self.observables..][..self.observables];
        for (to, v) in group_values.iter_mut().zip(values) {
            to.0[lane] = *v;
        }
        let group_targets = &mut self.targets[group * self.outputs..][..self.outputs];
        for (to, z) in group_targets.iter_mut().zip(targets) {
            to.0[lane] = *z;
        }
        self.filled += 1;
        self.pairs += 1;
        if self.filled == CHUNK * LANES {
            self.flush();
        }
    }

    fn flush(&mut self) {
        self.arch.dispatch(AddChunk(self));
        self.filled = 0;
    }

    #[inline(always)]
    fn add_chunk<S: Simd>(&mut self, simd: S) {
        let (n, m, o) = (self.distinct.len(), self.outputs, self.observables);
        let groups = self.filled.div_ceil(LANES);
        for (k, row) in self.lifted.chunks_exact_mut(n).enumerate().take(groups) {
            let values = &self.values[k * o..][..o];
            if n == self.dense.len() {
                self.dictionary.lift_dense(values, row);
            } else {
                self.dictionary.lift_dense(values, &mut self.dense);
                for (to, term) in row.iter_mut().zip(&self.distinct) {
                    *to = self.dense[*term];
                }
            }
        }
        // The lanes behind the last sample hold an older one: they must not count.
        let empty = groups * LANES - self.filled;
        if let Some(last) = groups.checked_sub(1) {
            blank(&mut self.lifted[last * n..][..n], empty);
        }
        add_product(simd, groups, (&self.targets, m), (&self.lifted, n), &mut self.cross, false);
        match &mut self.moments {
            Some(moments) => moments.add(simd, &self.values, o, groups, empty),
            None => add_product(
                simd,
                groups,
                (&self.lifted, n),
                (&self.lifted, n),
                &mut self.gram,
                true,
            ),
        }
    }

    /// G and A.
    pub fn finish(mut self) -> NormalEquations {
        if self.filled > 0 {
            self.flush();
        }
        let (n, m) = (self.distinct.len(), self.outputs);
        let mut gram = vec![0.0; n * n];
        match &self.moments {
            Some(moments) => {
                let dense = moments.gram();
                let width = self.dictionary.dense_terms();
                for (row, a) in gram.chunks_exact_mut(n).zip(&self.distinct) {
                    for (to, b) in row.iter_mut().zip(&self.distinct) {
                        *to = dense[a * width + b];
                    }
                }
            }
            None => {
                for i in 0..n {
                    for j in 0..n {
                        gram[i * n + j] = self.gram[i.min(j) * n + i.max(j)];
                    }
                }
            }
        }
        let mut cross = vec![0.0; n * m];
        for (i, row) in cross.chunks_exact_mut(m).enumerate() {
            for (j, to) in row.iter_mut().enumerate() {
                *to = total(self.cross[j * n + i]);
            }
        }
        NormalEquations { terms: n, outputs: m, pairs: self.pairs, gram, cross }
    }
}
