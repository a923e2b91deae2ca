//! Tests of [`Trainer`] and of the tables that it returns: cases with a known best policy, the fields of a scenario
//! that apply during learning, and resuming from checkpoints. [`six_devices`] and [`three_devices`] compare a learner
//! with the exact optimum of small networks. Not checked: the results on the scale of the paper.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use reveille_bs::policy::q_learning::learned::{
    INFORMATION_BUCKETS, REPORT_BUCKETS, SCORE_BUCKETS, WakeTable, score_edge,
};
use reveille_bs::scenario::{Override, PolicyChoice, load};
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};

use self::six_devices::uncovered_share;
use super::*;

mod six_devices;
mod three_devices;

fn scenario_with(preset: &str, set: &[&str]) -> Scenario {
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

fn training_config(episodes: u64, ttis: u64) -> QTrainingConfig {
    QTrainingConfig {
        episodes,
        ttis,
        epsilon: (0.1, 0.03),
        seed: 1,
    }
}

fn train_table(scenario: &Scenario, devices: u32, episodes: u64, ttis: u64) -> TableSet {
    let mut trainer = Trainer::new(scenario, &[devices], &[], &training_config(episodes, ttis)).expect("a training");
    assert!(
        trainer.train(1, &|_| Ok(()), &()).expect("no file is written"),
        "the training was stopped"
    );
    trainer.learned().entries.swap_remove(0)
}

/// Returns the scenario of a run with the tables of `entry` and without learning.
fn evaluation_of(scenario: &Scenario, entry: &TableSet, seed: u64, ttis: u64) -> Scenario {
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
fn no_device_senses_without_a_reward_for_detection() {
    for preset in ["paper", "paper-literal"] {
        for devices in [10, 60] {
            for ages in [false, true] {
                let set = ["policy.q-learning.mu1=0", &format!("policy.q-learning.ages={ages}")];
                let scenario = scenario_with(preset, &set);
                let entry = train_table(&scenario, devices, 6, 1000);
                for seed in 1..=3 {
                    let outcome = crate::preparation::run(&evaluation_of(&scenario, &entry, seed, 1500));
                    let sensing = sensing_per_tti(&outcome);
                    assert!(
                        sensing == 0.0,
                        "{preset}, N = {devices}, ages {ages}: {sensing} devices sense per TTI"
                    );
                }
            }
        }
    }
    // With a reward, training makes devices sense.
    let scenario = scenario_with("paper", &["policy.q-learning.mu1=14"]);
    let entry = train_table(&scenario, 10, 6, 1000);
    let sensing = sensing_per_tti(&crate::preparation::run(&evaluation_of(&scenario, &entry, 1, 1500)));
    assert!(sensing > 1.0, "{sensing} devices sense per TTI");
}

/// The learner with learned prices gathers about as much information per energy as `age-index`.
#[test]
fn a_short_training_with_ages_performs_like_age_index() {
    let devices = 60;
    let learner = scenario_with("paper", &["policy.q-learning.ages=true", "bs.ranking=posterior"]);
    let entry = train_table(&learner, devices, 6, 1500);
    // Information and energy, over two seeds.
    let mean_results = |scenario_of: &dyn Fn(u64) -> Scenario| {
        let runs = (1..=2).map(|seed| crate::preparation::run(&scenario_of(seed)).metrics);
        let sums = runs.fold([0.0; 2], |sum, metrics| {
            [sum[0] + metrics.info_p1, sum[1] + metrics.energy_per_device_tti]
        });
        sums.map(|sum| sum / 2.0)
    };
    let [info, energy] = mean_results(&|seed| evaluation_of(&learner, &entry, seed, 2000));
    let by_price: Vec<[f64; 2]> = [0.2, 0.35, 0.6, 1.0]
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
            mean_results(&|seed| base.with_seed(seed))
        })
        .collect();
    // The lowest price at which age-index spends at most as much energy as the learner.
    let [age_index_info, age_index_energy] = *by_price
        .iter()
        .find(|point| point[1] <= energy)
        .expect("a price with at most this energy");
    let results = format!(
        "learner: information {info:.3} at energy {energy:.3}; age-index: {age_index_info:.3} at {age_index_energy:.3}"
    );
    println!("{results}");
    assert!(info > 0.95 * age_index_info, "{results}");
}

