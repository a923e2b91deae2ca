//! One scenario and seed give one digest, in memory or over the bus, in one process or many. Lookahead, pace, pauses,
//! steps and observers do not change it.

use std::fmt::Write as _;

use reveille_bs::policy::registry::{self, POLICIES};
use reveille_tests::process::{PATIENCE, Process, TestFolder, free_endpoint, unique_run, wait_until};

/// Thirty devices, and enough TTIs for reports, failures and wake-ups.
const SMALL: &str = "-n 30 -k 400";

/// Ways to drive a run that must give the same result.
const WAYS: [&str; 9] = [
    "run",
    "run --no-lookahead",
    "up -P 0",
    "up -P 1",
    "up -P 4",
    "up -P 4",
    "up -P 4 --no-lookahead",
    "up -P 4 --window 7",
    "up -P 30",
];

/// Four ways, for variations of a policy that is tested in all ways.
const FEW_WAYS: [&str; 4] = ["run", "up -P 0", "up -P 4", "up -P 3 --no-lookahead --window 7"];

/// Settings that exercise other code paths of a policy or the world, in addition to the ranking of wake-ups.
const FURTHER: [(&str, &str); 8] = [
    (
        "q-learning",
        "--set bs.battery_knowledge=reported --set bs.ranking=posterior",
    ),
    ("q-learning", "--set bs.battery_knowledge=reported"),
    (
        "q-learning",
        "--set policy.q-learning.learn=true --set policy.q-learning.table=nothing",
    ),
    (
        "knn",
        "--set events.process=bursts --set events.duration_kind=geometric",
    ),
    (
        "q-learning",
        "--set policy.q-learning.ages=true --set bs.ranking=posterior",
    ),
    ("genie", "--set events.process=aftershocks"),
    (
        "age-index",
        "--set harvest.kind=diurnal --set harvest.diurnal.ttis_per_day=60 --set bs.battery_knowledge=reported \
         --set policy.age-index.foresight=20",
    ),
    (
        "knn",
        "--set harvest.kind=diurnal --set harvest.diurnal.ttis_per_day=60 --set harvest.diurnal.sky=clear",
    ),
];

/// All radio failures together.
const FAILING: &str = "--set radio.wake_miss=0.3 --set radio.false_wake_up=0.02 --set radio.uplink_loss=0.2 \
                       --set radio.plan_loss=0.2 --set radio.wake_latency=1 --set radio.interference=bursts \
                       --set bs.sync_interval=37";

fn digest(args: &str) -> String {
    TestFolder::new().summary(args).digest().to_owned()
}

/// Checks that all `ways` to drive one policy on one preset give one digest, and returns it.
fn agreed(preset: &str, policy: &str, ways: &[&str]) -> String {
    let scenario = format!("-s {preset} -p {policy} {SMALL}");
    let folder = TestFolder::new();
    let mut seen = String::new();
    let mut digests = Vec::new();
    for way in ways {
        let summary = folder.summary(&format!("{way} {scenario}"));
        assert!(
            summary.number("totals.events.events") > 0,
            "the scenario shows something"
        );
        let _infallible = writeln!(seen, "{}  {way}", summary.digest());
        digests.push(summary.digest().to_owned());
    }
    digests.dedup();
    assert_eq!(digests.len(), 1, "{scenario}\n{seen}");
    digests.remove(0)
}

/// Checks all ways for the policies whose index in the registry modulo 2 is `remainder`, and that other scenarios have
/// other digests.
fn all_ways_agree_on_half(remainder: usize) {
    for policy in registry::names().skip(remainder).step_by(2) {
        let expected = agreed("paper", policy, &WAYS);
        for other in ["--seed 2", "--set harvest.lambda=0.11", "--set events.alpha=0.21"] {
            let changed = digest(&format!("run -s paper -p {policy} {SMALL} {other}"));
            assert_ne!(changed, expected, "{policy} {other}");
        }
    }
}

#[test]
fn all_modes_agree_on_paper() {
    all_ways_agree_on_half(0);
}

// A separate test, so that two threads share the work.
#[test]
fn all_modes_agree_on_paper_with_learning() {
    all_ways_agree_on_half(1);
}

#[test]
fn modes_agree_on_paper_literal() {
    for policy in registry::names() {
        agreed("paper-literal", policy, &FEW_WAYS);
    }
}

#[test]
fn modes_agree_on_the_other_ranking() {
    for policy in POLICIES.iter().filter(|policy| policy.wakes) {
        agreed(
            "paper",
            &format!("{} --set bs.ranking=posterior", policy.name),
            &FEW_WAYS,
        );
    }
}

