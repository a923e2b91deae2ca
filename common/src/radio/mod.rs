//! The radio between base station and devices, and its failures; by default it never fails.
//!
//! ```text
//! settings ─► RadioSettings ─► Air: losses by (device, TTI) ─► world, devices
//!                   │          bursts of interference
//!                   ├────────► FalseWakeUps: gaps           ─► devices
//!                   └────────► RadioLossRates: means        ─► the base station's knowledge
//! ```
//! A loss is drawn by device and TTI, false wake-ups from a stream for each device, bursts from a stream of the run. So
//! the world, a device and an observer compute the same losses without a message. Digests depend on the draws, which
//! `tests/src/reference/radio.rs` repeats. Names and order of the fields are part of the scenario hash. A test compares
//! the help texts with `docs/scenario.md`; `docs/radio.md` explains the model.

mod air;
mod bursts;

pub use air::{Air, AirLosses, FalseWakeUps};
pub use bursts::{Interference, InterferenceBursts};

use serde::{Deserialize, Serialize};

use crate::declare::{FieldReader, FieldSink, PROBABILITY, ScenarioError, Section, Visit, choice, number, whole};
use crate::ids::Tti;

/// Maximum time from a wake-up until the device is awake.
const MAX_WAKE_LATENCY_TTIS: u64 = 1_000_000;

crate::declare! {
    /// Radio between base station and devices. By default it never fails.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Settings in "radio" {
        /// Probability that a powered wake-up radio misses a wake-up: one draw per device and TTI.
        wake_miss: f64 = number(PROBABILITY, 0.0),
        /// Probability that a device in S4 with a powered wake-up radio has a false wake-up. It enters S2, finds
        /// nothing to report and sleeps again within the TTI. This costs E_idle in addition to E_WuR.
        false_wake_up: f64 = number(PROBABILITY, 0.0).unit("per TTI").formerly("false_wake"),
        /// Probability that a report, which costs E_Tx, does not reach the base station: one draw per device and TTI.
        uplink_loss: f64 = number(PROBABILITY, 0.0),
        /// Probability that a device misses a δ plan and keeps its current plan: one draw per device and TTI in which a
        /// plan is sent. Each synchronisation broadcast is another chance to receive it.
        plan_loss: f64 = number(PROBABILITY, 0.0),
        /// Time from a wake-up until the device is awake. Wake-ups for an event are sent in order, each when the
        /// previous answer is due. A device that wakes after the event finds nothing and pays E_idle. The ledger books
        /// all of this in the TTI in which the event was reported.
        wake_latency: u64 = whole(0, MAX_WAKE_LATENCY_TTIS, 0).unit("TTIs"),
        /// Type of additional interference.
        interference: Interference = choice::<Interference>("none"),
    }
}

/// The failure settings of the radio. They are part of the wire format (`WIRE_VERSION`), in
/// [`HostSetup`](crate::message::HostSetup).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RadioSettings {
    /// Probability that a wake-up radio with power misses a wake-up, `[0, 1]`.
    pub wake_miss: f64,
    /// Probability of a false wake-up in a TTI in S4 with power, `[0, 1]`.
    pub false_wake_up: f64,
    /// Probability that a report does not reach the base station, `[0, 1]`.
    pub uplink_loss: f64,
    /// Probability that a device misses a plan, `[0, 1]`.
    pub plan_loss: f64,
    /// TTIs from a wake-up until the device is awake, at most `MAX_WAKE_LATENCY_TTIS`.
    pub wake_latency: u64,
    /// Bursts with higher loss.
    pub bursts: Option<InterferenceBursts>,
}

/// The base station's knowledge of its radio: long-run loss probabilities, not times. All `[0, 1]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RadioLossRates {
    /// Mean probability that a wake-up radio with power misses a wake-up.
    pub wake_miss: f64,
    /// Mean probability that a report is lost.
    pub uplink_loss: f64,
    /// Mean probability that a device misses a plan.
    pub plan_loss: f64,
}

