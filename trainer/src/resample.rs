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
    #[error(
        "the plan says of {found} states whether they are angles; expected it of each of the \
         {expected} states"
    )]
    Angles {
        /// Number of states.
        expected: usize,
        /// Number of states spoken of.
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
    move |source| ResampleError::Unwritable { path: path.to_owned(), source }
}

/// Writes `recording` on an even grid to `out_dir`, which is made if need be: one CSV file per
/// trajectory, named like it, with the time, the states and the inputs under the headers that the
/// log has for them. Times are rounded to nanoseconds. The part of a trajectory after a gap goes
/// to `<name>.part002.csv` and so on. All files appear at the end, or none.
///
/// ```
/// use trainer::recording::{LogColumn, LogSchema, Recording};
/// use trainer::resample::{ResamplePlan, resample};
///
/// let dir = tempfile::tempdir()?;
/// let log = dir.path().join("run.csv");
/// std::fs::write(&log, "time_s,x_m,u\n0,0,7\n0.3,3,8\n0.4,4,9\n")?;
///
/// let columns = |name, unit| vec![LogColumn::new(name, unit)];
/// let plan = ResamplePlan::new(0.2, LogSchema::new(0.2, columns("x", "m"), columns("u", "")));
/// let report = resample(&Recording::open(&log)?, &plan, &dir.path().join("even"))?;
/// assert_eq!(report.rows, 3);
/// assert_eq!(std::fs::read_to_string(&report.files[0])?, "time_s,x_m,u\n0,0,7\n0.2,2,7\n0.4,4,9\n");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
///
/// [`ResampleError`]; whatever it is, no file has been added to `out_dir`.
pub fn resample(
    recording: &Recording,
    plan: &ResamplePlan,
    out_dir: &Path,
) -> Result<ResampleReport, ResampleError> {
    check(plan)?;
    check_target(recording, out_dir)?;

    // Staged on the same file system, so that finished files only need a new name.
    let parent = out_dir.ancestors().find(|dir| dir.is_dir());
    let parent = parent.unwrap_or(Path::new("."));
    let staging = TempDir::with_prefix_in(".resample-", parent).map_err(unwritable(parent))?;

    let schema = LogSchema {
        states: as_written(&plan.schema.states),
        inputs: as_written(&plan.schema.inputs),
        ..plan.schema.clone()
    };
    let mut grid = Grid::new(plan);
    let mut output = Output::new(staging.path());
    let mut gaps = 0;
    let read = recording.stream(&schema, |row| {
        let step_s = row.time_s - grid.last.time_s;
        let begins = row.begins.is_some();
        if !begins && step_s <= 0.0 {
            return Err(ResampleError::TimeNotIncreasing {
                file: row.file.to_owned(),
                line: row.line,
                column: row.columns[0].clone(),
                step_s,
            });
        }
        let gap = !begins && step_s > plan.max_gap_s;
        gaps += u64::from(gap);
        if !begins && !gap {
            return grid.push(&row, &mut output);
        }
        grid.end(&mut output)?;
        output.end_part()?;
        if let Some(name) = row.begins {
            output.begin_trajectory(name);
        }
        output.begin_part(row.columns)?;
        grid.begin(&row);
        Ok(())
    })?;
    grid.end(&mut output)?;
    output.end_part()?;
    if output.names.is_empty() {
        return Err(ResampleError::NothingLeft {
            logs: recording.path().to_owned(),
            dt_s: plan.dt_s,
            max_gap_s: plan.max_gap_s,
        });
    }

    fs::create_dir_all(out_dir).map_err(unwritable(out_dir))?;
    let mut files: Vec<PathBuf> = Vec::with_capacity(output.names.len());
    for name in &output.names {
        let target = out_dir.join(name);
        if let Err(source) = fs::rename(staging.path().join(name), &target) {
            for file in &files {
                // The first error is the one to report.
                let _ = fs::remove_file(file);
            }
            return Err(unwritable(&target)(source));
        }
        files.push(target);
    }
    Ok(ResampleReport { read, files, rows: output.rows, gaps, dropped: output.dropped })
}

