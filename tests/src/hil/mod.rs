//! Hardware in the loop: the same cases on the controller in this process, on the simulated board
//! behind a PTY, on the Pico's image in an emulator, and on a real board.
//!
//! A case that a target cannot show says so by name, with the reason.

pub mod cases;
pub mod emulator;
pub mod host;
pub mod inprocess;
#[path = "../../../firmware/tests/common/naive.rs"]
#[allow(dead_code, missing_docs)]
mod naive;
pub mod serial;

pub use host::Host;

use crate::expansion::{changes_only, expand};
use daic_firmware::Board;
use daic_protocol::program::Instruction;

/// What a target is made of and how it is reached.
pub trait Target {
    /// For the output.
    fn name(&self) -> &'static str;
    /// Sends a frame and gives whatever came back until a frame was whole; nothing on silence.
    fn exchange(&mut self, frame: &[u8]) -> Vec<u8>;
    /// Lets time pass, where time can be made to.
    fn pass(&mut self, ticks: u64);
    /// Changes of the output word since last asked, as (tick, word); `None` where nobody watches.
    fn edges(&mut self) -> Option<Vec<(u64, u32)>>;
    /// Whether ticks of edges are those of the board's own clock.
    fn edges_on_board_clock(&self) -> bool;
    /// Instruments around the board.
    fn bench(&mut self) -> Option<&mut dyn Bench>;
    /// A fresh board.
    fn restart(&mut self);
    /// Time stands still while a stream has nothing to play.
    fn waits_for_streams(&self) -> bool {
        false
    }
}

/// What can be done to a board from outside. Times are ticks of the recorder.
pub trait Bench {
    /// Time now.
    fn now(&mut self) -> u64;
    /// Sets an input pin.
    fn input(&mut self, gpio: u8, level: bool);
    /// From `from` on the processor executes nothing.
    fn halt_core(&mut self, from: u64);
    /// From `from` until `to` the processor executes nothing.
    fn stall_core(&mut self, from: u64, to: u64);
    /// Pulls the reset pin.
    fn reset(&mut self);
    /// Power off and on.
    fn power_cycle(&mut self);
    /// Flash operation `operation` (from power-up on) is done to this part only, and power is gone.
    fn cut_power(&mut self, operation: usize, part: f64);
    /// Flash operations since power-up.
    fn flash_operations(&mut self) -> Vec<(String, u64)>;
    /// Whether power is gone.
    fn is_dead(&mut self) -> bool;
    /// The player misses one clock at this time.
    fn slip(&mut self, at: u64);
    /// Which link is used from now on.
    fn link(&mut self, usb: bool);
    /// Connects an output to an input.
    fn wire(&mut self, from: u8, to: u8);
    /// Duty cycle of each level output.
    fn duty(&mut self) -> [f64; 4];
}

/// How a case ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It held, with what was measured: name, value, unit.
    Passed(Vec<(&'static str, f64, &'static str)>),
    /// This target cannot show it, and why.
    Cannot(&'static str),
    /// It did not hold.
    Failed(String),
}

/// One case.
pub struct Case {
    /// Name.
    pub name: &'static str,
    /// What it shows.
    pub run: fn(&mut Host, bool) -> Result<Outcome, String>,
}

/// Runs every case (or those whose name contains `filter`) on a target, prints each, returns the outcomes.
pub fn run(target: Box<dyn Target>, long: bool, filter: &str) -> Vec<(&'static str, Outcome)> {
    let mut host = Host::new(target);
    let name = host.target.name();
    let mut outcomes = Vec::new();
    for case in cases::ALL.iter().filter(|case| case.name.contains(filter)) {
        let start = std::time::Instant::now();
        host.restart();
        let outcome = (case.run)(&mut host, long).unwrap_or_else(Outcome::Failed);
        let took = start.elapsed().as_secs_f64();
        match &outcome {
            Outcome::Passed(numbers) => {
                let numbers: Vec<String> =
                    numbers.iter().map(|(what, value, unit)| format!("{what} {value} {unit}")).collect();
                println!("hil {name}: passed {} ({took:.1} s) {}", case.name, numbers.join(", "));
            }
            Outcome::Cannot(why) => println!("hil {name}: CANNOT {}: {why}", case.name),
            Outcome::Failed(why) => println!("hil {name}: FAILED {} ({took:.1} s): {why}", case.name),
        }
        outcomes.push((case.name, outcome));
    }
    outcomes
}

/// What a program comes to, without the code of firmware or host: changes of the output word as (tick after the
/// begin of the run, word).
pub fn expected(program: &[Instruction]) -> Vec<(u64, u32)> {
    use Instruction::{Capture, Go, Join, Move, Reach};
    let harder = |i: &Instruction| {
        matches!(i, Capture { .. } | Go { .. } | Join { .. } | Reach)
            || matches!(i, Move { jerk, .. } if *jerk > 0)
    };
    if program.iter().any(harder) {
        return changes_only(&naive::play(program, &Board::pico(), 0, [0; 6], 0, 0).words);
    }
    expand(program)
}
