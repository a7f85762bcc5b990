//! Bytes to and from a box: serial port, TCP, any in-process stream.

use super::LinkError;
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Most bytes handed to one write: a longer one can block for ever on a port that nobody reads.
pub const MAX_WRITE: usize = 1024;
/// How long connecting over TCP may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);

/// A duplex stream of bytes.
pub trait Transport: Send {
    /// Reads what is there, waiting at most `timeout` for the first byte; 0 bytes means time-out.
    ///
    /// # Errors
    /// The stream is broken or closed ([`ErrorKind::UnexpectedEof`]).
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize>;

    /// Writes all bytes, in pieces of at most [`MAX_WRITE`], within `timeout`. Never flushes.
    ///
    /// # Errors
    /// The stream is broken or closed, or does not take the bytes in time ([`ErrorKind::TimedOut`]).
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> io::Result<()>;
}

/// Opens what `port` names: `tcp://host:port` or the path of a serial port.
///
/// # Errors
/// [`LinkError::SimulatedRig`], [`LinkError::PortAbsent`], [`LinkError::PortBusy`], [`LinkError::PortRefused`],
/// [`LinkError::BadAddress`], [`LinkError::Unreachable`].
pub fn open(port: &str, baud: u32) -> Result<Box<dyn Transport>, LinkError> {
    if port.trim() == "sim" {
        return Err(LinkError::SimulatedRig);
    }
    match port.strip_prefix("tcp://") {
        Some(address) => tcp(port, address),
        None => serial(port, baud),
    }
}

/// Paths of the serial ports that the system lists (a pseudo-terminal is never among them).
pub fn available_ports() -> Vec<String> {
    let mut names: Vec<String> =
        serialport::available_ports().unwrap_or_default().into_iter().map(|p| p.port_name).collect();
    names.sort();
    names
}

fn serial(path: &str, baud: u32) -> Result<Box<dyn Transport>, LinkError> {
    let absent = || LinkError::PortAbsent { path: path.to_owned(), available: available_ports() };
    if cfg!(unix) && !std::path::Path::new(path).exists() {
        return Err(absent());
    }
    match serialport::new(path, baud).timeout(Duration::from_millis(100)).open() {
        Ok(mut port) => {
            // Some USB boards send nothing before DTR; pseudo-terminals have no DTR at all.
            if let Err(error) = port.write_data_terminal_ready(true) {
                tracing::debug!(path, %error, "no DTR line");
            }
            Ok(Box::new(Serial(port)))
        }
        Err(error) => {
            let text = error.description.to_lowercase();
            match error.kind {
                _ if text.contains("exclusive lock") || text.contains("busy") => {
                    Err(LinkError::PortBusy { path: path.to_owned() })
                }
                serialport::ErrorKind::Io(ErrorKind::NotFound) => Err(absent()),
                serialport::ErrorKind::NoDevice if !cfg!(unix) => Err(absent()),
                _ => Err(LinkError::PortRefused { path: path.to_owned(), reason: error.description }),
            }
        }
    }
}

struct Serial(Box<dyn serialport::SerialPort>);

impl Transport for Serial {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        self.0.set_timeout(timeout.max(Duration::from_millis(1)))?;
        quiet_is_zero(self.0.read(buffer))
    }
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> io::Result<()> {
        write_pieces(&mut self.0, bytes, timeout)
    }
}

fn tcp(port: &str, address: &str) -> Result<Box<dyn Transport>, LinkError> {
    let unreachable = |source| LinkError::Unreachable { address: port.to_owned(), source };
    if address.rsplit_once(':').is_none_or(|(host, p)| host.is_empty() || p.parse::<u16>().is_err()) {
        return Err(LinkError::BadAddress { text: port.to_owned() });
    }
    let mut last = io::Error::from(ErrorKind::AddrNotAvailable);
    for target in address.to_socket_addrs().map_err(unreachable)? {
        match TcpStream::connect_timeout(&target, CONNECT_TIMEOUT) {
            Ok(stream) => {
                // Requests are small and answered one by one: waiting to fill a packet only delays.
                stream.set_nodelay(true).map_err(unreachable)?;
                stream.set_write_timeout(Some(Duration::from_millis(100))).map_err(unreachable)?;
                return Ok(Box::new(Tcp(stream)));
            }
            Err(error) => last = error,
        }
    }
    Err(unreachable(last))
}

