//! A serial connection: two ends, a line in each direction.
//!
//! Neither end ever blocks, as virtual time would then stand still. Where embedded-io would block,
//! these ends give [`UartError::WouldBlock`], whose kind is [`ErrorKind::TimedOut`]: a wait of no
//! time at all that is over. Firmware that asks [`ReadReady`] and [`WriteReady`] first never sees
//! it.

use crate::log::stream;
use crate::mcu::VirtualClock;
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write, WriteReady};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::cell::{RefCell, RefMut};
use std::collections::VecDeque;
use std::num::{NonZeroU32, NonZeroUsize};
use std::rc::Rc;

/// Start bit, eight data bits, stop bit.
const BITS_PER_BYTE: u64 = 10;

/// Why an end does nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UartError {
    /// Nothing has arrived, nothing more fits, or not everything has been sent.
    #[error("the operation would block")]
    WouldBlock,
}

impl embedded_io::Error for UartError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::TimedOut
    }
}

/// What fixes a connection; both directions are alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UartSettings {
    /// Bits per second; a byte takes ten.
    pub baud: NonZeroU32,
    /// Bytes that wait to be sent, the one on the line included.
    pub transmit_buffer: NonZeroUsize,
    /// Bytes that wait to be read; those that come when it is full are lost.
    pub receive_buffer: NonZeroUsize,
    /// Probability that a byte is lost.
    pub loss: f64,
    /// Probability that a byte arrives twice.
    pub doubling: f64,
    /// Probability that one bit of a byte is flipped.
    pub bit_flip: f64,
}

impl Default for UartSettings {
    /// The ROSbot's 576,000 baud, 256 bytes each way, no noise.
    fn default() -> Self {
        Self {
            baud: NonZeroU32::new(576_000).unwrap(),
            transmit_buffer: NonZeroUsize::new(256).unwrap(),
            receive_buffer: NonZeroUsize::new(256).unwrap(),
            loss: 0.0,
            doubling: 0.0,
            bit_flip: 0.0,
        }
    }
}

/// What became of the bytes of one direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineCounts {
    /// Bytes that the sender wrote.
    pub sent: u64,
    /// Bytes lost on the line.
    pub lost: u64,
    /// Bytes that arrived twice.
    pub doubled: u64,
    /// Bytes with a flipped bit.
    pub flipped: u64,
    /// Bytes lost because the receive buffer was full.
    pub overruns: u64,
}

/// One direction.
#[derive(Debug)]
struct Line {
    settings: UartSettings,
    rng: ChaCha8Rng,
    /// When the bytes that are being sent will be through (ns).
    sending: VecDeque<u64>,
    /// Bytes on the line, with the times at which they arrive (ns).
    arriving: VecDeque<(u64, u8)>,
    received: VecDeque<u8>,
    counts: LineCounts,
}

impl Line {
    fn new(settings: UartSettings, rng: ChaCha8Rng) -> Self {
        Self {
            settings,
            rng,
            sending: VecDeque::new(),
            arriving: VecDeque::new(),
            received: VecDeque::new(),
            counts: LineCounts::default(),
        }
    }

    /// Moves what has been sent and what has arrived by now.
    ///
    /// It is enough to do this before each access: between two reads the receive buffer only fills.
    fn settle(&mut self, now_ns: u64) {
        while self.sending.pop_front_if(|through_ns| *through_ns <= now_ns).is_some() {}
        while let Some((_, byte)) = self.arriving.pop_front_if(|(at_ns, _)| *at_ns <= now_ns) {
            if self.received.len() < self.settings.receive_buffer.get() {
                self.received.push_back(byte);
            } else {
                self.counts.overruns += 1;
            }
        }
    }

    fn room(&self) -> usize {
        self.settings.transmit_buffer.get().saturating_sub(self.sending.len())
    }

    fn send(&mut self, mut byte: u8, now_ns: u64) {
        let UartSettings { baud, loss, doubling, bit_flip, .. } = self.settings;
        let byte_ns = BITS_PER_BYTE * 1_000_000_000 / u64::from(baud.get());
        let through_ns = self.sending.back().map_or(now_ns, |ns| *ns) + byte_ns;
        self.sending.push_back(through_ns);
        self.counts.sent += 1;
        if self.rng.random::<f64>() < loss {
            self.counts.lost += 1;
            return;
        }
        if self.rng.random::<f64>() < bit_flip {
            self.counts.flipped += 1;
            byte ^= 1 << self.rng.random_range(0..8_u32);
        }
        self.arriving.push_back((through_ns, byte));
        if self.rng.random::<f64>() < doubling {
            self.counts.doubled += 1;
            self.arriving.push_back((through_ns, byte));
        }
    }
}

