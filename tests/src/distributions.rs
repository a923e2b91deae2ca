//! Draws events and tests drawn samples against their distribution, for `tests/tests/events.rs` and `bursts.rs`. The
//! seeds of the samples are fixed there, so the tests are deterministic: a changed seed can fail a correct sample.

use reveille_bs::scenario::Scenario;
use reveille_common::event::{ActiveEvent, EventProcess};
use reveille_common::ids::{MAX_TTIS, Tti};

/// Largest accepted deviation of a mean, in standard errors. A correct normal sample deviates more in 7 of a million
/// tests.
pub const MAX_STANDARD_ERRORS: f64 = 4.5;

/// Fewest values for a comparison of means, whose distribution is close to normal from there on.
const MIN_VALUES: f64 = 300.0;
/// Least variance of a number of hits, and least expected number of values in a bin, for the same reason.
const MIN_CASES: f64 = 20.0;

/// Draws the first `n` events of `scenario`. None is reported, so each lasts for its drawn duration, and the next
/// starts after it.
pub fn draw_events(scenario: &Scenario, n: usize) -> Vec<ActiveEvent> {
    let mut process = EventProcess::new(scenario.run.seed, scenario.area, &scenario.events, Tti(MAX_TTIS));
    let mut draw_event = || {
        let event = process.start();
        process.end(event.last);
        event
    };
    (0..n).map(|_| draw_event()).collect()
}

/// Checks that the mean of `values` is `expected`, with the standard error from their deviations from `expected`.
/// `quantity` names them in messages.
///
/// # Panics
/// If the mean differs or the sample is too small.
#[track_caller]
pub fn assert_mean(quantity: &str, values: impl IntoIterator<Item = f64>, expected: f64) {
    let (mut n, mut deviation_sum, mut square_sum) = (0.0, 0.0, 0.0);
    for value in values {
        n += 1.0;
        deviation_sum += value - expected;
        square_sum += (value - expected) * (value - expected);
    }
    assert!(n >= MIN_VALUES, "{quantity}: only {n} values");
    let (deviation, standard_error) = (deviation_sum / n, (square_sum / n / n).sqrt());
    assert!(
        deviation.abs() <= MAX_STANDARD_ERRORS * standard_error,
        "{quantity}: mean {} of {n} values, expected {expected}, {:.1} standard errors off",
        deviation + expected,
        deviation.abs() / standard_error
    );
}

/// Checks that the share of true `hits` matches the probability `expected`.
///
/// # Panics
/// If the share differs or the sample is too small.
#[track_caller]
pub fn assert_share(quantity: &str, hits: impl IntoIterator<Item = bool>, expected: f64) {
    let (mut n, mut hit_count) = (0.0, 0.0);
    for is_hit in hits {
        n += 1.0;
        hit_count += f64::from(u8::from(is_hit));
    }
    let standard_error = (expected * (1.0 - expected) / n).sqrt();
    assert!(
        n * expected * (1.0 - expected) >= MIN_CASES,
        "{quantity}: only {n} values"
    );
    let share = hit_count / n;
    assert!(
        (share - expected).abs() <= MAX_STANDARD_ERRORS * standard_error,
        "{quantity}: share {share} of {n} values, expected {expected}, {:.1} standard errors off",
        (share - expected).abs() / standard_error
    );
}

/// Checks the `counts` of bins against their `probabilities` with a χ² test. Both have the same length; the bins cover
/// all outcomes.
///
/// # Panics
/// If the counts do not fit, the sample is too small for a bin, or the probabilities do not add up to 1.
#[track_caller]
pub fn assert_bin_counts(quantity: &str, counts: &[f64], probabilities: &[f64]) {
    let n: f64 = counts.iter().sum();
    let total: f64 = probabilities.iter().sum();
    assert!(
        (total - 1.0).abs() < 1e-9,
        "{quantity}: the probabilities add up to {total}"
    );
    let terms = counts.iter().zip(probabilities).map(|(count, p)| {
        assert!(n * p > MIN_CASES, "{quantity}: only {} values expected in a bin", n * p);
        (count - n * p) * (count - n * p) / (n * p)
    });
    // χ² has the mean `freedom` and the variance 2 · `freedom`.
    let (chi_squared, freedom) = (terms.sum::<f64>(), counts.len() as f64 - 1.0);
    assert!(
        chi_squared <= freedom + MAX_STANDARD_ERRORS * (2.0 * freedom).sqrt(),
        "{quantity}: χ² is {chi_squared} with {freedom} degrees of freedom; counts {counts:?}"
    );
}
