//! The paper's figures, drawn again from the results of [`reproduce`](crate::reproduce).

use crate::convergence::Convergence;
use crate::plot::{Axes, Chart, Series, Style, svg};
use crate::reproduce::{Method, Reproduction, TestResult};

const BLACK: [u8; 3] = [0, 0, 0];
const GREY: [u8; 3] = [170, 170, 170];
const BLUE: [u8; 3] = [31, 119, 180];
const RED: [u8; 3] = [214, 39, 40];
const GREEN: [u8; 3] = [44, 160, 44];

fn colour(method: Method) -> [u8; 3] {
    match method {
        Method::Hermite => [148, 103, 189],
        Method::EdmdDl => [255, 127, 14],
        Method::SindyLasso => [23, 190, 207],
        Method::SindyThresholded => [140, 86, 75],
        Method::AcdEdmd => BLUE,
        Method::AcdEdmdAveraged => [140, 180, 215],
        Method::AcdEdmdWhole => [227, 119, 194],
        Method::Recommended => GREEN,
        Method::NoMotion => GREY,
        Method::Arx => [188, 189, 34],
    }
}

/// Every figure as (file name, SVG).
pub fn all(results: &Reproduction) -> Vec<(&'static str, String)> {
    let test = |training, folder| results.test(training, folder);
    let mut figures = Vec::new();
    let mut add = |name, title: &str, charts: Vec<Option<Chart>>, columns| {
        let charts: Vec<Chart> = charts.into_iter().flatten().collect();
        if !charts.is_empty() {
            figures.push((name, svg(title, &charts, columns)));
        }
    };
    let euler = "drive-euler/train";
    add(
        "drive-circle.svg",
        "Simulated drive on a circle, trained on random inputs",
        vec![
            test("drive-closing/train", "drive-closing/circle")
                .map(|t| path(t, "r = 0.053 m, as in the paper's figure")),
            test(euler, "drive-euler/circle")
                .map(|t| path(t, "r = 0.062 m, as in the paper's text")),
            test("drive-exact/train", "drive-exact/circle")
                .map(|t| path(t, "r = 0.062 m, exact motion")),
        ],
        3,
    );
    let own = "rosbot/chattering";
    add(
        "rosbot.svg",
        "Stand-in for the physical ROSbot",
        vec![
            test(euler, "rosbot/circle").map(|t| path(t, "circle, trained on the nominal drive")),
            test(own, "rosbot/circle").map(|t| path(t, "circle, trained on its own logs")),
            test(euler, "rosbot/sharp-turn")
                .map(|t| path(t, "sharp turn, trained on the nominal drive")),
            test(own, "rosbot/sharp-turn").map(|t| path(t, "sharp turn, trained on its own logs")),
        ],
        2,
    );
    add(
        "arm-quadrant.svg",
        "2R arm driven through a quadrant",
        vec![
            test("arm-euler/train", "arm-euler/quadrant").map(|t| arm(t, "Euler, as in the paper")),
            test("arm-rk4/train", "arm-rk4/quadrant").map(|t| arm(t, "RK4")),
        ],
        2,
    );
    let parts = [
        ("leg-bending/train", "leg-bending/test", "bending part"),
        ("leg-extension/train", "leg-extension/test", "extension part"),
    ];
    add(
        "leg-parts.svg",
        "Soft leg (stand-in plant), one part at a time",
        parts
            .iter()
            .flat_map(|(training, folder, name)| {
                let test = test(training, folder);
                (0..2).map(move |i| test.map(|t| over_time(t, i, name)))
            })
            .collect(),
        2,
    );
    let walk = test("leg-walk/train", "leg-walk/test");
    add(
        "leg-walk.svg",
        "Soft leg (stand-in plant), one step of a walk",
        vec![walk.map(|t| path(t, "tip")), walk.map(leg)],
        2,
    );
    add(
        "horizon.svg",
        "Rollout error grows with the horizon",
        [
            ("drive-exact/train", "drive-exact/validation", "drive, exact motion: position", 2),
            ("drive-exact/train", "drive-exact/circle", "drive, exact motion, circle: position", 2),
            ("rosbot/chattering", "rosbot/circle", "ROSbot, own logs, circle: position", 2),
            ("arm-euler/train", "arm-euler/validation", "arm, Euler: both angles", 2),
            ("arm-rk4/train", "arm-rk4/validation", "arm, RK4: both angles", 2),
            ("leg-walk/train", "leg-walk/test", "soft leg, walk: tip", 2),
        ]
        .into_iter()
        .map(|(training, folder, title, states)| {
            test(training, folder).map(|t| horizon(t, title, states))
        })
        .collect(),
        3,
    );
    add(
        "convergence.svg",
        "Convergence of the estimate to the Koopman operator",
        converging(&results.convergence),
        2,
    );
    figures
}

