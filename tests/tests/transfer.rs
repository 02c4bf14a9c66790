//! Models on their way to a controller that runs its loop: how long it takes, what noise does, what an erase
//! of seconds does, and that the robot ends with the old or the new model whatever happens.

use std::cell::RefCell;
use std::ops::Range;
use std::path::Path;
use std::rc::Rc;

use embedded_io::{Read, ReadReady, Write};
use firmware_core::blob;
use firmware_core::control_loop::{Command, Frame, Mode};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::slots::{PAYLOAD_OFFSET, Which};
use firmware_sim::fault::Fault;
use firmware_sim::mcu::UartEnd;
use firmware_sim::run::host::{Counts, Laptop};
use firmware_sim::run::scenario::{FaultText, LineSettings, Scenario};
use firmware_sim::run::store::Store;
use firmware_sim::run::summary::Summary;
use firmware_sim::run::{Blob, run_with};
use trainer::flash::{FlashError, Flashing, Options, Outcome, Phase};

/// Bytes of a slot of the simulated controller.
const SLOT: usize = 128 * 1024;

/// The model in the image.
fn factory() -> Blob {
    dense([1; 4])
}

/// A dense model of the ROSbot with Hermite orders of its four inputs, present and before.
fn dense(orders: [u8; 4]) -> Blob {
    let state = |name, unit, space| State {
        name,
        unit,
        space,
        target: Target::Increment,
        limit: [f32::MIN, f32::MAX],
    };
    let input = |name| Input { name, unit: "rad/s", range: [-16.0, 16.0] };
    let inputs = [(0, 0), (1, 0), (0, 1), (1, 1)];
    let factors = (0..4).zip(orders);
    let structure = Structure::try_from(ModelRepr {
        robot: "skid-rosbot",
        sample_time_s: 0.1,
        states: [
            state("x", "m", Space::Line),
            state("y", "m", Space::Line),
            state("phi", "rad", Space::Circle),
        ]
        .into_iter()
        .collect(),
        inputs: [input("omega_r"), input("omega_l")].into_iter().collect(),
        symmetry: Symmetry::Se2 { x: 0, y: 1, heading: 2 },
        observables: inputs
            .map(|(i, lag)| Observable { source: Source::Input(i), lag, centre: 0.0, gain: 0.05 })
            .into_iter()
            .collect(),
        factors: factors
            .map(|(observable, order)| Factor { observable, basis: Basis::Hermite, order })
            .collect(),
        blocks: [Block { factors: 4, max_degree: 0 }].into_iter().collect(),
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    })
    .unwrap();
    let terms = structure.dictionary().dense_terms();
    // Small, and different from each other.
    let coefficients: Vec<f32> = (0..3 * terms).map(|i| (i % 251) as f32 * 1e-7).collect();
    let model = Model::new(structure, &coefficients, None).unwrap();
    let mut out = vec![0; 1 << 16];
    let length = blob::emit(&model, &[0.0; 6], &[1.0; 4], &[1e-3; 3], &mut out).unwrap();
    Blob::new(&out[..length])
}

/// The trainer at the other end of the line.
struct Installer<'m> {
    end: UartEnd,
    flashing: Flashing<'m>,
    outgoing: Vec<u8>,
    /// Drives the robot, too, and starts it whenever it stands.
    drives: bool,
    /// While the cable is not plugged in (µs).
    unplugged_us: Range<u64>,
    next_us: u64,
    receiver: Receiver,
    seen: Rc<RefCell<Seen>>,
}

#[derive(Clone, Debug, Default)]
struct Seen {
    /// Every phase with the time at which it began (µs).
    phases: Vec<(u64, Phase)>,
    result: Option<Result<Outcome, FlashError>>,
    /// Samples of the running robot, with their times (µs).
    running_us: Vec<u64>,
}

impl Seen {
    /// When a phase began (µs).
    fn at(&self, wanted: Phase) -> u64 {
        self.phases.iter().find(|(_, phase)| *phase == wanted).expect("it came so far").0
    }
}

