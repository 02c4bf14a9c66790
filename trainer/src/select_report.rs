//! What a search found: text, figure, and the robot.toml of a candidate.

use std::collections::BTreeMap;

use firmware_core::model::{Symmetry, Target};

use crate::plot::{self, Axes, Chart, Series, Style};
use crate::report::{grouped, significant};
use crate::select::Selection;
use crate::sparse_fit::{MARGIN, Rejection, SEARCH_WINDOWS};
use firmware_core::cost::Cost;

impl Selection {
    /// What was found, as text.
    pub fn report(&self) -> String {
        let (windows, horizon, units) = self.scored;
        let rejected: Vec<&Rejection> =
            self.candidates.iter().filter_map(|c| c.rejected.as_ref()).collect();
        let mut text = format!(
            "{}: {} candidates and {} refinements of the front in {:.0} s, {} of them rejected; {windows} windows of {horizon} steps, \
             cross-validated over {units} trajectories or blocks.\n\
             `search` is the NRMSE over the windows that the search looks at, at most about {SEARCH_WINDOWS}.\n",
            self.robot,
            grouped(self.searched as u64),
            self.candidates.len() - self.searched,
            self.seconds,
            grouped(rejected.len() as u64),
        );
        text += &format!(
            "NRMSE of no motion {}, of the linear ARX with {} lags {}.\n\n",
            significant(self.no_motion),
            self.arx.1,
            significant(self.arx.0)
        );
        text += "instructions  bytes  terms  refined   search    NRMSE\n";
        for i in &self.front {
            let c = &self.candidates[*i];
            let mark = match *i {
                i if i == self.winner => {
                    "  <- winner: the cheapest within one standard error of the best"
                }
                i if i == self.best => "  <- best",
                _ => "",
            };
            let Cost { instructions, bytes } = c.cost;
            text += &format!(
                "{instructions:12} {bytes:6} {:6} {:>8} {:>8} {:>8}{mark}\n",
                c.terms.len(),
                c.refine.map_or_else(|| "no".to_owned(), |kappa| kappa.to_string()),
                significant(c.nrmse),
                c.cross_validated
                    .as_ref()
                    .map_or_else(|| "diverges".to_owned(), |e| significant(e.0)),
            );
        }
        let (winner, best) = (&self.candidates[self.winner], &self.candidates[self.best]);
        text += &format!(
            "\nbest in the search: {} ± {} (standard error over the trajectories or blocks)\n\
             winner: NRMSE {}; {}; ridge {:e}; {}\n  {}\n",
            significant(best.nrmse),
            significant(self.standard_error),
            significant(winner.error()),
            self.frame_text(winner.frame),
            winner.ridge,
            winner.refine.map_or_else(
                || "one-step fit".to_owned(),
                |kappa| format!("refined by its rollouts, held by {kappa}")
            ),
            winner.terms.join(", "),
        );
        for ((name, unit), rmse) in self.states.iter().zip(winner.rmse()) {
            text += &format!("  RMSE {name}: {} {unit}\n", significant(*rmse));
        }
        for (candidate, tested) in &self.held_out {
            let what = if *candidate == self.winner { "winner" } else { "best" };
            let nrmse = tested.as_ref().map_or(f64::INFINITY, |t| t.nrmse);
            text += &format!(
                "{what} on the held-out trajectories, which the search has not seen: NRMSE {}\n",
                significant(nrmse)
            );
        }
        // Which state failed, how often, and where most of the candidates failed first.
        let mut places: BTreeMap<Option<usize>, Vec<(usize, usize)>> = BTreeMap::new();
        for r in &rejected {
            places.entry(r.state).or_default().push((r.trajectory, r.row));
        }
        for (state, mut places) in places {
            let what = match state {
                Some(i) => format!(
                    "{} left the range of the data widened by {MARGIN} of its width",
                    self.states[i].0
                ),
                None => "no fit, or beyond the finite numbers".to_owned(),
            };
            places.sort_unstable();
            let same = places.chunk_by(|a, b| a == b).max_by_key(|same| same.len()).unwrap_or(&[]);
            let (trajectory, row) = same.first().copied().unwrap_or_default();
            let name = self.trajectories.get(trajectory).map_or("?", |n| n);
            text += &format!(
                "rejected {}: {what}; {} of them first in {name} from row {row}\n",
                places.len(),
                same.len()
            );
        }
        text
    }

    fn frame_text(&self, frame: usize) -> String {
        let name = |i: u8| self.states.get(usize::from(i)).map_or("?", |s| &s.0);
        let symmetry = match self.frames[frame].symmetry {
            Symmetry::None => "no symmetry".to_owned(),
            Symmetry::Translation { coordinates } => {
                let named: Vec<&str> =
                    (0..8).filter(|i| coordinates >> i & 1 == 1).map(name).collect();
                format!("translation of {}", named.join(", "))
            }
            Symmetry::Se2 { x, y, heading } => {
                format!("se2 of {}, {}, {}", name(x), name(y), name(heading))
            }
        };
        let increments =
            self.frames[frame].targets.iter().filter(|t| **t == Target::Increment).count();
        format!("{symmetry}; {increments} of {} states by increments", self.states.len())
    }

