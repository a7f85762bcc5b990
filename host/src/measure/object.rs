//! Results resampled to object coordinates.
//!
//! Neighbouring points of the −1 view's grid span triangles on the surface; a regular grid of (x, y) takes its
//! values inside them by linear interpolation. Outside the triangles there is nothing: no extrapolation.

use super::Grid;
use crate::error::Error;
use daic_dataset::{FloatMap, MapAxes};

/// Most nodes of the regular grid.
const MOST_NODES: f64 = 4e6;
/// A triangle with a side longer than this many times the usual distance of points spans a step or a gap.
const LONGEST: f64 = 3.0;

/// Where a node of the regular grid lies among the points.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    /// Nodes of the −1 view's grid.
    corners: [usize; 3],
    /// Their shares, together 1.
    weights: [f64; 3],
}

/// A regular grid in object coordinates, ready to take values from points.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectGrid {
    /// (x, y) of the first node, millimetres: multiples of the step.
    pub origin_mm: [f64; 2],
    /// Distance of nodes, millimetres.
    pub step_mm: f64,
    /// Nodes in a row.
    pub columns: usize,
    /// Rows of nodes.
    pub rows: usize,
    places: Vec<Option<Place>>,
    /// Nodes in a row of the −1 view's grid.
    stride: usize,
    /// Points standing at nodes of the −1 view's grid.
    points: Vec<Option<usize>>,
    /// Over how many steps neighbours share their noise.
    overlap: f64,
}

impl ObjectGrid {
    /// A grid over the points of `grid` whose (x, y) `at` gives, `step_mm` apart; without `step_mm` as far as
    /// the points are, rounded to two digits. Errors of points less than `overlap` steps apart are correlated
    /// (see [`super::Settings::overlap`]).
    ///
    /// # Errors
    /// [`Error::ObjectGrid`] for a step with which there would be no grid or too large a one.
    pub fn new(
        grid: &Grid,
        at: impl Fn(usize) -> Option<[f64; 2]>,
        step_mm: Option<f64>,
        overlap: f64,
    ) -> Result<Self, Error> {
        let place: Vec<Option<[f64; 2]>> = grid.nodes.iter().map(|n| n.and_then(&at)).collect();
        let usual =
            usual_distance(grid, &place).ok_or(Error::ObjectGrid { step_mm: f64::NAN, nodes: 0.0 })?;
        let step = step_mm.unwrap_or_else(|| two_digits(usual));
        let range = |i: usize| {
            place.iter().flatten().fold([f64::MAX, f64::MIN], |[a, b], p| [a.min(p[i]), b.max(p[i])])
        };
        let ends = [range(0), range(1)].map(|[a, b]| [(a / step).ceil(), (b / step).floor()]);
        let [columns, rows] = ends.map(|[a, b]| b - a + 1.0);
        let nodes = columns * rows;
        if !(step > 0.0 && columns >= 1.0 && rows >= 1.0 && nodes <= MOST_NODES) {
            return Err(Error::ObjectGrid { step_mm: step, nodes });
        }
        let mut made = Self {
            origin_mm: ends.map(|[a, _]| a * step),
            step_mm: step,
            columns: columns as usize,
            rows: rows as usize,
            places: vec![None; nodes as usize],
            stride: grid.columns,
            points: grid.nodes.clone(),
            overlap,
        };
        let first = ends.map(|[a, _]| a);
        for j in 1..grid.rows {
            for i in 1..grid.columns {
                let node = |a: usize, b: usize| (j - 1 + b) * grid.columns + i - 1 + a;
                let cell = [node(0, 0), node(1, 0), node(1, 1), node(0, 1)];
                for corners in triangles(cell.map(|n| place[n].is_some())) {
                    let corners = corners.map(|c| cell[c]);
                    if let [Some(a), Some(b), Some(c)] = corners.map(|n| place[n]) {
                        made.fill(corners, [a, b, c], first, LONGEST * usual);
                    }
                }
            }
        }
        Ok(made)
    }

