//! One request at a time, repeated until its answer comes: no line and no clock of its own.
//!
//! A request keeps its number when it is repeated, and an answer is known by that number; whatever else
//! arrives (telemetry, answers to what was asked before, damaged frames) is passed over.
//!
//! # When to repeat
//!
//! The time-out is four times the smoothed round trip, within [`LEAST_US`] and [`MOST_US`]. Nothing here
//! gets better by waiting: a frame that was damaged on a noisy line is best sent again at once. But a
//! controller that is busy, or a line that is longer than was measured, gets worse by asking. Which of the
//! two it is cannot be known, so that waits follow the sequence 1, 1, 2, 1, 1, 2, 4, … (times the
//! time-out) of Luby, Sinclair & Zuckerman 1993, "Optimal speedup of Las Vegas algorithms": most are
//! short, and all powers of two come up to [`REPEATED_US`].
//!
//! - A damaged frame may have been the answer: the request is repeated after [`LEAST_US`].
//! - An answer that comes twice says that the request was repeated too early: the time-out doubles.
//!
//! ```
//! use firmware_core::link::{MAX_FRAME, Message, encode};
//! use firmware_core::update::{Answer, Ask, Refused, Say};
//! use trainer::exchange::Exchange;
//!
//! let mut exchange = Exchange::new(7, None);
//! exchange.ask(Ask::Verify { session: 1 }, 0);
//! let mut out = Vec::new();
//! exchange.send(0, &mut out);
//! let once = out.len();
//! exchange.send(149_999, &mut out);
//! assert_eq!(out.len(), once); // not yet
//! exchange.send(150_000, &mut out);
//! assert_eq!(out[..once], out[once..]);
//!
//! let mut frame = [0; MAX_FRAME];
//! let mut answer = |number| {
//!     let say = Say::Refused(Refused::NoSession);
//!     let length = encode(&Message::Answer(Answer { number, say }), &mut frame).unwrap();
//!     let said = frame[..length].iter().filter_map(|byte| exchange.push(*byte, 160_000));
//!     said.last()
//! };
//! assert_eq!(answer(6), None); // to another request
//! assert_eq!(answer(7), Some(Say::Refused(Refused::NoSession)));
//! ```

use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_core::update::{Answer, Ask, Refused, Request, Say};

/// Time-out while no round trip has been measured (µs).
pub const FIRST_US: u64 = 150_000;
/// Shortest time-out (µs).
pub const LEAST_US: u64 = 15_000;
/// Longest time-out (µs).
pub const MOST_US: u64 = 500_000;
/// Longest wait for an answer to a repeated request (µs).
pub const REPEATED_US: u64 = 1_000_000;

/// What went over the line so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Requests, each counted once.
    pub requests: u32,
    /// How often one was sent again.
    pub repeated: u32,
    /// Bytes sent.
    pub sent: u64,
    /// Damaged frames received.
    pub damaged: u32,
    /// Telemetry frames received.
    pub frames: u32,
}

/// The host's end of the line.
#[derive(Clone, Debug)]
pub struct Exchange {
    receiver: Receiver,
    /// Shortest time-out on this line (µs).
    least_us: u64,
    /// Smoothed (µs).
    round_trip_us: Option<u64>,
    /// Of the next request.
    number: u8,
    pending: Option<Pending>,
    /// Number of the last request, while a second answer to it would come too early.
    before: Option<u8>,
    counts: Counts,
}

#[derive(Clone, Debug)]
struct Pending {
    number: u8,
    ask: Ask,
    frame: Vec<u8>,
    /// When it was sent last.
    sent_us: Option<u64>,
    due_us: u64,
    /// The next repetition is because of a damaged frame.
    hurries: bool,
    /// Some repetition was.
    hurried: bool,
    waits: Luby,
}

/// 1, 1, 2, 1, 1, 2, 4, …: by Knuth's "reluctant doubling".
#[derive(Clone, Copy, Debug)]
struct Luby {
    u: u32,
    v: u32,
}

