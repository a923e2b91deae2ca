//! Tuning of the weights μ1 and μ2 of `q-learning`. Each step trains tables with a pair of weights, measures runs with
//! those tables, and chooses the next pair from all results so far.
//!
//! ```text
//! Plan ─► design ─► evaluate ─► History (a CSV file, written after every point)
//!            ▲                     │
//!            └──── Proposer ◄──────┘
//! ```
//! Every pair uses the same seeds in training and in evaluation (common random numbers), so that pairs only differ in
//! the weights. The next pair depends on the history alone, so a resumed tuning reaches the same result. The program's
//! proposer is `bayes::Bayes`, with the cargo feature `tune`. Start with [`TuningPlan`] and [`Tuner`].

#[cfg(feature = "tune")]
pub mod bayes;
mod error;
mod evaluation;
mod history;
mod objective;
mod plan;
mod ranges;
mod tuner;

pub use error::TuningError;
pub use evaluation::{Evaluation, TuningPoint};
pub use history::History;
pub use objective::TuningObjective;
pub use plan::{TuningPlan, TuningProgress};
pub use ranges::{MIN_DESIGN_PAIRS, Ranges, WeightPair, design};
pub use tuner::Tuner;

/// Chooses the next pair of weights.
pub trait Proposer {
    /// Returns the pair to try next, in `ranges`, after `points`: pairs with their objectives, at least
    /// [`MIN_DESIGN_PAIRS`].
    ///
    /// # Errors
    /// If no pair can be found.
    fn propose(&self, ranges: &Ranges, points: &[(WeightPair, f64)]) -> Result<WeightPair, TuningError>;
}

/// Values over ranges of weights.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// Values at the centres of equal cells of the logarithms, in ascending μ2; each row in ascending μ1.
    pub rows: Vec<Vec<f64>>,
}

#[cfg(test)]
mod tests;
