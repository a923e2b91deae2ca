//! The trained net equals the deployed one, its gradient is right, and training recovers known structure.

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

fn net(shape: ModelShape, seed: u64) -> Net {
    let net = Net::new(shape, seed).expect("a net");
    for (id, (name, var)) in (100..).zip(net.vars()) {
        let mut stream = Stream::new(seed, Purpose::Training, id);
        let values: Vec<f32> = (0..var.elem_count())
            .map(|_| (0.6 * (stream.unit() - 0.5)) as f32)
            .collect();
        let noise = Tensor::from_vec(values, var.shape(), &Device::Cpu).expect(name);
        var.set(&(var.as_tensor() + noise).expect(name)).expect(name);
    }
    net
}

/// Chunks in which a device finds `e^m` times the expected number of events if its first feature is above 0, and `e^-m`
/// times otherwise.
fn chunks(count: u32, m: f32) -> Vec<Chunk> {
    let (devices, ttis) = (6, 5);
    let chunk = |run: u32| {
        let mut stream = Stream::new(u64::from(run), Purpose::Training, 1);
        let mut step = |k: u64| {
            let tokens: Vec<f32> = (0..devices * FEATURE_COUNT)
                .map(|_| (2.0 * stream.unit() - 1.0) as f32)
                .collect();
            let look = |j: usize| {
                let more = if tokens[j * FEATURE_COUNT] > 0.0 { m } else { -m };
                let hoped = 0.2 + 0.3 * stream.unit() as f32;
                DeviceStep {
                    expected_events: 0.2,
                    is_sensing: stream.unit() < 0.7,
                    has_reported_first: stream.unit() < f64::from(0.2 * libm::expf(more)),
                    wake_up: (stream.unit() < 0.3).then_some((hoped, 0.5 * hoped)),
                }
            };
            TrajectoryStep {
                tti: Tti(100 + k),
                devices: (0..devices).map(look).collect(),
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
            devices,
            steps: (0..ttis).map(&mut step).collect(),
            returns: vec![0.8; ttis as usize],
        }
    };
    (0..count).map(chunk).collect()
}

#[test]
fn what_is_learned_is_what_runs() {
    let wide = ModelShape {
        width: 40,
        ..ModelShape::SHIPPED
    };
    [SHAPE, ModelShape::SHIPPED, wide].into_iter().for_each(compare_outputs);
}

fn compare_outputs(shape: ModelShape) {
    let net = net(shape, 3);
    let bytes = encode_file(&net, &BTreeMap::new()).expect("a file");
    let weights = Arc::new(ModelWeights::read(&bytes).expect("a model"));
    let chunks = chunks(2, 0.5);
    let batch = TrainingBatch::from_chunks(&chunks.iter().collect::<Vec<_>>(), shape).expect("a batch");
    let outputs = net.forward(&batch.tokens, &batch.targets).expect("outputs");
    let (logs, prices) = (outputs.logs.flatten_all(), outputs.price.flatten_all());
    let logs: Vec<f32> = logs.and_then(|logs| logs.to_vec1()).expect("numbers");
    let prices: Vec<f32> = prices.and_then(|prices| prices.to_vec1()).expect("numbers");
    let (mut logs, mut prices) = (logs.chunks(6 * OUTPUTS), prices.into_iter());
    for chunk in &chunks {
        let mut forward = ForwardPass::new(Arc::clone(&weights), chunk.devices);
        for (step, target) in chunk.steps.iter().zip(&chunk.returns) {
            let own = forward.step(&step.tokens).to_vec();
            for (a, b) in own.iter().zip(logs.next().expect("a TTI")) {
                assert!((a - b).abs() < 1e-5, "{a} here, {b} in training");
            }
            let (a, b) = (forward.log_price(*target), prices.next().expect("a TTI"));
            assert!((a - b).abs() < 1e-5, "{a} here, {b} in training");
        }
    }
}

#[test]
fn the_gradient_of_each_weight_is_the_slope_of_the_loss() {
    ModelObjective::ALL.into_iter().for_each(compare_gradients);
}

fn compare_gradients(objective: ModelObjective) {
    // In double precision, so that steps are short compared with the distance to the kink of a relu.
    let net = net(SHAPE, 4);
    let net = net.to_type(DType::F64).expect("a net");
    // The features that the price head reads must not learn from it, so the other weights are checked without prices.
    let priced = chunks(3, 0.5);
    let mut others = priced.clone();
    for chunk in &mut others {
        chunk.price = None;
    }
    let batch = |chunks: &[Chunk]| {
        let shape = ModelShape { objective, ..SHAPE };
        let batch = TrainingBatch::from_chunks(&chunks.iter().collect::<Vec<_>>(), shape);
        batch.and_then(|batch| batch.to_type(DType::F64)).expect("a batch")
    };
    let batches = [batch(&others), batch(&priced)];
    let loss = |batch: &TrainingBatch| {
        let outputs = net.forward(&batch.tokens, &batch.targets).expect("outputs");
        let whole = LossDivisors::from_batches(std::slice::from_ref(batch)).expect("sums");
        Sums::from_outputs(batch, &outputs)
            .and_then(|sums| sums.loss(whole))
            .expect("a loss")
    };
    for (name, var) in net.vars() {
        let batch = &batches[usize::from(name.starts_with("price"))];
        let gradients = loss(batch).backward().expect("gradients");
        let gradient = gradients.get(var.as_tensor()).expect(name).flatten_all().expect(name);
        let gradient: Vec<f64> = gradient.to_vec1().expect(name);
        let values: Vec<f64> = var.flatten_all().and_then(|values| values.to_vec1()).expect(name);
        let moved = |at: usize, by: f64| {
            let mut values = values.clone();
            values[at] += by;
            var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu).expect(name))
                .expect(name);
            loss(batch).to_scalar::<f64>().expect("a number")
        };
        let step = 1e-7;
        for at in (0..values.len()).step_by(values.len().div_ceil(12)) {
            let slope = (moved(at, step) - moved(at, -step)) / (2.0 * step);
            let slack = 1e-4 * slope.abs() + 1e-6;
            assert!(
                (gradient[at] - slope).abs() < slack,
                "{name} {at}: {}, not {slope}",
                gradient[at]
            );
        }
        moved(0, 0.0);
        assert!(gradient.iter().any(|one| one.abs() > 1e-4), "{name} is never reached");
    }
}

