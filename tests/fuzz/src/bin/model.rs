//! Any model that can be made, by a recipe: it predicts, is written, and read again as the same one.
//!
//! A blob is hardly ever changed into another good one: its lists, sections and self-test hang together. The
//! recipe takes the trainer's way, with small numbers in the right places most of the time, and `emit` writes
//! the self-test.
#![no_main]

use firmware_core::ErrorBounds;
use firmware_core::blob::EmitError;
use firmware_core::capacity::{
    MAX_BLOCKS, MAX_FACTORS, MAX_INPUTS, MAX_LAG, MAX_OBSERVABLES, MAX_STATES,
};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::parse;
use fuzz::model::{predict, read, write};
use libfuzzer_sys::fuzz_target;

fuzz_target!(
    init: fuzz::seeds((1..=32_u32).map(|i| {
        // Anything is a recipe.
        let mut x = i;
        let bytes = std::iter::repeat_with(|| {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 24) as u8
        });
        bytes.take(64 * i as usize).collect::<Vec<u8>>()
    })),
    |bytes: &[u8]| {
        let mut recipe = Recipe(bytes);
        if let Ok(structure) = Structure::try_from(recipe.metadata()) {
            recipe.model(structure);
        }
    }
);

/// Bytes, each a decision; zeros when there are no more.
struct Recipe<'a>(&'a [u8]);

