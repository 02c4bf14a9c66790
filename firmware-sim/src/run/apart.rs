//! A robot whose controller is somewhere else: in QEMU (firmware-sim/cortex-m/robot), or on a board.
//!
//! ```text
//!  controller ══ line ═════════════════════ Plant     sensors and actuators, a frame each way per tick
//!      ╚════════ link ══ pass_on ══ door ══ client    commands and telemetry, docs/protocol.md
//! ```
//!
//! What goes over the line is specified in [`plant_line`](crate::plant_line). The robot's time is that of its
//! controller: it moves for a tick when it hears of one, under the outputs that the controller had set at the
//! tick's end. What it sets and takes back within a tick the robot does not see.

use crate::bench::{RosbotBench, SoftLegBench};
use crate::fault::{Fault, FaultKind, Faults};
use crate::faulty::{FaultyEncoder, FaultySensor};
use crate::mcu::position_sensor::MotionCaptureSettings;
use crate::mcu::{Encoder, MotionCapture, Pin, Pwm};
use crate::plant_line::{Actuators, Body as _, Receiver, Robot, Sensors, TICK_US};
use crate::run::RunError;
use crate::run::host::{Host, Laptop as _};
use crate::run::rig::Rig;
use crate::run::scenario::Scenario;
use crate::run::serve::{Door, Remote};
use embedded_hal::digital::OutputPin as _;
use embedded_hal::pwm::SetDutyCycle as _;
use embedded_io::{ErrorType, ReadReady};
use firmware_core::device::{EncoderCount as _, PositionSensor};
use serial2::SerialPort;
use std::convert::Infallible;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::num::NonZeroU64;
#[cfg(unix)]
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// Longest wait for bytes.
const PATIENCE: Duration = Duration::from_millis(100);
/// The same where somebody else has bytes, too.
const SHORT: Duration = Duration::from_millis(1);
/// Most ticks that a robot moves at once when frames were lost: a second.
const MOST_TICKS: u32 = 100;

/// A line to a controller.
#[derive(Debug)]
pub enum Line {
    /// A serial device, or a pseudo-terminal.
    Serial(SerialPort),
    /// A TCP connection.
    Tcp(TcpStream),
    /// A socket in the file system.
    #[cfg(unix)]
    Unix(UnixStream),
}

impl Line {
    /// Opens `tcp:HOST:PORT`, `unix:PATH`, or the serial device of this name at `baud` bits/s.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub fn open(name: &str, baud: u32) -> io::Result<Self> {
        let mut line = match name.split_once(':') {
            Some(("tcp", address)) => {
                let stream = TcpStream::connect(address)?;
                // A tick is short, and the controller waits for it.
                stream.set_nodelay(true)?;
                Self::Tcp(stream)
            }
            #[cfg(unix)]
            Some(("unix", path)) => Self::Unix(UnixStream::connect(path)?),
            _ => Self::Serial(SerialPort::open(name, baud)?),
        };
        line.set_patience(PATIENCE)?;
        Ok(line)
    }

    fn set_patience(&mut self, patience: Duration) -> io::Result<()> {
        match self {
            Self::Serial(line) => line.set_read_timeout(patience),
            Self::Tcp(stream) => stream.set_read_timeout(Some(patience)),
            #[cfg(unix)]
            Self::Unix(stream) => stream.set_read_timeout(Some(patience)),
        }
    }

    /// What has arrived; nothing after a while without a byte.
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = match self {
            Self::Serial(line) => line.read(bytes),
            Self::Tcp(stream) => stream.read(bytes),
            #[cfg(unix)]
            Self::Unix(stream) => stream.read(bytes),
        };
        let nothing = [ErrorKind::TimedOut, ErrorKind::WouldBlock, ErrorKind::Interrupted];
        match read {
            Ok(0) => Err(io::Error::new(ErrorKind::UnexpectedEof, "the controller has hung up")),
            Err(e) if nothing.contains(&e.kind()) => Ok(0),
            read => read,
        }
    }

    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Serial(line) => line.write_all(bytes),
            Self::Tcp(stream) => stream.write_all(bytes),
            #[cfg(unix)]
            Self::Unix(stream) => stream.write_all(bytes),
        }
    }
}

