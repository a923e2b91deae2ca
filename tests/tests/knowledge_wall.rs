//! A policy cannot see ground truth: a change that no base station can observe changes no plan, wake-up or belief of
//! any policy of the registry. The exception is `genie`, which receives events. Hidden battery levels are not varied
//! here, and the radio is perfect; `radio.rs` tests lost reports.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::registry;
use reveille_common::event::{EventProcess, EventRecord, ScriptedEvent};
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::WeightedPoint;
use reveille_common::plan::Plan;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::world::World;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;

/// Plans and wake-ups of a base station in a run, and its beliefs about events.
#[derive(Debug, Default, PartialEq)]
struct DecisionTranscript {
    plans: Vec<(Tti, Plan)>,
    wake_ups: Vec<(Tti, DeviceId)>,
    beliefs: Vec<(Tti, Vec<WeightedPoint>)>,
}

#[derive(Default)]
struct DecisionObserver {
    transcript: DecisionTranscript,
    events: Vec<EventRecord>,
}

impl Observer for DecisionObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.transcript.plans.push((update.from, update.plan.clone())),
            Notification::WakeUpSent { tti, device, .. } => self.transcript.wake_ups.push((*tti, *device)),
            Notification::BeliefUpdated { tti, places } => self.transcript.beliefs.push((*tti, places.to_vec())),
            Notification::EventEnded(event) => self.events.push(**event),
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}

/// Runs the events of `script` and records the decisions.
fn play(prepared: &PreparedRun, script: &[ScriptedEvent]) -> DecisionObserver {
    let process = EventProcess::scripted(script.to_vec());
    let world = World::with_events(&prepared.scenario, &prepared.deployment, process);
    let mut observer = DecisionObserver::default();
    Run::with_world(prepared, world, RunOptions::default()).finish(&mut observer);
    observer
}

fn prepare_policy(policy: &str, fields: &[&str]) -> PreparedRun {
    let policy = format!("policy.name={policy}");
    let common_fields = [policy.as_str(), "devices=40", "ttis=1500", "events.duration=3"];
    prepare(&paper(&[&common_fields, fields].concat()))
}

/// Generates events every few TTIs at random places. An event ends at least 3 TTIs before the next starts, so that its
/// duration can be raised to 5.
fn draw_script(prepared: &PreparedRun) -> Vec<ScriptedEvent> {
    let mut stream = Stream::new(77, Purpose::Epicentre, 0);
    let (width, height) = (prepared.scenario.area.width, prepared.scenario.area.height);
    (0..prepared.scenario.run.ttis / 8)
        .map(|i| ScriptedEvent {
            start: Tti(8 * i + stream.below(3)),
            duration: 1 + stream.below(3),
            epicentre: Point::new(stream.unit() * width, stream.unit() * height),
        })
        .collect()
}

/// Whether no device within d_max of `epicentre` is in S1 from `start` for `duration` TTIs under the plans of
/// `transcript`.
fn is_unseen(
    prepared: &PreparedRun,
    transcript: &DecisionTranscript,
    epicentre: Point,
    start: Tti,
    duration: u64,
) -> bool {
    let d_max = prepared.scenario.sensing.d_max;
    (start.0..start.0 + duration).map(Tti).all(|k| {
        let sent_plans = transcript.plans.partition_point(|(from, _)| *from <= k);
        let plan = &transcript.plans[sent_plans - 1].1;
        let devices = prepared.deployment.devices.iter();
        let mut in_range = devices.filter(|device| device.position.distance(epicentre) <= d_max);
        !in_range.any(|device| plan.duty_cycle(device.id).is_on(k))
    })
}

