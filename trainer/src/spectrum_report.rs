//! What `trainer spectrum` prints: eigenvalues in the robot's time, and what they carry.

use std::fmt::Write;

use serde::Serialize;

use crate::full_operator::{FullOperator, HeldInputError};
use crate::report::{grouped, significant};
use crate::spectrum::DEFECTIVE;

/// The spectrum of a robot's operator under held inputs. `null` stands for a number that does not
/// exist: the time constant of what neither decays nor grows, an infinite condition.
#[derive(Debug, Serialize)]
pub struct SpectrumReport {
    /// Robot name.
    pub robot: String,
    /// Sample time \[s\].
    pub sample_time_s: f64,
    /// Trajectories of the fit.
    pub trajectories: usize,
    /// Snapshot pairs of the fit.
    pub pairs: u64,
    /// Distinct terms that the operator was regressed on.
    pub regressed_terms: usize,
    /// Numerical rank of the lifted data.
    pub rank: usize,
    /// Inputs and what they are held at.
    pub inputs: Vec<HeldInputReport>,
    /// The terms of the state alone, whose operator this is, in Hermite form.
    pub terms: Vec<String>,
    /// Root mean square of every term over the data.
    pub term_sizes: Vec<f64>,
    /// Observables of the coordinates, which have a mode for every eigenvalue.
    pub coordinates: Vec<CoordinateReport>,
    /// Observables of coordinates without modes.
    pub without_modes: Vec<WithoutModesReport>,
    /// Largest modulus.
    pub spectral_radius: f64,
    /// By falling modulus, then rising frequency; conjugates side by side.
    pub eigenvalues: Vec<EigenvalueReport>,
    /// Condition of the matrix of the eigenvectors.
    pub condition: f64,
    /// Largest |K ξ − λ ξ| and |w* K − λ w*| over all entries, terms measured by their sizes.
    pub eigenvector_residuals: [f64; 2],
    /// ‖Σ ξ λ w* B − K B‖ / ‖K B‖ of the observable for which it is largest; `null` without any.
    pub reconstruction_residual: Option<f64>,
    /// Condition of an eigenvalue beyond which it counts as defective or nearly so.
    pub defective_beyond: f64,
    /// Eigenvalues (by index) without eigenvectors of their own.
    pub defects: Vec<DefectReport>,
}

/// An input of a spectrum.
#[derive(Debug, Serialize)]
pub struct HeldInputReport {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Value at every sample.
    pub value: f64,
    /// Range of the actuator.
    pub range: [f64; 2],
}

/// An observable with modes.
#[derive(Debug, Serialize)]
pub struct CoordinateReport {
    /// Such as `x` or `sin(phi)`.
    pub name: String,
    /// The coordinate that it belongs to.
    pub state: String,
    /// Unit; empty for sine and cosine.
    pub unit: String,
    /// What the robot's own model predicts of the coordinate: `absolute` or `increment`.
    pub target: &'static str,
}

/// An observable without modes.
#[derive(Debug, Serialize)]
pub struct WithoutModesReport {
    /// Such as `x` or `sin(phi)`.
    pub name: String,
    /// Why.
    pub reason: &'static str,
}

/// An eigenvalue with its eigenfunction and its modes.
#[derive(Debug, Serialize)]
pub struct EigenvalueReport {
    /// Real part.
    pub re: f64,
    /// Imaginary part.
    pub im: f64,
    /// Modulus.
    pub modulus: f64,
    /// arg λ / (2π T) \[Hz\], between plus and minus half the sample rate.
    pub frequency_hz: f64,
    /// −T / ln |λ| \[s\]: the time in which it decays to 1/e; negative when it grows.
    pub time_constant_s: Option<f64>,
    /// Condition of the eigenvalue.
    pub condition: f64,
    /// Coefficients ξ of the eigenfunction over the terms, as \[real, imaginary\].
    pub eigenfunction: Vec<(f64, f64)>,
    /// Root mean square of the eigenfunction over the data.
    pub eigenfunction_rms: f64,
    /// The mode v of every coordinate's observable, as \[real, imaginary\].
    pub modes: Vec<(f64, f64)>,
    /// |v| times the root mean square of the eigenfunction: the part of the observable, in its unit,
    /// that this eigenvalue carries over the data.
    pub shares: Vec<f64>,
}

/// Eigenvalues without eigenvectors of their own.
#[derive(Debug, Serialize)]
pub struct DefectReport {
    /// Indices of the eigenvalues.
    pub eigenvalues: Vec<usize>,
    /// Largest condition among them.
    pub condition: f64,
}

