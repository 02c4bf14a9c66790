//! Dictionaries: direct sums of Kronecker blocks of Hermite (or Fourier) bases over observables.
//!
//! A *block* is the Kronecker product over its factors of `[H⁰(v), H¹(v), …, Hᵖ(v)]`, the first
//! factor being the slowest index (Shi & Karydis, "ACD-EDMD", RA-L 2021, Table I, with a free
//! order p per factor). `H` are the probabilists' Hermite polynomials, H⁰ = 1, H¹ = v,
//! Hⁿ⁺¹ = v Hⁿ − n Hⁿ⁻¹. On the circle a factor may be the Fourier basis
//! `[1, sin φ, cos φ, sin 2φ, cos 2φ, …]` instead. A *direct sum* of blocks is the union of their
//! distinct terms: a term belongs to the first block that holds it.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::capacity::{
    MAX_BASIS, MAX_BLOCK_FACTORS, MAX_BLOCKS, MAX_FACTORS, MAX_OBSERVABLES, MAX_ORDER, MAX_TERMS,
};
use crate::encoding::Reader;
use crate::{Number, Scalar};

/// What an observable reads. The number is the index of the state coordinate or input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Source {
    /// A coordinate on ℝ, in its unit.
    State(u8),
    /// Sine of a coordinate on S¹.
    Sin(u8),
    /// Cosine of a coordinate on S¹.
    Cos(u8),
    /// Change of a coordinate from the sample at the lag to the next one, wrapped on S¹; for the
    /// pose of an se(2)-symmetric model in the frame of the earlier sample. Its lag is at least 1.
    Increment(u8),
    /// An input, in its unit. Lag 0 is the input that acts over the step to be predicted.
    Input(u8),
}

/// A number read from the history of the robot: `v = (raw − centre) · gain`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Observable {
    /// What is read.
    pub source: Source,
    /// How many samples before the present one it is read.
    pub lag: u8,
    /// Subtracted from the raw value, in its unit; 0 for sine and cosine.
    pub centre: f32,
    /// Reciprocal of the scale, in one over the unit; 1 for sine and cosine.
    pub gain: f32,
}

impl Observable {
    /// `(raw − centre) · gain`.
    #[inline]
    pub fn value<S: Scalar>(&self, raw: S) -> S {
        (raw - S::from_f32(self.centre)) * S::from_f32(self.gain)
    }
}

/// The basis of a factor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Basis {
    /// `[H⁰(v), …, Hᵖ(v)]`, p + 1 functions.
    Hermite,
    /// `[1, sin φ, cos φ, …, sin pφ, cos pφ]`, 2p + 1 functions. The observable is the sine, and
    /// the next one in the list the cosine, of the same coordinate at the same lag.
    Fourier,
}

/// One factor of a Kronecker block.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Factor {
    /// Index into the observables.
    pub observable: u8,
    /// Hermite or Fourier.
    pub basis: Basis,
    /// Order p, from 1 to [`MAX_ORDER`].
    pub order: u8,
}

impl Factor {
    /// Number of basis functions: p + 1 or 2p + 1.
    #[inline]
    pub fn radix(self) -> usize {
        match self.basis {
            Basis::Hermite => usize::from(self.order) + 1,
            Basis::Fourier => 2 * usize::from(self.order) + 1,
        }
    }
}

/// A Kronecker block: how many of the factors are its own, and where it is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Block {
    /// Number of factors, taken from the list in order. None makes the block of the constant.
    pub factors: u8,
    /// Terms of a higher total degree (Hermite orders and harmonics added up) are absent. 0: none.
    pub max_degree: u8,
}

/// Why a dictionary is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum DictionaryError {
    /// There is no block, or the blocks do not use up the factors.
    Factors {
        /// Factors that the blocks claim.
        claimed: usize,
        /// Factors in the list.
        found: usize,
    },
    /// A block has more factors, a factor a higher order, or the whole more terms than fit.
    TooLarge {
        /// What is too large.
        field: &'static str,
        /// The capacity.
        capacity: usize,
        /// What was found.
        found: usize,
    },
    /// A factor names an observable that is not there, is used twice in its block, or does not suit
    /// its basis.
    Factor {
        /// Index of the factor.
        factor: usize,
    },
    /// An observable is listed twice.
    Duplicate {
        /// Index of the second one.
        observable: usize,
    },
}

