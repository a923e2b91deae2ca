//! A tuning from its design to its end: evaluates pair after pair, and writes the history after each, so that a killed
//! tuning resumes. `reveille tune` runs it.
//!
//! The choice of a pair must depend on the plan and the history alone, so that a resumed tuning equals an uninterrupted
//! one. [`Tuner::open`] refuses a history with another header or design, but does not detect another rule for later
//! pairs.

use std::path::{Path, PathBuf};

use super::Proposer;
use super::error::TuningError;
use super::evaluation::TuningPoint;
use super::history::History;
use super::plan::{TuningPlan, TuningProgress, new_pool};
use super::ranges::WeightPair;
use crate::io::{read, replace};

/// A tuning that can start or resume.
#[derive(Debug)]
pub struct Tuner {
    plan: TuningPlan,
    /// The history file.
    path: PathBuf,
    history: History,
    /// The first pairs to try, which the first points of the history must have.
    design: Vec<WeightPair>,
    /// Whether the last line of the history file was incomplete.
    is_torn: bool,
}

impl Tuner {
    /// Opens the tuning of `plan`, which [`TuningPlan::check`] has accepted, with the history file at `path`. Points in
    /// that file are not evaluated again. With `force` the first new point replaces the file.
    ///
    /// # Errors
    /// If the file cannot be read, is not a history, or belongs to another tuning.
    pub fn open(plan: TuningPlan, path: &Path, force: bool) -> Result<Self, TuningError> {
        let design = plan.design();
        let header = plan.header();
        let is_new = force || !path.exists();
        let (history, is_torn) = if is_new {
            (History::new(header), false)
        } else {
            let (saved, is_torn) = History::read(path)?;
            let differences = saved.differences(&header, &design);
            if !differences.is_empty() {
                return Err(TuningError::OtherTuning {
                    path: path.to_owned(),
                    differences: differences.join("; "),
                });
            }
            (saved, is_torn)
        };
        Ok(Self {
            plan,
            path: path.to_owned(),
            history,
            design,
            is_torn,
        })
    }

    /// The points so far.
    pub const fn history(&self) -> &History {
        &self.history
    }

    /// The plan of the tuning.
    pub const fn plan(&self) -> &TuningPlan {
        &self.plan
    }

    /// Whether the file ended in an incomplete line, which was dropped.
    pub const fn is_torn(&self) -> bool {
        self.is_torn
    }

    /// The number of pairs to evaluate, with `iterations` pairs after the design.
    pub fn pairs_left(&self, iterations: usize) -> usize {
        (self.design.len() + iterations).saturating_sub(self.history.points.len())
    }

    /// Evaluates the design and `iterations` more pairs on `threads` threads, and writes the history after each pair.
    /// Skips pairs in the history. Returns `false` if the observer has stopped it.
    ///
    /// # Errors
    /// If a pair cannot be evaluated or proposed, or the history cannot be written.
    pub fn run(
        &mut self,
        iterations: usize,
        threads: usize,
        proposer: &impl Proposer,
        observer: &impl TuningProgress,
    ) -> Result<bool, TuningError> {
        let pool = new_pool(threads)?;
        while self.pairs_left(iterations) > 0 {
            let weights = self.choose_next(proposer)?;
            observer.begun(self.history.points.len(), weights);
            let Some(evaluation) = self.plan.evaluate(weights, &pool, observer)? else {
                return Ok(false);
            };
            let point = TuningPoint { weights, evaluation };
            self.history.points.push(point);
            // After each point: a killed tuning only loses the point in progress.
            self.history.write(&self.path)?;
            observer.point(&point);
        }
        Ok(true)
    }

    /// Returns the next pair. If the proposal repeats a known pair, or all objectives are equal, it returns a pair far
    /// from all others instead.
    fn choose_next(&self, proposer: &impl Proposer) -> Result<WeightPair, TuningError> {
        let point_number = self.history.points.len();
        if let Some(pair) = self.design.get(point_number) {
            return Ok(*pair);
        }
        let (ranges, pairs_with_objectives) = (&self.plan.ranges, self.history.objectives());
        let objectives = pairs_with_objectives.iter().map(|(_, objective)| *objective);
        // Equal objectives give no direction for better ones.
        let is_flat = objectives.clone().fold(f64::INFINITY, f64::min) >= objectives.fold(f64::NEG_INFINITY, f64::max);
        let tried_pairs: Vec<WeightPair> = pairs_with_objectives.iter().map(|(pair, _)| *pair).collect();
        if !is_flat {
            let proposed = ranges.rounded(proposer.propose(ranges, &pairs_with_objectives)?);
            if !ranges.is_close_to_any(proposed, &tried_pairs) {
                return Ok(proposed);
            }
        }
        Ok(ranges.draw_farthest(&tried_pairs, self.plan.scenario.run.seed, point_number as u64))
    }
}

impl History {
    /// Reads the history in the file at `path`, also for `reveille tune --picture-only`. Also returns whether an
    /// incomplete last line was dropped.
    ///
    /// # Errors
    /// If the file cannot be read or is not a history.
    pub fn read(path: &Path) -> Result<(Self, bool), TuningError> {
        let bytes = read(path).map_err(|error| TuningError::Read {
            path: path.to_owned(),
            error,
        })?;
        let parsed = String::from_utf8(bytes).map_err(|_| "it is not UTF-8 text".to_owned());
        parsed
            .and_then(|text| Self::parse(&text))
            .map_err(|reason| TuningError::NotAHistory {
                path: path.to_owned(),
                reason,
            })
    }

    /// Writes the history to the file at `path`, in one step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TuningError> {
        replace(path, self.to_csv().as_bytes()).map_err(|error| TuningError::Write {
            path: path.to_owned(),
            error,
        })
    }
}
