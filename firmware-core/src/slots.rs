//! Two model slots in flash that no power cut can brick: write, trial, confirm, revert.
//!
//! A new model goes to the slot that is not running: payload, read-back, header, and last the commit
//! mark. At the next boot it runs on trial. [`Slots::confirm`], after so many good ticks, makes it the
//! model that boots; without it the boot after that goes back to the one before. When neither slot has a
//! model that may run, the factory model in the image does.
//!
//! Erasing stalls most controllers for as long as seconds, programming for microseconds. When that is
//! allowed is the caller's business, which [`update`](crate::update) minds: call [`erase`](Slots::erase),
//! [`write`](Slots::write), [`verify`](Slots::verify), [`commit`](Slots::commit),
//! [`confirm`](Slots::confirm) and [`abort`](Slots::abort) only while the actuators are switched off: the
//! loop held in Safe, or, to confirm, at rest.
//!
//! A slot begins with a header of 64 bytes, four marks of two cells each, and, at 320, the payload; the layout is
//! the same on every flash. Every field, the states of a slot, how a boot decides, and why a power cut
//! anywhere leaves the old or the new model are specified in docs/flash-layout.md. In short:
//!
//! - The running slot is only ever marked, never erased. On trial no update may begin, because the other
//!   slot is what a revert goes back to.
//! - Each transition is one word, programmed where all bits are erased, so that it can be done again, in
//!   the second cell, after a cut. It holds the header's CRC: marks of another update do not fit.
//! - A boot that acts on what a cut may have left undecided first marks it: what has been decided stays
//!   decided.
//! - The trial mark is set before the model is handed to the caller: a model that crashes the
//!   controller while it is parsed runs once.
//! - The floor is the largest sequence number of a confirmed slot, or the one that the image asks for, if
//!   that is larger. Neither a new nor an old model below it ever runs, but for the factory model: it is the
//!   last resort.
//!
//! Sequence numbers and hashes are checked here; who may set them is [`update`](crate::update)'s business.
//!
//! A flash with error correction may answer a torn word with a fault: its driver has to turn it into an
//! error, which counts as a torn cell, as an empty slot, or, in the reject mark, as one that does not run.
//!
//! ```
//! # use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash};
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
//! # let mut flash = Memory([0xFF; 8192]);
//! use firmware_core::slots::{Geometry, Release, Slots, Which};
//!
//! let blob = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/rosbot/model.bin"));
//! let geometry = Geometry { offset: 0, slot_bytes: 4096 };
//! // On a controller: map the payload, and accept it if `parse_for("rosbot", …)` does.
//! let accept = |_payload| true;
//!
//! let (mut slots, boot) = Slots::boot(&mut flash, geometry, "rosbot", 0, accept).unwrap();
//! assert_eq!(boot.running, Which::Factory);
//! let release = Release::new("rosbot", 7, blob).unwrap();
//! slots.begin(&release).unwrap();
//! while slots.erase().unwrap() > 0 {} // a sector at a time
//! slots.write(0, &blob[..1000]).unwrap();
//! assert_eq!(slots.written(), Some(1000)); // where a host that reconnects goes on
//! slots.write(1000, &blob[1000..]).unwrap();
//! slots.verify().unwrap();
//! slots.commit().unwrap();
//!
//! // After a reset.
//! let (mut slots, boot) = Slots::boot(&mut flash, geometry, "rosbot", 0, accept).unwrap();
//! assert_eq!((boot.running, boot.trial, boot.floor), (Which::A, true, 0));
//! slots.confirm().unwrap(); // after so many good ticks
//! assert_eq!(slots.floor(), 7);
//! ```

use embedded_storage::nor_flash::{NorFlash, ReadNorFlash};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::blob::crc32;
use crate::encoding::{ReadError, Reader, Writer};

/// First bytes of a slot with a header.
pub const MAGIC: [u8; 4] = *b"SLOT";
/// The version of the layout that this code reads and writes.
pub const VERSION: u16 = 1;
/// Where the payload begins in a slot.
pub const PAYLOAD_OFFSET: u32 = 320;
/// Largest write unit of a flash, in bytes.
pub const MAX_WRITE_SIZE: usize = CELL;

const HEADER: usize = 64;
/// Bytes of a cell, and the largest write unit.
const CELL: usize = 32;
/// Bytes of a mark's word.
const WORD: usize = 8;
/// Header and marks.
const RECORD: usize = PAYLOAD_OFFSET as usize;
const ERASED: u8 = 0xFF;
/// Bytes read at a time.
const BUFFER: usize = 128;

const _: () = assert!(RECORD == HEADER + 4 * 2 * CELL && BUFFER.is_multiple_of(CELL));

