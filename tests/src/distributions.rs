//! Draws events and tests drawn samples against their distribution. Seeds are fixed, so the tests are deterministic.

use reveille_bs::scenario::Scenario;
use reveille_common::event::{ActiveEvent, EventProcess};
use reveille_common::ids::{MAX_TTIS, Tti};

/// Largest accepted deviation of a mean, in standard errors. A correct sample deviates more in 7 of a million tests.
pub const MAX_STANDARD_ERRORS: f64 = 4.5;

/// Fewest values for a comparison of means, whose distribution is close to normal from there on.
const MIN_VALUES: f64 = 300.0;
/// Least variance of a number of hits, and least expected number of values in a bin, for the same reason.
const MIN_CASES: f64 = 20.0;

/// Draws the first `n` events of `scenario`, none of them reported.
pub fn draw_events(scenario: &Scenario, n: usize) -> Vec<ActiveEvent> {
    let mut process = EventProcess::new(scenario.run.seed, scenario.area, &scenario.events, Tti(MAX_TTIS));
    let mut draw_event = || {
        let event = process.start();
        process.end(event.last);
        event
    };
    (0..n).map(|_| draw_event()).collect()
}

/// Checks that the mean of `values` is `expected`, using the sample's own standard error.
///
/// # Panics
/// If the mean differs or the sample is too small.
#[track_caller]
pub fn assert_mean(what: &str, values: impl IntoIterator<Item = f64>, expected: f64) {
    let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for value in values {
        n += 1.0;
        sum += value - expected;
        squares += (value - expected) * (value - expected);
    }
    assert!(n >= MIN_VALUES, "{what}: only {n} values");
    let (deviation, error) = (sum / n, (squares / n / n).sqrt());
    assert!(
        deviation.abs() <= MAX_STANDARD_ERRORS * error,
        "{what}: mean {} of {n} values, expected {expected}, {:.1} standard errors off",
        deviation + expected,
        deviation.abs() / error
    );
}

/// Checks that the share of true `hits` matches the probability `expected`.
///
/// # Panics
/// If the share differs or the sample is too small.
#[track_caller]
pub fn assert_share(what: &str, hits: impl IntoIterator<Item = bool>, expected: f64) {
    let (mut n, mut count) = (0.0, 0.0);
    for is_hit in hits {
        n += 1.0;
        count += f64::from(u8::from(is_hit));
    }
    let error = (expected * (1.0 - expected) / n).sqrt();
    assert!(n * expected * (1.0 - expected) >= MIN_CASES, "{what}: only {n} values");
    let share = count / n;
    assert!(
        (share - expected).abs() <= MAX_STANDARD_ERRORS * error,
        "{what}: share {share} of {n} values, expected {expected}, {:.1} standard errors off",
        (share - expected).abs() / error
    );
}

/// Checks the `counts` of bins against their `probabilities` with a χ² test.
///
/// # Panics
/// If the counts do not fit or the sample is too small.
#[track_caller]
pub fn assert_bin_counts(what: &str, counts: &[f64], probabilities: &[f64]) {
    let n: f64 = counts.iter().sum();
    let total: f64 = probabilities.iter().sum();
    assert!(
        (total - 1.0).abs() < 1e-9,
        "{what}: the probabilities add up to {total}"
    );
    let terms = counts.iter().zip(probabilities).map(|(count, p)| {
        assert!(n * p > MIN_CASES, "{what}: only {} values expected in a bin", n * p);
        (count - n * p) * (count - n * p) / (n * p)
    });
    // χ² has the mean `freedom` and the variance 2 · `freedom`.
    let (chi_squared, freedom) = (terms.sum::<f64>(), counts.len() as f64 - 1.0);
    assert!(
        chi_squared <= freedom + MAX_STANDARD_ERRORS * (2.0 * freedom).sqrt(),
        "{what}: χ² is {chi_squared} with {freedom} degrees of freedom; counts {counts:?}"
    );
}
