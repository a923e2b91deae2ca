//! The radio between base station and devices, and how it fails: never, unless a scenario says so.
//!
//! ```text
//! settings ─► Radio ─► air: what is lost, by (device, TTI)     ─► world, devices
//!               │      bursts of interference
//!               ├───► false_wakes: gaps                        ─► devices
//!               └───► Link: means                              ─► what a base station knows
//! ```
//! Every draw belongs to a device and a TTI, so that nobody has to be told of it: the world, a device and an observer
//! each find out by themselves.

mod air;
mod bursts;
mod false_wakes;

pub use air::{Air, Moment};
pub use bursts::{Bursts, Interference};
pub use false_wakes::FalseWakes;

use serde::{Deserialize, Serialize};

use crate::declare::{PROBABILITY, Reader, ScenarioError, Section, Sink, choice, number, whole};
use crate::ids::Tti;

/// The longest that a device may take to wake, in TTIs.
const LONGEST_LATENCY: u64 = 1_000_000;

crate::declare! {
    /// The radio between base station and devices. By default it never fails.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Settings in "radio" {
        /// Probability that a wake-up radio with power misses a wake-up: one draw per device and TTI.
        wake_miss: f64 = number(PROBABILITY, 0.0),
        /// Probability that a device in S4 whose wake-up radio has power wakes for nothing. It is in S2 then, finds
        /// nothing to report and sleeps again within the TTI, for E_idle on top of E_WuR.
        false_wake: f64 = number(PROBABILITY, 0.0).unit("per TTI"),
        /// Probability that a report, which costs E_Tx, does not reach the base station: one draw per device and TTI.
        uplink_loss: f64 = number(PROBABILITY, 0.0),
        /// Probability that a device misses a plan δ and keeps the one that it has: one draw per device and TTI in
        /// which a plan is sent. When the plan is sent again for synchronisation that is another chance.
        plan_loss: f64 = number(PROBABILITY, 0.0),
        /// TTIs from a wake-up until the device is awake. Wake-ups for an event follow one another, each when the
        /// answer to the one before is due; who wakes when the event is over finds nothing, for E_idle. All of it is
        /// in the books of the TTI in which the event was reported.
        wake_latency: u64 = whole(0, LONGEST_LATENCY, 0).unit("TTIs"),
        /// Whether more is lost at times.
        interference: Interference = choice::<Interference>("none"),
    }
}

/// How the radio fails.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Radio {
    /// Probability that a wake-up radio with power misses a wake-up, `[0, 1]`.
    pub wake_miss: f64,
    /// Probability that a device wakes for nothing in a TTI in S4 with power, `[0, 1]`.
    pub false_wake: f64,
    /// Probability that a report does not reach the base station, `[0, 1]`.
    pub uplink_loss: f64,
    /// Probability that a device misses a plan, `[0, 1]`.
    pub plan_loss: f64,
    /// TTIs from a wake-up until the device is awake, at most a million.
    pub wake_latency: u64,
    /// Bursts in which more is lost.
    pub bursts: Option<Bursts>,
}

/// What a base station knows of its radio: how often messages are lost in the long run, not when. All `[0, 1]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Link {
    /// Mean probability that a wake-up radio with power misses a wake-up.
    pub wake_miss: f64,
    /// Mean probability that a report is lost.
    pub uplink_loss: f64,
    /// Mean probability that a device misses a plan.
    pub plan_loss: f64,
}

impl Radio {
    /// The fields of all kinds.
    pub const SECTIONS: [&'static Section; 2] = [Settings::SECTION, Bursts::SECTION];

    /// The settings that `reader` has.
    ///
    /// # Errors
    /// A value is out of its range.
    pub fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        let Settings {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
            wake_latency,
            interference,
        } = Settings::read(reader)?;
        Ok(Self {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts: match interference {
                Interference::None => None,
                Interference::Bursts => Some(Bursts::read(reader)?),
            },
        })
    }

    /// Hands every field to `sink`; none of a radio that never fails, which is then the same as no radio at all, in
    /// fingerprints too.
    pub fn visit(&self, sink: &mut dyn Sink) {
        if self.is_perfect() {
            return;
        }
        let Self {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts,
        } = *self;
        Settings {
            wake_miss,
            false_wake,
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

    /// Whether it never fails.
    pub fn is_perfect(&self) -> bool {
        *self == Self::default()
    }

    /// Whether its numbers can be those of a radio.
    pub fn is_sound(&self) -> bool {
        let Self {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
            wake_latency,
            bursts,
        } = self;
        let probabilities = [wake_miss, false_wake, uplink_loss, plan_loss];
        probabilities.into_iter().all(|&p| PROBABILITY.contains(p))
            && *wake_latency <= LONGEST_LATENCY
            && bursts.is_none_or(|bursts| bursts.is_sound())
    }

    /// When the wake-up that comes after `before` others for what was reported in TTI `tti` is sent.
    pub const fn sent(&self, tti: Tti, before: u64) -> Tti {
        tti.saturating_add(before.saturating_mul(self.wake_latency))
    }

    /// Whether a wake-up that is sent in TTI `sent` can be for what was reported in TTI `tti`.
    pub const fn may_be_sent(&self, sent: Tti, tti: Tti) -> bool {
        match sent.0.checked_sub(tti.0) {
            Some(0) => true,
            Some(later) => self.wake_latency > 0 && later.is_multiple_of(self.wake_latency),
            None => false,
        }
    }

    /// Whether who is sent a wake-up in TTI `sent` is awake too late for an event that is over after TTI `until`.
    pub const fn is_late(&self, sent: Tti, until: Tti) -> bool {
        sent.saturating_add(self.wake_latency).0 > until.0
    }

    /// What a base station knows of it.
    pub fn link(&self) -> Link {
        let mean = |p: f64| self.bursts.map_or(p, |bursts| bursts.mean(p));
        Link {
            wake_miss: mean(self.wake_miss),
            uplink_loss: mean(self.uplink_loss),
            plan_loss: mean(self.plan_loss),
        }
    }
}

impl Link {
    /// The probability that nothing is heard of a device that was to sense and has detected an event: it missed the
    /// plan, or its report was lost.
    pub fn silence(&self) -> f64 {
        1.0 - (1.0 - self.plan_loss) * (1.0 - self.uplink_loss)
    }

    /// The probability that nothing is heard of a device with power that was woken.
    pub fn no_answer(&self) -> f64 {
        1.0 - (1.0 - self.wake_miss) * (1.0 - self.uplink_loss)
    }
}

#[cfg(test)]
mod tests;
