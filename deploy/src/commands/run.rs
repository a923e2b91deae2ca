//! `reveille run`: a run in memory, with the same run folder, watchers and digest as a run over the bus (`bs`). The
//! constants here decide only how soon a signal is noticed.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Context, anyhow, ensure};
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_bs::server::RunProgress;
use reveille_common::bus::FrameSink;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::score::WindowRecord;
use reveille_lab::external_inputs::{self, ExternalInputs};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions, StopWhen};
use reveille_view::metrics::ProcessStats;

use super::resolve_scenario::{read_log_of_run, resolve_started_run, warn_about_depletion, with_scenario_of_log};
use super::{print_results, window_length};
use crate::child_process;
use crate::cli::RunArgs;
use crate::display::RunProgressBar;
use crate::exit::Interrupted;
use crate::input_log::{self, InputLog};
use crate::resume_mark::{self, ResumeMarkWriter};
use crate::run_folder::RunFolder;
use crate::run_watchers::RunWatchers;
use crate::signals::{SignalMode, Signals, run_on_thread};
use crate::summary::{Summary, Timing};

/// Most TTIs between two checks for a signal: a fraction of a second for every policy, also with a recording.
const MAX_STRIDE_TTIS: u64 = 1_000;
/// Number of devices at which a TTI costs about twice as much as without devices. With many more, every TTI has a
/// check.
const DOUBLE_COST_DEVICES: u64 = 20_000;

