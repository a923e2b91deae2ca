//! `reveille up`: a base station and its device processes on this machine.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::Context;
use reveille_bs::host::Progress;
use reveille_common::bus::{self, Bus};
use reveille_common::keys::RunName;
use reveille_device::host::{self, HostError};

use super::bs::{Service, check, serve, settings};
use super::conclusion::window;
use super::resolution::resolve;
use super::run::Interrupted;
use crate::cli::{OnLossArg, UpArgs};
use crate::launch::Children;
use crate::results::RunFolder;
use crate::summary::Timing;

/// Device processes, where the command line says nothing.
const PROCESSES: u32 = 4;
/// How long all device processes may take to join.
const JOIN: Duration = Duration::from_mins(1);

/// Runs everything on this machine.
pub async fn run(args: &UpArgs, log: &[String]) -> anyhow::Result<ExitCode> {
    let started = crate::wall::now();
    let scenario = resolve(&args.scenario)?;
    let devices = scenario.devices;
    let processes = args.processes.unwrap_or(PROCESSES.min(devices));
    anyhow::ensure!(
        processes <= devices,
        "--processes {processes}: there are only {devices} devices; 0 to {devices} is allowed"
    );
    if processes == 0 && args.drive.on_loss == OnLossArg::Wait {
        tracing::warn!("--on-loss has no effect: with --processes 0 there is no device process to lose");
    }
    check(&args.output, &args.drive)?;
    crate::limits::for_station(processes)?;
    // Before there is a folder: one that is to be replaced stays as it is, if this is where it ends.
    let endpoint = bus::free_to_listen(&args.listen)?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    match listen(args, &endpoint, &folder).await {
        Ok((bus, run)) => {
            let service = Service {
                settings: settings(&args.drive, &args.output, window(&args.output, &scenario), Some(JOIN)),
                bus: &bus,
                run: &run,
                scenario: &scenario,
                output: &args.output,
                dashboard: args.drive.dashboard.as_deref(),
                progress: Arc::default(),
                started,
            };
            attend(processes, &service, folder, log).await
        }
        Err(error) => {
            folder.fail(&error);
            Err(error)
        }
    }
}

async fn listen(args: &UpArgs, endpoint: &str, folder: &RunFolder) -> anyhow::Result<(Bus, RunName)> {
    let run = match &args.run {
        Some(run) => run.clone(),
        None => folder.name().parse().context("the run folder's name")?,
    };
    let bus = Bus::listen(endpoint, run.clone()).await?;
    Ok((bus, run))
}

/// Serves the run to devices in this process or in `processes` others.
async fn attend(processes: u32, service: &Service<'_>, folder: RunFolder, log: &[String]) -> anyhow::Result<ExitCode> {
    let devices = service.scenario.devices;
    if processes == 0 {
        let own = service.bus.untapped();
        let carried = tokio::spawn(async move { host::carry(&own, devices, 0, JOIN, |_, _, _| {}).await });
        let code = serve(service, folder, |_| {}, async || None).await;
        if code.as_ref().is_err_and(anyhow::Error::is::<Interrupted>) {
            // They wait to join a run that there will not be.
            carried.abort();
            return code;
        }
        return match carried.await.context("the devices' task")? {
            // What the base station has told them is in `code`.
            Ok(()) | Err(HostError::RunFailed(_)) => code,
            Err(error) => Err(error.into()),
        };
    }
    let (endpoint, run) = (service.bus.endpoint(), service.run.to_string());
    let children = match Children::start(devices, processes, endpoint, &run, log) {
        Ok(children) => children,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let pids = children.pids();
    let children = Arc::new(std::sync::Mutex::new(Some(children)));
    let guard = tokio::spawn(watch(Arc::clone(&children), Arc::clone(&service.progress)));
    let cause = async || cause(&children, &service.progress).await;
    let code = serve(service, folder, |timing| measure(&pids, timing), cause).await;
    guard.abort();
    let _watched = guard.await.is_err();
    let children = children.lock().ok().and_then(|mut slot| slot.take());
    if let (Ok(_), Some(children)) = (&code, children) {
        children.wait();
    }
    code
}

/// How a device process has ended, if one has: its connection is gone a moment before it is.
async fn cause(children: &std::sync::Mutex<Option<Children>>, progress: &Progress) -> Option<String> {
    for _ in 0..10 {
        let failed = || children.lock().ok()?.as_mut()?.failed();
        if let Some(why) = progress.cause.get().cloned().or_else(failed) {
            return Some(why);
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    None
}

/// Looks after the device processes: one that has ended can neither join nor come back, so the run is not held for it.
async fn watch(children: Arc<std::sync::Mutex<Option<Children>>>, progress: Arc<Progress>) {
    loop {
        let failed = children
            .lock()
            .ok()
            .and_then(|mut slot| slot.as_mut().and_then(Children::failed));
        if let Some(why) = failed {
            // The first cause is the one that counts.
            let _told_before = progress.cause.set(why).is_err();
            progress.stop.store(true, Ordering::Relaxed);
            return;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// The mean memory of the device processes while they live.
fn measure(pids: &[u32], timing: &mut Timing) {
    let field = |text: &str, name: &str| -> f64 {
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        line.and_then(|rest| rest.split_whitespace().next()?.parse().ok())
            .unwrap_or(0.0)
    };
    let mut seen = 0.0;
    for pid in pids {
        if let Ok(text) = std::fs::read_to_string(format!("/proc/{pid}/smaps_rollup")) {
            timing.host_rss_mb += field(&text, "Rss:") / 1024.0;
            timing.host_pss_mb += field(&text, "Pss:") / 1024.0;
            seen += 1.0;
        }
    }
    if seen > 0.0 {
        timing.host_rss_mb /= seen;
        timing.host_pss_mb /= seen;
    }
}
