//! Logs of a simulated robot, as CSV files that a trainer reads.
//!
//! One file per trajectory, `trial-000.csv`, `trial-001.csv`, …, with the header
//! `time_s,<outputs>,<inputs>`, every column named `<name>_<unit>`:
//!
//! | robot | columns after `time_s` | rate | input |
//! |---|---|---|---|
//! | `rosbot` | `x_m,y_m,phi_rad,omega_r_radps,omega_l_radps` | 10 Hz | N(0, 9²) clipped to ±32 rad/s, new every sample |
//! | `two-link-arm` | `theta1_rad,theta2_rad,dtheta1_radps,dtheta2_radps,tau1_Nm,tau2_Nm` | 100 Hz | N(0, 1), new every sample |
//! | `soft-leg` | `y_mm,z_mm,bending_V,extension_V` | 20 Hz | levels uniform in ±12 V, one in five 0 V, each held for 0.2 s to 1 s |
//!
//! The first two are the paper's training data. 20 Hz for the leg puts at least two samples into
//! the fastest lag that its tip shows (0.1 s), while the 30 ms of its valves stay below a sample.
//!
//! Every trial starts where a new plant does: the ROSbot at the origin (or where it is
//! [put](Recording::starting_at)), the arm at rest stretched out horizontally (θ = 0, where the paper's
//! test begins too), the leg idle. One input can be [held](Recording::held) instead of random ones.
//!
//! - The input in a row acts from that row's time to the next row's; the last row holds the input
//!   that would act next. There is one row more than there are whole samples in the duration.
//! - Angles are unwrapped.
//! - Inputs are commands on a grid (0.001 rad/s, 0.0001 N m, 0.01 V), drawn and applied as written.
//! - Outputs are the plant's own numbers, with every digit that an f64 needs, unless noise or a
//!   number of digits is asked for.
//!
//! # Noise
//!
//! Independent normal measurement noise on every output, which never acts on the robot. At scale 1
//! its standard deviations are those of a sensor that such a robot could have; outputs are then
//! rounded far below them:
//!
//! | robot | standard deviation | decimals |
//! |---|---|---|
//! | `rosbot` | 1 mm, 2 mrad (motion capture) | 6 |
//! | `two-link-arm` | 0.2 mrad, 5 mrad/s (encoders) | 6 |
//! | `soft-leg` | 0.1 mm (motion capture) | 4 |
//!
//! # Randomness
//!
//! Trial i draws its inputs from stream i of ChaCha8 seeded with the seed, and its noise from
//! stream i + 2⁶³. A trial therefore does not depend on how many there are, its first rows do not
//! depend on how long it is, and noise of any scale leaves the motion as it is. The same settings
//! give the same bytes.

use crate::arm::{Arm, ArmParameters};
use crate::drive::{Drive, DriveParameters};
use crate::excitation::{Excitation, Signal};
use crate::integrate::{Integrator, Numerical};
use crate::log::{NOISE_STREAM, Sensor, file_name, is_file_name, rows, stream, write_csv};
use crate::plant::Plant;
use crate::soft_leg::{SoftLeg, SoftLegParameters};
use std::fmt;
use std::fs;
use std::io;
use std::iter;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use tempfile::TempPath;

/// A robot that can be recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Robot {
    /// [`Drive`] with the paper's ROSbot 2.0 dimensions.
    Rosbot,
    /// [`Arm`] with the masses and lengths of the paper's arm.
    TwoLinkArm,
    /// [`SoftLeg`], the invented soft pneumatic leg.
    SoftLeg,
}

