//! The player: PIO 0 fed by DMA. It goes safe by itself when it runs dry, when the interlock opens
//! and when the processor no longer reports.
//!
//! Machine 0 plays records (word, ticks − 4); machine 3 watches the interlock, machine 2 the
//! processor. They share the pins, and the writes of a higher machine win.

use crate::clock;
use crate::reg::{self, ADDR, CLKDIV, DMA, EXECCTRL, INSTR, PINCTRL, PIO0, SHIFTCTRL, machine, read, write};
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicU32, Ordering, fence};
use daic_firmware::blocks::{BLOCK, Block, MAX_HOLD, Packer};
use daic_firmware::pico::{INPUTS, INTERLOCK, LINES, ONBOARD, OUT_BASE, OUT_PINS, pin_word};
use daic_firmware::{Ahead, Controller, Reached, Sink};
use daic_protocol::channels::SAFE_WORD;
use daic_protocol::message::{FaultCause, State};

/// Words of the three programs; the rest of the memory is free.
///
/// ```text
///  0  out pins, 32        the edge                          machine 0, wraps 31 → 31
///  1  out x, 32
///  2  jmp x-- 2
///  3  mov pc, status      2 words waiting: 0 → 0, else all ones → 31
///  4  wait 0 pin 0        interlock                         machine 3, wraps 5 → 5
///  5  mov pins, y
///  6  pull noblock        nothing fed: OSR ← X              machine 2, wraps 9 → 9
///  7  mov x, osr
///  8  jmp x-- 6
///  9  mov pins, y
/// 31  mov pins, y         safe, when the next edge was due
/// ```
const PROGRAM: [(u32, u32); 11] = [
    (0, 0x6000),
    (1, 0x6020),
    (2, 0x0042),
    (3, 0xa0a5),
    (4, 0x2020),
    (5, 0xa002),
    (6, 0x8080),
    (7, 0xa027),
    (8, 0x0046),
    (9, 0xa002),
    (31, 0xa002),
];
const PLAY: u32 = 0;
const PULSE: u32 = 2;
const GUARD: u32 = 3;
const PLAY_ENTRY: u32 = 3;
const GUARD_ENTRY: u32 = 4;
const GUARD_SAFE: u32 = 5;
const PULSE_ENTRY: u32 = 6;
const PULSE_SAFE: u32 = 9;
const DRY: u32 = 31;

/// Buffers: 2048 records.
const BUFFERS: usize = 128;
const SLOTS: usize = 256;
/// How far ahead words are expanded: 20 ms.
pub const LOOK_AHEAD: u64 = 2_500_000;
/// So much is missing before more is expanded, in one go: 0.5 ms.
const REFILL: u64 = 62_500;
/// Longest time spent on looking ahead in one turn of the main loop: 0.2 ms.
const FILL: u64 = 25_000;
/// From the launch to the first tick of a program: 200 µs of the safe word.
const LEAD_IN: u64 = 25_000;
/// Time kept for the launch itself: 100 µs.
const LAUNCH_MARGIN: u64 = 12_500;
/// Time before the launch in which no word is expanded any more: planning a move takes long.
const LAST_FILL: u64 = 50_000;
/// From the reading of the core's timer for which the launch is set to the first word on the pins.
const LAUNCH_DELAY: u64 = 14;
/// A stream that has come so little before its time counts as dry: 2 ms.
const DRY_LEAD: u64 = 250_000;
/// Turns of three ticks that the processor may be silent: 5 ms.
const BUDGET: u32 = 208_000;
/// Longest time from the last report of the processor to the safe word.
const SILENCE: u64 = 3 * BUDGET as u64 + 6;

#[repr(C, align(1024))]
struct Memory {
    /// Addresses of the blocks to be played; 0 ends.
    slots: UnsafeCell<[u32; SLOTS]>,
    blocks: UnsafeCell<[[u32; 2 * BLOCK]; BUFFERS]>,
}
// SAFETY: written by `Player` alone, of which there is one; the DMA reads.
unsafe impl Sync for Memory {}
static MEMORY: Memory =
    Memory { slots: UnsafeCell::new([0; SLOTS]), blocks: UnsafeCell::new([[0; 2 * BLOCK]; BUFFERS]) };

/// Tick at which the interlock opened, low and high half; both 0: it has not.
static OPENED: [AtomicU32; 2] = [AtomicU32::new(0), AtomicU32::new(0)];

