//! Rows and columns of a [`super::ClaimReport`]: a row for each claim, with an assessment for each condition. [`super`]
//! and `lambda` make them; [`super::markdown`], [`super::page`] and [`super::search`] show them.

use super::judge::Verdict;
use crate::claims::{Citation, Contradiction};
use crate::figures::results::RunCondition;

/// Presets that come first in the report, in the order of their columns. They must be names of presets, which no test
/// checks.
pub const REPORT_PRESETS: [&str; 2] = ["paper", "paper-literal"];

/// Our result for a claim under one condition.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// Our value of the claim's quantity, with its 95 % interval; empty without runs.
    pub measured: String,
    /// Verdict on the claim.
    pub verdict: Verdict,
    /// Whether the verdict holds throughout the interval.
    pub is_firm: bool,
    /// Explanation of an unmet or doubtful verdict, and of missing runs; empty otherwise. `notes` compares it with
    /// `causes::NOT_RUN`.
    pub explanation: String,
    /// Deviation of our findings from the statement, for comparing conditions that do not meet the claim; infinite if
    /// undefined. A claim that is met within a tolerance may have a small deviation. See [`super::search`].
    pub deviation: f64,
}

/// A claim with its results.
#[derive(Clone, Debug, PartialEq)]
pub struct ClaimRow {
    /// Figure of the paper that the claim is about. Neighbouring rows with one figure form a table.
    pub paper_figure: &'static str,
    /// Description of the metric.
    pub metric_description: String,
    /// The policy; for a claim on λ with its rank, `random, spends least`. `notes` reads the policy up to the comma.
    pub policy: String,
    /// The N for which the claim is made.
    pub device_counts: String,
    /// Statement of the paper, as text.
    pub stated: String,
    /// Place of the claim in the paper.
    pub citation: Citation,
    /// Second place with the same claim.
    pub second_citation: Option<Citation>,
    /// Reason for the choice of metric; empty without alternatives.
    pub metric_reason: &'static str,
    /// Chosen reading of an ambiguous sentence; empty otherwise.
    pub interpretation: &'static str,
    /// Contradiction with another statement, if any.
    pub contradicts: Option<Contradiction>,
    /// Our results, one for each of [`super::ClaimReport::columns`].
    pub assessments: Vec<Assessment>,
}

impl ClaimRow {
    /// Whether any condition has runs for the claim.
    pub fn has_runs(&self) -> bool {
        self.assessments
            .iter()
            .any(|assessment| assessment.verdict != Verdict::NotRun)
    }

    /// All places of the claim in the paper, as text.
    pub fn citations(&self) -> String {
        match self.second_citation {
            Some(second) => format!("{}; {second}", self.citation),
            None => self.citation.to_string(),
        }
    }
}

/// A column: a preset in the tables, or another condition in them.
#[derive(Clone, Debug)]
pub struct ConditionColumn<'r> {
    /// Name of the condition. The column of an unchanged preset has the preset's name, by which [`REPORT_PRESETS`] are
    /// recognised.
    pub label: String,
    /// Runs of the condition.
    pub condition: &'r RunCondition,
}
