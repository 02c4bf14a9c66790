//! The logs that repeat the paper's experiments, one folder per experiment and part.
//!
//! | folder | plant | rate | trials × samples | input |
//! |---|---|---|---|---|
//! | `drive-euler/train` | [`Drive`], r = 0.062 m, L = 0.228 m, one Euler step per sample | 10 Hz | 100 × 500 | N(0, 9²) rad/s, new every sample, not clipped |
//! | `drive-euler/validation` | | | 100 × 50 | the same, other draws |
//! | `drive-euler/circle` | | | 1 × 50 | (12.1369, 6.7310) rad/s |
//! | `drive-exact/…` | the same in closed form | | | the same draws |
//! | `drive-closing/train`, `circle` | the same with r = 0.053 m, Euler | | | the same draws |
//! | `rosbot/chattering` | [`Rosbot`], **an invented plant**, nominally of the same r and L | 10 Hz | 10 × 500 | random v and ω, see below |
//! | `rosbot/circle` | | | 1 × 50 | (12.1369, 6.7310) rad/s |
//! | `rosbot/sharp-turn` | | | 1 × 36 | (10, 10) rad/s, (10, 0), (10, 10), see below |
//! | `arm-euler/train` | [`Arm`], m = 0.1 kg, L = 1 m, one Euler step per sample | 100 Hz | 100 × 200 | N(0, 1) N m, new every sample |
//! | `arm-euler/validation` | | | 100 × 100 | the same, other draws |
//! | `arm-euler/quadrant` | | | 1 × 50 | (−1, 0) N m |
//! | `arm-rk4/…` | the same, RK4 with 10 steps per sample | | | the same draws |
//! | `leg-bending/train`, `test` | [`SoftLeg`], **an invented plant** | 20 Hz | 5 × 40, 1 × 40 | Case 1 of the paper |
//! | `leg-extension/train`, `test` | | | 5 × 40, 1 × 40 | Case 2 of the paper |
//! | `leg-walk/train`, `test` | | | 14 × 40, 1 × 60 | Case 3 of the paper |
//!
//! Files, columns and the meaning of a row are those of [`record`](crate::record); a folder of
//! n samples has n + 1 rows per file. Every trial starts where a new plant does.
//!
//! # Choices where the paper is silent
//!
//! - The paper does not say how it integrated its models; its authors' program takes one Euler step
//!   per sample. Both that and the true motion are here.
//! - With r = 0.062 m, 5 s of the circle's input turn the robot by 7.35 rad. With r = 0.053 m, which
//!   the authors' program has, the circle closes: 0.053/0.228 · 5.4059 · 5 = 2π to 2e-5 rad.
//! - Validation and test trials start at the origin or at rest at θ = 0, as training does.
//! - The chattering of the ROSbot: a forward speed v uniform in ±1 m/s and a turn rate ω uniform in
//!   ±3 rad/s, each held for 1 to 5 samples, independently. Commanded and logged are the wheel speeds
//!   (v ± ω L/2)/r with the nominal r and L. 10 trials of 50 s.
//! - Its sharp turn: straight at (10, 10) rad/s for 1.5 s, then (10, 0) for 0.6 s, which is 93.5°
//!   to the left by the nominal equations, then straight again for 1.5 s.
//! - Its poses have the noise of a motion capture, 1 mm and 2 mrad.
//! - The quadrant takes 50 samples, the walk 1 s for each of its three inputs.
//! - Case 3 of the leg trains with (u1, u2) and (−u1, −u2) for each of the paper's seven pairs.
//!
//! # The leg's post-processing
//!
//! The tip has measurement noise of 0.1 mm and is then smoothed by a centred moving average over
//! 5 samples, as in the paper; two samples of the resting leg before the log and two more of the
//! last voltages after it serve the averages at its ends. A smoothed sample has seen two samples of
//! the future, and shares noise with its neighbours. Inputs are not smoothed.
//!
//! # Randomness
//!
//! As in [`record`](crate::record), but trial i of source b (train, test, … of a robot) draws its inputs from stream
//! i + 2³² b and its noise from stream i + 2³² b + 2⁶³, with b from 1: training, validation and
//! tests share no draws, nor does `record` with the same seed. The same seed gives the same bytes.
//!
//! # Manifest
//!
//! `paper.toml`, written last, is for programs that read the logs:
//!
//! ```toml
//! seed = 1
//!
//! [[logs]]
//! folder = "drive-euler/train"  # trial-000.csv, trial-001.csv, … lie there
//! plant = "differential drive, …"  # one line for people
//! trials = 100  # files
//! rows = 501  # per file
//! sample_time_s = 0.1
//! input = "…"  # one line for people
//! noise = "none"  # one line for people
//! stand_in = false  # true: replaces measurements that the paper never published
//! ```

use crate::arm::{Arm, ArmParameters};
use crate::drive::{Drive, DriveParameters};
use crate::excitation::{Excitation, Signal, round_to};
use crate::integrate::{Integrator, Numerical};
use crate::log::{NOISE_STREAM, Row, Sensor, file_name, rows, stream, write_csv};
use crate::plant::Plant;
use crate::rosbot::{Rosbot, RosbotParameters};
use crate::soft_leg::{SoftLeg, SoftLegParameters};
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::ffi::OsStr;
use std::fmt;
use std::fs;
use std::io;
use std::iter;
use std::num::NonZeroU32;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Wheel speeds ω_r, ω_l of the paper's circle (rad/s).
const CIRCLE: [f64; 2] = [12.1369, 6.7310];

