//! The command `trainer`: logs in, a model for the controller out.

mod flash_command;

use std::fmt::Display;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Args, Parser, Subcommand};
use firmware_core::blob;
use firmware_core::model::{Model, Space, Structure};
use firmware_core::q31;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use trainer::conformal::{CoverageReport, Residuals, Unit, least_units, with_bounds};
use trainer::cross_conformal::CrossResiduals;
use trainer::edmd;
use trainer::export::{controller_coefficients, export, write_whole};
use trainer::figures;
use trainer::fixed_point::{
    self, FixedCoordinate, FixedError, FixedInput, FixedInspection, FixedOptions, OnLogs, OneStep,
    fixed_point,
};
use trainer::full_operator::FullOperator;
use trainer::inspect::{Inspection, blocks, inspect};
use trainer::monitor::{Recorder, listen, picture};
use trainer::port::Port;
use trainer::recording::{LogColumn, LogSchema, Recording};
use trainer::report::{ScoreReport, grouped, hexadecimal, significant};
use trainer::reproduce::{self, Method as PaperMethod, Reproduction};
use trainer::resample::{InputResampling, ResamplePlan, resample};
use trainer::robot::{Method, Robot, ScoreOptions};
use trainer::rollout::TestReport;
use trainer::score::{self, Counts, Lifted};
use trainer::select::{self, Budget};
use trainer::signing::{SecretKey, SignedRelease, rust_line};
use trainer::spectrum_report::SpectrumReport;
use trainer::stability::Stability;
use trainer::topology::{Orders, lifting};
use trainer::trajectory::{Logs, Trajectory, collect, collect_named, collect_summed_up};

/// Fits Koopman models to robot logs and writes them as blobs that a microcontroller reads.
#[derive(Parser)]
#[command(version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Fit(FitArgs),
    Evaluate(EvaluateArgs),
    Inspect(InspectArgs),
    Export(ExportArgs),
    Calibrate(CalibrateArgs),
    Stability(StabilityArgs),
    Select(SelectArgs),
    Spectrum(SpectrumArgs),
    Dictionary(DictionaryArgs),
    Resample(ResampleArgs),
    Reproduce(ReproduceArgs),
    Monitor(MonitorArgs),
    Keygen(KeygenArgs),
    Sign(SignArgs),
    Flash(FlashArgs),
}

