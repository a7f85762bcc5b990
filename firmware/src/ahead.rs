//! The words of a run before their time, for a player in hardware.
//!
//! A [`Controller`] plays up to the present; what it reports has happened. A player in hardware
//! wants the words beforehand. As nothing that is played depends on how `play` is called, a second
//! cursor over the same program, running ahead, finds the same words at the same ticks.

use crate::Sink;
use crate::controller::Controller;
use crate::outputs::Outputs;
use crate::timeline::{Player, Progress};

/// What looking ahead came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reached {
    /// Nothing comes before the tick given.
    Waiting(u64),
    /// The run ends at the tick given, and every output is safe from there on.
    Ended(u64),
    /// The program does something that the verifier should have refused.
    Broken,
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
    /// Tick of the next thing to be done.
    pub fn due(&self) -> u64 {
        self.player.due()
    }

    /// Puts out every word due up to and including `until` of the run that `controller` is playing.
    ///
    /// Levels of LEDs are put out too, events are not.
    pub fn play(&mut self, until: u64, controller: &Controller, sink: &mut dyn Sink) -> Reached {
        if let Some(from) = controller.stop_from() {
            self.player.stop(from);
        }
        match self.player.play(until, controller.program_bytes(), &mut self.out, sink) {
            Progress::Waiting(tick) => Reached::Waiting(tick),
            Progress::Ended(tick) => {
                self.out.make_safe(tick, sink);
                Reached::Ended(tick)
            }
            Progress::Broken => Reached::Broken,
        }
    }
}
