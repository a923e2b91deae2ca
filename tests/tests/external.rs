//! External decisions in memory (`SteppedRun`): a run answered with the decisions of a built-in policy equals the run
//! of that policy. Invalid wake-ups, truncated input logs and forks are tested too, and that a request does not reveal
//! unreported events. The bus is tested in `tests/program/`. Minimum counts in the assertions ensure that a case occurs
//! often enough.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::external::wire::{DecisionRequest, Hello};
use reveille_bs::policy::external::{
    DEVICE_FEATURES, Decision, DecisionContext, DecisionStage, GLOBAL_FEATURES, PlanDecision, RecordedDecision,
};
use reveille_bs::policy::{outside, registry};
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::deployment::Deployment;
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
use reveille_tests::compare::ONE_TTI_PER_GRANT;
use reveille_tests::scenarios;
use reveille_tests::transcript::CommandTranscript;

/// Returns the overrides for a short run of `policy`, which `fields` can override again.
fn overrides(policy: &str, fields: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    scenarios::overrides(&[&[policy.as_str(), "devices=40", "ttis=1200"], fields].concat())
}

/// Creates a scenario with a built-in policy.
fn built_in(policy: &str, fields: &[&str]) -> Scenario {
    load("paper", &overrides(policy, fields)).expect("a scenario").scenario
}

/// Creates a scenario with an external policy.
fn external(fields: &[&str]) -> Scenario {
    let overrides = overrides("external", fields);
    reveille_common::scenario::load("paper", &overrides, &outside::kinds_with_external(), &Disk)
        .expect("a scenario")
        .scenario
}

/// Creates a run with the events of `world`.
fn stepped_run_in_world(scenario: &Scenario, world: World, options: RunOptions) -> SteppedRun<CommandTranscript> {
    let prepared = PreparedRun::without_pilots(scenario);
    SteppedRun::with_world(&prepared, world, options, CommandTranscript::default())
}

/// Creates a run with the events of the scenario.
fn stepped_run(scenario: &Scenario, options: RunOptions) -> SteppedRun<CommandTranscript> {
    let world = World::new(scenario, &Deployment::new(scenario));
    stepped_run_in_world(scenario, world, options)
}

/// Returns the digest of a run answered with the decisions of `transcript`, at most `max_wake_ups` wake-ups per answer.
/// Plans are limited to one TTI, so one is requested in every TTI.
fn digest_with_decisions(
    scenario: &Scenario,
    transcript: &CommandTranscript,
    options: RunOptions,
    max_wake_ups: usize,
) -> Digest {
    let mut run = stepped_run(scenario, options);
    // Wake-ups of this TTI in earlier answers.
    let mut answered_count = 0_usize;
    while let Some(request) = run.pending_decision() {
        let k = request.observation.now;
        match request.stage {
            DecisionStage::Plan => {
                answered_count = 0;
                run.decide(PlanDecision {
                    plan: transcript.plan_at(k),
                    next: k + 1,
                });
            }
            DecisionStage::Wake => {
                let wake_ups = transcript.wake_ups_in(k);
                let answered_before = answered_count;
                answered_count = wake_ups.len().min(answered_before.saturating_add(max_wake_ups));
                run.wake(&wake_ups[answered_before..answered_count]);
            }
        }
    }
    let (outcome, _) = run.finish();
    assert!(outcome.is_complete);
    outcome.digest
}

#[test]
fn external_decisions_of_a_policy_give_its_digest() {
    let lossy_radio = [
        "radio.uplink_loss=0.2",
        "radio.plan_loss=0.1",
        "radio.wake_miss=0.1",
        "radio.wake_latency=1",
    ];
    let settings: [&[&str]; 4] = [
        &[],
        &["bs.battery_knowledge=reported", "bs.ranking=posterior"],
        &["sensing.kind=probabilistic", "sensing.eta=0.5", "harvest.lambda=0.02"],
        &lossy_radio,
    ];
    let mut ttis_with_wake_ups = 0;
    for (policy, fields) in registry::names()
        .filter(|name| *name != "genie")
        .flat_map(|name| settings.map(|fields| (name, fields)))
    {
        // Shorten the search.
        let policy_fields: &[&str] = match policy {
            "adjusted" => &["policy.adjusted.pilot_ttis=300", "policy.adjusted.t_drx=[8]"],
            _ => &[],
        };
        let (transcript, expected_digest) =
            CommandTranscript::record(&built_in(policy, &[fields, policy_fields].concat()));
        ttis_with_wake_ups += transcript.wake_ups.len();
        let scenario = external(fields);
        for (options, max_wake_ups) in [
            (RunOptions::default(), usize::MAX),
            (ONE_TTI_PER_GRANT, 1),
            (RunOptions::default(), 2),
        ] {
            let digest = digest_with_decisions(&scenario, &transcript, options, max_wake_ups);
            assert_eq!(
                digest, expected_digest,
                "{policy} {fields:?} {options:?}, {max_wake_ups} wake-ups per answer"
            );
        }
    }
    assert!(ttis_with_wake_ups > 200, "{ttis_with_wake_ups} TTIs with wake-ups");
}

