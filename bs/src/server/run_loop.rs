//! The run loop on the bus: carries out the actions of its [`Session`], from the first TTI to the last ledger.
//!
//! `lab/src/run.rs` is the same loop in memory: both must give the session the same results, since their digests are
//! equal. The barrier expects an answer before the message that asks for it is sent. Nothing is sent under the lock of
//! [`SharedState`].

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reveille_common::bus::{Bus, BusError};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, ClockMessage, GrantMessage, Pace, PlanUpdate, WakeOutcome};
use reveille_common::totals::Ledger;

use super::admission::Assignment;
use super::barrier::GrantOptions;
use super::clock::{Lateness, PaceWatch, Schedule};
use super::config::{RunProgress, ServerConfig, ServerOutcome};
use super::downlink::Downlink;
use super::error::BsError;
use super::failover::ReplaySource;
use super::policy_port::PolicyPort;
use super::removed_hosts::RemovedHosts;
use super::state::{ServerState, SharedState, now};
use crate::cycle::WakeOrder;
use crate::observer::Observer;
use crate::policy::external::RecordedDecision;
use crate::session::{Action, ActionResult, GrantAnswers, Session};

/// Interval between checks of the clock, the hosts and the stop flag during a wait.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Time for hosts to answer after the run was asked to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(3);
/// Time to wait for an answer before the BS retransmits its messages.
const RETRANSMIT_INTERVAL: Duration = Duration::from_secs(1);
/// Time without an answer after which a host counts as unresponsive. docs/command-line.md states it.
pub(super) const UNRESPONSIVE_AFTER: Duration = Duration::from_secs(5);
/// Time without an answer after which a host counts as lost, even if its liveliness token exists.
/// docs/command-line.md states it.
pub(super) const LOST_AFTER: Duration = Duration::from_secs(30);

/// The parts of a run that the run loop uses and `serve` prepares.
pub(super) struct LoopContext<'a> {
    pub(super) bus: &'a Bus,
    pub(super) settings: &'a ServerConfig,
    pub(super) progress: &'a RunProgress,
    pub(super) shared: &'a Arc<SharedState>,
    pub(super) replay: Option<Arc<dyn ReplaySource>>,
    pub(super) port: PolicyPort<'a>,
}

/// State of the run loop; `failure_detection` has more of its methods.
pub(super) struct RunLoop<'a> {
    downlink: Downlink<'a>,
    pub(super) context: LoopContext<'a>,
    pub(super) session: Session,
    removed_hosts: RemovedHosts,
    grant_count: u64,
    lateness: Lateness,
    /// The pace to which `schedule` belongs; the clock may have a new one.
    pace: Pace,
    pace_watch: PaceWatch,
    /// The last TTI whose due time [`RunLoop::wait_until_due`] has reached.
    last_paced: Option<Tti>,
    schedule: Schedule,
}

/// Runs `session` to its end, or until it is interrupted. All devices must have hosts.
pub(super) async fn run(
    context: LoopContext<'_>,
    session: Session,
    observer: &mut impl Observer,
    joining_time: Duration,
) -> Result<ServerOutcome, BsError> {
    let mut run_loop = RunLoop {
        downlink: Downlink::new(context.bus)?,
        pace: context.settings.pace,
        removed_hosts: RemovedHosts::new(context.replay.clone()),
        context,
        session,
        grant_count: 0,
        lateness: Lateness::default(),
        pace_watch: PaceWatch::default(),
        last_paced: None,
        schedule: Schedule::default(),
    };
    run_loop.publish_progress();
    run_loop.context.progress.has_begun.store(true, Ordering::Relaxed);
    run_loop.context.shared.lock().copy_owners_to(run_loop.context.progress);
    let first_tti = run_loop.session.next_tti();
    let started = now();
    let ledgers = run_loop.run_ttis(observer).await;
    run_loop.publish_progress();
    let unused_decisions = run_loop.session.input_queue().decision_count();
    let outcome = match ledgers {
        Ok(ledgers) => run_loop.session.finish(&ledgers, observer),
        Err(error) if error.is_interruption() => match &run_loop.context.replay {
            // Some devices have no host to answer for them; a replay knows their ledgers.
            Some(replay) => {
                let point = run_loop.session.resume_point();
                replay.outcome(point.next).map_err(BsError::CannotContinue)?
            }
            None => return Err(error),
        },
        Err(error) => return Err(error),
    };
    let running_time = started.elapsed();
    let state = run_loop.context.shared.lock();
    Ok(ServerOutcome {
        outcome,
        first_tti,
        joining_time,
        running_time,
        process_count: state.process_count,
        grant_count: run_loop.grant_count,
        lateness: run_loop.lateness,
        malformed_payloads: run_loop.context.bus.malformed_payloads(),
        unexpected_messages: state.barrier.unexpected_messages(),
        loss_durations: state.lost_hosts.loss_durations().to_vec(),
        decisions: run_loop.context.port.counts(),
        unused_decisions,
    })
}

