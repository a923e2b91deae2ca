//! The verdict on a claim.
//!
//! 1. A policy without runs at a claim's N is *not run*.
//! 2. A claim is *reproduced* if our mean is within 20 % of the stated value: of the value itself, of the nearer end of a
//!    range, of a stated ratio of two means. A bound ("below", "above") is met or not, without a tolerance. A claim for
//!    several N must hold at each that was run.
//! 3. Otherwise its *order is reproduced* if, at each such N, our means stand to those of every other policy as the paper's
//!    figures do, where the paper states figures for both that exclude each other, and there is at least one such policy.
//! 4. Otherwise it is *not reproduced*.
//!
//! A verdict is *firm* if it would be the same for every value in our 95 % intervals.

use super::claims::{Claim, Relation, Topic};
use crate::figures::results::Setting;
use crate::stats::Estimate;

/// How far from a stated value still counts as that value, as a share of it.
pub const TOLERANCE: f64 = 0.2;
/// For what binary fractions do to the last digit of 20 %.
const ROUNDING: f64 = 1e-9;

/// The verdict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// Within [`TOLERANCE`], or a bound that is met.
    Reproduced,
    /// Not that, but the policy stands among the others where the paper has it.
    OrderReproduced,
    /// Neither.
    NotReproduced,
    /// There are no runs.
    NotRun,
}

impl Verdict {
    /// In words.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Reproduced => "reproduced",
            Self::OrderReproduced => "order reproduced",
            Self::NotReproduced => "not reproduced",
            Self::NotRun => "not run",
        }
    }
}

/// Our figure at one N, with what it was compared with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finding {
    /// N.
    pub n: u32,
    /// Our mean; of a ratio, the ratio of means.
    pub value: f64,
    /// Half the 95 % interval; NaN where it is not known.
    pub half: f64,
}

/// A claim, judged.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// The verdict.
    pub verdict: Verdict,
    /// Whether it holds throughout our intervals.
    pub firm: bool,
    /// Our figures, by rising N.
    pub findings: Vec<Finding>,
    /// The policies whose order was compared, with N, and whether we have it as the paper has it.
    pub order: Vec<(u32, &'static str, bool)>,
}

/// Judges one claim of `topic` by the runs of `setting`.
pub fn judge(topic: &Topic, claim: &Claim, setting: &Setting) -> Judgement {
    let estimate = |policy: &str, n: u32| setting.estimate(policy, n, topic.metric);
    let sizes: Vec<u32> = setting
        .sizes(claim.policy)
        .into_iter()
        .filter(|n| claim.sites.holds(*n))
        .collect();
    let findings = sizes.iter().filter_map(|&n| finding(claim, n, &estimate)).collect();
    let mut judgement = Judgement {
        verdict: Verdict::NotRun,
        firm: true,
        findings,
        order: Vec::new(),
    };
    if judgement.findings.is_empty() {
        return judgement;
    }
    let fits: Vec<(bool, bool)> = judgement.findings.iter().map(|f| fits(claim.relation, f)).collect();
    if fits.iter().all(|(fits, _)| *fits) {
        judgement.verdict = Verdict::Reproduced;
        judgement.firm = fits.iter().all(|(_, firm)| *firm);
        return judgement;
    }
    let surely_not = fits.iter().any(|(fits, firm)| !fits && *firm);
    let (mut all_firm, mut surely_wrong) = (true, false);
    for &n in &sizes {
        for (other, is_lower) in rivals(topic, claim, n) {
            let (Some(own), Some(theirs)) = (estimate(claim.policy, n), estimate(other, n)) else {
                continue;
            };
            let (as_stated, firm) = stands(is_lower, own, theirs);
            all_firm &= firm;
            surely_wrong |= firm && !as_stated;
            judgement.order.push((n, other, as_stated));
        }
    }
    let has_order = !judgement.order.is_empty() && judgement.order.iter().all(|(_, _, same)| *same);
    judgement.verdict = if has_order {
        Verdict::OrderReproduced
    } else {
        Verdict::NotReproduced
    };
    let order_firm = if has_order {
        all_firm
    } else {
        surely_wrong || judgement.order.is_empty()
    };
    judgement.firm = surely_not && order_firm;
    judgement
}

