//! Strangers on the line of a controller that takes updates: what they ask is refused, the model stays, and
//! the loop goes on in time.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::path::Path;
use std::rc::Rc;

use ed25519_compact::{KeyPair, Seed};
use embedded_io::{Read, ReadReady, Write};
use firmware_core::control_loop::{Alarms, Command, Frame, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_core::slots::{Release, Which};
use firmware_core::update::{
    Answer, Ask, MAX_CHUNK, PublicKey, Purpose, Refused, Request, SIGNATURE_PAUSE_US, Say,
    Signature, statement,
};
use firmware_sim::mcu::UartEnd;
use firmware_sim::run::host::{Counts, Laptop};
use firmware_sim::run::scenario::{Controller, Scenario};
use firmware_sim::run::store::{LINE_INSTRUCTIONS, Store};
use firmware_sim::run::summary::Summary;
use firmware_sim::run::{Blob, run_with};
use rand::RngExt;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const SESSION: u32 = 0x5E55_1011;

fn blob(name: &str) -> Blob {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").join(name);
    Blob::read(&path.join("model.bin")).unwrap()
}

fn pair(seed: u8) -> KeyPair {
    KeyPair::from_seed(Seed::new([seed; 32]))
}

/// The owner's key.
fn owner() -> KeyPair {
    pair(1)
}

fn key() -> PublicKey {
    PublicKey(*owner().pk)
}

fn sign(pair: &KeyPair, purpose: Purpose, release: &Release) -> Signature {
    pair.sk.sign(statement(purpose, release), None).iter().copied().collect()
}

fn release(blob: &Blob, sequence: u32) -> Release {
    let model = blob.model().unwrap();
    Release::new(model.structure().robot(), sequence, blob.bytes()).unwrap()
}

/// What a host does, one after the other.
#[derive(Clone, Debug)]
enum Step {
    /// Asks, and waits for the answer.
    Ask(Ask),
    /// Sends bytes and waits for an answer of number 0.
    Bytes(Vec<u8>),
    /// Sends a command.
    Command(Command<2>),
    /// Waits (µs).
    Wait(u64),
}

#[derive(Default)]
struct Heard {
    /// What came of each step; `None` without an answer within ten seconds.
    answers: Vec<Option<Say>>,
    frames: Vec<Frame>,
    /// When the last step was over (µs).
    done_us: u64,
}

/// A host that goes through its steps.
struct Hand {
    end: UartEnd,
    receiver: Receiver,
    steps: Vec<Step>,
    at: usize,
    /// When the present step began (µs).
    began_us: Option<u64>,
    outgoing: VecDeque<u8>,
    heard: Rc<RefCell<Heard>>,
}

impl Hand {
    fn send(&mut self, message: &Message) {
        let mut bytes = [0; MAX_FRAME];
        let length = encode(message, &mut bytes).unwrap();
        self.outgoing.extend(&bytes[..length]);
    }
}

impl Laptop for Hand {
    fn turn(
        &mut self,
        now_us: u64,
        frame: &mut dyn FnMut(&Frame) -> std::io::Result<()>,
    ) -> std::io::Result<()> {
        let mut answers = Vec::new();
        let mut bytes = [0; 256];
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            for byte in &bytes[..count] {
                match self.receiver.push(*byte) {
                    Some(Received::Message(Message::Frame(received))) => {
                        frame(&received)?;
                        self.heard.borrow_mut().frames.push(received);
                    }
                    Some(Received::Message(Message::Answer(answer))) => answers.push(answer),
                    Some(other) => panic!("a clean line: {other:?}"),
                    None => {}
                }
            }
        }
        let Some(step) = self.steps.get(self.at).cloned() else { return Ok(()) };
        let number = match step {
            Step::Ask(_) => self.at as u8 + 1,
            _ => 0,
        };
        let mut over = None;
        for Answer { number: of, say } in answers {
            if of == number && !matches!(say, Say::Working { .. }) && self.began_us.is_some() {
                over = Some(Some(say));
            }
        }
        match self.began_us {
            None => {
                self.began_us = Some(now_us);
                match &step {
                    Step::Ask(ask) => {
                        let request = Request { number, ask: ask.clone() };
                        self.send(&Message::Request(request));
                    }
                    Step::Bytes(bytes) => self.outgoing.extend(bytes),
                    Step::Command(command) => self.send(&(*command).into()),
                    Step::Wait(_) => {}
                }
            }
            Some(began_us) => match step {
                Step::Command(_) => over = Some(None),
                Step::Wait(us) if now_us - began_us >= us => over = Some(None),
                Step::Wait(_) => {}
                _ if now_us - began_us > 10_000_000 => over = Some(None),
                _ => {}
            },
        }
        let sent = self.end.write(self.outgoing.make_contiguous()).unwrap_or(0);
        self.outgoing.drain(..sent);
        if let Some(answer) = over {
            let mut heard = self.heard.borrow_mut();
            heard.answers.push(answer);
            heard.done_us = now_us;
            self.at += 1;
            self.began_us = None;
        }
        Ok(())
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }
}

