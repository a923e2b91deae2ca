//! Tables in files, in either format.

use std::fs::File;
use std::io;
use std::path::Path;

use super::about::About;
use super::contents::Table;
use super::error::{Failure, TableError};
use super::side_car::{self, Side};
use super::{csv, parquet};
use crate::io::{read_text, remove, replace};

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

impl About {
    /// What the table at `path` says of itself, without its rows.
    ///
    /// # Errors
    /// As [`Table::read`].
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::of(path) {
            Format::Parquet => open(path).and_then(|file| Ok(parquet::about(file)?)),
            Format::Csv => side_of(path).map(|side| side.about),
        };
        read.map_err(|failure| failure.of(path))
    }
}

impl Table {
    /// Reads a table, in the format that the file's ending says.
    ///
    /// # Errors
    /// The file cannot be read, is no result table, is one of another version, or is cut off or corrupt.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::of(path) {
            Format::Parquet => open(path).and_then(|file| Ok(parquet::decode(file)?)),
            Format::Csv => csv_at(path),
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
            write(&side_car::path_of(path), side_car::text(self).as_bytes())?;
        }
        write(path, &bytes)
    }

    /// Takes the table in `format` at `path` away, and with it its side-car.
    ///
    /// # Errors
    /// It is there and cannot be removed.
    pub fn remove(path: &Path, format: Format) -> io::Result<()> {
        remove(path)?;
        match format {
            Format::Parquet => Ok(()),
            Format::Csv => remove(&side_car::path_of(path)),
        }
    }
}

fn open(path: &Path) -> Result<File, Failure> {
    Ok(crate::io::open(path)?)
}

fn csv_at(path: &Path) -> Result<Table, Failure> {
    let text = read_text(path)?;
    Ok(csv::decode(&text, side_of(path)?)?)
}

/// What the side-car of the CSV file at `path` says; nothing if there is none.
fn side_of(path: &Path) -> Result<Side, Failure> {
    match read_text(&side_car::path_of(path)) {
        Ok(text) => Ok(side_car::parse(&text)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Side::default()),
        Err(error) => Err(error.into()),
    }
}
