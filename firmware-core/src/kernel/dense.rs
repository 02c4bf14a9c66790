//! The contraction of a Kronecker block with its coefficients.
//!
//! Neighbouring polynomial factors with as many coefficients each are folded together, as a [`Run`]: what is
//! between their axes never leaves the processor's registers.

use heapless::Vec;

use crate::Scalar;
use crate::capacity::{MAX_BASIS, MAX_BLOCK_FACTORS};
use crate::dictionary::{Basis, Factor, basis_functions, block_size, observable_pair};

/// Results that a first fold may have; larger blocks are cut along their slowest axes.
const ROOM: usize = 64;
/// Room for the Fourier functions of a block: the radices of a block whose product is at most
/// [`MAX_TERMS`](crate::capacity::MAX_TERMS) add up to less.
const FUNCTIONS: usize = 64;

/// Neighbouring polynomial axes with the same number of coefficients: they are folded at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    radix: u8,
    count: u8,
    size: u8,
    /// Its place among the [shapes](SHAPES), or the number of them.
    pub(super) shape: u8,
}

/// `[radix, count]` of the runs that are folded in registers.
const SHAPES: [[u8; 2]; 12] = [
    [2, 1],
    [2, 2],
    [2, 3],
    [2, 4],
    [2, 5],
    [2, 6],
    [3, 1],
    [3, 2],
    [4, 1],
    [4, 2],
    [5, 1],
    [6, 1],
];

impl Default for Run {
    /// Of no axes: nothing is folded.
    fn default() -> Self {
        Self::NONE
    }
}

impl Run {
    /// Of no axes.
    pub(crate) const NONE: Self = Self { radix: 0, count: 0, size: 0, shape: SHAPES.len() as u8 };

    /// Of `count` axes with `radix` coefficients each, order and one: up to six axes of two, two of three or
    /// of four, or a single one.
    pub const fn new(radix: u8, count: u8) -> Option<Self> {
        let mut shape = 0;
        while shape < SHAPES.len() {
            // Within bounds, as the loop says; a constant function has no other way.
            #[allow(clippy::indexing_slicing)]
            let [r, c] = SHAPES[shape];
            if radix == r && count == c {
                let size = radix.saturating_pow(count as u32);
                return Some(Self { radix, count, size, shape: shape as u8 });
            }
            shape = shape.saturating_add(1);
        }
        if count == 1 && radix > 0 {
            Some(Self { radix, count, size: radix, shape: SHAPES.len() as u8 })
        } else {
            None
        }
    }

    /// The place of a run among the shapes, or the number of them.
    pub(super) const fn shape(radix: u8, count: u8) -> u8 {
        match Self::new(radix, count) {
            Some(run) => run.shape,
            None => SHAPES.len() as u8,
        }
    }

    /// The longest run of the last factors; empty if the last one is not polynomial.
    #[inline(never)]
    pub(crate) fn last(factors: &[Factor]) -> Self {
        let Some(last) = factors.last() else { return Self::NONE };
        let most = match last.radix() {
            2 => 6,
            3 | 4 => 2,
            _ => 1,
        };
        let same = |f: &&Factor| f.basis == Basis::Hermite && f.order == last.order;
        let count = factors.iter().rev().take(most).take_while(same).count();
        Self::new(last.radix() as u8, count as u8).unwrap_or(Self::NONE)
    }

    /// A single axis of it.
    fn single(self) -> Self {
        Self::new(self.radix, 1).unwrap_or(self)
    }

    /// Axes.
    #[inline]
    pub fn count(self) -> usize {
        self.count.into()
    }

    /// Coefficients that become one number.
    #[inline]
    pub fn size(self) -> usize {
        self.size.into()
    }
}

/// Coefficients that are folded to one number.
trait Tile {
    const SIZE: usize;
    const AXES: usize;
    /// `c` has `SIZE` numbers, `v` one per axis, the slowest first.
    fn fold<S: Scalar>(c: &[S], v: &[S]) -> S;
}

/// A single coefficient.
struct One;

