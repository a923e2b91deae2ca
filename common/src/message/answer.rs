//! Emulation: what hosts answer.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Concerns, Failure, WakeOutcome};
use crate::ids::{DeviceId, HostId, Tti};
use crate::state::DeviceView;
use crate::totals::{DeviceTotals, Ledger};

/// Emulation, host → BS: the answer to a [`Clock`](super::Clock) message or to a wake-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Answer {
    /// A host's devices have done all TTIs up to `tti`.
    Done {
        /// The host.
        host: HostId,
        /// The last TTI of the grant.
        tti: Tti,
        /// Reports that its devices have put on the air plane in this TTI.
        reports: u32,
        /// Devices that detected the event and could not transmit.
        failures: Vec<Failure>,
        /// Sums over the host's devices, where the grant asked for them.
        totals: Option<DeviceTotals>,
        /// States and batteries of its devices, in the order of ids, where the grant asked for them: what observers
        /// see, and of which the batteries are what a policy with `bs.battery_knowledge = "oracle"` is told, and no
        /// real BS is.
        views: Option<Vec<DeviceView>>,
    },
    /// A wake-up that brought no report.
    NotWoken {
        /// The device.
        device: DeviceId,
        /// The TTI.
        tti: Tti,
        /// What came of it instead.
        outcome: WakeOutcome,
    },
    /// The ledgers of a host's devices at the end of the run.
    Final {
        /// The host.
        host: HostId,
        /// The ledger of each device.
        ledgers: Vec<(DeviceId, Ledger)>,
    },
}

impl Concerns for Answer {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        match self {
            Self::NotWoken { device: who, .. } => *who == device,
            Self::Done { failures, .. } => failures.iter().any(|failure| failure.device == device),
            Self::Final { ledgers, .. } => ledgers.iter().any(|(who, _)| *who == device),
        }
    }
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Done {
                reports,
                failures,
                totals,
                ..
            } => {
                write!(f, "done, {reports} reports")?;
                for failure in failures {
                    write!(f, ", device {} could not transmit", failure.device)?;
                }
                totals
                    .as_ref()
                    .map_or(Ok(()), |sums| write!(f, ", batteries hold {}", sums.battery))
            }
            Self::NotWoken { device, outcome, .. } => write!(f, "device {device} {outcome}"),
            Self::Final { ledgers, .. } => write!(f, "the ledgers of {} devices", ledgers.len()),
        }
    }
}
