//! The results of a run as text, for the end of `run`, `up` and `bs`. Its data are the fields of `summary.json`.
//! README.md and `docs/tutorial.md` show it, and `tests/program/tutorial.rs` compares the tutorial with the output.

use clap::builder::styling::Style;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Attribute, Cell, CellAlignment, Color, Table};
use reveille_bs::policy::registry;
use reveille_common::digits::format_significant;
use reveille_common::radio::RadioSettings;
use reveille_common::score::{EventActivity, MetricGroup, Metrics};
use reveille_common::totals::{DeviceTotals, MissCause};

use crate::display::{WIDTH, count_noun, wrap_text};
use crate::summary::{ClassSummary, Summary};

/// The metrics of the results table, in its order: information, missed events and delay, energy and batteries,
/// messages, wrong activations. A policy that wakes no device has no wake-ups per event. The first is the headline
/// metric. `compare` uses the list too, `docs/results.md` repeats it, and the help of `--all-metrics` and
/// [`Rows::Main`] repeat its length.
pub(crate) const MAIN_METRICS: [&str; 10] = [
    "info_p1",
    MISDETECTION_METRIC,
    "detection_delay_ttis",
    "energy_per_device_tti",
    "mean_battery",
    "low_energy_pct",
    "no_power_pct",
    "reports_per_event",
    "wake_ups_per_event",
    "wrong_activations_per_event",
];

/// The metric below which this table and `compare` list the causes of missed events.
pub(crate) const MISDETECTION_METRIC: &str = "misdetection_pct";

/// Whether a radio has a certain impairment.
type HasImpairment = fn(&RadioSettings) -> bool;

/// The metrics that are always 0 without a certain radio impairment, and whether the radio has the impairment. A new
/// impairment of `RadioSettings` needs an entry.
const IMPAIRMENTS: [(&str, HasImpairment); 5] = [
    ("lost_reports_pct", |radio| {
        radio.uplink_loss > 0.0 || radio.bursts.is_some()
    }),
    ("missed_plans_pct", |radio| {
        radio.plan_loss > 0.0 || radio.bursts.is_some()
    }),
    ("late_wake_ups_pct", |radio| radio.wake_latency > 0),
    ("wake_up_span_ttis", |radio| radio.wake_latency > 0),
    ("false_wake_ups_pct", |radio| {
        radio.false_wake_up > 0.0 || radio.wake_latency > 0
    }),
];

/// The metric of a policy that wakes devices.
const WAKE_UPS_METRIC: &str = "wake_ups_per_event";

/// The style of the title.
const BOLD: Style = Style::new().bold();

/// The metric that is 0 unless `--on-loss continue` has removed devices.
const REMOVED_METRIC: &str = "removed_pct";

/// Rows of the results table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rows {
    /// The ten metrics that runs are compared by, the causes of missed events, and the metrics of radio impairments
    /// that the scenario has.
    Main,
    /// All metrics.
    All,
}

/// Formats the results of a run, with escape codes of colours if `is_coloured`. The last line has the digest.
/// The tests keep lines to 80 columns.
pub(crate) fn format_results(summary: &Summary<'_>, rows: Rows, is_coloured: bool) -> String {
    let title = format!(
        "{} · {} · {} of {} · preset {} · seed {}",
        summary.policy,
        count_noun(summary.n, "device"),
        summary.ttis_done,
        count_noun(summary.ttis, "TTI"),
        summary.preset_label,
        summary.seed
    );
    let title = wrap_text(&title, WIDTH);
    let mut lines = vec![
        if is_coloured {
            format!("{BOLD}{title}{BOLD:#}")
        } else {
            title
        },
        format_metrics(summary, rows, is_coloured),
        format!(
            "{} of {} missed",
            summary.totals.events.misdetected,
            count_noun(summary.totals.events.events, "event")
        ),
    ];
    lines.extend(format_classes(&summary.classes, rows));
    lines.extend(format_facts(summary));
    if rows == Rows::All {
        lines.push(format_energy_balance(&summary.totals.energy));
    }
    lines.push(format_timing(summary));
    if summary.timing.late_ttis > 0 {
        let (late_ttis, max_late_ms) = (summary.timing.late_ttis, summary.timing.max_late_ms);
        lines.push(format!(
            "{} began late, by at most {max_late_ms:.1} ms",
            count_noun(late_ttis, "TTI")
        ));
    }
    if summary.metrics.removed_pct > 0.0 {
        lines.push(format!(
            "{:.2} % of device-TTIs belong to removed devices, which spend no energy",
            summary.metrics.removed_pct
        ));
    }
    if summary.status != "complete" {
        lines.push(if summary.totals.ttis == 0 {
            "interrupted before the end of the warm-up: no TTI was measured".to_owned()
        } else {
            "interrupted: the results cover the TTIs that were run".to_owned()
        });
    }
    lines.push(format!("digest {}\n", summary.digest));
    lines.join("\n")
}