impl Tile for One {
    const SIZE: usize = 1;
    const AXES: usize = 0;
    #[inline(always)]
    fn fold<S: Scalar>(c: &[S], _: &[S]) -> S {
        c.first().copied().unwrap_or_default()
    }
}

/// Some tiles along one more, slower axis. Written out, because a loop stays one where code has to be small.
macro_rules! nest {
    ($name:ident, $radix:literal: $($part:ident)+) => {
        struct $name<T>(core::marker::PhantomData<T>);

        impl<T: Tile> Tile for $name<T> {
            const SIZE: usize = $radix * T::SIZE;
            const AXES: usize = T::AXES + 1;
            #[inline(always)]
            fn fold<S: Scalar>(c: &[S], v: &[S]) -> S {
                let Some((v, faster)) = v.split_first() else { return S::ZERO };
                $(let ($part, c) = c.split_at_checked(T::SIZE).unwrap_or_default();
                let $part = T::fold($part, faster);)+
                let _ = c;
                nest!(@ v $($part)+)
            }
        }
    };
    (@ $v:ident $last:ident) => { $last };
    (@ $v:ident $lo:ident $($hi:ident)+) => { $lo + *$v * (nest!(@ $v $($hi)+)) };
}

nest!(Nest2, 2: first second);
nest!(Nest3, 3: first second third);
nest!(Nest4, 4: first second third fourth);

type Two1 = Nest2<One>;
type Two2 = Nest2<Two1>;
type Two3 = Nest2<Two2>;
type Two4 = Nest2<Two3>;
type Two5 = Nest2<Two4>;
type Two6 = Nest2<Two5>;
type Three1 = Nest3<One>;
type Three2 = Nest3<Three1>;
type Four1 = Nest4<One>;
type Four2 = Nest4<Four1>;

/// Folds as many tiles as `to` has room for.
#[inline(never)]
fn tiles<T: Tile, S: Scalar>(from: &[S], to: &mut [S], v: &[S]) {
    let Some(v) = v.get(..T::AXES) else { return };
    for (to, c) in to.iter_mut().zip(from.chunks_exact(T::SIZE)) {
        *to = T::fold(c, v);
    }
}

/// Folds a run of axes on any processor: `from` has shape `[tiles, run.size()]`, the last axis the fastest,
/// `v` shape `[run.count()]`, the slowest axis first, `to` shape `[tiles]`. On every axis that is Horner's scheme
/// `lo + v · hi`, the fastest axis first, product and sum rounded on their own. As many tiles are folded as there
/// are coefficients and room for; nothing, if `v` is too short. [`fold`] is the same, to the
/// bit, as fast as the processor does it.
///
/// ```
/// use firmware_core::kernel::{Run, fold, fold_portable};
///
/// // 1 + 2 v + u (3 + 4 v) at u = 10, v = 0.5, for two outputs, of which the second has twice the coefficients.
/// let coefficients = [1.0, 2.0, 3.0, 4.0, 2.0, 4.0, 6.0, 8.0];
/// let (run, v) = (Run::new(2, 2).unwrap(), [10.0_f32, 0.5]);
/// let mut outputs = [0.0; 2];
/// fold_portable(run, &coefficients, &mut outputs, &v);
/// assert_eq!(outputs, [52.0, 104.0]);
/// let mut again = [0.0; 2];
/// fold(run, &coefficients, &mut again, &v);
/// assert_eq!(again, outputs);
/// ```
#[inline]
pub fn fold_portable<S: Scalar>(run: Run, from: &[S], to: &mut [S], v: &[S]) {
    match (run.radix, run.count) {
        (2, 1) => tiles::<Two1, S>(from, to, v),
        (2, 2) => tiles::<Two2, S>(from, to, v),
        (2, 3) => tiles::<Two3, S>(from, to, v),
        (2, 4) => tiles::<Two4, S>(from, to, v),
        (2, 5) => tiles::<Two5, S>(from, to, v),
        (2, 6) => tiles::<Two6, S>(from, to, v),
        (3, 1) => tiles::<Three1, S>(from, to, v),
        (3, 2) => tiles::<Three2, S>(from, to, v),
        (4, 1) => tiles::<Four1, S>(from, to, v),
        (4, 2) => tiles::<Four2, S>(from, to, v),
        _ => fold_axis(run, from, to, v),
    }
}

