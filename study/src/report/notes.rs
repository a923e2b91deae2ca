//! Sentences around the tables of the report, shared by its Markdown and its HTML. `VERDICT_RULE` states the rule of
//! `judge`, as does docs/figures-and-report.md: change all three. `reveille report --page docs/reproduction.md` writes
//! the sentences to that page, which is not edited by hand. `page` makes code of the text between backticks, so each
//! sentence has an even number of them.

use super::causes::NOT_RUN;
use super::judge::Verdict;
use super::phrasing::join_names;
use super::{ClaimReport, ClaimRow, REPORT_PRESETS};

/// Rule for the verdicts.
pub(super) const VERDICT_RULE: &str = "A claim is reproduced if our mean is within 5 % of the stated value, in a \
    stated range, or meets a stated bound or order. It is within 20 % if our mean is that close to the value or to the \
    nearer end of the range. A claim for several N or against several policies must hold for each that was run. A \
    value that falls or rises with N may deviate from that by a tenth of its range, and a level value may vary by 20 \
    %. A stated 0 is met by at most 1 % of the largest of the other policies, and such a value is level too. Otherwise \
    its order is reproduced if the policy is above or below every other policy with a stated place as in the paper. A \
    verdict marked ? would differ for some value in our 95 % interval. Where an interval would need more cases, a \
    one-sided 95 % bound replaces it: 3/n without a case in n events, the rule of three. No definition was changed to \
    meet a claim.";

/// A list under a heading, from which `page` makes the anchor of the section.
pub(super) struct HeadedList {
    pub heading: &'static str,
    pub items: Vec<String>,
}

/// Summarises the verdicts, one sentence a column, or one for a report without any.
pub(super) fn summarise_verdicts(report: &ClaimReport<'_>) -> Vec<String> {
    let sentence = |(index, column): (usize, &super::ConditionColumn<'_>)| {
        let count = |verdict| report.count_verdict(index, verdict);
        let judged: usize = report.rows.len() - count(Verdict::NotRun);
        if judged == 0 {
            return format!("{}: no claim could be judged.", column.label);
        }
        format!(
            "{}: {} of {judged} claims reproduced, {} more within 20 %, {} more in their order, {} not reproduced.",
            column.label,
            count(Verdict::Reproduced),
            count(Verdict::Near),
            count(Verdict::OrderReproduced),
            count(Verdict::NotReproduced)
        )
    };
    if report.columns.is_empty() {
        return vec!["No claim could be judged.".to_owned()];
    }
    report.columns.iter().enumerate().map(sentence).collect()
}

/// Describes the number of runs of each column. A second sentence names N if all runs have the same.
pub(super) fn describe_runs(report: &ClaimReport<'_>) -> Vec<String> {
    let sentence = |column: &super::ConditionColumn<'_>| {
        let condition = column.condition;
        let ((least, most), (first, last)) = (condition.runs_per_cell(), condition.seed_range());
        let per_cell = match (least, most) {
            (1, 1) => "1 run".to_owned(),
            (least, most) if least == most => format!("{most} runs"),
            (least, most) => format!("{least} to {most} runs"),
        };
        let device_counts = condition.all_device_counts();
        let only_n = device_counts.first().filter(|_| device_counts.len() == 1);
        let only_n = only_n.map_or_else(String::new, |n| {
            format!(" Claims on several N are judged at N = {n} alone.")
        });
        format!(
            "{}: {per_cell} of {} TTIs for each policy and N, {} in all, seeds {first} to {last}.{only_n}",
            column.label,
            condition.ttis,
            condition.run_count()
        )
    };
    report.columns.iter().map(sentence).collect()
}

