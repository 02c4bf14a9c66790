//! Candidate terms of a sparse model: products of functions of single observables, under the names
//! that `[dictionary] terms` has.
//!
//! A *function* is a power of a state on ℝ, of a lagged increment or of an input, or a harmonic of
//! an angle. A *term* is a product of functions of different observables; the constant is always
//! there and has no name. Powers are of the raw numbers, neither centred nor scaled.

use std::collections::BTreeMap;

use firmware_core::capacity::{MAX_BASIS, MAX_BLOCKS, MAX_INPUTS, MAX_OBSERVABLES, MAX_STATES};
use firmware_core::cost::Cost;
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source, fourier};
use firmware_core::model::{
    Input, ModelError, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::{Number, SparseTerms};

use crate::robot::Robot;
use crate::terms::Names;

/// Terms of a library, the constant not counted.
pub const MAX_LIBRARY: usize = 400;
/// Terms of the library of an arm: two angles, and states on ℝ.
pub const MAX_ARM_LIBRARY: usize = 600;
/// The oldest sample of a library: what the linear ARX looks at.
pub const MAX_LIBRARY_LAG: u8 = 5;
/// Entries of a chain that the controller has room for, the constant not counted.
pub const MAX_CHAIN: usize = 255;
/// Functions that the controller has room for.
pub const MAX_FUNCTIONS: usize = 128;
/// Highest power of an observable on ℝ.
const MAX_POWER: u8 = 3;
/// Highest harmonic of an angle.
const MAX_HARMONIC: u8 = 4;
/// Highest harmonic of the angles of an arm, the second one first: the inverse of its inertia is no
/// polynomial in their sines and cosines, its harmonics fall by a factor of two or three each.
const ARM_HARMONICS: [u8; 2] = [8, 4];
/// Functions up to these lags enter products: increments, inputs.
const PRODUCT_LAGS: (u8, u8) = (2, 3);

/// What a function reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// Sine of a multiple of an angle.
    Sin,
    /// Cosine of a multiple of an angle.
    Cos,
    /// Power of a state on ℝ.
    State,
    /// Power of a lagged increment.
    Increment,
    /// Power of an input.
    Input,
}

/// A function of one observable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Function {
    /// What is read.
    pub kind: Kind,
    /// Which state or input.
    pub index: u8,
    /// Samples before the present one; for an increment at least 1.
    pub lag: u8,
    /// Power, or multiple of the angle; at least 1.
    pub degree: u8,
}

impl Function {
    fn harmonic(self) -> bool {
        matches!(self.kind, Kind::Sin | Kind::Cos)
    }

    /// The observable: for a harmonic the sine or cosine of the angle itself.
    pub fn source(self) -> Source {
        match self.kind {
            Kind::Sin => Source::Sin(self.index),
            Kind::Cos => Source::Cos(self.index),
            Kind::State => Source::State(self.index),
            Kind::Increment => Source::Increment(self.index),
            Kind::Input => Source::Input(self.index),
        }
    }

    /// What two functions of one term may not share; sine and cosine count as the same.
    fn variable(self) -> (Kind, u8, u8) {
        (if self.kind == Kind::Cos { Kind::Sin } else { self.kind }, self.index, self.lag)
    }

    /// Twelfths: the degree (half of it for harmonics above the first) and a quarter per lag.
    fn price(self) -> u32 {
        let degree = u32::from(self.degree);
        let lag = u32::from(self.lag) - u32::from(self.kind == Kind::Increment);
        12 + (degree - 1) * if self.harmonic() { 6 } else { 12 } + 3 * lag
    }

    fn name(self, names: &Names<'_>) -> String {
        let observable = names.observable(self.source(), self.lag);
        match (self.harmonic(), self.degree) {
            (_, 1) => observable,
            (true, n) => observable.replacen('(', &format!("({n}*"), 1),
            (false, n) => format!("{observable}^{n}"),
        }
    }