/// The same for a single axis.
#[inline(never)]
pub(crate) fn fold_axis<S: Scalar>(run: Run, from: &[S], to: &mut [S], v: &[S]) {
    let Some(v) = v.first() else { return };
    for (to, c) in to.iter_mut().zip(from.chunks_exact(usize::from(run.radix).max(1))) {
        *to = horner(*v, c.iter().copied());
    }
}

/// The same on the controller's own kernels, if there are any.
#[inline]
pub fn fold<S: Scalar>(run: Run, from: &[S], to: &mut [S], v: &[S]) {
    S::fold(run, from, to, v);
}

/// Horner's scheme from the last value to the first.
#[inline]
fn horner<S: Scalar>(v: S, values: impl DoubleEndedIterator<Item = S>) -> S {
    let mut values = values.rev();
    let last = values.next().unwrap_or_default();
    values.fold(last, |hi, lo| lo + v * hi)
}

/// A dot product with the functions of a Fourier factor, from the last harmonic to the first.
#[inline]
fn dot<S: Scalar>(functions: &[S], values: impl DoubleEndedIterator<Item = S>) -> S {
    let (mut functions, mut values) = (functions.iter().rev(), values.rev());
    let first = functions.next().copied().unwrap_or_default();
    let last = first * values.next().unwrap_or_default();
    values.zip(functions).fold(last, |sum, (c, h)| sum + *h * c)
}

/// What is folded at once: a run of polynomial axes, or a Fourier axis.
#[derive(Clone, Copy, Debug)]
enum Step<'v, S> {
    Run(Run, &'v [S]),
    Functions(&'v [S]),
}

impl<S: Scalar> Step<'_, S> {
    #[inline]
    fn size(&self) -> usize {
        match self {
            Self::Run(run, _) => run.size(),
            Self::Functions(functions) => functions.len(),
        }
    }

    /// Folds `from`, shape `[groups, size]`, into `to`, shape `[groups]`.
    #[inline]
    fn fold(&self, from: &[S], to: &mut [S]) {
        match self {
            Self::Run(run, v) => S::fold(*run, from, to, v),
            Self::Functions(functions) => {
                for (to, c) in to.iter_mut().zip(from.chunks_exact(functions.len().max(1))) {
                    *to = dot(functions, c.iter().copied());
                }
            }
        }
    }
}

/// Room for the results of a first and a second fold.
#[derive(Clone, Debug)]
struct Scratch<S> {
    first: [S; ROOM],
    second: [S; ROOM / 2],
}

/// The outputs of a dense model: `values` has shape `[observables]`, `coefficients` shape
/// `[outputs, dense_terms]`, `outputs` shape `[outputs]`.
#[inline(never)]
pub(crate) fn outputs<'d, S: Scalar>(
    blocks: impl Iterator<Item = &'d [Factor]>,
    dense_terms: usize,
    values: &[S],
    coefficients: &[S],
    outputs: &mut [S],
) {
    let mut scratch = Scratch { first: [S::ZERO; ROOM], second: [S::ZERO; ROOM / 2] };
    let mut start = 0_usize;
    for factors in blocks {
        let coefficients = coefficients.get(start..).unwrap_or(&[]);
        contract(factors, values, coefficients, dense_terms, start == 0, outputs, &mut scratch);
        start = start.wrapping_add(block_size(factors));
    }
}

