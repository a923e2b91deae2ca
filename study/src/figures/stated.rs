//! What the paper states of the policies that a figure draws, as marks and hatched ranges.

use super::chart::{Mark, Series, Span, Stated, spread};
use super::style::Style;
use crate::claims::{Claim, Quantity, Sites, Statement};

/// Marks for what `claims` state of the policies drawn at one N.
pub fn marks(claims: &[Claim], series: &[Series]) -> Vec<Mark> {
    let drawn = claims.iter().filter(|c| series.iter().any(|s| s.name == c.policy));
    let mut marks: Vec<Mark> = drawn.filter_map(|claim| mark(claim, claims)).collect();
    marks.sort_by(|a, b| a.x.total_cmp(&b.x));
    spread(&mut marks);
    marks
}

/// Where and how `claim`, one of `claims`, is marked; `None` if it is not about one N.
fn mark(claim: &Claim, claims: &[Claim]) -> Option<Mark> {
    let Sites::At(n) = claim.sites else { return None };
    Some(Mark {
        x: f64::from(n),
        aside: 0.0,
        stated: said(claim, claims)?,
        style: Style::of_policy(claim.policy),
    })
}

/// What `claims` state of the policies drawn for several N, from the least to the largest of them that was run.
pub fn spans(claims: &[Claim], series: &[Series]) -> Vec<Span> {
    let xs = || series.iter().flat_map(|s| &s.samples).map(|s| s.x);
    let (least, largest) = (xs().fold(f64::INFINITY, f64::min), xs().fold(0.0, f64::max));
    let span = |claim: &Claim| {
        let (from, to) = claim.sites.ends();
        let own = series.iter().find(|s| s.name == claim.policy)?;
        Some(Span {
            from: least.max(f64::from(from)),
            to: largest.min(f64::from(to)),
            stated: said(claim, claims)?,
            paint: own.style.paint,
        })
    };
    let spans = claims.iter().filter_map(span);
    spans.filter(|span| span.from < span.to).collect()
}

/// What `claim`, one of `claims`, says of the metric itself; a ratio to one other policy as its multiple of what is
/// stated of that.
pub fn said(claim: &Claim, claims: &[Claim]) -> Option<Stated> {
    let times = |factor: f64, statement: Statement| match statement {
        Statement::About(v) => Some(Stated::Value(factor * v)),
        Statement::Between(low, high) => Some(Stated::Range(factor * low, factor * high)),
        Statement::Below(v) => Some(Stated::Below(factor * v)),
        Statement::Above(v) => Some(Stated::Above(factor * v)),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Level | Statement::Falls | Statement::Rises => None,
    };
    match (claim.quantity, claim.statement) {
        (Quantity::Own, statement) => times(1.0, statement),
        (Quantity::Ratio([other]), Statement::About(factor)) => {
            let is_base = |c: &&Claim| c.policy == *other && c.sites == claim.sites && c.quantity == Quantity::Own;
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
        (Quantity::Ratio(_) | Quantity::Gap(_) | Quantity::Growth(_), _) => None,
    }
}
