//! A robot of one's own, from its first log to a control loop with a model: docs/your-robot.md.
//!
//! A cart on a rail, driven by one motor behind an H-bridge; a camera measures where it is. The cart, its
//! motor and the camera are simulated; [`Bridge`] and [`CartLoop`] are what runs on a controller.

use std::error::Error;
use std::fmt::Write;
use std::path::Path;

use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;
use firmware_core::Model;
use firmware_core::blob::Aligned;
use firmware_core::control_loop::rosbot::Motor;
use firmware_core::control_loop::telemetry::Queue;
use firmware_core::control_loop::{
    ActuatorError, Actuators, Alarms, Command, ControlLoop, ControlLoopError, Frame, Mode,
    Supervisor, Telemetry, Timing, Tracker,
};
use firmware_core::device::{MonotonicClock, PositionSensor};
use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
use firmware_sim::mcu::{Board, MotionCapture, Pin, Pwm, VirtualClock, Wire};

// What runs on the controller.

/// The cart's only actuator: the share of the supply goes to a motor behind an H-bridge.
pub struct Bridge<P, D>(Motor<P, D>);

impl<P: SetDutyCycle, D: OutputPin> Actuators<1> for Bridge<P, D> {
    fn apply(&mut self, [share]: [f32; 1]) -> Result<(), ActuatorError> {
        self.0.apply(share)
    }

    fn stop(&mut self) -> Result<(), ActuatorError> {
        self.0.apply(0.0)
    }
}

/// Full duty (V).
const SUPPLY_VOLT: f32 = 12.0;
/// The cart shall not be farther from the middle of its rail (m).
const END_M: f32 = 0.9;

/// The loop: every tick is a sample of the model. Voltages that would take the cart beyond the end of
/// its rail within the next ten samples are not applied.
pub struct CartLoop<'m, 'a, 'q, A, S> {
    actuators: A,
    sensor: S,
    tracker: Tracker<'m, 'a, 1, 1, 10>,
    supervisor: Supervisor,
    telemetry: Telemetry<'q>,
    /// What the host wants (V).
    wanted: [f32; 1],
    /// What acts since the last tick (V).
    applied: [f32; 1],
    /// How often a voltage was not applied.
    pub held_back: u32,
}

impl<'m, 'a, 'q, A: Actuators<1>, S: PositionSensor<1>> CartLoop<'m, 'a, 'q, A, S> {
    /// An idle cart.
    pub fn new(
        model: &'m Model<'a>,
        (actuators, sensor): (A, S),
        telemetry: Telemetry<'q>,
    ) -> Result<Self, ControlLoopError> {
        Ok(Self {
            actuators,
            sensor,
            tracker: Tracker::new(model, 10)?,
            supervisor: Supervisor::new(Timing::new(model, 1, 1_000_000)?),
            telemetry,
            wanted: [0.0],
            applied: [0.0],
            held_back: 0,
        })
    }
}

impl<A: Actuators<1>, S: PositionSensor<1>> ControlLoop<1> for CartLoop<'_, '_, '_, A, S> {
    fn command(&mut self, command: Command<1>) {
        self.supervisor.follow(command, &mut self.wanted, &self.tracker);
    }

    /// One tick: sense, predict, act, report.
    fn tick(&mut self, now_us: u64) -> Mode {
        self.supervisor.begin(now_us);
        let measured = self.tracker.measure(&mut self.sensor);
        let is_running = self.supervisor.mode() == Mode::Running;
        let mut next = if is_running { self.wanted } else { [0.0] };
        let tracked = self.tracker.sample(&self.applied, measured, &next);
        self.supervisor.judge(tracked.alarms, &mut self.tracker);

        // What is this cart's own: the path ahead under the voltage that the host wants.
        let beyond = |[x]: &[f32; 1]| x.abs() > END_M;
        if self.supervisor.mode() == Mode::Running && self.tracker.path().iter().any(beyond) {
            next = [0.0];
            self.held_back += 1;
        }

        let mode = self.supervisor.act(&mut self.actuators, next.map(|u| u / SUPPLY_VOLT));
        self.applied = if mode == Mode::Running { next } else { [0.0] };
        self.telemetry.send(Frame::of(now_us, self.supervisor.report(), &self.tracker));
        mode
    }

    fn finish(&mut self, now_us: u64) -> Mode {
        let mode = self.supervisor.finish(now_us, &mut self.actuators);
        if mode != Mode::Running {
            self.applied = [0.0];
        }
        mode
    }

    fn path(&self) -> &[f32] {
        self.tracker.path().as_flattened()
    }

    fn supervisor(&self) -> &Supervisor {
        &self.supervisor
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.supervisor
    }
}

