//! `reveille up`: a base station and its device processes on this machine.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use reveille_bs::host::Settings;
use reveille_common::bus::{self, Bus, allowed, draw_secret};
use reveille_common::keys::RunName;
use reveille_device::host::{self, HostError, Offer};

use super::bs::{Service, check, serve, settings};
use super::conclusion::window;
use super::resolution::resolve_run;
use super::run::Interrupted;
use crate::cli::{OnLossArg, UpArgs};
use crate::decider::deciding;
use crate::launch::{Fleet, Threads};
use crate::launcher::{Launcher, Orders};
use crate::results::RunFolder;
use crate::summary::Timing;

/// Device processes, where the command line says nothing.
const PROCESSES: u32 = 4;
/// How long all device processes may take to join, where they are few.
const JOIN: Duration = Duration::from_mins(1);

/// Runs everything on this machine.
pub async fn run(args: &UpArgs, log: &[String]) -> anyhow::Result<ExitCode> {
    let started = crate::wall::now();
    let (scenario, given) = resolve_run(&args.scenario, &args.output)?;
    let devices = scenario.devices;
    let processes = args.processes.unwrap_or(PROCESSES.min(devices));
    anyhow::ensure!(
        processes <= devices,
        "--processes {processes}: there are only {devices} devices; 0 to {devices} is allowed"
    );
    if processes == 0 && args.drive.on_loss != OnLossArg::Wait {
        tracing::warn!("--on-loss has no effect: with --processes 0 there is no device process to lose");
    }
    check(&args.output, &args.drive)?;
    let deciding = deciding(&scenario, given, &args.drive)?;
    crate::limits::for_station(processes)?;
    // Before there is a folder: one that is to be replaced stays as it is, if this is where it ends.
    let endpoint = bus::free_to_listen(&args.listen)?;
    let folder = RunFolder::create(&args.output, &scenario)?;
    match listen(args, &endpoint, &folder).await {
        Ok((bus, run)) => {
            let service = Service {
                settings: Settings {
                    join_patience: Some(allowed(JOIN, processes)),
                    key: Some(draw_secret()?),
                    members_only: true,
                    ..settings(&args.drive, &args.output, window(&args.output, &scenario))
                },
                bus: &bus,
                run: &run,
                scenario: &scenario,
                output: &args.output,
                dashboard: args.drive.dashboard.as_deref(),
                audit: args.drive.audit,
                deciding,
                progress: Arc::default(),
                started,
            };
            attend(processes, &service, folder, (args.untuned, log)).await
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
    let processes = args.processes.unwrap_or(PROCESSES);
    let bus = Bus::listen_to(processes, endpoint, run.clone()).await?;
    Ok((bus, run))
}

/// Serves the run to devices in this process or in `processes` others.
async fn attend(
    processes: u32,
    service: &Service<'_>,
    folder: RunFolder,
    (is_untuned, log): (bool, &[String]),
) -> anyhow::Result<ExitCode> {
    let devices = service.scenario.devices;
    if processes == 0 {
        let own = service.bus.untapped();
        let offer = Offer {
            count: devices,
            name: "the base station's own process".to_owned(),
            key: service.settings.key,
            patience: JOIN,
            stands_by: false,
            hands_over: is_untuned,
        };
        let carried = tokio::spawn(async move { host::carry(&own, offer, &|_| {}).await });
        let code = serve(service, folder, |_| {}).await;
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
    let fleet = Fleet {
        devices,
        processes,
        endpoint: service.bus.endpoint(),
        run: &service.run.to_string(),
        log,
        is_untuned,
    };
    let orders = Orders {
        commands: fleet.commands(),
        key: service.settings.key,
        threads: if is_untuned { Threads::Default } else { Threads::One },
        on_loss: service.settings.on_loss,
    };
    let launcher = match Launcher::start(orders, &service.progress) {
        Ok(launcher) => launcher,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let code = serve(service, folder, |timing| measure(&launcher.pids(), timing)).await;
    if code.is_ok() {
        launcher.wait();
    }
    code
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
