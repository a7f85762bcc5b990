//! Columnar tables, to CSV and to NumPy archives.
//!
//! CSV: comma, one header line, `\n`. A floating-point number is written as the shortest decimal
//! that reads back to the same bits (`0.1`, `1e-7`), and always with a point or an exponent, so
//! that it is told from an integer; not-a-number is `nan`, as NumPy and pandas read it.
//!
//! NPZ: one 1-D array per column, named as the column: `f8`, `i8` (64 bit), and for texts `u1` or
//! `u4` codes with the legend in `<name>_legend`, the UTF-8 bytes of a JSON list:
//! `json.loads(bytes(z["status_legend"]))[z["status"][0]]`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use ndarray::{Array1, ArrayView1};
use thiserror::Error;

use crate::atomic::{self, WriteError};
use crate::npz::{Archive, NpzError};

/// One column.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// Floating-point numbers; NaN means no value.
    F64(Vec<f64>),
    /// Whole numbers.
    I64(Vec<i64>),
    /// Free texts.
    Text(Vec<String>),
    /// Texts out of a short list, such as a status: row i reads `legend[codes[i]]`.
    Coded {
        /// Index into the legend, per row.
        codes: Vec<u8>,
        /// The texts.
        legend: Vec<String>,
    },
}

impl Column {
    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Column::F64(v) => v.len(),
            Column::I64(v) => v.len(),
            Column::Text(v) => v.len(),
            Column::Coded { codes, .. } => codes.len(),
        }
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The cell as CSV shows it.
    fn cell(&self, row: usize) -> String {
        match self {
            Column::F64(v) => match v[row] {
                x if x.is_nan() => "nan".to_string(),
                x => format!("{x:?}"),
            },
            Column::I64(v) => v[row].to_string(),
            Column::Text(v) => v[row].clone(),
            Column::Coded { codes, legend } => legend[usize::from(codes[row])].clone(),
        }
    }
}

/// Why a table could not be built, written or read.
#[derive(Debug, Error)]
pub enum TableError {
    /// A second column of one name.
    #[error("table has two columns named `{name}`")]
    DuplicateColumn {
        /// The name.
        name: String,
    },
    /// A column of another length than the first.
    #[error("column `{name}` has {rows} rows, the table has {expected}")]
    Length {
        /// The column.
        name: String,
        /// Its rows.
        rows: usize,
        /// Rows of the first column.
        expected: usize,
    },
    /// A code without a text.
    #[error("column `{name}`, row {row}: code {code} is not in its legend of {legend} texts")]
    Code {
        /// The column.
        name: String,
        /// The row, from 0.
        row: usize,
        /// The code.
        code: u8,
        /// Length of the legend.
        legend: usize,
    },
    /// A column that was asked for is not there.
    #[error("{} has no column `{name}`; it has: {}", path.display(), present.join(", "))]
    MissingColumn {
        /// The file.
        path: PathBuf,
        /// The column asked for.
        name: String,
        /// The columns there.
        present: Vec<String>,
    },
    /// A column is not of numbers.
    #[error("{}: column `{name}` does not hold numbers", path.display())]
    NotNumeric {
        /// The file.
        path: PathBuf,
        /// The column.
        name: String,
    },
    /// The file could not be opened or read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line of the file cannot be taken apart.
    #[error("{}, line {line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1 (0 if not known).
        line: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// A NumPy archive failed.
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// A table: named columns of one length.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    columns: Vec<(String, Column)>,
}

impl Table {
    /// A table without columns.
    #[must_use]
    pub fn new() -> Self {
        Table::default()
    }

    /// Adds a column to the right.
    ///
    /// # Errors
    /// [`TableError::DuplicateColumn`], [`TableError::Length`], [`TableError::Code`].
    pub fn push(&mut self, name: &str, column: Column) -> Result<(), TableError> {
        if self.column(name).is_some() {
            return Err(TableError::DuplicateColumn { name: name.to_string() });
        }
        if !self.columns.is_empty() && column.len() != self.rows() {
            return Err(TableError::Length {
                name: name.to_string(),
                rows: column.len(),
                expected: self.rows(),
            });
        }
        if let Column::Coded { codes, legend } = &column
            && let Some(row) = codes.iter().position(|&c| usize::from(c) >= legend.len())
        {
            return Err(TableError::Code {
                name: name.to_string(),
                row,
                code: codes[row],
                legend: legend.len(),
            });
        }
        self.columns.push((name.to_string(), column));
        Ok(())
    }

