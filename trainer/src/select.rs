//! The search for the sparse model with the best honest rollout that fits a controller budget.
//!
//! A candidate is a [`Frame`], some terms of its [library] that all outputs share, and a ridge. It is
//! fitted on columns of unit norm in every fold from one pass's Gram sums, rolled out in f32 over the
//! windows of [`score`], and scored by their NRMSE. The order of the search is fixed;
//! a limit on time or candidates only cuts it, so that the same number of candidates gives the same
//! result, whatever the number of threads and whatever is read back from the journal.
//!
//! 1. Every frame is screened with linear models and with terms added by one-step gain alone
//!    (orthogonal least squares on the Gram sums). The best [`FRAMES`] go on.
//! 2. From several starts (the best linear model, sets left by sequential thresholding of the whole
//!    library (Brunton, Proctor & Kutz 2016), sets grown by gain) terms are dropped until the budget
//!    holds, then added, dropped and exchanged, always by the rollout error.
//! 3. The best ones are tried along a path of ridges, and cut down term by term, which makes the
//!    cheap end of the front.
//! 4. Some models of the front are [refined](crate::refine) by their rollouts, in every fold, held
//!    less and less firmly while that helps. No limit cuts this.
//!
//! A candidate that diverges in any window, or leaves the range of the data widened by [`MARGIN`] of
//! its width on both sides (states on ℝ that the symmetry does not exclude), is rejected. The best
//! one and the winner have to hold that in the training windows of every fold, too.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use firmware_core::cost::Cost;
use firmware_core::model::{Symmetry, Target};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::arx::MAX_LAGS;
use crate::library::{Chain, Frame, MAX_CHAIN, MAX_LIBRARY_LAG, Term, library};
use crate::report::hexadecimal;
use crate::robot::{FitOptions, Robot, ScoreOptions};
use crate::score::{self, Counts, Lifted, ScoreError};
use crate::sparse_fit::{
    Data, Model, Outcome, Problem, Refinement, Windows, evaluate, roll_out, stress,
};
pub use crate::sparse_fit::{MARGIN, Rejection};
use crate::terms::{Names, robot_names};
use crate::trajectory::{InMemory, Trajectories, Trajectory, collect_named};

/// Frames that are searched after the screening.
pub const FRAMES: usize = 2;
/// Ridges tried, on columns of unit norm; the smallest are for logs without noise.
pub const RIDGES: [f64; 9] = [1e-12, 1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2];
/// Models of the front that are refined.
const REFINED: usize = 8;
/// Coefficients of a model that is refined: the time for it grows with their square, and larger models
/// gain little.
const REFINED_COEFFICIENTS: usize = 240;
/// How firmly the one-step fit holds a refinement, as far as each is better than the one before.
pub const KAPPAS: [f64; 5] = [1.0, 0.1, 0.01, 0.001, 1e-4];
/// A refinement that gains less than this fraction of the error is not worth having.
const WORTH_REFINING: f64 = 0.01;
/// The ridge of the search.
const RIDGE: f64 = 1e-6;
/// Terms whose addition, or removal, is tried in one round; more where fewer bring no gain.
const WIDTHS: [usize; 3] = [12, 40, 400];
/// A frame whose error in the screening is this many times the best one's is not searched.
const HOPELESS: f64 = 1.5;
/// The winner's error is at most this fraction above the best one's: with few trajectories a standard
/// error is itself uncertain, and can be a large part of the error.
pub const TOLERANCE: f64 = 0.1;
/// Differences in NRMSE below this are the rounding of f32.
const ROUNDING: f64 = 1e-6;
/// A gain below this fraction of the error is none.
const GAIN: f64 = 1e-4;

/// What a model may take, and how long the search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Instructions of one step, by [`cost`](firmware_core::cost).
    pub instructions: u32,
    /// Bytes of the blob.
    pub bytes: u32,
    /// Terms, the constant not counted.
    pub terms: usize,
    /// Oldest sample looked at.
    pub lag: usize,
    /// Candidates evaluated, refinements not counted.
    pub candidates: usize,
    /// Time before the front is refined; where it cuts depends on the machine, and [`Selection::searched`] says how far it came.
    pub time: Duration,
}

impl Default for Budget {
    fn default() -> Self {
        Self {
            instructions: u32::MAX,
            bytes: u32::MAX,
            terms: 60,
            lag: usize::from(MAX_LIBRARY_LAG),
            candidates: usize::MAX,
            time: Duration::from_secs(80),
        }
    }
}

/// How to search.
#[derive(Clone, Debug)]
pub struct Options {
    /// The budget.
    pub budget: Budget,
    /// Horizon, stride and folds; trajectories that `hold_out` matches are not looked at.
    pub score: ScoreOptions,
    /// Threads that evaluate candidates; the result does not depend on it.
    pub threads: usize,
    /// Evaluated candidates are kept in this file, one JSON object a line, and read back from it.
    pub journal: Option<PathBuf>,
}

/// How far the search is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Candidates evaluated.
    pub evaluated: usize,
    /// Smallest NRMSE within the budget.
    pub best: f64,
}

/// Why there is no selection.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SelectError<E> {
    /// The data cannot be read, or hold no window.
    #[error(transparent)]
    Score(ScoreError<E>),
    /// The journal cannot be read or written.
    #[error("{}: the journal cannot be used: {source}", path.display())]
    Journal {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The budget is too small for any model, or all candidates diverge.
    #[error(
        "none of {evaluated} candidates fits the budget without diverging; the cheapest takes \
         {instructions} instructions and {bytes} bytes"
    )]
    Nothing {
        /// Candidates evaluated.
        evaluated: usize,
        /// Of the cheapest.
        instructions: u32,
        /// Of the cheapest.
        bytes: u32,
    },
}

/// An evaluated model.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Index into [`Selection::frames`].
    pub frame: usize,
    /// Terms as robot.toml has them; the constant is implicit.
    pub terms: Vec<String>,
    /// Ridge on columns of unit norm.
    pub ridge: f64,
    /// How firmly the one-step fit holds its refinement by rollouts; `None`: it is not refined.
    pub refine: Option<f64>,
    /// What it takes.
    pub cost: Cost,
    /// Whether the budget and the controller have room for it.
    pub fits: bool,
    /// NRMSE of the rollouts; infinite when rejected.
    pub nrmse: f64,
    /// RMSE over all steps per state, in its unit; by what the search scores by, as `nrmse`.
    pub rmse: Vec<f64>,
    /// NRMSE and RMSE per state over all windows, as `trainer fit` scores, where a search looks at some
    /// of them; of the models of the front.
    pub cross_validated: Option<(f64, Vec<f64>)>,
    /// Squared errors per unit (trajectory or block) and state.
    sums: Vec<Vec<f64>>,
    /// Why it is not in the race.
    pub rejected: Option<Rejection>,
}