/// Whether `metric` is the share of a cause of missed events.
pub(crate) fn is_cause(metric: &str) -> bool {
    metric.starts_with("missed_")
        && MissCause::ALL
            .iter()
            .any(|cause| metric == format!("missed_{}_pct", cause.name()))
}

/// Whether `metric` is 0 unless the scenario has an impairment or `--on-loss continue` has removed devices.
fn is_optional(metric: &str) -> bool {
    metric == REMOVED_METRIC || IMPAIRMENTS.iter().any(|(name, _)| *name == metric)
}

/// Returns whether `metric`, if [`is_optional`], has a row in the table of a run with `radio`, in which it has this
/// value. True for every other metric.
fn has_row(metric: &str, value: f64, radio: &RadioSettings) -> bool {
    let impairment = IMPAIRMENTS.iter().find(|(name, _)| *name == metric);
    impairment.is_none_or(|(_, has_impairment)| has_impairment(radio)) && (metric != REMOVED_METRIC || value > 0.0)
}

/// Formats the metrics in `rows`. With [`Rows::All`] the metrics below the main ones are grouped.
fn format_metrics(summary: &Summary<'_>, rows: Rows, is_coloured: bool) -> String {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    if is_coloured {
        table.enforce_styling();
    } else {
        table.force_no_tty();
    }
    let heading = |text: &str| Cell::new(text).add_attribute(Attribute::Bold);
    table.set_header(["metric", "value", "unit"].map(heading));
    let metric_rows = summary.metrics.rows();
    let format_row = |indent: &str, (name, value, unit): (&str, f64, &str)| {
        let cells = [format!("{indent}{name}"), format_number(value), unit.to_owned()].map(Cell::new);
        if name == MAIN_METRICS[0] {
            return cells.map(|cell| cell.add_attribute(Attribute::Bold));
        }
        let is_missed = name == MISDETECTION_METRIC || is_cause(name);
        cells.map(|cell| {
            if is_missed && value > 0.0 {
                cell.fg(Color::Yellow)
            } else {
                cell
            }
        })
    };
    let wakes = registry::named(summary.policy).is_none_or(|policy| policy.wakes);
    let main_names = MAIN_METRICS
        .iter()
        .filter(|name| wakes || rows == Rows::All || **name != WAKE_UPS_METRIC);
    for main_row in main_names.filter_map(|name| metric_rows.iter().find(|row| row.0 == *name)) {
        table.add_row(format_row("", *main_row));
        if main_row.0 == MISDETECTION_METRIC && rows == Rows::Main {
            for cause_row in metric_rows
                .iter()
                .filter(|(name, value, _)| is_cause(name) && *value > 0.0)
            {
                table.add_row(format_row("  ", *cause_row));
            }
        }
    }
    match rows {
        Rows::Main => {
            for (name, value, unit) in metric_rows {
                if is_optional(name) && has_row(name, value, &summary.radio) {
                    table.add_row(format_row("", (name, value, unit)));
                }
            }
        }
        Rows::All => {
            for group in MetricGroup::ALL {
                table.add_row([heading(&group.title().to_uppercase())]);
                for (metric, metric_row) in Metrics::ALL.iter().zip(metric_rows) {
                    if metric.group == group && !MAIN_METRICS.contains(&metric_row.0) {
                        table.add_row(format_row("  ", metric_row));
                    }
                }
            }
        }
    }
    if let Some(column) = table.column_mut(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.to_string()
}

