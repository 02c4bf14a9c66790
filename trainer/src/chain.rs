//! The terms of a dictionary that lists them one by one: the chain of products that the core
//! evaluates (see [`firmware_core::sparse`]), and which of them the fit is about.

use firmware_core::dictionary::Dictionary;
use firmware_core::sparse::SparseTerms;

use crate::terms::Names;

/// A chain of products and the terms that were asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chain {
    /// `[parent, function]` of terms 1, 2, …
    entries: Vec<[u8; 2]>,
    /// For terms 0 (the constant), 1, 2, …: whether it was asked for. The others are there because
    /// a product of three functions needs the product of two of them; their coefficients are 0.
    fitted: Vec<bool>,
}

impl Chain {
    /// The chain of the constant and of products of functions, each a list of function indices of
    /// the dictionary, in any order; none may be there twice. `None` if there is no room for them.
    ///
    /// ```
    /// use trainer::chain::Chain;
    /// // f₀, f₀·f₁ and f₁·f₂·f₂: the last one needs f₁·f₂, which was not asked for.
    /// let chain = Chain::new(&[vec![0], vec![1, 0], vec![2, 1, 2]]).unwrap();
    /// assert_eq!(chain.entries(), [[0, 0], [1, 1], [0, 1], [3, 2], [4, 2]]);
    /// assert_eq!(chain.fitted(), [true, true, true, false, false, true]);
    /// assert_eq!(chain.count(), 4);
    /// ```
    pub fn new(products: &[Vec<u8>]) -> Option<Self> {
        let mut terms: Vec<Vec<u8>> = vec![Vec::new()];
        let mut chain = Self { entries: Vec::new(), fitted: vec![true] };
        let mut sorted: Vec<Vec<u8>> = products.to_vec();
        for product in &mut sorted {
            product.sort_unstable();
        }
        // Short products first: they are the parents of the longer ones.
        sorted.sort_by_key(Vec::len);
        for product in &sorted {
            let term = chain.term(&mut terms, product)?;
            chain.fitted[term] = true;
        }
        Some(chain)
    }

    /// The index of a product, made with its parents if it is not there.
    fn term(&mut self, terms: &mut Vec<Vec<u8>>, product: &[u8]) -> Option<usize> {
        if let Some(found) = terms.iter().position(|t| t == product) {
            return Some(found);
        }
        let without = |i: usize| [&product[..i], &product[i + 1..]].concat();
        let present = (0..product.len()).rev().find(|i| terms.iter().any(|t| *t == without(*i)));
        let last = present.unwrap_or(product.len() - 1);
        let parent = self.term(terms, &without(last))?;
        let index = terms.len();
        terms.push(product.to_vec());
        self.entries.push([u8::try_from(parent).ok()?, product[last]]);
        self.fitted.push(false);
        Some(index)
    }

    /// `[parent, function]` of terms 1, 2, …
    pub fn entries(&self) -> &[[u8; 2]] {
        &self.entries
    }

    /// Whether the fit is about a term, shape `[entries + 1]`, the constant first.
    pub fn fitted(&self) -> &[bool] {
        &self.fitted
    }

    /// Number of fitted terms, the constant among them.
    pub fn count(&self) -> usize {
        self.fitted.iter().filter(|f| **f).count()
    }

    /// The fitted terms at the values of the observables, in `lifted`, shape `[count]`; `all` is
    /// scratch of shape `[entries + 1]`.
    pub fn lift(
        &self,
        dictionary: &Dictionary,
        values: &[f64],
        all: &mut [f64],
        lifted: &mut [f64],
    ) {
        let Ok(terms) = SparseTerms::new(dictionary, &self.entries) else { return };
        terms.lift(dictionary, values, all);
        let fitted = all.iter().zip(&self.fitted).filter(|(_, fitted)| **fitted);
        for (to, (term, _)) in lifted.iter_mut().zip(fitted) {
            *to = *term;
        }
    }

    /// The names of the fitted terms.
    pub fn names(&self, dictionary: &Dictionary, names: Names<'_>) -> Vec<String> {
        let Ok(terms) = SparseTerms::new(dictionary, &self.entries) else { return Vec::new() };
        let fitted = self.fitted.iter().enumerate().filter(|(_, fitted)| **fitted);
        fitted.map(|(k, _)| names.sparse_term(dictionary, terms, k)).collect()
    }

    /// Coefficients of the fitted terms, shape `[count, outputs]`, as the model has them: of all
    /// terms, shape `[outputs, entries + 1]`.
    pub fn spread(&self, matrix: &[f64], outputs: usize) -> Vec<f64> {
        let mut spread = Vec::with_capacity(outputs * self.fitted.len());
        for output in 0..outputs {
            let mut column = matrix.iter().skip(output).step_by(outputs);
            spread.extend(
                self.fitted.iter().map(|fitted| {
                    if *fitted { column.next().copied().unwrap_or(0.0) } else { 0.0 }
                }),
            );
        }
        spread
    }
}
