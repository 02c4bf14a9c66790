//! Readable names of observables, terms and dictionaries.

use firmware_core::dictionary::{Basis, Dictionary, Factor, Source};
use firmware_core::sparse::SparseTerms;

use crate::robot::Robot;

/// The names of states and inputs, in order.
#[derive(Clone, Copy, Debug)]
pub struct Names<'n> {
    /// States.
    pub states: &'n [&'n str],
    /// Inputs.
    pub inputs: &'n [&'n str],
}

impl Names<'_> {
    /// `x`, `sin(phi)`, `d(x)@1`, `u@2`: as robot.toml has it.
    ///
    /// ```
    /// use firmware_core::dictionary::Source;
    /// use trainer::terms::Names;
    /// let names = Names { states: &["x", "phi"], inputs: &["u"] };
    /// assert_eq!(names.observable(Source::Sin(1), 0), "sin(phi)");
    /// assert_eq!(names.observable(Source::Input(0), 2), "u@2");
    /// ```
    pub fn observable(&self, source: Source, lag: u8) -> String {
        let state = |i: u8| self.states.get(usize::from(i)).copied().unwrap_or("?");
        let name = match source {
            Source::State(i) => state(i).to_owned(),
            Source::Sin(i) => format!("sin({})", state(i)),
            Source::Cos(i) => format!("cos({})", state(i)),
            Source::Increment(i) => format!("d({})", state(i)),
            Source::Input(i) => self.inputs.get(usize::from(i)).copied().unwrap_or("?").to_owned(),
        };
        if lag == 0 { name } else { format!("{name}@{lag}") }
    }

    /// One basis function: `x`, `H2(x)`, `x^2` (in monomial form), `sin(2*phi)`.
    fn function(
        &self,
        dictionary: &Dictionary,
        factor: Factor,
        digit: usize,
        form: Form,
    ) -> String {
        let Some(o) = dictionary.observables().get(usize::from(factor.observable)) else {
            return "?".to_owned();
        };
        let name = self.observable(o.source, o.lag);
        match (factor.basis, form) {
            (Basis::Hermite, _) if digit == 1 => name,
            (Basis::Hermite, Form::Hermite) => format!("H{digit}({name})"),
            (Basis::Hermite, Form::Monomial) => format!("{name}^{digit}"),
            (Basis::Fourier, _) => {
                let function = if digit % 2 == 1 { "sin" } else { "cos" };
                let angle = name.trim_start_matches("sin(");
                let (angle, lag) = angle.split_once(')').unwrap_or((angle, ""));
                match digit.div_ceil(2) {
                    1 => format!("{function}({angle}){lag}"),
                    n => format!("{function}({n}*{angle}){lag}"),
                }
            }
        }
    }

    /// A term such as `x*cos(phi)*u1`; `1` for the constant. `dense` counts all terms of all blocks.
    pub fn term(&self, dictionary: &Dictionary, dense: usize, form: Form) -> String {
        let Some((_, term)) = dictionary.term(dense) else { return "?".to_owned() };
        if term.is_empty() {
            return "1".to_owned();
        }
        let functions: Vec<String> = term
            .iter()
            .map(|(factor, digit)| self.function(dictionary, *factor, *digit, form))
            .collect();
        functions.join("*")
    }
}

impl Names<'_> {
    /// A term of a sparse model, such as `v*omega@1^2*sin(2*phi)`; `1` for the constant.
    pub fn sparse_term(
        &self,
        dictionary: &Dictionary,
        terms: SparseTerms<'_>,
        index: usize,
    ) -> String {
        let Some(powers) = terms.term(dictionary, index) else { return "?".to_owned() };
        let function = |power: &firmware_core::sparse::Power| {
            let name = self.function(dictionary, power.factor, power.digit, Form::Monomial);
            match power.exponent {
                1 => name,
                exponent => format!("{name}^{exponent}"),
            }
        };
        match powers.is_empty() {
            true => "1".to_owned(),
            false => powers.iter().map(function).collect::<Vec<_>>().join("*"),
        }
    }
}

/// Whether a term stands for Hermite polynomials (the fit) or powers (the blob).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// `H2(x)` is x² − 1.
    Hermite,
    /// `x^2`.
    Monomial,
}

/// The names of a robot's states and inputs.
pub fn robot_names(robot: &Robot) -> (Vec<&str>, Vec<&str>) {
    let states = robot.states.iter().map(|s| s.name.as_str()).collect();
    (states, robot.inputs.iter().map(|u| u.name.as_str()).collect())
}

/// An observable by the robot's names.
pub fn observable_name(robot: &Robot, (source, lag): (Source, u8)) -> String {
    let (states, inputs) = robot_names(robot);
    Names { states: &states, inputs: &inputs }.observable(source, lag)
}

/// The dense indices of the distinct terms.
pub fn distinct_terms(dictionary: &Dictionary) -> Vec<usize> {
    (0..dictionary.dense_terms()).filter(|i| dictionary.is_distinct(*i)).collect()
}
