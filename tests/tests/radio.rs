//! An unreliable radio: its effects, who can know of them, and the metric of each failure.

use std::collections::BTreeMap;

use reveille_bs::base_station::BaseStation;
use reveille_bs::cycle::{Cycle, PreparedRun};
use reveille_bs::knowledge::Knowledge;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::registry;
use reveille_bs::scenario::{Override, load};
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

fn prepared(set: &[&str]) -> PreparedRun {
    let parse = |set: &&str| Override::parse(set).expect("an override");
    let overrides: Vec<Override> = set.iter().map(parse).collect();
    prepare(&load("paper", &overrides).expect("a scenario").scenario)
}

/// Decisions of a base station and their outcomes.
#[derive(Clone, Debug, Default, PartialEq)]
struct RadioObserver {
    plans: Vec<(Tti, Plan)>,
    wake_ups: Vec<(Tti, DeviceId)>,
    /// By kind of notification: the count, and the last TTI.
    seen: BTreeMap<&'static str, u64>,
    /// TTIs and senders of reports: arrived, lost.
    reports: [Vec<(Tti, DeviceId)>; 2],
    /// TTIs and devices of wake-ups that were not received.
    missed_wake_ups: Vec<(Tti, DeviceId)>,
    /// Events: whether each was reported, and the number of its lost reports.
    events: Vec<(bool, u64)>,
    lost: u64,
}

impl Observer for RadioObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.plans.push((update.from, update.plan.clone())),
            Notification::ReportReceived(report) => self.reports[0].push((report.tti, report.device)),
            Notification::ReportLost(report) => {
                self.lost += 1;
                self.reports[1].push((report.tti, report.device));
            }
            Notification::WakeUpSent { tti, device, .. } => self.wake_ups.push((*tti, *device)),
            Notification::WakeUpCompleted { tti, device, outcome } => match outcome {
                WakeOutcome::Reported(_) => self.reports[0].push((*tti, *device)),
                WakeOutcome::Lost(_) => {
                    self.lost += 1;
                    self.reports[1].push((*tti, *device));
                }
                WakeOutcome::Missed => self.missed_wake_ups.push((*tti, *device)),
                WakeOutcome::Late { .. } => *self.seen.entry("late").or_default() += 1,
                WakeOutcome::Failed(_) => *self.seen.entry("failed").or_default() += 1,
            },
            Notification::EventStarted(_) => self.lost = 0,
            Notification::EventEnded(record) => self.events.push((record.tally.reports > 0, self.lost)),
            Notification::ReportFailed { .. } => *self.seen.entry("failed").or_default() += 1,
            Notification::TtisGranted(_)
            | Notification::DevicesRemoved(_)
            | Notification::BeliefUpdated { .. }
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

fn watch(prepared: &PreparedRun) -> RadioObserver {
    let mut watch = RadioObserver::default();
    Run::new(prepared, RunOptions::default()).finish(&mut watch);
    watch
}

/// Exactly the drawn messages are lost, under every policy.
#[test]
fn reports_and_wake_ups_are_lost_as_they_are_drawn() {
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
        let seen = watch(&prepared);
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        let mut all: Vec<(Tti, DeviceId, bool)> = Vec::new();
        for (place, reports) in seen.reports.iter().enumerate() {
            all.extend(reports.iter().map(|&(tti, device)| (tti, device, place == 1)));
        }
        all.sort_unstable();
        for &(tti, device, is_lost) in &all {
            assert_eq!(
                air.losses_at(tti).loses_report(device),
                is_lost,
                "{policy}: device {device} in TTI {tti}"
            );
        }
        let lost = seen.reports[1].len() as f64 / all.len() as f64;
        // The share exceeds the loss rate between bursts, since an event lasts longer while its reports are lost.
        assert!(
            all.len() > 60 && (0.2..0.6).contains(&lost),
            "{policy}: {lost} of {}",
            all.len()
        );
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        for &(tti, device) in &seen.wake_ups {
            let is_missed = air.losses_at(tti).misses_wake_up(device);
            let is_unheard = seen.missed_wake_ups.contains(&(tti, device));
            assert!(is_unheard || !is_missed, "{policy}: device {device} heard in TTI {tti}");
        }
    }
}

/// If every report is lost, none arrives, and each event that can be missed is missed.
#[test]
fn events_whose_reports_are_all_lost_stay_open_and_are_missed() {
    let prepared = prepared(&["ttis=2000", "radio.uplink_loss=1", "energy.initial=100"]);
    let seen = watch(&prepared);
    assert!(seen.events.iter().all(|(is_reported, _)| !is_reported));
    let most = seen.events.iter().map(|(_, lost)| *lost).max();
    // A device in S1 in several TTIs of an event reports in each of them.
    assert!(
        most > Some(4) && seen.reports[0].is_empty() && seen.wake_ups.is_empty(),
        "{most:?}"
    );
    let outcome = Run::new(&prepared, RunOptions::default()).finish(&mut ());
    let missed = outcome.totals.missed;
    let [missed_pct, lost_pct] = [outcome.metrics.misdetection_pct, outcome.metrics.lost_reports_pct];
    assert!((missed_pct - 100.0).abs() < 1e-12 && (lost_pct - 100.0).abs() < 1e-12);
    assert_eq!(missed.events(), outcome.totals.events.events);
    assert!(missed.lost > 20 * missed.no_energy.max(1), "{missed:?}");
}

