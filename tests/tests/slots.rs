//! Model slots under power cuts: at every flash operation of an update, and at every one of the recovery
//! after it, boot gives the old or the new model, whole, and the update can be done again.
//!
//! A step is a byte programmed or a sector erased. A cut tears the write unit or the sector under way.
//! What counts as kept is in [`Lab::live`]; that it notices what is not, in
//! [`a_slot_that_is_made_wrong_is_noticed`].

use std::cell::Cell;
use std::path::Path;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use firmware_core::blob::{Aligned, ParseError};
use firmware_core::slots::{
    BeginError, Boot, Geometry, GeometryError, MarkError, PAYLOAD_OFFSET, Payload, Refusal,
    Release, Slots, VerifyError, Which, WriteError, robot, sha256,
};
use firmware_sim::mcu::flash::{FlashError, Region};
use firmware_sim::mcu::{Board, Flash, VirtualClock};
use proptest::prelude::*;

/// Sequence numbers of the models: one that is retired, the running one, and the update.
const OLDER: u32 = 2;
const OLD: u32 = 3;
const NEW: u32 = 4;
/// Bytes of a part of the payload: no multiple of any write unit.
const PART: usize = 97;

/// Bytes at an address that the core accepts.
struct Room(Box<Aligned<[u8; 4096]>>);

impl Room {
    fn new() -> Self {
        Self(Box::new(Aligned([0; 4096])))
    }

    fn parse(&mut self, robot: &str, bytes: &[u8]) -> Result<(), ParseError> {
        let room = &mut self.0.0[..bytes.len()];
        room.copy_from_slice(bytes);
        firmware_core::parse_for(robot, room).map(|_| ())
    }
}

/// Three models of one robot.
#[derive(Clone)]
struct Models {
    robot: String,
    older: Vec<u8>,
    old: Vec<u8>,
    new: Vec<u8>,
}

impl Models {
    /// The blob of the folder, as the update, and two that differ from it in the self-test's last
    /// tolerance.
    fn read(folder: &str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").join(folder);
        let new = std::fs::read(path.join("model.bin")).unwrap();
        let mut room = Box::new(Aligned([0; 4096]));
        room.0[..new.len()].copy_from_slice(&new);
        let model = firmware_core::parse(&room.0[..new.len()]).unwrap();
        let robot = model.structure().robot().to_owned();
        let variant = |bit| variant(&robot, &new, bit);
        Self { older: variant(1), old: variant(2), new: new.clone(), robot: robot.clone() }
    }

    /// Those with the smallest blob first.
    fn all() -> Vec<Self> {
        let folders = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").read_dir().unwrap();
        let folders = folders.map(|folder| folder.unwrap().path());
        let mut all: Vec<Self> = folders
            .filter(|folder| folder.join("model.bin").exists())
            .map(|folder| Self::read(folder.file_name().unwrap().to_str().unwrap()))
            .collect();
        all.sort_by_key(|models| models.new.len());
        assert!(all.len() >= 4, "those of the simulated robots at least");
        all
    }
}

fn variant(robot: &str, blob: &[u8], bit: u8) -> Vec<u8> {
    const SELF_TEST: [u8; 2] = [3, 0];
    let mut bytes = blob.to_vec();
    let entry = blob[16..].chunks(12).find(|entry| entry[..2] == SELF_TEST).unwrap();
    let [.., a, b, c, d, e, f, g, h] = *entry else { unreachable!() };
    let end = u32::from_le_bytes([a, b, c, d]) + u32::from_le_bytes([e, f, g, h]);
    bytes[end as usize - 4] ^= bit;
    let Err(ParseError::Checksum { found, .. }) = Room::new().parse(robot, &bytes) else {
        panic!("the checksum covers the self-test")
    };
    bytes[12..16].copy_from_slice(&found.to_le_bytes());
    Room::new().parse(robot, &bytes).unwrap();
    bytes
}

/// What is wrong on purpose, to see that the tests notice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mutation {
    /// Header and commit mark are written before the payload.
    HeaderFirst,
    /// The payload always reads as it should when a header says so: nobody checks it.
    BlindHash,
    /// Both.
    HeaderFirstBlindHash,
    /// The trial mark is not kept.
    NoTrialMark,
    /// The confirm mark is not kept.
    NoConfirmMark,
    /// The commit mark is not kept, but reads as set beside any header.
    NoCommitMark,
}

impl Mutation {
    fn header_first(self) -> bool {
        matches!(self, Self::HeaderFirst | Self::HeaderFirstBlindHash)
    }

    fn blind_hash(self) -> bool {
        matches!(self, Self::BlindHash | Self::HeaderFirstBlindHash)
    }
}

/// The flash as the slots see it until the next power-on.
struct Seen<'a, const WRITE: usize, const ERASE: usize> {
    region: Region<WRITE, ERASE>,
    mutation: Option<Mutation>,
    lab: &'a Lab<WRITE, ERASE>,
    /// What reads as written but is not.
    unkept: Vec<(u32, Vec<u8>)>,
    /// Generation of the update, which a mutation has to know early.
    generation: u32,
}

impl<const WRITE: usize, const ERASE: usize> Seen<'_, WRITE, ERASE> {
    /// Beginning of the slot, and the offset in it.
    fn split(&self, offset: u32) -> (u32, u32) {
        let Geometry { offset: first, slot_bytes } = self.lab.geometry;
        let within = (offset - first) % slot_bytes;
        (offset - within, within)
    }

    fn largest_generation(&mut self) -> Result<u32, FlashError> {
        let Geometry { offset, slot_bytes } = self.lab.geometry;
        let mut largest = 0;
        for slot in [offset, offset + slot_bytes] {
            let mut header = [0; 64];
            self.region.read(slot, &mut header)?;
            let [.., a, b, c, d] = header;
            if header.starts_with(b"SLOT")
                && u32::from_le_bytes([a, b, c, d]) == crc32(&header[..60])
            {
                largest = largest.max(u32::from_le_bytes(header[16..20].try_into().unwrap()));
            }
        }
        Ok(largest)
    }
}

impl<const WRITE: usize, const ERASE: usize> ErrorType for Seen<'_, WRITE, ERASE> {
    type Error = FlashError;
}

