//! The channels of a recording: one for each kind of message, always with the same number.

use reveille_common::ids::Tti;
use reveille_common::message::MessageKind;

/// A TTI in log time, nanoseconds.
pub const NANOS_PER_TTI: u64 = 1_000_000;

/// The topic of a kind of message.
pub fn topic(kind: MessageKind) -> String {
    format!("/{}/{}", kind.plane().name(), kind.name())
}

/// The log time of a TTI.
pub const fn log_time(tti: Tti) -> u64 {
    tti.0 * NANOS_PER_TTI
}
