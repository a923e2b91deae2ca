//! The report as one self-contained HTML page, with the rows and notes of [`super::markdown`]: change both. The
//! explanations follow their rows instead of a section. Nothing is loaded.
//!
//! `page.css` styles the classes, the first four columns of a claim, and the `data-label` of cells. All text passes
//! `escape`, since labels, names and experiments come from the tables.

use std::fmt::Write as _;

use super::judge::Verdict;
use super::notes::{
    VERDICT_RULE, describe_missing_runs, describe_origins, describe_runs, remarks_on_paper, summarise_verdicts,
    verdict_cell,
};
use super::{ClaimReport, ClaimRow};
use crate::figures::svg::escape;

const STYLE: &str = include_str!("page.css");

/// Renders the page. `pictures` are SVGs, and `command` is the command that made it.
pub fn page(report: &ClaimReport<'_>, pictures: &[String], command: &str) -> String {
    let mut out = format!(
        "<!DOCTYPE html>\n\
         <html lang=\"en\">\n\
         <head>\n\
         <meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>Reveille compared with the paper</title>\n\
         <style>\n\
         {STYLE}</style>\n\
         </head>\n\
         <body>\n\
         <h1>Claims of the paper and measurements of Reveille</h1>\n\
         <h2 id=\"summary\">Summary</h2>\n"
    );
    out.push_str(&html_list(summarise_verdicts(report).into_iter()));
    out.push_str(&tally_table(report));
    out.push_str(&contents(report));
    out.push_str("<h2 id=\"runs\">Runs and rule</h2>\n");
    out.push_str(&html_list(
        describe_runs(report).into_iter().chain(describe_missing_runs(report)),
    ));
    let _ = writeln!(out, "<p>{}</p>", escape(VERDICT_RULE));
    out.push_str("<h2 id=\"claims\">Claims</h2>\n");
    for (figure, rows) in report.rows_by_figure() {
        out.push_str(&table_head(report, figure));
        out.extend(rows.iter().map(|row| table_row(report, row)));
        out.push_str("</tbody></table></div>\n");
    }
    for notes in remarks_on_paper(report) {
        let _ = writeln!(out, "<h2 id=\"{}\">{}</h2>", anchor(notes.heading), notes.heading);
        out.push_str(&html_list(notes.items.into_iter()));
    }
    out.push_str("<h2 id=\"figures\">Figures</h2>\n<div class=\"figures\">\n");
    for picture in pictures {
        // Not escaped: the pictures are our own SVG, whose texts are already escaped.
        let _ = writeln!(out, "<figure>{picture}</figure>");
    }
    out.push_str("</div>\n<h2 id=\"made\">How this report was made</h2>\n");
    let _ = writeln!(
        out,
        "<p>By Reveille {}: <code>{}</code></p>",
        env!("CARGO_PKG_VERSION"),
        escape(command)
    );
    out.push_str(&html_list(describe_origins(report).into_iter()));
    for (name, text) in report.experiments() {
        let (name, text) = (escape(name), escape(text));
        let _ = writeln!(
            out,
            "<details><summary>The experiment of {name}</summary><pre>{text}</pre></details>"
        );
    }
    out.push_str("</body>\n</html>\n");
    out
}

/// Returns the table of contents, with a link to each section. The targets repeat the ids that [`page`] writes.
fn contents(report: &ClaimReport<'_>) -> String {
    let link = |target: &str, text: &str| format!("<a href=\"#{target}\">{}</a>", escape(text));
    let figures: Vec<String> = report
        .rows_by_figure()
        .iter()
        .map(|(figure, _)| link(&anchor(figure), figure))
        .collect();
    let mut items = vec![
        link("runs", "Runs and rule"),
        format!("{}: {}", link("claims", "Claims"), figures.join(", ")),
    ];
    items.extend(
        remarks_on_paper(report)
            .iter()
            .map(|notes| link(&anchor(notes.heading), notes.heading)),
    );
    items.extend([link("figures", "Figures"), link("made", "How this report was made")]);
    let mut out = String::from("<nav><h2>Contents</h2>\n<ol>\n");
    for item in items {
        let _ = writeln!(out, "<li>{item}</li>");
    }
    out.push_str("</ol></nav>\n");
    out
}

/// Returns the anchor of the section `heading`: lower case, with hyphens.
fn anchor(heading: &str) -> String {
    let words = heading
        .split(|c: char| !c.is_ascii_alphanumeric())
        .filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-").to_lowercase()
}

fn html_list(items: impl Iterator<Item = String>) -> String {
    let mut out = String::from("<ul>\n");
    for item in items {
        let _ = writeln!(out, "<li>{}</li>", with_code(&with_no_break_spaces(&escape(&item))));
    }
    out.push_str("</ul>\n");
    out
}

