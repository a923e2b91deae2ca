//! The vocabulary of the Reveille emulator.
//!
//! Everything here but [`bus`] and [`logging`] is pure: no clock, no entropy, no I/O. The physical world ([`sensing`],
//! [`harvest`], [`event`]), the scenario that configures it, the messages that cross the bus, and the one definition of
//! every metric and of the run's digest.

#[cfg(feature = "bus")]
pub mod bus;
pub mod codec;
pub mod deployment;
pub mod digest;
pub mod event;
pub mod geometry;
pub mod harvest;
pub mod ids;
pub mod keys;
pub mod learned;
pub mod logging;
pub mod message;
pub mod metrics;
pub mod plan;
pub mod rng;
pub mod scenario;
pub mod sensing;
pub mod units;