/// The held-out gain of learned actions equals knowing how often a device senses: 7 times of 10 here.
#[test]
fn actions_of_teachers_are_learned_as_odds() {
    let mut chunks = chunks(300, 0.0);
    for look in chunks.iter_mut().flat_map(|chunk| &mut chunk.steps) {
        for token in look.tokens.as_chunks_mut::<FEATURE_COUNT>().0 {
            token[CAN_SENSE] = f32::from(u8::from(token[CAN_SENSE] > -0.5));
        }
    }
    let training = DtTrainingConfig {
        shape: ModelShape {
            objective: ModelObjective::Actions,
            ..SHAPE
        },
        steps: 80,
        batch: 600,
        rate: 0.01,
        every: 40,
        patience: 10,
        seed: 1,
    };
    let about = Vec::new();
    let mut score = None;
    let mut show = |progress: DtTrainingStatus, _: &[u8]| {
        score = Some(progress.score);
        true
    };
    let trajectories = vec![Trajectories { about, chunks }];
    let trained = train(trajectories, &training, &BTreeMap::new(), None, &mut show, &|| false);
    let bytes = model(trained.expect("trained"));
    let model = ModelWeights::read(&bytes).expect("a model");
    assert_eq!(model.shape().objective, ModelObjective::Actions);
    let worth = 0.7 * libm::log(1.4) + 0.3 * libm::log(0.6);
    let score = score.expect("a look");
    assert!((score.looks - worth).abs() < 0.25 * worth, "{score:?}, not {worth}");
}

/// The file of a training that reached its end.
fn model(trained: Trained) -> Vec<u8> {
    match trained {
        Trained::Model(bytes) => bytes,
        Trained::Stopped(_) => panic!("it was not stopped"),
    }
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
    let (mut right, mut pairs) = (0.0, 0.0);
    for (a, _) in numbers.iter().filter(|(_, found)| *found) {
        for (b, _) in numbers.iter().filter(|(_, found)| !*found) {
            right += 0.5 * (f64::from(u8::from(a > b)) + f64::from(u8::from(a >= b)));
            pairs += 1.0;
        }
    }
    assert!((loss::accuracy(numbers.into_iter()) - right / pairs).abs() < 1e-12);
    assert!((loss::accuracy([(1.0, true)].into_iter()) - 0.5).abs() < 1e-12);
}

