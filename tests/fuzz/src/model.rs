//! What has to be true of blobs, and of the models that they hold.

use std::f32::consts::PI;

use firmware_core::blob::{
    Aligned, EmitError, ParseError, SelfTest, emit, length, parse_into, self_test, size,
};
use firmware_core::model::{Model, Space};
use firmware_core::{PredictError, Predictor, PredictorState, parse, parse_for, parse_prefix};

/// Steps of a rollout, and samples that are observed beyond those that a model needs.
const STEPS: usize = 6;
/// What a rollout leaves alone keeps this value, a NaN that no arithmetic makes.
const UNTOUCHED: u32 = 0x7FED_CBA9;

static OTHER: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../models/soft-leg/model.bin"));

/// Everything that reads a blob, and that it agrees with itself.
pub fn read(bytes: &[u8]) {
    let (whole, prefix, test) = (parse(bytes), parse_prefix(bytes), self_test(bytes));
    // Into a place where another model was.
    let (mut model, mut state) = (parse(&OTHER.0).expect("a blob"), PredictorState::new());
    assert_eq!(parse_into(bytes, &mut model, &mut state).err(), whole.as_ref().err().copied());
    assert_eq!(model, whole.clone().unwrap_or(Model::empty()));
    assert_eq!(state, PredictorState::new());
    if let Some(beyond) = bytes.get(1..) {
        assert!(parse_prefix(beyond).is_err(), "misaligned");
    }
    let model = match prefix {
        Ok(model) => model,
        Err(error) => {
            // The prefix is all there is, or something follows it.
            let whole = whole.err();
            assert!(whole == Some(error) || matches!(whole, Some(ParseError::Trailing { .. })));
            assert_eq!(test.err(), whole);
            return;
        }
    };
    let end = length(bytes).expect("a blob has a length");
    if end < bytes.len() {
        return read(&bytes[..end]);
    }
    assert_eq!(whole.as_ref(), Ok(&model));
    assert_eq!(parse_for(model.structure().robot(), bytes).as_ref(), Ok(&model));
    // In a slot, with erased flash behind it.
    let slot: Vec<u32> = bytemuck::cast_slice(bytes).iter().copied().chain([u32::MAX]).collect();
    let slot: &[u8] = bytemuck::cast_slice(&slot);
    assert_eq!(parse_prefix(slot).as_ref(), Ok(&model));
    let trailing = ParseError::Trailing { expected: end, found: end + 4 };
    assert_eq!(parse(slot).err(), Some(trailing));
    let test = test.expect("the self-test held");
    written(&model, &test);

    let n = model.structure().states().len();
    let inputs = model.structure().inputs().len();
    predict(&model, test.states.iter().copied(), test.inputs.iter().copied());
    // Anything else: the blob itself as numbers, its last ones first.
    let numbers: &[f32] = bytemuck::cast_slice(bytes);
    let mut numbers = numbers.iter().rev().copied().cycle();
    let rows = model.structure().lag() + STEPS;
    let states: Vec<_> = numbers.by_ref().take(rows * n).collect();
    predict(&model, states, numbers.take(rows * inputs));
}

/// A model that was read is written, and read again as the same one; written again it is the same bytes.
fn written(model: &Model<'_>, test: &SelfTest<'_>) {
    let written = write(model, test.states, test.inputs, test.tolerance).expect("it has predicted");
    let blob: &[u8] = bytemuck::cast_slice(&written);
    let again = parse(blob).expect("what emit writes is a blob");
    assert_eq!(again, *model);
    let test_again = self_test(blob).expect("what emit writes is a blob");
    assert_eq!((test_again.states, test_again.inputs), (test.states, test.inputs));
    let twice = write(&again, test_again.states, test_again.inputs, test_again.tolerance);
    assert_eq!(twice.as_ref(), Ok(&written));
}

