//! Tests of [`ForwardPass`] against a second calculation in double precision that keeps no state between TTIs, of
//! [`ModelWeights`] with invalid files, and of the metadata of the included models. No test reaches the limit of the
//! price. Training is tested in the crate `lab`, decisions of the policy in `tests/tests/dt.rs`.

use std::collections::BTreeMap;
use std::sync::Arc;

use reveille_common::rng::{Purpose, Stream};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use super::super::tokens::FEATURE_COUNT;
use super::infer::{ForwardPass, MIN_FEATURE, OUTPUT_LIMIT};
use super::kernel::NORM_EPSILON;
use super::weights::{METADATA_KEY, ModelError, ModelWeights, encode_metadata};
use super::{ModelObjective, ModelShape, OUTPUTS};
use crate::vector_width::VectorWidth;

type Tensors = BTreeMap<&'static str, (Vec<usize>, Vec<f32>)>;

fn random_tensors(shape: ModelShape) -> Tensors {
    let tensor = |(id, (name, size)): (u64, (&'static str, Vec<usize>))| {
        let mut stream = Stream::new(11, Purpose::Training, id);
        let count = size.iter().product();
        let values = (0..count).map(|_| (stream.unit() - 0.5) as f32).collect();
        (name, (size, values))
    };
    (0..).zip(shape.tensors()).map(tensor).collect()
}

/// Returns a model file with `tensors`.
fn model_file(shape: ModelShape, tensors: &Tensors) -> Vec<u8> {
    let tensor_bytes: Vec<(&str, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, (size, values))| {
            let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            (*name, size.clone(), bytes)
        })
        .collect();
    let views = tensor_bytes.iter().map(|(name, size, bytes)| {
        (
            *name,
            TensorView::new(Dtype::F32, size.clone(), bytes).expect("a tensor"),
        )
    });
    let metadata = [(METADATA_KEY.to_owned(), encode_metadata(shape, &BTreeMap::new()))];
    safetensors::serialize(views, Some(metadata.into_iter().collect())).expect("a file")
}

/// Returns random tokens of `n` devices for each of `ttis` TTIs.
fn random_tokens(n: usize, ttis: usize) -> Vec<Vec<f32>> {
    let mut stream = Stream::new(12, Purpose::Training, 0);
    (0..ttis)
        .map(|_| {
            (0..n * FEATURE_COUNT)
                .map(|_| (2.0 * stream.unit() - 1.0) as f32)
                .collect()
        })
        .collect()
}

/// Reference model in double precision, computed from all tokens.
struct Reference<'t> {
    tensors: &'t Tensors,
    shape: ModelShape,
}