/// Wheels or chambers, and what measures them.
trait Devices {
    /// Sets the outputs, and lets a tick pass.
    fn act(&mut self, duties: [u16; 2], pins: u8);
    /// Lets a tick pass under the outputs as they are.
    fn hold(&mut self);
    /// What is measured now: counts, position, and its age (µs).
    fn sense(&mut self) -> ([u16; 2], Option<([f32; 3], u32)>);
}

struct Rosbot {
    bench: RosbotBench,
    faults: Faults,
    pwm: [Pwm; 2],
    direction: [Pin; 2],
    encoders: [FaultyEncoder<Encoder>; 2],
    pose: FaultySensor<MotionCapture<3>, 3>,
}

struct SoftLeg {
    bench: SoftLegBench,
    faults: Faults,
    valves: [Pwm; 2],
    lines: [Pin; 2],
    pumps: [Pin; 2],
    tip: FaultySensor<MotionCapture<2>, 2>,
}

/// A sensor measures every tick: which of them are samples the controller knows.
fn every_tick<const N: usize>(settings: MotionCaptureSettings<N>) -> MotionCaptureSettings<N> {
    MotionCaptureSettings { period_us: NonZeroU64::new(TICK_US.into()).unwrap(), ..settings }
}

/// A duty as the controller says it, on a channel of ours, which has the same full duty.
fn set(pwm: &mut Pwm, duty: u16) {
    let duty = duty.min(pwm.max_duty_cycle());
    pwm.set_duty_cycle(duty).expect("the duty is in range, and nobody resets this board");
}

fn switch(pin: &mut Pin, pins: u8, bit: u8) {
    let state = (pins & 1 << bit != 0).into();
    pin.set_state(state).expect("nothing is driven, and nobody resets this board");
}

fn position<const N: usize>(
    sensor: &mut FaultySensor<MotionCapture<N>, N>,
) -> Option<([f32; 3], u32)> {
    let Ok(measured) = sensor.measure();
    let measured = measured?;
    let coordinates = std::array::from_fn(|i| measured.get(i).copied().unwrap_or(0.0));
    Some((coordinates, sensor.age_us()))
}

impl Devices for Rosbot {
    fn act(&mut self, duties: [u16; 2], pins: u8) {
        for (side, (pwm, pin)) in self.pwm.iter_mut().zip(&mut self.direction).enumerate() {
            // The order of the controller: a bridge is turned round without load.
            set(pwm, 0);
            switch(pin, pins, side as u8);
            set(pwm, duties[side]);
        }
        self.hold();
    }

    fn hold(&mut self) {
        self.bench.apply(&self.faults);
        self.bench.advance_us(TICK_US.into());
    }

    fn sense(&mut self) -> ([u16; 2], Option<([f32; 3], u32)>) {
        let counts = self.encoders.each_mut().map(|encoder| {
            let Ok(count) = encoder.count();
            count
        });
        (counts, position(&mut self.pose))
    }
}

impl Devices for SoftLeg {
    fn act(&mut self, duties: [u16; 2], pins: u8) {
        for (chamber, (valve, line)) in self.valves.iter_mut().zip(&mut self.lines).enumerate() {
            switch(line, pins, chamber as u8);
            set(valve, duties[chamber]);
        }
        for (pump, pin) in self.pumps.iter_mut().enumerate() {
            switch(pin, pins, 2 + pump as u8);
        }
        self.hold();
    }

    fn hold(&mut self) {
        self.bench.apply(&self.faults);
        self.bench.advance_us(TICK_US.into());
    }

    fn sense(&mut self) -> ([u16; 2], Option<([f32; 3], u32)>) {
        ([0; 2], position(&mut self.tip))
    }
}

/// A robot at the far end of a line.
pub struct Plant {
    robot: Robot,
    devices: Box<dyn Devices>,
    /// Number of the last tick, and what was measured at its end.
    last: Option<(u32, Sensors)>,
}

