//! What a set-up will be able to measure, before it is built: field, resolution, overlap of the
//! views, grating size, depth range, uncertainty and its budget, what the light's bandwidth does, and
//! what to change.
//!
//! Everything that rays can say is asked of the exact ray model; the formulas of the literature, (2.9)
//! corrected and (2.10), stand beside it. Lengths in millimetres, places on the sensor in pixels.

mod advice;
mod budget;
mod views;

use serde::{Deserialize, Serialize};

use crate::decode::{Decoder, PixelPair, pixel_covariance};
use crate::model::{OpticalModel, TraceError};
use crate::pair_model::PairModel;
use crate::project::DisparityRange;
use crate::setup::{Optics, OpticsError, View};
use nalgebra::Vector3;

pub use advice::{Suggestion, Variant, Warning};
pub use budget::{BudgetRow, Light, Paraxial};
pub use views::{Extent, Rectangle};

/// What is asked of the set-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Request {
    /// Columns and rows of the sensor; the left half takes the −1 view, the right half the +1 view.
    pub sensor_px: [f64; 2],
    /// Standard deviation of the disparity (u, v), px.
    pub sigma_px: [f64; 2],
    /// Lowest and highest point of the specimen, mm over the reference plane.
    pub heights_mm: [f64; 2],
    /// Width and height of the specimen, centred on the axis; left out, nine tenths of the field.
    pub specimen_mm: Option<[f64; 2]>,
    /// Width Δλ of the light's spectrum, mm.
    pub bandwidth_mm: f64,
    /// Drift of the wavelength, mm.
    pub drift_mm: f64,
    /// Errors of d and s for (2.9), mm.
    pub distance_errors_mm: [f64; 2],
    /// Diameter of the lens's entrance pupil, for the depth of field.
    pub pupil_mm: Option<f64>,
    /// Side of the subsets, px.
    pub subset_px: f64,
    /// Whether light goes through the grating undiffracted; some gratings suppress it.
    pub zeroth_order: bool,
}

impl Default for Request {
    /// The thesis' camera and noise.
    fn default() -> Self {
        Self {
            sensor_px: [2592.0, 1944.0],
            sigma_px: [0.09, 0.09],
            heights_mm: [-2.0, 2.0],
            specimen_mm: None,
            bandwidth_mm: 2e-6,
            drift_mm: 1e-7,
            distance_errors_mm: [0.1, 0.1],
            pupil_mm: None,
            subset_px: 33.0,
            zeroth_order: true,
        }
    }
}

/// Standard deviations of a decoded point, mm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Sigma {
    /// On the axis, (x, y, h).
    pub centre_mm: [f64; 3],
    /// Largest over the specimen, (x, y, h).
    pub worst_mm: [f64; 3],
}

/// Depth range of the specimen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Depth {
    /// Heights between which the whole specimen is seen in both views without an overlap.
    pub seen_mm: [f64; 2],
    /// Heights between which defocus blurs by at most [`Depth::BLUR_PX`], if the pupil is known and
    /// the lens is focused on the reference plane (geometrical optics).
    pub sharp_mm: Option<[f64; 2]>,
}

impl Depth {
    /// Blur that still counts as sharp: diameter in pixels.
    pub const BLUR_PX: f64 = 2.0;
}

