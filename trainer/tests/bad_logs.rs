//! Bad logs are refused with one line and leave nothing behind; good ones of every habit are read.

mod command;

use command::{ROBOT, Workshop, lines, text, trial};

/// The log that the tests spoil.
fn good() -> Vec<String> {
    lines(&trial(1))
}

/// Row `row` of the file (the header is row 1) with field `field` replaced.
fn with_field(row: usize, field: usize, content: &str) -> String {
    let mut lines = good();
    let mut fields: Vec<&str> = lines[row - 1].split(',').collect();
    fields[field] = content;
    lines[row - 1] = fields.join(",");
    text(&lines)
}

/// The log with the time of every row from `row` on shifted.
fn with_shift(row: usize, seconds: f64) -> String {
    let mut lines = good();
    for (k, line) in lines.iter_mut().enumerate().skip(row - 1) {
        let (_, rest) = line.split_once(',').unwrap();
        *line = format!("{},{rest}", (k as f64 - 1.0) / 10.0 + seconds);
    }
    text(&lines)
}

/// Every command that reads logs refuses `content` in the second of three files, naming all
/// `fragments`, whether or not an output is there already.
#[track_caller]
fn refused(content: impl AsRef<[u8]>, fragments: &[&str]) {
    let workshop = Workshop::new();
    workshop.write("earlier.bin", "an earlier model");
    workshop.succeed(&["fit", "."]);
    workshop.write("logs/run-1.csv", content);
    for arguments in [
        &["fit", "."][..],
        &["fit", "robot.toml", "--out", "earlier.bin", "--json"],
        &["fit", ".", "--out", "new.bin", "--no-score"],
        &["evaluate", "model.bin", "--logs", "logs"],
        &["evaluate", "model.bin", "--logs", "logs", "--csv", "predicted.csv"],
        &["evaluate", "model.bin", "--logs", "logs/run-0.csv", "--train", "logs", "--json"],
    ] {
        let message = workshop.refuse(arguments);
        for fragment in ["logs/run-1.csv"].iter().chain(fragments) {
            assert!(message.contains(fragment), "`{fragment}` is not in: {message}");
        }
    }
}

#[test]
fn fields() {
    refused(with_field(7, 1, "fast"), &["row 7, column `x_m`", "`fast`"]);
    refused(with_field(2, 0, "noon"), &["row 2, column `time_s`", "`noon`"]);
    refused(with_field(121, 3, ""), &["row 121, column `u_V`", "empty"]);
    refused(with_field(40, 2, "NaN"), &["row 40, column `phi_rad`", "finite", "`NaN`"]);
    refused(with_field(41, 1, "inf"), &["row 41, column `x_m`", "finite", "`inf`"]);
    refused(with_field(42, 3, "-Infinity"), &["row 42, column `u_V`", "finite", "`-Infinity`"]);
    refused(with_field(43, 3, "1e999"), &["row 43, column `u_V`", "finite", "`1e999`"]);
    refused(with_field(44, 0, "nan"), &["row 44, column `time_s`", "finite", "`nan`"]);
    refused(with_field(45, 1, "0x10"), &["row 45, column `x_m`", "`0x10`"]);
}

#[test]
fn rows() {
    refused(with_field(9, 3, "1.5,7"), &["row 9, column `5`", "4 fields", "found 5"]);
    refused(with_field(10, 1, "0,5"), &["row 10", "found 5", "decimal comma"]);
    let mut cut = text(&good());
    cut.truncate(cut.rfind(',').unwrap());
    refused(cut, &["row 121, column `u_V`", "4 fields", "found 3"]);
    refused(text(&good()[..2]), &["row 2", "one row"]);
    refused(text(&good()[..1]), &["no rows"]);
    refused("", &["empty"]);
    refused("\n\n", &["empty"]);
}

