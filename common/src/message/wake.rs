//! Air: wake-ups, and what comes of them.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Concerns, Failure, Report};
use crate::ids::{DeviceId, Tti};
use crate::state::{DeviceState, DeviceView};
use crate::units::Energy;

/// Air, BS → one device's wake-up radio.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WakeUp {
    /// The TTI in which it is sent: that of the reports, or later where devices take time to wake and others were woken
    /// before.
    pub tti: Tti,
}

impl Concerns for WakeUp {
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        number == Some(device.0)
    }
}

impl fmt::Display for WakeUp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("wake-up")
    }
}

/// What came of a wake-up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum WakeOutcome {
    /// S4 → S2 → S3: the device reported.
    Reported(Report),
    /// S4 → S2 → S4: the device woke and could not pay E_Tx.
    Failed(Failure),
    /// The device's wake-up radio had no power or missed it, or the device was not asleep.
    Unheard,
    /// S4 → S2 → S3: the device reported, and the report was lost on its way to the BS.
    Lost(Report),
    /// S4 → S2 → S4: the device woke when the event was over, and found nothing.
    Late {
        /// What that took from its battery: E_idle, or what was left of it.
        spent: Energy,
        /// Whether it was E_idle, so that its wake-up radio still has power.
        powered: bool,
    },
}

impl fmt::Display for WakeOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reported(report) => write!(f, "reported: {report}"),
            Self::Failed(failure) => write!(
                f,
                "woke and cannot pay for a report; {:.2} are lost",
                failure.drained.units()
            ),
            Self::Unheard => f.write_str("did not hear it"),
            Self::Lost(report) => write!(f, "reported, and that was lost: {report}"),
            Self::Late { spent, .. } => write!(f, "woke when the event was over, for {:.2}", spent.units()),
        }
    }
}

impl WakeOutcome {
    /// What the BS is left with of it where `is_lost` tells whether a device's report is lost.
    #[must_use]
    pub fn over(self, is_lost: impl FnOnce(DeviceId) -> bool) -> Self {
        match self {
            Self::Reported(report) if is_lost(report.device) => Self::Lost(report),
            Self::Reported(_) | Self::Failed(_) | Self::Unheard | Self::Lost(_) | Self::Late { .. } => self,
        }
    }

    /// What `view`, taken before the wake-up, has become by it.
    #[must_use]
    pub const fn on(&self, view: DeviceView) -> DeviceView {
        match self {
            Self::Reported(report) | Self::Lost(report) => DeviceView {
                state: DeviceState::Transmission,
                battery: report.battery,
            },
            Self::Failed(_) => DeviceView {
                state: DeviceState::Sleep { powered: false },
                battery: Energy::ZERO,
            },
            Self::Late { spent, powered } => DeviceView {
                state: DeviceState::Sleep { powered: *powered },
                battery: view.battery.saturating_sub(*spent),
            },
            Self::Unheard => view,
        }
    }
}