fn check(plan: &ResamplePlan) -> Result<(), ResampleError> {
    let (dt, gap) = (plan.dt_s, plan.max_gap_s);
    if !(dt.is_finite() && dt > 0.0) {
        return Err(ResampleError::NotPositive { name: "dt", found: dt });
    }
    if gap.is_nan() || gap <= 0.0 {
        return Err(ResampleError::NotPositive { name: "max gap", found: gap });
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
    let logs = fs::canonicalize(recording.path())
        .map_err(|source| ReadError::Unreadable { file: recording.path().to_owned(), source })?;
    if logs == target || logs.is_file() && logs.parent() == Some(&target) {
        return Err(ResampleError::IntoLogs { dir: out_dir.to_owned() });
    }
    for entry in fs::read_dir(out_dir).map_err(unwritable(out_dir))? {
        let found = entry.map_err(unwritable(out_dir))?.path();
        if found.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("csv")) {
            return Err(ResampleError::HoldsLogs { dir: out_dir.to_owned(), found });
        }
    }
    Ok(())
}

fn as_written(columns: &[LogColumn]) -> Vec<LogColumn> {
    let as_written = |column: &LogColumn| LogColumn { factor: 1.0, ..column.clone() };
    columns.iter().map(as_written).collect()
}

/// A row of the log, with angles made continuous.
#[derive(Debug, Default)]
struct Sample {
    time_s: f64,
    states: Vec<f64>,
    inputs: Vec<f64>,
}

/// One interval of the grid, and with that one row of the result.
#[derive(Debug, Default)]
struct Interval {
    /// Time of the grid point that starts it.
    start_s: f64,
    /// The states there.
    states: Vec<f64>,
    /// The inputs that act there, or their mean so far.
    inputs: Vec<f64>,
    /// Up to when the inputs have been averaged, and over how many seconds.
    averaged_to_s: f64,
    averaged_s: f64,
}

/// One stretch of a log without gaps on its way to the grid.
struct Grid {
    dt_s: f64,
    inputs: InputResampling,
    /// One turn of each state that is an angle, in its own unit.
    turn: Vec<Option<f64>>,
    /// Turns to be added to the angles of the newest row.
    turns: Vec<f64>,
    /// Time of the first grid point.
    origin_s: f64,
    /// Number of grid points reached, the last of which starts `interval`.
    points: u64,
    interval: Interval,
    last: Sample,
    next: Sample,
}

impl Grid {
    fn new(plan: &ResamplePlan) -> Self {
        let turn = plan.schema.states.iter().zip(&plan.angles);
        Self {
            dt_s: plan.dt_s,
            inputs: plan.inputs,
            turn: turn.map(|(state, angle)| angle.then_some(TAU / state.factor.abs())).collect(),
            turns: vec![0.0; plan.angles.len()],
            origin_s: 0.0,
            points: 0,
            interval: Interval::default(),
            last: Sample::default(),
            next: Sample::default(),
        }
    }

    fn begin(&mut self, row: &Row<'_>) {
        self.turns.fill(0.0);
        self.origin_s = row.time_s;
        self.last.set(row);
        self.points = 1;
        self.interval.start_s = row.time_s;
        self.interval.states.clone_from(&self.last.states);
        self.interval.hold(&self.last.inputs, row.time_s);
    }

