//! Training of the decision transformer (Sec. V-C): offline, from recorded trajectories alone. `reveille train dt`
//! calls [`train`]; its output is a weights file that the policy `dt` loads. The benchmark `lab/benches/dt.rs` uses
//! [`Net`] and [`encode_file`].
//!
//! [`Net`] is a differentiable copy of the forward pass in `bs/src/policy/dt/model`: change both. The result
//! depends on the data, the options and the seed, not on the number of threads or on interruptions.

mod checkpoint;
mod data;
mod loss;
mod net;
mod optimiser;

use std::collections::BTreeMap;

use rayon::iter::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use reveille_bs::policy::dt::model::ModelShape;
use reveille_bs::policy::dt::model::weights::{METADATA_KEY, encode_metadata};
use reveille_common::digits::count_noun;
use reveille_common::rng::{Purpose, Stream};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use self::data::{Dataset, TrainingBatch};
pub use self::loss::EvalScore;
use self::loss::{LossDivisors, LossSums, ScoreSums};
pub use self::net::{Net, Outputs};
use self::optimiser::{AdamW, TensorByName};
use crate::trajectories::{Chunk, Trajectories};

/// The number of parts of a batch, each drawn separately and computed on a separate thread if available. The result
/// depends on this number, and not on the number of threads.
const BATCH_PARTS: usize = 4;

/// The parameters of a training. [`DtTrainingConfig::to_json`] identifies a training in its checkpoints.
#[derive(Clone, Debug, PartialEq)]
pub struct DtTrainingConfig {
    /// The shape of the model, which must be valid ([`ModelShape::is_valid`]).
    pub shape: ModelShape,
    /// The number of optimiser steps.
    pub steps: u64,
    /// The approximate number of device-TTIs in a batch.
    pub batch_device_ttis: usize,
    /// The largest learning rate. Half a cosine over all steps reduces it to a hundredth; in the first 50 steps, it
    /// also rises linearly from a fiftieth.
    pub learning_rate: f64,
    /// The number of steps between two evaluations on held-out data.
    pub evaluation_interval: u64,
    /// The number of evaluations without a better score after which the training ends.
    pub patience: u64,
    /// The seed of weights and batches.
    pub seed: u64,
}

impl DtTrainingConfig {
    /// Returns the parameters as JSON. The text is part of checkpoints and of the metadata of models: its keys must not
    /// follow a renamed field, and with a new key no older checkpoint can be resumed.
    pub fn to_json(&self) -> String {
        // In full, so that a new field cannot be forgotten.
        let Self {
            shape,
            steps,
            batch_device_ttis,
            learning_rate,
            evaluation_interval,
            patience,
            seed,
        } = self;
        let ModelShape {
            memory,
            width,
            heads,
            attends_to_devices,
            objective,
        } = shape;
        // In alphabetical order, with which serde_json writes the same text whether or not it preserves the order.
        serde_json::json!({
            "batch": batch_device_ttis,
            "every": evaluation_interval,
            "patience": patience,
            "rate": learning_rate,
            "seed": seed,
            "shape": {
                "attends_to_devices": attends_to_devices,
                "heads": heads,
                "memory": memory,
                "objective": objective.name(),
                "width": width,
            },
            "steps": steps,
        })
        .to_string()
    }
}

/// The progress of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DtTrainingStatus {
    /// The number of completed steps.
    pub step: u64,
    /// The mean training loss since the last evaluation, or since the training was resumed.
    pub loss: f64,
    /// The score on held-out data.
    pub score: EvalScore,
    /// Whether the score is the best so far.
    pub is_best: bool,
}

/// The result of a training.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Trained {
    /// The bytes of the best model's file, at the end or once `progress` has ended the training.
    Model(Vec<u8>),
    /// The bytes of a checkpoint, if `stop` has ended the training.
    Stopped(Vec<u8>),
}

