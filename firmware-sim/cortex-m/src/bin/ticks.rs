//! Counts the instructions of a tick of both loops, on devices that are not there: `proof` in this folder
//! holds them to budgets.txt.
//!
//! A line per loop comes out: its robot, the worst tick that is no sample, the worst that is one, both
//! from the tick's beginning to its end, telemetry queued.
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

use machine::count;

/// Ticks of a loop that are counted.
const TICKS: u64 = 2_000;

#[entry]
fn main() -> ! {
    machine::end(measure().is_some())
}

fn measure() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    let mut rosbot = Model::empty();
    firmware::rosbot_model(&mut rosbot)?;
    let mut queue = Queue::<4>::new();
    let (producer, mut frames) = queue.split();
    let mut robot = firmware::rosbot_loop(&rosbot, Telemetry::new(producer))?;
    one("skid-rosbot", &mut robot, &mut frames, (10_000, 10), per_tick)?;
    let mut leg = Model::empty();
    firmware::leg_model(&mut leg)?;
    let mut queue = Queue::<4>::new();
    let (producer, mut frames) = queue.split();
    let mut robot = firmware::leg_loop(&leg, Telemetry::new(producer))?;
    one("soft-leg", &mut robot, &mut frames, (50_000, 1), per_tick)
}

/// Runs a loop; every `per_sample`th of its ticks, `period_us` apart, is a sample.
#[inline(never)]
fn one(
    name: &str,
    robot: &mut impl ControlLoop<2>,
    frames: &mut Frames<'_>,
    (period_us, per_sample): (u64, u64),
    per_tick: f32,
) -> Option<()> {
    let mut worst = [0; 2];
    for tick in 0..TICKS {
        let now_us = tick * period_us;
        if tick == 10 * per_sample {
            robot.command(Command::Start);
        }
        robot.command(Command::Inputs([3.0, 4.0]));
        let taken = count(|| {
            black_box(robot.tick(black_box(now_us)));
            black_box(robot.finish(black_box(now_us + 1)));
        });
        let is_sample = tick.is_multiple_of(per_sample);
        while frames.dequeue().is_some() {}
        // Once it runs, and its history is full.
        if tick > 20 * per_sample {
            if robot.mode() != Mode::Running {
                hprintln!("{} {}", name, robot.alarms());
                return None;
            }
            let worst = worst.get_mut(usize::from(is_sample))?;
            *worst = (*worst).max(taken);
        }
    }
    let [plain, sample] = worst.map(|ticks: u32| ticks as f32 * per_tick);
    hprintln!("{} {:.0} {:.0}", name, plain, sample);
    Some(())
}
