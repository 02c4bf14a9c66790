//! A run as it happens, in the terminal: where the robot was, where it is, where it will be.

use crate::run::Seen;
use firmware_core::control_loop::Alarms;
use std::collections::VecDeque;
use std::fmt::Write as _;

/// Characters of the picture.
const COLUMNS: usize = 64;
const ROWS: usize = 20;
/// Samples of the way that are shown.
const TRAIL: usize = 300;
/// A character is about twice as high as wide.
const ASPECT: f64 = 2.0;

/// What is shown.
#[derive(Debug, Default)]
pub struct Live {
    trail: VecDeque<[f64; 2]>,
    /// What the picture spans.
    middle: [f64; 2],
    scale: f64,
}

impl Live {
    /// Nothing seen yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// The picture after one more sample: `·` measured, `o` the robot, `+` predicted.
    pub fn picture(&mut self, seen: &Seen<'_>, names: &[(String, String)]) -> String {
        let frame = seen.frame;
        let at = |list: &[f32]| match list {
            [x, y, ..] => Some([f64::from(*x), f64::from(*y)]),
            _ => None,
        };
        let now = at(&frame.measured).or_else(|| at(&frame.predicted));
        if let Some(measured) = at(&frame.measured) {
            self.trail.push_back(measured);
            if self.trail.len() > TRAIL {
                self.trail.pop_front();
            }
        }
        let path: Vec<[f64; 2]> = seen.path.chunks(names.len().max(1)).filter_map(at).collect();
        self.fit(&path);

        let mut canvas = vec![vec![' '; COLUMNS]; ROWS];
        let mut draw = |[x, y]: [f64; 2], mark: char| {
            let column = (x - self.middle[0]) / self.scale + COLUMNS as f64 / 2.0;
            let row = ROWS as f64 / 2.0 - (y - self.middle[1]) / self.scale / ASPECT;
            if (0.0..COLUMNS as f64).contains(&column) && (0.0..ROWS as f64).contains(&row) {
                canvas[row as usize][column as usize] = mark;
            }
        };
        self.trail.iter().for_each(|place| draw(*place, '·'));
        path.iter().for_each(|place| draw(*place, '+'));
        now.into_iter().for_each(|place| draw(place, 'o'));

        let mut text = String::new();
        let _ = writeln!(text, "┌{}┐", "─".repeat(COLUMNS));
        for row in canvas {
            let _ = writeln!(text, "│{}│", row.into_iter().collect::<String>());
        }
        let _ = writeln!(text, "└{}┘", "─".repeat(COLUMNS));
        let unit = names.first().map_or("", |(_, unit)| unit);
        let _ = writeln!(
            text,
            "· measured   o now   + predicted     {:.3} {unit} per character\x1b[K",
            self.scale
        );
        let list = |list: &[f32]| {
            let numbers: Vec<String> = list.iter().map(|x| format!("{x:9.3}")).collect();
            if numbers.is_empty() { "        -".to_owned() } else { numbers.join(" ") }
        };
        let _ = writeln!(
            text,
            "t {:9.2} s   {:?}   alarms: {}\x1b[K\nmeasured  {}\x1b[K\npredicted {}\x1b[K\ninputs    {}\x1b[K",
            frame.time_us as f64 * 1e-6,
            frame.mode,
            frame.alarms & Alarms::TELLING,
            list(&frame.measured),
            list(&frame.predicted),
            list(&frame.applied),
        );
        text
    }

    /// Moves and widens the picture when something would leave it.
    fn fit(&mut self, path: &[[f64; 2]]) {
        let half = [self.scale * COLUMNS as f64 / 2.0, self.scale * ROWS as f64 * ASPECT / 2.0];
        let all = || self.trail.iter().chain(path);
        let inside = all().all(|p| (0..2).all(|i| (p[i] - self.middle[i]).abs() < half[i]));
        if inside && self.scale > 0.0 {
            return;
        }
        let span = |i: usize| {
            all().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p[i]), b.max(p[i])))
        };
        let (x, y) = (span(0), span(1));
        if x.0 > x.1 {
            return;
        }
        self.middle = [0.5 * (x.0 + x.1), 0.5 * (y.0 + y.1)];
        // A third of room, so that it does not move all the time.
        let wide = 1.3 * (x.1 - x.0) / COLUMNS as f64;
        let high = 1.3 * (y.1 - y.0) / (ROWS as f64 * ASPECT);
        self.scale = wide.max(high).max(1e-3);
    }
}
