//! When the camera is exposed, and to what.
//!
//! The light of an exposure is what shines between trigger + delay and the end of the exposure,
//! together with where the specimen stood meanwhile. Turning this into pixels is the sensor's work.

use daic_protocol::channels;
use daic_protocol::limits::TICK_HZ;

use crate::config::CameraConfig;
use crate::world::ticks_from_ns;

/// Light received while the specimen stood (nearly) still.
#[derive(Debug, Clone, PartialEq)]
pub struct SubPosition {
    /// Position of the stage, averaged over the light, in millimetres.
    pub stage_mm: [f64; 3],
    /// Photo-electrons at reflectance 1 while any row was exposed.
    pub electrons: f64,
    /// When they came.
    pieces: Vec<Piece>,
}

/// Even light from one tick to another.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Piece {
    from: u64,
    to: u64,
    /// Electrons per second at reflectance 1.
    rate: f64,
}

impl Piece {
    /// Electrons between two ticks.
    fn electrons(&self, from: u64, to: u64) -> f64 {
        let ticks = self.to.min(to).saturating_sub(self.from.max(from));
        self.rate * ticks as f64 / f64::from(TICK_HZ)
    }
}

/// Light of one exposure, split where the specimen moved.
#[derive(Debug, Clone, Default)]
pub struct Light {
    positions: Vec<Group>,
    step_mm: f64,
    most: usize,
}

#[derive(Debug, Clone)]
struct Group {
    first_mm: [f64; 3],
    moment: [f64; 3],
    electrons: f64,
    moved: bool,
    pieces: Vec<Piece>,
}

impl Light {
    fn new(step_mm: f64, most: usize) -> Self {
        Self { positions: Vec::new(), step_mm, most: most.max(1) }
    }

    /// Adds what was received at `stage_mm`.
    fn add(&mut self, stage_mm: [f64; 3], piece: Piece) {
        let electrons = piece.electrons(piece.from, piece.to);
        if electrons <= 0.0 {
            return;
        }
        let moment = stage_mm.map(|p| p * electrons);
        let group = Group { first_mm: stage_mm, moment, electrons, moved: false, pieces: vec![piece] };
        self.push(group);
        while self.positions.len() > self.most {
            // Too long a smear: coarser positions, so that a frame stays affordable.
            self.step_mm *= 2.0;
            for group in std::mem::take(&mut self.positions) {
                self.push(group);
            }
        }
    }

    fn push(&mut self, group: Group) {
        if let Some(last) = self.positions.last_mut() {
            let distance2: f64 = (0..3).map(|k| (group.first_mm[k] - last.first_mm[k]).powi(2)).sum();
            if distance2 < self.step_mm * self.step_mm {
                last.electrons += group.electrons;
                last.moved |= group.moved || group.first_mm != last.first_mm;
                for k in 0..3 {
                    last.moment[k] += group.moment[k];
                }
                for piece in group.pieces {
                    match last.pieces.last_mut() {
                        Some(end) if end.to == piece.from && end.rate == piece.rate => end.to = piece.to,
                        _ => last.pieces.push(piece),
                    }
                }
                return;
            }
        }
        self.positions.push(group);
    }

    /// The positions and what was received at each, in order of time; empty for a dark frame.
    pub fn positions(&self) -> Vec<SubPosition> {
        let position = |g: &Group| {
            // At rest it is exactly where it was, without the rounding of a mean.
            let mean = g.moment.map(|m| m / g.electrons);
            SubPosition {
                stage_mm: if g.moved { mean } else { g.first_mm },
                electrons: g.electrons,
                pieces: g.pieces.clone(),
            }
        };
        self.positions.iter().map(position).collect()
    }

    /// Distance between positions that was used, in millimetres.
    pub fn step_mm(&self) -> f64 {
        self.step_mm
    }
}

/// One exposure, ended.
#[derive(Debug, Clone)]
pub struct ExposureRecord {
    /// Counts the exposures from 0, lost ones included.
    pub id: u64,
    /// Tick of the trigger's rising edge.
    pub trigger_tick: u64,
    /// First tick of the exposure of row 0.
    pub start_tick: u64,
    /// Tick at which it ended.
    pub end_tick: u64,
    /// How much later each row is than the one above; 0 is a global shutter.
    pub row_ticks: u64,
    /// What shone while any row was exposed.
    pub light: Light,
}

