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
use crate::encoding::{Reader, Writer};

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
/// Four bytes that are erased.
const BLANK: u32 = u32::MAX;
/// Header and marks.
const RECORD: usize = PAYLOAD_OFFSET as usize;
const ERASED: u8 = 0xFF;
/// Bytes read at a time.
const BUFFER: usize = 64;

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
    finish(&mut digest)
}

// Once each: where they are called they would be part of the code.

#[inline(never)]
fn feed(digest: &mut Sha256, part: &[u8]) {
    digest.update(part);
}

#[inline(never)]
fn finish(digest: &mut Sha256) -> [u8; 32] {
    // By value it would be copied.
    digest.finalize_reset().into()
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
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
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
    pub(crate) fn read(reader: &mut Reader<'_>) -> Self {
        let (length, mut sha256) = (reader.word(), [0; 32]);
        reader.copy(&mut sha256);
        Self { length, sha256, sequence: reader.word(), robot: reader.word() }
    }

    pub(crate) fn write<'w, 'b>(&self, to: &'w mut Writer<'b>) -> &'w mut Writer<'b> {
        to.word(self.length).array(&self.sha256).word(self.sequence).word(self.robot)
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

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Header {
    release: Release,
    generation: u32,
}

/// A header as it lies in the flash; the last word is the CRC-32 of the others.
type Words = [u32; HEADER / 4];

/// Magic, and version and where the payload begins.
const BEGINNING: [u32; 2] = [u32::from_le_bytes(MAGIC), VERSION as u32 | (RECORD as u32) << 16];

impl Header {
    fn encode(&self) -> Words {
        let Release { length, sequence, robot, sha256 } = self.release;
        let ([magic, layout], generation) = (BEGINNING, self.generation);
        let [a, b, c, d, e, f, g, h]: [u32; 8] = bytemuck::cast(sha256);
        let mut words =
            [magic, layout, length, sequence, generation, robot, a, b, c, d, e, f, g, h, 0, 0];
        let found = check_of(&words);
        let [.., check] = &mut words;
        *check = found;
        words
    }

    /// The header, as far as there is one.
    fn decode<E>(words: &Words) -> Result<Self, Refusal<E>> {
        let [magic, layout, length, sequence, generation, robot, sha256 @ .., _, check] = words;
        if *magic != u32::from_le_bytes(MAGIC) || *check != check_of(words) {
            return Err(Refusal::Empty);
        }
        if [*magic, *layout] != BEGINNING {
            return Err(Refusal::Layout);
        }
        let (length, sequence, robot) = (*length, *sequence, *robot);
        let sha256 = bytemuck::cast::<[u32; 8], _>(*sha256);
        let release = Release { length, sha256, sequence, robot };
        Ok(Self { release, generation: *generation })
    }
}

/// CRC-32 of a header's words but the last.
fn check_of(words: &Words) -> u32 {
    let [body @ .., _] = words;
    crc32(0, bytemuck::bytes_of(body))
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

    fn name(self) -> u32 {
        u32::from_le_bytes(*match self {
            Self::Committed => b"CMIT",
            Self::Trial => b"TRIL",
            Self::Confirmed => b"CNFM",
            Self::Rejected => b"RJCT",
        })
    }

    /// Where its cells lie in a slot: two for each mark, behind the header.
    fn cells(self) -> [u32; 2] {
        let first = (HEADER as u32).wrapping_add(2 * CELL as u32 * self as u32);
        [first, first.wrapping_add(CELL as u32)]
    }

    /// What a cell holds that is set, in a slot whose header has this CRC.
    fn cell(self, check: u32) -> Cell {
        [self.name(), check, BLANK, BLANK, BLANK, BLANK, BLANK, BLANK]
    }
}

/// Bytes of a cell.
type Cell = [u32; CELL / 4];

/// What a cell reads as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Found {
    /// Exactly the word.
    Set,
    /// All bits are erased.
    Erased,
    /// Anything else.
    Torn,
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
    fn count(&mut self, found: Found) {
        match found {
            Found::Set => self.set = self.set.wrapping_add(1),
            Found::Erased => self.erased = self.erased.wrapping_add(1),
            Found::Torn => {}
        }
    }

    fn is_set(self) -> bool {
        self.set > 0
    }
}

/// What is written before the payload.
#[derive(Clone, Copy, Debug, Default)]
struct Record {
    header: Header,
    /// CRC-32 of the header.
    check: u32,
    /// Those of all marks, in order.
    marks: [Cells; 4],
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
        let [committed, trial, confirmed, rejected] = &self.marks;
        if rejected.erased < 2 {
            State::Rejected
        } else if !committed.is_set() {
            State::NotCommitted
        } else if confirmed.is_set() {
            State::Confirmed
        } else if trial.is_set() || trial.erased == 0 {
            State::Rejected
        } else {
            State::Fresh
        }
    }

    /// What orders confirmed slots; 0 of any other.
    fn rank(&self) -> u64 {
        let Header { release, generation } = &self.header;
        match self.state() {
            State::Confirmed => {
                (u64::from(release.sequence) << 32 | u64::from(*generation)).saturating_add(1)
            }
            _ => 0,
        }
    }
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
        let [mut a, mut b] = [Record::default(); 2];
        let refused = [slots.settle(Side::A, &mut a), slots.settle(Side::B, &mut b)];
        for record in [&a, &b] {
            let Release { robot: of, sequence, .. } = record.header.release;
            // What another robot's firmware left behind says nothing about this one.
            if record.state() == State::Confirmed && of == robot {
                slots.floor = slots.floor.max(sequence);
            }
        }
        // Fresh ones before confirmed ones, the newest first.
        let key = |record: &Record| (record.state() == State::Fresh, record.header.generation);
        let mut candidates = [(Side::A, &a), (Side::B, &b)];
        if key(&b) > key(&a) {
            candidates.reverse();
        }

        let (running, floor) = (Which::Factory, slots.floor);
        let mut boot = Boot { running, payload: None, trial, floor, refused };
        for (side, record) in candidates {
            let [of_a, of_b] = &mut boot.refused;
            let refused = match side {
                Side::A => of_a,
                Side::B => of_b,
            };
            if boot.payload.is_some() || refused.is_some() {
                continue;
            }
            match slots.try_run(side, record, &mut accept) {
                Ok(payload) => {
                    boot.running = payload.slot;
                    boot.payload = Some(payload);
                    boot.trial = slots.trial;
                }
                Err(refusal) => *refused = Some(refusal),
            }
        }
        Ok((slots, boot))
    }

    /// Reads what is before the payload, and decides for good what a cut may have left undecided.
    #[inline(never)]
    fn settle(&mut self, side: Side, record: &mut Record) -> Option<Refusal<F::Error>> {
        if let Err(refusal) = self.read(side, record) {
            return Some(refusal);
        }
        let state = record.state();
        let is_live = matches!(state, State::Fresh | State::Confirmed);
        let wanted = [is_live, false, state == State::Confirmed, !is_live];
        for ((mark, cells), wanted) in Mark::ALL.into_iter().zip(&record.marks).zip(wanted) {
            if wanted && cells.erased > 0 {
                // A failure here leaves what was found, which the next boot finds again.
                let _ = self.set(side, mark, record.check);
            }
        }
        None
    }

    /// Checks a slot, marks its trial, and asks the caller.
    #[inline(never)]
    fn try_run(
        &mut self,
        side: Side,
        record: &Record,
        accept: &mut impl FnMut(Payload) -> bool,
    ) -> Result<Payload, Refusal<F::Error>> {
        let release = &record.header.release;
        let Release { sequence, robot, .. } = *release;
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
        let payload = self.payload(side, release);
        if !holds(&mut self.flash, payload.offset, release).map_err(Refusal::Flash)? {
            return Err(Refusal::Payload);
        }
        if trial {
            // A trial that cannot be told from none would be repeated for ever.
            self.set(side, Mark::Trial, record.check).map_err(|error| match error {
                MarkError::Flash(error) => Refusal::Flash(error),
                _ => Refusal::Rejected,
            })?;
        }
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
        self.running.map(|running| running.header.release)
    }

    /// The update that is under way.
    pub fn update(&self) -> Option<Release> {
        self.update.as_ref().map(|update| update.header.release)
    }

    /// Whether the update that is under way is one of this release.
    #[inline(never)]
    pub(crate) fn is_of(&self, release: &Release) -> bool {
        self.update.as_ref().is_some_and(|update| update.header.release == *release)
    }

    /// What headers say of the robot.
    pub(crate) fn robot(&self) -> u32 {
        self.robot
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
        self.update.as_ref().is_some_and(|update| update.stage == Stage::Committed)
    }

    /// Gives the flash back.
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// Whether an update may begin.
    ///
    /// # Errors
    /// [`BeginError`].
    #[inline(never)]
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
    #[inline(never)]
    pub fn begin(&mut self, release: &Release) -> Result<(), BeginError> {
        self.check(release)?;
        // That of what runs, even if it cannot be read just now.
        let mut newest = self.running.as_ref().map_or(0, |running| running.header.generation);
        let ranks = Side::BOTH.map(|side| {
            let mut record = Record::default();
            // A slot that cannot be read is empty.
            let _ = self.read(side, &mut record);
            newest = newest.max(record.header.generation);
            record.rank()
        });
        let [a, b] = ranks;
        let side = match &self.running {
            Some(running) => running.side.other(),
            None if a <= b => Side::A,
            None => Side::B,
        };
        self.update = Some(Update {
            side,
            header: Header { release: *release, generation: newest.saturating_add(1) },
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
        let Some(Update { side, stage: Stage::Erasing(from), .. }) = &self.update else {
            return Ok(0);
        };
        let (from, end) = (*from, self.at(*side, self.geometry.slot_bytes));
        let to = from.wrapping_add(Self::sector());
        let erased = self.flash.erase(from, to);
        self.go_on(erased, if to < end { Stage::Erasing(to) } else { Stage::Writing })?;
        Ok(end.saturating_sub(to).div_ceil(Self::sector()))
    }

    /// The next stage of the update, or its end if what it takes has failed.
    fn go_on<T, E>(&mut self, result: Result<T, E>, next: Stage) -> Result<T, E> {
        match &mut self.update {
            Some(update) if result.is_ok() => update.stage = next,
            update => *update = None,
        }
        result
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
    #[inline(never)]
    pub fn write(&mut self, offset: u32, part: &[u8]) -> Result<(), WriteError<F::Error>> {
        let update = self.update.as_ref().filter(|update| update.stage == Stage::Writing);
        let update = update.ok_or(WriteError::NotWriting)?;
        if offset != update.written {
            return Err(WriteError::OutOfOrder { expected: update.written, found: offset });
        }
        let room = update.header.release.length.saturating_sub(update.written);
        if u32::try_from(part.len()).is_ok_and(|length| length <= room) {
            let appended = self.append(part);
            return self.go_on(appended, Stage::Writing).map_err(WriteError::Flash);
        }
        Err(WriteError::TooLong { room, found: part.len() })
    }

    /// Writes a part that has room as far as it fills write units.
    fn append(&mut self, part: &[u8]) -> Result<(), F::Error> {
        let unit = F::WRITE_SIZE;
        let mut at = self.waiting_at();
        let Some(Update { written, tail, .. }) = &mut self.update else { return Ok(()) };
        let waiting = unaligned(*written, unit);
        *written = written.wrapping_add(part.len() as u32);
        let mut rest = part;
        if waiting > 0 {
            let (head, more) = rest.split_at(unit.wrapping_sub(waiting).min(rest.len()));
            let filled = waiting.wrapping_add(head.len());
            if let Some(place) = tail.get_mut(waiting..filled) {
                place.copy_from_slice(head);
            }
            if filled < unit {
                return Ok(());
            }
            rest = more;
            self.flash.write(at, tail.get(..unit).unwrap_or(&[]))?;
            at = at.wrapping_add(unit as u32);
            *tail = [ERASED; CELL];
        }
        let left = rest.len().checked_rem(unit).unwrap_or(0);
        let (whole, left) = rest.split_at(rest.len().saturating_sub(left));
        if !whole.is_empty() {
            self.flash.write(at, whole)?;
        }
        if let Some(place) = tail.get_mut(..left.len()) {
            place.copy_from_slice(left);
        }
        Ok(())
    }

    /// Where in the flash that belongs of the update what does not fill a write unit yet.
    fn waiting_at(&self) -> u32 {
        self.update.as_ref().map_or(0, |update| {
            let waiting = unaligned(update.written, F::WRITE_SIZE) as u32;
            self.at(update.side, PAYLOAD_OFFSET).wrapping_add(update.written).wrapping_sub(waiting)
        })
    }

    /// Reads the whole payload back and compares its hash with the release.
    ///
    /// # Errors
    /// [`VerifyError`]; unless parts are missing the update has to begin again.
    #[inline(never)]
    pub fn verify(&mut self) -> Result<Payload, VerifyError<F::Error>> {
        let update = self.update.as_ref().ok_or(VerifyError::NotWriting)?;
        let (written, length) = (update.written, update.header.release.length);
        let payload = self.payload(update.side, &update.header.release);
        match update.stage {
            Stage::Writing => {}
            Stage::Verified => return Ok(payload),
            Stage::Erasing(_) | Stage::Committed => return Err(VerifyError::NotWriting),
        }
        if written != length {
            return Err(VerifyError::Incomplete { written, length });
        }
        let right = match self.read_back(payload) {
            Ok(true) => Ok(payload),
            Ok(false) => Err(VerifyError::Hash),
            Err(error) => Err(VerifyError::Flash(error)),
        };
        self.go_on(right, Stage::Verified)
    }

    /// Writes what is left of the payload: whether it is what it was to be.
    fn read_back(&mut self, payload: Payload) -> Result<bool, F::Error> {
        let at = self.waiting_at();
        let Some(Update { written, tail, header, .. }) = &self.update else { return Ok(false) };
        if unaligned(*written, F::WRITE_SIZE) > 0 {
            self.flash.write(at, tail.get(..F::WRITE_SIZE).unwrap_or(&[]))?;
        }
        holds(&mut self.flash, payload.offset, &header.release)
    }

    /// Writes header and commit mark: the next boot tries the model.
    ///
    /// # Errors
    /// [`MarkError`]; the update has to begin again, unless it was [not ready](MarkError::NotReady).
    #[inline(never)]
    pub fn commit(&mut self) -> Result<(), MarkError<F::Error>> {
        let update = self.update.as_ref().filter(|update| update.stage == Stage::Verified);
        let Update { side, header, .. } = update.ok_or(MarkError::NotReady)?;
        let (side, words) = (*side, header.encode());
        let committed = self.write_header(side, &words);
        self.go_on(committed, Stage::Committed)
    }

    fn write_header(&mut self, side: Side, words: &Words) -> Result<(), MarkError<F::Error>> {
        let at = self.at(side, 0);
        self.flash.write(at, bytemuck::bytes_of(words)).map_err(MarkError::Flash)?;
        let mut found = [0; HEADER / 4];
        self.flash.read(at, bytemuck::bytes_of_mut(&mut found)).map_err(MarkError::Flash)?;
        if found != *words {
            return Err(MarkError::ReadBack);
        }
        let [.., check] = *words;
        self.set(side, Mark::Committed, check)
    }

    /// Drops the update that is under way, or that is committed since power-on: the next boot does not
    /// try it.
    ///
    /// # Errors
    /// [`MarkError`]: a committed update could not be marked as rejected; `begin` another one over it.
    pub fn abort(&mut self) -> Result<(), MarkError<F::Error>> {
        let update = self.update.as_ref().filter(|update| update.stage == Stage::Committed);
        let committed = update.map(|update| (update.side, update.header.encode()));
        self.update = None;
        match committed {
            Some((side, [.., check])) => self.set(side, Mark::Rejected, check),
            None => Ok(()),
        }
    }

    /// Confirms the model on trial: it boots from now on, and the floor is its sequence number.
    ///
    /// # Errors
    /// [`MarkError::NotReady`] if nothing is on trial; otherwise the model stays on trial.
    pub fn confirm(&mut self) -> Result<(), MarkError<F::Error>> {
        let running = self.running.as_ref().filter(|_| self.trial).ok_or(MarkError::NotReady)?;
        let sequence = running.header.release.sequence;
        self.set(running.side, Mark::Confirmed, running.check)?;
        self.trial = false;
        self.floor = self.floor.max(sequence);
        Ok(())
    }

    /// Where the payload of a release lies in a slot.
    fn payload(&self, side: Side, release: &Release) -> Payload {
        let Release { length, sequence, .. } = *release;
        Payload { slot: side.into(), offset: self.at(side, PAYLOAD_OFFSET), length, sequence }
    }

    /// Bytes of a sector.
    fn sector() -> u32 {
        u32::try_from(F::ERASE_SIZE).unwrap_or(u32::MAX)
    }

    /// Where a byte of a slot lies in the flash. Its address has been checked, so that nothing wraps.
    fn at(&self, side: Side, offset: u32) -> u32 {
        let Geometry { offset: first, slot_bytes } = self.geometry;
        first.wrapping_add(slot_bytes.wrapping_mul(side as u32)).wrapping_add(offset)
    }

    /// Reads what is before the payload; a record whose header cannot be read stays that of nothing.
    #[inline(never)]
    fn read(&mut self, side: Side, record: &mut Record) -> Result<(), Refusal<F::Error>> {
        let mut words = [0; HEADER / 4];
        let at = self.at(side, 0);
        self.flash.read(at, bytemuck::bytes_of_mut(&mut words)).map_err(Refusal::Flash)?;
        let header = Header::decode(&words)?;
        if header.release.length == 0 || header.release.length > self.room() {
            return Err(Refusal::Layout);
        }
        let [.., check] = words;
        // One by one: with error correction a torn cell may be an error, and the others say enough.
        for (mark, cells) in Mark::ALL.into_iter().zip(&mut record.marks) {
            for cell in mark.cells() {
                match self.look(self.at(side, cell), mark, check) {
                    // A slot that may have been rejected does not run.
                    Err(error) if mark == Mark::Rejected => return Err(Refusal::Flash(error)),
                    Err(_) => {}
                    Ok(found) => cells.count(found),
                }
            }
        }
        (record.header, record.check) = (header, check);
        Ok(())
    }

    /// What a cell of a mark reads as.
    #[inline(never)]
    fn look(&mut self, at: u32, mark: Mark, check: u32) -> Result<Found, F::Error> {
        let mut cell = [0; CELL / 4];
        self.flash.read(at, bytemuck::bytes_of_mut(&mut cell))?;
        let [name, of, rest @ ..] = cell;
        Ok(match rest.iter().all(|word| *word == BLANK) {
            true if [name, of] == [mark.name(), check] => Found::Set,
            true if [name, of] == [BLANK; 2] => Found::Erased,
            _ => Found::Torn,
        })
    }

    /// Programs the cells of a mark that are still erased.
    #[inline(never)]
    fn set(&mut self, side: Side, mark: Mark, check: u32) -> Result<(), MarkError<F::Error>> {
        let mut result = Err(MarkError::ReadBack);
        for cell in mark.cells() {
            match self.set_cell(self.at(side, cell), mark, check) {
                Ok(Found::Set) => result = Ok(()),
                Ok(_) => {}
                Err(error) => result = result.or(Err(MarkError::Flash(error))),
            }
        }
        result
    }

    /// What the cell reads as in the end.
    fn set_cell(&mut self, at: u32, mark: Mark, check: u32) -> Result<Found, F::Error> {
        let found = self.look(at, mark, check)?;
        if found != Found::Erased {
            return Ok(found);
        }
        let cell = mark.cell(check);
        let bytes = bytemuck::bytes_of(&cell);
        self.flash.write(at, bytes.get(..WORD.max(F::WRITE_SIZE)).unwrap_or(bytes))?;
        self.look(at, mark, check)
    }
}

/// Whether what lies in the flash has the hash of a release.
#[inline(never)]
fn holds<F: NorFlash>(flash: &mut F, at: u32, release: &Release) -> Result<bool, F::Error> {
    let mut digest = Sha256::new();
    let (mut at, mut left) = (at, release.length as usize);
    let mut buffer = [0; BUFFER];
    while left > 0 {
        let length = left.min(BUFFER);
        // In whole read units; they end within the slot, which ends with a sector.
        let whole = length.next_multiple_of(CELL).min(BUFFER);
        let part = buffer.get_mut(..whole).unwrap_or(&mut []);
        flash.read(at, part)?;
        feed(&mut digest, part.get(..length).unwrap_or(&[]));
        left = left.wrapping_sub(length);
        at = at.wrapping_add(whole as u32);
    }
    Ok(finish(&mut digest) == release.sha256)
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
