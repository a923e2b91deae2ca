//! Air: reports.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::{DeviceId, Tti};
use crate::units::Energy;

/// Air, device → BS: what a device in S3 sends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The reporter.
    pub device: DeviceId,
    /// The TTI of the transmission.
    pub tti: Tti,
    /// I_ij = Ψ p(d_ij), 0 beyond d_max (Eq. (1)).
    pub information: f64,
    /// The reporter's battery after the transmission.
    pub battery: Energy,
}

/// A device that entered S2 and could not pay E_Tx.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// The device.
    pub device: DeviceId,
    /// What was left in its battery and is now lost.
    pub drained: Energy,
}

impl Concerns for Report {
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        number == Some(device.0)
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "I {:.4}, battery {:.2} left", self.information, self.battery.units())
    }
}
