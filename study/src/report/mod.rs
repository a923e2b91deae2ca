//! The report: every claim of the paper next to our measurement, with a verdict by a stated rule.
//!
//! [`crate::claims`] holds the paper's claims and [`mod@judge`] the rule. [`ClaimReport`] applies the rule to result
//! tables; [`page`] and [`markdown`] render it.

mod causes;
mod claim_rows;
mod distance;
mod finding_text;
pub mod judge;
mod lambda;
pub mod markdown;
mod notes;
pub mod page;
pub mod page_sections;
mod phrasing;
pub mod search;

use self::judge::{Verdict, judge};
use self::phrasing::{relation, sites};
use crate::claims::{Claim, ClaimQuantity, ClaimTopic, TOPICS};
use crate::figures::results::{Results, RunCondition};

pub use self::claim_rows::{Assessment, ClaimRow, ConditionColumn, PRESETS};

/// The whole report, before rendering.
#[derive(Clone, Debug)]
pub struct ClaimReport<'r> {
    /// Tables that the report is based on.
    pub results: &'r Results,
    /// The columns.
    pub columns: Vec<ConditionColumn<'r>>,
    /// The claims, by figure of the paper.
    pub lines: Vec<ClaimRow>,
    /// Names of the conditions in the tables that have no runs for any claim.
    pub silent: Vec<String>,
}

impl<'r> ClaimReport<'r> {
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

    /// Groups the claims that have runs by the paper's figure.
    pub fn sections(&self) -> Vec<(&'static str, Vec<&ClaimRow>)> {
        let mut sections: Vec<(&'static str, Vec<&ClaimRow>)> = Vec::new();
        for line in self.lines.iter().filter(|line| line.is_run()) {
            match sections.last_mut() {
                Some((source, lines)) if *source == line.source => lines.push(line),
                Some(_) | None => sections.push((line.source, vec![line])),
            }
        }
        sections
    }

    /// Iterates over the conditions to draw: those in the columns, with rankings side by side.
    pub fn drawn(&self) -> impl Iterator<Item = &'r RunCondition> {
        let of_column = |part: &usize| {
            let own = &self.results.by_ranking[*part];
            self.columns.iter().any(|column| std::ptr::eq(column.condition, own))
        };
        let all = self.results.conditions.iter();
        all.filter(move |condition| condition.parts.iter().any(of_column))
    }

    /// Iterates over the presets without a table.
    pub fn missing(&self) -> impl Iterator<Item = &'static str> {
        let is_missing = |preset: &&str| !self.columns.iter().any(|column| column.label == *preset);
        PRESETS.into_iter().filter(is_missing)
    }

    /// Iterates over the tables that name their experiment, as table name and experiment text.
    pub fn experiments(&self) -> impl Iterator<Item = (&str, &str)> {
        let all = self.results.sources.iter();
        let texts = all.map(|source| (source.name.as_str(), source.about.experiment.trim_end()));
        texts.filter(|(_, text)| !text.is_empty())
    }

    /// Formats the number of claims with `verdict` in column `column`, and the number of doubtful ones among them.
    pub fn tally(&self, column: usize, verdict: Verdict) -> String {
        let is_doubtful = |line: &&ClaimRow| line.ours[column].verdict == verdict && !line.ours[column].firm;
        let count = self.count(column, verdict);
        match self.lines.iter().filter(is_doubtful).count() {
            0 => count.to_string(),
            doubtful => format!("{count}, of which {doubtful} ?"),
        }
    }

    /// Counts the claims with `verdict` in column `column`, doubtful or not.
    pub fn count(&self, column: usize, verdict: Verdict) -> usize {
        self.lines
            .iter()
            .filter(|line| line.ours[column].verdict == verdict)
            .count()
    }
}

/// Counts the claims for which `condition` has runs.
fn covered(condition: &RunCondition) -> usize {
    let claims = TOPICS.iter().flat_map(|topic| topic.claims);
    let is_run = |claim: &&Claim| condition.sizes(claim.policy).into_iter().any(|n| claim.sites.holds(n));
    claims.filter(is_run).count()
}

/// Whether a column is shown: a preset always, any other condition if it has runs for some claim.
fn is_shown(column: &ConditionColumn<'_>) -> bool {
    let is_judged = |(topic, claim)| judge(topic, claim, column.condition).verdict != Verdict::NotRun;
    let claims = TOPICS
        .iter()
        .flat_map(|topic| topic.claims.iter().map(move |claim| (topic, claim)));
    PRESETS.contains(&column.label.as_str()) || claims.into_iter().any(is_judged) || lambda::concerns(column.condition)
}

/// Selects the columns: first the presets, then all other conditions. For a preset, the condition that covers most
/// claims is chosen, then the one with most runs, then the longest.
fn columns(results: &Results) -> Vec<ConditionColumn<'_>> {
    let mut columns: Vec<ConditionColumn<'_>> = Vec::new();
    for preset in PRESETS {
        let own = results.by_ranking.iter().filter(|s| s.is_plain() && s.preset == preset);
        // A preset has one column, but tables may hold runs of it with several lengths.
        let widest = own.max_by_key(|s| (covered(s), s.run_count(), s.ttis));
        columns.extend(widest.map(|condition| ConditionColumn {
            label: preset.to_owned(),
            condition,
        }));
    }
    for condition in &results.by_ranking {
        if !columns.iter().any(|column| std::ptr::eq(column.condition, condition)) {
            columns.push(ConditionColumn {
                label: format!("{}, K = {}", condition.label(), condition.ttis),
                condition,
            });
        }
    }
    columns
}

fn line(topic: &'static ClaimTopic, claim: &Claim, columns: &[ConditionColumn<'_>]) -> ClaimRow {
    ClaimRow {
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

fn ours(topic: &ClaimTopic, claim: &Claim, condition: &RunCondition) -> Assessment {
    let judgement = judge(topic, claim, condition);
    let mut found = finding_text::found(claim, &judgement.findings);
    if let (ClaimQuantity::Gap(other), false) = (claim.quantity, found.is_empty()) {
        found = format!("gap to {other}: {found}");
    }
    Assessment {
        found,
        verdict: judgement.verdict,
        firm: judgement.firm,
        why: causes::why(topic, claim, &judgement, condition),
        off: distance::off(claim, &judgement.findings),
    }
}

#[cfg(test)]
mod tests;
