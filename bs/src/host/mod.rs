//! The tokio shell of the base station: it lets hosts join, plays the virtual clock over the bus, notices who is lost,
//! and has others take over. What it keeps in mind of hosts needs no bus, and is there without it.

pub mod admission;
pub mod barrier;
#[cfg(test)]
mod barrier_tests;
pub mod clock;
mod drive;
#[cfg(feature = "host")]
mod error;
#[cfg(feature = "host")]
mod joining;
pub mod losses;
#[cfg(feature = "host")]
mod missing;
#[cfg(feature = "host")]
mod outages;
#[cfg(feature = "host")]
pub mod port;
pub mod roster;
#[cfg(feature = "host")]
mod running;
#[cfg(feature = "host")]
mod serving;
#[cfg(feature = "host")]
mod shared;
#[cfg(feature = "host")]
mod told;
#[cfg(feature = "host")]
mod voice;
#[cfg(feature = "host")]
mod wall;

pub use self::drive::{DecisionCounts, Decisions, OnLoss, Patience, Progress, Served, Settings, Undecided};
#[cfg(feature = "host")]
pub use self::error::BsError;
pub use self::losses::Replay;
#[cfg(feature = "host")]
pub use self::serving::{Course, dismiss, serve};
