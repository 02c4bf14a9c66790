//! The folds of [`dense`](super::dense) for a Cortex-M4F, with as many coefficients at once as its registers
//! hold.
//!
//! `vmla` rounds the product and the sum on its own, as `lo + v * hi` in Rust does: the bits are the same. A
//! block of coefficients is loaded with one instruction and folded where it lies, the fastest axis first, so
//! that n coefficients take n − 1 multiply-adds and n/16 loads.
//!
//! `asm!` takes no float registers on this target, naked functions do.

use core::arch::naked_asm;
use core::cell::Cell;

use super::dense::Run;
use super::direct::Constants;
use crate::capacity::REGISTERS;
use crate::history::LONG;
use crate::registers::FromFirst;
use crate::scalar::sealed::Sealed;
use crate::scalar::{COS, HALF_PI, LONGEST, ROUND, SHORTEST, SIN};

/// Loads registers `$first` to `$last`.
macro_rules! load {
    ($first:literal $last:literal) => {
        concat!("vldmia r0!, {{s", $first, "-s", $last, "}}\n")
    };
}

/// `lo = lo + v * hi` for each `lo hi`.
macro_rules! fold {
    ($v:literal: $($lo:literal $hi:literal),+) => {
        concat!($("vmla.f32 s", $lo, ", s", $v, ", s", $hi, "\n"),+)
    };
}

/// Sixteen coefficients of four axes of two, to the first register.
macro_rules! sixteen {
    ($a:literal $b:literal $c:literal $d:literal; $s0:literal $s1:literal $s2:literal $s3:literal
     $s4:literal $s5:literal $s6:literal $s7:literal $s8:literal $s9:literal $s10:literal $s11:literal
     $s12:literal $s13:literal $s14:literal $s15:literal) => {
        concat!(
            load!($s0 $s15),
            fold!($d: $s0 $s1, $s2 $s3, $s4 $s5, $s6 $s7, $s8 $s9, $s10 $s11, $s12 $s13, $s14 $s15),
            fold!($c: $s0 $s2, $s4 $s6, $s8 $s10, $s12 $s14),
            fold!($b: $s0 $s4, $s8 $s12),
            fold!($a: $s0 $s8)
        )
    };
}

/// Sixteen coefficients into registers n to n + 15, folded to register n.
macro_rules! sixteen_at {
    (0 $a:literal $b:literal $c:literal $d:literal) => {
        sixteen!($a $b $c $d; 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15)
    };
    (1 $a:literal $b:literal $c:literal $d:literal) => {
        sixteen!($a $b $c $d; 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16)
    };
    (2 $a:literal $b:literal $c:literal $d:literal) => {
        sixteen!($a $b $c $d; 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17)
    };
    (3 $a:literal $b:literal $c:literal $d:literal) => {
        sixteen!($a $b $c $d; 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18)
    };
}

/// Sixty-four coefficients of six axes of two, to register n, the first of three neighbours; their values are in
/// registers 26 to 31.
macro_rules! sixty_four_at {
    ($n:tt $second:tt $third:tt) => {
        concat!(
            sixteen_at!($n 28 29 30 31), sixteen_at!($second 28 29 30 31), fold!(27: $n $second),
            sixteen_at!($second 28 29 30 31), sixteen_at!($third 28 29 30 31),
            fold!(27: $second $third), fold!(26: $n $second)
        )
    };
}

/// Sixteen coefficients of two axes of four into registers, folded to the first one.
macro_rules! four_by_four {
    ($s0:literal $s1:literal $s2:literal $s3:literal $s4:literal $s5:literal $s6:literal $s7:literal
     $s8:literal $s9:literal $s10:literal $s11:literal $s12:literal $s13:literal $s14:literal
     $s15:literal; $a:literal $b:literal) => {
        concat!(
            load!($s0 $s15),
            fold!($b: $s2 $s3, $s6 $s7, $s10 $s11, $s14 $s15),
            fold!($b: $s1 $s2, $s5 $s6, $s9 $s10, $s13 $s14),
            fold!($b: $s0 $s1, $s4 $s5, $s8 $s9, $s12 $s13),
            fold!($a: $s8 $s12, $s4 $s8, $s0 $s4)
        )
    };
}

