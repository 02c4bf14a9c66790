//! Do the error bounds hold as often as they say? The blobs of the simulated robots are calibrated on
//! 1,000 trajectories that they have not seen and asked on 1,000 others, one window each, all of one
//! distribution: every trial starts where a new plant does, with its own inputs and noise, and every
//! window at the same row.
//!
//! The bounds are exact order statistics, so that the number of test trajectories within a bound is
//! beta-binomial whatever the robot: mean 901/1001, standard deviation 1.3 %. By chance alone, one cell of
//! state and step in forty is outside 87 % to 93 %, and a robot has 100 to 200 cells: in most pairs of
//! recordings some cell is. The test below shows that no more happens than that. Bounds known
//! without error would still have a cell outside in 5 % to 15 % of the recordings, as 1,000 test
//! trajectories are few. Smoothing bounds over neighbouring steps helps the ROSbot, whose errors are
//! mostly independent from step to step, and not the arm; the leg, whose errors jump with its held
//! inputs, is then covered at 84 % to 92 %; and the guarantee would be gone. It is not done.

use std::path::Path;

use firmware_core::blob::{self, Aligned};
use firmware_core::model::Model;
use firmware_core::parse;
use firmware_sim::record::{Recording, Settings};
use trainer::conformal::{CoverageReport, Residuals, Unit, chance, least_units, with_bounds};
use trainer::trajectory::Trajectory;

const ROBOTS: [&str; 3] = ["rosbot", "two-link-arm", "soft-leg"];
const NOMINAL: f64 = 0.9;
const TRAJECTORIES: u32 = 1000;
const HORIZON: usize = 50;
/// Rows of a window: five before the present one, for every model of a table, and the horizon.
const ROWS: usize = 5 + 1 + HORIZON;
/// More bytes than any blob here.
const ROOM: usize = 1 << 14;
/// A cell is to be covered this often.
const BAR: [f64; 2] = [0.87, 0.93];

/// A blob at an address that the core accepts.
struct Blob {
    room: Box<Aligned<[u8; ROOM]>>,
    length: usize,
}

impl Blob {
    fn new(bytes: &[u8]) -> Self {
        let mut room = Box::new(Aligned([0xff; ROOM]));
        room.0[..bytes.len()].copy_from_slice(bytes);
        Self { room, length: bytes.len() }
    }

    fn of(name: &str) -> Self {
        let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
        Self::new(&std::fs::read(models.join(name).join("model.bin")).unwrap())
    }

    fn bytes(&self) -> &[u8] {
        &self.room.0[..self.length]
    }

    fn model(&self) -> Model<'_> {
        parse(self.bytes()).unwrap()
    }
}

/// The absolute errors of a robot's blob on the trajectories of a seed.
fn residuals(name: &str, blob: &Blob, seed: u64) -> Residuals {
    let model = blob.model();
    let (states, inputs) = (model.structure().states().len(), model.structure().inputs().len());
    let robot: firmware_sim::record::Robot = name.parse().unwrap();
    let seconds = (ROWS - 1) as f64 / f64::from(robot.rate_hz());
    let (trials, noise) = (TRAJECTORIES, 1.0);
    let settings = Settings { robot, trials, seconds, seed, noise, integrator: None, digits: None };
    let recording = Recording::new(settings).unwrap();
    let trajectory = |trial| {
        let mut csv = Vec::new();
        recording.write_trial(trial, &mut csv).unwrap();
        let mut trajectory = Trajectory::default();
        for line in String::from_utf8(csv).unwrap().lines().skip(1) {
            let row: Vec<f64> = line.split(',').skip(1).map(|x| x.parse().unwrap()).collect();
            assert_eq!(row.len(), states + inputs);
            trajectory.states.extend(&row[..states]);
            trajectory.inputs.extend(&row[states..]);
        }
        assert_eq!(trajectory.states.len(), ROWS * states);
        trajectory
    };
    let trajectories: Vec<Trajectory> = (0..trials).map(trajectory).collect();
    let least = least_units(NOMINAL).unwrap();
    let residuals = Residuals::measure(&model, &trajectories, HORIZON, least).unwrap();
    assert_eq!((residuals.unit, residuals.units()), (Unit::Trajectory, trials as usize));
    residuals
}

