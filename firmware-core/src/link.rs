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
use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::blob::crc32;
use crate::capacity::MAX_INPUTS;
use crate::control_loop::telemetry::{Frame, Frames};
use crate::control_loop::{Command, ControlLoop, Mode};
use crate::encoding::{Reader, Writer};
use crate::update::{Answer, Answers, Ask, Refused, Request, Updates};

/// Longest frame on the line, the final zero included: a telemetry frame with lists as long as there is
/// room for takes 206 bytes, the longest chunk of a blob 213.
pub const MAX_FRAME: usize = 256;
/// Where a message begins in a frame that is made in place: behind the first code byte of COBS, which is the
/// only one besides its zeros, as long as it is shorter than 254 bytes.
const BODY: usize = 1;
/// Longest frame that a controller sends: one of telemetry. The longest answer takes 171 bytes.
const MAX_SENT: usize = 206;
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
    let message = postcard::to_slice(message, out.get_mut(BODY..).ok_or(TooLong)?);
    let end = BODY.saturating_add(message.map_err(|_| TooLong)?.len());
    frame(out, end)
}

/// Makes a frame of the message that lies in `out` from [`BODY`] to `end`: its checksum behind it, the whole
/// stuffed in place, and the final zero. Its length.
#[inline(never)]
fn frame(out: &mut [u8], end: usize) -> Result<usize, TooLong> {
    let check = crc32(0, out.get(BODY..end).ok_or(TooLong)?);
    let mut writer = Writer::behind(out, end);
    writer.array(&check.to_le_bytes());
    writer.byte(0);
    let length = writer.end().filter(|length| *length <= MAX_FRAME).ok_or(TooLong)?;
    // Every zero becomes the distance to the next one, the byte in front the distance to the first.
    let mut distance = 0_u8;
    for (i, byte) in out.iter_mut().enumerate().take(length).rev() {
        if *byte == 0 || i == 0 {
            (*byte, distance) = (distance, 0);
        }
        distance = distance.saturating_add(1);
    }
    Ok(length)
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
        let body = match self.complete(byte)? {
            Ok(body) => body,
            Err(Unframed::TooLong) => return Some(Received::TooLong),
            Err(Unframed::Damaged) => return Some(Received::Damaged),
        };
        // Bytes after a message are no part of any.
        let message = postcard::take_from_bytes(body).ok().filter(|(_, rest)| rest.is_empty());
        Some(message.map_or_else(
            || {
                let (variant, number) = unknown(body);
                Received::Unknown { variant, number }
            },
            |(message, _)| Received::Message(message),
        ))
    }

    /// Takes a byte; what is in the frame that it completes.
    #[inline(never)]
    fn complete(&mut self, byte: u8) -> Option<Result<&[u8], Unframed>> {
        if byte != 0 {
            if let Some(place) = self.frame.get_mut(self.length) {
                *place = byte;
            }
            // One beyond the end says that the frame was too long.
            self.length = self.length.wrapping_add(1).min(MAX_FRAME.wrapping_add(1));
            return None;
        }
        let length = core::mem::take(&mut self.length);
        if length == 0 {
            return None;
        }
        if length >= MAX_FRAME {
            return Some(Err(Unframed::TooLong));
        }
        let frame = self.frame.get_mut(..length).unwrap_or_default();
        let length = cobs::decode_in_place(frame).unwrap_or(0);
        let plain = frame.get(..length).and_then(|plain| plain.split_last_chunk::<4>());
        Some(match plain {
            Some((body, check)) if crc32(0, body) == u32::from_le_bytes(*check) => Ok(body),
            _ => Err(Unframed::Damaged),
        })
    }
}

/// Why there is nothing in a frame.
enum Unframed {
    TooLong,
    Damaged,
}

/// Variant and number of a request, as far as it is one, of what is no message known here.
fn unknown(body: &[u8]) -> (u8, u8) {
    let variant = body.first().copied().unwrap_or(0);
    (variant, body.get(1).copied().filter(|_| variant == REQUEST).unwrap_or(0))
}

/// What a controller reads: a [`Message`] without what is for the host.
#[derive(Debug, PartialEq)]
enum Incoming<const M: usize> {
    Command(Command<M>),
    /// It is where it was to be put.
    Request,
    /// For the host: an echo, or another controller, which would answer in its turn, for ever.
    ForHost,
    Unknown {
        variant: u8,
        number: u8,
    },
}

