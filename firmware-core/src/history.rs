//! The samples that a prediction looks at: from coordinates to observables, and from the operator's
//! outputs back to coordinates.

use crate::Scalar;
use crate::capacity::{MAX_KEPT, MAX_STATES};
use crate::model::{Space, Structure, Target};
use crate::registers::{FIRST, GROUP, Kind, Layout, Place, Registers};

/// One sample of the robot: of each coordinate itself, its change since the sample before, its sine and its
/// cosine, as far as they are needed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<S>(pub(crate) [[S; GROUP]; MAX_STATES]);

impl<S: Scalar> Sample<S> {
    /// Of coordinates that are 0.
    pub(crate) const ZERO: Self = Self([[S::ZERO, S::ZERO, S::ZERO, S::ONE]; MAX_STATES]);
}

/// The present sample and what a model looks at of the ones before it.
///
/// It belongs to the models of one structure: to one that keeps other things it is empty.
#[derive(Debug)]
pub struct History<S> {
    registers: Registers<S>,
    /// Which [`Layout`] the registers have, 0 as long as there is no sample, and what it keeps.
    layout: u32,
    kept: [(u8, u8); 2],
    filled: u8,
}

impl<S: Scalar> Default for History<S> {
    fn default() -> Self {
        Self { registers: Registers::new(), layout: 0, kept: [(0, 0); 2], filled: 0 }
    }
}

/// Into a history that is there already only what is kept is copied, a fraction of the registers.
impl<S: Scalar> Clone for History<S> {
    fn clone(&self) -> Self {
        Self { registers: self.registers.clone(), ..*self }
    }

    fn clone_from(&mut self, other: &Self) {
        (self.layout, self.kept, self.filled) = (other.layout, other.kept, other.filled);
        copy(self.kept, self.registers.groups_mut(), other.registers.groups());
    }
}

/// What is kept is compared, not what a step has computed on the way.
impl<S: Scalar> PartialEq for History<S> {
    fn eq(&self, other: &Self) -> bool {
        let kept = |history: &Self| (history.layout, history.kept, history.filled);
        kept(self) == kept(other)
            && self.kept.iter().all(|(first, count)| {
                let count = usize::from(*count);
                self.registers.slice(*first, count) == other.registers.slice(*first, count)
            })
    }
}

/// What a [`History`] keeps, without room to compute: a fraction of it.
#[derive(Clone, Debug)]
pub(crate) struct Saved<S> {
    numbers: [[S; GROUP]; MAX_KEPT / GROUP],
    layout: u32,
    kept: [(u8, u8); 2],
    filled: u8,
}

impl<S: Scalar> Saved<S> {
    pub(crate) const fn empty() -> Self {
        let numbers = [[S::ZERO; GROUP]; MAX_KEPT / GROUP];
        Self { numbers, layout: 0, kept: [(0, 0); 2], filled: 0 }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.filled == 0
    }

    pub(crate) fn clear(&mut self) {
        (self.layout, self.filled) = (0, 0);
    }

    /// Takes what a history keeps, of which there is no more than [`MAX_KEPT`].
    #[inline(always)]
    pub(crate) fn save(&mut self, history: &History<S>) {
        (self.layout, self.kept, self.filled) = (history.layout, history.kept, history.filled);
        copy(self.kept, &mut self.numbers, history.registers.groups());
    }

    /// Gives it back.
    #[inline(always)]
    pub(crate) fn restore(&self, history: &mut History<S>) {
        (history.layout, history.kept, history.filled) = (self.layout, self.kept, self.filled);
        copy(self.kept, history.registers.groups_mut(), &self.numbers);
    }
}

