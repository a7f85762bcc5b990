//! What will not work, what to change, and what a change would bring.

use serde::Serialize;

use super::views::{Extent, Layout};
use super::{Depth, Plan, Request, without_variants};
use crate::model::TraceError;
use crate::setup::{Optics, View};

/// Something that will not work.
#[derive(Clone, Debug, PartialEq, Serialize, thiserror::Error)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Warning {
    /// The first order does not exist for part of a view.
    #[error(
        "the first order does not propagate for pixel ({:.0}, {:.0}) of the {view:?} view: choose a coarser grating or less tilt",
        pixel_px[0], pixel_px[1]
    )]
    NoOrder {
        /// The view.
        view: View,
        /// A corner of its half of the sensor.
        pixel_px: [f64; 2],
    },
    /// The first-order views overlap each other.
    #[error("the two first-order views overlap by {overlap_px:.0} columns")]
    ViewsOverlap {
        /// Columns.
        overlap_px: f64,
    },
    /// A first-order view and the undiffracted light overlap.
    #[error("the {view:?} view and the zeroth order overlap by {overlap_px:.0} columns")]
    ZerothOverlaps {
        /// The view.
        view: View,
        /// Columns.
        overlap_px: f64,
    },
    /// Part of the specimen is not on the half of the sensor for the view.
    #[error(
        "the specimen takes up columns {:.0} to {:.0} in the {view:?} view, its half of the sensor has {:.0} to {:.0}",
        columns_px.low, columns_px.high, half_px.low, half_px.high
    )]
    OffSensor {
        /// The view.
        view: View,
        /// Columns of the specimen.
        columns_px: Extent,
        /// Columns of the half.
        half_px: Extent,
    },
    /// The specimen is higher or wider than the field at some height.
    #[error(
        "the whole specimen is seen from {:.2} to {:.2} mm only, its heights are {:.2} to {:.2} mm",
        seen_mm[0], seen_mm[1], heights_mm[0], heights_mm[1]
    )]
    Depth {
        /// Heights at which it is seen.
        seen_mm: [f64; 2],
        /// Heights asked for.
        heights_mm: [f64; 2],
    },
    /// Defocus.
    #[error(
        "the specimen is sharp from {:.2} to {:.2} mm only, its heights are {:.2} to {:.2} mm",
        sharp_mm[0], sharp_mm[1], heights_mm[0], heights_mm[1]
    )]
    Blurred {
        /// Heights at which it is sharp.
        sharp_mm: [f64; 2],
        /// Heights asked for.
        heights_mm: [f64; 2],
    },
    /// Bandwidth smears the views by more than a pixel.
    #[error("the bandwidth smears the views by {smear_px:.1} px along x, in opposite senses")]
    Smear {
        /// Pixels.
        smear_px: f64,
    },
}

/// Pixels of smear that still are harmless: a speckle is three to five wide.
const SMEAR_PX: f64 = 1.0;

pub(super) fn warnings(layout: &Layout<'_>, plan: &Plan) -> Vec<Warning> {
    let mut found = Vec::new();
    for (view, columns_px) in View::BOTH.into_iter().zip([plan.columns_px[0], plan.columns_px[2]]) {
        let (half_px, rows) = (layout.half(view), layout.rows());
        let corners = [half_px.low, half_px.high].map(|x| [rows.low, rows.high].map(|y| [x, y]));
        let lost = corners
            .into_iter()
            .flatten()
            .find(|p| matches!(layout.model.ray(view, *p), Err(TraceError::Diffract { .. })));
        if let Some(pixel_px) = lost {
            found.push(Warning::NoOrder { view, pixel_px });
        }
        if !(columns_px.low >= half_px.low && columns_px.high <= half_px.high) {
            found.push(Warning::OffSensor { view, columns_px, half_px });
        }
    }
    if !(plan.free_between_views_px >= 0.0) {
        found.push(Warning::ViewsOverlap { overlap_px: -plan.free_between_views_px });
    }
    for (view, free) in View::BOTH.into_iter().zip(plan.free_px) {
        if layout.request.zeroth_order && !(free >= 0.0) {
            found.push(Warning::ZerothOverlaps { view, overlap_px: -free });
        }
    }
    let heights_mm = layout.request.heights_mm;
    let outside = |[low, high]: [f64; 2]| heights_mm[0] < low || heights_mm[1] > high;
    if outside(plan.depth.seen_mm) {
        found.push(Warning::Depth { seen_mm: plan.depth.seen_mm, heights_mm });
    }
    if let Some(sharp_mm) = plan.depth.sharp_mm.filter(|s| outside(*s)) {
        found.push(Warning::Blurred { sharp_mm, heights_mm });
    }
    if plan.light.smear_px > SMEAR_PX {
        found.push(Warning::Smear { smear_px: plan.light.smear_px });
    }
    found
}

