//! Models in fixed point: from the f32 of a blob to 32-bit integers ([`firmware_core::q31`]).
//!
//! Every coordinate and input gets a full scale: its trained range and a margin. The dictionary is written
//! anew in what its factors then read, integers that are the registers themselves: centre and gain of
//! an observable, and the scale, go into the coefficients, and a Fourier basis becomes products of powers of
//! sine and cosine, all of it in f64. Every output gets the largest scale for which no sum can
//! overflow, whatever the observables are; half of the last place, by which every product is rounded
//! down in the mean, is given to the coefficients.

use firmware_core::blob::SelfTest;
use firmware_core::dictionary::{Basis, Factor, Source, block_size};
use firmware_core::model::{Model, ModelError, Space, Structure, Symmetry, Target};
use firmware_core::q31::{self, FixedModel, FixedState, Kind, LoadError, Scale};
use firmware_core::{PredictError, Predictor, PredictorState};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::report::{grouped, hexadecimal, significant};
use crate::robot::ScoreOptions;
use crate::terms::Names;
use crate::trajectory::Trajectory;

/// 2³¹, what 1 is in Q31.
const ONE: f64 = 2_147_483_648.0;
/// How far a position may go whose range is nowhere said, in steps of the longest change.
const REACH: f64 = 256.0;
/// Random samples on which a model is compared with f64.
const SAMPLES: usize = 20_000;
/// Room for the parts of a blob that are not words of the section.
const METADATA_AND_TEST: usize = 16_384;
/// Slack of the trained ranges of sine and cosine, in Q31: what they are rounded by.
const SLACK: i32 = 16;

/// How a model is put in fixed point.
#[derive(Clone, Debug, PartialEq)]
pub struct FixedOptions {
    /// How much wider than the trained range full scale is, on each side, as a share of the range.
    pub margin: f64,
    /// Full scales by the name of the coordinate or input, in its unit, from the centre of its range.
    pub full_scales: Vec<(String, f64)>,
}

impl Default for FixedOptions {
    fn default() -> Self {
        Self { margin: 0.25, full_scales: Vec::new() }
    }
}

/// Why a model has no fixed-point form.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FixedError {
    /// It is sparse.
    #[error(
        "a model with a list of terms ({terms} here) cannot be put in fixed point, only whole Kronecker blocks; \
         leave `terms` out of [dictionary] and fit again"
    )]
    Sparse {
        /// Its terms.
        terms: usize,
    },
    /// It looks at earlier samples.
    #[error(
        "{observable} is of an earlier sample, which a model in fixed point does not keep; fit without delays"
    )]
    Delay {
        /// The first such observable.
        observable: String,
    },
    /// The scale would have to be guessed.
    #[error("the blob has no trained ranges, from which scales are chosen; fit the model again")]
    NoRanges,
    /// A limit that would not be checked.
    #[error(
        "{state} is an angle predicted by its sine and cosine, and has a limit, which fixed point cannot check; \
         predict its change, or leave the limit out"
    )]
    AngleLimit {
        /// The coordinate.
        state: String,
    },
    /// A name that is not there.
    #[error(
        "--full-scale {name}: there is no such coordinate on R and no such input; there are {known}"
    )]
    UnknownName {
        /// The name.
        name: String,
        /// Those that are there.
        known: String,
    },
    /// A scale that cannot be.
    #[error(
        "--full-scale {name}={value}: expected a number above 0 that holds the trained range, {least} or more"
    )]
    TooSmall {
        /// The name.
        name: String,
        /// What was given.
        value: f64,
        /// Half of the trained range.
        least: f64,
    },
    /// Not even coarse integers hold the sums.
    #[error(
        "the equation of {output} adds up numbers {factor} times as large as full scale: 32 bits leave nothing \
         of it; lower an order, or give a larger --full-scale"
    )]
    Range {
        /// The output.
        output: String,
        /// The sum of the coefficients over full scale.
        factor: String,
    },
    /// More than there is room for, or an error of ours.
    #[error("a model in fixed point cannot be that large: {0}")]
    Load(String),
    /// The model does not predict.
    #[error("the controller would refuse the model: {0:?}")]
    Model(ModelError),
}

impl From<LoadError> for FixedError {
    fn from(error: LoadError) -> Self {
        Self::Load(match error {
            LoadError::TooLarge { field, capacity, found } => {
                format!("{found} {field}, and there is room for {capacity}")
            }
            other => format!("{other:?}"),
        })
    }
}

/// One axis of a block in fixed point.
#[derive(Clone, Copy, Debug)]
struct Axis {
    radix: usize,
    reads: Source,
    observable: u8,
    range: [i32; 2],
}

/// A block: its axes, the first one slowest, and its coefficients, shape `[outputs, radices…]`.
struct FixedBlock {
    axes: Vec<Axis>,
    coefficients: Vec<Vec<f64>>,
}

/// A full scale that holds `low` to `high`, both exactly representable.
fn line(low: f64, high: f64) -> Scale {
    let centre = (0.5 * (low + high)) as f32;
    let half = (high - f64::from(centre)).max(f64::from(centre) - low);
    // A range of one number gets some width; the last integer is a little less than full scale.
    let half = half.max(1e-6 * f64::from(centre.abs())).max(1e-30) * (1.0 + 1e-6);
    Scale::Line { centre, full: (half as f32).next_up() }
}

fn parts(scale: Scale) -> (f64, f64) {
    match scale {
        Scale::Line { centre, full } => (centre.into(), full.into()),
        Scale::Turn => (0.0, std::f64::consts::PI),
    }
}

/// The scales of a model.
struct Scales {
    /// Of every coordinate; `None` where it depends on the equations.
    states: Vec<Option<Scale>>,
    inputs: Vec<Scale>,
}

