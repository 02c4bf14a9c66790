//! Messages between host and controller over a serial line.
//!
//! A message is encoded with postcard, followed by its CRC-32 (ISO-HDLC, as in the blob, little-endian),
//! the whole stuffed with COBS (Cheshire & Baker 1999, "Consistent overhead byte stuffing") and ended by a
//! zero byte:
//!
//! ```text
//! COBS( postcard(message) ‖ CRC-32 ) ‖ 00
//! ```
//!
//! so that a receiver that lost or mistook bytes is in step again after the next zero. A frame that does not
//! unstuff, or has a wrong checksum, is dropped and counted; nothing is guessed. A controller answers one
//! that is too long, and one whose message it does not know, with
//! [`Refused`].
//!
//! | variant | message | direction |
//! |---|---|---|
//! | 0 | [`Message::Start`] | to the controller |
//! | 1 | [`Message::Stop`] | to the controller |
//! | 2 | [`Message::Reset`] | to the controller |
//! | 3 | [`Message::Inputs`] | to the controller |
//! | 4 | [`Message::Frame`] | to the host |
//! | 5 | [`Message::Request`] | to the controller |
//! | 6 | [`Message::Answer`] | to the host |
//!
//! The whole, byte by byte: docs/protocol.md.

use embedded_io::{Read, ReadReady, Write, WriteReady};
use heapless::{Deque, Vec};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::blob::crc32;
use crate::capacity::MAX_INPUTS;
use crate::control_loop::telemetry::{Frame, Frames};
use crate::control_loop::{Command, ControlLoop, Mode};
use crate::update::{Answer, Refused, Request, Say, Updates};

/// Longest frame on the line, the final zero included: a telemetry frame with lists as long as there is
/// room for takes 204 bytes, the longest chunk of a blob 213.
pub const MAX_FRAME: usize = 256;
/// Number of [`Message::Inputs`].
const INPUTS: u8 = 3;
/// Number of [`Message::Frame`].
const FRAME: u8 = 4;
/// Number of [`Message::Request`].
pub(crate) const REQUEST: u8 = 5;
/// Number of [`Message::Answer`].
const ANSWER: u8 = 6;

/// What goes over the line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
// A frame is what is sent most of the time; there is no heap to put it on.
#[allow(clippy::large_enum_variant)]
pub enum Message {
    /// [`Command::Start`].
    Start,
    /// [`Command::Stop`].
    Stop,
    /// [`Command::Reset`].
    Reset,
    /// [`Command::Inputs`], in the model's order and units.
    Inputs(Vec<f32, MAX_INPUTS>),
    /// One sample of a loop.
    Frame(Frame),
    /// About models: [`update`](crate::update).
    Request(Request),
    /// To a request, or to what is none.
    Answer(Answer),
}

impl<const M: usize> From<Command<M>> for Message {
    fn from(command: Command<M>) -> Self {
        match command {
            Command::Start => Self::Start,
            Command::Stop => Self::Stop,
            Command::Reset => Self::Reset,
            Command::Inputs(inputs) => Self::Inputs(inputs.into_iter().take(MAX_INPUTS).collect()),
        }
    }
}

impl Message {
    /// The command to a robot with `M` inputs; `None` of a message that is none, or one with another
    /// number of inputs.
    pub fn command<const M: usize>(&self) -> Option<Command<M>> {
        match self {
            Self::Start => Some(Command::Start),
            Self::Stop => Some(Command::Stop),
            Self::Reset => Some(Command::Reset),
            Self::Inputs(inputs) => Some(Command::Inputs(inputs.as_slice().try_into().ok()?)),
            Self::Frame(_) | Self::Request(_) | Self::Answer(_) => None,
        }
    }
}

/// The bytes of a message, the final zero included, in `out`; their number.
///
/// ```
/// use firmware_core::link::{Message, Received, Receiver, encode};
/// let mut out = [0; 256];
/// let length = encode(&Message::Stop, &mut out).unwrap();
/// // COBS of [01, CRC-32 of 01 = a505df1b]: no zero inside, so one code byte for all five.
/// assert_eq!(out[..length], [6, 0x01, 0x1b, 0xdf, 0x05, 0xa5, 0]);
///
/// let mut receiver = Receiver::new();
/// let last = out[..length].iter().filter_map(|byte| receiver.push(*byte)).last();
/// assert_eq!(last, Some(Received::Message(Message::Stop)));
/// ```
///
/// # Errors
/// [`TooLong`] when `out` has no room for it; [`MAX_FRAME`] bytes always are enough.
pub fn encode(message: &Message, out: &mut [u8]) -> Result<usize, TooLong> {
    encode_as(message, out)
}

