//! The two float types a model is evaluated in.

use core::fmt::Debug;
use core::ops::{Add, Div, Mul, Neg, Sub};

use crate::kernel::{Run, fold_portable};
#[cfg(cortex_m4f)]
use crate::kernel::{cortex_m4f, fold_axis};

/// The square of the length of (sin, cos) has to be from the first to below the second one, or their direction
/// means nothing.
pub(crate) const SHORTEST: f32 = 1.0 / LONGEST;
pub(crate) const LONGEST: f32 = (1 << 20) as f32;

pub(crate) mod sealed {
    use core::cell::Cell;

    use super::Scalar;
    use crate::capacity::REGISTERS;
    use crate::kernel::Constants;
    use crate::registers::FromFirst;

    /// What a controller may have a kernel for: that of a Cortex-M4F is in [`cortex_m4f`](crate::kernel).
    pub trait Sealed: Sized {
        /// The terms of a sparse model, products of registers, and its first outputs, up to four.
        #[inline(always)]
        fn terms(
            registers: &[Cell<Self>; REGISTERS],
            products: &[[u8; 2]],
            made: &[Cell<Self>],
            coefficients: &[Self],
            outputs: &mut [Self],
        ) where
            Self: Scalar,
        {
            crate::kernel::terms(registers, products, made, coefficients, outputs);
        }

        /// A step of the paper's drive from its ranges and coefficients; its registers begin with the present
        /// sample and the inputs. Whether it was made: nothing has changed if not, as on machines without a
        /// kernel for it.
        #[inline(always)]
        fn drive(
            _: &Constants,
            _: &[[Self; 2]; 6],
            _: &[Self; 256],
            _: &mut FromFirst<Self>,
        ) -> bool {
            false
        }

        /// The same with the inputs held, from what they have left of the coefficients.
        #[inline(always)]
        fn drive_held(
            _: &Constants,
            _ranges: &[[Self; 2]; 6],
            _present: &mut [Self; 4],
            _held: &[Self; 64],
        ) -> bool {
            false
        }

        /// A step of a planar pose from its ranges and coefficients; its registers begin with the two inputs
        /// and x, y, heading, its sine and cosine. Whether it was made, as in [`drive`](Self::drive).
        #[inline(always)]
        fn planar(
            _: &Constants,
            _: &[[Self; 2]; 2],
            _: &[Self; 48],
            _: &mut FromFirst<Self>,
        ) -> bool {
            false
        }

        /// The same from the outputs that inputs lead to, which are held.
        #[inline(always)]
        fn planar_held(_: &Constants, _pose: &mut [Self; 5], _outputs: &[Self; 3]) -> bool {
            false
        }
    }

    #[cfg(not(cortex_m4f))]
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// What the lift needs of a number: addition, subtraction, multiplication.
pub trait Number:
    Copy + Default + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
    /// 0
    const ZERO: Self;
    /// 1
    const ONE: Self;
}

/// Numbers side by side, for lifting `N` samples at once; every lane is rounded as on its own.
///
/// ```
/// use firmware_core::Lanes;
/// assert_eq!((Lanes([1.0, 2.0]) * Lanes([3.0, 4.0]) + Lanes([0.5, 0.5])).0, [3.5, 8.5]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(transparent)]
pub struct Lanes<S, const N: usize>(pub [S; N]);

impl<S: Number, const N: usize> Default for Lanes<S, N> {
    #[inline(always)]
    fn default() -> Self {
        Self([S::ZERO; N])
    }
}

macro_rules! lanes {
    ($operator:ident, $function:ident) => {
        impl<S: Number, const N: usize> $operator for Lanes<S, N> {
            type Output = Self;
            #[inline(always)]
            fn $function(mut self, other: Self) -> Self {
                for (a, b) in self.0.iter_mut().zip(other.0) {
                    *a = a.$function(b);
                }
                self
            }
        }
    };
}

lanes!(Add, add);
lanes!(Sub, sub);
lanes!(Mul, mul);

impl<S: Number, const N: usize> Number for Lanes<S, N> {
    const ZERO: Self = Self([S::ZERO; N]);
    const ONE: Self = Self([S::ONE; N]);
}

