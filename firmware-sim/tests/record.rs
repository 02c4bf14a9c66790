//! The command `firmware-sim record`, from the outside.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn firmware_sim(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_firmware-sim")).args(arguments).output().unwrap()
}

/// `record ROBOT --trials 2 --seconds 1 --seed 1 --out OUT` and more; what it prints.
fn record(robot: &str, out: &Path, more: &[&str]) -> String {
    let out = out.to_str().unwrap();
    let fixed = ["record", robot, "--seconds", "1", "--seed", "1", "--out", out];
    let trials = ["--trials", "2"];
    let trials = if more.contains(&"--trials") { &[][..] } else { &trials };
    let output = firmware_sim(&[&fixed, trials, more].concat());
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{message}");
    assert_eq!(message, "");
    String::from_utf8(output.stdout).unwrap()
}

/// Runs a command that must fail; its message.
fn refused(arguments: &[&str]) -> String {
    let output = firmware_sim(arguments);
    assert!(!output.status.success(), "{arguments:?} must fail");
    assert_eq!(output.stdout, b"");
    String::from_utf8(output.stderr).unwrap()
}

fn files(dir: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(dir)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

fn text(dir: &Path, trial: u32) -> String {
    fs::read_to_string(dir.join(format!("trial-{trial:03}.csv"))).unwrap()
}

fn first_lines(text: &str, count: usize) -> Vec<&str> {
    text.lines().take(count).collect()
}

#[test]
fn golden_rows_of_every_robot() {
    let dir = tempfile::tempdir().unwrap();
    let golden = [
        (
            "rosbot",
            11,
            [
                "time_s,x_m,y_m,phi_rad,omega_r_radps,omega_l_radps",
                "0,0,0,0,7.993,2.323",
                "0.1,0.031853043240558085,0.002460494492476144,0.1541842105263158,-1.801,5.746",
            ],
            [
                "0,-0.001529,0.000179,-0.000586,7.993,2.323",
                "0.1,0.031544,0.001896,0.153922,-1.801,5.746",
            ],
        ),
        (
            "two-link-arm",
            101,
            [
                "time_s,theta1_rad,theta2_rad,dtheta1_radps,dtheta2_radps,tau1_Nm,tau2_Nm",
                "0,0,0,0,0,0.8882,0.2581",
                "0.01,-0.0003039999933804532,0.0002470499831513228,-0.06079999602819331,0.04940998989056047,-0.2001,0.6385",
            ],
            [
                "0,-0.000306,0.000036,-0.001464,-0.001545,0.8882,0.2581",
                "0.01,-0.000417,0.000221,-0.058931,0.039629,-0.2001,0.6385",
            ],
        ),
        (
            "soft-leg",
            21,
            [
                "time_s,y_mm,z_mm,bending_V,extension_V",
                "0,0,0,-10.07,7.98",
                "0.05,-0.15215383009799469,-0.0370804103865936,-10.07,7.98",
            ],
            ["0,-0.1529,0.0179,-10.07,7.98", "0.05,-0.1814,-0.068,-10.07,7.98"],
        ),
    ];
    for (robot, rows, exact, noisy) in golden {
        let out = dir.path().join(robot);
        record(robot, &out, &[]);
        assert_eq!(files(&out), ["trial-000.csv", "trial-001.csv"]);
        let log = text(&out, 0);
        assert_eq!(first_lines(&log, 3), exact);
        assert_eq!(log.lines().count(), 1 + rows);
        assert!(log.ends_with('\n') && !log.contains('\r'));

        let out = dir.path().join(format!("{robot}-noise"));
        record(robot, &out, &["--noise"]);
        assert_eq!(first_lines(&text(&out, 0), 3)[1..], noisy);
    }
}

#[test]
fn says_what_it_did() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("logs");
    assert_eq!(
        record("rosbot", &out, &["--noise", "0.5", "--integrator", "euler"]),
        format!(
            "rosbot: 2 trials of 11 rows, seed 1, noise 0.5, integrator euler:1, in {}\n",
            out.display()
        )
    );
}

