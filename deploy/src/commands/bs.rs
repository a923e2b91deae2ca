//! `reveille bs`: the base station, for devices started by hand; also the code that `up` and `bs` share.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail, ensure};
use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::Observer;
use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_bs::server::{self, BsError, OnLoss, RunProgress, RunSpec, ServerConfig, ServerOutcome, policy_port};
use reveille_bs::session::Session;
use reveille_common::bus::{Bus, DeclarationGuard, draw_secret};
use reveille_common::keys::RunName;
use reveille_common::message::{DescribeRequest, Description, Pace, ReadLog};
use reveille_lab::preparation::prepare as prepare_run;
use reveille_lab::run::StopWhen;
use reveille_view::metrics::ProcessStats;

use super::inspect::source::groups;
use super::resolve_scenario::resolve_run;
use super::resume::{self, ResumePlan};
use super::{conclude, window};
use crate::audit::{self, Auditor, device_owner};
use crate::cli::{AuditArg, BsArgs, DriveArgs, OutputArgs};
use crate::dashboard::feed::{Feed, FeedHandle};
use crate::display::{Bar, note};
use crate::exit::Interrupted;
use crate::input_log::{self, INPUTS, InputLog};
use crate::policy_process::PolicyProcess;
use crate::policy_source::{PolicySource, policy_source};
use crate::resume_mark::ResumeMarkWriter;
use crate::run_folder::RunFolder;
use crate::run_watchers::RunWatchers;
use crate::signals::{Manner, Signals, aside};
use crate::summary::{Summary, Timing};
use crate::{file_limits, key, recording, run_registry};

/// Time between two checks for the cause of an end.
const LOOK: Duration = Duration::from_millis(20);
/// Time for dashboard pages to learn that the run has ended.
const SHOWN: Duration = Duration::from_millis(200);
/// Time for observers on the bus to receive the last messages of an ended run.
const DRAIN: Duration = Duration::from_secs(1);

/// Serves a run to device processes started separately.
pub(crate) async fn run(args: &BsArgs) -> anyhow::Result<ExitCode> {
    let started = crate::runtime::now();
    let (scenario, given) = resolve_run(&args.scenario, &args.output)?;
    check(&args.output, &args.drive)?;
    let deciding = policy_source(&scenario, given, &args.drive)?;
    file_limits::for_any_station(scenario.run.devices)?;
    // Installed before the bus and the folder exist, so that no signal can leave something half made.
    let signals = Signals::install(Manner::Keeps)?;
    let bus = Bus::listen(&args.listen, args.run.clone()).await?;
    // The folder comes last: --force empties it, and an endpoint in use must not cost the old run.
    let folder = RunFolder::create(&args.output, &scenario)?;
    let window = window(&args.output, &scenario);
    let key = match &args.key_file {
        Some(path) => key::read_or_make(path)?,
        None => draw_secret()?,
    };
    let settings = ServerConfig {
        join_patience: args.join_timeout,
        key: Some(key),
        // A drawn key reaches no device process that was started by hand, so only a key file limits the members.
        members_only: args.key_file.is_some(),
        ..settings(&args.drive, &args.output, window)
    };
    if !args.output.quiet {
        note!(
            "waiting for {} devices: reveille device --connect {} --run {} --count …",
            scenario.run.devices,
            run_registry::reachable_endpoint(bus.endpoint()),
            args.run
        );
    }
    let progress = Arc::new(RunProgress::default());
    serve(
        &Service {
            bus: &bus,
            run: &args.run,
            scenario: &scenario,
            settings,
            output: &args.output,
            dashboard: args.drive.dashboard.as_deref(),
            audit: args.drive.audit,
            deciding,
            progress,
            signals: &signals,
            started,
        },
        folder,
        |_| {},
    )
    .await
}

/// A base station ready to serve.
pub(crate) struct Service<'a> {
    /// The bus session.
    pub bus: &'a Bus,
    /// The run's name.
    pub run: &'a RunName,
    /// The scenario.
    pub scenario: &'a Scenario,
    /// Server settings of the run.
    pub settings: ServerConfig,
    /// Options for the display of results.
    pub output: &'a OutputArgs,
    /// Address of the dashboard, if it is served.
    pub dashboard: Option<&'a str>,
    /// Extent of the audit.
    pub audit: AuditArg,
    /// Source of decisions under the policy `external`.
    pub deciding: PolicySource<'a>,
    /// The run's progress.
    pub progress: Arc<RunProgress>,
    /// The signals that end the run.
    pub signals: &'a Signals,
    /// Start time of the command.
    pub started: Instant,
}

