//! `reveille compare`: runs side by side, with their actions, scenario fields, metrics, digests and first difference;
//! of sweeps, the differences between policies and tables. Programs of users read the keys of `--json`, here and in the
//! submodules, so do not rename them. The text fits 80 columns (`tests/program/compare.rs`).

mod messages;
mod rows;
mod run;
mod sweep;
mod tables;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::process::ExitCode;

use anyhow::bail;
use reveille_bs::scenario::compare_scenarios;
use reveille_common::digits::decimals_for;
use reveille_common::message::{Change, OperatorAction};
use reveille_common::score::Metrics;
use serde_json::{Value, json};

use crate::action_text::{FAILURE_NOTE, describe_actions, name_actions};
use crate::cli::CompareArgs;
use crate::display::{WIDTH, print_stdout, wrap_indented, wrap_text};
use crate::exit::{ExitReason, InvalidUsage};
use crate::results_table::{MAIN_METRICS, MISDETECTION_METRIC, format_number, is_cause};
use run::{ComparedRun, Difference};

/// Width of the names of metrics, and of the cell of a run, in columns. With [`MAX_COLUMNS`] cells a line must fit into
/// [`WIDTH`].
const NAME_WIDTH: usize = 28;
const CELL_WIDTH: usize = 17;
/// Most runs in a table, run 1 included; more runs make further tables, each with run 1.
const MAX_COLUMNS: usize = 3;

/// Compares runs, or the policies of sweeps.
pub(crate) fn run(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let (sweeps, runs): (Vec<_>, Vec<_>) = args.runs.iter().partition(|path| sweep::is_sweep(path));
    match (sweeps.is_empty(), runs.iter().find(|path| !path.exists())) {
        (true, _) => compare_runs(args),
        (false, _) if runs.is_empty() => sweep::compare(args),
        (false, Some(missing)) => bail!(
            "{}: no such file or folder; name a sweep folder or a result table",
            missing.display()
        ),
        (false, None) => bail!(InvalidUsage(
            "sweeps and runs do not compare; name only runs, or only sweep folders and result tables".to_owned()
        )),
    }
}

fn compare_runs(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    if args.runs.len() < 2 {
        if !args.runs[0].exists() {
            bail!(
                "{}: no such file or folder; name a run folder, a recording or a sweep",
                args.runs[0].display()
            );
        }
        bail!(InvalidUsage(format!(
            "{}: one run has nothing to be compared with; name at least two runs, or a sweep",
            args.runs[0].display()
        )));
    }
    if args.against.is_some() || !args.metric.is_empty() {
        bail!(InvalidUsage(
            "--against and --metric need a sweep; leave them out, and use --all-metrics for runs".to_owned()
        ));
    }
    let runs = args
        .runs
        .iter()
        .map(|path| ComparedRun::open(path))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let (first, others) = runs.split_first().expect("at least two runs");
    let fields = differing_fields(&runs)?;
    let differences = (2..)
        .zip(others)
        .map(|(number, other)| first.compare(other, number))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let output = if args.json {
        json_report(&runs, &fields, &differences).to_string() + "\n"
    } else {
        text_report(args, &runs, &fields, &differences)
    };
    print_stdout(&output)?;
    if let Some(torn) = differences.iter().find_map(|difference| difference.torn.as_ref()) {
        bail!("{torn}");
    }
    Ok(
        if !args.exit_code || differences.iter().all(|difference| difference.is_equal) {
            ExitReason::Done.into()
        } else {
            ExitReason::Failed.into()
        },
    )
}

/// Returns the scenario fields in which the runs differ, with the value of each run, in their order.
fn differing_fields(runs: &[ComparedRun]) -> anyhow::Result<BTreeMap<String, Vec<String>>> {
    let (first, others) = runs.split_first().expect("at least two runs");
    let mut fields: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (index, other) in (1..).zip(others) {
        for (field, first_value, value) in compare_scenarios(first.scenario_text(), other.scenario_text())? {
            fields.entry(field).or_insert_with(|| vec![first_value; runs.len()])[index] = value;
        }
    }
    Ok(fields)
}

fn json_report(runs: &[ComparedRun], fields: &BTreeMap<String, Vec<String>>, differences: &[Difference]) -> Value {
    let run_json = |run: &ComparedRun| {
        let summary = run.summary();
        let half_widths = Metrics::ALL
            .iter()
            .filter_map(|metric| Some((metric.name, run.half_width(metric.name)?)));
        json!({
            "run": run.name(),
            "digest": run.digest(),
            "status": summary["status"],
            "actions": run.actions().len(),
            "first_actions": name_actions(run.actions()),
            "metrics": summary["metrics"],
            "half_widths": half_widths.collect::<BTreeMap<_, _>>(),
        })
    };
    let difference_json = |difference: &Difference| json!({ "equal": difference.is_equal, "first": difference.text });
    json!({
        "runs": runs.iter().map(run_json).collect::<Vec<_>>(),
        "fields": fields,
        "differences": differences.iter().map(difference_json).collect::<Vec<_>>(),
    })
}