/// A checked dictionary.
#[derive(Clone, Debug, PartialEq)]
pub struct Dictionary {
    observables: Vec<Observable, MAX_OBSERVABLES>,
    factors: Vec<Factor, MAX_FACTORS>,
    blocks: Vec<Block, MAX_BLOCKS>,
    dense_terms: u16,
}

impl Dictionary {
    /// Checks the parts of a dictionary against each other and against the capacities.
    ///
    /// # Errors
    /// [`DictionaryError`] says which part does not fit.
    pub fn new(
        observables: Vec<Observable, MAX_OBSERVABLES>,
        factors: Vec<Factor, MAX_FACTORS>,
        blocks: Vec<Block, MAX_BLOCKS>,
    ) -> Result<Self, DictionaryError> {
        let mut dictionary = Self::unchecked(observables, factors, blocks);
        dictionary.check::<DictionaryError>()?;
        Ok(dictionary)
    }

    /// Parts of which nothing is known yet, to be [checked](Self::check).
    pub(crate) fn unchecked(
        observables: Vec<Observable, MAX_OBSERVABLES>,
        factors: Vec<Factor, MAX_FACTORS>,
        blocks: Vec<Block, MAX_BLOCKS>,
    ) -> Self {
        Self { observables, factors, blocks, dense_terms: 0 }
    }

    /// A dictionary of nothing, to be [read](Self::read) over.
    pub(crate) const fn empty() -> Self {
        Self { observables: Vec::new(), factors: Vec::new(), blocks: Vec::new(), dense_terms: 0 }
    }

    pub(crate) fn clear(&mut self) {
        self.observables.clear();
        self.factors.clear();
        self.blocks.clear();
        self.dense_terms = 0;
    }

    /// The parts of a dictionary as the metadata hold them, to be [checked](Self::check).
    #[inline(never)]
    pub(crate) fn read(&mut self, reader: &mut Reader<'_>) {
        reader.list(&mut self.observables, |reader| {
            let kind = reader.variant(5);
            let (index, lag) = (reader.byte(), reader.byte());
            let source = match kind {
                0 => Source::State(index),
                1 => Source::Sin(index),
                2 => Source::Cos(index),
                3 => Source::Increment(index),
                _ => Source::Input(index),
            };
            Observable { source, lag, centre: reader.number(), gain: reader.number() }
        });
        reader.list(&mut self.factors, |reader| {
            let observable = reader.byte();
            let basis = match reader.variant(2) {
                0 => Basis::Hermite,
                _ => Basis::Fourier,
            };
            Factor { observable, basis, order: reader.byte() }
        });
        reader.list(&mut self.blocks, |reader| {
            let (factors, max_degree) = (reader.byte(), reader.byte());
            Block { factors, max_degree }
        });
    }