/// Fit the model of a robot to its logs, score it on held-out trajectories, and write the blob.
#[derive(Args)]
struct FitArgs {
    /// The robot's folder, or its robot.toml.
    robot: PathBuf,
    /// Folder of CSV logs, or one CSV file [default: logs/ beside robot.toml].
    #[arg(long, value_name = "DIR")]
    logs: Option<PathBuf>,
    /// Where the blob is written [default: model.bin beside robot.toml].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Do not score: only read, fit and write.
    #[arg(long)]
    no_score: bool,
    /// Also roll the model out over these logs, which it is not fitted on, from their first samples,
    /// in f64 and in the controller's f32.
    #[arg(long, value_name = "DIR")]
    test: Option<PathBuf>,
    /// Steps of these rollouts [default: as in robot.toml, or 50].
    #[arg(long, value_name = "N", requires = "test", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    horizon: Option<u32>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Score a blob on logs, with the controller's own f32 predictor.
#[derive(Args)]
struct EvaluateArgs {
    /// The blob.
    model: PathBuf,
    /// Folder of CSV logs to score on, or one CSV file.
    #[arg(long, value_name = "DIR")]
    logs: PathBuf,
    /// Logs that the linear ARX is fitted on [default: cross-validation over --logs].
    #[arg(long, value_name = "DIR")]
    train: Option<PathBuf>,
    /// The robot.toml that names the columns [default: the one beside the blob, if it is there;
    /// otherwise columns are found by the names and units in the blob].
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Steps of a rollout [default: as in robot.toml, or 50].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    horizon: Option<u32>,
    /// Samples between the starts of two windows [default: as in robot.toml, or 10].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    stride: Option<u32>,
    /// Write every step of every window, measured and predicted, to this file.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Measure how far off a blob's rollouts are on logs that it was not fitted on, and store bounds for
/// every state and step in it (split-conformal prediction).
///
/// Where there are no logs to spare, --cross-validate takes those of the fit: the model is fitted anew
/// without each fold of trajectories, and the errors are those on the fold that was left out
/// (cross-conformal prediction).
#[derive(Args)]
struct CalibrateArgs {
    /// The blob.
    model: PathBuf,
    /// Folder of CSV logs that the model has not seen, or one CSV file.
    #[arg(long, value_name = "DIR")]
    logs: PathBuf,
    /// The logs are those of the fit: leave out fold by fold, as in robot.toml.
    #[arg(long)]
    cross_validate: bool,
    /// Share of predictions that the bounds shall hold for.
    #[arg(long, value_name = "P", default_value_t = 0.9)]
    coverage: f64,
    /// Steps of a rollout, each of which gets a bound [default: as in robot.toml, or 50].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    horizon: Option<u32>,
    /// The robot.toml that names the columns [default: as for evaluate].
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Where the blob with the bounds is written [default: in place].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Tell whether a blob's predictions stay with the data: small deviations along the logs, and rollouts
/// that diverge or leave the range.
#[derive(Args)]
struct StabilityArgs {
    /// The blob.
    model: PathBuf,
    /// Folder of CSV logs, or one CSV file.
    #[arg(long, value_name = "DIR")]
    logs: PathBuf,
    /// The robot.toml that names the columns [default: as for evaluate].
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Steps of a rollout [default: as in robot.toml, or 50].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    horizon: Option<u32>,
    /// Samples between the starts of two rollouts [default: as in robot.toml, or 10].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    stride: Option<u32>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Search the sparse model with the best rollouts that fits a controller's budget.
///
/// Looks at the states, inputs and logs of a robot, not at its dictionary. Writes a folder with the
/// winner's robot.toml, its blob, a plot of rollout error against instructions, and a journal from
/// which an interrupted search goes on.
#[derive(Args)]
struct SelectArgs {
    /// The robot's folder, or its robot.toml.
    robot: PathBuf,
    /// Folder of CSV logs, or one CSV file [default: logs/ beside robot.toml].
    #[arg(long, value_name = "DIR")]
    logs: Option<PathBuf>,
    /// Folder for what is found [default: selected/ beside robot.toml].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Most instructions of one step, by the cost table [default: as in robot.toml, or no limit].
    #[arg(long, value_name = "N")]
    max_instructions: Option<u32>,
    /// Most bytes of the blob [default: as in robot.toml, or no limit].
    #[arg(long, value_name = "N")]
    max_bytes: Option<u32>,
    /// Most terms beside the constant [default: as in robot.toml, or 60].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=255))]
    max_terms: Option<u32>,
    /// Oldest sample looked at; 0: the present one alone [default: as in robot.toml, or 5].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=5))]
    max_lag: Option<u32>,
    /// Stop after this many candidates: the number that a report gives repeats its search exactly.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    max_candidates: Option<u32>,
    /// Stop searching after this many seconds; where that is depends on the machine. Some models of
    /// the front are refined after that.
    #[arg(long, value_name = "S", default_value_t = 80, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    time_limit: u32,
    /// Threads; the result does not depend on them.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=64))]
    threads: u8,
}

/// Show everything in a blob in readable form.
#[derive(Args)]
struct InspectArgs {
    /// The blob.
    model: PathBuf,
    /// Show every term of the equations, not only the largest.
    #[arg(long)]
    all: bool,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Put a blob in fixed point, for controllers without a floating-point unit (firmware_core::q31).
///
/// Prints the scale of every coordinate and input, and how far one step is off at random samples within
/// the trained range; with --logs also rollouts over these.
#[derive(Args)]
struct ExportArgs {
    /// The blob.
    model: PathBuf,
    /// In fixed point: 32-bit integers of stated scales.
    #[arg(long, required = true)]
    q31: bool,
    /// Where the new blob is written.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How much wider than the trained range full scale is, on each side, as a share of the range.
    #[arg(long, value_name = "SHARE", default_value_t = 0.25)]
    margin: f64,
    /// Full scale of a coordinate on R or an input, in its unit, from the centre of its range [default: the
    /// trained range and the margin; else the limits; else 256 steps of the longest change]. May be repeated.
    #[arg(long, value_name = "NAME=VALUE")]
    full_scale: Vec<String>,
    /// Also compare rollouts over these logs with those in f32.
    #[arg(long, value_name = "DIR")]
    logs: Option<PathBuf>,
    /// The robot.toml that names the columns [default: as for evaluate].
    #[arg(long, value_name = "FILE", requires = "logs")]
    robot: Option<PathBuf>,
    /// Steps of a rollout [default: as in robot.toml, or 50].
    #[arg(long, value_name = "N", requires = "logs", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    horizon: Option<u32>,
    /// Samples between the starts of two rollouts [default: as in robot.toml, or 10].
    #[arg(long, value_name = "N", requires = "logs", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    stride: Option<u32>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Show the Koopman eigenvalues of a robot's operator while its inputs are held, with their modes.
#[derive(Args)]
struct SpectrumArgs {
    /// The robot's folder, or its robot.toml.
    robot: PathBuf,
    /// Folder of CSV logs, or one CSV file [default: logs/ beside robot.toml].
    #[arg(long, value_name = "DIR")]
    logs: Option<PathBuf>,
    /// The inputs that are held, in their order and units, separated by commas [default: all 0].
    #[arg(long, value_name = "U1,U2,...", value_delimiter = ',', allow_hyphen_values = true)]
    input: Vec<String>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Show the lifting functions of a topology, as in the ACD-EDMD paper's table.
#[derive(Args)]
struct DictionaryArgs {
    /// A product of R^n (or E^n), S^1, T^n and S^2, such as "R^2 x S^1".
    topology: String,
    /// Number of inputs.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=12))]
    inputs: u8,
    /// Highest Hermite order: a number for all variables, or NAME=N for one; 0 leaves it out. May
    /// be repeated or separated by commas.
    #[arg(long, value_name = "N|NAME=N", value_delimiter = ',')]
    order: Vec<String>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Put logs on an even time grid: states are interpolated, inputs are held.
#[derive(Args)]
struct ResampleArgs {
    /// Folder of CSV logs, or one CSV file.
    logs: PathBuf,
    /// Step of the new grid in seconds.
    #[arg(long, value_name = "SECONDS")]
    dt: f64,
    /// Folder for the new logs.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The robot.toml that says which columns are states, inputs and angles.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["time", "episode", "inputs", "angles", "degrees"])]
    robot: Option<PathBuf>,
    /// Without a robot.toml: the time column.
    #[arg(long, value_name = "COLUMN", default_value = "time_s")]
    time: String,
    /// Without a robot.toml: the episode column.
    #[arg(long, value_name = "COLUMN")]
    episode: Option<String>,
    /// Without a robot.toml: columns that are inputs; all others are states.
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    inputs: Vec<String>,
    /// Without a robot.toml: states that are angles in radians, interpolated the short way round.
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    angles: Vec<String>,
    /// Without a robot.toml: states that are angles in degrees.
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    degrees: Vec<String>,
    /// Average each input over the new interval instead of taking the value held at its start.
    #[arg(long)]
    mean_inputs: bool,
    /// Longest gap that is interpolated, in seconds [default: ten steps of the new grid]; a longer
    /// one starts a new file.
    #[arg(long, value_name = "SECONDS")]
    max_gap: Option<f64>,
}

/// Run the experiments of the ACD-EDMD paper with every method, and print its tables beside ours.
///
/// Also writes the report (report.md) and the paper's figures drawn from these results (SVG).
#[derive(Args)]
struct ReproduceArgs {
    /// Logs written by `firmware-sim record paper --out DIR`.
    dir: PathBuf,
    /// Folder for the report and the figures.
    #[arg(long, value_name = "DIR", default_value = "paper-report")]
    out: PathBuf,
    /// Leave out EDMD-DL, which takes most of the time.
    #[arg(long)]
    quick: bool,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Listen to a controller: show its telemetry, and record it as logs that `fit` reads.
///
/// A new log begins whenever a frame is missing, a measurement is missing, or the robot has stopped.
#[derive(Args)]
struct MonitorArgs {
    /// Serial device, pseudo-terminal, or tcp:HOST:PORT.
    #[arg(long, value_name = "PORT")]
    port: String,
    /// The robot's folder, or its robot.toml: names and units of what the controller tells.
    #[arg(long, value_name = "FILE")]
    robot: PathBuf,
    /// New folder for the logs.
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Stop after this time [default: when the line is closed, or at Ctrl-C; what was recorded is there].
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    seconds: Option<u32>,
    /// Bits per second of a serial device.
    #[arg(long, value_name = "N", default_value_t = 576_000, value_parser = clap::value_parser!(u32).range(300..=20_000_000))]
    baud: u32,
}

/// Make a pair of keys: whose models a controller installs.
///
/// Prints the public key as the firmware takes it. The secret one signs models; keep it off the robots,
/// and keep a copy: it is not to be had again.
#[derive(Args)]
struct KeygenArgs {
    /// Name of the new files: NAME.key and NAME.pub.
    #[arg(long, value_name = "NAME")]
    out: PathBuf,
}

/// Sign a model, so that a controller which trusts the key installs it.
#[derive(Args)]
struct SignArgs {
    /// The blob.
    model: PathBuf,
    /// The secret key, NAME.key of `keygen`.
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Number of the release. A controller installs none with a smaller number than it has confirmed.
    #[arg(long, value_name = "N")]
    sequence: u32,
    /// Where the signatures are written [default: MODEL.sig beside the model].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Install a model on a controller, over the line, without its firmware.
///
/// The robot has to be at rest. The model runs on trial first, and is kept when enough ticks in a row were
/// good; otherwise the next restart goes back to the model before. An update that was interrupted goes
/// on where it stopped when the same command is run again.
#[derive(Args)]
struct FlashArgs {
    /// The blob.
    model: PathBuf,
    /// Serial device, pseudo-terminal, or tcp:HOST:PORT.
    #[arg(long, value_name = "PORT")]
    port: String,
    /// Bits per second of a serial device.
    #[arg(long, value_name = "N", default_value_t = 576_000, value_parser = clap::value_parser!(u32).range(300..=20_000_000))]
    baud: u32,
    /// The signatures of the model, by `sign` [default: MODEL.sig beside it, if that is there].
    #[arg(long, value_name = "FILE")]
    signature: Option<PathBuf>,
    /// Only tell who is there, and whether the model could be installed.
    #[arg(long)]
    dry_run: bool,
    /// Stop when the model runs on trial: the same command without this confirms it.
    #[arg(long)]
    trial: bool,
    /// Stop the robot if it is running: a model is installed and confirmed only while it stands.
    #[arg(long, conflicts_with = "dry_run")]
    stop: bool,
}

/// A message for the user.
struct Failure(String);

impl<E: Display> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(error.to_string())
    }
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Fit(args) => fit(&args),
        Command::Evaluate(args) => evaluate(&args),
        Command::Monitor(args) => monitor(&args),
        Command::Inspect(args) => show_blob(&args),
        Command::Export(args) => export_model(&args),
        Command::Calibrate(args) => calibrate(&args),
        Command::Stability(args) => stability(&args),
        Command::Select(args) => select_model(&args),
        Command::Spectrum(args) => spectrum(&args),
        Command::Dictionary(args) => dictionary(&args),
        Command::Resample(args) => resample_logs(&args),
        Command::Reproduce(args) => reproduce_paper(&args),
        Command::Keygen(args) => keygen(&args),
        Command::Sign(args) => sign(&args),
        Command::Flash(args) => flash_command::flash(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(message)) => {
            eprintln!("error: {message}");
            ExitCode::FAILURE
        }
    }
}

/// Prints to standard output; a reader that went away is not an error.
fn print(text: &str) -> Result<(), Failure> {
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print(&(serde_json::to_string_pretty(value)? + "\n"))
}

/// A bar on standard error, where that is a terminal.
fn bar(what: &'static str, bytes: u64) -> ProgressBar {
    let bar = ProgressBar::new(bytes);
    if let Ok(style) =
        ProgressStyle::with_template("{msg:9} {wide_bar} {bytes}/{total_bytes} {eta}")
    {
        bar.set_style(style);
    }
    bar.set_message(what);
    bar
}

/// `fit --json`.
#[derive(Serialize)]
struct FitReport<'r> {
    format: u32,
    command: &'static str,
    robot: &'r str,
    model: ModelReport,
    fit: OperatorReport,
    score: Option<ScoreReport>,
    /// Why there is no score.
    unscored: Option<String>,
    /// Errors over the logs of --test.
    test: Option<TestReport>,
}

#[derive(Serialize)]
struct ModelReport {
    file: String,
    bytes: usize,
    terms: usize,
    outputs: usize,
    coefficients: usize,
    zeros: usize,
    lag: usize,
    blocks: Vec<String>,
    logs_sha256: String,
    robot_sha256: String,
}

#[derive(Serialize)]
struct OperatorReport {
    method: &'static str,
    scale_columns: bool,
    ridge: f64,
    truncation: f64,
    refine: Option<f64>,
    refinement_windows: usize,
    refinement_steps: usize,
    trajectories: usize,
    rows: u64,
    pairs: u64,
    rank: usize,
    condition: f64,
}

/// Where a robot's files are, given its folder or its robot.toml.
fn folder(robot: &Path) -> PathBuf {
    if robot.is_dir() {
        robot.to_owned()
    } else {
        robot.parent().map(Path::to_owned).unwrap_or_default()
    }
}

fn fit(args: &FitArgs) -> Result<(), Failure> {
    let robot = Robot::load(&args.robot)?;
    let folder = folder(&args.robot);
    let logs = args.logs.clone().unwrap_or_else(|| folder.join("logs"));
    let out = args.out.clone().unwrap_or_else(|| folder.join("model.bin"));
    if out.extension().is_some_and(|e| e == "toml" || e == "csv") {
        let out = out.display();
        return Err(Failure(format!(
            "{out}: a blob must not take the place of a description or a log; give --out FILE.bin"
        )));
    }
    let recording = Recording::open(&logs)?;
    let source = Logs { recording: &recording, schema: &robot.schema };
    let test = args.test.as_deref().map(Recording::open).transpose()?;

    let reading = bar("fitting", recording.bytes());
    let fitted = edmd::fit(&robot, &source, &|bytes| reading.set_position(bytes));
    reading.finish_and_clear();
    let fitted = fitted?;
    let bytes = export(&fitted)?;

    let (mut report, mut unscored) = (None, None);
    if !args.no_score {
        let counts =
            Counts { trajectories: fitted.summary.trajectories, rows: fitted.summary.rows };
        let scoring = bar("scoring", recording.bytes());
        let lifted = Lifted::Fitted(&fitted.structure, fitted.chain, &robot.fit);
        let scored =
            score::score(&source, counts, lifted, &robot.score, None, &|b| scoring.set_position(b));
        scoring.finish_and_clear();
        match scored {
            Ok(score) => report = Some(ScoreReport::new(&score, &labels(&fitted.structure))),
            Err(
                error @ (score::ScoreError::NoWindow { .. }
                | score::ScoreError::HoldOut { .. }
                | score::ScoreError::Untrained { .. }),
            ) => {
                unscored = Some(error.to_string());
            }
            Err(error) => return Err(error.into()),
        }
    }
    let test = match &test {
        None => None,
        Some(recording) => {
            let test = collect(&Logs { recording, schema: &robot.schema })?;
            let horizon = args.horizon.map_or(robot.score.horizon, |h| h as usize);
            Some(TestReport::measure(&fitted, &test, horizon)?)
        }
    };
    write_whole(&out, |file| file.write_all(&bytes))?;

    let coefficients =
        controller_coefficients(fitted.structure.dictionary(), fitted.chain, &fitted.operator);
    let options = robot.fit;
    let provenance = fitted.structure.provenance();
    let report = FitReport {
        format: 1,
        command: "fit",
        robot: &robot.name,
        model: ModelReport {
            file: out.display().to_string(),
            bytes: bytes.len(),
            terms: fitted.operator.terms,
            outputs: fitted.operator.outputs,
            coefficients: coefficients.len(),
            zeros: coefficients.iter().filter(|c| **c == 0.0).count(),
            lag: fitted.structure.lag(),
            blocks: blocks(&fitted.structure),
            logs_sha256: hexadecimal(&provenance.logs),
            robot_sha256: hexadecimal(&provenance.robot),
        },
        fit: OperatorReport {
            method: match options.method {
                Method::Cholesky => "cholesky",
                Method::Qr => "qr",
                Method::Svd => "svd",
            },
            scale_columns: options.scale_columns,
            ridge: options.ridge,
            truncation: options.truncation,
            refine: options.refine,
            refinement_windows: fitted.refined.map_or(0, |r| r.windows),
            refinement_steps: fitted.refined.map_or(0, |r| r.steps),
            trajectories: fitted.summary.trajectories,
            rows: fitted.summary.rows,
            pairs: fitted.operator.pairs,
            rank: fitted.operator.rank,
            condition: fitted.operator.condition(),
        },
        score: report,
        unscored,
        test,
    };
    if args.json { print_json(&report) } else { print(&fit_text(&report)) }
}

fn fit_text(report: &FitReport<'_>) -> String {
    let (model, fit) = (&report.model, &report.fit);
    let truncation = if fit.method == "svd" {
        format!(", truncation {}", fit.truncation)
    } else {
        String::new()
    };
    let scaled = if fit.scale_columns { "columns scaled" } else { "columns not scaled" };
    let mut text = format!(
        "{}: {} trajectories, {} rows, {} snapshot pairs\n\
         dictionary: {} terms, {} outputs, largest lag {}\n",
        report.robot,
        grouped(fit.trajectories as u64),
        grouped(fit.rows),
        grouped(fit.pairs),
        model.terms,
        model.outputs,
        model.lag
    );
    const SHOWN: usize = 6;
    for block in model.blocks.iter().take(SHOWN) {
        text += &format!("  {block}\n");
    }
    if model.blocks.len() > SHOWN {
        text += &format!("  and {} more blocks\n", model.blocks.len() - SHOWN);
    }
    let refined = match (fit.refine, fit.refinement_windows, fit.refinement_steps) {
        (None, ..) => String::new(),
        (Some(_), 0, _) => "not refined: no window of the horizon in the logs\n".to_owned(),
        (Some(_), _, 0) => "not refined: a rollout diverges, or no step gains\n".to_owned(),
        (Some(kappa), windows, steps) => {
            format!(
                "refined by the rollouts of {windows} windows, held by {kappa}, in {steps} steps\n"
            )
        }
    };
    text += &format!(
        "fit: {}, {scaled}, ridge {}{truncation}; numerical rank {} of {}, condition number {}\n\
         {refined}model: {}, {} bytes, {} of them coefficients ({} of {} zero)\n",
        fit.method,
        fit.ridge,
        fit.rank,
        model.terms,
        if fit.condition.is_finite() { significant(fit.condition) } else { "infinite".to_owned() },
        model.file,
        grouped(model.bytes as u64),
        grouped(4 * model.coefficients as u64),
        model.zeros,
        model.coefficients
    );
    if let Some(score) = &report.score {
        text += &format!("\n{}", score.table(false));
    }
    if let Some(reason) = &report.unscored {
        text += &format!("\nnot scored: {reason}\n");
    }
    if let Some(test) = &report.test {
        text += &format!("\ntest logs: {}", test.text());
    }
    text
}

/// Names and units of the states.
fn labels<'s>(structure: &'s Structure<'_>) -> Vec<(&'s str, &'s str)> {
    structure.states().iter().map(|s| (s.name, s.unit)).collect()
}

/// Bytes of a blob at an address that the core accepts.
struct BlobFile {
    words: Vec<u32>,
    length: usize,
}

impl BlobFile {
    fn read(path: &Path) -> Result<Self, Failure> {
        let bytes =
            std::fs::read(path).map_err(|e| format!("{}: cannot be read: {e}", path.display()))?;
        Ok(Self::aligned(&bytes))
    }

