//! The experiments of the paper (Shi & Karydis 2021, section IV) on logs that
//! `firmware-sim record paper` writes: every method on every system, beside the paper's figures.
//!
//! Nothing here is typed in but the paper's own numbers (`Published`), its dictionaries
//! (`trainer/paper/*.toml`) and the words around them; what the plants are is read from the
//! manifest beside the logs.

use std::path::{Path, PathBuf};
use std::time::Instant;

use firmware_core::model::Space;
use serde::{Deserialize, Serialize};

use crate::arx::{ArxForecast, MAX_LAGS};
use crate::convergence::{self, Convergence};
use crate::edmd_dl::{self, EdmdDl};
use crate::forecast::{Baseline, Data, Evaluation, Forecast, NoMotion, evaluate};
use crate::hermite::Hermite;
use crate::koopman::Koopman;
use crate::paper::{SYSTEMS, TestCase};
use crate::recording::{ReadError, Recording, RecordingError};
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
    /// A folder does not hold what the manifest says.
    #[error(
        "{}: {found}, but paper.toml says {trials} trajectories of {rows} rows; record the logs again",
        path.display()
    )]
    Incomplete {
        /// The folder.
        path: PathBuf,
        /// What it holds.
        found: String,
        /// Trajectories expected.
        trials: usize,
        /// Rows of each.
        rows: usize,
    },
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
    trials: usize,
    rows: usize,
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
    /// The paper's kind of dictionary over all that is measured, where the paper leaves out a part.
    AcdEdmdWhole,
    /// The dictionary that this project recommends for the robot.
    Recommended,
    /// Every state stays.
    NoMotion,
    /// Linear ARX, the best of 0 to 5 lags on the scored data.
    Arx,
}

impl Method {
    /// All of them.
    pub const ALL: [Self; 10] = [
        Self::Hermite,
        Self::EdmdDl,
        Self::SindyLasso,
        Self::SindyThresholded,
        Self::AcdEdmd,
        Self::AcdEdmdAveraged,
        Self::AcdEdmdWhole,
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
            Self::AcdEdmdWhole => "ACD-EDMD, with velocities",
            Self::Recommended => "recommended",
            Self::NoMotion => "no motion",
            Self::Arx => "linear ARX",
        }
    }
}

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
    /// States that the paper's dictionary is made of.
    pub seen_by_the_paper: Vec<String>,
    /// States that the other methods see.
    pub seen: Vec<String>,
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
    /// Numbers that the model consists of and that are not 0.
    pub numbers: Option<usize>,
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

/// The logs of one folder: as the paper's dictionary sees them, and all that is measured.
struct Seen {
    narrow: Vec<Trajectory>,
    wide: Vec<Trajectory>,
}

