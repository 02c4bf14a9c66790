//! Every mistake in robot.toml is one clear line; data that do not determine a model are refused
//! by the methods that need that they do.

mod command;

use command::{ROBOT, TERMS, Workshop, lines, text, trial};

/// The command refuses the description, in which `passage` is replaced, naming all `fragments`.
#[track_caller]
fn refused(passage: &str, by: &str, fragments: &[&str]) {
    let workshop = Workshop::new();
    workshop.describe(passage, by);
    workshop.write("model.bin", "an earlier model");
    for robot in [".", "robot.toml"] {
        let message = workshop.refuse(&["fit", robot]);
        assert!(message.contains("robot.toml:"), "{message}");
        for fragment in fragments {
            assert!(message.contains(fragment), "`{fragment}` is not in: {message}");
        }
        // Words for people, not the inside of the program.
        assert!(!message.contains(" { ") && !message.contains("::"), "{message}");
    }
}

/// `[dictionary]` with this content is refused.
#[track_caller]
fn dictionary_refused(content: &str, fragments: &[&str]) {
    refused("[score]", &format!("[dictionary]\n{content}\n[score]"), fragments);
}

#[test]
fn syntax_and_types() {
    refused("horizon", "horizons", &["robot.toml:20:1: ", "horizons", "horizon"]);
    refused("unit = \"m\"", "unti = \"m\"", &["robot.toml:7:1: ", "unti"]);
    refused("[score]", "[scores]", &["robot.toml:19:2: ", "scores"]);
    refused("[score]", "[fit]\nmethods = \"qr\"\n[score]", &["robot.toml:20:1: ", "methods"]);
    refused("[score]", "[symmetry]\nknd = \"se2\"\n[score]", &["robot.toml:", "kind"]);
    refused("name = \"cart\"\n", "", &["robot.toml:1:1: ", "missing", "`name`"]);
    refused("sample_time_s = 0.1\n", "", &["missing", "`sample_time_s`"]);
    refused("range = [-10, 10]\n", "", &["robot.toml:14:", "missing", "`range`"]);
    refused("space = \"R\"\n", "", &["robot.toml:4:", "missing", "`space`"]);
    refused("0.1", "\"fast\"", &["robot.toml:2:17: ", "string \"fast\""]);
    refused("[-10, 10]", "10", &["robot.toml:17:9: ", "10"]);
    refused("[-10, 10]", "[1, 2, 3]", &["robot.toml:17:"]);
    refused("horizon = 10", "horizon = -1", &["robot.toml:20:11: ", "-1"]);
    refused("horizon = 10", "horizon = 1.5", &["robot.toml:20:11: ", "1.5"]);
    refused("\"S1\"", "\"S2\"", &["robot.toml:11:9: ", "S2", "`R` or `S1`"]);
    refused("\"R\"", "\"r\"", &["robot.toml:6:9: ", "`r`", "`R` or `S1`"]);
    refused("[score]", "[fit]\nmethod = \"lu\"\n[score]", &["lu", "cholesky", "qr", "svd"]);
    refused("space = \"R\"", "space = \"R", &["robot.toml:6:"]);
    refused("unit = \"m\"", "unit = \"m\"\nunit = \"mm\"", &["robot.toml:8:1: ", "duplicate"]);
    refused("[[states]]", "[states]", &["robot.toml:"]);
}

#[test]
fn names_and_ranges() {
    refused("name = \"phi\"", "name = \"x\"", &["states[1].name", "`x`"]);
    refused("name = \"u\"", "name = \"phi\"", &["inputs[0].name", "`phi`"]);
    refused("name = \"x\"", "name = \"2x\"", &["states[0].name", "letters"]);
    refused("name = \"x\"", "name = \"\"", &["states[0].name", "letters"]);
    refused("name = \"cart\"", "name = \"\"", &["name: expected a name"]);
    refused("0.1", "0", &["sample_time_s", "greater than 0"]);
    refused("0.1", "-0.1", &["sample_time_s", "greater than 0"]);
    refused("0.1", "nan", &["sample_time_s", "greater than 0"]);
    refused("[-10, 10]", "[10, -10]", &["inputs[0].range", "low < high"]);
    refused("[-10, 10]", "[1, 1]", &["inputs[0].range", "low < high"]);
    refused("[-10, 10]", "[-inf, inf]", &["inputs[0].range", "low < high"]);
    refused("[-10, 10]", "[nan, 1]", &["inputs[0].range", "low < high"]);
    refused("unit = \"m\"", "limit = [5, 1]", &["states[0].limit", "low < high"]);
    refused("\"rad\"", "\"turns\"", &["states[1].unit", "`rad` or `deg`"]);
    refused("[score]", "[fit]\nridge = -1\n[score]", &["fit.ridge", "0 or more"]);
    refused("[score]", "[fit]\nrefine = -0.1\n[score]", &["fit.refine", "0 or more"]);
    refused("[score]", "[fit]\ntruncation = nan\n[score]", &["fit.truncation", "0 or more"]);
    refused("[score]", "[fit]\ntruncation = 1\n[score]", &["fit.truncation", "below 1"]);
}

