//! Columns of data files (layouts, energy traces) from their bytes: CSV, and Parquet with the cargo feature `parquet`.
//! Positions and harvests come from these numbers, so the scenario hash and digests depend on their parsing.

mod csv;
mod data;
#[cfg(feature = "parquet")]
mod parquet;

use std::ops::Range;
use std::path::Path;

pub use data::ColumnData;

/// Maximum size of a data file, in bytes. Callers limit their reading to it; this module does not check it.
pub(crate) const MAX_FILE_BYTES: u64 = 256 << 20;

/// Reads the columns `wanted` of the file `bytes` as numbers; a file without rows is an error. The extension of `path`
/// selects the format. Of a file with more than `MAX_VALUES` values in these columns, only `needed_rows` are kept,
/// counted from 0.
///
/// # Errors
/// The problem with the file, without its name.
pub fn read_numbers(
    path: &Path,
    bytes: &[u8],
    wanted: &[String],
    needed_rows: Range<usize>,
) -> Result<ColumnData<f64>, String> {
    let columns = if is_parquet(path) {
        parquet_numbers(bytes, wanted, needed_rows)?
    } else {
        csv::numbers(bytes, wanted, needed_rows)?
    };
    if columns.rows_in_file == 0 {
        return Err("has no rows".to_owned());
    }
    Ok(columns)
}

/// Reads the column `wanted` of the file `bytes` as text; `None` without such a column. Every row is kept, so that rows
/// match [`read_numbers`] with all rows needed.
///
/// # Errors
/// The problem with the file, without its name.
pub fn read_texts(path: &Path, bytes: &[u8], wanted: &str) -> Result<Option<ColumnData<String>>, String> {
    if is_parquet(path) {
        parquet_texts(bytes, wanted)
    } else {
        csv::texts(bytes, wanted)
    }
}

fn is_parquet(path: &Path) -> bool {
    path.extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("parquet"))
}

#[cfg(feature = "parquet")]
use parquet::{numbers as parquet_numbers, texts as parquet_texts};

#[cfg(not(feature = "parquet"))]
const NO_PARQUET_SUPPORT: &str = "is a Parquet file; use a build with the cargo feature `parquet`, or a CSV file";

#[cfg(not(feature = "parquet"))]
fn parquet_numbers(_: &[u8], _: &[String], _: Range<usize>) -> Result<ColumnData<f64>, String> {
    Err(NO_PARQUET_SUPPORT.to_owned())
}

#[cfg(not(feature = "parquet"))]
fn parquet_texts(_: &[u8], _: &str) -> Result<Option<ColumnData<String>>, String> {
    Err(NO_PARQUET_SUPPORT.to_owned())
}
