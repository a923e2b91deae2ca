//! External decisions: runs that wait at a decision request, answered with a built-in policy's decisions and with
//! nonsense.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::external::wire::{DecisionRequest, Hello};
use reveille_bs::policy::external::{
    DEVICE_FEATURES, Decision, DecisionContext, DecisionStage, GLOBAL_FEATURES, PlanDecision, RecordedDecision,
};
use reveille_bs::policy::{outside, registry};
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::encoding::Encoding;
use reveille_common::event::{EventProcess, ScriptedEvent};
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::io::Disk;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::score::Digest;
use reveille_common::world::World;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::run::{Run, RunOptions};
use reveille_lab::stepped_run::SteppedRun;
use reveille_tests::transcript::CommandTranscript;

fn overrides(policy: &str, set: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    let always = [policy.as_str(), "devices=40", "ttis=1200"];
    let all = always.iter().chain(set);
    all.map(|set| Override::parse(set).expect("an override")).collect()
}

/// Creates the scenario with an external policy.
fn external(set: &[&str]) -> Scenario {
    let overrides = overrides("external", set);
    reveille_common::scenario::load("paper", &overrides, &outside::kinds_with_external(), &Disk)
        .expect("a scenario")
        .scenario
}

fn stepping(scenario: &Scenario, world: World, options: RunOptions) -> SteppedRun<CommandTranscript> {
    let prepared = PreparedRun::without_pilots(scenario);
    SteppedRun::with_world(&prepared, world, options, CommandTranscript::default())
}

fn own_world(scenario: &Scenario) -> World {
    let prepared = PreparedRun::without_pilots(scenario);
    World::new(scenario, &prepared.deployment)
}

/// Returns the digest of a run answered with the decisions of `first`, `at_a_time` wake-ups per answer or all together.
fn replayed(scenario: &Scenario, first: &CommandTranscript, options: RunOptions, at_a_time: usize) -> Digest {
    let mut stepping = stepping(scenario, own_world(scenario), options);
    let mut given = 0_usize;
    while let Some(question) = stepping.pending_decision() {
        let k = question.observation.now;
        match question.stage {
            DecisionStage::Plan => {
                given = 0;
                stepping.decide(PlanDecision {
                    plan: first.plan_at(k),
                    next: k + 1,
                });
            }
            DecisionStage::Wake => {
                let all = first.wake_ups.get(&k.0).map_or(&[][..], Vec::as_slice);
                let until = all.len().min(given.saturating_add(at_a_time));
                stepping.wake(&all[given..until]);
                given = until;
            }
        }
    }
    let (outcome, _) = stepping.finish();
    assert!(outcome.is_complete);
    outcome.digest
}

#[test]
fn external_decisions_of_a_policy_give_its_digest() {
    let lossy = [
        "radio.uplink_loss=0.2",
        "radio.plan_loss=0.1",
        "radio.wake_miss=0.1",
        "radio.wake_latency=1",
    ];
    let settings: [&[&str]; 4] = [
        &[],
        &["bs.battery_knowledge=reported", "bs.ranking=posterior"],
        &["sensing.kind=probabilistic", "sensing.eta=0.5", "harvest.lambda=0.02"],
        &lossy,
    ];
    let mut wake_ups = 0;
    for (policy, set) in registry::names()
        .filter(|name| *name != "genie")
        .flat_map(|name| settings.map(|set| (name, set)))
    {
        let set: Vec<&str> = match policy {
            "adjusted" => set
                .iter()
                .copied()
                .chain(["policy.adjusted.pilot_ttis=300", "policy.adjusted.t_drx=[8]"])
                .collect(),
            _ => set.to_vec(),
        };
        let own = load("paper", &overrides(policy, &set)).expect("a scenario").scenario;
        let (first, own_digest) = CommandTranscript::of(&own);
        wake_ups += first.wake_ups.len();
        let set: Vec<&str> = set.into_iter().filter(|set| !set.starts_with("policy.")).collect();
        let scenario = external(&set);
        let one_by_one = RunOptions {
            lookahead: false,
            ..RunOptions::default()
        };
        for (options, at_a_time) in [
            (RunOptions::default(), usize::MAX),
            (one_by_one, 1),
            (RunOptions::default(), 2),
        ] {
            let digest = replayed(&scenario, &first, options, at_a_time);
            assert_eq!(digest, own_digest, "{policy} {set:?} {options:?} {at_a_time}");
        }
    }
    assert!(wake_ups > 200, "{wake_ups} TTIs with wake-ups");
}

