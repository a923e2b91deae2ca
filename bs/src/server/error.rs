//! Errors that end a run over the bus. `run_loop` replaces an interruption ([`BsError::is_interruption`]) by the
//! outcome so far if it has a replay. Without a replay, the exit code is that for interruptions (`deploy/src/exit.rs`).
//! Operators read the texts; tests in `tests/program/` compare some, and texts name options of `deploy/src/cli/`.

use std::time::Duration;

use humantime::format_duration;
use reveille_common::bus::BusError;
use reveille_common::digits::count_noun;
use reveille_common::ids::{HostId, Tti};
use reveille_common::message::HostSummary;

/// Error that ends a run without an outcome.
#[derive(Debug, thiserror::Error)]
pub enum BsError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Too few devices.
    #[error("only {joined} of {} joined within {seconds} s", count_noun(*devices, "device"))]
    TooFewJoined {
        /// Devices that joined.
        joined: u32,
        /// Devices of the scenario.
        devices: u32,
        /// The time waited, at least the join timeout.
        seconds: u64,
    },
    /// A host is lost.
    #[error(
        "lost {lost} at TTI {tti}: its process ended, froze for longer than the lease, or the link broke; with \
            --on-loss wait another process can take over its devices"
    )]
    HostLost {
        /// The host.
        lost: HostSummary,
        /// The TTI that was open.
        tti: Tti,
    },
    /// A host was lost for longer than the limit.
    #[error(
        "lost {lost} at TTI {tti}, and no process has taken over its devices within {}, the --loss-timeout; use \
            --resume to continue the run",
        format_duration(*limit)
    )]
    LossTimeout {
        /// The host.
        lost: HostSummary,
        /// The TTI that was open.
        tti: Tti,
        /// The time limit.
        limit: Duration,
    },
    /// The run was interrupted and hosts did not answer.
    #[error("interrupted at TTI {tti}, and hosts {hosts:?} no longer answered")]
    NoAnswer {
        /// The TTI that was open.
        tti: Tti,
        /// The hosts that did not answer.
        hosts: Vec<HostId>,
    },
    /// No policy process has decided in time, under `OnUndecided::End`.
    #[error(
        "no decision for TTI {tti}: {why}; --decision-timeout sets the time limit, --on-undecided the reaction, and \
            --resume resumes the run"
    )]
    Undecided {
        /// The TTI.
        tti: Tti,
        /// Reason why there is no decision.
        why: String,
    },
    /// The run was interrupted during a decision request.
    #[error("interrupted at TTI {0}, while waiting for a decision")]
    InterruptedAwaitingDecision(Tti),
    /// The run cannot continue, for the given reason.
    #[error("{0}")]
    CannotContinue(String),
    /// The run was interrupted before it had any result.
    #[error("interrupted before all devices had joined")]
    Interrupted,
    /// The run was interrupted while it waited for a lost host.
    #[error("interrupted at TTI {tti}, during the wait for lost {lost}")]
    InterruptedAwaitingHost {
        /// The host.
        lost: HostSummary,
        /// The TTI that was open.
        tti: Tti,
    },
}

impl BsError {
    /// Whether the run was interrupted on request.
    pub const fn is_interruption(&self) -> bool {
        match self {
            Self::Interrupted
            | Self::InterruptedAwaitingHost { .. }
            | Self::InterruptedAwaitingDecision(_)
            | Self::NoAnswer { .. } => true,
            Self::Bus(_)
            | Self::TooFewJoined { .. }
            | Self::HostLost { .. }
            | Self::LossTimeout { .. }
            | Self::Undecided { .. }
            | Self::CannotContinue(_) => false,
        }
    }
}
