//! The models in a simulated controller's flash, and who may install others.

use crate::mcu::flash::{Flash, Region};
use crate::mcu::{Board, VirtualClock};
use crate::run::scenario::Controller;
use crate::run::{Blob, write_whole};
use embedded_storage::nor_flash::ReadNorFlash;
use firmware_core::slots::{Boot, Geometry, Payload, Which};
use firmware_core::update::{Capacities, Identity, PublicKey, Trust, Updater};
use std::cell::Cell;
use std::path::PathBuf;
use std::rc::Rc;

/// Bytes of a sector: slots are sectors 10 and 11 of an STM32F407, the last two.
const SECTOR: usize = 128 * 1024;
/// Most time that one takes to erase (ms): STM32F407, DS8626, by bytes; by words it is half of that.
pub const ERASE_MS: u32 = 4_000;
/// Instructions to check a signature, counted in the emulator (firmware-sim/cortex-m).
pub const SIGNATURE_INSTRUCTIONS: u64 = 1_670_000;
/// Instructions per byte of a blob that is hashed, parsed and put to its self-test, counted there, too.
pub const BLOB_INSTRUCTIONS: u64 = 85;
/// Instructions per byte that arrives, as counted there.
pub const LINE_INSTRUCTIONS: u32 = 74;
/// Time that a trial has to be good for (s).
const GOOD_S: f64 = 10.0;

/// What a boot chose to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Booted {
    /// When, in virtual time (µs).
    pub at_us: u64,
    /// Where the model lies.
    pub running: Which,
    /// Its sequence number, 0 of the factory model.
    pub sequence: u32,
    /// Whether it is on trial.
    pub trial: bool,
    /// Lowest sequence number that is accepted.
    pub floor: u32,
}

/// One line, such as `boots the model in slot A, sequence number 3, on trial`.
impl std::fmt::Display for Booted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { sequence, floor, .. } = self;
        match self.running {
            Which::Factory => write!(f, "boots the factory model")?,
            slot => write!(f, "boots the model in slot {slot:?}, sequence number {sequence}")?,
        }
        write!(f, "{}; floor {floor}", if self.trial { ", on trial" } else { "" })
    }
}

/// What outlives a reset, and who may change it.
pub struct Store {
    /// Contents of both slots.
    pub image: Vec<u8>,
    /// Whose releases are accepted; `None`: everybody's.
    pub key: Option<PublicKey>,
    /// Time to erase a sector (ns); `None`: the typical one.
    pub erase_ns: Option<u64>,
    /// Where the slots are kept from one run to the next.
    pub file: Option<PathBuf>,
    /// Boots so far.
    pub boots: Vec<Booted>,
    /// Signatures checked so far.
    pub signatures: u64,
    /// Is told of every boot.
    pub told: Box<dyn FnMut(&Booted)>,
    factory: Blob,
}

impl std::fmt::Debug for Store {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Store").field("key", &self.key).field("boots", &self.boots).finish()
    }
}

impl Store {
    /// Erased slots, and this model in the image.
    pub fn new(factory: &Blob, key: Option<PublicKey>) -> Self {
        Self {
            image: vec![0xFF; 2 * SECTOR],
            key,
            erase_ns: None,
            file: None,
            boots: Vec::new(),
            signatures: 0,
            told: Box::new(|_| {}),
            factory: factory.clone(),
        }
    }

