//! The model in the reference, TTI by TTI: devices, events and their outcomes. [`play`] defines the order of the steps,
//! and each method names its step.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::{Change, OperatorAction, Setting};
use reveille_common::score::EventActivity;
use reveille_common::sensing::{DetectionKind, Fusion};
use reveille_common::totals::{EventTally, EventTotals, Ledger, MissCause, RadioLosses};
use reveille_common::units::Energy;

use super::active_event::ActiveEvent;
use super::clusters::distance;
use super::deployment::ReferenceDeployment;
use super::detection::{Obstacle, detects, miss_cause};
use super::device::{Device, ReferenceState, S1, S3, S4};
use super::estimate::ReferenceEstimate;
use super::events::ReferenceEvents;
use super::harvest::{ReferenceSource, expected_day, is_day, mean_harvest};
use super::policy::{ReferencePolicy, Situation, WakeUpChoice};
use super::radio::ReferenceRadio;
use super::run::ReferenceRun;

/// Runs `scenario` on `deployment` with `policy` and the `actions` of operators, in the order of TTIs. Stops at the
/// first decision that is too close to call.
pub(super) fn play(
    scenario: &Scenario,
    deployment: &ReferenceDeployment,
    policy: ReferencePolicy,
    actions: &[OperatorAction],
) -> ReferenceRun {
    let mut world = ReferenceWorld::new(scenario, deployment, policy);
    for k in 0..scenario.run.ttis {
        if k == world.warm_up_end {
            world.begin_measuring();
        }
        for action in actions.iter().filter(|action| action.tti.0 == k) {
            world.apply_change(k, &action.change);
        }
        world.transmit_plan(k);
        world.harvest(k);
        world.apply_duty(k);
        world.start_event(k);
        world.sense(k);
        if !world.wake(k) {
            world.ambiguous = Some(k);
            break;
        }
        world.close_event(k);
        world.account();
    }
    world.into_run()
}

/// State of a run. Fields without a comment are fields of [`ReferenceRun`] so far.
struct ReferenceWorld<'a> {
    /// Scenario of the run.
    scenario: &'a Scenario,
    /// Positions of the devices.
    positions: Vec<Point>,
    /// Devices, by number.
    devices: Vec<Device>,
    /// Policy of the base station.
    policy: ReferencePolicy,
    /// The base station's battery estimates.
    estimates: Vec<ReferenceEstimate>,
    /// First measured TTI.
    warm_up_end: u64,
    /// Active event.
    active_event: Option<ActiveEvent>,
    /// Starts, places and durations of events.
    event_process: ReferenceEvents<'a>,
    /// Message losses and false wake-ups.
    radio: ReferenceRadio,
    /// Sum of the start probabilities of the measured TTIs so far.
    start_probability_sum: f64,
    /// Number of measured TTIs so far.
    measured_ttis: f64,
    events: Vec<EventRecord>,
    activity: Vec<EventActivity>,
    wake_ups: u64,
    losses: RadioLosses,
    wake_up_span_ttis: u64,
    arrived_reports: u64,
    missed_wake_ups: u64,
    exclusions: u64,
    trace: Vec<Vec<(ReferenceState, u64)>>,
    ambiguous: Option<u64>,
}

