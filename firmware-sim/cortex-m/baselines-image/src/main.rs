//! One prediction from 6 variables by 64 multilinear terms to 4 outputs, as several kernels make it: their
//! instructions, counted as in the image that `measure` runs. `baselines` makes the table.
//!
//! A line per kernel comes out: the language, the name, the instructions without those of an empty function
//! in its place. All must give the numbers of the formula in f64, or the image names the first
//! that does not, and fails.
//!
//! Ours fail, too, if they take more than [`MOST`] says.
//!
//! The model is the paper's differential drive: x, y, sine and cosine of the heading, two wheel speeds. The
//! baselines get the six values centred and scaled, and do nothing but lift and product. Ours is
//! the public step, with everything that makes it a prediction on the robot: history, inputs and trained
//! ranges are checked, the values centred and scaled, sine and cosine put back on the circle, limits and
//! finiteness checked, the state moved on; in a rollout the coordinates are written, too.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::kernel::{Run, fold, fold_portable};
use firmware_core::{Predictor, PredictorState, Scalar};
use nalgebra::{SMatrix, Vector2};

#[path = "../../src/machine.rs"]
mod machine;
#[path = "../../src/shapes.rs"]
mod shapes;

use machine::{count, stack};
use shapes::{COEFFICIENTS, DRIVE, DRIVE_SE2, LEG, Shape};

const VARIABLES: usize = 6;
const TERMS: usize = 64;
const OUTPUTS: usize = 4;
const STATES: usize = 3;

/// Repetitions that are counted together: a tick is then less than a hundredth of an instruction, and the
/// counter has room for 99,000 instructions in each.
const REPETITIONS: u32 = 1_000;
/// Steps of a rollout.
const HORIZON: usize = 10;
/// How far a number may be from that in f64. Rounding to f32 makes less than a tenth of it, in whatever order
/// the terms are summed; a term that is wrong makes hundreds.
const TOLERANCE: f64 = 1e-5;
/// How the names of kernels in Rust end: with their level of optimisation.
const LEVEL: &str = concat!(", ", env!("LEVEL"));

/// x, y \[m\] and heading \[rad\].
const MEASURED: [f32; STATES] = [0.8, -0.7, 0.7];
/// Wheel speeds \[rad/s\].
const INPUT: [f32; 2] = [12.0, 7.0];
/// Bytes of stack that a step of the drive may take.
const STACK: usize = 128;
/// Instructions that ours may take.
const MOST: [(&str, f32); 6] = [
    (PORTABLE, 570.0),
    (ON_CIRCLE, 310.0),
    (STEP, 380.0),
    (HOLD, 190.0),
    (LEG_FOLD, 60.0),
    (SE2_STEP, 200.0),
];
const PORTABLE: &str = "`kernel::fold_portable`";
const ON_CIRCLE: &str = "`kernel::fold`, back on the circle";
const STEP: &str = "`Predictor::step`";
const HOLD: &str = "`Predictor::hold`, a step of ten";
const LEG_FOLD: &str = "soft leg, `kernel::fold`";
const SE2_STEP: &str = "drive by its pose, `Predictor::step`";

type Values = [f32; VARIABLES];
/// Outputs slowest, as in a model.
type Operator = [[f32; TERMS]; OUTPUTS];
type Outputs = [f32; OUTPUTS];
/// `O` is the operator as the kernel likes it to lie.
type Kernel<O> = extern "C" fn(&Values, &O, &mut Outputs);

// SAFETY: all in baselines.c, and reading and writing nothing but these arrays.
unsafe extern "C" {
    safe fn naive_O2(values: &Values, operator: &Operator, outputs: &mut Outputs);
    safe fn naive_O3(values: &Values, operator: &Operator, outputs: &mut Outputs);
    safe fn doubling_O2(values: &Values, operator: &Operator, outputs: &mut Outputs);
    safe fn doubling_O3(values: &Values, operator: &Operator, outputs: &mut Outputs);
    #[cfg(cmsis)]
    safe fn cmsis_vector_O3(values: &Values, operator: &Operator, outputs: &mut Outputs);
    #[cfg(cmsis)]
    safe fn cmsis_matrix_O3(values: &Values, operator: &Operator, outputs: &mut Outputs);
}

