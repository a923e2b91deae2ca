//! Environments against runs of the policies whose actions they repeat.

use reveille_bs::policy::external::{DEVICE_FEATURES, GLOBAL_FEATURES};
use reveille_bs::policy::outside;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::io::Disk;
use reveille_common::rng::{Purpose, Stream};

use super::batch::REWARD_TERMS;
use super::*;

fn overrides(policy: &str, set: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    let always = [policy.as_str(), "devices=24", "ttis=400"];
    let all = always.iter().chain(set);
    all.map(|set| Override::parse(set).expect("an override")).collect()
}

fn external(set: &[&str]) -> Scenario {
    let overrides = overrides("external", set);
    reveille_common::scenario::load("paper", &overrides, &outside::kinds_with_external(), &Disk)
        .expect("a scenario")
        .scenario
}

/// The output buffers of `k` environments of `n` devices.
struct OwnedBuffers {
    devices: Vec<f32>,
    global: Vec<f32>,
    stage: Vec<i64>,
    mask: Vec<i8>,
    reward: Vec<f64>,
    parts: Vec<f64>,
    ttis: Vec<i64>,
    ended: Vec<bool>,
}

impl OwnedBuffers {
    fn new(k: usize, n: usize) -> Self {
        Self {
            devices: vec![0.0; k * n * DEVICE_FEATURES.len()],
            global: vec![0.0; k * GLOBAL_FEATURES.len()],
            stage: vec![0; k],
            mask: vec![0; k * n],
            reward: vec![0.0; k],
            parts: vec![0.0; k * REWARD_TERMS],
            ttis: vec![0; k],
            ended: vec![false; k],
        }
    }

    fn views(&mut self) -> BatchBuffers<'_> {
        BatchBuffers {
            devices: &mut self.devices,
            global: &mut self.global,
            stage: &mut self.stage,
            mask: &mut self.mask,
            reward: &mut self.reward,
            parts: &mut self.parts,
            ttis: &mut self.ttis,
            ended: &mut self.ended,
        }
    }
}

#[test]
fn what_a_policy_does_is_done_by_steps_with_its_digest() {
    for set in [&[][..], &["bs.battery_knowledge=reported", "radio.uplink_loss=0.1"]] {
        for policy in ["age-index", "q-learning", "dt"] {
            let own = load("paper", &overrides(policy, set)).expect("a scenario").scenario;
            let actions = record(&own, &external(set)).expect("no genie");
            assert_eq!(
                actions.policy_outcome.digest, actions.environment_outcome.digest,
                "{policy}"
            );
            assert!(actions.stages.contains(&1) && actions.rows.len() == actions.stages.len() * 24);
        }
        // A periodic plan is sent as bits: the outcome is equal, but more plans are sent.
        let own = load("paper", &overrides("knn", set)).expect("a scenario").scenario;
        let actions = record(&own, &external(set)).expect("no genie");
        let [own, stepped] = [&actions.policy_outcome, &actions.environment_outcome];
        assert_ne!(own.digest, stepped.digest);
        assert_eq!(own.totals.events, stepped.totals.events);
        assert_eq!(own.totals.energy, stepped.totals.energy);
    }
    let genie = load("paper", &overrides("genie", &[])).expect("a scenario").scenario;
    assert!(record(&genie, &external(&[])).is_none());
}

#[test]
fn a_batch_on_threads_shows_what_each_environment_shows_alone() {
    let scenarios: Vec<Scenario> = (0..5)
        .map(|seed| external(&[&format!("seed={seed}"), "ttis=60"]))
        .collect();
    let mut whole = EnvBatch::new(&scenarios, RewardWeights::default(), 3).expect("threads");
    let mut alone: Vec<EnvBatch> = scenarios
        .iter()
        .map(|scenario| EnvBatch::new(std::slice::from_ref(scenario), RewardWeights::default(), 1).expect("no threads"))
        .collect();
    let (mut all, mut one) = (OwnedBuffers::new(5, 24), OwnedBuffers::new(1, 24));
    let mut stream = Stream::new(3, Purpose::Training, 0);
    let (mut stages, mut ends) = (0, 0);
    for _ in 0..100 {
        let actions: Vec<i8> = (0..5 * 24).map(|_| i8::from(stream.below(6) == 0)).collect();
        whole.step(&actions, &[false; 5], all.views());
        for (at, batch) in alone.iter_mut().enumerate() {
            batch.step(&actions[at * 24..][..24], &[false], one.views());
            assert_eq!(
                one.devices,
                all.devices[at * 24 * DEVICE_FEATURES.len()..][..24 * DEVICE_FEATURES.len()]
            );
            assert_eq!(
                one.global,
                all.global[at * GLOBAL_FEATURES.len()..][..GLOBAL_FEATURES.len()]
            );
            assert_eq!(
                (one.stage[0], one.ttis[0], one.ended[0]),
                (all.stage[at], all.ttis[at], all.ended[at])
            );
            assert_eq!(one.reward[0].to_bits(), all.reward[at].to_bits());
            assert!((one.reward[0] - one.parts.iter().sum::<f64>()).abs() < 1e-12);
            assert_eq!(one.mask, all.mask[at * 24..][..24]);
            let unit = one.devices.iter().chain(&one.global);
            assert!(
                unit.clone().all(|value| (0.0..=1.0).contains(value)),
                "{:?}",
                one.devices
            );
            (stages, ends) = (stages + one.stage[0], ends + i32::from(one.ended[0]));
        }
    }
    assert!(stages > 10 && ends > 5, "{stages} {ends}");
    for (at, batch) in alone.iter().enumerate() {
        assert_eq!(whole.environments()[at].outcome(), batch.environments()[0].outcome());
    }
}

/// r* is the gain in Î, minus 1/N for each device.
#[test]
fn rewards_are_those_of_the_paper() {
    let scenario = external(&["sensing.psi=2", "ttis=2000"]);
    let mut environment = Environment::new(EpisodeTemplate::new(&scenario), RewardWeights { mu1: 3.0, mu2: 5.0 });
    let mut wakes = 0;
    while let Some(question) = environment.pending_decision() {
        let (stage, before, k) = (
            question.stage,
            question.observation.information,
            question.observation.now.0 % 4,
        );
        let free: Vec<usize> = (0..24)
            .filter(|j| question.may_wake(reveille_common::ids::DeviceId(*j as u32)))
            .collect();
        if stage == reveille_bs::policy::external::DecisionStage::Plan {
            let step = environment.step(|j| j as u64 % 4 == k);
            assert!(
                (step.asleep - 0.75).abs() < 1e-12 && step.missed < 0.0 && step.missed >= -3.0 * scenario.events.alpha
            );
            assert_eq!((step.information, step.woken), (0.0, 0.0));
            continue;
        }
        // The other devices, which cannot be woken, cost nothing.
        let two = &free[..free.len().min(6)];
        let now = question.observation.now;
        let step = environment.step(|j| two.contains(&j) || !free.contains(&j));
        assert!((step.woken + two.len() as f64 / 24.0).abs() < 1e-12);
        if let Some(question) = environment
            .pending_decision()
            .filter(|question| question.observation.now == now)
        {
            let gained = (question.observation.information - before) / 2.0;
            assert!((step.information - 5.0 * gained).abs() < 1e-9, "{step:?} {gained}");
            wakes += i32::from(gained > 0.0);
        }
    }
    assert!(wakes > 2, "{wakes}");
}
