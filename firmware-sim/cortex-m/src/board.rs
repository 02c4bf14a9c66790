//! The machine's registers that `robot` needs: two serial lines, a clock, a reset.
//!
//! | | netduinoplus2 (STM32F405) | mps2-an386 (feature `mps2-an386`) |
//! |---|---|---|
//! | the link, QEMU's first `-serial` | USART1 | UART0 |
//! | the line to the robot, its second | USART2 | UART1 |
//! | core clock, as QEMU has it | 168 MHz | 25 MHz |
//!
//! The clock counts interrupts of SysTick, one per millisecond. Without `-icount` QEMU drives SysTick by the
//! host's clock: a second is a second. When the host keeps the emulator waiting, interrupts that were due in
//! the meantime are one, and the image's clock falls behind by the rest, as if it had been stopped: a busy
//! laptop does not make its loop late.
//!
//! QEMU emulates neither clocks nor pins: on a board these would have to be set up first.

use core::convert::Infallible;
use core::sync::atomic::{AtomicU8, AtomicU32, AtomicUsize, Ordering::Relaxed};

use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::{NVIC, SCB, SYST, syst::SystClkSource};
use cortex_m_rt::exception;
use embedded_io::{ErrorType, Read, ReadReady, Write, WriteReady};
use firmware_core::device::MonotonicClock;

#[cfg(feature = "mps2-an386")]
pub use cmsdk::{CORE_HZ, MACHINE};
#[cfg(feature = "mps2-an386")]
use cmsdk::{LINES, Registers};
#[cfg(not(feature = "mps2-an386"))]
pub use stm32::{CORE_HZ, MACHINE};
#[cfg(not(feature = "mps2-an386"))]
use stm32::{LINES, Registers};

/// Baud rate of both lines; QEMU does not mind it.
const BAUD: u32 = 576_000;

fn read(address: usize) -> u32 {
    // SAFETY: only called with the addresses of registers of this machine, which are divisible by four.
    unsafe { (address as *const u32).read_volatile() }
}

fn write(address: usize, value: u32) {
    // SAFETY: as above; none of these registers has a say over memory.
    unsafe { (address as *mut u32).write_volatile(value) };
}

/// USARTs of an STM32F4, RM0090 chapter 30.
#[cfg(not(feature = "mps2-an386"))]
mod stm32 {
    use super::{BAUD, read, write};

    pub const MACHINE: &str = "netduinoplus2";
    /// The most an STM32F405 can do.
    pub const CORE_HZ: u32 = 168_000_000;

    /// USART1 on the bus that runs at half of that, USART2 on the one that runs at a quarter.
    pub const LINES: [Registers; 2] = [
        Registers { base: 0x4001_1000, interrupt: 37, clock_hz: CORE_HZ / 2 },
        Registers { base: 0x4000_4400, interrupt: 38, clock_hz: CORE_HZ / 4 },
    ];
    const STATUS: usize = 0x00;
    const RECEIVED: u32 = 1 << 5;
    const SENT: u32 = 1 << 6;
    const ROOM: u32 = 1 << 7;
    const DATA: usize = 0x04;
    const BAUD_RATE: usize = 0x08;
    const CONTROL: usize = 0x0C;
    /// Enable, interrupt when something was received, transmitter, receiver.
    const ON: u32 = 1 << 13 | 1 << 5 | 1 << 3 | 1 << 2;

    pub struct Registers {
        base: usize,
        pub interrupt: u16,
        clock_hz: u32,
    }

    impl Registers {
        pub fn start(&self) {
            write(self.base + BAUD_RATE, self.clock_hz / BAUD);
            write(self.base + CONTROL, ON);
        }

        /// A byte that was received. Reading the data after the status also clears an overrun.
        pub fn receive(&self) -> Option<u8> {
            (read(self.base + STATUS) & RECEIVED != 0).then(|| read(self.base + DATA) as u8)
        }

        pub fn has_room(&self) -> bool {
            read(self.base + STATUS) & ROOM != 0
        }

        pub fn send(&self, byte: u8) {
            write(self.base + DATA, byte.into());
        }