/// What a header says of a robot: the CRC-32 of its name.
///
/// ```
/// assert_eq!(firmware_core::slots::robot("rosbot"), 0x6B9E_3F84);
/// ```
pub fn robot(name: &str) -> u32 {
    crc32(0, name.as_bytes())
}

/// The hash of a payload, as in a header.
pub fn sha256(payload: &[u8]) -> [u8; 32] {
    let mut digest = Sha256::new();
    feed(&mut digest, payload);
    finish(digest)
}

// Once each: where they are called they would be part of the code.

#[inline(never)]
fn feed(digest: &mut Sha256, part: &[u8]) {
    digest.update(part);
}

#[inline(never)]
fn finish(digest: Sha256) -> [u8; 32] {
    digest.finalize().into()
}

/// Where the slots lie in the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Beginning of slot A, a multiple of a sector.
    pub offset: u32,
    /// Bytes of each slot, a multiple of a sector.
    pub slot_bytes: u32,
}

impl Geometry {
    /// Bytes of a payload there is room for in a slot.
    pub const fn room(self) -> u32 {
        self.slot_bytes.saturating_sub(PAYLOAD_OFFSET)
    }
}

/// Why there cannot be slots like this.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum GeometryError {
    /// Offset or size of the slots is no multiple of a sector, or a slot has no room for a payload.
    Sectors {
        /// Bytes of a sector.
        sector: usize,
    },
    /// The slots end beyond the flash.
    Capacity {
        /// Bytes of the flash.
        capacity: usize,
    },
    /// A write or read unit does not divide [`MAX_WRITE_SIZE`], or a sector is no multiple of that.
    Unit {
        /// Bytes of the unit, or of the sector.
        found: usize,
    },
}

/// Where a model comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Which {
    /// The first slot.
    A,
    /// The second slot.
    B,
    /// The image of the firmware.
    Factory,
}

/// One of the two slots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    A,
    B,
}

impl Side {
    const BOTH: [Self; 2] = [Self::A, Self::B];

    fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

impl From<Side> for Which {
    fn from(side: Side) -> Self {
        match side {
            Side::A => Self::A,
            Side::B => Self::B,
        }
    }
}

/// A payload in the flash, whose hash is right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Payload {
    /// Its slot.
    pub slot: Which,
    /// Its first byte in the flash, a multiple of 32 from the beginning of a sector: where sectors are
    /// mapped at addresses divisible by four, so is the blob.
    pub offset: u32,
    /// Its bytes.
    pub length: u32,
    /// The sequence number of the update that brought it.
    pub sequence: u32,
}

/// Why a slot is not run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refusal<E> {
    /// There is no header: erased, half erased or half written.
    Empty,
    /// A layout that this code does not read, or a length that does not fit.
    Layout,
    /// The update was not committed.
    NotCommitted,
    /// The trial was not confirmed, or the update was aborted.
    Rejected,
    /// The model belongs to another robot.
    AnotherRobot {
        /// [`robot`] of its name.
        found: u32,
    },
    /// The model is older than what has been confirmed.
    BelowFloor {
        /// The floor.
        floor: u32,
        /// The sequence number of the slot.
        found: u32,
    },
    /// The payload has been damaged.
    Payload,
    /// The caller did not accept it: no blob, or its self-test failed.
    NotAccepted,
    /// The flash failed.
    Flash(E),
}

/// What was found at power-on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Boot<E> {
    /// What to run.
    pub running: Which,
    /// Where it lies, unless it is the factory model.
    pub payload: Option<Payload>,
    /// Whether it must be [confirmed](Slots::confirm) to run at the next boot, too.
    pub trial: bool,
    /// The lowest sequence number that is accepted.
    pub floor: u32,
    /// Why slot A and slot B do not run; `None` of the one that does, and of one that was not needed.
    pub refused: [Option<Refusal<E>>; 2],
}

/// What the host says of a payload before it sends it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Release {
    /// Bytes of the payload.
    pub length: u32,
    /// Its SHA-256.
    pub sha256: [u8; 32],
    /// Sequence number: one that is never smaller than that of a model released before.
    pub sequence: u32,
    /// [`robot`] of the robot's name.
    pub robot: u32,
}

impl Release {
    /// The release of a payload; `None` of 4 GB and more.
    pub fn new(name: &str, sequence: u32, payload: &[u8]) -> Option<Self> {
        let length = u32::try_from(payload.len()).ok()?;
        Some(Self { length, sha256: sha256(payload), sequence, robot: robot(name) })
    }
}

impl Release {
    /// As postcard has it.
    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self, ReadError> {
        let (length, sha256) = (reader.word()?, reader.array()?);
        Ok(Self { length, sha256, sequence: reader.word()?, robot: reader.word()? })
    }

    pub(crate) fn write<const C: usize>(&self, to: &mut Writer<C>) {
        to.word(self.length);
        to.array(&self.sha256);
        to.word(self.sequence);
        to.word(self.robot);
    }
}

