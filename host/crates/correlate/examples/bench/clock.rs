//! Processor time and resident memory of this process.

/// Processor seconds of all threads of this process, user and system; NaN where the system does not
/// tell.
pub fn cpu() -> f64 {
    #[cfg(unix)]
    {
        use nix::sys::resource::{UsageWho, getrusage};
        use nix::sys::time::TimeValLike;
        if let Ok(usage) = getrusage(UsageWho::RUSAGE_SELF) {
            let micro = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
            return micro as f64 * 1e-6;
        }
    }
    f64::NAN
}

/// A line of /proc/self/status in bytes.
fn status(name: &str) -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(':'))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

/// Resident memory now.
pub fn resident() -> Option<u64> {
    status("VmRSS")
}

/// Largest resident memory since [`reset_peak`].
pub fn peak() -> Option<u64> {
    status("VmHWM")
}

/// Starts the peak anew from what is resident now (Linux).
pub fn reset_peak() -> bool {
    std::fs::write("/proc/self/clear_refs", "5").is_ok()
}
