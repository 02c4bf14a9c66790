//! The experiments of the paper (Shi & Karydis 2021, section IV) on logs that
//! `firmware-sim record paper` writes: every method on every system, beside the paper's figures.
//!
//! Nothing here is typed in but the paper's own numbers (`Published`), its dictionaries
//! (`trainer/paper/*.toml`) and the words around them; what the plants are is read from the
//! manifest beside the logs.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use firmware_core::model::Space;
use serde::{Deserialize, Serialize};

use crate::arx::{ArxForecast, MAX_LAGS};
use crate::convergence::{self, Column};
use crate::edmd_dl::{self, EdmdDl};
use crate::forecast::{Baseline, Data, Evaluation, Forecast, NoMotion, evaluate};
use crate::hermite::Hermite;
use crate::koopman::Koopman;
use crate::recording::{ReadError, Recording, RecordingError};
use crate::report::{grouped, significant};
use crate::robot::{Robot, RobotError};
use crate::sindy::{self, Sindy, Solver};
use crate::trajectory::{Logs, Trajectory, collect};

/// Why the experiments cannot be run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReproduceError {
    /// There is no readable manifest.
    #[error(
        "{}: {reason}; expected a folder written by `firmware-sim record paper --out DIR`",
        path.display()
    )]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A folder of logs is missing.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A log cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A built-in description is refused.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// A folder holds no whole trajectory to test on.
    #[error("{}: expected trajectories of two samples or more; record the logs again", path.display())]
    Short {
        /// The folder.
        path: PathBuf,
    },
    /// The convergence study has no operator.
    #[error("convergence: {0}")]
    Convergence(String),
}

/// The manifest `paper.toml`.
#[derive(Clone, Debug, Deserialize)]
struct Manifest {
    seed: u64,
    logs: Vec<ManifestLog>,
}

#[derive(Clone, Debug, Deserialize)]
struct ManifestLog {
    folder: String,
    plant: String,
    input: String,
    noise: String,
    stand_in: bool,
}

/// A method, in the order of the tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// EDMD with the direct sum of Hermite polynomials up to second order.
    Hermite,
    /// EDMD with dictionary learning.
    EdmdDl,
    /// SINDy, LASSO over a path of 100 λ.
    SindyLasso,
    /// SINDy, sequentially thresholded least squares.
    SindyThresholded,
    /// The paper's dictionary, one operator for all pairs.
    AcdEdmd,
    /// The paper's dictionary, operators of single trajectories averaged as in the authors' program.
    AcdEdmdAveraged,
    /// The dictionary that this project recommends for the robot.
    Recommended,
    /// Every state stays.
    NoMotion,
    /// Linear ARX with the number of lags that is best on the scored data.
    Arx,
}

impl Method {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Hermite,
        Self::EdmdDl,
        Self::SindyLasso,
        Self::SindyThresholded,
        Self::AcdEdmd,
        Self::AcdEdmdAveraged,
        Self::Recommended,
        Self::NoMotion,
        Self::Arx,
    ];

    /// The name in tables and legends.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hermite => "Hermite polynomials",
            Self::EdmdDl => "EDMD-DL",
            Self::SindyLasso => "SINDy (LASSO)",
            Self::SindyThresholded => "SINDy (STLSQ)",
            Self::AcdEdmd => "ACD-EDMD",
            Self::AcdEdmdAveraged => "ACD-EDMD, averaged",
            Self::Recommended => "recommended",
            Self::NoMotion => "no motion",
            Self::Arx => "linear ARX",
        }
    }
}

/// Figures printed in the paper: one-step MSE in its units, and training time.
struct Published {
    method: Method,
    mse: &'static [&'static str],
    seconds: Option<f64>,
}

const fn published(method: Method, mse: &'static [&'static str], seconds: f64) -> Published {
    Published { method, mse, seconds: Some(seconds) }
}

const fn published_error(mse: &'static [&'static str]) -> Published {
    Published { method: Method::AcdEdmd, mse, seconds: None }
}