/// Returns the fields of each scenario in which `policy` is tested. They must let at least 5 events pass that can be
/// changed unseen, and let a policy that wakes devices wake some; the tests check both. A new policy without an arm
/// here gets the last one.
fn fields_of_scenarios(policy: &str) -> Vec<&'static [&'static str]> {
    match policy {
        // Part of the area is out of range, so that some events can be moved.
        "knn" => vec![
            &["sensing.d_max=3.5"],
            &["sensing.d_max=3.5", "bs.ranking=posterior"],
            &[
                "sensing.d_max=3.5",
                "bs.ranking=posterior",
                "sensing.kind=probabilistic",
                "sensing.eta=0.5",
            ],
        ],
        // Shorter pilot runs.
        "adjusted" => vec![
            &["policy.adjusted.t_drx=[4,8]", "policy.adjusted.pilot_ttis=400"],
            &[
                "policy.adjusted.t_drx=[8]",
                "policy.adjusted.pilot_ttis=400",
                "bs.ranking=posterior",
            ],
        ],
        // Sensing that misses some events.
        "q-learning" => vec![
            &["policy.q-learning.window=4"],
            &["policy.q-learning.ages=true", "sensing.d_max=3"],
            &["policy.q-learning.ages=true", "sensing.d_max=3", "bs.ranking=posterior"],
            &[
                "policy.q-learning.window=4",
                "bs.ranking=posterior",
                "bs.battery_knowledge=reported",
            ],
            &[
                "policy.q-learning.window=4",
                "policy.q-learning.table=nothing",
                "policy.q-learning.learn=true",
                "policy.q-learning.epsilon=0.1",
            ],
            &[
                "policy.q-learning.window=4",
                "policy.q-learning.table=nothing",
                "policy.q-learning.learn=true",
                "bs.battery_knowledge=reported",
            ],
        ],
        // A price so high that places get old enough for missed events.
        "age-index" => vec![
            &["policy.age-index.price=3"],
            &["policy.age-index.price=3", "bs.battery_knowledge=reported"],
            &[
                "policy.age-index.price=3",
                "policy.age-index.foresight=40",
                "harvest.kind=diurnal",
                "bs.battery_knowledge=reported",
            ],
            &["sensing.kind=probabilistic", "sensing.eta=0.5"],
        ],
        "dt" => vec![
            &["policy.dt.price=3", "policy.dt.miss_cost=0.5"],
            &["policy.dt.target=0.3", "bs.battery_knowledge=reported"],
            &["sensing.kind=probabilistic", "sensing.eta=0.5"],
        ],
        _ => vec![&["devices=30"]],
    }
}

#[test]
fn a_base_station_knows_only_alpha_of_the_event_process() {
    // Debug texts of all that a policy is built from.
    let knowledge_and_site = |fields: &[&str]| {
        let prepared = prepare_policy("knn", fields);
        let site = format!("{:?}", prepared.scenario.site());
        (format!("{:?}", prepared.knowledge()), site)
    };
    let alpha = "events.alpha=0.25";
    let (knowledge, site) = knowledge_and_site(&[alpha]);
    assert!(knowledge.contains("alpha: 0.25") && site.contains("alpha: 0.25"));
    for process in [
        &["events.process=hot-spots", "events.hot-spots.sigma=0.5"][..],
        &["events.process=aftershocks", "events.aftershocks.radius=1"],
        &["events.duration_kind=geometric"],
        &["events.duration=9"],
        &[
            "events.process=bursts",
            "events.bursts.busy_alpha=0.4",
            "events.bursts.quiet_alpha=0.1",
            "events.bursts.busy_ttis=10",
            "events.bursts.quiet_ttis=10",
        ],
    ] {
        let fields = [process, &[alpha]].concat();
        assert_eq!(
            knowledge_and_site(&fields),
            (knowledge.clone(), site.clone()),
            "{process:?}"
        );
    }
    assert_ne!(knowledge_and_site(&["events.alpha=0.26"]), (knowledge, site));
}

/// Ground truth has one interface, which only `genie` uses.
#[test]
fn only_the_genie_can_access_ground_truth() {
    for policy in registry::POLICIES {
        let prepared = prepare_policy(policy.name, fields_of_scenarios(policy.name)[0]);
        let has_oracle = prepared.policy(&prepared.knowledge()).oracle().is_some();
        assert_eq!(has_oracle, policy.name == "genie", "{}", policy.name);
        assert_eq!(has_oracle, policy.is_bound, "{}", policy.name);
    }
}