/// Something to change, with its number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, thiserror::Error)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Suggestion {
    /// A narrower filter.
    #[error("light of at most {:.2} nm bandwidth smears by 1 px", bandwidth_mm * 1e6)]
    Bandwidth {
        /// mm.
        bandwidth_mm: f64,
    },
    /// A steadier wavelength.
    #[error(
        "a wavelength steady to {:.3} nm keeps the drift of all heights below the noise of one, {:.1} µm",
        drift_mm * 1e6, sigma_h_mm * 1e3
    )]
    Wavelength {
        /// mm.
        drift_mm: f64,
        /// mm.
        sigma_h_mm: f64,
    },
    /// A narrower specimen.
    #[error("a specimen of at most {width_mm:.2} mm width has views that do not overlap")]
    NarrowerSpecimen {
        /// mm.
        width_mm: f64,
    },
    /// A greater distance between grating and specimen.
    #[error("grating to reference plane d = {d_mm:.1} mm moves the views apart")]
    LongerD {
        /// mm.
        d_mm: f64,
    },
    /// Size of the gratings.
    #[error(
        "the gratings must cover x = {:.1} to {:.1} and {:.1} to {:.1} mm, y = {:.1} to {:.1} mm, and the lens's pupil beside",
        minus_x_mm.low, minus_x_mm.high, plus_x_mm.low, plus_x_mm.high, y_mm.low, y_mm.high
    )]
    Gratings {
        /// In the path of the −1 view.
        minus_x_mm: Extent,
        /// In the path of the +1 view.
        plus_x_mm: Extent,
        /// Both.
        y_mm: Extent,
    },
    /// Distances that are not known well enough.
    #[error(
        "calibrate d and s (`daic calibrate`): at {height_mm:.2} mm their errors make {distances_um:.1} µm of the heights, the noise {noise_um:.1} µm"
    )]
    Calibrate {
        /// mm.
        height_mm: f64,
        /// µm.
        distances_um: f64,
        /// µm.
        noise_um: f64,
    },
    /// A smaller opening of the lens.
    #[error("an entrance pupil of {pupil_mm:.2} mm keeps all heights sharp")]
    SmallerPupil {
        /// mm.
        pupil_mm: f64,
    },
}

pub(super) fn suggestions(optics: &Optics, request: &Request, plan: &Plan) -> Vec<Suggestion> {
    let mut found = Vec::new();
    let light = &plan.light;
    if light.smear_px > SMEAR_PX {
        found.push(Suggestion::Bandwidth { bandwidth_mm: request.bandwidth_mm * SMEAR_PX / light.smear_px });
    }
    let sigma_h_mm = plan.sigma.centre_mm[2];
    if light.drift_h_mm > sigma_h_mm {
        let drift_mm = light.drift_mm * sigma_h_mm / light.drift_h_mm;
        found.push(Suggestion::Wavelength { drift_mm, sigma_h_mm });
    }
    let overlaps = plan
        .warnings
        .iter()
        .any(|w| matches!(w, Warning::ViewsOverlap { .. } | Warning::ZerothOverlaps { .. }));
    if overlaps {
        found.push(Suggestion::NarrowerSpecimen { width_mm: plan.widest_specimen_mm });
        // the views part by d tan θ each, the width stays: to first order in proportion
        let width = plan.specimen_mm.x.length();
        let d_mm = optics.grating_to_reference_mm * width / plan.widest_specimen_mm;
        if d_mm.is_finite() {
            found.push(Suggestion::LongerD { d_mm });
        }
    }
    let [minus, plus] = plan.footprints_mm;
    let y_mm = Extent { low: minus.y.low.min(plus.y.low), high: minus.y.high.max(plus.y.high) };
    if [minus.x, plus.x, y_mm].iter().all(|e| e.length().is_finite()) {
        found.push(Suggestion::Gratings { minus_x_mm: minus.x, plus_x_mm: plus.x, y_mm });
    }
    if let Some(row) = plan.budget.last() {
        let distances = row.from_d_mm.hypot(row.from_s_mm);
        let offset = light.offset_d_mm.hypot(light.offset_s_mm);
        let all = distances.hypot(offset);
        if all > row.from_disparity_mm {
            found.push(Suggestion::Calibrate {
                height_mm: row.height_mm,
                distances_um: all * 1e3,
                noise_um: row.from_disparity_mm * 1e3,
            });
        }
    }
    let blurred = plan.warnings.iter().any(|w| matches!(w, Warning::Blurred { .. }));
    if let Some(pupil) = request.pupil_mm.filter(|_| blurred) {
        let blur = request.heights_mm.map(|h| plan.paraxial.blur_px(optics, pupil, h));
        found.push(Suggestion::SmallerPupil { pupil_mm: pupil * Depth::BLUR_PX / blur[0].max(blur[1]) });
    }
    found
}

