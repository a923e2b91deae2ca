//! Tests of [`Tuner`] and its parts: ranges, designs, plans, objectives (compared with the totals of a run),
//! evaluations, their seeds, and history files. With the feature `tune`, the optimiser is tested on a function with a
//! known maximum.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use reveille_bs::policy::q_learning::learned::QTrainingConfig;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::score::Metrics;

use super::plan::{evaluation_seed, new_pool};
use super::*;
use crate::preparation::run;

fn scenario_with(overrides: &[&str]) -> Scenario {
    let parse = |text: &&str| Override::parse(text).expect("an override");
    let base = [
        "policy.name=q-learning",
        "policy.q-learning.learn=true",
        "policy.q-learning.table=nothing",
    ];
    let overrides: Vec<Override> = base.iter().chain(overrides).map(parse).collect();
    load("paper", &overrides).expect("a scenario").scenario
}

fn small_plan() -> TuningPlan {
    TuningPlan {
        scenario: scenario_with(&["devices=12"]),
        ranges: Ranges::new((0.5, 20.0), (1.0, 5.0)).expect("ranges"),
        objective: TuningObjective::Balance { energy: 1.0, miss: 1.0 },
        design: 3,
        training: QTrainingConfig {
            episodes: 2,
            ttis: 100,
            epsilon: (0.1, 0.0),
            seed: 1,
        },
        runs: 3,
        ttis: 400,
    }
}

/// The path of a history file that is removed on drop.
struct HistoryFile(PathBuf);

impl HistoryFile {
    fn new(name: &str) -> Self {
        let name = format!("reveille-tuning-{name}-{}.csv", std::process::id());
        let path = std::env::temp_dir().join(name);
        let _ = std::fs::remove_file(&path);
        Self(path)
    }

    fn text(&self) -> String {
        std::fs::read_to_string(&self.0).expect("written")
    }
}

impl Drop for HistoryFile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A proposer whose result depends on the best and the last point: a pair between them.
struct BetweenBestAndLast;

impl Proposer for BetweenBestAndLast {
    fn propose(&self, ranges: &Ranges, points: &[(WeightPair, f64)]) -> Result<WeightPair, TuningError> {
        let best = points.iter().max_by(|a, b| a.1.total_cmp(&b.1)).expect("points").0;
        let (best, last) = (ranges.position(best), ranges.position(points[points.len() - 1].0));
        Ok(ranges.pair_at([0.6 * best[0] + 0.4 * last[0], 0.5 * best[1] + 0.5 * last[1]]))
    }
}

/// Stops during the evaluation of the point `point_number`.
struct StopInPoint {
    point_number: usize,
    current_point: AtomicUsize,
}

impl StopInPoint {
    fn new(point_number: usize) -> Self {
        let current_point = AtomicUsize::new(0);
        Self {
            point_number,
            current_point,
        }
    }
}

impl TuningProgress for StopInPoint {
    fn begun(&self, number: usize, _: WeightPair) {
        self.current_point.store(number, Ordering::Relaxed);
    }

    fn should_stop(&self) -> bool {
        self.current_point.load(Ordering::Relaxed) >= self.point_number
    }
}

#[test]
fn ranges_are_logarithmic_and_invalid_ones_are_refused() {
    let ranges = Ranges::new((0.5, 50.0), (1.0, 4.0)).expect("ranges");
    let [mu1, mu2] = ranges.pair_at([0.5, 0.5]);
    assert!((mu1 - 5.0).abs() < 1e-12 && (mu2 - 2.0).abs() < 1e-12);
    assert!(
        ranges
            .position([5.0, 2.0])
            .iter()
            .all(|share| (share - 0.5).abs() < 1e-12)
    );
    assert_eq!(
        ranges.pair_at([0.0, 1.0]).map(f64::to_bits),
        [0.5, 4.0].map(f64::to_bits)
    );
    assert_eq!(
        ranges.rounded([1.234_567, 3.999_99]).map(f64::to_bits),
        [1.2346, 4.0].map(f64::to_bits)
    );
    for (mu1, mu2) in [
        ((0.5, 0.5), (1.0, 5.0)),
        ((20.0, 0.5), (1.0, 5.0)),
        ((0.0, 1.0), (1.0, 5.0)),
        ((0.5, 1.0), (-1.0, 5.0)),
        ((0.5, f64::NAN), (1.0, 5.0)),
        ((0.5, 1.0), (1.0, 1e7)),
    ] {
        assert!(Ranges::new(mu1, mu2).is_err(), "{mu1:?} {mu2:?}");
    }
}

