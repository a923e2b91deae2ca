//! Emulation: joining a run.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Assignment, Concerns};

/// Emulation, host → BS, a query: places in the run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinRequest {
    /// The host's version of Reveille.
    pub version: String,
    /// How many devices the host offers to carry, ≥ 1.
    pub count: u32,
    /// A number that this host process drew for itself: a repeated request gets the same places.
    pub nonce: u64,
    /// What the host calls itself, for messages to people; not believed.
    pub name: String,
}

/// Emulation, BS → host: the reply to a [`JoinRequest`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum JoinReply {
    /// The host's places.
    Welcome(Box<Assignment>),
    /// There is no place now, but there may be one: the host may ask again. Why, in words.
    Later(String),
    /// The host is refused; the reason in words.
    Refused(String),
}

impl Concerns for JoinRequest {}

impl fmt::Display for JoinRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { version, count, .. } = self;
        write!(f, "{:?} offers to carry {count} devices, reveille {version}", self.name)
    }
}
