//! Installing a new model over the line: who may, when, and step by step.
//!
//! ```text
//! host                                 controller
//!  Hello ────────────────────────────►
//!        ◄──────────────────────────── Hello: who it is, what runs, what it has room for
//!  Begin: session, release, signature ►          signature checked, the robot held in Safe
//!        ◄──────────────────────────── Working: most milliseconds until the next answer
//!        ◄──────────────────────────── Begun: bytes that are there already    (slot erased)
//!  Chunk: session, offset, bytes ─────►
//!        ◄──────────────────────────── Written: bytes that are there     (after it is written)
//!  Verify: session ───────────────────►          read back, hashed, parsed, self-test
//!        ◄──────────────────────────── Verified
//!  Activate: session, signature ──────►          committed
//!        ◄──────────────────────────── Activated                   … and the controller resets
//!  Hello ────────────────────────────►
//!        ◄──────────────────────────── Hello: the new model runs on trial, so many good ticks
//!  Confirm: signature ────────────────►          after enough of them
//!        ◄──────────────────────────── Confirmed
//! ```
//!
//! The bytes on the line are specified in docs/protocol.md. Every request gets one answer with its number,
//! `Begin` two when it has to erase; a request that is not understood, or may not be, gets
//! [`Say::Refused`]. All requests may be repeated when an answer does not come.
//!
//! # When
//!
//! While the robot runs every request but `Hello` is answered [`Refused::Busy`], without looking at its
//! signature. At rest, `Begin` with a right signature holds the robot in Safe until the update is aborted,
//! or nothing has been heard of it for [`SILENCE_US`]. Nothing else here changes what the robot does.
//!
//! # Who
//!
//! Whoever has a file that was signed: the controller knows a public key and no secret. Four statements
//! are signed (Ed25519, RFC 8032), one for each thing that may be done with a release, so that whoever
//! hears one of them on the line cannot do the next: [`statement`]. What is signed is the hash of the
//! blob, which is compared with what was written before it may be activated, its length, the robot and the
//! sequence number. A wrong signature makes the next check wait for [`SIGNATURE_PAUSE_US`]: checking takes
//! some 1.7 million instructions, and nobody shall keep a controller busy with it.
//!
//! A session is a number that the host draws: chunks of an update that is not that of the session are
//! refused, and while a session is alive no other begins.
//!
//! # In a firmware
//!
//! [`Updater::boot`] first, then the loop with the model that it chose, then a tick after the other; between
//! two ticks of a robot at rest [`Port::receive`](crate::link::Port::receive) may be called as often as there
//! is time.
//!
//! ```
//! # use core::convert::Infallible;
//! # use embedded_io::{ErrorType as IoErrorType, Read, ReadReady, Write, WriteReady};
//! # use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash};
//! # use firmware_core::control_loop::{Command, Mode, Supervisor, Timing};
//! # use firmware_core::link::{Message, Received, Receiver, encode};
//! # use firmware_core::update::{Ask, Request, Say};
//! # struct Memory([u8; 8192]);
//! # #[derive(Debug)] struct Never;
//! # impl NorFlashError for Never { fn kind(&self) -> NorFlashErrorKind { NorFlashErrorKind::Other } }
//! # impl ErrorType for Memory { type Error = Never; }
//! # impl ReadNorFlash for Memory {
//! #     const READ_SIZE: usize = 1;
//! #     fn read(&mut self, at: u32, bytes: &mut [u8]) -> Result<(), Never> {
//! #         bytes.copy_from_slice(&self.0[at as usize..][..bytes.len()]); Ok(())
//! #     }
//! #     fn capacity(&self) -> usize { 8192 }
//! # }
//! # impl NorFlash for Memory {
//! #     const WRITE_SIZE: usize = 4;
//! #     const ERASE_SIZE: usize = 4096;
//! #     fn erase(&mut self, from: u32, to: u32) -> Result<(), Never> {
//! #         self.0[from as usize..to as usize].fill(0xFF); Ok(())
//! #     }
//! #     fn write(&mut self, at: u32, bytes: &[u8]) -> Result<(), Never> {
//! #         self.0[at as usize..][..bytes.len()].copy_from_slice(bytes); Ok(())
//! #     }
//! # }
//! # struct Wire { came: Vec<u8>, said: Vec<u8> }
//! # impl IoErrorType for Wire { type Error = Infallible; }
//! # impl Read for Wire {
//! #     fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
//! #         let count = bytes.len().min(self.came.len());
//! #         bytes[..count].copy_from_slice(&self.came[..count]);
//! #         self.came.drain(..count); Ok(count)
//! #     }
//! # }
//! # impl ReadReady for Wire { fn read_ready(&mut self) -> Result<bool, Infallible> { Ok(!self.came.is_empty()) } }
//! # impl Write for Wire {
//! #     fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> { self.said.extend(bytes); Ok(bytes.len()) }
//! #     fn flush(&mut self) -> Result<(), Infallible> { Ok(()) }
//! # }
//! # impl WriteReady for Wire { fn write_ready(&mut self) -> Result<bool, Infallible> { Ok(true) } }
//! # struct Robot(Supervisor);
//! # impl ControlLoop<2> for Robot {
//! #     fn command(&mut self, _: Command<2>) {}
//! #     fn tick(&mut self, now_us: u64) -> Mode { self.0.begin(now_us); self.mode() }
//! #     fn finish(&mut self, _: u64) -> Mode { self.mode() }
//! #     fn path(&self) -> &[f32] { &[] }
//! #     fn supervisor(&self) -> &Supervisor { &self.0 }
//! #     fn supervisor_mut(&mut self) -> &mut Supervisor { &mut self.0 }
//! # }
//! # let flash = Memory([0xFF; 8192]);
//! # let mut frame = [0; 256];
//! # let length = encode(&Message::Request(Request { number: 1, ask: Ask::Hello }), &mut frame).unwrap();
//! # let mut serial = Wire { came: frame[..length].to_vec(), said: Vec::new() };
//! # let mut queue = firmware_core::control_loop::telemetry::Queue::<2>::new();
//! # let (_, mut frames) = queue.split();
//! # let mut clock = [1_000, 1_200].into_iter();
//! use firmware_core::control_loop::ControlLoop;
//! use firmware_core::link::Port;
//! use firmware_core::slots::{Geometry, Which};
//! use firmware_core::update::{Capacities, Identity, PublicKey, Updater};
//!
//! static FACTORY: &[u8] =
//!     include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/rosbot/model.bin"));
//! # const KEY: [u8; 32] = [7; 32];
//!
//! let identity = Identity {
//!     firmware: "rosbot 1.0",
//!     robot: "rosbot",
//!     factory: FACTORY,
//!     capacities: Capacities::new::<3, 2>(100_000, 90_000), // a sample of 100 ms, 90,000 instructions a step
//!     erase_ms: 4_000,
//!     good_ticks: 1_000,
//! };
//! let geometry = Geometry { offset: 0, slot_bytes: 4096 };
//! // Map the payload; accept it if `parse_for` and `Capacities::check` do.
//! let accept = |_payload| true;
//! let booted = Updater::boot(flash, geometry, identity, 0, PublicKey(KEY), accept);
//! let (mut updater, boot) = booted.unwrap();
//! assert_eq!(boot.running, Which::Factory); // or where `boot.payload` lies
//! # let mut robot = Robot(Supervisor::new(Timing { period_us: 10_000, watchdog_us: 1_000_000 }));
//! let mut port = Port::new();
//! // Every tick:
//! let began_us = clock.next().unwrap();
//! port.receive(&mut serial, &mut robot, &mut updater, began_us);
//! robot.tick(began_us);
//! robot.finish(clock.next().unwrap());
//! updater.ticked(robot.alarms());
//! port.send(&mut frames, &mut serial);
//! if updater.resets() && port.is_sent() {
//!     // Wait until the last byte is out, at most some milliseconds, and reset the controller; also if
//!     // the answers have not been sent after a second.
//! }
//! # let mut receiver = Receiver::new();
//! # let said = serial.said.iter().filter_map(|byte| receiver.push(*byte)).last();
//! # let Some(Received::Message(Message::Answer(answer))) = said else { panic!("{said:?}") };
//! # let Say::Hello(hello) = answer.say else { panic!() };
//! # assert_eq!((hello.name.as_str(), hello.capacities.room, hello.key), ("rosbot", 3_776, Some([7; 8])));
//! ```