impl<const WRITE: usize, const ERASE: usize> ReadNorFlash for Seen<'_, WRITE, ERASE> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        self.region.read(offset, bytes)?;
        let Some(mutation) = self.mutation else { return Ok(()) };
        let (slot, within) = self.split(offset);
        for (at, kept) in &self.unkept {
            let end = offset + bytes.len() as u32;
            if (offset..end).contains(at) {
                bytes[(at - offset) as usize..][..kept.len()].copy_from_slice(kept);
            }
        }
        if mutation == Mutation::NoCommitMark && within == 64 {
            let mut header = [0; 64];
            self.region.read(slot, &mut header)?;
            bytes[..8].copy_from_slice(&mark(b"CMIT", &header));
        }
        if mutation.blind_hash() && within >= PAYLOAD_OFFSET {
            let mut hash = [0; 32];
            self.region.read(slot + 24, &mut hash)?;
            let models = &self.lab.models;
            let known = [&models.older, &models.old, &models.new];
            if let Some(model) = known.into_iter().find(|model| sha256(model) == hash) {
                let from = (within - PAYLOAD_OFFSET) as usize;
                for (byte, known) in bytes.iter_mut().zip(&model[from..]) {
                    *byte = *known;
                }
            }
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.region.capacity()
    }
}

impl<const WRITE: usize, const ERASE: usize> NorFlash for Seen<'_, WRITE, ERASE> {
    const WRITE_SIZE: usize = WRITE;
    const ERASE_SIZE: usize = ERASE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        if self.split(from).1 == 0 {
            self.generation = 1 + self.largest_generation()?;
        }
        self.region.erase(from, to)?;
        let is_last = self.split(to).1 == 0;
        if is_last && self.mutation.is_some_and(Mutation::header_first) {
            let slot = to - self.lab.geometry.slot_bytes;
            let header = header(&self.lab.models, self.generation);
            self.region.write(slot, &header)?;
            self.region.write(slot + 64, &mark(b"CMIT", &header))?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        let (_, within) = self.split(offset);
        let header_first = self.mutation.is_some_and(Mutation::header_first);
        match (within, self.mutation) {
            (0 | 64, _) if header_first => Ok(()),
            (64 | 96, Some(Mutation::NoCommitMark))
            | (128 | 160, Some(Mutation::NoTrialMark))
            | (192 | 224, Some(Mutation::NoConfirmMark)) => {
                self.unkept.push((offset, bytes.to_vec()));
                Ok(())
            }
            _ => self.region.write(offset, bytes),
        }
    }
}

/// The header of the update, byte by byte as the documentation has it.
fn header(models: &Models, generation: u32) -> Vec<u8> {
    let mut header = b"SLOT\x01\0\x40\x01".to_vec();
    header.extend((models.new.len() as u32).to_le_bytes());
    header.extend(NEW.to_le_bytes());
    header.extend(generation.to_le_bytes());
    header.extend(robot(&models.robot).to_le_bytes());
    header.extend(sha256(&models.new));
    header.extend([0; 4]);
    header.extend(crc32(&header).to_le_bytes());
    header
}

fn mark(name: &[u8; 4], header: &[u8]) -> Vec<u8> {
    [name, &header[60..]].concat()
}

/// CRC-32/ISO-HDLC, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

/// What is in the slots before the update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Start {
    /// Nothing: the factory model runs.
    Erased,
    /// The old model in A, nothing in B.
    Old,
    /// The old model in B, an older one in A.
    Retired,
    /// The same, with the same sequence number.
    Twins,
    /// The old model in A, the new one in B, which was on trial and not confirmed.
    Rejected,
    /// The old model in A, damaged since: the factory model runs, but the floor stays.
    Decayed,
}

const STARTS: [Start; 6] =
    [Start::Erased, Start::Old, Start::Retired, Start::Twins, Start::Rejected, Start::Decayed];

/// What the next boot may give, as far as it has been promised.
#[derive(Clone, Copy, Debug)]
struct May {
    be_old: bool,
    be_new: bool,
    /// Updates that will not be committed.
    drop_updates: u32,
    /// Trials that will not be confirmed.
    drop_trials: u32,
}

#[derive(Debug, PartialEq, Eq)]
enum Outcome {
    /// The new model is confirmed.
    Done,
    /// The power failed.
    Cut,
}

struct Lab<const WRITE: usize, const ERASE: usize> {
    board: Board,
    flash: Flash,
    geometry: Geometry,
    models: Models,
    start: Start,
    mutation: Option<Mutation>,
    /// Boots so far.
    boots: Cell<u64>,
    /// Contents at the start.
    image: Vec<u8>,
}

impl<const WRITE: usize, const ERASE: usize> Lab<WRITE, ERASE> {
    /// Slots of so many sectors, after `before` sectors of something else.
    fn new(models: &Models, start: Start, sectors: usize, before: usize) -> Self {
        let board = Board::new(&VirtualClock::new());
        let flash = Flash::new(&vec![ERASE; before + 2 * sectors], &board, 1);
        let (offset, slot_bytes) = ((before * ERASE) as u32, (sectors * ERASE) as u32);
        let geometry = Geometry { offset, slot_bytes };
        let mut lab = Self {
            board,
            flash,
            geometry,
            models: models.clone(),
            start,
            mutation: None,
            boots: Cell::new(0),
            image: Vec::new(),
        };
        let Models { older, old, new, .. } = models;
        match start {
            Start::Erased => {}
            Start::Old | Start::Decayed => lab.install(old, OLD, true),
            Start::Retired => {
                lab.install(older, OLDER, true);
                lab.install(old, OLD, true);
            }
            Start::Twins => {
                lab.install(older, OLD, true);
                lab.install(old, OLD, true);
            }
            Start::Rejected => {
                lab.install(old, OLD, true);
                lab.install(new, NEW, false);
            }
        }
        lab.image = lab.flash.snapshot();
        if start == Start::Decayed {
            lab.image[(offset + PAYLOAD_OFFSET) as usize] ^= 1;
            lab.flash.restore(&lab.image, 1);
        }
        lab
    }

    fn mutated(mut self, mutation: Mutation) -> Self {
        self.mutation = Some(mutation);
        self
    }

    fn region(&self) -> Region<WRITE, ERASE> {
        let end = self.geometry.offset + 2 * self.geometry.slot_bytes;
        self.flash.region(0..end as usize / ERASE).unwrap()
    }

    /// The payload, as the controller would see it.
    fn payload(&self, payload: Payload) -> Result<Vec<u8>, FlashError> {
        let mut bytes = vec![0; payload.length as usize];
        self.region().read(payload.offset, &mut bytes)?;
        Ok(bytes)
    }

