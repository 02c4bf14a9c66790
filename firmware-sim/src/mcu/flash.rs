//! NOR flash with unequal sectors, erase before write, and power that may fail at any byte.
//!
//! - Erasing a sector sets all its bits; programming clears some. A write unit that is not erased
//!   must not be programmed again: that is misuse, though real flash would let bits be cleared.
//! - Erasing and programming take their time on the clock, during which nothing else runs.
//! - When the power fails ([`Flash::cut_power_after`]), a seeded random part of the bits of the write
//!   unit or sector under way has changed, and every access fails until [`Flash::power_on`].
//!
//! [`Region`] is what the firmware gets: the traits of embedded-storage over equal sectors.

use crate::log::stream;
use crate::mcu::{Board, MisuseLog, VirtualClock};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use std::cell::{RefCell, RefMut};
use std::ops::Range;
use std::rc::Rc;

/// Time to program a write unit of up to 32 bits (ns): typical value of the data sheet
/// STM32F405xx/407xx (DS8626), table "Flash memory programming".
pub const PROGRAM_NS: u64 = 16_000;
/// Times to erase a sector of up to so many bytes (ns): typical values of the same table, with 32
/// bits in parallel.
pub const ERASE_NS: [(usize, u64); 3] =
    [(16 * 1024, 250_000_000), (64 * 1024, 550_000_000), (128 * 1024, 1_000_000_000)];
/// Sectors of an STM32F407 with 1 MB (bytes).
pub const STM32F407_SECTORS: [usize; 12] = {
    const KB: usize = 1024;
    let (small, large) = (16 * KB, 128 * KB);
    [small, small, small, small, 64 * KB, large, large, large, large, large, large, large]
};
/// What erased bytes read as.
const ERASED: u8 = 0xFF;

/// Why an access fails. All but [`PowerLost`](Self::PowerLost) is misuse, and on record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FlashError {
    /// An offset or a length is no multiple of the unit.
    #[error("{offset}..{end} is not aligned to {unit} bytes")]
    NotAligned {
        /// Beginning, within the region.
        offset: usize,
        /// End, within the region.
        end: usize,
        /// Bytes of a write unit or a sector.
        unit: usize,
    },
    /// The access ends beyond the region, or before it begins.
    #[error("{offset}..{end} does not lie within the {capacity} bytes of the region")]
    OutOfBounds {
        /// Beginning, within the region.
        offset: usize,
        /// End, within the region.
        end: usize,
        /// Bytes of the region.
        capacity: usize,
    },
    /// A byte that is to be programmed has been programmed before.
    #[error("the byte at {offset} is to be programmed but is not erased")]
    NotErased {
        /// Where, within the region.
        offset: usize,
    },
    /// There is no power.
    #[error("the flash has no power")]
    PowerLost,
}

impl NorFlashError for FlashError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::NotAligned { .. } => NorFlashErrorKind::NotAligned,
            Self::OutOfBounds { .. } => NorFlashErrorKind::OutOfBounds,
            Self::NotErased { .. } | Self::PowerLost => NorFlashErrorKind::Other,
        }
    }
}

/// Why a [`Region`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// There are no such sectors.
    #[error("sectors {first}..{end} do not exist: there are {count}")]
    NoSuchSectors {
        /// First sector.
        first: usize,
        /// Sector after the last.
        end: usize,
        /// Sectors of the flash.
        count: usize,
    },
    /// A sector has another size than the region says.
    #[error("sector {sector} has {len} bytes, not {expected}")]
    SectorSize {
        /// Number of the sector.
        sector: usize,
        /// Its bytes.
        len: usize,
        /// Bytes of a sector of the region.
        expected: usize,
    },
}

/// How much was done to a flash since it was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FlashCounts {
    /// Reads.
    pub reads: u64,
    /// Bytes programmed, a torn one included.
    pub programmed_bytes: u64,
    /// Sectors erased, a torn one included.
    pub erased_sectors: u64,
}

