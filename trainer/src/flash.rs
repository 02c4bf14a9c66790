//! Installing a model on a controller: the host's end of [an update](firmware_core::update).
//!
//! ```text
//! Hello ──> compare ──> Begin ──> Chunk … ──> Verify ──> Activate ──> (reset) Hello ──> trial ──> Confirm
//!                         ▲          │           │           │            │
//!                         └──────────┴───────────┴───────────┘            └──> the old model runs: refused
//!                          the session is over: go on where it ended
//! ```
//!
//! [`Flashing`] has no line, no clock and no thread: [`poll`](Flashing::poll) takes the time and what has
//! arrived, and gives what is to be sent. Requests are repeated as [`exchange`](crate::exchange) says. On a
//! noisy line chunks are halved, down to [`LEAST_CHUNK`], because a short frame arrives where a long one
//! does not. Nothing waits for ever: without a step forward for [`PATIENCE_US`] it gives up, and the same
//! command goes on where it stopped, because the controller knows what it has.
//!
//! What is a step forward: an answer that the update goes on from, more bytes written, more good ticks of the
//! trial than there were.
//!
//! A model of 4 KB at 576,000 baud, from Hello to Confirmed, with 0.25 s to erase and a trial of 0.5 s
//! (`cargo test --release -p integration-tests --test flash -- --include-ignored --nocapture`):
//!
//! | of the bytes each lost, doubled and flipped | arrived | time, median (most) | requests repeated, median (most) |
//! |---|---|---|---|
//! | none | all | 1.1 s | 4 |
//! | 0.1 % | 100 of 100 | 1.5 s (1.8 s) | 25 (40) |
//! | 1 % | 998 of 1,000 | 20 s (56 s) | 886 (1,332) |

use std::fmt;

use firmware_core::control_loop::Mode;
use firmware_core::link::{MAX_FRAME, Message, encode};
use firmware_core::model::Model;
use firmware_core::slots::{Release, Which, robot};
use firmware_core::update::{
    Ask, Hello, MAX_CHUNK, Misfit, PROTOCOL, Purpose, Refused, Say, Signature, Trial,
};

use crate::exchange::{Counts, Exchange};
use crate::report::{grouped, hexadecimal};
use crate::signing::SignedRelease;

/// Longest time without a step forward (µs).
pub const PATIENCE_US: u64 = 30_000_000;
/// Longest wait for the end of another host's session (µs): the controller ends it after five seconds.
pub const IN_USE_US: u64 = 8_000_000;
/// Shortest chunk on a noisy line (bytes).
pub const LEAST_CHUNK: usize = 16;
/// Time from one question how the trial goes to the next (µs).
const TRIAL_US: u64 = 200_000;
/// Time from one attempt to the next while others use the controller, and while it is about to reset (µs).
const AGAIN_US: u64 = 250_000;
/// Failures in a row after which chunks are halved, and successes after which they double.
const FAILURES: u32 = 2;
const SUCCESSES: u32 = 8;
/// How often an update begins again whose session is over.
const MOST_BEGINS: u32 = 16;
/// How often a session may be over where the model should have been activated.
const MOST_LOST: u32 = 3;
/// How often a trial may stumble and still be waited for.
const MOST_STUMBLES: u32 = 10;
/// Longest time to erase a slot that is believed (µs).
const ERASE_US: u64 = 300_000_000;

/// How to install.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// Number of the session, drawn at random.
    pub session: u32,
    /// Bits/s of the line, where that is known.
    pub baud: Option<u32>,
    /// Ask and compare, no more.
    pub dry_run: bool,
    /// Stop when the model runs on trial.
    pub trial: bool,
    /// Stop a running robot, each time that it is in the way.
    pub stop: bool,
}

/// Why a model is not installed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FlashError {
    /// Nothing answers.
    #[error(
        "no answer: {}", if *frames {
            "telemetry arrives, but requests do not seem to; is the line connected both ways?"
        } else {
            "is the controller on, and is this its port and its --baud?"
        }
    )]
    NoAnswer {
        /// Whether telemetry arrives.
        frames: bool,
    },
    /// The update stands still.
    #[error(
        "{} s without a step forward while {doing}, at byte {written} of {length}; the same command goes on \
         from there", PATIENCE_US / 1_000_000
    )]
    Stopped {
        /// What was under way.
        doing: Phase,
        /// Bytes that are there.
        written: u32,
        /// Bytes of the model.
        length: u32,
    },
    /// It did not come back.
    #[error(
        "the controller has not come back after its reset; switch it off and on: if it then runs the model on \
         trial, the same command confirms it"
    )]
    NotBack,
    /// The controller is another one or takes no updates.
    #[error(
        "the controller takes no updates: its model is part of its firmware; write the model into that"
    )]
    NoUpdates,
    /// Another version of the protocol.
    #[error(
        "the controller ({firmware}) speaks version {found} of the protocol, this program version {}; use \
         the trainer that belongs to that firmware",
        PROTOCOL
    )]
    Protocol {
        /// Firmware of the controller.
        firmware: String,
        /// Its version.
        found: u8,
    },
    /// The model is one of another robot.
    #[error(
        "the model belongs to `{model}`, but the controller is one of `{controller}`; flash one of that"
    )]
    AnotherRobot {
        /// Name in the model.
        model: String,
        /// Name that the controller gives, shortened.
        controller: String,
    },
    /// The model does not fit.
    #[error("the model does not fit the controller: {}", misfit(.0))]
    Misfit(Misfit),
    /// The release is too old.
    #[error(
        "release {sequence} is older than what was confirmed on the controller, which accepts {floor} and \
         above; sign the model with `--sequence {floor}` or more"
    )]
    BelowFloor {
        /// Number of the release.
        sequence: u32,
        /// Lowest that is accepted.
        floor: u32,
    },
    /// The controller wants a signature.
    #[error(
        "the controller installs only what is signed with the key that begins {}; sign the model with \
         `trainer sign`, or give the file with --signature",
        hexadecimal(key)
    )]
    NotSigned {
        /// First bytes of the key that is trusted.
        key: [u8; 8],
    },
    /// The signatures are of another key.
    #[error(
        "the model is signed with the key that begins {}, but the controller trusts the one that begins {}; \
         sign it with that",
        hexadecimal(found),
        hexadecimal(expected)
    )]
    AnotherKey {
        /// First bytes of the key that is trusted.
        expected: [u8; 8],
        /// First bytes of the key that signed.
        found: [u8; 8],
    },
    /// The robot is running.
    #[error(
        "the robot is running, and its model stays as it is while it does; stop whoever drives it (without \
         commands it stops by itself after a second), or let --stop stop the robot"
    )]
    Running,
    /// Somebody else updates.
    #[error("another host is updating the controller; let it end, or end it, and try again")]
    InUse,
    /// Another model is on trial.
    #[error(
        "another model is on trial there ({}); confirm it with `trainer flash` and its file, or restart the \
         controller, which drops it", name(.0)
    )]
    AnotherOnTrial(Release),
    /// The controller runs the old model after the reset.
    #[error(
        "the controller has started without the new model, and runs {} instead: it did not accept it when it \
         started, or was switched off during the trial; nothing is lost, and the same command tries again",
        name(.0)
    )]
    Dropped(Release),
    /// The model on trial does not do well.
    #[error(
        "the trial does not go on: {good} of {needed} good ticks in a row, and no more for {} s; look at the \
         alarms with `trainer monitor` and mend what they say; they stay until the robot is reset or \
         started; then run the same command again, or restart the controller, which drops the model", PATIENCE_US / 1_000_000
    )]
    TrialStalls {
        /// Good ticks in a row that were seen last.
        good: u32,
        /// Good ticks in a row that are needed.
        needed: u32,
    },
    /// The controller says no for a reason that nothing here can change.
    #[error("{}", refusal(.0))]
    Refused(Refused),
}

