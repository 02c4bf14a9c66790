//! The samples that a prediction looks at: from coordinates to observables, and from the operator's
//! outputs back to coordinates.

use crate::Scalar;
use crate::capacity::{MAX_OUTPUTS, MAX_STATES};
use crate::model::{Space, Structure, Symmetry, Target};
use crate::registers::{INPUTS, Kind, Layout, NOWHERE, Registers};

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
#[derive(Clone, Debug)]
pub struct History<S> {
    registers: Registers<S>,
    /// Which [`Layout`] the registers have, and what it keeps.
    layout: u32,
    kept: (u8, u8),
    filled: u8,
}

impl<S: Scalar> Default for History<S> {
    fn default() -> Self {
        Self { registers: Registers::new(), layout: 0, kept: (0, 0), filled: 0 }
    }
}

/// What is kept is compared, not what a step has computed on the way.
impl<S: Scalar> PartialEq for History<S> {
    fn eq(&self, other: &Self) -> bool {
        let kept = |history: &Self| (history.layout, history.kept, history.filled);
        let ((first, count), (of_other, _)) = (self.kept, other.kept);
        kept(self) == kept(other)
            && self.registers.from(first, count.into())
                == other.registers.from(of_other, count.into())
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

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.filled = 0;
    }

    /// How many samples there are for a model of this layout.
    #[inline]
    pub(crate) fn ready(&self, layout: &Layout) -> usize {
        if self.layout == layout.id { self.filled.into() } else { 0 }
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
        for (i, to) in self.registers.from_mut(INPUTS, layout.inputs.len()).iter_mut().enumerate() {
            *to = at(input, i as u8);
        }
        self.move_on(layout);
        let parts = next.x.iter().zip(&next.sin).zip(&next.cos).zip(increment);
        for (place, (((x, sin), cos), increment)) in layout.states.iter().zip(parts) {
            self.registers.set(place.x, *x);
            self.registers.set(place.sin, *sin);
            self.registers.set(place.cos, *cos);
            self.registers.set(place.increment, increment);
        }
        // Only what a later step may look at is counted.
        let room = u8::try_from(structure.lag()).unwrap_or(u8::MAX).saturating_add(1);
        self.filled = self.filled.saturating_add(1).min(room);
    }

    /// Moves the delay lines on by one sample and puts the inputs of the step in front of theirs.
    #[inline(always)]
    fn move_on(&mut self, layout: &Layout) {
        self.registers.shift(layout);
        for (head, from) in layout.inputs.iter().zip(INPUTS..) {
            self.registers.set(*head, self.registers.get(from));
        }
    }

    /// Takes a predicted sample as [`retract_in_place`](Self::retract_in_place) made it.
    #[inline(always)]
    pub(crate) fn advance(&mut self, layout: &Layout, outputs: &[S], next: &[S; MAX_STATES]) {
        self.move_on(layout);
        let registers = &mut self.registers;
        let mut outputs = outputs.iter().copied();
        for (place, x) in layout.states.iter().zip(next) {
            let z = outputs.next().unwrap_or_default();
            match place.kind {
                Kind::Angle | Kind::LimitedAngle => {
                    registers.set(place.sin, z);
                    registers.set(place.cos, outputs.next().unwrap_or_default());
                    registers.set(place.increment, *x);
                }
                Kind::Line | Kind::Increment | Kind::Pose | Kind::AngleIncrement => {
                    registers.set(place.x, *x);
                    registers.set(place.increment, z);
                }
                Kind::AngleIncrementTrigonometric => {
                    registers.set(place.x, *x);
                    registers.set(place.increment, z);
                    let (sin, cos) = x.sin_cos();
                    registers.set(place.sin, sin);
                    registers.set(place.cos, cos);
                }
            }
        }
    }

    /// Coordinate `i` of the present sample.
    #[inline]
    fn coordinate(&self, layout: &Layout, i: u8) -> S {
        let place = layout.place(i);
        match place.kind {
            Kind::Angle | Kind::LimitedAngle => {
                self.registers.get(place.sin).atan2(self.registers.get(place.cos))
            }
            _ => self.registers.get(place.x),
        }
    }

