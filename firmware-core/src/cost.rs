//! What a model costs on the controller: instructions of one step, bytes of its blob.
//!
//! The instructions are a sum over the [`parts`] of a step, each with a number of instructions that
//! was fitted to counts on an emulated Cortex-M4F. `firmware-sim/cortex-m/measure` counts again and
//! compares; `measure --fit` prints new numbers. They hold for the worst path of a step that
//! succeeds and stays in range: the first step that leaves it also looks for the observable, and an
//! angle that turns beyond half a turn takes a remainder.

use crate::SparseTerms;
use crate::blob;
use crate::dictionary::{Basis, Factor, Source};
use crate::kernel::{Direct, Shape};
use crate::model::{Space, State, Structure, Symmetry, Target};

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
        Self {
            instructions: instructions(structure, terms),
            bytes: u32::try_from(bytes).unwrap_or(u32::MAX),
        }
    }
}

/// Executed instructions of one step on a Cortex-M4F.
///
/// ```
/// use firmware_core::SparseTerms;
/// use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
/// use firmware_core::model::{Input, ModelRepr, Provenance, Space, State, Structure};
/// use firmware_core::model::{Symmetry, Target};
///
/// // A planar robot with 12 observables, each of them a term: two inputs at the present and the three
/// // samples before, the changes of the pose before the present sample, and one of them before that.
/// let state = |name, space| State {
///     name, unit: "", space, target: Target::Increment, limit: [f32::MIN, f32::MAX],
/// };
/// let input = |name| Input { name, unit: "", range: [-1.0, 1.0] };
/// let inputs = (0..8).map(|i| (Source::Input(i % 2), i / 2));
/// let changes = [(0, 1), (1, 1), (2, 1), (2, 2)].map(|(i, lag)| (Source::Increment(i), lag));
/// let observable = |(source, lag)| Observable { source, lag, centre: 0.0, gain: 1.0 };
/// let structure = Structure::try_from(ModelRepr {
///     robot: "planar",
///     sample_time_s: 0.1,
///     states: [state("x", Space::Line), state("y", Space::Line), state("phi", Space::Circle)]
///         .into_iter().collect(),
///     inputs: [input("v"), input("omega")].into_iter().collect(),
///     symmetry: Symmetry::Se2 { x: 0, y: 1, heading: 2 },
///     observables: inputs.chain(changes).map(observable).collect(),
///     factors: (0..12).map(|observable| Factor { observable, basis: Basis::Hermite, order: 1 })
///         .collect(),
///     blocks: [Block { factors: 1, max_degree: 0 }; 12].into_iter().collect(),
///     provenance: Provenance { logs: [0; 32], robot: [0; 32] },
/// }).unwrap();
/// let terms: Vec<[u8; 2]> = (0..12).map(|function| [0, function]).collect();
/// let terms = SparseTerms::new(structure.dictionary(), &terms).unwrap();
/// assert_eq!(firmware_core::cost::instructions(&structure, Some(terms)), 921);
/// ```
pub fn instructions(structure: &Structure<'_>, terms: Option<SparseTerms<'_>>) -> u32 {
    let parts = parts(structure, terms);
    libm::roundf(parts.iter().map(|part| part.count as f32 * part.each).sum::<f32>()) as u32
}

/// Something that a step does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    /// What.
    pub name: &'static str,
    /// How often a model does it.
    pub count: usize,
    /// Instructions each time.
    pub each: f32,
}