/// What does not fit, and how to get a model that does.
fn misfit(Misfit { field, expected, found, .. }: &Misfit) -> String {
    let select =
        |option: &str| format!("`trainer select --{option} {expected}` finds one that fits");
    match *field {
        "sample time in µs" => {
            let [expected, found] = [expected, found].map(|us| *us as f64 / 1e6);
            format!(
                "its sample time is {found} s, that of the controller {expected} s; fit it with \
                 `sample_time_s = {expected}`"
            )
        }
        "states" | "inputs" => format!(
            "it has {found} {field}, the robot {expected}; fit it for the {field} of this robot"
        ),
        "instructions of a step" => format!(
            "a step of it takes {found} instructions, and there is time for {expected}; {}",
            select("max-instructions")
        ),
        field => {
            let mend = match field {
                "bytes" => select("max-bytes"),
                "lag" => select("max-lag"),
                "sparse terms" => select("max-terms"),
                _ => "fit it with a smaller dictionary".to_owned(),
            };
            format!("it has {found} {field}, and there is room for {expected}; {mend}")
        }
    }
}

/// What the controller means, for those refusals that have no error of their own.
fn refusal(refused: &Refused) -> String {
    match *refused {
        Refused::Signature => {
            "the controller does not accept the signature: it is not one of the key that it \
                               trusts; sign the model again with that"
                .to_owned()
        }
        Refused::Pause { .. } => {
            "the controller has seen a wrong signature and checks no other for a second; \
                                  try again, and see who else talks to it"
                .to_owned()
        }
        Refused::AnotherRobot { .. } => {
            "the controller is one of another robot; flash a model of that".to_owned()
        }
        Refused::Length { room } => format!(
            "the controller has room for {} bytes; `trainer select --max-bytes {room}` finds a smaller model",
            grouped(room.into())
        ),
        Refused::Hash => {
            "what arrived at the controller is not what was signed, and was dropped; run the \
                          same command again"
                .to_owned()
        }
        Refused::Model => {
            "the controller cannot run the model: it does not parse it, or computes something \
                           else than the laptop; its firmware may be older than the model"
                .to_owned()
        }
        Refused::Flash => {
            "the controller's flash failed, and the update was dropped; run the same command \
                           again: if it fails again, the flash is worn out"
                .to_owned()
        }
        Refused::TooLong { most } => {
            format!(
                "the controller reads frames of {most} bytes at most; use the trainer of its version"
            )
        }
        other => format!(
            "the controller does not go on ({other:?}); run the same command again, and restart it if that \
             does not help"
        ),
    }
}

/// Number and hash of a release, for messages.
fn name(release: &Release) -> String {
    let hash = hexadecimal(&release.sha256);
    format!("release {}, {}…", release.sequence, hash.get(..8).unwrap_or(&hash))
}

/// What is under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Phase {
    /// Who is there?
    Asking,
    /// Another host has a session.
    Waiting,
    /// The update begins: its signature is checked.
    Beginning,
    /// The slot is erased.
    Erasing,
    /// Bytes are written.
    Writing,
    /// The model is read back and checked.
    Verifying,
    /// The model is committed.
    Activating,
    /// The controller resets.
    Restarting,
    /// The model is on trial.
    Trial(Trial),
    /// The model is confirmed.
    Confirming,
    /// It is over.
    Done(Outcome),
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Asking => "asking",
            Self::Waiting => "waiting for another host",
            Self::Beginning => "beginning",
            Self::Erasing => "erasing",
            Self::Writing => "writing",
            Self::Verifying => "verifying",
            Self::Activating => "activating",
            Self::Restarting => "restarting",
            Self::Trial(Trial { good, needed }) => {
                return write!(f, "trial {good}/{needed} good ticks");
            }
            Self::Confirming => "confirming",
            Self::Done(_) => "done",
        })
    }
}