/// The same set-up with one thing changed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Variant {
    /// What is changed, and to what.
    pub change: String,
    /// σ_h on the axis, mm.
    pub sigma_h_mm: f64,
    /// Width and height of the field, mm.
    pub field_mm: [f64; 2],
    /// Smear by the bandwidth, px.
    pub smear_px: f64,
    /// Columns free between the orders (the zeroth, if there is one, counts); negative: overlap.
    pub free_px: f64,
}

/// Columns free between neighbouring orders.
fn free(plan: &Plan, request: &Request) -> f64 {
    if request.zeroth_order { plan.free_px[0].min(plan.free_px[1]) } else { plan.free_between_views_px }
}

type Change = Box<dyn Fn(&mut Optics)>;

/// What a finer grating, a longer d, a shorter s and a longer lens would bring; only those in which
/// both views see the axis on their half of the sensor.
pub(super) fn variants(optics: &Optics, request: &Request) -> Vec<Variant> {
    let (s, d) = (optics.pinhole_to_grating_mm, optics.grating_to_reference_mm);
    let lines = |by: f64| by / optics.minus.pitch_mm;
    let finer = |by: f64| -> Change {
        Box::new(move |o| {
            o.minus.pitch_mm /= by;
            o.plus.pitch_mm /= by;
        })
    };
    let longer = |by: f64| -> Change { Box::new(move |o| o.grating_to_reference_mm *= by) };
    let nearer = |by: f64| -> Change { Box::new(move |o| o.pinhole_to_grating_mm *= by) };
    let lens = |by: f64| -> Change { Box::new(move |o| o.camera.focal_px *= by) };
    let changes: [(String, Change); 8] = [
        ("as planned".to_owned(), Box::new(|_| {})),
        (format!("{:.0} lines/mm", lines(2.0)), finer(2.0)),
        (format!("{:.0} lines/mm", lines(4.0 / 3.0)), finer(4.0 / 3.0)),
        (format!("{:.0} lines/mm", lines(0.5)), finer(0.5)),
        (format!("d = {:.0} mm", 1.25 * d), longer(1.25)),
        (format!("d = {:.0} mm", 0.8 * d), longer(0.8)),
        (format!("s = {:.0} mm", 0.8 * s), nearer(0.8)),
        (format!("focal_px = {:.0}", 0.8 * optics.camera.focal_px), lens(0.8)),
    ];
    let mut found = Vec::new();
    for (change, apply) in changes {
        let mut o = *optics;
        apply(&mut o);
        // each with its own specimen, nine tenths of its field, unless one was asked for
        if let Ok(plan) = without_variants(&o, request) {
            found.push(Variant {
                change,
                sigma_h_mm: plan.sigma.centre_mm[2],
                field_mm: [plan.field_mm.x.length(), plan.field_mm.y.length()],
                smear_px: plan.light.smear_px,
                free_px: free(&plan, request),
            });
        }
    }
    found
}
