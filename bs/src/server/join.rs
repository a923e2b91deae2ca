//! Answers to join requests, before the first TTI and after a loss, the wait for all devices, and the changes of
//! [`ServerState`] when hosts are lost, removed or replaced, for `subscriptions` and `failure_detection`.
//!
//! `admission` assigns free devices, `failover` the devices of lost hosts. A welcome holds the setup of every device,
//! so it is built without the lock of [`SharedState`]. After `Retry` a spare host repeats its request; `Refused` ends
//! it (`device/src/host/join.rs`).

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use reveille_common::bus::{draw_secret, scaled_timeout};
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{BusCredentials, HostCheckpoint, HostSetup, JoinReply, JoinRequest};
use reveille_common::secret::{HostCredential, Secret};

use super::admission::{Assignment, JoiningHost};
use super::config::{OnLoss, RunProgress, ServerConfig};
use super::error::BsError;
use super::state::{ServerState, SharedState, now};
use crate::scenario::Scenario;

/// Interval between checks of the time limit and the stop flag during the wait for hosts.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Time for a joined host to become ready, before [`scaled_timeout`] lengthens it in a run with many hosts.
const READY_TIMEOUT: Duration = Duration::from_secs(20);

pub(super) struct JoinHandler {
    pub(super) shared: Arc<SharedState>,
    pub(super) scenario: Scenario,
    pub(super) deployment: Deployment,
    /// Secret with which the key expressions of admitted hosts begin.
    pub(super) bus_secret: Secret,
    /// The key that a host must show to join, if any.
    pub(super) required_key: Option<Secret>,
    /// The devices of a resumed run, all of them in the order of ids.
    pub(super) resumed_devices: Option<Arc<HostCheckpoint>>,
}

impl JoinHandler {
    /// Answers `request`, sent with the key `shown`.
    pub(super) fn handle_request(&self, request: &JoinRequest, shown: Option<Secret>) -> JoinReply {
        let version = env!("CARGO_PKG_VERSION");
        if request.version != version {
            return JoinReply::Refused(format!(
                "the device process is reveille {}, the base station is {version}: run the same release on both sides",
                request.version
            ));
        }
        if self.required_key.is_some() && shown != self.required_key {
            return JoinReply::Refused(
                "the request does not show the run's key; use the key of the process that started the run".to_owned(),
            );
        }
        let reply = self.assign_devices(request);
        // This wakes the loop, which takes the lock that `assign_devices` has released.
        self.shared.notify_run_loop();
        reply.unwrap_or_else(|refusal_or_retry| refusal_or_retry)
    }

    /// Returns a welcome, or else the refusal or retry to send.
    fn assign_devices(&self, request: &JoinRequest) -> Result<JoinReply, JoinReply> {
        let mut state = self.shared.lock();
        // A reply can get lost, so a repeated request gets the same assignment again, not a second one.
        if let Some((assignment, token)) = state.admission.find_by_nonce(request.nonce) {
            let checkpoint = state
                .lost_hosts
                .reservation_of(assignment.host)
                .map(|(_, checkpoint)| checkpoint);
            // The reply copies the setup of each device, and callbacks need the lock meanwhile.
            drop(state);
            return Ok(self.welcome_reply(assignment, token, checkpoint));
        }
        let newcomer = JoiningHost {
            nonce: request.nonce,
            token: draw_secret().map_err(|error| JoinReply::Refused(error.to_string()))?,
            // Another process chose the name, which appears in logs, so its characters and length are limited.
            name: request.name.chars().filter(|c| !c.is_control()).take(64).collect(),
            offered_devices: request.count,
            requested_at: now(),
        };
        let token = newcomer.token;
        let devices = self.scenario.run.devices;
        if state.is_running {
            // Without `OnLoss::Wait` the loss of a host removes its devices or ends the run, so none become free again.
            if state.on_loss != OnLoss::Wait {
                return Err(JoinReply::Refused("the run has begun".to_owned()));
            }
            let Some((lost, checkpoint)) = state.lost_hosts.find_takeover(newcomer.offered_devices) else {
                return Err(retry_reply(&state, newcomer.offered_devices));
            };
            let assignment = state.admission.take_over(newcomer, lost);
            state.lost_hosts.reserve(lost.host, assignment.host);
            drop(state);
            tracing::info!(host = %assignment.host, instead_of = %lost.host, "a host takes over");
            return Ok(self.welcome_reply(assignment, token, Some(checkpoint)));
        }
        let Some(assignment) = state.admission.admit(newcomer) else {
            let reason = format!("all {devices} devices of the run have a host already");
            // With `wait` a spare process can still take over devices later, so it keeps asking.
            return Err(if state.on_loss == OnLoss::Wait {
                JoinReply::Retry(reason)
            } else {
                JoinReply::Refused(reason)
            });
        };
        drop(state);
        tracing::info!(host = %assignment.host, first = %assignment.first, devices = assignment.count, "a host joins");
        Ok(self.welcome_reply(assignment, token, None))
    }