impl Robot {
    /// Every robot.
    pub const ALL: [Self; 3] = [Self::Rosbot, Self::TwoLinkArm, Self::SoftLeg];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rosbot => "rosbot",
            Self::TwoLinkArm => "two-link-arm",
            Self::SoftLeg => "soft-leg",
        }
    }

    /// Rows per second.
    pub fn rate_hz(self) -> u32 {
        match self {
            Self::Rosbot => 10,
            Self::TwoLinkArm => 100,
            Self::SoftLeg => 20,
        }
    }

    /// The integrator that is used unless another is asked for.
    pub fn default_integrator(self) -> Integrator {
        match self {
            Self::Rosbot => Integrator::Exact,
            Self::TwoLinkArm | Self::SoftLeg => Integrator::Numerical(Numerical::RK4),
        }
    }
}

impl fmt::Display for Robot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The text names no robot.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown robot `{text}`: expected rosbot, two-link-arm, soft-leg or paper")]
pub struct UnknownRobot {
    /// What was given.
    pub text: String,
}

impl FromStr for Robot {
    type Err = UnknownRobot;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|robot| robot.name() == text)
            .ok_or_else(|| UnknownRobot { text: text.into() })
    }
}

/// What to record, unchecked; [`Recording::new`] checks it.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The robot.
    pub robot: Robot,
    /// Number of trajectories, at least 1.
    pub trials: u32,
    /// Duration of each trajectory (s), at least one sample.
    pub seconds: f64,
    /// Seed of all randomness.
    pub seed: u64,
    /// Multiple of the sensor's usual noise; 0 for none.
    pub noise: f64,
    /// Integrator; `None` for the robot's own.
    pub integrator: Option<Integrator>,
    /// Decimals of the outputs, at most 15; `None` for all of them, or the sensor's with noise.
    pub digits: Option<u8>,
}

/// Why [`Settings`] cannot be recorded.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SettingsError {
    /// There is nothing to record.
    #[error("the number of trials must be at least 1")]
    NoTrials,
    /// The duration is no number of seconds above zero.
    #[error("the duration must be finite and above 0 s, not {seconds}")]
    Seconds {
        /// What was given.
        seconds: f64,
    },
    /// The duration does not hold one sample.
    #[error("{seconds} s are shorter than one sample of {robot} at {} Hz", robot.rate_hz())]
    TooShort {
        /// The robot.
        robot: Robot,
        /// What was given.
        seconds: f64,
    },
    /// The duration holds too many samples.
    #[error("{seconds} s are more than {MOST_SAMPLES} samples of {robot} at {} Hz", robot.rate_hz())]
    TooLong {
        /// The robot.
        robot: Robot,
        /// What was given.
        seconds: f64,
    },
    /// The noise is no factor.
    #[error("the noise scale must be finite and at least 0, not {noise}")]
    Noise {
        /// What was given.
        noise: f64,
    },
    /// More decimals than an f64 can be rounded to.
    #[error("the number of digits must be at most {MOST_DIGITS}, not {digits}")]
    Digits {
        /// What was given.
        digits: u8,
    },
    /// Too few or too many numbers, or one that is not finite.
    #[error("expected {expected} finite numbers for the {what}, found {found}")]
    Numbers {
        /// What they are.
        what: &'static str,
        /// How many it has.
        expected: usize,
        /// How many were finite numbers.
        found: usize,
    },
    /// The robot always starts at rest at the same place.
    #[error("{robot} cannot start elsewhere; only the rosbot can")]
    Start {
        /// The robot.
        robot: Robot,
    },
    /// The robot cannot be integrated like this.
    #[error("{robot} cannot be integrated with {integrator}: use {}", integrators(*robot))]
    Integrator {
        /// The robot.
        robot: Robot,
        /// What was given.
        integrator: Integrator,
    },
}

/// Samples per trial, to catch a slip of the keyboard: 115 days at 10 Hz.
const MOST_SAMPLES: u32 = 100_000_000;
/// Decimal digits that every f64 keeps.
const MOST_DIGITS: u8 = 15;

