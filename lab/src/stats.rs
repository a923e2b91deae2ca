//! Means over the runs of a cell, with Student-t 95 % confidence intervals. Cells with `until_ci` end by them;
//! reports, figures and tuning show them. Values are added in a fixed order, so that results do not depend on threads.

use std::sync::Arc;

use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::table::{ResultRow, SweptValue, Table};

/// The confidence of all intervals and bounds; names and texts say 95 %, and `RULE_OF_THREE` in `metric_estimate.rs`
/// follows from it.
pub(crate) const CONFIDENCE: f64 = 0.95;

/// A mean with its confidence interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The arithmetic mean.
    pub mean: f64,
    /// The sample standard deviation (divisor `runs - 1`); NaN for a single value.
    pub deviation: f64,
    /// Half the width of the 95 % interval, `t · deviation / √runs`; NaN for a single value.
    pub half_width: f64,
    /// The number of averaged values: runs in which the metric is defined.
    pub runs: usize,
}

impl Estimate {
    /// Estimates the mean of `values` and ignores NaN. Returns `None` if no value remains.
    pub fn from_values(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut moments = Moments::default();
        values.into_iter().for_each(|value| moments.add(value));
        moments.estimate()
    }

    /// Estimates the mean of `values` and ignores NaN. All fields are NaN if no value remains.
    pub fn from_values_or_nan(values: impl IntoIterator<Item = f64>) -> Self {
        Self::from_values(values).unwrap_or(Self {
            mean: f64::NAN,
            deviation: f64::NAN,
            half_width: f64::NAN,
            runs: 0,
        })
    }

    /// The limits of the interval.
    pub fn interval(&self) -> (f64, f64) {
        (self.mean - self.half_width, self.mean + self.half_width)
    }

    /// Whether `value` lies in the interval.
    pub fn covers(&self, value: f64) -> bool {
        (value - self.mean).abs() <= self.half_width
    }

    /// The half-width over the magnitude of the mean: 0 if all values are equal, infinite if it is unknown. It is
    /// unknown for a mean of 0, because runs without a miss do not show how rare misses are.
    pub fn relative_half_width(&self) -> f64 {
        if self.half_width.is_nan() || self.mean == 0.0 {
            f64::INFINITY
        } else {
            self.half_width / self.mean.abs()
        }
    }
}

/// Running mean and sum of squared differences (Welford), for values in a fixed order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    /// The number of values, one for each run.
    runs: usize,
    mean: f64,
    squared_differences: f64,
}

impl Moments {
    /// Adds `value`, unless it is NaN.
    pub fn add(&mut self, value: f64) {
        if value.is_nan() {
            return;
        }
        self.runs += 1;
        // Welford's update: the difference of Σx² and (Σx)² would lose the digits of small variances.
        let difference = value - self.mean;
        self.mean += difference / self.runs as f64;
        self.squared_differences += difference * (value - self.mean);
    }

    /// The estimate so far; `None` before the first value.
    pub fn estimate(&self) -> Option<Estimate> {
        if self.runs == 0 {
            return None;
        }
        let degrees_of_freedom = (self.runs - 1) as f64;
        let deviation = if self.runs == 1 {
            f64::NAN
        } else {
            (self.squared_differences / degrees_of_freedom).sqrt()
        };
        Some(Estimate {
            mean: self.mean,
            deviation,
            half_width: student_t_quantile_95(self.runs - 1) * deviation / (self.runs as f64).sqrt(),
            runs: self.runs,
        })
    }
}

/// Half the width of the 95 % interval of a ratio Σa/Σb, from the sums `(a, b)` of parts of one run, such as batches of
/// TTIs (ratio estimator, Student's t). `None` for fewer than two parts or Σb = 0.
pub fn ratio_half_width(parts: &[(f64, f64)]) -> Option<f64> {
    let count = parts.len();
    let (sum_a, sum_b) = parts
        .iter()
        .fold((0.0, 0.0), |(sum_a, sum_b), (a, b)| (sum_a + a, sum_b + b));
    if count < 2 || sum_b == 0.0 {
        return None;
    }
    let ratio = sum_a / sum_b;
    let squares: f64 = parts.iter().map(|(a, b)| (a - ratio * b).powi(2)).sum();
    let residual_deviation = (squares / (count - 1) as f64).sqrt();
    Some(student_t_quantile_95(count - 1) * residual_deviation * (count as f64).sqrt() / sum_b.abs())
}

/// The two-sided 95 % quantile of Student's t with these degrees of freedom; NaN for none.
pub fn student_t_quantile_95(degrees_of_freedom: usize) -> f64 {
    // Two-sided: 2.5 % lie above the interval, so the quantile is taken at 0.975.
    StudentsT::new(0.0, 1.0, degrees_of_freedom as f64)
        .map_or(f64::NAN, |t| t.inverse_cdf(f64::midpoint(1.0, CONFIDENCE)))
}

/// The runs of one cell: equal in everything but the seed.
#[derive(Clone, Debug)]
pub struct CellRuns<'t> {
    /// The preset.
    pub preset: &'t str,
    /// The policy.
    pub policy: &'t str,
    /// The number of devices N.
    pub n: u32,
    /// The length of the runs K, TTIs.
    pub ttis: u64,
    /// The swept values, in the order of the table's schema.
    pub swept: Arc<[SweptValue]>,
    /// The runs, in the order of the table.
    pub rows: Vec<&'t ResultRow>,
}

