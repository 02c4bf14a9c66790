//! The command `firmware-sim record paper`, from the outside.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn record_paper(out: &Path, more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_firmware-sim"))
        .args(["record", "paper", "--out"])
        .arg(out)
        .args(more)
        .output()
        .unwrap()
}

/// Runs a command that must succeed; what it prints.
fn recorded(out: &Path, more: &[&str]) -> String {
    let output = record_paper(out, more);
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{message}");
    assert_eq!(message, "");
    String::from_utf8(output.stdout).unwrap()
}

/// Runs a command that must fail; its message, one line.
fn refused(out: &Path, more: &[&str]) -> String {
    let output = record_paper(out, more);
    assert!(!output.status.success());
    assert_eq!(output.stdout, b"");
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(message.lines().count(), 1, "{message}");
    message
}

/// Every file below a directory with its bytes.
fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    fn add(root: &Path, dir: &Path, files: &mut BTreeMap<PathBuf, Vec<u8>>) {
        for entry in fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                add(root, &path, files);
            } else {
                let bytes = fs::read(&path).unwrap();
                files.insert(path.strip_prefix(root).unwrap().into(), bytes);
            }
        }
    }
    let mut all = BTreeMap::new();
    add(dir, dir, &mut all);
    all
}

/// Folder, trials, rows, and the last row of the last trial.
const LAYOUT: [(&str, i64, i64, &str); 23] = [
    (
        "drive-euler/train",
        100,
        501,
        "50,-0.07687971002063662,-0.04341171439182447,-0.8615280701754421,-4.039,-5.329",
    ),
    (
        "drive-euler/validation",
        100,
        51,
        "5,0.30463208000135855,-0.024244586541551955,0.5181078947368426,2.959,16.502",
    ),
    (
        "drive-euler/circle",
        1,
        51,
        "5,0.3629391714239354,0.17980405633280483,7.35012719298246,12.1369,6.731",
    ),
    (
        "drive-exact/train",
        100,
        501,
        "50,-0.19731739557766736,-0.15642629626633614,-0.8615280701754421,-4.039,-5.329",
    ),
    (
        "drive-exact/validation",
        100,
        51,
        "5,0.31183346762729414,-0.00005206985777165066,0.5181078947368426,2.959,16.502",
    ),
    (
        "drive-exact/circle",
        1,
        51,
        "5,0.348441367661256,0.20578565493080314,7.35012719298246,12.1369,6.731",
    ),
    (
        "drive-closing/train",
        100,
        501,
        "50,0.08938191505006657,0.02071186530417015,-0.7364675438596455,-4.039,-5.329",
    ),
    (
        "drive-closing/circle",
        1,
        51,
        "5,-0.000004792828541523575,0.00000030156765076436165,6.28317324561403,12.1369,6.731",
    ),
    ("rosbot/chattering", 10, 501, "50,0.320003,-1.062945,7.439879,-10.439,-15.238"),
    ("rosbot/circle", 1, 51, "5,0.241123,0.071787,6.91538,12.1369,6.731"),
    ("rosbot/sharp-turn", 1, 37, "3.6,1.046467,0.988465,1.564674,10,10"),
    (
        "arm-euler/train",
        100,
        201,
        "2,-2.881739102822622,0.5004781566237373,3.114271469957968,0.06746648567777735,0.6579,-0.7475",
    ),
    (
        "arm-euler/validation",
        100,
        101,
        "1,-2.5765756960518034,0.45054784527342506,-1.5245652672258136,-4.010620519663251,0.7806,0.0729",
    ),
    (
        "arm-euler/quadrant",
        1,
        51,
        "0.5,-1.6821611301101385,1.3598954451159964,-4.146819984516899,-1.942650802921164,-1,0",
    ),
    (
        "arm-rk4/train",
        100,
        201,
        "2,-2.626917364077108,0.46744602590497075,3.9145496915104325,-1.9822520413477303,0.6579,-0.7475",
    ),
    (
        "arm-rk4/validation",
        100,
        101,
        "1,-2.5350421047507834,0.379702710765821,-1.539291692972633,-3.734476568554333,0.7806,0.0729",
    ),
    (
        "arm-rk4/quadrant",
        1,
        51,
        "0.5,-1.66086268305721,1.2707018052244325,-3.8459218802764354,-2.1881856505291926,-1,0",
    ),
    ("leg-bending/train", 5, 41, "2,31.1757,11.445,7.97,0"),
    ("leg-bending/test", 1, 41, "2,20.6449,4.5733,3.19,0"),
    ("leg-extension/train", 5, 41, "2,0.0485,-16.3276,0,6.92"),
    ("leg-extension/test", 1, 41, "2,-0.0472,-5.4872,0,3.61"),
    ("leg-walk/train", 14, 41, "2,-17.6987,15.5134,-11.24,-12.03"),
    ("leg-walk/test", 1, 61, "3,0.502,7.2224,-4.54,-3.88"),
];

