//! Evaluating the operator: the contraction of a Kronecker block with its coefficients.
//!
//! The coefficients of one output over a block are a tensor with one axis per factor, the first
//! factor slowest. Every axis is folded in turn: a polynomial factor by Horner's scheme
//! `lo + v · hi` in monomials, a Fourier factor by a dot product from the last harmonic to the
//! first. No term of the dictionary is ever formed: a block of n terms costs n − 1 multiply-adds per
//! output.
//!
//! Multiplication and addition are separate roundings on every machine, and the order is fixed, so
//! that all kernels give the same bits: first the last factors, as many as have together at most 16
//! coefficients (what a Cortex-M4F loads into its registers at once), the slowest of them first;
//! then the others, the fastest first.
//!
//! # Sparse models
//!
//! A [sparse](crate::sparse) model is evaluated in this order, which defines its result to the bit;
//! every product and every sum is rounded on its own.
//!
//! 1. The functions of all factors in order: of a polynomial factor v and vⁿ = vⁿ⁻¹ · v; of a Fourier
//!    factor s₁ = sin φ, c₁ = cos φ as observed and
//!    sₙ₊₁ = sₙ · c₁ + cₙ · s₁, cₙ₊₁ = cₙ · c₁ − sₙ · s₁.
//! 2. The terms in order: t₀ = 1 and tₖ = t_p · f_g for entry k = (p, g). A product with the constant
//!    is the function itself.
//! 3. Every output: c₀, then c₀ + c₁ · t₁, and so on in the order of the terms.
//!
//! A [`Program`] is the chain translated into [registers](crate::registers) when a model is loaded:
//! every power and every term is the product of two of them. A term is made once and multiplied
//! with the coefficients of up to four outputs while it is at hand.

use core::cell::Cell;

use heapless::Vec;

// Sizes of a checked dictionary are small numbers: the wrapping arithmetic below never wraps, and is
// there because it cannot panic.

use crate::capacity::{
    MAX_BASIS, MAX_BLOCK_FACTORS, MAX_FUNCTIONS, MAX_OBSERVABLES, MAX_SPARSE_TERMS, REGISTERS,
};
use crate::dictionary::{
    Basis, DictionaryError, Factor, Observable, basis_functions, block_size, observable_pair, turn,
};
use crate::model::{ModelError, Structure};
use crate::registers::{Cells, INPUTS, Layout, NOWHERE, ONE, Registers};
use crate::sparse::{SparseError, SparseTerms};
use crate::{Number, Scalar};

/// Coefficients of the last factors, which are folded slowest first.
const AT_ONCE: usize = 16;
/// Coefficients are folded on the stack in tiles that have at most this many results after the
/// first axis.
const ROOM: usize = 64;
/// Room for the Fourier functions of a block: the radices of a block whose product is at most
/// [`MAX_TERMS`](crate::capacity::MAX_TERMS) add up to less.
const FUNCTIONS: usize = 64;

/// A factor as the contraction sees it.
#[derive(Clone, Copy, Debug)]
enum Fold<'f, S> {
    /// Horner's scheme in `v` over `radix` coefficients.
    Polynomial { radix: usize, v: S },
    /// A dot product with these functions.
    Functions { functions: &'f [S] },
}

/// A factor and how far apart the coefficients are that it folds.
type Axis<'f, S> = (Fold<'f, S>, usize);

