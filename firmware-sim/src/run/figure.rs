//! Predicted beside measured, as a plot: the way, with rollouts over the horizon under the inputs that were
//! applied, and for every state how far off the prediction of the loop was.

use crate::fault::Fault;
use firmware_core::capacity::MAX_STATES;
use firmware_core::control_loop::{Alarms, Frame, Mode};
use firmware_core::model::Model;
use firmware_core::{Predictor, PredictorState};
use plotters::prelude::*;
use std::error::Error;
use std::ops::Range;

/// Most samples that are drawn; of longer runs every second, third, … one.
const MOST: usize = 4_000;

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Point {
    t_s: f64,
    measured: [f64; 3],
    /// Residual and its bound per state.
    residual: [f64; 3],
    bound: [f64; 3],
    /// The rollout: begun from measurements up to a horizon ago.
    rollout: [f64; 2],
    alarm: bool,
}

/// Collects samples and draws them.
#[derive(Debug)]
pub struct Figure<'b> {
    title: String,
    states: Vec<(String, String)>,
    model: &'b Model<'b>,
    faults: Vec<Fault>,
    horizon: u32,
    /// The samples as measured, and the rollout from some of them.
    measured: PredictorState,
    rollout: PredictorState,
    next_sequence: u32,
    points: Vec<Point>,
    every: usize,
    seen: usize,
}

const MEASURED: RGBColor = RGBColor(0, 0, 0);
const ROLLOUT: RGBColor = RGBColor(31, 119, 180);
const RESIDUAL: RGBColor = RGBColor(60, 60, 60);
const BOUND: RGBColor = RGBColor(44, 160, 44);
const ALARM: RGBColor = RGBColor(214, 39, 40);
const FAULT: RGBColor = RGBColor(255, 224, 178);

impl<'b> Figure<'b> {
    /// A figure of a model's first states, three at most, with rollouts of `horizon` samples.
    pub fn new(title: String, model: &'b Model<'b>, horizon: u32, faults: Vec<Fault>) -> Self {
        let states = model.structure().states().iter();
        Self {
            title,
            states: states.map(|s| (s.name.to_owned(), s.unit.to_owned())).collect(),
            model,
            faults,
            horizon,
            measured: PredictorState::new(),
            rollout: PredictorState::new(),
            next_sequence: 0,
            points: Vec::new(),
            every: 1,
            seen: 0,
        }
    }

    /// Moves the rollout on; where it is now. It begins anew at every horizon, with a gap.
    fn roll_out(&mut self, frame: &Frame) -> [f64; 2] {
        let predictor = Predictor::new(self.model);
        let gap = std::mem::replace(&mut self.next_sequence, frame.sequence.wrapping_add(1))
            != frame.sequence;
        if gap || frame.measured.is_empty() || frame.mode != Mode::Running {
            self.measured = PredictorState::new();
            self.rollout = PredictorState::new();
            if frame.measured.is_empty() {
                return [f64::NAN; 2];
            }
        }
        let mut place = [f64::NAN; 2];
        let mut x = [0.0; MAX_STATES];
        let x = &mut x[..self.states.len()];
        let stepped = predictor.step(&mut self.rollout, &frame.applied).is_ok();
        if stepped && predictor.coordinates(&self.rollout, x).is_ok() && x.len() >= 2 {
            place = [f64::from(x[0]), f64::from(x[1])];
        }
        // Frames of a loop hold finite numbers, as many as its model has.
        let _ = predictor.observe(&mut self.measured, &frame.applied, &frame.measured);
        if !stepped || self.rollout.step() >= self.horizon {
            self.rollout = self.measured.clone();
        }
        place
    }