    fn accept(&self, payload: Payload) -> bool {
        let Ok(bytes) = self.payload(payload) else { return false };
        // These were parsed before.
        let Models { robot, older, old, new } = &self.models;
        [older, old, new].contains(&&bytes) || Room::new().parse(robot, &bytes).is_ok()
    }

    fn boot(&self) -> (Slots<Seen<'_, WRITE, ERASE>>, Boot<FlashError>) {
        self.boots.set(self.boots.get() + 1);
        let (region, mutation) = (self.region(), self.mutation);
        let seen = Seen { region, mutation, lab: self, unkept: Vec::new(), generation: 0 };
        let accept = |payload| self.mutation.is_some() || self.accept(payload);
        Slots::boot(seen, self.geometry, &self.models.robot, 0, accept).unwrap()
    }

    fn install(&self, model: &[u8], sequence: u32, confirm: bool) {
        let (mut slots, _) = self.boot();
        self.update(&mut slots, model, sequence);
        let (mut slots, boot) = self.boot();
        assert!(boot.trial);
        if confirm {
            slots.confirm().unwrap();
        }
        let (_, boot) = self.boot();
        assert_eq!(boot.floor == sequence, confirm);
    }

    /// All of an update but the commit.
    fn send(
        &self,
        slots: &mut Slots<Seen<'_, WRITE, ERASE>>,
        model: &[u8],
        sequence: u32,
    ) -> Result<(), String> {
        let release = Release::new(&self.models.robot, sequence, model).unwrap();
        slots.begin(&release).map_err(|error| format!("begin: {error:?}"))?;
        while slots.erase().map_err(|error| format!("erase: {error:?}"))? > 0 {}
        for (i, part) in model.chunks(PART).enumerate() {
            let written = slots.write((i * PART) as u32, part);
            written.map_err(|error| format!("write: {error:?}"))?;
        }
        slots.verify().map(|_| ()).map_err(|error| format!("verify: {error:?}"))
    }

    /// All of an update but the trial.
    fn update(&self, slots: &mut Slots<Seen<'_, WRITE, ERASE>>, model: &[u8], sequence: u32) {
        self.send(slots, model, sequence).unwrap();
        slots.commit().unwrap();
    }

    /// What may be at the start, and how often update and trial are dropped.
    fn at_start(&self, detours: u32) -> May {
        May { be_old: true, be_new: false, drop_updates: detours, drop_trials: detours }
    }

    /// From power-on until the new model is confirmed, or the power fails. An error is a promise that
    /// was not kept.
    fn live(&self, may: &mut May) -> Result<Outcome, String> {
        let lost = || !self.flash.has_power();
        let mut boots = 0;
        loop {
            boots += 1;
            if boots > 8 {
                return Err("the update does not come to an end".to_owned());
            }
            let (mut slots, boot) = self.boot();
            if lost() {
                // The trial may have been marked.
                may.be_old |= may.be_new && !self.is_confirmed();
                return Ok(Outcome::Cut);
            }
            let is_new = self.check(&boot, may)?;
            match (is_new, boot.trial) {
                (true, false) => return Ok(Outcome::Done),
                (true, true) if may.drop_trials > 0 => {
                    may.drop_trials -= 1;
                    *may = May { be_old: true, be_new: false, ..*may };
                }
                (true, true) => {
                    *may = May { be_old: true, be_new: true, ..*may };
                    match slots.confirm() {
                        Ok(()) => *may = May { be_old: false, be_new: true, ..*may },
                        Err(_) if lost() => {}
                        Err(error) => return Err(format!("confirm: {error:?}")),
                    }
                    if slots.floor() != NEW && !may.be_old {
                        return Err("the floor has not risen".to_owned());
                    }
                }
                (false, _) => {
                    *may = May { be_old: true, be_new: false, ..*may };
                    let sent = self.send(&mut slots, &self.models.new, NEW);
                    if sent.is_ok() && may.drop_updates > 0 {
                        may.drop_updates -= 1;
                        continue;
                    }
                    let committed = sent.and_then(|()| {
                        may.be_new = true;
                        slots.commit().map_err(|error| format!("commit: {error:?}"))
                    });
                    match committed {
                        // The next boot has to try it.
                        Ok(()) => may.be_old = false,
                        Err(_) if lost() => {}
                        Err(error) => return Err(error),
                    }
                }
            }
            if lost() {
                return Ok(Outcome::Cut);
            }
        }
    }

    /// Whether the new model was confirmed: then a cut changes nothing any more.
    fn is_confirmed(&self) -> bool {
        let cells = [192, 224].into_iter();
        let image = self.flash.snapshot();
        [0, 1].into_iter().any(|slot| {
            let slot = &image[(self.geometry.offset + slot * self.geometry.slot_bytes) as usize..];
            let is_new = slot[24..56] == sha256(&self.models.new);
            is_new && cells.clone().any(|cell| slot[cell..cell + 8] == mark(b"CNFM", &slot[..64]))
        })
    }

    /// Whether the new model runs.
    fn check(&self, boot: &Boot<FlashError>, may: &mut May) -> Result<bool, String> {
        let fail = |what: &str| Err(format!("{what}: {boot:?}, {may:?}"));
        let bytes = boot.payload.map(|payload| self.payload(payload).unwrap());
        let is_new = bytes.as_ref() == Some(&self.models.new);
        let is_old = match self.start {
            Start::Erased | Start::Decayed => boot.running == Which::Factory && bytes.is_none(),
            _ => bytes.as_ref() == Some(&self.models.old),
        };
        if !is_new && !is_old {
            return fail("neither the old nor the new model");
        }
        if is_new && !may.be_new {
            return fail("the new model, which must not run");
        }
        if is_old && !may.be_old {
            return fail("the old model, which must not run");
        }
        if is_new {
            // Not by chance: what has been promised is there in so many words.
            let begin = boot.payload.unwrap().offset - PAYLOAD_OFFSET;
            let mut record = [0; PAYLOAD_OFFSET as usize];
            self.region().read(begin, &mut record).unwrap();
            let is_set = |name, cell: usize| {
                let word = mark(name, &record[..64]);
                [cell, cell + 32].into_iter().any(|cell| record[cell..cell + 8] == word)
            };
            if !is_set(b"CMIT", 64) {
                return fail("the new model, which was not committed");
            }
            if !boot.trial && !is_set(b"CNFM", 192) {
                return fail("the new model, which was not confirmed");
            }
        }
        if is_old && boot.trial {
            return fail("the old model on trial");
        }
        let old = if self.start == Start::Erased { 0 } else { OLD };
        if boot.floor != if is_new && !boot.trial { NEW } else { old } {
            return fail("a wrong floor");
        }
        Ok(is_new)
    }

