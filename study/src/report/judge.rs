//! The verdict on a claim.
//!
//! 1. A policy without runs at a claim's N is *not run*.
//! 2. A claim is *reproduced* if our mean is within 20 % of the stated value: of the value itself, of the nearer end of
//!    a range, of a stated ratio of two means. A bound ("below", "above") is met or not, without a tolerance. A claim
//!    for several N must hold at each that was run. A stated 0 allows 1 % of the largest of the other policies' means.
//! 3. Otherwise its *order is reproduced* if, at each such N, our means stand to those of every other policy as the
//!    paper's figures do, where the paper states their ratio or figures for both all of which exclude each other, and
//!    there is at least one such policy.
//! 4. Otherwise it is *not reproduced*.
//!
//! A verdict is *firm* if it would be the same for every value in our 95 % intervals.

use crate::claims::{Claim, Relation, Sites, Topic};
use crate::figures::results::Condition;
use reveille_lab::stats::Estimate;

/// How far from a stated value still counts as that value, as a share of it.
pub const TOLERANCE: f64 = 0.2;
/// How much counts as 0, as a share of the largest of the other policies' means.
pub const ZERO: f64 = 0.01;
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
    /// All verdicts, the best first.
    pub const ALL: [Self; 4] = [
        Self::Reproduced,
        Self::OrderReproduced,
        Self::NotReproduced,
        Self::NotRun,
    ];

    /// The verdict in words.
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
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Finding {
    /// N.
    pub n: u32,
    /// Our mean; of a ratio, the ratio of means.
    pub value: f64,
    /// Half the 95 % interval; NaN where it is not known. Above a count of zero, the rule of three's bound.
    pub half: f64,
    /// What counts as a stated 0, at most.
    pub zero: f64,
    /// The events, if none of them was missed.
    pub unseen: Option<u64>,
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

/// Judges one claim of `topic` by the runs of `condition`.
pub fn judge(topic: &Topic, claim: &Claim, condition: &Condition) -> Judgement {
    let estimate = |policy: &str, n: u32| condition.estimate(policy, n, topic.metric);
    let sizes: Vec<u32> = condition
        .sizes(claim.policy)
        .into_iter()
        .filter(|n| claim.sites.holds(*n))
        .collect();
    let findings = sizes
        .iter()
        .filter_map(|&n| finding(topic, claim, n, condition))
        .collect();
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
fn finding(topic: &Topic, claim: &Claim, n: u32, condition: &Condition) -> Option<Finding> {
    let mean = |policy: &str| condition.estimate(policy, n, topic.metric);
    let own = mean(claim.policy)?;
    let Relation::Times(_, other) = claim.relation else {
        let others = condition
            .policies()
            .into_iter()
            .filter(|policy| *policy != claim.policy);
        let largest = others.filter_map(mean).map(|e| e.mean).fold(0.0, f64::max);
        return Some(Finding {
            n,
            value: own.mean,
            half: own.half_width,
            zero: ZERO * largest,
            unseen: condition.unseen(claim.policy, n, topic.metric),
        });
    };
    let base = mean(other)?;
    let value = own.mean / base.mean;
    // First order in both means, which come from the same seeds: taking them as independent is on the wide side.
    let spread = (own.half_width / own.mean).abs() + (base.half_width / base.mean).abs();
    let half = value.abs() * spread;
    value.is_finite().then_some(Finding {
        n,
        value,
        half,
        ..Finding::default()
    })
}

/// Whether `finding` is what `relation` says, and whether all of its interval is on the same side.
fn fits(relation: Relation, finding: &Finding) -> (bool, bool) {
    let (low, high) = match relation {
        Relation::Below(v) => (f64::NEG_INFINITY, v),
        Relation::Above(v) => (v, f64::INFINITY),
        Relation::About(0.0) => (f64::NEG_INFINITY, finding.zero),
        Relation::About(v) | Relation::Times(v, _) => widened(v, v),
        Relation::Between(low, high) => widened(low, high),
    };
    let is_strict = matches!(relation, Relation::Below(_) | Relation::Above(_));
    let holds = |x: f64| {
        if is_strict {
            low < x && x < high
        } else {
            (low..=high).contains(&x)
        }
    };
    // No metric of a claim can be negative, whatever an interval says.
    let (from, to) = ((finding.value - finding.half).max(0.0), finding.value + finding.half);
    let result = holds(finding.value);
    let firm = if result {
        holds(from) && holds(to)
    } else {
        to < low || high < from || (is_strict && (to <= low || high <= from))
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

/// What the paper states of the policy of `claim` at `n`, from and to; a ratio stands for its multiple of what is
/// stated of the other policy.
fn stated(topic: &Topic, claim: &Claim, n: u32) -> Option<(f64, f64)> {
    let Relation::Times(factor, other) = claim.relation else {
        return claim.relation.range();
    };
    let base = topic.claims.iter().find(|c| c.policy == other && c.sites.holds(n))?;
    let (low, high) = base.relation.range()?;
    Some((factor * low, factor * high))
}

/// The policies to which the paper states the ratio of that of `claim` at `n`, or all of whose figures there exclude
/// all of its own, and whether `claim` is the lower.
fn rivals(topic: &Topic, claim: &Claim, n: u32) -> Vec<(&'static str, bool)> {
    let ranges = |policy: &str| -> Vec<(f64, f64)> {
        let own = || topic.claims.iter().filter(|c| c.policy == policy && c.sites.holds(n));
        // What is said of this N counts before what is said of many.
        let has_own = own().any(|c| c.sites == Sites::At(n));
        let counts = own().filter(|c| !has_own || c.sites == Sites::At(n));
        counts.filter_map(|c| stated(topic, c, n)).collect()
    };
    let own = ranges(claim.policy);
    let mut rivals: Vec<(&'static str, bool)> = Vec::new();
    if let Relation::Times(factor, other) = claim.relation {
        rivals.push((other, factor < 1.0));
    }
    for other in topic.claims.iter().filter(|other| other.policy != claim.policy) {
        if rivals.iter().any(|(known, _)| *known == other.policy) {
            continue;
        }
        let theirs = ranges(other.policy);
        let all = |apart: fn((f64, f64), (f64, f64)) -> bool| own.iter().all(|a| theirs.iter().all(|b| apart(*a, *b)));
        let (is_lower, is_higher) = (all(|a, b| a.1 < b.0), all(|a, b| b.1 < a.0));
        if !own.is_empty() && !theirs.is_empty() && is_lower != is_higher {
            rivals.push((other.policy, is_lower));
        }
    }
    rivals
}

/// Whether `own` stands to `theirs` as stated, and whether their intervals leave no doubt.
fn stands(is_lower: bool, own: Estimate, theirs: Estimate) -> (bool, bool) {
    let difference = own.mean - theirs.mean;
    let as_stated = if is_lower { difference < 0.0 } else { difference > 0.0 };
    (as_stated, difference.abs() > own.half_width + theirs.half_width)
}

#[cfg(test)]
mod tests;
