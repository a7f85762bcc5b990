//! `hil-sim`: the simulated rig as a program. It prints its port and runs until it is stopped.
#![warn(clippy::unwrap_used)]

mod frame_writer;

use std::io::{Read, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::{Sender, channel};

use clap::Parser;
use nix::sys::signal::{SigSet, Signal};

use daic_hil_sim::{ConfigError, SimConfig, SimError, SimRig, Transport};
use frame_writer::FrameWriter;

/// A simulated rig: the daic firmware in front of a simulated stage, LEDs, grating, specimen and camera.
///
/// Prints one line, `port: …`, and runs until SIGINT or SIGTERM.
#[derive(Debug, Parser)]
#[command(name = "hil-sim", version)]
struct Arguments {
    /// Offer the box on a pseudo-terminal (the default).
    #[arg(long, conflicts_with = "tcp")]
    pty: bool,
    /// Offer the box on this TCP address, e.g. 127.0.0.1:0 (port 0: any free one).
    #[arg(long, value_name = "ADDRESS")]
    tcp: Option<String>,
    /// Name under which the pseudo-terminal is also to be found (a symbolic link).
    #[arg(long, value_name = "PATH", conflicts_with = "tcp")]
    link: Option<PathBuf>,
    /// Seed of texture, noise and boot ids; overrides the scene file's.
    #[arg(long)]
    seed: Option<u64>,
    /// Scene, camera, board and faults; see --print-scene.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Print the scene that would be used, as TOML, and stop.
    #[arg(long)]
    print_scene: bool,
    /// Write every frame into this directory (16-bit TIFF and a line in frames.jsonl).
    #[arg(long, value_name = "DIR")]
    frames: Option<PathBuf>,
    /// Write what the box put out into this file at the end (value change dump).
    #[arg(long, value_name = "FILE")]
    vcd: Option<PathBuf>,
    /// Also stop when standard input ends.
    #[arg(long)]
    until_eof: bool,
}

#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error("{} cannot be read: {cause}", path.display())]
    SceneUnreadable { path: PathBuf, cause: std::io::Error },
    #[error("{}: {cause}", path.display())]
    SceneRefused { path: PathBuf, cause: ConfigError },
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Rig(#[from] SimError),
    #[error("--frames {}: the directory cannot be made: {cause}", path.display())]
    FramesDirectory { path: PathBuf, cause: std::io::Error },
    #[error("signals cannot be waited for: {0}")]
    Signals(nix::errno::Errno),
    #[error("{} cannot be written: {cause}", path.display())]
    Unwritable { path: PathBuf, cause: std::io::Error },
    #[error("standard output cannot be written: {0}")]
    Stdout(std::io::Error),
}

impl Failure {
    /// 2: what was given cannot be used; 3: the rig cannot run.
    fn code(&self) -> u8 {
        match self {
            Self::SceneUnreadable { .. }
            | Self::SceneRefused { .. }
            | Self::Config(_)
            | Self::FramesDirectory { .. }
            | Self::Rig(SimError::Config(_) | SimError::Tcp { .. } | SimError::PtyLink { .. }) => 2,
            _ => 3,
        }
    }
}

/// Why the program ends.
enum End {
    Asked,
    Failed(Failure),
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("hil-sim: {failure}");
            ExitCode::from(failure.code())
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Failure> {
    let mut config = match &arguments.scene {
        None => SimConfig::default(),
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .map_err(|cause| Failure::SceneUnreadable { path: path.clone(), cause })?;
            SimConfig::from_toml(&text)
                .map_err(|cause| Failure::SceneRefused { path: path.clone(), cause })?
        }
    };
    config.seed = arguments.seed.unwrap_or(config.seed);
    if arguments.print_scene {
        let text = config.to_toml()?;
        return std::io::stdout().write_all(text.as_bytes()).map_err(Failure::Stdout);
    }

    // Blocked before any thread is there, so that only the one that waits for them gets them.
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGINT);
    signals.add(Signal::SIGTERM);
    signals.thread_block().map_err(Failure::Signals)?;

    let transport = match &arguments.tcp {
        Some(address) => Transport::Tcp { address: address.clone() },
        None => Transport::Pty { link: arguments.link.clone() },
    };
    let writer = arguments.frames.as_deref().map(open_frames).transpose()?;
    let mut rig = SimRig::start(config, transport)?;
    let (end, ended) = channel();
    let writing = match (writer, rig.take_frames()) {
        (Some(mut writer), Some(frames)) => {
            let end = end.clone();
            Some(std::thread::spawn(move || {
                for frame in frames {
                    if let Err(cause) = writer.write(&frame) {
                        let path = writer.directory().to_owned();
                        end.send(End::Failed(Failure::Unwritable { path, cause })).ok();
                        return;
                    }
                }
            }))
        }
        _ => {
            rig.set_rendering(false);
            None
        }
    };
    writeln!(std::io::stdout(), "port: {}", rig.port()).map_err(Failure::Stdout)?;
    wait_in_background(arguments.until_eof, signals, end);
    let result = match ended.recv() {
        Ok(End::Failed(failure)) => Err(failure),
        Ok(End::Asked) | Err(_) => Ok(()),
    };
    if let Some(path) = &arguments.vcd {
        let mut text = Vec::new();
        rig.record()
            .write_vcd(&mut text)
            .and_then(|()| frame_writer::replace(path, &text))
            .map_err(|cause| Failure::Unwritable { path: path.clone(), cause })?;
    }
    rig.stop();
    if let Some(writing) = writing {
        // Frames already taken are still written.
        writing.join().ok();
    }
    result
}

fn open_frames(directory: &std::path::Path) -> Result<FrameWriter, Failure> {
    FrameWriter::open(directory)
        .map_err(|cause| Failure::FramesDirectory { path: directory.to_owned(), cause })
}

fn wait_in_background(until_eof: bool, signals: SigSet, end: Sender<End>) {
    if until_eof {
        let end = end.clone();
        std::thread::spawn(move || {
            let mut buffer = [0; 256];
            while std::io::stdin().read(&mut buffer).is_ok_and(|count| count > 0) {}
            end.send(End::Asked).ok();
        });
    }
    std::thread::spawn(move || {
        let outcome = signals.wait().map_or_else(|e| End::Failed(Failure::Signals(e)), |_| End::Asked);
        end.send(outcome).ok();
    });
}
