//! Runs on the simulated controller.

use firmware_core::blob::Aligned;
use firmware_core::control_loop::Alarms;
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_sim::fault::{Fault, FaultKind};
use firmware_sim::run::figure::Figure;
use firmware_sim::run::live::Live;
use firmware_sim::run::log::Logger;
use firmware_sim::run::scenario::{FaultText, Scenario};
use firmware_sim::run::summary::Summary;
use firmware_sim::run::sweep::{sweep, table};
use firmware_sim::run::{Robot, run};
use proptest::prelude::*;
use std::path::Path;

static ROSBOT: &Aligned<[u8]> = &Aligned(*include_bytes!(concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../models/skid-rosbot/model.bin"
)));
static SOFT_LEG: &Aligned<[u8]> =
    &Aligned(*include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/soft-leg/model.bin")));

fn models() -> [Model<'static>; 2] {
    [ROSBOT, SOFT_LEG].map(|blob| firmware_core::parse(&blob.0).unwrap())
}

/// Random driving of a model's robot.
fn driving(model: &Model<'_>, seconds: f64, faults: &[&str]) -> Scenario {
    let limit = Robot::of(model.structure()).unwrap().limit();
    let faults = faults.iter().map(|text| FaultText(text.parse().unwrap())).collect();
    Scenario { seconds, faults, ..Scenario::random(limit) }
}

fn quiet(model: &Model<'_>, scenario: &Scenario, seed: u64) -> Summary {
    run(model, scenario, seed, &mut |_| Ok(())).unwrap()
}

#[test]
fn without_faults_nothing_is_late_and_nothing_is_noticed() {
    for model in models() {
        let summary = quiet(&model, &driving(&model, 600.0, &[]), 5);
        assert_eq!((summary.deadline_misses, summary.false_alarms()), (0, 0), "{}", summary.text());
        assert_eq!(summary.worst_tick_us, summary.predicting_tick_us);
        assert_eq!(summary.time_s[2..], [0.0, 0.0]);
        assert!(summary.time_s[1] > 598.0 && summary.windows > 500);
        let [frames, lost, dropped, damaged] = summary.frames;
        assert!(frames > 0 && (lost, dropped, damaged) == (0, 0, 0));
        // The bounds are made for 99.9 %.
        assert!(summary.within.unwrap().iter().all(|share| *share > 0.99));
    }
}

#[test]
fn the_seed_decides_everything() {
    let faults = ["spike@5..10=0.5", "dropout@10..20=0.4", "late-tick@0..5=0.2"];
    for model in models() {
        let scenario = driving(&model, 60.0, &faults);
        let first = quiet(&model, &scenario, 1);
        assert_eq!(quiet(&model, &scenario, 1), first);
        assert_ne!(quiet(&model, &scenario, 2).horizons, first.horizons);
    }
}

/// As long as the robots, faults, loops and expectations stay what they are, so does every figure of this
/// table: `firmware-sim sweep MODEL --seeds 2` prints it anew.
#[test]
fn faults_end_as_expected() {
    for (model, snapshot) in
        models().iter().zip([include_str!("sweep-rosbot.txt"), include_str!("sweep-soft-leg.txt")])
    {
        let rows = sweep(model, 2, &mut |_, _| ()).unwrap();
        assert!(rows.iter().all(|row| row.holds()), "{}", table(&rows));
        assert_eq!(table(&rows), snapshot, "{}", model.structure().robot());
        // Every kind of fault is in one of the tables, and acts.
        let acted = rows.iter().all(|row| row.found.iter().all(|f| f.injected > 0));
        assert!(acted, "{}", table(&rows));
    }
    let kinds = [Robot::Rosbot, Robot::SoftLeg].map(firmware_sim::run::sweep::cases).concat();
    for (name, kind) in FaultKind::ALL {
        assert!(kinds.iter().any(|case| case.0 == kind), "{name}");
    }
}

/// A model of the ROSbot with 4,096 terms: the powers up to 7 of four inputs.
fn large(sample_time_s: f32) -> (Structure<'static>, Vec<f32>) {
    let state = |name, unit, space| State {
        name,
        unit,
        space,
        target: Target::Increment,
        limit: [f32::MIN, f32::MAX],
    };
    let input = |name| Input { name, unit: "rad/s", range: [-16.0, 16.0] };
    let inputs = [(0, 0), (1, 0), (0, 2), (1, 2)];
    let structure = Structure::try_from(ModelRepr {
        robot: "large",
        sample_time_s,
        states: [
            state("x", "m", Space::Line),
            state("y", "m", Space::Line),
            state("phi", "rad", Space::Circle),
        ]
        .into_iter()
        .collect(),
        inputs: [input("omega_r"), input("omega_l")].into_iter().collect(),
        symmetry: Symmetry::Se2 { x: 0, y: 1, heading: 2 },
        observables: inputs
            .map(|(i, lag)| Observable { source: Source::Input(i), lag, centre: 0.0, gain: 0.05 })
            .into_iter()
            .collect(),
        factors: (0..4)
            .map(|observable| Factor { observable, basis: Basis::Hermite, order: 7 })
            .collect(),
        blocks: [Block { factors: 4, max_degree: 0 }].into_iter().collect(),
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    });
    let structure = structure.unwrap();
    let coefficients = vec![0.0; structure.outputs() * 4096];
    (structure, coefficients)
}

#[test]
fn a_model_that_is_too_large_misses_where_its_cost_says() {
    let (structure, coefficients) = large(0.1);
    let model = Model::new(structure, &coefficients, None).unwrap();
    for (clock_mhz, seconds) in [(28.0, 5.0), (14.0, 5.0)] {
        let mut scenario = driving(&model, seconds, &[]);
        scenario.controller.clock_mhz = clock_mhz;
        let [predicts, plain] = Robot::Rosbot.instructions(&model, &scenario.controller);
        let us = |count: u64| count as f64 * scenario.controller.cycles_per_instruction / clock_mhz;
        let summary = quiet(&model, &scenario, 1);
        assert!(us(plain) < 300.0);
        let too_slow = us(predicts) > 10_000.0;
        assert_eq!(too_slow, clock_mhz < 20.0, "{} µs", us(predicts));
        // The first prediction is at the sample with which the history is full: two before it, of ten ticks.
        let expected = too_slow.then_some(20);
        assert_eq!(summary.first_miss, expected, "{}", summary.text());
        assert_eq!(summary.worst_tick_us, us(predicts).ceil() as u64);
        assert_eq!(summary.time_s[1] > 3.0, !too_slow, "a late loop does not keep running");
        assert_eq!(summary.driven_at_rest, 0);
    }
}

#[test]
fn every_scenario_runs() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
    let mut count = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let [rosbot, leg] = models();
        let model = if name.starts_with("rosbot-") { rosbot } else { leg };
        let mut scenario = Scenario::load(&path, 2).unwrap();
        scenario.seconds = scenario.seconds.min(60.0);
        let summary = quiet(&model, &scenario, 1);
        assert!(summary.holds() && summary.windows > 0, "{name}: {}", summary.text());
        count += 1;
    }
    assert!(count >= 7, "{count}");
}

