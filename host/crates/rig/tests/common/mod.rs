//! The real controller in a thread, behind an in-process pipe or a pseudo-terminal, with faults.
#![allow(dead_code)]

use daic_firmware::{Board, Controller, Sink};
use daic_protocol::limits::TICK_HZ;
use daic_rig::link::{PipeEnd, Transport, pipe};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What can be done to the box while it runs.
#[derive(Default)]
pub struct Faults {
    /// Replies still to be lost.
    pub lose_replies: AtomicU32,
    /// Replies still to be sent twice.
    pub double_replies: AtomicU32,
    /// Nothing is answered any more.
    pub silent: AtomicBool,
    /// Boot anew at the next request, which goes unanswered.
    pub reset: AtomicBool,
    /// Everything received is sent back as it came, and nothing else.
    pub echo: AtomicBool,
    stop: AtomicBool,
    /// Words put out: (boot, tick, word).
    pub words: Mutex<Vec<(u32, u64, u32)>>,
    /// Runs begun, over all boots.
    pub starts: AtomicU32,
}

struct Recorder<'a> {
    faults: &'a Faults,
    boot: u32,
}

impl Sink for Recorder<'_> {
    fn word(&mut self, tick: u64, word: u32) {
        self.faults.words.lock().expect("words").push((self.boot, tick, word));
    }
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

pub struct TestBox {
    pub faults: Arc<Faults>,
    thread: Option<JoinHandle<()>>,
}

impl TestBox {
    /// Serves whatever `io` connects to. Ticks follow the wall clock.
    pub fn serve(mut io: Box<dyn Transport>) -> Self {
        let faults = Arc::new(Faults::default());
        let shared = faults.clone();
        let thread = std::thread::spawn(move || run(io.as_mut(), &shared));
        Self { faults, thread: Some(thread) }
    }

    /// A box and the host's end of a pipe to it.
    pub fn piped() -> (Self, PipeEnd) {
        let (ours, theirs) = pipe();
        (Self::serve(Box::new(theirs)), ours)
    }
}

impl Drop for TestBox {
    fn drop(&mut self) {
        self.faults.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("box thread");
        }
    }
}

fn take(counter: &AtomicU32) -> bool {
    counter.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok()
}

fn run(io: &mut dyn Transport, faults: &Faults) {
    let mut boot = 1;
    let mut controller = Controller::new(Board::reference().simulated(), boot);
    let mut begin = Instant::now();
    let mut runs = 0;
    let mut buffer = [0; 512];
    while !faults.stop.load(Ordering::SeqCst) {
        let n = match io.read(&mut buffer, Duration::from_millis(1)) {
            Ok(n) => n,
            Err(_) => return,
        };
        let bytes = &buffer[..n];
        if faults.echo.load(Ordering::SeqCst) {
            let _ = io.write(bytes, Duration::from_secs(1));
            continue;
        }
        if n > 1 && faults.reset.swap(false, Ordering::SeqCst) {
            boot += 1;
            controller = Controller::new(Board::reference().simulated(), boot);
            begin = Instant::now();
            runs = 0;
            continue;
        }
        let now = (begin.elapsed().as_nanos() * u128::from(TICK_HZ) / 1_000_000_000) as u64;
        let mut sink = Recorder { faults, boot };
        controller.play(now, &mut sink);
        let mut replies = Vec::new();
        controller.receive(now, bytes, &mut sink, &mut |reply| replies.push(reply.to_vec()));
        if controller.run() != runs {
            runs = controller.run();
            faults.starts.fetch_add(1, Ordering::SeqCst);
        }
        for reply in replies {
            if faults.silent.load(Ordering::SeqCst) || take(&faults.lose_replies) {
                continue;
            }
            let copies = if take(&faults.double_replies) { 2 } else { 1 };
            for _ in 0..copies {
                if io.write(&reply, Duration::from_secs(1)).is_err() {
                    return;
                }
            }
        }
    }
}

#[cfg(unix)]
pub mod pty {
    use daic_rig::link::Transport;
    use nix::fcntl::{FcntlArg, OFlag, fcntl};
    use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
    use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
    use std::fs::File;
    use std::io::{self, Read, Write};
    use std::os::fd::{AsFd, OwnedFd};
    use std::time::Duration;

    /// The box's side of a pseudo-terminal. The other side stays open, so that a host that comes
    /// and goes does not hang it up.
    pub struct Master {
        file: File,
        _keep: OwnedFd,
    }

    /// A pseudo-terminal and the path a host opens.
    pub fn open() -> (Master, String) {
        let pair = nix::pty::openpty(None, None).expect("openpty");
        let mut settings = tcgetattr(&pair.slave).expect("tcgetattr");
        cfmakeraw(&mut settings);
        tcsetattr(&pair.slave, SetArg::TCSANOW, &settings).expect("tcsetattr");
        let path = nix::unistd::ttyname(&pair.slave).expect("ttyname").to_string_lossy().into_owned();
        fcntl(&pair.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).expect("fcntl");
        (Master { file: File::from(pair.master), _keep: pair.slave }, path)
    }

    impl Transport for Master {
        fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
            let ms = u16::try_from(timeout.as_millis()).unwrap_or(u16::MAX);
            let mut fds = [PollFd::new(self.file.as_fd(), PollFlags::POLLIN)];
            if poll(&mut fds, PollTimeout::from(ms))? == 0 {
                return Ok(0);
            }
            match self.file.read(buffer) {
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(0),
                other => other,
            }
        }
        fn write(&mut self, bytes: &[u8], _: Duration) -> io::Result<()> {
            self.file.write_all(bytes)
        }
    }
}
