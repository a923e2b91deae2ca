//! The report: every claim of the paper next to our measurement, with a verdict by a stated rule.
//!
//! [`crate::claims`] holds the paper's claims, and [`mod@judge`] the rule. [`ClaimReport`] applies the rule to merged
//! result tables: a row for each claim, a column for each condition. [`page`] (HTML) and [`markdown`] render it;
//! [`page_sections`] inserts the Markdown into hand-written pages, such as docs/reproduction.md. [`search`] ranks
//! conditions by the same verdicts. `reveille report` writes the files.

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
use self::phrasing::{format_device_counts, format_statement, join_names};
use crate::claims::{Claim, ClaimQuantity, ClaimTopic, TOPICS};
use crate::figures::FigureError;
use crate::figures::results::{Results, RunCondition};

use reveille_lab::series::RANKING;

pub use self::claim_rows::{Assessment, ClaimRow, ConditionColumn, REPORT_PRESETS};

/// The whole report, before rendering.
#[derive(Clone, Debug)]
pub struct ClaimReport<'r> {
    /// Tables that the report is based on.
    pub results: &'r Results,
    /// The columns.
    pub columns: Vec<ConditionColumn<'r>>,
    /// The claims, by figure of the paper. Each row has one assessment by column. [`search`] numbers the rows.
    pub rows: Vec<ClaimRow>,
    /// Names of the conditions in the tables that have no runs for any claim.
    pub conditions_without_claims: Vec<String>,
    /// Conditions of the tables that are not the paper's and have no column.
    pub conditions_left_out: ConditionsLeftOut,
}

/// Conditions that the report leaves out, because the paper makes no statement on them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConditionsLeftOut {
    /// Number of conditions.
    pub count: usize,
    /// Fields that distinguish them, each once; empty if only their tables do.
    pub fields: Vec<String>,
}

impl ConditionsLeftOut {
    fn new(columns: &[ConditionColumn<'_>]) -> Self {
        let paths = columns.iter().flat_map(|column| column.condition.all_changes());
        let mut fields: Vec<String> = Vec::new();
        for (path, _) in paths.filter(|(path, _)| path != RANKING) {
            if !fields.contains(path) {
                fields.push(path.clone());
            }
        }
        Self {
            count: columns.len(),
            fields,
        }
    }

    /// Formats the conditions, of which there are at least two: `3 conditions of events.alpha and harvest.lambda`. The
    /// report, a note and an error contain the text.
    pub fn describe(&self) -> String {
        let fields = if self.fields.is_empty() {
            String::new()
        } else {
            format!(" of {}", join_names(&self.fields))
        };
        format!("{} conditions{fields}", self.count)
    }
}

impl<'r> ClaimReport<'r> {
    /// Judges every claim by the presets in `results` with each of their rankings. A single other condition has a
    /// column too; several are left out, since the paper makes no statement on them.
    ///
    /// # Errors
    /// If the tables hold several conditions and no run of a preset.
    pub fn of_presets(results: &'r Results) -> Result<Self, FigureError> {
        let (presets, others): (Vec<_>, Vec<_>) = select_columns(results).into_iter().partition(|column| {
            let is_reported = REPORT_PRESETS.contains(&column.condition.preset.as_str());
            is_reported && column.condition.is_preset_of_any_ranking()
        });
        if others.len() < 2 {
            return Ok(Self::new(results));
        }
        let conditions_left_out = ConditionsLeftOut::new(&others);
        if presets.is_empty() {
            return Err(FigureError::NoPreset {
                conditions: conditions_left_out.describe(),
            });
        }
        Ok(Self {
            conditions_left_out,
            ..Self::judge_columns(results, presets)
        })
    }

    /// Judges every claim by every condition in `results`.
    pub fn new(results: &'r Results) -> Self {
        Self::judge_columns(results, select_columns(results))
    }

    fn judge_columns(results: &'r Results, columns: Vec<ConditionColumn<'r>>) -> Self {
        let (columns, hidden_columns): (Vec<_>, Vec<_>) = columns.into_iter().partition(|c| is_shown(c));
        let mut rows = Vec::new();
        for topic in TOPICS {
            rows.extend(topic.claims.iter().map(|claim| claim_row(topic, claim, &columns)));
        }
        rows.extend(lambda::claim_rows(&columns));
        Self {
            results,
            columns,
            rows,
            conditions_without_claims: hidden_columns.into_iter().map(|column| column.label).collect(),
            conditions_left_out: ConditionsLeftOut::default(),
        }
    }

    /// Groups the claims that have runs by the paper's figure. Rows of one figure must be neighbours.
    pub fn rows_by_figure(&self) -> Vec<(&'static str, Vec<&ClaimRow>)> {
        let mut groups: Vec<(&'static str, Vec<&ClaimRow>)> = Vec::new();
        for row in self.rows.iter().filter(|row| row.has_runs()) {
            match groups.last_mut() {
                Some((figure, rows)) if *figure == row.paper_figure => rows.push(row),
                Some(_) | None => groups.push((row.paper_figure, vec![row])),
            }
        }
        groups
    }

    /// Iterates over the conditions to draw: those in the columns, with rankings side by side.
    pub fn conditions_to_draw(&self) -> impl Iterator<Item = &'r RunCondition> {
        let is_in_columns = |index: &usize| {
            let ranked = &self.results.by_ranking[*index];
            self.columns.iter().any(|column| std::ptr::eq(column.condition, ranked))
        };
        let all = self.results.conditions.iter();
        all.filter(move |condition| condition.ranking_indices.iter().any(is_in_columns))
    }

