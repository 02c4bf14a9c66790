//! `robot.toml`: the robot, what its logs are called, its dictionary, and how to fit and score.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, ModelError, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use serde::Deserialize;
use sha2::{Digest, Sha256};

use crate::chain::Chain;
use crate::recording::{LogColumn, LogSchema};

/// Why a robot description is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RobotError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}; give the robot's folder or its robot.toml", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not TOML, or has an unknown, missing or ill-typed key.
    #[error("{}:{line}:{column}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What is wrong.
        message: String,
    },
    /// The keys are well formed, but do not describe a robot.
    #[error("{}: {key}: {message}", path.display())]
    Meaning {
        /// The file.
        path: PathBuf,
        /// The key, such as `states[1].target`.
        key: String,
        /// What is wrong and how to mend it.
        message: String,
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RobotToml {
    name: String,
    sample_time_s: f64,
    #[serde(default = "default_time_column")]
    time_column: String,
    episode_column: Option<String>,
    states: Vec<StateToml>,
    #[serde(default)]
    inputs: Vec<InputToml>,
    #[serde(default)]
    symmetry: SymmetryToml,
    #[serde(default)]
    dictionary: DictionaryToml,
    #[serde(default)]
    fit: FitOptions,
    #[serde(default)]
    score: ScoreOptions,
    #[serde(default)]
    budget: BudgetOptions,
}

fn default_time_column() -> String {
    "time_s".to_owned()
}

#[derive(Debug, Deserialize)]
enum SpaceToml {
    R,
    S1,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
enum TargetToml {
    Absolute,
    Increment,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct StateToml {
    name: String,
    space: SpaceToml,
    #[serde(default)]
    unit: String,
    target: Option<TargetToml>,
    column: Option<String>,
    limit: Option<Exactly<f64, 2>>,
}

/// A list of N values: serde itself takes an array from the front of a longer list.
#[derive(Clone, Debug, Deserialize)]
#[serde(try_from = "Vec<T>", bound = "T: Deserialize<'de>")]
struct Exactly<T, const N: usize>([T; N]);

impl<T, const N: usize> TryFrom<Vec<T>> for Exactly<T, N> {
    type Error = String;

    fn try_from(list: Vec<T>) -> Result<Self, String> {
        let list: Result<[T; N], _> = list.try_into();
        list.map(Self).map_err(|list| format!("expected {N} values, found {}", list.len()))
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct InputToml {
    name: String,
    #[serde(default)]
    unit: String,
    range: Exactly<f64, 2>,
    column: Option<String>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, tag = "kind", content = "coordinates", rename_all = "lowercase")]
enum SymmetryToml {
    #[default]
    None,
    Translation(Vec<String>),
    Se2(Exactly<String, 3>),
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DictionaryToml {
    order: u8,
    orders: BTreeMap<String, u8>,
    fourier: BTreeMap<String, u8>,
    delays: DelaysToml,
    blocks: Vec<BlockToml>,
    terms: Vec<String>,
    max_degree: u8,
    standardise: bool,
}

impl Default for DictionaryToml {
    fn default() -> Self {
        Self {
            order: 1,
            orders: BTreeMap::new(),
            fourier: BTreeMap::new(),
            delays: DelaysToml::default(),
            blocks: Vec::new(),
            terms: Vec::new(),
            max_degree: 0,
            standardise: true,
        }
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DelaysToml {
    states: u8,
    inputs: u8,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BlockToml {
    factors: Vec<String>,
    #[serde(default)]
    max_degree: u8,
}

/// How the least-squares problem is solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Cholesky factorisation of the Gram matrix: the fastest; squares the condition number.
    #[default]
    Cholesky,
    /// QR factorisation of the lifted data, row block by row block.
    Qr,
    /// Truncated singular value decomposition of the lifted data.
    Svd,
}

/// The `[fit]` table.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FitOptions {
    /// How the problem is solved.
    pub method: Method,
    /// Scale the columns of the lifted data to unit norm first.
    pub scale_columns: bool,
    /// Ridge λ, added to the diagonal of the (unit-diagonal, when scaled) Gram matrix.
    pub ridge: f64,
    /// For `svd`: singular values up to this fraction of the largest one are dropped.
    pub truncation: f64,
    /// Move the operator towards better rollouts, held by the one-step fit this firmly (see
    /// [`refine`](crate::refine)); `None`: leave it at the one-step fit.
    pub refine: Option<f64>,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            method: Method::Cholesky,
            scale_columns: true,
            ridge: 0.0,
            truncation: 1e-10,
            refine: None,
        }
    }
}

/// The `[score]` table.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScoreOptions {
    /// Steps of a rollout.
    pub horizon: usize,
    /// Samples between the starts of two windows.
    pub stride: usize,
    /// Cross-validation folds over whole trajectories; contiguous blocks of a single one.
    pub folds: usize,
    /// Score on the trajectories whose name matches one of these patterns (`*` and `?`), trained on
    /// the others, instead of cross-validation.
    pub hold_out: Vec<String>,
}

impl ScoreOptions {
    /// Samples before the present one of the first window: enough for a model with this lag and for
    /// every linear ARX.
    pub(crate) fn first(&self, lag: usize) -> usize {
        lag.max(crate::arx::MAX_LAGS)
    }
}

impl Default for ScoreOptions {
    fn default() -> Self {
        Self { horizon: 50, stride: 10, folds: 5, hold_out: Vec::new() }
    }
}

/// The `[budget]` table: what the controller can spare for the model, for `trainer select`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BudgetOptions {
    /// Instructions of one step.
    pub max_instructions: Option<u32>,
    /// Bytes of the blob.
    pub max_bytes: Option<u32>,
    /// Terms beside the constant.
    pub max_terms: Option<u32>,
    /// Samples looked back at.
    pub max_lag: Option<u32>,
}

/// A state coordinate of the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotState {
    /// Name.
    pub name: String,
    /// Unit in the model: `rad` where the log has degrees.
    pub unit: String,
    /// ℝ or S¹.
    pub space: Space,
    /// Next value or change.
    pub target: Target,
    /// Hard limit, if the description gives one.
    pub limit: Option<[f64; 2]>,
}

/// An input of the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotInput {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Range that the actuator accepts.
    pub range: [f64; 2],
}

