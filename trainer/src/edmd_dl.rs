//! EDMD with dictionary learning: the dictionary is a neural network that is trained together with
//! the Koopman operator (Li, Dietrich, Bollt & Kevrekidis, "Extended dynamic mode decomposition
//! with dictionary learning", Chaos 27, 103111, 2017, algorithm 2).
//!
//! ```text
//! Ψ(x, u) = [z, 1, W_out h₃ + b_out],  h_{k+1} = tanh(W_k h_k + b_k),  k = 0, 1, 2,  h₀ = z
//! ```
//!
//! z holds the observables (x on the line, sin x and cos x on the circle) and the inputs, each
//! centred and divided by its standard deviation. What is minimised over N snapshot pairs is
//!
//! ```text
//! J = 1/2N Σ |Δs − Ψ D_s|² + c² |Ψ_θ(x⁺, u) − Ψ_θ(x, u) − Ψ D_θ|²,  Ψ = Ψ(x, u),  K = 1 + D
//! ```
//!
//! with Δs the change of the observables and Ψ_θ the trainable outputs. The next input cannot be
//! predicted, so the present one is held: K is the Koopman operator of the robot under a held input.
//!
//! - K is found as its difference D from 1, so that the ridge pulls towards "nothing moves" and no
//!   digits are lost to the large part of a state that does not change.
//! - Every Δs is divided by its root mean square: states count by how well their *change* is
//!   predicted, whatever their units and the sample time.
//! - Closure is bought with the accuracy of the states: c = 0.3 costs nothing measurable, c = 1
//!   doubles the error of the ROSbot's heading.
//! - J would fall if the trainable outputs shrank. Each one is therefore brought back to mean 0 and
//!   deviation 1 whenever K is solved for, which leaves the span of the dictionary as it is.
//!
//! The two steps alternate every few batches: K by least squares from running sums of ΨᵀΨ and ΨᵀΔ,
//! θ by Adam (Kingma & Ba 2015) with a learning rate that rises over the first 2 % of the steps and
//! falls as (1 − t)². A fifth of the pairs, in five blocks, is not trained on; the θ kept is the one
//! that predicts them best. Last comes K over all pairs.
//!
//! θ is trained in f32, K is solved for in f64. Sums have a fixed order and every operation is
//! exactly rounded, as in [`gram`](crate::gram): the bits depend on the seed and the data, not on
//! the machine.
//!
//! The network is our own: three matrix products and their gradients, in a fixed order of operations.
//! The frameworks at hand bring dozens of crates and sums whose bits depend on the machine.

use firmware_core::Scalar;
use firmware_core::model::Space;
use pulp::{Simd, WithSimd};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::forecast::{Baseline, BaselineError, Data, Forecast};
use crate::solve::{self, RFactor, Svd};

/// Samples whose sums are kept apart, whatever the width of the vector unit.
const LANES: usize = 8;
/// Rows and vectors of a register tile.
const TILE: (usize, usize) = (4, 2);
/// Buffers hold a multiple of this many samples.
const GRAIN: usize = LANES * TILE.1;
/// Layers with weights: three hidden ones and the output.
const LAYERS: usize = 4;
/// Batches from one K to the next.
const REFRESH: usize = 8;
/// What is left of the running sums from one K to the next.
const MEMORY: f64 = 0.95;
/// Adam's decay of the mean gradient and of the mean squared gradient.
const BETA: (f32, f32) = (0.9, 0.99);
/// Adam's guard against division by 0.
const EPSILON: f32 = 1e-8;
/// Largest sizes: beyond them a setting is a slip of the pen.
const MAX_SIZE: usize = 4096;
/// A deviation this small beside the mean is rounding noise of a column that does not move: in f64,
const STILL: f64 = 1e-10;
/// and in the f32 sums over a batch.
const STILL_F32: f64 = 1e-3;

/// How a dictionary is learned. The defaults serve all systems.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Seed of the initial weights and of the order of the samples.
    pub seed: u64,
    /// Dictionary outputs: a constant, the observables, the inputs and at least one trainable one.
    pub outputs: usize,
    /// Units in each of the three hidden layers.
    pub width: usize,
    /// Passes over the training data.
    pub passes: usize,
    /// Gradient steps at least: few data are passed over more often.
    pub least_steps: usize,
    /// Snapshot pairs in a batch, rounded up to a multiple of 16.
    pub batch: usize,
    /// Adam's largest step, per weight.
    pub learning_rate: f64,
    /// c, the weight of the closure of the trainable outputs, relative to that of a state.
    pub closure: f64,
    /// Ridge while training, on the Gram matrix with a unit diagonal; the last K has a thousandth
    /// of it.
    pub ridge: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 1,
            outputs: 25,
            width: 32,
            passes: 120,
            least_steps: 3000,
            batch: 32,
            learning_rate: 4e-3,
            closure: 0.3,
            ridge: 1e-6,
        }
    }
}

