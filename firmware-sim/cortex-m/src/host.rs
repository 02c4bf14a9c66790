//! Files and the command line of the machine that runs the emulator, through semihosting.
//! What is `unsafe` is the call itself: the host reads and writes memory by address.

use cortex_m_semihosting::{nr::open::R_BINARY, syscall};

/// What follows `command` in the emulator's semihosting arguments, with the zero behind it.
pub fn argument<'b>(buffer: &'b mut [u8; 256], command: &[u8]) -> Option<&'b [u8]> {
    let mut block = [buffer.as_mut_ptr() as usize, buffer.len()];
    // SAFETY: the host writes at most `block[1]` bytes at `block[0]`, which is `buffer`, and then
    // the length into `block[1]`.
    let failed = unsafe {
        cortex_m_semihosting::syscall1(
            cortex_m_semihosting::nr::GET_CMDLINE,
            block.as_mut_ptr() as usize,
        )
    };
    if failed != 0 {
        return None;
    }
    let end = buffer.iter().position(|byte| *byte == 0)?;
    // Without arguments it is the name of the image.
    buffer.get(..=end)?.strip_prefix(command)
}

/// A file of the host, open for reading.
pub struct File(usize);

impl File {
    /// `name` ends with a zero byte.
    pub fn open(name: &[u8]) -> Option<Self> {
        // SAFETY: the host reads the name, whose length is that without the zero.
        let handle = unsafe { syscall!(OPEN, name.as_ptr(), R_BINARY, name.len() - 1) };
        (handle != usize::MAX).then_some(Self(handle))
    }

    /// Fills `buffer` from where the last read ended; returns how many bytes there were.
    pub fn read(&mut self, buffer: &mut [u8]) -> usize {
        // SAFETY: the host writes at most as many bytes as the buffer has.
        let missing = unsafe { syscall!(READ, self.0, buffer.as_mut_ptr(), buffer.len()) };
        buffer.len().saturating_sub(missing)
    }
}