/// Prepares the runs of all policies of the registry except `genie`, which receives events.
fn prepare_runs() -> Vec<PreparedRun> {
    let names = registry::names().filter(|name| *name != "genie");
    names
        .flat_map(|name| {
            let scenarios = fields_of_scenarios(name).into_iter();
            scenarios.map(move |fields| prepare_policy(name, fields))
        })
        .collect()
}

/// Runs `script` and checks that a policy that can wake devices does, since the test is vacuous otherwise.
fn play_with_wake_ups(prepared: &PreparedRun, script: &[ScriptedEvent]) -> DecisionObserver {
    let observed = play(prepared, script);
    let name = prepared.scenario.policy.name();
    let can_wake = registry::named(name).expect("a policy").wakes;
    let count = observed.transcript.wake_ups.len();
    assert_eq!(
        count > 0,
        can_wake,
        "{name}: {count} wake-ups; change its fields_of_scenarios"
    );
    observed
}

#[test]
fn the_position_of_an_unreported_event_changes_no_decision() {
    for prepared in prepare_runs() {
        let name = prepared.scenario.policy.name();
        let script = draw_script(&prepared);
        let original = play_with_wake_ups(&prepared, &script);
        let mut stream = Stream::new(78, Purpose::Epicentre, 0);
        let (width, height) = (prepared.scenario.area.width, prepared.scenario.area.height);
        let mut moved_script = script.clone();
        let mut moved_events = 0;
        for (event, record) in moved_script.iter_mut().zip(&original.events) {
            let is_unseen_at = |at| is_unseen(&prepared, &original.transcript, at, event.start, event.duration);
            if record.tally.reports > 0 || !is_unseen_at(event.epicentre) {
                continue;
            }
            let mut places = (0..400).map(|_| Point::new(stream.unit() * width, stream.unit() * height));
            if let Some(place) = places.find(|&at| at.distance(event.epicentre) > 1.0 && is_unseen_at(at)) {
                event.epicentre = place;
                moved_events += 1;
            }
        }
        assert!(moved_events >= 5, "{name}: only {moved_events} events could be moved");
        let changed = play(&prepared, &moved_script);
        assert!(
            original.transcript == changed.transcript,
            "{name}: {moved_events} unseen events were moved, and a decision differs"
        );
        let mut pairs = original.events.iter().zip(&changed.events);
        assert!(pairs.any(|(original, changed)| original.epicentre != changed.epicentre));
    }
}

#[test]
fn the_duration_of_an_unreported_event_changes_no_decision() {
    for prepared in prepare_runs() {
        let name = prepared.scenario.policy.name();
        let script = draw_script(&prepared);
        let original = play_with_wake_ups(&prepared, &script);
        let mut changed_script = script.clone();
        let mut changed_events = 0;
        for (event, record) in changed_script.iter_mut().zip(&original.events) {
            let is_unseen_for =
                |duration| is_unseen(&prepared, &original.transcript, event.epicentre, event.start, duration);
            if record.tally.reports > 0 || !is_unseen_for(event.duration) {
                continue;
            }
            let mut other_durations = (1..=5).rev().filter(|other| *other != event.duration);
            if let Some(duration) = other_durations.find(|duration| is_unseen_for(*duration)) {
                event.duration = duration;
                changed_events += 1;
            }
        }
        assert!(
            changed_events >= 5,
            "{name}: the duration of only {changed_events} events could be changed"
        );
        let changed = play(&prepared, &changed_script);
        assert!(
            original.transcript == changed.transcript,
            "{name}: the durations of {changed_events} unseen events were changed, and a decision differs"
        );
        let mut pairs = original.events.iter().zip(&changed.events);
        assert!(pairs.any(|(original, changed)| original.last != changed.last));
    }
}
