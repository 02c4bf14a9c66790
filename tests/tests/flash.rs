//! Updates over a line: the laptop's end and the controller's, in virtual time, with a line between them
//! that loses, doubles and flips what it carries.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::path::Path;
use std::rc::Rc;

use embedded_io::{ErrorType, Read, ReadReady, Write, WriteReady};
use firmware_core::blob::Aligned;
use firmware_core::control_loop::supervisor::Report;
use firmware_core::control_loop::telemetry::{Frames, Queue};
use firmware_core::control_loop::{
    Alarms, Command, ControlLoop, Frame, Mode, Supervisor, Telemetry, Timing,
};
use firmware_core::device::MonotonicClock;
use firmware_core::link::Port;
use firmware_core::model::Model;
use firmware_core::slots::{Geometry, Payload, Release, Which, sha256};
use firmware_core::update::{
    Answers, Ask, Capacities, Identity, PublicKey, Purpose, Refused, Request, Updater, Updates,
    statement,
};
use firmware_sim::mcu::flash::Region;
use firmware_sim::mcu::{Board, Flash, VirtualClock};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use trainer::exchange::Counts;
use trainer::flash::{FlashError, Flashing, Options, Outcome, PATIENCE_US, Phase};
use trainer::signing::{SecretKey, SignedRelease};

/// Bits per second of the line, ten of them to a byte.
const BAUD: u32 = 576_000;
/// What the controller's receiver keeps while nobody reads it, as a DMA buffer does (bytes).
const BUFFER: usize = 512;
const TICK_US: u64 = 10_000;
/// From the reset until the loop ticks (µs).
const BOOT_US: u64 = 30_000;
/// A signature takes some 1.7 million instructions; here at 168 MHz and 1.5 cycles each (ns).
const SIGNATURE_NS: u64 = 15_000_000;
const GOOD_TICKS: u32 = 50;
const SECTOR: usize = 16 * 1024;
const FACTORY: &[u8] = b"the model in the firmware";

/// A blob at an address that the core accepts.
struct Blob {
    room: Box<Aligned<[u8; 8192]>>,
    length: usize,
}

impl Blob {
    fn new(bytes: &[u8]) -> Self {
        let mut room = Box::new(Aligned([0; 8192]));
        room.0[..bytes.len()].copy_from_slice(bytes);
        Self { room, length: bytes.len() }
    }

    fn read(folder: &str) -> Self {
        let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
        Self::new(&std::fs::read(models.join(folder).join("model.bin")).unwrap())
    }

    /// With so many bytes, the last ones noise: a controller that looks at the beginning runs it.
    fn padded(folder: &str, length: usize) -> Self {
        let blob = Self::read(folder);
        let mut bytes = blob.bytes().to_vec();
        let mut rng = ChaCha8Rng::seed_from_u64(4096);
        bytes.resize_with(length, || rng.random());
        Self::new(&bytes)
    }

    fn bytes(&self) -> &[u8] {
        &self.room.0[..self.length]
    }

    fn model(&self) -> Model<'_> {
        firmware_core::parse_prefix(self.bytes()).unwrap()
    }
}

/// One direction of the line.
struct Line {
    on_the_way: VecDeque<(u64, u8)>,
    /// When the last byte has passed (ns).
    free_ns: u64,
    /// Time of a byte (ns).
    byte_ns: u64,
    noise: f64,
    cut: bool,
    rng: ChaCha8Rng,
}

impl Line {
    fn new(noise: f64, seed: u64) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self {
            on_the_way: VecDeque::new(),
            free_ns: 0,
            byte_ns: 10_000_000_000 / u64::from(BAUD),
            noise,
            cut: false,
            rng,
        }
    }

    fn at(baud: u32) -> Self {
        Self { byte_ns: 10_000_000_000 / u64::from(baud), ..Self::new(0.0, 0) }
    }

    fn send(&mut self, bytes: &[u8], now_ns: u64) {
        for byte in bytes {
            self.free_ns = self.free_ns.max(now_ns) + self.byte_ns;
            let mut happens = || self.noise > 0.0 && self.rng.random_bool(self.noise);
            let (lost, doubled, flipped) = (happens(), happens(), happens());
            let flip = if flipped { 1 << self.rng.random_range(0..8_u32) } else { 0 };
            let copies = if lost || self.cut { 0 } else { 1 + usize::from(doubled) };
            self.on_the_way.extend(std::iter::repeat_n((self.free_ns, byte ^ flip), copies));
        }
    }

    /// What has arrived.
    fn receive(&mut self, now_ns: u64) -> Vec<u8> {
        let arrived = self.on_the_way.iter().take_while(|(at_ns, _)| *at_ns <= now_ns).count();
        self.on_the_way.drain(..arrived).map(|(_, byte)| byte).collect()
    }

    fn next_ns(&self) -> Option<u64> {
        self.on_the_way.front().map(|(at_ns, _)| *at_ns)
    }
}

