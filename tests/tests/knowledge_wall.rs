//! A policy cannot see ground truth. A change that no base station can observe changes no plan and no wake-up. The
//! genie is the exception: it receives events.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::registry;
use reveille_bs::scenario::{Override, load};
use reveille_common::event::{EventProcess, EventRecord, ScriptedEvent};
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::WeightedPoint;
use reveille_common::plan::Plan;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::world::World;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

/// Commands of a base station in a run, and its beliefs about events.
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

fn play(prepared: &PreparedRun, script: &[ScriptedEvent]) -> DecisionObserver {
    let process = EventProcess::scripted(script.to_vec());
    let world = World::with_events(&prepared.scenario, &prepared.deployment, process);
    let mut watch = DecisionObserver::default();
    Run::with_world(prepared, world, RunOptions::default()).finish(&mut watch);
    watch
}

fn prepared(policy: &str, set: &[&str]) -> PreparedRun {
    let mut overrides = vec![Override::from_flag("--policy", "policy.name", policy).expect("an override")];
    let always = ["devices=40", "ttis=1500", "events.duration=3"];
    overrides.extend(
        always
            .iter()
            .chain(set)
            .map(|set| Override::parse(set).expect("an override")),
    );
    prepare(&load("paper", &overrides).expect("a scenario").scenario)
}

/// Generates events every few TTIs at random places, with gaps in which some can be extended.
fn script(prepared: &PreparedRun) -> Vec<ScriptedEvent> {
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
        let at = transcript.plans.partition_point(|(from, _)| *from <= k);
        let plan = &transcript.plans[at - 1].1;
        let devices = prepared.deployment.devices.iter();
        let mut near = devices.filter(|device| device.position.distance(epicentre) <= d_max);
        !near.any(|device| plan.duty_cycle(device.id).is_on(k))
    })
}

/// Returns the lists of settings to test `policy` with.
fn settings(policy: &str) -> Vec<&'static [&'static str]> {
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

/// The base station knows α and nothing else about events.
#[test]
fn the_event_process_does_not_pass_the_wall() {
    let known = |set: &[&str]| {
        let prepared = prepared("knn", set);
        let site = format!("{:?}", prepared.scenario.site());
        (format!("{:?}", prepared.knowledge()), site)
    };
    let alpha = "events.alpha=0.25";
    let (knowledge, site) = known(&[alpha]);
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
        let set: Vec<&str> = process.iter().copied().chain([alpha]).collect();
        assert_eq!(known(&set), (knowledge.clone(), site.clone()), "{process:?}");
    }
    assert_ne!(known(&["events.alpha=0.26"]), (knowledge, site));
}

/// Ground truth has one interface, which only the genie uses.
#[test]
fn only_the_genie_can_access_ground_truth() {
    for policy in registry::POLICIES {
        let prepared = prepared(policy.name, settings(policy.name)[0]);
        let has_door = prepared.policy(&prepared.knowledge()).oracle().is_some();
        assert_eq!(has_door, policy.name == "genie", "{}", policy.name);
        assert_eq!(has_door, policy.is_bound, "{}", policy.name);
    }
}

/// Returns every policy of the registry except the genie, which receives events.
fn policies() -> Vec<PreparedRun> {
    let names = registry::names().filter(|name| *name != "genie");
    names
        .flat_map(|name| settings(name).into_iter().map(move |set| prepared(name, set)))
        .collect()
}

/// Runs `script` and checks that a policy that can wake devices does, since the test is vacuous otherwise.
fn first(prepared: &PreparedRun, script: &[ScriptedEvent]) -> DecisionObserver {
    let watch = play(prepared, script);
    let name = prepared.scenario.policy.name();
    let can_wake = registry::named(name).expect("a policy").wakes;
    let count = watch.transcript.wake_ups.len();
    assert_eq!(
        count > 0,
        can_wake,
        "{name}: {count} wake-ups; give it other settings above"
    );
    watch
}

#[test]
fn the_position_of_an_unreported_event_changes_no_decision() {
    for prepared in policies() {
        let name = prepared.scenario.policy.name();
        let script = script(&prepared);
        let first = first(&prepared, &script);
        let mut stream = Stream::new(78, Purpose::Epicentre, 0);
        let (width, height) = (prepared.scenario.area.width, prepared.scenario.area.height);
        let mut moved = script.clone();
        let mut count = 0;
        for (event, record) in moved.iter_mut().zip(&first.events) {
            let unseen = |at| is_unseen(&prepared, &first.transcript, at, event.start, event.duration);
            if record.tally.reports > 0 || !unseen(event.epicentre) {
                continue;
            }
            let mut places = (0..400).map(|_| Point::new(stream.unit() * width, stream.unit() * height));
            if let Some(place) = places.find(|&at| at.distance(event.epicentre) > 1.0 && unseen(at)) {
                event.epicentre = place;
                count += 1;
            }
        }
        assert!(count >= 5, "{name}: only {count} events could be moved");
        let second = play(&prepared, &moved);
        assert!(
            first.transcript == second.transcript,
            "{name}: {count} unseen events were moved, and it knew"
        );
        assert!(
            first
                .events
                .iter()
                .zip(&second.events)
                .any(|(a, b)| a.epicentre != b.epicentre)
        );
    }
}

#[test]
fn the_duration_of_an_unreported_event_changes_no_decision() {
    for prepared in policies() {
        let name = prepared.scenario.policy.name();
        let script = script(&prepared);
        let first = first(&prepared, &script);
        let mut changed = script.clone();
        let mut count = 0;
        for (event, record) in changed.iter_mut().zip(&first.events) {
            let unseen = |duration| is_unseen(&prepared, &first.transcript, event.epicentre, event.start, duration);
            if record.tally.reports > 0 || !unseen(event.duration) {
                continue;
            }
            let others = (1..=5).rev().filter(|other| *other != event.duration);
            if let Some(other) = others.into_iter().find(|other| unseen(*other)) {
                event.duration = other;
                count += 1;
            }
        }
        assert!(count >= 5, "{name}: only {count} events could be changed");
        let second = play(&prepared, &changed);
        assert!(
            first.transcript == second.transcript,
            "{name}: {count} unseen events were changed, and it knew"
        );
        assert!(first.events.iter().zip(&second.events).any(|(a, b)| a.last != b.last));
    }
}