/// Why an update does not begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BeginError {
    /// The running model is on trial: the other slot is what a revert goes back to.
    OnTrial,
    /// The payload is empty or too long.
    Length {
        /// Bytes there is room for.
        room: u32,
        /// Bytes of the payload.
        found: u32,
    },
    /// The update is older than what has been confirmed.
    BelowFloor {
        /// The floor.
        floor: u32,
        /// The sequence number of the update.
        found: u32,
    },
    /// The model belongs to another robot.
    AnotherRobot {
        /// [`robot`] of its name.
        found: u32,
    },
}

/// Why a part of a payload is not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum WriteError<E> {
    /// No update has begun, its slot is not erased yet, or it is past its verification.
    NotWriting,
    /// The part does not begin where the one before it ended.
    OutOfOrder {
        /// Where to go on.
        expected: u32,
        /// Where the part begins.
        found: u32,
    },
    /// The part ends beyond the payload.
    TooLong {
        /// Bytes that are missing yet.
        room: u32,
        /// Bytes of the part.
        found: usize,
    },
    /// The flash failed, and the update is over.
    Flash(E),
}

/// Why a payload is not right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum VerifyError<E> {
    /// No update has begun, or it is committed.
    NotWriting,
    /// Not all of the payload has been written.
    Incomplete {
        /// Bytes written.
        written: u32,
        /// Bytes of the payload.
        length: u32,
    },
    /// What was read back has another hash than the release, and the update is over.
    Hash,
    /// The flash failed, and the update is over.
    Flash(E),
}

/// Why a mark is not set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum MarkError<E> {
    /// No update has been verified (commit), or nothing is on trial (confirm).
    NotReady,
    /// What was read back is not what was written.
    ReadBack,
    /// The flash failed.
    Flash(E),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Header {
    length: u32,
    sequence: u32,
    generation: u32,
    robot: u32,
    sha256: [u8; 32],
}

impl Header {
    fn release(&self) -> Release {
        let Self { length, sequence, robot, sha256, .. } = *self;
        Release { length, sha256, sequence, robot }
    }

    fn encode(&self) -> [u8; HEADER] {
        let mut bytes = [0; HEADER];
        let mut at = 0_usize;
        let mut put = |field: &[u8]| {
            let end = at.saturating_add(field.len());
            if let Some(place) = bytes.get_mut(at..end) {
                place.copy_from_slice(field);
            }
            at = end;
        };
        put(&MAGIC);
        put(&VERSION.to_le_bytes());
        put(&(RECORD as u16).to_le_bytes());
        put(&self.length.to_le_bytes());
        put(&self.sequence.to_le_bytes());
        put(&self.generation.to_le_bytes());
        put(&self.robot.to_le_bytes());
        put(&self.sha256);
        put(&[0; 4]);
        if let Some((body, check)) = bytes.split_last_chunk_mut::<4>() {
            *check = crc32(0, body).to_le_bytes();
        }
        bytes
    }

    /// The header, `None` where there is none.
    fn decode(bytes: &[u8]) -> Option<Result<Self, Unreadable>> {
        let (body, check) = bytes.split_last_chunk::<4>()?;
        let body = body.strip_prefix(&MAGIC)?;
        if bytes.len() != HEADER || check_of(bytes) != u32::from_le_bytes(*check) {
            return None;
        }
        let (version, body) = body.split_first_chunk()?;
        let (payload, mut body) = body.split_first_chunk()?;
        let mut word = || {
            let (word, rest) = body.split_first_chunk()?;
            body = rest;
            Some(u32::from_le_bytes(*word))
        };
        let (length, sequence, generation, robot) = (word()?, word()?, word()?, word()?);
        let (sha256, _) = body.split_first_chunk()?;
        let known = u16::from_le_bytes(*version) == VERSION
            && usize::from(u16::from_le_bytes(*payload)) == RECORD;
        let header = Self { length, sequence, generation, robot, sha256: *sha256 };
        Some(if known { Ok(header) } else { Err(Unreadable) })
    }
}

/// A header of another version.
struct Unreadable;

