//! Lift and prediction once more, straight from the definitions: closed forms, `std`'s sines,
//! explicit Kronecker products. Shares no code with the crate.
#![allow(dead_code, reason = "every test file uses a part")]

use std::collections::HashSet;
use std::f64::consts::{PI, TAU};

use firmware_core::Structure;
use firmware_core::dictionary::{Basis, Block, Dictionary, Factor, Source};
use firmware_core::model::{Space, Symmetry, Target};

/// Probabilists' Hermite polynomials in powers of v, constant first.
pub const HERMITE: [&[f64]; 6] = [
    &[1.0],
    &[0.0, 1.0],
    &[-1.0, 0.0, 1.0],
    &[0.0, -3.0, 0.0, 1.0],
    &[3.0, 0.0, -6.0, 0.0, 1.0],
    &[0.0, 15.0, 0.0, -10.0, 0.0, 1.0],
];

pub fn hermite(order: usize, v: f64) -> f64 {
    HERMITE[order].iter().enumerate().map(|(k, c)| c * v.powi(k as i32)).sum()
}

/// kron(a, b)[i · len(b) + j] = a[i] b[j]
pub fn kron(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().flat_map(|a| b.iter().map(move |b| a * b)).collect()
}

fn basis(factor: Factor, values: &[f64]) -> Vec<f64> {
    let o = usize::from(factor.observable);
    let order = usize::from(factor.order);
    match factor.basis {
        Basis::Hermite => (0..=order).map(|n| hermite(n, values[o])).collect(),
        Basis::Fourier => {
            let angle = values[o].atan2(values[o + 1]);
            let harmonics = (1..=order).flat_map(|n| {
                let (sin, cos) = (n as f64 * angle).sin_cos();
                [sin, cos]
            });
            std::iter::once(1.0).chain(harmonics).collect()
        }
    }
}

/// The Kronecker products of all blocks, one after the other.
pub fn lift_dense(dictionary: &Dictionary, values: &[f64]) -> Vec<f64> {
    dictionary
        .blocks()
        .flat_map(|(_, own)| own.iter().fold(vec![1.0], |d, f| kron(&d, &basis(*f, values))))
        .collect()
}

/// What the coefficients of the kernel multiply: powers instead of Hermite polynomials.
pub fn powers(dictionary: &Dictionary, values: &[f64]) -> Vec<f64> {
    let axis = |f: &Factor| match f.basis {
        Basis::Hermite => {
            let v = values[usize::from(f.observable)];
            (0..=f.order).map(|n| v.powi(n.into())).collect()
        }
        Basis::Fourier => basis(*f, values),
    };
    dictionary
        .blocks()
        .flat_map(|(_, own)| own.iter().fold(vec![1.0], |d, f| kron(&d, &axis(f))))
        .collect()
}

/// The functions of all factors, constants left out, in closed form.
pub fn functions(dictionary: &Dictionary, values: &[f64]) -> Vec<f64> {
    let factors = dictionary.blocks().flat_map(|(_, own)| own);
    factors
        .flat_map(|f| match f.basis {
            Basis::Hermite => {
                let v = values[usize::from(f.observable)];
                (1..=f.order).map(|n| v.powi(n.into())).collect()
            }
            Basis::Fourier => basis(*f, values).split_off(1),
        })
        .collect()
}

/// The terms of a chain, the constant first: every one multiplied from all its functions anew.
pub fn sparse(dictionary: &Dictionary, terms: &[[u8; 2]], values: &[f64]) -> Vec<f64> {
    let functions = functions(dictionary, values);
    let mut all = vec![vec![]];
    for [parent, function] in terms {
        let own: Vec<u8> = [&all[usize::from(*parent)][..], &[*function]].concat();
        all.push(own);
    }
    all.iter().map(|own| own.iter().map(|g| functions[usize::from(*g)]).product()).collect()
}

/// A basis function that is not the constant, one name for one function: (observable, order) for
/// Hermite, (100 + observable, harmonic) for higher harmonics.
type Function = (usize, usize);

fn function(factor: Factor, digit: usize) -> Function {
    let o = usize::from(factor.observable);
    match factor.basis {
        Basis::Hermite => (o, digit),
        Basis::Fourier => {
            let (which, harmonic) = (o + (digit + 1) % 2, digit.div_ceil(2));
            if harmonic == 1 { (which, 1) } else { (100 + which, harmonic) }
        }
    }
}

/// All terms of a block as sets of functions, with their total degrees.
fn names(own: &[Factor]) -> Vec<(Vec<Function>, usize)> {
    own.iter().fold(vec![(vec![], 0)], |terms, factor| {
        let size = match factor.basis {
            Basis::Hermite => factor.order + 1,
            Basis::Fourier => 2 * factor.order + 1,
        };
        let mut next = vec![];
        for (term, degree) in &terms {
            for digit in 0..usize::from(size) {
                let mut term: Vec<Function> = term.clone();
                let mut more = 0;
                if digit > 0 {
                    term.push(function(*factor, digit));
                    more = if factor.basis == Basis::Hermite { digit } else { digit.div_ceil(2) };
                }
                next.push((term, degree + more));
            }
        }
        next
    })
}

/// For every dense term whether it is in the union and was not there before.
pub fn distinct(dictionary: &Dictionary) -> Vec<bool> {
    let mut seen = HashSet::new();
    let mut distinct = vec![];
    for (Block { max_degree, .. }, own) in dictionary.blocks() {
        for (mut term, degree) in names(own) {
            term.sort_unstable();
            let there = max_degree == 0 || degree <= usize::from(max_degree);
            distinct.push(there && seen.insert(term));
        }
    }
    distinct
}

