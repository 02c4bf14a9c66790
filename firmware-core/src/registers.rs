//! The register file of a predictor: every number that a step reads or writes, and where it lies.
//!
//! A register has a byte as its index, and there are 256 of them, so that no access needs a check.
//!
//! | registers | what they hold |
//! |---|---|
//! | 0 | the constant 1 |
//! | 1 | nothing |
//! | 2 … | the inputs of the step to be predicted, in order, and the present sample |
//! | then | *delay lines*: what is observed of earlier samples, each source at consecutive samples, the newest first; padded to a multiple of four |
//! | then | what a step computes: standardised observables, functions and terms ([`kernel`](crate::kernel)) |
//!
//! Where there are delay lines, the inputs come first, and then the present sample with four registers per
//! coordinate: itself, its change since the sample before, sine, cosine. Where there are none, what is
//! observed comes first, in the order of the observables, so that a kernel loads it at once.
//!
//! All delay lines move on by one sample when all their registers are moved up by one: the last of a
//! line falls onto the head of the next line, which is then written anew, from the present sample or
//! the inputs.

use core::cell::Cell;

use heapless::Vec;

use crate::Scalar;
use crate::capacity::{MAX_INPUTS, MAX_KEPT, MAX_LAG, MAX_OBSERVABLES, MAX_STATES, REGISTERS};
use crate::dictionary::{Observable, Source};
use crate::model::{Space, State, Symmetry, Target};

/// Register of the constant 1.
pub(crate) const ONE: u8 = 0;
/// Register that nothing uses.
pub(crate) const NOWHERE: u8 = 1;
/// The first register of inputs and present sample.
pub(crate) const FIRST: u8 = 2;
/// Registers of a coordinate in the present sample, and registers of the delay lines that are moved at
/// once: what a Cortex-M loads and stores with one instruction each.
pub(crate) const GROUP: usize = 4;
/// Where they are among the four of a coordinate.
const CHANGE: u8 = 1;
const SIN: u8 = 2;
const COS: u8 = 3;

/// The registers from [`FIRST`] on.
pub(crate) type FromFirst<S> = [S; REGISTERS - FIRST as usize];

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
    pub(crate) fn slice(&self, first: u8, count: usize) -> &[S] {
        self.0.get(usize::from(first)..).and_then(|rest| rest.get(..count)).unwrap_or(&[])
    }

    /// The same, to be written.
    #[inline(always)]
    pub(crate) fn slice_mut(&mut self, first: u8, count: usize) -> &mut [S] {
        let rest = self.0.get_mut(usize::from(first)..).unwrap_or_default();
        rest.get_mut(..count).unwrap_or_default()
    }

    /// All that a step uses.
    #[inline(always)]
    pub(crate) fn all_mut(&mut self) -> &mut FromFirst<S> {
        let [_, _, rest @ ..] = &mut self.0;
        rest
    }

    /// The same, four at a time.
    #[inline(always)]
    pub(crate) fn groups(&self) -> &[[S; GROUP]] {
        let [_, _, rest @ ..] = &self.0;
        rest.as_chunks().0
    }

    /// The same, to be written.
    #[inline(always)]
    pub(crate) fn groups_mut(&mut self) -> &mut [[S; GROUP]] {
        self.all_mut().as_chunks_mut().0
    }

    /// The registers before one, and from it on.
    #[inline(always)]
    pub(crate) fn split_at_mut(&mut self, register: u8) -> (&mut [S], &mut [S]) {
        self.0.split_at_mut_checked(usize::from(register)).unwrap_or_default()
    }

    /// The registers, to be read and written in one loop.
    #[inline(always)]
    pub(crate) fn cells(&mut self) -> &[Cell<S>; REGISTERS] {
        Cell::from_mut(&mut self.0).as_array_of_cells()
    }

    /// Moves on by one sample: delay lines, and then the present sample.
    #[inline(always)]
    pub(crate) fn advance(&mut self, layout: &Layout, next: &[[S; GROUP]; MAX_STATES]) {
        let lines = self.0.get_mut(usize::from(layout.lines)..).unwrap_or_default();
        let (groups, _) = lines.as_chunks_mut::<GROUP>();
        // The head of the first line is written anew, whatever comes in.
        let mut carry = S::ZERO;
        for group in groups.iter_mut().take(layout.groups.into()) {
            let [a, b, c, d] = *group;
            *group = [carry, a, b, c];
            carry = d;
        }
        for [head, from] in &layout.heads {
            self.set(*head, self.get(*from));
        }
        if !layout.grouped {
            for (place, [x, change, sin, cos]) in layout.states.iter().zip(next) {
                self.set(place.x, *x);
                self.set(place.change, *change);
                self.set(place.sin, *sin);
                self.set(place.cos, *cos);
            }
            return;
        }
        let present = layout.states.first().map_or(NOWHERE, |place| place.x);
        let present = self.0.get_mut(usize::from(present)..).unwrap_or_default();
        let (present, _) = present.as_chunks_mut::<GROUP>();
        for ((to, from), _) in present.iter_mut().zip(next).zip(&layout.states) {
            *to = *from;
        }
    }
}

