//! Which trigger, and which strobe, belongs to which frame.
//!
//! The box says at which ticks it triggered; frames carry times of the camera's own clock, whose
//! zero is unknown and whose rate differs by up to [`PairingOptions::drift_ppm`]. An *alignment*
//! starts from the supposition that one frame belongs to one trigger and follows both trains from
//! there, keeping the rate between the bounds that the pairs so far allow: a frame that no trigger
//! explains is extra under this alignment. Of all alignments the one that explains most frames
//! wins. Where another explains as many, the frames on which the two differ are *ambiguous*:
//! a wrong pair is worse than none. Strictly periodic triggers with a frame lost at either end are
//! ambiguous by nature; an uneven period, a pause, or the arrival of frames at the host
//! ([`Arrival`]) makes them certain.
//!
//! What cannot be known: a foreign frame within the jitter of a trigger whose own frame was lost,
//! and one or two foreign frames that are all that came and fit the triggers by chance.
//!
//! Nothing here depends on the order in which frames came.

use std::collections::{HashMap, HashSet, VecDeque};

/// A rising edge of the camera trigger line, and the strobe that followed it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trigger {
    /// Tick of the edge.
    pub tick: u64,
    /// LED pulse inside the exposure; `None` if there was none.
    pub strobe: Option<StrobePulse>,
}

/// An LED pulse as it was played.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StrobePulse {
    /// LED line.
    pub led: u8,
    /// Tick of LED on.
    pub on: u64,
    /// Tick of LED off.
    pub off: u64,
}

/// What is known of a frame without looking at its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// The camera's frame counter.
    pub id: u64,
    /// Begin of the exposure by the camera's clock, in nanoseconds.
    pub camera_ns: Option<u64>,
    /// When the host had it, in nanoseconds from the zero of [`Arrival::trigger_ns`].
    pub host_ns: Option<i64>,
}

/// When triggers happened by the host's clock, and how fast frames reach the host.
#[derive(Debug, Clone, PartialEq)]
pub struct Arrival {
    /// Host time of each trigger in nanoseconds.
    pub trigger_ns: Vec<f64>,
    /// Error bound of those times.
    pub bound_ns: f64,
    /// No frame is with the host sooner than this after its trigger.
    pub min_latency_ns: f64,
    /// The quickest frame of a run is with the host within this after its trigger. Must be shorter
    /// than the trigger period to decide between neighbours.
    pub quickest_ns: f64,
    /// Every frame is with the host within this; only used for cameras without a clock.
    pub max_latency_ns: f64,
}

/// What is known of the clocks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairingOptions {
    /// Ticks per second of the box.
    pub tick_hz: u32,
    /// Largest relative rate difference of the camera's clock, in parts per million.
    pub drift_ppm: f64,
    /// Largest change of that rate while 64 frames are taken, in parts per million.
    pub wander_ppm: f64,
    /// Largest error of one frame's time of exposure, in nanoseconds.
    pub jitter_ns: f64,
}

impl PairingOptions {
    /// 200 ppm drift, 1 ppm wander, 20 µs jitter.
    pub fn new(tick_hz: u32) -> Self {
        Self { tick_hz, drift_ppm: 200.0, wander_ppm: 1.0, jitter_ns: 20e3 }
    }
}

/// What became of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It belongs to this trigger and was lit by this strobe.
    Paired {
        /// Index of the trigger.
        trigger: usize,
        /// The strobe, if one was played.
        strobe: Option<StrobePulse>,
    },
    /// No trigger of this run caused it, or it is a second copy.
    Extra,
    /// More than one trigger could have caused it.
    Ambiguous,
}

/// How many of each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Frames paired.
    pub paired: usize,
    /// Triggers without a frame.
    pub missing: usize,
    /// Frames without a trigger.
    pub extra: usize,
    /// Frames that could not be decided.
    pub ambiguous: usize,
}

/// The verdicts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pairing {
    /// One per frame, in the order given.
    pub frames: Vec<Verdict>,
    /// Frame of each trigger, `None` if missing.
    pub triggers: Vec<Option<usize>>,
    /// How many of each.
    pub counts: Counts,
}

