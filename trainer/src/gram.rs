//! The normal equations G = ΣΨᵀΨ, A = ΣΨᵀZ of all snapshot pairs, in constant memory.
//!
//! A product of two terms of one Kronecker block is, factor by factor, a product of two basis
//! functions of the same observable: a polynomial of degree up to 2p, or a Fourier series up to
//! harmonic 2p. So G has only Π(2pᵢ + 1) distinct moments (Π(4pᵢ + 1) for Fourier factors): 729
//! instead of 2,080 for six factors of order 1. They are summed as one small matrix product
//! (moments of the first factors × moments of the last factors) and spread over G at the end.
//!
//! The order of all sums is fixed and every operation is a separately rounded multiplication or
//! addition, so that vector units of any width give the same bits.

use firmware_core::capacity::MAX_BASIS;
use firmware_core::dictionary::{Basis, Dictionary, Factor, fourier};

use crate::terms::distinct_terms;

/// Pairs that are lifted and summed at once: all buffers of a chunk stay in the L1 cache.
const CHUNK: usize = 64;
/// Rows and columns of a register tile.
const TILE: (usize, usize) = (4, 8);

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
    values: Vec<f64>,
    /// Shape `[CHUNK, padded outputs]`.
    targets: Vec<f64>,
    /// Shape `[CHUNK, padded terms]`.
    lifted: Vec<f64>,
    dense: Vec<f64>,
    moments: Option<Moments>,
    /// Shape `[padded terms, padded terms]`, upper tiles; without moments.
    gram: Vec<f64>,
    /// Shape `[padded outputs, padded terms]`.
    cross: Vec<f64>,
}

/// The distinct moments of a single block, split into a slow and a fast half.
#[derive(Clone, Debug)]
struct Moments {
    factors: Vec<Factor>,
    split: usize,
    /// Shape `[CHUNK, padded slow moments]`.
    slow: Vec<f64>,
    /// Shape `[CHUNK, padded fast moments]`.
    fast: Vec<f64>,
    /// Shape `[padded slow, padded fast]`.
    sums: Vec<f64>,
}

/// Number of distinct products of two basis functions of a factor.
fn products(factor: Factor) -> usize {
    2 * factor.radix() - 1
}

fn size(factors: &[Factor]) -> usize {
    factors.iter().map(|f| products(*f)).product()
}

fn padded(len: usize, tile: usize) -> usize {
    len.next_multiple_of(tile)
}

impl Moments {
    /// `None` where summing the moments costs more than summing G itself.
    fn new(dictionary: &Dictionary, terms: usize) -> Option<Self> {
        let mut blocks = dictionary.blocks();
        let (_, factors) = blocks.next()?;
        if blocks.next().is_some() {
            return None;
        }
        let cost = |split: usize| {
            let (slow, fast) = factors.split_at(split);
            padded(size(slow), TILE.0) * padded(size(fast), TILE.1)
        };
        let split = (0..=factors.len()).min_by_key(|split| cost(*split))?;
        if 2 * cost(split) > terms * terms {
            return None;
        }
        let (slow, fast) = factors.split_at(split);
        let (p, q) = (padded(size(slow), TILE.0), padded(size(fast), TILE.1));
        Some(Self {
            factors: factors.to_vec(),
            split,
            slow: vec![0.0; CHUNK * p],
            fast: vec![0.0; CHUNK * q],
            sums: vec![0.0; p * q],
        })
    }

    #[inline(always)]
    fn add(&mut self, values: &[f64], observables: usize, rows: usize) {
        let (slow, fast) = self.factors.split_at(self.split);
        let (p, q) = (padded(size(slow), TILE.0), padded(size(fast), TILE.1));
        let samples = values.chunks_exact(observables).take(rows);
        let buffers = self.slow.chunks_exact_mut(p).zip(self.fast.chunks_exact_mut(q));
        for (values, (s, f)) in samples.zip(buffers) {
            moments(slow, values, s);
            moments(fast, values, f);
        }
        add_product(rows, (&self.slow, p), (&self.fast, q), &mut self.sums, false);
    }

