//! Predicting: one step, or a rollout that lifts again at every step.

use crate::Scalar;
use crate::capacity::{MAX_OUTPUTS, MAX_STATES};
use crate::history::{History, Sample, Saved};
use crate::kernel::{self, Constants, Direct, Known};
use crate::model::Model;
use crate::registers::{FIRST, Layout, Registers};

/// The first time a rollout left the range that the model was trained in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutOfRange {
    /// The step whose prediction used the value; 1 is the first step after the last measurement.
    pub step: u32,
    /// Index of the observable.
    pub observable: usize,
}

/// Why there is no prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PredictError {
    /// The model looks at earlier samples that have not been observed yet.
    NotReady {
        /// Samples observed.
        have: usize,
        /// Samples needed: the largest lag and the present one.
        need: usize,
    },
    /// A slice does not have the length that the model asks for.
    DimensionMismatch {
        /// Which argument.
        field: &'static str,
        /// Expected length.
        expected: usize,
        /// Length found.
        found: usize,
    },
    /// A measurement is NaN or infinite.
    NotFinite {
        /// Index of the coordinate.
        coordinate: usize,
    },
    /// An input is NaN or infinite.
    InputNotFinite {
        /// Index of the input.
        input: usize,
    },
    /// The prediction left the finite numbers, a hard limit of the model, or the circle.
    Diverged {
        /// The step that failed; 1 is the first step after the last measurement.
        step: u32,
    },
}

/// All that moves while a [`Predictor`] works.
///
/// `clone_from` into a state that is there already takes a fraction of what `clone` takes.
#[derive(Debug)]
pub struct PredictorState<S = f32> {
    history: History<S>,
    step: u32,
    out_of_range: Option<OutOfRange>,
    /// What the last step made on the way: the operator's outputs, and the next sample.
    outputs: [S; MAX_OUTPUTS],
    next: Sample<S>,
}

/// What a step has made on the way is not copied into a state that is there already.
impl<S: Scalar> Clone for PredictorState<S> {
    fn clone(&self) -> Self {
        Self { history: self.history.clone(), ..*self }
    }

    fn clone_from(&mut self, other: &Self) {
        self.history.clone_from(&other.history);
        (self.step, self.out_of_range) = (other.step, other.out_of_range);
    }
}

/// What a step has made on the way is not compared.
impl<S: Scalar> PartialEq for PredictorState<S> {
    fn eq(&self, other: &Self) -> bool {
        (&self.history, self.step, self.out_of_range)
            == (&other.history, other.step, other.out_of_range)
    }
}

impl<S: Scalar> Default for PredictorState<S> {
    fn default() -> Self {
        Self {
            history: History::default(),
            step: 0,
            out_of_range: None,
            outputs: [S::ZERO; MAX_OUTPUTS],
            next: Sample::ZERO,
        }
    }
}

impl<S: Scalar> PredictorState<S> {
    /// Nothing observed yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Forgets everything, as if new.
    pub fn clear(&mut self) {
        self.history.clear();
        (self.step, self.out_of_range) = (0, None);
    }

    /// Steps predicted since the last measurement.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// The first step and observable outside the trained range since the last measurement.
    pub fn out_of_range(&self) -> Option<OutOfRange> {
        self.out_of_range
    }

    /// The samples.
    pub fn history(&self) -> &History<S> {
        &self.history
    }
}

/// What a [`PredictorState`] keeps from one step to the next, without room to compute: a control loop that follows
/// several predictions of a model makes all of them in one state, and saves the others.
#[derive(Clone, Debug)]
pub(crate) struct SavedState<S = f32> {
    history: Saved<S>,
    step: u32,
    out_of_range: Option<OutOfRange>,
}

impl<S: Scalar> SavedState<S> {
    pub(crate) const fn empty() -> Self {
        Self { history: Saved::empty(), step: 0, out_of_range: None }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.history.is_empty()
    }

    pub(crate) fn clear(&mut self) {
        self.history.clear();
        (self.step, self.out_of_range) = (0, None);
    }

    #[inline(never)]
    pub(crate) fn save(&mut self, state: &PredictorState<S>) {
        self.history.save(&state.history);
        (self.step, self.out_of_range) = (state.step, state.out_of_range);
    }

    #[inline(never)]
    pub(crate) fn restore(&self, state: &mut PredictorState<S>) {
        self.history.restore(&mut state.history);
        (state.step, state.out_of_range) = (self.step, self.out_of_range);
    }
}

