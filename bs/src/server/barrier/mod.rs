//! The barrier of the run loop: waits for the answers of all hosts to a grant, for the outcome of a wake-up, or for the
//! final ledgers.
//!
//! One wait is open at a time, and keeps one answer by host; a new wait drops an open one. An answer with impossible
//! figures ([`Roster`]) is counted and dropped. A repeated answer replaces the first one, but of repeated reports to a
//! grant the first one stays. A late answer, such as a duplicate after a retransmission, is dropped.
//! Reports and views are in the order of ids, whichever host answers first.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{FailedTransmission, HostAnswer, Report, UnableDetectors, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::roster::Roster;
use crate::session::REMOVED_VIEW;

/// The answers to one grant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GrantResult {
    /// The reports of all devices, in the order of ids.
    pub reports: Vec<Report>,
    /// The devices that could not transmit.
    pub failures: Vec<FailedTransmission>,
    /// Devices that would have detected the event, but could not sense.
    pub unable: UnableDetectors,
    /// Sums over all devices, if the grant asked for them.
    pub totals: DeviceTotals,
    /// States and batteries of all devices, in the order of ids, if the grant asked for them.
    pub views: Vec<DeviceView>,
}

/// One host's answer to a grant.
#[derive(Debug)]
struct HostResult {
    /// Number of reports that the host announces; they arrive as separate messages.
    announced_reports: u32,
    failures: Vec<FailedTransmission>,
    unable: UnableDetectors,
    totals: Option<DeviceTotals>,
    views: Vec<DeviceView>,
}

/// Data that a grant requests in addition to reports, as in [`GrantMessage`](reveille_common::message::GrantMessage).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GrantOptions {
    /// Whether it requests sums over the devices.
    pub wants_totals: bool,
    /// Whether it requests states and batteries.
    pub wants_views: bool,
}

/// One answer of each host.
#[derive(Debug)]
struct Answers<T> {
    /// By position in the roster.
    by_host: Vec<Option<T>>,
    /// Number of hosts that have not answered, without removed ones.
    missing_count: usize,
}

impl<T> Answers<T> {
    fn new(roster: &Roster) -> Self {
        Self {
            by_host: (0..roster.host_count()).map(|_| None).collect(),
            missing_count: roster.active_host_count(),
        }
    }

    /// Stops waiting for the host at this position. Returns its answer, if it gave one.
    fn remove_host(&mut self, position: usize) -> Option<T> {
        let answer = self.by_host[position].take();
        self.missing_count -= usize::from(answer.is_none());
        answer
    }

    fn replace_answer(&mut self, position: usize, answer: T) -> Option<T> {
        let previous = self.by_host[position].replace(answer);
        self.missing_count -= usize::from(previous.is_none());
        previous
    }
}

/// The answers that the barrier waits for.
#[derive(Debug)]
enum BarrierState {
    Idle,
    Grant {
        tti: Tti,
        may_report: bool,
        /// The additional data that the answers must have.
        options: GrantOptions,
        answers: Answers<HostResult>,
        /// Number of reports that the answers so far announce.
        announced_reports: usize,
        reports: BTreeMap<DeviceId, Report>,
    },
    WakeUp {
        tti: Tti,
        device: DeviceId,
        outcome: Option<WakeOutcome>,
    },
    Ledgers {
        answers: Answers<Vec<(DeviceId, Ledger)>>,
    },
}

/// The barrier at the end of each grant, of each wake-up, and of the run for the ledgers.
#[derive(Debug)]
pub struct Barrier {
    roster: Roster,
    state: BarrierState,
    /// The last TTI of the last grant.
    last_granted: Option<Tti>,
    unexpected_messages: u64,
}

impl Barrier {
    /// Creates a barrier for the devices of `roster` that has no open wait.
    pub const fn new(roster: Roster) -> Self {
        Self {
            roster,
            state: BarrierState::Idle,
            last_granted: None,
            unexpected_messages: 0,
        }
    }

