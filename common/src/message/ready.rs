//! Emulation: a host is ready.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::HostId;

/// Emulation, host → BS, a query: the host is subscribed to everything and waits for the first TTI. The reply says
/// whether its places are still its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ready {
    /// The host.
    pub host: HostId,
}

impl Concerns for Ready {}

impl fmt::Display for Ready {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "host {} is ready", self.host)
    }
}