/// Every tick is charged for as much as a full line can bring in it.
fn scenario(seconds: f64) -> Scenario {
    let usual = Controller::default();
    let tick_instructions = usual.tick_instructions + 128 * LINE_INSTRUCTIONS;
    let controller = Controller { tick_instructions, ..usual };
    Scenario { seconds, controller, ..Scenario::random(16.0) }
}

/// Goes through the steps on a ROSbot at rest; what was said, and what the run showed.
fn go(store: &mut Store, seconds: f64, steps: &[Step]) -> (Heard, Summary) {
    go_on("skid-rosbot", store, seconds, steps)
}

/// The same on another robot.
fn go_on(robot: &str, store: &mut Store, seconds: f64, steps: &[Step]) -> (Heard, Summary) {
    let factory = blob(robot);
    let scenario = scenario(seconds);
    let heard = Rc::new(RefCell::new(Heard::default()));
    let laptop = |end| Hand {
        end,
        receiver: Receiver::new(),
        steps: steps.to_vec(),
        at: 0,
        began_us: None,
        outgoing: VecDeque::new(),
        heard: heard.clone(),
    };
    let summary = run_with(&factory.model().unwrap(), &scenario, 1, store, laptop).unwrap();
    (heard.take(), summary)
}

fn ask(asks: &[Ask]) -> Vec<Step> {
    asks.iter().cloned().map(Step::Ask).collect()
}

fn begin(session: u32, release: Release, signature: Signature) -> Ask {
    Ask::Begin { session, release, signature }
}

fn chunk(session: u32, offset: usize, bytes: &[u8]) -> Ask {
    let bytes = bytes.iter().copied().take(MAX_CHUNK).collect();
    Ask::Chunk { session, offset: offset as u32, bytes }
}

/// Everything that the owner says until the controller resets.
fn update(blob: &Blob, sequence: u32) -> Vec<Ask> {
    let release = release(blob, sequence);
    let chunks = blob.bytes().chunks(MAX_CHUNK).enumerate();
    let chunks = chunks.map(|(i, bytes)| chunk(SESSION, i * MAX_CHUNK, bytes));
    let signature = |purpose| sign(&owner(), purpose, &release);
    [begin(SESSION, release, signature(Purpose::Install))]
        .into_iter()
        .chain(chunks)
        .chain([
            Ask::Verify { session: SESSION },
            Ask::Activate { session: SESSION, signature: signature(Purpose::Activate) },
        ])
        .collect()
}

fn refused(answers: &[Option<Say>]) -> Vec<Refused> {
    let refused = answers.iter().map(|answer| match answer {
        Some(Say::Refused(refused)) => *refused,
        other => panic!("not refused: {other:?} of {answers:?}"),
    });
    refused.collect()
}

/// A blob that differs from the factory's, so that it is seen which one runs.
fn other_model() -> Blob {
    other_model_of("skid-rosbot")
}