    fn parse(text: &str, names: &Names<'_>) -> Option<Self> {
        let (text, power) = match text.split_once('^') {
            Some((text, power)) => (text, power.trim().parse().ok()?),
            None => (text, 1),
        };
        let (text, lag) = match text.split_once('@') {
            Some((text, lag)) => (text, lag.trim().parse().ok()?),
            None => (text, 0),
        };
        let (call, name) = match text.trim().strip_suffix(')') {
            Some(inside) => inside.split_once('(')?,
            None => ("", text.trim()),
        };
        let (degree, name) = match name.split_once('*') {
            Some((multiple, name)) => (multiple.trim().parse().ok()?, name),
            None => (power, name),
        };
        let find = |list: &[&str]| list.iter().position(|n| *n == name.trim());
        let (kind, index) = match (call.trim(), find(names.states), find(names.inputs)) {
            ("sin", Some(i), _) => (Kind::Sin, i),
            ("cos", Some(i), _) => (Kind::Cos, i),
            ("d", Some(i), _) if lag > 0 => (Kind::Increment, i),
            ("", Some(i), _) => (Kind::State, i),
            ("", _, Some(i)) => (Kind::Input, i),
            _ => return None,
        };
        (degree > 0).then_some(Self { kind, index: u8::try_from(index).ok()?, lag, degree })
    }
}

/// A product of functions of different observables, in a fixed order.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Term(Vec<Function>);

impl Term {
    /// `None` for no function, or two of the same observable.
    pub fn new(mut functions: Vec<Function>) -> Option<Self> {
        functions.sort_unstable();
        let repeated = |w: &[Function]| {
            functions.iter().filter(|f| f.variable() == w[0].variable()).count() > 1
        };
        if functions.is_empty() || functions.windows(1).any(repeated) {
            return None;
        }
        Some(Self(functions))
    }

    /// The functions.
    pub fn functions(&self) -> &[Function] {
        &self.0
    }

    /// The oldest sample looked at.
    pub fn lag(&self) -> usize {
        self.0.iter().map(|f| usize::from(f.lag)).max().unwrap_or(0)
    }

    /// The sum of what its functions cost; cheap terms come first.
    fn price(&self) -> u32 {
        self.0.iter().map(|f| f.price()).sum()
    }

    /// `v*omega@1^2`, as robot.toml has it.
    ///
    /// ```
    /// use trainer::{library::Term, terms::Names};
    /// let names = Names { states: &["x", "phi"], inputs: &["u"] };
    /// let term = Term::parse("sin(2*phi)*u@1^2", &names).unwrap();
    /// assert_eq!(term.name(&names), "sin(2*phi)*u@1^2");
    /// ```
    pub fn name(&self, names: &Names<'_>) -> String {
        self.0.iter().map(|f| f.name(names)).collect::<Vec<_>>().join("*")
    }

    /// Reads a name; `None` if it is not one.
    pub fn parse(text: &str, names: &Names<'_>) -> Option<Self> {
        // A `*` within parentheses is a multiple of an angle.
        let mut depth = 0;
        let functions = text
            .split(|c| {
                depth += i32::from(c == '(') - i32::from(c == ')');
                c == '*' && depth == 0
            })
            .map(|part| Function::parse(part, names))
            .collect::<Option<Vec<_>>>()?;
        Self::new(functions)
    }
}

/// What the targets are and what may enter the dictionary.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Symmetry.
    pub symmetry: Symmetry,
    /// Next value or change, per state.
    pub targets: Vec<Target>,
}

