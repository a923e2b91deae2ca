//! `reveille device`: a process that carries devices.

use std::process::ExitCode;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_device::host::{self, HostError, News, Offer};
use rustix::process::Signal;

use crate::cli::DeviceArgs;
use crate::display::note;
use crate::exit::Exit;
use crate::{interrupt, key, launch, limits};

/// A child of `up` ends with it; until then it waits.
const FOREVER: Duration = Duration::from_hours(24 * 365);

/// Carries devices to the end of a run.
pub async fn run(args: &DeviceArgs) -> anyhow::Result<ExitCode> {
    if let Some(parent) = args.parent {
        launch::die_with(parent, Signal::KILL)?;
    }
    limits::for_device()?;
    // Children of `up` leave the talking to it.
    let is_alone = args.parent.is_none();
    let say = |news: News| match news {
        News::Joined(host, first, last) if is_alone => {
            note!("joined run {} as host {host} with devices {first} to {last}", args.run);
        }
        News::StandsBy if is_alone => note!("all devices of run {} are carried; standing by for lost ones", args.run),
        News::Joined(..) | News::StandsBy => {}
    };
    let key = match &args.key_file {
        Some(path) => Some(key::read(path)?),
        None => key::inherited(),
    };
    let offer = Offer {
        count: args.count,
        name: format!("the process with pid {}", std::process::id()),
        key,
        patience: if is_alone { args.patience } else { FOREVER },
        stands_by: true,
        hands_over: args.untuned,
    };
    let work = async {
        let bus = Bus::connect_among(args.among, &args.connect, args.run.clone(), args.patience).await?;
        let carried = host::carry(&bus, offer, &say).await;
        bus.close().await;
        carried
    };
    tokio::select! {
        carried = work => match carried {
            Ok(()) => Ok(Exit::Done.into()),
            // `up` has ended the run and says why; to it this process did not fail.
            Err(HostError::RunFailed(_)) if !is_alone => Ok(Exit::Done.into()),
            Err(error) => Err(error.into()),
        },
        told = interrupt::told() => {
            told?;
            Ok(Exit::Interrupted.into())
        }
    }
}