    /// Restores an image, cuts the power after so many steps, and lives until then.
    fn cut(&self, image: &[u8], seed: u64, steps: u64, may: &mut May) -> Result<Outcome, String> {
        self.flash.restore(image, seed);
        self.flash.cut_power_after(steps);
        let outcome = self.live(may);
        self.flash.power_on();
        outcome
    }

    /// After all cuts: nothing fails any more.
    fn recover(&self, may: &mut May) -> Result<(), String> {
        match self.live(may)? {
            Outcome::Done => Ok(()),
            Outcome::Cut => unreachable!("no cut is to come"),
        }
    }

    /// Steps of a life without cuts.
    fn steps(&self, image: &[u8], mut may: May) -> Result<u64, String> {
        let done = |flash: &Flash| {
            let counts = flash.counts();
            counts.programmed_bytes + counts.erased_sectors
        };
        self.flash.restore(image, 0);
        let before = done(&self.flash);
        self.recover(&mut may)?;
        Ok(done(&self.flash) - before)
    }

    /// A cut at each of the steps; their number.
    fn single_cuts(&self, detours: u32, stride: usize) -> Result<u64, String> {
        let may = self.at_start(detours);
        let steps = self.steps(&self.image, may)?;
        let mut count = 0;
        for cut in (0..steps).step_by(stride) {
            let mut may = may;
            let outcome = self.cut(&self.image, cut, cut, &mut may);
            let outcome = outcome.and_then(|cut| self.recover(&mut may).map(|()| cut));
            match outcome {
                Ok(Outcome::Cut) => count += 1,
                Ok(Outcome::Done) => unreachable!("the cut is one of the steps"),
                Err(error) => return Err(format!("{:?}, cut {cut}: {error}", self.start)),
            }
        }
        self.no_misuse();
        Ok(count)
    }

    /// A cut at each of `first`, then at each of the steps after it; the number of pairs.
    fn pairs(&self, first: impl Iterator<Item = u64>) -> Result<u64, String> {
        let mut count = 0;
        for first in first {
            let mut may = self.at_start(0);
            if self.cut(&self.image, first, first, &mut may)? == Outcome::Done {
                break;
            }
            let image = self.flash.snapshot();
            for second in 0.. {
                if self.pair(&image, may, first, second)? == Outcome::Done {
                    break;
                }
                count += 1;
            }
        }
        self.no_misuse();
        Ok(count)
    }

    /// The second cut of a pair, and what comes after it.
    fn pair(&self, image: &[u8], mut may: May, first: u64, second: u64) -> Result<Outcome, String> {
        let seed = first << 32 | second;
        let mut run = || match self.cut(image, seed, second, &mut may)? {
            Outcome::Done => Ok(Outcome::Done),
            Outcome::Cut => self.recover(&mut may).map(|()| Outcome::Cut),
        };
        run().map_err(|error| format!("{:?}, cuts {first} and {second}: {error}", self.start))
    }

    /// Pairs drawn at random.
    fn random_pairs(&self, count: u64, random: &mut Random) -> Result<u64, String> {
        let start = self.at_start(0);
        let steps = self.steps(&self.image, start)?;
        let mut done = 0;
        while done < count {
            let first = random.below(steps);
            let mut may = start;
            self.cut(&self.image, first, first, &mut may)?;
            // Some second cuts for each first one, which costs as much.
            let image = self.flash.snapshot();
            for _ in 0..4 {
                let second = random.below(steps);
                if self.pair(&image, may, first, second)? == Outcome::Cut {
                    done += 1;
                }
            }
        }
        self.no_misuse();
        Ok(done)
    }

    /// Many cuts in a row, at random; their number.
    fn many_cuts(&self, cuts: u32, random: &mut Random) -> Result<u64, String> {
        let mut may = self.at_start(1);
        let steps = self.steps(&self.image, may)?;
        self.flash.restore(&self.image, random.below(u64::MAX));
        let mut count = 0;
        for _ in 0..cuts {
            // Often early, in the marks of a boot.
            let below = if random.below(2) == 0 { 20 } else { steps };
            self.flash.cut_power_after(random.below(below));
            let outcome = self.live(&mut may)?;
            self.flash.power_on();
            if outcome == Outcome::Done {
                break;
            }
            count += 1;
        }
        self.recover(&mut may)?;
        self.no_misuse();
        Ok(count)
    }

    fn no_misuse(&self) {
        assert_eq!(self.board.misuse(), None);
    }
}

/// SplitMix64 (Steele, Lea & Flood 2014).
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % end
    }
}

/// 16 KB sectors with words of 4 bytes.
type Words = Lab<4, 0x4000>;
/// 128 KB sectors written by the byte.
type Bytes = Lab<1, 0x20000>;
/// Slots of four small sectors behind another one: payloads cross sectors.
type Small = Lab<4, 1024>;

fn words(models: &Models, start: Start) -> Words {
    Lab::new(models, start, 1, 0)
}

fn bytes(models: &Models, start: Start) -> Bytes {
    Lab::new(models, start, 1, 0)
}

fn small(models: &Models, start: Start) -> Small {
    Lab::new(models, start, 4, 1)
}

/// Steps between cut points of the short tests: a prime, so that all bytes of words are met.
const STRIDE: usize = 13;

fn all_single_cuts(stride: usize) -> u64 {
    let mut count = 0;
    for models in Models::all() {
        for start in STARTS {
            for detours in [0, 1] {
                count += words(&models, start).single_cuts(detours, stride).unwrap();
                count += bytes(&models, start).single_cuts(detours, stride).unwrap();
                count += small(&models, start).single_cuts(detours, stride).unwrap();
            }
        }
        println!("{}: {count} cuts so far", models.robot);
    }
    count
}

#[test]
fn a_cut_anywhere_leaves_the_old_or_the_new_model() {
    let count = all_single_cuts(16 * STRIDE);
    // All of the steps with the smallest blob.
    let models = &Models::all()[0];
    let small: u64 =
        STARTS.map(|start| small(models, start).single_cuts(1, 1).unwrap()).iter().sum();
    println!("{} cuts", count + small);
}

#[test]
#[ignore = "every operation, 520,000 cuts; run with --release --ignored"]
fn a_cut_at_every_operation_leaves_the_old_or_the_new_model() {
    println!("{} cuts", all_single_cuts(1));
}

