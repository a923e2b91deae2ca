//! The longest stretch of a run in which a source certainly harvests nothing, such as a night: for `energy_balance`.

/// Returns the longest stretch without harvest in the first `ttis` TTIs of a run, TTIs. `pattern` yields parts of
/// constant harvest: whether it is 0, and the length in TTIs. The pattern repeats, or nothing follows if it `stops`.
pub(super) fn longest_gap(pattern: impl Iterator<Item = (bool, u64)> + Clone, stops: bool, ttis: u64) -> u64 {
    let dark_end = stops.then_some((true, u64::MAX));
    // A stretch across the end of the pattern lies within its second repetition. If all parts are dark, so is the run.
    let is_dark = pattern.clone().all(|(is_zero, _)| is_zero);
    let repetition = pattern.clone().filter(|_| !stops);
    let parts = pattern
        .chain(repetition)
        .chain(dark_end.or(is_dark.then_some((true, u64::MAX))));
    let (mut tti, mut gap, mut longest) = (0_u64, 0_u64, 0_u64);
    for (is_zero, length) in parts {
        let length = length.min(ttis - tti);
        tti += length;
        gap = if is_zero { gap + length } else { 0 };
        longest = longest.max(gap);
    }
    longest
}
