//! Programs without their loops, for streams.

use daic_protocol::program::Instruction;

/// The instructions of a program in the order in which they are played, loops gone through; made one by one, so
/// that a loop of any count takes no memory. Loops that do not close are handed on as they stand, for the box to refuse.
#[derive(Debug, Clone)]
pub struct Unrolled<'a> {
    program: &'a [Instruction],
    next: usize,
    /// First instruction of each open loop's body, and passes left.
    open: Vec<(usize, u32)>,
}

impl<'a> Unrolled<'a> {
    /// Goes through `program` from its first instruction.
    pub fn new(program: &'a [Instruction]) -> Self {
        Self { program, next: 0, open: Vec::new() }
    }

    /// Instructions of the whole program, up to `u64::MAX`.
    pub fn count(program: &[Instruction]) -> u64 {
        let (mut total, mut times) = (0u64, vec![1u64]);
        for instruction in program {
            let factor = times.last().copied().unwrap_or(1);
            match instruction {
                Instruction::LoopBegin { count } => times.push(factor.saturating_mul(u64::from(*count))),
                Instruction::LoopEnd => {
                    times.pop();
                }
                _ => total = total.saturating_add(factor),
            }
        }
        total
    }

    /// Where the loop that begins at `begin` ends, and whether there is anything in it to be played.
    fn end(&self, begin: usize) -> Option<(usize, bool)> {
        let (mut depth, mut plays) = (0usize, false);
        for (at, instruction) in self.program.iter().enumerate().skip(begin) {
            match instruction {
                Instruction::LoopBegin { .. } => depth += 1,
                Instruction::LoopEnd if depth == 1 => return Some((at, plays)),
                Instruction::LoopEnd => depth -= 1,
                _ => plays = true,
            }
        }
        None
    }
}

impl Iterator for Unrolled<'_> {
    type Item = Instruction;

    fn next(&mut self) -> Option<Instruction> {
        loop {
            let at = self.next;
            let instruction = *self.program.get(at)?;
            self.next += 1;
            match instruction {
                // a loop of no passes is refused by the box, as it is in a stored program
                Instruction::LoopBegin { count } if count > 0 => match self.end(at) {
                    Some((_, true)) => self.open.push((self.next, count)),
                    Some((end, false)) => self.next = end + 1,
                    None => return Some(instruction),
                },
                Instruction::LoopEnd => match self.open.last_mut() {
                    Some((begin, left)) if *left > 1 => {
                        *left -= 1;
                        self.next = *begin;
                    }
                    Some(_) => {
                        self.open.pop();
                    }
                    None => return Some(instruction),
                },
                other => return Some(other),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn delay(ticks: u32) -> Instruction {
        Instruction::Delay { ticks }
    }
    fn begin(count: u32) -> Instruction {
        Instruction::LoopBegin { count }
    }
    const END: Instruction = Instruction::LoopEnd;

    #[test]
    fn nested_loops_are_gone_through() {
        let program = [delay(1), begin(2), delay(2), begin(3), delay(3), END, END, delay(4)];
        let played: Vec<u32> = Unrolled::new(&program)
            .map(|i| if let Instruction::Delay { ticks } = i { ticks } else { 0 })
            .collect();
        assert_eq!(played, [1, 2, 3, 3, 3, 2, 3, 3, 3, 4]);
        assert_eq!(Unrolled::count(&program), 10);
        assert_eq!(
            Unrolled::count(&[begin(u32::MAX), begin(u32::MAX), begin(9), delay(1), END, END, END]),
            u64::MAX
        );
    }

    #[test]
    fn what_is_no_loop_is_handed_on() {
        for program in [vec![begin(2), delay(1)], vec![delay(1), END], vec![begin(0), delay(1), END]] {
            assert_eq!(Unrolled::new(&program).collect::<Vec<_>>(), program);
        }
        // of an empty body nothing is left, however often
        assert_eq!(Unrolled::new(&[begin(u32::MAX), END]).next(), None);
    }
}
