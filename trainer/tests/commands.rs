//! The commands one after the other, as a user runs them, and what programs read from them.

mod command;

use std::collections::{BTreeMap, BTreeSet};

use command::{ROBOT, ROWS, TERMS, Workshop, lines, text, trial};
use serde_json::Value;

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[track_caller]
fn has_fields(value: &Value, fields: &[&str]) {
    let found: BTreeSet<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(found, fields.iter().copied().collect());
}

/// The documented form of a score; its windows and its errors are numbers that make sense.
#[track_caller]
fn is_score(score: &Value, scheme: &str) {
    has_fields(
        score,
        &[
            "scheme",
            "folds",
            "horizon",
            "stride",
            "first_sample",
            "windows",
            "states",
            "contenders",
            "arx_lags",
            "arx_nrmse",
        ],
    );
    assert_eq!(score["scheme"], scheme);
    assert_eq!(score["first_sample"], 5);
    assert_eq!(score["arx_nrmse"].as_array().unwrap().len(), 6);
    assert!(score["arx_lags"].as_u64().unwrap() <= 5);
    let states = score["states"].as_array().unwrap();
    assert_eq!(states.len(), 2);
    for (state, (name, unit)) in states.iter().zip([("x", "m"), ("phi", "rad")]) {
        has_fields(state, &["name", "unit", "deviation"]);
        assert_eq!((state["name"].as_str(), state["unit"].as_str()), (Some(name), Some(unit)));
        assert!(state["deviation"].as_f64().unwrap() > 0.0);
    }
    let contenders = score["contenders"].as_array().unwrap();
    assert_eq!(contenders.len(), 3);
    for (i, contender) in contenders.iter().enumerate() {
        has_fields(
            contender,
            &[
                "name",
                "diverged_windows",
                "one_step_rmse",
                "rollout_rmse",
                "last_step_rmse",
                "nrmse",
            ],
        );
        let name = contender["name"].as_str().unwrap();
        assert!(name.starts_with(["model", "no motion", "ARX, "][i]), "{name}");
        for errors in ["one_step_rmse", "rollout_rmse", "last_step_rmse"] {
            let errors = contender[errors].as_array().unwrap();
            assert!(errors.len() == 2 && errors.iter().all(|e| e.as_f64().unwrap() >= 0.0));
        }
    }
}

#[test]
fn fit_reports_what_it_did() {
    let workshop = Workshop::new();
    let text = workshop.succeed(&["fit", "."]);
    let bytes = workshop.read("model.bin").len();
    for line in [
        "cart: 3 trajectories, 360 rows, 357 snapshot pairs",
        "dictionary: 16 terms, 3 outputs, largest lag 0",
        "  kron(H1(x), H1(sin(phi)), H1(cos(phi)), H1(u))",
        "3-fold cross-validation over whole trajectories: model and ARX were fitted on the other folds.",
    ] {
        assert!(text.lines().any(|l| l == line), "`{line}` is not in: {text}");
    }
    assert!(text.contains(&format!("model: ./model.bin, {bytes} bytes, 192 of them")), "{text}");

    let report = json(&workshop.succeed(&["fit", ".", "--json"]));
    has_fields(
        &report,
        &["format", "command", "robot", "model", "fit", "score", "test", "unscored"],
    );
    assert_eq!((&report["format"], &report["command"]), (&1.into(), &"fit".into()));
    assert_eq!(report["robot"], "cart");
    let model = &report["model"];
    has_fields(
        model,
        &[
            "file",
            "bytes",
            "terms",
            "outputs",
            "coefficients",
            "zeros",
            "lag",
            "blocks",
            "logs_sha256",
            "robot_sha256",
        ],
    );
    assert_eq!(model["file"], "./model.bin");
    assert_eq!(model["bytes"], bytes);
    assert_eq!((&model["terms"], &model["outputs"]), (&TERMS.into(), &3.into()));
    assert_eq!((&model["coefficients"], &model["lag"]), (&(3 * TERMS).into(), &0.into()));
    assert!(model["zeros"].as_u64().unwrap() < 3 * TERMS as u64);
    assert_eq!(model["blocks"].as_array().unwrap().len(), 1);
    for hash in ["logs_sha256", "robot_sha256"] {
        let hash = model[hash].as_str().unwrap();
        assert!(hash.len() == 64 && hash.chars().all(|c| c.is_ascii_hexdigit()), "{hash}");
    }
    let fit = &report["fit"];
    has_fields(
        fit,
        &[
            "method",
            "scale_columns",
            "ridge",
            "truncation",
            "refine",
            "refinement_windows",
            "refinement_steps",
            "trajectories",
            "rows",
            "pairs",
            "rank",
            "condition",
        ],
    );
    assert_eq!((&fit["method"], &fit["scale_columns"]), (&"cholesky".into(), &true.into()));
    assert_eq!((&fit["trajectories"], &fit["rows"]), (&3.into(), &(3 * ROWS).into()));
    assert_eq!((&fit["pairs"], &fit["rank"]), (&(3 * ROWS - 3).into(), &TERMS.into()));
    assert!(fit["condition"].as_f64().unwrap() >= 1.0);
    assert_eq!(report["unscored"], Value::Null);
    is_score(&report["score"], "cross-validation");
    let score = &report["score"];
    assert_eq!(
        (&score["folds"], &score["horizon"], &score["stride"]),
        (&3.into(), &10.into(), &10.into())
    );
    // Windows of 5 + 1 + 10 rows, one every 10 of 120.
    assert_eq!(score["windows"], 3 * ((ROWS - 16) / 10 + 1));
    // The cart's model is nearly in the span of the dictionary: it has to beat both baselines.
    let nrmse = |i: usize| score["contenders"][i]["nrmse"].as_f64().unwrap();
    assert!(nrmse(0) < nrmse(1) && nrmse(0) < nrmse(2));
}