impl Frame {
    /// The frames worth a search, each once: as declared; the same with increments; where two
    /// states on ℝ named like a planar position share a unit of length and there is one angle,
    /// also se(2), translation and none, with increments.
    pub fn all(robot: &Robot) -> Vec<Self> {
        let targets = robot.states.iter().map(|s| s.target).collect();
        let increments = vec![Target::Increment; robot.states.len()];
        let mut frames = vec![
            Self { symmetry: robot.symmetry, targets },
            Self { symmetry: robot.symmetry, targets: increments.clone() },
        ];
        let position = |axis: &str| {
            robot.states.iter().position(|s| {
                let name = s.name.to_ascii_lowercase();
                let named = name == axis
                    || name
                        .strip_suffix(axis)
                        .is_some_and(|n| n.ends_with('_') || n == "p" || n == "pos");
                named
                    && s.space == Space::Line
                    && ["m", "cm", "mm", "km"].contains(&s.unit.as_str())
            })
        };
        let mut angles =
            (0..robot.states.len()).filter(|i| robot.states[*i].space == Space::Circle);
        if let (Some(x), Some(y), Some(heading), None) =
            (position("x"), position("y"), angles.next(), angles.next())
            && robot.states[x].unit == robot.states[y].unit
        {
            let [x, y, heading] = [x as u8, y as u8, heading as u8];
            for symmetry in [
                Symmetry::Se2 { x, y, heading },
                Symmetry::Translation { coordinates: 1 << x | 1 << y },
                Symmetry::None,
            ] {
                frames.push(Self { symmetry, targets: increments.clone() });
            }
        }
        let mut distinct: Vec<Self> = Vec::new();
        for frame in frames {
            if !distinct.contains(&frame) {
                distinct.push(frame);
            }
        }
        distinct
    }

    /// The robot's metadata in this frame, without a dictionary.
    pub fn repr<'r>(&self, robot: &'r Robot) -> ModelRepr<'r> {
        // A loaded robot has no more states and inputs than fit.
        let states = robot.states.iter().zip(robot.limits()).zip(&self.targets).take(MAX_STATES);
        let states = states.map(|((s, limit), target)| State {
            name: &s.name,
            unit: &s.unit,
            space: s.space,
            target: *target,
            limit,
        });
        let inputs = robot.inputs.iter().take(MAX_INPUTS);
        let inputs = inputs.map(|u| Input {
            name: &u.name,
            unit: &u.unit,
            range: u.range.map(|x| x as f32),
        });
        ModelRepr {
            robot: &robot.name,
            sample_time_s: robot.schema.sample_time_s as f32,
            states: states.collect(),
            inputs: inputs.collect(),
            symmetry: self.symmetry,
            observables: Default::default(),
            factors: Default::default(),
            blocks: Default::default(),
            provenance: Provenance { logs: [0; 32], robot: robot.sha256 },
        }
    }
}

