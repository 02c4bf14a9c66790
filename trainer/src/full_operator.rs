//! The operator K of a robot on its whole dictionary, under inputs that are held.
//!
//! For prediction only the outputs are regressed, z⁺ = Ψ F with F = K B; the spectrum needs K
//! itself. Terms with an input in them cannot be predicted, for u at the next sample is anyone's
//! choice. So the terms of the state alone, D(x), are regressed on all terms Ψ(x, u), and for an
//! input that stays the same every term is a number g(u) times a term of the state alone: D(x⁺) =
//! D(x) K_u with a square K_u whose entries are polynomials of u.

use std::collections::BTreeMap;

use firmware_core::dictionary::{Basis, Dictionary, Factor, Source, hermite};
use firmware_core::history::{History, Sample};
use firmware_core::model::{Provenance, Space, Structure, Target};

use crate::edmd::{FitError, Operator, Regression, rank_deficient, standardisation};
use crate::recording::{Summary, Visitor};
use crate::robot::Robot;
use crate::spectrum::{Decomposition, SpectrumError};
use crate::terms::{Form, Names, distinct_terms, observable_name, robot_names};
use crate::trajectory::Trajectories;

/// Why there is no full operator.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FullOperatorError<E> {
    /// The least-squares problem has no solution.
    #[error(transparent)]
    Fit(#[from] FitError<E>),
    /// The dictionary lists its terms one by one.
    #[error(
        "{robot} has no spectrum: `[dictionary] terms` lists the terms of its equations, which need \
         not be a space of functions that the operator acts on; give blocks instead"
    )]
    Listed {
        /// The robot.
        robot: String,
    },
    /// The dictionary has no function of the state but the constant, whose eigenvalue is 1.
    #[error(
        "{robot} has no spectrum: the constant is the only term of its dictionary without inputs{}",
        left_out(excluded)
    )]
    NoState {
        /// The robot.
        robot: String,
        /// Coordinates that the symmetry leaves out.
        excluded: Vec<String>,
    },
}

fn left_out(excluded: &[String]) -> String {
    if excluded.is_empty() {
        return "; put states into the dictionary".to_owned();
    }
    let names: Vec<String> = excluded.iter().map(|name| format!("`{name}`")).collect();
    format!(
        ", for the symmetry leaves out {}; delays of states would give it more",
        names.join(", ")
    )
}

/// Why an operator under a held input is not given.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HeldInputError {
    /// Not one value per input.
    #[error("{found} values for {} inputs{}", names.len(), listed(names))]
    Count {
        /// Names of the inputs.
        names: Vec<String>,
        /// Values given.
        found: usize,
    },
    /// Infinite, NaN, or too large for the order of the dictionary.
    #[error("the held inputs are not finite, or too large for the orders of the dictionary")]
    NotFinite,
    /// The operator has no decomposition.
    #[error(transparent)]
    Spectrum(#[from] SpectrumError),
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { String::new() } else { format!(": {}", names.join(", ")) }
}

/// An observable that is a term by itself: a column of B.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// `x`, `sin(phi)`, `cos(phi)`.
    pub name: String,
    /// Unit of the coordinate; empty for sine and cosine.
    pub unit: String,
    /// Name of the coordinate.
    pub coordinate: String,
    /// Whether the robot's model predicts its next value; otherwise its increment.
    pub absolute: bool,
}

/// The full operator of a robot, for any input that is held.
#[derive(Clone, Debug)]
pub struct FullOperator<'r> {
    /// Spaces, dictionary and scaling.
    pub structure: Structure<'r>,
    /// The state-only terms regressed on all terms, shape `[terms, n]`, in Hermite form; its
    /// outputs are the n terms of the state alone.
    pub operator: Operator,
    /// Names of the n terms of the state alone, in Hermite form.
    pub names: Vec<String>,
    /// Mean products of the terms of the state alone over the data, shape `[n, n]`.
    pub moments: Vec<f64>,
    /// The coordinates' observables among the terms, in order: the columns of B.
    pub columns: Vec<Column>,
    /// Observables of coordinates that are not among the terms, and why.
    pub missing: Vec<(String, &'static str)>,
    /// B, shape `[n, columns]`: D(x) B are the observables in their units.
    pub b: Vec<f64>,
    /// What was read.
    pub summary: Summary,
    /// Dense indices of the n terms.
    dense: Vec<usize>,
    /// For every distinct term, the term of the state alone that it is a multiple of, and the
    /// inputs in it.
    parts: Vec<(usize, Vec<(Factor, usize)>)>,
}

