//! The score of a run: the results of events, the control traffic, the digest, and the metrics at the end.
//!
//! The score receives the history of the run in order and decides nothing. `bs/src/cycle.rs` feeds it during a run,
//! `view/src/reconstruction.rs` from a recording; equal calls must give an equal digest. [`Score`] is the entry point.
//! `tests/src/reference/world.rs` counts the same a second time.

mod devices;
mod digest;
mod metrics;
mod windows;

use std::collections::BTreeMap;

pub use devices::{ClassRecord, DeviceRecord, EventActivity};
pub use digest::{DIGEST_VERSION, Digest, DigestBuilder};
pub use metrics::{Metric, MetricGroup, Metrics, markdown_table};
pub use windows::{WindowAccumulator, WindowRecord};

use crate::codec;
use crate::deployment::Deployment;
use crate::event::{ActiveEvent, EventRecord, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::message::{
    Change, DeviceRemoval, FailedTransmission, OperatorAction, PlanUpdate, Report, Setting, UnableDetectors,
    WakeOutcome,
};
use crate::scenario::Scenario;
use crate::sensing::Sensing;
use crate::totals::{
    EventTally, EventTotals, Ledger, MessageTotals, MissCause, MissedEvents, PICO_PER_INFORMATION, RadioLosses, Spread,
    Totals,
};
use crate::units::Energy;

/// The active event and its results so far.
#[derive(Clone, Copy, Debug)]
struct OpenEvent {
    active_event: ActiveEvent,
    tally: EventTally,
    /// The last condition for a report that a device did not meet. Failed transmissions are only in `tally`.
    last_obstacle: Option<MissCause>,
    /// The TTI of its last wake-ups, and their number in that TTI.
    last_wake_ups: (Tti, u64),
    /// The number of those wake-ups up to the last one that brought a report.
    wake_ups_until_last_report: u64,
    /// Number of devices woken for it that woke after its end.
    late_wake_ups: u64,
}

impl OpenEvent {
    fn add_obstacle(&mut self, obstacle: MissCause) {
        self.last_obstacle = self.last_obstacle.max(Some(obstacle));
    }
}

/// The score of an unfinished run. Records of reports, failed transmissions and wake-ups panic unless an event is
/// active.
#[derive(Clone, Debug)]
pub struct Score {
    warm_up_end: Tti,
    /// The devices as deployed; [`Self::finish`] fills in their ledgers.
    devices: Vec<DeviceRecord>,
    /// Cost of a report, by device.
    e_tx: Vec<Energy>,
    seed: u64,
    sensing: Sensing,
    current: Option<OpenEvent>,
    /// Activities of devices during the active event, in order; a device can have several entries.
    activities: Vec<(DeviceId, EventActivity)>,
    events: EventTotals,
    missed: MissedEvents,
    delays: DelayHistogram,
    control: MessageTotals,
    uplink: MessageTotals,
    losses: RadioLosses,
    /// TTIs from a wake-up to its report.
    wake_latency: u64,
    /// TTIs from the first to the last report, summed over the counted events.
    wake_up_span_ttis: u64,
    removals: Vec<DeviceRemoval>,
    /// The devices that have failed, each with the TTI since when.
    failed_since: BTreeMap<DeviceId, Tti>,
    /// The changes of α, each with its TTI, in order.
    event_rates: Vec<(Tti, f64)>,
    digest: DigestBuilder,
}

/// A finished score.
#[derive(Clone, Debug, PartialEq)]
pub struct FinalScore {
    /// The digest of the run.
    pub digest: Digest,
    /// The metrics of the measured TTIs.
    pub metrics: Metrics,
    /// The α of `info_p1`: the mean probability that an event starts, over the measured TTIs.
    pub start_probability: f64,
    /// The exact totals from which the metrics follow.
    pub totals: Totals,
    /// The results of each device, in the order of ids.
    pub devices: Vec<DeviceRecord>,
}

impl Score {
    /// Creates the score of `scenario` before TTI 0, with its devices as in `deployment`.
    pub fn new<P>(scenario: &Scenario<P>, deployment: &Deployment) -> Self {
        let deployed = deployment.devices.iter().zip(&deployment.classes);
        let devices = deployed.map(|(setup, &class)| DeviceRecord {
            device: setup.id,
            position: setup.position,
            class,
            ledger: Ledger::default(),
            activity: EventActivity::default(),
        });
        Self {
            warm_up_end: scenario.warm_up_end(),
            devices: devices.collect(),
            e_tx: deployment.devices.iter().map(|d| d.energy.e_tx).collect(),
            seed: scenario.run.seed,
            sensing: scenario.sensing.clone(),
            current: None,
            activities: Vec::new(),
            events: EventTotals::default(),
            missed: MissedEvents::default(),
            delays: DelayHistogram::default(),
            control: MessageTotals::default(),
            uplink: MessageTotals::default(),
            losses: RadioLosses::default(),
            wake_latency: scenario.radio.wake_latency,
            wake_up_span_ttis: 0,
            removals: Vec::new(),
            failed_since: BTreeMap::new(),
            event_rates: Vec::new(),
            digest: DigestBuilder::default(),
        }
    }

    /// Returns the sums over the counted events that have ended.
    pub const fn events(&self) -> &EventTotals {
        &self.events
    }

    /// Records a δ plan of `bytes` bytes sent on the air; `is_new` if it differs from the plan before.
    pub fn record_plan(&mut self, update: &PlanUpdate, is_new: bool, bytes: u64) {
        // A plan that is sent again for synchronisation costs control traffic, but changes nothing in the run.
        if is_new {
            self.digest.add_plan(update);
        }
        self.count_control(update.from, bytes);
    }

    /// Records that `missed` of the `devices` addressed in TTI `from` did not receive the last plan sent.
    pub fn record_missed_plans(&mut self, from: Tti, devices: u64, missed: u64) {
        if from >= self.warm_up_end {
            self.losses.sent_plans += devices;
            self.losses.missed_plans += missed;
        }
    }

    /// Records the start of an event.
    pub fn record_event_start(&mut self, event: ActiveEvent) {
        self.digest.add_event_start(event.start, &event.stimulus);
        self.current = Some(OpenEvent {
            active_event: event,
            tally: EventTally::default(),
            last_obstacle: None,
            last_wake_ups: (Tti::NEVER, 0),
            wake_ups_until_last_report: 0,
            late_wake_ups: 0,
        });
        self.activities.clear();
    }

    /// Records a report from a device with δ = 1.
    pub fn record_report(&mut self, report: &Report) {
        self.digest.add_report(report);
        self.count_uplink(report);
        self.open_event().tally.reports += 1;
        self.add_activity(report.device, EventActivity::REPORT);
    }

    /// Records a lost report from a device with δ = 1.
    pub fn record_lost_report(&mut self, report: &Report) {
        self.digest.add_lost_report(report);
        self.count_lost_report(report);
    }

    /// Records that a device with δ = 1 detected the event and could not transmit.
    pub fn record_failed_transmission(&mut self, failure: &FailedTransmission) {
        self.count_wrong_activation(failure.device, failure.drained_energy);
    }

    /// Records the devices that would have detected the event in this TTI, but could not sense.
    pub fn record_unable_detectors(&mut self, unable: UnableDetectors) {
        let Some(current) = &mut self.current else { return };
        if unable.failed > 0 {
            current.add_obstacle(MissCause::Failed);
        }
        if unable.unpowered > 0 {
            current.add_obstacle(MissCause::Unpowered);
        }
    }

    /// Records the removal of devices.
    pub fn record_removal(&mut self, removal: &DeviceRemoval) {
        self.digest.add_removal(removal);
        self.removals.push(*removal);
    }

    /// Whether `device` is removed.
    pub fn is_removed(&self, device: DeviceId) -> bool {
        self.removals.iter().any(|removal| removal.contains(device))
    }

    /// Records an action, which must precede everything else of its TTI.
    pub fn record_action(&mut self, action: &OperatorAction) {
        self.digest.add_action(action);
        let tti = action.tti;
        match action.change {
            Change::Fail(devices) => devices.devices().for_each(|device| {
                self.failed_since.entry(device).or_insert(tti);
            }),
            Change::Revive(devices) => self.failed_since.retain(|device, _| !devices.contains(*device)),
            Change::Set(Setting::EventRate, alpha) => self.event_rates.push((tti, alpha)),
            Change::AddEnergy(..) | Change::Set(Setting::Price, _) => {}
        }
    }

    /// Returns the mean of α over the measured TTIs before `end`, with `alpha` up to the first change.
    fn mean_event_rate(&self, alpha: f64, end: Tti) -> f64 {
        let measured_ttis = end.0.saturating_sub(self.warm_up_end.0);
        if self.event_rates.is_empty() || measured_ttis == 0 {
            return alpha;
        }
        let (mut rate, mut from, mut sum) = (alpha, self.warm_up_end, 0.0);
        for &(tti, next_rate) in self.event_rates.iter().chain(&[(end, alpha)]) {
            let until = tti.max(from).min(end);
            sum += rate * (until - from) as f64;
            (rate, from) = (next_rate, until);
        }
        sum / measured_ttis as f64
    }

    /// Records a wake-up of `bytes` bytes sent on the air in `tti`.
    pub fn record_wake_up(&mut self, tti: Tti, bytes: u64) {
        let current = self.open_event();
        current.tally.wake_ups += 1;
        // An event whose reports are lost stays open, and its wake-ups are counted from 0 in the next TTI.
        let sent_before = if current.last_wake_ups.0 == tti {
            current.last_wake_ups.1
        } else {
            0
        };
        current.last_wake_ups = (tti, sent_before + 1);
        self.count_control(tti, bytes);
    }

    /// Records the outcome of the last wake-up of [`Self::record_wake_up`], which went to `device`; `is_far` if the
    /// device is farther than d_max from the event.
    pub fn record_wake_up_outcome(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome, is_far: bool) {
        self.digest.add_wake_up(tti, device, outcome);
        let is_measured = tti >= self.warm_up_end;
        self.losses.sent_wake_ups += u64::from(is_measured);
        match outcome {
            WakeOutcome::Reported(report) => {
                self.count_uplink(report);
                let current = self.open_event();
                current.tally.reports += 1;
                // The wake-up span ends with the last report, not with later wake-ups that bring none.
                current.wake_ups_until_last_report = current.last_wake_ups.1;
                self.add_activity(device, EventActivity::WOKEN_REPORT);
                self.count_far_report(device, is_far);
            }
            WakeOutcome::Lost(report) => {
                self.count_lost_report(report);
                self.add_activity(device, EventActivity::WOKEN);
                self.count_far_report(device, is_far);
            }
            WakeOutcome::Failed(failure) => {
                self.add_activity(device, EventActivity::WOKEN);
                self.count_wrong_activation(device, failure.drained_energy);
            }
            WakeOutcome::Late { spent, .. } => {
                self.losses.late_wake_ups += u64::from(is_measured);
                self.open_event().late_wake_ups += 1;
                self.add_activity(device, EventActivity::WOKEN);
                self.count_wrong_activation(device, *spent);
            }
            WakeOutcome::Missed => {
                self.losses.missed_wake_ups += u64::from(is_measured);
                self.open_event().add_obstacle(MissCause::WakeMissed);
                self.add_activity(device, EventActivity::MISSED_WAKE_UP);
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
    pub fn record_event_end(&mut self, last: Tti, information: f64) -> EventRecord {
        let open = self.current.take().expect("an event is active");
        let OpenEvent {
            active_event,
            mut tally,
            wake_ups_until_last_report,
            ..
        } = open;
        // Whole 10⁻¹² units: integer sums over events do not depend on their order.
        tally.information_pico = (information * PICO_PER_INFORMATION).round() as u64;
        self.digest.add_event_end(last, &tally);
        let ActiveEvent { stimulus, start, .. } = active_event;
        let Stimulus { event, epicentre } = stimulus;
        let record = EventRecord {
            event,
            epicentre,
            start,
            last,
            // An event belongs to the TTI in which it starts, even if it ends after the warm-up.
            counted: start >= self.warm_up_end,
            tally,
            miss_cause: (tally.reports == 0).then(|| self.miss_cause(&open)),
        };
        if record.counted {
            let delay = record.delay();
            self.events.count(&tally, delay);
            if let Some(delay) = delay {
                self.delays.count(delay);
                // Wake-ups go out one latency apart, so answer n arrives n latencies after the first report.
                self.wake_up_span_ttis += wake_ups_until_last_report * self.wake_latency;
            }
            if let Some(cause) = record.miss_cause {
                self.missed.count(cause);
            }
            // Added only here, because an event that is still open at the end of the run is not counted.
            for (device, activity) in &self.activities {
                self.devices[device.index()].activity += *activity;
            }
        }
        record
    }

    /// Finishes the score of a run that ended before TTI `end`, with events that started with probability `alpha` in
    /// the measured TTIs, unless an action has changed it. `ledgers` has the ledgers of the devices, in the order of
    /// ids.
    pub fn finish(mut self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> FinalScore {
        let totals = self.totals(end, ledgers);
        let start_probability = self.mean_event_rate(alpha, end);
        let metrics = Metrics::from_totals(start_probability, &totals);
        for (device, ledger) in self.devices.iter_mut().zip(ledgers) {
            device.ledger = *ledger;
        }
        FinalScore {
            digest: self.digest.finish(ledgers, &totals),
            metrics,
            start_probability,
            totals,
            devices: self.devices,
        }
    }

    /// Returns the metrics of the run as if it ended before TTI `end`. See [`Self::finish`] for the arguments.
    pub fn metrics(&self, alpha: f64, end: Tti, ledgers: &[Ledger]) -> Metrics {
        Metrics::from_totals(self.mean_event_rate(alpha, end), &self.totals(end, ledgers))
    }

    fn totals(&self, end: Tti, ledgers: &[Ledger]) -> Totals {
        let measured_totals = || ledgers.iter().map(|ledger| &ledger.measured);
        let removed_ttis = |removal: &DeviceRemoval| {
            // In TTI `tti` itself the devices still harvest and pay for δ, see `DeviceRemoval`.
            let first = self.warm_up_end.0.max(removal.tti.0 + 1);
            u64::from(removal.count) * end.0.saturating_sub(first)
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
            energy: measured_totals().copied().sum(),
            spread: Spread::from_devices(measured_totals()),
            wake_up_span_ttis: self.wake_up_span_ttis,
            removed_ttis: self.removals.iter().map(removed_ttis).sum(),
        }
    }

    /// Returns the first condition for a report of `open` that no device met, in the order of [`MissCause::ALL`].
    fn miss_cause(&self, open: &OpenEvent) -> MissCause {
        // Late wake-ups are wrong activations too; only the excess over them stands for devices that could not pay.
        let has_unpaid_report = open.tally.wrong_activations > open.late_wake_ups;
        let unpaid_report = has_unpaid_report.then_some(MissCause::NoEnergy);
        if let Some(cause) = open.last_obstacle.max(unpaid_report) {
            return cause;
        }
        let ActiveEvent { stimulus, start, .. } = open.active_event;
        let mut cause = MissCause::OutOfReach;
        for device in &self.devices {
            let d = device.position.distance(stimulus.epicentre);
            if d > self.sensing.d_max {
                continue;
            }
            let is_removed = |removal: &DeviceRemoval| removal.contains(device.device) && removal.tti < start;
            let failed_since = self.failed_since.get(&device.device);
            if self.removals.iter().any(is_removed) || failed_since.is_some_and(|since| *since <= start) {
                if cause == MissCause::OutOfReach {
                    cause = MissCause::Removed;
                }
            } else if self.sensing.detects(self.seed, stimulus.event, device.device, d) {
                return MissCause::Asleep;
            } else {
                cause = MissCause::Undetected;
            }
        }
        cause
    }

    fn open_event(&mut self) -> &mut OpenEvent {
        self.current.as_mut().expect("an event is active")
    }

    fn add_activity(&mut self, device: DeviceId, activity: EventActivity) {
        self.activities.push((device, activity));
    }

    /// Counts a report of the woken `device` as a wrong activation if it comes from farther than d_max (`is_far`).
    fn count_far_report(&mut self, device: DeviceId, is_far: bool) {
        if is_far {
            // A report from beyond d_max carries no information, so its E_Tx is wasted.
            self.count_wrong_activation(device, self.e_tx[device.index()]);
        }
    }

    fn count_wrong_activation(&mut self, device: DeviceId, wasted: Energy) {
        let tally = &mut self.open_event().tally;
        tally.wrong_activations += 1;
        tally.wasted_energy += wasted;
        self.add_activity(device, EventActivity::WRONG_ACTIVATION);
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

    fn count_lost_report(&mut self, report: &Report) {
        self.open_event().add_obstacle(MissCause::Lost);
        self.losses.lost_reports += u64::from(report.tti >= self.warm_up_end);
    }
}

/// Delays below this limit, in TTIs, are counted in an array: most are short, and the map needs a search.
const SHORT_DELAYS: usize = 8;

/// Number of events by detection delay in TTIs.
#[derive(Clone, Debug, Default)]
struct DelayHistogram {
    short: [u64; SHORT_DELAYS],
    long: BTreeMap<u64, u64>,
}

impl DelayHistogram {
    fn count(&mut self, delay: u64) {
        match usize::try_from(delay).ok().and_then(|delay| self.short.get_mut(delay)) {
            Some(count) => *count += 1,
            None => *self.long.entry(delay).or_default() += 1,
        }
    }

    /// Returns the smallest delay that at least `percent` % of the delays do not exceed (nearest rank); 0 if empty.
    fn percentile(&self, percent: u64) -> u64 {
        let long = self.long.iter().map(|(&delay, &count)| (delay, count));
        // Short delays come before long ones and both ascend, so the running sum is a cumulative count.
        let counts = || (0..).zip(self.short).chain(long.clone());
        let total: u64 = counts().map(|(_, count)| count).sum();
        let rank = (total * percent).div_ceil(100);
        let mut cumulative = 0;
        let reaches = |&(_, count): &(u64, u64)| {
            cumulative += count;
            cumulative >= rank
        };
        counts().find(reaches).map_or(0, |(delay, _)| delay)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::EventId;
    use crate::message::DeviceRange;
    use crate::scenario::testing::scenario_with;

    /// Returns the cause of a missed event at the position of the only device, which failed in TTI 100. The event lasts
    /// from TTI 200 to TTI 201, in each of which these devices with δ = 1 could not sense.
    fn cause_with(unable: [UnableDetectors; 2]) -> MissCause {
        let scenario = scenario_with(&["devices=1"]);
        let deployment = Deployment::new(&scenario);
        let mut score = Score::new(&scenario, &deployment);
        let devices = DeviceRange {
            first: DeviceId(0),
            count: 1,
        };
        score.record_action(&OperatorAction {
            tti: Tti(100),
            change: Change::Fail(devices),
        });
        score.record_event_start(ActiveEvent {
            stimulus: Stimulus {
                event: EventId(0),
                epicentre: deployment.devices[0].position,
            },
            start: Tti(200),
            last: Tti(201),
        });
        for devices in unable {
            score.record_unable_detectors(devices);
        }
        score.record_event_end(Tti(201), 0.0).miss_cause.expect("missed")
    }

    #[test]
    fn a_failed_detector_comes_before_an_unpowered_one() {
        let none = UnableDetectors::default();
        let (failed, unpowered) = (UnableDetectors::FAILED, UnableDetectors::UNPOWERED);
        for (unable, expected) in [
            ([none, none], MissCause::Removed),
            ([none, failed], MissCause::Failed),
            ([failed, none], MissCause::Failed),
            ([unpowered, none], MissCause::Unpowered),
            ([failed, unpowered], MissCause::Unpowered),
            ([unpowered, failed], MissCause::Unpowered),
            ([[failed, unpowered].into_iter().sum(), none], MissCause::Unpowered),
        ] {
            assert_eq!(cause_with(unable), expected, "{unable:?}");
        }
    }

    #[test]
    fn percentiles_are_nearest_ranks() {
        let lists: [&[u64]; 5] = [
            &[],
            &[7],
            &[0, 0, 0, 3],
            &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20],
            &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9],
        ];
        let percentiles = lists.map(|list| {
            let mut delays = DelayHistogram::default();
            for &delay in list {
                delays.count(delay);
            }
            delays.percentile(95)
        });
        assert_eq!(percentiles, [0, 7, 3, 19, 0]);
    }
}
