//! From the first TTI to the last ledger.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError, Topic};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Clock, Pace, PlanUpdate, Tick, WakeUp};
use reveille_common::score::Accounts;
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, EventTotals, Ledger};

use super::drive::{OnLoss, Progress, Served, Settings};
use super::error::BsError;
use super::shared::{BsState, Shared};
use crate::boundaries::Boundaries;
use crate::cycle::{Cycle, Step};
use crate::host::barrier::Asked;
use crate::host::clock::Lateness;
use crate::observe::{Happening, Observer};
use crate::prepared::Prepared;

/// How often a wait looks at what else may have happened.
const LOOK: Duration = Duration::from_millis(100);
/// How long hosts may take to answer once the run is to stop.
const STOP: Duration = Duration::from_secs(3);
/// How long the BS waits for an answer before it asks once more.
const REPEAT: Duration = Duration::from_secs(1);

/// The BS's voice on the bus.
struct Voice<'a> {
    bus: &'a Bus,
    clock: Topic<Clock>,
    plan: Topic<PlanUpdate>,
    wake: BTreeMap<DeviceId, Topic<WakeUp>>,
}

impl Voice<'_> {
    fn wake_up(&mut self, device: DeviceId, tti: Tti) -> Result<(), BusError> {
        if !self.wake.contains_key(&device) {
            self.wake.insert(device, self.bus.publisher(device)?);
        }
        self.wake[&device].put(&WakeUp { tti })
    }
}

/// The loop over TTIs.
struct Loop<'a> {
    voice: Voice<'a>,
    shared: &'a Shared,
    settings: &'a Settings,
    progress: &'a Progress,
    cycle: Cycle,
    devices: u32,
    boundaries: Boundaries,
    accounts: Accounts,
    /// The TTI from which the plan in force holds.
    plan_from: Tti,
    /// The devices at the end of the last TTI, where somebody wants to know.
    views: Vec<DeviceView>,
    grants: u64,
    lateness: Lateness,
    pace: Pace,
    /// The moment at which a TTI was or will be due, under a real-time pace.
    due: Option<(Tti, Instant)>,
}

pub(super) async fn run(
    bus: &Bus,
    prepared: &Prepared,
    settings: &Settings,
    progress: &Progress,
    observer: &mut impl Observer,
    shared: &Shared,
    joining: Duration,
) -> Result<Served, BsError> {
    let boundaries = Boundaries::new(&prepared.scenario, settings.window);
    let (clock, plan) = (bus.publisher(())?, bus.publisher(())?);
    let mut this = Loop {
        voice: Voice {
            bus,
            clock,
            plan,
            wake: BTreeMap::new(),
        },
        shared,
        settings,
        progress,
        cycle: Cycle::new(prepared),
        devices: prepared.scenario.devices,
        accounts: Accounts::new(&prepared.deployment),
        boundaries,
        plan_from: Tti::ZERO,
        views: Vec::new(),
        grants: 0,
        lateness: Lateness::default(),
        pace: settings.pace,
        due: None,
    };
    this.show();
    let started = now();
    while this.cycle.next_tti() < boundaries.end() && this.may_go_on().await? {
        if !this.grant(observer).await? {
            break;
        }
    }
    let ledgers = this.collect_ledgers().await?;
    let running = started.elapsed();
    let (end, events) = (this.cycle.next_tti(), *this.cycle.event_totals());
    this.account(end, ledgers.iter().map(|ledger| ledger.whole).sum(), events, observer);
    let (hosts, strays) = {
        let mut state = shared.lock();
        (state.barrier.roster().hosts(), state.barrier.strays())
    };
    Ok(Served {
        outcome: this.cycle.finish(&ledgers),
        joining,
        running,
        hosts,
        grants: this.grants,
        lateness: this.lateness,
        malformed: bus.malformed(),
        strays,
    })
}

