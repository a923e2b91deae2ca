//! Decisions from outside: runs that stand at a question, answered with what a policy of this program decided, and with
//! nonsense.

use reveille_bs::policy::external::wire::{Asked, Hello};
use reveille_bs::policy::external::{Answer, Answered, DEVICE, Decision, GLOBAL, Question, Stage};
use reveille_bs::policy::outside::{self, EXTERNAL};
use reveille_bs::policy::registry;
use reveille_bs::prepared::Prepared;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::event::{EventProcess, ScriptedEvent};
use reveille_common::forms::Form;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::io::Disk;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::score::Digest;
use reveille_common::world::World;
use reveille_lab::inputs::Inputs;
use reveille_lab::run::{Options, Run};
use reveille_lab::stepping::Stepping;
use reveille_tests::transcript::Transcript;

fn overrides(policy: &str, set: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    let always = [policy.as_str(), "devices=40", "ttis=1200"];
    let all = always.iter().chain(set);
    all.map(|set| Override::parse(set).expect("an override")).collect()
}

/// The scenario in which somebody outside decides.
fn external(set: &[&str]) -> Scenario {
    let overrides = overrides("external", set);
    reveille_common::scenario::load("paper", &overrides, &outside::kinds(), &Disk).expect("a scenario")
}

fn stepping(scenario: &Scenario, world: World, options: Options) -> Stepping<Transcript> {
    let prepared = Prepared::with_policies(scenario, EXTERNAL);
    Stepping::with_world(&prepared, world, options, Transcript::default())
}

fn own_world(scenario: &Scenario) -> World {
    let prepared = Prepared::with_policies(scenario, EXTERNAL);
    World::new(scenario, &prepared.deployment)
}

/// The digest of a run that is answered with what `first` did; wake-ups all at once, or `at_a_time` after another.
fn replayed(scenario: &Scenario, first: &Transcript, options: Options, at_a_time: usize) -> Digest {
    let mut stepping = stepping(scenario, own_world(scenario), options);
    let mut given = 0_usize;
    while let Some(question) = stepping.question() {
        let k = question.seen.now;
        match question.stage {
            Stage::Plan => {
                given = 0;
                stepping.decide(Decision {
                    plan: first.plan_at(k),
                    next: k + 1,
                });
            }
            Stage::Wake => {
                let all = first.wake_ups.get(&k.0).map_or(&[][..], Vec::as_slice);
                let until = all.len().min(given.saturating_add(at_a_time));
                stepping.wake(&all[given..until]);
                given = until;
            }
        }
    }
    let (outcome, _) = stepping.finish();
    assert!(outcome.complete);
    outcome.digest
}

#[test]
fn what_a_policy_decides_gives_its_digest_when_it_comes_from_outside() {
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
        let own = load("paper", &overrides(policy, &set)).expect("a scenario");
        let (first, own_digest) = Transcript::of(&own);
        wake_ups += first.wake_ups.len();
        let set: Vec<&str> = set.into_iter().filter(|set| !set.starts_with("policy.")).collect();
        let scenario = external(&set);
        let one_by_one = Options {
            lookahead: false,
            ..Options::default()
        };
        for (options, at_a_time) in [
            (Options::default(), usize::MAX),
            (one_by_one, 1),
            (Options::default(), 2),
        ] {
            let digest = replayed(&scenario, &first, options, at_a_time);
            assert_eq!(digest, own_digest, "{policy} {set:?} {options:?} {at_a_time}");
        }
    }
    assert!(wake_ups > 200, "{wake_ups} TTIs with wake-ups");
}

/// A plan that holds on is asked for once, and gives the same run.
#[test]
fn a_plan_that_holds_is_asked_for_no_more() {
    let scenario = external(&[]);
    let own = load("paper", &overrides("knn", &[])).expect("a scenario");
    let (first, digest) = Transcript::of(&own);
    let mut stepping = stepping(&scenario, own_world(&scenario), Options::default());
    let mut plans = 0;
    while let Some(question) = stepping.question() {
        let k = question.seen.now;
        match question.stage {
            Stage::Plan => {
                plans += 1;
                let (plan, next) = (first.plan_at(k), Tti::NEVER);
                stepping.decide(Decision { plan, next });
            }
            Stage::Wake => {
                let all: Vec<DeviceId> = first.wake_ups.get(&k.0).cloned().unwrap_or_default();
                let left: Vec<DeviceId> = all.into_iter().filter(|j| question.may_wake(*j)).collect();
                stepping.wake(&left);
            }
        }
    }
    assert_eq!((plans, stepping.finish().0.digest), (1, digest));
}