use embedded_storage::nor_flash::NorFlash;
use heapless::{Deque, String, Vec};
use serde::{Deserialize, Serialize};

use crate::capacity::{
    MAX_BLOCKS, MAX_FACTORS, MAX_INPUTS, MAX_KEPT, MAX_LAG, MAX_OBSERVABLES, MAX_SPARSE_TERMS,
    MAX_STATES, MAX_TERMS,
};
use crate::control_loop::{Alarms, Mode};
use crate::cost;
use crate::encoding::{Reader, Writer};
use crate::model::Model;
use crate::slots::{
    BeginError, Boot, Geometry, GeometryError, MarkError, Payload, Release, Slots, VerifyError,
    Which, WriteError, sha256,
};

/// The version of the protocol.
pub const PROTOCOL: u8 = 1;
/// Most bytes of a blob in one message.
pub const MAX_CHUNK: usize = 192;
/// A session that says nothing for so long is over (µs); what it wrote can be gone on with.
pub const SILENCE_US: u64 = 5_000_000;
/// Time from a wrong signature to the next check of one (µs).
pub const SIGNATURE_PAUSE_US: u64 = 1_000_000;
/// Bytes of a signature.
pub const SIGNATURE: usize = 64;

/// Bytes of a name.
const NAME: usize = 24;

/// A signature; empty where nothing is signed.
pub type Signature = Vec<u8, SIGNATURE>;

/// What the host asks for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// Comes back with the answer. A repeated request keeps its number.
    pub number: u8,
    /// What.
    pub ask: Ask,
}

/// The kinds of requests.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
// There is no heap to put a chunk on.
#[allow(clippy::large_enum_variant)]
pub enum Ask {
    /// Who are you? Answered with [`Say::Hello`], always.
    Hello,
    /// Begins an update, or goes on with one of the same release.
    Begin {
        /// Number of the session, drawn by the host.
        session: u32,
        /// What is to be installed.
        release: Release,
        /// Of [`Purpose::Install`].
        signature: Signature,
    },
    /// Bytes of the blob.
    Chunk {
        /// Number of the session.
        session: u32,
        /// Where they belong.
        offset: u32,
        /// The bytes.
        bytes: Vec<u8, MAX_CHUNK>,
    },
    /// All bytes are there: are they right, and a model that this robot can run?
    Verify {
        /// Number of the session.
        session: u32,
    },
    /// Commits what has been verified, and resets the controller.
    Activate {
        /// Number of the session.
        session: u32,
        /// Of [`Purpose::Activate`].
        signature: Signature,
    },
    /// Keeps the model that is on trial.
    Confirm {
        /// Of [`Purpose::Confirm`].
        signature: Signature,
    },
    /// Drops the update.
    Abort {
        /// Number of the session.
        session: u32,
        /// Of [`Purpose::Abort`].
        signature: Signature,
    },
}

impl Ask {
    /// The signature that came with it.
    fn signature(&self) -> &[u8] {
        match self {
            Self::Begin { signature, .. }
            | Self::Activate { signature, .. }
            | Self::Confirm { signature }
            | Self::Abort { signature, .. } => signature,
            Self::Hello | Self::Chunk { .. } | Self::Verify { .. } => &[],
        }
    }
}