/// What a squared error is multiplied by to give the paper's unit, and how the paper calls it.
type Unit = (f64, &'static str);

/// "mm" for 1000 × m².
const MILLI: Unit = (1e3, "mm");
const METRE: Unit = (1.0, "m");
const RAD: Unit = (1.0, "rad");
/// mm² of a tip that is measured in mm.
const TIP: Unit = (1.0, "mm");

/// One test of a system.
struct TestCase {
    folder: &'static str,
    title: &'static str,
    units: &'static [Unit],
    published: &'static [Published],
}

/// Training data, dictionaries and tests.
struct System {
    training: &'static str,
    title: &'static str,
    /// The paper's dictionary.
    paper: &'static str,
    /// The dictionary that this project recommends; its states are all that is measured.
    recommended: &'static str,
    tests: &'static [TestCase],
}

const DRIVE: &str = include_str!("../paper/drive.toml");
const DRIVE_SE2: &str = include_str!("../paper/drive-se2.toml");
const ROSBOT: &str = include_str!("../paper/rosbot.toml");
const ARM: &str = include_str!("../paper/arm.toml");
const ARM_RATES: &str = include_str!("../../models/two-link-arm/robot.toml");
const LEG: &str = include_str!("../paper/leg.toml");
const LEG_PARTS: &str = include_str!("../paper/leg-parts.toml");
const LEG_WALK: &str = include_str!("../paper/leg-walk.toml");

const DRIVE_UNITS: &[Unit] = &[MILLI, MILLI, RAD];
const CIRCLE: &[Published] = &[
    published(Method::Hermite, &["291.063", "110.825", "0"], 2.94),
    published(Method::EdmdDl, &["71.616", "1.119", "0.0624"], 2080.11),
    published(Method::SindyLasso, &["1.495", "1.729", "0"], 2631.00),
    published(Method::AcdEdmd, &["0.035", "0", "0.006"], 1.97),
];
const DRIVE_VALIDATION: &[Published] = &[published_error(&["0.0097", "0.0000", "0.0013"])];
const ARM_UNITS: &[Unit] = &[RAD, RAD];
const QUADRANT: &[Published] = &[
    published(Method::Hermite, &["0.0016", "0.0594"], 0.59),
    published(Method::EdmdDl, &["0.0000", "0.0000"], 280.45),
    published(Method::SindyLasso, &["0.0000", "0.0016"], 576.92),
    published(Method::AcdEdmd, &["0.0015", "0.0036"], 0.96),
];
const ARM_VALIDATION: &[Published] = &[published_error(&["0.0003", "0.0009"])];
const LEG_UNITS: &[Unit] = &[TIP, TIP];

const fn test(
    folder: &'static str,
    title: &'static str,
    units: &'static [Unit],
    published: &'static [Published],
) -> TestCase {
    TestCase { folder, title, units, published }
}

const SYSTEMS: &[System] = &[
    System {
        training: "drive-euler/train",
        title: "Differential drive, simulated as in the paper",
        paper: DRIVE,
        recommended: DRIVE_SE2,
        tests: &[
            test("drive-euler/validation", "validation", DRIVE_UNITS, DRIVE_VALIDATION),
            test("drive-euler/circle", "circle (table II)", DRIVE_UNITS, CIRCLE),
            test(
                "rosbot/circle",
                "ROSbot, case 1: circle",
                &[METRE, METRE, RAD],
                &[published_error(&["0.0008", "0.0011", "0.0211"])],
            ),
            test(
                "rosbot/sharp-turn",
                "ROSbot, case 2: sharp turn",
                DRIVE_UNITS,
                &[published_error(&["0.0016", "0.0154", "0.0011"])],
            ),
        ],
    },
    System {
        training: "drive-closing/train",
        title: "Differential drive, simulated with the radius for which the paper's circle closes",
        paper: DRIVE,
        recommended: DRIVE_SE2,
        tests: &[test("drive-closing/circle", "circle", DRIVE_UNITS, CIRCLE)],
    },
    System {
        training: "drive-exact/train",
        title: "Differential drive, exact motion",
        paper: DRIVE,
        recommended: DRIVE_SE2,
        tests: &[
            test("drive-exact/validation", "validation", DRIVE_UNITS, DRIVE_VALIDATION),
            test("drive-exact/circle", "circle", DRIVE_UNITS, CIRCLE),
        ],
    },
    System {
        training: "rosbot/chattering",
        title: "ROSbot, trained on its own ten trials",
        paper: DRIVE,
        recommended: ROSBOT,
        tests: &[
            test("rosbot/circle", "case 1: circle", &[METRE, METRE, RAD], &[]),
            test("rosbot/sharp-turn", "case 2: sharp turn", DRIVE_UNITS, &[]),
        ],
    },
    System {
        training: "arm-euler/train",
        title: "2R arm, simulated as in the paper",
        paper: ARM,
        recommended: ARM_RATES,
        tests: &[
            test("arm-euler/validation", "validation", ARM_UNITS, ARM_VALIDATION),
            test("arm-euler/quadrant", "quadrant (table III)", ARM_UNITS, QUADRANT),
        ],
    },
    System {
        training: "arm-rk4/train",
        title: "2R arm, integrated accurately",
        paper: ARM,
        recommended: ARM_RATES,
        tests: &[
            test("arm-rk4/validation", "validation", ARM_UNITS, ARM_VALIDATION),
            test("arm-rk4/quadrant", "quadrant", ARM_UNITS, QUADRANT),
        ],
    },
    System {
        training: "leg-bending/train",
        title: "Soft leg, case 1: bending part",
        paper: LEG,
        recommended: LEG_PARTS,
        tests: &[test(
            "leg-bending/test",
            "two voltages",
            LEG_UNITS,
            &[published_error(&["0.1423", "0.0068"])],
        )],
    },
    System {
        training: "leg-extension/train",
        title: "Soft leg, case 2: extension part",
        paper: LEG,
        recommended: LEG_PARTS,
        tests: &[test(
            "leg-extension/test",
            "two voltages",
            LEG_UNITS,
            &[published_error(&["0.0005", "0.0122"])],
        )],
    },
    System {
        training: "leg-walk/train",
        title: "Soft leg, case 3: whole leg",
        paper: LEG,
        recommended: LEG_WALK,
        tests: &[test(
            "leg-walk/test",
            "walk (table V)",
            LEG_UNITS,
            &[
                published(Method::Hermite, &["96.357", "2.940"], 0.11),
                published(Method::EdmdDl, &["0.095", "0.013"], 151.19),
                published(Method::SindyLasso, &["0.507", "0.216"], 2.77),
                published(Method::AcdEdmd, &["0.464", "0.616"], 0.08),
            ],
        )],
    },
];

/// All results.
#[derive(Clone, Debug, Serialize)]
pub struct Reproduction {
    /// Version of this form.
    pub format: u32,
    /// `reproduce`.
    pub command: &'static str,
    /// Seed of the logs.
    pub seed: u64,
    /// One entry per training set.
    pub systems: Vec<SystemResult>,
    /// The convergence study.
    pub convergence: Convergence,
}

/// The methods trained on one set of logs.
#[derive(Clone, Debug, Serialize)]
pub struct SystemResult {
    /// Folder of the training logs.
    pub training: String,
    /// Title.
    pub title: String,
    /// Plant and inputs, from the manifest.
    pub plant: String,
    /// Trajectories.
    pub trajectories: usize,
    /// Snapshot pairs.
    pub pairs: usize,
    /// Training times: best of three runs where one takes less than a second.
    pub times: Vec<Timed>,
    /// Tests.
    pub tests: Vec<TestResult>,
}

/// How long a method learned.
#[derive(Clone, Debug, Serialize)]
pub struct Timed {
    /// Method.
    pub method: Method,
    /// Seconds, one thread, from trajectories in memory to a model.
    pub seconds: Option<f64>,
    /// Why there is no model.
    pub failed: Option<String>,
    /// The paper's training time, on its own machine.
    pub published_seconds: Option<f64>,
}

/// One test.
#[derive(Clone, Debug, Serialize)]
pub struct TestResult {
    /// Folder of the logs.
    pub folder: String,
    /// Title.
    pub title: String,
    /// What was driven, from the manifest.
    pub input: String,
    /// The plant, where it is not that of the training.
    pub plant: Option<String>,
    /// Whether the plant stands in for unpublished measurements.
    pub stand_in: bool,
    /// Trajectories.
    pub trajectories: usize,
    /// Steps of a rollout.
    pub steps: usize,
    /// Names of the states.
    pub states: Vec<String>,
    /// Units of the states.
    pub units: Vec<String>,
    /// The paper's units of the squared errors and their factors.
    pub paper_units: Vec<(f64, String)>,
    /// One per method that has a model.
    pub scores: Vec<MethodScore>,
    /// The measured states of the first trajectory, shape `[samples, states]`.
    #[serde(skip)]
    pub measured: Vec<f64>,
    /// Sample time (s).
    pub sample_time_s: f64,
}

/// Errors of one method in one test.
#[derive(Clone, Debug, Serialize)]
pub struct MethodScore {
    /// Method.
    pub method: Method,
    /// One-step MSE per state, in squared units of the state.
    pub one_step: Vec<f64>,
    /// Rollout MSE per state over all steps.
    pub rollout: Vec<f64>,
    /// Rollouts that diverged.
    pub diverged: usize,
    /// Lags of the ARX.
    pub lags: Option<usize>,
    /// The paper's one-step MSE in its own units.
    pub published: Option<Vec<String>>,
    /// Everything, for the figures.
    #[serde(skip)]
    pub evaluation: Option<Evaluation>,
}

impl TestResult {
    /// A method's result.
    pub fn score(&self, method: Method) -> Option<&MethodScore> {
        self.scores.iter().find(|s| s.method == method)
    }
}

impl Reproduction {
    /// A test by the folders that it was trained and tested on.
    pub fn test(&self, training: &str, folder: &str) -> Option<&TestResult> {
        let system = self.systems.iter().find(|s| s.training == training)?;
        system.tests.iter().find(|t| t.folder == folder)
    }
}

/// The convergence study.
#[derive(Clone, Debug, Serialize)]
pub struct Convergence {
    /// Folder of the training logs.
    pub training: String,
    /// Folder of the test logs.
    pub test: String,
    /// Samples M.
    pub samples: Vec<u64>,
    /// Orders of the wheel speeds, with terms, errors and distances (m).
    pub columns: Vec<ConvergenceColumn>,
}

/// One dictionary of the study.
#[derive(Clone, Debug, Serialize)]
pub struct ConvergenceColumn {
    /// Order of the wheel speeds.
    pub order: u8,
    /// Terms N.
    pub terms: usize,
    /// RMS one-step error (m) for each M.
    pub error: Vec<Option<f64>>,
    /// RMS distance to the estimate from all samples (m) for each M.
    pub distance: Vec<Option<f64>>,
}

/// Reads logs with a robot's eyes.
fn read(dir: &Path, folder: &str, robot: &Robot) -> Result<Vec<Trajectory>, ReproduceError> {
    let path = dir.join(folder);
    let recording = Recording::open(&path)?;
    let trajectories = collect(&Logs { recording: &recording, schema: &robot.schema })?;
    if trajectories.iter().any(|t| t.states.len() < 2 * robot.states.len()) {
        return Err(ReproduceError::Short { path });
    }
    Ok(trajectories)
}

fn spaces(robot: &Robot) -> Vec<Space> {
    robot.states.iter().map(|s| s.space).collect()
}

/// A trained method: its model, and whether it sees the paper's states only.
struct Trained {
    method: Method,
    model: Model,
    narrow: bool,
}

enum Model {
    One(Box<dyn Forecast>),
    /// The best number of lags is chosen on the scored data.
    Arx(ArxForecast),
}

/// Trains and times; a quick method is run three times, and the best time counts.
fn train(
    method: Method,
    fit: impl Fn() -> Result<Model, String>,
    narrow: bool,
    published_seconds: Option<f64>,
) -> (Option<Trained>, Timed) {
    let mut best = f64::INFINITY;
    let mut result = Err(String::new());
    for _ in 0..3 {
        let start = Instant::now();
        result = fit();
        let seconds = start.elapsed().as_secs_f64();
        best = best.min(seconds);
        if seconds > 1.0 {
            break;
        }
    }
    match result {
        Ok(model) => (
            Some(Trained { method, model, narrow }),
            Timed { method, seconds: Some(best), failed: None, published_seconds },
        ),
        Err(reason) => {
            (None, Timed { method, seconds: None, failed: Some(reason), published_seconds })
        }
    }
}

fn boxed<F: Forecast + 'static, E: ToString>(model: Result<F, E>) -> Result<Model, String> {
    match model {
        Ok(model) => Ok(Model::One(Box::new(model))),
        Err(error) => Err(error.to_string()),
    }
}

