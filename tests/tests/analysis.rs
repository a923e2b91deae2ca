//! The state transitions that `study::analysis::transitions` measures, against counts in runs of the reference
//! implementation. The probabilities derived from the counts are not checked here. The radio is perfect, which
//! `measure` requires; if an action cannot be paid, only the transmissions are compared.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::radio::RadioSettings;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_study::analysis::transitions::{Transition, measure};
use reveille_tests::reference::ReferenceState;
use reveille_tests::{reference, scenarios};

/// Number of measured runs: only the scenario's own seed, as in the reference run.
const SEEDS: u64 = 1;

/// Counts transitions from state S_m to state S_n, at `[m][n]`, in the measured TTIs of a reference run in which every
/// action can be paid. Index 0 is unused.
///
/// # Panics
/// If an action failed.
fn count_transitions(scenario: &Scenario, run: &reference::ReferenceRun) -> [[u64; 5]; 5] {
    // The policies of these scenarios send one plan, which holds for the whole run.
    let mut emulated_run = start(scenario, RunOptions::default());
    emulated_run.run_grant(&mut ());
    let plan = emulated_run.cycle().plan().clone();
    let mut counts = [[0; 5]; 5];
    for j in 0..scenario.run.devices {
        let mut last_state: Option<usize> = None;
        for k in scenario.warm_up_end().0..scenario.run.ttis {
            let first_state = if plan.duty_cycle(DeviceId(j)).is_on(Tti(k)) {
                1
            } else {
                4
            };
            if let Some(last_state) = last_state {
                counts[last_state][first_state] += 1;
            }
            let (state, _) = run.trace[k as usize][j as usize];
            last_state = Some(match state {
                ReferenceState::Idle | ReferenceState::Asleep => first_state,
                ReferenceState::Transmission => {
                    counts[first_state][2] += 1;
                    counts[2][3] += 1;
                    3
                }
                ReferenceState::Unpowered | ReferenceState::Failed => panic!("TTI {k}, device {j}: an action failed"),
            });
        }
    }
    counts
}

proptest! {
    #![proptest_config(Config { cases: 150, failure_persistence: None, ..Config::default() })]

    #[test]
    fn transitions_equal_the_transitions_of_the_reference(text in scenarios::with_ample_energy()) {
        let scenario = scenarios::scenario(&text);
        let expected = reference::simulate(&scenario);
        if expected.ambiguous.is_some() {
            return Err(TestCaseError::reject("too close to call"));
        }
        let counts = count_transitions(&scenario, &expected);
        for measured in measure(&scenario, SEEDS).expect("a study").transitions {
            let (m, n) = (measured.from, measured.to);
            prop_assert_eq!(measured.count, counts[m][n], "transitions S{} → S{}\n{}", m, n, text);
        }
    }

    #[test]
    fn transmissions_equal_the_transmissions_of_the_reference(text in scenarios::small()) {
        let mut scenario = scenarios::scenario(&text);
        scenario.radio = RadioSettings::default();
        let expected = reference::simulate(&scenario);
        if expected.ambiguous.is_some() {
            return Err(TestCaseError::reject("too close to call"));
        }
        let measured_trace = &expected.trace[scenario.warm_up_end().0 as usize..];
        let is_transmission = |(state, _): &&(ReferenceState, u64)| *state == ReferenceState::Transmission;
        let transmissions = measured_trace.iter().flatten().filter(is_transmission).count();
        let transitions = measure(&scenario, SEEDS).expect("a study").transitions;
        let count = |m, n| {
            let is_wanted = |t: &&Transition| (t.from, t.to) == (m, n);
            transitions.iter().find(is_wanted).map_or(0, |t| t.count)
        };
        prop_assert_eq!(count(2, 3), transmissions as u64, "{}", text);
        // Each activation ends in a transmission or, without energy for it, in S4.
        prop_assert_eq!(count(1, 2) + count(4, 2), count(2, 3) + count(2, 4), "{}", text);
    }
}
