//! The limit of open files, sockets included: raised as far as the system allows, and checked against the run's needs.

use anyhow::bail;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Files of a base station without device processes: 34, plus some for a recording, pages, scrapers and observers.
const STATION: u64 = 48;
/// Files of a device process: 28 to 30, plus some while it connects.
const DEVICE: u64 = 32;

/// Ensures enough files for a base station with `processes` device processes, each of which needs one.
///
/// # Errors
/// If the system limit is too low.
pub(crate) fn for_station(processes: u32) -> anyhow::Result<()> {
    let (allowed, needed) = (raise(), STATION + u64::from(processes));
    if allowed >= needed {
        return Ok(());
    }
    let carried = allowed.saturating_sub(STATION);
    let fewer = if carried > 0 {
        format!(", or use at most {carried} device processes")
    } else {
        String::new()
    };
    let plural = if processes == 1 { "" } else { "es" };
    bail!(
        "this process may have {allowed} files open, and a base station with {processes} device process{plural} needs \
         {needed}; raise the limit (`ulimit -n {needed}`, LimitNOFILE= of a service){fewer}"
    )
}

/// Ensures files for a base station with an unknown number of device processes, at most `devices`.
///
/// # Errors
/// If the system limit does not even allow one device process.
pub(crate) fn for_any_station(devices: u32) -> anyhow::Result<()> {
    // Also ensures that the subtraction below does not wrap.
    for_station(1)?;
    let carried = raise() - STATION;
    if carried < u64::from(devices) {
        tracing::warn!(
            "this process may have {} files open, so at most {carried} device processes can join; raise the limit with \
             `ulimit -n`",
            raise()
        );
    }
    Ok(())
}

/// Ensures enough files for a device process.
///
/// # Errors
/// If the system limit is too low.
pub(crate) fn for_device() -> anyhow::Result<()> {
    let allowed = raise();
    if allowed < DEVICE {
        bail!(
            "this process may have {allowed} files open, and a device process needs {DEVICE}; raise the limit \
             (`ulimit -n {DEVICE}`, LimitNOFILE= of a service)"
        );
    }
    Ok(())
}

/// Raises the limit as far as the system allows, and returns it.
fn raise() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let most = Rlimit {
        current: limit.maximum,
        maximum: limit.maximum,
    };
    let now = if setrlimit(Resource::Nofile, most).is_ok() {
        limit.maximum
    } else {
        limit.current
    };
    // `None` means no limit.
    now.unwrap_or(u64::MAX)
}