#[test]
fn a_training_finds_what_is_there_and_goes_on_to_the_same_bytes() {
    let training = DtTrainingConfig {
        shape: SHAPE,
        steps: 120,
        batch: 600,
        rate: 0.01,
        every: 40,
        patience: 10,
        seed: 1,
    };
    let trajectories = || {
        vec![Trajectories {
            about: Vec::new(),
            chunks: chunks(400, 0.7),
        }]
    };
    let about = BTreeMap::from([("data".to_owned(), "a test".to_owned())]);
    let stopped = |from: Option<&[u8]>, most: u64, stop: &dyn Fn() -> bool| {
        let mut last = None;
        let mut show = |progress: DtTrainingStatus, checkpoint: &[u8]| {
            last = Some((progress.score, checkpoint.to_vec()));
            progress.step < most
        };
        super::train(trajectories(), &training, &about, from, &mut show, stop).map(|trained| (trained, last))
    };
    let train =
        |from: Option<&[u8]>, most: u64| stopped(from, most, &|| false).map(|(trained, last)| (model(trained), last));
    let (bytes, last) = train(None, 1000).expect("trained");
    let (score, _) = last.expect("a look");
    assert_eq!(ModelWeights::read(&bytes).expect("a model").metadata["data"], "a test");
    // Interrupted after the first evaluation, and resumed.
    let (_, last) = train(None, 40).expect("cut short");
    let (_, kept) = last.expect("a look");
    assert_eq!(bytes, train(Some(&kept), 1000).expect("trained").0);
    // Stopped between two evaluations, and right after one.
    for steps in [17_u64, 40, 57] {
        let left = Cell::new(steps);
        let stop = || left.replace(left.get().saturating_sub(1)) == 0;
        let Ok((Trained::Stopped(kept), _)) = stopped(None, 1000, &stop) else {
            panic!("it was not stopped before step {steps}");
        };
        assert_eq!(
            bytes,
            train(Some(&kept), 1000).expect("trained").0,
            "stopped before step {steps}"
        );
    }
    for bad in [&kept[..kept.len() - 1], &bytes[..], b""] {
        assert!(matches!(train(Some(bad), 1000), Err(TransformerError::Checkpoint(_))));
    }
    let other = DtTrainingConfig {
        seed: 2,
        ..training.clone()
    };
    let refused = super::train(trajectories(), &other, &about, Some(&kept), &mut |_, _| true, &|| false);
    assert!(refused.expect_err("another training").to_string().contains("another"));
    // With half of the tokens on each side, knowing the side is worth m·sinh m − (cosh m − 1) nats per expected event.
    let worth = 0.7 * libm::sinh(0.7) - (libm::cosh(0.7) - 1.0);
    assert!(
        score.looks > 0.6 * worth && score.looks < 1.4 * worth,
        "{score:?}, not {worth}"
    );
    // All wake-ups bring half of the expected gain: ln 2/2 − 1/2 + 1 nats less 1/2.
    let halved = 0.5 - 0.5 * std::f64::consts::LN_2;
    assert!((score.wakes - halved).abs() < 0.05, "{score:?}, not {halved}");
    assert!(score.price_error < 0.1, "{score:?}");
    // The side of a token is informative; the mean from age and α is equal for all tokens.
    assert!(
        score.accuracy > 0.55 && (score.plain_accuracy - 0.5).abs() < 1e-9,
        "{score:?}"
    );
}

/// The parts of a batch are summed in their order, on any number of threads.
#[test]
fn threads_do_not_show() {
    let training = DtTrainingConfig {
        shape: SHAPE,
        steps: 12,
        batch: 600,
        rate: 0.01,
        every: 6,
        patience: 10,
        seed: 1,
    };
    let model = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        let trajectories = vec![Trajectories {
            about: Vec::new(),
            chunks: chunks(40, 0.7),
        }];
        let mut go_on = |_: DtTrainingStatus, _: &[u8]| true;
        pool.install(|| super::train(trajectories, &training, &BTreeMap::new(), None, &mut go_on, &|| false))
            .expect("a model")
    };
    let one = model(1);
    assert!(one == model(3) && one == model(4));
}
