//! Time that the policy `dt` takes for a TTI, on one thread: the inference of [`ForwardPass`] by vector width and by N,
//! compared with the same weights in the training framework over the last Z TTIs. The weights and tokens are random,
//! since times do not depend on their values. `docs/benchmarks.md` repeats the command and shows the results, written
//! by hand.
//!
//! `RAYON_NUM_THREADS=1 cargo bench -p reveille-lab --features train-dt --bench dt`

use std::collections::BTreeMap;
use std::hint::black_box;
use std::sync::Arc;

use candle_core::{Device, Tensor};
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use reveille_bs::policy::dt::model::ModelShape;
use reveille_bs::policy::dt::model::infer::ForwardPass;
use reveille_bs::policy::dt::model::weights::ModelWeights;
use reveille_bs::policy::dt::tokens::FEATURE_COUNT;
use reveille_bs::vector_width::VectorWidth;
use reveille_common::rng::{Purpose, Stream};
use reveille_lab::transformer::{Net, encode_file};

/// Returns random tokens in `[-1, 1)`, by TTI, device and feature.
fn random_tokens(devices: usize, ttis: usize) -> Vec<f32> {
    let mut stream = Stream::new(1, Purpose::Training, 0);
    (0..ttis * devices * FEATURE_COUNT)
        .map(|_| (2.0 * stream.unit() - 1.0) as f32)
        .collect()
}

/// Returns the weights of a random model.
fn random_model(shape: ModelShape) -> (Net, Arc<ModelWeights>) {
    let net = Net::new(shape, 1).expect("a net");
    let bytes = encode_file(&net, &BTreeMap::new()).expect("a file");
    (net, Arc::new(ModelWeights::read(&bytes).expect("a model")))
}

fn bench_inference(criterion: &mut Criterion) {
    let included = [
        ("shipped", ModelShape::SHIPPED),
        ("attention", ModelShape::WITH_ATTENTION),
    ];
    let tti_tokens = random_tokens(250, 1);
    for (model, shape) in included {
        let (net, weights) = random_model(shape);
        let mut group = criterion.benchmark_group(format!("model {model}, a TTI of 250 devices"));
        for width in VectorWidth::supported() {
            let mut forward = ForwardPass::new(Arc::clone(&weights), 250).with_vector_width(width);
            // Attention covers at most Z TTIs: with Z steps before, each measured step attends to all of them.
            for _ in 0..shape.memory {
                forward.step(&tti_tokens);
            }
            // `Debug` also prints the fields of a variant.
            let variant = format!("{width:?}");
            let name = variant.split(['(', ' ']).next().unwrap_or_default().to_owned();
            group.bench_function(BenchmarkId::new("here", name), |bencher| {
                bencher.iter(|| forward.step(black_box(&tti_tokens))[0]);
            });
        }
        group.sample_size(20);
        let window = Tensor::from_vec(
            random_tokens(250, shape.memory),
            (1, shape.memory, 250, FEATURE_COUNT),
            &Device::Cpu,
        )
        .expect("tokens");
        let targets = Tensor::full(0.5_f32, (1, shape.memory), &Device::Cpu).expect("targets");
        group.bench_function("in the framework", |bencher| {
            bencher.iter(|| net.forward(black_box(&window), &targets).expect("outputs").log_price);
        });
        group.finish();

        let mut group = criterion.benchmark_group(format!("model {model}, a TTI of N devices"));
        group.sample_size(20);
        for devices in [10, 50, 250, 1000, 2500] {
            let tti_tokens = random_tokens(devices, 1);
            let mut forward = ForwardPass::new(Arc::clone(&weights), devices);
            // The steps before the measurement fill the memory of Z TTIs, as in the first group.
            for _ in 0..shape.memory {
                forward.step(&tti_tokens);
            }
            group.bench_function(BenchmarkId::from_parameter(devices), |bencher| {
                bencher.iter(|| forward.step(black_box(&tti_tokens))[0]);
            });
        }
        group.finish();
    }
}

criterion_group!(benches, bench_inference);
criterion_main!(benches);
