//! Finding the two views, matching one with the other, following both into another frame.

use super::{Grid, PointStatus};
use crate::error::Error;
use crate::progress::Progress;
use daic_correlate::{
    Correlation, Guess, Image, Observer, Point, Points, Reference as Subsets, Roi, Stage, Target, Views,
    find_views,
};
use daic_dataset::{GreyImage, Lattice};
use daic_optics::{OpticalModel, PixelPair};

pub use daic_correlate::Rectangle;

/// How frames are matched.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Subset, shape function, interpolation and acceptance.
    pub dic: daic_correlate::Settings,
    /// Distance of points in pixels.
    pub step: usize,
    /// Heights between which the surface is searched, millimetres.
    pub height_mm: [f64; 2],
    /// Where the centres of subsets may lie in the −1 view, sensor pixels; `None` takes the view found.
    pub roi: Option<Rectangle>,
    /// Pixels that are used. Subsets and steps count these, positions are always those of the sensor.
    pub lattice: Lattice,
}

impl Default for Settings {
    /// Subsets large enough for a second-order shape function at little noise: curved surfaces are
    /// matched without the bias L²/24·u'' of a first-order one.
    fn default() -> Self {
        Self {
            dic: daic_correlate::Settings {
                subset: 59,
                shape: daic_correlate::Shape::Quadratic,
                ..daic_correlate::Settings::default()
            },
            step: 5,
            height_mm: [-12.0, 12.0],
            roi: None,
            lattice: Lattice::ALL,
        }
    }
}

impl Settings {
    /// Overlapping subsets see the same pixels: how many points of a grid have one independent measurement
    /// between them.
    ///
    /// A first-order subset averages over its whole area, so neighbours closer than its side share their noise:
    /// (subset/step)² of them. The estimate of a second-order one rests on its middle: its kernel's noise is
    /// 1 + 5/4 + 5/4 = 3.5 times that of the mean over the square (the constant beside x² and y²), and shared
    /// by so many times fewer points.
    pub fn points_per_measurement(&self) -> f64 {
        points_per_measurement(self.dic.subset as f64 / self.step as f64, self.dic.shape)
    }

    /// Over how many points along either axis neighbours share their noise.
    pub fn overlap(&self) -> f64 {
        self.points_per_measurement().sqrt()
    }
}

/// [`Settings::points_per_measurement`] for subsets `ratio` times as wide as the distance of points.
pub fn points_per_measurement(ratio: f64, shape: daic_correlate::Shape) -> f64 {
    let narrower = match shape {
        daic_correlate::Shape::Quadratic => 3.5,
        _ => 1.0,
    };
    (ratio * ratio / narrower).max(1.0)
}

/// Beyond the v that the optics expect, this much is searched: gratings rotated by 10 mrad.
const V_MARGIN_PX: f64 = 10.0;
/// Beyond the u that the heights allow: distances that are 1 % wrong.
const U_MARGIN: f64 = 0.01;

/// A point seen in both views of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Where; the +1 pixel is NaN where the match failed.
    pub pair: PixelPair,
    /// Standard deviations (x, y) of the +1 pixel relative to the −1 pixel, pixels.
    pub sigma_px: [f64; 2],
    /// Whether the match holds.
    pub status: PointStatus,
}

/// A matched point in another frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Where the −1 view sees it.
    pub minus_px: [f64; 2],
    /// Where the +1 view sees it.
    pub plus_px: [f64; 2],
    /// Standard deviations of its move in the −1 view, pixels.
    pub sigma_minus_px: [f64; 2],
    /// Standard deviations of its move in the +1 view, pixels.
    pub sigma_plus_px: [f64; 2],
    /// Whether both moves hold.
    pub status: PointStatus,
}

/// All matched points in another frame, in their order.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracks {
    /// One entry per point of the reference.
    pub points: Vec<Track>,
}

/// A frame whose views are found and matched.
pub struct Reference {
    subsets: Subsets,
    points: Points,
    settings: Settings,
    /// The −1 view found.
    pub minus: Rectangle,
    /// Its pixels.
    pub(super) minus_mask: daic_correlate::Mask,
    /// The +1 view found.
    pub plus: Rectangle,
    /// Where the points stand.
    pub grid: Grid,
    /// The points, in the order of the grid.
    pub matches: Vec<Match>,
}

/// Hands the correlation's progress on under a name.
struct Named<'a>(&'static str, &'a dyn Progress);

impl Observer for Named<'_> {
    fn stage(&self, stage: Stage) {
        if stage == Stage::Init {
            self.1.stage(self.0, 0);
        }
    }
    fn points(&self, done: usize, total: usize) {
        if done == 0 {
            self.1.stage(self.0, total as u64);
        }
        self.1.advance(done as u64);
    }
}

/// The pixels of the settings' lattice, as the correlation wants them.
fn lattice_image(frame: &GreyImage, lattice: Lattice) -> Result<Image, Error> {
    if lattice == Lattice::ALL { image_of(frame) } else { image_of(&lattice.of(frame)) }
}