impl Settings {
    fn check(&self, fixed: usize) -> Result<(), BaselineError> {
        let wrong = |text| Err(BaselineError::Settings(text));
        if !(fixed + 1..=MAX_SIZE).contains(&self.outputs) {
            return wrong(format!(
                "outputs must be from {} (a constant, observables, inputs and one trainable \
                 output) to {MAX_SIZE}, not {}",
                fixed + 1,
                self.outputs
            ));
        }
        let sizes = [("width", self.width), ("passes", self.passes), ("batch", self.batch)];
        if let Some((name, size)) = sizes.iter().find(|(_, n)| !(1..=MAX_SIZE).contains(n)) {
            return wrong(format!("{name} must be from 1 to {MAX_SIZE}, not {size}"));
        }
        let numbers = [
            ("learning_rate", self.learning_rate, 0.0),
            ("closure", self.closure, 0.0),
            ("ridge", self.ridge, 1e-9),
        ];
        if let Some((name, x, least)) = numbers.iter().find(|(_, x, l)| !(*l..=1e3).contains(x)) {
            return wrong(format!("{name} must be from {least} to 1000, not {x}"));
        }
        Ok(())
    }
}

/// A learned dictionary and the state columns of K.
#[derive(Clone, Debug)]
pub struct EdmdDl {
    features: Features,
    network: Network,
    /// Columns of D for the observables, shape `[outputs, observables]`.
    change: Vec<f64>,
}

impl Baseline for EdmdDl {
    type Settings = Settings;

    /// # Errors
    /// [`BaselineError::NoPairs`] without two samples in a row, [`BaselineError::Settings`] if a
    /// setting is out of range, [`BaselineError::NotFinite`] if the data or the weights are.
    fn fit(training: Data<'_>, settings: &Settings) -> Result<Self, BaselineError> {
        let (features, table) = Features::new(training)?;
        settings.check(features.scale.len() + 1)?;
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let mut learner = Learner::new(&features, &table, settings, &mut rng);
        learner.train(&mut rng)?;
        let change = learner.state_columns();
        let network = learner.network;
        if change.iter().all(|d| d.is_finite()) && network.theta.iter().all(|w| w.is_finite()) {
            Ok(Self { features, network, change })
        } else {
            Err(BaselineError::NotFinite)
        }
    }
}

impl Forecast for EdmdDl {
    fn numbers(&self) -> usize {
        self.network.theta.len() + self.change.len()
    }

    /// s⁺ = s + Ψ(x, u) D_s; angles in (−π, π] by their sine and cosine.
    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
        let f = &self.features;
        let mut values = Vec::with_capacity(f.scale.len());
        observe(&f.spaces, &states[states.len() - f.spaces.len()..], &mut values);
        values.extend_from_slice(&inputs[inputs.len() - f.inputs..]);
        let mut pass = self.network.pass(GRAIN, 0);
        for ((x, scale), to) in values.iter().zip(&f.scale).zip(pass.lifted.chunks_exact_mut(GRAIN))
        {
            to[0] = standardise(*x, *scale);
        }
        self.network.forward(&mut pass);
        let observables = f.change.len();
        for (j, (value, scale)) in values.iter_mut().zip(&f.change).enumerate() {
            let weights = self.change[j..].iter().step_by(observables);
            let psi = pass.lifted.iter().step_by(GRAIN);
            *value += scale * psi.zip(weights).map(|(p, d)| f64::from(*p) * d).sum::<f64>();
        }
        let mut at = 0;
        for (space, next) in f.spaces.iter().zip(&mut *next) {
            *next = match space {
                Space::Line => values[at],
                Space::Circle => Scalar::atan2(values[at], values[at + 1]),
            };
            at += dimension(*space);
        }
        next.iter().all(|x| x.is_finite())
    }
}

/// Observables of a coordinate.
fn dimension(space: Space) -> usize {
    match space {
        Space::Line => 1,
        Space::Circle => 2,
    }
}

fn observe(spaces: &[Space], state: &[f64], values: &mut Vec<f64>) {
    for (space, x) in spaces.iter().zip(state) {
        match space {
            Space::Line => values.push(*x),
            Space::Circle => values.extend(<[f64; 2]>::from(Scalar::sin_cos(*x))),
        }
    }
}

fn standardise(x: f64, [centre, deviation]: [f64; 2]) -> f32 {
    ((x - centre) / deviation) as f32
}

/// The root of a mean square, or 1 for a column that does not move: up to `floor`, it is rounding
/// noise. NaN stays NaN.
fn deviation(square: f64, floor: f64) -> f64 {
    if square <= floor * floor { 1.0 } else { square.sqrt() }
}

/// How states and inputs become z and Δs.
#[derive(Clone, Debug)]
struct Features {
    spaces: Vec<Space>,
    inputs: usize,
    /// Mean and deviation of every observable, then of every input.
    scale: Vec<[f64; 2]>,
    /// Root mean square of the one-step change of every observable.
    change: Vec<f64>,
}

/// Snapshot pairs as rows of z, of the observables in z⁺, and of Δs.
struct Table {
    width: usize,
    rows: Vec<f32>,
}

impl Table {
    fn pairs(&self) -> usize {
        self.rows.len() / self.width
    }
}

