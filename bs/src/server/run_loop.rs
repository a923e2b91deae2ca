//! The run loop on the bus: it carries out the actions of its [`Session`], from the first TTI to the last ledger.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ClockMessage, GrantMessage, Pace, PlanUpdate, WakeOutcome};
use reveille_common::totals::Ledger;

use super::admission::Assignment;
use super::barrier::GrantOptions;
use super::clock::Lateness;
use super::config::{RunProgress, ServerConfig, ServerOutcome};
use super::downlink::Downlink;
use super::error::BsError;
use super::failover::ReplaySource;
use super::policy_port::Port;
use super::removed_hosts::RemovedHosts;
use super::state::{SharedState, now};
use crate::cycle::WakeOrder;
use crate::observer::Observer;
use crate::policy::external::RecordedDecision;
use crate::session::{Action, Event, Gathered, Session};

/// Interval between checks of other conditions during a wait.
const LOOK: Duration = Duration::from_millis(100);
/// Time for hosts to answer after the run was asked to stop.
const STOP: Duration = Duration::from_secs(3);
/// Time to wait for an answer before the BS resends its messages.
const REPEAT: Duration = Duration::from_secs(1);
/// Time without an answer after which a host counts as unresponsive.
pub(super) const SILENT: Duration = Duration::from_secs(5);
/// Time without an answer after which a host counts as lost, even if its token exists.
pub(super) const MUTE: Duration = Duration::from_secs(30);

/// Shared context of the run loop.
pub(super) struct LoopContext<'a> {
    pub(super) bus: &'a Bus,
    pub(super) settings: &'a ServerConfig,
    pub(super) progress: &'a RunProgress,
    pub(super) shared: &'a Arc<SharedState>,
    pub(super) replay: Option<Arc<dyn ReplaySource>>,
    pub(super) port: Port<'a>,
}

/// The loop over TTIs.
pub(super) struct RunLoop<'a> {
    voice: Downlink<'a>,
    pub(super) crew: LoopContext<'a>,
    pub(super) session: Session,
    outages: RemovedHosts,
    grants: u64,
    lateness: Lateness,
    pace: Pace,
    /// The last TTI whose due time [`RunLoop::keep_pace`] has reached.
    paced: Option<Tti>,
    /// The moment at which a TTI was or will be due, under a real-time pace.
    due: Option<(Tti, Instant)>,
}

pub(super) async fn run(
    crew: LoopContext<'_>,
    session: Session,
    observer: &mut impl Observer,
    joining: Duration,
) -> Result<ServerOutcome, BsError> {
    let mut this = RunLoop {
        voice: Downlink::new(crew.bus)?,
        pace: crew.settings.pace,
        outages: RemovedHosts::new(crew.replay.clone()),
        crew,
        session,
        grants: 0,
        lateness: Lateness::default(),
        paced: None,
        due: None,
    };
    this.show();
    this.crew.progress.has_begun.store(true, Ordering::Relaxed);
    this.crew.shared.lock().publish_owners(this.crew.progress);
    let started = now();
    let played = this.play(observer).await;
    this.show();
    let unused_decisions = this.session.queue().decisions();
    let outcome = match played {
        Ok(ledgers) => this.session.finish(&ledgers, observer),
        Err(error) if error.is_interruption() => match &this.crew.replay {
            // Some devices have no host to answer for them; a replay knows their ledgers.
            Some(replay) => {
                let point = this.session.resume_point();
                replay.outcome(point.next).map_err(BsError::CannotContinue)?
            }
            None => return Err(error),
        },
        Err(error) => return Err(error),
    };
    let running = started.elapsed();
    let mut state = this.crew.shared.lock();
    Ok(ServerOutcome {
        outcome,
        joining,
        running,
        hosts: state.barrier.roster().hosts(),
        grants: this.grants,
        lateness: this.lateness,
        malformed: this.crew.bus.malformed(),
        unexpected_messages: state.barrier.unexpected_messages(),
        losses: state.losses.recovery_times().to_vec(),
        decisions: this.crew.port.counts(),
        unused_decisions,
    })
}

