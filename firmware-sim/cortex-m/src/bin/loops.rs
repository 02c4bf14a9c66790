//! Both loops with the line and updates that anybody may make: `proof` looks for what may panic in it, and
//! for its size.
#![no_std]
#![no_main]

use cortex_m_rt::entry;
use firmware_core::update::Anyone;

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
    firmware::run(Anyone);
    loop {
        cortex_m::asm::wfi();
    }
}
