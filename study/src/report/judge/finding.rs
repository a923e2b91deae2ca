//! Findings: our values of a claim's quantity at each N, with 95 % intervals. The rule in [`super`] judges them. All
//! verdicts and measured values of the report, and so of docs/reproduction.md, depend on them.

use reveille_lab::metric_estimate::MetricEstimate;

use crate::claims::{Claim, ClaimQuantity, ClaimTopic};
use crate::figures::paired::{difference_and_half_width, paired_half_width};
use crate::figures::results::RunCondition;

/// Largest value that counts as 0, as a share of the largest of the other policies' means. Part of rule 2 in [`super`].
const ZERO_SHARE: f64 = 0.01;

/// Our value of a claim's quantity at one N, against one policy if the claim compares policies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finding {
    /// Number of devices N.
    pub n: u32,
    /// The compared policy; `None` for claims on one policy alone.
    pub other_policy: Option<&'static str>,
    /// Quantity, computed from means.
    pub value: f64,
    /// Lower end of its 95 % interval; 0 if unknown.
    pub low: f64,
    /// Upper end of its 95 % interval; infinite if unknown.
    pub high: f64,
    /// Largest value that counts as 0.
    pub zero_limit: f64,
    /// Estimate of the metric, if the quantity is its mean.
    pub metric_estimate: Option<MetricEstimate>,
}

/// Computes the findings on `claim` of `topic`, in ascending order of N.
pub(super) fn findings(topic: &ClaimTopic, claim: &Claim, condition: &RunCondition) -> Vec<Finding> {
    let runs = TopicRuns { topic, condition };
    let device_counts = condition.device_counts(claim.policy).into_iter();
    let device_counts = device_counts.filter(|n| claim.device_counts.contains(*n));
    device_counts.flat_map(|n| runs.findings_at(claim, n)).collect()
}

/// Runs of a condition, evaluated on the metric of a topic.
pub(super) struct TopicRuns<'a> {
    pub topic: &'a ClaimTopic,
    pub condition: &'a RunCondition,
}

impl TopicRuns<'_> {
    /// Estimate of the metric over the runs of `policy` with `n` devices.
    pub(super) fn metric_estimate(&self, policy: &str, n: u32) -> Option<MetricEstimate> {
        let estimate = self.condition.metric_estimate(policy, n, self.topic.metric)?;
        Some(if self.topic.is_per_device {
            estimate.divided_by(f64::from(n))
        } else {
            estimate
        })
    }

    /// Computes the findings on `claim` with `n` devices, in the order of the compared policies; empty without runs.
    fn findings_at(&self, claim: &Claim, n: u32) -> Vec<Finding> {
        let Some(estimate) = self.metric_estimate(claim.policy, n) else {
            return Vec::new();
        };
        let mean_finding = Finding {
            n,
            other_policy: None,
            value: estimate.mean_estimate.mean,
            low: estimate.limits().0,
            high: estimate.limits().1,
            zero_limit: self.zero_limit(claim.policy, n),
            metric_estimate: None,
        };
        match claim.quantity {
            ClaimQuantity::Mean => vec![Finding {
                metric_estimate: Some(estimate),
                ..mean_finding
            }],
            ClaimQuantity::Ratio(others) => {
                let ratio_to = |other: &&'static str| {
                    let other_estimate = self.metric_estimate(other, n)?;
                    let pairs = self.paired_values(claim.policy, other, n);
                    let [value, low, high] = ratio_with_interval(&estimate, &other_estimate, &pairs);
                    Some(Finding {
                        other_policy: Some(other),
                        value,
                        low,
                        high,
                        ..mean_finding
                    })
                };
                others.iter().filter_map(ratio_to).collect()
            }
            ClaimQuantity::Gap(other) => {
                let finding = self.metric_estimate(other, n).map(|other_estimate| {
                    let pairs = self.paired_values(claim.policy, other, n);
                    let [value, low, high] = gap_with_interval(&estimate, &other_estimate, &pairs);
                    Finding {
                        other_policy: Some(other),
                        value,
                        low,
                        high,
                        ..mean_finding
                    }
                });
                finding.into_iter().collect()
            }
            ClaimQuantity::Growth(from) => {
                let finding = self.metric_estimate(claim.policy, from).map(|base_estimate| {
                    // Not paired: runs with another N have other deployments, whatever their seeds.
                    let [value, low, high] = ratio_with_interval(&estimate, &base_estimate, &[]);
                    Finding {
                        value,
                        low,
                        high,
                        ..mean_finding
                    }
                });
                finding.into_iter().collect()
            }
        }
    }

    /// Largest value that counts as 0 for `policy` with `n` devices.
    fn zero_limit(&self, policy: &str, n: u32) -> f64 {
        let others = self.condition.policies().into_iter().filter(|other| *other != policy);
        let means = others.filter_map(|other| Some(self.metric_estimate(other, n)?.mean_estimate.mean));
        ZERO_SHARE * means.fold(0.0, f64::max)
    }

    /// Values of both policies, run by run; empty unless both were run with the same seeds.
    fn paired_values(&self, policy: &str, other: &str, n: u32) -> Vec<(f64, f64)> {
        let divisor = if self.topic.is_per_device { f64::from(n) } else { 1.0 };
        let seeds_and_values = |policy: &str| -> Vec<(u64, f64)> {
            let runs = self.condition.runs(policy, n);
            let values = runs.filter_map(|row| Some((row.seed, row.metric(self.topic.metric)? / divisor)));
            values.collect()
        };
        let (a, b) = (seeds_and_values(policy), seeds_and_values(other));
        // Runs are in the order of seeds, so two equal lists have equal seeds at each index.
        if a.len() != b.len() || a.iter().zip(&b).any(|(a, b)| a.0 != b.0) {
            return Vec::new();
        }
        a.into_iter().zip(b).map(|(a, b)| (a.1, b.1)).collect()
    }
}

