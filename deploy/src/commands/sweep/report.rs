//! The results of a sweep, as text and as JSON. Programs of users read the keys of the JSON, so do not rename them. The
//! text fits 80 columns (`tests/program/widths.rs`).

use std::path::Path;

use comfy_table::presets::UTF8_HORIZONTAL_ONLY;
use comfy_table::{CellAlignment, LineStyle, Table};
use reveille_common::digits::{decimals_for, format_significant};
use reveille_common::score::Metrics;
use reveille_common::totals::MissCause;
use reveille_lab::metric_estimate::MetricEstimate;
use reveille_lab::series::SeriesNames;
use reveille_lab::stats::{self, CellRuns, Estimate};
use reveille_lab::sweep::{CellSummary, Shard, SweepGrid, SweepResult};
use reveille_lab::table::SweptValue;
use serde_json::{Map, Value as Json, json};

use crate::cli::SweepArgs;
use crate::display::{WIDTH, count_noun, format_speed, wrap_text};

/// Heading of the number of runs of a cell.
const RUNS_HEADING: &str = "runs";
/// Most lines of a script of actions that are shown.
const MAX_SHOWN_LINES: usize = 3;
/// Index of the heading `policy` in the closing table.
const POLICY_COLUMN: usize = 1;

/// The metrics of the closing table and their short headings.
const CLOSING_METRICS: [(&str, &str); 6] = [
    ("info_p1", "info (P1)"),
    ("detection_delay_ttis", "delay"),
    ("misdetection_pct", "missed %"),
    ("energy_per_device_tti", "energy"),
    ("low_energy_pct", "low %"),
    ("mean_battery", "battery"),
];

/// A finished sweep.
pub(super) struct SweepSummary<'r> {
    /// The grid of the sweep.
    pub grid: &'r SweepGrid,
    /// Its results.
    pub result: &'r SweepResult,
    /// The folder of the sweep.
    pub folder: &'r Path,
    /// Number of runs taken from earlier calls.
    pub known_runs: usize,
    /// Duration of the other runs, seconds.
    pub seconds: f64,
    /// Device-TTIs of the other runs.
    pub device_ttis: u64,
    /// Number of threads.
    pub threads: usize,
}

