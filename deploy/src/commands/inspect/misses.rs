//! `reveille inspect misses`: where, when and why the events of a run were missed. Programs of users read the keys of
//! `--json`, so do not rename them. The text fits 80 columns; `docs/reading-results.md` shows it. `study/src/misses/`
//! finds the causes.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::process::ExitCode;

use reveille_common::ids::DeviceId;
use reveille_common::message::OperatorAction;
use reveille_common::totals::MissCause;
use reveille_study::misses::{Advice, InvolvedDevice, MissMap, Misses, cause_name};
use serde_json::{Value, json};

use crate::action_text::{describe_actions, name_actions};
use crate::cli::MissesArgs;
use crate::display::{WIDTH, print_stdout, wrap_text};
use crate::exit::ExitReason;
use crate::run_reader::{Row, RunReader};

/// Most parts of the run in the causes over time.
const MAX_BINS: u64 = 10;
/// Statistics of a device from `devices.csv`, also keys of `--json`; [`format_devices`] relies on their order.
const DEVICE_COLUMNS: [&str; 5] = [
    "final_battery",
    "low_ttis",
    "failed_ttis",
    "unpowered_ttis",
    "longest_outage_ttis",
];

/// Prints the missed events of a run.
pub(super) fn run(args: &MissesArgs) -> anyhow::Result<ExitCode> {
    let run = RunReader::open(&args.run)?;
    let misses = run.misses()?;
    let actions = run.actions()?;
    let devices = run.devices()?;
    let device_rows = devices
        .as_ref()
        .map_or_else(|| Ok(BTreeMap::new()), |table| table.by_device())?;
    let involved: Vec<InvolvedDevice> = misses.involved_devices().into_iter().take(args.devices).collect();
    let output = if args.json {
        json_report(&run, &misses, &actions, &involved, &device_rows)?.to_string() + "\n"
    } else {
        text_report(&run, &misses, &actions, &involved, &device_rows)
    };
    print_stdout(&output)?;
    Ok(ExitReason::Done.into())
}

fn json_report(
    run: &RunReader,
    misses: &Misses,
    actions: &[OperatorAction],
    involved: &[InvolvedDevice],
    device_rows: &BTreeMap<DeviceId, Row<'_>>,
) -> anyhow::Result<Value> {
    let map = misses.map();
    let causes = misses.causes();
    let device_json = |device: &InvolvedDevice| {
        let mut object = json!({
            "device": device.device,
            "missed": device.missed_count,
            "main_cause": cause_name(device.main_cause),
            "mean_distance_m": device.mean_distance_m,
        });
        if let Some(row) = device_rows.get(&device.device) {
            for column in DEVICE_COLUMNS {
                object[column] = json!(row.number::<f64>(column)?);
            }
        }
        Ok(object)
    };
    let bins = misses.bins(MAX_BINS).into_iter().map(|bin| {
        let by_cause = causes
            .iter()
            .zip(&bin.missed_by_cause)
            .map(|((cause, _), count)| (cause_name(*cause), *count));
        json!({
            "first_tti": bin.first,
            "end_tti": bin.end,
            "events": bin.events,
            "missed": bin.missed_by_cause.iter().sum::<u64>(),
            "causes": by_cause.collect::<BTreeMap<_, _>>(),
        })
    });
    let by_cause = causes.iter().map(|(cause, count)| (cause_name(*cause), *count));
    Ok(json!({
        "run": run.path(),
        "policy": misses.scenario.policy.name(),
        "n": misses.scenario.run.devices,
        "events": misses.counted_starts.len(),
        "missed": misses.missed.len(),
        "missed_pct": misses.missed_pct(),
        "missed_in_warm_up": misses.in_warm_up,
        "actions": actions.len(),
        "first_actions": name_actions(actions),
        "missed_after_first_action": missed_after_first_action(actions, misses),
        "causes": by_cause.collect::<BTreeMap<_, _>>(),
        "map": { "cell_m": map.cell_m, "missed": map.missed_counts, "devices": map.device_counts },
        "devices": involved.iter().map(device_json).collect::<anyhow::Result<Vec<_>>>()?,
        "bins": bins.collect::<Vec<_>>(),
        "advice": misses.advice().map(|advice| advice.to_string()),
        "suggestions": misses.advice().map(|advice| advice.suggestions),
    }))
}

