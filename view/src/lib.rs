//! Looking at runs: what an observer of a run is told, frame by frame, live or from a recording, and what can be made
//! of it.
//!
//! A [`Frame`](reveille_common::message::Frame) is the one thing that all of this reads. Frames come from the observer
//! of a run in memory, from the tap of a run on the bus, or from a [recording], and nobody who reads them need know
//! which.

pub mod batches;
pub mod compare;
pub mod export;
pub mod filter;
pub mod forms;
pub mod join;
pub mod line;
pub mod metrics;
pub mod mirror;
pub mod recording;
pub mod replay;
pub mod story;
pub mod traffic;
