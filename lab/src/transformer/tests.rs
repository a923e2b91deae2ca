//! Tests of [`train`] and [`Net`]. The outputs of a net are compared with the inference of the policy `dt`, its
//! gradients with finite differences of the loss, and scores with the values that follow from how the data is drawn.
//! Not checked: the quality of a model trained on recorded runs. Expected gains are computed; their tolerances allow
//! for short trainings and the noise of the data.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use reveille_bs::policy::dt::model::infer::ForwardPass;
use reveille_bs::policy::dt::model::weights::ModelWeights;
use reveille_bs::policy::dt::model::{ModelObjective, ModelShape, OUTPUTS};
use reveille_bs::policy::dt::record::{DeviceStep, TrajectoryStep};
use reveille_bs::policy::dt::tokens::{CAN_SENSE, FEATURE_COUNT};
use reveille_common::ids::Tti;
use reveille_common::rng::{Purpose, Stream};

use super::data::TrainingBatch;
use super::loss::LossDivisors;
use super::*;
use crate::trajectories::Chunk;

const SHAPE: ModelShape = ModelShape {
    memory: 3,
    width: 8,
    heads: 2,
    attends_to_devices: true,
    objective: ModelObjective::Events,
};

const DEVICES: usize = 6;

/// The number of events that a device that looks is expected to report first, given only α.
const EXPECTED_EVENTS: f32 = 0.2;

/// The probability that a device senses.
const SENSING_SHARE: f64 = 0.7;

/// Returns a net whose outputs vary: the weights of the heads are 0 in a new net.
fn noisy_net(shape: ModelShape, seed: u64) -> Net {
    let net = Net::new(shape, seed).expect("a net");
    // Ids above the ids of the streams that `Net::new` draws from.
    for (stream_id, (name, var)) in (100..).zip(net.vars()) {
        let mut stream = Stream::new(seed, Purpose::Training, stream_id);
        let values: Vec<f32> = (0..var.elem_count())
            .map(|_| (0.6 * (stream.unit() - 0.5)) as f32)
            .collect();
        let noise = Tensor::from_vec(values, var.shape(), &Device::Cpu).expect(name);
        var.set(&(var.as_tensor() + noise).expect(name)).expect(name);
    }
    net
}

/// Returns chunks of 5 TTIs in which a device finds `e^m` times the expected number of events if its first feature is
/// above 0, and `e^-m` times otherwise. Wake-ups bring half of the expected gain.
fn random_chunks(count: u32, m: f32) -> Vec<Chunk> {
    let ttis = 5;
    let random_chunk = |run: u32| {
        let mut stream = Stream::new(u64::from(run), Purpose::Training, 1);
        let mut random_step = |k: u64| {
            let tokens: Vec<f32> = (0..DEVICES * FEATURE_COUNT)
                .map(|_| (2.0 * stream.unit() - 1.0) as f32)
                .collect();
            let random_device = |j: usize| {
                let log_ratio = if tokens[j * FEATURE_COUNT] > 0.0 { m } else { -m };
                let expected_gain = 0.2 + 0.3 * stream.unit() as f32;
                DeviceStep {
                    expected_events: EXPECTED_EVENTS,
                    is_sensing: stream.unit() < SENSING_SHARE,
                    has_reported_first: stream.unit() < f64::from(EXPECTED_EVENTS * libm::expf(log_ratio)),
                    wake_up: (stream.unit() < 0.3).then_some((expected_gain, 0.5 * expected_gain)),
                }
            };
            TrajectoryStep {
                // Above 0: the chunk does not start its run.
                tti: Tti(100 + k),
                devices: (0..DEVICES).map(random_device).collect(),
                tokens,
                covered_share: 0.5,
                reward: 0.0,
                wake_reward: 0.0,
            }
        };
        Chunk {
            run,
            policy: "age-index".into(),
            price: Some(0.35),
            devices: DEVICES,
            steps: (0..ttis).map(&mut random_step).collect(),
            returns: vec![0.8; ttis as usize],
        }
    };
    (0..count).map(random_chunk).collect()
}

fn batch_of(chunks: &[Chunk], shape: ModelShape) -> TrainingBatch {
    TrainingBatch::from_chunks(&chunks.iter().collect::<Vec<_>>(), shape).expect("a batch")
}

fn trajectories_of(chunks: Vec<Chunk>) -> Vec<Trajectories> {
    let about = Vec::new();
    vec![Trajectories { about, chunks }]
}

fn short_config(steps: u64, evaluation_interval: u64) -> DtTrainingConfig {
    DtTrainingConfig {
        shape: SHAPE,
        steps,
        batch_device_ttis: 600,
        learning_rate: 0.01,
        evaluation_interval,
        patience: 10,
        seed: 1,
    }
}