    /// Takes a row later than the last one and passes on the intervals that end before it.
    fn push(&mut self, row: &Row<'_>, output: &mut Output<'_>) -> Result<(), ResampleError> {
        self.next.set(row);
        let angles = self.turn.iter().zip(&mut self.turns);
        let states = self.next.states.iter_mut().zip(&self.last.states);
        for ((turn, turns), (next, last)) in angles.zip(states) {
            if let Some(turn) = turn {
                *turns -= ((*next + turn * *turns - last) / turn).round();
                *next += turn * *turns;
            }
        }

        let (last, next) = (&self.last, &self.next);
        let rounding_s = SNAP * self.dt_s + 2.0 * f64::EPSILON * next.time_s.abs();
        loop {
            let start_s = self.origin_s + self.points as f64 * self.dt_s;
            if start_s > next.time_s + rounding_s {
                break;
            }
            let on_row = start_s >= next.time_s - rounding_s;
            let at_s = if on_row { next.time_s } else { start_s };
            self.interval.average(self.inputs, &last.inputs, at_s);
            output.write(&self.interval)?;

            let way = (at_s - last.time_s) / (next.time_s - last.time_s);
            let states = last.states.iter().zip(&next.states);
            self.interval.start_s = start_s;
            self.interval.states.clear();
            self.interval.states.extend(states.map(
                |(a, b)| {
                    if on_row { *b } else { a + way * (b - a) }
                },
            ));
            let acting = if on_row { &next.inputs } else { &last.inputs };
            self.interval.hold(acting, at_s);
            self.points += 1;
        }
        self.interval.average(self.inputs, &last.inputs, next.time_s);
        std::mem::swap(&mut self.last, &mut self.next);
        Ok(())
    }

    /// Passes on the last interval; the input of the last row acts to its end.
    fn end(&mut self, output: &mut Output<'_>) -> Result<(), ResampleError> {
        let end_s = self.origin_s + self.points as f64 * self.dt_s;
        self.interval.average(self.inputs, &self.last.inputs, end_s);
        output.write(&self.interval)
    }
}

impl Sample {
    fn set(&mut self, row: &Row<'_>) {
        self.time_s = row.time_s;
        self.states.clear();
        self.states.extend_from_slice(row.states);
        self.inputs.clear();
        self.inputs.extend_from_slice(row.inputs);
    }
}

impl Interval {
    /// Starts with the inputs that act at its start.
    fn hold(&mut self, inputs: &[f64], start_s: f64) {
        self.inputs.clear();
        self.inputs.extend_from_slice(inputs);
        self.averaged_to_s = start_s;
        self.averaged_s = 0.0;
    }

    /// Averages `inputs`, which act up to `to_s`. Equal inputs leave the mean exactly as it is.
    fn average(&mut self, how: InputResampling, inputs: &[f64], to_s: f64) {
        let weight = to_s - self.averaged_to_s;
        if how == InputResampling::Hold || weight <= 0.0 {
            return;
        }
        self.averaged_s += weight;
        self.averaged_to_s = to_s;
        for (mean, input) in self.inputs.iter_mut().zip(inputs) {
            *mean += (input - *mean) * (weight / self.averaged_s);
        }
    }
}

/// A file that is being written.
struct Part {
    name: String,
    path: PathBuf,
    writer: csv::Writer<File>,
    rows: u64,
}

/// The files of the result, in the directory where they are staged.
struct Output<'a> {
    staging: &'a Path,
    /// Name of the trajectory, and how many parts of it there have been.
    trajectory: String,
    parts: u32,
    part: Option<Part>,
    text: String,
    /// Names of the finished files.
    names: Vec<String>,
    /// Rows in the finished files.
    rows: u64,
    /// Parts that were too short.
    dropped: u64,
}

impl<'a> Output<'a> {
    fn new(staging: &'a Path) -> Self {
        Self {
            staging,
            trajectory: String::new(),
            parts: 0,
            part: None,
            text: String::new(),
            names: Vec::new(),
            rows: 0,
            dropped: 0,
        }
    }

    fn begin_trajectory(&mut self, name: &str) {
        // An episode's label may hold what a file name may not.
        let forbidden = |c: char| c.is_control() || r#"/\:*?"<>|"#.contains(c);
        self.trajectory = name.replace(forbidden, "_");
        self.parts = 0;
    }

