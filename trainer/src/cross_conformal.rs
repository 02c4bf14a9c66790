//! Error bounds where there are no logs to spare: cross-conformal prediction (Vovk 2015,
//! "Cross-conformal predictors", Annals of Mathematics and Artificial Intelligence 74), by whole
//! trajectories.
//!
//! The model is fitted anew without each fold of trajectories, and rolled out over that fold. The
//! bounds of the model that ships, which has seen all of them, come from the errors of all folds: it
//! has seen more than each of the fitted ones, so that its own errors on new data should not be larger,
//! but no theorem says so. How well such bounds hold is measured: for each fold with the bounds that the
//! other folds give.

use std::convert::Infallible;

use crate::conformal::{ConformalError, CoverageReport, Residuals};
use crate::edmd::{self, FitError};
use crate::export::{ExportError, controller_coefficients, controller_model};
use crate::robot::Robot;
use crate::trajectory::{InMemory, Trajectory};

/// Why there are no cross-validated errors.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CrossConformalError {
    /// There is nothing to leave out.
    #[error(
        "--cross-validate leaves out whole trajectories: it needs at least 2, and there is {found}; \
         give other logs than those of the fit and leave it out"
    )]
    Trajectories {
        /// Trajectories found.
        found: usize,
    },
    /// A fold's model cannot be fitted.
    #[error("without fold {fold}: {error}")]
    Fit {
        /// The fold, from 1.
        fold: usize,
        /// Why.
        error: FitError<Infallible>,
    },
    /// A fold's model is refused.
    #[error("without fold {fold}: {error}")]
    Model {
        /// The fold, from 1.
        fold: usize,
        /// Why.
        error: ExportError,
    },
    /// There are no bounds.
    #[error(transparent)]
    Conformal(#[from] ConformalError),
}

/// Errors on each fold of trajectories of models that have not seen it.
#[derive(Clone, Debug, PartialEq)]
pub struct CrossResiduals(Vec<Residuals>);

impl CrossResiduals {
    /// Fits `robot` without each of `robot.score.folds` folds of `trajectories` and rolls it out over
    /// that fold; `least` as in [`Residuals::measure`], `progress` is told the fold, from 1.
    ///
    /// # Errors
    /// [`CrossConformalError`].
    pub fn measure(
        robot: &Robot,
        trajectories: &[Trajectory],
        horizon: usize,
        least: usize,
        progress: &dyn Fn(usize),
    ) -> Result<Self, CrossConformalError> {
        let found = trajectories.len();
        if found < 2 {
            return Err(CrossConformalError::Trajectories { found });
        }
        let (states, inputs) = (robot.states.len(), robot.inputs.len());
        let folds = robot.score.folds.min(found);
        let mut residuals = Vec::with_capacity(folds);
        for fold in 0..folds {
            progress(fold + 1);
            let others = (0..found).filter(|i| i % folds != fold);
            let others: Vec<Trajectory> = others.map(|i| trajectories[i].clone()).collect();
            let source = InMemory { trajectories: &others, states, inputs };
            let fit = edmd::fit(robot, &source, &|_| {})
                .map_err(|error| CrossConformalError::Fit { fold: fold + 1, error })?;
            let dictionary = fit.structure.dictionary();
            let numbers = controller_coefficients(dictionary, fit.chain, &fit.operator);
            let (structure, chain) = (fit.structure, fit.chain);
            let model = controller_model(structure, chain, &numbers, Some(&fit.ranges));
            let model = model.map_err(|error| {
                let error = ExportError::Model(error);
                CrossConformalError::Model { fold: fold + 1, error }
            })?;
            // Whether there are enough trajectories is asked of all, not of one fold.
            let mut own = Residuals::empty(model.structure(), trajectories, horizon, least)?;
            for t in trajectories.iter().skip(fold).step_by(folds) {
                own.add(&model, t);
            }
            residuals.push(own);
        }
        Ok(Self(residuals))
    }

    /// Those of all folds but one, or of all.
    pub fn pooled(&self, except: Option<usize>) -> Residuals {
        let mut kept = self.0.iter().enumerate().filter(|(i, _)| Some(*i) != except);
        let mut all = kept.next().map_or_else(
            || Residuals { errors: Vec::new(), diverged: 0, ..self.0[0].clone() },
            |(_, first)| first.clone(),
        );
        for (_, residuals) in kept {
            all.errors.extend_from_slice(&residuals.errors);
            all.diverged += residuals.diverged;
        }
        all
    }