/// Centre and gain of every observable: `v = (raw − centre) · gain`.
pub type Scaling = Vec<[f32; 2]>;

/// A checked robot description.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Name.
    pub name: String,
    /// How the logs are read.
    pub schema: LogSchema,
    /// State coordinates.
    pub states: Vec<RobotState>,
    /// Inputs.
    pub inputs: Vec<RobotInput>,
    /// Symmetry.
    pub symmetry: Symmetry,
    /// What the observables read, and at which lag.
    pub observables: Vec<(Source, u8)>,
    /// Factors of all blocks.
    pub factors: Vec<Factor>,
    /// Kronecker blocks.
    pub blocks: Vec<Block>,
    /// The terms, where the description lists them one by one: products of the functions of the
    /// blocks, which are single factors then.
    pub chain: Option<Chain>,
    /// Centre and scale the observables on ℝ by the mean and standard deviation of the data.
    pub standardise: bool,
    /// How to fit.
    pub fit: FitOptions,
    /// How to score.
    pub score: ScoreOptions,
    /// What the controller can spare.
    pub budget: BudgetOptions,
    /// SHA-256 of the description.
    pub sha256: [u8; 32],
}

/// Where a TOML file is wrong, from 1.
pub(crate) fn line_and_column(text: &str, error: &toml::de::Error) -> (usize, usize) {
    let before = &text[..error.span().map_or(0, |span| span.start.min(text.len()))];
    let line_start = before.rfind('\n').map_or(0, |i| i + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

impl Robot {
    /// Reads `robot.toml`, or the one in a folder.
    ///
    /// # Errors
    /// [`RobotError`]: one message with file and, where there is one, line and column.
    pub fn load(path: &Path) -> Result<Self, RobotError> {
        let path = if path.is_dir() { path.join("robot.toml") } else { path.to_owned() };
        let text = std::fs::read_to_string(&path)
            .map_err(|source| RobotError::Read { path: path.clone(), source })?;
        Self::parse(&text, &path)
    }

    /// Reads a description; `path` is what messages call it.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn parse(text: &str, path: &Path) -> Result<Self, RobotError> {
        let toml: RobotToml = toml::from_str(text).map_err(|error| {
            let (line, column) = line_and_column(text, &error);
            let message = error.message().trim().replace('\n', " ");
            RobotError::Syntax { path: path.to_owned(), line, column, message }
        })?;
        let sha256 = Sha256::digest(text.as_bytes()).into();
        let mut robot = Self::check(toml, sha256).map_err(|(key, message)| {
            RobotError::Meaning { path: path.to_owned(), key, message }
        })?;
        robot.schema.robot = Some(path.to_owned());
        Ok(robot)
    }

    fn check(toml: RobotToml, sha256: [u8; 32]) -> Result<Self, (String, String)> {
        let fail = |key: String, message: &str| Err((key, message.to_owned()));
        let mut names: Vec<&str> = Vec::new();
        let states = toml.states.iter().map(|s| ("states", &s.name));
        for (i, (list, name)) in
            states.chain(toml.inputs.iter().map(|u| ("inputs", &u.name))).enumerate()
        {
            let i = if list == "inputs" { i - toml.states.len() } else { i };
            let key = format!("{list}[{i}].name");
            let plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
            if name.is_empty()
                || !name.chars().all(plain)
                || name.starts_with(|c: char| c.is_ascii_digit())
            {
                return fail(
                    key,
                    "expected letters, digits and underscores, not beginning with a digit",
                );
            }
            if names.contains(&name.as_str()) {
                return fail(
                    key,
                    &format!(
                        "`{name}` is there already; every state and input needs a name of its own"
                    ),
                );
            }
            names.push(name);
        }
        if toml.states.is_empty() {
            return fail("states".into(), "expected at least one [[states]] entry");
        }
        if toml.name.is_empty() {
            return fail("name".into(), "expected a name");
        }
        if !(toml.sample_time_s.is_finite() && toml.sample_time_s > 0.0) {
            return fail("sample_time_s".into(), "expected seconds, greater than 0");
        }
        let coordinate = |name: &String| {
            toml.states
                .iter()
                .position(|s| s.name == *name)
                .and_then(|i| u8::try_from(i).ok())
                .ok_or_else(|| {
                    (
                        "symmetry.coordinates".to_owned(),
                        format!("`{name}` is not the name of a state"),
                    )
                })
        };
        let symmetry = match &toml.symmetry {
            SymmetryToml::None => Symmetry::None,
            SymmetryToml::Translation(names) => {
                let mut coordinates = 0;
                for name in names {
                    coordinates |= 1_u8.checked_shl(coordinate(name)?.into()).unwrap_or(0);
                }
                Symmetry::Translation { coordinates }
            }
            SymmetryToml::Se2(Exactly([x, y, heading])) => Symmetry::Se2 {
                x: coordinate(x)?,
                y: coordinate(y)?,
                heading: coordinate(heading)?,
            },
        };

        let mut schema = LogSchema {
            sample_time_s: toml.sample_time_s,
            time: toml.time_column.clone(),
            episode: toml.episode_column.clone(),
            states: Vec::new(),
            inputs: Vec::new(),
            robot: None,
        };
        let mut states = Vec::new();
        for (i, s) in toml.states.iter().enumerate() {
            let space = match s.space {
                SpaceToml::R => Space::Line,
                SpaceToml::S1 => Space::Circle,
            };
            let degrees = space == Space::Circle && s.unit == "deg";
            if space == Space::Circle && !degrees && !["", "rad"].contains(&s.unit.as_str()) {
                return fail(
                    format!("states[{i}].unit"),
                    "expected `rad` or `deg` for a coordinate on S1",
                );
            }
            let excluded = symmetry.excludes(u8::try_from(i).unwrap_or(u8::MAX));
            let target = match (s.target, excluded) {
                (Some(TargetToml::Absolute), true) => {
                    return fail(
                        format!("states[{i}].target"),
                        "a coordinate that the symmetry leaves out of the dictionary can only be predicted by its increment",
                    );
                }
                (Some(TargetToml::Increment), _) | (None, true) => Target::Increment,
                (Some(TargetToml::Absolute) | None, false) => Target::Absolute,
            };
            let limit = s.limit.as_ref().map(|limit| limit.0);
            if let Some([low, high]) = limit
                && low.partial_cmp(&high) != Some(Ordering::Less)
            {
                return fail(format!("states[{i}].limit"), "expected [low, high] with low < high");
            }
            let factor = if degrees { PI / 180.0 } else { 1.0 };
            schema.states.push(LogColumn {
                name: s.name.clone(),
                unit: s.unit.clone(),
                column: s.column.clone(),
                factor,
            });
            let circle_unit = || "rad".to_owned();
            states.push(RobotState {
                name: s.name.clone(),
                unit: if space == Space::Circle { circle_unit() } else { s.unit.clone() },
                space,
                target,
                limit: limit.map(|limit| limit.map(|x| x * factor)),
            });
        }
        let mut inputs = Vec::new();
        for (i, u) in toml.inputs.iter().enumerate() {
            let Exactly(range) = u.range;
            let [low, high] = range;
            if !(low < high && low.is_finite() && high.is_finite()) {
                return fail(format!("inputs[{i}].range"), "expected [low, high] with low < high");
            }
            schema.inputs.push(LogColumn {
                name: u.name.clone(),
                unit: u.unit.clone(),
                column: u.column.clone(),
                factor: 1.0,
            });
            inputs.push(RobotInput { name: u.name.clone(), unit: u.unit.clone(), range });
        }

        let positive = |key: &str, value: f64| {
            if value.is_finite() && value >= 0.0 {
                Ok(())
            } else {
                Err((key.to_owned(), "expected a number, 0 or more".to_owned()))
            }
        };
        positive("fit.ridge", toml.fit.ridge)?;
        positive("fit.refine", toml.fit.refine.unwrap_or(0.0))?;
        positive("fit.truncation", toml.fit.truncation)?;
        if toml.fit.truncation >= 1.0 {
            return fail("fit.truncation".into(), "expected a number below 1, or nothing is left");
        }
        for (key, value, range) in [
            ("score.horizon", toml.score.horizon, 1..=1_000_000),
            ("score.stride", toml.score.stride, 1..=1_000_000),
            ("score.folds", toml.score.folds, 2..=1_000),
        ] {
            if !range.contains(&value) {
                let (low, high) = (range.start(), range.end());
                return fail(key.into(), &format!("expected a whole number, {low} to {high}"));
            }
        }

        let mut parts = DictionaryParts {
            states: &states,
            inputs: &inputs,
            symmetry,
            observables: Vec::new(),
            factors: Vec::new(),
            blocks: Vec::new(),
        };
        let chain = match toml.dictionary.terms.is_empty() {
            true => {
                parts.build(&toml.dictionary)?;
                None
            }
            false => Some(parts.build_terms(&toml.dictionary)?),
        };
        let DictionaryParts { observables, factors, blocks, .. } = parts;
        let robot = Self {
            name: toml.name,
            schema,
            states,
            inputs,
            symmetry,
            observables,
            factors,
            blocks,
            chain,
            standardise: toml.dictionary.standardise,
            fit: toml.fit,
            score: toml.score,
            budget: toml.budget,
            sha256,
        };
        // Everything that the controller will check is checked here once, with its words.
        robot
            .structure(
                &robot.identity_scaling(),
                &robot.limits(),
                Provenance { logs: [0; 32], robot: sha256 },
            )
            .map_err(|error| ("dictionary".to_owned(), explain(&error, &robot)))?;
        Ok(robot)
    }

    /// The description as the core's checked structure, borrowing the names.
    ///
    /// # Errors
    /// [`ModelError`]: capacities, mostly; a loaded robot has been checked with its own limits.
    pub fn structure(
        &self,
        scaling: &[[f32; 2]],
        limits: &[[f32; 2]],
        provenance: Provenance,
    ) -> Result<Structure<'_>, ModelError> {
        let too_many = |field, expected: usize, found: usize| ModelError::DimensionMismatch {
            field,
            expected,
            found,
        };
        let mut repr = ModelRepr {
            robot: &self.name,
            sample_time_s: self.schema.sample_time_s as f32,
            states: Default::default(),
            inputs: Default::default(),
            symmetry: self.symmetry,
            observables: Default::default(),
            factors: Default::default(),
            blocks: Default::default(),
            provenance,
        };
        for (s, limit) in self.states.iter().zip(limits) {
            let state = State {
                name: &s.name,
                unit: &s.unit,
                space: s.space,
                target: s.target,
                limit: *limit,
            };
            let room = repr.states.capacity();
            repr.states.push(state).map_err(|_| too_many("states", room, self.states.len()))?;
        }
        for u in &self.inputs {
            let input = Input { name: &u.name, unit: &u.unit, range: u.range.map(|x| x as f32) };
            let room = repr.inputs.capacity();
            repr.inputs.push(input).map_err(|_| too_many("inputs", room, self.inputs.len()))?;
        }
        for ((source, lag), [centre, gain]) in self.observables.iter().zip(scaling) {
            let observable =
                Observable { source: *source, lag: *lag, centre: *centre, gain: *gain };
            let room = repr.observables.capacity();
            repr.observables
                .push(observable)
                .map_err(|_| too_many("observables", room, self.observables.len()))?;
        }
        let room = repr.factors.capacity();
        repr.factors
            .extend_from_slice(&self.factors)
            .map_err(|_| too_many("factors", room, self.factors.len()))?;
        let room = repr.blocks.capacity();
        repr.blocks
            .extend_from_slice(&self.blocks)
            .map_err(|_| too_many("blocks", room, self.blocks.len()))?;
        Structure::try_from(repr)
    }

    /// Centre 0 and gain 1 for every observable.
    pub fn identity_scaling(&self) -> Scaling {
        vec![[0.0, 1.0]; self.observables.len()]
    }

    /// The hard limits of the description; where it has none, no limit.
    pub fn limits(&self) -> Vec<[f32; 2]> {
        let no_limit = [f64::NEG_INFINITY, f64::INFINITY];
        self.states.iter().map(|s| s.limit.unwrap_or(no_limit).map(|x| x as f32)).collect()
    }
}