/// CRC-32 of a header's bytes but the last four.
fn check_of(header: &[u8]) -> u32 {
    crc32(0, header.split_last_chunk::<4>().map_or(&[], |(body, _)| body))
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mark {
    Committed,
    Trial,
    Confirmed,
    Rejected,
}

impl Mark {
    const ALL: [Self; 4] = [Self::Committed, Self::Trial, Self::Confirmed, Self::Rejected];

    fn name(self) -> [u8; 4] {
        *match self {
            Self::Committed => b"CMIT",
            Self::Trial => b"TRIL",
            Self::Confirmed => b"CNFM",
            Self::Rejected => b"RJCT",
        }
    }

    /// Where its cells lie in a slot.
    fn cells(self) -> [u32; 2] {
        match self {
            Self::Committed => [64, 96],
            Self::Trial => [128, 160],
            Self::Confirmed => [192, 224],
            Self::Rejected => [256, 288],
        }
    }

    /// What a cell holds that is set, in a slot whose header has this CRC.
    fn cell(self, check: u32) -> [u8; CELL] {
        let [a, b, c, d] = self.name();
        let [e, f, g, h] = check.to_le_bytes();
        let mut cell = [ERASED; CELL];
        if let Some(word) = cell.first_chunk_mut::<WORD>() {
            *word = [a, b, c, d, e, f, g, h];
        }
        cell
    }
}

/// What a mark's two cells read as, together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Cells {
    /// Cells that hold exactly the word.
    set: u8,
    /// Cells all of whose bits are erased.
    erased: u8,
}

impl Cells {
    fn read(mut self, found: &[u8], set: &[u8; CELL]) -> Self {
        if found == set {
            self.set = self.set.saturating_add(1);
        } else if found.iter().all(|byte| *byte == ERASED) {
            self.erased = self.erased.saturating_add(1);
        }
        self
    }

    fn is_set(self) -> bool {
        self.set > 0
    }
}

/// What is written before the payload.
#[derive(Clone, Copy, Debug)]
struct Record {
    header: Header,
    /// CRC-32 of the header.
    check: u32,
    committed: Cells,
    trial: Cells,
    confirmed: Cells,
    rejected: Cells,
}

/// What a slot is good for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// An update that was never committed.
    NotCommitted,
    /// Committed and never run.
    Fresh,
    /// On trial at an earlier boot, or aborted.
    Rejected,
    Confirmed,
}

impl Record {
    #[inline(never)]
    fn state(&self) -> State {
        if self.rejected.erased < 2 {
            State::Rejected
        } else if !self.committed.is_set() {
            State::NotCommitted
        } else if self.confirmed.is_set() {
            State::Confirmed
        } else if self.trial.is_set() || self.trial.erased == 0 {
            State::Rejected
        } else {
            State::Fresh
        }
    }

    /// What orders confirmed slots.
    fn rank(&self) -> (u32, u32) {
        (self.header.sequence, self.header.generation)
    }
}

/// That of a slot that can be read.
fn state<E>(record: &Result<Record, E>) -> Option<State> {
    record.as_ref().ok().map(Record::state)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// Erased up to here, an offset in the flash.
    Erasing(u32),
    Writing,
    Verified,
    Committed,
}

/// An update under way.
#[derive(Clone, Copy, Debug)]
struct Update {
    side: Side,
    header: Header,
    written: u32,
    /// What has been accepted but does not fill a write unit yet: its first `written` modulo the unit
    /// bytes.
    tail: [u8; CELL],
    stage: Stage,
}

/// What runs.
#[derive(Clone, Copy, Debug)]
struct Running {
    side: Side,
    check: u32,
    header: Header,
}

/// The two slots, after [`boot`](Self::boot) has decided which one runs.
#[derive(Debug)]
pub struct Slots<F> {
    flash: F,
    geometry: Geometry,
    robot: u32,
    floor: u32,
    running: Option<Running>,
    trial: bool,
    update: Option<Update>,
}

impl<F: NorFlash> Slots<F> {
    /// Decides what runs, once at every power-on.
    ///
    /// A committed model that has not run yet comes first, on trial; then what is confirmed, the newest
    /// first; then the factory model. `robot` is the robot's name, `lowest` the lowest sequence number that
    /// the image accepts: 0 if it accepts all. `accept` is asked about a payload, whose hash is
    /// right, before it is chosen: map it, and accept it if [`parse_for`](crate::parse_for) does,
    /// self-test and all.
    ///
    /// A flash that fails does not stop it: see [`Boot::refused`].
    ///
    /// # Errors
    /// [`GeometryError`] for slots that there cannot be on this flash.
    #[inline(always)]
    pub fn boot(
        flash: F,
        geometry: Geometry,
        robot: &str,
        lowest: u32,
        mut accept: impl FnMut(Payload) -> bool,
    ) -> Result<(Self, Boot<F::Error>), GeometryError> {
        check_geometry::<F>(&flash, geometry)?;
        let robot = self::robot(robot);
        let (running, trial, update) = (None, false, None);
        let mut slots = Self { flash, geometry, robot, floor: lowest, running, trial, update };
        let mut records = Side::BOTH.map(|side| (side, slots.settled(side)));
        for (_, record) in &records {
            // What another robot's firmware left behind says nothing about this one.
            if let Ok(Record { header, .. }) = record
                && state(record) == Some(State::Confirmed)
                && header.robot == robot
            {
                slots.floor = slots.floor.max(header.sequence);
            }
        }
        // Fresh ones before confirmed ones, the newest first.
        let [a, b] = &records;
        let key = |record: &Result<Record, _>| {
            let generation = record.as_ref().map_or(0, |record| record.header.generation);
            (state(record) == Some(State::Fresh), generation)
        };
        if key(&b.1) > key(&a.1) {
            records.reverse();
        }

        let (running, floor, refused) = (Which::Factory, slots.floor, [None, None]);
        let mut boot = Boot { running, payload: None, trial, floor, refused };
        for (side, record) in records {
            let refusal = match record {
                Ok(_) if boot.payload.is_some() => continue,
                Ok(record) => match slots.try_run(side, &record, &mut accept) {
                    Ok(payload) => {
                        boot.running = payload.slot;
                        boot.payload = Some(payload);
                        boot.trial = slots.trial;
                        continue;
                    }
                    Err(refusal) => refusal,
                },
                Err(refusal) => refusal,
            };
            let [a, b] = &mut boot.refused;
            *match side {
                Side::A => a,
                Side::B => b,
            } = Some(refusal);
        }
        Ok((slots, boot))
    }

