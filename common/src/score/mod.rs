//! The score of a run: what every event came to, the control channel, the run's fingerprint, and the metrics at the
//! end.
//!
//! The score is told what happens, in order, and decides nothing.

mod digest;
mod metrics;
mod records;

pub use digest::{Digest, Fingerprint};
pub use metrics::{Metric, Metrics, markdown};
pub use records::{Accounts, EventRecord, WindowRecord};

use crate::deployment::Deployment;
use crate::event::{ActiveEvent, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::message::{Failure, PlanUpdate, Report, WakeOutcome};
use crate::scenario::Scenario;
use crate::totals::{ControlTotals, DeviceTotals, EventTally, EventTotals, PICO_PER_INFORMATION, Totals};
use crate::units::Energy;

/// The event under way and what has come of it.
#[derive(Clone, Copy, Debug)]
struct Current {
    event: ActiveEvent,
    tally: EventTally,
}

/// The score of a run under way.
#[derive(Clone, Debug)]
pub struct Score {
    warm_up_end: Tti,
    e_tx: Vec<Energy>,
    current: Option<Current>,
    events: EventTotals,
    control: ControlTotals,
    fingerprint: Fingerprint,
}

/// A finished score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Final {
    /// The run's fingerprint.
    pub digest: Digest,
    /// The metrics of the measured part.
    pub metrics: Metrics,
    /// The exact totals behind them.
    pub totals: Totals,
}

impl Score {
    /// The score of `scenario` before TTI 0, with its devices as in `deployment`.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        Self {
            warm_up_end: scenario.warm_up_end(),
            e_tx: deployment.devices.iter().map(|d| d.energy.e_tx).collect(),
            current: None,
            events: EventTotals::default(),
            control: ControlTotals::default(),
            fingerprint: Fingerprint::default(),
        }
    }

    /// Sums over the counted events that have ended.
    pub const fn events(&self) -> &EventTotals {
        &self.events
    }

    /// δ goes out on the air, `bytes` long; `is_new` where it differs from the plan before.
    pub fn plan(&mut self, update: &PlanUpdate, is_new: bool, bytes: u64) {
        if is_new {
            self.fingerprint.plan(update);
        }
        self.count_control(update.from, bytes);
    }

    /// An event has started.
    pub fn event_started(&mut self, event: ActiveEvent) {
        self.fingerprint.event_started(event.start, &event.stimulus);
        self.current = Some(Current {
            event,
            tally: EventTally::default(),
        });
    }

    /// A device with δ = 1 has reported the event.
    pub fn reported(&mut self, report: &Report) {
        self.fingerprint.report(report);
        self.tally().reports += 1;
    }

    /// A device with δ = 1 has detected the event and could not transmit.
    pub fn failed(&mut self, failure: &Failure) {
        let tally = self.tally();
        tally.wrong_activations += 1;
        tally.wasted += failure.drained;
    }

    /// A wake-up goes out on the air in `tti`, `bytes` long.
    pub fn wake_up(&mut self, tti: Tti, bytes: u64) {
        self.tally().wake_ups += 1;
        self.count_control(tti, bytes);
    }

    /// What came of the wake-up of `device`, which is farther than d_max from the event if it `is_far`.
    pub fn woken(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome, is_far: bool) {
        self.fingerprint.wake_up(tti, device, outcome);
        let e_tx = self.e_tx[device.index()];
        let tally = self.tally();
        match outcome {
            WakeOutcome::Reported(_) => {
                tally.reports += 1;
                tally.wrong_activations += u64::from(is_far);
                tally.wasted += if is_far { e_tx } else { Energy::ZERO };
            }
            WakeOutcome::Failed(failure) => {
                tally.wrong_activations += 1;
                tally.wasted += failure.drained;
            }
            WakeOutcome::Unheard => {}
        }
    }

    /// Whether the event under way has reached the base station.
    pub fn is_reported(&self) -> bool {
        self.current.is_some_and(|current| current.tally.reports > 0)
    }

    /// The event under way has ended with `information` I_i at the base station; `last` is its last TTI.
    ///
    /// # Panics
    /// While no event is under way.
    pub fn event_ended(&mut self, last: Tti, information: f64) -> EventRecord {
        let Current { event, mut tally } = self.current.take().expect("an event is under way");
        tally.information_pico = (information * PICO_PER_INFORMATION).round() as u64;
        self.fingerprint.event_ended(last, &tally);
        let ActiveEvent { stimulus, start, .. } = event;
        let Stimulus { event, epicentre } = stimulus;
        let counted = start >= self.warm_up_end;
        if counted {
            self.events.count(&tally);
        }
        EventRecord {
            event,
            epicentre,
            start,
            last,
            counted,
            tally,
        }
    }

    /// The score of a run of `scenario` that ended before TTI `end`. `ledgers` are the devices' totals in the order of
    /// ids, `at_warm_up` their sum at the end of the warm-up (`None` if the run did not get there).
    pub fn finish(
        self,
        scenario: &Scenario,
        end: Tti,
        ledgers: &[DeviceTotals],
        at_warm_up: Option<DeviceTotals>,
    ) -> Final {
        let total: DeviceTotals = ledgers.iter().copied().sum();
        let totals = Totals {
            devices: ledgers.len() as u64,
            ttis: end.0.saturating_sub(self.warm_up_end.0),
            events: self.events,
            control: self.control,
            energy: at_warm_up.map_or_else(DeviceTotals::default, |before| total - before),
        };
        let alpha = scenario
            .events
            .mean_start_probability(scenario.seed, self.warm_up_end, end);
        Final {
            digest: self.fingerprint.finish(ledgers, &totals),
            metrics: Metrics::of(alpha, &totals),
            totals,
        }
    }

    fn tally(&mut self) -> &mut EventTally {
        &mut self.current.as_mut().expect("an event is under way").tally
    }

    fn count_control(&mut self, tti: Tti, bytes: u64) {
        if tti >= self.warm_up_end {
            self.control.messages += 1;
            self.control.bytes += bytes;
        }
    }
}
