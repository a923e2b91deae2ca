//! Compiles and runs the policy code of docs/writing-a-policy.md exactly as printed there.

use std::path::Path;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::prelude::*;
use reveille_bs::policy::registry::{self, POLICIES};
use reveille_common::io::Disk;
use reveille_common::scenario::{Override, ScenarioError, load};
use reveille_lab::preparation::run as run_here;
use reveille_lab::run::{Run, RunOptions};

#[path = "../../docs/patrol.rs"]
#[expect(unreachable_pub, reason = "the page shows a policy of a separate crate")]
mod patrol;

use patrol::PATROL;

fn prepared(set: &[&str]) -> Result<PreparedRun, ScenarioError> {
    let always = ["devices=60", "ttis=2000", "policy.name=patrol"];
    let overrides: Vec<Override> = always
        .iter()
        .chain(set)
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    let mut kinds = registry::kinds();
    kinds.extend([&PATROL, &STUCK]);
    let scenario = load("paper", &overrides, &kinds, &Disk)?.scenario;
    Ok(PreparedRun::without_pilots(&scenario))
}

#[test]
fn the_page_shows_the_code_that_is_tested() {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs");
    let page = std::fs::read_to_string(docs.join("writing-a-policy.md")).expect("the page");
    let blocks: Vec<&str> = page
        .split("```rust\n")
        .skip(1)
        .filter_map(|rest| rest.split("```").next())
        .collect();
    let code = std::fs::read_to_string(docs.join("patrol.rs")).expect("the code");
    assert!(
        blocks.contains(&code.as_str()),
        "writing-a-policy.md does not show the current docs/patrol.rs"
    );
}

#[test]
fn it_runs_alike_with_and_without_lookahead_and_wakes_its_helpers() {
    let prepared = prepared(&[]).expect("a scenario");
    let outcome = |lookahead| {
        let options = RunOptions {
            lookahead,
            ..RunOptions::default()
        };
        Run::new(&prepared, options).finish(&mut ())
    };
    let with = outcome(true);
    assert_eq!(with, outcome(false));
    assert!(
        with.metrics.wake_ups_per_event > 0.5 && with.metrics.wake_ups_per_event <= 2.0,
        "{:?}",
        with.metrics
    );
    assert_eq!(with.facts, [("sensing_share", 0.125)]);
}

#[test]
fn more_devices_that_sense_see_more_events() {
    let missed = |every: u32| {
        // Enough energy for every device.
        let every = format!("policy.patrol.every={every}");
        let prepared = prepared(&[&every, "harvest.lambda=0.5", "harvest.e_b=50"]).expect("a scenario");
        Run::new(&prepared, RunOptions::default())
            .finish(&mut ())
            .metrics
            .misdetection_pct
    };
    assert!(missed(2) < missed(8) && missed(8) < missed(64));
}

#[test]
fn its_settings_are_checked_like_any_others() {
    let error = prepared(&["policy.patrol.every=0"])
        .expect_err("a cycle of no TTI")
        .to_string();
    assert!(
        error.contains("policy.patrol.every = 0") && error.contains("at least 1"),
        "{error}"
    );
    let error = prepared(&["policy.patrol.evry=3"])
        .expect_err("no such field")
        .to_string();
    assert!(error.contains("did you mean `every`"), "{error}");
    // The program's own registry does not contain the policy.
    assert!(POLICIES.iter().all(|policy| policy.name != PATROL.name));
    let random = Override::parse("policy.name=random").expect("an override");
    run_here(
        &reveille_bs::scenario::load("quick", &[random])
            .expect("a scenario")
            .scenario,
    );
}

declare! {
    /// Wakes one device without end.
    #[derive(Clone, Copy, Debug)]
    struct StuckSettings in "policy.stuck" {
        /// The device.
        device: u32 = declare::whole(0, 1_000_000, 3),
    }
}

const STUCK: PolicyEntry = PolicyEntry::for_settings::<StuckSettings>();

impl PolicyFactory for StuckSettings {
    fn build(&self, _: &Knowledge) -> Box<dyn Policy> {
        Box::new(*self)
    }
}

impl Policy for StuckSettings {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        Plan::from_bits((0..seen.known.n()).map(|j| j % 2 == 0))
    }

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        Some(DeviceId(self.device))
    }
}

/// Protects: policy authors, from a run that never ends or differs between memory and bus.
#[test]
#[should_panic(expected = "at most once per TTI")]
fn a_policy_that_wakes_a_device_twice_in_a_tti_is_refused() {
    let prepared = prepared(&["policy.name=stuck"]).expect("a scenario");
    Run::new(&prepared, RunOptions::default()).finish(&mut ());
}

#[test]
#[should_panic(expected = "does not exist")]
fn a_policy_that_wakes_an_unknown_device_is_refused() {
    let prepared = prepared(&["policy.name=stuck", "policy.stuck.device=60"]).expect("a scenario");
    Run::new(&prepared, RunOptions::default()).finish(&mut ());
}