impl SpectrumReport {
    /// The spectrum of an operator with its inputs held, shape `[inputs]`, in their units.
    ///
    /// # Errors
    /// [`HeldInputError`].
    pub fn new(
        full: &FullOperator<'_>,
        sample_time_s: f64,
        input: &[f64],
    ) -> Result<Self, HeldInputError> {
        let spectrum = full.spectrum(input)?;
        let structure = &full.structure;
        let (right, modes) = (spectrum.right(), spectrum.modes(&full.b));
        let values = spectrum.eigenvalues().iter().zip(right).zip(modes).enumerate();
        let eigenvalues = values.map(|(i, ((&(re, im), xi), modes))| {
            let modulus = libm::hypot(re, im);
            let rate = libm::log(modulus);
            let rms = full.root_mean_square(&xi);
            // On the unit circle as far as rounding lets anyone see.
            let steady = (modulus - 1.0).abs() <= spectrum.uncertainty(i);
            EigenvalueReport {
                re,
                im,
                modulus,
                frequency_hz: libm::atan2(im, re) / (std::f64::consts::TAU * sample_time_s),
                time_constant_s: (!steady).then(|| -sample_time_s / rate),
                condition: spectrum.conditions()[i],
                eigenfunction: xi,
                eigenfunction_rms: rms,
                shares: modes.iter().map(|v| libm::hypot(v.0, v.1) * rms).collect(),
                modes,
            }
        });
        let (right, left) = spectrum.eigenvector_residuals();
        Ok(Self {
            robot: structure.robot().to_owned(),
            sample_time_s,
            trajectories: full.summary.trajectories,
            pairs: full.operator.pairs,
            regressed_terms: full.operator.terms,
            rank: full.operator.rank,
            inputs: structure
                .inputs()
                .iter()
                .zip(input)
                .map(|(u, value)| HeldInputReport {
                    name: u.name.to_owned(),
                    unit: u.unit.to_owned(),
                    value: *value,
                    range: u.range.map(f64::from),
                })
                .collect(),
            terms: full.names.clone(),
            term_sizes: full.sizes(),
            coordinates: full
                .columns
                .iter()
                .map(|c| CoordinateReport {
                    name: c.name.clone(),
                    state: c.coordinate.clone(),
                    unit: c.unit.clone(),
                    target: if c.absolute { "absolute" } else { "increment" },
                })
                .collect(),
            without_modes: full
                .missing
                .iter()
                .map(|(name, reason)| WithoutModesReport { name: name.clone(), reason })
                .collect(),
            spectral_radius: spectrum.radius(),
            eigenvalues: eigenvalues.collect(),
            condition: spectrum.condition(),
            eigenvector_residuals: [right, left],
            reconstruction_residual: (!full.columns.is_empty())
                .then(|| spectrum.reconstruction_residual(&full.b)),
            defective_beyond: DEFECTIVE,
            defects: spectrum
                .defects()
                .into_iter()
                .map(|d| DefectReport { eigenvalues: d.eigenvalues, condition: d.condition })
                .collect(),
        })
    }

    /// The report for people.
    pub fn text(&self) -> String {
        let mut t = String::new();
        let _ = writeln!(
            t,
            "{}: {} trajectories, {} snapshot pairs, sample time {} s",
            self.robot,
            grouped(self.trajectories as u64),
            grouped(self.pairs),
            self.sample_time_s
        );
        let held: Vec<String> = self.inputs.iter().map(HeldInputReport::text).collect();
        let held = if held.is_empty() { "none".to_owned() } else { held.join(", ") };
        let _ = writeln!(t, "inputs held: {held}");
        let _ = writeln!(
            t,
            "operator K on the {} terms of the state alone, regressed on all {} terms, numerical rank {}",
            self.terms.len(),
            self.regressed_terms,
            self.rank
        );
        let shown: Vec<&str> = self.terms.iter().take(TERMS).map(String::as_str).collect();
        let more = match self.terms.len() {
            n if n > TERMS => format!(" and {} more", n - TERMS),
            _ => String::new(),
        };
        let _ = writeln!(t, "terms: {}{more}", shown.join(", "));
        let _ = writeln!(t, "\nspectral radius {}{}", precise(self.spectral_radius), self.growth());
        self.table(&mut t);
        let increments = self.coordinates.iter().filter(|c| c.target == "increment");
        let mut increments: Vec<&str> = increments.map(|c| c.state.as_str()).collect();
        increments.dedup();
        if !increments.is_empty() {
            let _ = writeln!(
                t,
                "{}: the robot's model predicts increments; K predicts the next values, as of all terms",
                increments.join(", ")
            );
        }
        for missing in &self.without_modes {
            let _ = writeln!(t, "no mode for {}: {}", missing.name, missing.reason);
        }
        let [right, left] = self.eigenvector_residuals;
        let _ = writeln!(
            t,
            "\ncondition of the eigenvectors {}; residuals: eigenvectors {}, {} (left)",
            number(self.condition),
            number(right),
            number(left)
        );
        if let Some(residual) = self.reconstruction_residual {
            let _ = writeln!(
                t,
                "sum of v lambda phi against K B (equation 1): relative residual {}",
                number(residual)
            );
        }
        for defect in &self.defects {
            let _ = writeln!(t, "{}", self.warning(defect));
        }
        t
    }