impl Plant {
    /// A robot at rest, with the faults of a scenario; `seed` is that of the sensors' noise and the faults.
    ///
    /// # Errors
    /// [`RunError::Fault`]: one that this robot cannot have, or one of a controller or a host.
    pub fn new(robot: Robot, faults: &[Fault], seed: u64) -> Result<Self, RunError> {
        let is_ours = |fault: &Fault| {
            use FaultKind::{BrownOut, LateTick, Silence};
            robot.run().feels(fault) && !matches!(fault.kind(), BrownOut | LateTick | Silence)
        };
        if let Some(fault) = faults.iter().find(|fault| !is_ours(fault)) {
            let robot = format!("{robot:?} without its controller");
            return Err(RunError::Fault { fault: *fault, robot });
        }
        const CLAIMED: &str = "a new board has all its devices";
        let faults = faults.iter().copied();
        let devices: Box<dyn Devices> = match robot {
            Robot::Rosbot => {
                let mut bench = <RosbotBench as Rig<3>>::new();
                let faults = Faults::new(bench.clock(), faults, seed);
                let settings = every_tick(MotionCaptureSettings::POSE);
                let devices = bench.devices(settings, seed).expect(CLAIMED);
                let [right, left] = devices.encoders;
                Box::new(Rosbot {
                    pwm: devices.pwm,
                    direction: devices.direction,
                    encoders: [
                        FaultyEncoder::new(right, &faults, 0),
                        FaultyEncoder::new(left, &faults, 1),
                    ],
                    pose: FaultySensor::new(devices.pose, &faults, RosbotBench::SPIKE),
                    bench,
                    faults,
                })
            }
            Robot::SoftLeg => {
                let mut bench = <SoftLegBench as Rig<2>>::new();
                let faults = Faults::new(bench.clock(), faults, seed);
                let settings = every_tick(MotionCaptureSettings::TIP);
                let devices = bench.devices(settings, seed).expect(CLAIMED);
                Box::new(SoftLeg {
                    valves: devices.valves,
                    lines: devices.lines,
                    pumps: devices.pumps,
                    tip: FaultySensor::new(devices.tip, &faults, SoftLegBench::SPIKE),
                    bench,
                    faults,
                })
            }
        };
        Ok(Self { robot, devices, last: None })
    }

    /// What the robot measures after a tick of its controller; `None` of another robot's.
    ///
    /// ```
    /// use firmware_sim::plant_line::{Actuators, Robot};
    /// use firmware_sim::run::apart::Plant;
    ///
    /// let mut plant = Plant::new(Robot::Rosbot, &[], 1)?;
    /// let robot = Robot::Rosbot;
    /// for tick in 0..200 {
    ///     plant.tick(&Actuators { robot, tick, duties: [2333; 2], pins: 0 }); // half of 4666: 6 V
    /// }
    /// // As on its bench.
    /// let last = Actuators { robot, tick: 199, duties: [0; 2], pins: 0 };
    /// assert_eq!(plant.tick(&last).unwrap().counts, [5685; 2], "said again, the tick is not done again");
    /// # Ok::<(), firmware_sim::run::RunError>(())
    /// ```
    pub fn tick(&mut self, actuators: &Actuators) -> Option<Sensors> {
        let Actuators { robot, tick, duties, pins } = *actuators;
        if robot != self.robot {
            return None;
        }
        match self.last {
            Some((last, sensors)) if tick == last => return Some(sensors),
            Some((last, _)) if tick > last => {
                (1..(tick - last).min(MOST_TICKS)).for_each(|_| self.devices.hold());
            }
            // The first one of all, or after a reset.
            _ => {}
        }
        self.devices.act(duties, pins);
        let (counts, position) = self.devices.sense();
        let sensors = Sensors { robot, tick, counts, position };
        self.last = Some((tick, sensors));
        Some(sensors)
    }

