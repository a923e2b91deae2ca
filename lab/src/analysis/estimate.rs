//! A mean over independent runs, and how well it is known.

use statrs::distribution::{ContinuousCDF, StudentsT};

/// A mean over independent runs with its 95 % interval by Student's t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The mean; NaN without runs.
    pub mean: f64,
    /// The standard deviation between runs; NaN with fewer than two.
    pub sd: f64,
    /// Half the width of the 95 % interval of the mean; NaN with fewer than two runs.
    pub half_width: f64,
    /// Runs.
    pub runs: usize,
}

impl Estimate {
    /// The estimate from one value of each run. Values that are NaN (a metric without events) are left out.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let values: Vec<f64> = values.into_iter().filter(|value| !value.is_nan()).collect();
        let runs = values.len();
        let n = runs as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let sd = if runs < 2 {
            f64::NAN
        } else {
            (squares / (n - 1.0)).sqrt()
        };
        Self {
            mean,
            sd,
            half_width: t_975(runs) * sd / n.sqrt(),
            runs,
        }
    }

    /// The ends of the interval.
    pub fn interval(&self) -> (f64, f64) {
        (self.mean - self.half_width, self.mean + self.half_width)
    }

    /// Whether `value` lies in the interval.
    pub fn covers(&self, value: f64) -> bool {
        (value - self.mean).abs() <= self.half_width
    }
}

/// The 97.5 % quantile of Student's t for `runs` values; NaN for fewer than two.
fn t_975(runs: usize) -> f64 {
    let freedom = runs.saturating_sub(1) as f64;
    StudentsT::new(0.0, 1.0, freedom).map_or(f64::NAN, |t| t.inverse_cdf(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_are_those_of_printed_t_tables() {
        for (runs, quantile) in [(2, 12.706), (3, 4.303), (10, 2.262), (31, 2.042), (1001, 1.962)] {
            assert!((t_975(runs) - quantile).abs() < 6e-4, "{runs}: {}", t_975(runs));
        }
        let estimate = Estimate::of([1.0, f64::NAN, 2.0, 3.0]);
        assert_eq!((estimate.mean, estimate.sd, estimate.runs), (2.0, 1.0, 3));
        assert!((estimate.half_width - 4.302_653 / 3.0_f64.sqrt()).abs() < 1e-5);
        assert!(estimate.covers(4.4) && !estimate.covers(4.5));
    }

    #[test]
    fn one_run_tells_nothing_of_the_spread() {
        let estimate = Estimate::of([4.0]);
        assert!(estimate.half_width.is_nan() && !estimate.covers(4.0));
        assert!(Estimate::of([]).mean.is_nan());
    }
}
