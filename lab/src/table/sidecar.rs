//! The sidecar of a CSV file, `NAME.csv.toml`, which holds the metadata of a Parquet file. Its keys are in `metadata`;
//! it also has the types of the swept columns and the number of rows. A CSV file without a sidecar must still be
//! readable. `io` reads and writes both files; error texts call this one the side-car.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::Table;
use super::columns::ColumnType;
use super::error::SchemaMismatch;
use super::metadata::{self, TableMetadata};

/// Returns the path of the sidecar of the CSV file at `csv_path`.
pub(super) fn sidecar_path(csv_path: &Path) -> PathBuf {
    let mut path = OsString::from(csv_path);
    path.push(".toml");
    PathBuf::from(path)
}

/// Returns the sidecar of `table`. All its values are TOML strings.
pub(super) fn to_text(table: &Table) -> String {
    let type_names: Vec<&str> = table
        .schema
        .swept
        .iter()
        .map(|(_, column_type)| column_type.name())
        .collect();
    let csv_pairs = [
        (metadata::COLUMN_TYPES_KEY, type_names.join(",")),
        (metadata::ROW_COUNT_KEY, table.rows.len().to_string()),
    ];
    let pairs = table.metadata.pairs().into_iter().chain(csv_pairs);
    pairs.fold(String::new(), |mut text, (key, value)| {
        let _ = writeln!(text, "\"{key}\" = {}", toml::Value::String(value));
        text
    })
}

/// The content of a sidecar; empty for a CSV file without one.
#[derive(Default)]
pub(super) struct Sidecar {
    pub(super) metadata: TableMetadata,
    /// The types of the swept columns, in their order; `csv` checks their number.
    pub(super) column_types: Option<Vec<ColumnType>>,
    /// The number of rows, by which `csv` finds a table that is cut off.
    pub(super) row_count: Option<usize>,
}

/// Parses the text of a sidecar. The types and the number of rows may be absent; the metadata may not.
pub(super) fn parse(text: &str) -> Result<Sidecar, SchemaMismatch> {
    let pairs: BTreeMap<String, String> =
        toml::from_str(text).map_err(|error| SchemaMismatch::Broken(format!("its side-car: {}", error.message())))?;
    let broken =
        |key: &str| SchemaMismatch::Broken(format!("its side-car: {key} = \"{}\"", pairs[key].escape_default()));
    let column_types = pairs.get(metadata::COLUMN_TYPES_KEY).map(|names| {
        let names = names.split(',').filter(|name| !name.is_empty());
        let types: Option<Vec<ColumnType>> = names.map(ColumnType::from_name).collect();
        types.ok_or_else(|| broken(metadata::COLUMN_TYPES_KEY))
    });
    let row_count = pairs
        .get(metadata::ROW_COUNT_KEY)
        .map(|rows| rows.parse().map_err(|_| broken(metadata::ROW_COUNT_KEY)));
    Ok(Sidecar {
        metadata: TableMetadata::from_pairs(|key| pairs.get(key).map(String::as_str))?,
        column_types: column_types.transpose()?,
        row_count: row_count.transpose()?,
    })
}