/// Predicts with a model; holds nothing that changes.
///
/// ```
/// use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
/// use firmware_core::model::{Input, Model, ModelRepr, Provenance, Space, State, Structure};
/// use firmware_core::model::{Symmetry, Target};
/// use firmware_core::{PredictError, Predictor, PredictorState};
///
/// // x⁺ = 0.5 x + 2 u as a Kronecker block [1, x] ⊗ [1, u]: terms 1, u, x, x·u.
/// let observable = |source| Observable { source, lag: 0, centre: 0.0, gain: 1.0 };
/// let factor = |observable| Factor { observable, basis: Basis::Hermite, order: 1 };
/// let structure = Structure::try_from(ModelRepr {
///     robot: "cart",
///     sample_time_s: 0.1,
///     states: [State {
///         name: "x", unit: "m", space: Space::Line, target: Target::Absolute, limit: [-9.0, 9.0],
///     }].into_iter().collect(),
///     inputs: [Input { name: "u", unit: "V", range: [-1.0, 1.0] }].into_iter().collect(),
///     symmetry: Symmetry::None,
///     observables: [observable(Source::State(0)), observable(Source::Input(0))].into_iter().collect(),
///     factors: [factor(0), factor(1)].into_iter().collect(),
///     blocks: [Block { factors: 2, max_degree: 0 }].into_iter().collect(),
///     provenance: Provenance { logs: [0; 32], robot: [0; 32] },
/// }).unwrap();
/// let coefficients = [0.0_f32, 2.0, 0.5, 0.0];
/// let model = Model::new(structure, &coefficients, None).unwrap();
///
/// let predictor = Predictor::new(&model);
/// let mut state = PredictorState::new();
/// predictor.observe(&mut state, &[], &[4.0]).unwrap();
/// let mut x = [0.0; 3];
/// predictor.rollout(&mut state, &[1.0, 1.0, -1.0], &mut x).unwrap();
/// assert_eq!(x, [4.0, 4.0, 0.0]); // 2 + 2, 2 + 2, 2 − 2
/// // From 8 m, 3 V would take the cart to 10 m, beyond its limit of 9 m.
/// predictor.observe(&mut state, &[0.0], &[8.0]).unwrap();
/// assert_eq!(predictor.step(&mut state, &[3.0]), Err(PredictError::Diverged { step: 1 }));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Predictor<'m, 'a, S = f32> {
    model: &'m Model<'a, S>,
}

impl<'m, 'a, S: Scalar> Predictor<'m, 'a, S> {
    /// A predictor of the model.
    pub fn new(model: &'m Model<'a, S>) -> Self {
        Self { model }
    }

    /// The model.
    pub fn model(&self) -> &'m Model<'a, S> {
        self.model
    }