/// Runs all experiments on the logs in `dir` with the methods asked for. `progress` is told how
/// much of the whole is done and what comes next.
///
/// # Errors
/// [`ReproduceError`].
pub fn run(
    dir: &Path,
    methods: &[Method],
    progress: &dyn Fn(usize, usize, &str),
) -> Result<Reproduction, ReproduceError> {
    let path = dir.join("paper.toml");
    let fail = |reason: String| ReproduceError::Manifest { path: path.clone(), reason };
    let text = std::fs::read_to_string(&path).map_err(|e| fail(format!("cannot be read: {e}")))?;
    let manifest: Manifest =
        toml::from_str(&text).map_err(|e| fail(e.message().trim().replace('\n', " ")))?;
    let entry = |folder: &str| {
        let found = manifest.logs.iter().find(|l| l.folder == folder);
        found.ok_or_else(|| fail(format!("no entry for the logs `{folder}`")))
    };
    let total = SYSTEMS.len() * methods.len() + 1;
    let mut done = 0;
    let mut systems = Vec::new();
    for system in SYSTEMS {
        let about = entry(system.training)?;
        let paper = builtin(system.paper)?;
        let full = builtin(system.recommended)?;
        let (narrow_spaces, wide_spaces) = (spaces(&paper), spaces(&full));
        let narrow = read(dir, system.training, &paper)?;
        let wide = read(dir, system.training, &full)?;
        let (narrow, wide) =
            (data(&narrow, &narrow_spaces, &paper), data(&wide, &wide_spaces, &full));

        let (mut trained, mut times) = (Vec::new(), Vec::new());
        for method in methods {
            progress(done, total, &format!("{}: {}", system.training, method.name()));
            let all = system.tests.iter().flat_map(|t| t.published);
            let published = all.filter(|p| p.method == *method).find_map(|p| p.seconds);
            let is_narrow = matches!(method, Method::AcdEdmd | Method::AcdEdmdAveraged);
            let fit = || -> Result<Model, String> {
                let lasso = sindy::Settings::default();
                match method {
                    Method::Hermite => boxed(Hermite::fit(wide, &Default::default())),
                    Method::EdmdDl => boxed(EdmdDl::fit(wide, &edmd_dl::Settings::default())),
                    Method::SindyLasso => boxed(Sindy::fit(wide, &lasso)),
                    Method::SindyThresholded => {
                        let settings = sindy::Settings { solver: Solver::Thresholded, ..lasso };
                        boxed(Sindy::fit(wide, &settings))
                    }
                    Method::AcdEdmd => boxed(Koopman::fit(&paper, narrow)),
                    Method::AcdEdmdAveraged => boxed(Koopman::fit_averaged(&paper, narrow)),
                    Method::Recommended => boxed(Koopman::fit(&full, wide)),
                    Method::NoMotion => Ok(Model::One(Box::new(NoMotion))),
                    Method::Arx => {
                        let model = ArxForecast::fit(wide);
                        model.map(Model::Arx).ok_or_else(|| "no data".to_owned())
                    }
                }
            };
            let (model, time) = train(*method, fit, is_narrow, published);
            trained.extend(model);
            if *method != Method::NoMotion {
                times.push(time);
            }
            done += 1;
        }

        let mut tests = Vec::new();
        for case in system.tests {
            progress(done, total, &format!("{}: scoring", case.folder));
            let narrow = read(dir, case.folder, &paper)?;
            let wide = read(dir, case.folder, &full)?;
            let (narrow, wide) =
                (data(&narrow, &narrow_spaces, &paper), data(&wide, &wide_spaces, &full));
            let about_test = entry(case.folder)?;
            tests.push(score(case, &trained, (narrow, &paper), wide, about_test, about));
        }
        systems.push(SystemResult {
            training: system.training.to_owned(),
            title: system.title.to_owned(),
            plant: format!("{}; {}; noise: {}", about.plant, about.input, about.noise),
            trajectories: wide.trajectories.len(),
            pairs: wide.pairs().count(),
            times,
            tests,
        });
    }
    progress(done, total, "convergence");
    let convergence = converge(dir)?;
    progress(total, total, "done");
    Ok(Reproduction { format: 1, command: "reproduce", seed: manifest.seed, systems, convergence })
}

