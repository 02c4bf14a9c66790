//! The spectrum of the paper's dictionary on the simulated drive.

use std::path::Path;

use firmware_sim::drive::{Drive, DriveParameters};
use firmware_sim::integrate::Numerical;
use firmware_sim::{Integrator, Plant};
use trainer::full_operator::FullOperator;
use trainer::robot::Robot;
use trainer::trajectory::{InMemory, Trajectory};

/// What a reconstruction by eigenvalues, eigenfunctions and modes has to hold.
const RECONSTRUCTED: f64 = 1e-9;
/// A step of the drive with Euler's method turns by r (u1 − u2) T / track, and the dictionary of
/// order 1 in u has their sine and cosine only to first order: what turns of up to 0.16 rad leave.
const TURN: f64 = 2e-3;

const DRIVE: &str = r#"
    name = "drive"
    sample_time_s = 0.1
    states = [
        { name = "x", space = "R", unit = "m" },
        { name = "y", space = "R", unit = "m" },
        { name = "phi", space = "S1", unit = "rad" },
    ]
    inputs = [
        { name = "u1", unit = "rad/s", range = [-10, 10] },
        { name = "u2", unit = "rad/s", range = [-10, 10] },
    ]
"#;

/// The paper's drive under random wheel speeds, uniform in ±`speed`, held for five steps.
fn trajectories(speed: f64) -> Vec<Trajectory> {
    let mut seed = 7_u64;
    let mut noise = || {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        speed * ((seed >> 11) as f64 / (1_u64 << 52) as f64 - 1.0)
    };
    let parameters = DriveParameters { wheel_radius_m: 0.062, track_m: 0.228 };
    let mut drive = Drive::new(parameters, Integrator::Numerical(Numerical::EULER)).unwrap();
    let mut one = |_| {
        drive.reset();
        let (mut trajectory, mut u) = (Trajectory::default(), [0.0; 2]);
        for k in 0..200 {
            if k % 5 == 0 {
                u = [noise(), noise()];
            }
            trajectory.states.extend(drive.observe());
            trajectory.inputs.extend(u);
            drive.step(&u, 0.1);
        }
        trajectory
    };
    (0..10).map(&mut one).collect()
}

#[test]
fn the_papers_dictionary_on_a_drive() {
    let mut robot = Robot::parse(DRIVE, Path::new("robot.toml")).unwrap();
    let trajectories = trajectories(3.0);
    let data = InMemory { trajectories: &trajectories, states: 3, inputs: 2 };
    for standardise in [false, true] {
        robot.standardise = standardise;
        let full = FullOperator::fit(&robot, &data, &|_| ()).unwrap();
        assert_eq!((full.operator.terms, full.terms()), (64, 16));
        let columns: Vec<&str> = full.columns.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(columns, ["x", "y", "sin(phi)", "cos(phi)"]);
        for input in [[0.0, 0.0], [2.0, -1.0], [-3.0, 3.0], [1.5, 1.5]] {
            let spectrum = full.spectrum(&input).unwrap();
            let residual = spectrum.reconstruction_residual(&full.b);
            let (right, left) = spectrum.eigenvector_residuals();
            println!(
                "standardised {standardise}, {input:?}: condition {:.1e}, eigenvectors {right:.1e} \
                 {left:.1e}, reconstruction {residual:.1e}, defects {:?}",
                spectrum.condition(),
                spectrum.defects()
            );
            assert!(residual <= RECONSTRUCTED, "{residual:e}");
            assert!(spectrum.defects().is_empty() && right <= 1e-11 && left <= 1e-11);
            // The whole operator, not only the coordinates' columns.
            let k = full.held(&input).unwrap();
            let trace: f64 = (0..16).map(|i| k[17 * i]).sum();
            let sum =
                spectrum.eigenvalues().iter().fold((0.0, 0.0), |(a, b), z| (a + z.0, b + z.1));
            assert!((sum.0 - trace).abs() < 1e-9 && sum.1 == 0.0);
        }
        // Turning on the spot: the heading is a rotation of the known frequency.
        let turn: f64 = 0.062 / 0.228 * 0.1 * 3.0;
        let spectrum = full.spectrum(&[1.5, -1.5]).unwrap();
        let near = |z: &&(f64, f64)| {
            (z.0 - turn.cos()).abs() < TURN && (z.1.abs() - turn.sin()).abs() < TURN
        };
        assert!(
            spectrum.eigenvalues().iter().filter(near).count() >= 2,
            "{:?}",
            spectrum.eigenvalues()
        );
    }
}
