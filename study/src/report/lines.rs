//! The claims in the report, one a line, with a column for each condition.

use super::judge::Verdict;
use crate::figures::results::Condition;

/// The presets that the report always has columns for.
pub const PRESETS: [&str; 2] = ["paper", "paper-literal"];

/// Why a preset has no verdicts.
pub(super) const NO_TABLE: &str = "No table of this preset was given.";

/// Our side of a claim under one condition.
#[derive(Clone, Debug, PartialEq)]
pub struct Ours {
    /// What we found, with its 95 % interval; empty without runs.
    pub found: String,
    /// The verdict.
    pub verdict: Verdict,
    /// Whether it holds throughout the interval.
    pub firm: bool,
    /// Why it is not met, as far as that is known; empty where it is met.
    pub why: String,
}

/// A claim and what became of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Where the paper says so.
    pub source: &'static str,
    /// The metric in words.
    pub about: String,
    /// The policy.
    pub policy: String,
    /// The N for which the claim is made.
    pub sites: String,
    /// What the paper says.
    pub paper: String,
    /// Ours, one for each of [`super::Report::columns`].
    pub ours: Vec<Ours>,
}

/// A column: one of [`PRESETS`], or another condition that the tables hold.
#[derive(Clone, Debug)]
pub struct Column<'r> {
    /// What it is.
    pub label: String,
    /// Its runs, if there are any.
    pub condition: Option<&'r Condition>,
}