/// What a step does. Of a sparse model up to four outputs are summed while the terms are made, further ones
/// after them.
pub fn parts(structure: &Structure<'_>, terms: Option<SparseTerms<'_>>) -> [Part; 38] {
    let part = |name, count, each| Part { name, count, each };
    let mut direct = Direct::empty();
    if terms.is_none() {
        direct.fill(structure, structure.layout().end);
    }
    let known = Shape::of(structure, &direct);
    let is_known = known.is_some();
    let direct = Some(direct).filter(|direct| direct.is_some() && !is_known);
    let [runs, tiles, folded] = direct.map_or([0; 3], |direct| direct.folds());
    let is_direct = direct.is_some();
    let planned = direct.is_some_and(|direct| direct.is_planned());
    // A step that looks at every part of the model.
    let at_length = !is_known && !is_direct;
    let dense = at_length && terms.is_none();
    let outputs = structure.outputs();
    let all = structure.dictionary().observables();
    let observables = if at_length { all } else { &[] };
    let scaled = observables.iter().filter(|o| dense || (o.centre, o.gain) != (0.0, 1.0)).count();

    // A sparse model has a factor per block, and no blocks for the kernel.
    let factors = structure.dictionary().blocks().flat_map(|(_, factors)| factors);
    let factors = factors.filter(|_| terms.is_some());
    let beyond = |f: &&Factor| usize::from(f.order).saturating_sub(1);
    let of_basis = |basis| factors.clone().filter(move |f| f.basis == basis);
    let fourier = of_basis(Basis::Fourier).filter(|f| f.order > 1);
    let powers = of_basis(Basis::Hermite).map(|f| beyond(&f)).sum();
    let fourier_harmonics = fourier.clone().map(|f| beyond(&f)).sum();
    let count = terms.map_or(0, |terms| terms.entries().len());
    let made = [1, 2, 3, 4].map(|n| if outputs.min(4) == n { count } else { 0 });
    let later = if terms.is_none() { 0 } else { outputs.saturating_sub(4) };

    let blocks = structure.dictionary().blocks().filter(|_| dense);
    let blocks =
        blocks.map(|(_, own)| (own.len(), own.iter().map(|f| f.radix()).product::<usize>()));
    let block_count = blocks.clone().count();

    let states = if is_known { &[] } else { structure.states() };
    let of =
        |kind: &dyn Fn(&State<'_>) -> bool| states.iter().filter(|s| !planned && kind(s)).count();
    let absolute = |s: &State<'_>| (s.space, s.target) == (Space::Circle, Target::Absolute);
    let undelayed = if at_length && structure.delay_lines() == 0 { states.len() } else { 0 };
    let planned_of =
        |kind: &dyn Fn(&State<'_>) -> bool| states.iter().filter(|s| planned && kind(s)).count();
    let observed = |source: Source| all.iter().any(|o| o.source == source);
    let heading =
        |i: u8| matches!(structure.symmetry(), Symmetry::Se2 { heading, .. } if heading == i);
    let se2 = matches!(structure.symmetry(), Symmetry::Se2 { .. });
    let states = (0_u8..).zip(states).filter(|_| !planned);
    let turned = states.clone().filter(|(i, s)| {
        let needed = heading(*i) || observed(Source::Sin(*i)) || observed(Source::Cos(*i));
        (s.space, s.target) == (Space::Circle, Target::Increment) && needed
    });
    let turned = turned.count();
    let angles = states.filter(|(i, s)| {
        let [low, high] = s.limit;
        let limited = low > -core::f32::consts::PI || high < core::f32::consts::PI;
        absolute(s) && (limited || observed(Source::Increment(*i)))
    });
    let angles = angles.count();
    [
        part("step", usize::from(at_length), 236.8),
        part("step of a dense model", usize::from(dense), -266.0),
        part("step of the paper's drive", usize::from(known == Some(Shape::Drive)), 378.0),
        part(
            "step of the paper's drive by its pose",
            usize::from(known == Some(Shape::Planar)),
            167.0,
        ),
        part("step of a dense model without delays", usize::from(is_direct), 178.1),
        part("observable of it", if is_direct { all.len() } else { 0 }, 7.6),
        part("run of its axes", runs, 63.4),
        part("tile", tiles, 0.2),
        part("coefficient", folded, 1.1),
        part("input", if is_known { 0 } else { structure.inputs().len() }, 14.5),
        part("observable and its range", observables.len(), 14.4),
        part("observable that is centred or scaled", scaled, 17.5),
        part("source with a delay line", structure.delay_lines(), 6.3),
        part("coordinate of a model without delays", undelayed, 3.8),
        part("four numbers of the history moved on", structure.delayed() / 4, 12.7),
        part("Fourier factor from order 2 on", fourier.count(), 17.2),
        part("sine and cosine of a harmonic from the second on", fourier_harmonics, 18.4),
        part("power from the second on", powers, 11.2),
        part("term and its product with 1 output", made[0], 12.3),
        part("term and its products with 2 outputs", made[1], 13.9),
        part("term and its products with 3 outputs", made[2], 15.3),
        part("term and its products with 4 outputs", made[3], 18.5),
        part("further output", later, 13.4),
        part("term times a further output", later * count, 4.7),
        part("next value as planned", planned_of(&|s| s.space == Space::Line && !se2), 22.0),
        part(
            "next sine and cosine as planned",
            planned_of(&|s| s.space == Space::Circle && !se2),
            45.0,
        ),
        part("next pose as planned", usize::from(planned && se2), 107.8),
        part(
            "coordinate on R, next value",
            of(&|s| (s.space, s.target) == (Space::Line, Target::Absolute)),
            47.5,
        ),
        part(
            "coordinate on R, change",
            of(&|s| (s.space, s.target) == (Space::Line, Target::Increment)),
            49.1,
        ),
        part(
            "angle, change",
            of(&|s| (s.space, s.target) == (Space::Circle, Target::Increment)),
            63.6,
        ),
        part("sine and cosine of an angle predicted by its change", turned, 55.8),
        part("angle, next sine and cosine", of(&absolute), 70.9),
        part("its limits or its observed change", angles, 157.9),
        part("planar pose", usize::from(se2 && !planned && !is_known), 37.2),
        part("dense block", block_count, 266.0),
        part("factor of a dense block", blocks.clone().map(|(factors, _)| factors).sum(), 236.4),
        part("dense block and output", block_count * outputs, 93.9),
        part("dense coefficient", blocks.map(|(_, size)| size * outputs).sum(), 5.5),
    ]
}
