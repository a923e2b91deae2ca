//! One question of the BS to a host, answered when the last of the devices concerned has done its part.

use std::sync::{Mutex, MutexGuard, PoisonError};

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Answer, Failure, Report};
use reveille_common::metrics::DeviceTotals;
use reveille_common::units::Energy;

use crate::uplink::Uplink;

/// What is asked of the devices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Question {
    /// A grant that ends with this TTI.
    Grant(Tti),
    /// The ledgers.
    Ledgers,
}

/// The answer in the making.
pub struct Round {
    host: HostId,
    question: Question,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Devices that have still to do their part, and one for the host while it hands the question out.
    pending: usize,
    reports: Vec<Report>,
    failures: Vec<Failure>,
    totals: Option<DeviceTotals>,
    levels: Vec<(DeviceId, Energy)>,
    ledgers: Vec<(DeviceId, DeviceTotals)>,
}

/// What one device adds to the answer.
pub enum Part {
    /// It sent a report.
    Reported(Report),
    /// It could not transmit.
    Failed(Failure),
    /// Its battery level.
    Level(DeviceId, Energy),
    /// Its sums.
    Totals(DeviceId, DeviceTotals),
    /// Nothing.
    Nothing,
}

impl State {
    /// The levels in the order of ids, if they were asked for.
    fn batteries(&self) -> Option<Vec<Energy>> {
        let mut levels = self.levels.clone();
        levels.sort_unstable_by_key(|(device, _)| *device);
        (!levels.is_empty()).then(|| levels.into_iter().map(|(_, level)| level).collect())
    }
}

impl Round {
    /// A question to `parts` devices.
    pub fn new(host: HostId, question: Question, parts: usize) -> Self {
        Self {
            host,
            question,
            state: Mutex::new(State {
                pending: parts + 1,
                ..State::default()
            }),
        }
    }

    /// Adds one device's part, or the host's own; the last one sends the answer.
    pub fn add(&self, part: &Part, uplink: &Uplink) {
        let mut state = self.lock();
        match part {
            Part::Reported(report) => state.reports.push(*report),
            Part::Failed(failure) => state.failures.push(*failure),
            Part::Level(device, level) => state.levels.push((*device, *level)),
            Part::Totals(device, totals) => match self.question {
                Question::Grant(_) => state.totals = Some(state.totals.unwrap_or_default() + *totals),
                Question::Ledgers => state.ledgers.push((*device, *totals)),
            },
            Part::Nothing => {}
        }
        state.pending -= 1;
        if state.pending == 0 {
            let answer = self.answer(&state);
            drop(state);
            uplink.answer(&answer);
        }
    }

    /// Sends everything once more, for a BS that asks again. Does nothing while the answer is still in the making.
    pub fn repeat(&self, uplink: &Uplink) {
        let state = self.lock();
        if state.pending > 0 {
            return;
        }
        let (answer, reports) = (self.answer(&state), state.reports.clone());
        drop(state);
        for report in &reports {
            uplink.report(report);
        }
        uplink.answer(&answer);
    }

    /// What was asked.
    pub const fn question(&self) -> Question {
        self.question
    }

    fn answer(&self, state: &State) -> Answer {
        match self.question {
            Question::Grant(tti) => Answer::Done {
                host: self.host,
                tti,
                reports: state.reports.len() as u32,
                failures: state.failures.clone(),
                totals: state.totals,
                batteries: state.batteries(),
            },
            Question::Ledgers => Answer::Final {
                host: self.host,
                ledgers: state.ledgers.clone(),
            },
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
