//! Our figures for a claim: its quantity at each N.

use reveille_lab::metric_estimate::MetricEstimate;
use reveille_lab::stats::{Moments, student_t};

use crate::claims::{Claim, ClaimQuantity, ClaimTopic};
use crate::figures::results::RunCondition;

/// Largest value that counts as 0, as a share of the largest of the other policies' means.
const ZERO: f64 = 0.01;

/// Our figure at one N, with the policy in its comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finding {
    /// Number of devices N.
    pub n: u32,
    /// The other policy of the comparison.
    pub other: Option<&'static str>,
    /// Quantity, computed from means.
    pub value: f64,
    /// Lower end of its 95 % interval; 0 if unknown.
    pub low: f64,
    /// Upper end of its 95 % interval; infinite if unknown.
    pub high: f64,
    /// Largest value that counts as 0.
    pub zero: f64,
    /// Estimate of the metric, if the quantity is its mean.
    pub reading: Option<MetricEstimate>,
}

/// Computes the figures for `claim` of `topic`, in ascending order of N.
pub(super) fn findings(topic: &ClaimTopic, claim: &Claim, condition: &RunCondition) -> Vec<Finding> {
    let runs = TopicRuns { topic, condition };
    let sizes = condition.sizes(claim.policy).into_iter();
    let sizes = sizes.filter(|n| claim.sites.holds(*n));
    sizes.flat_map(|n| runs.at(claim, n)).collect()
}

/// Runs of a condition, evaluated on the metric of a topic.
pub(super) struct TopicRuns<'a> {
    pub topic: &'a ClaimTopic,
    pub condition: &'a RunCondition,
}

impl TopicRuns<'_> {
    /// Estimate of the metric over the runs of `policy` with `n` devices.
    pub(super) fn reading(&self, policy: &str, n: u32) -> Option<MetricEstimate> {
        let reading = self.condition.reading(policy, n, self.topic.metric)?;
        Some(if self.topic.is_per_device {
            reading.divided_by(f64::from(n))
        } else {
            reading
        })
    }

    fn at(&self, claim: &Claim, n: u32) -> Vec<Finding> {
        let Some(own) = self.reading(claim.policy, n) else {
            return Vec::new();
        };
        let base = Finding {
            n,
            other: None,
            value: own.estimate.mean,
            low: own.ends().0,
            high: own.ends().1,
            zero: self.zero(claim.policy, n),
            reading: None,
        };
        match claim.quantity {
            ClaimQuantity::Own => vec![Finding {
                reading: Some(own),
                ..base
            }],
            ClaimQuantity::Ratio(others) => {
                let against = |other: &&'static str| {
                    let theirs = self.reading(other, n)?;
                    let pairs = self.pairs(claim.policy, other, n);
                    let [value, low, high] = ratio(&own, &theirs, &pairs);
                    Some(Finding {
                        other: Some(other),
                        value,
                        low,
                        high,
                        ..base
                    })
                };
                others.iter().filter_map(against).collect()
            }
            ClaimQuantity::Gap(other) => {
                let gap = self.reading(other, n).map(|theirs| {
                    let [value, low, high] = gap(&own, &theirs, &self.pairs(claim.policy, other, n));
                    Finding {
                        other: Some(other),
                        value,
                        low,
                        high,
                        ..base
                    }
                });
                gap.into_iter().collect()
            }
            ClaimQuantity::Growth(from) => {
                let growth = self.reading(claim.policy, from).map(|start| {
                    // Not paired: runs with another N have other deployments, whatever their seeds.
                    let [value, low, high] = ratio(&own, &start, &[]);
                    Finding {
                        value,
                        low,
                        high,
                        ..base
                    }
                });
                growth.into_iter().collect()
            }
        }
    }

    /// Largest value that counts as 0 for `policy` with `n` devices.
    fn zero(&self, policy: &str, n: u32) -> f64 {
        let others = self.condition.policies().into_iter().filter(|other| *other != policy);
        let means = others.filter_map(|other| Some(self.reading(other, n)?.estimate.mean));
        ZERO * means.fold(0.0, f64::max)
    }

    /// Values of both policies, run by run, if both were run with the same seeds.
    fn pairs(&self, a: &str, b: &str, n: u32) -> Vec<(f64, f64)> {
        let parts = if self.topic.is_per_device { f64::from(n) } else { 1.0 };
        let values = |policy: &str| -> Vec<(u64, f64)> {
            let runs = self.condition.runs(policy, n);
            let values = runs.filter_map(|row| Some((row.seed, row.metric(self.topic.metric)? / parts)));
            values.collect()
        };
        let (a, b) = (values(a), values(b));
        // Runs are in the order of seeds, so two equal lists have equal seeds at each index.
        if a.len() != b.len() || a.iter().zip(&b).any(|(a, b)| a.0 != b.0) {
            return Vec::new();
        }
        a.into_iter().zip(b).map(|(a, b)| (a.1, b.1)).collect()
    }
}