#[test]
fn fit_without_a_score() {
    let workshop = Workshop::new();
    let scored = workshop.succeed(&["fit", "."]);
    let model = workshop.read("model.bin");
    let text = workshop.succeed(&["fit", ".", "--no-score", "--out", "quick.bin"]);
    assert!(scored.contains("RMSE") && !text.contains("RMSE"), "{text}");
    assert_eq!(workshop.read("quick.bin"), model);
    let report = json(&workshop.succeed(&["fit", ".", "--no-score", "--json"]));
    assert_eq!((&report["score"], &report["unscored"]), (&Value::Null, &Value::Null));
}

#[test]
fn evaluate_scores_the_blob() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    for number in 7..9 {
        workshop.write(&format!("fresh/run-{number}.csv"), text(&lines(&trial(number))));
    }
    let table = workshop.succeed(&["evaluate", "model.bin", "--logs", "fresh"]);
    assert!(table.contains("RMSE over 10 steps") && table.contains("x [m]"), "{table}");

    let evaluate = ["evaluate", "model.bin", "--logs", "fresh", "--json"];
    let report = json(&workshop.succeed(&evaluate));
    has_fields(&report, &["format", "command", "robot", "model", "logs", "score", "error_bounds"]);
    assert_eq!((&report["format"], &report["command"]), (&1.into(), &"evaluate".into()));
    assert_eq!((&report["robot"], &report["logs"]), (&"cart".into(), &"fresh".into()));
    assert_eq!(report["model"], "model.bin");
    is_score(&report["score"], "cross-validation");

    // With the ARX trained elsewhere, the model's own errors are the same.
    let trained =
        json(&workshop.succeed(&[&evaluate[..], &["--train", "logs", "--stride", "10"]].concat()));
    is_score(&trained["score"], "all");
    assert_eq!(trained["score"]["contenders"][0], report["score"]["contenders"][0]);
    assert_eq!(trained["score"]["contenders"][1], report["score"]["contenders"][1]);

    let options = ["--horizon", "3", "--stride", "1"];
    let short = json(&workshop.succeed(&[&evaluate[..], &options].concat()));
    assert_eq!((&short["score"]["horizon"], &short["score"]["stride"]), (&3.into(), &1.into()));
    assert_eq!(short["score"]["windows"], 2 * (ROWS - 9 + 1));
}

