//! The contraction of a Kronecker block in Q31: Horner's scheme in every axis, the first axis outermost.
//!
//! # What every bit is
//!
//! With V an observable and X what has been folded so far, both signed 32-bit numbers, one step of the
//! scheme is
//!
//! > lo + ⌊V · X / 2³²⌋
//!
//! the upper word of the 64-bit product, rounded towards −∞, added without overflow (which the
//! [bound](bound) excludes). Read in fixed point with V in \[−1, 1) as Q31, the product has half the scale
//! of X; a coefficient that is multiplied d times therefore has 2ᵈ times the scale of the output.
//! Coefficients of an axis are folded from the highest power down, and an axis inside a faster one never
//! depends on the order of evaluation: every number above has one definition, and all kernels give the
//! same bits.
//!
//! This is SMMLA on a Cortex-M4, and SMULL and ADD on a Cortex-M3. Compiled Rust is the same
//! instructions, with two loads and stores of spilled registers for each; the block that fits the
//! registers exactly is therefore in assembly on these machines.

use core::cell::Cell;

/// Coefficients of the fastest axes that are folded at once if their shape is not special.
const AT_ONCE: usize = 16;
/// Tiles of a block: what is left of an output when the fastest axes are folded.
pub(super) const MAX_TILES: usize = 64;

/// `lo + ⌊v · hi / 2³²⌋`
#[inline(always)]
fn fold(lo: i32, v: i32, hi: i32) -> i32 {
    // Cannot overflow in a checked model, and panics where overflow is checked.
    lo + high(v, hi)
}

/// The upper word of the product.
#[inline(always)]
pub(super) fn high(a: i32, b: i32) -> i32 {
    ((i64::from(a) * i64::from(b)) >> 32) as i32
}

