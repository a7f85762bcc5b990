//! What turns pixel pairs into points, and how sure it is.

use daic_optics::bundle::Volume;
use daic_optics::{
    Decoder, Displacement, MapGrid, OpticalModel, ParameterCovariance, PixelPair, TraceError, UncertainPoint,
    View,
};
use nalgebra::{Matrix3, Matrix4, Vector4};
use std::sync::Arc;

/// Part of the shortest side of the calibrated volume by which a point may lie outside.
const MARGIN: f64 = 0.1;

/// What a distortion map's file says of the map itself.
#[derive(Debug, Clone, PartialEq)]
pub struct MapQuality {
    /// The view that it is for; all pixels if none.
    pub view: Option<View>,
    /// Nodes of the map.
    pub grid: MapGrid,
    /// Standard deviations of (e_x, e_y) at the nodes, row by row, pixels.
    pub sigma_px: Vec<[f64; 2]>,
    /// Whether the map was measured at a node.
    pub measured: Vec<bool>,
}

impl MapQuality {
    /// Variances (px²) between the nodes, and whether the nearest node was measured; nothing off the map.
    fn at(&self, pixel_px: [f64; 2]) -> Option<([f64; 2], bool)> {
        if !self.grid.contains(pixel_px) {
            return None;
        }
        let cell = |i: usize| {
            let at = (pixel_px[i] - self.grid.origin_px[i]) / self.grid.step_px[i];
            let first = at.floor().clamp(0.0, (self.grid.nodes[i] - 2) as f64);
            (first as usize, (at - first).clamp(0.0, 1.0))
        };
        let ((i, s), (j, t)) = (cell(0), cell(1));
        let node = |a: usize, b: usize| (j + b) * self.grid.nodes[0] + i + a;
        let corners =
            [(0, 0, (1.0 - s) * (1.0 - t)), (1, 0, s * (1.0 - t)), (0, 1, (1.0 - s) * t), (1, 1, s * t)];
        let mut sigma = [0.0; 2];
        for (a, b, w) in corners {
            for (sum, at_node) in sigma.iter_mut().zip(self.sigma_px[node(a, b)]) {
                *sum += w * at_node;
            }
        }
        let nearest = node(usize::from(s > 0.5), usize::from(t > 0.5));
        Some((sigma.map(|s| s * s), self.measured[nearest]))
    }
}

/// Optics, the decoder, and what is known of their uncertainty.
#[derive(Debug, Clone)]
pub struct Instrument {
    /// The optics.
    pub model: OpticalModel,
    /// How pixel pairs become points.
    pub decoder: Decoder,
    /// Covariance of the optics' parameters; none where nobody stated one.
    pub calibration: Option<ParameterCovariance>,
    /// Uncertainty and reach of the distortion maps in the model.
    pub maps: Arc<[MapQuality]>,
    /// Where the optics were calibrated; everywhere if none.
    pub volume: Option<Volume>,
}

fn inside(volume: &Volume, point_mm: [f64; 3]) -> bool {
    let side = (0..3).map(|i| volume.to_mm[i] - volume.from_mm[i]).fold(f64::MAX, f64::min);
    volume.contains(point_mm.into(), MARGIN * side)
}

impl Instrument {
    /// Optics about whose uncertainty nothing is known.
    pub fn new(model: OpticalModel, decoder: Decoder) -> Self {
        Self { model, decoder, calibration: None, maps: Arc::default(), volume: None }
    }

    /// Whether anything is stated about the calibration's uncertainty.
    pub fn states_uncertainty(&self) -> bool {
        self.calibration.is_some() || !self.maps.is_empty()
    }

    fn of(&self, view: View) -> impl Iterator<Item = &MapQuality> {
        self.maps.iter().filter(move |m| m.view.is_none_or(|own| own == view))
    }

