//! Telemetry as logs for the trainer: a CSV file per stretch of frames without a gap.
//!
//! Only the running robot is logged: one that coasts to a stop after its motors were switched off moves
//! as no input says.

use firmware_core::control_loop::{Frame, Mode};
use firmware_core::model::Structure;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes `episode-000.csv`, `episode-001.csv`, … into a folder.
#[derive(Debug)]
pub struct Logger {
    folder: PathBuf,
    header: String,
    sample_us: u64,
    /// Most rows of a file.
    most_rows: u64,
    file: Option<BufWriter<File>>,
    episodes: u32,
    /// The frame whose inputs the next one tells, and its number within its episode.
    last: Option<(Frame, u64)>,
}

impl Logger {
    /// A folder, made if it is not there; it must hold nothing, or, to `overwrite`, what an earlier logger
    /// wrote. A file holds at most `seconds`.
    ///
    /// # Errors
    /// Those of the file system; [`io::ErrorKind::AlreadyExists`] for a folder with other things.
    pub fn new(
        folder: &Path,
        structure: &Structure<'_>,
        seconds: Option<u32>,
        overwrite: bool,
    ) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let mut earlier = Vec::new();
        for entry in fs::read_dir(folder)? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let is_ours = name.starts_with("episode-") && name.ends_with(".csv");
            if !(is_ours && overwrite) {
                let mend = match is_ours {
                    true => "give another folder, or --overwrite",
                    false => "give another folder",
                };
                let message = format!("{}: holds {name}; {mend}", folder.display());
                return Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
            }
            earlier.push(path);
        }
        for path in earlier {
            fs::remove_file(path)?;
        }
        let mut header = String::from("time_s");
        let states = structure.states().iter().map(|s| (s.name, s.unit));
        let inputs = structure.inputs().iter().map(|u| (u.name, u.unit));
        for (name, unit) in states.chain(inputs) {
            let unit = unit.replace('/', "p");
            let _ = write!(header, ",{name}_{unit}");
        }
        header.push('\n');
        let sample_us = (f64::from(structure.sample_time_s()) * 1e6).round() as u64;
        Ok(Self {
            folder: folder.to_owned(),
            header,
            sample_us,
            most_rows: seconds.map_or(u64::MAX, |s| (u64::from(s) * 1_000_000 / sample_us).max(1)),
            file: None,
            episodes: 0,
            last: None,
        })
    }

    /// Files written so far.
    pub fn episodes(&self) -> u32 {
        self.episodes
    }

    /// Takes a frame.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn frame(&mut self, frame: &Frame) -> io::Result<()> {
        let usable = frame.mode == Mode::Running && !frame.measured.is_empty();
        let goes_on = |last: &Frame| {
            last.sequence.wrapping_add(1) == frame.sequence
                && frame
                    .time_us
                    .checked_sub(last.time_us)
                    .is_some_and(|us| us.abs_diff(self.sample_us) < self.sample_us / 50)
        };
        let row = match self.last.take() {
            // Its inputs acted also when the loop has just stopped.
            Some((last, row)) if goes_on(&last) => {
                self.write(&last, frame, row)?;
                if row + 1 < self.most_rows { row + 1 } else { 0 }
            }
            _ => 0,
        };
        if usable {
            self.last = Some((frame.clone(), row));
        } else {
            self.finish()?;
        }
        Ok(())
    }

    fn write(&mut self, last: &Frame, next: &Frame, row: u64) -> io::Result<()> {
        if row == 0 {
            self.finish()?;
            let path = self.folder.join(format!("episode-{:03}.csv", self.episodes));
            let mut file = BufWriter::new(File::create(path)?);
            file.write_all(self.header.as_bytes())?;
            self.file = Some(file);
            self.episodes += 1;
        }
        let Some(file) = &mut self.file else { return Ok(()) };
        // The clock's own time: f64 from whole microseconds.
        write!(file, "{}", (row * self.sample_us) as f64 / 1e6)?;
        for number in last.measured.iter().chain(&next.applied) {
            // The shortest decimal that reads back as the same f32.
            write!(file, ",{number}")?;
        }
        writeln!(file)
    }

    /// Ends the present file.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn finish(&mut self) -> io::Result<()> {
        match self.file.take() {
            Some(mut file) => file.flush(),
            None => Ok(()),
        }
    }
}