#[test]
fn two_cuts_leave_the_old_or_the_new_model() {
    let models = &Models::all()[0];
    let mut count = 0;
    for start in STARTS {
        let mut random = Random(start as u64);
        count += words(models, start).random_pairs(300, &mut random).unwrap();
        count += bytes(models, start).random_pairs(100, &mut random).unwrap();
        count += small(models, start).random_pairs(300, &mut random).unwrap();
    }
    println!("{count} pairs");
}

/// Every pair of cuts of the smallest blob, in two threads.
fn every_pair<const W: usize, const E: usize>(lab: fn(&Models, Start) -> Lab<W, E>, start: Start) {
    let models = &Models::all()[0];
    let count: u64 = std::thread::scope(|scope| {
        let half =
            |from| scope.spawn(move || lab(models, start).pairs((from..).step_by(2)).unwrap());
        [half(0), half(1)].map(|half| half.join().unwrap()).iter().sum()
    });
    println!("{}, {start:?}, units of {W}, sectors of {E}: {count} pairs", models.robot);
}

#[test]
#[ignore = "every pair of operations, 1,186,609; run with --release --ignored"]
fn every_pair_of_cuts_with_words_leaves_the_old_or_the_new_model() {
    every_pair(words, Start::Retired);
}

#[test]
#[ignore = "every pair of operations, 1,186,609; run with --release --ignored"]
fn every_pair_of_cuts_with_bytes_leaves_the_old_or_the_new_model() {
    every_pair(bytes, Start::Retired);
}

#[test]
#[ignore = "every pair of operations, 7,158,912; run with --release --ignored"]
fn every_pair_of_cuts_with_small_sectors_leaves_the_old_or_the_new_model() {
    for start in STARTS {
        every_pair(small, start);
    }
}

/// At least so many pairs for each blob but the smallest.
const PAIRS: u64 = 100_000;

#[test]
#[ignore = "100,000 pairs for each blob and flash; run with --release --ignored"]
fn random_pairs_of_cuts_leave_the_old_or_the_new_model() {
    for models in &Models::all()[1..] {
        let [words, bytes] = std::thread::scope(|scope| {
            let share = PAIRS.div_ceil(STARTS.len() as u64);
            let seed = |start: Start| Random(start as u64 + models.new.len() as u64);
            let words = scope.spawn(move || {
                let pairs = |start| words(models, start).random_pairs(share, &mut seed(start));
                STARTS.map(|start| pairs(start).unwrap()).iter().sum::<u64>()
            });
            let bytes = scope.spawn(move || {
                let pairs = |start| bytes(models, start).random_pairs(share, &mut seed(start));
                STARTS.map(|start| pairs(start).unwrap()).iter().sum::<u64>()
            });
            [words, bytes].map(|count| count.join().unwrap())
        });
        println!("{}: {words} pairs with words, {bytes} with bytes", models.robot);
    }
}

#[test]
fn many_cuts_in_a_row_leave_the_old_or_the_new_model() {
    let models = &Models::all()[0];
    let mut random = Random(1);
    let mut count = 0;
    for start in STARTS {
        let lab = small(models, start);
        for _ in 0..200 {
            count += lab.many_cuts(30, &mut random).unwrap();
        }
    }
    println!("{count} cuts");
}

#[test]
fn a_slot_that_is_made_wrong_is_noticed() {
    let models = &Models::all()[0];
    let with = |mutation| small(models, Start::Retired).mutated(mutation);
    // What is noticed first when single cuts are made at every step, with detours or without.
    let noticed = |mutation, detours| with(mutation).single_cuts(detours, 1).unwrap_err();

    // The payload is whole but nobody said so.
    let error = noticed(Mutation::HeaderFirst, 1);
    assert!(error.contains("the new model, which must not run"), "{error}");
    // Not even that.
    let error = noticed(Mutation::HeaderFirstBlindHash, 0);
    assert!(error.contains("neither the old nor the new model"), "{error}");
    // Header and payload are right, but the commit mark is left out.
    let error = noticed(Mutation::NoCommitMark, 0);
    assert!(error.contains("the new model, which was not committed"), "{error}");
    let error = noticed(Mutation::NoTrialMark, 1);
    assert!(error.contains("the new model, which must not run"), "{error}");
    let error = noticed(Mutation::NoConfirmMark, 0);
    assert!(error.contains("the old model, which must not run"), "{error}");
    // Against cuts the commit mark would do without the hash, which is there for damage.
    with(Mutation::BlindHash).single_cuts(1, 1).unwrap();
}

/// The contents, but other bytes in a cell of slot B.
fn with_cell<const W: usize, const E: usize>(
    lab: &Lab<W, E>,
    image: &[u8],
    cell: usize,
    bytes: &[u8],
) -> Vec<u8> {
    let at = (lab.geometry.offset + lab.geometry.slot_bytes) as usize + cell;
    let mut image = image.to_vec();
    image[at..at + bytes.len()].copy_from_slice(bytes);
    image
}

fn slot_b<const W: usize, const E: usize>(lab: &Lab<W, E>, image: &[u8]) -> Vec<u8> {
    image[(lab.geometry.offset + lab.geometry.slot_bytes) as usize..].to_vec()
}