#[test]
fn predictions_agree_with_the_table() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    let evaluate =
        ["evaluate", "model.bin", "--logs", "logs", "--json", "--horizon", "7", "--stride", "5"];
    let plain = workshop.succeed(&evaluate);
    let with_csv = workshop.succeed(&[&evaluate[..], &["--csv", "predicted.csv"]].concat());
    assert_eq!(plain, with_csv, "--csv changes no number");
    let report = json(&plain);
    let score = &report["score"];

    let csv = String::from_utf8(workshop.read("predicted.csv")).unwrap();
    let mut lines = csv.lines();
    let header = "trajectory,window_row,step,x_measured,x_predicted,phi_measured,phi_predicted";
    assert_eq!(lines.next(), Some(header));
    let mut sums = [[0.0; 3]; 2];
    let mut windows = BTreeMap::new();
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        let numbers: Vec<f64> = fields[1..].iter().map(|field| field.parse().unwrap()).collect();
        let (row, step) = (numbers[0] as usize, numbers[1] as usize);
        *windows.entry((fields[0].to_owned(), row)).or_insert(0) += 1;
        // Measured values are those of the log: `row` counts its samples from 0.
        let number = fields[0].strip_prefix("run-").unwrap().parse().unwrap();
        let sample = trial(number)[row + step];
        assert_eq!(numbers[2], sample[0]);
        assert!((numbers[4] - sample[1]).abs() < 1e-12);
        for (state, sums) in sums.iter_mut().enumerate() {
            let square = (numbers[3 + 2 * state] - numbers[2 + 2 * state]).powi(2);
            sums[1] += square;
            sums[0] += if step == 1 { square } else { 0.0 };
            sums[2] += if step == 7 { square } else { 0.0 };
        }
    }
    assert_eq!(score["windows"], windows.len());
    assert!(windows.values().all(|steps| *steps == 7));
    assert_eq!(windows.keys().next(), Some(&("run-0".to_owned(), 5)));
    let count = windows.len() as f64;
    for (state, sums) in sums.iter().enumerate() {
        let model = &score["contenders"][0];
        for (errors, rmse) in [
            ("one_step_rmse", (sums[0] / count).sqrt()),
            ("rollout_rmse", (sums[1] / count / 7.0).sqrt()),
            ("last_step_rmse", (sums[2] / count).sqrt()),
        ] {
            let reported = model[errors][state].as_f64().unwrap();
            // The angle is printed on the turn of the measured one, which costs its last digits.
            assert!((reported - rmse).abs() <= 1e-9 * rmse, "{errors}: {reported} {rmse}");
        }
    }
}

#[test]
fn held_out_trajectories() {
    let workshop = Workshop::new();
    for (patterns, windows) in
        [("\"run-2\"", 11), ("\"run-[12]\", \"*-0\"", 11), ("\"*1\", \"*2\"", 22), ("\"run-?\"", 0)]
    {
        workshop.describe("horizon = 10", &format!("horizon = 10\nhold_out = [{patterns}]"));
        let report = json(&workshop.succeed(&["fit", ".", "--json"]));
        if windows == 0 {
            assert!(report["unscored"].as_str().unwrap().contains("matches 3 of 3"), "{report}");
            continue;
        }
        is_score(&report["score"], "hold-out");
        assert_eq!(report["score"]["windows"], windows, "{patterns}");
    }
    workshop.describe("horizon = 10", "horizon = 10\nhold_out = [\"run-0\"]");
    let table = workshop.succeed(&["fit", "."]);
    assert!(table.contains("scored on held-out trajectories"), "{table}");
    assert!(table.contains("The model that is written is fitted on all trajectories"), "{table}");

    workshop.describe("horizon = 10", "hold_out = [\"run-1.csv\"]");
    let text = workshop.succeed(&["fit", "."]);
    assert!(text.contains("not scored: `[score] hold_out` matches 0 of 3"), "{text}");
}

#[test]
fn one_long_log_is_cut_into_blocks() {
    let workshop = Workshop::new();
    std::fs::remove_dir_all(workshop.path("logs")).unwrap();
    let mut samples = Vec::new();
    for number in 0..5 {
        samples.extend(trial(number));
    }
    workshop.write("logs/long.csv", text(&lines(&samples)));
    let report = json(&workshop.succeed(&["fit", ".", "--json"]));
    is_score(&report["score"], "blocks");
    assert_eq!((&report["score"]["folds"], &report["fit"]["trajectories"]), (&5.into(), &1.into()));
    // No window spans two blocks: as many as in five logs of 120 rows.
    assert_eq!(report["score"]["windows"], 5 * 11);
    let table = workshop.succeed(&["fit", ".", "--logs", "logs/long.csv"]);
    assert!(table.contains("one trajectory in 5 blocks"), "{table}");
}

