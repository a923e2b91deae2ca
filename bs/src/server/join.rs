//! Answers to join requests, before the first TTI and after a loss, the wait for all devices, and the changes of
//! [`ServerState`] when hosts are lost, removed or replaced, for `subscriptions` and `failure_detection`.
//!
//! `admission` assigns free devices, `failover` the devices of lost hosts. A welcome holds the setup of every device,
//! so it is built without the lock of [`SharedState`]. After `Retry` a spare host repeats its request; `Refused` ends
//! it (`device/src/host/join.rs`).

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{draw_secret, scaled_timeout};
use reveille_common::deployment::Deployment;
use reveille_common::digits::count_noun;
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{
    BusCredentials, DeviceRange, HostCheckpoint, HostOffer, HostSetup, JoinReply, JoinRequest,
};
use reveille_common::secret::{HostCredential, Secret};

use super::admission::{Assignment, JoiningHost};
use super::config::{OnLoss, RunProgress, ServerConfig};
use super::error::BsError;
use super::state::{ServerState, SharedState, now};
use crate::scenario::Scenario;

/// Interval between checks of the time limit and the stop flag during the wait for hosts.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Largest length of a host's name.
const MAX_NAME_CHARS: usize = 128;

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
        if request.offer == HostOffer::Nothing {
            tracing::info!("{} forwards messages of the run", displayable_name(&request.name));
            return JoinReply::Routes(self.bus_secret);
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
            name: displayable_name(&request.name),
            offered_devices: request.offer.max_devices(),
            requested_at: now(),
        };
        let token = newcomer.token;
        // Without `OnLoss::Wait` the loss of a host removes its devices or ends the run, so none become free again.
        if state.is_running && state.on_loss != OnLoss::Wait {
            return Err(JoinReply::Refused("the run has begun".to_owned()));
        }
        if let HostOffer::Exactly(range) = request.offer {
            state.check_range(range)?;
        }
        if state.is_running {
            let found = if let HostOffer::Exactly(range) = request.offer {
                state.lost_hosts.find_takeover_of(range)
            } else {
                state.lost_hosts.find_takeover(newcomer.offered_devices)
            };
            let Some((lost, checkpoint)) = found else {
                return Err(retry_reply(&state, newcomer.offered_devices));
            };
            let assignment = state.admission.take_over(newcomer, lost);
            state.lost_hosts.reserve(lost.host, assignment.host);
            let (old, new) = (
                state.admission.host_name(lost.host),
                state.admission.host_name(assignment.host),
            );
            tracing::info!(host = %assignment.host, instead_of = %lost.host, "{new} takes over the devices of {old}");
            drop(state);
            return Ok(self.welcome_reply(assignment, token, Some(checkpoint)));
        }
        let newcomer = match request.offer {
            HostOffer::AtMost(_) | HostOffer::Exactly(_) => newcomer,
            HostOffer::Share => JoiningHost {
                offered_devices: state.request_share(request.nonce)?,
                ..newcomer
            },
            // Devices that are free although every waiting host has its share: a host with a share has died since.
            HostOffer::Lost if state.has_leftover_devices() => newcomer,
            HostOffer::Lost | HostOffer::Nothing => return Err(JoinReply::Retry("no host is lost".to_owned())),
        };
        let name = newcomer.name.clone();
        let admitted = if let HostOffer::Exactly(range) = request.offer {
            state.admission.admit_exactly(newcomer, range)
        } else {
            state.admission.admit(newcomer)
        };
        let Some(assignment) = admitted else {
            return Err(state.surplus_reply());
        };
        drop(state);
        tracing::info!(host = %assignment.host, first = %assignment.first, devices = assignment.count, "{name} joins");
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

/// Returns `name` for logs. Another process chose it, so its characters and length are limited.
fn displayable_name(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).take(MAX_NAME_CHARS).collect()
}