impl Laptop for Installer<'_> {
    fn turn(
        &mut self,
        now_us: u64,
        _: &mut dyn FnMut(&Frame) -> std::io::Result<()>,
    ) -> std::io::Result<()> {
        let (mut received, mut bytes) = (Vec::new(), [0; 256]);
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            received.extend(&bytes[..count]);
        }
        if self.unplugged_us.contains(&now_us) {
            received.clear();
        }
        let mut seen = self.seen.borrow_mut();
        for byte in &received {
            if let Some(Received::Message(Message::Frame(frame))) = self.receiver.push(*byte)
                && frame.mode == Mode::Running
            {
                seen.running_us.push(now_us);
            }
        }
        if self.drives && now_us >= self.next_us {
            self.next_us = now_us + 50_000;
            for message in [Message::Reset, Message::Start, Command::Inputs([8.0, 6.0]).into()] {
                let mut frame = [0; MAX_FRAME];
                let length = encode(&message, &mut frame).unwrap();
                self.outgoing.extend(&frame[..length]);
            }
        }
        if seen.result.is_some() {
            let count = self.end.write(&self.outgoing).unwrap_or(0);
            self.outgoing.drain(..count);
            return Ok(());
        }
        match self.flashing.poll(now_us, &received, &mut self.outgoing) {
            Ok(progress) => {
                if seen.phases.last().is_none_or(|(_, phase)| *phase != progress.phase) {
                    seen.phases.push((now_us, progress.phase));
                }
                if let Phase::Done(outcome) = progress.phase {
                    seen.result = Some(Ok(outcome));
                }
            }
            Err(error) => seen.result = Some(Err(error)),
        }
        if self.unplugged_us.contains(&now_us) {
            self.outgoing.clear();
        }
        let count = self.end.write(&self.outgoing).unwrap_or(0);
        self.outgoing.drain(..count);
        Ok(())
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }
}

/// What is not as it should be.
#[derive(Clone, Default)]
struct Trouble {
    /// Probability with which a byte is lost, and doubled, and flipped.
    noise: f64,
    /// Somebody drives the robot.
    drives: bool,
    /// While the cable is not plugged in (µs).
    unplugged_us: Range<u64>,
    /// Of the scenario.
    faults: Vec<Fault>,
}

/// Installs a blob on a ROSbot; `seed` is that of the noise.
fn install(
    store: &mut Store,
    blob: &Blob,
    trouble: Trouble,
    seconds: f64,
    seed: u64,
) -> (Seen, Summary) {
    let options = Options { session: seed as u32, baud: Some(576_000), ..Options::default() };
    install_with(store, blob, trouble, seconds, (seed, options))
}

/// The same with these options.
fn install_with(
    store: &mut Store,
    blob: &Blob,
    Trouble { noise, drives, unplugged_us, faults }: Trouble,
    seconds: f64,
    (seed, options): (u64, Options),
) -> (Seen, Summary) {
    let factory = factory();
    let line =
        LineSettings { loss: noise, doubling: noise, bit_flip: noise, ..LineSettings::default() };
    let faults = faults.into_iter().map(FaultText).collect();
    let scenario = Scenario { seconds, line, faults, ..Scenario::random(16.0) };
    let model = blob.model().unwrap();
    let seen = Rc::new(RefCell::new(Seen::default()));
    let installer = |end| Installer {
        end,
        flashing: Flashing::new(blob.bytes(), &model, None, options),
        outgoing: Vec::new(),
        drives,
        unplugged_us,
        next_us: 1_000_000,
        receiver: Receiver::new(),
        seen: seen.clone(),
    };
    let summary = run_with(&factory.model().unwrap(), &scenario, seed, store, installer).unwrap();
    (seen.take(), summary)
}

fn noisy(noise: f64) -> Trouble {
    Trouble { noise, ..Trouble::default() }
}

/// The slot that begins here holds the whole blob.
fn holds(store: &Store, slot: usize, blob: &Blob) -> bool {
    let payload = slot * SLOT + PAYLOAD_OFFSET as usize;
    store.image[payload..].starts_with(blob.bytes())
}