    /// The roster, which maps devices to hosts. The caller may set its hosts before the run and replace a lost one, but
    /// [`Self::remove_host`] must remove them, since the open wait depends on it.
    pub const fn roster_mut(&mut self) -> &mut Roster {
        &mut self.roster
    }

    /// Starts to wait for the answers to a grant that ends with `tti`, with the data in `options`. `may_report` is
    /// whether the grant has a stimulus: without one no device can report.
    pub fn expect_grant(&mut self, tti: Tti, may_report: bool, options: GrantOptions) {
        self.last_granted = Some(tti);
        self.state = BarrierState::Grant {
            tti,
            may_report,
            options,
            answers: Answers::new(&self.roster),
            announced_reports: 0,
            reports: BTreeMap::new(),
        };
    }

    /// Starts to wait for the outcome of a wake-up.
    pub fn expect_wake(&mut self, tti: Tti, device: DeviceId) {
        // A wake-up to a removed device completes immediately, as no host would ever answer it.
        let has_owner = self.roster.owner_of(device).is_some();
        self.state = BarrierState::WakeUp {
            tti,
            device,
            outcome: (!has_owner).then_some(WakeOutcome::Missed),
        };
    }

    /// Starts to wait for the ledgers of all devices.
    pub fn expect_ledgers(&mut self) {
        self.state = BarrierState::Ledgers {
            answers: Answers::new(&self.roster),
        };
    }

    /// Removes `host` with its devices. Its answer to an open grant no longer counts, and nothing more is expected from
    /// it. Without effect if it is removed already.
    pub fn remove_host(&mut self, host: HostId) {
        let Self { roster, state, .. } = self;
        let Some(position) = roster.position(host) else { return };
        match state {
            BarrierState::Idle => {}
            BarrierState::Grant {
                answers,
                announced_reports,
                reports,
                ..
            } => {
                // Removed devices do not sense in this TTI, so neither the reports nor the number of reports of the
                // host may count.
                *announced_reports -= answers
                    .remove_host(position)
                    .map_or(0, |result| result.announced_reports as usize);
                reports.retain(|device, _| !roster.owns(position, *device));
            }
            BarrierState::WakeUp { device, outcome, .. } => {
                if roster.owns(position, *device) {
                    outcome.get_or_insert(WakeOutcome::Missed);
                }
            }
            BarrierState::Ledgers { answers } => drop(answers.remove_host(position)),
        }
        roster.remove_host(position);
    }

    /// Counts an unexpected message from a process without a valid credential.
    pub const fn count_unexpected(&mut self) {
        self.unexpected_messages += 1;
    }

