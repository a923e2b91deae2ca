//! `reveille inspect misses --try`: runs the suggested changes in memory, each with the seed, length and actions of the
//! run. The unchanged scenario runs too, so that all rows come from the same program and the same inputs. A
//! signal ends the command immediately, since it has no results to keep.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::ensure;
use reveille_bs::actions::check_change;
use reveille_bs::policy::outside;
use reveille_bs::scenario::{Override, Scenario, load_with_external};
use reveille_common::digits::format_significant;
use reveille_common::ids::Tti;
use reveille_common::message::OperatorAction;
use reveille_common::score::Metrics;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::RunPreparer;
use reveille_lab::run::{Run, RunOptions};
use reveille_study::misses::{FieldChange, Suggestion};
use serde_json::{Value, json};

use crate::commands::run::advance;
use crate::display::{WIDTH, count_noun, new_bar, note, shell_word, wrap_indented, wrap_text};
use crate::input_log::{self, INPUT_LOG_FILE};
use crate::run_folder::SCENARIO_FILE;
use crate::run_reader::RunReader;

/// A run to make.
struct Candidate {
    /// The changed fields; none for the unchanged run.
    changes: Vec<FieldChange>,
    scenario: Scenario,
    inputs: ExternalInputs,
}

impl Candidate {
    /// Creates the run that differs from `run` by these changes.
    ///
    /// # Errors
    /// If a value is not allowed, or a run with the actions is impossible; describes the cause.
    fn new(run: &RunReader, changes: &[FieldChange], actions: &[OperatorAction]) -> Result<Self, String> {
        Ok(Self {
            changes: changes.to_vec(),
            scenario: load_changed(run, changes, actions)?,
            inputs: ExternalInputs {
                actions: actions.to_vec(),
                ..ExternalInputs::default()
            },
        })
    }
}

/// A change that was tried, and its results.
struct Trial {
    changes: Vec<FieldChange>,
    metrics: Metrics,
}

impl Trial {
    /// Whether only the base station has other settings.
    fn has_same_hardware(&self) -> bool {
        let is_setting = |change: &FieldChange| ["policy.", "bs."].iter().any(|path| change.field.starts_with(path));
        self.changes.iter().all(is_setting)
    }
}

/// The outcome of all trials.
pub(super) struct TrialReport {
    unchanged: Metrics,
    /// The tried changes, those with the fewest missed events first.
    trials: Vec<Trial>,
    /// The changes that were not tried, with the reason.
    not_tried: Vec<String>,
    /// The command that makes the best run; `None` if no change lowers the missed events.
    best_command: Option<String>,
    /// The command that makes the best run with the same hardware, which may be the best of all runs.
    same_hardware_command: Option<String>,
    ttis: u64,
    seed: u64,
    elapsed: Duration,
}

/// Runs the changes in `suggestions` for `run`. Returns `None`, with a note, if no change can run.
///
/// # Errors
/// If the scenario or the input log of the run cannot be read or repeated.
pub(super) fn run_trials(run: &RunReader, suggestions: &[Suggestion]) -> anyhow::Result<Option<TrialReport>> {
    let started = crate::runtime::now();
    let mut inputs = input_log::read_folder(run.path(), &run.scenario)?;
    if !inputs.removals.is_empty() {
        let removals = count_noun(inputs.removals.len(), "removal");
        note!("{}: {removals} of devices left out of all trials", run.path().display());
        inputs.removals.clear();
    }
    let (mut candidates, mut not_tried) = find_candidates(run, suggestions, &inputs.actions);
    if candidates.is_empty() {
        note!("nothing to try: {}", not_tried.join("; "));
        return Ok(None);
    }
    candidates.insert(
        0,
        Candidate {
            changes: Vec::new(),
            scenario: run.scenario.clone(),
            inputs: inputs.clone(),
        },
    );
    let mut trials = run_all(&candidates)?;
    let unchanged = trials.remove(0).metrics;
    sort_by_missed_events(&mut trials);
    if let Some(changes) = combine_best(&trials, &unchanged) {
        match Candidate::new(run, &changes, &inputs.actions) {
            Ok(candidate) => trials.extend(run_all(&[candidate])?),
            Err(cause) => not_tried.push(format!("{}: {cause}", changes_text(&changes))),
        }
        sort_by_missed_events(&mut trials);
    }
    let find_best = |is_allowed: fn(&Trial) -> bool| {
        let best = trials.iter().find(|trial| is_allowed(trial))?;
        let is_better = best.metrics.misdetection_pct < unchanged.misdetection_pct;
        is_better.then(|| command_line(run, &best.changes, !inputs.actions.is_empty()))
    };
    let (best_command, same_hardware_command) = (find_best(|_| true), find_best(Trial::has_same_hardware));
    Ok(Some(TrialReport {
        unchanged,
        trials,
        not_tried,
        best_command,
        same_hardware_command,
        ttis: run.scenario.run.ttis,
        seed: run.scenario.run.seed,
        elapsed: started.elapsed(),
    }))
}

