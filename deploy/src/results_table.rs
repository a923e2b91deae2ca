//! The results of a run as text, for the end of `run`, `up` and `bs`. Its data are the fields of `summary.json`. The
//! README and `docs/tutorial.md` show it, and `tests/program/tutorial.rs` compares the page with the output.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use reveille_common::digits::format_significant;
use reveille_common::radio::RadioSettings;
use reveille_common::score::{EventActivity, MetricGroup, Metrics};
use reveille_common::totals::MissCause;

use crate::summary::{ClassSummary, Summary};

/// The metrics of every results table, in its order.
///
/// The first three show the information that the base station gets, and its share and delay of detection. The next
/// three show the messages and the wrong activations behind them. The last four show the energy that they cost and
/// leave.
const MAIN_METRICS: [&str; 10] = [
    "info_p1",
    "misdetection_pct",
    "detection_delay_ttis",
    "reports_per_event",
    "wake_ups_per_event",
    "wrong_activations_per_event",
    "energy_per_device_tti",
    "mean_battery",
    "low_energy_pct",
    "unpowered_pct",
];

/// Whether a radio has a certain impairment.
type HasImpairment = fn(&RadioSettings) -> bool;

/// The metrics that are always 0 without a certain radio impairment, and whether the radio has the impairment.
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

/// The metric that is 0 unless `--on-loss continue` has removed devices.
const REMOVED_METRIC: &str = "removed_pct";

/// Rows of the results table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rows {
    /// The ten metrics that runs are compared by.
    Main,
    /// All metrics, without the rows of radio impairments that the scenario leaves off.
    All,
}

/// Formats the results of a run.
pub(crate) fn format_results(summary: &Summary<'_>, rows: Rows) -> String {
    let mut lines = vec![
        format!(
            "{} · {} devices · {} of {} TTIs · preset {} · seed {}",
            summary.policy, summary.n, summary.ttis_done, summary.ttis, summary.preset, summary.seed
        ),
        format_metrics(summary, rows),
        format_missed(summary),
    ];
    lines.extend(format_classes(&summary.classes, rows));
    lines.extend(format_facts(summary));
    lines.push(format_timing(summary));
    if summary.timing.late_ttis > 0 {
        let (late, most) = (summary.timing.late_ttis, summary.timing.max_late_ms);
        lines.push(format!("{late} TTIs began late, by at most {most:.1} ms"));
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

/// Returns whether `metric` belongs to the table of a run with `radio`, in which it has this value.
fn is_active(metric: &str, value: f64, radio: &RadioSettings) -> bool {
    let impairment = IMPAIRMENTS.iter().find(|(name, _)| *name == metric);
    impairment.is_none_or(|(_, has_impairment)| has_impairment(radio)) && (metric != REMOVED_METRIC || value > 0.0)
}

/// Formats the main metrics; with [`Rows::All`] also the other metrics, by group.
fn format_metrics(summary: &Summary<'_>, rows: Rows) -> String {
    let mut table = Table::new();
    table
        .load_style(UTF8_FULL_CONDENSED)
        .set_header(["metric", "value", "unit"]);
    let all = summary.metrics.rows();
    let main = MAIN_METRICS
        .iter()
        .filter_map(|name| all.iter().find(|row| row.0 == *name));
    for (name, value, unit) in main {
        table.add_row([(*name).to_owned(), format_number(*value), (*unit).to_owned()]);
    }
    if rows == Rows::All {
        for group in MetricGroup::ALL {
            table.add_row([group.title().to_uppercase(), String::new(), String::new()]);
            for (metric, (name, value, unit)) in Metrics::ALL.iter().zip(all) {
                let is_other = metric.group == group && !MAIN_METRICS.contains(&name);
                if is_other && is_active(name, value, &summary.radio) {
                    table.add_row([format!("  {name}"), format_number(value), unit.to_owned()]);
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
        .map(|class| format!("{} ({} devices)", class.name, class.n));
    table
        .load_style(UTF8_FULL_CONDENSED)
        .set_header(std::iter::once("by class".to_owned()).chain(names));
    let by_device = Metrics::ALL.iter().filter(|metric| metric.group.is_by_device());
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
        let values = classes.iter().map(|class| class.acts.rows()[row].1.to_string());
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

/// Formats the number of events and of missed events, with the share of each cause in all events.
fn format_missed(summary: &Summary<'_>) -> String {
    let (events, missed) = (summary.totals.events, summary.totals.missed);
    let counts = MissCause::ALL.map(|cause| (missed.by_cause(cause), cause.explanation()));
    let causes: Vec<String> = counts
        .iter()
        .filter(|(count, _)| *count > 0)
        // A missed event was also counted, so `events` is above 0 here.
        .map(|(count, cause)| format!("{cause} {:.2} %", 100.0 * *count as f64 / events.events as f64))
        .collect();
    let causes = if causes.is_empty() {
        String::new()
    } else {
        format!(": {}", causes.join(", "))
    };
    format!("{} of {} events missed{causes}", events.misdetected, events.events)
}

/// Formats the speed of the run and its hosts.
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
    if timing.host_rss_mb > 0.0 {
        let (rss, pss) = (timing.host_rss_mb, timing.host_pss_mb);
        parts.push(format!("{rss:.1} MB ({pss:.1} MB unshared) per process"));
    }
    parts.join(" · ")
}

/// Formats a value of the table with four significant digits.
fn format_number(value: f64) -> String {
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
        let texts = [Rows::Main, Rows::All].map(|rows| format_results(&summary, rows));
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
    fn results_have_the_main_metrics_and_all_on_request() {
        let (_, [main, all]) = run_quick(&[]);
        assert_eq!(metric_names(&main), MAIN_METRICS);
        let shown = metric_names(&all);
        assert_eq!(shown[..MAIN_METRICS.len()], MAIN_METRICS);
        let inactive = IMPAIRMENTS.map(|(name, _)| name);
        for metric in &Metrics::ALL {
            let occurrences = shown.iter().filter(|name| **name == metric.name).count();
            let expected = usize::from(!inactive.contains(&metric.name) && metric.name != REMOVED_METRIC);
            assert_eq!(occurrences, expected, "{}: {all}", metric.name);
        }
        for part in [" events missed", " TTIs/s", "digest "] {
            assert!(main.contains(part) && all.contains(part), "no {part:?}: {main}");
        }
    }

    #[test]
    fn a_radio_impairment_adds_its_rows() {
        for (set, rows) in [
            (&["radio.uplink_loss=0.1"][..], &["lost_reports_pct"][..]),
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
            let (scenario, [main, all]) = run_quick(set);
            assert!(!scenario.radio.is_perfect(), "{set:?}");
            assert_eq!(metric_names(&main), MAIN_METRICS, "{set:?}");
            let shown = metric_names(&all);
            for (name, _) in IMPAIRMENTS {
                assert_eq!(shown.contains(&name), rows.contains(&name), "{set:?}: {name}: {all}");
            }
        }
    }
}