impl Features {
    fn new(data: Data<'_>) -> Result<(Self, Table), BaselineError> {
        let observables = data.spaces.iter().copied().map(dimension).sum::<usize>();
        let p = observables + data.inputs;
        let mut raw = Vec::new();
        for (x, u, next) in data.pairs() {
            observe(data.spaces, x, &mut raw);
            raw.extend_from_slice(u);
            observe(data.spaces, next, &mut raw);
        }
        if raw.is_empty() {
            return Err(BaselineError::NoPairs);
        }
        let rows = raw.chunks_exact(p + observables);
        let pairs = rows.len();
        let mean =
            |value: &dyn Fn(&[f64]) -> f64| rows.clone().map(value).sum::<f64>() / pairs as f64;
        let scale: Vec<[f64; 2]> = (0..p)
            .map(|f| {
                let centre = mean(&|r| r[f]);
                [centre, deviation(mean(&|r| (r[f] - centre) * (r[f] - centre)), STILL * centre)]
            })
            .collect();
        let change: Vec<f64> = (0..observables)
            .map(|f| {
                let square = mean(&|r| (r[p + f] - r[f]) * (r[p + f] - r[f]));
                deviation(square, STILL * scale[f][0])
            })
            .collect();
        if !scale.iter().flatten().chain(&change).all(|x| x.is_finite()) {
            return Err(BaselineError::NotFinite);
        }
        let width = p + 2 * observables;
        let mut table = Vec::with_capacity(pairs * width);
        for r in rows {
            table
                .extend(r.iter().zip(scale.iter().chain(&scale)).map(|(x, s)| standardise(*x, *s)));
            table.extend((0..observables).map(|f| ((r[p + f] - r[f]) / change[f]) as f32));
        }
        let spaces = data.spaces.to_vec();
        Ok((Self { spaces, inputs: data.inputs, scale, change }, Table { width, rows: table }))
    }
}

/// The trainable part of the dictionary.
#[derive(Clone, Debug)]
struct Network {
    arch: pulp::Arch,
    /// z, three hidden layers, trainable outputs.
    sizes: [usize; LAYERS + 1],
    /// Layer after layer, shape `[to, from + 1]`, the bias last.
    theta: Vec<f32>,
}

/// The values of a batch; every row is `stride` samples, the batch and then its successors.
struct Pass {
    stride: usize,
    /// z, ones, trainable outputs.
    lifted: Vec<f32>,
    /// Hidden layers, with ones below.
    hidden: [Vec<f32>; LAYERS - 1],
    /// Gradients of J with respect to a layer, and to the one before it.
    delta: [Vec<f32>; 2],
    /// What is to be predicted, or what is left of it: Δs, then the change of the outputs.
    residual: Vec<f32>,
}

impl Network {
    /// Weights uniform in ±√(6 / (from + to)), biases 0 (Glorot & Bengio 2010, equation 16).
    fn new(sizes: [usize; LAYERS + 1], rng: &mut impl Rng) -> Self {
        let mut theta = Vec::new();
        for layer in sizes.windows(2) {
            let limit = (6.0 / (layer[0] + layer[1]) as f64).sqrt();
            for _ in 0..layer[1] {
                let draw = |_| (limit * (2.0 * rng.random::<f64>() - 1.0)) as f32;
                theta.extend((0..layer[0]).map(draw).chain([0.0]));
            }
        }
        Self { arch: pulp::Arch::new(), sizes, theta }
    }

    /// Where the weights of a layer begin.
    fn offset(&self, layer: usize) -> usize {
        self.sizes.windows(2).take(layer).map(|s| (s[0] + 1) * s[1]).sum()
    }

    fn pass(&self, stride: usize, targets: usize) -> Pass {
        let [p, w, .., t] = self.sizes;
        let mut lifted = vec![0.0; (p + 1 + t) * stride];
        lifted[p * stride..][..stride].fill(1.0);
        let mut hidden = vec![0.0; (w + 1) * stride];
        hidden[w * stride..].fill(1.0);
        let delta = vec![0.0; w.max(t) * stride];
        Pass {
            stride,
            lifted,
            hidden: [hidden.clone(), hidden.clone(), hidden],
            delta: [delta.clone(), delta],
            residual: vec![0.0; targets * stride],
        }
    }

    /// The trainable outputs of z.
    fn forward(&self, pass: &mut Pass) {
        let stride = pass.stride;
        let (z, outputs) = pass.lifted.split_at_mut((self.sizes[0] + 1) * stride);
        for l in 0..LAYERS {
            let (from, to) = (self.sizes[l] + 1, self.sizes[l + 1]);
            let (before, after) = pass.hidden.split_at_mut(l);
            let input = before.last().map_or(&*z, |h| h);
            let out = after.first_mut().map_or(&mut *outputs, |h| h);
            let weights = Weights(&self.theta[self.offset(l)..], (to, from), (from, 1));
            let samples = (stride, stride);
            self.arch.dispatch(Product { weights, input, out, samples, add: false });
            if l < LAYERS - 1 {
                self.arch.dispatch(Tanh(&mut out[..to * stride]));
            }
        }
    }

