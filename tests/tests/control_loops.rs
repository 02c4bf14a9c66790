//! The control loops on devices that remember every call and forgive nothing.

use std::cell::{Cell, RefCell};
use std::path::Path;
use std::rc::Rc;
use std::sync::LazyLock;

use embedded_hal::digital::{self, OutputPin};
use embedded_hal::pwm::{self, SetDutyCycle};
use firmware_core::blob::Aligned;
use firmware_core::capacity::{MAX_KEPT, MAX_LAG};
use firmware_core::control_loop::monitor::{FAR, GATE};
use firmware_core::control_loop::rosbot::{Motor, RosbotSettings, Sides};
use firmware_core::control_loop::soft_leg::{Chamber, Pneumatics, SoftLegSettings};
use firmware_core::control_loop::telemetry::{Frames, Queue};
use firmware_core::control_loop::tracker::Tracked;
use firmware_core::control_loop::{
    ActuatorError, Actuators, Alarms, Command, ControlLoop, ControlLoopError, Frame, Measurement,
    Mode, Rosbot, SoftLeg, Supervisor, Telemetry, Timing, Tracker,
};
use firmware_core::device::{EncoderCount, PositionSensor};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::error_bounds::ErrorBounds;
use firmware_core::model::{Provenance, Space, State, Symmetry, Target};
use firmware_core::update::Capacities;
use firmware_core::{Model, ModelRepr, Structure};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use trainer::edmd;
use trainer::export::export;
use trainer::robot::Robot;
use trainer::trajectory::{InMemory, Trajectory};

// Models

/// A model for the rest of the process.
fn keep(bytes: &[u8]) -> Model<'static> {
    const ROOM: usize = 1 << 14;
    let slot: &'static mut Aligned<[u8; ROOM]> = Box::leak(Box::new(Aligned([0xff; ROOM])));
    slot.0[..bytes.len()].copy_from_slice(bytes);
    firmware_core::parse(&slot.0[..bytes.len()]).unwrap()
}

/// A model that comes with the project, without the error bounds that it may have.
fn shipped(name: &str) -> Model<'static> {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let model = keep(&std::fs::read(models.join(name).join("model.bin")).unwrap());
    let (structure, coefficients, ranges) =
        (model.structure().clone(), model.coefficients(), model.ranges());
    match model.terms() {
        Some(terms) => Model::new_sparse(structure, terms.entries(), coefficients, ranges),
        None => Model::new(structure, coefficients, ranges),
    }
    .unwrap()
}

fn with_bounds(
    model: &Model<'static>,
    horizons: &'static [u32],
    bounds: &'static [f32],
) -> Model<'static> {
    let n = model.structure().states().len();
    model
        .clone()
        .with_error_bounds(ErrorBounds::new(n, 0.999, 2000, horizons, bounds).unwrap())
        .unwrap()
}

/// Looks at no earlier samples: y⁺ = 0.9 y + 0.1 bending, z⁺ = 0.9 z + 0.1 extension.
static PLAIN: LazyLock<Model<'static>> = LazyLock::new(|| {
    let description = r#"
        name = "plain"
        sample_time_s = 0.05
        states = [
            { name = "y", space = "R", unit = "mm", limit = [-1e6, 1e6] },
            { name = "z", space = "R", unit = "mm", limit = [-1e6, 1e6] },
        ]
        inputs = [
            { name = "bending", unit = "V", range = [-24, 24] },
            { name = "extension", unit = "V", range = [-6, 12] },
        ]
        [dictionary]
        standardise = false
        terms = ["y", "z", "bending", "extension"]
    "#;
    let robot = Robot::parse(description, Path::new("robot.toml")).unwrap();
    // Trained far and wide.
    let logs = [1e3, -1e3].map(|start| {
        let (mut log, mut x) = (Trajectory::default(), [start; 2]);
        for k in 0..200 {
            let u = [24.0 * f64::sin(f64::from(k)), 12.0 * f64::cos(0.7 * f64::from(k))];
            log.states.extend(x);
            log.inputs.extend(u);
            x = [0, 1].map(|i| 0.9 * x[i] + 0.1 * u[i]);
        }
        log
    });
    let source = InMemory { trajectories: &logs, states: 2, inputs: 2 };
    keep(&export(&edmd::fit(&robot, &source, &|_| ()).unwrap()).unwrap())
});
const HORIZONS: [u32; 4] = [1, 2, 4, 8];
/// 1, 2, 3, 4 mm and half of that.
static PLAIN_BOUNDED: LazyLock<Model<'static>> =
    LazyLock::new(|| with_bounds(&PLAIN, &HORIZONS, &[1.0, 0.5, 2.0, 1.0, 3.0, 1.5, 4.0, 2.0]));
/// Looks back at four samples.
static LEG: LazyLock<Model<'static>> = LazyLock::new(|| shipped("soft-leg"));
static LEG_BOUNDED: LazyLock<Model<'static>> =
    LazyLock::new(|| with_bounds(&LEG, &HORIZONS, &[1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0]));
static ROSBOT: LazyLock<Model<'static>> = LazyLock::new(|| shipped("skid-rosbot"));
static ROSBOT_BOUNDED: LazyLock<Model<'static>> = LazyLock::new(|| {
    const BOUNDS: [f32; 12] = [0.01, 0.01, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03, 0.04, 0.0, 0.0, 0.0];
    with_bounds(&ROSBOT, &HORIZONS, &BOUNDS)
});

// Devices

/// What is called: PWM right and left (bending, extension), direction pins (lines), pumps, encoders,
/// and the sensor.
const DEVICES: usize = 9;
const PWM: usize = 0;
const PIN: usize = 2;
const PUMP: usize = 4;
const ENCODER: usize = 6;
const SENSOR: usize = 8;
const MAX_DUTY: u16 = 999;

/// A device that fails from a call on, once or for ever, and whether it does what was asked all the same.
#[derive(Clone, Copy, Debug)]
struct Broken {
    device: usize,
    call: u32,
    forever: bool,
    does_it: bool,
}

#[derive(Debug, Default)]
struct Hardware {
    is_leg: bool,
    duty: [u16; 2],
    /// Directions or lines, then pumps.
    pins: [bool; 4],
    counts: [u16; 2],
    measured: Option<Option<[f32; 3]>>,
    calls: [u32; DEVICES],
    broken: Option<Broken>,
    failed: bool,
    misuse: Vec<String>,
    /// Shares that were applied and not all zero.
    driven: u32,
}

#[derive(Clone, Debug, Default)]
struct Rig(Rc<RefCell<Hardware>>);

#[derive(Debug)]
struct Failed;

impl pwm::Error for Failed {
    fn kind(&self) -> pwm::ErrorKind {
        pwm::ErrorKind::Other
    }
}

impl digital::Error for Failed {
    fn kind(&self) -> digital::ErrorKind {
        digital::ErrorKind::Other
    }
}

impl Rig {
    fn new(is_leg: bool) -> Self {
        let rig = Self::default();
        rig.0.borrow_mut().is_leg = is_leg;
        rig.0.borrow_mut().measured = Some(Some([0.0; 3]));
        rig
    }

    /// A call of a device, which sets something unless it fails.
    fn call(&self, device: usize, set: impl FnOnce(&mut Hardware)) -> Result<(), Failed> {
        let mut hardware = self.0.borrow_mut();
        hardware.calls[device] += 1;
        let fails = hardware.broken.filter(|b| {
            let call = hardware.calls[device];
            b.device == device && (call == b.call || b.forever && call > b.call)
        });
        if fails.is_none_or(|b| b.does_it) {
            set(&mut hardware);
        }
        hardware.failed |= fails.is_some();
        fails.map_or(Ok(()), |_| Err(Failed))
    }

    fn count(&self, wheel: usize) -> Result<u16, Failed> {
        self.call(ENCODER + wheel, |_| ())?;
        Ok(self.0.borrow().counts[wheel])
    }

    fn measure(&self) -> Result<Option<[f32; 3]>, Failed> {
        self.call(SENSOR, |_| ())?;
        self.0.borrow().measured.ok_or(Failed)
    }

    fn measures(&self, measured: Option<Option<[f32; 3]>>) {
        self.0.borrow_mut().measured = measured;
    }

    /// Whether everything is off, but for a device that cannot be switched off.
    fn is_off(&self) -> bool {
        let h = self.0.borrow();
        let stuck = h.broken.filter(|b| b.forever && h.failed).map(|b| b.device);
        let off = |device: usize, off: bool| off || stuck == Some(device);
        (0..2).all(|i| off(PWM + i, h.duty[i] == 0))
            && (0..2).all(|i| off(PUMP + i, !h.pins[2 + i]))
    }

    fn misuse(&self) -> Vec<String> {
        self.0.borrow().misuse.clone()
    }
}

struct Duty(Rig, usize);

impl pwm::ErrorType for Duty {
    type Error = Failed;
}

