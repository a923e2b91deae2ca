//! How policies stand to each other, in the paper and in our runs.

use super::finding::{Finding, Runs};
use crate::claims::{Claim, Quantity, Sites, Statement, Topic};
use crate::figures::results::Condition;

/// Two policies at one N.
pub(super) struct Pair {
    /// N.
    pub n: u32,
    /// The other policy.
    pub other: &'static str,
    /// Whether the means stand to each other as in the paper.
    pub as_stated: bool,
    /// Whether their intervals leave no doubt.
    pub firm: bool,
}

/// The policies whose order to that of `claim` the paper states, at each N that was run; for what is said of the
/// largest or smallest over N, at the N of `findings` where it is. Nothing of claims on how one thing changes with N.
pub(super) fn compared(topic: &Topic, claim: &Claim, condition: &Condition, findings: &[Finding]) -> Vec<Pair> {
    if is_of_one_alone(claim) {
        return Vec::new();
    }
    let by_value = |a: &&Finding, b: &&Finding| a.value.total_cmp(&b.value);
    let at = match claim.statement {
        Statement::Largest(_) => findings.iter().max_by(by_value),
        Statement::Smallest(_) => findings.iter().min_by(by_value),
        Statement::About(_)
        | Statement::Between(..)
        | Statement::Below(_)
        | Statement::Above(_)
        | Statement::Level
        | Statement::Falls
        | Statement::Rises => None,
    };
    let runs = Runs { topic, condition };
    let mut pairs = Vec::new();
    let sizes = condition.sizes(claim.policy).into_iter();
    for n in sizes.filter(|n| claim.sites.holds(*n) && at.is_none_or(|at| at.n == *n)) {
        for (other, is_lower) in rivals(topic, claim, n) {
            let (Some(own), Some(theirs)) = (runs.reading(claim.policy, n), runs.reading(other, n)) else {
                continue;
            };
            let difference = own.estimate.mean - theirs.estimate.mean;
            pairs.push(Pair {
                n,
                other,
                as_stated: if is_lower { difference < 0.0 } else { difference > 0.0 },
                firm: difference.abs() > own.half_width() + theirs.half_width(),
            });
        }
    }
    pairs
}

/// Whether a claim, if it is not met, has no part in which it could be.
fn is_of_one_alone(claim: &Claim) -> bool {
    let is_order = matches!(claim.quantity, Quantity::Ratio(_)) && side(claim.statement).is_none_or(|(_, own)| own);
    let is_change = matches!(claim.quantity, Quantity::Growth(_) | Quantity::Gap(_));
    let is_trend = matches!(claim.statement, Statement::Level | Statement::Falls | Statement::Rises);
    is_order || is_change || is_trend
}

/// On which side of 1 a stated ratio is, whether below, and whether it says nothing else than that.
fn side(statement: Statement) -> Option<(bool, bool)> {
    match statement {
        Statement::Below(v) => (v <= 1.0).then_some((true, v >= 1.0)),
        Statement::Above(v) => (v >= 1.0).then_some((false, v <= 1.0)),
        Statement::About(v) | Statement::Largest(v) | Statement::Smallest(v) => {
            ((v - 1.0).abs() > 0.0).then_some((v < 1.0, false))
        }
        Statement::Between(low, high) => (high < 1.0 || low > 1.0).then_some((high < 1.0, false)),
        Statement::Level | Statement::Falls | Statement::Rises => None,
    }
}

/// The policies to which the paper states the order or the ratio of that of `claim` at `n`, or all of whose figures
/// there exclude all of its own, and whether `claim` is the lower. A claim on a ratio is about its own policies alone.
fn rivals(topic: &Topic, claim: &Claim, n: u32) -> Vec<(&'static str, bool)> {
    if let (Quantity::Ratio(others), Some((is_lower, _))) = (claim.quantity, side(claim.statement)) {
        return others.iter().map(|other| (*other, is_lower)).collect();
    }
    let mut rivals: Vec<(&'static str, bool)> = Vec::new();
    let mut add = |other: &'static str, is_lower: bool| {
        if !rivals.iter().any(|(known, _)| *known == other) {
            rivals.push((other, is_lower));
        }
    };
    for other in topic.claims.iter().filter(|other| other.sites.holds(n)) {
        // "Up to" is said of one N, which is not known.
        let is_here = other.statement.range().is_some();
        let (Quantity::Ratio(bases), Some((is_lower, _)), true) = (other.quantity, side(other.statement), is_here)
        else {
            continue;
        };
        if other.policy == claim.policy {
            for base in bases {
                add(base, is_lower);
            }
        } else if bases.contains(&claim.policy) {
            add(other.policy, !is_lower);
        }
    }
    let own = ranges(topic, claim.policy, n);
    for other in topic.claims.iter().filter(|other| other.policy != claim.policy) {
        let theirs = ranges(topic, other.policy, n);
        let all = |apart: fn((f64, f64), (f64, f64)) -> bool| own.iter().all(|a| theirs.iter().all(|b| apart(*a, *b)));
        let (is_lower, is_higher) = (all(|a, b| a.1 < b.0), all(|a, b| b.1 < a.0));
        if !own.is_empty() && !theirs.is_empty() && is_lower != is_higher {
            add(other.policy, is_lower);
        }
    }
    rivals
}

/// What the paper states of `policy` at `n`, from and to. What is said of this N counts before what is said of many.
fn ranges(topic: &Topic, policy: &str, n: u32) -> Vec<(f64, f64)> {
    let own = || topic.claims.iter().filter(|c| c.policy == policy && c.sites.holds(n));
    let stated = |claims: &mut dyn Iterator<Item = &'static Claim>| -> Vec<(f64, f64)> {
        claims.flat_map(|claim| stated(topic, claim, n)).collect()
    };
    let here = stated(&mut own().filter(|c| c.sites == Sites::At(n)));
    if here.is_empty() { stated(&mut own()) } else { here }
}

/// What `claim` states of its policy at `n`; a ratio stands for its multiple of what is stated of the other policy.
fn stated(topic: &Topic, claim: &Claim, n: u32) -> Vec<(f64, f64)> {
    let Some((from, to)) = claim.statement.range() else {
        return Vec::new();
    };
    match claim.quantity {
        Quantity::Own => vec![(from, to)],
        // Who is below another has no figure for that.
        Quantity::Ratio(_) if !from.is_finite() || !to.is_finite() => Vec::new(),
        Quantity::Ratio(others) => {
            let bases = topic
                .claims
                .iter()
                .filter(|c| c.quantity == Quantity::Own && c.sites.holds(n));
            let bases = bases.filter(|c| others.contains(&c.policy));
            let ranges = bases.filter_map(|c| c.statement.range());
            let multiples = ranges.filter(|(low, high)| low.is_finite() && high.is_finite());
            multiples.map(|(low, high)| (from * low, to * high)).collect()
        }
        Quantity::Gap(_) | Quantity::Growth(_) => Vec::new(),
    }
}
