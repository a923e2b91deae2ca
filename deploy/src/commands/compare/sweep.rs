//! Differences between the policies of sweeps, over the same seeds. `study/src/figures/paired.rs` computes them.

use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use reveille_common::digits::decimals_for;
use reveille_common::score::Metrics;
use reveille_study::figures::paired::PairedDifference;
use reveille_study::figures::results::{Results, RunCondition};
use serde_json::{Value, json};

use crate::cli::CompareArgs;
use crate::commands::figure_files::read_tables;
use crate::display::{print_stdout, wrap_text};
use crate::exit::{ExitReason, InvalidUsage};
use crate::results_table::format_number;
use crate::run_folder::SCENARIO_FILE;

/// Columns of a line of text.
const WIDTH: usize = 80;
/// Metrics that are compared by default.
const METRICS: [&str; 4] = [
    "info_p1",
    "misdetection_pct",
    "detection_delay_ttis",
    "energy_per_device_tti",
];

/// The difference of a policy from the reference policy.
struct Row<'r> {
    metric: &'r str,
    policy: &'r str,
    n: u32,
    found: PairedDifference,
}

/// Whether `path` is the folder of a sweep or a result table, and not a run folder or a recording.
pub(super) fn is_sweep(path: &Path) -> bool {
    let is_table = |ending: &std::ffi::OsStr| ending == "parquet" || ending == "csv";
    if path.is_dir() {
        let has = |name: &str| path.join(name).exists();
        return !has(SCENARIO_FILE) && (has("experiment.toml") || has("results.parquet") || has("results.csv"));
    }
    path.extension().is_some_and(is_table)
}

/// Compares the policies in the tables of sweeps.
pub(super) fn compare(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    if args.exit_code {
        bail!(InvalidUsage(
            "--exit-code needs runs, whose digests it compares; leave it out for sweeps".to_owned()
        ));
    }
    let results = read_tables(&args.runs)?;
    let reference = reference_policy(args, &results)?;
    let metrics: Vec<&str> = match (args.metric.as_slice(), args.all_metrics) {
        ([], true) => Metrics::ALL.iter().map(|metric| metric.name).collect(),
        ([], false) => METRICS.to_vec(),
        (given, _) => given.iter().map(String::as_str).collect(),
    };
    let mut conditions = Vec::new();
    for condition in &results.conditions {
        let rows = metrics.iter().flat_map(|metric| rows(condition, reference, metric));
        conditions.push((condition, rows.collect::<Vec<_>>()));
    }
    if conditions.iter().all(|(_, rows)| rows.is_empty()) {
        bail!(
            "{}: no other policy has runs with the N and seeds of {reference}; add policies to the sweep, with \
             `reveille sweep --policies`",
            results.tables[0].name
        );
    }
    print_stdout(&if args.json {
        json_report(reference, &conditions).to_string() + "\n"
    } else {
        text_report(reference, &conditions)
    })?;
    Ok(ExitReason::Done.into())
}

/// Returns the policy that the others are compared with, by its name in figures.
fn reference_policy<'r>(args: &'r CompareArgs, results: &'r Results) -> anyhow::Result<&'r str> {
    let mut policies: Vec<&str> = results.conditions.iter().flat_map(RunCondition::policies).collect();
    let mut seen = std::collections::BTreeSet::new();
    policies.retain(|policy| seen.insert(*policy));
    let wanted = args.against.as_deref().or(results.tables[0].first_policy.as_deref());
    match (&args.against, policies.iter().find(|policy| Some(**policy) == wanted)) {
        (_, Some(found)) => Ok(found),
        (Some(unknown), None) => bail!(
            "--against {unknown}: the sweep has no runs of this policy; use one of {}",
            policies.join(", ")
        ),
        // Its name can include a ranking that only another table has.
        (None, None) => Ok(policies[0]),
    }
}