/// What the set-up does.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// Angle θ of the first order of the gratings (−1 view, +1 view), degrees.
    pub angle_deg: [f64; 2],
    /// Size of a pixel on the reference plane at the axis, along x and y, mm.
    pub pixel_mm: [f64; 2],
    /// Side of a subset on the specimen, mm: the lateral resolution of the correlation.
    pub subset_mm: f64,
    /// Largest rectangle around the axis on the reference plane that both views see, each on its half.
    pub field_mm: Rectangle,
    /// The specimen: as asked, or nine tenths of the field.
    pub specimen_mm: Rectangle,
    /// Columns that the −1 view, the zeroth order and the +1 view of the specimen take up.
    pub columns_px: [Extent; 3],
    /// Columns free between −1 view and zeroth order, zeroth order and +1 view; negative: overlap.
    pub free_px: [f64; 2],
    /// Columns free between the two first-order views; negative: overlap.
    pub free_between_views_px: f64,
    /// Widest specimen whose views overlap neither each other nor (if there is one) the zeroth order.
    pub widest_specimen_mm: f64,
    /// Where the rays of the specimen cross the gratings (−1 view, +1 view), from the pivot.
    pub footprints_mm: [Rectangle; 2],
    /// Depth.
    pub depth: Depth,
    /// By exact Jacobian.
    pub sigma: Sigma,
    /// b', θ and (2.10).
    pub paraxial: Paraxial,
    /// (2.9), corrected, at some heights.
    pub budget: Vec<BudgetRow>,
    /// What bandwidth and drift do.
    pub light: Light,
    /// Smallest and largest disparity (u, v) over the specimen and its heights.
    pub disparity_px: DisparityRange,
    /// What will not work.
    pub warnings: Vec<Warning>,
    /// What would do better.
    pub suggestions: Vec<Suggestion>,
    /// The same set-up with one thing changed.
    pub variants: Vec<Variant>,
}

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// No set-up.
    #[error(transparent)]
    Optics(#[from] OpticsError),
    /// A request out of its limits.
    #[error("{field} is {value}, it must be {allowed}")]
    Request {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The middle of the reference plane is not seen.
    #[error("the middle of the reference plane is not seen: {0}")]
    Centre(#[from] TraceError),
    /// The middle is seen outside the half of the sensor that is meant for it.
    #[error(
        "the {view:?} view sees the middle of the reference plane at column {column_px:.0}, outside columns {:.0} to {:.0} of its half of the sensor: check principal point, pitch and distances",
        half_px.low, half_px.high
    )]
    OffSensor {
        /// The view.
        view: View,
        /// Where it is seen.
        column_px: f64,
        /// Where it should be.
        half_px: Extent,
    },
}

fn check(r: &Request) -> Result<(), PlanError> {
    let above = "a finite number above 0";
    let numbers = [
        ("sensor columns", r.sensor_px[0], r.sensor_px[0] >= 2.0, "at least 2"),
        ("sensor rows", r.sensor_px[1], r.sensor_px[1] >= 1.0, "at least 1"),
        ("sigma of u", r.sigma_px[0], r.sigma_px[0] > 0.0, above),
        ("sigma of v", r.sigma_px[1], r.sigma_px[1] > 0.0, above),
        ("lowest height", r.heights_mm[0], true, "finite"),
        ("highest height", r.heights_mm[1], r.heights_mm[1] >= r.heights_mm[0], "at least the lowest height"),
        ("bandwidth", r.bandwidth_mm, r.bandwidth_mm >= 0.0, "a finite number, at least 0"),
        ("drift", r.drift_mm, r.drift_mm >= 0.0, "a finite number, at least 0"),
        ("error of d", r.distance_errors_mm[0], r.distance_errors_mm[0] >= 0.0, "at least 0"),
        ("error of s", r.distance_errors_mm[1], r.distance_errors_mm[1] >= 0.0, "at least 0"),
        ("subset", r.subset_px, r.subset_px > 0.0, above),
        ("pupil", r.pupil_mm.unwrap_or(1.0), r.pupil_mm.is_none_or(|p| p > 0.0), above),
        (
            "specimen width",
            r.specimen_mm.map_or(1.0, |s| s[0]),
            r.specimen_mm.is_none_or(|s| s[0] > 0.0),
            above,
        ),
        (
            "specimen height",
            r.specimen_mm.map_or(1.0, |s| s[1]),
            r.specimen_mm.is_none_or(|s| s[1] > 0.0),
            above,
        ),
    ];
    for (field, value, fits, allowed) in numbers {
        if !(value.is_finite() && fits) {
            return Err(PlanError::Request { field, value, allowed });
        }
    }
    Ok(())
}

