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

use crate::capacity::{MAX_FUNCTIONS, MAX_OBSERVABLES, MAX_SPARSE_TERMS, REGISTERS};
use crate::dictionary::{Basis, DictionaryError, Factor, Observable, observable_pair, turn};
use crate::model::{ModelError, Structure};
use crate::registers::{FIRST, Layout, NOWHERE, ONE, Registers};
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

/// A Fourier factor of a sparse model: the registers of sine and cosine, and the order, 2 or more.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Harmonics {
    sin: u8,
    cos: u8,
    order: u8,
}

/// Outputs that are summed while the terms are made.
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
    for ([a, b], to) in products.iter().zip(made) {
        to.set(get(*a) * get(*b));
    }
    sums(made, coefficients, outputs);
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
/// Powers and terms are products of two registers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Program {
    /// The first register that is computed.
    first: u8,
    /// Observables with a register of their own: index, and register of the raw value.
    scaled: Vec<[u8; 2], MAX_OBSERVABLES>,
    harmonics: Vec<Harmonics, { MAX_FUNCTIONS / 4 }>,
    products: Vec<[u8; 2], { REGISTERS - FIRST as usize }>,
    /// Products that are powers, and not terms.
    powers: u8,
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
            scaled: Vec::new(),
            harmonics: Vec::new(),
            products: Vec::new(),
            powers: 0,
            direct: Direct::empty(),
        }
    }

    pub(crate) fn clear(&mut self) {
        (self.first, self.powers) = (0, 0);
        self.scaled.clear();
        self.harmonics.clear();
        self.products.clear();
        self.direct.clear();
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
        let mut next = usize::from(self.first).wrapping_add(self.scaled.len());
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
            next = next.wrapping_add(usize::from(order).wrapping_sub(1).wrapping_mul(2));
        }
        let first_power = next;
        for factor in factors.iter().filter(|f| f.basis == Basis::Hermite) {
            let v = self.observed(layout, factor.observable);
            let mut power = v;
            for _ in 1..factor.order {
                let _ = self.products.push([power, v]);
                power = byte(next);
                next = next.wrapping_add(1);
            }
        }
        self.powers = self.products.len() as u8;
        let first_term = next;
        for [parent, _] in terms.entries() {
            let parent = match parent.checked_sub(1) {
                None => ONE,
                Some(earlier) => byte(first_term.wrapping_add(earlier.into())),
            };
            // The register of its function follows.
            let _ = self.products.push([parent, NOWHERE]);
            next = next.wrapping_add(1);
        }
        if next > REGISTERS {
            let (field, capacity, found) = ("registers", REGISTERS, next);
            return Err(ModelError::Sparse(SparseError::TooLarge { field, capacity, found }).into());
        }
        // Some functions at a time: the registers of all would be half of what loading takes of the stack.
        let (mut from, functions) = (0_usize, dictionary.functions());
        while from < functions {
            let mut table = [ONE; TABLE];
            // Where a function belongs: out of bounds where it is not among those of the table.
            let mut place = 0_usize.wrapping_sub(from);
            let (mut harmonic, mut power) = (first_harmonic, first_power);
            for factor in factors {
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
                        let register = byte(*next);
                        *next = next.wrapping_add(1);
                        register
                    };
                    if let Some(place) = table.get_mut(place) {
                        *place = register;
                    }
                    place = place.wrapping_add(1);
                }
            }
            let of_terms = self.products.get_mut(self.powers.into()..).unwrap_or_default();
            for ([_, register], [_, function]) in of_terms.iter_mut().zip(terms.entries()) {
                if let Some(found) = table.get(usize::from(*function).wrapping_sub(from)) {
                    *register = *found;
                }
            }
            from = from.wrapping_add(TABLE);
        }
        Ok(())
    }

    /// What makes the step of some dense models short, once it is filled.
    #[inline]
    pub(crate) fn shorten(&mut self, structure: &Structure<'_>) {
        self.direct.fill(structure, self.first);
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
        let made = cells.get(usize::from(next)..).and_then(|made| made.get(..terms.len()));
        let made = made.unwrap_or(&[]);
        let (first, others) =
            outputs.split_at_mut_checked(TOGETHER.min(outputs.len())).unwrap_or_default();
        S::terms(cells, terms, made, coefficients, first);
        if !others.is_empty() {
            let before = made.len().wrapping_add(1).wrapping_mul(TOGETHER);
            sums(made, coefficients.get(before..).unwrap_or(&[]), others);
        }
    }
}
