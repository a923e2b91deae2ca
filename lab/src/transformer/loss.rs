//! Loss function and evaluation scores of a net, for [`super::train`]. Trained models depend on the sums and their
//! order.
//!
//! A look is a TTI of a device in S1. Events found by a look are Poisson with mean λ = λ₀·e^m: λ₀ is the expectation
//! without history, m the net's output. The negative log likelihood of y events is λ − y·m, up to a constant. The gain
//! of a wake-up uses the same formula as a quasi-likelihood, which is least at the correct mean. For a net that learns
//! the actions of teachers, m are log-odds, and the likelihood is the probability of each device's action. `expected`
//! then counts devices that could sense, and `found` those that sensed, instead of events.

use candle_core::{DType, Result, Tensor};
use reveille_bs::policy::dt::model::ModelObjective;

use super::data::TrainingBatch;
use super::net::Outputs;

/// Sums over a batch, from which ratios are reported.
pub(super) struct LossSums {
    /// Negative log likelihood of the events found by looks, or of the devices' actions.
    pub look_loss: Tensor,
    /// Expected number of events found by looks, or number of devices that could sense.
    pub expected: f64,
    /// Negative log quasi-likelihood of the gain of wake-ups, in Ψ.
    pub wake_loss: Tensor,
    /// Expected gain of wake-ups, in Ψ.
    pub expected_gain: f64,
    /// Sum of squared errors of ln θ.
    pub squared_price_errors: Tensor,
    /// Number of TTIs with a price.
    pub priced_ttis: f64,
}

fn sum(tensor: &Tensor) -> Result<f64> {
    tensor.sum_all()?.to_dtype(DType::F64)?.to_scalar()
}

/// Sums λ₀(e^m − 1) − y·m, which is 0 for m = 0.
fn negative_log_likelihood(expected: &Tensor, found: &Tensor, logs: &Tensor) -> Result<Tensor> {
    ((expected * (logs.exp()? - 1.0)?)? - (found * logs)?)?.sum_all()
}

/// Sums n·ln((1 + e^m)/2) − y·m over n devices of which y were in S1; this is 0 for m = 0.
fn cross_entropy(devices: &Tensor, sensing: &Tensor, logs: &Tensor) -> Result<Tensor> {
    // The net limits m to ±3, so e^m neither overflows nor vanishes.
    let log_partition = (((logs.exp()? + 1.0)? / 2.0)?.log()? * devices)?;
    (log_partition - (sensing * logs)?)?.sum_all()
}

impl LossSums {
    /// Computes the sums for the net's `outputs` on `batch`.
    pub(super) fn from_outputs(batch: &TrainingBatch, outputs: &Outputs) -> Result<Self> {
        // `OUTPUTS` of the model defines the order: 0 for looks, 1 for wake-ups.
        let head = |index: usize| outputs.logs.narrow(3, index, 1)?.squeeze(3);
        let squared_error = (&outputs.log_price - &batch.log_prices)?.sqr()?;
        let loss_of_looks = match batch.objective {
            ModelObjective::Events => negative_log_likelihood,
            ModelObjective::Actions => cross_entropy,
        };
        // Devices and TTIs that do not count have expectations of 0, which add nothing to a sum.
        Ok(Self {
            look_loss: loss_of_looks(&batch.expected, &batch.found, &head(0)?)?,
            expected: sum(&batch.expected)?,
            wake_loss: negative_log_likelihood(&batch.wake_expected_gain, &batch.wake_gain, &head(1)?)?,
            expected_gain: sum(&batch.wake_expected_gain)?,
            squared_price_errors: (squared_error * &batch.has_price)?.sum_all()?,
            priced_ttis: sum(&batch.has_price)?,
        })
    }

    /// Returns the loss per expected event, per expected Ψ and per TTI with a price. `divisors` are the totals of all
    /// batches of the update.
    pub(super) fn loss(&self, divisors: LossDivisors) -> Result<Tensor> {
        // A batch may have no priced TTI or no wake-up; its sum is then 0.
        let ratio = |sum: &Tensor, divisor: f64| sum / divisor.max(1.0);
        let looks = ratio(&self.look_loss, divisors.expected)?;
        let wakes = ratio(&self.wake_loss, divisors.expected_gain)?;
        (looks + (wakes + ratio(&self.squared_price_errors, divisors.priced_ttis)?)?)?.sum_all()
    }
}

/// The totals over all batches of an update, by which the sums of [`LossSums`] are divided.
#[derive(Clone, Copy, Debug)]
pub(super) struct LossDivisors {
    /// Expected number of events, or number of devices that could sense.
    pub expected: f64,
    /// Expected gain of wake-ups, in Ψ.
    pub expected_gain: f64,
    /// Number of TTIs with a price.
    pub priced_ttis: f64,
}

