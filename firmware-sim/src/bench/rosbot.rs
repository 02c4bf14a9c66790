//! The ROSbot: two motor drivers, two encoders, and motion capture.
//!
//! | device | where |
//! |---|---|
//! | PWM right, left | timer 3, channels 1 and 2, 18 kHz: voltage = share of full duty × supply |
//! | direction right, left | pins `dir_right`, `dir_left`: high is backwards |
//! | encoders right, left | 1632 counts per turn, as [`RosbotParameters`] say |
//! | pose | motion capture of x (m), y (m), φ (rad) |
//!
//! A direction pin is low after a reset, so that the robot's usual direction needs no setting up.

use crate::fault::{FaultKind, Faults};
use crate::mcu::board::ClaimError;
use crate::mcu::position_sensor::MotionCaptureSettings;
use crate::mcu::{Board, Encoder, MotionCapture, Pin, Pwm, VirtualClock, Wire};
use crate::rosbot::{RosbotError, RosbotParameters};
use crate::skid_steer::{Motion, SkidSteer};

/// Frequency of the motors' PWM (Hz), that of the ROSbot's own firmware.
pub const PWM_HZ: u32 = 18_000;
/// Longest step of the plant (ns), the one for which [`SkidSteer`] promises its accuracy.
const STEP_NS: u64 = 10_000_000;
const TIMER: u8 = 3;
const DIRECTION_PINS: [&str; 2] = ["dir_right", "dir_left"];

/// What the firmware of a ROSbot gets; sides are ordered right, left.
#[derive(Debug)]
pub struct RosbotDevices {
    /// Duty of the motors.
    pub pwm: [Pwm; 2],
    /// Directions of the motors: low is forwards.
    pub direction: [Pin; 2],
    /// Counters of the wheels.
    pub encoders: [Encoder; 2],
    /// x (m), y (m), φ (rad).
    pub pose: MotionCapture<3>,
}

/// A ROSbot at rest at the origin, on its board.
///
/// ```
/// use embedded_hal::pwm::SetDutyCycle;
/// use firmware_core::device::EncoderCount;
/// use firmware_sim::bench::RosbotBench;
/// use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
///
/// let mut bench = RosbotBench::new(Default::default())?;
/// let mut devices = bench.devices(MotionCaptureSettings::POSE, 1)?;
/// for pwm in &mut devices.pwm {
///     pwm.set_duty_cycle(2333)?; // half of 4666: 6 V
/// }
/// for _ in 0..200 {
///     bench.advance_us(10_000);
/// }
/// assert!((bench.motion().wheels[0].speed_radps - 11.379).abs() < 1e-3);
/// assert_eq!(devices.encoders[0].count()?, 5685);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct RosbotBench {
    /// Share of its ground speed that each side loses, from 0 to 1; 0 but for a fault.
    pub slip: [f64; 2],
    /// Share of the supply voltage that is missing, from 0 to 1; 0 but for a fault.
    pub sag: f64,
    plant: SkidSteer,
    board: Board,
    clock: VirtualClock,
    /// How far the plant has come (ns), and the voltages and slip that have acted on it since.
    plant_ns: u64,
    acting: [[f64; 2]; 2],
    pwm: [Wire<f64>; 2],
    backwards: [Wire<bool>; 2],
    angle_rad: [Wire<f64>; 2],
    pose: Wire<[f64; 3]>,
}

impl RosbotBench {
    /// A bench with a new clock at 0.
    ///
    /// # Errors
    ///
    /// [`RosbotError::OutOfRange`] for a parameter with which the equations make no sense.
    pub fn new(parameters: RosbotParameters) -> Result<Self, RosbotError> {
        let plant = SkidSteer::new(parameters)?;
        let clock = VirtualClock::new();
        let mut board = Board::new(&clock);
        Ok(Self {
            slip: [0.0; 2],
            sag: 0.0,
            plant,
            plant_ns: 0,
            acting: [[0.0; 2]; 2],
            pwm: [1, 2].map(|channel| board.pwm_wire(TIMER, channel)),
            backwards: DIRECTION_PINS.map(|pin| board.pin_wire(pin)),
            angle_rad: Default::default(),
            pose: Wire::new([0.0; 3]),
            board,
            clock,
        })
    }

