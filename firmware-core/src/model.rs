//! What a model is: [`ModelRepr`] is what the bytes say, [`Structure`] is that checked, and
//! [`Model`] is a structure with its coefficients.

use core::cmp::Ordering;

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::Scalar;
use crate::capacity::{MAX_BLOCKS, MAX_FACTORS, MAX_INPUTS, MAX_LAG, MAX_OBSERVABLES, MAX_STATES};
use crate::dictionary::{Block, Dictionary, DictionaryError, Factor, Observable, Source};
use crate::encoding::{ReadError, Reader};
use crate::error_bounds::ErrorBounds;
use crate::kernel::{Known, Program};
use crate::registers::{GROUP, Layout};
use crate::sparse::{SparseError, SparseTerms};

/// Where a state coordinate lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Space {
    /// The real line ℝ.
    Line,
    /// The circle S¹; the coordinate is an angle in radians.
    Circle,
}

impl Space {
    /// `to` − `from`, the short way round on S¹: in (−π, π].
    ///
    /// ```
    /// use firmware_core::model::Space;
    /// assert_eq!(Space::Line.difference(3.0, -3.0), 6.0);
    /// let short = Space::Circle.difference(3.0, -3.0);
    /// assert!((short - (6.0 - core::f64::consts::TAU)).abs() < 1e-15);
    /// ```
    #[inline]
    pub fn difference<S: Scalar>(self, to: S, from: S) -> S {
        let difference = to - from;
        match self {
            Self::Line => difference,
            Self::Circle => difference.wrap(),
        }
    }
}

/// What the operator's output for a coordinate stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Target {
    /// The coordinate at the next sample; its sine and cosine (two outputs) on S¹.
    Absolute,
    /// Its change over the step, wrapped on S¹.
    Increment,
}

/// A state coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct State<'a> {
    /// Name, such as `phi`.
    pub name: &'a str,
    /// Unit, such as `rad`.
    pub unit: &'a str,
    /// ℝ or S¹.
    pub space: Space,
    /// Next value or change.
    pub target: Target,
    /// A prediction outside `[low, high]`, in the coordinate's unit, has diverged. Infinite bounds
    /// are no bounds.
    pub limit: [f32; 2],
}

/// An input.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Input<'a> {
    /// Name, such as `omega_r`.
    pub name: &'a str,
    /// Unit, such as `rad/s`.
    pub unit: &'a str,
    /// The range that the actuator accepts, in its unit.
    pub range: [f32; 2],
}

/// What the robot's motion does not depend on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Symmetry {
    /// Every coordinate may enter the dictionary.
    None,
    /// These coordinates (bit i is coordinate i) do not enter it.
    Translation {
        /// One bit per coordinate.
        coordinates: u8,
    },
    /// A planar pose does not enter it; its increments are expressed in the body frame: with
    /// (Δx, Δy) the displacement over a step, the outputs are (c Δx + s Δy, −s Δx + c Δy, Δφ) with
    /// s, c the sine and cosine of the heading at the beginning of the step.
    Se2 {
        /// Coordinate on ℝ along the first world axis.
        x: u8,
        /// Coordinate on ℝ along the second world axis.
        y: u8,
        /// Heading on S¹, from the first axis towards the second.
        heading: u8,
    },
}

impl Symmetry {
    /// Whether the coordinate may not enter the dictionary.
    pub fn excludes(self, coordinate: u8) -> bool {
        match self {
            Self::None => false,
            Self::Translation { coordinates } => {
                coordinates.checked_shr(coordinate.into()).unwrap_or(0) & 1 == 1
            }
            Self::Se2 { x, y, heading } => [x, y, heading].contains(&coordinate),
        }
    }
}

/// What a model was made from, as SHA-256.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Of the logs: every file's length (u64, little-endian) and bytes, in the order of the names.
    pub logs: [u8; 32],
    /// Of the robot description.
    pub robot: [u8; 32],
}