    fn aligned(bytes: &[u8]) -> Self {
        let mut words = vec![0_u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { words, length: bytes.len() }
    }

    fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }
}

fn refused(path: &Path, error: blob::ParseError) -> Failure {
    use blob::ParseError::{
        Checksum, FixedPoint, Magic, SelfTest, Trailing, Truncated, UnknownSection, Version,
    };
    let reason = match error {
        Magic => {
            "this is not a model blob; expected a file that `trainer fit` has written".to_owned()
        }
        Version { found } => {
            format!(
                "format version {found}; this program reads version {}: fit the model again",
                blob::VERSION
            )
        }
        Truncated { expected, found } => {
            format!("{found} bytes of {expected}: the file is cut off; copy or fit it again")
        }
        Trailing { expected, found } => {
            format!(
                "{found} bytes where the blob has {expected}: something was appended; copy or fit it again"
            )
        }
        Checksum { .. } => {
            "the checksum does not match: the file is damaged; copy or fit it again".to_owned()
        }
        FixedPoint => {
            "a model in fixed point; only `trainer inspect` reads one, and a controller by q31::parse; give the \
             blob that it was made from"
                .to_owned()
        }
        UnknownSection { kind, .. } => {
            format!(
                "a section of kind {kind:#06x} that this program does not know: it is older than the model"
            )
        }
        SelfTest { .. } => {
            "the stored prediction is not reproduced: this program computes something else"
                .to_owned()
        }
        other => format!("{other:?}"),
    };
    Failure(format!("{}: {reason}", path.display()))
}

/// The columns of a log, from the description beside the blob or the blob itself; and the options
/// for scoring.
fn log_schema(
    (path, robot): (&Path, Option<&PathBuf>),
    (horizon, stride): (Option<u32>, Option<u32>),
    model: &Model<'_>,
) -> Result<(LogSchema, ScoreOptions, Option<Robot>), Failure> {
    let structure = model.structure();
    let beside = path.parent().unwrap_or(Path::new("")).join("robot.toml");
    let description = robot.cloned().or_else(|| beside.is_file().then_some(beside));
    let (schema, mut options, robot) = match description {
        Some(description) => {
            let robot = Robot::load(&description)?;
            let states = robot.states.iter().map(|s| (s.name.as_str(), s.unit.as_str(), s.space));
            let inputs = robot.inputs.iter().map(|u| (u.name.as_str(), u.unit.as_str()));
            if robot.name != structure.robot()
                || !states.eq(structure.states().iter().map(|s| (s.name, s.unit, s.space)))
                || !inputs.eq(structure.inputs().iter().map(|u| (u.name, u.unit)))
                || robot.schema.sample_time_s as f32 != structure.sample_time_s()
            {
                return Err(Failure(format!(
                    "{}: the model belongs to `{}`, but {} describes `{}` or other states, inputs or \
                     sample time; give the right one with --robot",
                    path.display(),
                    structure.robot(),
                    description.display(),
                    robot.name
                )));
            }
            (robot.schema.clone(), robot.score.clone(), Some(robot))
        }
        None => {
            let states = structure.states().iter().map(|s| LogColumn::new(s.name, s.unit));
            let inputs = structure.inputs().iter().map(|u| LogColumn::new(u.name, u.unit));
            // The decimal number that was meant: 0.1, not 0.10000000149.
            let dt = structure.sample_time_s();
            let dt = dt.to_string().parse().unwrap_or(f64::from(dt));
            let schema = LogSchema::new(dt, states.collect(), inputs.collect());
            (schema, ScoreOptions::default(), None)
        }
    };
    options.hold_out.clear();
    if let Some(horizon) = horizon {
        options.horizon = horizon as usize;
    }
    if let Some(stride) = stride {
        options.stride = stride as usize;
    }
    Ok((schema, options, robot))
}

/// `evaluate --json`.
#[derive(Serialize)]
struct EvaluateReport<'r> {
    format: u32,
    command: &'static str,
    robot: &'r str,
    model: String,
    logs: String,
    score: ScoreReport,
    /// How well the blob's error bounds hold here; `null` where it has none.
    error_bounds: Option<CoverageReport>,
}

fn evaluate(args: &EvaluateArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let place = (args.model.as_path(), args.robot.as_ref());
    let (schema, options, _) = log_schema(place, (args.horizon, args.stride), &model)?;
    let recording = Recording::open(&args.logs)?;
    let source = Logs { recording: &recording, schema: &schema };
    if let Some(path) = &args.csv
        && args.logs.is_dir()
        && recording.files().iter().any(|log| log.parent() == path.parent())
    {
        return Err(Failure(format!(
            "{}: beside the logs, the predictions would be read as a log; give --csv another folder",
            path.display()
        )));
    }
    let training = args.train.as_deref().map(Recording::open).transpose()?;
    let scoring = bar("scoring", recording.bytes());
    let progress = |bytes| scoring.set_position(bytes);

    let run = |predictions: Option<&mut dyn Write>| -> Result<score::Score, Failure> {
        match &training {
            None => {
                let counts = score::count(&source, &[])?;
                Ok(score::score(
                    &source,
                    counts,
                    Lifted::Given(&model),
                    &options,
                    predictions,
                    &progress,
                )?)
            }
            Some(training) => {
                let training = Logs { recording: training, schema: &schema };
                let counts = score::count(&training, &[])?;
                let training = (&training, counts);
                Ok(score::score_elsewhere(
                    &source,
                    training,
                    &model,
                    &options,
                    predictions,
                    &progress,
                )?)
            }
        }
    };
    let mut outcome = None;
    let written = match &args.csv {
        None => {
            outcome = Some(run(None));
            Ok(())
        }
        Some(path) => write_whole(path, |out| {
            let result = run(Some(out));
            let failed = result.is_err();
            outcome = Some(result);
            // The file must not appear when there is no score.
            if failed { Err(std::io::Error::other("not scored")) } else { Ok(()) }
        }),
    };
    scoring.finish_and_clear();
    let score = match outcome {
        Some(result) => result?,
        None => return written.map_err(Failure::from),
    };
    written?;
    let structure = model.structure();
    let report = EvaluateReport {
        format: 1,
        command: "evaluate",
        robot: structure.robot(),
        model: args.model.display().to_string(),
        logs: args.logs.display().to_string(),
        score: ScoreReport::new(&score, &labels(structure)),
        error_bounds: covered(&model, &source)?,
    };
    if args.json {
        return print_json(&report);
    }
    let bounds = report.error_bounds.as_ref().map_or_else(String::new, CoverageReport::text);
    print(&format!("{} on {}\n{}{bounds}", report.model, report.logs, report.score.table(true)))
}

/// How well the error bounds of a model, if it has any, hold on logs.
fn covered(model: &Model<'_>, source: &Logs<'_>) -> Result<Option<CoverageReport>, Failure> {
    let Some(bounds) = model.error_bounds() else { return Ok(None) };
    let trajectories = collect(source)?;
    let horizon = bounds.horizons().last().map_or(0, |h| *h as usize);
    let least = least_units(f64::from(bounds.coverage()))?;
    let Ok(residuals) = Residuals::measure(model, &trajectories, horizon, least) else {
        // The logs are shorter than the bounds' horizon; the score is there all the same.
        return Ok(None);
    };
    let names: Vec<&str> = model.structure().states().iter().map(|s| s.name).collect();
    Ok(CoverageReport::new(&residuals, bounds, &names))
}

fn calibrate(args: &CalibrateArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let test = blob::self_test(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let place = (args.model.as_path(), args.robot.as_ref());
    let (schema, options, described) = log_schema(place, (args.horizon, None), &model)?;
    let least = least_units(args.coverage)?;
    let recording = Recording::open(&args.logs)?;
    let source = Logs { recording: &recording, schema: &schema };
    let (trajectories, summary) = collect_summed_up(&source)?;
    let trajectories: Vec<Trajectory> = trajectories.into_iter().map(|(_, t)| t).collect();
    let seen = summary.sha256 == model.structure().provenance().logs;
    let (residuals, covered) = match (args.cross_validate, seen) {
        (false, false) => {
            (Residuals::measure(&model, &trajectories, options.horizon, least)?, None)
        }
        (true, true) => {
            let robot = described.filter(|r| r.sha256 == model.structure().provenance().robot);
            let robot = robot.ok_or_else(|| {
                "--cross-validate needs the robot.toml of the fit, unchanged: give it with --robot, \
                 or fit again"
                    .to_owned()
            })?;
            let bar = ProgressBar::new(robot.score.folds as u64);
            if let Ok(style) = ProgressStyle::with_template("fold {pos}/{len} {wide_bar} {elapsed}")
            {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(200));
            let cross =
                CrossResiduals::measure(&robot, &trajectories, options.horizon, least, &|fold| {
                    bar.set_position(fold as u64)
                });
            bar.finish_and_clear();
            let cross = cross?;
            let names: Vec<&str> = labels(model.structure()).into_iter().map(|l| l.0).collect();
            (cross.pooled(None), Some(cross.coverage(args.coverage, &names)))
        }
        (false, true) => {
            return Err(Failure(format!(
                "{}: the model was fitted on these very logs, on which it errs less than on others; \
                 give logs that it has not seen, or add --cross-validate",
                args.logs.display()
            )));
        }
        (true, false) => {
            return Err(Failure(format!(
                "{}: --cross-validate leaves out parts of the logs that the model was fitted on, and \
                 these are others; give those, or leave it out",
                args.logs.display()
            )));
        }
    };
    let bounds = residuals.bounds(args.coverage)?;
    let states: Vec<(String, String)> = labels(model.structure())
        .into_iter()
        .map(|(name, unit)| (name.to_owned(), unit.to_owned()))
        .collect();
    let bytes = with_bounds(model, &test, args.coverage, &residuals, &bounds, file.bytes().len())
        .map_err(|e| Failure(format!("the blob cannot be written: {e:?}")))?;
    let out = args.out.as_ref().unwrap_or(&args.model);
    write_whole(out, |file| file.write_all(&bytes))?;

    let units = match residuals.unit {
        Unit::Trajectory => "trajectories, one window each",
        Unit::Block => "contiguous blocks: too few trajectories for units of their own",
    };
    let mut text = format!(
        "{}: {} bytes, error bounds for {} % from {} {units}\n",
        out.display(),
        grouped(bytes.len() as u64),
        100.0 * args.coverage,
        residuals.units()
    );
    let n = states.len();
    for (i, (name, unit)) in states.iter().enumerate() {
        let at = |step: usize| significant(f64::from(bounds[(step - 1) * n + i]));
        let last = residuals.horizon;
        text += &format!(
            "  {name} [{unit}]: {} after 1 step, {} after {}, {} after {last}\n",
            at(1),
            at(last.div_ceil(2)),
            last.div_ceil(2),
            at(last)
        );
    }
    match covered {
        Some(Ok(Some(report))) => {
            text += "Cross-validated: each fold asked with the bounds from the others.\n";
            text += &report.text();
        }
        Some(Err(error)) => {
            text += &format!("Whether the bounds hold cannot be asked fold by fold: {error}\n");
        }
        Some(Ok(None)) | None => {}
    }
    print(&text)
}

fn keygen(args: &KeygenArgs) -> Result<(), Failure> {
    let key = SecretKey::generate()?;
    let (secret, public) = key.write(&args.out)?;
    print(&format!(
        "{}: secret, signs models; keep it off the robots\n{}: public\n\n{}\n\n\
         A controller with this key says that it begins {}\n",
        secret.display(),
        public.display(),
        rust_line(&key.public()),
        hexadecimal(&key.public().0[..8])
    ))
}

fn sign(args: &SignArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let key = SecretKey::read(&args.key)?;
    let out = args.out.clone().unwrap_or_else(|| args.model.with_extension("sig"));
    let found = out.canonicalize().ok();
    for (taken, what) in [(&args.model, "model"), (&args.key, "secret key")] {
        if found.is_some() && taken.canonicalize().ok() == found {
            return Err(Failure(format!(
                "{}: the {what} would be replaced by its signatures; give another --out",
                out.display()
            )));
        }
    }
    let robot = model.structure().robot();
    let signed = SignedRelease::new(&key, robot, args.sequence, file.bytes());
    let signed = signed.ok_or_else(|| format!("{}: too long", args.model.display()))?;
    write_whole(&out, |file| file.write_all(signed.text().as_bytes()))?;
    print(&format!(
        "{}: {}, {} bytes, as release {} for `{robot}`, signed with the key that begins {}\n",
        out.display(),
        args.model.display(),
        grouped(file.bytes().len() as u64),
        args.sequence,
        hexadecimal(&key.public().0[..8])
    ))
}

fn monitor(args: &MonitorArgs) -> Result<(), Failure> {
    let robot = Robot::load(&args.robot)?;
    let mut port = Port::open(&args.port, args.baud)?;
    let failed = |dir: &Path, e: std::io::Error| Failure(format!("{}: {e}", dir.display()));
    let mut recorder = match &args.record {
        Some(dir) => Some(Recorder::new(dir, &robot).map_err(|e| failed(dir, e))?),
        None => None,
    };
    let live = std::io::stdout().is_terminal();
    if live {
        write!(std::io::stdout(), "\x1b[2J")?;
    }
    let until = args.seconds.map(|s| Instant::now() + Duration::from_secs(s.into()));
    let heard = listen(&mut port, &robot, until, &mut |frame| {
        if let Some(recorder) = &mut recorder {
            recorder.frame(frame)?;
        }
        if live {
            let mut out = std::io::stdout().lock();
            write!(out, "\x1b[H{}", picture(frame, &robot))?;
            out.flush()?;
        }
        Ok(())
    });
    let heard = heard.map_err(|e| format!("{}: {e}", args.port))?;
    let mut text = format!(
        "{} frames, {} missing, {} damaged\n",
        grouped(heard.frames),
        grouped(heard.lost),
        grouped(heard.damaged)
    );
    if heard.strange > 0 {
        text += &format!(
            "{} frames had other states or inputs than {}: is this the right robot?\n",
            grouped(heard.strange),
            robot.name
        );
    }
    if let (Some(recorder), Some(dir)) = (&recorder, &args.record) {
        let (episodes, rows) = recorder.written();
        text += &format!("{}: {episodes} logs, {} rows\n", dir.display(), grouped(rows));
    }
    print(&text)?;
    if heard.frames == 0 {
        return Err(Failure(format!(
            "{}: nothing was heard of a robot like {}; is the controller running, at {} baud?",
            args.port, robot.name, args.baud
        )));
    }
    Ok(())
}

/// `stability --json`.
#[derive(Serialize)]
struct StabilityReport<'r> {
    format: u32,
    command: &'static str,
    robot: &'r str,
    model: String,
    logs: String,
    #[serde(flatten)]
    stability: Stability,
}

fn stability(args: &StabilityArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let place = (args.model.as_path(), args.robot.as_ref());
    let (schema, options, _) = log_schema(place, (args.horizon, args.stride), &model)?;
    let recording = Recording::open(&args.logs)?;
    let logs = collect_named(&Logs { recording: &recording, schema: &schema })?;
    let report = StabilityReport {
        format: 1,
        command: "stability",
        robot: model.structure().robot(),
        model: args.model.display().to_string(),
        logs: args.logs.display().to_string(),
        stability: Stability::measure(&model, &logs, &options)?,
    };
    if args.json {
        return print_json(&report);
    }
    print(&format!("{} on {}\n{}", report.model, report.logs, report.stability.text()))
}

/// `inspect --json`.
#[derive(Serialize)]
struct InspectReport<'i> {
    format: u32,
    command: &'static str,
    #[serde(flatten)]
    inspection: &'i Inspection,
}

fn show_blob(args: &InspectArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let inspection = match inspect(file.bytes()) {
        Err(blob::ParseError::FixedPoint) => return show_fixed_point(args, file.bytes()),
        inspection => inspection.map_err(|e| refused(&args.model, e))?,
    };
    if args.json {
        return print_json(&InspectReport {
            format: 1,
            command: "inspect",
            inspection: &inspection,
        });
    }
    print(&inspection.text(args.all))
}

/// `export --json`.
#[derive(Serialize)]
struct ExportReport<'r> {
    format: u32,
    command: &'static str,
    robot: &'r str,
    model: String,
    bytes: usize,
    coefficients: usize,
    coordinates: &'r [FixedCoordinate],
    inputs: &'r [FixedInput],
    one_step: &'r OneStep,
    /// Of --logs.
    logs: Option<&'r OnLogs>,
}

fn export_model(args: &ExportArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let test = blob::self_test(file.bytes()).map_err(|e| refused(&args.model, e))?;
    if args.out.extension().is_some_and(|e| e == "toml" || e == "csv")
        || args
            .out
            .canonicalize()
            .ok()
            .is_some_and(|out| args.model.canonicalize().ok() == Some(out))
    {
        let out = args.out.display();
        return Err(Failure(format!(
            "{out}: must not take the place of the model, a description or a log; give --out FILE.q31"
        )));
    }
    if !(args.margin.is_finite() && (0.0..=100.0).contains(&args.margin)) {
        return Err(Failure(format!("--margin {}: expected a number from 0 to 100", args.margin)));
    }
    let mut options = FixedOptions { margin: args.margin, full_scales: Vec::new() };
    for given in &args.full_scale {
        let value =
            given.split_once('=').and_then(|(name, v)| Some((name, v.trim().parse().ok()?)));
        let (name, value) = value.ok_or_else(|| {
            format!("--full-scale {given}: expected NAME=VALUE, such as x=10, in the unit of x")
        })?;
        options.full_scales.push((name.trim().to_owned(), value));
    }
    let failed = |error: FixedError| Failure(format!("{}: {error}", args.model.display()));
    let export = fixed_point(&model, &test, &options).map_err(failed)?;
    let fixed = BlobFile::aligned(&export.bytes);
    let fixed = q31::parse(fixed.bytes()).map_err(|e| failed(e.into()))?;
    let one_step = fixed_point::compare(&model, &fixed).map_err(failed)?;
    let logs = match &args.logs {
        None => None,
        Some(logs) => {
            let place = (args.model.as_path(), args.robot.as_ref());
            let (schema, options, _) = log_schema(place, (args.horizon, args.stride), &model)?;
            let recording = Recording::open(logs)?;
            let trajectories = collect(&Logs { recording: &recording, schema: &schema })?;
            let found = fixed_point::compare_on_logs(&model, &fixed, &trajectories, &options);
            Some(found.ok_or_else(|| {
                format!(
                    "{}: no trajectory is longer than {} steps; lower --horizon",
                    logs.display(),
                    options.horizon
                )
            })?)
        }
    };
    write_whole(&args.out, |file| file.write_all(&export.bytes))?;
    if args.json {
        return print_json(&ExportReport {
            format: 1,
            command: "export",
            robot: fixed.robot(),
            model: args.out.display().to_string(),
            bytes: export.bytes.len(),
            coefficients: export.coefficients,
            coordinates: &export.coordinates,
            inputs: &export.inputs,
            one_step: &one_step,
            logs: logs.as_ref(),
        });
    }
    print(&format!(
        "{}: {}, {} bytes, {}",
        args.out.display(),
        fixed.robot(),
        grouped(export.bytes.len() as u64),
        fixed_point::text(&export, &one_step, logs.as_ref())
    ))
}

/// `inspect --json` of a blob in fixed point.
#[derive(Serialize)]
struct InspectFixedReport<'i> {
    format: u32,
    command: &'static str,
    fixed_point: &'i FixedInspection,
}

fn show_fixed_point(args: &InspectArgs, bytes: &[u8]) -> Result<(), Failure> {
    let inspection = fixed_point::inspect(bytes).map_err(|e| match e {
        q31::LoadError::Blob(error) => refused(&args.model, error),
        other => Failure(format!("{}: {other:?}", args.model.display())),
    })?;
    if args.json {
        let (format, command) = (1, "inspect");
        return print_json(&InspectFixedReport { format, command, fixed_point: &inspection });
    }
    print(&inspection.text())
}

/// `spectrum --json`.
#[derive(Serialize)]
struct SpectrumJson<'r> {
    format: u32,
    command: &'static str,
    #[serde(flatten)]
    report: &'r SpectrumReport,
}

