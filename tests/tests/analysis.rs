//! The analysis counts the same transitions in the machines as the reference implementation.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::{DeviceId, Tti};
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_study::analysis::transitions::measure;
use reveille_tests::reference::ReferenceState;
use reveille_tests::{reference, scenarios};

/// Counts transitions by (m, n) in the measured TTIs of a reference run in which every action can be paid.
fn brute(scenario: &Scenario, run: &reference::ReferenceRun) -> [[u64; 5]; 5] {
    let mut first = start(scenario, RunOptions::default());
    first.run_grant(&mut ());
    let plan = first.cycle().plan().clone();
    let from = scenario.warm_up_end().0;
    let mut counts = [[0; 5]; 5];
    for j in 0..scenario.run.devices {
        let mut last: Option<usize> = None;
        for k in from..scenario.run.ttis {
            let start = if plan.duty_cycle(DeviceId(j)).is_on(Tti(k)) {
                1
            } else {
                4
            };
            if let Some(last) = last {
                counts[last][start] += 1;
            }
            let (state, _) = run.trace[k as usize][j as usize];
            last = Some(match state {
                ReferenceState::Idle | ReferenceState::Asleep => start,
                ReferenceState::Transmission => {
                    counts[start][2] += 1;
                    counts[2][3] += 1;
                    3
                }
                ReferenceState::Dark => panic!("TTI {k}, device {j}: an action failed"),
            });
        }
    }
    counts
}

proptest! {
    #![proptest_config(Config { cases: 150, failure_persistence: None, ..Config::default() })]

    #[test]
    fn transitions_are_those_of_the_reference(text in scenarios::rich()) {
        let scenario = scenarios::scenario(&text);
        let expected = reference::simulate(&scenario);
        if expected.ambiguous.is_some() {
            return Err(TestCaseError::reject("too close to call"));
        }
        let counts = brute(&scenario, &expected);
        for t in measure(&scenario, 1).expect("a study").transitions {
            prop_assert_eq!(t.count, counts[t.from][t.to], "P_{},{}\n{}", t.from, t.to, text);
        }
    }

    #[test]
    fn transmissions_are_those_of_the_reference(text in scenarios::small()) {
        let scenario = scenarios::scenario(&text);
        let expected = reference::simulate(&scenario);
        if expected.ambiguous.is_some() {
            return Err(TestCaseError::reject("too close to call"));
        }
        let measured = &expected.trace[scenario.warm_up_end().0 as usize..];
        let sent = measured.iter().flatten().filter(|(state, _)| *state == ReferenceState::Transmission).count();
        let found = measure(&scenario, 1).expect("a study").transitions;
        let count = |m, n| found.iter().find(|t| (t.from, t.to) == (m, n)).map_or(0, |t| t.count);
        prop_assert_eq!(count(2, 3), sent as u64, "{}", text);
        prop_assert_eq!(count(1, 2) + count(4, 2), count(2, 3) + count(2, 4), "{}", text);
    }
}
