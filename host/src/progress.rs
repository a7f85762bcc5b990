//! How long work tells how far it is.

use std::sync::atomic::AtomicBool;

/// Receives the progress of long work. Implementations must be cheap: they are called from worker threads.
pub trait Progress: Sync {
    /// A stage of `total` units begins.
    fn stage(&self, name: &str, total: u64);
    /// `done` units of the current stage are done.
    fn advance(&self, done: u64);
    /// Set to true by somebody who wants the rig stopped; recording looks at it often.
    fn stop_requested(&self) -> &AtomicBool {
        static NEVER: AtomicBool = AtomicBool::new(false);
        &NEVER
    }
}

/// Progress that nobody watches.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn stage(&self, _name: &str, _total: u64) {}
    fn advance(&self, _done: u64) {}
}