#[test]
fn columns() {
    let renamed = |from: &str, to: &str| text(&good()).replacen(from, to, 1);
    refused(renamed("phi_rad", "heading"), &["row 1", "`phi`", "`phi_rad`", "`heading`"]);
    refused(renamed("u_V", "U_V"), &["row 1", "`u`", "`u_V`", "`U_V`"]);
    refused(renamed("time_s", "t"), &["row 1", "`time_s`", "`t`"]);
    refused(renamed("phi_rad", "x_m"), &["row 1", "`x_m`", "columns 2 and 3"]);
    refused(renamed("phi_rad", "x"), &["row 1", "`x_m`", "`x`"]);
    refused(text(&good()).replace(',', ";"), &["row 1", "commas", "';'"]);
    // No header at all: its first row is taken for one.
    refused(text(&good()[1..]), &["row 1", "no column", "`time_s`"]);
}

#[test]
fn bytes() {
    refused([0xff_u8, 0xfe, b't', 0, b'i', 0], &["row 1"]);
    refused(text(&good()).replacen("0.1,", "0.1,\0", 1), &["row 2, column `phi_rad`"]);
    refused("time_s".to_owned() + &"x".repeat(3 << 20), &["row 1", "longer"]);
}

#[test]
fn times() {
    refused(with_shift(50, 0.1), &["row 50, column `time_s`", "gap", "0.1 s", "0.2 s"]);
    refused(with_shift(51, 0.006), &["row 51, column `time_s`", "jitter", "0.106 s"]);
    refused(with_shift(52, -0.006), &["row 52, column `time_s`", "jitter", "0.094 s"]);
    refused(with_shift(53, -0.1), &["row 53, column `time_s`", "stands still"]);
    refused(with_shift(54, -3.0), &["row 54, column `time_s`", "backwards", "-2.9 s"]);
}

#[test]
fn no_logs() {
    let workshop = Workshop::new();
    std::fs::create_dir(workshop.path("empty")).unwrap();
    workshop.write("notes/readme.txt", "nothing");
    for (logs, fragments) in [
        ("empty", ["empty", "no .csv file"]),
        ("notes", ["notes", "no .csv file"]),
        ("nowhere", ["nowhere", "no such file or directory"]),
        ("nowhere.csv", ["nowhere.csv", "no such file or directory"]),
        ("notes/readme.txt", ["notes/readme.txt", ".csv"]),
    ] {
        for options in [&[][..], &["--out", "new.bin"]] {
            let message = workshop.refuse(&[&["fit", ".", "--logs", logs], options].concat());
            assert!(fragments.iter().all(|f| message.contains(f)), "{message}");
        }
    }
    std::fs::remove_dir_all(workshop.path("logs")).unwrap();
    assert!(workshop.refuse(&["fit", "."]).contains("no such file or directory"));
}

#[test]
fn interleaved_episodes() {
    let workshop = Workshop::new();
    workshop.describe("sample_time_s = 0.1", "sample_time_s = 0.1\nepisode_column = \"run\"");
    let rows = |label: &str, number: u64| -> Vec<String> {
        lines(&trial(number))[1..].iter().map(|line| format!("{line},{label}")).collect()
    };
    let header = vec!["time_s,x_m,phi_rad,u_V,run".to_owned()];
    let (a, b) = (rows("a", 0), rows("b", 1));
    std::fs::remove_dir_all(workshop.path("logs")).unwrap();
    workshop.write("logs/all.csv", text(&[header.clone(), a.clone(), b.clone()].concat()));
    let both = workshop.succeed(&["fit", "."]);
    assert!(both.starts_with("cart: 2 trajectories, 240 rows, 238 snapshot pairs\n"), "{both}");

    let back = [&header[..], &a[..60], &b, &a[60..]].concat();
    workshop.write("logs/all.csv", text(&back));
    let message = workshop.refuse(&["fit", "."]);
    assert!(message.contains("logs/all.csv, row 182, column `run`: episode `a`"), "{message}");

    let single = [&header[..], &a, &b[..1]].concat();
    workshop.write("logs/all.csv", text(&single));
    let message = workshop.refuse(&["fit", "."]);
    assert!(message.contains("logs/all.csv, row 122") && message.contains("`all#b`"), "{message}");
}

/// Takes the command from a message and runs it as printed, in the workshop.
#[track_caller]
fn follow(workshop: &Workshop, message: &str) {
    let printed = message.split('`').find(|part| part.starts_with("trainer resample")).unwrap();
    let words = printed.strip_prefix("trainer ").unwrap();
    let mut shell = std::process::Command::new("sh");
    shell.current_dir(workshop.path("")).args(["-c", &format!("\"$TRAINER\" {words}")]);
    let output = shell.env("TRAINER", env!("CARGO_BIN_EXE_trainer")).output().unwrap();
    assert!(output.status.success(), "{printed}: {output:?}");
}

