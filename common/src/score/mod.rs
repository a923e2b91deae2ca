//! The score of a run: the results of events, the control traffic, the digest, and the metrics at the end.
//!
//! The score receives the history of the run in order and decides nothing.

mod devices;
mod digest;
mod metrics;
mod windows;

use std::collections::BTreeMap;

pub use devices::{ClassRecord, DeviceRecord, EventActivity};
pub use digest::{DIGEST_VERSION, Digest, DigestBuilder};
pub use metrics::{Metric, MetricGroup, Metrics, markdown};
pub use windows::{WindowAccumulator, WindowRecord};

use crate::codec;
use crate::deployment::Deployment;
use crate::event::{ActiveEvent, EventRecord, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::message::{DeviceRemoval, FailedTransmission, PlanUpdate, Report, WakeOutcome};
use crate::scenario::Scenario;
use crate::totals::{
    EventTally, EventTotals, Ledger, MessageTotals, MissedEvents, PICO_PER_INFORMATION, RadioLosses, Spread, Totals,
};
use crate::units::Energy;

/// The active event and its results so far.
#[derive(Clone, Copy, Debug)]
struct Current {
    event: ActiveEvent,
    tally: EventTally,
    /// Whether a report about it was lost.
    has_lost: bool,
    /// The TTI of its last wake-ups, and their number in that TTI.
    called: (Tti, u64),
    /// The number of those wake-ups up to the last one that brought a report.
    answered: u64,
    /// Number of devices that woke after its end.
    late: u64,
}

/// The score of an unfinished run.
#[derive(Clone, Debug)]
pub struct Score {
    warm_up_end: Tti,
    /// The devices as deployed, with empty ledgers.
    devices: Vec<DeviceRecord>,
    e_tx: Vec<Energy>,
    d_max: f64,
    current: Option<Current>,
    /// The activity of devices during the active event.
    acts: Vec<(DeviceId, EventActivity)>,
    events: EventTotals,
    missed: MissedEvents,
    delays: Delays,
    control: MessageTotals,
    uplink: MessageTotals,
    losses: RadioLosses,
    wake_latency: u64,
    /// TTIs from the first to the last report, summed over the counted events.
    wake_up_span_ttis: u64,
    outages: Vec<DeviceRemoval>,
    fingerprint: DigestBuilder,
}

/// A finished score.
#[derive(Clone, Debug, PartialEq)]
pub struct FinalScore {
    /// The digest of the run.
    pub digest: Digest,
    /// The metrics of the measured TTIs.
    pub metrics: Metrics,
    /// The exact totals from which the metrics follow.
    pub totals: Totals,
    /// The results of each device, in the order of ids.
    pub devices: Vec<DeviceRecord>,
}

impl Score {
    /// Creates the score of `scenario` before TTI 0, with its devices as in `deployment`.
    pub fn new<P>(scenario: &Scenario<P>, deployment: &Deployment) -> Self {
        let ground = deployment.devices.iter().zip(&deployment.classes);
        let devices = ground.map(|(setup, &class)| DeviceRecord {
            device: setup.id,
            position: setup.position,
            class,
            ledger: Ledger::default(),
            acts: EventActivity::default(),
        });
        Self {
            warm_up_end: scenario.warm_up_end(),
            devices: devices.collect(),
            e_tx: deployment.devices.iter().map(|d| d.energy.e_tx).collect(),
            d_max: scenario.sensing.d_max,
            current: None,
            acts: Vec::new(),
            events: EventTotals::default(),
            missed: MissedEvents::default(),
            delays: Delays::default(),
            control: MessageTotals::default(),
            uplink: MessageTotals::default(),
            losses: RadioLosses::default(),
            wake_latency: scenario.radio.wake_latency,
            wake_up_span_ttis: 0,
            outages: Vec::new(),
            fingerprint: DigestBuilder::default(),
        }
    }

    /// Returns the sums over the counted events that have ended.
    pub const fn events(&self) -> &EventTotals {
        &self.events
    }

    /// Records a δ plan of `bytes` bytes sent on the air; `is_new` if it differs from the plan before.
    pub fn plan(&mut self, update: &PlanUpdate, is_new: bool, bytes: u64) {
        // A plan that is sent again for synchronisation costs control traffic, but changes nothing in the run.
        if is_new {
            self.fingerprint.plan(update);
        }
        self.count_control(update.from, bytes);
    }

    /// Records that `missed` of the `devices` addressed in TTI `from` did not receive the last plan sent.
    pub fn plan_missed(&mut self, from: Tti, devices: u64, missed: u64) {
        if from >= self.warm_up_end {
            self.losses.plans += devices;
            self.losses.missed_plans += missed;
        }
    }

    /// Records the start of an event.
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

    /// Records a report from a device with δ = 1.
    pub fn reported(&mut self, report: &Report) {
        self.fingerprint.report(report);
        self.count_uplink(report);
        self.current().tally.reports += 1;
        self.act(report.device, EventActivity::REPORT);
    }

    /// Records a lost report from a device with δ = 1.
    pub fn lost(&mut self, report: &Report) {
        self.fingerprint.lost(report);
        self.count_lost(report);
    }

    /// Records that a device with δ = 1 detected the event and could not transmit.
    pub fn failed(&mut self, failure: &FailedTransmission) {
        self.wrong(failure.device, failure.drained);
    }

    /// Records the removal of devices.
    pub fn devices_removed(&mut self, outage: &DeviceRemoval) {
        self.fingerprint.devices_removed(outage);
        self.outages.push(*outage);
    }

    /// Whether `device` is removed.
    pub fn is_gone(&self, device: DeviceId) -> bool {
        self.outages.iter().any(|outage| outage.has(device))
    }

    /// Records a wake-up of `bytes` bytes sent on the air in `tti`.
    pub fn wake_up(&mut self, tti: Tti, bytes: u64) {
        let current = self.current();
        current.tally.wake_ups += 1;
        // An event whose reports are lost stays open, and its wake-ups are counted from 0 in the next TTI.
        let before = if current.called.0 == tti { current.called.1 } else { 0 };
        current.called = (tti, before + 1);
        self.count_control(tti, bytes);
    }

    /// Records the outcome of the wake-up of `device`; `is_far` if the device is farther than d_max from the event.
    pub fn wake_up_completed(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome, is_far: bool) {
        self.fingerprint.wake_up(tti, device, outcome);
        let is_measured = tti >= self.warm_up_end;
        self.losses.wake_ups += u64::from(is_measured);
        match outcome {
            WakeOutcome::Reported(report) => {
                self.count_uplink(report);
                let current = self.current();
                current.tally.reports += 1;
                // Refinement ends with the last report, not with later wake-ups that bring none.
                current.answered = current.called.1;
                self.act(device, EventActivity::WOKEN_REPORT);
                self.far(device, is_far);
            }
            WakeOutcome::Lost(report) => {
                self.count_lost(report);
                self.act(device, EventActivity::WOKEN);
                self.far(device, is_far);
            }
            WakeOutcome::Failed(failure) => {
                self.act(device, EventActivity::WOKEN);
                self.wrong(device, failure.drained);
            }
            WakeOutcome::Late { spent, .. } => {
                self.losses.late += u64::from(is_measured);
                self.current().late += 1;
                self.act(device, EventActivity::WOKEN);
                self.wrong(device, *spent);
            }
            WakeOutcome::Missed => {
                self.losses.missed_wake_ups += u64::from(is_measured);
                self.act(device, EventActivity::UNHEARD);
            }
        }
    }

    /// Whether the active event was reported to the base station.
    pub fn is_reported(&self) -> bool {
        self.current.is_some_and(|current| current.tally.reports > 0)
    }

    /// Records the end of the active event, with `information` I_i at the base station; `last` is its last TTI.
    ///
    /// # Panics
    /// If no event is active.
    pub fn event_ended(&mut self, last: Tti, information: f64) -> EventRecord {
        let Current {
            event,
            mut tally,
            has_lost,
            answered,
            late,
            ..
        } = self.current.take().expect("an event is active");
        // Whole 10⁻¹² units: integer sums over events do not depend on their order.
        tally.information_pico = (information * PICO_PER_INFORMATION).round() as u64;
        self.fingerprint.event_ended(last, &tally);
        let ActiveEvent { stimulus, start, .. } = event;
        let Stimulus { event, epicentre } = stimulus;
        let record = EventRecord {
            event,
            epicentre,
            start,
            last,
            // An event belongs to the TTI in which it starts, even if it ends after the warm-up.
            counted: start >= self.warm_up_end,
            tally,
        };
        if record.counted {
            let delay = record.delay();
            self.events.count(&tally, delay);
            match delay {
                Some(delay) => {
                    self.delays.count(delay);
                    // Wake-ups go out one latency apart, so answer n arrives n latencies after the first report.
                    self.wake_up_span_ttis += answered * self.wake_latency;
                }
                None => self.count_missed(&record, has_lost, late),
            }
            // Added only here, because an event that is still open at the end of the run is not counted.
            for (device, act) in &self.acts {
                self.devices[device.index()].acts += *act;
            }
        }
        record
    }

    /// Finishes the score of a run that ended before TTI `end`, with events that started with probability `alpha` in
    /// the measured TTIs. `ledgers` has the ledgers of the devices in the order of ids.
    pub fn finish(mut self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> FinalScore {
        let totals = self.totals(end, ledgers);
        for (device, ledger) in self.devices.iter_mut().zip(ledgers) {
            device.ledger = *ledger;
        }
        FinalScore {
            digest: self.fingerprint.finish(ledgers, &totals),
            metrics: Metrics::from_totals(alpha, &totals),
            totals,
            devices: self.devices,
        }
    }

    /// Returns the metrics of the run as if it ended before TTI `end`. See [`Self::finish`] for the arguments.
    pub fn metrics(&self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> Metrics {
        Metrics::from_totals(alpha, &self.totals(end, ledgers))
    }

    fn totals(&self, end: Tti, ledgers: &[Ledger]) -> Totals {
        let measured = || ledgers.iter().map(|ledger| &ledger.measured);
        let gone = |outage: &DeviceRemoval| {
            // In TTI `tti` itself the devices still harvest and pay for δ, see `DeviceRemoval`.
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
            spread: Spread::sum(measured()),
            wake_up_span_ttis: self.wake_up_span_ttis,
            removed_ttis: self.outages.iter().map(gone).sum(),
        }
    }

    fn count_missed(&mut self, event: &EventRecord, has_lost: bool, late: u64) {
        let is_in_reach = |device: &DeviceRecord| device.position.distance(event.epicentre) <= self.d_max;
        // Late wake-ups are wrong activations too; only the excess over them stands for devices that could not pay.
        let cause = if has_lost {
            &mut self.missed.lost
        } else if event.tally.wrong_activations > late {
            &mut self.missed.no_energy
        } else if self.devices.iter().any(is_in_reach) {
            &mut self.missed.not_sensing
        } else {
            &mut self.missed.out_of_reach
        };
        *cause += 1;
    }

    fn current(&mut self) -> &mut Current {
        self.current.as_mut().expect("an event is active")
    }

    fn act(&mut self, device: DeviceId, act: EventActivity) {
        self.acts.push((device, act));
    }

    /// Records a report of the woken `device`, from farther than d_max if `is_far`.
    fn far(&mut self, device: DeviceId, is_far: bool) {
        if is_far {
            // A report from beyond d_max carries no information, so its E_Tx is wasted.
            self.wrong(device, self.e_tx[device.index()]);
        }
    }

    fn wrong(&mut self, device: DeviceId, wasted: Energy) {
        let tally = &mut self.current().tally;
        tally.wrong_activations += 1;
        tally.wasted += wasted;
        self.act(device, EventActivity::WRONG);
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

/// Delays below this limit are counted in an array, without a search.
const SHORT: usize = 8;

/// Number of events by detection delay in TTIs.
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

    /// Returns the smallest delay that at least `percent` % of the delays do not exceed (nearest rank); 0 if empty.
    fn percentile(&self, percent: u64) -> u64 {
        let long = self.long.iter().map(|(&delay, &count)| (delay, count));
        // Short delays come before long ones and both ascend, so the running sum is a cumulative count.
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
