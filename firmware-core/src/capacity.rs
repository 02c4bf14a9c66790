//! What a controller built from this crate has room for.
//!
//! A blob is checked against these numbers once, when it is loaded, and a larger model is refused:
//! one with longer lists than there is room for as [unsupported](crate::blob::ParseError::Unsupported)
//! metadata, a larger dictionary or chain of terms with the field, the capacity and what was found. They bound the size of [`Model`](crate::Model) and
//! [`PredictorState`](crate::PredictorState), not of the coefficients, which stay in flash.

/// State coordinates.
pub const MAX_STATES: usize = 8;
/// Inputs.
pub const MAX_INPUTS: usize = 6;
/// Columns of the operator: one per coordinate, two for an absolute angle.
pub const MAX_OUTPUTS: usize = 2 * MAX_STATES;
/// The oldest sample a dictionary may look at, in samples before the present one.
pub const MAX_LAG: usize = 6;
/// Distinct observables of state, lagged samples and inputs.
pub const MAX_OBSERVABLES: usize = 64;
/// Kronecker blocks in the direct sum.
pub const MAX_BLOCKS: usize = 64;
/// Factors of all blocks together.
pub const MAX_FACTORS: usize = 96;
/// Factors of one block.
pub const MAX_BLOCK_FACTORS: usize = 12;
/// Highest Hermite or Fourier order of a factor.
pub const MAX_ORDER: u8 = 9;
/// Basis functions of one factor: a Fourier factor of the highest order.
pub const MAX_BASIS: usize = 2 * MAX_ORDER as usize + 1;
/// Terms of all blocks together, those held by an earlier block counted again.
pub const MAX_TERMS: usize = 4096;
/// Basis functions of all factors of a sparse model, the constant not counted. They are numbered by
/// a byte.
pub const MAX_FUNCTIONS: usize = 128;
/// Terms of a sparse model besides the constant. They are numbered by a byte; how many there is room
/// for beside the rest of a model depends on [`REGISTERS`], too.
pub const MAX_SPARSE_TERMS: usize = 255;
/// The last step that error bounds may be given for.
pub const MAX_HORIZON: u32 = 65_535;

/// Numbers that a step of a model reads and writes: the inputs, its history, centred or scaled
/// observables, and, of a sparse model, powers, harmonics and terms. They are numbered by a byte.
pub const REGISTERS: usize = 256;

/// Numbers of a model's samples, the latest inputs among them, that a control loop keeps of each of its
/// predictions: those of any model with three coordinates and two inputs, and of most others.
pub const MAX_KEPT: usize = 84;

const _: () = assert!(MAX_FUNCTIONS <= 256 && MAX_SPARSE_TERMS <= 255, "indices are bytes");
