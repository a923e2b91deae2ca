//! Training of the decision transformer (Sec. V-C): offline, from recorded trajectories alone.

mod checkpoint;
mod data;
mod loss;
mod net;
mod optimiser;

use std::collections::BTreeMap;

use rayon::iter::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use reveille_bs::policy::dt::model::shape::Shape;
use reveille_bs::policy::dt::model::weights::{KEY, metadata};
use reveille_common::rng::{Purpose, Stream};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use self::data::{Batch, Data};
pub use self::loss::Score;
use self::loss::{Scores, Sums, Whole};
pub use self::net::{Net, Outputs};
use self::optimiser::{AdamW, ByWeight};
use crate::trajectories::{Chunk, Trajectories};

/// Parts of a batch, each drawn for itself and computed on a thread of its own if there is one. What is learned depends
/// on how many there are, and not on the threads.
const PARTS: usize = 4;

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
    /// Weights cannot be written, or a checkpoint not be read.
    #[error("{0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The checkpoint is damaged, or of another training.
    #[error("{0}")]
    Checkpoint(String),
}

/// A training, between two looks at what is held out.
struct State {
    net: Net,
    optimiser: AdamW,
    /// The file of the best model so far.
    best: Option<Vec<u8>>,
    best_loss: f64,
    looks_since: u64,
}

/// Trains a model from `trajectories`. `about` goes into the metadata of its file, whose bytes are given. `progress`
/// hears of each look at what is held out, gets the bytes of a checkpoint, and says whether to go on. With such a
/// checkpoint as `from` a training goes on, and gives the same bytes as one that was never cut short.
///
/// # Errors
/// See [`TransformerError`].
pub fn train(
    trajectories: Vec<Trajectories>,
    training: &Training,
    about: &BTreeMap<String, String>,
    from: Option<&[u8]>,
    progress: &mut dyn FnMut(Progress, &[u8]) -> bool,
) -> Result<Vec<u8>, TransformerError> {
    let data = Data::new(trajectories);
    if data.learned_from() == 0 || data.held_out() == 0 {
        return Err(TransformerError::Data(format!(
            "there are {} chunks to learn from and {} of other runs to be judged by: record more runs",
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
        sum += state.step(&data, training)?;
        count += 1.0;
        let step = state.optimiser.steps;
        if !step.is_multiple_of(training.every) && step != training.steps {
            continue;
        }
        let score = judge(&state.net, &data, training)?;
        // The head of the price is a reading of the rest and decides nothing.
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
        let now = Progress {
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
    state.best.map_or_else(|| file(&state.net, about), Ok)
}

impl State {
    fn new(training: &Training) -> Result<Self, TransformerError> {
        let net = Net::new(training.shape, training.seed)?;
        Ok(Self {
            optimiser: AdamW::new(net.vars())?,
            net,
            best: None,
            best_loss: f64::INFINITY,
            looks_since: 0,
        })
    }

    /// One step of the optimiser; gives the loss before it.
    fn step(&mut self, data: &Data, training: &Training) -> Result<f64, TransformerError> {
        let step = self.optimiser.steps;
        let mut stream = Stream::new(training.seed ^ 0xDA7A, Purpose::Training, step);
        let draw = |_| Batch::of(&data.draw(training.batch / PARTS, &mut stream), training.shape);
        let batches: Vec<Batch> = (0..PARTS).map(draw).collect::<Result<_, _>>()?;
        let whole = Whole::of(&batches)?;
        let part = |batch: &Batch| -> candle_core::Result<(f64, ByWeight)> {
            let outputs = self.net.forward(&batch.tokens, &batch.targets)?;
            let loss = Sums::of(batch, &outputs)?.loss(whole)?;
            let gradients = loss.backward()?;
            let mut by_weight = ByWeight::new();
            for (name, var) in self.net.vars() {
                let Some(gradient) = gradients.get(var.as_tensor()) else {
                    candle_core::bail!("no gradient reaches {name}");
                };
                by_weight.insert(name, gradient.clone());
            }
            Ok((f64::from(loss.to_scalar::<f32>()?), by_weight))
        };
        let parts: Vec<(f64, ByWeight)> = batches.par_iter().map(part).collect::<Result<_, _>>()?;
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
        let rate = rate * (0.02 * (step + 1) as f64).min(1.0);
        self.optimiser.step(self.net.vars(), &gradients, rate)?;
        Ok(loss)
    }
}

fn judge(net: &Net, data: &Data, training: &Training) -> Result<Score, TransformerError> {
    let one = |chunks: Vec<&Chunk>| {
        let batch = Batch::of(&chunks, training.shape)?;
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

/// The bytes of a file of the weights of `net`, with `about` in its metadata.
///
/// # Errors
/// The framework or the format has failed.
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
    // One key alone: the order of several would be random.
    let metadata = [(KEY.to_owned(), metadata(shape, about))].into_iter().collect();
    Ok(safetensors::serialize(tensors, Some(metadata))?)
}

#[cfg(test)]
mod tests;
