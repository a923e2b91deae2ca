//! The limit of open files, sockets included: raised as far as the system allows, and checked against the run's needs.
//! `up`, `bs` and `device` call it before they create anything. `docs/command-line.md` lists both constants;
//! `tests/program/limits.rs` and `tests/chaos/environment.py` repeat sums of them and parts of the texts.

use anyhow::bail;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Files of a base station without device processes: 34 (sessions, runtimes, the run folder), plus some for a
/// recording, dashboard pages, scrapers and observers.
const STATION_FILES: u64 = 48;
/// Files of a device process: 28 to 30 open, plus some while it connects.
const DEVICE_PROCESS_FILES: u64 = 32;

/// Ensures enough files for a base station with `processes` device processes; each takes one more. The processes have
/// their own limit ([`ensure_for_device_process`]).
///
/// # Errors
/// If the system limit is too low.
pub(crate) fn ensure_for_station(processes: u32) -> anyhow::Result<()> {
    let (allowed, needed) = (raise_limit(), STATION_FILES + u64::from(processes));
    if allowed >= needed {
        return Ok(());
    }
    let max_processes = allowed.saturating_sub(STATION_FILES);
    let advice = if max_processes > 0 {
        format!(", or use at most {max_processes} device processes")
    } else {
        String::new()
    };
    let plural = if processes == 1 { "" } else { "es" };
    bail!(
        "this process may have {allowed} files open, and a base station with {processes} device process{plural} needs \
         {needed}; raise the hard limit (as root with `ulimit -n {needed}`, LimitNOFILE= of a service){advice}"
    )
}

/// Ensures files for a base station and one device process, and warns if fewer than `devices` could join.
///
/// # Errors
/// If the system limit does not even allow one device process.
pub(crate) fn ensure_for_unknown_processes(devices: u32) -> anyhow::Result<()> {
    // Also ensures that the subtraction below does not wrap.
    ensure_for_station(1)?;
    let max_processes = raise_limit() - STATION_FILES;
    if max_processes < u64::from(devices) {
        tracing::warn!(
            "this process may have {} files open, so at most {max_processes} device processes can join; raise the \
             limit with `ulimit -n`",
            raise_limit()
        );
    }
    Ok(())
}

/// Ensures enough files for a device process.
///
/// # Errors
/// If the system limit is too low.
pub(crate) fn ensure_for_device_process() -> anyhow::Result<()> {
    let allowed = raise_limit();
    if allowed < DEVICE_PROCESS_FILES {
        bail!(
            "this process may have {allowed} files open, and a device process needs {DEVICE_PROCESS_FILES}; raise the \
             limit (`ulimit -n {DEVICE_PROCESS_FILES}`, LimitNOFILE= of a service)"
        );
    }
    Ok(())
}

/// Raises the limit as far as the system allows, and returns it.
fn raise_limit() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        maximum: limit.maximum,
    };
    let effective = if setrlimit(Resource::Nofile, raised).is_ok() {
        limit.maximum
    } else {
        limit.current
    };
    // `None` means no limit.
    effective.unwrap_or(u64::MAX)
}
