//! Line charts as SVG: panels side by side under one title, one legend for all of them.

use std::ops::Range;

use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// A line.
    Line,
    /// A dashed line.
    Dashed,
    /// Small circles.
    Points,
}

/// One line or cloud of points.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend; series without a name, or with that of an earlier one, are not listed.
    pub name: String,
    /// Red, green, blue.
    pub colour: [u8; 3],
    /// How it is drawn.
    pub style: Style,
    /// (x, y) in the units of the axes; points that are not finite, or not above 0 on a logarithmic
    /// axis, are left out.
    pub points: Vec<(f64, f64)>,
}

/// What the axes do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axes {
    /// As the data need.
    Free,
    /// A unit is as long on both axes: maps.
    Equal,
    /// Powers of ten upwards.
    LogY,
    /// Powers of ten in both directions.
    LogLog,
}

/// One panel.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// Title.
    pub title: String,
    /// What is on the horizontal axis, with its unit.
    pub x: String,
    /// What is on the vertical axis, with its unit.
    pub y: String,
    /// Scales.
    pub axes: Axes,
    /// What is drawn, the first at the bottom.
    pub series: Vec<Series>,
}

/// The smallest value that a logarithmic axis shows: below it, rounding is all there is to see.
const LOG_FLOOR: f64 = 1e-18;

/// Pixels of one panel.
const PANEL: (u32, u32) = (460, 360);
/// Pixels of what surrounds the plotting area of a panel.
const MARGIN: u32 = 12;
const X_LABELS: u32 = 44;
const Y_LABELS: u32 = 64;
const CAPTION: u32 = 26;
/// Pixels of the legend's rows and of the figure's title.
const LEGEND_ROW: i32 = 20;
const TITLE: u32 = 40;
/// Pixels that a character of the legend takes, about.
const CHARACTER: usize = 8;

/// A figure of panels in rows of `columns`.
///
/// ```
/// use trainer::plot::{Axes, Chart, Series, Style, svg};
/// let line = Series {
///     name: "x".into(), colour: [0, 0, 0], style: Style::Line, points: vec![(0.0, 1.0), (1.0, 2.0)],
/// };
/// let chart = Chart {
///     title: "growth".into(), x: "time [s]".into(), y: "x [m]".into(), axes: Axes::Free, series: vec![line],
/// };
/// let figure = svg("Growth", &[chart], 1);
/// assert!(figure.starts_with("<svg") && figure.contains("time [s]"));
/// ```
pub fn svg(title: &str, charts: &[Chart], columns: usize) -> String {
    let columns = columns.clamp(1, charts.len().max(1)) as u32;
    let rows = (charts.len() as u32).div_ceil(columns);
    let mut legend: Vec<&Series> = Vec::new();
    for series in charts.iter().flat_map(|c| &c.series) {
        if !series.name.is_empty() && !legend.iter().any(|s| s.name == series.name) {
            legend.push(series);
        }
    }
    let longest = legend.iter().map(|s| s.name.chars().count()).max().unwrap_or(0);
    let width = columns * PANEL.0;
    // As many legend entries side by side as fit.
    let cell = (longest * CHARACTER + 60) as u32;
    let across = (width / cell.max(1)).max(1);
    let legend_height = (legend.len() as u32).div_ceil(across) * LEGEND_ROW as u32 + 16;
    let size = (width, TITLE + rows * PANEL.1 + legend_height);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        // Drawing into a string does not fail; a chart that cannot be drawn leaves its panel empty.
        let _ = root.fill(&WHITE);
        let centred =
            TextStyle::from(("sans-serif", 20)).pos(plotters::style::text_anchor::Pos::new(
                plotters::style::text_anchor::HPos::Center,
                plotters::style::text_anchor::VPos::Top,
            ));
        let _ = root.draw(&Text::new(title, (size.0 as i32 / 2, 12), centred));
        let (_, below) = root.split_vertically(TITLE);
        let (panels, bottom) = below.split_vertically(rows * PANEL.1);
        for (chart, area) in
            charts.iter().zip(panels.split_evenly((rows as usize, columns as usize)))
        {
            let _ = draw(chart, &area);
        }
        for (i, series) in legend.iter().enumerate() {
            let (column, row) = (i as u32 % across, i as u32 / across);
            let (x, y) = ((20 + column * cell) as i32, 14 + row as i32 * LEGEND_ROW);
            let colour = colour(series);
            let _ = match series.style {
                Style::Points => bottom.draw(&Circle::new((x + 14, y), 3, colour.filled())),
                Style::Line => {
                    bottom.draw(&PathElement::new([(x, y), (x + 28, y)], colour.stroke_width(2)))
                }
                Style::Dashed => [0, 11, 22].into_iter().try_for_each(|dash| {
                    let ends = [(x + dash, y), (x + dash + 6, y)];
                    bottom.draw(&PathElement::new(ends, colour.stroke_width(2)))
                }),
            };
            let _ =
                bottom.draw(&Text::new(series.name.clone(), (x + 36, y - 6), ("sans-serif", 14)));
        }
        let _ = root.present();
    }
    text
}

