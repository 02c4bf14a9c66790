//! The elementary functions in f32 against libm in f64.

use firmware_core::Scalar;

/// Largest absolute error of sine and cosine of a wrapped angle. The polynomials are good to 3e-8;
/// the rest is rounding to f32, whose half unit in the last place is 3e-8 below 1.
const SIN_COS: f64 = 1.0e-7;
/// Of what an angle beyond half a turn is off by when it is wrapped: |2π − 2π in f32| / 2π.
const WRAP: f64 = 2.8e-8;
/// Largest absolute error of the arc tangent [rad]; half a unit in the last place of π is 1.2e-7.
const ATAN2: f64 = 3.5e-7;

fn sin_cos_error(x: f32) -> f64 {
    let (sin, cos) = x.sin_cos_of_core();
    let (s, c) = libm_sin_cos(f64::from(x));
    (f64::from(sin) - s).abs().max((f64::from(cos) - c).abs())
}

/// `f32` has a method of the same name.
trait OfCore {
    fn sin_cos_of_core(self) -> (f32, f32);
}

impl OfCore for f32 {
    fn sin_cos_of_core(self) -> (f32, f32) {
        Scalar::sin_cos(self)
    }
}

fn libm_sin_cos(x: f64) -> (f64, f64) {
    Scalar::sin_cos(x)
}

fn worst(angles: impl Iterator<Item = f32>) -> (f64, f32) {
    // −π is no wrapped angle.
    angles.filter(|x| *x > -std::f32::consts::PI).fold((0.0, 0.0), |worst, x| {
        let error = sin_cos_error(x);
        if error > worst.0 { (error, x) } else { worst }
    })
}

/// Every `step`-th float from 0 to π, and its opposite.
fn wrapped(step: usize) -> impl Iterator<Item = f32> {
    let last = std::f32::consts::PI.to_bits();
    (0..=last).step_by(step).chain([last]).map(f32::from_bits).flat_map(|x| [x, -x])
}

#[test]
fn sine_and_cosine_of_wrapped_angles() {
    // Spread over the exponents, and evenly over the circle: 2^22 of each and more.
    let by_bits = wrapped(509);
    let evenly =
        (-(1 << 21)..=1 << 21).map(|i| i as f32 * (std::f32::consts::PI / (1 << 21) as f32));
    let (error, at) = worst(by_bits.chain(evenly));
    println!("at most {error:.3e}, at {at}");
    assert!(error <= SIN_COS, "{error:e} at {at:e}");
}

#[test]
#[ignore = "minutes: every f32 in (−π, π]"]
fn sine_and_cosine_of_every_wrapped_angle() {
    let (error, at) = worst(wrapped(1));
    println!("at most {error:.3e}, at {at}");
    assert!(error <= SIN_COS, "{error:e} at {at:e}");
}

#[test]
fn sine_and_cosine_of_any_turn() {
    for exponent in 0..255_u32 {
        for mantissa in (0..1 << 23).step_by((1 << 23) / 101) {
            let x = f32::from_bits(exponent << 23 | mantissa);
            for x in [x, -x] {
                let (sin, cos) = x.sin_cos_of_core();
                assert!(sin.abs() <= 1.0 && cos.abs() <= 1.0, "{x:e}");
                // Beyond that an f32 does not say where on the circle it is.
                if x.abs() < 1e5 {
                    let error = sin_cos_error(x);
                    assert!(error <= SIN_COS + WRAP * f64::from(x.abs()), "{error:e} at {x:e}");
                }
            }
        }
    }
    assert_eq!(0.0_f32.sin_cos_of_core(), (0.0, 1.0));
    for nothing in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let (sin, cos) = nothing.sin_cos_of_core();
        assert!(sin.is_nan() && cos.is_nan());
    }
}

#[test]
fn arc_tangents() {
    let mut worst = (0.0_f64, 0.0, 0.0);
    for i in 0..=1 << 20 {
        let angle = f64::from(i - (1 << 19)) * (std::f64::consts::PI / f64::from(1 << 19));
        for radius in [1e-3, 1.0, 1e3] {
            let (y, x) = ((radius * angle.sin()) as f32, (radius * angle.cos()) as f32);
            let found = f64::from(Scalar::atan2(y, x));
            let error = (found - Scalar::atan2(f64::from(y), f64::from(x))).abs();
            // On the seam the sign of a rounded zero decides.
            if error > worst.0 && error < 6.0 {
                worst = (error, y.into(), x.into());
            }
        }
    }
    println!("at most {:.3e}, at {}, {}", worst.0, worst.1, worst.2);
    assert!(worst.0 <= ATAN2, "{worst:?}");
    let quarter = std::f32::consts::FRAC_PI_2;
    assert_eq!(Scalar::atan2(0.0_f32, 0.0), 0.0);
    assert_eq!(Scalar::atan2(0.0_f32, 1.0), 0.0);
    assert_eq!(Scalar::atan2(0.0_f32, -1.0), std::f32::consts::PI);
    assert_eq!(Scalar::atan2(-0.0_f32, -1.0), std::f32::consts::PI);
    // Rounded: a prediction may be −π, too.
    assert_eq!(Scalar::atan2(-1e-9_f32, -1.0), -std::f32::consts::PI);
    assert_eq!(Scalar::atan2(-1e-18_f64, -1.0), -std::f64::consts::PI);
    assert_eq!(Scalar::atan2(1.0_f32, 0.0), quarter);
    assert_eq!(Scalar::atan2(-1.0_f32, 0.0), -quarter);
}

#[test]
fn back_on_the_circle() {
    let mut worst = 0.0_f64;
    // As long and as short as is accepted: between 1e-3 and 1e3.
    for i in 1..1 << 20 {
        let length = 10.0_f64.powf(f64::from(i) * 6.0 / f64::from(1 << 20) - 3.0);
        let (sin, cos) = f64::from(i).sin_cos();
        let mut pair = [(length * sin) as f32, (length * cos) as f32];
        assert!(f32::on_circle(&mut pair), "{length}");
        let [s, c] = pair.map(f64::from);
        worst = worst.max((s.hypot(c) - 1.0).abs()).max((s - sin).abs()).max((c - cos).abs());
    }
    println!("at most {worst:.3e}");
    assert!(worst <= 1.8e-7);
    for lost in [[0.0, 0.0], [1024.0, 1.0], [6e-4, 6e-4], [f32::NAN, 0.0], [0.0, f32::INFINITY]] {
        let mut pair = lost;
        assert!(!f32::on_circle(&mut pair), "{lost:?}");
        assert_eq!(pair.map(f32::to_bits), lost.map(f32::to_bits));
    }
}

#[test]
fn remainders_are_those_of_libm() {
    use std::f32::consts::TAU;
    // Numbers of every size and sign, zeros, infinities and NaN among them.
    let all = || (0..=u32::MAX).step_by(104_729).map(f32::from_bits);
    let mut divisors = vec![TAU, 1.0, f32::MIN_POSITIVE, f32::MAX, f32::INFINITY, 1e-42, 0.0, -3.0];
    divisors.extend(all().step_by(1_777));
    for divisor in divisors {
        for x in all().chain([TAU, -TAU, 2.0 * TAU, 0.0, -0.0, f32::INFINITY, f32::NAN]) {
            let (found, expected) = (Scalar::rem(x, divisor), libm::fmodf(x, divisor));
            let same = found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan();
            assert!(same, "{x:e} and {divisor:e}: {found:e} instead of {expected:e}");
        }
    }
}
