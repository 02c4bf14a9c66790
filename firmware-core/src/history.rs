//! The samples that a prediction looks at: from coordinates to observables, and from the operator's
//! outputs back to coordinates.

use crate::Scalar;
use crate::capacity::MAX_STATES;
use crate::model::{Space, Structure, Symmetry, Target};
use crate::registers::{GROUP, Kind, Layout, Registers};

/// One sample of the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<S> {
    /// Coordinates; of an absolute angle only sine and cosine are kept up.
    x: [S; MAX_STATES],
    sin: [S; MAX_STATES],
    cos: [S; MAX_STATES],
}

impl<S: Scalar> Sample<S> {
    const ZERO: Self =
        Self { x: [S::ZERO; MAX_STATES], sin: [S::ZERO; MAX_STATES], cos: [S::ONE; MAX_STATES] };
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
        for (first, count) in other.kept {
            let from = other.registers.slice(first, count.into());
            for (to, x) in self.registers.slice_mut(first, count.into()).iter_mut().zip(from) {
                *to = *x;
            }
        }
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
        let layout = structure.layout();
        if self.layout != layout.id {
            *self = Self { layout: layout.id, kept: layout.kept(), ..Self::default() };
        }
        let increment = match layout.increments && self.filled > 0 {
            true => self.increment(structure, next),
            false => [S::ZERO; MAX_STATES],
        };
        let inputs = self.registers.slice_mut(layout.first_input, layout.inputs());
        for (i, to) in inputs.iter_mut().enumerate() {
            *to = at(input, i as u8);
        }
        let mut staged = [[S::ZERO; GROUP]; MAX_STATES];
        let parts = next.x.iter().zip(increment).zip(&next.sin).zip(&next.cos);
        for (to, (((x, increment), sin), cos)) in staged.iter_mut().zip(parts) {
            *to = [*x, increment, *sin, *cos];
        }
        self.registers.advance(layout, &staged);
        // Only what a later step may look at is counted.
        let room = u8::try_from(structure.lag()).unwrap_or(u8::MAX).saturating_add(1);
        self.filled = self.filled.saturating_add(1).min(room);
    }

    /// Coordinate `i` of the present sample.
    #[inline]
    fn coordinate(&self, layout: &Layout, i: u8) -> S {
        let place = layout.place(i);
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
        for (i, to) in (0..).zip(out.iter_mut().take(structure.states().len())) {
            *to = self.coordinate(structure.layout(), i);
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
        let increments = structure.states().iter().any(|s| s.target == Target::Increment);
        let increment = match increments {
            true => self.increment(structure, next),
            false => [S::ZERO; MAX_STATES],
        };
        let mut to = out.iter_mut();
        for (i, state) in structure.states().iter().enumerate() {
            let mut put = |value| {
                if let Some(to) = to.next() {
                    *to = value;
                }
            };
            let i = i as u8;
            match (state.target, state.space) {
                (Target::Increment, _) => put(at(&increment, i)),
                (Target::Absolute, Space::Line) => put(at(&next.x, i)),
                (Target::Absolute, Space::Circle) => {
                    put(at(&next.sin, i));
                    put(at(&next.cos, i));
                }
            }
        }
    }

    /// The next sample from the operator's outputs, shape `[outputs]`: increments are added (in the
    /// body frame for a pose), sine and cosine are put back on the circle. `None` when an output is
    /// not finite, an absolute angle has lost its direction, or a coordinate leaves its limit.
    #[inline]
    pub fn retract(&self, structure: &Structure<'_>, outputs: &[S]) -> Option<Sample<S>> {
        let mut staged = [[S::ZERO; GROUP]; MAX_STATES];
        self.stage(structure.layout(), outputs, &mut staged)?;
        let mut next = Sample::ZERO;
        let parts = next.x.iter_mut().zip(&mut next.sin).zip(&mut next.cos);
        for (((x, sin), cos), staged) in parts.zip(staged) {
            [*x, _, *sin, *cos] = staged;
        }
        Some(next)
    }

    /// The next sample from the operator's outputs as the registers hold it, four numbers per
    /// coordinate, in `next`. Nothing that is kept changes. `None` as in [`retract`](Self::retract).
    #[inline(always)]
    pub(crate) fn stage(
        &self,
        layout: &Layout,
        outputs: &[S],
        next: &mut [[S; GROUP]; MAX_STATES],
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
    pub(crate) fn advance(&mut self, layout: &Layout, next: &[[S; GROUP]; MAX_STATES]) {
        self.registers.advance(layout, next);
    }

    /// The increments of all coordinates from the present sample to another: wrapped on S¹, the pose
    /// of an se(2)-symmetric model in the frame of the present one.
    #[inline]
    fn increment(&self, structure: &Structure<'_>, to: &Sample<S>) -> [S; MAX_STATES] {
        let mut increment = [S::ZERO; MAX_STATES];
        let layout = structure.layout();
        for (i, (d, place)) in (0..).zip(increment.iter_mut().zip(&layout.states)) {
            let to = match place.kind.absolute_angle() {
                // Two arc tangents for nothing if no one reads the change of an absolute angle.
                true if !layout.increments => continue,
                true => at(&to.sin, i).atan2(at(&to.cos, i)),
                false => at(&to.x, i),
            };
            let change = to - self.coordinate(layout, i);
            let circle = structure.states().get(usize::from(i)).map(|s| s.space);
            *d = if circle == Some(Space::Circle) { change.wrap() } else { change };
        }
        if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
            let place = layout.place(heading);
            let (s, c) = (self.registers.get(place.sin), self.registers.get(place.cos));
            let (dx, dy) = (at(&increment, x), at(&increment, y));
            if let Some(ahead) = increment.get_mut(usize::from(x)) {
                *ahead = c * dx + s * dy;
            }
            if let Some(left) = increment.get_mut(usize::from(y)) {
                *left = c * dy - s * dx;
            }
        }
        increment
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
        let parts = sample.x.iter_mut().zip(&mut sample.sin).zip(&mut sample.cos);
        for (i, (((x, sin), cos), value)) in parts.zip(coordinates).enumerate() {
            *x = *value;
            if self.needs_trigonometry(i) {
                (*sin, *cos) = value.sin_cos();
            }
        }
    }
}
