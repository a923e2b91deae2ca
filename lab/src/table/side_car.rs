//! The side-car of a CSV file, `NAME.csv.toml`: what Parquet keeps in its metadata.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::about::About;
use super::columns::ColumnType;
use super::contents::Table;
use super::error::Refusal;
use super::keys;

/// Where the side-car of the CSV file at `csv` is.
pub(super) fn path_of(csv: &Path) -> PathBuf {
    let mut name = OsString::from(csv);
    name.push(".toml");
    PathBuf::from(name)
}

/// The side-car of `table`.
pub(super) fn text(table: &Table) -> String {
    let types: Vec<&str> = table
        .schema
        .swept
        .iter()
        .map(|(_, column_type)| column_type.name())
        .collect();
    let own = [
        (keys::KINDS, types.join(",")),
        (keys::ROWS, table.rows.len().to_string()),
    ];
    let pairs = table.about.pairs().into_iter().chain(own);
    pairs.fold(String::new(), |mut text, (key, value)| {
        let _ = writeln!(text, "\"{key}\" = {}", toml::Value::String(value));
        text
    })
}

/// What the side-car says; nothing of it if there is none.
#[derive(Default)]
pub(super) struct Side {
    pub(super) about: About,
    pub(super) types: Option<Vec<ColumnType>>,
    pub(super) rows: Option<usize>,
}

/// What the side-car `text` says.
pub(super) fn parse(text: &str) -> Result<Side, Refusal> {
    let pairs: BTreeMap<String, String> =
        toml::from_str(text).map_err(|error| Refusal::Broken(format!("its side-car: {}", error.message())))?;
    let broken = |key: &str| Refusal::Broken(format!("its side-car: {key} = \"{}\"", pairs[key].escape_default()));
    let types = pairs.get(keys::KINDS).map(|names| {
        let names = names.split(',').filter(|name| !name.is_empty());
        let types: Option<Vec<ColumnType>> = names.map(ColumnType::named).collect();
        types.ok_or_else(|| broken(keys::KINDS))
    });
    let rows = pairs
        .get(keys::ROWS)
        .map(|rows| rows.parse().map_err(|_| broken(keys::ROWS)));
    Ok(Side {
        about: About::from_pairs(|key| pairs.get(key).map(String::as_str))?,
        types: types.transpose()?,
        rows: rows.transpose()?,
    })
}
