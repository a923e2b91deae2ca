//! `reveille bs`: the base station, for devices started by hand. [`serve_run`] is the whole run over the bus, which
//! `up` shares: services, replay and audit, results, farewell. The order of its steps is a guarantee: the summary is
//! written after all other files, since it marks the folder as complete, and the hosts leave after it. Tests wait for
//! the notes `waiting for N devices` and `dashboard at`, and rely on handlers of signals installed before them. Tests
//! and `bench watch` read the address in the latter.

use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail, ensure};
use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::Observer;
use reveille_bs::scenario::Scenario;
use reveille_bs::server::{self, BsError, RunProgress, RunSpec, ServerConfig, ServerOutcome, policy_port};
use reveille_bs::session::Session;
use reveille_common::bus::{Bus, DeclarationGuard, Endpoint, Role, draw_secret};
use reveille_common::keys::RunName;
use reveille_common::message::{DescribeRequest, InputLogRequest, Pace, ScenarioDescription};
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare as prepare_run;
use reveille_lab::run::StopWhen;
use reveille_view::metrics::{HostLabels, ProcessStats};

use super::device::split_process_name;
use super::inspect::source::device_groups;
use super::resolve_scenario::{resolve_started_run, warn_about_depletion};
use super::resume::{self, ResumePlan};
use super::{print_results, window_length};
use crate::audit::{self, Auditor, device_owner_clause};
use crate::cli::{AuditArg, BsArgs, DriveArgs, OutputArgs};
use crate::dashboard::feed::{Feed, FeedHandle, FeedOrigin};
use crate::display::{RunProgressBar, count_noun, note};
use crate::exit::Interrupted;
use crate::input_log::{self, INPUT_LOG_FILE, InputLog};
use crate::policy_process::PolicyProcess;
use crate::policy_source::{PolicySource, select_policy_source};
use crate::resume_mark::ResumeMarkWriter;
use crate::run_folder::RunFolder;
use crate::run_registry::RegisteredRun;
use crate::run_watchers::{RunWatchers, check_observers};
use crate::saved_address::SavedAddress;
use crate::signals::{SignalMode, Signals, run_on_thread};
use crate::summary::{Summary, Timing};
use crate::{file_limits, key, recording, run_registry, tls};

/// Default address, which `cli/run.rs` repeats.
const DEFAULT_LISTEN: &str = "tcp/127.0.0.1:7447";
/// Time between two checks for the cause of an end.
const CAUSE_POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Most checks for the cause of an end.
const MAX_CAUSE_POLLS: u32 = 10;
/// Time for dashboard pages to learn that the run has ended.
const DASHBOARD_GRACE: Duration = Duration::from_millis(200);
/// Time for observers on the bus to receive the last messages of an ended run.
const OBSERVER_DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// Serves a run to device processes started separately.
pub(crate) async fn run(args: &BsArgs) -> anyhow::Result<ExitCode> {
    let started = crate::runtime::now();
    let tls_files = tls::files_of_role(args.tls.as_deref(), &[Role::Bs])?;
    let (scenario, recorded_inputs) = resolve_started_run(&args.scenario, &args.output)?;
    check_observers(&args.output, &args.drive)?;
    let policy_source = select_policy_source(&scenario, recorded_inputs.as_ref(), &args.drive)?;
    let inputs = args.actions.read(&scenario, recorded_inputs)?;
    file_limits::ensure_for_unknown_processes(scenario.run.devices)?;
    // Installed before the bus and the folder exist, so that no signal can leave something half made.
    let signals = Signals::install(SignalMode::SavesResults)?;
    warn_about_depletion(&scenario);
    let earlier = SavedAddress::of_resumed(args.output.resume.as_deref());
    // Without --resume, --run is required.
    let resumed_folder = args.output.resume.as_deref().unwrap_or(Path::new(""));
    let run = earlier.run_in(args.run.as_ref(), resumed_folder)?;
    let listen = earlier.listen(args.listen.as_deref(), DEFAULT_LISTEN, false);
    let endpoint = Endpoint {
        address: listen,
        tls: tls_files.as_ref(),
    };
    let bus = Bus::listen(endpoint, run.clone()).await?;
    // The folder comes last: --force empties it, and an endpoint in use must not cost the old run.
    let folder = RunFolder::create(&args.output, &scenario)?;
    let run_id = earlier.write(folder.path(), Some(&run), (listen, bus.endpoint()))?;
    let window = window_length(&args.output, &scenario);
    let key = match &args.key_file {
        Some(path) => key::read_or_create(path)?,
        None => draw_secret()?,
    };
    let settings = ServerConfig {
        run_id,
        join_timeout: args.join_timeout,
        run_key: Some(key),
        // A drawn key reaches no device process that was started by hand, so only a key file limits the members.
        join_needs_key: args.key_file.is_some(),
        ..server_settings(&args.drive, &args.output, window)
    };
    if !args.output.quiet {
        note!(
            "waiting for {}: reveille device --connect {} --run {}{}",
            count_noun(scenario.run.devices, "device"),
            run_registry::reachable_endpoint(bus.endpoint()),
            run,
            if args.tls.is_some() { " --tls FOLDER" } else { "" }
        );
    }
    let progress = Arc::new(RunProgress::default());
    serve_run(
        &RunService {
            bus: &bus,
            command: "bs",
            run: &run,
            tls: args.tls.as_deref(),
            key_file: args.key_file.as_deref(),
            scenario: &scenario,
            settings,
            output: &args.output,
            dashboard: args.drive.dashboard.as_deref(),
            holds_dashboard: args.drive.hold,
            audit: args.drive.audit,
            inputs,
            policy_source,
            progress,
            signals: &signals,
            started,
        },
        folder,
        |_| {},
    )
    .await
}