/// How it ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Nothing was sent: the model could be installed.
    Fits,
    /// The model ran already, confirmed.
    RunsAlready,
    /// The model runs on trial.
    OnTrial,
    /// The model runs, confirmed.
    Installed,
}

/// How far it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// What is under way.
    pub phase: Phase,
    /// Bytes of the model that are on the controller.
    pub written: u32,
    /// Bytes of the model.
    pub length: u32,
    /// When to poll again, if nothing arrives before (µs).
    pub next_us: u64,
}

/// What is asked next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Hello,
    Begin,
    Write,
    Verify,
    Activate,
    /// Hello, after the reset.
    Restart,
    /// Verify, which a controller that is about to reset answers otherwise than one that has: Hello does not.
    Reset,
    Trial,
    Confirm,
    Done,
}

/// An update under way.
///
/// ```
/// use firmware_core::blob::Aligned;
/// use trainer::flash::{FlashError, Flashing, Options, Phase};
///
/// static BLOB: &Aligned<[u8]> =
///     &Aligned(*include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/rosbot/model.bin")));
/// let model = firmware_core::parse(&BLOB.0).unwrap();
/// let mut flashing = Flashing::new(&BLOB.0, &model, None, Options::default());
/// let mut line = Vec::new();
/// let progress = flashing.poll(0, &[], &mut line).unwrap();
/// assert_eq!((progress.phase, progress.length), (Phase::Asking, 1396));
/// assert_eq!(line.len(), 9); // Hello
/// assert_eq!(progress.next_us, 150_000); // or when something arrives
/// let error = flashing.poll(30_000_000, &[], &mut line).unwrap_err();
/// assert_eq!(error, FlashError::NoAnswer { frames: false });
/// ```
#[derive(Debug)]
pub struct Flashing<'m> {
    blob: &'m [u8],
    model: &'m Model<'m>,
    signed: Option<&'m SignedRelease>,
    options: Options,
    exchange: Exchange,
    step: Step,
    phase: Phase,
    /// What is installed; without signatures it gets its number from the controller.
    release: Release,
    /// What was heard first, and last.
    hello: [Option<Hello>; 2],
    /// When to ask next, unless something is being asked.
    wake_us: Option<u64>,
    deadline_us: u64,
    in_use_us: Option<u64>,
    begins: u32,
    /// How often a session was over when it should have been activated.
    lost: u32,
    /// The robot is to be stopped.
    stops: bool,
    written: u32,
    /// Most that were written since the update began.
    most_written: u32,
    /// Bytes of a chunk, and those in a row that failed and that arrived.
    chunk: usize,
    failures: u32,
    successes: u32,
    /// The controller said that it would reset, and that it has.
    activated: bool,
    has_reset: bool,
    trial: Trial,
    stumbles: u32,
    /// For the summary: beginning, first chunk with the bytes that were there, last chunk, end.
    began_us: Option<u64>,
    writing: Option<(u64, u32)>,
    written_us: u64,
    ended_us: u64,
}

impl<'m> Flashing<'m> {
    /// Installs `model`, whose bytes are `blob`; `signed` belongs to it
    /// ([`SignedRelease::read`](crate::signing::SignedRelease::read)).
    pub fn new(
        blob: &'m [u8],
        model: &'m Model<'m>,
        signed: Option<&'m SignedRelease>,
        options: Options,
    ) -> Self {
        let robot = model.structure().robot();
        // No slot has 4 GB: such a blob does not fit.
        let length = u32::try_from(blob.len()).unwrap_or(u32::MAX);
        let release = signed.map_or_else(
            || Release {
                length,
                sha256: firmware_core::slots::sha256(blob),
                sequence: 0,
                robot: self::robot(robot),
            },
            |signed| signed.release,
        );
        let [first, ..] = options.session.to_le_bytes();
        Self {
            blob,
            model,
            signed,
            options,
            // Answers to an earlier run may still be on the way.
            exchange: Exchange::new(first, options.baud),
            step: Step::Hello,
            phase: Phase::Asking,
            release,
            hello: [None, None],
            wake_us: None,
            deadline_us: u64::MAX,
            in_use_us: None,
            begins: 0,
            lost: 0,
            stops: false,
            written: 0,
            most_written: 0,
            chunk: MAX_CHUNK,
            failures: 0,
            successes: 0,
            activated: false,
            has_reset: false,
            trial: Trial { good: 0, needed: 0 },
            stumbles: 0,
            began_us: None,
            writing: None,
            written_us: 0,
            ended_us: 0,
        }
    }

    /// What the controller said of itself at first, as soon as it has.
    pub fn hello(&self) -> Option<&Hello> {
        self.hello[0].as_ref()
    }

    /// What went over the line so far.
    pub fn counts(&self) -> Counts {
        self.exchange.counts()
    }