    /// Takes a sample.
    pub fn sample(&mut self, frame: &Frame) {
        let n = self.states.len().min(3);
        let rollout = self.roll_out(frame);
        self.seen += 1;
        if !self.seen.is_multiple_of(self.every) {
            return;
        }
        let of = |list: &[f32], i: usize| list.get(i).map_or(f64::NAN, |x| f64::from(*x));
        let each =
            |f: &dyn Fn(usize) -> f64| std::array::from_fn(|i| if i < n { f(i) } else { f64::NAN });
        self.points.push(Point {
            t_s: frame.time_us as f64 * 1e-6,
            measured: each(&|i| of(&frame.measured, i)),
            residual: each(&|i| of(&frame.residual, i)),
            bound: each(&|i| {
                let bound = self.model.error_bounds().and_then(|b| b.bound(frame.bound_steps, i));
                bound.map_or(f64::NAN, f64::from)
            }),
            rollout,
            alarm: !(frame.noticed & Alarms::TELLING).is_empty(),
        });
        if self.points.len() >= MOST {
            let mut keep = false;
            self.points.retain(|_| {
                keep = !keep;
                keep
            });
            self.every *= 2;
        }
    }

    /// The plot, SVG.
    ///
    /// # Errors
    /// Those of the drawing library.
    pub fn svg(&self) -> Result<String, Box<dyn Error>> {
        let n = self.states.len().min(3);
        let size = (1180, 560);
        let mut text = String::new();
        {
            let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
            root.fill(&WHITE)?;
            root.draw(&Text::new(self.title.clone(), (16, 10), ("sans-serif", 18)))?;
            let (_, below) = root.split_vertically(36);
            let (panels, legend) = below.split_vertically(484);
            let (left, right) = panels.split_horizontally(500);
            self.way(&left)?;
            for (i, area) in right.split_evenly((n, 1)).iter().enumerate() {
                self.residuals(i, i + 1 == n, area)?;
            }
            self.legend(&legend)?;
            root.present()?;
        }
        Ok(text)
    }

    fn way(&self, area: &Area<'_>) -> Result<(), Box<dyn Error>> {
        let runs = |of: &dyn Fn(&Point) -> (f64, f64)| {
            let points: Vec<(f64, f64)> = self.points.iter().map(of).collect();
            points
        };
        let measured = runs(&|p| (p.measured[0], p.measured[1]));
        let rollouts = runs(&|p| (p.rollout[0], p.rollout[1]));
        let all = measured.iter().chain(&rollouts);
        let (x, y) = (span(all.clone().map(|p| p.0)), span(all.map(|p| p.1)));
        // One metre is as long to the right as upwards.
        let unit = ((x.end - x.start) / 400.0).max((y.end - y.start) / 380.0);
        let (x, y) = (widened(&x, unit * 400.0), widened(&y, unit * 380.0));
        let label = |i: usize| {
            self.states.get(i).map_or_else(String::new, |(name, unit)| format!("{name} [{unit}]"))
        };
        let mut chart = ChartBuilder::on(area)
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(58)
            .build_cartesian_2d(x, y)?;
        mesh(&mut chart, &label(0), &label(1))?;
        for run in pieces(&rollouts) {
            chart.draw_series(LineSeries::new(run.iter().copied(), ROLLOUT.stroke_width(2)))?;
        }
        for run in pieces(&measured) {
            chart.draw_series(LineSeries::new(run.iter().copied(), MEASURED.stroke_width(1)))?;
        }
        let alarms = self.points.iter().filter(|p| p.alarm && p.measured[0].is_finite());
        chart.draw_series(
            alarms.map(|p| Circle::new((p.measured[0], p.measured[1]), 3, ALARM.filled())),
        )?;
        Ok(())
    }