impl SetDutyCycle for Duty {
    fn max_duty_cycle(&self) -> u16 {
        MAX_DUTY
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Failed> {
        let Self(rig, side) = self;
        rig.call(PWM + *side, |hardware| {
            if duty > MAX_DUTY {
                hardware.misuse.push(format!("duty {duty}"));
            }
            hardware.duty[*side] = duty;
        })
    }
}

struct Level(Rig, usize);

impl Level {
    fn set(&self, high: bool) -> Result<(), Failed> {
        let Self(rig, pin) = self;
        rig.call(PIN + pin, |hardware| {
            let turned = hardware.pins[*pin] != high;
            if !hardware.is_leg && turned && hardware.duty[*pin] != 0 {
                hardware.misuse.push(format!("bridge {pin} turned round under load"));
            }
            hardware.pins[*pin] = high;
        })
    }
}

impl digital::ErrorType for Level {
    type Error = Failed;
}

impl OutputPin for Level {
    fn set_low(&mut self) -> Result<(), Failed> {
        self.set(false)
    }

    fn set_high(&mut self) -> Result<(), Failed> {
        self.set(true)
    }
}

struct Count(Rig, usize);

impl EncoderCount for Count {
    type Error = Failed;

    fn count(&mut self) -> Result<u16, Failed> {
        self.0.count(self.1)
    }
}

struct Eye(Rig);

impl PositionSensor<3> for Eye {
    type Error = Failed;

    fn measure(&mut self) -> Result<Option<[f32; 3]>, Failed> {
        self.0.measure()
    }
}

impl PositionSensor<2> for Eye {
    type Error = Failed;

    fn measure(&mut self) -> Result<Option<[f32; 2]>, Failed> {
        Ok(self.0.measure()?.map(|[y, z, _]| [y, z]))
    }
}

/// Actuators whose shares are looked at, and what has come of them.
struct Checked<A> {
    actuators: A,
    rig: Rig,
}

impl<A: Actuators<2>> Actuators<2> for Checked<A> {
    fn apply(&mut self, shares: [f32; 2]) -> Result<(), ActuatorError> {
        let result = self.actuators.apply(shares);
        let mut h = self.rig.0.borrow_mut();
        for (i, share) in shares.into_iter().enumerate() {
            if !(-1.0..=1.0).contains(&share) {
                h.misuse.push(format!("share {share}"));
            }
            let duty = (share.abs() * f32::from(MAX_DUTY) + 0.5) as u16;
            if result.is_ok() && h.duty[i] != duty {
                let found = h.duty[i];
                h.misuse.push(format!("a share of {share} is a duty of {found}"));
            }
            // Forwards is low, pressure is high. A valve that cannot be closed stays on its old side until
            // the loop stops everything, at once.
            if result.is_ok() && h.duty[i] != 0 && h.pins[i] != ((share > 0.0) == h.is_leg) {
                h.misuse.push(format!("output {i} is open on the wrong side"));
            }
            if h.is_leg
                && result.is_ok()
                && share != 0.0
                && !h.pins[if share > 0.0 { 2 } else { 3 }]
            {
                h.misuse.push(format!("chamber {i} without a pump"));
            }
        }
        h.driven += u32::from(shares != [0.0; 2]);
        result
    }

