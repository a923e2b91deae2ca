//! Estimates of a metric from the runs of a cell: a mean with its interval, or a one-sided bound if cases are few. The
//! claim report (docs/reproduction.md), the figures and the report of `reveille sweep` show these estimates, so a
//! change of a rule changes committed numbers. `CASE_METRICS` lists metrics by name: a renamed metric would lose its
//! bound.
//!
//! Student's t derives the interval of a mean from the spread of the runs. With very few cases that interval is too
//! narrow (runs without a case do not differ) or extends below zero. An upper bound is then the only valid result.

use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::stats::{CONFIDENCE, CellRuns, Estimate};
use crate::table::ResultRow;
use reveille_common::score::Metrics;

/// The metrics that count cases per event, by their names in `Metrics::NAMES`, with their value for one case per event.
const CASE_METRICS: [(&str, f64); 3] = [
    ("misdetection_pct", 100.0),
    ("wrong_activations_per_event", 1.0),
    ("wake_ups_per_event", 1.0),
];
/// The metric in `CASE_METRICS` that is a share of events, %.
const SHARE_METRIC: &str = "misdetection_pct";
/// The rule of three: without a case among n, 3/n is the 95 % upper bound. Another `CONFIDENCE` needs another number.
const RULE_OF_THREE: f64 = 3.0;
/// The largest number of cases for which a cell of one run, which has no interval, gets a bound. `reveille compare`
/// prints no interval of such a run.
pub const MAX_FEW_CASES_OF_ONE_RUN: u64 = 9;

/// The value of a metric for one case per event, if it counts cases per event.
#[must_use]
pub fn value_per_case(metric: &str) -> Option<f64> {
    let case_metric = CASE_METRICS.iter().find(|(name, _)| *name == metric);
    case_metric.map(|(_, value_per_case)| *value_per_case)
}

/// Counts of cases and events.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CaseCounts {
    /// The number of cases in all runs.
    pub cases: u64,
    /// The number of events in all runs.
    pub events: u64,
}

/// An estimate of a metric from runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MetricEstimate {
    /// The mean with its interval, also where a bound replaces the interval.
    pub mean_estimate: Estimate,
    /// The cases, if the metric counts cases per event.
    pub case_counts: Option<CaseCounts>,
    /// The one-sided 95 % upper bound, if it replaces the interval.
    pub upper_bound: Option<f64>,
    /// The one-sided 95 % lower bound, if all events were cases.
    pub lower_bound: Option<f64>,
}

impl MetricEstimate {
    /// Estimates `metric` from `rows`, the runs of one cell. Returns `None` if no row has a value.
    pub fn from_rows(rows: &[&ResultRow], metric: &str) -> Option<Self> {
        let defined_values = || rows.iter().filter_map(|row| Some((row, row.metric(metric)?)));
        let mean_estimate = Estimate::from_values(defined_values().map(|(_, value)| value))?;
        let value_per_case = value_per_case(metric);
        let case_counts = value_per_case.map(|value_per_case| CaseCounts {
            cases: defined_values()
                // The metric is a ratio of whole numbers: rounding removes the error of the division.
                .map(|(row, value)| (value * row.events as f64 / value_per_case).round() as u64)
                .sum(),
            events: defined_values().map(|(row, _)| row.events).sum(),
        });
        let count_bound = value_per_case
            .zip(case_counts)
            .map(|(value_per_case, counts)| value_per_case * counts.upper_bound_per_event());
        // A difference may be negative, so an interval across zero does not indicate few cases.
        let is_difference = Metrics::find(metric).is_some_and(|metric| metric.is_difference);
        Some(Self {
            mean_estimate,
            case_counts,
            upper_bound: bound_replacing_interval(mean_estimate, case_counts, count_bound).filter(|_| !is_difference),
            lower_bound: case_counts
                .filter(|_| metric == SHARE_METRIC)
                .and_then(CaseCounts::lower_bound_pct),
        })
    }

    /// Returns the 95 % limits of a metric that cannot be negative: of the interval, cut off at 0, or the bound and the
    /// end of the range; zero and infinity if they are unknown.
    pub fn limits(&self) -> (f64, f64) {
        let Estimate { mean, half_width, .. } = self.mean_estimate;
        match (self.upper_bound, self.lower_bound) {
            (Some(upper), _) => (0.0, upper),
            (None, Some(lower)) => (lower, mean),
            (None, None) if half_width.is_nan() => (0.0, f64::INFINITY),
            (None, None) => ((mean - half_width).max(0.0), mean + half_width),
        }
    }

