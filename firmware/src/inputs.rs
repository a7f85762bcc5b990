//! What the inputs say: levels, stamps, counters, exposures compared with triggers.

use crate::outputs::AXES;
use daic_protocol::channels::{self, CAMERAS, INPUTS};
use daic_protocol::message::EventKind;
use heapless::Deque;

/// Camera triggers kept until their exposure has begun.
const TRIGGERS_KEPT: usize = 8;

/// Levels and counters.
#[derive(Debug, Clone)]
pub(crate) struct InputLog {
    /// The input word at tick `known`.
    pub(crate) word: u32,
    /// The inputs are known up to this tick.
    pub(crate) known: u64,
    pub(crate) rising: [u32; INPUTS as usize],
    pub(crate) missed: [u32; INPUTS as usize],
    cameras: [Exposure; CAMERAS as usize],
}

/// One camera.
#[derive(Debug, Clone)]
struct Exposure {
    triggers: Deque<u64, TRIGGERS_KEPT>,
    began: Option<u64>,
    /// The line has changed since boot: there is one.
    seen: bool,
}

impl InputLog {
    pub(crate) const fn new() -> Self {
        const IDLE: Exposure = Exposure { triggers: Deque::new(), began: None, seen: false };
        Self {
            word: 0,
            known: 0,
            rising: [0; INPUTS as usize],
            missed: [0; INPUTS as usize],
            cameras: [IDLE; CAMERAS as usize],
        }
    }

    /// Whether all bits of `mask` are high.
    pub(crate) fn is_high(&self, mask: Option<u32>) -> bool {
        mask.is_some_and(|mask| self.word & mask == mask)
    }

    pub(crate) fn missed(&self, input: u8) -> u32 {
        self.missed.get(usize::from(input)).copied().unwrap_or(0)
    }

    /// Nothing waited for this trigger.
    pub(crate) fn miss(&mut self, input: u8) {
        if let Some(count) = self.missed.get_mut(usize::from(input)) {
            *count = count.saturating_add(1);
        }
    }

    pub(crate) fn count_rising(&mut self, risen: u32) {
        for (input, count) in (0u8..).zip(&mut self.rising) {
            if channels::trigger_input(input).is_some_and(|bit| risen & bit != 0) {
                *count = count.saturating_add(1);
            }
        }
    }

    /// A word goes out: camera triggers in it are remembered.
    pub(crate) fn triggered(&mut self, tick: u64, risen: u32, note: &mut dyn FnMut(EventKind)) {
        for (camera, exposure) in (0u8..).zip(&mut self.cameras) {
            if channels::camera(camera).is_some_and(|bit| risen & bit != 0) {
                if exposure.triggers.is_full()
                    && let Some(lost) = exposure.triggers.pop_front()
                    && exposure.seen
                {
                    note(EventKind::ExposureMissing { camera, after: ticks(lost, tick) });
                }
                // There is room: one was taken out above.
                let _ = exposure.triggers.push_back(tick);
            }
        }
    }

    /// Exposure-active lines change at `tick`; `changed` are the bits that do.
    pub(crate) fn exposures(&mut self, tick: u64, changed: u32, note: &mut dyn FnMut(EventKind)) {
        for (camera, exposure) in (0u8..).zip(&mut self.cameras) {
            let Some(bit) = channels::exposure_active(camera).filter(|bit| changed & bit != 0) else {
                continue;
            };
            exposure.seen = true;
            if self.word & bit == 0 {
                if let Some(began) = exposure.began.take() {
                    note(EventKind::ExposureEnded { camera, length: ticks(began, tick) });
                }
                continue;
            }
            // The last trigger up to now caused it; those before it caused none.
            let mut cause = None;
            while exposure.triggers.front().is_some_and(|&t| t <= tick) {
                if let Some(missing) = cause {
                    note(EventKind::ExposureMissing { camera, after: ticks(missing, tick) });
                }
                cause = exposure.triggers.pop_front();
            }
            exposure.began = Some(tick);
            note(EventKind::ExposureBegan { camera, after: cause.map_or(u32::MAX, |t| ticks(t, tick)) });
        }
    }

    /// A run ends at `tick`: triggers that are still without exposure will get none. Only cameras whose
    /// line has ever been seen are known to have one.
    pub(crate) fn end_of_run(&mut self, tick: u64, grace: u64, note: &mut dyn FnMut(EventKind)) {
        for (camera, exposure) in (0u8..).zip(&mut self.cameras) {
            while exposure.triggers.front().is_some_and(|t| t.saturating_add(grace) <= tick) {
                if let Some(missing) = exposure.triggers.pop_front()
                    && exposure.seen
                {
                    note(EventKind::ExposureMissing { camera, after: ticks(missing, tick) });
                }
            }
        }
    }

    /// The limit switch of an axis that moves in the direction given is pressed.
    pub(crate) fn at_limit(&self, axis: u8, positive: bool) -> bool {
        usize::from(axis) < AXES && self.is_high(channels::limit_switch(axis, positive))
    }
}

fn ticks(from: u64, to: u64) -> u32 {
    u32::try_from(to.saturating_sub(from)).unwrap_or(u32::MAX)
}
