//! The report as Markdown.

use std::fmt::Write as _;

use super::judge::Verdict;
use super::notes::{RULE, absent, origins, remarks, runs, verdict};
use super::page_sections::{PageSection, wrapped};
use super::{ClaimReport, ClaimRow, ConditionColumn, PRESETS};

/// Renders the whole report.
pub fn markdown(report: &ClaimReport<'_>, figures: &[(String, String)], command: &str) -> String {
    let mut out = String::from("# Claims of the paper and measurements of Reveille\n\n");
    for line in runs(report).into_iter().chain(absent(report)) {
        let _ = writeln!(out, "- {line}");
    }
    let _ = writeln!(out, "\n{RULE}\n");
    out.push_str(&tally(report));
    for (source, lines) in report.sections() {
        out.push_str(&head(report, source));
        out.extend(lines.iter().map(|line| row(line)));
    }
    out.push_str(&why(report));
    for remarks in remarks(report) {
        let _ = writeln!(out, "\n## {}\n", remarks.heading);
        for item in remarks.items {
            let _ = writeln!(out, "- {item}");
        }
    }
    if !figures.is_empty() {
        out.push_str("\n## Figures\n\n");
        for (title, file) in figures {
            let _ = writeln!(out, "![{title}]({file})");
        }
    }
    out.push_str(&made(report, command));
    out
}

/// Renders the report as sections of a page, with third-level headings.
pub fn parts(report: &ClaimReport<'_>, command: &str) -> Vec<PageSection> {
    let sections = report.sections().into_iter();
    let sections = sections.map(|(source, lines)| {
        let rows = lines.iter().map(|line| row(line));
        lower(&head(report, source)) + &rows.collect::<String>()
    });
    let [against, readings] = remarks(report);
    vec![
        PageSection::list("runs", runs(report).into_iter().chain(absent(report))),
        PageSection::new("rule", wrapped(RULE, "")),
        PageSection::new("tally", tally(report)),
        PageSection::new("claims", sections.collect()),
        // The paper makes no statements on other settings, and their reasons would fill another page.
        PageSection::list(
            "why",
            reasons(report, |column| PRESETS.contains(&column.label.as_str())),
        ),
        PageSection::list("contradictions", against.items),
        PageSection::list("readings", readings.items),
        PageSection::new("made", folded(&made(report, command))),
    ]
}

/// Converts second-level headings to third-level ones.
pub(super) fn lower(text: &str) -> String {
    text.replace("\n## ", "\n### ")
}

/// Removes the heading from the notes on the page's origin, and wraps their lists to the page width.
pub(super) fn folded(text: &str) -> String {
    let lines = text.lines().filter(|line| !line.starts_with("## "));
    let fold = |line: &str| match line.strip_prefix("- ") {
        Some(_) => wrapped(line, "  "),
        None => format!("{line}\n"),
    };
    lines.map(fold).collect()
}

fn tally(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("| claims |");
    for column in &report.columns {
        let _ = write!(out, " {} |", cell(&column.label));
    }
    let _ = writeln!(out, "\n|---|{}", "---|".repeat(report.columns.len()));
    for verdict in Verdict::ALL {
        let _ = write!(out, "| {} |", verdict.words());
        for column in 0..report.columns.len() {
            let _ = write!(out, " {} |", report.tally(column, verdict));
        }
        out.push('\n');
    }
    out
}

fn head(report: &ClaimReport<'_>, source: &str) -> String {
    let mut out = format!("\n## {source}\n\n| | policy | N | stated |");
    for column in &report.columns {
        let _ = write!(out, " {} | verdict |", cell(&column.label));
    }
    let _ = writeln!(
        out,
        " in the paper |\n|---|---|---|---|{}---|",
        "---|---|".repeat(report.columns.len())
    );
    out
}

fn row(line: &ClaimRow) -> String {
    let mut out = format!(
        "| {} | {} | {} | {} |",
        cell(&line.about),
        line.policy,
        line.sites,
        cell(&line.paper)
    );
    for (column, ours) in line.ours.iter().enumerate() {
        let _ = write!(out, " {} | {} |", cell(&ours.found), verdict(line, column));
    }
    let _ = writeln!(out, " {} |", cell(&line.places()));
    out
}

fn why(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("\n## Why\n\n");
    for reason in reasons(report, |_| true) {
        let _ = writeln!(out, "- {reason}");
    }
    out
}

/// Explains unmet claims in the columns for which `is_told` holds, as far as known, in one or more sentences each.
fn reasons(report: &ClaimReport<'_>, is_told: impl Fn(&ConditionColumn<'_>) -> bool) -> Vec<String> {
    let mut reasons = Vec::new();
    for line in report.lines.iter().filter(|line| line.is_run()) {
        let columns = report.columns.iter().zip(&line.ours);
        for (column, ours) in columns.filter(|(column, _)| is_told(column)) {
            if !ours.why.is_empty() && ours.verdict != Verdict::NotRun {
                let ClaimRow {
                    source,
                    policy,
                    sites,
                    about,
                    paper,
                    ..
                } = line;
                reasons.push(format!(
                    "{source}, {policy}, {sites}, {about} {paper}, under `{}`: {}",
                    column.label, ours.why
                ));
            }
        }
    }
    reasons
}

/// Describes the origin of the page: the command, the tables, and their experiments.
pub(super) fn made(report: &ClaimReport<'_>, command: &str) -> String {
    let mut out = format!(
        "\n## How this report was made\n\nBy Reveille {}: `{command}`\n\n",
        env!("CARGO_PKG_VERSION")
    );
    for line in origins(report) {
        let _ = writeln!(out, "- {line}");
    }
    for (name, text) in report.experiments() {
        let _ = writeln!(out, "\nThe experiment of `{name}`:\n\n```toml\n{text}\n```");
    }
    out
}

/// Escapes text for a table cell.
pub(super) fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}