// The cart itself, and the board that it is wired to.

const SAMPLE_US: u64 = 50_000;

/// The cart: x' = v, v' = (0.05 u (1 + (u / 12)²) − v) / 0.15, in m, s and V: its motor is series-wound,
/// and does more with more.
struct Cart {
    x: f64,
    v: f64,
    /// Something holds it.
    blocked: bool,
    duty: Wire<f64>,
    backwards: Wire<bool>,
    seen: Wire<[f64; 1]>,
    clock: VirtualClock,
    board: Board,
}

/// The cart and the devices that its firmware gets.
type OnBoard = (Cart, Bridge<Pwm, Pin>, MotionCapture<1>);

impl Cart {
    /// A cart at rest, with its bridge and its camera, which is off by half a millimetre.
    fn new(seed: u64) -> Result<OnBoard, Box<dyn Error>> {
        let clock = VirtualClock::new();
        let mut board = Board::new(&clock);
        let (duty, backwards) = (board.pwm_wire(3, 1), board.pin_wire("direction"));
        let pwm = board.pwm(3, 1, 18_000)?;
        let pin = board.direction_pin("direction", &pwm)?;
        let seen = Wire::new([0.0]);
        let settings = MotionCaptureSettings {
            period_us: SAMPLE_US.try_into()?,
            noise_std: [5e-4],
            decimals: Some(5),
        };
        let camera = MotionCapture::new(&seen, &clock, settings, seed);
        let cart = Self { x: 0.0, v: 0.0, blocked: false, duty, backwards, seen, clock, board };
        Ok((cart, Bridge(Motor::new(pwm, pin)), camera))
    }

    /// Lets a sample time pass, in steps of a millisecond.
    fn advance(&mut self) {
        let sign = if self.backwards.get() { -1.0 } else { 1.0 };
        let volt = sign * self.duty.get() * f64::from(SUPPLY_VOLT);
        let drive = 0.05 * volt * (1.0 + (volt / 12.0) * (volt / 12.0));
        for _ in 0..50 {
            self.v += (drive - self.v) / 0.15 * 1e-3;
            self.v *= if self.blocked { 0.0 } else { 1.0 };
            self.x += self.v * 1e-3;
        }
        self.seen.set([self.x]);
        self.clock.advance_us(SAMPLE_US);
    }
}

/// Uniform in ±1, without a generator's crate.
fn uniform(seed: &mut u64) -> f32 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (2.0 * (*seed >> 11) as f64 / (1_u64 << 53) as f64 - 1.0) as f32
}

/// The header of a log.
const HEADER: &str = "time_s,x_m,u_V\n";

/// Writes twenty logs of 20 s. There is no model yet: voltages are random, and towards the middle where
/// the cart is far from it.
pub fn record(folder: &Path, seed: u64) -> Result<String, Box<dyn Error>> {
    std::fs::create_dir_all(folder)?;
    for trial in 0..20 {
        let mut random = seed * 1000 + trial;
        let (mut cart, mut bridge, mut camera) = Cart::new(random)?;
        let (mut log, mut volt) = (HEADER.to_owned(), 0.0);
        for row in 0..=400 {
            if row % 8 == 0 {
                volt = (uniform(&mut random) * SUPPLY_VOLT * 100.0).round() / 100.0;
            }
            let Some([x]) = camera.measure()? else {
                return Err("the camera has no picture".into());
            };
            if x.abs() > 0.4 && x * volt > 0.0 {
                volt = -volt;
            }
            bridge.apply([volt / SUPPLY_VOLT]).map_err(|_| "the bridge failed")?;
            writeln!(log, "{:.2},{x},{volt}", f64::from(row) * 0.05)?;
            cart.advance();
        }
        if let Some(misuse) = cart.board.misuse() {
            return Err(misuse.to_string().into());
        }
        std::fs::write(folder.join(format!("trial-{trial:02}.csv")), log)?;
    }
    Ok(format!("20 logs of 401 rows in {}\n", folder.display()))
}

