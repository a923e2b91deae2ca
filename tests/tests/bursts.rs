//! The event process `bursts`: the lengths of its phases, its start times and its mean start probability, against
//! closed forms. Epicentres and durations are tested in `events.rs`. Seeds are fixed, so the tests are deterministic.

use reveille_common::event::EventProcess;
use reveille_common::ids::{MAX_TTIS, Tti};
use reveille_common::rng::{Purpose, Stream};
use reveille_lab::run::RunOptions;
use reveille_tests::compare;
use reveille_tests::distributions::{MAX_STANDARD_ERRORS, assert_share, draw_events};
use reveille_tests::scenarios::scenario;

/// Beginning of a scenario with bursts; a section `[events.bursts]` can follow.
const BURSTS: &str = "ttis = 1000000\n[events]\nprocess = \"bursts\"\n";

/// Returns whether each of the first `ttis` TTIs is busy. `length_fields` sets the mean lengths of the phases; empty
/// for the defaults.
fn is_busy_by_tti(length_fields: &str, seed: u64, ttis: u64) -> Vec<bool> {
    // With these probabilities events start in all busy TTIs and in no others.
    let alphas = "busy_alpha = 1.0\nquiet_alpha = 0.0\n";
    let scenario = scenario(&format!(
        "seed = {seed}\n{BURSTS}[events.bursts]\n{alphas}{length_fields}"
    ));
    let is_busy = |k: u64| {
        let alpha = scenario.events.mean_start_probability(seed, Tti(k), Tti(k + 1));
        assert!([0.0, 1.0].contains(&alpha), "α {alpha}");
        alpha > 0.5
    };
    (0..ttis).map(is_busy).collect()
}