fn builtin(text: &str) -> Result<Robot, RobotError> {
    Robot::parse(text, Path::new("built-in robot.toml"))
}

fn data<'d>(trajectories: &'d [Trajectory], spaces: &'d [Space], robot: &Robot) -> Data<'d> {
    let (inputs, sample_time_s) = (robot.inputs.len(), robot.schema.sample_time_s);
    Data { spaces, inputs, sample_time_s, trajectories }
}

fn score(
    case: &TestCase,
    trained: &[Trained],
    (narrow, paper): (Data<'_>, &Robot),
    wide: Data<'_>,
    about: &ManifestLog,
    training: &ManifestLog,
) -> TestResult {
    let n = narrow.spaces.len();
    let samples = narrow.trajectories.iter().map(|t| t.states.len() / n).min().unwrap_or(1);
    let steps = samples - 1;
    let still = evaluate(&NoMotion, narrow, steps);
    let scores = trained.iter().map(|Trained { method, model, narrow: is_narrow }| {
        let test = if *is_narrow { narrow } else { wide };
        let (evaluation, lags) = match model {
            Model::One(model) => (evaluate(model.as_ref(), test, steps), None),
            Model::Arx(arx) => {
                let candidates =
                    (0..=MAX_LAGS).map(|lags| (evaluate(&arx.with_lags(lags), test, steps), lags));
                let relative = |e: &Evaluation| -> f64 {
                    e.rollout.iter().zip(&still.rollout).map(|(a, b)| a / b.max(1e-300)).sum()
                };
                let best = candidates.min_by(|a, b| relative(&a.0).total_cmp(&relative(&b.0)));
                let (evaluation, lags) = best.unwrap_or_else(|| (still.clone(), 0));
                (evaluation, Some(lags))
            }
        };
        let published = case.published.iter().find(|p| p.method == *method);
        MethodScore {
            method: *method,
            one_step: evaluation.one_step[..n].to_vec(),
            rollout: evaluation.rollout[..n].to_vec(),
            diverged: evaluation.diverged,
            lags,
            published: published.map(|p| p.mse.iter().map(|x| (*x).to_owned()).collect()),
            evaluation: Some(first_states(evaluation, test.spaces.len(), n)),
        }
    });
    TestResult {
        folder: case.folder.to_owned(),
        title: case.title.to_owned(),
        input: about.input.clone(),
        plant: (about.plant != training.plant)
            .then(|| format!("{}; noise: {}", about.plant, about.noise)),
        stand_in: about.stand_in,
        trajectories: wide.trajectories.len(),
        steps,
        states: paper.states.iter().map(|s| s.name.clone()).collect(),
        units: paper.states.iter().map(|s| s.unit.clone()).collect(),
        paper_units: case.units.iter().map(|(f, u)| (*f, (*u).to_owned())).collect(),
        scores: scores.collect(),
        measured: narrow.trajectories.first().map_or_else(Vec::new, |t| t.states.clone()),
        sample_time_s: narrow.sample_time_s,
    }
}

/// The first `n` of `all` states of everything.
fn first_states(mut evaluation: Evaluation, all: usize, n: usize) -> Evaluation {
    let cut = |rows: &[f64]| rows.chunks_exact(all).flat_map(|row| &row[..n]).copied().collect();
    evaluation.one_step.truncate(n);
    evaluation.rollout.truncate(n);
    evaluation.by_step = cut(&evaluation.by_step);
    evaluation.example_steps = cut(&evaluation.example_steps);
    evaluation.example = cut(&evaluation.example);
    evaluation
}

/// Exact motion in the body frame with growing orders of the wheel speeds.
fn converge(dir: &Path) -> Result<Convergence, ReproduceError> {
    const ORDERS: [u8; 5] = [1, 2, 3, 4, 5];
    const SAMPLES: [u64; 10] = [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000];
    const FOLDERS: [&str; 2] = ["drive-exact/train", "drive-exact/validation"];
    let robot = builtin(DRIVE_SE2)?;
    let robots = ORDERS.map(|order| {
        let mut robot = robot.clone();
        for factor in &mut robot.factors {
            factor.order = order;
        }
        robot
    });
    let spaces = spaces(&robot);
    let [training, test] = [read(dir, FOLDERS[0], &robot)?, read(dir, FOLDERS[1], &robot)?];
    let (training, test) = (data(&training, &spaces, &robot), data(&test, &spaces, &robot));
    // The first two outputs are the forward and sideways displacement, in metres.
    let columns = convergence::study(&robots, &SAMPLES, 2, training, test)
        .map_err(|e| ReproduceError::Convergence(e.to_string()))?;
    let named = |(order, column): (u8, Column)| ConvergenceColumn {
        order,
        terms: column.terms,
        error: column.error,
        distance: column.distance,
    };
    Ok(Convergence {
        training: FOLDERS[0].to_owned(),
        test: FOLDERS[1].to_owned(),
        samples: SAMPLES.to_vec(),
        columns: ORDERS.into_iter().zip(columns).map(named).collect(),
    })
}

/// Three significant digits.
fn brief(x: f64) -> String {
    match x.abs() {
        size if !size.is_finite() => "diverged".to_owned(),
        0.0 => "0".to_owned(),
        size if !(1e-3..1e5).contains(&size) => format!("{x:.1e}"),
        size => format!("{x:.*}", (2 - libm::floor(libm::log10(size)) as i32).max(0) as usize),
    }
}

fn list(values: impl Iterator<Item = String>) -> String {
    format!("[{}]", values.collect::<Vec<_>>().join(", "))
}

/// A Markdown table with aligned columns; the first row is the header.
fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| {
        rows.iter().filter_map(|r| r.get(c)).map(|t| t.chars().count()).max().unwrap_or(0).max(3)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        for (cell, width) in row.iter().zip(&widths) {
            let _ = write!(text, "| {cell:width$} ");
        }
        text += "|\n";
        if i == 0 {
            for width in &widths {
                let _ = write!(text, "|{:-<1$}", "", width + 2);
            }
            text += "|\n";
        }
    }
    text
}