fn spectrum(args: &SpectrumArgs) -> Result<(), Failure> {
    let robot = Robot::load(&args.robot)?;
    let given = args.input.join(",");
    let number = |text: &String| {
        let value = text.trim().parse().ok().filter(|value: &f64| value.is_finite());
        value.ok_or_else(|| Failure(format!("--input {given}: `{text}` is not a finite number")))
    };
    let mut input = args.input.iter().map(number).collect::<Result<Vec<f64>, _>>()?;
    if input.is_empty() {
        input.resize(robot.inputs.len(), 0.0);
    } else if input.len() != robot.inputs.len() {
        let names: Vec<&str> = robot.inputs.iter().map(|u| u.name.as_str()).collect();
        return Err(Failure(format!(
            "--input {given}: expected {} values, found {}; the inputs of {} are: {}",
            names.len(),
            input.len(),
            robot.name,
            names.join(", ")
        )));
    }
    let recording =
        Recording::open(&args.logs.clone().unwrap_or_else(|| folder(&args.robot).join("logs")))?;
    let source = Logs { recording: &recording, schema: &robot.schema };
    let reading = bar("fitting", recording.bytes());
    let full = FullOperator::fit(&robot, &source, &|bytes| reading.set_position(bytes));
    reading.finish_and_clear();
    let report = SpectrumReport::new(&full?, robot.schema.sample_time_s, &input)?;
    if args.json {
        return print_json(&SpectrumJson { format: 1, command: "spectrum", report: &report });
    }
    print(&report.text())
}

