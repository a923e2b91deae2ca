//! The TTIs at which all devices are brought up to date and summed: the end of the warm-up, the ends of the windows of
//! the per-window series, and the end of the run.

use reveille_common::ids::Tti;
use reveille_common::scenario::Scenario;

/// The account boundaries of a run.
#[derive(Clone, Copy, Debug)]
pub struct Boundaries {
    warm_up_end: Tti,
    end: Tti,
    window: u64,
}

impl Boundaries {
    /// The boundaries of `scenario` with windows of `window` TTIs; [`u64::MAX`] for none.
    pub fn new(scenario: &Scenario, window: u64) -> Self {
        assert!(window > 0, "a window holds at least one TTI");
        Self {
            warm_up_end: scenario.warm_up_end(),
            end: Tti(scenario.ttis),
            window,
        }
    }

    /// The boundaries of the same run, if it ends before TTI `end`.
    #[must_use]
    pub const fn until(self, end: Tti) -> Self {
        Self { end, ..self }
    }

    /// The end of the warm-up: the first measured TTI.
    pub const fn warm_up_end(&self) -> Tti {
        self.warm_up_end
    }

    /// The TTI before which the run ends.
    pub const fn end(&self) -> Tti {
        self.end
    }

    /// Whether the TTIs before `k` are summed before `k` is granted.
    pub const fn is_boundary(&self, k: Tti) -> bool {
        k.0 > 0 && (k.0 == self.warm_up_end.0 || k.0 == self.end.0 || k.0.is_multiple_of(self.window))
    }

    /// The first boundary after `k`, or the end.
    pub fn next_boundary(&self, k: Tti) -> Tti {
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
    fn boundaries_are_found_one_after_another() {
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
        assert!(
            (0..96)
                .map(Tti)
                .filter(|&k| boundaries.is_boundary(k))
                .map(|k| k.0)
                .eq(found)
        );
        let whole = Boundaries {
            window: u64::MAX,
            warm_up_end: Tti::ZERO,
            end: Tti(7),
        };
        assert_eq!(whole.next_boundary(Tti::ZERO), Tti(7));
    }
}