/// The flash of a board. Clones are handles to the same chip.
///
/// ```
/// use embedded_storage::nor_flash::{NorFlash, ReadNorFlash};
/// use firmware_sim::mcu::{Board, Flash, VirtualClock, flash::{FlashError, STM32F407_SECTORS}};
///
/// let board = Board::new(&VirtualClock::new());
/// let flash = Flash::new(&STM32F407_SECTORS, &board, 1);
/// let mut slots = flash.region::<4, { 128 * 1024 }>(5..7)?;
/// slots.erase(0, 128 * 1024)?;
/// slots.write(8, &[1, 2, 3, 4])?;
/// assert_eq!(board.clock().now_ns(), 1_000_016_000); // 1 s to erase, 16 µs to program a word
///
/// flash.cut_power_after(2);
/// assert_eq!(slots.write(12, &[0; 4]), Err(FlashError::PowerLost));
/// flash.power_on();
/// let mut bytes = [0; 12];
/// slots.read(8, &mut bytes)?;
/// assert_eq!(bytes[..4], [1, 2, 3, 4]);
/// assert_ne!(bytes[4..8], [0; 4]); // torn
/// assert_eq!(bytes[8..], [0xFF; 4]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct Flash(Rc<RefCell<Chip>>);

#[derive(Debug)]
struct Chip {
    bytes: Vec<u8>,
    sectors: Vec<Sector>,
    misuse: MisuseLog,
    clock: VirtualClock,
    rng: ChaCha8Rng,
    has_power: bool,
    /// Time to erase a sector, whatever its size (ns), instead of [`ERASE_NS`].
    erase_ns: Option<u64>,
    /// Bytes to program and sectors to erase until the power fails.
    steps_left: Option<u64>,
    counts: FlashCounts,
}

#[derive(Debug)]
struct Sector {
    range: Range<usize>,
    erases: u32,
}

impl Flash {
    /// The erased flash of a board, with sectors of these sizes (bytes). `seed` decides what a failing
    /// power leaves behind.
    pub fn new(sector_bytes: &[usize], board: &Board, seed: u64) -> Self {
        let mut sectors = Vec::with_capacity(sector_bytes.len());
        let mut end = 0;
        for len in sector_bytes {
            sectors.push(Sector { range: end..end + len, erases: 0 });
            end += len;
        }
        Self(Rc::new(RefCell::new(Chip {
            bytes: vec![ERASED; end],
            sectors,
            misuse: board.misuse_log().clone(),
            clock: board.clock().clone(),
            rng: stream(seed, 0),
            has_power: true,
            erase_ns: None,
            steps_left: None,
            counts: FlashCounts::default(),
        })))
    }

    /// Equal neighbouring sectors as one storage, written in units of `WRITE` bytes (1 or 4).
    ///
    /// # Errors
    ///
    /// [`RegionError`] unless the sectors exist and have `ERASE` bytes each.
    pub fn region<const WRITE: usize, const ERASE: usize>(
        &self,
        sectors: Range<usize>,
    ) -> Result<Region<WRITE, ERASE>, RegionError> {
        const { assert!(WRITE == 1 || WRITE == 4, "the flash is programmed by bytes or words") };
        let chip = self.0.borrow();
        let Range { start: first, end } = sectors;
        let found = chip.sectors.get(sectors).filter(|found| !found.is_empty());
        let Some(found) = found else {
            return Err(RegionError::NoSuchSectors { first, end, count: chip.sectors.len() });
        };
        for (sector, found) in (first..).zip(found) {
            let len = found.range.len();
            if len != ERASE || !len.is_multiple_of(WRITE) {
                return Err(RegionError::SectorSize { sector, len, expected: ERASE });
            }
        }
        let start = found[0].range.start;
        let capacity = found.len() * ERASE;
        Ok(Region { chip: self.0.clone(), first_sector: first, start, capacity })
    }

    /// Erases every sector in so much time from now on (ns): the longest that a data sheet allows, say.
    pub fn set_erase_ns(&self, erase_ns: u64) {
        self.0.borrow_mut().erase_ns = Some(erase_ns);
    }

    /// Lets the power fail after so many more steps: inside the byte programmed or the sector erased
    /// then. A step is a byte programmed or a sector erased.
    pub fn cut_power_after(&self, steps: u64) {
        self.0.borrow_mut().steps_left = Some(steps);
    }

    /// Brings the power back, and forgets a cut that has not come yet.
    pub fn power_on(&self) {
        let mut chip = self.0.borrow_mut();
        chip.has_power = true;
        chip.steps_left = None;
    }

    /// Whether there is power.
    pub fn has_power(&self) -> bool {
        self.0.borrow().has_power
    }

    /// How much was done so far.
    pub fn counts(&self) -> FlashCounts {
        self.0.borrow().counts
    }

    /// How often each sector was erased.
    pub fn wear(&self) -> Vec<u32> {
        self.0.borrow().sectors.iter().map(|sector| sector.erases).collect()
    }

    /// The contents, with or without power.
    pub fn snapshot(&self) -> Vec<u8> {
        self.0.borrow().bytes.clone()
    }