#[test]
fn scores() {
    refused("horizon = 10", "horizon = 0", &["score.horizon", "1 to 1000000"]);
    refused("horizon = 10", "horizon = 9223372036854775807", &["score.horizon", "1 to 1000000"]);
    refused("horizon = 10", "stride = 0", &["score.stride", "1 to 1000000"]);
    refused("horizon = 10", "folds = 1", &["score.folds", "2 to 1000"]);
    refused("horizon = 10", "folds = 1000000000000", &["score.folds", "2 to 1000"]);
}

#[test]
fn no_states() {
    let workshop = Workshop::new();
    workshop.write("robot.toml", "name = \"cart\"\nsample_time_s = 0.1\nstates = []\n");
    let message = workshop.refuse(&["fit", "."]);
    assert!(message.contains("states: expected at least one"), "{message}");
}

#[test]
fn symmetries() {
    let symmetry = |kind: &str, list: &str| {
        format!("[symmetry]\nkind = \"{kind}\"\ncoordinates = {list}\n[score]")
    };
    let bad = |kind: &str, list: &str, fragments: &[&str]| {
        refused("[score]", &symmetry(kind, list), fragments);
    };
    bad("translation", "[\"y\"]", &["symmetry.coordinates", "`y`"]);
    bad("translation", "[\"u\"]", &["symmetry.coordinates", "`u`"]);
    bad("rotation", "[\"x\"]", &["robot.toml:", "rotation", "translation", "se2"]);
    bad("se2", "[\"x\", \"phi\"]", &["robot.toml:"]);
    bad("se2", "[\"x\", \"y\", \"phi\"]", &["symmetry.coordinates", "`y`"]);
    bad("se2", "[\"x\", \"x\", \"phi\"]", &["symmetry", "each once"]);
    bad("se2", "[\"x\", \"phi\", \"phi\"]", &["symmetry", "each once"]);
    let absolute = ROBOT
        .replace("unit = \"m\"", "unit = \"m\"\ntarget = \"absolute\"")
        .replace("[score]", &symmetry("translation", "[\"x\"]"));
    refused(ROBOT, &absolute, &["states[0].target", "increment"]);
}

#[test]
fn dictionaries() {
    dictionary_refused("orders = { y = 2 }", &["dictionary.orders.y", "neither"]);
    dictionary_refused("fourier = { x = 2 }", &["dictionary.fourier.x", "S1"]);
    dictionary_refused("fourier = { y = 2 }", &["dictionary.fourier.y", "S1"]);
    dictionary_refused("order = 10", &["dictionary", "10", "9"]);
    dictionary_refused("order = 300", &["robot.toml:20:9: ", "300"]);
    dictionary_refused("orders = { u = 200 }", &["dictionary", "200", "9"]);
    dictionary_refused("fourier = { phi = 10 }", &["dictionary", "10", "9"]);
    dictionary_refused("order = 9", &["dictionary", "terms", "10000", "4096"]);
    dictionary_refused("delays = { states = 7 }", &["dictionary", "@7", "6"]);
    dictionary_refused("delays = { inputs = 200 }", &["dictionary", "6"]);
    let block = |factors: &str, fragments: &[&str]| {
        dictionary_refused(&format!("blocks = [{{ factors = [{factors}] }}]"), fragments);
    };
    let at = "dictionary.blocks[0].factors[0]";
    block("\"y\"", &[at, "`y`", "neither a state nor an input"]);
    block("\"phi\"", &[at, "sin(phi)"]);
    block("\"sin(x)\"", &[at, "sin(x)"]);
    block("\"sin(y)\"", &[at, "`y`"]);
    block("\"tan(phi)\"", &[at, "tan(phi)"]);
    block("\"sin(u)\"", &[at, "sin(u)"]);
    block("\"d(x)\"", &[at, "d(x)@1"]);
    block("\"d(u)@1\"", &[at, "d(u)@1"]);
    block("\"x^y\"", &[at, "whole number"]);
    block("\"x^-1\"", &[at, "whole number"]);
    block("\"x@y\"", &[at, "whole number"]);
    block("\"x^2@1\"", &[at, "x^2@1"]);
    block("\"\"", &[at]);
    block("\"sin(phi\"", &[at, "sin(phi"]);
    block("\"x@7\"", &["x@7", "6"]);
    block("\"x^12\"", &["12", "9"]);
    block("\"x\", \"x^2\"", &["`x`", "twice"]);
}