/// Copies what is `kept`, and what lies between and just behind it.
#[inline(always)]
fn copy<S: Copy>([_, (first, count)]: [(u8, u8); 2], to: &mut [[S; GROUP]], from: &[[S; GROUP]]) {
    let groups = (usize::from(first) + usize::from(count)).saturating_sub(FIRST.into());
    let groups = groups.div_ceil(GROUP);
    for (to, [a, b, c, d]) in to.iter_mut().zip(from).take(groups) {
        // Element by element: a load and a store on a Cortex-M, which would call a function otherwise.
        *to = [*a, *b, *c, *d];
    }
}

/// An element that a checked structure keeps inside the array; 0 otherwise.
#[inline]
fn at<T: Copy + Default>(array: &[T], index: u8) -> T {
    array.get(usize::from(index)).copied().unwrap_or_default()
}

impl<S: Scalar> History<S> {
    /// How many samples there are, the present one included.
    pub fn len(&self) -> usize {
        self.filled.into()
    }

    /// Whether there is no sample yet.
    pub fn is_empty(&self) -> bool {
        self.filled == 0
    }

    /// Forgets all samples, and which model they were of.
    pub fn clear(&mut self) {
        (self.layout, self.kept, self.filled) = (0, [(0, 0); 2], 0);
    }

    /// Whether there is a sample for a model of this layout.
    #[inline]
    pub(crate) fn is_of(&self, layout: &Layout) -> bool {
        self.layout == layout.id
    }

    /// How many samples there are for a model of this layout.
    #[inline]
    pub(crate) fn ready(&self, layout: &Layout) -> usize {
        if self.is_of(layout) { self.filled.into() } else { 0 }
    }

    #[inline]
    pub(crate) fn registers(&self) -> &Registers<S> {
        &self.registers
    }

    /// Where a step puts its inputs and what it computes: everything that is not kept.
    #[inline]
    pub(crate) fn registers_mut(&mut self) -> &mut Registers<S> {
        &mut self.registers
    }

    /// Takes a measured sample. `input` acted from the present sample to it; before the first
    /// sample it is ignored.
    #[inline]
    pub fn push(&mut self, structure: &Structure<'_>, input: &[S], next: &Sample<S>) {
        self.take(structure, input, &mut next.clone());
    }

    /// [`push`](Self::push) of a sample whose changes are worked out where it lies.
    #[inline]
    pub(crate) fn take(&mut self, structure: &Structure<'_>, input: &[S], next: &mut Sample<S>) {
        let layout = structure.layout();
        if self.layout != layout.id {
            (self.layout, self.kept, self.filled) = (layout.id, layout.kept(), 0);
            for (first, count) in self.kept {
                self.registers.slice_mut(first, count.into()).fill(S::ZERO);
            }
        }
        if layout.increments && self.filled > 0 {
            self.change(structure, next);
        } else {
            next.0
                .iter_mut()
                .take(layout.states.len())
                .for_each(|[_, change, ..]| *change = S::ZERO);
        }
        let inputs = self.registers.slice_mut(layout.first_input, layout.inputs());
        for (i, to) in inputs.iter_mut().enumerate() {
            *to = at(input, i as u8);
        }
        self.registers.advance(layout, &next.0);
        // Only what a later step may look at is counted.
        let room = u8::try_from(structure.lag()).unwrap_or(u8::MAX).saturating_add(1);
        self.filled = self.filled.saturating_add(1).min(room);
    }

    /// A coordinate of the present sample.
    #[inline]
    fn coordinate(&self, place: Place) -> S {
        if place.kind.absolute_angle() {
            self.registers.get(place.sin).atan2(self.registers.get(place.cos))
        } else {
            self.registers.get(place.x)
        }
    }

    /// The present coordinates in `out`, shape `[states]`: angles in \[−π, π\] where the model
    /// predicts them absolutely, as they came or wrapped after a step otherwise.
    #[inline]
    pub fn coordinates(&self, structure: &Structure<'_>, out: &mut [S]) {
        for (to, place) in out.iter_mut().zip(&structure.layout().states) {
            *to = self.coordinate(*place);
        }
    }

