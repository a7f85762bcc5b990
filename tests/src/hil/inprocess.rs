//! The controller in this process, on a virtual clock.

use super::{Bench, Target};
use daic_firmware::{Board, Controller, Sink};
use daic_protocol::channels::INTERLOCK;

/// Ticks of a byte at 1 Mbaud.
const BYTE_TICKS: u64 = 1250;

/// The controller with the Pico's limits.
pub struct InProcess {
    controller: Controller,
    boots: u32,
    now: u64,
    out: Words,
}

#[derive(Default)]
struct Words(Vec<(u64, u32)>);

impl Sink for Words {
    fn word(&mut self, tick: u64, word: u32) {
        self.0.push((tick, word));
    }
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

impl Default for InProcess {
    fn default() -> Self {
        let controller = Controller::new(Board::pico(), 1);
        let mut target = Self { controller, boots: 0, now: 0, out: Words::default() };
        target.restart();
        target
    }
}

impl Target for InProcess {
    fn name(&self) -> &'static str {
        "in-process"
    }

    fn exchange(&mut self, frame: &[u8]) -> Vec<u8> {
        self.pass(frame.len() as u64 * BYTE_TICKS);
        let mut answer = Vec::new();
        self.controller.receive(self.now, frame, &mut self.out, &mut |reply| answer.extend_from_slice(reply));
        self.pass(answer.len() as u64 * BYTE_TICKS);
        answer
    }

    fn pass(&mut self, ticks: u64) {
        self.now += ticks;
        self.controller.play(self.now, &mut self.out);
    }

    fn edges(&mut self) -> Option<Vec<(u64, u32)>> {
        Some(std::mem::take(&mut self.out.0))
    }

    fn edges_on_board_clock(&self) -> bool {
        true
    }

    fn bench(&mut self) -> Option<&mut dyn Bench> {
        None
    }

    fn restart(&mut self) {
        self.boots += 1;
        self.controller = Controller::new(Board::pico(), self.boots);
        (self.now, self.out) = (0, Words::default());
        self.controller.inputs(0, INTERLOCK, &mut self.out);
    }
}