fn other_model_of(robot: &str) -> Blob {
    let mut bytes = blob(robot).bytes().to_vec();
    // A tolerance of the self-test: that section ends where its table says.
    let entry = bytes[16..].chunks(12).find(|entry| entry[..2] == [3, 0]).unwrap();
    let number = |at: usize| u32::from_le_bytes(entry[at..at + 4].try_into().unwrap()) as usize;
    let end = number(4) + number(8);
    bytes[end - 4] ^= 1;
    let crc = crc32(&[&bytes[..12], &bytes[16..]].concat());
    bytes[12..16].copy_from_slice(&crc.to_le_bytes());
    let blob = Blob::new(&bytes);
    blob.model().unwrap();
    blob
}

/// CRC-32/ISO-HDLC, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

/// The owner installs a model, which is confirmed after its trial.
fn installed(sequence: u32) -> Store {
    installed_on("skid-rosbot", sequence)
}

fn installed_on(robot: &str, sequence: u32) -> Store {
    let mut store = Store::new(&blob(robot), Some(key()));
    let new = other_model_of(robot);
    let confirm = sign(&owner(), Purpose::Confirm, &release(&new, sequence));
    let mut steps = ask(&update(&new, sequence));
    steps.push(Step::Wait(12_000_000));
    steps.push(Step::Ask(Ask::Confirm { signature: confirm }));
    let (heard, summary) = go_on(robot, &mut store, 20.0, &steps);
    assert_eq!(heard.answers.last(), Some(&Some(Say::Confirmed)), "{:?}", heard.answers);
    assert_eq!(summary.driven_at_rest, 0);
    let boots: Vec<_> = store.boots.iter().map(|b| (b.running, b.sequence, b.trial)).collect();
    assert_eq!(boots, [(Which::Factory, 0, false), (Which::A, sequence, true)]);
    store
}

#[test]
fn the_owner_installs_a_model() {
    let mut store = installed(5);
    let (heard, summary) = go(&mut store, 2.0, &ask(&[Ask::Hello]));
    let Some(Some(Say::Hello(hello))) = heard.answers.first() else { panic!() };
    assert_eq!((hello.which, hello.floor, hello.trial), (Which::A, 5, None));
    assert_eq!(hello.release, release(&other_model(), 5));
    assert_eq!((hello.name.as_str(), hello.mode), ("skid-rosbot", Mode::Idle));
    assert_eq!(hello.key.as_ref().map(|key| &key[..]), Some(&owner().pk[..8]));
    assert_eq!((summary.deadline_misses, summary.resets), (0, 0));
}