/// If the first report is lost, a later report ends the event.
#[test]
fn an_event_is_reported_after_a_report_was_lost() {
    let prepared = prepared(&["ttis=3000", "radio.uplink_loss=0.5", "events.duration=6"]);
    let seen = watch(&prepared);
    let late = seen
        .events
        .iter()
        .filter(|(is_reported, lost)| *is_reported && *lost > 0)
        .count();
    assert!(late > 50, "{late}");
}

/// A device that misses plans keeps the previous one, with and without lookahead.
#[test]
fn devices_that_miss_plans_keep_the_old_one() {
    for policy in ["knn", "age-index", "q-learning"] {
        let name = format!("policy.name={policy}");
        let set = [&*name, "ttis=1500", "radio.plan_loss=0.4", "bs.sync_interval=200"];
        let prepared = prepared(&set);
        let mut run = Run::new(&prepared, RunOptions::default());
        let mut watch = RadioObserver::default();
        let mut air = Air::new(prepared.scenario.run.seed, &prepared.scenario.radio);
        let mut heard: Vec<_> = run.machines().iter().map(Machine::duty).collect();
        let mut differing = 0_u64;
        while run.cycle().next_tti() < Tti(1500) {
            let before = watch.plans.len();
            run.run_grant(&mut watch);
            for (from, plan) in &watch.plans[before..] {
                let devices = heard.len();
                air.deliver_plan(*from, plan, DeviceId(0), devices, |j, cycle| heard[j] = cycle);
            }
            for (machine, duty) in run.machines().iter().zip(&heard) {
                assert_eq!(machine.duty(), *duty, "{policy}: device {}", machine.id());
                differing += u64::from(*duty != run.cycle().plan().duty_cycle(machine.id()));
            }
        }
        assert!(differing > 0, "{policy}");
        let one_by_one = RunOptions {
            lookahead: false,
            ..RunOptions::default()
        };
        let digests = [RunOptions::default(), one_by_one].map(|how| Run::new(&prepared, how).finish(&mut ()).digest);
        assert_eq!(digests[0], digests[1], "{policy}");
    }
}

/// Knowledge wall: a lost message has the same effect as a message never sent, whatever its content.
#[test]
fn a_base_station_does_not_learn_lost_reports() {
    for policy in registry::names().filter(|policy| *policy != "genie") {
        let name = format!("policy.name={policy}");
        let set = [
            &*name,
            "ttis=600",
            "radio.uplink_loss=1",
            "bs.battery_knowledge=reported",
        ];
        let prepared = prepared(&set);
        let play = |places: &dyn Fn(u64) -> Point| {
            let script = (0..70).map(|i| ScriptedEvent {
                start: Tti(8 * i),
                duration: 4,
                epicentre: places(i),
            });
            let process = EventProcess::scripted(script.collect());
            let world = World::with_events(&prepared.scenario, &prepared.deployment, process);
            // A base station that assumes a perfect radio: one that knew of the losses would not plan any sensing.
            let known = Knowledge {
                radio: RadioLossRates::default(),
                ..prepared.knowledge()
            };
            let policy = prepared.policy(&known);
            let cycle = Cycle::with_station(&prepared, world, BaseStation::new(known, policy));
            let mut watch = RadioObserver::default();
            Run::with_cycle(&prepared, cycle, RunOptions::default()).finish(&mut watch);
            watch
        };
        let one = play(&|i| Point::new(1.0 + (i % 19) as f64, 10.0));
        let other = play(&|i| Point::new(10.0, 19.0 - (i % 19) as f64));
        assert!(one.reports[1].len() > 20 && one.reports != other.reports, "{policy}");
        assert_eq!((one.plans, one.wake_ups), (other.plans, other.wake_ups), "{policy}");
    }
}

