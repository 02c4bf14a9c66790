//! What a model predicts from random samples, and from recorded ones, as a hash of all its bits. The same code
//! runs on the target and, through tests/examples/target_bits.rs, on the host.

use firmware_core::{Model, Predictor, PredictorState};

#[path = "random.rs"]
mod random;
use random::{Random, hash};

/// Steps from one set of random measurements to the next.
const ROLLOUT: u32 = 8;
/// Samples of a model's history at most, the present one included.
const SAMPLES: usize = firmware_core::capacity::MAX_LAG + 1;

impl Random {
    /// Within ±`most`; now and then the bound itself, nothing, or a number so small that it is not normal.
    fn number(&mut self, most: f32) -> f32 {
        let bits = self.next();
        let sign = if bits & 1 == 0 { 1.0 } else { -1.0 };
        // Exact: 24 bits.
        let share = ((bits >> 40) as f32) / 16_777_216.0;
        match (bits >> 1) % 64 {
            0 => sign * most,
            1 => sign * 0.0,
            2 => sign * share * 1e-40,
            _ => sign * share * most,
        }
    }
}

/// Predicts `steps` samples, in rollouts of eight after random measurements, and the same with one input held, with random inputs, some of
/// them beyond their range; how many did not diverge, and the hash of all coordinates and of every error.
pub fn bits(model: &Model<'_>, steps: u32) -> Option<(u32, u64)> {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    let mut result = 0xCBF2_9CE4_8422_2325;
    let mut predicted = 0;
    for step in 0..steps {
        if step.is_multiple_of(ROLLOUT) {
            state = PredictorState::new();
            let mut coordinates = [0.0; firmware_core::capacity::MAX_STATES];
            let coordinates = coordinates.get_mut(..n)?;
            let mut applied = [0.0; firmware_core::capacity::MAX_INPUTS];
            for _ in 0..=structure.lag().min(SAMPLES) {
                for x in &mut *coordinates {
                    // A motion: what changes at once is far from any data.
                    *x = 0.9 * *x + random.number(0.3);
                }
                for (u, input) in applied.iter_mut().zip(structure.inputs()) {
                    *u = random.number(input.range[1]);
                }
                predictor.observe(&mut state, applied.get(..m)?, coordinates).ok()?;
            }
            let mut path = [0.0; ROLLOUT as usize * firmware_core::capacity::MAX_STATES];
            let path = path.get_mut(..ROLLOUT as usize * n)?;
            let mut ahead = state.clone();
            let held = predictor.rollout_held(&mut ahead, applied.get(..m)?, path);
            for x in path {
                result = hash(result, x.to_bits());
            }
            ahead.clone_from(&state);
            let end = predictor.hold(&mut ahead, applied.get(..m)?, ROLLOUT as usize);
            if held != end {
                return None;
            }
            predictor.coordinates(&ahead, coordinates).ok()?;
            for x in coordinates {
                result = hash(result, x.to_bits());
            }
        }
        let mut input = [0.0; firmware_core::capacity::MAX_INPUTS];
        for (u, of) in input.iter_mut().zip(structure.inputs()) {
            *u = random.number(1.2 * of.range[1]);
        }
        match predictor.step(&mut state, input.get(..m)?) {
            Ok(()) => {
                predicted += 1;
                let mut out = [0.0; firmware_core::capacity::MAX_STATES];
                let out = out.get_mut(..n)?;
                predictor.coordinates(&state, out).ok()?;
                for x in out {
                    result = hash(result, x.to_bits());
                }
                result = hash(result, u32::from(state.out_of_range().is_some()));
            }
            Err(_) => result = hash(result, u32::MAX),
        }
    }
    Some((predicted, result))
}

/// Samples that a recorded sequence of inputs is predicted over, again and again.
const AHEAD: u32 = 10;

/// What is predicted along recorded trajectories.
pub struct Replay {
    /// Rollouts of ten samples that came to their end.
    pub rollouts: u32,
    /// Of all coordinates on the way.
    pub hash: u64,
    /// Mean squared error at the end of a rollout, in the square of the unit.
    pub error: [f32; firmware_core::capacity::MAX_STATES],
}

/// Predicts along recorded trajectories with their inputs. `next` puts a sample into its argument, states and
/// then inputs; NaN where a new trajectory begins; `false` at the end.
pub fn replay(model: &Model<'_>, mut next: impl FnMut(&mut [f32]) -> bool) -> Option<Replay> {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let predictor = Predictor::new(model);
    let (mut state, mut ahead) = (PredictorState::new(), PredictorState::new());
    let mut error = [0.0; firmware_core::capacity::MAX_STATES];
    let (mut rollouts, mut result) = (0, 0xCBF2_9CE4_8422_2325);
    let mut sample =
        [0.0; firmware_core::capacity::MAX_STATES + firmware_core::capacity::MAX_INPUTS];
    let sample = sample.get_mut(..n + m)?;
    let mut before = [0.0; firmware_core::capacity::MAX_INPUTS];
    let before = before.get_mut(..m)?;
    while next(sample) {
        let (states, inputs) = sample.split_at_checked(n)?;
        if states.iter().any(|x| x.is_nan()) {
            state.clear();
            ahead.clear();
            continue;
        }
        if !ahead.history().is_empty() {
            // One that has not been started looks back at too few samples, or has diverged.
            let made = predictor.step(&mut ahead, before).is_ok();
            let mut predicted = [0.0; firmware_core::capacity::MAX_STATES];
            let predicted = predicted.get_mut(..n)?;
            predictor.coordinates(&ahead, predicted).ok()?;
            for x in &*predicted {
                result = hash(result, x.to_bits());
            }
            if !made {
                ahead.clear();
            } else if ahead.step() == AHEAD {
                rollouts += 1;
                for (((sum, x), expected), of) in
                    error.iter_mut().zip(predicted).zip(states).zip(structure.states())
                {
                    let off = of.space.difference(*expected, *x);
                    *sum += off * off;
                }
                ahead.clear();
            }
        }
        predictor.observe(&mut state, before, states).ok()?;
        if ahead.history().is_empty() && state.history().len() > structure.lag() {
            ahead.clone_from(&state);
        }
        before.copy_from_slice(inputs);
    }
    let error = error.map(|sum| sum / rollouts.max(1) as f32);
    Some(Replay { rollouts, hash: result, error })
}
