//! A pipe within the process that behaves like a serial port: blocking with a time-out.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::transport::Link;

/// Bytes a direction holds.
const CAPACITY: usize = 64 * 1024;

#[derive(Debug, Default)]
struct Buffer {
    bytes: VecDeque<u8>,
    closed: bool,
}

#[derive(Debug, Default)]
struct Pipe {
    buffer: Mutex<Buffer>,
    changed: Condvar,
}

impl Pipe {
    fn lock(&self) -> MutexGuard<'_, Buffer> {
        // A panicked holder leaves the bytes intact.
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until `ready` or closed; false if time ran out.
    fn wait(&self, timeout: Duration, ready: impl Fn(&Buffer) -> bool) -> Option<MutexGuard<'_, Buffer>> {
        let end = Instant::now() + timeout;
        let mut buffer = self.lock();
        while !ready(&buffer) && !buffer.closed {
            let left = end.checked_duration_since(Instant::now())?;
            buffer = self.changed.wait_timeout(buffer, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        Some(buffer)
    }

    fn read(&self, out: &mut [u8], timeout: Duration) -> io::Result<usize> {
        let mut buffer =
            self.wait(timeout, |b| !b.bytes.is_empty()).ok_or(io::Error::from(io::ErrorKind::TimedOut))?;
        let count = buffer.bytes.len().min(out.len());
        if count == 0 && !out.is_empty() {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        for (to, from) in out.iter_mut().zip(buffer.bytes.drain(..count)) {
            *to = from;
        }
        self.changed.notify_all();
        Ok(count)
    }

    fn write(&self, bytes: &[u8], timeout: Duration) -> io::Result<usize> {
        let mut buffer = self
            .wait(timeout, |b| b.bytes.len() < CAPACITY)
            .ok_or(io::Error::from(io::ErrorKind::TimedOut))?;
        if buffer.closed {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        let count = bytes.len().min(CAPACITY - buffer.bytes.len());
        buffer.bytes.extend(&bytes[..count]);
        self.changed.notify_all();
        Ok(count)
    }

    fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}

/// The host's end.
///
/// Reading blocks up to the time-out and then fails with [`io::ErrorKind::TimedOut`]; once the rig
/// has stopped, reading (after what was still pending) and writing fail with
/// [`io::ErrorKind::BrokenPipe`].
#[derive(Debug, Clone)]
pub struct DuplexEnd {
    incoming: Arc<Pipe>,
    outgoing: Arc<Pipe>,
    timeout: Duration,
}

impl DuplexEnd {
    /// Sets how long reading and writing may block. At first it is one second.
    pub fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// How long reading and writing may block.
    pub fn timeout(&self) -> Duration {
        self.timeout
    }

    /// Discards what was received and not read, as opening a serial port does.
    pub fn clear_input(&mut self) {
        self.incoming.lock().bytes.clear();
    }
}

impl Read for DuplexEnd {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.incoming.read(buffer, self.timeout)
    }
}

impl Write for DuplexEnd {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.outgoing.write(bytes, self.timeout)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Makes host ends.
#[derive(Debug)]
pub(crate) struct Connector(DuplexEnd);

impl Connector {
    pub(crate) fn connect(&self) -> DuplexEnd {
        let mut end = self.0.clone();
        end.clear_input();
        end
    }
}

/// The box's end.
#[derive(Debug)]
pub(crate) struct BoardEnd(DuplexEnd);

pub(crate) fn board_end() -> (BoardEnd, Connector) {
    let (to_board, to_host) = (Arc::new(Pipe::default()), Arc::new(Pipe::default()));
    let timeout = Duration::from_secs(1);
    let board = DuplexEnd { incoming: Arc::clone(&to_board), outgoing: Arc::clone(&to_host), timeout };
    (BoardEnd(board), Connector(DuplexEnd { incoming: to_host, outgoing: to_board, timeout }))
}

impl Link for BoardEnd {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> usize {
        self.0.incoming.read(buffer, timeout).unwrap_or(0)
    }

    fn write(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match self.0.outgoing.write(bytes, Duration::from_millis(100)) {
                Ok(count) => bytes = &bytes[count..],
                Err(_) => return,
            }
        }
    }
}

impl Drop for BoardEnd {
    fn drop(&mut self) {
        self.0.incoming.close();
        self.0.outgoing.close();
    }
}
