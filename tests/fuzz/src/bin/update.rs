//! Any order of requests, times, commands, resets and power cuts at a controller that takes updates.
//!
//! What must hold, whatever comes: only what was signed for it is installed, runs and is confirmed; what is
//! confirmed stays until something newer is; the running slot is never erased, and nothing is while the robot
//! runs.
#![no_main]

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::convert::Infallible;
use std::rc::Rc;

use embedded_io::{ErrorType as IoErrorType, Read, ReadReady, Write, WriteReady};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use firmware_core::control_loop::{Alarms, Command, ControlLoop as _, Mode};
use firmware_core::link::{Message, Port};
use firmware_core::slots::{Geometry, Payload, Release, Slots, Which, sha256};
use firmware_core::update::{
    Ask, Capacities, Identity, MAX_CHUNK, Purpose, Request, Signature, Trust, Updater, statement,
};
use fuzz::link;
use fuzz::robot::Robot;
use libfuzzer_sys::fuzz_target;

fuzz_target!(
    init: {
        let both = [whole_update(0), whole_update(1)].concat();
        assert_eq!(play(&both).confirmed, BTreeSet::from([3, 4]), "the seeds install models");
        fuzz::seeds([whole_update(0), both, whole_update(3), whole_update(4)])
    },
    |bytes: &[u8]| { play(bytes); }
);

const ROBOT: &str = "robot";
const SECTOR: usize = 512;
const SLOT: usize = 2 * SECTOR;
/// Good ticks that a trial needs.
const GOOD: u32 = 3;

/// What the owner has signed.
struct Signed {
    release: Release,
    blob: Vec<u8>,
}

/// Models that may run, an older one, one that is none, and one of another robot.
fn signed() -> Vec<Signed> {
    let models: [(&str, u32, &[u8], usize); 5] = [
        (ROBOT, 3, b"GOOD", 150),
        (ROBOT, 4, b"GOOD too", 301),
        (ROBOT, 2, b"GOOD once", 64),
        (ROBOT, 5, b"EVIL", 90),
        ("another", 9, b"GOOD elsewhere", 80),
    ];
    let signed = models.map(|(robot, sequence, beginning, length)| {
        let mut blob = beginning.to_vec();
        blob.resize(length, sequence as u8);
        Signed { release: Release::new(robot, sequence, &blob).unwrap(), blob }
    });
    signed.into()
}

/// Stands for Ed25519, which would be slow: what nobody can make but [`sign`].
struct Owner;

fn sign(purpose: Purpose, release: &Release) -> Signature {
    statement(purpose, release).iter().map(|byte| byte.rotate_left(3) ^ 0x5A).collect()
}

impl Trust for Owner {
    fn key(&self) -> Option<[u8; 8]> {
        Some([1; 8])
    }

    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool {
        signature.iter().eq(statement.map(|byte| byte.rotate_left(3) ^ 0x5A).iter())
    }
}

#[derive(Debug)]
struct Dead;

impl NorFlashError for Dead {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

/// The chip, which survives resets.
struct Chip {
    bytes: Vec<u8>,
    /// Words and sectors until the power fails.
    left: Option<u32>,
    /// What a failing power leaves behind.
    torn: u8,
    is_dead: bool,
    mode: Mode,
    /// The slot that runs: must not be erased.
    running: Which,
}

impl Chip {
    fn survives(&mut self) -> bool {
        match &mut self.left {
            Some(0) => self.is_dead = true,
            Some(left) => *left -= 1,
            None => {}
        }
        !self.is_dead
    }
}

#[derive(Clone)]
struct Flash(Rc<RefCell<Chip>>);

impl ErrorType for Flash {
    type Error = Dead;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Dead> {
        let chip = self.0.borrow();
        bytes.copy_from_slice(&chip.bytes[offset as usize..][..bytes.len()]);
        if chip.is_dead { Err(Dead) } else { Ok(()) }
    }

    fn capacity(&self) -> usize {
        2 * SLOT
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Dead> {
        let mut chip = self.0.borrow_mut();
        assert!(chip.mode == Mode::Safe || chip.is_dead, "erased while {:?}", chip.mode);
        let side = if (from as usize) < SLOT { Which::A } else { Which::B };
        assert_ne!(side, chip.running, "the running slot is erased");
        for sector in (from as usize..to as usize).step_by(SECTOR) {
            if chip.is_dead {
                return Err(Dead);
            }
            let survives = chip.survives();
            let torn = chip.torn;
            for byte in &mut chip.bytes[sector..sector + SECTOR] {
                *byte = if survives { 0xFF } else { *byte | torn };
            }
        }
        if chip.is_dead { Err(Dead) } else { Ok(()) }
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Dead> {
        let mut chip = self.0.borrow_mut();
        for (at, word) in (offset as usize..).step_by(4).zip(bytes.chunks(4)) {
            if chip.is_dead {
                return Err(Dead);
            }
            assert!(chip.bytes[at..at + 4].iter().all(|byte| *byte == 0xFF), "written twice");
            assert_ne!(chip.mode, Mode::Running, "written while the robot runs");
            let mask = if chip.survives() { 0 } else { chip.torn };
            for (place, byte) in chip.bytes[at..].iter_mut().zip(word) {
                *place = byte | mask;
            }
        }
        if chip.is_dead { Err(Dead) } else { Ok(()) }
    }
}

/// What has arrived.
struct Line(Vec<u8>);

impl IoErrorType for Line {
    type Error = Infallible;
}

impl Read for Line {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        let count = bytes.len().min(self.0.len());
        for (to, from) in bytes.iter_mut().zip(self.0.drain(..count)) {
            *to = from;
        }
        Ok(count)
    }
}

impl ReadReady for Line {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(!self.0.is_empty())
    }
}

/// What is said.
struct Out<'o>(&'o mut Vec<u8>);