/// Checks, before a run folder exists, that the watchers of the run can be started.
///
/// # Errors
/// If one of them cannot.
pub(crate) fn check(output: &OutputArgs, drive: &DriveArgs) -> anyhow::Result<()> {
    crate::run_watchers::check(output)?;
    match &drive.dashboard {
        Some(address) => crate::metrics_server::can_listen("--dashboard", address),
        None => Ok(()),
    }
}

/// Returns the settings that the command line requests.
pub(crate) fn settings(drive: &DriveArgs, output: &OutputArgs, window: u64) -> ServerConfig {
    if drive.no_lookahead && drive.pace != Pace::Max {
        tracing::warn!("--no-lookahead has no effect: a real-time --pace already grants every TTI separately");
    }
    ServerConfig {
        lookahead: !drive.no_lookahead,
        pace: drive.pace,
        on_loss: drive.on_loss.into(),
        window,
        join_patience: None,
        paused: drive.paused,
        state_interval: output.record_states.unwrap_or(0),
        key: None,
        members_only: false,
    }
}

/// Serves the run, writes the results and dismisses the hosts. Calls `look` with the timing before any host leaves.
pub(crate) async fn serve(
    service: &Service<'_>,
    mut folder: RunFolder,
    look: impl FnOnce(&mut Timing),
) -> anyhow::Result<ExitCode> {
    let Service {
        bus,
        scenario,
        output,
        progress,
        signals,
        started,
        ..
    } = service;
    // The first two are held to the end of the run: dropping them withdraws the registration and the queries.
    let RunServices {
        registered: _registered,
        described: _described,
        watch,
        shown,
    } = match prepare(service, folder.path()).await {
        Ok(prepared) => prepared,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let decider = match service
        .deciding
        .start(bus, service.settings.key, progress, output.quiet)
    {
        Ok(decider) => decider,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let path = folder.path().to_owned();
    // A recording that cannot be written ends the run at the end of a window.
    let mut observer = (&mut folder, (watch.metrics_observer(), StopWhen(watch.is_broken())));
    let (watched, seen) = ((*signals).clone(), Arc::clone(progress));
    // The set-up and the loop over TTIs check `stop`, not signals.
    let relay = tokio::spawn(async move {
        watched.first().await;
        seen.stop.store(true, Ordering::Relaxed);
    });
    let bar = Bar::start(progress, scenario, output.quiet);
    let (preparing, served) = match set_up(scenario, progress) {
        Ok(prepared) => {
            let preparing = started.elapsed();
            prepared.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
            let played = Box::pin(play(service, &prepared, &path, &mut observer));
            (preparing, played.await)
        }
        Err(error) => (started.elapsed(), Err(error)),
    };
    relay.abort();
    drop(bar);
    // Called before the farewell: a policy process that leaves because of it must not count as a failure.
    let decider = decider.map(PolicyProcess::run_finished);
    if service.deciding.patience.is_some() {
        // Policy processes may leave now; dropping `decider` ends a started one that does not react.
        let _unheard = policy_port::send_bye(bus).await.is_err();
    }
    drop(decider);
    let ended = match served {
        Ok((served, audited)) => {
            let mut timing = timing(&served, preparing);
            look(&mut timing);
            let summary = Summary {
                audit: Some(audited),
                ..Summary::new(scenario, &served.outcome, timing)
            };
            // The recording is closed even if the learned tables cannot be written. The summary comes last: with it the
            // folder counts as complete.
            let kept = folder.write_learned(scenario, &served.outcome);
            let recorded = summary.to_json().and_then(|text| watch.finish(Some(text)));
            kept.and(recorded)
                .and_then(|()| folder.finish(scenario, &served.outcome, &summary))
                .and_then(|()| conclude(output, &summary, &path))
        }
        Err(error) => {
            let error = match cause(progress).await {
                Some(why) => because(&why, &error),
                None => error,
            };
            folder.fail(&error);
            // The run's own error is the one to report; an error of the recording would hide it.
            let _closed = watch.finish(None).is_ok();
            Err(error)
        }
    };
    // Sent only now: it tells the hosts whether the run failed, and writing the results can fail too.
    server::dismiss_hosts(bus, ended.as_ref().err().map(|error| format!("{error:#}")))?;
    bus.flush_observers(DRAIN).await;
    if let Some(hose) = shown {
        hose.end();
        tokio::time::sleep(SHOWN).await;
    }
    ended
}

/// Plays the run over the bus, together with its replay.
async fn play(
    service: &Service<'_>,
    prepared: &PreparedRun,
    folder: &Path,
    observer: &mut impl Observer,
) -> anyhow::Result<(ServerOutcome, String)> {
    let Service {
        bus,
        scenario,
        settings,
        output,
        progress,
        audit,
        ..
    } = service;
    let log = InputLog::new(folder, scenario);
    let ResumePlan {
        inputs,
        log,
        mark,
        from,
    } = match &output.resume {
        // A replay can be long; `block_in_place` keeps the other tasks of the runtime going.
        Some(_) => tokio::task::block_in_place(|| ResumePlan::from_folder(folder, prepared, log, progress))?,
        None => ResumePlan::new(&service.deciding.recorded, log)?,
    };
    // A resumed run keeps the window of its first part, so that windows.csv gets the same rows.
    let window = mark.as_ref().map_or(settings.window, |mark| mark.window);
    let settings = ServerConfig { window, ..*settings };
    let mut marker = ResumeMarkWriter::new(folder, scenario, window, mark);
    let (session, resumption) = if let Some(from) = from {
        let (session, devices) = tokio::task::block_in_place(|| {
            let mut observers = (&mut *observer, &mut marker);
            resume::replay(prepared, &inputs, from, window, progress, &mut observers)
        })?;
        (session, Some(devices))
    } else {
        let mut session = Session::new(prepared, window);
        for decision in &inputs.decisions {
            session.queue_mut().push_decision(decision.clone());
        }
        (session, None)
    };
    // Before any grant: a run that does not reproduce its mark must not continue.
    marker.check()?;
    let start = audit::AuditStart {
        from: from.unwrap_or_default(),
        inputs: &inputs,
        log,
    };
    let auditor = Auditor::start(prepared, start, *audit, progress);
    // The replay also stores external inputs, so a policy process needs it under every --on-loss.
    let is_kept = settings.on_loss != OnLoss::End || outside::is_external(&scenario.policy);
    let course = RunSpec {
        prepared,
        session,
        resumption: resumption.map(Arc::new),
        replay: is_kept.then(|| auditor.replay()),
        patience: service.deciding.patience,
    };
    let mut observers = (observer, (&mut marker, auditor.observer()));
    let served = server::serve(bus, course, &settings, progress, &mut observers).await;
    // Drops the audit observer, which sends its last batch; the auditor's thread ends only when no sender is left.
    drop(observers);
    let marked = marker.finish(served.as_ref().is_ok_and(|served| served.outcome.complete));
    // The run's own error takes precedence over an error of its mark.
    let served = served?;
    marked?;
    let audited = auditor.finish(&served.outcome);
    if audited.is_err() {
        // A run that failed its audit must not be resumed, so its mark is removed.
        marker.finish(true)?;
    }
    // A fault stops the run in order, as a signal does; only the cause tells them apart.
    if let Some(why) = progress.cause.get() {
        bail!("{why}");
    }
    // An interrupted run may leave logged decisions unused; a complete run that does so had the wrong log.
    let has_all = !served.outcome.complete || served.unused_decisions == 0;
    ensure!(has_all, input_log::MISFIT);
    match audited {
        Ok(audited) => Ok((served, audited.to_string())),
        Err(difference) => bail!(
            "audit failed: the run diverged from its replay at {difference}{}",
            device_owner(progress, &difference)
        ),
    }
}

/// The cause of a stop, if known. Waits briefly: a process's connection ends a moment before the process.
async fn cause(progress: &RunProgress) -> Option<String> {
    for _ in 0..10 {
        if let Some(why) = progress.cause.get() {
            return Some(why.clone());
        }
        tokio::time::sleep(LOOK).await;
    }
    None
}

/// Adds the cause `why` to `error`. A lost host whose process has ended cannot rejoin and was not frozen.
fn because(why: &str, error: &anyhow::Error) -> anyhow::Error {
    // `play` may have returned the cause itself.
    if error.to_string() == why {
        return anyhow!("{why}");
    }
    if let Some(BsError::HostLost { host, first, last, tti }) = error.downcast_ref() {
        anyhow!("{why}: lost host {host} with devices {first} to {last} at TTI {tti}; use --resume to continue the run")
    } else {
        anyhow!("{why}: {error:#}")
    }
}

/// Prepares the run on another thread, which takes a while with a million devices or a search. A stop request abandons
/// the preparation, since there is nothing to lose yet.
fn set_up(scenario: &Scenario, progress: &RunProgress) -> anyhow::Result<PreparedRun> {
    let scenario = scenario.clone();
    let is_over = || progress.stop.load(Ordering::Relaxed);
    // The wait blocks this thread; the task that turns a signal into `stop` runs on another one.
    let ready = tokio::task::block_in_place(|| aside(move || prepare_run(&scenario), is_over))?;
    ready.ok_or_else(|| Interrupted::BEFORE_RUN.into())
}

/// The registration, the descriptions and the watchers of a run, held until its end.
struct RunServices {
    registered: Option<run_registry::Registration>,
    described: [DeclarationGuard; 2],
    watch: RunWatchers,
    /// The handle that feeds the dashboard, if it is served.
    shown: Option<FeedHandle>,
}

async fn prepare(service: &Service<'_>, folder: &Path) -> anyhow::Result<RunServices> {
    let Service {
        run,
        bus,
        scenario,
        output,
        progress,
        ..
    } = service;
    let registered = run_registry::register(run, bus.endpoint(), service.settings.key);
    if let Err(error) = &registered {
        tracing::warn!(
            "{error:#}: `clock` and `inspect` cannot find this run; give them --run {run} and --connect {}, or set \
             XDG_RUNTIME_DIR to a folder that only you can write to",
            bus.endpoint()
        );
    }
    // Read once, so that every observer gets the same files even if they change later.
    let description = Description::from(recording::bundle(scenario)?);
    let log = folder.join(INPUTS);
    let described = [
        bus.serve(move |_: DescribeRequest| description.clone())?,
        // Read from the disk for each request, since the log grows during the run.
        bus.serve_with_secret(move |asked: ReadLog, _| {
            input_log::read_part(&log, asked.from).map_err(|error| format!("{}: {error}", log.display()))
        })?,
    ];
    let (progress, tapped) = (Arc::clone(progress), (*bus).clone());
    let process = move || {
        let get = |value: &AtomicU64| value.load(Ordering::Relaxed);
        ProcessStats {
            hosts: get(&progress.hosts),
            late_ttis: get(&progress.late_ttis),
            max_late_s: get(&progress.max_late) as f64 / 1e9,
            dropped: tapped.dropped_frames(),
            // Filled in by `RunWatchers::start`, which knows the recorder.
            recorder_waited_s: 0.0,
        }
    };
    let watch = RunWatchers::start(output, &run.to_string(), scenario, process).await?;
    let mut shown = None;
    let hose = match service.dashboard {
        Some(address) => {
            let feed = Feed::new(&run.to_string(), scenario, groups(scenario), true, None);
            let served =
                crate::dashboard::serve(address, Arc::clone(&feed), Some(bus.with_key(service.settings.key))).await?;
            note!("dashboard at {}", served.url);
            let hose = feed.open()?;
            shown = Some(hose.clone());
            Some(hose)
        }
        None => None,
    };
    let sink = watch.sink();
    if hose.is_some() || sink.is_some() {
        // The bus has one local sink, so one closure serves both.
        bus.set_local_sink(Box::new(move |frame| {
            if let Some(sink) = &sink {
                sink(frame);
            }
            if let Some(hose) = &hose {
                // The run continues without its dashboard.
                let _gone = hose.take(frame.clone());
            }
        }));
    }
    Ok(RunServices {
        registered: registered.ok(),
        described,
        watch,
        shown,
    })
}

fn timing(served: &ServerOutcome, preparing: Duration) -> Timing {
    let run_s = served.running.as_secs_f64();
    Timing {
        ready_s: (preparing + served.joining).as_secs_f64(),
        run_s,
        ttis_per_s: served.outcome.ttis_done as f64 / run_s,
        hosts: served.hosts,
        grants: served.grants,
        late_ttis: served.lateness.late,
        max_late_ms: served.lateness.max.as_secs_f64() * 1e3,
        malformed_messages: served.malformed,
        unexpected_messages: served.unexpected_messages,
        decisions: served.decisions.decided,
        decisions_refused: served.decisions.refused,
        decisions_held: served.decisions.held,
        losses: served.losses.len(),
        longest_loss_s: served.losses.iter().max().map_or(0.0, Duration::as_secs_f64),
        // `up` measures these: only it knows the device processes.
        host_rss_mb: 0.0,
        host_pss_mb: 0.0,
    }
}