/// The controller's UART.
struct Serial<'l> {
    received: &'l mut VecDeque<u8>,
    line: &'l mut Line,
    now_ns: u64,
}

impl ErrorType for Serial<'_> {
    type Error = Infallible;
}

impl Read for Serial<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        let count = bytes.len().min(self.received.len());
        for (place, byte) in bytes.iter_mut().zip(self.received.drain(..count)) {
            *place = byte;
        }
        Ok(count)
    }
}

impl ReadReady for Serial<'_> {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(!self.received.is_empty())
    }
}

impl Write for Serial<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.line.send(&bytes[..1], self.now_ns);
        Ok(1)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl WriteReady for Serial<'_> {
    /// A byte is on the way, and there is room for one more.
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(self.line.free_ns <= self.now_ns + self.line.byte_ns)
    }
}

/// A loop that does nothing but its state machine.
struct Robot<'q> {
    supervisor: Supervisor,
    telemetry: Telemetry<'q>,
    ticks: u64,
}

impl ControlLoop<2> for Robot<'_> {
    fn command(&mut self, command: Command<2>) {
        match command {
            Command::Start => self.supervisor.start(),
            Command::Inputs(_) => self.supervisor.heard(),
            Command::Stop => self.supervisor.stop(),
            Command::Reset => self.supervisor.reset(),
        }
    }

    fn tick(&mut self, now_us: u64) -> Mode {
        self.supervisor.begin(now_us);
        self.ticks += 1;
        if self.ticks.is_multiple_of(10) {
            let measured = [now_us as f32, 0.5, -0.5].into_iter().collect();
            let Report { mode, alarms, noticed, worst_tick_us } = self.supervisor.report();
            let said = Frame { mode, alarms, noticed, worst_tick_us, ..Frame::default() };
            self.telemetry.send(Frame { time_us: now_us, measured, ..said });
        }
        self.mode()
    }

    fn finish(&mut self, _: u64) -> Mode {
        self.mode()
    }

    fn path(&self) -> &[f32] {
        &[]
    }

    fn supervisor(&self) -> &Supervisor {
        &self.supervisor
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.supervisor
    }
}

type Accept = Box<dyn FnMut(Payload) -> bool>;
type Own = Updater<'static, Region<4, SECTOR>, Option<PublicKey>, Accept>;

/// Offset and length of the chunks that a controller was asked to write, over all its boots, with those
/// that it refused.
type Chunks = Rc<RefCell<Vec<(u32, usize)>>>;

/// An updater that takes its time, and notes what it was asked.
struct Watched {
    updater: Own,
    chunks: Chunks,
    clock: VirtualClock,
    checks: bool,
}

impl Updates for Watched {
    fn receive(&mut self, request: Request, mode: Mode, now_us: u64, answers: &mut Answers) {
        if let Ask::Chunk { offset, bytes, .. } = &request.ask {
            self.chunks.borrow_mut().push((*offset, bytes.len()));
        }
        let signed =
            matches!(request.ask, Ask::Begin { .. } | Ask::Activate { .. } | Ask::Confirm { .. });
        let worked = self.updater.is_working();
        self.updater.receive(request, mode, now_us, answers);
        if !worked && self.updater.is_working() {
            self.checks = signed;
        }
    }

    fn is_working(&self) -> bool {
        self.updater.is_working()
    }

    fn work(&mut self, mode: Mode, now_us: u64, answers: &mut Answers) {
        if std::mem::take(&mut self.checks) {
            self.clock.advance_ns(SIGNATURE_NS);
        }
        self.updater.work(mode, now_us, answers);
    }

    fn holds(&mut self, now_us: u64) -> bool {
        self.updater.holds(now_us)
    }
}

/// What stays through resets.
struct Place {
    board: Board,
    flash: Flash,
    trust: Option<PublicKey>,
    identity: Identity<'static>,
    /// Refuses every payload, as a firmware would whose kernel computes something else.
    refuses: Rc<RefCell<bool>>,
    chunks: Chunks,
}

impl Place {
    fn new(blob: &Blob, trust: Option<PublicKey>) -> Self {
        let board = Board::new(&VirtualClock::new());
        let flash = Flash::new(&[SECTOR; 2], &board, 1);
        let model = blob.model();
        let structure = model.structure();
        let name: &'static str = Box::leak(structure.robot().to_owned().into_boxed_str());
        let sample_us = (structure.sample_time_s() * 1e6).round() as u32;
        let capacities = Capacities {
            states: structure.states().len() as u8,
            inputs: structure.inputs().len() as u8,
            ..Capacities::new::<3, 2>(sample_us, 0)
        };
        let identity = Identity {
            firmware: "bench 1.0",
            robot: name,
            factory: FACTORY,
            capacities,
            erase_ms: 500,
            good_ticks: GOOD_TICKS,
        };
        let (refuses, chunks) = Default::default();
        Self { board, flash, trust, identity, refuses, chunks }
    }