    /// Whether both pixels lie where the distortion was measured and the point where the optics were calibrated.
    pub fn covers(&self, pair: PixelPair, point_mm: [f64; 3]) -> bool {
        let measured = |view: View| self.of(view).all(|m| m.at(pair.pixel(view)).is_some_and(|(_, m)| m));
        View::BOTH.into_iter().all(measured) && self.volume.is_none_or(|v| inside(&v, point_mm))
    }

    /// Variances (px²) of the maps at (x₋, y₋, x₊, y₊).
    fn map_variances_px2(&self, pair: PixelPair) -> Vector4<f64> {
        let mut all = Vector4::zeros();
        for (k, view) in View::BOTH.into_iter().enumerate() {
            for (variance, _) in self.of(view).filter_map(|m| m.at(pair.pixel(view))) {
                all[2 * k] += variance[0];
                all[2 * k + 1] += variance[1];
            }
        }
        all
    }

    /// The point of a pair, with what the pixels' noise does to it and what calibration and maps do.
    ///
    /// # Errors
    /// As [`OpticalModel::decode`].
    pub fn decode(&self, pair: PixelPair, pixels_px2: &Matrix4<f64>) -> Result<UncertainPoint, TraceError> {
        let none = ParameterCovariance::none();
        let calibration = self.calibration.as_ref().unwrap_or(&none);
        let mut point = self.model.decode_with_covariance(self.decoder, pair, pixels_px2, calibration)?;
        if !self.maps.is_empty() {
            let maps = Matrix4::from_diagonal(&self.map_variances_px2(pair));
            point.common_mm2 += point.decoded.covariance_mm2(&maps);
            point.gap_common_mm2 += point.decoded.gap_variance_mm2(&maps);
        }
        Ok(point)
    }

    /// Displacement of a material point, and its covariance (mm²) from calibration and maps.
    ///
    /// # Errors
    /// As [`OpticalModel::displacement`].
    pub fn displacement(
        &self,
        reference: PixelPair,
        deformed: PixelPair,
        reference_px2: &Matrix4<f64>,
        tracking_px2: &Matrix4<f64>,
    ) -> Result<(Displacement, Matrix3<f64>), TraceError> {
        let (model, decoder) = (&self.model, self.decoder);
        let found = model.displacement(decoder, reference, deformed, reference_px2, tracking_px2)?;
        let mut common = Matrix3::zeros();
        if let Some(calibration) = self.calibration.as_ref().filter(|c| !c.parameters().is_empty()) {
            // both points move with the calibration's error; what counts is by how much differently
            let before = model.parameter_jacobian(decoder, reference)?;
            let after = model.parameter_jacobian(decoder, deformed)?;
            let by = after - before;
            common += calibration.between(&by, &by);
        }
        if !self.maps.is_empty() {
            common += self.maps_between(&found, reference, deformed);
        }
        Ok((found, common))
    }

    /// What the maps' errors do to a displacement: an error of a map is the same within a cell and another
    /// one a cell further.
    fn maps_between(&self, found: &Displacement, reference: PixelPair, deformed: PixelPair) -> Matrix3<f64> {
        let sigma = [reference, deformed].map(|pair| self.map_variances_px2(pair).map(f64::sqrt));
        let mut sum = Matrix3::zeros();
        for (k, view) in View::BOTH.into_iter().enumerate() {
            let (from, to) = (reference.pixel(view), deformed.pixel(view));
            let away = (to[0] - from[0]).hypot(to[1] - from[1]);
            let cell =
                self.of(view).map(|m| m.grid.step_px[0].min(m.grid.step_px[1])).fold(f64::MAX, f64::min);
            let alike = (1.0 - away / cell).max(0.0);
            for c in [2 * k, 2 * k + 1] {
                let before = found.reference.jacobian.column(c) * sigma[0][c];
                let after = found.deformed.jacobian.column(c) * sigma[1][c];
                let mixed = before * after.transpose();
                sum += before * before.transpose() + after * after.transpose();
                sum -= (mixed + mixed.transpose()) * alike;
            }
        }
        sum
    }
}