    /// Claims all devices, as the firmware does after every reset. `seed` is that of the sensor's
    /// noise.
    ///
    /// # Errors
    ///
    /// [`ClaimError`] if something has an owner already.
    pub fn devices(
        &mut self,
        pose: MotionCaptureSettings<3>,
        seed: u64,
    ) -> Result<RosbotDevices, ClaimError> {
        let pwm = [self.board.pwm(TIMER, 1, PWM_HZ)?, self.board.pwm(TIMER, 2, PWM_HZ)?];
        let [right, left] = DIRECTION_PINS;
        let direction =
            [self.board.direction_pin(right, &pwm[0])?, self.board.direction_pin(left, &pwm[1])?];
        let counts_per_turn = self.plant.parameters().counts_per_turn;
        Ok(RosbotDevices {
            pwm,
            direction,
            encoders: self.angle_rad.each_ref().map(|angle| Encoder::new(angle, counts_per_turn)),
            pose: MotionCapture::new(&self.pose, &self.clock, pose, seed),
        })
    }

    /// The board, for its clock, its misuse and its resets.
    pub fn board(&mut self) -> &mut Board {
        &mut self.board
    }

    /// The clock that the bench advances.
    pub fn clock(&self) -> &VirtualClock {
        &self.clock
    }

    /// The true motion: pose, wheel speeds and angles, ground speeds.
    pub fn motion(&self) -> &Motion {
        self.plant.motion()
    }

    /// The voltages on the motors now (V).
    pub fn volts(&self) -> [f64; 2] {
        let supply = self.plant.parameters().supply_volt * (1.0 - self.sag);
        std::array::from_fn(|side| {
            let volt = self.pwm[side].get() * supply;
            if self.backwards[side].get() { -volt } else { volt }
        })
    }

    /// Whether the firmware drives nothing: motors without duty.
    pub fn is_off(&self) -> bool {
        self.pwm.iter().all(|duty| duty.get() == 0.0)
    }

    /// Sets slip and sag to what the faults say now; call it once per tick.
    pub fn apply(&mut self, faults: &Faults) {
        self.slip = [0, 1].map(|side| faults.act(FaultKind::Slip, Some(side)).unwrap_or(0.0));
        self.sag = faults.act(FaultKind::Sag, None).unwrap_or(0.0);
    }

    /// Lets `us` microseconds pass, and the plant catch up with the clock, under held outputs.
    pub fn advance_us(&mut self, us: u64) {
        self.pass_us(us);
        self.catch_up();
    }

    /// Lets `us` microseconds pass under held outputs. The plant waits: encoders, sensors and whoever looks at
    /// it see it where it was when it caught up last.
    pub fn pass_us(&mut self, us: u64) {
        // What has been set acts from now on; up to now it was what acted before.
        let acting = [self.volts(), self.slip];
        if acting != self.acting {
            self.catch_up();
            self.acting = acting;
        }
        self.clock.advance_us(us);
    }