    /// Reads what is before the payload, and decides for good what a cut may have left undecided.
    #[inline(never)]
    fn settled(&mut self, side: Side) -> Result<Record, Refusal<F::Error>> {
        let record = self.record(side)?;
        let state = record.state();
        let is_live = matches!(state, State::Fresh | State::Confirmed);
        // A failure here leaves what was found, which the next boot finds again.
        let marks = [
            (Mark::Committed, record.committed, is_live),
            (Mark::Confirmed, record.confirmed, state == State::Confirmed),
            (Mark::Rejected, record.rejected, !is_live),
        ];
        for (mark, cells, wanted) in marks {
            if wanted && cells.erased > 0 {
                let _ = self.set(side, mark, record.check);
            }
        }
        Ok(record)
    }

    /// Checks a slot, marks its trial, and asks the caller.
    #[inline(never)]
    fn try_run(
        &mut self,
        side: Side,
        record: &Record,
        accept: &mut impl FnMut(Payload) -> bool,
    ) -> Result<Payload, Refusal<F::Error>> {
        let Header { length, sequence, robot, sha256, .. } = record.header;
        let trial = match record.state() {
            State::NotCommitted => return Err(Refusal::NotCommitted),
            State::Rejected => return Err(Refusal::Rejected),
            State::Fresh => true,
            State::Confirmed => false,
        };
        if robot != self.robot {
            return Err(Refusal::AnotherRobot { found: robot });
        }
        if sequence < self.floor {
            return Err(Refusal::BelowFloor { floor: self.floor, found: sequence });
        }
        if self.hash(side, length).map_err(Refusal::Flash)? != sha256 {
            return Err(Refusal::Payload);
        }
        if trial {
            // A trial that cannot be told from none would be repeated for ever.
            self.set(side, Mark::Trial, record.check).map_err(|error| match error {
                MarkError::Flash(error) => Refusal::Flash(error),
                _ => Refusal::Rejected,
            })?;
        }
        let payload = self.payload(side, &record.header);
        if !accept(payload) {
            return Err(Refusal::NotAccepted);
        }
        self.running = Some(Running { side, check: record.check, header: record.header });
        self.trial = trial;
        Ok(payload)
    }

    /// What runs.
    pub fn running(&self) -> Which {
        self.running.map_or(Which::Factory, |running| running.side.into())
    }

    /// The update that brought what runs; `None` of the factory model.
    pub fn release(&self) -> Option<Release> {
        self.running.map(|running| running.header.release())
    }

    /// The update that is under way.
    #[inline(never)]
    pub fn update(&self) -> Option<Release> {
        self.update.as_ref().map(|update| update.header.release())
    }

    /// Whether what runs is still to be [confirmed](Self::confirm).
    pub fn on_trial(&self) -> bool {
        self.trial
    }

    /// The lowest sequence number that is accepted.
    pub fn floor(&self) -> u32 {
        self.floor
    }

    /// Bytes there is room for in a slot.
    pub fn room(&self) -> u32 {
        self.geometry.room()
    }

    /// Bytes of the payload that have been accepted, or `None` if no update is under way, or not that far:
    /// where to go on after the line was lost.
    pub fn written(&self) -> Option<u32> {
        let update = self.update.as_ref();
        update.filter(|u| !matches!(u.stage, Stage::Erasing(_))).map(|update| update.written)
    }

    /// Whether the update under way has been [committed](Self::commit).
    pub fn is_committed(&self) -> bool {
        self.update.is_some_and(|update| update.stage == Stage::Committed)
    }

