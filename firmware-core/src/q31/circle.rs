//! Angles in integers: sine and cosine in Q31, and angles as the signed 32-bit fraction of a turn
//! (2³¹ is π, and wrapping is the overflow of an addition).

use super::kernel::high;

/// sin(π/4 · u) / u in u², highest power first, in Q37, Q35, Q33, Q31: minimax for |u| ≤ 1, off by 2.4e-9.
const SIN: [i32; 4] = [-4_941_550, 85_555_993, -693_598_004, 1_686_629_708];
/// (cos(π/4 · u) − 1) / u² in u², highest power first, in Q38, Q36, Q34, Q32: off by 5e-11.
const COS: [i32; 4] = [970_267, -22_398_331, 272_375_234, -1_324_675_869];
/// Arc tangent of 2⁰, 2⁻¹, … 2⁻²⁹.
const ATAN: [i32; 30] = [
    536_870_912,
    316_933_406,
    167_458_907,
    85_004_756,
    42_667_331,
    21_354_465,
    10_679_838,
    5_340_245,
    2_670_163,
    1_335_087,
    667_544,
    333_772,
    166_886,
    83_443,
    41_722,
    20_861,
    10_430,
    5_215,
    2_608,
    1_304,
    652,
    326,
    163,
    81,
    41,
    20,
    10,
    5,
    3,
    1,
];
/// 1 / (2 √n) in n within [0.25, 2): highest power first, in Q32, Q31, Q29; off by 7.4 % at most.
const HALF_RECIPROCAL_ROOT: [i32; 3] = [1_083_731_345, -1_889_754_434, 606_848_070];
/// How much shorter than 1 sine and cosine may be before they have lost their direction: 2⁻¹⁰.
pub(super) const SHORTEST: u32 = 10;

/// The upper word of the product.
#[inline(always)]
fn high_unsigned(a: u32, b: u32) -> u32 {
    ((u64::from(a) * u64::from(b)) >> 32) as u32
}

/// Sine and cosine of an angle, off by at most 6e-9.
#[inline(never)]
pub(super) fn sin_cos(angle: i32) -> (i32, i32) {
    let quarter = angle.wrapping_add(1 << 29) >> 30;
    let u = angle.wrapping_sub(quarter << 30) << 2;
    // Q30: a product with it has a quarter of the scale.
    let square = high(u, u);
    let [a, b, c, d] = SIN;
    let sin =
        d.wrapping_add(high(square, c.wrapping_add(high(square, b.wrapping_add(high(square, a))))));
    let sin = high(u, sin) << 1;
    let [a, b, c, d] = COS;
    let cos =
        d.wrapping_add(high(square, c.wrapping_add(high(square, b.wrapping_add(high(square, a))))));
    let cos = (1_i32 << 30).wrapping_add(high(square, cos)).min((1 << 30) - 1) << 1;
    let (sin, cos) = if quarter & 1 == 0 { (sin, cos) } else { (cos, sin) };
    // The sine of the third and fourth quarter is negative, the cosine of the second and third. Neither is −1,
    // of which there is no opposite.
    (
        if quarter & 2 == 0 { sin } else { sin.wrapping_neg() },
        if quarter.wrapping_add(1) & 2 == 0 { cos } else { cos.wrapping_neg() },
    )
}

/// The angle of a point (cos, sin) on the circle in Q31, off by at most 3e-8 rad (CORDIC).
#[inline(never)]
pub(super) fn angle(sin: i32, cos: i32) -> i32 {
    // Room for what the rotations add, a factor of 1.65.
    let (mut x, mut y) = (cos >> 2, sin >> 2);
    let mut angle = 0_i32;
    if x < 0 {
        (x, y) = (x.wrapping_neg(), y.wrapping_neg());
        angle = i32::MIN;
    }
    for (shift, part) in ATAN.iter().enumerate() {
        let (dx, dy) = (x >> shift, y >> shift);
        if y >= 0 {
            (x, y) = (x.wrapping_add(dy), y.wrapping_sub(dx));
            angle = angle.wrapping_add(*part);
        } else {
            (x, y) = (x.wrapping_sub(dy), y.wrapping_add(dx));
            angle = angle.wrapping_sub(*part);
        }
    }
    angle
}

/// `y (3 − 4 n y²) / 2` for y in Q31 and n in Q30.
#[inline(always)]
fn newton(n: u32, y: u32) -> u32 {
    let product = high_unsigned(n, high_unsigned(y, y)) << 4;
    ((u64::from(y) * u64::from((3_u32 << 30).wrapping_sub(product))) >> 31) as u32
}