/// Leading frames tried as extra: more than this many before the first trigger are not expected.
const LEADING_EXTRAS: usize = 8;
/// Pairs needed to believe an alignment that leaves frames unexplained.
const LEAST_EVIDENCE: usize = 3;
/// Pairs over which the rate is followed.
const RATE_WINDOW: usize = 64;
/// Frames after which an alignment that explains less than a quarter of them is given up.
const FIRST_LOOK: usize = 32;

/// Pairs frames with triggers; `triggers` must be in order of ticks.
pub fn pair(
    triggers: &[Trigger],
    frames: &[Stamp],
    options: &PairingOptions,
    arrival: Option<&Arrival>,
) -> Pairing {
    let arrival = arrival.filter(|a| a.trigger_ns.len() == triggers.len());
    let mut verdicts = vec![Verdict::Extra; frames.len()];

    let mut timed: Vec<(f64, usize)> = Vec::new();
    let mut untimed = Vec::new();
    let mut seen = HashSet::new();
    for (index, frame) in frames.iter().enumerate() {
        // The second copy of a frame stays extra.
        if seen.insert((frame.id, frame.camera_ns)) {
            match frame.camera_ns {
                Some(ns) => timed.push((ns as f64, index)),
                None => untimed.push(index),
            }
        }
    }
    // Two frames under one id with different times contradict each other.
    let mut ids = HashMap::new();
    for &(_, index) in &timed {
        *ids.entry(frames[index].id).or_insert(0usize) += 1;
    }
    timed.retain(|&(_, index)| {
        let single = ids.get(&frames[index].id) == Some(&1);
        if !single {
            verdicts[index] = Verdict::Ambiguous;
        }
        single
    });
    timed.sort_by(|a, b| a.0.total_cmp(&b.0));

    let zero = triggers.first().map_or(0, |t| t.tick);
    let scale = 1e9 / f64::from(options.tick_hz.max(1));
    let edges: Vec<f64> = triggers.iter().map(|t| t.tick.saturating_sub(zero) as f64 * scale).collect();
    let start = timed.first().map_or(0.0, |t| t.0);
    let search = Search {
        edges: &edges,
        times: timed.iter().map(|t| t.0 - start).collect(),
        host: timed.iter().map(|t| frames[t.1].host_ns).collect(),
        options,
        arrival,
    };
    for (&(_, index), found) in timed.iter().zip(search.decide()) {
        verdicts[index] = found.verdict();
    }
    for index in untimed {
        verdicts[index] = by_arrival(frames[index].host_ns, arrival).verdict();
    }
    settle(triggers, verdicts)
}

/// What an alignment says of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Found {
    None,
    One(usize),
    Many,
}

impl Found {
    fn verdict(self) -> Verdict {
        match self {
            Self::None => Verdict::Extra,
            Self::One(trigger) => Verdict::Paired { trigger, strobe: None },
            Self::Many => Verdict::Ambiguous,
        }
    }
}

/// Undoes pairs that share a trigger, adds strobes, counts.
fn settle(triggers: &[Trigger], mut verdicts: Vec<Verdict>) -> Pairing {
    let mut users = vec![0usize; triggers.len()];
    for verdict in &verdicts {
        if let Verdict::Paired { trigger, .. } = verdict {
            users[*trigger] += 1;
        }
    }
    let mut owner = vec![None; triggers.len()];
    let mut counts = Counts::default();
    for (index, verdict) in verdicts.iter_mut().enumerate() {
        if let Verdict::Paired { trigger, strobe } = verdict {
            let trigger = *trigger;
            if users[trigger] > 1 {
                *verdict = Verdict::Ambiguous;
            } else {
                *strobe = triggers[trigger].strobe;
                owner[trigger] = Some(index);
            }
        }
        match verdict {
            Verdict::Paired { .. } => counts.paired += 1,
            Verdict::Extra => counts.extra += 1,
            Verdict::Ambiguous => counts.ambiguous += 1,
        }
    }
    counts.missing = owner.iter().filter(|o| o.is_none()).count();
    Pairing { frames: verdicts, triggers: owner, counts }
}