/// What the operator's outputs for a coordinate become.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Kind {
    /// On ℝ, the next value.
    #[default]
    Line,
    /// On ℝ, its change.
    Increment,
    /// On ℝ, its change, rotated with the pose.
    Pose,
    /// On S¹, its change.
    AngleIncrement,
    /// The same, with sine and cosine needed.
    AngleIncrementTrigonometric,
    /// On S¹, sine and cosine, from which nothing else is needed.
    Circle,
    /// The same, with limits or an observed change, which take the angle.
    Angle,
}

impl Kind {
    /// Whether the outputs are sine and cosine.
    #[inline]
    pub(crate) fn absolute_angle(self) -> bool {
        matches!(self, Self::Circle | Self::Angle)
    }
}

/// What becomes of a coordinate's outputs, its limits, and its registers in the present sample:
/// [`NOWHERE`] for what nobody reads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Place {
    pub(crate) kind: Kind,
    pub(crate) x: u8,
    pub(crate) change: u8,
    pub(crate) sin: u8,
    pub(crate) cos: u8,
    /// Limits of the coordinate, finite: what is within them is finite.
    pub(crate) limit: [f32; 2],
}

impl Place {
    /// Of coordinate `i`: whether its changes are observed, and its sine and cosine needed.
    #[inline(always)]
    fn of(
        i: u8,
        state: &State<'_>,
        symmetry: Symmetry,
        changes: bool,
        trigonometric: bool,
    ) -> Self {
        let [low, high] = state.limit;
        let limited = low > -core::f32::consts::PI || high < core::f32::consts::PI;
        let kind = match (state.target, state.space) {
            (Target::Absolute, Space::Line) => Kind::Line,
            (Target::Increment, Space::Line) => match symmetry {
                Symmetry::Se2 { x, y, .. } if x == i || y == i => Kind::Pose,
                _ => Kind::Increment,
            },
            (Target::Absolute, Space::Circle) if limited || changes => Kind::Angle,
            (Target::Absolute, Space::Circle) => Kind::Circle,
            (Target::Increment, Space::Circle) if trigonometric => {
                Kind::AngleIncrementTrigonometric
            }
            (Target::Increment, Space::Circle) => Kind::AngleIncrement,
        };
        // Limits are no NaN.
        let low = if low > f32::MIN { low } else { f32::MIN };
        let high = if high < f32::MAX { high } else { f32::MAX };
        let limit = [low, high];
        Self { kind, limit, x: NOWHERE, change: NOWHERE, sin: NOWHERE, cos: NOWHERE }
    }
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

/// Sources that may have a delay line.
const LINES: usize = 4 * MAX_STATES + MAX_INPUTS;

/// Where everything lies that a history keeps.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layout {
    /// Register of the raw value of every observable.
    pub(crate) observables: Vec<u8, MAX_OBSERVABLES>,
    pub(crate) states: Vec<Place, MAX_STATES>,
    pub(crate) pose: Option<Pose>,
    /// The first register of every delay line, and where its next value comes from.
    pub(crate) heads: Vec<[u8; 2], LINES>,
    /// Changes of coordinates are observed.
    pub(crate) increments: bool,
    inputs: u8,
    /// Register of the first input.
    pub(crate) first_input: u8,
    /// The present sample has four consecutive registers per coordinate.
    grouped: bool,
    /// The first register of the delay lines, and how many groups they are.
    pub(crate) lines: u8,
    pub(crate) groups: u8,
    /// The first register behind the history.
    pub(crate) end: u8,
    /// Differs between layouts that keep different things, or keep them elsewhere; 0 is that of nothing.
    pub(crate) id: u32,
}