#[test]
fn phases_have_geometric_lengths() {
    let length_fields = "busy_ttis = 8.0\nquiet_ttis = 30.5\n";
    // By TTI of the phases whose start was observed: whether the phase is busy, its age, and whether it ends now.
    let mut observations = Vec::new();
    for seed in 0..12 {
        let is_busy_in = is_busy_by_tti(length_fields, seed, 6000);
        let mut age = None;
        for pair in is_busy_in.windows(2) {
            let ends = pair[0] != pair[1];
            if let Some(age) = age {
                observations.push((pair[0], age, ends));
            }
            age = if ends { Some(1) } else { age.map(|age| age + 1) };
        }
    }
    for (is_busy, mean) in [(true, 8.0), (false, 30.5)] {
        for ages in [1..=1, 2..=7, 8..=30, 31..=1000] {
            // Few busy phases get older.
            if is_busy && *ages.start() > 8 {
                continue;
            }
            let in_age_range = observations
                .iter()
                .filter(|(busy, age, _)| *busy == is_busy && ages.contains(age));
            assert_share(
                &format!("phases with the mean {mean} that end at an age of {ages:?}"),
                in_age_range.map(|(_, _, ends)| *ends),
                1.0 / mean,
            );
        }
    }
    // Each TTI is a separate phase.
    let single_tti_phases = is_busy_by_tti("busy_ttis = 1.0\nquiet_ttis = 1.0\n", 3, 500);
    assert!(single_tti_phases.windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn phases_are_stationary_from_the_first_tti() {
    let length_fields = "busy_ttis = 20.0\nquiet_ttis = 60.0\n";
    let runs: Vec<Vec<bool>> = (0..4000).map(|seed| is_busy_by_tti(length_fields, seed, 60)).collect();
    for k in [0, 1, 7, 25, 59] {
        assert_share(&format!("busy in TTI {k}"), runs.iter().map(|run| run[k]), 0.25);
    }
    for (is_busy, mean) in [(true, 20.0), (false, 60.0)] {
        let runs_of_phase = runs.iter().filter(|run| run[0] == is_busy);
        assert_share(
            "phases that end after TTI 0",
            runs_of_phase.map(|run| run[1] != is_busy),
            1.0 / mean,
        );
    }
}

#[test]
fn events_start_with_the_probability_of_the_phase() {
    for (busy_alpha, quiet_alpha, duration) in [(0.8, 0.02, 3), (1.0, 0.3, 2), (0.4, 0.0, 1), (0.15, 0.6, 4)] {
        let text = format!(
            "seed = 21\n[events]\nprocess = \"bursts\"\nduration = {duration}\n[events.bursts]\n\
             busy_alpha = {busy_alpha:?}\nquiet_alpha = {quiet_alpha:?}\nbusy_ttis = 9.0\nquiet_ttis = 14.0\n"
        );
        let ttis = 12_000;
        let is_busy_in = is_busy_by_tti("busy_ttis = 9.0\nquiet_ttis = 14.0\n", 21, ttis);
        let scenario = scenario(&text);
        let mut process = EventProcess::new(scenario.run.seed, scenario.area, &scenario.events, Tti(ttis));
        // TTIs without an active event at their start, and whether an event starts.
        let mut idle_ttis = Vec::new();
        let mut k = 0;
        while k < ttis {
            let starts = process.next_start() == Tti(k);
            idle_ttis.push((k as usize, starts));
            if starts {
                let event = process.start();
                process.end(event.last);
                k = event.last.0;
            }
            assert!(process.next_start() > Tti(k));
            k += 1;
        }
        let is_first_of_phase = |k: usize| k > 0 && is_busy_in[k] != is_busy_in[k - 1];
        for (is_busy, alpha) in [(true, busy_alpha), (false, quiet_alpha)] {
            let starts_in = |is_included: &dyn Fn(usize) -> bool| -> Vec<bool> {
                let included = idle_ttis
                    .iter()
                    .filter(|(k, _)| is_busy_in[*k] == is_busy && is_included(*k));
                included.map(|(_, starts)| *starts).collect()
            };
            let label = format!("starts, α {alpha}, busy {is_busy}");
            let starts_in_first = starts_in(&is_first_of_phase);
            let starts_in_later = starts_in(&|k| !is_first_of_phase(k));
            let starts = starts_in(&|_| true);
            if [0.0, 1.0].contains(&alpha) {
                let is_certain = alpha > 0.5;
                assert!(
                    starts.iter().all(|starts| *starts == is_certain) && starts.len() > 100,
                    "{label}"
                );
                continue;
            }
            assert_share(&label, starts, alpha);
            assert_share(
                &format!("{label}, after the first TTI of a phase"),
                starts_in_later,
                alpha,
            );
            // The sample is too small for a lower probability.
            if alpha > 0.04 {
                assert_share(&format!("{label}, in the first TTI of a phase"), starts_in_first, alpha);
            }
        }
    }
}

#[test]
fn bursts_with_equal_probabilities_equal_uniform_events() {
    for alpha in [1.0, 0.35, 0.01] {
        let uniform = scenario(&format!("seed = 31\nevents.alpha = {alpha:?}\n"));
        let bursts = scenario(&format!(
            "seed = 31\n[events]\nprocess = \"bursts\"\n[events.bursts]\nbusy_alpha = {alpha:?}\n\
             quiet_alpha = {alpha:?}\nbusy_ttis = 3.0\nquiet_ttis = 7.0\n"
        ));
        assert_eq!(draw_events(&uniform, 5000), draw_events(&bursts, 5000), "α {alpha}");
    }
}

#[test]
fn a_run_with_a_negligible_start_probability_ends_without_events() {
    let scenario = scenario(
        "seed = 1\nttis = 500\n[events]\nprocess = \"bursts\"\n[events.bursts]\nbusy_alpha = 1e-300\n\
         quiet_alpha = 0.0\nbusy_ttis = 1.0\nquiet_ttis = 1.0\n",
    );
    let (outcome, events) = compare::outcome(&scenario, RunOptions::default());
    assert!(outcome.is_complete && events.is_empty());
}

#[test]
fn the_mean_start_probability_is_the_mean_over_its_ttis() {
    // The defaults of `busy_alpha` and `quiet_alpha`.
    let (busy_alpha, quiet_alpha) = (0.8, 0.02);
    let scenario = scenario(&format!("seed = 41\n{BURSTS}"));
    let events = &scenario.events;
    let is_busy_in = is_busy_by_tti("", 41, 3000);
    let mut stream = Stream::new(1, Purpose::Epicentre, 0);
    for _ in 0..300 {
        let bounds = [stream.below(3000), stream.below(3001)];
        let (first, end) = (bounds[0].min(bounds[1]), bounds[0].max(bounds[1]));
        let mean = events.mean_start_probability(41, Tti(first), Tti(end));
        if first == end {
            assert_eq!(mean.to_bits(), events.alpha.to_bits());
            continue;
        }
        let mut sum = 0.0;
        for k in first..end {
            sum += if is_busy_in[k as usize] {
                busy_alpha
            } else {
                quiet_alpha
            };
        }
        let expected_mean = sum / (end - first) as f64;
        assert!(
            (mean - expected_mean).abs() < 1e-12,
            "TTIs {first} to {end}: mean {mean}, expected {expected_mean}"
        );
    }
    // The long-run mean is α. The variance is the variance of the time share of one of two phases, whose default means
    // are 40 and 160 TTIs.
    let ttis = 2_000_000.0;
    let (busy_share, correlation) = (0.2, 1.0 - 1.0 / 40.0 - 1.0 / 160.0);
    let variance = busy_share * (1.0 - busy_share) * (1.0 + correlation) / (1.0 - correlation) / ttis;
    let mean = events.mean_start_probability(41, Tti(0), Tti(ttis as u64));
    let standard_error = (busy_alpha - quiet_alpha) * f64::sqrt(variance);
    assert!((events.alpha - 0.176).abs() < 1e-15, "α {}", events.alpha);
    assert!(
        (mean - events.alpha).abs() < MAX_STANDARD_ERRORS * standard_error && standard_error < 0.01,
        "mean {mean}, standard error {standard_error}"
    );
}

#[test]
fn the_mean_of_a_constant_start_probability_is_exactly_alpha() {
    for process in ["uniform", "hot-spots", "aftershocks"] {
        for alpha in [0.1, 0.2, 1.0 / 3.0] {
            let scenario = scenario(&format!("[events]\nprocess = \"{process}\"\nalpha = {alpha:?}\n"));
            for (first, end) in [(0, 1), (7, 100), (5, 5), (0, MAX_TTIS)] {
                let mean = scenario.events.mean_start_probability(3, Tti(first), Tti(end));
                assert_eq!(mean.to_bits(), f64::to_bits(alpha), "{process} {first} {end}");
            }
        }
    }
}