/// Blocks on their way to the player.
struct Ring {
    /// Blocks committed, and fetched, since the start.
    head: u32,
    fetched: u32,
    running: bool,
    /// Begin of the last record committed and its end.
    last: u64,
    end: u64,
}

impl Ring {
    /// Blocks that can be committed now.
    fn free(&mut self) -> u32 {
        if self.running {
            let base = MEMORY.slots.get() as u32;
            let at = read(DMA + 0x40 + 0x14).wrapping_sub(base) / 4;
            let new = at.wrapping_sub(self.fetched) % SLOTS as u32;
            self.fetched = self.fetched.wrapping_add(new);
        }
        // The block before the one fetched last may still be read from.
        let used = self.head.wrapping_sub(self.fetched).wrapping_add(1);
        (BUFFERS as u32).saturating_sub(used)
    }

    fn commit(&mut self, block: &Block) {
        let buffer = self.head as usize % BUFFERS;
        let slot = |h: u32| h as usize % SLOTS;
        // SAFETY: both indices are within the arrays. `free` has seen that the DMA is done with
        // this buffer, and it reads slots only one after the other: it meets the zero written here
        // before any older slot.
        unsafe {
            let to = MEMORY.blocks.get().cast::<[u32; 2 * BLOCK]>().add(buffer);
            let words: &mut [u32; 2 * BLOCK] = &mut *to;
            for (pair, record) in words.chunks_exact_mut(2).zip(&block.records) {
                if let [word, ticks] = pair {
                    *word = record.word;
                    *ticks = record.ticks.wrapping_sub(4);
                }
            }
            let slots = MEMORY.slots.get().cast::<u32>();
            slots.add(slot(self.head.wrapping_add(1))).write_volatile(0);
            fence(Ordering::SeqCst);
            slots.add(slot(self.head)).write_volatile(to as u32);
        }
        self.head = self.head.wrapping_add(1);
        (self.last, self.end) = (block.last, block.end);
    }
}

/// Run under way in the player.
struct Run {
    ahead: Ahead,
    packer: Packer,
    /// All of it is committed.
    complete: bool,
    /// Tick at which it ends safe by itself.
    ended: Option<u64>,
    number: u32,
}

/// The player.
pub struct Player {
    ring: Ring,
    run: Option<Run>,
    fed: u64,
    /// Least ticks by which words were ready before their time, in this or the last run.
    pub lead: u32,
}

/// Words of the look-ahead go into blocks.
struct Packing<'a> {
    packer: &'a mut Packer,
    ring: &'a mut Ring,
    broken: bool,
    /// Words taken, and how many may be.
    words: u32,
    most: u32,
    deadline: u64,
}

impl Sink for Packing<'_> {
    fn is_full(&self) -> bool {
        self.broken || self.words >= self.most || (self.words % 8 == 7 && clock::now() > self.deadline)
    }
    fn word(&mut self, tick: u64, word: u32) {
        self.words = self.words.wrapping_add(1);
        let ring = &mut *self.ring;
        self.broken |= self.packer.word(tick, pin_word(word), &mut |block| ring.commit(block)).is_err();
    }
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

impl Player {
    /// Sets up machines and pins: outputs safe and driven.
    pub fn new() -> Self {
        for i in 0..32 {
            write(PIO0 + 0x48 + 4 * i, 0);
        }
        for (at, instruction) in PROGRAM {
            write(PIO0 + 0x48 + 4 * at, instruction);
        }
        let pins = u32::from(OUT_BASE) | u32::from(OUT_PINS) << 20;
        for m in [PLAY, PULSE, GUARD] {
            write(machine(PIO0, m, CLKDIV), 1 << 16);
            write(machine(PIO0, m, PINCTRL), pins | u32::from(INTERLOCK) << 15);
        }
        // Status: fewer than 2 words in the transmit FIFO.
        write(machine(PIO0, PLAY, EXECCTRL), (31 << 12) | (31 << 7) | 2);
        write(machine(PIO0, PULSE, EXECCTRL), (9 << 12) | (9 << 7));
        write(machine(PIO0, GUARD, EXECCTRL), (5 << 12) | (5 << 7));
        write(machine(PIO0, PULSE, SHIFTCTRL), 3 << 18);
        write(machine(PIO0, GUARD, SHIFTCTRL), 3 << 18);
        let mut player = Self {
            ring: Ring { head: 0, fetched: 0, running: false, last: 0, end: 0 },
            run: None,
            fed: 0,
            lead: 0,
        };
        player.clear();
        // All pins of the player are outputs.
        write(machine(PIO0, PLAY, SHIFTCTRL), (1 << 30) | (3 << 18));
        write(PIO0 + 0x10, u32::MAX);
        write(machine(PIO0, PLAY, INSTR), 0x80a0); // pull
        write(machine(PIO0, PLAY, INSTR), 0x6080); // out pindirs, 32
        for (_, gpio) in LINES {
            connect(gpio);
        }
        connect(ONBOARD);
        // Input enabled, Schmitt trigger, pull-down: an open wire does not permit.
        for (_, gpio) in INPUTS {
            write(reg::PADS_BANK0 + 4 + 4 * u32::from(gpio), 0x46);
        }
        player
    }

