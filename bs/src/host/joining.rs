//! Hosts ask for places and say that they are ready, before the first TTI and after a loss; their tokens come and go.
//! Also all other subscriptions of the BS.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, Declared, allowed, draw_secret};
use reveille_common::deployment::Deployment;
use reveille_common::ids::HostId;
use reveille_common::message::{
    Answer, Assignment, ClockCommand, JoinReply, JoinRequest, Membership, Ready, Report, Resumption,
};
use reveille_common::scenario::Scenario;
use reveille_common::secret::{HostPass, Secret};

use super::admission::{Newcomer, Places};
use super::drive::{OnLoss, Progress, Settings};
use super::error::BsError;
use super::shared::{BsState, Shared};
use super::wall::now;
use crate::taken::Start;

/// How often the wait looks at the clock on the wall and at the stop flag.
const LOOK: Duration = Duration::from_millis(100);

/// Within what time a host that has joined must be ready, where hosts are few.
const READY: Duration = Duration::from_secs(20);

/// What newcomers are told, and who may be one.
struct Door {
    shared: Arc<Shared>,
    scenario: Scenario,
    deployment: Deployment,
    /// What the keys of members begin with.
    secret: Secret,
    /// What a host must show to be let in, if anything.
    key: Option<Secret>,
    start: Option<Arc<Start>>,
}

