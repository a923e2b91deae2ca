//! What the BS waits for: the answers of all hosts to a grant, the outcome of a wake-up, or the ledgers at the end.
//!
//! Answers are kept by host and TTI: one with figures that its sender cannot have is counted and dropped; one that
//! comes twice takes the place of the first; one that nobody waits for any more, as after a question that was asked
//! again, is dropped.

use std::collections::BTreeMap;

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Answer, Failure, Report, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;

use crate::host::roster::Roster;

/// A device that nobody carries.
pub const UNKNOWN: DeviceView = DeviceView {
    state: DeviceState::Sleep { powered: false },
    battery: Energy::ZERO,
};

/// The answers to one grant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gathered {
    /// The reports of all devices, in the order of ids.
    pub reports: Vec<Report>,
    /// The devices that could not transmit.
    pub failures: Vec<Failure>,
    /// Sums over all devices, where the grant asked for them.
    pub totals: DeviceTotals,
    /// States and batteries of all devices, in the order of ids, where the grant asked for them.
    pub views: Vec<DeviceView>,
}

/// One host's answer to a grant.
#[derive(Debug)]
struct Done {
    reports: u32,
    failures: Vec<Failure>,
    totals: Option<DeviceTotals>,
    views: Vec<DeviceView>,
}

/// What a grant asks for beside reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Asked {
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
            missing: roster.carrying(),
        }
    }

    /// The host at this position answers no more. Its answer, if it gave one.
    fn lose(&mut self, host: usize) -> Option<T> {
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

/// What is being waited for.
#[derive(Debug)]
enum Stage {
    Nothing,
    Grant {
        tti: Tti,
        /// Whether devices may report.
        stimulus: bool,
        /// What the answers carry.
        asked: Asked,
        answers: Answers<Done>,
        /// Reports that the answers so far speak of.
        expected: usize,
        reports: BTreeMap<DeviceId, Report>,
    },
    Wake {
        tti: Tti,
        device: DeviceId,
        outcome: Option<WakeOutcome>,
    },
    Finish {
        answers: Answers<Vec<(DeviceId, Ledger)>>,
    },
}

/// The barrier at the end of each TTI.
#[derive(Debug)]
pub struct Barrier {
    roster: Roster,
    stage: Stage,
    /// The last TTI that was granted.
    granted: Option<Tti>,
    strays: u64,
}

impl Barrier {
    /// A barrier for the devices of `roster` that waits for nothing yet.
    pub const fn new(roster: Roster) -> Self {
        Self {
            roster,
            stage: Stage::Nothing,
            granted: None,
            strays: 0,
        }
    }

    /// The roster: which host carries which devices.
    pub const fn roster(&mut self) -> &mut Roster {
        &mut self.roster
    }

    /// Waits for the answers to a grant that ends with `tti`, with all that was `asked`. Without a `stimulus` no device
    /// has anything to report.
    pub fn expect_grant(&mut self, tti: Tti, stimulus: bool, asked: Asked) {
        self.granted = Some(tti);
        self.stage = Stage::Grant {
            tti,
            stimulus,
            asked,
            answers: Answers::new(&self.roster),
            expected: 0,
            reports: BTreeMap::new(),
        };
    }

    /// Waits for what comes of a wake-up; of a device that nobody carries comes nothing.
    pub fn expect_wake(&mut self, tti: Tti, device: DeviceId) {
        let is_carried = self.roster.carrier(device).is_some();
        self.stage = Stage::Wake {
            tti,
            device,
            outcome: (!is_carried).then_some(WakeOutcome::Unheard),
        };
    }

    /// Waits for the ledgers of all devices.
    pub fn expect_ledgers(&mut self) {
        self.stage = Stage::Finish {
            answers: Answers::new(&self.roster),
        };
    }

    /// `host` has gone for good with its devices: what it has said of an open grant does not count, and nothing more is
    /// waited for.
    pub fn lose(&mut self, host: HostId) {
        let Self { roster, stage, .. } = self;
        let Some(position) = roster.position(host) else { return };
        match stage {
            Stage::Nothing => {}
            Stage::Grant {
                answers,
                expected,
                reports,
                ..
            } => {
                *expected -= answers.lose(position).map_or(0, |done| done.reports as usize);
                reports.retain(|device, _| !roster.owns(position, *device));
            }
            Stage::Wake { device, outcome, .. } => {
                if roster.owns(position, *device) {
                    outcome.get_or_insert(WakeOutcome::Unheard);
                }
            }
            Stage::Finish { answers } => drop(answers.lose(position)),
        }
        roster.lose(position);
    }

    /// A message has come that nobody waited for, from somebody who has no say.
    pub const fn stray(&mut self) {
        self.strays += 1;
    }

    /// A report has come from `host`. Whether that was the last thing waited for.
    pub fn report(&mut self, host: HostId, report: Report) -> bool {
        let owner = self.roster.position(host);
        let is_sound =
            owner.is_some_and(|position| self.roster.owns(position, report.device)) && self.roster.can_report(&report);
        let is_late = is_sound && self.is_past(report.tti);
        let is_asked = matches!(self.stage, Stage::Grant { tti, .. } if tti == report.tti);
        match &mut self.stage {
            Stage::Grant {
                tti,
                stimulus: true,
                reports,
                ..
            } if is_sound && report.tti == *tti => {
                // The first counts, where one is sent again.
                reports.entry(report.device).or_insert(report);
            }
            Stage::Wake { tti, device, outcome } if is_sound && report.tti == *tti && report.device == *device => {
                *outcome = Some(WakeOutcome::Reported(report));
            }
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => {
                self.strays += u64::from(!is_late || is_asked);
            }
        }
        self.is_complete()
    }

    /// Whether what concerns `tti` may have been asked for already.
    fn is_past(&self, tti: Tti) -> bool {
        self.granted.is_some_and(|last| tti <= last)
    }

    /// An answer has come from `host`. Whether that was the last thing waited for.
    pub fn answer(&mut self, host: HostId, answer: Answer) -> bool {
        let is_late = match &answer {
            Answer::Done { tti, .. } | Answer::NotWoken { tti, .. } => self.is_past(*tti),
            Answer::Final { .. } => false,
        };
        let is_open = self.is_about_what_is_open(&answer);
        let is_taken = self.roster.position(host).is_some_and(|at| self.take(at, answer));
        if !is_taken && (is_open || !is_late) {
            self.strays += 1;
        }
        self.is_complete()
    }

    /// Whether the answer is about what is waited for.
    fn is_about_what_is_open(&self, answer: &Answer) -> bool {
        match (&self.stage, answer) {
            (Stage::Grant { tti, .. }, Answer::Done { tti: answered, .. }) => tti == answered,
            (
                Stage::Wake { tti, device, .. },
                Answer::NotWoken {
                    tti: when, device: who, ..
                },
            ) => (tti, device) == (when, who),
            (Stage::Finish { .. }, Answer::Final { .. }) => true,
            (Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. }, _) => false,
        }
    }

    /// Keeps the answer of the host at position `host`, if it is what is waited for and can be true.
    fn take(&mut self, host: usize, answer: Answer) -> bool {
        let Self { roster, stage, .. } = self;
        match (stage, answer) {
            (
                Stage::Grant {
                    tti,
                    stimulus,
                    asked,
                    answers,
                    expected,
                    ..
                },
                Answer::Done {
                    host: named,
                    tti: answered,
                    reports,
                    failures,
                    totals,
                    views,
                },
            ) => {
                let is_quiet = reports == 0 && failures.is_empty();
                let is_sound = roster.position(named) == Some(host)
                    && answered == *tti
                    && (*stimulus || is_quiet)
                    && roster.can_be_done(host, reports, &failures)
                    && totals.is_some() == asked.account
                    && views.is_some() == asked.views
                    && views.as_ref().is_none_or(|views| roster.can_look_so(host, views))
                    && totals.is_none_or(|sums| roster.can_sum_to(host, &sums));
                if is_sound {
                    let done = Done {
                        reports,
                        failures,
                        totals,
                        views: views.unwrap_or_default(),
                    };
                    *expected += reports as usize;
                    *expected -= answers.put(host, done).map_or(0, |before| before.reports as usize);
                }
                is_sound
            }
            (
                Stage::Wake { tti, device, outcome },
                Answer::NotWoken {
                    device: who,
                    tti: when,
                    outcome: came,
                },
            ) => {
                let is_sound =
                    when == *tti && who == *device && roster.owns(host, who) && roster.can_come_to(who, &came);
                if is_sound {
                    *outcome = Some(came);
                }
                is_sound
            }
            (Stage::Finish { answers }, Answer::Final { host: named, ledgers }) => {
                let is_sound = roster.position(named) == Some(host) && roster.can_end_with(host, &ledgers);
                if is_sound {
                    answers.put(host, ledgers);
                }
                is_sound
            }
            (Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. }, _) => false,
        }
    }

    /// Whether everything waited for has come.
    pub fn is_complete(&self) -> bool {
        match &self.stage {
            Stage::Nothing => true,
            Stage::Grant {
                answers,
                expected,
                reports,
                ..
            } => answers.missing == 0 && reports.len() >= *expected,
            Stage::Wake { outcome, .. } => outcome.is_some(),
            Stage::Finish { answers } => answers.missing == 0,
        }
    }

    /// Takes the answers to the grant.
    ///
    /// # Panics
    /// If no grant is complete.
    pub fn take_gathered(&mut self) -> Gathered {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Grant {
                answers,
                reports,
                asked,
                ..
            } if answers.missing == 0 => {
                let mut gathered = Gathered {
                    reports: reports.into_values().collect(),
                    views: vec![UNKNOWN; if asked.views { self.roster.devices() } else { 0 }],
                    ..Gathered::default()
                };
                for (host, done) in answers.of.into_iter().enumerate() {
                    let Some(done) = done else { continue };
                    gathered.failures.extend(done.failures);
                    gathered.totals += done.totals.unwrap_or_default();
                    if asked.views {
                        let first = self.roster.places(host).first.index();
                        gathered.views[first..][..done.views.len()].copy_from_slice(&done.views);
                    }
                }
                gathered
            }
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => {
                panic!("no grant is complete")
            }
        }
    }

    /// Takes the outcome of the wake-up.
    ///
    /// # Panics
    /// If no wake-up is complete.
    pub fn take_outcome(&mut self) -> WakeOutcome {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Wake {
                outcome: Some(outcome), ..
            } => outcome,
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => {
                panic!("no wake-up is complete")
            }
        }
    }

    /// Takes the ledgers of all devices that are carried, in no order.
    ///
    /// # Panics
    /// If they are not complete.
    pub fn take_ledgers(&mut self) -> Vec<(DeviceId, Ledger)> {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Finish { answers } if answers.missing == 0 => answers.of.into_iter().flatten().flatten().collect(),
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => {
                panic!("the ledgers are not complete")
            }
        }
    }

    /// The hosts that have not answered.
    pub fn waiting(&self) -> Vec<HostId> {
        let is_missing: Vec<bool> = match &self.stage {
            Stage::Nothing => Vec::new(),
            Stage::Wake { device, .. } => return self.roster.carrier(*device).into_iter().collect(),
            Stage::Grant { answers, .. } => answers.of.iter().map(Option::is_none).collect(),
            Stage::Finish { answers } => answers.of.iter().map(Option::is_none).collect(),
        };
        let missing = (0..)
            .zip(is_missing)
            .filter(|(host, missing)| *missing && !self.roster.is_gone(*host));
        missing.map(|(host, _)| self.roster.places(host).host).collect()
    }

    /// Messages that nobody waited for, or that cannot be true.
    pub const fn strays(&self) -> u64 {
        self.strays
    }
}