const fn css_class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Reproduced => "yes",
        Verdict::Near => "near",
        Verdict::OrderReproduced => "order",
        Verdict::NotReproduced => "no",
        Verdict::NotRun => "none",
    }
}

/// Sign in front of the verdict, for readers who cannot distinguish the colours.
const fn verdict_sign(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Reproduced => "✓",
        Verdict::Near => "≈",
        Verdict::OrderReproduced => "≷",
        Verdict::NotReproduced => "✗",
        Verdict::NotRun => "–",
    }
}

fn tally_table(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("<table class=\"tally\"><thead><tr><th>claims</th>");
    for column in &report.columns {
        let _ = write!(out, "<th>{}</th>", escape(&column.label));
    }
    out.push_str("</tr></thead><tbody>\n");
    for verdict in Verdict::ALL {
        let _ = write!(
            out,
            "<tr><td class=\"{}\">{} {}</td>",
            css_class(verdict),
            verdict_sign(verdict),
            verdict.name()
        );
        for column in 0..report.columns.len() {
            let _ = write!(out, "<td>{}</td>", report.tally_text(column, verdict));
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table>\n");
    out
}

fn table_head(report: &ClaimReport<'_>, paper_figure: &str) -> String {
    let mut out = format!(
        "<h3 id=\"{}\">{}</h3>\n<div class=\"wide\"><table><thead><tr>\
         <th></th><th>policy</th><th>N</th><th>stated</th>",
        anchor(paper_figure),
        escape(paper_figure)
    );
    for column in &report.columns {
        let _ = write!(out, "<th>{}</th><th>verdict</th>", escape(&column.label));
    }
    out.push_str("<th>in the paper</th></tr></thead><tbody>\n");
    out
}

fn table_row(report: &ClaimReport<'_>, row: &ClaimRow) -> String {
    // On narrow screens a row is a card, in which the label of a cell replaces the head of its column.
    let cell = |label: &str, text: &str| format!("<td data-label=\"{}\">{}</td>", escape(label), escape(text));
    let mut out = format!(
        "<tr class=\"claim\"><td>{}</td>{}{}{}",
        escape(&row.metric_description),
        cell("policy", &row.policy),
        cell("N", &row.device_counts),
        cell("stated", &row.stated)
    );
    for (index, (column, assessment)) in report.columns.iter().zip(&row.assessments).enumerate() {
        let (class, sign, words) = (
            css_class(assessment.verdict),
            verdict_sign(assessment.verdict),
            verdict_cell(row, index),
        );
        let _ = write!(
            out,
            "{}<td data-label=\"verdict\" class=\"{class}\">{sign} {words}</td>",
            with_no_break_spaces(&cell(&column.label, &assessment.measured))
        );
    }
    out.push_str(&cell("in the paper", &row.citations()));
    let mut reasons: Vec<String> = Vec::new();
    // A reason that all columns share is printed once, without their names.
    let is_one_reason = row
        .assessments
        .iter()
        .all(|assessment| assessment.explanation == row.assessments[0].explanation);
    for (column, assessment) in report.columns.iter().zip(&row.assessments) {
        if is_one_reason {
            reasons = vec![escape(&assessment.explanation)];
        } else if !assessment.explanation.is_empty() {
            reasons.push(format!(
                "<b>{}</b>: {}",
                escape(&column.label),
                escape(&assessment.explanation)
            ));
        }
    }
    reasons.retain(|reason| !reason.is_empty());
    out.push_str("</tr>\n");
    if !reasons.is_empty() {
        // The columns of `table_head` without the first.
        let (width, reasons) = (
            4 + 2 * report.columns.len(),
            with_no_break_spaces(&reasons.join("<br>")),
        );
        let _ = writeln!(
            out,
            "<tr class=\"why\"><td></td><td colspan=\"{width}\">{reasons}</td></tr>"
        );
    }
    out
}

/// Makes the spaces around `±` and within `N = ` no-break spaces, so that lines do not break there.
fn with_no_break_spaces(text: &str) -> String {
    text.replace(" ± ", "\u{a0}±\u{a0}").replace("N = ", "N\u{a0}=\u{a0}")
}

/// Marks the parts of `text` between backticks, of which there is an even number, as code.
fn with_code(text: &str) -> String {
    let mut out = String::new();
    for (index, part) in text.split('`').enumerate() {
        if index > 0 {
            out.push_str(if index % 2 == 1 { "<code>" } else { "</code>" });
        }
        out.push_str(part);
    }
    out
}
