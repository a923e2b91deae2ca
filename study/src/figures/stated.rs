//! Statements of the paper about the drawn policies, as marks and hatched ranges.

use super::chart::{Series, StatedMark, StatedSpan, StatedValue, spread};
use super::style::Style;
use crate::claims::{Claim, ClaimQuantity, DeviceCounts, Statement};

/// Returns marks for the statements in `claims` about drawn policies at one N.
pub(super) fn marks(claims: &[Claim], series: &[Series]) -> Vec<StatedMark> {
    let drawn = claims.iter().filter(|c| series.iter().any(|s| s.name == c.policy));
    let mut marks: Vec<StatedMark> = drawn.filter_map(|claim| mark(claim, claims)).collect();
    marks.sort_by(|a, b| a.x.total_cmp(&b.x));
    spread(&mut marks);
    marks
}

/// Returns the mark for `claim`, one of `claims`; `None` if it does not refer to a single N.
fn mark(claim: &Claim, claims: &[Claim]) -> Option<StatedMark> {
    let DeviceCounts::At(n) = claim.sites else { return None };
    Some(StatedMark {
        x: f64::from(n),
        aside: 0.0,
        stated: stated_value(claim, claims)?,
        style: Style::of_policy(claim.policy),
    })
}

/// Returns hatched ranges for the statements in `claims` about several N, limited to the range of N that was run.
pub(super) fn spans(claims: &[Claim], series: &[Series]) -> Vec<StatedSpan> {
    let xs = || series.iter().flat_map(|s| &s.samples).map(|s| s.x);
    let (least, largest) = (xs().fold(f64::INFINITY, f64::min), xs().fold(0.0, f64::max));
    let span = |claim: &Claim| {
        let (from, to) = claim.sites.ends();
        let own = series.iter().find(|s| s.name == claim.policy)?;
        Some(StatedSpan {
            from: least.max(f64::from(from)),
            to: largest.min(f64::from(to)),
            stated: stated_value(claim, claims)?,
            paint: own.style.paint,
        })
    };
    let spans = claims.iter().filter_map(span);
    spans.filter(|span| span.from < span.to).collect()
}

/// Returns the value that `claim`, one of `claims`, states for the metric itself. A ratio to one other policy is
/// multiplied by the value stated for that policy.
pub(super) fn stated_value(claim: &Claim, claims: &[Claim]) -> Option<StatedValue> {
    let times = |factor: f64, statement: Statement| match statement {
        Statement::About(v) => Some(StatedValue::Value(factor * v)),
        Statement::Between(low, high) => Some(StatedValue::Range(factor * low, factor * high)),
        Statement::Below(v) => Some(StatedValue::Below(factor * v)),
        Statement::Above(v) => Some(StatedValue::Above(factor * v)),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Level | Statement::Falls | Statement::Rises => None,
    };
    match (claim.quantity, claim.statement) {
        (ClaimQuantity::Own, statement) => times(1.0, statement),
        (ClaimQuantity::Ratio([other]), Statement::About(factor)) => {
            let is_base = |c: &&Claim| c.policy == *other && c.sites == claim.sites && c.quantity == ClaimQuantity::Own;
            let base = claims.iter().find(is_base)?;
            match base.statement {
                Statement::About(_) | Statement::Between(..) => times(factor, base.statement),
                Statement::Below(_)
                | Statement::Above(_)
                | Statement::Largest(_)
                | Statement::Smallest(_)
                | Statement::Level
                | Statement::Falls
                | Statement::Rises => None,
            }
        }
        (ClaimQuantity::Ratio(_) | ClaimQuantity::Gap(_) | ClaimQuantity::Growth(_), _) => None,
    }
}