#[test]
fn a_clean_line_takes_as_long_as_its_bytes() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let small = Blob::read(&models.join("skid-rosbot/model.bin")).unwrap();
    let large = dense([5; 4]);
    assert!((15_900..16_500).contains(&large.bytes().len()), "{} bytes", large.bytes().len());
    for (blob, most_s) in [(small, 1.0), (large, 3.0)] {
        let mut store = Store::new(&factory(), None);
        let (seen, summary) = install(&mut store, &blob, Trouble::default(), 60.0, 1);
        assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "{:?}", seen.phases);
        let [asking, erasing, writing, restarting, done] = [
            seen.phases[0].0,
            seen.at(Phase::Erasing),
            seen.at(Phase::Writing),
            seen.at(Phase::Restarting),
            seen.at(Phase::Done(Outcome::Installed)),
        ]
        .map(|us| us as f64 * 1e-6);
        let erase = writing - erasing;
        println!(
            "{} B at 576,000 baud: {:.3} s from the first question to the reset, without the erase of \
             {erase:.3} s; {:.2} s in all with the trial",
            blob.bytes().len(),
            restarting - asking - erase,
            done - asking
        );
        assert!(restarting - asking - erase < most_s);
        // As the data sheet says of a sector of 128 KB.
        assert!((1.0..1.1).contains(&erase), "{erase} s");
        assert!(holds(&store, 0, &blob));
        let boots: Vec<_> = store.boots.iter().map(|b| (b.running, b.trial)).collect();
        assert_eq!(boots, [(Which::Factory, false), (Which::A, true)]);
        assert_eq!((summary.deadline_misses, summary.driven_at_rest), (0, 0));
        // It stays.
        install(&mut store, &blob, Trouble::default(), 1.0, 1);
        let last = store.boots.last().unwrap();
        assert_eq!((last.running, last.trial), (Which::A, false));
    }
}

#[test]
fn a_robot_that_somebody_drives_is_stopped_for_it_if_that_is_asked() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let blob = Blob::read(&models.join("skid-rosbot/model.bin")).unwrap();
    let mut store = Store::new(&factory(), None);
    let options = Options { session: 1, ..Options::default() };
    let driven = Trouble { drives: true, ..Trouble::default() };
    // It begins before anybody drives, and ends where it is to be confirmed.
    let (seen, _) = install_with(&mut store, &blob, driven.clone(), 40.0, (1, options));
    assert_eq!(seen.result, Some(Err(FlashError::Running)), "{:?}", seen.phases);
    assert_eq!(store.boots.len(), 2);

    let mut store = Store::new(&factory(), None);
    let options = Options { stop: true, ..options };
    let (seen, summary) = install_with(&mut store, &blob, driven.clone(), 40.0, (1, options));
    assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "{:?}", seen.phases);
    let confirmed_us = seen.at(Phase::Done(Outcome::Installed));
    let trial = seen.running_us.iter().filter(|us| (2_000_000..confirmed_us).contains(us)).count();
    let after = seen.running_us.iter().filter(|us| **us > confirmed_us).count();
    assert!(trial > 50 && after > 100, "{trial} samples on trial, {after} after it");
    assert_eq!((summary.deadline_misses, summary.driven_at_rest), (0, 0));
}

#[test]
fn the_session_lives_through_an_erase_of_four_seconds() {
    let mut store = Store::new(&factory(), None);
    store.erase_ns = Some(4_000_000_000);
    let blob = dense([3, 3, 3, 4]);
    let (seen, _) = install(&mut store, &blob, Trouble::default(), 60.0, 1);
    assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "{:?}", seen.phases);
    let erase = seen.at(Phase::Writing) - seen.at(Phase::Erasing);
    assert!((4_000_000..4_100_000).contains(&erase), "{erase} µs");
    // Once: it did not begin again.
    assert_eq!(seen.phases.iter().filter(|(_, phase)| *phase == Phase::Erasing).count(), 1);
}

#[test]
fn a_session_lives_through_an_erase_that_takes_longer_than_it_may_be_silent() {
    let mut store = Store::new(&factory(), None);
    store.erase_ns = Some(7_000_000_000);
    let blob = dense([3, 3, 3, 4]);
    let (seen, _) = install(&mut store, &blob, Trouble::default(), 60.0, 1);
    assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "{:?}", seen.phases);
    assert_eq!(seen.phases.iter().filter(|(_, phase)| *phase == Phase::Beginning).count(), 1);
}

