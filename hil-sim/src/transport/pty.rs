//! A pseudo-terminal that a host opens like a serial port.
//!
//! The slave is kept open here too. Otherwise the master hangs up whenever a host closes, and bytes
//! still pending at the end are lost before the host has read them.

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::poll::PollFlags;
use nix::pty::openpty;
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
use nix::unistd::ttyname;

use crate::error::SimError;
use crate::transport::{Link, ready};

/// How long a write waits for a reader: beyond it bytes are dropped, as on a real line.
const WRITE_PATIENCE: Duration = Duration::from_millis(100);
/// How long the end waits for the host to read what is pending.
const DRAIN_PATIENCE: Duration = Duration::from_millis(300);

pub(crate) struct Pty {
    master: File,
    slave: OwnedFd,
    name: String,
    link: Option<PathBuf>,
}

impl Pty {
    pub(crate) fn open(link: Option<&Path>) -> Result<Self, SimError> {
        let failed = |e: nix::errno::Errno| SimError::Pty { cause: e.into() };
        let pair = openpty(None, None).map_err(failed)?;
        // Raw from the start: bytes may arrive before the host has configured its end.
        let mut settings = tcgetattr(&pair.slave).map_err(failed)?;
        cfmakeraw(&mut settings);
        tcsetattr(&pair.slave, SetArg::TCSANOW, &settings).map_err(failed)?;
        fcntl(&pair.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).map_err(failed)?;
        let name = ttyname(&pair.slave).map_err(failed)?.to_string_lossy().into_owned();
        if let Some(path) = link {
            make_link(&name, path).map_err(|cause| SimError::PtyLink { path: path.to_owned(), cause })?;
        }
        Ok(Self { master: pair.master.into(), slave: pair.slave, name, link: link.map(Path::to_owned) })
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }
}

/// Makes the link under another name first, so that it replaces an old one in one go. Anything but
/// a link is left alone.
fn make_link(target: &str, path: &Path) -> std::io::Result<()> {
    if path.symlink_metadata().is_ok_and(|m| !m.is_symlink()) {
        return Err(ErrorKind::AlreadyExists.into());
    }
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.tmp", std::process::id()));
    let temporary = PathBuf::from(temporary);
    std::os::unix::fs::symlink(target, &temporary)?;
    std::fs::rename(&temporary, path).inspect_err(|_| {
        std::fs::remove_file(&temporary).ok();
    })
}

impl Link for Pty {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> usize {
        if !ready(&self.master, PollFlags::POLLIN, timeout) {
            // A host that died keeps the port marked as exclusive while our slave is open, and an
            // ordinary user could never open it again. Living hosts still hold their file lock.
            rustix::termios::ioctl_tiocnxcl(&self.slave).ok();
            return 0;
        }
        self.master.read(buffer).unwrap_or(0)
    }

    fn write(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match self.master.write(bytes) {
                Ok(0) => return,
                Ok(count) => bytes = &bytes[count..],
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    if !ready(&self.master, PollFlags::POLLOUT, WRITE_PATIENCE) {
                        return;
                    }
                }
                Err(_) => return,
            }
        }
    }

    fn drain(&mut self) {
        let end = Instant::now() + DRAIN_PATIENCE;
        while rustix::io::ioctl_fionread(&self.slave).is_ok_and(|pending| pending > 0) && Instant::now() < end
        {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        if let Some(path) = &self.link {
            // Another instance may have taken the name over.
            if std::fs::read_link(path).is_ok_and(|target| target == Path::new(&self.name)) {
                std::fs::remove_file(path).ok();
            }
        }
    }
}
