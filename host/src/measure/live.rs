//! Frame after frame to height maps, in memory that is taken once.

use super::matching::match_of;
use super::{Grid, Instrument, Match, Profile, Rectangle, Reference, Settings, profile};
use crate::error::Error;
use crate::progress::Progress;
use daic_correlate::{Guess, Image, Points, Reference as Subsets, Roi, ShapeParameters, Target, Workspace};
use daic_dataset::{GreyImage, Lattice};
use daic_optics::{Decoder, OpticalModel};

/// Pixels around the views that are kept, so that the matched view may move.
const MARGIN: usize = 64;

/// Matches the two views of every frame and decodes the surface. The views are found in the first
/// frame; only their surroundings are looked at afterwards, and each frame starts from the last.
pub struct Live {
    instrument: Instrument,
    settings: Settings,
    /// Size of the frames.
    frame: (usize, usize),
    /// What is looked at around the −1 view, and where the same rectangle lies around the +1 view.
    minus: Rectangle,
    plus: (usize, usize),
    points: Points,
    grid: Grid,
    reference: Subsets,
    target: Target,
    workspace: Workspace,
    last: Vec<Option<ShapeParameters>>,
    matches: Vec<Match>,
}

/// The part of a rectangle `at..at + len`, widened by the margin, that stays in `0..size` both where it
/// is and displaced by `shift`.
fn common(at: usize, len: usize, size: usize, shift: i64) -> (usize, usize) {
    let (at, end) = (at as i64, (at + len) as i64);
    let (margin, size) = (MARGIN as i64, size as i64);
    let first = (at - margin).max(0).max(-shift);
    let last = (end + margin).min(size).min(size - shift);
    (first as usize, (last - first).max(0) as usize)
}

impl Live {
    /// Finds and matches the views of a first frame.
    ///
    /// # Errors
    /// As [`Reference::new`]; [`Error::NothingMeasured`] where no point was matched; [`Error::LiveMosaic`] for a
    /// channel of a mosaic sensor.
    pub fn new(
        frame: &GreyImage,
        model: &OpticalModel,
        decoder: Decoder,
        settings: &Settings,
        progress: &dyn Progress,
    ) -> Result<Self, Error> {
        if settings.lattice != Lattice::ALL {
            return Err(Error::LiveMosaic);
        }
        let first = Reference::new(frame, model, settings, progress)?;
        let instrument = Instrument::new(model.clone(), decoder);
        profile(&first.grid, &first.matches, &instrument).with_points()?;
        let mut shifts: Vec<[f64; 2]> = first
            .matches
            .iter()
            .filter(|m| m.status.is_ok())
            .map(|m| [0, 1].map(|c| m.pair.plus_px[c] - m.pair.minus_px[c]))
            .collect();
        let middle = shifts.len() / 2;
        let [du, dv] = [0, 1].map(|c| {
            shifts.sort_by(|a, b| a[c].total_cmp(&b[c]));
            shifts[middle][c].round() as i64
        });
        let (width, height) = (frame.width as usize, frame.height as usize);
        let (x, w) = common(first.minus.x, first.minus.width, width, du);
        let (y, h) = common(first.minus.y, first.minus.height, height, dv);
        let plus = ((x as i64 + du) as usize, (y as i64 + dv) as usize);
        let minus = Rectangle { x, y, width: w, height: h };
        let inside = first.minus_mask.pixels();
        let rows = (y..y + h).flat_map(|row| inside[row * width + x..row * width + x + w].iter().copied());
        let mask = daic_correlate::Mask::new(w, h, rows.collect())?;
        let grid = &first.grid;
        // the nodes of the first frame's grid, seen from the rectangle
        let rectangle = Rectangle {
            x: grid.x0 - x,
            y: grid.y0 - y,
            width: (grid.columns - 1) * grid.step + 1,
            height: (grid.rows - 1) * grid.step + 1,
        };
        let roi = Roi { rectangle: Some(rectangle), mask: Some(&mask) };
        let points = Points::grid(w, h, settings.dic.subset, settings.step, &roi)?;
        let empty = || Image::from_u8(1, 1, &[0]);
        Ok(Self {
            instrument,
            settings: settings.clone(),
            frame: (width, height),
            minus,
            plus,
            grid: super::matching::grid_of(&points).moved(x, y),
            last: vec![None; points.len()],
            matches: Vec::with_capacity(points.len()),
            points,
            reference: Subsets::new(empty()?),
            target: Target::new(empty()?, settings.dic.interpolation),
            workspace: Workspace::new(),
        })
    }

    /// The points matched in every frame.
    pub fn points(&self) -> usize {
        self.points.len()
    }

    /// Surface of a frame of `width` × `height` pixels of 8 or 16 bits.
    ///
    /// # Errors
    /// If the frame has another size than the first one.
    pub fn frame<T: Copy + Into<f32> + Sync>(
        &mut self,
        width: usize,
        height: usize,
        grey: &[T],
    ) -> Result<Profile, Error> {
        if (width, height) != self.frame || grey.len() != width * height {
            return Err(Error::FrameSize { found: (width, height), expected: self.frame });
        }
        let r = self.minus;
        let from = |x: usize, y: usize| &grey[y * width + x..];
        let Self { reference, target, plus, .. } = self;
        let (a, b) = rayon::join(
            || reference.assign(r.width, r.height, width, from(r.x, r.y)),
            || target.assign(r.width, r.height, width, from(plus.0, plus.1)),
        );
        a?;
        b?;
        let guess =
            if self.last.iter().any(Option::is_some) { Guess::Shapes(&self.last) } else { Guess::default() };
        let found = self.workspace.correlate(
            &self.reference,
            &self.target,
            &self.points,
            &guess,
            &self.settings.dic,
            &(),
        )?;
        let shift = [self.plus.0 as f64 - r.x as f64, self.plus.1 as f64 - r.y as f64];
        self.matches.clear();
        for (p, last) in found.points.iter().zip(&mut self.last) {
            *last = p.status.is_ok().then_some(p.shape);
            let mut m = match_of(p, Lattice::ALL);
            for c in 0..2 {
                let at = [r.x, r.y][c] as f64;
                m.pair.minus_px[c] += at;
                m.pair.plus_px[c] += at + shift[c];
            }
            self.matches.push(m);
        }
        Ok(profile(&self.grid, &self.matches, &self.instrument))
    }
}
