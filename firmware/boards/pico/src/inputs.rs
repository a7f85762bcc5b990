//! Inputs. PIO 1 stamps trigger inputs and the exposure-active line: a machine each counts down once every
//! two ticks and hands over its count when the pin changes. Limit switches and interlock are looked at in
//! every turn of the main loop; what the interlock does, PIO 0 does.

use crate::reg::{self, EXECCTRL, GPIO_IN, INSTR, PIO1, SHIFTCTRL, machine, read, write};
use crate::{clock, player};
use core::cell::RefCell;
use core::sync::atomic::{AtomicU32, Ordering};
use critical_section::Mutex;
use daic_firmware::pico::{INPUTS, input_word};
use heapless::{Deque, Vec};
use rp2040_hal::pac::{self, interrupt};

/// Bit of the input word and GPIO of each pin that is stamped: the first ones of [`INPUTS`].
const STAMPED: usize = 3;

/// X counts down in every second cycle, whatever way is taken.
///
/// ```text
///  0  jmp x-- 1           low                 wraps 1 → 0
///  1  jmp pin 2
///  2  mov isr, x          rose
///  3  jmp x-- 4
///  4  push noblock
///  5  jmp x-- 6
///  6  jmp x-- 7           high
///  7  jmp pin 6
///  8  mov isr, x          fell
///  9  jmp x-- 10
/// 10  push noblock
/// 11  jmp x-- 0
/// 12  jmp 0
/// ```
const PROGRAM: [u32; 13] =
    [0x0041, 0x00c2, 0xa0c1, 0x0044, 0x8000, 0x0046, 0x0047, 0x00c6, 0xa0c1, 0x004a, 0x8000, 0x0040, 0];
/// From the first count to the pad that was seen: the machines' start, the way through the two flip-flops.
const LATE: u64 = 3;
/// A change younger than this may still be on its way to the queue.
const SETTLED: u64 = 32;

/// Changes handed over: machine and count.
static QUEUE: Mutex<RefCell<Deque<(u8, u32), 64>>> = Mutex::new(RefCell::new(Deque::new()));
/// Changes that nobody had room for.
static LOST: AtomicU32 = AtomicU32::new(0);

/// The inputs.
pub struct Inputs {
    /// Tick of the first count.
    origin: u64,
    /// As told to the controller.
    word: u32,
    /// Bits that were found wrong in the last turn.
    wrong: u32,
}

/// A change of the input word.
#[derive(Debug, Clone, Copy)]
pub struct Change {
    /// When.
    pub tick: u64,
    /// The word from then on.
    pub word: u32,
}

impl Inputs {
    /// Starts the machines. Until the first [`Inputs::poll`] all inputs count as low.
    pub fn new() -> Self {
        for (at, instruction) in (0u32..).zip(PROGRAM) {
            write(PIO1 + 0x48 + 4 * at, instruction);
        }
        for (m, (_, gpio)) in (0u32..).zip(INPUTS).take(STAMPED) {
            write(machine(PIO1, m, EXECCTRL), (u32::from(gpio) << 24) | (1 << 12));
            write(machine(PIO1, m, SHIFTCTRL), (1 << 31) | (3 << 18));
            write(machine(PIO1, m, reg::CLKDIV), 1 << 16);
            write(machine(PIO1, m, INSTR), 0xa02b); // mov x, ~null
            write(machine(PIO1, m, INSTR), 0); // jmp 0
        }
        // Received something, machines 0 to 2.
        write(PIO1 + 0x12c, 7);
        let origin = player::start_at_leisure(PIO1, 7);
        // SAFETY: the handler below shares nothing but what is behind a critical section.
        unsafe { pac::NVIC::unmask(pac::Interrupt::PIO1_IRQ_0) };
        Self { origin, word: 0, wrong: 0 }
    }

    /// Changes since the last time, in order, and the tick up to which no other is to come.
    pub fn poll(&mut self) -> (Vec<Change, 64>, u64) {
        let now = clock::now();
        let levels = input_word(read(GPIO_IN));
        let mut changes: Vec<(u64, u32), 64> = Vec::new();
        let half = (now.wrapping_sub(self.origin) >> 1) as u32;
        while changes.len() < changes.capacity() {
            let Some((m, count)) = critical_section::with(|cs| {
                drain(&mut QUEUE.borrow_ref_mut(cs));
                QUEUE.borrow_ref_mut(cs).pop_front()
            }) else {
                break;
            };
            // The count went down from all ones.
            let age = half.wrapping_sub(!count) as i32;
            let tick = now.wrapping_add_signed(-2 * i64::from(age)) & !1 | (self.origin & 1);
            let bit = INPUTS.get(usize::from(m)).map_or(0, |input| 1u32 << input.0);
            let _ = changes.push((tick.saturating_sub(LATE), bit));
        }
        changes.sort_unstable();
        let stamped = INPUTS.iter().take(STAMPED).fold(0, |mask, input| mask | 1 << input.0);
        let mut told: Vec<Change, 64> = Vec::new();
        for &(tick, bit) in &changes {
            self.word ^= bit;
            let _ = told.push(Change { tick, word: self.word });
        }
        // A change that was lost leaves the level wrong, and a short one that is under way does for a turn.
        let wrong = if changes.is_empty() { (self.word ^ levels) & stamped } else { 0 };
        let right = self.word ^ (wrong & self.wrong);
        self.wrong = wrong;
        let word = right & stamped | levels & !stamped;
        if word != self.word {
            self.word = word;
            let _ = told.push(Change { tick: now, word });
        }
        (told, now.saturating_sub(SETTLED))
    }

    /// Changes lost for want of room.
    pub fn lost() -> u32 {
        LOST.load(Ordering::Relaxed)
    }
}

/// Takes what the machines hand over.
fn drain(queue: &mut Deque<(u8, u32), 64>) {
    for m in 0..STAMPED as u32 {
        while read(PIO1 + 4) & (1 << (8 + m)) == 0 {
            let count = read(PIO1 + 0x20 + 4 * m);
            if queue.push_back((m as u8, count)).is_err() {
                LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            }
        }
    }
}

#[interrupt]
fn PIO1_IRQ_0() {
    critical_section::with(|cs| drain(&mut QUEUE.borrow_ref_mut(cs)));
}