fn text_report(
    run: &RunReader,
    misses: &Misses,
    actions: &[OperatorAction],
    involved: &[InvolvedDevice],
    device_rows: &BTreeMap<DeviceId, Row<'_>>,
) -> String {
    let scenario = &misses.scenario;
    let line = format!(
        "{}: policy {}, {} devices, TTIs {} to {}",
        run.path().display(),
        scenario.policy.name(),
        scenario.run.devices,
        scenario.warm_up_end(),
        misses.end.0.saturating_sub(1)
    );
    let mut text = wrap_text(&line, WIDTH) + "\n";
    let (missed, events) = (misses.missed.len(), misses.counted_starts.len());
    let warm_up = match misses.in_warm_up {
        0 => String::new(),
        count => format!("; {count} more in the warm-up, not counted"),
    };
    if events == 0 {
        return text + &format!("no counted event so far{warm_up}\n");
    }
    let _infallible = writeln!(
        text,
        "{missed} of {events} events missed ({:.2} %){warm_up}",
        misses.missed_pct()
    );
    if let (Some(actions), Some(after)) = (describe_actions(actions), missed_after_first_action(actions, misses)) {
        let line = format!("{actions}; {after} of the missed events started after the first action");
        text += &(wrap_text(&line, WIDTH) + "\n");
    }
    let Some(advice) = misses.advice() else {
        return text;
    };
    for (cause, count) in misses.causes() {
        text += &format_cause(cause, count, missed);
    }
    let _infallible = write!(text, "\n{}\n{}", format_map(&misses.map()), format_bins(misses));
    let devices = format_devices(involved, device_rows);
    let _infallible = write!(text, "\nNearest devices of missed events\n{devices}");
    text + "\n" + &format_advice(&advice)
}

/// Counts the missed events that started in the TTI of the first action or later; `None` without actions.
fn missed_after_first_action(actions: &[OperatorAction], misses: &Misses) -> Option<usize> {
    let first_tti = actions.first()?.tti;
    Some(misses.missed.iter().filter(|event| event.start >= first_tti).count())
}

/// Formats a cause of `count` of the `missed` events.
fn format_cause(cause: Option<MissCause>, count: u64, missed: usize) -> String {
    let explanation = cause.map_or("the table has no causes", |cause| cause.explanation());
    let share = 100.0 * count as f64 / missed as f64;
    format!("{count:7} {share:5.1} %  {:<12} {explanation}\n", cause_name(cause))
}

/// Formats the advice, with a line for each suggestion.
fn format_advice(advice: &Advice) -> String {
    let mut text = wrap_text(&advice.finding, WIDTH) + "\n";
    text += if advice.suggestions.len() == 1 {
        "Suggestion:\n"
    } else {
        "Suggestions, to try one at a time:\n"
    };
    for suggestion in &advice.suggestions {
        let lines = wrap_text(suggestion, WIDTH - 4).replace('\n', "\n    ");
        let _infallible = writeln!(text, "  - {lines}");
    }
    text
}

/// Formats missed events and devices by place, next to each other and north up.
fn format_map(map: &MissMap) -> String {
    let digits = map
        .missed_counts
        .iter()
        .chain(&map.device_counts)
        .flatten()
        .max()
        .map_or(1, |most| most.to_string().len());
    let format_cell = |count: &u64| match count {
        0 => format!("{:>width$}", "·", width = digits + 1),
        _ => format!("{count:>width$}", width = digits + 1),
    };
    let format_height = |row: usize| {
        format!("{:.4}", row as f64 * map.cell_m)
            .trim_end_matches('0')
            .trim_end_matches('.')
            .to_owned()
    };
    let label_width = format_height(map.missed_counts.len()).chars().count().max(4);
    let map_width = map.columns * (digits + 1);
    // Wide counts leave no room in one line for both maps, with their frames and the gap of fewer than 8 columns.
    let is_joint = label_width + 2 * map_width + 8 <= WIDTH;
    let title = format!(
        "Missed events and devices by place: cells of {0} m × {0} m, north up",
        format_height(1)
    );
    let format_row = |row: usize, counts: &[u64]| {
        let cells: String = counts.iter().map(format_cell).collect();
        format!("{:>label_width$} │{cells}", format_height(row))
    };
    let rows = (0..map.missed_counts.len()).rev();
    let heads = ["missed", "devices"].map(|head| format!("{head:<map_width$}"));
    let mut text = title + "\n";
    if is_joint {
        let _infallible = writeln!(text, "{:>label_width$}  {}     {}", "m", heads[0], heads[1].trim_end());
        for row in rows {
            let devices: String = map.device_counts[row].iter().map(format_cell).collect();
            let _infallible = writeln!(text, "{}    │{devices}", format_row(row, &map.missed_counts[row]));
        }
        return text;
    }
    for (head, counts) in heads.iter().zip([&map.missed_counts, &map.device_counts]) {
        let _infallible = writeln!(text, "{:>label_width$}  {}", "m", head.trim_end());
        for row in rows.clone() {
            let _infallible = writeln!(text, "{}", format_row(row, &counts[row]));
        }
    }
    text
}

