//! The journal of a sweep: an append-only file with a line for every finished run.
//!
//! Each line ends with a checksum of itself. A line is handed to the operating system as soon as its run has finished,
//! so that a killed process loses the runs under way and no other; it reaches the disk now and then, so that a power
//! cut loses little. Lines that are torn or garbled are taken out when the journal is opened; runs that are missing are
//! done again.
//!
//! The first line names the sweep and the seeds of each cell. When there shall be more, a copy with another first line
//! takes the journal's place at one stroke, and all runs with it.

mod io;
mod keeper;
mod lines;

pub use io::Journal;
pub use keeper::Keeper;
pub use lines::{Entry, Job};