    /// The gradient of J with respect to θ from that with respect to the outputs, `delta[0]`.
    fn backward(&self, pass: &mut Pass, gradient: &mut [f32]) {
        let stride = pass.stride;
        let [delta, before] = &mut pass.delta;
        for l in (0..LAYERS).rev() {
            let (from, to) = (self.sizes[l], self.sizes[l + 1]);
            let input = l.checked_sub(1).map_or(&pass.lifted, |h| &pass.hidden[h]);
            let (offset, samples, shape) = (self.offset(l), (stride, stride), (to, from + 1));
            let out = &mut gradient[offset..];
            self.arch.dispatch(Outer { left: delta, right: input, shape, samples, out });
            if l > 0 {
                let weights = Weights(&self.theta[offset..], (from, to), (1, from + 1));
                let (input, out) = (&*delta, &mut *before);
                self.arch.dispatch(Product { weights, input, out, samples, add: false });
                let hidden = &pass.hidden[l - 1];
                for (d, h) in before[..from * stride].iter_mut().zip(hidden) {
                    *d *= 1.0 - h * h;
                }
                std::mem::swap(delta, before);
            }
        }
    }
}

/// A matrix: numbers, shape, and the strides from row to row and from column to column.
struct Weights<'w>(&'w [f32], (usize, usize), (usize, usize));

/// `out[i] = Σⱼ weights[i, j] input[j]`, on top of what is there if `add`. `samples` are the length
/// of a row and how many of it count.
struct Product<'p> {
    weights: Weights<'p>,
    input: &'p [f32],
    out: &'p mut [f32],
    samples: (usize, usize),
    add: bool,
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Weights(weights, (rows, inner), (down, right)) = self.weights;
        let (stride, columns) = (self.samples.0 / S::F32_LANES, self.samples.1 / S::F32_LANES);
        let input = S::as_simd_f32s(&self.input[..inner * self.samples.0]).0;
        let out = S::as_mut_simd_f32s(&mut self.out[..rows * self.samples.0]).0;
        let mut panel = vec![[0.0; TILE.0]; inner];
        for first in (0..rows).step_by(TILE.0) {
            // Beyond the edge the last row is multiplied again and not used.
            let row = |k: usize| (first + k).min(rows - 1) * down;
            for (j, panel) in panel.iter_mut().enumerate() {
                *panel = std::array::from_fn(|k| weights[row(k) + j * right]);
            }
            for column in (0..columns).step_by(TILE.1) {
                let mut tile = [[simd.splat_f32s(0.0); TILE.1]; TILE.0];
                for (weights, x) in panel.iter().zip(input.chunks_exact(stride)) {
                    let x = &x[column..column + TILE.1];
                    for (tile, w) in tile.iter_mut().zip(weights) {
                        let w = simd.splat_f32s(*w);
                        for (sum, x) in tile.iter_mut().zip(x) {
                            *sum = simd.mul_add_f32s(w, *x, *sum);
                        }
                    }
                }
                for (out, tile) in out[first * stride..].chunks_exact_mut(stride).zip(&tile) {
                    for (out, sum) in out[column..column + TILE.1].iter_mut().zip(tile) {
                        *out = if self.add { simd.add_f32s(*out, *sum) } else { *sum };
                    }
                }
            }
        }
    }
}

/// `out[i, j] = Σ left[i] right[j]` over the samples that count.
struct Outer<'o> {
    left: &'o [f32],
    right: &'o [f32],
    shape: (usize, usize),
    samples: (usize, usize),
    out: &'o mut [f32],
}

impl WithSimd for Outer<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (p, q) = self.shape;
        let (stride, columns) = (self.samples.0 / S::F32_LANES, self.samples.1 / S::F32_LANES);
        let parts = LANES / S::F32_LANES;
        let left = S::as_simd_f32s(&self.left[..p * self.samples.0]).0;
        let right = S::as_simd_f32s(&self.right[..q * self.samples.0]).0;
        for i in (0..p).step_by(TILE.0) {
            let row = |k: usize| &left[(i + k).min(p - 1) * stride..][..columns];
            let l: [_; TILE.0] = std::array::from_fn(row);
            for j in (0..q).step_by(TILE.1) {
                let row = |k: usize| &right[(j + k).min(q - 1) * stride..][..columns];
                let r: [_; TILE.1] = std::array::from_fn(row);
                let mut sums = [[[0.0_f32; LANES]; TILE.1]; TILE.0];
                for part in 0..parts {
                    let mut tile = [[simd.splat_f32s(0.0); TILE.1]; TILE.0];
                    for c in (part..columns).step_by(parts) {
                        for (tile, l) in tile.iter_mut().zip(&l) {
                            for (sum, r) in tile.iter_mut().zip(&r) {
                                *sum = simd.mul_add_f32s(l[c], r[c], *sum);
                            }
                        }
                    }
                    for (sums, tile) in sums.iter_mut().zip(&tile) {
                        for (sums, sum) in sums.iter_mut().zip(tile) {
                            S::as_mut_simd_f32s(sums).0[part] = *sum;
                        }
                    }
                }
                for (out, sums) in self.out[i * q..p * q].chunks_exact_mut(q).zip(&sums) {
                    for (out, [a, b, c, d, e, f, g, h]) in out[j..].iter_mut().zip(sums) {
                        *out = ((a + e) + (c + g)) + ((b + f) + (d + h));
                    }
                }
            }
        }
    }
}