fn expect_numbers(
    what: &'static str,
    numbers: &[f64],
    expected: usize,
) -> Result<(), SettingsError> {
    let found = numbers.iter().filter(|x| x.is_finite()).count();
    if found == expected && numbers.len() == expected {
        Ok(())
    } else {
        Err(SettingsError::Numbers { what, expected, found })
    }
}

fn integrators(robot: Robot) -> &'static str {
    match robot {
        Robot::Rosbot => "exact, rk4 or euler",
        Robot::TwoLinkArm => "rk4 or euler",
        Robot::SoftLeg => "rk4",
    }
}

/// A plant at the start of a trial.
#[derive(Debug, Clone)]
enum AnyPlant {
    Drive(Drive),
    Arm(Arm),
    SoftLeg(SoftLeg),
}

/// Checked settings, ready to be simulated.
///
/// ```
/// use firmware_sim::record::{Recording, Robot, Settings};
///
/// let recording = Recording::new(Settings {
///     robot: Robot::Rosbot,
///     trials: 1,
///     seconds: 0.1,
///     seed: 1,
///     noise: 0.0,
///     integrator: None,
///     digits: Some(4),
/// })?;
/// let mut csv = Vec::new();
/// recording.write_trial(0, &mut csv)?;
/// assert_eq!(
///     String::from_utf8(csv)?,
///     "time_s,x_m,y_m,phi_rad,omega_r_radps,omega_l_radps\n\
///      0,0,0,0,7.993,2.323\n\
///      0.1,0.0319,0.0025,0.1542,-1.801,5.746\n",
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct Recording {
    settings: Settings,
    plant: AnyPlant,
    integrator: Integrator,
    samples: u32,
    held: Option<Vec<f64>>,
}

impl Recording {
    /// Checks the settings.
    ///
    /// # Errors
    ///
    /// [`SettingsError`] for the first setting that cannot be recorded.
    pub fn new(settings: Settings) -> Result<Self, SettingsError> {
        let Settings { robot, trials, seconds, noise, integrator, digits, .. } = settings;
        if trials == 0 {
            return Err(SettingsError::NoTrials);
        }
        if !(seconds.is_finite() && seconds > 0.0) {
            return Err(SettingsError::Seconds { seconds });
        }
        // 0.29 s at 100 Hz are 28.999999999999996 samples in f64, meant as 29.
        let samples = (seconds * f64::from(robot.rate_hz()) * (1.0 + 1e-12)).floor();
        if samples < 1.0 {
            return Err(SettingsError::TooShort { robot, seconds });
        }
        if samples > f64::from(MOST_SAMPLES) {
            return Err(SettingsError::TooLong { robot, seconds });
        }
        if !(noise.is_finite() && noise >= 0.0) {
            return Err(SettingsError::Noise { noise });
        }
        if let Some(digits) = digits
            && digits > MOST_DIGITS
        {
            return Err(SettingsError::Digits { digits });
        }
        let integrator = integrator.unwrap_or(robot.default_integrator());
        let plant = match (robot, integrator) {
            (Robot::Rosbot, integrator) => {
                Drive::new(DriveParameters::default(), integrator).ok().map(AnyPlant::Drive)
            }
            (Robot::TwoLinkArm, Integrator::Numerical(method)) => {
                Arm::new(ArmParameters::default(), method).ok().map(AnyPlant::Arm)
            }
            (Robot::SoftLeg, Integrator::Numerical(Numerical::Rk4 { substeps })) => {
                SoftLeg::new(SoftLegParameters::default(), substeps).ok().map(AnyPlant::SoftLeg)
            }
            _ => None,
        };
        let plant = plant.ok_or(SettingsError::Integrator { robot, integrator })?;
        Ok(Self { settings, plant, integrator, samples: samples as u32, held: None })
    }

