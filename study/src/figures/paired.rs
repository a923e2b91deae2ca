//! Differences of a metric between two policies or conditions. Runs with the same seeds have the same deployments,
//! epicentres and harvests, so the spread is taken over differences of pairs. `report` judges gaps and ratios by it,
//! and `reveille compare` shows the differences of sweeps.

use std::collections::BTreeMap;

use reveille_lab::metric_estimate::MetricEstimate;
use reveille_lab::stats::{Moments, student_t_quantile_95};
use reveille_lab::table::ResultRow;

use super::results::RunCondition;

/// A condition and the name of a policy under it.
pub type Series<'r> = (&'r RunCondition, &'r str);

/// The difference of a metric between two policies, or between two conditions of a policy, over their common seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairedDifference {
    /// Number of seeds with a value under both policies, ≥ 1.
    pub seeds: usize,
    /// Mean of the policy over these seeds.
    pub mean: f64,
    /// Mean of the reference policy over these seeds.
    pub reference_mean: f64,
    /// Mean of the policy minus mean of the reference.
    pub difference: f64,
    /// Half the width of the 95 % interval of the difference; NaN for one seed.
    pub half_width: f64,
    /// Whether the interval comes from the differences of pairs. With too few cases it is the sum of the intervals of
    /// both means.
    pub is_paired: bool,
}

impl PairedDifference {
    /// Compares the runs of a policy under a condition with runs of `reference`, both with `n` devices, by `metric`.
    /// Returns `None` without a common seed under which both have a value.
    pub fn new(own: Series<'_>, reference: Series<'_>, n: u32, metric: &str) -> Option<Self> {
        fn by_seed<'r>((condition, policy): Series<'r>, n: u32, metric: &str) -> BTreeMap<u64, &'r ResultRow> {
            let defined = condition.runs(policy, n).filter(|row| row.metric(metric).is_some());
            defined.map(|row| (row.seed, row)).collect()
        }
        let (own_by_seed, theirs_by_seed) = (by_seed(own, n, metric), by_seed(reference, n, metric));
        let common = own_by_seed
            .iter()
            .filter_map(|(seed, row)| Some((*row, *theirs_by_seed.get(seed)?)));
        let (own_rows, their_rows): (Vec<&ResultRow>, Vec<&ResultRow>) = common.unzip();
        let row_pairs = own_rows.iter().zip(&their_rows);
        let pairs: Vec<(f64, f64)> = row_pairs
            .filter_map(|(own, theirs)| Some((own.metric(metric)?, theirs.metric(metric)?)))
            .collect();
        let own = MetricEstimate::from_rows(&own_rows, metric)?;
        let theirs = MetricEstimate::from_rows(&their_rows, metric)?;
        let (difference, half_width) = difference(&own, &theirs, &pairs);
        Some(Self {
            seeds: pairs.len(),
            mean: own.mean_estimate.mean,
            reference_mean: theirs.mean_estimate.mean,
            difference,
            half_width,
            is_paired: paired_half_width(&own, &theirs, &pairs, 1.0).is_some(),
        })
    }
}

/// Returns the difference of two means and half the width of its interval; NaN if that is unknown. Means without
/// usable `pairs` get the sum of both half-widths.
pub(crate) fn difference(own: &MetricEstimate, theirs: &MetricEstimate, pairs: &[(f64, f64)]) -> (f64, f64) {
    let half_width = paired_half_width(own, theirs, pairs, 1.0).unwrap_or(own.half_width() + theirs.half_width());
    (own.mean_estimate.mean - theirs.mean_estimate.mean, half_width)
}

/// Half the interval of the mean of a − `factor` · b over `pairs`; `None` if the cases are too few or there are fewer
/// than two pairs.
pub(crate) fn paired_half_width(
    own: &MetricEstimate,
    theirs: &MetricEstimate,
    pairs: &[(f64, f64)],
    factor: f64,
) -> Option<f64> {
    // With too few cases for an interval, the spread of the differences does not show their frequency.
    let is_rare = |estimate: &MetricEstimate| estimate.upper_bound.is_some() && estimate.case_counts.is_some();
    if pairs.len() < 2 || is_rare(own) || is_rare(theirs) {
        return None;
    }
    let mut moments = Moments::default();
    for (a, b) in pairs {
        moments.add(a - factor * b);
    }
    let deviation = moments.estimate()?.deviation;
    Some(student_t_quantile_95(pairs.len() - 1) * deviation / (pairs.len() as f64).sqrt())
}
