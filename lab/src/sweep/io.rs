//! Experiments in files.

use std::path::Path;

use super::draft::Draft;
use super::error::SweepError;
use crate::io::read_short;

/// Bytes of the longest experiment that is read.
const LONGEST: u64 = 1 << 20;

impl Draft {
    /// Reads the experiment file at `path`.
    ///
    /// # Errors
    /// It cannot be read, or as [`Draft::parse`].
    pub fn load(path: &Path) -> Result<Self, SweepError> {
        let text = read_short(path, LONGEST).map_err(|error| SweepError::Read {
            path: path.to_owned(),
            error,
        })?;
        Self::parse(&text, &path.to_string_lossy(), path.parent().unwrap_or(Path::new("")))
    }
}