    fn stop(&mut self) -> Result<(), ActuatorError> {
        self.actuators.stop()
    }
}

// Loops

/// Both loops, by the period of their ticks (µs).
const LEG_US: u64 = 50_000;
const ROSBOT_US: u64 = 10_000;

/// A leg whose every tick is a sample.
const LEG_SETTINGS: SoftLegSettings = SoftLegSettings {
    ticks_per_sample: 1,
    supply_volt: 12.0,
    watchdog_us: 1_000_000,
    blind_samples: 10,
};

/// Builds a leg on a rig and hands it, with its frames, to a test.
fn leg<T>(
    model: &Model<'static>,
    rig: &Rig,
    settings: SoftLegSettings,
    test: impl FnOnce(&mut dyn ControlLoop<2>, &mut Frames<'_>) -> T,
) -> T {
    rig.0.borrow_mut().is_leg = true;
    let chamber = |i| Chamber::new(Duty(rig.clone(), i), Level(rig.clone(), i));
    let actuators = Pneumatics {
        bending: chamber(0),
        extension: chamber(1),
        input_pump: Level(rig.clone(), 2),
        exhaust_pump: Level(rig.clone(), 3),
    };
    let actuators = Checked { actuators, rig: rig.clone() };
    let mut queue = Queue::<4>::new();
    let (producer, mut frames) = queue.split();
    let sensor = Eye(rig.clone());
    let telemetry = Telemetry::new(producer);
    let mut robot = SoftLeg::<_, _, 5>::new(model, actuators, sensor, settings, telemetry).unwrap();
    test(&mut robot, &mut frames)
}

/// The same for a ROSbot.
fn rosbot<T>(
    model: &Model<'static>,
    rig: &Rig,
    settings: RosbotSettings,
    test: impl FnOnce(&mut dyn ControlLoop<2>, &mut Frames<'_>) -> T,
) -> T {
    rig.0.borrow_mut().is_leg = false;
    let motor = |i| Motor::new(Duty(rig.clone(), i), Level(rig.clone(), i));
    let actuators =
        Checked { actuators: Sides { right: motor(0), left: motor(1) }, rig: rig.clone() };
    let mut queue = Queue::<4>::new();
    let (producer, mut frames) = queue.split();
    let devices = (actuators, (Count(rig.clone(), 0), Count(rig.clone(), 1)), Eye(rig.clone()));
    let telemetry = Telemetry::new(producer);
    let mut robot = Rosbot::<_, _, _, 5>::new(model, devices, settings, telemetry).unwrap();
    test(&mut robot, &mut frames)
}

/// Ticks a loop every period from `*now_us` on.
fn run(robot: &mut dyn ControlLoop<2>, now_us: &mut u64, period_us: u64, ticks: usize) {
    for _ in 0..ticks {
        robot.tick(*now_us);
        robot.finish(*now_us + period_us / 3);
        *now_us += period_us;
    }
}

// Whatever happens

#[derive(Clone, Debug)]
enum Event {
    Command(Command<2>),
    /// What the devices say, when the tick begins and when it ends.
    Tick {
        measured: Option<Option<[f32; 3]>>,
        turned: [i16; 2],
        begin: When,
        end: When,
    },
}

#[derive(Clone, Copy, Debug)]
enum When {
    InTime,
    At(u64),
    Back(u64),
    After(u64),
}

impl When {
    fn time(self, from_us: u64, in_time_us: u64) -> u64 {
        match self {
            Self::InTime => from_us.saturating_add(in_time_us),
            Self::At(us) => us,
            Self::Back(us) => from_us.saturating_sub(us),
            Self::After(us) => from_us.saturating_add(us),
        }
    }
}

fn number() -> impl Strategy<Value = f32> {
    prop_oneof![
        12 => -3.0..3.0_f32,
        2 => prop::num::f32::ANY,
        1 => prop::sample::select(vec![
            f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45, -0.0,
        ]),
    ]
}

/// `wildness`: how many of a hundred things are out of order.
fn event(wildness: u32) -> impl Strategy<Value = Event> {
    let (w, calm) = (wildness, 100 - wildness);
    let when = move || {
        prop_oneof![
            calm * 10 => Just(When::InTime),
            w => any::<u64>().prop_map(When::At),
            w => Just(When::At(u64::MAX)),
            w => (0..100_000_u64).prop_map(When::Back),
            w => (0..200_000_u64).prop_map(When::After),
            w => Just(When::After(0)),
        ]
    };
    let measured = prop_oneof![
        calm * 5 => prop::array::uniform3(-0.5..0.5_f32).prop_map(|x| Some(Some(x))),
        w => prop::array::uniform3(number()).prop_map(|x| Some(Some(x))),
        5 => Just(Some(None)),
        w => Just(None),
    ];
    let turned = prop_oneof![
        calm * 5 => prop::array::uniform2(-60..60_i16),
        w => prop::array::uniform2(any::<i16>()),
    ];
    let command = prop_oneof![
        6 => Just(Command::Start),
        10 => prop::array::uniform2(-20.0..20.0_f32).prop_map(Command::Inputs),
        w / 10 => prop::array::uniform2(number()).prop_map(Command::Inputs),
        w / 10 => Just(Command::Stop),
        6 => Just(Command::Reset),
    ];
    let tick = (measured, turned, when(), when())
        .prop_map(|(measured, turned, begin, end)| Event::Tick { measured, turned, begin, end });
    prop_oneof![4 => tick, 2 => command.prop_map(Event::Command)]
}

fn check_off(rig: &Rig, mode: Mode) -> Result<(), TestCaseError> {
    prop_assert!(mode == Mode::Running || rig.is_off(), "{mode:?}: {:?}", rig.0.borrow());
    let misuse = rig.misuse();
    prop_assert!(misuse.is_empty(), "{misuse:?}");
    Ok(())
}

fn whatever_happens(
    robot: &mut dyn ControlLoop<2>,
    frames: &mut Frames<'_>,
    rig: &Rig,
    period_us: u64,
    events: &[Event],
) -> Result<u32, TestCaseError> {
    let mut now_us = 0_u64;
    let mut ran = 0;
    for event in events {
        match event {
            Event::Command(command) => {
                robot.command(*command);
                // In the middle of a tick, or between two.
                let mode = robot.finish(now_us);
                check_off(rig, mode)?;
            }
            Event::Tick { measured, turned, begin, end } => {
                let before = rig.0.borrow().counts;
                rig.0.borrow_mut().counts =
                    [0, 1].map(|i| before[i].wrapping_add_signed(turned[i]));
                rig.measures(*measured);
                now_us = begin.time(now_us, period_us);
                let mode = robot.tick(now_us);
                prop_assert_eq!(mode, robot.mode());
                check_off(rig, mode)?;
                if mode == Mode::Running {
                    prop_assert!(!robot.alarms().intersects(Alarms::SAFE), "{:?}", robot.alarms());
                    ran += 1;
                }
                let ended_us = end.time(now_us, period_us / 10);
                check_off(rig, robot.finish(ended_us))?;
            }
        }
        while let Some(frame) = frames.dequeue() {
            prop_assert!(frame.applied.iter().all(|u| u.is_finite()));
            prop_assert!(frame.measured.iter().all(|u| u.is_finite()));
            prop_assert!(frame.predicted.iter().all(|u| u.is_finite()));
            prop_assert!(frame.ahead.iter().all(|u| u.is_finite()));
        }
    }
    Ok(ran)
}

#[test]
fn no_sequence_of_events_leaves_an_actuator_on() {
    const CASES: u32 = 1000;
    let strategy = prop::sample::select(vec![2, 10, 40])
        .prop_flat_map(|wildness| prop::collection::vec(event(wildness), 1..200))
        .prop_flat_map(|events| (Just(events), any::<bool>()));
    for (name, models) in [
        ("leg", [&PLAIN, &PLAIN_BOUNDED, &LEG, &LEG_BOUNDED]),
        ("rosbot", [&ROSBOT, &ROSBOT_BOUNDED, &ROSBOT, &ROSBOT_BOUNDED]),
    ] {
        let (ticks, driven) = (Cell::new(0), Cell::new(0));
        let mut runner = TestRunner::new(Config {
            cases: CASES,
            failure_persistence: None,
            ..Config::default()
        });
        let which = Cell::new(0_usize);
        let outcome = runner.run(&strategy, |(events, short)| {
            which.set(which.get() + 1);
            let model: &Model<'static> = models[which.get() % models.len()];
            let rig = Rig::default();
            let watchdog_us = if short { 300_000 } else { 10_000_000 };
            let ran = if name == "leg" {
                let ticks_per_sample = if short { 1 } else { 3 };
                let settings = SoftLegSettings { watchdog_us, ticks_per_sample, ..LEG_SETTINGS };
                let period_us = LEG_US / u64::from(ticks_per_sample);
                leg(model, &rig, settings, |robot, frames| {
                    whatever_happens(robot, frames, &rig, period_us, &events)
                })
            } else {
                let ticks_per_sample = if short { 2 } else { 10 };
                let settings =
                    RosbotSettings { watchdog_us, ticks_per_sample, ..RosbotSettings::default() };
                let period_us = 100_000 / u64::from(ticks_per_sample);
                rosbot(model, &rig, settings, |robot, frames| {
                    whatever_happens(robot, frames, &rig, period_us, &events)
                })
            };
            ticks.set(ticks.get() + ran?);
            driven.set(driven.get() + rig.0.borrow().driven);
            Ok(())
        });
        outcome.unwrap_or_else(|error| panic!("{name}: {error}"));
        println!(
            "{name}: {} running ticks, {} of them with an actuator on",
            ticks.get(),
            driven.get()
        );
        // The test is worth something only while the robots run.
        assert!(
            ticks.get() > 5 * CASES && driven.get() > 3 * CASES,
            "{name}: {ticks:?} {driven:?}"
        );
    }
}

// Devices that fail

/// Drives a loop back and forth with a device that breaks; what became of the tick in which it did.
fn with_broken(
    robot: &mut dyn ControlLoop<2>,
    frames: &mut Frames<'_>,
    rig: &Rig,
    period_us: u64,
    broken: Broken,
) -> Option<(Mode, Mode, Alarms)> {
    let (mut now_us, mut found) = (0, None);
    for tick in 0..80_u16 {
        let before = robot.mode();
        let calls = rig.0.borrow().failed;
        // Wheels turn the way that they are driven: high is backwards.
        let mut hardware = rig.0.borrow_mut();
        for wheel in 0..2 {
            let turned = if hardware.pins[wheel] { -20 } else { 20 };
            hardware.counts[wheel] = hardware.counts[wheel].wrapping_add_signed(turned);
        }
        drop(hardware);
        let after = robot.tick(now_us);
        assert!(
            after == Mode::Running || rig.is_off(),
            "{broken:?}: {after:?} {:?}",
            rig.0.borrow()
        );
        if rig.0.borrow().failed && !calls {
            found = Some((before, after, robot.alarms()));
        }
        let after = robot.finish(now_us + 1000);
        assert!(
            after == Mode::Running || rig.is_off(),
            "{broken:?}: {after:?} {:?}",
            rig.0.borrow()
        );
        assert!(rig.misuse().is_empty(), "{broken:?}: {:?}", rig.misuse());
        now_us += period_us;
        if tick == 2 {
            robot.command(Command::Start);
        }
        let sign = if tick % 20 < 10 { 1.0 } else { -1.0 };
        robot.command(Command::Inputs([6.0 * sign, -5.0 * sign]));
        while frames.dequeue().is_some() {}
    }
    found
}

#[test]
fn an_actuator_that_fails_stops_the_robot_in_the_same_tick() {
    let mut counts = [0_usize; 2];
    // A leg whose ticks are samples, one with five ticks each, and a ROSbot.
    for (is_leg, ticks_per_sample) in [(true, 1), (true, 5), (false, 10)] {
        let devices = if is_leg { PWM..ENCODER } else { PWM..PUMP };
        let cases = devices.flat_map(|device| (1..40).map(move |call| (device, call)));
        let ways = [(false, false), (false, true), (true, false), (true, true)];
        for ((device, call), (forever, does_it)) in
            cases.flat_map(|case| ways.map(|way| (case, way)))
        {
            let broken = Broken { device, call, forever, does_it };
            let rig = Rig::new(is_leg);
            rig.0.borrow_mut().broken = Some(broken);
            let outcome = if is_leg {
                let settings = SoftLegSettings { ticks_per_sample, ..LEG_SETTINGS };
                leg(&PLAIN, &rig, settings, |robot, frames| {
                    let period_us = LEG_US / u64::from(ticks_per_sample);
                    with_broken(robot, frames, &rig, period_us, broken)
                })
            } else {
                rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
                    with_broken(robot, frames, &rig, ROSBOT_US, broken)
                })
            };
            // Some failed when the tick ended, or never were called as often.
            let Some((before, after, alarms)) = outcome else { continue };
            assert!(alarms.contains(Alarms::ACTUATOR), "{broken:?}: {alarms}");
            let expected = if before == Mode::Running { Mode::Safe } else { before };
            assert_eq!(after, expected, "{broken:?}");
            counts[usize::from(before == Mode::Running)] += 1;
        }
    }
    println!("failures in idle and in running ticks: {counts:?}");
    assert!(counts[1] > 500, "{counts:?}");
}

#[test]
fn a_sensor_or_encoder_may_fail_now_and_then_but_not_on_and_on() {
    for (device, forever, expected) in [
        (ENCODER, false, Alarms::none()),
        (ENCODER + 1, false, Alarms::none()),
        (ENCODER, true, Alarms::ENCODER),
        (ENCODER + 1, true, Alarms::ENCODER),
        (SENSOR, false, Alarms::none()),
        (SENSOR, true, Alarms::SENSOR_BAD),
    ] {
        // The sensor of a ROSbot is asked once in ten ticks.
        let call = if device == SENSOR { 3 } else { 20 };
        let rig = Rig::new(false);
        let broken = Broken { device, call, forever, does_it: false };
        rig.0.borrow_mut().broken = Some(broken);
        let alarms = rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
            with_broken(robot, frames, &rig, ROSBOT_US, broken);
            robot.alarms() & Alarms::SAFE
        });
        assert_eq!(alarms, expected, "{device} {forever}");
    }
}

// The state machine