impl SweepSummary<'_> {
    /// Formats a row per cell, and the path of the table of all runs.
    pub(super) fn to_text(&self) -> String {
        let cells = self.format_cells();
        let has_bounds = cells.contains('<');
        let mut lines = vec![
            cells,
            "mean and, below it, half-width of the 95 % interval over the runs".to_owned(),
        ];
        if has_bounds {
            lines.push("<: a one-sided 95 % bound, where an interval would need more cases".to_owned());
        }
        let script = self.result.table.metadata.action_script();
        lines.extend(script.map(|script| describe_script(&script)));
        lines.extend(self.format_wide_intervals());
        lines.push(self.format_run_count());
        let line = format!("one row per run in {}", self.result.path.display());
        lines.push(wrap_text(&line, WIDTH) + "\n");
        lines.join("\n")
    }

    /// Formats the cells as a table. Labels that all cells share form its title, so that it fits 80 columns.
    fn format_cells(&self) -> String {
        let names = SeriesNames::from_table(&self.result.table);
        let is_shown = |column: usize| names.ranking_column() != Some(column);
        let cells = stats::group_by_cell(&self.result.table);
        let cells = names.distinct_cells(&cells);
        let swept = self.result.table.schema.swept.iter().enumerate();
        let swept = swept
            .filter(|(column, _)| is_shown(*column))
            .map(|(_, (name, _))| name.as_str());
        let headings: Vec<&str> = ["preset", "policy", "N", "TTIs"]
            .into_iter()
            .chain(swept)
            .chain([RUNS_HEADING])
            .collect();
        let labels: Vec<Vec<String>> = cells
            .iter()
            .map(|cell| {
                let values = cell.swept.iter().enumerate().filter(|(column, _)| is_shown(*column));
                [
                    cell.preset.to_owned(),
                    names.name(cell.rows[0]),
                    cell.n.to_string(),
                    cell.ttis.to_string(),
                ]
                .into_iter()
                .chain(values.map(|(_, value)| value.to_string()))
                .chain([cell.rows.len().to_string()])
                .collect()
            })
            .collect();
        let is_shared = |column: &usize| labels.iter().all(|row| row[*column] == labels[0][*column]);
        // The policy stays a column: it names the rows.
        let (shared_columns, row_columns): (Vec<usize>, Vec<usize>) =
            (0..headings.len()).partition(|column| *column != POLICY_COLUMN && is_shared(column));
        let title = shared_columns.iter().filter_map(|column| {
            let value = labels.first()?.get(*column)?;
            Some(match headings[*column] {
                RUNS_HEADING => format!("{value} {} per row", if value == "1" { "run" } else { "runs" }),
                heading => format!("{heading} {value}"),
            })
        });
        let title = wrap_text(&title.collect::<Vec<_>>().join(" · "), WIDTH);
        let rows: Vec<(Vec<String>, &CellRuns<'_>)> = cells
            .iter()
            .zip(&labels)
            .map(|(cell, labels)| {
                (
                    row_columns.iter().map(|column| labels[*column].clone()).collect(),
                    *cell,
                )
            })
            .collect();
        let row_headings: Vec<&str> = row_columns.iter().map(|column| headings[*column]).collect();
        let mut blocks = vec![
            title,
            format_narrow_tables(&row_headings, &rows, &CLOSING_METRICS, format_estimate),
        ];
        blocks.extend(format_causes(&row_headings, &rows));
        blocks.join("\n")
    }

    /// Formats the number of runs, and the speed of the runs of this call.
    fn format_run_count(&self) -> String {
        let rows = self.result.table.rows.len();
        let line = match (self.known_runs, self.device_ttis) {
            (_, 0) => format!("{}, already finished", count_noun(rows, "run")),
            (known_runs, _) => {
                let known_text = match known_runs {
                    0 => String::new(),
                    known_runs => format!(", {known_runs} of them already finished; the others"),
                };
                format!(
                    "{}{known_text} in {} s on {}: {}",
                    count_noun(rows, "run"),
                    format_significant(self.seconds, 2),
                    count_noun(self.threads, "thread"),
                    format_speed(self.device_ttis as f64 / self.seconds.max(1e-9))
                )
            }
        };
        wrap_text(&line, WIDTH)
    }

    /// The cells whose intervals are wider than `until_ci` after all seeds: label, metric, and half-width as a share of
    /// the mean.
    fn wide_intervals(&self) -> Vec<(&str, &str, f64)> {
        let Some(until) = &self.grid.experiment.until_ci else {
            return Vec::new();
        };
        let cells = self.grid.cells.iter().zip(&self.result.cells);
        let wide_intervals = cells.filter_map(|(cell, CellSummary { widest, .. })| {
            let (metric, width) = widest.as_ref().filter(|(_, width)| *width > until.target)?;
            Some((cell.label.as_str(), metric.as_str(), *width))
        });
        wide_intervals.collect()
    }

    fn format_wide_intervals(&self) -> Vec<String> {
        let line = |(label, metric, width): (&str, &str, f64)| {
            let width = if width.is_finite() {
                format!("is {:.1} % of the mean", 100.0 * width)
            } else {
                "has no relative width, as its mean is 0 or only one run defines it".to_owned()
            };
            let seeds = count_noun(self.grid.experiment.seeds.count, "seed");
            let line = format!("{label}: --until-ci not reached with {seeds}: the interval of {metric} {width}");
            wrap_text(&line, WIDTH)
        };
        self.wide_intervals().into_iter().map(line).collect()
    }

    /// Returns the report as JSON.
    ///
    /// # Errors
    /// Never in practice.
    pub(super) fn to_json(&self) -> anyhow::Result<String> {
        let schema = &self.result.table.schema;
        let names = SeriesNames::from_table(&self.result.table);
        let cells: Vec<Json> = stats::group_by_cell(&self.result.table)
            .iter()
            .map(|cell| {
                let metrics: Map<String, Json> = Metrics::ALL
                    .iter()
                    .map(|metric| metric.name)
                    .map(|name| {
                        (
                            name.to_owned(),
                            cell.metric_estimate(name).map_or(Json::Null, estimate_json),
                        )
                    })
                    .collect();
                let values = schema.swept.iter().zip(cell.swept.iter());
                let swept: Map<String, Json> = values
                    .map(|((name, _), value)| (name.clone(), swept_json(value)))
                    .collect();
                json!({
                    "preset": cell.preset, "policy": cell.policy, "series": names.name(cell.rows[0]),
                    "n": cell.n, "ttis": cell.ttis, "swept": swept, "runs": cell.rows.len(), "metrics": metrics,
                })
            })
            .collect();
        let wide_intervals: Vec<Json> = self
            .wide_intervals()
            .into_iter()
            .map(|(label, metric, width)| json!({ "cell": label, "metric": metric, "relative_half_width": width }))
            .collect();
        let report = json!({
            "status": "complete",
            "folder": self.folder, "table": self.result.path,
            "runs": self.result.table.rows.len(), "found": self.known_runs,
            "threads": self.threads, "seconds": self.seconds, "device_ttis": self.device_ttis,
            "cells": cells, "not_narrow": wide_intervals, "actions": self.result.table.metadata.action_script(),
        });
        Ok(serde_json::to_string_pretty(&report)? + "\n")
    }
}