/// A reason why a training cannot start or finish.
#[derive(Debug, thiserror::Error)]
pub enum TransformerError {
    /// Training data or held-out data is missing.
    #[error("{0}")]
    Data(String),
    /// The loss is not finite.
    #[error(
        "the loss is not finite after {}: the training has failed; a lower --rate may help",
        count_noun(*.0, "step")
    )]
    Diverged(u64),
    /// The framework has failed.
    #[error("the training framework failed: {0}")]
    Framework(#[from] candle_core::Error),
    /// Weights cannot be written, or a checkpoint cannot be read.
    #[error("{0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The checkpoint is damaged, has another format version, or belongs to another training.
    #[error("{0}")]
    Checkpoint(String),
}

/// The state of a training. A checkpoint holds all of it.
struct TrainerState {
    net: Net,
    optimiser: AdamW,
    /// The bytes of the best model's file so far; `None` before the first evaluation.
    best_file: Option<Vec<u8>>,
    /// The held-out loss of the best model.
    best_loss: f64,
    evaluations_since_best: u64,
}

/// Trains a model from `trajectories`. `model_info` goes into the metadata of its file. `progress` receives each
/// evaluation on the held-out data with the bytes of a checkpoint, and returns whether to continue; `stop` is asked
/// before each step. With a `checkpoint` the training resumes, and returns the same bytes as an uninterrupted one.
///
/// # Errors
/// See [`TransformerError`].
pub fn train(
    trajectories: Vec<Trajectories>,
    config: &DtTrainingConfig,
    model_info: &BTreeMap<String, String>,
    checkpoint: Option<&[u8]>,
    progress: &mut dyn FnMut(DtTrainingStatus, &[u8]) -> bool,
    stop: &dyn Fn() -> bool,
) -> Result<Trained, TransformerError> {
    let data = Dataset::new(trajectories);
    if data.training_chunk_count() == 0 || data.held_out_chunk_count() == 0 {
        return Err(TransformerError::Data(format!(
            "there are {} chunks for training and {} of other runs for evaluation, both needed; record more runs",
            data.training_chunk_count(),
            data.held_out_chunk_count()
        )));
    }
    let mut state = match checkpoint {
        Some(bytes) => TrainerState::from_checkpoint(bytes, config, model_info)?,
        None => TrainerState::new(config)?,
    };
    let (mut loss_sum, mut step_count) = (0.0, 0.0);
    while state.optimiser.steps < config.steps && state.evaluations_since_best < config.patience {
        // Before the step, not after it: a checkpoint between a step and its evaluation would skip the evaluation.
        if stop() {
            return state.to_checkpoint(config, model_info).map(Trained::Stopped);
        }
        loss_sum += state.step(&data, config)?;
        step_count += 1.0;
        let step = state.optimiser.steps;
        if !step.is_multiple_of(config.evaluation_interval) && step != config.steps {
            continue;
        }
        let score = evaluate(&state.net, &data, config)?;
        // The price head makes no decisions, so it does not choose the best model.
        let held_out_loss = -score.look_gain - score.wake_gain;
        if !held_out_loss.is_finite() {
            return Err(TransformerError::Diverged(step));
        }
        let is_best = held_out_loss < state.best_loss;
        if is_best {
            (state.best_file, state.best_loss) = (Some(encode_file(&state.net, model_info)?), held_out_loss);
            state.evaluations_since_best = 0;
        } else {
            state.evaluations_since_best += 1;
        }
        let status = DtTrainingStatus {
            step,
            loss: loss_sum / step_count,
            score,
            is_best,
        };
        (loss_sum, step_count) = (0.0, 0.0);
        if !progress(status, &state.to_checkpoint(config, model_info)?) {
            break;
        }
    }
    state
        .best_file
        .map_or_else(|| encode_file(&state.net, model_info), Ok)
        .map(Trained::Model)
}

impl TrainerState {
    fn new(config: &DtTrainingConfig) -> Result<Self, TransformerError> {
        let net = Net::new(config.shape, config.seed)?;
        Ok(Self {
            optimiser: AdamW::new(net.vars())?,
            net,
            best_file: None,
            best_loss: f64::INFINITY,
            evaluations_since_best: 0,
        })
    }

