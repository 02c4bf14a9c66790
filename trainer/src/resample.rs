//! Puts a log on an even time grid.
//!
//! A trajectory that starts at time t₀ is evaluated at t₀ + k·dt for as long as it lasts:
//!
//! * States are interpolated linearly between the two rows around the grid point. An angle moves
//!   along the shorter way round from row to row; what is written is continuous and may leave
//!   (−π, π].
//! * Inputs act from their row's time to the next row's, so they are held, or averaged over the
//!   new interval: [`InputResampling`].
//! * No data are invented: a step longer than the accepted gap ends the trajectory, and another
//!   one starts after it.
//!
//! Reading and writing stream; memory holds two rows of a log, however long it is.

use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use thiserror::Error;

use crate::recording::{LogColumn, LogSchema, ReadError, Recording, Row, Summary, nanoseconds};

/// A row this close to a grid point counts as lying on it, relative to the grid's step: times
/// with decimal digits never meet t₀ + k·dt exactly.
const SNAP: f64 = 1e-6;

/// What an input becomes on the new grid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum InputResampling {
    /// The value that acts at the grid point: that of the last row at or before it. What happens
    /// between two grid points is lost, so this fits grids at least as fine as the log.
    #[default]
    Hold,
    /// The mean of the held input over the new interval, weighted by time, so that the integral
    /// of the input is kept. Where no row lies inside the interval it is the held value.
    Mean,
}

/// How to resample a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct ResamplePlan {
    /// Step of the new grid, in seconds; positive.
    pub dt_s: f64,
    /// The columns to read. Its sample time is not used, and factors are not applied: numbers
    /// stay in the unit of their column.
    pub schema: LogSchema,
    /// For each state of the schema whether it is an angle. One turn is 2π divided by the
    /// column's factor: 2π for radians (factor 1), 360 for degrees (factor π/180).
    pub angles: Vec<bool>,
    /// What the inputs become.
    pub inputs: InputResampling,
    /// Longest step of the log that is interpolated, in seconds; may be infinite.
    pub max_gap_s: f64,
}

impl ResamplePlan {
    /// A plan without angles that holds the inputs and interpolates steps of up to ten `dt_s`.
    pub fn new(dt_s: f64, schema: LogSchema) -> Self {
        Self {
            dt_s,
            angles: vec![false; schema.states.len()],
            schema,
            inputs: InputResampling::Hold,
            max_gap_s: 10.0 * dt_s,
        }
    }
}

/// What was resampled.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ResampleReport {
    /// What was read.
    pub read: Summary,
    /// The files written, one per trajectory, in the order of the recording.
    pub files: Vec<PathBuf>,
    /// Number of rows written to all files together, headers not counted.
    pub rows: u64,
    /// Number of gaps at which a trajectory was split.
    pub gaps: u64,
    /// Number of pieces left out because they give fewer than two rows on the new grid.
    pub dropped: u64,
}

/// Why a recording was not resampled. Nothing has been written then.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ResampleError {
    /// The recording cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A time of the plan is not a positive number.
    #[error("{name} is {found} s; expected a positive number of seconds")]
    NotPositive {
        /// Which one: `dt` or `max gap`.
        name: &'static str,
        /// Its value, in seconds.
        found: f64,
    },
    /// The plan does not say of every state whether it is an angle.
    #[error("the plan marks {found} states as angles or not; expected one mark for each of {expected} states")]
    Angles {
        /// Number of states.
        expected: usize,
        /// Number of marks.
        found: usize,
    },
    /// The time stands still or goes backwards inside a trajectory.
    #[error(
        "{}, row {line}, column `{column}`: the time {}: expected a later time than in the row \
         before, found a step of {} s; sort the rows, delete repeated ones, or split the log \
         here if a new run starts",
        file.display(),
        if *step_s == 0.0 { "stands still" } else { "goes backwards" },
        nanoseconds(*step_s)
    )]
    TimeNotIncreasing {
        /// The file.
        file: PathBuf,
        /// Line of the later of the two rows; the header is on line 1.
        line: u64,
        /// Header of the time column.
        column: String,
        /// The step found, in seconds: zero or negative.
        step_s: f64,
    },
    /// No trajectory gives two rows on the new grid.
    #[error(
        "{}: no trajectory gives two rows at a step of {dt_s} s: its pieces between gaps longer \
         than {max_gap_s} s are too short; choose a smaller dt or accept longer gaps",
        logs.display()
    )]
    NothingLeft {
        /// The recording.
        logs: PathBuf,
        /// Step of the new grid, in seconds.
        dt_s: f64,
        /// Longest step of the log that is interpolated, in seconds.
        max_gap_s: f64,
    },
    /// The results would land among the logs they are made from.
    #[error(
        "{}: this is the directory of the logs; expected another one, so that measured and \
         resampled logs are not mixed",
        dir.display()
    )]
    IntoLogs {
        /// The directory for the results.
        dir: PathBuf,
    },
    /// The directory for the results holds CSV files already.
    #[error(
        "{}: this directory holds CSV files already, such as {}; expected a new or empty one",
        dir.display(), found.display()
    )]
    HoldsLogs {
        /// The directory for the results.
        dir: PathBuf,
        /// One of the files in it.
        found: PathBuf,
    },
    /// The results cannot be written.
    #[error("{}: cannot be written: {source}", path.display())]
    Unwritable {
        /// The file or directory.
        path: PathBuf,
        /// What the operating system answered.
        source: io::Error,
    },
}

