//! State that the bus callbacks of the base station share with its run loop, under one lock. Callbacks run on zenoh's
//! threads, and a send can wait for a congested link, so no code sends while it holds the lock.

use std::collections::BTreeSet;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ClockCommand, ClockStatus, HostSummary, OperatorAction};
use tokio::sync::Notify;

use super::admission::{Admission, Assignment};
use super::barrier::Barrier;
use super::clock::VirtualClock;
use super::config::{OnLoss, RunProgress, ServerConfig};
use super::failover::LostHosts;
use super::roster::Roster;
use super::share_queue::ShareQueue;
use crate::scenario::Scenario;

/// State that callbacks change and the run loop reads.
#[expect(clippy::struct_excessive_bools, reason = "each is a separate fact about the run")]
pub(super) struct ServerState {
    pub(super) admission: Admission,
    pub(super) share_queue: ShareQueue,
    pub(super) barrier: Barrier,
    pub(super) clock: VirtualClock,
    /// The first TTI that is not granted yet.
    pub(super) next_tti: Tti,
    /// Whether the loop is paused before `next_tti`, with every earlier TTI closed.
    pub(super) is_paused: bool,
    pub(super) lost_hosts: LostHosts,
    /// Assignments of lost hosts whose devices the run loop has yet to remove.
    pub(super) pending_removals: Vec<Assignment>,
    /// Devices of lost hosts that are removed or will be.
    pub(super) removed_devices: BTreeSet<DeviceId>,
    /// Accepted actions that the run loop has yet to queue, all in TTIs from `next_tti` on.
    pub(super) pending_actions: Vec<OperatorAction>,
    /// Whether the run loop is deciding which TTIs to grant next, so that `next_tti` is about to change. Only
    /// [`SharedState::end_granting`] resets it.
    pub(super) is_granting: bool,
    /// Whether a host has returned or taken over, so that the last grant must be retransmitted.
    pub(super) needs_retransmit: bool,
    /// Whether the run has begun. From then on only devices of lost hosts are assigned.
    pub(super) is_running: bool,
    /// Number of processes with which the run began. One with several ranges has several hosts.
    pub(super) process_count: usize,
    /// Reason why the run cannot continue, found outside the loop.
    pub(super) failure: Option<String>,
    /// Action when a host is lost.
    pub(super) on_loss: OnLoss,
    /// The identity of the run.
    pub(super) run_id: u64,
}

impl ServerState {
    /// Notes that all TTIs before `next_tti` are closed. Returns whether the loop must pause there.
    pub(super) fn close_ttis_before(&mut self, next_tti: Tti) -> bool {
        self.next_tti = next_tti;
        self.is_paused = next_tti >= self.clock.until();
        self.is_paused
    }

    /// Copies the assignments and names of all hosts, except removed ones, to `progress`, where the audit reads them.
    pub(super) fn copy_owners_to(&mut self, progress: &RunProgress) {
        let roster = self.barrier.roster_mut();
        let assignments = (0..roster.host_count())
            .filter(|position| !roster.is_removed(*position))
            .map(|position| roster.assignment(position))
            .collect::<Vec<_>>();
        let owners = assignments
            .into_iter()
            .map(|assignment| (assignment, self.admission.host_name(assignment.host).to_owned()));
        *progress.owners.lock().unwrap_or_else(PoisonError::into_inner) = owners.collect();
    }

    /// The clock status for operators. After a pause command the clock runs until the open TTI is closed.
    pub(super) fn clock_status(&self) -> ClockStatus {
        let end = self.clock.end();
        ClockStatus {
            run_id: self.run_id,
            tti: self.next_tti,
            ttis: end.0,
            paused: self.is_paused && self.next_tti >= self.clock.until(),
            stop_before: self.clock.until().min(end),
            pace: self.clock.pace(),
            begun: self.is_running,
            devices: self.admission.devices(),
            hosts: self.host_summaries(),
        }
    }

