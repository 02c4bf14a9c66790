//! How well the arm of the paper (RK4, trained on torques N(0, 1)) can be predicted: rolled out over 50
//! steps of the paper's quadrant test, mean squared error over all steps of θ1 and θ2.

use std::path::Path;

use firmware_sim::paper::PaperLogs;
use trainer::edmd;
use trainer::recording::Recording;
use trainer::robot::Robot;
use trainer::rollout::TestReport;
use trainer::trajectory::{Logs, collect};

const HORIZON: usize = 50;

#[test]
fn what_select_found_for_the_arm_holds_on_the_quadrant() {
    let folder = tempfile::tempdir().unwrap();
    PaperLogs::new(1).write(folder.path(), true).unwrap();
    let arm = folder.path().join("arm-rk4");
    let paper = |file: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../trainer/paper").join(file);
        std::fs::read_to_string(path).unwrap()
    };
    let order_2 = paper("arm-velocities.toml")
        .replace("order = 1", "order = 1\norders = { dtheta1 = 2, dtheta2 = 2 }");
    for (description, text, bars) in [
        ("found by select", paper("arm-selected.toml"), [2e-6, 6e-6]),
        ("the paper's, velocities at order 2", order_2, [2.5e-4, 6e-4]),
    ] {
        let robot = Robot::parse(&text, Path::new("robot.toml")).unwrap();
        let [training, test] =
            ["train", "quadrant"].map(|set| Recording::open(&arm.join(set)).unwrap());
        let source = Logs { recording: &training, schema: &robot.schema };
        let fitted = edmd::fit(&robot, &source, &|_| {}).unwrap();
        let test = collect(&Logs { recording: &test, schema: &robot.schema }).unwrap();
        let report = TestReport::measure(&fitted, &test, HORIZON).unwrap();
        println!("{description}: {}", report.text());
        for errors in report.contenders.iter().filter(|c| c.name != "no motion") {
            assert_eq!(errors.diverged_windows, 0);
            for (mse, bar) in errors.mse.iter().zip(bars) {
                assert!(*mse <= bar, "{description}, {}: {:?}", errors.name, errors.mse);
            }
        }
    }
}
