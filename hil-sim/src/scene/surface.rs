//! Where a straight line first meets the specimen, in the specimen's own coordinates (X, Y, h).

use crate::config::{SpecimenConfig, SurfaceConfig};
use crate::error::ConfigError;
use crate::scene::height_map::HeightMap;

/// A straight line in specimen coordinates: X right, Y down, h towards the camera.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// Any point in front of the specimen.
    pub origin: [f64; 3],
    /// Direction of the light's path backwards, that is from the grating to the specimen; h falls along it.
    pub direction: [f64; 3],
}

impl Line {
    /// The point where the line has height `h`.
    #[inline]
    pub fn at_height(&self, h: f64) -> [f64; 2] {
        let t = (h - self.origin[2]) / self.direction[2];
        [self.origin[0] + t * self.direction[0], self.origin[1] + t * self.direction[1]]
    }

    #[inline]
    fn at(&self, t: f64) -> [f64; 3] {
        [0, 1, 2].map(|k| self.origin[k] + t * self.direction[k])
    }
}

#[derive(Debug)]
enum Shape {
    Plane { height: f64, slope: [f64; 2] },
    Cylinder { radius: f64, apex: f64 },
    Cone { apex: f64, slope: f64 },
    Step { x: f64, low: f64, high: f64, across: [f64; 2] },
    Sphere { radius: f64, apex: f64 },
    Map(HeightMap),
}

/// Shape and extent of the specimen, ready for intersection.
#[derive(Debug)]
pub struct Surface {
    shape: Shape,
    floor: Option<f64>,
    half: [f64; 2],
    range: [f64; 2],
}

impl Surface {
    /// Prepares the surface; reads the height map if there is one.
    pub fn new(config: &SpecimenConfig) -> Result<Self, ConfigError> {
        let (shape, floor) = match &config.surface {
            SurfaceConfig::Plane { height_mm, slope_x, slope_y } => {
                (Shape::Plane { height: *height_mm, slope: [*slope_x, *slope_y] }, None)
            }
            SurfaceConfig::Cylinder { radius_mm, apex_mm, floor_mm } => {
                (Shape::Cylinder { radius: *radius_mm, apex: *apex_mm }, *floor_mm)
            }
            SurfaceConfig::Cone { apex_mm, slope, floor_mm } => {
                (Shape::Cone { apex: *apex_mm, slope: *slope }, *floor_mm)
            }
            SurfaceConfig::Step { x_mm, low_mm, high_mm, direction_rad } => {
                let across = [direction_rad.cos(), direction_rad.sin()];
                (Shape::Step { x: *x_mm, low: *low_mm, high: *high_mm, across }, None)
            }
            SurfaceConfig::Sphere { radius_mm, apex_mm, floor_mm } => {
                (Shape::Sphere { radius: *radius_mm, apex: *apex_mm }, *floor_mm)
            }
            SurfaceConfig::HeightMap { file, pixel_mm, black_mm, white_mm } => {
                (Shape::Map(HeightMap::read(file, *pixel_mm, *black_mm, *white_mm)?), None)
            }
        };
        let half = [config.half_width_mm, config.half_height_mm];
        let mut surface = Self { shape, floor, half, range: [0.0; 2] };
        surface.range = surface.height_range();
        Ok(surface)
    }

    /// Lowest and highest height that the surface can have within the specimen.
    pub fn range(&self) -> [f64; 2] {
        self.range
    }

    /// Height at the material point (`x`, `y`), or `None` where the shape has none.
    pub fn height(&self, x: f64, y: f64) -> Option<f64> {
        let h = match &self.shape {
            Shape::Plane { height, slope } => Some(height + slope[0] * x + slope[1] * y),
            Shape::Cylinder { radius, apex } => cap(*radius, x * x).map(|h| h + apex),
            Shape::Cone { apex, slope } => Some(apex - slope * x.hypot(y)),
            Shape::Step { x: wall, low, high, across } => {
                Some(if x * across[0] + y * across[1] < *wall { *low } else { *high })
            }
            Shape::Sphere { radius, apex } => cap(*radius, x * x + y * y).map(|h| h + apex),
            Shape::Map(map) => Some(map.height(x, y)),
        };
        match (h, self.floor) {
            (Some(h), Some(floor)) => Some(h.max(floor)),
            (h, floor) => h.or(floor),
        }
    }

    /// The first point of the specimen on the line, (X, Y, h), or `None` if the line misses it.
    #[inline]
    pub fn first_hit(&self, line: &Line) -> Option<[f64; 3]> {
        let shape = match &self.shape {
            Shape::Plane { height, slope } => {
                let [o, d] = [line.origin, line.direction];
                let gap = o[2] - height - slope[0] * o[0] - slope[1] * o[1];
                let t = gap / (slope[0] * d[0] + slope[1] * d[1] - d[2]);
                (t > 0.0).then(|| line.at(t))
            }
            Shape::Cylinder { radius, apex } => round(line, [1.0, 0.0, 1.0], apex - radius, *radius),
            Shape::Sphere { radius, apex } => round(line, [1.0; 3], apex - radius, *radius),
            Shape::Cone { apex, slope } => cone(line, *apex, *slope),
            Shape::Step { x, low, high, across } => step(line, *x, *low, *high, *across),
            Shape::Map(map) => map.first_hit(line),
        };
        let hit = match (shape, self.floor) {
            (Some(hit), Some(floor)) if hit[2] < floor => None,
            (hit, _) => hit,
        };
        let hit = hit.or_else(|| {
            self.floor.map(|floor| {
                let [x, y] = line.at_height(floor);
                [x, y, floor]
            })
        })?;
        (hit[0].abs() <= self.half[0] && hit[1].abs() <= self.half[1]).then_some(hit)
    }

