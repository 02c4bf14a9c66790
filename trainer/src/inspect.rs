//! Everything in a blob, in readable form.

use std::fmt::Write;

use firmware_core::blob::{self, ParseError, SelfTest};
use firmware_core::dictionary::{Basis, Source};
use firmware_core::model::{Model, Space, Structure, Symmetry, Target};
use serde::Serialize;

use crate::report::{grouped, hexadecimal, significant};
use crate::spectrum;
use crate::terms::{Form, Names, distinct_terms};

/// A blob, described. Numbers are those of the blob; `null` stands for an infinite limit.
#[derive(Debug, Serialize)]
pub struct Inspection {
    /// Robot name.
    pub robot: String,
    /// Sample time \[s\].
    pub sample_time_s: f32,
    /// Such as `R^2 x S^1`.
    pub topology: String,
    /// States.
    pub states: Vec<StateInspection>,
    /// Inputs.
    pub inputs: Vec<InputInspection>,
    /// Such as `se2(x, y, phi)`.
    pub symmetry: String,
    /// Largest lag \[samples\].
    pub lag: usize,
    /// Blocks of the dictionary.
    pub blocks: Vec<String>,
    /// Observables with scaling and range.
    pub observables: Vec<ObservableInspection>,
    /// Distinct terms.
    pub terms: Vec<String>,
    /// One per output, largest coefficient first.
    pub equations: Vec<EquationInspection>,
    /// Error bounds, if the blob has any.
    pub error_bounds: Option<BoundsInspection>,
    /// Bytes of the blob.
    pub bytes: usize,
    /// Bytes of the coefficients among them.
    pub coefficient_bytes: usize,
    /// SHA-256 of the logs.
    pub logs_sha256: String,
    /// SHA-256 of the robot description.
    pub robot_sha256: String,
    /// Largest modulus of the eigenvalues of the one-step map linearised at the stored sample.
    pub spectral_radius: Option<f64>,
    /// The eigenvalues, as \[real, imaginary\].
    pub eigenvalues: Vec<(f64, f64)>,
}

/// The error bounds of a blob.
#[derive(Debug, Serialize)]
pub struct BoundsInspection {
    /// Share of predictions that the bounds hold for.
    pub coverage: f32,
    /// Units they were made from.
    pub units: u32,
    /// Steps that have a bound.
    pub steps: Vec<u32>,
    /// Shape `[steps, states]`, in the units of the states.
    pub bounds: Vec<f32>,
}

/// A state of a blob.
#[derive(Debug, Serialize)]
pub struct StateInspection {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// `R` or `S1`.
    pub space: &'static str,
    /// `absolute` or `increment`.
    pub target: &'static str,
    /// Hard limit.
    pub limit: [Option<f32>; 2],
    /// Tolerance of the self-test.
    pub self_test_tolerance: f32,
}

/// An input of a blob.
#[derive(Debug, Serialize)]
pub struct InputInspection {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Range of the actuator.
    pub range: [f32; 2],
}

/// An observable of a blob.
#[derive(Debug, Serialize)]
pub struct ObservableInspection {
    /// Name.
    pub name: String,
    /// Subtracted.
    pub centre: f32,
    /// Multiplied with the difference.
    pub gain: f32,
    /// Smallest and largest raw value in the training data.
    pub range: Option<[f32; 2]>,
}

/// An equation of a blob.
#[derive(Debug, Serialize)]
pub struct EquationInspection {
    /// What the output is.
    pub output: String,
    /// Terms and coefficients, largest first, zeros left out.
    pub terms: Vec<(String, f32)>,
}

fn names<'n>(structure: &'n Structure<'_>) -> (Vec<&'n str>, Vec<&'n str>) {
    let states = structure.states().iter().map(|s| s.name).collect();
    (states, structure.inputs().iter().map(|u| u.name).collect())
}

/// What each output of the operator is called.
pub fn output_names(structure: &Structure<'_>) -> Vec<String> {
    let mut outputs = Vec::new();
    for (i, state) in structure.states().iter().enumerate() {
        let name = state.name;
        let body = match structure.symmetry() {
            Symmetry::Se2 { x, .. } if usize::from(x) == i => " ahead",
            Symmetry::Se2 { y, .. } if usize::from(y) == i => " to the left",
            _ => "",
        };
        match (state.target, state.space) {
            (Target::Increment, _) => outputs.push(format!("change of {name}{body}")),
            (Target::Absolute, Space::Line) => outputs.push(format!("next {name}")),
            (Target::Absolute, Space::Circle) => {
                outputs.extend([format!("next sin({name})"), format!("next cos({name})")]);
            }
        }
    }
    outputs
}

/// The product of the spaces, such as `R^2 x S^1`.
fn topology(structure: &Structure<'_>) -> String {
    let mut runs: Vec<(Space, usize)> = Vec::new();
    for state in structure.states() {
        match runs.last_mut() {
            Some((space, count)) if *space == state.space => *count += 1,
            _ => runs.push((state.space, 1)),
        }
    }
    let name = |(space, count): &(Space, usize)| match (space, count) {
        (Space::Line, 1) => "R".to_owned(),
        (Space::Line, n) => format!("R^{n}"),
        (Space::Circle, 1) => "S^1".to_owned(),
        (Space::Circle, n) => format!("T^{n}"),
    };
    runs.iter().map(name).collect::<Vec<_>>().join(" x ")
}

