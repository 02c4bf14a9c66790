//! The control loops on their benches: the ROSbot drives as its plant does with its own controllers, and
//! what the loops predict is, to the last bit, what `trainer evaluate` predicts on the log of their frames.

use std::f64::consts::TAU;
use std::fmt::Write;
use std::path::Path;

use firmware_core::blob::Aligned;
use firmware_core::control_loop::rosbot::{Motor, RosbotSettings, Sides};
use firmware_core::control_loop::soft_leg::{Chamber, Pneumatics, SoftLegSettings};
use firmware_core::control_loop::telemetry::Queue;
use firmware_core::control_loop::{Command, ControlLoop, Frame, Mode, Rosbot, SoftLeg, Telemetry};
use firmware_core::device::{MonotonicClock, PositionSensor};
use firmware_core::error_bounds::ErrorBounds;
use firmware_core::model::Space;
use firmware_core::{Model, Scalar, parse};
use firmware_sim::bench::{RosbotBench, SoftLegBench};
use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
use firmware_sim::skid_steer::SkidSteer;
use firmware_sim::{Plant, rosbot};
use trainer::recording::Recording;
use trainer::robot::{Robot, ScoreOptions};
use trainer::score;
use trainer::trajectory::Logs;

const LEG_US: u64 = 2_000;
const ROSBOT_US: u64 = 10_000;

fn folder(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").join(name)
}

/// A model that comes with the project, with these bounds of 1 and of 9 steps, or with those that it has.
fn model(name: &str, bounds: Option<&'static [f32]>) -> Model<'static> {
    const ROOM: usize = 1 << 14;
    let bytes = std::fs::read(folder(name).join("model.bin")).unwrap();
    let slot: &'static mut Aligned<[u8; ROOM]> = Box::leak(Box::new(Aligned([0xff; ROOM])));
    slot.0[..bytes.len()].copy_from_slice(&bytes);
    let model = parse(&slot.0[..bytes.len()]).unwrap();
    let Some(bounds) = bounds else { return model };
    let n = model.structure().states().len();
    let horizons: &'static [u32] = &[1, 9];
    model.with_error_bounds(ErrorBounds::new(n, 0.999, 2000, horizons, bounds).unwrap()).unwrap()
}

/// Uniform in ±1, without a generator's crate.
fn uniform(seed: &mut u64) -> f64 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    2.0 * (*seed >> 11) as f64 / (1_u64 << 53) as f64 - 1.0
}

/// A sensor with gaps of 1 to 8 samples, one in forty, and now and then a first coordinate that is off by
/// the spike.
struct Gappy<S> {
    sensor: S,
    gaps: bool,
    spike: f32,
    samples: usize,
}

impl<const N: usize, S: PositionSensor<N>> PositionSensor<N> for Gappy<S> {
    type Error = S::Error;

    fn measure(&mut self) -> Result<Option<[f32; N]>, S::Error> {
        self.samples += 1;
        let (period, phase) = (self.samples / 40, self.samples % 40);
        let mut measured = self.sensor.measure()?;
        if phase == 0 && period % 3 == 0 {
            measured.iter_mut().flat_map(|x| x.iter_mut().take(1)).for_each(|x| *x += self.spike);
        }
        Ok(measured.filter(|_| !(self.gaps && (20..21 + period % 8).contains(&phase))))
    }
}

