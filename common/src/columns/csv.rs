//! Columns of CSV files; errors name the line. Only `columns/mod.rs` uses this module. Header and cells lose blanks at
//! both ends.

use std::ops::Range;

use csv::{ReaderBuilder, StringRecord, Trim};

use super::data::{ColumnData, RowCollector, column_index};
use crate::declare::truncate;
use crate::digits::count_noun;

/// Reads the columns `wanted` as finite numbers.
pub(super) fn numbers(bytes: &[u8], wanted: &[String], needed_rows: Range<usize>) -> Result<ColumnData<f64>, String> {
    read_columns(bytes, wanted, needed_rows, |text, name, line| {
        match text.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            Ok(_) | Err(_) => Err(format!(
                "line {line}, column `{name}`: \"{}\" is not a number",
                truncate(text)
            )),
        }
    })
}

/// Reads the column `wanted` as text; `None` without such a column.
pub(super) fn texts(bytes: &[u8], wanted: &str) -> Result<Option<ColumnData<String>>, String> {
    let mut reader = open_csv(bytes);
    let has_column = reader
        .headers()
        .is_ok_and(|header| header.iter().any(|name| name == wanted));
    if !has_column {
        return Ok(None);
    }
    read_columns(bytes, &[wanted.to_owned()], 0..usize::MAX, |text, _, _| {
        Ok(text.to_owned())
    })
    .map(Some)
}

fn open_csv(bytes: &[u8]) -> csv::Reader<&[u8]> {
    ReaderBuilder::new().trim(Trim::All).from_reader(bytes)
}

fn describe_broken_line(line: u64, error: &csv::Error) -> String {
    if let csv::ErrorKind::UnequalLengths { expected_len, len, .. } = error.kind() {
        let columns = count_noun(*len, "column");
        return format!("line {line} has {columns}, the header {expected_len}; complete or remove the line");
    }
    format!("line {line} is broken: {error}")
}

/// Reads the columns `wanted`, of a file with more than `MAX_VALUES` values only `needed_rows`; `parse_cell` converts a
/// text, given the name of its column and its line.
fn read_columns<T>(
    bytes: &[u8],
    wanted: &[String],
    needed_rows: Range<usize>,
    parse_cell: impl Fn(&str, &str, u64) -> Result<T, String>,
) -> Result<ColumnData<T>, String> {
    let mut reader = open_csv(bytes);
    let header = reader
        .headers()
        .map_err(|error| format!("the header is broken: {error}"))?
        .clone();
    let indices = wanted
        .iter()
        .map(|name| column_index(name, header.iter()))
        .collect::<Result<Vec<usize>, String>>()?;
    let mut collector = RowCollector::new(wanted.len(), needed_rows);
    let mut record = StringRecord::new();
    let mut line_counter = LineCounter::new(bytes);
    loop {
        // Read before the record, since an error has to name the line too.
        let line = line_counter.line_after_blanks(reader.position().byte() as usize);
        match reader.read_record(&mut record) {
            Ok(true) => {}
            Ok(false) => return Ok(collector.finish()),
            Err(error) => return Err(describe_broken_line(line, &error)),
        }
        let Some(columns) = collector.begin_row(Some(line))? else {
            continue;
        };
        for ((column, &index), name) in columns.iter_mut().zip(&indices).zip(wanted) {
            // The reader refuses rows of another length than the header's, so the cell exists.
            column.push(parse_cell(record.get(index).unwrap_or_default(), name, line)?);
        }
    }
}

/// Line numbers of a text, from 1, for ascending offsets.
struct LineCounter<'b> {
    bytes: &'b [u8],
    /// The offset up to which line breaks are counted.
    offset: usize,
    line: u64,
}

impl<'b> LineCounter<'b> {
    const fn new(bytes: &'b [u8]) -> Self {
        Self {
            bytes,
            offset: 0,
            line: 1,
        }
    }

    /// The line of the first byte from `offset` on that is not a line break. The next record begins there, since the
    /// reader skips blank lines. Offsets never decrease.
    fn line_after_blanks(&mut self, offset: usize) -> u64 {
        while let Some(&byte) = self.bytes.get(self.offset) {
            if self.offset >= offset && byte != b'\n' && byte != b'\r' {
                break;
            }
            self.line += u64::from(byte == b'\n');
            self.offset += 1;
        }
        self.line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_values(text: &str, names: &[&str]) -> Result<Vec<Vec<f64>>, String> {
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        numbers(text.as_bytes(), &names, 0..usize::MAX).map(|columns| columns.values)
    }

    #[test]
    fn columns_come_in_the_requested_order() {
        assert_eq!(
            read_values("a, b\n1, 2\n3, 4.5\n", &["b", "a"]),
            Ok(vec![vec![2.0, 4.5], vec![1.0, 3.0]])
        );
    }

    #[test]
    fn a_column_of_texts_is_optional() {
        let classes = texts(b"x,class\n1, weak \n\n2,strong\n", "class")
            .expect("a file")
            .expect("a column");
        assert_eq!(classes.values, [["weak", "strong"]]);
        assert_eq!(
            (classes.describe_row(0), classes.describe_row(1)),
            ("line 2".to_owned(), "line 4".to_owned())
        );
        assert_eq!(texts(b"x,y\n1,2\n", "class"), Ok(None));
    }

    #[test]
    fn errors_name_the_line_or_the_columns() {
        for (text, expected) in [
            ("a,b\n1,2\n", "its columns are `a`, `b`"),
            ("x,y\n1,2\n3,oops\n", "line 3, column `y`: \"oops\""),
            ("x,y\n\n1,2\n\n3,oops\n", "line 5, column `y`: \"oops\""),
            ("x,y\n1,2\n3\n", "line 3 has 1 column, the header 2; complete"),
            ("x,y\n1,nan\n", "line 2, column `y`"),
            ("x,y,x\n1,2,3\n", "has more than one column `x`"),
        ] {
            let reason = read_values(text, &["x", "y"]).expect_err(text);
            assert!(reason.contains(expected), "{text:?}: {reason}");
        }
    }
}