    /// Whether the line may meet the specimen: false only if it certainly does not, even when it is
    /// moved sideways by up to `margin`.
    #[inline]
    pub fn may_hit(&self, line: &Line, margin: f64) -> bool {
        let (low, high) = (line.at_height(self.range[0]), line.at_height(self.range[1]));
        (0..2).all(|k| {
            let reach = self.half[k] + margin;
            low[k].min(high[k]) <= reach && low[k].max(high[k]) >= -reach
        })
    }

    fn height_range(&self) -> [f64; 2] {
        let [a, b] = self.half;
        let [low, high] = match &self.shape {
            Shape::Plane { height, slope } => {
                let reach = slope[0].abs() * a + slope[1].abs() * b;
                [height - reach, height + reach]
            }
            Shape::Cylinder { radius, apex } => [apex + cap(*radius, a * a).unwrap_or(-radius), *apex],
            Shape::Cone { apex, slope } => [apex - slope * a.hypot(b), *apex],
            Shape::Step { low, high, .. } => [low.min(*high), low.max(*high)],
            Shape::Sphere { radius, apex } => [apex + cap(*radius, a * a + b * b).unwrap_or(-radius), *apex],
            Shape::Map(map) => map.range(),
        };
        match self.floor {
            Some(floor) => [low.max(floor).min(floor), high.max(floor)],
            None => [low, high],
        }
    }
}

/// √(R² − ρ²) − R, without cancellation; `None` beyond the rim.
fn cap(radius: f64, rho2: f64) -> Option<f64> {
    let root2 = radius * radius - rho2;
    (root2 >= 0.0).then(|| -rho2 / (root2.sqrt() + radius))
}

/// First point on Σ wₖ (Pₖ − Cₖ)² = R² with C = (0, 0, `centre_h`), upper half only.
#[inline]
fn round(line: &Line, weight: [f64; 3], centre_h: f64, radius: f64) -> Option<[f64; 3]> {
    let d = line.direction;
    // From the foot where the line passes the centre's height plus R: keeps the numbers small.
    let [x, y] = line.at_height(centre_h + radius);
    let o = [x, y, radius];
    let a: f64 = (0..3).map(|k| weight[k] * d[k] * d[k]).sum();
    let b: f64 = (0..3).map(|k| weight[k] * d[k] * o[k]).sum();
    let c: f64 = weight[0] * x * x + weight[1] * y * y;
    let disc = b * b - a * c;
    if disc < 0.0 {
        return None;
    }
    // b < 0 for a line that falls towards the surface, so the nearer root is c / (−b + √disc).
    let t = c / (-b + disc.sqrt());
    let h = o[2] + t * d[2];
    (h >= 0.0).then(|| [o[0] + t * d[0], o[1] + t * d[1], centre_h + h])
}

#[inline]
fn cone(line: &Line, apex: f64, slope: f64) -> Option<[f64; 3]> {
    let d = line.direction;
    let [x, y] = line.at_height(apex);
    // With k = apex − h: k = k̇ t, ρ² slope² = k², and the sheet below the tip has k ≥ 0.
    let k = -d[2];
    let s2 = slope * slope;
    let a = s2 * (d[0] * d[0] + d[1] * d[1]) - k * k;
    let b = s2 * (x * d[0] + y * d[1]);
    let c = s2 * (x * x + y * y);
    let disc = b * b - a * c;
    if disc < 0.0 {
        return None;
    }
    let root = disc.sqrt();
    // Roots of a t² + 2 b t + c = 0 in the form without cancellation.
    let q = if b < 0.0 { root - b } else { -(root + b) };
    let (t1, t2) = (if a == 0.0 { f64::INFINITY } else { q / a }, if q == 0.0 { 0.0 } else { c / q });
    let t = match (t1 >= 0.0 && t1.is_finite(), t2 >= 0.0 && t2.is_finite()) {
        (true, true) => t1.min(t2),
        (true, false) => t1,
        (false, true) => t2,
        (false, false) => return None,
    };
    Some([x + t * d[0], y + t * d[1], apex - k * t])
}

#[inline]
fn step(line: &Line, wall: f64, low: f64, high: f64, across: [f64; 2]) -> Option<[f64; 3]> {
    let place = |x: f64, y: f64| x * across[0] + y * across[1];
    // Upper level first: on its own side the line ends there.
    let (upper, lower) = (low.max(high), low.min(high));
    let upper_is_right = high >= low;
    let [x, y] = line.at_height(upper);
    if (place(x, y) >= wall) == upper_is_right || upper == lower {
        return Some([x, y, upper]);
    }
    let [x, y] = line.at_height(lower);
    if (place(x, y) >= wall) != upper_is_right {
        return Some([x, y, lower]);
    }
    // It passes the wall in between.
    let [origin, direction] = [line.origin, line.direction];
    let t = (wall - place(origin[0], origin[1])) / place(direction[0], direction[1]);
    Some(line.at(t))
}
