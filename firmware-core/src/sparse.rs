//! Sparse dictionaries: some products of basis functions instead of whole Kronecker blocks.
//!
//! The factors of a sparse model only provide *functions*: `v, v², …, vᵖ` of a polynomial factor (in
//! monomial form) and `sin φ, cos φ, sin 2φ, …, cos pφ` of a Fourier factor, numbered from 0 over all
//! factors in order. Every block is a single factor, not cut.
//!
//! The terms are a chain of products. Term 0 is the constant 1 and always there; entry k = 1 … T is
//! two bytes, a parent p < k and a function g:
//!
//! > term_k = term_p · f_g
//!
//! A product of three functions thus needs the product of two of them as a term of its own, whose
//! coefficients may be 0.

use heapless::Vec;

use crate::Number;
use crate::capacity::{MAX_FUNCTIONS, MAX_SPARSE_TERMS};
use crate::dictionary::{Basis, Dictionary, Factor};
use crate::kernel::{FunctionValues, TermValues, chain, functions};

/// Why a chain of terms is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SparseError {
    /// A block is not a single factor without a cut.
    Block {
        /// Index of the block.
        block: usize,
    },
    /// There are more functions or more terms than fit.
    TooLarge {
        /// What is too large.
        field: &'static str,
        /// The capacity.
        capacity: usize,
        /// What was found.
        found: usize,
    },
    /// The parent of a term is not an earlier term.
    Parent {
        /// Index of the term, from 1 on.
        term: usize,
    },
    /// The function of a term is not there.
    Function {
        /// Index of the term, from 1 on.
        term: usize,
    },
}

/// A function within a sparse term: how often it is multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Power {
    /// Where the function comes from. Sine and cosine themselves count as observables, whatever the
    /// basis that provides them: only higher harmonics have the Fourier basis here.
    pub factor: Factor,
    /// Which function: 1 for the value of the observable, 3, 4, 5, … for sin 2φ, cos 2φ, sin 3φ, …
    pub digit: usize,
    /// The exponent, 1 or more.
    pub exponent: usize,
}

/// The terms of a sparse model: a chain of products that has been checked against a dictionary.
///
/// ```
/// use firmware_core::dictionary::{Basis, Block, Dictionary, Factor, Observable, Source};
/// use firmware_core::sparse::SparseTerms;
///
/// // Functions of x: 0 is x, 1 is x². Functions of u: 2 is u.
/// let observable = |source| Observable { source, lag: 0, centre: 0.0, gain: 1.0 };
/// let factor = |observable, order| Factor { observable, basis: Basis::Hermite, order };
/// let dictionary = Dictionary::new(
///     [observable(Source::State(0)), observable(Source::Input(0))].into_iter().collect(),
///     [factor(0, 2), factor(1, 1)].into_iter().collect(),
///     [Block { factors: 1, max_degree: 0 }; 2].into_iter().collect(),
/// ).unwrap();
/// // Terms 1, u, u·x², u·x³.
/// let terms = SparseTerms::new(&dictionary, &[[0, 2], [1, 1], [2, 0]]).unwrap();
///
/// let mut lifted = [0.0_f32; 4];
/// assert_eq!(terms.lift(&dictionary, &[3.0, 0.5], &mut lifted), 4);
/// assert_eq!(lifted, [1.0, 0.5, 4.5, 13.5]);
/// let cubed = terms.term(&dictionary, 3).unwrap();
/// assert_eq!(cubed.iter().map(|p| (p.factor.observable, p.exponent)).collect::<Vec<_>>(), [(1, 1), (0, 3)]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SparseTerms<'a> {
    entries: &'a [[u8; 2]],
}

