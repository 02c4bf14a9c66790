//! The samples that a prediction looks at: from coordinates to observables, and from the operator's
//! outputs back to coordinates.

use crate::Scalar;
use crate::capacity::{MAX_INPUTS, MAX_LAG, MAX_STATES};
use crate::dictionary::Source;
use crate::model::{Space, Structure, Symmetry, Target};

/// One sample of the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<S> {
    /// Coordinates; of an absolute angle only sine and cosine are kept up.
    x: [S; MAX_STATES],
    sin: [S; MAX_STATES],
    cos: [S; MAX_STATES],
    /// The increment that led here from the sample before.
    increment: [S; MAX_STATES],
    /// The input that acts from this sample to the next.
    input: [S; MAX_INPUTS],
}

impl<S: Scalar> Sample<S> {
    pub(crate) const ZERO: Self = Self {
        x: [S::ZERO; MAX_STATES],
        sin: [S::ZERO; MAX_STATES],
        cos: [S::ONE; MAX_STATES],
        increment: [S::ZERO; MAX_STATES],
        input: [S::ZERO; MAX_INPUTS],
    };
}

impl<S: Scalar> Sample<S> {
    /// Takes over the coordinates of another sample, one number at a time: they have just been
    /// written that way, and a wider load would have to wait for the stores.
    #[inline]
    fn set(&mut self, other: &Self, states: usize) {
        let lists = [
            (&mut self.x, &other.x),
            (&mut self.sin, &other.sin),
            (&mut self.cos, &other.cos),
            (&mut self.increment, &other.increment),
        ];
        for (to, from) in lists {
            for (to, from) in to.iter_mut().zip(from).take(states) {
                *to = *from;
            }
        }
    }
}

/// The present sample and the ones before it, as far back as a model may look.
#[derive(Clone, Debug, PartialEq)]
pub struct History<S> {
    /// The newest first.
    samples: [Sample<S>; MAX_LAG + 1],
    filled: u8,
}