impl ExposureRecord {
    /// Photo-electrons at reflectance 1 that `row` received while the specimen stood at `position`.
    pub fn electrons_of_row(&self, position: &SubPosition, row: usize) -> f64 {
        if self.row_ticks == 0 {
            return position.electrons;
        }
        let late = self.row_ticks.saturating_mul(row as u64);
        let (from, to) = (self.start_tick.saturating_add(late), self.end_tick.saturating_add(late));
        position.pieces.iter().map(|piece| piece.electrons(from, to)).sum()
    }
}

/// Trigger input and exposure control of the camera.
#[derive(Debug)]
pub struct Camera {
    line: u32,
    delay: u64,
    exposure: u64,
    readout: u64,
    row: u64,
    rows: u64,
    blur_step_mm: f64,
    blur_positions: usize,
    open: Option<ExposureRecord>,
    busy_until: u64,
    next_id: u64,
    missed: u64,
    finished: Vec<ExposureRecord>,
}

impl Camera {
    /// An idle camera; light is split at every `blur_step_mm` of motion into at most `blur_positions`.
    pub fn new(config: &CameraConfig, blur_step_mm: f64, blur_positions: usize) -> Self {
        Self {
            line: channels::camera(config.line).unwrap_or(0),
            delay: ticks_from_ns(config.trigger_delay_ns),
            exposure: ticks_from_ns(config.exposure_ns).max(1),
            readout: ticks_from_ns(config.readout_ns),
            row: ticks_from_ns(config.row_ns),
            rows: config.height as u64,
            blur_step_mm,
            blur_positions,
            open: None,
            busy_until: 0,
            next_id: 0,
            missed: 0,
            finished: Vec::new(),
        }
    }

    /// Sets the length of the exposures that begin from now on.
    pub fn set_exposure_ns(&mut self, ns: u64) {
        self.exposure = ticks_from_ns(ns).max(1);
    }

    /// Triggers ignored because the camera was busy.
    pub fn missed_triggers(&self) -> u64 {
        self.missed
    }

    /// Exposures begun so far.
    pub fn exposures(&self) -> u64 {
        self.next_id
    }

    /// The word changes at `tick`.
    pub fn edge(&mut self, tick: u64, before: u32, after: u32) {
        if after & !before & self.line == 0 {
            return;
        }
        if self.open.is_some() || tick < self.busy_until {
            self.missed += 1;
            return;
        }
        let start_tick = tick.saturating_add(self.delay);
        let end_tick = start_tick.saturating_add(self.exposure);
        self.busy_until = end_tick.saturating_add(self.rolling()).saturating_add(self.readout);
        self.open = Some(ExposureRecord {
            id: self.next_id,
            trigger_tick: tick,
            start_tick,
            end_tick,
            row_ticks: self.row,
            light: Light::new(self.blur_step_mm, self.blur_positions),
        });
        self.next_id += 1;
    }

    /// How much later the last row is exposed than the first.
    fn rolling(&self) -> u64 {
        self.row.saturating_mul(self.rows.saturating_sub(1))
    }

    /// From tick `from` to tick `to` light of `rate` electrons per second shone on a specimen at `stage_mm`.
    pub fn collect(&mut self, from: u64, to: u64, rate: f64, stage_mm: [f64; 3]) {
        let rolling = self.rolling();
        let Some(open) = &mut self.open else { return };
        let last_tick = open.end_tick.saturating_add(rolling);
        let (start, end) = (from.max(open.start_tick), to.min(last_tick));
        if end > start {
            open.light.add(stage_mm, Piece { from: start, to: end, rate });
        }
        if to >= last_tick {
            self.finished.extend(self.open.take());
        }
    }

    /// When exposure and readout will have ended, if they have not at `tick`.
    pub fn free_at(&self, tick: u64) -> Option<u64> {
        (self.open.is_some() || tick < self.busy_until).then_some(self.busy_until)
    }

    /// Whether it is exposed at `tick`.
    pub fn is_exposing(&self, tick: u64) -> bool {
        self.open.as_ref().is_some_and(|open| (open.start_tick..open.end_tick).contains(&tick))
    }

    /// When that changes next after `tick`.
    pub fn next_change(&self, tick: u64) -> Option<u64> {
        let open = self.open.as_ref()?;
        Some(if tick < open.start_tick { open.start_tick } else { open.end_tick.max(tick) })
    }

    /// Index of its trigger line.
    pub fn line(&self) -> u8 {
        u8::try_from(self.line.trailing_zeros()).unwrap_or(0).wrapping_sub(8)
    }

    /// Exposures ended since the last call.
    pub fn take_finished(&mut self) -> Vec<ExposureRecord> {
        std::mem::take(&mut self.finished)
    }
}
