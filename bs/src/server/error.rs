//! Errors that end a run over the bus. `run_loop` replaces an interruption ([`BsError::is_interruption`]) by the
//! outcome so far if it has a replay. Without a replay, the exit code is that for interruptions (`deploy/src/exit.rs`).
//! Operators read the texts; tests in `tests/program/` compare some, and texts name options of `deploy/src/cli/`.

use reveille_common::bus::BusError;
use reveille_common::ids::{HostId, Tti};

/// Error that ends a run without an outcome.
#[derive(Debug, thiserror::Error)]
pub enum BsError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Too few devices.
    #[error("only {joined} of {devices} devices joined within {seconds} s")]
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
        "lost host {host} with devices {first} to {last} at TTI {tti}: its process ended, froze for longer than the \
            lease, or the link broke; with --on-loss wait another process can take over its devices"
    )]
    HostLost {
        /// The host.
        host: HostId,
        /// Its first device.
        first: u32,
        /// Its last device.
        last: u32,
        /// The TTI that was open.
        tti: Tti,
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
    #[error("interrupted at TTI {tti}, while the run waited for lost host {host} with devices {first} to {last}")]
    InterruptedAwaitingHost {
        /// The host.
        host: HostId,
        /// Its first device.
        first: u32,
        /// Its last device.
        last: u32,
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
            | Self::Undecided { .. }
            | Self::CannotContinue(_) => false,
        }
    }
}
