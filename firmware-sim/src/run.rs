//! Runs: the very firmware, on a simulated controller, against a robot that misbehaves.
//!
//! ```text
//! host ──commands──> line ──> firmware ──> PWM, pins ──> plant ──> sensors ──> firmware ──> line ──> host
//! ```
//!
//! Everything happens in virtual time. A tick is charged with the instructions that the core's
//! [cost table](firmware_core::cost) says its predictions take, so that deadlines mean something. The
//! same model, scenario and seed give the same run.
//!
//! | module | what lives there |
//! |---|---|
//! | [`scenario`] | what a run does |
//! | `rig` (private) | a robot with its firmware |
//! | [`host`] | the laptop at the other end of the line |
//! | [`summary`] | what a run showed |
//! | [`log`] | the telemetry as logs for the trainer |
//! | [`figure`], [`live`] | predicted beside measured: a plot, and a view in the terminal |
//! | [`store`] | the models in its flash, and who may install others |
//! | [`serve`] | the same in real time, for a client on a port |
//! | [`apart`] | the robot alone, for a controller in QEMU or on a board |
//! | [`sweep`] | every fault on every robot, against what is expected |

pub mod apart;
pub mod figure;
pub mod host;
pub mod live;
pub mod log;
mod rig;
pub mod scenario;
pub mod serve;
pub mod store;
pub mod summary;
pub mod sweep;

use crate::bench::{RosbotBench, SoftLegBench};
use crate::fault::{Fault, FaultKind, Faults};
use crate::faulty::FaultyHost;
use crate::mcu::board::ResetCause;
use crate::mcu::misuse::Misuse;
use crate::mcu::uart::{self, UartEnd, UartSettings};
use crate::mcu::{BrownOutDetector, VirtualClock, Wire};
use embedded_io::Write as _;
use firmware_core::control_loop::rhythm::most_steps;
use firmware_core::control_loop::telemetry::{Frame, Telemetry};
use firmware_core::control_loop::{ControlLoop as _, ControlLoopError, Mode};
use firmware_core::link::Port;
use firmware_core::model::{Model, Structure};
use firmware_core::update::Updates as _;
use firmware_core::{blob, cost};
use heapless::spsc::Queue;
use host::{Alone, Host, Laptop};
use rig::Rig;
use scenario::{Controller, Scenario};
use std::collections::VecDeque;
use std::num::NonZeroU32;
use std::path::Path;
use store::{Loop, Speed, Started, Store};
use summary::{Summary, Watch};

/// Voltage of the microcontroller's supply, and where its brown-out detector resets it (V): STM32F407,
/// level 3.
const SUPPLY_VOLT: f64 = 3.3;
const BROWN_OUT_VOLT: f64 = 2.7;
/// Frames that wait to be sent.
const QUEUE: usize = 8;
/// Time from one look at the line to the next while a model is being installed (µs).
const POLL_US: u64 = 250;
/// A reset waits at most so long until the answers are on the line (µs).
const RESET_US: u64 = 1_000_000;
/// Samples whose frames may be on their way, which is enough for a line of 100 baud. On a dead line the
/// oldest are forgotten.
const MOST_PENDING: usize = 4_096;

/// A robot that can be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Robot {
    /// The skid-steered ROSbot: models with three states (x, y, heading) and two inputs (wheel speeds).
    Rosbot,
    /// The soft leg: models with two states (tip y, z) and two inputs (valve voltages).
    SoftLeg,
}

impl Robot {
    /// Inputs of each of them.
    pub const INPUTS: usize = 2;

    /// The robot that a model is of, by its states and inputs.
    ///
    /// # Errors
    /// [`RunError::Robot`] when it is none of them.
    pub fn of(structure: &Structure<'_>) -> Result<Self, RunError> {
        let names = |names: &mut dyn Iterator<Item = &str>| names.collect::<Vec<_>>().join(", ");
        let states = names(&mut structure.states().iter().map(|s| s.name));
        let inputs = names(&mut structure.inputs().iter().map(|u| u.name));
        match (states.as_str(), inputs.as_str()) {
            ("x, y, phi", "omega_r, omega_l") => Ok(Self::Rosbot),
            ("y, z", "bending, extension") => Ok(Self::SoftLeg),
            _ => Err(RunError::Robot { robot: structure.robot().to_owned(), states, inputs }),
        }
    }

    /// Time between two ticks of its loop (µs).
    pub fn tick_us(self) -> u64 {
        match self {
            Self::Rosbot => RosbotBench::TICK_US,
            Self::SoftLeg => SoftLegBench::TICK_US,
        }
    }