    fn begin_part(&mut self, columns: &[String]) -> Result<(), ResampleError> {
        let (name, path, file) = loop {
            self.parts += 1;
            let name = match self.parts {
                1 => format!("{}.csv", self.trajectory),
                part => format!("{}.part{part:03}.csv", self.trajectory),
            };
            let path = self.staging.join(&name);
            match File::create_new(&path) {
                Ok(file) => break (name, path, file),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(unwritable(&path)(error)),
            }
        };
        let mut writer = csv::Writer::from_writer(file);
        writer.write_record(columns).map_err(|error| unwritable(&path)(error.into()))?;
        self.part = Some(Part { name, path, writer, rows: 0 });
        Ok(())
    }

    fn write(&mut self, interval: &Interval) -> Result<(), ResampleError> {
        let Some(part) = &mut self.part else {
            return Ok(());
        };
        part.rows += 1;
        let time_s = [nanoseconds(interval.start_s)];
        let numbers = time_s.iter().chain(&interval.states).chain(&interval.inputs);
        let row = || {
            for number in numbers {
                self.text.clear();
                // Writing to a string cannot fail.
                let _ = write!(self.text, "{number}");
                part.writer.write_field(&self.text)?;
            }
            part.writer.write_record(None::<&[u8]>)
        };
        row().map_err(|error| unwritable(&part.path)(error.into()))
    }