/// `dictionary --json`.
#[derive(Serialize)]
struct DictionaryReport<'r> {
    format: u32,
    command: &'static str,
    topology: &'r str,
    state_functions: &'r str,
    functions: &'r str,
    terms: &'r [String],
}

fn dictionary(args: &DictionaryArgs) -> Result<(), Failure> {
    let mut orders = Orders { common: 1, by_name: Vec::new() };
    for order in &args.order {
        let bad =
            || Failure(format!("--order {order}: expected a whole number, or NAME=N such as u1=3"));
        match order.split_once('=') {
            None => orders.common = order.trim().parse().map_err(|_| bad())?,
            Some((name, n)) => {
                orders.by_name.push((name.trim().to_owned(), n.trim().parse().map_err(|_| bad())?));
            }
        }
    }
    let lifting = lifting(&args.topology, args.inputs.into(), &orders)?;
    if args.json {
        return print_json(&DictionaryReport {
            format: 1,
            command: "dictionary",
            topology: &args.topology,
            state_functions: &lifting.state_functions,
            functions: &lifting.functions,
            terms: &lifting.terms,
        });
    }
    let states: Vec<String> = lifting
        .states
        .iter()
        .map(|(name, angle)| format!("{name} on {}", if *angle { "S^1" } else { "R" }))
        .collect();
    let mut text = format!("states      {}\n", states.join(", "));
    if !lifting.inputs.is_empty() {
        text += &format!("inputs      {}\n", lifting.inputs.join(", "));
    }
    text += &format!("D(x)        {}\n", lifting.state_functions);
    if !lifting.inputs.is_empty() {
        text += &format!("dictionary  {}\n", lifting.functions);
    }
    text += &format!(
        "Hp(v) = [1, v, H2(v), ..., Hp(v)]; the first factor is the slowest index\n\n{} terms\n",
        lifting.terms.len()
    );
    for term in &lifting.terms {
        text += &format!("  {term}\n");
    }
    print(&text)
}