    /// Samples that its loop looks ahead.
    pub fn ahead(self) -> u32 {
        match self {
            Self::Rosbot => RosbotBench::AHEAD as u32,
            Self::SoftLeg => SoftLegBench::AHEAD as u32,
        }
    }

    /// Whether a fault can act on this robot, in the unit that it names.
    pub fn feels(self, fault: &Fault) -> bool {
        use FaultKind::*;
        let coordinates = match self {
            Self::Rosbot => 3,
            Self::SoftLeg => 2,
        };
        let units = match (fault.kind(), self) {
            (Nan | Spike, _) => coordinates,
            (MissedCounts | Wrap | Slip, Self::Rosbot) => 2,
            (StuckValve | OpenValve | Leak | Pump, Self::SoftLeg) => 2,
            (MissedCounts | Wrap | Slip, Self::SoftLeg)
            | (StuckValve | OpenValve | Leak | Pump, Self::Rosbot) => return false,
            // They have no units.
            (Dropout | Freeze | Delay | Sag | LateTick | Silence | BrownOut, _) => 0,
        };
        fault.unit().is_none_or(|unit| unit < units)
    }

    /// Random commands stay within this (rad/s, V).
    pub fn limit(self) -> f64 {
        match self {
            Self::Rosbot => RosbotBench::LIMIT,
            Self::SoftLeg => SoftLegBench::LIMIT,
        }
    }

    /// Steps of the model that a tick of its loop makes at most.
    pub fn steps(self) -> u64 {
        let steps = match self {
            Self::Rosbot => most_steps(RosbotBench::TICKS_PER_SAMPLE as u8, RosbotBench::AHEAD),
            Self::SoftLeg => most_steps(SoftLegBench::TICKS_PER_SAMPLE as u8, SoftLegBench::AHEAD),
        };
        steps as u64
    }

    /// Instructions of a tick of its loop with this model: one that predicts, and one that does not.
    ///
    /// The model's instructions are those of the [cost table](firmware_core::cost).
    pub fn instructions(self, model: &Model<'_>, controller: &Controller) -> [u64; 2] {
        let step = u64::from(cost::instructions(model.structure(), model.terms()));
        let rest = u64::from(controller.tick_instructions);
        [rest + self.steps() * step, rest]
    }
}

/// The bytes of a model, at an address that the core accepts.
#[derive(Debug, Clone)]
pub struct Blob {
    words: Vec<u32>,
    length: usize,
}

impl Blob {
    /// Reads a file.
    ///
    /// # Errors
    /// Those of the file system, with its name.
    pub fn read(path: &Path) -> Result<Self, String> {
        let bytes =
            std::fs::read(path).map_err(|e| format!("{}: cannot be read: {e}", path.display()))?;
        Ok(Self::new(&bytes))
    }

    /// Copies bytes.
    pub fn new(bytes: &[u8]) -> Self {
        let mut words = vec![0_u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { words, length: bytes.len() }
    }

    /// The model.
    ///
    /// # Errors
    /// [`RunError::Blob`].
    pub fn model(&self) -> Result<Model<'_>, RunError> {
        firmware_core::parse(self.bytes()).map_err(RunError::Blob)
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }
}

/// The folder that a file is in.
pub fn folder_of(file: &Path) -> &Path {
    file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file whole or not at all.
///
/// # Errors
/// Those of the file system.
pub fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut file = tempfile::NamedTempFile::new_in(folder_of(path))?;
    std::io::Write::write_all(&mut file, bytes)?;
    file.persist(path)?;
    Ok(())
}