/// Runs the loop with a blob for a minute, under random voltages that know of no rail, and writes its
/// frames as a log. After half a minute something may block the cart.
pub fn run(blob: &Path, log: &Path, is_blocked: bool) -> Result<String, Box<dyn Error>> {
    // On a controller: static BLOB: &Aligned<[u8]> = &Aligned(*include_bytes!("model.bin"));
    let bytes = std::fs::read(blob)?;
    let mut slot = Box::new(Aligned([0xff; 8192]));
    slot.0.get_mut(..bytes.len()).ok_or("the blob is too long")?.copy_from_slice(&bytes);
    let model = firmware_core::parse_prefix(&slot.0).map_err(|error| format!("{error:?}"))?;
    if model.structure().robot() != "cart" {
        return Err("the blob is one of another robot".into());
    }

    let (mut cart, bridge, camera) = Cart::new(3)?;
    let mut queue = Queue::<4>::new();
    let (producer, mut consumer) = queue.split();
    let telemetry = Telemetry::new(producer);
    let mut robot =
        CartLoop::new(&model, (bridge, camera), telemetry).map_err(|error| format!("{error:?}"))?;

    let (mut random, mut said) = (7, String::new());
    let (mut frames, mut farthest, mut noticed) = (Vec::<Frame>::new(), 0.0_f64, Alarms::none());
    for sample in 0..=1200_u32 {
        cart.blocked = is_blocked && sample >= 600;
        // The host: starts, changes its mind twice a second, and stops when something is wrong.
        if sample == 1 {
            robot.command(Command::Start);
        }
        if sample % 10 == 1 {
            robot.command(Command::Inputs([uniform(&mut random) * SUPPLY_VOLT]));
        }
        robot.tick(cart.clock.now_us());
        robot.finish(cart.clock.now_us());
        let Some(frame) = consumer.dequeue() else { return Err("a tick without a frame".into()) };
        if frame.noticed.contains(Alarms::RESIDUAL) && frame.mode == Mode::Running {
            let time_s = frame.time_us as f64 * 1e-6;
            writeln!(said, "{time_s:.2} s: the cart is not where the model says: stopped")?;
            robot.command(Command::Stop);
        }
        noticed |= frame.noticed;
        frames.push(frame);
        cart.advance();
        farthest = farthest.max(cart.x.abs());
    }
    if let Some(misuse) = cart.board.misuse() {
        return Err(misuse.to_string().into());
    }

    let mode = frames.last().map(|frame| frame.mode);
    writeln!(
        said,
        "{} frames; at the end {:?}; noticed: {noticed}",
        frames.len(),
        mode.unwrap_or_default()
    )?;
    writeln!(said, "held back {} times; never farther out than {farthest:.2} m", robot.held_back)?;
    let before = frames.iter().take(if is_blocked { 600 } else { 1201 });
    let worst =
        before.flat_map(|frame| &frame.residual).fold(0.0_f32, |worst, r| worst.max(r.abs()));
    writeln!(said, "largest residual while it was free {:.1} mm", 1e3 * worst)?;
    std::fs::write(log, csv(&frames))?;
    Ok(said)
}

/// Frames as a log: a row has what was measured in its frame, and what was applied until the next one,
/// which is in that. A frame without a measurement ends the log, as the trainer asks for even times.
fn csv(frames: &[Frame]) -> String {
    let mut log = HEADER.to_owned();
    for pair in frames.windows(2) {
        let [now, next] = pair else { continue };
        let (Some(x), Some(u)) = (now.measured.first(), next.applied.first()) else { break };
        let _ = writeln!(log, "{:.2},{x},{u}", now.time_us as f64 * 1e-6);
    }
    log
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let said = match arguments[..] {
        ["record", folder, seed] => record(Path::new(folder), seed.parse()?)?,
        ["run", blob, log] => run(Path::new(blob), Path::new(log), false)?,
        ["run", blob, log, "--blocked"] => run(Path::new(blob), Path::new(log), true)?,
        _ => return Err("usage: cart record FOLDER SEED | cart run BLOB LOG [--blocked]".into()),
    };
    print!("{said}");
    Ok(())
}