impl Scales {
    fn new(
        structure: &Structure<'_>,
        ranges: &[f32],
        options: &FixedOptions,
    ) -> Result<Self, FixedError> {
        let range_of = |source: Source| {
            let observables =
                structure.dictionary().observables().iter().zip(ranges.as_chunks::<2>().0);
            let mut found = observables.filter(|(o, _)| o.source == source);
            found.next().map(|(_, range)| range.map(f64::from))
        };
        let given = |name: &str| {
            options.full_scales.iter().find(|(n, _)| n == name).map(|(_, value)| *value)
        };
        let centred = |name: &str, [low, high]: [f64; 2], value: f64| {
            let (centre, least) = (0.5 * (low + high), 0.5 * (high - low));
            if value.is_finite() && value > 0.0 && value >= least {
                Ok(line(centre - value, centre + value))
            } else {
                Err(FixedError::TooSmall { name: name.to_owned(), value, least })
            }
        };
        let mut known = Vec::new();
        let mut states = Vec::new();
        for (i, state) in structure.states().iter().enumerate() {
            if state.space == Space::Circle {
                states.push(Some(Scale::Turn));
                continue;
            }
            known.push(state.name);
            let [least, most] = state.limit.map(f64::from);
            let bounded = least.is_finite() && most.is_finite();
            let trained = range_of(Source::State(i as u8));
            states.push(match (given(state.name), trained) {
                (Some(value), Some(range)) => Some(centred(state.name, range, value)?),
                (Some(value), None) => Some(centred(state.name, [0.0; 2], value)?),
                (None, Some([low, high])) => {
                    let more = options.margin * (high - low);
                    // A limit within the margin is as far as it goes.
                    Some(line((low - more).max(least.min(low)), (high + more).min(most.max(high))))
                }
                (None, None) if bounded => Some(line(least, most)),
                (None, None) => None,
            });
        }
        let mut inputs = Vec::new();
        for (i, input) in structure.inputs().iter().enumerate() {
            known.push(input.name);
            let [least, most] = input.range.map(f64::from);
            let trained = range_of(Source::Input(i as u8));
            inputs.push(match (given(input.name), trained) {
                (Some(value), trained) => {
                    centred(input.name, trained.unwrap_or([least, most]), value)?
                }
                (None, Some([low, high])) => {
                    let more = options.margin * (high - low);
                    line((low - more).max(least.min(low)), (high + more).min(most.max(high)))
                }
                (None, None) => line(least, most),
            });
        }
        if let Some((name, _)) =
            options.full_scales.iter().find(|(n, _)| !known.contains(&n.as_str()))
        {
            let (name, known) = (name.clone(), known.join(", "));
            return Err(FixedError::UnknownName { name, known });
        }
        Ok(Self { states, inputs })
    }
}

/// `(a w + b)ⁿ` for n from 0: shape `[n][power of w]`.
fn powers_of(a: f64, b: f64, radix: usize) -> Vec<Vec<f64>> {
    let mut powers = vec![vec![1.0]];
    for n in 1..radix {
        let mut next = vec![0.0; n + 1];
        for (i, c) in powers[n - 1].iter().enumerate() {
            next[i] += b * c;
            next[i + 1] += a * c;
        }
        powers.push(next);
    }
    powers
}

/// The functions of a Fourier basis in the powers of sine (0 and 1, slowest) and cosine (0 to the order).
fn harmonics(order: usize) -> Vec<Vec<f64>> {
    let radix = order + 1;
    let mut one = vec![0.0; 2 * radix];
    one[0] = 1.0;
    // sin nφ = s · Uₙ₋₁(c), cos nφ = Tₙ(c), both with Pₙ₊₁ = 2 c Pₙ − Pₙ₋₁.
    let next = |current: &[f64], previous: &[f64]| -> Vec<f64> {
        (0..radix).map(|i| if i > 0 { 2.0 * current[i - 1] } else { 0.0 } - previous[i]).collect()
    };
    let unit = |i: usize| (0..radix).map(|j| if i == j { 1.0 } else { 0.0 }).collect::<Vec<f64>>();
    let (mut u, mut u_before) = (unit(0), vec![0.0; radix]);
    let (mut t, mut t_before) = (unit(1), unit(0));
    let mut functions = vec![one];
    for _ in 0..order {
        functions.push([vec![0.0; radix], u.clone()].concat());
        functions.push([t.clone(), vec![0.0; radix]].concat());
        (u, u_before) = (next(&u, &u_before), u);
        (t, t_before) = (next(&t, &t_before), t);
    }
    functions
}

/// Applies to an axis, whose elements are `after` apart, what its functions are made of.
fn change_basis(tensor: &[f64], functions: &[Vec<f64>], radix: usize, after: usize) -> Vec<f64> {
    let mut changed = Vec::new();
    for slab in tensor.chunks_exact(functions.len() * after) {
        let mut new = vec![0.0; radix * after];
        for (function, row) in functions.iter().zip(slab.chunks_exact(after)) {
            for (weight, to) in function.iter().zip(new.chunks_exact_mut(after)) {
                for (to, c) in to.iter_mut().zip(row) {
                    *to += weight * c;
                }
            }
        }
        changed.extend(new);
    }
    changed
}

/// A tensor with its axes in another order: axis i of the new one is axis `order[i]`.
fn permuted(tensor: &[f64], radices: &[usize], order: &[usize]) -> Vec<f64> {
    let mut strides = vec![1; radices.len()];
    for i in (1..radices.len()).rev() {
        strides[i - 1] = strides[i] * radices[i];
    }
    (0..tensor.len())
        .map(|index| {
            let (mut rest, mut from) = (index, 0);
            for axis in order.iter().rev() {
                from += rest % radices[*axis] * strides[*axis];
                rest /= radices[*axis];
            }
            tensor[from]
        })
        .collect()
}