#[test]
fn modes_agree_on_further_settings() {
    for (policy, settings) in FURTHER {
        assert!(registry::named(policy).is_some(), "FURTHER names {policy}");
        agreed("paper", &format!("{policy} {settings}"), &FEW_WAYS);
    }
}

/// Checks classes assigned by number, place and share with solar harvest, and a trace of irradiance.
#[test]
fn modes_agree_on_classes_and_panels() {
    let scenarios = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/scenarios");
    let mut digests = Vec::new();
    for (name, policy) in [
        ("day-and-night", "age-index --set bs.battery_knowledge=reported"),
        ("day-and-night", "q-learning"),
        ("solar-panel", "knn --set harvest.trace.panel.tti_seconds=300"),
    ] {
        digests.push(agreed(&format!("{scenarios}/{name}.toml"), policy, &FEW_WAYS));
    }
    digests.dedup();
    assert_eq!(digests.len(), 3);
}

#[test]
fn modes_agree_on_radio_faults() {
    for policy in registry::names() {
        let failing = agreed("paper", &format!("{policy} {FAILING}"), &FEW_WAYS);
        assert_ne!(failing, digest(&format!("run -p {policy} {SMALL}")), "{policy}");
    }
    agreed("paper", &format!("knn {FAILING}"), &WAYS);
}

#[test]
fn policies_and_presets_differ() {
    let each = |preset: &'static str| {
        registry::names().map(move |policy| digest(&format!("run -s {preset} -p {policy} {SMALL}")))
    };
    let mut digests: Vec<String> = ["paper", "paper-literal"].into_iter().flat_map(each).collect();
    let count = digests.len();
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), count);
}

/// Runs a base station and two device processes, with `counts` in join order, and returns the digest.
fn by_hand(counts: [u32; 2]) -> String {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("hand"), free_endpoint());
    let bs = folder.start(&format!("bs {SMALL} --run {run} --listen {endpoint} --json"));
    bs.wait_for_stderr("waiting for 30 devices");
    let mut hosts: Vec<Process> = Vec::new();
    for count in counts {
        let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count {count}"));
        host.wait_for_stderr("joined");
        hosts.push(host);
    }
    let summary = bs.finish().summary();
    for host in hosts {
        let host = host.finish();
        assert!(host.is_success(), "{host}");
    }
    assert_eq!(summary.number("timing.hosts"), 2);
    summary.digest().to_owned()
}

#[test]
fn the_assignment_of_devices_does_not_matter() {
    let expected = digest(&format!("run {SMALL}"));
    assert_eq!(by_hand([7, 23]), expected, "7 and 23");
    assert_eq!(by_hand([23, 7]), expected, "23 and 7");
}

#[test]
fn pace_does_not_matter() {
    let expected = digest(&format!("run {SMALL}"));
    assert_eq!(digest(&format!("up -P 4 {SMALL} --pace 1ms")), expected);
}

#[test]
fn pausing_and_stepping_do_not_matter() {
    let expected = digest(&format!("run {SMALL}"));
    let (folder, run) = (TestFolder::new(), unique_run("stepped"));
    let up = folder.start(&format!("up -P 4 {SMALL} --paused --run {run} --json"));
    folder.wait_for_tti(&run, 0);
    folder.clock(&run, "step");
    folder.wait_for_tti(&run, 1);
    folder.clock(&run, "step 7");
    folder.wait_for_tti(&run, 8);
    folder.clock(&run, "run-to 113");
    folder.wait_for_tti(&run, 113);
    assert_eq!(folder.clock(&run, "status"), "paused before TTI 113 of 400\n");
    folder.clock(&run, "pause");
    folder.clock(&run, "resume");
    assert_eq!(up.finish().summary().digest(), expected);
}

#[test]
fn an_observer_does_not_matter() {
    let expected = digest(&format!("run {SMALL}"));
    let (folder, run) = (TestFolder::new(), unique_run("watched"));
    let up = folder.start(&format!("up -P 4 {SMALL} --paused --no-lookahead --run {run} --json"));
    folder.wait_for_tti(&run, 0);
    let tail = folder.start(&format!("inspect tail --json --run {run}"));
    // Steps until the observer shows a grant, which proves that it receives frames.
    wait_until("the spectator to see something", PATIENCE, || {
        folder.clock(&run, "step");
        tail.stdout().contains("Grant").then_some(())
    });
    folder.clock(&run, "resume");
    assert_eq!(up.finish().summary().digest(), expected);
    let tail = tail.finish();
    assert!(tail.is_success(), "{tail}");
    assert!(tail.stderr.contains("messages shown"), "{tail}");
}