    fn end_part(&mut self) -> Result<(), ResampleError> {
        let Some(mut part) = self.part.take() else {
            return Ok(());
        };
        part.writer.flush().map_err(unwritable(&part.path))?;
        if part.rows < 2 {
            self.dropped += 1;
            return fs::remove_file(&part.path).map_err(unwritable(&part.path));
        }
        self.rows += part.rows;
        self.names.push(part.name);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// One state `x` in metres and one input `u`.
    fn schema() -> LogSchema {
        LogSchema::new(1.0, vec![LogColumn::new("x", "m")], vec![LogColumn::new("u", "")])
    }

    struct Bench {
        dir: TempDir,
    }

    impl Bench {
        fn new(files: &[(&str, &str)]) -> Self {
            let dir = TempDir::new().unwrap();
            fs::create_dir(dir.path().join("logs")).unwrap();
            for (name, text) in files {
                fs::write(dir.path().join("logs").join(name), text).unwrap();
            }
            Self { dir }
        }

        fn path(&self, name: &str) -> PathBuf {
            self.dir.path().join(name)
        }

        fn run(&self, plan: &ResamplePlan) -> Result<ResampleReport, ResampleError> {
            let recording = Recording::open(&self.path("logs")).unwrap();
            resample(&recording, plan, &self.path("out/deep"))
        }

        fn text(&self, name: &str) -> String {
            fs::read_to_string(self.path("out/deep").join(name)).unwrap()
        }

        /// The numbers of a resampled file.
        fn rows(&self, name: &str) -> Vec<Vec<f64>> {
            let numbers = |line: &str| line.split(',').map(|n| n.parse().unwrap()).collect();
            self.text(name).lines().skip(1).map(numbers).collect()
        }

        /// After a failure nothing is there but the logs.
        #[track_caller]
        fn assert_clean(&self) {
            let entries = fs::read_dir(self.dir.path()).unwrap();
            let names: Vec<_> = entries.map(|entry| entry.unwrap().file_name()).collect();
            assert_eq!(names, ["logs"]);
        }
    }

    fn one(text: &str, plan: &ResamplePlan) -> (Bench, ResampleReport) {
        let bench = Bench::new(&[("run.csv", text)]);
        let report = bench.run(plan).unwrap();
        (bench, report)
    }

    #[test]
    fn a_linear_signal_is_exact() {
        // x = 2 t + 1 at uneven times.
        let mut text = String::from("note,time_s,u,x_m\n");
        for t in [0.0, 0.13, 0.21, 0.37, 0.5, 0.58, 0.71] {
            text += &format!("a,{t},0,{}\n", 2.0 * t + 1.0);
        }
        let (bench, report) = one(&text, &ResamplePlan::new(0.1, schema()));
        assert!(bench.text("run.csv").starts_with("time_s,x_m,u\n0,1,0\n0.1,"));
        let rows = bench.rows("run.csv");
        assert_eq!((report.rows, rows.len()), (8, 8));
        for (k, row) in rows.iter().enumerate() {
            assert_eq!(row[0], k as f64 / 10.0);
            assert!((row[1] - (2.0 * row[0] + 1.0)).abs() < 1e-15, "{row:?}");
        }
        assert_eq!(report.read.rows, 7);
        assert_eq!(report.files, [bench.path("out/deep/run.csv")]);
        assert_eq!((report.gaps, report.dropped), (0, 0));
    }

    #[test]
    fn an_even_log_stays_as_it_is() {
        let mut text = String::from("time_s,x_m,u\n");
        for k in 0..1000 {
            let t = f64::from(k) / 100.0;
            text += &format!("{t},{},{}\n", (3.0 * t).sin(), (5.0 * t).cos());
        }
        for inputs in [InputResampling::Hold, InputResampling::Mean] {
            let plan = ResamplePlan { inputs, ..ResamplePlan::new(0.01, schema()) };
            assert_eq!(one(&text, &plan).0.text("run.csv"), text, "{inputs:?}");
        }
    }

    #[test]
    fn the_result_is_a_log_of_that_sample_time() {
        let text = "time_s,x_m,u\n1760000000,0,1\n1760000000.37,1,2\n1760000001.1,2,3\n";
        let (bench, _) = one(text, &ResamplePlan::new(0.1, schema()));
        struct Count(u64);
        impl crate::recording::Visitor for Count {
            fn begin(&mut self, _: &str) {}
            fn row(&mut self, _: &[f64], _: &[f64]) {
                self.0 += 1;
            }
        }
        let mut count = Count(0);
        let schema = LogSchema { sample_time_s: 0.1, ..schema() };
        Recording::open(&bench.path("out/deep")).unwrap().read(&schema, &mut count).unwrap();
        assert_eq!(count.0, 12);
    }

    #[test]
    fn angles_take_the_shorter_way() {
        let mut plan = ResamplePlan::new(0.5, schema());
        plan.angles = vec![true];
        let text = format!("time_s,x,u\n0,{},0\n1,{},0\n2,{},0\n", PI - 0.1, 0.1 - PI, PI - 0.3);
        let (bench, _) = one(&text, &plan);
        for (row, expected) in
            bench.rows("run.csv").iter().zip([PI - 0.1, PI, PI + 0.1, PI - 0.1, PI - 0.3])
        {
            assert!((row[1] - expected).abs() < 1e-14, "{row:?} {expected}");
        }

        // In degrees one turn is 360, and the numbers stay degrees.
        plan.schema.states[0].factor = 1f64.to_radians();
        let (bench, _) = one("time_s,x,u\n0,170,0\n1,-170,0\n2,-150,0\n", &plan);
        for (row, expected) in bench.rows("run.csv").iter().zip([170.0, 180.0, 190.0, 200.0, 210.0])
        {
            assert!((row[1] - expected).abs() < 1e-12, "{row:?} {expected}");
        }

        // What is not an angle goes straight.
        plan.angles = vec![false];
        let (bench, _) = one("time_s,x,u\n0,170,0\n1,-170,0\n", &plan);
        assert_eq!(bench.rows("run.csv")[1][1], 0.0);
    }

    #[test]
    fn inputs_are_held_or_averaged() {
        // u: 1 for 0.25 s, 5 for 0.75 s, 2 for 1 s, then 4.
        let text = "time_s,x,u\n0,0,1\n0.25,0,5\n1,0,2\n2,0,4\n";
        let inputs = |inputs, dt_s| {
            let plan = ResamplePlan { inputs, ..ResamplePlan::new(dt_s, schema()) };
            let rows = one(text, &plan).0.rows("run.csv");
            rows.iter().map(|row| row[2]).collect::<Vec<_>>()
        };
        assert_eq!(inputs(InputResampling::Hold, 1.0), [1.0, 2.0, 4.0]);
        assert_eq!(inputs(InputResampling::Mean, 1.0), [4.0, 2.0, 4.0]);
        // On a grid that meets every row both are the held value.
        let held = [1.0, 5.0, 5.0, 5.0, 2.0, 2.0, 2.0, 2.0, 4.0];
        assert_eq!(inputs(InputResampling::Hold, 0.25), held);
        assert_eq!(inputs(InputResampling::Mean, 0.25), held);
        // The last interval goes on beyond the last row, whose input acts to its end.
        assert_eq!(inputs(InputResampling::Hold, 1.5), [1.0, 2.0]);
        let mean = inputs(InputResampling::Mean, 1.5);
        assert!((mean[0] - (0.25 + 0.75 * 5.0 + 0.5 * 2.0) / 1.5).abs() < 1e-15);
        assert!((mean[1] - (0.5 * 2.0 + 1.0 * 4.0) / 1.5).abs() < 1e-15);
    }

    #[test]
    fn the_mean_keeps_the_integral() {
        let mut text = String::from("time_s,x,u\n");
        let mut integral = 0.0;
        let mut t = 0.0;
        for k in 0..500 {
            let u = (f64::from(k) * 0.7).sin();
            let step = 0.01 + 0.004 * (f64::from(k) * 1.3).cos();
            text += &format!("{t},0,{u}\n");
            t += step;
            integral += u * step;
        }
        // What acts after the last row does not matter if it is 0.
        text += &format!("{t},0,0\n");
        let plan =
            ResamplePlan { inputs: InputResampling::Mean, ..ResamplePlan::new(0.037, schema()) };
        let rows = one(&text, &plan).0.rows("run.csv");
        let sum: f64 = rows.iter().map(|row| row[2] * 0.037).sum();
        assert!((sum - integral).abs() < 1e-12, "{sum} {integral}");
    }

    #[test]
    fn gaps_split_and_pieces_that_are_too_short_are_dropped() {
        let text = "time_s,x,u\n0,0,0\n0.2,2,0\n5,9,0\n9,1,0\n9.3,4,0\n";
        let plan = ResamplePlan { max_gap_s: 1.0, ..ResamplePlan::new(0.1, schema()) };
        let (bench, report) = one(text, &plan);
        assert_eq!((report.gaps, report.dropped, report.rows), (2, 1, 7));
        assert_eq!(
            report.files,
            ["out/deep/run.csv", "out/deep/run.part003.csv"].map(|name| bench.path(name))
        );
        let rows = bench.rows("run.part003.csv");
        assert_eq!(rows[0], [9.0, 1.0, 0.0]);
        assert_eq!(rows[3], [9.3, 4.0, 0.0]);

        let bridged = ResamplePlan { max_gap_s: f64::INFINITY, ..plan };
        assert_eq!(one(text, &bridged).1.rows, 94);
    }

    #[test]
    fn every_trajectory_becomes_a_file() {
        let text = "run,time_s,x,u\na/1,0,0,0\na/1,1,1,0\nb,0,5,0\nb,1,6,0\n";
        let bench = Bench::new(&[("a.csv", text), ("b.csv", text)]);
        let mut plan = ResamplePlan::new(0.5, schema());
        plan.schema.episode = Some("run".into());
        let report = bench.run(&plan).unwrap();
        let names: Vec<_> = report.files.iter().map(|f| f.file_name().unwrap()).collect();
        assert_eq!(names, ["a#a_1.csv", "a#b.csv", "b#a_1.csv", "b#b.csv"]);
        assert_eq!(bench.rows("a#b.csv")[1], [0.5, 5.5, 0.0]);
        assert_eq!(fs::read_dir(bench.path("out/deep")).unwrap().count(), 4);
        assert_eq!(report.read.trajectories, 4);
    }

    #[test]
    fn headers_with_commas_survive() {
        let mut plan = ResamplePlan::new(1.0, schema());
        plan.schema.states[0].column = Some("x, in m".into());
        let (bench, _) = one("time_s,\"x, in m\",u\n0,1,2\n1,2,3\n", &plan);
        assert_eq!(bench.text("run.csv"), "time_s,\"x, in m\",u\n0,1,2\n1,2,3\n");
    }

    #[test]
    fn a_bad_row_leaves_nothing_behind() {
        let good = "time_s,x,u\n0,0,0\n1,0,0\n";
        let error = |bad: &str| {
            let bench = Bench::new(&[("a.csv", good), ("b.csv", bad)]);
            let error = bench.run(&ResamplePlan::new(0.5, schema())).unwrap_err();
            bench.assert_clean();
            error.to_string()
        };
        let text = error("time_s,x,u\n0,0,0\n1,zero,0\n");
        assert!(text.contains("b.csv, row 3, column `x`: expected a number, found `zero`"));
        let text = error("time_s,x,u\n0,0,0\n1,0,0\n1,0,0\n");
        assert!(text.contains("b.csv, row 4, column `time_s`: the time stands still"), "{text}");
        let text = error("time_s,x,u\n0,0,0\n1,0,0\n0.9,0,0\n");
        assert!(text.contains("row 4, column `time_s`: the time goes backwards"), "{text}");
        assert!(text.contains("found a step of -0.1 s"), "{text}");
        assert!(!text.contains('\n'));
    }

    #[test]
    fn nothing_left_is_an_error() {
        let bench = Bench::new(&[("run.csv", "time_s,x,u\n0,0,0\n1,0,0\n")]);
        let error = bench.run(&ResamplePlan::new(0.01, schema())).unwrap_err();
        assert!(error.to_string().contains("gaps longer than 0.1 s are too short"), "{error}");
        bench.assert_clean();
        let error = bench.run(&ResamplePlan::new(2.0, schema())).unwrap_err();
        assert!(matches!(error, ResampleError::NothingLeft { dt_s: 2.0, .. }));
    }

    #[test]
    fn plans_are_checked() {
        let bench = Bench::new(&[("run.csv", "time_s,x,u\n0,0,0\n1,0,0\n")]);
        let plan = ResamplePlan::new(0.5, schema());
        for dt_s in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let error = bench.run(&ResamplePlan { dt_s, ..plan.clone() }).unwrap_err();
            assert!(matches!(error, ResampleError::NotPositive { name: "dt", .. }), "{error}");
        }
        for max_gap_s in [0.0, f64::NAN] {
            let error = bench.run(&ResamplePlan { max_gap_s, ..plan.clone() }).unwrap_err();
            assert!(matches!(error, ResampleError::NotPositive { name: "max gap", .. }));
        }
        let error = bench.run(&ResamplePlan { angles: vec![], ..plan }).unwrap_err();
        assert!(matches!(error, ResampleError::Angles { expected: 1, found: 0 }));
        bench.assert_clean();
    }