    /// Nothing under way, outputs safe, machines at their entries and standing still.
    fn clear(&mut self) {
        write(PIO0, 0);
        // Disabled first: a channel that is only aborted may be started again by the other.
        write(DMA + 0x10, 0);
        write(DMA + 0x40 + 0x10, 0);
        write(DMA + 0x444, 3); // abort both channels
        while read(DMA + 0x444) & 3 != 0 {}
        for m in [PLAY, PULSE, GUARD] {
            // Toggling the join bits empties the FIFO. No autopull: what is pulled here is ours.
            write(machine(PIO0, m, SHIFTCTRL), 3 << 18);
            write(machine(PIO0, m, SHIFTCTRL), (1 << 30) | (3 << 18));
        }
        write(PIO0, 0xf0); // restart
        for m in [PLAY, PULSE, GUARD] {
            write(PIO0 + 0x10 + 4 * m, SAFE_WORD);
            write(machine(PIO0, m, INSTR), 0x80a0); // pull
            write(machine(PIO0, m, INSTR), 0xa047); // mov y, osr
        }
        write(machine(PIO0, PLAY, INSTR), 0xa002); // mov pins, y
        // The processor's first budget.
        write(PIO0 + 0x10 + 4 * PULSE, BUDGET);
        write(machine(PIO0, PULSE, INSTR), 0x80a0);
        write(machine(PIO0, PULSE, INSTR), 0xa027); // mov x, osr
        write(machine(PIO0, PLAY, SHIFTCTRL), (1 << 30) | (1 << 19) | (1 << 18) | (1 << 17));
        write(PIO0, 0xf0);
        for (m, entry) in [(PLAY, PLAY_ENTRY), (PULSE, PULSE_ENTRY), (GUARD, GUARD_ENTRY)] {
            write(machine(PIO0, m, INSTR), entry); // jmp
        }
        self.ring = Ring { head: 0, fetched: 0, running: false, last: 0, end: 0 };
        // SAFETY: the DMA has been stopped above.
        unsafe { *MEMORY.slots.get() = [0; SLOTS] };
        // Channel 0: a block, as fast as the player takes it; then channel 1, which gives channel 0
        // the address of the next block, or 0, which starts nothing.
        let common = 1 | 2 | 2 << 2 | 1 << 4 | 1 << 21;
        write(DMA + 0x34, PIO0 + 0x10);
        write(DMA + 0x38, 2 * BLOCK as u32);
        write(DMA + 0x10, common | 1 << 11);
        write(DMA + 0x40 + 0x14, MEMORY.slots.get() as u32);
        write(DMA + 0x40 + 0x34, DMA + 0x3c);
        write(DMA + 0x40 + 0x38, 1);
        write(DMA + 0x40 + 0x10, common | 10 << 6 | 1 << 11 | 0x3f << 15);
        for half in &OPENED {
            half.store(0, Ordering::Relaxed);
        }
    }

    /// Whether the interlock permits outputs now.
    pub fn permitted() -> bool {
        read(reg::IO_BANK0 + 8 * u32::from(INTERLOCK)) & (1 << 17) != 0
    }

    /// Tells the watching machine that the processor is alive.
    pub fn feed(&mut self, now: u64) {
        if self.ring.running {
            write(PIO0 + 0x10 + 4 * PULSE, BUDGET);
            self.fed = now;
        }
    }

    /// Tick at which the run under way ends safe by itself, once that is known.
    pub fn ended(&self) -> Option<u64> {
        self.run.as_ref().and_then(|run| run.ended)
    }

    /// The input word is `word` from tick `tick` on; the controller has been told.
    pub fn inputs(&mut self, tick: u64, word: u32, controller: &Controller) {
        let Some(run) = self.run.as_mut().filter(|run| !run.complete) else { return };
        let ring = &mut self.ring;
        let most = ring.free().saturating_sub(3);
        let (packer, deadline) = (&mut run.packer, u64::MAX);
        let mut packing = Packing { packer, ring, broken: false, words: 0, most, deadline };
        run.ahead.inputs(tick, word, controller, &mut packing);
        run.complete |= packing.broken;
    }

