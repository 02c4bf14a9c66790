//! Listening to a controller: its telemetry, live, and recorded as logs.

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use firmware_core::control_loop::Frame;
use firmware_core::control_loop::telemetry::Rows;
use firmware_core::link::{Message, Received, Receiver};

use crate::port::Port;
use crate::recording::unit_suffix;
use crate::robot::Robot;

/// Telemetry as logs: `episode-000.csv`, … in a folder, a new one at every gap. Every row is on the disk
/// before the next one comes.
#[derive(Debug)]
pub struct Recorder {
    folder: PathBuf,
    header: String,
    sample_us: u32,
    rows: Rows,
    file: Option<std::fs::File>,
    episodes: u32,
    written: u64,
}

impl Recorder {
    /// A folder, made if it is not there; it must be empty.
    ///
    /// # Errors
    /// Those of the file system; [`ErrorKind::AlreadyExists`] for a folder with something in it.
    pub fn new(folder: &Path, robot: &Robot) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        if let Some(entry) = std::fs::read_dir(folder)?.next() {
            let name = entry?.file_name();
            let message = format!("holds {}; give a new folder", name.to_string_lossy());
            return Err(io::Error::new(ErrorKind::AlreadyExists, message));
        }
        let states = robot.states.iter().map(|s| (&s.name, &s.unit));
        let inputs = robot.inputs.iter().map(|u| (&u.name, &u.unit));
        let columns = states.chain(inputs).map(|(name, unit)| match unit_suffix(unit) {
            suffix if suffix.is_empty() => format!(",{name}"),
            suffix => format!(",{name}_{suffix}"),
        });
        let sample_us = (robot.schema.sample_time_s * 1e6).round() as u32;
        Ok(Self {
            folder: folder.to_owned(),
            header: format!("time_s{}\n", columns.collect::<String>()),
            sample_us,
            rows: Rows::new(sample_us, u64::MAX),
            file: None,
            episodes: 0,
            written: 0,
        })
    }

    /// Takes a frame.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn frame(&mut self, frame: &Frame) -> io::Result<()> {
        let Some(row) = self.rows.frame(frame) else { return Ok(()) };
        if row.number == 0 {
            let path = self.folder.join(format!("episode-{:03}.csv", self.episodes));
            let mut file = std::fs::File::create_new(path)?;
            file.write_all(self.header.as_bytes())?;
            self.file = Some(file);
            self.episodes += 1;
        }
        let Some(file) = &mut self.file else { return Ok(()) };
        let mut line = ((row.number * u64::from(self.sample_us)) as f64 / 1e6).to_string();
        for number in row.measured.iter().chain(&row.inputs) {
            // The shortest decimal that reads back as the same f32.
            line += &format!(",{number}");
        }
        line.push('\n');
        file.write_all(line.as_bytes())?;
        self.written += 1;
        Ok(())
    }

    /// Files and rows written so far.
    pub fn written(&self) -> (u32, u64) {
        (self.episodes, self.written)
    }
}

/// What was heard.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// Frames.
    pub frames: u64,
    /// Frames whose numbers are missing.
    pub lost: u64,
    /// Frames damaged on the line.
    pub damaged: u64,
    /// Frames of a robot with other states or inputs.
    pub strange: u64,
}

/// Listens to a port until `until`, or for ever; `watch` sees every frame that fits the robot.
///
/// # Errors
/// Those of the line and of `watch`.
pub fn listen(
    port: &mut Port,
    robot: &Robot,
    until: Option<Instant>,
    watch: &mut dyn FnMut(&Frame) -> io::Result<()>,
) -> io::Result<Heard> {
    let (mut receiver, mut heard) = (Receiver::new(), Heard::default());
    let (mut next, mut first) = (None, true);
    let mut bytes = [0; 4096];
    while until.is_none_or(|until| Instant::now() < until) {
        let count = match port.read(&mut bytes) {
            Ok(count) => count,
            // What was heard until then counts.
            Err(e) if e.kind() == ErrorKind::UnexpectedEof && heard.frames > 0 => break,
            Err(e) => return Err(e),
        };
        for byte in &bytes[..count] {
            let Some(received) = receiver.push(*byte) else { continue };
            // A listener that comes in the middle of a frame has not lost it.
            let was_first = std::mem::replace(&mut first, false);
            match received {
                Received::Message(Message::Frame(frame)) => {
                    let fits = |len: usize, of: usize| len == of || len == 0;
                    if !(fits(frame.measured.len(), robot.states.len())
                        && fits(frame.predicted.len(), robot.states.len())
                        && frame.applied.len() == robot.inputs.len())
                    {
                        heard.strange += 1;
                        continue;
                    }
                    heard.frames += 1;
                    if let Some(expected) = next
                        && frame.sequence > expected
                    {
                        heard.lost += u64::from(frame.sequence - expected);
                    }
                    next = Some(frame.sequence.wrapping_add(1));
                    watch(&frame)?;
                }
                Received::Message(_) | Received::Unknown { .. } => {}
                Received::Damaged | Received::TooLong => heard.damaged += u64::from(!was_first),
            }
        }
    }
    Ok(heard)
}

/// A frame as a few lines of text, each cleared to its end: for a terminal.
pub fn picture(frame: &Frame, robot: &Robot) -> String {
    let mut text = format!(
        "{:10.2} s  {:?}  alarms: {}\x1b[K\n{:14} {:>12} {:>12} {:>12} {:>12}\x1b[K\n",
        frame.time_us as f64 * 1e-6,
        frame.mode,
        frame.alarms,
        "",
        "measured",
        "predicted",
        "off",
        "ahead"
    );
    let at =
        |list: &[f32], i: usize| list.get(i).map_or_else(|| "-".to_owned(), |x| format!("{x:.4}"));
    for (i, state) in robot.states.iter().enumerate() {
        text += &format!(
            "{:14} {:>12} {:>12} {:>12} {:>12}\x1b[K\n",
            format!("{} [{}]", state.name, state.unit),
            at(&frame.measured, i),
            at(&frame.predicted, i),
            at(&frame.residual, i),
            at(&frame.ahead, i)
        );
    }
    for (i, input) in robot.inputs.iter().enumerate() {
        let name = format!("{} [{}]", input.name, input.unit);
        text += &format!("{name:14} {:>12}\x1b[K\n", at(&frame.applied, i));
    }
    text +=
        &format!("worst tick {} µs, {} frames dropped\x1b[K\n", frame.worst_tick_us, frame.dropped);
    text
}
