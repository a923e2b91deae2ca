//! The score of a run: what every event came to, the control channel, the run's fingerprint, and the metrics at the
//! end.
//!
//! The score is told what happens, in order, and decides nothing.

mod devices;
mod digest;
mod metrics;
mod records;

use std::collections::BTreeMap;

pub use devices::{Acts, ClassRecord, DeviceRecord};
pub use digest::{DIGEST_VERSION, Digest, Fingerprint};
pub use metrics::{Group, Metric, Metrics, markdown};
pub use records::{Accounts, WindowRecord};

use crate::codec;
use crate::deployment::Deployment;
use crate::event::{ActiveEvent, EventRecord, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::message::{Failure, Outage, PlanUpdate, Report, WakeOutcome};
use crate::scenario::Scenario;
use crate::totals::{EventTally, EventTotals, Ledger, Losses, Missed, PICO_PER_INFORMATION, Spread, Totals, Traffic};
use crate::units::Energy;

/// The event under way and what has come of it.
#[derive(Clone, Copy, Debug)]
struct Current {
    event: ActiveEvent,
    tally: EventTally,
    /// Whether a report about it was lost.
    has_lost: bool,
    /// The TTI in which wake-ups were sent last, and how many in it.
    called: (Tti, u64),
    /// Of those, how many until the last one that was answered.
    answered: u64,
    /// Devices that woke when it was over.
    late: u64,
}

/// The score of a run under way.
#[derive(Clone, Debug)]
pub struct Score {
    warm_up_end: Tti,
    /// Each device as it was put on the ground, with nothing in its books yet.
    devices: Vec<DeviceRecord>,
    e_tx: Vec<Energy>,
    d_max: f64,
    current: Option<Current>,
    /// What devices did for the event under way.
    acts: Vec<(DeviceId, Acts)>,
    events: EventTotals,
    missed: Missed,
    delays: Delays,
    control: Traffic,
    uplink: Traffic,
    losses: Losses,
    wake_latency: u64,
    /// TTIs from the first to the last report, summed over the counted events.
    refining_ttis: u64,
    outages: Vec<Outage>,
    fingerprint: Fingerprint,
}

/// A finished score.
#[derive(Clone, Debug, PartialEq)]
pub struct Final {
    /// The run's fingerprint.
    pub digest: Digest,
    /// The metrics of the measured part.
    pub metrics: Metrics,
    /// The exact totals behind them.
    pub totals: Totals,
    /// Each device, in the order of ids.
    pub devices: Vec<DeviceRecord>,
}

impl Score {
    /// The score of `scenario` before TTI 0, with its devices as in `deployment`.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        let ground = deployment.devices.iter().zip(&deployment.classes);
        let devices = ground.map(|(setup, &class)| DeviceRecord {
            device: setup.id,
            position: setup.position,
            class,
            ledger: Ledger::default(),
            acts: Acts::default(),
        });
        Self {
            warm_up_end: scenario.warm_up_end(),
            devices: devices.collect(),
            e_tx: deployment.devices.iter().map(|d| d.energy.e_tx).collect(),
            d_max: scenario.sensing.d_max,
            current: None,
            acts: Vec::new(),
            events: EventTotals::default(),
            missed: Missed::default(),
            delays: Delays::default(),
            control: Traffic::default(),
            uplink: Traffic::default(),
            losses: Losses::default(),
            wake_latency: scenario.radio.wake_latency,
            refining_ttis: 0,
            outages: Vec::new(),
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

    /// Of the plan that went out last, in TTI `from` to so many `devices`, `missed` of them heard nothing.
    pub fn plan_missed(&mut self, from: Tti, devices: u64, missed: u64) {
        if from >= self.warm_up_end {
            self.losses.plans += devices;
            self.losses.missed_plans += missed;
        }
    }

    /// An event has started.
    pub fn event_started(&mut self, event: ActiveEvent) {
        self.fingerprint.event_started(event.start, &event.stimulus);
        self.current = Some(Current {
            event,
            tally: EventTally::default(),
            has_lost: false,
            called: (Tti::NEVER, 0),
            answered: 0,
            late: 0,
        });
        self.acts.clear();
    }

    /// A device with δ = 1 has reported the event.
    pub fn reported(&mut self, report: &Report) {
        self.fingerprint.report(report);
        self.count_uplink(report);
        self.current().tally.reports += 1;
        self.act(report.device, Acts::REPORT);
    }

    /// A device with δ = 1 has reported the event, and the report was lost.
    pub fn lost(&mut self, report: &Report) {
        self.fingerprint.lost(report);
        self.count_lost(report);
    }

    /// A device with δ = 1 has detected the event and could not transmit.
    pub fn failed(&mut self, failure: &Failure) {
        self.wrong(failure.device, failure.drained);
    }

    /// Devices are gone.
    pub fn gone(&mut self, outage: &Outage) {
        self.fingerprint.gone(outage);
        self.outages.push(*outage);
    }

    /// Whether `device` is gone.
    pub fn is_gone(&self, device: DeviceId) -> bool {
        self.outages.iter().any(|outage| outage.has(device))
    }

    /// A wake-up goes out on the air in `tti`, `bytes` long.
    pub fn wake_up(&mut self, tti: Tti, bytes: u64) {
        let current = self.current();
        current.tally.wake_ups += 1;
        let before = if current.called.0 == tti { current.called.1 } else { 0 };
        current.called = (tti, before + 1);
        self.count_control(tti, bytes);
    }

    /// What came of the wake-up of `device`, which is farther than d_max from the event if it `is_far`.
    pub fn woken(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome, is_far: bool) {
        self.fingerprint.wake_up(tti, device, outcome);
        let is_measured = tti >= self.warm_up_end;
        self.losses.wake_ups += u64::from(is_measured);
        match outcome {
            WakeOutcome::Reported(report) => {
                self.count_uplink(report);
                let current = self.current();
                current.tally.reports += 1;
                current.answered = current.called.1;
                self.act(device, Acts::WOKEN_REPORT);
                self.far(device, is_far);
            }
            WakeOutcome::Lost(report) => {
                self.count_lost(report);
                self.act(device, Acts::WOKEN);
                self.far(device, is_far);
            }
            WakeOutcome::Failed(failure) => {
                self.act(device, Acts::WOKEN);
                self.wrong(device, failure.drained);
            }
            WakeOutcome::Late { spent, .. } => {
                self.losses.late += u64::from(is_measured);
                self.current().late += 1;
                self.act(device, Acts::WOKEN);
                self.wrong(device, *spent);
            }
            WakeOutcome::Unheard => {
                self.losses.unheard += u64::from(is_measured);
                self.act(device, Acts::UNHEARD);
            }
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
        let Current {
            event,
            mut tally,
            has_lost,
            answered,
            late,
            ..
        } = self.current.take().expect("an event is under way");
        tally.information_pico = (information * PICO_PER_INFORMATION).round() as u64;
        self.fingerprint.event_ended(last, &tally);
        let ActiveEvent { stimulus, start, .. } = event;
        let Stimulus { event, epicentre } = stimulus;
        let record = EventRecord {
            event,
            epicentre,
            start,
            last,
            counted: start >= self.warm_up_end,
            tally,
        };
        if record.counted {
            let delay = record.delay();
            self.events.count(&tally, delay);
            match delay {
                Some(delay) => {
                    self.delays.count(delay);
                    self.refining_ttis += answered * self.wake_latency;
                }
                None => self.count_missed(&record, has_lost, late),
            }
            for (device, act) in &self.acts {
                self.devices[device.index()].acts += *act;
            }
        }
        record
    }

    /// The score of a run that ended before TTI `end`, where events started with probability `alpha` in the measured
    /// TTIs. `ledgers` are the devices' books in the order of ids.
    pub fn finish(mut self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> Final {
        let totals = self.totals(end, ledgers);
        for (device, ledger) in self.devices.iter_mut().zip(ledgers) {
            device.ledger = *ledger;
        }
        Final {
            digest: self.fingerprint.finish(ledgers, &totals),
            metrics: Metrics::of(alpha, &totals),
            totals,
            devices: self.devices,
        }
    }

    /// The metrics of a run if it ended before TTI `end`, as in [`Self::finish`].
    pub fn metrics(&self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> Metrics {
        Metrics::of(alpha, &self.totals(end, ledgers))
    }

    fn totals(&self, end: Tti, ledgers: &[Ledger]) -> Totals {
        let measured = || ledgers.iter().map(|ledger| &ledger.measured);
        let gone = |outage: &Outage| {
            let first = self.warm_up_end.0.max(outage.tti.0 + 1);
            u64::from(outage.count) * end.0.saturating_sub(first)
        };
        Totals {
            devices: ledgers.len() as u64,
            ttis: end.0.saturating_sub(self.warm_up_end.0),
            events: self.events,
            missed: self.missed,
            delay_p95_ttis: self.delays.percentile(95),
            control: self.control,
            uplink: self.uplink,
            losses: self.losses,
            energy: measured().copied().sum(),
            spread: Spread::of(measured()),
            refining_ttis: self.refining_ttis,
            gone_ttis: self.outages.iter().map(gone).sum(),
        }
    }

    fn count_missed(&mut self, event: &EventRecord, has_lost: bool, late: u64) {
        let is_in_reach = |device: &DeviceRecord| device.position.distance(event.epicentre) <= self.d_max;
        let cause = if has_lost {
            &mut self.missed.lost
        } else if event.tally.wrong_activations > late {
            &mut self.missed.unpaid
        } else if self.devices.iter().any(is_in_reach) {
            &mut self.missed.unseen
        } else {
            &mut self.missed.out_of_reach
        };
        *cause += 1;
    }

    fn current(&mut self) -> &mut Current {
        self.current.as_mut().expect("an event is under way")
    }

    fn act(&mut self, device: DeviceId, act: Acts) {
        self.acts.push((device, act));
    }

    /// `device` was woken and has sent a report, from farther than d_max if it `is_far`.
    fn far(&mut self, device: DeviceId, is_far: bool) {
        if is_far {
            self.wrong(device, self.e_tx[device.index()]);
        }
    }

    fn wrong(&mut self, device: DeviceId, wasted: Energy) {
        let tally = &mut self.current().tally;
        tally.wrong_activations += 1;
        tally.wasted += wasted;
        self.act(device, Acts::WRONG);
    }

    const fn count_control(&mut self, tti: Tti, bytes: u64) {
        if tti.0 >= self.warm_up_end.0 {
            self.control.count(bytes);
        }
    }

    fn count_uplink(&mut self, report: &Report) {
        if report.tti >= self.warm_up_end {
            self.uplink.count(codec::encoded_len(report));
        }
    }

    fn count_lost(&mut self, report: &Report) {
        self.current().has_lost = true;
        self.losses.reports += u64::from(report.tti >= self.warm_up_end);
    }
}

/// Delays below this are counted without a search.
const SHORT: usize = 8;

/// How many events were reported after so many TTIs.
#[derive(Clone, Debug, Default)]
struct Delays {
    short: [u64; SHORT],
    long: BTreeMap<u64, u64>,
}

impl Delays {
    fn count(&mut self, delay: u64) {
        match usize::try_from(delay).ok().and_then(|at| self.short.get_mut(at)) {
            Some(count) => *count += 1,
            None => *self.long.entry(delay).or_default() += 1,
        }
    }

    /// The least delay that at least `percent` % of those counted do not exceed (nearest rank); 0 of none.
    fn percentile(&self, percent: u64) -> u64 {
        let long = self.long.iter().map(|(&delay, &count)| (delay, count));
        let counts = || (0..).zip(self.short).chain(long.clone());
        let all: u64 = counts().map(|(_, count)| count).sum();
        let rank = (all * percent).div_ceil(100);
        let mut so_far = 0;
        let reaches = |&(_, count): &(u64, u64)| {
            so_far += count;
            so_far >= rank
        };
        counts().find(reaches).map_or(0, |(delay, _)| delay)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_percentile_is_that_of_the_sorted_list() {
        let lists: [&[u64]; 5] = [
            &[],
            &[7],
            &[0, 0, 0, 3],
            &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20],
            &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9],
        ];
        let found = lists.map(|list| {
            let mut delays = Delays::default();
            for &delay in list {
                delays.count(delay);
            }
            delays.percentile(95)
        });
        assert_eq!(found, [0, 7, 3, 19, 0]);
    }
}