impl Reproduction {
    /// The report as Markdown; every number but those in columns headed "paper" was computed from
    /// the logs.
    pub fn text(&self) -> String {
        let mut text = format!(
            "# The paper's experiments, run again\n\n\
             Logs: `firmware-sim record paper`, seed {}. One-step MSE: the mean squared error of one \
             prediction from each true sample, as in the paper, in the paper's units: `mm` for a \
             position measured in metres stands for 1000 × m², `m` for m², `rad` for rad², and `mm` \
             for the tip of the soft leg for mm². Rollout MSE: from the first sample on, each step \
             from the prediction before it, mean over all steps, in squared units of the state. \
             Angles are compared on the circle. Columns headed *paper* are the paper's printed \
             figures; all others are computed. ACD-EDMD and the recommended dictionary predict with \
             the controller's f32 code, in which exact motion is exact to about 1e-14.\n",
            self.seed
        );
        for system in &self.systems {
            let _ = write!(
                text,
                "\n## {}\n\nTrained on {}: {}. {} trajectories, {} snapshot pairs.\n",
                system.title,
                system.training,
                system.plant,
                grouped(system.trajectories as u64),
                grouped(system.pairs as u64)
            );
            for test in &system.tests {
                text += &test.text();
            }
        }
        text + "\n## Convergence\n\n" + &self.convergence.text()
    }