fn resample_logs(args: &ResampleArgs) -> Result<(), Failure> {
    let recording = Recording::open(&args.logs)?;
    let (schema, angles) = match &args.robot {
        Some(path) => {
            let robot = Robot::load(path)?;
            let angles = robot.states.iter().map(|s| s.space == Space::Circle).collect();
            (robot.schema, angles)
        }
        None => columns_by_name(args, &recording)?,
    };
    let mut plan = ResamplePlan::new(args.dt, schema);
    plan.angles = angles;
    if args.mean_inputs {
        plan.inputs = InputResampling::Mean;
    }
    if let Some(gap) = args.max_gap {
        plan.max_gap_s = gap;
    }
    let report = resample(&recording, &plan, &args.out)?;
    print(&format!(
        "{}: {} trajectories with {} rows, step {} s; {} gaps, {} pieces too short to keep\n",
        args.out.display(),
        report.files.len(),
        grouped(report.rows),
        args.dt,
        report.gaps,
        report.dropped
    ))
}

/// Columns by the names on the command line: what is no input is a state.
fn columns_by_name(
    args: &ResampleArgs,
    recording: &Recording,
) -> Result<(LogSchema, Vec<bool>), Failure> {
    let columns = recording.columns()?;
    let named = args.inputs.iter().chain(&args.angles).chain(&args.degrees);
    if let Some(missing) = named.into_iter().find(|name| !columns.contains(name)) {
        return Err(Failure(format!(
            "`{missing}` is not a column of the logs, which have {}",
            columns.join(", ")
        )));
    }
    let column = |name: &String| {
        let mut column = LogColumn::new(name.as_str(), "");
        column.column = Some(name.clone());
        if args.degrees.contains(name) {
            column.factor = std::f64::consts::PI / 180.0;
        }
        column
    };
    let is_state = |name: &&String| {
        **name != args.time && Some(*name) != args.episode.as_ref() && !args.inputs.contains(name)
    };
    let states: Vec<&String> = columns.iter().filter(is_state).collect();
    let angles =
        states.iter().map(|n| args.angles.contains(n) || args.degrees.contains(n)).collect();
    let mut schema = LogSchema::new(
        args.dt,
        states.into_iter().map(column).collect(),
        args.inputs.iter().map(column).collect(),
    );
    schema.time.clone_from(&args.time);
    schema.episode.clone_from(&args.episode);
    Ok((schema, angles))
}

