//! What should be looked at before a map is used.

use daic_dataset::GreyImage;
use daic_optics::distortion::{DistortionCalibration, DistortionWarning, Ideal};
use daic_optics::{Optics, View};
use std::path::{Path, PathBuf};

/// Something to be looked at.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Warning {
    /// Grey levels at the end of the scale.
    #[error("{:.1} % of the pixels of {} are saturated: expose less, clipped lines shift where blur is uneven", 100.0 * share, path.display())]
    Saturated {
        /// The image.
        path: PathBuf,
        /// Share of its pixels.
        share: f64,
    },
    /// The scale is not the one that the optics and the target's pitch give.
    #[error(
        "the line distance along {axis} comes out as {found_mm:.5} mm, the target is said to have {stated_mm:.5} mm ({:+.2} %): pitch, distances or F are wrong; the map does not depend on them",
        100.0 * (found_mm / stated_mm - 1.0)
    )]
    Scale {
        /// `x` or `y`.
        axis: &'static str,
        /// As the optics have it.
        found_mm: f64,
        /// As stated.
        stated_mm: f64,
    },
    /// See [`DistortionWarning::PartlyCovered`].
    #[error("the target covers {:.0} % of the image: there is no map elsewhere", 100.0 * share)]
    PartlyCovered {
        /// Share of the image within reach of the map.
        share: f64,
    },
    /// See [`DistortionWarning::PitchesDiffer`].
    #[error(
        "the lines crossed by y are {:.2} % {} than those crossed by x: not one target, not one distance, or pixels that are not square; e holds no trace of it",
        100.0 * (ratio - 1.0).abs(),
        if *ratio > 1.0 { "farther apart" } else { "closer" }
    )]
    PitchesDiffer {
        /// Ratio of the distances.
        ratio: f64,
    },
    /// See [`DistortionWarning::PartsLeftOut`].
    #[error(
        "parts of the target ({pixels} nodes) are cut off from the rest and were left out: their whole lines cannot be counted"
    )]
    PartsLeftOut {
        /// Nodes.
        pixels: usize,
    },
    /// A map through the grating without the optics.
    #[error(
        "no --optics given: this map is counted from a pinhole and goes with the decoders `linear` and `closed`, not with `ray`"
    )]
    NotForRays,
}

impl From<DistortionWarning> for Warning {
    fn from(w: DistortionWarning) -> Self {
        match w {
            DistortionWarning::PartlyCovered { share } => Self::PartlyCovered { share },
            DistortionWarning::PitchesDiffer { ratio } => Self::PitchesDiffer { ratio },
            DistortionWarning::PartsLeftOut { pixels } => Self::PartsLeftOut { pixels },
        }
    }
}

/// Part of an image's pixels at the end of the scale that passes without a warning.
const SATURATED: f64 = 0.005;
/// Part by which the target's scale may differ from the stated one without a warning.
const SCALE: f64 = 0.005;

/// Too many pixels at the highest level, if that is the end of a scale of 8 to 16 bits.
pub(super) fn saturated(whole: &GreyImage, part: &GreyImage, path: &Path) -> Option<Warning> {
    let top = whole.data.iter().copied().max().unwrap_or(0);
    let full = u32::from(top) + 1;
    if top < 255 || !full.is_power_of_two() {
        return None;
    }
    let share = part.data.iter().filter(|g| **g == top).count() as f64 / part.data.len() as f64;
    (share > SATURATED).then(|| Warning::Saturated { path: path.to_owned(), share })
}

/// Whether the target's line distance is the stated one.
pub(super) fn scale(
    found: &DistortionCalibration,
    ideal: &Ideal,
    optics: &Optics,
    view: Option<View>,
    stated_mm: f64,
) -> Vec<Warning> {
    let factor = match (ideal, view) {
        (Ideal::Grating { .. }, _) => 1.0,
        (Ideal::Camera(c), None) => {
            (optics.pinhole_to_grating_mm + optics.grating_to_reference_mm) / c.focal_px
        }
        // A pinhole has no scale that a view through the grating could be compared with.
        (Ideal::Camera(_), Some(_)) => return Vec::new(),
    };
    let wrong = |axis: &'static str, pitch: f64| {
        let found_mm = pitch * factor;
        ((found_mm / stated_mm - 1.0).abs() > SCALE).then_some(Warning::Scale { axis, found_mm, stated_mm })
    };
    [wrong("x", found.pitch[0]), wrong("y", found.pitch[1])].into_iter().flatten().collect()
}