/// Formats the device classes in columns, if there are several.
fn format_classes(classes: &[ClassSummary<'_>], rows: Rows) -> Option<String> {
    if classes.is_empty() {
        return None;
    }
    let mut table = Table::new();
    let names = classes
        .iter()
        .map(|class| format!("{} ({})", class.name, count_noun(class.n, "device")));
    table
        .load_style(UTF8_FULL_CONDENSED)
        .set_header(std::iter::once("by class".to_owned()).chain(names));
    let by_device = Metrics::ALL.iter().filter(|metric| metric.is_by_device());
    for metric in by_device.filter(|metric| rows == Rows::All || MAIN_METRICS.contains(&metric.name)) {
        let values = classes.iter().map(|class| {
            class
                .metrics
                .get(metric.name)
                .map_or_else(String::new, |value| format_number(*value))
        });
        table.add_row(std::iter::once(metric.name.to_owned()).chain(values));
    }
    for (row, (name, _)) in EventActivity::default().rows().into_iter().enumerate() {
        let values = classes.iter().map(|class| class.activity.rows()[row].1.to_string());
        table.add_row(std::iter::once(name.to_owned()).chain(values));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    Some(table.to_string())
}

/// Formats the policy's facts; `None` without facts.
fn format_facts(summary: &Summary<'_>) -> Option<String> {
    let facts = summary.policy_facts.iter();
    let facts: Vec<String> = facts
        .map(|(name, value)| format!("{name} {}", format_number(*value)))
        .collect();
    (!facts.is_empty()).then(|| facts.join(" · "))
}

/// Formats the measured energy of all devices as an equation of rounded numbers. `≠` marks an imbalance in micro-units.
fn format_energy_balance(energy: &DeviceTotals) -> String {
    let DeviceTotals {
        initial,
        harvested,
        overflow,
        battery,
        ..
    } = *energy;
    let spent = energy.spent.total();
    let is_exact = initial + harvested == spent + overflow + battery;
    let [initial, harvested, spent, overflow, battery] =
        [initial, harvested, spent, overflow, battery].map(|amount| format_number(amount.units()));
    let sign = if is_exact { "≈" } else { "≠" };
    format!("energy: {initial} + {harvested} harvested {sign} {spent} spent + {overflow} lost + {battery} left")
}

/// Formats the speed of the run, and its hosts and their memory if any.
fn format_timing(summary: &Summary<'_>) -> String {
    let timing = &summary.timing;
    let mut parts = vec![format!("{:.0} TTIs/s", timing.ttis_per_s)];
    if timing.hosts > 0 {
        let plural = if timing.hosts == 1 { "" } else { "es" };
        parts.push(format!(
            "{} process{plural} ready in {:.2} s",
            timing.hosts, timing.ready_s
        ));
        parts.push(format!("{} barriers", timing.grants));
    }
    let mut lines = vec![parts.join(" · ")];
    if let (Some(rss), Some(pss)) = (timing.host_rss_mb, timing.host_pss_mb) {
        lines.push(format!("{rss:.1} MB resident ({pss:.1} MB PSS) per process"));
    }
    lines.join("\n")
}

/// Formats a value of the table with four significant digits.
pub(crate) fn format_number(value: f64) -> String {
    format_significant(value, 4)
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, Scenario, load};
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

    use super::*;
    use crate::summary::Timing;

    /// Runs `quick` with these overrides, and returns its scenario, main results and all results.
    fn run_quick(set: &[&str]) -> (Scenario, [String; 2]) {
        let overrides: Vec<Override> = set
            .iter()
            .map(|text| Override::parse(text).expect("FIELD=VALUE"))
            .collect();
        let scenario = load("quick", &overrides).expect("a scenario").scenario;
        let prepared = prepare(&scenario);
        let options = RunOptions {
            lookahead: true,
            window: scenario.run.ttis,
        };
        let outcome = Run::new(&prepared, options).finish(&mut ());
        let summary = Summary::new(&scenario, &outcome, Timing::default());
        let texts = [Rows::Main, Rows::All].map(|rows| format_results(&summary, rows, false));
        (scenario, texts)
    }

    /// Returns the names in the first column of the first table of `text`, without titles.
    fn metric_names(text: &str) -> Vec<&str> {
        let table = text.lines().skip(1).take_while(|line| !line.starts_with('└'));
        let cells = table.filter_map(|line| line.split(['│', '┆']).nth(1));
        let names = cells.map(str::trim).filter(|name| Metrics::find(name).is_some());
        names.collect()
    }

    #[test]
    fn tables_contain_existing_metrics() {
        let impairments = IMPAIRMENTS.iter().map(|(name, _)| *name);
        for name in MAIN_METRICS.into_iter().chain(impairments).chain([REMOVED_METRIC]) {
            assert!(Metrics::ALL.iter().any(|metric| metric.name == name), "{name}");
        }
    }

    #[test]
    fn results_have_the_main_metrics_with_causes_and_all_on_request() {
        let (_, [main, all]) = run_quick(&["devices=12"]);
        let shown = metric_names(&main);
        let causes: Vec<&str> = shown.iter().copied().filter(|name| is_cause(name)).collect();
        assert!(!causes.is_empty(), "{main}");
        assert_eq!(shown[..2], MAIN_METRICS[..2]);
        assert_eq!(shown[2..2 + causes.len()], causes, "below the missed events");
        let without_causes: Vec<&str> = shown.iter().copied().filter(|name| !is_cause(name)).collect();
        assert_eq!(without_causes, MAIN_METRICS);
        let (_, [random_results, _]) = run_quick(&["policy.name=random"]);
        assert!(
            !metric_names(&random_results).contains(&WAKE_UPS_METRIC),
            "random wakes no device: {random_results}"
        );
        let shown = metric_names(&all);
        assert_eq!(shown[..MAIN_METRICS.len()], MAIN_METRICS);
        for metric in &Metrics::ALL {
            let occurrences = shown.iter().filter(|name| **name == metric.name).count();
            assert_eq!(occurrences, 1, "{}: {all}", metric.name);
        }
        for part in [" events missed", " TTIs/s", "digest "] {
            assert!(main.contains(part) && all.contains(part), "no {part:?}: {main}");
        }
        for line in main
            .lines()
            .chain(all.lines())
            .filter(|line| !line.starts_with("digest"))
        {
            assert!(line.chars().count() <= 80, "{line}");
        }
    }

    #[test]
    fn a_radio_impairment_adds_its_rows() {
        for (set, rows) in [
            (&[][..], &[][..]),
            (&["radio.uplink_loss=0.1"], &["lost_reports_pct"]),
            (&["radio.plan_loss=0.1"], &["missed_plans_pct"]),
            (&["radio.false_wake_up=0.1"], &["false_wake_ups_pct"]),
            (
                &["radio.wake_latency=2"],
                &["late_wake_ups_pct", "wake_up_span_ttis", "false_wake_ups_pct"],
            ),
            (
                &["radio.interference=bursts"],
                &["lost_reports_pct", "missed_plans_pct"],
            ),
        ] {
            let (scenario, [main, _]) = run_quick(set);
            assert_eq!(scenario.radio.is_perfect(), set.is_empty(), "{set:?}");
            let shown = metric_names(&main);
            for (name, _) in IMPAIRMENTS {
                assert_eq!(shown.contains(&name), rows.contains(&name), "{set:?}: {name}: {main}");
            }
            assert!(!shown.contains(&REMOVED_METRIC), "{main}");
        }
    }

    #[test]
    fn colours_change_no_letter() {
        let scenario = load("quick", &[]).expect("a scenario").scenario;
        let outcome = Run::new(&prepare(&scenario), RunOptions::default()).finish(&mut ());
        let summary = Summary::new(&scenario, &outcome, Timing::default());
        let [plain, coloured] = [false, true].map(|colours| format_results(&summary, Rows::Main, colours));
        assert!(
            !plain.contains('\u{1b}') && coloured.contains("\u{1b}[1m"),
            "{coloured:?}"
        );
        let without_codes = coloured
            .split('\u{1b}')
            .enumerate()
            .map(|(nth, part)| match (nth, part.split_once('m')) {
                (1.., Some((_, text))) => text,
                _ => part,
            });
        assert_eq!(without_codes.collect::<String>(), plain);
    }
}
