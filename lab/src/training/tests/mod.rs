//! Trained tables for cases with a known best policy, checkpoints, and two networks that are solved exactly.

use std::sync::Arc;

use reveille_bs::policy::q_learning::learned::{
    INFORMATION_BUCKETS, REPORT_BUCKETS, SCORE_BUCKETS, WakeTable, score_edge,
};
use reveille_bs::scenario::{Override, PolicyChoice, load};
use reveille_common::deployment::Deployment;
use reveille_common::geometry::Area;
use reveille_common::ids::DeviceId;

use self::six_devices::uncovered;
use super::*;

mod six_devices;
mod three_devices;

fn scenario(preset: &str, set: &[&str]) -> Scenario {
    let always = [
        "policy.name=q-learning",
        "policy.q-learning.learn=true",
        "policy.q-learning.table=nothing",
    ];
    let set: Vec<Override> = always
        .iter()
        .chain(set)
        .map(|text| Override::parse(text).expect("an override"))
        .collect();
    load(preset, &set).expect("a scenario").scenario
}

fn training(episodes: u64, ttis: u64) -> QTrainingConfig {
    QTrainingConfig {
        episodes,
        ttis,
        epsilon: (0.1, 0.03),
        seed: 1,
    }
}

fn trained(scenario: &Scenario, devices: u32, episodes: u64, ttis: u64) -> TableSet {
    let mut trainer = Trainer::new(scenario, &[devices], &[], &training(episodes, ttis)).expect("a training");
    assert!(
        trainer.train(1, &|_| Ok(()), &()).expect("no file is written"),
        "it is not stopped"
    );
    trainer.learned().entries.swap_remove(0)
}

/// A run with these tables and without learning.
fn evaluation(scenario: &Scenario, entry: &TableSet, seed: u64, ttis: u64) -> Scenario {
    let Some(settings) = scenario.policy.settings().downcast_ref::<QLearningSettings>() else {
        panic!("q-learning");
    };
    let settings = QLearningSettings {
        learn: false,
        initial_tables: Arc::new(entry.clone()),
        ..settings.clone()
    };
    let mut evaluation = scenario.with_seed(seed);
    evaluation.run.devices = entry.devices;
    evaluation.run.ttis = ttis;
    evaluation.policy = PolicyChoice::new(scenario.policy.kind(), Arc::new(settings));
    evaluation
}

fn sensing_per_tti(outcome: &reveille_bs::cycle::RunOutcome) -> f64 {
    let fact = outcome.facts.iter().find(|(name, _)| *name == "sensing_per_tti");
    fact.expect("a fact of the policy").1
}

#[test]
fn without_a_reward_for_detection_everyone_is_asleep() {
    for preset in ["paper", "paper-literal"] {
        for devices in [10, 60] {
            for ages in [false, true] {
                let set = ["policy.q-learning.mu1=0", &format!("policy.q-learning.ages={ages}")];
                let scenario = scenario(preset, &set);
                let entry = trained(&scenario, devices, 6, 1000);
                for seed in 1..=3 {
                    let outcome = crate::preparation::run(&evaluation(&scenario, &entry, seed, 1500));
                    let sensing = sensing_per_tti(&outcome);
                    assert!(sensing == 0.0, "{preset}, N = {devices}, ages {ages}: {sensing} sense");
                }
            }
        }
    }
    // With a reward, training makes devices sense.
    let scenario = scenario("paper", &["policy.q-learning.mu1=14"]);
    let entry = trained(&scenario, 10, 6, 1000);
    let sensing = sensing_per_tti(&crate::preparation::run(&evaluation(&scenario, &entry, 1, 1500)));
    assert!(sensing > 1.0, "{sensing} sense");
}