/// The coverage of every cell on `test` by bounds from `calibration`, by way of a blob.
fn coverage(blob: &Blob, calibration: &Residuals, test: &Residuals) -> (Vec<f64>, String) {
    let self_test = blob::self_test(blob.bytes()).unwrap();
    let bounds = calibration.bounds(NOMINAL).unwrap();
    let bytes = with_bounds(blob.model(), &self_test, NOMINAL, calibration, &bounds, blob.length);
    let calibrated = Blob::new(&bytes.unwrap());
    let model = calibrated.model();
    let names: Vec<&str> = model.structure().states().iter().map(|s| s.name).collect();
    let bounds = model.error_bounds().unwrap();
    let cells = test.coverage(bounds).into_iter().map(Option::unwrap).collect();
    (cells, CoverageReport::new(test, bounds, &names).unwrap().text())
}

fn is_outside(share: &f64) -> bool {
    !(BAR[0]..=BAR[1]).contains(share)
}

/// Seeds of the recordings, each of which calibrates the next.
const MANY: std::ops::Range<u64> = 100..121;
/// Means over some hundred cells, which move together, and twenty pairs: a third of a percent is what
/// twenty pairs leave of 1.3 % if all cells move as one.
const MEAN_TOLERANCE: f64 = 0.004;
/// Cells outside the bar, as a multiple of what chance alone puts there: cells move together, and
/// the few recordings make few independent draws.
const SHARE_TOLERANCE: f64 = 2.0;

#[test]
#[ignore = "63,000 trajectories; run with --release --ignored"]
fn a_cell_is_outside_as_often_as_chance_alone_puts_it_there() {
    let units = TRAJECTORIES as usize;
    let masses = chance(units, units, NOMINAL).unwrap();
    let expected: f64 = masses.iter().zip(0..).map(|(p, k)| p * f64::from(k)).sum();
    let expected = expected / f64::from(TRAJECTORIES);
    let by_chance: f64 = masses
        .iter()
        .zip(0..)
        .filter(|(_, k)| is_outside(&(f64::from(*k) / f64::from(TRAJECTORIES))))
        .map(|(p, _)| p)
        .sum();
    println!("by chance alone, {:.2} % of the cells are outside", 100.0 * by_chance);
    println!(
        "robot          pairs with a cell outside 87 % to 93 %   cells outside   least    most    mean"
    );
    for name in ROBOTS {
        let blob = Blob::of(name);
        let all: Vec<Residuals> = MANY.map(|seed| residuals(name, &blob, seed)).collect();
        let (mut pairs, mut cells, mut holds) = (0, Vec::new(), None);
        for (seed, pair) in MANY.zip(all.windows(2)) {
            let (shares, text) = coverage(&blob, &pair[0], &pair[1]);
            match shares.iter().any(is_outside) {
                true => pairs += 1,
                false if holds.is_none() => holds = Some((seed, text)),
                false => {}
            }
            cells.extend(shares);
        }
        let outside = cells.iter().filter(|c| is_outside(c)).count() as f64 / cells.len() as f64;
        let mean = cells.iter().sum::<f64>() / cells.len() as f64;
        let least = cells.iter().copied().fold(1.0, f64::min);
        let most = cells.iter().copied().fold(0.0, f64::max);
        println!(
            "{name:14} {pairs:2} of {:2} {:30}{:12.1} %{:7.1} %{:6.1} %{:6.2} %",
            all.len() - 1,
            "",
            100.0 * outside,
            100.0 * least,
            100.0 * most,
            100.0 * mean
        );
        // What a user sees when every cell holds: the first such pair, no evidence beyond the above.
        let (seed, text) = holds.unwrap_or_else(|| panic!("{name}: no pair holds in every cell"));
        println!("calibrated on seed {seed}, asked on seed {}:\n{text}", seed + 1);
        assert!((mean - expected).abs() < MEAN_TOLERANCE, "{name}: {mean} for {expected}");
        assert!(outside < SHARE_TOLERANCE * by_chance, "{name}: {outside}");
    }
}