impl<S: Scalar> Fold<'_, S> {
    #[inline]
    fn radix(&self) -> usize {
        match self {
            Self::Polynomial { radix, .. } => *radix,
            Self::Functions { functions } => functions.len(),
        }
    }

    /// One group of coefficients, or of folded results, to one number: from the last to the first.
    #[inline]
    fn group(&self, values: impl DoubleEndedIterator<Item = S>) -> S {
        let mut values = values.rev();
        match self {
            Self::Polynomial { v, .. } => {
                let last = values.next().unwrap_or_default();
                values.fold(last, |hi, lo| lo + *v * hi)
            }
            Self::Functions { functions } => {
                let mut functions = functions.iter().rev();
                let first = functions.next().copied().unwrap_or_default();
                let last = first * values.next().unwrap_or_default();
                values.zip(functions).fold(last, |sum, (c, h)| sum + *h * c)
            }
        }
    }

    /// Folds the axis of `from`, shape `[groups, radix, stride]`, into `to`, shape
    /// `[groups, stride]`; returns how many numbers that is.
    #[inline]
    fn level(&self, stride: usize, from: &[S], to: &mut [S]) -> usize {
        match (self, stride) {
            (Self::Polynomial { radix: 2, v }, 8) => rows::<S, 2, 8>(*v, from, to),
            (Self::Polynomial { radix: 2, v }, 4) => rows::<S, 2, 4>(*v, from, to),
            (Self::Polynomial { radix: 2, v }, 2) => rows::<S, 2, 2>(*v, from, to),
            (Self::Polynomial { radix: 2, v }, 1) => rows::<S, 2, 1>(*v, from, to),
            (Self::Polynomial { radix: 3, v }, 3) => rows::<S, 3, 3>(*v, from, to),
            (Self::Polynomial { radix: 3, v }, 1) => rows::<S, 3, 1>(*v, from, to),
            (Self::Polynomial { radix: 4, v }, 4) => rows::<S, 4, 4>(*v, from, to),
            (Self::Polynomial { radix: 4, v }, 1) => rows::<S, 4, 1>(*v, from, to),
            (_, 1) => {
                let groups = from.chunks_exact(self.radix().max(1));
                let count = groups.len();
                for (out, group) in to.iter_mut().zip(groups) {
                    *out = self.group(group.iter().copied());
                }
                count
            }
            _ => {
                let stride = stride.max(1);
                let groups = from.chunks_exact(self.radix().wrapping_mul(stride).max(1));
                let count = groups.len().wrapping_mul(stride);
                for (out, group) in to.chunks_exact_mut(stride).zip(groups) {
                    self.rows(group.chunks_exact(stride), out);
                }
                count
            }
        }
    }

    /// [`group`](Self::group) for rows of numbers at once.
    #[inline]
    fn rows<'r>(&self, rows: impl DoubleEndedIterator<Item = &'r [S]>, out: &mut [S]) {
        let mut rows = rows.rev();
        let last = rows.next().unwrap_or(&[]);
        match self {
            Self::Polynomial { v, .. } => {
                for (to, c) in out.iter_mut().zip(last) {
                    *to = *c;
                }
                for row in rows {
                    for (hi, lo) in out.iter_mut().zip(row) {
                        *hi = *lo + *v * *hi;
                    }
                }
            }
            Self::Functions { functions } => {
                let mut functions = functions.iter().rev();
                let first = functions.next().copied().unwrap_or_default();
                for (to, c) in out.iter_mut().zip(last) {
                    *to = first * *c;
                }
                for (row, h) in rows.zip(functions) {
                    for (sum, c) in out.iter_mut().zip(row) {
                        *sum = *sum + *h * *c;
                    }
                }
            }
        }
    }
}

/// Room for the results of a tile after its first and its second axis.
#[derive(Clone, Debug)]
pub(crate) struct Scratch<S> {
    first: [S; ROOM],
    second: [S; ROOM / 2],
}

impl<S: Scalar> Scratch<S> {
    pub(crate) fn new() -> Self {
        Self { first: [S::ZERO; ROOM], second: [S::ZERO; ROOM / 2] }
    }
}