    /// How often the units of each fold are within the bounds from the others.
    ///
    /// # Errors
    /// [`ConformalError`]: without some fold there is no finite bound.
    pub fn coverage(
        &self,
        coverage: f64,
        names: &[&str],
    ) -> Result<Option<CoverageReport>, ConformalError> {
        let all = self.pooled(None);
        let cells = all.horizon * all.states;
        let (mut within, mut fewest) = (vec![0_usize; cells], usize::MAX);
        for (fold, own) in self.0.iter().enumerate().filter(|(_, own)| own.units() > 0) {
            let others = self.pooled(Some(fold));
            let bounds = others.bounds(coverage)?;
            fewest = fewest.min(others.units());
            for unit in own.errors.chunks_exact(cells) {
                for ((count, error), bound) in within.iter_mut().zip(unit).zip(&bounds) {
                    *count += usize::from(*error <= f64::from(*bound));
                }
            }
        }
        let units = all.units() as f64;
        let shares: Vec<Option<f64>> = within.iter().map(|w| Some(*w as f64 / units)).collect();
        let fewest = u32::try_from(fewest).unwrap_or(u32::MAX);
        let report = CoverageReport::of(coverage, fewest, &all, &shares, names);
        // The folds share their units: chance would allow for a little less.
        Ok(report.map(|report| CoverageReport { chance: None, ..report }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// x⁺ = a x + u with another a in every trajectory: no model fits all of them.
    fn trajectories(gains: &[f64]) -> Vec<Trajectory> {
        let one = |a: &f64| {
            let (mut states, mut inputs, mut x) = (Vec::new(), Vec::new(), 1.0);
            for k in 0..40 {
                let u = f64::from(k * k % 7) - 3.0;
                states.push(x);
                inputs.push(u);
                x = a * x + u;
            }
            Trajectory { states, inputs }
        };
        gains.iter().map(one).collect()
    }

    fn robot(folds: usize) -> Robot {
        let text = format!(
            "name = \"cart\"\nsample_time_s = 0.1\n\
             states = [{{ name = \"x\", space = \"R\", unit = \"m\" }}]\n\
             inputs = [{{ name = \"u\", unit = \"V\", range = [-3, 3] }}]\n\
             [dictionary]\nterms = [\"x\", \"u\"]\nstandardise = false\n[score]\nfolds = {folds}\n"
        );
        Robot::parse(&text, Path::new("robot.toml")).unwrap()
    }

    #[test]
    fn one_model_for_all_leaves_no_error() {
        let logs = trajectories(&[0.5; 4]);
        let cross = CrossResiduals::measure(&robot(4), &logs, 3, 9, &|_| {}).unwrap();
        let all = cross.pooled(None);
        // Blocks of 5 + 1 + 3 rows: four of each trajectory.
        assert_eq!((all.units(), cross.pooled(Some(0)).units()), (16, 12));
        assert!(all.errors.iter().all(|e| *e < 1e-5), "only the rounding of f32");
    }

    #[test]
    fn an_odd_trajectory_is_outside_the_bounds_of_the_others() {
        let logs = trajectories(&[0.5, 0.5, 0.5, 0.9]);
        let cross = CrossResiduals::measure(&robot(4), &logs, 3, 9, &|_| {}).unwrap();
        let report = cross.coverage(0.5, &["x"]).unwrap().unwrap();
        assert_eq!((report.units, report.calibration_units, report.chance), (16, 12, None));
        assert!(report.mean < 0.95, "{}", report.mean);
        // What the odd one has seen of itself is not asked: its blocks are outside.
        let others = cross.pooled(Some(3)).bounds(0.9).unwrap();
        let odd = &cross.0[3];
        assert!(
            odd.errors
                .iter()
                .zip(others.iter().cycle())
                .filter(|(e, b)| **e > f64::from(**b))
                .count()
                > 6
        );
    }

    #[test]
    fn one_trajectory_is_refused() {
        let error = CrossResiduals::measure(&robot(4), &trajectories(&[0.5]), 3, 9, &|_| {});
        let message = error.unwrap_err().to_string();
        assert!(message.contains("at least 2, and there is 1"), "{message}");
    }
}