    /// Takes what has arrived until `now_us`, and puts what is to be sent behind `out`. Times are those of
    /// any clock that does not go back (µs).
    ///
    /// # Errors
    /// [`FlashError`]; then it is over.
    pub fn poll(
        &mut self,
        now_us: u64,
        received: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<Progress, FlashError> {
        if self.began_us.is_none() {
            self.began_us = Some(now_us);
            self.step_forward(now_us);
            self.go(Step::Hello, now_us);
        }
        for byte in received {
            if let Some(say) = self.exchange.push(*byte, now_us) {
                self.answered(say, now_us)?;
            }
        }
        if now_us >= self.deadline_us && self.step != Step::Done {
            return Err(self.late());
        }
        if self.step == Step::Write && self.exchange.is_overdue(now_us) {
            self.chunk_failed(now_us);
        }
        if self.wake_us.is_some_and(|wake_us| now_us >= wake_us) {
            self.wake_us = None;
            let ask = self.ask();
            self.exchange.ask(ask, now_us);
        }
        if std::mem::take(&mut self.stops) {
            // Before the request: whoever drives the robot may start it again at any moment.
            let mut frame = [0; MAX_FRAME];
            let length = encode(&Message::Stop, &mut frame).unwrap_or(0);
            out.extend(&frame[..length]);
        }
        self.exchange.send(now_us, out);
        let times = [self.wake_us, self.exchange.due_us(), Some(self.deadline_us)];
        Ok(Progress {
            phase: self.phase,
            written: self.written,
            length: self.release.length,
            next_us: times.into_iter().flatten().min().unwrap_or(now_us),
        })
    }

    fn step_forward(&mut self, now_us: u64) {
        self.deadline_us = now_us.saturating_add(PATIENCE_US);
    }

    /// Takes a step, and asks for it at once.
    fn go(&mut self, step: Step, now_us: u64) {
        self.step = step;
        self.wait(0, now_us);
        self.phase = match step {
            Step::Hello => Phase::Asking,
            Step::Begin => Phase::Beginning,
            Step::Write => Phase::Writing,
            Step::Verify => Phase::Verifying,
            Step::Activate => Phase::Activating,
            Step::Restart | Step::Reset => Phase::Restarting,
            Step::Trial => Phase::Trial(self.trial),
            Step::Confirm => Phase::Confirming,
            Step::Done => self.phase,
        };
    }

    /// Asks for the present step in a while.
    fn wait(&mut self, us: u64, now_us: u64) {
        self.exchange.forget();
        self.wake_us = Some(now_us.saturating_add(us));
    }

    fn done(&mut self, outcome: Outcome, now_us: u64) {
        self.exchange.forget();
        self.step = Step::Done;
        self.phase = Phase::Done(outcome);
        self.wake_us = None;
        self.ended_us = now_us;
    }

    fn signature(&self, purpose: Purpose) -> Signature {
        self.signed.map(|signed| signed.signature(purpose)).unwrap_or_default()
    }

    /// The request of the present step.
    fn ask(&self) -> Ask {
        let session = self.options.session;
        match self.step {
            Step::Hello | Step::Restart | Step::Trial | Step::Done => Ask::Hello,
            Step::Begin => Ask::Begin {
                session,
                release: self.release,
                signature: self.signature(Purpose::Install),
            },
            Step::Write => {
                let rest = self.blob.get(self.written as usize..).unwrap_or(&[]);
                let bytes = rest.iter().copied().take(self.chunk.min(MAX_CHUNK)).collect();
                Ask::Chunk { session, offset: self.written, bytes }
            }
            Step::Verify | Step::Reset => Ask::Verify { session },
            Step::Activate => {
                Ask::Activate { session, signature: self.signature(Purpose::Activate) }
            }
            Step::Confirm => Ask::Confirm { signature: self.signature(Purpose::Confirm) },
        }
    }

    /// Why it gives up.
    fn late(&self) -> FlashError {
        match self.step {
            Step::Hello => FlashError::NoAnswer { frames: self.counts().frames > 0 },
            Step::Restart | Step::Reset => FlashError::NotBack,
            Step::Trial | Step::Confirm if self.trial.needed > 0 => {
                let Trial { good, needed } = self.trial;
                FlashError::TrialStalls { good, needed }
            }
            _ => self.stopped(),
        }
    }

    fn stopped(&self) -> FlashError {
        let (doing, written, length) = (self.phase, self.written, self.release.length);
        FlashError::Stopped { doing, written, length }
    }

    /// The chunk that is on the way is to be sent again: as a shorter one, if it has failed often.
    fn chunk_failed(&mut self, now_us: u64) {
        self.successes = 0;
        self.failures += 1;
        if self.failures >= FAILURES && self.chunk > LEAST_CHUNK {
            self.failures = 0;
            self.chunk = (self.chunk / 2).max(LEAST_CHUNK);
            self.wait(0, now_us);
        }
    }

    fn answered(&mut self, say: Say, now_us: u64) -> Result<(), FlashError> {
        match say {
            Say::Hello(hello) => {
                let hello = self.hello[1].insert(hello).clone();
                match self.step {
                    Step::Restart => self.restarted(&hello, now_us)?,
                    Step::Trial => self.tried(&hello, now_us)?,
                    _ => self.greeted(&hello, now_us)?,
                }
            }
            // It comes again when the request is repeated.
            Say::Working { .. } if self.phase == Phase::Erasing => {}
            Say::Working { most_ms } => {
                self.phase = Phase::Erasing;
                let most_us = (1000 * u64::from(most_ms)).min(ERASE_US);
                self.step_forward(now_us.saturating_add(most_us));
            }
            Say::Begun { written } => {
                self.step_forward(now_us);
                self.written = written.min(self.release.length);
                self.most_written = self.written;
                self.in_use_us = None;
                self.write_on(now_us);
            }
            Say::Written { written } => self.arrived(written, now_us),
            // The session is alive and nothing is committed.
            Say::Verified if self.step == Step::Reset => self.begin_again(now_us)?,
            Say::Verified => {
                self.step_forward(now_us);
                self.go(Step::Activate, now_us);
            }
            Say::Activated => {
                self.step_forward(now_us);
                self.activated = true;
                self.go(Step::Restart, now_us);
            }
            Say::Confirmed => self.done(Outcome::Installed, now_us),
            // Never asked for.
            Say::Aborted => {}
            Say::Refused(refused) => self.refused(refused, now_us)?,
        }
        Ok(())
    }

    fn refused(&mut self, refused: Refused, now_us: u64) -> Result<(), FlashError> {
        match (self.step, refused) {
            (_, Refused::Unknown { .. }) => return Err(FlashError::NoUpdates),
            // It was held in Safe until it reset: if it runs, it has.
            (Step::Reset, Refused::NoSession | Refused::Busy) if self.activated => {
                self.has_reset = true;
                self.go(Step::Restart, now_us);
            }
            // The session ended before the model was committed.
            (Step::Reset, Refused::NoSession) => {
                self.lost += 1;
                // Or the answer was lost, and the boot did not accept it: over and over.
                if let (true, Some(hello)) = (self.lost > MOST_LOST, &self.hello[1]) {
                    return Err(FlashError::Dropped(hello.release));
                }
                self.begin_again(now_us)?;
            }
            (Step::Reset, Refused::Working) => {
                self.go(Step::Restart, now_us);
                self.wait(AGAIN_US, now_us);
            }
            (_, Refused::Busy) if self.options.stop => {
                self.stops = true;
                self.wait(0, now_us);
            }
            (_, Refused::Busy) => return Err(FlashError::Running),
            // The request waits on.
            (_, Refused::Working) => {}
            (_, Refused::Pause { ms }) => self.wait(1000 * u64::from(ms), now_us),
            (Step::Begin, Refused::InUse) => {
                if now_us >= self.in_use_us.get_or_insert(now_us).saturating_add(IN_USE_US) {
                    return Err(FlashError::InUse);
                }
                self.phase = Phase::Waiting;
                self.wait(AGAIN_US, now_us);
            }
            // Since it said hello: who is on trial?
            (Step::Begin, Refused::OnTrial) => {
                self.begin_again(now_us)?;
                self.go(Step::Hello, now_us);
            }
            (Step::Begin, Refused::BelowFloor { floor }) => {
                return Err(FlashError::BelowFloor { sequence: self.release.sequence, floor });
            }
            (Step::Write, Refused::OutOfOrder { written }) => self.arrived(written, now_us),
            (Step::Verify, Refused::Incomplete { written }) => {
                self.written = written.min(self.release.length);
                self.write_on(now_us);
            }
            // Committed, and reset before that could be said; or the session is over.
            (Step::Activate, Refused::NoSession) => self.go(Step::Restart, now_us),
            (Step::Write | Step::Verify, Refused::NoSession)
            | (Step::Activate, Refused::NotVerified) => self.begin_again(now_us)?,
            (Step::Confirm, Refused::TooEarly { good, needed }) => {
                self.go(Step::Trial, now_us);
                self.goes_on(Trial { good, needed }, now_us);
            }
            // Confirmed, and the answer was lost; or restarted, and dropped.
            (Step::Confirm, Refused::NotOnTrial) => {
                self.has_reset = true;
                self.go(Step::Restart, now_us);
            }
            (_, refused) => return Err(FlashError::Refused(refused)),
        }
        Ok(())
    }

    fn begin_again(&mut self, now_us: u64) -> Result<(), FlashError> {
        self.begins += 1;
        if self.begins > MOST_BEGINS {
            return Err(self.stopped());
        }
        self.go(Step::Begin, now_us);
        Ok(())
    }

    /// The next chunk, or what follows the last one.
    fn write_on(&mut self, now_us: u64) {
        if self.written < self.release.length {
            self.writing.get_or_insert((now_us, self.written));
            self.go(Step::Write, now_us);
        } else {
            self.go(Step::Verify, now_us);
        }
    }

    /// So many bytes are there.
    fn arrived(&mut self, written: u32, now_us: u64) {
        let written = written.min(self.release.length);
        if written > self.most_written {
            self.most_written = written;
            self.step_forward(now_us);
            self.written_us = now_us;
            self.successes = if self.failures == 0 { self.successes + 1 } else { 0 };
            self.failures = 0;
            if self.successes >= SUCCESSES {
                self.successes = 0;
                self.chunk = (2 * self.chunk).min(MAX_CHUNK);
            }
        }
        self.written = written;
        self.write_on(now_us);
    }

    /// Whether a release is the one that is installed; without signatures its number is anybody's.
    fn is_ours(&self, release: &Release) -> bool {
        let sequence = if self.signed.is_some() { self.release.sequence } else { release.sequence };
        *release == Release { sequence, ..self.release }
    }

    /// The first answer: does the model fit, and what is there to do?
    fn greeted(&mut self, hello: &Hello, now_us: u64) -> Result<(), FlashError> {
        self.step_forward(now_us);
        self.hello[0].get_or_insert_with(|| hello.clone());
        let structure = self.model.structure();
        if hello.protocol != PROTOCOL {
            let (firmware, found) = (hello.firmware.escape_debug().to_string(), hello.protocol);
            return Err(FlashError::Protocol { firmware, found });
        }
        if hello.robot != robot(structure.robot()) {
            let (model, controller) =
                (structure.robot().to_owned(), hello.name.escape_debug().to_string());
            return Err(FlashError::AnotherRobot { model, controller });
        }
        let runs = self.is_ours(&hello.release);
        if runs && hello.trial.is_none() {
            self.written = self.release.length;
            self.done(Outcome::RunsAlready, now_us);
            return Ok(());
        }
        if let Some(expected) = hello.key {
            let Some(signed) = self.signed else {
                return Err(FlashError::NotSigned { key: expected });
            };
            let [a, b, c, d, e, f, g, h, ..] = signed.key.0;
            let found = [a, b, c, d, e, f, g, h];
            if found != expected {
                return Err(FlashError::AnotherKey { expected, found });
            }
        }
        if let Some(trial) = hello.trial {
            if !runs {
                return Err(FlashError::AnotherOnTrial(hello.release));
            }
            self.release = hello.release;
            self.written = self.release.length;
            self.on_trial(trial, now_us);
            return Ok(());
        }
        if self.signed.is_none() {
            self.release.sequence = hello.floor;
        } else if self.release.sequence < hello.floor {
            let (sequence, floor) = (self.release.sequence, hello.floor);
            return Err(FlashError::BelowFloor { sequence, floor });
        }
        hello.capacities.check(self.model, self.blob.len()).map_err(FlashError::Misfit)?;
        match hello.mode {
            _ if self.options.dry_run => self.done(Outcome::Fits, now_us),
            Mode::Running if !self.options.stop => return Err(FlashError::Running),
            mode => {
                self.stops = mode == Mode::Running;
                self.go(Step::Begin, now_us);
            }
        }
        Ok(())
    }

    /// Our model is on trial.
    fn on_trial(&mut self, trial: Trial, now_us: u64) {
        if self.options.trial || self.options.dry_run {
            self.done(Outcome::OnTrial, now_us);
        } else {
            self.go(Step::Trial, now_us);
            self.goes_on(trial, now_us);
        }
    }

    /// An answer that may have come before the reset or after it.
    fn restarted(&mut self, hello: &Hello, now_us: u64) -> Result<(), FlashError> {
        match (self.is_ours(&hello.release), hello.trial) {
            (true, Some(trial)) => {
                // Not when it comes back from there.
                if self.trial.needed == 0 {
                    self.step_forward(now_us);
                }
                self.on_trial(trial, now_us);
            }
            (true, None) => self.done(Outcome::Installed, now_us),
            (false, _) if self.has_reset => return Err(FlashError::Dropped(hello.release)),
            (false, _) => self.go(Step::Reset, now_us),
        }
        Ok(())
    }

    /// How the trial goes.
    fn tried(&mut self, hello: &Hello, now_us: u64) -> Result<(), FlashError> {
        if !self.is_ours(&hello.release) {
            return Err(FlashError::Dropped(hello.release));
        }
        let Some(trial) = hello.trial else {
            self.done(Outcome::Installed, now_us);
            return Ok(());
        };
        self.goes_on(trial, now_us);
        Ok(())
    }

    /// The trial has so many good ticks now.
    fn goes_on(&mut self, trial: Trial, now_us: u64) {
        if trial.good < self.trial.good {
            self.stumbles += 1;
        } else if trial.good > self.trial.good && self.stumbles <= MOST_STUMBLES {
            self.step_forward(now_us);
        }
        self.trial = trial;
        self.phase = Phase::Trial(trial);
        if trial.good >= trial.needed {
            self.go(Step::Confirm, now_us);
        } else {
            self.wait(TRIAL_US, now_us);
        }
    }

    /// What the user should know before anything is sent; nothing in most cases.
    pub fn warning(&self) -> Option<String> {
        let hello = self.hello()?;
        hello.key.is_none().then(|| {
            "the controller trusts everybody: whoever is on its line may change its model; give its firmware \
             a key of `trainer keygen`"
                .to_owned()
        })
    }

    /// Who answered, in a few lines of text; empty before somebody has.
    pub fn introduction(&self) -> String {
        let Some(hello) = self.hello() else { return String::new() };
        let mode = match hello.mode {
            Mode::Idle => "idle",
            Mode::Running => "running",
            Mode::Safe => "switched off after an alarm, or for an update",
        };
        let trusted = hello.key.map_or_else(
            || "from everybody".to_owned(),
            |key| format!("signed with the key that begins {}", hexadecimal(&key)),
        );
        let capacities = &hello.capacities;
        // What goes to a terminal has no control characters.
        let (firmware, name) = (hello.firmware.escape_debug(), hello.name.escape_debug());
        format!(
            "controller  {firmware}, robot `{name}`, {mode}\n\
             runs        {}\n\
             accepts     release {} and above, {trusted}\n\
             room        {} bytes, {} states, {} inputs, a sample of {} ms\n",
            running(hello),
            hello.floor,
            grouped(capacities.room.into()),
            capacities.states,
            capacities.inputs,
            f64::from(capacities.sample_us) * 1e-3
        )
    }

    /// How it ended, in a few lines of text; empty before it has.
    pub fn summary(&self) -> String {
        let Phase::Done(outcome) = self.phase else { return String::new() };
        let seconds = |from: u64, to: u64| to.saturating_sub(from) as f64 * 1e-6;
        let mut text = String::new();
        if let Some((first_us, there)) = self.writing {
            let bytes = self.release.length.saturating_sub(there);
            let writing = seconds(first_us, self.written_us);
            let Counts { requests, repeated, .. } = self.counts();
            text += &format!(
                "{} bytes in {:.1} s, written at {} bytes/s; {requests} requests, {repeated} repeated\n",
                grouped(bytes.into()),
                seconds(self.began_us.unwrap_or(0), self.ended_us),
                grouped((f64::from(bytes) / writing.max(1e-6)) as u64),
            );
            if there > 0 {
                text += &format!("{} bytes were there already\n", grouped(there.into()));
            }
        }
        let Some(hello) = &self.hello[1] else { return text };
        let confirmed =
            Hello { trial: hello.trial.filter(|_| outcome != Outcome::Installed), ..hello.clone() };
        let runs = running(&confirmed);
        text += &match outcome {
            Outcome::Fits => format!(
                "{}, {} bytes, fits and may be installed\n",
                name(&self.release),
                grouped(self.release.length.into())
            ),
            Outcome::RunsAlready => format!("runs already: {runs}; nothing to do\n"),
            Outcome::OnTrial => format!(
                "runs now: {runs}; the same command without --trial and --dry-run confirms it, a restart of \
                 the controller drops it\n"
            ),
            Outcome::Installed => format!("runs now: {runs}\n"),
        };
        text
    }
}

/// What runs on a controller.
fn running(hello: &Hello) -> String {
    let slot = match hello.which {
        Which::A => "slot A",
        Which::B => "slot B",
        Which::Factory => return format!("the model in its firmware ({})", name(&hello.release)),
    };
    let state = hello.trial.map_or_else(
        || "confirmed".to_owned(),
        |Trial { good, needed }| format!("on trial, {good} of {needed} good ticks"),
    );
    format!("{} in {slot}, {state}", name(&hello.release))
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware_core::blob::Aligned;
    use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
    use firmware_core::update::{Answer, Capacities, Request};
    use proptest::prelude::*;

    static BLOB: &Aligned<[u8]> = &Aligned(*include_bytes!(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../models/rosbot/model.bin"
    )));