impl Candidate {
    /// NRMSE over all windows where that is known, otherwise over those that the search looks at.
    pub fn error(&self) -> f64 {
        self.cross_validated.as_ref().map_or(self.nrmse, |e| e.0)
    }

    /// RMSE per state that [`error`](Self::error) is made of.
    pub fn rmse(&self) -> &[f64] {
        self.cross_validated.as_ref().map_or(&self.rmse, |e| &e.1)
    }
}

/// The result of a search.
#[derive(Clone, Debug)]
pub struct Selection {
    /// The robot's name.
    pub robot: String,
    /// Names and units of the states.
    pub states: Vec<(String, String)>,
    /// Names of the trajectories that were not held out.
    pub trajectories: Vec<String>,
    /// Frames that candidates refer to.
    pub frames: Vec<Frame>,
    /// All candidates in the order of their evaluation, refinements last.
    pub candidates: Vec<Candidate>,
    /// Candidates without refinements: with as many at the most, a search is repeated exactly.
    pub searched: usize,
    /// Within the budget and not rejected, none of them worse and dearer than another: indices,
    /// cheapest first.
    pub front: Vec<usize>,
    /// The smallest NRMSE within the budget.
    pub best: usize,
    /// The cheapest within one standard error of the best, and within [`TOLERANCE`] of it.
    pub winner: usize,
    /// One standard error of the best one's NRMSE.
    pub standard_error: f64,
    /// NRMSE of no motion.
    pub no_motion: f64,
    /// NRMSE of the best linear ARX, and its lags.
    pub arx: (f64, usize),
    /// Windows, horizon, and units that the standard error is over.
    pub scored: (usize, usize, usize),
    /// The budget.
    pub budget: Budget,
    /// Seconds that the search took, for the report.
    pub seconds: f64,
    /// RMSE per state and NRMSE of the best and the winner on what `hold_out` matches, refitted on
    /// the rest; `None` when they diverge there.
    pub held_out: Vec<(usize, Option<Tested>)>,
}

/// Errors on data that a model was not fitted to.
#[derive(Clone, Debug, PartialEq)]
pub struct Tested {
    /// RMSE over all steps per state, in its unit.
    pub rmse: Vec<f64>,
    /// NRMSE, by the spread of the test data.
    pub nrmse: f64,
}

/// What the journal keeps of a candidate: numbers as their bits, so that they come back exactly.
#[derive(Serialize, Deserialize)]
struct Line {
    key: String,
    nrmse: Option<f64>,
    sums: Vec<Vec<u64>>,
    rejected: Option<Rejection>,
}

struct Journal {
    known: HashMap<String, Outcome>,
    file: Option<(PathBuf, File)>,
}

impl Journal {
    fn open(path: Option<&Path>) -> Result<Self, (PathBuf, std::io::Error)> {
        let Some(path) = path else { return Ok(Self { known: HashMap::new(), file: None }) };
        let open = || {
            let mut file = OpenOptions::new().create(true).append(true).read(true).open(path)?;
            let mut bytes = Vec::new();
            file.seek(SeekFrom::Start(0))?;
            file.read_to_end(&mut bytes)?;
            if bytes.last().is_some_and(|b| *b != b'\n') {
                file.write_all(b"\n")?;
            }
            let mut known = HashMap::new();
            // A torn line is not JSON.
            for line in bytes.split(|b| *b == b'\n') {
                if let Ok(line) = serde_json::from_slice::<Line>(line) {
                    let sums =
                        line.sums.iter().map(|u| u.iter().map(|b| f64::from_bits(*b)).collect());
                    let outcome = line.rejected.map_or_else(|| Ok(sums.collect()), Err);
                    known.insert(line.key, outcome);
                }
            }
            Ok((known, file))
        };
        let (known, file) = open().map_err(|source| (path.to_owned(), source))?;
        Ok(Self { known, file: Some((path.to_owned(), file)) })
    }

    fn append(
        &mut self,
        key: &str,
        nrmse: f64,
        outcome: &Outcome,
    ) -> Result<(), (PathBuf, std::io::Error)> {
        let Some((path, file)) = &mut self.file else { return Ok(()) };
        let sums = outcome.as_ref().map_or(&[][..], |sums| &sums[..]);
        let line = Line {
            key: key.to_owned(),
            nrmse: nrmse.is_finite().then_some(nrmse),
            sums: sums.iter().map(|u| u.iter().map(|x| x.to_bits()).collect()).collect(),
            rejected: outcome.as_ref().err().cloned(),
        };
        let mut text = serde_json::to_string(&line).unwrap_or_default();
        text.push('\n');
        file.write_all(text.as_bytes()).map_err(|source| (path.clone(), source))
    }
}

struct Search<'s> {
    data: &'s Data,
    problems: Vec<Problem<'s>>,
    frames: &'s [Frame],
    options: &'s Options,
    journal: Journal,
    known: HashMap<Model, usize>,
    models: Vec<Model>,
    candidates: Vec<Candidate>,
    started: Instant,
    progress: &'s dyn Fn(Progress),
    best: f64,
    failed: Option<(PathBuf, std::io::Error)>,
}

impl<'s> Search<'s> {
    /// Nothing more may be evaluated.
    fn over(&self) -> bool {
        let budget = &self.options.budget;
        self.failed.is_some()
            || self.candidates.len() >= budget.candidates
            || self.started.elapsed() >= budget.time
    }

    /// Hash of everything that a score depends on.
    fn key(&self, (frame, terms, ridge): &Model, refine: Option<f64>) -> String {
        let problem = &self.problems[*frame];
        let mut hash = Sha256::new();
        let names: Vec<&str> = terms.iter().map(|t| problem.names[*t].as_str()).collect();
        let score = &self.options.score;
        let what = format!(
            "2 {:?} {:?} {ridge:x} {} {} {} {MARGIN}",
            self.frames[*frame],
            names,
            score.horizon,
            score.stride,
            self.data.plan.folds()
        );
        hash.update(what.as_bytes());
        hash.update(self.data.hash);
        if let Some(kappa) = refine {
            hash.update(format!("refined {kappa:e}"));
        }
        let digest: [u8; 32] = hash.finalize().into();
        hexadecimal(&digest[..16])
    }

