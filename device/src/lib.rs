//! One battery-less IoT device, and the process that runs many of them.
//!
//! Start at [`machine`], the state machine of a device. [`battery`] and [`ledger`] account for its energy
//! independently, and both accounts agree. `lab`, `view` and `study` run machines in memory; [`host`] runs them on the
//! bus, following grants by the rules of [`grant_follower`]. Only [`host`] performs I/O, behind the default feature
//! `host`.

pub mod battery;
pub mod grant_follower;
#[cfg(feature = "host")]
pub mod host;
pub mod ledger;
pub mod machine;