/// tanh in place, by the rational function of degree 13 over 6 that Eigen uses: wrong by less than
/// 4e-7.
struct Tanh<'t>(&'t mut [f32]);

impl WithSimd for Tanh<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        /// From here on it is 1 in f32.
        const LIMIT: f32 = 7.905_311;
        const ODD: [f32; 7] = [
            -2.760_768_5e-16,
            2.000_188e-13,
            -8.604_672e-11,
            5.122_297_1e-8,
            1.485_722_4e-5,
            6.372_619_3e-4,
            4.893_524_6e-3,
        ];
        const EVEN: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];
        for x in S::as_mut_simd_f32s(self.0).0 {
            let v = simd.min_f32s(*x, simd.splat_f32s(LIMIT));
            let v = simd.max_f32s(v, simd.splat_f32s(-LIMIT));
            let square = simd.mul_f32s(v, v);
            let horner = |c: &[f32]| {
                c[1..].iter().fold(simd.splat_f32s(c[0]), |sum, c| {
                    simd.mul_add_f32s(sum, square, simd.splat_f32s(*c))
                })
            };
            *x = simd.div_f32s(simd.mul_f32s(v, horner(&ODD)), horner(&EVEN));
        }
    }
}

/// Everything that moves while a dictionary is learned.
struct Learner<'l> {
    settings: &'l Settings,
    table: &'l Table,
    network: Network,
    /// Observables o, rows of z and 1, outputs q, targets m = o + trainable outputs.
    o: usize,
    fixed: usize,
    q: usize,
    m: usize,
    /// −D, shape `[q, m]`.
    minus: Vec<f32>,
    /// Running sums of ΨᵀΨ, shape `[q, q]`, and of Ψᵀ(Δs, change of Ψ_θ), shape `[q, m]`.
    sums: Vec<f64>,
    pass: Pass,
    /// Pairs in a batch.
    half: usize,
}

impl<'l> Learner<'l> {
    fn new(
        features: &Features,
        table: &'l Table,
        settings: &'l Settings,
        rng: &mut impl Rng,
    ) -> Self {
        let (o, fixed, q) = (features.change.len(), features.scale.len() + 1, settings.outputs);
        let (t, w, m) = (q - fixed, settings.width, o + q - fixed);
        let network = Network::new([fixed - 1, w, w, w, t], rng);
        let half = settings.batch.next_multiple_of(GRAIN);
        let pass = network.pass(2 * half, m);
        let (minus, sums) = (vec![0.0; q * m], vec![0.0; q * (q + m)]);
        Self { settings, table, network, o, fixed, q, m, minus, sums, pass, half }
    }

    /// Ψ and targets of the pairs with these indices, which are repeated if they do not fill the
    /// batch.
    fn lift(&mut self, indices: &[usize]) {
        let (stride, half, o, p) = (self.pass.stride, self.half, self.o, self.fixed - 1);
        for (b, index) in indices.iter().cycle().take(half).enumerate() {
            let row = &self.table.rows[index * self.table.width..][..self.table.width];
            for f in 0..p {
                self.pass.lifted[f * stride + b] = row[f];
                self.pass.lifted[f * stride + half + b] = row[if f < o { p + f } else { f }];
            }
            for f in 0..o {
                self.pass.residual[f * stride + b] = row[p + o + f];
            }
        }
        self.network.forward(&mut self.pass);
        let psi = self.pass.lifted[self.fixed * stride..].chunks_exact(stride);
        let changes = self.pass.residual.chunks_exact_mut(stride).skip(o);
        for (change, psi) in changes.zip(psi) {
            let (now, next) = psi.split_at(half);
            for ((c, now), next) in change.iter_mut().zip(now).zip(next) {
                *c = next - now;
            }
        }
    }

    /// Adds the lifted batch to the running sums; `batch` is room for its own.
    fn sum_up(&mut self, batch: &mut [f32]) {
        let (gram, cross) = batch.split_at_mut(self.q * self.q);
        let Pass { lifted, residual, stride, .. } = &self.pass;
        for (right, n, out) in [(lifted, self.q, gram), (residual, self.m, cross)] {
            let (shape, samples) = ((self.q, n), (*stride, self.half));
            self.network.arch.dispatch(Outer { left: lifted, right, shape, samples, out });
        }
        for (sum, x) in self.sums.iter_mut().zip(batch) {
            *sum += f64::from(*x);
        }
    }