impl Request {
    /// As postcard has it, over the one that is there.
    #[inline(never)]
    pub(crate) fn read(&mut self, reader: &mut Reader<'_>) {
        self.number = reader.byte();
        let kind = reader.variant(7);
        // All but Hello and Confirm are of a session.
        let session = if kind == 0 || kind == 5 { 0 } else { reader.word() };
        self.ask = match kind {
            0 => Ask::Hello,
            1 => {
                let release = Release::read(reader);
                Ask::Begin { session, release, signature: Signature::new() }
            }
            2 => Ask::Chunk { session, offset: reader.word(), bytes: Vec::new() },
            3 => Ask::Verify { session },
            4 => Ask::Activate { session, signature: Signature::new() },
            5 => Ask::Confirm { signature: Signature::new() },
            _ => Ask::Abort { session, signature: Signature::new() },
        };
        match &mut self.ask {
            Ask::Hello | Ask::Verify { .. } => {}
            Ask::Chunk { bytes, .. } => reader.list(bytes, Reader::byte),
            Ask::Begin { signature, .. }
            | Ask::Activate { signature, .. }
            | Ask::Confirm { signature }
            | Ask::Abort { signature, .. } => reader.list(signature, Reader::byte),
        }
    }
}

/// What the controller answers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answer {
    /// Number of the request; 0 when it could not be read.
    pub number: u8,
    /// What.
    pub say: Say,
}

impl Answer {
    /// As postcard writes it.
    #[inline(never)]
    pub(crate) fn write(&self, to: &mut Writer<'_>) {
        let to = to.byte(self.number);
        let (kind, number) = match &self.say {
            Say::Hello(hello) => return hello.write(to.byte(0)),
            Say::Working { most_ms } => (1, Some(*most_ms)),
            Say::Begun { written } => (2, Some(*written)),
            Say::Written { written } => (3, Some(*written)),
            Say::Verified => (4, None),
            Say::Activated => (5, None),
            Say::Confirmed => (6, None),
            Say::Aborted => (7, None),
            Say::Refused(refused) => return refused.write(to.byte(8)),
        };
        let to = to.byte(kind);
        number.into_iter().for_each(|number| _ = to.word(number));
    }
}

/// The kinds of answers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)]
pub enum Say {
    /// Who it is.
    Hello(Hello),
    /// Another answer follows.
    Working {
        /// Most time until then (ms).
        most_ms: u32,
    },
    /// The slot is ready.
    Begun {
        /// Bytes of the blob that are there already.
        written: u32,
    },
    /// A chunk is in the flash.
    Written {
        /// Bytes of the blob that are there.
        written: u32,
    },
    /// The blob is right, and can be run.
    Verified,
    /// Committed; the controller resets.
    Activated,
    /// The model boots from now on.
    Confirmed,
    /// The update is dropped.
    Aborted,
    /// No, and why.
    Refused(Refused),
}

/// What was done: a [`Say`] that is not [`Hello`], whose room every call on the way would have to have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Done {
    Working { most_ms: u32 },
    Begun { written: u32 },
    Written { written: u32 },
    Verified,
    Activated,
    Confirmed,
    Aborted,
}

impl From<Done> for Say {
    fn from(done: Done) -> Self {
        match done {
            Done::Working { most_ms } => Self::Working { most_ms },
            Done::Begun { written } => Self::Begun { written },
            Done::Written { written } => Self::Written { written },
            Done::Verified => Self::Verified,
            Done::Activated => Self::Activated,
            Done::Confirmed => Self::Confirmed,
            Done::Aborted => Self::Aborted,
        }
    }
}

/// Why the controller does not do it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Refused {
    /// The message is not known here: another version of the protocol, or a controller that takes no
    /// updates.
    Unknown {
        /// Its first byte.
        variant: u8,
    },
    /// The frame is longer than there is room for.
    TooLong {
        /// Bytes of the longest frame, its final zero included.
        most: u32,
    },
    /// The robot is running.
    Busy,
    /// Another request is being worked on.
    Working,
    /// The release is not signed, or not with the key that is trusted here.
    Signature,
    /// There was a wrong signature a moment ago.
    Pause {
        /// Time until the next one is looked at (ms).
        ms: u32,
    },
    /// The model is one of another robot.
    AnotherRobot {
        /// [`robot`](crate::slots::robot) of the name of this one.
        robot: u32,
    },
    /// The release is older than what has been confirmed.
    BelowFloor {
        /// Lowest sequence number that is accepted.
        floor: u32,
    },
    /// The blob is empty, or longer than a slot.
    Length {
        /// Bytes there is room for.
        room: u32,
    },
    /// The model that runs is on trial: confirm it, or restart the controller, which drops it.
    OnTrial,
    /// Another session is alive.
    InUse,
    /// There is no such session: begin.
    NoSession,
    /// The chunk does not begin where the one before it ended, or it ends beyond the blob.
    OutOfOrder {
        /// Bytes of the blob that are there.
        written: u32,
    },
    /// The blob is not complete.
    Incomplete {
        /// Bytes of the blob that are there.
        written: u32,
    },
    /// What was written is not what was signed; the update is dropped.
    Hash,
    /// The blob is no model, fails its self-test, or is one that this robot cannot run; the update is
    /// dropped.
    Model,
    /// Nothing has been verified.
    NotVerified,
    /// No model is on trial.
    NotOnTrial,
    /// The model on trial has not had enough good ticks in a row.
    TooEarly {
        /// Those it has had.
        good: u32,
        /// Those it needs.
        needed: u32,
    },
    /// The flash failed; the update is dropped.
    Flash,
}

