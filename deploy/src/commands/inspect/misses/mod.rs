//! `reveille inspect misses`: where, when and why the events of a run were missed. Programs of users read the keys of
//! `--json`, so do not rename them. The text fits 80 columns; `docs/reading-results.md` shows it. `study/src/misses/`
//! finds the causes, and `trials` runs the suggested changes.

mod map;
mod phases;
mod trials;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::process::ExitCode;

use reveille_common::digits::format_significant;
use reveille_common::ids::DeviceId;
use reveille_common::message::OperatorAction;
use reveille_common::totals::MissCause;
use reveille_lab::action_script::warm_up_warning;
use reveille_study::misses::{ActionFailure, Advice, InvolvedDevice, MissedEvent, Misses, cause_name};
use serde_json::{Value, json};

use crate::action_text::{describe_actions, name_actions};
use crate::cli::MissesArgs;
use crate::display::{WIDTH, print_stdout, wrap_text};
use crate::exit::ExitReason;
use crate::run_reader::{Row, RunReader};
use map::{FAILED_MARK, format_map};
use phases::PhaseEnergy;
use trials::TrialReport;

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

/// The content of a report.
struct MissReport<'r> {
    run: &'r RunReader,
    misses: &'r Misses,
    involved: Vec<InvolvedDevice>,
    device_rows: BTreeMap<DeviceId, Row<'r>>,
    phase_energy: PhaseEnergy,
    advice: Option<Advice>,
    trials: Option<TrialReport>,
}

/// Prints the missed events of a run.
pub(super) fn run(args: &MissesArgs) -> anyhow::Result<ExitCode> {
    let run = RunReader::open(&args.run)?;
    let misses = run.misses()?;
    let devices = run.devices()?;
    let device_rows = devices
        .as_ref()
        .map_or_else(|| Ok(BTreeMap::new()), |table| table.by_device())?;
    let advice = misses.advice();
    let trials = match &advice {
        Some(advice) if args.tries => trials::run_trials(&run, &advice.suggestions)?,
        Some(_) | None => None,
    };
    let phase_energy = if misses.actions.is_empty() {
        PhaseEnergy::default()
    } else {
        PhaseEnergy::read(&run)?
    };
    let report = MissReport {
        run: &run,
        misses: &misses,
        involved: misses.involved_devices().into_iter().take(args.devices).collect(),
        device_rows,
        phase_energy,
        advice,
        trials,
    };
    let output = if args.json {
        report.to_json()?.to_string() + "\n"
    } else {
        report.to_text()
    };
    print_stdout(&output)?;
    Ok(ExitReason::Done.into())
}