    /// Evaluates what is not known yet, as far as the budget goes: index of every candidate.
    fn batch(&mut self, sets: Vec<Model>) -> Vec<Option<usize>> {
        let mut new: Vec<Model> = Vec::new();
        let room =
            if self.over() { 0 } else { self.options.budget.candidates - self.candidates.len() };
        for set in &sets {
            if new.len() < room && !self.known.contains_key(set) && !new.contains(set) {
                new.push(set.clone());
            }
        }
        let keys: Vec<String> = new.iter().map(|set| self.key(set, None)).collect();
        let known: Vec<Option<Outcome>> =
            keys.iter().map(|key| self.journal.known.get(key).cloned()).collect();
        let next = AtomicUsize::new(0);
        let this: &Self = self;
        let problems = (&this.problems[..], this.data);
        let work = || {
            let mut done = Vec::new();
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                match (new.get(i), known.get(i)) {
                    (Some(set), Some(None)) => {
                        done.push((i, evaluate(problems, set, None, &this.data.searched)))
                    }
                    (Some(_), _) => {}
                    _ => return done,
                }
            }
        };
        let threads = self.options.threads.clamp(1, new.len().max(1));
        let mut outcomes: Vec<Option<Outcome>> = known.clone();
        std::thread::scope(|scope| {
            let helpers: Vec<_> = (1..threads).map(|_| scope.spawn(work)).collect();
            let mut done = work();
            for helper in helpers {
                done.extend(helper.join().unwrap_or_default());
            }
            for (i, outcome) in done {
                outcomes[i] = Some(outcome);
            }
        });
        for (((set, key), known), outcome) in new.into_iter().zip(keys).zip(known).zip(outcomes) {
            let Some(outcome) = outcome else { continue };
            self.known.insert(set.clone(), self.candidates.len());
            self.take(set, None, (&key, known.is_none()), &outcome);
        }
        (self.progress)(Progress { evaluated: self.candidates.len(), best: self.best });
        sets.iter().map(|set| self.known.get(set).copied()).collect()
    }

    /// Takes an evaluated candidate, which goes into the journal if it is new.
    fn take(
        &mut self,
        set: Model,
        refine: Option<f64>,
        (key, is_new): (&str, bool),
        outcome: &Outcome,
    ) {
        let candidate = Candidate { refine, ..self.candidate(&set, outcome) };
        if is_new && let Err(error) = self.journal.append(key, candidate.nrmse, outcome) {
            self.failed = Some(error);
        }
        if candidate.fits {
            self.best = self.best.min(candidate.nrmse);
        }
        self.models.push(set);
        self.candidates.push(candidate);
    }

    /// How a candidate's fits are refined.
    fn refinement(&self, refine: Option<f64>) -> Option<Refinement<'s>> {
        let threads = self.options.threads;
        refine.map(|kappa| Refinement { data: self.data, kappa, threads })
    }

    /// Refines models evenly spread over the front, the best among them.
    fn refine_front(&mut self) {
        let mut front = pareto(&self.candidates);
        front.retain(|i| {
            let (frame, terms, _) = &self.models[*i];
            (terms.len() + 1) * self.problems[*frame].outputs <= REFINED_COEFFICIENTS
        });
        let count = front.len().min(REFINED);
        for i in (1..=count).map(|i| front[i * front.len() / count - 1]) {
            let set = self.models[i].clone();
            let worth = self.candidates[i].nrmse * (1.0 - WORTH_REFINING);
            self.refine(&set, worth, f64::INFINITY);
        }
        // Of the best one a small gain may be followed by larger ones.
        if let Some(best) = self.leader(None, 1).first().copied()
            && let Some(held) = self.candidates[best].refine
        {
            let set = self.models[best].clone();
            self.refine(&set, self.candidates[best].nrmse, held);
        }
    }

    /// Refines a model, held less and less firmly, as far as each is better than the error before.
    fn refine(&mut self, set: &Model, mut error: f64, held: f64) {
        for kappa in KAPPAS.into_iter().filter(|kappa| *kappa < held) {
            let refine = Some(kappa);
            let key = self.key(set, refine);
            let known = self.journal.known.get(&key).cloned();
            let is_new = known.is_none();
            let outcome = known.unwrap_or_else(|| {
                let problems = (&self.problems[..], self.data);
                evaluate(problems, set, self.refinement(refine), &self.data.searched)
            });
            self.take(set.clone(), refine, (&key, is_new), &outcome);
            (self.progress)(Progress { evaluated: self.candidates.len(), best: self.best });
            let found = self.candidates.last().map_or(f64::INFINITY, |c| c.nrmse);
            if found >= error {
                break;
            }
            error = found;
        }
    }

    fn candidate(&self, (frame, terms, ridge): &Model, outcome: &Outcome) -> Candidate {
        let problem = &self.problems[*frame];
        let (cost, fits) = self.cost(*frame, terms);
        let sums = outcome.clone().unwrap_or_default();
        let (rmse, nrmse) = match outcome {
            Ok(sums) => self.data.errors(&self.data.searched, sums, None),
            Err(_) => (Vec::new(), f64::INFINITY),
        };
        let terms = terms.iter().map(|t| problem.names[*t].clone()).collect();
        let rejected = outcome.as_ref().err().cloned();
        Candidate {
            frame: *frame,
            terms,
            ridge: f64::from_bits(*ridge),
            refine: None,
            cost,
            fits,
            nrmse,
            rmse,
            cross_validated: None,
            sums,
            rejected,
        }
    }

    fn cost(&self, frame: usize, terms: &[usize]) -> (Cost, bool) {
        let problem = &self.problems[frame];
        let chain = problem.chain(terms);
        let Ok(structure) = chain.structure(&problem.repr) else { return (Cost::REFUSED, false) };
        let (cost, budget) = (chain.cost(&structure), &self.options.budget);
        let fits = cost != Cost::REFUSED
            && cost.instructions <= budget.instructions
            && cost.bytes <= budget.bytes
            && chain.len() - 1 <= budget.terms
            && chain.fits();
        (cost, fits)
    }

    fn score(&self, index: Option<usize>) -> f64 {
        index.map_or(f64::INFINITY, |i| self.candidates[i].nrmse)
    }

    fn one(&mut self, frame: usize, terms: &[usize], ridge: u64) -> Option<usize> {
        self.batch(vec![(frame, terms.to_vec(), ridge)])[0]
    }

    /// The sets without one of their terms, at most `count`: those first that explain the least of
    /// what would be left of the targets.
    fn drops(&self, frame: usize, terms: &[usize], ridge: u64, count: usize) -> Vec<Model> {
        let mut order: Vec<usize> = (0..terms.len()).collect();
        if terms.len() > count {
            let losses = self.problems[frame].losses(terms, f64::from_bits(ridge));
            order.sort_by(|a, b| losses[*a].total_cmp(&losses[*b]).then(a.cmp(b)));
            order.truncate(count);
        }
        order.iter().map(|i| (frame, [&terms[..*i], &terms[i + 1..]].concat(), ridge)).collect()
    }

    /// Index and score of the best of some sets, those that fit the budget if asked.
    fn best_of(&mut self, sets: Vec<Model>, fitting: bool) -> Option<(usize, f64)> {
        let found = self.batch(sets);
        let allowed = |i: &usize| !fitting || self.candidates[*i].fits;
        let found =
            found.into_iter().flatten().filter(allowed).map(|i| (i, self.candidates[i].nrmse));
        found.filter(|(_, e)| e.is_finite()).min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The terms that explain most of what is left, without a look at rollouts.
    fn shortlist(&self, frame: usize, terms: &[usize], count: usize) -> Vec<usize> {
        let mut residual = self.problems[frame].residual.clone();
        terms.iter().for_each(|t| residual.explain(t + 1));
        residual.shortlist(count)
    }

    /// Drops terms, several at a time while there are many, until the budget holds.
    fn shrink(&mut self, frame: usize, mut terms: Vec<usize>, ridge: u64) -> Vec<usize> {
        while !terms.is_empty() && !self.cost(frame, &terms).1 && !self.over() {
            let sets = self.drops(frame, &terms, ridge, WIDTHS[1]);
            let found = self.batch(sets.clone());
            let mut order: Vec<(usize, f64)> =
                found.iter().enumerate().map(|(i, index)| (i, self.score(*index))).collect();
            order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
            // What a set does not have is what was dropped from it.
            let count = (terms.len() / 12).max(1);
            let dropped: Vec<&[usize]> =
                order.iter().take(count).map(|(i, _)| &sets[*i].1[..]).collect();
            terms.retain(|t| dropped.iter().all(|left| left.contains(t)));
        }
        terms
    }

    /// Adds, drops and exchanges terms as long as the rollouts gain, but never adds the banned one;
    /// looks further where there is no gain. Returns the best candidate.
    fn climb(
        &mut self,
        frame: usize,
        start: Vec<usize>,
        ridge: u64,
        banned: Option<usize>,
    ) -> Option<usize> {
        let mut terms = self.shrink(frame, start, ridge);
        let mut present = self.one(frame, &terms, ridge);
        let mut error = self.score(present);
        let (mut added, mut level) = (0, 0);
        while !self.over() && level < WIDTHS.len() {
            let width = WIDTHS[level];
            let list = self.shortlist(frame, &terms, width);
            let with = |t: &usize| (frame, inserted(&terms, *t), ridge);
            let sets: Vec<Model> = list.iter().filter(|t| Some(**t) != banned).map(with).collect();
            let better = |found: &(usize, f64)| found.1 < error * (1.0 - GAIN);
            let mut moved = self.best_of(sets.clone(), true).filter(better);
            added += usize::from(moved.is_some());
            if moved.is_none() || added % 3 == 0 {
                // Dropping a term that does no harm makes room.
                let sets = self.drops(frame, &terms, ridge, width);
                let dropped = self.best_of(sets, true).filter(better);
                let gain = moved.map_or(f64::INFINITY, |m| m.1);
                moved = dropped.filter(|d| d.1 < gain).or(moved);
            }
            if moved.is_none() {
                moved = self.exchange(frame, &sets, ridge, width).filter(better);
            }
            match moved {
                Some((index, found)) => {
                    (terms, present, error) = (self.models[index].1.clone(), Some(index), found);
                    level = 0;
                }
                None => level += 1,
            }
        }
        present
    }

    /// The best of the sets with one term more, less what makes them fit the budget again.
    fn exchange(
        &mut self,
        frame: usize,
        sets: &[Model],
        ridge: u64,
        width: usize,
    ) -> Option<(usize, f64)> {
        let found = self.batch(sets.to_vec());
        let mut order: Vec<(usize, f64)> =
            found.into_iter().flatten().map(|i| (i, self.candidates[i].nrmse)).collect();
        order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        let mut best: Option<(usize, f64)> = None;
        for (index, _) in order.into_iter().take((width / 3).min(12)) {
            let mut terms = self.models[index].1.clone();
            loop {
                let sets = self.drops(frame, &terms, ridge, width);
                let Some(found) = self.best_of(sets, false) else { break };
                terms = self.models[found.0].1.clone();
                if self.candidates[found.0].fits {
                    best = best.filter(|b| b.1 <= found.1).or(Some(found));
                    break;
                }
            }
        }
        best
    }

    /// Linear models: states (or harmonics) and inputs now, increments and inputs up to each lag.
    fn linear(&self, frame: usize) -> Vec<Vec<usize>> {
        use crate::library::Kind;
        let problem = &self.problems[frame];
        let mut sets = Vec::new();
        for (increments, inputs) in [
            (0, 0),
            (0, 1),
            (0, 2),
            (0, 3),
            (0, 5),
            (1, 1),
            (2, 2),
            (3, 3),
            (5, 5),
            (1, 0),
            (2, 0),
            (3, 0),
            (5, 0),
        ] {
            let wanted = |t: &Term| match t.functions() {
                [f] if f.degree == 1 => match f.kind {
                    Kind::Increment => f.lag <= increments,
                    Kind::Input => f.lag <= inputs,
                    _ => true,
                },
                _ => false,
            };
            sets.push((0..problem.terms.len()).filter(|t| wanted(&problem.terms[*t])).collect());
        }
        sets
    }

    /// Terms in the order of their one-step gain, behind some that are there.
    fn grown(&self, frame: usize, base: &[usize], count: usize) -> Vec<usize> {
        let mut residual = self.problems[frame].residual.clone();
        base.iter().for_each(|t| residual.explain(t + 1));
        let mut order = base.to_vec();
        while order.len() < count {
            let Some(next) = residual.shortlist(1).first().copied() else { break };
            residual.explain(next + 1);
            order.push(next);
        }
        order
    }

    /// What is left of the whole library by sequential thresholding: a term stays while its
    /// root-mean-square contribution to some target is above a fraction of that target's.
    fn thresholded(&self, frame: usize, ridge: f64) -> Vec<Vec<usize>> {
        let problem = &self.problems[frame];
        let mut kept: Vec<usize> = (0..problem.terms.len()).collect();
        let (all, _) = problem.sums(&kept, None);
        let (width, m) = (1 + kept.len() + problem.outputs, problem.outputs);
        let rms = |column: usize| all[column * width + column].sqrt();
        let mut sets = Vec::new();
        for threshold in [1e-3, 3e-3, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.3] {
            for _ in 0..10 {
                let Some(matrix) = problem.fit(&kept, ridge, None) else { return sets };
                let share = |k: usize, t: usize| {
                    let of = |o: usize| {
                        (matrix[(k + 1) * m + o] * rms(t + 1)).abs() / rms(width - m + o)
                    };
                    (0..m).map(of).fold(0.0_f64, f64::max)
                };
                let left: Vec<usize> = kept
                    .iter()
                    .enumerate()
                    .filter(|(k, t)| share(*k, **t) >= threshold)
                    .map(|(_, t)| *t)
                    .collect();
                let done = left.len() == kept.len();
                kept = left;
                if done {
                    break;
                }
            }
            sets.push(kept.clone());
        }
        sets.dedup();
        sets
    }

    /// The whole search, in its fixed order.
    fn run(&mut self) {
        let ridge = RIDGE.to_bits();
        // Screening.
        let mut order: Vec<(usize, f64)> = Vec::new();
        for frame in 0..self.problems.len() {
            let linear = self.linear(frame);
            let mut sets = linear.clone();
            let grown = self.grown(frame, &linear[0], 250);
            for count in [4, 8, 12, 16, 24, 32, 48, 64, 96, 128, 160, 200, 250] {
                sets.push(grown[..count.min(grown.len())].to_vec());
            }
            let sets = sets.into_iter().map(|s| (frame, sorted(s), ridge)).collect();
            order.push((frame, self.best_of(sets, false).map_or(f64::INFINITY, |b| b.1)));
        }
        order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        let limit = order.first().map_or(0.0, |best| best.1 * HOPELESS);
        order.retain(|frame| frame.1 <= limit);
        for (frame, _) in order.into_iter().take(FRAMES) {
            self.frame(frame);
        }
        // Then on from the best, whatever its frame: without each of its terms in turn.
        let mut tried = None;
        while let Some(best) = self.leader(None, 1).first().copied()
            && tried != Some(best)
        {
            tried = Some(best);
            let (frame, terms, ridge) = self.models[best].clone();
            self.ridges(&[best]);
            for banned in terms.iter().rev() {
                let left = terms.iter().filter(|t| *t != banned).copied().collect();
                self.climb(frame, left, ridge, Some(*banned));
            }
        }
    }

    fn frame(&mut self, frame: usize) {
        let start = RIDGE.to_bits();
        let thresholded: Vec<Model> = [1e-6, 1e-4]
            .iter()
            .flat_map(|r| self.thresholded(frame, *r))
            .map(|s| (frame, sorted(s), start))
            .collect();
        self.batch(thresholded);
        // The ridge that suits the best ones so far.
        let ridge = self.ridges(&self.leader(Some(frame), 3)).unwrap_or(start);
        // Starts: the best sets of different sizes, and the simplest.
        let mut starts: Vec<Vec<usize>> = Vec::new();
        // Large ones first where they are asked for: from small ones it is a long way.
        let large = (self.options.budget.terms > 100).then_some((100, MAX_CHAIN));
        for (low, high) in large.into_iter().chain([(0, 20), (20, 50), (50, 100)]) {
            let best = (0..self.candidates.len())
                .filter(|i| {
                    let c = &self.candidates[*i];
                    c.frame == frame && (low..high).contains(&c.terms.len()) && c.nrmse.is_finite()
                })
                .min_by(|a, b| self.candidates[*a].nrmse.total_cmp(&self.candidates[*b].nrmse));
            starts.extend(best.map(|i| self.models[i].1.clone()));
        }
        starts.push(self.linear(frame)[0].clone());
        for start in starts {
            self.climb(frame, start, ridge, None);
        }
        let best = self.leader(Some(frame), 3);
        if let Some(better) = self.ridges(&best)
            && better != ridge
        {
            self.climb(frame, self.models[best[0]].1.clone(), better, None);
        }
        // The cheap end of the front.
        if let Some(best) = self.leader(Some(frame), 1).first().copied() {
            let (_, mut terms, ridge) = self.models[best].clone();
            while terms.len() > 1 && !self.over() {
                let sets = self.drops(frame, &terms, ridge, WIDTHS[1]);
                let Some((index, _)) = self.best_of(sets, false) else { break };
                terms = self.models[index].1.clone();
            }
        }
    }

    /// The best candidates within the budget, of a frame if asked.
    fn leader(&self, frame: Option<usize>, count: usize) -> Vec<usize> {
        let fits = |i: &usize| {
            let c = &self.candidates[*i];
            frame.is_none_or(|f| c.frame == f) && c.fits && c.nrmse.is_finite()
        };
        let mut order: Vec<usize> = (0..self.candidates.len()).filter(fits).collect();
        order.sort_by(|a, b| self.candidates[*a].nrmse.total_cmp(&self.candidates[*b].nrmse));
        order.truncate(count);
        order
    }

    /// Candidates along the path of ridges; the best ridge.
    fn ridges(&mut self, candidates: &[usize]) -> Option<u64> {
        let sets: Vec<Model> = candidates
            .iter()
            .map(|i| self.models[*i].clone())
            .flat_map(|(frame, terms, _)| RIDGES.map(|r| (frame, terms.clone(), r.to_bits())))
            .collect();
        self.best_of(sets, true).map(|(i, _)| self.models[i].2)
    }
}

