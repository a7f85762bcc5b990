//! One frame: views matched, pairs decoded in several ways, heights compared with the truth.

use super::super::statistics::{Registration, rms};
use super::super::{ReproduceError, SUBSET};
use super::rig::{Rig, Shot};
use daic_correlate::{
    Guess, Points, Rectangle, Reference, Roi, Settings, Shape, Target, correlate, find_views,
};
use daic_hil_sim::scene::Scene;
use daic_hil_sim::scene::trace::View as SceneView;
use daic_optics::{Decoder, OpticalModel, PixelPair, View};
use nalgebra::Vector3;

/// A way from pixel pairs to points.
pub struct Way<'a> {
    /// Set-up with or without maps.
    pub model: &'a OpticalModel,
    /// The decoder.
    pub decoder: Decoder,
}

/// A matched point and where it truly is.
#[derive(Clone, Copy, Debug)]
pub struct Match {
    /// As measured.
    pub pair: PixelPair,
    /// The +1 pixel of what the −1 pixel sees, traced exactly; none where the +1 view does not see it.
    pub exact_plus_px: Option<[f64; 2]>,
}

/// Matched views of a frame.
pub struct Matched {
    /// Points that the correlation accepted.
    pub points: Vec<Match>,
    /// Points of the grid.
    pub grid: usize,
}

/// Pixels that the view's mask may be off by, and that subsets stay inside.
const EDGE_PX: usize = 12;
/// Both views show the same paint in the same light: undisturbed subsets reach 0.997, those on the cone's tip
/// 0.99. Beside the step with its edge along y a few subsets hold the wall and the strip that is hidden from the
/// +1 view, and no side of theirs can be proven: they reach 0.75 to 0.87 and were off by up to 0.4 px.
const MIN_ZNCC: f64 = 0.9;
/// A point that another view sees this much elsewhere is hidden from it, mm.
const HIDDEN_MM: f64 = 1e-3;

/// Matches the views of a frame, 59 × 59 pixels at every `rig.step`.
///
/// # Errors
/// What the correlation refuses.
pub fn matched(rig: &Rig, shot: &Shot, shape: Shape) -> Result<Matched, ReproduceError> {
    let settings = Settings { subset: SUBSET, shape, min_zncc: MIN_ZNCC, ..Settings::default() };
    let views = find_views(&shot.image)?;
    let b = views.minus.bounds;
    let inset = |start: usize| settings.radius() + if start == 0 { 0 } else { EDGE_PX };
    let (left, top) = (inset(b.x), inset(b.y));
    let far = settings.radius() + EDGE_PX;
    let rectangle = Rectangle {
        x: b.x + left,
        y: b.y + top,
        width: b.width.saturating_sub(left + far).max(1),
        height: b.height.saturating_sub(top + far).max(1),
    };
    let roi = Roi { rectangle: Some(rectangle), mask: Some(&views.minus.mask) };
    let points = Points::grid(shot.image.width(), shot.image.height(), SUBSET, rig.step, &roi)?;
    let nominal = OpticalModel::new(&rig.nominal())?;
    let [low, high] = shot.scene.surface().range();
    let range = nominal.disparity_range([b.x as f64, b.y as f64], [low - 1.0, high + 1.0])?;
    let guess = Guess::Search { u: (range.u_px[0] - 10.0, range.u_px[1] + 10.0), v: (-8.0, 8.0) };
    let target = Target::new(shot.image.clone(), settings.interpolation);
    let found = correlate(&Reference::new(shot.image.clone()), &target, &points, &guess, &settings, &())?;
    let truth = OpticalModel::new(&rig.truth)?;
    let mut points = Vec::new();
    for p in found.points.iter().filter(|p| p.status.is_ok()) {
        let minus_px = [p.x, p.y];
        let exact_plus_px = exact_plus(&truth, &shot.scene, minus_px)?;
        points.push(Match { pair: PixelPair { minus_px, plus_px: [p.x + p.u, p.y + p.v] }, exact_plus_px });
    }
    Ok(Matched { points, grid: found.points.len() })
}

fn exact_plus(
    truth: &OpticalModel,
    scene: &Scene,
    minus_px: [f64; 2],
) -> Result<Option<[f64; 2]>, ReproduceError> {
    let Some(p) = scene.object_point(SceneView::Minus, minus_px[0], minus_px[1], [0.0; 3]) else {
        return Ok(None);
    };
    let q = truth.project(View::Plus, Vector3::from(p))?;
    let Some(seen) = scene.object_point(SceneView::Plus, q[0], q[1], [0.0; 3]) else { return Ok(None) };
    let apart = (0..3).map(|i| (seen[i] - p[i]).powi(2)).sum::<f64>().sqrt();
    Ok((apart < HIDDEN_MM).then_some(q))
}

/// A decoded point and its error.
#[derive(Clone, Copy, Debug)]
pub struct Decoded {
    /// Its pixel in the −1 view.
    pub minus_px: [f64; 2],
    /// (x, y, h), mm.
    pub point_mm: [f64; 3],
    /// h minus the true height there, mm, without registration.
    pub error_mm: f64,
    /// The same after the registration.
    pub registered_mm: f64,
    /// Whether it is away from discontinuities.
    pub smooth: bool,
}

/// A surface decoded one way.
pub struct Surface {
    /// Every point that has a height and a truth.
    pub points: Vec<Decoded>,
}

impl Surface {
    /// RMS away from discontinuities, µm: registered, and as it stands.
    pub fn rms_um(&self) -> [f64; 2] {
        let smooth = || self.points.iter().filter(|p| p.smooth);
        [1e3 * rms(smooth().map(|p| p.registered_mm)), 1e3 * rms(smooth().map(|p| p.error_mm))]
    }
}

/// Says of a point (−1 pixel; x, y and h in mm) whether it is away from discontinuities.
pub type Smooth<'a> = dyn Fn([f64; 2], [f64; 3]) -> Result<bool, ReproduceError> + 'a;

/// Decodes pairs and compares with the scene; only points away from discontinuities register the surface.
///
/// # Errors
/// A pair that has no point; if hardly a point is left.
pub fn decode(
    way: &Way<'_>,
    scene: &Scene,
    pairs: &[PixelPair],
    smooth: &Smooth<'_>,
) -> Result<Surface, ReproduceError> {
    let height = |x: f64, y: f64| scene.surface().height(x, y).unwrap_or(f64::NAN);
    let mut points = Vec::with_capacity(pairs.len());
    for pair in pairs {
        let p = way.model.decode_point(way.decoder, *pair)?;
        let point_mm = [p.x, p.y, p.z];
        points.push(Decoded {
            minus_px: pair.minus_px,
            point_mm,
            error_mm: p.z - height(p.x, p.y),
            registered_mm: f64::NAN,
            smooth: smooth(pair.minus_px, point_mm)?,
        });
    }
    let basis: Vec<[f64; 3]> = points.iter().filter(|p| p.smooth).map(|p| p.point_mm).collect();
    if basis.len() < 50 {
        return Err(ReproduceError::Few {
            what: "decoded surface".to_owned(),
            found: basis.len(),
            needed: 50,
        });
    }
    let registration = Registration::of(&basis, &height);
    for p in &mut points {
        let [x, y, h] = registration.of_point(p.point_mm);
        p.registered_mm = h - height(x, y);
    }
    Ok(Surface { points })
}
