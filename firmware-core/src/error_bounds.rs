//! Error bounds: how far the measured coordinate may be from the predicted one.

use crate::capacity::MAX_HORIZON;

/// Why error bounds are refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorBoundsError {
    /// The coverage is not a number between 0 and 1, both excluded.
    Coverage,
    /// There is no calibration unit.
    Units,
    /// There is no horizon.
    NoHorizon,
    /// A horizon is 0, not larger than the one before it, or beyond [`MAX_HORIZON`].
    Horizon {
        /// Its index.
        horizon: usize,
    },
    /// Not one bound per horizon and coordinate.
    DimensionMismatch {
        /// Horizons times coordinates.
        expected: usize,
        /// Bounds found.
        found: usize,
    },
    /// A bound is negative, NaN or infinite.
    Bound {
        /// Its index, horizons slowest.
        bound: usize,
    },
}

/// Bounds of the prediction error by step and coordinate, measured on data that the fit has not
/// seen.
///
/// With the probability [`coverage`](Self::coverage), over units of calibration like the
/// [`units`](Self::units) it was measured on, the measured coordinate h steps after the last
/// measurement is within [`bound`](Self::bound)`(h, coordinate)` of the predicted one, in the unit of
/// the coordinate; the difference of angles is taken on the circle.
///
/// ```
/// use firmware_core::error_bounds::ErrorBounds;
/// // 90 % on 40 trajectories; x [m] and φ [rad] after 1 and 10 steps.
/// let bounds = ErrorBounds::new(2, 0.9, 40, &[1, 10], &[0.01, 0.02, 0.15, 0.2]).unwrap();
/// assert_eq!(bounds.bound(0, 1), Some(0.0));
/// assert_eq!(bounds.bound(1, 1), Some(0.02));
/// assert_eq!(bounds.bound(2, 1), Some(0.2)); // of the next horizon
/// assert_eq!(bounds.bound(11, 1), None);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorBounds<'a> {
    states: usize,
    coverage: f32,
    units: u32,
    horizons: &'a [u32],
    bounds: &'a [f32],
}

impl<'a> ErrorBounds<'a> {
    /// Checks bounds of shape `[horizons, states]`, horizons slowest, each in the unit of its
    /// coordinate, against the horizons, in steps, ascending. Between two horizons the bound of the
    /// later one holds: it is one for the steps before it as well if the bounds do not shrink with
    /// the horizon.
    ///
    /// # Errors
    /// [`ErrorBoundsError`].
    pub fn new(
        states: usize,
        coverage: f32,
        units: u32,
        horizons: &'a [u32],
        bounds: &'a [f32],
    ) -> Result<Self, ErrorBoundsError> {
        if !(coverage > 0.0 && coverage < 1.0) {
            return Err(ErrorBoundsError::Coverage);
        }
        if units == 0 {
            return Err(ErrorBoundsError::Units);
        }
        if horizons.is_empty() {
            return Err(ErrorBoundsError::NoHorizon);
        }
        let mut before = 0;
        for (horizon, steps) in horizons.iter().enumerate() {
            if *steps <= before || *steps > MAX_HORIZON {
                return Err(ErrorBoundsError::Horizon { horizon });
            }
            before = *steps;
        }
        let expected = horizons.len().saturating_mul(states);
        if bounds.len() != expected {
            let found = bounds.len();
            return Err(ErrorBoundsError::DimensionMismatch { expected, found });
        }
        if let Some(bound) = bounds.iter().position(|b| !(0.0..=f32::MAX).contains(b)) {
            return Err(ErrorBoundsError::Bound { bound });
        }
        Ok(Self { states, coverage, units, horizons, bounds })
    }

    /// The share of predictions within the bounds, between 0 and 1.
    pub fn coverage(&self) -> f32 {
        self.coverage
    }

    /// Independent units of calibration, such as trajectories.
    pub fn units(&self) -> u32 {
        self.units
    }

    /// State coordinates.
    pub fn states(&self) -> usize {
        self.states
    }

    /// The horizons \[steps\], ascending.
    pub fn horizons(&self) -> &'a [u32] {
        self.horizons
    }

    /// Shape `[horizons, states]`, horizons slowest, each in the unit of its coordinate.
    pub fn bounds(&self) -> &'a [f32] {
        self.bounds
    }

    /// The bound of a coordinate after so many steps, in its unit: that of the horizon, between two
    /// of them of the later one, 0 for the last measurement itself (step 0). `None` beyond the last
    /// horizon and for a coordinate that is not there.
    #[inline]
    pub fn bound(&self, step: u32, coordinate: usize) -> Option<f32> {
        if step == 0 && coordinate < self.states {
            return Some(0.0);
        }
        self.row(step)?.get(coordinate).copied()
    }

    /// The bounds of all coordinates after so many steps, shape `[states]`; `None` for step 0 and beyond the last
    /// horizon.
    #[inline]
    pub(crate) fn row(&self, step: u32) -> Option<&'a [f32]> {
        if step == 0 {
            return None;
        }
        let horizon = self.horizons.partition_point(|steps| *steps < step);
        self.bounds.get(horizon.checked_mul(self.states)?..)?.get(..self.states)
    }
}
