//! What the BS waits for: the answers of all hosts to a grant, the outcome of a wake-up, or the ledgers at the end.
//!
//! Answers are counted by host and TTI, so one that comes twice, late, or from nobody changes nothing.

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Answer, Failure, Report, WakeOutcome};
use reveille_common::metrics::DeviceTotals;

/// The answers to one grant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gathered {
    /// The reports of all devices, in the order of arrival.
    pub reports: Vec<Report>,
    /// The devices that could not transmit.
    pub failures: Vec<Failure>,
    /// Sums over all devices, where the grant asked for them.
    pub totals: DeviceTotals,
}

/// What is being waited for.
#[derive(Clone, Debug)]
enum Stage {
    Nothing,
    Grant {
        tti: Tti,
        /// Whether devices may report.
        stimulus: bool,
        waiting: Waiting,
        expected: usize,
        gathered: Gathered,
    },
    Wake {
        tti: Tti,
        device: DeviceId,
        outcome: Option<WakeOutcome>,
    },
    Finish {
        waiting: Waiting,
        ledgers: Vec<DeviceTotals>,
    },
}

/// The hosts that have not answered yet.
#[derive(Clone, Debug)]
struct Waiting {
    is_awaited: Vec<bool>,
    count: usize,
}

impl Waiting {
    fn for_all(hosts: &[HostId]) -> Self {
        let mut is_awaited = vec![false; hosts.iter().map(|host| host.index() + 1).max().unwrap_or(0)];
        for host in hosts {
            is_awaited[host.index()] = true;
        }
        Self {
            is_awaited,
            count: hosts.len(),
        }
    }

    fn holds(&self, host: HostId) -> bool {
        self.is_awaited.get(host.index()).copied().unwrap_or(false)
    }

    /// Takes `host` off the list, on which it is.
    fn strike(&mut self, host: HostId) {
        self.is_awaited[host.index()] = false;
        self.count -= 1;
    }

    const fn is_empty(&self) -> bool {
        self.count == 0
    }
}

/// The barrier at the end of each TTI.
#[derive(Debug)]
pub struct Barrier {
    devices: u32,
    hosts: Vec<HostId>,
    stage: Stage,
    strays: u64,
}

impl Barrier {
    /// A barrier for `devices` devices that waits for nothing yet.
    pub const fn new(devices: u32) -> Self {
        Self {
            devices,
            hosts: Vec::new(),
            stage: Stage::Nothing,
            strays: 0,
        }
    }

    /// The hosts to wait for from now on.
    pub fn set_hosts(&mut self, hosts: Vec<HostId>) {
        self.hosts = hosts;
    }

    /// Waits for the answers to a grant that ends with `tti`. Without a `stimulus` no device has anything to report.
    pub fn expect_grant(&mut self, tti: Tti, stimulus: bool) {
        self.stage = Stage::Grant {
            tti,
            stimulus,
            waiting: Waiting::for_all(&self.hosts),
            expected: 0,
            gathered: Gathered::default(),
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
        let ledgers = vec![DeviceTotals::default(); self.devices as usize];
        self.stage = Stage::Finish {
            waiting: Waiting::for_all(&self.hosts),
            ledgers,
        };
    }

    /// A report has come. Whether that was the last thing waited for.
    pub fn report(&mut self, report: Report) -> bool {
        match &mut self.stage {
            Stage::Grant {
                tti,
                stimulus: true,
                gathered,
                ..
            } if report.tti == *tti && report.device.0 < self.devices => {
                if gathered.reports.iter().all(|r| r.device != report.device) {
                    gathered.reports.push(report);
                }
            }
            Stage::Wake { tti, device, outcome } if report.tti == *tti && report.device == *device => {
                *outcome = Some(WakeOutcome::Reported(report));
            }
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => self.strays += 1,
        }
        self.is_complete()
    }

    /// An answer has come. Whether that was the last thing waited for.
    pub fn answer(&mut self, answer: Answer) -> bool {
        match (&mut self.stage, answer) {
            (
                Stage::Grant {
                    tti,
                    waiting,
                    expected,
                    gathered,
                    ..
                },
                Answer::Done {
                    host,
                    tti: answered,
                    reports,
                    failures,
                    totals,
                },
            ) if answered == *tti && waiting.holds(host) => {
                waiting.strike(host);
                *expected += reports as usize;
                gathered.failures.extend(failures);
                gathered.totals += totals.unwrap_or_default();
            }
            (
                Stage::Wake { tti, device, outcome },
                Answer::NotWoken {
                    device: who,
                    tti: when,
                    failure,
                },
            ) if when == *tti && who == *device => {
                *outcome = Some(failure.map_or(WakeOutcome::Unheard, WakeOutcome::Failed));
            }
            (Stage::Finish { waiting, ledgers: all }, Answer::Final { host, ledgers }) if waiting.holds(host) => {
                waiting.strike(host);
                for (device, ledger) in ledgers {
                    if let Some(slot) = all.get_mut(device.index()) {
                        *slot = ledger;
                    }
                }
            }
            (Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. }, _) => self.strays += 1,
        }
        self.is_complete()
    }