impl Recipe<'_> {
    fn byte(&mut self) -> u8 {
        self.0.split_off_first().copied().unwrap_or(0)
    }

    /// Below `count`, most of the time.
    fn index(&mut self, count: usize) -> u8 {
        match self.byte() {
            255 => self.byte(),
            byte => byte % u8::try_from(count.max(1)).unwrap_or(u8::MAX),
        }
    }

    fn flag(&mut self) -> bool {
        self.byte() & 1 == 1
    }

    /// A small number, most of the time.
    fn number(&mut self) -> f32 {
        match self.byte() {
            255 => f32::from_le_bytes(std::array::from_fn(|_| self.byte())),
            254 => [f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e19][usize::from(self.byte() % 4)],
            byte => f32::from(byte as i8) / 64.0,
        }
    }

    /// So many numbers, of which at most a hundred differ.
    fn numbers(&mut self, count: usize) -> Vec<f32> {
        let some: Vec<f32> = (0..count.min(100)).map(|_| self.number()).collect();
        some.iter().copied().cycle().take(count).collect()
    }

    /// `[low, high]` as a model wants it, most of the time.
    fn interval(&mut self) -> [f32; 2] {
        let [a, b] = [self.number(), self.number()];
        if a < b { [a, b] } else { [b, a] }
    }

    fn metadata(&mut self) -> ModelRepr<'static> {
        let (n, m) = (self.index(MAX_STATES).saturating_add(1), self.index(MAX_INPUTS + 1));
        let symmetry = match self.byte() % 4 {
            0 => Symmetry::Translation { coordinates: self.byte() },
            1 => {
                let [x, y, heading] = std::array::from_fn(|_| self.index(n.into()));
                Symmetry::Se2 { x, y, heading }
            }
            _ => Symmetry::None,
        };
        let states = (0..n).map(|i| State {
            name: ["x", "y", "phi", ""][usize::from(i % 4)],
            unit: "m",
            // What the symmetry asks for, and otherwise anything.
            space: match symmetry {
                Symmetry::Se2 { heading, .. } if i == heading => Space::Circle,
                Symmetry::Se2 { .. } if symmetry.excludes(i) => Space::Line,
                _ if self.flag() => Space::Circle,
                _ => Space::Line,
            },
            target: match symmetry.excludes(i) || self.flag() {
                true => Target::Increment,
                false => Target::Absolute,
            },
            limit: match self.byte() % 4 {
                0 => self.interval(),
                1 => [f32::NEG_INFINITY, f32::INFINITY],
                _ => [-1e6, 1e6],
            },
        });
        let states: Vec<State<'_>> = states.take(MAX_STATES).collect();
        let input = |i: u8, range| Input { name: ["u", "v"][usize::from(i % 2)], unit: "V", range };
        let inputs = (0..m).take(MAX_INPUTS).map(|i| input(i, self.interval())).collect();

        let mut observables: Vec<Observable> = Vec::new();
        for _ in 0..self.index(24) {
            let (kind, i) = (self.byte() % 4, self.index(n.into()));
            let lag = self.index(MAX_LAG);
            let space = states.get(usize::from(i)).map(|state| state.space);
            let own = |source, lag| Observable { source, lag, centre: 0.0, gain: 1.0 };
            let scaled = |source, lag, [centre, gain]: [f32; 2]| Observable {
                source,
                lag,
                centre,
                gain: if gain == 0.0 { 1.0 } else { gain },
            };
            let mut numbers = || [self.number(), self.number()];
            match (kind, space) {
                (0, _) => {
                    let source = Source::Input(i % m.max(1));
                    observables.push(scaled(source, lag, numbers()));
                }
                (1, _) => {
                    observables.push(scaled(Source::Increment(i), lag.saturating_add(1), numbers()))
                }
                _ if symmetry.excludes(i) => {
                    observables.push(own(Source::Increment(i), lag.saturating_add(1)));
                }
                (_, Some(Space::Circle)) => {
                    observables.extend([own(Source::Sin(i), lag), own(Source::Cos(i), lag)]);
                }
                _ => observables.push(scaled(Source::State(i), lag, numbers())),
            }
        }
        observables.truncate(MAX_OBSERVABLES);
        // The second of two equal ones would be refused.
        let mut seen = Vec::new();
        observables.retain(|o| {
            let new = !seen.contains(&(o.source, o.lag));
            seen.push((o.source, o.lag));
            new
        });

        let (mut factors, mut blocks) = (Vec::new(), Vec::new());
        for _ in 0..self.index(12) {
            let count = self.index(6);
            let own = (0..count).map(|_| {
                let observable = self.index(observables.len());
                let source = observables.get(usize::from(observable)).map(|o| o.source);
                let basis = match source {
                    Some(Source::Sin(_)) if self.flag() => Basis::Fourier,
                    _ => Basis::Hermite,
                };
                Factor { observable, basis, order: self.index(5).saturating_add(1) }
            });
            factors.extend(own);
            let max_degree = if count > 1 { self.index(4) } else { 0 };
            blocks.push(Block { factors: count, max_degree });
        }
        factors.truncate(MAX_FACTORS);
        blocks.truncate(MAX_BLOCKS);
        ModelRepr {
            robot: "any",
            sample_time_s: 0.1,
            states: states.into_iter().collect(),
            inputs,
            symmetry,
            observables: observables.into_iter().collect(),
            factors: factors.into_iter().collect(),
            blocks: blocks.into_iter().collect(),
            provenance: Provenance { logs: [self.byte(); 32], robot: [0; 32] },
        }
    }

    /// Puts numbers to a structure.
    fn model(&mut self, structure: Structure<'_>) {
        let functions = structure.dictionary().functions();
        let terms: Option<Vec<[u8; 2]>> = self.flag().then(|| {
            let count = usize::from(self.byte());
            (1..=count).map(|term| [self.index(term), self.index(functions)]).collect()
        });
        let dense = structure.dictionary().dense_terms();
        let per_output = terms.as_ref().map_or(dense, |terms| terms.len() + 1);
        let (n, m) = (structure.states().len(), structure.inputs().len());
        let samples = structure.lag() + 1;
        let (states, inputs) = (self.numbers(samples * n), self.numbers(samples * m));
        let tolerance: Vec<f32> = self.numbers(n).into_iter().map(f32::abs).collect();
        let ranges: Option<Vec<[f32; 2]>> = self.flag().then(|| {
            structure.dictionary().observables().iter().map(|_| self.interval()).collect()
        });
        let mut last = 0_u32;
        let horizons: Vec<u32> = (0..self.index(8))
            .map(|_| {
                last = last.wrapping_add(1 + u32::from(self.byte()));
                last
            })
            .collect();
        let bounds: Vec<f32> = self.numbers(n * horizons.len()).into_iter().map(f32::abs).collect();
        let (coverage, units) = (self.number(), self.byte().into());
        let coefficients = self.numbers(structure.outputs() * per_output);

        let ranges = ranges.as_ref().map(|ranges| ranges.as_flattened());
        let model = match &terms {
            None => Model::new(structure, &coefficients, ranges),
            Some(terms) => Model::new_sparse(structure, terms, &coefficients, ranges),
        };
        let Ok(mut model) = model else { return };
        if let Ok(bounds) = ErrorBounds::new(n, coverage, units, &horizons, &bounds) {
            model = model.with_error_bounds(bounds).expect("they are for as many states");
        }
        predict(&model, states.iter().copied(), inputs.iter().copied());
        match write(&model, &states, &inputs, &tolerance) {
            Ok(blob) => {
                let blob: &[u8] = bytemuck::cast_slice(&blob);
                assert_eq!(parse(blob).as_ref(), Ok(&model));
                read(blob);
            }
            // It diverges within a step, or a number is none.
            Err(error) => assert_eq!(error, EmitError::SelfTest),
        }
    }
}
