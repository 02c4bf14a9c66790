//! The tiles in assembly, for machines with multiply instructions that have the upper word of a product:
//! the compiler orders loads and products so that twice as many registers are needed as there are.
//!
//! In all functions r0 is behind the coefficients that are not folded yet, r1 behind the results that are
//! not there yet, and r2 the place of the first result: from the last one to the first. Observables
//! stay in r3 to r6, the fastest last, and numbers on the way are in r7 to r12; lr is scratch.
#![allow(
    unsafe_code,
    reason = "functions in assembly, and the calls with pointers and lengths checked"
)]

use core::arch::naked_asm;

/// `lo + ⌊v · hi / 2³²⌋` in `lo`, or in the register before it; a Cortex-M3 destroys `hi` and lr.
#[cfg(q31_kernel = "smmla")]
macro_rules! fold {
    ($lo:literal, $v:literal, $hi:literal) => {
        fold!($lo, $lo, $v, $hi)
    };
    ($to:literal, $lo:literal, $v:literal, $hi:literal) => {
        concat!("smmla ", $to, ", ", $v, ", ", $hi, ", ", $lo, "\n")
    };
}
#[cfg(q31_kernel = "smull")]
macro_rules! fold {
    ($lo:literal, $v:literal, $hi:literal) => {
        fold!($lo, $lo, $v, $hi)
    };
    ($to:literal, $lo:literal, $v:literal, $hi:literal) => {
        concat!("smull ", $hi, ", lr, ", $v, ", ", $hi, "\nadd ", $to, ", ", $lo, ", lr\n")
    };
}

/// Sixteen coefficients, and what the second of six axes is multiplied with, which they are.
#[cfg(q31_kernel = "smmla")]
macro_rules! keep {
    () => {
        sixteen!("lr")
    };
}
#[cfg(q31_kernel = "smull")]
macro_rules! keep {
    () => {
        concat!(sixteen!("r7"), "str r7, [sp]\n")
    };
}

/// Sixteen coefficients, and the second of six axes, to r7.
#[cfg(q31_kernel = "smmla")]
macro_rules! second {
    () => {
        concat!(sixteen!("r7"), "ldr r8, [sp, #4]\n", fold!("r7", "r8", "lr"))
    };
}
#[cfg(q31_kernel = "smull")]
macro_rules! second {
    () => {
        concat!(sixteen!("r7"), "ldrd r8, r9, [sp]\n", fold!("r7", "r9", "r8"))
    };
}

/// Two axes of two: the four numbers before r0, in ascending registers, to the first of them.
macro_rules! quad {
    ($a:literal, $b:literal, $c:literal, $d:literal) => {
        concat!(
            "ldmdb r0!, {{",
            $a,
            ", ",
            $b,
            ", ",
            $c,
            ", ",
            $d,
            "}}\n",
            fold!($a, "r6", $b),
            fold!($c, "r6", $d),
            fold!($a, "r5", $c),
        )
    };
}

/// Four axes of two: the sixteen numbers before r0 to a register.
macro_rules! sixteen {
    ($to:literal) => {
        concat!(
            quad!("r7", "r8", "r9", "r10"),
            quad!("r8", "r9", "r10", "r11"),
            fold!("r8", "r4", "r7"),
            quad!("r9", "r10", "r11", "r12"),
            quad!("r7", "r10", "r11", "r12"),
            fold!("r7", "r4", "r9"),
            fold!($to, "r7", "r3", "r8"),
        )
    };
}

/// An axis of four: the four numbers before r0, in ascending registers, to the first of them.
macro_rules! four {
    ($a:literal, $b:literal, $c:literal, $d:literal) => {
        concat!(
            "ldmdb r0!, {{",
            $a,
            ", ",
            $b,
            ", ",
            $c,
            ", ",
            $d,
            "}}\n",
            fold!($c, "r6", $d),
            fold!($b, "r6", $c),
            fold!($a, "r6", $b),
        )
    };
}

