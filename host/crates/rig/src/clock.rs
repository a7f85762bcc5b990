//! Device ticks as host times, each with an error bound.
//!
//! A sample says: the box read `tick` at some time between `sent` and `received`. The midpoint is
//! wrong by at most half the round trip, whatever the asymmetry. A line through the midpoints of
//! the quickest round trips, `host = Σ wᵢ(tick)·midᵢ`, is linear in them, so its error at any tick is
//! at most `Σ |wᵢ(tick)|·(rttᵢ/2 + wander·|tickᵢ − tick|) + 1 tick`: a bound, not an estimate, and
//! it grows by itself with the distance from the samples. Where few samples are at hand the nominal
//! rate within the crystals' tolerance gives the smaller bound, and that one is taken.

use thiserror::Error;

/// One clock request and its reply. Host times in nanoseconds from any fixed zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockSample {
    /// Just before the request was written.
    pub sent_ns: i64,
    /// Just after the reply was read.
    pub received_ns: i64,
    /// Tick at which the box had received the request.
    pub tick: u64,
}

impl ClockSample {
    fn round_trip_ns(&self) -> f64 {
        self.received_ns.saturating_sub(self.sent_ns) as f64
    }
}

/// What is known about the clocks beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockOptions {
    /// Nominal ticks per second.
    pub tick_hz: u32,
    /// Largest relative rate difference between the two clocks, in parts per million.
    pub tolerance_ppm: f64,
    /// Largest departure of the rate from its mean over `window` samples, in parts per million.
    pub wander_ppm: f64,
    /// No host time is given whose error may exceed this, in nanoseconds.
    pub limit_ns: f64,
    /// Samples used for one host time: those nearest to its tick.
    pub window: usize,
}

impl ClockOptions {
    /// 200 ppm tolerance, 0.5 ppm wander, 1 ms limit, 64 samples.
    pub fn new(tick_hz: u32) -> Self {
        Self { tick_hz, tolerance_ppm: 200.0, wander_ppm: 0.5, limit_ns: 1e6, window: 64 }
    }
}

/// A host time and the largest error it can have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HostTime {
    /// Nanoseconds from the zero of the samples.
    pub ns: f64,
    /// The true time lies within ± this many nanoseconds.
    pub bound_ns: f64,
}

/// A host time cannot be given, or a sample cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ClockError {
    /// No sample yet.
    #[error("no clock sample yet; take one before asking for host times")]
    NoSample,
    /// The error could exceed the limit.
    #[error(
        "the host time of tick {tick} may be wrong by {bound_ns:.0} ns, more than the limit of {limit_ns:.0} ns; take clock samples nearer to it"
    )]
    BeyondLimit {
        /// The tick asked for.
        tick: u64,
        /// Error bound in nanoseconds.
        bound_ns: f64,
        /// Limit in nanoseconds.
        limit_ns: f64,
    },
    /// The reply came before the request, or ticks ran backwards.
    #[error(
        "a clock sample runs backwards (tick {tick} after tick {previous}); the box was reset, or the host's clock was set"
    )]
    Backwards {
        /// Tick of the sample.
        tick: u64,
        /// Tick of the sample before.
        previous: u64,
    },
    /// No rate within the tolerance fits this sample and an earlier one.
    #[error(
        "a clock sample is {excess_ns:.0} ns off any rate within {tolerance_ppm} ppm; the clocks are not what they are said to be"
    )]
    Inconsistent {
        /// How far off.
        excess_ns: f64,
        /// Tolerance of the rate.
        tolerance_ppm: f64,
    },
}

/// The model; add samples, ask for host times.
#[derive(Debug, Clone)]
pub struct ClockModel {
    options: ClockOptions,
    /// In order of ticks; all of a run, 24 bytes a second.
    samples: Vec<ClockSample>,
}

/// Milliseconds to wait before each of the next samples: uneven, so that sampling cannot lock to
/// anything periodic, and short at the begin.
pub fn sample_period_ms(index: u64) -> u64 {
    if index < 8 {
        return 3 + index;
    }
    // Multiples of the golden ratio fall evenly and never periodically.
    let fraction = (index as f64 * 0.618_033_988_749_895).fract();
    700 + (fraction * 600.0) as u64
}

impl ClockModel {
    /// A model without samples.
    pub fn new(options: ClockOptions) -> Self {
        Self { options, samples: Vec::new() }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.samples.len()
    }
    /// Whether there is no sample.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }
    /// Shortest round trip of all samples, in nanoseconds.
    pub fn min_round_trip_ns(&self) -> Option<f64> {
        self.samples.iter().map(ClockSample::round_trip_ns).min_by(f64::total_cmp)
    }

