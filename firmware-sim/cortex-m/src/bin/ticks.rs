//! Counts the instructions of a tick of both loops, on devices that are not there: `proof` in this folder
//! holds them to budgets.txt.
//!
//! A line per loop comes out: its robot, the worst tick that is a sample and the worst of the others, without
//! telemetry, and the worst of all with telemetry queued, each from the tick's beginning to its end.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::Model;
use firmware_core::control_loop::telemetry::{Frames, Queue};
use firmware_core::control_loop::{Command, ControlLoop, Mode, Telemetry};

// Only its loops are measured here.
#[allow(dead_code)]
#[path = "../firmware.rs"]
mod firmware;
#[path = "../machine.rs"]
mod machine;
#[path = "../vectors.rs"]
mod vectors;

use machine::count;

/// Ticks of a loop that are counted.
const TICKS: u64 = 2_000;

#[entry]
fn main() -> ! {
    machine::end(measure().is_some())
}

fn measure() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    let [mut queue, mut other] = [Queue::<4>::new(), Queue::<4>::new()];

    let mut model = Model::empty();
    firmware::rosbot_model(&mut model)?;
    let rhythm = (10_000, 10);
    let alone = worst(firmware::rosbot_loop(&model, Telemetry::off())?, None, rhythm)?;
    let (producer, frames) = queue.split();
    let robot = firmware::rosbot_loop(&model, Telemetry::new(producer))?;
    line("skid-rosbot", alone, worst(robot, Some(frames), rhythm)?, per_tick);

    firmware::leg_model(&mut model)?;
    let rhythm = (2_000, 25);
    let alone = worst(firmware::leg_loop(&model, Telemetry::off())?, None, rhythm)?;
    let (producer, frames) = other.split();
    let robot = firmware::leg_loop(&model, Telemetry::new(producer))?;
    line("soft-leg", alone, worst(robot, Some(frames), rhythm)?, per_tick);
    Some(())
}

fn line(name: &str, [sample, between]: [u32; 2], told: [u32; 2], per_tick: f32) {
    let of = |count: u32| count as f32 * per_tick;
    hprintln!("{} {:.0} {:.0} {:.0}", name, of(sample), of(between), of(told[0].max(told[1])));
}

/// The worst tick that is a sample, and the worst of the others; every `per_sample`th tick, `period_us` apart, is
/// one.
#[inline(never)]
fn worst(
    mut robot: impl ControlLoop<2>,
    mut frames: Option<Frames<'_>>,
    (period_us, per_sample): (u64, u64),
) -> Option<[u32; 2]> {
    let mut worst = [0; 2];
    for tick in 0..TICKS {
        let now_us = tick * period_us;
        if tick == 10 * per_sample {
            robot.command(Command::Start);
        }
        robot.command(Command::Inputs(black_box([16.0, -16.0])));
        let taken = count(|| {
            black_box(robot.tick(black_box(now_us)));
            black_box(robot.finish(black_box(now_us + 1)));
        });
        if let Some(frames) = &mut frames {
            while frames.dequeue().is_some() {}
        }
        // Once it runs, and its history is full.
        if tick > 20 * per_sample {
            if robot.mode() != Mode::Running {
                hprintln!("{}", robot.alarms());
                return None;
            }
            let worst = worst.get_mut(usize::from(!tick.is_multiple_of(per_sample)))?;
            *worst = (*worst).max(taken);
        }
    }
    Some(worst)
}
