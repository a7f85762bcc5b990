//! The report as one HTML page.

use std::collections::BTreeSet;

use askama::Template;

use crate::error::ReportError;
use crate::svg::Markup;

/// The outcome at the top of the page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// Whether everything that was checked holds.
    pub pass: bool,
    /// One sentence: what was checked, or what failed.
    pub text: String,
}

/// A cell of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cell {
    /// Text, aligned left.
    Text(String),
    /// A number with its unit, aligned right.
    Number(String),
    /// A check that holds.
    Pass(String),
    /// A check that fails.
    Fail(String),
}

impl Cell {
    fn class(&self) -> &'static str {
        match self {
            Cell::Text(_) => "text",
            Cell::Number(_) => "number",
            Cell::Pass(_) => "pass",
            Cell::Fail(_) => "fail",
        }
    }

    /// Colour alone must not tell a failure.
    fn mark(&self) -> &'static str {
        match self {
            Cell::Pass(_) => "✓ ",
            Cell::Fail(_) => "✗ ",
            _ => "",
        }
    }

    fn text(&self) -> &str {
        match self {
            Cell::Text(t) | Cell::Number(t) | Cell::Pass(t) | Cell::Fail(t) => t,
        }
    }
}

/// A table.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TableBlock {
    /// Caption above it.
    pub caption: String,
    /// Column headings.
    pub head: Vec<String>,
    /// Rows, each as long as the head.
    pub rows: Vec<Vec<Cell>>,
}

/// A figure with its caption.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Figure {
    /// Anchor on the page; characters other than letters, digits, `-` and `_` are replaced, and a
    /// number is added to the second of a kind.
    pub id: String,
    /// Name in the caption, set off.
    pub title: String,
    /// What is to be seen.
    pub caption: String,
    /// The drawing.
    pub body: Markup,
}

/// A part of the report.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Section {
    /// Heading.
    pub title: String,
    /// Paragraphs.
    pub text: Vec<String>,
    /// Tables, after the text.
    pub tables: Vec<TableBlock>,
    /// Figures, after the tables.
    pub figures: Vec<Figure>,
}

/// A report: one page that needs no other file, asks nobody, and shows every text as text.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Report {
    /// Title of the page.
    pub title: String,
    /// Line below the title.
    pub subtitle: String,
    /// The outcome, if something was checked.
    pub verdict: Option<Verdict>,
    /// The parts.
    pub sections: Vec<Section>,
    /// Where the numbers come from: versions, seeds, files, settings.
    pub provenance: Vec<(String, String)>,
}

#[derive(Template)]
#[template(path = "report.html")]
struct Page<'a> {
    report: &'a Report,
}

impl Report {
    /// The page.
    ///
    /// # Errors
    /// [`ReportError::Page`] if the template engine fails.
    pub fn render(&self) -> Result<String, ReportError> {
        let mut report = self.clone();
        let mut taken = BTreeSet::new();
        for figure in report.sections.iter_mut().flat_map(|s| s.figures.iter_mut()) {
            figure.id = free_id(&figure.id, &mut taken);
        }
        Ok(Page { report: &report }.render()?)
    }
}

fn free_id(wanted: &str, taken: &mut BTreeSet<String>) -> String {
    let keep = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '-' | '_') { c } else { '-' };
    let base = format!("fig-{}", wanted.chars().map(keep).collect::<String>());
    let mut id = base.clone();
    let mut number = 2;
    while !taken.insert(id.clone()) {
        id = format!("{base}-{number}");
        number += 1;
    }
    id
}
