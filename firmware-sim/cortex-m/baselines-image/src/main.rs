//! One prediction from 6 variables by 64 multilinear terms to 4 outputs, as several kernels make it: their
//! instructions, counted as in the image that `measure` runs. `baselines` makes the table.
//!
//! A line per kernel comes out: the language, the name, the instructions without those of an empty function
//! in its place. All must give the numbers of the formula in f64, or the image names the first
//! that does not, and fails.
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
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::{Model, Predictor, PredictorState, Scalar};
use nalgebra::{SMatrix, Vector2};

#[path = "../../src/machine.rs"]
mod machine;

use machine::count;

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
/// Centre and gain of x, y, sine, cosine and the wheel speeds, as `standardise` makes them.
const SCALING: [[f32; 2]; VARIABLES] =
    [[0.3, 1.9], [-0.2, 1.7], [0.0, 1.0], [0.0, 1.0], [5.0, 0.13], [4.0, 0.25]];
/// Trained ranges of the same.
const RANGES: [[f32; 2]; VARIABLES] =
    [[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.0], [-1.0, 1.0], [-60.0, 60.0], [-60.0, 60.0]];

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

extern "C" fn nothing<O>(_: &Values, _: &O, _: &mut Outputs) {}

#[entry]
fn main() -> ! {
    machine::end(compare().is_some())
}

fn compare() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    let operator = operator();
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

    let ranges = RANGES.as_flattened();
    let model = Model::new(structure()?, operator.as_flattened(), Some(ranges)).ok()?;
    let predictor = Predictor::new(&model);
    let [first, .., last] = coordinates;
    ours("`Predictor::step`", per_tick, &predictor, step, 1, &first)?;
    ours("`Predictor::rollout_held`, a step of ten", per_tick, &predictor, rollout, HORIZON, &last)
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
    predictor.observe(&mut start, &[], &MEASURED).ok()?;
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
    predictor.coordinates(&state, &mut found).ok()?;
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
    hprintln!("{};{}{};{:.0}", language, name, level, instructions / REPETITIONS as f32);
    Some(())
}

/// What a robot standing still would need, and every term besides, by numbers that are all over the place.
fn operator() -> Operator {
    let mut bits = 1_u32;
    let mut operator = [[0.0; TERMS]; OUTPUTS];
    for coefficient in operator.as_flattened_mut() {
        // xorshift (Marsaglia 2003). At least a hundredth, that no term goes unnoticed.
        bits ^= bits << 13;
        bits ^= bits >> 17;
        bits ^= bits << 5;
        let size = 0.01 + 0.02 * (bits >> 8) as f32 / 16_777_216.0;
        *coefficient = if bits & 1 == 0 { size } else { -size };
    }
    let [x, y, sin, cos] = &mut operator;
    for (i, row) in [x, y, sin, cos].into_iter().enumerate() {
        let [centre, gain] = SCALING[i];
        row[0] += centre;
        row[variable_bit(i)] += 1.0 / gain;
    }
    operator
}

/// The bit of a term's index that says whether the term has the variable; the first one is the slowest.
fn variable_bit(variable: usize) -> usize {
    1 << (VARIABLES - 1 - variable)
}

/// By the formula in f64: values and outputs of the first step, coordinates after every step.
fn expected(operator: &Operator) -> (Values, [f64; OUTPUTS], [[f64; STATES]; HORIZON]) {
    let [x, y, phi] = MEASURED.map(f64::from);
    let (sin, cos) = phi.sin_cos();
    let [right, left] = INPUT.map(f64::from);
    let (mut raw, mut first) = ([x, y, sin, cos, right, left], None);
    let coordinates = [(); HORIZON].map(|()| {
        let mut values = raw;
        for (v, scaling) in values.iter_mut().zip(SCALING) {
            let [centre, gain] = scaling.map(f64::from);
            *v = (*v - centre) * gain;
        }
        let term = |t: usize| -> f64 {
            let factors = values.iter().enumerate().filter(|(i, _)| t & variable_bit(*i) != 0);
            factors.map(|(_, v)| v).product()
        };
        let outputs: [f64; OUTPUTS] =
            operator.map(|row| row.iter().enumerate().map(|(t, c)| f64::from(*c) * term(t)).sum());
        first.get_or_insert((values.map(|v| v as f32), outputs));
        let [x, y, sin, cos] = outputs;
        let onto_circle = (sin * sin + cos * cos).reciprocal_root();
        raw = [x, y, sin * onto_circle, cos * onto_circle, right, left];
        [x, y, sin.atan2(cos)]
    });
    let (values, outputs) = first.unwrap_or_default();
    (values, outputs, coordinates)
}

/// That of the paper's drive, `trainer/paper/drive.toml`, with centred and scaled variables.
fn structure() -> Option<Structure<'static>> {
    let state =
        |name, unit, space, limit| State { name, unit, space, target: Target::Absolute, limit };
    let input = |name| Input { name, unit: "rad/s", range: [-60.0, 60.0] };
    let sources = [
        Source::State(0),
        Source::State(1),
        Source::Sin(2),
        Source::Cos(2),
        Source::Input(0),
        Source::Input(1),
    ];
    let observables = sources.into_iter().zip(SCALING).map(|(source, [centre, gain])| Observable {
        source,
        lag: 0,
        centre,
        gain,
    });
    let factors = (0..6).map(|observable| Factor { observable, basis: Basis::Hermite, order: 1 });
    Structure::try_from(ModelRepr {
        robot: "paper-drive",
        sample_time_s: 0.1,
        states: [
            state("x", "m", Space::Line, [-40.0, 40.0]),
            state("y", "m", Space::Line, [-40.0, 40.0]),
            // As `fit` leaves an angle.
            state("phi", "rad", Space::Circle, [f32::NEG_INFINITY, f32::INFINITY]),
        ]
        .into_iter()
        .collect(),
        inputs: ["omega_r", "omega_l"].map(input).into_iter().collect(),
        symmetry: Symmetry::None,
        observables: observables.collect(),
        factors: factors.collect(),
        blocks: [Block { factors: 6, max_degree: 0 }].into_iter().collect(),
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    })
    .ok()
}