fn sorted(mut terms: Vec<usize>) -> Vec<usize> {
    terms.sort_unstable();
    terms.dedup();
    terms
}

fn inserted(terms: &[usize], term: usize) -> Vec<usize> {
    sorted([terms, &[term]].concat())
}

/// The trajectories whose names are wanted, with their names.
fn collect<T: Trajectories>(
    source: &T,
    wanted: &dyn Fn(&str) -> bool,
) -> Result<Vec<(String, Trajectory)>, T::Error> {
    let mut trajectories = collect_named(source)?;
    trajectories.retain(|(name, _)| wanted(name));
    Ok(trajectories)
}

/// Searches the best sparse model of a robot; its own dictionary and fit are not looked at.
///
/// The data are held in memory, beside the sums of every frame: about 1.3 MB, or 2.9 MB for an arm, for
/// each fold and each number of lags up to five.
///
/// # Errors
/// [`SelectError`].
pub fn select<T: Trajectories>(
    robot: &Robot,
    source: &T,
    options: &Options,
    progress: &dyn Fn(Progress),
) -> Result<Selection, SelectError<T::Error>> {
    let started = Instant::now();
    let held_out = |name: &str| score::matches_any(&options.score.hold_out, name);
    let read = |wanted: &dyn Fn(&str) -> bool| {
        collect(source, wanted).map_err(|e| SelectError::Score(ScoreError::Trajectories(e)))
    };
    let trajectories = read(&|name| !held_out(name))?;
    let data = Data::new(robot, &trajectories, &options.score, Windows::CrossValidated);
    if data.all.windows.is_empty() {
        let need = MAX_LAGS + 1 + data.horizon;
        return Err(SelectError::Score(ScoreError::NoWindow { need, first: MAX_LAGS }));
    }
    let journal = |(path, source)| SelectError::Journal { path, source };
    let mut frames = Frame::all(robot);
    let mut problems = Vec::new();
    frames.retain(|frame| {
        let mut terms = library(robot, frame);
        terms.retain(|term| term.lag() <= options.budget.lag);
        let problem = Problem::new(robot, frame, terms, &data);
        let possible = problem.is_some();
        problems.extend(problem);
        possible
    });
    let mut search = Search {
        data: &data,
        problems,
        frames: &frames,
        options,
        journal: Journal::open(options.journal.as_deref()).map_err(journal)?,
        known: HashMap::new(),
        models: Vec::new(),
        candidates: Vec::new(),
        started,
        progress,
        best: f64::INFINITY,
        failed: None,
    };
    search.run();
    let searched = search.candidates.len();
    search.refine_front();
    if let Some(failed) = search.failed {
        return Err(journal(failed));
    }
    let mut candidates = std::mem::take(&mut search.candidates);
    let chosen = loop {
        let Some(chosen) = choose(&candidates, &data) else { break None };
        // The two that matter have to stay in range in the training windows of every fold as well.
        let shaky = [chosen.1, chosen.2].map(|i| {
            let refinement = search.refinement(candidates[i].refine);
            (i, stress(&search.problems, &data, &search.models[i], refinement))
        });
        if shaky.iter().all(|(_, rejected)| rejected.is_none()) {
            break Some(chosen);
        }
        for (i, rejected) in shaky.into_iter().filter(|s| s.1.is_some()) {
            candidates[i].rejected = rejected;
            candidates[i].nrmse = f64::INFINITY;
        }
    };
    if let Some((front, ..)) = &chosen {
        for i in front {
            let refinement = search.refinement(candidates[*i].refine);
            let problems = (&search.problems[..], &data);
            let sums = evaluate(problems, &search.models[*i], refinement, &data.all);
            candidates[*i].cross_validated = sums.ok().map(|sums| {
                let (rmse, nrmse) = data.errors(&data.all, &sums, None);
                (nrmse, rmse)
            });
        }
    }
    drop(search);
    let Some((front, best, winner, standard_error)) = chosen else {
        let cheapest = candidates.iter().map(|c| c.cost).min().unwrap_or_default();
        let Cost { instructions, bytes } = cheapest;
        return Err(SelectError::Nothing { evaluated: candidates.len(), instructions, bytes });
    };
    let (names, plain) = trajectories.into_iter().unzip();
    let (no_motion, arx) = baselines(robot, plain, &options.score).map_err(SelectError::Score)?;
    let mut selection = Selection {
        robot: robot.name.clone(),
        states: robot.states.iter().map(|s| (s.name.clone(), s.unit.clone())).collect(),
        trajectories: names,
        scored: (data.all.windows.len(), data.horizon, data.all.steps.len()),
        budget: options.budget,
        seconds: 0.0,
        held_out: Vec::new(),
        frames,
        candidates,
        searched,
        front,
        best,
        winner,
        standard_error,
        no_motion,
        arx,
    };
    let others = read(&held_out)?;
    for candidate in [best, winner].into_iter().filter(|_| !others.is_empty()) {
        let tested =
            selection.test_on(robot, &data, &others, candidate, (&options.score, MAX_LAGS));
        selection.held_out.push((candidate, tested));
    }
    selection.seconds = started.elapsed().as_secs_f64();
    Ok(selection)
}