    fn residuals(&self, i: usize, is_last: bool, area: &Area<'_>) -> Result<(), Box<dyn Error>> {
        let (first, last) = (self.points.first(), self.points.last());
        let t = first.map_or(0.0, |p| p.t_s)..last.map_or(1.0, |p| p.t_s.max(1e-3));
        let bounds = || self.points.iter().map(|p| p.bound[i]).filter(|b| b.is_finite());
        let residuals = || self.points.iter().map(|p| p.residual[i]).filter(|r| r.is_finite());
        // The bounds stay readable whatever a fault does: what is beyond four of them is cut off.
        let widest = bounds().fold(0.0, f64::max);
        let largest = residuals().map(f64::abs).fold(0.0, f64::max);
        let most = if widest > 0.0 { largest.clamp(1.3 * widest, 4.0 * widest) } else { largest };
        let most = 1.05 * most.max(1e-9);
        let (name, unit) = &self.states[i];
        let mut chart = ChartBuilder::on(area)
            .margin(10)
            .x_label_area_size(if is_last { 40 } else { 14 })
            .y_label_area_size(70)
            .build_cartesian_2d(t.clone(), -most..most)?;
        for fault in &self.faults {
            // What lies far outside has no pixels that fit into an integer.
            let (from_s, until_s) = (fault.from_s().max(t.start), fault.until_s().min(t.end));
            if from_s >= until_s {
                continue;
            }
            let corners = [(from_s, -most), (until_s, most)];
            chart.draw_series([Rectangle::new(corners, FAULT.filled())])?;
        }
        let label = if is_last { "time [s]" } else { "" };
        mesh(&mut chart, label, &format!("{name} off [{unit}]"))?;
        for sign in [1.0, -1.0] {
            let line: Vec<(f64, f64)> =
                self.points.iter().map(|p| (p.t_s, sign * p.bound[i])).collect();
            for run in pieces(&line) {
                chart.draw_series(LineSeries::new(run.iter().copied(), BOUND.stroke_width(1)))?;
            }
        }
        let line: Vec<(f64, f64)> = self
            .points
            .iter()
            .map(|p| (p.t_s, p.residual[i].max(-most).min(most) + 0.0 * p.residual[i]))
            .collect();
        for run in pieces(&line) {
            chart.draw_series(LineSeries::new(run.iter().copied(), RESIDUAL.stroke_width(1)))?;
        }
        let alarms = self.points.iter().filter(|p| p.alarm);
        chart.draw_series(alarms.map(|p| Circle::new((p.t_s, -0.92 * most), 2, ALARM.filled())))?;
        Ok(())
    }

    fn legend(&self, area: &Area<'_>) -> Result<(), Box<dyn Error>> {
        let rollout = format!("rollouts of {} samples, inputs as applied", self.horizon);
        let entries = [
            ("measured", MEASURED),
            (rollout.as_str(), ROLLOUT),
            ("measured − predicted", RESIDUAL),
            ("its error bound", BOUND),
            ("alarm", ALARM),
            ("fault", FAULT),
        ];
        let mut x = 20;
        for (name, colour) in entries {
            if name == "fault" {
                area.draw(&Rectangle::new([(x, 8), (x + 24, 22)], colour.filled()))?;
            } else if name == "alarm" {
                area.draw(&Circle::new((x + 12, 15), 3, colour.filled()))?;
            } else {
                area.draw(&PathElement::new([(x, 15), (x + 24, 15)], colour.stroke_width(2)))?;
            }
            area.draw(&Text::new(name.to_owned(), (x + 30, 8), ("sans-serif", 14)))?;
            x += 56 + 7 * name.chars().count() as i32;
        }
        Ok(())
    }
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Context<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

fn mesh(chart: &mut Context<'_, '_>, x: &str, y: &str) -> Result<(), Box<dyn Error>> {
    let plain = |v: &f64| {
        let short = (v * 1e6).round() / 1e6;
        if short == 0.0 { "0".to_owned() } else { short.to_string() }
    };
    chart
        .configure_mesh()
        .x_desc(x)
        .y_desc(y)
        .x_labels(7)
        .y_labels(5)
        .x_label_formatter(&plain)
        .y_label_formatter(&plain)
        .label_style(("sans-serif", 12))
        .axis_desc_style(("sans-serif", 14))
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225))
        .draw()?;
    Ok(())
}

/// Runs of finite points.
fn pieces(points: &[(f64, f64)]) -> impl Iterator<Item = &[(f64, f64)]> {
    points.split(|(x, y)| !(x.is_finite() && y.is_finite())).filter(|run| run.len() > 1)
}

fn span(values: impl Iterator<Item = f64>) -> Range<f64> {
    let finite = values.filter(|v| v.is_finite());
    let (low, high) =
        finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if low > high {
        return 0.0..1.0;
    }
    let room = 0.05 * (high - low).max(1e-3);
    low - room..high + room
}

fn widened(range: &Range<f64>, width: f64) -> Range<f64> {
    let middle = 0.5 * (range.start + range.end);
    middle - 0.5 * width..middle + 0.5 * width
}