/// The blob of a model, in words.
pub fn write(
    model: &Model<'_>,
    states: &[f32],
    inputs: &[f32],
    tolerance: &[f32],
) -> Result<Vec<u32>, EmitError> {
    let mut expected = size(model.structure(), model.terms(), model.ranges().is_some());
    if let Some(bounds) = model.error_bounds() {
        // An entry of the table, three numbers, horizons and bounds.
        expected += 12 + 12 + 4 * (bounds.horizons().len() + bounds.bounds().len());
    }
    let mut out = vec![u32::MAX; expected / 4];
    let room: &mut [u8] = bytemuck::cast_slice_mut(&mut out);
    let found = room.len() - 1;
    let short = emit(model, states, inputs, tolerance, &mut room[..found]);
    let length = emit(model, states, inputs, tolerance, room)?;
    assert_eq!(length, expected);
    assert_eq!(short, Err(EmitError::BufferTooShort { found }));
    Ok(out)
}

/// Observes rows of states, each after a row of inputs, and predicts from each of them.
pub fn predict(
    model: &Model<'_>,
    states: impl IntoIterator<Item = f32>,
    inputs: impl IntoIterator<Item = f32>,
) {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    let (mut states, mut inputs) = (states.into_iter(), inputs.into_iter());
    let mut applied = Vec::new();
    loop {
        let row: Vec<f32> = states.by_ref().take(n).collect();
        if row.len() < n {
            return;
        }
        let before = state.clone();
        let observed = predictor.observe(&mut state, &applied, &row);
        match observed {
            Ok(()) => assert!(row.iter().all(|x| x.is_finite())),
            Err(PredictError::NotFinite { coordinate }) => assert!(!row[coordinate].is_finite()),
            Err(PredictError::InputNotFinite { input }) => assert!(!applied[input].is_finite()),
            Err(error) => panic!("{error:?}"),
        }
        assert!(observed.is_ok() || same(&state, &before), "an error leaves the state as it was");
        applied = inputs.by_ref().take(m).collect();
        applied.resize(m, 0.0);
        ahead(&predictor, &state, &applied);
    }
}

/// Steps, one by one and at once: the same numbers, finite and where they belong, or the same error.
fn ahead(predictor: &Predictor<'_, '_>, start: &PredictorState, input: &[f32]) {
    let structure = predictor.model().structure();
    let n = structure.states().len();
    let mut stepped = start.clone();
    let mut rows = vec![f32::from_bits(UNTOUCHED); n * STEPS];
    let mut result = Ok(());
    for row in rows.chunks_exact_mut(n) {
        let before = stepped.clone();
        result = predictor.step(&mut stepped, input);
        if result.is_err() {
            assert!(same(&stepped, &before), "an error leaves the state as it was");
            break;
        }
        predictor.coordinates(&stepped, row).expect("there is room");
        for (x, state) in row.iter().zip(structure.states()) {
            assert!(x.is_finite(), "{row:?}");
            assert!(*x >= state.limit[0] && *x <= state.limit[1], "{row:?}");
            if state.space == Space::Circle {
                assert!(*x >= -PI && *x <= PI, "{row:?}");
            }
        }
    }
    match result {
        Ok(()) => assert_eq!(stepped.step() as usize, start.step() as usize + STEPS),
        Err(PredictError::Diverged { step }) => assert_eq!(step, stepped.step() + 1),
        Err(PredictError::NotReady { have, need }) => {
            assert!(have < need && need == structure.lag() + 1);
        }
        Err(PredictError::InputNotFinite { input: i }) => assert!(!input[i].is_finite()),
        Err(error) => panic!("{error:?}"),
    }
    let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let inputs = input.repeat(STEPS);
    for held in [true, false] {
        let (mut end, mut path) = (start.clone(), vec![f32::from_bits(UNTOUCHED); n * STEPS]);
        let rolled = match held {
            true => predictor.rollout_held(&mut end, input, &mut path),
            false => predictor.rollout(&mut end, &inputs, &mut path),
        };
        assert_eq!(rolled, result);
        assert_eq!(bits(&path), bits(&rows));
        assert!(same(&end, &stepped));
    }
}

/// Equal, where equality can tell: a change between two huge measurements is no number.
fn same(a: &PredictorState, b: &PredictorState) -> bool {
    a == b || *a != a.clone()
}