/// Why there is no run, or why it means nothing.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The blob is refused.
    #[error("the model is refused: {0:?}")]
    Blob(blob::ParseError),
    /// The model is of a robot that is not simulated.
    #[error(
        "the model of `{robot}` predicts [{states}] from [{inputs}]; robots that can be run have \
         [x, y, phi] from [omega_r, omega_l] (models/skid-rosbot) or [y, z] from \
         [bending, extension] (models/soft-leg)"
    )]
    Robot {
        /// Its name.
        robot: String,
        /// Its states.
        states: String,
        /// Its inputs.
        inputs: String,
    },
    /// The model has another sample time than the loop.
    #[error("the model's sample time is {found_s} s, the robot's loop has one of {expected_s} s")]
    SampleTime {
        /// That of the robot (s).
        expected_s: f64,
        /// That of the model (s).
        found_s: f32,
    },
    /// A fault that the robot cannot have.
    #[error("{fault}: a {robot} has no such fault, or no such unit")]
    Fault {
        /// The fault.
        fault: Fault,
        /// Name of the robot.
        robot: String,
    },
    /// The firmware refuses the model.
    #[error("the control loop refuses the model: {0:?}")]
    Firmware(ControlLoopError),
    /// The scenario makes no sense.
    #[error(transparent)]
    Scenario(#[from] scenario::ScenarioError),
    /// The firmware misused the hardware.
    #[error("the firmware misused the hardware {} times, first at {} µs: {}", .0.count, .0.first_at_us, .0.first)]
    Misuse(Misuse),
    /// Whoever watched the run could not go on.
    #[error(transparent)]
    Watcher(#[from] std::io::Error),
}

/// One sample as it reached the host, beside what really was.
#[derive(Debug)]
pub struct Seen<'s> {
    /// The frame.
    pub frame: &'s Frame,
    /// The true coordinates at that time, in the model's units.
    pub truth: &'s [f64],
    /// What the loop predicted then for the coming samples, shape `[ahead, states]`.
    pub path: &'s [f32],
}

/// Whoever watches a run.
pub type Watcher<'w> = dyn FnMut(&Seen<'_>) -> std::io::Result<()> + 'w;

/// Runs a model; `watcher` sees every sample that reaches the host.
///
/// # Errors
/// [`RunError`].
pub fn run(
    model: &Model<'_>,
    scenario: &Scenario,
    seed: u64,
    watcher: &mut Watcher<'_>,
) -> Result<Summary, RunError> {
    let laptop = |end, faults: &Faults, host| Alone { end: FaultyHost::new(end, faults), host };
    with(model, scenario, seed, None, laptop, watcher)
}

/// Runs a controller that takes updates, with somebody at the other end of the line. The model is that of
/// the store's factory.
///
/// # Errors
/// [`RunError`].
pub fn run_with<L: Laptop>(
    model: &Model<'_>,
    scenario: &Scenario,
    seed: u64,
    store: &mut Store,
    laptop: impl FnOnce(UartEnd) -> L,
) -> Result<Summary, RunError> {
    let laptop = |end, _: &Faults, _| laptop(end);
    with(model, scenario, seed, Some(store), laptop, &mut |_| Ok(()))
}

/// Runs a model with somebody at the other end of the line, who is given that end and a host.
fn with<L: Laptop>(
    model: &Model<'_>,
    scenario: &Scenario,
    seed: u64,
    store: Option<&mut Store>,
    laptop: impl FnOnce(UartEnd, &Faults, Host) -> L,
    watcher: &mut Watcher<'_>,
) -> Result<Summary, RunError> {
    let robot = Robot::of(model.structure())?;
    scenario.check(model.structure().inputs().len())?;
    let run = (robot, scenario, seed);
    match robot {
        Robot::Rosbot => run_rig::<RosbotBench, L, 3>(model, run, store, laptop, watcher),
        Robot::SoftLeg => run_rig::<SoftLegBench, L, 2>(model, run, store, laptop, watcher),
    }
}

/// What was so when a sample was taken, until its frame reaches the host.
struct Then<const N: usize> {
    time_us: u64,
    truth: [f64; N],
    path: Vec<f32>,
}

/// A rig with all that is around its firmware, from one tick to the next.
struct World<'w, R, L, const N: usize> {
    rig: R,
    laptop: L,
    clock: VirtualClock,
    faults: Faults,
    supply: Wire<f64>,
    detector: BrownOutDetector,
    summary: Watch<N>,
    pending: VecDeque<Then<N>>,
    watcher: &'w mut Watcher<'w>,
    /// The next tick.
    tick: u64,
}

