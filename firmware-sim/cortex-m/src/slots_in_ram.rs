//! The flash with the two model slots, as QEMU can have it: in RAM.
//!
//! QEMU has no flash controller for these machines, so that nothing there can be erased or written. What
//! stands in for it is memory behind the traits of embedded-storage that behaves like NOR flash: erasing sets
//! all bits of a sector, writing only clears bits. It outlives a reset, since no section of the image lies
//! there that a start would fill, but not the end of the emulator. On a board this is the controller's
//! flash: these 33 KB do not count to the RAM that the firmware takes.

use core::ptr;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};
use firmware_core::slots::{Geometry, Payload};

/// Bytes of a sector, as the small ones of an STM32F405.
const SECTOR: usize = 16 * 1024;
/// Bytes of the flash: a slot is a sector.
const FLASH: usize = 2 * SECTOR;
/// Where the slots lie in it.
pub const GEOMETRY: Geometry = Geometry { offset: 0, slot_bytes: SECTOR as u32 };
/// Bytes before it, whose first ones say that it has been erased once.
const BEFORE: usize = 1024;
const ERASED_ONCE: u64 = u64::from_le_bytes(*b"NORflash");

unsafe extern "C" {
    /// Where they begin: right behind the RAM that the linker knows, divisible by 1024.
    static mut _slots: u8;
}

/// The flash. There is one.
pub struct SlotsInRam(());

impl SlotsInRam {
    /// Erased at power-on, otherwise as it was before the reset.
    ///
    /// # Safety
    /// Nothing else may hold one.
    pub unsafe fn after_reset() -> Self {
        let mut flash = Self(());
        let known = (&raw mut _slots).cast::<u64>();
        // SAFETY: the memory is there, aligned, and nobody else's; any bytes are a number.
        if unsafe { known.read_volatile() } != ERASED_ONCE {
            let _ = flash.erase(0, FLASH as u32);
            // SAFETY: as above.
            unsafe { known.write_volatile(ERASED_ONCE) };
        }
        flash
    }

    fn at(offset: u32) -> *mut u8 {
        (&raw mut _slots).wrapping_add(BEFORE + offset as usize)
    }

    /// A payload where it lies, which is where a controller maps its flash; `None` of one that is not there.
    ///
    /// # Safety
    /// As long as the bytes are used, the slot must not be erased or its payload written: what
    /// `firmware_core::slots` promises of the one that runs, and does to no other while it asks about it.
    pub unsafe fn map(payload: Payload) -> Option<&'static [u8]> {
        let end = payload.offset.checked_add(payload.length)?;
        (end as usize <= FLASH).then(|| {
            // SAFETY: inside of the flash; the caller sees to it that nothing writes there.
            unsafe {
                core::slice::from_raw_parts(Self::at(payload.offset), payload.length as usize)
            }
        })
    }
}

/// Beyond the end, or across the unit.
#[derive(Debug)]
pub struct Misused(NorFlashErrorKind);

impl NorFlashError for Misused {
    fn kind(&self) -> NorFlashErrorKind {
        self.0
    }
}

impl ErrorType for SlotsInRam {
    type Error = Misused;
}

impl ReadNorFlash for SlotsInRam {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Misused> {
        check_read(self, offset, bytes.len()).map_err(Misused)?;
        // SAFETY: inside of the flash, and `bytes` is not: it belongs to somebody else.
        unsafe { ptr::copy_nonoverlapping(Self::at(offset), bytes.as_mut_ptr(), bytes.len()) };
        Ok(())
    }

    fn capacity(&self) -> usize {
        FLASH
    }
}

impl NorFlash for SlotsInRam {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Misused> {
        check_erase(self, from, to).map_err(Misused)?;
        // SAFETY: inside of the flash; what is mapped is never erased.
        unsafe { ptr::write_bytes(Self::at(from), 0xFF, to.saturating_sub(from) as usize) };
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Misused> {
        check_write(self, offset, bytes.len()).map_err(Misused)?;
        for (offset, byte) in (offset..).zip(bytes) {
            let place = Self::at(offset);
            // SAFETY: inside of the flash; what is mapped is never written.
            unsafe { place.write(place.read() & byte) };
        }
        Ok(())
    }
}