/// The core's reasons in the words of robot.toml.
fn explain(error: &ModelError, robot: &Robot) -> String {
    use firmware_core::dictionary::DictionaryError;
    let factor_name = |factor: usize| {
        robot.factors.get(factor).map_or_else(String::new, |f| {
            crate::terms::observable_name(robot, robot.observables[usize::from(f.observable)])
        })
    };
    match error {
        ModelError::DimensionMismatch { field, expected, found } => {
            format!("{found} {field}; the controller has room for {expected}")
        }
        ModelError::Dictionary(DictionaryError::TooLarge { field, capacity, found }) => {
            format!(
                "{found} {field}; the controller has room for {capacity}; lower an order or leave a variable out"
            )
        }
        ModelError::Dictionary(DictionaryError::Factor { factor }) => {
            format!("`{}` is used twice in its block", factor_name(*factor))
        }
        ModelError::Symmetry { coordinate } => format!(
            "symmetry: `{}` does not fit; expected two coordinates on R and a heading on S1, each once",
            robot.states.get(usize::from(*coordinate)).map_or("?", |s| &s.name)
        ),
        ModelError::Observable { observable } => format!(
            "`{}` cannot be observed: the lag is beyond {}, or the symmetry leaves the coordinate out (use d({}))",
            crate::terms::observable_name(robot, robot.observables[*observable]),
            firmware_core::capacity::MAX_LAG,
            "name@lag"
        ),
        other => format!("{other:?}"),
    }
}

