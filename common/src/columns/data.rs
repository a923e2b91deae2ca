//! Data read from a file: values by column and row, with the position of each row for errors. The readers of CSV and
//! Parquet files collect it; layouts (`geometry/file.rs`) and traces (`harvest/trace/`) use it.

use std::ops::Range;

use crate::declare::{quoted_list, truncate};

/// Values of a file by column and row.
#[derive(Clone, Debug, PartialEq)]
pub struct ColumnData<T> {
    /// The values, by column and then by row.
    pub values: Vec<Vec<T>>,
    /// The row of the file, from 0, with the first values as read. [`Self::rotate_rows`] does not change it.
    pub first_row: usize,
    /// The number of rows of the file, kept or not.
    pub rows_in_file: usize,
    /// The line of each row in a text file; empty for other files.
    lines: Vec<u64>,
}

impl<T> ColumnData<T> {
    /// The position in the file of row `row` of the values, from 0: "line 5", or "row 4" for a file without lines. The
    /// row number of a file without lines is valid only before [`Self::rotate_rows`].
    pub fn describe_row(&self, row: usize) -> String {
        match self.lines.get(row) {
            Some(line) => format!("line {line}"),
            None => format!("row {}", self.first_row + row + 1),
        }
    }

    /// The number of rows with values, the same in every column.
    pub fn len(&self) -> usize {
        self.values.first().map_or(0, Vec::len)
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Moves the first `count` rows behind the last one.
    ///
    /// # Panics
    /// If there are fewer rows.
    pub fn rotate_rows(&mut self, count: usize) {
        for column in &mut self.values {
            column.rotate_left(count);
        }
        if !self.lines.is_empty() {
            self.lines.rotate_left(count);
        }
    }

    /// Removes the first `count` rows; all if there are fewer.
    pub fn remove_first_rows(&mut self, count: usize) {
        self.keep_rows(count..usize::MAX);
    }

    fn keep_rows(&mut self, rows: Range<usize>) {
        for column in &mut self.values {
            keep_range(column, &rows);
        }
        keep_range(&mut self.lines, &rows);
        self.first_row += rows.start;
    }
}

fn keep_range<T>(values: &mut Vec<T>, range: &Range<usize>) {
    values.truncate(range.end);
    values.drain(..range.start.min(values.len()));
}

/// Collects the rows of a file in order. From a file with more than [`MAX_VALUES`] values it keeps only the needed
/// rows.
pub(super) struct RowCollector<T> {
    data: ColumnData<T>,
    needed_rows: Range<usize>,
    /// Whether the file has more values than are kept, so that only the needed rows remain.
    is_cut: bool,
}

impl<T> RowCollector<T> {
    /// Creates an empty collector of `columns` columns.
    pub(super) fn new(columns: usize, needed_rows: Range<usize>) -> Self {
        Self {
            data: ColumnData {
                values: (0..columns).map(|_| Vec::new()).collect(),
                first_row: 0,
                rows_in_file: 0,
                lines: Vec::new(),
            },
            needed_rows,
            is_cut: false,
        }
    }

    /// Begins the next row, at `line` of a text file; a file without lines passes `None` for every row. Returns the
    /// columns, to each of which the caller must add one value; `None` if the row is not needed.
    ///
    /// # Errors
    /// If the needed rows have more values than memory should hold.
    pub(super) fn begin_row(&mut self, line: Option<u64>) -> Result<Option<&mut [Vec<T>]>, String> {
        let (row, columns) = (self.data.rows_in_file, self.data.values.len());
        if !self.is_cut && (row + 1).saturating_mul(columns) > MAX_VALUES {
            check_value_count(self.needed_rows.len(), columns)?;
            self.data.keep_rows(self.needed_rows.clone());
            self.is_cut = true;
        }
        self.data.rows_in_file += 1;
        if self.is_cut && !self.needed_rows.contains(&row) {
            return Ok(None);
        }
        self.data.lines.extend(line);
        Ok(Some(&mut self.data.values))
    }

    /// Returns the collected rows.
    pub(super) fn finish(self) -> ColumnData<T> {
        self.data
    }
}

/// Maximum number of values of one file that are kept, which bounds the memory. A test of `harvest/trace/` expects the
/// number in the error.
pub(super) const MAX_VALUES: usize = 10_000_000;

/// The index of the only column called `name`.
pub(super) fn column_index<'h>(name: &str, header: impl Iterator<Item = &'h str> + Clone) -> Result<usize, String> {
    let mut matches = header.clone().enumerate().filter(|(_, known)| *known == name);
    match (matches.next(), matches.next()) {
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
fn check_value_count(rows: usize, columns: usize) -> Result<(), String> {
    if rows.saturating_mul(columns) > MAX_VALUES {
        return Err(format!(
            "has more than {MAX_VALUES} values in {columns} columns; use fewer rows or columns"
        ));
    }
    Ok(())
}