#[test]
fn whoever_has_no_signed_release_is_refused_at_rest() {
    let mut store = installed(5);
    let (image, boots) = (store.image.clone(), store.boots.len());
    let new = blob("skid-rosbot");
    let right = release(&new, 6);
    let signed = |release: &Release| sign(&owner(), Purpose::Install, release);
    let with = |release: Release| begin(SESSION, release, signed(&release));
    let pause = Step::Wait(SIGNATURE_PAUSE_US + 100_000);
    let mut garbage = [7; 300];
    garbage[299] = 0;
    let mut strange = vec![9, 1, 2, 3];
    strange.extend(crc32(&strange).to_le_bytes());
    let mut frame = vec![0; strange.len() + 2];
    // COBS of bytes without a zero.
    assert!(!strange.contains(&0), "{strange:?}");
    frame[0] = strange.len() as u8 + 1;
    frame[1..=strange.len()].copy_from_slice(&strange);

    let room = 128 * 1024 - 320;
    let robot = right.robot;
    let forged = sign(&pair(2), Purpose::Install, &right);
    let of_another = sign(&owner(), Purpose::Activate, &right);
    let older = Refused::BelowFloor { floor: 5 };
    let ms = SIGNATURE_PAUSE_US as u32 / 1000;
    let attacks: Vec<(&str, Step, Refused)> = vec![
        ("unsigned", Step::Ask(begin(1, right, Signature::new())), Refused::Signature),
        (
            "half signed",
            Step::Ask(begin(1, right, signed(&right)[..63].iter().copied().collect())),
            Refused::Signature,
        ),
        ("wrong key", Step::Ask(begin(1, right, forged.clone())), Refused::Signature),
        ("at once again", Step::Ask(begin(1, right, forged)), Refused::Pause { ms }),
        ("another purpose", Step::Ask(begin(1, right, of_another)), Refused::Signature),
        (
            "another length",
            Step::Ask(begin(1, Release { length: 4, ..right }, signed(&right))),
            Refused::Signature,
        ),
        (
            "another blob",
            Step::Ask(begin(1, Release { sha256: [1; 32], ..right }, signed(&right))),
            Refused::Signature,
        ),
        (
            "another number",
            Step::Ask(begin(1, Release { sequence: 7, ..right }, signed(&right))),
            Refused::Signature,
        ),
        ("older", Step::Ask(with(release(&new, 4))), older),
        (
            "another robot",
            Step::Ask(with(Release { robot: 1, ..right })),
            Refused::AnotherRobot { robot },
        ),
        (
            "oversize",
            Step::Ask(with(Release { length: room + 1, ..right })),
            Refused::Length { room },
        ),
        (
            "endless",
            Step::Ask(with(Release { length: u32::MAX, ..right })),
            Refused::Length { room },
        ),
        ("empty", Step::Ask(with(Release { length: 0, ..right })), Refused::Length { room }),
        ("chunk", Step::Ask(chunk(SESSION, 0, &[1])), Refused::NoSession),
        ("verify", Step::Ask(Ask::Verify { session: SESSION }), Refused::NoSession),
        (
            "activate",
            Step::Ask(Ask::Activate {
                session: SESSION,
                signature: sign(&owner(), Purpose::Activate, &right),
            }),
            Refused::NoSession,
        ),
        (
            "abort",
            Step::Ask(Ask::Abort {
                session: SESSION,
                signature: sign(&owner(), Purpose::Abort, &right),
            }),
            Refused::NoSession,
        ),
        (
            "confirm",
            Step::Ask(Ask::Confirm { signature: sign(&owner(), Purpose::Confirm, &right) }),
            Refused::NotOnTrial,
        ),
        ("too long", Step::Bytes(garbage.to_vec()), Refused::TooLong { most: MAX_FRAME as u32 }),
        ("unknown", Step::Bytes(frame), Refused::Unknown { variant: 9 }),
    ];
    let mut steps = Vec::new();
    for (name, step, expected) in &attacks {
        if *expected == Refused::Signature && !["unsigned", "half signed"].contains(name) {
            steps.push(pause.clone());
        }
        steps.push(step.clone());
    }
    let (heard, summary) = go(&mut store, 20.0, &steps);
    assert_eq!(heard.answers.len(), steps.len(), "everything was asked");
    let answers: Vec<_> = heard
        .answers
        .into_iter()
        .zip(&steps)
        .filter(|(_, s)| !matches!(s, Step::Wait(_)))
        .collect();
    for ((name, _, expected), (answer, _)) in attacks.iter().zip(&answers) {
        let found = refused(std::slice::from_ref(answer))[0];
        match (found, expected) {
            (Refused::Pause { ms: found }, Refused::Pause { ms }) => {
                assert!(found <= *ms && found > 0)
            }
            _ => assert_eq!(found, *expected, "{name}"),
        }
    }
    // Nothing has happened.
    assert_eq!(store.image, image);
    let after = &store.boots[boots..];
    assert_eq!(after.iter().map(|b| (b.running, b.trial)).collect::<Vec<_>>(), [(Which::A, false)]);
    assert!(heard.frames.len() > 190);
    for frame in &heard.frames {
        assert_eq!(frame.mode, Mode::Idle, "a stranger holds nobody in Safe");
        assert!(!frame.alarms.intersects(Alarms::SAFE | Alarms::UPDATE), "{:?}", frame.alarms);
    }
    // The loop misses no deadline while signatures are checked: a tick or two are left out.
    assert_eq!((summary.deadline_misses, summary.driven_at_rest, summary.resets), (0, 0, 0));
    assert_eq!(store.signatures - 3, 5, "one per second at most");
}