/// The coefficients of a block in tiles: the fastest axes, which are folded in one go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Tiles<'a> {
    /// Six axes of two.
    Six(&'a [[i32; 64]]),
    /// Four axes of two.
    Four(&'a [[i32; 16]]),
    /// Two axes of four.
    Cubic(&'a [[i32; 16]]),
    /// That many axes, of up to [`AT_ONCE`] coefficients.
    Other(u8, &'a [i32]),
}

impl<'a> Tiles<'a> {
    /// Of a block with these radices, the first axis slowest.
    pub(super) fn new(
        radices: impl DoubleEndedIterator<Item = usize> + Clone,
        coefficients: &'a [i32],
    ) -> Self {
        let ends_with = |radix: usize, count: usize| {
            let fast = radices.clone().rev().take(count);
            fast.filter(|r| *r == radix).count() == count
        };
        if ends_with(2, 6) {
            return Self::Six(coefficients.as_chunks().0);
        }
        if ends_with(2, 4) {
            return Self::Four(coefficients.as_chunks().0);
        }
        if ends_with(4, 2) {
            return Self::Cubic(coefficients.as_chunks().0);
        }
        let (mut size, mut axes) = (1_usize, 0_u8);
        for radix in radices.rev() {
            size = size.saturating_mul(radix);
            if size > AT_ONCE {
                break;
            }
            axes = axes.saturating_add(1);
        }
        Self::Other(axes, coefficients)
    }

    /// How many axes a tile folds.
    #[inline]
    pub(super) fn axes(self) -> usize {
        match self {
            Self::Six(_) => 6,
            Self::Four(_) => 4,
            Self::Cubic(_) => 2,
            Self::Other(axes, _) => axes.into(),
        }
    }

    /// All coefficients.
    pub(super) fn coefficients(self) -> &'a [i32] {
        match self {
            Self::Six(tiles) => tiles.as_flattened(),
            Self::Four(tiles) | Self::Cubic(tiles) => tiles.as_flattened(),
            Self::Other(_, coefficients) => coefficients,
        }
    }

    /// Without the first `outputs` outputs, of so many tiles each.
    fn skip(self, outputs: usize, tiles: usize, size: usize) -> Self {
        let skipped = outputs.wrapping_mul(tiles);
        match self {
            Self::Six(all) => Self::Six(all.get(skipped..).unwrap_or(&[])),
            Self::Four(all) => Self::Four(all.get(skipped..).unwrap_or(&[])),
            Self::Cubic(all) => Self::Cubic(all.get(skipped..).unwrap_or(&[])),
            Self::Other(axes, all) => {
                Self::Other(axes, all.get(skipped.wrapping_mul(size)..).unwrap_or(&[]))
            }
        }
    }

    /// Folds all axes: `radices` and `v` of every axis, the first one slowest; the coefficients have shape
    /// `[outputs, radices…]`, the first axis slowest, `outputs` shape `[outputs]`. With the number of
    /// tiles of one output, at least 1 and at most [`MAX_TILES`].
    #[inline(never)]
    pub(super) fn contract(
        self,
        tiles: usize,
        radices: impl DoubleEndedIterator<Item = usize> + ExactSizeIterator + Clone,
        v: &[i32],
        outputs: &mut [i32],
        room: &mut [i32; MAX_TILES],
    ) {
        if tiles == 1 {
            return self.fold(radices, v, outputs);
        }
        let axes = radices.clone().zip(v).rev();
        let size =
            axes.clone().take(self.axes()).fold(1, |size: usize, (r, _)| size.wrapping_mul(r));
        // As many outputs at once as there is room for.
        let rows = MAX_TILES.checked_div(tiles).unwrap_or(1).max(1);
        let mut rest = self;
        for outputs in outputs.chunks_mut(rows) {
            let mut len = outputs.len().wrapping_mul(tiles);
            rest.fold(radices.clone(), v, room.get_mut(..len).unwrap_or_default());
            rest = rest.skip(outputs.len(), tiles, size);
            for (radix, v) in axes.clone().skip(self.axes()) {
                len = level(radix, *v, room.get_mut(..len).unwrap_or_default());
            }
            for (output, folded) in outputs.iter_mut().zip(&*room) {
                *output = *folded;
            }
        }
    }

    /// Folds the fastest axes: as many tiles as there are numbers in `out`.
    #[inline(always)]
    fn fold(
        self,
        radices: impl DoubleEndedIterator<Item = usize> + ExactSizeIterator + Clone,
        v: &[i32],
        out: &mut [i32],
    ) {
        match (self, v) {
            (Self::Six(all), [.., a, b, c, d, e, f]) => six(&[*a, *b, *c, *d, *e, *f], all, out),
            (Self::Four(all), [.., a, b, c, d]) => tiles::four(&[*a, *b, *c, *d], all, out),
            (Self::Cubic(all), [.., a, b]) => tiles::cubic(&[*a, *b], all, out),
            _ => other(radices.zip(v).rev().take(self.axes()), self.coefficients(), out),
        }
    }
}

/// Six axes of two: as many tiles as there are numbers in `out`.
#[inline(always)]
pub(super) fn six(v: &[i32; 6], all: &[[i32; 64]], out: &mut [i32]) {
    tiles::six(v, all, out);
}

/// Folds an axis that is the fastest now, in place; how many numbers that leaves.
#[inline(always)]
fn level(radix: usize, v: i32, numbers: &mut [i32]) -> usize {
    // What is written has been read.
    let cells = Cell::from_mut(numbers).as_slice_of_cells();
    if radix == 2 {
        let (pairs, _) = cells.as_chunks();
        for (to, [lo, hi]) in cells.iter().zip(pairs) {
            to.set(fold(lo.get(), v, hi.get()));
        }
        return pairs.len();
    }
    let groups = cells.chunks_exact(radix.max(1));
    let count = groups.len();
    for (to, group) in cells.iter().zip(groups) {
        let mut group = group.iter().rev();
        let last = group.next().map_or(0, Cell::get);
        to.set(group.fold(last, |hi, lo| fold(lo.get(), v, hi)));
    }
    count
}

/// Tiles of any shape, of these axes, the fastest first.
#[inline(never)]
fn other<'v>(
    axes: impl Iterator<Item = (usize, &'v i32)> + Clone,
    coefficients: &[i32],
    out: &mut [i32],
) {
    let size = axes.clone().fold(1_usize, |size, (radix, _)| size.wrapping_mul(radix)).max(1);
    for (out, coefficients) in out.iter_mut().zip(coefficients.chunks_exact(size)) {
        let mut room = [0; AT_ONCE];
        for (to, c) in room.iter_mut().zip(coefficients) {
            *to = *c;
        }
        let mut len = size;
        for (radix, v) in axes.clone() {
            len = level(radix, *v, room.get_mut(..len).unwrap_or_default());
        }
        let [folded, ..] = room;
        *out = folded;
    }
}

/// The largest magnitude that a fold of these axes can have for any observables, `None` if a number on
/// the way may not fit 32 bits: |V · X| / 2³² is at most |X| / 2, rounded up.
pub(super) fn bound(
    radices: impl ExactSizeIterator<Item = usize> + Clone,
    coefficients: &[i32],
) -> Option<u32> {
    let mut faster = radices;
    let Some(radix) = faster.next() else {
        let [c] = coefficients else { return None };
        return small(c.unsigned_abs());
    };
    let rows = coefficients.chunks_exact(coefficients.len().checked_div(radix)?.max(1));
    let mut sum = 0_u32;
    for row in rows.rev() {
        let product = sum.div_ceil(2);
        sum = small(bound(faster.clone(), row)?.checked_add(product)?)?;
    }
    Some(sum)
}

/// Less than 2³¹.
fn small(magnitude: u32) -> Option<u32> {
    (magnitude <= i32::MAX.unsigned_abs()).then_some(magnitude)
}

/// The tiles in Rust, for machines that have no kernel of their own.
#[cfg(not(q31_kernel))]
mod tiles {
    use super::fold;

    /// Coefficients whose axes can be folded, the slowest first.
    trait Tensor {
        fn fold(&self, v: &[i32]) -> i32;
    }

    impl Tensor for i32 {
        #[inline(always)]
        fn fold(&self, _: &[i32]) -> i32 {
            *self
        }
    }

    impl<T: Tensor, const RADIX: usize> Tensor for [T; RADIX] {
        #[inline(always)]
        fn fold(&self, v: &[i32]) -> i32 {
            let Some((v, faster)) = v.split_first() else { return 0 };
            let mut rows = self.iter().rev();
            let last = rows.next().map_or(0, |row| row.fold(faster));
            rows.fold(last, |hi, row| fold(row.fold(faster), *v, hi))
        }
    }

    #[inline(always)]
    fn all<T: Tensor + bytemuck::AnyBitPattern, const AXES: usize, const SIZE: usize>(
        v: &[i32; AXES],
        tiles: &[[i32; SIZE]],
        out: &mut [i32],
    ) {
        let tensors: &[T] = bytemuck::try_cast_slice(tiles.as_flattened()).unwrap_or(&[]);
        for (out, tensor) in out.iter_mut().zip(tensors) {
            *out = tensor.fold(v);
        }
    }

    pub(super) fn six(v: &[i32; 6], tiles: &[[i32; 64]], out: &mut [i32]) {
        all::<[[[[[[i32; 2]; 2]; 2]; 2]; 2]; 2], 6, 64>(v, tiles, out);
    }

    pub(super) fn four(v: &[i32; 4], tiles: &[[i32; 16]], out: &mut [i32]) {
        all::<[[[[i32; 2]; 2]; 2]; 2], 4, 16>(v, tiles, out);
    }

    pub(super) fn cubic(v: &[i32; 2], tiles: &[[i32; 16]], out: &mut [i32]) {
        all::<[[i32; 4]; 4], 2, 16>(v, tiles, out);
    }
}

#[cfg(q31_kernel)]
#[path = "tiles.rs"]
mod tiles;