impl<const M: usize> Incoming<M> {
    #[inline(never)]
    fn read(body: &[u8], request: &mut Request) -> Self {
        let mut reader = Reader::new(body);
        let read = match reader.variant(256) as u8 {
            0 => Some(Self::Command(Command::Start)),
            1 => Some(Self::Command(Command::Stop)),
            2 => Some(Self::Command(Command::Reset)),
            INPUTS => {
                let mut inputs: Vec<f32, MAX_INPUTS> = Vec::new();
                reader.list(&mut inputs, Reader::number);
                // Otherwise its number of inputs is another.
                let inputs = inputs.as_slice().try_into();
                inputs.ok().map(|inputs| Self::Command(Command::Inputs(inputs)))
            }
            REQUEST => {
                request.read(&mut reader);
                Some(Self::Request)
            }
            _ => None,
        };
        match (read, reader.end(), unknown(body)) {
            (Some(read), Ok(()), _) => read,
            (_, _, (FRAME | ANSWER, _)) => Self::ForHost,
            (_, _, (variant, number)) => Self::Unknown { variant, number },
        }
    }
}

/// Reads at most this many bytes per call: bounded work, whatever the line brings.
const READ: usize = 128;
/// What updates have to do waits at most so long until answers are on the line (µs).
const SENT_US: u64 = 1_000_000;

