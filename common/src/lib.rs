//! The common types of the Reveille emulator, on which all its other crates build.
//!
//! - A run: [`scenario`] describes it, [`deployment`] places its devices, [`world`] holds its events. [`ids`] has the
//!   numbers of devices, hosts and events, and model time.
//! - Physics: [`sensing`], [`harvest`], [`energy`] in [`units`], [`state`] of a device, [`event`] and [`radio`] (both
//!   with [`phases`]), [`geometry`], [`rng`]. [`energy_balance`] compares harvest and costs before a run.
//! - Decisions and messages: [`plan`], [`message`], [`codec`], [`bus`] with its key expressions in [`keys`], of which a
//!   [`secret`] is a part.
//! - Results: [`totals`], [`score`] with all metrics and the digest, [`digits`] to write numbers.
//! - Fields and files: [`mod@declare`] declares scenario fields; [`columns`], [`encoding`] for data, and `parquet`.
//!
//! Everything except [`bus`], [`io`] and [`logging`] is pure: no clock, no entropy, no I/O. `tests/tests/tidy/` checks
//! this, and that modules do not depend on each other in a cycle. The cargo features `bus` and `parquet` add the
//! modules of these names; `parquet` also adds a format of data files. Start with [`scenario`].

#[cfg(feature = "bus")]
pub mod bus;
pub mod codec;
pub mod columns;
pub mod declare;
pub mod deployment;
pub mod digits;
pub mod encoding;
pub mod energy;
pub mod energy_balance;
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