/// A leg in a mode, at the time of its next tick.
fn leg_in<T>(
    mode: Mode,
    test: impl FnOnce(&mut dyn ControlLoop<2>, &mut Frames<'_>, &Rig, u64) -> T,
) -> T {
    let rig = Rig::new(true);
    leg(&PLAIN_BOUNDED, &rig.clone(), LEG_SETTINGS, |robot, frames| {
        let mut now_us = 0;
        run(robot, &mut now_us, LEG_US, 2);
        if mode != Mode::Idle {
            robot.command(Command::Start);
        }
        run(robot, &mut now_us, LEG_US, 2);
        if mode == Mode::Safe {
            now_us += LEG_US;
            run(robot, &mut now_us, LEG_US, 1);
        }
        assert_eq!(robot.mode(), mode);
        while frames.dequeue().is_some() {}
        test(robot, frames, &rig, now_us)
    })
}

#[test]
fn every_command_in_every_mode() {
    use Mode::{Idle, Running, Safe};
    let inputs = Command::Inputs([1.0, 2.0]);
    let bad = Command::Inputs([1.0, f32::NAN]);
    for (command, after) in [
        (Command::Start, [Running, Running, Safe]),
        (inputs, [Idle, Running, Safe]),
        (bad, [Idle, Running, Safe]),
        (Command::Stop, [Idle, Idle, Safe]),
        (Command::Reset, [Idle, Running, Idle]),
    ] {
        for (before, after) in [Idle, Running, Safe].into_iter().zip(after) {
            leg_in(before, |robot, frames, rig, now_us| {
                let alarms = robot.alarms();
                robot.command(command);
                assert_eq!(robot.mode(), after, "{command:?} in {before:?}");
                robot.tick(now_us);
                assert_eq!(robot.mode(), after, "{command:?} in {before:?}");
                assert_eq!(rig.0.borrow().driven > 0, before == Running && command == inputs);
                // A start or a reset that has an effect forgets, nothing else does.
                let forgets = before != after && matches!(command, Command::Start | Command::Reset);
                let mut expected = if forgets { Alarms::none() } else { alarms };
                if matches!(command, Command::Inputs([_, u]) if u.is_nan()) {
                    expected |= Alarms::BAD_COMMAND;
                    assert_eq!(frames.dequeue().unwrap().noticed, Alarms::BAD_COMMAND);
                }
                assert_eq!(robot.alarms(), expected, "{command:?} in {before:?}");
            });
        }
    }
}

#[test]
fn every_alarm_in_every_mode() {
    let timing = Timing { period_us: 10, watchdog_us: 1000 };
    let flags = [
        Alarms::RESIDUAL,
        Alarms::OUTLIER,
        Alarms::WHEEL,
        Alarms::BAD_COMMAND,
        Alarms::OUT_OF_RANGE,
        Alarms::SENSOR_LATE,
        Alarms::UPDATE,
    ];
    for (bit, (alarm, name)) in Alarms::all().enumerate() {
        assert_eq!(alarm.bits(), 1 << bit, "{name}");
        assert_ne!(alarm.intersects(Alarms::SAFE), flags.contains(&alarm), "{name}");
        let mut supervisor = Supervisor::new(timing);
        supervisor.raise(alarm);
        assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Idle, alarm));
        supervisor.start();
        assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Running, Alarms::none()));
        supervisor.raise(alarm);
        let safe = alarm.intersects(Alarms::SAFE);
        let expected = if safe { Mode::Safe } else { Mode::Running };
        assert_eq!((supervisor.mode(), supervisor.alarms()), (expected, alarm), "{alarm}");
        if safe {
            supervisor.stop();
            supervisor.start();
            assert_eq!(supervisor.mode(), Mode::Safe, "only a reset leads out");
            supervisor.raise(Alarms::WHEEL);
            assert_eq!(supervisor.alarms(), alarm | Alarms::WHEEL);
            supervisor.reset();
            assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Idle, Alarms::none()));
        }
        assert!(supervisor.take_recent().contains(alarm), "a reset does not hide it from the host");
        assert_eq!(supervisor.take_recent(), Alarms::none());
    }
}

#[test]
fn a_robot_at_rest_is_held_in_safe_and_a_running_one_is_not() {
    let mut supervisor = Supervisor::new(Timing { period_us: 10, watchdog_us: 1000 });
    supervisor.begin(0);
    supervisor.start();
    supervisor.hold(true);
    assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Running, Alarms::none()));
    supervisor.stop();
    for _ in 0..3 {
        supervisor.hold(true);
        for lead_out in [Supervisor::reset, Supervisor::start, Supervisor::stop] {
            lead_out(&mut supervisor);
            assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Safe, Alarms::UPDATE));
        }
    }
    assert_eq!(supervisor.take_recent(), Alarms::UPDATE);
    supervisor.hold(true);
    assert_eq!(supervisor.take_recent(), Alarms::none(), "said once");
    // It took as long as it took.
    supervisor.pause();
    supervisor.begin(1_000_000);
    assert_eq!(supervisor.alarms(), Alarms::UPDATE);
    supervisor.hold(false);
    assert_eq!(supervisor.mode(), Mode::Safe, "only a reset leads out");
    supervisor.reset();
    supervisor.start();
    supervisor.pause();
    supervisor.begin(2_000_000);
    // A running one is never late on purpose.
    assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Safe, Alarms::LATE));
}

#[test]
fn a_robot_that_starts_right_after_a_pause_runs() {
    let mut supervisor = Supervisor::new(Timing { period_us: 10, watchdog_us: 1000 });
    supervisor.begin(1_000_000);
    supervisor.pause();
    supervisor.start();
    for now_us in (2_000_000..=2_001_000).step_by(10) {
        assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Running, Alarms::none()));
        supervisor.begin(now_us);
    }
    // Its watchdog counts from the first tick.
    supervisor.begin(2_001_010);
    assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Safe, Alarms::HOST_SILENT));
}

#[test]
fn times_that_are_wrong_stop_a_running_robot() {
    let ahead = |us| When::After(us);
    for (begin, end, expected) in [
        (ahead(LEG_US), ahead(1000), Alarms::none()),
        // A tick may be a quarter of a period late and half of one early, and take a period.
        (ahead(LEG_US + LEG_US / 4), ahead(LEG_US), Alarms::none()),
        (ahead(LEG_US / 2), ahead(0), Alarms::none()),
        (ahead(LEG_US + LEG_US / 4 + 1), ahead(1000), Alarms::LATE),
        (ahead(LEG_US), ahead(LEG_US + 1), Alarms::LATE),
        (ahead(LEG_US / 2 - 1), ahead(1000), Alarms::CLOCK),
        (ahead(0), ahead(1000), Alarms::CLOCK),
        (When::Back(1), ahead(1000), Alarms::CLOCK),
        (ahead(LEG_US), When::Back(1), Alarms::CLOCK),
        (When::At(u64::MAX), ahead(0), Alarms::LATE),
        (ahead(LEG_US), When::At(u64::MAX), Alarms::LATE),
    ] {
        leg_in(Mode::Running, |robot, frames, rig, next_us| {
            robot.command(Command::Inputs([6.0, -6.0]));
            let began_us = begin.time(next_us - LEG_US, 0);
            robot.tick(began_us);
            let ended_us = end.time(began_us, 0);
            let mode = robot.finish(ended_us);
            let safe = if expected.is_empty() { Mode::Running } else { Mode::Safe };
            assert_eq!((mode, robot.alarms()), (safe, expected), "{begin:?} {end:?}");
            assert_eq!(rig.is_off(), safe == Mode::Safe, "at once");
            // What was noticed at the end of a tick is in the next frame, with the time it took.
            robot.tick(ended_us);
            let noticed = [frames.dequeue(), frames.dequeue()].map(Option::unwrap);
            assert!((noticed[0].noticed | noticed[1].noticed).contains(expected));
            let taken = ended_us.saturating_sub(began_us).min(u32::MAX.into()) as u32;
            assert_eq!(noticed[1].worst_tick_us, taken);
        });
    }
}

#[test]
fn a_silent_host_stops_the_robot_by_time_or_by_ticks() {
    // The watchdog is 1 s. By a true clock it takes 20 ticks of 50 ms, of 62.5 ms (late, but within
    // what is allowed) 16; by a clock at half the speed the ticks count.
    for (tick_us, ticks) in [(LEG_US, 20), (LEG_US * 5 / 4, 16), (LEG_US / 2, 20)] {
        leg_in(Mode::Running, |robot, frames, rig, next_us| {
            robot.command(Command::Inputs([6.0, -6.0]));
            // Not followed, and no sign of life either.
            let bad = Command::Inputs([f32::INFINITY, 0.0]);
            let mut now_us = next_us - LEG_US;
            for tick in 1..=ticks {
                now_us += tick_us;
                robot.command(bad);
                assert_eq!(robot.tick(now_us), Mode::Running, "{tick_us} µs: tick {tick}");
                assert!(!rig.is_off());
                robot.finish(now_us);
                while frames.dequeue().is_some() {}
            }
            assert_eq!(robot.tick(now_us + tick_us), Mode::Safe, "{tick_us} µs");
            // This leg does not move as its model says; that does not stop it.
            assert!(robot.alarms().contains(Alarms::HOST_SILENT | Alarms::BAD_COMMAND));
            assert!(rig.is_off());
        });
    }
}

#[test]
fn a_start_without_a_measurement_is_refused() {
    for is_leg in [true, false] {
        let rig = Rig::new(is_leg);
        let test = |robot: &mut dyn ControlLoop<2>, _: &mut Frames<'_>| {
            let period_us = if is_leg { LEG_US } else { ROSBOT_US };
            let sample = if is_leg { 1 } else { 10 };
            let mut now_us = 0;
            let mut start = |robot: &mut dyn ControlLoop<2>, measured| {
                rig.measures(measured);
                run(robot, &mut now_us, period_us, sample);
                robot.command(Command::Start);
                let mode = robot.mode();
                robot.command(Command::Stop);
                mode
            };
            robot.command(Command::Start);
            assert_eq!(robot.mode(), Mode::Idle, "before the first tick");
            let taken = Some(Some([0.1; 3]));
            let nan = Some(Some([f32::NAN; 3]));
            for (measured, mode) in [
                (Some(None), Mode::Idle),
                (nan, Mode::Idle),
                (None, Mode::Idle),
                (taken, Mode::Running),
                (Some(None), Mode::Idle),
                (taken, Mode::Running),
                (nan, Mode::Idle),
                (taken, Mode::Running),
            ] {
                assert_eq!(start(robot, measured), mode, "{measured:?}");
            }
        };
        if is_leg {
            leg(&LEG, &rig, LEG_SETTINGS, test);
        } else {
            rosbot(&ROSBOT, &rig, RosbotSettings::default(), test);
        }
    }
}