    /// Whether everything waited for has come.
    pub fn is_complete(&self) -> bool {
        match &self.stage {
            Stage::Nothing => true,
            Stage::Grant {
                waiting,
                expected,
                gathered,
                ..
            } => waiting.is_empty() && gathered.reports.len() >= *expected,
            Stage::Wake { outcome, .. } => outcome.is_some(),
            Stage::Finish { waiting, .. } => waiting.is_empty(),
        }
    }

    /// Takes the answers to the grant.
    ///
    /// # Panics
    /// If no grant is complete.
    pub fn take_gathered(&mut self) -> Gathered {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Grant { waiting, gathered, .. } if waiting.is_empty() => gathered,
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
    pub fn take_ledgers(&mut self) -> Vec<DeviceTotals> {
        match std::mem::replace(&mut self.stage, Stage::Nothing) {
            Stage::Finish { waiting, ledgers } if waiting.is_empty() => ledgers,
            Stage::Nothing | Stage::Grant { .. } | Stage::Wake { .. } | Stage::Finish { .. } => {
                panic!("the ledgers are not complete")
            }
        }
    }

    /// Messages that nobody waited for.
    pub const fn strays(&self) -> u64 {
        self.strays
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::units::Energy;

    use super::*;

    fn done(host: u32, tti: u64, reports: u32) -> Answer {
        Answer::Done {
            host: HostId(host),
            tti: Tti(tti),
            reports,
            failures: vec![],
            totals: None,
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

    fn barrier() -> Barrier {
        let mut barrier = Barrier::new(10);
        barrier.set_hosts(vec![HostId(0), HostId(1)]);
        barrier
    }

    #[test]
    fn a_grant_waits_for_every_host_and_every_report() {
        let mut b = barrier();
        b.expect_grant(Tti(5), true);
        assert!(!b.answer(done(0, 5, 2)));
        assert!(!b.answer(done(0, 5, 2)), "the same answer twice");
        assert!(!b.answer(done(7, 5, 0)), "a host that nobody knows");
        assert!(!b.answer(done(1, 4, 0)), "an answer to another grant");
        assert!(!b.answer(done(1, 5, 0)));
        assert!(!b.report(report(3, 5)));
        assert!(!b.report(report(3, 5)), "the same report twice");
        assert!(!b.report(report(4, 4)), "a report of another TTI");
        assert!(!b.report(report(10, 5)), "a report of a device that is not there");
        assert!(b.report(report(4, 5)));
        assert_eq!(b.take_gathered().reports.len(), 2);
        assert_eq!(b.strays(), 5);
    }

    #[test]
    fn nobody_reports_on_nothing() {
        let mut b = barrier();
        b.expect_grant(Tti(5), false);
        assert!(!b.report(report(3, 5)));
        assert!(!b.answer(done(0, 5, 0)) && b.answer(done(1, 5, 0)));
        assert_eq!((b.take_gathered().reports.len(), b.strays()), (0, 1));
    }

    #[test]
    fn a_wake_up_waits_for_its_device() {
        let mut b = barrier();
        b.expect_wake(Tti(5), DeviceId(3));
        assert!(!b.report(report(4, 5)));
        assert!(!b.answer(Answer::NotWoken {
            device: DeviceId(3),
            tti: Tti(4),
            failure: None
        }));
        assert!(b.answer(Answer::NotWoken {
            device: DeviceId(3),
            tti: Tti(5),
            failure: None
        }));
        assert_eq!(b.take_outcome(), WakeOutcome::Unheard);
    }
}