/// Compares the policies of a condition with `reference`, by N.
fn rows<'r>(condition: &'r RunCondition, reference: &'r str, metric: &'r str) -> Vec<Row<'r>> {
    let others = condition.policies().into_iter().filter(|policy| *policy != reference);
    let row = |policy, n| {
        let found = PairedDifference::new(condition, (policy, reference), n, metric)?;
        Some(Row {
            metric,
            policy,
            n,
            found,
        })
    };
    others
        .flat_map(|policy| {
            condition
                .device_counts(policy)
                .into_iter()
                .filter_map(move |n| row(policy, n))
        })
        .collect()
}

fn json_report(reference: &str, conditions: &[(&RunCondition, Vec<Row<'_>>)]) -> Value {
    let row = |row: &Row<'_>| {
        let found = row.found;
        json!({
            "metric": row.metric, "policy": row.policy, "n": row.n, "seeds": found.seeds, "mean": found.mean,
            "against_mean": found.reference_mean, "difference": found.difference, "half_width": found.half_width,
            "paired": found.is_paired,
        })
    };
    let condition = |(condition, rows): &(&RunCondition, Vec<Row<'_>>)| {
        json!({
            "condition": condition.label(), "ttis": condition.ttis,
            "differences": rows.iter().map(row).collect::<Vec<_>>(),
        })
    };
    json!({ "against": reference, "conditions": conditions.iter().map(condition).collect::<Vec<_>>() })
}

fn text_report(reference: &str, conditions: &[(&RunCondition, Vec<Row<'_>>)]) -> String {
    let line = format!("differences from {reference} over the same seeds, with 95 % intervals");
    let mut text = wrap_text(&line, WIDTH) + "\n";
    for (condition, rows) in conditions.iter().filter(|(_, rows)| !rows.is_empty()) {
        let label = format!("preset {} · TTIs {}", condition.label(), condition.ttis);
        let _infallible = writeln!(text, "\n{}", wrap_text(&label, WIDTH));
        for block in rows.chunk_by(|a, b| a.metric == b.metric) {
            text += &format_block(reference, block);
        }
    }
    text.push('\n');
    let is_unpaired = |row: &Row<'_>| !row.found.is_paired && !row.found.half_width.is_nan();
    let is_single = |row: &Row<'_>| row.found.half_width.is_nan();
    let mut rows = conditions.iter().flat_map(|(_, rows)| rows);
    text += "difference: mean over the seeds; interval: Student's t over the differences by\nseed\n";
    if rows.clone().any(is_unpaired) {
        text += "~: too few cases for an interval of differences; the intervals of both means\n   are added\n";
    }
    if rows.any(is_single) {
        text += "–: one seed has no interval; run the sweep with more --seeds\n";
    }
    text
}

/// Formats the differences by one metric.
fn format_block(reference: &str, rows: &[Row<'_>]) -> String {
    let metric = rows[0].metric;
    let unit = Metrics::find(metric).map_or("", |metric| metric.unit);
    let policy_width = rows
        .iter()
        .map(|row| row.policy.chars().count())
        .max()
        .unwrap_or(0)
        .max(6);
    let mut text = format!("\n{}\n", wrap_text(&format!("{metric}, {unit}"), WIDTH));
    // A long name of the reference would move the columns.
    let reference = if reference.chars().count() <= 10 {
        reference
    } else {
        "reference"
    };
    let _infallible = writeln!(
        text,
        "{:<policy_width$} {:>5} {:>5} {:>10} {:>10}   difference and interval",
        "policy", "N", "seeds", "mean", reference
    );
    for Row { policy, n, found, .. } in rows {
        let PairedDifference {
            difference, half_width, ..
        } = *found;
        let mark = if found.is_paired || half_width.is_nan() {
            ' '
        } else {
            '~'
        };
        let change = if half_width.is_finite() {
            // Two significant digits of the uncertainty; an interval of width 0 leaves four of the difference.
            let digits = if half_width > 0.0 {
                decimals_for(half_width, 2)
            } else {
                decimals_for(difference, 4)
            };
            format!("{difference:+.digits$} ±{half_width:.digits$}")
        } else {
            format!("{difference:+.4} –")
        };
        let _infallible = writeln!(
            text,
            "{policy:<policy_width$} {n:>5} {:>5} {:>10} {:>10} {mark} {change}",
            found.seeds,
            format_number(found.mean),
            format_number(found.reference_mean),
        );
    }
    text
}
