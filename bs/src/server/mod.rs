//! The tokio shell of the base station on the bus. [`serve()`] is the entry point of a run.
//!
//! `subscriptions` receives all messages. `join` and [`admission`] assign devices to hosts. `run_loop` carries out the
//! actions of the [`Session`](crate::session::Session), sends through `downlink` and waits at the [`barrier`].
//! `failure_detection`, [`failover`] and `removed_hosts` handle lost hosts; [`policy_port`] obtains external decisions.
//! The records of hosts ([`admission`], [`barrier`], [`clock`], [`failover`], [`roster`]) need no bus and exist without
//! the feature `host`.

pub mod admission;
pub mod barrier;
pub mod clock;
mod config;
#[cfg(feature = "host")]
mod downlink;
#[cfg(feature = "host")]
mod error;
pub mod failover;
#[cfg(feature = "host")]
mod failure_detection;
#[cfg(feature = "host")]
mod join;
#[cfg(feature = "host")]
pub mod policy_port;
#[cfg(feature = "host")]
mod removed_hosts;
pub mod roster;
#[cfg(feature = "host")]
mod run_loop;
#[cfg(feature = "host")]
mod serve;
#[cfg(feature = "host")]
mod state;
#[cfg(feature = "host")]
mod subscriptions;

pub use self::config::{
    DecisionCounts, DecisionTimeout, OnLoss, OnUndecided, RunProgress, ServerConfig, ServerOutcome,
};
#[cfg(feature = "host")]
pub use self::error::BsError;
pub use self::failover::ReplaySource;
#[cfg(feature = "host")]
pub use self::serve::{RunSpec, dismiss_hosts, serve};
