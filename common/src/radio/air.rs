//! What gets lost on the air.

use super::Radio;
use crate::ids::{DeviceId, Tti};
use crate::phases::Phases;
use crate::rng::{Purpose, unit_for_pair};

/// The air of a run, TTI by TTI.
#[derive(Clone, Debug)]
pub struct Air {
    seed: u64,
    radio: Radio,
    bursts: Option<Phases>,
}

/// The air in one TTI. What it does to a device's message is the same however often it is asked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moment {
    seed: u64,
    tti: Tti,
    wake_miss: f64,
    uplink_loss: f64,
    plan_loss: f64,
}

impl Air {
    /// The air of a run with `seed`, before TTI 0.
    pub fn new(seed: u64, radio: &Radio) -> Self {
        Self {
            seed,
            radio: *radio,
            bursts: radio.bursts.map(|bursts| bursts.phases(seed)),
        }
    }

    /// The air in TTI `k`, a TTI of a run and none before that of the last call.
    pub fn at(&mut self, k: Tti) -> Moment {
        let Radio {
            wake_miss,
            uplink_loss,
            plan_loss,
            bursts,
            ..
        } = self.radio;
        let is_burst = self.bursts.as_mut().is_some_and(|phases| phases.at(k).is_busy);
        let least = bursts.filter(|_| is_burst).map_or(0.0, |bursts| bursts.loss);
        Moment {
            seed: self.seed,
            tti: k,
            wake_miss: wake_miss.max(least),
            uplink_loss: uplink_loss.max(least),
            plan_loss: plan_loss.max(least),
        }
    }

    /// Whether plans are ever missed.
    pub fn loses_plans(&self) -> bool {
        self.radio.plan_loss > 0.0 || self.radio.bursts.is_some()
    }
}

impl Moment {
    /// Whether the wake-up radio of `device`, which has power, misses a wake-up.
    pub fn misses_wake_up(&self, device: DeviceId) -> bool {
        self.draws(Purpose::WakeMiss, device, self.wake_miss)
    }

    /// Whether a report of `device` is lost.
    pub fn loses_report(&self, device: DeviceId) -> bool {
        self.draws(Purpose::UplinkLoss, device, self.uplink_loss)
    }

    /// Whether `device` misses a plan.
    pub fn misses_plan(&self, device: DeviceId) -> bool {
        self.draws(Purpose::PlanLoss, device, self.plan_loss)
    }

    #[inline]
    fn draws(&self, purpose: Purpose, device: DeviceId, p: f64) -> bool {
        p > 0.0 && unit_for_pair(self.seed, purpose, u64::from(device.0), self.tti.0) < p
    }
}