/// [`Fold::level`] for Horner's scheme with a known shape: unrolled and vectorised by the compiler.
#[inline(always)]
fn rows<S: Scalar, const RADIX: usize, const STRIDE: usize>(
    v: S,
    from: &[S],
    to: &mut [S],
) -> usize {
    let (rows, _) = from.as_chunks::<STRIDE>();
    let (groups, _) = rows.as_chunks::<RADIX>();
    let (to, _) = to.as_chunks_mut::<STRIDE>();
    for (out, group) in to.iter_mut().zip(groups) {
        // The same operations column by column where there are no vector registers: a row of sums
        // would go through memory.
        if cfg!(target_arch = "arm") {
            match &group[..] {
                [a, b] => {
                    for ((to, a), b) in out.iter_mut().zip(a).zip(b) {
                        *to = *a + v * *b;
                    }
                    continue;
                }
                [a, b, c] => {
                    for (((to, a), b), c) in out.iter_mut().zip(a).zip(b).zip(c) {
                        *to = *a + v * (*b + v * *c);
                    }
                    continue;
                }
                [a, b, c, d] => {
                    for ((((to, a), b), c), d) in out.iter_mut().zip(a).zip(b).zip(c).zip(d) {
                        *to = *a + v * (*b + v * (*c + v * *d));
                    }
                    continue;
                }
                _ => {}
            }
        }
        let mut sum = group.last().copied().unwrap_or([S::ZERO; STRIDE]);
        for row in group.iter().rev().skip(1) {
            for (hi, lo) in sum.iter_mut().zip(row) {
                *hi = *lo + v * *hi;
            }
        }
        *out = sum;
    }
    groups.len().wrapping_mul(STRIDE)
}

/// Adds the contributions of one block to every output.
///
/// `coefficients` has the outputs of a model one after the other, `stride` apart; the block's own
/// start at the beginning of the slice. `outputs` has shape `[outputs]`. Returns how many
/// coefficients the block has per output.
#[inline]
pub(crate) fn contract<S: Scalar>(
    factors: &[Factor],
    values: &[S],
    coefficients: &[S],
    stride: usize,
    outputs: &mut [S],
    scratch: &mut Scratch<S>,
) -> usize {
    let (mut size, mut last) = (1_usize, 0_usize);
    for factor in factors.iter().rev() {
        let larger = size.wrapping_mul(factor.radix());
        if larger > AT_ONCE {
            break;
        }
        (size, last) = (larger, last.wrapping_add(1));
    }
    let (others, last) =
        factors.split_at_checked(factors.len().saturating_sub(last)).unwrap_or((factors, &[]));

    // A checked dictionary has no more factors in a block, and no more functions in its factors.
    let mut functions: Vec<S, FUNCTIONS> = Vec::new();
    if factors.iter().any(|f| f.basis == Basis::Fourier) {
        for factor in last.iter().chain(others.iter().rev()).filter(|f| f.basis == Basis::Fourier) {
            let mut basis = [S::ZERO; MAX_BASIS];
            let _ = functions.extend_from_slice(basis_functions(*factor, values, &mut basis));
        }
    }
    let mut functions = functions.as_slice();
    let mut fold = |factor: &Factor, radix: usize| match factor.basis {
        Basis::Hermite => Fold::Polynomial { radix, v: observable_pair(*factor, values).0 },
        Basis::Fourier => {
            let (own, others) = functions.split_at_checked(radix).unwrap_or((functions, &[]));
            functions = others;
            Fold::Functions { functions: own }
        }
    };
    let mut folds: Vec<Axis<'_, S>, MAX_BLOCK_FACTORS> = Vec::new();
    let mut rest = last;
    while let [factor, faster @ ..] = rest {
        let _ = folds.push((fold(factor, factor.radix()), block_size(faster)));
        rest = faster;
    }
    let (mut tile, mut outer) = (folds.first().map_or(0, |(fold, _)| fold.radix() * ROOM), 0_usize);
    for factor in others.iter().rev() {
        let radix = factor.radix();
        if tile == 0 {
            tile = radix.wrapping_mul(ROOM);
        }
        size = size.wrapping_mul(radix);
        outer = outer.wrapping_add(usize::from(size > tile));
        let _ = folds.push((fold(factor, radix), 1));
    }
    let (inner, outer) = folds.split_at(folds.len().saturating_sub(outer));
    if size == stride && size.wrapping_mul(outputs.len()) <= tile {
        // The only block, and small: the outputs are one more axis, which is not folded.
        contract_tile(inner, coefficients, outputs, scratch);
        return size;
    }
    for (output, row) in outputs.chunks_mut(1).zip(coefficients.chunks(stride.max(1))) {
        let block = row.get(..size).unwrap_or(&[]);
        if outer.is_empty() {
            contract_tile(inner, block, output, scratch);
        } else if let [output] = output {
            *output = *output + contract_tiles(inner, outer, block, scratch);
        }
    }
    size
}