    fn hello() -> Hello {
        let mut hello = Hello {
            protocol: PROTOCOL,
            firmware: Default::default(),
            name: Default::default(),
            robot: robot("rosbot"),
            mode: Mode::Idle,
            capacities: Capacities { room: 4096, ..Capacities::new::<3, 2>(100_000, 0) },
            which: Which::Factory,
            release: Release { length: 1, sha256: [1; 32], sequence: 0, robot: robot("rosbot") },
            trial: None,
            floor: 0,
            key: None,
        };
        hello.firmware.push_str("script \u{1b}").unwrap();
        hello.name.push_str("rosbot").unwrap();
        hello
    }

    fn ours() -> Release {
        Release::new("rosbot", 0, &BLOB.0).unwrap()
    }

    fn slot_a(trial: Option<Trial>) -> Say {
        Say::Hello(Hello { which: Which::A, release: ours(), trial, ..hello() })
    }

    /// Lets a script answer, a millisecond after each request; how it ended, and when (µs).
    fn converse(
        options: Options,
        script: &mut dyn FnMut(&Ask, u64) -> Option<Say>,
    ) -> (Result<Outcome, FlashError>, u64) {
        let model = firmware_core::parse(&BLOB.0).unwrap();
        let mut flashing = Flashing::new(&BLOB.0, &model, None, options);
        let (mut receiver, mut now_us, mut received) = (Receiver::new(), 1_000_000, Vec::new());
        // More turns than any update has.
        for _ in 0..20_000_000 {
            let mut out = Vec::new();
            match flashing.poll(now_us, &std::mem::take(&mut received), &mut out) {
                Err(error) => return (Err(error), now_us - 1_000_000),
                Ok(Progress { phase: Phase::Done(outcome), .. }) => {
                    return (Ok(outcome), now_us - 1_000_000);
                }
                Ok(Progress { next_us, .. }) => {
                    for byte in out {
                        let Some(Received::Message(message)) = receiver.push(byte) else {
                            continue;
                        };
                        let Message::Request(Request { number, ask }) = message else { continue };
                        let Some(say) = script(&ask, now_us - 1_000_000) else { continue };
                        let mut frame = [0; MAX_FRAME];
                        let message = Message::Answer(Answer { number, say });
                        let length = encode(&message, &mut frame).unwrap();
                        received.extend_from_slice(&frame[..length]);
                    }
                    now_us =
                        if received.is_empty() { next_us.max(now_us + 1) } else { now_us + 1000 };
                }
            }
        }
        panic!("without an end")
    }