#[test]
fn what_a_boot_has_decided_stays_decided() {
    let models = &Models::all()[0];
    let lab = small(models, Start::Old);
    let new = |boot: &Boot<FlashError>| boot.running == Which::B;
    for torn in 0..8_u64 {
        for seed in 0..20 {
            for readable_first in [true, false] {
                // In the commit mark, after the 64 bytes of the header; in the trial mark; in the confirm
                // mark.
                for (name, cell) in [(b"CMIT", 64), (b"TRIL", 128), (b"CNFM", 192)] {
                    lab.flash.restore(&lab.image, seed);
                    let (mut slots, _) = lab.boot();
                    lab.send(&mut slots, &models.new, NEW).unwrap();
                    if cell == 64 {
                        lab.flash.cut_power_after(64 + torn);
                    }
                    assert_eq!(slots.commit().is_ok(), cell != 64);
                    if cell == 128 {
                        lab.flash.cut_power_after(torn);
                        lab.boot();
                    } else if cell == 192 {
                        let (mut slots, boot) = lab.boot();
                        assert!(boot.trial);
                        lab.flash.cut_power_after(torn);
                        slots.confirm().unwrap_err();
                    }
                    assert!(!lab.flash.has_power());

                    let image = lab.flash.snapshot();
                    let slot = slot_b(&lab, &image);
                    let unreadable = &slot[cell..cell + 8];
                    let readable = &mark(name, &slot[..64])[..];
                    if unreadable == readable {
                        // Cut so late that all of it had been programmed.
                        continue;
                    }
                    let (first, later) = if readable_first {
                        (readable, unreadable)
                    } else {
                        (unreadable, readable)
                    };
                    lab.flash.restore(&with_cell(&lab, &image, cell, first), seed);
                    let (mut slots, boot) = lab.boot();
                    match cell {
                        // Committed as read, and then on trial.
                        64 => {
                            assert_eq!((new(&boot), boot.trial), (readable_first, readable_first))
                        }
                        // The trial is over, or begins.
                        128 => {
                            assert_eq!((new(&boot), boot.trial), (!readable_first, !readable_first))
                        }
                        _ => assert_eq!((new(&boot), boot.trial), (readable_first, false)),
                    }
                    let confirmed = new(&boot);
                    if boot.trial {
                        slots.confirm().unwrap();
                    }
                    drop(slots);
                    let image = lab.flash.snapshot();
                    // What was erased at first has been programmed since.
                    if slot_b(&lab, &image)[cell..cell + 8] == *first {
                        lab.flash.restore(&with_cell(&lab, &image, cell, later), seed);
                    }
                    for _ in 0..2 {
                        let (_, boot) = lab.boot();
                        assert_eq!((new(&boot), boot.trial), (confirmed, false), "{torn} {cell}");
                        assert_eq!(boot.floor, if confirmed { NEW } else { OLD });
                    }
                }
            }
        }
    }
    lab.no_misuse();
}

#[test]
fn the_bytes_are_as_specified() {
    let models = &Models::all()[0];
    let lab = small(&Models { robot: "rosbot".to_owned(), ..models.clone() }, Start::Erased);
    let (mut slots, _) = lab.boot();
    lab.update(&mut slots, b"koopman", 7);
    let at = 1024;
    let slot = |len: usize| lab.flash.snapshot()[at..at + len].to_vec();
    let header = "534c4f5401004001070000000700000001000000843f9e6b1a45a8259ac87e6d8ad109746bde42bf79e3c47ae27a3d724e8bf1aa54647aea000000003f68df23";
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    assert_eq!(hex(&slot(64)), header);

    let set = |name: &str| format!("{}{}{}", hex(name.as_bytes()), &header[120..], "ff".repeat(24));
    let erased = "ff".repeat(32);
    let cells = |marks: [&str; 4]| {
        let cell = |name: &str| if name.is_empty() { erased.clone() } else { set(name) };
        marks.map(|name| cell(name).repeat(2)).concat()
    };
    assert_eq!(hex(&slot(320)[64..]), cells(["CMIT", "", "", ""]));
    assert_eq!(slot(332)[320..], *b"koopman\xFF\xFF\xFF\xFF\xFF");
    // It is no blob: on trial while it is looked at, and never again.
    let (_, boot) = lab.boot();
    assert_eq!(boot.refused, [Some(Refusal::NotAccepted), Some(Refusal::Empty)]);
    assert_eq!(hex(&slot(320)[64..]), cells(["CMIT", "TRIL", "", ""]));
    let (_, boot) = lab.boot();
    assert_eq!(boot.refused, [Some(Refusal::Rejected), Some(Refusal::Empty)]);
    assert_eq!(hex(&slot(320)[64..]), cells(["CMIT", "TRIL", "", "RJCT"]));
    assert_eq!(boot.running, Which::Factory);

    let lab = small(models, Start::Old);
    let header = lab.flash.snapshot()[at..at + 64].to_vec();
    let cell = |name| [mark(name, &header), vec![0xFF; 24]].concat().repeat(2);
    let marks = [cell(b"CMIT"), cell(b"TRIL"), cell(b"CNFM"), vec![0xFF; 64]].concat();
    assert_eq!(slot_of(&lab)[64..320], marks);
}

/// Slot A.
fn slot_of<const W: usize, const E: usize>(lab: &Lab<W, E>) -> Vec<u8> {
    lab.flash.snapshot()[lab.geometry.offset as usize..].to_vec()
}

#[test]
fn an_unconfirmed_trial_is_reverted_and_not_repeated() {
    let models = &Models::all()[0];
    let lab = words(models, Start::Old);
    let (mut slots, _) = lab.boot();
    assert_eq!(slots.confirm(), Err(MarkError::NotReady));
    lab.update(&mut slots, &models.new, NEW);
    assert_eq!(slots.running(), Which::A);

    let (mut slots, boot) = lab.boot();
    assert_eq!((boot.running, boot.trial, boot.floor), (Which::B, true, OLD));
    let release = Release::new(&models.robot, NEW, &models.new).unwrap();
    assert_eq!(slots.begin(&release), Err(BeginError::OnTrial));
    for _ in 0..3 {
        let (_, boot) = lab.boot();
        assert_eq!((boot.running, boot.trial, boot.floor), (Which::A, false, OLD));
        assert_eq!(boot.refused, [None, Some(Refusal::Rejected)]);
    }
    lab.no_misuse();
}

#[test]
fn what_is_below_the_floor_neither_comes_nor_stays() {
    let models = &Models::all()[0];
    let lab = words(models, Start::Retired);
    let (mut slots, _) = lab.boot();
    let release = |sequence| Release::new(&models.robot, sequence, &models.new).unwrap();
    let below = BeginError::BelowFloor { floor: OLD, found: OLD - 1 };
    let untouched = lab.flash.snapshot();
    assert_eq!(slots.begin(&release(OLD - 1)), Err(below));
    let other = Release::new("another", NEW, &models.new).unwrap();
    assert_eq!(slots.begin(&other), Err(BeginError::AnotherRobot { found: robot("another") }));
    let room = slots.room();
    assert_eq!(room, 0x4000 - 320);
    for found in [0, room + 1, u32::MAX] {
        let long = Release { length: found, ..release(NEW) };
        assert_eq!(slots.begin(&long), Err(BeginError::Length { room, found }));
    }
    assert_eq!(lab.flash.snapshot(), untouched);

    // The payload of the running model decays: the older one stays refused, the floor where it is.
    let mut image = untouched.clone();
    image[0x4000 + 320 + 100] ^= 1;
    lab.flash.restore(&image, 1);
    let (mut slots, boot) = lab.boot();
    assert_eq!((boot.running, boot.floor), (Which::Factory, OLD));
    let below = Refusal::BelowFloor { floor: OLD, found: OLDER };
    assert_eq!(boot.refused, [Some(below), Some(Refusal::Payload)]);
    // An update spares the slot with the floor, however often it is begun.
    for _ in 0..2 {
        begin(&mut slots, &release(OLD));
        assert_eq!(lab.flash.snapshot()[0x4000..], image[0x4000..]);
    }
    lab.update(&mut slots, &models.new, OLD);
    let (mut slots, boot) = lab.boot();
    assert_eq!((boot.running, boot.trial), (Which::A, true));
    slots.confirm().unwrap();
    assert_eq!((slots.floor(), slots.on_trial()), (OLD, false));
    assert_eq!(slots.confirm(), Err(MarkError::NotReady));
    assert_eq!(lab.boot().1.running, Which::A);

    // An image may ask for more.
    let accept = |_| true;
    let slots = Slots::boot(lab.region(), lab.geometry, &models.robot, NEW, accept).unwrap();
    assert_eq!((slots.1.running, slots.1.floor), (Which::Factory, NEW));
    let of_another = Slots::boot(lab.region(), lab.geometry, "another", 0, accept).unwrap();
    let another = Refusal::AnotherRobot { found: robot(&models.robot) };
    assert_eq!(of_another.1.refused, [Some(another), Some(another)]);
    lab.no_misuse();
}