    fn fill(&mut self, corners: [usize; 3], [a, b, c]: [[f64; 2]; 3], first: [f64; 2], longest: f64) {
        let side = |p: [f64; 2], q: [f64; 2]| (q[0] - p[0]).hypot(q[1] - p[1]);
        let cross = |p: [f64; 2], q: [f64; 2], r: [f64; 2]| {
            (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1])
        };
        let area = cross(a, b, c);
        // turned over: seen from behind, where the surface is steeper than the line of sight
        let seen = area > 1e-9 * longest * longest;
        if !seen || side(a, b).max(side(b, c)).max(side(c, a)) > longest {
            return;
        }
        let span = |i: usize, size: usize| {
            let (low, high) = (a[i].min(b[i]).min(c[i]), a[i].max(b[i]).max(c[i]));
            let from = (low / self.step_mm - first[i]).ceil().max(0.0) as usize;
            let to = (high / self.step_mm - first[i]).floor().min(size as f64 - 1.0);
            (from, to)
        };
        let ((x0, x1), (y0, y1)) = (span(0, self.columns), span(1, self.rows));
        for row in (y0..).take_while(|r| *r as f64 <= y1) {
            for column in (x0..).take_while(|c| *c as f64 <= x1) {
                let p = [(first[0] + column as f64) * self.step_mm, (first[1] + row as f64) * self.step_mm];
                let weights = [cross(p, b, c) / area, cross(a, p, c) / area, cross(a, b, p) / area];
                let place = &mut self.places[row * self.columns + column];
                // a node on a common side belongs to the first of both; rounding must not lose it to neither
                if place.is_none() && weights.iter().all(|w| *w >= -1e-9) {
                    *place = Some(Place { corners, weights });
                }
            }
        }
    }

    /// (x, y) of a node, mm.
    pub fn position_mm(&self, node: usize) -> [f64; 2] {
        let (i, j) = (node % self.columns, node / self.columns);
        [self.origin_mm[0] + i as f64 * self.step_mm, self.origin_mm[1] + j as f64 * self.step_mm]
    }

    /// Whether a node lies on the surface.
    pub fn is_on_surface(&self, node: usize) -> bool {
        self.places.get(node).is_some_and(Option::is_some)
    }

    fn spread(&self, of: impl Fn(&Place, [usize; 3]) -> f64) -> Vec<f64> {
        let one = |place: &Option<Place>| {
            let place = place.as_ref()?;
            let [a, b, c] = place.corners.map(|n| self.points[n]);
            Some(of(place, [a?, b?, c?]))
        };
        self.places.iter().map(|p| one(p).unwrap_or(f64::NAN)).collect()
    }

    /// Values at the nodes, row by row, from those of the points; NaN off the surface.
    pub fn values(&self, of: impl Fn(usize) -> f64) -> Vec<f64> {
        self.spread(|place, points| (0..3).map(|i| place.weights[i] * of(points[i])).sum())
    }

    /// Standard deviations of interpolated values from those of the points, whose errors are correlated as far
    /// as their subsets overlap.
    pub fn sigmas(&self, of: impl Fn(usize) -> f64) -> Vec<f64> {
        let near = |d: usize| if self.overlap > 0.0 { (1.0 - d as f64 / self.overlap).max(0.0) } else { 0.0 };
        self.spread(|place, points| {
            let s: [f64; 3] = std::array::from_fn(|i| place.weights[i] * of(points[i]));
            let mut variance = 0.0;
            for (i, si) in s.iter().enumerate() {
                for (k, sk) in s.iter().enumerate() {
                    let (p, q) = (place.corners[i], place.corners[k]);
                    let (dx, dy) = (
                        (p % self.stride).abs_diff(q % self.stride),
                        (p / self.stride).abs_diff(q / self.stride),
                    );
                    variance += si * sk * if i == k { 1.0 } else { near(dx) * near(dy) };
                }
            }
            variance.max(0.0).sqrt()
        })
    }

    /// Values as a map with axes in millimetres.
    pub fn map(&self, name: &str, unit: &str, data: Vec<f64>) -> FloatMap {
        FloatMap {
            name: name.to_owned(),
            unit: unit.to_owned(),
            width: self.columns as u32,
            height: self.rows as u32,
            data,
            axes: MapAxes {
                x0: self.origin_mm[0],
                dx: self.step_mm,
                y0: self.origin_mm[1],
                dy: self.step_mm,
                unit: "mm".to_owned(),
            },
        }
    }
}

/// Triangles of a cell with the corners 0 to 3 around it, as far as these are there.
fn triangles(there: [bool; 4]) -> Vec<[usize; 3]> {
    match there {
        [true, true, true, true] => vec![[0, 1, 2], [0, 2, 3]],
        [false, true, true, true] => vec![[1, 2, 3]],
        [true, false, true, true] => vec![[0, 2, 3]],
        [true, true, false, true] => vec![[0, 1, 3]],
        [true, true, true, false] => vec![[0, 1, 2]],
        _ => Vec::new(),
    }
}

