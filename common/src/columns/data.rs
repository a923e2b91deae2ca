//! Data read from a file: values by column and row, with the position of each row for errors.

use crate::declare::{quoted_list, truncate};

/// Values of a file by column and row.
#[derive(Clone, Debug, PartialEq)]
pub struct ColumnData<T> {
    /// The values, at least one row.
    pub values: Vec<Vec<T>>,
    /// The line of each row in a text file; empty for other files.
    pub(super) lines: Vec<u64>,
}

impl<T> ColumnData<T> {
    /// The position of row `row`, from 0: "line 5", or "row 4" for a file without lines.
    pub fn describe_row(&self, row: usize) -> String {
        match self.lines.get(row) {
            Some(line) => format!("line {line}"),
            None => format!("row {}", row + 1),
        }
    }

    /// The number of rows, the same in every column.
    pub fn len(&self) -> usize {
        self.values.first().map_or(0, Vec::len)
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Maximum number of values that are read from one file.
pub(super) const MAX_VALUES: usize = 10_000_000;

/// The index of the only column called `name`.
pub(super) fn column_index<'h>(name: &str, header: impl Iterator<Item = &'h str> + Clone) -> Result<usize, String> {
    let mut found = header.clone().enumerate().filter(|(_, known)| *known == name);
    match (found.next(), found.next()) {
        (Some((index, _)), None) => Ok(index),
        (Some(_), Some(_)) => Err(format!("has more than one column `{}`", truncate(name))),
        (None, _) => Err(format!(
            "has no column `{}`; its columns are {}",
            truncate(name),
            quoted_list(header.take(50))
        )),
    }
}

/// Returns an error for a file with more values than memory should hold.
pub(super) fn check_value_count(rows: usize, columns: usize) -> Result<(), String> {
    if rows.saturating_mul(columns) > MAX_VALUES {
        return Err(format!("has more than {MAX_VALUES} values in {columns} columns"));
    }
    Ok(())
}