#[test]
fn a_design_contains_the_start_and_covers_the_ranges() {
    let ranges = small_plan().ranges;
    let pairs = design(&ranges, [14.0, 1.6], 6, 1);
    assert_eq!((pairs.len(), pairs[0]), (6, [14.0, 1.6]));
    assert_eq!(pairs, design(&ranges, [14.0, 1.6], 6, 1));
    assert_ne!(pairs[1..], design(&ranges, [14.0, 1.6], 6, 2)[1..]);
    for i in 0..2 {
        let mut fifths: Vec<usize> = pairs[1..]
            .iter()
            .map(|pair| (ranges.position(*pair)[i] * 5.0) as usize)
            .collect();
        fifths.sort_unstable();
        assert_eq!(fifths, [0, 1, 2, 3, 4], "one pair in each fifth of a range");
    }
    let with_start_outside = design(&ranges, [100.0, 1.6], 6, 1);
    assert_eq!(with_start_outside.len(), 6);
    assert!(with_start_outside.iter().all(|pair| ranges.contains(*pair)));
}

#[test]
fn plans_out_of_range_are_refused() {
    let assert_refused = |change: &dyn Fn(&mut TuningPlan), cause: &str| {
        let mut plan = small_plan();
        change(&mut plan);
        let error = plan.check().expect_err(cause).to_string();
        assert!(error.contains(cause), "{error}");
    };
    assert!(small_plan().check().is_ok());
    assert_refused(&|plan| plan.design = 2, "design");
    // Sums of energy must fit in 2⁶⁴ micro-units: (18 446 744 − 10 000) / (10 000 + 1 + 1/14 + 10) TTIs, rounded down.
    let large = ["devices=1000000", "energy.e_max=10000", "harvest.e_b=10000", "ttis=100"];
    let with_many_devices = |plan: &mut TuningPlan| plan.scenario = scenario_with(&large);
    let and_many_devices = |change: fn(&mut TuningPlan)| {
        move |plan: &mut TuningPlan| {
            with_many_devices(plan);
            change(plan);
        }
    };
    assert_refused(
        &and_many_devices(|plan| plan.ttis = 2000),
        "ttis = 2000: must be at most 1841",
    );
    assert_refused(
        &and_many_devices(|plan| plan.training.ttis = 2000),
        "episode-ttis = 2000: must be at most 1841",
    );
    assert_refused(&|plan| plan.runs = 0, "seeds");
    assert_refused(&|plan| plan.ttis = 3, "ttis");
    assert_refused(&|plan| plan.training.episodes = 0, "episodes");
    assert_refused(
        &|plan| plan.scenario = load("paper", &[]).expect("a preset").scenario,
        "only q-learning",
    );
    assert_refused(
        &|plan| {
            plan.objective = TuningObjective::Balance {
                energy: f64::NAN,
                miss: 1.0,
            };
        },
        "energy-weight",
    );
}

#[test]
fn objectives_follow_from_the_totals_of_a_run() {
    let scenario = scenario_with(&["devices=30", "ttis=2000", "warm_up=0"]);
    let outcome = run(&scenario);
    let metrics: &Metrics = &outcome.metrics;
    let value_of = |objective: TuningObjective| objective.value_of(metrics, scenario.events.alpha, 30);
    let totals = &outcome.totals;
    let events = totals.events.events as f64;
    let information = totals.events.information_pico as f64 / 1e12;
    let spent = totals.energy.spent.total().units();
    // The objective of P1: all 2000 TTIs are measured, with α expected events each.
    let expected_events = scenario.events.alpha * 2000.0;
    assert!((value_of(TuningObjective::Information) - information / expected_events).abs() < 1e-12);
    assert!(
        (expected_events - events).abs() > 10.0,
        "the number of events must differ from its expectation"
    );
    assert!((value_of(TuningObjective::Efficiency) - information / spent).abs() < 1e-9 * information / spent);
    let missed_share = totals.events.misdetected as f64 / events;
    let balance = information / expected_events - 0.5 * spent / (30.0 * 2000.0) - 2.0 * missed_share;
    assert!((value_of(TuningObjective::Balance { energy: 0.5, miss: 2.0 }) - balance).abs() < 1e-12);
    assert!(missed_share > 0.0, "no event was missed");
    assert!(
        TuningObjective::Information
            .value_of(&Metrics::default(), 0.1, 30)
            .is_nan()
    );
}