impl Refused {
    #[inline(never)]
    fn write(self, to: &mut Writer<'_>) {
        let (kind, number) = match self {
            Self::Unknown { variant } => {
                to.byte(0).byte(variant);
                return;
            }
            Self::TooLong { most } => (1, Some(most)),
            Self::Busy => (2, None),
            Self::Working => (3, None),
            Self::Signature => (4, None),
            Self::Pause { ms } => (5, Some(ms)),
            Self::AnotherRobot { robot } => (6, Some(robot)),
            Self::BelowFloor { floor } => (7, Some(floor)),
            Self::Length { room } => (8, Some(room)),
            Self::OnTrial => (9, None),
            Self::InUse => (10, None),
            Self::NoSession => (11, None),
            Self::OutOfOrder { written } => (12, Some(written)),
            Self::Incomplete { written } => (13, Some(written)),
            Self::Hash => (14, None),
            Self::Model => (15, None),
            Self::NotVerified => (16, None),
            Self::NotOnTrial => (17, None),
            Self::TooEarly { good, needed } => {
                to.byte(18).word(good).word(needed);
                return;
            }
            Self::Flash => (19, None),
        };
        let to = to.byte(kind);
        number.into_iter().for_each(|number| _ = to.word(number));
    }
}

/// Who a controller is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// [`PROTOCOL`].
    pub protocol: u8,
    /// Its firmware and version.
    pub firmware: String<NAME>,
    /// Beginning of the robot's name, as far as there is room.
    pub name: String<NAME>,
    /// [`robot`](crate::slots::robot) of the whole name.
    pub robot: u32,
    /// What the loop is doing.
    pub mode: Mode,
    /// What it has room for.
    pub capacities: Capacities,
    /// Which model runs.
    pub which: Which,
    /// The release that brought it; of the factory model length and hash, and sequence number 0.
    pub release: Release,
    /// Whether it is still to be confirmed.
    pub trial: Option<Trial>,
    /// Lowest sequence number that is accepted.
    pub floor: u32,
    /// The first bytes of the public key that is trusted; `None`: everybody is.
    pub key: Option<[u8; 8]>,
}

impl Hello {
    fn write(&self, to: &mut Writer<'_>) {
        let Capacities { sample_us, states, inputs, room, instructions, lag, .. } =
            &self.capacities;
        let Capacities { observables, blocks, factors, terms, sparse_terms, .. } = &self.capacities;
        let to = to.byte(self.protocol).bytes(self.firmware.as_bytes());
        let to = to.bytes(self.name.as_bytes()).word(self.robot).byte(self.mode as u8);
        let to = to.word(*sample_us).byte(*states).byte(*inputs).word(*room).word(*instructions);
        let to = to.byte(*lag).word((*observables).into()).word((*blocks).into());
        let to = to.word((*factors).into()).word((*terms).into()).word((*sparse_terms).into());
        let to = self.release.write(to.byte(self.which as u8)).byte(self.trial.is_some().into());
        if let Some(Trial { good, needed }) = self.trial {
            to.word(good).word(needed);
        }
        to.word(self.floor).byte(self.key.is_some().into());
        self.key.iter().for_each(|key| _ = to.array(key));
    }
}

/// How a trial goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Trial {
    /// Good ticks in a row.
    pub good: u32,
    /// Good ticks in a row before it can be confirmed.
    pub needed: u32,
}

/// What a controller and its loop have room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Capacities {
    /// Sample time of the loop (µs).
    pub sample_us: u32,
    /// State coordinates of the loop.
    pub states: u8,
    /// Inputs of the loop.
    pub inputs: u8,
    /// Bytes of a blob.
    pub room: u32,
    /// Most instructions of one step; 0 where that is not known.
    pub instructions: u32,
    /// [`MAX_LAG`].
    pub lag: u8,
    /// [`MAX_OBSERVABLES`].
    pub observables: u16,
    /// [`MAX_BLOCKS`].
    pub blocks: u16,
    /// [`MAX_FACTORS`].
    pub factors: u16,
    /// [`MAX_TERMS`].
    pub terms: u16,
    /// [`MAX_SPARSE_TERMS`].
    pub sparse_terms: u16,
}

/// Why a model cannot run on a controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Misfit {
    /// Of what there is too much, or another number.
    pub field: &'static str,
    /// What the controller has.
    pub expected: u64,
    /// What the model has.
    pub found: u64,
}

impl Capacities {
    /// Those of this build, for a loop of `N` coordinates and `M` inputs with a sample time in µs.
    /// `instructions` is what one step of its model may take at most, 0 if that does not matter.
    pub const fn new<const N: usize, const M: usize>(sample_us: u32, instructions: u32) -> Self {
        const { assert!(N <= MAX_STATES && M <= MAX_INPUTS) };
        Self {
            sample_us,
            states: N as u8,
            inputs: M as u8,
            // The slots know.
            room: 0,
            instructions,
            lag: MAX_LAG as u8,
            observables: MAX_OBSERVABLES as u16,
            blocks: MAX_BLOCKS as u16,
            factors: MAX_FACTORS as u16,
            terms: MAX_TERMS as u16,
            sparse_terms: MAX_SPARSE_TERMS as u16,
        }
    }

    /// Whether a model of `length` bytes fits: on the laptop, before anything is sent, and on the
    /// controller, before it is activated. What is not among these numbers its parser refuses.
    ///
    /// # Errors
    /// [`Misfit`], the first one.
    pub fn check(&self, model: &Model<'_>, length: usize) -> Result<(), Misfit> {
        let structure = model.structure();
        let sample_us = libm::roundf(structure.sample_time_s() * 1e6) as u32;
        let dictionary = structure.dictionary();
        let sparse = model.terms();
        let exact = [
            ("sample time in µs", self.sample_us, sample_us),
            ("states", self.states.into(), count(structure.states().len())),
            ("inputs", self.inputs.into(), count(structure.inputs().len())),
        ];
        let (dense_terms, sparse_terms) =
            sparse.map_or_else(|| (dictionary.dense_terms(), 0), |terms| (0, terms.count()));
        let unlimited = |limit: u32| if limit == 0 { u32::MAX } else { limit };
        let factors = dictionary.blocks().map(|(_, factors)| factors.len()).sum();
        let most = [
            ("bytes", self.room, count(length)),
            (
                "instructions of a step",
                unlimited(self.instructions),
                cost::instructions(structure, sparse),
            ),
            ("numbers of the history", count(MAX_KEPT), count(structure.kept())),
            ("lag", self.lag.into(), count(structure.lag())),
            ("observables", self.observables.into(), count(dictionary.observables().len())),
            ("blocks", self.blocks.into(), count(dictionary.blocks().count())),
            ("factors", self.factors.into(), count(factors)),
            ("terms", self.terms.into(), count(dense_terms)),
            // The constant is one of a model's terms, but not of these.
            ("sparse terms", self.sparse_terms.into(), count(sparse_terms).saturating_sub(1)),
        ];
        let other = exact.into_iter().find(|(_, expected, found)| expected != found);
        let larger = most.into_iter().find(|(_, most, found)| found > most);
        other.or(larger).map_or(Ok(()), |(field, expected, found)| {
            Err(Misfit { field, expected: expected.into(), found: found.into() })
        })
    }
}

