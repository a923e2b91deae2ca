//! What is minimised, and how good a net is.
//!
//! Events found by a look are Poisson with mean λ = λ₀·e^m: λ₀ is what is expected without history, m what the net
//! says. Its negative log likelihood is λ − y·m for y events, but for a constant. What a wake-up brings is judged in
//! the same way, which is a quasi-likelihood: it is least where the mean is right.

use candle_core::{DType, Result, Tensor};

use super::data::Batch;
use super::net::Outputs;

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

impl Sums {
    /// Of what the net makes of `batch`.
    pub fn of(batch: &Batch, outputs: &Outputs) -> Result<Self> {
        let head = |index: usize| outputs.logs.narrow(3, index, 1)?.squeeze(3);
        let error = (&outputs.price - &batch.prices)?.sqr()?;
        Ok(Self {
            looks: likelihood(&batch.expected, &batch.found, &head(0)?)?,
            expected: sum(&batch.expected)?,
            wakes: likelihood(&batch.wake_expected, &batch.wake_brought, &head(1)?)?,
            hoped: sum(&batch.wake_expected)?,
            prices: (error * &batch.priced)?.sum_all()?,
            priced: sum(&batch.priced)?,
        })
    }

    /// The loss: per event expected, per Ψ hoped for, and per TTI with a price.
    pub fn loss(&self) -> Result<Tensor> {
        let part = |sum: &Tensor, by: f64| sum / by.max(1.0);
        (part(&self.looks, self.expected)? + (part(&self.wakes, self.hoped)? + part(&self.prices, self.priced)?)?)?
            .sum_all()
    }
}

/// How good a net is on what is held out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Score {
    /// Gain in log likelihood per event expected, over expecting nothing but α, nats.
    pub looks: f64,
    /// The same of wake-ups, per Ψ hoped for.
    pub wakes: f64,
    /// Root of the mean squared error of ln θ.
    pub price_error: f64,
}

/// Adds up to a [`Score`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Scores {
    looks: f64,
    expected: f64,
    wakes: f64,
    hoped: f64,
    prices: f64,
    priced: f64,
}

impl Scores {
    /// One more batch.
    pub fn add(&mut self, sums: &Sums) -> Result<()> {
        self.looks -= sum(&sums.looks)?;
        self.expected += sums.expected;
        self.wakes -= sum(&sums.wakes)?;
        self.hoped += sums.hoped;
        self.prices += sum(&sums.prices)?;
        self.priced += sums.priced;
        Ok(())
    }

    /// The score of all of them.
    pub fn score(&self) -> Score {
        Score {
            looks: self.looks / self.expected.max(1e-9),
            wakes: self.wakes / self.hoped.max(1e-9),
            price_error: (self.prices / self.priced.max(1.0)).sqrt(),
        }
    }
}