#[test]
fn a_horizon_beyond_the_logs() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    let model = workshop.read("model.bin");
    let message = workshop.refuse(&["evaluate", "model.bin", "--logs", "logs", "--horizon", "115"]);
    assert!(message.contains("121 rows") && message.contains("--horizon"), "{message}");
    workshop.succeed(&["evaluate", "model.bin", "--logs", "logs", "--horizon", "114"]);

    workshop.describe("horizon = 10", "horizon = 115");
    let text = workshop.succeed(&["fit", ".", "--out", "long.bin"]);
    assert!(text.contains("\nnot scored: ") && text.contains("121 rows"), "{text}");
    // The description is part of the provenance; everything else is as before.
    assert_eq!(workshop.read("long.bin").len(), model.len());
    let report = json(&workshop.succeed(&["fit", ".", "--json"]));
    assert_eq!(report["score"], Value::Null);
    assert!(report["unscored"].as_str().unwrap().contains("121 rows"), "{report}");
}

#[test]
fn inspect_and_dictionary() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    let short = workshop.succeed(&["inspect", "model.bin"]);
    for part in ["robot       cart", "R x S^1", "x*sin(phi)*u", "next x = ", "range -10 to 10"] {
        assert!(short.contains(part), "`{part}` is not in: {short}");
    }
    let all = workshop.succeed(&["inspect", "model.bin", "--all"]);
    assert!(short.contains("smaller terms") && !all.contains("smaller terms"), "{all}");
    let report = json(&workshop.succeed(&["inspect", "model.bin", "--json"]));
    assert_eq!((&report["format"], &report["command"]), (&1.into(), &"inspect".into()));

    let text = workshop.succeed(&["dictionary", "R^1 x S^1", "--inputs", "1"]);
    assert!(text.contains("\n16 terms\n") && text.contains("\n  1\n"), "{text}");
    let report = json(&workshop.succeed(&["dictionary", "S^1", "--order", "2", "--json"]));
    has_fields(
        &report,
        &["format", "command", "topology", "state_functions", "functions", "terms"],
    );
    assert_eq!(report["terms"].as_array().unwrap().len(), 9);
    for arguments in [
        &["dictionary", "R^2 y S^1"][..],
        &["dictionary", "R^2", "--order", "z=2"],
        &["dictionary", "R^2", "--order", "many"],
        &["dictionary", "R^2", "--order", "99"],
    ] {
        workshop.refuse(arguments);
    }
}

#[test]
fn resample_makes_logs_that_fit_reads() {
    let workshop = Workshop::new();
    let said = workshop.succeed(&[
        "resample",
        "logs",
        "--dt",
        "0.05",
        "--robot",
        ".",
        "--out",
        "new/finer",
    ]);
    assert!(said.contains("3 trajectories with 717 rows"), "{said}");
    workshop.describe("sample_time_s = 0.1", "sample_time_s = 0.05");
    workshop.succeed(&["fit", ".", "--logs", "new/finer"]);
    let again = ["resample", "logs", "--dt", "0.05", "--inputs", "u_V", "--angles", "phi_rad"];
    workshop.succeed(&[&again[..], &["--out", "by-hand"]].concat());
    assert_eq!(workshop.read("new/finer/run-2.csv"), workshop.read("by-hand/run-2.csv"));

    for (arguments, fragment) in [
        (&["--out", "logs"][..], "the directory of the logs"),
        (&["--out", "by-hand"], "holds CSV files already"),
        (&["--out", "robot.toml"], "robot.toml"),
        (&["--out", "new/coarse", "--max-gap", "0.01"], "too short"),
        (&["--out", "new/coarse", "--degrees", "theta"], "`theta`"),
    ] {
        let message = workshop.refuse(&[&again[..], arguments].concat());
        assert!(message.contains(fragment), "{message}");
    }
    for dt in ["0", "nan", "inf"] {
        let message = workshop.refuse(&["resample", "logs", "--dt", dt, "--out", "other"]);
        assert!(message.contains("positive"), "{message}");
    }
}

#[test]
fn the_same_log_and_settings_give_the_same_bytes() {
    let (here, there) = (Workshop::new(), Workshop::new());
    here.succeed(&["fit", "."]);
    let first = here.read("model.bin");
    here.succeed(&["fit", ".", "--out", "again.bin", "--json"]);
    let elsewhere = there.path("robot.toml");
    here.succeed(&["fit", elsewhere.to_str().unwrap()]);
    assert_eq!(here.read("again.bin"), first);
    assert_eq!(there.read("model.bin"), first);
}

