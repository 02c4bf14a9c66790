//! The results of [`reproduce`](crate::reproduce) as Markdown.

use std::fmt::Write as _;

use crate::convergence::{Column, Convergence};
use crate::report::{grouped, significant};
use crate::reproduce::{Method, Reproduction, SystemResult, TestResult};

/// Three significant digits.
fn brief(x: f64) -> String {
    match x.abs() {
        size if !size.is_finite() => "diverged".to_owned(),
        0.0 => "0".to_owned(),
        size if !(1e-3..1e5).contains(&size) => format!("{x:.1e}"),
        size => format!("{x:.*}", (2 - libm::floor(libm::log10(size)) as i32).max(0) as usize),
    }
}

fn list(values: impl Iterator<Item = String>) -> String {
    format!("[{}]", values.collect::<Vec<_>>().join(", "))
}

/// A Markdown table with aligned columns; the first row is the header.
fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| {
        rows.iter().filter_map(|r| r.get(c)).map(|t| t.chars().count()).max().unwrap_or(0).max(3)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        for (cell, width) in row.iter().zip(&widths) {
            let _ = write!(text, "| {cell:width$} ");
        }
        text += "|\n";
        if i == 0 {
            for width in &widths {
                let _ = write!(text, "|{:-<1$}", "", width + 2);
            }
            text += "|\n";
        }
    }
    text
}

impl Reproduction {
    /// The first line of the report.
    pub const HEADING: &str = "# The paper's experiments, run again";

    /// The report as Markdown; every number but those in columns headed "paper" was computed from
    /// the logs.
    pub fn text(&self) -> String {
        let mut text = format!(
            "{}\n\n\
             Logs: `firmware-sim record paper`, seed {}. One-step MSE: the mean squared error of one \
             prediction from each true sample, as in the paper, in the paper's units: `mm` for a \
             position measured in metres stands for 1000 × m², `m` for m², `rad` for rad², and `mm` \
             for the tip of the soft leg for mm². Rollout MSE: from the first sample on, each step \
             from the prediction before it, mean over all steps, in squared units of the state. \
             Angles are compared on the circle. Columns headed *paper* are the paper's printed \
             figures; all others are computed.\n\n\
             The linear ARX has the number of lags (0 to 5) that is best on the scored data, for one \
             step and for the rollout each. Where a method looks back further than the first sample, \
             the robot is taken to have rested there; the ARX may also use as many lags as there are \
             samples, whichever is better. ACD-EDMD, the recommended dictionary and the Hermite \
             polynomials predict with the controller's f32 code: exact motion is exact to about \
             1e-15 m².\n",
            Self::HEADING,
            self.seed
        );
        text += &self.summary();
        for system in &self.systems {
            let _ = write!(
                text,
                "\n## {}\n\nTrained on {}: {}. {} trajectories, {} snapshot pairs.\n",
                system.title,
                system.training,
                system.plant,
                grouped(system.trajectories as u64),
                grouped(system.pairs as u64)
            );
            if system.seen != system.seen_by_the_paper {
                let _ = write!(
                    text,
                    "\n**Not all methods see the same.** ACD-EDMD is made of {} as in the paper; all \
                     other methods are given {}, and so is *{}*.\n",
                    system.seen_by_the_paper.join(" and "),
                    system.seen.join(", "),
                    Method::AcdEdmdWhole.name()
                );
            }
            text += &system.sizes();
            for test in &system.tests {
                text += &test.text();
            }
        }
        text + "\n## Convergence\n\n" + &self.convergence.text()
    }

