//! What the process has used.

use std::time::Instant;

/// CPU and wall time since a moment.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    wall: Instant,
    cpu_s: f64,
}

/// Seconds of CPU (all threads) and of wall time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Seconds {
    /// CPU seconds, user and system, of all threads.
    pub cpu: f64,
    /// Wall seconds.
    pub wall: f64,
}

impl Clock {
    /// Starts now.
    pub fn start() -> Self {
        Self { wall: Instant::now(), cpu_s: cpu_seconds() }
    }

    /// Time since the start.
    pub fn elapsed(&self) -> Seconds {
        Seconds { cpu: cpu_seconds() - self.cpu_s, wall: self.wall.elapsed().as_secs_f64() }
    }
}

#[cfg(unix)]
fn usage() -> Option<nix::sys::resource::Usage> {
    nix::sys::resource::getrusage(nix::sys::resource::UsageWho::RUSAGE_SELF).ok()
}

/// CPU seconds of the process so far; NaN where the system does not tell.
#[cfg(unix)]
pub fn cpu_seconds() -> f64 {
    use nix::sys::time::TimeValLike as _;
    usage().map_or(f64::NAN, |u| (u.user_time() + u.system_time()).num_microseconds() as f64 * 1e-6)
}

/// Largest resident memory of the process so far in megabytes (10⁶ bytes); NaN where the system does
/// not tell.
#[cfg(unix)]
pub fn peak_rss_mb() -> f64 {
    // Linux counts in kibibytes, Darwin in bytes
    let unit = if cfg!(target_vendor = "apple") { 1.0 } else { 1024.0 };
    usage().map_or(f64::NAN, |u| u.max_rss() as f64 * unit * 1e-6)
}

/// CPU seconds of the process so far; NaN: not measured on this system.
#[cfg(not(unix))]
pub fn cpu_seconds() -> f64 {
    f64::NAN
}

/// Largest resident memory; NaN: not measured on this system.
#[cfg(not(unix))]
pub fn peak_rss_mb() -> f64 {
    f64::NAN
}
