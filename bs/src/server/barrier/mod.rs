//! The barrier, which waits for the answers of all hosts to a grant, the outcome of a wake-up, or the final ledgers.
//!
//! Answers are kept by host and TTI. An answer with impossible figures is counted and dropped, and a repeated answer
//! replaces the first one. A late answer, such as a duplicate after a resend, is dropped.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{FailedTransmission, HostAnswer, Report, WakeOutcome};
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::roster::Roster;
use crate::session::REMOVED;

/// The answers to one grant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GrantResult {
    /// The reports of all devices, in the order of ids.
    pub reports: Vec<Report>,
    /// The devices that could not transmit.
    pub failures: Vec<FailedTransmission>,
    /// Sums over all devices, if the grant asked for them.
    pub totals: DeviceTotals,
    /// States and batteries of all devices, in the order of ids, if the grant asked for them.
    pub views: Vec<DeviceView>,
}

/// One host's answer to a grant.
#[derive(Debug)]
struct HostResult {
    reports: u32,
    failures: Vec<FailedTransmission>,
    totals: Option<DeviceTotals>,
    views: Vec<DeviceView>,
}

/// Data that a grant requests in addition to reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GrantOptions {
    /// Sums over the devices.
    pub account: bool,
    /// States and batteries.
    pub views: bool,
}

/// One answer of each host.
#[derive(Debug)]
struct Answers<T> {
    of: Vec<Option<T>>,
    missing: usize,
}

impl<T> Answers<T> {
    fn new(roster: &Roster) -> Self {
        Self {
            of: (0..roster.hosts()).map(|_| None).collect(),
            missing: roster.active_hosts(),
        }
    }

    /// Stops waiting for the host at this position. Returns its answer, if it gave one.
    fn remove_host(&mut self, host: usize) -> Option<T> {
        let answer = self.of[host].take();
        self.missing -= usize::from(answer.is_none());
        answer
    }

    fn put(&mut self, host: usize, answer: T) -> Option<T> {
        let before = self.of[host].replace(answer);
        self.missing -= usize::from(before.is_none());
        before
    }
}