/// A signature takes longer than several of its ticks.
#[test]
fn a_leg_leaves_ticks_out_for_updates_and_is_not_late() {
    let mut store = installed_on("soft-leg", 5);
    let (image, signatures) = (store.image.clone(), store.signatures);
    let forged = sign(&pair(2), Purpose::Install, &release(&blob("soft-leg"), 6));
    let forged = begin(1, release(&blob("soft-leg"), 6), forged);
    let wait = Step::Wait(1_100_000);
    let steps = [wait.clone(), Step::Ask(forged.clone()), wait.clone(), Step::Ask(forged), wait];
    let (heard, summary) = go_on("soft-leg", &mut store, 5.0, &steps);
    let answers: Vec<_> = heard.answers.into_iter().flatten().map(Some).collect();
    assert_eq!(refused(&answers), [Refused::Signature; 2]);
    assert_eq!(store.signatures - signatures, 2);
    assert!(store.image == image);
    assert!(heard.frames.len() > 90);
    for frame in &heard.frames {
        assert_eq!((frame.mode, frame.alarms), (Mode::Idle, Alarms::none()));
        assert_eq!(frame.noticed, Alarms::none());
    }
    assert_eq!((summary.deadline_misses, summary.driven_at_rest, summary.resets), (0, 0, 0));
    // Some at boot, and for each of the two signatures.
    let left_out = 2_500 - summary.ticks;
    assert!((12..60).contains(&left_out), "{left_out}");
}

#[test]
fn while_the_robot_runs_nothing_is_looked_at() {
    let mut store = installed(5);
    let (image, signatures) = (store.image.clone(), store.signatures);
    let new = blob("skid-rosbot");
    // All of it would be accepted at rest.
    let mut asks = update(&new, 6);
    let later = release(&new, 6);
    asks.push(Ask::Confirm { signature: sign(&owner(), Purpose::Confirm, &later) });
    asks.push(Ask::Abort { session: SESSION, signature: sign(&owner(), Purpose::Abort, &later) });
    let drive = Step::Command(Command::Inputs([6.0, 8.0]));
    let mut steps = vec![Step::Wait(1_000_000), Step::Command(Command::Start)];
    for ask in asks.iter().cycle().take(180) {
        steps.extend([Step::Ask(ask.clone()), drive.clone()]);
    }
    let (heard, summary) = go(&mut store, 12.0, &steps);
    assert_eq!(heard.answers.len(), steps.len());
    let answers: Vec<_> =
        heard.answers.into_iter().zip(&steps).filter(|(_, s)| matches!(s, Step::Ask(_))).collect();
    assert_eq!(answers.len(), 180);
    for (answer, step) in answers {
        assert_eq!(answer, Some(Say::Refused(Refused::Busy)), "{step:?}");
    }
    assert_eq!((&store.image, store.signatures), (&image, signatures));
    let modes: Vec<_> = heard.frames.iter().map(|frame| frame.mode).collect();
    let started = modes.iter().position(|mode| *mode == Mode::Running).unwrap();
    let until = heard.frames.iter().rposition(|f| f.time_us <= heard.done_us).unwrap();
    assert!(
        started < 15 && until > 40 && modes[started..until].iter().all(|m| *m == Mode::Running)
    );
    assert_eq!((summary.deadline_misses, summary.driven_at_rest, summary.resets), (0, 0, 0));
}

/// A flood of everything at once, as fast as the line goes.
struct Flood {
    end: UartEnd,
    rng: ChaCha8Rng,
    asks: Vec<Ask>,
    next_us: u64,
    starts: bool,
    receiver: Receiver,
    frames: Rc<RefCell<Vec<Frame>>>,
}

