//! What it takes to load a blob into a model that is there already: instructions and stack. `proof` in this
//! folder holds them to budgets.txt.
//!
//! A blob ends with a prediction, which is tried. What that takes is a matter of the predictor, and told apart:
//! a copy whose self-test is a section that nobody knows is loaded, and refused when all else is done.
//!
//! A line per blob of models/ comes out: instructions without the stored prediction, and what it adds; bytes
//! of stack without it, and with it; bytes of coefficients, of metadata, and of the blob. Then instructions
//! per byte by which coefficients, and metadata, are longer; and bytes of a model, of a state, and of stack when
//! `parse` returns a model by value.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::blob::{Aligned, ParseError, emit, parse, parse_into};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{Input, Provenance, Space, State, Symmetry, Target};
use firmware_core::{Model, ModelRepr, PredictorState, Structure};

#[path = "../machine.rs"]
mod machine;
#[path = "../models.rs"]
mod models;
#[path = "../vectors.rs"]
mod vectors;

use machine::{count, stack};
use models::MODELS;

/// Instructions that a byte of coefficients, and one of metadata, may take, everything included.
const PER_COEFFICIENT_BYTE: f32 = 9.0;
const PER_METADATA_BYTE: f32 = 60.0;
/// Stack beside the model.
const STACK: usize = 256;
/// Room for the largest blob.
const ROOM: usize = 4 * 1024;
/// Kinds of sections.
const METADATA: u16 = 1;
const COEFFICIENTS: u16 = 2;
const SELF_TEST: u16 = 3;

type Room = Aligned<[u8; ROOM]>;

#[entry]
fn main() -> ! {
    machine::end(measure().is_some())
}

fn measure() -> Option<()> {
    let per_tick = machine::instructions_per_tick()?;
    for blob in MODELS {
        one(&blob.0, per_tick)?;
    }
    // The same model with another order; and with more of everything else, which has two coefficients each.
    let (small, large) = (made(3, (9, 4), per_tick)?, made(3, (9, 9), per_tick)?);
    let per_coefficient_byte =
        difference(&small, &large) / (large.coefficients - small.coefficients) as f32;
    let more = made(40, (9, 4), per_tick)?;
    let further = (more.coefficients - small.coefficients) as f32 * per_coefficient_byte;
    let per_metadata_byte =
        (difference(&small, &more) - further) / (more.metadata - small.metadata) as f32;
    hprintln!("# Instructions per further byte of coefficients, and of metadata:");
    hprintln!("per-byte {:.1} {:.1}", per_coefficient_byte, per_metadata_byte);
    let [blob, ..] = MODELS;
    let (_, by_value) = stack(|| black_box(parse)(black_box(&blob.0)));
    hprintln!(
        "# Bytes of a model, of a state, and of stack when a dense model is returned by value:"
    );
    hprintln!("bytes {} {} {}", size_of::<Model<'_>>(), size_of::<PredictorState>(), by_value);
    let good =
        per_coefficient_byte <= PER_COEFFICIENT_BYTE && per_metadata_byte <= PER_METADATA_BYTE;
    good.then_some(())
}

/// What a blob took.
struct Loaded {
    coefficients: usize,
    metadata: usize,
    /// Without its stored prediction, and with it.
    instructions: [f32; 2],
    stack: [usize; 2],
}

fn difference(small: &Loaded, large: &Loaded) -> f32 {
    let ([small, _], [large, _]) = (small.instructions, large.instructions);
    large - small
}

#[inline(never)]
fn one(blob: &[u8], per_tick: f32) -> Option<()> {
    let Loaded { coefficients, metadata, instructions: [bare, whole], stack } =
        loaded(blob, per_tick)?;
    let [bare_stack, whole_stack] = stack;
    let name = parse(blob).ok()?.structure().robot();
    hprintln!(
        "{} {:.0} {:.0} {} {} {} {} {}",
        name,
        bare,
        whole - bare,
        bare_stack,
        whole_stack,
        coefficients,
        metadata,
        blob.len()
    );
    let most = PER_COEFFICIENT_BYTE * coefficients as f32 + PER_METADATA_BYTE * metadata as f32;
    (bare <= most && bare_stack <= STACK).then_some(())
}

#[inline(never)]
fn loaded(blob: &[u8], per_tick: f32) -> Option<Loaded> {
    let mut room = Aligned([0; ROOM]);
    let untested = without_self_test(blob, &mut room)?;
    let (mut model, mut state) = (Model::empty(), PredictorState::new());
    let mut of = |blob, expected| {
        let mut result = Ok(());
        let ticks =
            count(|| result = black_box(parse_into)(black_box(blob), &mut model, &mut state));
        let (again, bytes) =
            stack(|| black_box(parse_into)(black_box(blob), &mut model, &mut state));
        (result == expected && again == expected).then_some((ticks as f32 * per_tick, bytes))
    };
    let bare = of(untested, Err(ParseError::MissingSection { kind: SELF_TEST }))?;
    let whole = of(blob, Ok(()))?;
    let (_, coefficients) = section(blob, COEFFICIENTS)?;
    let (_, metadata) = section(blob, METADATA)?;
    Some(Loaded {
        coefficients,
        metadata,
        instructions: [bare.0, whole.0],
        stack: [bare.1, whole.1],
    })
}

/// Where the entry of a section begins, and the length of the section.
fn section(blob: &[u8], kind: u16) -> Option<(usize, usize)> {
    let (entries, _) = blob.get(16..)?.as_chunks::<12>();
    let index =
        entries.iter().position(|entry| entry.first_chunk() == Some(&kind.to_le_bytes()))?;
    let length = entries.get(index)?.last_chunk::<4>()?;
    Some((16 + 12 * index, u32::from_le_bytes(*length) as usize))
}

/// The same blob with its self-test as a section that nobody knows.
fn without_self_test<'b>(blob: &[u8], room: &'b mut Room) -> Option<&'b [u8]> {
    let copy = room.0.get_mut(..blob.len())?;
    copy.copy_from_slice(blob);
    let (entry, _) = section(copy, SELF_TEST)?;
    copy.get_mut(entry..entry + 2)?.copy_from_slice(&(0xF000 | SELF_TEST).to_le_bytes());
    let Err(ParseError::Checksum { found, .. }) = parse(copy) else { return None };
    copy.get_mut(12..16)?.copy_from_slice(&found.to_le_bytes());
    Some(copy)
}

