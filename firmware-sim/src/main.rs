//! The command `firmware-sim`.

use clap::{Args, Parser, Subcommand};
use firmware_core::update::PublicKey;
use firmware_sim::Integrator;
use firmware_sim::fault::Fault;
use firmware_sim::paper::PaperLogs;
use firmware_sim::plant_line;
use firmware_sim::record::{Recording, Robot, Settings};
use firmware_sim::run;
use firmware_sim::run::apart::{self, Line, Plant};
use firmware_sim::run::figure::Figure;
use firmware_sim::run::live::Live;
use firmware_sim::run::log::Logger;
use firmware_sim::run::scenario::{FaultText, Scenario};
use firmware_sim::run::serve::{Door, serve};
use firmware_sim::run::store::Store;
use firmware_sim::run::summary::Summary;
use firmware_sim::run::sweep;
use std::error::Error;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

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
    Run(RunArgs),
    Sweep(SweepArgs),
    Serve(ServeArgs),
    Plant(PlantArgs),
}

/// Simulates a robot for a controller that runs somewhere else: in QEMU, as firmware-sim/cortex-m/robot starts
/// it, or on a board.
///
/// Sensor readings and outputs go over a line of their own, --port, as the documentation of
/// firmware_sim::plant_line says: one frame each way per tick of the controller, which keeps the time. Ends
/// when the controller hangs up.
///
/// With --link the controller's link is passed on to clients, as `serve` does it: its first line then says
/// where they come in. Only so it can be driven while a client listens, with --drive.
///
/// A line is tcp:HOST:PORT, unix:PATH, or a serial device.
#[derive(Args)]
#[command(verbatim_doc_comment)]
struct PlantArgs {
    /// Which robot
    robot: PlantRobot,
    /// The line to the controller's sensors and actuators
    #[arg(long, value_name = "LINE")]
    port: String,
    /// The controller's link, for --tcp, --pty and --drive
    #[arg(long, value_name = "LINE")]
    link: Option<String>,
    /// Baud rate of serial devices
    #[arg(long, value_name = "BAUD", default_value_t = 576_000)]
    baud: u32,
    #[command(flatten)]
    door: DoorArgs,
    /// Drive at random, or by the scenario
    #[arg(long, requires = "link")]
    drive: bool,
    /// Scenario, a TOML file: faults and, with --drive, the script
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Faults of the robot and its sensors, as for run
    #[arg(long, value_name = "FAULT", value_delimiter = ',')]
    faults: Vec<Fault>,
    /// Seed of sensors, faults and random commands
    #[arg(long, value_name = "K", default_value_t = 1)]
    seed: u64,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum PlantRobot {
    /// The skid-steered ROSbot
    Rosbot,
    /// The soft leg
    SoftLeg,
}

/// Where clients come in.
#[derive(Args)]
struct DoorArgs {
    /// Listen on this address; port 0 is a free one [default: 127.0.0.1:0]
    #[arg(long, value_name = "ADDRESS")]
    tcp: Option<std::net::SocketAddr>,
    /// A new pseudo-terminal instead
    #[arg(long, conflicts_with = "tcp")]
    pty: bool,
}

impl DoorArgs {
    fn open(&self) -> Result<Door, String> {
        match self.pty {
            #[cfg(unix)]
            true => Door::pty().map_err(|e| format!("there is no pseudo-terminal: {e}")),
            #[cfg(not(unix))]
            true => Err("there are no pseudo-terminals here; use --tcp".into()),
            false => {
                let address = self.tcp.unwrap_or_else(|| ([127, 0, 0, 1], 0).into());
                Door::tcp(address).map_err(|e| format!("cannot listen on {address}: {e}"))
            }
        }
    }
}

/// Runs a model's robot in real time, with its serial line on a TCP port or a pseudo-terminal: a controller
/// to talk to without hardware.
///
/// Says where on its first line, such as `skid-rosbot on tcp:127.0.0.1:4000`, which is what
/// `trainer monitor --port` and `trainer flash --port` take. Without --drive the client has to send the
/// commands. The model is the factory model in the image; every boot is told on standard error.
#[derive(Args)]
#[command(verbatim_doc_comment)]
struct ServeArgs {
    /// The blob
    model: PathBuf,
    #[command(flatten)]
    door: DoorArgs,
    /// Install only models that were signed with this key, as `trainer keygen` writes it to NAME.pub
    /// [default: everybody's]
    #[arg(long, value_name = "FILE")]
    public_key: Option<PathBuf>,
    /// Keep the flash with its two model slots in this file [default: erased at every start]
    #[arg(long, value_name = "FILE")]
    flash: Option<PathBuf>,
    /// Drive at random, or by the scenario
    #[arg(long)]
    drive: bool,
    /// Scenario, a TOML file: faults and, with --drive, the script
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Faults, as for run
    #[arg(long, value_name = "FAULT", value_delimiter = ',')]
    faults: Vec<Fault>,
    /// Seed of sensors, faults and random commands
    #[arg(long, value_name = "K", default_value_t = 1)]
    seed: u64,
    /// Stop after this time of the robot [default: never]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// Times as fast as reality; 0 for as fast as it goes
    #[arg(long, value_name = "X", default_value_t = 1.0, allow_negative_numbers = true, value_parser = speed)]
    speed: f64,
}

/// Runs a model's robot with every fault at several intensities and compares what comes of them with what
/// is expected.
///
/// Each case is run once per seed: 20 s of random driving, 30 s of the fault. A fault is *survived* when the
/// true motion stays within the prediction's error bounds, *flagged* when the loop noticed it and went on,
/// *safe* when it switched everything off, *MISSED* when the motion left the bounds and nothing noticed.
/// Times are the longest over the seeds, shares the least. Exits with an error when a case is worse than
/// expected.
#[derive(Args)]
#[command(verbatim_doc_comment)]
struct SweepArgs {
    /// The blob
    model: PathBuf,
    /// Runs per case
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    seeds: u64,
}

/// Runs a model's robot: the firmware's own control loop on a simulated controller, with its serial line,
/// faults and deadlines, in virtual time.
///
/// The model says which robot: [x, y, phi] from [omega_r, omega_l] is the ROSbot, [y, z] from
/// [bending, extension] the soft leg. Exits with an error when an actuator was driven out of turn, when a
/// fault was neither survived nor noticed, or when the firmware misused the hardware.
#[derive(Args)]
#[command(verbatim_doc_comment)]
struct RunArgs {
    /// The blob
    model: PathBuf,
    /// Scenario, a TOML file [default: a minute of random driving]
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Virtual time, instead of the scenario's
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// Faults, beside the scenario's: KIND[:UNIT]@FROM..UNTIL=INTENSITY, such as slip:1@20..40=0.5
    ///
    /// Kinds: dropout, nan, freeze, spike, delay, missed-counts, wrap, stuck-valve, open-valve, leak, pump,
    /// slip, sag, late-tick, silence, brown-out; times in seconds; intensities above 0 up to 1, whose
    /// meaning is in the documentation of firmware_sim::fault.
    #[arg(long, value_name = "FAULT", value_delimiter = ',')]
    faults: Vec<Fault>,
    /// Seed of sensors, faults and random commands
    #[arg(long, value_name = "K", default_value_t = 1)]
    seed: u64,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Show the robot in the terminal while it runs
    #[arg(long, conflicts_with = "json")]
    live: bool,
    /// With --live: times as fast as reality; 0 for as fast as it goes
    #[arg(long, value_name = "X", default_value_t = 1.0, requires = "live", allow_negative_numbers = true, value_parser = speed)]
    speed: f64,
    /// Write a plot of predicted beside measured, SVG
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write the telemetry as logs for the trainer to this folder
    #[arg(long, value_name = "DIR")]
    log: Option<PathBuf>,
    /// Start a new log after this time, for the trainer's whole-trajectory cross-validation
    #[arg(long, value_name = "S", requires = "log", value_parser = clap::value_parser!(u32).range(1..))]
    log_seconds: Option<u32>,
    /// Replace the logs of an earlier run
    #[arg(long, requires = "log")]
    overwrite: bool,
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
    /// rosbot, two-link-arm or soft-leg
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
    /// Usual sizes: rosbot 1 mm and 2 mrad, two-link-arm 0.2 mrad and 5 mrad/s, soft-leg 0.1 mm.
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

/// Times as fast as reality, or 0.
fn speed(text: &str) -> Result<f64, String> {
    let speed: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    match speed == 0.0 || (1e-3..=1e9).contains(&speed) {
        true => Ok(speed),
        false => Err("expected 0, or 0.001 to 1e9".to_owned()),
    }
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

fn run_model(args: &RunArgs) -> Result<(), Box<dyn Error>> {
    let named = |error: &dyn std::fmt::Display| format!("{}: {error}", args.model.display());
    let blob = run::Blob::read(&args.model)?;
    let model = blob.model().map_err(|e| named(&e))?;
    let structure = model.structure();
    let robot = run::Robot::of(structure)?;
    let scenario = scenario((args.scenario.as_deref(), args.seconds, &args.faults), robot)?;
    // Not only after a run of a minute.
    if let Some(path) = args.plot.as_ref().filter(|path| !run::folder_of(path).is_dir()) {
        return Err(
            format!("{}: cannot be written: there is no such folder", path.display()).into()
        );
    }
    let mut logger = args
        .log
        .as_ref()
        .map(|dir| Logger::new(dir, structure, args.log_seconds, args.overwrite))
        .transpose()?;
    let states = structure.states().iter().map(|s| (s.name.to_owned(), s.unit.to_owned()));
    let states: Vec<(String, String)> = states.collect();
    let name = args.scenario.as_ref().and_then(|path| path.file_stem()).unwrap_or_default();
    let title = match name.to_string_lossy() {
        name if name.is_empty() => format!("{}: random driving", structure.robot()),
        name => format!("{}: {name}", structure.robot()),
    };
    let faults = scenario.faults.iter().map(|fault| fault.0).collect();
    let horizon = robot.ahead();
    let mut figure = args.plot.as_ref().map(|_| Figure::new(title, &model, horizon, faults));
    let mut live = args.live.then(|| (Live::new(), std::time::Instant::now()));
    if args.live {
        // Clears the screen; every picture begins at its top.
        write!(std::io::stdout(), "\x1b[2J")?;
    }
    let summary = run::run(&model, &scenario, args.seed, &mut |seen| {
        if let Some(logger) = &mut logger {
            logger.frame(seen.frame)?;
        }
        if let Some(figure) = &mut figure {
            figure.sample(seen.frame);
        }
        if let Some((live, began)) = &mut live {
            let mut out = std::io::stdout().lock();
            write!(out, "\x1b[H{}", live.picture(seen, &states))?;
            out.flush()?;
            if args.speed > 0.0 {
                let due = seen.frame.time_us as f64 * 1e-6 / args.speed;
                let due = Duration::try_from_secs_f64(due).unwrap_or(Duration::MAX);
                std::thread::sleep(due.saturating_sub(began.elapsed()));
            }
        }
        Ok(())
    });
    let summary = summary.map_err(|e| named(&e))?;
    if let (Some(logger), Some(dir)) = (&mut logger, &args.log) {
        logger.finish()?;
        writeln!(std::io::stderr(), "{} logs in {}", logger.episodes(), dir.display())?;
    }
    if let (Some(figure), Some(path)) = (&figure, &args.plot) {
        let written = run::write_whole(path, figure.svg()?.as_bytes());
        written.map_err(|e| format!("{}: cannot be written: {e}", path.display()))?;
    }
    print_summary(args, &summary)?;
    if summary.holds() {
        Ok(())
    } else {
        Err("a fault was missed, or an actuator was driven out of turn: see the table".into())
    }
}

fn sweep_model(args: &SweepArgs) -> Result<(), Box<dyn Error>> {
    let named = |error: &dyn std::fmt::Display| format!("{}: {error}", args.model.display());
    let blob = run::Blob::read(&args.model)?;
    let model = blob.model().map_err(|e| named(&e))?;
    let terminal = std::io::stderr().is_terminal();
    let rows = sweep::sweep(&model, args.seeds, &mut |done, all| {
        if terminal {
            let end = if done == all { "\r\x1b[K" } else { "" };
            let _ = write!(std::io::stderr(), "\r{done} of {all} cases{end}");
        }
    });
    let rows = rows.map_err(|e| named(&e))?;
    let runs: usize = rows.iter().map(|row| row.found.len()).sum();
    write!(
        std::io::stdout(),
        "{}: {} cases, {runs} runs\n{}",
        args.model.display(),
        rows.len(),
        sweep::table(&rows)
    )?;
    match rows.iter().filter(|row| !row.holds()).count() {
        0 => Ok(()),
        worse => Err(format!("{worse} cases are worse than expected").into()),
    }
}

/// Virtual time of a controller that is served without an end (s): a hundred years.
const NO_END_S: f64 = 3e9;

fn serve_model(args: &ServeArgs) -> Result<(), Box<dyn Error>> {
    let named = |error: &dyn std::fmt::Display| format!("{}: {error}", args.model.display());
    let blob = run::Blob::read(&args.model)?;
    let model = blob.model().map_err(|e| named(&e))?;
    let structure = model.structure();
    let seconds = Some(args.seconds.unwrap_or(NO_END_S));
    let of = run::Robot::of(structure)?;
    let scenario = scenario((args.scenario.as_deref(), seconds, &args.faults), of)?;
    let key = args.public_key.as_deref().map(public_key).transpose()?;
    let mut store = Store::new(&blob, key);
    if let Some(file) = &args.flash {
        store.keep(file.clone())?;
    }
    let robot = structure.robot().to_owned();
    store.told = Box::new(move |boot| {
        // Nobody may be reading.
        let _ = writeln!(std::io::stderr(), "{:.2} s: {robot} {boot}", boot.at_us as f64 * 1e-6);
    });
    let door = args.door.open()?;
    let mut out = std::io::stdout();
    writeln!(out, "{} on {}", structure.robot(), door.name()?)?;
    out.flush()?;
    if store.key.is_none() {
        writeln!(
            std::io::stderr(),
            "WARNING: without --public-key everybody on this line may install a model: for \
             development only"
        )?;
    }
    let how = (args.drive, args.speed);
    let summary = serve(&model, &scenario, args.seed, &mut store, door, how);
    let summary = summary.map_err(|e| named(&e))?;
    write!(out, "{}", summary.text())?;
    Ok(())
}

fn plant(args: &PlantArgs) -> Result<(), Box<dyn Error>> {
    let (robot, called) = match args.robot {
        PlantRobot::Rosbot => (plant_line::Robot::Rosbot, "rosbot"),
        PlantRobot::SoftLeg => (plant_line::Robot::SoftLeg, "soft-leg"),
    };
    let scenario = scenario((args.scenario.as_deref(), Some(NO_END_S), &args.faults), robot.run())?;
    let faults: Vec<Fault> = scenario.faults.iter().map(|fault| fault.0).collect();
    let mut plant = Plant::new(robot, &faults, args.seed)?;
    let open = |name: &str| {
        Line::open(name, args.baud).map_err(|e| format!("{name}: cannot be opened: {e}"))
    };
    let mut line = open(&args.port)?;
    if let Some(link) = &args.link {
        let door = args.door.open()?;
        let mut out = std::io::stdout();
        writeln!(out, "{called} on {}", door.name()?)?;
        out.flush()?;
        let (name, link, seed, drives) = (link.clone(), open(link)?, args.seed, args.drive);
        std::thread::spawn(move || {
            let Err(error) = apart::pass_on(link, (&scenario, seed), door, drives);
            let _ = writeln!(std::io::stderr(), "{name}: {error}");
        });
    }
    let Err(error) = plant.serve(&mut line, &mut |what| {
        // Nobody may be reading.
        let _ = writeln!(std::io::stderr(), "{what}");
    });
    Err(format!("{}: {error}", args.port).into())
}

/// The key in a file: 64 hexadecimal digits.
fn public_key(path: &Path) -> Result<PublicKey, String> {
    let failed = |what: &str| format!("{}: {what}", path.display());
    let text =
        std::fs::read_to_string(path).map_err(|e| failed(&format!("cannot be read: {e}")))?;
    let digits = text.trim();
    let expected = "expected 64 hexadecimal digits, as `trainer keygen` writes them to NAME.pub";
    let mut key = [0; 32];
    if digits.len() != 2 * key.len() || !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return Err(failed(expected));
    }
    for (i, byte) in key.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).map_err(|_| failed(expected))?;
    }
    Ok(PublicKey(key))
}

fn scenario(
    (path, seconds, faults): (Option<&Path>, Option<f64>, &[Fault]),
    robot: run::Robot,
) -> Result<Scenario, Box<dyn Error>> {
    let mut scenario = match path {
        Some(path) => Scenario::load(path, run::Robot::INPUTS)?,
        None => Scenario::random(robot.limit()),
    };
    if let Some(seconds) = seconds {
        scenario.seconds = seconds;
    }
    scenario.faults.extend(faults.iter().copied().map(FaultText));
    scenario.check(run::Robot::INPUTS)?;
    Ok(scenario)
}

fn print_summary(args: &RunArgs, summary: &Summary) -> Result<(), Box<dyn Error>> {
    let mut out = std::io::stdout();
    if args.json {
        serde_json::to_writer_pretty(&mut out, summary)?;
        writeln!(out)?;
    } else {
        write!(out, "{} on the simulated controller\n{}", args.model.display(), summary.text())?;
    }
    Ok(())
}

fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    match arguments.command {
        Command::Run(args) => run_model(&args)?,
        Command::Sweep(args) => sweep_model(&args)?,
        Command::Serve(args) => serve_model(&args)?,
        Command::Plant(args) => plant(&args)?,
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