    /// Gives the flash back.
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// Whether an update may begin.
    ///
    /// # Errors
    /// [`BeginError`].
    pub fn check(&self, release: &Release) -> Result<(), BeginError> {
        let Release { length, sequence, robot, .. } = *release;
        if self.trial {
            return Err(BeginError::OnTrial);
        }
        if length == 0 || length > self.room() {
            return Err(BeginError::Length { room: self.room(), found: length });
        }
        if robot != self.robot {
            return Err(BeginError::AnotherRobot { found: robot });
        }
        if sequence < self.floor {
            return Err(BeginError::BelowFloor { floor: self.floor, found: sequence });
        }
        Ok(())
    }

    /// Begins an update, for which the slot that does not run has to be [erased](Self::erase). An update
    /// that was under way is dropped; a committed one that has not run yet, with the first sector.
    ///
    /// # Errors
    /// [`BeginError`]; everything is as it was.
    pub fn begin(&mut self, release: &Release) -> Result<(), BeginError> {
        self.check(release)?;
        let Release { length, sha256, sequence, robot } = *release;
        // That of what runs, even if it cannot be read just now.
        let mut newest = self.running.map_or(0, |running| running.header.generation);
        let mut ranks = [None; 2];
        for (rank, side) in ranks.iter_mut().zip(Side::BOTH) {
            // A slot that cannot be read is empty.
            let Ok(record) = self.record(side) else { continue };
            newest = newest.max(record.header.generation);
            *rank = (record.state() == State::Confirmed).then(|| record.rank());
        }
        let generation = newest.saturating_add(1);
        let [a, b] = ranks;
        let side = match self.running {
            Some(running) => running.side.other(),
            None if a <= b => Side::A,
            None => Side::B,
        };
        self.update = Some(Update {
            side,
            header: Header { length, sequence, generation, robot, sha256 },
            written: 0,
            tail: [ERASED; CELL],
            // One by one, the header's first: no part of an old payload is gone while its header stands.
            stage: Stage::Erasing(self.at(side, 0)),
        });
        Ok(())
    }

    /// Erases the next sector for the update that has begun; the number that are still to be erased, 0 when
    /// the payload can be written.
    ///
    /// # Errors
    /// Those of the flash; the update has to begin again.
    pub fn erase(&mut self) -> Result<u32, F::Error> {
        let Some(Update { side, stage: Stage::Erasing(from), .. }) = self.update else {
            return Ok(0);
        };
        let update = self.update.take();
        let sector = Self::sector();
        let (to, end) = (from.saturating_add(sector), self.at(side, self.geometry.slot_bytes));
        self.flash.erase(from, to)?;
        let stage = if to < end { Stage::Erasing(to) } else { Stage::Writing };
        self.update = update.map(|update| Update { stage, ..update });
        Ok(end.saturating_sub(to).div_ceil(sector))
    }

    /// Sectors of a slot.
    pub fn sectors(&self) -> u32 {
        self.geometry.slot_bytes.checked_div(Self::sector()).unwrap_or(0)
    }

    /// Writes the next part of the payload, of any length. What does not fill a write unit waits for
    /// the part after it.
    ///
    /// # Errors
    /// [`WriteError`]; after a failure of the flash the update has to begin again.
    pub fn write(&mut self, offset: u32, part: &[u8]) -> Result<(), WriteError<F::Error>> {
        let update = self.update.filter(|update| update.stage == Stage::Writing);
        let mut update = update.ok_or(WriteError::NotWriting)?;
        if offset != update.written {
            return Err(WriteError::OutOfOrder { expected: update.written, found: offset });
        }
        let room = update.header.length.saturating_sub(update.written);
        let too_long = WriteError::TooLong { room, found: part.len() };
        let length = u32::try_from(part.len()).map_err(|_| too_long)?;
        if length > room {
            return Err(WriteError::TooLong { room, found: part.len() });
        }

        let unit = F::WRITE_SIZE;
        let waiting = unaligned(update.written, unit);
        let mut at = self.at(update.side, PAYLOAD_OFFSET).saturating_add(update.written);
        at = at.saturating_sub(u32::try_from(waiting).unwrap_or(0));
        // What is only in memory: nothing is lost if the flash fails, because the update is, then.
        self.update = None;
        let mut rest = part;
        if waiting > 0 {
            let (head, more) = rest.split_at(unit.saturating_sub(waiting).min(rest.len()));
            let filled = waiting.saturating_add(head.len());
            if let Some(place) = update.tail.get_mut(waiting..filled) {
                place.copy_from_slice(head);
            }
            rest = more;
            if filled == unit {
                let tail = update.tail.get(..unit).unwrap_or(&[]);
                self.flash.write(at, tail).map_err(WriteError::Flash)?;
                at = at.saturating_add(u32::try_from(unit).unwrap_or(0));
                update.tail = [ERASED; CELL];
            }
        }
        if !rest.is_empty() {
            let left = rest.len().checked_rem(unit).unwrap_or(0);
            let (whole, left) = rest.split_at(rest.len().saturating_sub(left));
            if !whole.is_empty() {
                self.flash.write(at, whole).map_err(WriteError::Flash)?;
            }
            if let Some(place) = update.tail.get_mut(..left.len()) {
                place.copy_from_slice(left);
            }
        }
        update.written = update.written.saturating_add(length);
        self.update = Some(update);
        Ok(())
    }

