//! Where the views lie on the sensor and on the gratings.

use nalgebra::Vector3;
use serde::Serialize;

use super::{PlanError, Request};
use crate::model::OpticalModel;
use crate::project::DisparityRange;
use crate::setup::View;

/// From low to high.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Extent {
    /// Lowest.
    pub low: f64,
    /// Highest.
    pub high: f64,
}

impl Extent {
    pub(super) const NONE: Self = Self { low: f64::INFINITY, high: f64::NEG_INFINITY };

    pub(super) fn grow(&mut self, value: f64) {
        self.low = self.low.min(value);
        self.high = self.high.max(value);
    }

    /// Its length.
    pub fn length(&self) -> f64 {
        self.high - self.low
    }

    fn holds(&self, value: f64) -> bool {
        self.low <= value && value <= self.high
    }
}

/// An upright rectangle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rectangle {
    /// Along x.
    pub x: Extent,
    /// Along y.
    pub y: Extent,
}

impl Rectangle {
    pub(super) fn centred(width: f64, height: f64) -> Self {
        let around = |w: f64| Extent { low: -0.5 * w, high: 0.5 * w };
        Self { x: around(width), y: around(height) }
    }

    /// Scaled about the axis (0, 0), which it holds.
    pub(super) fn scaled(&self, by: f64) -> Self {
        let scale = |e: Extent| Extent { low: e.low * by, high: e.high * by };
        Self { x: scale(self.x), y: scale(self.y) }
    }

    /// n × n points, the border included.
    pub(super) fn grid(&self, n: usize) -> impl Iterator<Item = [f64; 2]> + use<> {
        let Self { x, y } = *self;
        let at = move |e: Extent, i: usize| e.low + e.length() * i as f64 / (n - 1) as f64;
        (0..n).flat_map(move |i| (0..n).map(move |j| [at(x, i), at(y, j)]))
    }

    /// Points on the border: extremes of monotonic maps lie there.
    fn border(&self) -> impl Iterator<Item = [f64; 2]> + use<> {
        let Self { x, y } = *self;
        self.grid(9).filter(move |p| p[0] == x.low || p[0] == x.high || p[1] == y.low || p[1] == y.high)
    }
}

/// Largest `t` in 0..=1 with `holds(t)`, taken to hold up to there; 0 if it never does.
fn largest(holds: impl Fn(f64) -> bool) -> f64 {
    if holds(1.0) {
        return 1.0;
    }
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if holds(middle) { low = middle } else { high = middle }
    }
    low
}

pub(super) struct Layout<'a> {
    pub(super) model: &'a OpticalModel,
    pub(super) request: &'a Request,
}