    fn payload(&self, payload: Payload) -> Vec<u8> {
        let from = payload.offset as usize;
        self.flash.snapshot()[from..from + payload.length as usize].to_vec()
    }

    /// What runs after a power-on: `None` is the factory model.
    fn boot(&self) -> (Own, Option<Payload>) {
        let geometry = Geometry { offset: 0, slot_bytes: SECTOR as u32 };
        let (flash, refuses) = (self.flash.clone(), self.refuses.clone());
        let Identity { robot, capacities, .. } = self.identity;
        let accept = move |payload: Payload| {
            let from = payload.offset as usize;
            let blob = Blob::new(&flash.snapshot()[from..from + payload.length as usize]);
            let Ok(model) = firmware_core::parse_prefix(blob.bytes()) else { return false };
            let room = Capacities { room: u32::MAX, ..capacities };
            !*refuses.borrow()
                && model.structure().robot() == robot
                && room.check(&model, blob.bytes().len()).is_ok()
        };
        let region = self.flash.region(0..2).unwrap();
        let accept: Accept = Box::new(accept);
        let booted = Updater::boot(region, geometry, self.identity, 0, self.trust, accept);
        let (updater, boot) = booted.unwrap();
        (updater, boot.payload)
    }

    /// What runs after a power-on.
    fn runs(&self) -> (Vec<u8>, Option<Payload>) {
        let (_, payload) = self.boot();
        (payload.map_or_else(|| FACTORY.to_vec(), |payload| self.payload(payload)), payload)
    }
}

/// A controller between two resets.
struct Controller<'q> {
    place: &'q Place,
    watched: Watched,
    robot: Robot<'q>,
    frames: Frames<'q>,
    port: Port,
    received: VecDeque<u8>,
    next_tick_us: u64,
    /// When it is there again after a reset.
    asleep_until_us: Option<u64>,
    /// What booted, at every boot.
    boots: Vec<Vec<u8>>,
}

impl<'q> Controller<'q> {
    fn new(place: &'q Place, queue: &'q mut Queue<4>) -> Self {
        let (producer, frames) = queue.split();
        let supervisor = Supervisor::new(Timing { period_us: 10_000, watchdog_us: 1_000_000 });
        let (updater, payload) = place.boot();
        let clock = place.board.clock().clone();
        let watched = Watched { updater, chunks: place.chunks.clone(), clock, checks: false };
        Self {
            place,
            watched,
            robot: Robot { supervisor, telemetry: Telemetry::new(producer), ticks: 0 },
            frames,
            port: Port::new(),
            received: VecDeque::new(),
            next_tick_us: place.board.clock().now_us(),
            asleep_until_us: None,
            boots: vec![payload.map_or_else(|| FACTORY.to_vec(), |payload| place.payload(payload))],
        }
    }

    /// Runs its main loop once, which may take time on its clock.
    fn turn(&mut self, to_it: &mut Line, from_it: &mut Line) {
        let clock = self.place.board.clock().clone();
        self.received.extend(to_it.receive(clock.now_ns()));
        // What came last has found the buffer full.
        self.received.truncate(BUFFER);
        if let Some(until_us) = self.asleep_until_us {
            self.received.clear();
            if clock.now_us() < until_us {
                return;
            }
            self.asleep_until_us = None;
            let (updater, payload) = self.place.boot();
            self.watched.updater = updater;
            self.port = Port::new();
            self.robot.supervisor =
                Supervisor::new(Timing { period_us: 10_000, watchdog_us: 1_000_000 });
            self.next_tick_us = clock.now_us();
            let runs = payload.map_or_else(|| FACTORY.to_vec(), |p| self.place.payload(p));
            self.boots.push(runs);
        }
        if clock.now_us() >= self.next_tick_us {
            self.next_tick_us = clock.now_us() + TICK_US;
            self.robot.tick(clock.now_us());
            let alarms = self.robot.alarms();
            self.watched.updater.ticked(alarms);
        }
        let now_ns = clock.now_ns();
        let mut serial = Serial { received: &mut self.received, line: from_it, now_ns };
        self.port.receive(&mut serial, &mut self.robot, &mut self.watched, clock.now_us());
        self.port.send(&mut self.frames, &mut serial);
        if self.watched.updater.resets() && self.port.is_sent() {
            self.asleep_until_us = Some(clock.now_us() + BOOT_US);
        }
    }
}

/// How an update went.
#[derive(Debug)]
struct Went {
    result: Result<Outcome, FlashError>,
    /// Virtual time (µs).
    us: u64,
    counts: Counts,
    phases: Vec<Phase>,
    summary: String,
}