    /// Serves a controller until it hangs up; `told` when it begins, and begins anew.
    ///
    /// # Errors
    /// When the line is gone.
    pub fn serve(&mut self, line: &mut Line, told: &mut dyn FnMut(&str)) -> io::Result<Infallible> {
        let (mut receiver, mut bytes) = (Receiver::new(), [0; 256]);
        let mut is_strange = false;
        loop {
            let count = line.read(&mut bytes)?;
            for byte in &bytes[..count] {
                let Some(actuators) = receiver.push::<Actuators>(*byte) else { continue };
                let before = self.last.map(|(tick, _)| tick);
                let Some(sensors) = self.tick(&actuators) else {
                    if !std::mem::replace(&mut is_strange, true) {
                        told("the controller's robot is another one");
                    }
                    continue;
                };
                let (frame, length) = sensors.frame();
                line.write_all(&frame[..length])?;
                match before {
                    None => told("the controller is there"),
                    Some(before) if actuators.tick < before => told("the controller was reset"),
                    _ => {}
                }
            }
        }
    }
}

impl Robot {
    /// As runs know it.
    pub fn run(self) -> crate::run::Robot {
        match self {
            Self::Rosbot => crate::run::Robot::Rosbot,
            Self::SoftLeg => crate::run::Robot::SoftLeg,
        }
    }
}

/// Our end of the link, for a client who takes bytes as they come.
struct LinkEnd {
    line: Line,
    bytes: [u8; 256],
    /// Those that have arrived and not been handed on.
    waiting: std::ops::Range<usize>,
    /// Why it has ended.
    error: Option<io::Error>,
}

/// It has ended, and its end says why.
#[derive(Debug)]
struct Ended;

impl embedded_io::Error for Ended {
    fn kind(&self) -> embedded_io::ErrorKind {
        embedded_io::ErrorKind::Other
    }
}

impl std::fmt::Display for Ended {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("the line has ended")
    }
}

impl std::error::Error for Ended {}

impl ErrorType for LinkEnd {
    type Error = Ended;
}

impl ReadReady for LinkEnd {
    fn read_ready(&mut self) -> Result<bool, Ended> {
        if self.waiting.is_empty() {
            let read = self.line.read(&mut self.bytes);
            self.waiting = 0..read.map_err(|error| self.ended(error))?;
        }
        Ok(!self.waiting.is_empty())
    }
}

impl embedded_io::Read for LinkEnd {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Ended> {
        let count = bytes.len().min(self.waiting.len());
        let end = self.waiting.start + count;
        bytes[..count].copy_from_slice(&self.bytes[self.waiting.start..end]);
        self.waiting.start = end;
        Ok(count)
    }
}

impl embedded_io::Write for LinkEnd {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Ended> {
        self.line.write_all(bytes).map_err(|error| self.ended(error))?;
        Ok(bytes.len())
    }
    fn flush(&mut self) -> Result<(), Ended> {
        Ok(())
    }
}

impl LinkEnd {
    fn ended(&mut self, error: io::Error) -> Ended {
        self.error = Some(error);
        Ended
    }
}