/// Runs a scenario in memory.
pub(crate) fn run(args: &RunArgs) -> anyhow::Result<ExitCode> {
    child_process::exit_with_optional_parent(args.output.parent)?;
    let (scenario, recorded_inputs) = resolve_scenario(args)?;
    crate::run_watchers::check(&args.output)?;
    // Read before the folder is created: a log that does not match leaves no folder behind.
    let given_inputs = read_given_inputs(args, &scenario, recorded_inputs)?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    warn_about_depletion(&scenario);
    let folder = RunFolder::create(&args.output, &scenario)?;
    let mark = match &args.output.resume {
        Some(_) => resume_mark::read(folder.path(), &scenario)?,
        None => None,
    };
    // A resumed run keeps the window of its first part, so that windows.csv gets the same rows.
    let stored_window = mark.as_ref().map(|mark| mark.window);
    let options = RunOptions {
        lookahead: !args.no_lookahead,
        window: stored_window.unwrap_or_else(|| window_length(&args.output, &scenario)),
    };
    let inputs = store_or_read_inputs(given_inputs, &folder, &scenario)?;
    let mut mark_writer = ResumeMarkWriter::new(folder.path(), &scenario, options.window, mark);
    let progress = Arc::new(RunProgress::default());
    // The worker serves metrics; the run itself stays on this thread.
    let runtime = crate::runtime::runtime(1)?;
    let run_name = folder.name();
    let watchers_start = RunWatchers::start(&args.output, &run_name, &scenario, ProcessStats::default);
    let watchers = match runtime.block_on(watchers_start) {
        Ok(watchers) => watchers,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let bar = RunProgressBar::start(&progress, &scenario, args.output.quiet);
    let started = crate::runtime::now();
    let mut run = match prepare_on_thread(&scenario, options, &signals) {
        Ok(run) => run,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    run.schedule_inputs(&inputs);
    let state_interval = args.output.record_states.unwrap_or(0);
    let frame_observer = |sink: Box<FrameSink>| FrameObserver::new(state_interval, move |frame| sink(&frame));
    let mut run_observers = RunObservers {
        frame_observer: watchers.sink().map(frame_observer),
        watchers: (
            watchers.metrics_observer(),
            StopWhen(watchers.recording_failure_check()),
        ),
        folder,
        progress: &progress,
        signals: &signals,
        devices: scenario.run.devices,
        removal_notices: 0,
    };
    let mut observers = (&mut run_observers, &mut mark_writer);
    let has_reached_end = advance(&mut run, Tti(scenario.run.ttis), &mut observers, |_| {
        !signals.has_arrived()
    });
    if let Some(tti) = run.missing_decision() {
        let error = anyhow!(
            "the input log has no decision for TTI {tti} of {}, as its run was interrupted; finish that run first, \
             with `reveille up --resume` and the folder of the log",
            scenario.run.ttis
        );
        run_observers.folder.fail(&error);
        return Err(error);
    }
    let unused_decisions = run.input_queue().decision_count();
    let outcome = if has_reached_end {
        run.finish(&mut (&mut run_observers, &mut mark_writer))
    } else {
        run.partial_outcome()
    };
    // A resumed run is replayed from TTI 0 in memory, and must have reproduced its mark by now.
    mark_writer.check()?;
    let has_used_all_inputs = unused_decisions == 0 && run_observers.removal_notices == inputs.removals.len();
    ensure!(!outcome.is_complete || has_used_all_inputs, input_log::MISMATCH);
    let mark_finished = mark_writer.finish(outcome.is_complete);
    let run_s = started.elapsed().as_secs_f64();
    drop(bar);
    let timing = Timing {
        run_s,
        ttis_per_s: outcome.ttis_done as f64 / run_s,
        ..Timing::default()
    };
    let summary = Summary::new(&scenario, &outcome, timing);
    let path = run_observers.folder.path().to_owned();
    runtime.block_on(watchers.finish(Some(summary.to_json()?)))?;
    run_observers.folder.write_learned(&scenario, &outcome)?;
    // On a full disk the error of the tables names the cause; the error of the mark would hide it.
    run_observers.folder.finish(&scenario, &outcome, &summary)?;
    mark_finished?;
    print_results(&args.output, &summary, &path)
}

/// Returns the scenario, which can be the one next to the log of `--input-log`, and the inputs in the log of
/// `--policy replay=FILE`, if given.
fn resolve_scenario(args: &RunArgs) -> anyhow::Result<(Scenario, Option<ExternalInputs>)> {
    match &args.input_log {
        Some(log_path) => resolve_started_run(&with_scenario_of_log(&args.scenario, log_path), &args.output),
        None => resolve_started_run(&args.scenario, &args.output),
    }
}

/// Returns the external inputs of the command line: the inputs of `--input-log`, or the `recorded_inputs` of
/// `--policy replay=FILE` and a script of actions. Returns `None` without such an option.
fn read_given_inputs(
    args: &RunArgs,
    scenario: &Scenario,
    recorded_inputs: Option<ExternalInputs>,
) -> anyhow::Result<Option<ExternalInputs>> {
    let Some(path) = &args.input_log else {
        ensure!(
            recorded_inputs.is_some() || args.output.resume.is_some() || !outside::is_external(&scenario.policy),
            "--policy external: only `reveille up` and `reveille bs` can ask a policy process; use one of them, or \
             repeat its decisions with --policy replay=FILE, the inputs.log of such a run, or step the run from Python"
        );
        let has_inputs = recorded_inputs.is_some() || args.actions.actions.is_some();
        let inputs = args.actions.read(scenario, recorded_inputs)?;
        return Ok(has_inputs.then_some(inputs));
    };
    // Before the log is compared with the scenario, which names policy external in the folder of such a log.
    let text = std::fs::read_to_string(path).unwrap_or_default();
    ensure!(
        !external_inputs::holds_decisions(&text),
        "--input-log {0}: the log holds decisions of a policy process; repeat them with --policy replay={0}, or use \
         the log of a run with a built-in policy",
        path.display()
    );
    ensure!(
        !outside::is_external(&scenario.policy),
        "--input-log: policy external takes all inputs from --policy replay=FILE; use that option, or choose a \
         built-in policy"
    );
    let inputs = read_log_of_run(path, scenario, args.scenario.is_given()).context("--input-log")?;
    Ok(Some(inputs))
}

/// Returns the external inputs of the run: the `given_inputs` of the command line, copied to the log in its folder,
/// else the inputs in that log.
fn store_or_read_inputs(
    given_inputs: Option<ExternalInputs>,
    folder: &RunFolder,
    scenario: &Scenario,
) -> anyhow::Result<ExternalInputs> {
    let Some(inputs) = given_inputs else {
        return input_log::read_folder(folder.path(), scenario);
    };
    InputLog::new(folder.path(), scenario).add_all(&inputs)?;
    Ok(inputs)
}

/// Prepares a run on another thread, since that takes a while with a million devices or a search. A signal abandons it,
/// as there is nothing to lose yet. Logs the warnings of the search.
fn prepare_on_thread(scenario: &Scenario, options: RunOptions, signals: &Signals) -> anyhow::Result<Run> {
    let scenario = scenario.clone();
    let prepare_run = move || {
        let prepared = prepare(&scenario);
        (Run::new(&prepared, options), prepared.warnings)
    };
    let (run, warnings) = run_on_thread(prepare_run, || signals.has_arrived())?.ok_or(Interrupted::BEFORE_RUN)?;
    for warning in warnings {
        tracing::warn!("{warning}");
    }
    Ok(run)
}

/// Runs to TTI `to`, as [`Run::advance`] does, and returns whether it got there. Regularly asks `may_continue` whether
/// to continue with the next TTI. `resume` uses it too.
pub(crate) fn advance(
    run: &mut Run,
    to: Tti,
    observer: &mut impl Observer,
    may_continue: impl Fn(Tti) -> bool,
) -> bool {
    // A TTI costs about 1 + n/DOUBLE_COST_DEVICES times as much as one without devices: the stride shrinks by this.
    let stride = (MAX_STRIDE_TTIS * DOUBLE_COST_DEVICES / (DOUBLE_COST_DEVICES + run.machines().len() as u64)).max(1);
    loop {
        let next = run.cycle().next_tti();
        if next >= to {
            return true;
        }
        // The run itself checks for a signal only at the end of a window, by default a hundredth of its length.
        if !may_continue(next) || !run.advance(to.min(next + stride), observer) {
            return false;
        }
    }
}

/// The observers of a run: they write tables, record, and show the progress.
///
/// A method of [`Observer`] without forwarding here is ignored, without an error. `batteries_revealed` has none: only
/// an audit over the bus needs it.
struct RunObservers<'a, F, W> {
    frame_observer: Option<FrameObserver<F>>,
    watchers: W,
    folder: RunFolder,
    progress: &'a RunProgress,
    signals: &'a Signals,
    devices: u32,
    /// Number of removals that took effect.
    removal_notices: usize,
}

impl<F: FnMut(Frame), W: Observer> Observer for RunObservers<'_, F, W> {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.removal_notices += usize::from(matches!(notification, Notification::DevicesRemoved(_)));
        self.folder.notify(notification);
        self.frame_observer.notify(notification);
        self.watchers.notify(notification);
    }

    fn states_due(&self) -> Tti {
        self.frame_observer.states_due().min(self.watchers.states_due())
    }

    fn wants_beliefs(&self) -> bool {
        self.frame_observer.wants_beliefs() || self.watchers.wants_beliefs()
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        let may_continue = self.watchers.window_closed(window);
        self.progress.next_tti.store(window.end.0, Ordering::Relaxed);
        self.progress.events.fetch_add(window.events.events, Ordering::Relaxed);
        self.progress
            .misdetected
            .fetch_add(window.events.misdetected, Ordering::Relaxed);
        self.progress.set_mean_battery(self.devices, window);
        // First in the chain: the folder must see every window, also the one in which the run stops.
        self.folder.window_closed(window) && may_continue && !self.signals.has_arrived()
    }
}