/// What is done to the line or the robot when so many bytes are written.
type Meddle<'m> = &'m mut dyn FnMut(u32, &mut Controller<'_>, [&mut Line; 2]);

/// The laptop at work, until it is done or gives up.
fn flash(
    controller: &mut Controller<'_>,
    [there, back]: [&mut Line; 2],
    mut flashing: Flashing<'_>,
    meddle: Meddle<'_>,
) -> Went {
    let clock = controller.place.board.clock().clone();
    let begin_us = clock.now_us();
    // The host has a clock of its own, which stands still for nobody's flash.
    let (mut host_ns, mut next_us) = (clock.now_ns(), 0);
    let mut phases = Vec::new();
    let result = loop {
        let received = back.receive(host_ns);
        let now_us = host_ns / 1000;
        if !received.is_empty() || now_us >= next_us {
            let mut out = Vec::new();
            let polled = flashing.poll(now_us, &received, &mut out);
            there.send(&out, host_ns);
            match polled {
                Err(error) => break Err(error),
                Ok(progress) => {
                    next_us = progress.next_us;
                    let same = |phase: &Phase| {
                        std::mem::discriminant(phase) == std::mem::discriminant(&progress.phase)
                    };
                    if !phases.last().is_some_and(same) {
                        phases.push(progress.phase);
                    }
                    if let Phase::Done(outcome) = progress.phase {
                        break Ok(outcome);
                    }
                    meddle(progress.written, controller, [&mut *there, &mut *back]);
                }
            }
        }
        // Whoever is behind goes on.
        while clock.now_ns() <= host_ns {
            let before_ns = clock.now_ns();
            controller.turn(there, back);
            if clock.now_ns() == before_ns {
                clock.advance_ns(50_000);
            }
        }
        let next_ns = back.next_ns().unwrap_or(u64::MAX).min(1000 * next_us);
        host_ns = next_ns.clamp(host_ns + 1000, host_ns.max(clock.now_ns()) + 50_000);
    };
    assert_eq!(controller.place.board.misuse(), None);
    Went {
        result,
        us: clock.now_us() - begin_us,
        counts: flashing.counts(),
        phases,
        summary: flashing.summary(),
    }
}

fn key(seed: u8) -> SecretKey {
    SecretKey::from_seed([seed; 32]).unwrap()
}

fn sign(blob: &Blob, sequence: u32, key: &SecretKey) -> SignedRelease {
    SignedRelease::new(key, blob.model().structure().robot(), sequence, blob.bytes()).unwrap()
}

fn options(session: u32) -> Options {
    Options { session, baud: Some(BAUD), ..Options::default() }
}

/// An update over a line with noise, from the factory model.
fn update(blob: &Blob, noise: f64, seed: u64) -> (Went, Place, Vec<Vec<u8>>) {
    let owner = key(1);
    let place = Place::new(blob, Some(owner.public()));
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let (mut there, mut back) = (Line::new(noise, 2 * seed), Line::new(noise, 2 * seed + 1));
    let (model, signed) = (blob.model(), sign(blob, 3, &owner));
    let session = 0x1234_5678 ^ (seed as u32).wrapping_mul(0x9E37_79B9);
    let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), options(session));
    let lines = [&mut there, &mut back];
    let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
    let boots = std::mem::take(&mut controller.boots);
    drop(controller);
    (went, place, boots)
}

fn seconds(us: u64) -> f64 {
    us as f64 * 1e-6
}

#[test]
fn every_model_arrives_is_confirmed_and_runs() {
    let folders = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").read_dir().unwrap();
    let mut folders: Vec<_> = folders
        .map(|folder| folder.unwrap().path())
        .filter(|folder| folder.join("model.bin").exists())
        .map(|folder| folder.file_name().unwrap().to_str().unwrap().to_owned())
        .collect();
    folders.sort();
    assert!(folders.len() >= 4);
    for folder in folders {
        let blob = Blob::read(&folder);
        let (went, place, boots) = update(&blob, 0.0, 1);
        assert_eq!(went.result, Ok(Outcome::Installed), "{folder}: {went:?}");
        assert!(boots == [FACTORY.to_vec(), blob.bytes().to_vec()], "{folder}");
        let (runs, payload) = place.runs();
        assert!(runs == blob.bytes(), "{folder}: confirmed");
        assert_eq!(payload.map(|p| (p.slot, p.sequence)), Some((Which::A, 3)));
        let Counts { requests, repeated, .. } = went.counts;
        println!(
            "{folder}, {} bytes: {requests} requests, {repeated} repeated, {:.2} s\n{}",
            blob.bytes().len(),
            seconds(went.us),
            went.summary
        );
        // Begin, while it is erased, and Hello, while it boots.
        assert!(repeated <= 6, "{went:?}");
        let chunks = place.chunks.borrow().clone();
        let total: usize = chunks.iter().map(|(_, length)| length).sum();
        assert_eq!(total, blob.bytes().len(), "{folder}: each byte once");
        let words: Vec<String> = went.phases.iter().map(ToString::to_string).collect();
        assert_eq!(words[..4], ["asking", "beginning", "erasing", "writing"]);
        assert_eq!(words[4..7], ["verifying", "activating", "restarting"]);
        assert!(words[7].ends_with("/50 good ticks"), "{words:?}");
        assert_eq!(words[8..], ["confirming", "done"]);
        assert!(went.summary.contains("release 3, ") && went.summary.contains("confirmed"));

        // Again: nothing to do.
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let (model, signed) = (blob.model(), sign(&blob, 3, &key(1)));
        let again = Flashing::new(blob.bytes(), &model, Some(&signed), options(9));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let went = flash(&mut controller, lines, again, &mut |_, _, _| {});
        assert_eq!((went.result, went.counts.requests), (Ok(Outcome::RunsAlready), 1));
        assert!(went.summary.contains("nothing to do"), "{}", went.summary);
    }
}