/// Wheel speeds ω_r, ω_l of the sharp turn (rad/s), and for how many samples at 10 Hz each.
const SHARP_TURN: [([f64; 2], u32); 3] = [([10.0, 10.0], 15), ([10.0, 0.0], 6), ([10.0, 10.0], 15)];
/// Largest forward speed of the chattering (m/s).
const CHATTERING_MPS: f64 = 1.0;
/// Largest turn rate of the chattering (rad/s).
const CHATTERING_RADPS: f64 = 3.0;
/// Samples for which the chattering holds a level.
const CHATTERING_HOLD: RangeInclusive<u32> = 1..=5;

/// Joint torques τ1, τ2 of the paper's quadrant (N m).
const QUADRANT: [f64; 2] = [-1.0, 0.0];

/// Training voltages u1 of the paper's Case 1, with u2 = 0 (V).
const BENDING: [f64; 5] = [3.12, 3.61, 3.64, 5.92, 7.97];
/// Training voltages u2 of the paper's Case 2, with u1 = 0 (V).
const EXTENSION: [f64; 5] = [3.12, 3.64, 4.30, 5.92, 6.92];
/// Sizes of the training voltages u1, u2 of the paper's Case 3 (V).
const WALK: [[f64; 2]; 7] = [
    [3.85, 4.55],
    [3.85, 12.03],
    [4.63, 4.63],
    [6.16, 6.16],
    [9.30, 9.30],
    [11.24, 4.55],
    [11.24, 12.03],
];
/// Test voltages u1, one second each, of the paper's Case 1 (V).
const BENDING_TEST: [f64; 2] = [4.30, 3.19];
/// Test voltages u2, one second each, of the paper's Case 2 (V).
const EXTENSION_TEST: [f64; 2] = [3.22, 3.61];
/// The foot path of the paper's Case 3 (V).
const WALK_TEST: [[f64; 2]; 3] = [[-3.88, -7.74], [4.63, 3.50], [-4.54, -3.88]];

/// Decimals of random wheel speeds.
const WHEEL_DECIMALS: u8 = 3;
/// Decimals of random torques.
const TORQUE_DECIMALS: u8 = 4;

/// Window of the leg's moving average, in samples.
const WINDOW: usize = 5;

const MANIFEST: &str = "paper.toml";

/// The logs of all experiments, ready to be written.
///
/// ```
/// use firmware_sim::paper::PaperLogs;
///
/// let dir = tempfile::tempdir()?;
/// PaperLogs::new(1).write(dir.path(), false)?;
/// let circle = std::fs::read_to_string(dir.path().join("drive-euler/circle/trial-000.csv"))?;
/// assert_eq!(circle.lines().count(), 1 + 51);
/// assert_eq!(
///     circle.lines().nth(2),
///     Some("0.1,0.05849049,0,0.14700254385964914,12.1369,6.731"),
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct PaperLogs {
    seed: u32,
    logs: Vec<Log>,
}

/// The files of one folder.
struct Log {
    entry: Entry,
    write_trial: WriteTrial,
}

type WriteTrial = Box<dyn Fn(u32, &mut dyn io::Write) -> io::Result<()>>;

#[derive(Serialize, Deserialize)]
struct Manifest {
    seed: u32,
    logs: Vec<Entry>,
}

/// A folder as the manifest describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Entry {
    folder: String,
    plant: String,
    trials: u32,
    /// Per trial, one more than samples.
    rows: u32,
    sample_time_s: f64,
    input: String,
    noise: String,
    stand_in: bool,
}

/// A source of randomness, 2³² streams for trials.
#[derive(Debug, Clone, Copy)]
enum Source {
    DriveTrain = 1,
    DriveValidation,
    DriveTest,
    ArmTrain,
    ArmValidation,
    ArmTest,
    BendingTrain,
    BendingTest,
    ExtensionTrain,
    ExtensionTest,
    WalkTrain,
    WalkTest,
    Chattering,
    RosbotCircle,
    SharpTurn,
}

impl Source {
    fn stream(self, trial: u32) -> u64 {
        ((self as u64) << 32) + u64::from(trial)
    }
}

/// What drives a robot in the trials of a folder.
#[derive(Debug, Clone)]
enum Input {
    /// A new draw from N(0, `std`²) on each input for every sample.
    Gaussian { std: f64, decimals: u8, trials: u32, samples: u32 },
    /// Random forward speeds and turn rates as wheel speeds, through the dimensions of a drive.
    Chattering { nominal: DriveParameters, trials: u32, samples: u32 },
    /// For every trial, levels and the number of samples for which each is held.
    Held(Vec<Vec<([f64; 2], u32)>>),
}

impl Input {
    fn trials(&self) -> u32 {
        match self {
            Self::Gaussian { trials, .. } | Self::Chattering { trials, .. } => *trials,
            Self::Held(trials) => trials.len() as u32,
        }
    }