        pub fn is_sent(&self) -> bool {
            read(self.base + STATUS) & SENT != 0
        }
    }
}

/// UARTs of Arm's Cortex-M System Design Kit, DDI 0479 chapter 4.3.
#[cfg(feature = "mps2-an386")]
mod cmsdk {
    use super::{BAUD, read, write};

    pub const MACHINE: &str = "mps2-an386";
    pub const CORE_HZ: u32 = 25_000_000;

    pub const LINES: [Registers; 2] = [
        Registers { base: 0x4000_4000, interrupt: 0 },
        Registers { base: 0x4000_5000, interrupt: 2 },
    ];
    const DATA: usize = 0x00;
    const STATE: usize = 0x04;
    const FULL: u32 = 1 << 0;
    const RECEIVED: u32 = 1 << 1;
    const CONTROL: usize = 0x08;
    /// Transmitter, receiver, interrupt when something was received.
    const ON: u32 = 1 << 0 | 1 << 1 | 1 << 3;
    const INTERRUPT: usize = 0x0C;
    const OF_RECEIVER: u32 = 1 << 1;
    const BAUD_DIVIDER: usize = 0x10;

    pub struct Registers {
        base: usize,
        pub interrupt: u16,
    }

    impl Registers {
        pub fn start(&self) {
            write(self.base + BAUD_DIVIDER, CORE_HZ / BAUD);
            write(self.base + CONTROL, ON);
        }

        /// A byte that was received. The interrupt is cleared before, so that it comes again with the next.
        pub fn receive(&self) -> Option<u8> {
            write(self.base + INTERRUPT, OF_RECEIVER);
            (read(self.base + STATE) & RECEIVED != 0).then(|| read(self.base + DATA) as u8)
        }

        pub fn has_room(&self) -> bool {
            read(self.base + STATE) & FULL == 0
        }

        pub fn send(&self, byte: u8) {
            write(self.base + DATA, byte.into());
        }

        pub fn is_sent(&self) -> bool {
            self.has_room()
        }
    }
}

/// Bytes that have been received on a line: the interrupt fills in, the loop takes out.
struct Ring {
    bytes: [AtomicU8; Self::SIZE],
    /// Bytes filled in and taken out so far.
    filled: AtomicUsize,
    taken: AtomicUsize,
}

impl Ring {
    /// More than arrives in a tick of the ROSbot at 576,000 baud.
    const SIZE: usize = 1024;

    const fn new() -> Self {
        let (filled, taken) = (AtomicUsize::new(0), AtomicUsize::new(0));
        Self { bytes: [const { AtomicU8::new(0) }; Self::SIZE], filled, taken }
    }

    fn len(&self) -> usize {
        self.filled.load(Relaxed).wrapping_sub(self.taken.load(Relaxed))
    }

    /// A byte without room is lost, as on any line.
    fn fill(&self, byte: u8) {
        let filled = self.filled.load(Relaxed);
        if self.len() < Self::SIZE
            && let Some(place) = self.bytes.get(filled % Self::SIZE)
        {
            place.store(byte, Relaxed);
            // One core: the loop sees stores in the order of the program.
            core::sync::atomic::compiler_fence(core::sync::atomic::Ordering::Release);
            self.filled.store(filled.wrapping_add(1), Relaxed);
        }
    }

    fn take(&self) -> Option<u8> {
        let taken = self.taken.load(Relaxed);
        if self.len() == 0 {
            return None;
        }
        core::sync::atomic::compiler_fence(core::sync::atomic::Ordering::Acquire);
        let byte = self.bytes.get(taken % Self::SIZE)?.load(Relaxed);
        self.taken.store(taken.wrapping_add(1), Relaxed);
        Some(byte)
    }
}

static RECEIVED: [Ring; 2] = [const { Ring::new() }; 2];

/// Every interrupt of the machine: those of the lines.
#[exception]
unsafe fn DefaultHandler(number: i16) {
    for (line, ring) in LINES.iter().zip(&RECEIVED) {
        if i32::from(number) == i32::from(line.interrupt) {
            while let Some(byte) = line.receive() {
                ring.fill(byte);
            }
        }
    }
}