/// Formats the causes over time: a row for each cause, a column for each part of the run.
fn format_bins(misses: &Misses) -> String {
    let causes = misses.causes();
    let name_width = causes
        .iter()
        .map(|(cause, _)| cause_name(*cause).len())
        .max()
        .unwrap_or(0)
        .max(8);
    let cell_width = misses.end.to_string().len().max(4) + 1;
    let bins = misses.bins(MAX_BINS.min(((WIDTH - name_width) / cell_width) as u64));
    let format_row = |name: &str, values: &mut dyn Iterator<Item = String>| {
        let mut line = format!("{name:<name_width$}");
        for value in values {
            let _infallible = write!(line, "{value:>cell_width$}");
        }
        line + "\n"
    };
    let mut text = "Causes over time\n".to_owned();
    text += &format_row("from TTI", &mut bins.iter().map(|bin| bin.first.to_string()));
    text += &format_row("events", &mut bins.iter().map(|bin| bin.events.to_string()));
    text += &format_row(
        "missed",
        &mut bins
            .iter()
            .map(|bin| bin.missed_by_cause.iter().sum::<u64>().to_string()),
    );
    if causes.len() > 1 {
        for (index, (cause, _)) in causes.iter().enumerate() {
            text += &format_row(
                cause_name(*cause),
                &mut bins.iter().map(|bin| bin.missed_by_cause[index].to_string()),
            );
        }
    }
    text
}

/// Formats the devices, with their statistics if the run has written them.
fn format_devices(involved: &[InvolvedDevice], device_rows: &BTreeMap<DeviceId, Row<'_>>) -> String {
    let mut text = format!(
        "{:>6} {:>7} {:<12} {:>7} {:>8} {:>7} {:>7} {:>9} {:>7}\n",
        "device", "missed", "main cause", "mean m", "battery", "low", "unpaid", "unpowered", "outage"
    );
    for device in involved {
        let row = device_rows.get(&device.device);
        let cells = DEVICE_COLUMNS.map(|column| {
            let value = row.and_then(|row| row.number::<f64>(column).ok());
            value.map_or("–".to_owned(), |value| {
                format!("{value:.*}", usize::from(column == "final_battery"))
            })
        });
        let [battery, low, unpaid, unpowered, outage] = cells;
        let _infallible = writeln!(
            text,
            "{:>6} {:>7} {:<12} {:>7.2} {battery:>8} {low:>7} {unpaid:>7} {unpowered:>9} {outage:>7}",
            device.device.to_string(),
            device.missed_count,
            cause_name(device.main_cause),
            device.mean_distance_m
        );
    }
    text + "battery: final level, units; low to outage: measured TTIs, as in devices.csv\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cause_fits_in_80_columns() {
        for cause in MissCause::ALL.map(Some).into_iter().chain([None]) {
            let line = format_cause(cause, 1_234_567, 1_234_567);
            assert!(line.trim_end().chars().count() <= WIDTH, "{line}");
        }
    }

    #[test]
    fn each_suggestion_has_its_own_lines() {
        let advice = |suggestions: &[&str]| Advice {
            finding: "3 of 7 missed events were not detected.".to_owned(),
            suggestions: suggestions.iter().map(|text| (*text).to_owned()).collect(),
        };
        assert_eq!(
            format_advice(&advice(&["lower sensing.eta", "raise devices"])),
            "3 of 7 missed events were not detected.\nSuggestions, to try one at a time:\n  - lower sensing.eta\n  \
             - raise devices\n"
        );
        let one = format_advice(&advice(&[&"word ".repeat(30)]));
        assert!(
            one.contains("\nSuggestion:\n  - word word") && one.contains("\n    word "),
            "{one}"
        );
        assert!(one.lines().all(|line| line.chars().count() <= WIDTH), "{one}");
    }
}