/// The order of axes that the controller folds fastest: what its kernels know comes last.
fn fastest(axes: &[Axis]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..axes.len()).collect();
    let twos = axes.iter().filter(|axis| axis.radix == 2).count();
    order.sort_by_key(|i| match axes[*i].radix {
        2 if twos >= 4 => usize::MAX,
        radix => radix,
    });
    order
}

impl FixedBlock {
    /// A block of a model, of coefficients of every output, written in registers.
    fn new(
        structure: &Structure<'_>,
        factors: &[Factor],
        rows: Vec<Vec<f64>>,
        scales: &Scales,
        ranges: &[f32],
    ) -> Self {
        let observables = structure.dictionary().observables();
        let mut axes = Vec::new();
        let mut changes = Vec::new();
        for factor in factors {
            let index = usize::from(factor.observable);
            let (observable, radix) = (observables[index], usize::from(factor.order) + 1);
            let range = |i: usize| [ranges[2 * i], ranges[2 * i + 1]];
            let q31 = |x: f32| (f64::from(x) * ONE).round() as i32;
            let circle = |i: usize| {
                let [low, high] = range(i).map(q31);
                [low.saturating_sub(SLACK), high.saturating_add(SLACK)]
            };
            let reads = observable.source;
            let scale = match reads {
                Source::State(i) => scales.states[usize::from(i)],
                Source::Input(i) => Some(scales.inputs[usize::from(i)]),
                Source::Sin(_) | Source::Cos(_) | Source::Increment(_) => None,
            };
            if factor.basis == Basis::Fourier {
                let observable = factor.observable;
                let cosine = index + 1;
                axes.push(Axis { radix: 2, reads, observable, range: circle(index) });
                axes.push(Axis {
                    radix,
                    reads: observables[cosine].source,
                    observable: observable + 1,
                    range: circle(cosine),
                });
                changes.push((harmonics(usize::from(factor.order)), 2 * radix));
                continue;
            }
            let (range, (centre, full)) = match scale {
                Some(scale) => (range(index).map(|x| scale.to_fixed(f64::from(x))), parts(scale)),
                None => (circle(index), (0.0, 1.0)),
            };
            let gain = f64::from(observable.gain);
            let shift = gain * (centre - f64::from(observable.centre));
            axes.push(Axis { radix, reads, observable: factor.observable, range });
            changes.push((powers_of(gain * full, shift, radix), radix));
        }
        let order = fastest(&axes);
        let radices: Vec<usize> = axes.iter().map(|axis| axis.radix).collect();
        let coefficients = rows
            .into_iter()
            .map(|mut row| {
                for (i, (functions, radix)) in changes.iter().enumerate() {
                    // The axes behind have not been changed yet.
                    let after = changes[i + 1..].iter().map(|(f, _)| f.len()).product();
                    row = change_basis(&row, functions, *radix, after);
                }
                permuted(&row, &radices, &order)
            })
            .collect();
        Self { axes: order.into_iter().map(|i| axes[i]).collect(), coefficients }
    }

    /// Integers of an output whose scale is 2^(31 − `exponent`), for coefficients over full scale; none if
    /// a coefficient does not fit.
    fn integers(&self, output: usize, exponent: i32) -> Option<Vec<i32>> {
        let row = &self.coefficients[output];
        let mut integers = Vec::new();
        for (index, c) in row.iter().enumerate() {
            let (mut rest, mut degree, mut rounded_down, mut constant) = (index, 0, 0, true);
            for axis in self.axes.iter().rev() {
                let digit = rest % axis.radix;
                rest /= axis.radix;
                degree += digit;
                // A product is added to the number that this one is the constant of.
                rounded_down += i32::from(constant && digit + 1 < axis.radix);
                constant &= digit == 0;
            }
            let scale = 2_f64.powi(31 - exponent + degree as i32);
            let integer = (c * scale + 0.5 * f64::from(rounded_down)).round();
            if integer.abs() >= ONE {
                return None;
            }
            integers.push(integer as i32);
        }
        Some(integers)
    }

    /// The largest magnitude of a fold, as the controller adds it up.
    fn bound(&self, integers: &[i32]) -> Option<u32> {
        fn bound(axes: &[Axis], c: &[i32]) -> Option<u32> {
            let Some((axis, faster)) = axes.split_first() else {
                return c.first().map(|c| c.unsigned_abs());
            };
            let rows = c.chunks_exact(c.len() / axis.radix);
            rows.rev().try_fold(0_u32, |sum, row| {
                let sum = bound(faster, row)?.checked_add(sum.div_ceil(2))?;
                (sum <= i32::MAX.unsigned_abs()).then_some(sum)
            })
        }
        bound(&self.axes, integers)
    }

    /// The sum of the magnitudes of an output's coefficients.
    fn magnitude(&self, output: usize) -> f64 {
        self.coefficients[output].iter().map(|c| c.abs()).sum()
    }
}

/// What became of a coordinate.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FixedCoordinate {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// What 0 stands for, in the unit.
    pub centre: f64,
    /// Full scale, in the unit; π of an angle.
    pub full_scale: f64,
    /// What the last place of the output stands for, as a share of full scale.
    pub resolution: f64,
    /// The largest sum of the equation that is possible, as a share of what fits, if that was reckoned.
    pub bound: Option<f64>,
}

/// What became of an input.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FixedInput {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// What 0 stands for, in the unit.
    pub centre: f64,
    /// Full scale, in the unit.
    pub full_scale: f64,
}

/// A model in fixed point.
#[derive(Clone, Debug, PartialEq)]
pub struct FixedExport {
    /// The blob.
    pub bytes: Vec<u8>,
    /// Coefficients of all outputs.
    pub coefficients: usize,
    /// Coordinates.
    pub coordinates: Vec<FixedCoordinate>,
    /// Inputs.
    pub inputs: Vec<FixedInput>,
}