/// A plan that stays valid is requested once, and the run is the same.
#[test]
fn an_unlimited_plan_is_not_requested_again() {
    let scenario = external(&[]);
    let own = load("paper", &overrides("knn", &[])).expect("a scenario").scenario;
    let (first, digest) = CommandTranscript::of(&own);
    let mut stepping = stepping(&scenario, own_world(&scenario), RunOptions::default());
    let mut plans = 0;
    while let Some(question) = stepping.pending_decision() {
        let k = question.observation.now;
        match question.stage {
            DecisionStage::Plan => {
                plans += 1;
                let (plan, next) = (first.plan_at(k), Tti::NEVER);
                stepping.decide(PlanDecision { plan, next });
            }
            DecisionStage::Wake => {
                let all: Vec<DeviceId> = first.wake_ups.get(&k.0).cloned().unwrap_or_default();
                let left: Vec<DeviceId> = all.into_iter().filter(|j| question.may_wake(*j)).collect();
                stepping.wake(&left);
            }
        }
    }
    assert_eq!((plans, stepping.finish().0.digest), (1, digest));
}

/// Returns the full content of a decision request as text.
fn said(question: &DecisionContext<'_>) -> String {
    let seen = &question.observation;
    let n = question.observation.known.n() as u32;
    let each = |j| {
        let j = DeviceId(j);
        (seen.can_report(j), question.may_wake(j), seen.is_asleep(j))
    };
    let devices: Vec<(bool, bool, bool)> = (0..n).map(each).collect();
    let at = (seen.now, question.stage, seen.plan, seen.information);
    let mut rows = vec![0.0; n as usize * DEVICE_FEATURES.len()];
    let (mut row, mut mask) = ([0.0; GLOBAL_FEATURES.len()], vec![0; n as usize]);
    question.write_devices(&mut rows);
    question.write_globals(&mut row);
    question.write_mask(&mut mask);
    let numbers = (rows, row, mask);
    // The decision request in its bus form.
    let known = Hello::new("run".to_owned(), seen.known);
    let asked = (DecisionRequest::new(question, 0, "client"), known);
    let asked = String::from_utf8(Encoding::Json.encode(&asked)).expect("JSON");
    format!(
        "{asked} {at:?} {:?} {:?} {:?} {devices:?} {numbers:?}",
        seen.batteries, question.heard, question.woken
    )
}

/// Answers with random draws that depend only on the earlier requests.
fn drawn(stepping: &mut SteppedRun<CommandTranscript>, stream: &mut Stream) -> Vec<String> {
    let mut heard = Vec::new();
    while let Some(question) = stepping.pending_decision() {
        heard.push(said(&question));
        let (n, k) = (question.observation.known.n() as u64, question.observation.now);
        match question.stage {
            DecisionStage::Plan => stepping.decide(PlanDecision {
                plan: Plan::from_bits((0..n).map(|_| stream.below(12) == 0)),
                next: k + 1 + stream.below(3),
            }),
            DecisionStage::Wake => {
                let count = stream.below(4);
                let devices: Vec<DeviceId> = (0..count).map(|_| DeviceId(stream.below(n + 5) as u32)).collect();
                stepping.wake(&devices);
            }
        }
    }
    heard
}