    /// Returns the distance from the mean to its limit: half the interval, or to the bound. NaN if it is unknown.
    pub fn half_width(&self) -> f64 {
        let bound = self.upper_bound.or(self.lower_bound);
        bound.map_or(self.mean_estimate.half_width, |bound| {
            (bound - self.mean_estimate.mean).abs()
        })
    }

    /// Returns the estimate of the metric divided by `divisor`, above 0.
    #[must_use]
    pub fn divided_by(self, divisor: f64) -> Self {
        let Estimate {
            mean,
            deviation,
            half_width,
            runs,
        } = self.mean_estimate;
        Self {
            mean_estimate: Estimate {
                mean: mean / divisor,
                deviation: deviation / divisor,
                half_width: half_width / divisor,
                runs,
            },
            upper_bound: self.upper_bound.map(|upper| upper / divisor),
            lower_bound: self.lower_bound.map(|lower| lower / divisor),
            ..self
        }
    }
}

impl CaseCounts {
    /// Returns the one-sided 95 % upper bound on cases per event, for Poisson counts (Garwood).
    fn upper_bound_per_event(self) -> f64 {
        let Self { cases, events } = self;
        let bound = if cases == 0 {
            RULE_OF_THREE
        } else {
            let chi_squared = ChiSquared::new(2.0 * cases as f64 + 2.0);
            chi_squared.map_or(f64::INFINITY, |law| 0.5 * law.inverse_cdf(CONFIDENCE))
        };
        bound / events as f64
    }

    /// Returns the one-sided 95 % lower bound on the share of events with a case, %, if all events have one.
    fn lower_bound_pct(self) -> Option<f64> {
        let is_all = self.events > 0 && self.cases == self.events;
        is_all.then(|| (100.0 * (1.0 - RULE_OF_THREE / self.events as f64)).max(0.0))
    }
}

/// Returns the one-sided bound on a mean whose interval is not usable; `None` if the interval is usable. `count_bound`
/// follows from the number of cases.
fn bound_replacing_interval(
    estimate: Estimate,
    case_counts: Option<CaseCounts>,
    count_bound: Option<f64>,
) -> Option<f64> {
    let Estimate { mean, half_width, .. } = estimate;
    let case_counts = case_counts.filter(|counts| counts.events > 0);
    match case_counts {
        Some(CaseCounts { cases: 0, .. }) => count_bound,
        Some(CaseCounts {
            cases: 1..=MAX_FEW_CASES_OF_ONE_RUN,
            ..
        }) if half_width.is_nan() => count_bound,
        // Clustered cases scatter more than Poisson's law. The spread of the runs shows it, so the wider bound counts.
        _ if mean > 0.0 && half_width >= mean => {
            let interval_bound = mean + half_width;
            let count_bound = case_counts.and(count_bound);
            Some(count_bound.map_or(interval_bound, |bound| bound.max(interval_bound)))
        }
        Some(_) | None => None,
    }
}