/// The library of a frame: at most [`MAX_LIBRARY`] terms, or [`MAX_ARM_LIBRARY`], of at most the
/// core's observables.
///
/// In the order of preference:
/// 1. single functions of degree 1 and single harmonics;
/// 2. for two angles with states on ℝ, what a step of an arm is made of up to the second order of the
///    sample time, its accelerations and how they change: harmonics of an angle × {products of the
///    rates up to degree 3, inputs × {1, rates}}, and × {sin, cos of the other} × {1, rates}, which is
///    gravity; those of the second angle first, as the inertia depends on it;
/// 3. powers and products of two and of three functions.
///
/// Within 1 and 3 the cheaper term first: a function costs its degree (half of it for harmonics
/// above the first) and a quarter per lag. In products increments have a lag of at most 2 and inputs
/// of at most 3; three functions are at the latest samples and linear.
pub fn library(robot: &Robot, frame: &Frame) -> Vec<Term> {
    let free = |i: usize| !frame.symmetry.excludes(i as u8);
    let on = |space: Space| {
        let states = robot.states.iter().enumerate();
        states
            .filter(move |(i, s)| s.space == space && free(*i))
            .map(|(i, _)| i as u8)
            .collect::<Vec<_>>()
    };
    let (lines, angles) = (on(Space::Line), on(Space::Circle));
    let function = |kind, index, lag, degree| Function { kind, index, lag, degree };
    let harmonics = |index: u8, order: u8| {
        (1..=order)
            .flat_map(move |h| [function(Kind::Sin, index, 0, h), function(Kind::Cos, index, 0, h)])
    };
    let mut functions: Vec<Function> =
        angles.iter().flat_map(|i| harmonics(*i, MAX_HARMONIC)).collect();
    for degree in 1..=MAX_POWER {
        functions.extend(lines.iter().map(|i| function(Kind::State, *i, 0, degree)));
        for lag in 0..=MAX_LIBRARY_LAG {
            let increments = (0..robot.states.len() as u8).filter(|_| lag > 0);
            functions.extend(increments.map(|i| function(Kind::Increment, i, lag, degree)));
            functions.extend(
                (0..robot.inputs.len() as u8).map(|i| function(Kind::Input, i, lag, degree)),
            );
        }
    }
    let single = |f: &Function| Term(vec![*f]);
    let mut first: Vec<Term> =
        functions.iter().filter(|f| f.degree == 1 || f.harmonic()).map(single).collect();
    first.sort_by_key(Term::price);

    let mut arm = Vec::new();
    if let ([a, b], false) = (&angles[..], lines.is_empty()) {
        let one = || std::iter::once(None);
        let rates: Vec<u8> = {
            let named = |i: &&u8| robot.states[usize::from(**i)].unit.ends_with("/s");
            let rates: Vec<u8> = lines.iter().filter(named).copied().collect();
            if rates.is_empty() { lines.clone() } else { rates }
        };
        let power = |i: u8, degree: u8| (degree > 0).then(|| function(Kind::State, i, 0, degree));
        let rates = |(p, q): (u8, u8)| {
            let pair = [rates.first().map(|i| power(*i, p)), rates.get(1).map(|i| power(*i, q))];
            pair.into_iter().flatten().flatten().collect::<Vec<_>>()
        };
        let inputs = (0..robot.inputs.len() as u8).map(|i| function(Kind::Input, i, 0, 1));
        let slow = [(0, 0), (1, 0), (0, 1)];
        let fast = [(2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)];
        let mut tails: Vec<Vec<Function>> = slow.into_iter().chain(fast).map(rates).collect();
        tails.extend(slow.into_iter().flat_map(|p| {
            inputs.clone().map(move |input| rates(p).into_iter().chain([input]).collect())
        }));
        for ((angle, other), order) in [(b, a), (a, b)].into_iter().zip(ARM_HARMONICS) {
            let parts: Vec<Option<Function>> =
                one().chain(harmonics(*angle, order).map(Some)).collect();
            let mut product = |h: &Option<Function>, o: Option<Function>, tail: &[Function]| {
                arm.extend(Term::new(h.iter().chain(&o).chain(tail).copied().collect()));
            };
            for h in &parts {
                tails.iter().for_each(|tail| product(h, None, tail));
                for o in harmonics(*other, 1) {
                    slow.iter().for_each(|p| product(h, Some(o), &rates(*p)));
                }
            }
        }
    }

    let near: Vec<Function> = functions
        .iter()
        .filter(|f| match f.kind {
            Kind::Increment => f.lag <= PRODUCT_LAGS.0,
            Kind::Input => f.lag <= PRODUCT_LAGS.1,
            _ => true,
        })
        .copied()
        .collect();
    let latest = |f: &&Function| f.degree == 1 && f.lag <= u8::from(f.kind == Kind::Increment);
    let latest: Vec<Function> = near.iter().filter(latest).copied().collect();
    let mut rest: Vec<Term> = functions.iter().map(single).collect();
    for (i, f) in near.iter().enumerate() {
        rest.extend(near[..i].iter().filter_map(|g| Term::new(vec![*g, *f])));
    }
    for (i, f) in latest.iter().enumerate() {
        for (j, g) in latest[..i].iter().enumerate() {
            rest.extend(latest[..j].iter().filter_map(|h| Term::new(vec![*h, *g, *f])));
        }
    }
    rest.sort_by_key(|t| (t.price(), t.clone()));

    let most = if arm.is_empty() { MAX_LIBRARY } else { MAX_ARM_LIBRARY };
    let mut library: Vec<Term> = Vec::new();
    let mut held = std::collections::BTreeSet::new();
    let mut observables = std::collections::BTreeSet::new();
    for term in first.into_iter().chain(arm).chain(rest) {
        if library.len() == most {
            break;
        }
        // Sine and cosine are two observables.
        let own = term.0.iter().flat_map(|f| {
            let (kind, index, lag) = f.variable();
            [Some((kind, index, lag)), (kind == Kind::Sin).then_some((Kind::Cos, index, lag))]
        });
        let mut with: std::collections::BTreeSet<_> = observables.clone();
        with.extend(own.flatten());
        if with.len() <= MAX_OBSERVABLES.min(MAX_BLOCKS) && held.insert(term.clone()) {
            observables = with;
            library.push(term);
        }
    }
    library
}

