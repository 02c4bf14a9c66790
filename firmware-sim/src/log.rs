//! The CSV of one trajectory: simulated, measured, written.
//!
//! The format is described in [`record`](crate::record).

use crate::excitation::round_to;
use crate::normal::standard_normal;
use crate::plant::Plant;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::io;

/// Where the noise streams begin, beyond those of all inputs.
pub(crate) const NOISE_STREAM: u64 = 1 << 63;

/// Generator `number` of a seed, independent of all others.
pub(crate) fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    rng
}

/// How outputs become measurements.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sensor<const OUTPUTS: usize> {
    /// Standard deviations of independent normal noise, in the outputs' units.
    pub(crate) std: [f64; OUTPUTS],
    /// Decimals that are kept; `None` for all of them.
    pub(crate) decimals: Option<u8>,
}

impl Sensor<3> {
    /// Motion capture of a planar pose (m, m, rad).
    pub(crate) const POSE: Self = Self { std: [1e-3, 1e-3, 2e-3], decimals: Some(6) };
}

impl Sensor<4> {
    /// Encoders of two joints (rad, rad, rad/s, rad/s).
    pub(crate) const JOINTS: Self = Self { std: [2e-4, 2e-4, 5e-3, 5e-3], decimals: Some(6) };
}

impl Sensor<2> {
    /// Motion capture of a leg's tip (mm).
    pub(crate) const TIP: Self = Self { std: [0.1, 0.1], decimals: Some(4) };
}

impl<const OUTPUTS: usize> Sensor<OUTPUTS> {
    /// Outputs as they are.
    pub(crate) const EXACT: Self = Self { std: [0.0; OUTPUTS], decimals: None };

    pub(crate) fn measure(
        &self,
        mut outputs: [f64; OUTPUTS],
        rng: &mut ChaCha8Rng,
    ) -> [f64; OUTPUTS] {
        for (output, std) in outputs.iter_mut().zip(self.std) {
            if std > 0.0 {
                *output += std * standard_normal(rng);
            }
            *output = self.decimals.map_or(*output, |decimals| round_to(*output, decimals));
        }
        outputs
    }
}

/// What was measured and the input from there on.
pub(crate) type Row<const OUTPUTS: usize, const INPUTS: usize> = ([f64; OUTPUTS], [f64; INPUTS]);

/// The rows of `plant` from where it stands, one per input.
pub(crate) fn rows<const OUTPUTS: usize, const INPUTS: usize>(
    mut plant: impl Plant<OUTPUTS, INPUTS>,
    rate_hz: u32,
    inputs: impl IntoIterator<Item = [f64; INPUTS]>,
    sensor: Sensor<OUTPUTS>,
    mut noise: ChaCha8Rng,
) -> impl Iterator<Item = Row<OUTPUTS, INPUTS>> {
    inputs.into_iter().map(move |input| {
        let measured = sensor.measure(plant.observe(), &mut noise);
        plant.step(&input, 1.0 / f64::from(rate_hz));
        (measured, input)
    })
}

/// Writes the header of `plant`'s columns and the rows, `rate_hz` of them per second.
pub(crate) fn write_csv<const OUTPUTS: usize, const INPUTS: usize>(
    out: impl io::Write,
    plant: &impl Plant<OUTPUTS, INPUTS>,
    rate_hz: u32,
    rows: impl IntoIterator<Item = Row<OUTPUTS, INPUTS>>,
) -> io::Result<()> {
    let mut csv = csv::Writer::from_writer(out);
    let columns = plant.outputs().map(|column| column.to_string());
    let commands = plant.inputs().map(|column| column.to_string());
    csv.write_record(
        ["time_s"].into_iter().chain(columns.iter().chain(&commands).map(String::as_str)),
    )?;
    let mut field = String::new();
    for (row, (outputs, input)) in (0_u32..).zip(rows) {
        let time_s = f64::from(row) / f64::from(rate_hz);
        for number in [time_s].iter().chain(&outputs).chain(&input) {
            field.clear();
            // The shortest decimal that reads back as the same f64; a String takes any text.
            let _ = write!(field, "{number}");
            csv.write_field(&field)?;
        }
        csv.write_record(None::<&[u8]>)?;
    }
    csv.flush()
}

/// `trial-000.csv`, `trial-001.csv`, …
pub(crate) fn file_name(trial: u32) -> String {
    format!("trial-{trial:03}.csv")
}

/// Whether [`file_name`] gives this name for some trial.
pub(crate) fn is_file_name(name: &OsStr) -> bool {
    name.to_str()
        .and_then(|name| name.strip_prefix("trial-")?.strip_suffix(".csv"))
        .and_then(|digits| digits.parse().ok())
        .is_some_and(|trial| name == file_name(trial).as_str())
}