    /// Checks the parts. `E` is the error of whoever asks.
    #[inline(never)]
    pub(crate) fn check<E: From<DictionaryError>>(&mut self) -> Result<(), E> {
        let Self { observables, factors, blocks, .. } = self;
        for (i, o) in observables.iter().enumerate() {
            let earlier = observables.get(..i).unwrap_or(&[]);
            if earlier.iter().any(|e| (e.source, e.lag) == (o.source, o.lag)) {
                return Err(DictionaryError::Duplicate { observable: i }.into());
            }
        }
        // Counts of what is in lists are small: nothing wraps.
        let mut claimed = 0_usize;
        // All blocks together have less than 2⁶⁴ terms, whatever they are.
        let mut dense_terms = 0_u64;
        for block in &*blocks {
            let count = usize::from(block.factors);
            if count > MAX_BLOCK_FACTORS {
                return Err(DictionaryError::TooLarge {
                    field: "factors of a block",
                    capacity: MAX_BLOCK_FACTORS,
                    found: count,
                }
                .into());
            }
            let end = claimed.wrapping_add(count);
            let Some(own) = factors.get(claimed..end) else {
                return Err(DictionaryError::Factors { claimed: end, found: factors.len() }.into());
            };
            let mut size = 1_u64;
            for (i, factor) in own.iter().enumerate() {
                let bad = DictionaryError::Factor { factor: claimed.wrapping_add(i) };
                if factor.order == 0 || factor.order > MAX_ORDER {
                    return Err(DictionaryError::TooLarge {
                        field: "order of a factor",
                        capacity: MAX_ORDER.into(),
                        found: factor.order.into(),
                    }
                    .into());
                }
                let Some(o) = observables.get(usize::from(factor.observable)) else {
                    return Err(bad.into());
                };
                if factor.basis == Basis::Fourier {
                    let cosine = observables.get(usize::from(factor.observable).wrapping_add(1));
                    let pair = match (o.source, cosine) {
                        (Source::Sin(i), Some(c)) => c.source == Source::Cos(i) && c.lag == o.lag,
                        _ => false,
                    };
                    if !pair {
                        return Err(bad.into());
                    }
                }
                let earlier = own.get(..i).unwrap_or(&[]);
                if earlier.iter().any(|e| overlap(*e, *factor)) {
                    return Err(bad.into());
                }
                size = size.wrapping_mul(factor.radix() as u64);
            }
            dense_terms = dense_terms.wrapping_add(size);
            claimed = end;
        }
        if blocks.is_empty() || claimed != factors.len() {
            return Err(DictionaryError::Factors { claimed, found: factors.len() }.into());
        }
        match u16::try_from(dense_terms) {
            Ok(n) if usize::from(n) <= MAX_TERMS => {
                self.dense_terms = n;
                Ok(())
            }
            _ => {
                let found = usize::try_from(dense_terms).unwrap_or(usize::MAX);
                let (field, capacity) = ("terms", MAX_TERMS);
                Err(DictionaryError::TooLarge { field, capacity, found }.into())
            }
        }
    }

    /// The observables, in the order in which their values are laid out.
    #[inline]
    pub fn observables(&self) -> &[Observable] {
        &self.observables
    }

    /// The blocks, each with its factors.
    #[inline]
    pub fn blocks(&self) -> impl Iterator<Item = (Block, &[Factor])> + Clone {
        let mut rest: &[Factor] = &self.factors;
        self.blocks.iter().map(move |block| {
            let (own, others) =
                rest.split_at_checked(usize::from(block.factors)).unwrap_or((rest, &[]));
            rest = others;
            (*block, own)
        })
    }

    /// The factors of all blocks, in order.
    #[inline]
    pub(crate) fn factors(&self) -> &[Factor] {
        &self.factors
    }

    /// Number of basis functions of all factors, the constant not counted.
    pub fn functions(&self) -> usize {
        self.factors.iter().fold(0, |sum: usize, f| sum.wrapping_add(f.radix()).wrapping_sub(1))
    }

    /// Which basis function of which factor has an index among the [`functions`](Self::functions)
    /// of all factors, in order: `(factor, digit)`, the digit counted from 1.
    pub fn function(&self, index: usize) -> Option<(Factor, usize)> {
        let mut index = index;
        for factor in &self.factors {
            let digit = index.saturating_add(1);
            if digit < factor.radix() {
                return Some((*factor, digit));
            }
            index = digit.saturating_sub(factor.radix());
        }
        None
    }

    /// Terms of all blocks one after the other: the number of coefficients per output in the blob of
    /// a dense model.
    #[inline]
    pub fn dense_terms(&self) -> usize {
        self.dense_terms.into()
    }

    /// Which factor of which basis function makes up a dense term: for each factor of its block
    /// with a digit above 0, `(factor, digit)`. Returns the index of the block as well.
    pub fn term(&self, dense: usize) -> Option<(usize, Vec<(Factor, usize), MAX_BLOCK_FACTORS>)> {
        let mut first = 0_usize;
        for (b, (_, own)) in self.blocks().enumerate() {
            let size = block_size(own);
            let mut index = dense.checked_sub(first)?;
            if index < size {
                let mut digits = Vec::new();
                let mut stride = size;
                for factor in own {
                    stride = stride.checked_div(factor.radix()).unwrap_or(1).max(1);
                    let digit = index.checked_div(stride).unwrap_or(0);
                    index = index.checked_rem(stride).unwrap_or(0);
                    if digit > 0 {
                        digits.push((*factor, digit)).ok()?;
                    }
                }
                return Some((b, digits));
            }
            first = first.saturating_add(size);
        }
        None
    }

