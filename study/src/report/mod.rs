//! The report: every claim of the paper beside what the lab measured, with a verdict by a stated rule.
//!
//! [`crate::claims`] is what the paper says, [`mod@judge`] the rule, [`Report`] both applied to result tables; [`page`]
//! and [`markdown`] write it down.

pub mod judge;
mod lambda;
mod lines;
pub mod markdown;
pub mod page;
mod why;
mod words;

use self::judge::{Verdict, judge};
use self::lines::NO_TABLE;
use self::words::{number, relation};
use crate::claims::{Claim, Sites, TOPICS, Topic};
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
}

impl<'r> Report<'r> {
    /// Judges every claim by `results`.
    pub fn new(results: &'r Results) -> Self {
        let columns = columns(results);
        let mut lines = Vec::new();
        for topic in TOPICS {
            lines.extend(topic.claims.iter().map(|claim| line(topic, claim, &columns)));
        }
        lines.extend(lambda::lines(&columns));
        Self {
            results,
            columns,
            lines,
        }
    }

    /// The claims by where the paper makes them.
    pub fn sections(&self) -> impl Iterator<Item = (&'static str, &[Line])> {
        let sections = self.lines.chunk_by(|a, b| a.source == b.source);
        sections.map(|lines| (lines[0].source, lines))
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

/// The presets' columns, each of the condition with most claims covered, then most runs, then the longest; then all
/// others.
fn columns(results: &Results) -> Vec<Column<'_>> {
    let mut columns: Vec<Column<'_>> = Vec::new();
    for preset in PRESETS {
        let own = results.conditions.iter().filter(|s| s.is_plain() && s.preset == preset);
        columns.push(Column {
            label: preset.to_owned(),
            condition: own.max_by_key(|s| (covered(s), s.run_count(), s.ttis)),
        });
    }
    for condition in &results.conditions {
        let is_shown = columns
            .iter()
            .any(|c| c.condition.is_some_and(|s| std::ptr::eq(s, condition)));
        if !is_shown {
            columns.push(Column {
                label: format!("{}, K = {}", condition.label(), condition.ttis),
                condition: Some(condition),
            });
        }
    }
    columns
}

fn line(topic: &'static Topic, claim: &Claim, columns: &[Column<'_>]) -> Line {
    let ours = |column: &Column<'_>| match column.condition {
        Some(condition) => ours(topic, claim, condition),
        None => Ours {
            found: String::new(),
            verdict: Verdict::NotRun,
            firm: true,
            why: NO_TABLE.to_owned(),
        },
    };
    Line {
        source: topic.source,
        about: topic.about.to_owned(),
        policy: claim.policy.to_owned(),
        sites: match claim.sites {
            Sites::At(n) => format!("N = {n}"),
            Sites::Under(n) => format!("N < {n}"),
            Sites::Everywhere => "all N".to_owned(),
        },
        paper: relation(claim.relation),
        ours: columns.iter().map(ours).collect(),
    }
}

fn ours(topic: &Topic, claim: &Claim, condition: &Condition) -> Ours {
    let judgement = judge(topic, claim, condition);
    let findings = &judgement.findings;
    let least = findings.iter().min_by(|a, b| a.value.total_cmp(&b.value));
    let most = findings.iter().max_by(|a, b| a.value.total_cmp(&b.value));
    let found = match (least, most) {
        (Some(only), Some(_)) if findings.len() == 1 => words::found(claim.relation, only),
        (Some(least), Some(most)) => format!(
            "{} (N = {}) to {} (N = {})",
            number(least.value),
            least.n,
            number(most.value),
            most.n
        ),
        (None, _) | (_, None) => String::new(),
    };
    Ours {
        found,
        verdict: judgement.verdict,
        firm: judgement.firm,
        why: why::why(topic, claim, &judgement, condition),
    }
}

#[cfg(test)]
mod tests;
