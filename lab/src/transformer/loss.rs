//! Loss function and evaluation scores of a net.
//!
//! Events found by a look are Poisson with mean λ = λ₀·e^m: λ₀ is the expectation without history, m the net's output.
//! The negative log likelihood of y events is λ − y·m, up to a constant. The gain of a wake-up uses the same formula as
//! a quasi-likelihood, which is least at the correct mean. For a net that learns the actions of teachers, m are
//! log-odds. The likelihood is then the one of each device's action.

use candle_core::{DType, Result, Tensor};
use reveille_bs::policy::dt::model::ModelObjective;

use super::data::TrainingBatch;
use super::net::Outputs;

/// Sums over a batch, from which ratios are reported.
pub(super) struct Sums {
    /// Negative log likelihood of the events found by looks.
    pub looks: Tensor,
    /// Expected number of events found by looks.
    pub expected: f64,
    /// Negative log quasi-likelihood of the gain of wake-ups, in Ψ.
    pub wakes: Tensor,
    /// Expected gain of wake-ups, in Ψ.
    pub hoped: f64,
    /// Sum of squared errors of ln θ.
    pub prices: Tensor,
    /// Number of TTIs with a price.
    pub priced: f64,
}

fn sum(tensor: &Tensor) -> Result<f64> {
    tensor.sum_all()?.to_dtype(DType::F64)?.to_scalar()
}

/// Sums λ₀(e^m − 1) − y·m, which is 0 for m = 0.
fn likelihood(expected: &Tensor, found: &Tensor, logs: &Tensor) -> Result<Tensor> {
    ((expected * (logs.exp()? - 1.0)?)? - (found * logs)?)?.sum_all()
}

/// Sums n·ln((1 + e^m)/2) − y·m over n devices of which y were in S1; this is 0 for m = 0.
fn cross_entropy(devices: &Tensor, sensing: &Tensor, logs: &Tensor) -> Result<Tensor> {
    // The net limits m to ±3, so e^m neither overflows nor vanishes.
    let certain = (((logs.exp()? + 1.0)? / 2.0)?.log()? * devices)?;
    (certain - (sensing * logs)?)?.sum_all()
}

impl Sums {
    /// Computes the sums for the net's `outputs` on `batch`.
    pub(super) fn of(batch: &TrainingBatch, outputs: &Outputs) -> Result<Self> {
        let head = |index: usize| outputs.logs.narrow(3, index, 1)?.squeeze(3);
        let error = (&outputs.price - &batch.prices)?.sqr()?;
        let looks = match batch.objective {
            ModelObjective::Events => likelihood,
            ModelObjective::Actions => cross_entropy,
        };
        Ok(Self {
            looks: looks(&batch.expected, &batch.found, &head(0)?)?,
            expected: sum(&batch.expected)?,
            wakes: likelihood(&batch.wake_expected, &batch.wake_brought, &head(1)?)?,
            hoped: sum(&batch.wake_expected)?,
            prices: (error * &batch.priced)?.sum_all()?,
            priced: sum(&batch.priced)?,
        })
    }

    /// Returns the loss per expected event, per expected Ψ and per TTI with a price. The divisors are the totals
    /// `whole` of all batches of the update.
    pub(super) fn loss(&self, whole: LossWeights) -> Result<Tensor> {
        // A batch may have no priced TTI or no wake-up; its sum is then 0.
        let part = |sum: &Tensor, by: f64| sum / by.max(1.0);
        (part(&self.looks, whole.expected)? + (part(&self.wakes, whole.hoped)? + part(&self.prices, whole.priced)?)?)?
            .sum_all()
    }
}

/// The divisors of the three parts of a loss.
#[derive(Clone, Copy, Debug)]
pub(super) struct LossWeights {
    /// Expected number of events.
    pub expected: f64,
    /// Expected gain of wake-ups, in Ψ.
    pub hoped: f64,
    /// Number of TTIs with a price.
    pub priced: f64,
}