/// The metadata of a model as the blob holds it, not yet checked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelRepr<'a> {
    /// The robot that the model belongs to.
    pub robot: &'a str,
    /// Time between samples \[s\].
    pub sample_time_s: f32,
    /// State coordinates.
    #[serde(borrow)]
    pub states: Vec<State<'a>, MAX_STATES>,
    /// Inputs.
    #[serde(borrow)]
    pub inputs: Vec<Input<'a>, MAX_INPUTS>,
    /// Symmetry.
    pub symmetry: Symmetry,
    /// Observables of the dictionary.
    pub observables: Vec<Observable, MAX_OBSERVABLES>,
    /// Factors of all blocks, in order.
    pub factors: Vec<Factor, MAX_FACTORS>,
    /// Kronecker blocks.
    pub blocks: Vec<Block, MAX_BLOCKS>,
    /// What it was made from.
    pub provenance: Provenance,
}

/// Why metadata and coefficients do not make a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ModelError {
    /// There is no state coordinate.
    NoState,
    /// The sample time is not a positive finite number.
    SampleTime,
    /// A limit, range, centre or gain is not usable: NaN, empty, or zero.
    Number {
        /// Which field.
        field: &'static str,
        /// Index of the state, input or observable.
        index: usize,
    },
    /// The symmetry names coordinates that are not there, live in the wrong space, or are not
    /// predicted by increments.
    Symmetry {
        /// Index of the coordinate.
        coordinate: u8,
    },
    /// An observable reads something that is not there, that the symmetry excludes, or that does
    /// not live in its space.
    Observable {
        /// Index of the observable.
        observable: usize,
    },
    /// The dictionary does not hold together.
    Dictionary(DictionaryError),
    /// The terms of a sparse model are not products of functions that are there.
    Sparse(SparseError),
    /// Some number of elements is not what the metadata asks for.
    DimensionMismatch {
        /// Which one.
        field: &'static str,
        /// As the metadata says.
        expected: usize,
        /// As found.
        found: usize,
    },
    /// A coefficient is NaN or infinite.
    NotFinite {
        /// Its index, outputs slowest.
        coefficient: usize,
    },
}

impl From<DictionaryError> for ModelError {
    fn from(error: DictionaryError) -> Self {
        Self::Dictionary(error)
    }
}

impl From<SparseError> for ModelError {
    fn from(error: SparseError) -> Self {
        Self::Sparse(error)
    }
}

/// A checked model without its coefficients: spaces, symmetry, targets, dictionary.
#[derive(Clone, Debug, PartialEq)]
pub struct Structure<'a> {
    robot: &'a str,
    sample_time_s: f32,
    states: Vec<State<'a>, MAX_STATES>,
    inputs: Vec<Input<'a>, MAX_INPUTS>,
    symmetry: Symmetry,
    dictionary: Dictionary,
    provenance: Provenance,
    outputs: u8,
    lag: u8,
    /// Bit i: the sine and cosine of coordinate i are needed.
    trigonometric: u8,
    layout: Layout,
}

impl<'a> TryFrom<ModelRepr<'a>> for Structure<'a> {
    type Error = ModelError;

    fn try_from(repr: ModelRepr<'a>) -> Result<Self, ModelError> {
        let ModelRepr {
            robot,
            sample_time_s,
            states,
            inputs,
            symmetry,
            observables,
            factors,
            blocks,
            provenance,
        } = repr;
        let mut structure =
            Self { robot, sample_time_s, states, inputs, symmetry, provenance, ..Self::empty() };
        // What is wrong with the dictionary is looked at when its turn comes.
        structure.dictionary = Dictionary::unchecked(observables, factors, blocks);
        structure.check::<ModelError>()?;
        structure.lay_out();
        Ok(structure)
    }
}

impl<'a> Structure<'a> {
    /// Of nothing, to be [read](Self::read) over.
    pub(crate) const fn empty() -> Self {
        Self {
            robot: "",
            sample_time_s: 0.0,
            states: Vec::new(),
            inputs: Vec::new(),
            symmetry: Symmetry::None,
            dictionary: Dictionary::empty(),
            provenance: Provenance { logs: [0; 32], robot: [0; 32] },
            outputs: 0,
            lag: 0,
            trigonometric: 0,
            layout: Layout::empty(),
        }
    }