/// Puts a model in fixed point; `test` is the sample of its self-test.
///
/// # Errors
/// [`FixedError`].
pub fn fixed_point(
    model: &Model<'_>,
    test: &SelfTest<'_>,
    options: &FixedOptions,
) -> Result<FixedExport, FixedError> {
    let structure = model.structure();
    let (kinds, ranges) = supported(model)?;
    let mut scales = Scales::new(structure, ranges, options)?;

    // Blocks, of coefficients that are still in units.
    let mut blocks = Vec::new();
    let mut first = 0;
    for (_, factors) in structure.dictionary().blocks() {
        let size = block_size(factors);
        let rows = model.coefficients().chunks_exact(structure.dictionary().dense_terms());
        let rows = rows.map(|row| row[first..first + size].iter().map(|c| f64::from(*c)).collect());
        blocks.push(FixedBlock::new(structure, factors, rows.collect(), &scales, ranges));
        first += size;
    }
    complete(structure, &kinds, &blocks, &mut scales);

    // Over full scale; from the next value its centre is taken away.
    let mut output = 0;
    for (kind, scale) in kinds.iter().zip(&scales.states) {
        let (centre, full) = scale.map_or((0.0, 1.0), parts);
        let outputs = if *kind == Kind::Circle { 2 } else { 1 };
        for output in output..output + outputs {
            if *kind == Kind::Next
                && let Some(block) = blocks.first_mut()
            {
                block.coefficients[output][0] -= centre;
            }
            if *kind != Kind::Circle {
                for c in blocks.iter_mut().flat_map(|block| &mut block.coefficients[output]) {
                    *c /= full;
                }
            }
        }
        output += outputs;
    }

    let exponents = exponents(structure, &kinds, &blocks)?;
    let mut words = Words::new(structure, &kinds, &blocks)?;
    let mut coordinates = Vec::new();
    let mut output = 0;
    for ((state, kind), scale) in structure.states().iter().zip(&kinds).zip(&scales.states) {
        let (exponent, bound) = exponents[output];
        let scale = scale.unwrap_or(Scale::Turn);
        words.coordinate(coordinates.len(), (*kind, output), exponent, state.limit, scale);
        let (centre, full_scale) = parts(scale);
        coordinates.push(FixedCoordinate {
            name: state.name.to_owned(),
            unit: state.unit.to_owned(),
            centre,
            full_scale,
            resolution: 2_f64.powi(exponent - 31),
            bound: Some(f64::from(bound) / ONE),
        });
        output += if *kind == Kind::Circle { 2 } else { 1 };
    }
    let mut inputs = Vec::new();
    for (input, scale) in structure.inputs().iter().zip(&scales.inputs) {
        words.input(inputs.len(), *scale);
        let (centre, full_scale) = parts(*scale);
        inputs.push(FixedInput {
            name: input.name.to_owned(),
            unit: input.unit.to_owned(),
            centre,
            full_scale,
        });
    }
    words.blocks(&blocks, &exponents);

    // Without delays the self-test is of one sample.
    let all = scales.states.iter().map(|scale| scale.unwrap_or(Scale::Turn));
    let all = all.zip(test.states).chain(scales.inputs.iter().copied().zip(test.inputs));
    let sample: Vec<i32> = all.map(|(scale, x)| scale.to_fixed(f64::from(*x))).collect();
    let mut bytes = vec![0; 4 * words.words.len() + METADATA_AND_TEST];
    let length = q31::emit(structure, &words.words, &sample, &mut bytes)?;
    bytes.truncate(length);
    let coefficients = blocks.iter().flat_map(|b| &b.coefficients).map(Vec::len).sum();
    Ok(FixedExport { bytes, coefficients, coordinates, inputs })
}

/// The kinds of all coordinates and the trained ranges of a model that can be put in fixed point.
fn supported<'m>(model: &Model<'m>) -> Result<(Vec<Kind>, &'m [f32]), FixedError> {
    let structure = model.structure();
    if let Some(terms) = model.terms() {
        return Err(FixedError::Sparse { terms: terms.count() });
    }
    let observables = structure.dictionary().observables();
    if let Some(index) = observables.iter().position(|o| o.lag > 0) {
        let states: Vec<&str> = structure.states().iter().map(|s| s.name).collect();
        let inputs: Vec<&str> = structure.inputs().iter().map(|u| u.name).collect();
        let names = Names { states: &states, inputs: &inputs };
        let o = observables[index];
        return Err(FixedError::Delay { observable: names.observable(o.source, o.lag) });
    }
    let ranges = model.ranges().ok_or(FixedError::NoRanges)?;
    let mut kinds = Vec::new();
    for (i, state) in (0_u8..).zip(structure.states()) {
        let read = |o: Source| o == Source::Sin(i) || o == Source::Cos(i);
        let (in_pose, heads) = match structure.symmetry() {
            Symmetry::Se2 { x, y, heading } => (x == i || y == i, heading == i),
            _ => (false, false),
        };
        kinds.push(match (state.space, state.target) {
            (Space::Line, Target::Absolute) => Kind::Next,
            (Space::Line, Target::Increment) if in_pose => Kind::Pose,
            (Space::Line, Target::Increment) => Kind::Change,
            (Space::Circle, Target::Absolute) => {
                if state.limit.iter().any(|limit| limit.is_finite()) {
                    return Err(FixedError::AngleLimit { state: state.name.to_owned() });
                }
                Kind::Circle
            }
            (Space::Circle, Target::Increment)
                if heads || observables.iter().any(|o| read(o.source)) =>
            {
                Kind::Heading
            }
            (Space::Circle, Target::Increment) => Kind::Turn,
        });
    }
    Ok((kinds, ranges))
}