#[test]
fn scenarios_that_make_no_sense_are_refused() {
    for (text, fragment) in [
        ("", "either `[[drive]]` or `[random]`"),
        ("drive = [{ for_s = 1, inputs = [1] }]", "number 1 has 1 inputs where the robot has 2"),
        ("drive = [{ for_s = 0, inputs = [1, 2] }]", "`for_s` must be above 0"),
        ("drive = [{ for_s = 1, inputs = [nan, 2] }]", "`inputs` must be finite"),
        ("seconds = -1\nrandom = { limit = 1, hold_s = [1, 2] }", "`seconds` must be above 0"),
        ("random = { limit = 1, hold_s = [2, 1] }", "`hold_s` must not end before it begins"),
        ("random = { limit = 1, zero_share = 2, hold_s = [1, 2] }", "`zero_share` must lie"),
        (
            "random = { limit = 1, hold_s = [1, 2] }\nfaults = [\"ice@0..1=1\"]",
            "unknown fault `ice`",
        ),
        ("random = { limit = 1, hold_s = [1, 2] }\nline = { loss = 1.5 }", "`loss` must lie"),
        ("random = { limit = 1, hold_s = [1, 2] }\nspeed = 3", "unknown field `speed`"),
        ("controller = { clock_mhz = 0 }\nrandom = { limit = 1, hold_s = [1, 2] }", "`clock_mhz`"),
    ] {
        let message = Scenario::parse(text, 2).unwrap_err().to_string();
        assert!(message.contains(fragment), "{text}: {message}");
    }
}