impl<'r> FullOperator<'r> {
    /// Fits the operator to all snapshot pairs of all trajectories, with the robot's own options.
    ///
    /// One pass over the data, two when the dictionary is standardised; memory does not grow with
    /// them. The constant is 1 at every sample: its column is not regressed, but exact.
    ///
    /// # Errors
    /// [`FullOperatorError`].
    pub fn fit<T: Trajectories>(
        robot: &'r Robot,
        trajectories: &T,
        progress: &dyn Fn(u64),
    ) -> Result<Self, FullOperatorError<T::Error>> {
        if robot.chain.is_some() {
            return Err(FullOperatorError::Listed { robot: robot.name.clone() });
        }
        let provenance = Provenance { logs: [0; 32], robot: robot.sha256 };
        let structure = |scaling: &[[f32; 2]]| {
            robot.structure(scaling, &robot.limits(), provenance).map_err(FitError::Model)
        };
        let plain = structure(&robot.identity_scaling())?;
        let StateTerms { dense, parts, terms } = StateTerms::new(plain.dictionary());
        let n = dense.len();
        if n < 2 {
            let excluded = |i: &usize| robot.symmetry.excludes(*i as u8);
            let excluded = (0..robot.states.len()).filter(excluded);
            return Err(FullOperatorError::NoState {
                robot: robot.name.clone(),
                excluded: excluded.map(|i| robot.states[i].name.clone()).collect(),
            });
        }
        let structure = match robot.standardise {
            true => structure(&standardisation(robot, trajectories, progress)?)?,
            false => plain,
        };
        let dictionary = structure.dictionary();
        let mut pass = Pass {
            structure: &structure,
            regression: Regression::new(dictionary, None, n, robot.fit.method),
            dense: &dense,
            history: History::default(),
            next: structure.sample(&[]),
            input: vec![0.0; robot.inputs.len()],
            values: vec![0.0; dictionary.observables().len()],
            lifted: vec![0.0; dictionary.dense_terms()],
            later: vec![0.0; dictionary.observables().len()],
            targets: vec![0.0; n],
            moments: vec![0.0; n * n],
            pairs: 0,
            progress,
        };
        let summary = trajectories.visit(&mut pass).map_err(FitError::Trajectories)?;
        let Pass { regression, mut moments, pairs, .. } = pass;
        if pairs == 0 {
            return Err(FitError::NoPairs { need: structure.lag() + 2 }.into());
        }
        for i in 0..n {
            for j in 0..=i {
                let mean = moments[i * n + j] / pairs as f64;
                (moments[i * n + j], moments[j * n + i]) = (mean, mean);
            }
        }
        let mut operator = regression
            .solve(&robot.fit, n)
            .map_err(|dependent| rank_deficient(robot, &structure, &dependent))?;
        let constant = terms[&Key::new()];
        for (i, (row, inputs)) in parts.iter().enumerate() {
            let exact = if *row == constant && inputs.is_empty() { 1.0 } else { 0.0 };
            operator.matrix[i * n + constant] = exact;
        }
        if !operator.matrix.iter().chain(&moments).all(|x| x.is_finite()) {
            return Err(FitError::NotFinite.into());
        }

        let (states, inputs) = robot_names(robot);
        let words = Names { states: &states, inputs: &inputs };
        let names = dense.iter().map(|i| words.term(dictionary, *i, Form::Hermite)).collect();
        let (mut columns, mut missing, mut places) = (Vec::new(), Vec::new(), Vec::new());
        for (i, state) in (0_u8..).zip(&robot.states) {
            let sources = match state.space {
                Space::Line => vec![Source::State(i)],
                Space::Circle => vec![Source::Sin(i), Source::Cos(i)],
            };
            for source in sources {
                let name = observable_name(robot, (source, 0));
                let observables = dictionary.observables();
                let place = observables.iter().position(|o| (o.source, o.lag) == (source, 0));
                let term = place.and_then(|o| terms.get(&vec![(o as u8, Basis::Hermite as u8, 1)]));
                match (place, term) {
                    (Some(place), Some(term)) => {
                        places.push((observables[place], *term));
                        columns.push(Column {
                            name,
                            unit: match state.space {
                                Space::Line => state.unit.clone(),
                                Space::Circle => String::new(),
                            },
                            coordinate: state.name.clone(),
                            absolute: state.target == Target::Absolute,
                        });
                    }
                    _ if robot.symmetry.excludes(i) => {
                        missing.push((name, "left out by the symmetry"));
                    }
                    _ => missing.push((name, "not a term of the dictionary")),
                }
            }
        }
        // v = (raw − centre) gain, so that raw = centre + v / gain.
        let mut b = vec![0.0; n * columns.len()];
        for (j, (o, term)) in places.iter().enumerate() {
            b[term * columns.len() + j] = 1.0 / f64::from(o.gain);
            b[constant * columns.len() + j] = o.centre.into();
        }
        Ok(Self { structure, operator, names, moments, columns, missing, b, summary, dense, parts })
    }