    /// Whether a dense term is one of the distinct terms: not cut off by its block's degree, and
    /// not held by an earlier block.
    pub fn is_distinct(&self, dense: usize) -> bool {
        let Some((block, term)) = self.term(dense) else { return false };
        self.blocks()
            .enumerate()
            .take(block.saturating_add(1))
            .all(|(b, (limits, own))| self.holds(limits, own, &term) == (b == block))
    }

    /// Whether a block holds a term.
    fn holds(&self, block: Block, own: &[Factor], term: &[(Factor, usize)]) -> bool {
        let degree: usize = term.iter().map(|(f, digit)| degree(f.basis, *digit)).sum();
        if block.max_degree > 0 && degree > usize::from(block.max_degree) {
            return false;
        }
        let mut used: Vec<usize, MAX_BLOCK_FACTORS> = Vec::new();
        term.iter().all(|(factor, digit)| {
            own.iter().enumerate().any(|(i, candidate)| {
                !used.contains(&i) && contains(*candidate, *factor, *digit) && used.push(i).is_ok()
            })
        })
    }

    /// Writes every term of every block: the Kronecker products, first factor slowest.
    ///
    /// `values` are the observables, shape `[observables]`; `terms` has shape `[dense_terms]`.
    /// Terms that are not [distinct](Self::is_distinct) are written too. Returns the number written;
    /// a `terms` that is too short is filled as far as whole blocks go.
    #[inline(always)]
    pub fn lift_dense<S: Number>(&self, values: &[S], terms: &mut [S]) -> usize {
        let mut written = 0_usize;
        let mut rest = terms;
        for (_, own) in self.blocks() {
            let size = block_size(own);
            let Some((block, others)) = rest.split_at_mut_checked(size) else { break };
            self.lift_factors(own, values, block);
            written = written.saturating_add(size);
            rest = others;
        }
        written
    }

    /// Writes the Kronecker product of the bases of `factors`, the first one slowest, into `terms`,
    /// shape `[product of the radices]`.
    #[inline(always)]
    pub fn lift_factors<S: Number>(&self, factors: &[Factor], values: &[S], terms: &mut [S]) {
        let mut basis = [S::ZERO; MAX_BASIS];
        if let Some(constant) = terms.first_mut() {
            *constant = S::ONE;
        }
        let mut len = 1_usize;
        for factor in factors.iter().rev() {
            let functions = basis_functions(*factor, values, &mut basis);
            let Some((inner, outer)) = terms.split_at_mut_checked(len) else { return };
            for (chunk, h) in outer.chunks_exact_mut(len.max(1)).zip(functions.iter().skip(1)) {
                for (term, x) in chunk.iter_mut().zip(inner.iter()) {
                    *term = *h * *x;
                }
            }
            len = len.saturating_mul(factor.radix());
        }
    }

    /// Writes the distinct terms Ψ in order and returns how many there are; `scratch` holds
    /// [`dense_terms`](Self::dense_terms) numbers. A `lifted` that is too short is filled.
    pub fn lift<S: Number>(&self, values: &[S], scratch: &mut [S], lifted: &mut [S]) -> usize {
        self.lift_dense(values, scratch);
        let distinct =
            scratch.iter().enumerate().filter(|(i, _)| self.is_distinct(*i)).map(|(_, term)| *term);
        let mut count = 0_usize;
        for (to, term) in lifted.iter_mut().zip(distinct) {
            *to = term;
            count = count.saturating_add(1);
        }
        count
    }
}

/// Number of terms of a block: the product of the radices of its factors.
#[inline]
pub fn block_size(factors: &[Factor]) -> usize {
    // At most MAX_TERMS in a checked dictionary.
    factors.iter().fold(1, |size: usize, factor| size.wrapping_mul(factor.radix()))
}

