//! The baseline of a planar robot whose inputs are a forward speed and a turn rate: a unicycle that
//! moves along arcs, with one fitted gain for each input.

use firmware_core::Scalar;
use firmware_core::model::{Structure, Symmetry};

/// Where the pose and the two inputs are in a row (states, then inputs), and the sample time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes {
    x: usize,
    y: usize,
    heading: usize,
    speed: usize,
    turn: usize,
    sample_time_s: f64,
}

impl Axes {
    /// `None` unless the model has a pose with se(2) symmetry and exactly two inputs, one in the
    /// unit of the position per second and one in rad/s.
    pub fn of(structure: &Structure<'_>) -> Option<Self> {
        let Symmetry::Se2 { x, y, heading } = structure.symmetry() else { return None };
        let (x, y, heading) = (usize::from(x), usize::from(y), usize::from(heading));
        let per_second = format!("{}/s", structure.states().get(x)?.unit);
        let [first, second] = structure.inputs() else { return None };
        let n = structure.states().len();
        let (speed, turn) = match (first.unit, second.unit) {
            (v, "rad/s") if v == per_second => (n, n + 1),
            ("rad/s", v) if v == per_second => (n + 1, n),
            _ => return None,
        };
        // The decimal number that was meant: 0.1, not 0.10000000149.
        let dt = structure.sample_time_s();
        let sample_time_s = dt.to_string().parse().unwrap_or(f64::from(dt));
        Some(Self { x, y, heading, speed, turn, sample_time_s })
    }
}

/// Sums of the two least-squares problems.
#[derive(Clone, Debug)]
pub struct UnicycleAccumulator {
    axes: Axes,
    ahead: [f64; 2],
    turned: [f64; 2],
}

impl UnicycleAccumulator {
    /// Nothing summed yet.
    pub fn new(axes: Axes) -> Self {
        Self { axes, ahead: [0.0; 2], turned: [0.0; 2] }
    }

    /// Adds a pair of consecutive rows (states, then inputs; angles continuous).
    pub fn pair(&mut self, now: &[f64], next: &[f64]) {
        let Axes { x, y, heading, speed, turn, sample_time_s } = self.axes;
        let turned = next[heading] - now[heading];
        // Along the chord of the arc.
        let (sin, cos) = Scalar::sin_cos(now[heading] + 0.5 * turned);
        let ahead = cos * (next[x] - now[x]) + sin * (next[y] - now[y]);
        let (v, w) = (now[speed] * sample_time_s, now[turn] * sample_time_s);
        self.ahead = [self.ahead[0] + v * v, self.ahead[1] + v * ahead];
        self.turned = [self.turned[0] + w * w, self.turned[1] + w * turned];
    }

    /// The gains; `None` when an input never moves.
    pub fn fit(&self) -> Option<Unicycle> {
        let gain = |[square, product]: [f64; 2]| (square > 0.0).then(|| product / square);
        Some(Unicycle { axes: self.axes, gains: [gain(self.ahead)?, gain(self.turned)?] })
    }
}

/// x⁺ = x + d cos(φ + δ/2), y⁺ = y + d sin(φ + δ/2), φ⁺ = φ + δ with d = g₁ v T, δ = g₂ ω T; other
/// states stay.
#[derive(Clone, Debug, PartialEq)]
pub struct Unicycle {
    axes: Axes,
    /// Of the speed and of the turn rate.
    pub gains: [f64; 2],
}

impl Unicycle {
    /// Rolls out from the last row of `past`; the inputs are those of `past`'s last row and of
    /// `future`. `predicted` has shape `[steps, states]`.
    pub fn roll_out(&self, past: &[Vec<f64>], future: &[Vec<f64>], predicted: &mut [f64]) -> bool {
        let Axes { x, y, heading, speed, turn, sample_time_s } = self.axes;
        let Some(present) = past.last() else { return false };
        let n = predicted.len() / future.len().max(1);
        let mut state = present[..n].to_vec();
        let inputs = std::iter::once(present).chain(future);
        for (out, row) in predicted.chunks_exact_mut(n).zip(inputs) {
            let ahead = self.gains[0] * row[speed] * sample_time_s;
            let turned = self.gains[1] * row[turn] * sample_time_s;
            let (sin, cos) = Scalar::sin_cos(state[heading] + 0.5 * turned);
            state[x] += ahead * cos;
            state[y] += ahead * sin;
            state[heading] += turned;
            out.copy_from_slice(&state);
        }
        predicted.iter().all(|x| x.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AXES: Axes = Axes { x: 0, y: 1, heading: 2, speed: 3, turn: 4, sample_time_s: 0.1 };

    #[test]
    fn gains_of_an_exact_unicycle_are_found_and_roll_out() {
        let truth = Unicycle { axes: AXES, gains: [0.9, 1.2] };
        let input = |k: usize| [0.3 + 0.1 * ((k * k % 7) as f64), ((k % 5) as f64 - 2.0) * 0.8];
        let mut rows: Vec<Vec<f64>> = vec![[&[1.0, -2.0, 3.0][..], &input(0)].concat()];
        for k in 1..40 {
            let mut next = [0.0; 3];
            let inputs = [vec![0.0; 5]];
            assert!(truth.roll_out(&rows[k - 1..k], &inputs, &mut next));
            rows.push([&next[..], &input(k)].concat());
        }
        let mut sums = UnicycleAccumulator::new(AXES);
        for pair in rows.windows(2) {
            sums.pair(&pair[0], &pair[1]);
        }
        let found = sums.fit().unwrap();
        assert!((found.gains[0] - 0.9).abs() < 1e-12 && (found.gains[1] - 1.2).abs() < 1e-12);
        let mut predicted = vec![0.0; 3 * 30];
        assert!(found.roll_out(&rows[..10], &rows[10..40], &mut predicted));
        for (p, row) in predicted.chunks_exact(3).zip(&rows[10..]) {
            assert!(p.iter().zip(row).all(|(a, b)| (a - b).abs() < 1e-10), "{p:?} {row:?}");
        }
        assert!(UnicycleAccumulator::new(AXES).fit().is_none());
    }
}