/// All that a question says, as text.
fn said(question: &Question<'_>) -> String {
    let seen = &question.seen;
    let n = question.seen.known.n() as u32;
    let each = |j| {
        let j = DeviceId(j);
        (seen.can_report(j), question.may_wake(j), seen.is_asleep(j))
    };
    let devices: Vec<(bool, bool, bool)> = (0..n).map(each).collect();
    let at = (seen.now, question.stage, seen.plan, seen.information);
    let mut rows = vec![0.0; n as usize * DEVICE.len()];
    let (mut row, mut mask) = ([0.0; GLOBAL.len()], vec![0; n as usize]);
    question.write_devices(&mut rows);
    question.write_global(&mut row);
    question.write_mask(&mut mask);
    let numbers = (rows, row, mask);
    // What goes over the bus.
    let known = Hello::new("run".to_owned(), seen.known);
    let asked = (Asked::new(question, 0, "somebody"), known);
    let asked = String::from_utf8(Form::Json.encode(&asked)).expect("JSON");
    format!(
        "{asked} {at:?} {:?} {:?} {:?} {devices:?} {numbers:?}",
        seen.batteries, question.heard, question.woken
    )
}

/// Answers by draws that depend on nothing but what was asked before.
fn drawn(stepping: &mut Stepping<Transcript>, stream: &mut Stream) -> Vec<String> {
    let mut heard = Vec::new();
    while let Some(question) = stepping.question() {
        heard.push(said(&question));
        let (n, k) = (question.seen.known.n() as u64, question.seen.now);
        match question.stage {
            Stage::Plan => stepping.decide(Decision {
                plan: Plan::from_bits((0..n).map(|_| stream.below(12) == 0)),
                next: k + 1 + stream.below(3),
            }),
            Stage::Wake => {
                let count = stream.below(4);
                let devices: Vec<DeviceId> = (0..count).map(|_| DeviceId(stream.below(n + 5) as u32)).collect();
                stepping.wake(&devices);
            }
        }
    }
    heard
}

#[test]
fn wake_ups_that_cannot_be_are_dropped_and_end_nothing_else() {
    let scenario = external(&["ttis=400"]);
    let mut stepping = stepping(&scenario, own_world(&scenario), Options::default());
    let mut rounds = 0;
    while let Some(question) = stepping.question() {
        let n = question.seen.known.n() as u32;
        let all: Vec<DeviceId> = (0..n).map(DeviceId).collect();
        match question.stage {
            Stage::Plan => {
                assert!(all.iter().all(|j| !question.may_wake(*j)));
                // One bit too many, and as a cycle that is none.
                let odd = question.seen.now.0 % 2 == 1;
                let one = (question.seen.now.0 % u64::from(n)) as usize;
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
                stepping.decide(Decision { plan, next });
            }
            Stage::Wake => {
                let k = question.seen.now;
                let before = stepping.observer().wake_ups.get(&k.0).cloned().unwrap_or_default();
                let on: Vec<DeviceId> = all.iter().copied().filter(|j| !question.seen.is_asleep(*j)).collect();
                assert!(question.heard.iter().all(|report| report.tti == k));
                let own = all.iter().copied().filter(|j| question.may_wake(*j));
                let two: Vec<DeviceId> = own.take(2).collect();
                assert!(!two.is_empty() && two.iter().all(|j| !on.contains(j) && !before.contains(j)));
                // Devices in S1, beyond the last, woken before, and each one twice.
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
    assert!(outcome.complete && transcript.plans.len() == 400);
    for (k, plan) in transcript.plans {
        let on = (0..60).filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k))).count();
        assert!((1..=2).contains(&on), "TTI {k}: {on}");
    }
}