impl Reference<'_> {
    fn linear(&self, x: &[f64], weight: &str, bias: Option<&str>) -> Vec<f64> {
        let (size, weight) = &self.tensors[weight];
        (0..size[1])
            .map(|to| {
                let sum: f64 = (0..size[0])
                    .map(|from| x[from] * f64::from(weight[from * size[1] + to]))
                    .sum();
                sum + bias.map_or(0.0, |bias| f64::from(self.tensors[bias].1[to]))
            })
            .collect()
    }

    fn norm(&self, x: &[f64], scale: &str) -> Vec<f64> {
        let mean = x.iter().map(|x| x * x).sum::<f64>() / x.len() as f64;
        let inverse = 1.0 / (mean + f64::from(NORM_EPSILON)).sqrt();
        x.iter()
            .zip(&self.tensors[scale].1)
            .map(|(x, scale)| x * inverse * f64::from(*scale))
            .collect()
    }

    /// Applies the feed-forward block of `layer`, with its residual connection.
    fn mix(&self, x: &[f64], layer: &str) -> Vec<f64> {
        let name = |part: &str| format!("{layer}.mix.{part}");
        let mut inner = self.linear(
            &self.norm(x, &name("norm")),
            &name("in.weight"),
            Some(name("in.bias").as_str()),
        );
        for x in &mut inner {
            *x = x.max(0.0);
        }
        let outer = self.linear(&inner, &name("out.weight"), Some(name("out.bias").as_str()));
        x.iter().zip(outer).map(|(x, y)| x + y).collect()
    }

    fn embed(&self, token: &[f32]) -> Vec<f64> {
        let token: Vec<f64> = token.iter().copied().map(f64::from).collect();
        let embedded = self.linear(&token, "embed.weight", Some("embed.bias"));
        embedded.into_iter().map(|x| x.max(0.0)).collect()
    }

    /// Returns the state of device `j` in the last of `ttis` (the tokens of each TTI), after it has attended to earlier
    /// TTIs if the shape has this attention.
    fn attend_across_ttis(&self, ttis: &[Vec<f32>], j: usize) -> Vec<f64> {
        let ModelShape {
            memory, width, heads, ..
        } = self.shape;
        let states: Vec<Vec<f64>> = ttis
            .iter()
            .rev()
            .take(memory)
            .map(|tokens| self.embed(&tokens[j * FEATURE_COUNT..(j + 1) * FEATURE_COUNT]))
            .collect();
        if memory == 1 {
            return self.mix(&states[0], "time");
        }
        let normed: Vec<Vec<f64>> = states.iter().map(|state| self.norm(state, "time.norm")).collect();
        let query = self.linear(&normed[0], "time.query", None);
        let head_width = width / heads;
        let mut gathered = vec![0.0; width];
        for head in 0..heads {
            let columns = head * head_width..(head + 1) * head_width;
            let score = |(lag, state): (usize, &Vec<f64>)| {
                let key = self.linear(state, "time.key", None);
                let product: f64 = columns.clone().map(|i| query[i] * key[i]).sum();
                let bias = f64::from(self.tensors["time.bias"].1[head * memory + lag]);
                libm::exp(product / (head_width as f64).sqrt() + bias)
            };
            let scores: Vec<f64> = normed.iter().enumerate().map(score).collect();
            for (score, state) in scores.iter().zip(&normed) {
                let value = self.linear(state, "time.value", None);
                for i in columns.clone() {
                    gathered[i] += score / scores.iter().sum::<f64>() * value[i];
                }
            }
        }
        let out = self.linear(&gathered, "time.out", None);
        let attended: Vec<f64> = states[0].iter().zip(out).map(|(x, y)| x + y).collect();
        self.mix(&attended, "time")
    }

    /// Returns the states after devices have attended to each other, by the weight of every pair.
    fn attend_across_devices(&self, states: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let ModelShape { width, heads, .. } = self.shape;
        let head_width = width / heads;
        let normed: Vec<Vec<f64>> = states.iter().map(|state| self.norm(state, "space.norm")).collect();
        let feature = |x: Vec<f64>| {
            x.into_iter()
                .map(|x| x.max(0.0) + f64::from(MIN_FEATURE))
                .collect::<Vec<_>>()
        };
        let project = |name: &str| normed.iter().map(|x| self.linear(x, name, None)).collect::<Vec<_>>();
        let queries: Vec<Vec<f64>> = project("space.query").into_iter().map(feature).collect();
        let keys: Vec<Vec<f64>> = project("space.key").into_iter().map(feature).collect();
        let values = project("space.value");
        let attend = |(state, query): (&Vec<f64>, &Vec<f64>)| {
            let mut gathered = vec![0.0; width];
            for head in 0..heads {
                let columns = head * head_width..(head + 1) * head_width;
                let weights: Vec<f64> = keys
                    .iter()
                    .map(|key| columns.clone().map(|i| query[i] * key[i]).sum())
                    .collect();
                for (weight, value) in weights.iter().zip(&values) {
                    for i in columns.clone() {
                        gathered[i] += weight / weights.iter().sum::<f64>() * value[i];
                    }
                }
            }
            let out = self.linear(&gathered, "space.out", None);
            let attended: Vec<f64> = state.iter().zip(out).map(|(x, y)| x + y).collect();
            self.mix(&attended, "space")
        };
        states.iter().zip(&queries).map(attend).collect()
    }

    /// Returns the outputs of all devices and the logarithm of the price for `target` in the last of `ttis`.
    fn step(&self, ttis: &[Vec<f32>], n: usize, target: f64) -> (Vec<f64>, f64) {
        let mut states: Vec<Vec<f64>> = (0..n).map(|j| self.attend_across_ttis(ttis, j)).collect();
        if self.shape.attends_to_devices {
            states = self.attend_across_devices(&states);
        }
        let normed: Vec<Vec<f64>> = states.iter().map(|state| self.norm(state, "head.norm")).collect();
        let raw_outputs = normed
            .iter()
            .flat_map(|state| self.linear(state, "head.weight", Some("head.bias")));
        let outputs = raw_outputs
            .map(|x| f64::from(OUTPUT_LIMIT) * x / (1.0 + x.abs()))
            .collect();
        let mut pooled: Vec<f64> = (0..self.shape.width)
            .map(|i| normed.iter().map(|state| state[i]).sum::<f64>() / n as f64)
            .collect();
        pooled.push(target);
        let mut inner = self.linear(&pooled, "price.in.weight", Some("price.in.bias"));
        for x in &mut inner {
            *x = x.max(0.0);
        }
        let log_price = self.linear(&inner, "price.out.weight", Some("price.out.bias"))[0];
        (outputs, log_price)
    }
}

