//! The TTIs at which the energy of all devices is summed: the end of the warm-up, of each window and of the run. The
//! session ends every grant at the next boundary, so that devices can return their sums before it.
//! Windows change the recorded series, not the digest of a complete run.

use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;

/// The boundaries of one run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Boundaries {
    warm_up_end: Tti,
    end: Tti,
    /// Length of a window, TTIs.
    window: u64,
}

impl Boundaries {
    /// The boundaries of `scenario` with windows of `window` TTIs; [`u64::MAX`] for none.
    pub(crate) fn new<P>(scenario: &Scenario<P>, window: u64) -> Self {
        assert!(window > 0, "a window holds at least one TTI");
        Self {
            warm_up_end: scenario.warm_up_end(),
            end: Tti(scenario.run.ttis),
            window,
        }
    }

    /// The TTI before which the run ends.
    pub(crate) const fn end(&self) -> Tti {
        self.end
    }

    /// The first boundary after `k`, or the end.
    pub(crate) fn next_boundary(&self, k: Tti) -> Tti {
        // `window` is `u64::MAX` for a run without windows.
        let window_end = (k.0 / self.window).saturating_add(1).saturating_mul(self.window);
        let warm_up_end = if self.warm_up_end > k {
            self.warm_up_end.0
        } else {
            u64::MAX
        };
        Tti(window_end.min(warm_up_end).min(self.end.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boundaries_come_in_order() {
        let boundaries = Boundaries {
            warm_up_end: Tti(25),
            end: Tti(95),
            window: 20,
        };
        let mut found = vec![];
        let mut k = Tti::ZERO;
        while k < Tti(95) {
            k = boundaries.next_boundary(k);
            found.push(k.0);
        }
        assert_eq!(found, [20, 25, 40, 60, 80, 95]);
        let without_windows = Boundaries {
            window: u64::MAX,
            warm_up_end: Tti::ZERO,
            end: Tti(7),
        };
        assert_eq!(without_windows.next_boundary(Tti::ZERO), Tti(7));
    }
}