/// The learner with learned prices gathers about as much information per energy as `age-index`.
#[test]
fn with_ages_little_training_comes_near_to_age_index() {
    let devices = 60;
    let learner = scenario("paper", &["policy.q-learning.ages=true", "bs.ranking=posterior"]);
    let entry = trained(&learner, devices, 6, 1500);
    let mean = |of: &dyn Fn(u64) -> Scenario| {
        let runs = (1..=2).map(|seed| crate::preparation::run(&of(seed)).metrics);
        let sums = runs.fold([0.0; 2], |sum, m| {
            [sum[0] + m.info_p1, sum[1] + m.energy_per_device_tti]
        });
        sums.map(|sum| sum / 2.0)
    };
    let [own, energy] = mean(&|seed| evaluation(&learner, &entry, seed, 2000));
    let line: Vec<[f64; 2]> = [0.2, 0.35, 0.6, 1.0]
        .iter()
        .map(|price| {
            let set = [
                "policy.name=age-index".to_owned(),
                format!("policy.age-index.price={price}"),
                format!("devices={devices}"),
                "ttis=2000".to_owned(),
            ];
            let set = set.map(|text| Override::parse(&text).expect("an override"));
            let base = load("paper", &set).expect("a scenario").scenario;
            mean(&|seed| base.with_seed(seed))
        })
        .collect();
    // The price at which age-index spends at most as much as the learner.
    let [other, spent] = *line.iter().find(|point| point[1] <= energy).expect("a price as dear");
    println!("N = {devices}: {own:.3} at {energy:.3}, age-index {other:.3} at {spent:.3}");
    assert!(
        own > 0.95 * other,
        "N = {devices}: {own} at {energy}, age-index {other} at {spent}"
    );
}

#[test]
fn with_energy_for_all_and_a_huge_reward_all_that_can_be_is_covered() {
    for (window, devices) in [(1, 30), (4, 30), (1, 80)] {
        let scenario = scenario(
            "paper",
            &[
                "policy.q-learning.mu1=100000",
                &format!("policy.q-learning.window={window}"),
                "energy.e_max=10000",
                "energy.initial=10000",
                "energy.e_idle=0.001",
                "energy.e_wur=0.0001",
            ],
        );
        let entry = trained(&scenario, devices, 6, 1000);
        let Area { width, height } = scenario.area;
        for seed in 1..=2 {
            let one = evaluation(&scenario, &entry, seed, 60);
            let points = Deployment::new(&one).positions();
            let of = |plans: &[Vec<bool>]| {
                let sensed = |j: &usize| plans.iter().any(|plan| plan[*j]);
                let points: Vec<_> = (0..points.len()).filter(sensed).map(|j| points[j]).collect();
                uncovered(Area { width, height }, &points)
            };
            let least = of(&[vec![true; points.len()]]);
            assert!(least < 0.3, "{least}");
            let mut run = Run::new(&PreparedRun::without_pilots(&one), RunOptions::default());
            let mut plans: Vec<Vec<bool>> = Vec::new();
            for k in 0..60_u64 {
                run.run_grant(&mut ());
                assert_eq!(run.cycle().next_tti().0, k + 1, "it decides in every TTI");
                let plan = run.cycle().plan();
                let is_on = |j: u32| plan.duty_cycle(DeviceId(j)).is_on(reveille_common::ids::Tti(k));
                plans.push((0..devices).map(is_on).collect());
                if plans.len() >= window {
                    let share = of(&plans[plans.len() - window..]);
                    let what = format!("window {window}, N = {devices}, seed {seed}, TTI {k}");
                    assert!(
                        (share - least).abs() < 1e-12,
                        "{what}: {share}, not {least}, is uncovered"
                    );
                }
            }
            let all = plans.iter().flatten().filter(|on| **on).count();
            assert!(all < 60 * devices as usize, "nor more than that");
        }
    }
}

