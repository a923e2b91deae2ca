//! Tuning of the weights μ1 and μ2 of `q-learning`: tables are trained with a pair of weights, runs with those tables are
//! measured, and the next pair is chosen by what is known so far.
//!
//! ```text
//! Plan ─► design ─► evaluate ─► History (a CSV file, written after every point)
//!            ▲                     │
//!            └──── Proposer ◄──────┘
//! ```
//! Every pair sees the same seeds in training and in evaluation (common random numbers), so that pairs differ in nothing but
//! the weights. A next pair depends on the history alone, so a tuning that was cut short goes on to the same end.
//! The proposer of the program is `bayes::Bayes`, with the cargo feature `tune`.

#[cfg(feature = "tune")]
pub mod bayes;
mod error;
mod evaluation;
mod history;
mod objective;
mod ranges;

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

pub use error::TuningError;
pub use evaluation::{Evaluation, Observer, Plan, evaluation_seed};
pub use history::{History, Point};
pub use objective::Objective;
pub use ranges::{LEAST_DESIGN, Pair, Ranges, design};

/// Chooses the next pair of weights.
pub trait Proposer {
    /// The pair to try next, in `ranges`, after `points`: pairs with the objective of each, at least [`LEAST_DESIGN`].
    ///
    /// # Errors
    /// If none can be found.
    fn propose(&self, ranges: &Ranges, points: &[(Pair, f64)]) -> Result<Pair, TuningError>;
}

/// A tuning, ready to begin or to go on.
#[derive(Debug)]
pub struct Tuner {
    plan: Plan,
    path: PathBuf,
    history: History,
    design: Vec<Pair>,
    torn: bool,
}

impl Tuner {
    /// The tuning of `plan` whose history is the file at `path`. What is in that file already is not evaluated again; with
    /// `force` it is left out.
    ///
    /// # Errors
    /// The file is no history, or that of another tuning.
    pub fn open(plan: Plan, path: &Path, force: bool) -> Result<Self, TuningError> {
        let design = plan.design();
        let header = plan.header();
        let is_new = force || !path.exists();
        let (history, torn) = if is_new {
            (History::new(header), false)
        } else {
            let (found, torn) = History::read(path)?;
            let why = found.differences(&header, &design);
            if !why.is_empty() {
                return Err(TuningError::Foreign {
                    path: path.to_owned(),
                    why: why.join("; "),
                });
            }
            (found, torn)
        };
        Ok(Self {
            plan,
            path: path.to_owned(),
            history,
            design,
            torn,
        })
    }

    /// The points so far.
    pub const fn history(&self) -> &History {
        &self.history
    }

    /// What is tuned.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Whether the file ended in half a line, which was left out.
    pub const fn torn(&self) -> bool {
        self.torn
    }

    /// Pairs still to be evaluated with `iterations` after those of the design.
    pub fn left(&self, iterations: usize) -> usize {
        (self.design.len() + iterations).saturating_sub(self.history.points.len())
    }

    /// Evaluates the design and `iterations` pairs more, on `threads` threads, and writes the history after each. Says
    /// whether it got there: the observer may have stopped it.
    ///
    /// # Errors
    /// A pair cannot be evaluated or proposed, or the history cannot be written.
    pub fn run(
        &mut self,
        iterations: usize,
        threads: usize,
        proposer: &impl Proposer,
        observer: &impl Observer,
    ) -> Result<bool, TuningError> {
        let pool = evaluation::pool(threads)?;
        while self.left(iterations) > 0 {
            let weights = self.next(proposer)?;
            observer.begun(self.history.points.len(), weights);
            let Some(evaluation) = self.plan.evaluate(weights, &pool, observer)? else {
                return Ok(false);
            };
            let point = Point { weights, evaluation };
            self.history.points.push(point);
            self.history.write(&self.path)?;
            observer.point(&point);
        }
        Ok(true)
    }

    /// The pair after those of the history. One that was tried already would tell nothing new: then it is one far from all.
    fn next(&self, proposer: &impl Proposer) -> Result<Pair, TuningError> {
        let number = self.history.points.len();
        if let Some(pair) = self.design.get(number) {
            return Ok(*pair);
        }
        let (ranges, points) = (&self.plan.ranges, self.history.objectives());
        let values = points.iter().map(|(_, value)| *value);
        let is_flat = values.clone().fold(f64::INFINITY, f64::min) >= values.fold(f64::NEG_INFINITY, f64::max);
        let tried: Vec<Pair> = points.iter().map(|(pair, _)| *pair).collect();
        if !is_flat {
            let proposed = ranges.rounded(proposer.propose(ranges, &points)?);
            if !ranges.is_near(proposed, &tried) {
                return Ok(proposed);
            }
        }
        Ok(ranges.farthest(&tried, self.plan.scenario.seed, number as u64))
    }
}
