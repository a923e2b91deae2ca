//! What is read from a file: values by column and row, and where each row stands.

/// Columns of a file by column and row.
#[derive(Clone, Debug, PartialEq)]
pub struct Columns<T> {
    /// The values, at least one row.
    pub values: Vec<Vec<T>>,
    /// The line of each row in a text file; nothing for other files.
    pub(super) lines: Vec<u64>,
}

impl<T> Columns<T> {
    /// Where row `row`, from 0, stands: "line 5", or "row 4" of a file without lines.
    pub fn place(&self, row: usize) -> String {
        match self.lines.get(row) {
            Some(line) => format!("line {line}"),
            None => format!("row {}", row + 1),
        }
    }

    /// The number of rows.
    pub fn len(&self) -> usize {
        self.values.first().map_or(0, Vec::len)
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
