//! `reveille device`: a process that runs devices. Tests wait for the note `joined`. With `--parent`, it is a child of
//! `up`, prints no notes about its join and ends with its parent; `child_process` writes the options and the key of a
//! child.

use std::process::ExitCode;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_device::host::{self, HostConfig, HostError, HostEvent};
use rustix::process::Signal;

use crate::cli::DeviceArgs;
use crate::display::note;
use crate::exit::ExitReason;
use crate::signals::{SignalMode, Signals};
use crate::{child_process, file_limits, key};

/// Time for which the devices of `up` wait to join and for a lost base station: in effect unlimited, since it ends with
/// the base station's process.
pub(super) const CHILD_PATIENCE: Duration = Duration::from_hours(24 * 365);

/// Runs devices to the end of a run.
pub(crate) async fn run(args: &DeviceArgs) -> anyhow::Result<ExitCode> {
    // Before anything else: the parent may end at any moment, and a child must not outlive it.
    if let Some(parent) = args.parent {
        child_process::exit_with_parent(parent, Signal::KILL)?;
    }
    let signals = Signals::install(SignalMode::HasNoResults)?;
    file_limits::ensure_for_device_process()?;
    // `up` reports on behalf of its children.
    let is_standalone = args.parent.is_none();
    let report_event = |event: HostEvent| match event {
        HostEvent::Joined { host, first, last } if is_standalone => {
            note!("joined run {} as host {host} with devices {first} to {last}", args.run);
        }
        HostEvent::StandsBy if is_standalone => {
            note!(
                "all devices of run {} have a host; standing by to take over lost devices",
                args.run
            );
        }
        HostEvent::Joined { .. } | HostEvent::StandsBy => {}
    };
    let key = match &args.key_file {
        Some(path) => Some(key::read(path)?),
        // The key that a parent passes to its child.
        None => key::inherited(),
    };
    let config = HostConfig {
        max_devices: args.count,
        name: format!("the process with pid {}", std::process::id()),
        key,
        patience: if is_standalone {
            args.connect_timeout
        } else {
            CHILD_PATIENCE
        },
        stands_by: true,
        // Tuned processes handle messages on the thread that delivers them, if their devices are few.
        forces_worker: args.untuned,
    };
    let work = async {
        let bus =
            Bus::connect_with_hosts(args.host_count, &args.connect, args.run.clone(), args.connect_timeout).await?;
        let result = host::run_host(&bus, config, &report_event).await;
        bus.close().await;
        result
    };
    match signals.unless_interrupted(work).await {
        Some(Ok(())) => Ok(ExitReason::Done.into()),
        // `up` ended the run and reports the cause; its child has not failed, and `supervisor` must not report it.
        Some(Err(HostError::RunFailed(_))) if !is_standalone => Ok(ExitReason::Done.into()),
        Some(Err(error)) => Err(error.into()),
        None => Ok(ExitReason::Interrupted.into()),
    }
}