#[test]
fn models_of_other_robots_are_refused() {
    static ARM: &Aligned<[u8]> = &Aligned(*include_bytes!(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../models/two-link-arm/model.bin"
    )));
    let model = firmware_core::parse(&ARM.0).unwrap();
    let error = run(&model, &Scenario::random(1.0), 1, &mut |_| Ok(())).unwrap_err();
    assert!(error.to_string().contains("the model of `two-link-arm` predicts [theta1"), "{error}");
}

#[test]
fn a_model_with_another_sample_time_is_refused() {
    let (structure, coefficients) = large(0.2);
    let model = Model::new(structure, &coefficients, None).unwrap();
    let error = run(&model, &driving(&model, 1.0, &[]), 1, &mut |_| Ok(())).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the model's sample time is 0.2 s, the robot's loop has one of 0.1 s"
    );
}

#[test]
fn an_alarm_ends_soon_after_its_fault() {
    for (model, fault) in models().iter().zip(["slip:1@10..20=0.5", "leak:0@10..20=0.5"]) {
        let mut last_s = 0.0;
        let summary = run(model, &driving(model, 60.0, &[fault]), 1, &mut |seen| {
            if seen.frame.noticed.contains(Alarms::RESIDUAL) {
                last_s = seen.frame.time_us as f64 * 1e-6;
            }
            Ok(())
        });
        let summary = summary.unwrap();
        // The slow comparison is forgotten within ten of its samples, of one second or half of one.
        assert!((15.0..35.0).contains(&last_s), "{last_s} s: {}", summary.text());
        assert_eq!(summary.false_alarms(), 0, "{}", summary.text());
    }
}

#[test]
fn telemetry_is_a_log() {
    for model in models() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path().join("logs");
        let mut logger = Logger::new(&dir, model.structure(), Some(10), false).unwrap();
        let scenario = driving(&model, 62.0, &["dropout@30..31=1"]);
        let summary = run(&model, &scenario, 1, &mut |seen| logger.frame(seen.frame)).unwrap();
        logger.finish().unwrap();
        assert!(summary.time_s[1] > 50.0, "{}", summary.text());
        let mut rows = 0;
        for episode in 0..logger.episodes() {
            let text = std::fs::read_to_string(dir.join(format!("episode-{episode:03}.csv")));
            let text = text.unwrap();
            let mut lines = text.lines();
            assert!(lines.next().unwrap().starts_with("time_s,"));
            let own = lines.clone().count();
            assert!(lines.next().unwrap().starts_with("0,"), "every log begins at 0");
            assert!(own as f64 * f64::from(model.structure().sample_time_s()) <= 10.0 + 1e-3);
            rows += own;
        }
        let expected = summary.time_s[1] / f64::from(model.structure().sample_time_s());
        assert!((rows as f64) > 0.9 * expected, "{rows} rows of {expected}");
        // Nothing is lost without being asked.
        let message = Logger::new(&dir, model.structure(), None, false).unwrap_err().to_string();
        assert!(message.contains("--overwrite"), "{message}");
        std::fs::write(dir.join("notes.txt"), "mine").unwrap();
        let message = Logger::new(&dir, model.structure(), None, true).unwrap_err().to_string();
        assert!(message.contains("holds") && dir.join("episode-000.csv").exists(), "{message}");
    }
}

