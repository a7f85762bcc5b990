//! The Pico's image in the emulator, in lockstep.

use super::{Bench, Target};
use daic_firmware::pico::{INTERLOCK, LINES};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// Longest time that an answer may take, in ticks: 0.64 s, for storing into flash.
const PATIENCE: u64 = 80_000_000;

/// From reset until requests are answered, in ticks (5 ms).
const BOOT: u64 = 625_000;

/// An emulated Pico.
pub struct Emulator {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    usb: bool,
    now: u64,
    levels: u32,
    words: Vec<(u64, u32)>,
    received: [Vec<u8>; 2],
    dead: bool,
}

impl Emulator {
    /// Starts the emulator in `directory` with the image `elf`; its packages are in `modules`.
    ///
    /// # Errors
    /// Node does not start.
    pub fn start(directory: &Path, modules: &Path, elf: &Path) -> Result<Self, String> {
        let mut child = Command::new("node")
            .arg(directory.join("main.mjs"))
            .arg(elf)
            .env("DAIC_EMULATOR_MODULES", modules)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("node: {error}"))?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err("no pipes to node".into());
        };
        let from = BufReader::new(from);
        let mut emulator = Self {
            child,
            to,
            from,
            usb: false,
            now: 0,
            levels: 0,
            words: Vec::new(),
            received: Default::default(),
            dead: false,
        };
        emulator.restart();
        Ok(emulator)
    }

    fn link_name(&self) -> &'static str {
        if self.usb { "usb" } else { "uart" }
    }

    /// Carries out a command and takes in what has happened.
    fn command(&mut self, command: &Value) -> Value {
        let mut line = String::new();
        let sent = writeln!(self.to, "{command}").and_then(|()| self.to.flush());
        let read = sent.and_then(|()| self.from.read_line(&mut line));
        let answer: Value = match read {
            Ok(count) if count > 0 => serde_json::from_str(&line).expect("the emulator answers in JSON"),
            other => panic!("the emulator has ended: {other:?}"),
        };
        self.now = answer["cycle"].as_u64().expect("a count");
        for (index, link) in ["uart", "usb"].into_iter().enumerate() {
            let hex = answer[link].as_str().unwrap_or_default();
            let bytes =
                (0..hex.len() / 2).filter_map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).ok());
            self.received[index].extend(bytes);
        }
        for edge in answer["edges"].as_array().into_iter().flatten() {
            let [at, gpio, level] = [0, 1, 2].map(|i| edge[i].as_u64().unwrap_or(u64::MAX));
            let Some(line) = LINES.iter().find(|line| u64::from(line.1) == gpio) else { continue };
            let bit = 1 << line.0;
            // Not driven is low: that is what the pull-downs at the drivers are for.
            let levels = if level == 1 { self.levels | bit } else { self.levels & !bit };
            if levels != self.levels {
                self.levels = levels;
                match self.words.last_mut() {
                    Some(last) if last.0 == at => last.1 = levels,
                    _ => self.words.push((at, levels)),
                }
            }
        }
        self.dead |= answer["cut"].is_string();
        answer
    }

    fn run(&mut self, ticks: u64, until: Option<&str>) {
        if !self.dead {
            self.command(&json!({ "op": "run", "ticks": ticks, "until": until }));
        }
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Target for Emulator {
    fn name(&self) -> &'static str {
        "pico"
    }

    fn exchange(&mut self, frame: &[u8]) -> Vec<u8> {
        let hex: String = frame.iter().map(|byte| format!("{byte:02x}")).collect();
        let link = self.link_name();
        if !frame.is_empty() {
            self.received[usize::from(self.usb)].clear();
            self.command(&json!({ "op": "send", "link": link, "hex": hex }));
        }
        self.run(PATIENCE, Some(link));
        std::mem::take(&mut self.received[usize::from(self.usb)])
    }

    fn pass(&mut self, ticks: u64) {
        self.run(ticks, None);
    }

    fn edges(&mut self) -> Option<Vec<(u64, u32)>> {
        Some(std::mem::take(&mut self.words))
    }

    fn edges_on_board_clock(&self) -> bool {
        false
    }

    fn bench(&mut self) -> Option<&mut dyn Bench> {
        Some(self)
    }

    fn restart(&mut self) {
        let usb = self.usb;
        self.command(&json!({ "op": "boot", "usb": usb }));
        self.dead = false;
        self.levels = 0;
        self.input(INTERLOCK, true);
        // Until it has booted; with USB until a host has found it.
        self.run(if usb { 5_000_000 } else { BOOT }, None);
        self.words.clear();
        self.received = Default::default();
    }
}

impl Bench for Emulator {
    fn now(&mut self) -> u64 {
        self.now
    }

    fn input(&mut self, gpio: u8, level: bool) {
        self.command(&json!({ "op": "input", "gpio": gpio, "level": u8::from(level) }));
    }

    fn halt_core(&mut self, from: u64) {
        self.command(&json!({ "op": "stall", "from": from }));
    }

    fn stall_core(&mut self, from: u64, to: u64) {
        self.command(&json!({ "op": "stall", "from": from, "to": to }));
    }

    fn reset(&mut self) {
        self.command(&json!({ "op": "reset" }));
    }

    fn power_cycle(&mut self) {
        self.dead = false;
        self.command(&json!({ "op": "power" }));
        self.levels = 0;
        self.words.clear();
        self.run(BOOT, None);
        self.received = Default::default();
    }

    fn cut_power(&mut self, operation: usize, part: f64) {
        self.command(&json!({ "op": "cut", "operation": operation, "part": part }));
    }

    fn flash_operations(&mut self) -> Vec<(String, u64)> {
        let answer = self.command(&json!({ "op": "operations" }));
        let list = answer["operations"].as_array().cloned().unwrap_or_default();
        list.iter()
            .map(|o| (o[0].as_str().unwrap_or_default().to_owned(), o[1].as_u64().unwrap_or(0)))
            .collect()
    }

    fn is_dead(&mut self) -> bool {
        self.dead
    }

    fn slip(&mut self, at: u64) {
        self.command(&json!({ "op": "slip", "at": at }));
    }

    fn link(&mut self, usb: bool) {
        if usb != self.usb {
            self.usb = usb;
            self.restart();
        }
    }

    fn wire(&mut self, from: u8, to: u8) {
        self.command(&json!({ "op": "wire", "from": from, "to": to }));
    }

    fn duty(&mut self) -> [f64; 4] {
        let answer = self.command(&json!({ "op": "duty" }));
        [0, 1, 2, 3].map(|i| answer["duty"][i].as_f64().unwrap_or(f64::NAN))
    }
}