impl LossDivisors {
    pub(super) fn from_batches(batches: &[TrainingBatch]) -> Result<Self> {
        let total =
            |labels: fn(&TrainingBatch) -> &Tensor| batches.iter().map(|batch| sum(labels(batch))).sum::<Result<f64>>();
        Ok(Self {
            expected: total(|batch| &batch.expected)?,
            expected_gain: total(|batch| &batch.wake_expected_gain)?,
            priced_ttis: total(|batch| &batch.has_price)?,
        })
    }
}

/// The quality of a net on held-out data. For a net that learns actions, an expected event is a device that could
/// sense, a look that found an event is a device that sensed, and a net that expects α alone has even odds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EvalScore {
    /// Gain in log likelihood per expected event over a net that expects α alone, nats.
    pub look_gain: f64,
    /// Gain in log quasi-likelihood of wake-ups per expected Ψ.
    pub wake_gain: f64,
    /// Probability that a look that found an event had a larger expectation than one that did not. Chance is 0.5.
    pub accuracy: f64,
    /// Accuracy of age and α alone, the baseline.
    pub plain_accuracy: f64,
    /// Root mean squared error of ln θ.
    pub price_error: f64,
}

/// Accumulates an [`EvalScore`].
#[derive(Clone, Debug, Default)]
pub(super) struct ScoreSums {
    /// Gain in log likelihood, the negative of [`LossSums::look_loss`].
    look_gain: f64,
    expected: f64,
    /// Gain in log quasi-likelihood, the negative of [`LossSums::wake_loss`].
    wake_gain: f64,
    expected_gain: f64,
    squared_price_errors: f64,
    priced_ttis: f64,
    /// The looks, each with its expectation without and with history, and whether it found an event.
    scored_looks: Vec<(f32, f32, bool)>,
}

impl ScoreSums {
    /// Computes the scores of the net's `outputs` on `batch`.
    pub(super) fn from_outputs(batch: &TrainingBatch, outputs: &Outputs) -> Result<Self> {
        let sums = LossSums::from_outputs(batch, outputs)?;
        let logs = outputs.logs.narrow(3, 0, 1)?.flatten_all()?.to_vec1::<f32>()?;
        let expected = batch.expected.flatten_all()?.to_vec1::<f32>()?;
        let found = batch.found.flatten_all()?.to_vec1::<f32>()?;
        let looks = expected.into_iter().zip(logs).zip(found);
        // 0 marks a device that did not look, or a TTI that does not count.
        let looks = looks.filter(|((expected, _), _)| *expected > 0.0);
        Ok(Self {
            look_gain: -sum(&sums.look_loss)?,
            expected: sums.expected,
            wake_gain: -sum(&sums.wake_loss)?,
            expected_gain: sums.expected_gain,
            squared_price_errors: sum(&sums.squared_price_errors)?,
            priced_ttis: sums.priced_ttis,
            scored_looks: looks
                .map(|((expected, log), found)| (expected, expected * libm::expf(log), found > 0.5))
                .collect(),
        })
    }

    pub(super) fn add(&mut self, other: Self) {
        self.look_gain += other.look_gain;
        self.expected += other.expected;
        self.wake_gain += other.wake_gain;
        self.expected_gain += other.expected_gain;
        self.squared_price_errors += other.squared_price_errors;
        self.priced_ttis += other.priced_ttis;
        self.scored_looks.extend(other.scored_looks);
    }

    pub(super) fn to_score(&self) -> EvalScore {
        EvalScore {
            look_gain: self.look_gain / self.expected.max(1e-9),
            wake_gain: self.wake_gain / self.expected_gain.max(1e-9),
            accuracy: accuracy(
                self.scored_looks
                    .iter()
                    .map(|(_, with_history, found)| (*with_history, *found)),
            ),
            plain_accuracy: accuracy(
                self.scored_looks
                    .iter()
                    .map(|(without_history, _, found)| (*without_history, *found)),
            ),
            price_error: (self.squared_price_errors / self.priced_ttis.max(1.0)).sqrt(),
        }
    }
}

/// Returns the probability that a hit (`true`) has a larger number than a miss. Equal numbers count half. Returns 0.5
/// if either kind is missing.
pub(super) fn accuracy(numbers: impl Iterator<Item = (f32, bool)>) -> f64 {
    let mut numbers: Vec<(f32, bool)> = numbers.collect();
    numbers.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let (mut misses_below, mut ordered_pairs, mut all_hits) = (0.0, 0.0, 0.0);
    for equal_numbers in numbers.chunk_by(|a, b| a.0.to_bits() == b.0.to_bits()) {
        let hits = equal_numbers.iter().filter(|(_, is_hit)| *is_hit).count() as f64;
        let misses = equal_numbers.len() as f64 - hits;
        ordered_pairs += hits * (misses_below + 0.5 * misses);
        all_hits += hits;
        misses_below += misses;
    }
    if all_hits * misses_below > 0.0 {
        ordered_pairs / (all_hits * misses_below)
    } else {
        0.5
    }
}
