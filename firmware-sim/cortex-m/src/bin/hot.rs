//! The hot path alone: a blob loaded, a measurement taken, a step, a rollout. `proof` looks for what may panic
//! in it.
#![no_std]
#![no_main]

use core::hint::black_box;

use cortex_m_rt::entry;
use firmware_core::blob::Aligned;
use firmware_core::{Predictor, PredictorState};

#[path = "../vectors.rs"]
mod vectors;

static BLOB: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../../models/rosbot/model.bin"));

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {
        cortex_m::asm::wfi();
    }
}

#[entry]
fn main() -> ! {
    if let Ok(model) = firmware_core::parse_for("rosbot", black_box(&BLOB.0)) {
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        loop {
            let measured = black_box([0.0; 3]);
            let input = black_box([0.0; 2]);
            let mut path = [0.0; 30];
            let ok = predictor.observe(&mut state, &input, &measured).is_ok()
                && predictor.step(&mut state, &input).is_ok()
                && predictor.rollout_held(&mut state, &input, &mut path).is_ok();
            black_box((ok, path, state.out_of_range()));
        }
    }
    loop {
        cortex_m::asm::wfi();
    }
}