impl IoErrorType for Out<'_> {
    type Error = Infallible;
}

impl Write for Out<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.0.extend(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl WriteReady for Out<'_> {
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(true)
    }
}

/// What comes next out of the input; zeros at its end.
struct Input<'b>(&'b [u8]);

impl Input<'_> {
    fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }
}

/// What has been allowed so far.
#[derive(Default)]
struct Allowed {
    activated: BTreeSet<u32>,
    confirmed: BTreeSet<u32>,
}

/// Plays an input, a list of operations; what the owner has allowed on the way.
fn play(bytes: &[u8]) -> Allowed {
    let chip = Chip {
        bytes: vec![0xFF; 2 * SLOT],
        left: None,
        torn: 0,
        is_dead: false,
        mode: Mode::Idle,
        running: Which::Factory,
    };
    let flash = Flash(Rc::new(RefCell::new(chip)));
    let (signed, mut allowed) = (signed(), Allowed::default());
    let mut input = Input(bytes);
    while !input.0.is_empty() {
        boot(&flash, &signed, &mut allowed, &mut input);
    }
    allowed
}

/// From one reset to the next.
fn boot(flash: &Flash, signed: &[Signed], allowed: &mut Allowed, input: &mut Input<'_>) {
    {
        let mut chip = flash.0.borrow_mut();
        (chip.left, chip.is_dead, chip.mode, chip.running) =
            (None, false, Mode::Idle, Which::Factory);
    }
    let mut mapped = flash.clone();
    let accept = move |payload: Payload| {
        let mut bytes = vec![0; payload.length as usize];
        mapped.read(payload.offset, &mut bytes).is_ok() && bytes.starts_with(b"GOOD")
    };
    let identity = Identity {
        firmware: "fuzz",
        robot: ROBOT,
        factory: b"GOOD since ever",
        capacities: Capacities::new::<2, 2>(10_000, 0),
        erase_ms: 1,
        good_ticks: GOOD,
    };
    let geometry = Geometry { offset: 0, slot_bytes: SLOT as u32 };
    let booted = Updater::boot(flash.clone(), geometry, identity, 0, Owner, accept);
    let (mut updater, boot) = booted.expect("the geometry is right");
    let release = updater.slots().release();
    match boot.payload {
        None => assert_eq!(boot.running, Which::Factory),
        Some(payload) => {
            let bytes = flash.0.borrow().bytes[payload.offset as usize..]
                [..payload.length as usize]
                .to_vec();
            let of = signed.iter().find(|s| Some(s.release) == release).expect("it was signed");
            assert_eq!(bytes, of.blob, "whole");
            assert_eq!(sha256(&bytes), of.release.sha256);
            assert!(bytes.starts_with(b"GOOD") && of.release.robot == signed[0].release.robot);
            assert!(allowed.activated.contains(&payload.sequence), "nobody activated it");
            assert!(boot.trial || allowed.confirmed.contains(&payload.sequence));
        }
    }
    // The newest that is confirmed for certain; what was confirmed in a failing power may not be.
    flash.0.borrow_mut().running = boot.running;
    let (mut floor, mut good) = (boot.floor, 0_u32);
    let mut robot = Robot::default();
    let (mut port, mut now_us, mut number) = (Port::new(), 0_u64, 1_u8);
    let mut frames = heapless::spsc::Queue::<_, 2>::new();
    let (_, mut frames) = frames.split();
    while !input.0.is_empty() {
        let before = flash.0.borrow().bytes.clone();
        let mut line = Line(Vec::new());
        let was = robot.mode();
        match input.byte() % 16 {
            0..=8 => {
                let ask = ask(input, signed, updater.slots());
                number =
                    if input.byte().is_multiple_of(4) { number } else { number.wrapping_add(1) };
                let may_confirm = good >= GOOD && robot.mode() != Mode::Running;
                note(&ask, &updater, allowed, may_confirm);
                line.0 = link::frame(&Message::Request(Request { number, ask }));
            }
            9 => line.0 = (0..input.byte()).map(|_| input.byte()).collect(),
            10 => {
                let command =
                    [Command::Start, Command::Stop, Command::Reset, Command::Inputs([0.0; 2])];
                line.0 = link::frame(&command[usize::from(input.byte() % 4)].into());
            }
            11 => now_us += u64::from(input.byte()) * 50_000,
            12 => {
                for _ in 0..input.byte() % 8 {
                    updater.ticked(Alarms::none());
                    good += 1;
                }
            }
            13 => {
                updater.ticked(Alarms::DIVERGED);
                good = 0;
            }
            14 => {
                let mut chip = flash.0.borrow_mut();
                (chip.left, chip.torn) = (Some(u32::from(input.byte())), input.byte());
            }
            _ => return,
        }
        now_us += 100;
        // The loop's tick, and what it takes to read what has come and to do one thing.
        for _ in 0..4 {
            flash.0.borrow_mut().mode = robot.mode();
            port.receive(&mut line, &mut robot, &mut updater, now_us);
            let mut out = Vec::new();
            port.send(&mut frames, &mut Out(&mut out));
            robot.finish(now_us);
            assert!(out.len() <= 2 * firmware_core::link::MAX_FRAME);
        }
        if was == Mode::Running {
            assert_eq!(flash.0.borrow().bytes, before, "nothing is touched while the robot runs");
            assert_ne!(robot.mode(), Mode::Safe, "nobody stops it from here");
        }
        assert!(updater.slots().floor() >= floor);
        floor = updater.slots().floor();
        assert_eq!(updater.slots().running(), boot.running);
        if updater.slots().is_committed() {
            let release = updater.slots().update();
            let of = signed.iter().find(|s| Some(s.release) == release).expect("it was signed");
            assert!(of.blob.starts_with(b"GOOD"), "what is no model is committed");
        }
        if flash.0.borrow().is_dead || (updater.resets() && port.is_sent()) {
            return;
        }
    }
}

