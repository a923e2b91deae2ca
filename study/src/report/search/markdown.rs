//! The search as Markdown: a whole file ([`markdown`]), sections of a page ([`search_sections`]), and the ranking as
//! cells for the terminal. Section names are marks in `docs/reproduction.md`, which contains the texts.

use std::fmt::Write as _;

use super::super::judge::Verdict;
use super::super::markdown::{demote_headings, escape_cell, origin_section, remove_headings_and_wrap};
use super::super::notes::{describe_missing_runs, verdict_cell};
use super::super::page_sections::{PageSection, wrap_text};
use super::super::phrasing::format_number;
use super::{ClaimCounts, ClaimHalf, ConditionRanking, RankedCondition};

/// Explanation of the ranking and of its limits. [`super`] and docs/figures-and-report.md state the same rule: change
/// all three.
pub(crate) const RANKING_RULE: &str = "Every claim has a number, in the order of the report. Conditions are ranked by \
    the claims with even numbers alone: by how many are reproduced, then by how many are within 20 %. The claims with \
    odd numbers do not affect the rank; the number of them that a condition meets shows whether its rank is more than \
    luck. Claims that were not run do not count. Each verdict is independent of the other claims. Both halves come \
    from the same runs, and a sentence about several policies gives several claims, so the halves are not independent \
    of each other.";

/// Renders the whole page, with the first `count` conditions and the presets.
pub fn markdown(ranking: &ConditionRanking<'_>, count: usize, command: &str) -> String {
    let mut out = String::from("# Which conditions meet most of the paper's claims\n\n");
    for line in summary(ranking)
        .into_iter()
        .chain(describe_missing_runs(&ranking.report))
    {
        let _ = writeln!(out, "- {line}");
    }
    let _ = writeln!(out, "\n{RANKING_RULE}\n\n## Conditions\n");
    out.push_str(&ranking_table(ranking, count));
    out.push_str(&effects_section(ranking));
    out.push_str(&unmet_section(ranking));
    out.push_str(&verdicts_section(ranking));
    out.push_str(&origin_section(&ranking.report, command));
    out
}

/// Renders the search as sections of a page, with the first `count` conditions and the presets.
pub fn search_sections(ranking: &ConditionRanking<'_>, count: usize, command: &str) -> Vec<PageSection> {
    // The text of a section below its heading, which must be a second-level one at the start.
    let without_heading = |text: String| {
        demote_headings(
            text.split_once("## ")
                .and_then(|(_, section)| section.split_once('\n'))
                .map_or("", |(_, body)| body),
        )
    };
    vec![
        PageSection::list(
            "search",
            summary(ranking)
                .into_iter()
                .chain(describe_missing_runs(&ranking.report)),
        ),
        PageSection::new("search-rule", wrap_text(RANKING_RULE, "")),
        PageSection::new("search-settings", ranking_table(ranking, count)),
        PageSection::new("search-effects", without_heading(effects_section(ranking))),
        PageSection::new("search-unmet", without_heading(unmet_section(ranking))),
        PageSection::new("search-claims", without_heading(verdicts_section(ranking))),
        PageSection::new(
            "search-made",
            remove_headings_and_wrap(&origin_section(&ranking.report, command)),
        ),
    ]
}

/// Summarises the search and its result, one sentence an item.
pub fn summary(ranking: &ConditionRanking<'_>) -> Vec<String> {
    let ClaimCounts { met, unmet, not_run } = ranking.counts();
    let run_count: usize = ranking.report.columns.iter().map(|c| c.condition.run_count()).sum();
    let rows = &ranking.report.rows;
    let [search_count, held_out_count] = [ClaimHalf::Search, ClaimHalf::HeldOut].map(|half| {
        let of_half = (1..)
            .zip(rows)
            .filter(|(number, _)| ClaimHalf::of_number(*number) == half);
        of_half.filter(|(_, row)| row.has_runs()).count()
    });
    let mut sentences = vec![
        format!(
            "{} conditions, {run_count} runs; {} claims, of which {} were run: {} to search by, {} held out.",
            ranking.conditions.len(),
            rows.len(),
            met + unmet,
            search_count,
            held_out_count
        ),
        format!("{met} claims are met by some condition, {unmet} by none, {not_run} were not run."),
    ];
    if let Some(best) = ranking.conditions.first() {
        sentences.push(format!(
            "The best of the search half meets {} of {} claims there and {} of {} of those held out, by which it has \
             place {} of {}.",
            best.search.met,
            best.search.judged,
            best.held_out.met,
            best.held_out.judged,
            best.held_out_rank,
            ranking.conditions.len()
        ));
    }
    if let Some(correlation) = ranking.correlation() {
        sentences.push(format!(
            "Over all conditions, the numbers of claims met in the two halves have a correlation of {correlation:.2}."
        ));
    }
    sentences
}

/// Headings of the ranking: its own columns, then the fields in which conditions differ.
pub fn ranking_heads(ranking: &ConditionRanking<'_>) -> Vec<String> {
    let ranking_columns = [
        "place",
        "met",
        "within 20 %",
        "of",
        "held out: met",
        "within 20 %",
        "of",
        "place",
    ];
    let ranking_columns = ranking_columns.map(str::to_owned).into_iter();
    let fields = ranking.fields().into_iter().map(str::to_owned);
    ranking_columns.chain(["condition".to_owned()]).chain(fields).collect()
}