/// A plan without an end is requested once, and the run is the same.
#[test]
fn an_unlimited_plan_is_not_requested_again() {
    let (transcript, expected_digest) = CommandTranscript::record(&built_in("knn", &[]));
    let mut run = stepped_run(&external(&[]), RunOptions::default());
    let mut plan_requests = 0;
    while let Some(request) = run.pending_decision() {
        match transcript.decision(request.stage, request.observation.now, |j| request.may_wake(j)) {
            Decision::Plan(PlanDecision { plan, .. }) => {
                plan_requests += 1;
                let next = Tti::NEVER;
                run.decide(PlanDecision { plan, next });
            }
            Decision::Wake(devices) => run.wake(&devices),
        }
    }
    assert_eq!((plan_requests, run.finish().0.digest), (1, expected_digest));
}

/// Returns the full content of a decision request as text. A test compares requests by this text, so add every new
/// field or accessor of `DecisionContext` and `Observation` here; the messages hold only the fields sent to a policy
/// process.
fn request_text(request: &DecisionContext<'_>) -> String {
    let observation = &request.observation;
    let n = observation.known.n() as u32;
    let device_knowledge = |id| {
        let j = DeviceId(id);
        (observation.can_report(j), request.may_wake(j), observation.is_asleep(j))
    };
    let devices: Vec<(bool, bool, bool)> = (0..n).map(device_knowledge).collect();
    let state = (
        observation.now,
        request.stage,
        observation.plan,
        observation.information,
    );
    let mut device_features = vec![0.0; n as usize * DEVICE_FEATURES.len()];
    let (mut global_features, mut mask) = ([0.0; GLOBAL_FEATURES.len()], vec![0; n as usize]);
    request.write_devices(&mut device_features);
    request.write_globals(&mut global_features);
    request.write_mask(&mut mask);
    let features = (device_features, global_features, mask);
    let hello = Hello::new("run".to_owned(), observation.known);
    let messages = (DecisionRequest::new(request, 0, "client"), hello);
    let messages_json = String::from_utf8(Encoding::Json.encode(&messages)).expect("JSON");
    format!(
        "{messages_json} {state:?} {:?} {:?} {:?} {devices:?} {features:?}",
        observation.batteries, request.reports, request.woken
    )
}

/// Answers with random draws, whose number depends only on the earlier requests, and returns the requests.
fn answer_randomly(run: &mut SteppedRun<CommandTranscript>, stream: &mut Stream) -> Vec<String> {
    let mut requests = Vec::new();
    while let Some(request) = run.pending_decision() {
        requests.push(request_text(&request));
        let (n, k) = (request.observation.known.n() as u64, request.observation.now);
        match request.stage {
            DecisionStage::Plan => run.decide(PlanDecision {
                plan: Plan::from_bits((0..n).map(|_| stream.below(12) == 0)),
                next: k + 1 + stream.below(3),
            }),
            DecisionStage::Wake => {
                let count = stream.below(4);
                // Draws 5 ids that do not exist, too.
                let devices: Vec<DeviceId> = (0..count).map(|_| DeviceId(stream.below(n + 5) as u32)).collect();
                run.wake(&devices);
            }
        }
    }
    requests
}