/// A ROSbot on its bench under random wheel speeds that change twice a second; every tick calls `each`
/// with what is commanded. Its frames.
fn drive(
    model: &Model<'static>,
    (gaps, spike): (bool, f32),
    seconds: u64,
    mut seed: u64,
    mut each: impl FnMut(&RosbotBench, [f32; 2]),
) -> Vec<Frame> {
    let mut bench = RosbotBench::new(Default::default()).unwrap();
    let devices = bench.devices(MotionCaptureSettings::POSE, 7).unwrap();
    let ([right, left], [right_back, left_back]) = (devices.pwm, devices.direction);
    let sides = Sides { right: Motor::new(right, right_back), left: Motor::new(left, left_back) };
    let [right, left] = devices.encoders;
    let sensor = Gappy { sensor: devices.pose, gaps, spike, samples: 0 };
    let mut queue = Queue::<4>::new();
    let (producer, mut consumer) = queue.split();
    let (devices, telemetry) = ((sides, (right, left), sensor), Telemetry::new(producer));
    let settings = RosbotSettings::default();
    let mut robot = Rosbot::<_, _, _, 5>::new(model, devices, settings, telemetry).unwrap();
    let (mut frames, mut wanted) = (Vec::new(), [0.0_f32; 2]);
    for tick in 0..=seconds * 1_000_000 / ROSBOT_US {
        if tick == 1 {
            robot.command(Command::Start);
        }
        if tick % 50 == 1 {
            // Eighths are the same in f32 and f64.
            wanted = [(); 2].map(|()| ((uniform(&mut seed) * 128.0).round() / 8.0) as f32);
            robot.command(Command::Inputs(wanted));
        }
        let mode = robot.tick(bench.clock().now_us());
        robot.finish(bench.clock().now_us());
        assert_eq!(mode, if tick == 0 { Mode::Idle } else { Mode::Running }, "{}", robot.alarms());
        bench.advance_us(ROSBOT_US);
        each(&bench, wanted);
        frames.extend(consumer.dequeue());
    }
    assert_eq!(bench.board().misuse(), None);
    frames
}

/// A leg on its bench under random voltages that change every half second; its frames.
fn bend(model: &Model<'static>, (gaps, spike): (bool, f32), seconds: u64) -> Vec<Frame> {
    let mut bench = SoftLegBench::new(Default::default()).unwrap();
    let devices = bench.devices(MotionCaptureSettings::TIP, 7).unwrap();
    let ([valve, other_valve], [line, other_line]) = (devices.valves, devices.lines);
    let [input_pump, exhaust_pump] = devices.pumps;
    let actuators = Pneumatics {
        bending: Chamber::new(valve, line),
        extension: Chamber::new(other_valve, other_line),
        input_pump,
        exhaust_pump,
    };
    let sensor = Gappy { sensor: devices.tip, gaps, spike, samples: 0 };
    let mut queue = Queue::<4>::new();
    let (producer, mut consumer) = queue.split();
    let (settings, telemetry) = (SoftLegSettings::default(), Telemetry::new(producer));
    let mut robot = SoftLeg::<_, _, 5>::new(model, actuators, sensor, settings, telemetry).unwrap();
    let (mut frames, mut seed) = (Vec::new(), 1);
    for tick in 0..=seconds * 1_000_000 / LEG_US {
        if tick == 1 {
            robot.command(Command::Start);
        }
        if tick % 250 == 1 {
            robot.command(Command::Inputs([(); 2].map(|()| (uniform(&mut seed) * 12.0) as f32)));
        }
        let mode = robot.tick(bench.clock().now_us());
        robot.finish(bench.clock().now_us());
        assert_eq!(mode, if tick == 0 { Mode::Idle } else { Mode::Running }, "{}", robot.alarms());
        bench.advance_us(LEG_US);
        frames.extend(consumer.dequeue());
    }
    assert_eq!(bench.board().misuse(), None);
    frames
}

/// The plant under the law of its own controllers in f64, with the duties that the timer has.
struct Reference {
    plant: SkidSteer,
    counts: [f64; 2],
    integral: [f64; 2],
}

impl Reference {
    fn step(&mut self, wanted: [f32; 2]) {
        let volts = [0, 1].map(|side| {
            let turns = self.plant.motion().wheels[side].angle_rad / TAU;
            let counts = (turns * 1632.0).round();
            let speed = TAU * (counts - self.counts[side]) / 1632.0 / 0.01;
            self.counts[side] = counts;
            let error = f64::from(wanted[side]) - speed;
            let asked = 0.7 * error + self.integral[side];
            let volt = asked.clamp(-12.0, 12.0);
            if volt == asked || error * asked <= 0.0 {
                self.integral[side] += 9.0 * error * 0.01;
            }
            (volt.abs() / 12.0 * 4666.0).round() / 4666.0 * 12.0 * volt.signum()
        });
        self.plant.step(volts, [0.0; 2], 0.01);
    }
}

