//! The unnormalised cardinal sine.

/// sin(a) / a, and 1 at 0.
///
/// Needs no series: `libm::sin` keeps its relative precision near 0, so the quotient is good to
/// about two units in the last place everywhere outside the zeros of the sine.
pub(crate) fn sinc(a: f64) -> f64 {
    if a == 0.0 { 1.0 } else { libm::sin(a) / a }
}

#[cfg(test)]
mod tests {
    use super::sinc;

    #[test]
    fn follows_its_series_near_zero() {
        /// Two roundings, of the sine and of the quotient.
        const TOLERANCE: f64 = 2.0 * f64::EPSILON;
        for exponent in -330..=-3 {
            let a = libm::exp10(f64::from(exponent));
            for a in [a, -a] {
                let a2 = a * a;
                let series = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0));
                assert!((sinc(a) - series).abs() <= TOLERANCE, "{a}");
            }
        }
        assert_eq!(sinc(0.0), 1.0);
        assert_eq!(sinc(-0.0), 1.0);
        assert!((sinc(std::f64::consts::FRAC_PI_2) - std::f64::consts::FRAC_2_PI).abs() < 1e-15);
    }
}
