//! The two float types a model is evaluated in.

use core::fmt::Debug;
use core::ops::{Add, Div, Mul, Neg, Sub};

mod sealed {
    pub trait Sealed {}
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
    /// `(sin, cos)` of an angle in radians.
    fn sin_cos(self) -> (Self, Self);
    /// The angle of the point `(x, self)`, in (−π, π].
    fn atan2(self, x: Self) -> Self;
    /// Square root, correctly rounded.
    fn sqrt(self) -> Self;
    /// What the division towards zero leaves over, exact, with the sign of `self`.
    fn rem(self, divisor: Self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;

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
        if self > -Self::PI && self <= Self::PI {
            self
        } else {
            // The remainder and one turn more or less are exact, so that no rounding at the seam
            // and no large angle leaves the interval.
            let turn = self.rem(Self::TAU);
            if turn > Self::PI {
                turn - Self::TAU
            } else if turn <= -Self::PI {
                turn + Self::TAU
            } else {
                turn
            }
        }
    }
}

macro_rules! scalar {
    ($float:ident, $sincos:ident, $atan2:ident, $sqrt:ident, $fmod:ident, $fabs:ident) => {
        impl Number for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
        }

        impl Scalar for $float {
            const PI: Self = core::$float::consts::PI;
            const TAU: Self = core::$float::consts::TAU;

            #[inline]
            fn from_f32(value: f32) -> Self {
                value.into()
            }
            #[inline]
            fn sin_cos(self) -> (Self, Self) {
                libm::$sincos(self)
            }
            #[inline]
            fn atan2(self, x: Self) -> Self {
                libm::$atan2(self, x)
            }
            #[inline]
            fn sqrt(self) -> Self {
                libm::$sqrt(self)
            }
            #[inline]
            fn rem(self, divisor: Self) -> Self {
                libm::$fmod(self, divisor)
            }
            #[inline]
            fn abs(self) -> Self {
                libm::$fabs(self)
            }
            #[inline]
            fn is_finite(self) -> bool {
                self.is_finite()
            }
        }
    };
}

scalar!(f32, sincosf, atan2f, sqrtf, fmodf, fabsf);
scalar!(f64, sincos, atan2, sqrt, fmod, fabs);