/// Gives a scale to the coordinates that are in no dictionary and have no limits.
fn complete(structure: &Structure<'_>, kinds: &[Kind], blocks: &[FixedBlock], scales: &mut Scales) {
    let mut output = 0;
    for (kind, scale) in kinds.iter().zip(&mut scales.states) {
        let most: f64 = blocks.iter().map(|block| block.magnitude(output)).sum();
        if scale.is_none() {
            let reach = if *kind == Kind::Next { most } else { REACH * most };
            // A round number: half of what is next.
            let full = 2_f64.powf(reach.max(1e-30).log2().ceil());
            *scale = Some(line(-full, full));
        }
        output += if *kind == Kind::Circle { 2 } else { 1 };
    }
    // A pose is turned: x and y have one scale.
    if let Symmetry::Se2 { x, y, .. } = structure.symmetry() {
        let [x, y] = [x, y].map(usize::from);
        let widest = [x, y].into_iter().filter_map(|i| scales.states[i]);
        let widest = widest.max_by(|a, b| parts(*a).1.total_cmp(&parts(*b).1));
        let full = widest.map_or(1.0, |scale| parts(scale).1) as f32;
        for i in [x, y] {
            if let Some(Scale::Line { full: of, .. }) = &mut scales.states[i] {
                *of = full;
            }
        }
    }
}

/// The exponent of every output, and its largest possible magnitude.
fn exponents(
    structure: &Structure<'_>,
    kinds: &[Kind],
    blocks: &[FixedBlock],
) -> Result<Vec<(i32, u32)>, FixedError> {
    let fits = |output: usize, exponent: i32, most: u64| -> Option<u32> {
        let mut sum = 0_u64;
        for block in blocks {
            sum += u64::from(block.bound(&block.integers(output, exponent)?)?);
        }
        // A rounding takes one more.
        (sum < most).then_some(sum as u32)
    };
    let mut groups: Vec<(Vec<usize>, i32, u64)> = Vec::new();
    let mut pose: Vec<usize> = Vec::new();
    let mut output = 0;
    for kind in kinds {
        match kind {
            Kind::Circle => groups.push((vec![output, output + 1], 0, 1 << 31)),
            Kind::Pose => pose.push(output),
            Kind::Next => groups.push((vec![output], 0, 1 << 31)),
            _ => groups.push((vec![output], -31, 1 << 31)),
        }
        output += if *kind == Kind::Circle { 2 } else { 1 };
    }
    if !pose.is_empty() {
        groups.push((pose, -30, 1 << 30));
    }
    let mut exponents = vec![(0, 0); output];
    for (outputs, least, most) in groups {
        let mut found = None;
        for exponent in least..=20 {
            let bounds: Option<Vec<u32>> =
                outputs.iter().map(|output| fits(*output, exponent, most - 1)).collect();
            if let Some(bounds) = bounds {
                found = Some((exponent, bounds));
                break;
            }
        }
        let Some((exponent, bounds)) = found else {
            let output = outputs[0];
            let factor: f64 = blocks.iter().map(|block| block.magnitude(output)).sum();
            return Err(FixedError::Range {
                output: crate::inspect::output_names(structure).remove(output),
                factor: significant(factor),
            });
        };
        for (output, bound) in outputs.into_iter().zip(bounds) {
            exponents[output] = (exponent, bound);
        }
    }
    Ok(exponents)
}

/// The section of the blob, word by word.
struct Words {
    words: Vec<u32>,
    /// What lies in registers 0, 1, …, and the observable and range of what is observed.
    registers: Vec<(Source, Option<Axis>)>,
}

impl Words {
    fn new(
        structure: &Structure<'_>,
        kinds: &[Kind],
        blocks: &[FixedBlock],
    ) -> Result<Self, FixedError> {
        let axes = blocks.iter().flat_map(|block| &block.axes);
        let factors = axes.clone().count();
        let room =
            [("blocks", blocks.len(), q31::MAX_BLOCKS), ("factors", factors, q31::MAX_FACTORS)];
        if let Some((field, found, capacity)) = room.into_iter().find(|(_, n, most)| n > most) {
            return Err(LoadError::TooLarge { field, capacity, found }.into());
        }
        let counts = [structure.states().len(), structure.inputs().len(), blocks.len(), factors];
        let pose = match structure.symmetry() {
            Symmetry::Se2 { x, y, heading } => [x, y, heading, 1],
            _ => [0; 4],
        };
        let words = vec![u32::from_le_bytes(counts.map(|n| n as u8)), u32::from_le_bytes(pose)];
        // The factors of the first block lie where they are folded.
        let mut registers: Vec<(Source, Option<Axis>)> = Vec::new();
        let mut keep = |source: Source, axis: Option<Axis>| {
            if registers.iter().all(|(kept, _)| *kept != source) {
                registers.push((source, axis));
            }
        };
        for axis in axes {
            keep(axis.reads, Some(*axis));
        }
        (0..structure.inputs().len()).for_each(|i| keep(Source::Input(i as u8), None));
        for (i, kind) in (0_u8..).zip(kinds) {
            if *kind != Kind::Circle {
                keep(Source::State(i), None);
            }
            if matches!(kind, Kind::Circle | Kind::Heading) {
                keep(Source::Sin(i), None);
                keep(Source::Cos(i), None);
            }
        }
        Ok(Self { words, registers })
    }

    fn floats(&mut self, scale: Scale) {
        let (centre, full) = parts(scale);
        self.words.extend([(centre as f32).to_bits(), (full as f32).to_bits()]);
    }

    /// The register of something and the observable that it is; 31 and none if it is not kept.
    fn register(&self, source: Source) -> (u8, u8) {
        let found = self.registers.iter().position(|(kept, _)| *kept == source);
        let observable = found.and_then(|i| self.registers[i].1).map_or(0, |axis| axis.observable);
        (found.map_or(31, |i| i as u8), observable)
    }

    /// The trained range of something without its last bit, or everything.
    fn range(&self, source: Source) -> [u32; 2] {
        let found = self.registers.iter().find(|(kept, _)| *kept == source);
        let range =
            found.and_then(|(_, axis)| *axis).map_or([i32::MIN, i32::MAX], |axis| axis.range);
        range.map(|x| (x >> 1) as u32)
    }