/// Builds the reply for a host that offers to run `offered` devices while no devices are available for it.
fn retry_reply(state: &ServerState, offered: u32) -> JoinReply {
    let lost_counts: Vec<u32> = state
        .lost_hosts
        .assignments()
        .map(|assignment| assignment.count)
        .collect();
    JoinReply::Retry(if lost_counts.is_empty() {
        state.full_run_text()
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
    /// Returns the refusal for a host that offers to run exactly `range`, unless all of it is free or lost. If another
    /// host has the same range, it may be an earlier process of the same container, so the newcomer has to ask again.
    fn check_range(&self, range: DeviceRange) -> Result<(), JoinReply> {
        let devices = self.admission.devices();
        if !range.is_valid(devices) {
            return Err(JoinReply::Refused(format!(
                "{range}: the run has {}, from 0 to {}; correct --range",
                count_noun(devices, "device"),
                devices.saturating_sub(1)
            )));
        }
        let is_shared = |other: &Assignment| {
            let other = other.devices();
            range.contains(other.first) || other.contains(range.first)
        };
        let Some(other) = self.admission.assignments().find(is_shared) else {
            return Ok(());
        };
        let name = self.admission.host_name(other.host);
        if other.devices() != range {
            return Err(JoinReply::Refused(format!(
                "{range}: {name} has {}; give each process other devices with --range",
                other.devices()
            )));
        }
        if self.lost_hosts.assignments().any(|lost| lost.devices() == range) {
            return Ok(());
        }
        Err(JoinReply::Retry(format!("{name} runs {range}")))
    }

    /// Returns the number of devices that the host which drew `nonce` gets as its share, or else the reply to send.
    fn request_share(&mut self, nonce: u64) -> Result<u32, JoinReply> {
        let free = self.admission.free_device_count();
        if free == 0 {
            return Err(self.surplus_reply());
        }
        self.share_queue
            .request(nonce, free, now())
            .ok_or(JoinReply::AwaitShare)
    }

    /// Whether devices are free that no waiting host will get as its share.
    fn has_leftover_devices(&mut self) -> bool {
        self.admission.free_device_count() > 0 && self.share_queue.is_idle(now())
    }

    fn full_run_text(&self) -> String {
        let devices = count_noun(self.admission.devices(), "device");
        format!("the run has {devices}, and each has a host")
    }

    /// Returns the reply for a host that finds all devices assigned before the run begins.
    fn surplus_reply(&self) -> JoinReply {
        let reason = self.full_run_text();
        // With `wait` a spare process can still take over devices later, so it keeps asking.
        if self.on_loss == OnLoss::Wait {
            JoinReply::Retry(reason)
        } else {
            JoinReply::Refused(reason)
        }
    }

    /// Logs a warning that only `joined` devices have joined, or that hosts are not ready. Nothing has changed for the
    /// time `waited`.
    fn warn_of_missing_devices(&self, joined: u32, waited: Duration) {
        let (seconds, devices) = (waited.as_secs(), count_noun(self.admission.devices(), "device"));
        let hosts = count_noun(self.admission.assigned_host_count() as u32, "host");
        if joined == self.admission.devices() {
            let ready = self.admission.active_host_count();
            tracing::warn!("{devices} have joined, on {hosts}, of which only {ready} are ready after {seconds} s");
        } else {
            tracing::warn!(
                "{joined} of {devices} have joined, on {hosts}, and no further one for {seconds} s; start more device \
                 processes, without --count or with a larger one"
            );
        }
    }

    /// Marks `host` as lost. If it was to take over the devices of a lost host, cancels this takeover instead.
    pub(super) fn mark_lost(&mut self, host: HostId) {
        // If the new host of a takeover is lost before it runs the devices, another host can take them over.
        if self.lost_hosts.reservation_of(host).is_some() {
            self.lost_hosts.cancel_reservation(host);
            self.admission.revoke(host);
        } else if let Some(assignment) = self.admission.assignment(host) {
            let process = self.admission.host_name(host);
            self.lost_hosts.add(assignment, process, now());
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
            let (first, last, outage) = (assignment.first.0, assignment.last().0, outage.as_secs_f64());
            let (new, old) = (self.admission.host_name(host), self.admission.host_name(lost.host));
            tracing::warn!(%host, first, last, "{new} runs the devices of {old}, which had no host for {outage:.2} s");
            self.admission.revoke(lost.host);
            self.barrier.roster_mut().replace(lost.host, assignment);
            // The new host resumes before the last grant, so the loop must retransmit that grant.
            self.needs_retransmit = true;
        }
    }
}

/// Decides when to warn the operator about missing devices.
struct JoinWatch {
    joined: u32,
    /// Time of the last change of `joined`.
    changed: Instant,
    /// Time after that change until the next warning.
    interval: Duration,
}

impl JoinWatch {
    const fn new(started: Instant) -> Self {
        Self {
            joined: 0,
            changed: started,
            // Before the first process, the operator may still be about to start it.
            interval: Duration::from_secs(30),
        }
    }

    /// Returns the time since the last change of `joined` if a warning is due. The first warning comes after 30 s, or
    /// 5 s after a change; the interval then doubles.
    fn take_due_warning(&mut self, joined: u32, now: Instant) -> Option<Duration> {
        if joined != self.joined {
            (self.joined, self.changed, self.interval) = (joined, now, Duration::from_secs(5));
        }
        let waited = now.saturating_duration_since(self.changed);
        let is_due = waited >= self.interval;
        if is_due {
            self.interval *= 2;
        }
        is_due.then_some(waited)
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
    let mut join_watch = JoinWatch::new(started);
    loop {
        {
            let mut state = shared.lock();
            let joined = state.admission.assigned_device_count();
            if let Some(waited) = join_watch.take_due_warning(joined, now()) {
                state.warn_of_missing_devices(joined, waited);
            }
            progress.joined_devices.store(u64::from(joined), Ordering::Relaxed);
            progress
                .active_host_count
                .store(state.admission.active_host_count() as u64, Ordering::Relaxed);
            if let Some(assignments) = state.admission.assignments_if_all_active() {
                tracing::info!(
                    hosts = assignments.len(),
                    devices = scenario.run.devices,
                    "all devices have joined"
                );
                let hosts = assignments.iter().map(|assignment| assignment.host);
                let names = hosts.map(|host| state.admission.host_name(host));
                state.process_count = names.collect::<BTreeSet<_>>().len();
                state.barrier.roster_mut().set_hosts(assignments);
                state.is_running = true;
                return Ok(());
            }
            // A process can die between joining and declaring its liveliness token; no token event would then free its
            // devices.
            for host in state.overdue_hosts() {
                let name = state.admission.host_name(host);
                tracing::warn!(%host, "{name} joined and never became ready; its devices are free again");
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