fn unwritable(path: &Path) -> impl FnOnce(io::Error) -> ResampleError {
    move |source| ResampleError::Unwritable {
        path: path.to_owned(),
        source,
    }
}

/// Writes `recording` on an even grid to `out_dir`, which is made if need be: one CSV file per
/// trajectory, named like it, with the time, the states and the inputs under the headers that the
/// log has for them. Times are rounded to nanoseconds. The part of a trajectory after a gap goes
/// to `<name>.part002.csv` and so on. All files appear at the end, or none.
///
/// # Errors
///
/// [`ResampleError`]; whatever it is, `out_dir` is as it was before.
pub fn resample(
    recording: &Recording,
    plan: &ResamplePlan,
    out_dir: &Path,
) -> Result<ResampleReport, ResampleError> {
    check(plan)?;
    check_target(recording, out_dir)?;

    // Staged on the same file system, so that finished files only need a new name.
    let parent = match out_dir.ancestors().find(|dir| dir.is_dir()) {
        Some(dir) => dir,
        None => Path::new("."),
    };
    let staging = TempDir::with_prefix_in(".resample-", parent).map_err(unwritable(parent))?;

    let schema = LogSchema {
        states: as_written(&plan.schema.states),
        inputs: as_written(&plan.schema.inputs),
        ..plan.schema.clone()
    };
    let mut resampler = Resampler::new(plan, staging.path());
    let read = recording.stream(&schema, |row| resampler.row(row))?;
    resampler.end()?;
    let Resampler {
        names,
        rows,
        gaps,
        dropped,
        ..
    } = resampler;
    if names.is_empty() {
        return Err(ResampleError::NothingLeft {
            logs: recording.path().to_owned(),
            dt_s: plan.dt_s,
            max_gap_s: plan.max_gap_s,
        });
    }

    fs::create_dir_all(out_dir).map_err(unwritable(out_dir))?;
    let mut files: Vec<PathBuf> = Vec::with_capacity(names.len());
    for name in names {
        let target = out_dir.join(&name);
        if let Err(source) = fs::rename(staging.path().join(&name), &target) {
            for file in &files {
                // The first error is the one to report.
                let _ = fs::remove_file(file);
            }
            return Err(unwritable(&target)(source));
        }
        files.push(target);
    }
    Ok(ResampleReport {
        read,
        files,
        rows,
        gaps,
        dropped,
    })
}

fn check(plan: &ResamplePlan) -> Result<(), ResampleError> {
    let (dt, gap) = (plan.dt_s, plan.max_gap_s);
    if !(dt.is_finite() && dt > 0.0) {
        return Err(ResampleError::NotPositive {
            name: "dt",
            found: dt,
        });
    }
    if gap.is_nan() || gap <= 0.0 {
        return Err(ResampleError::NotPositive {
            name: "max gap",
            found: gap,
        });
    }
    let (expected, found) = (plan.schema.states.len(), plan.angles.len());
    if expected != found {
        return Err(ResampleError::Angles { expected, found });
    }
    Ok(())
}

/// Refuses the directory of the logs and one that holds logs.
fn check_target(recording: &Recording, out_dir: &Path) -> Result<(), ResampleError> {
    let Ok(target) = fs::canonicalize(out_dir) else {
        return Ok(());
    };
    let logs = fs::canonicalize(recording.path()).map_err(|source| ReadError::Unreadable {
        file: recording.path().to_owned(),
        source,
    })?;
    if logs == target || logs.is_file() && logs.parent() == Some(&target) {
        return Err(ResampleError::IntoLogs {
            dir: out_dir.to_owned(),
        });
    }
    for entry in fs::read_dir(out_dir).map_err(unwritable(out_dir))? {
        let found = entry.map_err(unwritable(out_dir))?.path();
        if found.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("csv")) {
            return Err(ResampleError::HoldsLogs {
                dir: out_dir.to_owned(),
                found,
            });
        }
    }
    Ok(())
}

fn as_written(columns: &[LogColumn]) -> Vec<LogColumn> {
    let as_written = |column: &LogColumn| LogColumn {
        factor: 1.0,
        ..column.clone()
    };
    columns.iter().map(as_written).collect()
}

/// The newest row of the log, angles made continuous.
#[derive(Clone, Debug, Default)]
struct Sample {
    time_s: f64,
    states: Vec<f64>,
    inputs: Vec<f64>,
}

/// The interval of the grid that is not finished yet.
#[derive(Debug, Default)]
struct Interval {
    /// Time at the grid point that starts it.
    start_s: f64,
    /// The states there.
    states: Vec<f64>,
    /// The inputs that act there, or their mean so far.
    inputs: Vec<f64>,
    /// How much of the time since the start has been averaged, in seconds, and up to when.
    averaged_s: f64,
    until_s: f64,
}

/// A trajectory that is being written.
struct Output {
    name: String,
    path: PathBuf,
    writer: csv::Writer<File>,
    rows: u64,
}

struct Resampler<'a> {
    plan: &'a ResamplePlan,
    staging: &'a Path,
    /// One turn of each state in its own unit, for angles.
    turns: Vec<Option<f64>>,

    trajectory: String,
    /// Parts of the trajectory so far.
    part: u32,
    output: Option<Output>,
    /// Time of the first grid point of this part, and how many have been reached.
    origin_s: f64,
    points: u64,
    last: Sample,
    next: Sample,
    interval: Interval,
    text: String,

    names: Vec<String>,
    rows: u64,
    gaps: u64,
    dropped: u64,
}
