//! The rewards of Sec. V-B, reported by recorded trajectories (`policy/dt/record.rs`) and by environments
//! (`lab/src/gym/`). They decide nothing in a run; programs that train on them depend on their values.
//!
//! Whether an event is missed depends on chance and is unknown in its TTI. So r(k) uses the expectation over the
//! epicentre of an event that starts in TTI k, which is the uncovered share of the area.

use super::coverage::CoverageUnion;
use crate::knowledge::Knowledge;

/// Default weight μ1 of misdetections. The settings of `q-learning` declare their own defaults for both weights, and
/// `python/reveille/environment.py` repeats the values.
pub const DEFAULT_MU1: f64 = 14.0;
/// Default weight μ2 of information.
pub const DEFAULT_MU2: f64 = 1.0;

/// The coverage terms of the reward for a set of devices in S1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CoverageReward {
    /// Share of the devices that sleep, `[0, 1]`: the first term of r(k).
    pub asleep_share: f64,
    /// Uncovered share of the area, `[0, 1]`: the share of events starting in this TTI that are missed in it.
    pub uncovered_share: f64,
}

impl CoverageReward {
    /// Computes the terms for the devices in S1, those with a true value in `on`, by device id. `union` holds the
    /// positions of all devices, those in S4 included.
    pub fn new(union: &mut CoverageUnion, on: &[bool]) -> Self {
        let devices_on = || on.iter().enumerate().filter(|(_, is_on)| **is_on).map(|(j, _)| j);
        Self {
            asleep_share: 1.0 - devices_on().count() as f64 / on.len() as f64,
            uncovered_share: union.uncovered(devices_on()),
        }
    }

    /// Returns r(k) for the probability `alpha` that an event starts and the weight `mu1`.
    pub fn reward(&self, alpha: f64, mu1: f64) -> f64 {
        self.asleep_share - alpha * mu1 * self.uncovered_share
    }
}

/// Creates the model of the area that a set of devices covers. [`CoverageReward::new`] takes its uncovered share as a
/// term of the reward.
pub fn coverage_union(known: &Knowledge) -> CoverageUnion {
    CoverageUnion::new(&known.positions(), known.area, &known.sensing)
}

/// Returns the two terms of r*(k) for wake-ups that raise Î by `information_gain`, as a share of Ψ: their value
/// μ2 · `information_gain`, and their cost −`woken_count` / `device_count`. The terms of a TTI add up to r*(k).
pub fn wake_up_reward_terms(mu2: f64, information_gain: f64, woken_count: u32, device_count: usize) -> [f64; 2] {
    [mu2 * information_gain, -f64::from(woken_count) / device_count as f64]
}