/// Front, best, winner, standard error of the best.
fn choose(candidates: &[Candidate], data: &Data) -> Option<(Vec<usize>, usize, usize, f64)> {
    let front = pareto(candidates);
    let best = *front.last()?;
    let standard_error =
        data.jackknife(|u| data.errors(&data.searched, &candidates[best].sums, u).1);
    let most = standard_error.min(TOLERANCE * candidates[best].nrmse);
    let winner = one_standard_error(candidates, &front, most)?;
    Some((front, best, winner, standard_error))
}

/// Candidates in the race of which none is beaten in both cost and error, cheapest first.
fn pareto(candidates: &[Candidate]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..candidates.len())
        .filter(|i| candidates[*i].fits && candidates[*i].nrmse.is_finite())
        .collect();
    let rank = |c: &Candidate| (c.cost.instructions, c.terms.len());
    order.sort_by(|a, b| {
        let (a, b) = (&candidates[*a], &candidates[*b]);
        rank(a).cmp(&rank(b)).then(a.nrmse.total_cmp(&b.nrmse))
    });
    let mut lowest = f64::INFINITY;
    order.retain(|i| {
        let better = candidates[*i].nrmse < lowest;
        lowest = lowest.min(candidates[*i].nrmse);
        better
    });
    order
}

/// The cheapest of the front (sorted by cost, then terms; the best one last) whose error is at most so
/// much above that of the best.
fn one_standard_error(candidates: &[Candidate], front: &[usize], most: f64) -> Option<usize> {
    let best = candidates[*front.last()?].nrmse;
    front.iter().copied().find(|i| candidates[*i].nrmse <= best + most.max(ROUNDING))
}