fn series(name: &str, colour: [u8; 3], style: Style, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.to_owned(), colour, style, points }
}

/// What the figures compare: the paper's dictionary one step ahead and rolled out, and the
/// recommended one rolled out. Rows of all states, the true first sample ahead of each.
fn predictions(test: &TestResult) -> Vec<(&'static str, [u8; 3], Style, Vec<f64>)> {
    let n = test.states.len();
    let from_start = |rows: &[f64]| [&test.measured[..n], rows].concat();
    let mut found = Vec::new();
    if let Some(evaluation) = test.score(Method::AcdEdmd).and_then(|s| s.evaluation.as_ref()) {
        let steps = from_start(&evaluation.example_steps);
        found.push(("ACD-EDMD, one step ahead", BLUE, Style::Points, steps));
        found.push((
            "ACD-EDMD, rolled out from the start",
            RED,
            Style::Line,
            from_start(&evaluation.example),
        ));
    }
    if let Some(evaluation) = test.score(Method::Recommended).and_then(|s| s.evaluation.as_ref()) {
        let rollout = from_start(&evaluation.example);
        found.push(("recommended dictionary, rolled out", GREEN, Style::Dashed, rollout));
    }
    found
}

/// The states as `name [unit]`.
fn label(test: &TestResult, i: usize) -> String {
    format!("{} [{}]", test.states[i], test.units[i])
}

/// The first two states as a map.
fn path(test: &TestResult, title: &str) -> Chart {
    let n = test.states.len();
    let points = |rows: &[f64]| rows.chunks_exact(n).map(|x| (x[0], x[1])).collect();
    let mut all = vec![series("true", BLACK, Style::Line, points(&test.measured))];
    all.extend(
        predictions(test).into_iter().map(|(name, c, style, x)| series(name, c, style, points(&x))),
    );
    Chart {
        title: title.to_owned(),
        x: label(test, 0),
        y: label(test, 1),
        axes: Axes::Equal,
        series: all,
    }
}

/// One state over time.
fn over_time(test: &TestResult, i: usize, part: &str) -> Chart {
    let n = test.states.len();
    let points = |rows: &[f64]| {
        let times = (0..).map(|k| f64::from(k) * test.sample_time_s);
        times.zip(rows.chunks_exact(n)).map(|(t, x)| (t, x[i])).collect()
    };
    let mut all = vec![series("true", BLACK, Style::Line, points(&test.measured))];
    all.extend(
        predictions(test).into_iter().map(|(name, c, style, x)| series(name, c, style, points(&x))),
    );
    Chart {
        title: format!("{part}: {}", test.states[i]),
        x: "time [s]".to_owned(),
        y: label(test, i),
        axes: Axes::Free,
        series: all,
    }
}

/// The arm's links at a few instants, and the paths of its end.
fn arm(test: &TestResult, title: &str) -> Chart {
    /// L1 = L2 = 1 m.
    fn links(angles: &[f64]) -> Vec<(f64, f64)> {
        let (first, both) = (angles[0], angles[0] + angles[1]);
        let elbow = (libm::cos(first), libm::sin(first));
        vec![(0.0, 0.0), elbow, (elbow.0 + libm::cos(both), elbow.1 + libm::sin(both))]
    }
    let end = |rows: &[f64]| rows.chunks_exact(2).map(|x| links(x)[2]).collect();
    let samples: Vec<&[f64]> = test.measured.chunks_exact(2).collect();
    let last = samples.len().saturating_sub(1);
    let mut all = Vec::new();
    for k in [10, 20, 30, 40] {
        if let Some(angles) = samples.get(k * last / 50) {
            all.push(series("arm on its way", GREY, Style::Dashed, links(angles)));
        }
    }
    if let (Some(start), Some(finish)) = (samples.first(), samples.last()) {
        all.push(series("arm at the start", [230, 190, 0], Style::Line, links(start)));
        all.push(series("arm at the end", [120, 60, 160], Style::Line, links(finish)));
    }
    all.push(series("true", BLACK, Style::Line, end(&test.measured)));
    all.extend(
        predictions(test).into_iter().map(|(name, c, style, x)| series(name, c, style, end(&x))),
    );
    Chart {
        title: title.to_owned(),
        x: "end of the arm, horizontal [m]".to_owned(),
        y: "vertical [m]".to_owned(),
        axes: Axes::Equal,
        series: all,
    }
}