    /// Takes a measurement: `coordinates`, shape `[states]`, in the model's units (angles in
    /// radians, any turn), after `applied`, shape `[inputs]`, acted for one sample time. Before the
    /// first measurement `applied` may be empty.
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`], [`PredictError::NotFinite`] and
    /// [`PredictError::InputNotFinite`]; the state is unchanged.
    pub fn observe(
        &self,
        state: &mut PredictorState<S>,
        applied: &[S],
        coordinates: &[S],
    ) -> Result<(), PredictError> {
        let structure = self.model.structure();
        expect("coordinates", structure.states().len(), coordinates.len())?;
        if !(state.history.ready(structure.layout()) == 0 && applied.is_empty()) {
            expect_inputs(structure.inputs().len(), applied)?;
        }
        if let Some(coordinate) = coordinates.iter().position(|x| !x.is_finite()) {
            return Err(PredictError::NotFinite { coordinate });
        }
        structure.sample_into(coordinates, &mut state.next);
        state.history.take(structure, applied, &mut state.next);
        state.step = 0;
        state.out_of_range = None;
        Ok(())
    }

    /// Predicts one sample time ahead under `input`, shape `[inputs]`, and moves the state there.
    ///
    /// # Errors
    /// [`PredictError::NotReady`] until the history is full, [`PredictError::DimensionMismatch`],
    /// [`PredictError::InputNotFinite`], [`PredictError::Diverged`]; the state is unchanged.
    #[inline(always)]
    pub fn step(&self, state: &mut PredictorState<S>, input: &[S]) -> Result<(), PredictError> {
        match self.model.known() {
            Some(known) if self.step_known(known, state, input) => Ok(()),
            _ if self.step_otherwise(state, input) => Ok(()),
            _ => Err(self.why_not(state, input)),
        }
    }

    /// Why a step from an unchanged state was not made.
    #[cold]
    #[inline(never)]
    fn why_not(&self, state: &PredictorState<S>, input: &[S]) -> PredictError {
        let structure = self.model.structure();
        if let Err(error) = expect_inputs(structure.inputs().len(), input) {
            return error;
        }
        let have = state.history.ready(structure.layout());
        let need = structure.lag().saturating_add(1);
        if have < need {
            return PredictError::NotReady { have, need };
        }
        PredictError::Diverged { step: state.step.saturating_add(1) }
    }

    /// [`step`](Self::step) of a model that the controller has a kernel for; `false`, and nothing that is kept
    /// has changed, if there is none, or anything is unusual.
    #[inline(always)]
    fn step_known(self, known: &Known<'_, S>, state: &mut PredictorState<S>, input: &[S]) -> bool {
        let [first, second] = input else { return false };
        if !state.history.is_of(self.model.structure().layout()) {
            return false;
        }
        let constants = self.model.program().constants();
        let registers = state.history.registers_mut().all_mut();
        let made = match known {
            Known::Drive(ranges, coefficients) => {
                let [_, _, _, _, to_first, to_second, ..] = registers;
                (*to_first, *to_second) = (*first, *second);
                S::drive(constants, ranges, coefficients, registers)
            }
            Known::Planar(ranges, coefficients) => {
                let [to_first, to_second, ..] = registers;
                (*to_first, *to_second) = (*first, *second);
                S::planar(constants, ranges, coefficients, registers)
            }
        };
        if made {
            state.step = state.step.saturating_add(1);
        }
        made
    }

    /// [`step`](Self::step) of a model that the controller has no kernel for; `false`, and nothing that is kept
    /// has changed, if there is no prediction.
    #[inline(never)]
    fn step_otherwise(self, state: &mut PredictorState<S>, input: &[S]) -> bool {
        match self.model.program().direct() {
            Some(direct) if self.step_directly(direct, state, input).is_some() => true,
            _ => self.step_at_length(state, input).is_some(),
        }
    }

    /// [`step`](Self::step) of a model whose registers are as its kernel takes them. `None`, and nothing that
    /// is kept has changed, if anything is unusual: the other one says what.
    #[inline(never)]
    fn step_directly(
        self,
        direct: &Direct,
        state: &mut PredictorState<S>,
        input: &[S],
    ) -> Option<()> {
        let layout = self.model.structure().layout();
        take_input(layout, state, input)?;
        let registers = state.history.registers_mut();
        let (ranges, coefficients) = (self.model.range_pairs(), self.model.coefficients());
        let first = self.model.program().first();
        let outputs = state.outputs.get_mut(..direct.count())?;
        direct.outputs(registers, first, ranges, coefficients, outputs)?;
        self.advance(direct, state)?;
        state.step = state.step.saturating_add(1);
        Some(())
    }

    /// Moves a state on to the outputs in it.
    #[inline(always)]
    fn advance(self, direct: &Direct, state: &mut PredictorState<S>) -> Option<()> {
        let layout = self.model.structure().layout();
        let outputs = state.outputs.get_mut(..direct.count())?;
        if direct.advance(layout, state.history.registers_mut(), outputs).is_none() {
            stage(state, layout, direct.count())?;
            state.history.advance(layout, &state.next);
        }
        Some(())
    }

    /// [`step`](Self::step) of any model, sparse or dense. `None`, and nothing that is kept has changed, if there
    /// is no prediction.
    #[inline(never)]
    fn step_at_length(self, state: &mut PredictorState<S>, input: &[S]) -> Option<()> {
        let (structure, program) = (self.model.structure(), self.model.program());
        let layout = structure.layout();
        if state.history.ready(layout) <= structure.lag() {
            return None;
        }
        take_input(layout, state, input)?;
        let registers = state.history.registers_mut();
        let (dictionary, coefficients) = (structure.dictionary(), self.model.coefficients());
        let outputs = state.outputs.get_mut(..structure.outputs()).unwrap_or_default();
        let next = program.scale(dictionary.observables(), registers);
        if self.model.terms().is_some() {
            program.outputs(next, registers, coefficients, outputs);
        } else {
            let blocks = dictionary.blocks().map(|(_, factors)| factors);
            let values = program.values(registers);
            kernel::outputs(blocks, dictionary.dense_terms(), values, coefficients, outputs);
        }
        stage(state, layout, structure.outputs())?;
        let step = state.step.saturating_add(1);
        // What is observed is still there.
        let (ranges, registers) = (self.model.range_pairs(), state.history.registers());
        let mut outside = 0;
        for (register, [low, high]) in layout.observables.iter().zip(ranges) {
            outside |= registers.get(*register).outside(*low, *high);
        }
        if outside >> 31 != 0 && state.out_of_range.is_none() {
            let observable = first_outside(layout, state.history.registers(), ranges);
            state.out_of_range = observable.map(|observable| OutOfRange { step, observable });
        }
        state.history.advance(layout, &state.next);
        state.step = step;
        Some(())
    }

    /// The present coordinates in `out`, shape `[states]`: measured or predicted, whichever came
    /// last; predicted angles in \[−π, π\].
    ///
    /// # Errors
    /// [`PredictError::DimensionMismatch`].
    #[inline]
    pub fn coordinates(
        &self,
        state: &PredictorState<S>,
        out: &mut [S],
    ) -> Result<(), PredictError> {
        expect("coordinates", self.model.structure().states().len(), out.len())?;
        state.history.coordinates(self.model.structure(), out);
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
        state: &mut PredictorState<S>,
        inputs: &[S],
        predicted: &mut [S],
    ) -> Result<(), PredictError> {
        let (n, m) = self.dimensions();
        let horizon = predicted.len().checked_div(n).unwrap_or(0);
        expect("predicted", horizon.saturating_mul(n), predicted.len())?;
        expect("inputs", horizon.saturating_mul(m), inputs.len())?;
        // Without inputs there is nothing to cut into rows: every step gets the empty one.
        let mut rows = inputs.chunks_exact(m.max(1));
        for out in predicted.chunks_exact_mut(n) {
            self.step(state, rows.next().unwrap_or(&[]))?;
            state.history.coordinates(self.model.structure(), out);
        }
        Ok(())
    }

    /// The same with one input, shape `[inputs]`, held over the whole horizon.
    ///
    /// # Errors
    /// As [`rollout`](Self::rollout).
    pub fn rollout_held(
        &self,
        state: &mut PredictorState<S>,
        input: &[S],
        predicted: &mut [S],
    ) -> Result<(), PredictError> {
        let (n, _) = self.dimensions();
        let horizon = predicted.len().checked_div(n).unwrap_or(0);
        expect("predicted", horizon.saturating_mul(n), predicted.len())?;
        let done = self.hold_directly(state, input, horizon, predicted).unwrap_or(0);
        for out in predicted.chunks_exact_mut(n).skip(done) {
            self.step(state, input)?;
            state.history.coordinates(self.model.structure(), out);
        }
        Ok(())
    }

    /// Moves the state `steps` sample times on with one input, shape `[inputs]`, held: what as many
    /// [steps](Self::step) do, to the bit. Where only the end counts this takes less than
    /// [`rollout_held`](Self::rollout_held), which takes an arc tangent for every angle that it says.
    ///
    /// # Errors
    /// As [`step`](Self::step); the state is as it was after the last step that succeeded.
    pub fn hold(
        &self,
        state: &mut PredictorState<S>,
        input: &[S],
        steps: usize,
    ) -> Result<(), PredictError> {
        let done = self.hold_directly(state, input, steps, &mut []).unwrap_or(0);
        for _ in done..steps {
            self.step(state, input)?;
        }
        Ok(())
    }

    /// As many steps with the input held as there is nothing unusual about, their coordinates in the rows of
    /// `path`, as far as it goes.
    #[inline(never)]
    fn hold_directly(
        self,
        state: &mut PredictorState<S>,
        input: &[S],
        steps: usize,
        path: &mut [S],
    ) -> Option<usize> {
        let (n, _) = self.dimensions();
        let direct = self.model.program().direct()?;
        let (structure, first) = (self.model.structure(), self.model.program().first());
        take_input(structure.layout(), state, input)?;
        let (ranges, coefficients) = (self.model.range_pairs(), self.model.coefficients());
        direct.hold(state.history.registers_mut(), first, ranges, coefficients)?;
        let held = first.saturating_add(direct.observables() as u8);
        let done = self.model.known().map_or(0, |known| {
            hold_known(known, self.model.program().constants(), state, held, steps, path)
        });
        for row in done..steps {
            let outputs = state.outputs.get_mut(..direct.count())?;
            let registers = state.history.registers_mut();
            let count = coefficients.len();
            let made = direct.outputs_held(registers, first, ranges, count, outputs);
            if made.and_then(|()| self.advance(direct, state)).is_none() {
                return Some(row);
            }
            state.step = state.step.saturating_add(1);
            let start = row.saturating_mul(n);
            if let Some(row) = path.get_mut(start..start.saturating_add(n)) {
                state.history.coordinates(structure, row);
            }
        }
        Some(steps)
    }

    /// States (at least 1) and inputs.
    fn dimensions(&self) -> (usize, usize) {
        let structure = self.model.structure();
        (structure.states().len().clamp(1, MAX_STATES), structure.inputs().len())
    }
}

/// As many steps as are made, their coordinates in the rows of `path`, if it is not empty.
#[inline(always)]
fn repeat<S, P>(
    present: &mut P,
    steps: usize,
    path: &mut [S],
    step: impl Fn(&mut P) -> bool,
    coordinates: impl Fn(&P) -> [S; 3],
) -> usize {
    let mut done = 0_usize;
    if path.is_empty() {
        // A loop of its own, because it is the shortest.
        while done < steps && step(present) {
            done = done.wrapping_add(1);
        }
    }
    for row in path.as_chunks_mut().0.iter_mut().take(steps) {
        if !step(present) {
            break;
        }
        *row = coordinates(present);
        done = done.wrapping_add(1);
    }
    done
}

/// As many steps as there is nothing unusual about, with the inputs held, of a model that the controller has a
/// kernel for; what the inputs have left of the coefficients begins with register `held`.
#[inline(never)]
fn hold_known<S: Scalar>(
    known: &Known<'_, S>,
    constants: &Constants,
    state: &mut PredictorState<S>,
    held: u8,
    steps: usize,
    path: &mut [S],
) -> usize {
    let (registers, held) = state.history.registers_mut().split_at_mut(held);
    let registers = registers.get_mut(FIRST.into()..).unwrap_or_default();
    let done = match known {
        Known::Drive(ranges, _) => {
            let (Some(held), Some(present)) = (held.first_chunk(), registers.first_chunk_mut())
            else {
                return 0;
            };
            let step = |present: &mut _| S::drive_held(constants, ranges, present, held);
            repeat(present, steps, path, step, |[x, y, s, c]| [*x, *y, s.atan2(*c)])
        }
        Known::Planar(..) => {
            let pose = registers.get_mut(2..).and_then(|pose| pose.first_chunk_mut());
            let (Some(held), Some(pose)) = (held.first_chunk(), pose) else { return 0 };
            let step = |pose: &mut _| S::planar_held(constants, pose, held);
            repeat(pose, steps, path, step, |[x, y, heading, _, _]| [*x, *y, *heading])
        }
    };
    state.step = state.step.saturating_add(u32::try_from(done).unwrap_or(u32::MAX));
    done
}

/// Puts the input of a step where it belongs, if it is as it should be and the model looks at the present sample
/// alone, which is there.
#[inline(always)]
fn take_input<S: Scalar>(
    layout: &Layout,
    state: &mut PredictorState<S>,
    input: &[S],
) -> Option<()> {
    if !state.history.is_of(layout) || input.len() != layout.inputs() {
        return None;
    }
    let registers = state.history.registers_mut();
    let inputs = registers.slice_mut(layout.first_input, input.len());
    for (register, u) in inputs.iter_mut().zip(input) {
        if !u.is_finite() {
            return None;
        }
        *register = *u;
    }
    Some(())
}

/// What the outputs of a step lead to, beside the state.
#[inline(never)]
fn stage<S: Scalar>(state: &mut PredictorState<S>, layout: &Layout, outputs: usize) -> Option<()> {
    let outputs = state.outputs.get(..outputs)?;
    state.history.stage(layout, outputs, &mut state.next)
}

/// The first observable outside its range.
#[cold]
#[inline(never)]
fn first_outside<S: Scalar>(
    layout: &Layout,
    registers: &Registers<S>,
    ranges: &[[S; 2]],
) -> Option<usize> {
    layout.observables.iter().zip(ranges).position(|(register, [low, high])| {
        let raw = registers.get(*register);
        !(raw >= *low && raw <= *high)
    })
}

#[inline(never)]
fn expect_inputs<S: Scalar>(expected: usize, input: &[S]) -> Result<(), PredictError> {
    expect("inputs", expected, input.len())?;
    match input.iter().position(|u| !u.is_finite()) {
        Some(input) => Err(PredictError::InputNotFinite { input }),
        None => Ok(()),
    }
}

#[inline]
fn expect(field: &'static str, expected: usize, found: usize) -> Result<(), PredictError> {
    if expected == found {
        Ok(())
    } else {
        Err(PredictError::DimensionMismatch { field, expected, found })
    }
}
