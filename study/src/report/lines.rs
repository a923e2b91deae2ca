//! The claims in the report, one a line, with a column for each condition.

use super::judge::Verdict;
use crate::claims::{Contradiction, Place};
use crate::figures::results::Condition;

/// The presets that stand first in the report.
pub const PRESETS: [&str; 2] = ["paper", "paper-literal"];

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
    /// How far our figures are from what is stated, to compare settings by: 0 where it is met, infinite where nothing
    /// can be said. See [`super::search`].
    pub off: f64,
}

/// A claim and what became of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// The figure of the paper that it is about.
    pub source: &'static str,
    /// The metric in words.
    pub about: String,
    /// The policy.
    pub policy: String,
    /// The N for which the claim is made.
    pub sites: String,
    /// What the paper says.
    pub paper: String,
    /// Where it says so.
    pub place: Place,
    /// Where it says so again.
    pub again: Option<Place>,
    /// Why it is judged on this metric; empty where there is no other.
    pub judged: &'static str,
    /// How the sentence was read; empty where there is one way.
    pub reading: &'static str,
    /// What else it says that contradicts it.
    pub contradicts: Option<Contradiction>,
    /// Ours, one for each of [`super::Report::columns`].
    pub ours: Vec<Ours>,
}

impl Line {
    /// Whether there are runs for it under some condition.
    pub fn is_run(&self) -> bool {
        self.ours.iter().any(|ours| ours.verdict != Verdict::NotRun)
    }

    /// Where the paper says so, all of it.
    pub fn places(&self) -> String {
        match self.again {
            Some(again) => format!("{}; {again}", self.place),
            None => self.place.to_string(),
        }
    }
}

/// A column: a preset that the tables hold, or another condition of theirs.
#[derive(Clone, Debug)]
pub struct Column<'r> {
    /// What it is.
    pub label: String,
    /// Its runs.
    pub condition: &'r Condition,
}