/// Sorts by missed events, and equally many of them by energy.
fn sort_by_missed_events(trials: &mut [Trial]) {
    trials.sort_by(|a, b| {
        let key = |trial: &Trial| (trial.metrics.misdetection_pct, trial.metrics.energy_per_device_tti);
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
    });
}

/// Combines the best setting of the base station with the best other change, if each lowers the missed events. `trials`
/// are sorted.
fn combine_best(trials: &[Trial], unchanged: &Metrics) -> Option<Vec<FieldChange>> {
    let better = || {
        trials
            .iter()
            .filter(|trial| trial.metrics.misdetection_pct < unchanged.misdetection_pct)
    };
    let setting = better().find(|trial| trial.has_same_hardware())?;
    let hardware = better().find(|trial| !trial.has_same_hardware())?;
    Some([&hardware.changes[..], &setting.changes].concat())
}

/// Returns the runs for `suggestions` with these `actions`, and the changes without a run, with the reason.
fn find_candidates(
    run: &RunReader,
    suggestions: &[Suggestion],
    actions: &[OperatorAction],
) -> (Vec<Candidate>, Vec<String>) {
    let (mut candidates, mut not_tried) = (Vec::new(), Vec::new());
    let mut seen = BTreeSet::new();
    for suggestion in suggestions {
        if suggestion.trials.is_empty() {
            not_tried.push(suggestion.text.clone());
        }
        for changes in &suggestion.trials {
            if !seen.insert(changes_text(changes)) {
                continue;
            }
            match Candidate::new(run, changes, actions) {
                Ok(candidate) => candidates.push(candidate),
                Err(cause) => not_tried.push(format!("{}: {cause}", changes_text(changes))),
            }
        }
    }
    (candidates, not_tried)
}

/// Loads the scenario of `run` with these changes.
///
/// # Errors
/// If a value is not allowed, or a run with the actions is impossible; describes the cause.
fn load_changed(run: &RunReader, changes: &[FieldChange], actions: &[OperatorAction]) -> Result<Scenario, String> {
    let overrides: Result<Vec<Override>, _> = changes
        .iter()
        .map(|change| Override::parse(&change.to_string()))
        .collect();
    let overrides = overrides.map_err(|error| error.to_string())?;
    let scenario_file = run.path().join(SCENARIO_FILE);
    let loaded = load_with_external(&scenario_file.to_string_lossy(), &overrides);
    let scenario = loaded.map_err(|error| error.to_string())?.scenario;
    if outside::is_external(&scenario.policy) {
        return Err("the decisions of the policy process are known for the unchanged run only".to_owned());
    }
    for action in actions {
        check_change(&action.change, &scenario)?;
    }
    Ok(scenario)
}

