//! Robot logs: CSV files read row by row, checked, and handed on.
//!
//! A [`Recording`] is one `.csv` file or all `.csv` files of a directory. Reading streams: memory
//! holds one buffer, one row and the labels of the episodes met so far in a file, however long
//! the log is.
//!
//! # Form of a log
//!
//! * The first line is the header; fields are separated by commas. A UTF-8 byte order mark, LF or
//!   CRLF, blank lines, spaces around a field and quoted fields that end on their line are
//!   accepted. A line is at most 1 MiB long.
//! * One column holds the time in seconds. A quantity named `x` with unit `m` is looked for as
//!   `x`, then as `x_m` ([`unit_suffix`]), unless its column is named outright. Other columns
//!   are ignored.
//! * A file is one trajectory, or several if an episode column is named: a new one starts where
//!   the text of that column changes.
//! * The input in a row acts from that row's time to the next row's.
//!
//! Rows in messages are line numbers of the file: the header is row 1.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read};
use std::mem;
use std::ops::Range;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use thiserror::Error;

/// Size of the read buffer, in bytes; also the grain of [`Visitor::progress`].
const BUFFER_BYTES: usize = 1 << 16;

const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();

/// Longest line accepted, in bytes: a file without line ends must not fill the memory.
const MAX_LINE_BYTES: u64 = 1 << 20;

/// Largest deviation of a time step from the sample time, relative to the sample time.
const STEP_TOLERANCE: f64 = 0.05;

/// Added to [`STEP_TOLERANCE`] (same scale), so that a step of exactly 5 % in decimal digits
/// passes although neither time is exact in binary.
const STEP_ROUNDING: f64 = 1e-6;

/// A step longer than this many sample times is called a gap, a shorter one jitter.
const GAP_STEPS: f64 = 1.5;

/// One quantity read from a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogColumn {
    /// Name of the quantity, such as `theta`.
    pub name: String,
    /// Unit of the column in the log, such as `deg` or `rad/s`; empty if it has none.
    pub unit: String,
    /// The exact header of the column. `None`: `name` or `name_<unit>` is looked for.
    pub column: Option<String>,
    /// Factor applied to every number read: π/180 for degrees that are wanted in radians,
    /// 1 otherwise.
    pub factor: f64,
}

impl LogColumn {
    /// A column found by its name and unit, read as it stands (factor 1).
    pub fn new(name: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { name: name.into(), unit: unit.into(), column: None, factor: 1.0 }
    }

    /// The headers under which this quantity may stand.
    fn candidates(&self) -> Vec<String> {
        if let Some(column) = &self.column {
            return vec![column.clone()];
        }
        let suffix = unit_suffix(&self.unit);
        if suffix.is_empty() {
            vec![self.name.clone()]
        } else {
            vec![self.name.clone(), format!("{}_{suffix}", self.name)]
        }
    }
}

/// What is needed of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogSchema {
    /// Time between two rows, in seconds; positive. [`Recording::read`] accepts steps within
    /// 5 % of it.
    pub sample_time_s: f64,
    /// Header of the time column, in seconds.
    pub time: String,
    /// Header of the episode column, if the files hold several trajectories each.
    pub episode: Option<String>,
    /// The states, in the order in which a row hands them on.
    pub states: Vec<LogColumn>,
    /// The inputs, in the order in which a row hands them on.
    pub inputs: Vec<LogColumn>,
    /// The robot.toml that says all this, for the command that messages propose.
    pub robot: Option<PathBuf>,
}

impl LogSchema {
    /// A schema with the time in `time_s` and one trajectory per file.
    pub fn new(sample_time_s: f64, states: Vec<LogColumn>, inputs: Vec<LogColumn>) -> Self {
        Self { sample_time_s, time: "time_s".into(), episode: None, states, inputs, robot: None }
    }
}

/// The suffix of a column header that stands for a unit: `/` becomes `p`, and whatever else is
/// not alphanumeric is left out.
///
/// ```
/// use trainer::recording::unit_suffix;
///
/// assert_eq!(unit_suffix("rad/s"), "radps");
/// assert_eq!(unit_suffix("N m"), "Nm");
/// ```
pub fn unit_suffix(unit: &str) -> String {
    unit.chars().map(|c| if c == '/' { 'p' } else { c }).filter(|c| c.is_alphanumeric()).collect()
}

/// Receives the rows of a recording, in order.
pub trait Visitor {
    /// A new trajectory starts. `name` is the file's stem, followed by `#` and the episode's
    /// label if there is an episode column.
    fn begin(&mut self, name: &str);

    /// The next row of the current trajectory: the states and the inputs in the schema's order,
    /// each multiplied by its column's factor. All numbers are finite.
    fn row(&mut self, states: &[f64], inputs: &[f64]);

    /// `bytes_read` of [`Recording::bytes`] have been read. Called about every 64 KiB.
    fn progress(&mut self, bytes_read: u64) {
        let _ = bytes_read;
    }
}

/// What was read, once all of it has been read without an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Summary {
    /// Number of trajectories, each of at least two rows.
    pub trajectories: usize,
    /// Number of rows of all trajectories together, headers and blank lines not counted.
    pub rows: u64,
    /// SHA-256 over all files in order, each as its length in bytes (`u64`, little-endian)
    /// followed by its bytes. File names do not enter.
    pub sha256: [u8; 32],
}

/// Why a path cannot be opened as a recording.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The path does not exist.
    #[error(
        "{}: no such file or directory; expected a directory of CSV logs or one .csv file",
        path.display()
    )]
    NotFound {
        /// The path as given.
        path: PathBuf,
    },
    /// The operating system refuses to list the directory or to describe the file.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// The directory or file.
        path: PathBuf,
        /// What the operating system answered.
        source: io::Error,
    },
    /// The file's name does not end in `.csv`.
    #[error(
        "{}: expected a directory of CSV logs or one .csv file, found a file with another ending",
        path.display()
    )]
    NotCsv {
        /// The path as given.
        path: PathBuf,
    },
    /// Something named `.csv` is a directory, a pipe or a device.
    #[error(
        "{}: expected a regular file, found something else under a .csv name; rename or move it",
        path.display()
    )]
    NotRegular {
        /// The offending entry.
        path: PathBuf,
    },
    /// The directory holds no `.csv` file.
    #[error(
        "{}: the directory holds no .csv file (directories inside it are not searched); \
         expected one file per trajectory, or files with an episode column",
        path.display()
    )]
    NoLogs {
        /// The directory.
        path: PathBuf,
    },
}

/// How a time step misses the sample time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum StepFault {
    /// The time of the row before is repeated.
    StandsStill,
    /// The time is earlier than in the row before.
    GoesBack,
    /// The step is longer than 1.5 sample times: rows are missing.
    Gap,
    /// The step is off by more than 5 %, but no row seems to be missing.
    Jitter,
}

