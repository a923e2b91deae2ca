//! An unreliable radio: lost messages against the draws of `Air`, their effects on events, plans and energy, wake-up
//! latency, false wake-ups, the metric of each failure, and decisions that must not depend on lost reports. The draws
//! themselves are compared with the reference implementation in `reference.rs`. Losses over the bus are not tested.
//!
//! Minimum numbers of messages and events are not requirements: they show that the tested case occurs.

use reveille_bs::base_station::BaseStation;
use reveille_bs::cycle::{Cycle, PreparedRun, RunOutcome};
use reveille_bs::knowledge::Knowledge;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::registry;
use reveille_common::event::{EventProcess, ScriptedEvent};
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::WakeOutcome;
use reveille_common::plan::Plan;
use reveille_common::radio::{Air, RadioLossRates};
use reveille_common::world::World;
use reveille_device::machine::Machine;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::compare::ONE_TTI_PER_GRANT;
use reveille_tests::scenarios::paper;

/// E_idle of the preset `paper`, micro-units; a copy of the default in `common/src/energy.rs`.
const E_IDLE: u64 = 1_000_000;

fn prepared(fields: &[&str]) -> PreparedRun {
    prepare(&paper(fields))
}

/// Decisions of a base station and the messages that arrived or were lost.
#[derive(Clone, Debug, Default, PartialEq)]
struct RadioObserver {
    /// Plans that the base station sent, each with its first TTI.
    sent_plans: Vec<(Tti, Plan)>,
    /// TTIs and devices of wake-ups that the base station sent.
    sent_wake_ups: Vec<(Tti, DeviceId)>,
    /// TTIs and senders of reports that arrived.
    arrived_reports: Vec<(Tti, DeviceId)>,
    /// TTIs and senders of reports that were lost.
    lost_reports: Vec<(Tti, DeviceId)>,
    /// TTIs and devices of wake-ups that were not received.
    missed_wake_ups: Vec<(Tti, DeviceId)>,
    /// Events: whether each was reported, and the number of its lost reports.
    events: Vec<(bool, u64)>,
    /// Lost reports of the current event.
    lost_in_event: u64,
}

impl RadioObserver {
    fn lose_report(&mut self, tti: Tti, device: DeviceId) {
        self.lost_in_event += 1;
        self.lost_reports.push((tti, device));
    }
}