    /// The same with one input, in the robot's units, held all the time instead of random ones.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Numbers`] unless there is one finite number per input.
    ///
    /// ```
    /// use firmware_sim::record::{Recording, Robot, Settings};
    ///
    /// let settings = Settings {
    ///     robot: Robot::Rosbot,
    ///     trials: 1,
    ///     seconds: 0.1,
    ///     seed: 1,
    ///     noise: 0.0,
    ///     integrator: None,
    ///     digits: None,
    /// };
    /// let recording = Recording::new(settings)?.held(&[10.0, 10.0])?.starting_at(&[1000.0, 2.0, 0.0])?;
    /// let mut csv = Vec::new();
    /// recording.write_trial(0, &mut csv)?;
    /// assert!(String::from_utf8(csv)?.ends_with("\n0,1000,2,0,10,10\n0.1,1000.062,2,0,10,10\n"));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn held(mut self, input: &[f64]) -> Result<Self, SettingsError> {
        expect_numbers("inputs", input, 2)?;
        self.held = Some(input.to_owned());
        Ok(self)
    }

    /// The same with every trial starting at a pose (x, y in m, heading in rad) instead of the
    /// origin. Where a drive stands does not change its motion, only the digits that are left for it.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Start`] for a robot that is not a drive, [`SettingsError::Numbers`] unless
    /// there are three finite numbers.
    pub fn starting_at(mut self, pose: &[f64]) -> Result<Self, SettingsError> {
        let AnyPlant::Drive(drive) = &mut self.plant else {
            return Err(SettingsError::Start { robot: self.settings.robot });
        };
        expect_numbers("start", pose, 3)?;
        drive.set_pose([pose[0], pose[1], pose[2]]);
        Ok(self)
    }

    /// Rows of every file: one per sample and one more.
    pub fn rows(&self) -> u32 {
        self.samples + 1
    }

    /// Simulates one trial and writes its CSV.
    ///
    /// # Errors
    ///
    /// Those of `out`.
    pub fn write_trial(&self, trial: u32, out: impl io::Write) -> io::Result<()> {
        match self.plant.clone() {
            AnyPlant::Drive(drive) => {
                let signal = Signal::Gaussian { std: 9.0, limit: 32.0 };
                self.write_rows(trial, drive, Excitation::new(signal, 3), Sensor::POSE, out)
            }
            AnyPlant::Arm(arm) => {
                let signal = Signal::Gaussian { std: 1.0, limit: f64::INFINITY };
                self.write_rows(trial, arm, Excitation::new(signal, 4), Sensor::JOINTS, out)
            }
            AnyPlant::SoftLeg(leg) => {
                let signal = Signal::Steps { limit: 12.0, zero_share: 0.2, hold: 4..=20 };
                self.write_rows(trial, leg, Excitation::new(signal, 2), Sensor::TIP, out)
            }
        }
    }

    fn write_rows<const OUTPUTS: usize, const INPUTS: usize>(
        &self,
        trial: u32,
        plant: impl Plant<OUTPUTS, INPUTS> + Clone,
        mut excitation: Excitation<INPUTS>,
        usual: Sensor<OUTPUTS>,
        out: impl io::Write,
    ) -> io::Result<()> {
        let Settings { robot, seed, noise, digits, .. } = self.settings;
        let mut input_rng = stream(seed, u64::from(trial));
        let noise_rng = stream(seed, NOISE_STREAM + u64::from(trial));
        let sensor = Sensor {
            std: usual.std.map(|std| noise * std),
            decimals: digits.or(usual.decimals.filter(|_| noise > 0.0)),
        };
        let inputs = iter::repeat_with(|| match &self.held {
            Some(held) => std::array::from_fn(|i| held[i]),
            None => excitation.next(&mut input_rng),
        });
        let inputs = inputs.take(self.rows() as usize);
        let rate_hz = robot.rate_hz();
        let rows = rows(plant.clone(), rate_hz, inputs, sensor, noise_rng);
        write_csv(out, &plant, rate_hz, rows)
    }

    /// Records every trial into `dir`, which is made if need be.
    ///
    /// Files appear under their names only when all trials are written. With `overwrite`, the files
    /// of an earlier recording go, including those with numbers that this one does not have.
    ///
    /// # Errors
    ///
    /// [`WriteError`] if the directory cannot be made, read or written, already holds a recording
    /// that is not to be overwritten, or holds CSV files that are no recording, which a trainer
    /// would read as trajectories.
    pub fn write(&self, dir: &Path, overwrite: bool) -> Result<(), WriteError> {
        fs::create_dir_all(dir)
            .map_err(|source| WriteError::Directory { path: dir.into(), source })?;
        let old = old_recording(dir, overwrite)?;
        let names: Vec<_> = (0..self.settings.trials).map(file_name).collect();
        let mut written = Vec::with_capacity(names.len());
        for (trial, name) in (0..).zip(&names) {
            written.push(
                self.write_aside(trial, dir)
                    .map_err(|source| WriteError::File { path: dir.join(name), source })?,
            );
        }
        for (file, name) in written.into_iter().zip(&names) {
            let path = dir.join(name);
            file.persist(&path).map_err(|error| WriteError::File { path, source: error.error })?;
        }
        for path in old {
            if !names.iter().any(|name| path.ends_with(name)) {
                fs::remove_file(&path).map_err(|source| WriteError::File { path, source })?;
            }
        }
        Ok(())
    }

    /// Writes a trial whole under a passing name in `dir`, which goes when the result is dropped.
    fn write_aside(&self, trial: u32, dir: &Path) -> io::Result<TempPath> {
        let mut builder = tempfile::Builder::new();
        builder.prefix(".trial-").suffix(".tmp");
        // A log is no secret: what the umask leaves, not the owner alone.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let mut file = builder.tempfile_in(dir)?;
        self.write_trial(trial, &mut file)?;
        Ok(file.into_temp_path())
    }
}

