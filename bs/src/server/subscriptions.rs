//! Subscriptions and queryables of the base station, and their effect on its state.

use std::sync::Arc;

use reveille_common::bus::{Bus, BusError, DeclarationGuard};
use reveille_common::deployment::Deployment;
use reveille_common::message::{ClockCommand, HostAnswer, HostCheckpoint, JoinRequest, Ready, Report};
use reveille_common::secret::HostCredential;

use super::config::ServerConfig;
use super::join::JoinHandler;
use super::state::{ServerState, SharedState, now};
use crate::scenario::Scenario;

/// Declares all subscriptions and queryables of the base station.
pub(super) fn declare(
    bus: &Bus,
    scenario: &Scenario,
    deployment: &Deployment,
    settings: &ServerConfig,
    start: Option<Arc<HostCheckpoint>>,
    shared: &Arc<SharedState>,
) -> Result<Vec<DeclarationGuard>, BusError> {
    let keys = bus.keys();
    let secret = keys
        .secret()
        .ok_or_else(|| BusError::Refused("this session does not belong to a base station".to_owned()))?;
    let mut declared = Vec::new();
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_uplinks(move |pass, report: Report| {
        heard(&this, pass, |state| state.barrier.report(pass.host, report));
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_uplinks(move |pass, answer: HostAnswer| {
        heard(&this, pass, |state| state.barrier.answer(pass.host, answer));
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.watch_alive(keys.all_alive(), move |key, alive| {
        if let Some(pass) = HostCredential::at_end_of(key) {
            this.lock().on_alive(pass, alive);
            this.notify();
        }
    })?);
    let (this, control) = (Arc::clone(shared), settings.key);
    declared.push(bus.serve_with_secret(move |command: ClockCommand, shown| {
        // Asking for the status changes nothing, so anyone may do it.
        if command != ClockCommand::Status && control.is_some_and(|key| shown != Some(key)) {
            return Err(format!(
                "`{command}` needs the run's key; use the key of the process that started the run"
            ));
        }
        let mut state = this.lock();
        let next = state.next;
        // The command and the TTI that it counts from must belong to one state of the clock.
        state.clock.apply(command, next);
        this.notify();
        Ok(state.status())
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.serve_with_secret(move |Ready { host }, shown| {
        let pass = shown.map(|token| HostCredential { host, token });
        let known = pass.is_some_and(|pass| this.lock().on_ready(pass));
        this.notify();
        Ok(known)
    })?);
    let handler = JoinHandler {
        shared: Arc::clone(shared),
        scenario: scenario.clone(),
        deployment: deployment.clone(),
        secret,
        key: settings.key.filter(|_| settings.members_only),
        start,
    };
    declared.push(bus.serve_with_secret(move |request: JoinRequest, shown| Ok(handler.join(&request, shown)))?);
    // Declared last, so that no process finds the base station alive before its queryables exist.
    declared.push(bus.declare_alive(keys.bs_alive())?);
    Ok(declared)
}

/// Passes a message from a host to `take`, which returns whether it completes the barrier.
fn heard(shared: &SharedState, pass: HostCredential, take: impl FnOnce(&mut ServerState) -> bool) {
    let mut state = shared.lock();
    // The credential comes from the key of the message; a revoked host or an unknown process has no valid one.
    if !state.admission.is_valid(pass) {
        state.barrier.count_unexpected();
    } else if take(&mut state) {
        drop(state);
        shared.notify();
    }
}

impl ServerState {
    /// Records that the host with this credential has made all its subscriptions. Returns whether the credential is
    /// valid.
    fn on_ready(&mut self, pass: HostCredential) -> bool {
        let is_valid = self.admission.ready(pass);
        if is_valid {
            self.fill(pass.host);
        }
        is_valid
    }

    /// Records that the liveliness token of the host with this credential has appeared or disappeared.
    fn on_alive(&mut self, pass: HostCredential, alive: bool) {
        let host = pass.host;
        if !self.admission.is_valid(pass) {
            return;
        }
        self.admission.set_alive(host, alive);
        match (alive, self.is_running) {
            (true, _) => {
                if let Some(newcomer) = self.losses.restore(host, now()) {
                    tracing::warn!(%host, "a lost host is back");
                    self.reported.remove(&host);
                    self.needs_retransmit = true;
                    // The returned host still has its devices, so the new host that was to take them over is revoked.
                    newcomer.and_then(|newcomer| self.admission.revoke(newcomer));
                } else {
                    self.fill(host);
                }
            }
            (false, true) => self.mark_lost(host),
            (false, false) => {
                // Before the run no device has state, so its devices are immediately free for another process.
                if let Some(places) = self.admission.leave(host) {
                    let devices = places.count;
                    tracing::warn!(%host, devices, "a host left before the run began; its devices are free again");
                }
            }
        }
    }
}