impl Luby {
    fn new() -> Self {
        Self { u: 1, v: 1 }
    }

    fn advance(&mut self) {
        if self.u & self.u.wrapping_neg() == self.v {
            *self = Self { u: self.u.wrapping_add(1), v: 1 };
        } else {
            self.v = self.v.saturating_mul(2);
        }
    }
}

impl Exchange {
    /// Nothing asked. `first` is the number of the first request; `baud` the bits/s of the line, where
    /// that is known: no request is repeated before it and its answer can have passed.
    pub fn new(first: u8, baud: Option<u32>) -> Self {
        // A request, the telemetry frame that is on the way, and the answer; a byte takes ten bits.
        let bits = 3 * 10 * MAX_FRAME as u64;
        let line_us = baud.map_or(0, |baud| bits * 1_000_000 / u64::from(baud.max(1)));
        Self {
            receiver: Receiver::new(),
            least_us: line_us.max(LEAST_US),
            round_trip_us: None,
            number: first.max(1),
            pending: None,
            before: None,
            counts: Counts::default(),
        }
    }

    /// What went over the line so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Asks something new, from `now_us` on; what was asked before is forgotten.
    pub fn ask(&mut self, ask: Ask, now_us: u64) {
        self.forget();
        let number = self.number;
        // 0 is the number of an answer to what could not be read.
        self.number = self.number.checked_add(1).unwrap_or(1);
        let message = Message::Request(Request { number, ask });
        let mut frame = [0; MAX_FRAME];
        // There is room for every message.
        let length = encode(&message, &mut frame).unwrap_or(0);
        let Message::Request(Request { ask, .. }) = message else { return };
        self.pending = Some(Pending {
            number,
            ask,
            frame: frame[..length].to_vec(),
            sent_us: None,
            due_us: now_us,
            hurries: false,
            hurried: false,
            waits: Luby::new(),
        });
    }

    /// Asks no longer.
    pub fn forget(&mut self) {
        if let Some(pending) = self.pending.take() {
            self.before = Some(pending.number).filter(|_| !pending.hurried);
        }
    }

    fn time_out_us(&self) -> u64 {
        let most_us = MOST_US.max(self.least_us);
        self.round_trip_us.map_or(FIRST_US, |us| 4 * us).clamp(self.least_us, most_us)
    }

    /// Takes a byte at `now_us`; the answer that it completes. After [`Say::Working`] and
    /// [`Refused::Working`] the request waits on, after any other answer it is over.
    pub fn push(&mut self, byte: u8, now_us: u64) -> Option<Say> {
        match self.receiver.push(byte)? {
            Received::Message(Message::Answer(answer)) => self.answer(answer, now_us),
            Received::Message(Message::Frame(_)) => {
                self.counts.frames += 1;
                None
            }
            Received::Message(_) | Received::Unknown { .. } => None,
            Received::Damaged | Received::TooLong => {
                self.counts.damaged += 1;
                self.hurry(now_us);
                None
            }
        }
    }

    /// The request or its answer seems to have been damaged.
    fn hurry(&mut self, now_us: u64) {
        if let Some(pending) = &mut self.pending
            && let Some(sent_us) = pending.sent_us
        {
            let at_us = now_us.max(sent_us + self.least_us);
            if at_us < pending.due_us {
                pending.due_us = at_us;
                pending.hurries = true;
            }
        }
    }