/// What `optics` will be able to measure.
///
/// # Errors
/// If the set-up is impossible, the request is, or the axis is not seen.
pub fn plan(optics: &Optics, request: &Request) -> Result<Plan, PlanError> {
    check(request)?;
    let mut plan = without_variants(optics, request)?;
    plan.variants = advice::variants(optics, request);
    Ok(plan)
}

fn without_variants(optics: &Optics, request: &Request) -> Result<Plan, PlanError> {
    let model = OpticalModel::new(optics)?;
    let paraxial = Paraxial::new(optics, request.sigma_px[0]);
    let layout = views::Layout { model: &model, request };
    let field_mm = layout.field()?;
    let specimen_mm = match request.specimen_mm {
        Some([w, h]) => Rectangle::centred(w, h),
        None => field_mm.scaled(0.9),
    };
    let columns_px = layout.columns(&specimen_mm, request.heights_mm);
    let free_px = [columns_px[1].low - columns_px[0].high, columns_px[2].low - columns_px[1].high];
    let free_between_views_px = columns_px[2].low - columns_px[0].high;
    let (pixel_mm, sigma) = sigma(&model, request, &specimen_mm)?;
    let light = Light::new(optics, request, &paraxial)?;
    let mut plan = Plan {
        angle_deg: View::BOTH.map(|v| optics.grating(v).angle_rad(optics.wavelength_mm).to_degrees()),
        pixel_mm,
        subset_mm: request.subset_px * pixel_mm[0],
        field_mm,
        specimen_mm,
        columns_px,
        free_px,
        free_between_views_px,
        widest_specimen_mm: layout.widest(&specimen_mm),
        footprints_mm: View::BOTH.map(|v| layout.footprint(v, &specimen_mm)),
        depth: Depth {
            seen_mm: layout.depth(&specimen_mm),
            sharp_mm: request.pupil_mm.map(|p| paraxial.sharp(optics, p)),
        },
        sigma,
        budget: budget::rows(optics, request, &paraxial),
        paraxial,
        light,
        disparity_px: layout.disparity(&specimen_mm),
        warnings: Vec::new(),
        suggestions: Vec::new(),
        variants: Vec::new(),
    };
    plan.warnings = advice::warnings(&layout, &plan);
    plan.suggestions = advice::suggestions(optics, request, &plan);
    Ok(plan)
}

/// Size of a pixel at the axis; standard deviations at the axis and the largest over the specimen,
/// decoded on the −1 view's grid: its pixel is exact, the match has the noise.
fn sigma(
    model: &OpticalModel,
    request: &Request,
    specimen: &Rectangle,
) -> Result<([f64; 2], Sigma), PlanError> {
    let pixels = pixel_covariance([0.0; 2], request.sigma_px);
    let at = |p: Vector3<f64>| -> Result<[f64; 3], TraceError> {
        let pair: PixelPair = model.see(p)?;
        let c = model.decode(Decoder::Ray, pair)?.covariance_mm2(&pixels);
        Ok([0, 1, 2].map(|i| c[(i, i)].sqrt()))
    };
    let centre_mm = at(Vector3::zeros())?;
    let (_, j) = model.project_with_jacobian(View::Minus, Vector3::zeros())?;
    let mut worst_mm = centre_mm;
    for [x, y] in specimen.grid(5) {
        for h in request.heights_mm {
            // points that a view does not see are in the warnings
            if let Ok(s) = at(Vector3::new(x, y, h)) {
                worst_mm = [0, 1, 2].map(|i| worst_mm[i].max(s[i]));
            }
        }
    }
    Ok(([1.0 / j[(0, 0)], 1.0 / j[(1, 1)]], Sigma { centre_mm, worst_mm }))
}
