//! What one tick of virtual time costs on the host: the bench alone, without any firmware.

use criterion::{Criterion, criterion_group, criterion_main};
use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;
use firmware_sim::bench::{RosbotBench, SoftLegBench};
use firmware_sim::mcu::position_sensor::MotionCaptureSettings;

fn ticks(c: &mut Criterion) {
    let mut rosbot = RosbotBench::new(Default::default()).expect("default parameters");
    let mut devices = rosbot.devices(MotionCaptureSettings::POSE, 1).expect("a new board");
    let mut duty = 0;
    c.bench_function("ROSbot, 10 ms", |b| {
        b.iter(|| {
            duty = (duty + 613) % 4667;
            let [right, left] = &mut devices.pwm;
            right.set_duty_cycle(duty).expect("below the maximum");
            left.set_duty_cycle(4666 - duty).expect("below the maximum");
            rosbot.advance_us(10_000);
        })
    });

    let mut leg = SoftLegBench::new(Default::default()).expect("default parameters");
    let mut devices = leg.devices(MotionCaptureSettings::TIP, 1).expect("a new board");
    for pump in &mut devices.pumps {
        pump.set_high().expect("no reset");
    }
    c.bench_function("soft leg, 50 ms", |b| {
        b.iter(|| {
            duty = (duty + 613) % 4667;
            let [bending, extension] = &mut devices.valves;
            bending.set_duty_cycle(duty).expect("below the maximum");
            extension.set_duty_cycle(4666 - duty).expect("below the maximum");
            let [bending, extension] = &mut devices.lines;
            bending.set_state((duty % 3 == 0).into()).expect("no reset");
            extension.set_state((duty % 5 > 1).into()).expect("no reset");
            leg.advance_us(50_000);
        })
    });
}

criterion_group!(benches, ticks);
criterion_main!(benches);