fn text_report(
    args: &CompareArgs,
    runs: &[ComparedRun],
    fields: &BTreeMap<String, Vec<String>>,
    differences: &[Difference],
) -> String {
    let mut text = String::new();
    for (number, run) in (1..).zip(runs) {
        let digest = run
            .digest()
            .map_or("no digest", |digest| digest.get(..8).unwrap_or(digest));
        let line = format!("run {number}: {}  ({}digest {digest})", run.name(), run.state());
        text += &(wrap_text(&line, WIDTH) + "\n");
        if let Some(line) = describe_actions(run.actions()) {
            text += &(wrap_indented(&line, WIDTH, 2) + "\n");
        }
    }
    text += if fields.is_empty() {
        "\nno scenario field differs\n"
    } else {
        "\nscenario fields that differ\n"
    };
    for (field, values) in fields {
        text += &(wrap_indented(&format!("{field} = {}", values.join(" | ")), WIDTH, 2) + "\n");
    }
    let (first, others) = runs.split_first().expect("at least two runs");
    for (block, columns) in others.chunks(MAX_COLUMNS - 1).enumerate() {
        let shown_others = block * (MAX_COLUMNS - 1);
        text += &format_metrics(args.all_metrics, first, (shown_others + 2, columns));
    }
    let is_failure = |action: &OperatorAction| matches!(action.change, Change::Fail(_));
    if runs.iter().any(|run| run.actions().iter().any(is_failure)) {
        text += FAILURE_NOTE;
    }
    if runs
        .iter()
        .any(|run| MAIN_METRICS.iter().any(|metric| run.half_width(metric).is_some()))
    {
        // `PARTS` in `run` is the number of parts.
        text += "±: half-width of the 95 % interval of one run, from ten parts of its measured\n   TTIs; \
                 none with fewer than ten cases, or if the interval would reach below 0\n";
    }
    text.push('\n');
    for (number, difference) in (2..).zip(differences) {
        let line = format!("run 1 and run {number}: {}", difference.text);
        // A difference between messages is already divided into lines, with their own indentation.
        for line in line.lines() {
            let spaces = line.len() - line.trim_start().len();
            text += &(wrap_indented(line.trim_start(), WIDTH, spaces) + "\n");
        }
    }
    text
}

/// Formats the main metrics, or all of them, of the first run and of `others`, which are numbered from `first_number`.
/// A second line shows the difference from the first run. As in the results table of a run, the causes of missed events
/// follow their share.
fn format_metrics(shows_all: bool, first: &ComparedRun, (first_number, others): (usize, &[ComparedRun])) -> String {
    let cell = |text: &str| format!("{text:>CELL_WIDTH$}");
    let mut text = format!("\n{:<NAME_WIDTH$}{}", "metric", cell("run 1"));
    for number in first_number..first_number + others.len() {
        text += &cell(&format!("run {number}"));
    }
    text.push('\n');
    for (indent, name) in shown_metrics(shows_all, || std::iter::once(first).chain(others)) {
        let (mut values, mut changes) = (cell(&value_cell(first, name)), String::new());
        for other in others {
            values += &cell(&value_cell(other, name));
            changes += &cell(&change_cell(first, other, name));
        }
        let label = format!("{indent}{name}");
        let _infallible = writeln!(text, "{label:<NAME_WIDTH$}{values}");
        if !changes.trim().is_empty() {
            let _infallible = writeln!(text, "{:<NAME_WIDTH$}{}{changes}", "", cell(""));
        }
    }
    text
}

/// The names of the shown metrics with their indentation. `runs` returns the runs of the table.
fn shown_metrics<'r, R>(shows_all: bool, runs: impl Fn() -> R) -> Vec<(&'static str, &'static str)>
where
    R: Iterator<Item = &'r ComparedRun>,
{
    let all_names = || Metrics::ALL.iter().map(|metric| metric.name);
    let mut shown = Vec::new();
    for name in MAIN_METRICS {
        shown.push(("", name));
        if name == MISDETECTION_METRIC && !shows_all {
            let causes = all_names().filter(|name| is_cause(name) && runs().any(|run| run.metric(name) > 0.0));
            shown.extend(causes.map(|cause| ("  ", cause)));
        }
    }
    if shows_all {
        shown.extend(
            all_names()
                .filter(|name| !MAIN_METRICS.contains(name))
                .map(|name| ("", name)),
        );
    }
    shown
}

fn value_cell(run: &ComparedRun, metric: &str) -> String {
    let value = format_number(run.metric(metric));
    match run.half_width(metric) {
        // More than two significant digits of the uncertainty would fill the cell.
        Some(half_width) if half_width > 0.0 => format!("{value} ±{:.*}", decimals_for(half_width, 2), half_width),
        _ => value,
    }
}

/// Formats the difference of a metric and its share of the first value; empty without a difference, or if a value is
/// NaN. If a run has few cases, the share is left out, since chance dominates it.
fn change_cell(first_run: &ComparedRun, other_run: &ComparedRun, metric: &str) -> String {
    let (first, other) = (first_run.metric(metric), other_run.metric(metric));
    let change = other - first;
    if change.is_nan() || change == 0.0 {
        return String::new();
    }
    let share = 100.0 * change / first.abs();
    let has_few_cases = first_run.has_few_cases(metric) || other_run.has_few_cases(metric);
    if !has_few_cases && share.is_finite() && (0.5..1000.0).contains(&share.abs()) {
        format!("{} ({share:+.0} %)", format_signed(change))
    } else {
        format_signed(change)
    }
}

/// Formats a difference with its sign and three significant digits.
fn format_signed(change: f64) -> String {
    let sign = if change < 0.0 { '-' } else { '+' };
    let size = change.abs();
    format!("{sign}{size:.*}", decimals_for(size, 3))
}