/// Why reading a recording stopped.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The sample time of the schema is not a positive number.
    #[error("the sample time is {found_s} s; expected a positive, finite number of seconds")]
    SampleTime {
        /// The sample time of the schema, in seconds.
        found_s: f64,
    },
    /// The operating system refuses to open or read the file.
    #[error("{}: cannot be read: {source}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// What the operating system answered.
        source: io::Error,
    },
    /// The file's length changed between opening it and reaching its end.
    #[error(
        "{}: the file was {expected} bytes long when it was opened, and {found} bytes were read: \
         something is still writing it; read it again once it is complete",
        file.display()
    )]
    Changed {
        /// The file.
        file: PathBuf,
        /// Its length when it was opened, in bytes.
        expected: u64,
        /// The number of bytes read.
        found: u64,
    },
    /// The file holds nothing but blank lines.
    #[error(
        "{}: the file is empty; expected a header row and at least two rows of numbers; \
         remove the file or record it again",
        file.display()
    )]
    Empty {
        /// The file.
        file: PathBuf,
    },
    /// The header is separated by something other than commas.
    #[error(
        "{}, row 1: expected columns separated by commas, found {found:?} between them; \
         export the log with commas (and a point in the numbers)",
        file.display()
    )]
    Separator {
        /// The file.
        file: PathBuf,
        /// The separator found.
        found: char,
    },
    /// A needed column is not in the header.
    #[error(
        "{}, row 1: no column for `{quantity}`: looked for `{}`, found {}; \
         rename the column in the log or name it in robot.toml",
        file.display(), looked_for.join("` or `"), found.join(", ")
    )]
    MissingColumn {
        /// The file.
        file: PathBuf,
        /// The quantity.
        quantity: String,
        /// The headers that would have been accepted.
        looked_for: Vec<String>,
        /// The headers of the file.
        found: Vec<String>,
    },
    /// Two columns could be the one that is needed.
    #[error(
        "{}, row 1: two columns could be `{quantity}`: `{}`; expected one of them; \
         name the right column in robot.toml or remove the other",
        file.display(), found.join("` and `")
    )]
    AmbiguousColumn {
        /// The file.
        file: PathBuf,
        /// The quantity.
        quantity: String,
        /// The headers that fit, in the order of the file.
        found: Vec<String>,
    },
    /// A needed column occurs twice in the header.
    #[error(
        "{}, row 1: `{column}` is the header of columns {first} and {second}; \
         expected it once; rename or remove one of them",
        file.display()
    )]
    DuplicateColumn {
        /// The file.
        file: PathBuf,
        /// The header.
        column: String,
        /// Where it stands first, counted from 1.
        first: usize,
        /// Where it stands again, counted from 1.
        second: usize,
    },
    /// The file holds a header and nothing else.
    #[error(
        "{}: the file holds a header but no rows; expected at least two rows of numbers; \
         remove the file or record it again",
        file.display()
    )]
    NoRows {
        /// The file.
        file: PathBuf,
    },
    /// A trajectory is too short to hold one step.
    #[error(
        "{}, row {line}: trajectory `{trajectory}` has one row; expected at least two, \
         which make one step; remove it or record it again",
        file.display()
    )]
    OneRow {
        /// The file.
        file: PathBuf,
        /// Line of the only row.
        line: u64,
        /// Name of the trajectory.
        trajectory: String,
    },
    /// A row has more or fewer fields than the header.
    #[error(
        "{}, row {line}, column `{column}`: expected {expected} fields as in the header, \
         found {found}; complete or delete the row (a log that was cut off ends like this, \
         and a decimal comma makes two fields of one)",
        file.display()
    )]
    RaggedRow {
        /// The file.
        file: PathBuf,
        /// Line of the row.
        line: u64,
        /// The first column without a field, or the number of the first field without a column.
        column: String,
        /// Number of fields in the header.
        expected: usize,
        /// Number of fields in the row.
        found: usize,
    },
    /// A line does not end within the accepted length.
    #[error(
        "{}, row {line}: the line is longer than {limit} bytes; expected CSV text \
         with one row per line",
        file.display()
    )]
    LongRow {
        /// The file.
        file: PathBuf,
        /// The line.
        line: u64,
        /// The longest line accepted, in bytes.
        limit: u64,
    },
    /// A field that is needed is empty.
    #[error(
        "{}, row {line}, column `{column}`: expected {expected}, found an empty field; \
         fill it in or delete the row",
        file.display()
    )]
    EmptyField {
        /// The file.
        file: PathBuf,
        /// Line of the row.
        line: u64,
        /// Header of the column.
        column: String,
        /// What the field should hold.
        expected: &'static str,
    },
    /// A field holds text where a number is needed.
    #[error(
        "{}, row {line}, column `{column}`: expected a number, found `{found}`; \
         correct the field or delete the row",
        file.display()
    )]
    NotANumber {
        /// The file.
        file: PathBuf,
        /// Line of the row.
        line: u64,
        /// Header of the column.
        column: String,
        /// The field, shortened if it is long.
        found: String,
    },
    /// A number is NaN or infinite.
    #[error(
        "{}, row {line}, column `{column}`: expected a finite number, found `{found}`; \
         a lost measurement cannot be used: correct the field, or end the trajectory before it",
        file.display()
    )]
    NotFinite {
        /// The file.
        file: PathBuf,
        /// Line of the row.
        line: u64,
        /// Header of the column.
        column: String,
        /// The field, shortened if it is long.
        found: String,
    },
    /// An episode goes on after another one started.
    #[error(
        "{}, row {line}, column `{column}`: episode `{episode}` returns after it had ended; \
         expected the rows of an episode one after the other; sort the log by episode and time",
        file.display()
    )]
    EpisodeReturns {
        /// The file.
        file: PathBuf,
        /// Line of the row.
        line: u64,
        /// Header of the episode column.
        column: String,
        /// The label that returned.
        episode: String,
    },
    /// A time step is more than 5 % off the sample time.
    #[error("{}, row {line}, column `{column}`: {}", file.display(),
        step_message(*fault, *found_s, *expected_s, command))]
    TimeStep {
        /// The file.
        file: PathBuf,
        /// Line of the later of the two rows.
        line: u64,
        /// Header of the time column.
        column: String,
        /// How the step is off.
        fault: StepFault,
        /// The step found, in seconds.
        found_s: f64,
        /// The sample time, in seconds.
        expected_s: f64,
        /// The command that puts the recording on an even grid.
        command: String,
    },
}

fn step_message(fault: StepFault, found_s: f64, expected_s: f64, command: &str) -> String {
    let found = nanoseconds(found_s);
    let command = format!("`{command}`");
    match fault {
        StepFault::StandsStill => format!(
            "the time stands still: expected a step of {expected_s} s ± 5 %, found {found} s; \
             delete the repeated row, and if the steps are uneven then, run {command}"
        ),
        StepFault::GoesBack => format!(
            "the time goes backwards: expected a step of {expected_s} s ± 5 %, found {found} s; \
             sort the rows, or split the log here if a new run starts, and if the steps are \
             uneven then, run {command}"
        ),
        StepFault::Gap => format!(
            "a gap in the time: expected a step of {expected_s} s ± 5 %, found {found} s; \
             correct the sample time if all steps are like this, or run {command}, which \
             interpolates short gaps and splits the log at long ones"
        ),
        StepFault::Jitter => format!(
            "the time jitters: expected a step of {expected_s} s ± 5 %, found {found} s; \
             correct the sample time if all steps are like this, or run {command}"
        ),
    }
}

