//! Dictionaries: the lift against its definition, the union of distinct terms, what is refused.

mod fixtures;
mod naive;

use firmware_core::capacity::{MAX_BLOCK_FACTORS, MAX_ORDER, MAX_TERMS};
use firmware_core::dictionary::{
    self, Basis, Block, Dictionary, DictionaryError, Factor, Observable, Source,
};
use firmware_core::{Lanes, Scalar};
use fixtures::{Part, at, fourier, hermite};
use proptest::prelude::*;

/// Relative to the largest term: a few roundings of an order-5 recurrence at arguments below 3.
const ROUNDING: f64 = 1e-12;

fn dictionary(
    observables: &[Observable],
    parts: &[Part<'_>],
) -> Result<Dictionary, DictionaryError> {
    let blocks = parts.iter().map(|(own, max_degree)| Block {
        factors: u8::try_from(own.len()).unwrap(),
        max_degree: *max_degree,
    });
    Dictionary::new(
        observables.iter().copied().collect(),
        parts.iter().flat_map(|(own, _)| own.iter().copied()).collect(),
        blocks.collect(),
    )
}

/// x, y, sin φ, cos φ, u₁, u₂
const DRIVE: [Observable; 6] = [
    at(Source::State(0), 0),
    at(Source::State(1), 0),
    at(Source::Sin(2), 0),
    at(Source::Cos(2), 0),
    at(Source::Input(0), 0),
    at(Source::Input(1), 0),
];

fn lift_dense(dictionary: &Dictionary, values: &[f64]) -> Vec<f64> {
    let mut terms = vec![f64::NAN; dictionary.dense_terms()];
    assert_eq!(dictionary.lift_dense(values, &mut terms), terms.len());
    terms
}

fn lift(dictionary: &Dictionary, values: &[f64]) -> Vec<f64> {
    let mut scratch = vec![0.0; dictionary.dense_terms()];
    let mut terms = vec![f64::NAN; dictionary.dense_terms()];
    let count = dictionary.lift(values, &mut scratch, &mut terms);
    terms.truncate(count);
    terms
}

fn assert_close(found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(1.0_f64, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= ROUNDING * largest, "term {i}: {f} instead of {e}");
    }
}

#[test]
fn the_first_factor_is_the_slowest() {
    let d = dictionary(&DRIVE, &[(&[hermite(0, 2), hermite(4, 1)], 0)]).unwrap();
    let (x, u) = (3.0, 10.0);
    let expected = [1.0, u, x, x * u, x * x - 1.0, (x * x - 1.0) * u];
    assert_eq!(lift_dense(&d, &[x, 0.0, 0.0, 0.0, u, 0.0]), expected);
    let digits: Vec<_> = d.term(5).unwrap().1.iter().map(|(f, n)| (f.observable, *n)).collect();
    assert_eq!(digits, [(0, 2), (4, 1)]);
}

/// The seven rows of Table I of the paper, H₁(v) = [1, v].
#[test]
fn lifting_functions_of_the_papers_topologies() {
    let line = |i: u8| vec![Source::State(i)];
    let circle = |i: u8| vec![Source::Sin(i), Source::Cos(i)];
    let rows = [
        vec![line(0)],
        vec![line(0), line(1)],
        vec![line(0), line(1), line(2)],
        vec![circle(0), circle(1)], // S², by two angles
        vec![circle(0), circle(1)], // T²
        vec![line(0), circle(1)],
        vec![line(0), line(1), circle(2)],
    ];
    let values = [0.7, -1.3, 0.4, 2.5, -0.2, 1.9];
    for row in rows {
        let observables: Vec<_> = row.concat().into_iter().map(|s| at(s, 0)).collect();
        let factors: Vec<_> = (0..observables.len()).map(|o| hermite(o as u8, 1)).collect();
        let d = dictionary(&observables, &[(&factors, 0)]).unwrap();
        let n = observables.len();
        let expected =
            values[..n].iter().fold(vec![1.0], |terms, v| naive::kron(&terms, &[1.0, *v]));
        assert_eq!(lift_dense(&d, &values[..n]), expected);
        assert_eq!(lift(&d, &values[..n]), expected);
        assert_eq!(expected.len(), 1 << n);
    }
}

