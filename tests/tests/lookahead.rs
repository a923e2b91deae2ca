//! Lookahead: the number of TTIs in a grant does not change the result.

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::scenario::{Override, load};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

const TTIS: u64 = 1500;

fn prepared(policy: &str, knowledge: &str) -> PreparedRun {
    let set = [
        "devices=30".to_owned(),
        format!("ttis={TTIS}"),
        format!("policy.name={policy}"),
        format!("bs.battery_knowledge={knowledge}"),
    ];
    let set = set.map(|set| Override::parse(&set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario").scenario)
}

/// Returns the number of grants and the outcome of the run.
fn grants(prepared: &PreparedRun, lookahead: bool) -> (u64, RunOutcome) {
    let mut run = Run::new(
        prepared,
        RunOptions {
            lookahead,
            ..RunOptions::default()
        },
    );
    let mut grants = 0;
    while run.cycle().next_tti().0 < TTIS {
        run.run_grant(&mut ());
        grants += 1;
    }
    (grants, run.finish(&mut ()))
}

/// Grants at most once per TTI in which a device may detect an event, and once per end of a window.
#[test]
fn a_policy_that_decides_in_every_tti_decides_ahead() {
    for policy in ["age-index", "q-learning", "random", "dt", "knn"] {
        let prepared = prepared(policy, "reported");
        let (ahead, outcome) = grants(&prepared, true);
        let (plain, same) = grants(&prepared, false);
        assert_eq!(outcome, same, "{policy}");
        assert_eq!(plain, TTIS, "{policy}");
        // At α = 0.2 at most one event starts in five TTIs. A device may detect it only in some of its TTIs.
        assert!(ahead < TTIS / 2, "{policy}: {ahead} grants");
    }
}

/// A policy that receives true battery levels has to wait for them.
#[test]
fn true_batteries_are_not_predicted() {
    let prepared = prepared("q-learning", "oracle");
    let (ahead, outcome) = grants(&prepared, true);
    assert_eq!(ahead, TTIS);
    assert_eq!(outcome, grants(&prepared, false).1);
}