    /// The present coordinates in `out`, shape `[states]`: angles in (−π, π] where the model
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
        let (behind, _) = layout.kept();
        layout.observables.iter().map(move |register| match register.checked_sub(INPUTS) {
            Some(index) if *register < behind => at(input, index),
            _ => self.registers.get(*register),
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
        let mut placed = [S::ZERO; MAX_OUTPUTS];
        for (to, z) in placed.iter_mut().zip(outputs) {
            *to = *z;
        }
        let mut next = Sample::ZERO;
        let Sample { x, sin, cos } = &mut next;
        let layout = structure.layout();
        self.retract_in_place(layout, placed.get_mut(..outputs.len())?, x)?;
        let mut placed = placed.iter().copied();
        for (place, ((x, sin), cos)) in layout.states.iter().zip(x.iter().zip(sin).zip(cos)) {
            let z = placed.next()?;
            match place.kind {
                Kind::Angle | Kind::LimitedAngle => (*sin, *cos) = (z, placed.next()?),
                Kind::AngleIncrementTrigonometric => (*sin, *cos) = x.sin_cos(),
                _ => {}
            }
        }
        Some(next)
    }

    /// From the operator's outputs in place to what a history takes: the next coordinate in `next`
    /// and its change in the output, or sine and cosine, back on the circle, in the outputs and the
    /// change, if it is observed, in `next`. Nothing that is kept changes. `None` as in
    /// [`retract`](Self::retract).
    #[inline(always)]
    pub(crate) fn retract_in_place(
        &self,
        layout: &Layout,
        outputs: &mut [S],
        next: &mut [S; MAX_STATES],
    ) -> Option<()> {
        let registers = &self.registers;
        if let Some(pose) = layout.pose {
            let (s, c) = (registers.get(pose.sin), registers.get(pose.cos));
            let (ahead, left) = (at(outputs, pose.ahead), at(outputs, pose.left));
            *next.get_mut(usize::from(pose.x))? = c * ahead - s * left;
            *next.get_mut(usize::from(pose.y))? = s * ahead + c * left;
        }
        let mut outputs = outputs.iter_mut();
        for (place, next) in layout.states.iter().zip(next) {
            let z = outputs.next()?;
            let mut angle_change = None;
            let x = match place.kind {
                Kind::Line => {
                    let x = *z;
                    *z = x - registers.get(place.x);
                    x
                }
                Kind::Increment => *z + registers.get(place.x),
                Kind::Pose => *next + registers.get(place.x),
                Kind::AngleIncrement | Kind::AngleIncrementTrigonometric => {
                    // Hundreds of turns within a step would only look fine once they are wrapped.
                    if z.abs() > S::from_f32(LONG) {
                        return None;
                    }
                    (*z + registers.get(place.x)).wrap()
                }
                Kind::Angle | Kind::LimitedAngle => {
                    let c = outputs.next()?;
                    let square = *z * *z + *c * *c;
                    // Far from the circle the direction means nothing; also catches NaN.
                    if !(square > S::from_f32(1.0 / (LONG * LONG))
                        && square < S::from_f32(LONG * LONG))
                    {
                        return None;
                    }
                    let shrink = square.reciprocal_root();
                    (*z, *c) = (*z * shrink, *c * shrink);
                    let observed = place.increment != NOWHERE;
                    let angle = match place.kind == Kind::LimitedAngle || observed {
                        true => z.atan2(*c),
                        false => S::ZERO,
                    };
                    if observed {
                        let from = registers.get(place.sin).atan2(registers.get(place.cos));
                        angle_change = Some((angle - from).wrap());
                    }
                    angle
                }
            };
            let [low, high] = place.limit.map(S::from_f32);
            // Catches NaN and, as limits are finite, infinity.
            if !(x >= low && x <= high) {
                return None;
            }
            *next = angle_change.unwrap_or(x);
        }
        Some(())
    }

    /// The increments of all coordinates from the present sample to another: wrapped on S¹, the pose
    /// of an se(2)-symmetric model in the frame of the present one.
    #[inline]
    fn increment(&self, structure: &Structure<'_>, to: &Sample<S>) -> [S; MAX_STATES] {
        let mut increment = [S::ZERO; MAX_STATES];
        let layout = structure.layout();
        for (i, (d, place)) in (0..).zip(increment.iter_mut().zip(&layout.states)) {
            let to = match place.kind {
                // Two arc tangents for nothing if no one reads the change of an absolute angle.
                Kind::Angle | Kind::LimitedAngle if !layout.increments => continue,
                Kind::Angle | Kind::LimitedAngle => at(&to.sin, i).atan2(at(&to.cos, i)),
                _ => at(&to.x, i),
            };
            let change = to - self.coordinate(layout, i);
            let circle = structure.states().get(usize::from(i)).map(|s| s.space);
            *d = if circle == Some(Space::Circle) { change.wrap() } else { change };
        }
        if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
            let heading = layout.place(heading);
            let (s, c) = (self.registers.get(heading.sin), self.registers.get(heading.cos));
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

/// How far from the circle (sin, cos) may be, as a factor, and how far an angle may turn within a
/// step \[rad\], before a prediction counts as diverged.
const LONG: f32 = 1e3;

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