    /// Rollout error against instructions, SVG.
    pub fn figure(&self) -> String {
        let point = |i: &usize| {
            let c = &self.candidates[*i];
            (f64::from(c.cost.instructions), c.error())
        };
        let all: Vec<usize> = (0..self.candidates.len())
            .filter(|i| self.candidates[*i].cost != Cost::REFUSED)
            .filter(|i| self.candidates[*i].nrmse <= 2.0 * self.no_motion.max(self.arx.0))
            .collect();
        let (low, high) = all
            .iter()
            .map(|i| point(i).0)
            .fold((f64::INFINITY, 0.0_f64), |(a, b), x| (a.min(x), b.max(x)));
        let level = |y: f64| vec![(low, y), (high, y)];
        let series = |name: &str, colour, style, points| Series {
            name: name.to_owned(),
            colour,
            style,
            points,
        };
        let chart = Chart {
            title: format!("{} windows of {} steps", grouped(self.scored.0 as u64), self.scored.1),
            x: "instructions of a step".to_owned(),
            y: "NRMSE of the rollouts".to_owned(),
            axes: Axes::LogY,
            series: vec![
                series(
                    "evaluated",
                    [200, 200, 200],
                    Style::Points,
                    all.iter().map(point).collect(),
                ),
                series(
                    "front",
                    [31, 119, 180],
                    Style::Line,
                    self.front.iter().map(point).collect(),
                ),
                series("winner", [214, 39, 40], Style::Points, vec![point(&self.winner)]),
                series("linear ARX", [127, 127, 127], Style::Dashed, level(self.arx.0)),
                series("no motion", [0, 0, 0], Style::Dashed, level(self.no_motion)),
            ],
        };
        plot::svg(&format!("{}: what a better prediction costs", self.robot), &[chart], 1)
    }

    /// A whole robot.toml for a candidate: `original` with other targets and its tables `symmetry`,
    /// `dictionary` and `fit` replaced.
    pub fn robot_toml(&self, original: &str, candidate: usize) -> String {
        let c = &self.candidates[candidate];
        let frame = &self.frames[c.frame];
        let mut text = String::new();
        let (mut table, mut state) = (String::new(), 0);
        // What an earlier search said of its winner is not true of this one.
        let said = ["# Found by `trainer select`", "# cross-validated over "];
        for line in original.lines().filter(|line| !said.iter().any(|s| line.starts_with(s))) {
            let bare = line.split('#').next().unwrap_or("").trim();
            let header = bare.trim_start_matches('[').trim_end_matches(']').trim();
            let plain = |c: char| c.is_ascii_alphanumeric() || "_-. ".contains(c);
            let starts = bare.starts_with('[')
                && bare.ends_with(']')
                && !header.is_empty()
                && header.chars().all(plain);
            if starts {
                header.clone_into(&mut table);
            }
            let key =
                if table.is_empty() { bare.split(['=', ' ']).next().unwrap_or("") } else { &table };
            let root = key.split('.').next().unwrap_or("").trim();
            let target =
                table == "states" && bare.split('=').next().unwrap_or("").trim() == "target";
            if ["symmetry", "dictionary", "fit"].contains(&root) || target {
                continue;
            }
            text += line;
            text.push('\n');
            if starts && table == "states" {
                let absolute = frame.targets.get(state) == Some(&Target::Absolute);
                text +=
                    if absolute { "target = \"absolute\"\n" } else { "target = \"increment\"\n" };
                state += 1;
            }
        }
        let name = |i: u8| format!("{:?}", self.states.get(usize::from(i)).map_or("?", |s| &s.0));
        let listed = |names: Vec<String>| names.join(", ");
        let symmetry = match frame.symmetry {
            Symmetry::None => String::new(),
            Symmetry::Translation { coordinates } => {
                let named = (0..8).filter(|i| coordinates >> i & 1 == 1).map(name).collect();
                format!("[symmetry]\nkind = \"translation\"\ncoordinates = [{}]\n\n", listed(named))
            }
            Symmetry::Se2 { x, y, heading } => format!(
                "[symmetry]\nkind = \"se2\"\ncoordinates = [{}]\n\n",
                listed(vec![name(x), name(y), name(heading)])
            ),
        };
        let refine = c.refine.map_or_else(String::new, |kappa| format!("refine = {kappa:?}\n"));
        let terms: String = c.terms.iter().map(|t| format!("    {t:?},\n")).collect();
        let (windows, horizon, units) = self.scored;
        format!(
            "{}\n\n# Found by `trainer select` among {} candidates: NRMSE {} over {windows} windows of {horizon} steps,\n\
             # cross-validated over {units} trajectories or blocks; about {} instructions a step.\n\
             {symmetry}[dictionary]\nstandardise = false\nterms = [\n{terms}]\n\n[fit]\nridge = {:e}\n{refine}",
            text.trim_end(),
            grouped(self.searched as u64),
            significant(c.error()),
            c.cost.instructions,
            c.ridge
        )
    }
}