#[test]
fn impossible_wake_ups_are_dropped() {
    let scenario = external(&["ttis=400"]);
    let mut stepping = stepping(&scenario, own_world(&scenario), RunOptions::default());
    let mut rounds = 0;
    while let Some(question) = stepping.pending_decision() {
        let n = question.observation.known.n() as u32;
        let all: Vec<DeviceId> = (0..n).map(DeviceId).collect();
        match question.stage {
            DecisionStage::Plan => {
                assert!(all.iter().all(|j| !question.may_wake(*j)));
                // A plan with one bit too many, or with an invalid cycle.
                let odd = question.observation.now.0 % 2 == 1;
                let one = (question.observation.now.0 % u64::from(n)) as usize;
                let plan = if odd {
                    Plan::from_bits((0..n as usize + 9).map(|j| j >= n as usize || j == one || j + 1 == one))
                } else {
                    let none = DutyCycle {
                        t_on: 5,
                        t_drx: 0,
                        offset: 1,
                    };
                    let mut cycles = vec![none; n as usize + 2];
                    cycles[one] = DutyCycle::SENSING;
                    Plan::Periodic(cycles)
                };
                let next = Tti::ZERO;
                stepping.decide(PlanDecision { plan, next });
            }
            DecisionStage::Wake => {
                let k = question.observation.now;
                let before = stepping.observer().wake_ups.get(&k.0).cloned().unwrap_or_default();
                let on: Vec<DeviceId> = all
                    .iter()
                    .copied()
                    .filter(|j| !question.observation.is_asleep(*j))
                    .collect();
                assert!(question.heard.iter().all(|report| report.tti == k));
                let own = all.iter().copied().filter(|j| question.may_wake(*j));
                let two: Vec<DeviceId> = own.take(2).collect();
                assert!(!two.is_empty() && two.iter().all(|j| !on.contains(j) && !before.contains(j)));
                // Devices in S1, out of range or already woken, each of them twice.
                let beyond = [DeviceId(n), DeviceId(u32::MAX)];
                let nonsense: Vec<DeviceId> = [&on, &beyond[..], &before].concat();
                let answer = match before.len() {
                    0..4 => [&nonsense, &two[..], &two[..]].concat(),
                    _ => nonsense,
                };
                let expected = if before.len() < 4 {
                    [&before[..], &two].concat()
                } else {
                    before
                };
                stepping.wake(&answer);
                let after = stepping.observer().wake_ups.get(&k.0).cloned().unwrap_or_default();
                assert_eq!(after, expected);
                rounds += 1;
            }
        }
    }
    let (outcome, transcript) = stepping.finish();
    assert!(rounds > 30, "{rounds} rounds");
    assert!(outcome.is_complete && transcript.plans.len() == 400);
    for (k, plan) in transcript.plans {
        let on = (0..60).filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k))).count();
        assert!((1..=2).contains(&on), "TTI {k}: {on}");
    }
}

/// A truncated input log is reported at the missing decision, also within a TTI; no decision is invented.
#[test]
fn a_run_stands_where_its_log_ends() {
    for hold in [1, 40] {
        let scenario = external(&["ttis=300"]);
        let mut stepping = stepping(&scenario, own_world(&scenario), RunOptions::default());
        let (mut stream, mut all) = (Stream::new(9, Purpose::Training, 0), ExternalInputs::default());
        while let Some(question) = stepping.pending_decision() {
            let (tti, n) = (question.observation.now, question.observation.known.n() as u64);
            let answer = match question.stage {
                DecisionStage::Plan => Decision::Plan(PlanDecision {
                    plan: Plan::from_bits((0..n).map(|_| stream.below(9) == 0)),
                    next: tti + hold,
                }),
                DecisionStage::Wake => {
                    Decision::Wake((0..stream.below(3)).map(|_| DeviceId(stream.below(n) as u32)).collect())
                }
            };
            match answer.clone() {
                Decision::Plan(decision) => stepping.decide(decision),
                Decision::Wake(devices) => stepping.wake(&devices),
            }
            all.decisions.push(RecordedDecision { tti, decision: answer });
        }
        let digest = stepping.finish().0.digest;
        let prepared = PreparedRun::without_pilots(&scenario);
        let end = Tti(scenario.run.ttis);
        let wakes = |at: usize| all.decisions.get(at).map(|next| next.decision.stage()) == Some(DecisionStage::Wake);
        assert!((0..all.decisions.len()).filter(|at| wakes(*at)).count() > 20);
        for length in 0..=all.decisions.len() {
            let mut run = Run::new(&prepared, RunOptions::default());
            run.schedule_inputs(&ExternalInputs {
                decisions: all.decisions[..length].to_vec(),
                ..ExternalInputs::default()
            });
            let goes_on = run.advance(end, &mut ());
            let next = all.decisions.get(length).map(|next| next.tti);
            assert_eq!(
                (run.missing_decision(), goes_on),
                (next, next.is_none()),
                "{length} of {}",
                all.decisions.len()
            );
            assert_eq!(run.cycle().is_open(), wakes(length));
            if next.is_none() {
                assert_eq!(run.finish(&mut ()).digest, digest);
            }
        }
    }
}