/// A frame of a camera without a clock: certain only if one single trigger can have caused it.
fn by_arrival(host_ns: Option<i64>, arrival: Option<&Arrival>) -> Found {
    let (Some(host), Some(arrival)) = (host_ns, arrival) else { return Found::Many };
    let latest = host as f64 - arrival.min_latency_ns + arrival.bound_ns;
    let earliest = host as f64 - arrival.max_latency_ns - arrival.bound_ns;
    within(&arrival.trigger_ns, 0, earliest, latest)
}

/// Which of the ascending `values`, from index `first` on, lies in `from ..= to`.
fn within(values: &[f64], mut first: usize, from: f64, to: f64) -> Found {
    while values.get(first).is_some_and(|&v| v < from) {
        first += 1;
    }
    match (values.get(first), values.get(first + 1)) {
        (Some(&one), next) if one <= to => {
            if next.is_some_and(|&two| two <= to) {
                Found::Many
            } else {
                Found::One(first)
            }
        }
        _ => Found::None,
    }
}

/// A line through the last pairs: edge over frame time, and how wrong it can be.
struct Track<'a> {
    options: &'a PairingOptions,
    pairs: VecDeque<(f64, f64)>,
    /// Sums over the pairs, of coordinates relative to `origin`.
    origin: (f64, f64),
    sums: [f64; 4],
    stale: usize,
}

impl<'a> Track<'a> {
    fn new(options: &'a PairingOptions, time: f64, edge: f64) -> Self {
        let mut track =
            Self { options, pairs: VecDeque::new(), origin: (time, edge), sums: [0.0; 4], stale: 0 };
        track.add(time, edge);
        track
    }

    fn terms(&self, (time, edge): (f64, f64)) -> [f64; 4] {
        let (t, e) = (time - self.origin.0, edge - self.origin.1);
        [t, e, t * t, t * e]
    }

    fn add(&mut self, time: f64, edge: f64) {
        self.pairs.push_back((time, edge));
        if self.pairs.len() > RATE_WINDOW
            && let Some(oldest) = self.pairs.pop_front()
        {
            let terms = self.terms(oldest);
            self.sums.iter_mut().zip(terms).for_each(|(s, t)| *s -= t);
            self.stale += 1;
        }
        let terms = self.terms((time, edge));
        self.sums.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
        // Before the coordinates grow so large that their squares swamp the differences.
        if self.stale >= RATE_WINDOW {
            self.stale = 0;
            self.origin = self.pairs.front().copied().unwrap_or(self.origin);
            self.sums = [0.0; 4];
            for i in 0..self.pairs.len() {
                let terms = self.terms(self.pairs[i]);
                self.sums.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
            }
        }
    }

    /// Interval in which the edge of a frame taken at `time` must lie.
    fn predict(&self, time: f64) -> (f64, f64) {
        let n = self.pairs.len() as f64;
        let [t, e, tt, te] = self.sums;
        let (mean_t, mean_e) = (t / n, e / n);
        let ahead = time - self.origin.0 - mean_t;
        let jitter = self.options.jitter_ns;
        // By the nominal rate from the mean of the pairs, whose error is at most one jitter.
        let widest = self.options.drift_ppm * 1e-6;
        let mut centre = mean_e + ahead;
        let mut half = 2.0 * jitter + ahead.abs() * widest;
        // By their least-squares line. Its value here is a sum of the edges with weights whose
        // absolute values add up to at most √(1 + n·ahead²/spread).
        let spread = tt - n * mean_t * mean_t;
        if n > 1.0 && spread > 0.0 {
            let slope = (te - n * mean_t * mean_e) / spread;
            let line = jitter * (1.0 + (1.0 + n * ahead * ahead / spread).sqrt())
                + ahead.abs() * self.options.wander_ppm * 1e-6;
            if line < half {
                (centre, half) = (mean_e + ahead * slope, line);
            }
        }
        (centre + self.origin.1 - half, centre + self.origin.1 + half)
    }
}