    /// Samples of every trial.
    fn samples(&self) -> u32 {
        match self {
            Self::Gaussian { samples, .. } | Self::Chattering { samples, .. } => *samples,
            Self::Held(trials) => trials[0].iter().map(|(_, samples)| samples).sum(),
        }
    }

    /// One input per sample and the one that would act next.
    fn of_trial(&self, trial: u32, seed: u32, source: Source) -> Vec<[f64; 2]> {
        let count = self.samples() as usize + 1;
        let mut rng = stream(seed.into(), source.stream(trial));
        match self {
            Self::Gaussian { std, decimals, .. } => {
                let signal = Signal::Gaussian { std: *std, limit: f64::INFINITY };
                let mut excitation = Excitation::new(signal, *decimals);
                iter::repeat_with(|| excitation.next(&mut rng)).take(count).collect()
            }
            Self::Chattering { nominal, .. } => {
                let level = |limit| {
                    let signal = Signal::Steps { limit, zero_share: 0.0, hold: CHATTERING_HOLD };
                    Excitation::<1>::new(signal, WHEEL_DECIMALS)
                };
                let (mut speed, mut turn_rate) = (level(CHATTERING_MPS), level(CHATTERING_RADPS));
                let DriveParameters { wheel_radius_m: r, track_m: l } = nominal;
                let wheels = || {
                    let ([v], [w]) = (speed.next(&mut rng), turn_rate.next(&mut rng));
                    [w, -w].map(|w| round_to((v + w * l / 2.0) / r, WHEEL_DECIMALS))
                };
                iter::repeat_with(wheels).take(count).collect()
            }
            Self::Held(trials) => {
                let levels = &trials[trial as usize];
                let held = levels
                    .iter()
                    .flat_map(|&(level, samples)| iter::repeat_n(level, samples as usize));
                held.chain(levels.last().map(|&(level, _)| level)).collect()
            }
        }
    }
}

/// A plant and how it is observed, common to several folders.
struct Setup<P, const OUTPUTS: usize> {
    plant: P,
    described: String,
    stand_in: bool,
    rate_hz: u32,
    sensor: Sensor<OUTPUTS>,
    noise: &'static str,
    /// Samples over which the measured outputs are averaged, 1 for none.
    window: usize,
}

impl<P: Plant<OUTPUTS, 2> + Clone + 'static, const OUTPUTS: usize> Setup<P, OUTPUTS> {
    fn log(&self, seed: u32, folder: &str, source: Source, input: Input) -> Log {
        let entry = Entry {
            folder: folder.into(),
            plant: self.described.clone(),
            trials: input.trials(),
            rows: input.samples() + 1,
            sample_time_s: 1.0 / f64::from(self.rate_hz),
            input: self.describe(&input),
            noise: self.noise.into(),
            stand_in: self.stand_in,
        };
        let Self { plant, rate_hz, sensor, window, .. } = self;
        let (plant, rate_hz, sensor, window) = (plant.clone(), *rate_hz, *sensor, *window);
        let write_trial = move |trial, out: &mut dyn io::Write| {
            // Samples before and after the log, for the average of its first and last ones: the
            // robot rests, and goes on.
            let beyond = window / 2;
            let inputs = input.of_trial(trial, seed, source);
            let last = inputs.last().copied();
            let inputs = iter::repeat_n([0.0; 2], beyond)
                .chain(inputs)
                .chain(last.into_iter().flat_map(move |last| iter::repeat_n(last, beyond)));
            let noise_rng = stream(seed.into(), NOISE_STREAM + source.stream(trial));
            let rows: Vec<_> = rows(plant.clone(), rate_hz, inputs, sensor, noise_rng).collect();
            write_csv(out, &plant, rate_hz, smoothed(&rows, window, sensor.decimals))
        };
        Log { entry, write_trial: Box::new(write_trial) }
    }

    fn describe(&self, input: &Input) -> String {
        let [first, second] = self.plant.inputs();
        let unit = first.unit;
        match input {
            Input::Gaussian { std, .. } => {
                format!("{}, {}: N(0, {std}²) {unit}, new every sample", first.name, second.name)
            }
            Input::Chattering { nominal, .. } => {
                let DriveParameters { wheel_radius_m: r, track_m: l } = nominal;
                format!(
                    "{}, {}: forward speed uniform in ±{CHATTERING_MPS} m/s and turn rate uniform in \
                     ±{CHATTERING_RADPS} rad/s, each held for {} to {} samples, as wheel speeds for \
                     r = {r} m, L = {l} m",
                    first.name,
                    second.name,
                    CHATTERING_HOLD.start(),
                    CHATTERING_HOLD.end()
                )
            }
            Input::Held(trials) => {
                let rate_hz = f64::from(self.rate_hz);
                let level = |&([a, b], samples): &([f64; 2], u32)| {
                    format!("({a}, {b}) {unit} for {} s", f64::from(samples) / rate_hz)
                };
                let trial =
                    |levels: &Vec<_>| levels.iter().map(level).collect::<Vec<_>>().join(" then ");
                let trials: Vec<_> = trials.iter().map(trial).collect();
                format!("({}, {}): {}", first.name, second.name, trials.join("; "))
            }
        }
    }
}