    #[test]
    fn nothing_waits_for_ever() {
        let refuses = |refused| move |_: &Ask, _: u64| Some(Say::Refused(refused));
        let silent = converse(Options::default(), &mut |_, _| None);
        assert_eq!(silent, (Err(FlashError::NoAnswer { frames: false }), PATIENCE_US));
        let (error, us) =
            converse(Options::default(), &mut refuses(Refused::Unknown { variant: 5 }));
        assert_eq!((error, us), (Err(FlashError::NoUpdates), 1000));

        // What is said after Hello, for ever.
        let after = |say: Say| {
            converse(Options::default(), &mut |ask, _| {
                Some(if *ask == Ask::Hello { Say::Hello(hello()) } else { say.clone() })
            })
        };
        let (error, us) = after(Say::Refused(Refused::InUse));
        assert_eq!(error, Err(FlashError::InUse));
        assert!((IN_USE_US..IN_USE_US + 2 * AGAIN_US).contains(&us), "{us}");
        let bounded = [
            Say::Working { most_ms: u32::MAX },
            Say::Refused(Refused::Working),
            Say::Refused(Refused::Pause { ms: 900 }),
            Say::Refused(Refused::Pause { ms: u32::MAX }),
            Say::Refused(Refused::OnTrial),
        ];
        for say in bounded {
            let (error, us) = after(say.clone());
            assert!(matches!(error, Err(FlashError::Stopped { .. })), "{say:?}: {error:?}");
            assert!(us < ERASE_US + 3 * PATIENCE_US, "{say:?}: {us}");
        }
    }

