//! Models that take no look at each of their parts: dense ones of a single block, whose observables, all of the
//! present sample, lie in the registers as the block takes them.
//!
//! What is found here is what the general step finds, to the bit. Whatever is in any way unusual (not finite,
//! out of range, diverged) is left to that one, which says what it is.

use super::dense::{Run, fold};
use crate::Scalar;
use crate::capacity::{MAX_BLOCK_FACTORS, REGISTERS};
use crate::dictionary::{Factor, Observable, Source};
use crate::history::LONG;
use crate::model::Structure;
use crate::registers::{FIRST, Kind, Layout, NOWHERE, Registers};

/// Whether the only block of a dictionary takes the observables as they lie in the registers, one after the
/// other, and no changes have to be kept.
#[inline(never)]
fn is_direct(structure: &Structure<'_>) -> bool {
    let (layout, dictionary) = (structure.layout(), structure.dictionary());
    let (observables, factors) = (dictionary.observables(), dictionary.factors());
    (FIRST..).zip(&layout.observables).all(|(i, register)| i == *register)
        && (0..).zip(factors).all(|(i, factor)| factor.observable == i)
        && (dictionary.blocks().count(), observables.len()) == (1, factors.len())
        && !layout.increments
}

/// Polynomial axes in at most two runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Axes {
    /// The run of the last ones, and the one before it, which may be empty.
    last: Run,
    others: Run,
}

impl Axes {
    /// The last two runs of these factors.
    #[inline(never)]
    fn fill(&mut self, factors: &[Factor]) {
        self.last = Run::last(factors);
        let others = factors.len().saturating_sub(self.last.count());
        self.others = Run::last(factors.get(..others).unwrap_or(&[]));
    }

    /// Coefficients of an output.
    fn size(self) -> usize {
        self.last.size().max(1).wrapping_mul(self.others.size().max(1))
    }

    #[inline(always)]
    fn count(self) -> usize {
        self.last.count().wrapping_add(self.others.count())
    }

    /// Numbers between the two runs, for each output.
    #[inline(always)]
    fn between(self) -> usize {
        if self.others.count() == 0 { 0 } else { self.others.size() }
    }

    /// Folds `from`, shape `[outputs, all coefficients]`, into `to`, shape `[outputs]`; `scratch` has room for
    /// what is [between](Self::between) the runs.
    #[inline(always)]
    fn fold<S: Scalar>(self, from: &[S], v: &[S], scratch: &mut [S], to: &mut [S]) -> Option<()> {
        if self.others.count() == 0 {
            fold(self.last, from, to, v);
        } else {
            let (slow, fast) = v.split_at_checked(self.others.count())?;
            let left = scratch.get_mut(..self.others.size().wrapping_mul(to.len()))?;
            fold(self.last, from, left, fast);
            fold(self.others, left, to, slow);
        }
        Some(())
    }
}

/// Registers behind those of the scaled values of all factors, from register `first` on.
fn free(factors: &[Factor], first: u8) -> usize {
    REGISTERS.saturating_sub(usize::from(first)).saturating_sub(factors.len())
}

/// What becomes of the outputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    /// They are the next values: first those on ℝ, this many, and then angles without limits or observed
    /// changes. They lie in the registers in that order.
    Values(u8),
    /// They are the increments of a planar pose, and there are no other coordinates.
    Pose,
    /// Something else.
    Other,
}

impl Next {
    #[inline(never)]
    fn of(layout: &Layout) -> Self {
        let (mut lines, mut register, mut in_order) = (0_u8, FIRST, true);
        for place in &layout.states {
            let (first, count) = match place.kind {
                // No angle is in front of it.
                Kind::Line if register == FIRST.wrapping_add(lines) => (place.x, 1_u8),
                Kind::Circle if place.cos == place.sin.wrapping_add(1) => (place.sin, 2),
                _ => (NOWHERE, 0),
            };
            in_order &= first == register;
            register = register.wrapping_add(count);
            lines = lines.wrapping_add(count & 1);
        }
        match (layout.pose, layout.states.as_slice()) {
            _ if in_order => Self::Values(lines),
            (Some(pose), [_, _, heading])
                if (pose.x, pose.y) == (0, 1)
                    && heading.kind == Kind::AngleIncrementTrigonometric =>
            {
                Self::Pose
            }
            _ => Self::Other,
        }
    }
}