    /// The raw values of the observables in their units, before centring, one after the other;
    /// `input` acts over the coming step.
    #[inline]
    pub fn raw<'h>(
        &'h self,
        structure: &'h Structure<'_>,
        input: &'h [S],
    ) -> impl Iterator<Item = S> + 'h {
        let layout = structure.layout();
        let inputs = layout.inputs();
        layout.observables.iter().map(move |register| {
            match register.checked_sub(layout.first_input) {
                Some(index) if usize::from(index) < inputs => at(input, index),
                _ => self.registers.get(*register),
            }
        })
    }

    /// The values of the observables as the dictionary takes them, `(raw − centre) · gain`, in
    /// `out`, shape `[observables]`.
    #[inline]
    pub fn observe(&self, structure: &Structure<'_>, input: &[S], out: &mut [S]) {
        let observables = structure.dictionary().observables();
        for ((to, o), raw) in out.iter_mut().zip(observables).zip(self.raw(structure, input)) {
            *to = o.value(raw);
        }
    }

    /// What the operator's outputs have to be to lead from the present sample to `next`: the rows
    /// of the regression, shape `[outputs]`. The inverse of [`retract`](Self::retract).
    #[inline]
    pub fn targets(&self, structure: &Structure<'_>, next: &Sample<S>, out: &mut [S]) {
        let mut next = *next;
        if structure.states().iter().any(|s| s.target == Target::Increment) {
            self.change(structure, &mut next);
        }
        let mut to = out.iter_mut();
        for (state, [x, change, sin, cos]) in structure.states().iter().zip(next.0) {
            let mut put = |value| {
                if let Some(to) = to.next() {
                    *to = value;
                }
            };
            match (state.target, state.space) {
                (Target::Increment, _) => put(change),
                (Target::Absolute, Space::Line) => put(x),
                (Target::Absolute, Space::Circle) => {
                    put(sin);
                    put(cos);
                }
            }
        }
    }

    /// The next sample from the operator's outputs, shape `[outputs]`: increments are added (in the
    /// body frame for a pose), sine and cosine are put back on the circle. `None` when an output is
    /// not finite, an absolute angle has lost its direction, or a coordinate leaves its limit.
    #[inline]
    pub fn retract(&self, structure: &Structure<'_>, outputs: &[S]) -> Option<Sample<S>> {
        let mut next = Sample::ZERO;
        self.stage(structure.layout(), outputs, &mut next)?;
        Some(next)
    }

    /// The next sample from the operator's outputs as the registers hold it, four numbers per
    /// coordinate, in `next`. Nothing that is kept changes. `None` as in [`retract`](Self::retract).
    #[inline(always)]
    pub(crate) fn stage(
        &self,
        layout: &Layout,
        outputs: &[S],
        Sample(next): &mut Sample<S>,
    ) -> Option<()> {
        let registers = &self.registers;
        if let Some(pose) = layout.pose {
            let (s, c) = (registers.get(pose.sin), registers.get(pose.cos));
            let (ahead, left) = (at(outputs, pose.ahead), at(outputs, pose.left));
            let [x, ..] = next.get_mut(usize::from(pose.x))?;
            *x = c * ahead - s * left;
            let [y, ..] = next.get_mut(usize::from(pose.y))?;
            *y = s * ahead + c * left;
        }
        let mut outputs = outputs.iter().copied();
        for (place, next) in layout.states.iter().zip(next) {
            let z = outputs.next()?;
            let (from, [to, change, sin, cos]) = (registers.get(place.x), next);
            let x = match place.kind {
                Kind::Line => {
                    *change = z - from;
                    z
                }
                Kind::Increment => {
                    *change = z;
                    z + from
                }
                Kind::Pose => {
                    *change = z;
                    *to + from
                }
                Kind::AngleIncrement | Kind::AngleIncrementTrigonometric => {
                    // Hundreds of turns within a step would only look fine once they are wrapped.
                    if z.abs() > S::from_f32(LONG) {
                        return None;
                    }
                    *change = z;
                    let x = (z + from).wrap();
                    if place.kind == Kind::AngleIncrementTrigonometric {
                        (*sin, *cos) = x.sin_cos_within();
                    }
                    x
                }
                Kind::Circle => {
                    [*sin, *cos] = on_circle([z, outputs.next()?])?;
                    continue;
                }
                Kind::Angle => {
                    [*sin, *cos] = on_circle([z, outputs.next()?])?;
                    let from = registers.get(place.sin).atan2(registers.get(place.cos));
                    let x = sin.atan2(*cos);
                    *change = (x - from).wrap();
                    x
                }
            };
            let [low, high] = place.limit.map(S::from_f32);
            // Catches NaN and, as limits are finite, infinity.
            if !(x >= low && x <= high) {
                return None;
            }
            *to = x;
        }
        Some(())
    }

    /// Takes the sample that [`stage`](Self::stage) made.
    #[inline(always)]
    pub(crate) fn advance(&mut self, layout: &Layout, next: &Sample<S>) {
        self.registers.advance(layout, &next.0);
    }

    /// The changes of all coordinates from the present sample to another: wrapped on S¹, the pose
    /// of an se(2)-symmetric model in the frame of the present one.
    #[inline]
    fn change(&self, structure: &Structure<'_>, Sample(next): &mut Sample<S>) {
        let layout = structure.layout();
        let places = layout.states.iter().zip(structure.states());
        for ([x, change, sin, cos], (place, state)) in next.iter_mut().zip(places) {
            let to = match place.kind.absolute_angle() {
                // Two arc tangents for nothing if no one reads the change of an absolute angle.
                true if !layout.increments => continue,
                true => sin.atan2(*cos),
                false => *x,
            };
            *change = state.space.difference(to, self.coordinate(*place));
        }
        let Some(pose) = layout.pose else { return };
        let (s, c) = (self.registers.get(pose.sin), self.registers.get(pose.cos));
        let of = |coordinate: u8| next.get(usize::from(coordinate)).map(|[_, change, ..]| *change);
        let (dx, dy) = (of(pose.x).unwrap_or_default(), of(pose.y).unwrap_or_default());
        for (coordinate, turned) in [(pose.x, c * dx + s * dy), (pose.y, c * dy - s * dx)] {
            if let Some([_, change, ..]) = next.get_mut(usize::from(coordinate)) {
                *change = turned;
            }
        }
    }
}