/// Lift and product as they are written with nalgebra.
extern "C" fn kronecker(
    values: &Values,
    operator: &SMatrix<f32, OUTPUTS, TERMS>,
    outputs: &mut Outputs,
) {
    let [a, b, c, d, e, f] = values.map(|v| Vector2::new(1.0, v));
    let lift = a.kronecker(&b).kronecker(&c).kronecker(&d).kronecker(&e).kronecker(&f);
    *outputs = (operator * lift).into();
}

/// All axes.
const ALL: Run = Run::new(2, VARIABLES as u8).unwrap();

extern "C" fn folded(values: &Values, operator: &Operator, outputs: &mut Outputs) {
    fold(ALL, operator.as_flattened(), outputs, values);
}

extern "C" fn portable(values: &Values, operator: &Operator, outputs: &mut Outputs) {
    fold_portable(ALL, operator.as_flattened(), outputs, values);
}

fn leg_folded(coefficients: &[f32], outputs: &mut [f32; STATES]) {
    const RUN: Run = Run::new(2, 4).unwrap();
    let [outputs @ .., _] = outputs;
    fold(RUN, coefficients, outputs, &[0.5, -0.5, 0.25, 0.75]);
}

fn pose_folded(coefficients: &[f32], outputs: &mut [f32; STATES]) {
    const RUN: Run = Run::new(4, 2).unwrap();
    fold(RUN, coefficients, outputs, &[0.5, -0.5]);
}

extern "C" fn folded_on_circle(values: &Values, operator: &Operator, outputs: &mut Outputs) {
    fold(ALL, operator.as_flattened(), outputs, values);
    let [_, _, angle @ ..] = outputs;
    f32::on_circle(angle);
}

extern "C" fn nothing<O>(_: &Values, _: &O, _: &mut Outputs) {}

#[entry]
fn main() -> ! {
    machine::end(compare().is_some())
}

fn compare() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    let mut room = [0.0; COEFFICIENTS];
    let model = DRIVE.model(&mut room)?;
    let mut operator = [[0.0; TERMS]; OUTPUTS];
    operator.as_flattened_mut().copy_from_slice(model.coefficients());
    let (values, outputs, coordinates) = expected(&operator);

    let c = |name: &str, kernel: Kernel<Operator>| {
        baseline(("C", name), per_tick, kernel, (&values, &operator), &outputs)
    };
    c("naive C, O2", naive_O2)?;
    c("naive C, O3", naive_O3)?;
    c("C with a doubling lift, O2", doubling_O2)?;
    c("C with a doubling lift, O3", doubling_O3)?;
    #[cfg(cmsis)]
    {
        c("C with a doubling lift and `arm_mat_vec_mult_f32`, O3", cmsis_vector_O3)?;
        c("C with a doubling lift and `arm_mat_mult_f32`, O3", cmsis_matrix_O3)?;
    }
    let matrix = SMatrix::from_row_slice(operator.as_flattened());
    let nalgebra = ("Rust", "nalgebra, `kronecker` and product");
    baseline(nalgebra, per_tick, kronecker, (&values, &matrix), &outputs)?;

    let kernel = ("Rust", PORTABLE);
    baseline(kernel, per_tick, portable, (&values, &operator), &outputs)?;
    let kernel = ("Rust", "`kernel::fold`");
    baseline(kernel, per_tick, folded, (&values, &operator), &outputs)?;
    let [.., sin, cos] = outputs;
    let length = (sin * sin + cos * cos).root();
    let [x, y, sin, cos] = outputs;
    let kernel = ("Rust", ON_CIRCLE);
    let on_circle = [x, y, sin / length, cos / length];
    baseline(kernel, per_tick, folded_on_circle, (&values, &operator), &on_circle)?;

    let predictor = Predictor::new(&model);
    let [first, .., last] = coordinates;
    ours(STEP, per_tick, &predictor, step, 1, &first)?;
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &MEASURED).ok()?;
    let (stepped, bytes) = stack(|| black_box(step)(&predictor, &mut state, &INPUT, &mut []));
    hprintln!("Stack;{}", bytes);
    if !stepped || bytes > STACK {
        return None;
    }
    ours(
        "`Predictor::rollout_held`, a step of ten",
        per_tick,
        &predictor,
        rollout,
        HORIZON,
        &last,
    )?;
    ours(HOLD, per_tick, &predictor, hold, HORIZON, &last)?;
    let names = ["soft leg, `Predictor::step`", "soft leg, `Predictor::hold`, a step of ten"];
    other(&LEG, (LEG_FOLD, leg_folded), names, per_tick)?;
    let names = [SE2_STEP, "drive by its pose, `Predictor::hold`, a step of ten"];
    other(&DRIVE_SE2, ("drive by its pose, `kernel::fold`", pose_folded), names, per_tick)
}

