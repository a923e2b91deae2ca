//! Observation of runs: frames, live or from a recording, and the states, metrics and exports computed from them.
//! `deploy` uses it for `reveille inspect`, `compare`, the dashboard, `--record` and `--metrics`.
//!
//! The common input is the [`Frame`](reveille_common::message::Frame). Frames come from the observer of a run in
//! memory, from the tap of a run on the bus, or from a [recording]. Consumers do not depend on the source. Start with
//! [`device_mirror`] and [`reconstruction`]: from frames alone they compute the states and metrics that others use.
//!
//! - Reading frames: [`frame_line`], [`filter`], [`traffic`], [`wake_up_pairs`], [`compare`].
//! - Computing from frames: [`device_mirror`], [`reconstruction`], [`history`], [`metrics`].
//! - Files: [`recording`], [`export`], [`schemas`]. Live sources feed consumers through a [`batch_receiver`].

pub mod batch_receiver;
pub mod compare;
pub mod device_mirror;
pub mod export;
pub mod filter;
pub mod frame_line;
pub mod history;
pub mod metrics;
pub mod reconstruction;
pub mod recording;
pub mod schemas;
pub mod traffic;
pub mod wake_up_pairs;
