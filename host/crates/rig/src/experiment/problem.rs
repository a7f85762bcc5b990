//! What is wrong with a file, and where.

use serde::de::DeserializeOwned;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};
use thiserror::Error;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// One thing that is wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// What.
    pub kind: ProblemKind,
    /// Bytes of the text that it is about; what a program underlines.
    pub span: Range<usize>,
    /// Line from 1.
    pub line: usize,
    /// Column from 1, in characters.
    pub column: usize,
    /// What is wrong, one sentence.
    pub message: String,
    /// The way out, one sentence.
    pub help: Option<String>,
}

/// Kinds of problem.
#[derive(Debug, Clone, PartialEq)]
pub enum ProblemKind {
    /// Not TOML, an unknown or missing key, a wrong type or unit.
    Form,
    /// A value that breaks a rule.
    Value {
        /// Path of the field, such as `optics.grating.pitch` or `sequence[3].move.x`.
        field: String,
        /// The value found.
        value: String,
        /// What is allowed.
        allowed: String,
    },
}

/// A file could not be used.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// It could not be read.
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// An experiment under the microscope, where optics are wanted.
    #[error("{} describes a microscope, which has no [optics]", path.display())]
    NoOptics {
        /// The file.
        path: PathBuf,
    },
    /// It was read, and something in it is wrong.
    #[error("{}", Listing(.path, .problems))]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Its text, for showing the place.
        text: String,
        /// Everything that is wrong, at least one.
        problems: Vec<Problem>,
    },
}

impl ConfigError {
    /// The problems found (none if the file could not be read).
    pub fn problems(&self) -> &[Problem] {
        match self {
            Self::Read { .. } | Self::NoOptics { .. } => &[],
            Self::Invalid { problems, .. } => problems,
        }
    }
}

struct Listing<'a>(&'a Path, &'a [Problem]);

impl fmt::Display for Listing<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, p) in self.1.iter().enumerate() {
            let separator = if i == 0 { "" } else { "\n" };
            write!(f, "{separator}{}:{}:{}: {}", self.0.display(), p.line, p.column, p.message)?;
            if let Some(help) = &p.help {
                write!(f, "; {help}")?;
            }
        }
        Ok(())
    }
}

/// A broken rule, not yet placed in the text.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Finding {
    pub field: String,
    pub value: String,
    pub allowed: String,
}

pub(super) fn read(path: &Path) -> Result<String, ConfigError> {
    let bytes = std::fs::read(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
    String::from_utf8(bytes).map_err(|e| {
        let at = e.utf8_error().valid_up_to();
        let text = String::from_utf8_lossy(e.as_bytes()).into_owned();
        let problem = place(
            &text,
            at..at,
            ProblemKind::Form,
            "the file is not UTF-8 text".to_owned(),
            Some("give a TOML text file".to_owned()),
        );
        ConfigError::Invalid { path: path.to_owned(), text, problems: vec![problem] }
    })
}

pub(super) fn from_toml<T: DeserializeOwned>(text: &str, path: &Path) -> Result<T, ConfigError> {
    toml::from_str(text).map_err(|e| {
        let message = e.message().trim().replace('\n', ", ");
        let help = if message.starts_with("unknown field") || message.starts_with("unknown variant") {
            Some("check the spelling, or see `daic schema` and `daic init`".to_owned())
        } else if message.starts_with("missing field") {
            Some("add it; `daic init` writes an example of every key".to_owned())
        } else {
            None
        };
        let problem = place(text, e.span().unwrap_or(0..0), ProblemKind::Form, message, help);
        ConfigError::Invalid { path: path.to_owned(), text: text.to_owned(), problems: vec![problem] }
    })
}

pub(super) fn has_key(text: &str, key: &str) -> bool {
    DeTable::parse(text).is_ok_and(|table| table.get_ref().contains_key(key))
}

/// Turns findings into an error that knows their places; nothing if there are none.
pub(super) fn report(text: &str, path: &Path, findings: Vec<Finding>) -> Result<(), ConfigError> {
    if findings.is_empty() {
        return Ok(());
    }
    let table = DeTable::parse(text).ok();
    let problems = findings
        .into_iter()
        .map(|finding| {
            let span = table.as_ref().map_or(0..0, |t| span_of(t, &finding.field));
            let message = format!("{} is {}", finding.field, finding.value);
            let help = Some(format!("allowed: {}", finding.allowed));
            let kind =
                ProblemKind::Value { field: finding.field, value: finding.value, allowed: finding.allowed };
            place(text, span, kind, message, help)
        })
        .collect();
    Err(ConfigError::Invalid { path: path.to_owned(), text: text.to_owned(), problems })
}

fn place(
    text: &str,
    span: Range<usize>,
    kind: ProblemKind,
    message: String,
    help: Option<String>,
) -> Problem {
    let start = span.start.min(text.len());
    let before = text.get(..start).unwrap_or("");
    let line = before.matches('\n').count() + 1;
    let column = before.rsplit('\n').next().unwrap_or("").chars().count() + 1;
    Problem { kind, span, line, column, message, help }
}

/// Where `field` (`a.b[2].c`) stands; for a key left to its default, the table that would hold it.
fn span_of(table: &Spanned<DeTable<'_>>, field: &str) -> Range<usize> {
    let mut span = table.span();
    let mut segments = field.split('.').flat_map(|part| {
        let (key, indices) = part.split_once('[').unwrap_or((part, ""));
        std::iter::once(Err(key))
            .chain(indices.split(['[', ']']).filter_map(|i| i.parse::<usize>().ok().map(Ok)))
    });
    let Some(Err(key)) = segments.next() else { return span };
    let Some(mut value) = table.get_ref().get(key) else { return span };
    span = value.span();
    for segment in segments {
        let next = match (segment, value.get_ref()) {
            (Err(key), DeValue::Table(t)) => t.get(key),
            (Ok(index), DeValue::Array(a)) => a.get(index),
            _ => None,
        };
        match next {
            Some(inner) => value = inner,
            None => break,
        }
        span = value.span();
    }
    span
}
