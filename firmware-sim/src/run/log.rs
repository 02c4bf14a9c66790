//! Telemetry as logs for the trainer: a CSV file per stretch of frames without a gap.

use firmware_core::control_loop::Frame;
use firmware_core::control_loop::telemetry::Rows;
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
    sample_us: u32,
    rows: Rows,
    file: Option<BufWriter<File>>,
    episodes: u32,
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
            // As the trainer names columns: `/` is a p, other signs are left out.
            let unit = unit.replace('/', "p").replace(|c: char| !c.is_alphanumeric(), "");
            let separator = if unit.is_empty() { "" } else { "_" };
            let _ = write!(header, ",{name}{separator}{unit}");
        }
        header.push('\n');
        let sample_us = (f64::from(structure.sample_time_s()) * 1e6).round() as u32;
        let most = seconds.map_or(u64::MAX, |s| u64::from(s) * 1_000_000 / u64::from(sample_us));
        Ok(Self {
            folder: folder.to_owned(),
            header,
            sample_us,
            rows: Rows::new(sample_us, most.max(1)),
            file: None,
            episodes: 0,
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
        let Some(row) = self.rows.frame(frame) else { return Ok(()) };
        if row.number == 0 {
            self.finish()?;
            let path = self.folder.join(format!("episode-{:03}.csv", self.episodes));
            let mut file = BufWriter::new(File::create(path)?);
            file.write_all(self.header.as_bytes())?;
            self.file = Some(file);
            self.episodes += 1;
        }
        let Some(file) = &mut self.file else { return Ok(()) };
        // The clock's own time: f64 from whole microseconds.
        write!(file, "{}", (row.number * u64::from(self.sample_us)) as f64 / 1e6)?;
        for number in row.measured.iter().chain(&row.inputs) {
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