/// The rows that have a whole centred window around them, with their outputs averaged over it and
/// rounded.
fn smoothed<const OUTPUTS: usize>(
    rows: &[Row<OUTPUTS, 2>],
    window: usize,
    decimals: Option<u8>,
) -> impl Iterator<Item = Row<OUTPUTS, 2>> {
    rows.windows(window).map(move |around| {
        let (outputs, input) = around[window / 2];
        if window == 1 {
            return (outputs, input);
        }
        let mean = std::array::from_fn(|i| {
            let sum: f64 = around.iter().map(|(outputs, _)| outputs[i]).sum();
            let mean = sum / around.len() as f64;
            decimals.map_or(mean, |decimals| round_to(mean, decimals))
        });
        (mean, input)
    })
}

impl PaperLogs {
    /// The logs with all randomness from `seed`.
    pub fn new(seed: u32) -> Self {
        let mut logs = drive_logs(seed);
        logs.extend(rosbot_logs(seed));
        logs.extend(arm_logs(seed));
        logs.extend(leg_logs(seed));
        Self { seed, logs }
    }

    /// Writes everything to `dir`, which is made if need be.
    ///
    /// The logs are written beside `dir` and move there when they are complete, the manifest last.
    /// With `overwrite` they replace those of an earlier call.
    ///
    /// # Errors
    ///
    /// [`PaperError`] if a directory or a file cannot be made, or if `dir` already holds logs that
    /// are not to be overwritten, or anything that an earlier call did not write.
    pub fn write(&self, dir: &Path, overwrite: bool) -> Result<(), PaperError> {
        let unusable = |source| PaperError::Directory { path: dir.into(), source };
        fs::create_dir_all(dir).map_err(unusable)?;
        let dir = &dir.canonicalize().map_err(unusable)?;
        check_replaceable(dir, overwrite)?;

        let parent = dir.parent().unwrap_or(dir);
        let aside = tempfile::Builder::new()
            .prefix(".paper-")
            .tempdir_in(parent)
            .map_err(|source| PaperError::Directory { path: parent.into(), source })?;
        let (new, old) = (aside.path().join("new"), aside.path().join("old"));
        self.write_files(&new)?;
        make_dir(&old)?;
        // Without its manifest a set is incomplete: it leaves first and arrives last.
        let moved = move_entries(dir, &old, |name| name != MANIFEST)
            .and_then(|()| move_entries(&new, dir, |name| name == MANIFEST));
        if moved.is_err() {
            // Nothing is lost: what has not arrived stays beside `dir`.
            let _ = aside.keep();
        }
        moved
    }

    /// Writes the logs and then the manifest into `dir`, which does not exist yet.
    fn write_files(&self, dir: &Path) -> Result<(), PaperError> {
        for log in &self.logs {
            let folder = dir.join(&log.entry.folder);
            make_dir(&folder)?;
            for trial in 0..log.entry.trials {
                let path = folder.join(file_name(trial));
                fs::File::create_new(&path)
                    .and_then(|mut file| (log.write_trial)(trial, &mut file))
                    .map_err(|source| PaperError::File { path, source })?;
            }
        }
        let path = dir.join(MANIFEST);
        let logs = self.logs.iter().map(|log| log.entry.clone()).collect();
        toml::to_string(&Manifest { seed: self.seed, logs })
            .map_err(io::Error::other)
            .and_then(|text| fs::write(&path, text))
            .map_err(|source| PaperError::File { path, source })
    }
}

impl fmt::Display for PaperLogs {
    /// Such as `paper: 23 logs of 944 trials, seed 1`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let trials: u32 = self.logs.iter().map(|log| log.entry.trials).sum();
        write!(f, "paper: {} logs of {trials} trials, seed {}", self.logs.len(), self.seed)
    }
}

fn drive_logs(seed: u32) -> Vec<Log> {
    let nominal = DriveParameters::default();
    let closing = DriveParameters { wheel_radius_m: 0.053, ..nominal };
    let euler = Integrator::Numerical(Numerical::EULER);
    let mut logs = Vec::new();
    for (experiment, parameters, integrator, integrated) in [
        ("drive-euler", nominal, euler, "one Euler step per sample"),
        ("drive-exact", nominal, Integrator::Exact, "closed form"),
        ("drive-closing", closing, euler, "one Euler step per sample"),
    ] {
        let DriveParameters { wheel_radius_m: r, track_m: l } = parameters;
        let setup = Setup {
            plant: Drive::new(parameters, integrator).expect("lengths above 0"),
            described: format!("differential drive, r = {r} m, L = {l} m, {integrated}"),
            stand_in: false,
            rate_hz: 10,
            sensor: Sensor::EXACT,
            noise: "none",
            window: 1,
        };
        let gaussian = |trials, samples| Input::Gaussian {
            std: 9.0,
            decimals: WHEEL_DECIMALS,
            trials,
            samples,
        };
        let mut add = |part, source, input| {
            logs.push(setup.log(seed, &format!("{experiment}/{part}"), source, input));
        };
        add("train", Source::DriveTrain, gaussian(100, 500));
        if experiment != "drive-closing" {
            add("validation", Source::DriveValidation, gaussian(100, 50));
        }
        add("circle", Source::DriveTest, Input::Held(vec![vec![(CIRCLE, 50)]]));
    }
    logs
}