/// NRMSE of no motion, and of the best ARX and its lags, on the same windows.
fn baselines<E>(
    robot: &Robot,
    trajectories: Vec<Trajectory>,
    options: &ScoreOptions,
) -> Result<(f64, (f64, usize)), ScoreError<E>> {
    let (n, m) = (robot.states.len(), robot.inputs.len());
    let source = InMemory { trajectories: &trajectories, states: n, inputs: m };
    let rows: usize = trajectories.iter().map(|t| t.states.len() / n).sum();
    let counts = Counts { trajectories: trajectories.len(), rows: rows as u64 };
    let frame = Frame { symmetry: Symmetry::None, targets: vec![Target::Increment; n] };
    let Ok(structure) = Chain::new(&[]).structure(&frame.repr(robot)) else {
        return Ok((f64::NAN, (f64::NAN, 0)));
    };
    let fit = FitOptions { ridge: RIDGE, ..FitOptions::default() };
    let plain = ScoreOptions { hold_out: Vec::new(), ..options.clone() };
    let score = score::score(
        &source,
        counts,
        Lifted::Fitted(&structure, None, &fit),
        &plain,
        None,
        &|_| {},
    )
    .map_err(|error| match error {
        ScoreError::Trajectories(never) => match never {},
        ScoreError::NoWindow { need, first } => ScoreError::NoWindow { need, first },
        ScoreError::Untrained { fold } => ScoreError::Untrained { fold },
        ScoreError::HoldOut { matched, of } => ScoreError::HoldOut { matched, of },
        ScoreError::Write(error) => ScoreError::Write(error),
    })?;
    let nrmse = |i: usize| score.contenders.get(i).map_or(f64::NAN, |c| c.nrmse);
    Ok((nrmse(1), (nrmse(2), score.arx_lags)))
}

