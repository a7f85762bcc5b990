//! A series of images of one material: each frame starts from the last, the reference is replaced
//! where that helps, and displacements always count from the first frame.

mod track;

use crate::correlate::{CorrelateError, Correlation, Guess, Observer, Timing, Workspace};
use crate::image::Image;
use crate::point::{Point, ShapeParameters};
use crate::points::{Points, PointsError};
use crate::prepared::{Reference, Target};
use crate::settings::{Settings, SettingsError};
use serde::{Deserialize, Serialize};
use thiserror::Error;
use track::Track;

/// When the reference image is replaced.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Update {
    /// Never: every frame is correlated with the first. No error accumulates; points that fail in
    /// one frame may come back in the next.
    #[default]
    Fixed,
    /// By every frame: for changes too large or surfaces too altered to be recognised across the
    /// series. A frame in which fewer than half of the points were found that its forerunner had
    /// is measured, but does not become the reference.
    Incremental,
    /// By the last good frame, as soon as a frame is no good; that frame is then done again. A frame
    /// is no good if its number of `ok` points, or their median ZNCC, falls below a fraction of the
    /// best against the present reference.
    Automatic {
        /// Fraction of the number of `ok` points, 0…1.
        min_points: f64,
        /// Fraction of the median ZNCC, 0…1.
        min_zncc: f64,
    },
}

impl Update {
    /// [`Update::Automatic`] with the limits that suit most series: nine tenths of each.
    pub const AUTOMATIC: Update = Update::Automatic { min_points: 0.9, min_zncc: 0.9 };
}

/// Part of the reference's points that must be found in a frame for it to become a reference.
const MIN_KEPT: f64 = 0.5;
/// The same part of all points, where nothing is known yet: more than chance gives.
const MIN_SHARE: f64 = 0.02;

/// Why a sequence could not begin or go on.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SequenceError {
    /// A correlation.
    #[error(transparent)]
    Correlate(#[from] CorrelateError),
    /// Points that moved beyond all limits.
    #[error(transparent)]
    Points(#[from] PointsError),
    /// A limit of [`Update::Automatic`] is not a fraction.
    #[error("{name} = {value} must be a fraction, 0 to 1")]
    Limit {
        /// Which.
        name: &'static str,
        /// Value given.
        value: f64,
    },
    /// A stored state does not belong to these points.
    #[error("the stored state is of {found} points, the sequence has {points}")]
    StateCount {
        /// Points of the state.
        found: usize,
        /// Points of the sequence.
        points: usize,
    },
    /// A stored state holds what no run leaves.
    #[error("the stored state is damaged at point {index}")]
    StateDamaged {
        /// The point.
        index: usize,
    },
    /// The images of a stored state were not all given.
    #[error("the stored state needs the images of frames {reference} and {candidate}")]
    StateImages {
        /// The reference.
        reference: u32,
        /// The frame that may become the reference.
        candidate: u32,
    },
}

impl From<SettingsError> for SequenceError {
    fn from(error: SettingsError) -> Self {
        CorrelateError::from(error).into()
    }
}

/// All that a sequence hands from frame to frame, but for the images. Serialised and given to
/// [`Sequence::resume`] with exact numbers, the rest of the sequence comes out the same bit for bit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SequenceState {
    frame: u32,
    reference: u32,
    candidate: u32,
    /// Points in the reference and in the candidate; empty: the first frame.
    base: Vec<Track>,
    next: Vec<Track>,
    /// From the reference to the last good frame.
    starts: Vec<Option<ShapeParameters>>,
    best_count: u64,
    best_zncc: f32,
}

impl SequenceState {
    /// Number of the last frame treated; the first image of the sequence is 0.
    pub fn frame(&self) -> u32 {
        self.frame
    }

    /// Number of the frame that is the reference.
    pub fn reference(&self) -> u32 {
        self.reference
    }

    /// Number of the frame that would replace the reference; the reference itself if there is none.
    pub fn candidate(&self) -> u32 {
        self.candidate
    }
}