#[test]
fn evaluations_and_trainings_use_different_seeds() {
    for seed in [0, 1, 2, 77, u64::MAX] {
        let first_evaluation_seed = evaluation_seed(seed, 0);
        for (devices, episode) in [(1, 0), (100, 11), (1_000_000, 99_999)] {
            // Repeats the formula of `run_episode` in `training/mod.rs`.
            let training_seed = crate::training::EPISODE_SEED_OFFSET
                .wrapping_add(seed.wrapping_mul(0x1_0000_0001))
                .wrapping_add(devices << 20)
                .wrapping_add(episode);
            // Far more than the evaluations or episodes of any tuning.
            assert!(training_seed.wrapping_sub(first_evaluation_seed) > 10_000_000_000);
            assert!(first_evaluation_seed.wrapping_sub(training_seed) > 10_000_000_000);
        }
    }
}

#[test]
fn an_evaluation_is_the_same_twice_and_on_any_number_of_threads() {
    let plan = small_plan();
    let evaluate = |weights: WeightPair, threads: usize| {
        let pool = new_pool(threads).expect("threads");
        let result = plan.evaluate(weights, &pool, &()).expect("evaluated");
        result.expect("not stopped")
    };
    let evaluation = evaluate([5.0, 2.0], 1);
    assert_eq!(evaluation, evaluate([5.0, 2.0], 1));
    assert_eq!(evaluation, evaluate([5.0, 2.0], 2));
    assert_ne!(evaluation, evaluate([0.6, 2.0], 2));
    assert!(evaluation.information > 0.0 && evaluation.energy > 0.0 && evaluation.objective_half_width > 0.0);
    // The objective of `small_plan` weighs energy and missed events with 1.
    let balance = evaluation.information - evaluation.energy - evaluation.misdetection_pct / 100.0;
    assert!(
        (evaluation.objective - balance).abs() < 1e-12,
        "the objective differs from the one of the means"
    );
}

#[test]
fn a_tuning_without_events_is_refused() {
    let plan = TuningPlan {
        ttis: 10,
        runs: 1,
        scenario: scenario_with(&["devices=12", "events.alpha=0.000001"]),
        ..small_plan()
    };
    let error = plan.evaluate([5.0, 2.0], &new_pool(1).expect("a thread"), &());
    assert!(matches!(error, Err(TuningError::NoEvent { ttis: 10 })), "{error:?}");
}

#[test]
fn an_interrupted_tuning_resumes_to_the_same_result() {
    let (uninterrupted, interrupted) = (HistoryFile::new("uninterrupted"), HistoryFile::new("interrupted"));
    let mut tuner = Tuner::open(small_plan(), &uninterrupted.0, false).expect("new");
    assert!(tuner.run(3, 1, &BetweenBestAndLast, &()).expect("run"));
    assert_eq!((tuner.history().points.len(), tuner.pairs_left(3)), (6, 0));
    for stop_point in [1, 4] {
        let mut stopped = Tuner::open(small_plan(), &interrupted.0, false).expect("new or found");
        let is_finished = stopped.run(3, 2, &BetweenBestAndLast, &StopInPoint::new(stop_point));
        assert!(!is_finished.expect("run"), "stopped in point {stop_point}");
        assert_eq!(stopped.history().points.len(), stop_point);
        // A torn file: the point in progress is lost, the points before it are not.
        std::fs::write(&interrupted.0, interrupted.text() + &format!("{stop_point},1.5,2.")).expect("writable");
    }
    let mut resumed = Tuner::open(small_plan(), &interrupted.0, false).expect("found");
    assert!(resumed.is_torn());
    assert!(resumed.run(3, 1, &BetweenBestAndLast, &()).expect("run"));
    assert_eq!(interrupted.text(), uninterrupted.text());
    let reopened = Tuner::open(small_plan(), &uninterrupted.0, false).expect("found");
    assert_eq!(
        (reopened.pairs_left(3), reopened.pairs_left(5)),
        (0, 2),
        "pairs left with 3 and with 5 iterations"
    );
}