impl<'a> SparseTerms<'a> {
    /// Checks a chain, `[parent, function]` of terms 1, 2, …, against the dictionary that provides
    /// the functions. No entry at all leaves the constant.
    ///
    /// # Errors
    /// [`SparseError`] names the block or term that does not fit.
    pub fn new(dictionary: &Dictionary, entries: &'a [[u8; 2]]) -> Result<Self, SparseError> {
        let whole = dictionary.blocks().map(|(block, _)| (block.factors, block.max_degree));
        if let Some(block) = whole.into_iter().position(|block| block != (1, 0)) {
            return Err(SparseError::Block { block });
        }
        let functions = dictionary.functions();
        if functions > MAX_FUNCTIONS {
            let (field, capacity, found) = ("functions", MAX_FUNCTIONS, functions);
            return Err(SparseError::TooLarge { field, capacity, found });
        }
        if entries.len() > MAX_SPARSE_TERMS {
            let (field, capacity, found) = ("sparse terms", MAX_SPARSE_TERMS, entries.len());
            return Err(SparseError::TooLarge { field, capacity, found });
        }
        for (earlier, [parent, function]) in entries.iter().enumerate() {
            let term = earlier.wrapping_add(1);
            if usize::from(*parent) > earlier {
                return Err(SparseError::Parent { term });
            }
            if usize::from(*function) >= functions {
                return Err(SparseError::Function { term });
            }
        }
        Ok(Self { entries })
    }

    /// `[parent, function]` of terms 1, 2, …
    #[inline]
    pub fn entries(&self) -> &'a [[u8; 2]] {
        self.entries
    }

    /// Number of terms, the constant included: the number of coefficients per output.
    #[inline]
    pub fn count(&self) -> usize {
        self.entries.len().wrapping_add(1)
    }

    /// Indices of the functions whose product a term is, from the last one multiplied to the first;
    /// none for the constant, and for a term that is not there.
    pub fn functions(&self, term: usize) -> impl Iterator<Item = u8> + 'a {
        let entries = self.entries;
        let mut term = term;
        core::iter::from_fn(move || {
            let [parent, function] = *entries.get(term.checked_sub(1)?)?;
            term = parent.into();
            Some(function)
        })
    }

    /// What a term is: different functions and their exponents, those multiplied first in front. The
    /// dictionary is the one that the chain was checked against. Empty for the constant.
    pub fn term(&self, dictionary: &Dictionary, term: usize) -> Option<Vec<Power, MAX_FUNCTIONS>> {
        if term >= self.count() {
            return None;
        }
        let mut powers: Vec<Power, MAX_FUNCTIONS> = Vec::new();
        for function in self.functions(term) {
            let (factor, digit) = dictionary.function(function.into())?;
            let power = primitive(factor, digit);
            let same = |p: &&mut Power| {
                (p.factor.observable, p.factor.basis, p.digit)
                    == (power.factor.observable, power.factor.basis, power.digit)
            };
            match powers.iter_mut().find(same) {
                Some(found) => found.exponent = found.exponent.saturating_add(power.exponent),
                // There are no more different ones than functions.
                None => powers.push(power).ok()?,
            }
        }
        powers.reverse();
        Some(powers)
    }

    /// Writes all terms, the constant first, from the values of the observables, as the predictor
    /// computes them. The dictionary is the one that the chain was checked against.
    ///
    /// `values` has shape `[observables]`, `lifted` shape `[count]`. Returns the number written; a
    /// `lifted` that is too short is filled.
    #[inline(always)]
    pub fn lift<S: Number>(
        &self,
        dictionary: &Dictionary,
        values: &[S],
        lifted: &mut [S],
    ) -> usize {
        let mut of_factors = FunctionValues::new();
        functions(dictionary.factors(), values, &mut of_factors);
        let mut terms = TermValues::new();
        chain(self.entries, &of_factors, &mut terms);
        for (to, term) in lifted.iter_mut().zip(&terms) {
            *to = *term;
        }
        lifted.len().min(terms.len())
    }
}

/// A basis function as a power of an observable or of a higher harmonic.
fn primitive(factor: Factor, digit: usize) -> Power {
    let of_observable = |observable, exponent| Power {
        factor: Factor { observable, basis: Basis::Hermite, order: 1 },
        digit: 1,
        exponent,
    };
    match (factor.basis, digit) {
        (Basis::Hermite, _) => of_observable(factor.observable, digit),
        (Basis::Fourier, 1) => of_observable(factor.observable, 1),
        (Basis::Fourier, 2) => of_observable(factor.observable.saturating_add(1), 1),
        (Basis::Fourier, _) => Power { factor, digit, exponent: 1 },
    }
}
