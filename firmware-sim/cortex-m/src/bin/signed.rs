//! Both loops with the line and updates that have to be signed: `proof` looks for
//! its size.
#![no_std]
#![no_main]

use cortex_m_rt::entry;
use firmware_core::update::PublicKey;

#[path = "../firmware.rs"]
mod firmware;
#[path = "../vectors.rs"]
mod vectors;

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {
        cortex_m::asm::wfi();
    }
}

#[entry]
fn main() -> ! {
    firmware::run(PublicKey(core::hint::black_box([7; 32])));
    loop {
        cortex_m::asm::wfi();
    }
}
