//! Rows of paired differences between policies or tables, as text by metric.

use std::fmt::Write as _;

use reveille_common::digits::decimals_for;
use reveille_common::score::Metrics;
use reveille_study::figures::paired::PairedDifference;

use crate::display::{WIDTH, wrap_text};
use crate::results_table::format_number;

/// The difference of a policy from the reference policy or the reference table.
pub(super) struct Row<'r> {
    pub metric: &'r str,
    pub policy: &'r str,
    pub n: u32,
    pub found: PairedDifference,
}

/// Formats differences by metric. `reference` names the column of the reference's means.
pub(super) fn format_blocks(reference: &str, rows: &[Row<'_>]) -> String {
    let blocks = rows.chunk_by(|a, b| a.metric == b.metric);
    blocks.map(|block| format_block(reference, block)).collect()
}

/// Formats `x` with its sign; without one if it rounds to zero.
fn format_signed(x: f64, decimals: usize) -> String {
    let text = format!("{x:+.decimals$}");
    let is_zero = !text.contains(|c: char| matches!(c, '1'..='9'));
    text[usize::from(is_zero)..].to_owned()
}

/// Formats the differences by one metric; `rows` is not empty.
fn format_block(reference: &str, rows: &[Row<'_>]) -> String {
    let metric = rows[0].metric;
    let unit = Metrics::find(metric).map_or("", |metric| metric.unit);
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
    for Row { policy, n, found, .. } in rows {
        let PairedDifference {
            difference, half_width, ..
        } = *found;
        let mark = if found.is_paired || half_width.is_nan() {
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
            "{policy:<policy_width$} {n:>5} {:>5} {:>10} {:>10} {mark} {change}",
            found.seeds,
            format_number(found.compared_mean),
            format_number(found.reference_mean),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_that_rounds_to_zero_has_no_sign() {
        assert_eq!(format_signed(-0.4, 0), "0");
        assert_eq!(format_signed(0.004, 2), "0.00");
        assert_eq!(format_signed(-0.006, 2), "-0.01");
        assert_eq!(format_signed(12.0, 0), "+12");
    }
}
