//! Emulation: what a run is of, for observers.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::DeviceId;

/// Emulation, observer → BS, a query: the scenario of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Describe;

impl Concerns for Describe {
    fn concerns(&self, _number: Option<u32>, _device: DeviceId) -> bool {
        false
    }
}

impl fmt::Display for Describe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("asks for the scenario")
    }
}

/// Emulation, observer → BS, a query: a part of the run's log of inputs, which can be longer than a message may be and
/// grows as the run goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReadLog {
    /// Its first byte, counted from 0.
    pub from: u64,
}

impl Concerns for ReadLog {
    fn concerns(&self, _number: Option<u32>, _device: DeviceId) -> bool {
        false
    }
}

impl fmt::Display for ReadLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "asks for the log of inputs from byte {} on", self.from)
    }
}

/// Emulation, BS → observer: the reply to [`ReadLog`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogPart {
    /// What there is, up to [`LogPart::LONGEST`] bytes; nothing at the end of the log, or where there is none.
    pub bytes: Vec<u8>,
}

impl LogPart {
    /// The most bytes of a part.
    pub const LONGEST: u64 = 4 << 20;
}

/// Emulation, BS → observer: the reply to [`Describe`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// The text of the scenario file.
    pub scenario: String,
    /// The files that it names: path relative to its own, and bytes.
    pub files: Vec<(String, Vec<u8>)>,
}