/// Computes the ratio of the mean of `dividend` to the mean of `divisor`, and the lower and upper end of its interval,
/// in this order. Runs with the same seeds have the same deployments, epicentres and harvests, so the spread is taken
/// over their differences from the common ratio. Without `pairs`, and for metrics with an upper bound from case counts,
/// the interval is the worst case of both intervals.
fn ratio_with_interval(dividend: &MetricEstimate, divisor: &MetricEstimate, pairs: &[(f64, f64)]) -> [f64; 3] {
    let (a, b) = (dividend.mean_estimate.mean, divisor.mean_estimate.mean);
    let value = match (a == 0.0, b == 0.0) {
        (true, true) => 1.0,
        (false, true) => f64::INFINITY,
        (_, false) => a / b,
    };
    if let Some(half_width) = paired_half_width(dividend, divisor, pairs, value).filter(|_| b > 0.0) {
        return [value, (value - half_width / b).max(0.0), value + half_width / b];
    }
    let ((low, high), (divisor_low, divisor_high)) = (dividend.limits(), divisor.limits());
    let low = if divisor_high > 0.0 { low / divisor_high } else { 0.0 };
    let high = if divisor_low > 0.0 {
        high / divisor_low
    } else {
        f64::INFINITY
    };
    [value, low, high]
}

/// Computes the distance between two means, and the lower and upper end of its interval, in this order. Pairs are used
/// as in [`ratio_with_interval`]; without them the half-widths of both means are added.
fn gap_with_interval(a: &MetricEstimate, b: &MetricEstimate, pairs: &[(f64, f64)]) -> [f64; 3] {
    let (signed_gap, half_width) = difference_and_half_width(a, b, pairs);
    let value = signed_gap.abs();
    if half_width.is_nan() {
        return [value, 0.0, f64::INFINITY];
    }
    [value, (value - half_width).max(0.0), value + half_width]
}

#[cfg(test)]
mod tests {
    use reveille_lab::metric_estimate::CaseCounts;
    use reveille_lab::stats::Estimate;

    use super::*;

    fn estimate_of(values: &[f64]) -> MetricEstimate {
        MetricEstimate {
            mean_estimate: Estimate::from_values_or_nan(values.iter().copied()),
            case_counts: None,
            upper_bound: None,
            lower_bound: None,
        }
    }

    #[test]
    fn the_interval_of_a_ratio_of_pairs_follows_from_residuals() {
        // b is half of a, except for −0.1, 0.2 and −0.1: residuals a − 2b of 0.2, −0.4, 0.2, whose deviation is √0.12.
        let (a, b) = ([2.0, 4.0, 6.0], [0.9, 2.2, 2.9]);
        let pairs: Vec<(f64, f64)> = a.into_iter().zip(b).collect();
        let [value, low, high] = ratio_with_interval(&estimate_of(&a), &estimate_of(&b), &pairs);
        // 4.302653 is the 97.5 % quantile of Student's t with two degrees of freedom.
        let half_width = 4.302_653 * 0.12_f64.sqrt() / 3.0_f64.sqrt() / 2.0;
        assert!((value - 2.0).abs() < 1e-12);
        assert!(
            (low - (2.0 - half_width)).abs() < 1e-5 && (high - (2.0 + half_width)).abs() < 1e-5,
            "interval {low} to {high}"
        );
        let [_, wide_low, wide_high] = ratio_with_interval(&estimate_of(&a), &estimate_of(&b), &[]);
        assert!(
            wide_low < low && high < wide_high,
            "without pairs, the interval includes the spread of the seeds"
        );
    }

    #[test]
    fn the_interval_of_a_gap_follows_from_differences_of_pairs() {
        let (a, b) = ([2.0, 4.0, 6.0], [1.0, 3.1, 4.9]);
        let pairs: Vec<(f64, f64)> = a.into_iter().zip(b).collect();
        let [value, low, high] = gap_with_interval(&estimate_of(&b), &estimate_of(&a), &pairs);
        // Differences of 1, 0.9 and 1.1, whose deviation is 0.1.
        let half_width = 4.302_653 * 0.1 / 3.0_f64.sqrt();
        assert!((value - 1.0).abs() < 1e-12);
        assert!((low - (1.0 - half_width)).abs() < 1e-5 && (high - (1.0 + half_width)).abs() < 1e-5);
        let [_, low, high] = gap_with_interval(&estimate_of(&[2.0]), &estimate_of(&[1.0]), &[]);
        assert_eq!((low, high), (0.0, f64::INFINITY), "one run has no interval");
    }

    #[test]
    fn a_ratio_to_zero_is_defined() {
        let no_cases = MetricEstimate {
            case_counts: Some(CaseCounts { cases: 0, events: 30 }),
            upper_bound: Some(0.1),
            ..estimate_of(&[0.0, 0.0])
        };
        let [value, low, high] = ratio_with_interval(&no_cases, &no_cases, &[(0.0, 0.0); 2]);
        assert!((value - 1.0).abs() < 1e-12 && low == 0.0 && high.is_infinite());
        let [value, low, high] = ratio_with_interval(&estimate_of(&[4.0, 4.0]), &no_cases, &[(4.0, 0.0); 2]);
        assert!(value.is_infinite() && high.is_infinite() && (low - 40.0).abs() < 1e-9);
        let [value, low, high] = ratio_with_interval(&no_cases, &estimate_of(&[4.0, 4.0]), &[(0.0, 4.0); 2]);
        assert!(value == 0.0 && low == 0.0 && (high - 0.025).abs() < 1e-12);
    }
}