#[test]
fn the_history_of_another_tuning_is_refused() {
    let file = HistoryFile::new("foreign");
    let mut tuner = Tuner::open(small_plan(), &file.0, false).expect("new");
    assert!(tuner.run(0, 1, &BetweenBestAndLast, &()).expect("run"));
    let assert_refused = |change: &dyn Fn(&mut TuningPlan), cause: &str| {
        let mut plan = small_plan();
        change(&mut plan);
        match Tuner::open(plan, &file.0, false) {
            Err(error @ TuningError::OtherTuning { .. }) => assert!(error.to_string().contains(cause), "{error}"),
            other => panic!("{cause}: {other:?}"),
        }
    };
    assert_refused(
        &|plan| plan.scenario = scenario_with(&["devices=13"]),
        "devices: 12 there, 13 here",
    );
    assert_refused(
        &|plan| plan.scenario = scenario_with(&["devices=12", "harvest.lambda=0.2"]),
        "scenario",
    );
    assert_refused(&|plan| plan.objective = TuningObjective::Information, "objective");
    assert_refused(&|plan| plan.ranges.mu2 = (1.0, 6.0), "mu2");
    assert_refused(&|plan| plan.runs = 4, "evaluation");
    assert_refused(&|plan| plan.training.ttis = 101, "training");
    // A digit in front of μ1 of point 1, a pair of the design.
    let with_other_pair = file.text().replacen("\n1,", "\n1,1", 1);
    std::fs::write(&file.0, with_other_pair).expect("writable");
    assert_refused(&|_| {}, "other pairs");
    let restarted = Tuner::open(small_plan(), &file.0, true).expect("forced");
    assert_eq!(restarted.pairs_left(0), 3);
}

#[test]
fn a_history_round_trips_and_damaged_ones_are_refused() {
    let evaluation = Evaluation {
        objective: -1.0 / 3.0,
        objective_half_width: f64::NAN,
        information: 0.1 + 0.2,
        information_half_width: 1e-300,
        misdetection_pct: 100.0 / 3.0,
        energy: std::f64::consts::PI,
        wake_ups: 0.0,
    };
    let mut history = History::new(vec![("mu1".to_owned(), "0.5 to 20".to_owned())]);
    for weights in [[2.0 / 3.0, 1.0], [20.0, 4.999_999_999_999_999]] {
        history.points.push(TuningPoint { weights, evaluation });
    }
    let text = history.to_csv();
    let (read, is_torn) = History::parse(&text).expect("ours");
    let weight_bits = |history: &History| -> Vec<[u64; 2]> {
        history
            .points
            .iter()
            .map(|point| point.weights.map(f64::to_bits))
            .collect()
    };
    assert_eq!(
        (weight_bits(&read), is_torn, read.to_csv()),
        (weight_bits(&history), false, text.clone())
    );
    assert_eq!((read.range("mu1"), read.range("mu2")), (Some((0.5, 20.0)), None));
    for dropped_bytes in 1..text.lines().last().expect("a line").len() {
        let (torn, is_torn) = History::parse(&text[..text.len() - dropped_bytes]).expect("ours");
        assert_eq!(
            (torn.points.len(), is_torn),
            (1, true),
            "without the last {dropped_bytes} bytes"
        );
    }
    for bad in ["", "number,mu1\n", "a\nb\n", "# reveille tuning 1\nnumber\n"] {
        assert!(History::parse(bad).is_err(), "{bad:?}");
    }
    let parse_edited = |from: &str, to: &str| History::parse(&text.replacen(from, to, 1));
    assert!(
        parse_edited("\n0,", "\n7,").is_err()
            && parse_edited(",20,", ",x,").is_err()
            && parse_edited(",20,", ",").is_err()
    );
    assert!(parse_edited(",20,", ",NaN,").is_err());
}