/// Takes note of what an honest controller may do after this.
fn note<F: NorFlash, A: FnMut(Payload) -> bool>(
    ask: &Ask,
    updater: &Updater<'_, F, Owner, A>,
    allowed: &mut Allowed,
    may_confirm: bool,
) {
    match ask {
        Ask::Activate { signature, .. } => {
            if let Some(release) = updater.slots().update()
                && *signature == sign(Purpose::Activate, &release)
            {
                allowed.activated.insert(release.sequence);
            }
        }
        Ask::Confirm { signature } => {
            if let Some(release) = updater.slots().release()
                && updater.slots().on_trial()
                && may_confirm
                && *signature == sign(Purpose::Confirm, &release)
            {
                allowed.confirmed.insert(release.sequence);
            }
        }
        _ => {}
    }
}

/// A request: mostly one that could be right.
fn ask<F: NorFlash>(input: &mut Input<'_>, signed: &[Signed], slots: &Slots<F>) -> Ask {
    let kind = input.byte();
    let of = &signed[usize::from(input.byte()) % signed.len()];
    let session = u32::from(kind >> 6);
    let choice = input.byte();
    let mut release = of.release;
    if choice & 0x40 != 0 {
        // Something else than was signed.
        match input.byte() % 4 {
            0 => release.length = u32::from(input.byte()) << (input.byte() % 24),
            1 => release.sequence ^= 1 << (input.byte() % 32),
            2 => release.sha256[usize::from(input.byte() % 32)] ^= 1,
            _ => release.robot = input.byte().into(),
        }
    }
    let own = |purpose| sign(purpose, &of.release);
    let signature = |right: Purpose| match choice % 8 {
        0..=4 => own(right),
        5 => own(Purpose::ALL[usize::from(choice >> 4) % 4]),
        6 => Signature::new(),
        _ => own(right).into_iter().take(63).collect(),
    };
    match kind % 8 {
        0 => Ask::Hello,
        1 => Ask::Begin { session, release, signature: signature(Purpose::Install) },
        2 | 3 => {
            let written = slots.written().unwrap_or(0);
            let offset = if choice & 0x40 != 0 { input.byte().into() } else { written };
            let rest = of.blob.get(offset as usize..).unwrap_or(&[]);
            let mut bytes: heapless::Vec<u8, MAX_CHUNK> =
                rest.iter().copied().take(usize::from(input.byte())).take(MAX_CHUNK).collect();
            if choice & 0x80 != 0
                && let Some(byte) = bytes.first_mut()
            {
                *byte ^= 1;
            }
            Ask::Chunk { session, offset, bytes }
        }
        4 => Ask::Verify { session },
        5 => Ask::Activate { session, signature: signature(Purpose::Activate) },
        6 => Ask::Confirm { signature: signature(Purpose::Confirm) },
        _ => Ask::Abort { session, signature: signature(Purpose::Abort) },
    }
}

/// An input that installs a model, from the first request to its confirmation, and resets.
fn whole_update(which: u8) -> Vec<u8> {
    let request = |kind: u8, rest: &[u8]| [&[0, kind, which, 0][..], rest, &[1]].concat();
    let mut bytes = request(1, &[]);
    for _ in 0..4 {
        bytes.extend(request(2, &[192]));
    }
    bytes.extend(request(4, &[]));
    bytes.extend(request(5, &[]));
    bytes.extend([12, 7]);
    bytes.extend(request(6, &[]));
    bytes.push(15);
    bytes
}