    #[test]
    fn logs_are_never_mixed_with_results() {
        let bench = Bench::new(&[("run.csv", "time_s,x,u\n0,0,0\n1,0,0\n")]);
        let plan = ResamplePlan::new(0.5, schema());
        for path in ["logs", "logs/run.csv"] {
            let recording = Recording::open(&bench.path(path)).unwrap();
            let error = resample(&recording, &plan, &bench.path("logs/../logs")).unwrap_err();
            assert!(matches!(error, ResampleError::IntoLogs { .. }), "{error}");
        }
        bench.run(&plan).unwrap();
        let before = bench.text("run.csv");
        let error = bench.run(&plan).unwrap_err();
        assert!(matches!(error, ResampleError::HoldsLogs { .. }), "{error}");
        assert_eq!(bench.text("run.csv"), before);

        // A directory that exists without logs is fine, a file in its place is not.
        let recording = Recording::open(&bench.path("logs")).unwrap();
        fs::create_dir(bench.path("notes")).unwrap();
        fs::write(bench.path("notes/readme.txt"), "").unwrap();
        assert!(resample(&recording, &plan, &bench.path("notes")).is_ok());
        let error = resample(&recording, &plan, &bench.path("notes/readme.txt")).unwrap_err();
        assert!(matches!(error, ResampleError::Unwritable { .. }), "{error}");
    }
}