/// One end of a connection.
///
/// ```
/// use embedded_io::{Read, ReadReady, Write};
/// use firmware_sim::mcu::{VirtualClock, uart};
///
/// let clock = VirtualClock::new();
/// let (mut host, mut robot) = uart::pair(&clock, Default::default(), 1);
/// host.write_all(b"go")?;
/// clock.advance_us(17); // a byte takes 17.361 µs
/// assert!(!robot.read_ready()?);
/// clock.advance_us(1);
/// let mut buffer = [0; 8];
/// assert_eq!(robot.read(&mut buffer)?, 1);
/// clock.advance_us(17);
/// assert_eq!(robot.read(&mut buffer)?, 1);
/// assert_eq!(buffer[0], b'o');
/// # Ok::<(), firmware_sim::mcu::uart::UartError>(())
/// ```
#[derive(Debug)]
pub struct UartEnd {
    clock: VirtualClock,
    outgoing: Rc<RefCell<Line>>,
    incoming: Rc<RefCell<Line>>,
}

/// Two connected ends, with the noise of `seed`.
pub fn pair(clock: &VirtualClock, settings: UartSettings, seed: u64) -> (UartEnd, UartEnd) {
    let line = |number| Rc::new(RefCell::new(Line::new(settings, stream(seed, number))));
    let (there, back) = (line(0), line(1));
    let end = |outgoing: &Rc<RefCell<Line>>, incoming: &Rc<RefCell<Line>>| UartEnd {
        clock: clock.clone(),
        outgoing: outgoing.clone(),
        incoming: incoming.clone(),
    };
    (end(&there, &back), end(&back, &there))
}

impl UartEnd {
    /// What became of the bytes that this end wrote, as far as they have arrived.
    pub fn outgoing(&self) -> LineCounts {
        self.settled(&self.outgoing).counts
    }

    /// What became of the bytes for this end, as far as they have arrived.
    pub fn incoming(&self) -> LineCounts {
        self.settled(&self.incoming).counts
    }

    fn settled<'a>(&self, line: &'a RefCell<Line>) -> RefMut<'a, Line> {
        let mut line = line.borrow_mut();
        line.settle(self.clock.now_ns());
        line
    }
}

impl ErrorType for UartEnd {
    type Error = UartError;
}

impl Read for UartEnd {
    /// Reads what has arrived.
    ///
    /// # Errors
    ///
    /// [`UartError::WouldBlock`] if that is nothing.
    fn read(&mut self, buf: &mut [u8]) -> Result<usize, UartError> {
        let mut line = self.settled(&self.incoming);
        let count = buf.len().min(line.received.len());
        for (to, from) in buf.iter_mut().zip(line.received.drain(..count)) {
            *to = from;
        }
        if count == 0 && !buf.is_empty() { Err(UartError::WouldBlock) } else { Ok(count) }
    }
}

impl ReadReady for UartEnd {
    fn read_ready(&mut self) -> Result<bool, UartError> {
        Ok(!self.settled(&self.incoming).received.is_empty())
    }
}

impl Write for UartEnd {
    /// Takes as many bytes as fit.
    ///
    /// # Errors
    ///
    /// [`UartError::WouldBlock`] if that is none.
    fn write(&mut self, buf: &[u8]) -> Result<usize, UartError> {
        let mut line = self.settled(&self.outgoing);
        let count = buf.len().min(line.room());
        for byte in &buf[..count] {
            line.send(*byte, self.clock.now_ns());
        }
        if count == 0 && !buf.is_empty() { Err(UartError::WouldBlock) } else { Ok(count) }
    }

    /// Whether everything has been sent.
    ///
    /// # Errors
    ///
    /// [`UartError::WouldBlock`] if not.
    fn flush(&mut self) -> Result<(), UartError> {
        let is_empty = self.settled(&self.outgoing).sending.is_empty();
        if is_empty { Ok(()) } else { Err(UartError::WouldBlock) }
    }
}