    fn clear(&mut self) {
        let Self { robot, sample_time_s, states, inputs, symmetry, dictionary, provenance, .. } =
            self;
        (*robot, *sample_time_s, *symmetry) = ("", 0.0, Symmetry::None);
        states.clear();
        inputs.clear();
        dictionary.clear();
        provenance.logs.fill(0);
        provenance.robot.fill(0);
        (self.outputs, self.lag, self.trigonometric) = (0, 0, 0);
        self.layout.clear();
    }

    /// The metadata of a blob as they are, a [`ModelRepr`], to be [checked](Self::check).
    #[inline(always)]
    pub(crate) fn read(&mut self, bytes: &'a [u8]) -> Result<(), ReadError> {
        let mut reader = Reader::new(bytes);
        self.read_spaces(&mut reader);
        self.dictionary.read(&mut reader);
        reader.copy(&mut self.provenance.logs);
        reader.copy(&mut self.provenance.robot);
        reader.end()
    }

    /// What is in front of the dictionary.
    #[inline(never)]
    fn read_spaces(&mut self, reader: &mut Reader<'a>) {
        self.robot = reader.text();
        self.sample_time_s = reader.number();
        reader.list(&mut self.states, |reader| {
            let (name, unit) = (reader.text(), reader.text());
            let space = match reader.variant(2) {
                0 => Space::Line,
                _ => Space::Circle,
            };
            let target = match reader.variant(2) {
                0 => Target::Absolute,
                _ => Target::Increment,
            };
            State { name, unit, space, target, limit: [reader.number(), reader.number()] }
        });
        reader.list(&mut self.inputs, |reader| {
            let (name, unit) = (reader.text(), reader.text());
            Input { name, unit, range: [reader.number(), reader.number()] }
        });
        self.symmetry = match reader.variant(3) {
            0 => Symmetry::None,
            1 => Symmetry::Translation { coordinates: reader.byte() },
            _ => Symmetry::Se2 { x: reader.byte(), y: reader.byte(), heading: reader.byte() },
        };
    }

    /// Checks what was read; it is to be [laid out](Self::lay_out) then.
    ///
    /// Like what it consists of, and what follows when a blob is loaded, it has the error of whoever asks:
    /// every other one would have a place on the stack of its own.
    #[inline(always)]
    pub(crate) fn check<E>(&mut self) -> Result<(), E>
    where
        E: From<ModelError> + From<DictionaryError>,
    {
        self.check_spaces::<E>()?;
        self.check_dictionary::<E>()?;
        self.check_observables()
    }

    /// Part of it, as the one before and the one behind it.
    #[inline(always)]
    pub(crate) fn check_dictionary<E: From<DictionaryError>>(&mut self) -> Result<(), E> {
        self.dictionary.check()
    }

    /// Where a history keeps what was checked.
    #[inline(never)]
    pub(crate) fn lay_out(&mut self) {
        let observables = self.dictionary.observables();
        let (inputs, symmetry) = (self.inputs.len(), self.symmetry);
        self.layout.fill(&self.states, inputs, symmetry, observables, self.trigonometric);
    }

    #[inline(never)]
    pub(crate) fn check_spaces<E: From<ModelError>>(&mut self) -> Result<(), E> {
        if self.states.is_empty() {
            return Err(ModelError::NoState.into());
        }
        if !(self.sample_time_s > 0.0 && self.sample_time_s <= f32::MAX) {
            return Err(ModelError::SampleTime.into());
        }
        (self.outputs, self.trigonometric) = (0, 0);
        for (index, state) in self.states.iter().enumerate() {
            let [low, high] = state.limit;
            if low.partial_cmp(&high) != Some(Ordering::Less) {
                return Err(ModelError::Number { field: "limit of a state", index }.into());
            }
            let absolute_angle = (state.space, state.target) == (Space::Circle, Target::Absolute);
            self.outputs = self.outputs.saturating_add(if absolute_angle { 2 } else { 1 });
            if absolute_angle {
                self.trigonometric |= bit(index);
            }
        }
        for (index, input) in self.inputs.iter().enumerate() {
            let [low, high] = input.range;
            if !(f32::MIN <= low && low < high && high <= f32::MAX) {
                return Err(ModelError::Number { field: "range of an input", index }.into());
            }
        }
        check_symmetry(self.symmetry, &self.states)?;
        if let Symmetry::Se2 { heading, .. } = self.symmetry {
            self.trigonometric |= bit(heading.into());
        }
        Ok(())
    }

