//! What is minimised, and how good a net is.
//!
//! Events found by a look are Poisson with mean λ = λ₀·e^m: λ₀ is what is expected without history, m what the net
//! says. Its negative log likelihood is λ − y·m for y events, but for a constant. What a wake-up brings is judged in
//! the same way, which is a quasi-likelihood: it is least where the mean is right. Where the actions of teachers are
//! learned, m are log-odds, and the likelihood is that of what each device did.

use candle_core::{DType, Result, Tensor};

use super::data::Batch;
use super::net::Outputs;
use reveille_bs::policy::dt::model::shape::Objective;

/// Sums over a batch; ratios of them are what is shown.
pub struct Sums {
    /// Negative log likelihood of what looks found, and what was expected of them.
    pub looks: Tensor,
    /// The events that they were expected to find.
    pub expected: f64,
    /// The same of wake-ups, in Ψ.
    pub wakes: Tensor,
    /// What they were expected to bring.
    pub hoped: f64,
    /// Squared errors of ln θ.
    pub prices: Tensor,
    /// TTIs with a price.
    pub priced: f64,
}

fn sum(tensor: &Tensor) -> Result<f64> {
    tensor.sum_all()?.to_dtype(DType::F64)?.to_scalar()
}

/// λ₀(e^m − 1) − y·m, summed: 0 for a net that says nothing.
fn likelihood(expected: &Tensor, found: &Tensor, logs: &Tensor) -> Result<Tensor> {
    ((expected * (logs.exp()? - 1.0)?)? - (found * logs)?)?.sum_all()
}

/// n·ln((1 + e^m)/2) − y·m, summed, of n devices of which y were in S1: 0 for a net that says nothing.
fn cross_entropy(devices: &Tensor, sensing: &Tensor, logs: &Tensor) -> Result<Tensor> {
    let certain = (((logs.exp()? + 1.0)? / 2.0)?.log()? * devices)?;
    (certain - (sensing * logs)?)?.sum_all()
}

impl Sums {
    /// Of what the net makes of `batch`.
    pub fn of(batch: &Batch, outputs: &Outputs) -> Result<Self> {
        let head = |index: usize| outputs.logs.narrow(3, index, 1)?.squeeze(3);
        let error = (&outputs.price - &batch.prices)?.sqr()?;
        let looks = match batch.objective {
            Objective::Events => likelihood,
            Objective::Actions => cross_entropy,
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

    /// The loss: per event expected, per Ψ hoped for, and per TTI with a price, of all the `whole` that this is a part
    /// of.
    pub fn loss(&self, whole: Whole) -> Result<Tensor> {
        let part = |sum: &Tensor, by: f64| sum / by.max(1.0);
        (part(&self.looks, whole.expected)? + (part(&self.wakes, whole.hoped)? + part(&self.prices, whole.priced)?)?)?
            .sum_all()
    }
}

/// What losses are shared out over.
#[derive(Clone, Copy, Debug)]
pub struct Whole {
    /// Events expected.
    pub expected: f64,
    /// What wake-ups were expected to bring.
    pub hoped: f64,
    /// TTIs with a price.
    pub priced: f64,
}

impl Whole {
    /// Of all these batches.
    pub fn of(batches: &[Batch]) -> Result<Self> {
        let all = |of: fn(&Batch) -> &Tensor| batches.iter().map(|batch| sum(of(batch))).sum::<Result<f64>>();
        Ok(Self {
            expected: all(|batch| &batch.expected)?,
            hoped: all(|batch| &batch.wake_expected)?,
            priced: all(|batch| &batch.priced)?,
        })
    }
}

/// How good a net is on what is held out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Score {
    /// Gain in log likelihood per event expected, over expecting nothing but α, nats.
    pub looks: f64,
    /// The same of wake-ups, per Ψ hoped for.
    pub wakes: f64,
    /// Accuracy: how often, of a look that found an event and one that did not, more was expected of the first. A half
    /// is chance.
    pub accuracy: f64,
    /// The same by age and α alone, which is what there is to beat.
    pub plain_accuracy: f64,
    /// Root of the mean squared error of ln θ.
    pub price_error: f64,
}

/// Adds up to a [`Score`].
#[derive(Clone, Debug, Default)]
pub struct Scores {
    looks: f64,
    expected: f64,
    wakes: f64,
    hoped: f64,
    prices: f64,
    priced: f64,
    /// Of each look, what was expected without history and with it, and whether it found anything.
    seen: Vec<(f32, f32, bool)>,
}

impl Scores {
    /// Of what the net makes of `batch`.
    pub fn of(batch: &Batch, outputs: &Outputs) -> Result<Self> {
        let sums = Sums::of(batch, outputs)?;
        let logs = outputs.logs.narrow(3, 0, 1)?.flatten_all()?.to_vec1::<f32>()?;
        let expected = batch.expected.flatten_all()?.to_vec1::<f32>()?;
        let found = batch.found.flatten_all()?.to_vec1::<f32>()?;
        let looks = expected.into_iter().zip(logs).zip(found);
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

    /// Those of one more batch.
    pub fn add(&mut self, more: Self) {
        self.looks += more.looks;
        self.expected += more.expected;
        self.wakes += more.wakes;
        self.hoped += more.hoped;
        self.prices += more.prices;
        self.priced += more.priced;
        self.seen.extend(more.seen);
    }

    /// The score of all of them.
    pub fn score(&self) -> Score {
        Score {
            looks: self.looks / self.expected.max(1e-9),
            wakes: self.wakes / self.hoped.max(1e-9),
            accuracy: accuracy(self.seen.iter().map(|(_, with, found)| (*with, *found))),
            plain_accuracy: accuracy(self.seen.iter().map(|(without, _, found)| (*without, *found))),
            price_error: (self.prices / self.priced.max(1.0)).sqrt(),
        }
    }
}

/// How often one that is found has the larger number than one that is not; equal ones count half. A half if there are
/// none of one kind.
pub fn accuracy(numbers: impl Iterator<Item = (f32, bool)>) -> f64 {
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