    /// Terms of the state alone, n.
    pub fn terms(&self) -> usize {
        self.dense.len()
    }

    /// K_u, shape `[n, n]`, row-major: D(x⁺) = D(x) K_u while the inputs (in their units, shape
    /// `[inputs]`, at every lag) are held.
    ///
    /// # Errors
    /// [`HeldInputError`].
    pub fn held(&self, input: &[f64]) -> Result<Vec<f64>, HeldInputError> {
        let inputs = self.structure.inputs();
        if input.len() != inputs.len() {
            let names = inputs.iter().map(|u| u.name.to_owned()).collect();
            return Err(HeldInputError::Count { names, found: input.len() });
        }
        let n = self.terms();
        let observables = self.structure.dictionary().observables();
        let mut k = vec![0.0; n * n];
        for ((row, part), coefficients) in self.parts.iter().zip(self.operator.matrix.chunks(n)) {
            let function = |(factor, digit): &(Factor, usize)| {
                let o = observables[usize::from(factor.observable)];
                let Source::Input(i) = o.source else { return 1.0 };
                let mut functions = vec![0.0; digit + 1];
                hermite(o.value(input[usize::from(i)]), &mut functions);
                functions[*digit]
            };
            let weight: f64 = part.iter().map(function).product();
            for (to, c) in k[row * n..][..n].iter_mut().zip(coefficients) {
                *to += weight * c;
            }
        }
        if k.iter().all(|x| x.is_finite()) { Ok(k) } else { Err(HeldInputError::NotFinite) }
    }

    /// The decomposition of [`held`](Self::held), terms measured by their root mean squares over
    /// the data.
    ///
    /// # Errors
    /// [`HeldInputError`].
    pub fn spectrum(&self, input: &[f64]) -> Result<Decomposition, HeldInputError> {
        Ok(Decomposition::new(&self.held(input)?, &self.sizes())?)
    }

    /// Root mean squares of the terms over the data, shape `[n]`; 1 for a term that is always 0.
    pub fn sizes(&self) -> Vec<f64> {
        let n = self.terms();
        let size = |i: usize| self.moments[i * (n + 1)].sqrt();
        (0..n).map(|i| if size(i) > 0.0 { size(i) } else { 1.0 }).collect()
    }

    /// Root mean square of |D(x) ξ| over the data, for ξ of shape `[n]`.
    pub fn root_mean_square(&self, xi: &[(f64, f64)]) -> f64 {
        let form = |part: fn(&(f64, f64)) -> f64| -> f64 {
            let rows = self.moments.chunks_exact(self.terms()).zip(xi);
            rows.map(|(row, x)| part(x) * row.iter().zip(xi).map(|(m, y)| m * part(y)).sum::<f64>())
                .sum()
        };
        // Where the terms cancel each other over all data, rounding may leave less than nothing.
        (form(|z| z.0) + form(|z| z.1)).max(0.0).sqrt()
    }

