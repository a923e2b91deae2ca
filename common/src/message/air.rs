//! The air plane: δ plans, reports and wake-ups, as a deployment would send them over the radio. Metrics count their
//! encoded bytes, and the digest hashes their contents (`score/digest.rs`). Names of fields are part of recordings
//! (`view/src/schemas.rs`), their order of `WIRE_VERSION`.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::digits::{count_noun, format_significant};
use crate::ids::{DeviceId, Tti};
use crate::plan::Plan;
use crate::radio::AirLosses;
use crate::state::{DeviceState, DeviceView};
use crate::units::Energy;

/// The largest number of devices that the text of a plan names.
const MAX_NAMED_DEVICES: usize = 8;

/// Air, BS → all devices: the δ plan from a TTI on, sent when it changes and for synchronisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanUpdate {
    /// The first TTI for which the plan holds.
    pub from: Tti,
    /// δ.
    pub plan: Plan,
}

impl Concerns for PlanUpdate {
    fn concerns(&self, _number: Option<u32>, _device: DeviceId) -> bool {
        true
    }
}

impl fmt::Display for PlanUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { from, plan } = self;
        let (entries, prefix) = match plan {
            // A plan of bits does not hold N. The spare bits of its last byte are 0 and add no device to the count.
            Plan::Bits { bits } => (bits.len() * 8, ""),
            Plan::Periodic(cycles) => (cycles.len(), "periodic, "),
        };
        let sensing = || (0..entries as u32).filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(*from));
        let count = sensing().count();
        write!(f, "δ from TTI {from}: {prefix}")?;
        match plan {
            Plan::Bits { .. } if count == 1 => f.write_str("1 device senses")?,
            Plan::Bits { .. } => write!(f, "{count} devices sense")?,
            Plan::Periodic(_) => write!(f, "{count} of {} sense first", count_noun(entries, "device"))?,
        }
        for (nth, device) in sensing().take(MAX_NAMED_DEVICES).enumerate() {
            write!(f, "{} {device}", if nth == 0 { ":" } else { "," })?;
        }
        f.write_str(if count > MAX_NAMED_DEVICES { " …" } else { "" })
    }
}

/// Air, device → BS: the report of a device in S3.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The device that reports.
    pub device: DeviceId,
    /// The TTI of the transmission.
    pub tti: Tti,
    /// I_ij = Ψ p(d_ij), 0 beyond d_max (Eq. (1)).
    pub information: f64,
    /// The device's battery after the transmission.
    pub battery: Energy,
}

/// A device that entered S2 and could not pay E_Tx.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedTransmission {
    /// The device.
    pub device: DeviceId,
    /// Energy that was left in its battery and is now lost.
    #[serde(rename = "drained")]
    pub drained_energy: Energy,
}

impl Concerns for Report {
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        number == Some(device.0)
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [information, battery] = [self.information, self.battery.units()].map(|x| format_significant(x, 4));
        write!(f, "I {information}, battery {battery} left")
    }
}

/// Air, BS → one device's wake-up radio.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WakeUp {
    /// The TTI in which it is sent: the TTI of the reports, or a later one after other wake-ups that take time.
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

/// The outcome of a wake-up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum WakeOutcome {
    /// S4 → S2 → S3: the device reported.
    Reported(Report),
    /// S4 → S2 → S4: the device woke and could not pay E_Tx.
    Failed(FailedTransmission),
    /// The device's wake-up radio had no power or missed it, or the device was not asleep.
    Missed,
    /// S4 → S2 → S3: the device reported, and the report was lost on its way to the BS.
    Lost(Report),
    /// S4 → S2 → S4: the device woke after the end of the event and detected nothing.
    Late {
        /// Energy taken from its battery: E_idle, or the rest of its charge.
        spent: Energy,
        /// Whether it paid E_idle in full, so that its wake-up radio still has power.
        powered: bool,
    },
}

impl fmt::Display for WakeOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reported(report) => write!(f, "reported: {report}"),
            Self::Failed(failure) => write!(
                f,
                "woke but could not pay for a report; {} units lost",
                format_significant(failure.drained_energy.units(), 4)
            ),
            Self::Missed => f.write_str("did not receive it"),
            Self::Lost(report) => write!(f, "reported, but the report was lost: {report}"),
            Self::Late { spent, .. } => {
                write!(
                    f,
                    "woke after the event; {} units spent",
                    format_significant(spent.units(), 4)
                )
            }
        }
    }
}

impl WakeOutcome {
    /// Returns the outcome after the air has delivered or lost the device's report, if it sent one. `air` must be of
    /// the TTI in which the event was reported, also if the wake-up was sent in a later one.
    #[must_use]
    pub fn after_uplink(self, air: &AirLosses) -> Self {
        match self {
            // The draw is keyed by device and TTI, so the BS and an observer find the same loss without a message.
            Self::Reported(report) if air.loses_report(report.device) => Self::Lost(report),
            Self::Reported(_) | Self::Failed(_) | Self::Missed | Self::Lost(_) | Self::Late { .. } => self,
        }
    }

    /// Applies the outcome to `view`, which dates from before the wake-up.
    #[must_use]
    pub const fn apply_to(&self, view: DeviceView) -> DeviceView {
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
                // View and outcome come from a host and may contradict each other, so a plain subtraction could panic.
                battery: view.battery.saturating_sub(*spent),
            },
            Self::Missed => view,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::DutyCycle;

    #[test]
    fn a_plan_update_is_shown_with_the_first_sensing_devices() {
        let show = |plan| PlanUpdate { from: Tti(5), plan }.to_string();
        let plan_of =
            |devices: &[u32]| Plan::from_devices(50, &devices.iter().copied().map(DeviceId).collect::<Vec<_>>());
        assert_eq!(show(plan_of(&[])), "δ from TTI 5: 0 devices sense");
        assert_eq!(show(plan_of(&[3, 7, 49])), "δ from TTI 5: 3 devices sense: 3, 7, 49");
        let many: Vec<u32> = (0..20).map(|j| 2 * j).collect();
        assert_eq!(
            show(plan_of(&many)),
            "δ from TTI 5: 20 devices sense: 0, 2, 4, 6, 8, 10, 12, 14 …"
        );
        let impossible = DutyCycle {
            t_on: 1,
            t_drx: 0,
            offset: 0,
        };
        let cycles = vec![DutyCycle::SENSING, DutyCycle::ASLEEP, impossible];
        assert_eq!(
            show(Plan::Periodic(cycles)),
            "δ from TTI 5: periodic, 1 of 3 devices sense first: 0"
        );
    }
}