impl RunLoop<'_> {
    /// Plays all TTIs, and returns the ledgers of all devices after them.
    async fn play(&mut self, observer: &mut impl Observer) -> Result<Vec<Ledger>, BsError> {
        // Pause and stop act between TTIs: an open TTI is completed first, unless a host or a policy process does not
        // answer.
        while self.session.is_open() || self.may_begin().await? {
            match self.session.next_action(self.limit(), observer) {
                // One barrier fewer: the sums come with the answers to the next grant.
                Action::CollectTotals(_) => self.session.handle(Event::TotalsFollow, observer),
                Action::RequestDecision(_) => self.decide(observer).await?,
                Action::Grant(updates) => self.grant(updates)?,
                Action::Remove(outage) => {
                    return Err(BsError::CannotContinue(format!(
                        "the input log removes device {} in TTI {}, which a run on the bus cannot repeat",
                        outage.first, outage.tti
                    )));
                }
                Action::Gather => self.gather(observer).await?,
                Action::Wake(order) => {
                    let outcome = self.wake(&order, observer).await?;
                    self.session.handle(Event::Woken(outcome), observer);
                }
                Action::TtiClosed => {}
                Action::Finish(_) => break,
            }
        }
        self.collect_ledgers().await
    }

    /// Waits until the next TTI may begin: the clock runs, every device has a host, and the TTI is due. Returns false
    /// if the run is to stop.
    async fn may_begin(&mut self) -> Result<bool, BsError> {
        let next = self.session.next_tti();
        self.show();
        loop {
            if !self.may_go_on().await? {
                return Ok(false);
            }
            if self.paced != Some(next) {
                self.keep_pace(next).await?;
            }
            let state = self.crew.shared.lock();
            // The clock may have been paused, or a host lost, during the wait. A host that takes over repeats the last
            // grant, so no newer one may go out.
            if state.clock.until() > next && state.losses.is_empty() {
                self.paced = Some(next);
                drop(state);
                self.crew.bus.set_tti(next);
                return Ok(true);
            }
        }
    }

    /// Waits while the clock is paused, or held for a lost host. Returns false if the run is to stop.
    async fn may_go_on(&mut self) -> Result<bool, BsError> {
        let next = self.session.next_tti();
        loop {
            let (paused, pace, is_whole) = {
                let mut state = self.crew.shared.lock();
                self.check_hosts(&mut state)?;
                (state.close_until(next), state.clock.pace(), state.losses.is_empty())
            };
            if self.crew.progress.stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            // The new pace counts from now; due times of the old one would make it late from the start.
            if pace != self.pace {
                (self.pace, self.due) = (pace, None);
            }
            self.crew.progress.paused.store(paused, Ordering::Relaxed);
            let is_returned = std::mem::take(&mut self.crew.shared.lock().needs_retransmit);
            if is_returned {
                self.retransmit()?;
            }
            if !paused && is_whole {
                return Ok(true);
            }
            // Paused time does not count as lateness.
            if paused {
                self.due = None;
            }
            let _changed = tokio::time::timeout(LOOK, self.crew.shared.wait()).await;
        }
    }

    /// Obtains a decision from the policy process, stores it and passes it to the session. Between TTIs, returns
    /// without a decision if the run is to stop.
    async fn decide(&mut self, observer: &mut impl Observer) -> Result<(), BsError> {
        let question = self
            .session
            .pending_decision()
            .expect("the session requests a decision");
        let tti = question.seen.now;
        if let Some(kept) = self.session.queue().next_decision() {
            return Err(BsError::CannotContinue(format!(
                "inputs.log has a decision for TTI {kept}, but TTI {tti} needs one; use the inputs.log of this run"
            )));
        }
        let LoopContext {
            port, progress, replay, ..
        } = &mut self.crew;
        let pending = port.lookup(&question, self.session.decisions())?;
        // Boxed: the future is large, and few runs need it.
        let Some(answer) = Box::pin(port.resolve(pending, progress)).await? else {
            // Between TTIs the loop sees the stop flag itself and ends the run in order; an open TTI lacks its
            // decision.
            return if self.session.is_open() {
                Err(BsError::InterruptedAwaitingDecision(tti))
            } else {
                Ok(())
            };
        };
        // Stored first: a decision that took effect and was not stored would make the run impossible to replay.
        if let Some(replay) = replay {
            let answer = answer.clone();
            replay
                .decided(RecordedDecision { tti, answer })
                .map_err(BsError::CannotContinue)?;
        }
        self.session.handle(Event::Decided(answer), observer);
        Ok(())
    }

    /// Sends a grant with its plans.
    fn grant(&mut self, updates: Vec<PlanUpdate>) -> Result<(), BsError> {
        self.voice.clear();
        for update in updates {
            tracing::debug!(from = %update.from, "the plan is sent");
            self.voice.send_plan(update)?;
        }
        let GrantMessage {
            first,
            last,
            stimulus,
            account,
            views,
            ..
        } = *self.session.tick();
        // Before the grant is sent, since a host may answer while this task is still in `put`.
        {
            let mut state = self.crew.shared.lock();
            state.next = last + 1;
            let asked = GrantOptions { account, views };
            state.barrier.expect_grant(last, stimulus.is_some(), asked);
        }
        self.crew.bus.set_tti(last);
        self.voice.send_clock(ClockMessage::Grant(*self.session.tick()))?;
        self.grants += 1;
        tracing::trace!(%first, %last, ?stimulus, "granted");
        Ok(())
    }

    /// Waits for the answers to a grant.
    async fn gather(&mut self, observer: &mut impl Observer) -> Result<(), BsError> {
        self.wait_for_answers().await?;
        let GrantMessage {
            first, last, account, ..
        } = *self.session.tick();
        // Lost devices are removed before the answers count, since the removal precedes sensing in this TTI.
        self.remove_lost(last, observer)?;
        let mut gathered = self.crew.shared.lock().barrier.take_grant_result();
        // The sums of removed hosts come from a replay. A host that is lost after this point has already answered with
        // its own.
        if account {
            let totals = gathered.totals + self.outages.sums(first)?;
            self.session.handle(Event::Totals(totals), observer);
        }
        let event = Event::Gathered(Gathered {
            reports: &mut gathered.reports,
            failures: &mut gathered.failures,
            views: &gathered.views,
        });
        self.session.handle(event, observer);
        Ok(())
    }

    /// Sends a wake-up and waits for its outcome.
    async fn wake(&mut self, order: &WakeOrder, observer: &mut impl Observer) -> Result<WakeOutcome, BsError> {
        let WakeOrder { tti, device, .. } = *order;
        // Before the wake-up is sent, for the same reason as with a grant.
        let host = {
            let mut state = self.crew.shared.lock();
            state.barrier.expect_wake(tti, device);
            state.barrier.roster().owner_of(device)
        };
        if let Some(host) = host {
            self.voice.send_wake_up(host, device, order.message)?;
        }
        self.wait_for_answers().await?;
        self.remove_lost(tti, observer)?;
        let outcome = self.crew.shared.lock().barrier.take_outcome();
        tracing::debug!(%tti, %device, ?outcome, "woken");
        Ok(outcome)
    }

    /// Removes the devices of hosts that were lost for good in the open TTI.
    fn remove_lost(&mut self, tti: Tti, observer: &mut impl Observer) -> Result<(), BsError> {
        let leaving = std::mem::take(&mut self.crew.shared.lock().removals);
        for places in leaving {
            self.outages.add(places, tti);
            let devices = (places.first.0..=places.last().0).map(DeviceId);
            let outages = &self.outages;
            self.session
                .remove_devices(devices, observer, |outage| outages.begin(outage))?;
        }
        Ok(())
    }

    /// The TTI before which the next grant must end.
    fn limit(&self) -> Tti {
        // Under a real-time pace each TTI has its own moment, so a grant must not run ahead of it.
        if !self.crew.settings.lookahead || self.pace != Pace::Max {
            return self.session.next_tti() + 1;
        }
        self.crew.shared.lock().clock.until()
    }

    fn show(&self) {
        let events = self.session.cycle().event_totals();
        self.crew
            .progress
            .tti
            .store(self.session.next_tti().0, Ordering::Relaxed);
        self.crew.progress.events.store(events.events, Ordering::Relaxed);
        self.crew
            .progress
            .misdetected
            .store(events.misdetected, Ordering::Relaxed);
        let hosts = {
            let mut state = self.crew.shared.lock();
            let carrying = state.barrier.roster().active_hosts();
            carrying.saturating_sub(state.losses.assignments().count())
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
        // The next TTI counts from when this one was due, not from when it began, so delays do not add up.
        self.due = Some((first, due));
        self.sleep_until(due).await
    }

    /// Sleeps until `due`, or until a loss, a new pace, a stop or a pause.
    async fn sleep_until(&mut self, due: Instant) -> Result<(), BsError> {
        while now() < due && !self.crew.progress.stop.load(Ordering::Relaxed) {
            tokio::time::sleep_until(due.min(now() + LOOK).into()).await;
            let mut state = self.crew.shared.lock();
            self.check_hosts(&mut state)?;
            // The caller checks the clock and the losses again.
            if state.clock.pace() != self.pace || state.clock.until() <= self.session.next_tti() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Waits until the barrier is complete, and resends the messages of the grant at intervals.
    async fn wait_for_answers(&mut self) -> Result<(), BsError> {
        let (mut repeat_at, mut stop_at) = (None, None);
        // Time without an answer, counted only while this process ran: a stopped process receives nothing.
        let (mut looked, mut silent) = (None, Duration::ZERO);
        let mut is_named = false;
        loop {
            let (returned, is_whole) = {
                let mut state = self.crew.shared.lock();
                if state.barrier.is_complete() {
                    return Ok(());
                }
                self.check_hosts(&mut state)?;
                (std::mem::take(&mut state.needs_retransmit), state.losses.is_empty())
            };
            let now = now();
            // One check adds at most two intervals: a longer gap means that this process itself was stopped.
            silent += (now - *looked.get_or_insert(now)).min(LOOK + LOOK);
            looked = Some(now);
            // A lost host is not expected to answer, and a returned host needs time to do so.
            if returned || !is_whole {
                (silent, is_named) = (Duration::ZERO, false);
            }
            // A returned host may have missed the grant, so it does not wait for the next repetition.
            if returned || now >= *repeat_at.get_or_insert(now + REPEAT) {
                repeat_at = Some(now + REPEAT);
                self.retransmit()?;
            }
            if silent >= SILENT && !is_named {
                is_named = true;
                self.report_silent_hosts();
            }
            if silent >= MUTE {
                self.time_out_silent_hosts();
            }
            if self.crew.progress.stop.load(Ordering::Relaxed) && now >= *stop_at.get_or_insert(now + STOP) {
                let (tti, hosts) = (self.session.next_tti(), self.crew.shared.lock().barrier.missing_hosts());
                return Err(BsError::NoAnswer { tti, hosts });
            }
            let _looked = tokio::time::timeout(LOOK, self.crew.shared.wait()).await;
        }
    }

    /// Resends the messages of the last grant to the current owners of the devices.
    fn retransmit(&mut self) -> Result<(), BusError> {
        // Nothing is sent under the lock: a put waits while a link is congested, and callbacks of messages need the
        // lock.
        let mut state = self.crew.shared.lock();
        let roster = state.barrier.roster();
        self.voice.redirect(|device| roster.owner_of(device));
        state.publish_owners(self.crew.progress);
        drop(state);
        self.voice.retransmit()
    }

    /// Ends the run on all hosts before the next TTI, and collects the ledgers of the devices.
    async fn collect_ledgers(&mut self) -> Result<Vec<Ledger>, BsError> {
        // Before the message is sent, for the same reason as with a grant.
        self.crew.shared.lock().barrier.expect_ledgers();
        self.voice
            .send_clock(ClockMessage::CollectLedgers(self.session.next_tti()))?;
        self.wait_for_answers().await?;
        let end = self.session.next_tti();
        let (mut ledgers, leaving, devices) = {
            let mut state = self.crew.shared.lock();
            let devices = state.barrier.roster().devices() as u32;
            let leaving = std::mem::take(&mut state.removals);
            (state.barrier.take_ledgers(), leaving, devices)
        };
        ledgers.extend(self.outages.all_ledgers(end)?);
        for Assignment { first, count, .. } in leaving {
            // A host lost in this barrier has completed all TTIs, so its devices are not removed: a replay has their
            // ledgers.
            let own = self.outages.ledgers(end, first, count)?;
            ledgers.extend((first.0..).map(DeviceId).zip(own));
        }
        ledgers.sort_unstable_by_key(|(device, _)| *device);
        let each = (0..devices).map(DeviceId);
        assert!(
            ledgers.iter().map(|(device, _)| *device).eq(each),
            "a ledger for each device"
        );
        Ok(ledgers.into_iter().map(|(_, ledger)| ledger).collect())
    }
}
