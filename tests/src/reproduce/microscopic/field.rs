//! From frames of the microscope to matched and tracked points.

use super::super::{ReproduceError, SUBSET};
use super::focus::Bank;
use super::scene::Scene;
use daic_correlate::{
    Guess, Image, Point, Points, Rectangle, Reference, Roi, Settings, Shape, Target, correlate,
};
use daic_optics::{PairModel, PixelPair, View};
use nalgebra::Vector3;

/// Largest displacement that is searched, px: 20 µm.
const REACH_PX: f64 = 40.0;

/// A pair that was followed into another frame.
#[derive(Clone, Copy, Debug)]
pub struct Tracked {
    /// The pair in the reference frame.
    pub before: PixelPair,
    /// The pair in the other frame.
    pub after: PixelPair,
    /// σ of the four increments, px.
    pub sigma_px: [f64; 4],
}

/// A reference frame with its matched views.
pub struct Matched {
    bank: Bank,
    settings: Settings,
    minus: Points,
    /// What was matched; an entry for every point of the grid.
    pub pairs: Vec<Option<PixelPair>>,
    /// σ of their disparity along x, px.
    pub sigma_px: Vec<Option<f64>>,
}

fn seen(p: &Point) -> Option<([f64; 2], [f64; 2])> {
    p.status.is_ok().then(|| ([p.x + p.u, p.y + p.v], [f64::from(p.sigma_u), f64::from(p.sigma_v)]))
}

impl Matched {
    /// Matches the views of `frame` over the specimen within ±`half_mm`, whose heights are within
    /// `height_mm`, at every `step` pixels. The grid stays half a subset inside.
    ///
    /// # Errors
    /// What the correlation refuses.
    pub fn new(
        scene: &Scene,
        frame: Image,
        (shape, step): (Shape, usize),
        half_mm: [f64; 2],
        height_mm: [f64; 2],
    ) -> Result<Self, ReproduceError> {
        let settings = Settings { subset: SUBSET, shape, ..Settings::default() };
        let mut corners = Vec::new();
        for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            for h in height_mm {
                corners.push(scene.microscope.see(Vector3::new(sx * half_mm[0], sy * half_mm[1], h))?);
            }
        }
        let over = |f: &dyn Fn(&PixelPair) -> f64| {
            let values = || corners.iter().map(f);
            (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max))
        };
        let margin = settings.radius() as f64;
        let inside = |(a, b): (f64, f64)| ((a + margin).ceil().max(0.0), (b - margin).floor());
        let (x, y) = (inside(over(&|c| c.minus_px[0])), inside(over(&|c| c.minus_px[1])));
        let rectangle = Rectangle {
            x: x.0 as usize,
            y: y.0 as usize,
            width: (x.1 - x.0).max(1.0) as usize,
            height: (y.1 - y.0).max(1.0) as usize,
        };
        let roi = Roi { rectangle: Some(rectangle), mask: None };
        let minus = Points::grid(frame.width(), frame.height(), SUBSET, step, &roi)?;
        let (u0, u1) = over(&|c| c.plus_px[0] - c.minus_px[0]);
        let guess = Guess::Search { u: (u0 - 5.0, u1 + 5.0), v: (-5.0, 5.0) };
        let target = Target::new(frame.clone(), settings.interpolation);
        let bank = Bank::new(&frame)?;
        let found = correlate(bank.sharp(), &target, &minus, &guess, &settings, &())?;
        let pairs = found
            .points
            .iter()
            .map(|p| {
                let (plus_px, _) = seen(p)?;
                Some(PixelPair { minus_px: [p.x, p.y], plus_px })
            })
            .collect();
        let sigma_px = found.points.iter().map(|p| seen(p).map(|(_, sigma)| sigma[0])).collect();
        Ok(Self { bank, settings, minus, pairs, sigma_px })
    }

    /// Follows the pairs into `frame`, first with the reference as it is, then with the reference in the
    /// frame's focus; the +1 points are correlated where they are, between pixels.
    ///
    /// # Errors
    /// What the correlation refuses.
    pub fn track(&self, frame: Image) -> Result<Vec<Tracked>, ReproduceError> {
        let target = Target::new(frame, self.settings.interpolation);
        let known: Vec<usize> = (0..self.pairs.len()).filter(|k| self.pairs[*k].is_some()).collect();
        let places = known.iter().filter_map(|k| self.pairs[*k]).map(|p| p.plus_px).collect();
        let plus = Points::scattered(places)?;
        let run = |reference: &Reference, points: &Points, guess: &Guess<'_>| {
            correlate(reference, &target, points, guess, &self.settings, &())
        };
        // the other view shows the same particles: it must stay out of reach
        let near = Guess::Search { u: (-REACH_PX, REACH_PX), v: (-REACH_PX, REACH_PX) };
        let first = [&self.minus, &plus].map(|points| run(self.bank.sharp(), points, &near));
        let [left, right] = first;
        let (left, right) = (left?, right?);
        let moves = |found: &[Point]| -> Vec<Option<[f64; 2]>> {
            found.iter().map(|p| p.status.is_ok().then_some([p.u, p.v])).collect()
        };
        let probes = |found: &[Point]| -> Vec<([f64; 2], [f64; 2])> {
            found.iter().filter(|p| p.status.is_ok()).map(|p| ([p.x, p.y], [p.u, p.v])).collect()
        };
        let (a, b) = (probes(&left.points), probes(&right.points));
        let focused = self.bank.focused(&target, [&a, &b], &self.settings)?;
        let left = run(&focused, &self.minus, &Guess::Given(&moves(&left.points)))?;
        let right = run(&focused, &plus, &Guess::Given(&moves(&right.points)))?;
        let tracked = known.iter().zip(&right.points).filter_map(|(k, right)| {
            let before = self.pairs[*k]?;
            let (minus_px, a) = seen(&left.points[*k])?;
            let (plus_px, b) = seen(right)?;
            Some(Tracked {
                before,
                after: PixelPair { minus_px, plus_px },
                sigma_px: [a[0], a[1], b[0], b[1]],
            })
        });
        Ok(tracked.collect())
    }
}

/// Pixels of a view at the middle of the field.
pub fn centre(scene: &Scene, view: View) -> Result<[f64; 2], ReproduceError> {
    Ok(scene.microscope.project_point(view, Vector3::zeros())?.0)
}
