//! Differences of a metric between two policies or conditions. Runs with the same seeds have the same deployments,
//! epicentres and harvests unless their conditions differ in these, so the spread is taken over differences of pairs.
//! `report` judges gaps and ratios with the functions, and pairs only policies with equal lists of seeds. `reveille
//! compare` shows [`PairedDifference`], which pairs the common seeds.

use std::collections::BTreeMap;

use reveille_lab::metric_estimate::MetricEstimate;
use reveille_lab::stats::{Moments, student_t_quantile_95};
use reveille_lab::table::ResultRow;

use super::results::RunCondition;

/// A condition and the name of a policy under it, as in [`RunCondition::policies`].
pub type ConditionPolicy<'r> = (&'r RunCondition, &'r str);

/// The difference of a metric between two policies, or between two conditions of a policy, over their common seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairedDifference {
    /// Number of seeds with a value under both policies, ≥ 1.
    pub seeds: usize,
    /// Mean of the compared policy over these seeds.
    pub compared_mean: f64,
    /// Mean of the reference policy over these seeds.
    pub reference_mean: f64,
    /// Compared mean minus reference mean.
    pub difference: f64,
    /// Half the width of the 95 % interval of the difference; NaN for one seed.
    pub half_width: f64,
    /// Half the width of the 95 % interval of the difference as a share of the reference mean (delta method over the
    /// pairs, since both means vary). NaN without usable pairs, or unless the reference mean is above 0.
    pub share_half_width: f64,
    /// Whether the interval comes from the differences of pairs. With too few cases it is the sum of the intervals of
    /// both means.
    pub is_paired: bool,
}

impl PairedDifference {
    /// Compares runs of `compared` with runs of `reference`, both with `n` devices, by `metric`. Returns `None` without
    /// a common seed under which both have a value.
    pub fn new(compared: ConditionPolicy<'_>, reference: ConditionPolicy<'_>, n: u32, metric: &str) -> Option<Self> {
        fn by_seed<'r>((condition, policy): ConditionPolicy<'r>, n: u32, metric: &str) -> BTreeMap<u64, &'r ResultRow> {
            let defined = condition.runs(policy, n).filter(|row| row.metric(metric).is_some());
            defined.map(|row| (row.seed, row)).collect()
        }
        let (compared_by_seed, reference_by_seed) = (by_seed(compared, n, metric), by_seed(reference, n, metric));
        let common = compared_by_seed
            .iter()
            .filter_map(|(seed, row)| Some((*row, *reference_by_seed.get(seed)?)));
        let (compared_rows, reference_rows): (Vec<&ResultRow>, Vec<&ResultRow>) = common.unzip();
        let row_pairs = compared_rows.iter().zip(&reference_rows);
        let pairs: Vec<(f64, f64)> = row_pairs
            .filter_map(|(compared, reference)| Some((compared.metric(metric)?, reference.metric(metric)?)))
            .collect();
        let compared = MetricEstimate::from_rows(&compared_rows, metric)?;
        let reference = MetricEstimate::from_rows(&reference_rows, metric)?;
        let (difference, half_width) = difference_and_half_width(&compared, &reference, &pairs);
        let (compared_mean, reference_mean) = (compared.mean_estimate.mean, reference.mean_estimate.mean);
        let ratio_spread = paired_half_width(&compared, &reference, &pairs, compared_mean / reference_mean);
        Some(Self {
            seeds: pairs.len(),
            compared_mean,
            reference_mean,
            difference,
            half_width,
            share_half_width: ratio_spread
                .filter(|_| reference_mean > 0.0)
                .map_or(f64::NAN, |half_width| half_width / reference_mean),
            is_paired: paired_half_width(&compared, &reference, &pairs, 1.0).is_some(),
        })
    }
}

/// Returns `compared` − `reference` of two means and half the width of its interval; NaN if that is unknown. `pairs`
/// are values of both, in this order, by seed. Means without usable `pairs` get the sum of both half-widths.
pub(crate) fn difference_and_half_width(
    compared: &MetricEstimate,
    reference: &MetricEstimate,
    pairs: &[(f64, f64)],
) -> (f64, f64) {
    let half_width =
        paired_half_width(compared, reference, pairs, 1.0).unwrap_or(compared.half_width() + reference.half_width());
    (compared.mean_estimate.mean - reference.mean_estimate.mean, half_width)
}

/// Returns half the width of the 95 % interval of the mean of a − `factor` · b over `pairs` (a, b) of the compared and
/// the reference policy. `None` if the cases of either are too few, or for fewer than two pairs.
pub(crate) fn paired_half_width(
    compared: &MetricEstimate,
    reference: &MetricEstimate,
    pairs: &[(f64, f64)],
    factor: f64,
) -> Option<f64> {
    // With too few cases for an interval, the spread of the differences does not show their frequency.
    let has_too_few_cases =
        |estimate: &MetricEstimate| estimate.upper_bound.is_some() && estimate.case_counts.is_some();
    if pairs.len() < 2 || has_too_few_cases(compared) || has_too_few_cases(reference) {
        return None;
    }
    let mut moments = Moments::default();
    for (a, b) in pairs {
        moments.add(a - factor * b);
    }
    let deviation = moments.estimate()?.deviation;
    Some(student_t_quantile_95(pairs.len() - 1) * deviation / (pairs.len() as f64).sqrt())
}
