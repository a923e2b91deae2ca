//! Tables in files: reading by the file's extension, and atomic writing. `parquet` and `csv` encode and decode them.

use std::fs::File;
use std::io;
use std::path::Path;

use super::error::{ReadFailure, TableError};
use super::metadata::TableMetadata;
use super::sidecar::{self, Sidecar};
use super::{Table, csv, parquet};
use crate::io::{read_text, remove, replace};

/// A file format.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// Apache Parquet.
    #[default]
    Parquet,
    /// CSV, with a sidecar `NAME.csv.toml` that holds the metadata.
    Csv,
}

impl Format {
    /// The usual extension of its files.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Parquet => "parquet",
            Self::Csv => "csv",
        }
    }

    /// Returns the format of a file by its extension; Parquet unless it is `.csv`.
    pub fn from_path(path: &Path) -> Self {
        if path
            .extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case("csv"))
        {
            Self::Csv
        } else {
            Self::Parquet
        }
    }
}

impl TableMetadata {
    /// Reads the metadata of the table at `path`, without its rows.
    ///
    /// # Errors
    /// See [`Table::read`].
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::from_path(path) {
            Format::Parquet => open_file(path).and_then(|file| Ok(parquet::decode_metadata(file)?)),
            // The table may have no sidecar, but it must exist.
            Format::Csv => open_file(path).and_then(|_| Ok(read_sidecar(path)?.metadata)),
        };
        read.map_err(|failure| failure.with_path(path))
    }
}

impl Table {
    /// Reads a table, in the format of the file's extension.
    ///
    /// # Errors
    /// If the file cannot be read, is not a result table, has another version, or is cut off or corrupt.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        let read = match Format::from_path(path) {
            Format::Parquet => open_file(path).and_then(|file| Ok(parquet::decode(file)?)),
            Format::Csv => read_csv(path),
        };
        read.map_err(|failure| failure.with_path(path))
    }

    /// Writes the table to `path` in `format`, atomically: under another name, synced to the disk and then renamed.
    ///
    /// # Errors
    /// If the file cannot be written; an existing file is unchanged.
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
        // The sidecar first: a table that exists counts as complete, so its sidecar must exist too.
        if format == Format::Csv {
            write(&sidecar::sidecar_path(path), sidecar::to_text(self).as_bytes())?;
        }
        write(path, &bytes)
    }

    /// Removes the table in `format` at `path`, and its sidecar.
    ///
    /// # Errors
    /// If a file exists and cannot be removed.
    pub fn remove(path: &Path, format: Format) -> io::Result<()> {
        // In the reverse order of `write`: no table is ever without its sidecar.
        remove(path)?;
        match format {
            Format::Parquet => Ok(()),
            Format::Csv => remove(&sidecar::sidecar_path(path)),
        }
    }
}

fn open_file(path: &Path) -> Result<File, ReadFailure> {
    Ok(crate::io::open_regular(path)?)
}

fn read_csv(path: &Path) -> Result<Table, ReadFailure> {
    let text = read_text(path)?;
    Ok(csv::decode(&text, read_sidecar(path)?)?)
}

/// Reads the sidecar of the CSV file at `path`; empty if it does not exist.
fn read_sidecar(path: &Path) -> Result<Sidecar, ReadFailure> {
    match read_text(&sidecar::sidecar_path(path)) {
        Ok(text) => Ok(sidecar::parse(&text)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Sidecar::default()),
        Err(error) => Err(error.into()),
    }
}