fn count(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(u32::MAX)
}

/// What a signature allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// To hold the robot, erase a slot and write the release to it.
    Install = 1,
    /// To run it at the next boot.
    Activate = 2,
    /// To keep it.
    Confirm = 3,
    /// To drop it.
    Abort = 4,
}

impl Purpose {
    /// In the order of their numbers.
    pub const ALL: [Self; 4] = [Self::Install, Self::Activate, Self::Confirm, Self::Abort];
}

/// What is signed.
///
/// | offset | size | field |
/// |---|---|---|
/// | 0 | 16 | the bytes `koopman-release\0` |
/// | 16 | 1 | [`Purpose`] |
/// | 17 | 3 | zeros |
/// | 20 | 4 | robot: CRC-32 of its name |
/// | 24 | 4 | sequence number |
/// | 28 | 4 | length of the blob |
/// | 32 | 32 | SHA-256 of the blob |
///
/// ```
/// use firmware_core::slots::Release;
/// use firmware_core::update::{Purpose, statement};
/// let release = Release { length: 0x01020304, sha256: [7; 32], sequence: 5, robot: 6 };
/// let bytes = statement(Purpose::Confirm, &release);
/// assert_eq!(&bytes[..24], b"koopman-release\0\x03\0\0\0\x06\0\0\0");
/// assert_eq!(&bytes[24..], [&[5, 0, 0, 0, 4, 3, 2, 1][..], &[7; 32]].concat());
/// ```
pub fn statement(purpose: Purpose, release: &Release) -> [u8; 64] {
    let Release { length, sha256, sequence, robot } = release;
    let mut statement = [0; 64];
    let mut writer = Writer::behind(&mut statement, 0);
    writer.array(b"koopman-release\0").array(&[purpose as u8, 0, 0, 0]);
    for number in [robot, sequence, length] {
        writer.array(&number.to_le_bytes());
    }
    writer.array(sha256);
    statement
}

/// Whose releases are installed.
pub trait Trust {
    /// The first bytes of the key, `None` where everybody is trusted.
    fn key(&self) -> Option<[u8; 8]>;

    /// Whether the signature is right.
    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool;
}

/// An Ed25519 key (RFC 8032): releases that its owner has signed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublicKey(pub [u8; 32]);

impl Trust for PublicKey {
    fn key(&self) -> Option<[u8; 8]> {
        self.0.first_chunk().copied()
    }

    #[inline(never)]
    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool {
        let Ok(signature) = <[u8; SIGNATURE]>::try_from(signature) else { return false };
        let signature = ed25519_compact::Signature::new(signature);
        ed25519_compact::PublicKey::new(self.0).verify(statement, &signature).is_ok()
    }
}

/// Everybody: for development only. The host is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Anyone;

impl Trust for Anyone {
    fn key(&self) -> Option<[u8; 8]> {
        None
    }

    fn accepts(&self, _: &[u8; 64], _: &[u8]) -> bool {
        true
    }
}

impl<T: Trust> Trust for Option<T> {
    fn key(&self) -> Option<[u8; 8]> {
        self.as_ref().and_then(Trust::key)
    }

    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool {
        self.as_ref().is_none_or(|trust| trust.accepts(statement, signature))
    }
}

/// What a controller says of itself.
#[derive(Clone, Copy, Debug)]
pub struct Identity<'r> {
    /// Firmware and version.
    pub firmware: &'r str,
    /// Name of the robot.
    pub robot: &'r str,
    /// Bytes of the factory model.
    pub factory: &'r [u8],
    /// What it has room for; the slots fill in theirs.
    pub capacities: Capacities,
    /// Most time to erase a sector, from the data sheet (ms).
    pub erase_ms: u32,
    /// Good ticks in a row before a model on trial can be confirmed.
    pub good_ticks: u32,
}

/// Answers that wait to be sent. There is room for two; further ones are dropped, as the host asks again.
///
/// They are made where they wait: returned they would be on the stack below whatever finds out what to answer.
#[derive(Clone, Debug, Default)]
pub struct Answers(Deque<Answer, 2>);

impl Answers {
    /// None.
    pub const fn new() -> Self {
        Self(Deque::new())
    }

    /// One more, if there is room.
    #[inline(never)]
    pub(crate) fn refuse(&mut self, number: u8, refused: Refused) {
        let _ = self.0.push_back(Answer { number, say: Say::Refused(refused) });
    }

    #[inline(never)]
    fn tell(&mut self, number: u8, done: Done) {
        let _ = self.0.push_back(Answer { number, say: done.into() });
    }

    /// The one that has waited longest.
    pub fn first(&self) -> Option<&Answer> {
        self.0.front()
    }

    /// Takes it away.
    pub fn take(&mut self) -> Option<Answer> {
        self.0.pop_front()
    }
}

