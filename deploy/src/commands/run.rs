//! `reveille run`: a run in memory.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use reveille_bs::host::Progress;
use reveille_bs::observe::frames::Framed;
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::policy::outside;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::inputs::Inputs;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run, StopWhen};
use reveille_view::metrics::Process;

use super::conclusion::{conclude, window};
use super::resolution::resolve_run;
use crate::cli::RunArgs;
use crate::display::Bar;
use crate::input_log::{self, InputLog};
use crate::marks::{self, Marker};
use crate::results::RunFolder;
use crate::summary::{Summary, Timing};
use crate::watch::{Sink, Watch};

/// Time between two looks for a signal while a run is set up.
const LOOK: Duration = Duration::from_millis(50);

/// Runs a scenario in memory.
pub fn run(args: &RunArgs) -> anyhow::Result<ExitCode> {
    let (scenario, given) = resolve_run(&args.scenario, &args.output)?;
    crate::watch::check(&args.output)?;
    // Before there is a folder: a log that does not fit leaves none.
    let named = named(args, &scenario, given)?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    let mark = match &args.output.resume {
        Some(_) => marks::read(folder.path(), &scenario)?,
        None => None,
    };
    let options = Options {
        lookahead: !args.no_lookahead,
        window: mark
            .as_ref()
            .map_or_else(|| window(&args.output, &scenario), |mark| mark.window),
    };
    let inputs = inputs(named, &folder, &scenario)?;
    let mut marker = Marker::new(folder.path(), &scenario, options.window, mark);
    let progress = Arc::new(Progress::default());
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let name = folder.name();
    let watch = Watch::start(&args.output, &name, &scenario, Process::default);
    let watch = match runtime.block_on(watch) {
        Ok(watch) => watch,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let bar = Bar::start(&progress, &scenario, args.output.quiet);
    let started = crate::wall::now();
    let mut run = match set_up(&scenario, options, &stop) {
        Ok((mut run, warnings)) => {
            for warning in warnings {
                tracing::warn!("{warning}");
            }
            run.expect_all(&inputs);
            run
        }
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let states_every = args.output.record_states.unwrap_or(0);
    let framed = |sink: Sink| Framed::new(states_every, move |frame| sink(&frame));
    let mut shown = Shown {
        framed: watch.sink().map(framed),
        watchers: (watch.gauged(), StopWhen(watch.is_broken())),
        folder,
        progress: &progress,
        stop: &stop,
        devices: u64::from(scenario.devices),
        outages: 0,
    };
    let goes_on = run.advance(Tti(scenario.ttis), &mut (&mut shown, &mut marker));
    if let Some(tti) = run.undecided() {
        let error = anyhow!(
            "the log of inputs has no decision for TTI {tti} of {}: the run that it is of has not come further. \
             `reveille up --resume` in the folder of that run asks for the rest",
            scenario.ttis
        );
        shown.folder.fail(&error);
        return Err(error);
    }
    let left = run.take_decisions();
    let outcome = if goes_on {
        run.finish(&mut (&mut shown, &mut marker))
    } else {
        run.cut_short()
    };
    marker.check()?;
    let has_all = left.is_empty() && shown.outages == inputs.outages.len();
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
    shown.folder.keep_learned(&scenario, &outcome)?;
    // What the tables have to say of a disk that is full comes first.
    shown.folder.finish(&scenario, &outcome, &summary)?;
    marked?;
    conclude(&args.output, &summary, &path)
}

/// What the command names of inputs: a log, or decisions that were `given` for a policy.
fn named(args: &RunArgs, scenario: &Scenario, given: Option<Inputs>) -> anyhow::Result<Option<Inputs>> {
    let Some(path) = &args.inputs else {
        ensure!(
            given.is_some() || args.output.resume.is_some() || !outside::is_external(&scenario.policy),
            "--policy external: another program decides, and is asked over the bus: `reveille up` and `reveille bs` do \
             that. In memory, --policy replay=FILE takes what it has decided, the inputs.log of such a run; and from \
             Python a run can be stepped"
        );
        return Ok(given);
    };
    ensure!(
        !outside::is_external(&scenario.policy),
        "--inputs is for a policy of this program; decisions, and all else in the log, come with --policy replay=FILE"
    );
    let inputs = input_log::read(path, scenario).context("--inputs")?;
    ensure!(
        inputs.decisions.is_empty(),
        "--inputs: decisions are in it: {}",
        input_log::MISFIT
    );
    Ok(Some(inputs))
}

/// What the run depends on besides: what its folder holds, or what the command has `named`, which is copied there.
fn inputs(named: Option<Inputs>, folder: &RunFolder, scenario: &Scenario) -> anyhow::Result<Inputs> {
    let Some(inputs) = named else {
        return input_log::of_folder(folder.path(), scenario);
    };
    InputLog::new(folder.path(), scenario).add_all(&inputs)?;
    Ok(inputs)
}

/// Sets a run up on another thread, which takes a while with a million devices or a search before the run; at a signal
/// it is given up, since there is nothing to lose yet. Also gives what the user should know of the search.
fn set_up(scenario: &Scenario, options: Options, stop: &AtomicBool) -> anyhow::Result<(Run, Vec<String>)> {
    let (sender, receiver) = channel();
    let scenario = scenario.clone();
    std::thread::spawn(move || {
        let prepared = prepare(&scenario);
        let run = Run::new(&prepared, options);
        // After a signal nobody waits for it.
        let _ = sender.send((run, prepared.warnings));
    });
    loop {
        match receiver.recv_timeout(LOOK) {
            Ok(run) => return Ok(run),
            Err(RecvTimeoutError::Timeout) if stop.load(Ordering::Relaxed) => bail!(Interrupted),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => bail!("the run could not be set up"),
        }
    }
}

/// Ctrl-C has ended a run before its first TTI.
#[derive(Debug)]
pub struct Interrupted;

impl std::fmt::Display for Interrupted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("interrupted before the first TTI")
    }
}

impl std::error::Error for Interrupted {}

/// Writes the series, records, and shows the progress.
struct Shown<'a, F, W> {
    framed: Option<Framed<F>>,
    watchers: W,
    folder: RunFolder,
    progress: &'a Progress,
    stop: &'a AtomicBool,
    devices: u64,
    outages: usize,
}

impl<F: FnMut(Frame), W: Observer> Observer for Shown<'_, F, W> {
    fn see(&mut self, happening: &Happening<'_>) {
        self.outages += usize::from(matches!(happening, Happening::Gone(_)));
        self.folder.see(happening);
        self.framed.see(happening);
        self.watchers.see(happening);
    }

    fn wants_states(&self) -> bool {
        self.framed.wants_states() || self.watchers.wants_states()
    }

    fn wants_beliefs(&self) -> bool {
        self.framed.wants_beliefs() || self.watchers.wants_beliefs()
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        let goes_on = self.watchers.window(window);
        let device_ttis = u128::from((window.end - window.first) * self.devices).max(1);
        self.progress.tti.store(window.end.0, Ordering::Relaxed);
        self.progress.events.fetch_add(window.events.events, Ordering::Relaxed);
        self.progress
            .misdetected
            .fetch_add(window.events.misdetected, Ordering::Relaxed);
        self.progress
            .mean_battery
            .store((window.energy.battery_sum / device_ttis) as u64, Ordering::Relaxed);
        self.folder.window(window) && goes_on && !self.stop.load(Ordering::Relaxed)
    }
}
