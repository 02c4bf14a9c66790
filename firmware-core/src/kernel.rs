//! Evaluating the operator: the contraction of a Kronecker block with its coefficients.
//!
//! The coefficients of one output over a block are a tensor with one axis per factor, the first
//! factor slowest. Every axis is folded in turn: a polynomial factor by Horner's scheme
//! `lo + v · hi` in monomials, a Fourier factor by a dot product from the last harmonic to the
//! first. No term of the dictionary is ever formed: a block of n terms costs n − 1 multiply-adds per
//! output.
//!
//! Multiplication and addition are separate roundings on every machine, and the order is fixed, so
//! that all kernels give the same bits: the axes are folded from the last factor to the first. The blocks of a
//! direct sum are added in order.
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
//! A program is the chain translated into registers when a model is loaded:
//! every power and every term is the product of two of them.

use core::cell::Cell;

use heapless::Vec;

// Sizes of a checked dictionary are small numbers: the wrapping arithmetic below never wraps, and is
// there because it cannot panic.

use crate::capacity::{MAX_FUNCTIONS, MAX_SPARSE_TERMS, REGISTERS};
use crate::dictionary::{Basis, DictionaryError, Factor, Observable, observable_pair, turn};
use crate::model::{ModelError, Structure};
use crate::registers::{Layout, NOWHERE, ONE, Registers};
use crate::sparse::{SparseError, SparseTerms};
use crate::{Number, Scalar};

#[cfg(cortex_m4f)]
#[allow(unsafe_code)]
pub(crate) mod cortex_m4f;
mod dense;
mod direct;

#[cfg(cortex_m4f)]
pub(crate) use dense::fold_axis;
pub(crate) use dense::outputs;
pub use dense::{Run, fold, fold_portable};
pub(crate) use direct::{Constants, Direct, Known, Shape};

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

/// Outputs that are summed while the terms are made, at most.
const TOGETHER: usize = 4;

/// The terms, and the sums of their products with the coefficients of each output.
pub(crate) fn terms<S: Scalar>(
    registers: &[Cell<S>; REGISTERS],
    products: &[[u8; 2]],
    made: &[Cell<S>],
    coefficients: &[S],
    outputs: &mut [S],
) {
    let get = |register: u8| registers.get(usize::from(register)).map_or(S::ZERO, Cell::get);
    let made = made.get(..products.len()).unwrap_or(&[]);
    for ([a, b], to) in products.iter().zip(made) {
        to.set(get(*a) * get(*b));
    }
    sums(made, coefficients, outputs.get_mut(..TOGETHER.min(outputs.len())).unwrap_or_default());
}

/// The sums of the products of terms with the coefficients of each output.
fn sums<S: Scalar>(terms: &[Cell<S>], coefficients: &[S], outputs: &mut [S]) {
    let rows = coefficients.chunks_exact(terms.len().wrapping_add(1).max(1));
    for (output, row) in outputs.iter_mut().zip(rows) {
        let Some((constant, row)) = row.split_first() else { return };
        *output = terms.iter().zip(row).fold(*constant, |sum, (term, c)| sum + *c * term.get());
    }
}

/// How a step computes what is not in the history. Everything has a register, one after the other:
///
/// 1. observables that are centred or scaled; of a dense model all observables in order;
/// 2. harmonics of a sparse model from the second on, then its powers from the second on, then its
///    terms without the constant.
///
/// No entry makes less than a register, so that there is room for as many together as there are registers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Program {
    /// The first register that is computed.
    first: u8,
    /// The register of the first term.
    first_term: u8,
    /// Where the harmonics, the powers and the terms begin among the entries, and where these end.
    harmonics: u8,
    powers: u8,
    terms: u8,
    end: u8,
    /// Terms.
    count: u8,
    /// Of observables with a register of their own: index, and register of the raw value. Of the harmonics
    /// of a factor, order 2 or more, two entries: registers of sine and cosine; order, and nothing. Of powers and
    /// terms the two registers whose product they are.
    entries: [[u8; 2]; REGISTERS],
    /// What makes the step of some dense models short.
    direct: Direct,
}

/// A register, as far as it is one: that there are too many is noticed at the end.
fn byte(register: usize) -> u8 {
    u8::try_from(register).unwrap_or(NOWHERE)
}

/// Functions of a sparse model whose registers are looked up at once while its program is made.
const TABLE: usize = 32;

