//! The events of the box: a ring that can be read again from any sequence number.

use daic_protocol::limits::{EVENT_RING, EVENTS_PER_REPLY};
use daic_protocol::message::{Event, EventKind, Events};
use heapless::Deque;

/// The last [`EVENT_RING`] events.
#[derive(Debug, Clone)]
pub(crate) struct EventLog {
    ring: Deque<Event, EVENT_RING>,
    /// Sequence number of the next event. Sequence numbers wrap after 2³² events.
    next: u32,
    /// One past the highest sequence number ever put into a reply.
    read: u32,
    dropped: u32,
}

impl EventLog {
    pub(crate) const fn new() -> Self {
        Self { ring: Deque::new(), next: 0, read: 0, dropped: 0 }
    }

    pub(crate) fn next(&self) -> u32 {
        self.next
    }

    /// One past the highest sequence number ever put into a reply.
    pub(crate) fn read_end(&self) -> u32 {
        self.read
    }

    pub(crate) fn push(&mut self, tick: u64, kind: EventKind) {
        if self.ring.is_full()
            && let Some(lost) = self.ring.pop_front()
            && !is_before(lost.seq, self.read)
        {
            self.dropped = self.dropped.saturating_add(1);
        }
        // There is room: one was taken out above.
        let _ = self.ring.push_back(Event { seq: self.next, tick, kind });
        self.next = self.next.wrapping_add(1);
    }

    /// At most `limit` events from `from` on, or from the oldest kept if that is later.
    pub(crate) fn read(&self, from: u32, limit: usize) -> Events {
        let oldest = self.ring.front().map_or(self.next, |e| e.seq);
        let first = if is_before(from, oldest) { oldest } else { from };
        let skip = usize::try_from(first.wrapping_sub(oldest)).unwrap_or(usize::MAX);
        let events: heapless::Vec<Event, EVENTS_PER_REPLY> =
            self.ring.iter().skip(skip).take(limit.min(EVENTS_PER_REPLY)).copied().collect();
        Events { oldest, next: self.next, dropped: self.dropped, events }
    }

    /// Someone has got these.
    pub(crate) fn mark_read(&mut self, events: &Events) {
        if let Some(last) = events.events.last() {
            let end = last.seq.wrapping_add(1);
            if is_before(self.read, end) {
                self.read = end;
            }
        }
    }
}

/// `a` comes before `b` on the circle of sequence numbers.
fn is_before(a: u32, b: u32) -> bool {
    let ahead = b.wrapping_sub(a);
    ahead != 0 && ahead <= i32::MAX as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sequence_numbers_wrap() {
        let mut log = EventLog::new();
        log.next = u32::MAX - 1;
        log.read = u32::MAX - 1;
        for id in 0..4 {
            log.push(u64::from(id), EventKind::Mark { id });
        }
        let got = log.read(u32::MAX, EVENTS_PER_REPLY);
        log.mark_read(&got);
        assert_eq!(got.events.iter().map(|e| e.seq).collect::<heapless::Vec<_, 4>>(), [u32::MAX, 0, 1]);
        assert_eq!((got.oldest, got.next, got.dropped), (u32::MAX - 1, 2, 0));
        assert_eq!(log.read, 2);
        for id in 0..EVENT_RING as u16 {
            log.push(9, EventKind::Mark { id });
        }
        assert_eq!(log.dropped, 0, "all that was overwritten had been read");
        log.push(9, EventKind::Settled);
        assert_eq!(log.dropped, 1);
    }
}
