//! One scenario and seed give one digest with `run`, `up` and `bs`, in one process or many. Lookahead, window, pace,
//! pauses, steps, the assignment of devices and observers do not change it; policies, presets, seeds and fields do.
//! Here digests are compared with each other; `tests/digests/` compares them with recorded values. A new policy of the
//! registry takes part without a change here, with its default settings.

use std::fmt::Write as _;

use reveille_bs::policy::registry::{self, POLICIES};
use reveille_tests::process::{PATIENCE, Process, TestFolder, free_endpoint, unique_run, wait_until};

/// Thirty devices, and enough TTIs for reports, failures and wake-ups. [`COMMANDS`], [`digest_of_two_hosts`] and the
/// tests' texts repeat both numbers.
const SMALL: &str = "-n 30 -k 400";

/// Commands that must have the same digest. One occurs twice, since processes are scheduled differently each time.
const COMMANDS: [&str; 9] = [
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

/// Commands for variations of a policy that is tested with all of [`COMMANDS`].
const FEW_COMMANDS: [&str; 4] = ["run", "up -P 0", "up -P 4", "up -P 3 --no-lookahead --window 7"];

/// A policy, and settings that exercise other code paths of this policy or of the world. The posterior ranking of every
/// policy has a separate test.
const FURTHER_SETTINGS: [(&str, &str); 8] = [
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

/// All radio faults together; a new field of `radio` belongs here.
const RADIO_FAULTS: &str = "--set radio.wake_miss=0.3 --set radio.false_wake_up=0.02 --set radio.uplink_loss=0.2 \
                       --set radio.plan_loss=0.2 --set radio.wake_latency=1 --set radio.interference=bursts \
                       --set bs.sync_interval=37";

/// Runs `reveille ARGS` in a new folder and returns the digest.
fn digest(args: &str) -> String {
    TestFolder::new().summary(args).digest().to_owned()
}

/// Checks that all `commands` give one digest for a preset or scenario file with `policy`, which may include options,
/// and returns it.
fn common_digest(source: &str, policy: &str, commands: &[&str]) -> String {
    let scenario = format!("-s {source} -p {policy} {SMALL}");
    let folder = TestFolder::new();
    let mut digest_list = String::new();
    let mut digests = Vec::new();
    for command in commands {
        let summary = folder.summary(&format!("{command} {scenario}"));
        assert!(
            summary.number("totals.events.events") > 0,
            "{command} {scenario}: no events"
        );
        let _infallible = writeln!(digest_list, "{}  {command}", summary.digest());
        digests.push(summary.digest().to_owned());
    }
    digests.dedup();
    assert_eq!(digests.len(), 1, "{scenario}\n{digest_list}");
    digests.remove(0)
}

/// Checks all commands for every second policy of the registry, from index `first` on. Other scenarios must have other
/// digests.
fn check_every_second_policy(first: usize) {
    for policy in registry::names().skip(first).step_by(2) {
        let expected = common_digest("paper", policy, &COMMANDS);
        for change in ["--seed 2", "--set harvest.lambda=0.11", "--set events.alpha=0.21"] {
            let changed = digest(&format!("run -s paper -p {policy} {SMALL} {change}"));
            assert_ne!(changed, expected, "{policy} {change}");
        }
    }
}

#[test]
fn all_commands_agree_on_paper_for_even_policies() {
    check_every_second_policy(0);
}

// A separate test, so that two threads share the work.
#[test]
fn all_commands_agree_on_paper_for_odd_policies() {
    check_every_second_policy(1);
}

#[test]
fn commands_agree_on_paper_literal() {
    for policy in registry::names() {
        common_digest("paper-literal", policy, &FEW_COMMANDS);
    }
}

#[test]
fn commands_agree_on_the_posterior_ranking() {
    for policy in POLICIES.iter().filter(|policy| policy.wakes) {
        common_digest(
            "paper",
            &format!("{} --set bs.ranking=posterior", policy.name),
            &FEW_COMMANDS,
        );
    }
}

#[test]
fn commands_agree_on_further_settings() {
    for (policy, settings) in FURTHER_SETTINGS {
        assert!(registry::named(policy).is_some(), "unknown policy {policy}");
        common_digest("paper", &format!("{policy} {settings}"), &FEW_COMMANDS);
    }
}

/// Checks classes assigned by number, place and share with solar harvest, and a trace of irradiance.
#[test]
fn commands_agree_on_classes_and_panels() {
    let scenarios = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/scenarios");
    let mut digests = Vec::new();
    for (name, policy) in [
        ("day-and-night", "age-index --set bs.battery_knowledge=reported"),
        ("day-and-night", "q-learning"),
        ("solar-panel", "knn --set harvest.trace.panel.tti_seconds=300"),
    ] {
        digests.push(common_digest(
            &format!("{scenarios}/{name}.toml"),
            policy,
            &FEW_COMMANDS,
        ));
    }
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), 3, "distinct digests");
}

#[test]
fn commands_agree_on_radio_faults() {
    for policy in registry::names() {
        let with_faults = common_digest("paper", &format!("{policy} {RADIO_FAULTS}"), &FEW_COMMANDS);
        assert_ne!(with_faults, digest(&format!("run -p {policy} {SMALL}")), "{policy}");
    }
    common_digest("paper", &format!("knn {RADIO_FAULTS}"), &COMMANDS);
}

#[test]
fn policies_and_presets_have_different_digests() {
    let digests_of = |preset: &'static str| {
        registry::names().map(move |policy| digest(&format!("run -s {preset} -p {policy} {SMALL}")))
    };
    let mut digests: Vec<String> = ["paper", "paper-literal"].into_iter().flat_map(digests_of).collect();
    let count = digests.len();
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), count, "distinct digests");
}

/// Runs a base station and two device processes, with `counts` in join order, and returns the digest.
fn digest_of_two_hosts(counts: [u32; 2]) -> String {
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
fn the_assignment_of_devices_does_not_change_the_digest() {
    let expected = digest(&format!("run {SMALL}"));
    assert_eq!(digest_of_two_hosts([7, 23]), expected, "7 and 23");
    assert_eq!(digest_of_two_hosts([23, 7]), expected, "23 and 7");
}

#[test]
fn the_pace_does_not_change_the_digest() {
    let expected = digest(&format!("run {SMALL}"));
    assert_eq!(digest(&format!("up -P 4 {SMALL} --pace 1ms")), expected);
}

#[test]
fn pauses_and_steps_do_not_change_the_digest() {
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
fn an_observer_does_not_change_the_digest() {
    let expected = digest(&format!("run {SMALL}"));
    let (folder, run) = (TestFolder::new(), unique_run("watched"));
    let up = folder.start(&format!("up -P 4 {SMALL} --paused --no-lookahead --run {run} --json"));
    folder.wait_for_tti(&run, 0);
    let tail = folder.start(&format!("inspect tail --json --run {run}"));
    // Steps until the observer shows a grant, which proves that it receives frames. `Grant` is the JSON name of a
    // variant of `ClockMessage`.
    wait_until("the observer to show a grant", PATIENCE, || {
        folder.clock(&run, "step");
        tail.stdout().contains("Grant").then_some(())
    });
    folder.clock(&run, "resume");
    assert_eq!(up.finish().summary().digest(), expected);
    let tail = tail.finish();
    assert!(tail.is_success(), "{tail}");
    assert!(tail.stderr.contains("messages shown"), "{tail}");
}
