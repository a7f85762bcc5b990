//! What the box has put out, for later comparison with what it was told.

use std::io::{self, Write};

/// Words kept; beyond it they are only counted (16 bytes each).
pub const WORDS_KEPT: usize = 8_000_000;

/// Everything put out since the start, by ticks of the simulated time.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Record {
    /// (tick, word) in order.
    pub words: Vec<(u64, u32)>,
    /// (tick, LED, level) in order.
    pub levels: Vec<(u64, u8, u16)>,
    /// Words put out after [`WORDS_KEPT`].
    pub words_not_kept: u64,
}

impl Record {
    pub(crate) fn word(&mut self, tick: u64, word: u32) {
        if self.words.len() < WORDS_KEPT {
            self.words.push((tick, word));
        } else {
            self.words_not_kept += 1;
        }
    }

    /// Writes the words as a value change dump, one wire per line that ever changed, 8 ns per unit.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn write_vcd(&self, mut out: impl Write) -> io::Result<()> {
        let used = self.words.iter().fold(0, |used, (_, word)| used | word);
        let lines: Vec<u8> = (0..32).filter(|bit| used >> bit & 1 == 1).collect();
        // VCD knows only powers of ten: 8 ns ticks are written in nanoseconds.
        writeln!(out, "$timescale 1 ns $end\n$scope module box $end")?;
        for &bit in &lines {
            writeln!(out, "$var wire 1 {} {} $end", identifier(bit), line_name(bit))?;
        }
        writeln!(out, "$upscope $end\n$enddefinitions $end\n#0")?;
        for &bit in &lines {
            writeln!(out, "0{}", identifier(bit))?;
        }
        let mut before = 0;
        for &(tick, word) in &self.words {
            let changed = before ^ word;
            if changed == 0 {
                continue;
            }
            writeln!(out, "#{}", crate::world::ns_from_ticks(tick))?;
            for &bit in lines.iter().filter(|&&bit| changed >> bit & 1 == 1) {
                writeln!(out, "{}{}", word >> bit & 1, identifier(bit))?;
            }
            before = word;
        }
        Ok(())
    }
}

fn identifier(bit: u8) -> char {
    char::from(b'A' + bit)
}

fn line_name(bit: u8) -> String {
    match bit {
        0..=7 => format!("led{bit}"),
        8..=11 => format!("camera{}", bit - 8),
        12..=15 => format!("aux{}", bit - 12),
        16..=27 if bit.is_multiple_of(2) => format!("step{}", (bit - 16) / 2),
        16..=27 => format!("direction{}", (bit - 17) / 2),
        _ => format!("bit{bit}"),
    }
}
