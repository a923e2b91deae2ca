//! The base station (BS): what it knows, how it decides, the cycle of a TTI and the virtual clock, all without I/O; and the
//! tokio shell that runs them on the bus.

pub mod actor;
pub mod barrier;
pub mod candidates;
pub mod clock;
pub mod clusters;
mod correlation;
pub mod cycle;
pub mod learn;
pub mod levels;
mod neighbours;
pub mod observation;
pub mod outcome;
pub mod policy;
pub mod registry;
pub mod roster;
pub mod schedule;
pub mod wakeup;
