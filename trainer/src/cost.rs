//! What a model costs on the controller: instructions of one step, bytes of its blob.
//!
//! The instructions are a sum over what a step does, [`FEATURES`], each with a number of
//! instructions, [`CORTEX_M4F`], which was fitted to counts on an emulated Cortex-M4F.
//! `firmware-sim/cortex-m/measure` counts again and compares; `measure --fit` prints new numbers.
//! They hold for the worst path of a step that succeeds: no observable is out of range (the first
//! that is ends the check), and no angle needs the remainder of more than a turn.

use firmware_core::SparseTerms;
use firmware_core::blob;
use firmware_core::dictionary::{Basis, Source};
use firmware_core::model::{Space, Structure, Symmetry, Target};

/// What a step does, how often. Up to four outputs are summed while the terms are made, further ones
/// two by two.
pub const FEATURES: [&str; 33] = [
    "step of a model with 1 output",
    "step of a model with 2 outputs",
    "step of a model with 3 outputs",
    "step of a model with 4 outputs or more",
    "input",
    "four numbers of the history moved on",
    "observable and its range",
    "observable that is centred or scaled",
    "Fourier factor of order 2 or more",
    "sine and cosine of a harmonic from the second on",
    "power from the second on",
    "term and its product with 1 output",
    "term and its products with 2 outputs",
    "term and its products with 3 outputs",
    "term and its products with 4 outputs",
    "two further outputs",
    "term times two further outputs",
    "last further output",
    "term times the last further output",
    "coordinate on R, next value",
    "coordinate on R, change",
    "angle, next sine and cosine",
    "limits of an angle predicted by sine and cosine",
    "change of an angle predicted by sine and cosine, observed",
    "angle, change",
    "sine and cosine of an angle predicted by its change",
    "planar pose",
    "step of a dense model",
    "dense block",
    "factor of a dense block",
    "dense block and output",
    "dense coefficient, first 16 of a block",
    "dense coefficient",
];

/// Instructions of the [`FEATURES`] on a Cortex-M4F with FPU.
pub const CORTEX_M4F: [f32; FEATURES.len()] = [0.0; FEATURES.len()];

/// What one model takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cost {
    /// Executed instructions of one step.
    pub instructions: u32,
    /// Bytes of the blob, without error bounds.
    pub bytes: u32,
}

impl Cost {
    /// Of a model that the controller refuses.
    pub const REFUSED: Self = Self { instructions: u32::MAX, bytes: u32::MAX };

    /// Of a model with trained ranges: dense, or with these terms.
    pub fn new(structure: &Structure<'_>, terms: Option<SparseTerms<'_>>) -> Self {
        let bytes = blob::size(structure, terms, true);
        let instructions = instructions(structure, terms);
        Self { instructions, bytes: u32::try_from(bytes).unwrap_or(u32::MAX) }
    }
}

/// Executed instructions of one step on a Cortex-M4F.
pub fn instructions(structure: &Structure<'_>, terms: Option<SparseTerms<'_>>) -> u32 {
    let counts = features(structure, terms);
    counts.iter().zip(CORTEX_M4F).map(|(count, each)| *count as f32 * each).sum::<f32>().round()
        as u32
}

/// How often a step does each of the [`FEATURES`].
pub fn features(
    structure: &Structure<'_>,
    terms: Option<SparseTerms<'_>>,
) -> [u32; FEATURES.len()] {
    let mut counts = [0_usize; FEATURES.len()];
    let dictionary = structure.dictionary();
    let outputs = structure.outputs();
    counts[4] = structure.inputs().len();
    counts[5] = structure.delayed() / 4;
    counts[6] = dictionary.observables().len();
    match terms {
        Some(terms) => {
            let scaled = dictionary.observables().iter();
            counts[7] = scaled.filter(|o| (o.centre, o.gain) != (0.0, 1.0)).count();
            for factor in dictionary.blocks().flat_map(|(_, factors)| factors) {
                let beyond = usize::from(factor.order) - 1;
                match factor.basis {
                    Basis::Hermite => counts[10] += beyond,
                    Basis::Fourier => {
                        counts[8] += usize::from(beyond > 0);
                        counts[9] += beyond;
                    }
                }
            }
            let (together, count) = (outputs.clamp(1, 4) - 1, terms.count() - 1);
            counts[together] = 1;
            counts[11 + together] = count;
            let later = outputs.saturating_sub(4);
            (counts[15], counts[16]) = (later / 2, later / 2 * count);
            (counts[17], counts[18]) = (later % 2, later % 2 * count);
        }
        None => {
            counts[7] = dictionary.observables().len();
            counts[27] = 1;
            for (_, factors) in dictionary.blocks() {
                let size: usize = factors.iter().map(|f| f.radix()).product();
                counts[28] += 1;
                counts[29] += factors.len();
                counts[30] += outputs;
                counts[31] += outputs * size.min(16);
                counts[32] += outputs * size;
            }
        }
    }
    let observed = |source: Source| dictionary.observables().iter().any(|o| o.source == source);
    for (i, state) in (0_u8..).zip(structure.states()) {
        let heading = matches!(structure.symmetry(), Symmetry::Se2 { heading, .. } if heading == i);
        let turns = heading || observed(Source::Sin(i)) || observed(Source::Cos(i));
        match (state.space, state.target) {
            (Space::Line, Target::Absolute) => counts[19] += 1,
            (Space::Line, Target::Increment) => counts[20] += 1,
            (Space::Circle, Target::Absolute) => {
                let [low, high] = state.limit;
                let limited = low > -std::f32::consts::PI || high < std::f32::consts::PI;
                counts[21] += 1;
                counts[22] += usize::from(limited);
                counts[23] += usize::from(observed(Source::Increment(i)));
            }
            (Space::Circle, Target::Increment) => {
                counts[24] += 1;
                counts[25] += usize::from(turns);
            }
        }
    }
    counts[26] = usize::from(matches!(structure.symmetry(), Symmetry::Se2 { .. }));
    counts.map(|count| u32::try_from(count).unwrap_or(u32::MAX))
}