/// A model that a controller may have a kernel for, by its trained ranges and its coefficients, outputs slowest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Known<'a, S> {
    /// A differential drive as in the paper (Shi & Karydis 2021): two coordinates on ℝ, an angle and two
    /// inputs, all of order 1, which is 64 terms, and the next values as outputs.
    Drive(&'a [[S; 2]; 6], &'a [S; 256]),
    /// The same robot by what it does in its own frame: an se(2)-symmetric pose whose heading has no limits,
    /// and two inputs of order 3, which is 16 terms.
    Planar(&'a [[S; 2]; 2], &'a [S; 48]),
}

/// Which of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shape {
    Drive,
    Planar,
}

impl Shape {
    /// `None` if it is another one.
    #[inline(never)]
    pub(crate) fn of(structure: &Structure<'_>, direct: &Direct) -> Option<Self> {
        let of_runs = |last: u8, inputs: u8| {
            direct.all.last.shape == last
                && direct.all.others.count() == 0
                && direct.inputs.shape == inputs
        };
        let layout = structure.layout();
        match (direct.next, layout.states.as_slice()) {
            // A further input that nothing observes would lie behind the others.
            (Next::Values(2), [_, _, _]) if layout.inputs() == 2 => {
                of_runs(const { Run::shape(2, 6) }, const { Run::shape(2, 2) })
                    .then_some(Self::Drive)
            }
            (Next::Pose, [x, y, heading]) => {
                let run = const { Run::shape(4, 2) };
                let own = [x.x, y.x, heading.x, heading.sin, heading.cos];
                let [low, high] = heading.limit;
                let limited = low > -core::f32::consts::PI || high < core::f32::consts::PI;
                let follows = (FIRST..).skip(2).zip(own).all(|(i, register)| i == register);
                (of_runs(run, run) && follows && !limited).then_some(Self::Planar)
            }
            _ => None,
        }
    }
}

impl<'a, S: Scalar> Known<'a, S> {
    /// `None` if it is another one.
    #[inline(always)]
    pub(crate) fn new(
        structure: &Structure<'_>,
        direct: &Direct,
        ranges: &'a [[S; 2]],
        coefficients: &'a [S],
    ) -> Option<Self> {
        Some(match Shape::of(structure, direct)? {
            Shape::Drive => Self::Drive(ranges.try_into().ok()?, coefficients.try_into().ok()?),
            Shape::Planar => Self::Planar(ranges.try_into().ok()?, coefficients.try_into().ok()?),
        })
    }
}

/// Centre and gain of every observable, and behind them the limits of the first two coordinates.
pub type Constants = [[f32; 2]; MAX_BLOCK_FACTORS + 2];

/// What a step of such a model needs. Without axes it is that of another model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Direct {
    all: Axes,
    /// The last axes, if they are all inputs, a single run, and there is room for what folding them first
    /// leaves; and the others.
    inputs: Run,
    states: Axes,
    next: Next,
    outputs: u8,
    constants: Constants,
}

impl Direct {
    pub(crate) const fn empty() -> Self {
        let no_axes = Axes { last: Run::NONE, others: Run::NONE };
        Self {
            all: no_axes,
            inputs: Run::NONE,
            states: no_axes,
            next: Next::Other,
            outputs: 0,
            constants: [[0.0; 2]; MAX_BLOCK_FACTORS + 2],
        }
    }

    pub(crate) fn clear(&mut self) {
        (self.all, self.inputs, self.states) = (Axes::default(), Run::NONE, Axes::default());
        (self.next, self.outputs) = (Next::Other, 0);
        self.constants.fill([0.0; 2]);
    }

    /// Whether it is one at all.
    #[inline(always)]
    pub(crate) fn is_some(&self) -> bool {
        self.all.last.count() > 0
    }