/// Terms as the controller computes them: functions of observables, and a chain of products.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// What is read, and at which lag.
    pub observables: Vec<(Source, u8)>,
    /// One single-factor block each.
    factors: Vec<Factor>,
    /// `[parent, function]` of entries 1, 2, …; entry 0 is the constant.
    entries: Vec<[usize; 2]>,
    /// The entry of every term asked for.
    place: Vec<usize>,
    functions: usize,
}

impl Chain {
    /// The chain of these terms; products in between are added where no other term is one.
    pub fn new(terms: &[&Term]) -> Self {
        // Highest degree of every variable, and for angles whether sine or cosine occur.
        let mut variables: BTreeMap<(Kind, u8, u8), (u8, bool, bool)> = BTreeMap::new();
        for f in terms.iter().flat_map(|t| &t.0) {
            let v = variables.entry(f.variable()).or_default();
            *v = (v.0.max(f.degree), v.1 || f.kind != Kind::Cos, v.2 || f.kind == Kind::Cos);
        }
        let (mut observables, mut factors) = (Vec::new(), Vec::new());
        let mut numbers: BTreeMap<Function, usize> = BTreeMap::new();
        let mut functions = 0;
        for ((kind, index, lag), (order, sin, cos)) in variables {
            let observable = observables.len() as u8;
            let mut basis = Basis::Hermite;
            let mut number = |kind, degree| {
                numbers.insert(Function { kind, index, lag, degree }, functions);
                functions += 1;
            };
            if kind == Kind::Sin && (order > 1 || (sin && cos)) {
                basis = Basis::Fourier;
                observables.extend([(Source::Sin(index), lag), (Source::Cos(index), lag)]);
                (1..=order)
                    .for_each(|h| [Kind::Sin, Kind::Cos].into_iter().for_each(|k| number(k, h)));
            } else {
                let kind = if kind == Kind::Sin && cos { Kind::Cos } else { kind };
                observables.push((Function { kind, index, lag, degree: 1 }.source(), lag));
                (1..=order).for_each(|p| number(kind, p));
            }
            factors.push(Factor { observable, basis, order });
        }
        let mut entries = Vec::new();
        let mut places: BTreeMap<Vec<Function>, usize> = BTreeMap::from([(Vec::new(), 0)]);
        let mut order: Vec<&Term> = terms.to_vec();
        order.sort_by_key(|t| t.0.len());
        for term in order {
            // The parent: the term without one of its functions, or else a product put in between.
            let without = |i: usize| [&term.0[..i], &term.0[i + 1..]].concat();
            if let Some(i) = (0..term.0.len()).rev().find(|i| places.contains_key(&without(*i))) {
                entries.push([places[&without(i)], numbers[&term.0[i]]]);
                places.insert(term.0.clone(), entries.len());
                continue;
            }
            let mut parent = 0;
            for (k, f) in term.0.iter().enumerate() {
                parent = *places.entry(term.0[..=k].to_vec()).or_insert_with(|| {
                    entries.push([parent, numbers[f]]);
                    entries.len()
                });
            }
        }
        let place = terms.iter().map(|t| places[&t.0]).collect();
        Self { observables, factors, entries, place, functions }
    }

    /// Whether the controller has room for it.
    pub fn fits(&self) -> bool {
        self.entries.len() <= MAX_CHAIN
            && self.functions <= MAX_FUNCTIONS
            && self.observables.len() <= MAX_OBSERVABLES
            && self.factors.len() <= MAX_BLOCKS
    }

    /// Functions of all factors.
    pub fn functions(&self) -> usize {
        self.functions
    }

    /// Entries with the constant.
    pub fn len(&self) -> usize {
        self.entries.len() + 1
    }

