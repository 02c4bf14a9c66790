//! What a model in fixed point predicts from random samples, as a hash of all its bits. The same code runs on
//! the target and, through tests/examples/target_q31.rs, on the host.

use firmware_core::capacity::{MAX_INPUTS, MAX_STATES};
use firmware_core::q31::{FixedModel, FixedState};

#[path = "random.rs"]
mod random;
use random::{Random, hash};

/// Steps from one set of random measurements to the next.
const ROLLOUT: u32 = 8;

impl Random {
    /// Anywhere, more often near the middle; now and then the last numbers there are, and nothing.
    fn number(&mut self) -> i32 {
        let bits = self.next();
        let number = (bits >> 32) as i32;
        match bits % 32 {
            0 => i32::MIN,
            1 => i32::MAX,
            2 => 0,
            3 => -1,
            4..20 => number >> 1,
            _ => number,
        }
    }
}

/// Predicts `steps` samples, in rollouts of eight after random measurements, with random inputs; how many did
/// not diverge, and the hash of all coordinates and of every error.
pub fn bits(model: &FixedModel<'_>, steps: u32) -> Option<(u32, u64)> {
    let mut state = FixedState::new();
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    let mut result = 0xCBF2_9CE4_8422_2325;
    let mut predicted = 0;
    for step in 0..steps {
        if step.is_multiple_of(ROLLOUT) {
            let coordinates = [(); MAX_STATES].map(|()| random.number());
            model.observe(&mut state, coordinates.get(..model.states())?).ok()?;
        }
        let input = [(); MAX_INPUTS].map(|()| random.number());
        if model.step(&mut state, input.get(..model.inputs())?).is_ok() {
            predicted += 1;
            let mut out = [0; MAX_STATES];
            let out = out.get_mut(..model.states())?;
            model.coordinates(&state, out).ok()?;
            for x in out {
                result = hash(result, *x as u32);
            }
            result = hash(result, u32::from(state.out_of_range().is_some()));
        } else {
            result = hash(result, u32::MAX);
        }
    }
    Some((predicted, result))
}
