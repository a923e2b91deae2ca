//! `reveille device`: a process that carries devices.

use std::process::ExitCode;

use reveille_common::bus::Bus;
use reveille_device::host::{self, HostError};

use crate::cli::DeviceArgs;
use crate::display::note;
use crate::exit::Exit;
use crate::{interrupt, launch, limits};

/// Carries devices to the end of a run.
pub async fn run(args: &DeviceArgs) -> anyhow::Result<ExitCode> {
    if let Some(parent) = args.parent {
        launch::die_with(parent)?;
    }
    limits::for_device()?;
    // Children of `up` leave the talking to it.
    let is_alone = args.parent.is_none();
    let say = |host, first, last| {
        if is_alone {
            note!("joined run {} as host {host} with devices {first} to {last}", args.run);
        }
    };
    let work = async {
        let bus = Bus::connect(&args.connect, args.run.clone(), args.patience).await?;
        let carried = host::carry(&bus, args.count, nonce(), args.patience, say).await;
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

/// A number that tells this process from others that join; nothing of the model depends on it.
fn nonce() -> u64 {
    use std::hash::{BuildHasher, Hasher};
    std::collections::hash_map::RandomState::new().build_hasher().finish()
}