impl MissReport<'_> {
    fn to_json(&self) -> anyhow::Result<Value> {
        let Self { run, misses, .. } = self;
        let actions = &misses.actions;
        let map = misses.map();
        let causes = misses.causes();
        let failures = misses.action_failures();
        let device_json = |device: &InvolvedDevice| {
            let mut object = json!({
                "device": device.device,
                "missed": device.missed_count,
                "main_cause": cause_name(device.main_cause),
                "mean_distance_m": device.mean_distance_m,
                "failed_by_action_ttis": failures.get(&device.device).map_or(0, |failure| failure.ttis),
            });
            if let Some(row) = self.device_rows.get(&device.device) {
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
        let suggestions = self.advice.as_ref().map(|advice| &advice.suggestions);
        let mut report = json!({
            "run": run.path(),
            "policy": misses.scenario.policy.name(),
            "n": misses.scenario.run.devices,
            "events": misses.counted_starts.len(),
            "missed": misses.missed.len(),
            "missed_pct": misses.missed_pct(),
            "missed_in_warm_up": misses.in_warm_up,
            "actions": actions.len(),
            "actions_in_warm_up": actions.iter().filter(|action| action.tti < misses.scenario.warm_up_end()).count(),
            "first_actions": name_actions(actions),
            "missed_after_first_action": missed_after_first_action(actions, misses),
            "failed_devices": failures.iter().map(failure_json).collect::<Vec<_>>(),
            "phases": misses.phases().iter().map(|phase| self.phase_energy.to_json(phase)).collect::<Vec<_>>(),
            "causes": by_cause.collect::<BTreeMap<_, _>>(),
            "map": {
                "cell_m": map.cell_m, "missed": map.missed_counts, "devices": map.device_counts,
                "failed": map.failed_counts,
            },
            "devices": self.involved.iter().map(device_json).collect::<anyhow::Result<Vec<_>>>()?,
            "bins": bins.collect::<Vec<_>>(),
            "advice": self.advice.as_ref().map(Advice::to_string),
            "suggestions": suggestions.map(|list| list.iter().map(|one| one.text.clone()).collect::<Vec<_>>()),
            "suggested_changes": suggestions.map(|list| {
                let trials = list.iter().map(|one| one.trials.iter().map(|changes| trials::changes_json(changes)));
                trials.map(Iterator::collect::<Vec<_>>).collect::<Vec<_>>()
            }),
        });
        if let Some(trials) = &self.trials {
            report["tried"] = trials.to_json();
        }
        Ok(report)
    }

    fn to_text(&self) -> String {
        let Self { run, misses, .. } = self;
        let (scenario, actions) = (&misses.scenario, &misses.actions);
        let (first, end) = (scenario.warm_up_end(), misses.end);
        let ttis = if first < end {
            format!("TTIs {first} to {}", end.0 - 1)
        } else {
            format!("ended in TTI {end}, before the warm-up ends at TTI {first}")
        };
        let line = format!(
            "{}: policy {}, {} devices, {ttis}",
            run.path().display(),
            scenario.policy.name(),
            scenario.run.devices,
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
        if let Some(warning) = warm_up_warning(actions, scenario) {
            text += &(wrap_text(&warning, WIDTH) + "\n");
        }
        let phases = misses.phases();
        if !phases.is_empty() {
            let _infallible = write!(text, "\n{}", self.phase_energy.format(&phases));
        }
        let Some(advice) = &self.advice else {
            return text;
        };
        if !phases.is_empty() {
            text.push('\n');
        }
        for (cause, count) in misses.causes() {
            text += &format_cause(cause, count, missed);
        }
        text.extend(misses.missed.first().map(format_first_event));
        let _infallible = write!(text, "\n{}\n{}", format_map(&misses.map()), format_bins(misses));
        let devices = format_devices(&self.involved, &self.device_rows, &misses.action_failures());
        let _infallible = write!(text, "\nNearest devices of missed events\n{devices}");
        let _infallible = write!(text, "\n{}", format_advice(advice));
        match &self.trials {
            Some(trials) => text + "\n" + &trials.to_text(),
            None if advice.suggestions.iter().all(|suggestion| suggestion.trials.is_empty()) => text,
            None => text + "Add --try to run the suggested values and compare them.\n",
        }
    }
}

/// Returns the failures of a device as JSON.
fn failure_json((device, failure): (&DeviceId, &ActionFailure)) -> Value {
    json!({
        "device": device,
        "first_tti": failure.first,
        "ttis": failure.ttis,
        "failed_at_end": failure.is_failed_at_end,
    })
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

/// Formats the first missed event, from which a reader can follow the messages of a recording.
fn format_first_event(event: &MissedEvent) -> String {
    let MissedEvent {
        event,
        start,
        nearest,
        distance_m,
        ..
    } = event;
    format!(
        "first: event {event} in TTI {start}, nearest device {nearest} at {} m; events.csv has all\n",
        format_significant(*distance_m, 3)
    )
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
        let lines = wrap_text(&suggestion.text, WIDTH - 4).replace('\n', "\n    ");
        let _infallible = writeln!(text, "  - {lines}");
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

/// Formats the devices, with their statistics if the run has written them. Marks the devices with `failures`.
fn format_devices(
    involved: &[InvolvedDevice],
    device_rows: &BTreeMap<DeviceId, Row<'_>>,
    failures: &BTreeMap<DeviceId, ActionFailure>,
) -> String {
    let mut text = format!(
        "{:>6} {:>7} {:<12} {:>7} {:>8} {:>7} {:>8} {:>8} {:>7}\n",
        "device", "missed", "main cause", "mean m", "battery", "low", "no sense", "no radio", "outage"
    );
    for device in involved {
        let row = device_rows.get(&device.device);
        let cells = DEVICE_COLUMNS.map(|column| {
            let value = row.and_then(|row| row.number::<f64>(column).ok());
            value.map_or("–".to_owned(), |value| format_significant(value, 3))
        });
        let [battery, low, no_sense, no_radio, outage] = cells;
        let _infallible = writeln!(
            text,
            "{:>6} {:>7} {:<12} {:>7.2} {battery:>8} {low:>7} {no_sense:>8} {no_radio:>8} {outage:>7}",
            if failures.contains_key(&device.device) {
                format!("{FAILED_MARK}{}", device.device)
            } else {
                device.device.to_string()
            },
            device.missed_count,
            cause_name(device.main_cause),
            device.mean_distance_m
        );
    }
    text += "battery: final level, units; the next columns count measured TTIs\n\
             low: B < E_Tx at the end; no sense: δ = 1, but no power to sense; no radio:\n\
             δ = 0, but no power for the wake-up radio; outage: longest time without power\n";
    if involved.iter().any(|device| failures.contains_key(&device.device)) {
        let _infallible = writeln!(text, "{FAILED_MARK}: actions failed the device");
    }
    text
}

#[cfg(test)]
mod tests {
    use reveille_study::misses::Suggestion;

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
            suggestions: suggestions
                .iter()
                .map(|text| Suggestion {
                    text: (*text).to_owned(),
                    trials: Vec::new(),
                })
                .collect(),
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