/// The number of sensing devices in each of the first `ttis` TTIs of learning, and the tables at the end.
fn while_learning(set: &[&str], ttis: u64) -> (Vec<usize>, TableSet) {
    let rich = ["energy.e_idle=0.001", "energy.e_wur=0.0001", "devices=40"];
    let ttis_are = format!("ttis={ttis}");
    let set: Vec<&str> = rich.iter().chain(set).copied().chain([ttis_are.as_str()]).collect();
    let scenario = scenario("paper", &set);
    let mut run = Run::new(&PreparedRun::without_pilots(&scenario), RunOptions::default());
    let mut sensing = Vec::new();
    for k in 0..ttis {
        run.run_grant(&mut ());
        let plan = run.cycle().plan();
        let is_on = |j: &u32| plan.duty_cycle(DeviceId(*j)).is_on(reveille_common::ids::Tti(k));
        sensing.push((0..40).filter(is_on).count());
    }
    (sensing, tables_of(&run.finish(&mut ())).expect("it learns"))
}

#[test]
fn exploration_rates_and_optimism_are_those_of_the_scenario() {
    // Without a reward for detection only exploration makes devices sense: ε/2 of them.
    let dice = ["policy.q-learning.mu1=0", "policy.q-learning.epsilon=0.8"];
    let share = |sensing: &[usize]| sensing.iter().sum::<usize>() as f64 / (40 * sensing.len()) as f64;
    let (even, _) = while_learning(&dice, 600);
    assert!((share(&even) - 0.4).abs() < 0.02, "{}", share(&even));
    let (falling, _) = while_learning(&[&dice[..], &["policy.q-learning.epsilon_last=0"]].concat(), 600);
    for (third, expected) in falling.chunks(200).zip([0.4 * 5.0 / 6.0, 0.2, 0.4 / 6.0]) {
        assert!(
            (share(third) - expected).abs() < 0.02,
            "{}, not {expected}",
            share(third)
        );
    }
    // Without an expected gain a device is never tried; optimism makes the policy try it.
    let calm = |optimism: &str| while_learning(&["policy.q-learning.epsilon=0", optimism], 50);
    let (none, _) = calm("policy.q-learning.optimism=0");
    assert_eq!(none.iter().sum::<usize>(), 0);
    let (some, usual) = calm("policy.q-learning.optimism=1");
    assert!(some[0] > 5, "{some:?}");
    // With a rate of 1 a value is the last sample. For δ = 0 that is the reward 1 of sleep plus the battery's gain.
    let (_, last) = while_learning(&["policy.q-learning.epsilon=0", "policy.q-learning.rate_floor=1"], 50);
    let asleep = |entry: &TableSet| entry.duty.at(7, 0, false).value;
    assert!(asleep(&last) >= 1.0 && last.duty != usual.duty, "{}", asleep(&last));
    let slow = ["policy.q-learning.epsilon=0", "policy.q-learning.rate_decay=0.1"];
    assert!(while_learning(&slow, 50).1.duty != usual.duty);
}

