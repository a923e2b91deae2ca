//! Errors of reading and writing a result table. Decoders return a [`SchemaMismatch`]; `io` adds the file's path.

use std::io;
use std::path::{Path, PathBuf};

use reveille_common::declare::describe_read_error;

/// The version of the table format, raised when a column changes its name or meaning, or a metric is added. Still read:
/// version 1, with former names of metrics, and versions 2 to 4, without `Metrics::ADDED_LATER` or part of it.
pub(crate) const TABLE_VERSION: u32 = 5;

/// A reason why a result table cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The operating system refuses to read the file.
    #[error("{}: {}", path.display(), describe_read_error(error, "name a table of `reveille sweep` or its folder"))]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The operating system refuses to write the file, for example because the disk is full.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The rows do not fit the format.
    #[error("{}: the table cannot be encoded: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// The cause.
        reason: String,
    },
    /// The file is not a table of Reveille.
    #[error("{}: is not a result table of Reveille; use a table written by `reveille sweep`", path.display())]
    NotOurs {
        /// The file.
        path: PathBuf,
    },
    /// The table has another version.
    #[error(
        "{}: is a result table of version {table_version}, written by reveille {reveille_version}; this reveille reads \
         versions 1 to {TABLE_VERSION}; use that release, or run the sweep again",
        path.display()
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// The version of its format.
        table_version: String,
        /// The version of Reveille that wrote it.
        reveille_version: String,
    },
    /// The columns differ from this version's.
    #[error("{}: is not a result table: {reason}; use a table written by `reveille sweep`", path.display())]
    Columns {
        /// The file.
        path: PathBuf,
        /// The difference.
        reason: String,
    },
    /// The file is cut off or corrupt.
    #[error(
        "{}: is cut off or corrupt ({reason}); run `reveille sweep` or `reveille merge` again",
        path.display()
    )]
    Broken {
        /// The file.
        path: PathBuf,
        /// The cause.
        reason: String,
    },
}

/// A mismatch between a file and the tables of this version. The variants are [`TableError`]'s, each with its reason.
pub(super) enum SchemaMismatch {
    NotOurs,
    Version {
        table_version: String,
        reveille_version: String,
    },
    Columns(String),
    Broken(String),
}

/// A read error without the file's name.
pub(super) enum ReadFailure {
    Io(io::Error),
    Mismatch(SchemaMismatch),
}

impl From<io::Error> for ReadFailure {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<SchemaMismatch> for ReadFailure {
    fn from(mismatch: SchemaMismatch) -> Self {
        Self::Mismatch(mismatch)
    }
}

impl ReadFailure {
    /// Adds the path of the file.
    pub(super) fn with_path(self, path: &Path) -> TableError {
        let path = path.to_owned();
        match self {
            Self::Io(error) => TableError::Read { path, error },
            Self::Mismatch(SchemaMismatch::NotOurs) => TableError::NotOurs { path },
            Self::Mismatch(SchemaMismatch::Version {
                table_version,
                reveille_version,
            }) => TableError::Version {
                path,
                table_version,
                reveille_version,
            },
            Self::Mismatch(SchemaMismatch::Columns(reason)) => TableError::Columns { path, reason },
            Self::Mismatch(SchemaMismatch::Broken(reason)) => TableError::Broken { path, reason },
        }
    }
}
