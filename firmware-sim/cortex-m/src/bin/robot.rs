//! The whole firmware, as on a board: the loop of the ROSbot or of the soft leg, the link on a serial line,
//! models that can be installed over it.
//!
//! `robot` in this folder builds it, starts it in QEMU and gives it a simulated robot. The semihosting
//! argument says which loop runs, `rosbot` or `soft-leg`, and after a space whose models are installed: the
//! file with the public key, as `trainer keygen` writes it; without it, everybody's. Through semihosting come
//! a line for every boot, for every change of the mode, and every ten seconds.
//!
//! | | where |
//! |---|---|
//! | link to the host, docs/protocol.md | first serial line ([`board`]) |
//! | sensors and actuators: the robot on the laptop | second serial line ([`plant_line`]); without a robot there no sensor can be read, and the loop does not start |
//! | factory model | flash of the image |
//! | installed models | RAM, since QEMU has no flash controller, and not counted as such: [`slots_in_ram`] |
#![no_std]
#![no_main]

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use embedded_storage::nor_flash::NorFlash;
use firmware_core::blob::Aligned;
use firmware_core::control_loop::rhythm::most_steps;
use firmware_core::control_loop::rosbot::{Motor, RosbotSettings, Sides};
use firmware_core::control_loop::soft_leg::{Chamber, Pneumatics, SoftLegSettings};
use firmware_core::control_loop::telemetry::{Frames, Queue};
use firmware_core::control_loop::{ControlLoop, Mode, Rosbot, SoftLeg, Telemetry};
use firmware_core::device::MonotonicClock as _;
use firmware_core::link::Port;
use firmware_core::slots::{Boot, Payload, Which};
use firmware_core::update::{Capacities, Identity, PublicKey, Trust, Updater, Updates as _};

#[path = "../board.rs"]
mod board;
#[path = "../host.rs"]
mod host;
// What is counted elsewhere is not counted here.
#[allow(dead_code)]
#[path = "../machine.rs"]
mod machine;
#[path = "../plant.rs"]
mod plant;
// Both ends are in it.
#[allow(dead_code)]
#[path = "../../../src/plant_line.rs"]
mod plant_line;
#[path = "../slots_in_ram.rs"]
mod slots_in_ram;
#[path = "../vectors.rs"]
mod vectors;

use board::{CORE_HZ, Clock, MACHINE, Serial};
use plant::Plant;
use plant_line::TICK_US;
use slots_in_ram::{GEOMETRY, SlotsInRam};

static ROSBOT: &Aligned<[u8]> =
    &Aligned(*include_bytes!("../../../../models/skid-rosbot/model.bin"));
static LEG: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../../models/soft-leg/model.bin"));

/// Frames that wait to be sent.
const QUEUE: usize = 8;
/// Time that a trial has to be good for (µs).
const GOOD_US: u32 = 10_000_000;
/// Answers wait at most so long for the line before a reset (µs).
const RESET_US: u64 = 1_000_000;
/// Time from one report to the next (µs).
const REPORT_US: u64 = 10_000_000;

/// What is the controller's.
struct Controller {
    clock: Clock,
    link: Serial,
    line: Serial,
    key: Option<PublicKey>,
}

/// What is a robot's.
struct Of {
    name: &'static str,
    factory: &'static [u8],
    capacities: Capacities,
    period_us: u32,
}

#[entry]
fn main() -> ! {
    if start().is_none() {
        hprintln!("expected `rosbot` or `soft-leg`, and a file that holds a public key, if any");
    }
    machine::end(false)
}

/// Comes back only if it cannot start.
fn start() -> Option<()> {
    let mut arguments = [0; 256];
    let timer = cortex_m::Peripherals::take()?.SYST;
    let [link, line] = Serial::start();
    let clock = Clock::start(timer);
    let with = |key| Controller { clock, link, line, key };
    if let Some(rest) = host::argument(&mut arguments, b"rosbot") {
        rosbot(with(key(rest)?))
    } else {
        let rest = host::argument(&mut arguments, b"soft-leg")?;
        leg(with(key(rest)?))
    }
}