/// Each kind of failure shows in its own metric, and only there.
#[test]
fn every_failure_has_its_metric() {
    let names = [
        "lost_reports_pct",
        "missed_wake_ups_pct",
        "missed_plans_pct",
        "false_wake_ups_pct",
    ];
    let fields = ["uplink_loss=0.2", "wake_miss=0.2", "plan_loss=0.2", "false_wake_up=0.2"];
    // Batteries never run out, so a wake-up without an answer was missed by the radio.
    let always = [
        "ttis=4000",
        "energy.e_max=10000",
        "energy.initial=10000",
        "bs.sync_interval=3",
        // Many wake-ups.
        "policy.name=genie",
    ];
    for (at, field) in fields.iter().enumerate() {
        let field = format!("radio.{field}");
        let mut set = always.to_vec();
        set.push(&field);
        let metrics = Run::new(&prepared(&set), RunOptions::default()).finish(&mut ()).metrics;
        for (place, name) in names.iter().enumerate() {
            let value = metrics.value(name).expect("a metric");
            if place == at {
                assert!((value - 20.0).abs() < 6.0, "{field}: {name} {value}");
            } else {
                assert!(value.abs() < 1e-12, "{field}: {name} {value}");
            }
        }
    }
}

/// Wake-ups of the current event: its start, and for each wake-up the TTI sent and its outcome.
#[derive(Default)]
struct WakeUpTimes {
    start: Tti,
    sent: Vec<Tti>,
    /// TTIs from the event's start until the device was awake, and the outcome.
    came: Vec<(u64, WakeOutcome)>,
    latency: u64,
}

impl Observer for WakeUpTimes {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::EventStarted(event) => self.start = event.start,
            Notification::WakeUpSent { tti, sent, .. } => {
                assert_eq!(sent.0, tti.0 + self.sent.len() as u64 * self.latency, "in sequence");
                self.sent.push(*sent);
            }
            Notification::WakeUpCompleted { outcome, .. } => {
                let awake = self.sent[self.sent.len() - 1].0 + self.latency;
                self.came.push((awake - self.start.0, **outcome));
            }
            Notification::TtiClosed(_) => self.sent.clear(),
            Notification::PlanSent { .. }
            | Notification::TtisGranted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::ReportFailed { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::DevicesRemoved(_)
            | Notification::EventEnded(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// An event of 6 TTIs that was reported in its first TTI is found only by devices awake at most 5 TTIs later.
#[test]
fn a_device_that_wakes_after_the_event_detects_nothing() {
    for (policy, latency) in [
        ("q-learning", 1),
        ("q-learning", 2),
        ("age-index", 3),
        ("genie", 2),
        ("genie", 6),
    ] {
        let (name, latency_set) = (format!("policy.name={policy}"), format!("radio.wake_latency={latency}"));
        let prepared = prepared(&[
            &name,
            &latency_set,
            "ttis=3000",
            "events.duration=6",
            "energy.initial=100",
        ]);
        let mut calls = WakeUpTimes {
            latency,
            ..WakeUpTimes::default()
        };
        let outcome = Run::new(&prepared, RunOptions::default()).finish(&mut calls);
        let (mut in_time, mut late) = (0, 0);
        for (after, came) in &calls.came {
            match came {
                WakeOutcome::Late { spent, powered } => {
                    late += 1;
                    assert!(
                        *after > 5 && (!powered || spent.micro() == 1_000_000),
                        "{policy}: {after} TTIs, {came}"
                    );
                }
                WakeOutcome::Reported(_) | WakeOutcome::Failed(_) | WakeOutcome::Lost(_) => {
                    in_time += 1;
                    assert!(*after <= 5, "{policy}: {after} TTIs, {came}");
                }
                WakeOutcome::Missed => {}
            }
        }
        assert!(
            late > 50 || (policy, latency) == ("genie", 2),
            "{policy}, {latency}: {late} of {in_time}"
        );
        assert_eq!(in_time == 0, latency > 5, "{policy}, {latency}: {in_time}");
        assert_eq!(
            outcome.totals.energy.false_wake_ups > 0,
            late > 0,
            "the ledger counts a false wake-up"
        );
        if policy == "genie" {
            let missed = outcome.metrics.misdetection_pct;
            assert_eq!(
                missed > 99.0,
                latency > 5,
                "{missed} % missed with a latency of {latency}"
            );
        }
    }
}

/// Each false wake-up costs E_idle, in S4.
#[test]
fn false_wakes_are_paid_for_in_s4() {
    let rich = [
        "ttis=2000",
        "energy.e_max=10000",
        "energy.initial=10000",
        "policy.name=genie",
    ];
    let total = |extra: &[&str]| {
        let set: Vec<&str> = rich.iter().chain(extra).copied().collect();
        Run::new(&prepared(&set), RunOptions::default())
            .finish(&mut ())
            .totals
            .energy
    };
    let (plain, startled) = (total(&[]), total(&["radio.false_wake_up=0.1"]));
    assert_eq!(startled.spent.sensing, plain.spent.sensing);
    let extra = startled.spent.sleep - plain.spent.sleep;
    assert_eq!(extra.micro(), startled.false_wake_ups * 1_000_000, "E_idle is 1 unit");
    let share = startled.false_wake_ups as f64 / (50.0 * 1800.0);
    assert!((share - 0.1).abs() < 0.005, "{share}");
}