/// Takes requests, as a [`Port`](crate::link::Port) hands them on.
pub trait Updates {
    /// A request has arrived; answers what can be answered at once.
    fn receive(&mut self, request: Request, mode: Mode, now_us: u64, answers: &mut Answers);

    /// Whether there is something to do that takes long: only while the robot is at rest.
    fn is_working(&self) -> bool;

    /// Does a part of it: checks a signature, erases a sector, writes a chunk, reads a blob back. Of a
    /// robot that runs nothing is done, and what was asked is given up.
    fn work(&mut self, mode: Mode, now_us: u64, answers: &mut Answers);

    /// Whether the robot has to be [held](crate::control_loop::Supervisor::hold) in Safe; to be called
    /// after [`work`](Self::work), with the same time.
    fn holds(&mut self, now_us: u64) -> bool;
}

/// A controller whose model is part of its image: every request is unknown.
#[derive(Clone, Copy, Debug)]
pub struct NoUpdates;

impl Updates for NoUpdates {
    fn receive(&mut self, request: Request, _: Mode, _: u64, answers: &mut Answers) {
        answers.refuse(request.number, Refused::Unknown { variant: crate::link::REQUEST });
    }

    fn is_working(&self) -> bool {
        false
    }

    fn work(&mut self, _: Mode, _: u64, _: &mut Answers) {}

    fn holds(&mut self, _: u64) -> bool {
        false
    }
}

impl<U: Updates> Updates for Option<U> {
    fn receive(&mut self, request: Request, mode: Mode, now_us: u64, answers: &mut Answers) {
        match self {
            Some(updates) => updates.receive(request, mode, now_us, answers),
            None => NoUpdates.receive(request, mode, now_us, answers),
        }
    }

    fn is_working(&self) -> bool {
        self.as_ref().is_some_and(Updates::is_working)
    }

    fn work(&mut self, mode: Mode, now_us: u64, answers: &mut Answers) {
        if let Some(updates) = self {
            updates.work(mode, now_us, answers);
        }
    }

    fn holds(&mut self, now_us: u64) -> bool {
        self.as_mut().is_some_and(|updates| updates.holds(now_us))
    }
}

#[derive(Clone, Copy, Debug)]
struct Session {
    id: u32,
    /// When it was heard last; `None`: at the next call.
    heard_us: Option<u64>,
}

/// What is being done.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)]
enum Job {
    /// What was asked.
    Ask(Request),
    /// The slot is being erased for a request of this number.
    Erase(u8),
}

/// Installs models in [slots](crate::slots): the controller's end of an update.
///
/// `F` is the flash, `T` says whose releases are accepted, `A` whether a payload in the flash is a model
/// that can run: map it, [parse](crate::parse_for) it, and ask the loop and [`Capacities::check`].
#[derive(Debug)]
pub struct Updater<'r, F, T, A> {
    slots: Slots<F>,
    trust: T,
    accept: A,
    identity: Identity<'r>,
    /// What runs.
    release: Release,
    session: Option<Session>,
    job: Option<Job>,
    /// When the next signature may be looked at.
    pause_until_us: u64,
    wrong_signature: bool,
    /// Some work was done, and nobody has looked at the clock since.
    worked: bool,
    good: u32,
    resets: bool,
}

