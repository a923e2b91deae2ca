//! Emulation: what a run is of, for observers.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;

/// Emulation, observer → BS, a query: the scenario of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Describe;

impl Concerns for Describe {}

impl fmt::Display for Describe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("asks for the scenario")
    }
}

/// Emulation, BS → observer: the reply to [`Describe`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// The text of the scenario file.
    pub scenario: String,
    /// The files that it names: path relative to its own, and bytes.
    pub files: Vec<(String, Vec<u8>)>,
}
