//! The commands `run` and `sweep`, as a user types them.

use std::path::Path;
use std::process::{Command, Output};

const ROSBOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/skid-rosbot/model.bin");
const SOFT_LEG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/soft-leg/model.bin");

fn firmware_sim(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_firmware-sim"));
    command.current_dir(folder).args(arguments).output().unwrap()
}

fn succeed(folder: &Path, arguments: &[&str]) -> String {
    let output = firmware_sim(folder, arguments);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{arguments:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

fn refuse(folder: &Path, arguments: &[&str]) -> String {
    let output = firmware_sim(folder, arguments);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(said.lines().count(), 1, "one line: {said}");
    said
}

#[test]
fn run_prints_a_table_and_writes_what_it_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let said = succeed(
        folder,
        &[
            "run",
            ROSBOT,
            "--seconds",
            "30",
            "--faults",
            "slip:1@10..20=0.5,dropout@22..24=0.5",
            "--plot",
            "run.svg",
            "--log",
            "logs",
            "--seed",
            "4",
        ],
    );
    for fragment in [
        "deadline misses        0",
        "false alarms           0",
        "x [m]",
        "slip:1@10..20=0.5",
        "flagged",
        "dropout@22..24=0.5",
        "30.00 s, seed 4",
    ] {
        assert!(said.contains(fragment), "{fragment}: {said}");
    }
    let svg = std::fs::read_to_string(folder.join("run.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("skid-rosbot: random driving"));
    assert!(folder.join("logs/episode-000.csv").is_file());

    let json = succeed(folder, &["run", SOFT_LEG, "--seconds", "20", "--json"]);
    let value: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(value["ticks"], 10_000);
    assert_eq!(value["deadline_misses"], 0);
    assert_eq!(value["robot"], "soft-leg");

    let live = succeed(folder, &["run", SOFT_LEG, "--seconds", "5", "--live", "--speed", "0"]);
    assert!(live.contains("+ predicted") && live.contains("deadline misses"));
}

#[test]
fn sweep_says_whether_faults_end_as_expected() {
    let folder = tempfile::tempdir().unwrap();
    let said = succeed(folder.path(), &["sweep", ROSBOT, "--seeds", "1"]);
    assert!(said.contains("33 cases, 33 runs") && said.contains("off in 1.1 s"), "{said}");
    assert!(!said.contains("WORSE") && !said.contains("MISSED"), "{said}");
}

#[test]
fn mistakes_get_one_line_and_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    std::fs::write(folder.join("bad.toml"), "seconds = 5\nspeed = 3\n").unwrap();
    std::fs::write(folder.join("bad.bin"), b"no model").unwrap();
    let arm = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/two-link-arm/model.bin");
    for (arguments, fragment) in [
        (&["run", "none.bin"][..], "none.bin: cannot be read"),
        (&["run", "bad.bin"], "bad.bin: the model is refused"),
        (&["run", arm], "robots that can be run have [x, y, phi]"),
        (&["run", ROSBOT, "--scenario", "none.toml"], "none.toml: cannot be read"),
        (&["run", ROSBOT, "--scenario", "bad.toml"], "bad.toml: line 2: unknown field `speed`"),
        (&["run", ROSBOT, "--seconds", "-3"], "`seconds` must be above 0"),
        (
            &["run", ROSBOT, "--seconds", "2", "--plot", "none/run.svg"],
            "run.svg: cannot be written",
        ),
        (&["run", ROSBOT, "--log", "."], "give another folder"),
        (
            &["run", ROSBOT, "--faults", "leak@1..2=1"],
            "leak@1..2=1: a skid-rosbot has no such fault",
        ),
        (&["run", SOFT_LEG, "--faults", "leak:2@1..2=1"], "or no such unit"),
        (&["sweep", "none.bin"], "none.bin: cannot be read"),
        (&["plant", "rosbot", "--port", "unix:none"], "unix:none: cannot be opened"),
        (
            &["plant", "soft-leg", "--port", "unix:none", "--faults", "late-tick@1..2=1"],
            "a SoftLeg without its controller has no such fault",
        ),
    ] {
        let said = refuse(folder, arguments);
        assert!(said.contains(fragment), "{arguments:?}: {said}");
    }
    // A fault or a speed that is none is a mistake on the command line.
    for (arguments, fragment) in [
        (&["--faults", "ice@1..2=1"][..], "unknown fault `ice`"),
        (&["--live", "--speed", "-1"], "expected 0, or 0.001"),
        (&["--live", "--speed", "nan"], "expected 0, or 0.001"),
        (&["--live", "--speed", "1e-300"], "expected 0, or 0.001"),
    ] {
        let output = firmware_sim(folder, &[&["run", ROSBOT], arguments].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && said.contains(fragment), "{said}");
    }
    let mut left: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["bad.bin", "bad.toml"]);
}
