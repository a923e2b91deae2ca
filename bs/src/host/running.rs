//! From the first TTI to the last ledger.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Clock, Outage, Pace, Tick};
use reveille_common::score::Accounts;
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, EventTotals, Ledger};

use super::admission::Places;
use super::drive::{Progress, Served, Settings};
use super::error::BsError;
use super::losses::{Point, Replay};
use super::outages::Outages;
use super::port::{Port, Posed};
use super::shared::Shared;
use super::voice::Voice;
use super::wall::now;
use crate::boundaries::Boundaries;
use crate::cycle::{Cycle, Step};
use crate::host::barrier::{Asked, UNKNOWN};
use crate::host::clock::Lateness;
use crate::observe::{Happening, Observer};
use crate::policy::external::{Answer, Answered};
use crate::prepared::Prepared;
use crate::taken::Taken;

/// How often a wait looks at what else may have happened.
const LOOK: Duration = Duration::from_millis(100);
/// How long hosts may take to answer once the run is to stop.
const STOP: Duration = Duration::from_secs(3);
/// How long the BS waits for an answer before it asks once more.
const REPEAT: Duration = Duration::from_secs(1);
/// How long hosts may be silent before they are named.
pub(super) const SILENT: Duration = Duration::from_secs(5);
/// How long hosts may be silent before they count as lost, though their tokens are there.
pub(super) const MUTE: Duration = Duration::from_secs(30);

/// What drives a run beside its settings.
pub(super) struct Crew<'a> {
    pub(super) bus: &'a Bus,
    pub(super) settings: &'a Settings,
    pub(super) progress: &'a Progress,
    pub(super) shared: &'a Arc<Shared>,
    pub(super) replay: Option<Arc<dyn Replay>>,
    pub(super) port: Port<'a>,
}

