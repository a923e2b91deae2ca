//! The result table: one row per run, as Parquet or CSV.
//!
//! | columns | what |
//! |---|---|
//! | `scenario_hash`, `preset`, `policy`, `n`, `ttis`, `seed` | which run |
//! | one per swept field, named by its path (`harvest.lambda`) | what the sweep set there |
//! | one per metric of [`reveille_common::metrics`] | what came out; empty where it is not defined (no events) |
//! | `events`, `digest` | events counted; the run's fingerprint |
//!
//! Rows are in the order of the experiment's cells, then of seeds. The same rows always give the same bytes.

mod atomic;
mod columns;
mod csv;
mod error;
#[cfg(test)]
pub(crate) mod fixtures;
mod parquet;
mod row;

use std::path::Path;

pub use atomic::{put, replace};
pub use columns::{Kind, METRICS, Schema, Value, metric_names};
pub use error::TableError;
pub use row::{Hash, Row};

/// The form of the table; raised when a column changes its meaning.
pub const TABLE_VERSION: u32 = 1;

/// Keys of the metadata of a Parquet file, and of the side-car of a CSV file.
pub mod keys {
    /// [`super::TABLE_VERSION`].
    pub const TABLE: &str = "reveille.table";
    /// The version of Reveille that made the runs.
    pub const VERSION: &str = "reveille.version";
    /// The experiment as TOML.
    pub const EXPERIMENT: &str = "reveille.experiment";
    /// SHA-256 over the scenarios of all cells.
    pub const GRID: &str = "reveille.grid";
    /// `i/n` in the table of a shard, `i,j/n` in a merge of some shards; absent in a whole table.
    pub const SHARD: &str = "reveille.shard";
    /// In side-cars: what the swept columns hold, `int`, `float` or `text`, separated by commas.
    pub const KINDS: &str = "reveille.kinds";
    /// In side-cars: the number of rows.
    pub const ROWS: &str = "reveille.rows";
}

/// What a table says about its origin.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct About {
    /// The version of Reveille that made the runs.
    pub version: String,
    /// The experiment as TOML; empty for a CSV file without its side-car.
    pub experiment: String,
    /// SHA-256 over the scenarios of all cells, hexadecimal.
    pub grid: String,
    /// Which shard of the experiment it is; `None` for all of it.
    pub shard: Option<String>,
}

impl About {
    /// What the table at `path` says of itself, without its rows.
    ///
    /// # Errors
    /// As [`Table::read`].
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::of(path) {
            Format::Parquet => parquet::about(path),
            Format::Csv => csv::about(path),
        };
        read.map_err(|failure| failure.of(path))
    }

    /// As key-value metadata, in a fixed order.
    fn pairs(&self) -> Vec<(&'static str, String)> {
        let mut pairs = vec![
            (keys::TABLE, TABLE_VERSION.to_string()),
            (keys::VERSION, self.version.clone()),
            (keys::EXPERIMENT, self.experiment.clone()),
            (keys::GRID, self.grid.clone()),
        ];
        if let Some(shard) = &self.shard {
            pairs.push((keys::SHARD, shard.clone()));
        }
        pairs
    }

    /// From key-value metadata, after a check of the table's version.
    fn from_pairs<'p>(get: impl Fn(&str) -> Option<&'p str>) -> Result<Self, Refusal> {
        let Some(version) = get(keys::TABLE) else {
            return Err(Refusal::NotOurs);
        };
        if version != TABLE_VERSION.to_string() {
            return Err(Refusal::Version {
                found: version.to_owned(),
                by: get(keys::VERSION).unwrap_or("unknown").to_owned(),
            });
        }
        let text = |key: &str| get(key).unwrap_or_default().to_owned();
        Ok(Self {
            version: text(keys::VERSION),
            experiment: text(keys::EXPERIMENT),
            grid: text(keys::GRID),
            shard: get(keys::SHARD).map(str::to_owned),
        })
    }
}

/// Why metadata or columns are not those of a table of this version.
enum Refusal {
    NotOurs,
    Version { found: String, by: String },
    Columns(String),
    Broken(String),
}

/// File formats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// Apache Parquet.
    #[default]
    Parquet,
    /// CSV, with a side-car `NAME.csv.toml` that holds what Parquet keeps in its metadata.
    Csv,
}

impl Format {
    /// The usual ending of its files.
    pub const fn ending(self) -> &'static str {
        match self {
            Self::Parquet => "parquet",
            Self::Csv => "csv",
        }
    }

    /// The format of a file, by its ending; Parquet unless it is `.csv`.
    pub fn of(path: &Path) -> Self {
        if path
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
        {
            Self::Csv
        } else {
            Self::Parquet
        }
    }
}

/// A result table.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Where it comes from.
    pub about: About,
    /// Its columns.
    pub schema: Schema,
    /// One row per run.
    pub rows: Vec<Row>,
}

impl Table {
    /// Reads a table, in the format that the file's ending says.
    ///
    /// # Errors
    /// The file cannot be read, is no result table, is one of another version, or is cut off or corrupt.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::of(path) {
            Format::Parquet => parquet::read(path),
            Format::Csv => csv::read(path),
        };
        read.map_err(|failure| failure.of(path))
    }

    /// Writes the table to `path` in `format`. The file is whole or not there: it is written under another name, synced
    /// to the disk and renamed.
    ///
    /// # Errors
    /// It cannot be written; a file that was there before is untouched.
    pub fn write(&self, path: &Path, format: Format) -> Result<(), TableError> {
        let bytes = match format {
            Format::Parquet => parquet::to_bytes(self),
            Format::Csv => csv::to_bytes(self),
        };
        let bytes = bytes.map_err(|reason| TableError::Encode {
            path: path.to_owned(),
            reason,
        })?;
        let write = |path: &Path, bytes: &[u8]| {
            replace(path, bytes).map_err(|error| TableError::Write {
                path: path.to_owned(),
                error,
            })
        };
        if format == Format::Csv {
            write(&csv::side_car(path), csv::side_car_text(self).as_bytes())?;
        }
        write(path, &bytes)
    }

    /// Takes the table in `format` at `path` away, and with it its side-car.
    ///
    /// # Errors
    /// It is there and cannot be removed.
    pub fn remove(path: &Path, format: Format) -> std::io::Result<()> {
        let remove = |path: &Path| match std::fs::remove_file(path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
            Ok(()) | Err(_) => Ok(()),
        };
        remove(path)?;
        match format {
            Format::Parquet => Ok(()),
            Format::Csv => remove(&csv::side_car(path)),
        }
    }
}

/// Why a read failed, before the file's name is put in front.
enum Failure {
    Io(std::io::Error),
    Refused(Refusal),
}

impl From<std::io::Error> for Failure {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl Failure {
    fn of(self, path: &Path) -> TableError {
        let path = path.to_owned();
        match self {
            Self::Io(error) => TableError::Read { path, error },
            Self::Refused(Refusal::NotOurs) => TableError::NotOurs { path },
            Self::Refused(Refusal::Version { found, by }) => TableError::Version { path, found, by },
            Self::Refused(Refusal::Columns(reason)) => TableError::Columns { path, reason },
            Self::Refused(Refusal::Broken(reason)) => TableError::Broken { path, reason },
        }
    }
}

#[cfg(test)]
mod tests;