impl Selection {
    /// RMSE per state over `options.horizon` steps, and NRMSE (by the spread of the test data), of a
    /// candidate fitted on all of `training` that `options.hold_out` does not match. Windows of
    /// `test` begin behind `first` samples; it is at least the model's lag.
    ///
    /// # Errors
    /// The trajectories' own.
    pub fn test<T: Trajectories>(
        &self,
        robot: &Robot,
        (training, test): (&T, &T),
        candidate: usize,
        (options, first): (&ScoreOptions, usize),
    ) -> Result<Option<Tested>, T::Error> {
        let training = collect(training, &|name| !score::matches_any(&options.hold_out, name))?;
        let data = Data::new(robot, &training, options, Windows::CrossValidated);
        let test = collect(test, &|_| true)?;
        Ok(self.test_on(robot, &data, &test, candidate, (options, first)))
    }

    fn test_on(
        &self,
        robot: &Robot,
        data: &Data,
        test: &[(String, Trajectory)],
        candidate: usize,
        (options, first): (&ScoreOptions, usize),
    ) -> Option<Tested> {
        let candidate = self.candidates.get(candidate)?;
        let (states, inputs) = robot_names(robot);
        let names = Names { states: &states, inputs: &inputs };
        let terms: Vec<Term> =
            candidate.terms.iter().map(|t| Term::parse(t, &names)).collect::<Option<_>>()?;
        let all: Vec<usize> = (0..terms.len()).collect();
        let first = terms.iter().map(Term::lag).max().unwrap_or(0).max(first);
        let problem = Problem::new(robot, &self.frames[candidate.frame], terms, data)?;
        let chain = problem.chain(&all);
        let refinement = candidate.refine.map(|kappa| Refinement { data, kappa, threads: 1 });
        let model = problem.coefficients(&chain, &all, candidate.ridge, None, refinement)?;
        let test = Data::new(robot, test, options, Windows::Tested { first });
        // What the test itself does is no divergence.
        let both =
            data.range.iter().zip(&test.range).map(|(a, b)| [a[0].min(b[0]), a[1].max(b[1])]);
        let range: Vec<[f64; 2]> = both.collect();
        let sums =
            roll_out((&test, &test.all), &problem, &chain, Some(vec![(None, model)]), &range)
                .ok()?;
        let (rmse, nrmse) = test.errors(&test.all, &sums, None);
        (!test.all.windows.is_empty()).then_some(Tested { rmse, nrmse })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware_core::Scalar;
    use rand::{RngExt, SeedableRng};

    const CART: &str = "name = \"cart\"\nsample_time_s = 0.1\n# kept\n[[states]]\nname = \"x\"\nspace = \"R\"\n\
        [[inputs]]\nname = \"u\"\nrange = [-1, 1]\n[dictionary]\nblocks = [\n  { factors = [\"x\"] },\n]\n\
        [fit]\nridge = 1e-3\n[score]\nstride = 4\nfolds = 3\nhorizon = 20\n";
    const WHEEL: &str = "name = \"wheel\"\nsample_time_s = 0.1\n[[states]]\nname = \"p\"\nspace = \"S1\"\ntarget = \"increment\"\n\
        [[inputs]]\nname = \"u\"\nrange = [-1, 1]\n[score]\nstride = 4\nfolds = 3\nhorizon = 20\n";

    fn robot(text: &str) -> Robot {
        Robot::parse(text, Path::new("robot.toml")).unwrap()
    }

    /// Trajectories of one state under random inputs: `next(x, u, u before)`.
    fn simulate(next: impl Fn(f64, f64, f64) -> f64) -> Vec<Trajectory> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let one = |_| {
            let inputs: Vec<f64> = (0..80).map(|_| random.random_range(-1.0..1.0)).collect();
            let mut states = vec![random.random_range(-1.0..1.0)];
            for k in 0..79 {
                states.push(next(states[k], inputs[k], if k > 0 { inputs[k - 1] } else { 0.0 }));
            }
            // The first step has no input before it.
            Trajectory { states: states[1..].to_vec(), inputs: inputs[1..].to_vec() }
        };
        (0..6).map(one).collect()
    }

    fn bilinear() -> Vec<Trajectory> {
        simulate(|x, u, before| 0.8 * x + 0.5 * before + 0.3 * x * u)
    }

    fn options(robot: &Robot, candidates: usize) -> Options {
        let budget = Budget { candidates, time: Duration::MAX, ..Budget::default() };
        Options { budget, score: robot.score.clone(), threads: 1, journal: None }
    }

    fn search(robot: &Robot, trajectories: &[Trajectory], options: &Options) -> Selection {
        let source = InMemory { trajectories, states: 1, inputs: 1 };
        select(robot, &source, options, &|_| {}).unwrap()
    }