/// A base station ready to serve a run.
pub(crate) struct RunService<'a> {
    /// The bus session.
    pub bus: &'a Bus,
    /// The subcommand that serves the run: `bs` or `up`.
    pub command: &'static str,
    /// The run's name.
    pub run: &'a RunName,
    /// The folder of certificates, if the bus is encrypted.
    pub tls: Option<&'a Path>,
    /// The file of `--key-file`.
    pub key_file: Option<&'a Path>,
    /// The scenario.
    pub scenario: &'a Scenario,
    /// Server settings of the run. The mark of a resumed run replaces `window_ttis`.
    pub settings: ServerConfig,
    /// Options for the results and their display.
    pub output: &'a OutputArgs,
    /// Address of the dashboard, if it is served.
    pub dashboard: Option<&'a str>,
    /// Whether the dashboard is served until a signal.
    pub holds_dashboard: bool,
    /// Extent of the audit.
    pub audit: AuditArg,
    /// External inputs of a new run: decisions of an earlier run, and scripted actions. A resumed run takes its inputs
    /// from its folder instead.
    pub inputs: ExternalInputs,
    /// Source of decisions under the policy `external`.
    pub policy_source: PolicySource<'a>,
    /// The run's progress, which also carries the request to stop and its cause.
    pub progress: Arc<RunProgress>,
    /// The signals that end the run.
    pub signals: &'a Signals,
    /// Start time of the command.
    pub started: Instant,
}

/// Returns the settings that the command line requests, with windows of `window` TTIs. The caller sets `run_id`,
/// `join_timeout`, `run_key` and `join_needs_key`, which differ between runs.
pub(crate) fn server_settings(drive: &DriveArgs, output: &OutputArgs, window: u64) -> ServerConfig {
    if drive.no_lookahead && drive.pace != Pace::Max {
        tracing::warn!("--no-lookahead has no effect: a real-time --pace already grants every TTI separately");
    }
    ServerConfig {
        run_id: 0,
        lookahead: !drive.no_lookahead,
        pace: drive.pace,
        on_loss: drive.on_loss.into(),
        loss_timeout: drive.loss_timeout,
        window_ttis: window,
        join_timeout: None,
        starts_paused: drive.paused,
        state_interval_ttis: output.record_states.unwrap_or(0),
        run_key: None,
        join_needs_key: false,
    }
}

