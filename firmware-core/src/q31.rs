//! Fixed point: models for controllers without a floating-point unit, all of it in 32-bit integers.
//!
//! A [`FixedModel`] predicts what the [`Model`](crate::Model) predicts that it was made from
//! (`trainer export MODEL.bin --q31 --out MODEL.q31`), within a millionth of a coordinate's range, and to
//! the bit the same on every machine: every number and every rounding is defined, for the contraction in
//! its [own words](#what-is-computed). Nothing in it is a float but the scales, which are for hosts.
//!
//! # Numbers
//!
//! A number on ℝ, a coordinate or an input, is a signed 32-bit integer X that stands for
//! `centre + full · X / 2³¹`, in the unit of the coordinate; centre and full scale are [`Scale::Line`].
//! An angle is an integer in which a full turn is 2³² ([`Scale::Turn`]), so that wrapping is the overflow
//! of an addition. [`Scale::to_fixed`] and [`Scale::to_unit`] convert on a host; a controller compares,
//! scales and offsets its sensors' integers itself.
//!
//! # What is beyond the scale
//!
//! A full scale is the trained range of the coordinate and a margin. What is outside the trained range
//! but within full scale is predicted, and flagged as [`out_of_range`](FixedState::out_of_range). What is
//! beyond full scale does not exist: a prediction that would be there has
//! [diverged](PredictError::Diverged), and a measurement or input that is there has to be limited to full
//! scale by who converts it ([`Scale::to_fixed`] does), where it is outside the trained range.
//! Nothing overflows on the way, whatever observables there are: the exporter scales the coefficients so
//! that no sum can, and [`parse`] adds up their magnitudes and refuses the model if one could.
//!
//! # What is computed
//!
//! 1. The operator: per output and block Horner's scheme, `lo + ⌊V · X / 2³²⌋` for every coefficient; the
//!    blocks are added.
//! 2. An output is multiplied with 2^shift of its coordinate (a negative one: to nearest, ties up). It is
//!    the next value, or the change, which is added; the change of a pose is turned first,
//!    `(c · a ∓ s · b) · 2^(shift − 31)` in 64 bits and rounded once.
//! 3. Sine and cosine of an absolute angle are put back on the circle by an approximation of 1 / √n
//!    and three rounds of Newton's method.
//!
//! # Which models
//!
//! Dense models of any blocks, Hermite and Fourier (the exporter turns a Fourier basis of order p into
//! \[1, sin φ\] ⊗ \[1, cos φ, …, cosᵖ φ\], which spans it), with absolute and increment targets, translation
//! and se(2) symmetry. No delays, and no sparse models: the exporter says so.
//!
//! # The section 0x0005
//!
//! 32-bit words, little-endian; the [blob] has no coefficients in f32 then.
//!
//! | words | what |
//! |---|---|
//! | 1 | bytes: states n, inputs m, blocks b, factors f |
//! | 1 | bytes: x, y, heading of an se(2) pose, and 1; or 0 |
//! | 10 n | coordinates, below |
//! | 5 m | inputs, below |
//! | f | factors of all blocks; byte 0: register; byte 1: radix, order + 1 |
//! | b | blocks: number of factors |
//! | | coefficients, i32, `[blocks, outputs, terms]`, the first factor of a block slowest |
//!
//! | word of a coordinate | what |
//! |---|---|
//! | 0 | byte 0: kind; byte 1: shift, signed; byte 2: the first of its outputs; byte 3: observable α |
//! | 1 | bytes: registers of value, sine and cosine, 31 for what is not kept; byte 3: observable β |
//! | 2, 3 | least value (i32) and span (u32): outside them a prediction has diverged |
//! | 4, 5 | trained range of the value, or the sine, α: half of the least and of the last one (i32) |
//! | 6, 7 | the same of the cosine, β |
//! | 8, 9 | centre and full scale, f32; 0 and π for an angle |
//!
//! | word of an input | what |
//! |---|---|
//! | 0 | byte 0: register; byte 1: observable |
//! | 1, 2 | trained range: half of the least and of the last value (i32) |
//! | 3, 4 | centre and full scale, f32 |
//!
//! | kind | output | kept | least value and span are those of |
//! |---|---|---|---|
//! | 0 | the next value | value | the output |
//! | 1 | the change | value | the next value |
//! | 2 | two: the next sine and cosine, in Q(31 − shift) | sine, cosine | nothing |
//! | 3 | the change of an angle | value | the next value |
//! | 4 | the change of an angle | value, sine, cosine | the next value |
//! | 5 | the change of x or y of the pose, in the body frame | value | the next value |
//!
//! Every number that is kept has a register of its own, from 0 to 30; a block whose factors are registers
//! 0, 1, … in order is folded where they lie. Observables are counted as in the metadata. Sine and
//! cosine are in Q31. The self-test (kind 0x0003, encoding 7) is i32, coordinates, inputs, and the
//! coordinates one step later, which have to come out exactly.

use heapless::Vec;

use crate::blob::{
    self, EmitError, Extent, METADATA, ParseError, Q31, Q31_SELF_TEST, Sections, Writer,
};
use crate::capacity::{MAX_BLOCK_FACTORS, MAX_INPUTS, MAX_ORDER, MAX_OUTPUTS, MAX_STATES};
use crate::encoding::Reader;
use crate::model::Structure;
use crate::predictor::{OutOfRange, PredictError};

