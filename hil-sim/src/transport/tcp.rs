//! The box on a TCP port: the same bytes as on the serial line.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;

use nix::poll::PollFlags;

use crate::error::SimError;
use crate::transport::{Link, ready};

pub(crate) struct Tcp {
    listener: TcpListener,
    /// As a host names it, `tcp://host:port`.
    address: String,
    client: Option<TcpStream>,
    restarted: bool,
}

impl Tcp {
    pub(crate) fn listen(address: &str) -> Result<Self, SimError> {
        let failed = |cause| SimError::Tcp { address: address.to_owned(), cause };
        let plain = address.strip_prefix("tcp://").unwrap_or(address);
        let listener = TcpListener::bind(plain).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = format!("tcp://{}", listener.local_addr().map_err(failed)?);
        Ok(Self { listener, address, client: None, restarted: false })
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    fn accept(&mut self, timeout: Duration) {
        if ready(&self.listener, PollFlags::POLLIN, timeout) {
            self.client = self.listener.accept().ok().and_then(|(stream, _)| {
                stream.set_nodelay(true).ok()?;
                stream.set_nonblocking(true).ok()?;
                Some(stream)
            });
            self.restarted |= self.client.is_some();
        }
    }
}

impl Link for Tcp {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> usize {
        let Some(client) = &mut self.client else {
            self.accept(timeout);
            return 0;
        };
        if !ready(client, PollFlags::POLLIN, timeout) {
            return 0;
        }
        match client.read(buffer) {
            Ok(count) if count > 0 => count,
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
            _ => {
                self.client = None;
                0
            }
        }
    }

    fn restarted(&mut self) -> bool {
        std::mem::take(&mut self.restarted)
    }

    fn write(&mut self, mut bytes: &[u8]) {
        while let (Some(client), false) = (&mut self.client, bytes.is_empty()) {
            match client.write(bytes) {
                Ok(count) if count > 0 => bytes = &bytes[count..],
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    if !ready(client, PollFlags::POLLOUT, Duration::from_millis(100)) {
                        return;
                    }
                }
                _ => self.client = None,
            }
        }
    }
}
