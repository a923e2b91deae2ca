//! Tests of [`Environment`], [`EnvBatch`] and [`record`]: steps are compared with a run of the policy whose actions
//! they repeat, batches with single environments, and rewards with the formulas of the paper.

use reveille_bs::policy::external::{DEVICE_FEATURES, DecisionStage, GLOBAL_FEATURES};
use reveille_bs::policy::outside;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::ids::DeviceId;
use reveille_common::io::Disk;
use reveille_common::rng::{Purpose, Stream};

use super::batch::REWARD_TERMS;
use super::*;

const DEVICES: usize = 24;

fn overrides_of(policy: &str, set: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    let devices = format!("devices={DEVICES}");
    let always = [policy.as_str(), &devices, "ttis=400"];
    let all = always.iter().chain(set);
    all.map(|set| Override::parse(set).expect("an override")).collect()
}

fn external_scenario(set: &[&str]) -> Scenario {
    let overrides = overrides_of("external", set);
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
fn repeated_actions_of_a_policy_give_the_digest_of_its_run() {
    for set in [&[][..], &["bs.battery_knowledge=reported", "radio.uplink_loss=0.1"]] {
        for policy in ["age-index", "q-learning", "dt"] {
            let scenario = load("paper", &overrides_of(policy, set)).expect("a scenario").scenario;
            let actions = record(&scenario, &external_scenario(set)).expect("no genie");
            assert_eq!(
                actions.policy_outcome.digest, actions.environment_outcome.digest,
                "{policy}"
            );
            assert!(actions.stages.contains(&1) && actions.rows.len() == actions.stages.len() * DEVICES);
        }
        // A periodic plan is sent as bits: the outcome is equal, but more plans are sent.
        let scenario = load("paper", &overrides_of("knn", set)).expect("a scenario").scenario;
        let actions = record(&scenario, &external_scenario(set)).expect("no genie");
        let [policy, environment] = [&actions.policy_outcome, &actions.environment_outcome];
        assert_ne!(policy.digest, environment.digest);
        assert_eq!(policy.totals.events, environment.totals.events);
        assert_eq!(policy.totals.energy, environment.totals.energy);
    }
    let genie = load("paper", &overrides_of("genie", &[])).expect("a scenario").scenario;
    assert!(record(&genie, &external_scenario(&[])).is_none());
}

#[test]
fn a_batch_on_threads_equals_single_environments() {
    const ENVIRONMENTS: usize = 5;
    let scenarios: Vec<Scenario> = (0..ENVIRONMENTS)
        .map(|seed| external_scenario(&[&format!("seed={seed}"), "ttis=60"]))
        .collect();
    let mut batch = EnvBatch::new(&scenarios, RewardWeights::default(), 3).expect("threads");
    let mut singles: Vec<EnvBatch> = scenarios
        .iter()
        .map(|scenario| EnvBatch::new(std::slice::from_ref(scenario), RewardWeights::default(), 1).expect("no threads"))
        .collect();
    let mut all = OwnedBuffers::new(ENVIRONMENTS, DEVICES);
    let mut one = OwnedBuffers::new(1, DEVICES);
    let mut stream = Stream::new(3, Purpose::Training, 0);
    let (mut wake_stages, mut observations_at_the_end) = (0, 0);
    for _ in 0..100 {
        let actions: Vec<i8> = (0..ENVIRONMENTS * DEVICES)
            .map(|_| i8::from(stream.below(6) == 0))
            .collect();
        batch.step(&actions, &[false; ENVIRONMENTS], all.views());
        for (index, single) in singles.iter_mut().enumerate() {
            single.step(&actions[index * DEVICES..][..DEVICES], &[false], one.views());
            let device_values = DEVICES * DEVICE_FEATURES.len();
            assert_eq!(one.devices, all.devices[index * device_values..][..device_values]);
            assert_eq!(
                one.global,
                all.global[index * GLOBAL_FEATURES.len()..][..GLOBAL_FEATURES.len()]
            );
            assert_eq!(
                (one.stage[0], one.ttis[0], one.ended[0]),
                (all.stage[index], all.ttis[index], all.ended[index])
            );
            assert_eq!(one.reward[0].to_bits(), all.reward[index].to_bits());
            assert!((one.reward[0] - one.parts.iter().sum::<f64>()).abs() < 1e-12);
            assert_eq!(one.mask, all.mask[index * DEVICES..][..DEVICES]);
            let mut features = one.devices.iter().chain(&one.global);
            assert!(
                features.all(|value| (0.0..=1.0).contains(value)),
                "device features {:?}, global features {:?}",
                one.devices,
                one.global
            );
            wake_stages += one.stage[0];
            observations_at_the_end += i32::from(one.ended[0]);
        }
    }
    assert!(
        wake_stages > 10 && observations_at_the_end > 5,
        "too few cases: {wake_stages} wake stages, {observations_at_the_end} observations at the end"
    );
    for (index, single) in singles.iter().enumerate() {
        assert_eq!(
            batch.environments()[index].outcome(),
            single.environments()[0].outcome()
        );
    }
}

/// r* is the gain in Î, minus 1/N for each woken device.
#[test]
fn rewards_follow_the_formulas_of_the_paper() {
    let scenario = external_scenario(&["sensing.psi=2", "ttis=2000"]);
    let mut environment = Environment::new(EpisodeTemplate::new(&scenario), RewardWeights { mu1: 3.0, mu2: 5.0 });
    let mut gains = 0;
    while let Some(request) = environment.pending_decision() {
        let (now, information_before) = (request.observation.now, request.observation.information);
        let wakeable: Vec<usize> = (0..DEVICES).filter(|j| request.may_wake(DeviceId(*j as u32))).collect();
        if request.stage == DecisionStage::Plan {
            // A quarter of the devices senses.
            let step = environment.step(|j| j as u64 % 4 == now.0 % 4);
            assert!((step.asleep - 0.75).abs() < 1e-12);
            assert!(step.missed < 0.0 && step.missed >= -3.0 * scenario.events.alpha);
            assert_eq!((step.information, step.woken), (0.0, 0.0));
            continue;
        }
        // Devices that cannot be woken cost nothing.
        let woken = &wakeable[..wakeable.len().min(6)];
        let step = environment.step(|j| woken.contains(&j) || !wakeable.contains(&j));
        assert!((step.woken + woken.len() as f64 / DEVICES as f64).abs() < 1e-12);
        // Without a further request in this TTI, the information after the wake-ups is not known.
        if let Some(request) = environment
            .pending_decision()
            .filter(|request| request.observation.now == now)
        {
            let gain = (request.observation.information - information_before) / 2.0;
            assert!(
                (step.information - 5.0 * gain).abs() < 1e-9,
                "gain {gain}, step {step:?}"
            );
            gains += i32::from(gain > 0.0);
        }
    }
    assert!(gains > 2, "only {gains} wake-ups with a gain");
}
