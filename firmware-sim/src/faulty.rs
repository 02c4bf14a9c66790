//! Devices that show the faults of a schedule.
//!
//! Each wraps a device with the same trait and is transparent while none of its faults is active.

use crate::fault::{FaultKind, Faults};
use embedded_io::{ErrorType, Read, ReadReady, Write, WriteReady};
use firmware_core::device::{EncoderCount, MonotonicClock, PositionSensor};
use std::collections::VecDeque;

/// Share of the measurements that a spike hits.
const SPIKE_SHARE: f64 = 0.1;

/// A position sensor with dropouts, NaN, freezes, spikes and delays.
///
/// ```
/// use firmware_core::device::PositionSensor;
/// use firmware_sim::{fault::{FaultKind, Faults}, faulty::FaultySensor};
/// use firmware_sim::mcu::{MotionCapture, VirtualClock, Wire};
/// use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
///
/// let (clock, tip) = (VirtualClock::new(), Wire::new([1.5, -2.0]));
/// let faults = Faults::new(&clock, ["dropout@0..1=1".parse()?], 1);
/// let sensor = MotionCapture::new(&tip, &clock, MotionCaptureSettings::exact(50_000.try_into()?), 1);
/// let mut sensor = FaultySensor::new(sensor, &faults, [10.0, 10.0]);
/// assert_eq!(sensor.measure()?, None);
/// clock.advance_us(1_000_000);
/// assert_eq!(sensor.measure()?, Some([1.5, -2.0]));
/// assert_eq!(faults.injected(FaultKind::Dropout), 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct FaultySensor<D, const N: usize> {
    device: D,
    faults: Faults,
    spike: [f32; N],
    last: Option<[f32; N]>,
    /// Measurements on their way, each with the times of its measurement and its arrival (µs).
    delayed: VecDeque<(u64, u64, [f32; N])>,
    age_us: u32,
}

impl<D, const N: usize> FaultySensor<D, N> {
    /// Wraps a sensor. A spike of intensity 1 adds or takes `spike`, in the units of the coordinates.
    pub fn new(device: D, faults: &Faults, spike: [f32; N]) -> Self {
        Self {
            device,
            faults: faults.clone(),
            spike,
            last: None,
            delayed: VecDeque::new(),
            age_us: 0,
        }
    }

    /// What becomes of a measurement before it sets out.
    fn spoil(&mut self, mut measured: [f32; N]) -> Option<[f32; N]> {
        let faults = &self.faults;
        if faults.strikes(FaultKind::Dropout, None) {
            return None;
        }
        match self.last {
            Some(last) if faults.strikes(FaultKind::Freeze, None) => measured = last,
            _ => self.last = Some(measured),
        }
        if let Some(spike) = faults.worst(FaultKind::Spike, None)
            && spike.uniform() < SPIKE_SHARE
        {
            let sign = if spike.uniform() < 0.5 { 1.0 } else { -1.0 };
            let at = coordinate::<N>(spike.fault.unit(), spike.uniform());
            if let (Some(value), Some(most)) = (measured.get_mut(at), self.spike.get(at)) {
                *value += (sign * spike.fault.intensity()) as f32 * most;
                spike.count();
            }
        }
        if let Some(nan) = faults.worst(FaultKind::Nan, None)
            && nan.uniform() < nan.fault.intensity()
            && let Some(value) = measured.get_mut(coordinate::<N>(nan.fault.unit(), nan.uniform()))
        {
            *value = f32::NAN;
            nan.count();
        }
        Some(measured)
    }
}

/// The coordinate that a fault hits: its unit, or by a uniform draw.
fn coordinate<const N: usize>(unit: Option<usize>, uniform: f64) -> usize {
    unit.unwrap_or((uniform * N as f64) as usize)
}

impl<D: PositionSensor<N>, const N: usize> PositionSensor<N> for FaultySensor<D, N> {
    type Error = D::Error;

    fn measure(&mut self) -> Result<Option<[f32; N]>, D::Error> {
        let measured = self.device.measure()?.and_then(|measured| self.spoil(measured));
        let now_us = self.faults.clock().now_us();
        if let Some(measured) = measured {
            let delay_s = self.faults.act(FaultKind::Delay, None).unwrap_or(0.0);
            self.delayed.push_back((now_us, now_us + (delay_s * 1e6) as u64, measured));
        }
        // The newest that is there; what it overtook is of no use any more.
        let arrived = self.delayed.iter().rposition(|(_, arrival_us, _)| *arrival_us <= now_us);
        let newest = arrived.and_then(|last| self.delayed.drain(..=last).next_back());
        Ok(newest.map(|(measured_us, _, measured)| {
            self.age_us = u32::try_from(now_us - measured_us).unwrap_or(u32::MAX);
            measured
        }))
    }