impl CellRuns<'_> {
    /// Estimates a metric from the runs of the cell. Returns `None` without such a metric or run.
    pub fn metric_estimate(&self, metric: &str) -> Option<MetricEstimate> {
        MetricEstimate::from_rows(&self.rows, metric)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stats::group_by_cell;
    use crate::table::fixtures;

    /// Estimates `metric` from runs with these values and 1000 events each.
    fn estimate_of(metric: &str, values: &[f64]) -> MetricEstimate {
        let index = Metrics::NAMES
            .iter()
            .position(|name| *name == metric)
            .expect("a metric");
        let template = fixtures::table().rows.remove(0);
        let row = |value: &f64| {
            let mut row = template.clone();
            row.metrics[index] = *value;
            row.events = 1000;
            row
        };
        let rows: Vec<ResultRow> = values.iter().map(row).collect();
        let rows: Vec<&ResultRow> = rows.iter().collect();
        MetricEstimate::from_rows(&rows, metric).expect("values")
    }

    #[test]
    fn bounds_on_counts_equal_printed_tables() {
        // One-sided 95 % limits of a Poisson mean.
        for (cases, printed) in [(1, 4.744), (2, 6.296), (3, 7.754), (10, 16.962)] {
            let bound = CaseCounts { cases, events: 1000 }.upper_bound_per_event() * 1000.0;
            assert!(
                (bound - printed).abs() < 6e-4,
                "{cases} cases: bound {bound}, table {printed}"
            );
        }
        let none = CaseCounts { cases: 0, events: 600 };
        assert!(
            (none.upper_bound_per_event() - 0.005).abs() < 1e-12,
            "3 divided by the number of events: the rule of three"
        );
    }

    #[test]
    fn no_case_gives_a_bound_instead_of_an_interval_of_width_0() {
        let none = estimate_of("misdetection_pct", &[0.0, 0.0, 0.0]);
        assert_eq!(none.case_counts, Some(CaseCounts { cases: 0, events: 3000 }));
        assert_eq!((none.upper_bound, none.limits()), (Some(0.1), (0.0, 0.1)));
        assert!((none.half_width() - 0.1).abs() < 1e-15);
        let one_run = estimate_of("wrong_activations_per_event", &[0.0]);
        assert_eq!(one_run.upper_bound, Some(0.003));
        let uncounted = estimate_of("low_energy_pct", &[0.0, 0.0]);
        assert_eq!(
            (uncounted.upper_bound, uncounted.half_width()),
            (None, 0.0),
            "the metric counts no cases"
        );
    }

    #[test]
    fn a_share_of_100_percent_has_a_lower_bound() {
        let all = estimate_of("misdetection_pct", &[100.0, 100.0]);
        let (lower, mean) = all.limits();
        assert!(all.upper_bound.is_none() && all.lower_bound == Some(lower));
        assert!((lower - 99.85).abs() < 1e-9 && (mean - 100.0).abs() < 1e-12, "{all:?}");
        assert!((all.half_width() - 0.15).abs() < 1e-9);
        let one_per_event = estimate_of("wake_ups_per_event", &[1.0, 1.0]);
        assert_eq!(one_per_event.lower_bound, None, "an event can have several");
    }

    #[test]
    fn few_cases_give_the_wider_of_two_bounds() {
        // All cases in one run: 0, 0 and 4 of 1000 have mean 4/30 % and deviation 0.23094; t(2) = 4.302653.
        let few = estimate_of("misdetection_pct", &[0.0, 0.0, 0.4]);
        assert_eq!(few.case_counts, Some(CaseCounts { cases: 4, events: 3000 }));
        let bound_of_runs = 0.4 / 3.0 + 4.302_653 * 0.4 / 3.0;
        assert!(
            (few.upper_bound.expect("a bound") - bound_of_runs).abs() < 1e-6,
            "{few:?}"
        );
        // 1 of 1000 in each of 2 of 300 runs: the bound of the count is the wider one.
        let mut rare = vec![0.0; 298];
        rare.extend([0.1, 0.1]);
        let rare = estimate_of("misdetection_pct", &rare);
        assert!(
            (rare.upper_bound.expect("a bound") - 100.0 * 6.296 / 300_000.0).abs() < 1e-6,
            "{rare:?}"
        );
        let one_run = estimate_of("misdetection_pct", &[0.3]);
        assert!((one_run.upper_bound.expect("a bound") - 100.0 * 7.754 / 1000.0).abs() < 1e-4);
        assert_eq!(one_run.limits().0.to_bits(), 0.0_f64.to_bits());
    }

    #[test]
    fn an_interval_above_0_is_not_changed() {
        let many_cases = estimate_of("misdetection_pct", &[30.0, 31.0, 32.0]);
        assert_eq!(many_cases.upper_bound, None);
        assert_eq!(many_cases.limits(), many_cases.mean_estimate.interval());
        let one_run = estimate_of("misdetection_pct", &[33.0]);
        assert_eq!((one_run.upper_bound, one_run.limits()), (None, (0.0, f64::INFINITY)));
        let difference = estimate_of("net_per_device_tti", &[0.01, -0.01, 0.02]);
        assert_eq!(difference.upper_bound, None, "a difference may be negative");
        let wide = estimate_of("low_energy_pct", &[0.0, 0.03]);
        assert!((wide.upper_bound.expect("a bound") - (0.015 + 12.706_205 * 0.015)).abs() < 1e-6);
    }

    #[test]
    fn an_estimate_is_divided_with_its_bounds() {
        let wasted = estimate_of("wasted_energy_per_event", &[10.0, 12.0]).divided_by(4.0);
        assert!((wasted.mean_estimate.mean - 2.75).abs() < 1e-12);
        assert!((wasted.half_width() - 12.706_205 / 4.0).abs() < 1e-5);
        let rare = estimate_of("wasted_energy_per_event", &[0.0, 2.0]);
        assert_eq!(
            rare.divided_by(2.0).upper_bound,
            rare.upper_bound.map(|upper| upper / 2.0)
        );
    }

    #[test]
    fn a_cell_estimates_metrics_from_its_runs() {
        let table = fixtures::table();
        let cells = group_by_cell(&table);
        assert_eq!(
            cells[0].metric_estimate("info_per_event"),
            None,
            "undefined in both runs"
        );
        assert_eq!(
            cells[0]
                .metric_estimate("info_p1")
                .map(|estimate| estimate.mean_estimate.runs),
            Some(2)
        );
    }
}