    /// The plant catches up with the clock, in as few steps as can be: however often time passed under the
    /// same outputs, it comes to the same.
    pub fn catch_up(&mut self) {
        let now_ns = self.clock.now_ns();
        let [volts, slip] = self.acting;
        while self.plant_ns < now_ns {
            let step_ns = (now_ns - self.plant_ns).min(STEP_NS);
            self.plant.step(volts, slip, step_ns as f64 * 1e-9);
            self.plant_ns += step_ns;
        }
        let motion = self.plant.motion();
        for (wire, wheel) in self.angle_rad.iter().zip(motion.wheels) {
            wire.set(wheel.angle_rad);
        }
        self.pose.set(motion.pose);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mcu::board::ResetCause;
    use embedded_hal::digital::OutputPin;
    use embedded_hal::pwm::SetDutyCycle;
    use firmware_core::device::{EncoderCount, PositionSensor};

    fn bench() -> (RosbotBench, RosbotDevices) {
        let mut bench = RosbotBench::new(RosbotParameters::default()).unwrap();
        let settings = MotionCaptureSettings::exact(100_000.try_into().unwrap());
        let devices = bench.devices(settings, 1).unwrap();
        (bench, devices)
    }

    fn full_ahead(devices: &mut RosbotDevices) {
        devices.pwm.iter_mut().for_each(|pwm| pwm.set_duty_cycle_fully_on().unwrap());
    }

    fn advance(bench: &mut RosbotBench, ticks: u32) {
        (0..ticks).for_each(|_| bench.advance_us(10_000));
    }

    #[test]
    fn wires_lead_where_they_say() {
        let (mut bench, mut devices) = bench();
        devices.direction[0].set_high().unwrap();
        devices.pwm[0].set_duty_cycle(1000).unwrap();
        devices.pwm[1].set_duty_cycle_fully_on().unwrap();
        assert_eq!(bench.volts(), [-1000.0 / 4666.0 * 12.0, 12.0]);
        advance(&mut bench, 30);
        let motion = *bench.motion();
        assert!(motion.wheels[0].speed_radps < 0.0 && motion.wheels[1].speed_radps > 0.0);
        assert!(motion.pose[2] < 0.0, "right wheels backwards turn it clockwise");
        let counts = devices.encoders.each_mut().map(|encoder| encoder.count().unwrap() as i16);
        for (count, wheel) in counts.into_iter().zip(motion.wheels) {
            let exact = wheel.angle_rad / std::f64::consts::TAU * 1632.0;
            assert!((f64::from(count) - exact).abs() <= 0.5);
        }
        let pose = devices.pose.measure().unwrap().unwrap();
        assert_eq!(pose, motion.pose.map(|value| value as f32));
        assert_eq!(devices.pose.measure().unwrap(), None);
        assert_eq!(bench.board().misuse(), None);
    }

    #[test]
    fn moves_as_the_plant_alone_under_the_same_voltages() {
        let (mut bench, mut devices) = bench();
        let mut alone = SkidSteer::new(RosbotParameters::default()).unwrap();
        for tick in 0..300 {
            let duty = [(tick * 37) % 4667, (tick * 91) % 4667];
            for (pwm, duty) in devices.pwm.iter_mut().zip(duty) {
                pwm.set_duty_cycle(duty).unwrap();
            }
            bench.advance_us(10_000);
            alone.step(duty.map(|duty| f64::from(duty) / 4666.0 * 12.0), [0.0; 2], 0.01);
        }
        assert_eq!(bench.motion(), alone.motion());
    }

    #[test]
    fn a_sagging_supply_slows_the_wheels() {
        let (mut bench, mut devices) = bench();
        full_ahead(&mut devices);
        bench.sag = 0.25;
        advance(&mut bench, 200);
        // (9 V − 0.6 V) · 2.2 / 1.044.
        assert!((bench.motion().wheels[0].speed_radps - 17.701).abs() < 1e-3);
    }

    #[test]
    fn faults_reach_the_plant() {
        let (mut bench, _) = bench();
        let faults = ["slip:1@0..1=0.5".parse().unwrap(), "sag@0..1=0.25".parse().unwrap()];
        let faults = Faults::new(bench.clock(), faults, 1);
        bench.apply(&faults);
        assert_eq!((bench.slip, bench.sag), ([0.0, 0.5], 0.25));
        bench.advance_us(1_000_000);
        bench.apply(&faults);
        assert_eq!((bench.slip, bench.sag), ([0.0, 0.0], 0.0));
        assert_eq!([FaultKind::Slip, FaultKind::Sag].map(|kind| faults.injected(kind)), [1, 1]);
    }

    #[test]
    fn a_reset_coasts_to_a_stop_and_the_firmware_starts_anew() {
        let (mut bench, mut devices) = bench();
        full_ahead(&mut devices);
        advance(&mut bench, 50);
        bench.board().reset(ResetCause::BrownOut);
        advance(&mut bench, 100);
        assert_eq!(bench.motion().wheels.map(|wheel| wheel.speed_radps), [0.0; 2]);
        drop(devices);
        assert!(bench.devices(MotionCaptureSettings::POSE, 1).is_ok());
        assert!(bench.devices(MotionCaptureSettings::POSE, 1).is_err());
        assert_eq!(bench.board().misuse().unwrap().count, 1);
    }

    #[test]
    fn it_comes_to_the_same_however_often_time_passes() {
        let (mut bench, mut devices) = bench();
        let (mut other, mut others) = self::bench();
        for tick in 0..100_u16 {
            devices.pwm[0].set_duty_cycle(tick * 40).unwrap();
            others.pwm[0].set_duty_cycle(tick * 40).unwrap();
            bench.advance_us(10_000);
            [17, 983, 9_000].into_iter().for_each(|us| other.pass_us(us));
            other.catch_up();
            assert_eq!(bench.motion(), other.motion());
        }
        assert!(bench.motion().pose[2] > 0.1);
    }

    #[test]
    fn catches_up_with_a_clock_that_ran_on() {
        let (mut bench, mut devices) = bench();
        let (mut other, mut others) = self::bench();
        devices.pwm[0].set_duty_cycle_fully_on().unwrap();
        others.pwm[0].set_duty_cycle_fully_on().unwrap();
        bench.advance_us(0);
        bench.clock().advance_us(1_000_000);
        bench.advance_us(0);
        advance(&mut other, 100);
        assert_eq!(bench.motion(), other.motion());
    }
}