#[test]
fn listed_terms() {
    let terms = |list: &str, fragments: &[&str]| {
        dictionary_refused(&format!("terms = [{list}]"), fragments);
    };
    let at = "dictionary.terms[1]";
    terms("\"x\", \"y*u\"", &[at, "`y`", "neither a state nor an input"]);
    terms("\"x\", \"phi*u\"", &[at, "lives on S1"]);
    terms("\"x\", \"sin(0*phi)\"", &[at, "harmonic of 1 to 9"]);
    terms("\"x\", \"cos(2*phi)^2\"", &[at, "without an exponent"]);
    terms("\"x\", \"fourier(phi)^2\"", &[at, "sin(n*angle)"]);
    terms("\"x\", \"u^10\"", &[at, "exponent of 1 to 9"]);
    terms("\"x\", \"\"", &[at, "neither a state nor an input"]);
    terms("\"x\", \"d(x)\"", &[at, "lag of 1 or more"]);
    terms("\"x*u\", \"u*x\"", &[at, "`u*x` is listed twice"]);
    terms("\"x@7\"", &["dictionary", "x@7", "6"]);
    dictionary_refused("terms = [\"x\"]\norder = 2", &["dictionary.order", "beside `terms`"]);
    dictionary_refused(
        "terms = [\"x\"]\nblocks = [{ factors = [\"u\"] }]",
        &["dictionary.blocks", "beside `terms`"],
    );
    // Nine powers of each of nine functions, in pairs: more than 255 products.
    let powers = ["x", "u", "x@1", "u@1"];
    let mut pairs = Vec::new();
    for (i, a) in powers.iter().enumerate() {
        for b in &powers[i + 1..] {
            pairs.extend((1..8).flat_map(|p| (1..8).map(move |q| format!("\"{a}^{p}*{b}^{q}\""))));
        }
    }
    terms(&pairs.join(", "), &["dictionary.terms", "255"]);
}

#[test]
fn too_many_states() {
    let workshop = Workshop::new();
    let mut robot = "name = \"worm\"\nsample_time_s = 0.1\n".to_owned();
    for i in 0..9 {
        robot += &format!("[[states]]\nname = \"x{i}\"\nspace = \"R\"\n");
    }
    workshop.write("robot.toml", robot);
    let message = workshop.refuse(&["fit", "."]);
    assert!(
        message.contains("9") && message.contains("states") && message.contains("8"),
        "{message}"
    );
}

#[test]
fn no_description() {
    let workshop = Workshop::new();
    for robot in ["nowhere", "logs", "nowhere/robot.toml"] {
        let message = workshop.refuse(&["fit", robot]);
        assert!(message.contains(robot) && message.contains("robot.toml"), "{message}");
    }
    workshop.write("robot.toml", b"name = \"\xff\"");
    assert!(workshop.refuse(&["fit", "."]).contains("robot.toml"));
}

/// A workshop whose input never moves, fitted by `options`.
fn still(input: f64, options: &str) -> Workshop {
    let workshop = Workshop::new();
    workshop.describe("[score]", &format!("[fit]\n{options}\n[score]"));
    for number in 0..3 {
        let (mut x, mut phi) = (1.0 + number as f64, 0.3 * number as f64);
        let samples: Vec<_> = (0..80)
            .map(|_| {
                let sample = [x, phi, input];
                x = 0.95 * x + 0.2 * phi.sin() + 0.01 * input;
                phi += 0.37 + 0.1 * x;
                sample
            })
            .collect();
        workshop.write(&format!("logs/run-{number}.csv"), text(&lines(&samples)));
    }
    workshop
}

#[test]
fn dependent_terms_are_refused_by_name() {
    for input in [0.0, 2.5] {
        for method in ["cholesky", "qr"] {
            for scaled in ["true", "false"] {
                let options = format!("method = \"{method}\"\nscale_columns = {scaled}");
                let message = still(input, &options).refuse(&["fit", "."]);
                for fragment in ["8 of 16 terms", "`u`", "`x*u`", "ridge", "svd", "robot.toml"] {
                    assert!(message.contains(fragment), "`{fragment}` is not in: {message}");
                }
            }
        }
    }
}

#[test]
fn ridge_and_truncation_accept_dependent_terms_and_print_the_rank() {
    for input in [0.0, 2.5] {
        for options in [
            "ridge = 1e-8",
            "method = \"qr\"\nridge = 1e-8",
            "method = \"svd\"",
            "method = \"svd\"\nridge = 1e-8",
            "method = \"svd\"\nscale_columns = false\ntruncation = 1e-9",
        ] {
            let workshop = still(input, options);
            let text = workshop.succeed(&["fit", "."]);
            assert!(text.contains("numerical rank 8 of 16"), "{options}, {input}: {text}");
            assert!(!text.contains("condition number diverged"), "{options}, {input}: {text}");
            let json: serde_json::Value =
                serde_json::from_str(&workshop.succeed(&["fit", ".", "--json"])).unwrap();
            assert_eq!(json["fit"]["rank"], 8);
            assert_eq!(json["model"]["terms"], TERMS);
        }
    }
}

#[test]
fn fewer_pairs_than_terms_are_dependent_terms() {
    let workshop = Workshop::new();
    std::fs::remove_dir_all(workshop.path("logs")).unwrap();
    workshop.write("logs/short.csv", text(&lines(&trial(0)[..12])));
    let message = workshop.refuse(&["fit", "."]);
    assert!(message.contains("5 of 16 terms"), "{message}");
}
