//! Rows of the report, one for each claim, with a column for each condition.

use super::judge::Verdict;
use crate::claims::{Citation, Contradiction};
use crate::figures::results::RunCondition;

/// Presets that come first in the report.
pub const PRESETS: [&str; 2] = ["paper", "paper-literal"];

/// Our result for a claim under one condition.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// Our figure, with its 95 % interval; empty without runs.
    pub found: String,
    /// Verdict on the claim.
    pub verdict: Verdict,
    /// Whether the verdict holds throughout the interval.
    pub firm: bool,
    /// Known cause of an unmet claim; empty if the claim is met.
    pub why: String,
    /// Distance of our figures from the statement, for comparing settings: 0 if the claim is met, infinite if
    /// undefined. See [`super::search`].
    pub off: f64,
}

/// A claim with its results.
#[derive(Clone, Debug, PartialEq)]
pub struct ClaimRow {
    /// Figure of the paper that the claim is about.
    pub source: &'static str,
    /// Description of the metric.
    pub about: String,
    /// The policy.
    pub policy: String,
    /// The N for which the claim is made.
    pub sites: String,
    /// Statement of the paper.
    pub paper: String,
    /// Place of the claim in the paper.
    pub place: Citation,
    /// Second place with the same claim.
    pub again: Option<Citation>,
    /// Reason for the choice of metric; empty without alternatives.
    pub judged: &'static str,
    /// Chosen reading of an ambiguous sentence; empty otherwise.
    pub reading: &'static str,
    /// Contradiction with another statement, if any.
    pub contradicts: Option<Contradiction>,
    /// Our results, one for each of [`super::ClaimReport::columns`].
    pub ours: Vec<Assessment>,
}

impl ClaimRow {
    /// Whether any condition has runs for the claim.
    pub fn is_run(&self) -> bool {
        self.ours.iter().any(|ours| ours.verdict != Verdict::NotRun)
    }

    /// All places of the claim in the paper.
    pub fn places(&self) -> String {
        match self.again {
            Some(again) => format!("{}; {again}", self.place),
            None => self.place.to_string(),
        }
    }
}

/// A column: a preset in the tables, or another condition in them.
#[derive(Clone, Debug)]
pub struct ConditionColumn<'r> {
    /// Name of the condition.
    pub label: String,
    /// Runs of the condition.
    pub condition: &'r RunCondition,
}