#[test]
fn same_settings_give_the_same_bytes_whatever_else_is_recorded() {
    let dir = tempfile::tempdir().unwrap();
    for robot in ["rosbot", "two-link-arm", "soft-leg"] {
        let logs = |name: &str, more: &[&str]| {
            let out = dir.path().join(format!("{robot}-{name}"));
            record(robot, &out, more);
            out
        };
        let two = logs("two", &["--noise"]);
        let again = logs("again", &["--noise"]);
        let five = logs("five", &["--noise", "--trials", "5"]);
        for trial in 0..2 {
            assert_eq!(text(&two, trial), text(&again, trial));
            assert_eq!(text(&two, trial), text(&five, trial));
        }
        assert_ne!(text(&two, 0), text(&two, 1));

        // Noise changes what is measured, never what is commanded.
        let silent = logs("silent", &[]);
        let inputs = |log: String| -> Vec<String> {
            let input = |line: &str| line.rsplitn(3, ',').take(2).collect::<Vec<_>>().join(",");
            log.lines().map(input).collect()
        };
        assert_eq!(inputs(text(&two, 0)), inputs(text(&silent, 0)));
    }
}

#[test]
fn other_seeds_and_longer_trials() {
    let dir = tempfile::tempdir().unwrap();
    let run = |seed: &str, seconds: &str| {
        let out = dir.path().join(format!("{seed}-{seconds}"));
        let path = out.to_str().unwrap();
        let output = firmware_sim(&[
            "record",
            "soft-leg",
            "--trials",
            "1",
            "--seconds",
            seconds,
            "--seed",
            seed,
            "--out",
            path,
            "--noise",
        ]);
        assert!(output.status.success());
        text(&out, 0)
    };
    let short = run("7", "2");
    assert!(run("7", "20").starts_with(&short));
    assert_ne!(run("8", "2"), short);
    assert_eq!(run("7", "2.049"), short, "part of a sample is left out");
}

#[test]
fn numbers_read_back_and_digits_limit_them() {
    let dir = tempfile::tempdir().unwrap();
    let full = dir.path().join("full");
    record("two-link-arm", &full, &[]);
    let short = dir.path().join("short");
    record("two-link-arm", &short, &["--digits", "3"]);
    let cells = |log: &str| -> Vec<Vec<String>> {
        csv::Reader::from_reader(log.as_bytes())
            .records()
            .map(|row| row.unwrap().iter().map(String::from).collect())
            .collect()
    };
    let (full, short) = (cells(&text(&full, 1)), cells(&text(&short, 1)));
    for (row, (full, short)) in full.iter().zip(&short).enumerate() {
        assert_eq!(full[0], (row as f64 / 100.0).to_string());
        assert_eq!(full[5..], short[5..]);
        for (full, short) in full[1..5].iter().zip(&short[1..5]) {
            assert!(short.split_once('.').is_none_or(|(_, decimals)| decimals.len() <= 3));
            let number = |text: &str| text.parse::<f64>().unwrap();
            assert_eq!(number(full).to_string(), *full);
            assert!((number(full) - number(short)).abs() <= 0.5e-3 + 1e-12);
        }
    }
}

#[test]
fn impossible_settings_are_refused_with_the_reason_and_no_output() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("logs");
    let out = out.to_str().unwrap();
    let cases: [(&str, &[&str], &str); 17] = [
        (
            "hexapod",
            &[],
            "unknown robot `hexapod`: expected rosbot, two-link-arm, soft-leg or paper",
        ),
        ("rosbot", &["--seconds", "0"], "duration must be finite and above 0 s, not 0"),
        ("rosbot", &["--seconds", "-3"], "duration must be finite and above 0 s, not -3"),
        ("rosbot", &["--seconds", "NaN"], "duration must be finite and above 0 s, not NaN"),
        ("rosbot", &["--seconds", "inf"], "duration must be finite and above 0 s, not inf"),
        ("rosbot", &["--seconds", "0.05"], "shorter than one sample of rosbot at 10 Hz"),
        ("rosbot", &["--seconds", "1e12"], "more than 100000000 samples"),
        ("rosbot", &["--trials", "0"], "number of trials must be at least 1"),
        ("rosbot", &["--noise", "-1"], "noise scale must be finite and at least 0, not -1"),
        ("rosbot", &["--digits", "16"], "number of digits must be at most 15, not 16"),
        ("rosbot", &["--integrator", "heun"], "unknown integrator `heun`"),
        (
            "two-link-arm",
            &["--integrator", "exact"],
            "cannot be integrated with exact: use rk4 or euler",
        ),
        ("soft-leg", &["--integrator", "euler"], "cannot be integrated with euler:1: use rk4"),
        ("rosbot", &["--hold", "1"], "expected 2 finite numbers for the inputs, found 1"),
        ("rosbot", &["--hold", "1,NaN"], "expected 2 finite numbers for the inputs, found 1"),
        ("rosbot", &["--start", "1,2,3,4"], "expected 3 finite numbers for the start, found 4"),
        ("soft-leg", &["--start", "1,2,3"], "soft-leg cannot start elsewhere; only the rosbot can"),
    ];
    for (robot, changed, reason) in cases {
        let mut arguments = vec!["record", robot, "--out", out];
        for usual in [["--trials", "1"], ["--seconds", "1"], ["--seed", "1"]] {
            if !changed.contains(&usual[0]) {
                arguments.extend(usual);
            }
        }
        arguments.extend(changed);
        let message = refused(&arguments);
        assert!(message.contains(reason), "{message}");
        assert!(!Path::new(out).exists());
    }
}