/// Rounds a time in seconds to whole nanoseconds, so that `0.3 - 0.2` prints as `0.1`.
pub(crate) fn nanoseconds(time_s: f64) -> f64 {
    (time_s * 1e9).round() / 1e9
}

/// The command that resamples `logs` as `schema` reads them. `columns` are the headers of the time,
/// the states and the inputs.
fn resample_command(logs: &Path, schema: &LogSchema, columns: &[String]) -> String {
    let mut words = vec!["trainer".to_owned(), "resample".to_owned(), shell_word(logs)];
    let mut option = |name: &str, value: &str| words.extend([name.to_owned(), value.to_owned()]);
    option("--dt", &schema.sample_time_s.to_string());
    if let Some(robot) = &schema.robot {
        option("--robot", &shell_word(robot));
    } else {
        if schema.time != "time_s" {
            option("--time", &shell_word(Path::new(&schema.time)));
        }
        if let Some(episode) = &schema.episode {
            option("--episode", &shell_word(Path::new(episode)));
        }
        let (states, inputs) = columns[1..].split_at(schema.states.len());
        let in_unit = |unit| {
            let states = states.iter().zip(&schema.states);
            states.filter(|(_, s)| s.unit == unit).map(|(c, _)| c.clone()).collect::<Vec<_>>()
        };
        let lists = [
            ("--inputs", inputs.to_vec()),
            ("--angles", in_unit("rad")),
            ("--degrees", in_unit("deg")),
        ];
        for (name, list) in lists.into_iter().filter(|(_, list)| !list.is_empty()) {
            option(name, &shell_word(Path::new(&list.join(","))));
        }
    }
    option("--out", "DIR");
    words.join(" ")
}

/// The path as one word of a POSIX shell.
fn shell_word(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "_-./:,@%+=".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// The files of a log, in a fixed order.
#[derive(Clone, Debug)]
pub struct Recording {
    path: PathBuf,
    files: Vec<PathBuf>,
    bytes: u64,
}

impl Recording {
    /// Finds the files of a log: `path` itself if it is a `.csv` file, otherwise the `.csv`
    /// files directly inside it, sorted by the bytes of their names. Hidden files are left out,
    /// as `*.csv` does in a shell; `.CSV` counts as well.
    ///
    /// # Errors
    ///
    /// [`RecordingError`] if the path does not exist or cannot be listed, holds no log, or
    /// something that is not a regular file has the name of one.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let unreadable =
            |path: &Path, source| RecordingError::Unreadable { path: path.to_owned(), source };
        let kind = match fs::metadata(path) {
            Err(source) if source.kind() == io::ErrorKind::NotFound => {
                return Err(RecordingError::NotFound { path: path.into() });
            }
            other => other.map_err(|source| unreadable(path, source))?,
        };

        let mut files = Vec::new();
        if kind.is_dir() {
            for entry in fs::read_dir(path).map_err(|source| unreadable(path, source))? {
                let file = entry.map_err(|source| unreadable(path, source))?.path();
                let name = file.file_name().unwrap_or_default().as_encoded_bytes();
                if is_csv(&file) && !name.starts_with(b".") {
                    files.push(file);
                }
            }
            if files.is_empty() {
                return Err(RecordingError::NoLogs { path: path.into() });
            }
            files.sort_by_cached_key(|file| file.file_name().map(OsStr::to_owned));
        } else if is_csv(path) {
            files.push(path.to_owned());
        } else {
            return Err(RecordingError::NotCsv { path: path.into() });
        }

        let mut bytes = 0;
        for file in &files {
            let facts = fs::metadata(file).map_err(|source| unreadable(file, source))?;
            if !facts.is_file() {
                return Err(RecordingError::NotRegular { path: file.clone() });
            }
            bytes += facts.len();
        }
        Ok(Self { path: path.to_owned(), files, bytes })
    }

    /// The path that was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The files, in the order in which they are read.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// Size of all files together when they were found, in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// The headers of the first file, in its order.
    ///
    /// # Errors
    ///
    /// [`ReadError`] if the file cannot be read or has no header.
    pub fn columns(&self) -> Result<Vec<String>, ReadError> {
        Lines::open(&self.files[0], Sha256::new())?.header()
    }

    /// Streams all rows, file after file, to `visitor`. Every step in time must be within 5 %
    /// of the sample time.
    ///
    /// ```
    /// use trainer::recording::{LogColumn, LogSchema, Recording, Visitor};
    ///
    /// #[derive(Default)]
    /// struct Headings(Vec<f64>);
    ///
    /// impl Visitor for Headings {
    ///     fn begin(&mut self, name: &str) {
    ///         assert_eq!(name, "run");
    ///     }
    ///     fn row(&mut self, states: &[f64], _inputs: &[f64]) {
    ///         self.0.push(states[0]);
    ///     }
    /// }
    ///
    /// let dir = tempfile::tempdir()?;
    /// std::fs::write(dir.path().join("run.csv"), "time_s,theta_deg\n0,0\n0.1,180\n")?;
    ///
    /// let theta = LogColumn { factor: 1f64.to_radians(), ..LogColumn::new("theta", "deg") };
    /// let schema = LogSchema::new(0.1, vec![theta], vec![]);
    /// let mut headings = Headings::default();
    /// let summary = Recording::open(dir.path())?.read(&schema, &mut headings)?;
    /// assert_eq!(headings.0, [0.0, std::f64::consts::PI]);
    /// assert_eq!((summary.trajectories, summary.rows), (1, 2));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`ReadError`] at the first fault. The visitor has then seen the rows before it, and
    /// nothing it made of them may be used.
    pub fn read<V: Visitor + ?Sized>(
        &self,
        schema: &LogSchema,
        visitor: &mut V,
    ) -> Result<Summary, ReadError> {
        let expected_s = schema.sample_time_s;
        if !(expected_s.is_finite() && expected_s > 0.0) {
            return Err(ReadError::SampleTime { found_s: expected_s });
        }
        let mut last_s = 0.0;
        let mut reported = 0;
        let summary = self.stream(schema, |row| {
            if let Some(name) = row.begins {
                visitor.begin(name);
            } else if let Some(fault) = step_fault(last_s, row.time_s, expected_s) {
                return Err(ReadError::TimeStep {
                    file: row.file.to_owned(),
                    line: row.line,
                    column: row.columns[0].clone(),
                    fault,
                    found_s: row.time_s - last_s,
                    expected_s,
                    command: resample_command(&self.path, schema, row.columns),
                });
            }
            last_s = row.time_s;
            visitor.row(row.states, row.inputs);
            if row.bytes_read != reported {
                reported = row.bytes_read;
                visitor.progress(reported);
            }
            Ok(())
        })?;
        Ok(summary)
    }

    /// Streams all rows with their times, which may be anything finite.
    pub(crate) fn stream<E: From<ReadError>>(
        &self,
        schema: &LogSchema,
        mut visit: impl FnMut(Row<'_>) -> Result<(), E>,
    ) -> Result<Summary, E> {
        let mut hasher = Sha256::new();
        let mut trajectories = 0;
        let mut rows = 0;
        let mut bytes_before = 0;
        for file in &self.files {
            let mut log = Log::open(Lines::open(file, hasher)?, schema)?;
            while let Some(begins) = log.advance()? {
                trajectories += usize::from(begins);
                rows += 1;
                let (states, inputs) = log.values[1..].split_at(schema.states.len());
                visit(Row {
                    file,
                    line: log.lines.line,
                    begins: begins.then_some(log.trajectory.as_str()),
                    columns: &log.columns,
                    time_s: log.values[0],
                    states,
                    inputs,
                    bytes_read: bytes_before + log.lines.input.get_ref().bytes,
                })?;
            }
            let source = log.lines.input.into_inner();
            bytes_before += source.bytes;
            hasher = source.hasher;
        }
        Ok(Summary { trajectories, rows, sha256: hasher.finalize().into() })
    }
}

fn is_csv(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
}

fn step_fault(last_s: f64, time_s: f64, expected_s: f64) -> Option<StepFault> {
    let step = time_s - last_s;
    // Times since 1970 carry a rounding of their own, of a fraction of a microsecond.
    let tolerance = (STEP_TOLERANCE + STEP_ROUNDING) * expected_s
        + 2.0 * f64::EPSILON * time_s.abs().max(last_s.abs());
    if (step - expected_s).abs() <= tolerance {
        None
    } else if step == 0.0 {
        Some(StepFault::StandsStill)
    } else if step < 0.0 {
        Some(StepFault::GoesBack)
    } else if step > GAP_STEPS * expected_s {
        Some(StepFault::Gap)
    } else {
        Some(StepFault::Jitter)
    }
}

/// One row of a log.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row<'a> {
    pub file: &'a Path,
    /// Line number in the file; the header is on line 1.
    pub line: u64,
    /// The name of the trajectory, if this is its first row.
    pub begins: Option<&'a str>,
    /// Headers of the time, the states and the inputs.
    pub columns: &'a [String],
    pub time_s: f64,
    pub states: &'a [f64],
    pub inputs: &'a [f64],
    /// Bytes read so far of all files.
    pub bytes_read: u64,
}