    fn coordinate(
        &mut self,
        index: usize,
        (kind, output): (Kind, usize),
        shift: i32,
        limit: [f32; 2],
        scale: Scale,
    ) {
        // The limits, where there are any, in integers of the coordinate.
        let [low, high] = limit;
        let mut low = if low.is_finite() { scale_up(scale, low) } else { i32::MIN };
        let mut high = if high.is_finite() { scale_up(scale, high) } else { i32::MAX };
        if kind == Kind::Next {
            // In integers of the output, none of which leaves the coordinate.
            let unit = 2_f64.powi(shift);
            low = (f64::from(low) / unit).ceil() as i32;
            high = (f64::from(high) / unit).floor() as i32;
        }
        let index = index as u8;
        let value = self.register(Source::State(index));
        let (sin, cos) = (self.register(Source::Sin(index)), self.register(Source::Cos(index)));
        let angle = matches!(kind, Kind::Circle | Kind::Heading);
        let first = if angle { Source::Sin(index) } else { Source::State(index) };
        let observable = if angle { sin.1 } else { value.1 };
        let head = [kind as u8, shift as i8 as u8, output as u8, observable];
        let registers = [value.0, sin.0, cos.0, cos.1];
        self.words.extend([head, registers].map(u32::from_le_bytes));
        self.words.extend([low as u32, high.wrapping_sub(low) as u32]);
        self.words.extend(self.range(first));
        self.words.extend(self.range(Source::Cos(index)));
        self.floats(scale);
    }

    fn input(&mut self, index: usize, scale: Scale) {
        let source = Source::Input(index as u8);
        let (register, observable) = self.register(source);
        self.words.push(u32::from_le_bytes([register, observable, 0, 0]));
        self.words.extend(self.range(source));
        self.floats(scale);
    }

    fn blocks(&mut self, blocks: &[FixedBlock], exponents: &[(i32, u32)]) {
        for axis in blocks.iter().flat_map(|block| &block.axes) {
            let (register, _) = self.register(axis.reads);
            self.words.push(u32::from_le_bytes([register, axis.radix as u8, 0, 0]));
        }
        self.words.extend(blocks.iter().map(|block| block.axes.len() as u32));
        for block in blocks {
            for (output, (exponent, _)) in exponents.iter().enumerate() {
                // They fit: that is how the exponent was found.
                let integers = block.integers(output, *exponent).unwrap_or_default();
                self.words.extend(integers.iter().map(|c| *c as u32));
            }
        }
    }
}

/// A limit in integers: of an angle beyond half a turn there is none.
fn scale_up(scale: Scale, limit: f32) -> i32 {
    let (centre, full) = parts(scale);
    ((f64::from(limit) - centre) / full * ONE).round() as i32
}

/// A blob in fixed point, described.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FixedInspection {
    /// Robot name.
    pub robot: String,
    /// Sample time \[s\].
    pub sample_time_s: f32,
    /// Coordinates, without the bound, which only the exporter knows.
    pub coordinates: Vec<FixedCoordinate>,
    /// Inputs.
    pub inputs: Vec<FixedInput>,
    /// Coefficients of all outputs.
    pub coefficients: usize,
    /// Bytes of the blob.
    pub bytes: usize,
    /// SHA-256 of the logs.
    pub logs_sha256: String,
    /// SHA-256 of the robot description.
    pub robot_sha256: String,
}

/// Describes a blob in fixed point.
///
/// # Errors
/// [`LoadError`].
pub fn inspect(bytes: &[u8]) -> Result<FixedInspection, LoadError> {
    let (model, structure) = (q31::parse(bytes)?, q31::structure(bytes)?);
    let coordinates = structure.states().iter().zip(model.coordinates_of());
    let inputs = structure.inputs().iter().zip((0..).map_while(|i| model.input_scale(i)));
    Ok(FixedInspection {
        robot: structure.robot().to_owned(),
        sample_time_s: structure.sample_time_s(),
        coordinates: coordinates
            .map(|(state, (_, shift, scale))| {
                let (centre, full_scale) = parts(scale);
                FixedCoordinate {
                    name: state.name.to_owned(),
                    unit: state.unit.to_owned(),
                    centre,
                    full_scale,
                    resolution: 2_f64.powi(shift - 31),
                    bound: None,
                }
            })
            .collect(),
        inputs: inputs
            .map(|(input, scale)| {
                let (centre, full_scale) = parts(scale);
                FixedInput {
                    name: input.name.to_owned(),
                    unit: input.unit.to_owned(),
                    centre,
                    full_scale,
                }
            })
            .collect(),
        coefficients: model.coefficients().map(<[i32]>::len).sum(),
        bytes: bytes.len(),
        logs_sha256: hexadecimal(&structure.provenance().logs),
        robot_sha256: hexadecimal(&structure.provenance().robot),
    })
}

impl FixedInspection {
    /// As text.
    pub fn text(&self) -> String {
        format!(
            "robot        {}\nsample time  {} s\nnumbers      32-bit integers of the scales below (fixed point)\n\n{}\n\
             {} bytes, {} of them coefficients\nlogs         sha256 {}\nrobot.toml   sha256 {}\n",
            self.robot,
            self.sample_time_s,
            scales(&self.coordinates, &self.inputs),
            grouped(self.bytes as u64),
            grouped(4 * self.coefficients as u64),
            self.logs_sha256,
            self.robot_sha256
        )
    }
}

