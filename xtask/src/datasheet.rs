//! The measured numbers of docs/datasheet.md.

use crate::firmware::{self, Elf};
use crate::steps::{Outcome, root};
use std::path::PathBuf;

const BEGIN: &str = "<!-- measured -->\n";
const END: &str = "<!-- end -->";
/// How far a number that depends on the compiler's version may be from the one written: it is
/// written with another version.
const COMPILER: f64 = 0.10;

/// One number: what, value, unit.
type Row = (String, f64, String);

/// Where the cases leave what they measured.
pub fn numbers() -> PathBuf {
    root().join("target/firmware/numbers.json")
}

fn document() -> PathBuf {
    root().join("docs/datasheet.md")
}

/// Sizes of the image, then what the cases measured.
fn measured() -> Result<Vec<Row>, String> {
    let bytes = std::fs::read(firmware::elf()).map_err(|error| format!("no image: {error}"))?;
    let sizes = Elf::parse(&bytes).ok_or("the image is not a 32-bit ELF file")?.sizes();
    let row = |what: &str, value: u32| (what.to_owned(), f64::from(value), "bytes".to_owned());
    let mut rows = vec![row("image: flash", sizes.flash), row("image: variables in RAM", sizes.ram)];
    let text = std::fs::read_to_string(numbers()).map_err(|error| format!("no numbers: {error}"))?;
    let list: Vec<(String, String, f64, String)> =
        serde_json::from_str(&text).map_err(|error| format!("{}: {error}", numbers().display()))?;
    rows.extend(list.into_iter().map(|(case, what, value, unit)| (format!("{case}: {what}"), value, unit)));
    Ok(rows)
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from("\n| case | value | label |\n|---|---|---|\n");
    for (what, value, unit) in rows {
        text += &format!("| {what} | {value} {unit} | emulated |\n");
    }
    text + "\n"
}

/// The block between the marks and what is around it.
fn split(text: &str) -> Option<(&str, &str, &str)> {
    let begin = text.find(BEGIN)? + BEGIN.len();
    let end = begin + text[begin..].find(END)?;
    Some((&text[..begin], &text[begin..end], &text[end..]))
}

/// Writes the block anew.
pub fn write() -> Outcome {
    let result = measured().and_then(|rows| {
        let text = std::fs::read_to_string(document()).map_err(|error| error.to_string())?;
        let (before, _, after) = split(&text).ok_or("no marks in docs/datasheet.md")?;
        firmware::put(&document(), format!("{before}{}{after}", table(&rows)).as_bytes())
    });
    match result {
        Ok(()) => Outcome::Passed,
        Err(error) => Outcome::Failed(error),
    }
}

/// Numbers of the table as written.
fn written(block: &str) -> Vec<Row> {
    let rows = block.lines().filter_map(|line| {
        let mut cells = line.split('|').map(str::trim).skip(1);
        let (what, value) = (cells.next()?, cells.next()?);
        let (value, unit) = value.split_once(' ').unwrap_or((value, ""));
        Some((what.to_owned(), value.parse().ok()?, unit.trim().to_owned()))
    });
    rows.collect()
}

/// Whether a number is the one written; those that the compiler decides may differ a little.
fn agrees(now: &Row, then: &Row) -> bool {
    let by_compiler = now.2 == "bytes"
        || ["least lead", "longest turn", "halt to safe", "late by", "edges before"]
            .iter()
            .any(|w| now.0.contains(w));
    // Two ticks of the clock of the stamps.
    let by_clock =
        [": latency", ": jitter", "spread of the stamps", "wire told"].iter().any(|w| now.0.contains(w));
    // In steps of a quarter.
    if now.0 == then.0 && now.0.starts_with("sustained rate") {
        return now.1 >= 0.75 * then.1;
    }
    let allowed = match (by_compiler, by_clock) {
        (true, _) => COMPILER * then.1.abs().max(100.0),
        (_, true) => 2.0,
        _ => 0.0,
    };
    now.0 == then.0 && now.2 == then.2 && (now.1 - then.1).abs() <= allowed
}

/// Compares what was measured with what is written.
pub fn check() -> Outcome {
    let result = measured().and_then(|rows| {
        let text = std::fs::read_to_string(document()).map_err(|error| error.to_string())?;
        let (_, block, _) = split(&text).ok_or("no marks in docs/datasheet.md")?;
        let written = written(block);
        if written.len() != rows.len() {
            return Err(format!(
                "{} numbers measured, {} written: `cargo xtask datasheet`",
                rows.len(),
                written.len()
            ));
        }
        match rows.iter().zip(&written).find(|(now, then)| !agrees(now, then)) {
            None => Ok(()),
            Some((now, then)) => Err(format!("measured {now:?}, written {then:?}: `cargo xtask datasheet`")),
        }
    });
    match result {
        Ok(()) => Outcome::Passed,
        Err(error) => Outcome::Failed(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let rows = vec![
            ("image: flash".to_owned(), 60_000.0, "bytes".to_owned()),
            ("strobe: edge error".to_owned(), 0.0, "ticks".to_owned()),
            ("many: edges".to_owned(), 10_000.0, String::new()),
        ];
        let text = format!("before\n{BEGIN}{}{END}\nafter", table(&rows));
        let (before, block, after) = split(&text).unwrap();
        assert!(before.starts_with("before") && after.ends_with("after"));
        let read = written(block);
        assert!(read.iter().zip(&rows).all(|(a, b)| a == b) && read.len() == rows.len(), "{read:?}");
        // A tick is a tick; bytes are the compiler's.
        let more = |row: &Row, by: f64| (row.0.clone(), row.1 + by, row.2.clone());
        assert!(agrees(&more(&rows[0], 5999.0), &rows[0]) && !agrees(&more(&rows[0], 6001.0), &rows[0]));
        assert!(!agrees(&more(&rows[1], 1.0), &rows[1]) && !agrees(&more(&rows[2], 1.0), &rows[2]));
    }
}