mod circle;
mod kernel;

use kernel::{MAX_TILES, Tiles};

/// Blocks of a model in fixed point.
pub const MAX_BLOCKS: usize = 16;
/// Factors of all of its blocks.
pub const MAX_FACTORS: usize = 64;

/// Registers: inputs, and value, sine and cosine of every coordinate as far as they are kept.
const REGISTERS: usize = 32;
/// Where goes what is not kept.
const NOWHERE: usize = 31;
const _: () = assert!(MAX_INPUTS + 3 * MAX_STATES <= NOWHERE && MAX_OUTPUTS == 16);

type Bank = [i32; REGISTERS];

/// What an output stands for: the kinds of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// The next value.
    Next = 0,
    /// The change.
    Change = 1,
    /// The next sine and cosine.
    Circle = 2,
    /// The change of an angle.
    Turn = 3,
    /// The change of an angle whose sine and cosine are kept.
    Heading = 4,
    /// The change of x or y of a pose, in the body frame.
    Pose = 5,
}

impl Kind {
    #[inline(always)]
    fn of(head: i32) -> Option<Self> {
        Some(match head & 0xFF {
            0 => Self::Next,
            1 => Self::Change,
            2 => Self::Circle,
            3 => Self::Turn,
            4 => Self::Heading,
            5 => Self::Pose,
            _ => return None,
        })
    }

    /// Whether the coordinate is an angle.
    pub fn angle(self) -> bool {
        matches!(self, Self::Circle | Self::Turn | Self::Heading)
    }

    fn outputs(self) -> usize {
        if self == Self::Circle { 2 } else { 1 }
    }
}

/// What the integers of a coordinate or an input stand for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// `centre + full · X / 2³¹`
    Line {
        /// What 0 stands for.
        centre: f32,
        /// What 2³¹ would stand for more.
        full: f32,
    },
    /// `π · X / 2³¹` \[rad\]
    Turn,
}

impl Scale {
    /// The nearest integer: beyond full scale the last one there is, of an angle the same angle; 0 for NaN
    /// and infinite angles.
    ///
    /// ```
    /// use firmware_core::q31::Scale;
    /// let scale = Scale::Line { centre: 1.0, full: 2.0 };
    /// assert_eq!(scale.to_fixed(2.0), 1 << 30);
    /// assert_eq!(scale.to_fixed(99.0), i32::MAX);
    /// let turn = core::f64::consts::TAU;
    /// assert_eq!(Scale::Turn.to_fixed(0.125 * turn), 1 << 29);
    /// assert_eq!(Scale::Turn.to_fixed(1.125 * turn), 1 << 29);
    /// ```
    pub fn to_fixed(self, value: f64) -> i32 {
        match self {
            Self::Line { centre, full } => {
                let share = (value - f64::from(centre)) / f64::from(full);
                libm::rint(share * TWO_31) as i32
            }
            Self::Turn => {
                let turns = value / core::f64::consts::TAU;
                // Exact: within half a turn, and an integer of at most 33 bits.
                libm::rint((turns - libm::rint(turns)) * (2.0 * TWO_31)) as i64 as i32
            }
        }
    }

    /// What the integer stands for, in the unit; of an angle in \[−π, π).
    ///
    /// ```
    /// use firmware_core::q31::Scale;
    /// assert_eq!(Scale::Line { centre: 1.0, full: 2.0 }.to_unit(1 << 30), 2.0);
    /// assert_eq!(Scale::Turn.to_unit(i32::MIN), -core::f64::consts::PI);
    /// ```
    pub fn to_unit(self, fixed: i32) -> f64 {
        let share = f64::from(fixed) / TWO_31;
        match self {
            Self::Line { centre, full } => f64::from(centre) + f64::from(full) * share,
            Self::Turn => core::f64::consts::PI * share,
        }
    }
}

const TWO_31: f64 = 2_147_483_648.0;

/// Why bytes are not a model in fixed point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LoadError {
    /// They are no blob, or a damaged one.
    Blob(ParseError),
    /// It is a model in floating point: [`blob::parse`] reads it.
    FloatingPoint,
    /// A number of the section is not what its others ask for.
    Section {
        /// Which one.
        field: &'static str,
    },
    /// There are more than there is room for.
    TooLarge {
        /// Of what.
        field: &'static str,
        /// The capacity.
        capacity: usize,
        /// What was found.
        found: usize,
    },
    /// A sum may not fit 32 bits.
    Overflow {
        /// Of which output.
        output: usize,
    },
    /// The stored prediction is not reproduced.
    SelfTest,
}

impl From<ParseError> for LoadError {
    fn from(error: ParseError) -> Self {
        match error {
            ParseError::UnknownSection { kind: blob::COEFFICIENTS_KIND, .. } => Self::FloatingPoint,
            other => Self::Blob(other),
        }
    }
}

/// How a block is folded.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Plan<'a> {
    factors: &'a [i32],
    tiles: Tiles<'a>,
    /// Tiles of an output.
    count: u8,
    /// Its factors are the first registers in order.
    in_place: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Pose {
    heading: u8,
    /// Which outputs are the changes of x and y.
    ahead: u8,
    left: u8,
}

