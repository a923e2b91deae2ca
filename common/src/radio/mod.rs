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

use crate::declare::{PROBABILITY, Reader, ScenarioError, Section, Sink, choice, number};

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
            interference,
        } = Settings::read(reader)?;
        Ok(Self {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
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
            bursts,
        } = *self;
        Settings {
            wake_miss,
            false_wake,
            uplink_loss,
            plan_loss,
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
            bursts,
        } = self;
        let probabilities = [wake_miss, false_wake, uplink_loss, plan_loss];
        probabilities.into_iter().all(|&p| PROBABILITY.contains(p)) && bursts.is_none_or(|bursts| bursts.is_sound())
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
