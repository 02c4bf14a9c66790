//! A firmware with both loops, the line and the model slots, on devices that are not there: what the core
//! takes of flash and memory, and what in it may panic.

use core::convert::Infallible;
use core::hint::black_box;

use embedded_hal::digital::{ErrorType as PinErrorType, OutputPin};
use embedded_hal::pwm::{ErrorType as PwmErrorType, SetDutyCycle};
use embedded_io::{ErrorType as IoErrorType, Read, ReadReady, Write, WriteReady};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use firmware_core::blob::{Aligned, parse_into};
use firmware_core::control_loop::rosbot::{Motor, RosbotSettings, Sides};
use firmware_core::control_loop::soft_leg::{Chamber, Pneumatics, SoftLegSettings};
use firmware_core::control_loop::telemetry::{Frames, Queue};
use firmware_core::control_loop::{ControlLoop, Rosbot, SoftLeg, Telemetry};
use firmware_core::device::{EncoderCount, PositionSensor};
use firmware_core::link::Port;
use firmware_core::slots::{Geometry, Payload};
use firmware_core::update::{Capacities, Identity, Trust, Updater};
use firmware_core::{Model, PredictorState};

static ROSBOT: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../models/skid-rosbot/model.bin"));
static LEG: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../models/soft-leg/model.bin"));

/// Places in the queue of telemetry, of which one is always free: a frame waits there while another message is on
/// the line, which is over long before the next sample.
const FRAMES: usize = 2;

/// Every device: what it reads nobody knows, what it writes goes nowhere.
struct Nowhere;

impl PwmErrorType for Nowhere {
    type Error = Infallible;
}

impl SetDutyCycle for Nowhere {
    fn max_duty_cycle(&self) -> u16 {
        black_box(4_666)
    }
    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        black_box(duty);
        Ok(())
    }
}

impl PinErrorType for Nowhere {
    type Error = Infallible;
}

impl OutputPin for Nowhere {
    fn set_low(&mut self) -> Result<(), Infallible> {
        black_box(false);
        Ok(())
    }
    fn set_high(&mut self) -> Result<(), Infallible> {
        black_box(true);
        Ok(())
    }
}

impl EncoderCount for Nowhere {
    type Error = ();
    fn count(&mut self) -> Result<u16, ()> {
        black_box(Ok(1))
    }
}

/// A sensor whose last coordinate goes on by as much at every measurement.
struct Turning {
    last: f32,
    by: f32,
}

impl<const N: usize> PositionSensor<N> for Turning {
    type Error = ();
    fn measure(&mut self) -> Result<Option<[f32; N]>, ()> {
        self.last += self.by;
        let mut coordinates = [0.0; N];
        if let [.., last] = &mut coordinates[..] {
            *last = self.last;
        }
        black_box(Ok(Some(coordinates)))
    }
}

impl IoErrorType for Nowhere {
    type Error = Infallible;
}

impl Read for Nowhere {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        black_box(&mut *bytes);
        Ok(black_box(1))
    }
}

impl ReadReady for Nowhere {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(black_box(true))
    }
}

impl Write for Nowhere {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        Ok(black_box(bytes.len()))
    }
    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl WriteReady for Nowhere {
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(black_box(true))
    }
}

/// The flash failed.
#[derive(Debug)]
struct Failed;

impl NorFlashError for Failed {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl ErrorType for Nowhere {
    type Error = Failed;
}

impl ReadNorFlash for Nowhere {
    const READ_SIZE: usize = 1;
    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Failed> {
        black_box((offset, &mut *bytes));
        black_box(Ok(()))
    }
    fn capacity(&self) -> usize {
        black_box(256 * 1024)
    }
}

impl NorFlash for Nowhere {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 128 * 1024;
    fn erase(&mut self, from: u32, to: u32) -> Result<(), Failed> {
        black_box((from, to));
        black_box(Ok(()))
    }
    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Failed> {
        black_box((offset, bytes));
        black_box(Ok(()))
    }
}

/// One of two robots; never comes back.
pub fn run(trust: impl Trust) -> Option<()> {
    let goes_on = || true;
    if black_box(true) { rosbot(trust, Nowhere, goes_on) } else { leg(trust, Nowhere, goes_on) }
}

const fn identity(
    robot: &'static str,
    factory: &'static [u8],
    capacities: Capacities,
) -> Identity<'static> {
    Identity { firmware: "image", robot, factory, capacities, erase_ms: 4_000, good_ticks: 1_000 }
}

#[inline(never)]
fn no_model() -> Model<'static> {
    Model::empty()
}

/// The model of the ROSbot, where it is to be.
pub fn rosbot_model(model: &mut Model<'static>) -> Option<()> {
    load(model, "skid-rosbot", &ROSBOT.0)
}

/// Loads the model of a robot; the state in which its prediction is tried is off the stack afterwards.
#[inline(never)]
fn load(model: &mut Model<'static>, robot: &str, blob: &'static [u8]) -> Option<()> {
    parse_into(blob, model, &mut PredictorState::new()).ok()?;
    (model.structure().robot() == robot).then_some(())
}