/// The key in the file that is named behind a space; `None` of a file that holds none.
fn key(argument: &[u8]) -> Option<Option<PublicKey>> {
    let Some(name) = argument.strip_prefix(b" ") else { return Some(None) };
    let mut digits = [0; 64];
    if host::File::open(name)?.read(&mut digits) != digits.len() {
        return None;
    }
    let mut key = [0; 32];
    for (byte, digits) in key.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = u8::from_str_radix(core::str::from_utf8(digits).ok()?, 16).ok()?;
    }
    Some(Some(PublicKey(key)))
}

/// Most instructions of a step, so that a tick with so many steps takes its period at most: 1.5 cycles for
/// each instruction, and 2,000 of them for everything else.
const fn instructions(period_us: u32, steps: u32) -> u32 {
    (period_us * (CORE_HZ / 1_500_000) - 2_000) / steps
}

#[inline(never)]
fn rosbot(controller: Controller) -> Option<()> {
    let capacities =
        Capacities::new::<3, 2>(100_000, instructions(TICK_US, most_steps(10, 10) as u32));
    let of = Of { name: "skid-rosbot", factory: &ROSBOT.0, capacities, period_us: TICK_US };
    let Controller { clock, link, line, key } = controller;
    let Booted { mut updater, blob } = boot(&of, key)?;
    let model = firmware_core::parse_for(of.name, blob).ok()?;
    let plant = Plant::new(plant_line::Robot::Rosbot, line);
    let sides = Sides {
        right: Motor::new(plant.pwm(0), plant.pin(0)),
        left: Motor::new(plant.pwm(1), plant.pin(1)),
    };
    let devices = (sides, (plant.encoder(0), plant.encoder(1)), plant.position());
    let mut queue = Queue::<QUEUE>::new();
    let (producer, mut frames) = queue.split();
    let (settings, telemetry) = (RosbotSettings::default(), Telemetry::new(producer));
    let mut robot = Rosbot::<_, _, _, 10>::new(&model, devices, settings, telemetry).ok()?;
    run(&of, &mut robot, &mut updater, &mut frames, &plant, (clock, link))
}

#[inline(never)]
fn leg(controller: Controller) -> Option<()> {
    let ticks_per_sample = (50_000 / TICK_US) as u8;
    let steps = most_steps(ticks_per_sample, 20) as u32;
    let capacities = Capacities::new::<2, 2>(50_000, instructions(TICK_US, steps));
    let of = Of { name: "soft-leg", factory: &LEG.0, capacities, period_us: TICK_US };
    let Controller { clock, link, line, key } = controller;
    let Booted { mut updater, blob } = boot(&of, key)?;
    let model = firmware_core::parse_for(of.name, blob).ok()?;
    let plant = Plant::new(plant_line::Robot::SoftLeg, line);
    let pneumatics = Pneumatics {
        bending: Chamber::new(plant.pwm(0), plant.pin(0)),
        extension: Chamber::new(plant.pwm(1), plant.pin(1)),
        input_pump: plant.pin(2),
        exhaust_pump: plant.pin(3),
    };
    let mut queue = Queue::<QUEUE>::new();
    let (producer, mut frames) = queue.split();
    let settings = SoftLegSettings { ticks_per_sample, ..SoftLegSettings::default() };
    let telemetry = Telemetry::new(producer);
    let tip = plant.position();
    let mut robot = SoftLeg::<_, _, 20>::new(&model, pneumatics, tip, settings, telemetry).ok()?;
    run(&of, &mut robot, &mut updater, &mut frames, &plant, (clock, link))
}

/// What a boot decided.
struct Booted<A> {
    updater: Updater<'static, SlotsInRam, Option<PublicKey>, A>,
    /// The model that runs.
    blob: &'static [u8],
}