#[test]
fn layout_manifest_and_last_rows() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("new").join("logs");
    assert_eq!(
        recorded(&out, &[]),
        format!("paper: 23 logs of 944 trials, seed 1, in {}\n", out.display())
    );
    let mut files = files(&out);

    let manifest = String::from_utf8(files.remove(Path::new("paper.toml")).unwrap()).unwrap();
    assert!(manifest.starts_with(
        "seed = 1\n\n\
         [[logs]]\n\
         folder = \"drive-euler/train\"\n\
         plant = \"differential drive, r = 0.062 m, L = 0.228 m, one Euler step per sample\"\n\
         trials = 100\n\
         rows = 501\n\
         sample_time_s = 0.1\n\
         input = \"omega_r, omega_l: N(0, 9²) radps, new every sample\"\n\
         noise = \"none\"\n\
         stand_in = false\n\n\
         [[logs]]\n"
    ));
    let manifest: toml::Table = manifest.parse().unwrap();
    let logs = manifest["logs"].as_array().unwrap();
    assert_eq!(logs.len(), LAYOUT.len());
    for (log, (folder, trials, rows, last_row)) in logs.iter().zip(LAYOUT) {
        assert_eq!(log["folder"].as_str(), Some(folder));
        assert_eq!(log["trials"].as_integer(), Some(trials), "{folder}");
        assert_eq!(log["rows"].as_integer(), Some(rows), "{folder}");
        let robot = folder.split(['-', '/']).next().unwrap();
        let (columns, sample_time_s) = match robot {
            "drive" | "rosbot" => ("x_m,y_m,phi_rad,omega_r_radps,omega_l_radps", 0.1),
            "arm" => ("theta1_rad,theta2_rad,dtheta1_radps,dtheta2_radps,tau1_Nm,tau2_Nm", 0.01),
            _ => ("y_mm,z_mm,bending_V,extension_V", 0.05),
        };
        assert_eq!(log["sample_time_s"].as_float(), Some(sample_time_s));
        let invented = ["rosbot", "leg"].contains(&robot);
        assert_eq!(log["stand_in"].as_bool(), Some(invented));
        assert_eq!(log["plant"].as_str().unwrap().contains("invented"), invented);
        assert_eq!(log["noise"].as_str() != Some("none"), invented);
        for text in ["plant", "input", "noise"] {
            assert_eq!(log[text].as_str().unwrap().lines().count(), 1);
        }

        for trial in 0..trials {
            let path = Path::new(folder).join(format!("trial-{trial:03}.csv"));
            let csv = String::from_utf8(files.remove(&path).unwrap()).unwrap();
            assert!(csv.ends_with('\n') && !csv.contains('\r'));
            assert_eq!(csv.lines().next(), Some(&*format!("time_s,{columns}")));
            assert_eq!(csv.lines().count() as i64, 1 + rows, "{}", path.display());
            if trial == trials - 1 {
                assert_eq!(csv.lines().last(), Some(last_row), "{}", path.display());
            }
        }
    }
    assert_eq!(files.keys().collect::<Vec<_>>(), Vec::<&PathBuf>::new());
    // Nothing is left beside it.
    assert_eq!(fs::read_dir(dir.path().join("new")).unwrap().count(), 1);
}