/// The scales of coordinates and inputs, a line each.
fn scales(coordinates: &[FixedCoordinate], inputs: &[FixedInput]) -> String {
    let mut text = format!(
        "{:26} {:>12} {:>11}  last place of the output  largest sum\n",
        "", "centre", "full scale"
    );
    for c in coordinates {
        let bound = c.bound.map(|bound| format!("  {:>10} %", significant(100.0 * bound)));
        text += &format!(
            "  {:<24} {:>12} {:>11}  {:>24}{}\n",
            format!("{} [{}]", c.name, c.unit),
            significant(c.centre),
            significant(c.full_scale),
            significant(c.resolution * c.full_scale),
            bound.unwrap_or_default(),
        );
    }
    for input in inputs {
        text += &format!(
            "  {:<24} {:>12} {:>11}\n",
            format!("{} [{}]", input.name, input.unit),
            significant(input.centre),
            significant(input.full_scale),
        );
    }
    text
}

/// Errors of a coordinate in its unit.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FixedDifference {
    /// Largest.
    pub largest: f64,
    /// Root of the mean square.
    pub rms: f64,
}

/// Differences to the model in f64 at random samples within the trained range, one step ahead.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct OneStep {
    /// Samples that both predicted.
    pub samples: usize,
    /// Samples that one of them did not.
    pub diverged: usize,
    /// Of the model in fixed point, one per coordinate.
    pub fixed: Vec<FixedDifference>,
    /// Of the model in f32.
    pub float: Vec<FixedDifference>,
}

/// Differences of rollouts over logs to those of the model in f32.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct OnLogs {
    /// Steps of a rollout.
    pub horizon: usize,
    /// Rollouts.
    pub windows: usize,
    /// Rollouts that diverged in f32 alone, in fixed point alone, in both.
    pub diverged: [usize; 3],
    /// After one step.
    pub one_step: Vec<FixedDifference>,
    /// Over all steps that both predicted.
    pub rollout: Vec<FixedDifference>,
}

struct Differences(Vec<(f64, f64, usize)>);

impl Differences {
    fn new(states: usize) -> Self {
        Self(vec![(0.0, 0.0, 0); states])
    }

    fn add(&mut self, structure: &Structure<'_>, a: &[f64], b: &[f64]) {
        let pairs = a.iter().zip(b).zip(structure.states());
        for ((most, sum, n), ((a, b), state)) in self.0.iter_mut().zip(pairs) {
            let difference = state.space.difference(*a, *b).abs();
            *most = most.max(difference);
            *sum += difference * difference;
            *n += 1;
        }
    }

    fn done(self) -> Vec<FixedDifference> {
        let done = |(largest, sum, n): (f64, f64, usize)| FixedDifference {
            largest,
            rms: (sum / n.max(1) as f64).sqrt(),
        };
        self.0.into_iter().map(done).collect()
    }
}

/// A model in fixed point that takes and gives units.
struct InUnits<'m, 'a> {
    model: &'m FixedModel<'a>,
    states: Vec<Scale>,
    inputs: Vec<Scale>,
}

impl<'m, 'a> InUnits<'m, 'a> {
    fn new(model: &'m FixedModel<'a>) -> Self {
        let states = (0..model.states()).filter_map(|i| model.coordinate_scale(i)).collect();
        let inputs = (0..model.inputs()).filter_map(|i| model.input_scale(i)).collect();
        Self { model, states, inputs }
    }

    fn fixed(scales: &[Scale], values: &[f64]) -> Vec<i32> {
        scales.iter().zip(values).map(|(scale, x)| scale.to_fixed(*x)).collect()
    }

    fn observe(&self, state: &mut FixedState, x: &[f64]) -> Result<(), PredictError> {
        self.model.observe(state, &Self::fixed(&self.states, x))
    }

    fn step(&self, state: &mut FixedState, u: &[f64]) -> Result<Vec<f64>, PredictError> {
        self.model.step(state, &Self::fixed(&self.inputs, u))?;
        let mut out = vec![0; self.states.len()];
        self.model.coordinates(state, &mut out)?;
        Ok(self.states.iter().zip(out).map(|(scale, x)| scale.to_unit(x)).collect())
    }
}

/// What the model predicts one step ahead, in f64 or f32.
fn float_step<S: firmware_core::Scalar + Into<f64>>(
    model: &Model<'_, S>,
    x: &[S],
    u: &[S],
) -> Option<Vec<f64>> {
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], x).ok()?;
    predictor.step(&mut state, u).ok()?;
    let mut out = vec![S::default(); x.len()];
    predictor.coordinates(&state, &mut out).ok()?;
    Some(out.into_iter().map(Into::into).collect())
}

/// Compares a model in fixed point with the one that it was made from, at random samples within the
/// trained range; coordinates that have none are at the middle of their scale.
///
/// # Errors
/// [`FixedError`].
pub fn compare(model: &Model<'_>, fixed: &FixedModel<'_>) -> Result<OneStep, FixedError> {
    let structure = model.structure();
    let n = structure.states().len();
    let observables = structure.dictionary().observables();
    let ranges = model.ranges().ok_or(FixedError::NoRanges)?;
    let wide = |numbers: &[f32]| numbers.iter().map(|x| f64::from(*x)).collect::<Vec<f64>>();
    let (coefficients, f64_ranges) = (wide(model.coefficients()), wide(ranges));
    let exact = Model::new(structure.clone(), &coefficients, Some(&f64_ranges))
        .map_err(FixedError::Model)?;
    let range = |source: Source| {
        let found = observables.iter().position(|o| o.source == source);
        found.map(|i| [f64_ranges[2 * i], f64_ranges[2 * i + 1]])
    };
    let units = InUnits::new(fixed);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let (mut of_fixed, mut of_float) = (Differences::new(n), Differences::new(n));
    let (mut samples, mut diverged) = (0, 0);
    for _ in 0..SAMPLES {
        let mut between = |[low, high]: [f64; 2]| low + (high - low) * random.random::<f64>();
        let x: Vec<f64> = (0_u8..)
            .zip(structure.states())
            .zip(&units.states)
            .map(|((i, state), scale)| match (state.space, range(Source::State(i))) {
                (Space::Circle, _) => between([-std::f64::consts::PI, std::f64::consts::PI]),
                (Space::Line, Some(range)) => between(range),
                (Space::Line, None) => parts(*scale).0,
            })
            .collect();
        let u: Vec<f64> = (0_u8..)
            .zip(structure.inputs())
            .map(|(i, input)| {
                between(range(Source::Input(i)).unwrap_or(input.range.map(f64::from)))
            })
            .collect();
        // From one sample: what the controller is given.
        let mut state = FixedState::new();
        let x = InUnits::fixed(&units.states, &x);
        let u = InUnits::fixed(&units.inputs, &u);
        let back = |scales: &[Scale], x: &[i32]| -> Vec<f64> {
            scales.iter().zip(x).map(|(scale, x)| scale.to_unit(*x)).collect()
        };
        let (x, u) = (back(&units.states, &x), back(&units.inputs, &u));
        let narrow = |x: &[f64]| x.iter().map(|x| *x as f32).collect::<Vec<f32>>();
        let truth = float_step(&exact, &x, &u);
        let float = float_step(model, &narrow(&x), &narrow(&u));
        let fixed = units.observe(&mut state, &x).and_then(|()| units.step(&mut state, &u)).ok();
        match (truth, float, fixed) {
            (Some(truth), Some(float), Some(fixed)) => {
                samples += 1;
                of_fixed.add(structure, &fixed, &truth);
                of_float.add(structure, &float, &truth);
            }
            _ => diverged += 1,
        }
    }
    Ok(OneStep { samples, diverged, fixed: of_fixed.done(), float: of_float.done() })
}