    fn growth(&self) -> &'static str {
        let grows = |e: &EigenvalueReport| e.time_constant_s.is_some_and(|t| t < 0.0);
        if self.eigenvalues.iter().any(grows) { ": an eigenfunction grows" } else { "" }
    }

    fn table(&self, t: &mut String) {
        // A pair has one line.
        let rows: Vec<&EigenvalueReport> =
            self.eigenvalues.iter().filter(|e| e.im >= 0.0).collect();
        let mut header: Vec<String> =
            ["re", "im", "modulus", "frequency [Hz]", "time constant [s]", "condition"]
                .map(str::to_owned)
                .to_vec();
        for c in &self.coordinates {
            let unit = if c.unit.is_empty() { String::new() } else { format!(" [{}]", c.unit) };
            header.push(format!("{}{unit}", c.name));
        }
        header.push("  eigenfunction, largest terms".to_owned());
        let mut lines = vec![header];
        for e in rows.iter().take(SHOWN) {
            let pair = if e.im > 0.0 { "±" } else { "" };
            let mut line = vec![
                precise(e.re),
                format!("{pair}{}", precise(e.im)),
                precise(e.modulus),
                format!("{pair}{}", number(e.frequency_hz)),
                e.time_constant_s.map_or("-".to_owned(), number),
                number(e.condition),
            ];
            line.extend(e.shares.iter().map(|share| number(*share)));
            line.push(format!("  {}", self.largest_terms(e)));
            lines.push(line);
        }
        let last = lines[0].len() - 1;
        let width = |j: usize| lines.iter().map(|l| l[j].chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..last).map(width).collect();
        let modes = if self.coordinates.is_empty() {
            ""
        } else {
            "; per coordinate |v| times the RMS of phi over the logs"
        };
        let _ = writeln!(
            t,
            "frequency arg(lambda) / (2 pi T), time constant -T / ln |lambda|, negative when it grows{modes}\n"
        );
        for line in &lines {
            for (text, width) in line.iter().zip(&widths) {
                let _ = write!(t, "{text:>w$}  ", w = *width);
            }
            let _ = writeln!(t, "{}", line[last].trim_end());
        }
        if rows.len() > SHOWN {
            let _ = writeln!(t, "and {} more lines of smaller modulus: --json", rows.len() - SHOWN);
        }
    }

    /// The terms that make up most of an eigenfunction over the data.
    fn largest_terms(&self, e: &EigenvalueReport) -> String {
        let size = |i: &usize| {
            libm::hypot(e.eigenfunction[*i].0, e.eigenfunction[*i].1) * self.term_sizes[*i]
        };
        let mut order: Vec<usize> = (0..self.terms.len()).collect();
        order.sort_by(|a, b| size(b).total_cmp(&size(a)));
        let largest = size(&order[0]);
        let shown = order.iter().take(LARGEST).filter(|i| size(i) >= 0.05 * largest);
        shown.map(|i| self.terms[*i].as_str()).collect::<Vec<_>>().join(", ")
    }

    fn warning(&self, defect: &DefectReport) -> String {
        let value = |i: &usize| {
            let e = &self.eigenvalues[*i];
            match e.im {
                im if im > 0.0 => format!("{} + {}i", precise(e.re), precise(im)),
                im if im < 0.0 => format!("{} - {}i", precise(e.re), precise(-im)),
                _ => precise(e.re),
            }
        };
        let shown: Vec<String> = defect.eigenvalues.iter().take(TERMS).map(value).collect();
        let more = defect.eigenvalues.len().saturating_sub(TERMS);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        let (what, whose) = match defect.eigenvalues.len() {
            1 => ("the eigenvalue", "its mode and eigenfunction are"),
            _ => ("the eigenvalues", "their modes and eigenfunctions are"),
        };
        format!(
            "warning: defective or nearly so: {what} {}{more} (condition {} beyond {}); {whose} large, \
             cancel others, and mean nothing alone",
            shown.join(", "),
            number(defect.condition),
            number(self.defective_beyond)
        )
    }
}

