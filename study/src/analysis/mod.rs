//! The analytical part of the paper beside what the machines do: closed forms and chains on one side, runs in memory on
//! the other.
//!
//! Everything measured comes from [`reveille_lab::run`] or from the device machine itself; nothing here is a second
//! model. Closed forms are given as the paper prints them, and where what it prints is not a probability, that is said
//! and not mended.

pub mod battery;
mod error;
pub mod harvest;
pub mod imin;
mod runs;
pub mod runtime;
pub mod transitions;

pub use error::AnalysisError;
