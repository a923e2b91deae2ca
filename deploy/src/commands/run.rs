//! `reveille run`: a run in memory.

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
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions, StopWhen};
use reveille_view::metrics::ProcessStats;

use super::resolve_scenario::resolve_run;
use super::{conclude, window};
use crate::child_process;
use crate::cli::RunArgs;
use crate::display::Bar;
use crate::exit::Interrupted;
use crate::input_log::{self, InputLog};
use crate::resume_mark::{self, ResumeMarkWriter};
use crate::run_folder::RunFolder;
use crate::run_watchers::RunWatchers;
use crate::signals::{Manner, Signals, aside};
use crate::summary::{Summary, Timing};

/// TTIs between two checks for a signal: a fraction of a second for every policy, also with a recording.
const STRIDE: u64 = 1_000;
/// Number of devices at which a TTI costs about twice as much as without devices. With many more, every TTI has a
/// check.
const MANY: u64 = 20_000;

/// Runs a scenario in memory.
pub(crate) fn run(args: &RunArgs) -> anyhow::Result<ExitCode> {
    child_process::end_with(args.output.parent)?;
    let (scenario, given) = resolve_run(&args.scenario, &args.output)?;
    crate::run_watchers::check(&args.output)?;
    // Read before the folder is created: a log that does not match leaves no folder behind.
    let named = named(args, &scenario, given)?;
    let signals = Signals::install(Manner::Keeps)?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    let mark = match &args.output.resume {
        Some(_) => resume_mark::read(folder.path(), &scenario)?,
        None => None,
    };
    // A resumed run keeps the window of its first part, so that windows.csv gets the same rows.
    let options = RunOptions {
        lookahead: !args.no_lookahead,
        window: mark
            .as_ref()
            .map_or_else(|| window(&args.output, &scenario), |mark| mark.window),
    };
    let inputs = inputs(named, &folder, &scenario)?;
    let mut marker = ResumeMarkWriter::new(folder.path(), &scenario, options.window, mark);
    let progress = Arc::new(RunProgress::default());
    // The worker serves metrics; the run itself stays on this thread.
    let runtime = crate::runtime::runtime(1)?;
    let name = folder.name();
    let watch = RunWatchers::start(&args.output, &name, &scenario, ProcessStats::default);
    let watch = match runtime.block_on(watch) {
        Ok(watch) => watch,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let bar = Bar::start(&progress, &scenario, args.output.quiet);
    let started = crate::runtime::now();
    let mut run = match set_up(&scenario, options, &signals) {
        Ok(run) => run,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    run.schedule_inputs(&inputs);
    let states_every = args.output.record_states.unwrap_or(0);
    let framed = |sink: Box<FrameSink>| FrameObserver::new(states_every, move |frame| sink(&frame));
    let mut shown = RunObservers {
        framed: watch.sink().map(framed),
        watchers: (watch.metrics_observer(), StopWhen(watch.is_broken())),
        folder,
        progress: &progress,
        signals: &signals,
        devices: scenario.run.devices,
        outages: 0,
    };
    let mut observers = (&mut shown, &mut marker);
    let goes_on = advance(&mut run, Tti(scenario.run.ttis), &mut observers, |_| {
        !signals.have_come()
    });
    if let Some(tti) = run.missing_decision() {
        let error = anyhow!(
            "the input log has no decision for TTI {tti} of {}, as its run was interrupted; finish that run first with \
             `reveille up --resume FOLDER`",
            scenario.run.ttis
        );
        shown.folder.fail(&error);
        return Err(error);
    }
    let unused_decisions = run.queue().decisions();
    let outcome = if goes_on {
        run.finish(&mut (&mut shown, &mut marker))
    } else {
        run.partial_outcome()
    };
    // A resumed run is replayed from TTI 0 in memory, and must have reproduced its mark by now.
    marker.check()?;
    let has_all = unused_decisions == 0 && shown.outages == inputs.outages.len();
    ensure!(!outcome.complete || has_all, input_log::MISFIT);
    let marked = marker.finish(outcome.complete);
    let run_s = started.elapsed().as_secs_f64();
    drop(bar);
    let timing = Timing {
        run_s,
        ttis_per_s: outcome.ttis_done as f64 / run_s,
        ..Timing::default()
    };
    let summary = Summary::new(&scenario, &outcome, timing);
    let path = shown.folder.path().to_owned();
    watch.finish(Some(summary.to_json()?))?;
    shown.folder.write_learned(&scenario, &outcome)?;
    // On a full disk the error of the tables names the cause; the error of the mark would hide it.
    shown.folder.finish(&scenario, &outcome, &summary)?;
    marked?;
    conclude(&args.output, &summary, &path)
}

/// Returns the external inputs that the command names: a log, or the decisions `given` for a policy.
fn named(args: &RunArgs, scenario: &Scenario, given: Option<ExternalInputs>) -> anyhow::Result<Option<ExternalInputs>> {
    let Some(path) = &args.input_log else {
        ensure!(
            given.is_some() || args.output.resume.is_some() || !outside::is_external(&scenario.policy),
            "--policy external: only `reveille up` and `reveille bs` can ask a policy process; use one of them, or \
             repeat its decisions with --policy replay=FILE, the inputs.log of such a run, or step the run from Python"
        );
        return Ok(given);
    };
    ensure!(
        !outside::is_external(&scenario.policy),
        "--input-log: policy external takes all inputs from --policy replay=FILE; use that option, or choose a \
         built-in policy"
    );
    let inputs = input_log::read_named(path, scenario).context("--input-log")?;
    ensure!(
        inputs.decisions.is_empty(),
        "--input-log: the log holds decisions, but the policy is built in: {}",
        input_log::MISFIT
    );
    Ok(Some(inputs))
}

/// Returns the external inputs of the run: those in its folder, or the command's `named` ones, which are copied there.
fn inputs(named: Option<ExternalInputs>, folder: &RunFolder, scenario: &Scenario) -> anyhow::Result<ExternalInputs> {
    let Some(inputs) = named else {
        return input_log::of_folder(folder.path(), scenario);
    };
    InputLog::new(folder.path(), scenario).add_all(&inputs)?;
    Ok(inputs)
}

/// Prepares a run on another thread, since that takes a while with a million devices or a search. A signal abandons it,
/// as there is nothing to lose yet. Logs the warnings of the search.
fn set_up(scenario: &Scenario, options: RunOptions, signals: &Signals) -> anyhow::Result<Run> {
    let scenario = scenario.clone();
    let prepared = move || {
        let prepared = prepare(&scenario);
        (Run::new(&prepared, options), prepared.warnings)
    };
    let (run, warnings) = aside(prepared, || signals.have_come())?.ok_or(Interrupted::BEFORE_RUN)?;
    for warning in warnings {
        tracing::warn!("{warning}");
    }
    Ok(run)
}

/// Runs to TTI `to`, as [`Run::advance`] does. Regularly asks `goes_on` whether to continue with the next TTI.
pub(crate) fn advance(run: &mut Run, to: Tti, observer: &mut impl Observer, goes_on: impl Fn(Tti) -> bool) -> bool {
    // A TTI costs about 1 + n/MANY times as much as one without devices, so the stride shrinks by that factor.
    let stride = (STRIDE * MANY / (MANY + run.machines().len() as u64)).max(1);
    loop {
        let next = run.cycle().next_tti();
        if next >= to {
            return true;
        }
        // The run itself checks for a signal only at the end of a window, by default a hundredth of its length.
        if !goes_on(next) || !run.advance(to.min(next + stride), observer) {
            return false;
        }
    }
}

/// The observers of a run: they write tables, record, and show the progress.
struct RunObservers<'a, F, W> {
    framed: Option<FrameObserver<F>>,
    watchers: W,
    folder: RunFolder,
    progress: &'a RunProgress,
    signals: &'a Signals,
    devices: u32,
    outages: usize,
}

impl<F: FnMut(Frame), W: Observer> Observer for RunObservers<'_, F, W> {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.outages += usize::from(matches!(notification, Notification::DevicesRemoved(_)));
        self.folder.notify(notification);
        self.framed.notify(notification);
        self.watchers.notify(notification);
    }

    fn wants_states(&self) -> bool {
        self.framed.wants_states() || self.watchers.wants_states()
    }

    fn wants_beliefs(&self) -> bool {
        self.framed.wants_beliefs() || self.watchers.wants_beliefs()
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        let goes_on = self.watchers.window_closed(window);
        self.progress.tti.store(window.end.0, Ordering::Relaxed);
        self.progress.events.fetch_add(window.events.events, Ordering::Relaxed);
        self.progress
            .misdetected
            .fetch_add(window.events.misdetected, Ordering::Relaxed);
        self.progress.set_mean_battery(self.devices, window);
        // First in the chain: the folder must see every window, also the one in which the run stops.
        self.folder.window_closed(window) && goes_on && !self.signals.have_come()
    }
}
