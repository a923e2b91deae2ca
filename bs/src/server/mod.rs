//! The asynchronous part of the base station: connects the [`Session`](crate::session::Session), which decides without
//! I/O, to the bus. [`serve()`] runs it: [`RunSpec`] describes the run, [`ServerConfig`] the settings of the bus side.
//!
//! `subscriptions` receives all messages and checks credentials; `state` is shared by its callbacks and the run loop.
//! `join`, [`admission`] and `share_queue` assign devices to hosts. `run_loop` carries out the actions of the session,
//! sends through `downlink` and waits at the [`barrier`], under the [`clock`]. [`roster`] checks received values.
//! `failure_detection`, [`failover`] and `removed_hosts` handle lost hosts; [`policy_port`] obtains external decisions.
//! `actions` accepts the actions of operators. `config` and `error` declare the settings, outcome and errors of a run,
//! and `serve` its entry points.
//!
//! The cargo feature `host` adds the modules that need tokio and zenoh. `lab`, `view`, `study`, the Python package and
//! the fuzz targets build without it, and get the other modules: the records of hosts, and `config`.

#[cfg(feature = "host")]
mod actions;
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
mod share_queue;
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