#[test]
fn devices_cover_all_that_they_can_with_enough_energy_and_reward() {
    const TTIS: u64 = 60;
    for (window, devices) in [(1, 30), (4, 30), (1, 80)] {
        let scenario = scenario_with(
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
        let entry = train_table(&scenario, devices, 6, 1000);
        for seed in 1..=2 {
            let scenario = evaluation_of(&scenario, &entry, seed, TTIS);
            let points = Deployment::new(&scenario).positions();
            let uncovered_by = |plans: &[Vec<bool>]| {
                let is_sensing = |j: &usize| plans.iter().any(|plan| plan[*j]);
                let sensing: Vec<_> = (0..points.len()).filter(is_sensing).map(|j| points[j]).collect();
                uncovered_share(scenario.area, &sensing)
            };
            let least_uncovered = uncovered_by(&[vec![true; points.len()]]);
            assert!(least_uncovered < 0.3, "uncovered by all devices: {least_uncovered}");
            let mut run = Run::new(&PreparedRun::without_pilots(&scenario), RunOptions::default());
            let mut plans: Vec<Vec<bool>> = Vec::new();
            for k in 0..TTIS {
                run.run_grant(&mut ());
                assert_eq!(run.cycle().next_tti().0, k + 1, "the policy decides in every TTI");
                let plan = run.cycle().plan();
                let is_on = |j: u32| plan.duty_cycle(DeviceId(j)).is_on(Tti(k));
                plans.push((0..devices).map(is_on).collect());
                if plans.len() >= window {
                    let uncovered = uncovered_by(&plans[plans.len() - window..]);
                    assert!(
                        (uncovered - least_uncovered).abs() < 1e-12,
                        "window {window}, N = {devices}, seed {seed}, TTI {k}: uncovered {uncovered}, by all devices \
                         {least_uncovered}"
                    );
                }
            }
            let sensing = plans.iter().flatten().filter(|is_on| **is_on).count();
            assert!(
                sensing < TTIS as usize * devices as usize,
                "not all devices sense in every TTI"
            );
        }
    }
}

/// Returns the number of sensing devices, of 40, in each of the first `ttis` TTIs of learning, and the tables at the
/// end.
fn run_learning(set: &[&str], ttis: u64) -> (Vec<usize>, TableSet) {
    let cheap_sensing = ["energy.e_idle=0.001", "energy.e_wur=0.0001", "devices=40"];
    let ttis_field = format!("ttis={ttis}");
    let set: Vec<&str> = cheap_sensing
        .iter()
        .chain(set)
        .copied()
        .chain([ttis_field.as_str()])
        .collect();
    let scenario = scenario_with("paper", &set);
    let mut run = Run::new(&PreparedRun::without_pilots(&scenario), RunOptions::default());
    let mut sensing = Vec::new();
    for k in 0..ttis {
        run.run_grant(&mut ());
        let plan = run.cycle().plan();
        let is_on = |j: &u32| plan.duty_cycle(DeviceId(*j)).is_on(Tti(k));
        sensing.push((0..40).filter(is_on).count());
    }
    (sensing, tables_of(&run.finish(&mut ())).expect("a learning run"))
}

#[test]
fn learning_follows_the_exploration_rates_and_optimism_of_the_scenario() {
    // Without a reward for detection only exploration makes devices sense: ε/2 of them.
    let exploring = ["policy.q-learning.mu1=0", "policy.q-learning.epsilon=0.8"];
    let sensing_share = |sensing: &[usize]| sensing.iter().sum::<usize>() as f64 / (40 * sensing.len()) as f64;
    let (constant, _) = run_learning(&exploring, 600);
    let constant = sensing_share(&constant);
    assert!((constant - 0.4).abs() < 0.02, "sensing share {constant}");
    let (decreasing, _) = run_learning(&[&exploring[..], &["policy.q-learning.epsilon_last=0"]].concat(), 600);
    // Means over thirds of the run, in which ε falls linearly.
    for (third, expected) in decreasing.chunks(200).zip([0.4 * 5.0 / 6.0, 0.2, 0.4 / 6.0]) {
        assert!(
            (sensing_share(third) - expected).abs() < 0.02,
            "sensing share {}, expected {expected}",
            sensing_share(third)
        );
    }
    // Without exploration and optimism no device senses, since no gain is expected.
    let run_without_exploration = |optimism: &str| run_learning(&["policy.q-learning.epsilon=0", optimism], 50);
    let (pessimistic, _) = run_without_exploration("policy.q-learning.optimism=0");
    assert_eq!(pessimistic.iter().sum::<usize>(), 0);
    let (optimistic, default_tables) = run_without_exploration("policy.q-learning.optimism=1");
    assert!(optimistic[0] > 5, "sensing devices by TTI: {optimistic:?}");
    // With a rate of 1 a value is the last sample. For δ = 0 that is the reward 1 of sleep plus the battery's gain.
    let (_, last_sample_tables) = run_learning(&["policy.q-learning.epsilon=0", "policy.q-learning.rate_floor=1"], 50);
    let sleep_value = last_sample_tables.duty.at(7, 0, false).value;
    assert!(sleep_value >= 1.0, "value of δ = 0: {sleep_value}");
    assert!(last_sample_tables.duty != default_tables.duty);
    let slow_decay = ["policy.q-learning.epsilon=0", "policy.q-learning.rate_decay=0.1"];
    assert!(run_learning(&slow_decay, 50).1.duty != default_tables.duty);
}

#[test]
fn a_training_resumes_from_any_checkpoint_with_the_same_result() {
    let folder = std::env::temp_dir().join(format!("reveille-training-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let path = folder.join("checkpoint");
    let mut stream = Stream::new(5, Purpose::Training, 0);
    for _ in 0..12 {
        // Random numbers, which a file rounds; the error of 1/(1 − ζ) is even larger.
        let set = [
            format!("policy.q-learning.mu1={}", 20.0 * stream.unit()),
            format!("policy.q-learning.mu2={}", 5.0 * stream.unit()),
            format!("policy.q-learning.zeta={}", 0.99 * stream.unit()),
            format!("area.width={}", 10.0 + 10.0 * stream.unit()),
            format!("area.height={}", 10.0 + 10.0 * stream.unit()),
            format!("events.alpha={}", stream.unit()),
        ];
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        let scenario = scenario_with("paper", &set);
        let config = QTrainingConfig {
            epsilon: (0.9 * stream.unit(), 0.9 * stream.unit()),
            ..training_config(3, 60)
        };
        let lookbacks = [Lookback::Window(3), Lookback::Ages, Lookback::Window(1)];
        let new_trainer = || Trainer::new(&scenario, &[5, 9], &lookbacks, &config).expect("a training");
        let mut uninterrupted = new_trainer();
        assert!(!uninterrupted.resume(&path).expect("no checkpoint"));
        assert!(uninterrupted.train(2, &|_| Ok(()), &()).expect("no file"));
        // 3 episodes for each of 2 numbers of devices and 3 lookbacks.
        let episodes = 18;
        let stop = StopAfterEpisodes(AtomicU64::new(stream.below(episodes)));
        let mut stopped = new_trainer();
        let is_finished = stopped.train_and_save(1, &path, &stop).expect("a file");
        assert!(!is_finished, "the training was not stopped");
        let mut resumed = new_trainer();
        let is_resumed = resumed.resume(&path).expect("a checkpoint of this training");
        assert_eq!(is_resumed, resumed.episodes_left() < episodes);
        assert!(resumed.train_and_save(1, &path, &()).expect("a file"));
        assert!(resumed.learned().to_json() == uninterrupted.learned().to_json());
        std::fs::remove_file(&path).expect("the checkpoint");
    }
    std::fs::remove_dir(&folder).expect("the folder");
}

/// Stops after this number of further episodes.
struct StopAfterEpisodes(AtomicU64);

impl TrainingProgress for StopAfterEpisodes {
    fn episode(&self, _: &TableSet, _: &CurvePoint) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }

    fn should_stop(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
}

/// Returns the mean of r*(k) over the events of two runs, with `wake` as the wake-up table.
fn waking_reward(entry: &TableSet, ranking: WakeUpRanking, wake: &WakeTable) -> f64 {
    const TTIS: u64 = 1500;
    let mut entry = entry.clone();
    (entry.wake_p42, entry.wake_posterior) = (wake.clone(), wake.clone());
    let mut base = scenario_with("paper", &["policy.q-learning.mu2=1"]);
    base.bs.ranking = ranking;
    let reward_of_run = |seed: u64| {
        let scenario = evaluation_of(&base, &entry, seed, TTIS);
        let outcome = Run::new(&PreparedRun::without_pilots(&scenario), RunOptions::default()).finish(&mut ());
        outcome.metrics.info_per_event - outcome.metrics.wake_ups_per_event / f64::from(entry.devices)
    };
    0.5 * (reward_of_run(7001) + reward_of_run(7002))
}

#[test]
fn no_simple_wake_up_rule_exceeds_the_shipped_tables() {
    let shipped = LearnedTables::shipped_named("shipped").expect("tables");
    let entry = shipped.closest_entry(Lookback::Window(1), 60, 400.0).expect("an entry");
    assert_eq!(entry.devices, 60);
    for ranking in [WakeUpRanking::P42, WakeUpRanking::Posterior] {
        let shipped_table = match ranking {
            WakeUpRanking::P42 => &entry.wake_p42,
            WakeUpRanking::Posterior => &entry.wake_posterior,
        };
        let shipped_reward = waking_reward(entry, ranking, shipped_table);
        let mut best_reward = f64::MIN;
        // Wakes while the best candidate has at least this score and the event has fewer than this number of reports.
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
            for score_bucket in (0..SCORE_BUCKETS).filter(|bucket| score_edge(*bucket) >= score) {
                for information_bucket in 0..INFORMATION_BUCKETS {
                    for reports_before in (0..REPORT_BUCKETS).filter(|before| before + 1 < reports) {
                        rule.at_mut([score_bucket, information_bucket, reports_before]).value = 1.0;
                    }
                }
            }
            let reward = waking_reward(entry, ranking, &rule);
            println!(
                "{ranking:?}: rule with score {score}, reports {reports}: {reward:.4}; shipped: {shipped_reward:.4}"
            );
            best_reward = best_reward.max(reward);
        }
        // The tolerance covers the noise of two runs.
        assert!(
            shipped_reward > best_reward - 0.002,
            "{ranking:?}: shipped {shipped_reward}, best rule {best_reward}"
        );
    }
}
