//! Lookahead (`RunOptions::lookahead`): it saves grants and does not change the outcome. Random scenarios are compared
//! in `ledger.rs`, with windows too; here a run is one window.

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;

const TTIS: u64 = 1500;

fn prepare_policy(policy: &str, battery_knowledge: &str) -> PreparedRun {
    prepare(&paper(&[
        "devices=30",
        &format!("ttis={TTIS}"),
        &format!("policy.name={policy}"),
        &format!("bs.battery_knowledge={battery_knowledge}"),
    ]))
}

/// Runs with or without `lookahead`, and returns the number of grants and the outcome.
fn run_counting_grants(prepared: &PreparedRun, lookahead: bool) -> (u64, RunOutcome) {
    let mut run = Run::new(
        prepared,
        RunOptions {
            lookahead,
            ..RunOptions::default()
        },
    );
    let mut grant_count = 0;
    while run.cycle().next_tti().0 < TTIS {
        run.run_grant(&mut ());
        grant_count += 1;
    }
    (grant_count, run.finish(&mut ()))
}

/// A grant is needed at most once per TTI in which a device may detect an event, and once per end of a window.
#[test]
fn lookahead_saves_grants_and_changes_no_outcome() {
    for policy in ["age-index", "q-learning", "random", "dt", "knn"] {
        let prepared = prepare_policy(policy, "reported");
        let (grants, outcome) = run_counting_grants(&prepared, true);
        let (grants_without_lookahead, outcome_without_lookahead) = run_counting_grants(&prepared, false);
        assert_eq!(outcome, outcome_without_lookahead, "{policy}");
        assert_eq!(grants_without_lookahead, TTIS, "{policy}");
        // With α = 0.2 an event starts on average in at most every fifth TTI, and devices may detect it only in some of
        // its TTIs.
        assert!(grants < TTIS / 2, "{policy}: {grants} grants");
    }
}

/// A policy that receives true battery levels has to wait for them.
#[test]
fn true_battery_levels_prevent_lookahead() {
    let prepared = prepare_policy("q-learning", "oracle");
    let (grants, outcome) = run_counting_grants(&prepared, true);
    assert_eq!(grants, TTIS);
    assert_eq!(outcome, run_counting_grants(&prepared, false).1);
}