struct Tcp(TcpStream);

impl Transport for Tcp {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        self.0.set_read_timeout(Some(timeout.max(Duration::from_millis(1))))?;
        match self.0.read(buffer) {
            Ok(0) if !buffer.is_empty() => Err(ErrorKind::UnexpectedEof.into()),
            other => quiet_is_zero(other),
        }
    }
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> io::Result<()> {
        write_pieces(&mut self.0, bytes, timeout)
    }
}

/// Any in-process stream whose reads come back quickly: with bytes, or with
/// [`ErrorKind::WouldBlock`], [`ErrorKind::TimedOut`] or 0 bytes when there are none yet.
#[derive(Debug)]
pub struct StreamTransport<S>(S);

impl<S: Read + Write + Send> StreamTransport<S> {
    /// Wraps a stream.
    pub fn new(stream: S) -> Self {
        Self(stream)
    }
}

impl<S: Read + Write + Send> Transport for StreamTransport<S> {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        let deadline = Instant::now() + timeout;
        loop {
            let n = quiet_is_zero(self.0.read(buffer))?;
            if n > 0 || Instant::now() >= deadline {
                return Ok(n);
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> io::Result<()> {
        write_pieces(&mut self.0, bytes, timeout)
    }
}

/// An idle line is no error.
fn quiet_is_zero(result: io::Result<usize>) -> io::Result<usize> {
    match result {
        Err(e)
            if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted) =>
        {
            Ok(0)
        }
        other => other,
    }
}

fn write_pieces(stream: &mut dyn Write, bytes: &[u8], timeout: Duration) -> io::Result<()> {
    let deadline = Instant::now() + timeout;
    let mut rest = bytes;
    while !rest.is_empty() {
        let piece = rest.get(..MAX_WRITE).unwrap_or(rest);
        let n = quiet_is_zero(stream.write(piece))?;
        rest = rest.get(n..).unwrap_or(&[]);
        if n == 0 {
            if Instant::now() >= deadline {
                return Err(ErrorKind::TimedOut.into());
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    Ok(())
}

#[derive(Debug, Default)]
struct Direction {
    bytes: VecDeque<u8>,
    closed: bool,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<Direction>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Direction> {
        // The state is bytes and a flag: whole after any panic of the other side.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One end of an in-process duplex stream made by [`pipe`].
#[derive(Debug)]
pub struct PipeEnd {
    incoming: Arc<Shared>,
    outgoing: Arc<Shared>,
}

/// Two connected ends: what one writes the other reads. Dropping an end closes the stream.
pub fn pipe() -> (PipeEnd, PipeEnd) {
    let (a, b) = (Arc::new(Shared::default()), Arc::new(Shared::default()));
    (PipeEnd { incoming: a.clone(), outgoing: b.clone() }, PipeEnd { incoming: b, outgoing: a })
}

impl Transport for PipeEnd {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        let (mut state, _) = self
            .incoming
            .changed
            .wait_timeout_while(self.incoming.lock(), timeout, |s| s.bytes.is_empty() && !s.closed)
            .unwrap_or_else(PoisonError::into_inner);
        if state.bytes.is_empty() && state.closed {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        state.bytes.read(buffer)
    }
    fn write(&mut self, bytes: &[u8], _: Duration) -> io::Result<()> {
        let mut state = self.outgoing.lock();
        if state.closed {
            return Err(ErrorKind::BrokenPipe.into());
        }
        state.bytes.extend(bytes);
        self.outgoing.changed.notify_all();
        Ok(())
    }
}

impl Drop for PipeEnd {
    fn drop(&mut self) {
        for direction in [&self.incoming, &self.outgoing] {
            direction.lock().closed = true;
            direction.changed.notify_all();
        }
    }
}