impl Observer for RadioObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.sent_plans.push((update.from, update.plan.clone())),
            Notification::ReportReceived(report) => self.arrived_reports.push((report.tti, report.device)),
            Notification::ReportLost(report) => self.lose_report(report.tti, report.device),
            Notification::WakeUpSent { tti, device, .. } => self.sent_wake_ups.push((*tti, *device)),
            Notification::WakeUpCompleted { tti, device, outcome } => match outcome {
                WakeOutcome::Reported(_) => self.arrived_reports.push((*tti, *device)),
                WakeOutcome::Lost(_) => self.lose_report(*tti, *device),
                WakeOutcome::Missed => self.missed_wake_ups.push((*tti, *device)),
                WakeOutcome::Late { .. } | WakeOutcome::Failed(_) => {}
            },
            Notification::EventStarted(_) => self.lost_in_event = 0,
            Notification::EventEnded(record) => self.events.push((record.tally.reports > 0, self.lost_in_event)),
            Notification::ReportFailed { .. }
            | Notification::TtisGranted(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::BeliefUpdated { .. }
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

fn observe(prepared: &PreparedRun) -> RadioObserver {
    let mut observer = RadioObserver::default();
    Run::new(prepared, RunOptions::default()).finish(&mut observer);
    observer
}

fn finish(prepared: &PreparedRun) -> RunOutcome {
    Run::new(prepared, RunOptions::default()).finish(&mut ())
}

#[test]
fn exactly_the_drawn_reports_and_wake_ups_are_lost() {
    for policy in registry::names() {
        let name = format!("policy.name={policy}");
        let prepared = prepared(&[
            &name,
            "ttis=1200",
            "energy.initial=100",
            "radio.uplink_loss=0.3",
            "radio.wake_miss=0.25",
            "radio.interference=bursts",
            "radio.bursts.loss=0.6",
            "bs.sync_interval=20",
        ]);
        let observed = observe(&prepared);
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        let with_loss = |is_lost| move |&(tti, device): &(Tti, DeviceId)| (tti, device, is_lost);
        let arrived_reports = observed.arrived_reports.iter().map(with_loss(false));
        let lost_reports = observed.lost_reports.iter().map(with_loss(true));
        let mut reports: Vec<(Tti, DeviceId, bool)> = arrived_reports.chain(lost_reports).collect();
        // `Air` never goes back in time.
        reports.sort_unstable();
        for &(tti, device, is_lost) in &reports {
            assert_eq!(
                air.losses_at(tti).loses_report(device),
                is_lost,
                "{policy}: report of device {device} in TTI {tti}"
            );
        }
        let lost_share = observed.lost_reports.len() as f64 / reports.len() as f64;
        // The share exceeds the loss rate between bursts, since an event lasts longer while its reports are lost.
        assert!(
            reports.len() > 60 && (0.2..0.6).contains(&lost_share),
            "{policy}: lost share {lost_share} of {} reports",
            reports.len()
        );
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        for &(tti, device) in &observed.sent_wake_ups {
            let is_drawn_as_missed = air.losses_at(tti).misses_wake_up(device);
            // An unpowered device misses wake-ups too.
            let is_missed = observed.missed_wake_ups.contains(&(tti, device));
            assert!(
                is_missed || !is_drawn_as_missed,
                "{policy}: device {device} received a lost wake-up in TTI {tti}"
            );
        }
    }
}

#[test]
fn events_are_missed_if_every_report_is_lost() {
    let prepared = prepared(&["ttis=2000", "radio.uplink_loss=1", "energy.initial=100"]);
    let observed = observe(&prepared);
    assert!(observed.events.iter().all(|(is_reported, _)| !is_reported));
    assert!(observed.arrived_reports.is_empty() && observed.sent_wake_ups.is_empty());
    // A device in S1 in several TTIs of an event reports in each of them.
    let max_lost_reports = observed.events.iter().map(|(_, lost)| *lost).max();
    assert!(
        max_lost_reports > Some(4),
        "{max_lost_reports:?} lost reports of an event"
    );
    let outcome = finish(&prepared);
    let missed = outcome.totals.missed;
    let [misdetection_pct, lost_pct] = [outcome.metrics.misdetection_pct, outcome.metrics.lost_reports_pct];
    assert!(
        (misdetection_pct - 100.0).abs() < 1e-12,
        "misdetection {misdetection_pct} %"
    );
    assert!((lost_pct - 100.0).abs() < 1e-12, "lost reports {lost_pct} %");
    assert_eq!(missed.events(), outcome.totals.events.events);
    assert!(missed.lost > 20 * missed.no_energy.max(1), "{missed:?}");
}

#[test]
fn an_event_is_reported_after_a_report_was_lost() {
    let prepared = prepared(&["ttis=3000", "radio.uplink_loss=0.5", "events.duration=6"]);
    let observed = observe(&prepared);
    let late_events = observed
        .events
        .iter()
        .filter(|(is_reported, lost)| *is_reported && *lost > 0)
        .count();
    assert!(late_events > 50, "{late_events} events reported after a lost report");
}

/// Holds with and without lookahead.
#[test]
fn devices_that_miss_a_plan_keep_the_previous_one() {
    for policy in ["knn", "age-index", "q-learning"] {
        let name = format!("policy.name={policy}");
        let prepared = prepared(&[&*name, "ttis=1500", "radio.plan_loss=0.4", "bs.sync_interval=200"]);
        let mut run = Run::new(&prepared, RunOptions::default());
        let mut observer = RadioObserver::default();
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        let mut received_duties: Vec<_> = run.machines().iter().map(Machine::duty).collect();
        let mut outdated_duties = 0_u64;
        while run.cycle().next_tti() < Tti(1500) {
            let earlier_plans = observer.sent_plans.len();
            run.run_grant(&mut observer);
            for (from, plan) in &observer.sent_plans[earlier_plans..] {
                let devices = received_duties.len();
                air.deliver_plan(*from, plan, DeviceId(0), devices, |j, duty| received_duties[j] = duty);
            }
            for (machine, duty) in run.machines().iter().zip(&received_duties) {
                assert_eq!(machine.duty(), *duty, "{policy}: device {}", machine.id());
                outdated_duties += u64::from(*duty != run.cycle().plan().duty_cycle(machine.id()));
            }
        }
        assert!(outdated_duties > 0, "{policy}: every device has the current plan");
        let digests = [RunOptions::default(), ONE_TTI_PER_GRANT]
            .map(|options| Run::new(&prepared, options).finish(&mut ()).digest);
        assert_eq!(digests[0], digests[1], "{policy}");
    }
}

/// A lost message has the same effect as a message that was never sent, whatever its content.
#[test]
fn the_content_of_lost_reports_changes_no_decision() {
    for policy in registry::names().filter(|policy| *policy != "genie") {
        let name = format!("policy.name={policy}");
        let prepared = prepared(&[
            &*name,
            "ttis=600",
            "radio.uplink_loss=1",
            "bs.battery_knowledge=reported",
        ]);
        let play = |epicentre: &dyn Fn(u64) -> Point| {
            let script = (0..70).map(|i| ScriptedEvent {
                start: Tti(8 * i),
                duration: 4,
                epicentre: epicentre(i),
            });
            let process = EventProcess::scripted(script.collect());
            let world = World::with_events(&prepared.scenario, &prepared.deployment, process);
            // A base station that assumes a perfect radio: one that knew of the losses would not plan any sensing.
            let knowledge = Knowledge {
                radio: RadioLossRates::default(),
                ..prepared.knowledge()
            };
            let policy = prepared.policy(&knowledge);
            let cycle = Cycle::with_station(&prepared, world, BaseStation::new(knowledge, policy));
            let mut observer = RadioObserver::default();
            Run::with_cycle(&prepared, cycle, RunOptions::default()).finish(&mut observer);
            observer
        };
        let eastwards = play(&|i| Point::new(1.0 + (i % 19) as f64, 10.0));
        let southwards = play(&|i| Point::new(10.0, 19.0 - (i % 19) as f64));
        assert!(eastwards.lost_reports.len() > 20, "{policy}");
        assert_ne!(eastwards.lost_reports, southwards.lost_reports, "{policy}");
        assert_eq!(eastwards.arrived_reports, southwards.arrived_reports, "{policy}");
        assert_eq!(eastwards.sent_plans, southwards.sent_plans, "{policy}");
        assert_eq!(eastwards.sent_wake_ups, southwards.sent_wake_ups, "{policy}");
    }
}

/// Each of these kinds of failure shows in its own metric, and only there. Late wake-ups are tested below.
#[test]
fn every_failure_has_its_metric() {
    let failures = [
        ("radio.uplink_loss=0.2", "lost_reports_pct"),
        ("radio.wake_miss=0.2", "missed_wake_ups_pct"),
        ("radio.plan_loss=0.2", "missed_plans_pct"),
        ("radio.false_wake_up=0.2", "false_wake_ups_pct"),
    ];
    for (field, affected_metric) in failures {
        let metrics = finish(&prepared(&[
            "ttis=4000",
            // Batteries never run out, so a wake-up without an answer was missed by the radio.
            "energy.e_max=10000",
            "energy.initial=10000",
            "bs.sync_interval=3",
            // Many wake-ups.
            "policy.name=genie",
            field,
        ]))
        .metrics;
        for (_, metric) in failures {
            let value = metrics.value(metric).expect("a metric");
            if metric == affected_metric {
                // The smallest sample has some hundred messages, and a standard error of about 2 %.
                assert!((value - 20.0).abs() < 6.0, "{field}: {metric} {value}");
            } else {
                assert!(value.abs() < 1e-12, "{field}: {metric} {value}");
            }
        }
    }
}

/// Observer of the TTIs in which wake-ups are sent and devices become awake. `latency` must be set before the run.
#[derive(Default)]
struct WakeUpTimes {
    /// First TTI of the latest event.
    event_start: Tti,
    /// TTIs in which the wake-ups decided in the current TTI were sent.
    sent_ttis: Vec<Tti>,
    /// TTIs from the start of the event until the device was awake, and the outcome.
    delays: Vec<(u64, WakeOutcome)>,
    /// Wake-up latency, TTIs.
    latency: u64,
}

impl Observer for WakeUpTimes {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::EventStarted(event) => self.event_start = event.start,
            Notification::WakeUpSent {
                tti, sent: sent_tti, ..
            } => {
                let expected_tti = tti.0 + self.sent_ttis.len() as u64 * self.latency;
                assert_eq!(sent_tti.0, expected_tti, "TTI of wake-up {}", self.sent_ttis.len());
                self.sent_ttis.push(*sent_tti);
            }
            Notification::WakeUpCompleted { outcome, .. } => {
                let awake_from = self.sent_ttis[self.sent_ttis.len() - 1].0 + self.latency;
                self.delays.push((awake_from - self.event_start.0, **outcome));
            }
            Notification::TtiClosed(_) => self.sent_ttis.clear(),
            Notification::PlanSent { .. }
            | Notification::TtisGranted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::ReportFailed { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::EventEnded(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// An event of 6 TTIs is detected only by devices that are awake at most 5 TTIs after its start.
#[test]
fn a_device_that_wakes_after_the_event_detects_nothing() {
    for (policy, latency) in [
        ("q-learning", 1),
        ("q-learning", 2),
        ("age-index", 3),
        ("genie", 2),
        ("genie", 6),
    ] {
        let prepared = prepared(&[
            &format!("policy.name={policy}"),
            &format!("radio.wake_latency={latency}"),
            "ttis=3000",
            "events.duration=6",
            "energy.initial=100",
        ]);
        let mut wake_ups = WakeUpTimes {
            latency,
            ..WakeUpTimes::default()
        };
        let outcome = Run::new(&prepared, RunOptions::default()).finish(&mut wake_ups);
        let (mut in_time, mut late) = (0, 0);
        for (delay, wake_outcome) in &wake_ups.delays {
            match wake_outcome {
                WakeOutcome::Late { spent, powered } => {
                    late += 1;
                    assert!(*delay > 5, "{policy}: {wake_outcome} after {delay} TTIs");
                    assert!(!powered || spent.micro() == E_IDLE, "{policy}: {wake_outcome}");
                }
                WakeOutcome::Reported(_) | WakeOutcome::Failed(_) | WakeOutcome::Lost(_) => {
                    in_time += 1;
                    assert!(*delay <= 5, "{policy}: {wake_outcome} after {delay} TTIs");
                }
                WakeOutcome::Missed => {}
            }
        }
        let case = format!("{policy}, latency {latency}: {late} wake-ups late, {in_time} in time");
        // With perfect reports, `genie` wakes one device at the start of an event.
        assert!(late > 50 || (policy, latency) == ("genie", 2), "{case}");
        assert_eq!(in_time == 0, latency > 5, "{case}");
        // The ledger counts a late wake-up as a false one.
        assert_eq!(outcome.totals.energy.false_wake_ups > 0, late > 0, "{case}");
        if policy == "genie" {
            let misdetection_pct = outcome.metrics.misdetection_pct;
            assert_eq!(
                misdetection_pct > 99.0,
                latency > 5,
                "{case}, misdetection {misdetection_pct} %"
            );
        }
    }
}

#[test]
fn each_false_wake_up_costs_e_idle_in_s4() {
    let energy = |false_wake_up: f64| {
        finish(&prepared(&[
            "ttis=2000",
            "energy.e_max=10000",
            "energy.initial=10000",
            "policy.name=genie",
            &format!("radio.false_wake_up={false_wake_up:?}"),
        ]))
        .totals
        .energy
    };
    let (without_false, with_false) = (energy(0.0), energy(0.1));
    assert_eq!(with_false.spent.sensing, without_false.spent.sensing);
    let additional = with_false.spent.sleep - without_false.spent.sleep;
    assert_eq!(additional.micro(), with_false.false_wake_ups * E_IDLE);
    // The preset has 50 devices and a warm-up of 10 %: under `genie` all sleep in most of the 1800 measured TTIs.
    let share = with_false.false_wake_ups as f64 / (50.0 * 1800.0);
    assert!((share - 0.1).abs() < 0.005, "false wake-ups in a share {share} of TTIs");
}