    /// Training times as Markdown: they differ from run to run.
    pub fn times(&self) -> String {
        let mut text =
            "## Training times\n\nOne thread, from trajectories in memory to a model; the \
             best of three runs where one takes less than a second. The paper's times are those of \
             its own machine and programs. Seconds.\n\n"
                .to_owned();
        let methods: Vec<Method> =
            Method::ALL.into_iter().filter(|m| *m != Method::NoMotion).collect();
        let mut rows = vec![vec!["training logs".to_owned(), "pairs".to_owned()]];
        rows[0].extend(methods.iter().map(|m| m.name().to_owned()));
        for system in &self.systems {
            let find = |m: &Method| system.times.iter().find(|t| t.method == *m);
            let mut row = vec![system.training.clone(), grouped(system.pairs as u64)];
            row.extend(methods.iter().map(|m| {
                find(m).and_then(|t| t.seconds).map_or_else(|| "–".to_owned(), significant)
            }));
            rows.push(row);
            let published = |m: &Method| find(m).and_then(|t| t.published_seconds);
            if methods.iter().any(|m| published(m).is_some()) {
                let mut row = vec!["paper".to_owned(), String::new()];
                row.extend(
                    methods
                        .iter()
                        .map(|m| published(m).map_or_else(String::new, |s| s.to_string())),
                );
                rows.push(row);
            }
        }
        text += &table(&rows);
        for (system, time) in self.systems.iter().flat_map(|s| s.times.iter().map(move |t| (s, t)))
        {
            if let Some(reason) = &time.failed {
                let name = time.method.name();
                let _ = write!(text, "\n{}: {name} has no model: {reason}\n", system.training);
            }
        }
        text
    }
}

