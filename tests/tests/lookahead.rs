//! How many TTIs go in one grant, and that it changes nothing.

use reveille_bs::outcome::Outcome;
use reveille_bs::prepared::Prepared;
use reveille_bs::scenario::{Override, load};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run};

const TTIS: u64 = 1500;

fn prepared(policy: &str, knowledge: &str) -> Prepared {
    let set = [
        "devices=30".to_owned(),
        format!("ttis={TTIS}"),
        format!("policy.name={policy}"),
        format!("bs.battery_knowledge={knowledge}"),
    ];
    let set = set.map(|set| Override::parse(&set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario"))
}

/// The number of grants, and what the run came to.
fn grants(prepared: &Prepared, lookahead: bool) -> (u64, Outcome) {
    let mut run = Run::new(
        prepared,
        Options {
            lookahead,
            ..Options::default()
        },
    );
    let mut grants = 0;
    while run.cycle().next_tti().0 < TTIS {
        run.grant(&mut ());
        grants += 1;
    }
    (grants, run.finish(&mut ()))
}

/// No more grants than TTIs in which somebody may hear of an event, and the ends of windows.
#[test]
fn a_policy_that_decides_in_every_tti_decides_ahead() {
    for policy in ["age-index", "q-learning", "random", "dt", "knn"] {
        let prepared = prepared(policy, "reported");
        let (ahead, outcome) = grants(&prepared, true);
        let (plain, same) = grants(&prepared, false);
        assert_eq!(outcome, same, "{policy}");
        assert_eq!(plain, TTIS, "{policy}");
        // At α = 0.2 no more than one event starts in five TTIs. Each brings some TTIs in which somebody may detect it.
        assert!(ahead < TTIS / 2, "{policy}: {ahead} grants");
    }
}

/// Who is told what batteries hold has to wait for them.
#[test]
fn true_batteries_are_not_foreseen() {
    let prepared = prepared("q-learning", "oracle");
    let (ahead, outcome) = grants(&prepared, true);
    assert_eq!(ahead, TTIS);
    assert_eq!(outcome, grants(&prepared, false).1);
}
