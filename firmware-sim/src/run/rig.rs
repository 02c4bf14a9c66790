//! A robot on its bench with the firmware that drives it.

use crate::bench::{RosbotBench, SoftLegBench};
use crate::fault::Faults;
use crate::faulty::{FaultyEncoder, FaultySensor};
use crate::mcu::position_sensor::MotionCaptureSettings;
use crate::mcu::{Board, VirtualClock};
use crate::rosbot::RosbotParameters;
use crate::soft_leg::SoftLegParameters;
use firmware_core::control_loop::rosbot::{Motor, RosbotSettings, Sides};
use firmware_core::control_loop::soft_leg::{Chamber, Pneumatics, SoftLegSettings};
use firmware_core::control_loop::telemetry::Telemetry;
use firmware_core::control_loop::{ControlLoop, ControlLoopError, Rosbot, SoftLeg};
use firmware_core::model::Model;

/// A robot and its microcontroller, without the firmware.
pub(crate) trait Rig<const N: usize> {
    /// Time between two ticks (µs).
    const TICK_US: u64;
    /// Ticks per sample of the model.
    const TICKS_PER_SAMPLE: u64;
    /// Samples that the firmware looks ahead.
    const AHEAD: usize;
    /// What a spike of intensity 1 adds.
    const SPIKE: [f32; N];
    /// Random commands stay within this, in the inputs' unit.
    const LIMIT: f64;

    fn new() -> Self;
    /// The firmware after a reset; `seed` is that of the sensor's noise.
    fn boot<'m, 'q>(
        &mut self,
        model: &'m Model<'m>,
        faults: &Faults,
        seed: u64,
        telemetry: Telemetry<'q>,
    ) -> Result<impl ControlLoop<2> + use<'m, 'q, Self, N>, ControlLoopError>;
    fn apply(&mut self, faults: &Faults);
    /// Lets time pass under held outputs.
    fn advance_us(&mut self, us: u64);
    fn board(&mut self) -> &mut Board;
    fn clock(&self) -> VirtualClock;
    /// The true coordinates. To be asked before a measurement: the position sensor sees them from now on.
    fn truth(&mut self) -> [f64; N];
    /// Whether nothing is driven.
    fn is_off(&self) -> bool;
}

impl Rig<3> for RosbotBench {
    const TICK_US: u64 = 10_000;
    const TICKS_PER_SAMPLE: u64 = 10;
    const AHEAD: usize = 10;
    /// m, m, rad.
    const SPIKE: [f32; 3] = [1.0, 1.0, 1.0];
    const LIMIT: f64 = 16.0;

    fn new() -> Self {
        Self::new(RosbotParameters::default()).expect("the default robot can be")
    }

    fn boot<'m, 'q>(
        &mut self,
        model: &'m Model<'m>,
        faults: &Faults,
        seed: u64,
        telemetry: Telemetry<'q>,
    ) -> Result<impl ControlLoop<2> + use<'m, 'q>, ControlLoopError> {
        let devices = self.devices(MotionCaptureSettings::POSE, seed);
        let devices = devices.expect("a reset frees all devices");
        let [pwm_right, pwm_left] = devices.pwm;
        let [direction_right, direction_left] = devices.direction;
        let [right, left] = devices.encoders;
        let sides = Sides {
            right: Motor::new(pwm_right, direction_right),
            left: Motor::new(pwm_left, direction_left),
        };
        let encoders = (FaultyEncoder::new(right, faults, 0), FaultyEncoder::new(left, faults, 1));
        let pose = FaultySensor::new(devices.pose, faults, Self::SPIKE);
        let settings = RosbotSettings::default();
        Rosbot::<_, _, _, { Self::AHEAD }>::new(model, (sides, encoders, pose), settings, telemetry)
    }

    fn apply(&mut self, faults: &Faults) {
        // Wheels are counted at every tick.
        self.catch_up();
        self.apply(faults);
    }
    fn advance_us(&mut self, us: u64) {
        self.pass_us(us);
    }
    fn board(&mut self) -> &mut Board {
        self.board()
    }
    fn clock(&self) -> VirtualClock {
        self.clock().clone()
    }
    fn truth(&mut self) -> [f64; 3] {
        self.motion().pose
    }
    fn is_off(&self) -> bool {
        self.is_off()
    }
}

impl Rig<2> for SoftLegBench {
    const TICK_US: u64 = 2_000;
    const TICKS_PER_SAMPLE: u64 = 25;
    const AHEAD: usize = 20;
    /// mm.
    const SPIKE: [f32; 2] = [30.0, 30.0];
    const LIMIT: f64 = 12.0;

    fn new() -> Self {
        Self::new(SoftLegParameters::default()).expect("the default leg can be")
    }

    fn boot<'m, 'q>(
        &mut self,
        model: &'m Model<'m>,
        faults: &Faults,
        seed: u64,
        telemetry: Telemetry<'q>,
    ) -> Result<impl ControlLoop<2> + use<'m, 'q>, ControlLoopError> {
        let devices = self.devices(MotionCaptureSettings::TIP, seed);
        let devices = devices.expect("a reset frees all devices");
        let [bending, extension] = devices.valves;
        let [bending_line, extension_line] = devices.lines;
        let [input_pump, exhaust_pump] = devices.pumps;
        let pneumatics = Pneumatics {
            bending: Chamber::new(bending, bending_line),
            extension: Chamber::new(extension, extension_line),
            input_pump,
            exhaust_pump,
        };
        let tip = FaultySensor::new(devices.tip, faults, Self::SPIKE);
        let settings = SoftLegSettings::default();
        SoftLeg::<_, _, { Self::AHEAD }>::new(model, pneumatics, tip, settings, telemetry)
    }

    fn apply(&mut self, faults: &Faults) {
        self.apply(faults);
    }
    fn advance_us(&mut self, us: u64) {
        // A leg has nothing that is measured between two samples.
        self.pass_us(us);
    }
    fn board(&mut self) -> &mut Board {
        self.board()
    }
    fn clock(&self) -> VirtualClock {
        self.clock().clone()
    }
    fn truth(&mut self) -> [f64; 2] {
        self.catch_up();
        self.tip_mm()
    }
    fn is_off(&self) -> bool {
        self.is_off()
    }
}