/// The contributions of one block to every output, added to them but for the first block.
///
/// `coefficients` has the outputs of a model one after the other, `stride` apart; the block's own start is at
/// the beginning of the slice.
#[inline]
fn contract<S: Scalar>(
    factors: &[Factor],
    values: &[S],
    coefficients: &[S],
    stride: usize,
    is_first: bool,
    outputs: &mut [S],
    scratch: &mut Scratch<S>,
) {
    // A checked dictionary has no more factors in a block, and no more functions in its factors.
    let mut v: Vec<S, MAX_BLOCK_FACTORS> = Vec::new();
    let mut functions: Vec<S, FUNCTIONS> = Vec::new();
    for factor in factors {
        let _ = v.push(observable_pair(*factor, values).0);
        if factor.basis == Basis::Fourier {
            let mut basis = [S::ZERO; MAX_BASIS];
            let _ = functions.extend_from_slice(basis_functions(*factor, values, &mut basis));
        }
    }
    let (mut v, mut functions) = (v.as_slice(), functions.as_slice());
    let mut steps: Vec<Step<'_, S>, MAX_BLOCK_FACTORS> = Vec::new();
    let (mut rest, mut size, mut tile, mut inner) = (factors, 1_usize, 0_usize, 0_usize);
    while let [.., last] = rest {
        let mut run = Run::last(rest);
        // What is cut off along its slowest axes is folded one axis after the other.
        if tile > 0 && size.wrapping_mul(run.size()) > tile {
            run = run.single();
        }
        let axes = run.count().max(1);
        let (slower, _) =
            rest.split_at_checked(rest.len().saturating_sub(axes)).unwrap_or_default();
        let (slower_v, own_v) = v.split_at_checked(slower.len()).unwrap_or_default();
        let step = if run.count > 0 {
            Step::Run(run, own_v)
        } else {
            let (slower, own) = functions
                .split_at_checked(functions.len().saturating_sub(last.radix()))
                .unwrap_or_default();
            functions = slower;
            Step::Functions(own)
        };
        (rest, v) = (slower, slower_v);
        size = size.wrapping_mul(step.size());
        if tile == 0 {
            tile = size.wrapping_mul(ROOM);
        }
        if size <= tile {
            inner = inner.wrapping_add(1);
        }
        let _ = steps.push(step);
    }
    let (inner, outer) = steps.split_at_checked(inner).unwrap_or_default();
    if is_first && size == stride && size.wrapping_mul(outputs.len()) <= tile {
        // The only block, and small: the outputs are one more axis, which is not folded.
        return contract_tile(inner, coefficients, outputs, scratch);
    }
    for (output, row) in outputs.iter_mut().zip(coefficients.chunks(stride.max(1))) {
        let block = row.get(..size).unwrap_or(&[]);
        let sum = contract_tiles(inner, outer, block, scratch);
        *output = if is_first { sum } else { *output + sum };
    }
}

/// Folds the outer axes (the last of `outer` is the slowest) over the results of the tiles.
fn contract_tiles<S: Scalar>(
    inner: &[Step<'_, S>],
    outer: &[Step<'_, S>],
    c: &[S],
    scratch: &mut Scratch<S>,
) -> S {
    let Some((slowest, faster)) = outer.split_last() else {
        let mut result = [S::ZERO];
        contract_tile(inner, c, &mut result, scratch);
        let [result] = result;
        return result;
    };
    let size = c.len().checked_div(slowest.size()).unwrap_or(0).max(1);
    let parts = c.chunks_exact(size).map(|part| contract_tiles(inner, faster, part, scratch));
    match slowest {
        Step::Run(_, v) => horner(v.first().copied().unwrap_or_default(), parts),
        Step::Functions(functions) => dot(functions, parts),
    }
}

/// Folds all axes of tiles: as many as there are results.
#[inline]
fn contract_tile<S: Scalar>(
    steps: &[Step<'_, S>],
    c: &[S],
    results: &mut [S],
    scratch: &mut Scratch<S>,
) {
    let (mut from, mut to): (&mut [S], &mut [S]) = (&mut scratch.second, &mut scratch.first);
    let mut len = c.len();
    let mut is_first = true;
    for (left, step) in (0..steps.len()).rev().zip(steps) {
        let source = if is_first { c } else { from.get(..len).unwrap_or(&[]) };
        if left == 0 {
            return step.fold(source, results);
        }
        len = len.checked_div(step.size()).unwrap_or(0);
        step.fold(source, to.get_mut(..len).unwrap_or_default());
        core::mem::swap(&mut from, &mut to);
        is_first = false;
    }
    // The block of the constant.
    for (result, c) in results.iter_mut().zip(c) {
        *result = *c;
    }
}