/// Median distance of neighbours along rows and columns.
fn usual_distance(grid: &Grid, place: &[Option<[f64; 2]>]) -> Option<f64> {
    let mut all = Vec::new();
    for n in 0..place.len() {
        let right = ((n + 1) % grid.columns != 0).then_some(n + 1);
        for other in right.into_iter().chain(Some(n + grid.columns)) {
            if let (Some(p), Some(Some(q))) = (place[n], place.get(other)) {
                all.push((q[0] - p[0]).hypot(q[1] - p[1]));
            }
        }
    }
    let middle = all.len() / 2;
    let found = (!all.is_empty()).then(|| *all.select_nth_unstable_by(middle, f64::total_cmp).1)?;
    (found > 0.0).then_some(found)
}

fn two_digits(value: f64) -> f64 {
    let exponent = value.log10().floor() as i32 - 1;
    let unit = 10f64.powi(exponent.abs());
    // dividing by a power of ten gives the number nearest to the decimal one
    if exponent < 0 { (value * unit).round() / unit } else { (value / unit).round() * unit }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 6 × 5 points, sheared and stretched: x = 0.3 i + 0.02 j, y = 0.25 j − 0.01 i.
    fn grid() -> (Grid, Vec<[f64; 2]>) {
        let nodes = (0..30).map(Some).collect();
        let grid = Grid { x0: 0, y0: 0, step: 5, columns: 6, rows: 5, nodes };
        let at = (0..30).map(|k| (f64::from(k % 6), f64::from(k / 6)));
        (grid, at.map(|(i, j)| [0.3 * i + 0.02 * j, 0.25 * j - 0.01 * i]).collect())
    }

    #[test]
    fn planes_are_reproduced_and_nothing_is_extrapolated() {
        let (mut grid, at) = grid();
        grid.nodes[14] = None;
        let made = ObjectGrid::new(&grid, |k| Some(at[k]), Some(0.05), 0.0).unwrap();
        let plane = |[x, y]: [f64; 2]| 0.4 - 0.7 * x + 1.9 * y;
        let values = made.values(|k| plane(at[k]));
        let (mut inside, mut outside) = (0, 0);
        for (n, value) in values.iter().enumerate() {
            let [x, y] = made.position_mm(n);
            // grid indices of the place
            let det = 0.3 * 0.25 + 0.02 * 0.01;
            let (i, j) = ((0.25 * x - 0.02 * y) / det, (0.3 * y + 0.01 * x) / det);
            let hole = (i - 2.0).abs() + (j - 2.0).abs() < 1.0 - 1e-6;
            let off = !(0.0..=5.0).contains(&i) || !(0.0..=4.0).contains(&j);
            if value.is_finite() {
                inside += 1;
                assert!((value - plane([x, y])).abs() < 1e-12);
                assert!(!hole && i > -1e-6 && j > -1e-6 && i < 5.0 + 1e-6 && j < 4.0 + 1e-6, "{i} {j}");
            } else {
                outside += 1;
                // without (2, 2) its four cells keep the triangle that does not need it
                assert!(off || (i - 2.0).abs() < 1.0 && (j - 2.0).abs() < 1.0, "{i} {j}");
            }
        }
        assert!(inside > 400 && outside > 30, "{inside} {outside}");
    }

    #[test]
    fn sigmas_of_independent_and_of_shared_errors() {
        let (grid, at) = grid();
        let of = |overlap: f64| {
            let made = ObjectGrid::new(&grid, |k| Some(at[k]), Some(0.05), overlap).unwrap();
            (made.sigmas(|_| 2.0), made.values(|_| 1.0))
        };
        let ((alone, one), (shared, _)) = (of(0.0), of(1e12));
        for (n, one) in one.iter().enumerate().filter(|(_, v)| v.is_finite()) {
            // weights between a corner and the middle of a triangle
            assert!((one - 1.0).abs() < 1e-12);
            assert!((2.0 / 3f64.sqrt() - 1e-9..=2.0 + 1e-9).contains(&alone[n]));
            assert!((shared[n] - 2.0).abs() < 1e-9);
        }
    }

    #[test]
    fn steps_of_two_digits() {
        for (from, to) in
            [(0.11749, 0.12), (0.0934, 0.093), (1.26, 1.3), (0.00999, 0.01), (26.7, 27.0), (134.0, 130.0)]
        {
            assert!((two_digits(from) - to).abs() < 1e-12, "{from} {}", two_digits(from));
        }
    }

    #[test]
    fn steps_without_a_grid_are_refused() {
        let (grid, at) = grid();
        for step in [1e-9, -1.0, f64::NAN, 50.0] {
            let made = ObjectGrid::new(&grid, |k| Some([at[k][0] + 0.1, at[k][1] + 0.1]), Some(step), 0.0);
            assert!(matches!(made, Err(Error::ObjectGrid { .. })), "{step}");
        }
        let none = ObjectGrid::new(&grid, |_| None, None, 0.0);
        assert!(matches!(none, Err(Error::ObjectGrid { .. })));
    }
}
