//! How a base station is driven, how far it has come, and what came of it.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use reveille_common::ids::DeviceId;
use reveille_common::message::Pace;
use reveille_common::secret::Secret;

use super::admission::Places;
use super::clock::Lateness;
use crate::outcome::Outcome;
use crate::policy::external::Answered;

/// What to do when a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnLoss {
    /// End the run with an error.
    End,
    /// Go on without its devices, which are gone for good.
    Continue,
    /// Hold the clock until the host is back, or another one carries its devices from where they were.
    Wait,
}

/// Where the decisions of a run come from whose policy makes none itself. Others have no need of it.
#[derive(Clone, Debug, Default)]
pub struct Decisions {
    /// Those that were made before, in order. Nobody is asked for them.
    pub kept: Vec<Answered>,
    /// How many were made before those.
    pub before: u64,
    /// How long somebody is waited for at the policy port; `None` where nobody is asked.
    pub port: Option<Patience>,
}

/// How long a decision is waited for, and what then.
#[derive(Clone, Copy, Debug, Default)]
pub struct Patience {
    /// Until then; `None` for as long as it takes.
    pub limit: Option<Duration>,
    /// What then.
    pub then: Undecided,
}

/// What to do when nobody decides in time, or only what cannot be understood.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Undecided {
    /// End the run with an error.
    #[default]
    End,
    /// Let the plan in force hold on, and wake nobody.
    Hold,
}

/// How often it was decided from outside, and how often not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DecisionCounts {
    /// Decisions of policy processes.
    pub decided: u64,
    /// Answers that decided nothing, or came after the one that counted.
    pub refused: u64,
    /// Questions that nobody answered: the plan in force held, or nobody was woken.
    pub held: u64,
    /// Decisions that were kept and nobody has asked for.
    pub left: u64,
}

/// How the BS runs. None of it changes the outcome, except that a run that goes on without lost devices
/// ([`OnLoss::Continue`]) comes to what comes of that.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Grant as many TTIs at a time as possible, or one.
    pub lookahead: bool,
    /// The pace; a real-time pace grants one TTI at a time.
    pub pace: Pace,
    /// What to do when a host is lost.
    pub on_loss: OnLoss,
    /// TTIs in a window of the per-window series.
    pub window: u64,
    /// How long to wait for all devices to join; `None` for as long as it takes.
    pub join_patience: Option<Duration>,
    /// Start with the clock paused.
    pub paused: bool,
    /// TTIs between two of which observers are told the states of all devices; 0 for none.
    pub states_every: u64,
    /// The run's key, which operators must show; `None` where anyone may pause the run.
    pub key: Option<Secret>,
    /// Whether hosts must show the key as well.
    pub members_only: bool,
}

/// How far a run has come, for a display in another thread.
#[derive(Debug, Default)]
pub struct Progress {
    /// Devices that have joined.
    pub joined: AtomicU64,
    /// Whether all have, so that the run has begun.
    pub has_begun: AtomicBool,
    /// The next TTI to be granted.
    pub tti: AtomicU64,
    /// Counted events that have ended.
    pub events: AtomicU64,
    /// Counted events that have ended without a report.
    pub misdetected: AtomicU64,
    /// Mean battery over the last window, micro-units.
    pub mean_battery: AtomicU64,
    /// Whether the clock is paused.
    pub paused: AtomicBool,
    /// Hosts that carry devices and are not lost.
    pub hosts: AtomicU64,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: AtomicU64,
    /// The largest delay of a TTI, nanoseconds.
    pub max_late: AtomicU64,
    /// Who carries which devices: the host's places and what it is called.
    pub carriers: Mutex<Vec<(Places, String)>>,
    /// Set from outside, before `stop`: why the run cannot go on.
    pub cause: OnceLock<String>,
    /// Set from outside: end the run at the next TTI.
    pub stop: AtomicBool,
}

impl Progress {
    /// Who carries `device`, in words.
    pub fn carrier(&self, device: DeviceId) -> Option<String> {
        let carriers = self.carriers.lock().unwrap_or_else(PoisonError::into_inner);
        let own = |places: &Places| (places.first..=places.last()).contains(&device);
        let (places, name) = carriers.iter().find(|(places, _)| own(places))?;
        Some(format!("Host {}, {name},", places.host))
    }
}

/// What a run over the bus came to.
#[derive(Clone, Debug)]
pub struct Served {
    /// The outcome, whole or partial.
    pub outcome: Outcome,
    /// The time from the call until all devices had joined.
    pub joining: Duration,
    /// The time from the first grant to the last answer.
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
    /// How long each loss of a host lasted.
    pub losses: Vec<Duration>,
    /// What came from outside of a policy that makes no decision itself.
    pub decisions: DecisionCounts,
}