    /// D(x), shape `[n]`, at a sample with those before it: `states` has shape
    /// `[lag + 1, states]`, oldest first.
    pub fn lift(&self, states: &[f64]) -> Vec<f64> {
        let mut history = History::default();
        for x in states.chunks_exact(self.structure.states().len()) {
            history.push(&self.structure, &[], &self.structure.sample(x));
        }
        let dictionary = self.structure.dictionary();
        let mut values = vec![0.0; dictionary.observables().len()];
        history.observe(&self.structure, &[], &mut values);
        let mut lifted = vec![0.0; dictionary.dense_terms()];
        dictionary.lift_dense(&values, &mut lifted);
        self.dense.iter().map(|i| lifted[*i]).collect()
    }
}

/// A term as a set of basis functions, however its block spells it: observable, kind and number of
/// each. Sine and cosine are first harmonics and H¹ of their observables alike.
type Key = Vec<(u8, u8, usize)>;

fn key(term: &[(Factor, usize)]) -> Key {
    let function = |(factor, digit): &(Factor, usize)| match (factor.basis, digit) {
        (Basis::Fourier, 1) => (factor.observable, Basis::Hermite as u8, 1),
        (Basis::Fourier, 2) => (factor.observable + 1, Basis::Hermite as u8, 1),
        (basis, digit) => (factor.observable, basis as u8, *digit),
    };
    let mut key: Key = term.iter().map(function).collect();
    key.sort_unstable();
    key
}

/// The distinct terms of a dictionary, taken apart into state and input.
struct StateTerms {
    dense: Vec<usize>,
    parts: Vec<(usize, Vec<(Factor, usize)>)>,
    terms: BTreeMap<Key, usize>,
}

impl StateTerms {
    fn new(dictionary: &Dictionary) -> Self {
        let input = |(factor, _): &(Factor, usize)| {
            let source = dictionary.observables()[usize::from(factor.observable)].source;
            matches!(source, Source::Input(_))
        };
        let split = |dense: &usize| {
            let (_, term) = dictionary.term(*dense).unwrap_or_default();
            let (inputs, states): (Vec<_>, Vec<_>) = term.iter().copied().partition(input);
            (*dense, key(&states), inputs)
        };
        let split: Vec<_> = distinct_terms(dictionary).iter().map(split).collect();
        let (mut dense, mut terms) = (Vec::new(), BTreeMap::new());
        for (index, state, _) in split.iter().filter(|(_, _, inputs)| inputs.is_empty()) {
            terms.insert(state.clone(), dense.len());
            dense.push(*index);
        }
        // A block that holds a term holds its state part, too: of lower degree, with digits of 0.
        let parts = split.into_iter().map(|(_, state, inputs)| (terms[&state], inputs)).collect();
        Self { dense, parts, terms }
    }
}

/// The pass over the logs: the state-only terms at the later sample are the targets.
struct Pass<'s, 'r, 'p> {
    structure: &'s Structure<'r>,
    regression: Regression,
    dense: &'s [usize],
    history: History<f64>,
    next: Sample<f64>,
    input: Vec<f64>,
    values: Vec<f64>,
    later: Vec<f64>,
    lifted: Vec<f64>,
    targets: Vec<f64>,
    /// Lower half of ΣDᵀD.
    moments: Vec<f64>,
    pairs: u64,
    progress: &'p dyn Fn(u64),
}