impl<'a> ReferenceWorld<'a> {
    fn new(scenario: &'a Scenario, deployment: &ReferenceDeployment, policy: ReferencePolicy) -> Self {
        let mut device_counts = vec![0; scenario.classes.len()];
        let (mut devices, mut estimates) = (Vec::new(), Vec::new());
        for (id, &class) in deployment.classes.iter().enumerate() {
            let class = usize::from(class);
            let settings = &scenario.classes[class];
            let (seed, nth) = (scenario.run.seed, device_counts[class]);
            device_counts[class] += 1;
            let known_mean = mean_harvest(&settings.harvest, scenario.run.tau, nth);
            let (expected_harvest, is_daylight) = match expected_day(&settings.harvest, scenario.run.tau) {
                Some(day) => {
                    let is_daylight = (0..day.len() as u64).map(|k| is_day(&settings.harvest, k)).collect();
                    (day, is_daylight)
                }
                None => (vec![known_mean], vec![true]),
            };
            estimates.push(ReferenceEstimate::new(settings.energy, expected_harvest, is_daylight));
            let source = ReferenceSource::new(&settings.harvest, scenario.run.tau, seed, id as u64, nth);
            let source = if deployment.has_known_harvest {
                source.with_known_harvest(known_mean)
            } else {
                source
            };
            devices.push(Device::new(settings.energy, source));
        }
        Self {
            policy,
            estimates,
            activity: vec![EventActivity::default(); deployment.positions.len()],
            scenario,
            positions: deployment.positions.clone(),
            devices,
            warm_up_end: (scenario.run.ttis as f64 * scenario.run.warm_up).floor() as u64,
            active_event: None,
            event_process: ReferenceEvents::new(scenario),
            radio: ReferenceRadio::new(scenario, deployment.positions.len()),
            start_probability_sum: 0.0,
            measured_ttis: 0.0,
            events: Vec::new(),
            wake_ups: 0,
            losses: RadioLosses::default(),
            wake_up_span_ttis: 0,
            arrived_reports: 0,
            missed_wake_ups: 0,
            exclusions: 0,
            trace: Vec::new(),
            ambiguous: None,
        }
    }

    /// Before TTI `k`: applies an operator's change. The price has no effect under the policies here.
    fn apply_change(&mut self, k: u64, change: &Change) {
        for (device, id) in self.devices.iter_mut().zip((0..).map(DeviceId)) {
            device.apply_change(id, k, change);
        }
        if let Change::Set(Setting::EventRate, alpha) = *change {
            self.event_process.set_alpha(alpha);
        }
    }

    /// Before step 1: transmits the plan if it is due.
    fn transmit_plan(&mut self, k: u64) {
        let is_plan_sent = k.is_multiple_of(self.scenario.bs.sync_interval);
        let missed_plans = self.radio.begin(k, is_plan_sent);
        if k >= self.warm_up_end {
            self.losses.sent_plans += if is_plan_sent { self.devices.len() as u64 } else { 0 };
            self.losses.missed_plans += missed_plans;
        }
    }

    /// Step 1: harvesting.
    fn harvest(&mut self, k: u64) {
        for device in &mut self.devices {
            let arriving = device.source.arriving(k);
            device.store(arriving);
        }
    }

    /// Step 2: duty cycles.
    fn apply_duty(&mut self, k: u64) {
        for (j, device) in self.devices.iter_mut().enumerate() {
            // Counts down in every TTI, whatever the state.
            let has_false_wake_up = self.radio.draw_false_wake_up(j);
            if device.failed_since.is_some() {
                device.state = ReferenceState::Failed;
                device.current_outage = 0;
                continue;
            }
            let is_paid;
            let commanded_state = if self.policy.senses(j, k) && self.radio.has_plan(j) {
                (_, is_paid) = device.pay(device.costs.e_idle, S1);
                device.sensing_ttis += 1;
                device.unpaid_sensing_ttis += u64::from(!is_paid);
                ReferenceState::Idle
            } else {
                (_, is_paid) = device.pay(device.costs.e_wur, S4);
                device.unpowered_ttis += u64::from(!is_paid);
                ReferenceState::Asleep
            };
            device.current_outage = if is_paid { 0 } else { device.current_outage + 1 };
            device.longest_outage = device.longest_outage.max(device.current_outage);
            device.state = if is_paid {
                commanded_state
            } else {
                ReferenceState::Unpowered
            };
            if has_false_wake_up && device.state == ReferenceState::Asleep {
                device.false_wake_ups += 1;
                let (_, is_paid) = device.pay(device.costs.e_idle, S4);
                if !is_paid {
                    device.state = ReferenceState::Unpowered;
                }
            }
        }
    }