#[test]
fn a_training_goes_on_from_any_checkpoint_as_if_nothing_had_been() {
    let folder = std::env::temp_dir().join(format!("reveille-training-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let path = folder.join("kept");
    let mut stream = Stream::new(5, Purpose::Training, 0);
    for _ in 0..12 {
        // Numbers that a file does not hold to the last bit; 1/(1 − ζ) is even further off.
        let set = [
            format!("policy.q-learning.mu1={}", 20.0 * stream.unit()),
            format!("policy.q-learning.mu2={}", 5.0 * stream.unit()),
            format!("policy.q-learning.zeta={}", 0.99 * stream.unit()),
            format!("area.width={}", 10.0 + 10.0 * stream.unit()),
            format!("area.height={}", 10.0 + 10.0 * stream.unit()),
            format!("events.alpha={}", stream.unit()),
        ];
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        let scenario = scenario("paper", &set);
        let how = QTrainingConfig {
            epsilon: (0.9 * stream.unit(), 0.9 * stream.unit()),
            ..training(3, 60)
        };
        let lookbacks = [Lookback::Window(3), Lookback::Ages, Lookback::Window(1)];
        let new = || Trainer::new(&scenario, &[5, 9], &lookbacks, &how).expect("a training");
        let mut whole = new();
        assert!(!whole.resume(&path).expect("none"));
        assert!(whole.train(2, &|_| Ok(()), &()).expect("no file"));
        let stop = AtEpisode(std::sync::atomic::AtomicU64::new(stream.below(18)));
        let mut cut = new();
        assert!(!cut.train_and_save(1, &path, &stop).expect("a file") || !path.exists());
        let mut rest = new();
        let resumed = rest.resume(&path).expect("a checkpoint of this training");
        assert_eq!(resumed, rest.episodes_left() < 18);
        assert!(rest.train_and_save(1, &path, &()).expect("a file"));
        assert!(rest.learned().to_json() == whole.learned().to_json());
        std::fs::remove_file(&path).expect("the checkpoint");
    }
    std::fs::remove_dir(&folder).expect("the folder");
}

/// Stops after the given number of episodes.
struct AtEpisode(std::sync::atomic::AtomicU64);

impl TrainingProgress for AtEpisode {
    fn episode(&self, _: &TableSet, _: &CurvePoint) {
        self.0.fetch_sub(1, std::sync::atomic::Ordering::Relaxed);
    }

    fn stop(&self) -> bool {
        self.0.load(std::sync::atomic::Ordering::Relaxed) == 0
    }
}

/// The mean of r*(k) over the events of two runs, with `wake` as the table for `ranking`.
fn waking_reward(entry: &TableSet, ranking: WakeUpRanking, wake: &WakeTable) -> f64 {
    const TTIS: u64 = 1500;
    let mut entry = entry.clone();
    (entry.wake_p42, entry.wake_posterior) = (wake.clone(), wake.clone());
    let mut base = scenario("paper", &["policy.q-learning.mu2=1"]);
    base.bs.ranking = ranking;
    let of = |seed: u64| {
        let scenario = evaluation(&base, &entry, seed, TTIS);
        let outcome = Run::new(&PreparedRun::without_pilots(&scenario), RunOptions::default()).finish(&mut ());
        outcome.metrics.info_per_event - outcome.metrics.wake_ups_per_event / f64::from(entry.devices)
    };
    0.5 * (of(7001) + of(7002))
}

#[test]
fn no_simple_rule_for_waking_is_better_than_the_shipped_tables() {
    let shipped = LearnedTables::shipped_named("shipped").expect("tables");
    let entry = shipped.closest_entry(Lookback::Window(1), 60, 400.0).expect("an entry");
    assert_eq!(entry.devices, 60);
    for ranking in [WakeUpRanking::P42, WakeUpRanking::Posterior] {
        let own = match ranking {
            WakeUpRanking::P42 => &entry.wake_p42,
            WakeUpRanking::Posterior => &entry.wake_posterior,
        };
        let own = waking_reward(entry, ranking, own);
        let mut best = f64::MIN;
        // Wakes while the best candidate has at least this score and there are fewer reports.
        for (score, reports) in [
            (2.0, 1),
            (0.0, 2),
            (0.0, 4),
            (0.02, 4),
            (0.05, 3),
            (0.1, 4),
            (0.2, 2),
            (0.3, 4),
        ] {
            let mut rule = WakeTable::optimistic(-1.0);
            for state in (0..SCORE_BUCKETS)
                .flat_map(|s| (0..INFORMATION_BUCKETS).flat_map(move |i| (0..REPORT_BUCKETS).map(move |r| [s, i, r])))
            {
                let [bucket, _, before] = state;
                if score_edge(bucket) >= score && before + 1 < reports {
                    rule.at_mut(state).value = 1.0;
                }
            }
            let worth = waking_reward(entry, ranking, &rule);
            println!("{ranking:?}: from {score} on, fewer than {reports} reports: {worth:.4}, the table {own:.4}");
            best = best.max(worth);
        }
        assert!(own > best - 0.002, "{ranking:?}: {own}, and a simple rule has {best}");
    }
}
