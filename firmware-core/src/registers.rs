//! The register file of a predictor: every number that a step reads or writes, and where it lies.
//!
//! A register has a byte as its index, and there are 256 of them, so that no access needs a check.
//!
//! | registers | what they hold |
//! |---|---|
//! | 0 | the constant 1 |
//! | 1 | what is written and never read |
//! | 2 … | the inputs of the step to be predicted, in order |
//! | then | what the history keeps of the present sample only |
//! | then | *delay lines*: a coordinate, sine, cosine, increment or input at consecutive samples, the newest first; padded to a multiple of [`GROUP`] |
//! | then | what a step computes: standardised observables, functions and terms ([`kernel`](crate::kernel)) |
//!
//! All delay lines move on by one sample when all their registers are moved up by one: the last of a
//! line falls onto the head of the next line, which is then written anew.
//!
//! The head of the line of a coordinate, its sine and its cosine is the present sample; of an
//! increment the one that led to the present sample (lag 1); of an input the one that acted before
//! (lag 1).

use core::cell::Cell;

use heapless::Vec;

use crate::Scalar;
use crate::capacity::{MAX_INPUTS, MAX_LAG, MAX_OBSERVABLES, MAX_STATES, REGISTERS};
use crate::dictionary::{Observable, Source};
use crate::model::{Space, State, Symmetry, Target};

/// Register of the constant 1.
pub(crate) const ONE: u8 = 0;
/// Register that is written and never read.
pub(crate) const NOWHERE: u8 = 1;
/// Register of the first input.
pub(crate) const INPUTS: u8 = 2;
/// Registers of the delay lines that are moved at once: what a Cortex-M loads and stores with one
/// instruction each.
pub(crate) const GROUP: usize = 4;

/// The registers.
#[derive(Clone, Debug)]
pub(crate) struct Registers<S>([S; REGISTERS]);

impl<S: Scalar> Registers<S> {
    pub(crate) fn new() -> Self {
        let mut registers = Self([S::ZERO; REGISTERS]);
        registers.set(ONE, S::ONE);
        registers
    }

    #[inline(always)]
    pub(crate) fn get(&self, register: u8) -> S {
        // Never out of bounds: there are as many registers as bytes.
        self.0.get(usize::from(register)).copied().unwrap_or_default()
    }

    #[inline(always)]
    pub(crate) fn set(&mut self, register: u8, value: S) {
        if let Some(to) = self.0.get_mut(usize::from(register)) {
            *to = value;
        }
    }

    /// `count` registers from `first` on, as far as there are.
    #[inline(always)]
    pub(crate) fn from(&self, first: u8, count: usize) -> &[S] {
        self.0.get(usize::from(first)..).and_then(|rest| rest.get(..count)).unwrap_or(&[])
    }

    /// The same, to be written.
    #[inline(always)]
    pub(crate) fn from_mut(&mut self, first: u8, count: usize) -> &mut [S] {
        let rest = self.0.get_mut(usize::from(first)..).unwrap_or_default();
        rest.get_mut(..count).unwrap_or_default()
    }

    /// The registers, to be read and written in one loop.
    #[inline(always)]
    pub(crate) fn cells(&mut self) -> Cells<'_, S> {
        Cells(Cell::from_mut(&mut self.0).as_array_of_cells())
    }

    /// Moves the delay lines on by one sample.
    #[inline(always)]
    pub(crate) fn shift(&mut self, layout: &Layout) {
        let lines = self.0.get_mut(usize::from(layout.lines)..).unwrap_or_default();
        let (groups, _) = lines.as_chunks_mut::<GROUP>();
        // The head of the first line is written anew, whatever comes in.
        let mut carry = S::ZERO;
        for group in groups.iter_mut().take(layout.groups.into()) {
            let [a, b, c, d] = *group;
            *group = [carry, a, b, c];
            carry = d;
        }
    }
}

/// All registers, each to be read and written.
#[derive(Clone, Copy)]
pub(crate) struct Cells<'r, S>(&'r [Cell<S>; REGISTERS]);

impl<'r, S: Scalar> Cells<'r, S> {
    #[inline(always)]
    pub(crate) fn get(self, register: u8) -> S {
        self.0.get(usize::from(register)).map_or(S::ZERO, Cell::get)
    }

