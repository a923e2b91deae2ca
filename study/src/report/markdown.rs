//! The report as Markdown.

use std::fmt::Write as _;

use super::judge::Verdict;
use super::{Line, Report};

/// What stands at the head of the report, for both of its forms.
pub(super) const RULE: &str = "A claim is reproduced if our mean is within 20 % of the stated value, of the nearer end \
    of a stated range or of a stated ratio, or meets a stated bound; a claim for several N must hold at each that was \
    run. A stated 0 is met by less than 1 % of the largest of the other policies. Its order is reproduced if, failing \
    that, the policy stands to every other with a stated figure or ratio as in the paper. A verdict marked ? would \
    differ for some value in our 95 % interval, which for not one miss in Σ events ends at 300 / Σ events %. No \
    definition was changed to meet a claim.";

/// The whole report.
pub fn markdown(report: &Report<'_>, figures: &[(String, String)], command: &str) -> String {
    let mut out = String::from("# What the paper claims and what Reveille measures\n\n");
    let _ = writeln!(out, "{RULE}\n");
    out.push_str(&tally(report));
    for (source, lines) in report.sections() {
        out.push_str(&head(report, source));
        out.extend(lines.iter().map(row));
    }
    out.push_str("\n## Why\n\n");
    for line in &report.lines {
        for (column, ours) in report.columns.iter().zip(&line.ours) {
            if !ours.why.is_empty() && ours.verdict != Verdict::NotRun {
                let Line {
                    source,
                    policy,
                    sites,
                    about,
                    ..
                } = line;
                let _ = writeln!(
                    out,
                    "- {source}, {policy}, {sites}, {about}, under `{}`: {}",
                    column.label, ours.why
                );
            }
        }
    }
    out.push_str(&not_run(report));
    if !figures.is_empty() {
        out.push_str("\n## Figures\n\n");
        for (title, file) in figures {
            let _ = writeln!(out, "![{title}]({file})");
        }
    }
    out.push_str(&made(report, command));
    out
}

fn tally(report: &Report<'_>) -> String {
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

fn head(report: &Report<'_>, source: &str) -> String {
    let mut out = format!("\n## {source}\n\n| | policy | N | stated |");
    for column in &report.columns {
        let _ = write!(out, " {} | verdict |", cell(&column.label));
    }
    let _ = writeln!(out, "\n|---|---|---|---|{}", "---|---|".repeat(report.columns.len()));
    out
}

fn row(line: &Line) -> String {
    let mut out = format!(
        "| {} | {} | {} | {} |",
        cell(&line.about),
        line.policy,
        line.sites,
        cell(&line.paper)
    );
    for ours in &line.ours {
        let doubt = if ours.firm { "" } else { " ?" };
        let _ = write!(out, " {} | {}{doubt} |", cell(&ours.found), ours.verdict.words());
    }
    out.push('\n');
    out
}

/// Claims without runs, by reason.
fn not_run(report: &Report<'_>) -> String {
    let mut reasons: Vec<(String, usize)> = Vec::new();
    for line in &report.lines {
        for (column, ours) in report.columns.iter().zip(&line.ours) {
            if ours.verdict == Verdict::NotRun {
                let reason = format!("Under `{}`: {}", column.label, ours.why);
                match reasons.iter_mut().find(|(known, _)| *known == reason) {
                    Some((_, count)) => *count += 1,
                    None => reasons.push((reason, 1)),
                }
            }
        }
    }
    let mut out = String::new();
    for (reason, count) in reasons {
        let claims = if count == 1 { "one claim was" } else { "claims were" };
        let count = if count == 1 { String::new() } else { format!("{count} ") };
        let _ = writeln!(out, "- {count}{claims} not run. {reason}");
    }
    out
}

fn made(report: &Report<'_>, command: &str) -> String {
    let mut out = format!(
        "\n## How it was made\n\nBy Reveille {}: `{command}`\n\n",
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

/// Where the runs come from, a sentence a table and a condition.
pub(super) fn origins(report: &Report<'_>) -> Vec<String> {
    let mut lines = Vec::new();
    for source in &report.results.sources {
        let about = &source.about;
        let shard = about
            .shard
            .as_ref()
            .map_or_else(String::new, |shard| format!(", shard {shard}"));
        let version = if about.version.is_empty() {
            "unknown version"
        } else {
            &about.version
        };
        lines.push(format!(
            "{}: {} runs by Reveille {version}{shard}; SHA-256 of the experiment's scenarios {}; of the \
             runs' digests in order {}.",
            source.name, source.rows, about.grid, source.digests
        ));
    }
    for column in &report.columns {
        if let Some(condition) = column.condition {
            let ((least, most), (first, last)) = (condition.runs_per_cell(), condition.seeds());
            lines.push(format!(
                "{}: {} of {} TTIs a cell, seeds {first} to {last}.",
                column.label,
                if least == most {
                    format!("{most} runs")
                } else {
                    format!("{least} to {most} runs")
                },
                condition.ttis
            ));
        }
    }
    lines
}

/// Text as it may stand in a cell of a table.
fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}
