//! From the first TTI to the last ledger.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::ids::Tti;
use reveille_common::message::{Clock, Pace, Resumption, Tick};
use reveille_common::score::Accounts;
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, EventTotals, Ledger};

use super::drive::{OnLoss, Progress, Served, Settings};
use super::error::BsError;
use super::losses::{Point, Replay};
use super::shared::{BsState, Shared};
use super::voice::Voice;
use super::wall::now;
use crate::boundaries::Boundaries;
use crate::cycle::{Cycle, Step};
use crate::host::barrier::Asked;
use crate::host::clock::Lateness;
use crate::observe::{Happening, Observer};
use crate::prepared::Prepared;
use crate::taken::Taken;

/// How often a wait looks at what else may have happened.
const LOOK: Duration = Duration::from_millis(100);
/// How long hosts may take to answer once the run is to stop.
const STOP: Duration = Duration::from_secs(3);
/// How long the BS waits for an answer before it asks once more.
const REPEAT: Duration = Duration::from_secs(1);
/// How long hosts may be silent before they are named.
const SILENT: Duration = Duration::from_secs(5);
/// How long hosts may be silent before they count as lost, though their tokens are there.
const MUTE: Duration = Duration::from_secs(30);

/// What drives a run beside its settings.
pub(super) struct Crew<'a> {
    pub(super) bus: &'a Bus,
    pub(super) settings: &'a Settings,
    pub(super) progress: &'a Progress,
    pub(super) shared: &'a Arc<Shared>,
    pub(super) replay: Option<Arc<dyn Replay>>,
}

/// The loop over TTIs.
struct Loop<'a> {
    voice: Voice<'a>,
    crew: Crew<'a>,
    cycle: Cycle,
    devices: u32,
    boundaries: Boundaries,
    accounts: Accounts,
    /// The TTI from which the plan in force holds.
    plan_from: Option<Tti>,
    /// Where a newcomer takes up devices.
    point: Point,
    /// The devices at the end of the last TTI, where somebody wants to know.
    views: Vec<DeviceView>,
    grants: u64,
    lateness: Lateness,
    pace: Pace,
    /// The moment at which a TTI was or will be due, under a real-time pace.
    due: Option<(Tti, Instant)>,
}

pub(super) async fn run(
    crew: Crew<'_>,
    prepared: &Prepared,
    taken: Option<Taken>,
    observer: &mut impl Observer,
    joining: Duration,
) -> Result<Served, BsError> {
    let (cycle, accounts, point, views) = if let Some(taken) = taken {
        let (next, plan) = (taken.start.next, taken.start.plan);
        (taken.cycle, taken.accounts, Point { next, plan }, taken.views)
    } else {
        let (cycle, accounts) = (Cycle::new(prepared), Accounts::new(&prepared.deployment));
        (cycle, accounts, Point::default(), Vec::new())
    };
    let boundaries = Boundaries::new(&prepared.scenario, crew.settings.window);
    let mut this = Loop {
        voice: Voice::new(crew.bus)?,
        pace: crew.settings.pace,
        crew,
        cycle,
        devices: prepared.scenario.devices,
        accounts,
        boundaries,
        plan_from: point.plan,
        point,
        views,
        grants: 0,
        lateness: Lateness::default(),
        due: None,
    };
    this.show();
    this.crew.shared.lock().name_carriers(this.crew.progress);
    let started = now();
    let outcome = match this.play(observer).await {
        Ok(ledgers) => {
            let (end, events) = (this.cycle.next_tti(), *this.cycle.event_totals());
            this.account(end, ledgers.iter().map(|ledger| ledger.whole).sum(), events, observer);
            this.cycle.finish(&ledgers)
        }
        Err(error) if error.is_interruption() => match &this.crew.replay {
            // Nobody answers for some devices, but what they have come to follows.
            Some(replay) => replay.outcome(this.point.next).map_err(BsError::CannotGoOn)?,
            None => return Err(error),
        },
        Err(error) => return Err(error),
    };
    let running = started.elapsed();
    let mut state = this.crew.shared.lock();
    Ok(Served {
        outcome,
        joining,
        running,
        hosts: state.barrier.roster().hosts(),
        grants: this.grants,
        lateness: this.lateness,
        malformed: this.crew.bus.malformed(),
        strays: state.barrier.strays(),
        losses: state.losses.mended().to_vec(),
    })
}