/// A function that folds tiles one after the other. It may use registers 0 to 15 as it likes; `saved` says
/// that it uses others, too.
macro_rules! kernel {
    ($(#[$doc:meta])* $name:ident, $first_v:literal $last_v:literal, $($body:expr),+) => {
        kernel!(@ $(#[$doc])* $name, "", "", $first_v $last_v, $($body),+);
    };
    ($(#[$doc:meta])* saved $name:ident, $first_v:literal $last_v:literal, $($body:expr),+) => {
        kernel!(@ $(#[$doc])* $name, "vpush {{d8-d15}}", "vpop {{d8-d15}}", $first_v $last_v, $($body),+);
    };
    (@ $(#[$doc:meta])* $name:ident, $save:literal, $restore:literal,
     $first_v:literal $last_v:literal, $($body:expr),+) => {
        $(#[$doc])*
        ///
        /// # Safety
        /// `from` has `tiles` tiles of coefficients, `to` room for a number of each, and neither overlaps the
        /// other; `v` has a number per axis; `tiles` is at least 1.
        #[unsafe(naked)]
        unsafe extern "C" fn $name(from: *const f32, to: *mut f32, tiles: usize, v: *const f32) {
            naked_asm!(
                // The assembler is not told what the target has.
                ".fpu fpv4-sp-d16",
                $save,
                concat!("vldmia r3, {{s", $first_v, "-s", $last_v, "}}"),
                "2:",
                $($body,)+
                "vstmia r1!, {{s0}}",
                "subs r2, r2, #1",
                "bne 2b",
                $restore,
                "bx lr",
            )
        }
    };
}

/// Four coefficients of two axes of two, to the first register.
macro_rules! four {
    ($($s0:literal $s1:literal $s2:literal $s3:literal),+) => {
        concat!($(load!($s0 $s3), fold!(15: $s0 $s1, $s2 $s3), fold!(14: $s0 $s2)),+)
    };
}

kernel!(two_1, 15 15, load!(0 1), fold!(15: 0 1));

/// As the others, eight tiles at a time as long as there are as many: folding what is held first leaves many.
///
/// # Safety
/// As the others.
#[unsafe(naked)]
unsafe extern "C" fn two_2(from: *const f32, to: *mut f32, tiles: usize, v: *const f32) {
    naked_asm!(
        ".fpu fpv4-sp-d16",
        "vldmia r3, {{s14-s15}}",
        "subs r2, r2, #8",
        "blo 3f",
        "2:",
        four!(0 1 2 3, 1 2 3 4, 2 3 4 5, 3 4 5 6, 4 5 6 7, 5 6 7 8, 6 7 8 9, 7 8 9 10),
        "vstmia r1!, {{s0-s7}}",
        "subs r2, r2, #8",
        "bhs 2b",
        "3:",
        "adds r2, r2, #8",
        "beq 5f",
        "4:",
        four!(0 1 2 3),
        "vstmia r1!, {{s0}}",
        "subs r2, r2, #1",
        "bne 4b",
        "5:",
        "bx lr",
    )
}

kernel!(two_3, 13 15, load!(0 7), fold!(15: 0 1, 2 3, 4 5, 6 7), fold!(14: 0 2, 4 6), fold!(13: 0 4));
kernel!(saved two_4, 28 31, sixteen_at!(0 28 29 30 31));
kernel!(saved two_5, 27 31,
    sixteen_at!(0 28 29 30 31), sixteen_at!(1 28 29 30 31), fold!(27: 0 1));
kernel!(saved two_6, 26 31, sixty_four_at!(0 1 2));
kernel!(three_1, 15 15, load!(0 2), fold!(15: 1 2, 0 1));
kernel!(three_2, 14 15, load!(0 8),
    fold!(15: 1 2, 4 5, 7 8), fold!(15: 0 1, 3 4, 6 7), fold!(14: 3 6, 0 3));
kernel!(four_1, 15 15, load!(0 3), fold!(15: 2 3, 1 2, 0 1));
kernel!(saved four_2, 30 31, four_by_four!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15; 30 31));
kernel!(five_1, 15 15, load!(0 4), fold!(15: 3 4, 2 3, 1 2, 0 1));
kernel!(six_1, 15 15, load!(0 5), fold!(15: 4 5, 3 4, 2 3, 1 2, 0 1));

/// Scales values and compares them with their ranges: `v = (raw − centre) · gain`. The first bit of the result
/// is set if one is outside: the product of its distances from both ends is then negative.
///
/// # Safety
/// `raw` has `count` numbers and `v` room for them, `ranges` and `scales` have a pair for each.
#[unsafe(naked)]
unsafe extern "C" fn observe_all(
    raw: *const f32,
    ranges: *const [f32; 2],
    scales: *const [f32; 2],
    v: *mut f32,
    count: usize,
) -> u32 {
    naked_asm!(
        ".fpu fpv4-sp-d16",
        "push {{r4-r6, lr}}",
        "ldr r12, [sp, #16]",
        "movs r4, #0",
        "subs r12, r12, #2",
        "blo 3f",
        "2:",
        "vldmia r0!, {{s0-s1}}",
        "vldmia r1!, {{s2-s5}}",
        "vldmia r2!, {{s6-s9}}",
        "vsub.f32 s2, s0, s2",
        "vsub.f32 s3, s3, s0",
        "vsub.f32 s4, s1, s4",
        "vsub.f32 s5, s5, s1",
        "vmul.f32 s2, s2, s3",
        "vmul.f32 s3, s4, s5",
        "vsub.f32 s0, s0, s6",
        "vsub.f32 s1, s1, s8",
        "vmov r5, r6, s2, s3",
        "vmul.f32 s0, s0, s7",
        "vmul.f32 s1, s1, s9",
        "orrs r4, r5",
        "orrs r4, r6",
        "vstmia r3!, {{s0-s1}}",
        "subs r12, r12, #2",
        "bhs 2b",
        "3:",
        "adds r12, r12, #1",
        "bmi 4f",
        "vldr s0, [r0]",
        "vldmia r1, {{s2-s3}}",
        "vldmia r2, {{s6-s7}}",
        "vsub.f32 s2, s0, s2",
        "vsub.f32 s3, s3, s0",
        "vmul.f32 s2, s2, s3",
        "vsub.f32 s0, s0, s6",
        "vmov r5, s2",
        "vmul.f32 s0, s0, s7",
        "orrs r4, r5",
        "vstr s0, [r3]",
        "4:",
        "mov r0, r4",
        "pop {{r4-r6, pc}}",
    )
}

/// [`Scalar::observe`](crate::Scalar::observe).
#[inline(always)]
pub(crate) fn observe(
    raw: &[f32],
    ranges: &[[f32; 2]],
    scales: &[[f32; 2]],
    v: &mut [f32],
) -> bool {
    let count = v.len();
    if raw.len() < count || ranges.len() < count || scales.len() < count {
        return false;
    }
    // SAFETY: there are `count` of everything, and what is borrowed to be written overlaps nothing.
    let outside = unsafe {
        observe_all(raw.as_ptr(), ranges.as_ptr(), scales.as_ptr(), v.as_mut_ptr(), count)
    };
    outside >> 31 == 0
}

/// Puts sine and cosine back on the circle, or goes elsewhere if their direction means nothing: their
/// registers, two more, one for the bits of the square, and where to go.
macro_rules! on_circle {
    ($sin:literal $cos:literal, $square:literal $one:literal, $bits:literal, $lost:literal) => {
        concat!(
            "vmul.f32 s",
            $square,
            ", s",
            $sin,
            ", s",
            $sin,
            "\n",
            "vmla.f32 s",
            $square,
            ", s",
            $cos,
            ", s",
            $cos,
            "\n",
            "vmov ",
            $bits,
            ", s",
            $square,
            "\n",
            "sub ",
            $bits,
            ", ",
            $bits,
            ", #{shortest}\n",
            "cmp ",
            $bits,
            ", #{between}\n",
            "bhs ",
            $lost,
            "\n",
            "vsqrt.f32 s",
            $square,
            ", s",
            $square,
            "\n",
            "vmov.f32 s",
            $one,
            ", #1.0\n",
            "vdiv.f32 s",
            $square,
            ", s",
            $one,
            ", s",
            $square,
            "\n",
            "vmul.f32 s",
            $sin,
            ", s",
            $sin,
            ", s",
            $square,
            "\n",
            "vmul.f32 s",
            $cos,
            ", s",
            $cos,
            ", s",
            $square,
            "\n"
        )
    };
}

/// [`Scalar::on_circle`](crate::Scalar::on_circle).
///
/// # Safety
/// There is a pair at `pair`.
#[unsafe(naked)]
unsafe extern "C" fn circle(pair: *mut [f32; 2]) -> bool {
    naked_asm!(
        ".fpu fpv4-sp-d16",
        "vldmia r0, {{s0-s1}}",
        on_circle!(0 1, 2 3, "r1", "2f"),
        "vstmia r0, {{s0-s1}}",
        "movs r0, #1",
        "bx lr",
        "2:",
        "movs r0, #0",
        "bx lr",
        shortest = const SHORTEST.to_bits(),
        between = const LONGEST.to_bits() - SHORTEST.to_bits(),
    )
}

/// [`Scalar::on_circle`](crate::Scalar::on_circle).
#[inline(always)]
pub(crate) fn on_circle(pair: &mut [f32; 2]) -> bool {
    // SAFETY: it is borrowed to be written.
    unsafe { circle(pair) }
}

/// A function that makes the terms of a sparse model and sums their products with the coefficients of some
/// outputs: where the coefficients of each begin, in which register they are read, and which sums them.
macro_rules! terms {
    ($name:ident, $last:literal $(, $begin:literal)*; $($row:literal $c:literal $sum:literal),+) => {
        /// # Safety
        /// `registers` has 256 numbers; there are `count` products, at least one, and as many of `made`, which
        /// are among the registers; as many coefficients and one more for each output, and room for the outputs.
        #[unsafe(naked)]
        unsafe extern "C" fn $name(
            registers: *const Cell<f32>,
            products: *const [u8; 2],
            made: *const Cell<f32>,
            coefficients: *const f32,
            outputs: *mut f32,
            count: usize,
        ) {
            naked_asm!(
                ".fpu fpv4-sp-d16",
                "push {{r4-r8}}",
                "ldr r12, [sp, #24]",
                "add r7, r12, #1",
                $($begin,)*
                $(concat!("vldmia ", $row, "!, {{s", $sum, "}}"),)+
                "2:",
                "ldrb r7, [r1], #1",
                "ldrb r8, [r1], #1",
                "add r7, r0, r7, lsl #2",
                "add r8, r0, r8, lsl #2",
                "vldr s0, [r7]",
                "vldr s1, [r8]",
                $(concat!("vldmia ", $row, "!, {{s", $c, "}}"),)+
                "vmul.f32 s0, s0, s1",
                "subs r12, r12, #1",
                "vstmia r2!, {{s0}}",
                $(concat!("vmla.f32 s", $sum, ", s", $c, ", s0"),)+
                "bne 2b",
                "ldr r12, [sp, #20]",
                concat!("vstmia r12, {{s8-s", $last, "}}"),
                "pop {{r4-r8}}",
                "bx lr",
            )
        }
    };
}

terms!(terms_1, 8; "r3" 4 8);
terms!(terms_2, 9, "add r4, r3, r7, lsl #2"; "r3" 4 8, "r4" 5 9);
terms!(terms_3, 10, "add r4, r3, r7, lsl #2", "add r5, r4, r7, lsl #2";
    "r3" 4 8, "r4" 5 9, "r5" 6 10);
terms!(terms_4, 11, "add r4, r3, r7, lsl #2", "add r5, r4, r7, lsl #2", "add r6, r5, r7, lsl #2";
    "r3" 4 8, "r4" 5 9, "r5" 6 10, "r6" 7 11);

/// The product of a value's distances from both ends of its range: negative outside.
macro_rules! range {
    ($($v:literal $low:literal $high:literal $to:literal),+) => {
        concat!($(
            "vsub.f32 s", $low, ", s", $v, ", s", $low, "\n",
            "vsub.f32 s", $high, ", s", $high, ", s", $v, "\n",
            "vmul.f32 s", $to, ", s", $low, ", s", $high, "\n"
        ),+)
    };
}

/// `v = (v - centre) * gain`.
macro_rules! scale {
    ($($v:literal $centre:literal $gain:literal),+) => {
        concat!($(
            "vsub.f32 s", $v, ", s", $v, ", s", $centre, "\n",
            "vmul.f32 s", $v, ", s", $v, ", s", $gain, "\n"
        ),+)
    };
}

/// Leaves with 0 unless a coordinate is within its limits; not a number is not.
macro_rules! limit {
    ($($x:literal $low:literal $high:literal),+) => {
        concat!($(
            "vcmp.f32 s", $x, ", s", $low, "\n",
            "vmrs APSR_nzcv, fpscr\n",
            "blt 9f\n",
            "vcmp.f32 s", $x, ", s", $high, "\n",
            "vmrs APSR_nzcv, fpscr\n",
            "bgt 9f\n"
        ),+)
    };
}

/// The outputs, registers 0 to 3, become the present sample if all is well.
macro_rules! drive_end {
    () => {
        concat!(
            limit!(0 20 21, 1 22 23),
            on_circle!(2 3, 4 5, "r2", "9f"),
            "vstmia r1, {{s0-s3}}\n",
            "vpop {{d8-d15}}\n",
            "movs r0, #1\n",
            "bx lr\n",
            "9:\n",
            "vpop {{d8-d15}}\n",
            "movs r0, #0\n",
            "bx lr\n"
        )
    };
}

/// A step: six observables are compared with their ranges and scaled, the coefficients of two outputs at a time
/// folded, the prediction compared with its limits and put back on the circle. Whether it was made; nothing has
/// changed if not.
///
/// # Safety
/// `raw` has the present sample and the inputs, six numbers, and four more that it writes; `coefficients` has
/// 256, `ranges` six pairs, `constants` centre and gain of each and two pairs of limits.
#[unsafe(naked)]
unsafe extern "C" fn drive_step(
    coefficients: *const f32,
    raw: *mut f32,
    ranges: *const [f32; 2],
    constants: *const [f32; 2],
) -> bool {
    naked_asm!(
        ".fpu fpv4-sp-d16",
        "vpush {{d8-d15}}",
        "vldmia r1, {{s26-s31}}",
        "vldmia r2, {{s0-s11}}",
        range!(26 0 1 12, 27 2 3 13, 28 4 5 14, 29 6 7 15, 30 8 9 16, 31 10 11 17),
        "vldmia r3!, {{s0-s11}}",
        "vldmia r3, {{s20-s23}}",
        "vmov r2, r12, s12, s13",
        "orrs r2, r12",
        "vmov r3, r12, s14, s15",
        "orrs r2, r3",
        "orrs r2, r12",
        "vmov r3, r12, s16, s17",
        "orrs r2, r3",
        "orrs r2, r12",
        "bmi 9f",
        // Sine and cosine are never scaled.
        scale!(26 0 1, 27 2 3, 30 8 9, 31 10 11),
        // Behind the inputs, where nothing is kept.
        "add r12, r1, #24",
        "movs r2, #2",
        "2:",
        sixty_four_at!(0 1 2),
        sixty_four_at!(1 2 3),
        "vstmia r12!, {{s0-s1}}",
        "subs r2, r2, #1",
        "bne 2b",
        "vldmdb r12!, {{s0-s3}}",
        drive_end!(),
        shortest = const SHORTEST.to_bits(),
        between = const LONGEST.to_bits() - SHORTEST.to_bits(),
    )
}

/// The same with the inputs folded already: four observables, 64 coefficients.
///
/// # Safety
/// `raw` has the present sample, four numbers; `coefficients` has 64, `ranges` four pairs, `constants` as before.
#[unsafe(naked)]
unsafe extern "C" fn drive_held_step(
    coefficients: *const f32,
    raw: *mut f32,
    ranges: *const [f32; 2],
    constants: *const [f32; 2],
) -> bool {
    naked_asm!(
        ".fpu fpv4-sp-d16",
        "vpush {{d8-d15}}",
        "vldmia r1, {{s28-s31}}",
        "vldmia r2, {{s0-s7}}",
        range!(28 0 1 8, 29 2 3 9, 30 4 5 10, 31 6 7 11),
        "vldmia r3, {{s0-s3}}",
        "adds r3, r3, #48",
        "vldmia r3, {{s20-s23}}",
        "vmov r2, r12, s8, s9",
        "orrs r2, r12",
        "vmov r3, r12, s10, s11",
        "orrs r2, r3",
        "orrs r2, r12",
        "bmi 9f",
        scale!(28 0 1, 29 2 3),
        sixteen_at!(0 28 29 30 31),
        sixteen_at!(1 28 29 30 31),
        sixteen_at!(2 28 29 30 31),
        sixteen_at!(3 28 29 30 31),
        drive_end!(),
        shortest = const SHORTEST.to_bits(),
        between = const LONGEST.to_bits() - SHORTEST.to_bits(),
    )
}

/// The pose at r1 (x, y, heading, sine, cosine) moves on by the outputs in registers 0 to 2; r3 is where the
/// limits are. Sine and cosine are those of [`Scalar::sin_cos_within`](crate::Scalar::sin_cos_within).
macro_rules! pose_end {
    () => {
        concat!(
            "vldmia r1, {{s3-s7}}\n",
            "adr r12, 8f\n",
            "vldmia r12, {{s11-s22}}\n",
            "vmul.f32 s8, s7, s0\n",
            "vmls.f32 s8, s6, s1\n",
            "vadd.f32 s3, s8, s3\n",
            "vmul.f32 s9, s6, s0\n",
            "vmla.f32 s9, s7, s1\n",
            "vadd.f32 s4, s9, s4\n",
            // Hundreds of turns are no turn; an angle that has to be wrapped is left to others.
            "vabs.f32 s8, s2\n",
            "vcmp.f32 s8, s11\n",
            "vmrs APSR_nzcv, fpscr\n",
            "bgt 9f\n",
            "vadd.f32 s5, s2, s5\n",
            "vneg.f32 s8, s12\n",
            "vcmp.f32 s5, s12\n",
            "vmrs APSR_nzcv, fpscr\n",
            "bhi 9f\n",
            "vcmp.f32 s5, s8\n",
            "vmrs APSR_nzcv, fpscr\n",
            "ble 9f\n",
            "vldmia r3, {{s24-s27}}\n",
            limit!(3 24 25, 4 26 27),
            // How many quarters, and what is left of the angle.
            "vmov.f32 s8, s14\n",
            "vmla.f32 s8, s5, s13\n",
            "vmov r2, s8\n",
            "vsub.f32 s8, s8, s14\n",
            "vmov.f32 s9, s5\n",
            "vmls.f32 s9, s8, s15\n",
            "vmls.f32 s9, s8, s16\n",
            "vmul.f32 s10, s9, s9\n",
            "vmla.f32 s18, s17, s10\n",
            "vmla.f32 s21, s20, s10\n",
            "vmov.f32 s7, #1.0\n",
            "vmov.f32 s8, #0.5\n",
            "vmla.f32 s19, s18, s10\n",
            "vmla.f32 s22, s21, s10\n",
            "vmul.f32 s6, s10, s9\n",
            "vmls.f32 s7, s8, s10\n",
            "vmul.f32 s10, s10, s10\n",
            "vmla.f32 s9, s19, s6\n",
            "vmla.f32 s7, s22, s10\n",
            "lsls r12, r2, #31\n",
            "vmov r0, s9\n",
            "vmov r12, s7\n",
            "beq 2f\n",
            "vmov r0, s7\n",
            "vmov r12, s9\n",
            "2:\n",
            // The sine of the third and fourth quarter is negative, the cosine of the second and third.
            "adds r3, r2, #1\n",
            "and r2, r2, #2\n",
            "and r3, r3, #2\n",
            "eor r0, r0, r2, lsl #30\n",
            "eor r12, r12, r3, lsl #30\n",
            "vmov s6, s7, r0, r12\n",
            "vstmia r1, {{s3-s7}}\n",
            "vpop {{d8-d15}}\n",
            "movs r0, #1\n",
            "bx lr\n",
            "9:\n",
            "vpop {{d8-d15}}\n",
            "movs r0, #0\n",
            "bx lr\n",
            ".p2align 2\n",
            "8: .word {long}, {pi}, {quarters}, {round}, {high}, {low}\n",
            ".word {sin_0}, {sin_1}, {sin_2}, {cos_0}, {cos_1}, {cos_2}\n"
        )
    };
}

/// A function that ends with [`pose_end`].
macro_rules! pose {
    ($(#[$doc:meta])* $name:ident, $($body:expr),+) => {
        $(#[$doc])*
        #[unsafe(naked)]
        unsafe extern "C" fn $name(
            from: *const f32,
            registers: *mut f32,
            ranges: *const [f32; 2],
            constants: *const [f32; 2],
        ) -> bool {
            naked_asm!(
                ".fpu fpv4-sp-d16",
                "vpush {{d8-d15}}",
                $($body,)+
                pose_end!(),
                long = const LONG.to_bits(),
                pi = const core::f32::consts::PI.to_bits(),
                quarters = const core::f32::consts::FRAC_2_PI.to_bits(),
                round = const ROUND.to_bits(),
                high = const HALF_PI[0].to_bits(),
                low = const HALF_PI[1].to_bits(),
                sin_0 = const SIN[0].to_bits(),
                sin_1 = const SIN[1].to_bits(),
                sin_2 = const SIN[2].to_bits(),
                cos_0 = const COS[0].to_bits(),
                cos_1 = const COS[1].to_bits(),
                cos_2 = const COS[2].to_bits(),
            )
        }
    };
}

pose!(
    /// A step: two inputs are compared with their ranges and scaled, the coefficients folded, and the pose
    /// moves on. Whether it did; nothing has changed if not.
    ///
    /// # Safety
    /// `from` has 48 coefficients, `registers` seven numbers, `ranges` two pairs, `constants` centre and gain of
    /// each and two pairs of limits.
    planar_step,
    "vldmia r1!, {{s28-s29}}",
    "vldmia r2, {{s0-s3}}",
    range!(28 0 1 4, 29 2 3 5),
    "vldmia r3!, {{s6-s9}}",
    "vmov r2, r12, s4, s5",
    "orrs r2, r12",
    "bmi 9f",
    scale!(28 6 7, 29 8 9),
    four_by_four!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15; 28 29),
    four_by_four!(1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16; 28 29),
    four_by_four!(2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17; 28 29)
);

pose!(
    /// The same from the outputs.
    ///
    /// # Safety
    /// `from` has three outputs, `registers` a pose, five numbers, `constants` the limits of x and y.
    planar_held_step,
    "vldmia r0, {{s0-s2}}"
);

/// Of each shape of a [`Run`].
static KERNELS: [unsafe extern "C" fn(*const f32, *mut f32, usize, *const f32); 12] =
    [two_1, two_2, two_3, two_4, two_5, two_6, three_1, three_2, four_1, four_2, five_1, six_1];

/// Folds as many tiles as there are coefficients and room for; whether there is a kernel for the run.
#[inline(always)]
pub(crate) fn fold(run: Run, from: &[f32], to: &mut [f32], v: &[f32]) -> bool {
    let Some(kernel) = KERNELS.get(usize::from(run.shape)) else { return false };
    // Those with a kernel have a size.
    let tiles = to.len().min(from.len().checked_div(run.size()).unwrap_or(0));
    if tiles == 0 || v.len() < run.count() {
        return true;
    }
    // SAFETY: there are as many coefficients and values as the kernel reads, `to` has `tiles` numbers, and what
    // is borrowed to be written overlaps nothing.
    unsafe { kernel(from.as_ptr(), to.as_mut_ptr(), tiles, v.as_ptr()) };
    true
}

impl Sealed for f32 {
    #[inline(always)]
    fn terms(
        registers: &[Cell<f32>; REGISTERS],
        products: &[[u8; 2]],
        made: &[Cell<f32>],
        coefficients: &[f32],
        outputs: &mut [f32],
    ) {
        let kernel = match outputs.len() {
            0 => return,
            1 => terms_1,
            2 => terms_2,
            3 => terms_3,
            _ => terms_4,
        };
        let count = products.len();
        let row = count.wrapping_add(1);
        let enough = coefficients.len() >= row.wrapping_mul(outputs.len());
        if count == 0 || made.len() < count || !enough {
            // The constants alone.
            for (output, constant) in outputs.iter_mut().zip(coefficients.iter().step_by(row)) {
                *output = *constant;
            }
            return;
        }
        // SAFETY: there is as much of everything as is read and written, an index has a byte and finds one of 256
        // registers, and cells may be written through shared references.
        unsafe {
            kernel(
                registers.as_ptr(),
                products.as_ptr(),
                made.as_ptr(),
                coefficients.as_ptr(),
                outputs.as_mut_ptr(),
                count,
            )
        };
    }

    #[inline(always)]
    fn drive(
        constants: &Constants,
        ranges: &[[f32; 2]; 6],
        coefficients: &[f32; 256],
        registers: &mut FromFirst<f32>,
    ) -> bool {
        // SAFETY: types say how many ranges, coefficients and constants there are, and that there are more than ten
        // registers.
        unsafe {
            drive_step(
                coefficients.as_ptr(),
                registers.as_mut_ptr(),
                ranges.as_ptr(),
                constants.as_ptr(),
            )
        }
    }

    #[inline(always)]
    fn drive_held(
        constants: &Constants,
        ranges: &[[f32; 2]; 6],
        present: &mut [f32; 4],
        held: &[f32; 64],
    ) -> bool {
        // SAFETY: types say how many numbers there are.
        unsafe {
            drive_held_step(
                held.as_ptr(),
                present.as_mut_ptr(),
                ranges.as_ptr(),
                constants.as_ptr(),
            )
        }
    }

    #[inline(always)]
    fn planar(
        constants: &Constants,
        ranges: &[[f32; 2]; 2],
        coefficients: &[f32; 48],
        registers: &mut FromFirst<f32>,
    ) -> bool {
        // SAFETY: types say how many ranges, coefficients and constants there are, and that there are more than
        // seven registers.
        unsafe {
            planar_step(
                coefficients.as_ptr(),
                registers.as_mut_ptr(),
                ranges.as_ptr(),
                constants.as_ptr(),
            )
        }
    }

    #[inline(always)]
    fn planar_held(constants: &Constants, pose: &mut [f32; 5], outputs: &[f32; 3]) -> bool {
        let [_, _, limits @ ..] = constants;
        let limits = limits.as_ptr();
        // SAFETY: types say how many outputs and limits there are, and what a pose is; ranges are not read.
        unsafe { planar_held_step(outputs.as_ptr(), pose.as_mut_ptr(), limits, limits) }
    }
}