/// A rectangle of the lattice in pixels of the sensor.
fn on_sensor(r: Rectangle, lattice: Lattice) -> Rectangle {
    let (pitch, [x, y]) = (lattice.pitch as usize, lattice.origin.map(|o| o as usize));
    Rectangle { x: pitch * r.x + x, y: pitch * r.y + y, width: pitch * r.width, height: pitch * r.height }
}

/// The pixels of the lattice in a rectangle of the sensor.
fn in_lattice(r: Rectangle, lattice: Lattice) -> Rectangle {
    let pitch = lattice.pitch as usize;
    let along = |at: usize, length: usize, origin: u32| {
        let first = |edge: usize| edge.saturating_sub(origin as usize).div_ceil(pitch);
        (first(at), first(at + length) - first(at))
    };
    let (x, width) = along(r.x, r.width, lattice.origin[0]);
    let (y, height) = along(r.y, r.height, lattice.origin[1]);
    Rectangle { x, y, width, height }
}

/// Grey levels as the correlation wants them.
///
/// # Errors
/// If the image has no pixels or is too large.
pub fn image_of(frame: &GreyImage) -> Result<Image, Error> {
    Ok(Image::from_u16(frame.width as usize, frame.height as usize, &frame.data)?)
}

pub(super) fn displaced(point: &Point) -> [f64; 2] {
    [point.x + point.u, point.y + point.v]
}

fn sigma(point: &Point, lattice: Lattice) -> [f64; 2] {
    [point.sigma_u, point.sigma_v].map(|s| f64::from(s) * f64::from(lattice.pitch))
}

pub(super) fn grid_of(points: &Points) -> Grid {
    let Some(grid) = points.as_grid() else {
        return Grid::none();
    };
    let nodes = (0..grid.rows).flat_map(|j| (0..grid.columns).map(move |i| (i, j)));
    Grid {
        x0: grid.x0,
        y0: grid.y0,
        step: grid.step,
        columns: grid.columns,
        rows: grid.rows,
        nodes: nodes.map(|(i, j)| grid.point(i, j)).collect(),
    }
}

impl Reference {
    /// Finds the two views of `frame` and matches them along the diffraction direction.
    ///
    /// # Errors
    /// If there are not two views, a setting cannot be used, or no subset fits.
    pub fn new(
        frame: &GreyImage,
        model: &OpticalModel,
        settings: &Settings,
        progress: &dyn Progress,
    ) -> Result<Self, Error> {
        let lattice = settings.lattice;
        Self::matched(frame, settings, progress, |views| {
            disparity(model, &on_sensor(views.minus.bounds, lattice), settings.height_mm)
        })
    }

    /// The same without any optics: displacements are searched up to `margin_px` (sensor pixels) from the one
    /// that lays the outlines of the two views upon each other.
    ///
    /// # Errors
    /// As [`Reference::new`].
    pub fn by_outlines(
        frame: &GreyImage,
        margin_px: f64,
        settings: &Settings,
        progress: &dyn Progress,
    ) -> Result<Self, Error> {
        Self::matched(frame, settings, progress, |views| {
            let [a, b] = [&views.minus.bounds, &views.plus.bounds].map(|r| on_sensor(*r, settings.lattice));
            let middle = |at: usize, length: usize| at as f64 + 0.5 * length as f64;
            let u = middle(b.x, b.width) - middle(a.x, a.width);
            let v = middle(b.y, b.height) - middle(a.y, a.height);
            Ok(([u - margin_px, u + margin_px], [v - margin_px, v + margin_px]))
        })
    }

    /// `search` gives the displacements (u, v) to be searched between the views, sensor pixels.
    fn matched(
        frame: &GreyImage,
        settings: &Settings,
        progress: &dyn Progress,
        search: impl FnOnce(&Views) -> Result<([f64; 2], [f64; 2]), Error>,
    ) -> Result<Self, Error> {
        let lattice = settings.lattice;
        let image = lattice_image(frame, lattice)?;
        settings.dic.validate_for(image.width(), image.height())?;
        progress.stage("finding the two views", 0);
        let found = find_views(&image)?;
        let rectangle = settings
            .roi
            .map(|roi| in_lattice(roi, lattice))
            .or_else(|| centres(&found.minus.bounds, settings.dic.radius()));
        let roi = Roi { rectangle, mask: Some(&found.minus.mask) };
        let points = Points::grid(image.width(), image.height(), settings.dic.subset, settings.step, &roi)?;
        let pitch = f64::from(lattice.pitch);
        let (u, v) = search(&found)?;
        let guess = Guess::Search { u: (u[0] / pitch, u[1] / pitch), v: (v[0] / pitch, v[1] / pitch) };
        let target = Target::new(image.clone(), settings.dic.interpolation);
        let subsets = Subsets::new(image);
        let matched = daic_correlate::correlate(
            &subsets,
            &target,
            &points,
            &guess,
            &settings.dic,
            &Named("matching the two views", progress),
        )?;
        let matches = matched.points.iter().map(|point| match_of(point, lattice)).collect();
        let mut grid = grid_of(&points);
        [grid.x0, grid.y0] = [(grid.x0, 0), (grid.y0, 1)]
            .map(|(at, axis)| at * lattice.pitch as usize + lattice.origin[axis] as usize);
        grid.step *= lattice.pitch as usize;
        Ok(Self {
            subsets,
            grid,
            points,
            settings: settings.clone(),
            minus: on_sensor(found.minus.bounds, lattice),
            minus_mask: found.minus.mask,
            plus: on_sensor(found.plus.bounds, lattice),
            matches,
        })
    }