impl<R: Rig<N>, L: Laptop, const N: usize> World<'_, R, L, N> {
    fn now_us(&self) -> u64 {
        self.clock.now_ns() / 1000
    }

    /// When the next tick is due (µs). Timers go on while a tick is late: it begins when it can.
    fn due_us(&self) -> u64 {
        self.tick * R::TICK_US + self.faults.late_by_us(R::TICK_US)
    }

    /// Goes on to the next tick; whether there is power for it.
    fn next_tick(&mut self, model: &Model<'_>) -> Result<bool, RunError> {
        self.rig.advance_us(self.due_us().saturating_sub(self.now_us()));
        self.rig.apply(&self.faults);
        let missing = self.faults.act(FaultKind::BrownOut, None).unwrap_or(0.0);
        self.supply.set(SUPPLY_VOLT * (1.0 - missing));
        self.turn(model)?;
        self.tick += 1;
        let runs = self.detector.runs(self.rig.board());
        if !runs {
            self.summary.off(self.now_us(), self.rig.is_off());
        }
        Ok(runs)
    }

    /// Lets the laptop have its turn.
    fn turn(&mut self, model: &Model<'_>) -> std::io::Result<()> {
        let now_us = self.now_us();
        let Self { laptop, pending, summary, watcher, .. } = self;
        laptop.turn(now_us, &mut |frame| {
            while pending.front().is_some_and(|then| then.time_us < frame.time_us) {
                pending.pop_front();
            }
            let Some(then) = pending.pop_front_if(|then| then.time_us == frame.time_us) else {
                return Ok(());
            };
            summary.sample(model, frame, &then.truth);
            watcher(&Seen { frame, truth: &then.truth, path: &then.path })
        })
    }

    /// A robot at rest was kept waiting on purpose: ticks that were due in the meantime are left out.
    fn leave_out(&mut self, mode: Mode) {
        let next = self.now_us().div_ceil(R::TICK_US);
        let left_out = next.saturating_sub(self.tick);
        self.summary.left_out(mode, left_out, self.rig.is_off());
        self.tick += left_out;
    }
}