/// `[H⁰(v), H¹(v), …]`, the probabilists' Hermite polynomials, as far as `out` goes
/// (Hⁿ⁺¹ = v Hⁿ − n Hⁿ⁻¹).
///
/// ```
/// let mut h = [0.0_f64; 5];
/// firmware_core::dictionary::hermite(2.0, &mut h);
/// assert_eq!(h, [1.0, 2.0, 3.0, 2.0, -5.0]); // 1, v, v² − 1, v³ − 3v, v⁴ − 6v² + 3
/// ```
#[inline(always)]
pub fn hermite<S: Number>(v: S, out: &mut [S]) {
    let (mut previous, mut current) = (S::ZERO, S::ONE);
    let mut n = S::ZERO;
    for h in out {
        *h = current;
        let next = v * current - n * previous;
        previous = current;
        current = next;
        n = n + S::ONE;
    }
}

/// `[1, sin φ, cos φ, sin 2φ, cos 2φ, …]` from sine and cosine, as far as `out` goes, by the angle
/// addition theorem: no trigonometric function is called.
///
/// ```
/// let (s, c) = (0.6_f64, 0.8);
/// let mut f = [0.0; 5];
/// firmware_core::dictionary::fourier(s, c, &mut f);
/// assert_eq!(f[..3], [1.0, 0.6, 0.8]);
/// assert!((f[3] - 2.0 * s * c).abs() < 1e-15 && (f[4] - (c * c - s * s)).abs() < 1e-15);
/// ```
#[inline(always)]
pub fn fourier<S: Number>(sin: S, cos: S, out: &mut [S]) {
    let Some((constant, harmonics)) = out.split_first_mut() else { return };
    *constant = S::ONE;
    let (mut s, mut c) = (sin, cos);
    for pair in harmonics.chunks_mut(2) {
        for (to, value) in pair.iter_mut().zip([s, c]) {
            *to = value;
        }
        (s, c) = turn((s, c), (sin, cos));
    }
}

/// Sine and cosine of the sum of two angles.
#[inline(always)]
pub(crate) fn turn<S: Number>((s, c): (S, S), (sin, cos): (S, S)) -> (S, S) {
    (s * cos + c * sin, c * cos - s * sin)
}

/// The basis functions of a factor at the values of the observables, in `out`.
#[inline(always)]
pub(crate) fn basis_functions<'o, S: Number>(
    factor: Factor,
    values: &[S],
    out: &'o mut [S; MAX_BASIS],
) -> &'o [S] {
    let radix = factor.radix();
    let Some(functions) = out.get_mut(..radix) else { return &[] };
    let (v, next) = observable_pair(factor, values);
    match factor.basis {
        Basis::Hermite => hermite(v, functions),
        Basis::Fourier => fourier(v, next, functions),
    }
    functions
}

/// The value of a factor's observable and of the one behind it.
#[inline]
pub(crate) fn observable_pair<S: Copy + Default>(factor: Factor, values: &[S]) -> (S, S) {
    let mut from = values.iter().skip(factor.observable.into()).copied();
    (from.next().unwrap_or_default(), from.next().unwrap_or_default())
}

/// Degree of a basis function: its Hermite order or its harmonic.
fn degree(basis: Basis, digit: usize) -> usize {
    match basis {
        Basis::Hermite => digit,
        Basis::Fourier => digit.div_ceil(2),
    }
}

/// Whether two factors of one block, of observables that are there, read the same one.
fn overlap(a: Factor, b: Factor) -> bool {
    let last = |f: Factor| f.observable.wrapping_add((f.basis == Basis::Fourier).into());
    a.observable <= last(b) && b.observable <= last(a)
}

/// Whether the basis of `candidate` has the function that digit `digit` of `factor` stands for.
/// Sine and cosine are the first harmonics of a Fourier basis and H¹ of their observable alike.
fn contains(candidate: Factor, factor: Factor, digit: usize) -> bool {
    // A primitive function: the observable it is H¹ of, or a higher one of the factor's own kind.
    let (first, n) = match factor.basis {
        Basis::Hermite => (factor.observable, digit),
        Basis::Fourier if digit % 2 == 1 => (factor.observable, digit.div_ceil(2)),
        Basis::Fourier => (factor.observable.saturating_add(1), digit.div_ceil(2)),
    };
    let same_kind = factor.basis == candidate.basis || n == 1;
    let reads = match candidate.basis {
        Basis::Hermite => candidate.observable == first,
        Basis::Fourier => {
            candidate.observable == first || candidate.observable.checked_add(1) == Some(first)
        }
    };
    same_kind && reads && n <= usize::from(candidate.order)
}
