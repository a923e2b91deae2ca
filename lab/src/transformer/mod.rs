//! Training of the decision transformer (Sec. V-C): offline, from recorded trajectories alone.

mod data;
mod loss;
mod net;
mod optimiser;

use std::collections::BTreeMap;

use reveille_bs::policy::dt::model::shape::Shape;
use reveille_bs::policy::dt::model::weights::{KEY, metadata};
use reveille_common::rng::{Purpose, Stream};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use self::data::Data;
pub use self::loss::Score;
use self::loss::{Scores, Sums};
use self::net::Net;
use self::optimiser::AdamW;
use crate::trajectories::Trajectories;

/// How a model is trained.
#[derive(Clone, Debug, PartialEq)]
pub struct Training {
    /// The shape of the model.
    pub shape: Shape,
    /// Steps of the optimiser.
    pub steps: u64,
    /// Device-TTIs of a batch, about.
    pub batch: usize,
    /// The learning rate at the start; it falls to a hundredth by half a cosine.
    pub rate: f64,
    /// Steps between two looks at what is held out.
    pub every: u64,
    /// Looks without a better score after which the training ends.
    pub patience: u64,
    /// The seed of weights and batches.
    pub seed: u64,
}

/// How far a training has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// The loss since the last look.
    pub loss: f64,
    /// The score on what is held out.
    pub score: Score,
    /// Whether it is the best so far.
    pub is_best: bool,
}

/// Why a training could not be begun or finished.
#[derive(Debug, thiserror::Error)]
pub enum TransformerError {
    /// There is nothing to learn from, or to be judged by.
    #[error("{0}")]
    Data(String),
    /// The loss is not a number any more.
    #[error("the loss is not finite after {0} steps: the training has failed; a lower --rate may help")]
    Diverged(u64),
    /// The framework has failed.
    #[error("the training framework: {0}")]
    Framework(#[from] candle_core::Error),
    /// Weights cannot be written.
    #[error("{0}")]
    Format(#[from] safetensors::SafeTensorError),
}

/// Trains a model from `trajectories`. `about` goes into the metadata of its file, whose bytes are given. `progress`
/// hears of each look at what is held out, and says whether to go on.
///
/// # Errors
/// See [`TransformerError`].
pub fn train(
    trajectories: Vec<Trajectories>,
    training: &Training,
    about: &BTreeMap<String, String>,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Vec<u8>, TransformerError> {
    let data = Data::new(trajectories);
    if data.learned_from() == 0 || data.held_out() == 0 {
        return Err(TransformerError::Data(format!(
            "there are {} chunks to learn from and {} of other runs to be judged by: record more runs",
            data.learned_from(),
            data.held_out()
        )));
    }
    let net = Net::new(training.shape, training.seed)?;
    let mut optimiser = AdamW::new(net.vars())?;
    let memory = training.shape.memory;
    let (mut best, mut best_loss, mut looks_since) = (None, f64::INFINITY, 0);
    let (mut sum, mut count) = (0.0, 0.0);
    for step in 0..training.steps {
        let mut stream = Stream::new(training.seed ^ 0xDA7A, Purpose::Training, step);
        let batch = data.draw(training.batch, memory, &mut stream)?;
        let sums = Sums::of(&batch, &net.forward(&batch.tokens, &batch.targets)?)?;
        let loss = sums.loss()?;
        let value = f64::from(loss.to_scalar::<f32>()?);
        if !value.is_finite() {
            return Err(TransformerError::Diverged(step));
        }
        let done = step as f64 / training.steps as f64;
        let rate = training.rate * (0.505 + 0.495 * libm::cos(std::f64::consts::PI * done));
        optimiser.step(
            net.vars(),
            &loss.backward()?,
            rate * (0.02 * (step + 1) as f64).min(1.0),
        )?;
        sum += value;
        count += 1.0;
        if (step + 1).is_multiple_of(training.every) || step + 1 == training.steps {
            let score = judge(&net, &data, training)?;
            let held_out = -score.looks - score.wakes + score.price_error * score.price_error;
            let is_best = held_out < best_loss;
            if is_best {
                (best, best_loss, looks_since) = (Some(file(&net, about)?), held_out, 0);
            } else {
                looks_since += 1;
            }
            let goes_on = progress(Progress {
                step: step + 1,
                loss: sum / count,
                score,
                is_best,
            });
            (sum, count) = (0.0, 0.0);
            if !goes_on || looks_since >= training.patience {
                break;
            }
        }
    }
    best.map_or_else(|| file(&net, about), Ok)
}

fn judge(net: &Net, data: &Data, training: &Training) -> Result<Score, TransformerError> {
    let mut scores = Scores::default();
    for batch in data.held_out_batches(training.batch, training.shape.memory) {
        let batch = batch?;
        scores.add(&Sums::of(&batch, &net.forward(&batch.tokens, &batch.targets)?)?)?;
    }
    Ok(scores.score())
}

/// The bytes of a file of the weights of `net`.
fn file(net: &Net, about: &BTreeMap<String, String>) -> Result<Vec<u8>, TransformerError> {
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
    // One key alone: the order of several would be random.
    let metadata = [(KEY.to_owned(), metadata(shape, about))].into_iter().collect();
    Ok(safetensors::serialize(tensors, Some(metadata))?)
}

#[cfg(test)]
mod tests;
