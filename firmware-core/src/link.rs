//! Messages between host and controller over a serial line.
//!
//! A message is encoded with postcard, followed by its CRC-32 (ISO-HDLC, as in the blob, little-endian),
//! the whole stuffed with COBS (Cheshire & Baker 2049, "Consistent overhead byte stuffing") and ended by a
//! zero byte:
//!
//! ```text
//! COBS( postcard(message) ‖ CRC-32 ) ‖ 00
//! ```
//!
//! so that a receiver that lost or mistook bytes is in step again after the next zero. A frame that is too
//! long, does not unstuff, or has a wrong checksum is dropped and counted; nothing is guessed.
//!
//! | variant | message | direction |
//! |---|---|---|
//! | 0 | [`Message::Start`] | to the controller |
//! | 1 | [`Message::Stop`] | to the controller |
//! | 2 | [`Message::Reset`] | to the controller |
//! | 3 | [`Message::Inputs`] | to the controller |
//! | 4 | [`Message::Frame`] | to the host |

use embedded_io::{Read, ReadReady, Write, WriteReady};
use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::blob::CRC;
use crate::capacity::MAX_INPUTS;
use crate::control_loop::Command;
use crate::control_loop::telemetry::{Frame, Frames};

/// Longest frame on the line, the final zero included: a telemetry frame with lists as long as there is
/// room for takes 204 bytes.
pub const MAX_FRAME: usize = 256;

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
            Self::Frame(_) => None,
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
    let mut plain = [0; MAX_FRAME];
    let length = postcard::to_slice(message, &mut plain).map_err(|_| TooLong)?.len();
    let check = CRC.checksum(plain.get(..length).unwrap_or(&[]));
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
pub enum Received {
    /// A message.
    Message(Message),
    /// A frame that is dropped: too long, damaged, or no message.
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
        let message = self.frame.get_mut(..length).and_then(decode);
        Some(message.map_or(Received::Damaged, Received::Message))
    }
}

/// The message of a frame without its final zero.
fn decode(frame: &mut [u8]) -> Option<Message> {
    let length = cobs::decode_in_place(frame).ok()?;
    let (body, check) = frame.get(..length)?.split_last_chunk::<4>()?;
    if CRC.checksum(body) != u32::from_le_bytes(*check) {
        return None;
    }
    // Bytes after a message are no part of any.
    postcard::take_from_bytes(body).ok().filter(|(_, rest)| rest.is_empty()).map(|(m, _)| m)
}

/// Reads at most this many bytes per call: bounded work, whatever the line brings.
const READ: usize = 128;

/// One end of the line at a controller: commands in, frames out, never waiting.
#[derive(Clone, Debug)]
pub struct Port {
    receiver: Receiver,
    /// The frame that is being sent, its length and how much of it is on the way.
    out: [u8; MAX_FRAME],
    length: usize,
    sent: usize,
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
        Self { receiver: Receiver::new(), out: [0; MAX_FRAME], length: 0, sent: 0, damaged: 0 }
    }

    /// Frames dropped on the way in so far.
    pub fn damaged(&self) -> u32 {
        self.damaged
    }

    /// Reads what has arrived, at most 128 bytes, and hands on each command to a robot of `M` inputs.
    pub fn receive<const M: usize>(
        &mut self,
        serial: &mut (impl Read + ReadReady),
        mut command: impl FnMut(Command<M>),
    ) {
        let mut bytes = [0; READ];
        if !matches!(serial.read_ready(), Ok(true)) {
            return;
        }
        let count = serial.read(&mut bytes).unwrap_or(0);
        for byte in bytes.iter().take(count) {
            match self.receiver.push(*byte) {
                Some(Received::Message(message)) => match message.command() {
                    Some(wanted) => command(wanted),
                    None => self.damaged = self.damaged.saturating_add(1),
                },
                Some(Received::Damaged) => self.damaged = self.damaged.saturating_add(1),
                None => {}
            }
        }
    }

    /// Sends as much of the waiting frames as the line takes now: the rest of the one on the way, and at
    /// most one more.
    pub fn send(&mut self, frames: &mut Frames<'_>, serial: &mut (impl Write + WriteReady)) {
        for _ in 0..2 {
            if self.sent == self.length {
                let Some(frame) = frames.dequeue() else { return };
                (self.sent, self.length) = (0, 0);
                // There is room for every frame.
                self.length = encode(&Message::Frame(frame), &mut self.out).unwrap_or(0);
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
            mode: crate::control_loop::Mode::Safe,
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
        assert_eq!(receive(&endless), [Received::Damaged, Received::Message(Message::Stop)]);
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