    /// `count` registers from `first` on, as far as there are.
    #[inline(always)]
    pub(crate) fn from(self, first: u8, count: usize) -> &'r [Cell<S>] {
        self.0.get(usize::from(first)..).and_then(|rest| rest.get(..count)).unwrap_or(&[])
    }
}

/// What the operator's outputs for a coordinate become.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) enum Kind {
    /// On ℝ, the next value.
    #[default]
    Line,
    /// On ℝ, its change.
    Increment,
    /// On ℝ, its change, rotated with the pose.
    Pose,
    /// On S¹, sine and cosine, whose limits no angle leaves.
    Angle,
    /// The same with limits.
    LimitedAngle,
    /// On S¹, its change.
    AngleIncrement,
    /// The same, with sine and cosine needed.
    AngleIncrementTrigonometric,
}

/// Where a coordinate is kept, and its limits.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Place {
    pub(crate) kind: Kind,
    /// The coordinate; [`NOWHERE`] for an absolute angle.
    pub(crate) x: u8,
    /// Sine and cosine; [`NOWHERE`] where they are not needed.
    pub(crate) sin: u8,
    pub(crate) cos: u8,
    /// The increment that led to the present sample; [`NOWHERE`] if it is not observed.
    pub(crate) increment: u8,
    /// Limits of the coordinate, finite: what is within them is finite.
    pub(crate) limit: [f32; 2],
}

/// Where the pose of an se(2)-symmetric model is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    /// Coordinates.
    pub(crate) x: u8,
    pub(crate) y: u8,
    /// Outputs.
    pub(crate) ahead: u8,
    pub(crate) left: u8,
    /// Registers of the heading's sine and cosine.
    pub(crate) sin: u8,
    pub(crate) cos: u8,
}

/// Where everything lies that a history keeps.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layout {
    /// Register of the raw value of every observable.
    pub(crate) observables: Vec<u8, MAX_OBSERVABLES>,
    pub(crate) states: Vec<Place, MAX_STATES>,
    pub(crate) pose: Option<Pose>,
    /// Head of the line of every input; [`NOWHERE`] if no earlier one is observed.
    pub(crate) inputs: Vec<u8, MAX_INPUTS>,
    /// Increments are observed.
    pub(crate) increments: bool,
    /// The first register of the delay lines, and how many groups they are.
    pub(crate) lines: u8,
    pub(crate) groups: u8,
    /// The first register behind the history.
    pub(crate) end: u8,
    /// Differs between layouts that keep different things, or keep them elsewhere.
    pub(crate) id: u32,
}

/// Registers that a history needs at most.
const HISTORY: usize = INPUTS as usize
    + MAX_INPUTS
    + MAX_STATES * (1 + 2 * (MAX_LAG + 1) + MAX_LAG)
    + MAX_INPUTS * MAX_LAG
    + GROUP;
const _: () = assert!(HISTORY < REGISTERS, "no index of a register that keeps something overflows");

