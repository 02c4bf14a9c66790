//! The command `firmware-sim`.

use clap::{Args, Parser, Subcommand};
use firmware_sim::Integrator;
use firmware_sim::paper::PaperLogs;
use firmware_sim::record::{Recording, Robot, Settings};
use std::error::Error;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

/// Simulated robots.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Records logs of a robot under random inputs, one CSV file per trial.
    ///
    /// Writes DIR/trial-000.csv, DIR/trial-001.csv, … with the header time_s,<states>,<inputs>. The
    /// input in a row acts until the next row. The same options give the same bytes.
    ///
    /// ROBOT is one of
    ///   rosbot        differential drive: x, y, phi; wheel speeds N(0, 9²) within ±32 rad/s; 10 Hz
    ///   skid-rosbot   invented skid-steered ROSbot: as rosbot; wheel speeds within ±16 rad/s, held 0.3 s to 2 s
    ///   two-link-arm  two joints: angles and rates; torques N(0, 1) Nm; 100 Hz
    ///   soft-leg      invented soft pneumatic leg: tip y, z; valve voltages held 0.2 s to 1 s; 20 Hz
    ///
    /// `record paper` writes the logs of all the paper's experiments instead.
    #[command(
        verbatim_doc_comment,
        allow_negative_numbers = true,
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        disable_help_subcommand = true
    )]
    Record {
        #[command(subcommand)]
        set: Option<LogSet>,
        #[command(flatten)]
        robot: Option<RobotLogs>,
    },
}

#[derive(Subcommand)]
enum LogSet {
    /// Records the logs of all the paper's experiments, in folders of DIR.
    ///
    /// Writes DIR/drive-euler/train/trial-000.csv, … and DIR/paper.toml, which lists the folders with
    /// their plants, sizes, inputs and noise. Nothing appears in DIR before everything is written.
    /// The same seed gives the same bytes.
    #[command(verbatim_doc_comment)]
    Paper {
        /// Seed of the inputs and the noise
        #[arg(long, value_name = "K", default_value_t = 1)]
        seed: u32,
        /// Directory for the logs, made if it does not exist; it must be empty
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Replace what an earlier `record paper` wrote to DIR
        #[arg(long)]
        overwrite: bool,
    },
}

#[derive(Args)]
struct RobotLogs {
    /// rosbot, skid-rosbot, two-link-arm or soft-leg
    robot: Robot,
    /// Number of trajectories
    #[arg(long, value_name = "N")]
    trials: u32,
    /// Duration of each trajectory; a part of a sample at its end is left out
    #[arg(long, value_name = "S")]
    seconds: f64,
    /// Seed of the inputs and the noise
    #[arg(long, value_name = "K")]
    seed: u64,
    /// Directory for the logs, made if it does not exist
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Add measurement noise of SCALE times the usual size (1 if SCALE is left out)
    ///
    /// Usual sizes: rosbot and skid-rosbot 1 mm and 2 mrad, two-link-arm 0.2 mrad and 5 mrad/s, soft-leg 0.1 mm.
    #[arg(long, value_name = "SCALE", num_args = 0..=1, default_value = "0", default_missing_value = "1", hide_default_value = true)]
    noise: f64,
    /// exact (rosbot only), rk4 or euler (not soft-leg); rk4:N or euler:N for N steps per sample
    ///
    /// Without it: exact for the rosbot, rk4 for the others. rk4 means rk4:10, euler means euler:1.
    #[arg(long, value_name = "METHOD")]
    integrator: Option<Integrator>,
    /// Decimals of the measured columns
    ///
    /// Without it: every digit, or with noise 6 (soft-leg 4).
    #[arg(long, value_name = "N")]
    digits: Option<u8>,
    /// Inputs that are held all the time instead of random ones: 12.1369,6.7310 is the paper's circle
    #[arg(long, value_name = "U1,U2", value_delimiter = ',', allow_hyphen_values = true)]
    hold: Option<Vec<f64>>,
    /// Where the rosbot starts (m, m, rad) [default: 0,0,0]
    #[arg(long, value_name = "X,Y,PHI", value_delimiter = ',', allow_hyphen_values = true)]
    start: Option<Vec<f64>>,
    /// Replace a recording that DIR already holds
    #[arg(long)]
    overwrite: bool,
}

fn main() -> ExitCode {
    match run(Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Nothing is left to say it with if this fails too.
            let _ = writeln!(std::io::stderr(), "error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    match arguments.command {
        Command::Record { set: Some(LogSet::Paper { seed, out, overwrite }), .. } => {
            let logs = PaperLogs::new(seed);
            logs.write(&out, overwrite)?;
            writeln!(std::io::stdout(), "{logs}, in {}", out.display())?;
        }
        Command::Record { set: None, robot } => {
            let RobotLogs {
                robot,
                trials,
                seconds,
                seed,
                out,
                noise,
                integrator,
                digits,
                hold,
                start,
                overwrite,
            } = robot.expect("clap asks for a robot where no set is named");
            let settings = Settings { robot, trials, seconds, seed, noise, integrator, digits };
            let mut recording = Recording::new(settings)?;
            if let Some(input) = hold {
                recording = recording.held(&input)?;
            }
            if let Some(pose) = start {
                recording = recording.starting_at(&pose)?;
            }
            recording.write(&out, overwrite)?;
            writeln!(std::io::stdout(), "{recording}, in {}", out.display())?;
        }
    }
    Ok(())
}
