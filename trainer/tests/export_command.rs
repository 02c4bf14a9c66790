//! `trainer export --q31` as a user runs it.

mod command;

use command::Workshop;
use serde_json::Value;

#[test]
fn the_cart_in_fixed_point() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", ".", "--no-score"]);
    let text = workshop.succeed(&[
        "export",
        "model.bin",
        "--q31",
        "--out",
        "model.q31",
        "--logs",
        "logs",
        "--full-scale",
        "u=20",
    ]);
    for part in [
        "cart, ",
        "64 in 32 bits",
        "x [m]",
        "20.00",
        "against f64",
        "against f32",
        "0 in fixed point alone",
    ] {
        let part = part.replace("64 in", "48 coefficients in");
        assert!(text.contains(&part), "`{part}` is not in: {text}");
    }
    let json = workshop.succeed(&["export", "model.bin", "--q31", "--out", "model.q31", "--json"]);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["command"], "export");
    for coordinate in 0..2 {
        let largest = json["one_step"]["fixed"][coordinate]["largest"].as_f64().unwrap();
        assert!(largest <= 1e-6 * json["coordinates"][coordinate]["full_scale"].as_f64().unwrap());
    }
    let shown = workshop.succeed(&["inspect", "model.q31"]);
    assert!(shown.contains("32-bit integers") && shown.contains("phi [rad]"), "{shown}");
    let shown: Value =
        serde_json::from_str(&workshop.succeed(&["inspect", "model.q31", "--json"])).unwrap();
    assert_eq!(shown["fixed_point"]["robot"], "cart");
}

#[test]
fn what_is_refused_leaves_no_file() {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", ".", "--no-score"]);
    for (arguments, reason) in [
        (&["--full-scale", "z=1"][..], "--full-scale z: there is no such coordinate"),
        (&["--full-scale", "x"], "expected NAME=VALUE"),
        (&["--full-scale", "u=0.001"], "that holds the trained range"),
        (&["--margin=-1"], "--margin -1"),
    ] {
        let all = [&["export", "model.bin", "--q31", "--out", "new.q31"], arguments].concat();
        let message = workshop.refuse(&all);
        assert!(message.contains(reason), "`{reason}` is not in: {message}");
        assert!(!workshop.path("new.q31").exists());
    }
    let message = workshop.refuse(&["export", "model.bin", "--q31", "--out", "model.bin"]);
    assert!(message.contains("must not take the place of the model"), "{message}");
    workshop.succeed(&["export", "model.bin", "--q31", "--out", "model.q31"]);
    let message = workshop.refuse(&["evaluate", "model.q31", "--logs", "logs"]);
    assert!(message.contains("a model in fixed point"), "{message}");
}
