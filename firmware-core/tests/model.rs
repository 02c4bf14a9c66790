//! What metadata and coefficients have to be to make a model.

mod fixtures;

use firmware_core::capacity::{MAX_LAG, MAX_OUTPUTS, MAX_STATES};
use firmware_core::dictionary::{DictionaryError, Source};
use firmware_core::model::{
    Model, ModelError, ModelRepr, Space, State, Structure, Symmetry, Target,
};
use firmware_core::{PredictError, Predictor, PredictorState};
use fixtures::{at, hermite, input, repr, scaled, state};

fn refused(repr: ModelRepr<'static>) -> ModelError {
    Structure::try_from(repr).unwrap_err()
}

/// The one-state model with something changed.
fn changed(change: impl FnOnce(&mut ModelRepr<'static>)) -> ModelRepr<'static> {
    let mut repr = fixtures::one_state();
    change(&mut repr);
    repr
}

#[test]
fn metadata_come_back_from_a_structure() {
    for repr in fixtures::all() {
        assert_eq!(fixtures::structure(&repr).to_repr(), repr);
    }
}

#[test]
fn scalars_that_cannot_be() {
    assert_eq!(refused(changed(|r| r.states.clear())), ModelError::NoState);
    for time in [0.0, -0.1, f32::NAN, f32::INFINITY] {
        assert_eq!(refused(changed(|r| r.sample_time_s = time)), ModelError::SampleTime);
    }
    let limit = ModelError::Number { field: "limit of a state", index: 0 };
    for bad in [[1.0, 1.0], [1.0, -1.0], [f32::NAN, 1.0], [0.0, f32::NAN]] {
        assert_eq!(refused(changed(|r| r.states[0].limit = bad)), limit);
    }
    let unbounded = changed(|r| r.states[0].limit = [f32::NEG_INFINITY, f32::INFINITY]);
    assert!(Structure::try_from(unbounded).is_ok());
    let range = ModelError::Number { field: "range of an input", index: 0 };
    for bad in [[1.0, 1.0], [f32::NAN, 1.0], [f32::NEG_INFINITY, 1.0], [0.0, f32::INFINITY]] {
        assert_eq!(refused(changed(|r| r.inputs[0].range = bad)), range);
    }
    let scale = ModelError::Number { field: "centre or gain of an observable", index: 1 };
    for (centre, gain) in [(0.0, 0.0), (f32::NAN, 1.0), (0.0, f32::NAN), (0.0, f32::INFINITY)] {
        let bad = scaled(Source::Input(0), 0, centre, gain);
        assert_eq!(refused(changed(|r| r.observables[1] = bad)), scale);
    }
}

#[test]
fn observables_that_are_not_there() {
    let coordinates =
        [state("x", Space::Line, Target::Absolute), state("phi", Space::Circle, Target::Absolute)];
    let with = |o| repr("r", &coordinates, &[input("u")], Symmetry::None, &[o], &[(&[], 0)]);
    let lag = MAX_LAG as u8;
    for bad in [
        at(Source::State(1), 0),
        at(Source::State(2), 0),
        at(Source::State(255), 0),
        at(Source::Sin(0), 0),
        at(Source::Cos(0), 0),
        at(Source::Sin(200), 0),
        at(Source::Cos(8), 0),
        at(Source::Input(1), 0),
        at(Source::Increment(2), 1),
        at(Source::Increment(0), 0),
        at(Source::State(0), lag + 1),
        at(Source::Input(0), 255),
        scaled(Source::Sin(1), 0, 0.1, 1.0),
        scaled(Source::Cos(1), 0, 0.0, 2.0),
    ] {
        assert_eq!(refused(with(bad)), ModelError::Observable { observable: 0 }, "{bad:?}");
    }
    for good in [
        at(Source::Increment(1), lag),
        at(Source::Sin(1), lag),
        scaled(Source::State(0), 3, 1.0, -2.0),
    ] {
        let structure = fixtures::structure(&with(good));
        assert_eq!(structure.lag(), usize::from(good.lag));
    }
}

#[test]
fn what_a_symmetry_excludes_does_not_enter() {
    let line = |target| state("x", Space::Line, target);
    let angle = |target| state("phi", Space::Circle, target);
    let (by, to) = (Target::Increment, Target::Absolute);
    let pose = [line(by), line(by), angle(by), line(to)];
    let with = |states: &[State<'static>], symmetry, o| {
        Structure::try_from(repr("r", states, &[input("u")], symmetry, &[o], &[(&[], 0)]))
    };
    let se2 = |x, y, heading| Symmetry::Se2 { x, y, heading };
    let shift = |coordinates| Symmetry::Translation { coordinates };

    let observable = Err(ModelError::Observable { observable: 0 });
    for lag in [0, 2] {
        for source in [Source::State(0), Source::State(1), Source::Sin(2), Source::Cos(2)] {
            assert_eq!(with(&pose, se2(0, 1, 2), at(source, lag)), observable);
            assert_eq!(with(&pose, shift(0b0111), at(source, lag)), observable);
            assert!(with(&pose, Symmetry::None, at(source, lag)).is_ok());
        }
        assert!(with(&pose, se2(0, 1, 2), at(Source::State(3), lag)).is_ok());
    }
    for i in 0..3 {
        assert!(with(&pose, se2(0, 1, 2), at(Source::Increment(i), 1)).is_ok());
    }

    let symmetry = |coordinate| Err(ModelError::Symmetry { coordinate });
    let any = at(Source::Input(0), 0);
    assert_eq!(with(&pose, se2(0, 0, 2), any), symmetry(0));
    assert_eq!(with(&pose, se2(0, 2, 2), any), symmetry(2));
    assert_eq!(with(&pose, se2(0, 1, 1), any), symmetry(1));
    assert_eq!(with(&pose, se2(0, 3, 2), any), symmetry(3));
    assert_eq!(with(&pose, se2(4, 1, 2), any), symmetry(4));
    assert_eq!(with(&pose, se2(0, 1, 255), any), symmetry(255));
    assert_eq!(with(&pose, shift(0b1000), any), symmetry(3));
    assert_eq!(with(&pose, shift(0b1000_0000), any), symmetry(7));
    assert!(with(&pose, shift(0), any).is_ok());
    assert!(with(&pose, shift(0b0111), any).is_ok());
}

#[test]
fn errors_of_the_dictionary_are_passed_on() {
    let found = refused(changed(|r| r.factors[0] = hermite(7, 1)));
    assert_eq!(found, ModelError::Dictionary(DictionaryError::Factor { factor: 0 }));
}

#[test]
fn numbers_that_do_not_fit_the_metadata() {
    let structure = || fixtures::structure(&fixtures::one_state());
    let with = |coefficients: &[f32], ranges: Option<&[f32]>| {
        Model::new(structure(), coefficients, ranges).map(|_| ())
    };
    let mismatch =
        |field, expected, found| Err(ModelError::DimensionMismatch { field, expected, found });
    let good = [1.0; 4];
    assert_eq!(with(&good, None), Ok(()));
    assert_eq!(with(&good[..3], None), mismatch("coefficients", 4, 3));
    assert_eq!(with(&[1.0; 5], None), mismatch("coefficients", 4, 5));
    assert_eq!(with(&[], None), mismatch("coefficients", 4, 0));
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let found = with(&[0.0, 0.0, bad, bad], None);
        assert_eq!(found, Err(ModelError::NotFinite { coefficient: 2 }));
    }
    assert_eq!(with(&good, Some(&[0.0, 1.0])), mismatch("ranges", 4, 2));
    assert_eq!(with(&good, Some(&[])), mismatch("ranges", 4, 0));
    assert_eq!(with(&good, Some(&[0.0, 1.0, 2.0, 2.0])), Ok(()));
    for bad in [[1.0, 0.0], [f32::NAN, 0.0], [0.0, f32::NAN]] {
        let ranges = [0.0, 1.0, bad[0], bad[1]];
        let number = ModelError::Number { field: "trained range of an observable", index: 1 };
        assert_eq!(with(&good, Some(&ranges)), Err(number));
    }
}

#[test]
fn an_absolute_angle_has_two_outputs() {
    let angles = [state("phi", Space::Circle, Target::Absolute); MAX_STATES];
    let full = repr("r", &angles, &[], Symmetry::None, &[], &[(&[], 0)]);
    assert_eq!(fixtures::structure(&full).outputs(), MAX_OUTPUTS);
    assert_eq!(fixtures::structure(&fixtures::translation()).outputs(), 4);
    assert_eq!(fixtures::structure(&fixtures::lagged()).outputs(), 2);
}

#[test]
fn an_empty_model_predicts_nothing() {
    let model = Model::<f32>::empty();
    assert_eq!((model.structure().outputs(), model.coefficients_per_output()), (0, 0));
    let predictor = Predictor::new(&model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &[]).unwrap();
    assert_eq!(predictor.step(&mut state, &[]), Ok(()));
    assert_eq!(predictor.coordinates(&state, &mut []), Ok(()));
    let mut untouched = [1.0; 3];
    predictor.rollout_held(&mut state, &[], &mut untouched).unwrap();
    assert_eq!(untouched, [1.0; 3]);
    let found = 1;
    let mismatch = PredictError::DimensionMismatch { field: "coordinates", expected: 0, found };
    assert_eq!(predictor.observe(&mut state, &[], &[0.0]), Err(mismatch));
    state.clear();
    assert_eq!(state, PredictorState::new());
}
