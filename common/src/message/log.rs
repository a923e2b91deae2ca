//! Emulation: what a run depends on beside its scenario, for observers.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;

/// Emulation, observer → BS, a query: a part of the run's log of inputs, which can be longer than a message may be and
/// grows as the run goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReadLog {
    /// Its first byte, counted from 0.
    pub from: u64,
}

impl Concerns for ReadLog {}

impl fmt::Display for ReadLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "asks for the log of inputs from byte {} on", self.from)
    }
}

/// Emulation, BS → observer: the reply to [`ReadLog`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogPart {
    /// What there is, of a long log [`LogPart::LONGEST`] bytes, or a line that is longer; nothing at its end, or where
    /// there is no log.
    pub bytes: Vec<u8>,
}

impl LogPart {
    /// Bytes of a part that is not the last.
    pub const LONGEST: u64 = 4 << 20;
}