/// How far an angle may turn within a step \[rad\] before a prediction counts as diverged.
pub(crate) const LONG: f32 = 1e3;

/// Sine and cosine, back on the circle; `None` if they have lost their direction.
#[inline]
fn on_circle<S: Scalar>(mut pair: [S; 2]) -> Option<[S; 2]> {
    S::on_circle(&mut pair).then_some(pair)
}

impl Structure<'_> {
    /// How many numbers of its samples a history of this structure keeps, the latest inputs among them.
    pub fn kept(&self) -> usize {
        usize::from(self.layout().end.saturating_sub(FIRST))
    }

    /// A sample from coordinates, shape `[states]`, angles in radians; missing ones are 0.
    #[inline]
    pub fn sample<S: Scalar>(&self, coordinates: &[S]) -> Sample<S> {
        let mut sample = Sample::ZERO;
        self.sample_into(coordinates, &mut sample);
        sample
    }

    /// [`sample`](Self::sample) over an earlier sample of the same structure.
    #[inline]
    pub fn sample_into<S: Scalar>(&self, coordinates: &[S], sample: &mut Sample<S>) {
        for (i, ([x, _, sin, cos], value)) in sample.0.iter_mut().zip(coordinates).enumerate() {
            *x = *value;
            if self.needs_trigonometry(i) {
                (*sin, *cos) = value.sin_cos();
            }
        }
    }
}