fn encode_as(message: &impl Serialize, out: &mut [u8]) -> Result<usize, TooLong> {
    let mut plain = [0; MAX_FRAME];
    let length = postcard::to_slice(message, &mut plain).map_err(|_| TooLong)?.len();
    let check = crc32(0, plain.get(..length).unwrap_or(&[]));
    let end = length.saturating_add(4);
    plain.get_mut(length..end).ok_or(TooLong)?.copy_from_slice(&check.to_le_bytes());
    let plain = plain.get(..end).ok_or(TooLong)?;
    let stuffed = cobs::try_encode(plain, out).map_err(|_| TooLong)?;
    *out.get_mut(stuffed).ok_or(TooLong)? = 0;
    Ok(stuffed.saturating_add(1))
}

/// A message has no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong;

/// What a byte completed.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)]
pub enum Received<M = Message> {
    /// A message.
    Message(M),
    /// A frame with a right checksum that holds no message known here.
    Unknown {
        /// Its first byte.
        variant: u8,
        /// Number of a request, as far as it is one; 0.
        number: u8,
    },
    /// A frame that is longer than [`MAX_FRAME`].
    TooLong,
    /// A damaged frame.
    Damaged,
}

/// Finds messages in a stream of bytes.
#[derive(Clone, Debug)]
pub struct Receiver {
    frame: [u8; MAX_FRAME],
    length: usize,
}

impl Default for Receiver {
    fn default() -> Self {
        Self::new()
    }
}

impl Receiver {
    /// Nothing received.
    pub fn new() -> Self {
        Self { frame: [0; MAX_FRAME], length: 0 }
    }

    /// Takes a byte; every zero but those that follow another one completes something.
    pub fn push(&mut self, byte: u8) -> Option<Received> {
        self.push_as(byte)
    }

    fn push_as<M: DeserializeOwned>(&mut self, byte: u8) -> Option<Received<M>> {
        if byte != 0 {
            if let Some(place) = self.frame.get_mut(self.length) {
                *place = byte;
            }
            // One beyond the end says that the frame was too long.
            self.length = self.length.saturating_add(1).min(MAX_FRAME.saturating_add(1));
            return None;
        }
        let length = core::mem::take(&mut self.length);
        if length == 0 {
            return None;
        }
        if length >= MAX_FRAME {
            return Some(Received::TooLong);
        }
        let received = self.frame.get_mut(..length).and_then(decode);
        Some(received.unwrap_or(Received::Damaged))
    }
}

/// What a frame without its final zero holds; `None` of one that is damaged.
fn decode<M: DeserializeOwned>(frame: &mut [u8]) -> Option<Received<M>> {
    let length = cobs::decode_in_place(frame).ok()?;
    let (body, check) = frame.get(..length)?.split_last_chunk::<4>()?;
    if crc32(0, body) != u32::from_le_bytes(*check) {
        return None;
    }
    // Bytes after a message are no part of any.
    let message = postcard::take_from_bytes(body).ok().filter(|(_, rest)| rest.is_empty());
    Some(message.map_or_else(
        || {
            let variant = body.first().copied().unwrap_or(0);
            let number = body.get(1).copied().filter(|_| variant == REQUEST).unwrap_or(0);
            Received::Unknown { variant, number }
        },
        |(message, _)| Received::Message(message),
    ))
}

/// What a controller reads: [`Message`] without what is for the host, of which only the number is left.
#[derive(Deserialize)]
#[allow(clippy::large_enum_variant)]
enum Incoming {
    Start,
    Stop,
    Reset,
    Inputs(Vec<f32, MAX_INPUTS>),
    Frame,
    Request(Request),
    Answer,
}

/// What a controller sends, numbered as in [`Message`].
#[derive(Serialize)]
#[allow(dead_code, clippy::large_enum_variant)]
enum Outgoing {
    Start,
    Stop,
    Reset,
    Inputs,
    Frame(Frame),
    Request,
    Answer(Answer),
}

/// Reads at most this many bytes per call: bounded work, whatever the line brings.
const READ: usize = 128;
/// Answers that wait to be sent; further ones are dropped, as the host asks again.
const ANSWERS: usize = 2;
/// What updates have to do waits at most so long until answers are on the line (µs).
const SENT_US: u64 = 1_000_000;

