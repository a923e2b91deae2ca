//! The policy of the page docs/writing-a-policy.md: its code is compiled here as it stands there, and runs.

use std::path::Path;

use reveille_bs::policy::kind::Registered;
use reveille_bs::policy::registry::{POLICIES, Registry};
use reveille_bs::prepared::Prepared;
use reveille_common::io::Disk;
use reveille_common::scenario::{Override, PolicyKind, ScenarioError, load};
use reveille_lab::preparation::run as run_here;
use reveille_lab::run::{Options, Run};

#[path = "../../docs/patrol/mod.rs"]
mod patrol;

use patrol::PatrolKind;

const OWN: Registry = &[&PatrolKind];

fn prepared(set: &[&str]) -> Result<Prepared, ScenarioError> {
    let always = ["policy.name=patrol", "devices=60", "ttis=2000"];
    let overrides: Vec<Override> = always
        .iter()
        .chain(set)
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    let kinds: Vec<&'static dyn PolicyKind> = POLICIES.iter().chain(OWN).map(|policy| *policy as _).collect();
    let scenario = load("paper", &overrides, &kinds, &Disk)?;
    Ok(Prepared::with_policies(&scenario, OWN))
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
    for file in ["settings.rs", "mod.rs"] {
        let code = std::fs::read_to_string(docs.join("patrol").join(file)).expect("the code");
        assert!(
            blocks.contains(&code.as_str()),
            "writing-a-policy.md does not show docs/patrol/{file} as it is"
        );
    }
}

#[test]
fn it_runs_alike_with_and_without_lookahead_and_wakes_its_helpers() {
    let prepared = prepared(&[]).expect("a scenario");
    let outcome = |lookahead| {
        let options = Options {
            lookahead,
            ..Options::default()
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
        // With energy enough that nobody runs dry.
        let every = format!("policy.patrol.every={every}");
        let prepared = prepared(&[&every, "harvest.lambda=0.5", "harvest.e_b=50"]).expect("a scenario");
        Run::new(&prepared, Options::default())
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
    // The program itself does not know it.
    assert!(POLICIES.iter().all(|policy| policy.name() != PatrolKind.name()));
    let random = Override::parse("policy.name=random").expect("an override");
    run_here(&reveille_bs::scenario::load("quick", &[random]).expect("a scenario"));
    assert_eq!(PatrolKind.profile().series, 7);
}