    /// Step 3: start of an event.
    fn start_event(&mut self, k: u64) {
        let alpha = self.event_process.advance();
        if k >= self.warm_up_end {
            self.start_probability_sum += alpha;
            self.measured_ttis += 1.0;
        }
        if self.active_event.is_some() || !self.event_process.check_start() {
            return;
        }
        let (epicentre, duration) = self.event_process.draw_event();
        self.active_event = Some(ActiveEvent {
            epicentre,
            start: k,
            duration,
            tally: EventTally::default(),
            information: 0.0,
            wake_up_span: 0,
            furthest_obstacle: None,
            activity: Vec::new(),
            reporters: Vec::new(),
        });
    }

    /// Steps 4 and 5: sensing and reports.
    fn sense(&mut self, k: u64) {
        let Some(mut event) = self.active_event.take() else {
            return;
        };
        let mut reporters = Vec::new();
        for j in 0..self.devices.len() {
            let d = distance(self.positions[j], event.epicentre);
            if self.devices[j].state == ReferenceState::Idle && self.detects(j, d) {
                debug_assert!(self.policy.senses(j, k));
                if self.send_report(j, k, &mut event) {
                    self.estimates[j].record_report(k, self.devices[j].battery);
                    reporters.push((j, d));
                }
                continue;
            }
            let obstacle = match self.devices[j].state {
                ReferenceState::Failed => Obstacle::FailedDevice,
                ReferenceState::Unpowered => Obstacle::NoPowerToSense,
                ReferenceState::Idle | ReferenceState::Transmission | ReferenceState::Asleep => continue,
            };
            if self.policy.senses(j, k) && self.radio.has_plan(j) && self.detects(j, d) {
                event.meet(obstacle);
            }
        }
        self.record_silence(k, &reporters);
        self.active_event = Some(event);
    }

    /// Learns from missing reports if detection is certain within d_max. A device planned to sense would have reported
    /// if it is within d_max of every point on the ring around a reporter. `reporters` are the devices whose reports
    /// arrived, with their distances from the event.
    fn record_silence(&mut self, k: u64, reporters: &[(usize, f64)]) {
        let sensing = &self.scenario.sensing;
        if sensing.kind != DetectionKind::Range {
            return;
        }
        for j in 0..self.devices.len() {
            let covers_ring = |&(h, d): &(usize, f64)| {
                // `ROUNDING_MARGIN` of `bs/src/battery_estimator/mod.rs`: both must agree at the edge of the range.
                distance(self.positions[h], self.positions[j]) <= sensing.d_max * (1.0 - 1e-9) - d
            };
            let has_reported = reporters.iter().any(|&(h, _)| h == j);
            if self.policy.senses(j, k) && !has_reported && reporters.iter().any(covers_ring) {
                let policy = &self.policy;
                let loss_probability = self.radio.silence_probability();
                self.estimates[j].record_silence(k, loss_probability, |tti| policy.senses(j, tti));
            }
        }
    }