/// One end of the line at a controller: commands and requests in, answers and frames out, never waiting.
#[derive(Clone, Debug)]
pub struct Port {
    receiver: Receiver,
    answers: Deque<Answer, ANSWERS>,
    /// The frame that is being sent, its length and how much of it is on the way.
    out: [u8; MAX_FRAME],
    length: usize,
    sent: usize,
    /// Whether the last one was an answer: then it is the turn of a frame, however much is asked.
    answered: bool,
    /// Since when there is something to do for updates.
    works_since_us: Option<u64>,
    damaged: u32,
}

impl Default for Port {
    fn default() -> Self {
        Self::new()
    }
}

impl Port {
    /// Nothing received or sent.
    pub fn new() -> Self {
        Self {
            receiver: Receiver::new(),
            answers: Deque::new(),
            out: [0; MAX_FRAME],
            length: 0,
            sent: 0,
            answered: false,
            works_since_us: None,
            damaged: 0,
        }
    }

    /// Frames on the way in so far that were dropped or not understood.
    pub fn damaged(&self) -> u32 {
        self.damaged
    }

    /// Whether all answers have been handed to the line. Of telemetry there may always be more.
    pub fn is_sent(&self) -> bool {
        self.answers.is_empty() && (self.sent == self.length || !self.answered)
    }

    /// Reads what has arrived, at most 128 bytes, and hands on commands to the loop, requests to the
    /// updates; of what these have to do for long, a part, once the robot is
    /// [switched off](crate::control_loop::Supervisor::is_switched_off). Between two ticks of a robot at
    /// rest it may be called as often as there is time.
    pub fn receive<const M: usize>(
        &mut self,
        serial: &mut (impl Read + ReadReady),
        robot: &mut (impl ControlLoop<M> + ?Sized),
        updates: &mut impl Updates,
        now_us: u64,
    ) {
        let mut bytes = [0; READ];
        let count = match serial.read_ready() {
            Ok(true) => serial.read(&mut bytes).unwrap_or(0),
            _ => 0,
        };
        for byte in bytes.iter().take(count) {
            let Some(received) = self.receiver.push_as(*byte) else { continue };
            let answer = self.take(received, robot, updates, now_us);
            self.answer(answer);
        }
        if !updates.is_working() {
            self.works_since_us = None;
        } else if self.is_time_to_work(robot, now_us) {
            self.works_since_us = None;
            let answer = updates.work(robot.mode(), now_us);
            self.answer(answer);
            robot.supervisor_mut().pause();
        }
        robot.supervisor_mut().hold(updates.holds(now_us));
    }

    fn is_time_to_work<const M: usize>(
        &mut self,
        robot: &(impl ControlLoop<M> + ?Sized),
        now_us: u64,
    ) -> bool {
        // What was asked before a start is not done after it, but given up at once.
        if robot.mode() == Mode::Running {
            return true;
        }
        // Erasing may hold up the line: what has been said goes first, if the line takes it.
        let since_us = *self.works_since_us.get_or_insert(now_us);
        let is_patient = now_us.saturating_sub(since_us) <= SENT_US;
        robot.supervisor().is_switched_off() && (self.is_sent() || !is_patient)
    }

    fn take<const M: usize>(
        &mut self,
        received: Received<Incoming>,
        robot: &mut (impl ControlLoop<M> + ?Sized),
        updates: &mut impl Updates,
        now_us: u64,
    ) -> Option<Answer> {
        let refused = |number, refused| Some(Answer { number, say: Say::Refused(refused) });
        let command = match received {
            Received::Message(Incoming::Request(request)) => {
                return updates.receive(&request, robot.mode(), now_us);
            }
            Received::Message(Incoming::Start) => Some(Command::Start),
            Received::Message(Incoming::Stop) => Some(Command::Stop),
            Received::Message(Incoming::Reset) => Some(Command::Reset),
            Received::Message(Incoming::Inputs(ref inputs)) => {
                inputs.as_slice().try_into().ok().map(Command::Inputs)
            }
            _ => None,
        };
        if let Some(command) = command {
            robot.command(command);
            return None;
        }
        self.damaged = self.damaged.saturating_add(1);
        match received {
            // For the host: an echo, or another controller, which would answer in its turn, for ever.
            Received::Message(Incoming::Frame | Incoming::Answer)
            | Received::Unknown { variant: FRAME | ANSWER, .. } => None,
            // Its number of inputs is another.
            Received::Message(_) => refused(0, Refused::Unknown { variant: INPUTS }),
            Received::Unknown { variant, number } => refused(number, Refused::Unknown { variant }),
            Received::TooLong => {
                let most = u32::try_from(MAX_FRAME).unwrap_or(u32::MAX);
                refused(0, Refused::TooLong { most })
            }
            // Whoever sent it will see that nothing comes back.
            Received::Damaged => None,
        }
    }