/// Everything that the BS listens to.
pub(super) fn declare(
    bus: &Bus,
    scenario: &Scenario,
    deployment: &Deployment,
    settings: &Settings,
    start: Option<Arc<Start>>,
    shared: &Arc<Shared>,
) -> Result<Vec<Declared>, BusError> {
    let keys = bus.keys();
    let secret = keys
        .secret()
        .ok_or_else(|| BusError::Refused("this is no base station's session".to_owned()))?;
    let mut declared = Vec::new();
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_uplinks(move |pass, report: Report| {
        heard(&this, pass, |state| state.barrier.report(pass.host, report));
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.subscribe_uplinks(move |pass, answer: Answer| {
        heard(&this, pass, |state| state.barrier.answer(pass.host, answer));
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.watch_alive(keys.all_alive(), move |key, alive| {
        if let Some(pass) = HostPass::at_end_of(key) {
            this.lock().on_alive(pass, alive);
            this.ring();
        }
    })?);
    let (this, control) = (Arc::clone(shared), settings.key);
    declared.push(bus.serve_shown(move |command: ClockCommand, shown| {
        if command != ClockCommand::Status && control.is_some_and(|key| shown != Some(key)) {
            return Err(format!(
                "`{command}` needs the run's key, which whoever started the run has"
            ));
        }
        let mut state = this.lock();
        let next = state.next;
        state.clock.obey(command, next);
        this.ring();
        Ok(state.status())
    })?);
    let this = Arc::clone(shared);
    declared.push(bus.serve_shown(move |Ready { host }, shown| {
        let pass = shown.map(|token| HostPass { host, token });
        let known = pass.is_some_and(|pass| this.lock().on_ready(pass));
        this.ring();
        Ok(known)
    })?);
    let door = Door {
        shared: Arc::clone(shared),
        scenario: scenario.clone(),
        deployment: deployment.clone(),
        secret,
        key: settings.key.filter(|_| settings.members_only),
        start,
    };
    declared.push(bus.serve_shown(move |request: JoinRequest, shown| Ok(door.join(&request, shown)))?);
    declared.push(bus.declare_alive(keys.bs_alive())?);
    Ok(declared)
}

/// Takes in what a host says; `take` says whether that was the last thing waited for.
fn heard(shared: &Shared, pass: HostPass, take: impl FnOnce(&mut BsState) -> bool) {
    let mut state = shared.lock();
    if !state.admission.is_valid(pass) {
        state.barrier.stray();
    } else if take(&mut state) {
        drop(state);
        shared.ring();
    }
}

impl Door {
    fn join(&self, request: &JoinRequest, shown: Option<Secret>) -> JoinReply {
        let ours = env!("CARGO_PKG_VERSION");
        if request.version != ours {
            return JoinReply::Refused(format!(
                "the device process is reveille {}, the base station is {ours}: run the same release on both sides",
                request.version
            ));
        }
        if self.key.is_some() && shown != self.key {
            return JoinReply::Refused("only processes that have the run's key may carry its devices".to_owned());
        }
        let reply = self.place(request);
        self.shared.ring();
        reply.unwrap_or_else(|refusal| refusal)
    }

    fn place(&self, request: &JoinRequest) -> Result<JoinReply, JoinReply> {
        let mut state = self.shared.lock();
        if let Some((places, token)) = state.admission.known(request.nonce) {
            let resumption = state.losses.offered_to(places.host).map(|(_, resumption)| resumption);
            drop(state);
            return Ok(self.welcome(places, token, resumption));
        }
        let newcomer = Newcomer {
            nonce: request.nonce,
            token: draw_secret().map_err(|error| JoinReply::Refused(error.to_string()))?,
            name: request.name.chars().filter(|c| !c.is_control()).take(64).collect(),
            count: request.count,
            asked: now(),
        };
        let token = newcomer.token;
        let devices = self.scenario.devices;
        if state.is_running {
            if state.on_loss != OnLoss::Wait {
                return Err(JoinReply::Refused("the run has begun".to_owned()));
            }
            let Some((lost, resumption)) = state.losses.fitting(newcomer.count) else {
                return Err(later(&state, newcomer.count));
            };
            let places = state.admission.take_over(newcomer, lost);
            state.losses.offer(lost.host, places.host);
            drop(state);
            tracing::info!(host = %places.host, instead_of = %lost.host, "a host takes over");
            return Ok(self.welcome(places, token, Some(resumption)));
        }
        let Some(places) = state.admission.join(newcomer) else {
            let why = format!("all {devices} devices of the run are carried already");
            return Err(if state.on_loss == OnLoss::Wait {
                JoinReply::Later(why)
            } else {
                JoinReply::Refused(why)
            });
        };
        drop(state);
        tracing::info!(host = %places.host, first = %places.first, devices = places.count, "a host joins");
        Ok(self.welcome(places, token, None))
    }

    fn welcome(&self, places: Places, token: Secret, resumption: Option<Arc<Resumption>>) -> JoinReply {
        let membership = Membership {
            pass: HostPass {
                host: places.host,
                token,
            },
            secret: self.secret,
        };
        let (first, count) = (places.first.0, places.count);
        let from_start = || {
            self.start
                .as_ref()
                .map(|start| start.resumption(places.first, places.count))
        };
        JoinReply::Welcome(Box::new(Assignment {
            resumption: resumption.map(|r| (*r).clone()).or_else(from_start),
            ..self.deployment.assignment(&self.scenario, membership, first, count)
        }))
    }
}

/// What who offers to carry `count` devices is told while there are none for it.
fn later(state: &BsState, count: u32) -> JoinReply {
    let lost: Vec<String> = state.losses.places().map(|places| places.count.to_string()).collect();
    JoinReply::Later(if lost.is_empty() {
        format!("all {} devices of the run are carried", state.admission.devices())
    } else {
        format!(
            "lost processes have left {} devices, each lot to be taken over whole; {count} are offered",
            lost.join(" + ")
        )
    })
}

impl BsState {
    /// The host with this pass has subscribed to everything. Whether its places are its own.
    fn on_ready(&mut self, pass: HostPass) -> bool {
        let is_valid = self.admission.ready(pass);
        if is_valid {
            self.fill(pass.host);
        }
        is_valid
    }

    /// The token of the host with this pass has come or is gone.
    fn on_alive(&mut self, pass: HostPass, alive: bool) {
        let host = pass.host;
        if !self.admission.is_valid(pass) {
            return;
        }
        self.admission.set_alive(host, alive);
        match (alive, self.is_running) {
            (true, _) => {
                if let Some(newcomer) = self.losses.back(host, now()) {
                    tracing::warn!(%host, "a lost host is back");
                    self.reported.remove(&host);
                    self.returned = true;
                    newcomer.and_then(|newcomer| self.admission.retire(newcomer));
                } else {
                    self.fill(host);
                }
            }
            (false, true) => self.lose(host),
            (false, false) => {
                if let Some(places) = self.admission.leave(host) {
                    let devices = places.count;
                    tracing::warn!(%host, devices, "a host left before the run began; its places are free again");
                }
            }
        }
    }

    /// The host no longer carries its devices, or will not.
    pub(super) fn lose(&mut self, host: HostId) {
        if self.losses.offered_to(host).is_some() {
            self.losses.decline(host);
            self.admission.retire(host);
        } else if let Some(places) = self.admission.places(host) {
            self.losses.lose(places, now());
        }
    }

    /// The run goes on without the devices of the lost host with these places.
    pub(super) fn go_on_without(&mut self, places: Places) {
        self.losses.forget(places.host);
        self.admission.retire(places.host);
        self.barrier.lose(places.host);
        self.leaving.push(places);
    }

    /// Hosts that have joined and were not ready in time.
    pub(super) fn late(&self) -> Vec<HostId> {
        self.admission
            .late(now(), allowed(READY, self.admission.placed() as u32))
    }

    /// A newcomer carries the devices of a lost host, if it is one and all is in place.
    fn fill(&mut self, host: HostId) {
        if !self.admission.carries(host) {
            return;
        }
        if let Some((lost, took)) = self.losses.filled(host, now())
            && let Some(places) = self.admission.places(host)
        {
            self.admission.retire(lost.host);
            self.barrier.roster().replace(lost.host, places);
            self.reported.remove(&lost.host);
            self.returned = true;
            let (first, last, took) = (places.first.0, places.last().0, took.as_secs_f64());
            let lost = lost.host;
            tracing::warn!(%host, first, last, "devices of lost host {lost} are carried again after {took:.2} s");
        }
    }
}

/// Waits until every device has a host and every host is ready.
pub(super) async fn wait_for_all(
    shared: &Shared,
    scenario: &Scenario,
    settings: &Settings,
    progress: &Progress,
) -> Result<(), BsError> {
    let begun = now();
    loop {
        {
            let mut state = shared.lock();
            progress
                .joined
                .store(u64::from(state.admission.taken()), Ordering::Relaxed);
            progress
                .hosts
                .store(state.admission.carrying() as u64, Ordering::Relaxed);
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
            for host in state.late() {
                tracing::warn!(%host, "a host joined and then said nothing more; its places are free again");
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
            let joined = shared.lock().admission.taken();
            return Err(BsError::TooFew {
                joined,
                devices: scenario.devices,
                seconds: begun.elapsed().as_secs(),
            });
        }
        let _looked = tokio::time::timeout(LOOK, shared.rung()).await;
    }
}