    /// Step 6: wake-ups. Returns false if the next wake-up is too close to call.
    fn wake(&mut self, k: u64) -> bool {
        let Some(mut event) = self.active_event.take() else {
            return true;
        };
        let mut woken = Vec::new();
        let estimated_able: Vec<bool> = if self.policy.ranks() && !event.reporters.is_empty() {
            let can_report =
                |(j, estimate): (usize, &ReferenceEstimate)| estimate.can_report(k, |tti| self.policy.senses(j, tti));
            self.estimates.iter().enumerate().map(can_report).collect()
        } else {
            vec![true; self.devices.len()]
        };
        let is_excluded = |(j, is_able): (usize, &bool)| !is_able && !self.policy.senses(j, k);
        self.exclusions += u64::from(estimated_able.iter().enumerate().any(is_excluded));
        loop {
            let choice = self.policy.choose(&Situation {
                scenario: self.scenario,
                positions: &self.positions,
                k,
                is_first_tti: k == event.start,
                epicentre: event.epicentre,
                reporters: &event.reporters,
                information: event.information,
                woken: &woken,
                can_report: &estimated_able,
                answers_can_be_lost: self.radio.no_answer_probability() > 0.0,
            });
            let j = match choice {
                WakeUpChoice::Wake(j) => j,
                WakeUpChoice::Stop => break,
                WakeUpChoice::Ambiguous => return false,
            };
            woken.push(j);
            event.tally.wake_ups += 1;
            self.wake_ups += u64::from(k >= self.warm_up_end);
            let is_received = self.devices[j].state == ReferenceState::Asleep && !self.radio.misses_wake_up(j);
            let activity = EventActivity {
                wake_ups: 1,
                received_wake_ups: u64::from(is_received),
                ..EventActivity::default()
            };
            event.activity.push((j, activity));
            // Wake-ups for an event are sent in order, each after the latency of the previous one.
            let awake_from = k + woken.len() as u64 * self.scenario.radio.wake_latency;
            let is_over = awake_from >= event.start.saturating_add(event.duration);
            let has_reported = if is_received && is_over {
                self.wake_too_late(j, k, &mut event);
                false
            } else if is_received {
                if self.send_report(j, k, &mut event) {
                    event.wake_up_span = awake_from - k;
                    true
                } else {
                    false
                }
            } else {
                event.meet(Obstacle::MissedWakeUp);
                self.missed_wake_ups += 1;
                self.losses.missed_wake_ups += u64::from(k >= self.warm_up_end);
                false
            };
            if has_reported {
                self.estimates[j].record_report(k, self.devices[j].battery);
            } else {
                let policy = &self.policy;
                let loss_probability = self.radio.no_answer_probability();
                self.estimates[j].record_silence(k, loss_probability, |tti| policy.senses(j, tti));
            }
        }
        self.active_event = Some(event);
        true
    }

    /// Wakes device `j` after the end of the event; it detects nothing and sleeps again.
    fn wake_too_late(&mut self, j: usize, k: u64, event: &mut ActiveEvent) {
        let device = &mut self.devices[j];
        device.false_wake_ups += 1;
        let (spent, is_paid) = device.pay(device.costs.e_idle, S4);
        device.state = if is_paid {
            ReferenceState::Asleep
        } else {
            ReferenceState::Unpowered
        };
        let activity = EventActivity {
            wrong_activations: 1,
            ..EventActivity::default()
        };
        event.activity.push((j, activity));
        event.tally.wrong_activations += 1;
        event.tally.wasted_energy += Energy::from_micro(spent);
        self.losses.late_wake_ups += u64::from(k >= self.warm_up_end);
    }

    /// From S2: device `j` sends its report if it can pay for it. Returns whether the report arrives.
    fn send_report(&mut self, j: usize, k: u64, event: &mut ActiveEvent) -> bool {
        let sensing = &self.scenario.sensing;
        let d = distance(self.positions[j], event.epicentre);
        let is_in_range = d <= sensing.d_max;
        let e_tx = self.devices[j].costs.e_tx;
        let (spent, is_paid) = self.devices[j].pay(e_tx, S3);
        let arrives = is_paid && !self.radio.loses_report(j);
        let is_wrong_activation = !is_paid || !is_in_range;
        let activity = EventActivity {
            reports: u64::from(arrives),
            wrong_activations: u64::from(is_wrong_activation),
            ..EventActivity::default()
        };
        event.activity.push((j, activity));
        if is_wrong_activation {
            event.tally.wrong_activations += 1;
            event.tally.wasted_energy += Energy::from_micro(spent);
        }
        if !is_paid {
            event.meet(Obstacle::UnpaidReport);
            self.devices[j].state = ReferenceState::Unpowered;
            return false;
        }
        self.devices[j].state = ReferenceState::Transmission;
        let measured_count = u64::from(k >= self.warm_up_end);
        if !arrives {
            event.meet(Obstacle::LostReport);
            self.losses.lost_reports += measured_count;
            return false;
        }
        self.arrived_reports += measured_count;
        event.tally.reports += 1;
        if is_in_range {
            let information = sensing.psi * libm::exp(-sensing.eta * d);
            event.information = match sensing.g {
                Fusion::Max => event.information.max(information),
                Fusion::SumSaturation => (event.information + information).min(sensing.psi),
            };
            let reporter = self.policy.new_reporter(self.scenario, &self.positions, j, d);
            event.reporters.push(reporter);
        }
        true
    }