impl<'r, F, T, A> Updater<'r, F, T, A>
where
    F: NorFlash,
    T: Trust,
    A: FnMut(Payload) -> bool,
{
    /// Decides what runs ([`Slots::boot`]), once at every power-on. `lowest` is the lowest sequence number
    /// that the image accepts.
    ///
    /// # Errors
    /// [`GeometryError`].
    #[inline(always)]
    pub fn boot(
        flash: F,
        geometry: Geometry,
        identity: Identity<'r>,
        lowest: u32,
        trust: T,
        mut accept: A,
    ) -> Result<(Self, Boot<F::Error>), GeometryError> {
        let (slots, boot) = Slots::boot(flash, geometry, identity.robot, lowest, &mut accept)?;
        let release = slots.release().unwrap_or_else(|| {
            let (length, sha256) = (count(identity.factory.len()), sha256(identity.factory));
            Release { length, sha256, sequence: 0, robot: slots.robot() }
        });
        let (session, job, pause_until_us) = (None, None, 0);
        let (wrong_signature, worked, good, resets) = (false, false, 0, false);
        let updater = Self {
            slots,
            trust,
            accept,
            identity,
            release,
            session,
            job,
            pause_until_us,
            wrong_signature,
            worked,
            good,
            resets,
        };
        Ok((updater, boot))
    }

    /// The slots.
    pub fn slots(&self) -> &Slots<F> {
        &self.slots
    }

    /// A tick is over: does the trial go well? A tick is good unless the loop has an alarm that stops the
    /// robot, or finds that the model is not the robot's.
    pub fn ticked(&mut self, alarms: Alarms) {
        let bad = alarms.intersects(Alarms::SAFE | Alarms::RESIDUAL);
        self.good = if bad { 0 } else { self.good.saturating_add(1) };
    }

    /// Whether the controller is to be reset: as soon as its answers are on the line, or after a second
    /// if that does not take them. Until then the robot is held.
    pub fn resets(&self) -> bool {
        self.resets
    }

    fn trial(&self) -> Option<Trial> {
        let needed = self.identity.good_ticks;
        self.slots.on_trial().then(|| Trial { good: self.good.min(needed), needed })
    }

    #[inline(never)]
    fn greet(&self, number: u8, mode: Mode, answers: &mut Answers) {
        let Identity { firmware, robot: name, capacities, .. } = &self.identity;
        let hello = Hello {
            protocol: PROTOCOL,
            firmware: beginning(firmware),
            name: beginning(name),
            robot: self.slots.robot(),
            mode,
            capacities: Capacities { room: self.slots.room(), ..*capacities },
            which: self.slots.running(),
            release: self.release,
            trial: self.trial(),
            floor: self.slots.floor(),
            key: self.trust.key(),
        };
        let _ = answers.0.push_back(Answer { number, say: Say::Hello(hello) });
    }

    /// Whether a session is alive; that of an update that is over is not.
    #[inline(never)]
    fn settle(&mut self, now_us: u64) {
        if let Some(session) = &mut self.session {
            let heard_us = *session.heard_us.get_or_insert(now_us);
            // What takes long is no silence of the host.
            if self.job.is_none() && now_us.saturating_sub(heard_us) > SILENCE_US {
                self.session = None;
            }
        }
        if self.wrong_signature {
            self.wrong_signature = false;
            self.pause_until_us = now_us.saturating_add(SIGNATURE_PAUSE_US);
        }
    }

    /// Whether a signature may be looked at.
    fn signed(&self, signature: &Signature, now_us: u64) -> Result<(), Refused> {
        if self.trust.key().is_none() {
            return Ok(());
        }
        if signature.len() != SIGNATURE {
            return Err(Refused::Signature);
        }
        match self.pause_until_us.checked_sub(now_us) {
            Some(us) if us > 0 => {
                Err(Refused::Pause { ms: u32::try_from(us.div_ceil(1000)).unwrap_or(u32::MAX) })
            }
            _ => Ok(()),
        }
    }

    /// Whether the request is of the session that is alive.
    fn of_session(&mut self, id: u32, now_us: u64) -> Result<(), Refused> {
        let session = self.session.as_mut().filter(|session| session.id == id);
        session.ok_or(Refused::NoSession)?.heard_us = Some(now_us);
        Ok(())
    }

    /// Whether there is a model on trial, with enough good ticks.
    fn may_confirm(&self) -> Result<(), Refused> {
        let Trial { good, needed } = self.trial().ok_or(Refused::NotOnTrial)?;
        if good < needed { Err(Refused::TooEarly { good, needed }) } else { Ok(()) }
    }

    /// What can be said at once; `None` where there is something to do.
    #[inline(never)]
    fn at_once(&mut self, ask: &Ask, now_us: u64) -> Result<Option<Done>, Refused> {
        if self.resets && !matches!(ask, Ask::Activate { .. }) {
            return Err(Refused::Working);
        }
        if let Ask::Chunk { session, .. }
        | Ask::Verify { session }
        | Ask::Activate { session, .. }
        | Ask::Abort { session, .. } = ask
        {
            self.of_session(*session, now_us)?;
        }
        match ask {
            // One was answered before, the other is looked at when it is done.
            Ask::Hello | Ask::Verify { .. } => {}
            Ask::Begin { session: id, release, signature } => {
                let same = self.slots.is_of(release);
                match &self.session {
                    Some(session) if session.id != *id => return Err(Refused::InUse),
                    // The answer was lost.
                    Some(_) if same => {
                        if let Some(written) = self.slots.written() {
                            self.of_session(*id, now_us)?;
                            return Ok(Some(Done::Begun { written }));
                        }
                    }
                    _ => {}
                }
                self.slots.check(release).map_err(|error| match error {
                    BeginError::OnTrial => Refused::OnTrial,
                    BeginError::Length { room, .. } => Refused::Length { room },
                    BeginError::BelowFloor { floor, .. } => Refused::BelowFloor { floor },
                    BeginError::AnotherRobot { .. } => {
                        Refused::AnotherRobot { robot: self.slots.robot() }
                    }
                })?;
                self.signed(signature, now_us)?;
            }
            Ask::Chunk { offset, bytes, .. } => {
                let release = self.slots.update().ok_or(Refused::NoSession)?;
                let written = self.slots.written().ok_or(Refused::NoSession)?;
                let room = release.length.saturating_sub(written);
                if *offset != written || count(bytes.len()) > room {
                    return Err(Refused::OutOfOrder { written });
                }
                if bytes.is_empty() {
                    return Ok(Some(Done::Written { written }));
                }
            }
            Ask::Activate { signature, .. } => {
                if self.resets {
                    return Ok(Some(Done::Activated));
                }
                self.signed(signature, now_us)?;
            }
            Ask::Confirm { signature } => {
                self.may_confirm()?;
                self.signed(signature, now_us)?;
            }
            Ask::Abort { signature, .. } => self.signed(signature, now_us)?,
        }
        Ok(None)
    }

    /// Looks at a signature of what is installed, or runs.
    fn check(&mut self, purpose: Purpose, release: &Release) -> Result<(), Refused> {
        let signature = match &self.job {
            Some(Job::Ask(Request { ask, .. })) => ask.signature(),
            _ => &[],
        };
        // Nothing has to be said where everybody is trusted.
        if self.trust.key().is_none() || self.trust.accepts(&statement(purpose, release), signature)
        {
            return Ok(());
        }
        // From when this call is over.
        self.wrong_signature = true;
        Err(Refused::Signature)
    }

    /// The same of the update under way.
    #[inline(never)]
    fn check_update(&mut self, purpose: Purpose, missing: Refused) -> Result<(), Refused> {
        let release = self.slots.update().ok_or(missing)?;
        self.check(purpose, &release)
    }

    /// Begins an update, or goes on with it.
    #[inline(never)]
    fn begin(&mut self, number: u8, id: u32, release: Release) -> Result<Done, Refused> {
        self.check(Purpose::Install, &release)?;
        self.session = Some(Session { id, heard_us: None });
        if self.slots.is_of(&release) && !self.slots.is_committed() {
            if let Some(written) = self.slots.written() {
                return Ok(Done::Begun { written });
            }
        } else if self.slots.begin(&release).is_err() {
            // Checked when it arrived.
            return Err(Refused::NoSession);
        }
        self.job = Some(Job::Erase(number));
        Ok(self.working())
    }

    /// Drops the update.
    fn drop_update(&mut self) -> Result<(), Refused> {
        self.session = None;
        self.slots.abort().map_err(|_| Refused::Flash)
    }

    /// Does what was asked and takes long. The request stays where it is.
    fn perform(&mut self) -> Result<Done, Refused> {
        let Some(Job::Ask(Request { number, ask })) = &self.job else {
            return Err(Refused::NoSession);
        };
        match ask {
            Ask::Hello => Err(Refused::Unknown { variant: crate::link::REQUEST }),
            Ask::Begin { session, release, .. } => self.begin(*number, *session, *release),
            Ask::Chunk { offset, bytes, .. } => {
                self.slots.write(*offset, bytes).map_err(|error| match error {
                    WriteError::OutOfOrder { expected: written, .. } => {
                        Refused::OutOfOrder { written }
                    }
                    WriteError::Flash(_) => Refused::Flash,
                    _ => Refused::NoSession,
                })?;
                Ok(Done::Written { written: self.slots.written().unwrap_or(0) })
            }
            Ask::Verify { .. } => {
                let payload = match self.slots.verify() {
                    Ok(payload) => payload,
                    Err(VerifyError::NotWriting) => return Err(Refused::NoSession),
                    Err(VerifyError::Incomplete { written, .. }) => {
                        return Err(Refused::Incomplete { written });
                    }
                    Err(VerifyError::Flash(_)) => return Err(Refused::Flash),
                    Err(VerifyError::Hash) => {
                        self.session = None;
                        return Err(Refused::Hash);
                    }
                };
                if !(self.accept)(payload) {
                    self.drop_update()?;
                    return Err(Refused::Model);
                }
                Ok(Done::Verified)
            }
            Ask::Activate { .. } => {
                self.check_update(Purpose::Activate, Refused::NotVerified)?;
                self.slots.commit().map_err(|error| match error {
                    MarkError::NotReady => Refused::NotVerified,
                    _ => Refused::Flash,
                })?;
                self.resets = true;
                Ok(Done::Activated)
            }
            Ask::Confirm { .. } => {
                // Ticks may have come since.
                self.may_confirm()?;
                let release = self.release;
                self.check(Purpose::Confirm, &release)?;
                self.slots.confirm().map_err(|error| match error {
                    MarkError::NotReady => Refused::NotOnTrial,
                    _ => Refused::Flash,
                })?;
                Ok(Done::Confirmed)
            }
            Ask::Abort { .. } => {
                self.check_update(Purpose::Abort, Refused::NoSession)?;
                self.drop_update()?;
                Ok(Done::Aborted)
            }
        }
    }

    /// What is said while the slot is erased.
    fn working(&self) -> Done {
        // One sector more for what else there is to do.
        let sectors = self.slots.sectors().saturating_add(1);
        Done::Working { most_ms: sectors.saturating_mul(self.identity.erase_ms) }
    }

    /// Erases a sector; `None` until it was the last.
    fn erase(&mut self) -> Option<Result<Done, Refused>> {
        match self.slots.erase() {
            Ok(0) => Some(Ok(Done::Begun { written: 0 })),
            Ok(_) => None,
            Err(_) => Some(Err(Refused::Flash)),
        }
    }
}

