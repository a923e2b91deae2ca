//! Tuning of the weights μ1 and μ2 of `q-learning`. Each step trains tables with a pair of weights, measures runs with
//! those tables, and chooses the next pair from all results so far.
//!
//! ```text
//! TuningPlan ─► design ─► evaluate ─► History (a CSV file, written after every point)
//!                            ▲            │
//!                            └─ Proposer ◄┘
//! ```
//! Every pair uses the same seeds in training and in evaluation (common random numbers), so that pairs only differ in
//! the weights. The next pair depends on the plan and the history alone, so a resumed tuning reaches the same result.
//! If a proposal repeats a known pair, [`Tuner`] takes a pair far from all others instead. The program's proposer is
//! `bayes::Bayes`, with the cargo feature `tune`. `reveille tune` runs all of this, and `study` draws the history.
//! Start with [`TuningPlan`] and [`Tuner`].

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

/// Chooses the next pair of weights. The choice must be the same for the same arguments, on every machine and in every
/// process.
pub trait Proposer {
    /// Returns the pair to try next, in `ranges`, after `points`: pairs with their objectives, in order of evaluation,
    /// at least [`MIN_DESIGN_PAIRS`] and not all with the same objective.
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
