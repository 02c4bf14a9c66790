//! Snapshot pairs: the observables at a sample, and what the operator has to make of them.

use firmware_core::capacity::{MAX_OBSERVABLES, MAX_OUTPUTS};
use firmware_core::history::{History, Sample};
use firmware_core::model::Structure;

use crate::recording::Visitor;

/// Takes snapshot pairs.
pub trait PairSink {
    /// `values`, shape `[observables]`, as the dictionary takes them; `targets`, shape `[outputs]`;
    /// `row` is that of the later sample in its trajectory, from 0.
    fn pair(&mut self, row: u64, values: &[f64], targets: &[f64]);
    /// Bytes of the log read so far.
    fn progress(&mut self, _bytes: u64) {}
}

/// Turns rows into snapshot pairs with the core's history; pairs never span two trajectories.
#[derive(Debug)]
pub struct Snapshots<'s, 'a, P> {
    structure: &'s Structure<'a>,
    history: History<f64>,
    next: Sample<f64>,
    input: Vec<f64>,
    values: [f64; MAX_OBSERVABLES],
    targets: [f64; MAX_OUTPUTS],
    row: u64,
    sink: P,
}

impl<'s, 'a, P: PairSink> Snapshots<'s, 'a, P> {
    /// Pairs for `structure` go to `sink`.
    pub fn new(structure: &'s Structure<'a>, sink: P) -> Self {
        Self {
            structure,
            history: History::default(),
            next: structure.sample(&[]),
            input: vec![0.0; structure.inputs().len()],
            values: [0.0; MAX_OBSERVABLES],
            targets: [0.0; MAX_OUTPUTS],
            row: 0,
            sink,
        }
    }

    /// The sink, while pairs are still coming.
    pub fn sink_mut(&mut self) -> &mut P {
        &mut self.sink
    }

    /// The sink.
    pub fn into_sink(self) -> P {
        self.sink
    }
}

impl<P: PairSink> Visitor for Snapshots<'_, '_, P> {
    fn begin(&mut self, _name: &str) {
        self.history.clear();
        self.row = 0;
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        self.structure.sample_into(states, &mut self.next);
        if self.history.len() > self.structure.lag() {
            let values = &mut self.values[..self.structure.dictionary().observables().len()];
            let targets = &mut self.targets[..self.structure.outputs()];
            self.history.observe(self.structure, &self.input, values);
            self.history.targets(self.structure, &self.next, targets);
            self.sink.pair(self.row, values, targets);
        }
        self.history.push(self.structure, &self.input, &self.next);
        for (to, u) in self.input.iter_mut().zip(inputs) {
            *to = *u;
        }
        self.row += 1;
    }

    fn progress(&mut self, bytes: u64) {
        self.sink.progress(bytes);
    }
}