fn symmetry(structure: &Structure<'_>) -> String {
    let name = |i: u8| structure.states().get(usize::from(i)).map_or("?", |s| s.name);
    match structure.symmetry() {
        Symmetry::None => "none".to_owned(),
        Symmetry::Translation { .. } => {
            let excluded = (0..8).filter(|i| structure.symmetry().excludes(*i)).map(name);
            format!("translation({})", excluded.collect::<Vec<_>>().join(", "))
        }
        Symmetry::Se2 { x, y, heading } => {
            format!("se2({}, {}, {})", name(x), name(y), name(heading))
        }
    }
}

/// The blocks of a dictionary, such as `kron(H1(sin(phi)), H3(u))`.
pub fn blocks(structure: &Structure<'_>) -> Vec<String> {
    let (states, inputs) = names(structure);
    let names = Names { states: &states, inputs: &inputs };
    let observables = structure.dictionary().observables();
    let mut texts = Vec::new();
    for (block, factors) in structure.dictionary().blocks() {
        let factor = |f: &firmware_core::dictionary::Factor| {
            let o = observables[usize::from(f.observable)];
            match (f.basis, o.source) {
                (Basis::Fourier, Source::Sin(i)) => {
                    format!("F{}({})", f.order, states[usize::from(i)])
                }
                _ => format!("H{}({})", f.order, names.observable(o.source, o.lag)),
            }
        };
        let parts: Vec<String> = factors.iter().map(factor).collect();
        let text = match parts.len() {
            0 => "1".to_owned(),
            1 => parts[0].clone(),
            _ => format!("kron({})", parts.join(", ")),
        };
        let cut = if block.max_degree > 0 {
            format!(" up to degree {}", block.max_degree)
        } else {
            String::new()
        };
        texts.push(text + &cut);
    }
    texts
}

/// Describes a blob.
///
/// # Errors
/// As [`blob::parse`].
pub fn inspect(bytes: &[u8]) -> Result<Inspection, ParseError> {
    let model = blob::parse(bytes)?;
    let test = blob::self_test(bytes)?;
    Ok(describe(&model, &test, bytes.len()))
}

fn describe(model: &Model<'_>, test: &SelfTest<'_>, bytes: usize) -> Inspection {
    let structure = model.structure();
    let dictionary = structure.dictionary();
    let (states, inputs) = names(structure);
    let names = Names { states: &states, inputs: &inputs };
    let finite = |x: f32| x.is_finite().then_some(x);
    let eigenvalues = spectrum::eigenvalues(model, test.states, test.inputs).unwrap_or_default();
    let per_output = model.coefficients_per_output();
    let term_names: Vec<String> = match model.terms() {
        Some(terms) => (0..per_output).map(|i| names.sparse_term(dictionary, terms, i)).collect(),
        None => (0..per_output).map(|i| names.term(dictionary, i, Form::Monomial)).collect(),
    };
    let distinct = match model.terms() {
        Some(_) => term_names.clone(),
        None => distinct_terms(dictionary).into_iter().map(|i| term_names[i].clone()).collect(),
    };
    let equations = output_names(structure)
        .into_iter()
        .zip(model.coefficients().chunks_exact(per_output.max(1)));
    let provenance = structure.provenance();
    Inspection {
        robot: structure.robot().to_owned(),
        sample_time_s: structure.sample_time_s(),
        topology: topology(structure),
        states: structure
            .states()
            .iter()
            .zip(test.tolerance)
            .map(|(s, tolerance)| StateInspection {
                name: s.name.to_owned(),
                unit: s.unit.to_owned(),
                space: if s.space == Space::Line { "R" } else { "S1" },
                target: if s.target == Target::Absolute { "absolute" } else { "increment" },
                limit: s.limit.map(finite),
                self_test_tolerance: *tolerance,
            })
            .collect(),
        inputs: structure
            .inputs()
            .iter()
            .map(|u| InputInspection {
                name: u.name.to_owned(),
                unit: u.unit.to_owned(),
                range: u.range,
            })
            .collect(),
        symmetry: symmetry(structure),
        lag: structure.lag(),
        blocks: blocks(structure),
        observables: dictionary
            .observables()
            .iter()
            .enumerate()
            .map(|(i, o)| ObservableInspection {
                name: names.observable(o.source, o.lag),
                centre: o.centre,
                gain: o.gain,
                range: model.ranges().and_then(|r| r.get(2 * i..)?.first_chunk().copied()),
            })
            .collect(),
        terms: distinct,
        equations: equations
            .map(|(output, row)| {
                let mut terms: Vec<(String, f32)> = Vec::new();
                for (name, c) in term_names.iter().zip(row).filter(|(_, c)| **c != 0.0) {
                    // A term that several blocks hold is one term to the reader.
                    match terms.iter_mut().find(|(n, _)| n == name) {
                        Some((_, sum)) => *sum += c,
                        None => terms.push((name.clone(), *c)),
                    }
                }
                terms.sort_by(|(_, a), (_, b)| b.abs().total_cmp(&a.abs()));
                EquationInspection { output, terms }
            })
            .collect(),
        error_bounds: model.error_bounds().map(|b| BoundsInspection {
            coverage: b.coverage(),
            units: b.units(),
            steps: b.horizons().to_vec(),
            bounds: b.bounds().to_vec(),
        }),
        bytes,
        coefficient_bytes: 4 * model.coefficients().len(),
        logs_sha256: hexadecimal(&provenance.logs),
        robot_sha256: hexadecimal(&provenance.robot),
        spectral_radius: spectrum::radius(&eigenvalues),
        eigenvalues,
    }
}

