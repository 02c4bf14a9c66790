//! What a controller and a simulated robot tell each other when they are apart: a frame each way per tick.
//!
//! ```text
//!  controller, in QEMU or on a board                                 plant, on the laptop
//!    tick n: devices read what is in Sensors n
//!            its outputs ──────────── Actuators n + 1 ──────────────►
//!                                                        the robot moves for one tick under them
//!            ◄─────────────────────── Sensors n + 1 ───────────────── and is measured
//!    tick n + 1 …
//! ```
//!
//! The controller keeps the time; the robot's stands still until it hears of the next tick. Before its first
//! tick the controller sends number 0, with everything off. A tick is 10 ms here, of both robots: the loop of
//! the leg has 5 of them per sample, not the 25 of 2 ms by which it usually ticks, since both frames have to
//! be there within one.
//!
//! What is lost is not sent again. Without the sensors of its last frame when a tick begins, a controller's
//! sensors cannot be read in that tick: its loop bears some such ticks in a row, and then switches off, as it
//! would with sensors that broke. A robot that misses a frame moves on under the outputs before it as soon as
//! the next number tells.
//!
//! A frame is that of the link (docs/protocol.md): `COBS( body ‖ CRC-32 ) ‖ 00`. Bodies have fixed fields, the
//! lowest byte first. This file is part of the simulator and of the image for QEMU alike.
//!
//! | offset | size | [`Actuators`] |
//! |---|---|---|
//! | 0 | 1 | robot: 1 the ROSbot, 2 the soft leg |
//! | 1 | 4 | number of the tick; a smaller one than before: the controller was reset |
//! | 5 | 2 × 2 | duties of the motors right, left, or the valves bending, extension; at most [`FULL_DUTY`] |
//! | 9 | 1 | pins, a bit each: motors right, left backwards; lines bending, extension to pressure, input pump, exhaust pump |
//!
//! | offset | size | [`Sensors`] |
//! |---|---|---|
//! | 0 | 1 | robot |
//! | 1 | 4 | number of the tick that is over |
//! | 5 | 2 × 2 | counts of the encoders right, left; 0 of the leg |
//! | 9 | 1 | 1: there is a measured position, 0: there is none |
//! | 10 | 4 | age of that (µs) |
//! | 14 | 3 × 4 | it, as f32: x, y (m), φ (rad), or y, z (mm) and 0 |

use crc::{CRC_32_ISO_HDLC, Crc};

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// Time between two ticks (µs), also of the leg, whose loop could tick faster: frames go to the robot and back
/// in between.
pub const TICK_US: u32 = 10_000;
/// The duty that is the whole supply: 84 MHz / 18 kHz.
pub const FULL_DUTY: u16 = 4666;
/// Longest frame, its final zero included.
pub const MAX_FRAME: usize = 32;
const CHECK: usize = 4;

/// Whose frames they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Robot {
    /// The skid-steered ROSbot.
    Rosbot = 1,
    /// The soft leg.
    SoftLeg = 2,
}

/// What the controller drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Actuators {
    /// Whose.
    pub robot: Robot,
    /// Number of the tick.
    pub tick: u32,
    /// Of [`FULL_DUTY`].
    pub duties: [u16; 2],
    /// A bit each.
    pub pins: u8,
}

/// What the robot measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensors {
    /// Whose.
    pub robot: Robot,
    /// Number of the tick that is over.
    pub tick: u32,
    /// Of the encoders.
    pub counts: [u16; 2],
    /// The coordinates, and how old they are (µs).
    pub position: Option<([f32; 3], u32)>,
}

/// A body.
pub trait Body: Sized {
    /// Writes it.
    fn write(&self, to: &mut Writer);
    /// Reads it; `None` of another one.
    fn read(from: &mut Reader<'_>) -> Option<Self>;

    /// Its frame, the final zero included, and how many bytes of it there are.
    fn frame(&self) -> ([u8; MAX_FRAME], usize) {
        let mut plain = Writer { bytes: [0; MAX_FRAME], length: 0 };
        self.write(&mut plain);
        let check = CRC.checksum(plain.bytes.get(..plain.length).unwrap_or(&[]));
        plain.put(check.to_le_bytes());
        let mut frame = [0; MAX_FRAME];
        let plain = plain.bytes.get(..plain.length).unwrap_or(&[]);
        // There is room for both bodies; what is not written stays zero, and ends the frame.
        let length = cobs::try_encode(plain, &mut frame).unwrap_or(0);
        (frame, length.saturating_add(1).min(MAX_FRAME))
    }
}

/// The fields written so far.
pub struct Writer {
    bytes: [u8; MAX_FRAME],
    length: usize,
}

impl Writer {
    fn put<const N: usize>(&mut self, field: [u8; N]) {
        let end = self.length.saturating_add(N);
        if let Some(place) = self.bytes.get_mut(self.length..end) {
            place.copy_from_slice(&field);
            self.length = end;
        }
    }

    fn pair(&mut self, [first, second]: [u16; 2]) {
        self.put(first.to_le_bytes());
        self.put(second.to_le_bytes());
    }
}

/// The fields that are still to be read.
pub struct Reader<'b>(&'b [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (field, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*field)
    }

