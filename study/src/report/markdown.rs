//! The report as Markdown: a whole file ([`markdown`]), or sections of a page ([`report_sections`]). [`super::page`]
//! shows the same rows as HTML: change both.
//!
//! Section names are marks in `docs/reproduction.md`: `why` has the explanations, `readings` the interpretations of the
//! paper, and `made` the origin of the report. Every table row must have the columns of its head. The search uses
//! `origin_section` and the functions for headings and cells.

use std::fmt::Write as _;

use super::judge::Verdict;
use super::notes::{
    VERDICT_RULE, describe_missing_runs, describe_origins, describe_runs, remarks_on_paper, summarise_verdicts,
    verdict_cell,
};
use super::page_sections::{PageSection, wrap_text};
use super::{ClaimReport, ClaimRow, ConditionColumn, REPORT_PRESETS};

/// Renders the whole report. `figures` are pairs of a title and a file, and `command` is the command that made it.
pub fn markdown(report: &ClaimReport<'_>, figures: &[(String, String)], command: &str) -> String {
    let mut out = String::from("# Claims of the paper and measurements of Reveille\n\n## Summary\n\n");
    for line in summarise_verdicts(report) {
        let _ = writeln!(out, "- {line}");
    }
    out.push('\n');
    out.push_str(&tally_table(report));
    out.push_str("\n## Runs and rule\n\n");
    for line in describe_runs(report).into_iter().chain(describe_missing_runs(report)) {
        let _ = writeln!(out, "- {line}");
    }
    let _ = writeln!(out, "\n{VERDICT_RULE}");
    for (figure, rows) in report.rows_by_figure() {
        out.push_str(&table_head(report, figure));
        out.extend(rows.iter().map(|row| table_row(row)));
    }
    out.push_str(&why_section(report));
    for notes in remarks_on_paper(report) {
        let _ = writeln!(out, "\n## {}\n", notes.heading);
        for item in notes.items {
            let _ = writeln!(out, "- {item}");
        }
    }
    if !figures.is_empty() {
        out.push_str("\n## Figures\n\n");
        for (title, file) in figures {
            let _ = writeln!(out, "![{title}]({file})");
        }
    }
    out.push_str(&origin_section(report, command));
    out
}

/// Renders the report as sections of a page, with third-level headings.
pub fn report_sections(report: &ClaimReport<'_>, command: &str) -> Vec<PageSection> {
    let tables = report.rows_by_figure().into_iter();
    let tables = tables.map(|(figure, rows_of_figure)| {
        let rows = rows_of_figure.iter().map(|row| table_row(row));
        demote_headings(&table_head(report, figure)) + &rows.collect::<String>()
    });
    let [contradictions, interpretations] = remarks_on_paper(report);
    vec![
        PageSection::list(
            "runs",
            describe_runs(report).into_iter().chain(describe_missing_runs(report)),
        ),
        PageSection::new("rule", wrap_text(VERDICT_RULE, "")),
        PageSection::new("tally", tally_table(report)),
        PageSection::new("claims", tables.collect()),
        // The paper makes no statements on other conditions, and their reasons would fill another page.
        PageSection::list(
            "why",
            explanations(report, |column| REPORT_PRESETS.contains(&column.label.as_str())),
        ),
        PageSection::list("contradictions", contradictions.items),
        PageSection::list("readings", interpretations.items),
        PageSection::new("made", remove_headings_and_wrap(&origin_section(report, command))),
    ]
}

/// Converts second-level headings to third-level ones.
pub(super) fn demote_headings(text: &str) -> String {
    text.replace("\n## ", "\n### ")
}

/// Removes the second-level headings from the text of [`origin_section`], and wraps their lists to the page width.
pub(super) fn remove_headings_and_wrap(text: &str) -> String {
    let lines = text.lines().filter(|line| !line.starts_with("## "));
    let wrap_item = |line: &str| match line.strip_prefix("- ") {
        Some(_) => wrap_text(line, "  "),
        None => format!("{line}\n"),
    };
    lines.map(wrap_item).collect()
}

fn tally_table(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("| claims |");
    for column in &report.columns {
        let _ = write!(out, " {} |", escape_cell(&column.label));
    }
    let _ = writeln!(out, "\n|---|{}", "---|".repeat(report.columns.len()));
    for verdict in Verdict::ALL {
        let _ = write!(out, "| {} |", verdict.name());
        for column in 0..report.columns.len() {
            let _ = write!(out, " {} |", report.tally_text(column, verdict));
        }
        out.push('\n');
    }
    out
}

fn table_head(report: &ClaimReport<'_>, paper_figure: &str) -> String {
    let mut out = format!("\n## {paper_figure}\n\n| | policy | N | stated |");
    for column in &report.columns {
        let _ = write!(out, " {} | verdict |", escape_cell(&column.label));
    }
    let _ = writeln!(
        out,
        " in the paper |\n|---|---|---|---|{}---|",
        "---|---|".repeat(report.columns.len())
    );
    out
}

fn table_row(row: &ClaimRow) -> String {
    let mut out = format!(
        "| {} | {} | {} | {} |",
        escape_cell(&row.metric_description),
        row.policy,
        row.device_counts,
        escape_cell(&row.stated)
    );
    for (column, assessment) in row.assessments.iter().enumerate() {
        let _ = write!(
            out,
            " {} | {} |",
            escape_cell(&assessment.measured),
            verdict_cell(row, column)
        );
    }
    let _ = writeln!(out, " {} |", escape_cell(&row.citations()));
    out
}

fn why_section(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("\n## Why\n\n");
    for reason in explanations(report, |_| true) {
        let _ = writeln!(out, "- {reason}");
    }
    out
}

/// Explains verdicts in the columns for which `is_included` holds, as far as known, in one or more sentences each.
fn explanations(report: &ClaimReport<'_>, is_included: impl Fn(&ConditionColumn<'_>) -> bool) -> Vec<String> {
    let mut sentences = Vec::new();
    for row in report.rows.iter().filter(|row| row.has_runs()) {
        let columns = report.columns.iter().zip(&row.assessments);
        for (column, assessment) in columns.filter(|(column, _)| is_included(column)) {
            if !assessment.explanation.is_empty() && assessment.verdict != Verdict::NotRun {
                let ClaimRow {
                    paper_figure,
                    policy,
                    device_counts,
                    metric_description,
                    stated,
                    ..
                } = row;
                sentences.push(format!(
                    "{paper_figure}, {policy}, {device_counts}, {metric_description} {stated}, under `{}`: {}",
                    column.label, assessment.explanation
                ));
            }
        }
    }
    sentences
}

/// Describes the origin of the page: the command, the tables, and their experiments. [`remove_headings_and_wrap`]
/// removes its second-level heading, a line without other text.
pub(super) fn origin_section(report: &ClaimReport<'_>, command: &str) -> String {
    let mut out = format!(
        "\n## How this report was made\n\nBy Reveille {}: `{command}`\n\n",
        env!("CARGO_PKG_VERSION")
    );
    for line in describe_origins(report) {
        let _ = writeln!(out, "- {line}");
    }
    for (name, text) in report.experiments() {
        let _ = writeln!(out, "\nThe experiment of `{name}`:\n\n```toml\n{text}\n```");
    }
    out
}

/// Escapes text for a table cell.
pub(super) fn escape_cell(text: &str) -> String {
    text.replace('|', "\\|")
}
