//! What a run does: the script of the host, the faults, the controller's speed.

use crate::excitation::{Excitation, Signal};
use crate::fault::Fault;
use crate::log::stream;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::ops::RangeInclusive;
use std::path::Path;

/// A scenario, as in a TOML file.
///
/// ```
/// use firmware_sim::run::scenario::Scenario;
/// let scenario: Scenario = Scenario::parse("
///     seconds = 20
///     faults = [\"slip:1@5..10=0.5\"]
///     [[drive]]
///     for_s = 2
///     inputs = [8, 8]
///     [[drive]]
///     for_s = 1
///     inputs = [4, -4]
/// ", 2).unwrap();
/// assert_eq!((scenario.seconds, scenario.drive.len(), scenario.faults.len()), (20.0, 2, 1));
/// ```
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Virtual time (s).
    #[serde(default = "Scenario::default_seconds")]
    pub seconds: f64,
    /// What the host commands, one after the other, from the start again at the end.
    #[serde(default)]
    pub drive: Vec<Leg>,
    /// Random commands instead.
    pub random: Option<Random>,
    /// Faults, such as `slip:1@5..10=0.5`.
    #[serde(default)]
    pub faults: Vec<FaultText>,
    /// Whether the host resets and starts a robot that went to Safe.
    #[serde(default = "yes")]
    pub restart: bool,
    /// The controller.
    #[serde(default)]
    pub controller: Controller,
    /// The serial line.
    #[serde(default)]
    pub line: LineSettings,
}

/// A fault, written as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "String")]
pub struct FaultText(pub Fault);

impl TryFrom<String> for FaultText {
    type Error = crate::fault::FaultError;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse().map(Self)
    }
}

fn yes() -> bool {
    true
}

/// Inputs that are held for a while.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Leg {
    /// How long (s).
    pub for_s: f64,
    /// The inputs, in the model's order and units.
    pub inputs: Vec<f64>,
}

/// Levels that are drawn for each input and held for a while.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Random {
    /// Levels are uniform in ±limit, in the inputs' unit.
    pub limit: f64,
    /// Share of the levels that are 0 instead.
    #[serde(default)]
    pub zero_share: f64,
    /// Shortest and longest time that a level is held (s).
    pub hold_s: [f64; 2],
}

/// How fast the controller is. Instructions of a model come from the core's cost table; the rest is a round
/// figure: counted on the emulated controller (firmware-sim/cortex-m/budgets.txt) it is less in most ticks, and
/// more in one that is a sample.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Controller {
    /// Clock (MHz).
    pub clock_mhz: f64,
    /// Cycles per instruction, on average.
    pub cycles_per_instruction: f64,
    /// Instructions of a tick without the model's steps.
    pub tick_instructions: u32,
}

impl Default for Controller {
    /// An STM32F407 at 168 MHz; flash with waits costs half a cycle per instruction.
    fn default() -> Self {
        Self { clock_mhz: 168.0, cycles_per_instruction: 1.5, tick_instructions: 2_000 }
    }
}

/// The serial line between host and controller.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LineSettings {
    /// Baud rate (bits/s).
    pub baud: u32,
    /// Probability that a byte is lost.
    pub loss: f64,
    /// Probability that a byte arrives twice.
    pub doubling: f64,
    /// Probability that a bit of a byte is flipped.
    pub bit_flip: f64,
}

impl Default for LineSettings {
    /// The ROSbot's 576,000 baud, without errors.
    fn default() -> Self {
        Self { baud: 576_000, loss: 0.0, doubling: 0.0, bit_flip: 0.0 }
    }
}

/// Why a scenario is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScenarioError {
    /// It is no TOML of a scenario.
    #[error("line {line}: {message}")]
    Syntax {
        /// The line, from 1.
        line: usize,
        /// What is wrong.
        message: String,
    },
    /// A value is out of range.
    #[error("`{field}` must {expected}, not {found}")]
    Value {
        /// Which.
        field: &'static str,
        /// What it must do.
        expected: &'static str,
        /// What was found.
        found: f64,
    },
    /// Inputs of the wrong number.
    #[error("`drive` number {number} has {found} inputs where the robot has {expected}")]
    Inputs {
        /// Which, from 1.
        number: usize,
        /// Inputs of the robot.
        expected: usize,
        /// Inputs found.
        found: usize,
    },
    /// Both scripts, or none.
    #[error("a scenario needs either `[[drive]]` or `[random]`, and only one of them")]
    Script,
}

impl Scenario {
    fn default_seconds() -> f64 {
        60.0
    }

    /// Random driving for a minute, levels within ±`limit`.
    pub fn random(limit: f64) -> Self {
        Self {
            seconds: Self::default_seconds(),
            drive: Vec::new(),
            random: Some(Random { limit, zero_share: 0.2, hold_s: [0.3, 2.0] }),
            faults: Vec::new(),
            restart: true,
            controller: Controller::default(),
            line: LineSettings::default(),
        }
    }