    /// Performs one optimiser step and returns the loss before it.
    fn step(&mut self, data: &Dataset, config: &DtTrainingConfig) -> Result<f64, TransformerError> {
        let step = self.optimiser.steps;
        // A stream for each step: a resumed training draws the same batches. The constant separates it from the streams
        // of the weights.
        let mut stream = Stream::new(config.seed ^ 0xDA7A, Purpose::Training, step);
        let draw = |_| {
            let chunks = data.draw(config.batch_device_ttis / BATCH_PARTS, &mut stream);
            TrainingBatch::from_chunks(&chunks, config.shape)
        };
        let batches: Vec<TrainingBatch> = (0..BATCH_PARTS).map(draw).collect::<Result<_, _>>()?;
        let divisors = LossDivisors::from_batches(&batches)?;
        let loss_of_part = |batch: &TrainingBatch| -> candle_core::Result<(f64, TensorByName)> {
            let outputs = self.net.forward(&batch.tokens, &batch.targets)?;
            let loss = LossSums::from_outputs(batch, &outputs)?.loss(divisors)?;
            let gradients = loss.backward()?;
            let mut gradient_by_weight = TensorByName::new();
            for (name, var) in self.net.vars() {
                // Some operations of the framework have no backward pass and cut off gradients without an error.
                let Some(gradient) = gradients.get(var.as_tensor()) else {
                    candle_core::bail!("no gradient reaches {name}");
                };
                gradient_by_weight.insert(name, gradient.clone());
            }
            Ok((f64::from(loss.to_scalar::<f32>()?), gradient_by_weight))
        };
        let parts: Vec<(f64, TensorByName)> = batches.par_iter().map(loss_of_part).collect::<Result<_, _>>()?;
        // Added in the order of the parts: floating-point sums must not depend on the threads.
        let mut parts = parts.into_iter();
        let (mut loss, mut gradients) = parts.next().expect("several parts");
        for (part_loss, part_gradients) in parts {
            loss += part_loss;
            for (sum, other) in gradients.values_mut().zip(part_gradients.values()) {
                *sum = (&*sum + other)?;
            }
        }
        if !loss.is_finite() {
            return Err(TransformerError::Diverged(step));
        }
        let done_share = step as f64 / config.steps as f64;
        let rate = config.learning_rate * (0.505 + 0.495 * libm::cos(std::f64::consts::PI * done_share));
        // The rate rises over the first 50 steps.
        let rate = rate * (0.02 * (step + 1) as f64).min(1.0);
        self.optimiser.step(self.net.vars(), &gradients, rate)?;
        Ok(loss)
    }
}

/// Returns the score of `net` on the held-out chunks of `data`.
fn evaluate(net: &Net, data: &Dataset, config: &DtTrainingConfig) -> Result<EvalScore, TransformerError> {
    let score_batch = |chunks: Vec<&Chunk>| {
        let batch = TrainingBatch::from_chunks(&chunks, config.shape)?;
        ScoreSums::from_outputs(&batch, &net.forward(&batch.tokens, &batch.targets)?)
    };
    let batches = data.held_out_batches(config.batch_device_ttis / BATCH_PARTS);
    let parts: Vec<ScoreSums> = batches.into_par_iter().map(score_batch).collect::<Result<_, _>>()?;
    // Added in the order of the batches: floating-point sums must not depend on the threads.
    let mut sums = ScoreSums::default();
    for part in parts {
        sums.add(part);
    }
    Ok(sums.to_score())
}

/// Returns the bytes of a file with the weights of `net`, with `model_info` in its metadata.
///
/// # Errors
/// If the framework or the format fails.
pub fn encode_file(net: &Net, model_info: &BTreeMap<String, String>) -> Result<Vec<u8>, TransformerError> {
    let shape = net.shape();
    let mut tensors = Vec::new();
    for (name, tensor_shape) in shape.tensors() {
        let bytes: Vec<u8> = net.values(name)?.into_iter().flat_map(f32::to_le_bytes).collect();
        tensors.push((name, tensor_shape, bytes));
    }
    let mut views = Vec::new();
    for (name, tensor_shape, bytes) in &tensors {
        views.push((*name, TensorView::new(Dtype::F32, tensor_shape.clone(), bytes)?));
    }
    // Only one key: the order of several would be random.
    let metadata = [(METADATA_KEY.to_owned(), encode_metadata(shape, model_info))]
        .into_iter()
        .collect();
    Ok(safetensors::serialize(views, Some(metadata))?)
}

#[cfg(test)]
mod tests;