impl Laptop for Flood {
    fn turn(
        &mut self,
        now_us: u64,
        frame: &mut dyn FnMut(&Frame) -> std::io::Result<()>,
    ) -> std::io::Result<()> {
        let mut bytes = [0; 256];
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            for byte in &bytes[..count] {
                if let Some(Received::Message(Message::Frame(received))) = self.receiver.push(*byte)
                {
                    frame(&received)?;
                    self.frames.borrow_mut().push(received);
                }
            }
        }
        let mut send = |message: &Message| {
            let mut bytes = [0; MAX_FRAME];
            let length = encode(message, &mut bytes).unwrap();
            let _ = self.end.write(&bytes[..length]);
        };
        // Who drives comes first, or his commands find the line full.
        if now_us >= self.next_us {
            self.next_us += 50_000;
            if self.starts && now_us > 1_000_000 {
                send(&Message::Start);
            }
            send(&Command::Inputs([7.0, 5.0]).into());
        }
        while self.end.outgoing().sent < now_us / 18 {
            let ask = self.asks[self.rng.random_range(0..self.asks.len())].clone();
            let number = self.rng.random();
            let mut bytes = [0; MAX_FRAME];
            let mut length =
                encode(&Message::Request(Request { number, ask }), &mut bytes).unwrap();
            match self.rng.random_range(0..4) {
                // Flipped bits, a lost end, anything.
                0 => bytes[self.rng.random_range(0..length)] ^= 1 << self.rng.random_range(0..8),
                1 => length = self.rng.random_range(1..=length),
                2 => self.rng.fill(&mut bytes[..length]),
                _ => {}
            }
            if !matches!(self.end.write(&bytes[..length]), Ok(written) if written == length) {
                break;
            }
        }
        Ok(())
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }
}

#[test]
fn a_flood_of_everything_neither_stops_a_running_robot_nor_changes_its_model() {
    let mut store = installed(5);
    let (image, signatures) = (store.image.clone(), store.signatures);
    let new = blob("skid-rosbot");
    let mut asks = update(&new, 6);
    asks.push(Ask::Hello);
    let factory = blob("skid-rosbot");
    let scenario = scenario(60.0);
    let frames = Rc::new(RefCell::new(Vec::new()));
    let laptop = |end| Flood {
        end,
        rng: ChaCha8Rng::seed_from_u64(1),
        asks,
        next_us: 0,
        starts: true,
        receiver: Receiver::new(),
        frames: frames.clone(),
    };
    let summary = run_with(&factory.model().unwrap(), &scenario, 1, &mut store, laptop).unwrap();
    let frames = frames.take();
    assert_eq!((summary.deadline_misses, summary.driven_at_rest, summary.resets), (0, 0, 0));
    assert_eq!((&store.image, store.signatures), (&image, signatures));
    assert!(frames.len() > 300, "answers leave room for telemetry: {}", frames.len());
    assert!(summary.time_s[1] > 55.0, "it runs: {:?}", summary.time_s);
    assert!(frames.iter().all(|frame| !frame.alarms.contains(Alarms::UPDATE)));
}