/// Returns the file of a training that reached its end.
fn into_model(trained: Trained) -> Vec<u8> {
    match trained {
        Trained::Model(bytes) => bytes,
        Trained::Stopped(_) => panic!("the training was stopped"),
    }
}

#[test]
fn a_net_returns_the_outputs_of_the_policy() {
    let wide = ModelShape {
        width: 40,
        ..ModelShape::WITH_ATTENTION
    };
    let included = [ModelShape::SHIPPED, ModelShape::WITH_ATTENTION];
    included.into_iter().chain([SHAPE, wide]).for_each(compare_outputs);
}

fn compare_outputs(shape: ModelShape) {
    let net = noisy_net(shape, 3);
    let bytes = encode_file(&net, &BTreeMap::new()).expect("a file");
    let weights = Arc::new(ModelWeights::read(&bytes).expect("a model"));
    let chunks = random_chunks(2, 0.5);
    let batch = batch_of(&chunks, shape);
    let outputs = net.forward(&batch.tokens, &batch.targets).expect("outputs");
    let (logs, log_prices) = (outputs.logs.flatten_all(), outputs.log_price.flatten_all());
    let logs: Vec<f32> = logs.and_then(|logs| logs.to_vec1()).expect("numbers");
    let log_prices: Vec<f32> = log_prices.and_then(|prices| prices.to_vec1()).expect("numbers");
    let (mut logs_by_tti, mut log_prices) = (logs.chunks(DEVICES * OUTPUTS), log_prices.into_iter());
    for chunk in &chunks {
        let mut forward = ForwardPass::new(Arc::clone(&weights), chunk.devices);
        for (step, target) in chunk.steps.iter().zip(&chunk.returns) {
            let policy_logs = forward.step(&step.tokens).to_vec();
            for (policy, net) in policy_logs.iter().zip(logs_by_tti.next().expect("a TTI")) {
                assert!((policy - net).abs() < 1e-5, "logarithm: policy {policy}, net {net}");
            }
            let (policy, net) = (forward.log_price(*target), log_prices.next().expect("a TTI"));
            assert!((policy - net).abs() < 1e-5, "price: policy {policy}, net {net}");
        }
    }
}

#[test]
fn each_gradient_is_the_slope_of_the_loss() {
    ModelObjective::ALL.into_iter().for_each(compare_gradients);
}

fn compare_gradients(objective: ModelObjective) {
    // In double precision, so that steps are short compared with the distance to the kink of a relu.
    let net = noisy_net(SHAPE, 4).to_dtype(DType::F64).expect("a net");
    // The features that the price head reads must not learn from it, so the other weights are checked without prices.
    let priced = random_chunks(3, 0.5);
    let mut unpriced = priced.clone();
    for chunk in &mut unpriced {
        chunk.price = None;
    }
    let shape = ModelShape { objective, ..SHAPE };
    let [unpriced, priced] =
        [unpriced, priced].map(|chunks| batch_of(&chunks, shape).to_dtype(DType::F64).expect("a batch"));
    let loss_of = |batch: &TrainingBatch| {
        let outputs = net.forward(&batch.tokens, &batch.targets).expect("outputs");
        let divisors = LossDivisors::from_batches(std::slice::from_ref(batch)).expect("sums");
        LossSums::from_outputs(batch, &outputs)
            .and_then(|sums| sums.loss(divisors))
            .expect("a loss")
    };
    for (name, var) in net.vars() {
        let batch = if name.starts_with("price") { &priced } else { &unpriced };
        let gradients = loss_of(batch).backward().expect("gradients");
        let gradient = gradients.get(var.as_tensor()).expect(name).flatten_all().expect(name);
        let gradient: Vec<f64> = gradient.to_vec1().expect(name);
        let values: Vec<f64> = var.flatten_all().and_then(|values| values.to_vec1()).expect(name);
        let loss_with_shift = |index: usize, shift: f64| {
            let mut values = values.clone();
            values[index] += shift;
            var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu).expect(name))
                .expect(name);
            loss_of(batch).to_scalar::<f64>().expect("a number")
        };
        let shift = 1e-7;
        // About 12 values of each weight, to save time.
        for index in (0..values.len()).step_by(values.len().div_ceil(12)) {
            let slope = (loss_with_shift(index, shift) - loss_with_shift(index, -shift)) / (2.0 * shift);
            let tolerance = 1e-4 * slope.abs() + 1e-6;
            assert!(
                (gradient[index] - slope).abs() < tolerance,
                "{name}, value {index}: gradient {}, slope {slope}",
                gradient[index]
            );
        }
        // Restores the weight.
        loss_with_shift(0, 0.0);
        assert!(
            gradient.iter().any(|partial| partial.abs() > 1e-4),
            "{name}: the gradient is 0"
        );
    }
}