    /// Never: the constant is always there.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// `[parent, function]` of entries 1, 2, …, as the controller has them; `None` where their numbers
    /// do not fit a byte.
    pub fn controller_entries(&self) -> Option<Vec<[u8; 2]>> {
        let byte = |index: usize| u8::try_from(index).ok();
        self.entries.iter().map(|[parent, f]| Some([byte(*parent)?, byte(*f)?])).collect()
    }

    /// The entry of every term.
    pub fn place(&self) -> &[usize] {
        &self.place
    }

    /// The model's structure with these observables.
    ///
    /// # Errors
    /// What the core refuses.
    pub fn structure<'a>(&self, frame: &ModelRepr<'a>) -> Result<Structure<'a>, ModelError> {
        let mut repr = frame.clone();
        let (found, room) = (self.observables.len(), MAX_OBSERVABLES.min(MAX_BLOCKS));
        if found > room {
            let field = "observables";
            return Err(ModelError::DimensionMismatch { field, expected: room, found });
        }
        repr.observables = self
            .observables
            .iter()
            .map(|(source, lag)| Observable { source: *source, lag: *lag, centre: 0.0, gain: 1.0 })
            .collect();
        repr.factors = self.factors.iter().copied().collect();
        repr.blocks = self.factors.iter().map(|_| Block { factors: 1, max_degree: 0 }).collect();
        if self.factors.is_empty() {
            repr.blocks = std::iter::once(Block { factors: 0, max_degree: 0 }).collect();
        }
        Structure::try_from(repr)
    }

    /// The chain from the values of the observables: `functions` of shape `[functions]` is scratch,
    /// `entries` has shape `[len]`.
    #[inline]
    pub fn lift<S: Number>(&self, values: &[S], functions: &mut [S], entries: &mut [S]) {
        let mut next = 0;
        for factor in &self.factors {
            let (v, order) = (usize::from(factor.observable), usize::from(factor.order));
            match factor.basis {
                Basis::Hermite => {
                    let mut power = values[v];
                    for f in &mut functions[next..next + order] {
                        *f = power;
                        power = power * values[v];
                    }
                    next += order;
                }
                Basis::Fourier => {
                    let mut basis = [S::ZERO; MAX_BASIS];
                    let basis = &mut basis[..2 * order + 1];
                    fourier(values[v], values[v + 1], basis);
                    functions[next..next + 2 * order].copy_from_slice(&basis[1..]);
                    next += 2 * order;
                }
            }
        }
        entries[0] = S::ONE;
        for (k, [parent, function]) in self.entries.iter().enumerate() {
            entries[k + 1] = entries[*parent] * functions[*function];
        }
    }

    /// What it costs in this frame; [`Cost::REFUSED`] where the controller has no room for it.
    pub fn cost(&self, structure: &Structure<'_>) -> Cost {
        let Some(entries) = self.controller_entries() else { return Cost::REFUSED };
        match SparseTerms::new(structure.dictionary(), &entries) {
            Ok(terms) if structure.fits(Some(terms)).is_ok() => Cost::new(structure, Some(terms)),
            _ => Cost::REFUSED,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terms::robot_names;

    fn robot(text: &str) -> Robot {
        Robot::parse(text, std::path::Path::new("robot.toml")).unwrap()
    }

    fn arm() -> Robot {
        robot(
            "name = \"arm\"\nsample_time_s = 0.01\n\
             [[states]]\nname = \"a\"\nspace = \"S1\"\n[[states]]\nname = \"b\"\nspace = \"S1\"\n\
             [[states]]\nname = \"da\"\nspace = \"R\"\nunit = \"rad/s\"\n[[states]]\nname = \"db\"\nspace = \"R\"\nunit = \"rad/s\"\n\
             [[inputs]]\nname = \"u\"\nrange = [-1, 1]\n",
        )
    }

    fn car() -> Robot {
        robot(
            "name = \"car\"\nsample_time_s = 0.01\n\
             [[states]]\nname = \"x\"\nspace = \"R\"\nunit = \"m\"\n[[states]]\nname = \"y\"\nspace = \"R\"\nunit = \"m\"\n\
             [[states]]\nname = \"phi\"\nspace = \"S1\"\n[[inputs]]\nname = \"v\"\nrange = [-1, 1]\n",
        )
    }

    #[test]
    fn names_parse_back_and_libraries_hold_each_term_once() {
        for robot in [arm(), car()] {
            let (states, inputs) = robot_names(&robot);
            let names = Names { states: &states, inputs: &inputs };
            for frame in Frame::all(&robot) {
                let library = library(&robot, &frame);
                assert!(library.len() > 100 && library.len() <= MAX_ARM_LIBRARY);
                for (i, term) in library.iter().enumerate() {
                    assert_eq!(Term::parse(&term.name(&names), &names).as_ref(), Some(term));
                    assert!(!library[..i].contains(term));
                    assert!(term.0.iter().all(|f| f.kind == Kind::Increment
                        || !frame.symmetry.excludes(f.index)
                        || f.kind == Kind::Input));
                }
                assert!(
                    Chain::new(&library.iter().collect::<Vec<_>>())
                        .structure(&frame.repr(&robot))
                        .is_ok()
                );
            }
        }
        let names = Names { states: &["x"], inputs: &["u"] };
        for wrong in ["", "z", "sin(u)", "d(x)", "x^0", "x*x", "x**u", "x@", "sin(x)*cos(2*x)"] {
            assert_eq!(Term::parse(wrong, &names), None, "{wrong}");
        }
    }

    #[test]
    fn the_library_of_an_arm_holds_its_accelerations_and_how_they_change() {
        let robot = arm();
        let (states, inputs) = robot_names(&robot);
        let names = Names { states: &states, inputs: &inputs };
        let library = library(&robot, &Frame::all(&robot)[1]);
        for term in [
            "cos(8*b)*u",
            "sin(8*b)*db*u",
            "sin(8*b)*da*db^2",
            "sin(a)*sin(8*b)*da",
            "cos(4*a)*db*u",
            "cos(4*a)*sin(b)",
            "d(a)@5",
        ] {
            assert!(library.contains(&Term::parse(term, &names).unwrap()), "{term}");
        }
    }

    #[test]
    fn frames_are_those_worth_a_search() {
        let [se2, translation, none, ..] = &Frame::all(&car())[1..] else { panic!() };
        assert_eq!(se2.symmetry, Symmetry::None, "increments as declared");
        assert_eq!(translation.symmetry, Symmetry::Se2 { x: 0, y: 1, heading: 2 });
        assert_eq!(none.symmetry, Symmetry::Translation { coordinates: 3 });
        assert_eq!(Frame::all(&arm()).len(), 2);
    }

    #[test]
    fn a_chain_multiplies() {
        let names = Names { states: &["p", "v"], inputs: &["u"] };
        let terms: Vec<Term> = ["sin(2*p)*v*u", "v^2", "cos(p)", "v*u@1^2", "sin(2*p)"]
            .iter()
            .map(|t| Term::parse(t, &names).unwrap())
            .collect();
        let chain = Chain::new(&terms.iter().collect::<Vec<_>>());
        // sin p, cos p, sin 2p, cos 2p; v, v²; u; u@1, u@1²; one product in between for each of two terms.
        assert_eq!((chain.functions(), chain.len()), (9, 1 + terms.len() + 2));
        let angle = 0.3_f64;
        let of = |o: &(Source, u8)| match o {
            (Source::Sin(_), _) => libm::sin(angle),
            (Source::Cos(_), _) => libm::cos(angle),
            (Source::State(_), _) => 2.0,
            (_, 0) => 3.0,
            _ => 5.0,
        };
        let values: Vec<f64> = chain.observables.iter().map(of).collect();
        let (mut functions, mut entries) = ([0.0; 9], [0.0; 8]);
        chain.lift(&values, &mut functions, &mut entries);
        let sine = libm::sin(2.0 * angle);
        for (place, expected) in
            chain.place().iter().zip([sine * 6.0, 4.0, libm::cos(angle), 50.0, sine])
        {
            assert!((entries[*place] - expected).abs() < 1e-12);
        }
    }
}