/// A function in a listed term.
#[derive(Clone, Copy, Debug)]
enum Function {
    /// A power of an observable.
    Power { source: Source, lag: u8, power: u8 },
    /// sin or cos of n times an angle; `source` is its sine.
    Harmonic { source: Source, lag: u8, n: u8, cosine: bool },
}

impl Function {
    /// The factor that provides it, and the order that the factor needs.
    fn factor(self) -> (Source, u8, Basis, u8) {
        match self {
            Self::Power { source, lag, power } => (source, lag, Basis::Hermite, power),
            Self::Harmonic { source, lag, n, .. } => (source, lag, Basis::Fourier, n),
        }
    }

    /// Its number within the factor, from 1 on.
    fn digit(self) -> usize {
        match self {
            Self::Power { power, .. } => power.into(),
            Self::Harmonic { n, cosine, .. } => 2 * usize::from(n) - usize::from(!cosine),
        }
    }
}

/// The factors of a product: split at each `*` outside of parentheses.
fn split_product(text: &str) -> impl Iterator<Item = &str> {
    let mut depth = 0;
    text.split(move |c| {
        depth += i32::from(c == '(') - i32::from(c == ')');
        c == '*' && depth == 0
    })
}

/// Collects observables, factors and blocks.
struct DictionaryParts<'r> {
    states: &'r [RobotState],
    inputs: &'r [RobotInput],
    symmetry: Symmetry,
    observables: Vec<(Source, u8)>,
    factors: Vec<Factor>,
    blocks: Vec<Block>,
}

