//! What the distance between the two rays of every point says, without truth, of the calibration.
//!
//! Noise of the match opens the gap at random, a wrong calibration opens it smoothly over the field. So a
//! polynomial of second order in the pixel is fitted to the gaps, robustly: what it holds is set against what
//! noise (averaged over the field) and the calibration's own covariance leave to be expected.

use super::decode::ProfilePoint;
use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

/// Terms of the polynomial.
const TERMS: usize = 6;
/// Fewest points for a fit: with fewer, a constant.
const FEWEST: usize = 4 * TERMS;
/// A gap beyond this many robust standard deviations of all is left out of the fit.
const OUTLIER: f64 = 5.0;
/// Smooth errors of the correlation itself, pixels of v: interpolation and shape function.
const CORRELATION_PX: f64 = 0.003;
/// The smooth part may exceed its expected value this many times.
const LIMIT: f64 = 3.0;

/// The gap (mm) as a polynomial of the −1 pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GapField {
    middle_px: [f64; 2],
    scale_px: f64,
    coefficients: [f64; TERMS],
}

impl GapField {
    /// No gap anywhere.
    pub const ZERO: Self = Self { middle_px: [0.0; 2], scale_px: 1.0, coefficients: [0.0; TERMS] };

    fn row(&self, pixel_px: [f64; 2]) -> SVector<f64, TERMS> {
        let [x, y] = [0, 1].map(|i| (pixel_px[i] - self.middle_px[i]) / self.scale_px);
        SVector::from([1.0, x, y, x * x, x * y, y * y])
    }

    /// The gap at a pixel, mm.
    pub fn at(&self, pixel_px: [f64; 2]) -> f64 {
        self.row(pixel_px).dot(&SVector::from(self.coefficients))
    }

    /// The gaps of the points that are `ok`.
    pub(super) fn fit(points: &[ProfilePoint]) -> Self {
        let ok = || points.iter().filter(|p| p.status.is_ok());
        let gaps: Vec<f64> = ok().map(|p| p.gap_mm).collect();
        let Some(centre) = median(gaps.clone()) else { return Self::ZERO };
        let spread = median(gaps.iter().map(|g| (g - centre).abs()).collect()).unwrap_or(0.0);
        let mut field = Self::ZERO;
        field.coefficients[0] = centre;
        let range = |i: usize| {
            ok().fold([f64::MAX, f64::MIN], |[a, b], p| [a.min(p.pixel_px[i]), b.max(p.pixel_px[i])])
        };
        let [x, y] = [range(0), range(1)];
        // a constant serves until there are points enough
        let constant = field;
        field.middle_px = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])];
        field.scale_px = (0.5 * (x[1] - x[0]).max(y[1] - y[0])).max(1.0);
        let mut normal = SMatrix::<f64, TERMS, TERMS>::zeros();
        let mut right = SVector::<f64, TERMS>::zeros();
        let mut used = 0;
        // 1.48: from the median deviation of a normal distribution to its σ
        for p in ok().filter(|p| (p.gap_mm - centre).abs() <= OUTLIER * 1.48 * spread) {
            let row = field.row(p.pixel_px);
            normal += row * row.transpose();
            right += row * p.gap_mm;
            used += 1;
        }
        if used < FEWEST {
            return constant;
        }
        match normal.cholesky() {
            // points on a line leave terms open
            Some(factor) if factor.l().diagonal().min() > 1e-6 => {
                field.coefficients = factor.solve(&right).into();
                field
            }
            _ => constant,
        }
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Gaps of the rays over the field, micrometres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GapSummary {
    /// Mean, with sign.
    pub mean_um: f64,
    /// RMS.
    pub rms_um: f64,
    /// RMS to expect from the noise of the matches and from the calibration's covariance.
    pub expected_um: f64,
    /// RMS of the part that varies smoothly over the field.
    pub smooth_um: f64,
    /// The same, to be expected.
    pub expected_smooth_um: f64,
    /// Whether the smooth part is no more than three times what is to be expected.
    pub consistent: bool,
}

impl GapSummary {
    pub(super) fn new<'a>(
        points: impl Iterator<Item = &'a ProfilePoint>,
        field: &GapField,
        shared: f64,
    ) -> Self {
        let (mut n, mut sum, mut square, mut noise, mut common, mut smooth) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        let mut by_pixel = 0.0;
        for p in points {
            n += 1.0;
            sum += p.gap_mm;
            square += p.gap_mm * p.gap_mm;
            noise += p.sigma_gap_mm * p.sigma_gap_mm;
            common += p.common_gap_mm * p.common_gap_mm;
            smooth += field.at(p.pixel_px).powi(2);
            by_pixel += p.gap_by_v_mm_per_px.powi(2);
        }
        let averaged = noise / n * (TERMS as f64 * shared / n).min(1.0);
        let least = CORRELATION_PX * CORRELATION_PX * by_pixel / n;
        let um = |mean_square: f64| 1e3 * mean_square.sqrt();
        let (smooth_um, expected_smooth_um) = (um(smooth / n), um(averaged + common / n + least));
        Self {
            mean_um: 1e3 * sum / n,
            rms_um: um(square / n),
            expected_um: um((noise + common) / n),
            smooth_um,
            expected_smooth_um,
            consistent: smooth_um <= LIMIT * expected_smooth_um,
        }
    }

    /// What to think of it, in a sentence.
    pub fn verdict(&self) -> String {
        let (smooth, expected) = (self.smooth_um, self.expected_smooth_um);
        if self.consistent {
            return format!(
                "The rays meet: the part of the gap that varies smoothly over the field is {smooth:.3} µm RMS, at most {LIMIT} × {expected:.3} µm is to be expected."
            );
        }
        format!(
            "The rays do not meet: the part of the gap that varies smoothly over the field is {smooth:.3} µm RMS where {expected:.3} µm is to be expected. The calibration (groove angles, pitches, tilts of the gratings, or the lens) does not fit this frame, or the decoder's model does not; calibrate anew, or check that the gratings and maps of the two views are not mistaken for each other."
        )
    }
}