#[test]
fn inputs_are_held_within_the_ranges_of_model_and_supply() {
    // Trained in ±24 V and −6 to 12 V, on a supply of 12 V.
    for (asked, applied) in [
        ([1.5, -2.5], [1.5, -2.5]),
        ([100.0, 100.0], [12.0, 12.0]),
        ([f32::MIN, f32::MIN], [-12.0, -6.0]),
        ([-0.0, 1e-45], [0.0, 1e-45]),
    ] {
        leg_in(Mode::Running, |robot, frames, rig, now_us| {
            robot.command(Command::Inputs(asked));
            robot.tick(now_us);
            let duty = applied.map(|u: f32| (u.abs() / 12.0 * 999.0 + 0.5) as u16);
            assert_eq!((rig.0.borrow().duty, rig.misuse()), (duty, vec![]));
            robot.finish(now_us + 1);
            robot.tick(now_us + LEG_US);
            assert_eq!(frames.dequeue().unwrap().applied, [0.0, 0.0], "until the first tick");
            assert_eq!(frames.dequeue().unwrap().applied, applied, "{asked:?}");
        });
    }
}

#[test]
fn a_start_begins_with_nothing_and_a_stop_ends_within_the_tick() {
    leg_in(Mode::Idle, |robot, _, rig, now_us| {
        robot.command(Command::Inputs([6.0, 6.0]));
        robot.command(Command::Start);
        robot.tick(now_us);
        assert!(rig.is_off(), "what was asked for before the start is forgotten");
        robot.command(Command::Inputs([6.0, 6.0]));
        robot.finish(now_us + 1);
        robot.tick(now_us + LEG_US);
        assert!(!rig.is_off());
        robot.command(Command::Stop);
        robot.finish(now_us + LEG_US + 1);
        assert!(rig.is_off(), "not only at the next tick");
    });
}

#[test]
fn frames_are_numbered_and_dropped_ones_counted() {
    leg_in(Mode::Running, |robot, frames, _, mut now_us| {
        let before = 4;
        run(robot, &mut now_us, LEG_US, 1);
        let first = frames.dequeue().unwrap();
        assert_eq!((first.sequence, first.dropped, first.noticed), (before, 1, Alarms::none()));
        // Room for three: the fourth and the fifth are lost, and what was noticed in them.
        run(robot, &mut now_us, LEG_US, 3);
        robot.command(Command::Inputs([f32::NAN; 2]));
        run(robot, &mut now_us, LEG_US, 2);
        let kept = [(); 3].map(|()| frames.dequeue().unwrap());
        assert_eq!(kept.each_ref().map(|frame| frame.sequence), [1, 2, 3].map(|k| before + k));
        run(robot, &mut now_us, LEG_US, 1);
        let frame = frames.dequeue().unwrap();
        assert_eq!((frame.sequence, frame.dropped), (before + 6, 3));
        assert_eq!((frame.noticed, frame.alarms), (Alarms::none(), Alarms::BAD_COMMAND));
        assert_eq!(frame.time_us, now_us - LEG_US);
    });
}

// A leg with several ticks per sample

