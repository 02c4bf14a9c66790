//! What every simulated robot offers.

use std::fmt;

/// A measured or commanded quantity and its unit, as it is named in a log.
///
/// ```
/// use firmware_sim::Variable;
/// assert_eq!(Variable { name: "omega_r", unit: "radps" }.to_string(), "omega_r_radps");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Variable {
    /// Name without the unit, such as `omega_r`.
    pub name: &'static str,
    /// Unit in letters only, such as `m`, `rad`, `radps`, `Nm`, `mm` or `V`.
    pub unit: &'static str,
}

impl fmt::Display for Variable {
    /// The column name `<name>_<unit>`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}_{}", self.name, self.unit)
    }
}

/// A robot in continuous time that is driven by inputs held between two instants.
///
/// `OUTPUTS` counts what a sensor can see, which may be less than the plant's own state (the soft
/// leg hides its pressures); `INPUTS` counts the commands.
///
/// A plant does no checking while it runs: a non-finite input or duration gives non-finite outputs,
/// never a panic.
pub trait Plant<const OUTPUTS: usize, const INPUTS: usize> {
    /// What [`observe`](Self::observe) returns, in its order.
    fn outputs(&self) -> [Variable; OUTPUTS];

    /// What [`step`](Self::step) takes, in its order.
    fn inputs(&self) -> [Variable; INPUTS];

    /// Puts the plant back to where a new one starts, at rest.
    fn reset(&mut self);

    /// Advances by `dt_s` seconds while `input` is held.
    fn step(&mut self, input: &[f64; INPUTS], dt_s: f64);

    /// The outputs now, free of noise.
    fn observe(&self) -> [f64; OUTPUTS];
}