fn reproduce_paper(args: &ReproduceArgs) -> Result<(), Failure> {
    let out = &args.out;
    if out.exists() && !out.is_dir() {
        return Err(Failure(format!("{}: not a folder; give another --out", out.display())));
    }
    let file = out.join("report.md");
    let own = |text: String| text.starts_with(Reproduction::HEADING);
    if file.exists() && !std::fs::read_to_string(&file).is_ok_and(own) {
        return Err(Failure(format!(
            "{}: not a report of `trainer reproduce`; give another --out",
            file.display()
        )));
    }
    let (logs, target) = (args.dir.canonicalize(), std::path::absolute(out));
    if let (Ok(logs), Ok(target)) = (logs, target)
        && target.starts_with(logs)
    {
        return Err(Failure(format!(
            "{}: among the logs, which are to stay as they were recorded; give another --out",
            out.display()
        )));
    }
    let is_new = !out.exists();
    std::fs::create_dir_all(out).map_err(|e| format!("{}: cannot be made: {e}", out.display()))?;
    let mut methods = PaperMethod::ALL.to_vec();
    methods.retain(|m| !(args.quick && *m == PaperMethod::EdmdDl));
    let bar = ProgressBar::new(1);
    if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} {elapsed} {msg:40}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(200));
    let results = reproduce::run(&args.dir, &methods, &|done, total, next| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
        bar.set_message(next.to_owned());
    });
    bar.finish_and_clear();
    if results.is_err() && is_new {
        // Nothing is in it yet; a folder that will not go is no further news.
        let _ = std::fs::remove_dir(out);
    }
    let results = results?;
    let mut report = results.text();
    let mut links = String::from("\n## Figures\n\n");
    for (name, svg) in figures::all(&results) {
        write_whole(&out.join(name), |file| file.write_all(svg.as_bytes()))?;
        links += &format!("![{name}]({name})\n");
    }
    report += &format!("\n{}", results.times());
    let whole = format!("{report}{links}");
    write_whole(&file, |file| file.write_all(whole.as_bytes()))?;
    if args.json {
        return print_json(&results);
    }
    print(&format!("{report}\nReport and figures: {}\n", file.display()))
}