    /// Describes the host with this assignment.
    pub(super) fn describe_host(&self, assignment: Assignment) -> HostSummary {
        HostSummary {
            host: assignment.host,
            name: self.admission.host_name(assignment.host).to_owned(),
            first: assignment.first,
            last: assignment.last(),
            is_lost: self.lost_hosts.assignments().any(|lost| lost.host == assignment.host),
        }
    }

    /// Returns the hosts with devices, lost ones included, in the order of their devices.
    fn host_summaries(&self) -> Vec<HostSummary> {
        // A host that is still to take over devices has none yet.
        let has_devices = |assignment: &Assignment| self.lost_hosts.reservation_of(assignment.host).is_none();
        let with_devices = self.admission.assignments().filter(has_devices);
        let mut summaries: Vec<HostSummary> = with_devices.map(|assignment| self.describe_host(assignment)).collect();
        summaries.sort_unstable_by_key(|summary| summary.first);
        summaries
    }
}

/// The server state, with a signal for the changes that the run loop waits for.
pub(super) struct SharedState {
    state: Mutex<ServerState>,
    changed: Notify,
    /// Signals that [`ServerState::is_granting`] is false again.
    has_granted: Condvar,
}

impl SharedState {
    /// Creates the state of a run that begins with TTI `next_tti`, without hosts. `serve` adds the removed devices of a
    /// resumed run.
    pub(super) fn new(
        scenario: &Scenario,
        deployment: &Deployment,
        settings: &ServerConfig,
        next_tti: Tti,
    ) -> Arc<Self> {
        let mut clock = VirtualClock::new(Tti(scenario.run.ttis), settings.pace);
        if settings.starts_paused {
            clock.apply(ClockCommand::Pause, next_tti);
        }
        let state = ServerState {
            admission: Admission::new(scenario.run.devices),
            share_queue: ShareQueue::default(),
            barrier: Barrier::new(Roster::new(deployment.devices.clone(), scenario.sensing.psi)),
            clock,
            next_tti,
            is_paused: true,
            lost_hosts: LostHosts::default(),
            pending_removals: Vec::new(),
            removed_devices: BTreeSet::new(),
            pending_actions: Vec::new(),
            is_granting: false,
            needs_retransmit: false,
            is_running: false,
            process_count: 0,
            failure: None,
            on_loss: settings.on_loss,
            run_id: settings.run_id,
        };
        Arc::new(Self {
            state: Mutex::new(state),
            changed: Notify::new(),
            has_granted: Condvar::new(),
        })
    }

    /// Locks the state. The caller neither sends nor waits before it unlocks.
    pub(super) fn lock(&self) -> MutexGuard<'_, ServerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks the state while the run loop decides about no grant, for an action in a TTI that is not granted yet.
    pub(super) fn lock_between_grants(&self) -> MutexGuard<'_, ServerState> {
        // The wait is short: the run loop only computes until it has decided.
        let locked = self.has_granted.wait_while(self.lock(), |state| state.is_granting);
        locked.unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the decision about a grant: `next_tti` is the first TTI that is not granted yet.
    pub(super) fn end_granting(&self, next_tti: Tti) {
        let mut state = self.lock();
        (state.is_granting, state.next_tti) = (false, next_tti);
        self.has_granted.notify_all();
    }

    /// Wakes the run loop, which then locks the state and checks it again.
    pub(super) fn notify_run_loop(&self) {
        // `notify_one` keeps a permit, so a signal between a check of the loop and its wait is not lost. Only one task
        // waits.
        self.changed.notify_one();
    }

    /// Waits for [`Self::notify_run_loop`]. Only the run loop and the wait for hosts before it call this.
    pub(super) async fn wait_for_change(&self) {
        self.changed.notified().await;
    }
}

/// The wall clock, which paces a run and bounds waits. Results do not depend on it.
#[expect(
    clippy::disallowed_methods,
    reason = "the shell keeps the pace and reports how long things took"
)]
pub(super) fn now() -> Instant {
    Instant::now()
}