/// The held-out gain of learned actions equals knowing how often a device senses.
#[test]
fn actions_of_teachers_are_learned_as_odds() {
    let mut chunks = random_chunks(300, 0.0);
    for step in chunks.iter_mut().flat_map(|chunk| &mut chunk.steps) {
        for token in step.tokens.as_chunks_mut::<FEATURE_COUNT>().0 {
            token[CAN_SENSE] = f32::from(u8::from(token[CAN_SENSE] > -0.5));
        }
    }
    let config = DtTrainingConfig {
        shape: ModelShape {
            objective: ModelObjective::Actions,
            ..SHAPE
        },
        ..short_config(80, 40)
    };
    let mut last_score = None;
    let mut progress = |status: DtTrainingStatus, _: &[u8]| {
        last_score = Some(status.score);
        true
    };
    let trajectories = trajectories_of(chunks);
    let trained = train(trajectories, &config, &BTreeMap::new(), None, &mut progress, &|| false);
    let bytes = into_model(trained.expect("trained"));
    let model = ModelWeights::read(&bytes).expect("a model");
    assert_eq!(model.shape().objective, ModelObjective::Actions);
    // In nats per device, over the odds of 1 to 1 of a net without history.
    let expected_gain =
        SENSING_SHARE * libm::log(2.0 * SENSING_SHARE) + (1.0 - SENSING_SHARE) * libm::log(2.0 * (1.0 - SENSING_SHARE));
    let score = last_score.expect("an evaluation");
    assert!(
        (score.look_gain - expected_gain).abs() < 0.25 * expected_gain,
        "gain {}, expected {expected_gain}",
        score.look_gain
    );
}

#[test]
fn accuracy_is_the_share_of_pairs_in_order() {
    let numbers = [
        (0.1, false),
        (0.4, true),
        (0.4, false),
        (0.2, true),
        (0.7, true),
        (0.2, false),
        (0.3, false),
    ];
    let (mut ordered_pairs, mut pairs) = (0.0, 0.0);
    for (hit, _) in numbers.iter().filter(|(_, found)| *found) {
        for (miss, _) in numbers.iter().filter(|(_, found)| !*found) {
            // 1 if greater, 0.5 if equal.
            ordered_pairs += 0.5 * (f64::from(u8::from(hit > miss)) + f64::from(u8::from(hit >= miss)));
            pairs += 1.0;
        }
    }
    assert!((loss::accuracy(numbers.into_iter()) - ordered_pairs / pairs).abs() < 1e-12);
    assert!((loss::accuracy([(1.0, true)].into_iter()) - 0.5).abs() < 1e-12);
}

/// The score and the checkpoint of the last evaluation.
type LastEvaluation = Option<(EvalScore, Vec<u8>)>;

/// Trains on random chunks with m = 0.7 until `last_step` or until `stop`, from `checkpoint` if given.
fn train_from(
    checkpoint: Option<&[u8]>,
    config: &DtTrainingConfig,
    last_step: u64,
    stop: &dyn Fn() -> bool,
) -> Result<(Trained, LastEvaluation), TransformerError> {
    let model_info = BTreeMap::from([("data".to_owned(), "a test".to_owned())]);
    let mut last_evaluation = None;
    let mut progress = |status: DtTrainingStatus, checkpoint: &[u8]| {
        last_evaluation = Some((status.score, checkpoint.to_vec()));
        status.step < last_step
    };
    let trajectories = trajectories_of(random_chunks(400, 0.7));
    train(trajectories, config, &model_info, checkpoint, &mut progress, stop).map(|trained| (trained, last_evaluation))
}