/// A model in fixed point, checked once, and read in place.
#[derive(Clone, Debug, PartialEq)]
pub struct FixedModel<'a> {
    robot: &'a str,
    /// Tells the states of this model from those of others: odd.
    tag: u32,
    outputs: u8,
    pose: Option<Pose>,
    coordinates: &'a [[i32; 10]],
    inputs: &'a [[i32; 5]],
    /// One block of six axes of two in place; otherwise the blocks.
    six: Option<&'a [[i32; 64]]>,
    blocks: Vec<Plan<'a>, MAX_BLOCKS>,
}

/// All that moves while a model in fixed point predicts.
///
/// `clone_from` into a state that is there already takes a fraction of what `clone` takes.
#[derive(Debug)]
pub struct FixedState {
    /// The present sample, and where the next one is made.
    banks: [Bank; 2],
    present: bool,
    /// Less than 0: the present sample is outside the trained range.
    outside: i32,
    /// Which model it belongs to; 0: nothing observed yet.
    model: u32,
    step: u32,
    out_of_range: Option<OutOfRange>,
    outputs: [i32; MAX_OUTPUTS],
    scratch: Scratch,
}

/// What a step makes on the way.
#[derive(Clone, Debug)]
struct Scratch {
    values: [i32; MAX_BLOCK_FACTORS],
    room: [i32; MAX_TILES],
}

/// What a step has made on the way is not copied into a state that is there already.
impl Clone for FixedState {
    fn clone(&self) -> Self {
        Self { scratch: self.scratch.clone(), ..*self }
    }

    fn clone_from(&mut self, other: &Self) {
        let [a, b] = &other.banks;
        let [present, _] = &mut self.banks;
        *present = if other.present { *b } else { *a };
        (self.present, self.outside, self.model) = (false, other.outside, other.model);
        (self.step, self.out_of_range) = (other.step, other.out_of_range);
    }
}

impl Default for FixedState {
    fn default() -> Self {
        Self {
            banks: [[0; REGISTERS]; 2],
            present: false,
            outside: 0,
            model: 0,
            step: 0,
            out_of_range: None,
            outputs: [0; MAX_OUTPUTS],
            scratch: Scratch { values: [0; MAX_BLOCK_FACTORS], room: [0; MAX_TILES] },
        }
    }
}

impl FixedState {
    /// Nothing observed yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Steps predicted since the last measurement.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// The first step and observable outside the trained range since the last measurement.
    pub fn out_of_range(&self) -> Option<OutOfRange> {
        self.out_of_range
    }

    /// The present sample, and where the next one is made.
    #[inline(always)]
    fn banks(&mut self) -> (&mut Bank, &mut Bank) {
        let [a, b] = &mut self.banks;
        if self.present { (b, a) } else { (a, b) }
    }
}

/// Register `index`, which a checked model keeps below [`REGISTERS`].
#[inline(always)]
fn get(bank: &Bank, index: i32) -> i32 {
    bank.get(index as usize & (REGISTERS - 1)).copied().unwrap_or_default()
}

#[inline(always)]
fn set(bank: &mut Bank, index: i32, x: i32) {
    if let Some(register) = bank.get_mut(index as usize & (REGISTERS - 1)) {
        *register = x;
    }
}

/// Less than 0 if a number is outside its trained range: without the last bit nothing overflows.
#[inline(always)]
fn beyond(x: i32, low: i32, high: i32) -> i32 {
    (x >> 1).wrapping_sub(low) | high.wrapping_sub(x >> 1)
}

/// Whether a number is below the least or above the last of a range.
#[inline(always)]
fn outside(x: i32, low: i32, span: i32) -> bool {
    x.wrapping_sub(low) as u32 > span as u32
}

/// `x · 2^shift`: to the right to nearest, ties up; to the left without what overflows.
#[inline(always)]
fn shifted(x: i32, shift: i32) -> i32 {
    if shift >= 0 {
        x.wrapping_shl(shift as u32)
    } else {
        // The bound of an output leaves room for the 1.
        x.wrapping_shr(shift.wrapping_neg().wrapping_sub(1) as u32).wrapping_add(1) >> 1
    }
}

/// `x + z · 2^shift`, if it fits.
#[inline(always)]
fn change(x: i32, z: i32, shift: i32) -> Option<i32> {
    if shift <= 0 {
        return x.checked_add(shifted(z, shift));
    }
    let change = i64::from(z).wrapping_shl(shift as u32);
    i32::try_from(change.wrapping_add(i64::from(x))).ok()
}

#[inline(always)]
fn shift_of(head: i32) -> i32 {
    i32::from((head >> 8) as i8)
}