    /// Whether device `j`, `d` metres from the active event, detects it if it senses.
    fn detects(&self, j: usize, d: f64) -> bool {
        detects(self.scenario, self.event_process.number(), j, d)
    }

    /// End of step 6: an event ends with its first report or at its end time.
    fn close_event(&mut self, k: u64) {
        let Some(mut event) = self.active_event.take() else {
            return;
        };
        if event.tally.reports == 0 && k + 1 < event.start.saturating_add(event.duration) {
            self.active_event = Some(event);
            return;
        }
        if event.start >= self.warm_up_end {
            self.wake_up_span_ttis += event.wake_up_span;
            for (j, contribution) in event.activity.drain(..) {
                self.activity[j] += contribution;
            }
        }
        // The emulator sums information in whole units of 10⁻¹².
        event.tally.information_pico = (event.information * 1e12).round() as u64;
        self.events.push(EventRecord {
            event: EventId(self.event_process.number()),
            epicentre: event.epicentre,
            start: Tti(event.start),
            last: Tti(k),
            counted: event.start >= self.warm_up_end,
            tally: event.tally,
            miss_cause: self.miss_cause(&event),
        });
        self.event_process.end_event();
    }

    /// Returns the cause of the miss of `event`, which ends in this TTI; `None` if it was reported.
    fn miss_cause(&self, event: &ActiveEvent) -> Option<MissCause> {
        let positions = self.positions.iter().enumerate();
        let distances = positions.map(|(j, position)| (j, distance(*position, event.epicentre)));
        let in_range: Vec<_> = distances.filter(|(_, d)| *d <= self.scenario.sensing.d_max).collect();
        let has_failed = |j: usize| self.devices[j].failed_since.is_some_and(|since| since <= event.start);
        let not_failed = in_range.iter().filter(|(j, _)| !has_failed(*j));
        let would_detect: Vec<bool> = not_failed.map(|&(j, d)| self.detects(j, d)).collect();
        (event.tally.reports == 0).then(|| miss_cause(event.furthest_obstacle, &would_detect, in_range.is_empty()))
    }

    /// Step 7: accounting.
    fn account(&mut self) {
        let mut row = Vec::new();
        for device in &mut self.devices {
            device.battery_sum += u128::from(device.battery);
            device.low_ttis += u64::from(device.battery < device.costs.e_tx.micro());
            row.push((device.state, device.battery));
        }
        self.trace.push(row);
    }

    /// Before the first measured TTI.
    fn begin_measuring(&mut self) {
        for device in &mut self.devices {
            device.totals_at_warm_up_end = Some(device.totals());
            (device.current_outage, device.longest_outage) = (0, 0);
        }
    }

    fn into_run(self) -> ReferenceRun {
        let mut totals = EventTotals::default();
        for record in self.events.iter().filter(|record| record.counted) {
            totals.events += 1;
            totals.misdetected += u64::from(record.tally.reports == 0);
            totals.delay_ttis += if record.tally.reports > 0 {
                record.last - record.start
            } else {
                0
            };
            totals.reports += record.tally.reports;
            totals.wake_ups += record.tally.wake_ups;
            totals.information_pico += u128::from(record.tally.information_pico);
            totals.wrong_activations += record.tally.wrong_activations;
            totals.wasted_energy += record.tally.wasted_energy;
        }
        let ledgers: Vec<Ledger> = self.devices.iter().map(Device::ledger).collect();
        ReferenceRun {
            measured: ledgers.iter().map(|ledger| ledger.measured).sum(),
            ledgers,
            events: self.events,
            activity: self.activity,
            totals,
            start_probability: self.start_probability_sum / self.measured_ttis,
            wake_ups: self.wake_ups,
            losses: RadioLosses {
                sent_wake_ups: self.wake_ups,
                ..self.losses
            },
            wake_up_span_ttis: self.wake_up_span_ttis,
            arrived_reports: self.arrived_reports,
            missed_wake_ups: self.missed_wake_ups,
            exclusions: self.exclusions,
            trace: self.trace,
            ambiguous: self.ambiguous,
        }
    }
}