struct Search<'a> {
    /// Trigger edges in nominal nanoseconds, ascending from 0.
    edges: &'a [f64],
    /// Frame times in camera nanoseconds, ascending from 0.
    times: Vec<f64>,
    host: Vec<Option<i64>>,
    options: &'a PairingOptions,
    arrival: Option<&'a Arrival>,
}

struct Alignment {
    found: Vec<Found>,
    matches: usize,
}

impl Search<'_> {
    /// The verdict of each frame in order of time.
    fn decide(&self) -> Vec<Found> {
        let count = self.times.len();
        let mut best = 0;
        let mut leaders: Vec<Alignment> = Vec::new();
        let mut tried = HashSet::new();
        for i in 0..count.min(LEADING_EXTRAS) {
            for j in 0..self.edges.len() {
                // No alignment from here can explain as many frames as the best one.
                if (count - i).min(self.edges.len() - j) < best {
                    break;
                }
                if tried.contains(&(i, j)) {
                    continue;
                }
                let Some(alignment) = self.follow(i, j, best) else { continue };
                for (k, found) in alignment.found.iter().enumerate().take(LEADING_EXTRAS) {
                    if let Found::One(trigger) = found {
                        tried.insert((k, *trigger));
                    }
                }
                if alignment.matches > best {
                    best = alignment.matches;
                    leaders.clear();
                }
                leaders.push(alignment);
                self.merge(&mut leaders);
            }
        }
        let mut found = leaders.pop().map_or_else(|| vec![Found::None; count], |a| a.found);
        // Two frames among strangers may have a trigger interval between them by chance.
        if best < count && best < LEAST_EVIDENCE {
            for f in found.iter_mut().filter(|f| matches!(f, Found::One(_))) {
                *f = Found::Many;
            }
        }
        found
    }

    /// Folds equally good alignments into one; where they differ nothing is certain.
    fn merge(&self, leaders: &mut Vec<Alignment>) {
        if let [first, rest @ ..] = leaders.as_mut_slice() {
            for other in rest {
                for (a, b) in first.found.iter_mut().zip(&other.found) {
                    if *a != *b {
                        *a = Found::Many;
                    }
                }
            }
            leaders.truncate(1);
        }
    }

    /// Follows both trains from frame `i` at trigger `j`; `None` if fewer than `least` frames can
    /// be explained, or if frames would arrive before their trigger.
    fn follow(&self, i: usize, j: usize, least: usize) -> Option<Alignment> {
        let count = self.times.len();
        let mut track = Track::new(self.options, self.times[i], self.edges[j]);
        let mut found = vec![Found::None; i];
        found.push(Found::One(j));
        let mut matches = 1;
        let mut quickest = f64::INFINITY;
        self.latency(i, j, &mut quickest)?;
        let mut last = j;
        for k in i + 1..count {
            let (from, to) = track.predict(self.times[k]);
            let here = within(self.edges, last, from, to);
            match here {
                Found::One(trigger) => {
                    self.latency(k, trigger, &mut quickest)?;
                    // A second frame at one trigger explains nothing; both end up ambiguous.
                    if trigger > last {
                        matches += 1;
                        last = trigger;
                        track.add(self.times[k], self.edges[trigger]);
                    }
                }
                Found::Many => matches += 1,
                Found::None => {}
            }
            found.push(here);
            let hopeless = k - i == FIRST_LOOK && matches < FIRST_LOOK / 4;
            if hopeless || matches + (count - k - 1) < least {
                return None;
            }
        }
        if self.arrival.is_some_and(|a| quickest.is_finite() && quickest > a.quickest_ns + a.bound_ns) {
            return None;
        }
        (matches >= least).then_some(Alignment { found, matches })
    }

    /// Arrival of frame `k` after trigger `j`; `None` if it came before it could.
    fn latency(&self, k: usize, j: usize, quickest: &mut f64) -> Option<()> {
        if let (Some(arrival), Some(host)) = (self.arrival, self.host[k]) {
            let latency = host as f64 - arrival.trigger_ns[j];
            if latency < arrival.min_latency_ns - arrival.bound_ns {
                return None;
            }
            *quickest = quickest.min(latency);
        }
        Some(())
    }
}