    fn age_us(&self) -> u32 {
        self.age_us.saturating_add(self.device.age_us())
    }
}

/// An encoder that misses counts, or starts near its wrap.
#[derive(Debug)]
pub struct FaultyEncoder<D> {
    device: D,
    faults: Faults,
    side: usize,
    /// The device's last count, and ours.
    last: Option<(u16, u16)>,
    start: u16,
}

impl<D> FaultyEncoder<D> {
    /// Wraps the encoder of a side: 0 right, 1 left.
    pub fn new(device: D, faults: &Faults, side: usize) -> Self {
        let wrap = faults.of(FaultKind::Wrap, Some(side)).next();
        let start = wrap.map_or(0, |wrap| (65_535.0 * wrap.fault.intensity()) as u16);
        Self { device, faults: faults.clone(), side, last: None, start }
    }
}

impl<D: EncoderCount> EncoderCount for FaultyEncoder<D> {
    type Error = D::Error;

    fn count(&mut self) -> Result<u16, D::Error> {
        let read = self.device.count()?;
        let (last_read, last) = self.last.unwrap_or((read, read.wrapping_add(self.start)));
        let turned = read.wrapping_sub(last_read) as i16;
        let side = Some(self.side);
        let missed = if self.faults.worst(FaultKind::MissedCounts, side).is_some() {
            let each = 0..turned.unsigned_abs();
            each.filter(|_| self.faults.strikes(FaultKind::MissedCounts, side)).count() as i16
        } else {
            0
        };
        let seen = turned.wrapping_sub(missed.wrapping_mul(turned.signum()));
        let count = last.wrapping_add_signed(seen);
        if last.checked_add_signed(seen).is_none()
            && let Some(wrap) = self.faults.of(FaultKind::Wrap, side).next()
        {
            wrap.count();
        }
        self.last = Some((read, count));
        Ok(count)
    }
}

/// The host's end of a line, which sends into the void while it is silenced.
#[derive(Debug)]
pub struct FaultyHost<D> {
    device: D,
    faults: Faults,
}

impl<D> FaultyHost<D> {
    /// Wraps the host's end of a line.
    pub fn new(device: D, faults: &Faults) -> Self {
        Self { device, faults: faults.clone() }
    }

    /// The end itself.
    pub fn inner(&self) -> &D {
        &self.device
    }
}

impl<D: ErrorType> ErrorType for FaultyHost<D> {
    type Error = D::Error;
}

impl<D: Read> Read for FaultyHost<D> {
    fn read(&mut self, buf: &mut [u8]) -> Result<usize, D::Error> {
        self.device.read(buf)
    }
}

impl<D: ReadReady> ReadReady for FaultyHost<D> {
    fn read_ready(&mut self) -> Result<bool, D::Error> {
        self.device.read_ready()
    }
}

impl<D: Write> Write for FaultyHost<D> {
    fn write(&mut self, buf: &[u8]) -> Result<usize, D::Error> {
        if self.faults.strikes(FaultKind::Silence, None) {
            return Ok(buf.len());
        }
        self.device.write(buf)
    }

    fn flush(&mut self) -> Result<(), D::Error> {
        self.device.flush()
    }
}