/// The answers that the barrier waits for.
#[derive(Debug)]
enum BarrierState {
    Idle,
    Grant {
        tti: Tti,
        /// Whether devices may report.
        stimulus: bool,
        /// The additional data in the answers.
        asked: GrantOptions,
        answers: Answers<HostResult>,
        /// Number of reports that the answers so far announce.
        expected: usize,
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

/// The barrier at the end of each TTI.
#[derive(Debug)]
pub struct Barrier {
    roster: Roster,
    stage: BarrierState,
    /// The last TTI that was granted.
    granted: Option<Tti>,
    unexpected: u64,
}

impl Barrier {
    /// Creates a barrier for the devices of `roster` that has no open wait.
    pub const fn new(roster: Roster) -> Self {
        Self {
            roster,
            stage: BarrierState::Idle,
            granted: None,
            unexpected: 0,
        }
    }

    /// The roster, which maps devices to hosts.
    pub const fn roster(&mut self) -> &mut Roster {
        &mut self.roster
    }

    /// Starts to wait for the answers to a grant that ends with `tti`, with the data in `asked`. Without a `stimulus`
    /// no device can report.
    pub fn expect_grant(&mut self, tti: Tti, stimulus: bool, asked: GrantOptions) {
        self.granted = Some(tti);
        self.stage = BarrierState::Grant {
            tti,
            stimulus,
            asked,
            answers: Answers::new(&self.roster),
            expected: 0,
            reports: BTreeMap::new(),
        };
    }

    /// Starts to wait for the outcome of a wake-up.
    pub fn expect_wake(&mut self, tti: Tti, device: DeviceId) {
        // A wake-up to a removed device completes immediately, as no host would ever answer it.
        let is_carried = self.roster.owner_of(device).is_some();
        self.stage = BarrierState::WakeUp {
            tti,
            device,
            outcome: (!is_carried).then_some(WakeOutcome::Missed),
        };
    }

    /// Starts to wait for the ledgers of all devices.
    pub fn expect_ledgers(&mut self) {
        self.stage = BarrierState::Ledgers {
            answers: Answers::new(&self.roster),
        };
    }

    /// Removes `host` with its devices. Its answer to an open grant no longer counts, and nothing more is expected from
    /// it.
    pub fn remove_host(&mut self, host: HostId) {
        let Self { roster, stage, .. } = self;
        let Some(position) = roster.position(host) else { return };
        match stage {
            BarrierState::Idle => {}
            BarrierState::Grant {
                answers,
                expected,
                reports,
                ..
            } => {
                // Removed devices do not sense in this TTI, so neither the reports nor the number of reports of the
                // host may count.
                *expected -= answers.remove_host(position).map_or(0, |done| done.reports as usize);
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
        self.unexpected += 1;
    }

    /// Takes in a report from `host`. Returns whether the barrier is complete.
    pub fn report(&mut self, host: HostId, report: Report) -> bool {
        let owner = self.roster.position(host);
        let is_sound =
            owner.is_some_and(|position| self.roster.owns(position, report.device)) && self.roster.can_report(&report);
        let is_late = is_sound && self.is_past(report.tti);
        let is_asked = matches!(self.stage, BarrierState::Grant { tti, .. } if tti == report.tti);
        match &mut self.stage {
            BarrierState::Grant {
                tti,
                stimulus: true,
                reports,
                ..
            } if is_sound && report.tti == *tti => {
                // The first report counts if a host sends it again.
                reports.entry(report.device).or_insert(report);
            }
            BarrierState::WakeUp { tti, device, outcome }
                if is_sound && report.tti == *tti && report.device == *device =>
            {
                *outcome = Some(WakeOutcome::Reported(report));
            }
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                // After a resend, duplicates about an earlier TTI are normal; only a report that was never asked for is
                // a stray.
                self.unexpected += u64::from(!is_late || is_asked);
            }
        }
        self.is_complete()
    }

    /// Whether `tti` has been granted, so that a message about it can be a late duplicate.
    fn is_past(&self, tti: Tti) -> bool {
        self.granted.is_some_and(|last| tti <= last)
    }

    /// Takes in an answer from `host`. Returns whether the barrier is complete.
    pub fn answer(&mut self, host: HostId, answer: HostAnswer) -> bool {
        let is_late = match &answer {
            HostAnswer::GrantDone { tti, .. } | HostAnswer::NotWoken { tti, .. } => self.is_past(*tti),
            HostAnswer::Ledgers { .. } => false,
        };
        let is_open = self.is_about_what_is_open(&answer);
        let is_taken = self.roster.position(host).is_some_and(|at| self.take(at, answer));
        // As for reports, a late duplicate is not counted, but an impossible answer to the open grant is.
        if !is_taken && (is_open || !is_late) {
            self.unexpected += 1;
        }
        self.is_complete()
    }

    /// Whether the answer concerns the open wait.
    fn is_about_what_is_open(&self, answer: &HostAnswer) -> bool {
        match (&self.stage, answer) {
            (BarrierState::Grant { tti, .. }, HostAnswer::GrantDone { tti: answered, .. }) => tti == answered,
            (
                BarrierState::WakeUp { tti, device, .. },
                HostAnswer::NotWoken {
                    tti: when, device: who, ..
                },
            ) => (tti, device) == (when, who),
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

    /// Keeps the answer of the host at position `host` if it is expected and possible. Returns whether it was kept.
    fn take(&mut self, host: usize, answer: HostAnswer) -> bool {
        let Self { roster, stage, .. } = self;
        match (stage, answer) {
            (
                BarrierState::Grant {
                    tti,
                    stimulus,
                    asked,
                    answers,
                    expected,
                    ..
                },
                HostAnswer::GrantDone {
                    host: named,
                    tti: answered,
                    reports,
                    failures,
                    totals,
                    views,
                },
            ) => {
                let is_quiet = reports == 0 && failures.is_empty();
                // Every field is checked before anything is kept, since a host may send any numbers.
                let is_sound = roster.position(named) == Some(host)
                    && answered == *tti
                    && (*stimulus || is_quiet)
                    && roster.is_possible_answer(host, reports, &failures)
                    && totals.is_some() == asked.account
                    && views.is_some() == asked.views
                    && views
                        .as_ref()
                        .is_none_or(|views| roster.are_possible_views(host, views))
                    && totals.is_none_or(|sums| roster.are_possible_totals(host, &sums));
                if is_sound {
                    let done = HostResult {
                        reports,
                        failures,
                        totals,
                        views: views.unwrap_or_default(),
                    };
                    *expected += reports as usize;
                    // The host may answer again after a resend, so its earlier number of reports is replaced, not
                    // added.
                    *expected -= answers.put(host, done).map_or(0, |before| before.reports as usize);
                }
                is_sound
            }
            (
                BarrierState::WakeUp { tti, device, outcome },
                HostAnswer::NotWoken {
                    device: who,
                    tti: when,
                    outcome: came,
                },
            ) => {
                let is_sound =
                    when == *tti && who == *device && roster.owns(host, who) && roster.is_possible_outcome(who, &came);
                if is_sound {
                    *outcome = Some(came);
                }
                is_sound
            }
            (BarrierState::Ledgers { answers }, HostAnswer::Ledgers { host: named, ledgers }) => {
                let is_sound = roster.position(named) == Some(host) && roster.are_possible_ledgers(host, &ledgers);
                if is_sound {
                    answers.put(host, ledgers);
                }
                is_sound
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
        match &self.stage {
            BarrierState::Idle => true,
            // A host can send more reports than it announces, so `==` might never become true.
            BarrierState::Grant {
                answers,
                expected,
                reports,
                ..
            } => answers.missing == 0 && reports.len() >= *expected,
            BarrierState::WakeUp { outcome, .. } => outcome.is_some(),
            BarrierState::Ledgers { answers } => answers.missing == 0,
        }
    }

    /// Takes the answers to the grant.
    ///
    /// # Panics
    /// If no grant is complete.
    pub fn take_grant_result(&mut self) -> GrantResult {
        match std::mem::replace(&mut self.stage, BarrierState::Idle) {
            BarrierState::Grant {
                answers,
                reports,
                asked,
                ..
            } if answers.missing == 0 => {
                let mut gathered = GrantResult {
                    reports: reports.into_values().collect(),
                    // No host answers for removed devices, so their views keep this value.
                    views: vec![REMOVED; if asked.views { self.roster.devices() } else { 0 }],
                    ..GrantResult::default()
                };
                for (host, done) in answers.of.into_iter().enumerate() {
                    let Some(done) = done else { continue };
                    gathered.failures.extend(done.failures);
                    gathered.totals += done.totals.unwrap_or_default();
                    if asked.views {
                        let first = self.roster.assignment(host).first.index();
                        // In range: `are_possible_views` has checked that there is one view for each device of the
                        // host.
                        gathered.views[first..][..done.views.len()].copy_from_slice(&done.views);
                    }
                }
                gathered
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
    pub fn take_outcome(&mut self) -> WakeOutcome {
        match std::mem::replace(&mut self.stage, BarrierState::Idle) {
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
        match std::mem::replace(&mut self.stage, BarrierState::Idle) {
            BarrierState::Ledgers { answers } if answers.missing == 0 => {
                answers.of.into_iter().flatten().flatten().collect()
            }
            BarrierState::Idle
            | BarrierState::Grant { .. }
            | BarrierState::WakeUp { .. }
            | BarrierState::Ledgers { .. } => {
                panic!("the ledgers are not complete")
            }
        }
    }

    /// The hosts that have not answered.
    pub fn missing_hosts(&self) -> Vec<HostId> {
        let is_missing: Vec<bool> = match &self.stage {
            BarrierState::Idle => Vec::new(),
            BarrierState::WakeUp { device, .. } => return self.roster.owner_of(*device).into_iter().collect(),
            BarrierState::Grant { answers, .. } => answers.of.iter().map(Option::is_none).collect(),
            BarrierState::Ledgers { answers } => answers.of.iter().map(Option::is_none).collect(),
        };
        let missing = (0..)
            .zip(is_missing)
            .filter(|(host, missing)| *missing && !self.roster.is_removed(*host));
        missing.map(|(host, _)| self.roster.assignment(host).host).collect()
    }

    /// Number of messages that were unexpected or impossible.
    pub const fn unexpected_messages(&self) -> u64 {
        self.unexpected
    }
}

#[cfg(test)]
mod tests;
