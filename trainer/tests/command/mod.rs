//! Runs the built command on a made-up robot in a folder of its own.
#![allow(dead_code, reason = "every test file uses a part")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;

/// A cart on a rail with a swivelling sail: terms of both kinds of space and an input.
pub const ROBOT: &str = r#"name = "cart"
sample_time_s = 0.1

[[states]]
name = "x"
space = "R"
unit = "m"

[[states]]
name = "phi"
space = "S1"
unit = "rad"

[[inputs]]
name = "u"
unit = "V"
range = [-10, 10]

[score]
horizon = 10
"#;

/// Terms of its dictionary: [1, sin phi] ⊗ [1, cos phi] ⊗ [1, x] ⊗ [1, u].
pub const TERMS: usize = 16;

/// Rows of each of its logs.
pub const ROWS: usize = 120;

/// One recorded sample: x, phi (not wrapped), u.
pub type Sample = [f64; 3];

/// What the cart did in a trial.
pub fn trial(number: u64) -> Vec<Sample> {
    let mut seed = number.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(1);
    let mut uniform = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        2.0 * (seed >> 11) as f64 / (1_u64 << 53) as f64 - 1.0
    };
    let (mut x, mut phi) = (0.1, 0.2_f64);
    (0..ROWS)
        .map(|_| {
            let sample = [x, phi, (10.0 * uniform() * 1e3).round() / 1e3];
            x = 0.9 * x + 0.1 * phi.sin() + 0.02 * sample[2];
            phi += 0.1 * sample[2] + 0.05 * x;
            sample
        })
        .collect()
}

/// Lines of a log: the header, then one line per sample.
pub fn lines(samples: &[Sample]) -> Vec<String> {
    let header = "time_s,x_m,phi_rad,u_V".to_owned();
    let rows = samples
        .iter()
        .enumerate()
        .map(|(k, [x, phi, u])| format!("{},{x},{phi},{u}", (k as f64 * 1e8).round() / 1e9));
    [header].into_iter().chain(rows).collect()
}

/// Lines as the bytes of a file.
pub fn text(lines: &[String]) -> String {
    lines.join("\n") + "\n"
}

/// What a run of the command said.
#[derive(Debug)]
pub struct Said {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl From<Output> for Said {
    fn from(output: Output) -> Self {
        let text = |bytes| String::from_utf8(bytes).expect("the command speaks UTF-8");
        Self {
            code: output.status.code(),
            stdout: text(output.stdout),
            stderr: text(output.stderr),
        }
    }
}

/// A folder with `robot.toml` and three logs, in which the command runs.
pub struct Workshop {
    folder: TempDir,
}

impl Workshop {
    pub fn new() -> Self {
        let workshop = Self { folder: TempDir::new().unwrap() };
        workshop.write("robot.toml", ROBOT);
        for number in 0..3 {
            workshop.write(&format!("logs/run-{number}.csv"), text(&lines(&trial(number))));
        }
        workshop
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, content).unwrap();
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap()
    }

    /// The robot's description with one passage replaced.
    pub fn describe(&self, passage: &str, by: &str) {
        assert!(ROBOT.contains(passage), "{passage}");
        self.write("robot.toml", ROBOT.replacen(passage, by, 1));
    }

    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trainer"));
        command.current_dir(self.folder.path()).args(arguments);
        command
    }

    pub fn run(&self, arguments: &[&str]) -> Said {
        self.command(arguments).output().unwrap().into()
    }

    /// Runs the command, which has to succeed and be silent on standard error.
    #[track_caller]
    pub fn succeed(&self, arguments: &[&str]) -> String {
        let said = self.run(arguments);
        assert_eq!((said.code, said.stderr.as_str()), (Some(0), ""), "{arguments:?}");
        said.stdout
    }

    /// Runs the command, which has to refuse with one line and leave every file as it was.
    #[track_caller]
    pub fn refuse(&self, arguments: &[&str]) -> String {
        let before = self.files();
        let said = self.run(arguments);
        assert_eq!((said.code, said.stdout.as_str()), (Some(1), ""), "{arguments:?}: {said:?}");
        let line = said.stderr.strip_suffix('\n').expect("the message ends its line");
        assert!(!line.contains('\n'), "more than one line: {line}");
        let message = line.strip_prefix("error: ").unwrap_or_else(|| panic!("no error: {line}"));
        assert!(before == self.files(), "files changed, though the command refused: {message}");
        message.to_owned()
    }

    /// Every file and folder with its content, to see that nothing was touched or left behind.
    fn files(&self) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
        fn walk(folder: &Path, found: &mut BTreeMap<PathBuf, Option<Vec<u8>>>) {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    walk(&path, found);
                    found.insert(path, None);
                } else {
                    let content = std::fs::read(&path).unwrap();
                    found.insert(path, Some(content));
                }
            }
        }
        let mut found = BTreeMap::new();
        walk(self.folder.path(), &mut found);
        found
    }
}