    /// Reads a scenario for a robot with so many inputs.
    ///
    /// # Errors
    /// [`ScenarioError`].
    pub fn parse(text: &str, inputs: usize) -> Result<Self, ScenarioError> {
        let scenario: Self = toml::from_str(text).map_err(|e| {
            let start = e.span().map_or(0, |span| span.start);
            let line = 1 + text.get(..start).unwrap_or(text).matches('\n').count();
            // A message of several lines begins with what is wrong.
            let message = e.message().lines().next().unwrap_or_default().to_owned();
            ScenarioError::Syntax { line, message }
        })?;
        scenario.check(inputs)?;
        Ok(scenario)
    }

    /// The same from a file, which the message names.
    ///
    /// # Errors
    /// The message for the user.
    pub fn load(path: &Path, inputs: usize) -> Result<Self, String> {
        let text = std::fs::read_to_string(path)
            .map_err(|e| format!("{}: cannot be read: {e}", path.display()))?;
        Self::parse(&text, inputs).map_err(|e| format!("{}: {e}", path.display()))
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`ScenarioError`] for the first one that makes no sense.
    pub fn check(&self, inputs: usize) -> Result<(), ScenarioError> {
        if self.drive.is_empty() == self.random.is_none() {
            return Err(ScenarioError::Script);
        }
        for (number, leg) in (1..).zip(&self.drive) {
            let found = leg.inputs.len();
            if found != inputs {
                return Err(ScenarioError::Inputs { number, expected: inputs, found });
            }
        }
        let positive = "be above 0 and finite";
        let share = "lie between 0 and 1";
        let check = |field, expected, found: f64, right: bool| match right {
            true => Ok(()),
            false => Err(ScenarioError::Value { field, expected, found }),
        };
        let is_positive = |x: f64| x > 0.0 && x.is_finite();
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        let century = "be above 0 and at most 1e10";
        let lasts = is_positive(self.seconds) && self.seconds <= 1e10;
        check("seconds", century, self.seconds, lasts)?;
        for leg in &self.drive {
            check("for_s", positive, leg.for_s, is_positive(leg.for_s))?;
            for u in &leg.inputs {
                check("inputs", "be finite", *u, u.is_finite())?;
            }
        }
        if let Some(Random { limit, zero_share, hold_s: [least, most] }) = self.random {
            check("limit", positive, limit, is_positive(limit))?;
            check("zero_share", share, zero_share, is_share(zero_share))?;
            check("hold_s", positive, least, is_positive(least) && most < 1e6)?;
            check("hold_s", "not end before it begins", most, most >= least)?;
        }
        let Controller { clock_mhz, cycles_per_instruction, .. } = self.controller;
        check("clock_mhz", positive, clock_mhz, is_positive(clock_mhz))?;
        check(
            "cycles_per_instruction",
            positive,
            cycles_per_instruction,
            is_positive(cycles_per_instruction),
        )?;
        let LineSettings { baud, loss, doubling, bit_flip } = self.line;
        check("baud", positive, baud.into(), baud > 0)?;
        check("loss", share, loss, is_share(loss))?;
        check("doubling", share, doubling, is_share(doubling))?;
        check("bit_flip", share, bit_flip, is_share(bit_flip))
    }
}

/// A script as it unfolds, for a robot with two inputs.
#[derive(Debug)]
pub(crate) struct Script {
    drive: Vec<Leg>,
    random: Option<(Excitation<2>, ChaCha8Rng)>,
    period_s: f64,
    at: usize,
    left: u32,
    now: [f32; 2],
}

impl Script {
    /// The script of a scenario, asked every `period_s`; randomness from `seed`.
    pub(crate) fn new(scenario: &Scenario, period_s: f64, seed: u64) -> Self {
        let steps = |s: f64| (s / period_s).round().max(1.0) as u32;
        let random = scenario.random.map(|Random { limit, zero_share, hold_s: [least, most] }| {
            let hold: RangeInclusive<u32> = steps(least)..=steps(most);
            let signal = Signal::Steps { limit, zero_share, hold };
            (Excitation::new(signal, 3), stream(seed, 0))
        });
        let drive = scenario.drive.clone();
        let at = drive.len().saturating_sub(1);
        Self { drive, random, period_s, at, left: 0, now: [0.0; 2] }
    }

    /// The inputs for the coming period.
    pub(crate) fn next(&mut self) -> [f32; 2] {
        if let Some((excitation, rng)) = &mut self.random {
            return excitation.next(rng).map(|u| u as f32);
        }
        if self.left == 0 && !self.drive.is_empty() {
            self.at = (self.at + 1) % self.drive.len();
            let leg = &self.drive[self.at];
            self.left = (leg.for_s / self.period_s).round().max(1.0) as u32;
            for (to, u) in self.now.iter_mut().zip(&leg.inputs) {
                *to = *u as f32;
            }
        }
        self.left = self.left.saturating_sub(1);
        self.now
    }
}