#[test]
fn every_vector_width_gives_the_same_bits() {
    for shape in [ModelShape::SHIPPED, ModelShape::WITH_ATTENTION] {
        compare_vector_widths(shape);
    }
}

fn compare_vector_widths(shape: ModelShape) {
    let n = 53;
    let weights = Arc::new(ModelWeights::read(&model_file(shape, &random_tensors(shape))).expect("a model"));
    let outputs_with = |width: VectorWidth| -> Vec<u32> {
        let mut forward = ForwardPass::new(Arc::clone(&weights), n).with_vector_width(width);
        let step = |tokens: &Vec<f32>| {
            let mut outputs = forward.step(tokens).to_vec();
            outputs.extend_from_slice(forward.attention());
            outputs.push(forward.log_price(0.5));
            outputs
        };
        random_tokens(n, 12).iter().flat_map(step).map(f32::to_bits).collect()
    };
    let widths = VectorWidth::supported();
    // Which widths are supported depends on the machine.
    println!("supported: {widths:?}");
    let baseline_bits = outputs_with(widths[0]);
    for width in &widths[1..] {
        assert!(
            outputs_with(*width) == baseline_bits,
            "{width:?} differs from {:?}",
            widths[0]
        );
    }
}

#[test]
fn a_step_equals_the_reference_model() {
    let shapes = [
        (4, 16, 2, true, 7),
        (1, 8, 1, true, 1),
        (8, 32, 4, false, 5),
        // The sizes of the two included models.
        (1, 16, 1, false, 9),
        (8, 32, 2, true, 9),
        // Heads wider than a vector, and of a width that is not a multiple of one.
        (3, 40, 2, true, 6),
        (2, 72, 2, true, 3),
    ];
    for (memory, width, heads, attends_to_devices, n) in shapes {
        let shape = ModelShape {
            memory,
            width,
            heads,
            attends_to_devices,
            objective: ModelObjective::Events,
        };
        let tensors = random_tensors(shape);
        let weights = Arc::new(ModelWeights::read(&model_file(shape, &tensors)).expect("a model"));
        let mut forward = ForwardPass::new(weights, n);
        let ttis = random_tokens(n, 11);
        for k in 0..ttis.len() {
            let outputs = forward.step(&ttis[k]).to_vec();
            assert_eq!(outputs.len(), n * OUTPUTS);
            let log_price = f64::from(forward.log_price(0.7));
            let reference = Reference {
                tensors: &tensors,
                shape,
            };
            let (expected_outputs, expected_log_price) = reference.step(&ttis[..=k], n, 0.7);
            for (output, expected) in outputs.iter().zip(&expected_outputs) {
                assert!(
                    (f64::from(*output) - expected).abs() < 1e-4,
                    "{shape:?}, TTI {k}: output {output}, not {expected}"
                );
            }
            assert!(
                (log_price - expected_log_price).abs() < 1e-4,
                "{shape:?}, TTI {k}: log price {log_price}, not {expected_log_price}"
            );
            for shares in forward.attention().chunks(memory) {
                let (attended, unused) = shares.split_at((k + 1).min(memory));
                assert!(
                    (attended.iter().sum::<f32>() - 1.0).abs() < 1e-5 && unused.iter().all(|share| *share == 0.0),
                    "{shape:?}, TTI {k}: {shares:?}"
                );
            }
        }
    }
}

#[test]
fn the_included_models_contain_no_path_of_a_machine() {
    check_for_paths(include_bytes!("../shipped.safetensors"));
    check_for_paths(include_bytes!("../attention.safetensors"));
}