/// Formats the cells as one table with all `metrics`, or as several with fewer each where swept fields leave less room.
fn format_narrow_tables(
    row_headings: &[&str],
    rows: &[(Vec<String>, &CellRuns<'_>)],
    metrics: &[(&str, &str)],
    format_cell: FormatCell,
) -> String {
    let layouts = [metrics.len(), 3, 2, 1].map(|metrics_per_table| {
        let parts = metrics.chunks(metrics_per_table);
        let tables: Vec<String> = parts
            .map(|metrics| format_table(row_headings, rows, metrics, format_cell))
            .collect();
        tables.join("\n")
    });
    let [.., narrowest] = &layouts;
    let widest_that_fits = layouts.iter().find(|text| widest_line(text) <= WIDTH);
    widest_that_fits.unwrap_or(narrowest).clone()
}

/// Formats the causes of missed events that occur in any cell; `None` if no event was missed. A single cause is a
/// sentence, as the table above already has its numbers.
fn format_causes(row_headings: &[&str], rows: &[(Vec<String>, &CellRuns<'_>)]) -> Option<String> {
    let occurs = |metric: &str| {
        let mut estimates = rows.iter().filter_map(|(_, cell)| cell.metric_estimate(metric));
        estimates.any(|estimate| estimate.mean_estimate.mean > 0.0)
    };
    let causes = MissCause::ALL.iter().filter_map(|cause| {
        let metric = Metrics::find(&format!("missed_{}_pct", cause.name()))?.name;
        occurs(metric).then_some((*cause, metric))
    });
    match &causes.collect::<Vec<_>>()[..] {
        [] => None,
        [(cause, _)] => Some(wrap_text(
            &format!("cause of all missed events: {}", cause.explanation()),
            WIDTH,
        )),
        causes => {
            let headings: Vec<String> = causes.iter().map(|(cause, _)| cause.name().replace('_', " ")).collect();
            let metrics: Vec<(&str, &str)> = causes
                .iter()
                .zip(&headings)
                .map(|((_, metric), heading)| (*metric, heading.as_str()))
                .collect();
            let tables = format_narrow_tables(row_headings, rows, &metrics, format_mean);
            Some(format!("missed events by cause, % of events, means\n{tables}"))
        }
    }
}

/// Formats the estimate of a metric in a cell of a table.
type FormatCell = fn(Option<MetricEstimate>) -> String;

/// Formats a row for each cell with its labels, below `row_headings`, and `metrics`. Long headings of swept fields
/// break at dots.
fn format_table(
    row_headings: &[&str],
    rows: &[(Vec<String>, &CellRuns<'_>)],
    metrics: &[(&str, &str)],
    format_cell: FormatCell,
) -> String {
    let mut table = Table::new();
    let label_headings = row_headings.iter().map(|heading| heading.replace('.', ".\n"));
    let metric_headings = metrics.iter().map(|(_, heading)| (*heading).to_owned());
    table
        .load_style(UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none()))
        .set_header(label_headings.chain(metric_headings));
    for (labels, cell) in rows {
        let estimates = metrics.iter().map(|(metric, _)| {
            let text = format_cell(cell.metric_estimate(metric));
            text.replace(" ± ", "\n±").replace(", <", "\n<").replace(", >", "\n>")
        });
        table.add_row(labels.iter().cloned().chain(estimates));
    }
    // Names are aligned left, and the number next to the metrics right.
    for column in table
        .column_iter_mut()
        .skip(row_headings.len().saturating_sub(1).max(1))
    {
        column.set_cell_alignment(CellAlignment::Right);
    }
    for column in table.column_iter_mut() {
        column.set_padding((0, 1));
    }
    if let Some(last) = table.column_iter_mut().last() {
        last.set_padding((0, 0));
    }
    table.to_string()
}

/// The number of columns of the widest line of `text`.
fn widest_line(text: &str) -> usize {
    text.lines().map(|line| line.chars().count()).max().unwrap_or(0)
}

/// Describes a script of actions by its first lines, in lines of at most 80 columns.
fn describe_script(script: &str) -> String {
    let lines = script
        .lines()
        .map(|line| line.split('#').next().unwrap_or_default().trim());
    let lines: Vec<&str> = lines.filter(|line| !line.is_empty()).collect();
    let more = match lines.len().saturating_sub(MAX_SHOWN_LINES) {
        0 => String::new(),
        more => format!("; {}", count_noun(more, "more line")),
    };
    let shown = lines
        .iter()
        .take(MAX_SHOWN_LINES)
        .copied()
        .collect::<Vec<_>>()
        .join("; ");
    wrap_text(&format!("actions of every run: {shown}{more}"), WIDTH)
}

fn swept_json(value: &SweptValue) -> Json {
    match value {
        SweptValue::Int(value) => json!(value),
        SweptValue::Float(value) => json!(value),
        SweptValue::Text(value) => json!(value),
    }
}

fn estimate_json(estimate: MetricEstimate) -> Json {
    let Estimate {
        mean,
        deviation,
        half_width,
        runs,
    } = estimate.mean_estimate;
    json!({
        "mean": mean, "deviation": deviation, "half_width": half_width, "runs": runs,
        "upper_bound": estimate.upper_bound, "lower_bound": estimate.lower_bound,
    })
}

/// Formats the mean of an estimate; a dash without a value.
fn format_mean(estimate: Option<MetricEstimate>) -> String {
    estimate.map_or_else(
        || "–".to_owned(),
        |estimate| format_significant(estimate.mean_estimate.mean, 3),
    )
}

/// Formats an estimate as `0.1473 ± 0.0012`, with the digits that the interval justifies; `0.013, < 0.040` if there is
/// only a bound.
fn format_estimate(estimate: Option<MetricEstimate>) -> String {
    let Some(estimate) = estimate else {
        return "–".to_owned();
    };
    let Estimate { mean, half_width, .. } = estimate.mean_estimate;
    // Two significant digits of the uncertainty.
    let digits = |uncertainty: f64| decimals_for(uncertainty, 2);
    match estimate.upper_bound {
        Some(upper) if mean == 0.0 => format!("0, < {upper:.*}", digits(upper)),
        Some(upper) => format!("{mean:.digits$}, < {upper:.digits$}", digits = digits(upper)),
        None if estimate.lower_bound.is_some() => {
            let lower = estimate.lower_bound.unwrap_or(mean);
            format!("{mean:.0}, > {lower:.*}", digits(mean - lower))
        }
        // A single run has no interval.
        None if half_width == 0.0 || half_width.is_nan() => format_significant(mean, 4),
        None => {
            let digits = digits(half_width);
            format!("{mean:.digits$} ± {half_width:.digits$}")
        }
    }
}

/// Formats the grid and its cost, as JSON with `--json`.
pub(super) fn dry_run(args: &SweepArgs, grid: &SweepGrid, shard: Shard, folder: &Path) -> anyhow::Result<String> {
    let seeds = grid.experiment.seeds;
    let runs = grid.shard_run_count(shard);
    // In 128 bits: seeds × TTIs × devices of a large grid can exceed 64.
    let device_ttis: u128 = grid
        .cells
        .iter()
        .map(|cell| u128::from(cell.device_ttis()) * u128::from(seeds.count))
        .sum::<u128>()
        / u128::from(shard.count());
    if args.json {
        let labels: Vec<&str> = grid.cells.iter().map(|cell| cell.label.as_str()).collect();
        let plan = json!({
            "status": "dry-run", "folder": folder, "cells": labels, "seeds_first": seeds.first,
            "seeds_count": seeds.count, "shard": shard.to_string(), "runs": runs, "device_ttis": device_ttis as f64,
            "experiment": grid.experiment.to_toml(),
        });
        return Ok(serde_json::to_string_pretty(&plan)? + "\n");
    }
    let mut lines = vec![grid.experiment.to_toml()];
    lines.extend(grid.cells.iter().map(|cell| format!("  {}", cell.label)));
    let at_most = if grid.experiment.until_ci.is_some() {
        "at most "
    } else {
        ""
    };
    lines.push(format!(
        "\n{} × {} from {}: {at_most}{}{}, {} million device-TTIs",
        count_noun(grid.cells.len(), "cell"),
        count_noun(seeds.count as usize, "seed"),
        seeds.first,
        count_noun(runs as usize, "run"),
        if shard == Shard::WHOLE {
            String::new()
        } else {
            format!(" in shard {shard}")
        },
        format_significant(device_ttis as f64 / 1e6, 3)
    ));
    lines.push(format!(
        "every scenario is valid; results would go to {}\n",
        folder.display()
    ));
    Ok(lines.join("\n"))
}
