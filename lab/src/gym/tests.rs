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

fn overrides_of(policy: &str, fields: &[&str]) -> Vec<Override> {
    let policy = format!("policy.name={policy}");
    let devices = format!("devices={DEVICES}");
    let default_fields = [policy.as_str(), &devices, "ttis=400"];
    let all_fields = default_fields.iter().chain(fields);
    all_fields
        .map(|field| Override::parse(field).expect("an override"))
        .collect()
}

fn external_scenario(fields: &[&str]) -> Scenario {
    let overrides = overrides_of("external", fields);
    reveille_common::scenario::load("paper", &overrides, &outside::kinds_with_external(), &Disk)
        .expect("a scenario")
        .scenario
}

/// The output buffers of `k` environments of `n` devices.
struct OwnedBuffers {
    device_features: Vec<f32>,
    global_features: Vec<f32>,
    stage: Vec<i64>,
    mask: Vec<i8>,
    reward: Vec<f64>,
    reward_terms: Vec<f64>,
    ttis: Vec<i64>,
    ended: Vec<bool>,
}

impl OwnedBuffers {
    fn new(k: usize, n: usize) -> Self {
        Self {
            device_features: vec![0.0; k * n * DEVICE_FEATURES.len()],
            global_features: vec![0.0; k * GLOBAL_FEATURES.len()],
            stage: vec![0; k],
            mask: vec![0; k * n],
            reward: vec![0.0; k],
            reward_terms: vec![0.0; k * REWARD_TERMS],
            ttis: vec![0; k],
            ended: vec![false; k],
        }
    }

    fn as_batch_buffers(&mut self) -> BatchBuffers<'_> {
        BatchBuffers {
            device_features: &mut self.device_features,
            global_features: &mut self.global_features,
            stage: &mut self.stage,
            mask: &mut self.mask,
            reward: &mut self.reward,
            reward_terms: &mut self.reward_terms,
            ttis: &mut self.ttis,
            ended: &mut self.ended,
        }
    }
}

#[test]
fn repeated_actions_of_a_policy_give_the_digest_of_its_run() {
    for fields in [&[][..], &["bs.battery_knowledge=reported", "radio.uplink_loss=0.1"]] {
        for policy in ["age-index", "q-learning", "dt"] {
            let scenario = load("paper", &overrides_of(policy, fields))
                .expect("a scenario")
                .scenario;
            let actions = record(&scenario, &external_scenario(fields)).expect("no genie");
            assert_eq!(
                actions.policy_outcome.digest, actions.environment_outcome.digest,
                "{policy}"
            );
            assert!(actions.stages.contains(&1) && actions.rows.len() == actions.stages.len() * DEVICES);
        }
        // A periodic plan is sent as bits: the outcome is equal, but more plans are sent.
        let scenario = load("paper", &overrides_of("knn", fields))
            .expect("a scenario")
            .scenario;
        let actions = record(&scenario, &external_scenario(fields)).expect("no genie");
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
    let mut batch_buffers = OwnedBuffers::new(ENVIRONMENTS, DEVICES);
    let mut single_buffers = OwnedBuffers::new(1, DEVICES);
    let mut stream = Stream::new(3, Purpose::Training, 0);
    let (mut wake_stages, mut observations_at_the_end) = (0, 0);
    for _ in 0..100 {
        let actions: Vec<i8> = (0..ENVIRONMENTS * DEVICES)
            .map(|_| i8::from(stream.below(6) == 0))
            .collect();
        batch.step(&actions, &[false; ENVIRONMENTS], batch_buffers.as_batch_buffers());
        for (index, single) in singles.iter_mut().enumerate() {
            single.step(
                &actions[index * DEVICES..][..DEVICES],
                &[false],
                single_buffers.as_batch_buffers(),
            );
            let device_values = DEVICES * DEVICE_FEATURES.len();
            assert_eq!(
                single_buffers.device_features,
                batch_buffers.device_features[index * device_values..][..device_values]
            );
            assert_eq!(
                single_buffers.global_features,
                batch_buffers.global_features[index * GLOBAL_FEATURES.len()..][..GLOBAL_FEATURES.len()]
            );
            assert_eq!(
                (single_buffers.stage[0], single_buffers.ttis[0], single_buffers.ended[0]),
                (
                    batch_buffers.stage[index],
                    batch_buffers.ttis[index],
                    batch_buffers.ended[index]
                )
            );
            assert_eq!(
                single_buffers.reward[0].to_bits(),
                batch_buffers.reward[index].to_bits()
            );
            assert!((single_buffers.reward[0] - single_buffers.reward_terms.iter().sum::<f64>()).abs() < 1e-12);
            assert_eq!(single_buffers.mask, batch_buffers.mask[index * DEVICES..][..DEVICES]);
            let mut features = single_buffers
                .device_features
                .iter()
                .chain(&single_buffers.global_features);
            assert!(
                features.all(|value| (0.0..=1.0).contains(value)),
                "device features {:?}, global features {:?}",
                single_buffers.device_features,
                single_buffers.global_features
            );
            wake_stages += single_buffers.stage[0];
            observations_at_the_end += i32::from(single_buffers.ended[0]);
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

/// r* is the gain in Î as a share of Ψ, minus 1/N for each woken device. Of the misdetection term only sign and limit
/// are checked.
#[test]
fn rewards_follow_the_formulas_of_the_paper() {
    const PSI: f64 = 2.0;
    const WEIGHTS: RewardWeights = RewardWeights { mu1: 3.0, mu2: 5.0 };
    let scenario = external_scenario(&[&format!("sensing.psi={PSI}"), "ttis=2000"]);
    let mut environment = Environment::new(EpisodeTemplate::new(&scenario), WEIGHTS);
    let mut gains = 0;
    while let Some(request) = environment.pending_decision() {
        let (now, information_before) = (request.observation.now, request.observation.information);
        let wakeable: Vec<usize> = (0..DEVICES).filter(|j| request.may_wake(DeviceId(*j as u32))).collect();
        if request.stage == DecisionStage::Plan {
            // A quarter of the devices senses.
            let step = environment.step(|j| j as u64 % 4 == now.0 % 4);
            assert!((step.asleep - 0.75).abs() < 1e-12);
            assert!(step.missed < 0.0 && step.missed >= -WEIGHTS.mu1 * scenario.events.alpha);
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
            let gain = (request.observation.information - information_before) / PSI;
            assert!(
                (step.information - WEIGHTS.mu2 * gain).abs() < 1e-9,
                "gain {gain}, step {step:?}"
            );
            gains += i32::from(gain > 0.0);
        }
    }
    // Without cases the test would check nothing; their number follows from the seed.
    assert!(gains > 2, "only {gains} wake-ups with a gain");
}