impl<D: WriteReady> WriteReady for FaultyHost<D> {
    fn write_ready(&mut self) -> Result<bool, D::Error> {
        self.device.write_ready()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mcu::position_sensor::MotionCaptureSettings;
    use crate::mcu::{Encoder, MotionCapture, VirtualClock, Wire};
    use proptest::prelude::*;
    use std::f64::consts::TAU;
    use std::num::{NonZeroU32, NonZeroU64};

    const PERIOD_US: u64 = 10_000;

    /// What a sensor says every 10 ms for 1 s, with its coordinates at (t, 100 + t) in ticks.
    fn measured(text: &str) -> (Vec<Option<[f32; 2]>>, Faults) {
        let clock = VirtualClock::new();
        let wire = Wire::new([0.0, 100.0]);
        let faults = Faults::new(&clock, [text.parse().unwrap()], 5);
        let settings = MotionCaptureSettings::exact(NonZeroU64::new(PERIOD_US).unwrap());
        let sensor = MotionCapture::new(&wire, &clock, settings, 1);
        let mut sensor = FaultySensor::new(sensor, &faults, [1000.0, 1000.0]);
        let said = (0..100).map(|tick| {
            wire.set([f64::from(tick), 100.0 + f64::from(tick)]);
            let said = sensor.measure().unwrap();
            clock.advance_us(PERIOD_US);
            said
        });
        (said.collect(), faults)
    }

    fn truth(tick: usize) -> Option<[f32; 2]> {
        Some([tick as f32, 100.0 + tick as f32])
    }

    #[test]
    fn dropouts_are_as_frequent_as_they_should_be() {
        let (said, faults) = measured("dropout@0.2..0.8=0.5");
        let missing = said.iter().filter(|said| said.is_none()).count();
        assert_eq!(faults.injected(FaultKind::Dropout), missing as u64);
        assert!((15..45).contains(&missing), "{missing}");
        assert!(
            (0..100).all(|t| said[t].is_none() && (20..80).contains(&t) || said[t] == truth(t))
        );
    }

    #[test]
    fn nan_hits_the_coordinate_it_is_told_to() {
        let (said, faults) = measured("nan:1@0.5..0.6=1");
        assert_eq!(faults.injected(FaultKind::Nan), 10);
        for (tick, said) in said.iter().enumerate() {
            let [y, z] = said.unwrap();
            assert_eq!(y, tick as f32);
            assert_eq!(z.is_nan(), (50..60).contains(&tick));
        }
    }

    #[test]
    fn a_frozen_sensor_repeats_itself_until_it_thaws() {
        let (said, faults) = measured("freeze@0.5..0.6=1");
        assert_eq!(faults.injected(FaultKind::Freeze), 10);
        let expected = |t| if (50..60).contains(&t) { truth(49) } else { truth(t) };
        assert!((0..100).all(|t| said[t] == expected(t)));
    }

    #[test]
    fn spikes_are_rare_and_of_their_size() {
        let (said, faults) = measured("spike@0..1=0.25");
        let off = |t: usize| {
            let [a, b] = [0, 1].map(|i| (said[t].unwrap()[i] - truth(t).unwrap()[i]).abs());
            assert!([(0.0, 0.0), (0.0, 250.0), (250.0, 0.0)].contains(&(a, b)));
            a + b > 0.0
        };
        let hit = (0..100).filter(|&t| off(t)).count();
        assert_eq!(faults.injected(FaultKind::Spike), hit as u64);
        assert!((2..22).contains(&hit), "{hit}");
    }

    #[test]
    fn delayed_measurements_arrive_in_order() {
        let (said, faults) = measured("delay@0.2..0.5=0.04");
        assert_eq!(faults.injected(FaultKind::Delay), 30);
        for (tick, said) in said.into_iter().enumerate() {
            let expected = match tick {
                20..24 => None,
                24..50 => truth(tick - 4),
                // The first that is not delayed overtakes four.
                _ => truth(tick),
            };
            assert_eq!(said, expected, "tick {tick}");
        }
    }

    proptest! {
        #[test]
        fn encoders_miss_their_share_and_wrap_unnoticed(
            turns in prop::collection::vec(-200.0..200.0_f64, 1..50), seed in 0..100_u64,
        ) {
            let clock = VirtualClock::new();
            let angle = Wire::new(0.0);
            let faults = ["wrap@0..1=0.9999".parse().unwrap()];
            let faults = Faults::new(&clock, faults, seed);
            let encoder = || Encoder::new(&angle, NonZeroU32::new(1632).unwrap());
            let mut true_encoder = encoder();
            let mut wrapping = FaultyEncoder::new(encoder(), &faults, 1);
            prop_assert_eq!(wrapping.count().unwrap(), 65_528);
            let missing = Faults::new(&clock, ["missed-counts:1@0..1=1".parse().unwrap()], seed);
            let mut missing = FaultyEncoder::new(encoder(), &missing, 1);
            prop_assert_eq!(missing.count().unwrap(), 0);
            for turn in turns {
                angle.set(angle.get() + turn / 1632.0 * TAU);
                let count = true_encoder.count().unwrap();
                prop_assert_eq!(wrapping.count().unwrap(), count.wrapping_add(65_528));
                prop_assert_eq!(missing.count().unwrap(), 0);
            }
        }
    }

    #[test]
    fn missed_counts_and_wraps_are_counted() {
        let clock = VirtualClock::new();
        let angle = Wire::new(0.0);
        let faults = ["wrap@0..1=1".parse().unwrap(), "missed-counts@0..1=0.1".parse().unwrap()];
        let faults = Faults::new(&clock, faults, 3);
        let encoder = Encoder::new(&angle, NonZeroU32::new(1000).unwrap());
        let mut encoder = FaultyEncoder::new(encoder, &faults, 0);
        assert_eq!(encoder.count().unwrap(), 65_535);
        angle.set(TAU);
        let count = encoder.count().unwrap();
        let missed = faults.injected(FaultKind::MissedCounts);
        assert_eq!(u64::from(count), 999 - missed);
        // Five standard deviations: 100 ± 47.
        assert!((53..147).contains(&missed), "{missed}");
        assert_eq!(faults.injected(FaultKind::Wrap), 1);
    }
}