/// One frame of a sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceFrame {
    /// Number of the frame; the first image is 0.
    pub frame: u32,
    /// Number of the frame with which it was correlated.
    pub reference: u32,
    /// Results in the order of the points of the first frame, displacements counted from there
    /// (Lagrangian). `shape` is composed as well; `zncc`, `iterations` and `solver` are those of the
    /// correlation with the reference. Variances are the sums over the references: an upper bound,
    /// because successive steps share an image (see `docs/correlation.md`).
    pub points: Vec<Point>,
    /// For every point the number of the frame with which it was correlated last: the reference, or
    /// the one in which it was seen last before it was lost.
    pub references: Vec<u32>,
    /// Wall times, of both attempts where the reference was replaced.
    pub timing: Timing,
}

impl SequenceFrame {
    /// Number of points that are `ok`.
    pub fn converged(&self) -> usize {
        self.points.iter().filter(|p| p.status.is_ok()).count()
    }
}

/// Points to be found in the present reference, where it is not the first frame.
struct Moved {
    points: Points,
    /// Their numbers in the first frame.
    index: Vec<usize>,
}

/// A series of images. Its planes are allocated once and used again for every frame.
///
/// Memory: reference and deformed image with their planes as in [`crate::correlate`], one more image for
/// [`Update::Incremental`] and [`Update::Automatic`].
pub struct Sequence {
    settings: Settings,
    update: Update,
    points: Points,
    reference: Reference,
    target: Option<Target>,
    workspace: Workspace,
    /// Image of the candidate.
    spare: Option<Image>,
    moved: Option<Moved>,
    state: SequenceState,
}

/// What correlating with the present reference gave.
struct Step {
    found: Correlation,
    count: u64,
    zncc: f32,
}

impl Step {
    fn new(found: Correlation) -> Self {
        let mut zncc: Vec<f32> = found.points.iter().filter(|p| p.status.is_ok()).map(|p| p.zncc).collect();
        let count = zncc.len() as u64;
        let half = zncc.len() / 2;
        let zncc = if zncc.is_empty() { 0.0 } else { *zncc.select_nth_unstable_by(half, f32::total_cmp).1 };
        Self { found, count, zncc }
    }
}

impl Sequence {
    /// Begins with the first image.
    ///
    /// # Errors
    /// Settings or limits that cannot be used.
    pub fn new(
        first: Image,
        points: Points,
        settings: Settings,
        update: Update,
    ) -> Result<Self, SequenceError> {
        settings.validate_for(first.width(), first.height())?;
        check(update)?;
        let state = SequenceState {
            frame: 0,
            reference: 0,
            candidate: 0,
            base: Vec::new(),
            next: Vec::new(),
            starts: vec![None; points.len()],
            best_count: 0,
            best_zncc: 0.0,
        };
        let reference = Reference::new(first);
        Ok(Self {
            settings,
            update,
            points,
            reference,
            target: None,
            workspace: Workspace::new(),
            spare: None,
            moved: None,
            state,
        })
    }

    /// Goes on after the frame in which `state` was taken. `reference` and `candidate` are the
    /// images of the frames that the state names; the latter is not needed where both are the same.
    ///
    /// # Errors
    /// As [`Sequence::new`], and a state that does not belong to the points or is damaged.
    pub fn resume(
        state: SequenceState,
        reference: Image,
        candidate: Option<Image>,
        points: Points,
        settings: Settings,
        update: Update,
    ) -> Result<Self, SequenceError> {
        settings.validate_for(reference.width(), reference.height())?;
        check(update)?;
        let count = points.len();
        let whole = |tracks: &[Track], frame: u32| tracks.len() == if frame == 0 { 0 } else { count };
        if state.starts.len() != count
            || !whole(&state.base, state.reference)
            || !whole(&state.next, state.candidate)
        {
            return Err(SequenceError::StateCount { found: state.starts.len(), points: count });
        }
        let sound = |k: &usize| {
            let tracks = state.base.get(*k).into_iter().chain(state.next.get(*k));
            let starts = state.starts[*k].iter().flat_map(|s| s.u.iter().chain(&s.v));
            !(tracks.into_iter().all(Track::is_sound) && starts.into_iter().all(|c| c.is_finite()))
        };
        if let Some(index) = (0..count).find(sound) {
            return Err(SequenceError::StateDamaged { index });
        }
        if state.candidate != state.reference && candidate.is_none() {
            return Err(SequenceError::StateImages {
                reference: state.reference,
                candidate: state.candidate,
            });
        }
        let reference = Reference::new(reference);
        let mut sequence = Self {
            settings,
            update,
            points,
            reference,
            target: None,
            workspace: Workspace::new(),
            spare: candidate,
            moved: None,
            state,
        };
        sequence.moved = sequence.moved()?;
        Ok(sequence)
    }