    /// As [`Table::push`], for building in one expression.
    ///
    /// # Errors
    /// As [`Table::push`].
    pub fn with(mut self, name: &str, column: Column) -> Result<Self, TableError> {
        self.push(name, column)?;
        Ok(self)
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, |(_, c)| c.len())
    }

    /// Columns, from the left.
    #[must_use]
    pub fn columns(&self) -> &[(String, Column)] {
        &self.columns
    }

    /// The column of that name.
    #[must_use]
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|(n, _)| n == name).map(|(_, c)| c)
    }

    /// The numbers of a column; whole numbers are converted. `path` names the table in errors.
    ///
    /// # Errors
    /// [`TableError::MissingColumn`], [`TableError::NotNumeric`].
    pub fn numbers(&self, name: &str, path: &Path) -> Result<Vec<f64>, TableError> {
        match self.require(name, path)? {
            Column::F64(v) => Ok(v.clone()),
            Column::I64(v) => Ok(v.iter().map(|&i| i as f64).collect()),
            _ => Err(TableError::NotNumeric { path: path.to_path_buf(), name: name.to_string() }),
        }
    }

    /// The cells of a column as CSV shows them. `path` names the table in errors.
    ///
    /// # Errors
    /// [`TableError::MissingColumn`].
    pub fn texts(&self, name: &str, path: &Path) -> Result<Vec<String>, TableError> {
        let column = self.require(name, path)?;
        Ok((0..column.len()).map(|row| column.cell(row)).collect())
    }

    fn require(&self, name: &str, path: &Path) -> Result<&Column, TableError> {
        self.column(name).ok_or_else(|| TableError::MissingColumn {
            path: path.to_path_buf(),
            name: name.to_string(),
            present: self.columns.iter().map(|(n, _)| n.clone()).collect(),
        })
    }

    /// The table as CSV text.
    ///
    /// # Errors
    /// [`TableError::Line`] if the CSV writer refuses a row.
    pub fn to_csv(&self) -> Result<Vec<u8>, TableError> {
        let refused = |line: usize, e: &dyn std::fmt::Display| TableError::Line {
            path: PathBuf::from("(table)"),
            line: line as u64,
            reason: e.to_string(),
        };
        let mut writer = csv::Writer::from_writer(Vec::new());
        let names = self.columns.iter().map(|(n, _)| n);
        writer.write_record(names).map_err(|e| refused(1, &e))?;
        for row in 0..self.rows() {
            let cells = self.columns.iter().map(|(_, c)| c.cell(row));
            writer.write_record(cells).map_err(|e| refused(row + 2, &e))?;
        }
        writer.into_inner().map_err(|e| refused(0, &e))
    }

    /// Writes CSV; see the module for the format.
    ///
    /// # Errors
    /// [`TableError::Write`], naming the file; nothing is left half-written.
    pub fn write_csv(&self, path: &Path) -> Result<(), TableError> {
        Ok(atomic::write_bytes(path, &self.to_csv()?)?)
    }

    /// Reads CSV. A column is `I64` if every cell is a whole number, else `F64` if every cell is a
    /// number (`nan` and empty cells are NaN), else `Text`. A column without rows is `F64`.
    ///
    /// # Errors
    /// [`TableError::Read`] or [`TableError::Line`], naming file and line.
    pub fn read_csv(path: &Path) -> Result<Self, TableError> {
        let file =
            File::open(path).map_err(|source| TableError::Read { path: path.to_path_buf(), source })?;
        let mut reader = csv::Reader::from_reader(BufReader::new(file));
        let csv_error = |e: csv::Error| TableError::Line {
            path: path.to_path_buf(),
            line: e.position().map_or(0, csv::Position::line),
            reason: e.to_string(),
        };
        let names: Vec<String> = reader.headers().map_err(csv_error)?.iter().map(str::to_string).collect();
        let mut cells = vec![Vec::new(); names.len()];
        for record in reader.records() {
            for (column, cell) in cells.iter_mut().zip(record.map_err(csv_error)?.iter()) {
                column.push(cell.to_string());
            }
        }
        let mut table = Table::new();
        for (name, cells) in names.iter().zip(cells) {
            table.push(name, infer(cells))?;
        }
        Ok(table)
    }

    /// Writes a NumPy archive; see the module for the format.
    ///
    /// # Errors
    /// [`TableError::Npz`], naming the file; nothing is left half-written.
    pub fn write_npz(&self, path: &Path) -> Result<(), TableError> {
        let mut archive = Archive::new(path);
        for (name, column) in &self.columns {
            match column {
                Column::F64(v) => archive.add(name, &ArrayView1::from(v))?,
                Column::I64(v) => archive.add(name, &ArrayView1::from(v))?,
                Column::Coded { codes, legend } => {
                    archive.add(name, &ArrayView1::from(codes))?;
                    archive.add(&legend_name(name), &legend_array(legend))?;
                }
                Column::Text(v) => {
                    let distinct: BTreeSet<&String> = v.iter().collect();
                    let codes: BTreeMap<&String, u32> = distinct.iter().copied().zip(0u32..).collect();
                    let rows: Vec<u32> = v.iter().map(|t| codes[t]).collect();
                    archive.add(name, &Array1::from(rows))?;
                    archive.add(&legend_name(name), &legend_array(&distinct))?;
                }
            }
        }
        Ok(archive.finish()?)
    }
}

