//! One interface to every model that turns a pixel pair into a point and back.

use nalgebra::{Matrix2x3, Matrix4, Vector3};

use crate::decode::{Decoded, Decoder, Displacement, PixelPair};
use crate::model::{OpticalModel, TraceError};
use crate::setup::View;

/// A calibrated instrument with two first-order views: pixel pair in, point and Jacobian out; point
/// in, pixels out. Lengths in millimetres, h towards the camera, pixels as everywhere in this crate.
pub trait PairModel {
    /// Point seen by a pixel pair, with ∂(x, y, h)/∂(x₋, y₋, x₊, y₊).
    ///
    /// # Errors
    /// If an input is not finite or no point is seen by this pair.
    fn decode_pair(&self, pair: PixelPair) -> Result<Decoded, TraceError>;

    /// Pixel at which `view` sees a point, and its derivatives (2×3, px/mm) with respect to it.
    ///
    /// # Errors
    /// If the view does not see the point.
    fn project_point(
        &self,
        view: View,
        point_mm: Vector3<f64>,
    ) -> Result<([f64; 2], Matrix2x3<f64>), TraceError>;

    /// Both pixels of a point.
    ///
    /// # Errors
    /// As [`PairModel::project_point`].
    fn see(&self, point_mm: Vector3<f64>) -> Result<PixelPair, TraceError> {
        let pixel = |view| self.project_point(view, point_mm).map(|(pixel, _)| pixel);
        Ok(PixelPair { minus_px: pixel(View::Minus)?, plus_px: pixel(View::Plus)? })
    }

    /// Displacement of a material point tracked in both views, the +1 pixel of either state being
    /// the match of its −1 pixel. Covariances as in [`OpticalModel::displacement`].
    ///
    /// # Errors
    /// As [`PairModel::decode_pair`].
    fn track(
        &self,
        reference: PixelPair,
        deformed: PixelPair,
        reference_px2: &Matrix4<f64>,
        tracking_px2: &Matrix4<f64>,
    ) -> Result<Displacement, TraceError> {
        let reference = self.decode_pair(reference)?;
        let deformed = self.decode_pair(deformed)?;
        Ok(Displacement::between(reference, deformed, reference_px2, tracking_px2))
    }
}

/// Decodes with [`Decoder::Ray`].
impl PairModel for OpticalModel {
    fn decode_pair(&self, pair: PixelPair) -> Result<Decoded, TraceError> {
        self.decode(Decoder::Ray, pair)
    }

    fn project_point(
        &self,
        view: View,
        point_mm: Vector3<f64>,
    ) -> Result<([f64; 2], Matrix2x3<f64>), TraceError> {
        self.project_with_jacobian(view, point_mm)
    }
}