/// Folds the coefficients of a shape.
type OwnFold = fn(&[f32], &mut [f32; STATES]);

/// Counts another shape: its kernel, a step, and a rollout, which has to lead where the steps do.
fn other(
    shape: &Shape,
    (name, kernel): (&str, OwnFold),
    [one, ten]: [&str; 2],
    per_tick: f32,
) -> Option<()> {
    let mut room = [0.0; COEFFICIENTS];
    let model = shape.model(&mut room)?;
    let mut outputs = [0.0; STATES];
    let mut repeat = |work: OwnFold| {
        count(|| {
            for _ in 0..REPETITIONS {
                work(black_box(model.coefficients()), black_box(&mut outputs));
            }
        })
    };
    let without = repeat(black_box(|_, _| {}));
    let with = repeat(black_box(kernel));
    report(("Rust", name), (with - without) as f32 * per_tick, [].into_iter())?;

    let predictor = Predictor::new(&model);
    let n = model.structure().states().len();
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], MEASURED.get(..n)?).ok()?;
    let mut all = [[0.0; STATES]; HORIZON];
    for end in &mut all {
        predictor.step(&mut state, &INPUT).ok()?;
        predictor.coordinates(&state, end.get_mut(..n)?).ok()?;
    }
    let [first, .., last] = all.map(|end| end.map(f64::from));
    ours(one, per_tick, &predictor, step, 1, &first)?;
    ours(ten, per_tick, &predictor, hold, HORIZON, &last)
}

/// Counts a kernel, and compares its numbers.
fn baseline<O>(
    (language, name): (&str, &str),
    per_tick: f32,
    kernel: Kernel<O>,
    (values, operator): (&Values, &O),
    expected: &[f64; OUTPUTS],
) -> Option<()> {
    let mut outputs = [0.0; OUTPUTS];
    let mut repeat = |kernel: Kernel<O>| {
        count(|| {
            for _ in 0..REPETITIONS {
                kernel(black_box(values), black_box(operator), black_box(&mut outputs));
            }
        })
    };
    let without = repeat(black_box(nothing));
    let with = repeat(black_box(kernel));
    let errors = outputs.iter().zip(expected).map(|(found, expected)| f64::from(*found) - expected);
    report((language, name), (with - without) as f32 * per_tick, errors)
}

type Work = fn(&Predictor<'_, '_>, &mut PredictorState, &[f32], &mut [f32]) -> bool;

fn step(
    predictor: &Predictor<'_, '_>,
    state: &mut PredictorState,
    input: &[f32],
    _: &mut [f32],
) -> bool {
    predictor.step(state, input).is_ok()
}

fn rollout(
    predictor: &Predictor<'_, '_>,
    state: &mut PredictorState,
    input: &[f32],
    path: &mut [f32],
) -> bool {
    predictor.rollout_held(state, input, path).is_ok()
}

fn hold(
    predictor: &Predictor<'_, '_>,
    state: &mut PredictorState,
    input: &[f32],
    _: &mut [f32],
) -> bool {
    predictor.hold(state, input, HORIZON).is_ok()
}

