//! The vocabulary of the Reveille emulator.
//!
//! Everything here but [`bus`] and [`logging`] is pure: no clock, no entropy, no I/O. The physical world ([`sensing`],
//! [`harvest`], [`event`]), the scenario that configures it, the messages that cross the bus, and the one definition of
//! every metric and of the run's digest.

pub mod geometry;
pub mod ids;
pub mod rng;
pub mod scenario;
pub mod sensing;
pub mod units;
