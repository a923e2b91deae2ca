//! The columns of a result table: identity, swept fields, metrics, `events` and `digest`, in this order in each format.
//! `csv` and `parquet` write and read the fixed columns by position: change both with a constant below, and also the
//! lists in `mod.rs` and `docs/results.md`.

use std::fmt;

use reveille_bs::scenario::current_field;
use reveille_common::score::Metrics;

use super::error::SchemaMismatch;

/// The columns before the swept ones.
pub(super) const IDENTITY_COLUMNS: [&str; 6] = ["scenario_hash", "preset", "policy", "n", "ttis", "seed"];
/// The columns after the metrics.
pub(super) const TRAILING_COLUMNS: [&str; 2] = ["events", "digest"];

/// The value of a swept field.
#[derive(Clone, Debug, PartialEq)]
pub enum SweptValue {
    /// A whole number.
    Int(i64),
    /// A number.
    Float(f64),
    /// Anything else, a list as TOML.
    Text(String),
}

impl fmt::Display for SweptValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Int(value) => write!(f, "{value}"),
            Self::Float(value) => write!(f, "{value}"),
            Self::Text(value) => write!(f, "{value}"),
        }
    }
}

/// The type of a swept column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColumnType {
    /// Whole numbers.
    Int,
    /// Numbers.
    Float,
    /// Text.
    Text,
}

impl SweptValue {
    /// The type of the value.
    pub const fn column_type(&self) -> ColumnType {
        match self {
            Self::Int(_) => ColumnType::Int,
            Self::Float(_) => ColumnType::Float,
            Self::Text(_) => ColumnType::Text,
        }
    }

    /// Converts the value to the type of its column: whole numbers to floats in a float column, any value to text in a
    /// text column. A value that the column cannot hold stays as it is; Parquet then refuses to encode it.
    #[must_use]
    pub(crate) fn into_type(self, column_type: ColumnType) -> Self {
        match (column_type, self) {
            (ColumnType::Float, Self::Int(value)) => Self::Float(value as f64),
            (ColumnType::Text, value) => Self::Text(value.to_string()),
            (ColumnType::Int | ColumnType::Float, value) => value,
        }
    }
}

impl ColumnType {
    /// All types.
    const ALL: [Self; 3] = [Self::Int, Self::Float, Self::Text];

    /// The name in sidecars, part of the file format.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Int => "int",
            Self::Float => "float",
            Self::Text => "text",
        }
    }

    pub(super) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|column_type| column_type.name() == name)
    }

    /// Returns the type that holds both.
    #[must_use]
    pub const fn join(self, other: Self) -> Self {
        match (self, other) {
            (Self::Int, Self::Int) => Self::Int,
            (Self::Text, _) | (_, Self::Text) => Self::Text,
            (Self::Int | Self::Float, Self::Int | Self::Float) => Self::Float,
        }
    }
}

/// The columns that differ between tables: the swept fields. All others are fixed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Schema {
    /// Path and type of each swept field beyond preset, policy, N and TTIs.
    pub swept: Vec<(String, ColumnType)>,
}

impl Schema {
    /// The names of all columns, in order.
    pub fn names(&self) -> Vec<&str> {
        let swept = self.swept.iter().map(|(name, _)| name.as_str());
        let fixed = Metrics::NAMES.into_iter().chain(TRAILING_COLUMNS);
        IDENTITY_COLUMNS.into_iter().chain(swept).chain(fixed).collect()
    }

    /// Returns the index of the swept field at `path`.
    pub fn position(&self, path: &str) -> Option<usize> {
        self.swept.iter().position(|(name, _)| name == path)
    }
}

/// The columns of a file that can differ between versions and tables.
pub(super) struct FileColumns {
    /// Today's name of each swept column, in the order of the file.
    pub(super) swept_names: Vec<String>,
    /// The index in [`Metrics::NAMES`] of each column of a metric, ascending.
    pub(super) metric_indices: Vec<usize>,
}

impl FileColumns {
    /// Finds the swept columns and the metrics in `header`, and checks all others. Fields and metrics may have former
    /// names, and metrics that were added later may be absent. The first metric's name ends the swept columns, so no
    /// field of scenarios may have the name of a metric.
    pub(super) fn from_header(header: &[&str]) -> Result<Self, SchemaMismatch> {
        let metric_index = |name: &str| {
            let name = Metrics::current_name(name);
            Metrics::NAMES.iter().position(|metric| *metric == name)
        };
        let mismatch = || columns_mismatch(&Schema::default().names(), header);
        let first_metric = header
            .iter()
            .position(|name| metric_index(name).is_some())
            .ok_or_else(mismatch)?;
        let (Some(metrics_end), Some(swept_names)) = (
            header.len().checked_sub(TRAILING_COLUMNS.len()),
            header.get(IDENTITY_COLUMNS.len()..first_metric),
        ) else {
            return Err(mismatch());
        };
        let metric_names = header.get(first_metric..metrics_end).ok_or_else(mismatch)?;
        let metric_indices: Option<Vec<usize>> = metric_names.iter().map(|name| metric_index(name)).collect();
        let metric_indices = metric_indices.ok_or_else(mismatch)?;
        let is_present_or_later =
            |(index, name): (usize, &&str)| metric_indices.contains(&index) || Metrics::ADDED_LATER.contains(name);
        if header.starts_with(&IDENTITY_COLUMNS)
            && header.ends_with(&TRAILING_COLUMNS)
            && metric_indices.is_sorted_by(|a, b| a < b)
            && Metrics::NAMES.iter().enumerate().all(is_present_or_later)
        {
            Ok(Self {
                swept_names: swept_names.iter().map(|name| current_field(name)).collect(),
                metric_indices,
            })
        } else {
            Err(mismatch())
        }
    }
}

/// Describes the first difference between the names of columns that every table has and the names in a file.
fn columns_mismatch(expected: &[&str], found: &[&str]) -> SchemaMismatch {
    // Without this column the file belongs to another program, and a list of missing columns would mislead.
    if !found.contains(&IDENTITY_COLUMNS[0]) {
        return SchemaMismatch::NotOurs;
    }
    let current_names: Vec<&str> = found.iter().map(|name| Metrics::current_name(name)).collect();
    let is_missing = |name: &&&str| !current_names.contains(*name) && !Metrics::ADDED_LATER.contains(*name);
    let missing = expected.iter().find(is_missing);
    SchemaMismatch::Columns(missing.map_or_else(
        || "its columns are in another order".to_owned(),
        |name| format!("it has no column `{name}`, or has columns of metrics that this version does not know"),
    ))
}
