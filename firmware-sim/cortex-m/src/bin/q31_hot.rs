//! The hot path of a model in fixed point alone: a blob loaded, a measurement taken, a step, a rollout. `fixed`
//! looks for what may panic in it, and for floating point, on a Cortex-M4, M3 and M0+.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use firmware_core::blob::Aligned;
use firmware_core::q31::{FixedState, parse_for};

#[path = "../vectors.rs"]
mod vectors;

static BLOB: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../../models/rosbot/model.q31"));

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {
        cortex_m::asm::wfi();
    }
}

#[entry]
fn main() -> ! {
    if let Ok(model) = parse_for("rosbot", black_box(&BLOB.0)) {
        let mut state = FixedState::new();
        loop {
            let measured = black_box([0; 3]);
            let input = black_box([0; 2]);
            let mut path = [0; 30];
            let ok = model.observe(&mut state, &measured).is_ok()
                && model.step(&mut state, &input).is_ok()
                && model.rollout(&mut state, &black_box([0; 20]), &mut path).is_ok();
            black_box((ok, path, state.out_of_range()));
        }
    }
    loop {
        cortex_m::asm::wfi();
    }
}
