//! Columns of numbers from CSV files (and Parquet files, with the cargo feature `parquet`).

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::error::{listed, shortened};

/// Bytes of the largest data file that is read.
const LARGEST_FILE: u64 = 256 << 20;
/// Numbers that are taken from one file at the most.
pub(super) const MOST_VALUES: usize = 10_000_000;

/// The columns `wanted` of the file at `path`, at most its first `rows` rows, at least one. The error says what is wrong
/// with the file, without its name.
pub(super) fn read_columns(path: &Path, wanted: &[String], rows: usize) -> Result<Vec<Vec<f64>>, String> {
    let file = open(path)?;
    let parquet = path
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("parquet"));
    let columns = if parquet {
        read_parquet(file, wanted, rows)?
    } else {
        read_csv(BufReader::new(file.take(LARGEST_FILE)), wanted, rows)?
    };
    if columns.iter().any(Vec::is_empty) {
        return Err("has no rows".to_owned());
    }
    Ok(columns)
}

/// Opens a regular file: a pipe or a device may never end.
fn open(path: &Path) -> Result<File, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read: {error}");
    let metadata = std::fs::metadata(path).map_err(unreadable)?;
    if !metadata.is_file() {
        return Err("is not a file".to_owned());
    }
    if metadata.len() > LARGEST_FILE {
        return Err(format!("is larger than {LARGEST_FILE} bytes"));
    }
    File::open(path).map_err(unreadable)
}

#[cfg(feature = "parquet")]
use super::parquet::read_parquet;

#[cfg(not(feature = "parquet"))]
fn read_parquet(_: File, _: &[String], _: usize) -> Result<Vec<Vec<f64>>, String> {
    Err("is a Parquet file, which only a build with the cargo feature `parquet` reads: cargo run --release --features parquet -- …".to_owned())
}

fn read_csv(source: impl Read, wanted: &[String], rows: usize) -> Result<Vec<Vec<f64>>, String> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(source);
    let header = reader
        .headers()
        .map_err(|error| format!("the header is broken: {error}"))?
        .clone();
    let indices = wanted
        .iter()
        .map(|name| column_index(name, header.iter()))
        .collect::<Result<Vec<usize>, String>>()?;
    let mut columns = vec![Vec::new(); wanted.len()];
    let mut record = csv::StringRecord::new();
    for row in 1..=rows {
        match reader.read_record(&mut record) {
            Ok(true) => {}
            Ok(false) => break,
            Err(error) => return Err(format!("row {row} is broken: {error}")),
        }
        within_limit(row, wanted.len())?;
        for ((column, &index), name) in columns.iter_mut().zip(&indices).zip(wanted) {
            column.push(cell(record.get(index).unwrap_or_default(), row, name)?);
        }
    }
    Ok(columns)
}

/// The number of the column called `name`.
pub(super) fn column_index<'h>(name: &str, header: impl Iterator<Item = &'h str> + Clone) -> Result<usize, String> {
    header.clone().position(|known| known == name).ok_or_else(|| {
        format!(
            "has no column `{}`; its columns are {}",
            shortened(name),
            listed(header.take(50))
        )
    })
}

/// Refuses a file of more numbers than memory should hold.
pub(super) fn within_limit(rows: usize, columns: usize) -> Result<(), String> {
    if rows.saturating_mul(columns) > MOST_VALUES {
        return Err(format!("has more than {MOST_VALUES} values in {columns} columns"));
    }
    Ok(())
}

fn cell(text: &str, row: usize, column: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) | Err(_) => Err(format!(
            "row {row}, column `{column}`: \"{}\" is not a number",
            shortened(text)
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn csv(text: &str, wanted: &[&str]) -> Result<Vec<Vec<f64>>, String> {
        let wanted: Vec<String> = wanted.iter().map(|&name| name.to_owned()).collect();
        read_csv(text.as_bytes(), &wanted, 100)
    }

    #[test]
    fn columns_come_in_the_order_asked_for() {
        assert_eq!(
            csv("a, b\n1, 2\n3, 4.5\n", &["b", "a"]),
            Ok(vec![vec![2.0, 4.5], vec![1.0, 3.0]])
        );
    }

    #[test]
    fn no_more_rows_than_asked_for_are_read() {
        let columns = read_csv("a\n1\n2\nbroken\n".as_bytes(), &["a".to_owned()], 2);
        assert_eq!(columns, Ok(vec![vec![1.0, 2.0]]));
    }

    #[test]
    fn broken_files_name_the_row_or_the_columns() {
        for (text, part) in [
            ("a,b\n1,2\n", "its columns are `a`, `b`"),
            ("x,y\n1,2\n3,oops\n", "row 2, column `y`: \"oops\""),
            ("x,y\n1,2\n3\n", "row 2 is broken"),
            ("x,y\n1,nan\n", "row 1, column `y`"),
        ] {
            let reason = csv(text, &["x", "y"]).expect_err(text);
            assert!(reason.contains(part), "{reason}");
        }
    }

    #[test]
    fn a_directory_is_no_file() {
        let reason = read_columns(Path::new("/"), &[], 1).expect_err("a directory");
        assert_eq!(reason, "is not a file");
    }
}
