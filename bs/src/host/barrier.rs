//! What the BS waits for: the answers of all hosts to a grant, the outcome of a wake-up, or the ledgers at the end.
//!
//! Answers are kept by host and TTI: one with figures that its sender cannot have is counted and dropped; one that
//! comes twice takes the place of the first; one that nobody waits for any more, as after a question that was asked
//! again, is dropped.

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Answer, Failure, Report, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;

use crate::host::roster::Roster;

/// A device whose host has still to answer.
const UNKNOWN: DeviceView = DeviceView {
    state: DeviceState::Sleep { powered: false },
    battery: Energy::ZERO,
};

/// The answers to one grant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gathered {
    /// The reports of all devices, in the order of arrival.
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
    fn new(hosts: usize) -> Self {
        Self {
            of: (0..hosts).map(|_| None).collect(),
            missing: hosts,
        }
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
        reports: Vec<Report>,
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
            answers: Answers::new(self.roster.hosts()),
            expected: 0,
            reports: Vec::new(),
        };
    }

    /// Waits for what comes of a wake-up.
    pub fn expect_wake(&mut self, tti: Tti, device: DeviceId) {
        self.stage = Stage::Wake {
            tti,
            device,
            outcome: None,
        };
    }

    /// Waits for the ledgers of all devices.
    pub fn expect_ledgers(&mut self) {
        self.stage = Stage::Finish {
            answers: Answers::new(self.roster.hosts()),
        };
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
                if reports.iter().all(|r| r.device != report.device) {
                    reports.push(report);
                }
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
                    failure,
                },
            ) => {
                let is_sound = when == *tti
                    && who == *device
                    && roster.owns(host, who)
                    && failure.is_none_or(|f| f.device == who && roster.can_fail(&f));
                if is_sound {
                    *outcome = Some(failure.map_or(WakeOutcome::Unheard, WakeOutcome::Failed));
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
            Stage::Grant { answers, reports, .. } if answers.missing == 0 => {
                let mut gathered = Gathered {
                    reports,
                    ..Gathered::default()
                };
                for (host, done) in answers.of.into_iter().flatten().enumerate() {
                    gathered.failures.extend(done.failures);
                    gathered.totals += done.totals.unwrap_or_default();
                    if !done.views.is_empty() {
                        let first = self.roster.places(host).first.index();
                        let end = first + done.views.len();
                        let length = gathered.views.len().max(end);
                        gathered.views.resize(length, UNKNOWN);
                        gathered.views[first..end].copy_from_slice(&done.views);
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

    /// Takes the ledgers, in the order of device ids.
    ///
    /// # Panics
    /// If they are not complete.
    pub fn take_ledgers(&mut self) -> Vec<Ledger> {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Finish { answers } if answers.missing == 0 => {
                let mut ledgers: Vec<_> = answers.of.into_iter().flatten().flatten().collect();
                ledgers.sort_unstable_by_key(|(device, _)| *device);
                ledgers.into_iter().map(|(_, ledger)| ledger).collect()
            }
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
        let missing = is_missing.iter().enumerate().filter(|(_, missing)| **missing);
        missing.map(|(host, _)| self.roster.places(host).host).collect()
    }

    /// Messages that nobody waited for, or that cannot be true.
    pub const fn strays(&self) -> u64 {
        self.strays
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host::admission::Places;
    use crate::host::roster::tests::roster;

    fn done(host: u32, tti: u64, reports: u32) -> Answer {
        Answer::Done {
            host: HostId(host),
            tti: Tti(tti),
            reports,
            failures: vec![],
            totals: None,
            views: None,
        }
    }

    fn report(device: u32, tti: u64) -> Report {
        Report {
            device: DeviceId(device),
            tti: Tti(tti),
            information: 0.5,
            battery: Energy::ZERO,
        }
    }

    /// Two hosts with five devices each, waiting for TTI 5.
    fn barrier(stimulus: bool) -> Barrier {
        let mut barrier = Barrier::new(roster());
        barrier.expect_grant(Tti(5), stimulus, Asked::default());
        barrier
    }

    fn hear(b: &mut Barrier, report: Report) -> bool {
        b.report(HostId(report.device.0 / 5), report)
    }

    #[test]
    fn a_grant_waits_for_every_host_and_every_report() {
        let mut b = barrier(true);
        assert!(!b.answer(HostId(0), done(0, 5, 2)));
        assert!(!b.answer(HostId(0), done(0, 5, 2)), "the same answer twice");
        assert!(!b.answer(HostId(7), done(7, 5, 0)), "a host that nobody knows");
        assert!(!b.answer(HostId(1), done(0, 5, 0)), "in another's name");
        assert!(!b.answer(HostId(1), done(1, 4, 0)), "an answer to another grant");
        assert!(!b.answer(HostId(1), done(1, 5, 6)), "more reports than devices");
        assert_eq!(b.waiting(), [HostId(1)]);
        assert!(!b.answer(HostId(1), done(1, 5, 0)));
        assert!(!hear(&mut b, report(3, 5)));
        assert!(!hear(&mut b, report(3, 5)), "the same report twice");
        assert!(!hear(&mut b, report(4, 4)), "a report of another TTI");
        assert!(!hear(&mut b, report(10, 5)), "a report of a device that is not there");
        assert!(!b.report(HostId(1), report(4, 5)), "another host's device");
        assert!(hear(&mut b, report(4, 5)));
        assert_eq!(b.take_gathered().reports.len(), 2);
        // The answer to another grant and the report of another TTI came late: those of a question asked again may.
        assert_eq!(b.strays(), 5);
    }

    #[test]
    fn a_better_answer_takes_the_place_of_a_false_one() {
        let mut b = barrier(true);
        assert!(!b.answer(HostId(0), done(0, 5, 3)), "false: nobody reports");
        assert!(!b.answer(HostId(1), done(1, 5, 0)));
        assert!(b.answer(HostId(0), done(0, 5, 0)));
    }

    #[test]
    fn nobody_reports_on_nothing() {
        let mut b = barrier(false);
        assert!(!hear(&mut b, report(3, 5)));
        assert!(!b.answer(HostId(0), done(0, 5, 1)));
        assert!(!b.answer(HostId(0), done(0, 5, 0)) && b.answer(HostId(1), done(1, 5, 0)));
        assert_eq!((b.take_gathered().reports.len(), b.strays()), (0, 2));
    }

    #[test]
    fn who_takes_over_says_the_same_once_more() {
        let mut b = barrier(true);
        b.answer(HostId(0), done(0, 5, 1));
        hear(&mut b, report(3, 5));
        let heir = Places {
            host: HostId(2),
            ..b.roster().places(0)
        };
        b.roster().replace(HostId(0), heir);
        assert!(!b.answer(HostId(0), done(0, 5, 1)), "it has no say any more");
        assert!(!b.report(HostId(2), report(3, 5)) && !b.answer(HostId(2), done(2, 5, 1)));
        assert!(b.answer(HostId(1), done(1, 5, 0)));
        assert_eq!(b.take_gathered().reports.len(), 1);
        b.answer(HostId(2), done(2, 5, 1));
        assert_eq!(b.strays(), 1, "what is late is no stray");
    }

    #[test]
    fn a_wake_up_waits_for_its_device() {
        let not_woken = |tti| Answer::NotWoken {
            device: DeviceId(3),
            tti: Tti(tti),
            failure: None,
        };
        let mut b = Barrier::new(roster());
        b.expect_wake(Tti(5), DeviceId(3));
        assert!(!hear(&mut b, report(4, 5)));
        assert!(!b.answer(HostId(0), not_woken(4)));
        assert!(!b.answer(HostId(1), not_woken(5)), "another host's device");
        assert_eq!(b.waiting(), [HostId(0)]);
        assert!(b.answer(HostId(0), not_woken(5)));
        assert_eq!(b.take_outcome(), WakeOutcome::Unheard);
    }
}
