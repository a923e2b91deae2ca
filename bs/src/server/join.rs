//! Admission of hosts: join requests before the first TTI and after a loss, and the wait for all devices.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use reveille_common::bus::{draw_secret, scaled_timeout};
use reveille_common::deployment::Deployment;
use reveille_common::ids::HostId;
use reveille_common::message::{BusCredentials, HostCheckpoint, HostSetup, JoinReply, JoinRequest};
use reveille_common::secret::{HostCredential, Secret};

use super::admission::{Assignment, JoiningHost};
use super::config::{OnLoss, RunProgress, ServerConfig};
use super::error::BsError;
use super::state::{ServerState, SharedState, now};
use crate::scenario::Scenario;

/// Interval between checks of the time limit and the stop flag during the wait for hosts.
const LOOK: Duration = Duration::from_millis(100);

/// Time for a joined host to become ready, in a run with few hosts.
const READY: Duration = Duration::from_secs(20);

/// Answers join requests.
pub(super) struct JoinHandler {
    pub(super) shared: Arc<SharedState>,
    pub(super) scenario: Scenario,
    pub(super) deployment: Deployment,
    /// Secret with which the bus keys of admitted hosts begin.
    pub(super) secret: Secret,
    /// The key that a host must show to join, if any.
    pub(super) key: Option<Secret>,
    /// The devices of a resumed run.
    pub(super) start: Option<Arc<HostCheckpoint>>,
}

impl JoinHandler {
    pub(super) fn join(&self, request: &JoinRequest, shown: Option<Secret>) -> JoinReply {
        let ours = env!("CARGO_PKG_VERSION");
        if request.version != ours {
            return JoinReply::Refused(format!(
                "the device process is reveille {}, the base station is {ours}: run the same release on both sides",
                request.version
            ));
        }
        if self.key.is_some() && shown != self.key {
            return JoinReply::Refused(
                "the request does not show the run's key; use the key of the process that started the run".to_owned(),
            );
        }
        let reply = self.place(request);
        // This wakes the loop, which takes the lock that `place` has released.
        self.shared.notify();
        reply.unwrap_or_else(|refusal| refusal)
    }

    fn place(&self, request: &JoinRequest) -> Result<JoinReply, JoinReply> {
        let mut state = self.shared.lock();
        // A reply can get lost, so a repeated request gets the same assignment again, not a second one.
        if let Some((places, token)) = state.admission.find_by_nonce(request.nonce) {
            let resumption = state.losses.offer_for(places.host).map(|(_, resumption)| resumption);
            // The reply copies the setup of each device, and callbacks need the lock meanwhile.
            drop(state);
            return Ok(self.welcome(places, token, resumption));
        }
        let newcomer = JoiningHost {
            nonce: request.nonce,
            token: draw_secret().map_err(|error| JoinReply::Refused(error.to_string()))?,
            // Another process chose the name, which appears in logs, so its characters and length are limited.
            name: request.name.chars().filter(|c| !c.is_control()).take(64).collect(),
            count: request.count,
            asked: now(),
        };
        let token = newcomer.token;
        let devices = self.scenario.run.devices;
        if state.is_running {
            // Without `OnLoss::Wait` a lost host's devices are removed or end the run, so none become free again.
            if state.on_loss != OnLoss::Wait {
                return Err(JoinReply::Refused("the run has begun".to_owned()));
            }
            let Some((lost, resumption)) = state.losses.find_takeover(newcomer.count) else {
                return Err(later(&state, newcomer.count));
            };
            let places = state.admission.take_over(newcomer, lost);
            state.losses.offer(lost.host, places.host);
            drop(state);
            tracing::info!(host = %places.host, instead_of = %lost.host, "a host takes over");
            return Ok(self.welcome(places, token, Some(resumption)));
        }
        let Some(places) = state.admission.join(newcomer) else {
            let why = format!("all {devices} devices of the run have a host already");
            // With `wait` a spare process can still take over devices later, so it keeps asking.
            return Err(if state.on_loss == OnLoss::Wait {
                JoinReply::Retry(why)
            } else {
                JoinReply::Refused(why)
            });
        };
        drop(state);
        tracing::info!(host = %places.host, first = %places.first, devices = places.count, "a host joins");
        Ok(self.welcome(places, token, None))
    }

