//! What a sparse model costs on the controller: instructions of one step, bytes of its blob.

/// Instructions of the parts of one step on a Cortex-M4F; placeholders until they are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Constants {
    /// Every step.
    pub step: u32,
    /// A basis function: a power, a sine or a cosine.
    pub function: u32,
    /// A term: one product of the chain.
    pub term: u32,
    /// A coefficient: one multiply-add of one output.
    pub product: u32,
    /// A number of the history that is moved by one sample.
    pub lagged: u32,
    /// Rotating the increments of a planar pose, with the sine and cosine of its heading.
    pub se2: u32,
    /// Sine and cosine of an angle that is predicted by its increment and enters the dictionary.
    pub angle: u32,
}

/// Of a Cortex-M4F with FPU, about.
pub const CORTEX_M4F: Constants =
    Constants { step: 250, function: 6, term: 6, product: 3, lagged: 1, se2: 20, angle: 20 };

/// What the cost depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// State coordinates.
    pub states: usize,
    /// Inputs.
    pub inputs: usize,
    /// Columns of the operator.
    pub outputs: usize,
    /// Observables.
    pub observables: usize,
    /// Observables with a lag of 1 or more.
    pub lagged: usize,
    /// Functions of all factors, the constant not counted.
    pub functions: usize,
    /// Entries of the chain, the constant not counted.
    pub terms: usize,
    /// Angles predicted by increments that enter the dictionary.
    pub angles: usize,
    /// Whether the pose is se(2)-symmetric.
    pub se2: bool,
}

/// What one model takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cost {
    /// Executed instructions of one step.
    pub instructions: u32,
    /// Bytes of the blob.
    pub bytes: u32,
}

/// The cost of a sparse model.
///
/// ```
/// use trainer::cost::{CORTEX_M4F, Shape, cost};
/// let shape = Shape { states: 1, inputs: 1, outputs: 1, observables: 2, functions: 2, terms: 2, ..Shape::default() };
/// assert_eq!(cost(&CORTEX_M4F, shape).instructions, 250 + 2 * 6 + 2 * 6 + 2 * 3);
/// ```
pub fn cost(constants: &Constants, shape: Shape) -> Cost {
    let times =
        |count: usize, each: u32| u32::try_from(count).unwrap_or(u32::MAX).saturating_mul(each);
    let instructions = [
        constants.step,
        times(shape.functions, constants.function),
        times(shape.terms, constants.term),
        times(shape.terms.saturating_mul(shape.outputs), constants.product),
        times(shape.lagged, constants.lagged),
        times(shape.angles, constants.angle),
        if shape.se2 { constants.se2 } else { 0 },
    ];
    // Header, sections and provenance; names and limits; then coefficients, chain, ranges.
    let bytes = 220
        + times(shape.states + shape.inputs, 20)
        + times(shape.observables, 11 + 8 + 5)
        + times(shape.terms, 2)
        + times((shape.terms + 1).saturating_mul(shape.outputs), 4);
    Cost { instructions: instructions.into_iter().fold(0, u32::saturating_add), bytes }
}
