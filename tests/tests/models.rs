//! The models that come with the project: made from their logs to the last bit, and refused when a
//! single bit of them is wrong.

use std::path::{Path, PathBuf};

use firmware_core::blob::{self, Aligned, ParseError};
use firmware_core::cost::Cost;
use firmware_core::{Model, Predictor, PredictorState, parse, parse_for};
use firmware_sim::run::Blob as SimBlob;
use trainer::edmd;
use trainer::export::{coordinate, export};
use trainer::recording::{Recording, Visitor};
use trainer::robot::Robot;
use trainer::trajectory::Logs;

/// The folders in models/.
fn folders() -> Vec<PathBuf> {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let mut folders: Vec<PathBuf> =
        std::fs::read_dir(models).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.retain(|folder| folder.is_dir());
    folders.sort();
    assert!(folders.len() >= 4, "those of the simulated robots at least");
    folders
}

/// Those with logs, and with that a blob.
fn made_models() -> Vec<PathBuf> {
    let mut folders = folders();
    folders.retain(|folder| folder.join("logs").is_dir());
    assert!(folders.len() >= 4, "those of the simulated robots at least");
    folders
}

/// More bytes than any of the models.
const ROOM: usize = 1 << 17;

/// A blob at an address that the core accepts, with room for more behind it.
struct Blob {
    room: Box<Aligned<[u8; ROOM]>>,
    length: usize,
}

