//! Notes around the tables of the report, for Markdown and HTML.

use super::causes::NOT_RUN;
use super::judge::Verdict;
use super::phrasing::list;
use super::{ClaimReport, ClaimRow, PRESETS};

/// Rule for the verdicts.
pub(super) const RULE: &str = "A claim is reproduced if our mean is within 5 % of the stated value, in a stated range, \
    or meets a stated bound or order. It is within 20 % if our mean is that close to the value or to the nearer end of \
    the range. A claim for several N or against several policies must hold for each that was run. A value that falls \
    or rises with N may deviate from that by a tenth of its range, and a level value may vary by 20 %. A stated 0 is \
    met by less than 1 % of the largest of the other policies. Otherwise its order is reproduced if the policy is \
    above or below every other policy with a stated place as in the paper. A verdict marked ? would differ for some \
    value in our 95 % interval. Where an interval would need more cases, a one-sided 95 % bound replaces it: 3/n \
    without a case in n events, the rule of three. No definition was changed to meet a claim.";

/// A list under a heading.
pub(super) struct ReportNotes {
    pub heading: &'static str,
    pub items: Vec<String>,
}

/// Describes the number of runs of each column, one sentence a column.
pub(super) fn runs(report: &ClaimReport<'_>) -> Vec<String> {
    let of = |column: &super::ConditionColumn<'_>| {
        let condition = column.condition;
        let ((least, most), (first, last)) = (condition.runs_per_cell(), condition.seeds());
        let per_cell = match (least, most) {
            (1, 1) => "1 run".to_owned(),
            (least, most) if least == most => format!("{most} runs"),
            (least, most) => format!("{least} to {most} runs"),
        };
        format!(
            "{}: {per_cell} of {} TTIs for each policy and N, {} in all, seeds {first} to {last}.",
            column.label,
            condition.ttis,
            condition.run_count()
        )
    };
    report.columns.iter().map(of).collect()
}

/// Describes the missing runs: presets, settings of the tables, and claims, one sentence each.
pub(super) fn absent(report: &ClaimReport<'_>) -> Vec<String> {
    let mut sentences = Vec::new();
    let missing: Vec<&str> = report.missing().collect();
    if missing.len() == PRESETS.len() {
        sentences.push(
            "These tables hold no runs of an unchanged preset; the claims of the paper are about other settings."
                .to_owned(),
        );
    } else {
        sentences.extend(
            missing
                .iter()
                .map(|preset| format!("No table of preset {preset} was given.")),
        );
    }
    if !report.silent.is_empty() {
        sentences.push(format!("No claim is about the runs of {}.", list(&report.silent)));
    }
    let lines = || report.lines.iter().filter(|line| !line.is_run());
    let mut policies: Vec<&str> = Vec::new();
    for line in lines() {
        // Lines on λ name the policy with its rank: `random, spends least`.
        let name = line.policy.split(',').next().unwrap_or_default();
        if !policies.contains(&name) {
            policies.push(name);
        }
    }
    if !policies.is_empty() {
        let of = |policy: &&str| {
            let count = lines()
                .filter(|line| line.policy.split(',').next() == Some(*policy))
                .count();
            format!("{policy} {count}")
        };
        let counts: Vec<String> = policies.iter().map(of).collect();
        sentences.push(format!(
            "Not run and left out below: {} of {} claims ({}).",
            lines().count(),
            report.lines.len(),
            counts.join(", ")
        ));
    }
    sentences.extend(reasons(report));
    sentences
}

/// Explains missing verdicts of claims that have runs, one sentence a reason.
fn reasons(report: &ClaimReport<'_>) -> Vec<String> {
    let mut reasons: Vec<(String, usize)> = Vec::new();
    for line in report.lines.iter().filter(|line| !line.is_run()) {
        for (column, ours) in report.columns.iter().zip(&line.ours) {
            let reason = (&column.label, &ours.why);
            if ours.why == NOT_RUN {
                continue;
            }
            // The count is inserted last: `# claims` is its placeholder until all lines are counted.
            let text = format!("`{}`: # claims: {}", reason.0, reason.1);
            match reasons.iter_mut().find(|(known, _)| *known == text) {
                Some((_, count)) => *count += 1,
                None => reasons.push((text, 1)),
            }
        }
    }
    let of = |(text, count): (String, usize)| {
        let claims = if count == 1 {
            "1 claim".to_owned()
        } else {
            format!("{count} claims")
        };
        text.replacen("# claims", &claims, 1)
    };
    reasons.into_iter().map(of).collect()
}

/// Lists the paper's contradictions, and the readings of ambiguous sentences.
pub(super) fn remarks(report: &ClaimReport<'_>) -> [ReportNotes; 2] {
    let mut against: Vec<String> = Vec::new();
    let mut readings: Vec<String> = Vec::new();
    for line in &report.lines {
        if let Some(contradiction) = line.contradicts {
            let item = format!("{}, against {}: {}", line.place, contradiction.with, contradiction.why);
            if !against.contains(&item) {
                against.push(item);
            }
        }
        for (text, item) in [
            (line.judged, format!("{}, {}: {}", line.source, line.about, line.judged)),
            (line.reading, format!("{}: {}", line.places(), line.reading)),
        ] {
            if !text.is_empty() && !readings.contains(&item) {
                readings.push(item);
            }
        }
    }
    [
        ReportNotes {
            heading: "Contradictions in the paper",
            items: against,
        },
        ReportNotes {
            heading: "Interpretation of sentences",
            items: readings,
        },
    ]
}

/// Describes the origin of the runs, one sentence a table.
pub(super) fn origins(report: &ClaimReport<'_>) -> Vec<String> {
    let of = |source: &crate::figures::results::LabelledTable| {
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
        format!(
            "{}: {} runs by Reveille {version}{shard}; SHA-256 of the scenarios of the experiment {}; of the digests \
             of the runs in order {}.",
            source.name, source.rows, about.grid, source.digests
        )
    };
    report.results.sources.iter().map(of).collect()
}

/// Formats the cell of a verdict.
pub(super) fn verdict(line: &ClaimRow, column: usize) -> String {
    let ours = &line.ours[column];
    let doubt = if ours.firm || ours.verdict == Verdict::NotRun {
        ""
    } else {
        " ?"
    };
    format!("{}{doubt}", ours.verdict.words())
}