/// `f32` on the controller, `f64` in the trainer.
///
/// The elementary functions call `libm` by name. std's and num-traits' versions differ from it in
/// the last bit of about one value in seventy, and which of them a generic `sin` means changes with
/// the crates that happen to be in the build; laptop and controller would then disagree.
pub trait Scalar:
    sealed::Sealed + Number + Debug + PartialOrd + Div<Output = Self> + Neg<Output = Self> + 'static
{
    /// π
    const PI: Self;
    /// 2π
    const TAU: Self;

    /// The same number; `f32` to `f64` is exact.
    fn from_f32(value: f32) -> Self;
    /// `(sin, cos)` of an angle in radians. In `f32` our own polynomials, off by at most 9.3e-8 for
    /// angles in (−π, π]; larger ones are [wrapped](Self::wrap) first, which turns them by up to
    /// 2.8e-8 of their size, less than what rounding them to `f32` has turned them by.
    fn sin_cos(self) -> (Self, Self) {
        self.wrap().sin_cos_within()
    }
    /// [`sin_cos`](Self::sin_cos) of an angle that is wrapped.
    fn sin_cos_within(self) -> (Self, Self);
    /// The angle of the point `(x, self)`, in \[−π, π\]: −π just below the negative axis, where the angle
    /// rounds to it.
    fn atan2(self, x: Self) -> Self;
    /// The square root, rounded correctly.
    fn root(self) -> Self;
    /// What the division towards zero leaves over, exact, with the sign of `self`.
    fn rem(self, divisor: Self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// The first bit is set if a number, which is not NaN, is below `low` or above `high`: a
    /// difference is negative, and not rounded to 0, exactly if the first number is smaller. It may
    /// also be set where infinite numbers are equal.
    fn outside(self, low: Self, high: Self) -> u32;

    /// Puts sine and cosine back on the circle, one rounded square root and one quotient for both; `false`,
    /// and nothing done, if they are a thousand times too long or too short, or not finite.
    #[inline]
    fn on_circle(pair: &mut [Self; 2]) -> bool {
        let [s, c] = *pair;
        let square = s * s + c * c;
        if !(square >= Self::from_f32(SHORTEST) && square < Self::from_f32(LONGEST)) {
            return false;
        }
        let shrink = Self::ONE / square.root();
        *pair = [s * shrink, c * shrink];
        true
    }

    /// Scales the values of observables, `v = (raw − centre) · gain`, and compares them, which have to be
    /// finite, with their ranges: whether all are inside. `raw` has shape `[n]`, `ranges` shape `[n, 2]`,
    /// `scales` with centre and gain shape `[n, 2]`, `v` shape `[n]`.
    #[inline]
    fn observe(raw: &[Self], ranges: &[[Self; 2]], scales: &[[f32; 2]], v: &mut [Self]) -> bool {
        let mut inside = true;
        for (((to, raw), [low, high]), [centre, gain]) in
            v.iter_mut().zip(raw).zip(ranges).zip(scales)
        {
            inside &= *raw >= *low && *raw <= *high;
            *to = (*raw - Self::from_f32(*centre)) * Self::from_f32(*gain);
        }
        inside
    }

    /// [`kernel::fold`](crate::kernel::fold): the same bits as [`fold_portable`], whatever the machine.
    #[inline]
    fn fold(run: Run, from: &[Self], to: &mut [Self], v: &[Self]) {
        fold_portable(run, from, to, v);
    }

    /// The same angle in (−π, π] \[rad\].
    ///
    /// ```
    /// use firmware_core::Scalar;
    /// assert_eq!(0.5_f64.wrap(), 0.5);
    /// assert!((4.0_f64.wrap() - (4.0 - core::f64::consts::TAU)).abs() < 1e-15);
    /// assert_eq!((-core::f64::consts::PI).wrap(), core::f64::consts::PI);
    /// ```
    #[inline]
    fn wrap(self) -> Self {
        if self > -Self::PI && self <= Self::PI { self } else { wrap(self) }
    }
}

/// [`Scalar::wrap`] of an angle that is not there yet.
#[cold]
#[inline(never)]
fn wrap<S: Scalar>(angle: S) -> S {
    // The remainder and one turn more or less are exact, so that no rounding at the seam and no
    // large angle leaves the interval.
    let turn = angle.rem(S::TAU);
    if turn > S::PI {
        turn - S::TAU
    } else if turn <= -S::PI {
        turn + S::TAU
    } else {
        turn
    }
}

impl Number for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
}

impl Number for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
}

/// 1.5 · 2²³: added to a small number, it leaves it rounded to an integer in the last bits.
pub(crate) const ROUND: f32 = 12_582_912.0;
/// π/2 in two parts; up to two of the first are exact, and so is taking them away from an angle.
pub(crate) const HALF_PI: [f32; 2] = [core::f32::consts::FRAC_PI_2, -4.371_139e-8];
/// (sin x − x) / x³ in x², highest power first, for |x| ≤ π/4. This and the next two are Moshier's
/// minimax polynomials (Cephes, `sinf.c` and `atanf.c`).
pub(crate) const SIN: [f32; 3] = [-1.951_529_6e-4, 8.332_161e-3, -1.666_665_5e-1];
/// (cos x − 1 + x²/2) / x⁴ in x², highest power first, for |x| ≤ π/4.
pub(crate) const COS: [f32; 3] = [2.443_315_7e-5, -1.388_731_6e-3, 4.166_664_6e-2];
/// (arctan x − x) / x³ in x², highest power first, for |x| ≤ tan π/8.
const ATAN: [f32; 4] = [8.053_744_5e-2, -1.387_768_6e-1, 1.997_771_1e-1, -3.333_295e-1];
/// tan π/8
const TAN_PI_8: f32 = 0.414_213_56;

