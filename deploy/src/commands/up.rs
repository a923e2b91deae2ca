//! `reveille up`: a base station and its device processes on this machine. `bs` serves the run, `supervisor` keeps the
//! processes. The help of `--processes` and `docs/command-line.md` repeat [`DEFAULT_PROCESSES`]. With
//! `--processes 0` the devices run in this process, without a supervisor.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use reveille_bs::server::ServerConfig;
use reveille_common::bus::{self, Bus, draw_secret, scaled_timeout};
use reveille_common::keys::RunName;
use reveille_common::message::HostOffer;
use reveille_device::host::{self, HostConfig, HostError};

use super::bs::{RunService, serve_run, server_settings};
use super::device::CHILD_PATIENCE;
use super::resolve_scenario::{resolve_started_run, warn_about_depletion};
use super::window_length;
use crate::child_process::{self, DeviceProcesses, ZenohThreads};
use crate::cli::{OnLossArg, UpArgs};
use crate::policy_source::select_policy_source;
use crate::run_folder::RunFolder;
use crate::run_watchers::check_observers;
use crate::saved_address::SavedAddress;
use crate::signals::{SignalMode, Signals};
use crate::summary::Timing;
use crate::supervisor::{Supervisor, SupervisorConfig};

/// Default number of device processes.
const DEFAULT_PROCESSES: u32 = 4;
/// Default address, which `cli/run.rs` repeats.
const DEFAULT_LISTEN: &str = "tcp/127.0.0.1:0";
/// Time for all device processes to join; `scaled_timeout` extends it for many.
const JOIN_TIMEOUT: Duration = Duration::from_mins(1);

/// Runs the base station and the devices on this machine. The device processes get the `log_options`.
pub(crate) async fn run(args: &UpArgs, log_options: &[String]) -> anyhow::Result<ExitCode> {
    child_process::exit_with_optional_parent(args.output.parent)?;
    let started = crate::runtime::now();
    let (scenario, recorded_inputs) = resolve_started_run(&args.scenario, &args.output)?;
    let devices = scenario.run.devices;
    let processes = args.processes.unwrap_or(DEFAULT_PROCESSES.min(devices));
    anyhow::ensure!(
        processes <= devices,
        "--processes {processes}: must be from 0 to {devices}, the number of devices"
    );
    if processes == 0 && args.drive.on_loss != OnLossArg::Wait {
        tracing::warn!("--on-loss has no effect: with --processes 0 there is no device process to lose");
    }
    check_observers(&args.output, &args.drive)?;
    let policy_source = select_policy_source(&scenario, recorded_inputs.as_ref(), &args.drive)?;
    let inputs = args.actions.read(&scenario, recorded_inputs)?;
    crate::file_limits::ensure_for_station(processes)?;
    let earlier = SavedAddress::of_resumed(args.output.resume.as_deref());
    let listen = earlier.listen(args.listen.as_deref(), DEFAULT_LISTEN, true);
    // Checked before the folder is created: an endpoint in use must not cost a run that --force replaces.
    bus::resolve_listen_endpoint(listen)?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    warn_about_depletion(&scenario);
    let folder = RunFolder::create(&args.output, &scenario)?;
    match open_bus(args, (&earlier, listen), processes, &folder).await {
        Ok((bus, run, run_id)) => {
            let service = RunService {
                settings: ServerConfig {
                    run_id,
                    join_timeout: Some(scaled_timeout(JOIN_TIMEOUT, processes)),
                    run_key: Some(draw_secret()?),
                    join_needs_key: true,
                    ..server_settings(&args.drive, &args.output, window_length(&args.output, &scenario))
                },
                bus: &bus,
                command: "up",
                run: &run,
                tls: None,
                key_file: None,
                scenario: &scenario,
                output: &args.output,
                dashboard: args.drive.dashboard.as_deref(),
                holds_dashboard: args.drive.hold,
                audit: args.drive.audit,
                inputs,
                policy_source,
                progress: Arc::default(),
                signals: &signals,
                started,
            };
            serve_with_devices(processes, &service, folder, (args.untuned, log_options)).await
        }
        Err(error) => {
            folder.fail(&error);
            Err(error)
        }
    }
}