#[test]
fn pictures_show_what_they_should() {
    for model in models() {
        // One of three seconds, one that does not come, one that does not end.
        let faults = ["spike@5..8=1", "slip@30..40=1", "slip@15..inf=1"];
        let faults = faults.map(|text| text.parse().unwrap()).to_vec();
        let mut figure = Figure::new("a run".to_owned(), &model, 10, faults);
        let (mut live, mut last) = (Live::new(), String::new());
        let states = model.structure().states();
        let names: Vec<(String, String)> =
            states.iter().map(|s| (s.name.to_owned(), s.unit.to_owned())).collect();
        let scenario = driving(&model, 20.0, &["spike@5..8=1"]);
        run(&model, &scenario, 1, &mut |seen| {
            figure.sample(seen.frame);
            last = live.picture(seen, &names);
            Ok(())
        })
        .unwrap();
        let svg = figure.svg().unwrap();
        assert!(svg.contains("a run") && svg.contains("time [s]") && svg.contains("error bound"));
        for (name, unit) in &names {
            assert!(svg.contains(&format!("{name} off [{unit}]")), "{name}");
        }
        assert!(!svg.contains("NaN"));
        // The two that act have a rectangle each in the panels, and there is one in the legend.
        let left = |text: &str| text.split('"').next().unwrap().parse::<f64>().unwrap();
        let rectangles = svg.split("<rect x=\"").map(|text| &text[..text.find('>').unwrap()]);
        let faults: Vec<f64> =
            rectangles.filter(|text| text.contains("#FFE0B2")).map(left).collect();
        assert_eq!(faults.len(), 2 * names.len() + 1, "{faults:?}");
        let in_order = |pair: &[f64]| pair[0] < pair[1];
        assert!(faults[..2 * names.len()].chunks(2).all(in_order), "{faults:?}");
        // The legend has all marks; the picture must have them, too.
        let picture: String = last.lines().filter(|line| line.starts_with('│')).collect();
        assert!(['·', '+', 'o'].iter().all(|mark| picture.contains(*mark)), "{last}");
        assert!(last.contains("Running"), "{last}");
    }
}

#[test]
fn a_noisy_line_costs_frames_and_nothing_else() {
    for model in models() {
        let mut scenario = driving(&model, 120.0, &[]);
        scenario.line.loss = 1e-3;
        scenario.line.bit_flip = 1e-3;
        let summary = quiet(&model, &scenario, 3);
        let [frames, lost, _, damaged] = summary.frames;
        assert!(damaged > 0 && lost > 0 && frames > 500, "{}", summary.text());
        assert_eq!(
            (summary.time_s[2], summary.driven_at_rest, summary.false_alarms()),
            (0.0, 0, 0)
        );
    }
}

fn fault() -> impl Strategy<Value = Fault> {
    let unit = prop::option::of(0..2_usize);
    (0..FaultKind::ALL.len(), unit, 0.0..8.0, 0.1..8.0, 0.01..=1.0).prop_map(
        |(kind, unit, from, lasts, intensity)| {
            Fault::new(FaultKind::ALL[kind].1, unit, from, from + lasts, intensity).unwrap()
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn whatever_goes_wrong_at_once_nothing_is_driven_at_rest(
        faults in prop::collection::vec(fault(), 0..6), seed in any::<u64>(), restart in any::<bool>(),
        loss in 0.0..0.05,
    ) {
        for model in models() {
            let mut scenario = driving(&model, 10.0, &[]);
            let robot = Robot::of(model.structure()).unwrap();
            let felt = faults.iter().copied().filter(|fault| robot.feels(fault));
            scenario.faults = felt.map(FaultText).collect();
            scenario.restart = restart;
            scenario.line.loss = loss;
            let summary = quiet(&model, &scenario, seed);
            prop_assert_eq!(summary.driven_at_rest, 0);
            // Only a tick that begins late may end late.
            let late = faults.iter().any(|fault| fault.kind() == FaultKind::LateTick);
            prop_assert!(late || summary.deadline_misses == 0, "{}", summary.text());
        }
    }
}