#[test]
fn evaluate_and_inspect_refuse_other_files() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    let good = workshop.read("model.bin");
    let mut damaged = good.clone();
    damaged[good.len() / 2] ^= 0x10;
    let mut version = good.clone();
    version[4] = 9;
    for (content, fragment) in [
        (damaged, "damaged"),
        (good[..good.len() - 4].to_vec(), "cut off"),
        (good[..7].to_vec(), "cut off"),
        (Vec::new(), "cut off"),
        ([&good[..], b"\n"].concat(), "appended"),
        (version, "version 9"),
        (ROBOT.into(), "not a model blob"),
        (vec![0; 4096], "not a model blob"),
    ] {
        workshop.write("other.bin", content);
        for arguments in [
            &["inspect", "other.bin"][..],
            &["inspect", "other.bin", "--json"],
            &["evaluate", "other.bin", "--logs", "logs"],
            &["evaluate", "other.bin", "--logs", "logs", "--csv", "predicted.csv"],
        ] {
            let message = workshop.refuse(arguments);
            assert!(message.starts_with("other.bin: ") && message.contains(fragment), "{message}");
        }
    }
    assert!(workshop.refuse(&["inspect", "nowhere.bin"]).starts_with("nowhere.bin: "));
    assert!(workshop.refuse(&["inspect", "logs"]).starts_with("logs: "));

    workshop.describe("name = \"cart\"", "name = \"boat\"");
    let message = workshop.refuse(&["evaluate", "model.bin", "--logs", "logs"]);
    assert!(message.contains("`cart`") && message.contains("`boat`"), "{message}");
    workshop.describe("unit = \"V\"", "unit = \"mV\"");
    assert!(workshop.refuse(&["evaluate", "model.bin", "--logs", "logs"]).contains("--robot"));
    workshop.describe("sample_time_s = 0.1", "sample_time_s = 0.2");
    let message = workshop.refuse(&["evaluate", "model.bin", "--logs", "logs"]);
    assert!(message.contains("sample time"), "{message}");
    // Logs of another robot, without a description to say so.
    workshop.write("alone/model.bin", &good);
    workshop.write("alone/logs/run.csv", "time_s,y_m\n0,1\n0.1,1\n");
    let message = workshop.refuse(&["evaluate", "alone/model.bin", "--logs", "alone/logs"]);
    assert!(message.contains("alone/logs/run.csv, row 1") && message.contains("`x`"), "{message}");
}

#[test]
fn outputs_that_cannot_be_written() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    for target in ["no/such/folder/model.bin", "robot.toml/model.bin", "logs"] {
        for arguments in [
            &["fit", ".", "--out", target][..],
            &["evaluate", "model.bin", "--logs", "logs", "--csv", target],
        ] {
            let message = workshop.refuse(arguments);
            assert!(message.starts_with(&format!("{target}: cannot be written: ")), "{message}");
            assert!(!message.contains(".trainer-"), "names a passing file: {message}");
        }
    }
}

#[test]
#[cfg(unix)]
fn a_read_only_folder_is_left_alone() {
    use std::os::unix::fs::PermissionsExt;
    let workshop = Workshop::new();
    workshop.write("shelf/model.bin", "an earlier model");
    let allow = |mode| {
        let permissions = std::fs::Permissions::from_mode(mode);
        std::fs::set_permissions(workshop.path("shelf"), permissions).unwrap();
    };
    allow(0o555);
    // The administrator may write everywhere.
    if std::fs::write(workshop.path("shelf/probe"), "").is_err() {
        let message = workshop.refuse(&["fit", ".", "--out", "shelf/model.bin"]);
        assert!(message.starts_with("shelf/model.bin: cannot be written: "), "{message}");
    } else {
        println!("skipped: this user may write to a read-only folder");
    }
    allow(0o755);
}

#[test]
#[cfg(unix)]
fn a_pipe_is_written_and_not_replaced() {
    use std::os::unix::fs::FileTypeExt;
    let workshop = Workshop::new();
    let pipe = workshop.path("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let reader = std::thread::spawn({
        let pipe = pipe.clone();
        move || std::fs::read(pipe).unwrap()
    });
    workshop.succeed(&["fit", ".", "--out", "pipe"]);
    assert!(std::fs::symlink_metadata(pipe).unwrap().file_type().is_fifo());
    workshop.succeed(&["fit", "."]);
    assert_eq!(reader.join().unwrap(), workshop.read("model.bin"));
}