#[test]
fn the_sizes_of_the_papers_robots() {
    for (repr, terms, outputs) in [
        (fixtures::rosbot(), 64, 4),
        (fixtures::soft_leg(), 16, 2),
        (fixtures::arm(), 256, 6),
        (fixtures::se2(), 16, 3),
    ] {
        let structure = fixtures::structure(&repr);
        assert_eq!(structure.dictionary().dense_terms(), terms);
        assert_eq!(structure.outputs(), outputs);
    }
}

#[test]
fn closed_forms_of_hermite_polynomials() {
    for v in [-2.5, -1.0, 0.0, 0.3, 1.0, 3.0] {
        let mut h = [0.0; 6];
        dictionary::hermite(v, &mut h);
        let v2 = v * v;
        let expected = [
            1.0,
            v,
            v2 - 1.0,
            v * (v2 - 3.0),
            v2 * (v2 - 6.0) + 3.0,
            v * (v2 * (v2 - 10.0) + 15.0),
        ];
        assert_close(&h, &expected);
    }
}

#[test]
fn bases_end_where_the_slice_ends() {
    dictionary::hermite::<f64>(2.0, &mut []);
    dictionary::fourier::<f64>(0.6, 0.8, &mut []);
    let mut odd = [0.0; 4];
    dictionary::fourier(0.6_f64, 0.8, &mut odd);
    assert_close(&odd, &[1.0, 0.6, 0.8, 0.96]);
}

#[test]
fn slices_of_another_length_are_filled_as_far_as_they_go() {
    let d = dictionary(&DRIVE, &[(&[hermite(0, 1)], 0), (&[hermite(1, 2)], 0)]).unwrap();
    let values = [2.0, 3.0, 0.0, 1.0, 0.0, 0.0];
    let mut short = [7.0; 4];
    assert_eq!(d.lift_dense(&values, &mut short), 2);
    assert_eq!(short, [1.0, 2.0, 7.0, 7.0]);
    let mut long = [7.0; 9];
    assert_eq!(d.lift_dense(&values, &mut long), 5);
    assert_eq!(long[..6], [1.0, 2.0, 1.0, 3.0, 8.0, 7.0]);
    let (mut scratch, mut lifted) = ([0.0; 5], [7.0; 3]);
    assert_eq!(d.lift(&values, &mut scratch, &mut lifted), 3);
    assert_eq!(lifted, [1.0, 2.0, 3.0]);
    assert_eq!(d.term(5), None);
    assert!(!d.is_distinct(5) && !d.is_distinct(usize::MAX));
}