fn select_model(args: &SelectArgs) -> Result<(), Failure> {
    let robot = Robot::load(&args.robot)?;
    let folder = folder(&args.robot);
    let file = if args.robot.is_dir() { args.robot.join("robot.toml") } else { args.robot.clone() };
    let original = std::fs::read_to_string(&file)
        .map_err(|e| format!("{}: cannot be read: {e}", file.display()))?;
    let logs = args.logs.clone().unwrap_or_else(|| folder.join("logs"));
    let out = args.out.clone().unwrap_or_else(|| folder.join("selected"));
    let recording = Recording::open(&logs)?;
    let source = Logs { recording: &recording, schema: &robot.schema };
    let description = out.join("robot.toml");
    if std::fs::canonicalize(&description)
        .is_ok_and(|found| std::fs::canonicalize(&file).is_ok_and(|given| given == found))
    {
        return Err(Failure(format!(
            "{}: the description that is searched for would be replaced; give another --out",
            description.display()
        )));
    }
    let is_new = !out.exists();
    std::fs::create_dir_all(&out).map_err(|e| format!("{}: cannot be made: {e}", out.display()))?;
    let default = Budget::default();
    let limit = |given: Option<u32>, described: Option<u32>, default: u32| {
        given.or(described).unwrap_or(default)
    };
    let described = robot.budget;
    let options = select::Options {
        budget: Budget {
            instructions: limit(
                args.max_instructions,
                described.max_instructions,
                default.instructions,
            ),
            bytes: limit(args.max_bytes, described.max_bytes, default.bytes),
            terms: args.max_terms.or(described.max_terms).map_or(default.terms, |n| n as usize),
            lag: args.max_lag.or(described.max_lag).map_or(default.lag, |n| n as usize),
            candidates: args.max_candidates.map_or(default.candidates, |n| n as usize),
            time: Duration::from_secs(args.time_limit.into()),
        },
        score: robot.score.clone(),
        threads: args.threads.into(),
        journal: Some(out.join("journal.jsonl")),
    };
    let bar = ProgressBar::new(args.time_limit.into());
    if let Ok(style) =
        ProgressStyle::with_template("{wide_bar} {elapsed} of at most {len} s  {msg}")
    {
        bar.set_style(style);
    }
    let found = select::select(&robot, &source, &options, &|progress| {
        bar.set_position(bar.elapsed().as_secs());
        bar.set_message(format!(
            "{} candidates, best NRMSE {}",
            grouped(progress.evaluated as u64),
            significant(progress.best)
        ));
    });
    bar.finish_and_clear();
    if found.is_err() && is_new {
        // Empty but for the journal of a search that found nothing.
        let _ = std::fs::remove_dir_all(&out);
    }
    let found = found?;
    let text = found.robot_toml(&original, found.winner);
    let chosen = Robot::parse(&text, &description)?;
    let fitted = edmd::fit(&chosen, &source, &|_| {})?;
    let bytes = export(&fitted)?;
    write_whole(&description, |file| file.write_all(text.as_bytes()))?;
    write_whole(&out.join("model.bin"), |file| file.write_all(&bytes))?;
    write_whole(&out.join("front.svg"), |file| file.write_all(found.figure().as_bytes()))?;
    let file = BlobFile::aligned(&bytes);
    let model =
        firmware_core::parse(file.bytes()).map_err(|e| refused(&out.join("model.bin"), e))?;
    let stability = Stability::measure(&model, &collect_named(&source)?, &robot.score)?;
    print(&format!(
        "{}\n\nThe winner, fitted on all trajectories, along them:\n{}\n{}: {} bytes\n\
         `trainer fit {} --logs {}` scores it\n",
        found.report().trim_end(),
        stability.text(),
        out.join("model.bin").display(),
        grouped(bytes.len() as u64),
        out.display(),
        logs.display()
    ))
}