    /// What [`Sequence::resume`] needs.
    pub fn state(&self) -> &SequenceState {
        &self.state
    }

    /// The points, in the first frame.
    pub fn points(&self) -> &Points {
        &self.points
    }

    /// Counts a frame that cannot be used; the next one starts from the last good one.
    pub fn skip(&mut self) {
        self.state.frame += 1;
    }

    /// Correlates the next image.
    ///
    /// The result does not depend on the number of threads.
    ///
    /// # Errors
    /// An image of another size, or a run that was cancelled: the sequence is then as before, and
    /// can go on with another image.
    pub fn next(&mut self, image: Image, observer: &dyn Observer) -> Result<SequenceFrame, SequenceError> {
        let first = &self.reference.image;
        if (first.width(), first.height()) != (image.width(), image.height()) {
            return Err(SequenceError::Correlate(CorrelateError::ImageSize {
                reference_width: first.width(),
                reference_height: first.height(),
                target_width: image.width(),
                target_height: image.height(),
            }));
        }
        match &mut self.target {
            Some(target) => target.update(image),
            None => self.target = Some(Target::new(image, self.settings.interpolation)),
        }
        if self.update == Update::Incremental {
            self.replace()?;
        }
        let mut step = self.correlate(observer)?;
        let mut tracks = self.tracks(&step);
        let first_try = step.found.timing;
        let again = match self.update {
            Update::Automatic { min_points, .. }
                if !self.good(&step) && self.state.candidate != self.state.reference =>
            {
                self.again(&step, &tracks, min_points, observer)?
            }
            _ => None,
        };
        if let Some(better) = again {
            step = better;
            tracks = self.tracks(&step);
            step.found.timing.init += first_try.init;
            step.found.timing.solve += first_try.solve;
        }
        self.state.frame += 1;
        let frame = self.composed(&step, &tracks);
        self.remember(&step, tracks);
        Ok(frame)
    }

    /// Present reference against the present target.
    fn correlate(&mut self, observer: &dyn Observer) -> Result<Step, SequenceError> {
        let Some(target) = &self.target else {
            return Ok(Step::new(Correlation::default()));
        };
        let chosen: Vec<Option<ShapeParameters>>;
        let (points, starts) = match &self.moved {
            None => (&self.points, &self.state.starts),
            Some(moved) => {
                chosen = moved.index.iter().map(|&k| self.state.starts[k]).collect();
                (&moved.points, &chosen)
            }
        };
        let guess = if starts.iter().any(Option::is_some) { Guess::Shapes(starts) } else { Guess::default() };
        if points.is_empty() {
            return Ok(Step::new(Correlation::default()));
        }
        let memory = &mut self.workspace;
        Ok(Step::new(memory.correlate(&self.reference, target, points, &guess, &self.settings, observer)?))
    }