/// Terms listed.
const TERMS: usize = 12;
/// Lines of the table.
const SHOWN: usize = 30;
/// Terms of an eigenfunction that are named.
const LARGEST: usize = 3;

impl HeldInputReport {
    fn text(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        let [low, high] = self.range;
        let outside = if self.value >= low && self.value <= high {
            String::new()
        } else {
            format!(" (outside its range, {low} to {high})")
        };
        format!("{} = {}{unit}{outside}", self.name, self.value)
    }
}

fn number(x: f64) -> String {
    if x.is_finite() { significant(x) } else { "infinite".to_owned() }
}

/// Six decimals: eigenvalues near 1 differ in the late ones.
fn precise(x: f64) -> String {
    if x != 0.0 && x.abs() < 1e-3 { number(x) } else { format!("{x:.6}") }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::robot::Robot;
    use crate::trajectory::{InMemory, Trajectory};

    const OSCILLATOR: &str = r#"
        name = "spring"
        sample_time_s = 0.02
        states = [{ name = "x", space = "R", unit = "m" }, { name = "w", space = "R", unit = "m/s" }]
        [dictionary]
        blocks = [{ factors = ["x"] }, { factors = ["w"] }]
    "#;

    /// x and w of a linear map, shape `[2, 2]`, from two starts.
    fn report(map: [[f64; 2]; 2]) -> SpectrumReport {
        let robot = Robot::parse(OSCILLATOR, Path::new("robot.toml")).unwrap();
        let one = |start: [f64; 2]| {
            let (mut x, mut states) = (start, Vec::new());
            for _ in 0..50 {
                states.extend(x);
                x = map.map(|row| row[0] * x[0] + row[1] * x[1]);
            }
            Trajectory { states, inputs: Vec::new() }
        };
        let trajectories = [one([1.0, 0.0]), one([-0.3, 2.0]), one([0.5, 0.5])];
        let data = InMemory { trajectories: &trajectories, states: 2, inputs: 0 };
        let full = FullOperator::fit(&robot, &data, &|_| ()).unwrap();
        SpectrumReport::new(&full, robot.schema.sample_time_s, &[]).unwrap()
    }

    #[test]
    fn frequency_and_time_constant_of_an_oscillator() {
        // 1.5 Hz, decaying to 1/e in 0.4 s.
        let (decay, angle) = ((-0.02_f64 / 0.4).exp(), 1.5 * 0.02 * std::f64::consts::TAU);
        let (s, c) = (decay * angle.sin(), decay * angle.cos());
        let report = report([[c, s], [-s, c]]);
        assert_eq!(report.spectral_radius, report.eigenvalues[0].modulus);
        assert_eq!(report.eigenvalues[0].time_constant_s, None);
        for (e, sign) in report.eigenvalues[1..].iter().zip([1.0, -1.0]) {
            assert!((e.frequency_hz - sign * 1.5).abs() < 1e-9, "{}", e.frequency_hz);
            assert!((e.time_constant_s.unwrap() - 0.4).abs() < 1e-9);
            assert!((e.modulus - decay).abs() < 1e-12);
        }
        assert!(report.reconstruction_residual.unwrap() < 1e-12);
        assert!(report.defects.is_empty());
        let text = report.text();
        for part in [
            "spring: 3 trajectories, 147 snapshot",
            "inputs held: none",
            "±1.500",
            "0.4000",
            "x [m]",
        ] {
            assert!(text.contains(part), "`{part}` is not in {text}");
        }
        assert!(!text.contains("warning") && !text.contains("grows\n"), "{text}");
        // A pair has one line.
        assert_eq!(text.lines().filter(|l| l.starts_with("0.") || l.starts_with("1.0")).count(), 2);
    }

    #[test]
    fn growth_and_defects_are_said() {
        let text = report([[1.02, 0.3], [0.0, 0.7]]).text();
        assert!(text.contains("spectral radius 1.020000: an eigenfunction grows"), "{text}");
        let report = report([[0.9, 1.0], [0.0, 0.9]]);
        assert_eq!(report.defects.len(), 1);
        assert_eq!(report.defects[0].eigenvalues, [1, 2]);
        let text = report.text();
        assert!(text.contains("warning: defective or nearly so: the eigenvalues 0.9"), "{text}");
    }
}