    /// Training times as Markdown: they differ from run to run.
    pub fn times(&self) -> String {
        let mut text =
            "## Training times\n\nOne thread, from trajectories in memory to a model; the \
             best of three runs where one takes less than a second. The paper's times are those of \
             its own machine and programs. Seconds.\n\n"
                .to_owned();
        let methods: Vec<Method> =
            Method::ALL.into_iter().filter(|m| *m != Method::NoMotion).collect();
        let mut rows = vec![vec!["training logs".to_owned(), "pairs".to_owned()]];
        rows[0].extend(methods.iter().map(|m| m.name().to_owned()));
        let mut printed = Vec::new();
        for system in &self.systems {
            let find = |m: &Method| system.times.iter().find(|t| t.method == *m);
            let mut row = vec![system.training.clone(), grouped(system.pairs as u64)];
            row.extend(methods.iter().map(|m| {
                find(m).and_then(|t| t.seconds).map_or_else(|| "–".to_owned(), significant)
            }));
            rows.push(row);
            let published = |m: &Method| find(m).and_then(|t| t.published_seconds);
            let all: Vec<Option<f64>> = methods.iter().map(&published).collect();
            // The paper timed each robot once.
            if all.iter().any(Option::is_some) && !printed.contains(&all) {
                printed.push(all);
                let mut row = vec!["paper".to_owned(), String::new()];
                row.extend(
                    methods
                        .iter()
                        .map(|m| published(m).map_or_else(String::new, |s| s.to_string())),
                );
                rows.push(row);
            }
        }
        text += &table(&rows);
        for (system, time) in self.systems.iter().flat_map(|s| s.times.iter().map(move |t| (s, t)))
        {
            if let Some(reason) = &time.failed {
                let name = time.method.name();
                let _ = write!(text, "\n{}: {name} has no model: {reason}\n", system.training);
            }
        }
        text
    }
}

impl TestResult {
    fn text(&self) -> String {
        let states = |units: &mut dyn Iterator<Item = String>| {
            list(self.states.iter().zip(units).map(|(s, u)| format!("{s} {u}")))
        };
        let mut text = format!(
            "\n### {}\n\n{}: {}. {} of {} samples.",
            self.title,
            self.folder,
            self.input,
            match self.trajectories {
                1 => "1 trajectory".to_owned(),
                n => format!("{n} trajectories"),
            },
            self.steps
        );
        if let Some(plant) = &self.plant {
            let _ = write!(text, " The robot: {plant}.");
        }
        if self.stand_in {
            text += " The paper's measurements were never published; another robot stands in for \
                     theirs, so that no comparison with the paper's figures is meant.";
        }
        text += "\n\n";
        let paper = self.scores.iter().any(|s| s.published.is_some());
        let mut header = vec![
            "method".to_owned(),
            format!("one-step MSE {}", states(&mut self.paper_units.iter().map(|u| u.1.clone()))),
        ];
        if paper {
            header.push("paper".to_owned());
        }
        header.push(format!(
            "rollout MSE, {} steps {}",
            self.steps,
            states(&mut self.units.iter().map(|u| format!("{u}²")))
        ));
        let mut rows = vec![header];
        for score in &self.scores {
            let name = score.method.name().to_owned();
            let one_step = score.one_step.iter().zip(&self.paper_units);
            let mut row = vec![name, list(one_step.map(|(x, (factor, _))| brief(x * factor)))];
            if paper {
                let published = score.published.as_ref();
                row.push(published.map_or_else(String::new, |p| list(p.iter().cloned())));
            }
            row.push(match score.diverged {
                0 => list(score.rollout.iter().copied().map(brief)),
                diverged => format!("diverged in {diverged} of {}", self.trajectories),
            });
            rows.push(row);
        }
        text + &table(&rows)
    }
}

impl SystemResult {
    /// How many numbers each method has found.
    fn sizes(&self) -> String {
        let sizes: Vec<String> = self
            .times
            .iter()
            .filter_map(|t| Some(format!("{} {}", t.method.name(), grouped(t.numbers? as u64))))
            .collect();
        format!("\nNumbers in the model that are not 0: {}.\n", sizes.join("; "))
    }
}