fn run_rig<R: Rig<N>, L: Laptop, const N: usize>(
    model: &Model<'_>,
    (robot, scenario, seed): (Robot, &Scenario, u64),
    mut store: Option<&mut Store>,
    laptop: impl FnOnce(UartEnd, &Faults, Host) -> L,
    watcher: &mut Watcher<'_>,
) -> Result<Summary, RunError> {
    let expected_s = (R::TICK_US * R::TICKS_PER_SAMPLE) as f64 / 1e6;
    let found_s = model.structure().sample_time_s();
    if (f64::from(found_s) - expected_s).abs() > 1e-3 * expected_s {
        return Err(RunError::SampleTime { expected_s, found_s });
    }
    if let Some(fault) = scenario.faults.iter().find(|fault| !robot.feels(&fault.0)) {
        let robot = model.structure().robot().to_owned();
        return Err(RunError::Fault { fault: fault.0, robot });
    }
    let mut rig = R::new();
    let clock = rig.clock();
    let faults = Faults::new(&clock, scenario.faults.iter().map(|fault| fault.0), seed);
    let line = UartSettings {
        baud: NonZeroU32::new(scenario.line.baud).unwrap_or(NonZeroU32::MIN),
        loss: scenario.line.loss,
        doubling: scenario.line.doubling,
        bit_flip: scenario.line.bit_flip,
        ..UartSettings::default()
    };
    let (host_end, mut serial) = uart::pair(&clock, line, seed);
    let laptop = laptop(host_end, &faults, Host::new(scenario, seed));
    let supply = Wire::new(SUPPLY_VOLT);
    let detector = BrownOutDetector::new(&supply, BROWN_OUT_VOLT, 0.1);

    let controller = scenario.controller;
    let Controller { clock_mhz, cycles_per_instruction, .. } = controller;
    let cost_us = |model: &Model<'_>| {
        let instructions = robot.instructions(model, &controller);
        instructions.map(|count| (count as f64 * cycles_per_instruction / clock_mhz).ceil() as u64)
    };
    let ticks = (scenario.seconds * 1e6 / R::TICK_US as f64).round().max(1.0) as u64;
    let summary = Watch::<N>::new(model, robot, scenario, seed, cost_us(model));
    let installed = store.as_ref().map(|store| {
        let of = Loop {
            robot: model.structure().robot().to_owned(),
            states: N,
            tick_us: R::TICK_US,
            sample_us: R::TICK_US * R::TICKS_PER_SAMPLE,
            steps: robot.steps(),
        };
        store.installed(of, Speed { clock: clock.clone(), controller }, rig.board(), seed)
    });
    let pending = VecDeque::new();
    let mut world =
        World { rig, laptop, clock, faults, supply, detector, summary, pending, watcher, tick: 0 };
    let mut boots = 0;

    // Each round is a boot, until the end or the next reset.
    'boots: while world.tick < ticks {
        if !world.next_tick(model)? {
            continue;
        }
        boots += 1;
        let booted_us = world.now_us();
        let (mut updates, chosen) = match &installed {
            Some(installed) => {
                let Started { updater, chosen, booted } = installed.boot();
                store.as_deref_mut().map(|store| store.booted(booted, installed)).transpose()?;
                (Some(updater), chosen)
            }
            None => (None, None),
        };
        if world.now_us() > booted_us {
            // The timer of the ticks starts when everything else is ready.
            world.leave_out(Mode::Idle);
            if !world.next_tick(model)? {
                continue;
            }
        }
        let parsed = chosen.as_ref().map(Blob::model).transpose()?;
        let model = parsed.as_ref().unwrap_or(model);
        let cost_us = cost_us(model);
        let lag = model.structure().lag() as u64;
        let mut queue = Queue::<Frame, QUEUE>::new();
        let (producer, mut frames) = queue.split();
        let telemetry = Telemetry::new(producer);
        let booted = world.rig.boot(model, &world.faults, seed.wrapping_add(boots), telemetry);
        let mut firmware = booted.map_err(RunError::Firmware)?;
        let (mut port, mut of_boot) = (Port::new(), 0);
        let mut resets_since_us = None;
        let mut was_on_trial = updates.as_ref().is_some_and(|u| u.slots().on_trial());
        loop {
            let mut began_us = world.now_us();
            port.receive(&mut serial, &mut firmware, &mut updates, began_us);
            let waited_us = world.now_us() - began_us;
            if waited_us > R::TICK_US / 4 {
                // Something of an update took long: this tick is left out, and what else was due.
                let off = world.rig.is_off();
                world.summary.left_out(firmware.mode(), 1, off);
                world.leave_out(firmware.mode());
                if world.tick >= ticks {
                    break 'boots;
                }
                if !world.next_tick(model)? {
                    break;
                }
                continue;
            }
            began_us += waited_us;
            let is_sample = of_boot % R::TICKS_PER_SAMPLE == 0;
            // While the model's history fills there is nothing to predict.
            let predicts = of_boot / R::TICKS_PER_SAMPLE >= lag;
            of_boot += 1;
            let truth = is_sample.then(|| world.rig.truth());
            firmware.tick(began_us);
            if let Some(truth) = truth {
                if world.pending.len() == MOST_PENDING {
                    world.pending.pop_front();
                }
                world.pending.push_back(Then { time_us: began_us, truth, path: Vec::new() });
            }
            // It grows from tick to tick.
            if let Some(then) = world.pending.back_mut() {
                then.path.extend(firmware.path().iter().skip(then.path.len()));
            }
            world.rig.advance_us(cost_us[usize::from(!predicts)]);
            let ended_us = world.now_us();
            let mode = firmware.finish(ended_us);
            port.send(&mut frames, &mut serial);
            let off = world.rig.is_off();
            world.summary.tick(world.tick - 1, [began_us, ended_us], mode, off);

            // At rest there is time for updates until the next tick.
            while let Some(updater) = &mut updates
                && firmware.mode() != Mode::Running
                && (updater.is_working() || updater.holds(world.now_us()))
                && world.now_us() + POLL_US < world.due_us()
            {
                world.rig.advance_us(POLL_US);
                world.turn(model)?;
                port.receive(&mut serial, &mut firmware, updater, world.now_us());
                port.send(&mut frames, &mut serial);
                if world.now_us() > world.due_us() {
                    world.leave_out(firmware.mode());
                }
            }
            if let Some(updater) = &mut updates {
                updater.ticked(firmware.alarms());
                let on_trial = updater.slots().on_trial();
                if std::mem::replace(&mut was_on_trial, on_trial) != on_trial
                    && let (Some(store), Some(installed)) = (&mut store, &installed)
                {
                    store.save(installed)?;
                }
                let is_sent = port.is_sent() && serial.flush().is_ok();
                let now_us = world.now_us();
                if updater.resets()
                    && (is_sent || now_us - *resets_since_us.get_or_insert(now_us) > RESET_US)
                {
                    world.rig.board().reset(ResetCause::Software);
                    break;
                }
            }
            if world.tick >= ticks {
                break 'boots;
            }
            if !world.next_tick(model)? {
                break;
            }
        }
    }
    if let (Some(store), Some(installed)) = (store, &installed) {
        store.save(installed)?;
    }
    let resets = world.rig.board().resets();
    if let Some(misuse) = world.rig.board().misuse() {
        return Err(RunError::Misuse(misuse));
    }
    Ok(world.summary.finish(&world.faults, resets, world.laptop.counts()))
}

/// The time in `mode` is counted under its number.
pub(crate) fn number(mode: Mode) -> usize {
    match mode {
        Mode::Idle => 0,
        Mode::Running => 1,
        Mode::Safe => 2,
    }
}