#[test]
fn names_with_spaces_and_other_letters() {
    let workshop = Workshop::new();
    for number in 0..3 {
        let name = format!("мой робот/log files/trial {number}, é.csv");
        workshop.write(&name, text(&lines(&trial(number))));
    }
    workshop.write("мой робот/robot.toml", ROBOT);
    workshop.succeed(&["fit", "мой робот", "--logs", "мой робот/log files"]);
    workshop.succeed(&[
        "evaluate",
        "мой робот/model.bin",
        "--logs",
        "мой робот/log files",
        "--csv",
        "мой робот/out put.csv",
    ]);
    let csv = String::from_utf8(workshop.read("мой робот/out put.csv")).unwrap();
    assert!(csv.lines().nth(1).unwrap().starts_with("\"trial 0, é\",5,1,"), "{csv:.200}");
}

#[test]
fn mistakes_on_the_command_line() {
    let workshop = Workshop::new();
    for arguments in [
        &[][..],
        &["fti"],
        &["fit"],
        &["fit", ".", "--log", "logs"],
        &["evaluate", "model.bin"],
        &["evaluate", "model.bin", "--logs", "logs", "--horizon", "0"],
        &["evaluate", "model.bin", "--logs", "logs", "--stride", "-1"],
        &["evaluate", "model.bin", "--logs", "logs", "--horizon", "ten"],
        &["resample", "logs", "--dt", "fast", "--out", "new"],
        &["resample", "logs", "--dt", "0.1"],
    ] {
        let said = workshop.run(arguments);
        assert_eq!((said.code, said.stdout.as_str()), (Some(2), ""), "{arguments:?}");
        assert!(said.stderr.contains("--help") || said.stderr.contains("Usage"), "{}", said.stderr);
    }
    for command in [
        "fit",
        "evaluate",
        "inspect",
        "spectrum",
        "dictionary",
        "resample",
        "reproduce",
        "calibrate",
        "stability",
    ] {
        let help = workshop.succeed(&[command, "--help"]);
        assert!(help.contains(&format!("Usage: trainer {command}")), "{help}");
    }
}

#[test]
fn outputs_take_no_place_of_inputs() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", ".", "--no-score"]);
    let description = workshop.read("robot.toml");
    let message = workshop.refuse(&["fit", ".", "--out", "robot.toml"]);
    assert!(message.contains("robot.toml: a blob must not"), "{message}");
    assert_eq!(workshop.read("robot.toml"), description);
    let inside = ["evaluate", "model.bin", "--logs", "logs", "--csv", "logs/predicted.csv"];
    let message = workshop.refuse(&inside);
    assert!(message.contains("logs/predicted.csv: beside the logs"), "{message}");
    workshop.succeed(&["fit", ".", "--no-score"]);
}

#[test]
fn reproduce_wants_the_papers_logs() {
    let workshop = Workshop::new();
    let message = workshop.refuse(&["reproduce", "logs", "--out", "report"]);
    assert!(message.contains("paper.toml: cannot be read"), "{message}");
    assert!(message.contains("`firmware-sim record paper --out DIR`"), "{message}");
    workshop.write("paper.toml", "seed = 1\nlogs = 3\n");
    workshop.write("paper/paper.toml", "seed = 1\nlogs = 3\n");
    let message = workshop.refuse(&["reproduce", "paper", "--out", "report"]);
    assert!(message.contains("paper.toml: invalid type"), "{message}");
    let message = workshop.refuse(&["reproduce", ".", "--out", "robot.toml"]);
    assert!(message.contains("robot.toml: not a folder"), "{message}");
    let message = workshop.refuse(&["reproduce", ".", "--out", "report"]);
    assert!(message.contains("among the logs"), "{message}");
    workshop.write("mine/report.md", "my own report\n");
    let message = workshop.refuse(&["reproduce", "logs", "--out", "mine"]);
    assert!(message.contains("not a report of `trainer reproduce`"), "{message}");
}