impl<'a> FixedModel<'a> {
    /// The robot that the model belongs to.
    pub fn robot(&self) -> &'a str {
        self.robot
    }

    /// State coordinates.
    pub fn states(&self) -> usize {
        self.coordinates.len()
    }

    /// Inputs.
    pub fn inputs(&self) -> usize {
        self.inputs.len()
    }

    /// Columns of the operator: one per coordinate, two for an absolute angle.
    pub fn outputs(&self) -> usize {
        self.outputs.into()
    }

    /// Coefficients of all outputs, block by block.
    pub fn coefficients(&self) -> impl Iterator<Item = &'a [i32]> {
        self.blocks.iter().map(|plan| plan.tiles.coefficients())
    }

    /// Kind and shift of every coordinate, and what its integers stand for.
    pub fn coordinates_of(&self) -> impl Iterator<Item = (Kind, i32, Scale)> {
        self.coordinates.iter().map(|[head, .., centre, full]| {
            let kind = Kind::of(*head).unwrap_or(Kind::Next);
            let line = scale(*centre, *full);
            (kind, shift_of(*head), if kind.angle() { Scale::Turn } else { line })
        })
    }

    /// What the integers of a coordinate stand for.
    pub fn coordinate_scale(&self, coordinate: usize) -> Option<Scale> {
        self.coordinates_of().nth(coordinate).map(|(_, _, scale)| scale)
    }

    /// What the integers of an input stand for.
    pub fn input_scale(&self, input: usize) -> Option<Scale> {
        self.inputs.get(input).map(|[.., centre, full]| scale(*centre, *full))
    }

    /// Takes a measurement: `coordinates`, shape `[states]`, each in its [scale](Self::coordinate_scale).
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`]; the state is unchanged.
    pub fn observe(&self, state: &mut FixedState, coordinates: &[i32]) -> Result<(), PredictError> {
        expect("coordinates", self.coordinates.len(), coordinates.len())?;
        let (bank, _) = state.banks();
        let mut outside = 0;
        for ([head, registers, _, _, low, high, last @ ..], x) in
            self.coordinates.iter().zip(coordinates)
        {
            let (sin, cos) = circle::sin_cos(*x);
            let angle = matches!(Kind::of(*head), Some(Kind::Circle | Kind::Heading));
            set(bank, *registers, *x);
            set(bank, registers >> 8, sin);
            set(bank, registers >> 16, cos);
            outside |= beyond(if angle { sin } else { *x }, *low, *high);
            if let ([low, high, ..], true) = (last, angle) {
                outside |= beyond(cos, *low, *high);
            }
        }
        (state.model, state.step, state.out_of_range) = (self.tag, 0, None);
        state.outside = outside;
        Ok(())
    }

    /// Predicts one sample time ahead under `input`, shape `[inputs]`, each in its
    /// [scale](Self::input_scale), and moves the state there.
    ///
    /// # Errors
    /// [`PredictError::NotReady`] until something was observed, [`PredictError::DimensionMismatch`],
    /// [`PredictError::Diverged`]; the state is unchanged.
    #[inline]
    pub fn step(&self, state: &mut FixedState, input: &[i32]) -> Result<(), PredictError> {
        if state.model != self.tag {
            return Err(PredictError::NotReady { have: 0, need: 1 });
        }
        expect("inputs", self.inputs.len(), input.len())?;
        let [a, b] = &mut state.banks;
        let (from, to) = if state.present { (b, a) } else { (a, b) };
        let mut outside = state.outside;
        for ([register, low, high, ..], u) in self.inputs.iter().zip(input) {
            set(from, *register, *u);
            outside |= beyond(*u, *low, *high);
        }
        match (self.six, from.first_chunk()) {
            (Some(all), Some(v)) => {
                let outputs = state.outputs.get_mut(..all.len()).unwrap_or_default();
                kernel::six(v, all, outputs);
            }
            _ => self.operate(from, &mut state.outputs, &mut state.scratch),
        }
        let Some(next_outside) = self.retract(from, to, &state.outputs) else {
            return Err(PredictError::Diverged { step: state.step.wrapping_add(1) });
        };
        let step = state.step.wrapping_add(1);
        if outside < 0 && state.out_of_range.is_none() {
            let observable = self.first_outside(from);
            state.out_of_range = observable.map(|observable| OutOfRange { step, observable });
        }
        state.outside = next_outside;
        state.present = !state.present;
        state.step = step;
        Ok(())
    }

    /// The outputs of any operator.
    #[inline(never)]
    fn operate(&self, from: &Bank, outputs: &mut [i32; MAX_OUTPUTS], scratch: &mut Scratch) {
        let outputs = outputs.get_mut(..self.outputs.into()).unwrap_or_default();
        for (i, plan) in self.blocks.iter().enumerate() {
            if i == 0 {
                plan.contract(from, outputs, scratch);
                continue;
            }
            let mut block = [0; MAX_OUTPUTS];
            let block = block.get_mut(..outputs.len()).unwrap_or_default();
            plan.contract(from, block, scratch);
            for (sum, z) in outputs.iter_mut().zip(block) {
                // The bound is that of the sum; panics where overflow is checked.
                *sum += *z;
            }
        }
    }

    /// The next sample from the operator's outputs, and less than 0 if it is outside the trained range; `None` if
    /// there is none.
    #[inline(always)]
    fn retract(&self, from: &Bank, to: &mut Bank, outputs: &[i32; MAX_OUTPUTS]) -> Option<i32> {
        let mut beyond_range = 0;
        for [head, registers, low, span, least, last, least_cos, last_cos, ..] in self.coordinates {
            let output = |i: i32| {
                let index = (head >> 16).wrapping_add(i) as usize & (MAX_OUTPUTS - 1);
                outputs.get(index).copied().unwrap_or_default()
            };
            let (z, registers) = (output(0), *registers);
            if head & 0xFF == Kind::Next as i32 {
                if outside(z, *low, *span) {
                    return None;
                }
                let x = z << (head >> 8 & 31);
                set(to, registers, x);
                beyond_range |= beyond(x, *least, *last);
                continue;
            }
            let (kind, shift) = (Kind::of(*head)?, shift_of(*head));
            let x = match kind {
                Kind::Circle => {
                    let cos = output(1);
                    let zeros = circle::zeros(z, cos);
                    if zeros > shift as u32 + circle::SHORTEST {
                        return None;
                    }
                    let (sin, cos) = circle::on_circle(z, cos, zeros);
                    set(to, registers >> 8, sin);
                    set(to, registers >> 16, cos);
                    beyond_range |= beyond(sin, *least, *last) | beyond(cos, *least_cos, *last_cos);
                    continue;
                }
                Kind::Pose => self.place(*head, registers, from, outputs)?,
                Kind::Next | Kind::Change => change(get(from, registers), z, shift)?,
                Kind::Turn | Kind::Heading => get(from, registers).wrapping_add(shifted(z, shift)),
            };
            if outside(x, *low, *span) {
                return None;
            }
            set(to, registers, x);
            if kind == Kind::Heading {
                let (sin, cos) = circle::sin_cos(x);
                set(to, registers >> 8, sin);
                set(to, registers >> 16, cos);
                beyond_range |= beyond(sin, *least, *last) | beyond(cos, *least_cos, *last_cos);
            } else {
                beyond_range |= beyond(x, *least, *last);
            }
        }
        Some(beyond_range)
    }

    /// The next x or y of a pose.
    #[inline(never)]
    fn place(
        &self,
        head: i32,
        registers: i32,
        from: &Bank,
        outputs: &[i32; MAX_OUTPUTS],
    ) -> Option<i32> {
        let pose = self.pose?;
        let output = |index: u8| outputs.get(usize::from(index)).copied().map(i64::from);
        let (ahead, left) = (output(pose.ahead)?, output(pose.left)?);
        let [_, heading, ..] = self.coordinates.get(usize::from(pose.heading))?;
        let (sin, cos) = (get(from, heading >> 8), get(from, heading >> 16));
        let (sin, cos) = (i64::from(sin), i64::from(cos));
        // Below 2⁶² both: the outputs are below 2³⁰.
        let change = if head >> 16 & 0xFF == i32::from(pose.ahead) {
            cos.wrapping_mul(ahead).wrapping_sub(sin.wrapping_mul(left))
        } else {
            sin.wrapping_mul(ahead).wrapping_add(cos.wrapping_mul(left))
        };
        let down = 31_i32.wrapping_sub(shift_of(head)) as u32;
        let change = change.wrapping_shr(down.wrapping_sub(1)).wrapping_add(1) >> 1;
        i32::try_from(change.wrapping_add(get(from, registers).into())).ok()
    }

    /// The first observable outside its range.
    #[cold]
    #[inline(never)]
    fn first_outside(&self, bank: &Bank) -> Option<usize> {
        let inputs =
            self.inputs.iter().map(|[head, low, high, ..]| (*head, *low, *high, head >> 8));
        let states =
            self.coordinates.iter().flat_map(|[head, registers, _, _, low, high, last @ ..]| {
                let [least_cos, last_cos, ..] = last;
                let angle = matches!(Kind::of(*head), Some(Kind::Circle | Kind::Heading));
                let first = if angle { registers >> 8 } else { *registers };
                let cos = (registers >> 16, *least_cos, *last_cos, registers >> 24);
                [Some((first, *low, *high, head >> 24)), angle.then_some(cos)].into_iter().flatten()
            });
        let mut all = states.chain(inputs);
        let found =
            all.find(|(register, low, high, _)| beyond(get(bank, *register), *low, *high) < 0);
        found.map(|(.., observable)| (observable & 0xFF) as usize)
    }

    /// The present coordinates in `out`, shape `[states]`, each in its [scale](Self::coordinate_scale):
    /// measured or predicted, whichever came last; 0 if nothing was observed.
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`].
    pub fn coordinates(&self, state: &FixedState, out: &mut [i32]) -> Result<(), PredictError> {
        expect("coordinates", self.coordinates.len(), out.len())?;
        let [a, b] = &state.banks;
        let bank = if state.present { b } else { a };
        for (to, [head, registers, ..]) in out.iter_mut().zip(self.coordinates) {
            *to = match Kind::of(*head) {
                Some(Kind::Circle) => {
                    circle::angle(get(bank, registers >> 8), get(bank, registers >> 16))
                }
                _ => get(bank, *registers),
            };
        }
        Ok(())
    }

    /// Predicts over a sequence of inputs, shape `[horizon, inputs]`, into `predicted`, shape
    /// `[horizon, states]`, and moves the state to the end. Clone the state first to keep it.
    ///
    /// # Errors
    /// As [`step`](Self::step); the rows of `predicted` before the step that failed are valid, the
    /// others are untouched.
    pub fn rollout(
        &self,
        state: &mut FixedState,
        inputs: &[i32],
        predicted: &mut [i32],
    ) -> Result<(), PredictError> {
        let (n, m) = (self.coordinates.len().max(1), self.inputs.len());
        let horizon = predicted.len().checked_div(n).unwrap_or(0);
        expect("predicted", horizon.saturating_mul(n), predicted.len())?;
        expect("inputs", horizon.saturating_mul(m), inputs.len())?;
        let mut rows = inputs.chunks_exact(m.max(1));
        for out in predicted.chunks_exact_mut(n) {
            self.step(state, rows.next().unwrap_or(&[]))?;
            self.coordinates(state, out)?;
        }
        Ok(())
    }

    /// The same with one input, shape `[inputs]`, held over the whole horizon.
    ///
    /// # Errors
    /// As [`rollout`](Self::rollout).
    pub fn rollout_held(
        &self,
        state: &mut FixedState,
        input: &[i32],
        predicted: &mut [i32],
    ) -> Result<(), PredictError> {
        let n = self.coordinates.len().max(1);
        let horizon = predicted.len().checked_div(n).unwrap_or(0);
        expect("predicted", horizon.saturating_mul(n), predicted.len())?;
        for out in predicted.chunks_exact_mut(n) {
            self.step(state, input)?;
            self.coordinates(state, out)?;
        }
        Ok(())
    }

    /// Checks everything in a section.
    fn check(robot: &'a str, tag: u32, words: &'a [u32]) -> Result<Self, LoadError> {
        let section = |field| LoadError::Section { field };
        let length = section("length");
        let ([counts, pose], rest) = words.split_first_chunk().ok_or(length)?;
        let [n, m, b, f] = counts.to_le_bytes().map(usize::from);
        let too_large = |field, capacity, found| LoadError::TooLarge { field, capacity, found };
        let room = [
            ("states", MAX_STATES, n),
            ("inputs", MAX_INPUTS, m),
            ("blocks", MAX_BLOCKS, b),
            ("factors", MAX_FACTORS, f),
        ];
        if let Some((field, capacity, found)) = room.into_iter().find(|(_, most, n)| n > most) {
            return Err(too_large(field, capacity, found));
        }
        if n == 0 || b == 0 {
            return Err(section("counts"));
        }
        let (coordinates, rest) = rest.split_at_checked(n.wrapping_mul(10)).ok_or(length)?;
        let (inputs, rest) = rest.split_at_checked(m.wrapping_mul(5)).ok_or(length)?;
        let (mut factors, rest) = rest.split_at_checked(f).ok_or(length)?;
        let (blocks, mut coefficients) = rest.split_at_checked(b).ok_or(length)?;
        let mut model = Self {
            robot,
            tag,
            outputs: 0,
            pose: None,
            coordinates: bytemuck::try_cast_slice(coordinates).map_err(|_| length)?,
            inputs: bytemuck::try_cast_slice(inputs).map_err(|_| length)?,
            six: None,
            blocks: Vec::new(),
        };
        let mut outputs = 0_usize;
        for [head, ..] in model.coordinates {
            let kind = Kind::of(*head).ok_or(section("kind of a coordinate"))?;
            outputs = outputs.wrapping_add(kind.outputs());
        }
        model.outputs = outputs as u8;
        let observed = model.check_registers()?;

        for count in blocks {
            let count = usize::try_from(*count).unwrap_or(usize::MAX);
            if count > MAX_BLOCK_FACTORS {
                return Err(too_large("factors of a block", MAX_BLOCK_FACTORS, count));
            }
            let (own, others) = factors.split_at_checked(count).ok_or(section("blocks"))?;
            factors = others;
            let own: &[i32] = bytemuck::try_cast_slice(own).map_err(|_| length)?;
            let fits = |factor: &i32| {
                let [register, radix, rest @ ..] = factor.to_le_bytes();
                let register = 1_u32.checked_shl(register.into()).unwrap_or(0);
                observed & register != 0
                    && (2..=MAX_ORDER.saturating_add(1)).contains(&radix)
                    && rest == [0, 0]
            };
            if !own.iter().all(fits) {
                return Err(section("factor"));
            }
            let radices = own.iter().map(radix);
            let product = |size: usize, radix| size.saturating_mul(radix);
            let size = radices.clone().fold(1, product).saturating_mul(outputs);
            let (all, others) = coefficients.split_at_checked(size).ok_or(length)?;
            coefficients = others;
            let all = bytemuck::try_cast_slice(all).map_err(|_| length)?;
            let tiles = Tiles::new(radices.clone(), all);
            let count = radices.rev().skip(tiles.axes()).fold(1, product);
            if count > MAX_TILES {
                return Err(too_large("tiles of a block", MAX_TILES, count));
            }
            let in_place = (0..).zip(own).all(|(i, factor)| factor & 0xFF == i);
            if let (Tiles::Six(all), 1, true, 1) = (tiles, count, in_place, b) {
                model.six = Some(all);
            }
            let plan = Plan { factors: own, tiles, count: count as u8, in_place };
            model.blocks.push(plan).map_err(|_| section("blocks"))?;
        }
        if !factors.is_empty() {
            return Err(section("blocks"));
        }
        if !coefficients.is_empty() {
            return Err(length);
        }
        let bounds = model.bounds()?;
        model.check_coordinates(*pose, &bounds)?;
        Ok(model)
    }

    /// That every number that is kept has a register of its own; the registers that may be observed, a bit each.
    fn check_registers(&self) -> Result<u32, LoadError> {
        let section = LoadError::Section { field: "registers" };
        let (mut used, mut observed) = (0_u32, 0_u32);
        let mut take = |register: u8, observable: bool| {
            let bit = 1_u32.checked_shl(register.into()).unwrap_or(0);
            let free = usize::from(register) < NOWHERE && used & bit == 0;
            used |= bit;
            observed |= if observable { bit } else { 0 };
            if free { Ok(()) } else { Err(section) }
        };
        for [head, ..] in self.inputs {
            let [register, _, rest @ ..] = head.to_le_bytes();
            take(register, true)?;
            if rest != [0, 0] {
                return Err(section);
            }
        }
        for [head, registers, ..] in self.coordinates {
            let kind = Kind::of(*head).ok_or(section)?;
            let [value, sin, cos, _] = registers.to_le_bytes();
            if kind != Kind::Circle {
                take(value, matches!(kind, Kind::Next | Kind::Change))?;
            }
            let circle = matches!(kind, Kind::Circle | Kind::Heading);
            if circle {
                take(sin, true)?;
                take(cos, true)?;
            }
            let nowhere = |register: u8| usize::from(register) == NOWHERE;
            let fits = match kind {
                Kind::Circle => nowhere(value),
                Kind::Heading => true,
                _ => nowhere(sin) && nowhere(cos),
            };
            if !fits {
                return Err(section);
            }
        }
        Ok(observed)
    }

    /// The largest magnitude that every output can have.
    fn bounds(&self) -> Result<[u32; MAX_OUTPUTS], LoadError> {
        let mut bounds = [0_u32; MAX_OUTPUTS];
        for plan in &self.blocks {
            let coefficients = plan.tiles.coefficients();
            let size = coefficients.len().checked_div(self.outputs()).unwrap_or(0).max(1);
            let rows = coefficients.chunks_exact(size);
            for ((output, bound), c) in bounds.iter_mut().enumerate().zip(rows) {
                let more = kernel::bound(plan.factors.iter().map(radix), c);
                let sum = more.and_then(|more| bound.checked_add(more));
                // One less than what fits, for a rounding.
                *bound = sum
                    .filter(|sum| *sum < i32::MAX.unsigned_abs())
                    .ok_or(LoadError::Overflow { output })?;
            }
        }
        Ok(bounds)
    }

    /// Kinds, shifts and ranges, and the pose, for outputs within their bounds.
    fn check_coordinates(&mut self, pose: u32, bounds: &[u32]) -> Result<(), LoadError> {
        let section = |field| LoadError::Section { field };
        let [x, y, heading, there] = pose.to_le_bytes();
        let (mut ahead, mut left, mut poses) = (None, None, 0_u8);
        let mut output = 0_u8;
        for (index, [head, _, low, span, .., centre, full]) in (0_u8..).zip(self.coordinates) {
            let kind = Kind::of(*head).ok_or(section("kind of a coordinate"))?;
            let shift = shift_of(*head);
            let bound = bounds.get(usize::from(output)).copied().unwrap_or_default();
            let (low, high) = (i64::from(*low), i64::from(*low) + i64::from(*span as u32));
            let shift_fits = match kind {
                Kind::Circle => (0..=20).contains(&shift),
                // What is possible and not outside the range is there when it is shifted.
                Kind::Next => {
                    let shifted = |x: i64| x << shift.clamp(0, 31);
                    let bound = i64::from(bound);
                    (0..=31).contains(&shift)
                        && i32::try_from(shifted(low.max(-bound))).is_ok()
                        && i32::try_from(shifted(high.min(bound))).is_ok()
                }
                Kind::Change | Kind::Turn | Kind::Heading => (-31..=31).contains(&shift),
                Kind::Pose => (-30..=30).contains(&shift) && bound < 1 << 30,
            };
            if !shift_fits || head >> 16 & 0xFF != i32::from(output) {
                return Err(section("shift of a coordinate"));
            }
            if high > i64::from(i32::MAX) {
                return Err(section("range of a coordinate"));
            }
            let (centre, full) = (f32::from_bits(*centre as u32), f32::from_bits(*full as u32));
            if !(centre.is_finite() && full.is_finite() && full > 0.0) {
                return Err(section("scale of a coordinate"));
            }
            if kind == Kind::Pose {
                poses = poses.wrapping_add(1);
                if there == 1 && index == x {
                    ahead = Some(output);
                }
                if there == 1 && index == y {
                    left = Some(output);
                }
            }
            output = output.wrapping_add(kind.outputs() as u8);
        }
        let head = |i: u8| self.coordinates.get(usize::from(i)).map(|[head, ..]| *head);
        self.pose = match (there, poses, ahead, left) {
            (0, 0, ..) if pose == 0 => None,
            (1, 2, Some(ahead), Some(left))
                if head(heading).and_then(Kind::of) == Some(Kind::Heading)
                    && head(x).map(shift_of) == head(y).map(shift_of) =>
            {
                Some(Pose { heading, ahead, left })
            }
            _ => return Err(section("pose")),
        };
        let fits = |[.., centre, full]: &[i32; 5]| {
            let (centre, full) = (f32::from_bits(*centre as u32), f32::from_bits(*full as u32));
            centre.is_finite() && full.is_finite() && full > 0.0
        };
        if self.inputs.iter().all(fits) { Ok(()) } else { Err(section("scale of an input")) }
    }

    /// One step from a stored sample.
    fn predict(&self, test: &[i32], out: &mut [i32]) -> Result<(), PredictError> {
        let mut state = FixedState::new();
        let (states, input) = test.split_at_checked(self.coordinates.len()).unwrap_or_default();
        self.observe(&mut state, states)?;
        self.step(&mut state, input)?;
        self.coordinates(&state, out)
    }
}