/// Quantiles of what is printed.
fn spread(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    format!("least {:.2}, median {:.2}, most {:.2}", at(0.0), at(0.5), at(1.0))
}

fn report(what: &str, all: &[Went]) {
    let count = |f: &dyn Fn(&Went) -> f64| spread(all.iter().map(f).collect());
    println!("{what}: {} updates", all.len());
    println!("  seconds:  {}", count(&|w| seconds(w.us)));
    println!("  requests: {}", count(&|w| w.counts.requests.into()));
    println!("  repeated: {}", count(&|w| w.counts.repeated.into()));
    println!("  kB sent:  {}", count(&|w| w.counts.sent as f64 * 1e-3));
}

#[test]
fn four_kilobytes_arrive_over_a_bad_line() {
    let blob = Blob::padded("two-link-arm", 4096);
    let mut all = Vec::new();
    for seed in 0..100 {
        let (went, place, boots) = update(&blob, 1e-3, seed);
        assert_eq!(went.result, Ok(Outcome::Installed), "seed {seed}: {went:?}");
        assert!(boots == [FACTORY.to_vec(), blob.bytes().to_vec()], "seed {seed}");
        assert!(place.runs().0 == blob.bytes(), "seed {seed}");
        all.push(went);
    }
    report("4 KB over a clean line", &[update(&blob, 0.0, 0).0]);
    report("4 KB, 0.1 % of the bytes each lost, doubled, flipped", &all);
}

/// Updates at 1 % noise each, which arrive or end with an error; those that arrive.
fn over_a_terrible_line(seeds: std::ops::Range<u64>) -> usize {
    let blob = Blob::padded("two-link-arm", 4096);
    let mut all = Vec::new();
    for seed in seeds {
        let (went, place, mut boots) = update(&blob, 1e-2, seed);
        boots.push(place.runs().0);
        let known = |runs: &Vec<u8>| runs == FACTORY || runs == blob.bytes();
        assert!(boots.iter().all(known), "seed {seed}: neither the old nor the new model");
        match &went.result {
            Ok(outcome) => {
                assert_eq!(*outcome, Outcome::Installed, "seed {seed}");
                assert!(boots.ends_with(&[blob.bytes().to_vec()]), "seed {seed}: not confirmed");
            }
            Err(error) => println!("seed {seed}: {error}"),
        }
        all.push(went);
    }
    report("4 KB, 1 % of the bytes each lost, doubled, flipped", &all);
    let arrived = all.iter().filter(|went| went.result.is_ok()).count();
    println!("  arrived: {arrived}");
    arrived
}

#[test]
fn over_a_terrible_line_the_old_or_the_new_model_runs() {
    assert_eq!(over_a_terrible_line(100..120), 20);
}

#[test]
#[ignore = "takes 20 s"]
fn over_a_terrible_line_a_thousand_times() {
    assert!(over_a_terrible_line(1000..2000) >= 990);
}

/// A line a sixtieth as fast, half of it taken by telemetry: whether its speed is known or not, requests
/// are not repeated before their answers can have come.
#[test]
fn a_slow_line_is_not_flooded() {
    let blob = Blob::read("rosbot");
    let owner = key(1);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    for (baud, most_repeated) in [(Some(9600), 3), (None, 12)] {
        let place = Place::new(&blob, Some(owner.public()));
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let options = Options { baud, ..options(1) };
        let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), options);
        let lines = [&mut Line::at(9600), &mut Line::at(9600)];
        let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
        assert_eq!(went.result, Ok(Outcome::Installed), "{baud:?}: {went:?}");
        drop(controller);
        assert!(place.runs().0 == blob.bytes());
        println!("9,600 baud, {baud:?}: {:.2} s, {:?}", seconds(went.us), went.counts);
        assert!(went.counts.repeated <= most_repeated, "{baud:?}: {went:?}");
    }
}

/// There is always a frame of telemetry that waits for the line.
#[test]
fn a_line_that_telemetry_fills_takes_an_update() {
    let blob = Blob::read("rosbot");
    let owner = key(1);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let place = Place::new(&blob, Some(owner.public()));
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let options = Options { baud: Some(2400), ..options(1) };
    let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), options);
    let lines = [&mut Line::at(2400), &mut Line::at(2400)];
    let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
    assert!(controller.robot.telemetry.dropped() > 10, "the line is full");
    assert_eq!(went.result, Ok(Outcome::Installed), "{went:?}");
    drop(controller);
    assert!(place.runs().0 == blob.bytes());
}