    /// Brings the trainable outputs to mean 0 and deviation 1 and solves for K.
    fn solve(&mut self) -> Result<(), BaselineError> {
        let (q, m, one) = (self.q, self.m, self.fixed - 1);
        let (gram, cross) = self.sums.split_at_mut(q * q);
        let pairs = gram[one * q + one];
        let width = self.network.sizes[LAYERS - 1] + 1;
        let last = self.network.offset(LAYERS - 1);
        let rows = self.network.theta[last..].chunks_exact_mut(width);
        for (i, weights) in (self.fixed..q).zip(rows) {
            let mean = gram[i * q + one] / pairs;
            let variance = gram[i * q + i] / pairs - mean * mean;
            let gain = 1.0 / deviation(variance, STILL_F32 * mean);
            for j in 0..q {
                gram[i * q + j] = gain * (gram[i * q + j] - mean * gram[one * q + j]);
            }
            for j in 0..m {
                cross[i * m + j] = gain * (cross[i * m + j] - mean * cross[one * m + j]);
            }
            for j in 0..q {
                gram[j * q + i] = gain * (gram[j * q + i] - mean * gram[j * q + one]);
                cross[j * m + self.o + i - self.fixed] *= gain;
            }
            weights[width - 1] -= mean as f32;
            for w in weights {
                *w *= gain as f32;
            }
        }
        let norm: Vec<f64> = (0..q).map(|i| deviation(gram[i * q + i], 0.0)).collect();
        let mut x = cross.to_vec();
        let mut unit = vec![0.0; q * q];
        for i in 0..q {
            for j in 0..q {
                unit[i * q + j] = gram[i * q + j] / (norm[i] * norm[j]);
            }
            unit[i * q + i] = 1.0 + self.settings.ridge;
            for x in &mut x[i * m..][..m] {
                *x /= norm[i];
            }
        }
        let l = solve::cholesky(&unit, q).map_err(|_| BaselineError::NotFinite)?;
        solve::solve_cholesky(&l, &mut x, q, m);
        for (k, (minus, x)) in self.minus.iter_mut().zip(x).enumerate() {
            *minus = -(x / norm[k / m]) as f32;
        }
        Ok(())
    }

    /// Takes the prediction from the first `targets` targets.
    fn subtract(&mut self, targets: usize) {
        let weights = Weights(&self.minus, (targets, self.q), (1, self.m));
        let Pass { lifted: input, residual: out, stride, .. } = &mut self.pass;
        let samples = (*stride, self.half);
        self.network.arch.dispatch(Product { weights, input, out, samples, add: true });
    }

    /// dJ/dΨ of the lifted batch, in `delta[0]`; the residuals become their weighted selves.
    fn differentiate(&mut self) {
        self.subtract(self.m);
        let (stride, half, n) = (self.pass.stride, self.half, self.half as f64);
        let closure = (self.settings.closure * self.settings.closure / n) as f32;
        for (j, r) in self.pass.residual.chunks_exact_mut(stride).enumerate() {
            let weight = if j < self.o { (1.0 / n) as f32 } else { closure };
            for r in &mut r[..half] {
                *r *= weight;
            }
        }
        let (trainable, samples) = (&self.minus[self.fixed * self.m..], (stride, half));
        let weights = Weights(trainable, (self.q - self.fixed, self.m), (self.m, 1));
        let Pass { delta: [delta, _], residual: input, .. } = &mut self.pass;
        let out = &mut *delta;
        self.network.arch.dispatch(Product { weights, input, out, samples, add: false });
        let residual = input.chunks_exact(stride).skip(self.o);
        for (d, r) in delta.chunks_exact_mut(stride).zip(residual) {
            let (now, next) = d.split_at_mut(half);
            for ((now, next), r) in now.iter_mut().zip(next).zip(r) {
                *now -= r;
                *next = *r;
            }
        }
    }

    /// Mean of |Δs − Ψ D_s|² over the pairs with these indices.
    fn state_error(&mut self, indices: &[usize]) -> f64 {
        let mut sum = 0.0;
        for batch in indices.chunks(self.half) {
            self.lift(batch);
            self.subtract(self.o);
            for r in self.pass.residual.chunks_exact(self.pass.stride).take(self.o) {
                sum += r[..batch.len()].iter().map(|r| f64::from(r * r)).sum::<f64>();
            }
        }
        sum / indices.len() as f64
    }

    /// Alternates between K and θ; leaves the θ that predicts the held-out pairs best.
    fn train(&mut self, rng: &mut impl Rng) -> Result<(), BaselineError> {
        let pairs = self.table.pairs();
        let block = pairs.div_ceil(25);
        let (mut test, mut order): (Vec<usize>, Vec<usize>) =
            (0..pairs).partition(|k| k / block % 5 == 2);
        if test.is_empty() {
            test.clone_from(&order);
        }
        let mut batch_sums = vec![0.0; self.sums.len()];
        let zeros = vec![0.0_f32; self.network.theta.len()];
        let (mut gradient, mut mean, mut square) = (zeros.clone(), zeros.clone(), zeros);
        let steps = (order.len() / self.half).max(1);
        let passes = self.settings.passes.max(self.settings.least_steps.div_ceil(steps));
        let total = passes as f64 * steps as f64;
        let (mut step, mut unseen) = (0_usize, (1.0_f32, 1.0_f32));
        let mut best = (f64::INFINITY, None);
        for _ in 0..passes {
            for i in (1..order.len()).rev() {
                order.swap(i, rng.random_range(0..=i));
            }
            for batch in order.chunks(self.half).take(steps) {
                self.lift(batch);
                self.sum_up(&mut batch_sums);
                self.differentiate();
                self.network.backward(&mut self.pass, &mut gradient);
                let t = step as f64 / total;
                let rate =
                    self.settings.learning_rate * (50.0 * t).min(1.0) * (1.0 - t) * (1.0 - t);
                unseen = (unseen.0 * BETA.0, unseen.1 * BETA.1);
                let (rate, scale) = (rate as f32 / (1.0 - unseen.0), 1.0 / (1.0 - unseen.1));
                let theta = self.network.theta.iter_mut().zip(&gradient);
                for ((w, g), (m, v)) in theta.zip(mean.iter_mut().zip(&mut square)) {
                    *m = BETA.0 * *m + (1.0 - BETA.0) * g;
                    *v = BETA.1 * *v + (1.0 - BETA.1) * g * g;
                    *w -= rate * *m / ((*v * scale).sqrt() + EPSILON);
                }
                step += 1;
                if step.is_multiple_of(REFRESH) {
                    self.solve()?;
                    self.sums.iter_mut().for_each(|x| *x *= MEMORY);
                }
            }
            self.solve()?;
            let error = self.state_error(&test);
            if error < best.0 {
                best = (error, Some(self.network.theta.clone()));
            }
        }
        self.network.theta = best.1.ok_or(BaselineError::NotFinite)?;
        Ok(())
    }