    /// Takes in a report from `host`, whose credential the caller has checked. Returns whether the barrier is complete.
    pub fn receive_report(&mut self, host: HostId, report: Report) -> bool {
        let position = self.roster.position(host);
        let is_possible = position.is_some_and(|position| self.roster.owns(position, report.device))
            && self.roster.is_possible_report(&report);
        let is_for_granted_tti = is_possible && self.was_granted(report.tti);
        let is_about_open_grant = matches!(self.state, BarrierState::Grant { tti, .. } if tti == report.tti);
        match &mut self.state {
            BarrierState::Grant {
                tti,
                may_report: true,
                reports,
                ..
            } if is_possible && report.tti == *tti => {
                // The first report counts if a host sends it again.
                reports.entry(report.device).or_insert(report);
            }
            BarrierState::WakeUp { tti, device, outcome }
                if is_possible && report.tti == *tti && report.device == *device =>
            {
                *outcome = Some(WakeOutcome::Reported(report));
            }
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                // After a retransmission, duplicates about an earlier TTI are normal; only a report that was never
                // asked for is a stray.
                self.unexpected_messages += u64::from(!is_for_granted_tti || is_about_open_grant);
            }
        }
        self.is_complete()
    }

    /// Whether `tti` has been granted, so that a message about it can be a late duplicate.
    fn was_granted(&self, tti: Tti) -> bool {
        self.last_granted.is_some_and(|last| tti <= last)
    }

    /// Takes in an answer from `host`, whose credential the caller has checked. Returns whether the barrier is
    /// complete.
    pub fn receive_answer(&mut self, host: HostId, answer: HostAnswer) -> bool {
        let is_for_granted_tti = match &answer {
            HostAnswer::GrantDone { tti, .. } | HostAnswer::NoReport { tti, .. } => self.was_granted(*tti),
            HostAnswer::Ledgers { .. } => false,
        };
        let is_open = self.concerns_open_wait(&answer);
        let is_stored = self
            .roster
            .position(host)
            .is_some_and(|position| self.store_answer(position, answer));
        // As for reports, a late duplicate is not counted, but an impossible answer to the open grant is.
        if !is_stored && (is_open || !is_for_granted_tti) {
            self.unexpected_messages += 1;
        }
        self.is_complete()
    }

    /// Whether the answer concerns the open wait.
    fn concerns_open_wait(&self, answer: &HostAnswer) -> bool {
        match (&self.state, answer) {
            (BarrierState::Grant { tti, .. }, HostAnswer::GrantDone { tti: answered_tti, .. }) => tti == answered_tti,
            (
                BarrierState::WakeUp { tti, device, .. },
                HostAnswer::NoReport {
                    tti: answered_tti,
                    device: answered_device,
                    ..
                },
            ) => (tti, device) == (answered_tti, answered_device),
            (BarrierState::Ledgers { .. }, HostAnswer::Ledgers { .. }) => true,
            (
                BarrierState::Idle
                | BarrierState::Grant { .. }
                | BarrierState::WakeUp { .. }
                | BarrierState::Ledgers { .. },
                _,
            ) => false,
        }
    }

    /// Keeps the answer of the host at `position` if it is expected and possible. Returns whether it was kept.
    fn store_answer(&mut self, position: usize, answer: HostAnswer) -> bool {
        let Self { roster, state, .. } = self;
        match (state, answer) {
            (
                BarrierState::Grant {
                    tti,
                    may_report,
                    options,
                    answers,
                    announced_reports,
                    ..
                },
                HostAnswer::GrantDone {
                    host: stated_host,
                    tti: answered_tti,
                    reports,
                    failures,
                    unable,
                    totals,
                    views,
                },
            ) => {
                let is_quiet = reports == 0 && failures.is_empty() && unable == UnableDetectors::default();
                // Every field is checked before anything is kept, since a host may send any numbers.
                let is_possible = roster.position(stated_host) == Some(position)
                    && answered_tti == *tti
                    && (*may_report || is_quiet)
                    && roster.is_possible_answer(position, reports, &failures, unable)
                    && totals.is_some() == options.wants_totals
                    && views.is_some() == options.wants_views
                    && views
                        .as_ref()
                        .is_none_or(|views| roster.are_possible_views(position, views))
                    && totals.is_none_or(|sums| roster.are_possible_totals(position, &sums));
                if is_possible {
                    let result = HostResult {
                        announced_reports: reports,
                        failures,
                        unable,
                        totals,
                        views: views.unwrap_or_default(),
                    };
                    *announced_reports += reports as usize;
                    // The host may answer again after a retransmission, so its earlier number of reports is replaced,
                    // not added.
                    *announced_reports -= answers
                        .replace_answer(position, result)
                        .map_or(0, |previous| previous.announced_reports as usize);
                }
                is_possible
            }
            (
                BarrierState::WakeUp { tti, device, outcome },
                HostAnswer::NoReport {
                    device: answered_device,
                    tti: answered_tti,
                    outcome: answered_outcome,
                },
            ) => {
                let is_possible = answered_tti == *tti
                    && answered_device == *device
                    && roster.owns(position, answered_device)
                    && roster.is_possible_outcome(answered_device, &answered_outcome);
                if is_possible {
                    *outcome = Some(answered_outcome);
                }
                is_possible
            }
            (
                BarrierState::Ledgers { answers },
                HostAnswer::Ledgers {
                    host: stated_host,
                    ledgers,
                },
            ) => {
                let is_possible =
                    roster.position(stated_host) == Some(position) && roster.are_possible_ledgers(position, &ledgers);
                if is_possible {
                    answers.replace_answer(position, ledgers);
                }
                is_possible
            }
            (
                BarrierState::Idle
                | BarrierState::Grant { .. }
                | BarrierState::WakeUp { .. }
                | BarrierState::Ledgers { .. },
                _,
            ) => false,
        }
    }

    /// Whether everything expected has arrived.
    pub fn is_complete(&self) -> bool {
        match &self.state {
            BarrierState::Idle => true,
            // A host can send more reports than it announces, so `==` might never become true.
            BarrierState::Grant {
                answers,
                announced_reports,
                reports,
                ..
            } => answers.missing_count == 0 && reports.len() >= *announced_reports,
            BarrierState::WakeUp { outcome, .. } => outcome.is_some(),
            BarrierState::Ledgers { answers } => answers.missing_count == 0,
        }
    }

    /// Takes the answers to the grant.
    ///
    /// # Panics
    /// If no grant is open or a host has not answered it. Announced reports that are missing cause no panic.
    pub fn take_grant_result(&mut self) -> GrantResult {
        match std::mem::replace(&mut self.state, BarrierState::Idle) {
            BarrierState::Grant {
                answers,
                reports,
                options,
                ..
            } if answers.missing_count == 0 => {
                let view_count = usize::from(options.wants_views) * self.roster.device_count();
                let mut grant_result = GrantResult {
                    reports: reports.into_values().collect(),
                    // No host answers for removed devices, so their views keep this value.
                    views: vec![REMOVED_VIEW; view_count],
                    ..GrantResult::default()
                };
                for (position, result) in answers.by_host.into_iter().enumerate() {
                    let Some(result) = result else { continue };
                    grant_result.failures.extend(result.failures);
                    grant_result.unable += result.unable;
                    grant_result.totals += result.totals.unwrap_or_default();
                    if options.wants_views {
                        let first = self.roster.assignment(position).first.index();
                        // In range: `are_possible_views` has checked that there is one view for each device of the
                        // host.
                        grant_result.views[first..][..result.views.len()].copy_from_slice(&result.views);
                    }
                }
                grant_result
            }
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                panic!("no grant is complete")
            }
        }
    }

    /// Takes the outcome of the wake-up.
    ///
    /// # Panics
    /// If no wake-up is complete.
    pub fn take_wake_outcome(&mut self) -> WakeOutcome {
        match std::mem::replace(&mut self.state, BarrierState::Idle) {
            BarrierState::WakeUp {
                outcome: Some(outcome), ..
            } => outcome,
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                panic!("no wake-up is complete")
            }
        }
    }

    /// Takes the ledgers of all devices that are not removed, in no order.
    ///
    /// # Panics
    /// If they are not complete.
    pub fn take_ledgers(&mut self) -> Vec<(DeviceId, Ledger)> {
        match std::mem::replace(&mut self.state, BarrierState::Idle) {
            BarrierState::Ledgers { answers } if answers.missing_count == 0 => {
                answers.by_host.into_iter().flatten().flatten().collect()
            }
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                panic!("the ledgers are not complete")
            }
        }
    }

    /// The hosts that have not answered; for a wake-up the owner of the device, even after its outcome. A host that
    /// owes only announced reports is not among them.
    pub fn missing_hosts(&self) -> Vec<HostId> {
        let is_missing: Vec<bool> = match &self.state {
            BarrierState::Idle => Vec::new(),
            BarrierState::WakeUp { device, .. } => return self.roster.owner_of(*device).into_iter().collect(),
            BarrierState::Grant { answers, .. } => answers.by_host.iter().map(Option::is_none).collect(),
            BarrierState::Ledgers { answers } => answers.by_host.iter().map(Option::is_none).collect(),
        };
        let missing_positions = (0..)
            .zip(is_missing)
            .filter(|(position, is_missing)| *is_missing && !self.roster.is_removed(*position));
        missing_positions
            .map(|(position, _)| self.roster.assignment(position).host)
            .collect()
    }

    /// Number of messages that were unexpected or impossible.
    pub const fn unexpected_messages(&self) -> u64 {
        self.unexpected_messages
    }
}

#[cfg(test)]
mod tests;
