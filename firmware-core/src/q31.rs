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
//! 2. An output is multiplied with 2^shift of its coordinate (to the right: to nearest, ties up). It is
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
//! 32-bit words, little-endian; the [blob](crate::blob) has no coefficients in f32 then.
//!
//! | words | what |
//! |---|---|
//! | 1 | bytes: states n, inputs m, blocks b, factors f |
//! | 1 | bytes: x, y, heading of an se(2) pose, and 1; or 0 |
//! | 5 n | coordinates, below |
//! | 2 m | inputs: centre and full scale, f32 |
//! | 3 f | factors of all blocks, below |
//! | b | blocks: number of factors |
//! | | coefficients, i32, `[blocks, outputs, terms]`, the first factor of a block slowest |
//!
//! | word of a coordinate | what |
//! |---|---|
//! | 0 | byte 0: kind; byte 1: shift, signed |
//! | 1, 2 | least value (i32) and span (u32): outside them a prediction has diverged |
//! | 3, 4 | centre and full scale, f32; 0 and π for an angle |
//!
//! | kind | output | least value and span are those of |
//! |---|---|---|
//! | 0 | the next value | the output |
//! | 1 | the change | the next value |
//! | 2 | two: the next sine and cosine, in Q(31 − shift) | nothing |
//! | 3 | the change of an angle | the next value |
//! | 4 | the same; sine and cosine are kept | the next value |
//! | 5 | the change of x or y of the pose, in the body frame | the next value |
//!
//! | word of a factor | what |
//! |---|---|
//! | 0 | byte 0: register; byte 1: radix, order + 1; byte 2: index of the observable in the metadata |
//! | 1, 2 | trained range: least value (i32) and span (u32) |
//!
//! Register i is input i; 8 + 3 i, 9 + 3 i, 10 + 3 i are value, sine and cosine of coordinate i. Sine and
//! cosine are in Q31. The self-test (kind 0x0003, encoding 7) is i32, coordinates, inputs, and the
//! coordinates one step later, which have to come out exactly.

use heapless::Vec;

use crate::blob::{self, EmitError, METADATA, ParseError, Q31, Q31_SELF_TEST, Sections, Writer};
use crate::capacity::{MAX_BLOCK_FACTORS, MAX_INPUTS, MAX_ORDER, MAX_OUTPUTS, MAX_STATES};
use crate::model::Structure;
use crate::predictor::{OutOfRange, PredictError};

mod circle;
mod kernel;

use kernel::{MAX_TILES, Tile};

/// Blocks of a model in fixed point.
pub const MAX_BLOCKS: usize = 16;
/// Factors of all of its blocks.
pub const MAX_FACTORS: usize = 64;

