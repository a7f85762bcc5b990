//! `docs/reproduction.md`: parts written by the program, each in its place.

use super::ReproduceError;
use daic_dataset::atomic::write_bytes;
use daic_report::Markup;
use std::path::Path;

/// One part of the page with its figures.
#[derive(Debug)]
pub struct Part {
    /// Its name: `macro`, `micro` or `lightfield`.
    pub name: &'static str,
    /// The text in Markdown, without its markers.
    pub text: String,
    /// Figures by file name without ending.
    pub figures: Vec<(String, Markup)>,
}

/// Names of the parts in their order on the page.
const PARTS: [&str; 3] = ["macro", "micro", "lightfield"];

const HEAD: &str = "\
# Reproduction of chapters 2, 3 and 4

Written by `cargo xtask reproduce macro`, `cargo xtask reproduce micro` and `cargo xtask reproduce lightfield`; not to be edited by hand. The set-ups of chapters 2 and 3
are simulated ray by ray through the grating equation and measured with the project's own correlation, calibration and decoding; those of chapter 4 by wave optics, with finer sampling
than the reconstructions use. Seeds are fixed: the same source gives the same numbers on every machine; those of chapter 4 are rounded differently by
processors with other vector instructions, which may change the last digit shown. \"Thesis\" are the values printed there: measured on real specimens in chapters 2 and 3, simulated in chapter 4 but for figure 15.
";

fn markers(name: &str) -> (String, String) {
    (format!("<!-- {name} begins -->\n"), format!("<!-- {name} ends -->\n"))
}

/// The page with one part replaced; what is there of the others is kept.
fn replaced(page: &str, part: &Part) -> String {
    let mut out = HEAD.to_owned();
    for name in PARTS {
        let (begin, end) = markers(name);
        let inside = if name == part.name {
            part.text.clone()
        } else {
            let old = page.split_once(&begin).and_then(|(_, rest)| rest.split_once(&end));
            old.map_or_else(
                || format!("\nNot run yet: `cargo xtask reproduce {name}`.\n\n"),
                |(text, _)| text.to_owned(),
            )
        };
        out.push_str(&format!("\n{begin}{inside}{end}"));
    }
    out
}

/// Puts a part into the page `reproduction.md` in the folder `docs` and its figures into `figures` there.
///
/// # Errors
/// A file that cannot be read or written.
pub fn write(docs: &Path, part: &Part) -> Result<(), ReproduceError> {
    let path = docs.join("reproduction.md");
    let page = match std::fs::read_to_string(&path) {
        Ok(page) => page,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(source) => return Err(ReproduceError::File { path, source }),
    };
    for (name, figure) in &part.figures {
        write_bytes(&docs.join("figures").join(format!("{name}.svg")), figure.as_str().as_bytes())?;
    }
    write_bytes(&path, replaced(&page, part).as_bytes())?;
    Ok(())
}

/// A table in Markdown.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let line = |cells: &mut dyn Iterator<Item = String>| {
        let mut out = String::from("|");
        cells.for_each(|c| out.push_str(&format!(" {c} |")));
        out + "\n"
    };
    let mut out = line(&mut head.iter().map(|h| (*h).to_owned()));
    let rule = head.iter().enumerate().map(|(i, _)| if i == 0 { "---" } else { "--:" }.to_owned());
    out += &line(&mut rule.collect::<Vec<_>>().into_iter());
    for row in rows {
        out += &line(&mut row.iter().cloned());
    }
    out
}

/// Figures side by side.
pub fn row_of(figures: &[(&str, &str)]) -> String {
    let width = 98 / figures.len().max(1);
    let images = figures
        .iter()
        .map(|(file, text)| format!("<img src=\"figures/{file}.svg\" alt=\"{text}\" width=\"{width}%\">"));
    format!("\n{}\n\n", images.collect::<Vec<_>>().join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_replace_themselves_alone() {
        let part = |name, text: &str| Part { name, text: text.to_owned(), figures: Vec::new() };
        let first = replaced("", &part("micro", "one\n"));
        assert!(first.contains("Not run yet: `cargo xtask reproduce macro`") && first.contains("one"));
        let second = replaced(&first, &part("macro", "two\n"));
        assert!(second.contains("one") && second.contains("two"));
        let left: Vec<_> = second.lines().filter(|l| l.starts_with("Not run yet")).collect();
        assert_eq!(left, ["Not run yet: `cargo xtask reproduce lightfield`."]);
        let third = replaced(&second, &part("micro", "three\n"));
        assert!(third.contains("two") && third.contains("three") && !third.contains("one\n"));
    }
}
