//! What the callbacks of the BS's subscriptions share with its loop.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use reveille_common::deployment::Deployment;
use reveille_common::ids::{HostId, Tti};
use reveille_common::scenario::Scenario;
use tokio::sync::Notify;

use crate::barrier::Barrier;
use crate::clock::VirtualClock;
use crate::registry::Registry;
use crate::roster::Roster;

/// The state that callbacks change and the loop looks at.
pub(super) struct State {
    pub(super) registry: Registry,
    pub(super) barrier: Barrier,
    pub(super) clock: VirtualClock,
    /// The TTI after all that are granted.
    pub(super) next: Tti,
    /// Hosts whose token is gone.
    pub(super) lost: BTreeSet<HostId>,
    /// Lost hosts that were already spoken of.
    pub(super) reported: BTreeSet<HostId>,
    /// Hosts that came back since the loop last looked.
    pub(super) returned: bool,
    /// Whether the run has begun: from then on no place is given.
    pub(super) is_running: bool,
}

/// The state with the bell that rings when it has changed in a way that the loop waits for.
pub(super) struct Shared {
    state: Mutex<State>,
    bell: Notify,
}

impl Shared {
    pub(super) fn new(scenario: &Scenario, deployment: &Deployment, paused: bool) -> Arc<Self> {
        let mut clock = VirtualClock::new(Tti(scenario.ttis));
        if paused {
            clock.obey(reveille_common::message::ClockCommand::Pause, Tti::ZERO);
        }
        let state = State {
            registry: Registry::new(scenario.devices),
            barrier: Barrier::new(Roster::new(deployment.devices.clone(), scenario.sensing.psi)),
            clock,
            next: Tti::ZERO,
            lost: BTreeSet::new(),
            reported: BTreeSet::new(),
            returned: false,
            is_running: false,
        };
        Arc::new(Self {
            state: Mutex::new(state),
            bell: Notify::new(),
        })
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn ring(&self) {
        self.bell.notify_one();
    }

    pub(super) async fn rung(&self) {
        self.bell.notified().await;
    }
}