    /// Adds a sample. Samples of repeated requests must not be given
    /// ([`Link::clock_sample`](crate::link::Link::clock_sample) gives none).
    ///
    /// # Errors
    /// [`ClockError::Backwards`], [`ClockError::Inconsistent`]; the sample is not kept.
    pub fn add(&mut self, sample: ClockSample) -> Result<(), ClockError> {
        let last = self.samples.last().copied();
        let previous = last.map_or(0, |s| s.tick);
        let backwards = sample.received_ns < sample.sent_ns
            || last.is_some_and(|s| sample.tick < s.tick || sample.sent_ns < s.sent_ns);
        if backwards {
            return Err(ClockError::Backwards { tick: sample.tick, previous });
        }
        // Against the oldest, where a wrong rate shows most, and the newest.
        for other in [self.samples.first(), self.samples.last()].into_iter().flatten() {
            let device = self.span_ns(sample.tick, other.tick);
            let host = self.mid(&sample) - self.mid(other);
            let slack = device.abs() * self.options.tolerance_ppm * 1e-6
                + 0.5 * (sample.round_trip_ns() + other.round_trip_ns())
                + 2.0 * self.tick_ns();
            let excess_ns = (host - device).abs() - slack;
            if excess_ns > 0.0 {
                return Err(ClockError::Inconsistent {
                    excess_ns,
                    tolerance_ppm: self.options.tolerance_ppm,
                });
            }
        }
        self.samples.push(sample);
        Ok(())
    }

    /// Host time of a tick.
    ///
    /// # Errors
    /// [`ClockError::NoSample`], [`ClockError::BeyondLimit`].
    pub fn host_time(&self, tick: u64) -> Result<HostTime, ClockError> {
        let near = self.near(tick);
        let nominal = near.iter().map(|s| self.by_rate(s, tick));
        let best = nominal
            .chain(self.by_line(near, tick))
            .min_by(|a, b| a.bound_ns.total_cmp(&b.bound_ns))
            .ok_or(ClockError::NoSample)?;
        if best.bound_ns <= self.options.limit_ns {
            Ok(best)
        } else {
            Err(ClockError::BeyondLimit { tick, bound_ns: best.bound_ns, limit_ns: self.options.limit_ns })
        }
    }

    /// The samples used for a tick: half of the window before it and half behind, where there are.
    fn near(&self, tick: u64) -> &[ClockSample] {
        let window = self.options.window.clamp(2, self.samples.len().max(2));
        let at = self.samples.partition_point(|s| s.tick < tick);
        let last = self.samples.len().saturating_sub(window);
        let first = at.saturating_sub(window / 2).min(last);
        self.samples.get(first..).map_or(&[], |rest| rest.get(..window).unwrap_or(rest))
    }

    fn tick_ns(&self) -> f64 {
        1e9 / f64::from(self.options.tick_hz.max(1))
    }

    /// Nominal time from tick `b` to tick `a` in nanoseconds.
    fn span_ns(&self, a: u64, b: u64) -> f64 {
        let ns = a.abs_diff(b) as f64 * self.tick_ns();
        if a >= b { ns } else { -ns }
    }

    fn mid(&self, s: &ClockSample) -> f64 {
        s.sent_ns as f64 + 0.5 * s.round_trip_ns()
    }

    /// From one sample by the nominal rate.
    fn by_rate(&self, s: &ClockSample, tick: u64) -> HostTime {
        let device = self.span_ns(tick, s.tick);
        HostTime {
            ns: self.mid(s) + device,
            bound_ns: 0.5 * s.round_trip_ns()
                + device.abs() * self.options.tolerance_ppm * 1e-6
                + self.tick_ns(),
        }
    }

    /// From the line through the quickest samples.
    fn by_line(&self, near: &[ClockSample], tick: u64) -> Option<HostTime> {
        let mut used: Vec<&ClockSample> = near.iter().collect();
        used.sort_by(|a, b| a.round_trip_ns().total_cmp(&b.round_trip_ns()));
        let limit = 1.5 * used.first()?.round_trip_ns();
        let quick = used.iter().take_while(|s| s.round_trip_ns() <= limit).count();
        used.truncate(quick.max(3));

        // Weighted by 1/rtt²; abscissa: nominal nanoseconds from the tick asked for, so that the
        // intercept is the wanted value.
        let floor = self.tick_ns();
        let rows: Vec<(f64, f64, f64)> = used
            .iter()
            .map(|s| {
                let weight = s.round_trip_ns().max(floor).powi(-2);
                (self.span_ns(s.tick, tick), weight, 0.5 * s.round_trip_ns())
            })
            .collect();
        let total: f64 = rows.iter().map(|r| r.1).sum();
        let mean = rows.iter().map(|r| r.0 * r.1).sum::<f64>() / total;
        let spread: f64 = rows.iter().map(|r| r.1 * (r.0 - mean).powi(2)).sum();
        if spread.is_nan() || spread <= 0.0 {
            return None;
        }
        let wander = self.options.wander_ppm * 1e-6;
        // Host times relative to the first sample and to its nominal rate: small numbers.
        let first = *used.first()?;
        let mut ns = 0.0;
        let mut bound_ns = self.tick_ns();
        for (s, &(x, weight, half)) in used.iter().zip(&rows) {
            let w = weight / total - mean * weight * (x - mean) / spread;
            ns += w * (self.mid(s) - self.mid(first) - self.span_ns(s.tick, first.tick));
            bound_ns += w.abs() * (half + wander * x.abs() + self.tick_ns());
        }
        Some(HostTime { ns: ns + self.mid(first) + self.span_ns(tick, first.tick), bound_ns })
    }
}
