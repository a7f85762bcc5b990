//! Several links to one controller: bytes of one never get between those of another.

use daic_protocol::frame::MAX_FRAME;

/// Collects what comes over one link until it is a frame.
#[derive(Debug)]
pub struct FrameGate {
    bytes: heapless::Vec<u8, { MAX_FRAME + 1 }>,
    full: bool,
}

impl Default for FrameGate {
    fn default() -> Self {
        Self::new()
    }
}

impl FrameGate {
    /// Nothing received.
    pub const fn new() -> Self {
        Self { bytes: heapless::Vec::new(), full: false }
    }

    /// Takes a byte. With the delimiter the whole frame is handed out, delimiter included, for
    /// [`Controller::receive`](crate::Controller::receive).
    ///
    /// Of what is longer than any frame so much is kept that the controller sees and counts it.
    pub fn feed(&mut self, byte: u8) -> Option<&[u8]> {
        if self.full {
            self.bytes.clear();
            self.full = false;
        }
        if byte == 0 {
            self.full = true;
            // The delimiter always has its place: the last one is kept for it below.
            let _ = self.bytes.push(0);
            return Some(&self.bytes);
        }
        if self.bytes.len() < MAX_FRAME {
            let _ = self.bytes.push(byte);
        }
        None
    }

    /// The link was opened anew: forgets a frame that has begun.
    pub fn restart(&mut self) {
        self.bytes.clear();
    }
}