/// The leg as arcs from the hip to the tip, later ones darker.
fn leg(test: &TestResult) -> Chart {
    /// The hip is this far above the idle tip (mm).
    const HIP: f64 = 65.0;
    const SHOWN: usize = 8;
    // An arc that leaves the hip straight down and ends at the tip turns by twice the angle of its
    // chord.
    let arc = |tip: &[f64]| -> Vec<(f64, f64)> {
        let (across, down) = (tip[0], HIP - tip[1]);
        let chord = libm::sqrt(across * across + down * down);
        let half = libm::atan2(across, down);
        (0..=20)
            .map(|i| {
                let angle = half * f64::from(i) / 20.0;
                let length = if half == 0.0 {
                    chord * f64::from(i) / 20.0
                } else {
                    chord * libm::sin(angle) / libm::sin(half)
                };
                (length * libm::sin(angle), HIP - length * libm::cos(angle))
            })
            .collect()
    };
    let tips: Vec<&[f64]> = test.measured.chunks_exact(2).collect();
    let mut all: Vec<Series> = (0..SHOWN)
        .filter_map(|i| {
            let tip = tips.get(i * tips.len().saturating_sub(1) / (SHOWN - 1))?;
            let shade = (210 - 25 * i) as u8;
            let name = if i + 1 == SHOWN { "leg, darker later" } else { "" };
            Some(series(name, [shade; 3], Style::Line, arc(tip)))
        })
        .collect();
    let path = tips.iter().map(|tip| (tip[0], tip[1])).collect();
    all.push(series("true", BLACK, Style::Dashed, path));
    Chart {
        title: "the leg on its way".to_owned(),
        x: label(test, 0),
        y: label(test, 1),
        axes: Axes::Equal,
        series: all,
    }
}

/// Root mean square error over the first `states` states after each step.
fn horizon(test: &TestResult, title: &str, states: usize) -> Chart {
    let n = test.states.len();
    let all = test.scores.iter().filter_map(|score| {
        let evaluation = score.evaluation.as_ref()?;
        let points = evaluation
            .by_step
            .chunks_exact(n)
            .zip(1..)
            .map(|(row, step)| (f64::from(step), libm::sqrt(row[..states].iter().sum())));
        let style = match score.method {
            Method::NoMotion | Method::Arx => Style::Dashed,
            _ => Style::Line,
        };
        Some(series(score.method.name(), colour(score.method), style, points.collect()))
    });
    Chart {
        title: title.to_owned(),
        x: format!("steps of {} s", test.sample_time_s),
        y: format!("RMS error [{}]", test.units[0]),
        axes: Axes::LogY,
        series: all.collect(),
    }
}

fn converging(study: &Convergence) -> Vec<Option<Chart>> {
    const COLOURS: [[u8; 3]; 5] = [GREY, [23, 190, 207], BLUE, GREEN, RED];
    let chart = |title: &str, y: &str, values: &dyn Fn(usize) -> Vec<Option<f64>>| {
        let all = study.columns.iter().zip(COLOURS).enumerate().map(|(i, (column, colour))| {
            let samples = study.samples.iter().map(|m| *m as f64);
            let points = samples.zip(values(i)).filter_map(|(m, v)| Some((m, v?))).collect();
            series(&format!("N = {} terms", column.terms), colour, Style::Line, points)
        });
        Chart {
            title: title.to_owned(),
            x: "samples M".to_owned(),
            y: y.to_owned(),
            axes: Axes::LogLog,
            series: all.collect(),
        }
    };
    vec![
        Some(chart("leading eigenvalue", "distance to the exact one", &|i| {
            study.columns[i].eigenvalue_error.clone()
        })),
        Some(chart("prediction of the next x", "RMS error", &|i| {
            study.columns[i].prediction_error.clone()
        })),
    ]
}
