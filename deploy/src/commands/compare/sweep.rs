//! Differences between the policies of sweeps, over the same seeds, and between sweeps (see `tables`).
//! `study/src/figures/paired.rs` computes them. Programs of users read the keys of the JSON.

use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use reveille_common::io::Disk;
use reveille_common::score::Metrics;
use reveille_study::figures::paired::PairedDifference;
use reveille_study::figures::results::{Results, RunCondition};
use serde_json::{Value, json};

use super::rows::{DifferenceRow, format_blocks};
use super::tables::{self, TableDifference};
use crate::action_text::FAILURE_NOTE;
use crate::cli::CompareArgs;
use crate::commands::figure_files::read_named_tables;
use crate::display::{WIDTH, note, print_stdout, wrap_text};
use crate::exit::{ExitReason, InvalidUsage};
use crate::run_folder::SCENARIO_FILE;

/// Metrics that are compared by default; the help of `--metric` repeats them.
const DEFAULT_METRICS: [&str; 5] = [
    "info_p1",
    "misdetection_pct",
    "detection_delay_ttis",
    "energy_per_device_tti",
    "info_per_energy",
];

/// Whether `path` is the folder of a sweep or a result table, and not a run folder or a recording.
/// `lab/src/sweep/folder.rs` names the files that identify a sweep; the names are repeated here.
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
    let tables = read_named_tables(&args.runs)?;
    let results = Results::new(&tables, &Disk)?;
    let reference = reference_policy(args, &results)?;
    let metrics: Vec<&str> = match (args.metric.as_slice(), args.all_metrics) {
        ([], true) => Metrics::ALL.iter().map(|metric| metric.name).collect(),
        ([], false) => DEFAULT_METRICS.to_vec(),
        (given, _) => given.iter().map(String::as_str).collect(),
    };
    let mut conditions = Vec::new();
    for condition in &results.conditions {
        let rows = metrics
            .iter()
            .flat_map(|metric| compare_with_reference(condition, reference, metric));
        conditions.push((condition, rows.collect::<Vec<_>>()));
    }
    conditions.retain(|(_, rows)| args.json || !rows.is_empty());
    let separate_results = tables::read_separately(&tables)?;
    let table_differences = tables::compare(&separate_results, &metrics);
    if conditions.iter().all(|(_, rows)| rows.is_empty()) && table_differences.is_empty() {
        let pairs = if tables.len() > 1 {
            "no two policies and no two settings of a policy have"
        } else {
            "no two policies have"
        };
        let other = if reference == "random" { "knn" } else { "random" };
        bail!(
            "{}: nothing to compare: {pairs} runs with the same N and seeds; give one sweep several policies, such as \
             `reveille sweep --policies {reference},{other}`, or repeat it with the same N, seeds and --ttis",
            results.tables[0].name
        );
    }
    for name in tables::without_counterpart(&separate_results, &metrics) {
        note!(
            "{name}: not compared with {}, as no policy has runs in both with the same N, seeds and swept fields",
            separate_results[0].tables[0].name
        );
    }
    print_stdout(&if args.json {
        let mut report = json_report(reference, &conditions);
        report["tables"] = tables::json_report(&table_differences);
        report.to_string() + "\n"
    } else {
        text_report(reference, &conditions, &table_differences)
    })?;
    Ok(ExitReason::Done.into())
}

/// Returns the policy that the others are compared with, by its name in figures.
fn reference_policy<'r>(args: &'r CompareArgs, results: &'r Results) -> anyhow::Result<&'r str> {
    let mut policies: Vec<&str> = results.conditions.iter().flat_map(RunCondition::policies).collect();
    let mut distinct = std::collections::BTreeSet::new();
    policies.retain(|policy| distinct.insert(*policy));
    let reference = args.against.as_deref().or(results.tables[0].first_series.as_deref());
    match (
        &args.against,
        policies.iter().find(|policy| Some(**policy) == reference),
    ) {
        (_, Some(found)) => Ok(found),
        (Some(unknown), None) => bail!(
            "--against {unknown}: the sweep has no runs of this policy; use one of {}",
            policies.join(", ")
        ),
        // The name of the first table's policy can include a ranking, if only another table has a second ranking.
        (None, None) => Ok(policies[0]),
    }
}

/// Compares the other policies of a condition with the policy `reference`, by N.
fn compare_with_reference<'r>(
    condition: &'r RunCondition,
    reference: &'r str,
    metric: &'r str,
) -> Vec<DifferenceRow<'r>> {
    let others = condition.policies().into_iter().filter(|policy| *policy != reference);
    let row = |policy, n| {
        let comparison = PairedDifference::new((condition, policy), (condition, reference), n, metric)?;
        Some(DifferenceRow {
            metric,
            policy,
            n,
            comparison,
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

fn json_report(reference: &str, conditions: &[(&RunCondition, Vec<DifferenceRow<'_>>)]) -> Value {
    let condition_json = |(condition, rows): &(&RunCondition, Vec<DifferenceRow<'_>>)| {
        json!({
            "condition": condition.label(), "ttis": condition.ttis,
            "differences": rows.iter().map(DifferenceRow::to_json).collect::<Vec<_>>(),
        })
    };
    json!({ "against": reference, "conditions": conditions.iter().map(condition_json).collect::<Vec<_>>() })
}

fn text_report(
    reference: &str,
    conditions: &[(&RunCondition, Vec<DifferenceRow<'_>>)],
    table_differences: &[TableDifference<'_>],
) -> String {
    let mut sections: Vec<String> = table_differences.iter().map(tables::format_difference).collect();
    if !conditions.is_empty() {
        let line = format!("differences from {reference} over the same seeds, with 95 % intervals");
        let mut section = wrap_text(&line, WIDTH) + "\n";
        for (condition, rows) in conditions {
            let label = format!("preset {} · TTIs {}", condition.label(), condition.ttis);
            let _infallible = writeln!(section, "\n{}", wrap_text(&label, WIDTH));
            section += &format_blocks(reference, rows);
        }
        sections.push(section);
    }
    let mut text = sections.join("\n");
    text.push('\n');
    // The legend of the marks that `format_blocks` writes.
    let has_one_seed = |row: &DifferenceRow<'_>| row.comparison.half_width.is_nan();
    let is_unpaired = |row: &DifferenceRow<'_>| !row.comparison.is_paired && !has_one_seed(row);
    let table_rows = table_differences.iter().flat_map(|difference| &difference.rows);
    let mut rows = conditions.iter().flat_map(|(_, rows)| rows).chain(table_rows);
    text += "difference: mean over the seeds; interval: Student's t over the differences by\nseed\n";
    if table_differences.iter().any(TableDifference::has_failures) {
        text += FAILURE_NOTE;
    }
    if rows.clone().any(is_unpaired) {
        text += "~: too few cases for an interval of differences; the intervals of both means\n   are added\n";
    }
    if rows.any(has_one_seed) {
        text += "–: one seed has no interval; run the sweep with more --seeds\n";
    }
    text
}