impl Program {
    /// Of nothing.
    pub(crate) const fn empty() -> Self {
        Self {
            first: 0,
            first_term: 0,
            harmonics: 0,
            powers: 0,
            terms: 0,
            end: 0,
            count: 0,
            entries: [[0; 2]; REGISTERS],
            direct: Direct::empty(),
        }
    }

    pub(crate) fn clear(&mut self) {
        self.entries.iter_mut().take(self.end.into()).for_each(|entry| *entry = [0; 2]);
        (self.first, self.first_term, self.end) = (0, 0, 0);
        (self.harmonics, self.powers, self.terms, self.count) = (0, 0, 0, 0);
        self.direct.clear();
    }

    /// An entry. There are as many as bytes, so that this needs no check.
    #[inline(always)]
    fn entry(&self, index: u8) -> [u8; 2] {
        self.entries.get(usize::from(index)).copied().unwrap_or_default()
    }

    /// Observables with a register of their own.
    #[inline(always)]
    fn scaled(&self) -> &[[u8; 2]] {
        self.entries.get(..self.harmonics.into()).unwrap_or(&[])
    }

    /// Puts an entry behind the others, if there is room.
    #[inline(always)]
    fn put(&mut self, entry: [u8; 2]) {
        let place = self.entries.get_mut(usize::from(self.end));
        place.into_iter().for_each(|place| *place = entry);
        self.end = self.end.saturating_add(1);
    }

    /// The register of an observable.
    #[inline(never)]
    fn observed(&self, layout: &Layout, observable: u8) -> u8 {
        // They are in order, so that it cannot be further behind.
        let scaled = self.scaled();
        let own = scaled.get(..=usize::from(observable)).unwrap_or(scaled);
        match own.iter().rposition(|[index, _]| *index == observable) {
            Some(place) => self.first.saturating_add(place as u8),
            None => layout.observables.get(usize::from(observable)).copied().unwrap_or(NOWHERE),
        }
    }