    /// Reads the whole payload back and compares its hash with the release.
    ///
    /// # Errors
    /// [`VerifyError`]; unless parts are missing the update has to begin again.
    pub fn verify(&mut self) -> Result<Payload, VerifyError<F::Error>> {
        let mut update = self.update.ok_or(VerifyError::NotWriting)?;
        let Update { side, written, header, .. } = update;
        let payload = self.payload(side, &header);
        match update.stage {
            Stage::Writing => {}
            Stage::Verified => return Ok(payload),
            Stage::Erasing(_) | Stage::Committed => return Err(VerifyError::NotWriting),
        }
        if written != header.length {
            return Err(VerifyError::Incomplete { written, length: header.length });
        }
        self.update = None;
        let waiting = unaligned(written, F::WRITE_SIZE);
        if waiting > 0 {
            let at = self.at(side, PAYLOAD_OFFSET).saturating_add(written);
            let at = at.saturating_sub(u32::try_from(waiting).unwrap_or(0));
            let tail = update.tail.get(..F::WRITE_SIZE).unwrap_or(&[]);
            self.flash.write(at, tail).map_err(VerifyError::Flash)?;
        }
        if self.hash(side, header.length).map_err(VerifyError::Flash)? != header.sha256 {
            return Err(VerifyError::Hash);
        }
        update.stage = Stage::Verified;
        self.update = Some(update);
        Ok(payload)
    }

    /// Writes header and commit mark: the next boot tries the model.
    ///
    /// # Errors
    /// [`MarkError`]; the update has to begin again, unless it was [not ready](MarkError::NotReady).
    pub fn commit(&mut self) -> Result<(), MarkError<F::Error>> {
        let update = self.update.filter(|update| update.stage == Stage::Verified);
        let mut update = update.ok_or(MarkError::NotReady)?;
        let bytes = update.header.encode();
        let at = self.at(update.side, 0);
        self.update = None;
        self.flash.write(at, &bytes).map_err(MarkError::Flash)?;
        let mut found = [0; HEADER];
        self.flash.read(at, &mut found).map_err(MarkError::Flash)?;
        if found != bytes {
            return Err(MarkError::ReadBack);
        }
        self.set(update.side, Mark::Committed, check_of(&bytes))?;
        update.stage = Stage::Committed;
        self.update = Some(update);
        Ok(())
    }

    /// Drops the update that is under way, or that is committed since power-on: the next boot does not
    /// try it.
    ///
    /// # Errors
    /// [`MarkError`]: a committed update could not be marked as rejected; `begin` another one over it.
    pub fn abort(&mut self) -> Result<(), MarkError<F::Error>> {
        match self.update.take() {
            Some(Update { side, header, stage: Stage::Committed, .. }) => {
                self.set(side, Mark::Rejected, check_of(&header.encode()))
            }
            _ => Ok(()),
        }
    }

    /// Confirms the model on trial: it boots from now on, and the floor is its sequence number.
    ///
    /// # Errors
    /// [`MarkError::NotReady`] if nothing is on trial; otherwise the model stays on trial.
    pub fn confirm(&mut self) -> Result<(), MarkError<F::Error>> {
        let running = self.running.filter(|_| self.trial).ok_or(MarkError::NotReady)?;
        self.set(running.side, Mark::Confirmed, running.check)?;
        self.trial = false;
        self.floor = self.floor.max(running.header.sequence);
        Ok(())
    }

    /// Where the payload of a slot with this header lies.
    fn payload(&self, side: Side, header: &Header) -> Payload {
        let Header { length, sequence, .. } = *header;
        Payload { slot: side.into(), offset: self.at(side, PAYLOAD_OFFSET), length, sequence }
    }

    /// Bytes of a sector.
    fn sector() -> u32 {
        u32::try_from(F::ERASE_SIZE).unwrap_or(u32::MAX)
    }

    /// Where a byte of a slot lies in the flash.
    fn at(&self, side: Side, offset: u32) -> u32 {
        let Geometry { offset: first, slot_bytes } = self.geometry;
        let slot = match side {
            Side::A => first,
            Side::B => first.saturating_add(slot_bytes),
        };
        slot.saturating_add(offset)
    }

