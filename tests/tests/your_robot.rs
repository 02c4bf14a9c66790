//! docs/your-robot.md: its example in one piece, and its commands as they are printed.

use std::path::Path;
use std::process::Command;

use firmware_core::blob;
use firmware_core::blob::Aligned;
use trainer::conformal::{Residuals, least_units, with_bounds};
use trainer::edmd;
use trainer::export::export;
use trainer::recording::Recording;
use trainer::robot::Robot;
use trainer::trajectory::{Logs, collect};

#[allow(dead_code)]
#[path = "../../firmware-sim/examples/cart.rs"]
mod cart;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

fn page() -> String {
    std::fs::read_to_string(root().join("docs/your-robot.md")).unwrap()
}

/// The code blocks of a language, and the text outside of all blocks.
fn blocks(page: &str) -> (Vec<(&str, &str)>, String) {
    let (mut blocks, mut prose) = (Vec::new(), String::new());
    let mut parts = page.split("```");
    while let Some(text) = parts.next() {
        prose += text;
        if let Some((language, code)) = parts.next().and_then(|block| block.split_once('\n')) {
            blocks.push((language, code));
        }
    }
    (blocks, prose)
}

/// Whether the lines stand in a text in this order, others between them.
fn assert_lines(text: &str, lines: &str) {
    let mut rest = text.lines();
    for line in lines.lines() {
        assert!(
            rest.any(|found| found.trim_end() == line.trim_end()),
            "`{line}` is not in\n{text}"
        );
    }
}

#[test]
fn the_cart_records_is_fitted_and_runs() {
    let folder = tempfile::tempdir().unwrap();
    let page = page();
    let description = page.split("<<'END'\n").nth(1).unwrap().split("\nEND").next().unwrap();
    let robot = Robot::parse(description, Path::new("robot.toml")).unwrap();
    let logs = |seed: u64| {
        let path = folder.path().join(format!("logs-{seed}"));
        cart::record(&path, seed).unwrap();
        Recording::open(&path).unwrap()
    };
    let (seen, unseen) = (logs(1), logs(2));
    let source = |recording| Logs { recording, schema: &robot.schema };
    let bytes = export(&edmd::fit(&robot, &source(&seen), &|_| ()).unwrap()).unwrap();

    let mut slot = Box::new(Aligned([0xff; 4096]));
    slot.0[..bytes.len()].copy_from_slice(&bytes);
    let parsed = &slot.0[..bytes.len()];
    let (model, test) = (firmware_core::parse(parsed).unwrap(), blob::self_test(parsed).unwrap());
    let trajectories = collect(&source(&unseen)).unwrap();
    let least = least_units(0.9).unwrap();
    let residuals = Residuals::measure(&model, &trajectories, 50, least).unwrap();
    let bounds = residuals.bounds(0.9).unwrap();
    let bytes = with_bounds(model, &test, 0.9, &residuals, &bounds, bytes.len()).unwrap();
    let (blob, log) = (folder.path().join("model.bin"), folder.path().join("run.csv"));
    std::fs::write(&blob, bytes).unwrap();

    let (all, _) = blocks(&page);
    let shown: Vec<&str> =
        all.iter().filter(|(language, _)| *language == "text").map(|(_, code)| *code).collect();
    let said = cart::run(&blob, &log, false).unwrap();
    assert!(shown.contains(&said.as_str()), "{said}");
    let said = cart::run(&blob, &folder.path().join("blocked.csv"), true).unwrap();
    assert!(shown.contains(&said.as_str()), "{said}");
    // Its frames are a log: one row less, as the last one's inputs are not known yet.
    let run = Recording::open(&log).unwrap();
    let [run] = &collect(&source(&run)).unwrap()[..] else { panic!() };
    assert_eq!((run.states.len(), run.inputs.len()), (1200, 1200));
}

#[test]
fn the_loop_on_the_page_is_that_of_the_example() {
    let page = page();
    let example = std::fs::read_to_string(root().join("firmware-sim/examples/cart.rs")).unwrap();
    let (all, _) = blocks(&page);
    for (_, code) in all.iter().filter(|(language, _)| *language == "rust") {
        let plain = |text: &str| text.lines().map(str::trim_start).collect::<Vec<_>>().join("\n");
        assert!(plain(&example).contains(plain(code).trim_end()), "{code}");
    }
}

#[test]
#[ignore = "builds trainer and example in release; run with --release --ignored"]
fn the_commands_of_the_page_print_what_it_shows() {
    let page = page();
    let (all, prose) = blocks(&page);
    let mut said = String::new();
    let mut everything = String::new();
    for (language, code) in &all {
        match *language {
            "sh" => {
                let output = Command::new("bash")
                    .args(["-e", "-u", "-o", "pipefail", "-c", code])
                    .current_dir(root())
                    .output()
                    .unwrap();
                let errors = String::from_utf8_lossy(&output.stderr);
                assert!(output.status.success(), "{code}\n{errors}");
                said = String::from_utf8(output.stdout).unwrap();
                everything += &said;
                everything += code;
            }
            "text" => assert_lines(&said, code),
            _ => {}
        }
    }
    // No number is typed in by hand, but for those of the headings.
    let numbers = prose.lines().filter(|line| !line.starts_with('#')).flat_map(|line| {
        line.split(|c: char| !(c.is_ascii_digit() || c == '.'))
            .map(|number| number.trim_matches('.'))
    });
    for number in numbers.filter(|number| !number.is_empty()) {
        assert!(everything.contains(number), "nothing prints {number}");
    }
}
