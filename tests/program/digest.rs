//! One scenario and seed give one digest, however the run is driven: in memory or over the bus, in one process or many,
//! with or without lookahead, paced, paused, stepped or watched.

use std::fmt::Write as _;

use reveille_tests::process::{Folder, PATIENCE, Process, free_endpoint, unique_run, wait_until};

/// Thirty devices and as many TTIs as show reports, failures and wake-ups.
const SMALL: &str = "-n 30 -k 400";

/// The ways to drive a run that must not be told from one another.
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

fn digest(args: &str) -> String {
    Folder::new().summary(args).digest().to_owned()
}

/// Every way to drive one policy on one preset.
fn every_way_agrees(preset: &str, policy: &str) {
    let scenario = format!("-s {preset} -p {policy} {SMALL}");
    let folder = Folder::new();
    let mut seen = String::new();
    let mut digests = Vec::new();
    for way in WAYS {
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
    for other in ["--seed 2", "--set harvest.lambda=0.11", "--set events.alpha=0.21"] {
        let changed = folder.summary(&format!("run {scenario} {other}"));
        assert_ne!(changed.digest(), digests[0], "{scenario} {other}");
    }
}

#[test]
fn knn_on_paper() {
    every_way_agrees("paper", "knn");
}

#[test]
fn adjusted_on_paper() {
    every_way_agrees("paper", "adjusted");
}

#[test]
fn adjusted_on_paper_literal() {
    every_way_agrees("paper-literal", "adjusted");
}

#[test]
fn random_on_paper() {
    every_way_agrees("paper", "random");
}

#[test]
fn genie_on_paper() {
    every_way_agrees("paper", "genie");
}

#[test]
fn knn_on_paper_literal() {
    every_way_agrees("paper-literal", "knn");
}

#[test]
fn random_on_paper_literal() {
    every_way_agrees("paper-literal", "random");
}

#[test]
fn genie_on_paper_literal() {
    every_way_agrees("paper-literal", "genie");
}

/// Ways to know batteries and to rank candidates; q-learning decides in every TTI.
fn every_way_agrees_on_q_learning(preset: &str, ways: &[(&str, &str)]) {
    for (knowledge, ranking) in ways {
        let fields = format!("--set bs.battery_knowledge={knowledge} --set bs.ranking={ranking}");
        every_way_agrees(preset, &format!("q-learning {fields}"));
    }
}

#[test]
fn q_learning_on_paper() {
    let ways = [
        ("oracle", "p42"),
        ("oracle", "posterior"),
        ("reported", "p42"),
        ("reported", "posterior"),
    ];
    every_way_agrees_on_q_learning("paper", &ways);
}

#[test]
fn q_learning_on_paper_literal() {
    every_way_agrees_on_q_learning("paper-literal", &[("oracle", "posterior"), ("reported", "p42")]);
}

#[test]
fn learning_on_paper() {
    let learning = "q-learning --set policy.q-learning.learn=true --set policy.q-learning.table=nothing";
    every_way_agrees("paper", learning);
}

#[test]
fn rankings_agree_for_policies_that_wake() {
    for policy in ["knn", "adjusted"] {
        every_way_agrees("paper", &format!("{policy} --set bs.ranking=posterior"));
    }
}

#[test]
fn policies_and_presets_differ() {
    let mut digests: Vec<String> = ["paper", "paper-literal"]
        .into_iter()
        .flat_map(|preset| {
            ["knn", "random", "genie"].map(|policy| digest(&format!("run -s {preset} -p {policy} {SMALL}")))
        })
        .collect();
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), 6);
}

/// A base station and two device processes, each started by itself; `counts` are in the order in which they join.
fn by_hand(counts: [u32; 2]) -> String {
    let (folder, run, endpoint) = (Folder::new(), unique_run("hand"), free_endpoint());
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
fn who_carries_which_devices_does_not_matter() {
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
    let (folder, run) = (Folder::new(), unique_run("stepped"));
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
fn a_spectator_does_not_matter() {
    let expected = digest(&format!("run {SMALL}"));
    let (folder, run) = (Folder::new(), unique_run("watched"));
    let up = folder.start(&format!("up -P 4 {SMALL} --paused --no-lookahead --run {run} --json"));
    folder.wait_for_tti(&run, 0);
    let tail = folder.start(&format!("inspect tail --json --run {run}"));
    // Steps that the spectator sees show that it watches.
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
