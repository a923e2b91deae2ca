//! The TTIs at which the energy of all devices is summed: the end of the warm-up, of each window and of the run. The
//! session ends every grant at the next boundary, so that devices can return their sums before it.
//! Windows change the recorded series, not the digest of a complete run.

use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;

/// The boundaries of one run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Boundaries {
    /// First TTI after the warm-up.
    warm_up_end: Tti,
    /// The TTI before which the run ends.
    end: Tti,
    /// Length of a window, TTIs; [`u64::MAX`] without windows.
    window_ttis: u64,
}

impl Boundaries {
    /// The boundaries of `scenario` with windows of `window_ttis` TTIs; [`u64::MAX`] for none.
    ///
    /// # Panics
    /// If `window_ttis` is 0.
    pub(crate) fn new<P>(scenario: &Scenario<P>, window_ttis: u64) -> Self {
        assert!(window_ttis > 0, "a window holds at least one TTI");
        Self {
            warm_up_end: scenario.warm_up_end(),
            end: Tti(scenario.run.ttis),
            window_ttis,
        }
    }

    /// The TTI before which the run ends.
    pub(crate) const fn end(&self) -> Tti {
        self.end
    }

    /// The first boundary after `k`; the end of the run if none follows.
    pub(crate) fn next_boundary(&self, k: Tti) -> Tti {
        let window_end = (k.0 / self.window_ttis)
            .saturating_add(1)
            .saturating_mul(self.window_ttis);
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
            window_ttis: 20,
        };
        let mut found = vec![];
        let mut k = Tti::ZERO;
        while k < Tti(95) {
            k = boundaries.next_boundary(k);
            found.push(k.0);
        }
        assert_eq!(found, [20, 25, 40, 60, 80, 95]);
        let without_windows = Boundaries {
            window_ttis: u64::MAX,
            warm_up_end: Tti::ZERO,
            end: Tti(7),
        };
        assert_eq!(without_windows.next_boundary(Tti::ZERO), Tti(7));
    }
}