#[test]
fn sessions_do_not_mix_and_what_is_replayed_is_not_written_twice() {
    let mut store = installed(5);
    let new = blob("skid-rosbot");
    let right = release(&new, 6);
    let (other, stranger) = (release(&other_model(), 7), 77);
    let signature = |purpose| sign(&owner(), purpose, &right);
    let (before, after): (Vec<_>, Vec<_>) = (update(&new, 6), Vec::<Ask>::new());
    assert!(after.is_empty());
    // After two chunks the stranger tries, who knows what was on the line so far.
    let mut steps = ask(&before[..3]);
    let attacks: Vec<(Ask, Refused)> = vec![
        (before[1].clone(), Refused::OutOfOrder { written: 384 }),
        (before[2].clone(), Refused::OutOfOrder { written: 384 }),
        (chunk(SESSION, 385, &[1, 2, 3]), Refused::OutOfOrder { written: 384 }),
        (chunk(stranger, 384, &[1, 2, 3]), Refused::NoSession),
        (begin(stranger, right, signature(Purpose::Install)), Refused::InUse),
        (begin(stranger, other, sign(&owner(), Purpose::Install, &other)), Refused::InUse),
        (Ask::Verify { session: SESSION }, Refused::Incomplete { written: 384 }),
        (
            Ask::Activate { session: stranger, signature: signature(Purpose::Activate) },
            Refused::NoSession,
        ),
        // Of what was heard nothing activates or aborts.
        (
            Ask::Activate { session: SESSION, signature: signature(Purpose::Install) },
            Refused::Signature,
        ),
        (
            Ask::Abort { session: SESSION, signature: signature(Purpose::Install) },
            Refused::Pause { ms: 0 },
        ),
        (Ask::Confirm { signature: signature(Purpose::Install) }, Refused::NotOnTrial),
    ];
    steps.extend(ask(&attacks.iter().map(|(ask, _)| ask.clone()).collect::<Vec<_>>()));
    steps.push(Step::Wait(SIGNATURE_PAUSE_US + 100_000));
    steps.push(Step::Ask(Ask::Abort { session: SESSION, signature: Signature::new() }));
    steps.extend(ask(&before[3..before.len() - 1]));
    // Verified: the stranger activates with what was heard.
    steps.push(Step::Ask(Ask::Activate {
        session: SESSION,
        signature: signature(Purpose::Install),
    }));
    steps.push(Step::Wait(SIGNATURE_PAUSE_US + 100_000));
    steps.extend(ask(&before[before.len() - 1..]));
    // On trial: nobody but the owner confirms, and not too early.
    let confirm = signature(Purpose::Confirm);
    steps.push(Step::Wait(1_000_000));
    steps.push(Step::Ask(Ask::Confirm { signature: confirm }));
    steps.push(Step::Wait(11_000_000));
    steps.push(Step::Ask(Ask::Confirm { signature: signature(Purpose::Activate) }));
    let (heard, summary) = go(&mut store, 40.0, &steps);
    assert_eq!(heard.answers.len(), steps.len());
    let found = refused(&heard.answers[3..3 + attacks.len()]);
    for (found, (ask, expected)) in found.iter().zip(&attacks) {
        match (found, expected) {
            (Refused::Pause { .. }, Refused::Pause { .. }) => {}
            _ => assert_eq!(found, expected, "{ask:?}"),
        }
    }
    let rest = &heard.answers[3 + attacks.len()..];
    assert_eq!(rest[1], Some(Say::Refused(Refused::Signature)));
    assert_eq!(rest[rest.len() - 8], Some(Say::Verified), "{rest:?}");
    assert_eq!(rest[rest.len() - 7], Some(Say::Refused(Refused::Signature)));
    assert_eq!(rest[rest.len() - 5], Some(Say::Activated));
    assert!(matches!(rest[rest.len() - 3], Some(Say::Refused(Refused::TooEarly { .. }))));
    assert_eq!(rest[rest.len() - 1], Some(Say::Refused(Refused::Signature)));
    let boots: Vec<_> = store.boots[2..].iter().map(|b| (b.running, b.sequence, b.trial)).collect();
    assert_eq!(boots, [(Which::A, 5, false), (Which::B, 6, true)]);
    // The blob is that of the owner, byte by byte.
    assert_eq!(&store.image[128 * 1024 + 320..][..new.bytes().len()], new.bytes());
    assert_eq!((summary.deadline_misses, summary.driven_at_rest, summary.resets), (0, 0, 1));
    // Not confirmed: the next boot drops it.
    go(&mut store, 1.0, &[]);
    let last = store.boots.last().unwrap();
    assert_eq!((last.running, last.sequence, last.trial), (Which::A, 5, false));
}