    /// D_s over all pairs, shape `[q, o]`.
    fn state_columns(&mut self) -> Vec<f64> {
        let (q, o, stride) = (self.q, self.o, self.pass.stride);
        let mut factor = RFactor::new(q, o);
        let all: Vec<usize> = (0..self.table.pairs()).collect();
        for batch in all.chunks(self.half) {
            self.lift(batch);
            for b in 0..batch.len() {
                let column = |rows: &[f32]| -> Vec<f64> {
                    rows[b..].iter().step_by(stride).map(|x| f64::from(*x)).collect()
                };
                factor.push(&column(&self.pass.lifted), &column(&self.pass.residual)[..o]);
            }
        }
        let (r, c) = factor.finish();
        let ridge = 1e-3 * self.settings.ridge * all.len() as f64;
        Svd::new(&r, q).solve(&c, o, 0.0, ridge).0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trajectory::Trajectory;

    /// φ⁺ = φ + 0.3 u, x⁺ = 0.9 x + u cos φ.
    fn walk(seed: u64, samples: usize) -> Trajectory {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (mut phi, mut x) = (0.0, 0.0);
        let mut walk = Trajectory::default();
        for _ in 0..samples {
            let input = 4.0 * rng.random::<f64>() - 2.0;
            walk.states.extend([phi, x]);
            walk.inputs.push(input);
            (phi, x) = (phi + 0.3 * input, 0.9 * x + input * Scalar::sin_cos(phi).1);
        }
        walk
    }

    fn data<'d>(spaces: &'d [Space], trajectories: &'d [Trajectory]) -> Data<'d> {
        Data { spaces, inputs: 1, sample_time_s: 0.1, trajectories }
    }

    const SPACES: [Space; 2] = [Space::Circle, Space::Line];

    fn small() -> Settings {
        Settings { outputs: 10, width: 12, least_steps: 300, passes: 1, ..Settings::default() }
    }

    fn fit(settings: &Settings, trajectories: &[Trajectory]) -> Result<EdmdDl, BaselineError> {
        EdmdDl::fit(data(&SPACES, trajectories), settings)
    }

    #[test]
    fn gradients_are_finite_differences() {
        let walks = [walk(1, 17)];
        let (features, table) = Features::new(data(&SPACES, &walks)).unwrap();
        let settings = Settings { width: 5, outputs: 8, closure: 0.8, ..small() };
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut learner = Learner::new(&features, &table, &settings, &mut rng);
        for d in &mut learner.minus {
            *d = rng.random::<f32>() - 0.5;
        }
        let indices: Vec<usize> = (0..16).collect();
        let loss = |learner: &mut Learner<'_>| {
            learner.lift(&indices);
            learner.subtract(learner.m);
            let stride = learner.pass.stride;
            let squares = learner.pass.residual.chunks_exact(stride).enumerate().map(|(j, r)| {
                let weight = if j < learner.o { 1.0 } else { 0.8 * 0.8 };
                r[..16].iter().map(|r| weight * f64::from(*r) * f64::from(*r)).sum::<f64>()
            });
            squares.sum::<f64>() / (2.0 * 16.0)
        };
        learner.lift(&indices);
        learner.differentiate();
        let mut gradient = vec![0.0; learner.network.theta.len()];
        learner.network.backward(&mut learner.pass, &mut gradient);
        let largest = gradient.iter().fold(0.0_f32, |max, g| max.max(g.abs()));
        for (k, g) in gradient.iter().enumerate() {
            const STEP: f32 = 4e-3;
            let mut at = |step: f32| {
                let before = std::mem::replace(&mut learner.network.theta[k], step);
                learner.network.theta[k] = before + step;
                let loss = loss(&mut learner);
                learner.network.theta[k] = before;
                loss
            };
            let slope = (at(STEP) - at(-STEP)) / f64::from(2.0 * STEP);
            // The third derivative and the rounding of f32 leave about 1e-4 of the largest.
            let error = (slope - f64::from(*g)).abs();
            assert!(error < 1e-3 * f64::from(largest), "{k}: {g} for {slope}");
        }
    }

