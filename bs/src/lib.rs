//! The base station (BS): what it knows, how it decides, the cycle of a TTI and the virtual clock, all without I/O; and
//! the tokio shell that runs them on the bus.

// A policy names this crate in the same way wherever it lives, in its folder here or in a crate of its own.
#[expect(unused_extern_crates, reason = "for policies that say `reveille_bs`")]
extern crate self as reveille_bs;

pub mod beliefs;
pub mod boundaries;
pub mod cycle;
pub mod grant;
pub mod grids;
pub mod host;
pub mod knowledge;
pub mod levels;
pub mod observation;
pub mod observe;
pub mod outcome;
pub mod policy;
pub mod prepared;
pub mod scenario;
pub mod station;
pub mod taken;
