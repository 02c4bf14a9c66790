//! What the images that QEMU runs share: their end, and the counter of instructions.

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m_semihosting::{debug, hprintln};

/// Rounds of the loop that calibrates, of two instructions each.
const CALIBRATION: u32 = 1_000_000;

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    hprintln!("panic");
    end(false)
}

/// Ends the emulator; its exit code says whether all was well.
pub fn end(ok: bool) -> ! {
    debug::exit(if ok { debug::EXIT_SUCCESS } else { debug::EXIT_FAILURE });
    loop {
        cortex_m::asm::wfi();
    }
}

/// Starts SysTick; the instructions per tick, once.
pub fn instructions_per_tick() -> Option<f32> {
    let mut timer = cortex_m::Peripherals::take()?.SYST;
    timer.set_clock_source(SystClkSource::Core);
    timer.set_reload(0x00FF_FFFF);
    timer.clear_current();
    timer.enable_counter();
    // `delay(n)` runs a loop of two instructions n + 1 times.
    let ticks = count(|| cortex_m::asm::delay(CALIBRATION - 1));
    Some(2.0 * CALIBRATION as f32 / ticks as f32)
}

/// Ticks that `work` takes; the timer counts down.
pub fn count(work: impl FnOnce()) -> u32 {
    let before = SYST::get_current();
    work();
    before.wrapping_sub(SYST::get_current()) & 0x00FF_FFFF
}

/// Bytes below the present stack that are painted before they are counted.
const PAINTED: usize = 48 * 1024;
const PAINT: u32 = 0xC01D_C0DE;

/// What `work` returns, and the bytes of stack that what it calls takes: those below the present stack are
/// painted first. Compiled into this function `work` itself takes none; what it calls must not be.
#[allow(dead_code)]
#[inline(never)]
pub fn stack<T>(work: impl FnOnce() -> T) -> (T, usize) {
    let top = cortex_m::register::msp::read() as usize;
    let words = || (top - PAINTED..top).step_by(4).map(|address| address as *mut u32);
    for word in words() {
        // SAFETY: nothing is below the stack, and the memory of `memory.x` reaches further down.
        unsafe { word.write_volatile(PAINT) };
    }
    let result = work();
    // SAFETY: as above.
    let untouched = words().take_while(|word| unsafe { word.read_volatile() } == PAINT).count();
    (result, PAINTED - 4 * untouched)
}