    fn robot(&mut self) -> Option<Robot> {
        match self.take()? {
            [1] => Some(Robot::Rosbot),
            [2] => Some(Robot::SoftLeg),
            _ => None,
        }
    }

    fn pair(&mut self) -> Option<[u16; 2]> {
        Some([u16::from_le_bytes(self.take()?), u16::from_le_bytes(self.take()?)])
    }
}

impl Body for Actuators {
    fn write(&self, to: &mut Writer) {
        to.put([self.robot as u8]);
        to.put(self.tick.to_le_bytes());
        to.pair(self.duties);
        to.put([self.pins]);
    }

    fn read(from: &mut Reader<'_>) -> Option<Self> {
        let (robot, tick) = (from.robot()?, u32::from_le_bytes(from.take()?));
        let (duties, [pins]) = (from.pair()?, from.take()?);
        Some(Self { robot, tick, duties, pins })
    }
}

impl Body for Sensors {
    fn write(&self, to: &mut Writer) {
        let (position, age_us) = self.position.unwrap_or_default();
        to.put([self.robot as u8]);
        to.put(self.tick.to_le_bytes());
        to.pair(self.counts);
        to.put([u8::from(self.position.is_some())]);
        to.put(age_us.to_le_bytes());
        for x in position {
            to.put(x.to_le_bytes());
        }
    }

    fn read(from: &mut Reader<'_>) -> Option<Self> {
        let (robot, tick) = (from.robot()?, u32::from_le_bytes(from.take()?));
        let (counts, [is_there]) = (from.pair()?, from.take()?);
        let age_us = u32::from_le_bytes(from.take()?);
        let mut position = [0.0; 3];
        for x in &mut position {
            *x = f32::from_le_bytes(from.take()?);
        }
        let position = (is_there == 1).then_some((position, age_us));
        Some(Self { robot, tick, counts, position })
    }
}

/// Finds bodies in a stream of bytes; what is damaged is dropped.
#[derive(Clone, Debug)]
pub struct Receiver {
    frame: [u8; MAX_FRAME],
    length: usize,
}

impl Default for Receiver {
    fn default() -> Self {
        Self::new()
    }
}

impl Receiver {
    /// Nothing received.
    pub fn new() -> Self {
        Self { frame: [0; MAX_FRAME], length: 0 }
    }

    /// Takes a byte; what it completed.
    pub fn push<B: Body>(&mut self, byte: u8) -> Option<B> {
        if byte != 0 {
            if let Some(place) = self.frame.get_mut(self.length) {
                *place = byte;
            }
            // Beyond the end, a frame is too long.
            self.length = self.length.saturating_add(1);
            return None;
        }
        let frame = self.frame.get_mut(..core::mem::take(&mut self.length))?;
        let length = cobs::decode_in_place(frame).ok()?;
        let (body, check) = frame.get(..length)?.split_last_chunk::<CHECK>()?;
        let mut reader = Reader(body);
        let read = B::read(&mut reader).filter(|_| reader.0.is_empty());
        read.filter(|_| CRC.checksum(body) == u32::from_le_bytes(*check))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACTUATORS: Actuators =
        Actuators { robot: Robot::Rosbot, tick: 258, duties: [4666, 0], pins: 2 };
    const SENSORS: Sensors = Sensors {
        robot: Robot::SoftLeg,
        tick: u32::MAX,
        counts: [0, 65_535],
        position: Some(([1.5, -2.0, f32::MIN_POSITIVE], 50_000)),
    };

    fn received<B: Body>(bytes: &[u8]) -> Vec<B> {
        let mut receiver = Receiver::new();
        bytes.iter().filter_map(|byte| receiver.push(*byte)).collect()
    }

    #[test]
    fn bytes_are_those_of_the_tables() {
        let (frame, length) = ACTUATORS.frame();
        // Zeros: the two upper bytes of the tick, and both of the left duty.
        let body = [4, 1, 2, 1, 1, 3, 0x3A, 0x12, 1, 6, 2];
        assert_eq!(frame[..body.len()], body);
        assert_eq!(received::<Actuators>(&frame[..length]), [ACTUATORS]);
        assert_eq!(received::<Sensors>(&frame[..length]), []);
        for sensors in [SENSORS, Sensors { position: None, ..SENSORS }] {
            let (frame, length) = sensors.frame();
            assert_eq!((frame[length - 1], length), (0, MAX_FRAME));
            assert_eq!(received::<Sensors>(&frame[..length]), [sensors]);
        }
    }

    #[test]
    fn damage_is_dropped_and_the_next_frame_arrives() {
        let (frame, length) = SENSORS.frame();
        let (next, next_length) = Sensors { tick: 7, ..SENSORS }.frame();
        for i in 0..length {
            for bit in 0..8 {
                let mut bytes = frame[..length].to_vec();
                bytes[i] ^= 1 << bit;
                bytes.push(0);
                bytes.extend_from_slice(&next[..next_length]);
                assert_eq!(
                    received::<Sensors>(&bytes),
                    [Sensors { tick: 7, ..SENSORS }],
                    "{i} {bit}"
                );
            }
        }
        let endless = [&[1; 1000], &[0][..], &next[..next_length]].concat();
        assert_eq!(received::<Sensors>(&endless).len(), 1);
    }
}