/// Of 2 ms, the usual ones, for a leg that runs, from the tick after a sample on.
fn ticking_leg<T>(
    test: impl FnOnce(&mut dyn ControlLoop<2>, &mut Frames<'_>, &Rig, u64) -> T,
) -> T {
    let rig = Rig::new(true);
    leg(&PLAIN_BOUNDED, &rig.clone(), SoftLegSettings::default(), |robot, frames| {
        let mut now_us = 0;
        run(robot, &mut now_us, TICK_US, 1);
        robot.command(Command::Start);
        run(robot, &mut now_us, TICK_US, 25);
        while frames.dequeue().is_some() {}
        test(robot, frames, &rig, now_us)
    })
}

const TICK_US: u64 = LEG_US / 25;

/// Duties of voltages.
fn duties(volts: [f32; 2]) -> [u16; 2] {
    volts.map(|u| (u.abs() / 12.0 * f32::from(MAX_DUTY) + 0.5) as u16)
}

#[test]
fn inputs_of_a_leg_are_constant_from_sample_to_sample() {
    for ticks_per_sample in [1_u8, 2, 25, 255] {
        let rig = Rig::new(true);
        let settings = SoftLegSettings { ticks_per_sample, ..LEG_SETTINGS };
        leg(&PLAIN, &rig.clone(), settings, |robot, frames| {
            let period_us = LEG_US / u64::from(ticks_per_sample);
            let ticks = u32::from(ticks_per_sample);
            let mut now_us = 0;
            let mut acts = [0.0; 2];
            let mut samples = std::collections::VecDeque::new();
            for tick in 0..4 * ticks {
                // Fifths and sevenths are no floats.
                let u = [tick as f32 / 5.0 % 9.0, -1.0 - tick as f32 / 7.0 % 5.0];
                if tick == 1 {
                    robot.command(Command::Start);
                }
                robot.command(Command::Inputs(u));
                if tick % ticks == 0 {
                    assert!(samples.is_empty(), "a frame before the next sample");
                    samples.push_back((now_us, acts));
                    acts = if tick > 0 { u } else { [0.0; 2] };
                }
                run(robot, &mut now_us, period_us, 1);
                if let Some(frame) = frames.dequeue() {
                    let (time_us, acted) = samples.pop_front().expect("a sample");
                    assert_eq!(frame.applied, acted, "tick {tick} of {ticks}");
                    assert_eq!(frame.time_us, time_us);
                }
                assert!(samples.is_empty() || ticks >= 4, "at once where ticks are few");
                assert!(frames.dequeue().is_none());
                assert_eq!(rig.0.borrow().duty, duties(acts), "tick {tick} of {ticks}");
            }
            // Every tick sets them anew.
            assert!(rig.0.borrow().calls[PWM] >= 4 * ticks);
            assert_eq!((robot.mode(), rig.misuse()), (Mode::Running, vec![]));
        });
    }
}

#[test]
fn a_leg_is_switched_off_at_the_tick_and_predicted_with_what_acted() {
    type Break = fn(&mut dyn ControlLoop<2>, &mut u64);
    let breaks: [(Break, Mode); 3] = [
        (|robot, _| robot.command(Command::Stop), Mode::Idle),
        // A tick that is lost.
        (|_, now_us| *now_us += TICK_US, Mode::Safe),
        // One that takes too long; what it began it has not done.
        (
            |robot, now_us| {
                robot.tick(*now_us);
                robot.finish(*now_us + TICK_US + 1);
                *now_us += TICK_US;
            },
            Mode::Safe,
        ),
    ];
    for (broken, (break_it, mode)) in breaks.into_iter().enumerate() {
        for after in [1, 10, 23] {
            ticking_leg(|robot, frames, rig, mut now_us| {
                robot.command(Command::Inputs([6.0, -3.0]));
                // Until the next sample, which is the first of them, they do not act.
                run(robot, &mut now_us, TICK_US, 24);
                assert!(rig.is_off());
                while frames.dequeue().is_some() {}
                run(robot, &mut now_us, TICK_US, after);
                assert_eq!(rig.0.borrow().duty, duties([6.0, -3.0]));
                break_it(robot, &mut now_us);
                let over = usize::from(broken == 2);
                run(robot, &mut now_us, TICK_US, 1);
                assert_eq!((robot.mode(), rig.is_off()), (mode, true));
                run(robot, &mut now_us, TICK_US, 25 - over - after);
                run(robot, &mut now_us, TICK_US, 10);
                // However late it comes, it says how things were at the sample.
                let frame = frames.dequeue().unwrap();
                assert_eq!((&frame.applied[..], frame.mode), (&[0.0; 2][..], Mode::Running));
                assert_eq!(frame.alarms, Alarms::none());
                let frame = frames.dequeue().unwrap();
                for (applied, u) in frame.applied.iter().zip([6.0, -3.0]) {
                    assert!((applied - u * after as f32 / 25.0).abs() < 1e-5, "{applied}");
                }
                assert_eq!(frame.mode, mode);
            });
        }
    }
}

#[test]
fn a_leg_that_starts_between_two_samples_waits_for_the_next() {
    ticking_leg(|robot, frames, rig, mut now_us| {
        let inputs = Command::Inputs([6.0, 6.0]);
        robot.command(inputs);
        run(robot, &mut now_us, TICK_US, 30);
        assert!(!rig.is_off());
        // What acted before the stop does not go on.
        for command in [Command::Stop, Command::Start, inputs] {
            robot.command(command);
        }
        while frames.dequeue().is_some() {}
        for tick in 30..49 {
            run(robot, &mut now_us, TICK_US, 1);
            assert_eq!((robot.mode(), rig.is_off()), (Mode::Running, true), "tick {tick}");
        }
        run(robot, &mut now_us, TICK_US, 1);
        assert!(!rig.is_off() && rig.misuse().is_empty());
        // Ticks 24 to 29.
        run(robot, &mut now_us, TICK_US, 10);
        let applied = std::iter::from_fn(|| frames.dequeue()).last().unwrap().applied[0];
        assert!((applied - 6.0 * 6.0 / 25.0).abs() < 1e-5, "{applied}");
    });
}

#[test]
fn a_leg_whose_host_is_silent_stops_at_the_tick() {
    ticking_leg(|robot, _, rig, mut now_us| {
        run(robot, &mut now_us, TICK_US, 7);
        robot.command(Command::Inputs([6.0, 6.0]));
        run(robot, &mut now_us, TICK_US, 500);
        assert_eq!((robot.mode(), rig.is_off()), (Mode::Running, false));
        run(robot, &mut now_us, TICK_US, 1);
        assert!(robot.alarms().contains(Alarms::HOST_SILENT) && rig.is_off());
        assert_eq!(robot.mode(), Mode::Safe);
    });
}

#[test]
fn no_ticks_are_no_sample() {
    let rig = Rig::new(true);
    let chamber = |i| Chamber::new(Duty(rig.clone(), i), Level(rig.clone(), i));
    let pneumatics = Pneumatics {
        bending: chamber(0),
        extension: chamber(1),
        input_pump: Level(rig.clone(), 2),
        exhaust_pump: Level(rig.clone(), 3),
    };
    let settings = SoftLegSettings { ticks_per_sample: 0, ..LEG_SETTINGS };
    let mut queue = Queue::<2>::new();
    let telemetry = Telemetry::new(queue.split().0);
    let refused =
        SoftLeg::<_, _, 5>::new(&PLAIN, pneumatics, Eye(rig.clone()), settings, telemetry);
    let field = "ticks_per_sample";
    assert_eq!(refused.err(), Some(ControlLoopError::Setting { field }));

    let motor = |i| Motor::new(Duty(rig.clone(), i), Level(rig.clone(), i));
    let sides = Sides { right: motor(0), left: motor(1) };
    let devices = (sides, (Count(rig.clone(), 0), Count(rig.clone(), 1)), Eye(rig.clone()));
    let settings = RosbotSettings { ticks_per_sample: 0, ..RosbotSettings::default() };
    let mut queue = Queue::<2>::new();
    let telemetry = Telemetry::new(queue.split().0);
    let refused = Rosbot::<_, _, _, 5>::new(&ROSBOT, devices, settings, telemetry);
    assert_eq!(refused.err(), Some(ControlLoopError::Setting { field }));
}

// Whether the robot is as the model says

/// A tracker of the plain model that has seen one sample at the origin.
fn tracker(model: &'static Model<'static>, blind: u32) -> Tracker<'static, 'static, 2, 2, 3> {
    let mut tracker = Tracker::new(model, blind).unwrap();
    let first = tracker.sample(&[0.0; 2], Measurement::Taken([1.0, -1.0]), &[0.0; 2]);
    assert_eq!((first.predicted, first.steps), (None, 0));
    tracker
}

const U: [f32; 2] = [1.0, 0.5];

/// A sample that is measured `off` (mm) the prediction in y.
fn off(tracker: &mut Tracker<'static, 'static, 2, 2, 3>, off: f32) -> Tracked<2> {
    let [y, z] = tracker.clone().sample(&U, Measurement::Missing, &U).predicted.unwrap();
    tracker.sample(&U, Measurement::Taken([y + off, z]), &U)
}

proptest! {
    #![proptest_config(Config { failure_persistence: None, ..Config::default() })]

    #[test]
    fn an_error_that_stays_is_noticed_as_soon_as_promised(ratio in 1.02..7.9_f32, sign in any::<bool>()) {
        let mut tracker = tracker(&PLAIN_BOUNDED, 10);
        let excess = ratio.min(4.0) - 1.0;
        // One bound is 1 mm after one step.
        let error = if sign { ratio } else { -ratio };
        let noticed = (1..1000).find(|_| off(&mut tracker, error).alarms.contains(Alarms::RESIDUAL));
        let promised = (FAR / excess).ceil() as i32;
        // Sums are rounded, and 5 itself is not beyond 5.
        let exact = FAR / excess;
        let slack = i32::from((exact - exact.round()).abs() < 1e-3 * exact);
        // Often beyond its bound, it may be noticed before it has been far enough.
        prop_assert!(noticed.unwrap() <= promised + slack, "{noticed:?} {promised}");
    }

    #[test]
    fn within_the_bounds_nothing_is_noticed(errors in prop::collection::vec(-1.0..1.0_f32, 1..200)) {
        let mut tracker = tracker(&PLAIN_BOUNDED, 10);
        for error in errors {
            let tracked = off(&mut tracker, 0.999 * error);
            prop_assert_eq!(tracked.alarms, Alarms::none());
            prop_assert_eq!(tracked.steps, 1);
        }
    }

    #[test]
    fn one_wild_sample_is_an_outlier_and_no_residual(wild in 8.1..1e30_f32, calm in 5..20_usize) {
        let mut tracker = tracker(&PLAIN_BOUNDED, 10);
        for _ in 0..calm {
            prop_assert_eq!(off(&mut tracker, 0.5).alarms, Alarms::none());
        }
        let tracked = off(&mut tracker, wild);
        prop_assert_eq!((tracked.alarms, tracked.measured), (Alarms::OUTLIER, None));
        prop_assert!(!tracker.sees() && tracked.ratio > GATE && tracked.residual.is_some());
        // Predicted over two steps from the last one that was believed, without the wild one.
        let tracked = off(&mut tracker, 0.5);
        prop_assert_eq!((tracked.alarms, tracked.steps), (Alarms::none(), 2));
        prop_assert!((tracked.ratio - 0.25).abs() < 1e-3, "the bound of two steps: {}", tracked.ratio);
        prop_assert!(tracker.sees());
    }
}

/// What a sensor says of a leg that is predicted at `expected`, by a number.
fn said(what: u8, expected: [f32; 2], off: f32) -> Measurement<2> {
    let [y, z] = expected;
    match what {
        0 => Measurement::Missing,
        1 => Measurement::Late,
        2 => Measurement::Unreadable,
        3 => Measurement::Taken([f32::NAN, 0.0]),
        4 => Measurement::Taken([y + 1e3 * off, z]),
        _ => Measurement::Taken([y + off, z - off]),
    }
}

proptest! {
    #![proptest_config(Config { failure_persistence: None, ..Config::default() })]

    /// However the work of a sample is spread over ticks, what comes out is the same, to the bit.
    #[test]
    fn work_that_is_spread_is_the_same_work(
        samples in prop::collection::vec((0..12_u8, -3.0..3.0_f32, -12.0..12.0_f32, 1..9_usize), 1..80),
        plain in any::<bool>(),
    ) {
        let model = if plain { &PLAIN_BOUNDED } else { &LEG_BOUNDED };
        let mut at_once = Tracker::<2, 2, 7>::new(model, 10).unwrap();
        let mut spread = at_once.clone();
        for (what, off, u, steps) in samples {
            let (applied, held) = ([u, 0.5 * u], [u, -u]);
            let expected = at_once.clone().sample(&applied, Measurement::Missing, &held).predicted;
            let measured = said(what, expected.unwrap_or_default(), off);
            let whole = at_once.sample(&applied, measured, &held);
            let mut noticed = spread.take(&applied, measured, &held);
            prop_assert!(spread.path().is_empty() && !spread.is_done());
            prop_assert_eq!(spread.sees(), at_once.sees());
            // To the history, seven samples ahead, and the second prediction in a call of its own.
            let calls = 8_usize.div_ceil(steps) + 1;
            for call in 1..=calls {
                let before = spread.path().len();
                noticed |= spread.go_on(steps);
                prop_assert!(spread.path().len() - before <= steps);
                prop_assert!(spread.is_done() || call < calls);
            }
            prop_assert_eq!(noticed, whole.alarms);
            prop_assert_eq!(spread.tracked(), whole);
            prop_assert_eq!(spread.path(), at_once.path());
        }
    }
}

#[test]
fn a_sample_that_comes_too_early_loses_the_path_alone() {
    let mut whole = tracker(&LEG_BOUNDED, 10);
    let mut early = whole.clone();
    for k in 0..40_u8 {
        let u = [f32::from(k % 7) - 3.0, 1.0];
        let place = Measurement::Taken([0.1 * f32::from(k), -0.2 * f32::from(k)]);
        let measured = if k % 5 == 0 { Measurement::Missing } else { place };
        let expected = whole.sample(&u, measured, &u);
        early.take(&u, measured, &u);
        early.go_on(usize::from(k % 3));
        assert_eq!(early.tracked().predicted, expected.predicted, "{k}");
        assert_eq!(early.tracked().measured, expected.measured, "{k}");
    }
}

#[test]
fn a_model_that_keeps_more_than_there_is_room_for_is_refused() {
    // Of every coordinate the oldest sample and the oldest change are looked at.
    let observable = |source| Observable { source, lag: MAX_LAG as u8, centre: 0.0, gain: 1.0 };
    let sources = (0..8).flat_map(|i| [Source::State(i), Source::Increment(i)]);
    let state = State {
        name: "x",
        unit: "m",
        space: Space::Line,
        target: Target::Increment,
        limit: [f32::MIN, f32::MAX],
    };
    let structure = Structure::try_from(ModelRepr {
        robot: "wide",
        sample_time_s: 0.1,
        states: [state; 8].into_iter().collect(),
        inputs: [].into_iter().collect(),
        symmetry: Symmetry::None,
        observables: sources.map(observable).collect(),
        factors: (0..16)
            .map(|observable| Factor { observable, basis: Basis::Hermite, order: 1 })
            .collect(),
        blocks: [Block { factors: 1, max_degree: 0 }; 16].into_iter().collect(),
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    });
    let coefficients = [0.0; 8 * 2 * 16];
    let model = Model::new(structure.unwrap(), &coefficients, None).unwrap();
    let found = model.structure().kept();
    assert_eq!(found, 8 * (4 + 6 + 5));
    let field = "numbers of the history";
    let error = Tracker::<8, 0, 3>::new(&model, 10).unwrap_err();
    let expected = MAX_KEPT;
    assert_eq!(error, ControlLoopError::DimensionMismatch { field, expected, found });
    // An update says so before it is installed.
    let capacities = Capacities { room: 1 << 20, ..Capacities::new::<8, 0>(100_000, 0) };
    let misfit = capacities.check(&model, 1000).unwrap_err();
    assert_eq!((misfit.field, misfit.expected, misfit.found), (field, 84, 120));
}

#[test]
fn a_jump_is_believed_after_three_outliers() {
    let mut tracker = tracker(&PLAIN_BOUNDED, 10);
    for k in 1..=3 {
        let tracked = tracker.sample(&U, Measurement::Taken([500.0, 300.0]), &U);
        assert!(tracked.alarms.contains(Alarms::OUTLIER) && tracked.measured.is_none(), "{k}");
        // Wild samples in a row are no chance: from the second on they are a residual, too.
        assert_eq!(tracked.alarms.contains(Alarms::RESIDUAL), k > 1);
    }
    let tracked = tracker.sample(&U, Measurement::Taken([500.0, 300.0]), &U);
    assert_eq!((tracked.measured, tracked.steps), (Some([500.0, 300.0]), 4));
    assert!(!tracked.alarms.contains(Alarms::OUTLIER) && tracker.sees());
    // From there on the robot is where it is.
    let tracked = off(&mut tracker, 0.0);
    assert_eq!((tracked.steps, tracked.ratio), (1, 0.0));
    assert!((tracked.predicted.unwrap()[0] - 450.1).abs() < 0.1);
    // The sums have gone up to twice the threshold, and are forgotten within ten samples.
    let forgotten = (0..20).find(|_| off(&mut tracker, 0.0).alarms.is_empty());
    assert!(forgotten.unwrap() <= 5, "{forgotten:?}");
}

#[test]
fn missing_measurements_use_the_bounds_of_as_many_steps() {
    // The bounds of y are 1, 2, 3, 4 mm after 1, 2, 4, 8 steps.
    for (missing, bound) in [(0, 1.0), (1, 2.0), (2, 3.0), (3, 3.0), (4, 4.0), (7, 4.0)] {
        let mut tracker = tracker(&PLAIN_BOUNDED, 10);
        for step in 1..=missing {
            let tracked = tracker.sample(&U, Measurement::Missing, &U);
            assert_eq!((tracked.steps, tracked.measured, tracked.residual), (step, None, None));
            assert_eq!((tracked.alarms, tracker.path().len()), (Alarms::none(), 3));
        }
        let tracked = off(&mut tracker, 0.9);
        assert_eq!(tracked.steps, missing + 1);
        assert!((tracked.ratio - 0.9 / bound).abs() < 1e-4, "{missing}: {}", tracked.ratio);
    }
}

#[test]
fn a_sensor_is_lost_where_the_prediction_cannot_be_trusted() {
    // Bounds reach over eight steps; without them the loop's own limit holds.
    let models =
        [(&PLAIN_BOUNDED, 10, 8), (&PLAIN_BOUNDED, 5, 5), (&PLAIN, 10, 10), (&PLAIN, 0, 0)];
    for (model, blind, limit) in models {
        let mut tracker = tracker(model, blind);
        for _ in 0..limit {
            assert_eq!(tracker.sample(&U, Measurement::Missing, &U).alarms, Alarms::none());
        }
        let tracked = tracker.sample(&U, Measurement::Missing, &U);
        assert_eq!(tracked.alarms, Alarms::SENSOR_LOST, "{blind}");
        let tracked = tracker.sample(&U, Measurement::Taken([0.0; 2]), &U);
        assert!(!tracked.alarms.contains(Alarms::SENSOR_LOST));
    }
}

#[test]
fn a_sensor_too_slow_for_the_model_to_predict_is_lost() {
    // The leg looks back at several samples, and never sees two in a row. They fill before the first that
    // could be predicted; after that it may be blind for the eight samples of the bounds.
    let allowed = LEG_BOUNDED.structure().lag() + 1 + 8;
    let rig = Rig::new(true);
    leg(&LEG_BOUNDED, &rig.clone(), LEG_SETTINGS, |robot, frames| {
        let mut now_us = 0;
        for sample in 0..40 {
            rig.measures(Some((sample % 2 == 0).then_some([0.0; 3])));
            run(robot, &mut now_us, LEG_US, 1);
            if sample == 0 {
                robot.command(Command::Start);
                assert_eq!(robot.mode(), Mode::Running, "there is a measurement");
            }
            assert!(frames.dequeue().unwrap().predicted.is_empty());
            let expected = if sample < allowed { Mode::Running } else { Mode::Safe };
            assert_eq!((robot.mode(), sample), (expected, sample));
            robot.command(Command::Inputs([6.0; 2]));
        }
        assert!(robot.alarms().contains(Alarms::SENSOR_LOST) && rig.is_off());
        robot.command(Command::Reset);
        robot.command(Command::Start);
        assert_eq!(robot.mode(), Mode::Idle, "refused");
        rig.measures(Some(Some([0.0; 3])));
        run(robot, &mut now_us, LEG_US, allowed);
        robot.command(Command::Start);
        run(robot, &mut now_us, LEG_US, 1);
        assert_eq!(robot.mode(), Mode::Running);
    });
}

#[test]
fn a_sensor_is_bad_after_three_samples_that_are_no_numbers() {
    let bad = [
        Measurement::Taken([f32::NAN, 0.0]),
        Measurement::Taken([0.0, f32::NEG_INFINITY]),
        Measurement::Unreadable,
    ];
    let mut tracker = tracker(&PLAIN_BOUNDED, 10);
    for k in 0..20 {
        let (first, second) = (bad[k % 3], bad[(k / 3) % 3]);
        assert_eq!(tracker.sample(&U, first, &U).alarms, Alarms::none());
        assert_eq!(tracker.sample(&U, second, &U).alarms, Alarms::none());
        // A good one in between begins anew.
        off(&mut tracker, 0.0);
    }
    for k in 1..=4 {
        let tracked = tracker.sample(&U, bad[k % 3], &U);
        assert_eq!(tracked.alarms.contains(Alarms::SENSOR_BAD), k >= 3);
        assert_eq!(tracked.measured, None);
    }
}

#[test]
fn a_robot_at_rest_is_only_asked_for_its_sensor() {
    leg_in(Mode::Idle, |robot, frames, rig, mut now_us| {
        // Carried about by hand.
        for k in 0..20_u16 {
            rig.measures(Some(Some([f32::from(k) * 40.0, 0.0, 0.0])));
            run(robot, &mut now_us, LEG_US, 1);
            assert_eq!(frames.dequeue().unwrap().noticed, Alarms::none());
        }
        rig.measures(None);
        run(robot, &mut now_us, LEG_US, 3);
        assert_eq!((robot.alarms(), robot.mode()), (Alarms::SENSOR_BAD, Mode::Idle));
    });
}

// The ROSbot

/// Ticks of a ROSbot whose wheels turn by so many counts a tick; its frames.
fn drive(
    robot: &mut dyn ControlLoop<2>,
    frames: &mut Frames<'_>,
    rig: &Rig,
    now_us: &mut u64,
    turns: impl IntoIterator<Item = [i16; 2]>,
) -> Vec<Frame> {
    let mut all = Vec::new();
    for turned in turns {
        let counts = rig.0.borrow().counts;
        rig.0.borrow_mut().counts = [0, 1].map(|i| counts[i].wrapping_add_signed(turned[i]));
        run(robot, now_us, ROSBOT_US, 1);
        all.extend(std::iter::from_fn(|| frames.dequeue()));
    }
    all
}

#[test]
fn inputs_of_a_sample_are_the_mean_of_its_ticks() {
    for ticks_per_sample in [1_u8, 2, 10, 50] {
        let rig = Rig::new(false);
        let settings = RosbotSettings { ticks_per_sample, ..RosbotSettings::default() };
        rosbot(&ROSBOT, &rig, settings, |robot, frames| {
            let period_us = 100_000 / u64::from(ticks_per_sample);
            let ticks = usize::from(ticks_per_sample);
            let mut now_us = 0;
            let mut expected = [0.0_f32; 2];
            run(robot, &mut now_us, period_us, 1);
            let mut samples = std::collections::VecDeque::from([(0, [0.0; 2])]);
            if ticks < 4 {
                assert_eq!(
                    frames.dequeue().unwrap().applied,
                    [0.0, 0.0],
                    "the first tick is a sample"
                );
                samples.clear();
            }
            robot.command(Command::Start);
            // The tick that is a sample belongs to the next one; its frame comes when the look-ahead is there.
            for tick in 1..=3 * ticks {
                let u = [tick as f32 / 8.0 % 9.0, -2.5];
                robot.command(Command::Inputs(u));
                let is_sample = tick % ticks == 0;
                if is_sample {
                    assert!(samples.is_empty(), "a frame before the next sample");
                    samples
                        .push_back((now_us, expected.map(|sum| sum / f32::from(ticks_per_sample))));
                    expected = [0.0; 2];
                }
                run(robot, &mut now_us, period_us, 1);
                assert!(robot.path().is_empty() || robot.path().len() % 3 == 0);
                if let Some(frame) = frames.dequeue() {
                    let (time_us, mean) = samples.pop_front().expect("a sample");
                    assert_eq!(frame.time_us, time_us);
                    assert_eq!(is_sample, ticks < 4);
                    for (applied, mean) in frame.applied.iter().zip(mean) {
                        assert!((applied - mean).abs() < 1e-5, "{applied} {mean}");
                    }
                }
                assert!(frames.dequeue().is_none());
                expected = [0, 1].map(|i| expected[i] + u[i]);
            }
            assert_eq!(samples.len(), usize::from(ticks >= 4));
        });
    }
}

#[test]
fn counts_wrap_both_ways_and_impossible_ones_are_not_believed() {
    // Both ways across zero at 43 counts, 16.6 rad/s: the robot runs on, and with the wheels about as fast
    // as commanded the motors see little but the integral part.
    for (start, turned) in [(65_500_u16, 43_i16), (20, -43), (0, 0)] {
        let rig = Rig::new(false);
        rig.0.borrow_mut().counts = [start; 2];
        rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
            let mut now_us = 0;
            let speed = f32::from(turned) * std::f32::consts::TAU / 1632.0 / 0.01;
            drive(robot, frames, &rig, &mut now_us, [[turned; 2]; 3]);
            robot.command(Command::Start);
            let mut duties = Vec::new();
            for tick in 0..60 {
                robot.command(Command::Inputs([speed.clamp(-16.0, 16.0); 2]));
                // A count of far too many now and then.
                let turned = if tick % 8 == 7 { 20_000 } else { turned };
                drive(robot, frames, &rig, &mut now_us, [[turned; 2]]);
                duties.push(rig.0.borrow().duty[0]);
            }
            assert_eq!(
                (robot.mode(), robot.alarms() & Alarms::SAFE),
                (Mode::Running, Alarms::none())
            );
            let error = speed.clamp(-16.0, 16.0) - speed;
            let (first, last) = (0.7 * error / 12.0, (0.7 + 59.0 * 0.09) * error / 12.0);
            let duty = |share: f32| (share.abs().min(1.0) * 999.0 + 0.5) as u16;
            assert!(duties[0].abs_diff(duty(first)) <= 1, "{duties:?}");
            assert!(duties[59].abs_diff(duty(last)) <= 2, "{duties:?} {}", duty(last));
            // Five in a row are one too many.
            drive(robot, frames, &rig, &mut now_us, [[turned; 2]]);
            drive(robot, frames, &rig, &mut now_us, [[-20_000; 2]; 4]);
            assert_eq!(robot.mode(), Mode::Running);
            drive(robot, frames, &rig, &mut now_us, [[-20_000; 2]]);
            assert_eq!(robot.mode(), Mode::Safe);
            assert!(robot.alarms().contains(Alarms::ENCODER) && rig.is_off());
        });
    }
}

