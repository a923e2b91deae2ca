//! The vocabulary of the Reveille emulator.
//!
//! Everything here but [`bus`], [`io`] and [`logging`] is pure: no clock, no entropy, no I/O. The physical world
//! ([`sensing`], [`harvest`], [`event`], [`radio`]), the scenario that configures it, the messages that cross the bus,
//! and the one definition of every metric and of the run's digest.

#[cfg(feature = "bus")]
pub mod bus;
pub mod codec;
pub mod columns;
pub mod declare;
pub mod deployment;
pub mod energy;
pub mod event;
pub mod forms;
pub mod geometry;
pub mod harvest;
pub mod ids;
pub mod io;
pub mod keys;
pub mod logging;
pub mod message;
#[cfg(test)]
mod pages;
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