fn colour(series: &Series) -> RGBColor {
    let [r, g, b] = series.colour;
    RGBColor(r, g, b)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn draw(chart: &Chart, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
    let log_x = chart.axes == Axes::LogLog;
    let log_y = matches!(chart.axes, Axes::LogY | Axes::LogLog);
    let scale = |value: f64, log: bool| match log {
        true if value > 0.0 => libm::log10(value.max(LOG_FLOOR)),
        true => f64::NAN,
        false => value,
    };
    let runs: Vec<Vec<(f64, f64)>> = chart
        .series
        .iter()
        .map(|s| {
            let scaled = s.points.iter().map(|(x, y)| (scale(*x, log_x), scale(*y, log_y)));
            scaled.filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
        })
        .collect();
    let mut x = span(runs.iter().flatten().map(|p| p.0), log_x);
    let mut y = span(runs.iter().flatten().map(|p| p.1), log_y);
    if chart.axes == Axes::Equal {
        let pixels = (
            f64::from(PANEL.0 - Y_LABELS - 2 * MARGIN),
            f64::from(PANEL.1 - X_LABELS - CAPTION - 2 * MARGIN),
        );
        let unit = ((x.end - x.start) / pixels.0).max((y.end - y.start) / pixels.1);
        x = widened(&x, unit * pixels.0);
        y = widened(&y, unit * pixels.1);
    }
    let mut context = ChartBuilder::on(area)
        .margin(MARGIN)
        .caption(&chart.title, ("sans-serif", 16))
        .x_label_area_size(X_LABELS)
        .y_label_area_size(Y_LABELS)
        .build_cartesian_2d(x, y)?;
    let power = |v: &f64| match (v - v.round()).abs() < 1e-9 {
        true => format!("1e{}", v.round() as i32),
        false => String::new(),
    };
    let plain = |v: &f64| {
        // 0.30000000000000004 is 0.3.
        let short = (v * 1e6).round() / 1e6;
        if short == 0.0 { "0".to_owned() } else { short.to_string() }
    };
    context
        .configure_mesh()
        .x_desc(&chart.x)
        .y_desc(&chart.y)
        .x_labels(if log_x { 6 } else { 7 })
        .y_labels(8)
        .x_label_formatter(if log_x { &power } else { &plain })
        .y_label_formatter(if log_y { &power } else { &plain })
        .label_style(("sans-serif", 12))
        .axis_desc_style(("sans-serif", 14))
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225))
        .draw()?;
    for (series, points) in chart.series.iter().zip(runs) {
        draw_series(&mut context, series, points)?;
    }
    Ok(())
}

type Context<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

fn draw_series(
    context: &mut Context<'_, '_>,
    series: &Series,
    points: Vec<(f64, f64)>,
) -> Result<(), Box<dyn std::error::Error>> {
    let colour = colour(series);
    match series.style {
        Style::Line => {
            context.draw_series(LineSeries::new(points, colour.stroke_width(2)))?;
        }
        Style::Dashed => {
            context.draw_series(DashedLineSeries::new(points, 6, 5, colour.stroke_width(2)))?;
        }
        Style::Points => {
            let circle = |point| Circle::new(point, 3, colour.filled());
            context.draw_series(points.into_iter().map(circle))?;
        }
    }
    Ok(())
}

/// The range of the values with some room, on whole decades when logarithmic.
fn span(values: impl Iterator<Item = f64>, log: bool) -> Range<f64> {
    let (low, high) =
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if low > high {
        return 0.0..1.0;
    }
    if log {
        let (low, high) = (low.floor(), high.ceil());
        return if low < high { low..high } else { low..low + 1.0 };
    }
    let room = 0.05 * (high - low).max(1e-9 * high.abs()).max(f64::MIN_POSITIVE);
    if high > low { low - room..high + room } else { low - 0.5..high + 0.5 }
}

/// A range of the given width around the same middle.
fn widened(range: &Range<f64>, width: f64) -> Range<f64> {
    let middle = 0.5 * (range.start + range.end);
    middle - 0.5 * width..middle + 0.5 * width
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(axes: Axes, points: Vec<(f64, f64)>) -> Chart {
        let series = Series { name: "a".into(), colour: [9, 8, 7], style: Style::Line, points };
        let label = |s: &str| s.to_owned();
        Chart {
            title: label("t"),
            x: label("x [s]"),
            y: label("y [m]"),
            axes,
            series: vec![series],
        }
    }

    #[test]
    fn a_name_is_in_the_legend_once() {
        let charts = [
            chart(Axes::Free, vec![(0.0, 0.0), (1.0, 2.0)]),
            chart(Axes::Free, vec![(0.0, 0.0), (3.0, 2.0)]),
        ];
        let text = svg("two", &charts, 2);
        assert_eq!(text.matches("\na\n").count(), 1, "{text}");
        assert!(text.contains("two") && text.contains("x [s]") && text.contains("y [m]"));
    }

    #[test]
    fn numbers_that_cannot_be_drawn_are_left_out() {
        let points =
            vec![(0.0, f64::NAN), (1.0, 0.0), (2.0, 1e-3), (3.0, 1e-2), (4.0, f64::INFINITY)];
        let text = svg("log", &[chart(Axes::LogY, points)], 1);
        assert!(!text.contains("NaN") && !text.contains("inf"), "{text}");
        assert!(text.contains("1e-3") && text.contains("1e-2"));
        for axes in [Axes::Free, Axes::Equal, Axes::LogY, Axes::LogLog] {
            assert!(svg("empty", &[chart(axes, Vec::new())], 1).ends_with("</svg>\n"));
            assert!(svg("point", &[chart(axes, vec![(2.0, 2.0)])], 1).contains("<polyline"));
        }
    }

    #[test]
    fn spans_hold_their_values() {
        assert_eq!(span([0.0, 10.0].into_iter(), false), -0.5..10.5);
        assert_eq!(span([-2.5, 0.1].into_iter(), true), -3.0..1.0);
        assert_eq!(span([3.0].into_iter(), false), 2.5..3.5);
        assert_eq!(widened(&(0.0..2.0), 6.0), -2.0..4.0);
    }
}
