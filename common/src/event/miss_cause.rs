//! The causes of missed events, from geometry to the radio: each missed event has exactly one.
//!
//! `common/src/score/mod.rs` finds the cause. Names are part of `events.csv`, of metrics and of `summary.json`; a new
//! cause also needs a metric in `common/src/score/metrics.rs`.

use serde::{Deserialize, Serialize};

/// The cause of a missed event: the first condition for a report that no device met.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum MissCause {
    /// No device is within d_max of the epicentre.
    OutOfReach,
    /// All devices within d_max were removed before the event started.
    Removed,
    /// The probabilistic detection of the event fails for every device within d_max.
    Undetected,
    /// The devices that would have detected the event slept throughout it.
    Asleep,
    /// Devices that would have detected the event had δ = 1, but none of them could pay for sensing.
    Unpowered,
    /// Devices were woken for the event, as only an oracle can order, and their wake-up radios received nothing: they
    /// were unpowered, or missed the signal.
    WakeMissed,
    /// Devices detected the event, and none of them could pay for a report.
    NoEnergy,
    /// Devices reported the event, and all reports were lost.
    Lost,
}

impl MissCause {
    /// Number of causes.
    pub const COUNT: usize = Self::ALL.len();

    /// All causes, in the order of the conditions.
    pub const ALL: [Self; 8] = [
        Self::OutOfReach,
        Self::Removed,
        Self::Undetected,
        Self::Asleep,
        Self::Unpowered,
        Self::WakeMissed,
        Self::NoEnergy,
        Self::Lost,
    ];

    /// The name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OutOfReach => "out_of_reach",
            Self::Removed => "removed",
            Self::Undetected => "undetected",
            Self::Asleep => "asleep",
            Self::Unpowered => "unpowered",
            Self::WakeMissed => "wake_missed",
            Self::NoEnergy => "no_energy",
            Self::Lost => "lost",
        }
    }

    /// Returns the cause with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|cause| cause.name() == name)
    }

    /// The cause as a clause about an event.
    pub const fn explanation(self) -> &'static str {
        match self {
            Self::OutOfReach => "no device within d_max",
            Self::Removed => "all devices within d_max were removed",
            Self::Undetected => "detection failed for every device within d_max",
            Self::Asleep => "devices within d_max slept by plan",
            Self::Unpowered => "devices told to sense had no power",
            Self::WakeMissed => "no woken device received its wake-up",
            Self::NoEnergy => "devices detected it but could not pay for a report",
            Self::Lost => "every report was lost on the radio",
        }
    }
}