/// A file whose bytes are hashed and counted as they are read.
struct HashedFile {
    file: File,
    hasher: Sha256,
    bytes: u64,
}

impl Read for HashedFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let length = self.file.read(buffer)?;
        self.hasher.update(&buffer[..length]);
        self.bytes += length as u64;
        Ok(length)
    }
}

/// The lines of a CSV file, split into fields.
struct Lines<'a> {
    file: &'a Path,
    /// Length of the file when it was opened, in bytes.
    length: u64,
    input: BufReader<HashedFile>,
    line: u64,
    /// The line without its end, and with U+FFFD in the place of what is not UTF-8.
    text: String,
    /// Where the fields are in `text`.
    fields: Vec<Range<usize>>,
}

impl<'a> Lines<'a> {
    fn open(file: &'a Path, mut hasher: Sha256) -> Result<Self, ReadError> {
        let unreadable = |source| ReadError::Unreadable { file: file.to_owned(), source };
        let input = File::open(file).map_err(unreadable)?;
        let length = input.metadata().map_err(unreadable)?.len();
        hasher.update(length.to_le_bytes());
        let input = HashedFile { file: input, hasher, bytes: 0 };
        Ok(Self {
            file,
            length,
            input: BufReader::with_capacity(BUFFER_BYTES, input),
            line: 0,
            text: String::new(),
            fields: Vec::new(),
        })
    }

    /// Moves to the next line that is not blank; `false` at the end of the file.
    fn advance(&mut self) -> Result<bool, ReadError> {
        loop {
            let mut text = mem::take(&mut self.text).into_bytes();
            text.clear();
            let length =
                self.input.by_ref().take(MAX_LINE_BYTES + 1).read_until(b'\n', &mut text).map_err(
                    |source| ReadError::Unreadable { file: self.file.to_owned(), source },
                )?;
            if length == 0 {
                let found = self.input.get_ref().bytes;
                if found != self.length {
                    return Err(ReadError::Changed {
                        file: self.file.to_owned(),
                        expected: self.length,
                        found,
                    });
                }
                return Ok(false);
            }
            self.line += 1;
            if length as u64 > MAX_LINE_BYTES {
                return Err(ReadError::LongRow {
                    file: self.file.to_owned(),
                    line: self.line,
                    limit: MAX_LINE_BYTES,
                });
            }
            if self.line == 1 && text.starts_with(BYTE_ORDER_MARK) {
                text.drain(..BYTE_ORDER_MARK.len());
            }
            text.truncate(text.trim_ascii_end().len());
            self.text = String::from_utf8(text)
                .unwrap_or_else(|odd| String::from_utf8_lossy(odd.as_bytes()).into_owned());
            if !self.text.is_empty() {
                self.split();
                return Ok(true);
            }
        }
    }

    /// Finds the fields of `text`. Plain lines, which is nearly all of them, are split in place.
    fn split(&mut self) {
        self.fields.clear();
        let mut start = 0;
        let mut quotes = 0;
        let (words, rest) = self.text.as_bytes().as_chunks::<8>();
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        for (index, word) in words.iter().chain([&last]).enumerate() {
            quotes |= occurrences(*word, b'"');
            let mut commas = occurrences(*word, b',');
            while commas != 0 {
                let end = 8 * index + commas.trailing_zeros() as usize / 8;
                self.fields.push(start..end);
                start = end + 1;
                commas &= commas - 1;
            }
        }
        self.fields.push(start..self.text.len());
        if quotes != 0 {
            self.split_quoted();
        }
    }

    fn split_quoted(&mut self) {
        let mut record = csv::StringRecord::new();
        let read = csv::ReaderBuilder::new()
            .has_headers(false)
            .buffer_capacity(self.text.len())
            .from_reader(self.text.as_bytes())
            .read_record(&mut record);
        // Any text is a record; should csv see it otherwise, the plain fields stand.
        if let Ok(true) = read {
            self.fields.clear();
            self.fields.extend((0..record.len()).filter_map(|field| record.range(field)));
            self.text.clear();
            self.text.push_str(record.as_slice());
        }
    }

    fn field(&self, field: usize) -> &str {
        &self.text[self.fields[field].clone()]
    }

