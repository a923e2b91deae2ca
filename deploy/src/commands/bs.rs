//! `reveille bs`: the base station, for devices started by hand. Also what `up` and `bs` share.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow, bail, ensure};
use reveille_bs::host::port;
use reveille_bs::host::{self, BsError, Course, Decisions, OnLoss, Progress, Served, Settings};
use reveille_bs::observe::Observer;
use reveille_bs::policy::outside;
use reveille_bs::prepared::Prepared;
use reveille_common::bus::{Bus, Declared, draw_secret};
use reveille_common::keys::RunName;
use reveille_common::message::{Describe, Description, Pace, ReadLog};
use reveille_common::scenario::Scenario;
use reveille_lab::preparation::prepare as prepare_run;
use reveille_lab::run::StopWhen;
use reveille_view::metrics::Process;
use tokio::sync::oneshot;

use super::conclusion::{conclude, window};
use super::inspect::source::groups;
use super::resolution::resolve_run;
use super::run::Interrupted;
use super::taken::{self, Beginning};
use crate::cli::{AuditArg, BsArgs, DriveArgs, OutputArgs};
use crate::dashboard::feed::{Feed, Hose};
use crate::decider::{Deciding, deciding};
use crate::display::{Bar, note};
use crate::input_log::{self, INPUTS, InputLog};
use crate::marks::Marker;
use crate::policy_process::PolicyProcess;
use crate::results::RunFolder;
use crate::shadow::{self, Auditor, whose};
use crate::summary::{Summary, Timing};
use crate::watch::Watch;
use crate::{interrupt, key, limits, local, recording};

/// Time between two looks for a signal.
const LOOK: Duration = Duration::from_millis(20);
/// How long pages that follow the run have to be told that it has ended.
const SHOWN: Duration = Duration::from_millis(200);
/// How long observers on the bus may take for the last messages once a run has ended.
const DRAIN: Duration = Duration::from_secs(1);

/// Serves a run to devices that come from elsewhere.
pub async fn run(args: &BsArgs) -> anyhow::Result<ExitCode> {
    let started = crate::wall::now();
    let (scenario, given) = resolve_run(&args.scenario, &args.output)?;
    check(&args.output, &args.drive)?;
    let deciding = deciding(&scenario, given, &args.drive)?;
    limits::for_any_station(scenario.devices)?;
    let bus = Bus::listen(&args.listen, args.run.clone()).await?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    let window = window(&args.output, &scenario);
    let key = match &args.key_file {
        Some(path) => key::read_or_make(path)?,
        None => draw_secret()?,
    };
    let settings = Settings {
        join_patience: args.join_timeout,
        key: Some(key),
        members_only: args.key_file.is_some(),
        ..settings(&args.drive, &args.output, window)
    };
    if !args.output.quiet {
        note!(
            "waiting for {} devices: reveille device --connect {} --run {} --count …",
            scenario.devices,
            local::reachable(bus.endpoint()),
            args.run
        );
    }
    let progress = Arc::new(Progress::default());
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
            started,
        },
        folder,
        |_| {},
    )
    .await
}

/// A base station about to serve.
pub struct Service<'a> {
    /// Its session.
    pub bus: &'a Bus,
    /// The run's name.
    pub run: &'a RunName,
    /// The scenario.
    pub scenario: &'a Scenario,
    /// How the run is driven.
    pub settings: Settings,
    /// How results are shown.
    pub output: &'a OutputArgs,
    /// Where the dashboard is served, if it is.
    pub dashboard: Option<&'a str>,
    /// Whether it is compared with a replay.
    pub audit: AuditArg,
    /// Who decides, where the policy does not.
    pub deciding: Deciding<'a>,
    /// How far the run has come.
    pub progress: Arc<Progress>,
    /// When the command was given.
    pub started: Instant,
}

/// Looks whether what watches the run can be had, before there is a run folder.
///
/// # Errors
/// It cannot.
pub fn check(output: &OutputArgs, drive: &DriveArgs) -> anyhow::Result<()> {
    crate::watch::check(output)?;
    match &drive.dashboard {
        Some(address) => crate::web::can_listen("--dashboard", address),
        None => Ok(()),
    }
}

/// The settings that the command line means.
pub fn settings(drive: &DriveArgs, output: &OutputArgs, window: u64) -> Settings {
    if drive.no_lookahead && drive.pace != Pace::Max {
        tracing::warn!("--no-lookahead has no effect: a real-time --pace grants every TTI by itself anyway");
    }
    Settings {
        lookahead: !drive.no_lookahead,
        pace: drive.pace,
        on_loss: drive.on_loss.into(),
        window,
        join_patience: None,
        paused: drive.paused,
        states_every: output.record_states.unwrap_or(0),
        key: None,
        members_only: false,
    }
}

