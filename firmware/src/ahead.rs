//! The words of a run before their time, for a player in hardware.
//!
//! A [`Controller`] plays up to the present; what it reports has happened. A player in hardware
//! wants the words beforehand. As nothing that is played depends on how `play` is called, a second
//! cursor over the same program, running ahead, finds the same words at the same ticks.

use crate::Sink;
use crate::controller::Controller;
use crate::outputs::Outputs;
use crate::player::{Player, Progress, Stage, trigger_edges};

/// What looking ahead came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reached {
    /// Nothing comes before the tick given.
    Waiting(u64),
    /// The next instruction of a stream has not come; it begins at the tick given.
    Dry(u64),
    /// The run ends at the tick given, and every output is safe from there on.
    Ended(u64),
    /// The run cannot go on; the controller, when it gets there, halts the outputs.
    Failed,
}

/// A cursor that runs ahead of the controller's.
#[derive(Debug)]
pub struct Ahead {
    player: Player,
    out: Outputs,
}

impl Controller {
    /// A cursor at the controller's place in the run, if one is under way.
    pub fn ahead(&self) -> Option<Ahead> {
        let (player, out) = self.cursor()?;
        Some(Ahead { player: player.clone(), out: out.clone() })
    }
}

impl Ahead {
    /// Nothing comes before this tick of the run that `controller` is playing.
    pub fn due(&self, controller: &Controller) -> u64 {
        let known = self.out.inputs.known;
        self.player.due_knowing(&self.out, controller.host_ahead(), known).unwrap_or(known)
    }

    /// Puts out every word due up to and including `until` of the run that `controller` is playing; inputs
    /// have not changed up to and including `known` but for what [`Ahead::inputs`] was told.
    ///
    /// Levels of LEDs are put out too, events are not. Limit switches are left to the controller.
    pub fn play(&mut self, until: u64, known: u64, controller: &Controller, sink: &mut dyn Sink) -> Reached {
        if let Some(from) = controller.stop_from() {
            self.player.stop(from);
        }
        self.out.inputs.known = self.out.inputs.known.max(known);
        let (board, host) = (controller.board(), controller.host_ahead());
        let mut stage = Stage { board, out: &mut self.out, sink, host, blind: true };
        match self.player.play(until, known, controller.source_ahead(), &mut stage) {
            Progress::Waiting => Reached::Waiting(self.due(controller)),
            Progress::Later(tick) => Reached::Dry(tick),
            Progress::Ended(tick) => {
                self.out.make_safe(tick, board, sink);
                Reached::Ended(tick)
            }
            Progress::Failed(_, tick) => {
                let tick = self.out.earliest_safe(tick.max(self.out.last()));
                // The answer to an input comes too late to be put into the player.
                if tick <= known {
                    return Reached::Failed;
                }
                self.out.make_safe(tick, board, sink);
                Reached::Ended(tick)
            }
            Progress::Broken => Reached::Failed,
        }
    }

    /// The input word is `word` from tick `tick` on, as told to the controller.
    pub fn inputs(&mut self, tick: u64, word: u32, controller: &Controller, sink: &mut dyn Sink) {
        let tick = tick.max(self.out.inputs.known);
        self.play(tick, tick.saturating_sub(1), controller, sink);
        let before = self.out.inputs.word;
        self.out.inputs.word = word;
        for (input, rising) in trigger_edges(before, word) {
            self.player.trigger(tick, input, rising, &self.out);
        }
        self.player.look_again(tick, &self.out);
    }
}