    /// Becomes that of a dense model, whose first free register is `first`, if it is one; it has been cleared.
    // In parts, so that little is on the stack at once.
    #[inline(always)]
    pub(crate) fn fill(&mut self, structure: &Structure<'_>, first: u8) {
        if is_direct(structure) {
            self.fill_axes(structure, first);
        }
        if self.is_some() {
            self.fill_held(structure, first);
            self.fill_constants(structure);
            self.next = Next::of(structure.layout());
        }
    }

    #[inline(never)]
    fn fill_axes(&mut self, structure: &Structure<'_>, first: u8) {
        let factors = structure.dictionary().factors();
        let outputs = structure.outputs();
        self.outputs = outputs as u8;
        self.all.fill(factors);
        let between = self.all.between().wrapping_mul(outputs);
        if self.all.count() != factors.len() || between > free(factors, first) {
            self.all = Axes::default();
        }
    }

    #[inline(never)]
    fn fill_held(&mut self, structure: &Structure<'_>, first: u8) {
        let dictionary = structure.dictionary();
        let is_input = |o: &&Observable| matches!(o.source, Source::Input(_));
        let inputs = dictionary.observables().iter().rev().take_while(is_input).count();
        let factors = dictionary.factors();
        let (states, inputs) =
            factors.split_at_checked(factors.len().saturating_sub(inputs)).unwrap_or_default();
        self.states.fill(states);
        self.inputs = Run::last(inputs);
        let left = self.states.size().wrapping_add(self.states.between());
        let room = left.wrapping_mul(self.outputs.into());
        let (of_states, of_inputs) = (self.states.count(), self.inputs.count());
        if (of_states, of_inputs) != (states.len(), inputs.len()) || room > free(factors, first) {
            (self.states, self.inputs) = (Axes::default(), Run::NONE);
        }
    }

    #[inline(never)]
    fn fill_constants(&mut self, structure: &Structure<'_>) {
        let observables = structure.dictionary().observables();
        let scales = observables.iter().map(|o| [o.centre, o.gain]);
        let limits = structure.layout().states.iter().take(2).map(|place| place.limit);
        for (to, pair) in self.constants.iter_mut().zip(scales.chain(limits)) {
            *to = pair;
        }
    }

    /// Centre and gain of the observables, and behind them the limits of the first two coordinates.
    #[inline(always)]
    pub(super) fn constants(&self) -> &Constants {
        &self.constants
    }

    /// The scaled values of observables `from` to `to` in the registers from `first` on.
    #[inline(always)]
    fn observe<S: Scalar>(
        &self,
        (from, to): (usize, usize),
        registers: &mut Registers<S>,
        first: u8,
        ranges: &[[S; 2]],
    ) -> Option<()> {
        let (kept, free) = registers.split_at_mut(first);
        let raw = kept.get(usize::from(FIRST).wrapping_add(from)..)?;
        // A model without trained ranges has none.
        let (ranges, scales) = (ranges.get(from..to)?, self.constants.get(from..to)?);
        S::observe(raw, ranges, scales, free.get_mut(from..to)?).then_some(())
    }

    /// The outputs from the registers, whose free ones begin with `first`. `None` if an observable is outside
    /// its range.
    #[inline(always)]
    pub(crate) fn outputs<S: Scalar>(
        &self,
        registers: &mut Registers<S>,
        first: u8,
        ranges: &[[S; 2]],
        coefficients: &[S],
        outputs: &mut [S],
    ) -> Option<()> {
        let count = self.all.count();
        self.observe((0, count), registers, first, ranges)?;
        let (_, free) = registers.split_at_mut(first);
        let (values, scratch) = free.split_at_mut_checked(count)?;
        self.all.fold(coefficients, values, scratch, outputs)
    }

    /// Folds the inputs, which are held from now on. `None` if one is outside its range, or if they cannot be
    /// folded first.
    #[inline(always)]
    pub(crate) fn hold<S: Scalar>(
        &self,
        registers: &mut Registers<S>,
        first: u8,
        ranges: &[[S; 2]],
        coefficients: &[S],
    ) -> Option<()> {
        let (states, count) = (self.states.count(), self.all.count());
        if self.inputs.count() == 0 {
            return None;
        }
        self.observe((states, count), registers, first, ranges)?;
        let (_, free) = registers.split_at_mut(first);
        let (values, free) = free.split_at_mut_checked(count)?;
        let left = coefficients.len().checked_div(self.inputs.size())?;
        fold(self.inputs, coefficients, free.get_mut(..left)?, values.get(states..)?);
        Some(())
    }

