//! The laptop at the other end of the line.

use crate::fault::Faults;
use crate::faulty::FaultyHost;
use crate::mcu::uart::UartEnd;
use crate::run::scenario::{Scenario, Script};
use embedded_io::{Read, ReadReady, Write};
use firmware_core::control_loop::telemetry::Frame;
use firmware_core::control_loop::{Command, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};

/// Time between two commands (µs).
const COMMAND_US: u64 = 50_000;
/// Time after which the host asks again for what has not happened (µs).
const AGAIN_US: u64 = 500_000;

/// What reached the host.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    pub(crate) frames: u64,
    /// Frames whose numbers are missing.
    pub(crate) lost: u64,
    /// Frames that the loop could not put into its queue.
    pub(crate) dropped: u64,
    pub(crate) damaged: u64,
}

/// Sends the script, starts the robot, and takes frames.
pub(crate) struct Host {
    end: FaultyHost<UartEnd>,
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
    pub(crate) fn new(
        end: UartEnd,
        faults: &Faults,
        scenario: &Scenario,
        tick_us: u64,
        seed: u64,
    ) -> Self {
        let period_us = COMMAND_US.max(tick_us);
        Self {
            end: FaultyHost::new(end, faults),
            receiver: Receiver::new(),
            script: Script::new(scenario, period_us as f64 * 1e-6, seed),
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

    /// Takes what arrived, then sends what is due.
    pub(crate) fn turn(
        &mut self,
        now_us: u64,
        mut frame: impl FnMut(&Frame) -> std::io::Result<()>,
    ) -> std::io::Result<()> {
        let mut bytes = [0; 256];
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            for byte in &bytes[..count] {
                match self.receiver.push(*byte) {
                    Some(Received::Message(Message::Frame(received))) => {
                        self.take(&received);
                        frame(&received)?;
                    }
                    Some(_) => self.counts.damaged += 1,
                    None => {}
                }
            }
        }
        if now_us >= self.due_us {
            self.due_us += COMMAND_US;
            if now_us >= self.ask_us {
                let asked = match self.mode {
                    Mode::Idle if !self.started || self.restart => Some(Message::Start),
                    Mode::Safe if self.restart => Some(Message::Reset),
                    _ => None,
                };
                if let Some(message) = asked {
                    self.ask_us = now_us + AGAIN_US;
                    self.send(&message);
                }
            }
            let inputs = self.script.next();
            self.send(&Command::Inputs(inputs).into());
        }
        Ok(())
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

    fn send(&mut self, message: &Message) {
        let mut bytes = [0; MAX_FRAME];
        let length = encode(message, &mut bytes).expect("there is room for every message");
        // A full line is a command lost, as on a real one.
        let _ = self.end.write(&bytes[..length]);
    }
}