#[test]
fn a_training_learns_the_data_and_resumes_to_the_same_bytes() {
    let config = short_config(120, 40);
    let train_to_end = |checkpoint: Option<&[u8]>| {
        train_from(checkpoint, &config, u64::MAX, &|| false).map(|(trained, last)| (into_model(trained), last))
    };
    let (bytes, last_evaluation) = train_to_end(None).expect("trained");
    let (score, _) = last_evaluation.expect("an evaluation");
    assert_eq!(ModelWeights::read(&bytes).expect("a model").metadata["data"], "a test");
    // Interrupted after the first evaluation, and resumed.
    let (_, last_evaluation) = train_from(None, &config, 40, &|| false).expect("interrupted");
    let (_, checkpoint) = last_evaluation.expect("an evaluation");
    assert_eq!(bytes, train_to_end(Some(&checkpoint)).expect("trained").0);
    // Stopped between two evaluations, and right after one.
    for steps in [17_u64, 40, 57] {
        let steps_left = Cell::new(steps);
        let stop = || steps_left.replace(steps_left.get().saturating_sub(1)) == 0;
        let Ok((Trained::Stopped(checkpoint), _)) = train_from(None, &config, u64::MAX, &stop) else {
            panic!("the training was not stopped before step {steps}");
        };
        assert_eq!(
            bytes,
            train_to_end(Some(&checkpoint)).expect("trained").0,
            "stopped before step {steps}"
        );
    }
    // With half of the tokens on each side, knowing the side is worth m·sinh m − (cosh m − 1) nats per expected event.
    let expected_gain = 0.7 * libm::sinh(0.7) - (libm::cosh(0.7) - 1.0);
    assert!(
        score.look_gain > 0.6 * expected_gain && score.look_gain < 1.4 * expected_gain,
        "gain of looks: {}, expected {expected_gain}",
        score.look_gain
    );
    // All wake-ups bring half of the expected gain: ½·ln ½ − (½ − 1) nats.
    let expected_wake_gain = 0.5 - 0.5 * std::f64::consts::LN_2;
    assert!(
        (score.wake_gain - expected_wake_gain).abs() < 0.05,
        "gain of wake-ups: {}, expected {expected_wake_gain}",
        score.wake_gain
    );
    assert!(score.price_error < 0.1, "price error: {}", score.price_error);
    // The side of a token is informative; the mean from age and α is equal for all tokens.
    assert!(
        score.accuracy > 0.55 && (score.plain_accuracy - 0.5).abs() < 1e-9,
        "accuracy: {score:?}"
    );
}

#[test]
fn an_invalid_checkpoint_is_refused_with_the_reason() {
    let own_config = short_config(2, 1);
    let (trained, last_evaluation) = train_from(None, &own_config, u64::MAX, &|| false).expect("trained");
    let (model, (_, checkpoint)) = (into_model(trained), last_evaluation.expect("an evaluation"));
    let error_of =
        |checkpoint: &[u8], config: &DtTrainingConfig| match train_from(Some(checkpoint), config, 2, &|| false) {
            Err(TransformerError::Checkpoint(cause)) => cause,
            other => panic!("{:?}", other.map(|_| "accepted")),
        };
    for damaged in [&checkpoint[..checkpoint.len() - 1], &model[..], b""] {
        assert!(error_of(damaged, &own_config).contains("damaged"));
    }
    // Replaces a text of the header by another of the same length.
    let edited = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = checkpoint
            .windows(from.len())
            .position(|bytes| bytes == from.as_bytes());
        let at = at.unwrap_or_else(|| panic!("no {from:?} in the checkpoint"));
        let mut bytes = checkpoint.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    // Line ends are escaped in the header. The first 2 is `FORMAT_VERSION`, the first counter the 2 steps.
    assert!(error_of(&edited(r#"training":"2\n"#, r#"training":"1\n"#), &own_config).contains("another version"));
    assert!(error_of(&edited(r"2\n2 ", r"2\nx "), &own_config).contains("damaged"));
    let other_config = DtTrainingConfig {
        seed: 2,
        ..own_config.clone()
    };
    assert!(error_of(&checkpoint, &other_config).contains("another training"));
}

/// The text is part of files: with another text, no checkpoint of an earlier build can be resumed.
#[test]
fn the_text_of_a_configuration_is_fixed() {
    let expected = concat!(
        r#"{"batch":600,"every":40,"patience":10,"rate":0.01,"seed":1,"shape":{"attends_to_devices":true,"heads":2,"#,
        r#""memory":3,"objective":"events","width":8},"steps":120}"#
    );
    assert_eq!(short_config(120, 40).to_json(), expected);
}

/// The four parts of a batch (`BATCH_PARTS`) are summed in their order, on any number of threads.
#[test]
fn the_result_is_the_same_on_any_number_of_threads() {
    let train_on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        let trajectories = trajectories_of(random_chunks(40, 0.7));
        let mut progress = |_: DtTrainingStatus, _: &[u8]| true;
        pool.install(|| {
            train(
                trajectories,
                &short_config(12, 6),
                &BTreeMap::new(),
                None,
                &mut progress,
                &|| false,
            )
        })
        .expect("a model")
    };
    let on_one_thread = train_on(1);
    assert!(on_one_thread == train_on(3) && on_one_thread == train_on(4));
}