#[test]
fn invalid_wake_ups_and_plans_are_corrected() {
    let scenario = external(&["ttis=400"]);
    let mut run = stepped_run(&scenario, RunOptions::default());
    let mut wake_answers = 0;
    while let Some(request) = run.pending_decision() {
        let n = request.observation.known.n() as u32;
        let all_devices: Vec<DeviceId> = (0..n).map(DeviceId).collect();
        match request.stage {
            DecisionStage::Plan => {
                assert!(all_devices.iter().all(|j| !request.may_wake(*j)));
                // Plans for devices that do not exist, every second one with invalid cycles. One or two devices sense.
                let is_odd = request.observation.now.0 % 2 == 1;
                let sensing_device = (request.observation.now.0 % u64::from(n)) as usize;
                let plan = if is_odd {
                    let is_on = |j| j >= n as usize || j == sensing_device || j + 1 == sensing_device;
                    Plan::from_bits((0..n as usize + 9).map(is_on))
                } else {
                    let invalid_cycle = DutyCycle {
                        t_on: 5,
                        t_drx: 0,
                        offset: 1,
                    };
                    let mut cycles = vec![invalid_cycle; n as usize + 2];
                    cycles[sensing_device] = DutyCycle::SENSING;
                    Plan::Periodic(cycles)
                };
                // A TTI in the past: the plan counts for this TTI only.
                let next = Tti::ZERO;
                run.decide(PlanDecision { plan, next });
            }
            DecisionStage::Wake => {
                let k = request.observation.now;
                let woken_before = run.observer().wake_ups_in(k).to_vec();
                let awake: Vec<DeviceId> = all_devices
                    .iter()
                    .copied()
                    .filter(|j| !request.observation.is_asleep(*j))
                    .collect();
                assert!(request.reports.iter().all(|report| report.tti == k));
                let wakeable = all_devices.iter().copied().filter(|j| request.may_wake(*j));
                let valid: Vec<DeviceId> = wakeable.take(2).collect();
                let is_valid = |j: &DeviceId| !awake.contains(j) && !woken_before.contains(j);
                assert!(!valid.is_empty() && valid.iter().all(is_valid));
                // Devices that are in S1, do not exist or are already woken, and valid ones twice. After 4 wake-ups
                // only invalid ones, so that the wake-ups end.
                let unknown = [DeviceId(n), DeviceId(u32::MAX)];
                let invalid: Vec<DeviceId> = [&awake, &unknown[..], &woken_before].concat();
                let (answer, expected_wake_ups) = if woken_before.len() < 4 {
                    (
                        [&invalid, &valid[..], &valid[..]].concat(),
                        [&woken_before[..], &valid].concat(),
                    )
                } else {
                    (invalid, woken_before)
                };
                run.wake(&answer);
                assert_eq!(run.observer().wake_ups_in(k), expected_wake_ups);
                wake_answers += 1;
            }
        }
    }
    let (outcome, transcript) = run.finish();
    assert!(wake_answers > 30, "{wake_answers} answers with wake-ups");
    assert!(outcome.is_complete && transcript.plans.len() == 400);
    for (k, plan) in transcript.plans {
        // Includes ids that do not exist, from 40 on.
        let sensing_devices = (0..60).filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k))).count();
        assert!(
            (1..=2).contains(&sensing_devices),
            "TTI {k}: {sensing_devices} devices sense"
        );
    }
}

/// A missing decision is reported within a TTI too; no decision is invented.
#[test]
fn a_run_stops_at_the_first_decision_missing_in_its_input_log() {
    for plan_ttis in [1, 40] {
        let scenario = external(&["ttis=300"]);
        let mut run = stepped_run(&scenario, RunOptions::default());
        let (mut stream, mut decisions) = (Stream::new(9, Purpose::Training, 0), Vec::new());
        while let Some(request) = run.pending_decision() {
            let (tti, n) = (request.observation.now, request.observation.known.n() as u64);
            let decision = match request.stage {
                DecisionStage::Plan => Decision::Plan(PlanDecision {
                    plan: Plan::from_bits((0..n).map(|_| stream.below(9) == 0)),
                    next: tti + plan_ttis,
                }),
                DecisionStage::Wake => {
                    Decision::Wake((0..stream.below(3)).map(|_| DeviceId(stream.below(n) as u32)).collect())
                }
            };
            match decision.clone() {
                Decision::Plan(decision) => run.decide(decision),
                Decision::Wake(devices) => run.wake(&devices),
            }
            decisions.push(RecordedDecision { tti, decision });
        }
        let digest = run.finish().0.digest;
        let prepared = PreparedRun::without_pilots(&scenario);
        let run_end = Tti(scenario.run.ttis);
        let is_wake_decision =
            |index: usize| decisions.get(index).map(|recorded| recorded.decision.stage()) == Some(DecisionStage::Wake);
        assert!((0..decisions.len()).filter(|index| is_wake_decision(*index)).count() > 20);
        for logged_count in 0..=decisions.len() {
            let mut run = Run::new(&prepared, RunOptions::default());
            run.schedule_inputs(&ExternalInputs {
                decisions: decisions[..logged_count].to_vec(),
                ..ExternalInputs::default()
            });
            let has_ended = run.advance(run_end, &mut ());
            let missing_tti = decisions.get(logged_count).map(|recorded| recorded.tti);
            assert_eq!(
                (run.missing_decision(), has_ended),
                (missing_tti, missing_tti.is_none()),
                "with {logged_count} of {} decisions",
                decisions.len()
            );
            assert_eq!(run.cycle().is_open(), is_wake_decision(logged_count));
            if missing_tti.is_none() {
                assert_eq!(run.finish(&mut ()).digest, digest);
            }
        }
    }
}