#[test]
fn a_model_of_four_kilobytes_arrives_on_a_noisy_line() {
    let blob = dense([3, 3, 3, 4]);
    assert!((4_000..4_400).contains(&blob.bytes().len()), "{} bytes", blob.bytes().len());
    let mut times: Vec<f64> = (1..=100)
        .map(|seed| {
            let mut store = Store::new(&factory(), None);
            let (seen, summary) = install(&mut store, &blob, noisy(1e-3), 120.0, seed);
            assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "seed {seed}: {:?}", seen.phases);
            assert!(holds(&store, 0, &blob), "seed {seed}");
            assert_eq!(summary.driven_at_rest, 0);
            (seen.at(Phase::Restarting) - seen.phases[0].0) as f64 * 1e-6
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!(
        "each byte lost, doubled, flipped with 1e-3 each: 100 of 100 arrive, after {:.1} to {:.1} s, median \
         {:.1} s, the erase of 1 s included",
        times[0], times[99], times[50]
    );
}

#[test]
fn on_a_very_noisy_line_it_arrives_or_says_why_not() {
    let blob = dense([3, 3, 3, 4]);
    let (mut times, mut failed) = (Vec::new(), 0);
    for seed in 1..=30 {
        let mut store = Store::new(&factory(), None);
        let (seen, _) = install(&mut store, &blob, noisy(1e-2), 600.0, seed);
        let (booted, last) = (store.boots.len(), *store.boots.last().unwrap());
        match seen.result.clone().expect("it ends") {
            Ok(outcome) => {
                assert_eq!((outcome, booted), (Outcome::Installed, 2), "seed {seed}");
                times.push((seen.at(Phase::Restarting) - seen.phases[0].0) as f64 * 1e-6);
            }
            Err(error) => {
                failed += 1;
                println!("seed {seed}: {error}");
            }
        }
        // Whatever was heard: the controller runs the old or the new model, whole.
        match last.running {
            Which::Factory => {}
            _ => assert!(holds(&store, 0, &blob), "seed {seed}: half a model runs"),
        }
    }
    times.sort_by(f64::total_cmp);
    println!(
        "with 1e-2 each: {} of 30 arrive, after {:.1} to {:.1} s, {failed} end with an error",
        times.len(),
        times.first().copied().unwrap_or(f64::NAN),
        times.last().copied().unwrap_or(f64::NAN)
    );
}

#[test]
fn a_cable_that_is_pulled_at_any_moment_and_plugged_in_again_does_not_matter() {
    let blob = dense([3, 3, 3, 4]);
    for from_us in (0..1_500_000).step_by(23_000) {
        // Longer than the controller waits for a session, or shorter.
        let away_us = if from_us % 2_000 == 0 { 7_000_000 } else { 700_000 };
        let unplugged_us = from_us..from_us + away_us;
        let trouble = Trouble { unplugged_us, ..Trouble::default() };
        let mut store = Store::new(&factory(), None);
        let (seen, _) = install(&mut store, &blob, trouble, 60.0, 1);
        assert_eq!(seen.result, Some(Ok(Outcome::Installed)), "{from_us} µs: {:?}", seen.phases);
        assert!(holds(&store, 0, &blob) && store.boots.len() == 2, "{from_us} µs");
        // What was written is not written again.
        let erased = seen.phases.iter().filter(|(_, phase)| *phase == Phase::Erasing).count();
        assert!(erased <= 1, "{from_us} µs: {:?}", seen.phases);
    }
}

#[test]
fn power_that_fails_at_any_moment_of_an_update_costs_no_model() {
    let blob = dense([3, 3, 3, 4]);
    let mut dropped = 0;
    // Every tick of the update, and some of the trial.
    let moments = (1..200).chain((200..1_400).step_by(40));
    for tick in moments {
        let from_s = f64::from(tick) * 0.01;
        let fault = format!("brown-out@{from_s}..{}=1", from_s + 0.05).parse().unwrap();
        let trouble = Trouble { faults: vec![fault], ..Trouble::default() };
        let mut store = Store::new(&factory(), None);
        let (seen, summary) = install(&mut store, &blob, trouble, 60.0, 1);
        match seen.result.clone().expect("it ends") {
            Ok(outcome) => assert_eq!(outcome, Outcome::Installed),
            Err(FlashError::Dropped(_)) => dropped += 1,
            Err(error) => panic!("{from_s} s: {error}"),
        }
        assert!(summary.resets > 0 && summary.driven_at_rest == 0, "{from_s} s");
        for boot in &store.boots {
            assert!(boot.running == Which::Factory || holds(&store, 0, &blob), "{from_s} s");
        }
        // It can be done again.
        if seen.result != Some(Ok(Outcome::Installed)) {
            let (again, _) = install(&mut store, &blob, Trouble::default(), 60.0, 1);
            assert_eq!(again.result, Some(Ok(Outcome::Installed)), "{from_s} s");
        }
        install(&mut store, &blob, Trouble::default(), 1.0, 1);
        let last = store.boots.last().unwrap();
        assert!(last.running != Which::Factory && !last.trial, "{from_s} s: {last}");
    }
    assert!(dropped > 20, "a reset ends a trial: {dropped}");
}