/// Describes the missing runs: presets, conditions of the tables, and claims, one sentence each.
pub(super) fn describe_missing_runs(report: &ClaimReport<'_>) -> Vec<String> {
    let mut sentences = Vec::new();
    let missing: Vec<&str> = report.missing_presets().collect();
    if missing.len() == REPORT_PRESETS.len() {
        sentences.push(
            "These tables hold no runs of an unchanged preset; the claims of the paper are about other conditions."
                .to_owned(),
        );
    } else {
        sentences.extend(
            missing
                .iter()
                .map(|preset| format!("No table of preset {preset} was given.")),
        );
    }
    if report.conditions_left_out.count > 0 {
        sentences.push(format!(
            "Left out: {}, on which the paper makes no statement. `reveille report search` judges every condition, and \
             `reveille figures` draws them.",
            report.conditions_left_out.describe()
        ));
    }
    if !report.conditions_without_claims.is_empty() {
        sentences.push(format!(
            "No claim is about the runs of {}.",
            join_names(&report.conditions_without_claims)
        ));
    }
    let rows_without_runs = || report.rows.iter().filter(|row| !row.has_runs());
    let mut policies: Vec<&str> = Vec::new();
    for row in rows_without_runs() {
        // Rows on λ name the policy with its rank: `random, spends least`.
        let policy = row.policy.split(',').next().unwrap_or_default();
        if !policies.contains(&policy) {
            policies.push(policy);
        }
    }
    if !policies.is_empty() {
        let policy_count = |policy: &&str| {
            let count = rows_without_runs()
                .filter(|row| row.policy.split(',').next() == Some(*policy))
                .count();
            format!("{policy} {count}")
        };
        let counts: Vec<String> = policies.iter().map(policy_count).collect();
        sentences.push(format!(
            "Not run and left out below: {} of {} claims ({}).",
            rows_without_runs().count(),
            report.rows.len(),
            counts.join(", ")
        ));
    }
    sentences.extend(explain_missing_verdicts(report));
    sentences
}

/// Explains verdicts that are missing although a policy was run, one sentence for each column and reason: claims on λ
/// without Eq. (5).
fn explain_missing_verdicts(report: &ClaimReport<'_>) -> Vec<String> {
    let mut reasons: Vec<(String, usize)> = Vec::new();
    for row in report.rows.iter().filter(|row| !row.has_runs()) {
        for (column, assessment) in report.columns.iter().zip(&row.assessments) {
            if assessment.explanation == NOT_RUN {
                continue;
            }
            // The count is inserted last: `# claims` is its placeholder until all rows are counted.
            let text = format!("`{}`: # claims: {}", column.label, assessment.explanation);
            match reasons.iter_mut().find(|(known, _)| *known == text) {
                Some((_, count)) => *count += 1,
                None => reasons.push((text, 1)),
            }
        }
    }
    let sentence = |(text, count): (String, usize)| {
        let claims = if count == 1 {
            "1 claim".to_owned()
        } else {
            format!("{count} claims")
        };
        text.replacen("# claims", &claims, 1)
    };
    reasons.into_iter().map(sentence).collect()
}

/// Lists the paper's contradictions, then the interpretations of ambiguous sentences.
pub(super) fn remarks_on_paper(report: &ClaimReport<'_>) -> [HeadedList; 2] {
    let mut contradictions: Vec<String> = Vec::new();
    let mut interpretations: Vec<String> = Vec::new();
    for row in &report.rows {
        if let Some(contradiction) = row.contradicts {
            let item = format!(
                "{}, against {}: {}",
                row.citation, contradiction.other_citation, contradiction.reason
            );
            if !contradictions.contains(&item) {
                contradictions.push(item);
            }
        }
        for (text, item) in [
            (
                row.metric_reason,
                format!(
                    "{}, {}: {}",
                    row.paper_figure, row.metric_description, row.metric_reason
                ),
            ),
            (
                row.interpretation,
                format!("{}: {}", row.citations(), row.interpretation),
            ),
        ] {
            if !text.is_empty() && !interpretations.contains(&item) {
                interpretations.push(item);
            }
        }
    }
    [
        HeadedList {
            heading: "Contradictions in the paper",
            items: contradictions,
        },
        HeadedList {
            heading: "Interpretation of sentences",
            items: interpretations,
        },
    ]
}

/// Describes the origin of the runs, one sentence a table.
pub(super) fn describe_origins(report: &ClaimReport<'_>) -> Vec<String> {
    let sentence = |table: &crate::figures::results::LabelledTable| {
        let metadata = &table.metadata;
        let shard = metadata
            .shard
            .as_ref()
            .map_or_else(String::new, |shard| format!(", shard {shard}"));
        let version = if metadata.version.is_empty() {
            "unknown version"
        } else {
            &metadata.version
        };
        format!(
            "{}: {} runs by Reveille {version}{shard}; SHA-256 of the scenarios of the experiment {}; of the digests \
             of the runs in order {}.",
            table.name, table.run_count, metadata.grid_hash, table.digest_hash
        )
    };
    report.results.tables.iter().map(sentence).collect()
}

/// Formats the cell of a verdict in column `column`, with `?` if it is doubtful. The text needs no escaping.
pub(super) fn verdict_cell(row: &ClaimRow, column: usize) -> String {
    let assessment = &row.assessments[column];
    let doubt = if assessment.is_firm || assessment.verdict == Verdict::NotRun {
        ""
    } else {
        " ?"
    };
    format!("{}{doubt}", assessment.verdict.name())
}
