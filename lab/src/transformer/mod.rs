//! Training of the decision transformer (Sec. V-C): offline, from recorded trajectories alone.

mod checkpoint;
mod data;
mod loss;
mod net;
mod optimiser;

use std::collections::BTreeMap;

use rayon::iter::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use reveille_bs::policy::dt::model::ModelShape;
use reveille_bs::policy::dt::model::weights::{KEY, metadata};
use reveille_common::rng::{Purpose, Stream};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use self::data::{Data, TrainingBatch};
pub use self::loss::EvalScore;
use self::loss::{LossWeights, Scores, Sums};
pub use self::net::{Net, Outputs};
use self::optimiser::{AdamW, ByWeight};
use crate::trajectories::{Chunk, Trajectories};

/// The number of parts of a batch, each drawn separately and computed on a separate thread if available. The result
/// depends on this number, and not on the number of threads.
const PARTS: usize = 4;

/// The parameters of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct DtTrainingConfig {
    /// The shape of the model.
    pub shape: ModelShape,
    /// The number of optimiser steps.
    pub steps: u64,
    /// The approximate number of device-TTIs in a batch.
    pub batch: usize,
    /// The learning rate at the start; it falls to a hundredth along half a cosine.
    pub rate: f64,
    /// The number of steps between two evaluations on held-out data.
    pub every: u64,
    /// The number of evaluations without a better score after which the training ends.
    pub patience: u64,
    /// The seed of weights and batches.
    pub seed: u64,
}

/// The progress of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DtTrainingStatus {
    /// The number of completed steps.
    pub step: u64,
    /// The mean loss since the last evaluation.
    pub loss: f64,
    /// The score on held-out data.
    pub score: EvalScore,
    /// Whether the score is the best so far.
    pub is_best: bool,
}

/// The result of a training.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Trained {
    /// The bytes of the best model's file.
    Model(Vec<u8>),
    /// The bytes of a checkpoint, if the training was stopped between two evaluations.
    Stopped(Vec<u8>),
}

/// A reason why a training cannot start or finish.
#[derive(Debug, thiserror::Error)]
pub enum TransformerError {
    /// Training data or held-out data is missing.
    #[error("{0}")]
    Data(String),
    /// The loss is not finite.
    #[error("the loss is not finite after {0} steps: the training has failed; a lower --rate may help")]
    Diverged(u64),
    /// The framework has failed.
    #[error("the training framework: {0}")]
    Framework(#[from] candle_core::Error),
    /// Weights cannot be written, or a checkpoint cannot be read.
    #[error("{0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The checkpoint is damaged, or belongs to another training.
    #[error("{0}")]
    Checkpoint(String),
}

/// A training between two evaluations on held-out data.
struct State {
    net: Net,
    optimiser: AdamW,
    /// The file of the best model so far.
    best: Option<Vec<u8>>,
    best_loss: f64,
    looks_since: u64,
}

/// Trains a model from `trajectories`. `about` goes into the metadata of its file. `progress` receives each evaluation
/// on the held-out data with the bytes of a checkpoint, and returns whether to continue; `stop` is asked before each
/// step. With a checkpoint as `from` the training resumes, and returns the same bytes as an uninterrupted one.
///
/// # Errors
/// See [`TransformerError`].
pub fn train(
    trajectories: Vec<Trajectories>,
    training: &DtTrainingConfig,
    about: &BTreeMap<String, String>,
    from: Option<&[u8]>,
    progress: &mut dyn FnMut(DtTrainingStatus, &[u8]) -> bool,
    stop: &dyn Fn() -> bool,
) -> Result<Trained, TransformerError> {
    let data = Data::new(trajectories);
    if data.learned_from() == 0 || data.held_out() == 0 {
        return Err(TransformerError::Data(format!(
            "there are {} chunks for training and {} of other runs for evaluation, both needed; record more runs",
            data.learned_from(),
            data.held_out()
        )));
    }
    let mut state = match from {
        Some(bytes) => State::from_checkpoint(bytes, training, about)?,
        None => State::new(training)?,
    };
    let (mut sum, mut count) = (0.0, 0.0);
    while state.optimiser.steps < training.steps && state.looks_since < training.patience {
        // Before the step, not after it: a checkpoint between a step and its evaluation would skip the evaluation.
        if stop() {
            return state.to_checkpoint(training, about).map(Trained::Stopped);
        }
        sum += state.step(&data, training)?;
        count += 1.0;
        let step = state.optimiser.steps;
        if !step.is_multiple_of(training.every) && step != training.steps {
            continue;
        }
        let score = judge(&state.net, &data, training)?;
        // The price head makes no decisions, so it does not choose the best model.
        let held_out = -score.looks - score.wakes;
        if !held_out.is_finite() {
            return Err(TransformerError::Diverged(step));
        }
        let is_best = held_out < state.best_loss;
        if is_best {
            (state.best, state.best_loss) = (Some(file(&state.net, about)?), held_out);
            state.looks_since = 0;
        } else {
            state.looks_since += 1;
        }
        let now = DtTrainingStatus {
            step,
            loss: sum / count,
            score,
            is_best,
        };
        (sum, count) = (0.0, 0.0);
        if !progress(now, &state.to_checkpoint(training, about)?) {
            break;
        }
    }
    state
        .best
        .map_or_else(|| file(&state.net, about), Ok)
        .map(Trained::Model)
}

impl State {
    fn new(training: &DtTrainingConfig) -> Result<Self, TransformerError> {
        let net = Net::new(training.shape, training.seed)?;
        Ok(Self {
            optimiser: AdamW::new(net.vars())?,
            net,
            best: None,
            best_loss: f64::INFINITY,
            looks_since: 0,
        })
    }

