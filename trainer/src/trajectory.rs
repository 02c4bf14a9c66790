//! Trajectories, in memory or streamed from a recording.

use crate::recording::{LogSchema, ReadError, Recording, Summary, Visitor};

/// A trajectory in memory: one row per sample, the input of a row acts until the next row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Shape `[samples, states]`, angles in radians.
    pub states: Vec<f64>,
    /// Shape `[samples, inputs]`.
    pub inputs: Vec<f64>,
}

/// Anything that can show its trajectories, in the same order every time.
pub trait Trajectories {
    /// Why they cannot be shown.
    type Error;

    /// Shows every sample of every trajectory to the visitor.
    ///
    /// # Errors
    /// The source's own; the visitor has then seen a part.
    fn visit<V: Visitor>(&self, visitor: &mut V) -> Result<Summary, Self::Error>;
}

/// A recording and how to read it.
#[derive(Clone, Copy, Debug)]
pub struct Logs<'r> {
    /// The files.
    pub recording: &'r Recording,
    /// The columns.
    pub schema: &'r LogSchema,
}

impl Trajectories for Logs<'_> {
    type Error = ReadError;

    fn visit<V: Visitor>(&self, visitor: &mut V) -> Result<Summary, ReadError> {
        self.recording.read(self.schema, visitor)
    }
}

/// Trajectories in memory with their dimensions.
#[derive(Clone, Copy, Debug)]
pub struct InMemory<'t> {
    /// The trajectories.
    pub trajectories: &'t [Trajectory],
    /// State coordinates per sample.
    pub states: usize,
    /// Inputs per sample.
    pub inputs: usize,
}

impl Trajectories for InMemory<'_> {
    type Error = std::convert::Infallible;

    fn visit<V: Visitor>(&self, visitor: &mut V) -> Result<Summary, Self::Error> {
        let mut summary =
            Summary { trajectories: self.trajectories.len(), rows: 0, sha256: [0; 32] };
        for (i, trajectory) in self.trajectories.iter().enumerate() {
            visitor.begin(&format!("trajectory {i}"));
            let mut inputs = trajectory.inputs.chunks_exact(self.inputs.max(1));
            for x in trajectory.states.chunks_exact(self.states) {
                visitor.row(x, inputs.next().unwrap_or(&[]));
                summary.rows += 1;
            }
        }
        Ok(summary)
    }
}

/// All trajectories of a source, in memory.
///
/// # Errors
/// The source's own.
pub fn collect<T: Trajectories>(source: &T) -> Result<Vec<Trajectory>, T::Error> {
    Ok(collect_named(source)?.into_iter().map(|(_, trajectory)| trajectory).collect())
}

/// The same with the name of each.
///
/// # Errors
/// The source's own.
pub fn collect_named<T: Trajectories>(source: &T) -> Result<Vec<(String, Trajectory)>, T::Error> {
    Ok(collect_summed_up(source)?.0)
}

/// Named trajectories, and what was read.
type SummedUp = (Vec<(String, Trajectory)>, Summary);

/// The same with what was read.
///
/// # Errors
/// The source's own.
pub fn collect_summed_up<T: Trajectories>(source: &T) -> Result<SummedUp, T::Error> {
    struct Collector(Vec<(String, Trajectory)>);
    impl Visitor for Collector {
        fn begin(&mut self, name: &str) {
            self.0.push((name.to_owned(), Trajectory::default()));
        }
        fn row(&mut self, states: &[f64], inputs: &[f64]) {
            if let Some((_, last)) = self.0.last_mut() {
                last.states.extend_from_slice(states);
                last.inputs.extend_from_slice(inputs);
            }
        }
    }
    let mut collector = Collector(Vec::new());
    let summary = source.visit(&mut collector)?;
    Ok((collector.0, summary))
}