impl Layout {
    /// Of a checked structure; `trigonometric` has a bit per coordinate whose sine and cosine are
    /// needed.
    pub(crate) fn new(
        states: &[State<'_>],
        inputs: usize,
        symmetry: Symmetry,
        observables: &[Observable],
        trigonometric: impl Fn(usize) -> bool,
    ) -> Self {
        // Registers of a source: as far back as it is observed.
        let length = |source: Source, present: bool| {
            let lags = observables.iter().filter(|o| o.source == source).map(|o| o.lag);
            match (lags.max(), source) {
                (Some(lag), Source::Increment(_) | Source::Input(_)) => lag,
                (Some(lag), _) => lag.saturating_add(1),
                (None, _) => u8::from(present),
            }
        };
        let mut layout = Self {
            observables: Vec::new(),
            states: states.iter().take(MAX_STATES).map(place).collect(),
            pose: None,
            inputs: (0..inputs.min(MAX_INPUTS)).map(|_| NOWHERE).collect(),
            increments: false,
            lines: 0,
            groups: 0,
            end: 0,
            id: 0,
        };
        let mut next = INPUTS.saturating_add(layout.inputs.len() as u8);
        for lines in [false, true] {
            if lines {
                layout.lines = next;
            }
            let mut put = |to: &mut u8, source, present| {
                let length = length(source, present);
                if length > 0 && (length > 1) == lines {
                    *to = next;
                    next = next.saturating_add(length);
                }
            };
            for (i, place) in (0..).zip(&mut layout.states) {
                let angle = matches!(place.kind, Kind::Angle | Kind::LimitedAngle);
                let turns = trigonometric(i.into());
                put(&mut place.x, Source::State(i), !angle);
                put(&mut place.sin, Source::Sin(i), turns);
                put(&mut place.cos, Source::Cos(i), turns);
                put(&mut place.increment, Source::Increment(i), false);
                if turns && place.kind == Kind::AngleIncrement {
                    place.kind = Kind::AngleIncrementTrigonometric;
                }
            }
            for (i, head) in (0..).zip(&mut layout.inputs) {
                put(head, Source::Input(i), false);
            }
        }
        layout.groups = next.saturating_sub(layout.lines).div_ceil(GROUP as u8);
        layout.end = layout.lines.saturating_add(layout.groups.saturating_mul(GROUP as u8));

        if let Symmetry::Se2 { x, y, heading } = symmetry {
            // An absolute angle has two outputs.
            let output = |coordinate: u8| {
                layout.states.iter().take(coordinate.into()).fold(0_u8, |sum, s| {
                    let angle = matches!(s.kind, Kind::Angle | Kind::LimitedAngle);
                    sum.saturating_add(1).saturating_add(angle.into())
                })
            };
            let (ahead, left) = (output(x), output(y));
            let heading = layout.place(heading);
            layout.pose =
                Some(Pose { x, y, ahead, left, sin: heading.sin, cos: heading.cos });
            for coordinate in [x, y] {
                if let Some(place) = layout.states.get_mut(usize::from(coordinate)) {
                    place.kind = Kind::Pose;
                }
            }
        }
        layout.increments = layout.states.iter().any(|s| s.increment != NOWHERE);
        let registers = observables.iter().map(|o| match o.source {
            Source::State(i) => layout.place(i).x.saturating_add(o.lag),
            Source::Sin(i) => layout.place(i).sin.saturating_add(o.lag),
            Source::Cos(i) => layout.place(i).cos.saturating_add(o.lag),
            Source::Increment(i) => {
                layout.place(i).increment.saturating_add(o.lag).saturating_sub(1)
            }
            Source::Input(i) if o.lag == 0 => INPUTS.saturating_add(i),
            Source::Input(i) => {
                let head = layout.inputs.get(usize::from(i)).copied().unwrap_or(NOWHERE);
                head.saturating_add(o.lag).saturating_sub(1)
            }
        });
        layout.observables = registers.collect();
        let places = layout.states.iter().flat_map(|s| [s.x, s.sin, s.cos, s.increment]);
        let bytes = places.chain(layout.inputs.iter().copied()).chain([layout.lines, layout.groups]);
        // FNV-1a.
        layout.id = bytes.fold(0x811C_9DC5, |id: u32, byte| {
            (id ^ u32::from(byte)).wrapping_mul(0x0100_0193)
        });
        layout
    }

    /// The place of a coordinate that a checked structure has.
    #[inline]
    pub(crate) fn place(&self, coordinate: u8) -> Place {
        self.states.get(usize::from(coordinate)).copied().unwrap_or_default()
    }

    /// The registers that a history keeps: the first, and how many.
    #[inline]
    pub(crate) fn kept(&self) -> (u8, u8) {
        let first = INPUTS.saturating_add(self.inputs.len() as u8);
        (first, self.end.saturating_sub(first))
    }
}

/// A coordinate that is kept nowhere yet.
fn place(state: &State<'_>) -> Place {
    let [low, high] = state.limit;
    let limited = low > -core::f32::consts::PI || high < core::f32::consts::PI;
    let kind = match (state.target, state.space) {
        (Target::Absolute, Space::Line) => Kind::Line,
        (Target::Increment, Space::Line) => Kind::Increment,
        (Target::Absolute, Space::Circle) if limited => Kind::LimitedAngle,
        (Target::Absolute, Space::Circle) => Kind::Angle,
        (Target::Increment, Space::Circle) => Kind::AngleIncrement,
    };
    Place {
        kind,
        x: NOWHERE,
        sin: NOWHERE,
        cos: NOWHERE,
        increment: NOWHERE,
        limit: [low.max(f32::MIN), high.min(f32::MAX)],
    }
}