#[test]
fn listed_terms_make_a_sparse_model() {
    let workshop = Workshop::new();
    let listed = r#"[dictionary]
terms = ["u", "sin(phi)", "x", "x*sin(2*phi)*u"]
standardise = false

[score]"#;
    workshop.describe("[score]", listed);
    let fitted = workshop.succeed(&["fit", "."]);
    assert!(fitted.contains("dictionary: 5 terms, 3 outputs"), "{fitted}");
    let inspected = workshop.succeed(&["inspect", "model.bin", "--json"]);
    let inspected: Value = serde_json::from_str(&inspected).unwrap();
    // The chain needs a product of two for the product of three.
    assert_eq!(inspected["terms"].as_array().unwrap().len(), 6);
    let next_x = inspected["equations"][0]["terms"].as_array().unwrap();
    let coefficient = |name: &str| {
        let term = next_x.iter().find(|t| t[0] == name);
        term.map_or(0.0, |t| t[1].as_f64().unwrap())
    };
    for (name, expected) in [("x", 0.9), ("sin(phi)", 0.1), ("u", 0.02), ("1", 0.0)] {
        assert!((coefficient(name) - expected).abs() < 1e-6, "{name}: {next_x:?}");
    }
    assert!(next_x.iter().all(|t| t[0] != "x*sin(2*phi)*u" || t[1].as_f64().unwrap().abs() < 1e-6));
    // The blob predicts as the fit did.
    let scored = workshop.succeed(&["evaluate", "model.bin", "--logs", "logs"]);
    assert!(scored.contains("x [m]"), "{scored}");
    let message = workshop.refuse(&["spectrum", "."]);
    assert!(message.contains("cart has no spectrum") && message.contains("blocks"), "{message}");
}

#[test]
fn a_refined_fit_says_so_and_repeats_to_the_bit() {
    let workshop = Workshop::new();
    workshop.describe(
        "[score]",
        "[dictionary]\nterms = [\"x\", \"u\", \"sin(phi)\"]\n[fit]\nrefine = 0.1\n[score]",
    );
    let text = workshop.succeed(&["fit", "."]);
    assert!(text.contains("refined by the rollouts of") && text.contains("held by 0.1"), "{text}");
    let blob = workshop.read("model.bin");
    workshop.succeed(&["fit", "."]);
    assert_eq!(workshop.read("model.bin"), blob);

    // The rollouts of the refined operator are better than those of the one-step fit.
    let nrmse = |workshop: &Workshop| {
        let report = json(&workshop.succeed(&["fit", ".", "--json"]));
        report["score"]["contenders"][0]["nrmse"].as_f64().unwrap()
    };
    let refined = nrmse(&workshop);
    workshop.describe("[score]", "[dictionary]\nterms = [\"x\", \"u\", \"sin(phi)\"]\n[score]");
    let one_step = nrmse(&workshop);
    assert!(refined < one_step, "{refined} {one_step}");

    // Logs too short for a window of the horizon.
    workshop.describe("[score]\nhorizon = 10", "[fit]\nrefine = 0.1\n[score]\nhorizon = 1000");
    let text = workshop.succeed(&["fit", "."]);
    assert!(text.contains("not refined: no window"), "{text}");
}

#[test]
fn calibrate_stores_bounds_that_evaluate_checks() {
    let workshop = Workshop::new();
    workshop.describe("[score]", "[dictionary]\norders = { phi = 0 }\n\n[score]");
    workshop.succeed(&["fit", ".", "--no-score", "--logs", "logs/run-0.csv"]);
    let plain = workshop.read("model.bin");
    // Three trajectories are too few for 90 %; their 21 blocks of 16 rows are not.
    let said =
        workshop.succeed(&["calibrate", "model.bin", "--logs", "logs", "--out", "calibrated.bin"]);
    assert!(said.contains("error bounds for 90 % from 21 contiguous blocks"), "{said}");
    assert!(said.contains("x [m]: ") && said.contains(" after 10"), "{said}");
    assert_eq!(workshop.read("model.bin"), plain);
    // Nothing but the bounds is new, and a second calibration replaces them.
    let again = ["calibrate", "calibrated.bin", "--logs", "logs", "--coverage", "0.8"];
    let bytes = workshop.read("calibrated.bin");
    workshop.succeed(&again);
    assert_eq!(workshop.read("calibrated.bin").len(), bytes.len());
    let inspected: Value =
        serde_json::from_str(&workshop.succeed(&["inspect", "calibrated.bin", "--json"])).unwrap();
    let bounds = &inspected["error_bounds"];
    assert_eq!((bounds["coverage"].as_f64(), bounds["units"].as_u64()), (Some(0.8), Some(21)));
    assert_eq!(bounds["steps"].as_array().unwrap().len(), 10);
    assert_eq!(bounds["bounds"].as_array().unwrap().len(), 20);
    assert!(workshop.succeed(&["inspect", "calibrated.bin"]).contains("error bounds for 80.00 %"));
    // On the very units that made them, the bounds hold for ⌈22 · 0.8⌉ = 18 of 21.
    let scored = ["evaluate", "calibrated.bin", "--robot", "robot.toml", "--logs", "logs"];
    let text = workshop.succeed(&scored);
    assert!(
        text.contains("Error bounds for 80.0 % from 21 units: on 21 contiguous blocks, 85.7 % to"),
        "{text}"
    );
    let scored: Value =
        serde_json::from_str(&workshop.succeed(&[&scored[..], &["--json"]].concat())).unwrap();
    assert!((scored["error_bounds"]["range"][0].as_f64().unwrap() - 18.0 / 21.0).abs() < 1e-12);

    for (arguments, fragment) in [
        (["--coverage", "0.99"], "21 units (blocks of 16 rows) are too few"),
        (["--coverage", "1"], "must lie between 0 and 1"),
        (["--horizon", "400"], "rows of a window"),
    ] {
        let command = ["calibrate", "model.bin", "--logs", "logs", arguments[0], arguments[1]];
        let message = workshop.refuse(&command);
        assert!(message.contains(fragment), "{message}");
    }
}