/// Folds the outer axes (the last of `outer` is the slowest) over the results of the tiles.
fn contract_tiles<S: Scalar>(
    inner: &[Axis<'_, S>],
    outer: &[Axis<'_, S>],
    c: &[S],
    scratch: &mut Scratch<S>,
) -> S {
    match outer.split_last() {
        None => {
            let mut result = [S::ZERO];
            contract_tile(inner, c, &mut result, scratch);
            let [result] = result;
            result
        }
        Some(((slowest, _), faster)) => {
            let size = c.len().checked_div(slowest.radix()).unwrap_or(0).max(1);
            let parts = c.chunks_exact(size);
            slowest.group(parts.map(|part| contract_tiles(inner, faster, part, scratch)))
        }
    }
}

/// Folds all axes of a tile in the order of `axes` and adds the results.
#[inline]
fn contract_tile<S: Scalar>(
    axes: &[Axis<'_, S>],
    c: &[S],
    outputs: &mut [S],
    scratch: &mut Scratch<S>,
) {
    let (mut from, mut to): (&mut [S], &mut [S]) = (&mut scratch.first, &mut scratch.second);
    let results = match axes.split_first() {
        None => c,
        Some(((fold, stride), others)) => {
            let mut len = fold.level(*stride, c, from);
            for (fold, stride) in others {
                len = fold.level(*stride, from.get(..len).unwrap_or(&[]), to);
                core::mem::swap(&mut from, &mut to);
            }
            from
        }
    };
    for (output, result) in outputs.iter_mut().zip(results) {
        *output = *output + *result;
    }
}

/// The functions of the factors of a sparse model.
pub(crate) type FunctionValues<S> = Vec<S, MAX_FUNCTIONS>;
/// The terms of a sparse model, the constant first.
pub(crate) type TermValues<S> = Vec<S, { MAX_SPARSE_TERMS + 1 }>;

/// Appends the functions of the factors, a checked number of them.
#[inline(always)]
pub(crate) fn functions<S: Number>(
    factors: &[Factor],
    values: &[S],
    functions: &mut FunctionValues<S>,
) {
    for factor in factors {
        let (v, next) = observable_pair(*factor, values);
        match factor.basis {
            Basis::Hermite => {
                let mut power = v;
                for _ in 1..factor.order {
                    let _ = functions.push(power);
                    power = power * v;
                }
                let _ = functions.push(power);
            }
            Basis::Fourier => {
                let (mut s, mut c) = (v, next);
                for _ in 0..factor.order {
                    let _ = functions.push(s);
                    let _ = functions.push(c);
                    (s, c) = turn((s, c), (v, next));
                }
            }
        }
    }
}

/// Appends the constant and the terms of a checked chain.
#[inline(always)]
pub(crate) fn chain<S: Number>(entries: &[[u8; 2]], functions: &[S], terms: &mut TermValues<S>) {
    let _ = terms.push(S::ONE);
    for [parent, function] in entries {
        let parent = terms.get(usize::from(*parent)).copied().unwrap_or_default();
        let function = functions.get(usize::from(*function)).copied().unwrap_or_default();
        let _ = terms.push(parent * function);
    }
}

/// A Fourier factor of a sparse model: the registers of sine and cosine, and the order, 2 or more.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Harmonics {
    sin: u8,
    cos: u8,
    order: u8,
}

/// Outputs that are summed at once while the terms are made; as many as leave the processor registers
/// for everything else.
const TOGETHER: usize = 4;

/// Sums terms times coefficients for some outputs at once, so that every term is loaded once: the
/// name of a term and how it is zipped with its coefficients; for every output the names of it, its
/// coefficients and its sum.
macro_rules! sum {
    ($coefficients:ident, $outputs:ident, $count:expr, $terms:expr, $term:ident, $zipped:pat,
     $($output:ident $row:ident $sum:ident),+) => {{
        let mut rows = $coefficients.chunks_exact($count.wrapping_add(1).max(1));
        $(let Some([$sum, $row @ ..]) = rows.next() else { return };
        let mut $sum = *$sum;)+
        for $zipped in $terms$(.zip($row))+ {
            $($sum = $sum + *$row * $term;)+
        }
        if let [$($output,)+ ..] = $outputs {
            $(*$output = $sum;)+
        }
    }};
}

/// A function that makes the terms and the first outputs from them.
macro_rules! make {
    ($name:ident, $term:ident, $zipped:pat, $($output:ident $row:ident $sum:ident),+) => {
        #[inline(never)]
        fn $name<S: Scalar>(
            cells: Cells<'_, S>,
            products: &[[u8; 2]],
            made: &[Cell<S>],
            coefficients: &[S],
            outputs: &mut [S],
        ) {
            let terms = products.iter().zip(made).map(|([a, b], to)| {
                let term = cells.get(*a) * cells.get(*b);
                to.set(term);
                term
            });
            sum!(coefficients, outputs, products.len(), terms, $term, $zipped,
                $($output $row $sum),+);
        }
    };
}

/// How a step computes what is not in the history. Everything has a register, one after the other:
///
/// 1. observables that are centred or scaled; of a dense model all observables in order;
/// 2. harmonics of a sparse model from the second on, then its powers from the second on, then its
///    terms without the constant.
///
/// Powers and terms are products of two registers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Program {
    /// The first register that is computed.
    first: u8,
    /// Observables with a register of their own: index, and register of the raw value.
    scaled: Vec<[u8; 2], MAX_OBSERVABLES>,
    harmonics: Vec<Harmonics, { MAX_FUNCTIONS / 4 }>,
    products: Vec<[u8; 2], { REGISTERS - INPUTS as usize }>,
    /// Products that are powers, and not terms.
    powers: u8,
}

/// A register, as far as it is one: that there are too many is noticed at the end.
fn byte(register: usize) -> u8 {
    u8::try_from(register).unwrap_or(NOWHERE)
}

/// Functions of a sparse model whose registers are looked up at once while its program is made.
const TABLE: usize = 24;

impl Program {
    /// Of nothing.
    pub(crate) const fn empty() -> Self {
        Self {
            first: 0,
            scaled: Vec::new(),
            harmonics: Vec::new(),
            products: Vec::new(),
            powers: 0,
        }
    }

    pub(crate) fn clear(&mut self) {
        (self.first, self.powers) = (0, 0);
        self.scaled.clear();
        self.harmonics.clear();
        self.products.clear();
    }

    /// The register of an observable.
    #[inline(never)]
    fn observed(&self, layout: &Layout, observable: u8) -> u8 {
        // They are in order, so that it cannot be further behind.
        let own = self.scaled.get(..=usize::from(observable)).unwrap_or(&self.scaled);
        match own.iter().rposition(|[index, _]| *index == observable) {
            Some(place) => self.first.saturating_add(place as u8),
            None => layout.observables.get(usize::from(observable)).copied().unwrap_or(NOWHERE),
        }
    }

    /// Becomes that of a structure and the terms that have been checked against its dictionary. It is
    /// made where it lies: on the stack it would take a kilobyte.
    #[inline(never)]
    pub(crate) fn fill<E: From<ModelError>>(
        &mut self,
        structure: &Structure<'_>,
        terms: Option<SparseTerms<'_>>,
    ) -> Result<(), E> {
        let (layout, dictionary) = (structure.layout(), structure.dictionary());
        self.clear();
        self.first = layout.end;
        let observables = dictionary.observables().iter().zip(&layout.observables);
        for (index, (o, register)) in observables.enumerate() {
            if terms.is_none() || (o.centre, o.gain) != (0.0, 1.0) {
                let _ = self.scaled.push([index as u8, *register]);
            }
        }
        let mut next = usize::from(self.first).saturating_add(self.scaled.len());
        let Some(terms) = terms else {
            return if next <= REGISTERS {
                Ok(())
            } else {
                let (field, capacity, found) = ("registers", REGISTERS, next);
                Err(ModelError::Dictionary(DictionaryError::TooLarge { field, capacity, found })
                    .into())
            };
        };
        let factors = dictionary.factors();
        let first_harmonic = next;
        for factor in factors.iter().filter(|f| f.basis == Basis::Fourier && f.order > 1) {
            let (sin, cos) = (
                self.observed(layout, factor.observable),
                self.observed(layout, factor.observable.saturating_add(1)),
            );
            let order = factor.order;
            let _ = self.harmonics.push(Harmonics { sin, cos, order });
            next = next.saturating_add(usize::from(order).saturating_sub(1).saturating_mul(2));
        }
        let first_power = next;
        for factor in factors.iter().filter(|f| f.basis == Basis::Hermite) {
            let v = self.observed(layout, factor.observable);
            let mut power = v;
            for _ in 1..factor.order {
                let _ = self.products.push([power, v]);
                power = byte(next);
                next = next.saturating_add(1);
            }
        }
        self.powers = self.products.len() as u8;
        let first_term = next;
        for [parent, _] in terms.entries() {
            let parent = match parent.checked_sub(1) {
                None => ONE,
                Some(earlier) => byte(first_term.saturating_add(earlier.into())),
            };
            // The register of its function follows.
            let _ = self.products.push([parent, NOWHERE]);
            next = next.saturating_add(1);
        }
        if next > REGISTERS {
            let (field, capacity, found) = ("registers", REGISTERS, next);
            return Err(ModelError::Sparse(SparseError::TooLarge { field, capacity, found }).into());
        }
        // Some functions at a time: the registers of all would be half of what loading takes of the stack.
        for from in (0..dictionary.functions()).step_by(TABLE) {
            let mut table = [NOWHERE; TABLE];
            let mut function = 0_usize;
            let mut put = |register| {
                let place = function.checked_sub(from).and_then(|place| table.get_mut(place));
                place.into_iter().for_each(|place| *place = register);
                function = function.saturating_add(1);
            };
            let (mut harmonic, mut power) = (first_harmonic, first_power);
            for factor in factors {
                put(self.observed(layout, factor.observable));
                let (next, others) = match factor.basis {
                    Basis::Hermite => (&mut power, 2),
                    Basis::Fourier => {
                        put(self.observed(layout, factor.observable.saturating_add(1)));
                        (&mut harmonic, 3)
                    }
                };
                for _ in others..factor.radix() {
                    put(byte(*next));
                    *next = next.saturating_add(1);
                }
            }
            let terms = self.products.iter_mut().skip(self.powers.into()).zip(terms.entries());
            for ([_, register], [_, function]) in terms {
                let place = usize::from(*function).checked_sub(from);
                if let Some(found) = place.and_then(|place| table.get(place)) {
                    *register = *found;
                }
            }
        }
        Ok(())
    }

    /// Observables that have a register of their own; returns the register behind them.
    #[inline(always)]
    pub(crate) fn scale<S: Scalar>(
        &self,
        observables: &[Observable],
        registers: &mut Registers<S>,
    ) -> u8 {
        let mut next = self.first;
        for [index, raw] in &self.scaled {
            if let Some(o) = observables.get(usize::from(*index)) {
                registers.set(next, o.value(registers.get(*raw)));
            }
            next = next.wrapping_add(1);
        }
        next
    }

    /// The values of all observables of a dense model, which have been scaled.
    #[inline]
    pub(crate) fn values<'r, S: Scalar>(&self, registers: &'r Registers<S>) -> &'r [S] {
        registers.slice(self.first, self.scaled.len())
    }

    /// The outputs of a sparse model, whose observables have been scaled up to register `next`:
    /// `coefficients` has shape `[outputs, terms]`, `outputs` shape `[outputs]`.
    #[inline(always)]
    pub(crate) fn outputs<S: Scalar>(
        &self,
        next: u8,
        registers: &mut Registers<S>,
        coefficients: &[S],
        outputs: &mut [S],
    ) {
        let mut next = next;
        for Harmonics { sin, cos, order } in &self.harmonics {
            let first = (registers.get(*sin), registers.get(*cos));
            let mut harmonic = first;
            for _ in 1..*order {
                harmonic = turn(harmonic, first);
                registers.set(next, harmonic.0);
                registers.set(next.wrapping_add(1), harmonic.1);
                next = next.wrapping_add(2);
            }
        }
        let (powers, terms) =
            self.products.split_at_checked(self.powers.into()).unwrap_or_default();
        for [a, b] in powers {
            registers.set(next, registers.get(*a) * registers.get(*b));
            next = next.wrapping_add(1);
        }
        let cells = registers.cells();
        let made = cells.slice(next, terms.len());
        match outputs.len() {
            0 => {}
            1 => make_one(cells, terms, made, coefficients, outputs),
            2 => make_two(cells, terms, made, coefficients, outputs),
            3 => make_three(cells, terms, made, coefficients, outputs),
            _ => make_four(cells, terms, made, coefficients, outputs),
        }
        if outputs.len() > TOGETHER {
            sum_others(made, coefficients, outputs);
        }
    }
}

