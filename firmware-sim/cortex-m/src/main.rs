//! firmware-core on a Cortex-M4F: loads blobs, checks them, and counts the instructions of a step.
//!
//! QEMU runs it (`cargo run --release`; `measure` in this folder does more). Under `-icount shift=0`
//! every instruction takes one nanosecond of the machine's time, so that SysTick counts them; a loop
//! of known length says how many a tick is. Counts are exact and repeatable; they are no cycles.
//!
//! Without an argument the blobs of `models/` are measured, which are part of the image. The
//! semihosting argument names a file of other blobs, each behind its length (u32, little-endian).
//! Two lines with a `#` come out, sizes and what an update costs, and a line per blob: its place, its robot,
//! instructions of a step, bytes of the blob.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::blob::{Aligned, parse, self_test};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_core::slots::sha256;
use firmware_core::update::{Ask, MAX_CHUNK, PublicKey, Request, Trust};
use firmware_core::{Model, Predictor, PredictorState};

mod host;
mod machine;
mod models;
mod owner;
mod vectors;

use machine::count;
use models::MODELS;
use owner::{KEY, SIGNED};

/// Repetitions that are counted together: a tick is then less than a hundredth of an instruction.
const REPETITIONS: u32 = 1_000;
/// Room for the largest blob that is read from the host.
const ROOM: usize = 48 * 1024;

#[entry]
fn main() -> ! {
    machine::end(measure().is_some())
}

fn measure() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    hprintln!(
        "# model {} B, state {} B, {} instructions per tick",
        size_of::<Model<'_>>(),
        size_of::<PredictorState>(),
        per_tick
    );
    update(per_tick)?;
    let mut line = [0; 256];
    let list = host::argument(&mut line, b"list ").and_then(host::File::open);
    let Some(mut list) = list else {
        for (i, blob) in MODELS.iter().enumerate() {
            one(i, &blob.0, per_tick)?;
        }
        return Some(());
    };
    let mut blob = Aligned([0; ROOM]);
    let mut length = [0; 4];
    let mut i = 0;
    while list.read(&mut length) == length.len() {
        let blob = blob.0.get_mut(..u32::from_le_bytes(length) as usize)?;
        if list.read(blob) < blob.len() {
            return None;
        }
        one(i, blob, per_tick)?;
        i += 1;
    }
    Some(())
}

/// What it takes to install a model: a signature, and per byte of the largest blob its hash, its parser with
/// the self-test, and the line.
#[inline(never)]
fn update(per_tick: f32) -> Option<()> {
    let mut good = true;
    let signature =
        count(|| good &= black_box(PublicKey(KEY)).accepts(black_box(&[0; 64]), &SIGNED));
    let [.., blob] = MODELS;
    let blob = black_box(&blob.0);
    let hash = count(|| good &= black_box(sha256(blob)) != [0; 32]);
    let parsed = count(|| good &= parse(black_box(blob)).is_ok());
    let bytes = blob.get(..MAX_CHUNK)?.iter().copied().collect();
    let ask = Ask::Chunk { session: u32::MAX, offset: 1_000, bytes };
    let mut frame = [0; MAX_FRAME];
    let length = encode(&Message::Request(Request { number: 1, ask }), &mut frame).ok()?;
    let mut receiver = Receiver::new();
    let mut received = 0;
    let line = count(|| {
        for byte in black_box(frame.get(..length).unwrap_or(&[])) {
            received += u32::from(matches!(receiver.push(*byte), Some(Received::Message(_))));
        }
    });
    let per_byte = |ticks: u32, bytes: usize| ticks as f32 * per_tick / bytes as f32;
    hprintln!(
        "# signature {:.0}, per byte: hash {:.1}, parse {:.1}, line {:.1}",
        signature as f32 * per_tick,
        per_byte(hash, blob.len()),
        per_byte(parsed, blob.len()),
        per_byte(line, length)
    );
    (good && received == 1).then_some(())
}

/// Measures a step from the samples of the blob's self-test.
#[inline(never)]
fn one(i: usize, blob: &[u8], per_tick: f32) -> Option<()> {
    let model = match parse(blob) {
        Ok(model) => model,
        Err(error) => {
            hprintln!("{} {:?}", i, error);
            return None;
        }
    };
    let test = self_test(blob).ok()?;
    let structure = model.structure();
    let predictor = Predictor::new(&model);
    let mut start = PredictorState::new();
    let mut inputs = test.inputs.chunks_exact(structure.inputs().len().max(1));
    let mut input: &[f32] = &[];
    for states in test.states.chunks_exact(structure.states().len()) {
        predictor.observe(&mut start, input, states).ok()?;
        input = inputs.next().unwrap_or(&[]);
    }
    let mut state = start.clone();
    let (with, good) = repeated(&predictor, &start, &mut state, input, black_box(step));
    if !good || state.out_of_range().is_some() {
        hprintln!("{} not in range", i);
        return None;
    }
    let (without, _) = repeated(&predictor, &start, &mut state, input, black_box(nothing));
    // What `nothing` does, a move and a return, is taken off as well: the return is one of the step, too, and the
    // move goes with its call.
    let instructions = 1.0 + (with - without) as f32 * per_tick / REPETITIONS as f32;
    hprintln!("{} {} {:.1} {}", i, structure.robot(), instructions, blob.len());
    Some(())
}

type Work = fn(&Predictor<'_, '_>, &mut PredictorState, &[f32]) -> bool;

/// Ticks that some work takes from a state, time and again, and whether it was always done.
#[inline(never)]
fn repeated(
    predictor: &Predictor<'_, '_>,
    start: &PredictorState,
    state: &mut PredictorState,
    input: &[f32],
    work: Work,
) -> (u32, bool) {
    let mut good = true;
    let ticks = count(|| {
        for _ in 0..REPETITIONS {
            state.clone_from(black_box(start));
            good &= work(predictor, state, input);
        }
    });
    (ticks, good)
}

#[inline(never)]
fn step(predictor: &Predictor<'_, '_>, state: &mut PredictorState, input: &[f32]) -> bool {
    predictor.step(state, input).is_ok()
}

#[inline(never)]
fn nothing(_: &Predictor<'_, '_>, _: &mut PredictorState, _: &[f32]) -> bool {
    true
}
