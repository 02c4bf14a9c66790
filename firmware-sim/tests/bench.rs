//! Whole runs on a bench: host, line, firmware, plant and faults in virtual time.

use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;
use embedded_io::{Read, ReadReady, Write};
use firmware_core::device::{EncoderCount, PositionSensor};
use firmware_sim::bench::rosbot::RosbotDevices;
use firmware_sim::bench::{RosbotBench, SoftLegBench};
use firmware_sim::fault::{FaultKind, Faults};
use firmware_sim::faulty::{FaultyEncoder, FaultyHost, FaultySensor};
use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
use firmware_sim::mcu::{BrownOutDetector, Wire, uart};

const TICK_US: u64 = 10_000;
const FAULTS: [&str; 12] = [
    "dropout@0..10=0.2",
    "nan@0..10=0.1",
    "freeze@0..10=0.1",
    "spike@0..10=1",
    "delay@2..3=0.05",
    "missed-counts:1@0..10=0.1",
    "wrap@0..10=0.999",
    "slip:0@1..2=0.5",
    "sag@2..4=0.2",
    "late-tick@0..10=0.3",
    "silence@5..6=0.5",
    "brown-out@7..7.5=0.4",
];

/// What the firmware saw and where the robot ended up.
#[derive(Debug, PartialEq)]
struct Run {
    counts: Vec<[u16; 2]>,
    /// As bits, so that NaN equals itself.
    poses: Vec<[u32; 3]>,
    end: [f64; 3],
}

/// Ten seconds: the host sends a duty for both motors twice a second, the firmware obeys.
fn run(seed: u64) -> (Run, Faults) {
    let mut bench = RosbotBench::new(Default::default()).unwrap();
    let clock = bench.clock().clone();
    let faults = Faults::new(&clock, FAULTS.map(|text| text.parse().unwrap()), seed);
    let (host, mut robot) = uart::pair(&clock, Default::default(), seed);
    let mut host = FaultyHost::new(host, &faults);
    let supply = Wire::new(3.3);
    let mut detector = BrownOutDetector::new(&supply, 2.7, 0.1);
    let mut firmware = None;
    let (mut counts, mut poses) = (Vec::new(), Vec::new());
    for tick in 0..1_000_u32 {
        if tick % 50 == 0 {
            host.write_all(&[(tick / 50 * 37 % 256) as u8]).unwrap();
        }
        bench.apply(&faults);
        supply.set(3.3 * (1.0 - faults.act(FaultKind::BrownOut, None).unwrap_or(0.0)));
        if detector.runs(bench.board()) {
            let (pwm, encoders, pose) = firmware.get_or_insert_with(|| {
                let devices = bench.devices(MotionCaptureSettings::POSE, seed).unwrap();
                let RosbotDevices { pwm, encoders: [right, left], pose, .. } = devices;
                let right = FaultyEncoder::new(right, &faults, 0);
                let left = FaultyEncoder::new(left, &faults, 1);
                (pwm, [right, left], FaultySensor::new(pose, &faults, [0.5; 3]))
            });
            if robot.read_ready().unwrap() {
                let mut command = [0];
                robot.read(&mut command).unwrap();
                for pwm in pwm {
                    pwm.set_duty_cycle(u16::from(command[0]) * 18).unwrap();
                }
            }
            counts.push(encoders.each_mut().map(|encoder| encoder.count().unwrap()));
            poses.extend(pose.measure().unwrap().map(|pose| pose.map(f32::to_bits)));
        } else {
            firmware = None;
        }
        let late_us = faults.late_by_us(TICK_US);
        bench.advance_us(TICK_US + late_us);
    }
    assert_eq!(bench.board().misuse(), None);
    assert_eq!(bench.board().resets(), 1);
    (Run { counts, poses, end: bench.motion().pose }, faults)
}

#[test]
fn the_seed_decides_everything() {
    let (first, faults) = run(1);
    for (fault, times) in faults.injections() {
        assert!(times > 0, "{fault} never acted");
    }
    assert!(run(1).0 == first);
    let (other, _) = run(2);
    assert!(first.counts != other.counts && first.poses != other.poses && first.end != other.end);
}

#[test]
fn a_leg_with_leaks_ends_elsewhere() {
    let run = |faults: &[&str]| {
        let mut bench = SoftLegBench::new(Default::default()).unwrap();
        let faults = faults.iter().map(|text| text.parse().unwrap());
        let faults = Faults::new(bench.clock(), faults, 1);
        let mut devices = bench.devices(MotionCaptureSettings::TIP, 1).unwrap();
        devices.pumps[0].set_high().unwrap();
        devices.lines[0].set_high().unwrap();
        devices.valves[0].set_duty_cycle(1500).unwrap();
        for _ in 0..100 {
            bench.apply(&faults);
            bench.advance_us(50_000);
        }
        assert_eq!(bench.board().misuse(), None);
        bench.tip_mm()[0]
    };
    let sound = run(&[]);
    for fault in ["leak:0@0..5=0.5", "pump:0@0..5=0.5", "sag@0..5=0.2", "stuck-valve:0@0..5=1"] {
        assert!(run(&[fault]) < 0.9 * sound, "{fault}: {} {sound}", run(&[fault]));
    }
    assert!(run(&["open-valve:0@0..5=1"]) > 1.01 * sound);
    // A leak in the other chamber is not seen in this one.
    assert_eq!(run(&["leak:1@0..5=0.5"]), sound);
}