    #[inline(never)]
    fn record(&mut self, side: Side) -> Result<Record, Refusal<F::Error>> {
        let mut bytes = [0; HEADER];
        self.flash.read(self.at(side, 0), &mut bytes).map_err(Refusal::Flash)?;
        let check = check_of(&bytes);
        let header = Header::decode(&bytes).ok_or(Refusal::Empty)?;
        let header = header.map_err(|Unreadable| Refusal::Layout)?;
        if header.length == 0 || header.length > self.room() {
            return Err(Refusal::Layout);
        }
        // One by one: with error correction a torn cell may be an error, and the others say enough.
        let mut marks = Mark::ALL.map(|mark| (mark, Cells::default()));
        for (mark, read) in &mut marks {
            let set = mark.cell(check);
            for cell in mark.cells() {
                let mut found = [0; CELL];
                match self.flash.read(self.at(side, cell), &mut found) {
                    // A slot that may have been rejected does not run.
                    Err(error) if *mark == Mark::Rejected => return Err(Refusal::Flash(error)),
                    Err(_) => {}
                    Ok(()) => *read = read.read(&found, &set),
                }
            }
        }
        let [(_, committed), (_, trial), (_, confirmed), (_, rejected)] = marks;
        Ok(Record { header, check, committed, trial, confirmed, rejected })
    }

    /// Programs the cells of a mark that are still erased.
    fn set(&mut self, side: Side, mark: Mark, check: u32) -> Result<(), MarkError<F::Error>> {
        let set = mark.cell(check);
        let word = set.get(..WORD.max(F::WRITE_SIZE)).unwrap_or(&set);
        let mut result = Err(MarkError::ReadBack);
        for cell in mark.cells() {
            let at = self.at(side, cell);
            match self.set_cell(at, word, &set) {
                Ok(true) => result = Ok(()),
                Ok(false) => {}
                Err(error) => result = result.or(Err(MarkError::Flash(error))),
            }
        }
        result
    }

    /// Whether the cell holds the word in the end.
    fn set_cell(&mut self, at: u32, word: &[u8], set: &[u8; CELL]) -> Result<bool, F::Error> {
        let mut found = [0; CELL];
        self.flash.read(at, &mut found)?;
        if found.iter().all(|byte| *byte == ERASED) {
            self.flash.write(at, word)?;
            self.flash.read(at, &mut found)?;
        }
        Ok(found == *set)
    }

    /// SHA-256 of a payload.
    fn hash(&mut self, side: Side, length: u32) -> Result<[u8; 32], F::Error> {
        let mut digest = Sha256::new();
        let mut at = self.at(side, PAYLOAD_OFFSET);
        let mut left = usize::try_from(length).unwrap_or(usize::MAX);
        let mut buffer = [0; BUFFER];
        while left > 0 {
            let length = left.min(BUFFER);
            // In whole read units; they end within the slot, which ends with a sector.
            let whole = length.checked_next_multiple_of(CELL).unwrap_or(BUFFER).min(BUFFER);
            let part = buffer.get_mut(..whole).unwrap_or(&mut []);
            self.flash.read(at, part)?;
            feed(&mut digest, part.get(..length).unwrap_or(&[]));
            left = left.saturating_sub(length);
            at = at.saturating_add(u32::try_from(whole).unwrap_or(u32::MAX));
        }
        Ok(finish(digest))
    }
}

/// Bytes beyond the last whole unit.
fn unaligned(length: u32, unit: usize) -> usize {
    usize::try_from(length).unwrap_or(0).checked_rem(unit).unwrap_or(0)
}

fn check_geometry<F: NorFlash>(flash: &F, geometry: Geometry) -> Result<(), GeometryError> {
    for unit in [F::WRITE_SIZE, <F as ReadNorFlash>::READ_SIZE] {
        if unit == 0 || !MAX_WRITE_SIZE.is_multiple_of(unit) {
            return Err(GeometryError::Unit { found: unit });
        }
    }
    let sector = F::ERASE_SIZE;
    if sector == 0 || !sector.is_multiple_of(MAX_WRITE_SIZE) {
        return Err(GeometryError::Unit { found: sector });
    }
    let Geometry { offset, slot_bytes } = geometry;
    let capacity = flash.capacity();
    let beyond = GeometryError::Capacity { capacity };
    let to_usize = |number: u32| usize::try_from(number).map_err(|_| beyond);
    if !to_usize(offset)?.is_multiple_of(sector)
        || !to_usize(slot_bytes)?.is_multiple_of(sector)
        || slot_bytes <= PAYLOAD_OFFSET
    {
        return Err(GeometryError::Sectors { sector });
    }
    let end = slot_bytes.checked_mul(2).and_then(|both| both.checked_add(offset)).ok_or(beyond)?;
    if to_usize(end)? > capacity { Err(beyond) } else { Ok(()) }
}
