//! The tokio shell of the base station: it admits hosts, drives the virtual clock over the bus, detects lost hosts and
//! assigns their devices to others. The records of hosts need no bus and exist without the feature `host`.

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
