//! Columns of CSV files (and of Parquet files, with the cargo feature `parquet`), from their bytes.

mod cells;
mod csv;
mod limits;
#[cfg(feature = "parquet")]
mod parquet;

use std::path::Path;

pub use cells::Columns;

/// Bytes of the largest data file that is read.
pub const LARGEST_FILE: u64 = 256 << 20;

/// The columns `wanted` of numbers of the file `bytes`, at least one row; `path` tells its form by its ending.
///
/// # Errors
/// What is wrong with the file, without its name.
pub fn numbers(path: &Path, bytes: &[u8], wanted: &[String]) -> Result<Columns<f64>, String> {
    let columns = if is_parquet(path) {
        parquet_numbers(bytes, wanted)?
    } else {
        csv::numbers(bytes, wanted)?
    };
    if columns.is_empty() {
        return Err("has no rows".to_owned());
    }
    Ok(columns)
}

/// The column `wanted` of texts of the file `bytes`, if it has it.
///
/// # Errors
/// What is wrong with the file, without its name.
pub fn texts(path: &Path, bytes: &[u8], wanted: &str) -> Result<Option<Columns<String>>, String> {
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
const WITHOUT_PARQUET: &str = "is a Parquet file, which only a build with the cargo feature `parquet` reads: cargo run \
                               --release --features parquet -- …";

#[cfg(not(feature = "parquet"))]
fn parquet_numbers(_: &[u8], _: &[String]) -> Result<Columns<f64>, String> {
    Err(WITHOUT_PARQUET.to_owned())
}

#[cfg(not(feature = "parquet"))]
fn parquet_texts(_: &[u8], _: &str) -> Result<Option<Columns<String>>, String> {
    Err(WITHOUT_PARQUET.to_owned())
}
