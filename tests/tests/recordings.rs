//! Recordings of real robots. They are not part of the project: KOOPMAN_RECORDINGS names the folder
//! that holds them, one subfolder per robot, as the descriptions in models/ call them; without it
//! the tests say so and pass.

use std::path::{Path, PathBuf};

use trainer::edmd;
use trainer::recording::Recording;
use trainer::robot::Robot;
use trainer::score::{self, Counts, Lifted, Score};
use trainer::trajectory::Logs;

fn recordings(test: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("KOOPMAN_RECORDINGS").map(PathBuf::from);
    if folder.is_none() {
        println!("skipped: {test} needs recordings; name their folder in KOOPMAN_RECORDINGS");
    }
    folder
}

fn description(robot: &str) -> String {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").join(robot).join("robot.toml");
    std::fs::read_to_string(path).unwrap()
}

fn scored(description: &str, logs: &Path) -> Score {
    let robot = Robot::parse(description, Path::new("robot.toml")).unwrap();
    let recording = Recording::open(logs).unwrap();
    let source = Logs { recording: &recording, schema: &robot.schema };
    let fit = edmd::fit(&robot, &source, &|_| ()).unwrap();
    let counts = Counts { trajectories: fit.summary.trajectories, rows: fit.summary.rows };
    let lifted = Lifted::Fitted(&fit.structure, None, &robot.fit);
    score::score(&source, counts, lifted, &robot.score, None, &|_| ()).unwrap()
}

/// Independent figures: NRMSE of no motion and of the ARX with 0 to 5 lags on a fixed split, given
/// to four decimals.
// One of the figures happens to look like √2.
#[allow(clippy::approx_constant)]
const ARX: [(&str, &str, f64, [f64; 6]); 4] = [
    (
        "diffdrive-mrclam",
        r#""d6-robot3-*""#,
        0.0830,
        [0.0764, 0.0707, 0.0557, 0.0380, 0.0295, 0.0249],
    ),
    (
        "car-f1tenth",
        r#""run?0", "run?5""#,
        0.7058,
        [0.1293, 0.1240, 0.1002, 0.0961, 0.0886, 0.0813],
    ),
    (
        "double-pendulum-dfki",
        r#""run-143747", "run-154548""#,
        1.0252,
        [0.8561, 0.9699, 0.9577, 0.8891, 0.8634, 0.8706],
    ),
    ("soft-arm-eth", r#""step-200mbar""#, 0.5942, [1.3863, 1.4142, 1.1234, 1.1025, 1.1091, 1.1138]),
];

/// The independent figures are rounded to four decimals, the smallest of them to 2e-3 of itself.
const FIGURE_TOLERANCE: f64 = 5e-3;

#[test]
fn the_arx_scores_as_an_independent_one() {
    let Some(folder) = recordings("the_arx_scores_as_an_independent_one") else { return };
    for (robot, hold_out, no_motion, arx) in ARX {
        let mut text = description(robot);
        let folds = text.find("folds = ").unwrap();
        let end = text[folds..].find('\n').unwrap() + folds;
        text.replace_range(folds..end, &format!("hold_out = [{hold_out}]"));
        if robot == "double-pendulum-dfki" {
            // The independent figures compare the angles of this robot without wrapping them.
            text = text.replace("\"S1\"", "\"R\"").replace("sin(theta1)", "theta1");
            text = text.replace("sin(theta2)", "theta2").replace("cos(theta2)", "d(theta2)@1");
        }
        let score = scored(&text, &folder.join(robot));
        println!("{robot}: no motion {:.5}, ARX {:.5?}", score.contenders[1].nrmse, score.arx);
        for (found, expected) in score.arx.iter().zip(arx) {
            assert!(
                (found / expected - 1.0).abs() < FIGURE_TOLERANCE,
                "{robot}: {found} {expected}"
            );
        }
        let found = score.contenders[1].nrmse;
        assert!((found / no_motion - 1.0).abs() < FIGURE_TOLERANCE, "{robot}: {found} {no_motion}");
    }
}

#[test]
fn the_examples_beat_no_motion_and_the_arx() {
    let Some(folder) = recordings("the_examples_beat_no_motion_and_the_arx") else { return };
    for (robot, ..) in ARX {
        let score = scored(&description(robot), &folder.join(robot));
        let nrmse: Vec<f64> = score.contenders.iter().map(|c| c.nrmse).collect();
        println!("{robot}: model, no motion, ARX: {nrmse:.4?}");
        assert_eq!(score.contenders[0].diverged, 0, "{robot}");
        assert!(nrmse[0] < nrmse[1] && nrmse[0] < nrmse[2], "{robot}: {nrmse:?}");
    }
}