#[test]
fn a_fork_continues_independently() {
    let scenario = external(&["ttis=300", "bs.battery_knowledge=reported"]);
    // Consecutive counts, so that forks can occur at requests for plans and for wake-ups.
    for answer_count in [120, 121, 122, 123, 124] {
        let mut run = stepped_run(&scenario, RunOptions::default());
        for _ in 0..answer_count {
            let request = run.pending_decision().expect("a request");
            let (k, n) = (request.observation.now, request.observation.known.n() as u64);
            match request.stage {
                DecisionStage::Plan => run.decide(PlanDecision {
                    plan: Plan::from_bits((0..n).map(|j| (j + k.0) % 9 == 0)),
                    next: k + 1,
                }),
                DecisionStage::Wake => run.wake(&[DeviceId((k.0 % n) as u32)]),
            }
        }
        let forks = [1, 1, 2].map(|seed| {
            let mut fork = run.fork();
            let requests = answer_randomly(&mut fork, &mut Stream::new(seed, Purpose::Training, 0));
            (requests, fork.finish().0.digest)
        });
        let requests = answer_randomly(&mut run, &mut Stream::new(1, Purpose::Training, 0));
        let original = (requests, run.finish().0.digest);
        assert_eq!(forks[0], original);
        assert_eq!(forks[1], original);
        assert_ne!(forks[2], original);
    }
}

/// Generates events every few TTIs at random places, never two at a time.
fn draw_script(scenario: &Scenario) -> Vec<ScriptedEvent> {
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
        let requests_and_transcript = |script: &[ScriptedEvent]| {
            let process = EventProcess::scripted(script.to_vec());
            let world = World::with_events(&scenario, &prepared.deployment, process);
            let mut run = stepped_run_in_world(&scenario, world, RunOptions::default());
            let requests = answer_randomly(&mut run, &mut Stream::new(5, Purpose::Training, 0));
            (requests, run.finish().1)
        };
        let script = draw_script(&scenario);
        let (requests, transcript) = requests_and_transcript(&script);
        let is_unseen = |at: Point, event: &ScriptedEvent| {
            let devices = prepared.deployment.devices.iter();
            let in_range = devices.filter(|device| device.position.distance(at) <= scenario.sensing.d_max);
            let in_range: Vec<DeviceId> = in_range.map(|device| device.id).collect();
            let mut ttis = (event.start.0..event.start.0 + event.duration).map(Tti);
            ttis.all(|k| {
                let plan = transcript.plan_at(k);
                !in_range.iter().any(|j| plan.duty_cycle(*j).is_on(k))
            })
        };
        let (mut moved_script, mut moved_events) = (script.clone(), 0);
        let mut stream = Stream::new(78, Purpose::Epicentre, 0);
        for (event, record) in moved_script.iter_mut().zip(&transcript.events) {
            if record.tally.reports > 0 || !is_unseen(event.epicentre, event) {
                continue;
            }
            let (width, height) = (scenario.area.width, scenario.area.height);
            let mut places = (0..300).map(|_| Point::new(stream.unit() * width, stream.unit() * height));
            let is_other_unseen_place = |at: &Point| at.distance(event.epicentre) > 1.0 && is_unseen(*at, event);
            if let Some(place) = places.find(is_other_unseen_place) {
                event.epicentre = place;
                moved_events += 1;
            }
        }
        assert!(moved_events >= 5, "only {moved_events} events could be moved");
        let (requests_when_moved, transcript_when_moved) = requests_and_transcript(&moved_script);
        assert!(
            requests == requests_when_moved,
            "{knowledge}: {moved_events} unseen events were moved, and a request differs"
        );
        assert_ne!(transcript.events, transcript_when_moved.events);
        // A reported event that moves does change a request.
        let reported = transcript
            .events
            .iter()
            .position(|event| event.tally.reports > 0)
            .expect("a reported event");
        moved_script[reported].epicentre = Point::new(0.01, 0.01);
        assert!(requests != requests_and_transcript(&moved_script).0);
    }
}

/// Without a policy process the external policy cannot run.
#[test]
fn the_external_policy_is_not_in_the_registry() {
    assert!(registry::names().all(|name| name != "external"));
    let error = load("paper", &overrides("external", &[]))
        .expect_err("no policy process can answer")
        .to_string();
    assert!(error.contains("external") && error.contains("knn"), "{error}");
}
