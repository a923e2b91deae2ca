//! Subscriptions and queryables of a run: messages of hosts and operators enter the shared state here. This file checks
//! the credentials of hosts and the run's key of clock commands, `actions` and `join` check the key of their requests,
//! and `roster` the values. `deploy/src/commands/bs.rs` serves the description and the input log of the run, and
//! [`super::policy_port`] asks policy processes.

use std::sync::Arc;

use reveille_common::bus::{Bus, BusError, DeclarationGuard};
use reveille_common::deployment::Deployment;
use reveille_common::message::{ActRequest, ClockCommand, HostAnswer, HostCheckpoint, JoinRequest, Ready, Report};
use reveille_common::secret::HostCredential;

use super::actions::ActionHandler;
use super::config::ServerConfig;
use super::failover::ReplaySource;
use super::join::JoinHandler;
use super::state::{ServerState, SharedState, now};
use crate::scenario::Scenario;

/// Declares all subscriptions and queryables, until the guards are dropped. `bus` must be the base station's session.
///
/// # Errors
/// If `bus` is another session, or zenoh refuses.
pub(super) fn declare(
    bus: &Bus,
    scenario: &Scenario,
    deployment: &Deployment,
    settings: &ServerConfig,
    checkpoint: Option<Arc<HostCheckpoint>>,
    replay: Option<Arc<dyn ReplaySource>>,
    shared: &Arc<SharedState>,
) -> Result<Vec<DeclarationGuard>, BusError> {
    let key_exprs = bus.key_exprs();
    let bus_secret = key_exprs
        .member_secret()
        .ok_or_else(|| BusError::Refused("this session does not belong to a base station".to_owned()))?;
    let mut guards = Vec::new();
    let shared_state = Arc::clone(shared);
    guards.push(bus.subscribe_uplinks(move |credential, report: Report| {
        handle_host_message(&shared_state, credential, |state| {
            state.barrier.receive_report(credential.host, report)
        });
    })?);
    let shared_state = Arc::clone(shared);
    guards.push(bus.subscribe_uplinks(move |credential, answer: HostAnswer| {
        handle_host_message(&shared_state, credential, |state| {
            state.barrier.receive_answer(credential.host, answer)
        });
    })?);
    let shared_state = Arc::clone(shared);
    guards.push(
        bus.watch_alive(key_exprs.all_host_liveliness(), move |key_expr, is_alive| {
            if let Some(credential) = HostCredential::from_key_expr(key_expr) {
                shared_state.lock().on_liveliness(credential, is_alive);
                shared_state.notify_run_loop();
            }
        })?,
    );
    let (shared_state, run_key) = (Arc::clone(shared), settings.run_key);
    guards.push(bus.serve_with_secret(move |command: ClockCommand, shown| {
        // A request for the status changes nothing, so any client may send it.
        if command != ClockCommand::Status && run_key.is_some_and(|key| shown != Some(key)) {
            return Err(format!(
                "`{command}` needs the run's key; use the key of the process that started the run"
            ));
        }
        let mut state = shared_state.lock();
        let next = state.next_tti;
        // The command and the TTI that it counts from must belong to one state of the clock.
        state.clock.apply(command, next);
        shared_state.notify_run_loop();
        Ok(state.clock_status())
    })?);
    let action_handler = ActionHandler {
        shared: Arc::clone(shared),
        scenario: scenario.clone(),
        run_key: settings.run_key,
        replay,
    };
    guards.push(bus.serve_with_secret(move |request: ActRequest, shown| action_handler.accept(request, shown))?);
    let shared_state = Arc::clone(shared);
    guards.push(bus.serve_with_secret(move |Ready { host }, shown| {
        let credential = shown.map(|secret| HostCredential { host, token: secret });
        let is_known = credential.is_some_and(|credential| shared_state.lock().on_ready(credential));
        shared_state.notify_run_loop();
        Ok(is_known)
    })?);
    let join_handler = JoinHandler {
        shared: Arc::clone(shared),
        scenario: scenario.clone(),
        deployment: deployment.clone(),
        bus_secret,
        required_key: settings.run_key.filter(|_| settings.join_needs_key),
        resumed_devices: checkpoint,
    };
    guards.push(
        bus.serve_with_secret(move |request: JoinRequest, shown| Ok(join_handler.handle_request(&request, shown)))?,
    );
    // Declared last, so that no process finds the base station alive before its queryables exist.
    guards.push(bus.declare_alive(key_exprs.bs_liveliness())?);
    Ok(guards)
}

/// Passes a message from a host to `handle`, which returns whether it completes the barrier.
fn handle_host_message(
    shared: &SharedState,
    credential: HostCredential,
    handle: impl FnOnce(&mut ServerState) -> bool,
) {
    let mut state = shared.lock();
    // The credential comes from the message's key expression; a revoked host or an unknown process has no valid one.
    if !state.admission.is_valid(credential) {
        state.barrier.count_unexpected();
    } else if handle(&mut state) {
        drop(state);
        shared.notify_run_loop();
    }
}

impl ServerState {
    /// Records that the host with this credential has made all its subscriptions. Returns whether the credential is
    /// valid.
    fn on_ready(&mut self, credential: HostCredential) -> bool {
        let is_valid = self.admission.mark_ready(credential);
        if is_valid {
            self.try_complete_takeover(credential.host);
        }
        is_valid
    }

    /// Records that the liveliness token of the host with this credential has appeared or disappeared.
    fn on_liveliness(&mut self, credential: HostCredential, is_alive: bool) {
        let host = credential.host;
        if !self.admission.is_valid(credential) {
            return;
        }
        self.admission.set_alive(host, is_alive);
        match (is_alive, self.is_running) {
            (true, _) => {
                if let Some(newcomer) = self.lost_hosts.end_loss(host, now()) {
                    tracing::warn!(%host, "{} is back", self.admission.host_name(host));
                    self.needs_retransmit = true;
                    // The returned host still has its devices, so the new host that was to take them over is revoked.
                    newcomer.and_then(|newcomer| self.admission.revoke(newcomer));
                } else {
                    self.try_complete_takeover(host);
                }
            }
            (false, true) => self.mark_lost(host),
            (false, false) => {
                // Before the run no device has state, so its devices are immediately free for another process.
                if let Some(assignment) = self.admission.free_host(host) {
                    let (devices, name) = (assignment.count, self.admission.host_name(host));
                    tracing::warn!(%host, devices, "{name} left before the run began; its devices are free again");
                }
            }
        }
    }
}
