//! The base station (BS): what it knows, how it decides, and the cycle of a TTI, all without I/O.

pub mod clusters;
pub mod cycle;
pub mod observation;
pub mod outcome;
pub mod policy;
pub mod schedule;
pub mod wakeup;