#[test]
fn calibrate_leaves_out_folds_of_the_logs_of_the_fit() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    let same = ["calibrate", "model.bin", "--logs", "logs"];
    let message = workshop.refuse(&same);
    assert!(message.contains("fitted on these very logs"), "{message}");
    let said = workshop.succeed(&[&same[..], &["--cross-validate"]].concat());
    assert!(said.contains("error bounds for 90 % from 21 contiguous blocks"), "{said}");
    // Three folds of seven blocks: each is asked with the bounds from fourteen.
    assert!(said.contains("each fold asked with the bounds from the others"), "{said}");
    assert!(said.contains("from 14 units: on 21 contiguous blocks"), "{said}");
    // With 15 blocks at most, no fold has a finite bound for 94 %; all 21 have.
    let high = [&same[..], &["--cross-validate", "--coverage", "0.94"]].concat();
    let said = workshop.succeed(&high);
    assert!(said.contains("cannot be asked fold by fold: 14 units"), "{said}");

    let text = workshop.read("robot.toml");
    workshop.write("robot.toml", [&text[..], b"# changed\n"].concat());
    let message = workshop.refuse(&[&same[..], &["--cross-validate"]].concat());
    assert!(message.contains("the robot.toml of the fit, unchanged"), "{message}");
    workshop.write("robot.toml", &text);
    workshop.succeed(&["fit", ".", "--no-score", "--logs", "logs/run-0.csv"]);
    let message = workshop.refuse(&[&same[..], &["--cross-validate"]].concat());
    assert!(message.contains("these are others"), "{message}");
}

#[test]
fn select_finds_a_model_within_the_budget() {
    let workshop = Workshop::new();
    let search = ["select", ".", "--max-terms", "6", "--max-candidates", "150"];
    let said = workshop.succeed(&search);
    assert!(said.contains("150 candidates") && said.contains("<- winner"), "{said}");
    let found = workshop.read("selected/robot.toml");
    let text = String::from_utf8(found.clone()).unwrap();
    assert!(
        text.contains("terms = [") && text.contains("Found by `trainer select` among 150"),
        "{text}"
    );
    assert!(workshop.read("selected/front.svg").starts_with(b"<svg"));
    // The blob is the fit of the description that lies beside it.
    let blob = workshop.read("selected/model.bin");
    let fitted = workshop.succeed(&["fit", "selected", "--logs", "logs"]);
    assert!(fitted.contains("RMSE over 10 steps"), "{fitted}");
    assert_eq!(workshop.read("selected/model.bin"), blob);
    // From the journal, from scratch and with another number of threads: the same.
    workshop.succeed(&search);
    assert_eq!(workshop.read("selected/robot.toml"), found);
    workshop.succeed(&[&search[..], &["--out", "again", "--threads", "1"]].concat());
    assert_eq!(workshop.read("again/robot.toml"), found);

    let message = workshop.refuse(&["select", ".", "--max-bytes", "10", "--out", "small"]);
    assert!(message.contains("fits the budget"), "{message}");
    let message = workshop.refuse(&["select", ".", "--out", "."]);
    assert!(message.contains("would be replaced"), "{message}");
}