impl<S: Scalar> Default for History<S> {
    fn default() -> Self {
        Self { samples: [Sample::ZERO; MAX_LAG + 1], filled: 0 }
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

    #[inline]
    fn newest(&self) -> &Sample<S> {
        let [newest, ..] = &self.samples;
        newest
    }

    /// Takes a measured sample. `input` acted from the present sample to it; before the first
    /// sample it is ignored.
    #[inline]
    pub fn push(&mut self, structure: &Structure<'_>, input: &[S], next: &Sample<S>) {
        if structure.needs_increments() && self.filled > 0 {
            let increment = structure.increment(self.newest(), next);
            self.advance(structure, input, &Sample { increment, ..*next });
        } else {
            self.advance(structure, input, next);
        }
    }

    /// Takes a predicted sample, as [`retract`](Self::retract) made it.
    #[inline]
    pub(crate) fn advance(&mut self, structure: &Structure<'_>, input: &[S], next: &Sample<S>) {
        let [newest, ..] = &mut self.samples;
        for (to, u) in newest.input.iter_mut().zip(input) {
            *to = *u;
        }
        let kept = structure.lag().min(MAX_LAG);
        if kept > 0 {
            self.samples.copy_within(..kept, 1);
        }
        let [newest, ..] = &mut self.samples;
        newest.set(next, structure.states().len());
        // Only what a later step may look at is kept: another model is not shown stale samples.
        let room = u8::try_from(kept).unwrap_or(u8::MAX).saturating_add(1);
        self.filled = self.filled.saturating_add(1).min(room);
    }

    /// The present coordinates in `out`, shape `[states]`: angles in (−π, π] where the model
    /// predicts them absolutely, as they came or wrapped after a step otherwise.
    #[inline]
    pub fn coordinates(&self, structure: &Structure<'_>, out: &mut [S]) {
        for (i, to) in out.iter_mut().enumerate().take(structure.states().len()) {
            *to = structure.coordinate(self.newest(), i);
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
        structure.dictionary().observables().iter().map(move |o| {
            let sample = |lag: u8| self.samples.get(usize::from(lag)).unwrap_or(self.newest());
            match o.source {
                Source::State(i) => at(&sample(o.lag).x, i),
                Source::Sin(i) => at(&sample(o.lag).sin, i),
                Source::Cos(i) => at(&sample(o.lag).cos, i),
                Source::Increment(i) => at(&sample(o.lag.saturating_sub(1)).increment, i),
                Source::Input(i) if o.lag == 0 => at(input, i),
                Source::Input(i) => at(&sample(o.lag).input, i),
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
            true => structure.increment(self.newest(), next),
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
        let mut next = Sample::ZERO;
        self.retract_into(structure, outputs, &mut next)?;
        Some(next)
    }

    /// [`retract`](Self::retract) into a sample that is still [`Sample::ZERO`].
    #[inline]
    pub(crate) fn retract_into(
        &self,
        structure: &Structure<'_>,
        outputs: &[S],
        next: &mut Sample<S>,
    ) -> Option<()> {
        let present = self.newest();
        let mut outputs = outputs.iter().copied();
        for (i, state) in structure.states().iter().enumerate() {
            let z = outputs.next()?;
            let (x, sin, cos) = (next.x.get_mut(i)?, next.sin.get_mut(i)?, next.cos.get_mut(i)?);
            match (state.target, state.space) {
                (Target::Increment, space) => {
                    // Hundreds of turns within a step would only look fine once they are wrapped.
                    if space == Space::Circle && z.abs() > S::from_f32(LONG) {
                        return None;
                    }
                    *x = z;
                    *next.increment.get_mut(i)? = z;
                }
                (Target::Absolute, Space::Line) => *x = z,
                (Target::Absolute, Space::Circle) => {
                    let c = outputs.next()?;
                    let radius = (z * z + c * c).sqrt();
                    // Far from the circle the direction means nothing; also catches NaN.
                    if !(radius > S::from_f32(1.0 / LONG) && radius < S::from_f32(LONG)) {
                        return None;
                    }
                    let shrink = S::ONE / radius;
                    (*sin, *cos) = (z * shrink, c * shrink);
                }
            }
        }
        if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
            let (s, c) = (at(&present.sin, heading), at(&present.cos, heading));
            let (ahead, left) = (at(&next.x, x), at(&next.x, y));
            *next.x.get_mut(usize::from(x))? = c * ahead - s * left;
            *next.x.get_mut(usize::from(y))? = s * ahead + c * left;
        }
        for (i, state) in structure.states().iter().enumerate() {
            let x = next.x.get_mut(i)?;
            let absolute_angle = (state.target, state.space) == (Target::Absolute, Space::Circle);
            if state.target == Target::Increment {
                *x = *x + present.x.get(i).copied()?;
            }
            if state.space == Space::Circle && !absolute_angle {
                *x = x.wrap();
                if structure.needs_trigonometry(i) {
                    (*next.sin.get_mut(i)?, *next.cos.get_mut(i)?) = x.sin_cos();
                }
            }
            let [low, high] = state.limit.map(S::from_f32);
            let value = if !absolute_angle {
                *x
            } else if low > -S::PI || high < S::PI {
                at(&next.sin, i as u8).atan2(at(&next.cos, i as u8))
            } else {
                // A limit that no angle leaves is not worth an arc tangent.
                continue;
            };
            if !(value >= low && value <= high && value.is_finite()) {
                return None;
            }
        }
        if structure.needs_increments() {
            for (i, state) in structure.states().iter().enumerate() {
                if state.target == Target::Absolute {
                    *next.increment.get_mut(i)? = structure.change(present, next, i);
                }
            }
        }
        Some(())
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

    #[inline]
    fn coordinate<S: Scalar>(&self, sample: &Sample<S>, i: usize) -> S {
        let absolute_angle = self
            .states()
            .get(i)
            .is_some_and(|s| (s.target, s.space) == (Target::Absolute, Space::Circle));
        let i = i as u8;
        if absolute_angle { at(&sample.sin, i).atan2(at(&sample.cos, i)) } else { at(&sample.x, i) }
    }

    /// The change of a coordinate, wrapped on S¹.
    #[inline]
    fn change<S: Scalar>(&self, from: &Sample<S>, to: &Sample<S>, i: usize) -> S {
        let change = self.coordinate(to, i) - self.coordinate(from, i);
        match self.states().get(i).map(|s| s.space) {
            Some(Space::Circle) => change.wrap(),
            _ => change,
        }
    }

    /// The increments of all coordinates from one sample to the next: wrapped on S¹, the pose of an
    /// se(2)-symmetric model in the frame of `from`.
    #[inline]
    fn increment<S: Scalar>(&self, from: &Sample<S>, to: &Sample<S>) -> [S; MAX_STATES] {
        let mut increment = [S::ZERO; MAX_STATES];
        for (i, (d, state)) in increment.iter_mut().zip(self.states()).enumerate() {
            // Two arc tangents for nothing if no one reads the change of an absolute angle.
            let absolute_angle = (state.target, state.space) == (Target::Absolute, Space::Circle);
            if !absolute_angle || self.needs_increments() {
                *d = self.change(from, to, i);
            }
        }
        if let Symmetry::Se2 { x, y, heading } = self.symmetry() {
            let (s, c) = (at(&from.sin, heading), at(&from.cos, heading));
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