impl LossWeights {
    /// Computes the divisors over all `batches`.
    pub(super) fn of(batches: &[TrainingBatch]) -> Result<Self> {
        let all = |of: fn(&TrainingBatch) -> &Tensor| batches.iter().map(|batch| sum(of(batch))).sum::<Result<f64>>();
        Ok(Self {
            expected: all(|batch| &batch.expected)?,
            hoped: all(|batch| &batch.wake_expected)?,
            priced: all(|batch| &batch.priced)?,
        })
    }
}

/// The quality of a net on held-out data.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EvalScore {
    /// Gain in log likelihood per expected event over a net that expects α alone, nats.
    pub looks: f64,
    /// Gain in log quasi-likelihood of wake-ups per expected Ψ.
    pub wakes: f64,
    /// Probability that a look that found an event had a larger expectation than one that did not. Chance is 0.5.
    pub accuracy: f64,
    /// Accuracy of age and α alone, the baseline.
    pub plain_accuracy: f64,
    /// Root mean squared error of ln θ.
    pub price_error: f64,
}

/// Accumulates an [`EvalScore`].
#[derive(Clone, Debug, Default)]
pub(super) struct Scores {
    looks: f64,
    expected: f64,
    wakes: f64,
    hoped: f64,
    prices: f64,
    priced: f64,
    /// The looks, each with its expectation without and with history, and whether it found an event.
    seen: Vec<(f32, f32, bool)>,
}

impl Scores {
    /// Computes the scores of the net's `outputs` on `batch`.
    pub(super) fn of(batch: &TrainingBatch, outputs: &Outputs) -> Result<Self> {
        let sums = Sums::of(batch, outputs)?;
        let logs = outputs.logs.narrow(3, 0, 1)?.flatten_all()?.to_vec1::<f32>()?;
        let expected = batch.expected.flatten_all()?.to_vec1::<f32>()?;
        let found = batch.found.flatten_all()?.to_vec1::<f32>()?;
        let looks = expected.into_iter().zip(logs).zip(found);
        // 0 marks a device that did not look, or a TTI that does not count.
        let looks = looks.filter(|((expected, _), _)| *expected > 0.0);
        Ok(Self {
            looks: -sum(&sums.looks)?,
            expected: sums.expected,
            wakes: -sum(&sums.wakes)?,
            hoped: sums.hoped,
            prices: sum(&sums.prices)?,
            priced: sums.priced,
            seen: looks
                .map(|((expected, log), found)| (expected, expected * libm::expf(log), found > 0.5))
                .collect(),
        })
    }

    /// Adds the scores of another batch.
    pub(super) fn add(&mut self, more: Self) {
        self.looks += more.looks;
        self.expected += more.expected;
        self.wakes += more.wakes;
        self.hoped += more.hoped;
        self.prices += more.prices;
        self.priced += more.priced;
        self.seen.extend(more.seen);
    }

    /// Returns the score over all batches.
    pub(super) fn score(&self) -> EvalScore {
        EvalScore {
            looks: self.looks / self.expected.max(1e-9),
            wakes: self.wakes / self.hoped.max(1e-9),
            accuracy: accuracy(self.seen.iter().map(|(_, with, found)| (*with, *found))),
            plain_accuracy: accuracy(self.seen.iter().map(|(without, _, found)| (*without, *found))),
            price_error: (self.prices / self.priced.max(1.0)).sqrt(),
        }
    }
}

/// Returns the probability that a found item has a larger number than one that is not found. Equal numbers count half.
/// Returns 0.5 if either kind is missing.
pub(super) fn accuracy(numbers: impl Iterator<Item = (f32, bool)>) -> f64 {
    let mut numbers: Vec<(f32, bool)> = numbers.collect();
    numbers.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let (mut below, mut pairs, mut found) = (0.0, 0.0, 0.0);
    for same in numbers.chunk_by(|a, b| a.0.to_bits() == b.0.to_bits()) {
        let hits = same.iter().filter(|(_, found)| *found).count() as f64;
        let misses = same.len() as f64 - hits;
        pairs += hits * (below + 0.5 * misses);
        found += hits;
        below += misses;
    }
    if found * below > 0.0 {
        pairs / (found * below)
    } else {
        0.5
    }
}
