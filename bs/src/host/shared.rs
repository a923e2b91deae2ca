//! What the callbacks of the BS's subscriptions share with its loop.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use reveille_common::deployment::Deployment;
use reveille_common::ids::{HostId, Tti};
use reveille_common::message::{ClockCommand, ClockStatus, LostHost};
use reveille_common::scenario::Scenario;
use tokio::sync::Notify;

use super::drive::{OnLoss, Progress, Settings};
use crate::host::admission::{Admission, Places};
use crate::host::barrier::Barrier;
use crate::host::clock::VirtualClock;
use crate::host::losses::Losses;
use crate::host::roster::Roster;

/// The state that callbacks change and the loop looks at.
pub(super) struct BsState {
    pub(super) admission: Admission,
    pub(super) barrier: Barrier,
    pub(super) clock: VirtualClock,
    /// The TTI after all that are granted.
    pub(super) next: Tti,
    /// Whether the loop stands before `next`, with every TTI before it closed.
    pub(super) stands: bool,
    /// Devices whose host is lost.
    pub(super) losses: Losses,
    /// The devices of lost hosts that the run goes on without, until that is noted.
    pub(super) leaving: Vec<Places>,
    /// Lost hosts that were already spoken of.
    pub(super) reported: BTreeSet<HostId>,
    /// Whether somebody came, or came back, who has to be asked again.
    pub(super) returned: bool,
    /// Whether the run has begun: from then on only places of lost hosts are given.
    pub(super) is_running: bool,
    /// Why the run cannot go on, where a callback has found out.
    pub(super) failure: Option<String>,
    /// What to do when a host is lost.
    pub(super) on_loss: OnLoss,
}

impl BsState {
    /// All TTIs before `next` are closed. Whether the loop is to stand there until it is told otherwise.
    pub(super) fn stand(&mut self, next: Tti) -> bool {
        self.next = next;
        self.stands = next >= self.clock.until();
        self.stands
    }

    /// Tells `progress` who carries which devices.
    pub(super) fn name_carriers(&mut self, progress: &Progress) {
        let roster = self.barrier.roster();
        let all = (0..roster.hosts())
            .filter(|position| !roster.is_gone(*position))
            .map(|position| roster.places(position))
            .collect::<Vec<_>>();
        let named = all
            .into_iter()
            .map(|places| (places, self.admission.name(places.host).to_owned()));
        *progress.carriers.lock().unwrap_or_else(PoisonError::into_inner) = named.collect();
    }

    /// What an operator is told. A clock that has been told to stop runs until the TTI in work is closed.
    pub(super) fn status(&self) -> ClockStatus {
        let end = self.clock.end();
        ClockStatus {
            tti: self.next,
            ttis: end.0,
            paused: self.stands && self.next >= self.clock.until(),
            until: self.clock.until().min(end),
            pace: self.clock.pace(),
            begun: self.is_running,
            devices: self.admission.devices(),
            lost: self
                .losses
                .places()
                .map(|places| LostHost {
                    host: places.host,
                    first: places.first,
                    last: places.last(),
                })
                .collect(),
        }
    }
}

/// The state with the bell that rings when it has changed in a way that the loop waits for.
pub(super) struct Shared {
    state: Mutex<BsState>,
    bell: Notify,
}

impl Shared {
    /// The state of a run that begins with TTI `next`.
    pub(super) fn new(scenario: &Scenario, deployment: &Deployment, settings: &Settings, next: Tti) -> Arc<Self> {
        let mut clock = VirtualClock::new(Tti(scenario.ttis), settings.pace);
        if settings.paused {
            clock.obey(ClockCommand::Pause, next);
        }
        let state = BsState {
            admission: Admission::new(scenario.devices),
            barrier: Barrier::new(Roster::new(deployment.devices.clone(), scenario.sensing.psi)),
            clock,
            next,
            stands: true,
            losses: Losses::default(),
            leaving: Vec::new(),
            reported: BTreeSet::new(),
            returned: false,
            is_running: false,
            failure: None,
            on_loss: settings.on_loss,
        };
        Arc::new(Self {
            state: Mutex::new(state),
            bell: Notify::new(),
        })
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, BsState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn ring(&self) {
        self.bell.notify_one();
    }

    pub(super) async fn rung(&self) {
        self.bell.notified().await;
    }
}