    fn answer(&mut self, Answer { number, say }: Answer, now_us: u64) -> Option<Say> {
        if number == 0 {
            // Something arrived there that was none of the requests.
            self.hurry(now_us);
            return None;
        }
        if self.before == Some(number) {
            self.before = None;
            self.round_trip_us = Some(self.time_out_us() / 2);
            return None;
        }
        let time_out_us = self.time_out_us();
        let pending = self.pending.as_mut().filter(|pending| pending.number == number)?;
        let sent_us = pending.sent_us.filter(|_| fits(&pending.ask, &say))?;
        let wait_us = match say {
            Say::Working { most_ms } => Some((1000 * u64::from(most_ms)).min(REPEATED_US)),
            Say::Refused(Refused::Working) => Some(time_out_us),
            _ => None,
        };
        match wait_us {
            Some(us) => {
                pending.due_us = now_us + us;
                pending.hurries = false;
                // How long that takes says nothing of the line.
                pending.hurried = true;
            }
            None => {
                self.forget();
                // If this is the answer to an earlier sending, the time is too short; then a second one comes.
                let us = now_us.saturating_sub(sent_us);
                // What was erased before this answer says nothing of the line.
                if !matches!(say, Say::Begun { .. }) {
                    let smoothed =
                        self.round_trip_us.map_or(us, |smoothed| (7 * smoothed + us) / 8);
                    self.round_trip_us = Some(smoothed);
                }
            }
        }
        Some(say)
    }

    /// Whether a request was sent and is to be repeated at `now_us`.
    pub fn is_overdue(&self, now_us: u64) -> bool {
        self.pending.as_ref().is_some_and(|p| p.sent_us.is_some() && now_us >= p.due_us)
    }

    /// Puts what is to be sent at `now_us` behind `out`.
    pub fn send(&mut self, now_us: u64, out: &mut Vec<u8>) {
        let time_out_us = self.time_out_us();
        let Some(pending) = self.pending.as_mut().filter(|p| now_us >= p.due_us) else { return };
        if pending.sent_us.is_none() {
            self.counts.requests += 1;
        } else {
            self.counts.repeated += 1;
            if pending.hurries {
                pending.hurried = true;
            } else {
                pending.waits.advance();
            }
        }
        pending.hurries = false;
        pending.sent_us = Some(now_us);
        let wait_us = (time_out_us * u64::from(pending.waits.v)).min(REPEATED_US.max(time_out_us));
        pending.due_us = now_us + wait_us;
        self.counts.sent += pending.frame.len() as u64;
        out.extend_from_slice(&pending.frame);
    }

    /// When [`send`](Self::send) has something to do; `None` while nothing is asked (µs).
    pub fn due_us(&self) -> Option<u64> {
        self.pending.as_ref().map(|pending| pending.due_us)
    }
}