impl Plan<'_> {
    #[inline(always)]
    fn contract(&self, bank: &Bank, outputs: &mut [i32], scratch: &mut Scratch) {
        let v = match self.in_place {
            true => bank.get(..self.factors.len()).unwrap_or_default(),
            false => {
                for (to, factor) in scratch.values.iter_mut().zip(self.factors) {
                    *to = get(bank, *factor);
                }
                scratch.values.get(..self.factors.len()).unwrap_or_default()
            }
        };
        let radices = self.factors.iter().map(radix);
        self.tiles.contract(self.count.into(), radices, v, outputs, &mut scratch.room);
    }
}

/// Radix of a factor.
#[inline(always)]
fn radix(factor: &i32) -> usize {
    (factor >> 8 & 0xFF) as usize
}

fn scale(centre: i32, full: i32) -> Scale {
    Scale::Line { centre: f32::from_bits(centre as u32), full: f32::from_bits(full as u32) }
}

#[inline]
fn expect(field: &'static str, expected: usize, found: usize) -> Result<(), PredictError> {
    if expected == found {
        Ok(())
    } else {
        Err(PredictError::DimensionMismatch { field, expected, found })
    }
}

/// The sections that a blob in fixed point may have besides the optional ones.
const KNOWN: [(u16, u16); 3] = [METADATA, Q31, Q31_SELF_TEST];