/// One end of the line at a controller: commands and requests in, answers and frames out, never waiting.
#[derive(Clone, Debug)]
pub struct Port {
    receiver: Receiver,
    answers: Answers,
    /// The frame that is being sent, its length and how much of it is on the way.
    out: [u8; MAX_SENT],
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
            answers: Answers::new(),
            out: [0; MAX_SENT],
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
        self.answers.first().is_none() && (self.sent == self.length || !self.answered)
    }

    /// Reads what has arrived, at most 128 bytes, and hands on commands to the loop, requests to the
    /// updates; of what these have to do for long, a part, once the robot is
    /// [switched off](crate::control_loop::Supervisor::is_switched_off). Between two ticks of a robot at
    /// rest it may be called as often as there is time.
    #[inline(never)]
    pub fn receive<const M: usize>(
        &mut self,
        serial: &mut (impl Read + ReadReady),
        robot: &mut (impl ControlLoop<M> + ?Sized),
        updates: &mut impl Updates,
        now_us: u64,
    ) {
        self.listen(serial, robot, updates, now_us);
        if !updates.is_working() {
            self.works_since_us = None;
        } else if self.is_time_to_work(robot, now_us) {
            self.works_since_us = None;
            updates.work(robot.mode(), now_us, &mut self.answers);
            robot.supervisor_mut().pause();
        }
        robot.supervisor_mut().hold(updates.holds(now_us));
    }

    /// Reads what has arrived.
    #[inline(never)]
    fn listen<const M: usize>(
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
            let Some(body) = self.receiver.complete(*byte) else { continue };
            let is_done = match body {
                Ok(body) => take(body, robot, updates, now_us, &mut self.answers),
                Err(Unframed::TooLong) => {
                    let most = u32::try_from(MAX_FRAME).unwrap_or(u32::MAX);
                    self.answers.refuse(0, Refused::TooLong { most });
                    false
                }
                // Whoever sent it will see that nothing comes back.
                Err(Unframed::Damaged) => false,
            };
            if !is_done {
                self.damaged = self.damaged.saturating_add(1);
            }
        }
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

    /// Sends as much of the waiting answers and frames as the line takes now: the rest of the one on the
    /// way, and at most one more.
    #[inline(never)]
    pub fn send(&mut self, frames: &mut Frames<'_>, serial: &mut (impl Write + WriteReady)) {
        for _ in 0..2 {
            if self.sent == self.length {
                let waits = self.answered && frames.ready();
                let answer = if waits { None } else { self.answers.first() };
                self.answered = answer.is_some();
                let mut message = Writer::behind(&mut self.out, BODY);
                // Written where they lie, and dropped then.
                if let Some(answer) = answer {
                    message.byte(ANSWER);
                    answer.write(&mut message);
                    let _ = self.answers.take();
                } else if let Some(frame) = frames.peek() {
                    message.byte(FRAME);
                    frame.write(&mut message);
                    let _ = frames.dequeue();
                } else {
                    return;
                }
                self.sent = 0;
                // There is room for every message.
                let end = message.end().unwrap_or(0);
                self.length = frame(&mut self.out, end).unwrap_or(0);
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

/// Does what was received, and answers; whether it could be done.
#[inline(never)]
fn take<const M: usize>(
    body: &[u8],
    robot: &mut (impl ControlLoop<M> + ?Sized),
    updates: &mut impl Updates,
    now_us: u64,
    answers: &mut Answers,
) -> bool {
    let mut request = Request { number: 0, ask: Ask::Hello };
    match Incoming::read(body, &mut request) {
        Incoming::Command(command) => {
            robot.command(command);
            true
        }
        Incoming::Request => {
            updates.receive(request, robot.mode(), now_us, answers);
            true
        }
        Incoming::ForHost => false,
        Incoming::Unknown { variant, number } => {
            answers.refuse(number, Refused::Unknown { variant });
            false
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use crate::update::Say;
    use proptest::prelude::*;

    fn full() -> Message {
        let numbers = [f32::MIN_POSITIVE; 8];
        Message::Frame(Frame {
            sequence: u32::MAX,
            time_us: u64::MAX,
            mode: Mode::Safe,
            alarms: crate::control_loop::Alarms::TELLING,
            noticed: crate::control_loop::Alarms::TELLING,
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
    fn what_has_room_is_stuffed_in_place_and_the_rest_too_long() {
        // Without and with zeros: at every place, at the beginning, at the end.
        let fills: [fn(usize, usize) -> u8; 5] = [
            |_, _| 0xA5,
            |_, _| 0,
            |i, _| u8::from(i != 0),
            |i, n| u8::from(i + 1 != n),
            |i, _| (i % 7) as u8,
        ];
        for (fill, n) in fills.iter().flat_map(|fill| (1..=256).map(move |n| (fill, n))) {
            let body: std::vec::Vec<u8> = (0..n).map(|i| fill(i, n)).collect();
            let mut out = [0xEE; 300];
            out[BODY..BODY + n].copy_from_slice(&body);
            // Code byte, checksum and final zero.
            let Ok(length) = frame(&mut out, BODY + n) else {
                assert!(n > MAX_FRAME - 6, "{n}");
                continue;
            };
            assert_eq!(length, n + 6);
            let (frame, rest) = out.split_at(length);
            assert!(rest.iter().all(|byte| *byte == 0xEE));
            let mut receiver = Receiver::new();
            for byte in &frame[..length - 1] {
                assert!(*byte != 0 && receiver.complete(*byte).is_none());
            }
            let read = receiver.complete(frame[length - 1]);
            assert!(matches!(read, Some(Ok(read)) if read == body), "{n}");
        }
        for (room, end) in [(0, 1), (1, 0), (6, 1), (6, 2), (6, 7)] {
            assert_eq!(frame(&mut [1; 300][..room], end).is_ok(), (room, end) == (6, 1));
        }
    }

    #[test]
    fn the_largest_frame_has_room() {
        let mut out = [0; MAX_FRAME];
        let length = encode(&full(), &mut out).unwrap();
        assert_eq!(length, MAX_SENT, "see MAX_FRAME");
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

    /// What serde makes of a frame's body, as a controller takes it.
    fn as_serde_reads(body: &[u8]) -> (Incoming<2>, Option<Request>) {
        let message = postcard::take_from_bytes::<Message>(body);
        let incoming = match message {
            Ok((message, [])) => match (message.command(), message) {
                (Some(command), _) => Incoming::Command(command),
                (_, Message::Request(request)) => return (Incoming::Request, Some(request)),
                (_, Message::Inputs(_)) => Incoming::Unknown { variant: INPUTS, number: 0 },
                _ => Incoming::ForHost,
            },
            _ => match unknown(body) {
                (FRAME | ANSWER, _) => Incoming::ForHost,
                (variant, number) => Incoming::Unknown { variant, number },
            },
        };
        (incoming, None)
    }

    fn release() -> impl Strategy<Value = crate::slots::Release> {
        let numbers = (any::<u32>(), any::<u32>(), any::<u32>());
        (numbers, any::<[u8; 32]>()).prop_map(|((length, sequence, robot), sha256)| {
            crate::slots::Release { length, sha256, sequence, robot }
        })
    }

    fn request() -> impl Strategy<Value = Request> {
        let signature = || {
            prop::collection::vec(any::<u8>(), 0..=64)
                .prop_map(|bytes| bytes.into_iter().collect::<crate::update::Signature>())
        };
        let session = any::<u32>;
        let chunk = prop::collection::vec(any::<u8>(), 0..=crate::update::MAX_CHUNK);
        let ask = prop_oneof![
            Just(Ask::Hello),
            (session(), release(), signature()).prop_map(|(session, release, signature)| {
                Ask::Begin { session, release, signature }
            }),
            (session(), any::<u32>(), chunk).prop_map(|(session, offset, bytes)| Ask::Chunk {
                session,
                offset,
                bytes: bytes.into_iter().collect()
            }),
            session().prop_map(|session| Ask::Verify { session }),
            (session(), signature())
                .prop_map(|(session, signature)| Ask::Activate { session, signature }),
            signature().prop_map(|signature| Ask::Confirm { signature }),
            (session(), signature())
                .prop_map(|(session, signature)| Ask::Abort { session, signature }),
        ];
        (any::<u8>(), ask).prop_map(|(number, ask)| Request { number, ask })
    }

    fn incoming() -> impl Strategy<Value = Message> {
        prop_oneof![
            Just(Message::Start),
            Just(Message::Stop),
            Just(Message::Reset),
            prop::collection::vec(any::<f32>(), 0..=MAX_INPUTS)
                .prop_map(|inputs| Message::Inputs(inputs.into_iter().collect())),
            request().prop_map(Message::Request),
            answer().prop_map(Message::Answer),
            telemetry().prop_map(Message::Frame),
        ]
    }

    fn mode() -> impl Strategy<Value = Mode> {
        prop::sample::select(std::vec![Mode::Idle, Mode::Running, Mode::Safe])
    }

    fn hello() -> impl Strategy<Value = crate::update::Hello> {
        use crate::slots::Which;
        use crate::update::{Capacities, Hello, Trial};
        let capacities =
            (any::<[u32; 3]>(), any::<[u8; 3]>(), any::<[u16; 5]>()).prop_map(|(a, b, c)| {
                let ([sample_us, room, instructions], [states, inputs, lag]) = (a, b);
                let [observables, blocks, factors, terms, sparse_terms] = c;
                Capacities {
                    sample_us,
                    states,
                    inputs,
                    room,
                    instructions,
                    lag,
                    observables,
                    blocks,
                    factors,
                    terms,
                    sparse_terms,
                }
            });
        let which = prop::sample::select(std::vec![Which::A, Which::B, Which::Factory]);
        let trial = prop::option::of(any::<[u32; 2]>());
        (
            (any::<u8>(), "[a-zü]{0,12}", "[a-z]{0,24}", any::<u32>()),
            (mode(), capacities, which, release()),
            (trial, any::<u32>(), prop::option::of(any::<[u8; 8]>())),
        )
            .prop_map(|(first, second, (trial, floor, key))| {
                let ((protocol, firmware, name, robot), (mode, capacities, which, release)) =
                    (first, second);
                let [firmware, name] =
                    [firmware, name].map(|text| text.as_str().try_into().unwrap());
                let trial = trial.map(|[good, needed]| Trial { good, needed });
                Hello {
                    protocol,
                    firmware,
                    name,
                    robot,
                    mode,
                    capacities,
                    which,
                    release,
                    trial,
                    floor,
                    key,
                }
            })
    }

    fn answer() -> impl Strategy<Value = Answer> {
        let refused = (0_u8..20, any::<[u32; 2]>()).prop_map(|(which, [n, needed])| match which {
            0 => Refused::Unknown { variant: n as u8 },
            1 => Refused::TooLong { most: n },
            2 => Refused::Busy,
            3 => Refused::Working,
            4 => Refused::Signature,
            5 => Refused::Pause { ms: n },
            6 => Refused::AnotherRobot { robot: n },
            7 => Refused::BelowFloor { floor: n },
            8 => Refused::Length { room: n },
            9 => Refused::OnTrial,
            10 => Refused::InUse,
            11 => Refused::NoSession,
            12 => Refused::OutOfOrder { written: n },
            13 => Refused::Incomplete { written: n },
            14 => Refused::Hash,
            15 => Refused::Model,
            16 => Refused::NotVerified,
            17 => Refused::NotOnTrial,
            18 => Refused::TooEarly { good: n, needed },
            _ => Refused::Flash,
        });
        let say = prop_oneof![
            hello().prop_map(Say::Hello),
            any::<u32>().prop_map(|most_ms| Say::Working { most_ms }),
            any::<u32>().prop_map(|written| Say::Begun { written }),
            any::<u32>().prop_map(|written| Say::Written { written }),
            Just(Say::Verified),
            Just(Say::Activated),
            Just(Say::Confirmed),
            Just(Say::Aborted),
            refused.prop_map(Say::Refused),
        ];
        (any::<u8>(), say).prop_map(|(number, say)| Answer { number, say })
    }

    fn telemetry() -> impl Strategy<Value = Frame> {
        use crate::control_loop::Alarms;
        let list = || prop::collection::vec(any::<f32>(), 0..=MAX_INPUTS);
        let alarms = || {
            any::<u16>().prop_map(|bits| {
                let all = Alarms::all().map(|(alarm, _)| alarm);
                let there = all.filter(|alarm| alarm.bits() & bits != 0);
                there.fold(Alarms::none(), |alarms, alarm| alarms | alarm)
            })
        };
        let numbers = (any::<[u32; 5]>(), any::<u64>(), mode(), alarms(), alarms());
        (numbers, [list(), list(), list(), list(), list()]).prop_map(
            |((words, time_us, mode, alarms, noticed), lists)| {
                let [sequence, steps, bound_steps, worst_tick_us, dropped] = words;
                let [applied, measured, predicted, residual, ahead] = lists;
                let list = |numbers: std::vec::Vec<f32>| numbers.into_iter().collect();
                Frame {
                    sequence,
                    time_us,
                    mode,
                    alarms,
                    noticed,
                    applied: applied.into_iter().collect(),
                    measured: list(measured),
                    predicted: list(predicted),
                    residual: list(residual),
                    steps,
                    bound_steps,
                    ahead: list(ahead),
                    worst_tick_us,
                    dropped,
                }
            },
        )
    }

    fn written(variant: u8, write: impl FnOnce(&mut Writer<'_>)) -> std::vec::Vec<u8> {
        let mut bytes = [0; MAX_FRAME];
        let mut writer = Writer::behind(&mut bytes, 0);
        writer.byte(variant);
        write(&mut writer);
        let length = writer.end().unwrap();
        bytes[..length].to_vec()
    }

    fn as_serde_writes(message: &Message) -> std::vec::Vec<u8> {
        postcard::to_slice(message, &mut [0; MAX_FRAME]).unwrap().to_vec()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(5_000))]

        #[test]
        fn a_controller_writes_what_serde_writes(answer in answer(), frame in telemetry()) {
            let of_answer = written(ANSWER, |to| answer.write(to));
            prop_assert_eq!(of_answer, as_serde_writes(&Message::Answer(answer)));
            let of_frame = written(FRAME, |to| frame.write(to));
            prop_assert_eq!(of_frame, as_serde_writes(&Message::Frame(frame)));
        }

        #[test]
        fn a_controller_reads_what_serde_reads(
            message in incoming(),
            changes in prop::collection::vec((
                any::<prop::sample::Index>(), 0_usize..3, prop::collection::vec(any::<u8>(), 0..3),
            ), 0..3),
        ) {
            let mut body = as_serde_writes(&message);
            for (at, removed, inserted) in changes {
                let at = at.index(body.len() + 1);
                let end = (at + removed).min(body.len());
                body.splice(at..end, inserted);
            }
            // A variant may have more bytes than it takes; of what is for the host only the first counts.
            prop_assume!(body.first().is_none_or(|variant| *variant < 0x80));
            let mut request = Request { number: 0, ask: Ask::Hello };
            let read = Incoming::<2>::read(&body, &mut request);
            let (expected, expected_request) = as_serde_reads(&body);
            // NaN is as good as any other bits.
            prop_assert_eq!(std::format!("{read:?}"), std::format!("{expected:?}"));
            if let Some(expected) = expected_request {
                prop_assert_eq!(request, expected);
            }
        }
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
