//! How much of the stack has ever been used.

const PAINT: u32 = 0x5afe_57ac;
/// Words looked at in one turn.
const SLICE: u32 = 64;

unsafe extern "C" {
    /// End of the variables, from the linker.
    static mut __sheap: u32;
    /// Top of the stack, from the linker.
    static mut _stack_start: u32;
}

fn bottom() -> u32 {
    (&raw const __sheap) as u32
}

fn top() -> u32 {
    (&raw const _stack_start) as u32
}

/// Fills what is not in use yet. To be called first of all.
#[inline(never)]
pub fn paint() {
    let here = cortex_m::register::msp::read();
    let mut at = bottom();
    // This function's own frame is left alone.
    while at < here.wrapping_sub(96) {
        // Eight at a time: the outputs wait for this.
        for offset in 0..8 {
            // SAFETY: between the variables and the stack pointer nothing lives.
            unsafe { (at as *mut u32).add(offset).write_volatile(PAINT) };
        }
        at = at.wrapping_add(32);
    }
}

/// Looks for the lowest word ever written, a little each turn.
pub struct Watch {
    at: u32,
    /// Most bytes ever in use.
    pub peak: u32,
}

impl Watch {
    /// Begins at the bottom.
    pub fn new() -> Self {
        Self { at: bottom(), peak: 0 }
    }

    /// Bytes there are.
    pub fn size() -> u32 {
        top().wrapping_sub(bottom())
    }

    /// Looks at the next few words.
    pub fn look(&mut self) {
        for _ in 0..SLICE {
            // SAFETY: within the RAM between variables and top of the stack.
            let painted = self.at < top() && unsafe { (self.at as *const u32).read_volatile() } == PAINT;
            if !painted {
                self.peak = self.peak.max(top().wrapping_sub(self.at));
                self.at = bottom();
                return;
            }
            self.at = self.at.wrapping_add(4);
        }
    }
}
