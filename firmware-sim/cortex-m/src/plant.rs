//! Motors, valves, encoders and position sensors whose other end is a simulated robot on the laptop: what the
//! loop sets in a tick goes there in a frame, what it reads came from there ([`plant_line`]).

use core::cell::{Cell, RefCell};
use core::convert::Infallible;

use embedded_hal::digital::{ErrorType as PinErrorType, OutputPin};
use embedded_hal::pwm::{ErrorType as PwmErrorType, SetDutyCycle};
use embedded_io::Write as _;
use firmware_core::device::{EncoderCount, PositionSensor};

use crate::board::Serial;
use crate::plant_line::{Actuators, Body as _, FULL_DUTY, Receiver, Robot, Sensors};

/// A robot at the end of a line.
pub struct Plant {
    robot: Robot,
    duties: [Cell<u16>; 2],
    pins: Cell<u8>,
    /// What may be read in this tick.
    sensors: Cell<Option<Sensors>>,
    line: RefCell<Line>,
}

struct Line {
    serial: Serial,
    receiver: Receiver,
    heard: Option<Sensors>,
    /// Number of the last frame sent.
    tick: u32,
    /// That frame, and how much of it is on the way.
    out: ([u8; crate::plant_line::MAX_FRAME], usize),
    sent: usize,
    /// Ticks whose sensors did not come in time.
    missed: u32,
}

/// The robot has not answered.
#[derive(Clone, Copy, Debug)]
pub struct Silent;

impl Plant {
    /// All off, and the robot is told so.
    pub fn new(robot: Robot, serial: Serial) -> Self {
        let line = Line {
            serial,
            receiver: Receiver::new(),
            heard: None,
            tick: 0,
            out: Actuators { robot, tick: 0, duties: [0; 2], pins: 0 }.frame(),
            sent: 0,
            missed: 0,
        };
        Self {
            robot,
            duties: Default::default(),
            pins: Cell::new(0),
            sensors: Cell::new(None),
            line: RefCell::new(line),
        }
    }

    /// Receives what has arrived, and sends what the line takes now.
    pub fn exchange(&self) {
        let mut line = self.line.borrow_mut();
        let Line { serial, receiver, heard, out: (frame, length), sent, .. } = &mut *line;
        while let Some(byte) = serial.take() {
            *heard = receiver.push(byte).or(*heard);
        }
        let rest = frame.get(*sent..*length).unwrap_or(&[]);
        let Ok(count) = serial.write(rest);
        *sent += count;
    }

    /// A tick begins: of what has arrived only the answer to the last frame counts. Older sensors are those
    /// of another time.
    pub fn begin(&self) {
        let mut line = self.line.borrow_mut();
        let tick = line.tick;
        let of_now = |sensors: &Sensors| sensors.robot == self.robot && sensors.tick == tick;
        let sensors = line.heard.take().filter(of_now);
        line.missed = line.missed.saturating_add(u32::from(sensors.is_none()));
        self.sensors.set(sensors);
    }

    /// It has ended: what it has set is on its way.
    pub fn end(&self) {
        let mut line = self.line.borrow_mut();
        line.tick = line.tick.wrapping_add(1);
        let duties = [0, 1].map(|i| self.duties[i].get());
        let (robot, tick, pins) = (self.robot, line.tick, self.pins.get());
        line.out = Actuators { robot, tick, duties, pins }.frame();
        line.sent = 0;
    }

    /// Ticks so far whose sensors did not come in time.
    pub fn missed(&self) -> u32 {
        self.line.borrow().missed
    }

    /// A PWM channel.
    pub fn pwm(&self, channel: usize) -> Pwm<'_> {
        Pwm(&self.duties[channel])
    }

    /// An output.
    pub fn pin(&self, bit: u8) -> Pin<'_> {
        Pin(&self.pins, bit)
    }

    /// An encoder.
    pub fn encoder(&self, side: usize) -> Encoder<'_> {
        Encoder(&self.sensors, side)
    }

    /// The position sensor.
    pub fn position(&self) -> Position<'_> {
        Position { sensors: &self.sensors, age_us: 0 }
    }
}

/// A PWM channel.
pub struct Pwm<'p>(&'p Cell<u16>);

impl PwmErrorType for Pwm<'_> {
    type Error = Infallible;
}

impl SetDutyCycle for Pwm<'_> {
    fn max_duty_cycle(&self) -> u16 {
        FULL_DUTY
    }
    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        self.0.set(duty);
        Ok(())
    }
}

/// An output.
pub struct Pin<'p>(&'p Cell<u8>, u8);

impl PinErrorType for Pin<'_> {
    type Error = Infallible;
}

impl OutputPin for Pin<'_> {
    fn set_low(&mut self) -> Result<(), Infallible> {
        self.0.set(self.0.get() & !(1 << self.1));
        Ok(())
    }
    fn set_high(&mut self) -> Result<(), Infallible> {
        self.0.set(self.0.get() | 1 << self.1);
        Ok(())
    }
}

/// An encoder.
pub struct Encoder<'p>(&'p Cell<Option<Sensors>>, usize);

impl EncoderCount for Encoder<'_> {
    type Error = Silent;
    fn count(&mut self) -> Result<u16, Silent> {
        Ok(self.0.get().ok_or(Silent)?.counts[self.1])
    }
}

/// The position sensor.
pub struct Position<'p> {
    sensors: &'p Cell<Option<Sensors>>,
    age_us: u32,
}

impl<const N: usize> PositionSensor<N> for Position<'_> {
    type Error = Silent;

    fn measure(&mut self) -> Result<Option<[f32; N]>, Silent> {
        let position = self.sensors.get().ok_or(Silent)?.position;
        let Some((coordinates, age_us)) = position else { return Ok(None) };
        self.age_us = age_us;
        Ok(coordinates.first_chunk().copied())
    }

    fn age_us(&self) -> u32 {
        self.age_us
    }
}