fn rosbot_logs(seed: u32) -> Vec<Log> {
    let parameters = RosbotParameters::default();
    let RosbotParameters { wheel_radius_m, track_m, track_ratio, .. } = parameters;
    let nominal = DriveParameters { wheel_radius_m, track_m };
    let setup = Setup {
        plant: Rosbot::new(parameters).expect("a robot that can be"),
        described: format!(
            "invented stand-in for a ROSbot 2.0: PI wheel speed control, motor lag, friction, slip, \
             nominal r = {wheel_radius_m} m, L = {track_m} m, turns with {track_ratio} L"
        ),
        stand_in: true,
        rate_hz: 10,
        sensor: Sensor::POSE,
        noise: "1 mm on x and y, 2 mrad on phi",
        window: 1,
    };
    let chattering = Input::Chattering { nominal, trials: 10, samples: 500 };
    let held = |levels: &[([f64; 2], u32)]| Input::Held(vec![levels.to_vec()]);
    [
        ("rosbot/chattering", Source::Chattering, chattering),
        ("rosbot/circle", Source::RosbotCircle, held(&[(CIRCLE, 50)])),
        ("rosbot/sharp-turn", Source::SharpTurn, held(&SHARP_TURN)),
    ]
    .map(|(folder, source, input)| setup.log(seed, folder, source, input))
    .into()
}

fn arm_logs(seed: u32) -> Vec<Log> {
    let parameters = ArmParameters::default();
    let ArmParameters { mass_kg: [m1, m2], length_m: [l1, l2], gravity_mps2: g } = parameters;
    let mut logs = Vec::new();
    for (experiment, method, integrated) in [
        ("arm-euler", Numerical::EULER, "one Euler step per sample"),
        ("arm-rk4", Numerical::RK4, "10 RK4 steps per sample"),
    ] {
        let setup = Setup {
            plant: Arm::new(parameters, method).expect("masses and lengths above 0"),
            described: format!(
                "two-link arm, m1 = {m1} kg, m2 = {m2} kg, L1 = {l1} m, L2 = {l2} m, \
                 g = {g} m/s², {integrated}"
            ),
            stand_in: false,
            rate_hz: 100,
            sensor: Sensor::EXACT,
            noise: "none",
            window: 1,
        };
        let gaussian = |trials, samples| Input::Gaussian {
            std: 1.0,
            decimals: TORQUE_DECIMALS,
            trials,
            samples,
        };
        for (part, source, input) in [
            ("train", Source::ArmTrain, gaussian(100, 200)),
            ("validation", Source::ArmValidation, gaussian(100, 100)),
            ("quadrant", Source::ArmTest, Input::Held(vec![vec![(QUADRANT, 50)]])),
        ] {
            logs.push(setup.log(seed, &format!("{experiment}/{part}"), source, input));
        }
    }
    logs
}

fn leg_logs(seed: u32) -> Vec<Log> {
    const RATE_HZ: u32 = 20;
    const SUBSTEPS: NonZeroU32 = NonZeroU32::new(10).unwrap();
    let setup = Setup {
        plant: SoftLeg::new(SoftLegParameters::default(), SUBSTEPS).expect("a leg that can be"),
        described: format!(
            "invented stand-in for the soft pneumatic leg, {SUBSTEPS} RK4 steps per sample"
        ),
        stand_in: true,
        rate_hz: RATE_HZ,
        sensor: Sensor::TIP,
        noise: "0.1 mm on y and z, then a centred moving average over 5 samples",
        window: WINDOW,
    };
    let bend = |u1| [u1, 0.0];
    let extend = |u2| [0.0, u2];
    let both_signs = WALK.iter().flat_map(|&[u1, u2]| [[u1, u2], [-u1, -u2]]);
    let train = |levels: Vec<[f64; 2]>| {
        Input::Held(levels.into_iter().map(|level| vec![(level, 2 * RATE_HZ)]).collect())
    };
    let test = |levels: &[[f64; 2]]| {
        Input::Held(vec![levels.iter().map(|&level| (level, RATE_HZ)).collect()])
    };
    [
        ("leg-bending/train", Source::BendingTrain, train(BENDING.map(bend).into())),
        ("leg-bending/test", Source::BendingTest, test(&BENDING_TEST.map(bend))),
        ("leg-extension/train", Source::ExtensionTrain, train(EXTENSION.map(extend).into())),
        ("leg-extension/test", Source::ExtensionTest, test(&EXTENSION_TEST.map(extend))),
        ("leg-walk/train", Source::WalkTrain, train(both_signs.collect())),
        ("leg-walk/test", Source::WalkTest, test(&WALK_TEST)),
    ]
    .map(|(folder, source, input)| setup.log(seed, folder, source, input))
    .into()
}