/// Serves the run, writes the results, dismisses the hosts. `look` is called with the timing before anyone leaves.
pub async fn serve(
    service: &Service<'_>,
    mut folder: RunFolder,
    look: impl FnOnce(&mut Timing),
) -> anyhow::Result<ExitCode> {
    let Service {
        bus,
        scenario,
        output,
        progress,
        started,
        ..
    } = service;
    let Prerequisites {
        registered: _registered,
        described: _described,
        stop,
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
    let mut observer = (&mut folder, (watch.gauged(), StopWhen(watch.is_broken())));
    let (watched, seen) = (Arc::clone(&stop), Arc::clone(progress));
    let relay = tokio::spawn(async move {
        while !watched.load(Ordering::Relaxed) {
            tokio::time::sleep(LOOK).await;
        }
        seen.stop.store(true, Ordering::Relaxed);
    });
    let bar = Bar::start(progress, scenario, output.quiet);
    let (preparing, served) = match set_up(scenario, progress).await {
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
    let decider = decider.map(PolicyProcess::dismissed);
    if service.deciding.decisions.port.is_some() {
        // Who decides may leave; one that does not hear of it is ended all the same.
        let _unheard = port::farewell(bus).await.is_err();
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
            let kept = folder.keep_learned(scenario, &served.outcome);
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
            // The run's error is the one to tell.
            let _closed = watch.finish(None).is_ok();
            Err(error)
        }
    };
    host::dismiss(bus, ended.as_ref().err().map(|error| format!("{error:#}")))?;
    bus.drain(DRAIN).await;
    if let Some(hose) = shown {
        hose.end();
        tokio::time::sleep(SHOWN).await;
    }
    ended
}

/// The run over the bus, and its shadow beside it.
async fn play(
    service: &Service<'_>,
    prepared: &Prepared,
    folder: &Path,
    observer: &mut impl Observer,
) -> anyhow::Result<(Served, String)> {
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
    let Beginning {
        inputs,
        log,
        mark,
        from,
    } = match &output.resume {
        Some(_) => tokio::task::block_in_place(|| Beginning::of_folder(folder, prepared, log))?,
        None => Beginning::new(&service.deciding.decisions.kept, log)?,
    };
    let window = mark.as_ref().map_or(settings.window, |mark| mark.window);
    let settings = Settings { window, ..*settings };
    let mut marker = Marker::new(folder, scenario, window, mark);
    let (taken, decisions) = match from {
        Some(from) => {
            let (taken, decisions) = tokio::task::block_in_place(|| {
                let mut observers = (&mut *observer, &mut marker);
                taken::replay(prepared, &inputs, from, window, progress, &mut observers)
            })?;
            (Some(taken), decisions)
        }
        None => (
            None,
            Decisions {
                kept: inputs.decisions.clone(),
                ..Decisions::default()
            },
        ),
    };
    marker.check()?;
    let start = shadow::Beginning {
        from: from.unwrap_or_default(),
        inputs: &inputs,
        log,
    };
    let auditor = Auditor::start(prepared, start, *audit, progress);
    let is_kept = settings.on_loss != OnLoss::End || outside::is_external(&scenario.policy);
    let course = Course {
        prepared,
        taken,
        replay: is_kept.then(|| auditor.replay()),
        decisions: Decisions {
            port: service.deciding.decisions.port,
            ..decisions
        },
    };
    let mut observers = (observer, (&mut marker, auditor.ear()));
    let served = host::serve(bus, course, &settings, progress, &mut observers).await;
    drop(observers);
    let marked = marker.finish(served.as_ref().is_ok_and(|served| served.outcome.complete));
    // Why the run ended comes first.
    let served = served?;
    marked?;
    let audited = auditor.finish(&served.outcome);
    if audited.is_err() {
        // What is wrong is not gone on with.
        marker.finish(true)?;
    }
    if let Some(why) = progress.cause.get() {
        bail!("{why}");
    }
    let has_all = !served.outcome.complete || served.decisions.left == 0;
    ensure!(has_all, input_log::MISFIT);
    match audited {
        Ok(audited) => Ok((served, audited.to_string())),
        Err(difference) => bail!(
            "the run is not what it should be. {difference}{}",
            whose(progress, &difference)
        ),
    }
}

/// Why the run was stopped, if that is known: the connection of a process is gone a moment before it is.
async fn cause(progress: &Progress) -> Option<String> {
    for _ in 0..10 {
        if let Some(why) = progress.cause.get() {
            return Some(why.clone());
        }
        tokio::time::sleep(LOOK).await;
    }
    None
}

/// `error`, which came about as `why` says. A process that has ended neither comes back nor was frozen.
fn because(why: &str, error: &anyhow::Error) -> anyhow::Error {
    if error.to_string() == why {
        return anyhow!("{why}");
    }
    if let Some(BsError::HostLost { host, first, last, tti }) = error.downcast_ref() {
        anyhow!(
            "{why}: lost host {host} with devices {first} to {last} at TTI {tti}, and the run cannot go on without it"
        )
    } else {
        anyhow!("{why}: {error:#}")
    }
}

/// Finds out on another thread what the run needs, which takes a while with a million devices or a search before it;
/// when it is told to stop, that is given up, since there is nothing to lose yet.
async fn set_up(scenario: &Scenario, progress: &Progress) -> anyhow::Result<Prepared> {
    let (sender, mut receiver) = oneshot::channel();
    let scenario = scenario.clone();
    std::thread::spawn(move || {
        // After a signal nobody waits for it.
        let _ = sender.send(prepare_run(&scenario));
    });
    loop {
        tokio::select! {
            ready = &mut receiver => return ready.context("the run could not be set up"),
            () = tokio::time::sleep(LOOK) => {
                if progress.stop.load(Ordering::Relaxed) {
                    bail!(Interrupted);
                }
            }
        }
    }
}

/// What a run needs beside its scenario: to be found, to be described, to be stopped, and to be watched.
struct Prerequisites {
    registered: Option<local::Registered>,
    described: [Declared; 2],
    stop: Arc<AtomicBool>,
    watch: Watch,
    /// What the dashboard is fed by, if there is one.
    shown: Option<Hose>,
}

async fn prepare(service: &Service<'_>, folder: &Path) -> anyhow::Result<Prerequisites> {
    let Service {
        run,
        bus,
        scenario,
        output,
        progress,
        ..
    } = service;
    let registered = local::register(run, bus.endpoint(), service.settings.key);
    if let Err(error) = &registered {
        tracing::warn!(
            "{error:#}: `clock` and `inspect` will not find this run by themselves; give them --run {run} and \
             --connect {}, or let XDG_RUNTIME_DIR name a folder of your own",
            bus.endpoint()
        );
    }
    let description = Description::from(recording::bundle(scenario)?);
    let log = folder.join(INPUTS);
    let described = [
        bus.serve(move |_: Describe| description.clone())?,
        bus.serve_shown(move |asked: ReadLog, _| {
            input_log::part(&log, asked.from).map_err(|error| format!("{}: {error}", log.display()))
        })?,
    ];
    let (progress, tapped) = (Arc::clone(progress), (*bus).clone());
    let process = move || {
        let get = |value: &AtomicU64| value.load(Ordering::Relaxed);
        Process {
            hosts: get(&progress.hosts),
            late_ttis: get(&progress.late_ttis),
            max_late_s: get(&progress.max_late) as f64 / 1e9,
            left_out: tapped.left_out(),
            recorder_waited_s: 0.0,
        }
    };
    let watch = Watch::start(output, &run.to_string(), scenario, process).await?;
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
        bus.copy_to(Box::new(move |frame| {
            if let Some(sink) = &sink {
                sink(frame);
            }
            if let Some(hose) = &hose {
                let _gone = hose.take(frame.clone());
            }
        }));
    }
    Ok(Prerequisites {
        registered: registered.ok(),
        described,
        stop: interrupt::watch()?,
        watch,
        shown,
    })
}

fn timing(served: &Served, preparing: Duration) -> Timing {
    let run_s = served.running.as_secs_f64();
    Timing {
        ready_s: (preparing + served.joining).as_secs_f64(),
        run_s,
        ttis_per_s: served.outcome.ttis_done as f64 / run_s,
        hosts: served.hosts,
        grants: served.grants,
        late_ttis: served.lateness.late,
        max_late_ms: served.lateness.max.as_secs_f64() * 1e3,
        malformed: served.malformed,
        strays: served.strays,
        decisions: served.decisions.decided,
        decisions_refused: served.decisions.refused,
        decisions_held: served.decisions.held,
        losses: served.losses.len(),
        longest_loss_s: served.losses.iter().max().map_or(0.0, Duration::as_secs_f64),
        host_rss_mb: 0.0,
        host_pss_mb: 0.0,
    }
}