fn legend_name(name: &str) -> String {
    format!("{name}_legend")
}

fn legend_array(legend: &impl serde::Serialize) -> Array1<u8> {
    // Lists of texts always serialise; an empty legend would only make the codes unreadable.
    Array1::from(serde_json::to_vec(legend).unwrap_or_default())
}

fn infer(cells: Vec<String>) -> Column {
    let number = |c: &String| match c.as_str() {
        "" => Some(f64::NAN),
        text => text.parse::<f64>().ok(),
    };
    if !cells.is_empty()
        && let Some(v) = cells.iter().map(|c| c.parse().ok()).collect::<Option<Vec<i64>>>()
    {
        return Column::I64(v);
    }
    match cells.iter().map(number).collect::<Option<Vec<f64>>>() {
        Some(v) => Column::F64(v),
        None => Column::Text(cells),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_look_like_floats_and_nan_is_nan() {
        let table = Table::new()
            .with("x", Column::F64(vec![1.0, f64::NAN, -1e-7, f64::INFINITY, 0.1 + 0.2]))
            .unwrap()
            .with("n", Column::I64(vec![-1, 2, 3, 4, 5]))
            .unwrap()
            .with(
                "status",
                Column::Coded {
                    codes: vec![0, 1, 0, 0, 1],
                    legend: vec!["ok".into(), "no, \"texture\"".into()],
                },
            )
            .unwrap();
        let csv = String::from_utf8(table.to_csv().unwrap()).unwrap();
        assert_eq!(
            csv,
            "x,n,status\n1.0,-1,ok\nnan,2,\"no, \"\"texture\"\"\"\n-1e-7,3,ok\ninf,4,ok\n\
             0.30000000000000004,5,\"no, \"\"texture\"\"\"\n"
        );
    }

    #[test]
    fn refuses_what_does_not_fit() {
        let one = || Table::new().with("a", Column::I64(vec![1])).unwrap();
        assert!(matches!(one().with("a", Column::I64(vec![1])), Err(TableError::DuplicateColumn { .. })));
        assert!(matches!(
            one().with("b", Column::F64(vec![])),
            Err(TableError::Length { rows: 0, expected: 1, .. })
        ));
        assert!(matches!(
            one().with("b", Column::Coded { codes: vec![1], legend: vec!["ok".into()] }),
            Err(TableError::Code { row: 0, code: 1, .. })
        ));
    }
}