impl Reproduction {
    /// The paper's own figures beside ours, and where the recommended dictionary is not the best.
    fn summary(&self) -> String {
        let mut rows = vec![
            [
                "test",
                "ACD-EDMD: paper, one step",
                "ours, one step",
                "ours, rollout",
                "recommended, rollout",
            ]
            .map(str::to_owned)
            .to_vec(),
        ];
        let mut behind = String::new();
        for (system, test) in self.systems.iter().flat_map(|s| s.tests.iter().map(move |t| (s, t)))
        {
            let errors =
                |method, pick: fn(&crate::reproduce::MethodScore) -> &Vec<f64>, scaled: bool| {
                    test.score(method).map_or_else(String::new, |score| {
                        let scale = |i: usize| if scaled { test.paper_units[i].0 } else { 1.0 };
                        list(pick(score).iter().enumerate().map(|(i, x)| brief(x * scale(i))))
                    })
                };
            let own = test.score(Method::AcdEdmd);
            let published = own.and_then(|s| s.published.as_ref());
            let stand_in = if test.stand_in { " (stand-in)" } else { "" };
            rows.push(vec![
                format!("{}{stand_in}", test.folder)
                    + if system.training.starts_with("rosbot") { ", own logs" } else { "" },
                published.map_or_else(String::new, |p| list(p.iter().cloned())),
                errors(Method::AcdEdmd, |s| &s.one_step, true),
                errors(Method::AcdEdmd, |s| &s.rollout, false),
                errors(Method::Recommended, |s| &s.rollout, false),
            ]);
            let Some(recommended) = test.score(Method::Recommended) else { continue };
            for (i, state) in test.states.iter().enumerate() {
                let better = test.scores.iter().filter(|s| {
                    s.method != Method::Recommended && s.rollout[i] < recommended.rollout[i]
                });
                let best = better.min_by(|a, b| a.rollout[i].total_cmp(&b.rollout[i]));
                if let Some(best) = best {
                    let _ = writeln!(
                        behind,
                        "- {} (trained on {}), {state}: {} {} against {}",
                        test.folder,
                        system.training,
                        best.method.name(),
                        brief(best.rollout[i]),
                        brief(recommended.rollout[i])
                    );
                }
            }
        }
        let mut text = format!(
            "\n## Summary\n\nUnits as in the tables below; the first two columns in the paper's.\n\n{}",
            table(&rows)
        );
        if !behind.is_empty() {
            text += "\nRollouts in which another method beats the recommended dictionary:\n\n";
            text += &behind;
        }
        text
    }
}

impl Convergence {
    fn text(&self) -> String {
        let cells = |pick: fn(&Column) -> &[Option<f64>]| {
            let mut rows = vec![vec!["samples M".to_owned()]];
            rows[0].extend(self.columns.iter().map(|c| format!("N = {}", c.terms)));
            for (i, samples) in self.samples.iter().enumerate() {
                let mut row = vec![grouped(*samples as u64)];
                row.extend(self.columns.iter().map(|c| {
                    pick(c).get(i).copied().flatten().map_or_else(|| "–".to_owned(), brief)
                }));
                rows.push(row);
            }
            table(&rows)
        };
        format!(
            "The map x⁺ = 2 asinh({0} sinh(x/2)) with x from N(0, 1), the weight of the paper's theorem: \
             its Koopman operator has the eigenvalue {0} with the eigenfunction sinh(x/2), which no \
             finite sum of Hermite polynomials is. Estimated from M samples over N polynomials; root \
             mean squares over {1} draws.\n\n\
             Error of the predicted next x under the Gaussian weight: falls with M to a floor that \
             falls with N.\n\n{3}\n\
             Distance from {0} to the nearest eigenvalue of the estimate: falls with N. With few \
             samples, all in the middle of the Gaussian where the map is nearly a polynomial, it is \
             smaller than in the limit of many.\n\n{2}",
            self.eigenvalue,
            self.draws,
            cells(|c| &c.eigenvalue_error),
            cells(|c| &c.prediction_error)
        )
    }
}