/// The loop over TTIs.
pub(super) struct Loop<'a> {
    voice: Voice<'a>,
    pub(super) crew: Crew<'a>,
    pub(super) cycle: Cycle,
    devices: u32,
    boundaries: Boundaries,
    accounts: Accounts,
    outages: Outages,
    /// The TTI from which the plan in force holds.
    plan_from: Option<Tti>,
    /// Where a newcomer takes up devices.
    pub(super) point: Point,
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
        outages: Outages::new(crew.replay.clone()),
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
    this.crew.progress.has_begun.store(true, Ordering::Relaxed);
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
        decisions: this.crew.port.counts(),
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
            let batteries = self.views.iter().map(|view| view.battery);
            self.cycle.tell_batteries(batteries, observer);
        }
        if let Some(question) = self.cycle.question() {
            let posed = self.crew.port.pose(&question)?;
            match self.decided(first, posed).await? {
                Some(Answer::Plan(decision)) => self.cycle.decide(decision),
                // It was told to stop while it waited.
                Some(Answer::Wake(_)) | None => return Ok(true),
            }
        }
        let account = self.boundaries.is_boundary(first);
        let events = *self.cycle.event_totals();
        let horizon = self.horizon(first);
        let wants_states = observer.wants_states();
        let mut granted = self.cycle.grant(horizon, observer);
        let grant = granted.grant;
        self.point = Point {
            next: first,
            plan: self.plan_from,
        };
        self.voice.begin();
        let updates = std::mem::take(&mut granted.updates);
        let plans = updates.len() as u32;
        for update in updates {
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
            until: grant.until,
            account,
            views: asked.views,
            plan: self.plan_from.unwrap_or_default(),
            plans,
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
        self.let_go(grant.last, None, observer)?;
        let mut gathered = self.crew.shared.lock().barrier.take_gathered();
        // A host that is lost from here on is among those that have answered.
        let sums = if account {
            Some(gathered.totals + self.outages.sums(first)?)
        } else {
            None
        };
        self.views = std::mem::take(&mut gathered.views);
        let step = self
            .cycle
            .gathered(granted, &mut gathered.reports, &mut gathered.failures, observer);
        self.wake(grant.last, step, observer).await?;
        if wants_states {
            observer.see(&Happening::States(&self.views));
        }
        self.show();
        Ok(sums.is_none_or(|sums| self.account(first, sums, events, observer)))
    }

    /// The wake-ups of TTI `tti`, one after the other.
    async fn wake(&mut self, tti: Tti, mut step: Step, observer: &mut impl Observer) -> Result<(), BsError> {
        let mut wake_ups = 0;
        loop {
            let waking = match step {
                Step::WakeUp(waking) => waking,
                Step::Asks(asking) => {
                    let posed = self.crew.port.pose(&self.cycle.question_of(&asking))?;
                    let Some(Answer::Wake(devices)) = self.decided(tti, posed).await? else {
                        return Err(BsError::InterruptedDeciding(tti));
                    };
                    step = self.cycle.wake(asking, &devices, observer);
                    continue;
                }
                Step::Closed => return Ok(()),
            };
            let device = waking.device();
            let host = {
                let mut state = self.crew.shared.lock();
                state.barrier.expect_wake(tti, device);
                state.barrier.roster().carrier(device)
            };
            if let Some(host) = host {
                self.voice.wake_up(host, device, waking.message())?;
            }
            self.answered().await?;
            self.let_go(tti, Some(wake_ups), observer)?;
            wake_ups += 1;
            let outcome = self.crew.shared.lock().barrier.take_outcome();
            tracing::debug!(%tti, %device, ?outcome, "woken");
            if let Some(view) = self.views.get_mut(device.index()) {
                *view = outcome.on(*view);
            }
            step = self.cycle.woken(waking, &outcome, observer);
        }
    }

    /// What somebody outside decides for TTI `tti`; when this returns, it is kept. Nothing if the run is to stop.
    async fn decided(&mut self, tti: Tti, posed: Posed) -> Result<Option<Answer>, BsError> {
        let pending = match posed {
            Posed::Kept(answer) => return Ok(Some(answer)),
            Posed::Open(pending) => pending,
        };
        let Crew { port, progress, .. } = &mut self.crew;
        // Boxed, since few runs have need of so large a future.
        let answer = Box::pin(port.settle(*pending, progress)).await?;
        if let (Some(answer), Some(replay)) = (&answer, &self.crew.replay) {
            let answer = answer.clone();
            replay.decided(Answered { tti, answer }).map_err(BsError::CannotGoOn)?;
        }
        Ok(answer)
    }

    /// Devices that the run goes on without are gone from here on, those that are not gone already.
    fn let_go(&mut self, tti: Tti, wake_ups: Option<u32>, observer: &mut impl Observer) -> Result<(), BsError> {
        let leaving = std::mem::take(&mut self.crew.shared.lock().leaving);
        for places in leaving {
            self.outages.lose(places, tti);
            let devices = (places.first.0..=places.last().0).map(DeviceId);
            for outage in Outage::of(devices.filter(|&device| !self.cycle.is_gone(device)), tti, wake_ups) {
                self.outages.begin(&outage)?;
                self.cycle.gone(&outage, observer);
            }
            if let Some(views) = self.views.get_mut(places.first.index()..=places.last().index()) {
                views.fill(UNKNOWN);
            }
        }
        Ok(())
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
            let carrying = state.barrier.roster().carrying();
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

    /// Ends the devices' work before the next TTI and gathers their ledgers.
    async fn collect_ledgers(&mut self) -> Result<Vec<Ledger>, BsError> {
        self.crew.shared.lock().barrier.expect_ledgers();
        self.voice.clock(Clock::Finish(self.cycle.next_tti()))?;
        self.answered().await?;
        let end = self.cycle.next_tti();
        let (mut ledgers, leaving) = {
            let mut state = self.crew.shared.lock();
            (state.barrier.take_ledgers(), std::mem::take(&mut state.leaving))
        };
        ledgers.extend(self.outages.all_ledgers(end)?);
        for Places { first, count, .. } in leaving {
            // It has done all TTIs, and not said so.
            let own = self.outages.ledgers(end, first, count)?;
            ledgers.extend((first.0..).map(DeviceId).zip(own));
        }
        ledgers.sort_unstable_by_key(|(device, _)| *device);
        let each = (0..self.devices).map(DeviceId);
        assert!(
            ledgers.iter().map(|(device, _)| *device).eq(each),
            "a ledger for each device"
        );
        Ok(ledgers.into_iter().map(|(_, ledger)| ledger).collect())
    }
}
