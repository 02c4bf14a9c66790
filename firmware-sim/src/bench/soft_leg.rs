//! The soft leg: two valves, two pumps, and a camera on the tip.
//!
//! | device | where |
//! |---|---|
//! | valves bending, extension | timer 3, channels 1 and 2, 18 kHz: voltage \|u\| = share of full duty × 12 V |
//! | lines bending, extension | pins `line_bending`, `line_extension`: high is pressure, low vacuum |
//! | pumps input, exhaust | pins `pump_input`, `pump_exhaust`: high runs |
//! | tip | motion capture of y (mm), z (mm) |
//!
//! With both pumps running, the leg moves exactly as [`SoftLeg::step`](crate::Plant::step) says for
//! the signed voltages: + on the pressure line, − on the vacuum line.

use crate::fault::{FaultKind, Faults};
use crate::mcu::board::ClaimError;
use crate::mcu::position_sensor::MotionCaptureSettings;
use crate::mcu::{Board, MotionCapture, Pin, Pwm, VirtualClock, Wire};
use crate::plant::Plant;
use crate::soft_leg::{SoftLeg, SoftLegError, SoftLegParameters, Surroundings};
use std::num::NonZeroU32;

/// Frequency of the valves' PWM (Hz).
pub const PWM_HZ: u32 = 18_000;
/// Voltage of a valve at full duty (V).
pub const SUPPLY_VOLT: f64 = 12.0;
/// Longest step of the plant (ns): four of them in 50 ms keep the error of RK4 below a fifth of the
/// sensor's noise; two would come up to it.
const STEP_NS: u64 = 12_500_000;
/// A valve that sticks with some probability does so, or does not, for so long (µs).
const STICKS_US: u64 = 50_000;
const TIMER: u8 = 3;
const LINE_PINS: [&str; 2] = ["line_bending", "line_extension"];
const PUMP_PINS: [&str; 2] = ["pump_input", "pump_exhaust"];

/// What the firmware of a soft leg gets; chambers are ordered bending, extension.
#[derive(Debug)]
pub struct SoftLegDevices {
    /// Duty of the valves.
    pub valves: [Pwm; 2],
    /// Lines that the valves open to: high is pressure, low vacuum. They may be switched at any time.
    pub lines: [Pin; 2],
    /// The input pump (pressure) and the exhaust pump (vacuum): high runs.
    pub pumps: [Pin; 2],
    /// y (mm), z (mm).
    pub tip: MotionCapture<2>,
}

/// What a valve does when it does not do as it is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StuckValve {
    /// It keeps the opening that it has.
    AsItIs,
    /// It is open this far, from 0 to 1, to whatever line is selected.
    At(f64),
}

/// What acts on the plant: outputs and faults.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Acting {
    volts: [f64; 2],
    pressure: [bool; 2],
    pumps: [bool; 2],
    stuck: [Option<StuckValve>; 2],
    leaks: [f64; 2],
    pump_strength: [f64; 2],
}

/// A soft leg, idle, on its board.
///
/// ```
/// use embedded_hal::{digital::OutputPin, pwm::SetDutyCycle};
/// use firmware_sim::bench::SoftLegBench;
/// use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
///
/// let mut bench = SoftLegBench::new(Default::default())?;
/// let mut devices = bench.devices(MotionCaptureSettings::TIP, 1)?;
/// devices.pumps[0].set_high()?;
/// devices.lines[0].set_high()?;
/// devices.valves[0].set_duty_cycle(2333)?; // half of 4666: 6 V
/// bench.advance_us(1_000_000);
/// let [y, z] = bench.tip_mm();
/// assert!((y - 24.82).abs() < 0.01 && (z - 6.82).abs() < 0.01);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct SoftLegBench {
    /// Valves that are stuck, by chamber; `None` but for a fault.
    pub stuck: [Option<StuckValve>; 2],
    /// By how much faster than usual the chambers leak; 1 but for a fault.
    pub leaks: [f64; 2],
    /// Shares of their pressure that the input and the exhaust pump reach; 1 but for a fault.
    pub pump_strength: [f64; 2],
    /// Share of the supply voltage that the valves miss, from 0 to 1; 0 but for a fault.
    pub sag: f64,
    plant: SoftLeg,
    board: Board,
    clock: VirtualClock,
    /// How far the plant has come (ns), and what has acted on it since.
    plant_ns: u64,
    acting: Acting,
    /// When it is drawn next whether valves stick (µs).
    draw_us: u64,
    valves: [Wire<f64>; 2],
    pressure: [Wire<bool>; 2],
    pumps: [Wire<bool>; 2],
    tip: Wire<[f64; 2]>,
}