/// A log whose times jitter by up to a fifth of a sample, and whose angle is wrapped.
fn jittery(number: u64) -> Vec<String> {
    let mut lines = lines(&trial(number));
    for (k, line) in lines.iter_mut().enumerate().skip(1) {
        let fields: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let time = fields[0] + if k % 3 == 1 { 0.02 } else { 0.0 };
        let phi = fields[2].sin().atan2(fields[2].cos());
        *line = format!("{time},{},{phi},{}", fields[1], fields[3]);
    }
    lines
}

#[test]
fn jittery_logs_can_be_resampled_as_the_message_says() {
    let workshop = Workshop::new();
    for number in 0..3 {
        workshop.write(&format!("un even/run-{number}.csv"), text(&jittery(number)));
    }
    let message = workshop.refuse(&["fit", ".", "--logs", "un even"]);
    assert!(message.contains("un even/run-0.csv, row 3, column `time_s`"), "{message}");
    assert!(message.contains("jitters") && message.contains("--dt 0.1"), "{message}");
    follow(&workshop, &message);
    let fitted = workshop.succeed(&["fit", ".", "--logs", "DIR"]);
    assert!(fitted.starts_with("cart: 3 trajectories"), "{fitted}");
    // Inputs are held, never mixed: every one is a number of the log.
    let recorded: Vec<String> = trial(1).iter().map(|sample| sample[2].to_string()).collect();
    let resampled = String::from_utf8(workshop.read("DIR/run-1.csv")).unwrap();
    for line in resampled.lines().skip(1) {
        let input = line.rsplit(',').next().unwrap();
        assert!(recorded.iter().any(|u| u == input), "{line}");
    }
    // Angles move the short way round: no step larger than the inputs can make.
    let angles: Vec<f64> =
        resampled.lines().skip(1).map(|l| l.split(',').nth(2).unwrap().parse().unwrap()).collect();
    assert!(angles.windows(2).all(|w| (w[1] - w[0]).abs() < 1.5));
}

#[test]
fn the_proposed_command_knows_other_columns() {
    let workshop = Workshop::new();
    workshop.describe(
        "sample_time_s = 0.1",
        "sample_time_s = 0.1\ntime_column = \"t\"\nepisode_column = \"run\"",
    );
    let mut all = vec!["t,x_m,phi_rad,u_V,run,note".to_owned()];
    for (number, label) in [(0, "a"), (1, "b")] {
        all.extend(jittery(number)[1..].iter().map(|line| format!("{line},{label},fine")));
    }
    std::fs::remove_dir_all(workshop.path("logs")).unwrap();
    workshop.write("logs/all.csv", text(&all));
    let message = workshop.refuse(&["fit", "."]);
    follow(&workshop, &message);
    workshop.write(
        "even.toml",
        ROBOT.replacen("sample_time_s", "time_column = \"t\"\nsample_time_s", 1),
    );
    let fitted = workshop.succeed(&["fit", "even.toml", "--logs", "DIR"]);
    assert!(fitted.starts_with("cart: 2 trajectories"), "{fitted}");
}

#[test]
fn the_proposed_command_works_without_a_description() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", "."]);
    std::fs::create_dir(workshop.path("alone")).unwrap();
    std::fs::rename(workshop.path("model.bin"), workshop.path("alone/model.bin")).unwrap();
    for number in 0..3 {
        workshop.write(&format!("uneven/run-{number}.csv"), text(&jittery(number)));
    }
    let message = workshop.refuse(&["evaluate", "alone/model.bin", "--logs", "uneven"]);
    assert!(message.contains("--dt 0.1 --inputs u_V --angles phi_rad"), "{message}");
    follow(&workshop, &message);
    let table = workshop.succeed(&["evaluate", "alone/model.bin", "--logs", "DIR"]);
    assert!(table.contains("windows of 50 steps"), "{table}");
}

