//! One question of the BS to a host, answered when the last of the devices concerned has done its part.

use std::sync::{Mutex, MutexGuard, PoisonError};

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{Answer, Failure, Report};
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};

use crate::follower::Question;
use crate::host::uplink::Uplink;

/// The answer in the making.
pub struct Round {
    host: HostId,
    question: Question,
    parts: Mutex<Parts>,
}

/// What the devices have added so far.
#[derive(Default)]
struct Parts {
    /// Devices that have still to do their part, and one for the host while it hands the question out.
    pending: usize,
    reports: Vec<Report>,
    failures: Vec<Failure>,
    totals: Option<DeviceTotals>,
    views: Vec<(DeviceId, DeviceView)>,
    ledgers: Vec<(DeviceId, Ledger)>,
}

/// What one device adds to the answer.
pub enum Part {
    /// The device sent a report.
    Reported(Report),
    /// The device could not transmit.
    Failed(Failure),
    /// A device, its state and battery.
    View(DeviceId, DeviceView),
    /// A device and its books.
    Books(DeviceId, Box<Ledger>),
    /// Nothing to tell.
    Nothing,
}

impl Parts {
    /// The views in the order of ids, if they were asked for.
    fn views(&self) -> Option<Vec<DeviceView>> {
        let mut views = self.views.clone();
        views.sort_unstable_by_key(|(device, _)| *device);
        (!views.is_empty()).then(|| views.into_iter().map(|(_, view)| view).collect())
    }
}

impl Round {
    /// A question to `parts` devices.
    pub fn new(host: HostId, question: Question, parts: usize) -> Self {
        Self {
            host,
            question,
            parts: Mutex::new(Parts {
                pending: parts + 1,
                ..Parts::default()
            }),
        }
    }

    /// Adds one device's part, or the host's own; the last one sends the answer.
    pub fn add(&self, part: &Part, uplink: &Uplink) {
        if let Some(answer) = self.take(part) {
            uplink.answer(&answer);
        }
    }

    /// Sends everything once more, for a BS that asks again. Does nothing while the answer is still in the making.
    pub fn repeat(&self, uplink: &Uplink) {
        if let Some((reports, answer)) = self.whole() {
            for report in &reports {
                uplink.report(report);
            }
            uplink.answer(&answer);
        }
    }

    /// Takes in a part; gives the answer when it is the last.
    fn take(&self, part: &Part) -> Option<Answer> {
        let mut parts = self.lock();
        match part {
            Part::Reported(report) => parts.reports.push(*report),
            Part::Failed(failure) => parts.failures.push(*failure),
            Part::View(device, view) => parts.views.push((*device, *view)),
            Part::Books(device, ledger) => match self.question {
                Question::Grant(_) => parts.totals = Some(parts.totals.unwrap_or_default() + ledger.whole),
                Question::Ledgers => parts.ledgers.push((*device, **ledger)),
            },
            Part::Nothing => {}
        }
        parts.pending -= 1;
        (parts.pending == 0).then(|| self.answer(&parts))
    }

    /// All reports and the answer, once the last part is in.
    fn whole(&self) -> Option<(Vec<Report>, Answer)> {
        let parts = self.lock();
        (parts.pending == 0).then(|| (parts.reports.clone(), self.answer(&parts)))
    }

    fn answer(&self, parts: &Parts) -> Answer {
        match self.question {
            Question::Grant(tti) => Answer::Done {
                host: self.host,
                tti,
                reports: parts.reports.len() as u32,
                failures: parts.failures.clone(),
                totals: parts.totals,
                views: parts.views(),
            },
            Question::Ledgers => Answer::Final {
                host: self.host,
                ledgers: parts.ledgers.clone(),
            },
        }
    }

    fn lock(&self) -> MutexGuard<'_, Parts> {
        self.parts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests;