    #[inline(never)]
    pub(crate) fn check_observables<E: From<ModelError>>(&mut self) -> Result<(), E> {
        self.lag = 0;
        for (index, o) in self.dictionary.observables().iter().enumerate() {
            let space = |i: u8| self.states.get(usize::from(i)).map(|s| s.space);
            let free = |i: u8| !self.symmetry.excludes(i);
            let fits = match o.source {
                Source::State(i) => space(i) == Some(Space::Line) && free(i),
                Source::Sin(i) | Source::Cos(i) => {
                    self.trigonometric |= bit(i.into());
                    space(i) == Some(Space::Circle) && free(i) && (o.centre, o.gain) == (0.0, 1.0)
                }
                Source::Increment(i) => space(i).is_some() && o.lag > 0,
                Source::Input(i) => usize::from(i) < self.inputs.len(),
            };
            if !fits || usize::from(o.lag) > MAX_LAG {
                return Err(ModelError::Observable { observable: index }.into());
            }
            if !(o.centre.is_finite() && o.gain.abs() > 0.0 && o.gain.abs() <= f32::MAX) {
                let field = "centre or gain of an observable";
                return Err(ModelError::Number { field, index }.into());
            }
            self.lag = self.lag.max(o.lag);
        }
        Ok(())
    }
}

fn check_symmetry(symmetry: Symmetry, states: &[State<'_>]) -> Result<(), ModelError> {
    let fits = |coordinate: u8, space: Option<Space>| {
        let found = states.get(usize::from(coordinate));
        match found {
            Some(s) if s.target == Target::Increment && space.is_none_or(|e| e == s.space) => {
                Ok(())
            }
            _ => Err(ModelError::Symmetry { coordinate }),
        }
    };
    match symmetry {
        Symmetry::None => Ok(()),
        Symmetry::Translation { .. } => {
            (0..8).filter(|i| symmetry.excludes(*i)).try_for_each(|i| fits(i, None))
        }
        Symmetry::Se2 { x, y, heading } => {
            fits(x, Some(Space::Line))?;
            fits(y, Some(Space::Line))?;
            fits(heading, Some(Space::Circle))?;
            if x == y { Err(ModelError::Symmetry { coordinate: y }) } else { Ok(()) }
        }
    }
}

/// Bit `index` of a set of coordinates; there are at most eight.
#[inline]
fn bit(index: usize) -> u8 {
    u32::try_from(index).ok().and_then(|i| 1_u8.checked_shl(i)).unwrap_or(0)
}

impl<'a> Structure<'a> {
    /// The robot that the model belongs to.
    pub fn robot(&self) -> &'a str {
        self.robot
    }

    /// Time between samples \[s\].
    pub fn sample_time_s(&self) -> f32 {
        self.sample_time_s
    }

    /// State coordinates, in order.
    #[inline]
    pub fn states(&self) -> &[State<'a>] {
        &self.states
    }

    /// Inputs, in order.
    #[inline]
    pub fn inputs(&self) -> &[Input<'a>] {
        &self.inputs
    }

    /// Symmetry.
    #[inline]
    pub fn symmetry(&self) -> Symmetry {
        self.symmetry
    }

    /// The dictionary.
    #[inline]
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// What the model was made from.
    pub fn provenance(&self) -> Provenance {
        self.provenance
    }

    /// Columns of the operator: one per coordinate, two for an absolute angle (sine, cosine).
    #[inline]
    pub fn outputs(&self) -> usize {
        self.outputs.into()
    }

    /// The oldest sample that the dictionary looks at, in samples before the present one.
    #[inline]
    pub fn lag(&self) -> usize {
        self.lag.into()
    }

    /// Whether sine and cosine of a coordinate are needed.
    #[inline]
    pub(crate) fn needs_trigonometry(&self, coordinate: usize) -> bool {
        self.trigonometric & bit(coordinate) != 0
    }

    /// Where a history keeps everything.
    #[inline]
    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Numbers of the history that a step moves on by one sample: a multiple of four.
    pub fn delayed(&self) -> usize {
        usize::from(self.layout.groups).saturating_mul(GROUP)
    }

    /// Coordinates, sines, cosines, changes and inputs of which earlier samples are kept.
    pub fn delay_lines(&self) -> usize {
        self.layout.heads.len()
    }

    /// Whether a model of this structure, dense or with these terms, gets by with the
    /// [registers](crate::capacity::REGISTERS) there are.
    ///
    /// # Errors
    /// [`ModelError`] with what it would take.
    pub fn fits(&self, terms: Option<SparseTerms<'_>>) -> Result<(), ModelError> {
        let mut program = Program::empty();
        program.fill(self, terms)
    }

    /// The metadata again, as a blob holds it.
    pub fn to_repr(&self) -> ModelRepr<'a> {
        let mut repr = ModelRepr {
            robot: self.robot,
            sample_time_s: self.sample_time_s,
            states: self.states.clone(),
            inputs: self.inputs.clone(),
            symmetry: self.symmetry,
            observables: Vec::new(),
            factors: Vec::new(),
            blocks: Vec::new(),
            provenance: self.provenance,
        };
        // The same capacities: nothing can be lost.
        let _ = repr.observables.extend_from_slice(self.dictionary.observables());
        for (block, factors) in self.dictionary.blocks() {
            let _ = repr.blocks.push(block);
            let _ = repr.factors.extend_from_slice(factors);
        }
        repr
    }
}