impl CellRuns<'_> {
    /// Estimates a metric over the runs in which it is defined. Returns `None` without such a metric or run.
    pub fn estimate(&self, metric: &str) -> Option<Estimate> {
        Estimate::from_values(self.rows.iter().filter_map(|row| row.metric(metric)))
    }

    /// Returns whether `row` is a run of this cell. A new field that distinguishes cells belongs here and in
    /// `SeriesNames::distinct_cells`.
    fn matches(&self, row: &ResultRow) -> bool {
        self.policy == &*row.policy
            && self.n == row.n
            && self.preset == &*row.preset
            && self.ttis == row.ttis
            && self.swept == row.swept
    }
}

/// Groups the rows of `table` by cell, in the order of their first rows.
pub fn group_by_cell(table: &Table) -> Vec<CellRuns<'_>> {
    let mut cells: Vec<CellRuns<'_>> = Vec::new();
    for row in &table.rows {
        // Tables are sorted by cell, so the search from the end nearly always succeeds with the first comparison.
        match cells.iter_mut().rev().find(|cell| cell.matches(row)) {
            Some(cell) => cell.rows.push(row),
            None => cells.push(CellRuns {
                preset: &row.preset,
                policy: &row.policy,
                n: row.n,
                ttis: row.ttis,
                swept: Arc::clone(&row.swept),
                rows: vec![row],
            }),
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::fixtures;

    /// Two-sided 95 % quantiles of Student's t from printed tables, by degrees of freedom.
    const PRINTED_QUANTILES: [(usize, f64); 6] = [
        (1, 12.706),
        (2, 4.303),
        (9, 2.262),
        (29, 2.045),
        (99, 1.984),
        (999, 1.962),
    ];

    #[test]
    fn quantiles_equal_printed_tables() {
        for (degrees_of_freedom, printed) in PRINTED_QUANTILES {
            let quantile = student_t_quantile_95(degrees_of_freedom);
            // Half of the last printed digit, and a little more for its rounding.
            assert!(
                (quantile - printed).abs() < 6e-4,
                "{degrees_of_freedom} degrees of freedom: {quantile}, table {printed}"
            );
        }
        assert!(student_t_quantile_95(0).is_nan());
    }

    #[test]
    fn an_estimate_equals_a_calculation_by_hand() {
        // Mean 5, squared differences 9+1+1+1+0+0+4+16 = 32, so the variance is 32/7; t(7) = 2.3646.
        let estimate = Estimate::from_values([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]).expect("values");
        let deviation = (32.0f64 / 7.0).sqrt();
        assert!((estimate.mean - 5.0).abs() < 1e-12 && (estimate.deviation - deviation).abs() < 1e-12);
        assert!((estimate.half_width - 2.364_624_25 * deviation / 8f64.sqrt()).abs() < 1e-7);
        assert!((estimate.relative_half_width() - estimate.half_width / 5.0).abs() < 1e-15);
        assert_eq!(estimate.runs, 8);
    }

    #[test]
    fn undefined_values_are_left_out() {
        assert_eq!(Estimate::from_values([f64::NAN, f64::NAN]), None);
        let one = Estimate::from_values([3.0, f64::NAN]).expect("one value");
        assert_eq!((one.mean, one.runs), (3.0, 1));
        assert!(one.half_width.is_nan() && one.relative_half_width().is_infinite());
        let equal = Estimate::from_values([2.0, 2.0, 2.0]).expect("values");
        assert!(equal.relative_half_width() == 0.0, "equal values");
        let zeros = Estimate::from_values([0.0, 0.0, 0.0]).expect("values");
        assert!(
            zeros.relative_half_width().is_infinite(),
            "no relative width of a mean of 0"
        );
    }

    #[test]
    fn an_interval_has_its_half_width_on_both_sides() {
        let estimate = Estimate::from_values_or_nan([1.0, f64::NAN, 2.0, 3.0]);
        // t(2) times the deviation of 1.
        let half_width = 4.302_653 / 3.0_f64.sqrt();
        let (low, high) = estimate.interval();
        assert!((low - (2.0 - half_width)).abs() < 1e-5 && (high - (2.0 + half_width)).abs() < 1e-5);
        assert!(estimate.covers(4.4) && !estimate.covers(4.5));
        assert!(Estimate::from_values_or_nan([]).mean.is_nan() && !Estimate::from_values_or_nan([4.0]).covers(4.0));
    }

    #[test]
    fn a_cell_groups_runs_that_differ_only_in_the_seed() {
        let table = fixtures::table();
        let cells = group_by_cell(&table);
        let counts: Vec<(&str, u32, usize)> = cells
            .iter()
            .map(|cell| (cell.policy, cell.n, cell.rows.len()))
            .collect();
        assert_eq!(counts, [("knn", 10, 2), ("knn", 50, 2), ("random", 10, 1)]);
        let estimate = cells[0].estimate("info_p1").expect("defined");
        assert_eq!((estimate.mean, estimate.runs), (1.5, 2));
        assert_eq!(cells[0].estimate("info_per_event"), None, "undefined in both runs");
        assert_eq!(cells[0].estimate("colour"), None);
        assert!(cells[1].estimate("events").is_some());
    }
}
