//! Recordings: all that an observer of a run is told, in one file that other tools open.
//!
//! The file is an MCAP container. Each kind of message is a channel, `/air/report` for one, whose messages are the
//! lines of JSON that [`Line::to_json`](crate::line::Line::to_json) gives, with a schema. Log time is virtual: a TTI is
//! a millisecond. Beside the messages it holds the scenario, the files that this names, and at the end the summary.
//! Chunks of messages are compressed and come one after the other, so a file that was torn can be read up to the tear.

mod bundle;
mod channel;
mod reader;
mod recorder;
#[cfg(test)]
mod tests;
mod writer;

pub use bundle::{Bundle, SCENARIO, SUMMARY};
pub use channel::{NANOS_PER_TTI, topic};
pub use reader::{Reader, RecordingError};
pub use recorder::{Recorded, Recorder, Tape, is_growing};
pub use writer::Writer;

/// The form of recordings; a file of another is refused.
pub const VERSION: u32 = 1;
