//! Rollouts over other logs: `fit --test` and `stability`.

mod command;

use command::{Workshop, lines, text, trial};
use serde_json::Value;

/// The cart's position is exactly this; the angle, which is not, may be as wrong as it likes.
const CART: &str = "[dictionary]\nblocks = [{ factors = [\"x\"] }, \
    { factors = [\"sin(phi)\"] }, { factors = [\"u\"] }]\n\n[score]";

fn workshop() -> Workshop {
    let workshop = Workshop::new();
    workshop.describe("[score]", CART);
    workshop.write("other/run-9.csv", text(&lines(&trial(9))));
    workshop.write("other/short.csv", text(&lines(&trial(8))[..8]));
    workshop
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[test]
fn fit_shows_the_errors_over_other_logs_in_both_precisions() {
    let workshop = workshop();
    let fit = ["fit", ".", "--no-score", "--test", "other"];
    let said = workshop.succeed(&fit);
    assert!(said.contains("test logs: 1 rollout of 10 steps from sample 0 of each"), "{said}");
    assert!(said.contains("x [m²]") && said.contains("phi [rad²]"), "{said}");
    let report = json(&workshop.succeed(&[&fit[..], &["--json", "--horizon", "5"]].concat()));
    let test = &report["test"];
    assert_eq!((test["horizon"].as_u64(), test["windows"].as_u64()), (Some(5), Some(2)));
    let contender = |i: usize| {
        let c = &test["contenders"][i];
        let number = |key: &str, state: usize| c[key][state].as_f64().unwrap();
        assert!((number("rmse", 0).powi(2) / number("mse", 0) - 1.0).abs() < 1e-12);
        assert_eq!(c["diverged_windows"], 0);
        number("mse", 0)
    };
    let [wide, narrow, still] = [0, 1, 2].map(contender);
    assert!(wide < still && narrow < still && wide != narrow, "{test}");
    assert!(json(&workshop.succeed(&["fit", ".", "--json"]))["test"].is_null());

    let message = workshop.refuse(&[&fit[..], &["--horizon", "400"]].concat());
    assert!(message.contains("no test trajectory has the 401 rows"), "{message}");
    let message = workshop.refuse(&["fit", ".", "--test", "nowhere"]);
    assert!(message.contains("nowhere"), "{message}");
}

#[test]
fn stability_says_where() {
    let workshop = workshop();
    workshop.succeed(&["fit", ".", "--no-score"]);
    let command = ["stability", "model.bin", "--logs", "other"];
    let said = workshop.succeed(&command);
    assert!(said.contains("spectral radius of one step: median"), "{said}");
    assert!(said.contains("11 rollouts of 10 steps, one every 10 samples"), "{said}");
    assert!(said.contains("diverged: none"), "{said}");
    let report = json(&workshop.succeed(&[&command[..], &["--json"]].concat()));
    assert_eq!((report["format"].as_u64(), report["points"].as_u64()), (Some(1), Some(110)));
    let radius = &report["spectral_radius"];
    assert!(radius["median"].as_f64().unwrap() <= radius["largest"].as_f64().unwrap());
    assert_eq!(radius["place"]["trajectory"], "run-9");
    assert_eq!(report["states"], serde_json::json!(["x", "phi"]));
    let message = workshop.refuse(&[&command[..], &["--horizon", "400"]].concat());
    assert!(message.contains("no trajectory has the 401 rows of a window"), "{message}");
}
