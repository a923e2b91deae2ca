//! The emulation plane between operators and the BS: commands to the virtual clock, and its status. Fields and variants
//! are encoded by position: a change raises `WIRE_VERSION`. `tests/untrusted_clients/bus.py` repeats some bytes. Names
//! of commands are part of recordings (`view/src/schemas.rs`), names of [`ClockStatus`] of the dashboard's page
//! (`deploy/src/dashboard/page/`).

use core::time::Duration;
use std::fmt;

use humantime::format_duration;
use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::{DeviceId, HostId, Tti};

/// The speed at which TTIs follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Pace {
    /// As fast as the hosts answer.
    Max,
    /// One TTI per given number of microseconds. Late TTIs are counted; the clock never makes up for them.
    RealTime(u64),
}

impl fmt::Display for Pace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Max => f.write_str("max"),
            Self::RealTime(micros) => write!(f, "{}", format_duration(Duration::from_micros(*micros))),
        }
    }
}

/// Emulation, any client → BS, a query: commands to the virtual clock. All except [`Self::Status`] need the run's key,
/// if the run has one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ClockCommand {
    /// Grant nothing until a command lets the clock run.
    Pause,
    /// Grant `n` TTIs, then pause. A limit that the clock has not reached yet moves by `n` TTIs instead.
    Step(u64),
    /// Grant TTIs up to but not including this one, then pause.
    RunTo(Tti),
    /// Grant TTIs to the end of the run.
    Resume,
    /// Use this pace from now on; a paused clock stays paused.
    Pace(Pace),
    /// Change nothing.
    Status,
}

impl Concerns for ClockCommand {}

impl fmt::Display for ClockCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pause => f.write_str("pause"),
            Self::Step(n) => write!(f, "step {n}"),
            Self::RunTo(k) => write!(f, "run to TTI {k}"),
            Self::Resume => f.write_str("resume"),
            Self::Pace(pace) => write!(f, "pace {pace}"),
            Self::Status => f.write_str("status"),
        }
    }
}

/// Emulation, BS → operator: the reply to a [`ClockCommand`]. `reveille clock` prints its text, which tests and
/// `docs/running.md` quote.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockStatus {
    /// The identity of the run: a random number, which a resumed run keeps. Another run with the same name has another
    /// one.
    pub run_id: u64,
    /// The next TTI to be granted.
    pub tti: Tti,
    /// Length K of the run.
    pub ttis: u64,
    /// Whether the clock is paused: no TTI is open, and none starts before a command.
    pub paused: bool,
    /// The TTI before which the clock will stop, at most K.
    #[serde(rename = "until")]
    pub stop_before: Tti,
    /// The speed at which TTIs follow each other.
    pub pace: Pace,
    /// Whether all devices have joined.
    pub begun: bool,
    /// Number of devices N of the run.
    pub devices: u32,
    /// The hosts with devices, in the order of their devices.
    pub hosts: Vec<HostSummary>,
}

/// A host with devices.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostSummary {
    /// The host.
    pub host: HostId,
    /// Its name: pid, machine and address, as the host states them.
    pub name: String,
    /// Its first device.
    pub first: DeviceId,
    /// Its last device.
    pub last: DeviceId,
    /// Whether it is lost, and the BS waits for it or for a takeover.
    #[serde(rename = "lost")]
    pub is_lost: bool,
}

impl HostSummary {
    /// Number of its devices.
    fn device_count(&self) -> u32 {
        // Saturating, since the message can come from a foreign program.
        self.last.0.saturating_sub(self.first.0).saturating_add(1)
    }
}

impl fmt::Display for HostSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            host,
            name,
            first,
            last,
            ..
        } = self;
        write!(f, "host {host} (devices {first} to {last}, {name})")
    }
}

impl ClockStatus {
    /// The lost hosts whose return the BS awaits.
    pub fn lost_hosts(&self) -> impl Iterator<Item = &HostSummary> {
        self.hosts.iter().filter(|host| host.is_lost)
    }
}

impl fmt::Display for ClockStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            tti,
            ttis,
            paused,
            stop_before,
            pace,
            begun,
            devices,
            hosts,
            ..
        } = self;
        let mut lost_hosts = self.lost_hosts().peekable();
        if !begun {
            let joined: u32 = hosts.iter().map(HostSummary::device_count).fold(0, u32::saturating_add);
            write!(
                f,
                "joining before TTI {tti} of {ttis}, {joined} of {devices} devices so far"
            )?;
            return f.write_str(if *paused { "; then paused" } else { "" });
        }
        match (paused, lost_hosts.peek().is_none()) {
            (true, _) => write!(f, "paused before TTI {tti} of {ttis}")?,
            (false, true) => write!(f, "running at TTI {tti} of {ttis}")?,
            (false, false) => write!(f, "waiting at TTI {tti} of {ttis}")?,
        }
        if !paused && stop_before.0 < *ttis {
            write!(f, ", to stop before TTI {stop_before}")?;
        }
        if *pace != Pace::Max {
            write!(f, ", a TTI every {pace}")?;
        }
        for (nth, host) in lost_hosts.enumerate() {
            write!(f, "{} {host}", if nth == 0 { ": lost" } else { ";" })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_shown_with_the_state_of_the_clock() {
        let running = ClockStatus {
            run_id: 7,
            tti: Tti(12),
            ttis: 400,
            paused: false,
            stop_before: Tti(400),
            pace: Pace::Max,
            begun: true,
            devices: 50,
            hosts: Vec::new(),
        };
        let hosts = [(0, 0, 24, false), (1, 25, 49, true)].map(|(host, first, last, is_lost)| HostSummary {
            host: HostId(host),
            name: format!("the process with pid {}", 70 + host),
            first: DeviceId(first),
            last: DeviceId(last),
            is_lost,
        });
        let cases = [
            (running.clone(), "running at TTI 12 of 400"),
            (
                ClockStatus {
                    stop_before: Tti(15),
                    ..running.clone()
                },
                "running at TTI 12 of 400, to stop before TTI 15",
            ),
            (
                ClockStatus {
                    paused: true,
                    ..running.clone()
                },
                "paused before TTI 12 of 400",
            ),
            (
                ClockStatus {
                    pace: Pace::RealTime(4_000),
                    ..running.clone()
                },
                "running at TTI 12 of 400, a TTI every 4ms",
            ),
            (
                ClockStatus {
                    hosts: hosts.to_vec(),
                    ..running.clone()
                },
                "waiting at TTI 12 of 400: lost host 1 (devices 25 to 49, the process with pid 71)",
            ),
            (
                ClockStatus {
                    tti: Tti(0),
                    begun: false,
                    paused: true,
                    hosts: hosts[..1].to_vec(),
                    ..running
                },
                "joining before TTI 0 of 400, 25 of 50 devices so far; then paused",
            ),
        ];
        for (status, expected) in cases {
            assert_eq!(status.to_string(), expected);
        }
    }
}
