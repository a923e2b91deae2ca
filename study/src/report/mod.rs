//! The report: every claim of the paper beside what the lab measured, with a verdict by a stated rule.
//!
//! [`crate::claims`] is what the paper says, [`mod@judge`] the rule, [`Report`] both applied to result tables; [`page`]
//! and [`markdown`] write it down.

mod found;
pub mod judge;
mod lambda;
mod lines;
pub mod markdown;
mod off;
pub mod page;
pub mod parts;
mod remarks;
pub mod search;
mod why;
mod words;

use self::judge::{Verdict, judge};
use self::words::{relation, sites};
use crate::claims::{Claim, Quantity, TOPICS, Topic};
use crate::figures::results::{Condition, Results};

pub use self::lines::{Column, Line, Ours, PRESETS};

/// The whole report, before it is a page.
#[derive(Clone, Debug)]
pub struct Report<'r> {
    /// The tables behind it.
    pub results: &'r Results,
    /// The columns.
    pub columns: Vec<Column<'r>>,
    /// The claims, by figure of the paper.
    pub lines: Vec<Line>,
    /// Conditions of the tables that have no run for any claim, in words.
    pub silent: Vec<String>,
}

impl<'r> Report<'r> {
    /// Judges every claim by `results`.
    pub fn new(results: &'r Results) -> Self {
        let all = columns(results);
        let (columns, silent): (Vec<_>, Vec<_>) = all.into_iter().partition(|c| is_shown(c));
        let mut lines = Vec::new();
        for topic in TOPICS {
            lines.extend(topic.claims.iter().map(|claim| line(topic, claim, &columns)));
        }
        lines.extend(lambda::lines(&columns));
        Self {
            results,
            columns,
            lines,
            silent: silent.into_iter().map(|column| column.label).collect(),
        }
    }

    /// The claims that there are runs for, by the figures that they are about.
    pub fn sections(&self) -> Vec<(&'static str, Vec<&Line>)> {
        let mut sections: Vec<(&'static str, Vec<&Line>)> = Vec::new();
        for line in self.lines.iter().filter(|line| line.is_run()) {
            match sections.last_mut() {
                Some((source, lines)) if *source == line.source => lines.push(line),
                Some(_) | None => sections.push((line.source, vec![line])),
            }
        }
        sections
    }

    /// The conditions to draw: those that columns are of, with rankings side by side.
    pub fn drawn(&self) -> impl Iterator<Item = &'r Condition> {
        let of_column = |part: &usize| {
            let own = &self.results.by_ranking[*part];
            self.columns.iter().any(|column| std::ptr::eq(column.condition, own))
        };
        let all = self.results.conditions.iter();
        all.filter(move |condition| condition.parts.iter().any(of_column))
    }

    /// The presets of which there is no table.
    pub fn missing(&self) -> impl Iterator<Item = &'static str> {
        let is_missing = |preset: &&str| !self.columns.iter().any(|column| column.label == *preset);
        PRESETS.into_iter().filter(is_missing)
    }

    /// The tables that say which experiment they belong to, by name, with its text.
    pub fn experiments(&self) -> impl Iterator<Item = (&str, &str)> {
        let all = self.results.sources.iter();
        let texts = all.map(|source| (source.name.as_str(), source.about.experiment.trim_end()));
        texts.filter(|(_, text)| !text.is_empty())
    }

    /// How many claims have `verdict` in column `column`, in words, with those that are in doubt.
    pub fn tally(&self, column: usize, verdict: Verdict) -> String {
        let is_doubtful = |line: &&Line| line.ours[column].verdict == verdict && !line.ours[column].firm;
        let count = self.count(column, verdict);
        match self.lines.iter().filter(is_doubtful).count() {
            0 => count.to_string(),
            doubtful => format!("{count}, of which {doubtful} ?"),
        }
    }

    /// How many claims have `verdict` in column `column`, in doubt or not.
    pub fn count(&self, column: usize, verdict: Verdict) -> usize {
        self.lines
            .iter()
            .filter(|line| line.ours[column].verdict == verdict)
            .count()
    }
}

/// How many claims `condition` has runs for.
fn covered(condition: &Condition) -> usize {
    let claims = TOPICS.iter().flat_map(|topic| topic.claims);
    let is_run = |claim: &&Claim| condition.sizes(claim.policy).into_iter().any(|n| claim.sites.holds(n));
    claims.filter(is_run).count()
}

/// Whether a column has a verdict: of a preset always, of other conditions if some claim has runs.
fn is_shown(column: &Column<'_>) -> bool {
    let is_judged = |(topic, claim)| judge(topic, claim, column.condition).verdict != Verdict::NotRun;
    let claims = TOPICS
        .iter()
        .flat_map(|topic| topic.claims.iter().map(move |claim| (topic, claim)));
    PRESETS.contains(&column.label.as_str()) || claims.into_iter().any(is_judged) || lambda::concerns(column.condition)
}

/// The presets' columns, each of the condition with most claims covered, then most runs, then the longest; then all
/// others.
fn columns(results: &Results) -> Vec<Column<'_>> {
    let mut columns: Vec<Column<'_>> = Vec::new();
    for preset in PRESETS {
        let own = results.by_ranking.iter().filter(|s| s.is_plain() && s.preset == preset);
        let widest = own.max_by_key(|s| (covered(s), s.run_count(), s.ttis));
        columns.extend(widest.map(|condition| Column {
            label: preset.to_owned(),
            condition,
        }));
    }
    for condition in &results.by_ranking {
        if !columns.iter().any(|column| std::ptr::eq(column.condition, condition)) {
            columns.push(Column {
                label: format!("{}, K = {}", condition.label(), condition.ttis),
                condition,
            });
        }
    }
    columns
}

fn line(topic: &'static Topic, claim: &Claim, columns: &[Column<'_>]) -> Line {
    Line {
        source: topic.source,
        about: topic.about.to_owned(),
        policy: claim.policy.to_owned(),
        sites: sites(claim.sites),
        paper: relation(claim),
        place: claim.place,
        again: claim.again,
        judged: topic.reading,
        reading: claim.reading,
        contradicts: claim.contradicts,
        ours: columns
            .iter()
            .map(|column| ours(topic, claim, column.condition))
            .collect(),
    }
}

fn ours(topic: &Topic, claim: &Claim, condition: &Condition) -> Ours {
    let judgement = judge(topic, claim, condition);
    let mut found = found::found(claim, &judgement.findings);
    if let (Quantity::Gap(other), false) = (claim.quantity, found.is_empty()) {
        found = format!("gap to {other}: {found}");
    }
    Ours {
        found,
        verdict: judgement.verdict,
        firm: judgement.firm,
        why: why::why(topic, claim, &judgement, condition),
        off: off::off(claim, &judgement.findings),
    }
}

#[cfg(test)]
mod tests;