#[test]
fn of_two_confirmed_models_the_newer_runs_and_the_other_stands_in() {
    let models = &Models::all()[0];
    let lab = words(models, Start::Twins);
    let (_, boot) = lab.boot();
    assert_eq!((boot.running, boot.refused), (Which::B, [None, None]));
    let mut image = lab.flash.snapshot();
    image[0x4000 + 320] ^= 1;
    lab.flash.restore(&image, 1);
    let (_, boot) = lab.boot();
    assert_eq!((boot.running, boot.floor), (Which::A, OLD));
    assert_eq!(boot.refused, [None, Some(Refusal::Payload)]);
    image[320] ^= 1;
    lab.flash.restore(&image, 1);
    let (_, boot) = lab.boot();
    assert_eq!((boot.running, boot.payload, boot.floor), (Which::Factory, None, OLD));
    assert_eq!(boot.refused, [Some(Refusal::Payload), Some(Refusal::Payload)]);
}

#[test]
fn an_update_that_is_aborted_or_damaged_does_not_run() {
    let models = &Models::all()[0];
    let lab = words(models, Start::Old);
    let release = Release::new(&models.robot, NEW, &models.new).unwrap();
    // Before the commit, and after it.
    let (mut slots, _) = lab.boot();
    begin(&mut slots, &release);
    slots.write(0, &models.new[..10]).unwrap();
    slots.abort().unwrap();
    assert_eq!(slots.written(), None);
    assert_eq!(slots.write(10, &models.new[10..]), Err(WriteError::NotWriting));
    assert_eq!(slots.verify(), Err(VerifyError::NotWriting));
    assert_eq!(lab.boot().1.running, Which::A);
    lab.update(&mut slots, &models.new, NEW);
    slots.abort().unwrap();
    let (mut slots, boot) = lab.boot();
    assert_eq!((boot.running, boot.refused), (Which::A, [None, Some(Refusal::Rejected)]));

    // Bytes that got lost on the way.
    let mut damaged = models.new.clone();
    damaged[500] ^= 4;
    begin(&mut slots, &release);
    slots.write(0, &damaged).unwrap();
    assert_eq!(slots.verify(), Err(VerifyError::Hash));
    assert_eq!(slots.commit(), Err(MarkError::NotReady));
    assert_eq!(slots.written(), None);
    assert_eq!(lab.boot().1.running, Which::A);
    lab.no_misuse();
}

#[test]
fn parts_come_in_order_and_a_broken_line_is_taken_up_again() {
    let models = &Models::all()[0];
    let lab = words(models, Start::Old);
    let (mut slots, _) = lab.boot();
    assert_eq!(slots.commit(), Err(MarkError::NotReady));
    let release = Release::new(&models.robot, NEW, &models.new).unwrap();
    begin(&mut slots, &release);
    assert_eq!(slots.written(), Some(0));
    slots.write(0, &models.new[..101]).unwrap();
    // The acknowledgement was lost.
    let out_of_order = WriteError::OutOfOrder { expected: 101, found: 0 };
    assert_eq!(slots.write(0, &models.new[..101]), Err(out_of_order));
    assert_eq!(slots.written(), Some(101));
    let length = models.new.len() as u32;
    assert_eq!(slots.verify(), Err(VerifyError::Incomplete { written: 101, length }));
    slots.write(101, &[]).unwrap();
    let room = length - 101;
    let found = models.new.len();
    assert_eq!(slots.write(101, &models.new), Err(WriteError::TooLong { room, found }));
    slots.write(101, &models.new[101..]).unwrap();
    slots.verify().unwrap();
    slots.verify().unwrap();
    assert_eq!(slots.write(length, &[]), Err(WriteError::NotWriting));
    slots.commit().unwrap();
    assert_eq!(slots.commit(), Err(MarkError::NotReady));
    let (_, boot) = lab.boot();
    assert_eq!(lab.payload(boot.payload.unwrap()).unwrap(), models.new);
    lab.no_misuse();
}

/// Begins an update, and erases.
fn begin<F: NorFlash<Error: std::fmt::Debug>>(slots: &mut Slots<F>, release: &Release) {
    slots.begin(release).unwrap();
    assert_eq!((slots.update(), slots.written()), (Some(*release), None));
    assert_eq!(slots.write(0, &[1]).map_err(|_| ()), Err(()), "nothing before it is erased");
    for left in (0..slots.sectors()).rev() {
        assert_eq!(slots.erase().unwrap(), left);
    }
    assert_eq!((slots.erase().unwrap(), slots.written()), (0, Some(0)));
}