    #[test]
    fn a_bilinear_system_with_a_lag_is_found() {
        let robot = robot(CART);
        let found = search(&robot, &bilinear(), &options(&robot, 400));
        let winner = &found.candidates[found.winner];
        assert_eq!(winner.terms, ["x", "u@1", "x*u"], "{}", found.report());
        assert!(winner.nrmse < 1e-4, "{}", winner.nrmse);
        assert!(found.arx.0 > 0.05 && found.no_motion > 0.5);

        // The description it is written as: the rest is kept, and everything is TOML.
        let text = found.robot_toml(CART, found.winner);
        let (old, new): (toml::Table, toml::Table) = (CART.parse().unwrap(), text.parse().unwrap());
        assert!(text.contains("# kept") && !text.contains("factors"));
        assert_eq!((&old["score"], &old["inputs"]), (&new["score"], &new["inputs"]));
        let terms: Vec<&str> = new["dictionary"]["terms"]
            .as_array()
            .unwrap()
            .iter()
            .filter_map(|t| t.as_str())
            .collect();
        assert_eq!(terms, winner.terms);
        assert!(new["states"][0]["target"].as_str().is_some());
        let figure = found.figure();
        assert!(figure.starts_with("<svg") && figure.contains("winner"));
    }

    #[test]
    fn a_harmonic_is_found_and_tested_on_other_data() {
        let mut robot = robot(WHEEL);
        let walk = simulate(|p, u, _| p + 0.2 * u + 0.1 * Scalar::sin_cos(2.0 * p).0);
        robot.score.hold_out = vec!["trajectory 5".into()];
        let found = search(&robot, &walk, &options(&robot, 300));
        assert_eq!(found.candidates[found.winner].terms, ["u", "sin(2*p)"], "{}", found.report());
        let [_, (winner, Some(Tested { rmse, .. }))] = &found.held_out[..] else {
            panic!("{:?}", found.held_out)
        };
        assert!(*winner == found.winner && rmse[0] < 1e-4);
        assert!(!found.trajectories.contains(&"trajectory 5".to_owned()));
    }

    #[test]
    fn threads_and_a_torn_journal_change_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal.jsonl");
        let (robot, walk) = (robot(CART), bilinear());
        let mut options = options(&robot, 150);
        options.journal = Some(path.clone());
        let first = search(&robot, &walk, &options);
        assert_eq!(first.searched, 150);
        let all = first.candidates.len();
        assert!(all > 150, "the front is refined");
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), all);
        std::fs::write(&path, &text[..text.len() / 2]).unwrap();
        options.threads = 3;
        let second = search(&robot, &walk, &options);
        assert_eq!((&first.front, first.winner), (&second.front, second.winner));
        assert_eq!(first.candidates, second.candidates);
        // Everything is known now, and only the torn line is evaluated and written again.
        let lines = std::fs::read_to_string(&path).unwrap();
        assert_eq!(lines.lines().filter(|l| serde_json::from_str::<Line>(l).is_ok()).count(), all);
        let third = search(&robot, &walk, &options);
        assert_eq!(
            (first.candidates, lines),
            (third.candidates, std::fs::read_to_string(&path).unwrap())
        );
    }

    #[test]
    fn the_budget_holds_and_an_impossible_one_is_refused() {
        let (robot, walk) = (robot(CART), bilinear());
        let mut options = options(&robot, 120);
        options.budget.instructions = 350;
        let found = search(&robot, &walk, &options);
        assert!(found.front.iter().all(|i| found.candidates[*i].cost.instructions <= 350));
        assert!(found.candidates[found.winner].terms.len() <= 2);
        options.budget.bytes = 10;
        let source = InMemory { trajectories: &walk, states: 1, inputs: 1 };
        let refused = select(&robot, &source, &options, &|_| {});
        assert!(matches!(refused, Err(SelectError::Nothing { evaluated: 1.., .. })));
        let short = InMemory { trajectories: &[Trajectory::default()], ..source };
        assert!(matches!(select(&robot, &short, &options, &|_| {}), Err(SelectError::Score(_))));
    }

    #[test]
    fn no_older_sample_is_looked_at_than_asked() {
        let (robot, walk) = (robot(CART), bilinear());
        let mut options = options(&robot, 200);
        options.budget.lag = 0;
        let found = search(&robot, &walk, &options);
        let terms = found.candidates.iter().flat_map(|c| &c.terms);
        assert!(terms.clone().count() > 0 && terms.clone().all(|t| !t.contains('@')));
    }

    #[test]
    fn the_cheapest_within_one_standard_error_wins() {
        let candidate = |instructions, nrmse| Candidate {
            frame: 0,
            terms: vec!["u".into()],
            ridge: 1e-6,
            refine: None,
            cost: Cost { instructions, bytes: 0 },
            fits: true,
            nrmse,
            rmse: vec![],
            cross_validated: None,
            sums: vec![],
            rejected: None,
        };
        let mut table: Vec<Candidate> =
            [(500, 0.10), (400, 0.11), (300, 0.13), (350, 0.14), (200, 0.5)]
                .map(|(i, e)| candidate(i, e))
                .into();
        let mut dear = candidate(100, 0.01);
        dear.fits = false;
        table.push(dear);
        let front = pareto(&table);
        assert_eq!(front, [4, 2, 1, 0]);
        assert_eq!(one_standard_error(&table, &front, 0.015), Some(1));
        assert_eq!(one_standard_error(&table, &front, 0.035), Some(2));
        assert_eq!(one_standard_error(&table, &front, 0.0), Some(0));
        assert_eq!(one_standard_error(&table, &[], 0.0), None);
    }

    #[test]
    fn a_prediction_that_leaves_the_range_is_rejected_with_its_place() {
        let robot = robot(CART);
        let walk: Vec<(String, Trajectory)> =
            bilinear().into_iter().map(|t| (String::new(), t)).collect();
        let data = Data::new(&robot, &walk, &robot.score, Windows::CrossValidated);
        let names = Names { states: &["x"], inputs: &["u"] };
        let terms = vec![Term::parse("x", &names).unwrap()];
        let frame = Frame { symmetry: Symmetry::None, targets: vec![Target::Absolute] };
        let problem = Problem::new(&robot, &frame, terms, &data).unwrap();
        let chain = problem.chain(&[0]);
        let run = |gain: f32| {
            roll_out(
                (&data, &data.all),
                &problem,
                &chain,
                Some(vec![(None, vec![0.0, gain])]),
                &data.range,
            )
        };
        let stays = run(0.9).unwrap();
        assert_eq!((stays.len(), stays[0].len()), (6, 1));
        let leaves = run(2.0).unwrap_err();
        assert_eq!((leaves.state, leaves.trajectory, leaves.row), (Some(0), 0, MAX_LAGS));
        assert!(leaves.step > 1 && leaves.windows > data.all.windows.len() / 2);
        assert_eq!(run(f32::NAN).unwrap_err().state, None);
        assert_eq!(
            roll_out((&data, &data.all), &problem, &chain, None, &data.range).unwrap_err().windows,
            0
        );
    }
}
