//! How a host reaches the simulated box.

mod duplex;
mod pty;
mod tcp;

pub(crate) use duplex::Connector;
pub use duplex::DuplexEnd;

use std::os::fd::AsFd;
use std::path::PathBuf;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use crate::error::SimError;

/// Where the box is offered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Transport {
    /// A pipe within the process, see [`SimRig::connect`](crate::rig::SimRig::connect).
    InProcess,
    /// A pseudo-terminal, to be opened like a serial port.
    Pty {
        /// Also reachable under this name (a symbolic link, removed at the end).
        link: Option<PathBuf>,
    },
    /// A TCP port; one host at a time, the next one waits.
    Tcp {
        /// Address and port to listen on, with or without `tcp://`; port 0 takes a free one.
        address: String,
    },
}

/// The box's end of a link. Hosts may come and go.
pub(crate) trait Link: Send {
    /// Bytes received, 0 if none came within `timeout`.
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> usize;
    /// Sends bytes; drops them if nobody takes them for a while, as a UART does.
    fn write(&mut self, bytes: &[u8]);
    /// Whether another host has come since the last call; only some links can tell.
    fn restarted(&mut self) -> bool {
        false
    }
    /// Lets the host read what was sent, for a short time, before the link goes away.
    fn drain(&mut self) {}
}

/// An open link and what a host needs to reach it.
pub(crate) struct Opened {
    pub(crate) link: Box<dyn Link>,
    pub(crate) port: String,
    pub(crate) connector: Option<Connector>,
}

pub(crate) fn open(transport: &Transport) -> Result<Opened, SimError> {
    match transport {
        Transport::InProcess => {
            let (link, connector) = duplex::board_end();
            Ok(Opened { link: Box::new(link), port: "in-process".to_owned(), connector: Some(connector) })
        }
        Transport::Pty { link } => {
            let pty = pty::Pty::open(link.as_deref())?;
            Ok(Opened { port: pty.name().to_owned(), link: Box::new(pty), connector: None })
        }
        Transport::Tcp { address } => {
            let tcp = tcp::Tcp::listen(address)?;
            Ok(Opened { port: tcp.address().to_owned(), link: Box::new(tcp), connector: None })
        }
    }
}

/// Waits until one of `events` holds; an interrupted wait counts as none.
fn ready(fd: &impl AsFd, events: PollFlags, timeout: Duration) -> bool {
    let timeout = PollTimeout::try_from(timeout).unwrap_or(PollTimeout::MAX);
    let mut fds = [PollFd::new(fd.as_fd(), events)];
    poll(&mut fds, timeout).is_ok_and(|n| n > 0)
}
