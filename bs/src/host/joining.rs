//! Before the first TTI: hosts ask for places and say that they are ready. Also all other subscriptions of the BS.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, Declared};
use reveille_common::deployment::Deployment;
use reveille_common::ids::HostId;
use reveille_common::keys::last_number;
use reveille_common::message::{Answer, ClockCommand, JoinReply, JoinRequest, Ready, Report};
use reveille_common::scenario::Scenario;

use super::drive::{Progress, Settings};
use super::error::BsError;
use super::shared::Shared;

/// How often the wait looks at the clock on the wall and at the stop flag.
const LOOK: Duration = Duration::from_millis(100);

/// Looks within which a host that has joined must be ready: 20 s.
const READY_LOOKS: u32 = 200;

/// Everything that the BS listens to.
pub(super) fn declare(
    bus: &Bus,
    scenario: &Scenario,
    deployment: &Deployment,
    shared: &Arc<Shared>,
) -> Result<Vec<Declared>, BusError> {
    let keys = bus.keys();
    let mut declared = Vec::new();
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_all(move |device, report: Report| {
        if this.lock().barrier.report(device, report) {
            this.ring();
        }
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_all(move |host, answer: Answer| {
        if this.lock().barrier.answer(host, answer) {
            this.ring();
        }
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.watch_alive(keys.all_alive(), move |key, alive| on_alive(&this, key, alive))?);
    let this = Arc::clone(shared);
    declared.push(bus.serve(move |command: ClockCommand| {
        let mut state = this.lock();
        let next = state.next;
        state.clock.obey(command, next);
        this.ring();
        state.status()
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.serve(move |Ready { host }| {
        let known = this.lock().admission.ready(host);
        this.ring();
        known
    })?);
    let (this, scenario, deployment) = (Arc::clone(shared), scenario.clone(), deployment.clone());
    declared.push(bus.serve(move |request: JoinRequest| join(&this, &scenario, &deployment, &request))?);
    declared.push(bus.declare_alive(keys.bs_alive())?);
    Ok(declared)
}

fn join(shared: &Shared, scenario: &Scenario, deployment: &Deployment, request: &JoinRequest) -> JoinReply {
    let ours = env!("CARGO_PKG_VERSION");
    if request.version != ours {
        return JoinReply::Refused(format!(
            "the device process is reveille {}, the base station is {ours}: run the same release on both sides",
            request.version
        ));
    }
    let mut state = shared.lock();
    let Some(places) = state.admission.join(request.nonce, request.count) else {
        let lost = if state.lost.is_empty() {
            ""
        } else {
            "; a new process cannot take over those of a lost one"
        };
        return JoinReply::Refused(format!(
            "all {} devices of the run are carried already{lost}",
            scenario.devices
        ));
    };
    if state.is_running {
        return JoinReply::Refused("the run has begun".to_owned());
    }
    shared.ring();
    drop(state);
    tracing::info!(host = %places.host, first = %places.first, devices = places.count, "a host joins");
    JoinReply::Welcome(deployment.assignment(scenario, places.host, places.first.0, places.count))
}

fn on_alive(shared: &Shared, key: &str, alive: bool) {
    let Some(host) = last_number(key).map(HostId) else {
        return;
    };
    let mut state = shared.lock();
    if alive {
        if state.lost.remove(&host) {
            tracing::warn!(%host, "a lost host is back");
            state.reported.remove(&host);
            state.returned = true;
        }
    } else if state.is_running {
        if state.admission.places(host).is_some() {
            state.lost.insert(host);
        }
    } else if let Some(places) = state.admission.leave(host) {
        tracing::warn!(%host, devices = places.count, "a host left before the run began; its places are free again");
    }
    shared.ring();
}

/// Waits until every device has a host and every host is ready.
pub(super) async fn wait_for_all(
    shared: &Shared,
    scenario: &Scenario,
    settings: &Settings,
    progress: &Progress,
) -> Result<(), BsError> {
    let mut waited = Duration::ZERO;
    loop {
        {
            let mut state = shared.lock();
            progress
                .joined
                .store(u64::from(state.admission.taken()), Ordering::Relaxed);
            if let Some(hosts) = state.admission.complete() {
                tracing::info!(
                    hosts = hosts.len(),
                    devices = scenario.devices,
                    "all devices have joined"
                );
                state.barrier.roster().set_hosts(hosts);
                state.is_running = true;
                return Ok(());
            }
        }
        if progress.stop.load(Ordering::Relaxed) {
            return Err(BsError::Interrupted);
        }
        if settings.join_patience.is_some_and(|patience| waited >= patience) {
            let joined = shared.lock().admission.taken();
            return Err(BsError::TooFew {
                joined,
                devices: scenario.devices,
                seconds: waited.as_secs(),
            });
        }
        if tokio::time::timeout(LOOK, shared.rung()).await.is_err() {
            waited += LOOK;
            for host in shared.lock().admission.look(READY_LOOKS) {
                tracing::warn!(%host, "a host joined and then said nothing more; its places are free again");
            }
        }
    }
}