#[test]
fn a_cut_line_is_gone_on_with_where_it_ended() {
    let blob = Blob::read("two-link-arm");
    let owner = key(1);
    let place = Place::new(&blob, Some(owner.public()));
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let mut lines = [Line::new(0.0, 1), Line::new(0.0, 2)];
    let [there, back] = &mut lines;
    let half = blob.bytes().len() as u32 / 2;
    let first = Flashing::new(blob.bytes(), &model, Some(&signed), options(1));
    let went =
        flash(&mut controller, [&mut *there, &mut *back], first, &mut |written, _, lines| {
            if written >= half {
                for line in lines {
                    line.cut = true;
                }
            }
        });
    let Err(FlashError::Stopped { doing: Phase::Writing, written, length }) = went.result else {
        panic!("{:?}", went.result)
    };
    assert!(written >= half && written < length);
    assert!((PATIENCE_US..PATIENCE_US + 3_000_000).contains(&went.us), "{went:?}");
    let message = went.result.unwrap_err().to_string();
    assert!(message.contains(&format!("while writing, at byte {written} of")), "{message}");
    there.cut = false;
    back.cut = false;

    let second = Flashing::new(blob.bytes(), &model, Some(&signed), options(2));
    let went = flash(&mut controller, [&mut *there, &mut *back], second, &mut |_, _, _| {});
    assert_eq!(went.result, Ok(Outcome::Installed), "{went:?}");
    let there_already = went.summary.contains(" bytes were there already");
    assert!(there_already, "{}", went.summary);
    let chunks = place.chunks.borrow().clone();
    let mut next = 0;
    for (offset, length) in &chunks {
        assert_eq!(*offset, next, "nothing twice: {chunks:?}");
        next += *length as u32;
    }
    assert_eq!(next as usize, blob.bytes().len());
    println!("cut at byte {written}: {} chunks over both, none twice", chunks.len());
    drop(controller);
    assert!(place.runs().0 == blob.bytes());
}

#[test]
fn a_host_that_vanished_is_waited_for() {
    let blob = Blob::read("skid-rosbot");
    let place = Place::new(&blob, None);
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let model = blob.model();
    let [mut there, mut back] = [Line::new(0.0, 1), Line::new(0.0, 2)];
    let meddle = &mut |_: u32, _: &mut Controller<'_>, _: [&mut Line; 2]| {};
    // Its session is drawn, and it is gone after its first bytes.
    let mut first = Flashing::new(blob.bytes(), &model, None, options(1));
    let clock = place.board.clock().clone();
    let mut written = 0;
    while written == 0 {
        let mut out = Vec::new();
        let received = back.receive(clock.now_ns());
        let progress = first.poll(clock.now_us(), &received, &mut out).unwrap();
        written = progress.written;
        there.send(&out, clock.now_ns());
        if written == 0 {
            controller.turn(&mut there, &mut back);
        }
        clock.advance_ns(50_000);
    }
    assert!(first.warning().unwrap().contains("trusts everybody"));
    let second = Flashing::new(blob.bytes(), &model, None, options(2));
    let went = flash(&mut controller, [&mut there, &mut back], second, meddle);
    assert_eq!(went.result, Ok(Outcome::Installed), "{went:?}");
    assert!(went.phases.contains(&Phase::Waiting), "{went:?}");
    assert!(went.us > 5_000_000);
    // The number is the lowest that was accepted.
    drop(controller);
    assert_eq!(place.runs().1.unwrap().sequence, 0);
}

/// Tries an update that is refused, and sees that the controller still runs what it ran; the message.
fn refused(
    place: &Place,
    blob: &Blob,
    signed: Option<&SignedRelease>,
    start: bool,
    options: Options,
) -> (FlashError, String) {
    let before = place.runs().0;
    let mut queue = Queue::new();
    let mut controller = Controller::new(place, &mut queue);
    if start {
        controller.robot.supervisor.start();
    }
    let model = blob.model();
    let flashing = Flashing::new(blob.bytes(), &model, signed, options);
    let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
    let went = flash(&mut controller, lines, flashing, &mut |_, controller, _| {
        if start {
            controller.robot.supervisor.heard();
        }
    });
    let error = went.result.unwrap_err();
    let message = error.to_string();
    println!("{message}");
    assert!(!message.contains('\n') && !message.contains(" { "), "{message}");
    drop(controller);
    assert!(place.runs().0 == before, "{message}");
    (error, message)
}