/// Its loop.
#[inline(never)]
pub fn rosbot_loop<'m, 'q>(
    model: &'m Model<'static>,
    telemetry: Telemetry<'q>,
) -> Option<impl ControlLoop<2> + use<'m, 'q>> {
    let sides = Sides { right: Motor::new(Nowhere, Nowhere), left: Motor::new(Nowhere, Nowhere) };
    // A heading that is measured over any number of turns.
    let devices = (sides, (Nowhere, Nowhere), Turning { last: 0.0, by: 0.45 });
    // What the devices read stands still: no reason to stop.
    let settings = RosbotSettings { stall_volt: 100.0, ..RosbotSettings::default() };
    Rosbot::<_, _, _, 10>::new(model, devices, settings, telemetry).ok()
}

/// The model of the leg.
pub fn leg_model(model: &mut Model<'static>) -> Option<()> {
    load(model, "soft-leg", &LEG.0)
}

/// Its loop.
#[inline(never)]
pub fn leg_loop<'m, 'q>(
    model: &'m Model<'static>,
    telemetry: Telemetry<'q>,
) -> Option<impl ControlLoop<2> + use<'m, 'q>> {
    let pneumatics = Pneumatics {
        bending: Chamber::new(Nowhere, Nowhere),
        extension: Chamber::new(Nowhere, Nowhere),
        input_pump: Nowhere,
        exhaust_pump: Nowhere,
    };
    let settings = SoftLegSettings::default();
    let tip = Turning { last: 60.0, by: 0.0 };
    SoftLeg::<_, _, 20>::new(model, pneumatics, tip, settings, telemetry).ok()
}

/// What installs models.
type Updates<T> = Updater<'static, Nowhere, T, fn(Payload) -> bool>;

/// The ROSbot as long as it `goes_on`, asked at every tick.
#[inline(never)]
pub fn rosbot<S: Read + ReadReady + Write + WriteReady>(
    trust: impl Trust,
    serial: S,
    goes_on: impl FnMut() -> bool,
) -> Option<()> {
    static IDENTITY: Identity<'static> =
        identity("skid-rosbot", &ROSBOT.0, Capacities::new::<3, 2>(100_000, 0));
    let mut updater = boot(&IDENTITY, trust);
    let mut model = no_model();
    rosbot_model(&mut model)?;
    run_rosbot(&model, updater.as_mut()?, serial, goes_on)
}

/// The leg.
#[inline(never)]
pub fn leg<S: Read + ReadReady + Write + WriteReady>(
    trust: impl Trust,
    serial: S,
    goes_on: impl FnMut() -> bool,
) -> Option<()> {
    static IDENTITY: Identity<'static> =
        identity("soft-leg", &LEG.0, Capacities::new::<2, 2>(50_000, 0));
    let mut updater = boot(&IDENTITY, trust);
    let mut model = no_model();
    leg_model(&mut model)?;
    run_leg(&model, updater.as_mut()?, serial, goes_on)
}

// What comes once is off the stack when the loop runs: what decides which model that is, what loads it, and what
// the loop is made from. And nothing is unwrapped, which would be a copy.

#[inline(never)]
fn boot<T: Trust>(identity: &Identity<'static>, trust: T) -> Option<Updates<T>> {
    let geometry = Geometry { offset: 0, slot_bytes: 128 * 1024 };
    let accept = |payload: Payload| black_box(payload.length) > 0;
    let booted = Updater::boot(Nowhere, geometry, *identity, 0, trust, accept as fn(_) -> _);
    booted.ok().map(|(updater, _)| updater)
}

#[inline(never)]
fn run_rosbot(
    model: &Model<'static>,
    updater: &mut Updates<impl Trust>,
    serial: impl Read + ReadReady + Write + WriteReady,
    goes_on: impl FnMut() -> bool,
) -> Option<()> {
    let mut queue = Queue::<FRAMES>::new();
    let (producer, mut frames) = queue.split();
    let mut robot = rosbot_loop(model, Telemetry::new(producer));
    serve(robot.as_mut()?, updater, &mut frames, serial, goes_on)
}

#[inline(never)]
fn run_leg(
    model: &Model<'static>,
    updater: &mut Updates<impl Trust>,
    serial: impl Read + ReadReady + Write + WriteReady,
    goes_on: impl FnMut() -> bool,
) -> Option<()> {
    let mut queue = Queue::<FRAMES>::new();
    let (producer, mut frames) = queue.split();
    let mut leg = leg_loop(model, Telemetry::new(producer));
    serve(leg.as_mut()?, updater, &mut frames, serial, goes_on)
}

#[inline(never)]
fn serve(
    robot: &mut dyn ControlLoop<2>,
    updater: &mut Updates<impl Trust>,
    frames: &mut Frames<'_>,
    mut serial: impl Read + ReadReady + Write + WriteReady,
    mut goes_on: impl FnMut() -> bool,
) -> Option<()> {
    let mut port = Port::new();
    while goes_on() && !(updater.resets() && port.is_sent()) {
        let now_us = black_box(0);
        port.receive(&mut serial, robot, updater, now_us);
        robot.tick(now_us);
        robot.finish(black_box(0));
        updater.ticked(robot.alarms());
        port.send(frames, &mut serial);
    }
    None
}