/// A flash in memory that knows no other write unit, and writes each only once.
struct Memory<const WRITE: usize, const READ: usize>(Vec<u8>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Refused;

impl NorFlashError for Refused {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl<const W: usize, const R: usize> ErrorType for Memory<W, R> {
    type Error = Refused;
}

impl<const W: usize, const R: usize> ReadNorFlash for Memory<W, R> {
    const READ_SIZE: usize = R;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        let at = offset as usize;
        let aligned = at.is_multiple_of(R) && bytes.len().is_multiple_of(R);
        let found = self.0.get(at..at + bytes.len()).filter(|_| aligned).ok_or(Refused)?;
        bytes.copy_from_slice(found);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl<const W: usize, const R: usize> NorFlash for Memory<W, R> {
    const WRITE_SIZE: usize = W;
    const ERASE_SIZE: usize = 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        self.0.get_mut(from as usize..to as usize).ok_or(Refused)?.fill(0xFF);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        let at = offset as usize;
        let aligned = at.is_multiple_of(W) && bytes.len().is_multiple_of(W);
        let place = self.0.get_mut(at..at + bytes.len()).filter(|_| aligned).ok_or(Refused)?;
        if place.iter().any(|byte| *byte != 0xFF) {
            return Err(Refused);
        }
        place.copy_from_slice(bytes);
        Ok(())
    }
}

/// Installs a payload in parts of these lengths, over and over; the layout does not depend on the units.
fn install<const W: usize, const R: usize>(payload: &[u8], parts: &[usize]) -> Vec<u8> {
    let mut memory = Memory::<W, R>(vec![0; 4096]);
    fn boot<F: NorFlash>(memory: F) -> (Slots<F>, Boot<F::Error>) {
        let geometry = Geometry { offset: 0, slot_bytes: 2048 };
        Slots::boot(memory, geometry, "robot", 0, |_| true).unwrap()
    }
    let (mut slots, _) = boot(&mut memory);
    begin(&mut slots, &Release::new("robot", 1, payload).unwrap());
    let mut parts = parts.iter().cycle();
    let mut rest = payload;
    while !rest.is_empty() {
        let (part, more) = rest.split_at(rest.len().min(*parts.next().unwrap()));
        slots.write(slots.written().unwrap(), part).unwrap();
        rest = more;
    }
    slots.verify().unwrap();
    slots.commit().unwrap();
    let (mut slots, _) = boot(&mut memory);
    slots.confirm().unwrap();
    let (_, found) = boot(&mut memory);
    assert_eq!((found.running, found.trial, found.floor), (Which::A, false, 1));
    memory.0
}

proptest! {
    #[test]
    fn parts_and_units_of_any_length_make_the_same_slot(
        payload in prop::collection::vec(any::<u8>(), 1..=1728),
        parts in prop::collection::vec(1..200_usize, 1..20),
    ) {
        let bytes = install::<1, 1>(&payload, &[payload.len()]);
        prop_assert_eq!(&bytes[320..][..payload.len()], &payload);
        prop_assert!(bytes[320 + payload.len()..2048].iter().all(|byte| *byte == 0xFF));
        prop_assert_eq!(&install::<1, 1>(&payload, &parts), &bytes);
        prop_assert_eq!(&install::<2, 1>(&payload, &parts), &bytes);
        prop_assert_eq!(&install::<4, 4>(&payload, &parts), &bytes);
        prop_assert_eq!(&install::<8, 1>(&payload, &parts), &bytes);
        prop_assert_eq!(&install::<16, 16>(&payload, &parts), &bytes);
        prop_assert_eq!(&install::<32, 32>(&payload, &parts), &bytes);
    }

    #[test]
    fn any_contents_boot(
        bytes in prop::collection::vec(prop_oneof![any::<u8>(), Just(0xFF)], 4096),
        valid_header: bool, length: u32,
    ) {
        let mut memory = Memory::<4, 1>(bytes);
        if valid_header {
            let fields = [&b"SLOT\x01\0\x40\x01"[..], &length.to_le_bytes()].concat();
            memory.0[..12].copy_from_slice(&fields);
            let crc = crc32(&memory.0[..60]);
            memory.0[60..64].copy_from_slice(&crc.to_le_bytes());
        }
        let geometry = Geometry { offset: 0, slot_bytes: 2048 };
        let (mut slots, boot) = Slots::boot(&mut memory, geometry, "robot", 0, |_| true).unwrap();
        prop_assert_eq!(boot.running, Which::Factory);
        prop_assert_eq!(boot.floor, 0);
        begin(&mut slots, &Release::new("robot", 0, b"model").unwrap());
        slots.write(0, b"model").unwrap();
        slots.verify().unwrap();
        slots.commit().unwrap();
        let (_, boot) = Slots::boot(&mut memory, geometry, "robot", 0, |_| true).unwrap();
        prop_assert_eq!((boot.running, boot.trial), (Which::A, true));
    }
}

#[test]
fn geometries_that_do_not_fit_are_refused() {
    fn boot<const W: usize, const R: usize>(
        offset: u32,
        slot_bytes: u32,
    ) -> Result<(), GeometryError> {
        let memory = Memory::<W, R>(vec![0xFF; 4096]);
        let geometry = Geometry { offset, slot_bytes };
        Slots::boot(memory, geometry, "robot", 0, |_| true).map(|_| ())
    }
    assert_eq!(boot::<4, 1>(0, 2048), Ok(()));
    assert_eq!(boot::<4, 1>(2048, 1024), Ok(()));
    let sectors = GeometryError::Sectors { sector: 1024 };
    for (offset, slot_bytes) in [(0, 0), (0, 512), (0, 1536), (512, 1024)] {
        assert_eq!(boot::<4, 1>(offset, slot_bytes), Err(sectors));
    }
    let capacity = GeometryError::Capacity { capacity: 4096 };
    for (offset, slot_bytes) in [(0, 3072), (3072, 1024), (1024, 2048), (0, 1 << 31), (1024, !1023)]
    {
        assert_eq!(boot::<4, 1>(offset, slot_bytes), Err(capacity));
    }
    assert_eq!(boot::<64, 1>(0, 2048), Err(GeometryError::Unit { found: 64 }));
    assert_eq!(boot::<4, 3>(0, 2048), Err(GeometryError::Unit { found: 3 }));
}

/// A flash that fails in one slot.
struct Failing(Memory<4, 1>);

impl ErrorType for Failing {
    type Error = Refused;
}

impl ReadNorFlash for Failing {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        if offset < 2048 { Err(Refused) } else { self.0.read(offset, bytes) }
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl NorFlash for Failing {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        self.0.erase(from, to)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        self.0.write(offset, bytes)
    }
}

#[test]
fn a_slot_that_cannot_be_read_does_not_stop_the_other() {
    let mut memory = install::<4, 1>(b"model", &[5]);
    let slot = memory[..2048].to_vec();
    memory[2048..].copy_from_slice(&slot);
    let geometry = Geometry { offset: 0, slot_bytes: 2048 };
    let failing = Failing(Memory(memory));
    let (_, boot) = Slots::boot(failing, geometry, "robot", 0, |_| true).unwrap();
    assert_eq!((boot.running, boot.refused), (Which::B, [Some(Refusal::Flash(Refused)), None]));
}