/// A log that ends too early is noticed at the decision that is missing, be it within a TTI; nothing is made up.
#[test]
fn a_run_stands_where_its_log_ends() {
    for hold in [1, 40] {
        let scenario = external(&["ttis=300"]);
        let mut stepping = stepping(&scenario, own_world(&scenario), Options::default());
        let (mut stream, mut all) = (Stream::new(9, Purpose::Training, 0), Inputs::default());
        while let Some(question) = stepping.question() {
            let (tti, n) = (question.seen.now, question.seen.known.n() as u64);
            let answer = match question.stage {
                Stage::Plan => Answer::Plan(Decision {
                    plan: Plan::from_bits((0..n).map(|_| stream.below(9) == 0)),
                    next: tti + hold,
                }),
                Stage::Wake => Answer::Wake((0..stream.below(3)).map(|_| DeviceId(stream.below(n) as u32)).collect()),
            };
            match answer.clone() {
                Answer::Plan(decision) => stepping.decide(decision),
                Answer::Wake(devices) => stepping.wake(&devices),
            }
            all.decisions.push(Answered { tti, answer });
        }
        let digest = stepping.finish().0.digest;
        let prepared = Prepared::with_policies(&scenario, EXTERNAL);
        let end = Tti(scenario.ttis);
        let wakes = |at: usize| all.decisions.get(at).map(|next| next.answer.stage()) == Some(Stage::Wake);
        assert!((0..all.decisions.len()).filter(|at| wakes(*at)).count() > 20);
        for length in 0..=all.decisions.len() {
            let mut run = Run::new(&prepared, Options::default());
            run.expect_all(&Inputs {
                decisions: all.decisions[..length].to_vec(),
                ..Inputs::default()
            });
            let goes_on = run.advance(end, &mut ());
            let next = all.decisions.get(length).map(|next| next.tti);
            assert_eq!(
                (run.undecided(), goes_on),
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
fn a_branch_goes_on_by_itself() {
    let scenario = external(&["ttis=300", "bs.battery_knowledge=reported"]);
    for answers in [120, 121, 122, 123, 124] {
        let mut trunk = stepping(&scenario, own_world(&scenario), Options::default());
        for _ in 0..answers {
            let question = trunk.question().expect("a question");
            let (k, n) = (question.seen.now, question.seen.known.n() as u64);
            match question.stage {
                Stage::Plan => trunk.decide(Decision {
                    plan: Plan::from_bits((0..n).map(|j| (j + k.0) % 9 == 0)),
                    next: k + 1,
                }),
                Stage::Wake => trunk.wake(&[DeviceId((k.0 % n) as u32)]),
            }
        }
        let branches = [1, 1, 2].map(|seed| {
            let mut branch = trunk.branch();
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

/// Events every few TTIs at random places.
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
    (0..scenario.ttis / 6).map(event).collect()
}

#[test]
fn where_an_event_is_that_nobody_reports_changes_nothing_that_is_asked() {
    for knowledge in ["reported", "oracle"] {
        let scenario = external(&["ttis=600", &format!("bs.battery_knowledge={knowledge}")]);
        let prepared = Prepared::with_policies(&scenario, EXTERNAL);
        let play = |script: &[ScriptedEvent]| {
            let process = EventProcess::scripted(script.to_vec());
            let world = World::with_events(&scenario, &prepared.deployment, process);
            let mut stepping = stepping(&scenario, world, Options::default());
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
        // The same check finds a seen one.
        let seen = transcript
            .events
            .iter()
            .position(|event| event.tally.reports > 0)
            .expect("seen");
        moved[seen].epicentre = Point::new(0.01, 0.01);
        assert!(heard != play(&moved).0);
    }
}

/// It cannot be run by its name alone.
#[test]
fn nobody_lists_it() {
    assert!(registry::names().all(|name| name != "external"));
    let error = load("paper", &overrides("external", &[]))
        .expect_err("nobody would answer")
        .to_string();
    assert!(error.contains("external") && error.contains("knn"), "{error}");
}
