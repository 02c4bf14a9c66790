//! Models in fixed point: predictions from random samples, and the instructions of a step. `fixed` in this
//! folder runs it on a Cortex-M4 and a Cortex-M3.
//!
//! The semihosting argument is `q31 STEPS FILE`: so many random predictions, and a file of blobs, each behind
//! its length (u32, little-endian). A line per blob comes out: its place, its robot, the predictions that did
//! not diverge, their hash; and one that begins with `#`: its place, instructions of a step, of reading the
//! coordinates, bytes of the blob.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::PredictError;
use firmware_core::blob::Aligned;
use firmware_core::capacity::{MAX_INPUTS, MAX_STATES};
use firmware_core::q31::{FixedModel, FixedState, parse};

#[path = "../q31_bits.rs"]
mod bits;
#[path = "../host.rs"]
mod host;
#[path = "../machine.rs"]
mod machine;
#[path = "../vectors.rs"]
mod vectors;

use machine::count;

/// Repetitions that are counted together: a tick is then less than a hundredth of an instruction.
const REPETITIONS: u32 = 1_000;
/// Room for the largest blob that is read from the host.
const ROOM: usize = 16 * 1024;

#[entry]
fn main() -> ! {
    machine::end(all().is_some())
}

fn all() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    let mut line = [0; 256];
    let arguments = host::argument(&mut line, b"q31 ")?;
    let space = arguments.iter().position(|byte| *byte == b' ')?;
    let (steps, name) = arguments.split_at_checked(space)?;
    let steps = core::str::from_utf8(steps).ok()?.parse().ok()?;
    let mut list = host::File::open(name.get(1..)?)?;
    let mut blob = Aligned([0; ROOM]);
    let mut length = [0; 4];
    let mut i = 0;
    while list.read(&mut length) == length.len() {
        let blob = blob.0.get_mut(..u32::from_le_bytes(length) as usize)?;
        if list.read(blob) < blob.len() {
            return None;
        }
        let model = match parse(blob) {
            Ok(model) => model,
            Err(error) => {
                hprintln!("{} {:?}", i, error);
                return None;
            }
        };
        let (predicted, hash) = bits::bits(&model, steps)?;
        hprintln!("{} {} {} of {} {:016x}", i, model.robot(), predicted, steps, hash);
        measure(i, &model, per_tick, blob.len())?;
        i += 1;
    }
    Some(())
}

type Work<'a> = fn(&FixedModel<'a>, &mut FixedState, &[i32]) -> Result<(), PredictError>;

/// Measures a step from the middle of all ranges, from its first instruction to its last.
#[inline(never)]
fn measure<'a>(i: usize, model: &FixedModel<'a>, per_tick: f32, bytes: usize) -> Option<()> {
    let zeros = [0; MAX_STATES];
    let input = [0; MAX_INPUTS];
    let input = input.get(..model.inputs())?;
    let mut start = FixedState::new();
    model.observe(&mut start, zeros.get(..model.states())?).ok()?;
    let (with, good) = repeat(FixedModel::step, model, &start, input);
    let (reading, read) = repeat(coordinates, model, &start, input);
    let (without, _) = repeat(nothing, model, &start, input);
    let per_call = |ticks: u32| (ticks - without) as f32 * per_tick / REPETITIONS as f32 + NOTHING;
    hprintln!("# {} {:.1} {:.1} {}", i, per_call(with), per_call(reading), bytes);
    (good && read).then_some(())
}

/// Ticks of many calls, each from the same state, and whether all were well. Never inlined, so that it is the
/// same loop for all.
#[inline(never)]
fn repeat<'a>(
    work: Work<'a>,
    model: &FixedModel<'a>,
    start: &FixedState,
    input: &[i32],
) -> (u32, bool) {
    let (work, mut state, mut good) = (black_box(work), start.clone(), true);
    let ticks = count(|| {
        for _ in 0..REPETITIONS {
            state.clone_from(black_box(start));
            good &= work(model, &mut state, input).is_ok();
        }
    });
    (ticks, good && state.out_of_range().is_none())
}

#[inline(never)]
fn coordinates(
    model: &FixedModel<'_>,
    state: &mut FixedState,
    _: &[i32],
) -> Result<(), PredictError> {
    let mut out = [0; MAX_STATES];
    let out = out.get_mut(..model.states()).unwrap_or_default();
    model.coordinates(state, black_box(out))
}

/// Instructions of [`nothing`]: two that enter, two that store the result, and the return.
const NOTHING: f32 = 5.0;

#[inline(never)]
fn nothing(_: &FixedModel<'_>, _: &mut FixedState, _: &[i32]) -> Result<(), PredictError> {
    Ok(())
}