/// Why the logs were not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PaperError {
    /// A directory cannot be made or read.
    #[error("cannot use the directory {}: {source}", path.display())]
    Directory {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The directory holds logs that are not to be overwritten.
    #[error("{} already exists: choose another directory or pass --overwrite", path.display())]
    AlreadyWritten {
        /// The manifest of those logs.
        path: PathBuf,
    },
    /// The directory holds something else than the logs of an earlier call.
    #[error("{} is not from `record paper`: choose another directory", path.display())]
    Foreign {
        /// A file or directory of another origin.
        path: PathBuf,
    },
    /// A file cannot be written, or a file or directory not moved.
    #[error("cannot write {}: {source}", path.display())]
    File {
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

fn make_dir(path: &Path) -> Result<(), PaperError> {
    fs::create_dir_all(path).map_err(|source| PaperError::Directory { path: path.into(), source })
}

/// Moves what lies in one directory into another; names that come last after all others.
fn move_entries(
    from: &Path,
    to: &Path,
    comes_last: impl Fn(&OsStr) -> bool,
) -> Result<(), PaperError> {
    let unreadable = |source| PaperError::Directory { path: from.into(), source };
    let mut names: Vec<_> = fs::read_dir(from)
        .and_then(|entries| entries.map(|entry| Ok(entry?.file_name())).collect())
        .map_err(unreadable)?;
    names.sort_by_key(|name| comes_last(name));
    for name in names {
        let path = to.join(&name);
        fs::rename(from.join(&name), &path).map_err(|source| PaperError::File { path, source })?;
    }
    Ok(())
}

/// Refuses a directory with anything in it but logs that may be overwritten.
fn check_replaceable(dir: &Path, overwrite: bool) -> Result<(), PaperError> {
    let path = dir.join(MANIFEST);
    let manifest: Option<Manifest> =
        fs::read_to_string(&path).ok().and_then(|text| toml::from_str(&text).ok());
    let mut ours = HashSet::new();
    if let Some(manifest) = &manifest {
        ours.insert(path.clone());
        for log in &manifest.logs {
            let folder = dir.join(&log.folder);
            ours.extend((0..log.trials).map(|trial| folder.join(file_name(trial))));
            ours.extend(folder.ancestors().map(PathBuf::from));
        }
    }
    check_entries(dir, &ours)?;
    if manifest.is_some() && !overwrite {
        return Err(PaperError::AlreadyWritten { path });
    }
    Ok(())
}

/// Refuses a directory with anything below it that is not in `ours`.
fn check_entries(dir: &Path, ours: &HashSet<PathBuf>) -> Result<(), PaperError> {
    let unreadable = |source| PaperError::Directory { path: dir.into(), source };
    for entry in fs::read_dir(dir).map_err(unreadable)? {
        let entry = entry.map_err(unreadable)?;
        let path = entry.path();
        if !ours.contains(&path) {
            return Err(PaperError::Foreign { path });
        }
        if entry.file_type().map_err(unreadable)?.is_dir() {
            check_entries(&path, ours)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// The numbers of one file, without the header.
    fn trial(folder: &str, trial: u32) -> Vec<Vec<f64>> {
        let logs = PaperLogs::new(1);
        let log = logs.logs.iter().find(|log| log.entry.folder == folder).unwrap();
        let mut csv = Vec::new();
        (log.write_trial)(trial, &mut csv).unwrap();
        csv::Reader::from_reader(&csv[..])
            .records()
            .map(|row| row.unwrap().iter().map(|field| field.parse().unwrap()).collect())
            .collect()
    }

    /// The two last columns.
    fn inputs(folder: &str, number: u32) -> Vec<[f64; 2]> {
        trial(folder, number).iter().map(|row| row[row.len() - 2..].try_into().unwrap()).collect()
    }

    /// The levels of a file and the number of rows of each.
    fn levels(folder: &str, number: u32) -> Vec<([f64; 2], usize)> {
        inputs(folder, number).chunk_by(|a, b| a == b).map(|rows| (rows[0], rows.len())).collect()
    }

    #[test]
    fn euler_drives_obey_the_papers_equations_row_by_row() {
        for (experiment, r) in [("drive-euler", 0.062), ("drive-closing", 0.053)] {
            for number in [0, 99] {
                let rows = trial(&format!("{experiment}/train"), number);
                assert_eq!(rows[0][..4], [0.0; 4]);
                for pair in rows.windows(2) {
                    let [_, x, y, phi, right, left] = pair[0][..] else { panic!() };
                    let speed = r / 2.0 * (right + left);
                    let next = [
                        x + 0.1 * (speed * libm::cos(phi)),
                        y + 0.1 * (speed * libm::sin(phi)),
                        phi + 0.1 * (r / 0.228 * (right - left)),
                    ];
                    // To the last digit: written numbers are whole.
                    assert_eq!(pair[1][1..4], next);
                }
            }
        }
    }

    #[test]
    fn euler_arm_moves_its_angles_by_the_old_rates() {
        for pair in trial("arm-euler/train", 99).windows(2) {
            for joint in [1, 2] {
                assert_eq!(pair[1][joint], pair[0][joint] + 0.01 * pair[0][joint + 2]);
            }
        }
    }

    #[test]
    fn integrators_share_their_inputs_and_nothing_else_does() {
        let same = |a: &str, b: &str, number| inputs(a, number) == inputs(b, number);
        for number in [0, 1, 99] {
            assert!(same("drive-euler/train", "drive-exact/train", number));
            assert!(same("drive-euler/train", "drive-closing/train", number));
            assert!(same("drive-euler/validation", "drive-exact/validation", number));
            assert!(same("arm-euler/train", "arm-rk4/train", number));
            assert!(same("arm-euler/validation", "arm-rk4/validation", number));
        }
        for robot in ["drive-euler", "arm-euler"] {
            let validation = inputs(&format!("{robot}/validation"), 0);
            let train = format!("{robot}/train");
            assert_ne!(validation, inputs(&train, 0)[..validation.len()]);
            assert_ne!(inputs(&train, 0), inputs(&train, 1));
        }
    }

    #[test]
    fn no_two_sources_share_a_stream() {
        let first = Source::DriveTrain as u64;
        let last = Source::SharpTurn as u64;
        assert!(first == 1 && last < 1 << 31);
        assert_eq!(Source::DriveTrain.stream(u32::MAX) + 1, Source::DriveValidation.stream(0));
        assert!(Source::SharpTurn.stream(u32::MAX) < NOISE_STREAM);
    }

    #[test]
    fn random_inputs_have_the_papers_spread_and_no_limit() {
        for (folder, std, beyond) in
            [("drive-euler/train", 9.0, 32.0), ("arm-euler/train", 1.0, 3.0)]
        {
            let draws: Vec<f64> =
                (0..20).flat_map(|number| inputs(folder, number)).flatten().collect();
            let count = draws.len() as f64;
            let mean = draws.iter().sum::<f64>() / count;
            let variance = draws.iter().map(|u| u * u).sum::<f64>() / count;
            // Four standard errors at 8,000 draws and more.
            assert!((mean / std).abs() < 0.045, "{mean}");
            assert!((variance / (std * std) - 1.0).abs() < 0.065, "{variance}");
            assert!(draws.iter().any(|u| u.abs() > beyond));
        }
    }

    #[test]
    fn circle_closes_with_the_smaller_wheel() {
        // 2π = 0.053/0.228 · 5.4059 · 5 s: the regular polygon of 50 Euler steps closes too.
        let rows = trial("drive-closing/circle", 0);
        let [_, x, y, phi, ..] = rows[50][..] else { panic!() };
        assert!((phi - TAU).abs() < 2e-5, "{phi}");
        assert!(x.hypot(y) < 1e-5, "{x} {y}");
        // Half-way, one diameter 2 v/ω' to the left, on the polygon's circle.
        let diameter = 0.228 * (CIRCLE[0] + CIRCLE[1]) / (CIRCLE[0] - CIRCLE[1]);
        assert!((f64::hypot(rows[25][1], rows[25][2]) / diameter - 1.0).abs() < 1e-2);

        // The paper's own wheel goes on for another sixth of a turn.
        for experiment in ["drive-euler", "drive-exact"] {
            let rows = trial(&format!("{experiment}/circle"), 0);
            assert!((rows[50][3] - TAU * 0.062 / 0.053).abs() < 2e-5);
        }
    }

    #[test]
    fn held_inputs_are_those_of_the_paper() {
        for folder in ["drive-euler", "drive-exact", "drive-closing", "rosbot"] {
            assert_eq!(levels(&format!("{folder}/circle"), 0), [([12.1369, 6.7310], 51)]);
        }
        for folder in ["arm-euler/quadrant", "arm-rk4/quadrant"] {
            assert_eq!(levels(folder, 0), [([-1.0, 0.0], 51)]);
        }
        assert_eq!(
            levels("rosbot/sharp-turn", 0),
            [([10.0, 10.0], 15), ([10.0, 0.0], 6), ([10.0, 10.0], 16)]
        );
        for (number, u1) in (0..).zip([3.12, 3.61, 3.64, 5.92, 7.97]) {
            assert_eq!(levels("leg-bending/train", number), [([u1, 0.0], 41)]);
        }
        for (number, u2) in (0..).zip([3.12, 3.64, 4.30, 5.92, 6.92]) {
            assert_eq!(levels("leg-extension/train", number), [([0.0, u2], 41)]);
        }
        let pairs = [
            (3.85, 4.55),
            (3.85, 12.03),
            (4.63, 4.63),
            (6.16, 6.16),
            (9.30, 9.30),
            (11.24, 4.55),
            (11.24, 12.03),
        ];
        for (number, (u1, u2)) in (0..).zip(pairs) {
            assert_eq!(levels("leg-walk/train", 2 * number), [([u1, u2], 41)]);
            assert_eq!(levels("leg-walk/train", 2 * number + 1), [([-u1, -u2], 41)]);
        }
        assert_eq!(levels("leg-bending/test", 0), [([4.30, 0.0], 20), ([3.19, 0.0], 21)]);
        assert_eq!(levels("leg-extension/test", 0), [([0.0, 3.22], 20), ([0.0, 3.61], 21)]);
        assert_eq!(
            levels("leg-walk/test", 0),
            [([-3.88, -7.74], 20), ([4.63, 3.50], 20), ([-4.54, -3.88], 21)]
        );
    }

    #[test]
    fn chattering_holds_random_speeds_and_turn_rates() {
        let mut speeds = Vec::new();
        for number in 0..10 {
            let inputs = inputs("rosbot/chattering", number);
            // Half a unit of the third decimal of each wheel speed.
            let speed = |[right, left]: [f64; 2]| 0.031 * (right + left);
            let turn_rate = |[right, left]: [f64; 2]| 0.062 / 0.228 * (right - left);
            for (value, most, resolution) in [
                (&speed as &dyn Fn(_) -> f64, 1.0, 4e-5),
                (&turn_rate as &dyn Fn(_) -> f64, 3.0, 4e-4),
            ] {
                let values: Vec<f64> = inputs.iter().map(|&input| value(input)).collect();
                assert!(values.iter().all(|value| value.abs() <= most + resolution));
                let runs: Vec<_> = values
                    .chunk_by(|a, b| (a - b).abs() < 2.0 * resolution)
                    .map(<[_]>::len)
                    .collect();
                // Two levels may be equal to the resolution.
                assert!(runs.iter().all(|&run| run <= 10));
                let mean = 501.0 / runs.len() as f64;
                assert!((2.5..3.5).contains(&mean), "{mean}");
                speeds.extend(values.iter().map(|value| value / most));
            }
        }
        // Uniform in ±1.
        let variance = speeds.iter().map(|v| v * v).sum::<f64>() / speeds.len() as f64;
        assert!((variance - 1.0 / 3.0).abs() < 0.03, "{variance}");
    }

    #[test]
    fn rosbot_is_the_stand_in_seen_by_a_camera() {
        let mut rosbot = Rosbot::new(RosbotParameters::default()).unwrap();
        let mut squares = [0.0; 3];
        let rows = trial("rosbot/chattering", 3);
        for row in &rows {
            for (i, (value, std)) in
                rosbot.observe().into_iter().zip([1e-3, 1e-3, 2e-3]).enumerate()
            {
                let deviation = (row[1 + i] - value) / std;
                assert!(deviation.abs() < 5.0);
                squares[i] += deviation * deviation / rows.len() as f64;
            }
            rosbot.step(&[row[4], row[5]], 0.1);
        }
        // Three standard errors at 501 draws.
        assert!(squares.iter().all(|square| (square - 1.0).abs() < 0.2), "{squares:?}");
    }

    #[test]
    fn moving_average_is_centred() {
        let rows: Vec<Row<2, 2>> =
            [3.0, 1.0, 4.0, 1.0, 5.0, 9.0].iter().map(|&y| ([y, -y], [y; 2])).collect();
        let smooth: Vec<_> = smoothed(&rows, 5, Some(4)).collect();
        assert_eq!(smooth, [([2.8, -2.8], [4.0; 2]), ([4.0, -4.0], [1.0; 2])]);
        // A window of one row changes nothing, whatever the decimals.
        assert!(smoothed(&rows, 1, None).eq(rows.iter().copied()));
        assert_eq!(smoothed(&rows[..4], 5, None).count(), 0);
    }

    #[test]
    fn leg_is_smoothed_and_still_noisy() {
        let leg = || SoftLeg::new(SoftLegParameters::default(), 10.try_into().unwrap()).unwrap();
        let mut residuals = Vec::new();
        for number in 0..14 {
            let rows = trial("leg-walk/train", number);
            let mut leg = leg();
            let raw: Vec<Row<2, 2>> = rows
                .iter()
                .map(|row| {
                    let outputs = leg.observe();
                    leg.step(&[row[3], row[4]], 0.05);
                    (outputs, [row[3], row[4]])
                })
                .collect();
            for (row, (quiet, _)) in rows[2..].iter().zip(smoothed(&raw, 5, None)) {
                residuals.extend([row[1] - quiet[0], row[2] - quiet[1]]);
            }
        }
        let variance = residuals.iter().map(|r| r * r).sum::<f64>() / residuals.len() as f64;
        // 0.1 mm averaged over 5 samples; neighbours share draws: about 200 independent ones.
        let expected = 0.01 / 5.0;
        assert!((variance / expected - 1.0).abs() < 0.3, "{variance}");
    }

    #[test]
    fn quadrant_falls_from_the_horizontal() {
        let rows = trial("arm-rk4/quadrant", 0);
        assert_eq!(rows[0][1..5], [0.0; 4]);
        // Towards −π/2, clockwise, within the half second.
        assert!((-2.5..-0.8).contains(&rows[50][1]), "{}", rows[50][1]);
    }

    #[test]
    fn seeds_move_what_is_random_and_nothing_else() {
        let bytes = |seed, folder: &str| {
            let logs = PaperLogs::new(seed);
            let log = logs.logs.iter().find(|log| log.entry.folder == folder).unwrap();
            let mut csv = Vec::new();
            (log.write_trial)(0, &mut csv).unwrap();
            csv
        };
        for entry in PaperLogs::new(1).logs.iter().map(|log| &log.entry) {
            let random = entry.input.contains("N(0") || entry.noise != "none";
            let same = bytes(1, &entry.folder) == bytes(2, &entry.folder);
            assert_eq!(same, !random, "{}", entry.folder);
        }
    }
}