impl Loop<'_> {
    /// All TTIs from the next to the last, and the ledgers of all devices after them.
    async fn play(&mut self, observer: &mut impl Observer) -> Result<Vec<Ledger>, BsError> {
        while self.cycle.next_tti() < self.boundaries.end() && self.may_go_on().await? {
            if !self.grant(observer).await? {
                break;
            }
        }
        self.collect_ledgers().await
    }

    /// Waits while the clock is paused, or held for a lost host. False when the run is to stop.
    async fn may_go_on(&mut self) -> Result<bool, BsError> {
        let next = self.cycle.next_tti();
        loop {
            let (paused, pace, is_whole) = {
                let mut state = self.crew.shared.lock();
                self.check(&mut state)?;
                (state.stand(next), state.clock.pace(), state.losses.is_empty())
            };
            if self.crew.progress.stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            if pace != self.pace {
                (self.pace, self.due) = (pace, None);
            }
            self.crew.progress.paused.store(paused, Ordering::Relaxed);
            let is_returned = std::mem::take(&mut self.crew.shared.lock().returned);
            if is_returned {
                self.say_again()?;
            }
            if !paused && is_whole {
                return Ok(true);
            }
            if paused {
                self.due = None;
            }
            let _changed = tokio::time::timeout(LOOK, self.crew.shared.rung()).await;
        }
    }

    /// One grant with its reports and wake-ups. False when the observer wants to stop.
    async fn grant(&mut self, observer: &mut impl Observer) -> Result<bool, BsError> {
        let first = self.cycle.next_tti();
        self.keep_pace(first).await?;
        {
            let state = self.crew.shared.lock();
            if state.clock.until() <= first || !state.losses.is_empty() {
                // It was told to stop while it waited, or a host is lost, whose devices are taken up at the last grant.
                return Ok(true);
            }
        }
        self.crew.bus.set_tti(first);
        if self.cycle.wants_batteries() {
            self.cycle.tell_batteries(self.views.iter().map(|view| view.battery));
        }
        let account = self.boundaries.is_boundary(first);
        let events = *self.cycle.event_totals();
        let horizon = self.horizon(first);
        let wants_states = observer.wants_states();
        let granted = self.cycle.grant(horizon, observer);
        let grant = granted.grant;
        self.point = Point {
            next: first,
            plan: self.plan_from,
        };
        self.voice.begin();
        if let Some(update) = granted.update.clone() {
            self.plan_from = Some(update.from);
            tracing::debug!(from = %update.from, "the plan goes out");
            self.voice.plan(update)?;
        }
        let asked = Asked {
            account,
            views: self.cycle.will_want_batteries() || wants_states,
        };
        let tick = Clock::Grant(Tick {
            first,
            last: grant.last,
            stimulus: grant.stimulus,
            account,
            views: asked.views,
            plan: self.plan_from.unwrap_or_default(),
        });
        {
            let mut state = self.crew.shared.lock();
            state.next = grant.last + 1;
            state.barrier.expect_grant(grant.last, grant.stimulus.is_some(), asked);
        }
        self.crew.bus.set_tti(grant.last);
        self.voice.clock(tick)?;
        self.grants += 1;
        tracing::trace!(first = %grant.first, last = %grant.last, stimulus = ?grant.stimulus, "granted");
        self.answered().await?;
        let mut gathered = self.crew.shared.lock().barrier.take_gathered();
        self.views = std::mem::take(&mut gathered.views);
        let mut step = self
            .cycle
            .gathered(granted, &mut gathered.reports, &mut gathered.failures, observer);
        while let Step::WakeUp(waking) = step {
            let device = waking.device();
            let host = {
                let mut state = self.crew.shared.lock();
                state.barrier.expect_wake(grant.last, device);
                state.barrier.roster().carrier(device)
            };
            if let Some(host) = host {
                self.voice.wake_up(host, device, grant.last)?;
            }
            self.answered().await?;
            let outcome = self.crew.shared.lock().barrier.take_outcome();
            tracing::debug!(tti = %grant.last, %device, ?outcome, "woken");
            if let Some(view) = self.views.get_mut(device.index()) {
                *view = outcome.on(*view);
            }
            step = self.cycle.woken(waking, &outcome, observer);
        }
        if wants_states {
            observer.see(&Happening::States(&self.views));
        }
        self.show();
        Ok(!account || self.account(first, gathered.totals, events, observer))
    }

    /// The TTI before which the next grant must end.
    fn horizon(&self, first: Tti) -> Tti {
        let one_by_one = !self.crew.settings.lookahead || self.pace != Pace::Max;
        let horizon = if one_by_one {
            first + 1
        } else {
            self.boundaries.next_boundary(first)
        };
        horizon.min(self.crew.shared.lock().clock.until()).max(first + 1)
    }

    /// Takes in the sums at boundary `k`, where the counted events came to `events`. False when the observer wants to
    /// stop.
    fn account(&mut self, k: Tti, energy: DeviceTotals, events: EventTotals, observer: &mut impl Observer) -> bool {
        let window = self.accounts.reach(k, energy, events);
        let ttis = window.end - window.first;
        if ttis > 0 {
            let mean = window.energy.battery_sum / u128::from(ttis) / u128::from(self.devices.max(1));
            self.crew.progress.mean_battery.store(mean as u64, Ordering::Relaxed);
        }
        observer.window(&window)
    }

    fn show(&self) {
        let events = self.cycle.event_totals();
        self.crew.progress.tti.store(self.cycle.next_tti().0, Ordering::Relaxed);
        self.crew.progress.events.store(events.events, Ordering::Relaxed);
        self.crew
            .progress
            .misdetected
            .store(events.misdetected, Ordering::Relaxed);
        let hosts = {
            let mut state = self.crew.shared.lock();
            let carrying = state.barrier.roster().hosts();
            carrying.saturating_sub(state.losses.places().count())
        };
        self.crew.progress.hosts.store(hosts as u64, Ordering::Relaxed);
        self.crew
            .progress
            .late_ttis
            .store(self.lateness.late, Ordering::Relaxed);
        let latest = self.lateness.max.as_nanos() as u64;
        self.crew.progress.max_late.store(latest, Ordering::Relaxed);
    }

    /// Waits until `first` is due, under a real-time pace.
    async fn keep_pace(&mut self, first: Tti) -> Result<(), BsError> {
        let Pace::RealTime(micros) = self.pace else {
            return Ok(());
        };
        let duration = Duration::from_micros(micros);
        let now = now();
        let due = match self.due {
            Some((tti, moment)) => moment + duration.saturating_mul((first - tti) as u32),
            None => now,
        };
        if due < now {
            self.lateness.count(now - due);
        }
        self.due = Some((first, due));
        self.sleep_until(due).await
    }

    /// Sleeps, but not through a loss, another pace, or a wish to stop or to pause.
    async fn sleep_until(&mut self, due: Instant) -> Result<(), BsError> {
        while now() < due && !self.crew.progress.stop.load(Ordering::Relaxed) {
            tokio::time::sleep_until(due.min(now() + LOOK).into()).await;
            let mut state = self.crew.shared.lock();
            self.check(&mut state)?;
            if state.clock.pace() != self.pace || state.clock.until() <= self.cycle.next_tti() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Waits until the barrier is complete, asking again from time to time.
    async fn answered(&mut self) -> Result<(), BsError> {
        let (mut repeat_at, mut stop_at) = (None, None);
        // How long hosts were silent while this process looked: one that was stopped for a while has heard nothing.
        let (mut looked, mut silent) = (None, Duration::ZERO);
        let mut is_named = false;
        loop {
            let (returned, is_whole) = {
                let mut state = self.crew.shared.lock();
                if state.barrier.is_complete() {
                    return Ok(());
                }
                self.check(&mut state)?;
                (std::mem::take(&mut state.returned), state.losses.is_empty())
            };
            let now = now();
            silent += (now - *looked.get_or_insert(now)).min(LOOK + LOOK);
            looked = Some(now);
            if returned || !is_whole {
                (silent, is_named) = (Duration::ZERO, false);
            }
            if returned || now >= *repeat_at.get_or_insert(now + REPEAT) {
                repeat_at = Some(now + REPEAT);
                self.say_again()?;
            }
            if silent >= SILENT && !is_named {
                is_named = true;
                self.name_silent();
            }
            if silent >= MUTE {
                self.give_up_silent();
            }
            if self.crew.progress.stop.load(Ordering::Relaxed) && now >= *stop_at.get_or_insert(now + STOP) {
                let (tti, hosts) = (self.cycle.next_tti(), self.crew.shared.lock().barrier.waiting());
                return Err(BsError::NoAnswer { tti, hosts });
            }
            let _looked = tokio::time::timeout(LOOK, self.crew.shared.rung()).await;
        }
    }

    /// Asks everything of the last grant once more of those who carry the devices now.
    fn say_again(&mut self) -> Result<(), BusError> {
        let mut state = self.crew.shared.lock();
        let roster = state.barrier.roster();
        self.voice.redirect(|device| roster.carrier(device));
        state.name_carriers(self.crew.progress);
        drop(state);
        self.voice.say_again()
    }

    /// Says whom the run waits for.
    fn name_silent(&self) {
        let state = self.crew.shared.lock();
        for host in state.barrier.waiting() {
            let (tti, name) = (self.cycle.next_tti(), state.admission.name(host));
            tracing::warn!(%host, %tti, "waiting for the answer of {name} for {} s now", SILENT.as_secs());
        }
    }

    /// Hosts that have not answered for long do not carry their devices any more.
    fn give_up_silent(&self) {
        let mut state = self.crew.shared.lock();
        for host in state.barrier.waiting() {
            let name = state.admission.name(host);
            tracing::warn!(%host, "{name} has not answered for {} s: it counts as lost", MUTE.as_secs());
            state.lose(host);
        }
    }

    /// Whether the run can go on, with those who are lost and without; what is needed for that is begun.
    fn check(&self, state: &mut BsState) -> Result<(), BsError> {
        if let Some(why) = state.failure.take() {
            return Err(BsError::CannotGoOn(why));
        }
        let lost: Vec<_> = state.losses.places().collect();
        let Some(places) = lost.first() else { return Ok(()) };
        let (tti, host, first, last) = (self.cycle.next_tti(), places.host, places.first.0, places.last().0);
        match self.crew.settings.on_loss {
            OnLoss::End => return Err(BsError::HostLost { host, first, last, tti }),
            OnLoss::Wait if self.crew.progress.stop.load(Ordering::Relaxed) => {
                return Err(BsError::InterruptedWaiting { host, first, last, tti });
            }
            OnLoss::Wait => {}
        }
        for places in lost {
            if state.reported.insert(places.host) {
                let (host, first, last) = (places.host, places.first.0, places.last().0);
                let name = state.admission.name(host);
                let held = "the clock is held until its devices are carried again";
                tracing::warn!(%host, first, last, %tti, "lost {name}; {held}");
            }
        }
        for host in state.late() {
            state.lose(host);
        }
        self.restore(state);
        Ok(())
    }

    /// Has a replay find the devices of lost hosts, where none was asked for them yet.
    fn restore(&self, state: &mut BsState) {
        let Some(replay) = &self.crew.replay else { return };
        let Point { next, plan } = self.point;
        for places in state.losses.unasked(next) {
            let (replay, shared) = (Arc::clone(replay), Arc::clone(self.crew.shared));
            tokio::task::spawn_blocking(move || {
                let found = replay.devices(next, places.first, places.count);
                let mut state = shared.lock();
                match found {
                    Ok(devices) => state.losses.found(places.host, Resumption { next, plan, devices }),
                    Err(why) => state.failure = Some(why),
                }
                drop(state);
                shared.ring();
            });
        }
    }

    /// Ends the devices' work before the next TTI and gathers their ledgers.
    async fn collect_ledgers(&mut self) -> Result<Vec<Ledger>, BsError> {
        self.crew.shared.lock().barrier.expect_ledgers();
        self.voice.clock(Clock::Finish(self.cycle.next_tti()))?;
        self.answered().await?;
        Ok(self.crew.shared.lock().barrier.take_ledgers())
    }
}