#[test]
fn refusals_say_how_to_mend_it() {
    let blob = Blob::read("skid-rosbot");
    let owner = key(1);
    let place = Place::new(&blob, Some(owner.public()));
    let signed = sign(&blob, 3, &owner);
    let says = |(error, message): (FlashError, String), parts: &[&str]| {
        for part in parts {
            assert!(message.contains(part), "`{part}` is not in: {message}");
        }
        error
    };

    // Found on the laptop.
    let error = says(refused(&place, &blob, None, false, options(1)), &["trainer sign"]);
    assert!(matches!(error, FlashError::NotSigned { .. }));
    let stranger = sign(&blob, 3, &key(2));
    let error = refused(&place, &blob, Some(&stranger), false, options(1));
    assert!(matches!(says(error, &["sign it with that"]), FlashError::AnotherKey { .. }));
    let error = refused(&place, &blob, Some(&signed), true, options(1));
    assert_eq!(says(error, &["stops by itself after a second"]), FlashError::Running);
    let arm = Blob::read("two-link-arm");
    let error = refused(&place, &arm, Some(&sign(&arm, 3, &owner)), false, options(1));
    assert!(matches!(says(error, &["belongs to"]), FlashError::AnotherRobot { .. }));

    // Found on the controller: signatures that only look right.
    let mut swapped = signed.clone();
    swapped.signatures.swap(0, 1);
    let error = says(refused(&place, &blob, Some(&swapped), false, options(1)), &["signature"]);
    assert_eq!(error, FlashError::Refused(Refused::Signature));
    let mut forged = stranger.clone();
    forged.key = owner.public();
    let error = says(refused(&place, &blob, Some(&forged), false, options(1)), &["sign"]);
    assert_eq!(error, FlashError::Refused(Refused::Signature));
    let mut install_only = signed.clone();
    install_only.signatures[1] = install_only.signatures[0];
    let error = says(refused(&place, &blob, Some(&install_only), false, options(1)), &["sign"]);
    assert_eq!(error, FlashError::Refused(Refused::Signature));
    // A model that the laptop was told is another one: bytes that are no model.
    let mut nonsense = Blob::read("skid-rosbot");
    let good = Blob::read("skid-rosbot");
    nonsense.room.0[500] ^= 1;
    {
        let model = good.model();
        let release = Release::new(model.structure().robot(), 3, nonsense.bytes()).unwrap();
        let signatures = Purpose::ALL.map(|purpose| owner.sign(&statement(purpose, &release)));
        let robot = model.structure().robot().to_owned();
        let signed = SignedRelease { robot, release, key: owner.public(), signatures };
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let flashing = Flashing::new(nonsense.bytes(), &model, Some(&signed), options(1));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
        assert_eq!(went.result, Err(FlashError::Refused(Refused::Model)));
        // Bytes that are not those that were signed.
        let flashing = Flashing::new(good.bytes(), &model, Some(&signed), options(2));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
        assert_eq!(went.result, Err(FlashError::Refused(Refused::Hash)));
    }

    // One that does not fit: too long, by a byte.
    let room = SECTOR - firmware_core::slots::PAYLOAD_OFFSET as usize;
    let mut tight = Place::new(&blob, None);
    tight.identity.capacities.states = 9;
    let error = says(refused(&tight, &blob, None, false, options(1)), &["3 states, the robot 9"]);
    assert!(matches!(error, FlashError::Misfit(_)));
    tight.identity.capacities.states = 3;
    tight.identity.capacities.instructions = 10;
    says(refused(&tight, &blob, None, false, options(1)), &["--max-instructions 10"]);
    tight.identity.capacities.instructions = 0;
    tight.identity.capacities.sample_us *= 2;
    says(refused(&tight, &blob, None, false, options(1)), &["sample_time_s = "]);
    {
        let model = blob.model();
        let mut long = blob.bytes().to_vec();
        long.resize(room + 1, 0);
        let place = Place::new(&blob, None);
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let flashing = Flashing::new(&long, &model, None, options(1));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
        let message = went.result.unwrap_err().to_string();
        assert!(message.contains("16065 bytes, and there is room for 16064"), "{message}");
        assert!(message.contains("--max-bytes 16064"), "{message}");
        assert_eq!(went.counts.requests, 1);
    }

    // Older than what was confirmed.
    let (went, place, _) = update(&blob, 0.0, 1);
    assert_eq!(went.result, Ok(Outcome::Installed));
    let older = sign(&blob, 2, &owner);
    let error = refused(&place, &blob, Some(&older), false, options(1));
    let expected = FlashError::BelowFloor { sequence: 2, floor: 3 };
    assert_eq!(says(error, &["--sequence 3"]), expected);
}

#[test]
fn a_dry_run_only_asks() {
    let blob = Blob::read("skid-rosbot");
    let owner = key(1);
    let place = Place::new(&blob, Some(owner.public()));
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let dry = Options { dry_run: true, ..options(1) };
    let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), dry);
    let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
    let went = flash(&mut controller, lines, flashing, &mut |_, _, _| {});
    assert_eq!((went.result, went.counts.requests), (Ok(Outcome::Fits), 1));
    assert!(went.summary.contains("fits and may be installed"), "{}", went.summary);
    assert_eq!(place.flash.counts().programmed_bytes, 0);
}