/// Leading zeros of the larger one; −2ᵏ has one more than 2ᵏ.
#[inline(always)]
pub(super) fn zeros(sin: i32, cos: i32) -> u32 {
    ((sin ^ (sin >> 31)) | (cos ^ (cos >> 31))).leading_zeros()
}

/// Sine and cosine of any scale back on the circle and in Q31, off by at most 3e-8 of their length; with their
/// leading [`zeros`].
#[inline(never)]
pub(super) fn on_circle(sin: i32, cos: i32, zeros: u32) -> (i32, i32) {
    // The larger one within [2³⁰, 2³¹]: the square n of the length, in Q30, is within [0.25, 2). Without the
    // 1, which is nothing, it could be 2.
    let up = zeros.wrapping_sub(1) & 31;
    let (sin, cos) = (sin << up, cos << up);
    let square = high(sin, sin).wrapping_sub(1).wrapping_add(high(cos, cos));
    let [a, b, c] = HALF_RECIPROCAL_ROOT;
    let guess = c.wrapping_add(high(square, b.wrapping_add(high(square, a) << 1)));
    // In Q31: y = 1 / (2 √n) by Newton's method.
    let n = square as u32;
    let y = newton(n, newton(n, (guess as u32) << 2));
    let product = ((u64::from(n) * u64::from(high_unsigned(y, y))) >> 28) as u32;
    let y = high_unsigned(y, (3_u32 << 30).wrapping_sub(product)) as i32;
    // Half of it in Q31 is it in Q30, and products are in Q28.
    let put = |x: i32| high(x, y).clamp(-(1 << 28), (1 << 28) - 1) << 3;
    (put(sin), put(cos))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What an angle stands for \[rad\].
    fn radians(angle: i32) -> f64 {
        f64::from(angle) / 2_147_483_648.0 * core::f64::consts::PI
    }

    fn share(x: i32) -> f64 {
        f64::from(x) / 2_147_483_648.0
    }

    /// Angles all around, the corners among them.
    fn angles() -> impl Iterator<Item = i32> {
        let corners = [i32::MIN, i32::MAX, 0, -1, 1, 1 << 29, (1 << 29) - 1, -(1 << 29), 1 << 30];
        (0..1_000_003_i64).map(|i| (i * 4_295 - 2_147_483_648) as i32).chain(corners)
    }

    #[test]
    fn sine_and_cosine_of_every_angle() {
        for angle in angles() {
            let (sin, cos) = sin_cos(angle);
            let (true_sin, true_cos) = libm::sincos(radians(angle));
            assert!((share(sin) - true_sin).abs() <= 6e-9, "{angle}");
            assert!((share(cos) - true_cos).abs() <= 6e-9, "{angle}");
        }
    }

    #[test]
    fn angle_of_every_point() {
        for of in angles() {
            let (sin, cos) = libm::sincos(radians(of));
            let q31 = |x: f64| libm::rint(x * 2_147_483_648.0) as i32;
            let off = angle(q31(sin), q31(cos)).wrapping_sub(of);
            assert!(radians(off).abs() <= 3e-8, "{of} {off}");
        }
    }

    #[test]
    fn points_of_any_length_back_on_the_circle() {
        for (i, of) in angles().enumerate() {
            let (sin, cos) = libm::sincos(radians(of));
            // Lengths from 2²¹ to 2³¹: shorter ones have fewer digits than the bound.
            let length = 2_147_483_647.0 * libm::exp2(-((i % 1_000) as f64) / 100.0);
            let (a, b) = (libm::rint(sin * length) as i32, libm::rint(cos * length) as i32);
            let (sin, cos) = on_circle(a, b, zeros(a, b));
            let root = libm::hypot(a.into(), b.into());
            assert!((share(sin) - f64::from(a) / root).abs() <= 3e-8, "{a} {b} {sin}");
            assert!((share(cos) - f64::from(b) / root).abs() <= 3e-8, "{a} {b} {cos}");
        }
        // The last numbers there are.
        for a in [i32::MIN + 1, i32::MAX, 1 << 30, -(1 << 30)] {
            for b in [a, 0, i32::MAX] {
                let (sin, cos) = on_circle(a, b, zeros(a, b));
                let root = libm::hypot(a.into(), b.into());
                assert!((share(sin) - f64::from(a) / root).abs() <= 3e-8, "{a} {b} {sin}");
                assert!((share(cos) - f64::from(b) / root).abs() <= 3e-8, "{a} {b} {cos}");
            }
        }
    }
}
