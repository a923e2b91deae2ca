//! The longest stretch of a run in which a source certainly harvests nothing, such as a night. The users and the tests
//! are in `energy_balance/`. The random gaps between arrivals are another concept (`GapTable` in `rng.rs`).

use crate::ids::Tti;

/// Consecutive TTIs without harvest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HarvestGap {
    /// The first TTI.
    pub first: Tti,
    /// Number of TTIs.
    pub ttis: u64,
}

/// Returns the longest gap in the first `ttis` TTIs of a run, the first of equal ones; without a gap, no TTIs.
/// `pattern` yields parts of constant harvest: whether it is 0, and the length in TTIs. The pattern repeats, or nothing
/// follows if it `stops`. Under an empty pattern the whole run is a gap.
pub(super) fn longest_gap(pattern: impl Iterator<Item = (bool, u64)> + Clone, stops: bool, ttis: u64) -> HarvestGap {
    let dark_end = stops.then_some((true, u64::MAX));
    // A gap across the end of the pattern lies within its second repetition. If all parts are dark, so is the run.
    let is_all_dark = pattern.clone().all(|(is_zero, _)| is_zero);
    let repetition = pattern.clone().filter(|_| !stops);
    let parts = pattern
        .chain(repetition)
        .chain(dark_end.or(is_all_dark.then_some((true, u64::MAX))));
    let mut tti = 0_u64;
    let mut gap = HarvestGap {
        first: Tti::ZERO,
        ttis: 0,
    };
    let mut longest = gap;
    for (is_zero, length) in parts {
        let length = length.min(ttis - tti);
        tti += length;
        gap = if is_zero {
            HarvestGap {
                ttis: gap.ttis + length,
                ..gap
            }
        } else {
            HarvestGap {
                first: Tti(tti),
                ttis: 0,
            }
        };
        if gap.ttis > longest.ttis {
            longest = gap;
        }
    }
    longest
}