/// Reads logs with the eyes of two robots, and holds them against the manifest.
fn read(
    dir: &Path,
    about: &ManifestLog,
    paper: &Robot,
    full: &Robot,
) -> Result<Seen, ReproduceError> {
    let path = dir.join(&about.folder);
    let recording = Recording::open(&path)?;
    let trajectories = |robot: &Robot| -> Result<Vec<Trajectory>, ReproduceError> {
        let (trials, rows) = (about.trials, about.rows);
        let found = collect(&Logs { recording: &recording, schema: &robot.schema })?;
        let n = robot.states.len();
        let other = found.iter().map(|t| t.states.len() / n).find(|r| *r != rows || rows < 2);
        let wrong = match other {
            _ if found.len() != trials => Some(format!("{} trajectories", found.len())),
            Some(rows) => Some(format!("a trajectory of {rows} rows")),
            None => None,
        };
        match wrong {
            Some(found) => {
                Err(ReproduceError::Incomplete { path: path.clone(), found, trials, rows })
            }
            None => Ok(found),
        }
    };
    Ok(Seen { narrow: trajectories(paper)?, wide: trajectories(full)? })
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
        Ok(model) => {
            let numbers = match &model {
                Model::One(model) => Some(model.numbers()),
                // As many as the number of lags that is best in each column.
                Model::Arx(_) => None,
            };
            let seconds = Some(best);
            let time = Timed { method, seconds, numbers, failed: None, published_seconds };
            (Some(Trained { method, model, narrow }), time)
        }
        Err(reason) => {
            let failed = Some(reason);
            (None, Timed { method, seconds: None, numbers: None, failed, published_seconds })
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
    // Everything is read and held against the manifest before any work is done.
    let mut experiments = Vec::new();
    for system in SYSTEMS {
        let (paper, full) = (builtin(system.paper)?, builtin(system.recommended)?);
        let whole = system.whole.map(builtin).transpose()?;
        let about = entry(system.training)?;
        let training = read(dir, about, &paper, &full)?;
        let tests = system.tests.iter().map(|case| {
            let about = entry(case.folder)?;
            Ok((case, about, read(dir, about, &paper, &full)?))
        });
        let tests = tests.collect::<Result<Vec<_>, ReproduceError>>()?;
        experiments.push((system, paper, full, whole, about, training, tests));
    }
    let total = SYSTEMS.len() * methods.len() + 1;
    let mut done = 0;
    let mut systems = Vec::new();
    for (system, paper, full, whole, about, training, tests) in &experiments {
        let (narrow_spaces, wide_spaces) = (spaces(paper), spaces(full));
        let narrow = data(&training.narrow, &narrow_spaces, paper);
        let wide = data(&training.wide, &wide_spaces, full);
        let (mut trained, mut times) = (Vec::new(), Vec::new());
        for method in methods {
            progress(done, total, &format!("{}: {}", system.training, method.name()));
            done += 1;
            if *method == Method::AcdEdmdWhole && whole.is_none() {
                continue;
            }
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
                    Method::AcdEdmd => boxed(Koopman::fit(paper, narrow)),
                    Method::AcdEdmdAveraged => boxed(Koopman::fit_averaged(paper, narrow)),
                    Method::AcdEdmdWhole => {
                        boxed(Koopman::fit(whole.as_ref().unwrap_or(full), wide))
                    }
                    Method::Recommended => boxed(Koopman::fit(full, wide)),
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
        }

        let mut results = Vec::new();
        for (case, about_test, seen) in tests {
            progress(done, total, &format!("{}: scoring", case.folder));
            let narrow = data(&seen.narrow, &narrow_spaces, paper);
            let wide = data(&seen.wide, &wide_spaces, full);
            results.push(score(case, &trained, (narrow, paper), wide, about_test, about));
        }
        systems.push(SystemResult {
            training: system.training.to_owned(),
            title: system.title.to_owned(),
            plant: format!("{}; {}; noise: {}", about.plant, about.input, about.noise),
            seen_by_the_paper: named(paper),
            seen: named(full),
            trajectories: wide.trajectories.len(),
            pairs: wide.pairs().count(),
            times,
            tests: results,
        });
    }
    progress(done, total, "convergence");
    let convergence = convergence::study(manifest.seed)?;
    progress(total, total, "done");
    Ok(Reproduction { format: 1, command: "reproduce", seed: manifest.seed, systems, convergence })
}

fn named(robot: &Robot) -> Vec<String> {
    robot.states.iter().map(|s| s.name.clone()).collect()
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
        let evaluation = match model {
            Model::One(model) => evaluate(model.as_ref(), test, steps),
            Model::Arx(arx) => best_arx(arx, test, steps, &still),
        };
        let published = case.published.iter().find(|p| p.method == *method);
        MethodScore {
            method: *method,
            one_step: evaluation.one_step[..n].to_vec(),
            rollout: evaluation.rollout[..n].to_vec(),
            diverged: evaluation.diverged,
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

/// The ARX with the number of lags that is best on the test, for one step and for the rollout each,
/// with the robot at rest before the first sample or with as many lags as there are samples.
fn best_arx(arx: &ArxForecast, test: Data<'_>, steps: usize, still: &Evaluation) -> Evaluation {
    let relative = |errors: &[f64], still: &[f64]| -> f64 {
        errors.iter().zip(still).map(|(a, b)| a / b.max(f64::MIN_POSITIVE)).sum()
    };
    let mut best = evaluate(&arx.with_lags(0, false), test, steps);
    for lags in 1..=MAX_LAGS {
        for rested in [false, true] {
            let other = evaluate(&arx.with_lags(lags, rested), test, steps);
            let better = |pick: fn(&Evaluation) -> &Vec<f64>, than: &Evaluation| {
                relative(pick(&other), pick(still)) < relative(pick(than), pick(still))
            };
            let one_step = better(|e| &e.one_step, &best);
            if better(|e| &e.rollout, &best) {
                let (step, steps) = (best.one_step, best.example_steps);
                best = Evaluation { one_step: step, example_steps: steps, ..other.clone() };
            }
            if one_step {
                best.one_step = other.one_step;
                best.example_steps = other.example_steps;
            }
        }
    }
    best
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