impl Blob {
    fn read(folder: &Path) -> Self {
        let path = folder.join("model.bin");
        Self::new(&std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
    }

    fn new(bytes: &[u8]) -> Self {
        let mut room = Box::new(Aligned([0; ROOM]));
        room.0[..bytes.len()].copy_from_slice(bytes);
        Self { room, length: bytes.len() }
    }

    /// The blob and `extra` bytes behind it.
    fn bytes(&mut self, extra: usize) -> &mut [u8] {
        &mut self.room.0[..self.length + extra]
    }
}

/// The trainer knows the length of a blob before it is written.
#[test]
fn the_length_is_known_beforehand() {
    for folder in made_models() {
        let robot = Robot::load(&folder).unwrap();
        let mut blob = Blob::new(&remade(&folder, &robot));
        let bytes = blob.bytes(0);
        let model = parse(bytes).unwrap();
        let cost = Cost::new(model.structure(), model.terms());
        assert_eq!(cost.bytes as usize, bytes.len(), "{}", folder.display());
    }
}

#[test]
fn every_description_loads() {
    for folder in folders() {
        let robot = Robot::load(&folder).unwrap_or_else(|error| panic!("{error}"));
        let name = folder.file_name().unwrap().to_str().unwrap();
        assert_eq!(robot.name, name, "a folder is called as its robot");
    }
}

/// The blob of a model's logs, without error bounds.
fn remade(folder: &Path, robot: &Robot) -> Vec<u8> {
    let recording = Recording::open(&folder.join("logs")).unwrap();
    let logs = Logs { recording: &recording, schema: &robot.schema };
    export(&edmd::fit(robot, &logs, &|_| ()).unwrap()).unwrap()
}

/// The error bounds come from hours of simulated motion, which `.ci/run` makes again.
#[test]
fn remaking_a_blob_gives_the_same_bytes_but_for_its_error_bounds() {
    for folder in made_models() {
        let robot = Robot::load(&folder).unwrap();
        let mut remade = remade(&folder, &robot);
        let committed = std::fs::read(folder.join("model.bin")).unwrap();
        let mut calibrated = Blob::new(&committed);
        if let Some(bounds) = parse(calibrated.bytes(0)).unwrap().error_bounds() {
            let mut plain = Blob::new(&remade);
            let bytes = plain.bytes(0);
            let test = blob::self_test(bytes).unwrap();
            let model = parse(bytes).unwrap().with_error_bounds(bounds).unwrap();
            let mut out = vec![0; ROOM];
            let (states, inputs) = (test.states, test.inputs);
            let length = blob::emit(&model, states, inputs, test.tolerance, &mut out).unwrap();
            out.truncate(length);
            remade = out;
        }
        assert!(
            remade == committed,
            "{}: {} bytes from the logs, {} committed, {} of them different",
            folder.display(),
            remade.len(),
            committed.len(),
            remade.iter().zip(&committed).filter(|(a, b)| a != b).count()
        );
    }
}

#[test]
fn every_flipped_bit_is_refused() {
    for folder in made_models() {
        let mut blob = Blob::read(&folder);
        parse(blob.bytes(0)).unwrap();
        for bit in 0..8 * blob.length {
            let bytes = blob.bytes(0);
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(parse(bytes).is_err(), "{}: bit {bit}", folder.display());
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        parse(blob.bytes(0)).unwrap();
    }
}

#[test]
fn every_other_length_is_refused() {
    for folder in made_models() {
        let mut blob = Blob::read(&folder);
        let length = blob.length;
        for shorter in 0..length {
            let error = parse(&blob.bytes(0)[..shorter]).err();
            assert!(
                matches!(error, Some(ParseError::Truncated { found, .. }) if found == shorter),
                "{}: {shorter} bytes: {error:?}",
                folder.display()
            );
        }
        for extra in 1..=8 {
            for filling in [0x00, 0xff, 0x0a] {
                let bytes = blob.bytes(extra);
                bytes[length..].fill(filling);
                let trailing = ParseError::Trailing { expected: length, found: length + extra };
                assert_eq!(parse(bytes).err(), Some(trailing), "{}", folder.display());
            }
        }
    }
}

#[test]
fn another_robot_is_refused() {
    for folder in made_models() {
        let mut blob = Blob::read(&folder);
        let name = folder.file_name().unwrap().to_str().unwrap();
        assert_eq!(parse_for(name, blob.bytes(0)).unwrap().structure().robot(), name);
        let longer = format!("{name}2");
        for other in ["", "another", &name[1..], &longer, &name.to_uppercase()] {
            let refused = parse_for(other, blob.bytes(0)).err();
            assert_eq!(refused, Some(ParseError::AnotherRobot), "{other}");
        }
    }
}

/// The first trajectory of a recording, one vector of states and one of inputs per row.
#[derive(Default)]
struct First {
    begun: usize,
    rows: Vec<(Vec<f64>, Vec<f64>)>,
}

impl Visitor for First {
    fn begin(&mut self, _: &str) {
        self.begun += 1;
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        if self.begun == 1 {
            self.rows.push((states.to_vec(), inputs.to_vec()));
        }
    }
}

#[test]
fn a_rollout_over_the_whole_first_log_stays_finite() {
    for folder in made_models() {
        let robot = Robot::load(&folder).unwrap();
        let mut log = First::default();
        Recording::open(&folder.join("logs")).unwrap().read(&robot.schema, &mut log).unwrap();
        let mut blob = Blob::read(&folder);
        let model = parse(blob.bytes(0)).unwrap();
        let structure = model.structure();
        let narrow = |inputs: &[f64]| inputs.iter().map(|u| *u as f32).collect::<Vec<_>>();

        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let (past, future) = log.rows.split_at(structure.lag() + 1);
        let mut applied = Vec::new();
        for (states, inputs) in past {
            let sample: Vec<f32> = states
                .iter()
                .zip(structure.states())
                .map(|(x, state)| coordinate(*x, state.space))
                .collect();
            predictor.observe(&mut state, &applied, &sample).unwrap();
            applied = narrow(inputs);
        }
        let mut inputs = applied;
        for (_, next) in &future[..future.len() - 1] {
            inputs.extend(narrow(next));
        }
        assert!(future.len() >= 100, "{}: a log worth the name", folder.display());
        let mut predicted = vec![f32::NAN; future.len() * structure.states().len()];
        let rolled_out = predictor.rollout(&mut state, &inputs, &mut predicted);
        assert_eq!(rolled_out, Ok(()), "{}", folder.display());
        assert!(predicted.iter().all(|x| x.is_finite()), "{}", folder.display());
    }
}

/// Whatever a state was used for, what is cloned into it predicts as the original does, to the bit.
#[test]
fn a_state_cloned_into_another_one_predicts_the_same() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let blobs = ["rosbot", "skid-rosbot", "soft-leg", "two-link-arm"]
        .map(|name| SimBlob::read(&folder.join(name).join("model.bin")).unwrap());
    let models = blobs.each_ref().map(|blob| blob.model().unwrap());
    let seen = |model: &Model<'_>, value: f32| {
        let (n, m) = (model.structure().states().len(), model.structure().inputs().len());
        let mut state = PredictorState::new();
        for k in 0..=model.structure().lag() {
            let x: Vec<f32> = (0..n).map(|i| value * (1.0 + 0.1 * (i + k) as f32)).collect();
            Predictor::new(model).observe(&mut state, &vec![0.5; m], &x).unwrap();
        }
        state
    };
    let rollout = |model: &Model<'_>, mut state: PredictorState| {
        let (n, m) = (model.structure().states().len(), model.structure().inputs().len());
        let mut path = vec![0.0; 5 * n];
        Predictor::new(model).rollout_held(&mut state, &vec![0.25; m], &mut path).unwrap();
        path.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    for model in &models {
        let original = seen(model, 0.1);
        let expected = rollout(model, original.clone());
        let others = models.iter().map(|other| seen(other, 0.3)).chain([PredictorState::new()]);
        for mut used in others {
            used.clone_from(&original);
            assert_eq!(used, original);
            assert_eq!(rollout(model, used), expected, "{}", model.structure().robot());
        }
        // An empty one empties it.
        let mut used = seen(model, 0.2);
        used.clone_from(&PredictorState::new());
        assert_eq!(used, PredictorState::new());
        assert!(used.history().is_empty());
    }
}