    #[test]
    fn tanh_keeps_its_bound() {
        let mut x: Vec<f32> = (-96_000..96_000).map(|k| k as f32 / 8_000.0).collect();
        let exact: Vec<f64> = x.iter().map(|x| tanh(f64::from(*x))).collect();
        pulp::Arch::new().dispatch(Tanh(&mut x));
        for (x, exact) in x.iter().zip(exact) {
            assert!((f64::from(*x) - exact).abs() < 4e-7, "{x} for {exact}");
        }
    }

    /// By the continued fraction x / (1 + x² / (3 + x² / (5 + …))).
    fn tanh(x: f64) -> f64 {
        x / (0..40).rev().fold(81.0, |below, k| f64::from(2 * k + 1) + x * x / below)
    }

    #[test]
    fn every_vector_unit_gives_the_same_bits() {
        let walks = [walk(1, 60)];
        let (features, table) = Features::new(data(&SPACES, &walks)).unwrap();
        let settings = small();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut learner = Learner::new(&features, &table, &settings, &mut rng);
        let indices: Vec<usize> = (0..32).collect();
        let mut run = |arch| {
            learner.network.arch = arch;
            learner.lift(&indices);
            learner.differentiate();
            let mut gradient = vec![0.0; learner.network.theta.len()];
            learner.network.backward(&mut learner.pass, &mut gradient);
            (learner.pass.lifted.clone(), gradient)
        };
        assert_eq!(run(pulp::Arch::new()), run(pulp::Arch::Scalar));
    }

    #[test]
    fn the_seed_and_the_data_fix_every_bit() {
        let walks = [walk(1, 300)];
        let fitted = |seed| {
            let model = fit(&Settings { seed, ..small() }, &walks).unwrap();
            (model.network.theta, model.change)
        };
        assert_eq!(fitted(1), fitted(1));
        assert_ne!(fitted(1), fitted(2));
    }

    #[test]
    fn what_no_linear_model_can_predict_is_learned() {
        let walks: Vec<Trajectory> = (0..8).map(|seed| walk(seed, 250)).collect();
        let test = [walk(99, 500)];
        let model = fit(&Settings { passes: 60, ..small() }, &walks).unwrap();
        let errors = crate::forecast::evaluate(&model, data(&SPACES, &test), 50);
        // What the linear model leaves that knows x⁺ − 0.9 x and has seen the test.
        let left = |gain: f64| -> f64 {
            let pairs = data(&SPACES, &test).pairs();
            pairs.map(|(x, u, next)| (next[1] - 0.9 * x[1] - gain * u[0]).powi(2)).sum::<f64>()
                / 499.0
        };
        let linear = (-100..=100).map(|k| left(f64::from(k) / 100.0)).fold(f64::INFINITY, f64::min);
        assert!(errors.one_step[1] < linear / 100.0, "{errors:?} for {linear}");
        assert!(errors.one_step[0] < 1e-3, "{errors:?}");
        assert_eq!(errors.diverged, 0);
    }

    #[test]
    fn no_pair_spans_two_trajectories() {
        let still = |x: f64| Trajectory { states: vec![x; 20], inputs: vec![1.0; 20] };
        let walks = [still(0.0), still(10.0)];
        let model = EdmdDl::fit(data(&[Space::Line], &walks), &small()).unwrap();
        for x in [0.0, 10.0] {
            let mut next = [f64::NAN];
            assert!(model.predict(&[x], &[1.0], &mut next));
            assert_eq!(next, [x]);
        }
    }

    #[test]
    fn few_pairs_are_enough_and_none_are_not() {
        for samples in [2, 3, 20] {
            assert!(fit(&small(), &[walk(1, samples)]).is_ok());
        }
        let none = fit(&small(), &[walk(1, 1), walk(2, 1)]);
        assert_eq!(none.unwrap_err(), BaselineError::NoPairs);
    }

    #[test]
    fn bad_settings_are_named() {
        let walks = [walk(1, 20)];
        // sin, cos, x, input, constant: a sixth output is the first trainable one.
        assert!(fit(&Settings { outputs: 6, ..small() }, &walks).is_ok());
        for (settings, name) in [
            (Settings { outputs: 5, ..small() }, "outputs"),
            (Settings { outputs: usize::MAX, ..small() }, "outputs"),
            (Settings { width: 0, ..small() }, "width"),
            (Settings { passes: 0, ..small() }, "passes"),
            (Settings { batch: 0, ..small() }, "batch"),
            (Settings { learning_rate: f64::NAN, ..small() }, "learning_rate"),
            (Settings { closure: -1.0, ..small() }, "closure"),
            (Settings { ridge: 0.0, ..small() }, "ridge"),
        ] {
            let error = fit(&settings, &walks).unwrap_err();
            let BaselineError::Settings(text) = &error else { panic!("{error:?}") };
            assert!(text.starts_with(name), "{text}");
        }
    }

    #[test]
    fn numbers_that_are_not_finite_are_refused() {
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            for state in [true, false] {
                let mut walk = walk(1, 50);
                *(if state { &mut walk.states[21] } else { &mut walk.inputs[10] }) = bad;
                assert_eq!(fit(&small(), &[walk]).unwrap_err(), BaselineError::NotFinite);
            }
        }
    }
}
