//! Every way in which using a rig can fail.

use crate::camera::{CameraError, FrameError};
use crate::compile::CompileError;
use crate::experiment::ConfigError;
use crate::link::{LinkError, state_name};
use daic_protocol::message::{FaultCause, State};
use thiserror::Error;

/// Using a rig failed.
#[derive(Debug, Error)]
pub enum RigError {
    /// The experiment or optics file.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The sequence asks for what the box cannot do.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// The connection to the box.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The camera, while frames were fetched.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A frame of another size than the camera or the experiment says.
    #[error(
        "a frame has {} × {} pixels, not {} × {}; set width and height of [rig.camera] to those of the frames, or give the right frames",
        found[0], found[1], expected[0], expected[1]
    )]
    FrameSize {
        /// Columns and rows of the frame.
        found: [u32; 2],
        /// Columns and rows that it should have.
        expected: [u32; 2],
    },
    /// The box is busy.
    #[error("the box is {}: another run has not ended; wait for it, or stop it", state_name(*state))]
    NotReady {
        /// Its state.
        state: State,
    },
    /// The box stopped by itself or was told to abort.
    #[error("the box stopped safe at tick {tick} in instruction {instruction} ({})", cause_text(*cause))]
    BoxFaulted {
        /// Why.
        cause: FaultCause,
        /// When.
        tick: u64,
        /// Where in the program.
        instruction: u16,
    },
    /// The box plays another program than the one loaded.
    #[error("the box runs program {running:#010x}, not {loaded:#010x}; another host is using it")]
    OtherProgram {
        /// Hash of the program it runs.
        running: u32,
        /// Hash of the program that was loaded.
        loaded: u32,
    },
    /// The run ended with fewer or more events than the box counted.
    #[error(
        "the box counted {announced} events in this run, {received} were read; the record is not complete"
    )]
    TotalsDiffer {
        /// Events the box counted.
        announced: u32,
        /// Events read.
        received: u32,
    },
    /// Edges were not played as the program says.
    #[error(
        "frame {frame}: {what} is {played}, the plan says {planned}; firmware and program do not fit each other"
    )]
    PlayedOtherwise {
        /// Number of the trigger.
        frame: usize,
        /// Which figure.
        what: &'static str,
        /// As planned.
        planned: u64,
        /// As played.
        played: u64,
    },
    /// The run did not end in the time allowed.
    #[error("the run has not ended after {after_ms} ms; it was stopped")]
    RunTimeout {
        /// Time waited.
        after_ms: u64,
    },
    /// The user stopped the run.
    #[error("stopped on request; what was recorded until then is kept")]
    Cancelled,
    /// What was recorded could not be kept.
    #[error("cannot keep what was recorded: {source}; check free space and permissions of the output folder")]
    Sink {
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

impl RigError {
    /// Whether the input is to blame (exit code 2) rather than the rig (exit code 3).
    pub fn is_input(&self) -> bool {
        match self {
            Self::Config(_) | Self::Compile(_) | Self::FrameSize { .. } | Self::Sink { .. } => true,
            Self::Link(e) => e.is_input(),
            Self::Camera(e) => matches!(e, CameraError::Setting { .. }),
            Self::Frame(_)
            | Self::NotReady { .. }
            | Self::BoxFaulted { .. }
            | Self::OtherProgram { .. }
            | Self::TotalsDiffer { .. }
            | Self::PlayedOtherwise { .. }
            | Self::RunTimeout { .. }
            | Self::Cancelled => false,
        }
    }
}

fn cause_text(cause: FaultCause) -> String {
    let text = match cause {
        FaultCause::Aborted => "a host asked it to abort",
        FaultCause::Underrun => "its player ran dry",
        FaultCause::Internal => "the program broke a rule while running",
        FaultCause::HostLost => "it heard nothing from the host for longer than the program allows",
        FaultCause::Interlock => "its interlock opened",
        FaultCause::LimitSwitch { axis } => return format!("axis {axis} met its limit switch"),
        FaultCause::TriggerTimeout { input } => return format!("no trigger came on input {input} in time"),
        FaultCause::HomingFailed { axis } => return format!("axis {axis} did not find its home switch"),
        FaultCause::Heartbeat => "its processor did not report in time",
        FaultCause::LedLimit { led } => return format!("LED {led} was about to exceed a limit"),
    };
    text.to_owned()
}