    /// Begins, feeds and ends runs as the controller says.
    pub fn service(&mut self, controller: &mut Controller, sink: &mut dyn Sink) {
        if controller.state() != State::Running {
            if self.run.take().is_some() {
                self.clear();
            }
            return;
        }
        if self.run.as_ref().is_none_or(|run| run.number != controller.run()) {
            self.begin(controller, sink);
        }
        self.fill(controller, clock::now().saturating_add(FILL));
        if let Some((cause, tick)) = self.tripped() {
            controller.trip(cause, tick, sink);
        }
    }

    fn begin(&mut self, controller: &mut Controller, sink: &mut dyn Sink) {
        self.clear();
        self.lead = u32::MAX;
        let Some(ahead) = controller.ahead() else { return };
        let launch = ahead.due(controller).saturating_sub(LEAD_IN);
        let packer = Packer::new(launch.saturating_add(LAUNCH_DELAY));
        self.run = Some(Run { ahead, packer, complete: false, ended: None, number: controller.run() });
        if !Self::permitted() {
            controller.trip(FaultCause::Interlock, clock::now(), sink);
            return;
        }
        self.fill(controller, launch.saturating_sub(LAST_FILL));
        write(DMA + 0x430, 2); // start channel 1
        // It fills the FIFO meanwhile.
        while clock::now().saturating_add(LAUNCH_MARGIN) < launch {}
        if launch_at(launch) {
            self.ring.running = true;
            self.fed = launch;
        } else {
            controller.trip(FaultCause::Underrun, clock::now(), sink);
        }
    }

    /// Expands as far as there is room, until `deadline` at the latest.
    fn fill(&mut self, controller: &mut Controller, deadline: u64) {
        let Some(run) = &mut self.run else { return };
        let ring = &mut self.ring;
        let now = clock::now();
        if ring.running && !run.complete {
            let lead = ring.last.saturating_sub(now);
            self.lead = self.lead.min(u32::try_from(lead).unwrap_or(u32::MAX));
        }
        let until = now.saturating_add(LOOK_AHEAD);
        if run.packer.upto().saturating_add(REFILL) > until {
            return;
        }
        while !run.complete && run.packer.upto() < until {
            // A word never fills more than one block, nor does what comes before it once it is near.
            let most = ring.free().saturating_sub(3);
            if most == 0 || clock::now() > deadline {
                break;
            }
            let due = run.ahead.due(controller);
            let quiet = run.packer.upto().saturating_add(8 * u64::from(MAX_HOLD));
            if due > quiet {
                run.packer.quiet(quiet, &mut |block| ring.commit(block));
                continue;
            }
            let packer = &mut run.packer;
            let mut packing = Packing { packer, ring: &mut *ring, broken: false, words: 0, most, deadline };
            // The words of so long a time, one after the other, fill no more than a block each.
            let soon = due.saturating_add(8 * u64::from(MAX_HOLD)).min(until.max(due));
            let reached = run.ahead.play(soon, controller.now(), controller, &mut packing);
            let (broken, some) = (packing.broken, packing.words > 0);
            match reached {
                Reached::Waiting(next) if !broken && (some || next > due) => {}
                // Only an input can go on, or time without one.
                Reached::Waiting(next) if !broken => {
                    run.packer.flush(next, &mut |block| ring.commit(block));
                    break;
                }
                Reached::Dry(tick) if !broken => {
                    run.packer.quiet(tick, &mut |block| ring.commit(block));
                    let late = clock::now().saturating_add(DRY_LEAD);
                    if ring.end >= late || !ring.running {
                        break;
                    }
                    if !run.packer.flush(tick, &mut |block| ring.commit(block)) {
                        // Played to the end of what there is.
                        controller.seal_stream();
                    }
                }
                Reached::Ended(tick) if !broken => {
                    run.packer.finish(tick, &mut |block| ring.commit(block));
                    run.complete = true;
                    run.ended = Some(tick);
                }
                // The controller finds it too and halts; else the player runs dry.
                _ => run.complete = true,
            }
        }
        controller.committed(run.ahead.due(controller));
    }