/// Formats a row of the ranking, in the order of [`ranking_heads`].
pub fn ranking_row(ranking: &ConditionRanking<'_>, ranked: &RankedCondition) -> Vec<String> {
    let (search_score, held_out_score) = (ranked.search, ranked.held_out);
    let numbers = [
        ranked.rank,
        search_score.met,
        search_score.near,
        search_score.judged,
        held_out_score.met,
        held_out_score.near,
        held_out_score.judged,
        ranked.held_out_rank,
    ];
    let condition = ranking.report.columns[ranked.column].condition;
    let name = if condition.is_unchanged_preset() {
        condition.preset.clone()
    } else {
        String::new()
    };
    let fields = ranking.fields().into_iter();
    let values = fields.map(|field| ranking.value(ranked.column, field).unwrap_or("–").to_owned());
    let numbers = numbers.iter().map(ToString::to_string);
    numbers.chain([name]).chain(values).collect()
}

/// Renders a table, whose rows must have one cell for each of `heads`.
fn table(heads: &[String], rows: impl Iterator<Item = Vec<String>>) -> String {
    let line = |cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|text| escape_cell(text)).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let mut out = line(heads);
    let _ = writeln!(out, "|{}", "---|".repeat(heads.len()));
    rows.for_each(|row| out.push_str(&line(&row)));
    out
}

fn ranking_table(ranking: &ConditionRanking<'_>, count: usize) -> String {
    let shown: Vec<&RankedCondition> = ranking.conditions_to_show(count).collect();
    let mut out = table(
        &ranking_heads(ranking),
        shown.iter().map(|ranked| ranking_row(ranking, ranked)),
    );
    match ranking.conditions.len() - shown.len() {
        0 => {}
        1 => out.push_str("\nOne more condition is not shown.\n"),
        hidden => {
            let _ = writeln!(out, "\n{hidden} more conditions are not shown.");
        }
    }
    out
}

fn effects_section(ranking: &ConditionRanking<'_>) -> String {
    let effects = ranking.effects();
    if effects.is_empty() {
        return String::new();
    }
    let heads = [
        "field",
        "value",
        "conditions",
        "claims met, mean",
        "best",
        "held out: met, mean",
    ]
    .map(str::to_owned);
    let rows = effects.into_iter().map(|effect| {
        vec![
            format!("`{}`", effect.field),
            effect.value,
            effect.condition_count.to_string(),
            format_number(effect.mean_met_search),
            effect.most_met_search.to_string(),
            format_number(effect.mean_met_held_out),
        ]
    });
    format!(
        "\n## Effect of each value\n\nOver all conditions with this value.\n\n{}",
        table(&heads, rows)
    )
}

fn unmet_section(ranking: &ConditionRanking<'_>) -> String {
    let claims = ranking.unmet();
    if claims.is_empty() {
        return String::new();
    }
    let heads = [
        "claim",
        "figure",
        "policy",
        "N",
        "of",
        "stated",
        "closest",
        "verdict",
        "condition",
        "why",
    ];
    let heads = heads.map(str::to_owned);
    let rows = claims.into_iter().map(|claim| {
        let (row, column) = (claim.row, claim.closest_column);
        let assessment = &row.assessments[column];
        vec![
            claim.number.to_string(),
            row.paper_figure.to_owned(),
            row.policy.clone(),
            row.device_counts.clone(),
            row.metric_description.clone(),
            row.stated.clone(),
            assessment.measured.clone(),
            verdict_cell(row, column),
            ranking.label(column).to_owned(),
            assessment.explanation.clone(),
        ]
    });
    format!("\n## Claims that no condition meets\n\n{}", table(&heads, rows))
}

/// Lists every claim, its half, the number of conditions that meet it, and its verdicts under the presets and the best
/// condition.
fn verdicts_section(ranking: &ConditionRanking<'_>) -> String {
    let best = ranking.conditions.first().map(|ranked| ranked.column);
    // With a count of 0, `conditions_to_show` yields only the presets.
    let presets = ranking.conditions_to_show(0).map(|ranked| ranked.column);
    let mut columns: Vec<usize> = presets.collect();
    columns.sort_unstable();
    columns.extend(best.filter(|best| !columns.contains(best)));
    let heads = [
        "claim",
        "half",
        "figure",
        "policy",
        "N",
        "of",
        "stated",
        "conditions that meet it",
    ];
    let mut heads: Vec<String> = heads.map(str::to_owned).to_vec();
    heads.extend(columns.iter().map(|column| ranking.label(*column).to_owned()));
    let numbered_rows = (1..).zip(&ranking.report.rows).filter(|(_, row)| row.has_runs());
    let table_rows = numbered_rows.map(|(number, row)| {
        let condition_count = row
            .assessments
            .iter()
            .filter(|assessment| assessment.verdict == Verdict::Reproduced)
            .count();
        let mut cells = vec![
            number.to_string(),
            ClaimHalf::of_number(number).name().to_owned(),
            row.paper_figure.to_owned(),
            row.policy.clone(),
            row.device_counts.clone(),
            row.metric_description.clone(),
            row.stated.clone(),
            condition_count.to_string(),
        ];
        let verdict_and_value = |column: &usize| match verdict_cell(row, *column) {
            verdict if row.assessments[*column].measured.is_empty() => verdict,
            verdict => format!("{verdict}: {}", row.assessments[*column].measured),
        };
        cells.extend(columns.iter().map(verdict_and_value));
        cells
    });
    format!("\n## Claim by claim\n\n{}", table(&heads, table_rows))
}