    /// Puts a [`snapshot`](Self::snapshot) back, in no time, with the power on and no cut to come. `seed`
    /// decides, as if the flash were new, what a failing power leaves behind.
    ///
    /// # Panics
    ///
    /// If the snapshot is one of a flash of another size.
    pub fn restore(&self, snapshot: &[u8], seed: u64) {
        let mut chip = self.0.borrow_mut();
        chip.bytes.copy_from_slice(snapshot);
        chip.rng = stream(seed, 0);
        chip.has_power = true;
        chip.steps_left = None;
    }
}

impl Chip {
    /// Whether the power lasts for one more byte or sector.
    fn survives_step(&mut self) -> bool {
        match &mut self.steps_left {
            Some(0) => {
                self.has_power = false;
                false
            }
            Some(left) => {
                *left -= 1;
                true
            }
            None => true,
        }
    }

    fn program(&mut self, start: usize, bytes: &[u8], unit: usize) -> Result<(), FlashError> {
        for (unit_at, unit) in (start..).step_by(unit).zip(bytes.chunks(unit)) {
            self.clock.advance_ns(PROGRAM_NS);
            for (at, byte) in (unit_at..).zip(unit) {
                self.counts.programmed_bytes += 1;
                if !self.survives_step() {
                    self.tear(unit_at, unit, at);
                    return Err(FlashError::PowerLost);
                }
                self.bytes[at] &= byte;
            }
        }
        Ok(())
    }

    /// Leaves some of the bits standing that a write unit was to clear: of the byte at `at`, or, as if
    /// the bytes were programmed at once, of all. The unit was erased before.
    fn tear(&mut self, unit_at: usize, unit: &[u8], at: usize) {
        let at_once = unit.len() > 1 && self.rng.random::<bool>();
        for (torn, byte) in (unit_at..).zip(unit) {
            if at_once || torn == at {
                self.bytes[torn] = byte | self.rng.random::<u8>();
            }
        }
    }

    fn erase(&mut self, sector: usize) -> Result<(), FlashError> {
        let Sector { range, erases } = &mut self.sectors[sector];
        *erases += 1;
        let range = range.clone();
        let fits = ERASE_NS.iter().find(|(len, _)| range.len() <= *len);
        let typical_ns = fits.unwrap_or(&ERASE_NS[2]).1;
        self.clock.advance_ns(self.erase_ns.unwrap_or(typical_ns));
        self.counts.erased_sectors += 1;
        let survives = self.survives_step();
        if survives {
            self.bytes[range].fill(ERASED);
            Ok(())
        } else {
            // Between hardly begun and all but finished: bits are set with a probability from
            // 1/256 to 255/256.
            let rounds = self.rng.random_range(1..=8_u32);
            let is_late = self.rng.random::<bool>();
            for byte in &mut self.bytes[range] {
                *byte |= random_bits(&mut self.rng, rounds, is_late);
            }
            Err(FlashError::PowerLost)
        }
    }
}

/// Bits that are set with probability 1 − 2^−rounds (`is_late`) or 2^−rounds.
fn random_bits(rng: &mut impl Rng, rounds: u32, is_late: bool) -> u8 {
    let few = (0..rounds).fold(u8::MAX, |bits, _| bits & rng.random::<u8>());
    if is_late { !few } else { few }
}

/// Equal neighbouring sectors of a [`Flash`], from [`Flash::region`].
#[derive(Debug)]
pub struct Region<const WRITE: usize, const ERASE: usize> {
    chip: Rc<RefCell<Chip>>,
    first_sector: usize,
    start: usize,
    capacity: usize,
}

impl<const WRITE: usize, const ERASE: usize> Region<WRITE, ERASE> {
    /// The range within the region, if it lies there and is aligned.
    fn check(&self, offset: u32, end: usize, unit: usize) -> Result<Range<usize>, FlashError> {
        let (offset, capacity) = (offset as usize, self.capacity);
        if offset > end || end > capacity {
            Err(FlashError::OutOfBounds { offset, end, capacity })
        } else if !offset.is_multiple_of(unit) || !end.is_multiple_of(unit) {
            Err(FlashError::NotAligned { offset, end, unit })
        } else {
            Ok(offset..end)
        }
    }

    /// The chip, if it has power, and the range if that is no misuse.
    fn access(
        &self,
        offset: u32,
        end: usize,
        unit: usize,
    ) -> Result<(RefMut<'_, Chip>, Range<usize>), FlashError> {
        let chip = self.chip.borrow_mut();
        let range = self.check(offset, end, unit).map_err(|error| chip.misuse.record(error))?;
        if chip.has_power { Ok((chip, range)) } else { Err(FlashError::PowerLost) }
    }
}

