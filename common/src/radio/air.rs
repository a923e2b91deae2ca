//! Losses on the air, and false wake-ups. Each loss is drawn from seed, device and TTI, and bursts follow from the
//! seed, so the world, hosts and observers compute the same losses. Digests depend on the draws;
//! `tests/src/reference/radio.rs` repeats them.

use super::RadioSettings;
use crate::ids::{DeviceId, Tti};
use crate::phases::Phases;
use crate::plan::{DutyCycle, Plan};
use crate::rng::{Geometric, Purpose, Stream, unit_for_pair};

/// The losses on the air of a run, TTI by TTI.
#[derive(Clone, Debug)]
pub struct Air {
    seed: u64,
    radio: RadioSettings,
    burst_phases: Option<Phases>,
}

/// The losses on the air in one TTI: the probability of each kind of loss, and the draw for each device. Repeated
/// queries for a device have the same result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AirLosses {
    seed: u64,
    tti: Tti,
    wake_miss_probability: f64,
    uplink_loss_probability: f64,
    plan_loss_probability: f64,
}

impl Air {
    /// Creates the air of a run with `seed`, before TTI 0.
    pub fn new(seed: u64, radio: &RadioSettings) -> Self {
        Self {
            seed,
            radio: *radio,
            burst_phases: radio.bursts.map(|bursts| bursts.burst_phases(seed)),
        }
    }

    /// Returns the losses in TTI `k` of a run; `k` must not decrease between calls.
    pub fn losses_at(&mut self, k: Tti) -> AirLosses {
        let RadioSettings {
            wake_miss,
            uplink_loss,
            plan_loss,
            bursts,
            ..
        } = self.radio;
        let is_burst = self
            .burst_phases
            .as_mut()
            .is_some_and(|phases| phases.phase_at(k).is_busy);
        // During a burst each loss has at least the probability `loss`; a higher one in the settings is kept, also in
        // `InterferenceBursts::mean_loss`.
        let burst_loss = bursts.filter(|_| is_burst).map_or(0.0, |bursts| bursts.loss);
        AirLosses {
            seed: self.seed,
            tti: k,
            wake_miss_probability: wake_miss.max(burst_loss),
            uplink_loss_probability: uplink_loss.max(burst_loss),
            plan_loss_probability: plan_loss.max(burst_loss),
        }
    }

    /// Whether devices can miss plans.
    pub(crate) fn loses_plans(&self) -> bool {
        // A burst can make devices miss plans even if plan_loss is 0.
        self.radio.plan_loss > 0.0 || self.radio.bursts.is_some()
    }

    /// Delivers a plan that is sent in TTI `sent` to the `device_count` devices from `first` on. Calls `receive` with
    /// the position and the duty cycle of each device that receives it; the others keep their plan. Returns how many
    /// devices miss it. `sent` must not decrease between calls, nor between calls of [`Self::losses_at`].
    pub fn deliver_plan(
        &mut self,
        sent: Tti,
        plan: &Plan,
        first: DeviceId,
        device_count: usize,
        mut receive: impl FnMut(usize, DutyCycle),
    ) -> u64 {
        let losses = self.losses_at(sent);
        let mut missed = 0;
        // Each draw is keyed by device and TTI, so a host that delivers only to its own devices finds the same losses.
        for (j, device) in (first.0..).map(DeviceId).enumerate().take(device_count) {
            if losses.is_lost(Purpose::PlanLoss, device, losses.plan_loss_probability) {
                missed += 1;
            } else {
                receive(j, plan.duty_cycle(device));
            }
        }
        missed
    }
}

impl AirLosses {
    /// Whether the powered wake-up radio of `device` misses a wake-up.
    pub fn misses_wake_up(&self, device: DeviceId) -> bool {
        self.is_lost(Purpose::WakeMiss, device, self.wake_miss_probability)
    }

    /// Whether a report of `device` is lost.
    pub fn loses_report(&self, device: DeviceId) -> bool {
        self.is_lost(Purpose::UplinkLoss, device, self.uplink_loss_probability)
    }

    #[inline]
    fn is_lost(&self, purpose: Purpose, device: DeviceId, p: f64) -> bool {
        // A radio that never fails skips the hash. The draw is below 1, so p = 1 always loses.
        p > 0.0 && unit_for_pair(self.seed, purpose, u64::from(device.0), self.tti.0) < p
    }
}

/// The TTIs in which noise wakes a device, if it sleeps with power. They are drawn in advance as gaps, whatever the
/// state of the device: a TTI without a false wake-up costs nothing.
#[derive(Clone, Debug)]
pub struct FalseWakeUps {
    stream: Stream,
    gap_distribution: Geometric,
    next_tti: Tti,
}

impl FalseWakeUps {
    /// Creates the false wake-ups of `device` in a run with `seed`, with probability `p` in each TTI.
    ///
    /// # Panics
    /// If `p` is not within 0 and 1.
    pub fn new(seed: u64, p: f64, device: DeviceId) -> Self {
        let gap_distribution = Geometric::new(p);
        let mut stream = Stream::new(seed, Purpose::FalseWakeUps, u64::from(device.0));
        // A gap of 1 is TTI 0.
        let next_tti = Tti(gap_distribution.draw(&mut stream)).previous();
        Self {
            stream,
            gap_distribution,
            next_tti,
        }
    }

    /// The TTI of the next false wake-up; [`Tti::NEVER`] without one.
    pub const fn next_tti(&self) -> Tti {
        self.next_tti
    }

    /// Takes the next false wake-up and returns the TTI of the one after it.
    pub fn advance(&mut self) -> Tti {
        self.next_tti = self
            .next_tti
            .saturating_add(self.gap_distribution.draw(&mut self.stream));
        self.next_tti
    }
}