    /// A controller that keeps to the protocol but for one answer.
    fn but_for<'s>(
        wrong: impl Fn(&Ask, u32) -> Option<Say> + 's,
    ) -> impl FnMut(&Ask, u64) -> Option<Say> + 's {
        let (mut asked, mut written, mut committed, mut reset) = (0, 0, false, false);
        move |ask, _| {
            asked += 1;
            if let Some(say) = wrong(ask, asked) {
                return Some(say);
            }
            Some(match ask {
                // The first answer after the commit comes before the reset.
                Ask::Hello if reset => slot_a(Some(Trial { good: 50, needed: 50 })),
                Ask::Hello => Say::Hello(hello()),
                Ask::Verify { .. } if committed => {
                    reset = true;
                    Say::Refused(Refused::Working)
                }
                Ask::Begin { .. } => Say::Begun { written },
                Ask::Chunk { offset, bytes, .. } => {
                    assert_eq!(*offset, written);
                    written += bytes.len() as u32;
                    Say::Written { written }
                }
                Ask::Verify { .. } => Say::Verified,
                Ask::Activate { .. } => {
                    committed = true;
                    Say::Activated
                }
                Ask::Confirm { .. } => Say::Confirmed,
                Ask::Abort { .. } => Say::Aborted,
            })
        }
    }

    #[test]
    fn what_can_be_mended_is() {
        let clean = converse(Options::default(), &mut but_for(|_, _| None));
        assert_eq!(clean.0, Ok(Outcome::Installed));
        // Asked: Hello, Begin, eight chunks, Verify, Activate, …
        let wrong = [
            (2, Refused::OnTrial),
            (2, Refused::InUse),
            (2, Refused::Pause { ms: 1000 }),
            (5, Refused::NoSession),
            (5, Refused::Working),
            (11, Refused::NoSession),
            (11, Refused::Incomplete { written: BLOB.0.len() as u32 }),
            (12, Refused::NotVerified),
            (12, Refused::NoSession),
            (16, Refused::TooEarly { good: 3, needed: 50 }),
        ];
        for (at, refused) in wrong {
            let mut script =
                but_for(move |_, asked| (asked == at).then_some(Say::Refused(refused)));
            let (outcome, us) = converse(Options::default(), &mut script);
            assert_eq!(outcome, Ok(Outcome::Installed), "{at}: {refused:?}");
            assert!(us < 2_500_000, "{at}: {refused:?}: {us}");
        }
    }

    #[test]
    fn what_cannot_be_mended_is_one_clear_sentence() {
        let all = [
            (2, Refused::Busy, "stops by itself"),
            (2, Refused::BelowFloor { floor: 7 }, "--sequence 7"),
            (2, Refused::AnotherRobot { robot: 1 }, "another robot"),
            (2, Refused::Length { room: 1000 }, "--max-bytes 1000"),
            (2, Refused::Signature, "sign the model again"),
            (2, Refused::TooLong { most: 100 }, "100 bytes at most"),
            (2, Refused::NotOnTrial, "restart it"),
            (5, Refused::Flash, "worn out"),
            (11, Refused::Hash, "run the same command again"),
            (11, Refused::Model, "older than the model"),
        ];
        for (at, refused, part) in all {
            let mut script =
                but_for(move |_, asked| (asked == at).then_some(Say::Refused(refused)));
            let message = converse(Options::default(), &mut script).0.unwrap_err().to_string();
            assert!(message.contains(part) && !message.contains('\n'), "{message}");
        }
        let other = |change: fn(&mut Hello)| {
            let (error, _) = converse(Options::default(), &mut |_, _| {
                let mut hello = hello();
                change(&mut hello);
                Some(Say::Hello(hello))
            });
            error.unwrap_err().to_string()
        };
        let message = other(|hello| hello.protocol = 9);
        assert!(message.contains("script \\u{1b}") && message.contains("version 9"), "{message}");
        let message = other(|hello| hello.robot = 1);
        assert!(message.contains("belongs to `rosbot`"), "{message}");
        let message = other(|hello| hello.capacities.observables = 2);
        assert!(message.contains("room for 2; fit it with a smaller dictionary"), "{message}");
        let message = other(|hello| hello.key = Some([0xAB; 8]));
        assert!(message.contains("begins abababababababab"), "{message}");
        let message = other(|hello| hello.trial = Some(Trial { good: 1, needed: 2 }));
        assert!(message.contains("another model is on trial there (release 0, 01010101…)"));
    }

    #[test]
    fn a_trial_may_stumble() {
        // Good ticks of a trial that falls back to none every so many seconds.
        let run = |period_us: u64| {
            let mut reset = but_for(|_, _| None);
            let mut on_trial = false;
            converse(Options::default(), &mut |ask, now_us| {
                on_trial |= matches!(ask, Ask::Activate { .. });
                if on_trial && *ask == Ask::Hello {
                    let good = (now_us % period_us / 100_000) as u32;
                    return Some(slot_a(Some(Trial { good, needed: 300 })));
                }
                reset(ask, now_us)
            })
        };
        // It has thirty seconds in the end.
        let (outcome, us) = run(40_000_000);
        assert_eq!(outcome, Ok(Outcome::Installed));
        assert!(us > 29_000_000);
        // It never has.
        let (error, us) = run(5_000_000);
        assert!(matches!(error, Err(FlashError::TrialStalls { needed: 300, .. })), "{error:?}");
        assert!((50_000_000..100_000_000).contains(&us), "{us}");
    }

    fn said() -> impl Strategy<Value = Say> {
        let length = BLOB.0.len() as u32;
        let refused = prop_oneof![
            Just(Refused::Working),
            Just(Refused::InUse),
            Just(Refused::NoSession),
            Just(Refused::OnTrial),
            Just(Refused::NotVerified),
            Just(Refused::NotOnTrial),
            (0..2000_u32).prop_map(|written| Refused::OutOfOrder { written }),
            (0..2000_u32).prop_map(|written| Refused::Incomplete { written }),
            (0..60_u32).prop_map(|good| Refused::TooEarly { good, needed: 50 }),
            any::<u32>().prop_map(|ms| Refused::Pause { ms }),
        ];
        prop_oneof![
            Just(Say::Hello(hello())),
            proptest::option::of(0..60_u32)
                .prop_map(|good| slot_a(good.map(|good| Trial { good, needed: 50 }))),
            any::<u32>().prop_map(|most_ms| Say::Working { most_ms }),
            (0..2 * length).prop_map(|written| Say::Begun { written }),
            (0..2 * length).prop_map(|written| Say::Written { written }),
            Just(Say::Verified),
            Just(Say::Activated),
            Just(Say::Confirmed),
            refused.prop_map(Say::Refused),
        ]
    }

    proptest! {
        /// Whatever a controller says, there is an end, and no panic.
        #[test]
        fn nonsense_comes_to_an_end(says in prop::collection::vec(said(), 1..40)) {
            let mut says = says.iter().cycle();
            let (_, us) = converse(Options::default(), &mut |_, _| says.next().cloned());
            // Each time that it begins again may erase.
            prop_assert!(us < u64::from(MOST_BEGINS + 2) * (ERASE_US + 20 * PATIENCE_US), "{}", us);
        }
    }
}
