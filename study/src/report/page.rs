//! The report as one self-contained HTML page.

use std::fmt::Write as _;

use super::judge::Verdict;
use super::notes::{RULE, absent, origins, remarks, runs, verdict};
use super::{ClaimReport, ClaimRow};
use crate::figures::svg::escape;

const STYLE: &str = include_str!("page.css");

/// Renders the page. `pictures` are SVGs.
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
         <h1>Claims of the paper and measurements of Reveille</h1>\n"
    );
    out.push_str(&list(runs(report).into_iter().chain(absent(report))));
    let _ = writeln!(out, "<p>{}</p>", escape(RULE));
    out.push_str(&tally(report));
    out.push_str("<h2>Claims</h2>\n");
    for (source, lines) in report.sections() {
        out.push_str(&head(report, source));
        out.extend(lines.iter().map(|line| row(report, line)));
        out.push_str("</tbody></table></div>\n");
    }
    for remarks in remarks(report) {
        let _ = writeln!(out, "<h2>{}</h2>", remarks.heading);
        out.push_str(&list(remarks.items.into_iter()));
    }
    out.push_str("<h2>Figures</h2>\n<div class=\"figures\">\n");
    for picture in pictures {
        // Not escaped: the pictures are our own SVG, whose texts are already escaped.
        let _ = writeln!(out, "<figure>{picture}</figure>");
    }
    out.push_str("</div>\n<h2>How this report was made</h2>\n");
    let _ = writeln!(
        out,
        "<p>By Reveille {}: <code>{}</code></p>",
        env!("CARGO_PKG_VERSION"),
        escape(command)
    );
    out.push_str(&list(origins(report).into_iter()));
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

fn list(items: impl Iterator<Item = String>) -> String {
    let mut out = String::from("<ul>\n");
    for item in items {
        let _ = writeln!(out, "<li>{}</li>", together(&escape(&item)));
    }
    out.push_str("</ul>\n");
    out
}

const fn class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Reproduced => "yes",
        Verdict::Near => "near",
        Verdict::OrderReproduced => "order",
        Verdict::NotReproduced => "no",
        Verdict::NotRun => "none",
    }
}

/// Sign in front of the verdict, for readers who cannot distinguish the colours.
const fn sign(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Reproduced => "✓",
        Verdict::Near => "≈",
        Verdict::OrderReproduced => "≷",
        Verdict::NotReproduced => "✗",
        Verdict::NotRun => "–",
    }
}

fn tally(report: &ClaimReport<'_>) -> String {
    let mut out = String::from("<table class=\"tally\"><thead><tr><th>claims</th>");
    for column in &report.columns {
        let _ = write!(out, "<th>{}</th>", escape(&column.label));
    }
    out.push_str("</tr></thead><tbody>\n");
    for verdict in Verdict::ALL {
        let _ = write!(
            out,
            "<tr><td class=\"{}\">{} {}</td>",
            class(verdict),
            sign(verdict),
            verdict.words()
        );
        for column in 0..report.columns.len() {
            let _ = write!(out, "<td>{}</td>", report.tally(column, verdict));
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table>\n");
    out
}

fn head(report: &ClaimReport<'_>, source: &str) -> String {
    let mut out = format!(
        "<h3>{}</h3>\n<div class=\"wide\"><table><thead><tr><th></th><th>policy</th><th>N</th><th>stated</th>",
        escape(source)
    );
    for column in &report.columns {
        let _ = write!(out, "<th>{}</th><th>verdict</th>", escape(&column.label));
    }
    out.push_str("<th>in the paper</th></tr></thead><tbody>\n");
    out
}

fn row(report: &ClaimReport<'_>, line: &ClaimRow) -> String {
    let mut out = format!(
        "<tr class=\"claim\"><td>{}</td><td>{}</td><td>{}</td><td>{}</td>",
        escape(&line.about),
        escape(&line.policy),
        escape(&line.sites),
        escape(&line.paper)
    );
    for (column, ours) in line.ours.iter().enumerate() {
        let (class, sign, words) = (class(ours.verdict), sign(ours.verdict), verdict(line, column));
        let _ = write!(
            out,
            "<td>{}</td><td class=\"{class}\">{sign} {words}</td>",
            together(&escape(&ours.found))
        );
    }
    let _ = write!(out, "<td>{}</td>", escape(&line.places()));
    let mut reasons: Vec<String> = Vec::new();
    // A reason that all columns share is printed once, without their names.
    let is_same = line.ours.iter().all(|ours| ours.why == line.ours[0].why);
    for (column, ours) in report.columns.iter().zip(&line.ours) {
        if is_same {
            reasons = vec![escape(&ours.why)];
        } else if !ours.why.is_empty() {
            reasons.push(format!("<b>{}</b>: {}", escape(&column.label), escape(&ours.why)));
        }
    }
    reasons.retain(|reason| !reason.is_empty());
    out.push_str("</tr>\n");
    if !reasons.is_empty() {
        let (width, reasons) = (4 + 2 * report.columns.len(), together(&reasons.join("<br>")));
        let _ = writeln!(
            out,
            "<tr class=\"why\"><td></td><td colspan=\"{width}\">{reasons}</td></tr>"
        );
    }
    out
}

/// Joins figures in `text` by no-break spaces, so that lines do not break within them.
fn together(text: &str) -> String {
    text.replace(" ± ", "\u{a0}±\u{a0}").replace("N = ", "N\u{a0}=\u{a0}")
}