impl RunLoop<'_> {
    /// Runs all TTIs, and returns the ledgers of all devices after them.
    async fn run_ttis(&mut self, observer: &mut impl Observer) -> Result<Vec<Ledger>, BsError> {
        // Pause and stop act between TTIs: an open TTI is completed first, unless a host or a policy process does not
        // answer.
        while self.session.is_open() || self.wait_for_next_tti().await? {
            match self.next_action(observer) {
                // One barrier fewer: the sums come with the answers to the next grant.
                Action::CollectTotals(_) => self.session.apply_result(ActionResult::TotalsFollow, observer),
                Action::RequestDecision(_) => self.request_decision(observer).await?,
                Action::Grant { changes, updates } => self.send_grant(changes, updates)?,
                Action::Remove(removal) => {
                    return Err(BsError::CannotContinue(format!(
                        "the input log removes device {} in TTI {}, which a run on the bus cannot repeat",
                        removal.first, removal.tti
                    )));
                }
                Action::Gather => self.gather_answers(observer).await?,
                Action::Wake(order) => {
                    let outcome = self.wake_device(&order, observer).await?;
                    self.session.apply_result(ActionResult::Woken(outcome), observer);
                }
                Action::TtiClosed => {}
                Action::Finish(_) => break,
            }
        }
        self.collect_ledgers().await
    }

    /// Waits until the next TTI may begin: the clock runs, every device has a host, and the TTI is due. Returns false
    /// if the run is to stop.
    async fn wait_for_next_tti(&mut self) -> Result<bool, BsError> {
        let next_tti = self.session.next_tti();
        self.publish_progress();
        loop {
            if !self.wait_for_clock_and_hosts().await? {
                return Ok(false);
            }
            if self.last_paced != Some(next_tti) {
                self.wait_until_due(next_tti).await?;
            }
            let state = self.context.shared.lock();
            // The clock may have been paused, or a host lost, during the wait. A host that takes over repeats the last
            // grant, so no newer one may go out.
            if state.clock.until() > next_tti && state.lost_hosts.is_empty() {
                self.last_paced = Some(next_tti);
                drop(state);
                self.context.bus.set_tti(next_tti);
                return Ok(true);
            }
        }
    }

    /// Waits while the clock is paused, or held for a lost host. Returns false if the run is to stop.
    async fn wait_for_clock_and_hosts(&mut self) -> Result<bool, BsError> {
        let next_tti = self.session.next_tti();
        loop {
            let (is_paused, pace, has_all_hosts) = {
                let mut state = self.context.shared.lock();
                self.handle_lost_hosts(&mut state)?;
                (
                    state.close_ttis_before(next_tti),
                    state.clock.pace(),
                    state.lost_hosts.is_empty(),
                )
            };
            if self.context.progress.is_stop_requested() {
                return Ok(false);
            }
            // The new pace counts from now; due times of the old one would make it late from the start.
            if pace != self.pace {
                (self.pace, self.schedule, self.pace_watch) = (pace, Schedule::default(), PaceWatch::default());
            }
            self.context.progress.is_paused.store(is_paused, Ordering::Relaxed);
            let needs_retransmit = std::mem::take(&mut self.context.shared.lock().needs_retransmit);
            if needs_retransmit {
                self.retransmit()?;
            }
            if !is_paused && has_all_hosts {
                return Ok(true);
            }
            // Paused time does not count as lateness.
            if is_paused {
                self.schedule = Schedule::default();
            }
            let _changed = tokio::time::timeout(CHECK_INTERVAL, self.context.shared.wait_for_change()).await;
        }
    }

    /// Obtains a decision from the policy process, stores it and passes it to the session. Between TTIs, returns
    /// without a decision if the run is to stop.
    async fn request_decision(&mut self, observer: &mut impl Observer) -> Result<(), BsError> {
        let request = self
            .session
            .pending_decision()
            .expect("the session requests a decision");
        let tti = request.observation.now;
        if let Some(queued) = self.session.input_queue().next_decision_tti() {
            return Err(BsError::CannotContinue(format!(
                "inputs.log has a decision for TTI {queued}, but TTI {tti} needs one; use the inputs.log of this run"
            )));
        }
        let LoopContext {
            port, progress, replay, ..
        } = &mut self.context;
        let pending = port.prepare_request(&request, self.session.decision_count())?;
        // Boxed: the future is large, and few runs need it.
        let Some(decision) = Box::pin(port.obtain_decision(pending, progress)).await? else {
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
            let decision = decision.clone();
            replay
                .record_decision(RecordedDecision { tti, decision })
                .map_err(BsError::CannotContinue)?;
        }
        self.session.apply_result(ActionResult::Decided(decision), observer);
        Ok(())
    }

    /// The next action of the session. Before a grant, the session receives all actions that operators have sent.
    fn next_action(&mut self, observer: &mut impl Observer) -> Action {
        if self.session.is_open() {
            return self.session.next_action(self.grant_limit(), observer);
        }
        // From here on no operator can act in a TTI that this call grants.
        let actions = {
            let mut state = self.context.shared.lock();
            // `end_granting` below must follow on every path: callbacks of actions block until then.
            state.is_granting = true;
            std::mem::take(&mut state.pending_actions)
        };
        let queue = self.session.input_queue_mut();
        for action in actions {
            queue.add_action(action);
        }
        let action = self.session.next_action(self.grant_limit(), observer);
        let next_tti = if matches!(action, Action::Grant { .. }) {
            self.session.grant_message().last + 1
        } else {
            self.session.next_tti()
        };
        self.context.shared.end_granting(next_tti);
        action
    }

    fn send_grant(&mut self, changes: Vec<Change>, updates: Vec<PlanUpdate>) -> Result<(), BsError> {
        self.downlink.drop_grant_messages();
        for update in updates {
            tracing::debug!(from = %update.from, "the plan is sent");
            self.downlink.send_plan(update)?;
        }
        let first = self.session.grant_message().first;
        if !changes.is_empty() {
            self.downlink.send_clock(ClockMessage::Act(first, changes))?;
        }
        let GrantMessage {
            last,
            stimulus,
            wants_totals,
            wants_views,
            ..
        } = *self.session.grant_message();
        // Before the grant is sent, since a host may answer while this task is still in `put`.
        {
            let mut state = self.context.shared.lock();
            let options = GrantOptions {
                wants_totals,
                wants_views,
            };
            state.barrier.expect_grant(last, stimulus.is_some(), options);
        }
        self.context.bus.set_tti(last);
        self.downlink
            .send_clock(ClockMessage::Grant(*self.session.grant_message()))?;
        self.grant_count += 1;
        tracing::trace!(%first, %last, ?stimulus, "granted");
        Ok(())
    }

    async fn gather_answers(&mut self, observer: &mut impl Observer) -> Result<(), BsError> {
        self.wait_for_answers().await?;
        let GrantMessage {
            first,
            last,
            wants_totals,
            ..
        } = *self.session.grant_message();
        // Lost devices are removed before the answers count, since the removal precedes sensing in this TTI.
        self.remove_lost(last, observer)?;
        let mut answers = self.context.shared.lock().barrier.take_grant_result();
        // The sums of removed hosts come from a replay. A host that is lost after this point has already answered with
        // its own.
        if wants_totals {
            let totals = answers.totals + self.removed_hosts.totals_before(first)?;
            self.session.apply_result(ActionResult::Totals(totals), observer);
        }
        let result = ActionResult::GrantAnswers(GrantAnswers {
            reports: &mut answers.reports,
            failures: &mut answers.failures,
            unable: answers.unable,
            views: &answers.views,
        });
        self.session.apply_result(result, observer);
        Ok(())
    }

    /// Sends a wake-up and waits for its outcome.
    async fn wake_device(&mut self, order: &WakeOrder, observer: &mut impl Observer) -> Result<WakeOutcome, BsError> {
        let WakeOrder { tti, device, .. } = *order;
        // Before the wake-up is sent, for the same reason as with a grant.
        let host = {
            let mut state = self.context.shared.lock();
            state.barrier.expect_wake(tti, device);
            state.barrier.roster_mut().owner_of(device)
        };
        if let Some(host) = host {
            self.downlink.send_wake_up(host, device, order.message)?;
        }
        self.wait_for_answers().await?;
        self.remove_lost(tti, observer)?;
        let outcome = self.context.shared.lock().barrier.take_wake_outcome();
        tracing::debug!(%tti, %device, ?outcome, "woken");
        Ok(outcome)
    }

    /// Removes the devices of hosts that were lost for good in the open TTI.
    fn remove_lost(&mut self, tti: Tti, observer: &mut impl Observer) -> Result<(), BsError> {
        let lost = {
            let mut state = self.context.shared.lock();
            let lost = std::mem::take(&mut state.pending_removals);
            if !lost.is_empty() {
                state.copy_owners_to(self.context.progress);
            }
            lost
        };
        for assignment in lost {
            self.removed_hosts.add(assignment, tti);
            let devices = (assignment.first.0..=assignment.last().0).map(DeviceId);
            let removed_hosts = &self.removed_hosts;
            self.session
                .remove_devices(devices, observer, |removal| removed_hosts.log_removal(removal))?;
        }
        Ok(())
    }

    /// The TTI before which the next grant must end.
    fn grant_limit(&self) -> Tti {
        // Under a real-time pace each TTI has its own moment, so a grant must not run ahead of it.
        if !self.context.settings.lookahead || self.pace != Pace::Max {
            return self.session.next_tti() + 1;
        }
        self.context.shared.lock().clock.until()
    }

    /// Writes the state of the run to [`RunProgress`].
    fn publish_progress(&self) {
        let event_totals = self.session.cycle().event_totals();
        self.context
            .progress
            .next_tti
            .store(self.session.next_tti().0, Ordering::Relaxed);
        self.context
            .progress
            .events
            .store(event_totals.events, Ordering::Relaxed);
        self.context
            .progress
            .misdetected
            .store(event_totals.misdetected, Ordering::Relaxed);
        self.publish_active_hosts(&mut self.context.shared.lock());
        self.context
            .progress
            .late_ttis
            .store(self.lateness.late_ttis, Ordering::Relaxed);
        let max_late_ns = self.lateness.max_delay.as_nanos() as u64;
        self.context.progress.max_late_ns.store(max_late_ns, Ordering::Relaxed);
    }

    /// Writes the number of hosts that are not lost to [`RunProgress`].
    pub(super) fn publish_active_hosts(&self, state: &mut ServerState) {
        let remaining_hosts = state.barrier.roster_mut().active_host_count();
        let active_hosts = remaining_hosts.saturating_sub(state.lost_hosts.assignments().count());
        let progress = self.context.progress;
        progress.active_host_count.store(active_hosts as u64, Ordering::Relaxed);
    }

    /// Waits until `first` is due, under a real-time pace.
    async fn wait_until_due(&mut self, first: Tti) -> Result<(), BsError> {
        let Pace::RealTime(micros) = self.pace else {
            return Ok(());
        };
        let tti_duration = Duration::from_micros(micros);
        let now = now();
        let due = self.schedule.due(first, tti_duration, now);
        if due < now {
            self.lateness.record_delay(now - due);
        }
        let delay = now.saturating_duration_since(due);
        let begin = now.max(due);
        let backlog = self.schedule.backlog(begin);
        if let Some(mean) = self.pace_watch.record(first, delay, backlog, begin) {
            let (pace, mean) = (self.pace, mean.as_secs_f64() * 1e3);
            tracing::warn!(
                tti = %first,
                "a TTI takes {mean:.1} ms, with the network and the devices, but the pace is one every {pace}: TTIs \
                 begin late; use a slower --pace, or `reveille clock pace`"
            );
        }
        self.sleep_until(due).await
    }

    /// Sleeps until `due`, or until a loss, a new pace, a stop or a pause.
    async fn sleep_until(&mut self, due: Instant) -> Result<(), BsError> {
        while now() < due && !self.context.progress.is_stop_requested() {
            tokio::time::sleep_until(due.min(now() + CHECK_INTERVAL).into()).await;
            let mut state = self.context.shared.lock();
            self.handle_lost_hosts(&mut state)?;
            // The caller checks the clock and the losses again.
            if state.clock.pace() != self.pace || state.clock.until() <= self.session.next_tti() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Waits until the barrier is complete, and retransmits the messages of the grant at intervals.
    async fn wait_for_answers(&mut self) -> Result<(), BsError> {
        let (mut retransmit_at, mut stop_at) = (None, None);
        // Time without an answer, counted only while this process ran: a stopped process receives nothing.
        let (mut last_check, mut unanswered_for) = (None, Duration::ZERO);
        let mut has_warned = false;
        loop {
            let (needs_retransmit, has_all_hosts) = {
                let mut state = self.context.shared.lock();
                if state.barrier.is_complete() {
                    return Ok(());
                }
                self.handle_lost_hosts(&mut state)?;
                (std::mem::take(&mut state.needs_retransmit), state.lost_hosts.is_empty())
            };
            let now = now();
            // One check adds at most two intervals: a longer gap means that this process itself was stopped.
            unanswered_for += (now - *last_check.get_or_insert(now)).min(CHECK_INTERVAL + CHECK_INTERVAL);
            last_check = Some(now);
            // A lost host is not expected to answer, and a returned host needs time to do so.
            if needs_retransmit || !has_all_hosts {
                (unanswered_for, has_warned) = (Duration::ZERO, false);
            }
            // A returned host may have missed the grant, so it does not wait for the next retransmission.
            if needs_retransmit || now >= *retransmit_at.get_or_insert(now + RETRANSMIT_INTERVAL) {
                retransmit_at = Some(now + RETRANSMIT_INTERVAL);
                self.retransmit()?;
            }
            if unanswered_for >= UNRESPONSIVE_AFTER && !has_warned {
                has_warned = true;
                self.warn_of_unresponsive_hosts();
            }
            if unanswered_for >= LOST_AFTER {
                self.mark_unresponsive_hosts_lost();
            }
            let must_stop = self.context.progress.is_stop_requested();
            if must_stop && now >= *stop_at.get_or_insert(now + STOP_TIMEOUT) {
                let (tti, hosts) = (
                    self.session.next_tti(),
                    self.context.shared.lock().barrier.missing_hosts(),
                );
                return Err(BsError::NoAnswer { tti, hosts });
            }
            let _changed = tokio::time::timeout(CHECK_INTERVAL, self.context.shared.wait_for_change()).await;
        }
    }

    /// Retransmits the messages of the last grant to the current owners of the devices.
    fn retransmit(&mut self) -> Result<(), BusError> {
        // Nothing is sent under the lock: a put waits while a link is congested, and callbacks of messages need the
        // lock.
        let mut state = self.context.shared.lock();
        let roster = state.barrier.roster_mut();
        self.downlink.redirect_wake_ups(|device| roster.owner_of(device));
        state.copy_owners_to(self.context.progress);
        drop(state);
        self.downlink.retransmit()
    }

    /// Ends the run on all hosts before the next TTI, and collects the ledgers of the devices.
    async fn collect_ledgers(&mut self) -> Result<Vec<Ledger>, BsError> {
        // Before the message is sent, for the same reason as with a grant.
        self.context.shared.lock().barrier.expect_ledgers();
        self.downlink
            .send_clock(ClockMessage::CollectLedgers(self.session.next_tti()))?;
        self.wait_for_answers().await?;
        let run_end = self.session.next_tti();
        let (mut ledgers, lost_meanwhile, devices) = {
            let mut state = self.context.shared.lock();
            let devices = state.barrier.roster_mut().device_count() as u32;
            let lost_meanwhile = std::mem::take(&mut state.pending_removals);
            (state.barrier.take_ledgers(), lost_meanwhile, devices)
        };
        ledgers.extend(self.removed_hosts.all_ledgers_before(run_end)?);
        for Assignment { first, count, .. } in lost_meanwhile {
            // A host lost in this barrier has completed all TTIs, so its devices are not removed: a replay has their
            // ledgers.
            let lost_ledgers = self.removed_hosts.ledgers_before(run_end, first, count)?;
            ledgers.extend((first.0..).map(DeviceId).zip(lost_ledgers));
        }
        ledgers.sort_unstable_by_key(|(device, _)| *device);
        let all_devices = (0..devices).map(DeviceId);
        assert!(
            ledgers.iter().map(|(device, _)| *device).eq(all_devices),
            "a ledger for each device"
        );
        Ok(ledgers.into_iter().map(|(_, ledger)| ledger).collect())
    }
}