fn boot(of: &Of, key: Option<PublicKey>) -> Option<Booted<impl FnMut(Payload) -> bool + use<>>> {
    let Of { name: robot, factory, capacities, period_us } = *of;
    let identity = Identity {
        firmware: concat!("image ", env!("CARGO_PKG_VERSION")),
        robot,
        factory,
        capacities,
        // It takes no time.
        erase_ms: 100,
        good_ticks: GOOD_US / period_us,
    };
    let capacities = Capacities { room: GEOMETRY.room(), ..capacities };
    let accept = move |payload| {
        // SAFETY: used only while the slots ask.
        let Some(blob) = (unsafe { SlotsInRam::map(payload) }) else { return false };
        let model = firmware_core::parse_for(robot, blob);
        model.is_ok_and(|model| capacities.check(&model, blob.len()).is_ok())
    };
    // SAFETY: this is called once.
    let flash = unsafe { SlotsInRam::after_reset() };
    let (updater, boot) = Updater::boot(flash, GEOMETRY, identity, 0, key, accept).ok()?;
    let Boot { running, payload, trial, floor, .. } = boot;
    match payload {
        None => hprintln!("{} on {} boots the factory model; floor {}", robot, MACHINE, floor),
        Some(Payload { sequence, .. }) => hprintln!(
            "{} on {} boots the model in slot {}, sequence number {}{}; floor {}",
            robot,
            MACHINE,
            if running == Which::A { "A" } else { "B" },
            sequence,
            if trial { ", on trial" } else { "" },
            floor
        ),
    }
    let blob = match payload {
        // SAFETY: this is the slot that runs.
        Some(payload) => unsafe { SlotsInRam::map(payload) }?,
        None => factory,
    };
    Some(Booted { updater, blob })
}

/// Tick after tick, until a reset.
fn run(
    of: &Of,
    robot: &mut impl ControlLoop<2>,
    updater: &mut Updater<'_, impl NorFlash, impl Trust, impl FnMut(Payload) -> bool>,
    frames: &mut Frames<'_>,
    plant: &Plant,
    (clock, mut link): (Clock, Serial),
) -> ! {
    let period_us = u64::from(of.period_us);
    let mut port = Port::new();
    // The robot has a period to say where it is.
    let mut due_us = clock.now_us() + period_us;
    let mut told = Told::default();
    let mut resets_since_us = None;
    loop {
        // Until the next tick.
        loop {
            plant.exchange();
            let now_us = clock.now_us();
            if now_us >= due_us {
                break;
            }
            // At rest there is time for updates.
            if robot.mode() != Mode::Running && (updater.is_working() || updater.holds(now_us)) {
                port.receive(&mut link, robot, updater, now_us);
            }
            port.send(frames, &mut link);
            // The next byte or millisecond ends it.
            cortex_m::asm::wfi();
        }
        port.receive(&mut link, robot, updater, clock.now_us());
        let began_us = clock.now_us();
        let late = began_us - due_us > period_us / 4;
        // After a late tick the next ones come so much later, too.
        due_us = if late { began_us } else { due_us } + period_us;
        if late && robot.mode() != Mode::Running {
            // Something of an update took long: this tick is left out.
            continue;
        }
        plant.begin();
        robot.tick(began_us);
        let ended_us = clock.now_us();
        robot.finish(ended_us);
        plant.end();
        plant.exchange();
        updater.ticked(robot.alarms());
        port.send(frames, &mut link);
        told.tick(robot, plant, [began_us, ended_us]);
        if updater.resets() {
            let since_us = *resets_since_us.get_or_insert(ended_us);
            if (port.is_sent() && link.is_sent()) || ended_us - since_us > RESET_US {
                hprintln!("resets");
                board::reset();
            }
        }
    }
}

/// What has been told through semihosting.
#[derive(Default)]
struct Told {
    mode: Option<Mode>,
    ticks: u32,
    worst_us: u64,
    next_us: u64,
}

impl Told {
    fn tick(&mut self, robot: &impl ControlLoop<2>, plant: &Plant, [began_us, ended_us]: [u64; 2]) {
        self.ticks = self.ticks.wrapping_add(1);
        self.worst_us = self.worst_us.max(ended_us - began_us);
        let mode = robot.mode();
        if self.mode.replace(mode) == Some(mode) && began_us < self.next_us {
            return;
        }
        self.next_us = began_us + REPORT_US;
        hprintln!(
            "{}.{:03} s: {:?}, alarms {}; {} ticks, the longest {} us, {} without sensors",
            began_us / 1_000_000,
            began_us / 1000 % 1000,
            mode,
            robot.alarms(),
            self.ticks,
            self.worst_us,
            plant.missed()
        );
    }
}