/// Registers that a history keeps at most: of an angle its sine, cosine and changes are delayed.
const fn most_kept(states: usize, inputs: usize) -> usize {
    states * (GROUP + 2 * MAX_LAG + MAX_LAG - 1) + inputs * MAX_LAG + GROUP
}
const _: () = assert!(
    FIRST as usize + MAX_INPUTS + most_kept(MAX_STATES, MAX_INPUTS) < REGISTERS,
    "no index of a register that keeps something overflows"
);
const _: () =
    assert!(2 + most_kept(3, 2) <= MAX_KEPT, "the loops take every model of their robots");

impl Layout {
    /// Of nothing.
    pub(crate) const fn empty() -> Self {
        Self {
            observables: Vec::new(),
            states: Vec::new(),
            pose: None,
            heads: Vec::new(),
            increments: false,
            inputs: 0,
            first_input: FIRST,
            grouped: false,
            lines: FIRST,
            groups: 0,
            end: FIRST,
            id: 0,
        }
    }

    pub(crate) fn clear(&mut self) {
        self.observables.clear();
        self.states.clear();
        self.heads.clear();
        (self.pose, self.increments, self.inputs) = (None, false, 0);
        (self.first_input, self.grouped) = (FIRST, false);
        (self.lines, self.groups, self.end) = (FIRST, 0, FIRST);
        self.id = 0;
    }

