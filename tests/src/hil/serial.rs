//! A board at a serial port: the simulated one behind a PTY, or a real one.

use super::{Bench, Target};
use daic_firmware::pico::LEDS;
use daic_hil_sim::config::ClockMode;
use daic_hil_sim::{SimConfig, SimRig, Transport};
use std::io::{ErrorKind, Read, Write};
use std::time::{Duration, Instant};

/// A board at a port.
pub struct Serial {
    name: &'static str,
    port: Box<dyn serialport::SerialPort>,
    rig: Option<SimRig>,
    seen: usize,
}

fn open(path: &str) -> Result<Box<dyn serialport::SerialPort>, String> {
    serialport::new(path, 1_000_000)
        .timeout(Duration::from_millis(20))
        .open()
        .map_err(|error| format!("{path}: {error}"))
}

fn simulate() -> Result<(SimRig, Box<dyn serialport::SerialPort>), String> {
    let mut config = SimConfig { clock: ClockMode::Stepped { baud: 1_000_000 }, ..SimConfig::default() };
    // As many LEDs as the Pico has.
    config.board.leds.resize(usize::from(LEDS), Default::default());
    let rig = SimRig::start(config, Transport::Pty { link: None }).map_err(|error| error.to_string())?;
    rig.set_rendering(false);
    let port = open(rig.port())?;
    Ok((rig, port))
}

impl Serial {
    /// The simulated board behind a PTY.
    ///
    /// # Errors
    /// The rig does not start, or its port does not open.
    pub fn simulated() -> Result<Self, String> {
        let (rig, port) = simulate()?;
        Ok(Self { name: "pty", port, rig: Some(rig), seen: 0 })
    }

    /// A real board at `path`.
    ///
    /// # Errors
    /// The port does not open.
    pub fn real(path: &str) -> Result<Self, String> {
        Ok(Self { name: "board", port: open(path)?, rig: None, seen: 0 })
    }
}

impl Target for Serial {
    fn name(&self) -> &'static str {
        self.name
    }

    fn exchange(&mut self, frame: &[u8]) -> Vec<u8> {
        let mut answer = Vec::new();
        if self.port.write_all(frame).is_err() {
            return answer;
        }
        let end = Instant::now() + Duration::from_secs(5);
        let mut byte = [0];
        while Instant::now() < end {
            match self.port.read(&mut byte) {
                Ok(1) => answer.push(byte[0]),
                Ok(_) => {}
                Err(error) if matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {}
                Err(_) => break,
            }
            if answer.last() == Some(&0) {
                break;
            }
        }
        answer
    }

    fn pass(&mut self, ticks: u64) {
        if self.rig.is_none() {
            std::thread::sleep(Duration::from_nanos(8 * ticks));
        }
    }

    fn edges(&mut self) -> Option<Vec<(u64, u32)>> {
        let played = self.rig.as_ref()?.played();
        let new = played.get(self.seen..).unwrap_or(&[]).to_vec();
        self.seen = played.len();
        Some(new)
    }

    fn edges_on_board_clock(&self) -> bool {
        true
    }

    fn bench(&mut self) -> Option<&mut dyn Bench> {
        None
    }

    fn waits_for_streams(&self) -> bool {
        self.rig.is_some()
    }

    fn restart(&mut self) {
        if self.rig.is_some()
            && let Ok((rig, port)) = simulate()
        {
            (self.rig, self.port, self.seen) = (Some(rig), port, 0);
        }
    }
}