/// Serves the run, writes the results to `folder` and dismisses the hosts. After a run without error it calls
/// `on_timing` while all hosts still live, so that `up` can measure its device processes.
///
/// # Errors
/// If an observer or the policy process cannot be started, the run or its audit fails, or the results cannot be
/// written. The folder is then marked as failed.
pub(crate) async fn serve_run(
    service: &RunService<'_>,
    mut folder: RunFolder,
    on_timing: impl FnOnce(&mut Timing),
) -> anyhow::Result<ExitCode> {
    let RunService {
        bus,
        scenario,
        output,
        progress,
        signals,
        started,
        ..
    } = service;
    let starting = start_observation(service, folder.path()).await.and_then(|observation| {
        let (key, tls) = (service.settings.run_key, service.tls);
        let policy = service.policy_source.start((bus, tls), key, progress, output.quiet)?;
        Ok((observation, policy))
    });
    let (observation, policy_process) = match starting {
        Ok(started) => started,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    // The first two are held to the end of the run: dropping them withdraws the registration and the queries.
    let RunObservation {
        registration,
        described,
        watchers,
        feed_handle,
    } = observation;
    let path = folder.path().to_owned();
    // A recording that cannot be written ends the run at the end of a window.
    let recording_check = StopWhen(watchers.recording_failure_check());
    let mut observer = (&mut folder, (watchers.metrics_observer(), recording_check));
    let (relay_signals, relay_progress) = ((*signals).clone(), Arc::clone(progress));
    // The set-up and the loop over TTIs check `progress`, not signals.
    let relay = tokio::spawn(async move {
        relay_signals.wait_for_first().await;
        relay_progress.request_stop();
    });
    let bar = RunProgressBar::start(progress, scenario, output.quiet);
    let (preparation_time, served) = match prepare_on_thread(scenario, progress) {
        Ok(prepared) => {
            let preparation_time = started.elapsed();
            prepared.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
            let run = Box::pin(run_over_bus(service, &prepared, &path, &mut observer));
            (preparation_time, run.await)
        }
        Err(error) => (started.elapsed(), Err(error)),
    };
    relay.abort();
    drop(bar);
    // Called before the farewell: a policy process that leaves because of it must not count as a failure.
    let policy_process = policy_process.map(PolicyProcess::allow_end);
    if service.policy_source.decision_timeout.is_some() {
        // Policy processes may leave now; dropping `policy_process` ends a started one that does not react.
        let _unheard = policy_port::send_bye(bus).await.is_err();
    }
    drop(policy_process);
    let result = match served {
        Ok((served, audited)) => {
            let mut timing = timing(&served, preparation_time);
            on_timing(&mut timing);
            let summary = Summary {
                audit: Some(audited),
                ..Summary::new(scenario, &served.outcome, timing)
            };
            // The recording is closed even if the learned tables cannot be written. The summary comes last: with it the
            // folder counts as complete.
            let learned_written = folder.write_learned(scenario, &served.outcome);
            let recording_closed = match summary.to_json() {
                Ok(text) => watchers.finish(Some(text)).await,
                Err(error) => Err(error),
            };
            learned_written
                .and(recording_closed)
                .and_then(|()| folder.finish(scenario, &served.outcome, &summary))
                .and_then(|()| print_results(output, &summary, &path))
        }
        Err(error) => {
            let error = match wait_for_cause(progress).await {
                Some(cause) => with_cause(&cause, &error),
                None => error,
            };
            folder.fail(&error);
            // The run's own error is the one to report; an error of the recording would hide it.
            let _closed = watchers.finish(None).await.is_ok();
            Err(error)
        }
    };
    // Sent only now: it tells the hosts whether the run failed, and writing the results can fail too.
    server::dismiss_hosts(bus, result.as_ref().err().map(|error| format!("{error:#}"))).await?;
    bus.flush_observers(OBSERVER_DRAIN_TIMEOUT).await;
    if let Some(feed_handle) = feed_handle {
        // The run has ended for all other programs.
        drop((registration, described));
        end_dashboard(&feed_handle, service.holds_dashboard && result.is_ok(), signals).await;
    }
    result
}

/// Ends the dashboard's feed of the run. If `holds`, serves the dashboard until the first signal.
async fn end_dashboard(feed_handle: &FeedHandle, holds: bool, signals: &Signals) {
    feed_handle.end();
    tokio::time::sleep(DASHBOARD_GRACE).await;
    if holds && !signals.has_arrived() {
        signals.note_saved();
        note!("the dashboard is served until Ctrl-C");
        signals.wait_for_first().await;
    }
}

/// Runs over the bus, together with the replay. Returns the outcome and the extent of the audit, for the
/// summary.
async fn run_over_bus(
    service: &RunService<'_>,
    prepared: &PreparedRun,
    folder: &Path,
    observer: &mut impl Observer,
) -> anyhow::Result<(ServerOutcome, String)> {
    let RunService {
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
        window,
        resume_tti,
    } = match &output.resume {
        // A replay can be long; `block_in_place` keeps the other tasks of the runtime going.
        Some(_) => tokio::task::block_in_place(|| ResumePlan::from_folder(folder, prepared, log, progress))?,
        None => ResumePlan::new(&service.inputs, log)?,
    };
    // A resumed run keeps the window of its first part, so that windows.csv gets the same rows.
    let window = window.unwrap_or(settings.window_ttis);
    let settings = ServerConfig {
        window_ttis: window,
        ..*settings
    };
    let mut mark_writer = ResumeMarkWriter::new(folder, scenario, window, mark);
    let (session, checkpoint) = if let Some(tti) = resume_tti {
        let (session, devices) = tokio::task::block_in_place(|| {
            let mut observers = (&mut *observer, &mut mark_writer);
            resume::replay(prepared, &inputs, tti, window, progress, &mut observers)
        })?;
        (session, Some(devices))
    } else {
        let mut session = Session::new(prepared, window);
        let queue = session.input_queue_mut();
        for decision in &inputs.decisions {
            queue.push_decision(decision.clone());
        }
        for action in &inputs.actions {
            queue.add_action(*action);
        }
        (session, None)
    };
    // Before any grant: a run that does not reproduce its mark must not continue.
    mark_writer.check()?;
    let audit_start = audit::AuditStart {
        from: resume_tti.unwrap_or_default(),
        inputs: &inputs,
        input_log: log,
    };
    let auditor = Auditor::start(prepared, audit_start, *audit, progress);
    let spec = RunSpec {
        prepared,
        session,
        checkpoint: checkpoint.map(Arc::new),
        // The replay also stores external inputs, so actions and a policy process need it under every --on-loss.
        replay: Some(auditor.replay_source()),
        decision_timeout: service.policy_source.decision_timeout,
    };
    let mut observers = (observer, (&mut mark_writer, auditor.observer()));
    let served = server::serve(bus, spec, &settings, progress, &mut observers).await;
    // Drops the audit observer, which sends its last batch; the auditor's thread ends only when no sender is left.
    drop(observers);
    let mark_finished = mark_writer.finish(served.as_ref().is_ok_and(|served| served.outcome.is_complete));
    // The run's own error takes precedence over an error of its mark.
    let served = served?;
    mark_finished?;
    let audited = auditor.finish(&served.outcome);
    if audited.is_err() {
        // A run that failed its audit must not be resumed: its mark is removed, as the mark of a complete run is.
        mark_writer.finish(true)?;
    }
    // A fault stops the run in order, as a signal does; only the cause tells them apart.
    if let Some(cause) = progress.stop_cause() {
        bail!("{cause}");
    }
    // An interrupted run may leave logged decisions unused; a complete run that does so had the wrong log.
    let fits_log = !served.outcome.is_complete || served.unused_decisions == 0;
    ensure!(fits_log, input_log::MISMATCH);
    match audited {
        Ok(audited) => Ok((served, audited.to_string())),
        Err(divergence) => bail!(
            "audit failed: the run diverged from its replay at {divergence}{}",
            device_owner_clause(progress, &divergence)
        ),
    }
}

/// Returns the cause of a stop, if known. Waits briefly: a process's connection ends a moment before the process.
async fn wait_for_cause(progress: &RunProgress) -> Option<String> {
    for _ in 0..MAX_CAUSE_POLLS {
        if let Some(cause) = progress.stop_cause() {
            return Some(cause.to_owned());
        }
        tokio::time::sleep(CAUSE_POLL_INTERVAL).await;
    }
    None
}

/// Adds `cause` to `error`. A lost host whose process has ended cannot rejoin and was not frozen.
fn with_cause(cause: &str, error: &anyhow::Error) -> anyhow::Error {
    // `run_over_bus` may have returned the cause itself.
    if error.to_string() == cause {
        return anyhow!("{cause}");
    }
    if let Some(BsError::HostLost { lost, tti }) = error.downcast_ref() {
        anyhow!("{cause}: lost {lost} at TTI {tti}; use --resume to continue the run")
    } else {
        anyhow!("{cause}: {error:#}")
    }
}

/// Prepares the run on another thread, which takes a while with a million devices or a search. A stop request abandons
/// the preparation, since there is nothing to lose yet.
fn prepare_on_thread(scenario: &Scenario, progress: &RunProgress) -> anyhow::Result<PreparedRun> {
    let scenario = scenario.clone();
    let is_abandoned = || progress.is_stop_requested();
    // The wait blocks this thread; the task that turns a signal into a stop request runs on another one.
    let prepared = tokio::task::block_in_place(|| run_on_thread(move || prepare_run(&scenario), is_abandoned))?;
    prepared.ok_or_else(|| Interrupted::BEFORE_RUN.into())
}

/// The parts of a run by which others find and observe it, held until its end.
struct RunObservation {
    /// The entry by which `clock` and `inspect` find the run on this machine; `None` if it could not be written.
    registration: Option<run_registry::Registration>,
    /// The answers to queries for the scenario and for the input log.
    described: [DeclarationGuard; 2],
    /// The recording and the metrics.
    watchers: RunWatchers,
    /// The handle that feeds the dashboard, if it is served.
    feed_handle: Option<FeedHandle>,
}

/// The hosts with devices and their numbers of devices, for the metrics.
fn host_devices(progress: &RunProgress) -> Vec<(HostLabels, u32)> {
    let owners = progress.owners.lock().unwrap_or_else(PoisonError::into_inner);
    let labels = owners.iter().map(|(assignment, name)| {
        let (pid, machine, address) = split_process_name(name);
        let labels = HostLabels {
            host: assignment.host.0,
            pid: pid.to_owned(),
            machine: machine.to_owned(),
            address: address.to_owned(),
        };
        (labels, assignment.count)
    });
    labels.collect()
}

/// Starts all that observes the run in `folder`, before any device joins.
async fn start_observation(service: &RunService<'_>, folder: &Path) -> anyhow::Result<RunObservation> {
    let RunService {
        run,
        bus,
        scenario,
        output,
        progress,
        ..
    } = service;
    let registration = run_registry::register(&RegisteredRun {
        run,
        endpoint: bus.endpoint(),
        key: service.settings.run_key,
        command: service.command,
        tls: service.tls,
        key_file: service.key_file,
        folder,
    });
    if let Err(error) = &registration {
        tracing::warn!(
            "{error:#}: `clock` and `inspect` cannot find this run; give them --run {run} and --connect {}, or set \
             XDG_RUNTIME_DIR to a folder that only you can write to",
            bus.endpoint()
        );
    }
    // Read once, so that every observer gets the same files even if they change later.
    let description = ScenarioDescription::from(recording::bundle_scenario(scenario)?);
    let log = folder.join(INPUT_LOG_FILE);
    let described = [
        bus.serve(move |_: DescribeRequest| description.clone())?,
        // Read from the disk for each request, since the log grows during the run.
        bus.serve_with_secret(move |request: InputLogRequest, _| {
            input_log::read_part(&log, request.from).map_err(|error| format!("{}: {error}", log.display()))
        })?,
    ];
    let (progress, bus_copy) = (Arc::clone(progress), (*bus).clone());
    let process_stats = move || {
        let load = |value: &AtomicU64| value.load(Ordering::Relaxed);
        ProcessStats {
            hosts: load(&progress.active_host_count),
            host_devices: host_devices(&progress),
            late_ttis: load(&progress.late_ttis),
            max_late_s: load(&progress.max_late_ns) as f64 / 1e9,
            dropped_frames: bus_copy.dropped_frames(),
            // Filled in by `RunWatchers::start`, which knows the recorder.
            recorder_waited_s: 0.0,
        }
    };
    let watchers = RunWatchers::start(output, &run.to_string(), scenario, process_stats).await?;
    let feed_handle = match service.dashboard {
        Some(address) => {
            let feed = Feed::new(
                &run.to_string(),
                scenario,
                device_groups(scenario),
                FeedOrigin::OwnRun(folder),
                None,
            );
            let dashboard =
                crate::dashboard::serve(address, Arc::clone(&feed), Some(bus.with_key(service.settings.run_key)))
                    .await?;
            note!("dashboard at {}", dashboard.url);
            Some(feed.open()?)
        }
        None => None,
    };
    let (sink, sink_feed) = (watchers.sink(), feed_handle.clone());
    if sink_feed.is_some() || sink.is_some() {
        // The bus has one local sink, so one closure serves both.
        bus.set_local_sink(Box::new(move |frame| {
            if let Some(sink) = &sink {
                sink(frame);
            }
            if let Some(sink_feed) = &sink_feed {
                // The run continues without its dashboard.
                let _gone = sink_feed.send(frame.clone());
            }
        }));
    }
    Ok(RunObservation {
        registration: registration.ok(),
        described,
        watchers,
        feed_handle,
    })
}

fn timing(served: &ServerOutcome, preparation_time: Duration) -> Timing {
    let run_s = served.running_time.as_secs_f64();
    Timing {
        ready_s: (preparation_time + served.joining_time).as_secs_f64(),
        run_s,
        // Without the TTIs that a resumed run replays before.
        ttis_per_s: served.outcome.ttis_done.saturating_sub(served.first_tti.0) as f64 / run_s,
        hosts: served.process_count,
        grants: served.grant_count,
        late_ttis: served.lateness.late_ttis,
        max_late_ms: served.lateness.max_delay.as_secs_f64() * 1e3,
        malformed_messages: served.malformed_payloads,
        unexpected_messages: served.unexpected_messages,
        decisions: served.decisions.decided,
        decisions_refused: served.decisions.refused_answers,
        decisions_held: served.decisions.held,
        losses: served.loss_durations.len(),
        longest_loss_s: served.loss_durations.iter().max().map_or(0.0, Duration::as_secs_f64),
        // `up` measures these: only it knows the device processes.
        host_rss_mb: None,
        host_pss_mb: None,
    }
}
