//! Errors of a tuning and of its history file. Each message names the thing, the cause and the fix. Outside tests, no
//! code reads the texts.

use std::path::PathBuf;

use reveille_common::declare::describe_read_error;

use crate::training::TrainingError;

/// A reason why a tuning cannot start or finish.
#[derive(Debug, thiserror::Error)]
pub enum TuningError {
    /// A value is out of range.
    #[error("{option} = {value}: {requirement}")]
    Invalid {
        /// The option.
        option: &'static str,
        /// The value.
        value: String,
        /// The requirement on the value: `must be …`.
        requirement: String,
    },
    /// The tables of a pair cannot be trained.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// No evaluation run has an event that counts.
    #[error("no evaluation run of {ttis} TTIs has a counted event; use longer runs (--ttis)")]
    NoEvent {
        /// The length of the evaluation runs, TTIs.
        ttis: u64,
    },
    /// The file is not a history.
    #[error("{}: is not a history of a tuning: {reason}", path.display())]
    NotAHistory {
        /// The file.
        path: PathBuf,
        /// The cause.
        reason: String,
    },
    /// The history belongs to another tuning.
    #[error(
        "{}: is the history of another tuning ({differences}); use the options of that tuning, another --out, or \
         --force to start over",
        path.display()
    )]
    OtherTuning {
        /// The file.
        path: PathBuf,
        /// The differences.
        differences: String,
    },
    /// The history cannot be read.
    #[error("{}: {}", path.display(), describe_read_error(error, "name the history.csv of a tuning"))]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: std::io::Error,
    },
    /// The history cannot be written.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: std::io::Error,
    },
    /// The optimiser or the surrogate has failed.
    #[error("the {part} failed: {reason}")]
    Model {
        /// The part that failed.
        part: &'static str,
        /// The cause.
        reason: String,
    },
}