    fn welcome(&self, places: Assignment, token: Secret, resumption: Option<Arc<HostCheckpoint>>) -> JoinReply {
        let membership = BusCredentials {
            pass: HostCredential {
                host: places.host,
                token,
            },
            secret: self.secret,
        };
        let (first, count) = (places.first.0, places.count);
        let from_start = || {
            self.start
                .as_ref()
                .map(|start| start.part(places.first.index(), places.count as usize))
        };
        JoinReply::Welcome(Box::new(HostSetup {
            resumption: resumption.map(|r| (*r).clone()).or_else(from_start),
            ..self.deployment.host_setup(&self.scenario, membership, first, count)
        }))
    }
}

/// Builds the reply for a host that offers to run `count` devices while no devices are available for it.
fn later(state: &ServerState, count: u32) -> JoinReply {
    let lost: Vec<String> = state
        .losses
        .assignments()
        .map(|places| places.count.to_string())
        .collect();
    JoinReply::Retry(if lost.is_empty() {
        format!("all {} devices of the run have a host", state.admission.devices())
    } else {
        format!(
            "lost hosts left {} devices, and each of these ranges needs one host; this process offers to run {count}",
            lost.join(" + ")
        )
    })
}

impl ServerState {
    /// Marks `host` as lost, or cancels the takeover that it has not completed.
    pub(super) fn mark_lost(&mut self, host: HostId) {
        // If the new host of a takeover is lost before it runs the devices, another host can take them over.
        if self.losses.offer_for(host).is_some() {
            self.losses.decline(host);
            self.admission.revoke(host);
        } else if let Some(places) = self.admission.assignment(host) {
            self.losses.add(places, now());
        }
    }

    /// Removes a lost host and its devices from the run.
    pub(super) fn remove_host(&mut self, places: Assignment) {
        self.losses.drop_host(places.host);
        self.admission.revoke(places.host);
        self.barrier.remove_host(places.host);
        self.removals.push(places);
    }

    /// Returns the hosts that have joined and were not ready in time.
    pub(super) fn overdue_hosts(&self) -> Vec<HostId> {
        self.admission
            .overdue(now(), scaled_timeout(READY, self.admission.assigned_hosts() as u32))
    }

    /// Completes the takeover of a lost host by `host`, if one is pending and `host` is ready and alive.
    pub(super) fn fill(&mut self, host: HostId) {
        // The token and the ready message arrive in either order, so both callers try and the second one succeeds.
        if !self.admission.is_active(host) {
            return;
        }
        if let Some((lost, took)) = self.losses.complete_takeover(host, now())
            && let Some(places) = self.admission.assignment(host)
        {
            self.admission.revoke(lost.host);
            self.barrier.roster().replace(lost.host, places);
            self.reported.remove(&lost.host);
            // The new host resumes before the last grant, so the loop must resend that grant.
            self.needs_retransmit = true;
            let (first, last, took) = (places.first.0, places.last().0, took.as_secs_f64());
            let lost = lost.host;
            tracing::warn!(%host, first, last, "devices of lost host {lost} run again after {took:.2} s");
        }
    }
}

/// Waits until every device has a host and every host is ready.
pub(super) async fn wait_for_all(
    shared: &SharedState,
    scenario: &Scenario,
    settings: &ServerConfig,
    progress: &RunProgress,
) -> Result<(), BsError> {
    let begun = now();
    loop {
        {
            let mut state = shared.lock();
            progress
                .joined
                .store(u64::from(state.admission.assigned_devices()), Ordering::Relaxed);
            progress
                .hosts
                .store(state.admission.active_hosts() as u64, Ordering::Relaxed);
            if let Some(hosts) = state.admission.all_ready() {
                tracing::info!(
                    hosts = hosts.len(),
                    devices = scenario.run.devices,
                    "all devices have joined"
                );
                state.barrier.roster().set_hosts(hosts);
                state.is_running = true;
                return Ok(());
            }
            // A process can die between joining and declaring its token; no token event would then free its devices.
            for host in state.overdue_hosts() {
                tracing::warn!(%host, "a host joined and never became ready; its devices are free again");
                state.admission.leave(host);
            }
        }
        if progress.stop.load(Ordering::Relaxed) {
            return Err(BsError::Interrupted);
        }
        if settings
            .join_patience
            .is_some_and(|patience| begun.elapsed() >= patience)
        {
            let joined = shared.lock().admission.assigned_devices();
            return Err(BsError::TooFewJoined {
                joined,
                devices: scenario.run.devices,
                seconds: begun.elapsed().as_secs(),
            });
        }
        // The result does not matter: after a notification or a timeout all conditions are checked again.
        let _looked = tokio::time::timeout(LOOK, shared.wait()).await;
    }
}
