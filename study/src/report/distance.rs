//! Deviation of findings from a claim, as a number. [`super::search`] uses it to find the condition closest to a claim
//! that none meets. [`super::finding_text`] describes the same deviations as text; change both.

use super::judge::Finding;
use crate::claims::{Claim, Statement};

/// Computes the deviation of `findings` from `claim`: 0 if they are exactly as stated, infinite if it is undefined.
///
/// Values, ranges and bounds: |ln(ours / the nearest allowed value)|, the largest over several N and policies. A stated
/// 0: |ln| of our multiple of the 1 % of the others that counts as 0. A trend: the largest step against it, divided by
/// the range of all means. A constant level: half the range divided by the middle. Unlike in the rule of
/// [`super::judge()`], these two ranges cover all compared policies together. Deviations are comparable only under the
/// same claim.
pub(super) fn deviation(claim: &Claim, findings: &[Finding]) -> f64 {
    if findings.is_empty() {
        return f64::INFINITY;
    }
    let worst = |deviation_of: &dyn Fn(&Finding) -> f64| findings.iter().map(deviation_of).fold(0.0, f64::max);
    match claim.statement {
        Statement::About(0.0) => worst(&|finding| log_factor(finding.value, 0.0, finding.zero_limit)),
        Statement::About(v) => worst(&|finding| log_factor(finding.value, v, v)),
        Statement::Between(low, high) => worst(&|finding| log_factor(finding.value, low, high)),
        Statement::Below(v) => worst(&|finding| log_factor(finding.value, f64::NEG_INFINITY, v)),
        Statement::Above(v) => worst(&|finding| log_factor(finding.value, v, f64::INFINITY)),
        Statement::Largest(v) => log_factor(reduce_values(findings, f64::max), v, v),
        Statement::Smallest(v) => log_factor(reduce_values(findings, f64::min), v, v),
        Statement::Constant => level_deviation(reduce_values(findings, f64::min), reduce_values(findings, f64::max)),
        Statement::Falls => trend_deviation(findings, |earlier, later| later - earlier),
        Statement::Rises => trend_deviation(findings, |earlier, later| earlier - later),
    }
}

/// Computes |ln| of the factor from `value` to the nearest value in `low` to `high`; infinite if the factor has no
/// logarithm.
///
/// # Panics
/// If `low` is above `high`.
fn log_factor(value: f64, low: f64, high: f64) -> f64 {
    let nearest = value.clamp(low, high);
    let is_within = value.total_cmp(&nearest).is_eq();
    let factor = value / nearest;
    if is_within {
        0.0
    } else if factor > 0.0 {
        libm::log(factor).abs()
    } else {
        f64::INFINITY
    }
}

/// Reduces the values of all `findings` with `pick`; NaN without findings.
fn reduce_values(findings: &[Finding], pick: fn(f64, f64) -> f64) -> f64 {
    findings
        .iter()
        .map(|finding| finding.value)
        .reduce(pick)
        .unwrap_or(f64::NAN)
}

/// Computes half the range divided by the middle.
fn level_deviation(least: f64, most: f64) -> f64 {
    if most > least {
        (most - least) / (most + least)
    } else {
        0.0
    }
}

/// Computes the largest step against a trend between two N of one comparison, as a share of the range of all values; 1
/// if all values are equal. `step` is measured from an earlier to a later value.
fn trend_deviation(findings: &[Finding], step: impl Fn(f64, f64) -> f64) -> f64 {
    let precedes_in_trend = |a: &Finding, b: &Finding| a.other_policy == b.other_policy && a.n < b.n;
    let pairs = findings.iter().flat_map(|a| findings.iter().map(move |b| (a, b)));
    let largest = pairs
        .filter(|(a, b)| precedes_in_trend(a, b))
        .map(|(a, b)| step(a.value, b.value))
        .fold(0.0, f64::max);
    let range = reduce_values(findings, f64::max) - reduce_values(findings, f64::min);
    // Without any change there is no trend, which is as far off as the largest possible step.
    if range > 0.0 { largest / range } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claims::{ClaimQuantity, DeviceCounts, FIG_8};

    fn deviation_of(statement: Statement, values: &[f64]) -> f64 {
        let finding = |(n, value): (u32, &f64)| Finding {
            n,
            other_policy: None,
            value: *value,
            low: 0.0,
            high: f64::INFINITY,
            zero_limit: 0.5,
            metric_estimate: None,
        };
        let findings: Vec<Finding> = (1..).zip(values).map(finding).collect();
        deviation(
            &Claim::new("knn", DeviceCounts::All, ClaimQuantity::Mean, statement, FIG_8),
            &findings,
        )
    }

    #[test]
    fn the_deviation_is_the_largest_over_the_findings() {
        let (ln_two, ln_four) = (std::f64::consts::LN_2, 2.0 * std::f64::consts::LN_2);
        for (statement, values, expected) in [
            (Statement::About(10.0), vec![10.0], 0.0),
            (Statement::About(10.0), vec![5.0], ln_two),
            (Statement::About(10.0), vec![5.0, 40.0], ln_four),
            (Statement::About(10.0), vec![0.0], f64::INFINITY),
            (Statement::About(0.0), vec![0.4], 0.0),
            (Statement::About(0.0), vec![1.0], ln_two),
            (Statement::Between(2.0, 4.0), vec![3.0, 8.0], ln_two),
            (Statement::Below(2.0), vec![0.0, 1.0], 0.0),
            (Statement::Below(2.0), vec![4.0], ln_two),
            (Statement::Above(2.0), vec![1.0, 9.0], ln_two),
            (Statement::Largest(4.0), vec![1.0, 8.0, 2.0], ln_two),
            (Statement::Smallest(4.0), vec![1.0, 8.0], ln_four),
            (Statement::Constant, vec![1.0, 3.0], 0.5),
            (Statement::Constant, vec![0.0, 0.0], 0.0),
            (Statement::Falls, vec![5.0, 1.0, 3.0], 0.5),
            (Statement::Falls, vec![5.0, 4.0, 3.0], 0.0),
            (Statement::Falls, vec![5.0, 5.0], 1.0),
            (Statement::Rises, vec![5.0, 1.0, 3.0], 1.0),
            (Statement::Rises, vec![], f64::INFINITY),
        ] {
            let deviation = deviation_of(statement, &values);
            let is_same = deviation.total_cmp(&expected).is_eq() || (deviation - expected).abs() < 1e-12;
            assert!(
                is_same,
                "{statement:?} for {values:?}: {deviation}, expected {expected}"
            );
        }
    }
}