    /// Becomes that of a checked structure; bit i of `trigonometric`: the sine and cosine of coordinate i
    /// are needed. It is made where it lies, part by part: it would be a quarter of a kilobyte of stack.
    #[inline(always)]
    pub(crate) fn fill(
        &mut self,
        states: &[State<'_>],
        inputs: usize,
        symmetry: Symmetry,
        observables: &[Observable],
        trigonometric: u8,
    ) {
        self.inputs = inputs as u8;
        self.increments = observables.iter().any(|o| matches!(o.source, Source::Increment(_)));
        self.place_states(states, symmetry, observables, trigonometric);
        let next = self.place_present(observables, trigonometric);
        self.place_lines(observables, next);
        self.pose = self.place_pose(symmetry);
        self.identify(trigonometric);
    }

    /// FNV-1a of what two layouts that keep the same have in common.
    #[inline(never)]
    fn identify(&mut self, trigonometric: u8) {
        let mut id = 0x811C_9DC5;
        let mut hash = |bytes: &[u8]| {
            for byte in bytes {
                id = (id ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
            }
        };
        hash(self.heads.as_flattened());
        let kinds = [self.increments.into(), self.pose.is_some().into(), trigonometric];
        hash(&[self.first_input, self.lines, self.groups]);
        hash(&kinds);
        for place in &self.states {
            hash(&[place.x, place.change, place.sin, place.cos]);
        }
        self.id = id.max(1);
    }

    /// What becomes of the coordinates.
    #[inline(never)]
    fn place_states(
        &mut self,
        states: &[State<'_>],
        symmetry: Symmetry,
        observables: &[Observable],
        trigonometric: u8,
    ) {
        self.states.clear();
        for (i, state) in (0_u8..).zip(states) {
            let changes = observables.iter().any(|o| o.source == Source::Increment(i));
            let place = Place::of(i, state, symmetry, changes, (trigonometric >> i) & 1 != 0);
            let _ = self.states.push(place);
        }
    }

    /// Where the inputs are, and the present sample; the first register behind them.
    #[inline(never)]
    fn place_present(&mut self, observables: &[Observable], trigonometric: u8) -> u8 {
        let mut next = FIRST;
        let mut take = |count: u8| {
            let first = next;
            next = next.saturating_add(count);
            first
        };
        let latest = |source: Source| u8::from(matches!(source, Source::Increment(_)));
        self.grouped = observables.iter().any(|o| o.lag > latest(o.source));
        self.first_input = NOWHERE;
        if self.grouped {
            self.first_input = take(self.inputs);
            for place in &mut self.states {
                let first = take(GROUP as u8);
                let at = |offset| first.saturating_add(offset);
                (place.x, place.change, place.sin, place.cos) =
                    (first, at(CHANGE), at(SIN), at(COS));
            }
            return next;
        }
        for o in observables {
            let i = match o.source {
                Source::Input(_) => {
                    if self.first_input == NOWHERE {
                        self.first_input = take(self.inputs);
                    }
                    continue;
                }
                Source::State(i) | Source::Sin(i) | Source::Cos(i) | Source::Increment(i) => i,
            };
            let Some(place) = self.states.get_mut(usize::from(i)) else { continue };
            let register = match o.source {
                Source::Sin(_) => &mut place.sin,
                Source::Cos(_) => &mut place.cos,
                Source::Increment(_) => &mut place.change,
                _ => &mut place.x,
            };
            *register = take(1);
        }
        if self.first_input == NOWHERE {
            self.first_input = take(self.inputs);
        }
        for (i, place) in self.states.iter_mut().enumerate() {
            if !place.kind.absolute_angle() && place.x == NOWHERE {
                place.x = take(1);
            }
            let needed = (trigonometric >> i) & 1 != 0;
            for register in [&mut place.sin, &mut place.cos] {
                if needed && *register == NOWHERE {
                    *register = take(1);
                }
            }
        }
        next
    }

    /// The register of a source at its latest sample, and the lag of that sample.
    fn latest(&self, source: Source) -> (u8, u8) {
        let i = match source {
            Source::Input(i) => return (self.first_input.saturating_add(i), 0),
            Source::State(i) | Source::Sin(i) | Source::Cos(i) | Source::Increment(i) => i,
        };
        // A checked source is there.
        let Some(place) = self.states.get(usize::from(i)) else { return (NOWHERE, 0) };
        match source {
            Source::Sin(_) => (place.sin, 0),
            Source::Cos(_) => (place.cos, 0),
            Source::Increment(_) => (place.change, 1),
            _ => (place.x, 0),
        }
    }

    /// The delay lines, and the register of every observable.
    #[inline(never)]
    fn place_lines(&mut self, observables: &[Observable], first: u8) {
        self.lines = first;
        let mut next = first;
        self.heads.clear();
        self.observables.clear();
        for o in observables {
            let (from, lag) = self.latest(o.source);
            if o.lag <= lag {
                let _ = self.observables.push(from);
                continue;
            }
            // The first register of the line of its source.
            let head = match self.heads.iter().find(|[_, source]| *source == from) {
                Some([head, _]) => *head,
                None => {
                    let own = observables.iter().filter(|other| other.source == o.source);
                    let oldest = own.fold(lag, |oldest, o| oldest.max(o.lag));
                    let _ = self.heads.push([next, from]);
                    let head = next;
                    next = next.saturating_add(oldest.saturating_sub(lag));
                    head
                }
            };
            let register = head.saturating_add(o.lag.saturating_sub(lag)).saturating_sub(1);
            let _ = self.observables.push(register);
        }
        self.groups = next.saturating_sub(self.lines).div_ceil(GROUP as u8);
        self.end = self.lines.saturating_add(self.groups.saturating_mul(GROUP as u8));
    }

    /// Where the pose is, if the symmetry has one.
    #[inline(never)]
    fn place_pose(&self, symmetry: Symmetry) -> Option<Pose> {
        let Symmetry::Se2 { x, y, heading } = symmetry else { return None };
        // An absolute angle has two outputs.
        let output = |coordinate: u8| {
            self.states.iter().take(coordinate.into()).fold(0_u8, |sum, place| {
                sum.saturating_add(1).saturating_add(place.kind.absolute_angle().into())
            })
        };
        let Place { sin, cos, .. } = *self.states.get(usize::from(heading))?;
        Some(Pose { x, y, ahead: output(x), left: output(y), sin, cos })
    }

    /// Inputs of the model.
    #[inline]
    pub(crate) fn inputs(&self) -> usize {
        self.inputs.into()
    }

    /// The registers that a history keeps: those before the inputs and those behind them, each the first
    /// and how many.
    #[inline]
    pub(crate) fn kept(&self) -> [(u8, u8); 2] {
        let behind = self.first_input.saturating_add(self.inputs);
        [(FIRST, self.first_input.saturating_sub(FIRST)), (behind, self.end.saturating_sub(behind))]
    }
}