/// A result, r7, is put in its place; on with the next one.
macro_rules! next {
    () => {
        "str r7, [r1, #-4]!\ncmp r1, r2\nbne 2b\n"
    };
}

/// Six axes of two.
#[inline(always)]
pub(super) fn six(v: &[i32; 6], tiles: &[[i32; 64]], out: &mut [i32]) {
    #[unsafe(naked)]
    unsafe extern "C" fn all(_: *const i32, _: *mut i32, _: *mut i32, _: &[i32; 6]) {
        naked_asm!(concat!(
            // On the stack, in room that r0 to r3 make: what the second observable is multiplied with, the second
            // observable, the first one, what it is multiplied with.
            "push {{r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, lr}}\n",
            "ldrd r4, r5, [r3], #8\n",
            "strd r5, r4, [sp, #4]\n",
            "ldm r3, {{r3, r4, r5, r6}}\n",
            "2:\n",
            keep!(),
            second!(),
            "str r7, [sp, #12]\n",
            keep!(),
            second!(),
            "ldrd r8, r9, [sp, #8]\n",
            fold!("r7", "r8", "r9"),
            next!(),
            "pop {{r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, pc}}\n",
        ))
    }
    if let Some(tiles) = tiles.get(..out.len())
        && !out.is_empty()
    {
        let (from, to) = (tiles.as_ptr_range(), out.as_mut_ptr_range());
        // SAFETY: reads 64 numbers before `from.end` for every number before `to.end` that it writes,
        // until the first one is written; there is at least one, and there are as many tiles.
        unsafe { all(from.end.cast(), to.end, to.start, v) }
    }
}

/// Four axes of two.
#[inline(always)]
pub(super) fn four(v: &[i32; 4], tiles: &[[i32; 16]], out: &mut [i32]) {
    #[unsafe(naked)]
    unsafe extern "C" fn all(_: *const i32, _: *mut i32, _: *mut i32, _: &[i32; 4]) {
        naked_asm!(concat!(
            "push {{r4, r5, r6, r7, r8, r9, r10, r11, lr}}\n",
            "ldm r3, {{r3, r4, r5, r6}}\n",
            "2:\n",
            sixteen!("r7"),
            next!(),
            "pop {{r4, r5, r6, r7, r8, r9, r10, r11, pc}}\n",
        ))
    }
    if let Some(tiles) = tiles.get(..out.len())
        && !out.is_empty()
    {
        let (from, to) = (tiles.as_ptr_range(), out.as_mut_ptr_range());
        // SAFETY: as for six axes, with 16 numbers.
        unsafe { all(from.end.cast(), to.end, to.start, v) }
    }
}

/// Two axes of four.
#[inline(always)]
pub(super) fn cubic(v: &[i32; 2], tiles: &[[i32; 16]], out: &mut [i32]) {
    #[unsafe(naked)]
    unsafe extern "C" fn all(_: *const i32, _: *mut i32, _: *mut i32, _: &[i32; 2]) {
        naked_asm!(concat!(
            "push {{r4, r5, r6, r7, r8, r9, r10, r11, lr}}\n",
            "ldrd r5, r6, [r3]\n",
            "2:\n",
            four!("r7", "r8", "r9", "r10"),
            four!("r8", "r9", "r10", "r11"),
            fold!("r8", "r5", "r7"),
            four!("r9", "r10", "r11", "r12"),
            fold!("r9", "r5", "r8"),
            four!("r7", "r8", "r10", "r11"),
            fold!("r7", "r5", "r9"),
            next!(),
            "pop {{r4, r5, r6, r7, r8, r9, r10, r11, pc}}\n",
        ))
    }
    if let Some(tiles) = tiles.get(..out.len())
        && !out.is_empty()
    {
        let (from, to) = (tiles.as_ptr_range(), out.as_mut_ptr_range());
        // SAFETY: as for four axes of two.
        unsafe { all(from.end.cast(), to.end, to.start, v) }
    }
}
