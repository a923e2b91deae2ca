//! The policy `patrol` of docs/writing-a-policy.md, compiled and run exactly as printed there, and the errors for
//! policies that wake devices wrongly. Expected values follow from the defaults in docs/patrol.rs: one device in
//! `every = 8` senses, and at most `helpers = 2` are woken. `tests/program/tutorial.rs` tests docs/tutorial.md.

use std::path::Path;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::prelude::*;
use reveille_bs::policy::registry::{self, POLICIES};
use reveille_common::io::Disk;
use reveille_common::scenario::{ScenarioError, load};
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::overrides;

#[path = "../../docs/patrol.rs"]
#[expect(unreachable_pub, reason = "the page shows a policy of a separate crate")]
mod patrol;

use patrol::PATROL;

/// Loads the preset `paper` under `patrol`, with `fields` of the form `field=value`, and prepares its run.
fn prepare(fields: &[&str]) -> Result<PreparedRun, ScenarioError> {
    let overrides = overrides(&[&["devices=60", "ttis=2000", "policy.name=patrol"], fields].concat());
    let mut all_policies = registry::all_policies();
    all_policies.extend([&PATROL, &STUCK]);
    let scenario = load("paper", &overrides, &all_policies, &Disk)?.scenario;
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
fn patrol_wakes_devices_and_has_one_outcome_with_and_without_lookahead() {
    let prepared = prepare(&[]).expect("a scenario");
    let outcome = |lookahead| {
        let options = RunOptions {
            lookahead,
            ..RunOptions::default()
        };
        Run::new(&prepared, options).finish(&mut ())
    };
    let with_lookahead = outcome(true);
    assert_eq!(with_lookahead, outcome(false));
    // It wakes at most two devices per event.
    let wake_ups_per_event = with_lookahead.metrics.wake_ups_per_event;
    assert!(
        wake_ups_per_event > 0.5 && wake_ups_per_event <= 2.0,
        "{wake_ups_per_event} wake-ups per event"
    );
    assert_eq!(with_lookahead.facts, [("sensing_share", 0.125)]);
}

#[test]
fn patrol_misses_fewer_events_with_more_sensing_devices() {
    let misdetection_pct = |every: u32| {
        // Enough energy for every device.
        let every_override = format!("policy.patrol.every={every}");
        let prepared = prepare(&[&every_override, "harvest.lambda=0.5", "harvest.e_b=50"]).expect("a scenario");
        Run::new(&prepared, RunOptions::default())
            .finish(&mut ())
            .metrics
            .misdetection_pct
    };
    let by_period = [2, 8, 64].map(misdetection_pct);
    assert!(by_period.is_sorted_by(|more, fewer| more < fewer), "{by_period:?}");
}

#[test]
fn invalid_settings_of_patrol_are_refused_with_the_reason() {
    let error = prepare(&["policy.patrol.every=0"])
        .expect_err("a cycle of no TTI")
        .to_string();
    assert!(
        error.contains("policy.patrol.every = 0") && error.contains("at least 1"),
        "{error}"
    );
    let error = prepare(&["policy.patrol.evry=3"])
        .expect_err("no such field")
        .to_string();
    assert!(error.contains("did you mean `policy.patrol.every`"), "{error}");
    // The program's own registry does not contain the policy.
    assert!(POLICIES.iter().all(|policy| policy.name != PATROL.name));
}

declare! {
    /// Wakes one device again and again.
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

/// Protects: policy authors, from a run that never ends or differs between memory and bus. Both
/// texts below are parts of one panic in `bs/src/cycle.rs`.
#[test]
#[should_panic(expected = "at most once per TTI")]
fn a_policy_that_wakes_a_device_twice_in_a_tti_is_refused() {
    let prepared = prepare(&["policy.name=stuck"]).expect("a scenario");
    Run::new(&prepared, RunOptions::default()).finish(&mut ());
}

#[test]
#[should_panic(expected = "does not exist")]
fn a_policy_that_wakes_an_unknown_device_is_refused() {
    let prepared = prepare(&["policy.name=stuck", "policy.stuck.device=60"]).expect("a scenario");
    Run::new(&prepared, RunOptions::default()).finish(&mut ());
}