    /// Numbers of the points that a step holds, in its order.
    fn sought(&self) -> impl Iterator<Item = usize> + '_ {
        let all = self.moved.is_none().then(|| 0..self.points.len());
        let some = self.moved.iter().flat_map(|m| m.index.iter().copied());
        all.into_iter().flatten().chain(some)
    }

    /// Every point's way from the first frame to this one.
    fn tracks(&self, step: &Step) -> Vec<Track> {
        let mut tracks =
            if self.moved.is_none() { vec![Track::HERE; self.points.len()] } else { self.state.base.clone() };
        for (k, point) in self.sought().zip(&step.found.points) {
            tracks[k] = tracks[k].then(point, self.state.reference);
        }
        tracks
    }

    fn good(&self, step: &Step) -> bool {
        let share = MIN_SHARE * self.points.len() as f64;
        let (min_points, min_zncc) = match self.update {
            Update::Automatic { min_points, min_zncc } => (min_points, min_zncc),
            Update::Fixed | Update::Incremental => (MIN_KEPT, 0.0),
        };
        step.count as f64 >= (min_points * self.state.best_count as f64).max(share)
            && f64::from(step.zncc) >= min_zncc * f64::from(self.state.best_zncc)
    }

    /// The frame once more, with the candidate as the reference; back to the old one if that is no
    /// better.
    fn again(
        &mut self,
        step: &Step,
        tracks: &[Track],
        min_points: f64,
        observer: &dyn Observer,
    ) -> Result<Option<Step>, SequenceError> {
        let old = self.state.clone();
        for (k, start) in self.state.starts.iter_mut().enumerate() {
            let from = self.state.next.get(k).copied().unwrap_or(Track::HERE);
            *start = track::between(&from, &tracks[k]);
        }
        self.replace()?;
        let result = self.correlate(observer);
        if let Ok(better) = result.as_ref()
            && (better.count > step.count
                || better.count as f64 >= min_points * step.count as f64 && better.zncc > step.zncc)
        {
            return result.map(Some);
        }
        // the image that was the reference lies in the spare place
        if let Some(image) = &mut self.spare {
            self.reference.exchange(image);
        }
        self.state = old;
        self.moved = self.moved()?;
        result.map(|_| None)
    }

    /// Makes the candidate the reference.
    fn replace(&mut self) -> Result<(), SequenceError> {
        let Some(image) = &mut self.spare else {
            return Ok(());
        };
        if self.state.candidate == self.state.reference {
            return Ok(());
        }
        self.reference.exchange(image);
        self.state.reference = self.state.candidate;
        self.state.base = self.state.next.clone();
        self.state.best_count = match self.update {
            Update::Incremental => self.state.base.iter().filter(|t| t.is_found()).count() as u64,
            Update::Fixed | Update::Automatic { .. } => 0,
        };
        self.state.best_zncc = 0.0;
        self.moved = self.moved()?;
        Ok(())
    }

    /// The points where they are in the present reference.
    fn moved(&self) -> Result<Option<Moved>, SequenceError> {
        if self.state.reference == 0 {
            return Ok(None);
        }
        let (mut positions, mut index) = (Vec::new(), Vec::new());
        for (k, (track, &x)) in self.state.base.iter().zip(self.points.positions()).enumerate() {
            if let Some(position) = track.position(x) {
                positions.push(position);
                index.push(k);
            }
        }
        Ok(Some(Moved { points: Points::scattered(positions)?, index }))
    }

    fn composed(&self, step: &Step, tracks: &[Track]) -> SequenceFrame {
        let positions = self.points.positions();
        let mut points: Vec<Point> =
            positions.iter().zip(tracks).map(|(&x, t)| track::composed(x, t, None)).collect();
        let present = self.state.reference;
        let mut references: Vec<u32> = tracks
            .iter()
            .map(|t| if let Track::Lost { reference, .. } = t { *reference } else { present })
            .collect();
        for (k, point) in self.sought().zip(&step.found.points) {
            references[k] = present;
            points[k] = if self.moved.is_none() {
                *point
            } else {
                track::composed(positions[k], &tracks[k], Some(point))
            };
        }
        SequenceFrame {
            frame: self.state.frame,
            reference: present,
            points,
            references,
            timing: step.found.timing,
        }
    }

    /// What the next frame starts from, and whether this one may become the reference.
    fn remember(&mut self, step: &Step, tracks: Vec<Track>) {
        if !self.good(step) {
            return;
        }
        let mut starts = vec![None; self.points.len()];
        for (k, point) in self.sought().zip(&step.found.points) {
            starts[k] = track::start(point);
        }
        let state = &mut self.state;
        state.starts = starts;
        state.best_count = state.best_count.max(step.count);
        state.best_zncc = state.best_zncc.max(step.zncc);
        let Some(target) = &mut self.target else {
            return;
        };
        if self.update != Update::Fixed {
            state.candidate = state.frame;
            state.next = tracks;
            match &mut self.spare {
                Some(image) => std::mem::swap(image, &mut target.image),
                None => self.spare = Some(target.image.clone()),
            }
        }
    }
}

fn check(update: Update) -> Result<(), SequenceError> {
    if let Update::Automatic { min_points, min_zncc } = update {
        for (name, value) in [("min_points", min_points), ("min_zncc", min_zncc)] {
            if !(0.0..=1.0).contains(&value) {
                return Err(SequenceError::Limit { name, value });
            }
        }
    }
    Ok(())
}
