//! Draws events and tests drawn samples against their distribution. Seeds are fixed, so the tests are deterministic.

use reveille_bs::scenario::Scenario;
use reveille_common::event::{ActiveEvent, EventProcess};
use reveille_common::ids::{MAX_TTIS, Tti};

/// Largest accepted deviation of a mean, in standard errors.
pub const BOUND: f64 = 4.5;

/// Draws the first `n` events of `scenario`, none of them reported.
pub fn drawn(scenario: &Scenario, n: usize) -> Vec<ActiveEvent> {
    let mut process = EventProcess::new(scenario.run.seed, scenario.area, &scenario.events, Tti(MAX_TTIS));
    let mut next = || {
        let event = process.start();
        process.end(event.last);
        event
    };
    (0..n).map(|_| next()).collect()
}

/// Checks that the mean of `values` is `expected`, using the sample's own standard error.
///
/// # Panics
/// If the mean differs or the sample is too small.
#[track_caller]
pub fn mean_is(what: &str, values: impl IntoIterator<Item = f64>, expected: f64) {
    let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for value in values {
        n += 1.0;
        sum += value - expected;
        squares += (value - expected) * (value - expected);
    }
    assert!(n >= 300.0, "{what}: only {n} values");
    let (off, error) = (sum / n, (squares / n / n).sqrt());
    assert!(
        off.abs() <= BOUND * error,
        "{what}: {} of {n} values, expected {expected}, {:.1} standard errors off",
        off + expected,
        off.abs() / error
    );
}

/// Checks that the share of true `hits` matches the probability `expected`.
///
/// # Panics
/// If the share differs or the sample is too small.
#[track_caller]
pub fn share_is(what: &str, hits: impl IntoIterator<Item = bool>, expected: f64) {
    let (mut n, mut count) = (0.0, 0.0);
    for is_hit in hits {
        n += 1.0;
        count += f64::from(u8::from(is_hit));
    }
    let error = (expected * (1.0 - expected) / n).sqrt();
    assert!(n * expected * (1.0 - expected) >= 20.0, "{what}: only {n} values");
    let share = count / n;
    assert!(
        (share - expected).abs() <= BOUND * error,
        "{what}: {share} of {n}, expected {expected}, {:.1} standard errors off",
        (share - expected).abs() / error
    );
}

/// Checks the `counts` of cells against their `probabilities` with a χ² test.
///
/// # Panics
/// If the counts do not fit or the sample is too small.
#[track_caller]
pub fn cells_are(what: &str, counts: &[f64], probabilities: &[f64]) {
    let n: f64 = counts.iter().sum();
    let whole: f64 = probabilities.iter().sum();
    assert!((whole - 1.0).abs() < 1e-9, "{what}: cells of {whole} in all");
    let terms = counts.iter().zip(probabilities).map(|(count, p)| {
        assert!(n * p > 20.0, "{what}: too few in a cell of {p}");
        (count - n * p) * (count - n * p) / (n * p)
    });
    // χ² has the mean `freedom` and the variance 2 · `freedom`.
    let (chi, freedom) = (terms.sum::<f64>(), counts.len() as f64 - 1.0);
    assert!(
        chi <= freedom + BOUND * (2.0 * freedom).sqrt(),
        "{what}: χ² is {chi}, of {freedom} degrees of freedom; {counts:?}"
    );
}