/// Our figure for `claim` at `n`.
fn finding(claim: &Claim, n: u32, estimate: &impl Fn(&str, u32) -> Option<Estimate>) -> Option<Finding> {
    let own = estimate(claim.policy, n)?;
    let Relation::Times(_, other) = claim.relation else {
        return Some(Finding {
            n,
            value: own.mean,
            half: own.half_width,
        });
    };
    let base = estimate(other, n)?;
    let value = own.mean / base.mean;
    // First order in both means, which come from the same seeds: taking them as independent is on the wide side.
    let spread = (own.half_width / own.mean).abs() + (base.half_width / base.mean).abs();
    let half = value.abs() * spread;
    value.is_finite().then_some(Finding { n, value, half })
}

/// Whether `finding` is what `relation` says, and whether all of its interval is on the same side.
fn fits(relation: Relation, finding: &Finding) -> (bool, bool) {
    let holds = |x: f64| match relation {
        Relation::Below(v) => x < v,
        Relation::Above(v) => x > v,
        Relation::About(v) | Relation::Times(v, _) => within(x, v, v),
        Relation::Between(low, high) => within(x, low, high),
    };
    let result = holds(finding.value);
    let (low, high) = (finding.value - finding.half, finding.value + finding.half);
    let firm = match relation {
        Relation::Below(_) | Relation::Above(_) => holds(low) == result && holds(high) == result,
        Relation::About(v) | Relation::Times(v, _) => firm_within(result, low, high, v, v),
        Relation::Between(a, b) => firm_within(result, low, high, a, b),
    };
    (result, firm && !finding.half.is_nan())
}

/// Whether `x` is between `low` and `high`, both widened by [`TOLERANCE`].
pub fn within(x: f64, low: f64, high: f64) -> bool {
    let (low, high) = widened(low, high);
    (low..=high).contains(&x)
}

fn widened(low: f64, high: f64) -> (f64, f64) {
    let room = TOLERANCE + ROUNDING;
    (low - room * low.abs(), high + room * high.abs())
}

fn firm_within(result: bool, from: f64, to: f64, low: f64, high: f64) -> bool {
    let (low, high) = widened(low, high);
    if result {
        low <= from && to <= high
    } else {
        to < low || high < from
    }
}

/// What the paper states of the policy of `claim` at `n`, from and to; a ratio stands for its multiple of what is stated of
/// the other policy.
fn stated(topic: &Topic, claim: &Claim, n: u32) -> Option<(f64, f64)> {
    let Relation::Times(factor, other) = claim.relation else {
        return claim.relation.range();
    };
    let base = topic.claims.iter().find(|c| c.policy == other && c.sites.holds(n))?;
    let (low, high) = base.relation.range()?;
    Some((factor * low, factor * high))
}

/// The policies of which the paper states figures at `n` that exclude those of `claim`, and whether `claim` is the lower.
fn rivals(topic: &Topic, claim: &Claim, n: u32) -> Vec<(&'static str, bool)> {
    let Some((low, high)) = stated(topic, claim, n) else {
        return Vec::new();
    };
    let others = topic
        .claims
        .iter()
        .filter(|other| other.policy != claim.policy && other.sites.holds(n));
    let apart = others.filter_map(|other| {
        let (least, most) = stated(topic, other, n)?;
        (high < least || most < low).then_some((other.policy, high < least))
    });
    apart.collect()
}

/// Whether `own` stands to `theirs` as stated, and whether their intervals leave no doubt.
fn stands(is_lower: bool, own: Estimate, theirs: Estimate) -> (bool, bool) {
    let difference = own.mean - theirs.mean;
    let as_stated = if is_lower { difference < 0.0 } else { difference > 0.0 };
    (as_stated, difference.abs() > own.half_width + theirs.half_width)
}

#[cfg(test)]
mod tests;