/// Speed controllers see whole counts, of 0.24 mm or, on one side, 1 mrad of heading. A voltage that is
/// off in its last digit (the loop computes in f32 and sets duties of 2.6 mV) makes a count fall on the
/// other side, and a wheel that is about to break loose do so a tick later: now and then runs part by
/// centimetres, as the plant does from itself when it is commanded 0.01 % more. Hence the median of many
/// runs; that the law itself is the same is in `control_loops`.
#[test]
fn a_rosbot_drives_as_its_plant_with_its_own_controllers() {
    const SEEDS: u64 = 20;
    let mut all = [[0; 3]; 3].map(|row: [i32; 3]| row.map(|_| Vec::new()));
    for seed in 1..=SEEDS {
        let mut alone = rosbot::Rosbot::new(Default::default()).unwrap();
        let mut twin = alone.clone();
        let plant = SkidSteer::new(Default::default()).unwrap();
        let mut reference = Reference { plant, counts: [0.0; 2], integral: [0.0; 2] };
        let mut worst = [[0.0_f64; 3]; 3];
        drive(&model("skid-rosbot", None), (false, 0.0), 20, seed, |bench, wanted| {
            let exact = wanted.map(f64::from);
            alone.step(&exact, 0.01);
            twin.step(&exact.map(|u| u * (1.0 + 1e-4)), 0.01);
            reference.step(wanted);
            let (loops, alone) = (bench.motion().pose, alone.observe());
            let pairs =
                [(loops, reference.plant.motion().pose), (loops, alone), (twin.observe(), alone)];
            for (worst, (a, b)) in worst.iter_mut().zip(pairs) {
                *worst = [0, 1, 2].map(|i| worst[i].max((a[i] - b[i]).abs()));
            }
        });
        for (all, worst) in all.iter_mut().zip(worst) {
            all.iter_mut().zip(worst).for_each(|(all, worst)| all.push(worst));
        }
    }
    println!(
        "largest difference of x, y (mm), phi (mrad) over 20 s, median and most of {SEEDS} runs:"
    );
    let names = ["loop and the law with its duties", "loop and plant", "plant and plant + 0.01 %"];
    let [law, plant, _] = [0, 1, 2].map(|pair| {
        let mut median_and_most = [[0.0; 3]; 2];
        for (i, worst) in all[pair].iter_mut().enumerate() {
            worst.sort_by(f64::total_cmp);
            median_and_most[0][i] = 1e3 * worst[worst.len() / 2];
            median_and_most[1][i] = 1e3 * worst[worst.len() - 1];
        }
        println!("{}: {median_and_most:.4?}", names[pair]);
        median_and_most
    });
    assert!(law[0].iter().all(|worst| *worst < 1.0), "{law:?}");
    assert!(plant[0].iter().all(|worst| *worst < 1.0), "{plant:?}");
}

/// Steps of a window of the trainer, one more than any gap.
const HORIZON: usize = 10;