impl TestResult {
    fn text(&self) -> String {
        let states = |units: &mut dyn Iterator<Item = String>| {
            list(self.states.iter().zip(units).map(|(s, u)| format!("{s} {u}")))
        };
        let mut text = format!(
            "\n### {}\n\n{}: {}. {} of {} samples.",
            self.title,
            self.folder,
            self.input,
            match self.trajectories {
                1 => "1 trajectory".to_owned(),
                n => format!("{n} trajectories"),
            },
            self.steps
        );
        if let Some(plant) = &self.plant {
            let _ = write!(text, " The robot: {plant}.");
        }
        if self.stand_in {
            text += " The paper's measurements were never published; another robot stands in for \
                     theirs, so that no comparison with the paper's figures is meant.";
        }
        text += "\n\n";
        let paper = self.scores.iter().any(|s| s.published.is_some());
        let mut header = vec![
            "method".to_owned(),
            format!("one-step MSE {}", states(&mut self.paper_units.iter().map(|u| u.1.clone()))),
        ];
        if paper {
            header.push("paper".to_owned());
        }
        header.push(format!(
            "rollout MSE, {} steps {}",
            self.steps,
            states(&mut self.units.iter().map(|u| format!("{u}²")))
        ));
        let mut rows = vec![header];
        for score in &self.scores {
            let name = match score.lags {
                Some(1) => format!("{}, 1 lag", score.method.name()),
                Some(lags) => format!("{}, {lags} lags", score.method.name()),
                None => score.method.name().to_owned(),
            };
            let one_step = score.one_step.iter().zip(&self.paper_units);
            let mut row = vec![name, list(one_step.map(|(x, (factor, _))| brief(x * factor)))];
            if paper {
                let published = score.published.as_ref();
                row.push(published.map_or_else(String::new, |p| list(p.iter().cloned())));
            }
            row.push(match score.diverged {
                0 => list(score.rollout.iter().copied().map(brief)),
                diverged => format!("diverged in {diverged} of {}", self.trajectories),
            });
            rows.push(row);
        }
        text + &table(&rows)
    }
}

