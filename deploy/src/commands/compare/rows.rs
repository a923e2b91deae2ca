//! Rows of paired differences between policies (`sweep`) or tables (`tables`), as text by metric and as JSON. Programs
//! of users read the keys of the JSON. `docs/reading-results.md` shows the text.

use std::fmt::Write as _;

use reveille_common::digits::decimals_for;
use reveille_common::score::Metrics;
use reveille_study::figures::paired::PairedDifference;
use serde_json::{Value, json};

use crate::display::{WIDTH, wrap_text};
use crate::results_table::format_number;

/// The difference of a policy from the reference policy, or from itself in the reference table.
pub(super) struct DifferenceRow<'r> {
    /// Name of the metric in result tables.
    pub metric: &'r str,
    /// Name of the policy in figures.
    pub policy: &'r str,
    /// Number of devices N of both.
    pub n: u32,
    /// The means and their difference.
    pub comparison: PairedDifference,
}

impl DifferenceRow<'_> {
    pub(super) fn to_json(&self) -> Value {
        let comparison = self.comparison;
        json!({
            "metric": self.metric, "policy": self.policy, "n": self.n, "seeds": comparison.seeds,
            "mean": comparison.compared_mean, "against_mean": comparison.reference_mean,
            "difference": comparison.difference, "half_width": comparison.half_width,
            "share_half_width": comparison.share_half_width, "paired": comparison.is_paired,
        })
    }
}

/// Formats differences by metric; rows of the same metric must be next to each other. `reference` names the column of
/// the reference's means. `sweep` explains the marks `~` and `–` below the last block.
pub(super) fn format_blocks(reference: &str, rows: &[DifferenceRow<'_>]) -> String {
    let blocks = rows.chunk_by(|a, b| a.metric == b.metric);
    blocks.map(|block| format_block(reference, block)).collect()
}

/// Formats `x` with its sign; without one if it rounds to zero.
fn format_signed(x: f64, decimals: usize) -> String {
    let text = format!("{x:+.decimals$}");
    let is_zero = !text.contains(|c: char| matches!(c, '1'..='9'));
    text[usize::from(is_zero)..].to_owned()
}

/// Formats the difference as a percentage of the reference mean, with its interval, in parentheses; empty below 0.05 %
/// and from 1000 % on.
fn format_share(comparison: &PairedDifference) -> String {
    let percent = 100.0 * comparison.difference / comparison.reference_mean.abs();
    if !percent.is_finite() || !(0.05..1000.0).contains(&percent.abs()) {
        return String::new();
    }
    let half_width = 100.0 * comparison.share_half_width;
    if half_width.is_finite() && half_width > 0.0 {
        let digits = decimals_for(half_width, 2);
        format!(" ({percent:+.digits$} ±{half_width:.digits$} %)")
    } else {
        format!(" ({percent:+.1} %)")
    }
}

/// Formats the differences by one metric; `rows` is not empty.
fn format_block(reference: &str, rows: &[DifferenceRow<'_>]) -> String {
    let metric = rows[0].metric;
    let unit = Metrics::find(metric).map_or("", |metric| metric.unit);
    // Of a metric in per cent, the difference is in points, and only the share of the reference in per cent.
    let points = if unit.starts_with('%') { " points" } else { "" };
    let policy_width = rows
        .iter()
        .map(|row| row.policy.chars().count())
        .max()
        .unwrap_or(0)
        .max(6);
    let mut text = format!("\n{}\n", wrap_text(&format!("{metric}, {unit}"), WIDTH));
    // A long name of the reference would move the columns.
    let reference = if reference.chars().count() <= 10 {
        reference
    } else {
        "reference"
    };
    let _infallible = writeln!(
        text,
        "{:<policy_width$} {:>5} {:>5} {:>10} {:>10}   difference and interval",
        "policy", "N", "seeds", "mean", reference
    );
    for DifferenceRow {
        policy, n, comparison, ..
    } in rows
    {
        let PairedDifference {
            difference, half_width, ..
        } = *comparison;
        let mark = if comparison.is_paired || half_width.is_nan() {
            ' '
        } else {
            '~'
        };
        let change = if half_width.is_finite() {
            // Two significant digits of the uncertainty; an interval of width 0 leaves four of the difference.
            let digits = if half_width > 0.0 {
                decimals_for(half_width, 2)
            } else {
                decimals_for(difference, 4)
            };
            format!("{} ±{half_width:.digits$}", format_signed(difference, digits))
        } else {
            format!("{} –", format_signed(difference, 4))
        };
        let _infallible = writeln!(
            text,
            "{policy:<policy_width$} {n:>5} {:>5} {:>10} {:>10} {mark} {change}{points}{}",
            comparison.seeds,
            format_number(comparison.compared_mean),
            format_number(comparison.reference_mean),
            format_share(comparison),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_refers_to_the_size_of_the_reference() {
        let share = |difference, reference_mean, share_half_width| {
            format_share(&PairedDifference {
                seeds: 5,
                compared_mean: reference_mean + difference,
                reference_mean,
                difference,
                half_width: 0.1,
                share_half_width,
                is_paired: true,
            })
        };
        assert_eq!(share(-1.0, 8.0, 0.0123), " (-12.5 ±1.2 %)");
        assert_eq!(share(1.0, -4.0, f64::NAN), " (+25.0 %)");
        assert_eq!(share(1.0, 0.0, f64::NAN), "");
        assert_eq!(share(0.0001, 8.0, 0.1), "");
    }

    #[test]
    fn a_difference_that_rounds_to_zero_has_no_sign() {
        assert_eq!(format_signed(-0.4, 0), "0");
        assert_eq!(format_signed(0.004, 2), "0.00");
        assert_eq!(format_signed(-0.006, 2), "-0.01");
        assert_eq!(format_signed(12.0, 0), "+12");
    }
}
