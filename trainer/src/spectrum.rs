//! The spectral radius of a model's one-step map.

use firmware_core::model::{Model, ModelError, Space};
use firmware_core::{Predictor, PredictorState, Scalar};

/// The eigenvalues, as (real, imaginary), of the one-step map linearised at a sample with its
/// history: the largest modulus says whether small deviations grow. A pose that is predicted by
/// increments contributes eigenvalues of 1.
///
/// `states` has shape `[lag + 1, states]`, `inputs` `[lag + 1, inputs]`, oldest first. Empty when
/// the model does not predict from there.
///
/// # Errors
/// [`ModelError`], which a blob that has been parsed does not give.
pub fn eigenvalues(
    model: &Model<'_>,
    states: &[f32],
    inputs: &[f32],
) -> Result<Vec<(f64, f64)>, ModelError> {
    let coefficients: Vec<f64> = model.coefficients().iter().copied().map(f64::from).collect();
    let model = Model::new(model.structure().clone(), &coefficients, None)?;
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let states: Vec<f64> = states.iter().copied().map(f64::from).collect();
    let inputs: Vec<f64> = inputs.iter().copied().map(f64::from).collect();
    let next = |states: &[f64]| -> Option<Vec<f64>> {
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let mut applied: &[f64] = &[];
        let mut rows = inputs.chunks_exact(m.max(1));
        for x in states.chunks_exact(n) {
            predictor.observe(&mut state, applied, x).ok()?;
            applied = rows.next().unwrap_or(&[]);
        }
        predictor.step(&mut state, applied).ok()?;
        let mut out = vec![0.0; n];
        predictor.coordinates(&state, &mut out).ok()?;
        Some(out)
    };
    // Companion form: (xₖ₋ₗ, …, xₖ) to (xₖ₋ₗ₊₁, …, xₖ₊₁).
    let size = states.len();
    let mut jacobian = faer::Mat::<f64>::zeros(size, size);
    for i in n..size {
        jacobian[(i - n, i)] = 1.0;
    }
    for j in 0..size {
        let step = 1e-5 * states[j].abs().max(1.0);
        let (mut high, mut low) = (states.clone(), states.clone());
        high[j] += step;
        low[j] -= step;
        let (Some(high), Some(low)) = (next(&high), next(&low)) else { return Ok(Vec::new()) };
        for i in 0..n {
            let change = match structure.states()[i].space {
                Space::Line => high[i] - low[i],
                Space::Circle => (high[i] - low[i]).wrap(),
            };
            jacobian[(size - n + i, j)] = change / (2.0 * step);
        }
    }
    faer::set_global_parallelism(faer::Par::Seq);
    let values = jacobian.eigenvalues().unwrap_or_default();
    Ok(values.into_iter().map(|z| (z.re, z.im)).collect())
}

/// The largest modulus.
///
/// ```
/// assert_eq!(trainer::spectrum::radius(&[(0.6, 0.8), (-0.5, 0.0)]), Some(1.0));
/// ```
pub fn radius(eigenvalues: &[(f64, f64)]) -> Option<f64> {
    eigenvalues.iter().map(|(re, im)| re.hypot(*im)).reduce(f64::max)
}