impl Layout<'_> {
    /// Columns of the half of the sensor for a view.
    pub(super) fn half(&self, view: View) -> Extent {
        let width = self.request.sensor_px[0];
        match view {
            View::Minus => Extent { low: -0.5, high: 0.5 * width - 0.5 },
            View::Plus => Extent { low: 0.5 * width - 0.5, high: width - 0.5 },
        }
    }

    pub(super) fn rows(&self) -> Extent {
        Extent { low: -0.5, high: self.request.sensor_px[1] - 0.5 }
    }

    fn on_sensor(&self, view: View, [x, y]: [f64; 2], h: f64) -> bool {
        let seen = self.model.project(view, Vector3::new(x, y, h));
        seen.is_ok_and(|[column, row]| self.half(view).holds(column) && self.rows().holds(row))
    }

    fn seen(&self, r: &Rectangle, h: f64) -> bool {
        View::BOTH.iter().all(|v| r.border().all(|p| self.on_sensor(*v, p, h)))
    }

    pub(super) fn field(&self) -> Result<Rectangle, PlanError> {
        for view in View::BOTH {
            let [column_px, row] = self.model.project(view, Vector3::zeros())?;
            let half_px = self.half(view);
            if !(half_px.holds(column_px) && self.rows().holds(row)) {
                return Err(PlanError::OffSensor { view, column_px, half_px });
            }
        }
        // how far each side reaches along the axes of the object, then together at the corners
        let far = self.model.optics().grating_to_reference_mm;
        let reach = |direction: [f64; 2]| {
            far * largest(|t| {
                let p = direction.map(|d| d * far * t);
                View::BOTH.iter().all(|v| self.on_sensor(*v, p, 0.0))
            })
        };
        let outer = Rectangle {
            x: Extent { low: -reach([-1.0, 0.0]), high: reach([1.0, 0.0]) },
            y: Extent { low: -reach([0.0, -1.0]), high: reach([0.0, 1.0]) },
        };
        Ok(outer.scaled(largest(|t| self.seen(&outer.scaled(t), 0.0))))
    }

    /// Pixel of the undiffracted light; the substrate displaces it as in the paraxial limit.
    fn zeroth(&self, [x, y]: [f64; 2], h: f64) -> [f64; 2] {
        let o = self.model.optics();
        let g = &o.minus.substrate;
        let lift = g.thickness_mm * (1.0 - 1.0 / g.index);
        let z = o.pinhole_to_grating_mm + o.grating_to_reference_mm - h - lift;
        o.camera.pixel([x / z, y / z])
    }

    /// Columns of −1 view, zeroth order, +1 view.
    pub(super) fn columns(&self, r: &Rectangle, heights: [f64; 2]) -> [Extent; 3] {
        let mut columns = [Extent::NONE; 3];
        for h in heights {
            for p in r.border() {
                columns[1].grow(self.zeroth(p, h)[0]);
                for (view, slot) in [(View::Minus, 0), (View::Plus, 2)] {
                    if let Ok([column, _]) = self.model.project(view, Vector3::new(p[0], p[1], h)) {
                        columns[slot].grow(column);
                    }
                }
            }
        }
        columns
    }

    fn apart(&self, r: &Rectangle, heights: [f64; 2]) -> bool {
        let [minus, zero, plus] = self.columns(r, heights);
        let free = if self.request.zeroth_order {
            (zero.low - minus.high).min(plus.low - zero.high)
        } else {
            plus.low - minus.high
        };
        free >= 0.0
    }

    /// Widest rectangle of the specimen's height whose views do not overlap.
    pub(super) fn widest(&self, specimen: &Rectangle) -> f64 {
        let far = 2.0 * self.model.optics().grating_to_reference_mm;
        let h = specimen.y.length();
        far * largest(|t| {
            self.apart(
                &Rectangle { y: specimen.y, ..Rectangle::centred(far * t, h) },
                self.request.heights_mm,
            )
        })
    }

    /// Heights up and down to which the specimen stays visible and apart.
    pub(super) fn depth(&self, specimen: &Rectangle) -> [f64; 2] {
        let d = self.model.optics().grating_to_reference_mm;
        let fits = |h: f64| self.seen(specimen, h) && self.apart(specimen, [h, h]);
        if !fits(0.0) {
            return [0.0, 0.0];
        }
        [-3.0 * d * largest(|t| fits(-3.0 * d * t)), d * largest(|t| fits(d * t))]
    }

    pub(super) fn footprint(&self, view: View, specimen: &Rectangle) -> Rectangle {
        let mut r = Rectangle { x: Extent::NONE, y: Extent::NONE };
        for h in self.request.heights_mm {
            for [x, y] in specimen.border() {
                let seen = self.model.project(view, Vector3::new(x, y, h));
                if let Ok(ray) = seen.and_then(|pixel| self.model.ray(view, pixel)) {
                    r.x.grow(ray.origin_mm.x);
                    r.y.grow(ray.origin_mm.y);
                }
            }
        }
        r
    }

    pub(super) fn disparity(&self, specimen: &Rectangle) -> DisparityRange {
        let (mut u, mut v) = (Extent::NONE, Extent::NONE);
        let [low, high] = self.request.heights_mm;
        for h in [low, 0.5 * (low + high), high] {
            for [x, y] in specimen.grid(5) {
                let p = Vector3::new(x, y, h);
                let pair = View::BOTH.map(|view| self.model.project(view, p));
                if let [Ok(minus), Ok(plus)] = pair {
                    u.grow(plus[0] - minus[0]);
                    v.grow(plus[1] - minus[1]);
                }
            }
        }
        DisparityRange { u_px: [u.low, u.high], v_px: [v.low, v.high] }
    }
}
