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
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read};
use std::ops::Range;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use thiserror::Error;

/// Size of the read buffer, in bytes; also the grain of [`Visitor::progress`].
const BUFFER_BYTES: usize = 1 << 16;

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
        Self {
            name: name.into(),
            unit: unit.into(),
            column: None,
            factor: 1.0,
        }
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
}

impl LogSchema {
    /// A schema with the time in `time_s` and one trajectory per file.
    pub fn new(sample_time_s: f64, states: Vec<LogColumn>, inputs: Vec<LogColumn>) -> Self {
        Self {
            sample_time_s,
            time: "time_s".into(),
            episode: None,
            states,
            inputs,
        }
    }
}

/// The suffix of a column header that stands for a unit: `/` becomes `p`, and whatever else is
/// not alphanumeric is left out. `m` → `m`, `rad/s` → `radps`, `N m` → `Nm`.
pub fn unit_suffix(unit: &str) -> String {
    unit.chars()
        .map(|c| if c == '/' { 'p' } else { c })
        .filter(|c| c.is_alphanumeric())
        .collect()
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
        step_message(*fault, *found_s, *expected_s, logs))]
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
        /// The recording, as its path was given.
        logs: PathBuf,
    },
}

fn step_message(fault: StepFault, found_s: f64, expected_s: f64, logs: &Path) -> String {
    let found = nanoseconds(found_s);
    let command = format!(
        "`trainer resample {} --dt {expected_s} --out DIR`",
        shell_word(logs)
    );
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
        let unreadable = |path: &Path, source| RecordingError::Unreadable {
            path: path.to_owned(),
            source,
        };
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
        Ok(Self {
            path: path.to_owned(),
            files,
            bytes,
        })
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
            return Err(ReadError::SampleTime {
                found_s: expected_s,
            });
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
                    logs: self.path.clone(),
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
        Ok(Summary {
            trajectories,
            rows,
            sha256: hasher.finalize().into(),
        })
    }
}

fn is_csv(path: &Path) -> bool {
    path.extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
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
    text: Vec<u8>,
    /// Where the fields are in `text`.
    fields: Vec<Range<usize>>,
}

impl<'a> Lines<'a> {
    fn open(file: &'a Path, mut hasher: Sha256) -> Result<Self, ReadError> {
        let unreadable = |source| ReadError::Unreadable {
            file: file.to_owned(),
            source,
        };
        let input = File::open(file).map_err(unreadable)?;
        let length = input.metadata().map_err(unreadable)?.len();
        hasher.update(length.to_le_bytes());
        let input = HashedFile {
            file: input,
            hasher,
            bytes: 0,
        };
        Ok(Self {
            file,
            length,
            input: BufReader::with_capacity(BUFFER_BYTES, input),
            line: 0,
            text: Vec::new(),
            fields: Vec::new(),
        })
    }

    /// Moves to the next line that is not blank; `false` at the end of the file.
    fn advance(&mut self) -> Result<bool, ReadError> {
        loop {
            self.text.clear();
            let length = self
                .input
                .by_ref()
                .take(MAX_LINE_BYTES + 1)
                .read_until(b'\n', &mut self.text)
                .map_err(|source| ReadError::Unreadable {
                    file: self.file.to_owned(),
                    source,
                })?;
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
            if self.line == 1 && self.text.starts_with("\u{feff}".as_bytes()) {
                self.text.drain(.."\u{feff}".len());
            }
            if !self.text.trim_ascii_start().is_empty() {
                self.split();
                return Ok(true);
            }
        }
    }

    /// Finds the fields of `text`. Plain lines, which is nearly all of them, are split in place.
    fn split(&mut self) {
        self.fields.clear();
        if self.text.contains(&b'"') {
            let mut record = csv::ByteRecord::new();
            let read = csv::ReaderBuilder::new()
                .has_headers(false)
                .buffer_capacity(self.text.len())
                .from_reader(self.text.as_slice())
                .read_byte_record(&mut record);
            if let Ok(true) = read {
                self.fields
                    .extend((0..record.len()).filter_map(|field| record.range(field)));
                self.text.clear();
                self.text.extend_from_slice(record.as_slice());
                return;
            }
        }
        let mut start = 0;
        for (end, byte) in self.text.iter().enumerate() {
            if *byte == b',' {
                self.fields.push(start..end);
                start = end + 1;
            }
        }
        let end = self.text.trim_ascii_end().len().max(start);
        self.fields.push(start..end);
    }

    fn field(&self, field: usize) -> &[u8] {
        &self.text[self.fields[field].clone()]
    }

    /// Reads the header.
    fn header(&mut self) -> Result<Vec<String>, ReadError> {
        if !self.advance()? {
            return Err(ReadError::Empty {
                file: self.file.to_owned(),
            });
        }
        let header: Vec<String> = (0..self.fields.len())
            .map(|field| String::from_utf8_lossy(self.field(field).trim_ascii()).into_owned())
            .collect();
        if let [only] = header.as_slice()
            && let Some(found) = [';', '\t'].into_iter().find(|c| only.contains(*c))
        {
            return Err(ReadError::Separator {
                file: self.file.to_owned(),
                found,
            });
        }
        Ok(header)
    }
}

/// Where an episode column stands and which episodes have been seen.
struct Episodes {
    field: usize,
    current: Vec<u8>,
    seen: HashSet<Box<[u8]>>,
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
                current: Vec::new(),
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
                0 => Err(ReadError::NoRows {
                    file: self.lines.file.to_owned(),
                }),
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
            ReadError::EmptyField {
                file,
                line,
                column,
                expected: "a number",
            }
        } else if is_number {
            ReadError::NotFinite {
                file,
                line,
                column,
                found,
            }
        } else {
            ReadError::NotANumber {
                file,
                line,
                column,
                found,
            }
        }
    }

    /// Whether the current row belongs to another episode than the row before.
    fn next_episode(&mut self) -> Result<bool, ReadError> {
        let Some(episodes) = &mut self.episodes else {
            return Ok(false);
        };
        let label = self.lines.field(episodes.field).trim_ascii();
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
            return Err(ReadError::EpisodeReturns {
                file,
                line,
                column,
                episode: excerpt(label),
            });
        }
        episodes.current.clear();
        episodes.current.extend_from_slice(label);
        Ok(true)
    }

    fn name_trajectory(&mut self) {
        let stem = self.lines.file.file_stem().unwrap_or_default();
        self.trajectory.clear();
        self.trajectory.push_str(&stem.to_string_lossy());
        if let Some(episodes) = &self.episodes {
            let label = String::from_utf8_lossy(&episodes.current);
            // Writing to a string cannot fail.
            let _ = write!(self.trajectory, "#{label}");
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
    let fits: Vec<usize> = (0..header.len())
        .filter(|field| looked_for.contains(&header[*field]))
        .collect();
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
fn number(field: &[u8]) -> Option<f64> {
    let parse = |text| std::str::from_utf8(text).ok()?.parse().ok();
    parse(field).or_else(|| parse(field.trim_ascii()))
}

/// A field as it is shown in a message: at most 40 characters, on one line.
fn excerpt(field: &[u8]) -> String {
    let text = String::from_utf8_lossy(field.trim_ascii()).replace(char::is_control, "\u{fffd}");
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}