impl<const WRITE: usize, const ERASE: usize> ErrorType for Region<WRITE, ERASE> {
    type Error = FlashError;
}

impl<const WRITE: usize, const ERASE: usize> ReadNorFlash for Region<WRITE, ERASE> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        let end = (offset as usize).saturating_add(bytes.len());
        let (mut chip, range) = self.access(offset, end, 1)?;
        chip.counts.reads += 1;
        bytes.copy_from_slice(&chip.bytes[self.start + range.start..self.start + range.end]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.capacity
    }
}

impl<const WRITE: usize, const ERASE: usize> NorFlash for Region<WRITE, ERASE> {
    const WRITE_SIZE: usize = WRITE;
    const ERASE_SIZE: usize = ERASE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        let (mut chip, range) = self.access(from, to as usize, ERASE)?;
        for sector in range.start / ERASE..range.end / ERASE {
            chip.erase(self.first_sector + sector)?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        let end = (offset as usize).saturating_add(bytes.len());
        let (mut chip, range) = self.access(offset, end, WRITE)?;
        let at = self.start + range.start..self.start + range.end;
        if let Some(used) = chip.bytes[at.clone()].iter().position(|byte| *byte != ERASED) {
            let error = FlashError::NotErased { offset: range.start + used };
            return Err(chip.misuse.record(error));
        }
        chip.program(at.start, bytes, WRITE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mcu::misuse::Misuse;
    use proptest::prelude::*;

    /// Two sectors of 64 bytes between two of other sizes.
    const SECTORS: [usize; 4] = [16, 64, 64, 256];

    struct Bench {
        board: Board,
        flash: Flash,
        region: Region<4, 64>,
    }

    fn bench(seed: u64) -> Bench {
        let board = Board::new(&VirtualClock::new());
        let flash = Flash::new(&SECTORS, &board, seed);
        let region = flash.region(1..3).unwrap();
        Bench { board, flash, region }
    }

    fn contents(region: &mut Region<4, 64>) -> Vec<u8> {
        let mut bytes = vec![0; 128];
        region.read(0, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn writes_reads_and_erases_its_own_sectors() {
        let Bench { board, flash, mut region } = bench(1);
        assert_eq!(region.capacity(), 128);
        region.write(60, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
        assert_eq!(board.clock().now_ns(), 2 * PROGRAM_NS);
        assert_eq!(contents(&mut region)[58..70], [255, 255, 1, 2, 3, 4, 5, 6, 7, 8, 255, 255]);
        assert_eq!(flash.snapshot()[16 + 60], 1);
        region.erase(64, 128).unwrap();
        assert_eq!(board.clock().now_ns(), 2 * PROGRAM_NS + 250_000_000);
        assert_eq!(contents(&mut region)[60..66], [1, 2, 3, 4, 255, 255]);
        region.erase(0, 128).unwrap();
        assert!(flash.snapshot().iter().all(|byte| *byte == 255));
        assert_eq!(flash.wear(), [0, 1, 2, 0]);
        let counts = FlashCounts { reads: 2, programmed_bytes: 8, erased_sectors: 3 };
        assert_eq!(flash.counts(), counts);
        assert_eq!(board.misuse(), None);
    }

    #[test]
    fn sectors_of_the_f407_take_their_times() {
        assert_eq!(STM32F407_SECTORS.iter().sum::<usize>(), 1 << 20);
        let board = Board::new(&VirtualClock::new());
        let flash = Flash::new(&STM32F407_SECTORS, &board, 1);
        flash.region::<1, 0x4000>(0..4).unwrap().erase(0, 0x10000).unwrap();
        assert_eq!(board.clock().now_ns(), 4 * 250_000_000);
        flash.region::<1, 0x10000>(4..5).unwrap().erase(0, 0x10000).unwrap();
        assert_eq!(board.clock().now_ns(), 1_550_000_000);
        flash.region::<1, 0x20000>(5..12).unwrap().erase(0, 0x20000).unwrap();
        assert_eq!(board.clock().now_ns(), 2_550_000_000);
    }

    #[test]
    fn regions_of_unequal_or_missing_sectors_are_refused() {
        let Bench { flash, .. } = bench(1);
        let error = flash.region::<4, 64>(1..4).unwrap_err();
        assert_eq!(error, RegionError::SectorSize { sector: 3, len: 256, expected: 64 });
        for sectors in [3..5, 2..2, 9..9] {
            assert!(matches!(
                flash.region::<4, 64>(sectors),
                Err(RegionError::NoSuchSectors { count: 4, .. })
            ));
        }
    }

    #[test]
    fn misuse_is_refused_and_recorded_and_changes_nothing() {
        let Bench { board, flash, mut region } = bench(1);
        region.write(0, &[0xF0; 4]).unwrap();
        let before = flash.snapshot();
        // Even where only bits would be cleared.
        assert_eq!(region.write(0, &[0; 4]), Err(FlashError::NotErased { offset: 0 }));
        let errors = [
            region.write(2, &[0; 4]),
            region.write(4, &[0; 3]),
            region.write(128, &[0; 4]),
            region.write(u32::MAX, &[0; 4]),
            region.erase(0, 32),
            region.erase(64, 0),
            region.erase(0, 192),
            region.read(126, &mut [0; 3]),
        ];
        let kinds = errors.map(|error| error.unwrap_err().kind());
        let aligned = NorFlashErrorKind::NotAligned;
        let bounds = NorFlashErrorKind::OutOfBounds;
        let expected = [aligned, aligned, bounds, bounds, aligned, bounds, bounds, bounds];
        assert_eq!(kinds, expected);
        assert_eq!(flash.snapshot(), before);
        let first = "the byte at 0 is to be programmed but is not erased".to_owned();
        assert_eq!(board.misuse(), Some(Misuse { first, first_at_us: 16, count: 9 }));
    }

    #[test]
    fn without_power_everything_fails_until_it_is_back() {
        let Bench { board, flash, mut region } = bench(1);
        flash.cut_power_after(0);
        assert_eq!(region.erase(0, 64), Err(FlashError::PowerLost));
        assert!(!flash.has_power());
        assert_eq!(region.read(0, &mut [0; 4]), Err(FlashError::PowerLost));
        assert_eq!(region.write(0, &[0; 4]), Err(FlashError::PowerLost));
        assert_eq!(region.erase(0, 64), Err(FlashError::PowerLost));
        flash.power_on();
        assert_eq!(region.write(0, &[0; 4]), Ok(()));
        // Losing power is nobody's fault.
        assert_eq!(board.misuse(), None);
    }

    #[test]
    fn torn_erases_end_anywhere() {
        let mut shares = Vec::new();
        for seed in 0..200 {
            let Bench { flash, mut region, .. } = bench(seed);
            region.write(0, &[0; 128]).unwrap();
            flash.cut_power_after(1);
            assert_eq!(region.erase(0, 128), Err(FlashError::PowerLost));
            flash.power_on();
            let bytes = contents(&mut region);
            assert!(bytes[..64].iter().all(|byte| *byte == 255), "the first sector was done");
            let set: u32 = bytes[64..].iter().map(|byte| byte.count_ones()).sum();
            shares.push(set);
            assert_eq!(flash.wear(), [0, 1, 1, 0]);
        }
        shares.sort();
        assert!(shares[10] < 16 && shares[189] > 512 - 16, "{shares:?}");
    }

    proptest! {
        #[test]
        fn a_torn_write_is_a_prefix_and_part_of_one_word(
            words in prop::collection::vec(any::<[u8; 4]>(), 1..32), cut in 0..128_u64, seed: u64,
        ) {
            let Bench { board, flash, mut region } = bench(seed);
            let bytes = words.concat();
            flash.cut_power_after(cut);
            let cut = cut as usize;
            let written = region.write(0, &bytes);
            prop_assert_eq!(written.is_ok(), cut >= bytes.len());
            flash.power_on();
            let found = contents(&mut region);
            let whole = cut.min(bytes.len()) / 4 * 4;
            prop_assert_eq!(&found[..whole], &bytes[..whole]);
            for (found, byte) in found[whole..].iter().zip(&bytes[whole..]).take(4) {
                // Only bits that were to be cleared are.
                prop_assert_eq!(found & byte, *byte);
            }
            prop_assert!(found[(whole + 4).min(128)..].iter().all(|byte| *byte == 255));
            prop_assert_eq!(board.misuse(), None);
        }

        #[test]
        fn the_seed_decides_what_is_left(seed: u64) {
            let left = |bench: &mut Bench| {
                bench.flash.cut_power_after(0);
                bench.region.erase(0, 64).unwrap_err();
                bench.flash.snapshot()
            };
            let mut bench = bench(seed);
            bench.region.write(0, &[0; 64]).unwrap();
            let written = bench.flash.snapshot();
            let first = left(&mut bench);
            bench.flash.restore(&written, seed);
            prop_assert_eq!(bench.flash.snapshot(), written);
            prop_assert_eq!(left(&mut bench), first);
        }
    }
}