/// Registers: inputs, and value, sine and cosine of every coordinate.
const REGISTERS: usize = 32;
/// The first register of a coordinate.
const COORDINATES: usize = 8;
const _: () = assert!(MAX_INPUTS <= COORDINATES && COORDINATES + 3 * MAX_STATES == REGISTERS);

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
struct Plan {
    factors: u8,
    tile: Tile,
    tiles: u8,
    /// Coefficients of all outputs.
    coefficients: u32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Pose {
    x: u8,
    y: u8,
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
    coordinates: &'a [[i32; 5]],
    inputs: &'a [[u32; 2]],
    factors: &'a [[i32; 3]],
    blocks: Vec<Plan, MAX_BLOCKS>,
    coefficients: &'a [i32],
}

/// All that moves while a model in fixed point predicts.
#[derive(Clone, Debug)]
pub struct FixedState {
    /// The present sample, and where the next one is made.
    banks: [Bank; 2],
    present: bool,
    /// Which model it belongs to; 0: nothing observed yet.
    model: u32,
    step: u32,
    out_of_range: Option<OutOfRange>,
    /// What a step makes on the way.
    values: [i32; MAX_BLOCK_FACTORS],
    outputs: [i32; MAX_OUTPUTS],
    room: [i32; MAX_TILES],
}

impl Default for FixedState {
    fn default() -> Self {
        Self {
            banks: [[0; REGISTERS]; 2],
            present: false,
            model: 0,
            step: 0,
            out_of_range: None,
            values: [0; MAX_BLOCK_FACTORS],
            outputs: [0; MAX_OUTPUTS],
            room: [0; MAX_TILES],
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
fn register(bank: &Bank, index: i32) -> i32 {
    bank.get(index as usize & (REGISTERS - 1)).copied().unwrap_or_default()
}

/// Value, sine and cosine of every coordinate.
#[inline(always)]
fn coordinates(bank: &Bank) -> &[[i32; 3]] {
    bank.last_chunk::<{ 3 * MAX_STATES }>().map_or(&[], |registers| registers.as_chunks().0)
}

#[inline(always)]
fn coordinates_mut(bank: &mut Bank) -> &mut [[i32; 3]] {
    let registers = bank.last_chunk_mut::<{ 3 * MAX_STATES }>();
    registers.map_or(&mut [], |registers| registers.as_chunks_mut().0)
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

    /// Coefficients of all outputs.
    pub fn coefficients(&self) -> &'a [i32] {
        self.coefficients
    }

    /// Kind and shift of every coordinate, and what its integers stand for.
    pub fn coordinates_of(&self) -> impl Iterator<Item = (Kind, i32, Scale)> {
        self.coordinates.iter().map(|[head, _, _, centre, full]| {
            let kind = Kind::of(*head).unwrap_or(Kind::Next);
            let float = |bits: i32| f32::from_bits(bits as u32);
            let line = Scale::Line { centre: float(*centre), full: float(*full) };
            (kind, shift_of(*head), if kind.angle() { Scale::Turn } else { line })
        })
    }

    /// What the integers of a coordinate stand for.
    pub fn coordinate_scale(&self, coordinate: usize) -> Option<Scale> {
        self.coordinates_of().nth(coordinate).map(|(_, _, scale)| scale)
    }

    /// What the integers of an input stand for.
    pub fn input_scale(&self, input: usize) -> Option<Scale> {
        self.inputs.get(input).map(|[centre, full]| Scale::Line {
            centre: f32::from_bits(*centre),
            full: f32::from_bits(*full),
        })
    }

    /// Takes a measurement: `coordinates`, shape `[states]`, each in its [scale](Self::coordinate_scale).
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`]; the state is unchanged.
    pub fn observe(
        &self,
        state: &mut FixedState,
        coordinates: &[i32],
    ) -> Result<(), PredictError> {
        expect("coordinates", self.coordinates.len(), coordinates.len())?;
        let (bank, _) = state.banks();
        let registers = coordinates_mut(bank).iter_mut();
        for ((to, [head, ..]), x) in registers.zip(self.coordinates).zip(coordinates) {
            let (sin, cos) = match Kind::of(*head) {
                Some(Kind::Circle | Kind::Heading) => circle::sin_cos(*x),
                _ => (0, circle::ONE),
            };
            *to = [*x, sin, cos];
        }
        (state.model, state.step, state.out_of_range) = (self.tag, 0, None);
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
        let step = state.step.saturating_add(1);
        let [a, b] = &mut state.banks;
        let (from, to) = if state.present { (b, a) } else { (a, b) };
        for (register, u) in from.iter_mut().zip(input) {
            *register = *u;
        }

        let outputs = state.outputs.get_mut(..self.outputs.into()).unwrap_or_default();
        let (mut factors, mut coefficients) = (self.factors, self.coefficients);
        let mut out = false;
        let (first, others) = self.blocks.split_first().ok_or(PredictError::Diverged { step })?;
        {
            let (own, rest) = factors.split_at_checked(first.factors.into()).unwrap_or_default();
            let (c, more) =
                coefficients.split_at_checked(first.coefficients as usize).unwrap_or_default();
            (factors, coefficients) = (rest, more);
            out |= gather(from, own, &mut state.values);
            first.contract(own, &state.values, c, outputs, &mut state.room);
        }
        for plan in others {
            let (own, rest) = factors.split_at_checked(plan.factors.into()).unwrap_or_default();
            let (c, more) =
                coefficients.split_at_checked(plan.coefficients as usize).unwrap_or_default();
            (factors, coefficients) = (rest, more);
            out |= gather(from, own, &mut state.values);
            let mut block = [0; MAX_OUTPUTS];
            let block = block.get_mut(..outputs.len()).unwrap_or_default();
            plan.contract(own, &state.values, c, block, &mut state.room);
            for (sum, z) in outputs.iter_mut().zip(block) {
                // The bound is that of the sum.
                *sum = sum.wrapping_add(*z);
            }
        }
        if let Some(pose) = self.pose {
            self.place(pose, from, to, outputs).ok_or(PredictError::Diverged { step })?;
        }
        self.retract(from, to, outputs).ok_or(PredictError::Diverged { step })?;
        if out && state.out_of_range.is_none() {
            let observable = self.first_outside(from);
            state.out_of_range = observable.map(|observable| OutOfRange { step, observable });
        }
        state.present = !state.present;
        state.step = step;
        Ok(())
    }

    /// The next sample from the operator's outputs.
    #[inline(always)]
    fn retract(&self, from: &Bank, to: &mut Bank, outputs: &[i32]) -> Option<()> {
        let registers = coordinates(from).iter().zip(coordinates_mut(to));
        let mut outputs = outputs.iter();
        for ([head, low, span, ..], ([x, ..], next)) in self.coordinates.iter().zip(registers) {
            let z = *outputs.next()?;
            let shift = shift_of(*head);
            match Kind::of(*head)? {
                Kind::Next => {
                    if outside(z, *low, *span) {
                        return None;
                    }
                    let [to, ..] = next;
                    *to = shifted(z, shift);
                    continue;
                }
                Kind::Circle => {
                    let (sin, cos) = circle::on_circle(z, *outputs.next()?, shift as u32)?;
                    let [_, to_sin, to_cos] = next;
                    (*to_sin, *to_cos) = (sin, cos);
                    continue;
                }
                Kind::Change => {
                    let [to, ..] = next;
                    *to = if shift > 0 {
                        let change = i64::from(z).wrapping_shl(shift as u32);
                        i32::try_from(change.wrapping_add(i64::from(*x))).ok()?
                    } else {
                        x.checked_add(shifted(z, shift))?
                    };
                }
                // Is there already.
                Kind::Pose => {}
                Kind::Turn => {
                    let [to, ..] = next;
                    *to = x.wrapping_add(shifted(z, shift));
                }
                Kind::Heading => {
                    let [to, sin, cos] = next;
                    *to = x.wrapping_add(shifted(z, shift));
                    (*sin, *cos) = circle::sin_cos(*to);
                }
            }
            let [x, ..] = next;
            if outside(*x, *low, *span) {
                return None;
            }
        }
        Some(())
    }

    /// The next x and y of a pose.
    #[inline(never)]
    fn place(&self, pose: Pose, from: &Bank, to: &mut Bank, outputs: &[i32]) -> Option<()> {
        let output = |index: u8| outputs.get(usize::from(index)).copied().map(i64::from);
        let (ahead, left) = (output(pose.ahead)?, output(pose.left)?);
        let from = coordinates(from);
        let [_, sin, cos] = *from.get(usize::from(pose.heading))?;
        let (sin, cos) = (i64::from(sin), i64::from(cos));
        // Below 2⁶² both: the outputs are below 2³⁰.
        let x = cos.wrapping_mul(ahead).wrapping_sub(sin.wrapping_mul(left));
        let y = sin.wrapping_mul(ahead).wrapping_add(cos.wrapping_mul(left));
        let to = coordinates_mut(to);
        for (index, change) in [(pose.x, x), (pose.y, y)] {
            let index = usize::from(index);
            let [head, ..] = self.coordinates.get(index)?;
            let down = 31_i32.wrapping_sub(shift_of(*head)) as u32;
            let change = change.wrapping_shr(down.wrapping_sub(1)).wrapping_add(1) >> 1;
            let [x, ..] = *from.get(index)?;
            let [next, ..] = to.get_mut(index)?;
            *next = i32::try_from(change.wrapping_add(i64::from(x))).ok()?;
        }
        Some(())
    }

    /// The first observable outside its range.
    #[cold]
    #[inline(never)]
    fn first_outside(&self, bank: &Bank) -> Option<usize> {
        let mut factors = self.factors.iter();
        let found = factors.find(|[head, low, span]| outside(register(bank, head & 0xFF), *low, *span));
        found.map(|[head, ..]| (head >> 16 & 0xFF) as usize)
    }

    /// The present coordinates in `out`, shape `[states]`, each in its [scale](Self::coordinate_scale):
    /// measured or predicted, whichever came last; 0 if nothing was observed.
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`].
    pub fn coordinates(&self, state: &FixedState, out: &mut [i32]) -> Result<(), PredictError> {
        expect("coordinates", self.coordinates.len(), out.len())?;
        let [a, b] = &state.banks;
        let registers = coordinates(if state.present { b } else { a });
        for ((to, [x, sin, cos]), [head, ..]) in out.iter_mut().zip(registers).zip(self.coordinates)
        {
            *to = match Kind::of(*head) {
                Some(Kind::Circle) => circle::angle(*sin, *cos),
                _ => *x,
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
        let (coordinates, rest) = rest.split_at_checked(n.wrapping_mul(5)).ok_or(length)?;
        let (inputs, rest) = rest.split_at_checked(m.wrapping_mul(2)).ok_or(length)?;
        let (factors, rest) = rest.split_at_checked(f.wrapping_mul(3)).ok_or(length)?;
        let (blocks, coefficients) = rest.split_at_checked(b).ok_or(length)?;
        let mut model = Self {
            robot,
            tag,
            outputs: 0,
            pose: None,
            coordinates: bytemuck::try_cast_slice(coordinates).map_err(|_| length)?,
            inputs: bytemuck::try_cast_slice(inputs).map_err(|_| length)?,
            factors: bytemuck::try_cast_slice(factors).map_err(|_| length)?,
            blocks: Vec::new(),
            coefficients: bytemuck::try_cast_slice(coefficients).map_err(|_| length)?,
        };
        let kinds = || model.coordinates.iter().map(|[head, ..]| Kind::of(*head));
        let mut outputs = 0_usize;
        for kind in kinds() {
            outputs = outputs.wrapping_add(kind.ok_or(section("kind of a coordinate"))?.outputs());
        }
        model.outputs = outputs as u8;

        // Blocks and factors.
        let mut rest = model.factors;
        let mut used = 0_usize;
        for count in blocks {
            let count = usize::try_from(*count).unwrap_or(usize::MAX);
            if count > MAX_BLOCK_FACTORS {
                return Err(too_large("factors of a block", MAX_BLOCK_FACTORS, count));
            }
            let (own, others) = rest.split_at_checked(count).ok_or(section("blocks"))?;
            rest = others;
            for [head, ..] in own {
                let [register, radix, _, zero] = head.to_le_bytes();
                let radix_fits = (2..=MAX_ORDER.saturating_add(1)).contains(&radix);
                let register = usize::from(register);
                let fits = match register.checked_sub(COORDINATES) {
                    None => register < m,
                    Some(of) => {
                        let kind = kinds().nth(of / 3).flatten();
                        match of % 3 {
                            0 => matches!(kind, Some(Kind::Next | Kind::Change)),
                            _ => matches!(kind, Some(Kind::Circle | Kind::Heading)),
                        }
                    }
                };
                if !(fits && radix_fits && zero == 0) {
                    return Err(section("factor"));
                }
            }
            let radices = own.iter().map(radix);
            let tile = Tile::of(radices.clone());
            let product = |size: usize, radix| size.saturating_mul(radix);
            let tiles = radices.clone().rev().skip(tile.axes()).fold(1, product);
            if tiles > MAX_TILES {
                return Err(too_large("tiles of a block", MAX_TILES, tiles));
            }
            let size = radices.fold(1, product).saturating_mul(outputs);
            used = used.saturating_add(size);
            let plan = Plan {
                factors: count as u8,
                tile,
                tiles: tiles as u8,
                coefficients: u32::try_from(size).map_err(|_| length)?,
            };
            model.blocks.push(plan).map_err(|_| section("blocks"))?;
        }
        if !rest.is_empty() {
            return Err(section("blocks"));
        }
        if used != model.coefficients.len() {
            return Err(length);
        }
        let bounds = model.bounds()?;
        model.check_coordinates(*pose, &bounds)?;
        Ok(model)
    }

    /// The largest magnitude that every output can have.
    fn bounds(&self) -> Result<[u32; MAX_OUTPUTS], LoadError> {
        let mut bounds = [0_u32; MAX_OUTPUTS];
        let (mut factors, mut coefficients) = (self.factors, self.coefficients);
        for plan in &self.blocks {
            let (own, rest) = factors.split_at_checked(plan.factors.into()).unwrap_or_default();
            let (c, more) =
                coefficients.split_at_checked(plan.coefficients as usize).unwrap_or_default();
            (factors, coefficients) = (rest, more);
            let size = c.len().checked_div(self.outputs()).unwrap_or(0).max(1);
            for ((output, bound), c) in bounds.iter_mut().enumerate().zip(c.chunks_exact(size)) {
                let more = kernel::bound(own.iter().map(radix), c);
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
        for (index, [head, low, span, centre, full]) in (0_u8..).zip(self.coordinates) {
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
                    (-31..=31).contains(&shift)
                        && i32::try_from(shifted(low.max(-bound))).is_ok()
                        && i32::try_from(shifted(high.min(bound))).is_ok()
                }
                Kind::Change | Kind::Turn | Kind::Heading => (-31..=31).contains(&shift),
                Kind::Pose => (-30..=30).contains(&shift) && bound < 1 << 30,
            };
            if !shift_fits || *head >> 16 != 0 {
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
                if head(heading).and_then(Kind::of) == Some(Kind::Heading) && head(x) == head(y) =>
            {
                Some(Pose { x, y, heading, ahead, left })
            }
            _ => return Err(section("pose")),
        };
        let fits = |[centre, full]: &[u32; 2]| {
            let (centre, full) = (f32::from_bits(*centre), f32::from_bits(*full));
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

impl Plan {
    #[inline(always)]
    fn contract(
        self,
        factors: &[[i32; 3]],
        values: &[i32],
        coefficients: &[i32],
        outputs: &mut [i32],
        room: &mut [i32; MAX_TILES],
    ) {
        let radices = factors.iter().map(radix);
        let v = values.get(..factors.len()).unwrap_or_default();
        kernel::contract(self.tile, self.tiles.into(), radices, v, coefficients, outputs, room);
    }
}

/// Radix of a factor.
#[inline(always)]
fn radix([head, ..]: &[i32; 3]) -> usize {
    (head >> 8 & 0xFF) as usize
}

/// The observables of a block in order; whether one is outside its range.
#[inline(always)]
fn gather(bank: &Bank, factors: &[[i32; 3]], values: &mut [i32]) -> bool {
    let mut out = false;
    for (to, [head, low, span]) in values.iter_mut().zip(factors) {
        let x = register(bank, *head);
        out |= outside(x, *low, *span);
        *to = x;
    }
    out
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
    let (blob, checksum) = blob::checked(slot)?;
    let sections = Sections::of(blob, &KNOWN)?;
    let (robot, _) = postcard::take_from_bytes(sections.bytes(METADATA)?)
        .map_err(|_| LoadError::Blob(ParseError::Metadata))?;
    let model = FixedModel::check(robot, checksum | 1, sections.cast(Q31)?)?;
    let test: &[i32] = sections.cast(Q31_SELF_TEST)?;
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