impl WriteReady for UartEnd {
    fn write_ready(&mut self) -> Result<bool, UartError> {
        Ok(self.settled(&self.outgoing).room() > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::{FaultKind, Faults};
    use crate::faulty::FaultyHost;
    use proptest::prelude::*;

    fn size(bytes: usize) -> NonZeroUsize {
        NonZeroUsize::new(bytes).unwrap()
    }

    /// A byte takes 1 ms.
    fn slow() -> UartSettings {
        UartSettings { baud: NonZeroU32::new(10_000).unwrap(), ..Default::default() }
    }

    #[test]
    fn never_blocks_and_says_so_beforehand() {
        let clock = VirtualClock::new();
        let settings = UartSettings { transmit_buffer: size(3), ..slow() };
        let (mut a, mut b) = pair(&clock, settings, 1);
        let mut buffer = [0; 8];
        assert_eq!(b.read_ready(), Ok(false));
        assert_eq!(b.read(&mut buffer), Err(UartError::WouldBlock));
        assert_eq!((a.read(&mut []), a.write(&[])), (Ok(0), Ok(0)));
        assert_eq!(a.write(&[1, 2, 3, 4]), Ok(3));
        assert_eq!(a.write_ready(), Ok(false));
        assert_eq!(a.write(&[4]), Err(UartError::WouldBlock));
        assert_eq!(a.flush(), Err(UartError::WouldBlock));
        clock.advance_us(1_000);
        // The first is through and makes room, which is taken up where the third ends.
        assert_eq!((b.read_ready(), a.write_ready()), (Ok(true), Ok(true)));
        assert_eq!(a.write(&[4, 5]), Ok(1));
        clock.advance_us(2_999);
        assert_eq!(b.read(&mut buffer), Ok(3));
        clock.advance_us(1);
        assert_eq!(a.flush(), Ok(()));
        assert_eq!((b.read(&mut buffer), buffer[0]), (Ok(1), 4));
        assert_eq!(b.incoming(), LineCounts { sent: 4, ..Default::default() });
        // Nothing went the other way.
        assert_eq!(b.outgoing(), LineCounts::default());
    }

    #[test]
    fn a_full_receiver_loses_the_newest_bytes() {
        let clock = VirtualClock::new();
        let (mut a, mut b) = pair(&clock, UartSettings { receive_buffer: size(4), ..slow() }, 1);
        a.write_all(&[1, 2, 3, 4, 5, 6]).unwrap();
        clock.advance_us(5_000);
        let mut buffer = [0; 8];
        assert_eq!(b.read(&mut buffer[..2]), Ok(2));
        clock.advance_us(1_000);
        assert_eq!(b.read(&mut buffer), Ok(3));
        assert_eq!(buffer[..3], [3, 4, 6]);
        assert_eq!(b.incoming().overruns, 1);
    }

    #[test]
    fn noise_is_that_of_the_seed_and_counted() {
        let run = |seed| {
            let clock = VirtualClock::new();
            let settings = UartSettings {
                transmit_buffer: size(10_000),
                receive_buffer: size(20_000),
                loss: 0.1,
                doubling: 0.05,
                bit_flip: 0.02,
                ..slow()
            };
            let (mut a, mut b) = pair(&clock, settings, seed);
            a.write_all(&[0; 10_000]).unwrap();
            clock.advance_us(10_000_000);
            let mut buffer = vec![0; 20_000];
            let count = b.read(&mut buffer).unwrap();
            buffer.truncate(count);
            (buffer, b.incoming())
        };
        let (bytes, counts) = run(3);
        assert_eq!(run(3).0, bytes);
        assert_ne!(run(4).0, bytes);
        assert_eq!(bytes.len() as u64, counts.sent - counts.lost + counts.doubled);
        assert!(bytes.iter().all(|byte| byte.count_ones() <= 1));
        // Five standard deviations each.
        assert!((850..1150).contains(&counts.lost), "{counts:?}");
        assert!((340..560).contains(&counts.doubled), "{counts:?}");
        assert!((110..250).contains(&counts.flipped), "{counts:?}");
    }

    #[test]
    fn a_silenced_host_is_not_heard() {
        let clock = VirtualClock::new();
        let (host, mut robot) = pair(&clock, slow(), 1);
        let faults = Faults::new(&clock, ["silence@0..1=1".parse().unwrap()], 1);
        let mut host = FaultyHost::new(host, &faults);
        host.write_all(b"stop").unwrap();
        clock.advance_us(1_000_000);
        assert_eq!(robot.read_ready(), Ok(false));
        host.write_all(b"go").unwrap();
        clock.advance_us(2_000);
        let mut buffer = [0; 8];
        assert_eq!((robot.read(&mut buffer), &buffer[..2]), (Ok(2), &b"go"[..]));
        assert_eq!(faults.injected(FaultKind::Silence), 1);
    }

    proptest! {
        #[test]
        fn a_clean_line_is_a_queue(
            writes in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..40), 0..40_000_u64), 1..20),
        ) {
            let clock = VirtualClock::new();
            let settings = UartSettings { transmit_buffer: size(16), ..slow() };
            let (mut a, mut b) = pair(&clock, settings, 1);
            let (mut written, mut read) = (Vec::new(), Vec::new());
            let mut buffer = [0; 64];
            for (bytes, pause_us) in writes {
                let room = a.write_ready().unwrap();
                let count = a.write(&bytes).unwrap_or(0);
                prop_assert_eq!(room || bytes.is_empty(), count > 0 || bytes.is_empty());
                written.extend_from_slice(&bytes[..count]);
                clock.advance_us(pause_us);
                let ready = b.read_ready().unwrap();
                let count = b.read(&mut buffer).unwrap_or(0);
                prop_assert_eq!(ready, count > 0);
                read.extend_from_slice(&buffer[..count]);
            }
            clock.advance_us(1_000_000);
            let count = b.read(&mut buffer).unwrap_or(0);
            read.extend_from_slice(&buffer[..count]);
            prop_assert_eq!(read, written);
        }
    }
}