    /// Whether the player has gone safe by itself, why and when.
    fn tripped(&self) -> Option<(FaultCause, u64)> {
        if !self.ring.running {
            return None;
        }
        let at = |m| read(machine(PIO0, m, ADDR));
        if at(GUARD) == GUARD_SAFE {
            return Some((FaultCause::Interlock, opened_at().unwrap_or_else(clock::now)));
        }
        if at(PULSE) == PULSE_SAFE {
            let tick = self.fed.saturating_add(SILENCE).min(self.ring.last);
            return Some((FaultCause::Heartbeat, tick));
        }
        // A run that is complete ends like this too.
        let complete = self.run.as_ref().is_some_and(|run| run.complete);
        (at(PLAY) == DRY && !complete).then_some((FaultCause::Underrun, self.ring.last))
    }
}

/// Gives a pin to the player: pull-down, slow slew, 4 mA.
fn connect(gpio: u8) {
    write(reg::PADS_BANK0 + 4 + 4 * u32::from(gpio), 0x56);
    write(reg::IO_BANK0 + 4 + 8 * u32::from(gpio), 6);
}

/// Makes every output safe at once; returns the tick at which it was.
#[inline(never)]
pub fn halt() -> u64 {
    // The guard's own safe loop: latched.
    write(machine(PIO0, GUARD, INSTR), GUARD_SAFE);
    write(PIO0 + reg::SET, 1 << GUARD);
    clock::now()
}

/// Outputs off by all means, for when nothing else can be relied on.
pub fn kill() {
    let _ = halt();
    for (_, gpio) in LINES {
        // Output disabled whatever the peripheral says; the pull-down takes over.
        write(reg::PADS_BANK0 + 4 + 4 * u32::from(gpio), 0xd6);
    }
    write(reg::PADS_BANK0 + 4 + 4 * u32::from(ONBOARD), 0xd6);
}

/// Tick at which the interlock opened since the run began.
pub fn opened_at() -> Option<u64> {
    let [low, high] = &OPENED;
    let (low, high) = (low.load(Ordering::Relaxed), high.load(Ordering::Relaxed));
    Some(u64::from(high) << 32 | u64::from(low)).filter(|opened| *opened > 0)
}

/// The interlock has opened.
pub fn opened() {
    let now = clock::now();
    let [low, high] = &OPENED;
    if low.load(Ordering::Relaxed) == 0 {
        low.store(now as u32, Ordering::Relaxed);
        high.store((now >> 32) as u32, Ordering::Relaxed);
    }
}

/// Starts the machines so that the first word is out [`LAUNCH_DELAY`] after `tick`. False: too late.
fn launch_at(tick: u64) -> bool {
    critical_section::with(|_| {
        let left = tick.wrapping_sub(clock::now());
        // Soon enough for interrupts to wait: their FIFOs hold 300 µs.
        if !(200..2 * LAUNCH_MARGIN).contains(&left) {
            return false;
        }
        launch(clock::reading_at(tick), PIO0, (1 << PLAY) | (1 << PULSE) | (1 << GUARD));
        true
    })
}

/// Starts machines of a block soon; returns the tick at which they begin.
pub fn start_at_leisure(block: u32, machines: u32) -> u64 {
    critical_section::with(|_| {
        let tick = clock::now().wrapping_add(1000);
        launch(clock::reading_at(tick), block, machines);
        tick.wrapping_add(LAUNCH_DELAY)
    })
}

/// Waits until the core's timer, which counts down, reads `reading`, and starts `machines` of a PIO block.
///
/// In RAM, so that no flash access comes in between: always the same number of cycles.
#[inline(never)]
#[unsafe(link_section = ".data.launch")]
fn launch(reading: u32, block: u32, machines: u32) {
    // SAFETY: reads one register and writes another; jumps within its own instructions.
    unsafe {
        core::arch::asm!(
            "adr {to}, 3f",
            "adds {to}, #1",
            ".balign 4",
            "2: ldr {left}, [{cvr}]",
            "subs {left}, {left}, {reading}",
            "lsls {left}, {left}, #8",
            "lsrs {left}, {left}, #8",
            "cmp {left}, #60",
            "bhi 2b",
            // What is left is waited for in as many no-operations, 2 bytes and a cycle each.
            "lsls {left}, {left}, #1",
            "subs {to}, {to}, {left}",
            "bx {to}",
            ".rept 64",
            "nop",
            ".endr",
            ".balign 4",
            "3: movs {left}, {machines}",
            "str {left}, [{ctrl}]",
            left = out(reg) _,
            to = out(reg) _,
            cvr = in(reg) reg::SYST_CVR,
            reading = in(reg) reading,
            ctrl = in(reg) block,
            machines = in(reg) machines,
            options(nostack),
        );
    }
}