/// A model that can predict: checked once, immutable, its coefficients read in place.
#[derive(Clone, Debug, PartialEq)]
pub struct Model<'a, S = f32> {
    structure: Structure<'a>,
    terms: Option<SparseTerms<'a>>,
    /// How the registers are computed.
    program: Program,
    /// Set if a controller may have a kernel for the whole model.
    known: Option<Known<'a, S>>,
    coefficients: &'a [S],
    ranges: Option<&'a [[S; 2]]>,
    error_bounds: Option<ErrorBounds<'a>>,
}

impl<'a, S: Scalar> Model<'a, S> {
    /// Joins a structure and the coefficients of all terms of its blocks: a dense model.
    ///
    /// `coefficients` has shape `[outputs, dense_terms]`, outputs slowest: the operator F of
    /// z⁺ = Ψ F, transposed, in the *monomial* form of the dictionary (powers of the observables
    /// where the lift has Hermite polynomials). `ranges`, shape `[observables, 2]`, is the smallest
    /// and largest raw value of each observable in the training data.
    ///
    /// # Errors
    /// [`ModelError::DimensionMismatch`], [`ModelError::NotFinite`], or [`ModelError::Number`] for a
    /// range that is NaN or the wrong way round.
    pub fn new(
        structure: Structure<'a>,
        coefficients: &'a [S],
        ranges: Option<&'a [S]>,
    ) -> Result<Self, ModelError> {
        let mut model = Self { structure, ..Self::empty() };
        model.join(None, coefficients, ranges)?;
        Ok(model)
    }