#[test]
fn a_branch_continues_independently() {
    let scenario = external(&["ttis=300", "bs.battery_knowledge=reported"]);
    for answers in [120, 121, 122, 123, 124] {
        let mut trunk = stepping(&scenario, own_world(&scenario), RunOptions::default());
        for _ in 0..answers {
            let question = trunk.pending_decision().expect("a question");
            let (k, n) = (question.observation.now, question.observation.known.n() as u64);
            match question.stage {
                DecisionStage::Plan => trunk.decide(PlanDecision {
                    plan: Plan::from_bits((0..n).map(|j| (j + k.0) % 9 == 0)),
                    next: k + 1,
                }),
                DecisionStage::Wake => trunk.wake(&[DeviceId((k.0 % n) as u32)]),
            }
        }
        let branches = [1, 1, 2].map(|seed| {
            let mut branch = trunk.fork();
            let heard = drawn(&mut branch, &mut Stream::new(seed, Purpose::Training, 0));
            (heard, branch.finish().0.digest)
        });
        let heard = drawn(&mut trunk, &mut Stream::new(1, Purpose::Training, 0));
        let own = (heard, trunk.finish().0.digest);
        assert_eq!(branches[0], own);
        assert_eq!(branches[1], own);
        assert_ne!(branches[2], own);
    }
}

/// Generates events every few TTIs at random places.
fn script(scenario: &Scenario) -> Vec<ScriptedEvent> {
    let mut stream = Stream::new(77, Purpose::Epicentre, 0);
    let event = |i: u64| ScriptedEvent {
        start: Tti(6 * i + stream.below(3)),
        duration: 1 + stream.below(3),
        epicentre: Point::new(
            stream.unit() * scenario.area.width,
            stream.unit() * scenario.area.height,
        ),
    };
    (0..scenario.run.ttis / 6).map(event).collect()
}

#[test]
fn the_position_of_an_unreported_event_changes_no_request() {
    for knowledge in ["reported", "oracle"] {
        let scenario = external(&["ttis=600", &format!("bs.battery_knowledge={knowledge}")]);
        let prepared = PreparedRun::without_pilots(&scenario);
        let play = |script: &[ScriptedEvent]| {
            let process = EventProcess::scripted(script.to_vec());
            let world = World::with_events(&scenario, &prepared.deployment, process);
            let mut stepping = stepping(&scenario, world, RunOptions::default());
            let heard = drawn(&mut stepping, &mut Stream::new(5, Purpose::Training, 0));
            (heard, stepping.finish().1)
        };
        let script = script(&scenario);
        let (heard, transcript) = play(&script);
        let is_unseen = |at: Point, event: &ScriptedEvent| {
            let devices = prepared.deployment.devices.iter();
            let near = devices.filter(|j| j.position.distance(at) <= scenario.sensing.d_max);
            let near: Vec<DeviceId> = near.map(|j| j.id).collect();
            let mut ttis = (event.start.0..event.start.0 + event.duration).map(Tti);
            ttis.all(|k| {
                let plan = transcript.plan_at(k);
                !near.iter().any(|j| plan.duty_cycle(*j).is_on(k))
            })
        };
        let (mut moved, mut count) = (script.clone(), 0);
        let mut stream = Stream::new(78, Purpose::Epicentre, 0);
        for (event, record) in moved.iter_mut().zip(&transcript.events) {
            if record.tally.reports > 0 || !is_unseen(event.epicentre, event) {
                continue;
            }
            let (width, height) = (scenario.area.width, scenario.area.height);
            let mut places = (0..300).map(|_| Point::new(stream.unit() * width, stream.unit() * height));
            let elsewhere = |at: &Point| at.distance(event.epicentre) > 1.0 && is_unseen(*at, event);
            if let Some(place) = places.find(elsewhere) {
                event.epicentre = place;
                count += 1;
            }
        }
        assert!(count >= 5, "only {count} events could be moved");
        let (again, second) = play(&moved);
        assert!(
            heard == again,
            "{knowledge}: {count} unseen events were moved, and a question tells"
        );
        assert_ne!(transcript.events, second.events);
        // The check detects a visible event.
        let seen = transcript
            .events
            .iter()
            .position(|event| event.tally.reports > 0)
            .expect("seen");
        moved[seen].epicentre = Point::new(0.01, 0.01);
        assert!(heard != play(&moved).0);
    }
}

/// The external policy cannot be run by name only.
#[test]
fn the_external_policy_is_not_listed() {
    assert!(registry::names().all(|name| name != "external"));
    let error = load("paper", &overrides("external", &[]))
        .expect_err("no policy process can answer")
        .to_string();
    assert!(error.contains("external") && error.contains("knn"), "{error}");
}