/// The outputs beyond the first ones from the terms, two by two.
#[inline(never)]
fn sum_others<S: Scalar>(terms: &[Cell<S>], coefficients: &[S], outputs: &mut [S]) {
    let row = terms.len().wrapping_add(1);
    let mut rest = coefficients.get(row.wrapping_mul(TOGETHER)..).unwrap_or(&[]);
    let (pairs, last) = outputs.get_mut(TOGETHER..).unwrap_or_default().as_chunks_mut::<2>();
    for pair in pairs {
        sum_two(terms, rest, pair);
        rest = rest.get(row.wrapping_mul(2)..).unwrap_or(&[]);
    }
    if !last.is_empty() {
        sum_one(terms, rest, last);
    }
}

// Functions of their own, so that the loop over the terms has the processor's registers for itself.
make!(make_four, t, ((((t, p), q), r), s), a p w, b q x, c r y, d s z);
make!(make_three, t, (((t, p), q), r), a p w, b q x, c r y);
make!(make_two, t, ((t, p), q), a p w, b q x);
make!(make_one, t, (t, p), a p w);

/// Two further outputs from the terms.
#[inline(never)]
fn sum_two<S: Scalar>(terms: &[Cell<S>], coefficients: &[S], outputs: &mut [S]) {
    let values = terms.iter().map(Cell::get);
    sum!(coefficients, outputs, terms.len(), values, t, ((t, p), q), a p w, b q x);
}

/// A further output from the terms.
#[inline(never)]
fn sum_one<S: Scalar>(terms: &[Cell<S>], coefficients: &[S], outputs: &mut [S]) {
    let values = terms.iter().map(Cell::get);
    sum!(coefficients, outputs, terms.len(), values, t, (t, p), a p w);
}