#[test]
fn a_trial_is_confirmed_by_the_next_run() {
    let blob = Blob::read("soft-leg");
    let owner = key(1);
    let place = Place::new(&blob, Some(owner.public()));
    let mut queue = Queue::new();
    let mut controller = Controller::new(&place, &mut queue);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let [mut there, mut back] = [Line::new(0.0, 1), Line::new(0.0, 2)];
    let mut run = |signed: &SignedRelease, options| {
        let flashing = Flashing::new(blob.bytes(), &model, Some(signed), options);
        flash(&mut controller, [&mut there, &mut back], flashing, &mut |_, _, _| {})
    };
    let went = run(&signed, Options { trial: true, ..options(1) });
    assert_eq!(went.result, Ok(Outcome::OnTrial));
    assert!(went.summary.contains("without --trial"), "{}", went.summary);
    // Another release has to wait.
    let error = run(&sign(&blob, 4, &owner), options(2)).result.unwrap_err();
    assert!(matches!(error, FlashError::AnotherOnTrial(release) if release.sequence == 3));
    let went = run(&signed, options(3));
    assert_eq!(went.result, Ok(Outcome::Installed));
    assert!(went.counts.requests < 6, "{went:?}");
    drop(controller);
    assert!(place.runs().0 == blob.bytes());
}

#[test]
fn a_model_that_does_not_come_up_is_reported() {
    let blob = Blob::read("soft-leg");
    let owner = key(1);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let run = |meddle: Meddle<'_>| {
        let place = Place::new(&blob, Some(owner.public()));
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), options(1));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let went = flash(&mut controller, lines, flashing, meddle);
        drop(controller);
        (went, place.runs().0)
    };
    // Refused when it boots, after it was accepted when it was written.
    let (went, runs) = run(&mut |_, controller, _| {
        *controller.place.refuses.borrow_mut() = controller.asleep_until_us.is_some();
    });
    assert!(runs == FACTORY);
    let error = went.result.unwrap_err();
    assert!(matches!(error, FlashError::Dropped(release) if release.sha256 == sha256(FACTORY)));
    assert!(error.to_string().contains("the same command tries again"), "{error}");
    // Restarted during the trial.
    let (went, runs) = run(&mut |_, controller, _| {
        if controller.boots.len() == 2 && controller.watched.updater.slots().on_trial() {
            let now_us = controller.place.board.clock().now_us();
            controller.asleep_until_us.get_or_insert(now_us + BOOT_US);
        }
    });
    assert!(runs == FACTORY && matches!(went.result, Err(FlashError::Dropped(_))), "{went:?}");
    // An alarm in every tick.
    let alarm = Alarms::RESIDUAL;
    let (went, runs) = run(&mut |_, controller, _| controller.robot.supervisor.raise(alarm));
    assert!(runs == FACTORY);
    let message = went.result.as_ref().unwrap_err().to_string();
    assert!(message.contains("stay until the robot is reset or started"), "{message}");
    let Err(FlashError::TrialStalls { good, needed }) = went.result else { panic!("{went:?}") };
    assert!(good < 10 && needed == GOOD_TICKS, "{good} of {needed}");
    // It never comes back; switched off and on it runs the new one, on trial.
    let (went, runs) = run(&mut |_, controller, _| {
        if let Some(until_us) = &mut controller.asleep_until_us {
            *until_us = u64::MAX;
        }
    });
    assert_eq!(went.result, Err(FlashError::NotBack));
    assert!(went.us < 35_000_000 && runs == blob.bytes());
}

/// A stretch of any answers may be lost: the update arrives all the same.
#[test]
fn lost_answers_are_made_up_for() {
    let blob = Blob::read("skid-rosbot");
    let owner = key(1);
    let (model, signed) = (blob.model(), sign(&blob, 3, &owner));
    let mut longest_us = 0;
    // Each poll of the laptop sends or receives something: beyond the end of a clean update.
    for lost in 0..30 {
        let place = Place::new(&blob, Some(owner.public()));
        let mut queue = Queue::new();
        let mut controller = Controller::new(&place, &mut queue);
        let flashing = Flashing::new(blob.bytes(), &model, Some(&signed), options(1));
        let lines = [&mut Line::new(0.0, 1), &mut Line::new(0.0, 2)];
        let mut polls = 0;
        let went = flash(&mut controller, lines, flashing, &mut |_, _, [_, back]| {
            polls += 1;
            back.cut = (10 * lost..10 * lost + 10).contains(&polls);
        });
        assert_eq!(went.result, Ok(Outcome::Installed), "{lost}: {went:?}");
        drop(controller);
        assert!(place.runs().0 == blob.bytes());
        longest_us = longest_us.max(went.us);
    }
    println!("longest with a stretch of answers lost: {:.2} s", seconds(longest_us));
}