#[test]
fn a_stop_and_a_start_between_two_ticks_begin_anew() {
    let rig = Rig::new(false);
    rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
        let mut now_us = 0;
        drive(robot, frames, &rig, &mut now_us, [[0; 2]; 2]);
        robot.command(Command::Start);
        robot.command(Command::Inputs([10.0; 2]));
        drive(robot, frames, &rig, &mut now_us, [[0; 2]; 20]);
        assert_ne!(rig.0.borrow().duty, [0; 2]);
        robot.command(Command::Stop);
        robot.command(Command::Start);
        drive(robot, frames, &rig, &mut now_us, [[0; 2]]);
        assert_eq!((robot.mode(), rig.is_off()), (Mode::Running, true), "no integral part is left");
    });
}

#[test]
fn a_slow_wheel_is_noticed_within_a_second_and_one_that_is_not_counted_stops_the_robot() {
    // 26 counts a tick are 10.01 rad/s.
    for (turned, noticed, stopped) in [
        ([26, 26], false, false),
        ([13, 26], true, false),
        ([26, 13], true, false),
        // Blocked, or a dead encoder; an encoder with swapped wires.
        ([0, 26], false, true),
        ([26, 0], false, true),
        ([26, -26], false, true),
    ] {
        let rig = Rig::new(false);
        rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
            let mut now_us = 0;
            drive(robot, frames, &rig, &mut now_us, [[0; 2]; 2]);
            robot.command(Command::Start);
            let (mut told, mut ticks) = (false, 0);
            for _ in 0..100 {
                robot.command(Command::Inputs([10.0, 10.0]));
                let frames = drive(robot, frames, &rig, &mut now_us, [turned]);
                told |= frames.iter().any(|frame| frame.noticed.contains(Alarms::WHEEL));
                ticks += i32::from(robot.mode() == Mode::Running);
            }
            assert_eq!(robot.mode() == Mode::Safe, stopped, "{turned:?}");
            assert_eq!(robot.alarms().contains(Alarms::ENCODER), stopped, "{turned:?}");
            if stopped {
                assert!((28..35).contains(&ticks) && rig.is_off(), "{turned:?}: {ticks} ticks");
            } else {
                assert_eq!(told, noticed, "{turned:?}: a slow wheel is for the host to judge");
                robot.command(Command::Stop);
                let frames = drive(robot, frames, &rig, &mut now_us, [[0; 2]; 20]);
                let last = frames.last().unwrap();
                assert!(!last.noticed.contains(Alarms::WHEEL), "forgotten at rest");
            }
        });
    }
}

