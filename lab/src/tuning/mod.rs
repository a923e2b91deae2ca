//! Tuning of the weights μ1 and μ2 of `q-learning`: tables are trained with a pair of weights, runs with those tables
//! are measured, and the next pair is chosen by what is known so far.
//!
//! ```text
//! Plan ─► design ─► evaluate ─► History (a CSV file, written after every point)
//!            ▲                     │
//!            └──── Proposer ◄──────┘
//! ```
//! Every pair sees the same seeds in training and in evaluation (common random numbers), so that pairs differ in
//! nothing but the weights. A next pair depends on the history alone, so a tuning that was cut short goes on to the
//! same end. The proposer of the program is `bayes::Bayes`, with the cargo feature `tune`.

#[cfg(feature = "tune")]
pub mod bayes;
mod error;
mod evaluation;
mod history;
mod io;
mod objective;
mod plan;
mod proposer;
mod ranges;
mod tuner;

#[cfg(test)]
mod tests;

pub use error::TuningError;
pub use evaluation::{Evaluation, Point};
pub use history::History;
pub use objective::Objective;
pub use plan::{Plan, TuningProgress, evaluation_seed};
pub use proposer::{Proposer, Surface};
pub use ranges::{LEAST_DESIGN, Pair, Ranges, design};
pub use tuner::Tuner;
