//! Memory that is kept from one parallel loop to the next.

use std::sync::Mutex;

/// Working memory for each thread of the pool, made when it is first asked for. What it holds between
/// two uses is arbitrary: whoever borrows it overwrites what it reads.
#[derive(Default)]
pub(crate) struct PerThread<T>(Vec<Mutex<T>>);

impl<T: Default> PerThread<T> {
    /// Makes room for the threads of the current pool.
    pub(crate) fn prepare(&mut self) {
        let threads = rayon::current_num_threads();
        self.0.resize_with(self.0.len().max(threads), Mutex::default);
    }

    /// Runs with the memory of the calling thread.
    pub(crate) fn with<R>(&self, f: impl FnOnce(&mut T) -> R) -> R {
        let own = rayon::current_thread_index().and_then(|i| self.0.get(i)).or(self.0.first());
        match own.map(Mutex::try_lock) {
            Some(Ok(mut t)) => f(&mut t),
            // a thread from elsewhere
            _ => f(&mut T::default()),
        }
    }
}

/// A copy has memory of its own.
impl<T> Clone for PerThread<T> {
    fn clone(&self) -> Self {
        Self(Vec::new())
    }
}