/// Reads exactly one blob in fixed point and checks everything: checksum, section table, every number of
/// the section, that nothing can overflow, and the stored prediction, to the bit.
///
/// # Errors
/// [`LoadError`] names the first thing that is wrong.
pub fn parse(bytes: &[u8]) -> Result<FixedModel<'_>, LoadError> {
    let expected = blob::length(bytes)?;
    if bytes.len() > expected {
        return Err(LoadError::Blob(ParseError::Trailing { expected, found: bytes.len() }));
    }
    parse_prefix(bytes)
}

/// [`parse`], refusing the model of another robot.
///
/// # Errors
/// As [`parse`], and [`ParseError::AnotherRobot`].
pub fn parse_for<'a>(robot: &str, bytes: &'a [u8]) -> Result<FixedModel<'a>, LoadError> {
    match parse(bytes) {
        Ok(model) if model.robot() != robot => Err(LoadError::Blob(ParseError::AnotherRobot)),
        parsed => parsed,
    }
}

/// Reads the blob at the beginning of a flash slot, whatever follows it.
///
/// # Errors
/// As [`parse`].
pub fn parse_prefix(slot: &[u8]) -> Result<FixedModel<'_>, LoadError> {
    let (blob, checksum) = blob::checked(slot, Extent::Prefix)?;
    let sections = Sections::of(blob, &KNOWN)?;
    let missing = ParseError::MissingSection { kind: METADATA.0 };
    // The robot's name is what the metadata begin with.
    let mut metadata = Reader::new(sections.bytes(METADATA).ok_or(missing)?);
    let robot = metadata.text();
    metadata.so_far().map_err(|error| LoadError::Blob(error.into()))?;
    let model = FixedModel::check(robot, checksum | 1, sections.required(Q31)?)?;
    let test: &[i32] = bytemuck::cast_slice(sections.required(Q31_SELF_TEST)?);
    let (given, expected) = test
        .split_at_checked(model.states().wrapping_add(model.inputs()))
        .ok_or(LoadError::Section { field: "self-test" })?;
    if expected.len() != model.states() {
        return Err(LoadError::Section { field: "self-test" });
    }
    let mut out = [0; MAX_STATES];
    let out = out.get_mut(..model.states()).unwrap_or_default();
    match model.predict(given, out) {
        Ok(()) if *out == *expected => Ok(model),
        _ => Err(LoadError::SelfTest),
    }
}

