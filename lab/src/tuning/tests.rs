//! Short tunings, and their state after an interruption.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use reveille_bs::policy::q_learning::learned::QTrainingConfig;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::score::Metrics;

use super::plan::{evaluation_seed, new_pool};
use super::*;
use crate::preparation::run;

fn scenario(overrides: &[&str]) -> Scenario {
    let parse = |text: &&str| Override::parse(text).expect("an override");
    let base = [
        "policy.name=q-learning",
        "policy.q-learning.learn=true",
        "policy.q-learning.table=nothing",
    ];
    let overrides: Vec<Override> = base.iter().chain(overrides).map(parse).collect();
    load("paper", &overrides).expect("a scenario").scenario
}

fn plan() -> TuningPlan {
    TuningPlan {
        scenario: scenario(&["devices=12"]),
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

/// A file of one test.
struct File(PathBuf);

impl File {
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

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A proposer that depends on all points: it proposes a pair between the best and the last one.
struct Between;

impl Proposer for Between {
    fn propose(&self, ranges: &Ranges, points: &[(WeightPair, f64)]) -> Result<WeightPair, TuningError> {
        let best = points.iter().max_by(|a, b| a.1.total_cmp(&b.1)).expect("points").0;
        let (a, b) = (ranges.position(best), ranges.position(points[points.len() - 1].0));
        Ok(ranges.pair_at([0.6 * a[0] + 0.4 * b[0], 0.5 * a[1] + 0.5 * b[1]]))
    }
}

/// Stops in the point with this number.
struct StopIn(usize, AtomicUsize);

impl TuningProgress for StopIn {
    fn begun(&self, number: usize, _: WeightPair) {
        self.1.store(number, Ordering::Relaxed);
    }

    fn stop(&self) -> bool {
        self.1.load(Ordering::Relaxed) >= self.0
    }
}

#[test]
fn ranges_are_logarithmic_and_checked() {
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
fn a_design_has_the_start_and_fills_the_ranges() {
    let ranges = plan().ranges;
    let pairs = design(&ranges, [14.0, 1.6], 6, 1);
    assert_eq!((pairs.len(), pairs[0]), (6, [14.0, 1.6]));
    assert_eq!(pairs, design(&ranges, [14.0, 1.6], 6, 1));
    assert_ne!(pairs[1..], design(&ranges, [14.0, 1.6], 6, 2)[1..]);
    for i in 0..2 {
        let mut fifths: Vec<usize> = pairs[1..]
            .iter()
            .map(|p| (ranges.position(*p)[i] * 5.0) as usize)
            .collect();
        fifths.sort_unstable();
        assert_eq!(fifths, [0, 1, 2, 3, 4], "one in each fifth");
    }
    let without = design(&ranges, [100.0, 1.6], 6, 1);
    assert_eq!(without.len(), 6);
    assert!(without.iter().all(|pair| ranges.contains(*pair)));
}

#[test]
fn plans_out_of_range_are_refused() {
    let refused = |change: &dyn Fn(&mut TuningPlan), part: &str| {
        let mut plan = plan();
        change(&mut plan);
        let error = plan.check().expect_err(part).to_string();
        assert!(error.contains(part), "{error}");
    };
    assert!(plan().check().is_ok());
    refused(&|p| p.design = 2, "design");
    let many = |p: &mut TuningPlan| p.scenario = scenario(&["devices=1000000", "energy.e_max=10000", "ttis=100"]);
    let long = |of: fn(&mut TuningPlan)| {
        move |p: &mut TuningPlan| {
            many(p);
            of(p);
        }
    };
    refused(&long(|p| p.ttis = 2000), "ttis = 2000: must be at most 1844");
    refused(
        &long(|p| p.training.ttis = 2000),
        "episode-ttis = 2000: must be at most 1844",
    );
    refused(&|p| p.runs = 0, "seeds");
    refused(&|p| p.ttis = 3, "ttis");
    refused(&|p| p.training.episodes = 0, "episodes");
    refused(
        &|p| p.scenario = load("paper", &[]).expect("a preset").scenario,
        "only q-learning",
    );
    refused(
        &|p| {
            p.objective = TuningObjective::Balance {
                energy: f64::NAN,
                miss: 1.0,
            };
        },
        "energy-weight",
    );
}

#[test]
fn an_objective_is_what_it_says() {
    let (outcome, scenario) = {
        let scenario = scenario(&["devices=30", "ttis=2000", "warm_up=0"]);
        (run(&scenario), scenario)
    };
    let metrics: &Metrics = &outcome.metrics;
    let of = |objective: TuningObjective| objective.value_of(metrics, scenario.events.alpha, 30);
    // From the totals instead of the metrics.
    let totals = &outcome.totals;
    let events = totals.events.events as f64;
    let information = totals.events.information_pico as f64 / 1e12;
    let spent = totals.energy.spent.total().units();
    // The objective of P1: all 2000 TTIs are measured, with α expected events each.
    let expected = scenario.events.alpha * 2000.0;
    assert!((of(TuningObjective::Information) - information / expected).abs() < 1e-12);
    assert!((expected - events).abs() > 10.0, "or it might be per event");
    assert!((of(TuningObjective::Efficiency) - information / spent).abs() < 1e-9 * information / spent);
    let missed = totals.events.misdetected as f64 / events;
    let balance = information / expected - 0.5 * spent / (30.0 * 2000.0) - 2.0 * missed;
    assert!((of(TuningObjective::Balance { energy: 0.5, miss: 2.0 }) - balance).abs() < 1e-12);
    assert!(missed > 0.0, "otherwise the last term has no effect");
    assert!(
        TuningObjective::Information
            .value_of(&Metrics::default(), 0.1, 30)
            .is_nan()
    );
}

#[test]
fn no_evaluation_has_a_seed_of_a_training() {
    for seed in [0, 1, 2, 77, u64::MAX] {
        let first = evaluation_seed(seed, 0);
        for (n, episode) in [(1, 0), (100, 11), (1_000_000, 99_999)] {
            let training = crate::training::EPISODE_SEED_OFFSET
                .wrapping_add(seed.wrapping_mul(0x1_0000_0001))
                .wrapping_add(n << 20)
                .wrapping_add(episode);
            // The two ranges of seeds do not overlap for any index.
            assert!(training.wrapping_sub(first) > 10_000_000_000);
            assert!(first.wrapping_sub(training) > 10_000_000_000);
        }
    }
}

#[test]
fn a_pair_comes_to_the_same_twice_and_with_any_number_of_threads() {
    let plan = plan();
    let evaluate = |weights: WeightPair, threads: usize| {
        let pool = new_pool(threads).expect("threads");
        let found = plan.evaluate(weights, &pool, &()).expect("evaluated");
        found.expect("it is not stopped")
    };
    let once = evaluate([5.0, 2.0], 1);
    assert_eq!(once, evaluate([5.0, 2.0], 1));
    assert_eq!(once, evaluate([5.0, 2.0], 2));
    assert_ne!(once, evaluate([0.6, 2.0], 2));
    assert!(once.information > 0.0 && once.energy > 0.0 && once.objective_half > 0.0);
    let balance = once.information - once.energy - once.misdetection_pct / 100.0;
    assert!((once.objective - balance).abs() < 1e-12, "means add up");
}

#[test]
fn a_tuning_without_events_says_so() {
    let plan = TuningPlan {
        ttis: 10,
        runs: 1,
        scenario: scenario(&["devices=12", "events.alpha=0.000001"]),
        ..plan()
    };
    let error = plan.evaluate([5.0, 2.0], &new_pool(1).expect("a thread"), &());
    assert!(matches!(error, Err(TuningError::NoEvent { ttis: 10 })), "{error:?}");
}

#[test]
fn a_tuning_that_is_cut_short_comes_to_the_same_end() {
    let (whole, cut) = (File::new("whole"), File::new("cut"));
    let mut tuner = Tuner::open(plan(), &whole.0, false).expect("new");
    assert!(tuner.run(3, 1, &Between, &()).expect("run"));
    assert_eq!((tuner.history().points.len(), tuner.pairs_left(3)), (6, 0));
    for stop in [1, 4] {
        let mut part = Tuner::open(plan(), &cut.0, false).expect("new or found");
        let ended = part.run(3, 2, &Between, &StopIn(stop, AtomicUsize::new(0)));
        assert!(!ended.expect("run"), "stopped in point {stop}");
        assert_eq!(part.history().points.len(), stop);
        // A torn file: the point in progress is lost, the points before it are not.
        std::fs::write(&cut.0, cut.text() + &format!("{stop},1.5,2.")).expect("writable");
    }
    let mut rest = Tuner::open(plan(), &cut.0, false).expect("found");
    assert!(rest.is_torn());
    assert!(rest.run(3, 1, &Between, &()).expect("run"));
    assert_eq!(cut.text(), whole.text());
    let longer = Tuner::open(plan(), &whole.0, false).expect("found");
    assert_eq!(
        (longer.pairs_left(3), longer.pairs_left(5)),
        (0, 2),
        "more iterations resume it"
    );
}

#[test]
fn the_history_of_another_tuning_is_refused() {
    let file = File::new("foreign");
    let mut tuner = Tuner::open(plan(), &file.0, false).expect("new");
    assert!(tuner.run(0, 1, &Between, &()).expect("run"));
    let refused = |change: &dyn Fn(&mut TuningPlan), part: &str| {
        let mut plan = plan();
        change(&mut plan);
        match Tuner::open(plan, &file.0, false) {
            Err(error @ TuningError::Foreign { .. }) => assert!(error.to_string().contains(part), "{error}"),
            other => panic!("{part}: {other:?}"),
        }
    };
    refused(
        &|p| p.scenario = scenario(&["devices=13"]),
        "devices: 12 there, 13 here",
    );
    refused(
        &|p| p.scenario = scenario(&["devices=12", "harvest.lambda=0.2"]),
        "scenario",
    );
    refused(&|p| p.objective = TuningObjective::Information, "objective");
    refused(&|p| p.ranges.mu2 = (1.0, 6.0), "mu2");
    refused(&|p| p.runs = 4, "evaluation");
    refused(&|p| p.training.ttis = 101, "training");
    let other = file.text().replacen("\n1,", "\n1,1", 1);
    std::fs::write(&file.0, other).expect("writable");
    refused(&|_| {}, "other pairs");
    let restarted = Tuner::open(plan(), &file.0, true).expect("forced");
    assert_eq!(restarted.pairs_left(0), 3);
}

#[test]
fn a_history_is_read_as_it_was_written() {
    let evaluation = Evaluation {
        objective: -1.0 / 3.0,
        objective_half: f64::NAN,
        information: 0.1 + 0.2,
        information_half: 1e-300,
        misdetection_pct: 100.0 / 3.0,
        energy: std::f64::consts::PI,
        wake_ups: 0.0,
    };
    let mut history = History::new(vec![("mu1".to_owned(), "0.5 to 20".to_owned())]);
    for weights in [[2.0 / 3.0, 1.0], [20.0, 4.999_999_999_999_999]] {
        history.points.push(TuningPoint { weights, evaluation });
    }
    let text = history.to_csv();
    let (read, torn) = History::parse(&text).expect("ours");
    let bits = |h: &History| -> Vec<[u64; 2]> { h.points.iter().map(|p| p.weights.map(f64::to_bits)).collect() };
    assert_eq!(
        (bits(&read), torn, read.to_csv()),
        (bits(&history), false, text.clone())
    );
    assert_eq!((read.range("mu1"), read.range("mu2")), (Some((0.5, 20.0)), None));
    for end in 1..text.lines().last().expect("a line").len() {
        let (torn, is_torn) = History::parse(&text[..text.len() - end]).expect("ours");
        assert_eq!((torn.points.len(), is_torn), (1, true), "{end}");
    }
    for bad in ["", "number,mu1\n", "a\nb\n", "# reveille tuning 1\nnumber\n"] {
        assert!(History::parse(bad).is_err(), "{bad:?}");
    }
    let with = |from: &str, to: &str| History::parse(&text.replacen(from, to, 1));
    assert!(with("\n0,", "\n7,").is_err() && with(",20,", ",x,").is_err() && with(",20,", ",").is_err());
    assert!(with(",20,", ",NaN,").is_err());
}

#[test]
fn the_best_come_first_and_of_equals_the_earlier() {
    let mut history = History::new(Vec::new());
    for objective in [0.1, 0.5, -1.0, 0.5] {
        let evaluation = Evaluation {
            objective,
            objective_half: 0.0,
            information: 0.0,
            information_half: 0.0,
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

    /// A hill with its top at μ1 = 6, μ2 = 2.
    fn hill([mu1, mu2]: WeightPair) -> f64 {
        let (x, y) = (libm::log(mu1 / 6.0), libm::log(mu2 / 2.0));
        0.4 - 0.05 * x * x - 0.3 * y * y - 0.03 * x * y
    }

    fn climb(seed: u64, iterations: usize) -> Vec<(WeightPair, f64)> {
        let ranges = plan().ranges;
        let value = |pair: WeightPair| (pair, hill(pair));
        let mut points: Vec<(WeightPair, f64)> = design(&ranges, [14.0, 1.6], 6, seed).into_iter().map(value).collect();
        for _ in 0..iterations {
            let next = Bayes { seed }.propose(&ranges, &points).expect("a proposal");
            points.push(value(next));
        }
        points
    }

    /// Within ten proposals the optimiser gets within 2 % of the hill's height below the top. At random this takes
    /// hundreds: such pairs are less than 1 % of the ranges.
    #[test]
    fn it_finds_the_top_of_a_hill() {
        for seed in [1, 2, 3] {
            let points = climb(seed, 10);
            let best = points.iter().map(|(_, value)| *value).fold(f64::NEG_INFINITY, f64::max);
            assert!(best > 0.4 - 0.002, "seed {seed}: {best} {points:?}");
        }
    }

    #[test]
    fn it_proposes_the_same_twice_and_in_any_pool() {
        let once = climb(1, 3);
        let bits =
            |points: &[(WeightPair, f64)]| -> Vec<[u64; 2]> { points.iter().map(|p| p.0.map(f64::to_bits)).collect() };
        assert_eq!(bits(&once), bits(&climb(1, 3)));
        let many = new_pool(3).expect("threads").install(|| climb(1, 3));
        assert_eq!(bits(&once), bits(&many));
    }

    #[test]
    fn a_surface_goes_through_points_without_noise() {
        let ranges = plan().ranges;
        let mut history = History::new(Vec::new());
        for (weights, objective) in climb(1, 4) {
            let evaluation = Evaluation {
                objective,
                objective_half: f64::NAN,
                information: 0.0,
                information_half: f64::NAN,
                misdetection_pct: 0.0,
                energy: 0.0,
                wake_ups: 0.0,
            };
            history.points.push(TuningPoint { weights, evaluation });
        }
        let surface = surface(&ranges, &history).expect("a surface");
        assert_eq!((surface.rows.len(), surface.rows[0].len()), (40, 40));
        for point in &history.points {
            let [u, v] = ranges
                .position(point.weights)
                .map(|share| ((share * 40.0) as usize).min(39));
            let off = surface.rows[v][u] - hill(ranges.pair_at([(u as f64 + 0.5) / 40.0, (v as f64 + 0.5) / 40.0]));
            assert!(off.abs() < 0.01, "{:?}: {off}", point.weights);
        }
    }
}