impl RadioSettings {
    /// The fields of the radio, and of its bursts.
    pub(crate) const SECTIONS: [&'static Section; 2] = [Settings::SECTION, InterferenceBursts::SECTION];

    /// Builds the settings in `reader`.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        let Settings {
            wake_miss,
            false_wake_up,
            uplink_loss,
            plan_loss,
            wake_latency,
            interference,
        } = Settings::read(reader)?;
        Ok(Self {
            wake_miss,
            false_wake_up,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts: match interference {
                Interference::None => None,
                Interference::Bursts => Some(InterferenceBursts::read(reader)?),
            },
        })
    }

    /// Passes every field to `sink`. A perfect radio passes none: the scenario hash is then the one of a scenario
    /// without these fields.
    pub fn visit(&self, sink: &mut dyn FieldSink) {
        if self.is_perfect() {
            return;
        }
        let Self {
            wake_miss,
            false_wake_up,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts,
        } = *self;
        Settings {
            wake_miss,
            false_wake_up,
            uplink_loss,
            plan_loss,
            wake_latency,
            interference: bursts.map_or(Interference::None, |_| Interference::Bursts),
        }
        .visit(sink);
        if let Some(bursts) = bursts {
            bursts.visit(sink);
        }
    }

    /// Whether the radio never fails and wakes devices without latency.
    pub fn is_perfect(&self) -> bool {
        *self == Self::default()
    }

    /// Whether all values are in range. A host checks it, since other values would panic in a device.
    pub fn is_valid(&self) -> bool {
        let Self {
            wake_miss,
            false_wake_up,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts,
        } = self;
        let probabilities = [wake_miss, false_wake_up, uplink_loss, plan_loss];
        probabilities.into_iter().all(|&p| PROBABILITY.contains(p))
            && *wake_latency <= MAX_WAKE_LATENCY_TTIS
            && bursts.is_none_or(|bursts| bursts.is_valid())
    }

    /// The TTI in which a wake-up for a report in TTI `report_tti` is sent, after `earlier_wake_ups` other wake-ups.
    pub const fn send_tti(&self, report_tti: Tti, earlier_wake_ups: u64) -> Tti {
        report_tti.saturating_add(earlier_wake_ups.saturating_mul(self.wake_latency))
    }

    /// Whether a wake-up sent in TTI `sent` can belong to a report in TTI `report_tti`, see [`Self::send_tti`].
    pub const fn is_valid_send_tti(&self, sent: Tti, report_tti: Tti) -> bool {
        match sent.0.checked_sub(report_tti.0) {
            Some(0) => true,
            Some(delay) => self.wake_latency > 0 && delay.is_multiple_of(self.wake_latency),
            None => false,
        }
    }

    /// Whether a wake-up sent in TTI `sent` wakes a device too late for an event whose last TTI is `event_last`.
    pub const fn is_late(&self, sent: Tti, event_last: Tti) -> bool {
        sent.saturating_add(self.wake_latency).0 > event_last.0
    }

    /// The base station's knowledge of this radio.
    pub fn loss_rates(&self) -> RadioLossRates {
        let mean = |p: f64| self.bursts.map_or(p, |bursts| bursts.mean_loss(p));
        RadioLossRates {
            wake_miss: mean(self.wake_miss),
            uplink_loss: mean(self.uplink_loss),
            plan_loss: mean(self.plan_loss),
        }
    }
}

impl RadioLossRates {
    /// The probability that no report arrives from a device that was to sense and has detected an event: it missed the
    /// plan, or its report was lost.
    pub fn no_report_probability(&self) -> f64 {
        1.0 - (1.0 - self.plan_loss) * (1.0 - self.uplink_loss)
    }

    /// The probability that no report arrives from a device with power that was woken.
    pub fn no_answer_probability(&self) -> f64 {
        1.0 - (1.0 - self.wake_miss) * (1.0 - self.uplink_loss)
    }
}

#[cfg(test)]
mod tests;