    fn welcome_reply(
        &self,
        assignment: Assignment,
        token: Secret,
        checkpoint: Option<Arc<HostCheckpoint>>,
    ) -> JoinReply {
        let credentials = BusCredentials {
            credential: HostCredential {
                host: assignment.host,
                token,
            },
            secret: self.bus_secret,
        };
        let (first, count) = (assignment.first.0, assignment.count);
        let from_resumed_run = || {
            self.resumed_devices
                .as_ref()
                .map(|checkpoint| checkpoint.slice(assignment.first.index(), assignment.count as usize))
        };
        JoinReply::Welcome(Box::new(HostSetup {
            checkpoint: checkpoint.map(|shared| (*shared).clone()).or_else(from_resumed_run),
            ..self.deployment.host_setup(&self.scenario, credentials, first, count)
        }))
    }
}

/// Builds the reply for a host that offers to run `offered` devices while no devices are available for it.
fn retry_reply(state: &ServerState, offered: u32) -> JoinReply {
    let lost_counts: Vec<u32> = state
        .lost_hosts
        .assignments()
        .map(|assignment| assignment.count)
        .collect();
    JoinReply::Retry(if lost_counts.is_empty() {
        format!("all {} devices of the run have a host", state.admission.devices())
    } else if lost_counts.iter().any(|count| *count <= offered) {
        "the devices of a lost host are not ready for this process: their replay runs, or another process has them"
            .to_owned()
    } else {
        let ranges: Vec<String> = lost_counts.iter().map(u32::to_string).collect();
        format!(
            "lost hosts left {} devices, and each of these ranges needs one host; this process offers to run {offered}",
            ranges.join(" + ")
        )
    })
}

impl ServerState {
    /// Marks `host` as lost. If it was to take over the devices of a lost host, cancels this takeover instead.
    pub(super) fn mark_lost(&mut self, host: HostId) {
        // If the new host of a takeover is lost before it runs the devices, another host can take them over.
        if self.lost_hosts.reservation_of(host).is_some() {
            self.lost_hosts.cancel_reservation(host);
            self.admission.revoke(host);
        } else if let Some(assignment) = self.admission.assignment(host) {
            self.lost_hosts.add(assignment, now());
        }
    }

    /// Removes the lost host with this assignment permanently. The run loop then removes its devices from the session:
    /// see [`ServerState::pending_removals`].
    pub(super) fn remove_host(&mut self, assignment: Assignment) {
        self.lost_hosts.drop_host(assignment.host);
        self.admission.revoke(assignment.host);
        let devices = assignment.first.0..=assignment.last().0;
        self.removed_devices.extend(devices.map(DeviceId));
        self.barrier.remove_host(assignment.host);
        self.pending_removals.push(assignment);
    }

    /// Returns the hosts that have joined and were not ready in time.
    pub(super) fn overdue_hosts(&self) -> Vec<HostId> {
        self.admission.overdue_hosts(
            now(),
            scaled_timeout(READY_TIMEOUT, self.admission.assigned_host_count() as u32),
        )
    }

    /// Completes the takeover of a lost host by `host`, if one is pending and `host` is ready and alive.
    pub(super) fn try_complete_takeover(&mut self, host: HostId) {
        // The liveliness token and the ready message arrive in either order: both of their handlers call this, and the
        // second call succeeds.
        if !self.admission.is_active(host) {
            return;
        }
        if let Some((lost, outage)) = self.lost_hosts.complete_takeover(host, now())
            && let Some(assignment) = self.admission.assignment(host)
        {
            self.admission.revoke(lost.host);
            self.barrier.roster_mut().replace(lost.host, assignment);
            self.warned_hosts.remove(&lost.host);
            // The new host resumes before the last grant, so the loop must retransmit that grant.
            self.needs_retransmit = true;
            let (first, last, outage) = (assignment.first.0, assignment.last().0, outage.as_secs_f64());
            let lost = lost.host;
            tracing::warn!(%host, first, last, "devices of lost host {lost} run again after {outage:.2} s");
        }
    }
}

/// Waits until every device has a host and every host is ready.
pub(super) async fn wait_for_all_devices(
    shared: &SharedState,
    scenario: &Scenario,
    settings: &ServerConfig,
    progress: &RunProgress,
) -> Result<(), BsError> {
    let started = now();
    loop {
        {
            let mut state = shared.lock();
            progress
                .joined_devices
                .store(u64::from(state.admission.assigned_device_count()), Ordering::Relaxed);
            progress
                .active_host_count
                .store(state.admission.active_host_count() as u64, Ordering::Relaxed);
            if let Some(assignments) = state.admission.assignments_if_all_active() {
                tracing::info!(
                    hosts = assignments.len(),
                    devices = scenario.run.devices,
                    "all devices have joined"
                );
                state.barrier.roster_mut().set_hosts(assignments);
                state.is_running = true;
                return Ok(());
            }
            // A process can die between joining and declaring its liveliness token; no token event would then free its
            // devices.
            for host in state.overdue_hosts() {
                tracing::warn!(%host, "a host joined and never became ready; its devices are free again");
                state.admission.free_host(host);
            }
        }
        if progress.is_stop_requested() {
            return Err(BsError::Interrupted);
        }
        if settings
            .join_timeout
            .is_some_and(|patience| started.elapsed() >= patience)
        {
            let joined = shared.lock().admission.assigned_device_count();
            return Err(BsError::TooFewJoined {
                joined,
                devices: scenario.run.devices,
                seconds: started.elapsed().as_secs(),
            });
        }
        // The result does not matter: after a notification or a timeout all conditions are checked again.
        let _changed = tokio::time::timeout(CHECK_INTERVAL, shared.wait_for_change()).await;
    }
}
