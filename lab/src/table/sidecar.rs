//! The sidecar of a CSV file, `NAME.csv.toml`, which holds the metadata of a Parquet file. Its keys are in `metadata`.
//! A CSV file without a sidecar must still be readable.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::Table;
use super::columns::ColumnType;
use super::error::SchemaMismatch;
use super::metadata::{self, TableMetadata};

pub(super) fn sidecar_path(csv: &Path) -> PathBuf {
    let mut name = OsString::from(csv);
    name.push(".toml");
    PathBuf::from(name)
}

pub(super) fn to_text(table: &Table) -> String {
    let types: Vec<&str> = table
        .schema
        .swept
        .iter()
        .map(|(_, column_type)| column_type.name())
        .collect();
    let csv_pairs = [
        (metadata::COLUMN_TYPES_KEY, types.join(",")),
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
    pub(super) column_types: Option<Vec<ColumnType>>,
    pub(super) row_count: Option<usize>,
}

pub(super) fn parse(text: &str) -> Result<Sidecar, SchemaMismatch> {
    let pairs: BTreeMap<String, String> =
        toml::from_str(text).map_err(|error| SchemaMismatch::Broken(format!("its side-car: {}", error.message())))?;
    let broken =
        |key: &str| SchemaMismatch::Broken(format!("its side-car: {key} = \"{}\"", pairs[key].escape_default()));
    let types = pairs.get(metadata::COLUMN_TYPES_KEY).map(|names| {
        let names = names.split(',').filter(|name| !name.is_empty());
        let types: Option<Vec<ColumnType>> = names.map(ColumnType::named).collect();
        types.ok_or_else(|| broken(metadata::COLUMN_TYPES_KEY))
    });
    let rows = pairs
        .get(metadata::ROW_COUNT_KEY)
        .map(|rows| rows.parse().map_err(|_| broken(metadata::ROW_COUNT_KEY)));
    Ok(Sidecar {
        metadata: TableMetadata::from_pairs(|key| pairs.get(key).map(String::as_str))?,
        column_types: types.transpose()?,
        row_count: rows.transpose()?,
    })
}
