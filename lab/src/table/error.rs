//! Why a result table cannot be read or written.

use std::io;
use std::path::{Path, PathBuf};

use super::keys::TABLE_VERSION;

/// A result table that cannot be read or written, and why.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The operating system refuses.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What it said.
        error: io::Error,
    },
    /// The operating system refuses, for example because the disk is full.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What it said.
        error: io::Error,
    },
    /// The rows do not go into the format.
    #[error("{}: the table cannot be encoded: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// Why it cannot be encoded.
        reason: String,
    },
    /// The file is no table of Reveille.
    #[error("{}: is not a result table of Reveille; `reveille sweep` and `reveille merge` write those", path.display())]
    NotOurs {
        /// The file.
        path: PathBuf,
    },
    /// A table of another version.
    #[error(
        "{}: is a result table of version {found}, written by reveille {by}; this reveille reads version \
         {TABLE_VERSION}: use that one, or run the sweep again",
        path.display()
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: String,
        /// The version of Reveille that wrote it.
        by: String,
    },
    /// The columns are not those of this version.
    #[error("{}: has not the columns of a result table: {reason}", path.display())]
    Columns {
        /// The file.
        path: PathBuf,
        /// What differs.
        reason: String,
    },
    /// Cut off or corrupt.
    #[error(
        "{}: is cut off or corrupt ({reason}); run `reveille sweep` or `reveille merge` again to make it anew",
        path.display()
    )]
    Broken {
        /// The file.
        path: PathBuf,
        /// What the reader stumbled over.
        reason: String,
    },
}

/// Why metadata or columns are not those of a table of this version.
pub(super) enum Refusal {
    NotOurs,
    Version { found: String, by: String },
    Columns(String),
    Broken(String),
}

/// Why a read failed, before the file's name is put in front.
pub(super) enum Failure {
    Io(io::Error),
    Refused(Refusal),
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl Failure {
    /// The error of the file at `path`.
    pub(super) fn of(self, path: &Path) -> TableError {
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