/// Whether this can be an answer to that: numbers come round, and a controller may have been asked by
/// others before.
fn fits(ask: &Ask, say: &Say) -> bool {
    matches!(
        (ask, say),
        (_, Say::Refused(_))
            | (Ask::Hello, Say::Hello(_))
            | (Ask::Begin { .. }, Say::Working { .. } | Say::Begun { .. })
            | (Ask::Chunk { .. }, Say::Written { .. })
            | (Ask::Verify { .. }, Say::Verified)
            | (Ask::Activate { .. }, Say::Activated)
            | (Ask::Confirm { .. }, Say::Confirmed)
            | (Ask::Abort { .. }, Say::Aborted)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(number: u8, say: Say) -> Vec<u8> {
        let mut frame = [0; MAX_FRAME];
        let length = encode(&Message::Answer(Answer { number, say }), &mut frame).unwrap();
        frame[..length].to_vec()
    }

    fn hear(exchange: &mut Exchange, bytes: &[u8], now_us: u64) -> Option<Say> {
        bytes.iter().filter_map(|byte| exchange.push(*byte, now_us)).last()
    }

    /// When a request is sent that nobody answers, from `now_us` on.
    fn sendings(exchange: &mut Exchange, now_us: u64, count: usize) -> Vec<u64> {
        exchange.ask(Ask::Hello, now_us);
        (0..count)
            .map(|_| {
                let due_us = exchange.due_us().unwrap();
                let mut out = Vec::new();
                if let Some(early_us) = due_us.checked_sub(1) {
                    exchange.send(early_us, &mut out);
                    assert!(out.is_empty());
                }
                exchange.send(due_us, &mut out);
                assert!(!out.is_empty());
                due_us
            })
            .collect()
    }

    #[test]
    fn waits_are_mostly_short() {
        let mut exchange = Exchange::new(1, None);
        let sent: Vec<u64> = sendings(&mut exchange, 0, 16);
        let waits: Vec<u64> = sent.windows(2).map(|pair| (pair[1] - pair[0]) / 1000).collect();
        let expected = [150, 150, 300, 150, 150, 300, 600, 150, 150, 300, 150, 150, 300, 600, 1000];
        assert_eq!(waits, expected);
    }

    #[test]
    fn the_time_out_follows_the_line() {
        let mut exchange = Exchange::new(255, None);
        let verified = |number| answer(number, Say::Verified);
        let mut now_us = 0;
        for number in [255, 1, 2] {
            exchange.ask(Ask::Verify { session: 1 }, now_us);
            exchange.send(now_us, &mut Vec::new());
            now_us += 20_000;
            assert_eq!(hear(&mut exchange, &verified(number), now_us), Some(Say::Verified));
        }
        let sent = sendings(&mut exchange, now_us, 2);
        assert_eq!(sent[1] - sent[0], 80_000);
        // A second answer to what was answered.
        exchange.ask(Ask::Verify { session: 1 }, now_us);
        exchange.send(now_us, &mut Vec::new());
        assert!(hear(&mut exchange, &verified(4), now_us + 20_000).is_some());
        for _ in 0..2 {
            assert_eq!(hear(&mut exchange, &verified(4), now_us + 20_000), None);
        }
        let sent = sendings(&mut exchange, now_us, 2);
        assert_eq!(sent[1] - sent[0], 160_000, "doubled once");
        // No answer can have passed earlier.
        let mut exchange = Exchange::new(1, Some(9600));
        let sent = sendings(&mut exchange, 0, 2);
        assert_eq!(sent[1], 800_000);
    }

    #[test]
    fn damage_is_answered_at_once() {
        let mut exchange = Exchange::new(1, Some(576_000));
        exchange.ask(Ask::Hello, 0);
        exchange.send(0, &mut Vec::new());
        hear(&mut exchange, &[1, 2, 3, 0], 4_000);
        assert_eq!(exchange.due_us(), Some(LEAST_US));
        exchange.send(LEAST_US, &mut Vec::new());
        let nothing = Say::Refused(Refused::TooLong { most: 256 });
        hear(&mut exchange, &answer(0, nothing), LEAST_US + 40_000);
        assert_eq!(exchange.due_us(), Some(LEAST_US + 40_000));
        assert_eq!(exchange.counts().repeated, 1);
    }

    #[test]
    fn who_works_is_not_hurried() {
        let mut exchange = Exchange::new(1, None);
        let begin = |exchange: &mut Exchange, now_us| {
            let release = firmware_core::slots::Release::new("r", 0, b"b").unwrap();
            let signature = Default::default();
            exchange.ask(Ask::Begin { session: 1, release, signature }, now_us);
            exchange.send(now_us, &mut Vec::new());
        };
        begin(&mut exchange, 0);
        let working = Say::Working { most_ms: 4000 };
        assert_eq!(hear(&mut exchange, &answer(1, working.clone()), 1_000), Some(working));
        assert_eq!(exchange.due_us(), Some(1_001_000));
        // What does not fit the request is none of its answers.
        assert_eq!(hear(&mut exchange, &answer(1, Say::Verified), 2_000), None);
        let begun = Say::Begun { written: 0 };
        assert_eq!(hear(&mut exchange, &answer(1, begun.clone()), 900_000), Some(begun));
        assert_eq!((exchange.due_us(), exchange.round_trip_us), (None, None));
        begin(&mut exchange, 900_000);
        let busy = Say::Refused(Refused::Working);
        assert_eq!(hear(&mut exchange, &answer(2, busy.clone()), 901_000), Some(busy));
        assert_eq!(exchange.due_us(), Some(901_000 + FIRST_US));
    }
}