fn idle(_: &Predictor<'_, '_>, _: &mut PredictorState, _: &[f32], _: &mut [f32]) -> bool {
    true
}

/// Counts a step of the public predictor, the mean of `steps`, and compares where they lead to.
fn ours(
    name: &str,
    per_tick: f32,
    predictor: &Predictor<'_, '_>,
    work: Work,
    steps: usize,
    expected: &[f64; STATES],
) -> Option<()> {
    let mut start = PredictorState::new();
    let n = predictor.model().structure().states().len();
    predictor.observe(&mut start, &[], MEASURED.get(..n)?).ok()?;
    let mut state = start.clone();
    let mut path = [0.0; STATES * HORIZON];
    let mut repeat = |work: Work| {
        let mut good = true;
        let ticks = count(|| {
            for _ in 0..REPETITIONS {
                state.clone_from(black_box(&start));
                good &= work(predictor, &mut state, black_box(&INPUT), black_box(&mut path));
            }
        });
        good.then_some(ticks)
    };
    let without = repeat(black_box(idle))?;
    let with = repeat(black_box(work))?;
    let mut found = [0.0; STATES];
    predictor.coordinates(&state, found.get_mut(..n)?).ok()?;
    if state.out_of_range().is_some() {
        hprintln!("{}: not in range", name);
        return None;
    }
    let errors = found.iter().zip(expected).map(|(found, expected)| f64::from(*found) - expected);
    report(("Rust", name), (with - without) as f32 * per_tick / steps as f32, errors)
}

/// A line, or what is wrong.
fn report(
    (language, name): (&str, &str),
    instructions: f32,
    mut errors: impl Iterator<Item = f64>,
) -> Option<()> {
    // NaN is wrong, too.
    if let Some(error) = errors.find(|error| error.is_nan() || error.abs() > TOLERANCE) {
        hprintln!("{}: off by {:e}", name, error);
        return None;
    }
    // Names in C say their level themselves.
    let level = if language == "Rust" { LEVEL } else { "" };
    let instructions = instructions / REPETITIONS as f32;
    hprintln!("{};{}{};{:.0}", language, name, level, instructions);
    let most = MOST.iter().find(|(kernel, _)| *kernel == name).map(|(_, most)| *most);
    if most.is_some_and(|most| instructions > most) {
        hprintln!("{}: more than {:.0} instructions", name, most.unwrap_or(0.0));
        return None;
    }
    Some(())
}

/// By the formula in f64: values and outputs of the first step, coordinates after every step.
fn expected(operator: &Operator) -> (Values, [f64; OUTPUTS], [[f64; STATES]; HORIZON]) {
    let [x, y, phi] = MEASURED.map(f64::from);
    let (sin, cos) = phi.sin_cos();
    let [right, left] = INPUT.map(f64::from);
    let (mut raw, mut first) = ([x, y, sin, cos, right, left], None);
    let coordinates = [(); HORIZON].map(|()| {
        let mut values = raw;
        for (v, scaling) in values.iter_mut().zip(DRIVE.scaling) {
            let [centre, gain] = scaling.map(f64::from);
            *v = (*v - centre) * gain;
        }
        let term = |t: usize| -> f64 {
            let factors = values.iter().enumerate().filter(|(i, _)| t & DRIVE.term(*i) != 0);
            factors.map(|(_, v)| v).product()
        };
        let outputs: [f64; OUTPUTS] =
            operator.map(|row| row.iter().enumerate().map(|(t, c)| f64::from(*c) * term(t)).sum());
        first.get_or_insert((values.map(|v| v as f32), outputs));
        let [x, y, sin, cos] = outputs;
        let onto_circle = 1.0 / (sin * sin + cos * cos).root();
        raw = [x, y, sin * onto_circle, cos * onto_circle, right, left];
        [x, y, sin.atan2(cos)]
    });
    let (values, outputs) = first.unwrap_or_default();
    (values, outputs, coordinates)
}