#[test]
fn same_seed_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let logs = |name: &str, seed: &str| {
        let out = dir.path().join(name);
        recorded(&out, &["--seed", seed]);
        files(&out)
    };
    let first = logs("first", "7");
    // Not assert_eq: twenty megabytes of message help nobody.
    assert!(first == logs("again", "7"));
    let other = logs("other", "8");
    assert!(first.keys().eq(other.keys()));
    let changed = |path: &str| first[Path::new(path)] != other[Path::new(path)];
    assert!(changed("drive-euler/train/trial-099.csv") && changed("leg-walk/test/trial-000.csv"));
    assert!(!changed("drive-euler/circle/trial-000.csv"));
}

#[test]
fn logs_are_replaced_only_on_request_and_then_whole() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path();
    recorded(out, &[]);
    let before = files(out);
    let message = refused(out, &["--seed", "2"]);
    assert!(
        message.contains("paper.toml already exists: choose another directory or pass --overwrite"),
        "{message}"
    );
    assert!(files(out) == before);
    recorded(out, &["--seed", "2", "--overwrite"]);
    let after = files(out);
    assert!(after != before && after.keys().eq(before.keys()));

    // What an earlier version wrote goes too, if its manifest says so.
    let manifest = fs::read_to_string(out.join("paper.toml")).unwrap();
    fs::rename(out.join("rosbot"), out.join("older")).unwrap();
    fs::write(out.join("paper.toml"), manifest.replace("rosbot/", "older/")).unwrap();
    recorded(out, &["--overwrite"]);
    assert!(files(out) == before);
}

#[test]
fn what_others_wrote_is_never_touched() {
    let foreign = |path: &str| {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("logs");
        recorded(&out, &[]);
        let path = out.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "mine").unwrap();
        let before = files(&out);
        for more in [&[][..], &["--overwrite"]] {
            let message = refused(&out, more);
            assert!(message.contains("is not from `record paper`"), "{message}");
            assert!(message.contains(out.to_str().unwrap()), "{message}");
            assert!(files(&out) == before);
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    };
    foreign("notes.txt");
    foreign("drive-euler/train/trial-100.csv");
    foreign("drive-euler/mine/trial-000.csv");
    // Its own name is not enough.
    foreign("paper.toml");

    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("trial-000.csv"), "time_s\n").unwrap();
    for more in [&[][..], &["--overwrite"]] {
        let message = refused(dir.path(), more);
        assert!(message.contains("trial-000.csv is not from `record paper`"), "{message}");
    }
    assert_eq!(files(dir.path()).len(), 1);
}

#[test]
fn an_empty_directory_is_filled_and_stays_the_same_directory() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("here");
    fs::create_dir(&out).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_firmware-sim"))
        .current_dir(&out)
        .args(["record", "paper", "--out", ".", "--seed", "4294967295"])
        .output()
        .unwrap();
    assert!(output.status.success());
    assert!(fs::read_to_string(out.join("paper.toml")).unwrap().starts_with("seed = 4294967295\n"));
}

#[cfg(unix)]
#[test]
fn logs_can_be_read_by_others() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("logs");
    recorded(&out, &[]);
    let (plain_dir, plain) = (dir.path().join("plain"), dir.path().join("file"));
    fs::create_dir(&plain_dir).unwrap();
    fs::write(&plain, "").unwrap();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
    for path in [&out, &out.join("drive-euler"), &out.join("drive-euler/train")] {
        assert_eq!(mode(path), mode(&plain_dir));
    }
    for path in [out.join("paper.toml"), out.join("arm-rk4/quadrant/trial-000.csv")] {
        assert_eq!(mode(&path), mode(&plain));
    }
}

#[test]
fn an_unusable_directory_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    fs::write(&file, "").unwrap();
    for out in [file.clone(), file.join("below")] {
        let message = refused(&out, &[]);
        assert!(message.contains("cannot use the directory"), "{message}");
        assert!(message.contains(out.to_str().unwrap()), "{message}");
    }
}

#[test]
fn help_tells_of_the_set_and_its_options() {
    let help = |arguments: &[&str]| {
        let output =
            Command::new(env!("CARGO_BIN_EXE_firmware-sim")).args(arguments).output().unwrap();
        assert!(output.status.success());
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(help(&["record", "--help"]).contains("record paper"));
    let own = help(&["record", "paper", "--help"]);
    for word in ["--seed", "--out", "--overwrite", "paper.toml", "[default: 1]"] {
        assert!(own.contains(word), "{word}");
    }
    assert!(!own.contains("--trials"));
}