    /// Spreads the sums over `[dense terms, dense terms]`.
    fn gram(&self) -> Vec<f64> {
        let (slow, fast) = self.factors.split_at(self.split);
        let (fast_len, fast_padded) = (size(fast), padded(size(fast), TILE.1));
        let mut tensor: Vec<f64> = self
            .sums
            .chunks_exact(fast_padded)
            .take(size(slow))
            .flat_map(|row| &row[..fast_len])
            .copied()
            .collect();
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

/// The kron over factors of the functions that products of two basis functions are made of: powers
/// up to 2p, harmonics up to 2p.
#[inline(always)]
fn moments(factors: &[Factor], values: &[f64], out: &mut [f64]) {
    let mut functions = [0.0; 2 * MAX_BASIS];
    out[0] = 1.0;
    let mut len = 1;
    for factor in factors.iter().rev() {
        let v = values[usize::from(factor.observable)];
        let count = products(*factor);
        match factor.basis {
            Basis::Hermite => {
                let mut power = 1.0;
                for f in &mut functions[..count] {
                    *f = power;
                    power *= v;
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
                *to = f * x;
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

/// `out += leftᵀ right` over `rows` rows; `left` and `right` come with their padded row lengths.
/// With `upper`, tiles wholly below the diagonal are left alone.
#[inline(always)]
fn add_product(
    rows: usize,
    left: (&[f64], usize),
    right: (&[f64], usize),
    out: &mut [f64],
    upper: bool,
) {
    let ((left, p), (right, q)) = (left, right);
    let (left, right) = (&left[..rows * p], &right[..rows * q]);
    for i in (0..p).step_by(TILE.0) {
        for j in (0..q).step_by(TILE.1) {
            if upper && j + TILE.1 <= i {
                continue;
            }
            let mut sums = [[0.0; TILE.1]; TILE.0];
            for (l, r) in left.chunks_exact(p).zip(right.chunks_exact(q)) {
                let l: &[f64; TILE.0] = l[i..].first_chunk().unwrap_or(&[0.0; TILE.0]);
                let r: &[f64; TILE.1] = r[j..].first_chunk().unwrap_or(&[0.0; TILE.1]);
                for (sums, l) in sums.iter_mut().zip(l) {
                    for (sum, r) in sums.iter_mut().zip(r) {
                        *sum += l * r;
                    }
                }
            }
            for (k, sums) in sums.iter().enumerate() {
                let row = &mut out[(i + k) * q + j..][..TILE.1];
                for (to, sum) in row.iter_mut().zip(sums) {
                    *to += sum;
                }
            }
        }
    }
}

impl GramAccumulator {
    /// Sums for `outputs` targets over the distinct terms of `dictionary`.
    pub fn new(dictionary: &Dictionary, outputs: usize) -> Self {
        let distinct = distinct_terms(dictionary);
        let (n, m) = (padded(distinct.len(), TILE.1), padded(outputs, TILE.0));
        let moments = Moments::new(dictionary, distinct.len());
        let gram = if moments.is_some() { 0 } else { n * n };
        Self {
            dictionary: dictionary.clone(),
            arch: pulp::Arch::new(),
            outputs,
            pairs: 0,
            filled: 0,
            observables: dictionary.observables().len(),
            values: vec![0.0; CHUNK * dictionary.observables().len()],
            targets: vec![0.0; CHUNK * m],
            lifted: vec![0.0; CHUNK * n],
            dense: vec![0.0; dictionary.dense_terms()],
            moments,
            gram: vec![0.0; gram],
            cross: vec![0.0; m * n],
            distinct,
        }
    }

    /// Adds a snapshot pair: values of the observables and targets.
    #[inline]
    pub fn push(&mut self, values: &[f64], targets: &[f64]) {
        let (k, o) = (self.filled, self.observables);
        let m = padded(self.outputs, TILE.0);
        self.values[k * o..][..o].copy_from_slice(values);
        self.targets[k * m..][..self.outputs].copy_from_slice(targets);
        self.filled += 1;
        self.pairs += 1;
        if self.filled == CHUNK {
            self.flush();
        }
    }

    fn flush(&mut self) {
        let arch = self.arch;
        arch.dispatch(
            #[inline(always)]
            || self.add_chunk(),
        );
        self.filled = 0;
    }

    #[inline(always)]
    fn add_chunk(&mut self) {
        let rows = self.filled;
        let (n, m) = (padded(self.distinct.len(), TILE.1), padded(self.outputs, TILE.0));
        let samples = self.values.chunks_exact(self.observables.max(1)).take(rows);
        let all_distinct = self.distinct.len() == self.dictionary.dense_terms();
        if self.observables == 0 {
            for row in self.lifted.chunks_exact_mut(n) {
                row[0] = 1.0;
            }
        }
        for (values, row) in samples.zip(self.lifted.chunks_exact_mut(n)) {
            if all_distinct {
                self.dictionary.lift_dense(values, row);
            } else {
                self.dictionary.lift_dense(values, &mut self.dense);
                for (to, term) in row.iter_mut().zip(&self.distinct) {
                    *to = self.dense[*term];
                }
            }
        }
        add_product(rows, (&self.targets, m), (&self.lifted, n), &mut self.cross, false);
        match &mut self.moments {
            Some(moments) => moments.add(&self.values, self.observables, rows),
            None => add_product(rows, (&self.lifted, n), (&self.lifted, n), &mut self.gram, true),
        }
    }

    /// G and A.
    pub fn finish(mut self) -> NormalEquations {
        if self.filled > 0 {
            self.flush();
        }
        let (n, m) = (self.distinct.len(), self.outputs);
        let padded = padded(n, TILE.1);
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
                        gram[i * n + j] = self.gram[i.min(j) * padded + i.max(j)];
                    }
                }
            }
        }
        let mut cross = vec![0.0; n * m];
        for (i, row) in cross.chunks_exact_mut(m).enumerate() {
            for (j, to) in row.iter_mut().enumerate() {
                *to = self.cross[j * padded + i];
            }
        }
        NormalEquations { terms: n, outputs: m, pairs: self.pairs, gram, cross }
    }
}
