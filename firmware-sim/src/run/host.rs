//! The laptop at the other end of the line.

use crate::run::scenario::{Scenario, Script};
use embedded_io::{Read, ReadReady, Write};
use firmware_core::control_loop::telemetry::Frame;
use firmware_core::control_loop::{Command, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use std::io;

/// Time between two commands (µs).
const COMMAND_US: u64 = 50_000;
/// Time after which the host asks again for what has not happened (µs).
const AGAIN_US: u64 = 500_000;

/// What reached the host.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Frames.
    pub frames: u64,
    /// Frames whose numbers are missing.
    pub lost: u64,
    /// Frames that the loop could not put into its queue.
    pub dropped: u64,
    /// Frames damaged on the line.
    pub damaged: u64,
}

/// Whoever is at the host's end of the line.
pub trait Laptop {
    /// Takes what arrived, `frame` each frame, and sends what is due.
    fn turn(
        &mut self,
        now_us: u64,
        frame: &mut dyn FnMut(&Frame) -> io::Result<()>,
    ) -> io::Result<()>;

    /// What reached it.
    fn counts(&self) -> Counts;
}

/// A host by itself.
pub(crate) struct Alone<E> {
    pub(crate) end: E,
    pub(crate) host: Host,
}

impl<E: Read + ReadReady + Write> Laptop for Alone<E> {
    fn turn(
        &mut self,
        now_us: u64,
        frame: &mut dyn FnMut(&Frame) -> io::Result<()>,
    ) -> io::Result<()> {
        let mut bytes = [0; 256];
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            self.host.hear(&bytes[..count], frame)?;
        }
        self.host.speak(now_us, &mut self.end);
        Ok(())
    }

    fn counts(&self) -> Counts {
        self.host.counts()
    }
}

/// Sends the script, starts the robot, and takes frames.
pub(crate) struct Host {
    receiver: Receiver,
    script: Script,
    restart: bool,
    mode: Mode,
    /// When the next command is due, and when a start or reset may be asked for again.
    due_us: u64,
    ask_us: u64,
    started: bool,
    next_sequence: Option<u32>,
    counts: Counts,
}

impl Host {
    pub(crate) fn new(scenario: &Scenario, seed: u64) -> Self {
        Self {
            receiver: Receiver::new(),
            script: Script::new(scenario, COMMAND_US as f64 * 1e-6, seed),
            restart: scenario.restart,
            mode: Mode::Idle,
            due_us: 0,
            // The model's history fills first.
            ask_us: 2 * AGAIN_US,
            started: false,
            next_sequence: None,
            counts: Counts::default(),
        }
    }

    pub(crate) fn counts(&self) -> Counts {
        self.counts
    }

    /// Takes bytes from the line.
    pub(crate) fn hear(
        &mut self,
        bytes: &[u8],
        frame: &mut dyn FnMut(&Frame) -> io::Result<()>,
    ) -> io::Result<()> {
        for byte in bytes {
            match self.receiver.push(*byte) {
                Some(Received::Message(Message::Frame(received))) => {
                    self.take(&received);
                    frame(&received)?;
                }
                Some(_) => self.counts.damaged += 1,
                None => {}
            }
        }
        Ok(())
    }

    /// Sends what is due.
    pub(crate) fn speak(&mut self, now_us: u64, end: &mut impl Write) {
        if now_us < self.due_us {
            return;
        }
        self.due_us += COMMAND_US;
        if now_us >= self.ask_us {
            let asked = match self.mode {
                Mode::Idle if !self.started || self.restart => Some(Message::Start),
                Mode::Safe if self.restart => Some(Message::Reset),
                _ => None,
            };
            if let Some(message) = asked {
                self.ask_us = now_us + AGAIN_US;
                send(end, &message);
            }
        }
        let inputs = self.script.next();
        send(end, &Command::Inputs(inputs).into());
    }

    fn take(&mut self, frame: &Frame) {
        if frame.mode != self.mode {
            self.mode = frame.mode;
            self.started |= frame.mode == Mode::Running;
        }
        self.counts.frames += 1;
        self.counts.dropped = self.counts.dropped.max(frame.dropped.into());
        // After a reset the controller counts from 0 again.
        if let Some(expected) = self.next_sequence
            && frame.sequence >= expected
        {
            self.counts.lost += u64::from(frame.sequence - expected);
        }
        self.next_sequence = Some(frame.sequence.wrapping_add(1));
    }
}

fn send(end: &mut impl Write, message: &Message) {
    let mut bytes = [0; MAX_FRAME];
    let length = encode(message, &mut bytes).expect("there is room for every message");
    // A full line is a command lost, as on a real one.
    let _ = end.write(&bytes[..length]);
}