/// Something went wrong for good: the emulator ends.
#[exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    cortex_m_semihosting::hprintln!("hard fault");
    crate::machine::end(false)
}

/// Number of an interrupt.
#[derive(Clone, Copy)]
struct Interrupt(u16);

// SAFETY: the number never changes, and is one of the machine's.
unsafe impl InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self.0
    }
}

/// One of the serial lines; neither reading nor writing waits.
pub struct Serial {
    line: &'static Registers,
    ring: &'static Ring,
}

impl Serial {
    /// Both lines, switched on: the link, and the one to the robot.
    pub fn start() -> [Self; 2] {
        const REGISTERS: &[Registers; 2] = &LINES;
        let [link, plant] = [0, 1].map(|i| Self { line: &REGISTERS[i], ring: &RECEIVED[i] });
        for serial in [&link, &plant] {
            serial.line.start();
            // SAFETY: no critical section relies on this interrupt being masked.
            unsafe { NVIC::unmask(Interrupt(serial.line.interrupt)) };
        }
        [link, plant]
    }

    /// A byte that has arrived.
    pub fn take(&mut self) -> Option<u8> {
        self.ring.take()
    }

    /// Whether the last byte is out.
    pub fn is_sent(&self) -> bool {
        self.line.is_sent()
    }
}

impl ErrorType for Serial {
    type Error = Infallible;
}

impl ReadReady for Serial {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(self.ring.len() > 0)
    }
}

impl Read for Serial {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        let mut count = 0;
        for (place, byte) in bytes.iter_mut().zip(core::iter::from_fn(|| self.ring.take())) {
            *place = byte;
            count += 1;
        }
        Ok(count)
    }
}

impl WriteReady for Serial {
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(self.line.has_room())
    }
}

impl Write for Serial {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let mut count = 0;
        for byte in bytes.iter().take_while(|_| self.line.has_room()) {
            self.line.send(*byte);
            count += 1;
        }
        Ok(count)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        while !self.is_sent() {}
        Ok(())
    }
}

/// Milliseconds since the start; it wraps after 49 days.
static MILLISECONDS: AtomicU32 = AtomicU32::new(0);

#[exception]
fn SysTick() {
    MILLISECONDS.store(MILLISECONDS.load(Relaxed).wrapping_add(1), Relaxed);
}

/// The time since the start, which is 0 after every reset. To be asked more often than every 49 days.
pub struct Clock {
    /// The milliseconds when it was asked last, and those before they wrapped.
    seen: core::cell::Cell<(u32, u64)>,
}

impl Clock {
    const RELOAD: u32 = CORE_HZ / 1000 - 1;

    /// Starts SysTick.
    pub fn start(mut timer: SYST) -> Self {
        timer.set_clock_source(SystClkSource::Core);
        timer.set_reload(Self::RELOAD);
        timer.clear_current();
        timer.enable_interrupt();
        timer.enable_counter();
        Self { seen: core::cell::Cell::new((0, 0)) }
    }
}

impl MonotonicClock for Clock {
    fn now_us(&self) -> u64 {
        let (milliseconds, left, is_due) = loop {
            let before = MILLISECONDS.load(Relaxed);
            let (left, is_due) = (SYST::get_current(), SCB::is_pendst_pending());
            if MILLISECONDS.load(Relaxed) == before {
                break (before, left, is_due);
            }
        };
        let (last, wrapped) = self.seen.get();
        let wrapped = wrapped + if milliseconds < last { 1 << 32 } else { 0 };
        self.seen.set((milliseconds, wrapped));
        // The timer has begun the next millisecond, and its interrupt is about to say so.
        let begun = u64::from(is_due && left > Self::RELOAD / 2);
        let cycles = Self::RELOAD.saturating_sub(left);
        (wrapped + u64::from(milliseconds) + begun) * 1000
            + u64::from(cycles / (CORE_HZ / 1_000_000))
    }
}

/// Starts the controller anew.
pub fn reset() -> ! {
    SCB::sys_reset()
}
