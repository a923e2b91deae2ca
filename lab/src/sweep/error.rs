//! Errors of sweeps, their folders and merges. Each message names the thing, the cause and, if known, the fix. Outside
//! tests, no code reads the texts. `deploy` prints them; `python/src/runs.rs` tells [`SweepError::Panicked`] apart.

use std::any::Any;
use std::fmt::Display;
use std::io;
use std::path::PathBuf;

use reveille_common::declare::describe_read_error;
use reveille_common::scenario::ScenarioError;

use crate::table::TableError;

/// A reason why a sweep cannot start, resume, finish or be merged.
#[derive(Debug, thiserror::Error)]
pub enum SweepError {
    /// The experiment file cannot be read.
    #[error(
        "{}: {}",
        path.display(),
        describe_read_error(error, "name an experiment file, such as deploy/examples/experiment.toml")
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The experiment file is not TOML, or has unknown fields.
    #[error("{name}, line {line}: {reason}")]
    Syntax {
        /// The file's name.
        name: String,
        /// The line, from 1.
        line: usize,
        /// The cause.
        reason: String,
    },
    /// A value of the experiment is invalid.
    #[error("{field} = {value}: {requirement}")]
    Invalid {
        /// The option or field.
        field: String,
        /// The value.
        value: String,
        /// The requirement on the value, and the fix.
        requirement: String,
    },
    /// The scenario of a cell is invalid.
    #[error("the cell {cell}: {error}")]
    Scenario {
        /// The cell.
        cell: String,
        /// The cause.
        error: Box<ScenarioError>,
    },
    /// The script of actions cannot be read, or an action is impossible in a cell.
    #[error("{name}: {reason}")]
    Actions {
        /// The option with its file, or the field of the experiment.
        name: String,
        /// The cause and the fix.
        reason: String,
    },
    /// The output folder cannot be used.
    #[error("--out {}: {reason}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// The cause and the fix.
        reason: String,
    },
    /// The journal cannot be written, for example because the disk is full.
    #[error(
        "{}: cannot be written: {error}; its {recorded} runs are kept; free some space or repair the disk, then give \
         the same command again to resume",
        path.display()
    )]
    Journal {
        /// The journal.
        path: PathBuf,
        /// The number of runs in it.
        recorded: usize,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The result table cannot be read or written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// The table of a sweep cannot be written, for example because the disk is full; the runs are kept.
    #[error(
        "{error}; the {recorded} finished runs are kept in {}; free some space or repair the disk, then give the same \
         command again to resume",
        folder.display()
    )]
    Results {
        /// The folder of the sweep.
        folder: PathBuf,
        /// The number of runs in its journal.
        recorded: usize,
        /// The table and the error of the operating system.
        error: TableError,
    },
    /// A folder holds no table with all its runs.
    #[error("{}: the folder holds no table with all runs of its sweep: {reason}", folder.display())]
    NoTable {
        /// The folder.
        folder: PathBuf,
        /// The cause and the fix.
        reason: String,
    },
    /// The tables are not the shards of one sweep.
    #[error("{}: cannot be merged: {reason}", path.display())]
    Merge {
        /// The table that does not fit.
        path: PathBuf,
        /// The cause and the fix.
        reason: String,
    },
    /// The runs of a table cannot be reused.
    #[error(
        "--reuse {}: was written by reveille {version}, whose results may differ; run it again without --reuse, or use \
         that version",
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
        /// The requested number of threads.
        threads: usize,
        /// The cause.
        reason: String,
    },
    /// A thread of the sweep panicked; the text is the panic's message.
    #[error("the sweep panicked, which is a bug in Reveille: {0}")]
    Panicked(String),
}

impl SweepError {
    /// Creates the error of a panic from its payload, as [`std::panic::catch_unwind`] returns it.
    pub fn from_panic(payload: &(dyn Any + Send)) -> Self {
        let text = payload.downcast_ref::<&str>().copied();
        let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
        Self::Panicked(text.unwrap_or("without a message").to_owned())
    }

    /// Creates the error of an invalid value; shows at most 60 characters of it.
    pub(super) fn invalid(field: impl Into<String>, value: impl Display, requirement: impl Into<String>) -> Self {
        let value = value.to_string();
        let shown: String = value.chars().take(60).collect();
        Self::Invalid {
            field: field.into(),
            value: if shown.len() < value.len() {
                shown + "…"
            } else {
                value
            },
            requirement: requirement.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_keeps_its_message() {
        let payloads: [(Box<dyn Any + Send>, &str); 3] = [
            (Box::new("fixed"), "fixed"),
            (Box::new("formatted".to_owned()), "formatted"),
            (Box::new(7), "without a message"),
        ];
        for (payload, message) in payloads {
            let error = SweepError::from_panic(&*payload).to_string();
            assert_eq!(
                error,
                format!("the sweep panicked, which is a bug in Reveille: {message}")
            );
        }
    }
}