    /// Reads the header.
    fn header(&mut self) -> Result<Vec<String>, ReadError> {
        if !self.advance()? {
            return Err(ReadError::Empty { file: self.file.to_owned() });
        }
        let header: Vec<String> =
            (0..self.fields.len()).map(|field| self.field(field).trim().to_owned()).collect();
        if let [only] = header.as_slice()
            && let Some(found) = [';', '\t'].into_iter().find(|c| only.contains(*c))
        {
            return Err(ReadError::Separator { file: self.file.to_owned(), found });
        }
        Ok(header)
    }
}

/// Marks the bytes of `word` that equal `byte` by their highest bit, the first byte lowest: eight
/// comparisons at once.
fn occurrences(word: [u8; 8], byte: u8) -> u64 {
    const LOW_BITS: u64 = u64::from_le_bytes([0x7f; 8]);
    let difference = u64::from_le_bytes(word) ^ u64::from_le_bytes([byte; 8]);
    !(((difference & LOW_BITS) + LOW_BITS) | difference | LOW_BITS)
}

/// Where an episode column stands and which episodes have been seen.
struct Episodes {
    field: usize,
    current: String,
    seen: HashSet<Box<str>>,
}

/// One log file, read row by row according to a schema.
struct Log<'a> {
    lines: Lines<'a>,
    header: Vec<String>,
    /// Headers of the time, the states and the inputs.
    columns: Vec<String>,
    /// Field and factor of the time, the states and the inputs.
    sources: Vec<(usize, f64)>,
    /// The current row: the time, the states and the inputs.
    values: Vec<f64>,
    episodes: Option<Episodes>,
    /// Name of the current trajectory.
    trajectory: String,
    /// Rows of the current trajectory so far, and the line of the last one.
    rows: u64,
    last_line: u64,
}

impl<'a> Log<'a> {
    fn open(mut lines: Lines<'a>, schema: &LogSchema) -> Result<Self, ReadError> {
        let header = lines.header()?;
        let find =
            |quantity: &str, candidates| find_column(lines.file, &header, quantity, candidates);

        let mut sources = vec![(find("time", vec![schema.time.clone()])?, 1.0)];
        for column in schema.states.iter().chain(&schema.inputs) {
            sources.push((find(&column.name, column.candidates())?, column.factor));
        }
        let episodes = match &schema.episode {
            None => None,
            Some(column) => Some(Episodes {
                field: find("episode", vec![column.clone()])?,
                current: String::new(),
                seen: HashSet::new(),
            }),
        };
        Ok(Self {
            columns: sources.iter().map(|(f, _)| header[*f].clone()).collect(),
            values: vec![0.0; sources.len()],
            lines,
            header,
            sources,
            episodes,
            trajectory: String::new(),
            rows: 0,
            last_line: 0,
        })
    }

    /// Reads the next row into `values`. `Some(true)`: it starts a trajectory; `None`: the file
    /// has ended.
    fn advance(&mut self) -> Result<Option<bool>, ReadError> {
        if !self.lines.advance()? {
            self.end_trajectory()?;
            return match self.rows {
                0 => Err(ReadError::NoRows { file: self.lines.file.to_owned() }),
                _ => Ok(None),
            };
        }
        let (expected, found) = (self.header.len(), self.lines.fields.len());
        if found != expected {
            let column = match self.header.get(found) {
                Some(name) => name.clone(),
                None => (expected + 1).to_string(),
            };
            return Err(ReadError::RaggedRow {
                file: self.lines.file.to_owned(),
                line: self.lines.line,
                column,
                expected,
                found,
            });
        }
        for (value, (field, factor)) in self.values.iter_mut().zip(&self.sources) {
            match number(self.lines.field(*field)).map(|number| number * factor) {
                Some(number) if number.is_finite() => *value = number,
                other => return Err(self.bad_number(*field, other.is_some())),
            }
        }
        let begins = self.next_episode()? || self.rows == 0;
        if begins {
            self.end_trajectory()?;
            self.rows = 0;
            self.name_trajectory();
        }
        self.rows += 1;
        self.last_line = self.lines.line;
        Ok(Some(begins))
    }

    fn bad_number(&self, field: usize, is_number: bool) -> ReadError {
        let file = self.lines.file.to_owned();
        let line = self.lines.line;
        let column = self.header[field].clone();
        let found = excerpt(self.lines.field(field));
        if found.is_empty() {
            ReadError::EmptyField { file, line, column, expected: "a number" }
        } else if is_number {
            ReadError::NotFinite { file, line, column, found }
        } else {
            ReadError::NotANumber { file, line, column, found }
        }
    }

    /// Whether the current row belongs to another episode than the row before.
    fn next_episode(&mut self) -> Result<bool, ReadError> {
        let Some(episodes) = &mut self.episodes else {
            return Ok(false);
        };
        let label = self.lines.field(episodes.field).trim();
        if label == episodes.current && !label.is_empty() {
            return Ok(false);
        }
        let file = self.lines.file.to_owned();
        let line = self.lines.line;
        let column = self.header[episodes.field].clone();
        if label.is_empty() {
            return Err(ReadError::EmptyField {
                file,
                line,
                column,
                expected: "the episode's label",
            });
        }
        if !episodes.seen.insert(label.into()) {
            return Err(ReadError::EpisodeReturns { file, line, column, episode: excerpt(label) });
        }
        episodes.current.clear();
        episodes.current.push_str(label);
        Ok(true)
    }

    fn name_trajectory(&mut self) {
        let stem = self.lines.file.file_stem().unwrap_or_default();
        self.trajectory.clear();
        self.trajectory.push_str(&stem.to_string_lossy());
        if let Some(episodes) = &self.episodes {
            self.trajectory.push('#');
            self.trajectory.push_str(&episodes.current);
        }
    }

    fn end_trajectory(&self) -> Result<(), ReadError> {
        if self.rows == 1 {
            return Err(ReadError::OneRow {
                file: self.lines.file.to_owned(),
                line: self.last_line,
                trajectory: self.trajectory.clone(),
            });
        }
        Ok(())
    }
}

fn find_column(
    file: &Path,
    header: &[String],
    quantity: &str,
    looked_for: Vec<String>,
) -> Result<usize, ReadError> {
    let fits: Vec<usize> =
        (0..header.len()).filter(|field| looked_for.contains(&header[*field])).collect();
    let file = file.to_owned();
    match fits[..] {
        [field] => Ok(field),
        [] => Err(ReadError::MissingColumn {
            file,
            quantity: quantity.into(),
            looked_for,
            found: header.iter().map(|name| format!("`{name}`")).collect(),
        }),
        [first, second, ..] if header[first] == header[second] => Err(ReadError::DuplicateColumn {
            file,
            column: header[first].clone(),
            first: first + 1,
            second: second + 1,
        }),
        _ => Err(ReadError::AmbiguousColumn {
            file,
            quantity: quantity.into(),
            found: fits.iter().map(|field| header[*field].clone()).collect(),
        }),
    }
}

