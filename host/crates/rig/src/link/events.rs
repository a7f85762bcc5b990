//! The event stream without gaps.

use super::{Link, LinkError};
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::{Event, EventKind};

/// Reads the event ring from a sequence number on and notices every gap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EventReader {
    next: u32,
    /// Tick of the last event.
    tick: u64,
}

/// Whether `a` comes before `b`: sequence numbers wrap.
fn is_before(a: u32, b: u32) -> bool {
    a != b && b.wrapping_sub(a) < 1 << 31
}

impl EventReader {
    /// Starts with event `next`, such as [`Status::next_event`](daic_protocol::message::Status::next_event).
    pub fn new(next: u32) -> Self {
        Self { next, tick: 0 }
    }

    /// Sequence number of the next event wanted.
    pub fn next(&self) -> u32 {
        self.next
    }

    /// Appends everything that has happened since the last call; returns how many events.
    ///
    /// # Errors
    /// [`LinkError::EventsLost`] if the box has overwritten events that were not read yet (the
    /// next call goes on behind the gap), [`LinkError::BoardReset`], else as [`Link::request`].
    pub fn poll(&mut self, link: &mut Link, events: &mut Vec<Event>) -> Result<usize, LinkError> {
        let before = events.len();
        loop {
            let reply = link.read_events(self.next)?;
            // A box that has started anew may have as many events again: its ticks, or the end of a run, tell.
            let back = |e: &Event| e.tick.saturating_add(u64::from(TICK_HZ)) < self.tick;
            let ends = |e: &Event| matches!(e.kind, EventKind::RunDone { .. } | EventKind::Faulted { .. });
            if reply.events.iter().any(|e| back(e) || ends(e)) {
                link.verify_boot()?;
            }
            if is_before(self.next, reply.oldest) {
                let from = self.next;
                self.next = reply.oldest;
                return Err(LinkError::EventsLost { from, to: reply.oldest.wrapping_sub(1) });
            }
            if is_before(reply.next, self.next) {
                // The box counts from 0 again.
                link.verify_boot()?;
                return Err(LinkError::EventsOutOfOrder { expected: self.next, found: reply.next });
            }
            for event in &reply.events {
                if event.seq != self.next {
                    return Err(LinkError::EventsOutOfOrder { expected: self.next, found: event.seq });
                }
                events.push(*event);
                self.next = self.next.wrapping_add(1);
                self.tick = event.tick;
            }
            if reply.events.is_empty() || self.next == reply.next {
                return Ok(events.len() - before);
            }
        }
    }
}