impl<F, T, A> Updates for Updater<'_, F, T, A>
where
    F: NorFlash,
    T: Trust,
    A: FnMut(Payload) -> bool,
{
    #[inline(never)]
    fn receive(&mut self, request: Request, mode: Mode, now_us: u64, answers: &mut Answers) {
        self.settle(now_us);
        let Request { number, ask } = &request;
        let number = *number;
        if matches!(ask, Ask::Hello) {
            return self.greet(number, mode, answers);
        }
        if mode == Mode::Running {
            return answers.refuse(number, Refused::Busy);
        }
        match &self.job {
            // It is on its way.
            Some(Job::Ask(Request { number: known, .. })) if *known == number => return,
            Some(Job::Erase(known)) if *known == number => {
                return answers.tell(number, self.working());
            }
            Some(_) => return answers.refuse(number, Refused::Working),
            None => {}
        }
        match self.at_once(ask, now_us) {
            Ok(Some(done)) => answers.tell(number, done),
            Ok(None) => self.job = Some(Job::Ask(request)),
            Err(refused) => answers.refuse(number, refused),
        }
    }

    fn is_working(&self) -> bool {
        self.job.is_some()
    }

    #[inline(never)]
    fn work(&mut self, mode: Mode, now_us: u64, answers: &mut Answers) {
        self.settle(now_us);
        let (number, result) = match &self.job {
            None => return,
            // It was started in the meantime.
            Some(Job::Ask(Request { number, .. })) if mode == Mode::Running => {
                (*number, Err(Refused::Busy))
            }
            Some(Job::Ask(Request { number, .. })) => (*number, self.perform()),
            // Whoever calls this has not held the robot yet.
            Some(Job::Erase(_)) if mode != Mode::Safe => return,
            Some(Job::Erase(number)) => {
                let number = *number;
                let Some(result) = self.erase() else { return };
                (number, result)
            }
        };
        if !matches!(result, Ok(Done::Working { .. })) {
            self.job = None;
        }
        if matches!(result, Err(Refused::Flash)) {
            self.session = None;
        }
        if let Some(session) = &mut self.session {
            // It could not be heard while this took its time.
            session.heard_us = None;
        }
        self.worked = true;
        match result {
            Ok(done) => answers.tell(number, done),
            Err(refused) => answers.refuse(number, refused),
        }
    }

    fn holds(&mut self, now_us: u64) -> bool {
        // Right after some work the time is that before it.
        if !core::mem::take(&mut self.worked) {
            self.settle(now_us);
        }
        self.session.is_some() || self.resets
    }
}

/// As much of a text as there is room for.
#[inline(never)]
fn beginning(text: &str) -> String<NAME> {
    let mut end = text.len().min(NAME);
    while !text.is_char_boundary(end) {
        end = end.saturating_sub(1);
    }
    let mut beginning = String::new();
    // There is room.
    let _ = beginning.push_str(text.get(..end).unwrap_or(""));
    beginning
}