#[test]
fn numbers_beyond_the_controllers() {
    let workshop = Workshop::new();
    for scale in [1e39, 1e300] {
        let samples: Vec<_> = trial(1).iter().map(|[x, phi, u]| [x * scale, *phi, *u]).collect();
        workshop.write("logs/run-1.csv", text(&lines(&samples)));
        let message = workshop.refuse(&["fit", "."]);
        assert!(message.contains("`x` goes beyond"), "{message}");
    }
    let samples: Vec<_> = trial(1).iter().map(|[x, phi, u]| [x * 1e30, *phi, *u]).collect();
    workshop.write("logs/run-1.csv", text(&lines(&samples)));
    workshop.succeed(&["fit", "."]);
}

/// The blob of the workshop's robot from other texts of the same logs, without its provenance.
fn blob(habit: impl Fn(&str) -> Vec<u8>) -> Vec<f32> {
    let workshop = Workshop::new();
    for number in 0..3 {
        let log = text(&lines(&trial(number)));
        workshop.write(&format!("logs/run-{number}.csv"), habit(&log));
    }
    workshop.succeed(&["fit", "."]);
    coefficients(&workshop)
}

fn coefficients(workshop: &Workshop) -> Vec<f32> {
    let bytes = workshop.read("model.bin");
    let mut words = vec![0_u32; bytes.len().div_ceil(4)];
    bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(&bytes);
    let model = firmware_core::parse(bytemuck::cast_slice(&words)).unwrap();
    model.coefficients().to_vec()
}

#[test]
fn habits_of_writing_do_not_change_the_model() {
    let plain = blob(|log| log.as_bytes().to_vec());
    let same = |habit: fn(&str) -> String| {
        assert_eq!(blob(|log| habit(log).into_bytes()), plain);
    };
    same(|log| log.replace('\n', "\r\n"));
    same(|log| format!("\u{feff}{log}"));
    same(|log| format!("\u{feff}{}", log.replace('\n', "\r\n")));
    same(|log| format!("{log}\n\n"));
    same(|log| log.trim_end().to_owned());
    same(|log| log.replace(',', " , "));
    same(|log| log.lines().map(|l| format!("{},\"a, b\"\n", l)).collect());
    same(|log| log.replacen("phi_rad", "phi", 1).replacen("u_V", "u", 1));
    // The columns in another order.
    same(|log| {
        let turned = |line: &str| line.split(',').rev().collect::<Vec<_>>().join(",") + "\n";
        log.lines().map(turned).collect()
    });
}

#[test]
fn jitter_within_five_percent_is_accepted() {
    let workshop = Workshop::new();
    for sign in [-1.0, 1.0] {
        for number in 0..3 {
            let mut lines = lines(&trial(number));
            for (k, line) in lines.iter_mut().enumerate().skip(1) {
                let (_, rest) = line.split_once(',').unwrap();
                // One step in two is 4.9 % long, the other 4.9 % short.
                let jitter = if k % 2 == 0 { 0.0049 * sign } else { 0.0 };
                *line = format!("{},{rest}", (k as f64 - 1.0) / 10.0 + jitter);
            }
            workshop.write(&format!("logs/run-{number}.csv"), text(&lines));
        }
        workshop.succeed(&["fit", "."]);
    }
}

#[test]
fn degrees_give_the_model_of_radians() {
    let radians = blob(|log| log.as_bytes().to_vec());
    let workshop = Workshop::new();
    workshop.describe("unit = \"rad\"", "unit = \"deg\"");
    for number in 0..3 {
        let degrees =
            trial(number).iter().map(|[x, phi, u]| [*x, phi.to_degrees(), *u]).collect::<Vec<_>>();
        let log = text(&lines(&degrees)).replacen("phi_rad", "phi_deg", 1);
        workshop.write(&format!("logs/run-{number}.csv"), log);
    }
    workshop.succeed(&["fit", "."]);
    let degrees = coefficients(&workshop);
    assert_eq!(degrees.len(), radians.len());
    let largest = radians.iter().fold(0.0_f32, |max, c| max.max(c.abs()));
    for (d, r) in degrees.iter().zip(&radians) {
        // Two roundings of f32, relative to the largest coefficient.
        assert!((d - r).abs() <= 2.0 * f32::EPSILON * largest, "{d} {r}");
    }
}