/// Coefficients of a dense Hermite lift, `[dense_terms]`, as coefficients of powers.
pub fn monomials(dictionary: &Dictionary, hermite: &[f64]) -> Vec<f64> {
    let mut out = vec![];
    for (_, own) in dictionary.blocks() {
        let size: usize = own.iter().map(|f| f.radix()).product();
        out.extend(expand(own, &hermite[out.len()..out.len() + size]));
    }
    out
}

/// Collects the powers of the first factor, then those of the others.
fn expand(own: &[Factor], hermite: &[f64]) -> Vec<f64> {
    let Some((first, others)) = own.split_first() else { return hermite.to_vec() };
    let part = hermite.len() / first.radix();
    let mut collected = vec![vec![0.0; part]; first.radix()];
    for (n, coefficients) in hermite.chunks(part).enumerate() {
        let fourier = [&vec![0.0; n][..], &[1.0]].concat();
        let powers = if first.basis == Basis::Hermite { HERMITE[n] } else { &fourier };
        for (power, to) in powers.iter().zip(&mut collected) {
            to.iter_mut().zip(coefficients).for_each(|(to, c)| *to += power * c);
        }
    }
    collected.iter().flat_map(|part| expand(others, part)).collect()
}

pub fn wrap(angle: f64) -> f64 {
    let turn = angle.rem_euclid(TAU);
    if turn > PI { turn - TAU } else { turn }
}

/// Coordinates and the inputs that acted from each of them on, the oldest first.
#[derive(Clone, Debug)]
pub struct Log {
    pub x: Vec<Vec<f64>>,
    /// One fewer than `x`: the last one is about to be chosen.
    pub u: Vec<Vec<f64>>,
}

/// The change from `a` to `b`: wrapped on S¹, a symmetric pose in the frame of `a`.
pub fn increment(structure: &Structure<'_>, a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut d: Vec<f64> = b.iter().zip(a).map(|(b, a)| b - a).collect();
    for (d, s) in d.iter_mut().zip(structure.states()) {
        if s.space == Space::Circle {
            *d = wrap(*d);
        }
    }
    if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
        let (x, y) = (usize::from(x), usize::from(y));
        let phi = a[usize::from(heading)];
        (d[x], d[y]) = (phi.cos() * d[x] + phi.sin() * d[y], -phi.sin() * d[x] + phi.cos() * d[y]);
    }
    d
}

/// The observables before the step that `input` drives.
pub fn observables(structure: &Structure<'_>, log: &Log, input: &[f64]) -> Vec<f64> {
    let k = log.x.len() - 1;
    let value = |source, lag: usize| match source {
        Source::State(i) => log.x[k - lag][usize::from(i)],
        Source::Sin(i) => log.x[k - lag][usize::from(i)].sin(),
        Source::Cos(i) => log.x[k - lag][usize::from(i)].cos(),
        Source::Increment(i) => {
            increment(structure, &log.x[k - lag], &log.x[k - lag + 1])[usize::from(i)]
        }
        Source::Input(i) if lag == 0 => input[usize::from(i)],
        Source::Input(i) => log.u[k - lag][usize::from(i)],
    };
    let all = structure.dictionary().observables();
    all.iter()
        .map(|o| (value(o.source, o.lag.into()) - f64::from(o.centre)) * f64::from(o.gain))
        .collect()
}

/// The next coordinates from the outputs of the operator.
pub fn retract(structure: &Structure<'_>, present: &[f64], outputs: &[f64]) -> Vec<f64> {
    let mut z = outputs.iter().copied();
    let mut next: Vec<f64> = structure
        .states()
        .iter()
        .map(|s| match (s.target, s.space) {
            (Target::Absolute, Space::Circle) => {
                let (sin, cos) = (z.next().unwrap(), z.next().unwrap());
                sin.atan2(cos)
            }
            _ => z.next().unwrap(),
        })
        .collect();
    if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
        let (x, y) = (usize::from(x), usize::from(y));
        let phi = present[usize::from(heading)];
        (next[x], next[y]) =
            (phi.cos() * next[x] - phi.sin() * next[y], phi.sin() * next[x] + phi.cos() * next[y]);
    }
    for ((next, present), s) in next.iter_mut().zip(present).zip(structure.states()) {
        if s.target == Target::Increment {
            *next += present;
            if s.space == Space::Circle {
                *next = wrap(*next);
            }
        }
    }
    next
}

/// One step with Hermite coefficients `[outputs][dense_terms]`, or with those of sparse terms.
pub fn step(
    structure: &Structure<'_>,
    terms: Option<&[[u8; 2]]>,
    log: &Log,
    input: &[f64],
    coefficients: &[f64],
) -> Vec<f64> {
    let values = observables(structure, log, input);
    let lifted = match terms {
        None => lift_dense(structure.dictionary(), &values),
        Some(terms) => sparse(structure.dictionary(), terms, &values),
    };
    let outputs: Vec<f64> = coefficients
        .chunks(lifted.len())
        .map(|row| row.iter().zip(&lifted).map(|(c, t)| c * t).sum())
        .collect();
    retract(structure, log.x.last().unwrap(), &outputs)
}

/// Largest difference of two states, angles compared on the circle.
pub fn distance(structure: &Structure<'_>, a: &[f64], b: &[f64]) -> f64 {
    let mut largest = 0.0_f64;
    for ((a, b), s) in a.iter().zip(b).zip(structure.states()) {
        let d = if s.space == Space::Circle { wrap(a - b) } else { a - b };
        largest = largest.max(d.abs());
    }
    largest
}