/// What a dense model takes of one coordinate and six inputs, with so many observables: the coordinate and
/// an input in a block of these orders, and every other input, of any sample, in a block of its own.
#[inline(never)]
fn made(observables: u8, (first, second): (u8, u8), per_tick: f32) -> Option<Loaded> {
    let observable = |i: u8| {
        let (source, lag) = match i.checked_sub(1) {
            None => (Source::State(0), 0),
            Some(i) => (Source::Input(i % 6), i / 6),
        };
        Observable { source, lag: lag.min(6), centre: 0.5, gain: 2.0 }
    };
    let factor = |(observable, order)| Factor { observable, basis: Basis::Hermite, order };
    let others = (2..observables).map(|observable| (observable, 1));
    let block = |factors| Block { factors, max_degree: 0 };
    let limit = [-1e9, 1e9];
    let state = State { name: "x", unit: "m", space: Space::Line, target: Target::Absolute, limit };
    let structure = Structure::try_from(ModelRepr {
        robot: "made",
        sample_time_s: 0.1,
        states: [state].into_iter().collect(),
        inputs: ["a", "b", "c", "d", "e", "f"]
            .map(|name| Input { name, unit: "V", range: [-1.0, 1.0] })
            .into_iter()
            .collect(),
        symmetry: Symmetry::None,
        observables: (0..observables).map(observable).collect(),
        factors: [(0, first), (1, second)].into_iter().chain(others.clone()).map(factor).collect(),
        blocks: [2].into_iter().chain(others.map(|_| 1)).map(block).collect(),
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    });
    let structure = structure.ok()?;
    let (zeros, samples) = ([0.0; 256], structure.lag() + 1);
    let coefficients = zeros.get(..structure.dictionary().dense_terms())?;
    let model = Model::new(structure, coefficients, None).ok()?;
    let mut room = Aligned([0; ROOM]);
    let (states, inputs) = (zeros.get(..samples)?, zeros.get(..6 * samples)?);
    let length = emit(&model, states, inputs, &[0.0], &mut room.0).ok()?;
    loaded(room.0.get(..length)?, per_tick)
}