#[test]
fn a_session_that_says_nothing_ends_and_its_robot_can_be_used_again() {
    let mut store = Store::new(&blob("skid-rosbot"), Some(key()));
    let new = other_model();
    let update = update(&new, 6);
    let mut steps = ask(&update[..3]);
    // Held while the session is alive, whatever is commanded; free after it.
    steps.extend([Step::Command(Command::Reset), Step::Command(Command::Start)]);
    steps.push(Step::Wait(6_000_000));
    steps.push(Step::Ask(update[3].clone()));
    steps.extend([Step::Command(Command::Reset), Step::Command(Command::Start)]);
    steps.push(Step::Wait(200_000));
    steps.push(Step::Command(Command::Stop));
    // Somebody goes on with it, by a session of his own, without an erase.
    let again = release(&new, 6);
    steps.push(Step::Ask(begin(9, again, sign(&owner(), Purpose::Install, &again))));
    let (heard, summary) = go(&mut store, 15.0, &steps);
    let count = heard.answers.len();
    assert_eq!(heard.answers[6], Some(Say::Refused(Refused::NoSession)));
    assert_eq!(heard.answers[count - 1], Some(Say::Begun { written: 384 }));
    let modes = |from: f64, to: f64| {
        let within = heard
            .frames
            .iter()
            .filter(move |f| (from * 1e6..to * 1e6).contains(&(f.time_us as f64)));
        within.map(|frame| frame.mode).collect::<Vec<_>>()
    };
    assert!(modes(1.5, 6.0).iter().all(|mode| *mode == Mode::Safe), "{:?}", modes(1.5, 6.0));
    assert!(heard.frames.iter().any(|frame| frame.mode == Mode::Running));
    assert_eq!((summary.deadline_misses, summary.driven_at_rest), (0, 0));
}

#[test]
fn the_motors_are_off_before_an_update_takes_its_time() {
    let mut store = installed(5);
    let new = blob("skid-rosbot");
    let ask = update(&new, 6)[0].clone();
    let mut both = vec![0; 2 * MAX_FRAME];
    let stop = encode(&Message::Stop, &mut both).unwrap();
    let request = Message::Request(Request { number: 0, ask });
    let length = stop + encode(&request, &mut both[stop..]).unwrap();
    // They are read together, and no tick comes between them.
    assert!(length <= 128, "{length}");
    both.truncate(length);
    let drive = |_| Step::Command(Command::Inputs([6.0, 8.0]));
    let mut steps = vec![Step::Wait(1_000_000), Step::Command(Command::Start)];
    steps.extend((0..20).flat_map(|i| [drive(i), Step::Wait(50_000)]));
    steps.push(Step::Bytes(both));
    let (heard, summary) = go(&mut store, 8.0, &steps);
    assert_eq!(heard.answers.last(), Some(&Some(Say::Begun { written: 0 })));
    assert!(heard.frames.iter().any(|frame| frame.mode == Mode::Running));
    assert_eq!((summary.driven_at_rest, summary.deadline_misses), (0, 0));
}

#[test]
fn what_was_asked_of_a_robot_that_is_started_is_not_done_later() {
    let mut store = Store::new(&blob("skid-rosbot"), Some(key()));
    let new = other_model();
    let mut steps = ask(&update(&new, 5));
    steps.push(Step::Wait(12_000_000));
    // Enough good ticks; the start comes before the signature is looked at.
    let signature = sign(&owner(), Purpose::Confirm, &release(&new, 5));
    let mut both = vec![0; 2 * MAX_FRAME];
    let request = Message::Request(Request { number: 0, ask: Ask::Confirm { signature } });
    let length = encode(&request, &mut both).unwrap();
    let end = length + encode(&Message::Start, &mut both[length..]).unwrap();
    both.truncate(end);
    steps.push(Step::Bytes(both));
    steps.push(Step::Wait(300_000));
    // Whoever drives it knows nothing of that.
    steps.push(Step::Command(Command::Stop));
    steps.push(Step::Wait(1_000_000));
    steps.push(Step::Ask(Ask::Hello));
    let (heard, summary) = go(&mut store, 30.0, &steps);
    assert_eq!(heard.answers.len(), steps.len());
    assert!(heard.frames.iter().any(|frame| frame.mode == Mode::Running));
    let answer = &heard.answers[steps.len() - 5];
    assert_eq!(*answer, Some(Say::Refused(Refused::Busy)));
    let Some(Some(Say::Hello(hello))) = heard.answers.last() else { panic!("{:?}", heard.answers) };
    assert!(hello.trial.is_some() && hello.floor == 0, "{hello:?}");
    assert_eq!((summary.driven_at_rest, summary.deadline_misses), (0, 0));
}
