//! Recordings: all messages that an observer of a run receives, in one file that other tools open.
//!
//! The file is an MCAP container. Each kind of message is a channel, such as `/air/report`. Its messages are the JSON
//! lines of [`FrameLine::to_json`](crate::frame_line::FrameLine::to_json), with a schema. Log time is virtual: a TTI is
//! a millisecond. The container also holds the scenario, the files that it refers to and, at the end, the summary.
//! Chunks of messages are compressed and written in order, so a torn file can be read up to the tear.
//! docs/inspecting.md describes the format; `tests/recordings/check.py` reads it with another library and repeats
//! topics, names of attachments and log times.

mod bundle;
mod reader;
mod recorder;
mod writer;

use reveille_common::ids::Tti;
use reveille_common::message::MessageKind;

pub use bundle::{SCENARIO_FILE, ScenarioBundle};
pub use reader::{RecordingError, RecordingReader};
pub use recorder::{Recorder, RecorderHandle, RecordingStats, is_growing};
pub use writer::RecordingWriter;

/// Name of the summary in a recording.
pub const SUMMARY_FILE: &str = "summary.json";
/// Log time of one TTI, nanoseconds.
pub(crate) const NANOS_PER_TTI: u64 = 1_000_000;

/// Topic of a kind of message.
pub fn topic(kind: MessageKind) -> String {
    format!("/{}/{}", kind.plane().name(), kind.name())
}

/// Log time of a TTI, nanoseconds.
pub(crate) const fn log_time(tti: Tti) -> u64 {
    tti.0 * NANOS_PER_TTI
}

/// Version of the recording format; the reader refuses files of other versions, and of other versions of the bus.
///
/// Raise it with any change that an older reader would misread: the JSON lines, the attachments, the log times, the
/// keys of the metadata. A change of [`WIRE_VERSION`](reveille_common::codec::WIRE_VERSION) needs no change here.
/// Topics and schemas are also a contract with programs that show MCAP files, but our reader does not depend on topics.
pub const VERSION: u32 = 2;

#[cfg(test)]
mod tests;