fn check_for_paths(bytes: &[u8]) {
    // A safetensors file: the length of the header in eight bytes, then the header.
    let (length, after_length) = bytes.split_first_chunk().expect("a length");
    let header = &after_length[..u64::from_le_bytes(*length) as usize];
    let text = std::str::from_utf8(header).expect("a text");
    for path in ["\"/", "= \"/", "/tmp", "/home", "/root", "/work", "/Users"] {
        assert!(!text.contains(path), "the header contains {path}");
    }
    // The metadata names the files of the training without their folders.
    assert!(text.contains("teachers.safetensors"));
}

#[test]
fn the_order_of_devices_does_not_matter() {
    let shape = ModelShape::WITH_ATTENTION;
    let weights = Arc::new(ModelWeights::read(&model_file(shape, &random_tensors(shape))).expect("a model"));
    let (mut forward, mut reversed) = (ForwardPass::new(Arc::clone(&weights), 6), ForwardPass::new(weights, 6));
    for tokens in random_tokens(6, 5) {
        let reversed_tokens: Vec<f32> = tokens.chunks(FEATURE_COUNT).rev().flatten().copied().collect();
        let outputs = forward.step(&tokens).to_vec();
        for (a, b) in outputs
            .chunks(OUTPUTS)
            .rev()
            .flatten()
            .zip(reversed.step(&reversed_tokens))
        {
            assert!((a - b).abs() < 1e-5, "output {a}, in reverse order {b}");
        }
    }
}

#[test]
fn invalid_model_files_are_refused() {
    let shape = ModelShape::WITH_ATTENTION;
    let file = model_file(shape, &random_tensors(shape));
    assert!(ModelWeights::read(&file).is_ok());
    for cut in [0, 7, 100, file.len() / 2, file.len() - 1] {
        assert!(
            matches!(ModelWeights::read(&file[..cut]), Err(ModelError::Format(_))),
            "{cut} bytes"
        );
    }
    let error_after = |change: &dyn Fn(&mut Tensors)| {
        let mut tensors = random_tensors(shape);
        change(&mut tensors);
        ModelWeights::read(&model_file(shape, &tensors))
            .expect_err("refused")
            .to_string()
    };
    let missing = error_after(&|tensors| drop(tensors.remove("time.key")));
    assert!(missing.contains("time.key") && missing.contains("missing"), "{missing}");
    let extra = error_after(&|tensors| drop(tensors.insert("more", (vec![1], vec![0.0]))));
    assert!(extra.contains("more"), "{extra}");
    let wrong_size = error_after(&|tensors| drop(tensors.insert("head.bias", (vec![3], vec![0.0; 3]))));
    assert!(
        wrong_size.contains("head.bias") && wrong_size.contains("[3]"),
        "{wrong_size}"
    );
    let not_finite = error_after(&|tensors| tensors.get_mut("embed.bias").expect("a tensor").1[3] = f32::NAN);
    assert!(
        not_finite.contains("embed.bias") && not_finite.contains("not finite"),
        "{not_finite}"
    );
    // Tensors of one shape in a file for another, invalid shapes, and a file of another program.
    let other_shape = ModelShape { memory: 4, ..shape };
    assert!(ModelWeights::read(&model_file(other_shape, &random_tensors(shape))).is_err());
    // A model of version 0.1 with Z = 1 had an attention over that one TTI.
    let single_tti = ModelShape { memory: 1, ..shape };
    let mut former_tensors = random_tensors(single_tti);
    former_tensors.insert("time.norm", (vec![shape.width], vec![1.0; shape.width]));
    let former = ModelWeights::read(&model_file(single_tti, &former_tensors)).expect_err("refused");
    assert!(former.to_string().contains("reveille train dt"), "{former}");
    for width in [0, 6, 260] {
        let invalid_shape = ModelShape { width, ..shape };
        let error = ModelWeights::read(&model_file(invalid_shape, &random_tensors(shape))).expect_err("refused");
        assert!(matches!(error, ModelError::Foreign { key: "shape", .. }), "{error}");
    }
    let data = [0_u8; 4];
    let foreign_tensors = [("x", TensorView::new(Dtype::F32, vec![1], &data).expect("a tensor"))];
    let foreign = safetensors::serialize(foreign_tensors, None).expect("a file");
    assert!(SafeTensors::deserialize(&foreign).is_ok());
    assert!(matches!(ModelWeights::read(&foreign), Err(ModelError::Foreign { .. })));
}