impl Scalar for f32 {
    const PI: Self = core::f32::consts::PI;
    const TAU: Self = core::f32::consts::TAU;

    #[inline]
    fn from_f32(value: f32) -> Self {
        value
    }
    // Calls of their own: the constants of an inlined one would be loaded where it is not needed.
    #[inline(never)]
    fn sin_cos_within(self) -> (Self, Self) {
        let x = self;
        let shifted = x * core::f32::consts::FRAC_2_PI + ROUND;
        let (turns, quarter) = (shifted - ROUND, shifted.to_bits());
        let [high, low] = HALF_PI;
        let r = (x - turns * high) - turns * low;
        let square = r * r;
        let ([a, b, c], [d, e, f]) = (SIN, COS);
        let sin = ((a * square + b) * square + c) * (square * r) + r;
        let cos = ((d * square + e) * square + f) * (square * square) + (1.0 - 0.5 * square);
        let (sin, cos) = if quarter & 1 == 0 { (sin, cos) } else { (cos, sin) };
        // The sine of the third and fourth quarter is negative, the cosine of the second and third.
        let sign = |quarter: u32| (quarter & 2) << 30;
        (
            f32::from_bits(sin.to_bits() ^ sign(quarter)),
            f32::from_bits(cos.to_bits() ^ sign(quarter.wrapping_add(1))),
        )
    }
    #[inline(never)]
    fn atan2(self, x: Self) -> Self {
        let (width, height) = (x.abs(), self.abs());
        let (short, long) = if height > width { (width, height) } else { (height, width) };
        // arctan q = π/4 + arctan((q − 1) / (q + 1))
        let (above, below, octant) = if short > TAN_PI_8 * long {
            (short - long, short + long, core::f32::consts::FRAC_PI_4)
        } else {
            (short, long, 0.0)
        };
        let q = if below > 0.0 { above / below } else { 0.0 };
        let square = q * q;
        let [a, b, c, d] = ATAN;
        let series = ((a * square + b) * square + c) * square + d;
        let angle = octant + (series * (square * q) + q);
        let angle = if height > width { core::f32::consts::FRAC_PI_2 - angle } else { angle };
        let angle = if x < 0.0 { core::f32::consts::PI - angle } else { angle };
        if self < 0.0 { -angle } else { angle }
    }
    #[inline]
    fn root(self) -> Self {
        libm::sqrtf(self)
    }
    // A difference at a time, each of them exact. libm's divides integers of 64 bits, which is a kilobyte
    // of a controller's flash.
    #[inline]
    fn rem(self, divisor: Self) -> Self {
        let (mut rest, divisor) = (self.abs(), divisor.abs());
        if !(rest.is_finite() && divisor > 0.0) {
            return f32::NAN;
        }
        let mut step = divisor;
        while step <= rest * 0.5 {
            step += step;
        }
        loop {
            if rest >= step {
                rest -= step;
            }
            if step <= divisor {
                return rest.copysign(self);
            }
            step *= 0.5;
        }
    }
    #[inline]
    fn abs(self) -> Self {
        self.abs()
    }
    #[inline]
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline]
    fn outside(self, low: Self, high: Self) -> u32 {
        (self - low).to_bits() | (high - self).to_bits()
    }
    #[cfg(cortex_m4f)]
    #[inline]
    fn fold(run: Run, from: &[Self], to: &mut [Self], v: &[Self]) {
        if !cortex_m4f::fold(run, from, to, v) {
            fold_axis(run, from, to, v);
        }
    }
    #[cfg(cortex_m4f)]
    #[inline]
    fn observe(raw: &[Self], ranges: &[[Self; 2]], scales: &[[f32; 2]], v: &mut [Self]) -> bool {
        cortex_m4f::observe(raw, ranges, scales, v)
    }
    #[cfg(cortex_m4f)]
    #[inline]
    fn on_circle(pair: &mut [Self; 2]) -> bool {
        cortex_m4f::on_circle(pair)
    }
}

impl Scalar for f64 {
    const PI: Self = core::f64::consts::PI;
    const TAU: Self = core::f64::consts::TAU;

    #[inline]
    fn from_f32(value: f32) -> Self {
        value.into()
    }
    #[inline]
    fn sin_cos(self) -> (Self, Self) {
        libm::sincos(self)
    }
    #[inline]
    fn sin_cos_within(self) -> (Self, Self) {
        libm::sincos(self)
    }
    #[inline]
    fn atan2(self, x: Self) -> Self {
        libm::atan2(self, x)
    }
    #[inline]
    fn root(self) -> Self {
        libm::sqrt(self)
    }
    #[inline]
    fn rem(self, divisor: Self) -> Self {
        libm::fmod(self, divisor)
    }
    #[inline]
    fn abs(self) -> Self {
        self.abs()
    }
    #[inline]
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline]
    fn outside(self, low: Self, high: Self) -> u32 {
        (((self - low).to_bits() | (high - self).to_bits()) >> 32) as u32
    }
}
