//! Models of the paper's robots (Shi & Karydis 2021) in the shapes that it gives them, with coefficients that
//! are all over the place instead of fitted ones: for counting instructions and comparing bits.

use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};

/// Room for the coefficients of the largest.
pub const COEFFICIENTS: usize = 256;

/// A shape: coordinates, inputs, and what enters the dictionary, one Kronecker block, with its order.
pub struct Shape {
    pub name: &'static str,
    states: &'static [State<'static>],
    inputs: &'static [&'static str],
    symmetry: Symmetry,
    order: u8,
    sources: &'static [Source],
    /// Centre and gain of each source, as `standardise` makes them.
    pub scaling: &'static [[f32; 2]],
    /// Their trained ranges.
    ranges: &'static [[f32; 2]],
}

const fn on_line(name: &'static str, unit: &'static str, target: Target) -> State<'static> {
    State { name, unit, space: Space::Line, target, limit: [-40.0, 40.0] }
}

/// As `fit` leaves an angle.
const fn angle(target: Target) -> State<'static> {
    let limit = [f32::NEG_INFINITY, f32::INFINITY];
    State { name: "phi", unit: "rad", space: Space::Circle, target, limit }
}

/// Differential drive, all of order 1: 64 terms, four outputs.
pub const DRIVE: Shape = Shape {
    name: "paper-drive",
    states: &[
        on_line("x", "m", Target::Absolute),
        on_line("y", "m", Target::Absolute),
        angle(Target::Absolute),
    ],
    inputs: &["omega_r", "omega_l"],
    symmetry: Symmetry::None,
    order: 1,
    sources: &[
        Source::State(0),
        Source::State(1),
        Source::Sin(2),
        Source::Cos(2),
        Source::Input(0),
        Source::Input(1),
    ],
    scaling: &[[0.3, 1.9], [-0.2, 1.7], [0.0, 1.0], [0.0, 1.0], [5.0, 0.13], [4.0, 0.25]],
    ranges: &[[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.0], [-1.0, 1.0], [-60.0, 60.0], [-60.0, 60.0]],
};

/// The same robot by what it does in its own frame, order 3 in the wheel speeds: 16 terms, three outputs.
pub const DRIVE_SE2: Shape = Shape {
    name: "paper-drive-se2",
    states: &[
        on_line("x", "m", Target::Increment),
        on_line("y", "m", Target::Increment),
        angle(Target::Increment),
    ],
    inputs: &["omega_r", "omega_l"],
    symmetry: Symmetry::Se2 { x: 0, y: 1, heading: 2 },
    order: 3,
    sources: &[Source::Input(0), Source::Input(1)],
    scaling: &[[5.0, 0.13], [4.0, 0.25]],
    ranges: &[[-60.0, 60.0], [-60.0, 60.0]],
};

/// Soft leg, all of order 1: 16 terms, two outputs.
pub const LEG: Shape = Shape {
    name: "paper-leg",
    states: &[on_line("y", "mm", Target::Absolute), on_line("z", "mm", Target::Absolute)],
    inputs: &["bending", "extension"],
    symmetry: Symmetry::None,
    order: 1,
    sources: &[Source::State(0), Source::State(1), Source::Input(0), Source::Input(1)],
    scaling: &[[0.3, 1.9], [-0.2, 1.7], [0.5, 0.23], [-0.4, 0.25]],
    ranges: &[[-4.0, 4.0], [-4.0, 4.0], [-60.0, 60.0], [-60.0, 60.0]],
};

// Not every image counts all of them.
#[allow(dead_code)]
pub const SHAPES: [Shape; 3] = [DRIVE, DRIVE_SE2, LEG];

impl Shape {
    /// The model; its coefficients are put into `room`.
    pub fn model<'a>(&'a self, room: &'a mut [f32; COEFFICIENTS]) -> Option<Model<'a>> {
        let structure = self.structure()?;
        let terms = structure.dictionary().dense_terms();
        let coefficients = room.get_mut(..terms * structure.outputs())?;
        self.fill(coefficients, terms);
        Model::new(structure, coefficients, Some(self.ranges.as_flattened())).ok()
    }

    /// What a robot standing still would need, and every term besides.
    fn fill(&self, coefficients: &mut [f32], terms: usize) {
        let mut bits = 1_u32;
        for coefficient in &mut *coefficients {
            // xorshift (Marsaglia 2003). At least a hundredth, that no term goes unnoticed.
            bits ^= bits << 13;
            bits ^= bits >> 17;
            bits ^= bits << 5;
            let size = 0.01 + 0.02 * (bits >> 8) as f32 / 16_777_216.0;
            *coefficient = if bits & 1 == 0 { size } else { -size };
        }
        // Every output that is a next value is that of the same source before.
        let next = self.sources.iter().zip(self.scaling).enumerate();
        let next = next.filter(|(_, (source, _))| !matches!(source, Source::Input(_)));
        for ((i, (_, [centre, gain])), row) in next.zip(coefficients.chunks_exact_mut(terms)) {
            row[0] += centre;
            row[self.term(i)] += 1.0 / gain;
        }
    }

    /// The term of a source alone; all have order 1, and the first one is the slowest.
    pub fn term(&self, source: usize) -> usize {
        1 << (self.sources.len() - 1 - source)
    }

    fn structure(&self) -> Option<Structure<'_>> {
        let input = |name| Input { name, unit: "", range: [-60.0, 60.0] };
        let observables = self.sources.iter().zip(self.scaling);
        let observables = observables.map(|(source, [centre, gain])| {
            let (centre, gain) = (*centre, *gain);
            Observable { source: *source, lag: 0, centre, gain }
        });
        let factors = (0..self.sources.len() as u8).map(|observable| Factor {
            observable,
            basis: Basis::Hermite,
            order: self.order,
        });
        Structure::try_from(ModelRepr {
            robot: self.name,
            sample_time_s: 0.1,
            states: self.states.iter().copied().collect(),
            inputs: self.inputs.iter().copied().map(input).collect(),
            symmetry: self.symmetry,
            observables: observables.collect(),
            factors: factors.collect(),
            blocks: [Block { factors: self.sources.len() as u8, max_degree: 0 }]
                .into_iter()
                .collect(),
            provenance: Provenance { logs: [0; 32], robot: [0; 32] },
        })
        .ok()
    }
}