    /// Performs one optimiser step and returns the loss before it.
    fn step(&mut self, data: &Data, training: &DtTrainingConfig) -> Result<f64, TransformerError> {
        let step = self.optimiser.steps;
        // A stream for each step: a resumed training draws the same batches. The constant separates it from the streams
        // of the weights.
        let mut stream = Stream::new(training.seed ^ 0xDA7A, Purpose::Training, step);
        let draw = |_| TrainingBatch::of(&data.draw(training.batch / PARTS, &mut stream), training.shape);
        let batches: Vec<TrainingBatch> = (0..PARTS).map(draw).collect::<Result<_, _>>()?;
        let whole = LossWeights::of(&batches)?;
        let part = |batch: &TrainingBatch| -> candle_core::Result<(f64, ByWeight)> {
            let outputs = self.net.forward(&batch.tokens, &batch.targets)?;
            let loss = Sums::of(batch, &outputs)?.loss(whole)?;
            let gradients = loss.backward()?;
            let mut by_weight = ByWeight::new();
            for (name, var) in self.net.vars() {
                // Some operations of the framework have no backward pass and cut off gradients without an error.
                let Some(gradient) = gradients.get(var.as_tensor()) else {
                    candle_core::bail!("no gradient reaches {name}");
                };
                by_weight.insert(name, gradient.clone());
            }
            Ok((f64::from(loss.to_scalar::<f32>()?), by_weight))
        };
        let parts: Vec<(f64, ByWeight)> = batches.par_iter().map(part).collect::<Result<_, _>>()?;
        // Added in the order of the parts: floating-point sums must not depend on the threads.
        let mut parts = parts.into_iter();
        let (mut loss, mut gradients) = parts.next().expect("several parts");
        for (more, others) in parts {
            loss += more;
            for (sum, other) in gradients.values_mut().zip(others.values()) {
                *sum = (&*sum + other)?;
            }
        }
        if !loss.is_finite() {
            return Err(TransformerError::Diverged(step));
        }
        let done = step as f64 / training.steps as f64;
        let rate = training.rate * (0.505 + 0.495 * libm::cos(std::f64::consts::PI * done));
        // The rate rises over the first 50 steps.
        let rate = rate * (0.02 * (step + 1) as f64).min(1.0);
        self.optimiser.step(self.net.vars(), &gradients, rate)?;
        Ok(loss)
    }
}

fn judge(net: &Net, data: &Data, training: &DtTrainingConfig) -> Result<EvalScore, TransformerError> {
    let one = |chunks: Vec<&Chunk>| {
        let batch = TrainingBatch::of(&chunks, training.shape)?;
        Scores::of(&batch, &net.forward(&batch.tokens, &batch.targets)?)
    };
    let batches = data.held_out_batches(training.batch / PARTS);
    let parts: Vec<Scores> = batches.into_par_iter().map(one).collect::<Result<_, _>>()?;
    let mut scores = Scores::default();
    for part in parts {
        scores.add(part);
    }
    Ok(scores.score())
}

/// Returns the bytes of a file with the weights of `net`, with `about` in its metadata.
///
/// # Errors
/// If the framework or the format fails.
pub fn file(net: &Net, about: &BTreeMap<String, String>) -> Result<Vec<u8>, TransformerError> {
    let shape = net.shape();
    let mut values = Vec::new();
    for (name, size) in shape.tensors() {
        let bytes: Vec<u8> = net.values(name)?.into_iter().flat_map(f32::to_le_bytes).collect();
        values.push((name, size, bytes));
    }
    let mut tensors = Vec::new();
    for (name, size, bytes) in &values {
        tensors.push((*name, TensorView::new(Dtype::F32, size.clone(), bytes)?));
    }
    // Only one key: the order of several would be random.
    let metadata = [(KEY.to_owned(), metadata(shape, about))].into_iter().collect();
    Ok(safetensors::serialize(tensors, Some(metadata))?)
}

#[cfg(test)]
mod tests;