/// Terms of an equation that are shown.
const SHOWN: usize = 8;

impl Inspection {
    /// The description for people; `all` shows every term of the equations.
    pub fn text(&self, all: bool) -> String {
        let mut t = String::new();
        let _ = writeln!(t, "robot       {}", self.robot);
        let _ = writeln!(t, "sample time {} s", self.sample_time_s);
        let _ = writeln!(t, "topology    {}", self.topology);
        let _ = writeln!(t, "symmetry    {}", self.symmetry);
        let _ = writeln!(
            t,
            "size        {} bytes, {} of them coefficients",
            grouped(self.bytes as u64),
            grouped(self.coefficient_bytes as u64)
        );
        let radius =
            self.spectral_radius.map_or("none: the model diverges there".to_owned(), significant);
        let _ = writeln!(
            t,
            "spectral radius of the one-step map, linearised at the stored sample: {radius}"
        );
        if let Some(b) = &self.error_bounds {
            let last = b.bounds.len().saturating_sub(self.states.len());
            let at_last: Vec<String> = b.bounds[last..]
                .iter()
                .zip(&self.states)
                .map(|(x, s)| format!("{} {} [{}]", s.name, significant(f64::from(*x)), s.unit))
                .collect();
            let _ = writeln!(
                t,
                "error bounds for {} % from {} units, {} steps; at step {}: {}",
                significant(100.0 * f64::from(b.coverage)),
                b.units,
                b.steps.len(),
                b.steps.last().copied().unwrap_or(0),
                at_last.join(", ")
            );
        }
        let _ = writeln!(t, "logs        sha256 {}", self.logs_sha256);
        let _ = writeln!(t, "robot.toml  sha256 {}", self.robot_sha256);

        let _ = writeln!(t, "\nstates");
        for s in &self.states {
            let limit = match s.limit {
                [Some(low), Some(high)] => {
                    format!("limit {} to {}", significant(low.into()), significant(high.into()))
                }
                _ => "no limit".to_owned(),
            };
            let _ = writeln!(t, "  {} [{}] on {}, {}, {limit}", s.name, s.unit, s.space, s.target);
        }
        let _ = writeln!(t, "inputs");
        for u in &self.inputs {
            let [low, high] = u.range;
            let _ = writeln!(t, "  {} [{}], range {low} to {high}", u.name, u.unit);
        }
        let _ = writeln!(
            t,
            "observables, v = (raw - centre) * gain, and their range in the training data"
        );
        for o in &self.observables {
            let range = o.range.map_or("not stored".to_owned(), |[low, high]| {
                format!("{} to {}", significant(low.into()), significant(high.into()))
            });
            let scaling = if (o.centre, o.gain) == (0.0, 1.0) {
                String::new()
            } else {
                format!(
                    ", centre {}, gain {}",
                    significant(o.centre.into()),
                    significant(o.gain.into())
                )
            };
            let _ = writeln!(t, "  {}: {range}{scaling}", o.name);
        }
        let _ = writeln!(
            t,
            "\ndictionary: {} distinct terms, largest lag {}",
            self.terms.len(),
            self.lag
        );
        for block in &self.blocks {
            let _ = writeln!(t, "  {block}");
        }
        let _ = writeln!(t, "terms: {}", self.terms.join(", "));
        let _ = writeln!(t, "\nequations, in powers of the observables v");
        for equation in &self.equations {
            let shown = if all { equation.terms.len() } else { SHOWN };
            let _ = write!(t, "  {} =", equation.output);
            for (i, (name, c)) in equation.terms.iter().take(shown).enumerate() {
                let sign = if *c < 0.0 {
                    " - "
                } else if i > 0 {
                    " + "
                } else {
                    " "
                };
                let factor = if name == "1" { String::new() } else { format!("*{name}") };
                let _ = write!(t, "{sign}{}{factor}", significant(c.abs().into()));
            }
            match equation.terms.len() {
                0 => t.push_str(" 0\n"),
                n if n > shown => {
                    let _ = writeln!(t, " + {} smaller terms", n - shown);
                }
                _ => t.push('\n'),
            }
        }
        t
    }
}
