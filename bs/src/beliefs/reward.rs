//! The rewards of Sec. V-B, which learning policies maximise and which trajectories and environments show.
//!
//! Whether an event was missed is not known in its TTI, and hangs on chance; so r(k) is taken with the expectation over
//! the place of an event that starts in TTI k: the part of the area that nobody looks at.

use super::coverage::Union;
use crate::knowledge::Knowledge;

/// The weight μ1 of misdetections, where nothing else is asked for.
pub const MU1: f64 = 14.0;
/// The weight μ2 of information, where nothing else is asked for.
pub const MU2: f64 = 1.0;

/// What a choice of devices in S1 is worth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Looked {
    /// The share of the devices that sleep, `[0, 1]`: the first term of r(k).
    pub asleep: f64,
    /// The share of the area that nobody looks at, `[0, 1]`: of events that start in this TTI, those that are missed in
    /// it.
    pub uncovered: f64,
}

impl Looked {
    /// Of devices that are in S1 where `on` says so, in the order of ids; `union` is that of all.
    pub fn of(union: &mut Union, on: &[bool]) -> Self {
        let sensing = || on.iter().enumerate().filter(|(_, on)| **on).map(|(j, _)| j);
        Self {
            asleep: 1.0 - sensing().count() as f64 / on.len() as f64,
            uncovered: union.uncovered(sensing()),
        }
    }

    /// r(k), with the probability `alpha` that an event starts and the weight `mu1`.
    pub fn reward(&self, alpha: f64, mu1: f64) -> f64 {
        self.asleep - alpha * mu1 * self.uncovered
    }
}

/// What is covered by whom, for [`Looked`].
pub fn union(known: &Knowledge) -> Union {
    Union::new(&known.positions(), known.area, &known.sensing)
}

/// The share of r*(k) of wake-ups of `woken` out of `n` devices that have brought `brought` more of Î, a share of Ψ:
/// what it is worth, and what it costs, ≤ 0. Those of a TTI add up to r*(k).
pub fn of_wake_ups(mu2: f64, brought: f64, woken: u32, n: usize) -> [f64; 2] {
    [mu2 * brought, -f64::from(woken) / n as f64]
}