proptest! {
    #![proptest_config(Config { failure_persistence: None, ..Config::default() })]

    #[test]
    fn speeds_are_controlled_by_the_law_of_the_simulated_robot(
        steps in prop::collection::vec((prop::array::uniform2(-128..=128_i16), 1..30_usize), 1..20),
        noise in prop::collection::vec(prop::array::uniform2(-3..=3_i16), 600),
    ) {
        let rig = Rig::new(false);
        rosbot(&ROSBOT, &rig, RosbotSettings::default(), |robot, frames| {
            let mut now_us = 0;
            drive(robot, frames, &rig, &mut now_us, [[0; 2]; 2]);
            robot.command(Command::Start);
            let (mut integral, mut speeds) = ([0.0_f64; 2], [0.0_f64; 2]);
            let mut noise = noise.into_iter();
            for (eighths, ticks) in steps {
                let command = eighths.map(|u| f64::from(u) / 8.0);
                robot.command(Command::Inputs(command.map(|u| u as f32)));
                for noise in noise.by_ref().take(ticks) {
                    // Wheels that follow by a lag, jolted.
                    speeds = [0, 1].map(|i| speeds[i] + 0.1 * (command[i] - speeds[i]));
                    let counts = [0, 1].map(|i| (speeds[i] / 0.385) as i16 + noise[i]);
                    drive(robot, frames, &rig, &mut now_us, [counts]);
                    let hardware = rig.0.borrow();
                    for side in 0..2 {
                        // As in firmware_sim::rosbot, in f64.
                        let turns = f64::from(counts[side]) / 1632.0;
                        let error = command[side] - std::f64::consts::TAU * turns / 0.01;
                        let wanted = 0.7 * error + integral[side];
                        if (wanted.abs() - 12.0).abs() < 1e-3 {
                            // f32 may decide otherwise whether that winds up, and goes its own way.
                            return Ok(());
                        }
                        let volt = wanted.clamp(-12.0, 12.0);
                        if !(volt != wanted && error * wanted > 0.0) {
                            integral[side] += 9.0 * error * 0.01;
                        }
                        let duty = (volt.abs() / 12.0 * 999.0).round();
                        let found = f64::from(hardware.duty[side]);
                        prop_assert!((found - duty).abs() <= 1.0, "{found} {duty}");
                        prop_assert!(duty < 2.0 || hardware.pins[side] == (volt < 0.0));
                    }
                }
            }
            Ok(())
        })?;
    }
}
