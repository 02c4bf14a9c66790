//! Evaluating the operator: the contraction of a Kronecker block with its coefficients.
//!
//! The coefficients of one output over a block are a tensor with one axis per factor, the first
//! factor slowest. Every axis is folded in turn, the last one first: a polynomial factor by
//! Horner's scheme `lo + v · hi` in monomials, a Fourier factor by a dot product from the last
//! harmonic to the first. No term of the dictionary is ever formed: a block of n terms costs n − 1
//! multiply-adds per output. Multiplication and addition are separate roundings on every machine,
//! and the order is fixed, so that all kernels give the same bits.

use heapless::Vec;

use crate::Scalar;
use crate::capacity::{MAX_BASIS, MAX_BLOCK_FACTORS};
use crate::dictionary::{Basis, Factor, basis_functions, observable_pair};

/// Blocks are folded on the stack in tiles of at most this many coefficients.
const TILE: usize = 64;

/// A factor as the contraction sees it.
#[derive(Clone, Copy, Debug)]
enum Fold<S> {
    /// Horner's scheme in `v` over `radix` coefficients.
    Polynomial { radix: usize, v: S },
    /// A dot product with these functions.
    Functions { radix: usize, basis: [S; MAX_BASIS] },
}

impl<S: Scalar> Fold<S> {
    fn new(factor: Factor, values: &[S]) -> Self {
        let radix = factor.radix();
        match factor.basis {
            Basis::Hermite => Self::Polynomial { radix, v: observable_pair(factor, values).0 },
            Basis::Fourier => {
                let mut basis = [S::ZERO; MAX_BASIS];
                basis_functions(factor, values, &mut basis);
                Self::Functions { radix, basis }
            }
        }
    }

    #[inline]
    fn radix(&self) -> usize {
        match self {
            Self::Polynomial { radix, .. } | Self::Functions { radix, .. } => *radix,
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
            Self::Functions { radix, basis } => {
                let mut functions = basis.iter().take(*radix).rev();
                let first = functions.next().copied().unwrap_or_default();
                let last = first * values.next().unwrap_or_default();
                values.zip(functions).fold(last, |sum, (c, h)| sum + *h * c)
            }
        }
    }

    /// All groups of `from` into `to`; returns how many there were.
    #[inline]
    fn level(&self, from: &[S], to: &mut [S]) -> usize {
        match self {
            Self::Polynomial { radix: 2, v } => horner::<S, 2>(*v, from, to),
            Self::Polynomial { radix: 3, v } => horner::<S, 3>(*v, from, to),
            Self::Polynomial { radix: 4, v } => horner::<S, 4>(*v, from, to),
            _ => {
                let groups = from.chunks_exact(self.radix().max(1));
                let count = groups.len();
                for (out, group) in to.iter_mut().zip(groups) {
                    *out = self.group(group.iter().copied());
                }
                count
            }
        }
    }
}

/// Horner's scheme over groups whose size is known: unrolled and vectorised by the compiler.
#[inline]
fn horner<S: Scalar, const RADIX: usize>(v: S, from: &[S], to: &mut [S]) -> usize {
    let (groups, _) = from.as_chunks::<RADIX>();
    for (out, group) in to.iter_mut().zip(groups) {
        let mut rest = group.iter().rev().copied();
        let last = rest.next().unwrap_or_default();
        *out = rest.fold(last, |hi, lo| lo + v * hi);
    }
    groups.len()
}

/// Adds the contributions of one block to every output.
///
/// `coefficients` has the outputs of a model one after the other, `stride` apart; the block's own
/// start at the beginning of the slice. `outputs` has shape `[outputs]`.
pub(crate) fn contract<S: Scalar>(
    factors: &[Factor],
    values: &[S],
    coefficients: &[S],
    stride: usize,
    outputs: &mut [S],
) {
    let mut folds: Vec<Fold<S>, MAX_BLOCK_FACTORS> = Vec::new();
    let (mut size, mut outer) = (1_usize, 0_usize);
    for factor in factors.iter().rev() {
        let radix = factor.radix();
        size = size.saturating_mul(radix);
        if size > TILE {
            outer = outer.saturating_add(1);
        }
        // A checked dictionary has at most MAX_BLOCK_FACTORS factors in a block.
        let _ = folds.push(Fold::new(*factor, values));
    }
    let (inner, outer) = folds.split_at(folds.len().saturating_sub(outer));
    for (output, row) in outputs.iter_mut().zip(coefficients.chunks(stride.max(1))) {
        let block = row.get(..size).unwrap_or(&[]);
        *output = *output + contract_tiles(inner, outer, block);
    }
}

/// Folds the outer axes (the last of `outer` is the slowest) over the results of the tiles.
fn contract_tiles<S: Scalar>(inner: &[Fold<S>], outer: &[Fold<S>], c: &[S]) -> S {
    match outer.split_last() {
        None => contract_tile(inner, c),
        Some((slowest, faster)) => {
            let size = c.len().checked_div(slowest.radix()).unwrap_or(0).max(1);
            slowest.group(c.chunks_exact(size).map(|part| contract_tiles(inner, faster, part)))
        }
    }
}

/// Folds all axes of a tile; the first of `folds` is the fastest.
#[inline]
fn contract_tile<S: Scalar>(folds: &[Fold<S>], c: &[S]) -> S {
    let Some((first, others)) = folds.split_first() else {
        return c.first().copied().unwrap_or_default();
    };
    let (mut a, mut b) = ([S::ZERO; TILE / 2], [S::ZERO; TILE / 2]);
    let (mut from, mut to) = (&mut a, &mut b);
    let mut len = first.level(c, from);
    for fold in others {
        len = fold.level(from.get(..len).unwrap_or(&[]), to);
        core::mem::swap(&mut from, &mut to);
    }
    let [result, ..] = *from;
    result
}
