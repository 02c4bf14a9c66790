//! Models of models/ in fixed point: as accurate as asked for, and refused with a reason where they cannot be.

use std::path::{Path, PathBuf};

use firmware_core::blob;
use firmware_core::model::Model;
use firmware_core::q31;
use firmware_sim::run::Blob;
use trainer::fixed_point::{FixedError, FixedOptions, compare, fixed_point, inspect};

/// Of full scale: the bar.
const ACCURACY: f64 = 1e-6;

fn models() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models")
}

/// Bytes where a blob may lie.
struct Words(Vec<u32>, usize);

impl Words {
    fn new(bytes: &[u8]) -> Self {
        let mut words = vec![0; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self(words, bytes.len())
    }

    fn read(path: &Path) -> Self {
        Self::new(&std::fs::read(path).expect("a file"))
    }

    fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.0)[..self.1]
    }
}

fn model(robot: &str) -> Words {
    Words::read(&models().join(robot).join("model.bin"))
}

fn export(bytes: &[u8], options: &FixedOptions) -> Result<Vec<u8>, FixedError> {
    let model: Model<'_> = firmware_core::parse(bytes).expect("a blob");
    let test = blob::self_test(bytes).expect("a self-test");
    fixed_point(&model, &test, options).map(|export| export.bytes)
}

#[test]
fn one_step_is_within_a_millionth_of_full_scale_and_no_worse_than_f32() {
    // Absolute angle under translation; angles by their change, Fourier bases in four blocks.
    for robot in ["rosbot", "two-link-arm"] {
        let file = model(robot);
        let model = firmware_core::parse(file.bytes()).expect("a blob");
        let bytes = Words::new(&export(file.bytes(), &FixedOptions::default()).expect("a model"));
        let fixed = q31::parse(bytes.bytes()).expect("a blob in fixed point");
        let found = compare(&model, &fixed).expect("a comparison");
        assert!(found.samples > 19_000, "{robot}: {}", found.samples);
        let shown = inspect(bytes.bytes()).expect("a blob in fixed point");
        for ((c, of_fixed), of_float) in
            shown.coordinates.iter().zip(&found.fixed).zip(&found.float)
        {
            let share = of_fixed.largest / c.full_scale;
            assert!(share <= ACCURACY, "{robot} {}: {share}", c.name);
            // f32 has 24 digits, and its own sine.
            assert!(of_fixed.largest <= 4.0 * of_float.largest, "{robot} {}", c.name);
        }
    }
}

#[test]
fn the_blob_of_models_is_what_the_exporter_makes() {
    let found = export(model("rosbot").bytes(), &FixedOptions::default()).expect("a model");
    assert_eq!(found, std::fs::read(models().join("rosbot/model.q31")).expect("a file"));
}

#[test]
fn what_cannot_be_is_refused_with_a_reason() {
    let options = FixedOptions::default();
    assert!(matches!(export(model("soft-leg").bytes(), &options), Err(FixedError::Sparse { .. })));
    let given = |name: &str, value: f64| FixedOptions {
        full_scales: vec![(name.to_owned(), value)],
        ..FixedOptions::default()
    };
    let rosbot = model("rosbot");
    assert!(export(rosbot.bytes(), &given("x", 10.0)).is_ok());
    let refused = export(rosbot.bytes(), &given("z", 10.0));
    assert!(matches!(refused, Err(FixedError::UnknownName { .. })));
    let refused = export(rosbot.bytes(), &given("omega_r", 1.0));
    assert!(matches!(refused, Err(FixedError::TooSmall { .. })));
    // No trained ranges: none are needed by any other reader.
    let blob = Blob::read(&models().join("rosbot/model.bin")).expect("a blob");
    let model = blob.model().expect("a model");
    let bare = Model::new(model.structure().clone(), model.coefficients(), None).expect("a model");
    let test = blob::self_test(rosbot.bytes()).expect("a self-test");
    assert_eq!(fixed_point(&bare, &test, &options), Err(FixedError::NoRanges));
}