/// Makes the runs of `candidates` on all processor cores. Returns their results in the same order.
fn run_all(candidates: &[Candidate]) -> anyhow::Result<Vec<Trial>> {
    let scenario = &candidates[0].scenario;
    let ttis = scenario.run.ttis;
    note!("making {} of {ttis} TTIs", count_noun(candidates.len(), "run"));
    let bar = new_bar(
        candidates.len() as u64 * ttis,
        "{bar:24} {percent} %  {eta} left",
        false,
    );
    let preparer = RunPreparer::default();
    let next_candidate = AtomicUsize::new(0);
    let finished = Mutex::new(Vec::new());
    let take_next = || {
        let index = next_candidate.fetch_add(1, Ordering::Relaxed);
        Some((index, candidates.get(index)?))
    };
    let work = || {
        while let Some((index, candidate)) = take_next() {
            let result = run_candidate(candidate, &preparer, |ttis| bar.inc(ttis));
            let mut finished = finished.lock().unwrap_or_else(PoisonError::into_inner);
            finished.push((index, result));
        }
    };
    let threads = std::thread::available_parallelism()?.get().min(candidates.len());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(work);
        }
    });
    bar.finish_and_clear();
    let mut finished = finished.into_inner().unwrap_or_else(PoisonError::into_inner);
    finished.sort_by_key(|(index, _)| *index);
    finished.into_iter().map(|(_, result)| result).collect()
}

/// Makes one run, and passes the number of finished TTIs to `report`.
fn run_candidate(candidate: &Candidate, preparer: &RunPreparer, report: impl Fn(u64)) -> anyhow::Result<Trial> {
    let Candidate {
        changes,
        scenario,
        inputs,
    } = candidate;
    let mut run = Run::new(&preparer.prepare(scenario), RunOptions::default());
    run.schedule_inputs(inputs);
    let reported = std::cell::Cell::new(0);
    let has_reached_end = advance(&mut run, Tti(scenario.run.ttis), &mut (), |next| {
        report(next.0 - reported.replace(next.0));
        true
    });
    ensure!(
        has_reached_end,
        "{INPUT_LOG_FILE} ends before the last TTI, as its run was interrupted; finish that run first, with `reveille \
         up --resume`"
    );
    report(scenario.run.ttis - reported.get());
    Ok(Trial {
        changes: changes.clone(),
        metrics: run.finish(&mut ()).metrics,
    })
}

/// Returns the command that makes the run with these changes.
fn command_line(run: &RunReader, changes: &[FieldChange], has_actions: bool) -> String {
    let path = |name: &str| shell_word(run.path().join(name));
    let mut command = format!("reveille run --scenario {}", path(SCENARIO_FILE));
    for change in changes {
        let _infallible = write!(command, " --set {}", shell_word(change.to_string()));
    }
    if has_actions {
        let _infallible = write!(command, " --actions {}", path(INPUT_LOG_FILE));
    }
    command
}

fn changes_text(changes: &[FieldChange]) -> String {
    let changes: Vec<String> = changes.iter().map(FieldChange::to_string).collect();
    changes.join(" ")
}

impl TrialReport {
    /// Whether `trial` has the results of the unchanged run.
    fn is_without_effect(&self, trial: &Trial) -> bool {
        let key = |metrics: &Metrics| {
            [metrics.misdetection_pct, metrics.energy_per_device_tti, metrics.info_p1].map(f64::to_bits)
        };
        key(&self.unchanged) == key(&trial.metrics)
    }

    /// Whether the best trial has the largest or the smallest of at least two tried values of its last field.
    fn is_best_at_edge(&self) -> bool {
        let last_change = |trial: &Trial| -> Option<(String, f64)> {
            let FieldChange { field, value } = trial.changes.last()?;
            Some((field.clone(), value.parse().ok()?))
        };
        let Some((best_field, best)) = self.trials.first().and_then(last_change) else {
            return false;
        };
        let others: Vec<f64> = self
            .trials
            .iter()
            .skip(1)
            .filter_map(last_change)
            .filter(|(field, value)| *field == best_field && value.to_bits() != best.to_bits())
            .map(|(_, value)| value)
            .collect();
        !others.is_empty() && (others.iter().all(|value| *value < best) || others.iter().all(|value| *value > best))
    }