/// The metadata of a blob in fixed point: names, units, and the model that it was made from. For hosts.
///
/// # Errors
/// As [`parse`], and those of the metadata.
pub fn structure(bytes: &[u8]) -> Result<Structure<'_>, LoadError> {
    parse(bytes)?;
    Ok(blob::read_structure(&Sections::of(bytes, &KNOWN)?)?)
}

/// Writes a blob in fixed point: the metadata of `structure`, the words of the section, and a prediction
/// from `test`, the coordinates and then the inputs; returns the number of bytes. For hosts.
///
/// # Errors
/// [`LoadError`] if [`parse`] would refuse the words, [`LoadError::SelfTest`] if there is no prediction,
/// and [`LoadError::TooLarge`] if `out` is too short.
pub fn emit(
    structure: &Structure<'_>,
    words: &[u32],
    test: &[i32],
    out: &mut [u8],
) -> Result<usize, LoadError> {
    let model = FixedModel::check(structure.robot(), 1, words)?;
    let mut expected = [0; MAX_STATES];
    let expected = expected.get_mut(..model.states()).unwrap_or_default();
    model.predict(test, expected).map_err(|_| LoadError::SelfTest)?;
    let found = out.len();
    let short = |capacity| LoadError::TooLarge { field: "bytes", capacity, found };
    let mut write = || -> Result<usize, EmitError> {
        let mut writer = Writer::new(out, KNOWN.len(), structure)?;
        writer.put(Q31, words.iter().map(|word| word.to_le_bytes()))?;
        let numbers = test.iter().chain(&*expected);
        writer.put(Q31_SELF_TEST, numbers.map(|number| number.to_le_bytes()))?;
        writer.seal()
    };
    write().map_err(|_| short(found))
}