impl DictionaryParts<'_> {
    fn build(&mut self, toml: &DictionaryToml) -> Result<(), (String, String)> {
        let known = |name: &str| {
            let states = self.states.iter().any(|s| s.name == name);
            states || self.inputs.iter().any(|u| u.name == name)
        };
        for name in toml.orders.keys() {
            if !known(name) {
                return Err((
                    format!("dictionary.orders.{name}"),
                    "is neither a state nor an input".into(),
                ));
            }
        }
        for name in toml.fourier.keys() {
            if !self.states.iter().any(|s| s.name == *name && s.space == Space::Circle) {
                return Err((format!("dictionary.fourier.{name}"), "is not a state on S1".into()));
            }
        }
        if toml.blocks.is_empty() {
            self.kronecker_block(toml);
        }
        for (b, block) in toml.blocks.iter().enumerate() {
            for (f, text) in block.factors.iter().enumerate() {
                let (source, lag, basis, order) = self
                    .parse_factor(text)
                    .map_err(|message| (format!("dictionary.blocks[{b}].factors[{f}]"), message))?;
                self.factor(source, lag, basis, order);
            }
            self.close_block(block.factors.len(), block.max_degree);
        }
        // Lagged samples enter linearly: one block [1, v] each, whose constant is held already.
        for lag in 1..=toml.delays.states.max(toml.delays.inputs) {
            let mut lagged = Vec::new();
            if lag <= toml.delays.states {
                for (i, state) in self.states.iter().enumerate() {
                    let i = i as u8;
                    match state.space {
                        _ if self.symmetry.excludes(i) => lagged.push(Source::Increment(i)),
                        Space::Line => lagged.push(Source::State(i)),
                        Space::Circle => lagged.extend([Source::Sin(i), Source::Cos(i)]),
                    }
                }
            }
            if lag <= toml.delays.inputs {
                lagged.extend((0..self.inputs.len()).map(|i| Source::Input(i as u8)));
            }
            for source in lagged {
                self.factor(source, lag, Basis::Hermite, 1);
                self.close_block(1, 0);
            }
        }
        Ok(())
    }

    /// The functions that the listed terms are products of, each observable's a block of its own,
    /// and the chain of the terms.
    fn build_terms(&mut self, toml: &DictionaryToml) -> Result<Chain, (String, String)> {
        let default = DictionaryToml::default();
        let others = [
            ("order", toml.order != default.order),
            ("orders", !toml.orders.is_empty()),
            ("fourier", !toml.fourier.is_empty()),
            ("delays", toml.delays.states > 0 || toml.delays.inputs > 0),
            ("blocks", !toml.blocks.is_empty()),
            ("max_degree", toml.max_degree > 0),
        ];
        if let Some((name, _)) = others.iter().find(|(_, given)| *given) {
            let message = "has no meaning beside `terms`, which list the whole dictionary";
            return Err((format!("dictionary.{name}"), message.to_owned()));
        }
        let mut terms: Vec<Vec<Function>> = Vec::new();
        for (t, text) in toml.terms.iter().enumerate() {
            let fail = |message| (format!("dictionary.terms[{t}]"), message);
            let functions: Result<Vec<Function>, String> =
                split_product(text).map(|part| self.parse_function(part)).collect();
            let functions = functions.map_err(fail)?;
            terms.push(functions);
        }
        // One polynomial factor per observable and one Fourier factor per angle and lag, as high as
        // the terms need them.
        let mut factors: Vec<(Source, u8, Basis, u8)> = Vec::new();
        for function in terms.iter().flatten() {
            let (source, lag, basis, degree) = function.factor();
            match factors.iter_mut().find(|f| (f.0, f.1, f.2) == (source, lag, basis)) {
                Some(found) => found.3 = found.3.max(degree),
                None => factors.push((source, lag, basis, degree)),
            }
        }
        let mut first = Vec::new();
        let mut functions = 0;
        for (source, lag, basis, degree) in &factors {
            self.factor(*source, *lag, *basis, *degree);
            self.close_block(1, 0);
            first.push(functions);
            functions += match basis {
                Basis::Hermite => usize::from(*degree),
                Basis::Fourier => 2 * usize::from(*degree),
            };
        }
        let index = |function: &Function| {
            let (source, lag, basis, _) = function.factor();
            let factor = factors.iter().position(|f| (f.0, f.1, f.2) == (source, lag, basis));
            let index = factor.map_or(0, |f| first[f]) + function.digit() - 1;
            u8::try_from(index).unwrap_or(u8::MAX)
        };
        let mut products: Vec<Vec<u8>> = Vec::new();
        for (t, term) in terms.iter().enumerate() {
            let mut product: Vec<u8> = term.iter().map(index).collect();
            product.sort_unstable();
            if products.contains(&product) {
                let message = format!("`{}` is listed twice", toml.terms[t]);
                return Err((format!("dictionary.terms[{t}]"), message));
            }
            products.push(product);
        }
        let full = || {
            let message = format!(
                "more terms, or functions in them, than the controller has room for ({} and {})",
                firmware_core::capacity::MAX_SPARSE_TERMS,
                firmware_core::capacity::MAX_FUNCTIONS
            );
            ("dictionary.terms".to_owned(), message)
        };
        if functions > firmware_core::capacity::MAX_FUNCTIONS {
            return Err(full());
        }
        Chain::new(&products).ok_or_else(full)
    }

    /// `x^2`, `u@1`, `d(x)@1^3`, `sin(phi)`, `cos(3*phi)@1`.
    fn parse_function(&self, text: &str) -> Result<Function, String> {
        let text = text.trim();
        let harmonic = |function: &str| {
            let (inside, behind) =
                text.strip_prefix(function)?.strip_prefix('(')?.split_once(')')?;
            let (n, name) = inside.split_once('*')?;
            Some((n.trim().parse::<u8>().ok()?, name.trim(), behind.trim()))
        };
        for (function, cosine) in [("sin", false), ("cos", true)] {
            let Some((n, name, behind)) = harmonic(function) else { continue };
            let (source, lag, _, order) = self.parse_factor(&format!("sin({name}){behind}"))?;
            if n == 0 || n > firmware_core::capacity::MAX_ORDER || order != 1 {
                return Err(format!(
                    "`{text}`: expected a harmonic of 1 to {} without an exponent",
                    firmware_core::capacity::MAX_ORDER
                ));
            }
            return Ok(Function::Harmonic { source, lag, n, cosine });
        }
        match self.parse_factor(text)? {
            (_, _, Basis::Fourier, _) => {
                Err(format!("`{text}`: a term is made of sin(n*angle) and cos(n*angle)"))
            }
            (_, _, _, power) if power == 0 || power > firmware_core::capacity::MAX_ORDER => {
                Err(format!(
                    "`{text}`: expected an exponent of 1 to {}",
                    firmware_core::capacity::MAX_ORDER
                ))
            }
            (source, lag, Basis::Hermite, power) => Ok(Function::Power { source, lag, power }),
        }
    }

    /// The paper's dictionary: one block that holds everything.
    fn kronecker_block(&mut self, toml: &DictionaryToml) {
        let order = |name: &str| toml.orders.get(name).copied().unwrap_or(toml.order);
        let mut count = 0;
        for (i, state) in self.states.iter().enumerate() {
            let (i, p) = (i as u8, order(&state.name));
            let fourier = toml.fourier.get(&state.name).copied().unwrap_or(0);
            if self.symmetry.excludes(i) {
            } else if fourier > 0 {
                self.factor(Source::Sin(i), 0, Basis::Fourier, fourier);
                count += 1;
            } else if p > 0 && state.space == Space::Circle {
                self.factor(Source::Sin(i), 0, Basis::Hermite, p);
                self.factor(Source::Cos(i), 0, Basis::Hermite, p);
                count += 2;
            } else if p > 0 {
                self.factor(Source::State(i), 0, Basis::Hermite, p);
                count += 1;
            }
        }
        for (i, input) in self.inputs.iter().enumerate() {
            let p = order(&input.name);
            if p > 0 {
                self.factor(Source::Input(i as u8), 0, Basis::Hermite, p);
                count += 1;
            }
        }
        self.close_block(count, toml.max_degree);
    }

    fn close_block(&mut self, factors: usize, max_degree: u8) {
        self.blocks.push(Block { factors: factors.try_into().unwrap_or(u8::MAX), max_degree });
    }

    fn factor(&mut self, source: Source, lag: u8, basis: Basis, order: u8) {
        let observable = self.observable(source, lag) as u8;
        self.factors.push(Factor { observable, basis, order });
    }

    /// The index of an observable. Sine and cosine of an angle are listed together, the sine first,
    /// as a Fourier factor wants them.
    fn observable(&mut self, source: Source, lag: u8) -> usize {
        let found = self.observables.iter().position(|o| *o == (source, lag));
        found.unwrap_or_else(|| {
            let first = self.observables.len();
            match source {
                Source::Sin(i) | Source::Cos(i) => {
                    self.observables.extend([(Source::Sin(i), lag), (Source::Cos(i), lag)]);
                    first + usize::from(source == Source::Cos(i))
                }
                _ => {
                    self.observables.push((source, lag));
                    first
                }
            }
        })
    }

    /// `x`, `sin(phi)`, `cos(phi)`, `fourier(phi)`, `d(x)`, `u`, each with `@lag` and `^order` behind.
    fn parse_factor(&self, text: &str) -> Result<(Source, u8, Basis, u8), String> {
        let number = |digits: &str, what: &str| {
            digits
                .parse::<u8>()
                .map_err(|_| format!("`{text}`: expected a whole number behind `{what}`"))
        };
        let (rest, order) = match text.split_once('^') {
            Some((rest, order)) => (rest, number(order, "^")?),
            None => (text, 1),
        };
        let (expression, lag) = match rest.split_once('@') {
            Some((expression, lag)) => (expression.trim(), number(lag.trim(), "@")?),
            None => (rest.trim(), 0),
        };
        let call = expression.strip_suffix(')').and_then(|e| e.split_once('('));
        let (function, name) = call.unwrap_or(("", expression));
        let state = self.states.iter().position(|s| s.name == name.trim()).map(|i| i as u8);
        let input = self.inputs.iter().position(|u| u.name == name.trim()).map(|i| i as u8);
        let space = state.map(|i| self.states[usize::from(i)].space);
        let source = match (function.trim(), state, input, space) {
            ("", Some(i), _, Some(Space::Line)) => (Source::State(i), Basis::Hermite),
            ("", _, Some(i), _) => (Source::Input(i), Basis::Hermite),
            ("sin", Some(i), _, Some(Space::Circle)) => (Source::Sin(i), Basis::Hermite),
            ("cos", Some(i), _, Some(Space::Circle)) => (Source::Cos(i), Basis::Hermite),
            ("fourier", Some(i), _, Some(Space::Circle)) => (Source::Sin(i), Basis::Fourier),
            ("d", Some(i), _, _) if lag > 0 => (Source::Increment(i), Basis::Hermite),
            ("d", Some(_), _, _) => {
                return Err(format!(
                    "`{text}`: an increment needs a lag of 1 or more, such as `d({name})@1`"
                ));
            }
            ("", Some(_), _, _) => {
                return Err(format!(
                    "`{text}` lives on S1: use sin({name}), cos({name}) or fourier({name})"
                ));
            }
            (_, None, None, _) => {
                return Err(format!("`{name}` in `{text}` is neither a state nor an input"));
            }
            _ => {
                return Err(format!(
                    "`{text}`: expected a state on R or an input, sin(), cos() or fourier() of a state on S1, \
                     or d() of a state, then @lag and ^order if wanted"
                ));
            }
        };
        Ok((source.0, lag, source.1, order))
    }
}