    /// Joins a structure whose blocks are single factors, a chain of products of their functions and
    /// its coefficients: a [sparse](crate::sparse) model.
    ///
    /// `terms` are `[parent, function]` of terms 1, 2, …; `coefficients` has shape
    /// `[outputs, terms + 1]`, outputs slowest, the constant first; `ranges` are as in
    /// [`new`](Self::new).
    ///
    /// # Errors
    /// [`ModelError::Sparse`], and as [`new`](Self::new).
    ///
    /// ```
    /// use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
    /// use firmware_core::model::{Input, Model, ModelRepr, Provenance, Space, State, Structure};
    /// use firmware_core::model::{Symmetry, Target};
    /// use firmware_core::{Predictor, PredictorState};
    ///
    /// // x⁺ = x + 0.5 x² u. Functions of x: 0 is x, 1 is x². Functions of u: 2 is u.
    /// let observable = |source| Observable { source, lag: 0, centre: 0.0, gain: 1.0 };
    /// let factor = |observable, order| Factor { observable, basis: Basis::Hermite, order };
    /// let structure = Structure::try_from(ModelRepr {
    ///     robot: "cart",
    ///     sample_time_s: 0.1,
    ///     states: [State {
    ///         name: "x", unit: "m", space: Space::Line, target: Target::Absolute, limit: [-9.0, 9.0],
    ///     }].into_iter().collect(),
    ///     inputs: [Input { name: "u", unit: "V", range: [-1.0, 1.0] }].into_iter().collect(),
    ///     symmetry: Symmetry::None,
    ///     observables: [observable(Source::State(0)), observable(Source::Input(0))].into_iter().collect(),
    ///     factors: [factor(0, 2), factor(1, 1)].into_iter().collect(),
    ///     blocks: [Block { factors: 1, max_degree: 0 }; 2].into_iter().collect(),
    ///     provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    /// }).unwrap();
    /// // Terms 1, x, x², x²·u.
    /// let terms = [[0, 0], [0, 1], [2, 2]];
    /// let coefficients = [0.0_f32, 1.0, 0.0, 0.5];
    /// let model = Model::new_sparse(structure, &terms, &coefficients, None).unwrap();
    ///
    /// let predictor = Predictor::new(&model);
    /// let mut state = PredictorState::new();
    /// predictor.observe(&mut state, &[], &[2.0]).unwrap();
    /// let mut x = [0.0; 2];
    /// predictor.rollout(&mut state, &[1.0, -0.25], &mut x).unwrap();
    /// assert_eq!(x, [4.0, 2.0]); // 2 + 0.5 · 4 · 1, 4 − 0.5 · 16 · 0.25
    /// ```
    pub fn new_sparse(
        structure: Structure<'a>,
        terms: &'a [[u8; 2]],
        coefficients: &'a [S],
        ranges: Option<&'a [S]>,
    ) -> Result<Self, ModelError> {
        let mut model = Self { structure, ..Self::empty() };
        model.join(Some(terms), coefficients, ranges)?;
        Ok(model)
    }

    /// A model of nothing, which predicts nothing: where
    /// [`parse_into`](crate::blob::parse_into) puts one.
    pub const fn empty() -> Self {
        Self {
            structure: Structure::empty(),
            terms: None,
            program: Program::empty(),
            known: None,
            coefficients: &[],
            ranges: None,
            error_bounds: None,
        }
    }

    /// Becomes [empty](Self::empty) in place.
    #[inline(never)]
    pub(crate) fn clear(&mut self) {
        let Self { structure, terms, program, known, coefficients, ranges, error_bounds } = self;
        structure.clear();
        program.clear();
        (*terms, *known, *ranges, *error_bounds) = (None, None, None, None);
        *coefficients = &[];
    }