    /// Follows the matched points of both views into `frame`.
    ///
    /// The +1 points lie between pixels; they are correlated where they are, not interpolated from a
    /// grid.
    ///
    /// # Errors
    /// If the frame has another size.
    pub fn track(&self, frame: &GreyImage, progress: &dyn Progress) -> Result<Tracks, Error> {
        let lattice = self.settings.lattice;
        let target = Target::new(lattice_image(frame, lattice)?, self.settings.dic.interpolation);
        let run = |points: &Points, name| -> Result<Correlation, Error> {
            let observer = Named(name, progress);
            Ok(daic_correlate::correlate(
                &self.subsets,
                &target,
                points,
                &Guess::Auto,
                &self.settings.dic,
                &observer,
            )?)
        };
        let minus = run(&self.points, "tracking in the −1 view")?;
        let matched: Vec<usize> =
            (0..self.matches.len()).filter(|&k| self.matches[k].status.is_ok()).collect();
        let positions = matched.iter().map(|&k| lattice.from_sensor(self.matches[k].pair.plus_px)).collect();
        let plus = run(&Points::scattered(positions)?, "tracking in the +1 view")?;

        let mut points: Vec<Track> = self
            .matches
            .iter()
            .zip(&minus.points)
            .map(|(m, p)| Track {
                minus_px: lattice.to_sensor(displaced(p)),
                plus_px: [f64::NAN; 2],
                sigma_minus_px: sigma(p, lattice),
                sigma_plus_px: [f64::NAN; 2],
                status: if !m.status.is_ok() {
                    m.status
                } else if p.status.is_ok() {
                    PointStatus::Ok
                } else {
                    PointStatus::TrackMinus(p.status.name())
                },
            })
            .collect();
        for (&k, p) in matched.iter().zip(&plus.points) {
            let track = &mut points[k];
            track.plus_px = lattice.to_sensor(displaced(p));
            track.sigma_plus_px = sigma(p, lattice);
            if track.status.is_ok() && !p.status.is_ok() {
                track.status = PointStatus::TrackPlus(p.status.name());
            }
        }
        Ok(Tracks { points })
    }
}

/// Edges of a view are found to about this many pixels; subsets stay as far inside.
const VIEW_EDGE_PX: usize = 12;

/// Where the centres of subsets can lie that are wholly inside `view`; `None` where there is no room. Where the
/// sensor cuts the view there is no edge to stay away from.
fn centres(view: &Rectangle, radius: usize) -> Option<Rectangle> {
    let inset = |start: usize| radius + if start == 0 { 0 } else { VIEW_EDGE_PX };
    let (left, top) = (inset(view.x), inset(view.y));
    let width = view.width.checked_sub(left + radius + VIEW_EDGE_PX)?;
    let height = view.height.checked_sub(top + radius + VIEW_EDGE_PX)?;
    (width > 0 && height > 0).then_some(Rectangle { x: view.x + left, y: view.y + top, width, height })
}

/// A point of the lattice's image in pixels of the sensor.
pub(super) fn match_of(point: &Point, lattice: Lattice) -> Match {
    let ok = point.status.is_ok();
    Match {
        pair: PixelPair {
            minus_px: lattice.to_sensor([point.x, point.y]),
            plus_px: if ok { lattice.to_sensor(displaced(point)) } else { [f64::NAN; 2] },
        },
        sigma_px: sigma(point, lattice),
        status: if ok { PointStatus::Ok } else { PointStatus::Match(point.status.name()) },
    }
}

/// Displacements (u, v) to be searched from the −1 to the +1 view: what the heights allow over the whole view.
fn disparity(
    model: &OpticalModel,
    view: &Rectangle,
    height_mm: [f64; 2],
) -> Result<([f64; 2], [f64; 2]), Error> {
    // distortion is small against the margins; and maps end where they were measured, the search may go beyond
    let model = OpticalModel::new(model.optics())?;
    let (left, top) = (view.x as f64, view.y as f64);
    let (right, bottom) = (left + view.width as f64, top + view.height as f64);
    let (mut u, mut v) = ((f64::INFINITY, f64::NEG_INFINITY), (f64::INFINITY, f64::NEG_INFINITY));
    for pixel in [[left, top], [right, top], [left, bottom], [right, bottom]] {
        let range = model.disparity_range(pixel, height_mm)?;
        u = (u.0.min(range.u_px[0]), u.1.max(range.u_px[1]));
        v = (v.0.min(range.v_px[0]), v.1.max(range.v_px[1]));
    }
    let margin = U_MARGIN * u.0.abs().max(u.1.abs());
    Ok(([u.0 - margin, u.1 + margin], [v.0 - V_MARGIN_PX, v.1 + V_MARGIN_PX]))
}
