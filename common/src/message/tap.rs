//! Copies of messages for observers.

use serde::{Deserialize, Serialize};

use crate::ids::Tti;

/// Emulation, BS → observers: copies of messages, in the order in which the BS sent or received them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TapBatch {
    /// The number of the first frame, counted since the run began. A gap to the batch before is what was left out.
    pub first: u64,
    /// The frames.
    pub frames: Vec<TapFrame>,
}

/// A copy of one message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TapFrame {
    /// The TTI that the BS was in.
    pub tti: Tti,
    /// Its key.
    pub key: String,
    /// Its payload as sent.
    pub payload: Vec<u8>,
}
