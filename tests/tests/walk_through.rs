//! The README's two terminals: serve, flash, monitor, and a fit from the recording.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// The commands that stand in the README, block by block, under a heading.
fn blocks(heading: &str) -> Vec<Vec<String>> {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let (_, section) = readme.split_once(heading).expect("the heading is there");
    let section = section.split("\n#").next().unwrap();
    let mut blocks = vec![Vec::new()];
    for line in section.lines() {
        match line.strip_prefix("    ") {
            Some(command) => blocks.last_mut().unwrap().push(command.to_owned()),
            None if blocks.last().unwrap().is_empty() => {}
            None => blocks.push(Vec::new()),
        }
    }
    blocks.retain(|block| !block.is_empty());
    blocks
}

/// A command of the README in a folder of its own, where the models are.
fn command(line: &str, folder: &Path, port: &str) -> Command {
    let bin = root().join("target/release");
    // A port of its own, as others may use that of the README.
    let line = line.replace("127.0.0.1:4000", port);
    let mut words = line.split_whitespace();
    let mut command = Command::new(bin.join(words.next().unwrap()));
    command.args(words).current_dir(folder);
    command
}

struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        // It would run for ever.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "takes a minute of real time and builds the commands in release; run with --release --ignored"]
fn serve_flash_monitor_and_fit_as_the_readme_says() {
    let built = Command::new("cargo")
        .args(["build", "--release", "--locked", "-q", "-p", "trainer", "-p", "firmware-sim"])
        .current_dir(root())
        .status()
        .unwrap();
    assert!(built.success());
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let robot = folder.join("models/skid-rosbot");
    std::fs::create_dir_all(robot.join("logs")).unwrap();
    let models = root().join("models/skid-rosbot");
    for name in ["robot.toml", "model.bin"] {
        std::fs::copy(models.join(name), robot.join(name)).unwrap();
    }
    for log in models.join("logs").read_dir().unwrap() {
        let log = log.unwrap();
        std::fs::copy(log.path(), robot.join("logs").join(log.file_name())).unwrap();
    }

    let blocks = blocks("### Talking to it");
    let [first, second, ..] = &blocks[..] else { panic!("{blocks:?}") };
    let [keygen, serve] = &first[..] else { panic!("{first:?}") };
    assert!(command(keygen, folder, "").status().unwrap().success(), "{keygen}");
    assert!(serve.contains("serve ") && serve.contains(" --public-key "), "{serve}");
    let mut served = command(serve, folder, "127.0.0.1:0");
    let served = served.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut served = Served(served);
    let mut line = String::new();
    BufReader::new(served.0.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let port = line.trim_end().strip_prefix("skid-rosbot on tcp:").expect("its first line");

    let mut said = Vec::new();
    for line in second {
        let output = command(line, folder, port).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{line}\n{text}{errors}");
        said.push(text);
    }
    assert_eq!(said.len(), 5, "{second:?}");
    assert!(said[2].contains("runs now: release 1, ") && said[2].contains("confirmed"), "{said:?}");
    // A minute of driving is enough for a score of the next model.
    assert!(said[4].contains("NRMSE") && folder.join("next.bin").exists(), "{}", said[4]);
}