/// Compares what frames say was predicted with what the trainer predicts on their log; the number of
/// frames compared by how many steps they were predicted over.
fn compare(name: &str, model: &Model<'static>, frames: &[Frame]) -> [usize; HORIZON + 1] {
    let robot = Robot::load(&folder(name)).unwrap();
    let names = |all: Vec<&str>| all.iter().map(|name| format!(",{name}")).collect::<String>();
    let mut log = String::from("time_s");
    log += &names(robot.states.iter().map(|state| state.name.as_str()).collect());
    log += &names(robot.inputs.iter().map(|input| input.name.as_str()).collect());
    for (row, frame) in frames.iter().enumerate() {
        assert_eq!(frame.sequence as usize, row);
        write!(log, "\n{}", frame.time_us as f64 * 1e-6).unwrap();
        // The trainer wants a number where nothing was measured; no window that begins there, or looks
        // back at it, is compared.
        let (measured, missing) = (&frame.measured, vec![0.0; robot.states.len()]);
        let shown = [measured, &frame.predicted, missing.as_slice()];
        let states = shown.into_iter().find(|x| !x.is_empty()).unwrap().iter();
        // What acted until the next frame is in that one.
        let last = vec![0.0; robot.inputs.len()];
        let inputs = frames.get(row + 1).map_or(last.as_slice(), |next| &next.applied);
        for x in states.chain(inputs) {
            write!(log, ",{}", f64::from(*x)).unwrap();
        }
    }
    let out = tempfile::tempdir().unwrap();
    let path = out.path().join("run.csv");
    std::fs::write(&path, log).unwrap();

    let recording = Recording::open(&path).unwrap();
    let source = Logs { recording: &recording, schema: &robot.schema };
    let counts = score::count(&source, &[]).unwrap();
    let options = ScoreOptions { horizon: HORIZON, stride: 1, ..ScoreOptions::default() };
    let mut csv = Vec::new();
    let training = (&source, counts);
    score::score_elsewhere(&source, training, model, &options, Some(&mut csv), &|_| ()).unwrap();
    let csv = String::from_utf8(csv).unwrap();

    let lag = model.structure().lag();
    let mut compared = [0; HORIZON + 1];
    for line in csv.lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let (from, step): (usize, usize) = (fields[1].parse().unwrap(), fields[2].parse().unwrap());
        let frame = &frames[from + step];
        let measured = frames[from - lag..=from].iter().all(|frame| !frame.measured.is_empty());
        if frame.steps as usize != step || !measured {
            continue;
        }
        assert_eq!(frame.predicted.len(), robot.states.len());
        for (i, p) in frame.predicted.iter().enumerate() {
            let [measured, shown] = [0, 1].map(|k| fields[3 + 2 * i + k].parse::<f64>().unwrap());
            // An angle is shown on the turn of the measured one, by this very formula.
            let expected = match robot.states[i].space {
                Space::Line => f64::from(*p),
                Space::Circle => measured + (f64::from(*p) - measured).wrap(),
            };
            assert_eq!(shown.to_bits(), expected.to_bits(), "{name}: {line}");
        }
        compared[step] += 1;
    }
    compared
}

/// Three minutes; how often each number of steps must have been compared.
const SECONDS: u64 = 180;

#[test]
fn a_loop_predicts_what_evaluate_does_to_the_last_bit() {
    // With bounds, wild samples are not believed, which makes more gaps.
    const POSE: [f32; 6] = [0.03, 0.03, 0.06, 0.1, 0.1, 0.2];
    const TIP: [f32; 4] = [8.0, 8.0, 20.0, 20.0];
    for (gaps, spike, bounded) in [(false, 0.0, false), (true, 0.0, false), (true, 1.0, true)] {
        let pose = model("skid-rosbot", bounded.then_some(&POSE));
        let frames = drive(&pose, (gaps, spike * 5.0), SECONDS, 1, |_, _| ());
        let turns = frames.iter().filter_map(|frame| frame.measured.get(2));
        assert!(turns.into_iter().all(|phi| phi.abs() <= std::f32::consts::PI));
        let tip = model("soft-leg", bounded.then_some(&TIP));
        let leg = bend(&tip, (gaps, spike * 300.0), SECONDS);
        for (name, model, frames) in [("skid-rosbot", &pose, frames), ("soft-leg", &tip, leg)] {
            let compared = compare(name, model, &frames);
            let missing = frames.iter().filter(|frame| frame.measured.is_empty()).count();
            println!(
                "{name}: {} frames, {missing} without a measurement, by steps: {compared:?}",
                frames.len()
            );
            // Each gap costs the lag and the window at the end.
            assert!(10 * compared[1] > 6 * frames.len(), "{name}: {compared:?}");
            assert!(
                !gaps || compared[2..=9].iter().all(|count| *count > 2),
                "{name}: {compared:?}"
            );
        }
    }
}