    /// Formats the table, the changes that were not tried, and the best command.
    pub(super) fn to_text(&self) -> String {
        let runs = count_noun(self.trials.len() + 1, "run");
        let mut text = format!(
            "Tried changes: {runs} of {} TTIs, seed {}, {:.1} s\n{:>8} {:>8} {:>8} {:>8}  change\n",
            self.ttis,
            self.seed,
            self.elapsed.as_secs_f64(),
            "missed %",
            "points",
            "energy",
            "P1"
        );
        let rows = self.trials.iter().map(|trial| (&trial.metrics, Some(trial)));
        let mut rows: Vec<(&Metrics, Option<&Trial>)> = rows.collect();
        // The unchanged run comes before changes with equally many missed events.
        let unchanged_pct = self.unchanged.misdetection_pct;
        let better = rows
            .iter()
            .take_while(|(metrics, _)| metrics.misdetection_pct < unchanged_pct);
        rows.insert(better.count(), (&self.unchanged, None));
        for (metrics, trial) in rows {
            let points = match trial {
                Some(trial) if self.is_without_effect(trial) => "no eff.".to_owned(),
                Some(_) => format!("{:+.2}", metrics.misdetection_pct - unchanged_pct),
                None => String::new(),
            };
            let change = trial.map_or_else(|| "(unchanged)".to_owned(), |trial| changes_text(&trial.changes));
            let [energy, p1] =
                [metrics.energy_per_device_tti, metrics.info_p1].map(|value| format_significant(value, 3));
            let change = wrap_text(&change, WIDTH - 37).replace('\n', &format!("\n{:37}", ""));
            let missed_pct = metrics.misdetection_pct;
            let _infallible = writeln!(text, "{missed_pct:>8.2} {points:>8} {energy:>8} {p1:>8}  {change}");
        }
        text += "points: difference of missed %; energy: units per device and TTI\n";
        if !self.not_tried.is_empty() {
            text += "Not tried:\n";
        }
        for change in &self.not_tried {
            let lines = wrap_text(change, WIDTH - 4).replace('\n', "\n    ");
            let _infallible = writeln!(text, "  - {lines}");
        }
        match &self.best_command {
            // One line: a wrapped command could not be pasted.
            Some(command) => {
                let edge = if self.is_best_at_edge() {
                    "The best value is the largest or smallest one tried: a further one can be better. "
                } else {
                    ""
                };
                let caution =
                    format!("{edge}One seed can mislead: compare the change over several seeds with `reveille sweep`.");
                let same_hardware = match &self.same_hardware_command {
                    Some(same_hardware) if same_hardware != command => {
                        format!("Fewest missed events with the same hardware:\n  {same_hardware}\n")
                    }
                    Some(_) | None => String::new(),
                };
                let caution = wrap_indented(&caution, WIDTH, 0);
                format!("{text}Fewest missed events:\n  {command}\n{same_hardware}{caution}\n")
            }
            None => text + "No tried change lowers the number of missed events.\n",
        }
    }

    /// Returns the report as JSON.
    pub(super) fn to_json(&self) -> Value {
        let metrics_json = |metrics: &Metrics| {
            json!({
                "missed_pct": metrics.misdetection_pct,
                "energy_per_device_tti": metrics.energy_per_device_tti,
                "info_p1": metrics.info_p1,
            })
        };
        let trial_json = |trial: &Trial| {
            let mut object = metrics_json(&trial.metrics);
            object["changes"] = changes_json(&trial.changes);
            object["difference_points"] = json!(trial.metrics.misdetection_pct - self.unchanged.misdetection_pct);
            object["has_effect"] = json!(!self.is_without_effect(trial));
            object
        };
        json!({
            "unchanged": metrics_json(&self.unchanged),
            "trials": self.trials.iter().map(trial_json).collect::<Vec<_>>(),
            "not_tried": self.not_tried,
            "best_command": self.best_command,
            "same_hardware_command": self.same_hardware_command,
            "seconds": self.elapsed.as_secs_f64(),
        })
    }
}

/// Returns changed fields as an object.
pub(super) fn changes_json(changes: &[FieldChange]) -> Value {
    let pairs = changes.iter().map(|change| (change.field.clone(), json!(change.value)));
    Value::Object(pairs.collect())
}
