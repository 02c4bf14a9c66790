//! `trainer spectrum` as a user runs it.

mod command;

use std::collections::BTreeSet;

use command::{TERMS, Workshop};
use serde_json::Value;

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[track_caller]
fn has_fields(value: &Value, fields: &[&str]) {
    let found: BTreeSet<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(found, fields.iter().copied().collect());
}

#[test]
fn spectrum_of_the_cart() {
    let workshop = Workshop::new();
    let text = workshop.succeed(&["spectrum", "."]);
    for part in [
        "cart: 3 trajectories, 357 snapshot pairs, sample time 0.1 s",
        "inputs held: u = 0 V",
        "operator K on the 8 terms of the state alone, regressed on all 16 terms",
        "spectral radius 1.0",
        "frequency [Hz]",
        "x [m]",
        "relative residual",
    ] {
        assert!(text.contains(part), "`{part}` is not in: {text}");
    }
    assert_eq!(
        workshop.succeed(&["spectrum", "robot.toml", "--logs", "logs", "--input", "0"]),
        text
    );
    let turned = workshop.succeed(&["spectrum", ".", "--input", "-2.5"]);
    assert!(turned.contains("u = -2.5 V") && turned != text, "{turned}");
    assert!(
        workshop
            .succeed(&["spectrum", ".", "--input=11"])
            .contains("u = 11 V (outside its range, -10 to 10)")
    );
}

#[test]
fn spectrum_as_json() {
    let workshop = Workshop::new();
    let report = json(&workshop.succeed(&["spectrum", ".", "--input", "5", "--json"]));
    has_fields(
        &report,
        &[
            "format",
            "command",
            "robot",
            "sample_time_s",
            "trajectories",
            "pairs",
            "regressed_terms",
            "rank",
            "inputs",
            "terms",
            "term_sizes",
            "coordinates",
            "without_modes",
            "spectral_radius",
            "eigenvalues",
            "condition",
            "eigenvector_residuals",
            "reconstruction_residual",
            "defective_beyond",
            "defects",
        ],
    );
    assert_eq!((&report["format"], &report["command"]), (&1.into(), &"spectrum".into()));
    assert_eq!((&report["rank"], &report["regressed_terms"]), (&TERMS.into(), &TERMS.into()));
    assert_eq!(report["inputs"][0]["value"], 5.0);
    has_fields(&report["inputs"][0], &["name", "unit", "value", "range"]);
    let coordinates = report["coordinates"].as_array().unwrap();
    let names: Vec<&str> = coordinates.iter().map(|c| c["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["x", "sin(phi)", "cos(phi)"]);
    has_fields(&coordinates[0], &["name", "state", "unit", "target"]);
    let eigenvalues = report["eigenvalues"].as_array().unwrap();
    assert_eq!(eigenvalues.len(), TERMS / 2);
    let mut last = f64::INFINITY;
    for e in eigenvalues {
        has_fields(
            e,
            &[
                "re",
                "im",
                "modulus",
                "frequency_hz",
                "time_constant_s",
                "condition",
                "eigenfunction",
                "eigenfunction_rms",
                "modes",
                "shares",
            ],
        );
        let (re, im, modulus) = (e["re"].as_f64(), e["im"].as_f64(), e["modulus"].as_f64());
        assert!((re.unwrap().hypot(im.unwrap()) - modulus.unwrap()).abs() < 1e-12);
        assert!(modulus.unwrap() <= last + 1e-8);
        last = modulus.unwrap();
        assert_eq!(e["eigenfunction"].as_array().unwrap().len(), TERMS / 2);
        assert_eq!(
            (e["modes"].as_array().unwrap().len(), e["shares"].as_array().unwrap().len()),
            (3, 3)
        );
    }
    // 0.1 · 5 V turn the sail by half a radian a step: sin and cos are a rotation, sampled at 10 Hz.
    let turns = |e: &&Value| {
        (e["frequency_hz"].as_f64().unwrap() - 5.0 / std::f64::consts::TAU).abs() < 0.1
    };
    assert!(eigenvalues.iter().any(|e| turns(&e)), "{eigenvalues:#?}");
    assert!(report["reconstruction_residual"].as_f64().unwrap() < 1e-9);
}

#[test]
fn spectrum_refuses() {
    let workshop = Workshop::new();
    for (input, fragment) in [
        ("1,2", "--input 1,2: expected 1 values, found 2; the inputs of cart are: u"),
        ("fast", "--input fast: `fast` is not a finite number"),
        ("", "is not a finite number"),
        ("1,", "is not a finite number"),
        ("nan", "is not a finite number"),
        ("1e999", "is not a finite number"),
    ] {
        let message = workshop.refuse(&["spectrum", ".", "--input", input]);
        assert!(message.contains(fragment), "{message}");
        workshop.refuse(&["spectrum", ".", "--json", "--input", input]);
    }
    let message = workshop.refuse(&["spectrum", ".", "--input", "1e300"]);
    assert!(message.contains("too large"), "{message}");
    assert!(workshop.refuse(&["spectrum", "nowhere"]).starts_with("nowhere"));
    assert!(workshop.refuse(&["spectrum", ".", "--logs", "nowhere"]).starts_with("nowhere"));

    workshop.describe("[score]", "[dictionary]\norders = { x = 0, phi = 0 }\n[score]");
    let message = workshop.refuse(&["spectrum", "."]);
    assert!(message.contains("cart has no spectrum"), "{message}");
    // Fewer functions of the state still have one.
    workshop.describe("[score]", "[dictionary]\norders = { x = 0 }\n[score]");
    let text = workshop.succeed(&["spectrum", "."]);
    assert!(text.contains("no mode for x: not a term of the dictionary"), "{text}");
    // Dependent terms by name, unless the options accept them.
    let dependent = "[dictionary]\norders = { phi = 2 }\n";
    workshop.describe("[score]", &format!("{dependent}[score]"));
    let message = workshop.refuse(&["spectrum", "."]);
    assert!(message.contains("depend") && message.contains("`H2(sin(phi))`"), "{message}");
    for options in ["ridge = 1e-8", "method = \"svd\""] {
        workshop.describe("[score]", &format!("{dependent}[fit]\n{options}\n[score]"));
        let report = json(&workshop.succeed(&["spectrum", ".", "--json"]));
        assert_eq!(report["eigenvalues"].as_array().unwrap().len(), 18);
        assert!(report["rank"].as_u64().unwrap() < 36, "{report}");
        let residual = report["reconstruction_residual"].as_f64().unwrap();
        let defects = report["defects"].as_array().unwrap();
        assert!(residual < 1e-9 || !defects.is_empty(), "{residual:e}");
    }
}