    /// Iterates over the presets without a table.
    pub fn missing_presets(&self) -> impl Iterator<Item = &'static str> {
        let is_missing = |preset: &&str| !self.columns.iter().any(|column| column.label == *preset);
        REPORT_PRESETS.into_iter().filter(is_missing)
    }

    /// Iterates over the tables that name their experiment, as table name and experiment text.
    pub fn experiments(&self) -> impl Iterator<Item = (&str, &str)> {
        let tables = self.results.tables.iter();
        let texts = tables.map(|table| (table.name.as_str(), table.metadata.experiment.trim_end()));
        texts.filter(|(_, text)| !text.is_empty())
    }

    /// Formats the number of claims with `verdict` in column `column`, and the number of doubtful ones among them with
    /// the sign `?` that `notes::verdict_cell` adds to their verdicts.
    ///
    /// # Panics
    /// If the report has no such column.
    pub fn tally_text(&self, column: usize, verdict: Verdict) -> String {
        let is_doubtful =
            |row: &&ClaimRow| row.assessments[column].verdict == verdict && !row.assessments[column].is_firm;
        let count = self.count_verdict(column, verdict);
        match self.rows.iter().filter(is_doubtful).count() {
            0 => count.to_string(),
            doubtful => format!("{count}, of which {doubtful} ?"),
        }
    }

    /// Counts the claims with `verdict` in column `column`, doubtful or not.
    ///
    /// # Panics
    /// If the report has no such column.
    pub fn count_verdict(&self, column: usize, verdict: Verdict) -> usize {
        self.rows
            .iter()
            .filter(|row| row.assessments[column].verdict == verdict)
            .count()
    }
}

/// Counts the claims for which `condition` has runs.
fn count_claims_with_runs(condition: &RunCondition) -> usize {
    let claims = TOPICS.iter().flat_map(|topic| topic.claims);
    let has_runs = |claim: &&Claim| {
        condition
            .device_counts(claim.policy)
            .into_iter()
            .any(|n| claim.device_counts.contains(n))
    };
    claims.filter(has_runs).count()
}

/// Whether a column is shown: a preset always, any other condition if it has runs for some claim.
fn is_shown(column: &ConditionColumn<'_>) -> bool {
    let is_judged = |(topic, claim)| judge(topic, claim, column.condition).verdict != Verdict::NotRun;
    let claims = TOPICS
        .iter()
        .flat_map(|topic| topic.claims.iter().map(move |claim| (topic, claim)));
    REPORT_PRESETS.contains(&column.label.as_str())
        || claims.into_iter().any(is_judged)
        || lambda::has_claims_on(column.condition)
}

/// Selects the columns: first the presets, then all other conditions. For a preset, the condition that covers most
/// claims is chosen, then the one with most runs, then the longest.
fn select_columns(results: &Results) -> Vec<ConditionColumn<'_>> {
    let mut columns: Vec<ConditionColumn<'_>> = Vec::new();
    for preset in REPORT_PRESETS {
        let candidates = results
            .by_ranking
            .iter()
            .filter(|condition| condition.is_unchanged_preset() && condition.preset == preset);
        // A preset has one column, but tables may hold runs of it with several lengths.
        let best_covered = candidates.max_by_key(|c| (count_claims_with_runs(c), c.run_count(), c.ttis));
        columns.extend(best_covered.map(|condition| ConditionColumn {
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

fn claim_row(topic: &'static ClaimTopic, claim: &Claim, columns: &[ConditionColumn<'_>]) -> ClaimRow {
    ClaimRow {
        paper_figure: topic.paper_figure,
        metric_description: topic.metric_description.to_owned(),
        policy: claim.policy.to_owned(),
        device_counts: format_device_counts(claim.device_counts),
        stated: format_statement(claim),
        citation: claim.citation,
        second_citation: claim.second_citation,
        metric_reason: topic.metric_reason,
        interpretation: claim.interpretation,
        contradicts: claim.contradicts,
        assessments: columns
            .iter()
            .map(|column| assess(topic, claim, column.condition))
            .collect(),
    }
}

fn assess(topic: &ClaimTopic, claim: &Claim, condition: &RunCondition) -> Assessment {
    let judgement = judge(topic, claim, condition);
    let mut measured = finding_text::describe_findings(claim, &judgement.findings);
    if let (ClaimQuantity::Gap(other), false) = (claim.quantity, measured.is_empty()) {
        measured = format!("gap to {other}: {measured}");
    }
    Assessment {
        measured,
        verdict: judgement.verdict,
        is_firm: judgement.is_firm,
        explanation: causes::explain(topic, claim, &judgement, condition),
        deviation: distance::deviation(claim, &judgement.findings),
    }
}

#[cfg(test)]
mod tests;