impl Convergence {
    fn text(&self) -> String {
        let cells = |pick: fn(&ConvergenceColumn) -> &[Option<f64>]| {
            let mut rows = vec![vec!["samples M".to_owned()]];
            rows[0].extend(self.columns.iter().map(|c| format!("N = {}", c.terms)));
            for (i, samples) in self.samples.iter().enumerate() {
                let mut row = vec![grouped(*samples)];
                row.extend(self.columns.iter().map(|c| {
                    pick(c).get(i).copied().flatten().map_or_else(|| "–".to_owned(), brief)
                }));
                rows.push(row);
            }
            table(&rows)
        };
        let orders: Vec<String> = self.columns.iter().map(|c| c.order.to_string()).collect();
        format!(
            "The operator from the first M snapshot pairs of {} over Hermite polynomials of orders \
             {} in both wheel speeds (N terms; pose left out, displacement in the body frame), on \
             {}. The wheel speeds are normal, the weight of the paper's theorem, so that the mean \
             over the test data is its integral.\n\n\
             RMS one-step error of the displacement [m]: falls with M to a floor that falls with \
             N.\n\n{}\n\
             RMS distance [m] between the predictions of the estimate from M samples and of that \
             from all: the estimate's own limit.\n\n{}",
            self.training,
            orders.join(", "),
            self.test,
            cells(|c| &c.error),
            cells(|c| &c.distance)
        )
    }
}