/// Compares rollouts over windows of logs; `None` if no trajectory is long enough.
pub fn compare_on_logs(
    model: &Model<'_>,
    fixed: &FixedModel<'_>,
    trajectories: &[Trajectory],
    options: &ScoreOptions,
) -> Option<OnLogs> {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let (units, predictor) = (InUnits::new(fixed), Predictor::new(model));
    let (mut one_step, mut rollout) = (Differences::new(n), Differences::new(n));
    let mut result = OnLogs { horizon: options.horizon, ..OnLogs::default() };
    for trajectory in trajectories {
        let rows = trajectory.states.len() / n.max(1);
        for start in (0..rows.saturating_sub(options.horizon)).step_by(options.stride.max(1)) {
            result.windows += 1;
            let x = &trajectory.states[start * n..][..n];
            let x32: Vec<f32> = structure
                .states()
                .iter()
                .zip(x)
                .map(|(state, x)| crate::export::coordinate(*x, state.space))
                .collect();
            let (mut float, mut state) = (PredictorState::new(), FixedState::new());
            let seen = predictor.observe(&mut float, &[], &x32);
            let _ = units.observe(&mut state, x);
            if seen.is_err() {
                continue;
            }
            for step in 0..options.horizon {
                let u = &trajectory.inputs[(start + step) * m..][..m];
                let u32: Vec<f32> = u.iter().map(|u| *u as f32).collect();
                let in_float = predictor.step(&mut float, &u32);
                let in_fixed = units.step(&mut state, u);
                let (in_fixed, in_float) = match (in_fixed, in_float) {
                    (Ok(x), Ok(())) => (x, {
                        let mut out = vec![0.0; n];
                        let _ = predictor.coordinates(&float, &mut out);
                        out.into_iter().map(f64::from).collect::<Vec<f64>>()
                    }),
                    (Ok(_), Err(_)) => {
                        result.diverged[0] += 1;
                        break;
                    }
                    (Err(_), Ok(())) => {
                        result.diverged[1] += 1;
                        break;
                    }
                    (Err(_), Err(_)) => {
                        result.diverged[2] += 1;
                        break;
                    }
                };
                if step == 0 {
                    one_step.add(structure, &in_fixed, &in_float);
                }
                rollout.add(structure, &in_fixed, &in_float);
            }
        }
    }
    (result.one_step, result.rollout) = (one_step.done(), rollout.done());
    (result.windows > 0).then_some(result)
}

/// Scales, bounds and differences, as text.
pub fn text(export: &FixedExport, one_step: &OneStep, logs: Option<&OnLogs>) -> String {
    let mut text = format!(
        "{} coefficients in 32 bits; nothing overflows, whatever the observables are\n\n{}",
        grouped(export.coefficients as u64),
        scales(&export.coordinates, &export.inputs)
    );
    text += &format!(
        "\none step from {} random samples within the trained range, against f64",
        grouped(one_step.samples as u64)
    );
    if one_step.diverged > 0 {
        text += &format!(" ({} more diverge)", grouped(one_step.diverged as u64));
    }
    text +=
        ":\n                             largest, over full scale          rms   f32: largest\n";
    for ((c, fixed), float) in export.coordinates.iter().zip(&one_step.fixed).zip(&one_step.float) {
        text += &format!(
            "  {:<24} {:>11}  {:>14} {:>12} {:>14}\n",
            format!("{} [{}]", c.name, c.unit),
            significant(fixed.largest),
            significant(fixed.largest / c.full_scale),
            significant(fixed.rms),
            significant(float.largest),
        );
    }
    if let Some(logs) = logs {
        text += &format!(
            "\nrollouts of {} steps over {} windows of the logs, against f32:\n                             \
             one step: largest  rollout: largest          rms\n",
            logs.horizon,
            grouped(logs.windows as u64)
        );
        for ((c, first), all) in export.coordinates.iter().zip(&logs.one_step).zip(&logs.rollout) {
            text += &format!(
                "  {:<24} {:>21}  {:>16} {:>12}\n",
                format!("{} [{}]", c.name, c.unit),
                significant(first.largest),
                significant(all.largest),
                significant(all.rms),
            );
        }
        let [float, fixed, both] = logs.diverged;
        text += &format!(
            "  diverged: {both} in both, {float} in f32 alone, {fixed} in fixed point alone\n"
        );
    }
    text
}