/// Opens the bus at the address `listen`, under the name `--run`, the name of the resumed run, or the name of `folder`.
async fn open_bus(
    args: &UpArgs,
    (earlier, listen): (&SavedAddress, &str),
    processes: u32,
    folder: &RunFolder,
) -> anyhow::Result<(Bus, RunName, u64)> {
    let run = earlier.run_in(args.run.as_ref(), folder.path())?;
    let bus = Bus::listen_for_hosts(processes, listen, run.clone()).await?;
    let run_id = earlier.write(folder.path(), args.run.as_ref(), (listen, bus.endpoint()))?;
    Ok((bus, run, run_id))
}

/// Serves the run to devices in this process or in `processes` others.
async fn serve_with_devices(
    processes: u32,
    service: &RunService<'_>,
    folder: RunFolder,
    (is_untuned, log_options): (bool, &[String]),
) -> anyhow::Result<ExitCode> {
    let devices = service.scenario.run.devices;
    if processes == 0 {
        // Without a tap, since the base station already copies both directions.
        let host_bus = service.bus.without_tap();
        let host_config = HostConfig {
            offer: HostOffer::AtMost(devices),
            name: "the base station's own process".to_owned(),
            key: service.settings.run_key,
            patience: CHILD_PATIENCE,
            // With a single host there are no devices to take over.
            stands_by: false,
            // A tuned host handles messages on the thread that delivers them, if its devices are few.
            forces_worker: is_untuned,
        };
        let host_task = tokio::spawn(async move { host::run_host(&host_bus, host_config, &|_| {}).await });
        let code = serve_run(service, folder, |_| {}).await;
        if code.is_err() && !host_task.is_finished() {
            // The devices would wait to join a run that never starts, or for a base station that has ended.
            host_task.abort();
            return code;
        }
        return match host_task.await.context("the devices' task")? {
            // `code` already has the error that the base station sent to the devices.
            Ok(()) | Err(HostError::RunFailed(_)) => code,
            // The devices have ended first: their error is the cause of the base station's.
            Err(error) => Err(error.into()),
        };
    }
    let device_processes = DeviceProcesses {
        devices,
        processes,
        endpoint: service.bus.endpoint(),
        run: &service.run.to_string(),
        log: log_options,
        is_untuned,
    };
    let config = SupervisorConfig {
        commands: device_processes.commands(),
        key: service.settings.run_key,
        threads: if is_untuned {
            ZenohThreads::Default
        } else {
            ZenohThreads::One
        },
        on_loss: service.settings.on_loss,
    };
    let supervisor = match Supervisor::start(config, &service.progress) {
        Ok(supervisor) => supervisor,
        Err(error) => {
            folder.fail(&error);
            return Err(error);
        }
    };
    let code = serve_run(service, folder, |timing| measure_memory(&supervisor.pids(), timing)).await;
    // After an error the drop of `supervisor` ends the processes without a wait.
    if code.is_ok() {
        supervisor.wait();
    }
    code
}

/// Sets the mean memory of the live device processes in `timing`, if it can be measured for one of them.
fn measure_memory(pids: &[u32], timing: &mut Timing) {
    let megabytes = |text: &str, name: &str| -> f64 {
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        let kilobytes: Option<f64> = line.and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        kilobytes.unwrap_or(0.0) / 1024.0
    };
    // A process can have ended since its pid was listed.
    let texts = pids
        .iter()
        .filter_map(|pid| std::fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok());
    let texts: Vec<String> = texts.collect();
    if !texts.is_empty() {
        let mean = |name| texts.iter().map(|text| megabytes(text, name)).sum::<f64>() / texts.len() as f64;
        (timing.host_rss_mb, timing.host_pss_mb) = (Some(mean("Rss:")), Some(mean("Pss:")));
    }
}