    fn answer(&mut self, answer: Option<Answer>) {
        if let Some(answer) = answer {
            let _ = self.answers.push_back(answer);
        }
    }

    /// Sends as much of the waiting answers and frames as the line takes now: the rest of the one on the
    /// way, and at most one more.
    pub fn send(&mut self, frames: &mut Frames<'_>, serial: &mut (impl Write + WriteReady)) {
        for _ in 0..2 {
            if self.sent == self.length {
                let waits = self.answered && frames.ready();
                let answer = if waits { None } else { self.answers.pop_front() };
                self.answered = answer.is_some();
                let message = answer.map(Outgoing::Answer);
                let message = message.or_else(|| frames.dequeue().map(Outgoing::Frame));
                let Some(message) = message else { return };
                (self.sent, self.length) = (0, 0);
                // There is room for every message.
                self.length = encode_as(&message, &mut self.out).unwrap_or(0);
            }
            while let Some(rest) = self.out.get(self.sent..self.length).filter(|r| !r.is_empty()) {
                if !matches!(serial.write_ready(), Ok(true)) {
                    return;
                }
                match serial.write(rest) {
                    // Each round is a byte at least: at most as many rounds as bytes.
                    Ok(count) if count > 0 => {
                        self.sent = self.sent.saturating_add(count).min(self.length)
                    }
                    _ => return,
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    fn full() -> Message {
        let numbers = [f32::MIN_POSITIVE; 8];
        Message::Frame(Frame {
            sequence: u32::MAX,
            time_us: u64::MAX,
            mode: Mode::Safe,
            alarms: crate::control_loop::Alarms::SAFE,
            noticed: crate::control_loop::Alarms::SAFE,
            applied: numbers.into_iter().take(MAX_INPUTS).collect(),
            measured: numbers.into_iter().collect(),
            predicted: numbers.into_iter().collect(),
            residual: numbers.into_iter().collect(),
            steps: u32::MAX,
            bound_steps: u32::MAX,
            ahead: numbers.into_iter().collect(),
            worst_tick_us: u32::MAX,
            dropped: u32::MAX,
        })
    }

    fn receive(bytes: &[u8]) -> std::vec::Vec<Received> {
        let mut receiver = Receiver::new();
        bytes.iter().filter_map(|byte| receiver.push(*byte)).collect()
    }

    #[test]
    fn the_largest_frame_has_room() {
        let mut out = [0; MAX_FRAME];
        let length = encode(&full(), &mut out).unwrap();
        assert_eq!(length, 204, "see MAX_FRAME");
        assert_eq!(receive(&out[..length]), [Received::Message(full())]);
    }

    #[test]
    fn damage_is_noticed_and_the_next_message_arrives() {
        let mut out = [0; MAX_FRAME];
        let length = encode(&full(), &mut out).unwrap();
        let mut stop = [0; 16];
        let end = encode(&Message::Stop, &mut stop).unwrap();
        for i in 0..length {
            for bit in 0..8 {
                let mut bytes = out[..length].to_vec();
                bytes[i] ^= 1 << bit;
                bytes.push(0);
                bytes.extend_from_slice(&stop[..end]);
                let received = receive(&bytes);
                assert_eq!(received.last(), Some(&Received::Message(Message::Stop)));
                assert!(received[..received.len() - 1].iter().all(|r| *r == Received::Damaged));
            }
            // A byte of the frame lost; the zero at its end comes again.
            let mut bytes = out[..length - 1].to_vec();
            if i < bytes.len() {
                bytes.remove(i);
            } else {
                bytes.push(7);
            }
            bytes.push(0);
            assert!(receive(&bytes).iter().all(|r| *r == Received::Damaged));
        }
        let endless = [[1; 1000].as_slice(), &[0], &stop[..end]].concat();
        assert_eq!(receive(&endless), [Received::TooLong, Received::Message(Message::Stop)]);
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
            receive(&bytes);
        }

        #[test]
        fn inputs_arrive_as_they_are(inputs in prop::array::uniform2(any::<f32>())) {
            let mut out = [0; MAX_FRAME];
            let length = encode(&Command::Inputs(inputs).into(), &mut out).unwrap();
            let received = receive(&out[..length]);
            let [Received::Message(message)] = &received[..] else { panic!("{received:?}") };
            let Some(Command::Inputs(back)) = message.command::<2>() else { panic!() };
            prop_assert_eq!(back.map(f32::to_bits), inputs.map(f32::to_bits));
            prop_assert_eq!(message.command::<3>(), None);
        }
    }
}