impl fmt::Display for Recording {
    /// Such as `rosbot: 20 trials of 501 rows, seed 1, noise 1, integrator exact`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Settings { robot, trials, seed, noise, .. } = self.settings;
        let rows = self.rows();
        let s = if trials == 1 { "" } else { "s" };
        write!(f, "{robot}: {trials} trial{s} of {rows} rows, seed {seed}, ")?;
        write!(f, "noise {noise}, integrator {}", self.integrator)
    }
}

/// Why a recording was not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// The directory cannot be made or read.
    #[error("cannot use the directory {}: {source}", path.display())]
    Directory {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The directory holds a recording that is not to be overwritten.
    #[error("{} already exists: choose another directory or pass --overwrite", path.display())]
    AlreadyRecorded {
        /// A file of the recording.
        path: PathBuf,
    },
    /// The directory holds a CSV file that is none of ours.
    #[error("{} is not from a recording but would be read with it: choose another directory", path.display())]
    ForeignCsv {
        /// The file.
        path: PathBuf,
    },
    /// A file cannot be written, or an old one not removed.
    #[error("cannot write {}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// The files of an earlier recording in `dir`, if they may be overwritten.
fn old_recording(dir: &Path, overwrite: bool) -> Result<Vec<PathBuf>, WriteError> {
    let unreadable = |source| WriteError::Directory { path: dir.into(), source };
    let mut csvs = Vec::new();
    for entry in fs::read_dir(dir).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let extension = path.extension();
        if extension.is_some_and(|extension| extension.eq_ignore_ascii_case("csv")) {
            csvs.push(path);
        }
    }
    csvs.sort();
    let is_ours = |path: &&PathBuf| path.file_name().is_some_and(is_file_name);
    if let Some(path) = csvs.iter().find(|path| !is_ours(path)) {
        return Err(WriteError::ForeignCsv { path: path.clone() });
    }
    match csvs.first() {
        Some(path) if !overwrite => Err(WriteError::AlreadyRecorded { path: path.clone() }),
        _ => Ok(csvs),
    }
}
