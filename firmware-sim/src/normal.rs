//! Normal deviates that are the same on every machine.

use rand::{Rng, RngExt};

/// One draw from N(0, 1) by the method of Box and Muller (1958), from two uniform draws.
///
/// Own code because the usual sampler takes its logarithm through a trait that switches between
/// `libm` and the system's library with the features of other crates in the build; logs must not.
pub(crate) fn standard_normal(rng: &mut impl Rng) -> f64 {
    let above_zero = 1.0 - rng.random::<f64>();
    let turn = rng.random::<f64>();
    libm::sqrt(-2.0 * libm::log(above_zero)) * libm::cos(std::f64::consts::TAU * turn)
}

#[cfg(test)]
mod tests {
    use super::standard_normal;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn moments_and_tails_are_those_of_the_normal_law() {
        const DRAWS: usize = 200_000;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> = (0..DRAWS).map(|_| standard_normal(&mut rng)).collect();
        let moment = |p: i32| draws.iter().map(|z| z.powi(p)).sum::<f64>() / DRAWS as f64;
        // Each bound is about four standard errors of the moment at this many draws.
        assert!(moment(1).abs() < 0.01);
        assert!((moment(2) - 1.0).abs() < 0.013);
        assert!(moment(3).abs() < 0.035);
        assert!((moment(4) - 3.0).abs() < 0.09);
        let beyond_two = draws.iter().filter(|z| z.abs() > 2.0).count() as f64 / DRAWS as f64;
        assert!((beyond_two - 0.0455).abs() < 0.002);
    }
}