/// The number in a field, spaces around it ignored. NaN and the infinities are numbers here.
fn number(field: &str) -> Option<f64> {
    field.parse().or_else(|_| field.trim().parse()).ok()
}

/// A field as it is shown in a message: at most 40 characters, on one line.
fn excerpt(field: &str) -> String {
    let text = field.trim().replace(char::is_control, "\u{fffd}");
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tempfile::TempDir;

    /// Keeps everything it is shown.
    #[derive(Debug, Default)]
    struct Seen {
        names: Vec<String>,
        rows: Vec<Vec<f64>>,
        progress: Vec<u64>,
        addresses: HashSet<usize>,
    }

    impl Visitor for Seen {
        fn begin(&mut self, name: &str) {
            self.names.push(name.into());
        }
        fn row(&mut self, states: &[f64], inputs: &[f64]) {
            self.addresses.insert(states.as_ptr().addr());
            self.rows.push([states, inputs].concat());
        }
        fn progress(&mut self, bytes_read: u64) {
            self.progress.push(bytes_read);
        }
    }

    fn logs(files: &[(&str, &str)]) -> TempDir {
        let dir = TempDir::new().unwrap();
        for (name, text) in files {
            fs::write(dir.path().join(name), text).unwrap();
        }
        dir
    }

    /// One state `x` in metres, one input `u` without a unit, a row every 0.1 s.
    fn schema() -> LogSchema {
        LogSchema::new(0.1, vec![LogColumn::new("x", "m")], vec![LogColumn::new("u", "")])
    }

    fn read_with(text: &str, schema: &LogSchema) -> Result<(Seen, Summary), ReadError> {
        let dir = logs(&[("run.csv", text)]);
        let mut seen = Seen::default();
        let summary = Recording::open(dir.path()).unwrap().read(schema, &mut seen)?;
        Ok((seen, summary))
    }

    fn read(text: &str) -> Result<(Seen, Summary), ReadError> {
        read_with(text, &schema())
    }

    fn episodes(text: &str) -> Result<(Seen, Summary), ReadError> {
        read_with(text, &LogSchema { episode: Some("run".into()), ..schema() })
    }

    /// The message without the directory of the log, which is another one in every test run.
    #[track_caller]
    fn message(result: Result<(Seen, Summary), ReadError>) -> String {
        let text = result.unwrap_err().to_string();
        assert!(!text.contains('\n'), "one line: {text}");
        text[text.find("run.csv").expect("the message names the file")..].to_owned()
    }

    #[test]
    fn rows_arrive_in_order_in_the_same_memory() {
        let text = "time_s,x_m,u\n0,1,-1\n0.1,2,-2\n0.2,3,-3\n";
        let (seen, summary) = read(text).unwrap();
        assert_eq!(seen.names, ["run"]);
        assert_eq!(seen.rows, [[1.0, -1.0], [2.0, -2.0], [3.0, -3.0]]);
        assert_eq!(seen.addresses.len(), 1);
        assert_eq!(seen.progress, [text.len() as u64]);
        assert_eq!((summary.trajectories, summary.rows), (1, 3));
    }

    #[test]
    fn progress_ends_at_the_size_of_the_recording() {
        let mut text = String::from("time_s,x,u\n");
        for k in 0..20_000 {
            text += &format!("{},{k},0\n", f64::from(k) / 10.0);
        }
        let dir = logs(&[("a.csv", &text), ("b.csv", &text)]);
        let recording = Recording::open(dir.path()).unwrap();
        let mut seen = Seen::default();
        let summary = recording.read(&schema(), &mut seen).unwrap();
        assert_eq!((summary.trajectories, summary.rows), (2, 40_000));
        assert_eq!(recording.bytes(), 2 * text.len() as u64);
        assert_eq!(seen.progress.last(), Some(&recording.bytes()));
        assert!(seen.progress.is_sorted() && seen.progress.len() > 4);
        assert_eq!(seen.addresses.len(), 2, "one row of memory per file");
    }

    #[test]
    fn files_are_sorted_by_the_bytes_of_their_names() {
        let text = "time_s,x,u\n0,0,0\n0.1,0,0\n";
        let names = ["b.csv", "a10.csv", "a2.csv", "B.csv", "Z.CSV", "robot.toml", ".hidden.csv"];
        let dir = logs(&names.map(|name| (name, text)));
        fs::create_dir(dir.path().join("inner")).unwrap();
        let recording = Recording::open(dir.path()).unwrap();
        let found: Vec<_> = recording.files().iter().map(|f| f.file_name().unwrap()).collect();
        assert_eq!(found, ["B.csv", "Z.CSV", "a10.csv", "a2.csv", "b.csv"]);
        assert_eq!(recording.path(), dir.path());
        assert_eq!(recording.columns().unwrap(), ["time_s", "x", "u"]);

        let one = Recording::open(&dir.path().join("b.csv")).unwrap();
        assert_eq!(one.files(), [dir.path().join("b.csv")]);
    }

    #[test]
    fn the_digest_covers_lengths_and_bytes() {
        let (a, b) = ("time_s,x,u\n0,0,0\n0.1,0,0\n", "time_s,x,u\r\n0,0,0\r\n0.1,1,0");
        let dir = logs(&[("a.csv", a), ("b.csv", b)]);
        let recording = Recording::open(dir.path()).unwrap();
        let summary = recording.read(&schema(), &mut Seen::default()).unwrap();
        let mut bytes = Vec::new();
        for text in [a, b] {
            bytes.extend((text.len() as u64).to_le_bytes());
            bytes.extend(text.as_bytes());
        }
        assert_eq!(summary.sha256, <[u8; 32]>::from(Sha256::digest(&bytes)));
    }

    #[test]
    fn byte_order_mark_crlf_blank_lines_spaces_and_quotes_are_accepted() {
        let plain = read("time_s,x_m,u\n0,1,2\n0.1,3,4\n").unwrap().0.rows;
        for text in [
            "\u{feff}time_s,x_m,u\r\n0,1,2\r\n0.1,3,4\r\n\r\n",
            "time_s,x_m,u\n0,1,2\n\n0.1,3,4",
            "  time_s , x_m, u \n 0 ,\t1, 2\n0.1, 3, 4 \n \n\t\n\n",
            "\n\"time_s\",\"x_m\",\"u\"\n\"0\",1,2\n0.1,\"3\",4\n",
            "time_s,note,x_m,u\n0,\"a, \"\"b\"\"\",1,2\n0.1,,3,4\n",
        ] {
            assert_eq!(read(text).unwrap().0.rows, plain, "{text:?}");
        }
        let dir = logs(&[]);
        fs::write(dir.path().join("l.csv"), b"note,time_s,x,u\n\xb0C,0,1,2\n,0.1,3,4\n").unwrap();
        let mut seen = Seen::default();
        let recording = Recording::open(dir.path()).unwrap();
        recording.read(&schema(), &mut seen).unwrap();
        assert_eq!(seen.rows, plain, "other columns need not be UTF-8");
    }

    #[test]
    fn many_columns_are_split_exactly() {
        // Commas next to every other byte, at every place in a word of eight.
        let fields: Vec<String> = (0..40).map(|k| "-".to_owned() + &"7".repeat(k % 9)).collect();
        let dir = logs(&[("a.csv", &fields.join(","))]);
        assert_eq!(Recording::open(dir.path()).unwrap().columns().unwrap(), fields);
        let line = ",,-,,+,\u{1},\u{ac},,";
        let dir = logs(&[("a.csv", line)]);
        let found = Recording::open(dir.path()).unwrap().columns().unwrap();
        assert_eq!(found, line.split(',').collect::<Vec<_>>());
    }

    #[test]
    fn units_become_suffixes() {
        for (unit, suffix) in [
            ("m", "m"),
            ("rad/s", "radps"),
            ("m/s", "mps"),
            ("Nm", "Nm"),
            ("N m", "Nm"),
            ("m/s^2", "mps2"),
            ("", ""),
        ] {
            assert_eq!(unit_suffix(unit), suffix);
        }
    }

    #[test]
    fn columns_are_found_by_name_unit_or_header() {
        for header in ["time_s,u,x", "time_s,u,x_m", "u,X,time_s,x_m", "time_s,u,x,a,a"] {
            let row = vec!["7"; header.split(',').count()].join(",");
            let at = |t| {
                let place = header.split(',').position(|name| name == "time_s").unwrap();
                let mut row: Vec<&str> = row.split(',').collect();
                row[place] = t;
                row.join(",")
            };
            let text = format!("{header}\n{}\n{}\n", at("0"), at("0.1"));
            assert_eq!(read(&text).unwrap().0.rows, [[7.0, 7.0], [7.0, 7.0]], "{header}");
        }
        let mut named = schema();
        named.states[0].column = Some("position [m]".into());
        named.time = "t".into();
        let text = "t,x,position [m],u\n0,9,1,2\n.1,9,3,4\n";
        assert_eq!(read_with(text, &named).unwrap().0.rows, [[1.0, 2.0], [3.0, 4.0]]);
    }

    #[test]
    fn degrees_become_radians_by_the_factor() {
        let mut degrees = schema();
        degrees.states[0] =
            LogColumn { factor: 1f64.to_radians(), ..LogColumn::new("theta", "deg") };
        let (seen, _) = read_with("time_s,theta_deg,u\n0,180,1\n0.1,-90,1\n", &degrees).unwrap();
        assert_eq!(seen.rows[0], [std::f64::consts::PI, 1.0]);
        assert_eq!(seen.rows[1], [-std::f64::consts::FRAC_PI_2, 1.0]);
    }

    #[test]
    fn header_faults_name_what_was_looked_for_and_found() {
        assert_eq!(
            message(read("time_s,y_m,u\n0,0,0\n")),
            "run.csv, row 1: no column for `x`: looked for `x` or `x_m`, found `time_s`, `y_m`, \
             `u`; rename the column in the log or name it in robot.toml"
        );
        assert_eq!(
            message(read("time,x_m,u\n0,0,0\n")),
            "run.csv, row 1: no column for `time`: looked for `time_s`, found `time`, `x_m`, \
             `u`; rename the column in the log or name it in robot.toml"
        );
        assert_eq!(
            message(read("time_s,x,x_m,u\n0,0,0,0\n")),
            "run.csv, row 1: two columns could be `x`: `x` and `x_m`; expected one of them; \
             name the right column in robot.toml or remove the other"
        );
        assert_eq!(
            message(read("time_s,x,u,x\n0,0,0,0\n")),
            "run.csv, row 1: `x` is the header of columns 2 and 4; expected it once; \
             rename or remove one of them"
        );
        assert!(message(episodes("time_s,x,u\n0,0,0\n")).contains("looked for `run`"));
        let text = message(read("time_s;x;u\n0;0;0\n"));
        assert!(
            text.starts_with("run.csv, row 1: expected columns separated by commas, found ';'")
        );
    }

    #[test]
    fn numbers_that_cannot_be_used_are_named_by_row_and_column() {
        let with = |field: &str| message(read(&format!("time_s,x_m,u\n0,0,0\n0.1,{field},0\n")));
        assert_eq!(
            with("abc"),
            "run.csv, row 3, column `x_m`: expected a number, found `abc`; \
             correct the field or delete the row"
        );
        assert_eq!(
            with(" "),
            "run.csv, row 3, column `x_m`: expected a number, found an empty field; \
             fill it in or delete the row"
        );
        for field in ["NaN", "nan", "inf", "-Infinity", "1e999"] {
            let start =
                format!("run.csv, row 3, column `x_m`: expected a finite number, found `{field}`;");
            assert!(with(field).starts_with(&start), "{}", with(field));
        }
        assert!(with(&"9x".repeat(99)).contains(&format!("found `{}…`;", "9x".repeat(20))));
        assert!(with("0x1\u{7}").contains("found `0x1\u{fffd}`"));

        let text = message(read("time_s,x,u\r\n\r\nzero,0,0\r\n"));
        assert!(text.starts_with("run.csv, row 3, column `time_s`: expected a number"), "{text}");
        let text = message(read("time_s,x,u\n0,0,\n"));
        assert!(text.starts_with("run.csv, row 2, column `u`: expected a number"), "{text}");
    }

    #[test]
    fn a_factor_must_not_overflow() {
        let mut large = schema();
        large.states[0].factor = 10.0;
        let text = message(read_with("time_s,x,u\n0,1e308,0\n", &large));
        assert!(text.contains("row 2, column `x`: expected a finite number"), "{text}");
    }

    #[test]
    fn ragged_rows_are_named_by_the_first_column_that_does_not_fit() {
        let text = message(read("time_s,x,u\n0,0,0\n0.1,0\n"));
        let start = "run.csv, row 3, column `u`: expected 3 fields as in the header, found 2;";
        assert!(text.starts_with(start), "{text}");
        let text = message(read("time_s,x,u\n0,0,0\n0,1,0,0,0\n"));
        let start = "run.csv, row 3, column `4`: expected 3 fields as in the header, found 5;";
        assert!(text.starts_with(start), "{text}");
    }

    #[test]
    fn short_files_have_a_message_each() {
        for empty in ["", "\n \r\n", "\u{feff}"] {
            let text = message(read(empty));
            assert!(text.starts_with("run.csv: the file is empty;"), "{text}");
        }
        let text = message(read("time_s,x,u\n\n"));
        assert!(text.starts_with("run.csv: the file holds a header but no rows;"), "{text}");
        let text = message(read("time_s,x,u\n0,0,0\n"));
        assert!(text.starts_with("run.csv, row 2: trajectory `run` has one row;"), "{text}");
    }

    #[test]
    fn a_line_without_end_is_refused() {
        let text = message(read(&"7".repeat(1 << 21)));
        assert!(text.starts_with("run.csv, row 1: the line is longer than 1048576 bytes"));
    }

    #[test]
    fn episodes_are_trajectories() {
        let (seen, summary) =
            episodes("run,time_s,x,u\na,0,1,0\na,0.1,2,0\n b,7,3,0\nb ,7.1,4,0\n").unwrap();
        assert_eq!(seen.names, ["run#a", "run#b"]);
        assert_eq!((summary.trajectories, summary.rows), (2, 4));

        // The same label in another file is another trajectory.
        let text = "run,time_s,x,u\n1,0,0,0\n1,0.1,0,0\n";
        let dir = logs(&[("a.csv", text), ("b.csv", text)]);
        let mut seen = Seen::default();
        let schema = LogSchema { episode: Some("run".into()), ..schema() };
        Recording::open(dir.path()).unwrap().read(&schema, &mut seen).unwrap();
        assert_eq!(seen.names, ["a#1", "b#1"]);
    }

    #[test]
    fn episode_faults() {
        let text = message(episodes(
            "run,time_s,x,u\na,0,0,0\na,0.1,0,0\nb,0,0,0\nb,0.1,0,0\na,0.2,0,0\n",
        ));
        let start = "run.csv, row 6, column `run`: episode `a` returns after it had ended;";
        assert!(text.starts_with(start), "{text}");
        let text = message(episodes("run,time_s,x,u\na,0,0,0\na,0.1,0,0\nb,0,0,0\nc,0,0,0\n"));
        assert!(text.starts_with("run.csv, row 4: trajectory `run#b` has one row;"), "{text}");
        let text = message(episodes("run,time_s,x,u\n,0,0,0\n"));
        let start = "run.csv, row 2, column `run`: expected the episode's label, found an empty";
        assert!(text.starts_with(start), "{text}");
    }

    #[test]
    fn five_percent_of_jitter_passes() {
        let with = |times: &[&str], sample_time_s| {
            let rows: String = times.iter().map(|t| format!("{t},0,0\n")).collect();
            read_with(&format!("time_s,x,u\n{rows}"), &LogSchema { sample_time_s, ..schema() })
        };
        for times in [
            ["0", "0.105", "0.2"],
            ["-0.1", "0", "0.095"],
            ["0.3", "0.4", "0.5"],
            ["0", "0.102", "0.204"],
            ["1760000000.1", "1760000000.205", "1760000000.3"],
        ] {
            assert!(with(&times, 0.1).is_ok(), "{times:?}");
        }
        for times in [["0", "0.10501", "0.2"], ["0", "0.1", "0.19499"]] {
            assert!(with(&times, 0.1).is_err(), "{times:?}");
        }
        for bad in [0.0, -0.1, f64::NAN, f64::INFINITY] {
            let error = with(&["0", "0.1"], bad).unwrap_err();
            assert!(matches!(error, ReadError::SampleTime { .. }), "{error}");
        }
    }

    #[test]
    fn time_faults_are_told_apart_and_name_the_command() {
        let dir = logs(&[]);
        let file = dir.path().join("run.csv");
        let with = |time: &str| {
            fs::write(&file, format!("time_s,x,u\n0.1,0,0\n0.2,0,0\n{time},0,0\n")).unwrap();
            let recording = Recording::open(dir.path()).unwrap();
            recording.read(&schema(), &mut Seen::default()).unwrap_err()
        };
        for (time, kind, start, step) in [
            ("0.32", StepFault::Jitter, "the time jitters", "0.12"),
            ("0.26", StepFault::Jitter, "the time jitters", "0.06"),
            ("0.5", StepFault::Gap, "a gap in the time", "0.3"),
            ("0.2", StepFault::StandsStill, "the time stands still", "0"),
            ("0.1", StepFault::GoesBack, "the time goes backwards", "-0.1"),
        ] {
            let error = with(time);
            let text = error.to_string();
            let logs = dir.path().display();
            let start = format!(
                "{}, row 4, column `time_s`: {start}: expected a step of 0.1 s ± 5 %, \
                 found {step} s; ",
                file.display()
            );
            assert!(text.starts_with(&start), "{text}");
            let options = "--dt 0.1 --inputs u --out DIR";
            assert!(text.contains(&format!("`trainer resample {logs} {options}`")));
            assert!(matches!(error, ReadError::TimeStep { fault, line: 4, .. } if fault == kind));
        }
    }

    #[test]
    fn paths_are_written_as_one_shell_word() {
        assert_eq!(shell_word(Path::new("models/a-b_1.csv")), "models/a-b_1.csv");
        assert_eq!(shell_word(Path::new("my logs")), "'my logs'");
        assert_eq!(shell_word(Path::new("it's")), r"'it'\''s'");
    }

    #[test]
    fn paths_that_hold_no_log() {
        let dir = logs(&[("robot.toml", "")]);
        let open = |path: &Path| Recording::open(path).unwrap_err();
        let path = dir.path();
        let error = open(path);
        assert!(matches!(&error, RecordingError::NoLogs { path: p } if p == path));
        let start = format!("{}: the directory holds no .csv file", path.display());
        assert!(error.to_string().starts_with(&start));
        assert!(matches!(open(&path.join("robot.toml")), RecordingError::NotCsv { .. }));
        let error = open(&path.join("nowhere"));
        assert!(matches!(error, RecordingError::NotFound { .. }));
        assert!(error.to_string().contains("nowhere: no such file or directory"));
        fs::create_dir(path.join("old.csv")).unwrap();
        assert!(
            matches!(open(path), RecordingError::NotRegular { path: p } if p == path.join("old.csv"))
        );
    }

    #[test]
    fn a_file_that_vanishes_or_grows_is_named() {
        let dir = logs(&[("run.csv", "time_s,x,u\n0,0,0\n0.1,0,0\n")]);
        let recording = Recording::open(dir.path()).unwrap();
        fs::remove_file(&recording.files()[0]).unwrap();
        let error = recording.read(&schema(), &mut Seen::default()).unwrap_err();
        assert!(matches!(&error, ReadError::Unreadable { file, .. } if file.ends_with("run.csv")));
        assert!(error.to_string().contains("run.csv: cannot be read: "));

        /// Another program that adds a row while the log is read.
        struct Writer(PathBuf);
        impl Visitor for Writer {
            fn begin(&mut self, _: &str) {
                let mut text = fs::read_to_string(&self.0).unwrap();
                text += "0.2,0,0\n";
                fs::write(&self.0, text).unwrap();
            }
            fn row(&mut self, _: &[f64], _: &[f64]) {}
        }
        fs::write(&recording.files()[0], "time_s,x,u\n0,0,0\n0.1,0,0\n").unwrap();
        let mut writer: Box<dyn Visitor> = Box::new(Writer(recording.files()[0].clone()));
        let error = recording.read(&schema(), &mut *writer).unwrap_err();
        assert!(matches!(error, ReadError::Changed { expected: 25, found: 33, .. }), "{error}");
    }
}