    /// The structure, to be read and checked before anything else is taken.
    pub(crate) fn structure_mut(&mut self) -> &mut Structure<'a> {
        &mut self.structure
    }

    /// Joins the structure, which has been checked, with its coefficients: a dense model, or a sparse
    /// one with these terms.
    pub(crate) fn join(
        &mut self,
        terms: Option<&'a [[u8; 2]]>,
        coefficients: &'a [S],
        ranges: Option<&'a [S]>,
    ) -> Result<(), ModelError> {
        self.take_terms(terms)?;
        self.lay_out::<ModelError>()?;
        self.complete();
        self.take_numbers(coefficients, ranges)
    }

    /// The terms of a sparse model, or that there are none.
    #[inline]
    pub(crate) fn take_terms(&mut self, terms: Option<&'a [[u8; 2]]>) -> Result<(), SparseError> {
        let dictionary = self.structure.dictionary();
        self.terms = terms.map(|terms| SparseTerms::new(dictionary, terms)).transpose()?;
        Ok(())
    }

    /// What the registers are, once structure and terms are there.
    pub(crate) fn lay_out<E: From<ModelError>>(&mut self) -> Result<(), E> {
        self.program.fill(&self.structure, self.terms)
    }

    /// The rest of the program, once the registers are known.
    #[inline]
    pub(crate) fn complete(&mut self) {
        self.program.complete(&self.structure, self.terms);
    }

    /// Coefficients and trained ranges of a model with its terms. Error bounds come later.
    #[inline]
    pub(crate) fn take_numbers<E: From<ModelError>>(
        &mut self,
        coefficients: &'a [S],
        ranges: Option<&'a [S]>,
    ) -> Result<(), E> {
        self.error_bounds = None;
        self.coefficients = coefficients;
        self.ranges = ranges.map(|ranges| ranges.as_chunks().0);
        let structure = &self.structure;
        // Small numbers, all of them: nothing wraps.
        let expected = structure.outputs().wrapping_mul(self.coefficients_per_output());
        let mismatch =
            |field, expected, found| ModelError::DimensionMismatch { field, expected, found };
        if coefficients.len() != expected {
            return Err(mismatch("coefficients", expected, coefficients.len()).into());
        }
        if let Some(coefficient) = coefficients.iter().position(|c| !c.is_finite()) {
            return Err(ModelError::NotFinite { coefficient }.into());
        }
        if let Some(ranges) = ranges {
            let expected = structure.dictionary().observables().len().wrapping_mul(2);
            if ranges.len() != expected {
                return Err(mismatch("ranges", expected, ranges.len()).into());
            }
            let (pairs, _) = ranges.as_chunks::<2>();
            // Of what is not a number nothing is true.
            let is_range = |[low, high]: &[S; 2]| low <= high;
            if let Some(index) = pairs.iter().position(|pair| !is_range(pair)) {
                let field = "trained range of an observable";
                return Err(ModelError::Number { field, index }.into());
            }
        }
        self.known = match (self.program.direct(), self.ranges) {
            (Some(direct), Some(ranges)) => {
                Known::new(&self.structure, direct, ranges, coefficients)
            }
            _ => None,
        };
        Ok(())
    }

    /// The same model with these error bounds instead of any it has.
    ///
    /// # Errors
    /// [`ModelError::DimensionMismatch`] if they are for another number of state coordinates.
    pub fn with_error_bounds(mut self, error_bounds: ErrorBounds<'a>) -> Result<Self, ModelError> {
        self.set_error_bounds::<ModelError>(error_bounds)?;
        Ok(self)
    }

    /// The same in place.
    pub(crate) fn set_error_bounds<E: From<ModelError>>(
        &mut self,
        error_bounds: ErrorBounds<'a>,
    ) -> Result<(), E> {
        let (expected, found) = (self.structure.states().len(), error_bounds.states());
        if expected != found {
            let field = "states of the error bounds";
            return Err(ModelError::DimensionMismatch { field, expected, found }.into());
        }
        self.error_bounds = Some(error_bounds);
        Ok(())
    }

    /// Everything but the numbers.
    #[inline]
    pub fn structure(&self) -> &Structure<'a> {
        &self.structure
    }

    /// The terms of a sparse model; `None` for a dense one, which has all terms of its dictionary.
    #[inline]
    pub fn terms(&self) -> Option<SparseTerms<'a>> {
        self.terms
    }

    /// How the registers are computed.
    #[inline]
    pub(crate) fn program(&self) -> &Program {
        &self.program
    }

    /// The model as a controller may have a kernel for it.
    #[inline]
    pub(crate) fn known(&self) -> Option<&Known<'a, S>> {
        self.known.as_ref()
    }

    /// Coefficients per output: dense terms of the dictionary, or sparse terms with the constant.
    #[inline]
    pub fn coefficients_per_output(&self) -> usize {
        self.terms.map_or(self.structure.dictionary().dense_terms(), |terms| terms.count())
    }

    /// Shape `[outputs, coefficients_per_output]`, outputs slowest.
    #[inline]
    pub fn coefficients(&self) -> &'a [S] {
        self.coefficients
    }

    /// Smallest and largest raw value of every observable in the training data.
    #[inline]
    pub fn ranges(&self) -> Option<&'a [S]> {
        self.ranges.map(|pairs| pairs.as_flattened())
    }

    /// The same, `[smallest, largest]` of every observable; none if they are not known.
    #[inline]
    pub(crate) fn range_pairs(&self) -> &'a [[S; 2]] {
        self.ranges.unwrap_or(&[])
    }

    /// How far off the predictions may be, if that was measured.
    #[inline]
    pub fn error_bounds(&self) -> Option<ErrorBounds<'a>> {
        self.error_bounds
    }
}