impl SoftLegBench {
    /// A bench with a new clock at 0.
    ///
    /// # Errors
    ///
    /// [`SoftLegError::OutOfRange`] for a parameter with which the equations make no sense.
    pub fn new(parameters: SoftLegParameters) -> Result<Self, SoftLegError> {
        let plant = SoftLeg::new(parameters, NonZeroU32::MIN)?;
        let clock = VirtualClock::new();
        let mut board = Board::new(&clock);
        Ok(Self {
            stuck: [None; 2],
            leaks: [1.0; 2],
            pump_strength: [1.0; 2],
            sag: 0.0,
            plant,
            plant_ns: 0,
            acting: Acting {
                volts: [0.0; 2],
                pressure: [false; 2],
                pumps: [false; 2],
                stuck: [None; 2],
                leaks: [1.0; 2],
                pump_strength: [1.0; 2],
            },
            draw_us: 0,
            valves: [1, 2].map(|channel| board.pwm_wire(TIMER, channel)),
            pressure: LINE_PINS.map(|pin| board.pin_wire(pin)),
            pumps: PUMP_PINS.map(|pin| board.pin_wire(pin)),
            tip: Wire::new([0.0; 2]),
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
        tip: MotionCaptureSettings<2>,
        seed: u64,
    ) -> Result<SoftLegDevices, ClaimError> {
        let board = &mut self.board;
        Ok(SoftLegDevices {
            valves: [board.pwm(TIMER, 1, PWM_HZ)?, board.pwm(TIMER, 2, PWM_HZ)?],
            lines: [board.pin(LINE_PINS[0])?, board.pin(LINE_PINS[1])?],
            pumps: [board.pin(PUMP_PINS[0])?, board.pin(PUMP_PINS[1])?],
            tip: MotionCapture::new(&self.tip, &self.clock, tip, seed),
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

    /// The true tip y, z (mm).
    pub fn tip_mm(&self) -> [f64; 2] {
        self.plant.observe()
    }

    /// The true gauge pressures of the chambers (kPa).
    pub fn pressures_kpa(&self) -> [f64; 2] {
        self.plant.pressures_kpa()
    }

    /// The true signed openings of the valves, from −1 to 1: above 0 towards the pressure line.
    pub fn openings(&self) -> [f64; 2] {
        self.plant.openings()
    }

    /// The signed voltages now (V): on the valve's coil, − for the vacuum line.
    pub fn volts(&self) -> [f64; 2] {
        let supply = SUPPLY_VOLT * (1.0 - self.sag);
        std::array::from_fn(|chamber| {
            let volt = self.valves[chamber].get() * supply;
            if self.pressure[chamber].get() { volt } else { -volt }
        })
    }

    /// Whether the firmware drives nothing: valves without duty, pumps off.
    pub fn is_off(&self) -> bool {
        self.valves.iter().all(|duty| duty.get() == 0.0) && !self.pumps.iter().any(Wire::get)
    }

    /// Sets valves, leaks, pumps and sag to what the faults say now; call it once per tick.
    pub fn apply(&mut self, faults: &Faults) {
        let now_us = self.clock.now_ns() / 1000;
        let draws = now_us >= self.draw_us;
        if draws {
            self.draw_us = (now_us / STICKS_US + 1).saturating_mul(STICKS_US);
        }
        for unit in 0..2 {
            let act = |kind| faults.act(kind, Some(unit));
            let sticks = if draws {
                faults.strikes(FaultKind::StuckValve, Some(unit))
            } else {
                self.stuck[unit] == Some(StuckValve::AsItIs)
                    && faults.is_active(FaultKind::StuckValve, Some(unit))
            };
            self.stuck[unit] = if sticks {
                Some(StuckValve::AsItIs)
            } else {
                act(FaultKind::OpenValve).map(StuckValve::At)
            };
            self.leaks[unit] = 1.0 + 99.0 * act(FaultKind::Leak).unwrap_or(0.0);
            self.pump_strength[unit] = 1.0 - act(FaultKind::Pump).unwrap_or(0.0);
        }
        self.sag = faults.act(FaultKind::Sag, None).unwrap_or(0.0);
    }

    /// Lets `us` microseconds pass, and the plant catch up with the clock, under held outputs.
    pub fn advance_us(&mut self, us: u64) {
        self.pass_us(us);
        self.catch_up();
    }

    /// Lets `us` microseconds pass under held outputs. The plant waits: sensors and whoever looks at it see
    /// it where it was when it caught up last.
    pub fn pass_us(&mut self, us: u64) {
        self.notice();
        self.clock.advance_us(us);
    }

    /// The plant catches up with the clock, in as few steps as can be: however often time passed under the
    /// same outputs, it comes to the same.
    pub fn catch_up(&mut self) {
        let now_ns = self.clock.now_ns();
        if self.plant_ns == now_ns {
            return;
        }
        let Acting { volts, pressure, pumps, stuck, leaks, pump_strength } = self.acting;
        let at = self.plant.openings();
        let openings = std::array::from_fn(|chamber| {
            let line = if pressure[chamber] { 1.0 } else { -1.0 };
            match stuck[chamber] {
                None => self.plant.opening(volts[chamber]),
                Some(StuckValve::AsItIs) => at[chamber],
                Some(StuckValve::At(opening)) => opening * line,
            }
        });
        let sources = std::array::from_fn(|pump| pumps[pump].then_some(pump_strength[pump]));
        let around = Surroundings { sources, leaks };
        while self.plant_ns < now_ns {
            let step_ns = (now_ns - self.plant_ns).min(STEP_NS);
            self.plant.step_towards(openings, &around, step_ns as f64 * 1e-9);
            self.plant_ns += step_ns;
        }
        self.tip.set(self.plant.observe());
    }

    /// What has been set acts from now on; up to now it was what acted before.
    fn notice(&mut self) {
        let acting = Acting {
            volts: self.volts(),
            pressure: self.pressure.each_ref().map(Wire::get),
            pumps: self.pumps.each_ref().map(Wire::get),
            stuck: self.stuck,
            leaks: self.leaks,
            pump_strength: self.pump_strength,
        };
        if acting != self.acting {
            self.catch_up();
            self.acting = acting;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mcu::board::ResetCause;
    use embedded_hal::digital::OutputPin;
    use embedded_hal::pwm::SetDutyCycle;
    use firmware_core::device::PositionSensor;
    use proptest::prelude::*;

    const SAMPLE_US: u64 = 50_000;

    fn bench() -> (SoftLegBench, SoftLegDevices) {
        let mut bench = SoftLegBench::new(SoftLegParameters::default()).unwrap();
        let settings = MotionCaptureSettings::exact(SAMPLE_US.try_into().unwrap());
        let devices = bench.devices(settings, 1).unwrap();
        (bench, devices)
    }

    fn running() -> (SoftLegBench, SoftLegDevices) {
        let (bench, mut devices) = bench();
        devices.pumps.iter_mut().for_each(|pump| pump.set_high().unwrap());
        (bench, devices)
    }

    /// Signed duties, from −4666 to 4666, for so many samples.
    fn hold(
        (bench, devices): &mut (SoftLegBench, SoftLegDevices),
        duties: [i16; 2],
        samples: usize,
    ) {
        for (chamber, duty) in duties.into_iter().enumerate() {
            devices.lines[chamber].set_state((duty > 0).into()).unwrap();
            devices.valves[chamber].set_duty_cycle(duty.unsigned_abs()).unwrap();
        }
        (0..samples).for_each(|_| bench.advance_us(SAMPLE_US));
    }

    fn plant(substeps: u32) -> SoftLeg {
        SoftLeg::new(SoftLegParameters::default(), NonZeroU32::new(substeps).unwrap()).unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn moves_exactly_as_the_plant_under_signed_voltages(
            inputs in prop::collection::vec((-4666..=4666_i16, -4666..=4666_i16, 1..20_usize), 1..20),
        ) {
            let mut on_bench = running();
            let mut alone = plant(4);
            for (bend, extend, samples) in inputs {
                hold(&mut on_bench, [bend, extend], samples);
                let volts = [bend, extend].map(|duty| f64::from(duty) / 4666.0 * 12.0);
                (0..samples).for_each(|_| alone.step(&volts, 0.05));
                prop_assert_eq!(on_bench.0.tip_mm(), alone.observe());
            }
        }

        #[test]
        fn four_steps_in_50_ms_are_converged_to_the_sensor(
            inputs in prop::collection::vec((-12.0..=12.0, -12.0..=12.0, 1..20_usize), 1..20),
        ) {
            let (mut coarse, mut fine) = (plant(4), plant(40));
            for (bend, extend, samples) in inputs {
                for _ in 0..samples {
                    coarse.step(&[bend, extend], 0.05);
                    fine.step(&[bend, extend], 0.05);
                    let (coarse, fine) = (coarse.observe(), fine.observe());
                    // A fifth of the 0.1 mm of measurement noise.
                    prop_assert!((0..2).all(|i| (coarse[i] - fine[i]).abs() < 0.02));
                }
            }
        }
    }

    #[test]
    fn without_pumps_nothing_moves() {
        let mut leg = bench();
        hold(&mut leg, [4666, -4666], 20);
        assert_eq!(leg.0.tip_mm(), [0.0, 0.0]);
        // The input pump alone serves the pressure line alone.
        leg.1.pumps[0].set_high().unwrap();
        hold(&mut leg, [4666, -4666], 20);
        let [bending, extension] = leg.0.pressures_kpa();
        assert!(bending > 50.0 && extension == 0.0, "{bending} {extension}");
        let measured = leg.1.tip.measure().unwrap().unwrap();
        assert_eq!(measured, leg.0.tip_mm().map(|value| value as f32));
    }

    #[test]
    fn a_stuck_valve_does_not_follow() {
        let mut leg = running();
        hold(&mut leg, [2333, 2333], 40);
        let stuck_at = leg.0.openings()[0];
        leg.0.stuck = [Some(StuckValve::AsItIs), Some(StuckValve::At(0.5))];
        hold(&mut leg, [0, 0], 40);
        let [bending, extension] = leg.0.openings();
        assert_eq!(bending, stuck_at);
        assert!((extension + 0.5).abs() < 1e-9, "open to the vacuum line: {extension}");
    }

    #[test]
    fn leaks_and_weak_pumps_cost_pressure() {
        let settled = |change: fn(&mut SoftLegBench)| {
            let mut leg = running();
            change(&mut leg.0);
            hold(&mut leg, [2333, -2333], 400);
            leg.0.pressures_kpa()
        };
        let [bending, extension] = settled(|_| ());
        assert!(bending > 57.0 && extension < -28.0, "{bending} {extension}");
        let [leaking, _] = settled(|bench| bench.leaks[0] = 30.0);
        assert!(leaking < 0.7 * bending, "{leaking}");
        let [_, weak] = settled(|bench| bench.pump_strength[1] = 0.5);
        assert!((weak / extension - 0.5).abs() < 0.02, "{weak}");
    }

    #[test]
    fn faults_reach_the_plant() {
        let (mut bench, _) = bench();
        let faults = [
            "stuck-valve:0@0..1=1",
            "open-valve:1@0..1=0.3",
            "leak:1@0..1=0.5",
            "pump:0@0..1=0.25",
            "sag@0..1=0.1",
        ];
        let faults = Faults::new(bench.clock(), faults.map(|text| text.parse().unwrap()), 1);
        bench.apply(&faults);
        assert_eq!(bench.stuck, [Some(StuckValve::AsItIs), Some(StuckValve::At(0.3))]);
        assert_eq!((bench.leaks, bench.pump_strength), ([1.0, 50.5], [0.75, 1.0]));
        assert_eq!(bench.volts(), [-0.0, -0.0]);
        assert_eq!(bench.sag, 0.1);
        assert!(faults.injections().all(|(_, times)| times == 1));
        bench.advance_us(1_000_000);
        bench.apply(&faults);
        assert_eq!((bench.stuck, bench.leaks), ([None; 2], [1.0; 2]));
        assert_eq!((bench.pump_strength, bench.sag), ([1.0; 2], 0.0));
    }

    #[test]
    fn it_comes_to_the_same_however_often_time_passes() {
        let mut legs = [running(), running()];
        let mut ends = [[0.0; 2]; 2];
        for (step_us, ((bench, devices), end)) in
            [50_000, 2_000].into_iter().zip(legs.iter_mut().zip(&mut ends))
        {
            for sample in 0..40_u16 {
                // Held, changed, and closed in the middle of a sample.
                devices.valves[0].set_duty_cycle(sample / 3 * 300).unwrap();
                devices.lines[0].set_state((sample % 6 < 3).into()).unwrap();
                for part_us in [20_000, 30_000] {
                    for _ in 0..part_us / step_us.min(part_us) {
                        bench.pass_us(step_us.min(part_us));
                    }
                    if sample % 7 == 0 {
                        devices.valves[0].set_duty_cycle(0).unwrap();
                    }
                }
                bench.catch_up();
            }
            *end = bench.tip_mm();
        }
        assert_eq!(ends[0], ends[1]);
        assert!(ends[0][0].abs() > 1.0, "{ends:?}");
    }

    #[test]
    fn a_valve_sticks_or_not_for_a_while_and_no_longer_than_its_fault() {
        let (mut bench, _) = bench();
        let faults = ["stuck-valve:0@0..10=0.5", "stuck-valve:1@0..0.01=1"];
        let faults = Faults::new(bench.clock(), faults.map(|text| text.parse().unwrap()), 1);
        let (mut changes, mut last) = (0, None);
        for tick in 0..5_000 {
            bench.apply(&faults);
            if bench.stuck[0] != last {
                assert_eq!(tick % 25, 0);
                (changes, last) = (changes + 1, bench.stuck[0]);
            }
            assert_eq!(bench.stuck[1].is_some(), tick < 5);
            bench.advance_us(2_000);
        }
        // Two hundred draws; four standard deviations of half of them.
        assert!((70..130).contains(&changes), "{changes}");
        let times = faults.injections().map(|(_, times)| times).collect::<Vec<_>>();
        assert!((72..128).contains(&times[0]) && times[1] == 1, "{times:?}");
    }

    #[test]
    fn it_is_off_when_nothing_is_driven_whatever_the_supply() {
        let (mut bench, mut devices) = bench();
        bench.sag = 1.0;
        assert!(bench.is_off());
        devices.pumps[1].set_high().unwrap();
        assert!(!bench.is_off());
        devices.pumps[1].set_low().unwrap();
        devices.valves[0].set_duty_cycle(1).unwrap();
        assert!(!bench.is_off() && bench.volts() == [0.0; 2]);
    }

    #[test]
    fn a_reset_shuts_everything() {
        let mut leg = running();
        hold(&mut leg, [4666, 4666], 20);
        leg.0.board().reset(ResetCause::BrownOut);
        assert_eq!(leg.0.volts(), [0.0, 0.0]);
        let before = leg.0.pressures_kpa()[0];
        (0..200).for_each(|_| leg.0.advance_us(SAMPLE_US));
        // The 10 s of the leak.
        assert!((leg.0.pressures_kpa()[0] / before - libm::exp(-1.0)).abs() < 0.01);
    }
}