    /// Keeps the slots in a file, which is read now if it is there.
    ///
    /// # Errors
    /// When it cannot be read, or is not as long as two slots.
    pub fn keep(&mut self, file: PathBuf) -> Result<(), String> {
        let failed = |e: &dyn std::fmt::Display| format!("{}: {e}", file.display());
        match std::fs::read(&file) {
            Ok(bytes) if bytes.len() == self.image.len() => self.image = bytes,
            Ok(bytes) => {
                let expected = self.image.len();
                let found = bytes.len();
                return Err(failed(&format!(
                    "expected the {expected} bytes of two model slots, found {found}; give another \
                     file, or delete this one to begin with erased slots"
                )));
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(failed(&format!("cannot be read: {e}"))),
        }
        self.file = Some(file);
        Ok(())
    }

    /// Takes over what the flash holds now, and writes it to the file.
    pub(crate) fn save(&mut self, installed: &Installed) -> std::io::Result<()> {
        self.image = installed.flash.snapshot();
        self.signatures = installed.checked.get();
        self.file.as_ref().map_or(Ok(()), |file| write_whole(file, &self.image))
    }

    /// Takes note of a boot.
    pub(crate) fn booted(&mut self, boot: Booted, installed: &Installed) -> std::io::Result<()> {
        (self.told)(&boot);
        self.boots.push(boot);
        self.save(installed)
    }

    /// The same on a board.
    pub(crate) fn installed(&self, of: Loop, speed: Speed, board: &Board, seed: u64) -> Installed {
        let flash = Flash::new(&[SECTOR; 2], board, seed);
        flash.restore(&self.image, seed);
        if let Some(erase_ns) = self.erase_ns {
            flash.set_erase_ns(erase_ns);
        }
        let (factory, key) = (self.factory.clone(), self.key);
        Installed { flash, factory, key, of, speed, checked: Rc::new(Cell::new(self.signatures)) }
    }
}

/// How fast a controller checks signatures.
#[derive(Debug, Clone)]
pub(crate) struct Speed {
    pub(crate) clock: VirtualClock,
    pub(crate) controller: Controller,
}

impl Speed {
    fn charge(&self, instructions: u64) {
        let Controller { clock_mhz, cycles_per_instruction, .. } = self.controller;
        let us = instructions as f64 * cycles_per_instruction / clock_mhz;
        self.clock.advance_ns((us * 1e3) as u64);
    }
}

/// A key whose checks take their time, and are counted.
#[derive(Debug)]
pub(crate) struct Timed {
    key: PublicKey,
    speed: Speed,
    checked: Rc<Cell<u64>>,
}

impl Trust for Timed {
    fn key(&self) -> Option<[u8; 8]> {
        self.key.key()
    }

    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool {
        self.speed.charge(SIGNATURE_INSTRUCTIONS);
        self.checked.set(self.checked.get() + 1);
        self.key.accepts(statement, signature)
    }
}

/// What a robot's loop is to the updates.
#[derive(Debug, Clone)]
pub(crate) struct Loop {
    pub(crate) robot: String,
    pub(crate) states: usize,
    pub(crate) tick_us: u64,
    pub(crate) sample_us: u64,
    /// Predictions per tick, at most.
    pub(crate) steps: u64,
}

/// Models in the flash of a board.
#[derive(Debug)]
pub(crate) struct Installed {
    flash: Flash,
    factory: Blob,
    key: Option<PublicKey>,
    of: Loop,
    speed: Speed,
    checked: Rc<Cell<u64>>,
}

type Slot = Region<4, SECTOR>;

/// A controller after a reset.
pub(crate) struct Started<'i, A> {
    /// Its end of updates.
    pub(crate) updater: Updater<'i, Slot, Option<Timed>, A>,
    /// The model that was chosen, unless it is that of the factory.
    pub(crate) chosen: Option<Blob>,
    pub(crate) booted: Booted,
}

impl Installed {
    /// What happens after a reset.
    pub(crate) fn boot(&self) -> Started<'_, impl FnMut(Payload) -> bool + use<>> {
        let Loop { robot, states, tick_us, sample_us, steps } = &self.of;
        let Controller { clock_mhz, cycles_per_instruction, tick_instructions } =
            self.speed.controller;
        let tick = *tick_us as f64 * clock_mhz / cycles_per_instruction;
        let left = (tick - f64::from(tick_instructions)).max(1.0) / *steps as f64;
        let (sample_us, left) = (*sample_us as u32, left as u32);
        let capacities = match states {
            2 => Capacities::new::<2, 2>(sample_us, left),
            _ => Capacities::new::<3, 2>(sample_us, left),
        };
        let identity = Identity {
            firmware: concat!("firmware-sim ", env!("CARGO_PKG_VERSION")),
            robot,
            factory: self.factory.bytes(),
            capacities,
            erase_ms: ERASE_MS,
            good_ticks: (GOOD_S * 1e6 / *tick_us as f64) as u32,
        };
        let geometry = Geometry { offset: 0, slot_bytes: SECTOR as u32 };
        let capacities = Capacities { room: geometry.room(), ..capacities };
        let region = || self.flash.region(0..2).expect("these are its sectors");
        let trust = self.key.map(|key| Timed {
            key,
            speed: self.speed.clone(),
            checked: self.checked.clone(),
        });
        let (mut mapped, speed, name) = (region(), self.speed.clone(), robot.clone());
        let accept = move |payload: Payload| {
            speed.charge(u64::from(payload.length) * BLOB_INSTRUCTIONS);
            let Some(blob) = read(&mut mapped, payload) else { return false };
            let bytes = blob.bytes();
            let model = firmware_core::parse_for(&name, bytes);
            model.is_ok_and(|model| capacities.check(&model, bytes.len()).is_ok())
        };
        let booted = Updater::boot(region(), geometry, identity, 0, trust, accept);
        let (updater, Boot { running, payload, trial, floor, .. }) =
            booted.expect("the slots fit the flash");
        let chosen = payload.and_then(|payload| read(&mut region(), payload));
        let sequence = payload.map_or(0, |payload| payload.sequence);
        let at_us = self.speed.clock.now_ns() / 1000;
        Started { updater, chosen, booted: Booted { at_us, running, sequence, trial, floor } }
    }
}

fn read(region: &mut Slot, payload: Payload) -> Option<Blob> {
    let mut bytes = vec![0; payload.length as usize];
    region.read(payload.offset, &mut bytes).ok()?;
    Some(Blob::new(&bytes))
}
