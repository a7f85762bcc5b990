//! The event stream without gaps.

use super::{Link, LinkError};
use daic_protocol::message::Event;

/// Reads the event ring from a sequence number on and notices every gap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EventReader {
    next: u32,
}

impl EventReader {
    /// Starts with event `next`, such as [`Status::next_event`](daic_protocol::message::Status::next_event).
    pub fn new(next: u32) -> Self {
        Self { next }
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
            if reply.oldest > self.next {
                let from = self.next;
                self.next = reply.oldest;
                return Err(LinkError::EventsLost { from, to: reply.oldest - 1 });
            }
            if reply.next < self.next {
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
            }
            if reply.events.is_empty() || self.next == reply.next {
                return Ok(events.len() - before);
            }
        }
    }
}
