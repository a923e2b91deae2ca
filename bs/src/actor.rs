//! The tokio shell of the base station: it lets hosts join, plays the virtual clock over the bus, and notices who is lost.

mod joining;
mod running;
mod shared;

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError};
use reveille_common::deployment::Deployment;
use reveille_common::ids::{HostId, Tti};
use reveille_common::keys::Kind;
use reveille_common::message::Clock;
use reveille_common::scenario::Scenario;

use crate::clock::{Lateness, Pace};
use crate::outcome::{Outcome, Watcher};
use shared::Shared;

/// What to do when a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnLoss {
    /// End the run with an error.
    End,
    /// Hold the clock until the host is back.
    Wait,
}

/// How the BS runs; none of it changes the outcome.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Grant as many TTIs at a time as possible, or one.
    pub lookahead: bool,
    /// The pace; a real-time pace grants one TTI at a time.
    pub pace: Pace,
    /// When a host is lost.
    pub on_loss: OnLoss,
    /// TTIs in a window of the per-window series.
    pub window: u64,
    /// How long to wait for all devices to join; `None` for as long as it takes.
    pub join_patience: Option<Duration>,
    /// Start with the clock paused.
    pub paused: bool,
}

/// How far a run has come, for a display in another thread.
#[derive(Debug, Default)]
pub struct Progress {
    /// Devices that have joined.
    pub joined: AtomicU64,
    /// The next TTI to be granted.
    pub tti: AtomicU64,
    /// Counted events that have ended.
    pub events: AtomicU64,
    /// Those without a report.
    pub misdetected: AtomicU64,
    /// Mean battery over the last window, micro-units.
    pub mean_battery: AtomicU64,
    /// Whether the clock is paused.
    pub paused: AtomicBool,
    /// Set from outside, before `stop`: why the run cannot go on.
    pub cause: OnceLock<String>,
    /// Set from outside: end the run at the next TTI.
    pub stop: AtomicBool,
}

/// Why a run ended without an outcome.
#[derive(Debug, thiserror::Error)]
pub enum BsError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Too few devices.
    #[error("only {joined} of {devices} devices joined within {seconds} s")]
    TooFew {
        /// Devices that joined.
        joined: u32,
        /// Devices of the scenario.
        devices: u32,
        /// The time allowed.
        seconds: u64,
    },
    /// A host is gone.
    #[error(
        "lost host {host} with devices {first} to {last} at TTI {tti}: its process ended, froze for longer than the lease, or the link broke. The run cannot go on without it (--on-loss wait holds the clock until it is back)"
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
    /// Stopped from outside while hosts did not answer.
    #[error("interrupted at TTI {tti}, and hosts {hosts:?} did not answer any more")]
    NoAnswer {
        /// The TTI that was open.
        tti: Tti,
        /// Who did not answer.
        hosts: Vec<HostId>,
    },
    /// Stopped from outside before there was anything to sum up.
    #[error("interrupted before all devices had joined")]
    Interrupted,
    /// Stopped from outside while there was no way to sum up.
    #[error(
        "interrupted at TTI {tti}, while the clock was held for lost host {host} with devices {first} to {last}: without their ledgers there is no summary"
    )]
    InterruptedWaiting {
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
    /// Whether the run ended because somebody asked for it.
    pub const fn is_interruption(&self) -> bool {
        match self {
            Self::Interrupted | Self::InterruptedWaiting { .. } | Self::NoAnswer { .. } => true,
            Self::Bus(_) | Self::TooFew { .. } | Self::HostLost { .. } => false,
        }
    }
}

/// What a run over the bus came to.
#[derive(Clone, Debug)]
pub struct Served {
    /// The outcome, whole or partial.
    pub outcome: Outcome,
    /// From the call until all devices had joined.
    pub joining: Duration,
    /// From the first grant to the last answer.
    pub running: Duration,
    /// Hosts that carried devices.
    pub hosts: usize,
    /// Grants made: barriers over all hosts.
    pub grants: u64,
    /// How a real-time pace was kept.
    pub lateness: Lateness,
    /// Payloads that were dropped because they were not messages.
    pub malformed: u64,
    /// Messages that were dropped because nobody waited for them or they could not be true.
    pub strays: u64,
}

/// Runs `scenario` over `bus`: waits for hosts to carry all devices, plays every TTI, collects the ledgers.
///
/// # Errors
/// If the bus fails, too few devices join, or a host is lost.
pub async fn serve(
    bus: &Bus,
    scenario: &Scenario,
    deployment: &Deployment,
    settings: &Settings,
    progress: &Arc<Progress>,
    watcher: &mut impl Watcher,
) -> Result<Served, BsError> {
    let shared = Shared::new(scenario, deployment, settings.paused);
    let _declared = joining::declare(bus, scenario, deployment, &shared)?;
    #[expect(clippy::disallowed_methods, reason = "the shell reports how long things took")]
    let started = std::time::Instant::now();
    joining::wait_for_all(&shared, scenario, settings, progress).await?;
    let joining = started.elapsed();
    running::run(bus, scenario, deployment, settings, progress, watcher, &shared, joining).await
}

/// Tells all hosts that the run is over and its results are written: they leave.
///
/// # Errors
/// If the bus fails.
pub fn dismiss(bus: &Bus) -> Result<(), BsError> {
    bus.publisher(bus.keys().of(Kind::Clock))?.put(&Clock::Dismiss)?;
    Ok(())
}