#[test]
fn the_constant_belongs_to_the_first_block() {
    let blocks: [Part<'_>; 3] = [(&[], 0), (&[hermite(0, 1)], 0), (&[hermite(1, 1)], 0)];
    let values = [2.0, 3.0, 0.0, 1.0, 0.0, 0.0];
    let d = dictionary(&DRIVE, &blocks).unwrap();
    assert_eq!(lift_dense(&d, &values), [1.0, 1.0, 2.0, 1.0, 3.0]);
    assert_eq!(lift(&d, &values), [1.0, 2.0, 3.0]);
    assert_eq!(d.term(0).map(|(block, term)| (block, term.len())), Some((0, 0)));
    let reversed: Vec<_> = blocks.into_iter().rev().collect();
    let d = dictionary(&DRIVE, &reversed).unwrap();
    assert_eq!(lift(&d, &values), [1.0, 3.0, 2.0]);
}

/// sin φ and cos φ are the same terms in a Fourier basis and as H¹; sin 2φ and H² of sin φ are not.
#[test]
fn first_harmonics_are_the_observables_themselves() {
    let (s, c) = (0.6, 0.8);
    let values = [0.0, 0.0, s, c, 5.0, 0.0];
    let harmonics: Part<'_> = (&[fourier(2, 2)], 0);
    let squares: Part<'_> = (&[hermite(2, 2)], 0);
    let cosine: Part<'_> = (&[hermite(3, 1), hermite(4, 1)], 0);
    let (s2, c2) = (2.0 * s * c, c * c - s * s);

    let d = dictionary(&DRIVE, &[harmonics, squares, cosine]).unwrap();
    assert_close(&lift(&d, &values), &[1.0, s, c, s2, c2, s * s - 1.0, 5.0, c * 5.0]);
    let d = dictionary(&DRIVE, &[squares, cosine, harmonics]).unwrap();
    assert_close(&lift(&d, &values), &[1.0, s, s * s - 1.0, 5.0, c, c * 5.0, s2, c2]);
    // A product of two observables is not in a block that has them one at a time.
    let product: Part<'_> = (&[hermite(2, 1), hermite(3, 1)], 0);
    let d = dictionary(&DRIVE, &[harmonics, product]).unwrap();
    assert_close(&lift(&d, &values), &[1.0, s, c, s2, c2, s * c]);
}

#[test]
fn a_block_is_cut_at_its_total_degree() {
    let values = [2.0, 3.0, 0.6, 0.8, 0.0, 0.0];
    let own = [hermite(0, 2), hermite(1, 2)];
    let d = dictionary(&DRIVE, &[(&own, 2)]).unwrap();
    // 1, y, y² − 1, x, x y, x² − 1; x (y² − 1) and beyond are cut off.
    assert_eq!(lift(&d, &values), [1.0, 3.0, 8.0, 2.0, 6.0, 3.0]);
    assert_eq!(d.dense_terms(), 9);
    // What one block cuts off, a later one may hold.
    let d = dictionary(&DRIVE, &[(&own, 2), (&[hermite(0, 1), hermite(1, 2)], 0)]).unwrap();
    assert_eq!(lift(&d, &values), [1.0, 3.0, 8.0, 2.0, 6.0, 3.0, 16.0]);
    // Harmonics count by their number.
    let d = dictionary(&DRIVE, &[(&[fourier(2, 2), hermite(0, 1)], 2)]).unwrap();
    assert_close(&lift(&d, &values), &[1.0, 2.0, 0.6, 1.2, 0.8, 1.6, 0.96, 0.28]);
}

#[test]
fn dictionaries_that_do_not_hold_together() {
    let refused = |parts: &[Part<'_>]| dictionary(&DRIVE, parts).unwrap_err();
    let too_large = |field, capacity, found| DictionaryError::TooLarge { field, capacity, found };
    let factor = |factor| DictionaryError::Factor { factor };

    assert_eq!(refused(&[]), DictionaryError::Factors { claimed: 0, found: 0 });
    let missing = Dictionary::new(
        DRIVE.into_iter().collect(),
        [hermite(0, 1)].into_iter().collect(),
        [Block { factors: 2, max_degree: 0 }].into_iter().collect(),
    );
    assert_eq!(missing, Err(DictionaryError::Factors { claimed: 2, found: 1 }));
    let left_over = Dictionary::new(
        DRIVE.into_iter().collect(),
        [hermite(0, 1), hermite(1, 1)].into_iter().collect(),
        [Block { factors: 1, max_degree: 0 }].into_iter().collect(),
    );
    assert_eq!(left_over, Err(DictionaryError::Factors { claimed: 1, found: 2 }));

    let order = "order of a factor";
    assert_eq!(refused(&[(&[hermite(0, 0)], 0)]), too_large(order, MAX_ORDER.into(), 0));
    assert_eq!(refused(&[(&[hermite(0, 10)], 0)]), too_large(order, MAX_ORDER.into(), 10));
    assert_eq!(refused(&[(&[hermite(0, 255)], 0)]), too_large(order, MAX_ORDER.into(), 255));
    assert_eq!(
        refused(&[(&[hermite(0, 9), hermite(1, 9), hermite(4, 9), hermite(5, 4)], 0)]),
        too_large("terms", MAX_TERMS, 5000)
    );
    let (a, b) = ([hermite(0, 7), hermite(1, 7), hermite(4, 7), hermite(5, 7)], [hermite(0, 1)]);
    assert!(dictionary(&DRIVE, &[(&a, 0)]).is_ok_and(|d| d.dense_terms() == MAX_TERMS));
    assert_eq!(refused(&[(&a, 0), (&b, 0)]), too_large("terms", MAX_TERMS, MAX_TERMS + 2));
    let many = [hermite(0, 1); MAX_BLOCK_FACTORS + 1];
    assert_eq!(
        refused(&[(&many, 0)]),
        too_large("factors of a block", MAX_BLOCK_FACTORS, MAX_BLOCK_FACTORS + 1)
    );

    assert_eq!(refused(&[(&[hermite(6, 1)], 0)]), factor(0));
    assert_eq!(refused(&[(&[hermite(0, 1)], 0), (&[hermite(255, 1)], 0)]), factor(1));
    // Fourier on something that is not the sine of a pair.
    for observable in [0, 1, 3, 5, 255] {
        assert_eq!(refused(&[(&[fourier(observable, 1)], 0)]), factor(0));
    }
    for second in [at(Source::Cos(1), 0), at(Source::Cos(2), 1), at(Source::Sin(1), 0)] {
        let pair = [at(Source::Sin(2), 0), second];
        assert_eq!(dictionary(&pair, &[(&[fourier(0, 1)], 0)]), Err(factor(0)));
    }
    // One observable twice in a block, in whatever basis.
    assert_eq!(refused(&[(&[hermite(0, 1), hermite(0, 2)], 0)]), factor(1));
    assert_eq!(refused(&[(&[fourier(2, 1), hermite(3, 1)], 0)]), factor(1));
    assert_eq!(refused(&[(&[hermite(3, 1), fourier(2, 1)], 0)]), factor(1));
    assert_eq!(refused(&[(&[fourier(2, 1), fourier(2, 2)], 0)]), factor(1));
    // The same name twice, whatever its scale; another lag is another observable.
    let twice = [at(Source::State(0), 1), fixtures::scaled(Source::State(0), 1, 1.0, 2.0)];
    let found = dictionary(&twice, &[(&[], 0)]);
    assert_eq!(found, Err(DictionaryError::Duplicate { observable: 1 }));
    assert!(dictionary(&[twice[0], at(Source::State(0), 0)], &[(&[], 0)]).is_ok());
}

fn of(parts: &[(Vec<Factor>, u8)]) -> Dictionary {
    let parts: Vec<Part<'_>> = parts.iter().map(|(own, cut)| (&own[..], *cut)).collect();
    dictionary(&fixtures::OBSERVABLES, &parts).unwrap()
}

proptest! {
    #[test]
    fn the_lift_is_its_definition(parts in fixtures::parts(), values in fixtures::values()) {
        let d = of(&parts);
        let expected = naive::lift_dense(&d, &values);
        assert_close(&lift_dense(&d, &values), &expected);

        let distinct = naive::distinct(&d);
        prop_assert_eq!(distinct.len(), d.dense_terms());
        for (i, there) in distinct.iter().enumerate() {
            prop_assert_eq!(d.is_distinct(i), *there, "term {}", i);
        }
        let union: Vec<_> =
            expected.iter().zip(&distinct).filter(|(_, there)| **there).map(|(t, _)| *t).collect();
        assert_close(&lift(&d, &values), &union);
    }

    /// Samples lifted side by side are rounded as on their own, to the bit.
    #[test]
    fn lanes_do_not_touch_each_other(
        parts in fixtures::parts(), samples in prop::array::uniform4(fixtures::values()),
    ) {
        let d = of(&parts);
        let lanes: Vec<_> =
            (0..samples[0].len()).map(|o| Lanes(samples.each_ref().map(|v| v[o]))).collect();
        let mut together = vec![Lanes([f64::NAN; 4]); d.dense_terms()];
        prop_assert_eq!(d.lift_dense(&lanes, &mut together), d.dense_terms());
        for (i, sample) in samples.iter().enumerate() {
            let lane: Vec<f64> = together.iter().map(|term| term.0[i]).collect();
            prop_assert_eq!(lane, lift_dense(&d, sample));
        }
    }

    /// The first block always keeps all it holds; a block repeated adds nothing.
    #[test]
    fn a_repeated_block_adds_no_term(parts in fixtures::parts()) {
        let count = |d: &Dictionary| (0..d.dense_terms()).filter(|i| d.is_distinct(*i)).count();
        let once = of(&parts[..1]);
        if parts[0].1 == 0 {
            prop_assert_eq!(count(&once), once.dense_terms());
        }
        let twice = of(&[parts[0].clone(), parts[0].clone()]);
        prop_assert_eq!(count(&twice), count(&once));
        let all = of(&parts);
        let sum: usize = parts.iter().map(|part| count(&of(std::slice::from_ref(part)))).sum();
        prop_assert!(count(&once) <= count(&all) && count(&all) <= sum);
    }

    /// Every dense term is the product of the functions that `term` names.
    #[test]
    fn terms_are_named_after_what_they_are(parts in fixtures::parts(), values in fixtures::values()) {
        let d = of(&parts);
        let terms = lift_dense(&d, &values);
        for (i, term) in terms.iter().enumerate() {
            let (_, digits) = d.term(i).unwrap();
            let mut product = 1.0;
            for (factor, digit) in digits {
                let mut functions = [0.0; 16];
                let o = usize::from(factor.observable);
                match factor.basis {
                    Basis::Hermite => dictionary::hermite(values[o], &mut functions),
                    Basis::Fourier => {
                        dictionary::fourier(values[o], values[o + 1], &mut functions);
                    }
                }
                product *= functions[digit];
            }
            prop_assert!((term - product).abs() <= ROUNDING * product.abs().max(1.0));
        }
    }

    /// D(a ⊗ b) = D(a) ⊗ D(b).
    #[test]
    fn the_lift_is_multiplicative(p in 1_u8..=5, q in 1_u8..=4, r in 1_u8..=5, values in fixtures::values()) {
        let (a, b) = ([hermite(1, p), fourier(2, q)], [hermite(4, r)]);
        let one = |own: &[Factor]| lift_dense(&of(&[(own.to_vec(), 0)]), &values);
        assert_close(&one(&[&a[..], &b].concat()), &naive::kron(&one(&a), &one(&b)));
        assert_close(&one(&[&b[..], &a].concat()), &naive::kron(&one(&b), &one(&a)));
    }

    /// d/dv Hⁿ = n Hⁿ⁻¹ and Hⁿ(−v) = (−1)ⁿ Hⁿ(v), up to the highest order.
    #[test]
    fn hermite_polynomials_have_their_properties(v in -3.0_f64..3.0) {
        const STEP: f64 = 1e-4;
        let h = |v: f64| {
            let mut h = [0.0; MAX_ORDER as usize + 1];
            dictionary::hermite(v, &mut h);
            h
        };
        let (low, here, high, mirrored) = (h(v - STEP), h(v), h(v + STEP), h(-v));
        for n in 1..here.len() {
            let slope = (high[n] - low[n]) / (2.0 * STEP);
            // Central difference: step²/6 times a third derivative below 1e6.
            prop_assert!((slope - n as f64 * here[n - 1]).abs() < 1e-2);
            let sign = if n % 2 == 0 { 1.0 } else { -1.0 };
            prop_assert_eq!(mirrored[n], sign * here[n]);
        }
    }

    #[test]
    fn harmonics_are_sines_and_cosines_of_multiples(phi in -10.0_f64..10.0) {
        let mut f = [0.0; 2 * MAX_ORDER as usize + 1];
        dictionary::fourier(phi.sin(), phi.cos(), &mut f);
        prop_assert_eq!(f[0], 1.0);
        for n in 1..=usize::from(MAX_ORDER) {
            let (sin, cos) = (n as f64 * phi).sin_cos();
            prop_assert!((f[2 * n - 1] - sin).abs() < 1e-13 && (f[2 * n] - cos).abs() < 1e-13);
        }
    }

    /// The same angle, and always in (−π, π].
    #[test]
    fn wrapped_angles(angle in -1e4_f64..1e4) {
        use std::f64::consts::PI;
        let wrapped = angle.wrap();
        prop_assert!(wrapped > -PI && wrapped <= PI);
        prop_assert!((wrapped.sin() - angle.sin()).abs() < 1e-11);
        prop_assert!((wrapped.cos() - angle.cos()).abs() < 1e-11);
        let single = (angle as f32).wrap();
        prop_assert!(single > -std::f32::consts::PI && single <= std::f32::consts::PI);
        // τ in f32 is 1.7e-7 too large, 1,592 turns at most.
        prop_assert!(naive::wrap(f64::from(single) - f64::from(angle as f32)).abs() < 2e-3);
    }
}

/// The floats next to odd multiples of π.
#[test]
fn angles_next_to_the_seam() {
    use std::f32::consts::PI;
    for turns in -1001..=1001 {
        let seam = (f64::from(PI) * f64::from(2 * turns + 1)) as f32;
        let (mut below, mut above) = (seam, seam);
        for _ in 0..3 {
            for angle in [below, above] {
                let wrapped = angle.wrap();
                assert!(wrapped > -PI && wrapped <= PI, "{angle:e} became {wrapped:e}");
            }
            (below, above) = (below.next_down(), above.next_up());
        }
    }
}

/// Where neighbouring floats are more than a turn apart there is no angle left, but still a number
/// in range.
#[test]
fn angles_that_are_too_large_to_mean_anything() {
    use std::f32::consts::PI;
    for angle in [1e6_f32, 1e7, 1e8, 1e9, 1e20, f32::MAX] {
        for angle in [angle, -angle] {
            let wrapped = angle.wrap();
            assert!(wrapped > -PI && wrapped <= PI, "{angle:e} became {wrapped:e}");
        }
    }
    for none in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert!(none.wrap().is_nan());
    }
}