/// Passes a controller's link on to clients at a door, and with `drives` drives the robot by the scenario's
/// script meanwhile, until the controller hangs up.
///
/// # Errors
/// When the link is gone.
pub fn pass_on(
    mut link: Line,
    (scenario, seed): (&Scenario, u64),
    door: Door,
    drives: bool,
) -> io::Result<Infallible> {
    link.set_patience(SHORT)?;
    let end = LinkEnd { line: link, bytes: [0; 256], waiting: 0..0, error: None };
    let host = Host::new(scenario, seed);
    // Waiting for the link's bytes is what paces it.
    let mut remote = Remote::new(end, door, host, (drives, 0.0));
    let began = Instant::now();
    loop {
        remote.turn(began.elapsed().as_micros() as u64, &mut |_| Ok(()))?;
        if let Some(error) = remote.end().error.take() {
            return Err(error);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AHEAD: Actuators =
        Actuators { robot: Robot::Rosbot, tick: 0, duties: [2333; 2], pins: 0 };

    fn plant(faults: &[&str]) -> Result<Plant, RunError> {
        let faults: Vec<Fault> = faults.iter().map(|fault| fault.parse().unwrap()).collect();
        Plant::new(Robot::Rosbot, &faults, 1)
    }

    fn ticks(plant: &mut Plant, ticks: impl IntoIterator<Item = u32>) -> Sensors {
        let ticked = ticks.into_iter().map(|tick| plant.tick(&Actuators { tick, ..AHEAD }));
        ticked.last().unwrap().unwrap()
    }

    #[test]
    fn a_robot_that_missed_frames_is_where_it_would_have_been() {
        let mut whole = plant(&[]).unwrap();
        let mut missing = plant(&[]).unwrap();
        let expected = ticks(&mut whole, 0..100);
        let found = ticks(&mut missing, (0..100).filter(|tick| tick % 7 != 3));
        assert_eq!(found.counts, expected.counts);
        assert!(expected.counts[0] > 2000);
    }

    #[test]
    fn a_controller_that_was_reset_finds_the_robot_where_it_left_it() {
        let mut plant = plant(&[]).unwrap();
        let before = ticks(&mut plant, 0..100).counts[0];
        let off = Actuators { duties: [0; 2], ..AHEAD };
        let after = plant.tick(&off).unwrap();
        assert_eq!(after.tick, 0);
        assert!((1..50).contains(&after.counts[0].wrapping_sub(before)), "{before} {after:?}");
    }

    #[test]
    fn a_leg_bends_as_on_its_bench() {
        let mut plant = Plant::new(Robot::SoftLeg, &[], 1).unwrap();
        // Line of the bending chamber and input pump; half of the supply for a second.
        let (robot, duties, pins) = (Robot::SoftLeg, [2333, 0], 1 | 1 << 2);
        let bends = (0..100).map(|tick| plant.tick(&Actuators { robot, tick, duties, pins }));
        let measured = bends.last().unwrap().unwrap().position.unwrap().0;
        // Measured with 0.1 mm of noise.
        assert!(
            (measured[0] - 24.82).abs() < 0.5 && (measured[1] - 6.82).abs() < 0.5,
            "{measured:?}"
        );
    }

    #[test]
    fn pins_turn_motors_round_without_load() {
        let mut plant = plant(&[]).unwrap();
        ticks(&mut plant, 0..100);
        let (backwards, tick) = (Actuators { pins: 1, ..AHEAD }, 100..300);
        let turned = tick.map(|tick| plant.tick(&Actuators { tick, ..backwards }).unwrap());
        let [right, left] = turned.last().unwrap().counts;
        assert!((right as i16) < 0 && left as i16 > 5000, "{right} {left}");
    }

    #[test]
    fn faults_are_those_of_the_robot() {
        let mut lost = plant(&["dropout@0..10=1"]).unwrap();
        assert_eq!(ticks(&mut lost, 0..10).position, None);
        assert!(ticks(&mut plant(&[]).unwrap(), 0..10).position.is_some());
        for fault in ["leak@0..1=1", "late-tick@0..1=1", "silence@0..1=1", "brown-out@0..1=1"] {
            assert!(matches!(plant(&[fault]), Err(RunError::Fault { .. })), "{fault}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_line_is_served_until_it_ends() {
        let (mut ours, theirs) = UnixStream::pair().unwrap();
        let controller = std::thread::spawn(move || {
            let (mut receiver, mut heard, mut bytes) = (Receiver::new(), Vec::new(), [0; 64]);
            let others = Actuators { robot: Robot::SoftLeg, ..AHEAD };
            // Noise and what is another robot's get no answer.
            ours.write_all(&[7, 7, 0]).unwrap();
            for actuators in [others, AHEAD, Actuators { tick: 5, ..AHEAD }, AHEAD] {
                let (frame, length) = actuators.frame();
                ours.write_all(&frame[..length]).unwrap();
            }
            while heard.len() < 3 {
                let count = ours.read(&mut bytes).unwrap();
                let bodies = bytes[..count].iter().filter_map(|byte| receiver.push(*byte));
                heard.extend(bodies.map(|sensors: Sensors| sensors.tick));
            }
            heard
        });
        let (mut line, mut said) = (Line::Unix(theirs), Vec::new());
        let mut plant = plant(&[]).unwrap();
        let Err(error) = plant.serve(&mut line, &mut |what| said.push(what.to_owned()));
        assert_eq!(error.kind(), ErrorKind::UnexpectedEof);
        assert_eq!(controller.join().unwrap(), [0, 5, 0]);
        let expected = [
            "the controller's robot is another one",
            "the controller is there",
            "the controller was reset",
        ];
        assert_eq!(said, expected);
    }
}
