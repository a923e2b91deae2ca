//! Why a sweep cannot start, go on, or be merged.

use std::fmt::Display;
use std::io;
use std::path::PathBuf;

use reveille_common::scenario::ScenarioError;

use crate::table::TableError;

/// A sweep that cannot start, go on, or be merged, and why.
#[derive(Debug, thiserror::Error)]
pub enum SweepError {
    /// The experiment file cannot be read.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
    /// The experiment file is not TOML, or has fields that experiments do not have.
    #[error("{name}, line {line}: {reason}")]
    Syntax {
        /// The file's name.
        name: String,
        /// The line, from 1.
        line: usize,
        /// What is wrong there.
        reason: String,
    },
    /// A value of the experiment cannot be used.
    #[error("{field} = {value}: {allowed}")]
    Invalid {
        /// The option or field.
        field: String,
        /// Its value.
        value: String,
        /// What it has to be, and what to do.
        allowed: String,
    },
    /// A cell's scenario cannot be used.
    #[error("the cell {cell}: {error}")]
    Scenario {
        /// The cell.
        cell: String,
        /// What is wrong with its scenario.
        error: Box<ScenarioError>,
    },
    /// The output folder cannot be used.
    #[error("--out {}: {reason}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// The journal cannot be written, for example because the disk is full.
    #[error(
        "{}: cannot be written: {error}; the runs in it, {kept} so far, are kept: free some space or mend the disk, \
         then give the same command again to go on",
        path.display()
    )]
    Journal {
        /// The journal.
        path: PathBuf,
        /// Runs that it holds.
        kept: usize,
        /// What the operating system said.
        error: io::Error,
    },
    /// The result table cannot be read or written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// The table of a sweep cannot be written, for example because the disk is full; its runs are safe.
    #[error(
        "{error}; the runs, {kept} so far, are kept in {}: free some space or mend the disk, then give the \
         same command again to go on",
        folder.display()
    )]
    Results {
        /// The folder of the sweep.
        folder: PathBuf,
        /// Runs that its journal holds.
        kept: usize,
        /// The table, and what the operating system said.
        error: TableError,
    },
    /// A folder holds no table that tells of all its runs.
    #[error("{}: {reason}", folder.display())]
    NoTable {
        /// The folder.
        folder: PathBuf,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// Tables do not make up one sweep.
    #[error("{}: {reason}", path.display())]
    Merge {
        /// The table that does not fit.
        path: PathBuf,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// The runs of a table cannot be taken over.
    #[error(
        "--reuse {}: was written by reveille {version}, whose runs may have come out differently; make them anew, or \
         go on with that version",
        path.display()
    )]
    Reuse {
        /// The table.
        path: PathBuf,
        /// The version that wrote it.
        version: String,
    },
    /// Threads cannot be started.
    #[error("--threads {threads}: {reason}")]
    Threads {
        /// The number of threads that was asked for.
        threads: usize,
        /// Why they cannot be started.
        reason: String,
    },
}

impl SweepError {
    /// A value that cannot be used.
    pub(super) fn invalid(field: impl Into<String>, value: impl Display, allowed: impl Into<String>) -> Self {
        let value = value.to_string();
        let shown: String = value.chars().take(60).collect();
        Self::Invalid {
            field: field.into(),
            value: if shown.len() < value.len() {
                shown + "…"
            } else {
                value
            },
            allowed: allowed.into(),
        }
    }
}