#[test]
fn a_recording_is_replaced_only_on_request_and_then_whole() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().to_str().unwrap();
    let arguments =
        ["record", "rosbot", "--trials", "1", "--seconds", "1", "--seed", "2", "--out", path];
    fs::write(dir.path().join("robot.toml"), "kept").unwrap();
    record("rosbot", dir.path(), &["--trials", "3"]);
    let before = text(dir.path(), 0);

    let message = refused(&arguments);
    assert!(
        message.contains("already exists: choose another directory or pass --overwrite"),
        "{message}"
    );
    assert_eq!(text(dir.path(), 0), before);

    let overwrite = [&arguments[..], &["--overwrite"]].concat();
    assert!(firmware_sim(&overwrite).status.success());
    assert_ne!(text(dir.path(), 0), before);
    assert_eq!(files(dir.path()), ["robot.toml", "trial-000.csv"]);

    // A log of another origin would be read as a trajectory; it is never removed.
    fs::write(dir.path().join("Measured.CSV"), "time_s\n").unwrap();
    for arguments in [&arguments[..], &overwrite] {
        let message = refused(arguments);
        assert!(message.contains("Measured.CSV is not from a recording"), "{message}");
    }
    assert_eq!(files(dir.path()), ["Measured.CSV", "robot.toml", "trial-000.csv"]);
}

#[test]
fn an_unusable_directory_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    fs::write(&file, "").unwrap();
    for out in [file.clone(), file.join("below")] {
        let message = refused(&[
            "record",
            "rosbot",
            "--trials",
            "1",
            "--seconds",
            "1",
            "--seed",
            "1",
            "--out",
            out.to_str().unwrap(),
        ]);
        assert!(message.contains("cannot use the directory"), "{message}");
        assert!(message.contains(out.to_str().unwrap()), "{message}");
    }
}

#[cfg(unix)]
#[test]
fn logs_can_be_read_by_others() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    record("rosbot", dir.path(), &[]);
    let plain = dir.path().join("plain");
    fs::write(&plain, "").unwrap();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
    assert_eq!(mode(&dir.path().join("trial-000.csv")), mode(&plain));
}

#[test]
fn an_input_can_be_held_and_the_drive_put_somewhere() {
    let dir = tempfile::tempdir().unwrap();
    let (circle, far) = (dir.path().join("circle"), dir.path().join("far"));
    let hold = ["--hold", "12.1369,6.7310"];
    record("rosbot", &circle, &hold);
    record("rosbot", &far, &[&hold[..], &["--start", "1000,-2,0"]].concat());
    let numbers = |dir: &Path| -> Vec<Vec<f64>> {
        let parse = |line: &str| line.split(',').map(|x| x.parse().unwrap()).collect();
        text(dir, 0).lines().skip(1).map(parse).collect()
    };
    // Half a unit in the last place of 1 km, once a row.
    const ROUNDING: f64 = 1e-12;
    for (here, there) in numbers(&circle).iter().zip(numbers(&far)) {
        assert_eq!(here[4..], [12.1369, 6.731]);
        assert_eq!((here[3], &here[4..]), (there[3], &there[4..]));
        assert!((here[1] + 1000.0 - there[1]).abs() < ROUNDING);
        assert!((here[2] - 2.0 - there[2]).abs() < ROUNDING);
    }
    record("soft-leg", &dir.path().join("leg"), &["--hold", "-3,4.5"]);
    assert!(text(&dir.path().join("leg"), 1).lines().skip(1).all(|line| line.ends_with(",-3,4.5")));
}

#[test]
fn help_names_every_robot_and_option() {
    let output = firmware_sim(&["record", "--help"]);
    assert!(output.status.success());
    let help = String::from_utf8(output.stdout).unwrap();
    for word in [
        "rosbot",
        "two-link-arm",
        "soft-leg",
        "--trials",
        "--seconds",
        "--seed",
        "--out",
        "--noise",
        "--integrator",
        "--digits",
        "--hold",
        "--start",
        "--overwrite",
    ] {
        assert!(help.contains(word), "{word}");
    }
}