/// Computes the ratio of two means with its interval. Runs with the same seeds have the same deployments, epicentres
/// and harvests, so the spread is taken over their differences from the common ratio. Other means, and metrics with
/// only a bound, use the worst case of both intervals.
fn ratio(own: &MetricEstimate, theirs: &MetricEstimate, pairs: &[(f64, f64)]) -> [f64; 3] {
    let (a, b) = (own.estimate.mean, theirs.estimate.mean);
    let value = match (a == 0.0, b == 0.0) {
        (true, true) => 1.0,
        (false, true) => f64::INFINITY,
        (_, false) => a / b,
    };
    if let Some(half) = half_of(own, theirs, pairs, value).filter(|_| b > 0.0) {
        return [value, (value - half / b).max(0.0), value + half / b];
    }
    let ((low, high), (least, most)) = (own.ends(), theirs.ends());
    let low = if most > 0.0 { low / most } else { 0.0 };
    let high = if least > 0.0 { high / least } else { f64::INFINITY };
    [value, low, high]
}

/// Computes the distance between two means with its interval, as in [`ratio`].
fn gap(own: &MetricEstimate, theirs: &MetricEstimate, pairs: &[(f64, f64)]) -> [f64; 3] {
    let value = (own.estimate.mean - theirs.estimate.mean).abs();
    let half = half_of(own, theirs, pairs, 1.0).unwrap_or(own.half_width() + theirs.half_width());
    if half.is_nan() {
        return [value, 0.0, f64::INFINITY];
    }
    [value, (value - half).max(0.0), value + half]
}

/// Half the interval of the mean of a − `factor` · b over `pairs`; `None` if the cases are too few or there are fewer
/// than two pairs.
fn half_of(own: &MetricEstimate, theirs: &MetricEstimate, pairs: &[(f64, f64)], factor: f64) -> Option<f64> {
    // With too few cases for an interval, the spread of the differences does not show their frequency.
    let is_rare = |reading: &MetricEstimate| reading.upper.is_some() && reading.counted.is_some();
    if pairs.len() < 2 || is_rare(own) || is_rare(theirs) {
        return None;
    }
    let mut moments = Moments::default();
    for (a, b) in pairs {
        moments.add(a - factor * b);
    }
    let deviation = moments.estimate()?.deviation;
    Some(student_t(pairs.len() - 1) * deviation / (pairs.len() as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use reveille_lab::metric_estimate::CaseCounts;
    use reveille_lab::stats::Estimate;

    use super::*;

    fn reading(values: &[f64]) -> MetricEstimate {
        MetricEstimate {
            estimate: Estimate::over(values.iter().copied()),
            counted: None,
            upper: None,
            lower: None,
        }
    }

    #[test]
    fn the_interval_of_a_ratio_of_pairs_follows_from_residuals() {
        // b is half of a, except for ±0.1: residuals a − 2b of 0.2, −0.4, 0.2, whose deviation is √0.12.
        let (a, b) = ([2.0, 4.0, 6.0], [0.9, 2.2, 2.9]);
        let pairs: Vec<(f64, f64)> = a.into_iter().zip(b).collect();
        let [value, low, high] = ratio(&reading(&a), &reading(&b), &pairs);
        let half = 4.302_653 * 0.12_f64.sqrt() / 3.0_f64.sqrt() / 2.0;
        assert!((value - 2.0).abs() < 1e-12);
        assert!(
            (low - (2.0 - half)).abs() < 1e-5 && (high - (2.0 + half)).abs() < 1e-5,
            "{low} {high}"
        );
        let [_, wide_low, wide_high] = ratio(&reading(&a), &reading(&b), &[]);
        assert!(wide_low < low && high < wide_high, "the spread of the seeds is in it");
    }

    #[test]
    fn the_interval_of_a_gap_follows_from_differences() {
        let (a, b) = ([2.0, 4.0, 6.0], [1.0, 3.1, 4.9]);
        let pairs: Vec<(f64, f64)> = a.into_iter().zip(b).collect();
        let [value, low, high] = gap(&reading(&b), &reading(&a), &pairs);
        let half = 4.302_653 * 0.1 / 3.0_f64.sqrt();
        assert!((value - 1.0).abs() < 1e-12);
        assert!((low - (1.0 - half)).abs() < 1e-5 && (high - (1.0 + half)).abs() < 1e-5);
        let [_, low, high] = gap(&reading(&[2.0]), &reading(&[1.0]), &[]);
        assert_eq!((low, high), (0.0, f64::INFINITY), "one run tells no interval");
    }

    #[test]
    fn a_ratio_to_zero_is_defined() {
        let none = MetricEstimate {
            counted: Some(CaseCounts { cases: 0, events: 30 }),
            upper: Some(0.1),
            ..reading(&[0.0, 0.0])
        };
        let [value, low, high] = ratio(&none, &none, &[(0.0, 0.0); 2]);
        assert!((value - 1.0).abs() < 1e-12 && low == 0.0 && high.is_infinite());
        let [value, low, high] = ratio(&reading(&[4.0, 4.0]), &none, &[(4.0, 0.0); 2]);
        assert!(value.is_infinite() && high.is_infinite() && (low - 40.0).abs() < 1e-9);
        let [value, low, high] = ratio(&none, &reading(&[4.0, 4.0]), &[(0.0, 4.0); 2]);
        assert!(value == 0.0 && low == 0.0 && (high - 0.025).abs() < 1e-12);
    }
}
