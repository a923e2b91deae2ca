//! A tuning from its design to its end.

use std::path::{Path, PathBuf};

use super::error::TuningError;
use super::evaluation::Point;
use super::history::History;
use super::plan::{Plan, TuningProgress, pool};
use super::proposer::Proposer;
use super::ranges::Pair;

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
    /// The tuning of `plan` whose history is the file at `path`. What is in that file already is not evaluated again;
    /// with `force` it is left out.
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
        observer: &impl TuningProgress,
    ) -> Result<bool, TuningError> {
        let pool = pool(threads)?;
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

    /// The pair after those of the history. One that was tried already would tell nothing new: then it is one far from
    /// all.
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
