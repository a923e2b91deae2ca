//! Histories in files.

use std::path::Path;

use super::error::TuningError;
use super::history::History;
use crate::io::{read, replace};

impl History {
    /// The history in the file at `path`, and whether half a line at its end was left out.
    ///
    /// # Errors
    /// The file cannot be read or is no history.
    pub fn read(path: &Path) -> Result<(Self, bool), TuningError> {
        let bytes = read(path).map_err(|error| TuningError::Read {
            path: path.to_owned(),
            error,
        })?;
        let parsed = String::from_utf8(bytes).map_err(|_| "it is no text".to_owned());
        parsed
            .and_then(|text| Self::parse(&text))
            .map_err(|why| TuningError::NotOurs {
                path: path.to_owned(),
                why,
            })
    }

    /// Puts the history in the file at `path`, whole or not at all.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TuningError> {
        replace(path, self.to_csv().as_bytes()).map_err(|error| TuningError::Write {
            path: path.to_owned(),
            error,
        })
    }
}