impl Visitor for Pass<'_, '_, '_> {
    fn begin(&mut self, _name: &str) {
        self.history.clear();
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        self.structure.sample_into(states, &mut self.next);
        let pair = self.history.len() > self.structure.lag();
        if pair {
            self.history.observe(self.structure, &self.input, &mut self.values);
        }
        self.history.push(self.structure, &self.input, &self.next);
        if pair {
            // No input acts yet: what it would enter is not taken.
            self.history.observe(self.structure, &[], &mut self.later);
            self.structure.dictionary().lift_dense(&self.later, &mut self.lifted);
            for (to, term) in self.targets.iter_mut().zip(self.dense) {
                *to = self.lifted[*term];
            }
            let rows = self.moments.chunks_exact_mut(self.dense.len());
            for (i, (row, a)) in rows.zip(&self.targets).enumerate() {
                for (sum, b) in row[..=i].iter_mut().zip(&self.targets) {
                    *sum += a * b;
                }
            }
            self.regression.push(&self.values, &self.targets);
            self.pairs += 1;
        }
        self.input.copy_from_slice(inputs);
    }

    fn progress(&mut self, bytes: u64) {
        (self.progress)(bytes);
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::trajectory::{InMemory, Trajectory};

    /// Systems of order one that are exactly in their dictionaries: rounding times the squared
    /// condition of the lifted data.
    const RECOVERED: f64 = 1e-10;

    /// In [-1, 1): a linear congruential generator (Knuth's MMIX), high bits.
    struct Noise(u64);

    impl Noise {
        fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
    }

    fn robot(description: &str) -> Robot {
        let text = format!("name = \"test\"\nsample_time_s = 0.1\n{description}");
        Robot::parse(&text, Path::new("robot.toml")).unwrap()
    }

    /// Trajectories from random starts around 0.3, under random inputs; the step gets the present
    /// state and input, and the input before.
    fn trajectories(
        robot: &Robot,
        step: impl Fn(&[f64], &[f64], &[f64]) -> Vec<f64>,
    ) -> Vec<Trajectory> {
        let (n, m, mut noise) = (robot.states.len(), robot.inputs.len(), Noise(3));
        let one = |_| {
            let mut x: Vec<f64> = (0..n).map(|_| 0.3 + noise.next()).collect();
            let mut before = vec![0.0; m];
            let mut trajectory = Trajectory::default();
            for _ in 0..12 {
                let u: Vec<f64> = (0..m).map(|_| noise.next()).collect();
                trajectory.states.extend(&x);
                trajectory.inputs.extend(&u);
                x = step(&x, &u, &before);
                before = u;
            }
            trajectory
        };
        (0..40).map(one).collect()
    }

    fn fit<'r>(robot: &'r Robot, trajectories: &[Trajectory]) -> FullOperator<'r> {
        let (states, inputs) = (robot.states.len(), robot.inputs.len());
        FullOperator::fit(robot, &InMemory { trajectories, states, inputs }, &|_| ()).unwrap()
    }

    fn refused(robot: &Robot, trajectories: &[Trajectory]) -> String {
        let (states, inputs) = (robot.states.len(), robot.inputs.len());
        let data = InMemory { trajectories, states, inputs };
        FullOperator::fit(robot, &data, &|_| ()).unwrap_err().to_string()
    }

    #[track_caller]
    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() <= RECOVERED, "{found:e} instead of {expected:e}");
    }

    #[track_caller]
    fn has_eigenvalues(found: &[(f64, f64)], expected: &[(f64, f64)]) {
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for (a, b) in found.iter().zip(expected) {
            near(a.0, b.0);
            near(a.1, b.1);
        }
    }

    /// D(x) K_u B.
    fn next(full: &FullOperator<'_>, states: &[f64], input: &[f64]) -> Vec<f64> {
        let (d, k) = (full.lift(states), full.held(input).unwrap());
        let (n, m) = (full.terms(), full.columns.len());
        let lifted = |j: usize| -> f64 { (0..n).map(|i| d[i] * k[i * n + j]).sum() };
        let lifted: Vec<f64> = (0..n).map(lifted).collect();
        (0..m).map(|j| (0..n).map(|i| lifted[i] * full.b[i * m + j]).sum()).collect()
    }

    /// The slow manifold x2 = x1² (Tu et al. 2014; Brunton et al. 2016), with two numbers:
    /// {1, x1, x2, x1²} is invariant, with eigenvalues 1, λ, μ and λ².
    const LAMBDA: f64 = 0.9;
    const MU: f64 = 0.5;
    const SLOW_MANIFOLD: &str = r#"
        states = [{ name = "x1", space = "R" }, { name = "x2", space = "R" }]
        [dictionary]
        blocks = [{ factors = ["x1^2"] }, { factors = ["x2"] }]
    "#;

    fn slow_manifold(x: &[f64], _: &[f64], _: &[f64]) -> Vec<f64> {
        vec![LAMBDA * x[0], MU * x[1] + (LAMBDA * LAMBDA - MU) * x[0] * x[0]]
    }

    #[test]
    fn slow_manifold_has_its_known_spectrum() {
        let mut robot = robot(SLOW_MANIFOLD);
        let data = trajectories(&robot, slow_manifold);
        for standardise in [false, true] {
            robot.standardise = standardise;
            let full = fit(&robot, &data);
            assert_eq!(full.names, ["1", "x1", "H2(x1)", "x2"]);
            let spectrum = full.spectrum(&[]).unwrap();
            let values = [1.0, LAMBDA, LAMBDA * LAMBDA, MU].map(|x| (x, 0.0));
            has_eigenvalues(spectrum.eigenvalues(), &values);
            assert_eq!(spectrum.defects(), []);
            let (right, left) = spectrum.eigenvector_residuals();
            assert!(right < 1e-12 && left < 1e-12);
            assert!(spectrum.reconstruction_residual(&full.b) < 1e-12);
            let modes = spectrum.modes(&full.b);
            let mut noise = Noise(8);
            for _ in 0..20 {
                let x = [2.0 * noise.next(), 2.0 * noise.next()];
                let phi = spectrum.eigenfunctions(&full.lift(&x));
                // What each eigenfunction carries of (x1, x2) is known, whatever its length.
                let shares =
                    [[0.0, 0.0], [x[0], 0.0], [0.0, x[0] * x[0]], [0.0, x[1] - x[0] * x[0]]];
                for ((phi, mode), share) in phi.iter().zip(&modes).zip(shares) {
                    for (v, share) in mode.iter().zip(share) {
                        near(v.0 * phi.0, share);
                        assert_eq!((v.1, phi.1), (0.0, 0.0));
                    }
                }
                // Equation (1), and the eigenfunctions along the motion.
                let y = slow_manifold(&x, &[], &[]);
                let later = spectrum.eigenfunctions(&full.lift(&y));
                for (j, y) in y.iter().enumerate() {
                    let terms = modes.iter().zip(&values).zip(&phi);
                    near(terms.map(|((v, l), p)| v[j].0 * l.0 * p.0).sum(), *y);
                }
                for ((later, phi), value) in later.iter().zip(&phi).zip(&values) {
                    near(later.0, value.0 * phi.0);
                }
            }
        }
    }

    const BILINEAR: &str = r#"
        states = [{ name = "x", space = "R" }, { name = "v", space = "R", target = "increment" }]
        inputs = [{ name = "u", range = [-1, 1] }]
        [dictionary]
        blocks = [{ factors = ["x", "u^2"] }, { factors = ["v", "u"] }]
        delays = { inputs = 1 }
    "#;

    fn bilinear(x: &[f64], u: &[f64], before: &[f64]) -> Vec<f64> {
        let ([x, v], [u], [before]) =
            (*x.as_array().unwrap(), *u.as_array().unwrap(), *before.as_array().unwrap());
        vec![
            0.6 * x + 0.1 * v + 0.2 * x * u + 0.1 * x * u * u + 0.2 * u + 0.15 * before,
            0.05 - 0.2 * x + 0.5 * v - 0.25 * v * u,
        ]
    }

    #[test]
    fn held_inputs_enter_every_term() {
        let mut robot = robot(BILINEAR);
        let data = trajectories(&robot, bilinear);
        robot.standardise = false;
        let full = fit(&robot, &data);
        assert_eq!(
            (&full.names[..], full.operator.terms),
            (&["1", "x", "v"].map(str::to_owned)[..], 9)
        );
        for u in [0.0, 0.7, -0.4, 3.0] {
            let expected = [
                [1.0, (0.2 + 0.15) * u, 0.05],
                [0.0, 0.6 + 0.2 * u + 0.1 * u * u, -0.2],
                [0.0, 0.1, 0.5 - 0.25 * u],
            ];
            for (found, expected) in full.held(&[u]).unwrap().iter().zip(expected.as_flattened()) {
                near(*found, *expected);
            }
        }
        // Exactly, not as the regression found it.
        let k = full.held(&[0.3]).unwrap();
        assert_eq!([k[0], k[3], k[6]], [1.0, 0.0, 0.0]);
        let targets: Vec<bool> = full.columns.iter().map(|c| c.absolute).collect();
        assert_eq!((targets, full.missing.len()), (vec![true, false], 0));

        let standardised = Robot { standardise: true, ..robot.clone() };
        let full = fit(&standardised, &data);
        for (u, x) in [(0.7, [0.4, -1.0]), (-0.4, [-0.2, 0.9])] {
            for (found, expected) in next(&full, &x, &[u]).iter().zip(bilinear(&x, &[u], &[u])) {
                near(*found, expected);
            }
            let spectrum = full.spectrum(&[u]).unwrap();
            let (trace, product): (f64, f64) = {
                let (a, d) = (0.6 + 0.2 * u + 0.1 * u * u, 0.5 - 0.25 * u);
                (a + d, a * d + 0.02)
            };
            let root = (trace * trace / 4.0 - product).sqrt();
            let pair = if root.is_nan() {
                let im = (product - trace * trace / 4.0).sqrt();
                [(trace / 2.0, im), (trace / 2.0, -im)]
            } else {
                [(trace / 2.0 + root, 0.0), (trace / 2.0 - root, 0.0)]
            };
            has_eigenvalues(spectrum.eigenvalues(), &[(1.0, 0.0), pair[0], pair[1]]);
        }
    }

    #[test]
    fn inputs_that_cannot_be_held() {
        let robot = robot(BILINEAR);
        let full = fit(&robot, &trajectories(&robot, bilinear));
        assert_eq!(full.held(&[]).unwrap_err().to_string(), "0 values for 1 inputs: u");
        assert!(full.held(&[1.0, 2.0]).is_err());
        for u in [f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(full.held(&[u]), Err(HeldInputError::NotFinite));
        }
    }

    #[test]
    fn delayed_states_are_part_of_the_state() {
        let robot = robot(
            r#"
            states = [{ name = "x", space = "R" }]
            inputs = [{ name = "u", range = [-1, 1] }]
            [dictionary]
            blocks = [{ factors = ["x"] }, { factors = ["u"] }]
            delays = { states = 1 }
        "#,
        );
        // x⁺ = 1.1 x − 0.5 x@1 + 0.1 u: λ² − 1.1 λ + 0.5 = 0.
        let mut noise = Noise(5);
        let mut states = vec![0.4, 0.9];
        let inputs: Vec<f64> = (0..300).map(|_| noise.next()).collect();
        for k in 1..299 {
            states.push(1.1 * states[k] - 0.5 * states[k - 1] + 0.1 * inputs[k]);
        }
        let full = fit(&robot, &[Trajectory { states, inputs }]);
        assert_eq!(full.names, ["1", "x", "x@1"]);
        let im = (0.5_f64 - 0.3025).sqrt();
        let spectrum = full.spectrum(&[0.0]).unwrap();
        has_eigenvalues(spectrum.eigenvalues(), &[(1.0, 0.0), (0.55, im), (0.55, -im)]);
        near(next(&full, &[-0.7, 0.3], &[0.5])[0], 1.1 * 0.3 + 0.5 * 0.7 + 0.05);
    }

    #[test]
    fn harmonics_of_a_rotation() {
        // sin φ is in both blocks, once as H¹ and once as a first harmonic, with inputs in both.
        let mut robot = robot(
            r#"
            states = [{ name = "x", space = "R" }, { name = "phi", space = "S1", target = "increment" }]
            inputs = [{ name = "u", range = [-1, 1] }]
            symmetry = { kind = "translation", coordinates = ["x"] }
            [dictionary]
            blocks = [{ factors = ["sin(phi)", "u"] }, { factors = ["fourier(phi)^2", "u^2"] }]
        "#,
        );
        let turn = 0.7;
        let step = |x: &[f64], u: &[f64], _: &[f64]| vec![x[0] + 0.1 * u[0], x[1] + turn];
        let data = trajectories(&robot, step);
        for ridge in [0.0, 1e-13] {
            robot.fit.ridge = ridge;
            let full = fit(&robot, &data);
            assert_eq!(full.names.len(), 5);
            let spectrum = full.spectrum(&[0.8]).unwrap();
            let on_circle = |angle: f64| [(angle.cos(), angle.sin()), (angle.cos(), -angle.sin())];
            let ([a, b], [c, d]) = (on_circle(turn), on_circle(2.0 * turn));
            has_eigenvalues(spectrum.eigenvalues(), &[(1.0, 0.0), a, b, c, d]);
            let columns: Vec<&str> = full.columns.iter().map(|c| c.name.as_str()).collect();
            assert_eq!(columns, ["sin(phi)", "cos(phi)"]);
            assert_eq!(full.missing, [("x".to_owned(), "left out by the symmetry")]);
            let later = next(&full, &[5.0, 1.2], &[-0.3]);
            near(later[0], (1.2 + turn).sin());
            near(later[1], (1.2 + turn).cos());
            // The first harmonic carries sine and cosine whole, half in each of the pair.
            let (modes, right) = (spectrum.modes(&full.b), spectrum.right());
            let rms = full.root_mean_square(&right[1]);
            for v in &modes[1] {
                assert!((libm::hypot(v.0, v.1) * rms - 0.5).abs() < 1e-9, "{v:?}, {rms}");
            }
            assert!(modes[0].iter().chain(&modes[3]).all(|v| v.0.abs() + v.1.abs() < 1e-9));
        }
    }

    #[test]
    fn every_method_and_the_constant() {
        let mut robot = robot(SLOW_MANIFOLD);
        let data = trajectories(&robot, slow_manifold);
        for method in
            [crate::robot::Method::Cholesky, crate::robot::Method::Qr, crate::robot::Method::Svd]
        {
            robot.fit.method = method;
            let full = fit(&robot, &data);
            let values = [1.0, LAMBDA, LAMBDA * LAMBDA, MU].map(|x| (x, 0.0));
            has_eigenvalues(full.spectrum(&[]).unwrap().eigenvalues(), &values);
            // 40 trajectories of 12 samples: no pair spans two, none is left out.
            assert_eq!((full.operator.pairs, full.operator.rank), (40 * 11, 4));
        }
        robot.fit.ridge = 0.1;
        let values = fit(&robot, &data).spectrum(&[]).unwrap();
        assert!(values.eigenvalues().contains(&(1.0, 0.0)));
        assert!(values.eigenvalues().iter().all(|z| (z.0 - LAMBDA).abs() > 1e-3));
    }

    #[test]
    fn data_without_a_spectrum() {
        let plain = robot(SLOW_MANIFOLD);
        let short = [Trajectory { states: vec![1.0, 2.0], inputs: vec![] }];
        assert!(refused(&plain, &short).contains("at least 2 rows"));
        let still = [Trajectory { states: [0.5, 0.25].repeat(9), inputs: vec![] }];
        let message = refused(&plain, &still);
        assert!(message.contains("`x1`") && message.contains("`x2`"), "{message}");

        let pose = r#"
            states = [
                { name = "x", space = "R" }, { name = "y", space = "R" }, { name = "phi", space = "S1" },
            ]
            inputs = [{ name = "u", range = [-1, 1] }]
            symmetry = { kind = "se2", coordinates = ["x", "y", "phi"] }
        "#;
        let message = refused(&robot(pose), &[]);
        assert!(
            message.starts_with("test has no spectrum: the constant is the only term"),
            "{message}"
        );
        assert!(message.contains("leaves out `x`, `y`, `phi`"), "{message}");
        let delays = robot(&format!("{pose}\n[dictionary]\ndelays = {{ states = 1 }}"));
        let step = |x: &[f64], u: &[f64], before: &[f64]| {
            vec![x[0] + 0.1 * u[0], x[1] + 0.2 * before[0], x[2] + 0.3 * u[0] * u[0]]
        };
        let full = fit(&delays, &trajectories(&delays, step));
        assert_eq!(full.names, ["1", "d(x)@1", "d(y)@1", "d(phi)@1"]);
        assert_eq!((full.columns.len(), full.missing.len()), (0, 4));
        assert_eq!(full.spectrum(&[0.0]).unwrap().eigenvalues().len(), 4);
    }
}