#[test]
fn points_are_ranked_by_objective_and_then_by_number() {
    let mut history = History::new(Vec::new());
    for objective in [0.1, 0.5, -1.0, 0.5] {
        let evaluation = Evaluation {
            objective,
            objective_half_width: 0.0,
            information: 0.0,
            information_half_width: 0.0,
            misdetection_pct: 0.0,
            energy: 0.0,
            wake_ups: 0.0,
        };
        history.points.push(TuningPoint {
            weights: [1.0, 1.0],
            evaluation,
        });
    }
    assert_eq!(history.ranked(), [1, 3, 0, 2]);
}

#[cfg(feature = "tune")]
mod optimiser {
    use super::super::bayes::{Bayes, surface};
    use super::*;

    /// An objective with its maximum of 0.4 at μ1 = 6, μ2 = 2.
    fn hill([mu1, mu2]: WeightPair) -> f64 {
        let (x, y) = (libm::log(mu1 / 6.0), libm::log(mu2 / 2.0));
        0.4 - 0.05 * x * x - 0.3 * y * y - 0.03 * x * y
    }

    /// Returns the points of a design and of further `iterations` of the optimiser on the hill.
    fn climb(seed: u64, iterations: usize) -> Vec<(WeightPair, f64)> {
        let ranges = small_plan().ranges;
        let value = |pair: WeightPair| (pair, hill(pair));
        let mut points: Vec<(WeightPair, f64)> = design(&ranges, [14.0, 1.6], 6, seed).into_iter().map(value).collect();
        for _ in 0..iterations {
            let next = Bayes { seed }.propose(&ranges, &points).expect("a proposal");
            points.push(value(next));
        }
        points
    }

    /// Pairs within 0.002 of the maximum are less than 1 % of the ranges: a random search needs a hundred proposals.
    #[test]
    fn the_optimiser_finds_the_maximum() {
        for seed in [1, 2, 3] {
            let points = climb(seed, 10);
            let best = points.iter().map(|(_, value)| *value).fold(f64::NEG_INFINITY, f64::max);
            assert!(best > 0.4 - 0.002, "seed {seed}: best {best}, points {points:?}");
        }
    }

    #[test]
    fn proposals_are_the_same_twice_and_in_any_pool() {
        let points = climb(1, 3);
        let bits = |points: &[(WeightPair, f64)]| -> Vec<[u64; 2]> {
            points.iter().map(|(pair, _)| pair.map(f64::to_bits)).collect()
        };
        assert_eq!(bits(&points), bits(&climb(1, 3)));
        let on_three_threads = new_pool(3).expect("threads").install(|| climb(1, 3));
        assert_eq!(bits(&points), bits(&on_three_threads));
    }

    #[test]
    fn a_surface_interpolates_points_without_noise() {
        let ranges = small_plan().ranges;
        let mut history = History::new(Vec::new());
        for (weights, objective) in climb(1, 4) {
            let evaluation = Evaluation {
                objective,
                objective_half_width: f64::NAN,
                information: 0.0,
                information_half_width: f64::NAN,
                misdetection_pct: 0.0,
                energy: 0.0,
                wake_ups: 0.0,
            };
            history.points.push(TuningPoint { weights, evaluation });
        }
        let surface = surface(&ranges, &history).expect("a surface");
        // 40 is `SURFACE_SIDE` of `bayes.rs`.
        assert_eq!((surface.rows.len(), surface.rows[0].len()), (40, 40));
        for point in &history.points {
            let [column, row] = ranges
                .position(point.weights)
                .map(|share| ((share * 40.0) as usize).min(39));
            let error = surface.rows[row][column]
                - hill(ranges.pair_at([(column as f64 + 0.5) / 40.0, (row as f64 + 0.5) / 40.0]));
            assert!(error.abs() < 0.01, "{:?}: error {error}", point.weights);
        }
    }
}