    /// Becomes that of a structure and the terms that have been checked against its dictionary. It is
    /// made where it lies: on the stack it would take a kilobyte.
    ///
    /// The [rest](Self::complete) follows: in parts, so that little is on the stack at once.
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
                self.put([index as u8, *register]);
            }
        }
        self.harmonics = self.end;
        let mut next = usize::from(self.first).wrapping_add(self.harmonics.into());
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
        for factor in factors.iter().filter(|f| f.basis == Basis::Fourier && f.order > 1) {
            let (sin, cos) = (
                self.observed(layout, factor.observable),
                self.observed(layout, factor.observable.saturating_add(1)),
            );
            let order = factor.order;
            self.put([sin, cos]);
            self.put([order, NOWHERE]);
            next = next.wrapping_add(usize::from(order).wrapping_sub(1).wrapping_mul(2));
        }
        self.powers = self.end;
        for factor in factors.iter().filter(|f| f.basis == Basis::Hermite) {
            let v = self.observed(layout, factor.observable);
            let mut power = v;
            for _ in 1..factor.order {
                self.put([power, v]);
                power = byte(next);
                next = next.wrapping_add(1);
            }
        }
        self.terms = self.end;
        let first_term = next;
        self.first_term = byte(next);
        for [parent, _] in terms.entries() {
            let parent = match parent.checked_sub(1) {
                None => ONE,
                Some(earlier) => byte(first_term.wrapping_add(earlier.into())),
            };
            // The register of its function follows.
            self.put([parent, NOWHERE]);
            next = next.wrapping_add(1);
        }
        if next > REGISTERS {
            let (field, capacity, found) = ("registers", REGISTERS, next);
            return Err(ModelError::Sparse(SparseError::TooLarge { field, capacity, found }).into());
        }
        self.count = self.end.saturating_sub(self.terms);
        Ok(())
    }

    /// The registers of the terms' functions.
    #[inline(never)]
    fn fill_functions(&mut self, structure: &Structure<'_>, terms: SparseTerms<'_>) {
        let (layout, dictionary) = (structure.layout(), structure.dictionary());
        let first_harmonic = self.first.wrapping_add(self.harmonics);
        let first_power = self.first_term.wrapping_sub(self.terms.wrapping_sub(self.powers));
        // Some functions at a time: the registers of all would be half of what loading takes of the stack.
        let (mut from, functions) = (0_usize, dictionary.functions());
        while from < functions {
            let mut table = [ONE; TABLE];
            // Where a function belongs: out of bounds where it is not among those of the table.
            let mut place = 0_usize.wrapping_sub(from);
            let (mut harmonic, mut power) = (first_harmonic, first_power);
            for factor in dictionary.factors() {
                // What is observed, and behind it what is computed.
                let (next, observed) = match factor.basis {
                    Basis::Hermite => (&mut power, 1),
                    Basis::Fourier => (&mut harmonic, 2),
                };
                for digit in 1..factor.radix() {
                    let register = if digit <= observed {
                        let behind = digit.wrapping_sub(1) as u8;
                        self.observed(layout, factor.observable.wrapping_add(behind))
                    } else {
                        let register = *next;
                        *next = next.wrapping_add(1);
                        register
                    };
                    if let Some(place) = table.get_mut(place) {
                        *place = register;
                    }
                    place = place.wrapping_add(1);
                }
            }
            let of_terms = self.entries.get_mut(self.terms.into()..).unwrap_or_default();
            for ([_, register], [_, function]) in of_terms.iter_mut().zip(terms.entries()) {
                if let Some(found) = table.get(usize::from(*function).wrapping_sub(from)) {
                    *register = *found;
                }
            }
            from = from.wrapping_add(TABLE);
        }
    }

    /// Once it is filled: the functions of a sparse model's terms, or what makes the step of some dense models short.
    #[inline]
    pub(crate) fn complete(&mut self, structure: &Structure<'_>, terms: Option<SparseTerms<'_>>) {
        match terms {
            Some(terms) => self.fill_functions(structure, terms),
            None => self.direct.fill(structure, self.first),
        }
    }

    /// How a step gets by without looking at each observable.
    #[inline]
    pub(crate) fn direct(&self) -> Option<&Direct> {
        Some(&self.direct).filter(|direct| direct.is_some())
    }

    /// The constants of a model that a controller may have a kernel for.
    #[inline]
    pub(crate) fn constants(&self) -> &Constants {
        self.direct.constants()
    }

    /// The first register that is computed.
    #[inline]
    pub(crate) fn first(&self) -> u8 {
        self.first
    }

    /// Observables that have a register of their own; returns the register behind them.
    #[inline(always)]
    pub(crate) fn scale<S: Scalar>(
        &self,
        observables: &[Observable],
        registers: &mut Registers<S>,
    ) -> u8 {
        let cells = registers.cells();
        let own = cells.get(usize::from(self.first)..).unwrap_or(&[]);
        for ([index, raw], to) in self.scaled().iter().zip(own) {
            let raw = cells.get(usize::from(*raw)).map_or(S::ZERO, Cell::get);
            if let Some(o) = observables.get(usize::from(*index)) {
                to.set(o.value(raw));
            }
        }
        self.first.wrapping_add(self.harmonics)
    }

    /// The values of all observables of a dense model, which have been scaled.
    #[inline]
    pub(crate) fn values<'r, S: Scalar>(&self, registers: &'r Registers<S>) -> &'r [S] {
        registers.slice(self.first, self.harmonics.into())
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
        let mut index = self.harmonics;
        while index < self.powers {
            let ([sin, cos], [order, _]) = (self.entry(index), self.entry(index.wrapping_add(1)));
            let first = (registers.get(sin), registers.get(cos));
            let mut harmonic = first;
            for _ in 1..order {
                harmonic = turn(harmonic, first);
                registers.set(next, harmonic.0);
                registers.set(next.wrapping_add(1), harmonic.1);
                next = next.wrapping_add(2);
            }
            index = index.saturating_add(2);
        }
        let (powers, terms) = (self.powers.into(), self.terms.into());
        let cells = registers.cells();
        let get = |register: u8| cells.get(usize::from(register)).map_or(S::ZERO, Cell::get);
        let made = cells.get(usize::from(next)..).unwrap_or(&[]);
        for ([a, b], to) in self.entries.get(powers..terms).unwrap_or(&[]).iter().zip(made) {
            to.set(get(*a) * get(*b));
        }
        let made = cells.get(usize::from(self.first_term)..).unwrap_or(&[]);
        let terms = self.entries.get(terms..).unwrap_or(&[]);
        let terms = terms.get(..self.count.into()).unwrap_or(&[]);
        S::terms(cells, terms, made, coefficients, outputs);
        if let Some(others) = outputs.get_mut(TOGETHER..) {
            let made = made.get(..terms.len()).unwrap_or(&[]);
            let before = made.len().wrapping_add(1).wrapping_mul(TOGETHER);
            sums(made, coefficients.get(before..).unwrap_or(&[]), others);
        }
    }
}