impl Loop<'_> {
    /// Waits while the clock is paused. False when the run is to stop.
    async fn may_go_on(&mut self) -> Result<bool, BsError> {
        let next = self.cycle.next_tti();
        loop {
            if self.progress.stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            let (paused, pace) = {
                let mut state = self.shared.lock();
                (state.stand(next), state.clock.pace())
            };
            if pace != self.pace {
                (self.pace, self.due) = (pace, None);
            }
            self.progress.paused.store(paused, Ordering::Relaxed);
            if !paused {
                return Ok(true);
            }
            self.due = None;
            let _changed = tokio::time::timeout(LOOK, self.shared.rung()).await;
            self.check(&mut self.shared.lock())?;
        }
    }

    /// One grant with its reports and wake-ups. False when the observer wants to stop.
    async fn grant(&mut self, observer: &mut impl Observer) -> Result<bool, BsError> {
        let first = self.cycle.next_tti();
        self.keep_pace(first).await?;
        if self.shared.lock().clock.until() <= first {
            // It was told to stop while it waited.
            return Ok(true);
        }
        self.voice.bus.set_tti(first);
        if self.cycle.wants_batteries() {
            self.cycle.tell_batteries(self.views.iter().map(|view| view.battery));
        }
        let account = self.boundaries.is_boundary(first);
        let events = *self.cycle.event_totals();
        let horizon = self.horizon(first);
        let wants_states = observer.wants_states();
        let granted = self.cycle.grant(horizon, observer);
        let (grant, update) = (granted.grant, granted.update.clone());
        if let Some(update) = &update {
            self.plan_from = update.from;
            tracing::debug!(from = %update.from, "the plan goes out");
            self.voice.plan.put(update)?;
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
            plan: self.plan_from,
        });
        {
            let mut state = self.shared.lock();
            state.next = grant.last + 1;
            state.barrier.expect_grant(grant.last, grant.stimulus.is_some(), asked);
        }
        self.voice.bus.set_tti(grant.last);
        self.voice.clock.put(&tick)?;
        self.grants += 1;
        tracing::trace!(first = %grant.first, last = %grant.last, stimulus = ?grant.stimulus, "granted");
        self.answered(|voice| {
            if let Some(update) = &update {
                voice.plan.put(update)?;
            }
            voice.clock.put(&tick)
        })
        .await?;
        let mut gathered = self.shared.lock().barrier.take_gathered();
        self.views = std::mem::take(&mut gathered.views);
        let mut step = self
            .cycle
            .gathered(granted, &mut gathered.reports, &mut gathered.failures, observer);
        while let Step::WakeUp(waking) = step {
            let device = waking.device();
            self.shared.lock().barrier.expect_wake(grant.last, device);
            self.voice.wake_up(device, grant.last)?;
            self.answered(|voice| voice.wake_up(device, grant.last)).await?;
            let outcome = self.shared.lock().barrier.take_outcome();
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
        let one_by_one = !self.settings.lookahead || self.pace != Pace::Max;
        let horizon = if one_by_one {
            first + 1
        } else {
            self.boundaries.next_boundary(first)
        };
        horizon.min(self.shared.lock().clock.until()).max(first + 1)
    }

    /// Takes in the sums at boundary `k`, where the counted events came to `events`. False when the observer wants to
    /// stop.
    fn account(&mut self, k: Tti, energy: DeviceTotals, events: EventTotals, observer: &mut impl Observer) -> bool {
        let window = self.accounts.reach(k, energy, events);
        let ttis = window.end - window.first;
        if ttis > 0 {
            let mean = window.energy.battery_sum / u128::from(ttis) / u128::from(self.devices.max(1));
            self.progress.mean_battery.store(mean as u64, Ordering::Relaxed);
        }
        observer.window(&window)
    }

    fn show(&self) {
        let events = self.cycle.event_totals();
        self.progress.tti.store(self.cycle.next_tti().0, Ordering::Relaxed);
        self.progress.events.store(events.events, Ordering::Relaxed);
        self.progress.misdetected.store(events.misdetected, Ordering::Relaxed);
        let hosts = {
            let mut state = self.shared.lock();
            let carrying = state.barrier.roster().hosts();
            carrying.saturating_sub(state.lost.len())
        };
        self.progress.hosts.store(hosts as u64, Ordering::Relaxed);
        self.progress.late_ttis.store(self.lateness.late, Ordering::Relaxed);
        let latest = self.lateness.max.as_nanos() as u64;
        self.progress.max_late.store(latest, Ordering::Relaxed);
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
        while now() < due && !self.progress.stop.load(Ordering::Relaxed) {
            tokio::time::sleep_until(due.min(now() + LOOK).into()).await;
            let mut state = self.shared.lock();
            self.check(&mut state)?;
            if state.clock.pace() != self.pace || state.clock.until() <= self.cycle.next_tti() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Waits until the barrier is complete, asking again from time to time.
    async fn answered(&mut self, mut ask: impl FnMut(&mut Voice<'_>) -> Result<(), BusError>) -> Result<(), BsError> {
        let mut repeat_at = None;
        let mut stop_at = None;
        loop {
            let returned = {
                let mut state = self.shared.lock();
                if state.barrier.is_complete() {
                    return Ok(());
                }
                self.check(&mut state)?;
                std::mem::take(&mut state.returned)
            };
            let now = now();
            if returned || now >= *repeat_at.get_or_insert(now + REPEAT) {
                repeat_at = Some(now + REPEAT);
                ask(&mut self.voice)?;
            }
            if self.progress.stop.load(Ordering::Relaxed) && now >= *stop_at.get_or_insert(now + STOP) {
                let (tti, hosts) = (self.cycle.next_tti(), self.shared.lock().barrier.waiting());
                return Err(BsError::NoAnswer { tti, hosts });
            }
            let _looked = tokio::time::timeout(LOOK, self.shared.rung()).await;
        }
    }

    /// Whether the run can go on without those who are lost.
    fn check(&self, state: &mut BsState) -> Result<(), BsError> {
        let Some(&host) = state.lost.first() else { return Ok(()) };
        let tti = self.cycle.next_tti();
        let Some(places) = state.admission.places(host) else {
            return Ok(());
        };
        let (first, last) = (places.first.0, places.last().0);
        match self.settings.on_loss {
            OnLoss::End => Err(BsError::HostLost { host, first, last, tti }),
            OnLoss::Wait if self.progress.stop.load(Ordering::Relaxed) => {
                Err(BsError::InterruptedWaiting { host, first, last, tti })
            }
            OnLoss::Wait => {
                if state.reported.insert(host) {
                    tracing::warn!(%host, first, last, %tti, "lost a host; the clock is held until it is back");
                }
                Ok(())
            }
        }
    }

    /// Ends the devices' work before the next TTI and gathers their ledgers.
    async fn collect_ledgers(&mut self) -> Result<Vec<Ledger>, BsError> {
        self.shared.lock().barrier.expect_ledgers();
        let finish = Clock::Finish(self.cycle.next_tti());
        self.voice.clock.put(&finish)?;
        self.answered(|voice| voice.clock.put(&finish)).await?;
        Ok(self.shared.lock().barrier.take_ledgers())
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "the shell keeps the pace and reports how long things took"
)]
fn now() -> Instant {
    Instant::now()
}
