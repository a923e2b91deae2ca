//! Statements of the paper about the drawn policies, as marks (one N) and hatched ranges (several N) of a chart, for
//! the figures `study` and `pareto`. A claim is drawn with the series that has the name of its policy; a series with
//! another ranking has another name. In every function `claims` are all claims about the drawn metric, since a ratio
//! refers to another of them. Ranges end at the smallest and the largest N that were run; marks do not depend on the
//! runs.

use super::chart::{Series, StatedMark, StatedSpan, StatedValue, separate_overlapping};
use super::style::Style;
use crate::claims::{Claim, ClaimQuantity, DeviceCounts, Statement};

/// Returns marks for the statements in `claims` about drawn policies at one N.
pub(super) fn stated_marks(claims: &[Claim], series: &[Series]) -> Vec<StatedMark> {
    let drawn = claims.iter().filter(|c| series.iter().any(|s| s.name == c.policy));
    let mut marks: Vec<StatedMark> = drawn.filter_map(|claim| stated_mark(claim, claims)).collect();
    // `separate_overlapping` moves neighbours apart.
    marks.sort_by(|a, b| a.x.total_cmp(&b.x));
    separate_overlapping(&mut marks);
    marks
}

/// Returns the mark for `claim`, one of `claims`; `None` if it does not refer to a single N.
fn stated_mark(claim: &Claim, claims: &[Claim]) -> Option<StatedMark> {
    let DeviceCounts::At(n) = claim.device_counts else {
        return None;
    };
    Some(StatedMark {
        x: f64::from(n),
        x_offset: 0.0,
        stated: stated_value(claim, claims)?,
        style: Style::of_policy(claim.policy),
    })
}

/// Returns hatched ranges for the statements in `claims` about several N, limited to the range of N that was run.
pub(super) fn stated_spans(claims: &[Claim], series: &[Series]) -> Vec<StatedSpan> {
    let ns = || series.iter().flat_map(|s| &s.points).map(|p| p.x);
    let (smallest_n, largest_n) = (ns().fold(f64::INFINITY, f64::min), ns().fold(0.0, f64::max));
    let span = |claim: &Claim| {
        let (from, to) = claim.device_counts.range();
        let line = series.iter().find(|s| s.name == claim.policy)?;
        Some(StatedSpan {
            from: smallest_n.max(f64::from(from)),
            to: largest_n.min(f64::from(to)),
            stated: stated_value(claim, claims)?,
            paint: line.style.paint,
        })
    };
    // Claims at one N have equal ends: `stated_marks` draws them. A claim of which a single N was run is not drawn.
    let spans = claims.iter().filter_map(span);
    spans.filter(|span| span.from < span.to).collect()
}

/// Returns the value that `claim`, one of `claims`, states for the metric itself. A ratio to one other policy is
/// multiplied by the value stated for that policy. `None` for trends, constant levels, extremes, gaps and growth. For a
/// ratio also `None` if it is not stated as one number, if it refers to several policies, or if no value or range is
/// stated for the other policy at the same N.
pub(super) fn stated_value(claim: &Claim, claims: &[Claim]) -> Option<StatedValue> {
    let scaled = |factor: f64, statement: Statement| match statement {
        Statement::About(v) => Some(StatedValue::Value(factor * v)),
        Statement::Between(low, high) => Some(StatedValue::Range(factor * low, factor * high)),
        Statement::Below(v) => Some(StatedValue::Below(factor * v)),
        Statement::Above(v) => Some(StatedValue::Above(factor * v)),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Constant | Statement::Falls | Statement::Rises => {
            None
        }
    };
    match (claim.quantity, claim.statement) {
        (ClaimQuantity::Mean, statement) => scaled(1.0, statement),
        (ClaimQuantity::Ratio([other]), Statement::About(factor)) => {
            let is_base = |c: &&Claim| {
                c.policy == *other && c.device_counts == claim.device_counts && c.quantity == ClaimQuantity::Mean
            };
            let base = claims.iter().find(is_base)?;
            match base.statement {
                Statement::About(_) | Statement::Between(..) => scaled(factor, base.statement),
                Statement::Below(_)
                | Statement::Above(_)
                | Statement::Largest(_)
                | Statement::Smallest(_)
                | Statement::Constant
                | Statement::Falls
                | Statement::Rises => None,
            }
        }
        (ClaimQuantity::Ratio(_) | ClaimQuantity::Gap(_) | ClaimQuantity::Growth(_), _) => None,
    }
}
