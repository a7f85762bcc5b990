//! What is on this machine, and whether the box at a port is ours.

use crate::error::Error;
use daic_rig::link::{Link, LinkOptions, available_ports};
use serde::Serialize;
use std::fmt;

/// What `daic doctor` found.
#[derive(Debug, Clone, Serialize)]
pub struct Findings {
    /// Version of the program.
    pub daic: String,
    /// Threads that computations get.
    pub threads: usize,
    /// Widest SIMD level that the correlation uses here.
    pub simd: String,
    /// Serial ports that the system lists (pseudo-terminals are never listed).
    pub ports: Vec<String>,
    /// Where frames can come from.
    pub cameras: Vec<&'static str>,
    /// Whether the simulated rig is built in.
    pub simulated_rig: bool,
    /// Who answers at the port asked for.
    pub board: Option<Board>,
}

/// A trigger box.
#[derive(Debug, Clone, Serialize)]
pub struct Board {
    /// Port.
    pub port: String,
    /// Board name.
    pub name: String,
    /// Firmware version.
    pub firmware: String,
    /// Version of the wire format.
    pub protocol: u16,
    /// Ticks per second.
    pub tick_hz: u32,
    /// LEDs, cameras, axes, inputs.
    pub lines: [u8; 4],
}

/// Looks.
///
/// # Errors
/// What is wrong with the port, if one was asked for.
pub fn look(port: Option<&str>) -> Result<Findings, Error> {
    let board = port.map(ask).transpose()?;
    Ok(Findings {
        daic: env!("CARGO_PKG_VERSION").to_owned(),
        threads: rayon::current_num_threads(),
        simd: daic_correlate::simd_level(),
        ports: available_ports(),
        cameras: if cfg!(feature = "sim") { vec!["sim", "folder"] } else { vec!["folder"] },
        simulated_rig: cfg!(feature = "sim"),
        board,
    })
}

fn ask(port: &str) -> Result<Board, Error> {
    let link = Link::open(port, LinkOptions::default()).map_err(daic_rig::RigError::from)?;
    let hello = link.hello();
    Ok(Board {
        port: port.to_owned(),
        name: hello.board.as_str().to_owned(),
        firmware: hello.firmware.as_str().to_owned(),
        protocol: hello.protocol,
        tick_hz: hello.tick_hz,
        lines: [hello.leds, hello.cameras, hello.axes, hello.inputs],
    })
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "daic           {}", self.daic)?;
        writeln!(f, "threads        {}", self.threads)?;
        writeln!(f, "SIMD           {}", self.simd)?;
        let ports = if self.ports.is_empty() { "none listed".to_owned() } else { self.ports.join(", ") };
        writeln!(f, "serial ports   {ports}")?;
        writeln!(f, "cameras        {}", self.cameras.join(", "))?;
        writeln!(
            f,
            "simulated rig  {}",
            if self.simulated_rig { "built in" } else { "left out of this build" }
        )?;
        match &self.board {
            Some(b) => write!(
                f,
                "box            {} at {}, firmware {}, protocol {}, {} ticks/s; {} LEDs, {} cameras, {} axes, {} inputs",
                b.name,
                b.port,
                b.firmware,
                b.protocol,
                b.tick_hz,
                b.lines[0],
                b.lines[1],
                b.lines[2],
                b.lines[3]
            ),
            None => write!(f, "box            not asked (--port)"),
        }
    }
}