    /// [`outputs`](Self::outputs) after [`hold`](Self::hold).
    #[inline(always)]
    pub(crate) fn outputs_held<S: Scalar>(
        &self,
        registers: &mut Registers<S>,
        first: u8,
        ranges: &[[S; 2]],
        coefficients: usize,
        outputs: &mut [S],
    ) -> Option<()> {
        let (states, count) = (self.states.count(), self.all.count());
        self.observe((0, states), registers, first, ranges)?;
        let (_, free) = registers.split_at_mut(first);
        let (values, free) = free.split_at_mut_checked(count)?;
        let left = coefficients.checked_div(self.inputs.size())?;
        let (held, scratch) = free.split_at_mut_checked(left)?;
        if states == 0 {
            for (to, c) in outputs.iter_mut().zip(held) {
                *to = *c;
            }
            return Some(());
        }
        self.states.fold(held, values.get(..states)?, scratch, outputs)
    }

    /// Moves the registers on to the outputs, if it is known what they are. `None`, and nothing has moved, if
    /// it is not, or if the prediction has diverged.
    #[inline(always)]
    pub(crate) fn advance<S: Scalar>(
        &self,
        layout: &Layout,
        registers: &mut Registers<S>,
        outputs: &mut [S],
    ) -> Option<()> {
        match self.next {
            Next::Values(lines) => {
                let (lines, angles) = outputs.split_at_mut_checked(lines.into())?;
                for (x, place) in lines.iter().zip(&layout.states) {
                    let [low, high] = place.limit.map(S::from_f32);
                    if !(*x >= low && *x <= high) {
                        return None;
                    }
                }
                for pair in angles.as_chunks_mut().0 {
                    if !S::on_circle(pair) {
                        return None;
                    }
                }
                for (to, x) in registers.slice_mut(FIRST, outputs.len()).iter_mut().zip(outputs) {
                    // The outputs are not looked at again. A copy would call a function that takes 1.6 KB.
                    core::mem::swap(to, x);
                }
            }
            Next::Pose => {
                let ([x, y, heading], [ahead, left, turn]) = (layout.states.as_slice(), outputs)
                else {
                    return None;
                };
                let (s, c) = (registers.get(heading.sin), registers.get(heading.cos));
                let to_x = c * *ahead - s * *left + registers.get(x.x);
                let to_y = s * *ahead + c * *left + registers.get(y.x);
                if turn.abs() > S::from_f32(LONG) {
                    return None;
                }
                let to = (*turn + registers.get(heading.x)).wrap();
                for (to, place) in [(to_x, x), (to_y, y), (to, heading)] {
                    let [low, high] = place.limit.map(S::from_f32);
                    if !(to >= low && to <= high) {
                        return None;
                    }
                }
                let (s, c) = to.sin_cos_within();
                registers.set(x.x, to_x);
                registers.set(y.x, to_y);
                registers.set(heading.x, to);
                registers.set(heading.sin, s);
                registers.set(heading.cos, c);
            }
            Next::Other => return None,
        }
        Some(())
    }

    /// What a step folds: runs, tiles of them, and coefficients that are folded, between the runs, too.
    pub(crate) fn folds(&self) -> [usize; 3] {
        let outputs = usize::from(self.outputs);
        let others = self.all.others;
        let between = self.all.between().wrapping_mul(outputs);
        let runs = if others.count() == 0 { 1 } else { 2 };
        let tiles = if runs == 1 { outputs } else { between.saturating_add(outputs) };
        let size = self.all.size();
        [runs, tiles, size.saturating_mul(outputs).saturating_add(between)]
    }

    /// Whether what becomes of the outputs is known beforehand.
    pub(crate) fn is_planned(&self) -> bool {
        self.next != Next::Other
    }

    /// Observables.
    #[inline(always)]
    pub(crate) fn observables(&self) -> usize {
        self.all.count()
    }

    /// Outputs.
    #[inline(always)]
    pub(crate) fn count(&self) -> usize {
        self.outputs.into()
    }
}
