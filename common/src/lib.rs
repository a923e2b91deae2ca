//! The common types of the Reveille emulator.
//!
//! Everything except [`bus`], [`io`] and [`logging`] is pure: no clock, no entropy, no I/O. The crate contains the
//! physical world ([`sensing`], [`harvest`], [`event`], [`radio`]), the scenario that configures it, and the messages
//! on the bus. It defines all metrics and the digest of a run.

#[cfg(feature = "bus")]
pub mod bus;
pub mod codec;
pub mod columns;
pub mod declare;
pub mod deployment;
pub mod encoding;
pub mod energy;
pub mod event;
pub mod geometry;
pub mod harvest;
pub mod ids;
pub mod io;
pub mod keys;
pub mod logging;
pub mod message;
#[cfg(feature = "parquet")]
pub mod parquet;
pub mod phases;
pub mod plan;
pub mod radio;
pub mod rng;
pub mod scenario;
pub mod score;
pub mod secret;
pub mod sensing;
pub mod state;
pub mod totals;
pub mod units;
pub mod world;
