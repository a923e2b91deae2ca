//! Order of the policies in the paper and in our runs: rule 4 of [`super`]. Change it together with the texts of the
//! rule that [`super`] lists. The paper's order follows from all claims of a topic, so a new claim can change this
//! verdict of the topic's other claims.

use super::finding::{Finding, TopicRuns};
use crate::claims::{Claim, ClaimQuantity, ClaimTopic, DeviceCounts, Statement};
use crate::figures::results::RunCondition;

/// Comparison of a policy with another at one N.
pub(super) struct PolicyPair {
    /// Number of devices N.
    pub n: u32,
    /// The other policy.
    pub other_policy: &'static str,
    /// Whether the means have the order that the paper states.
    pub is_as_stated: bool,
    /// Whether the means keep their order, as stated or not, for all values within both intervals.
    pub is_firm: bool,
}

/// Compares the policy of `claim` with the policies whose order to it the paper states, at each N that was run. A claim
/// on the largest or smallest over N is compared only at that N in `findings`. Empty for claims on a change with N.
pub(super) fn compare_policies(
    topic: &ClaimTopic,
    claim: &Claim,
    condition: &RunCondition,
    findings: &[Finding],
) -> Vec<PolicyPair> {
    if has_no_order(claim) {
        return Vec::new();
    }
    let by_value = |a: &&Finding, b: &&Finding| a.value.total_cmp(&b.value);
    let extreme = match claim.statement {
        Statement::Largest(_) => findings.iter().max_by(by_value),
        Statement::Smallest(_) => findings.iter().min_by(by_value),
        Statement::About(_)
        | Statement::Between(..)
        | Statement::Below(_)
        | Statement::Above(_)
        | Statement::Constant
        | Statement::Falls
        | Statement::Rises => None,
    };
    let runs = TopicRuns { topic, condition };
    let mut pairs = Vec::new();
    let device_counts = condition.device_counts(claim.policy).into_iter();
    for n in device_counts.filter(|n| claim.device_counts.contains(*n) && extreme.is_none_or(|extreme| extreme.n == *n))
    {
        for (other_policy, is_lower) in policies_with_stated_order(topic, claim, n) {
            let (Some(estimate), Some(other_estimate)) = (
                runs.metric_estimate(claim.policy, n),
                runs.metric_estimate(other_policy, n),
            ) else {
                continue;
            };
            let difference = estimate.mean_estimate.mean - other_estimate.mean_estimate.mean;
            pairs.push(PolicyPair {
                n,
                other_policy,
                is_as_stated: if is_lower { difference < 0.0 } else { difference > 0.0 },
                is_firm: difference.abs() > estimate.half_width() + other_estimate.half_width(),
            });
        }
    }
    pairs
}

/// Whether the claim has no order to judge apart from its own statement: a pure order, a change or a trend.
fn has_no_order(claim: &Claim) -> bool {
    let is_order = matches!(claim.quantity, ClaimQuantity::Ratio(_))
        && stated_side(claim.statement).is_none_or(|side| side.is_whole_statement);
    let is_change = matches!(claim.quantity, ClaimQuantity::Growth(_) | ClaimQuantity::Gap(_));
    let is_trend = matches!(
        claim.statement,
        Statement::Constant | Statement::Falls | Statement::Rises
    );
    is_order || is_change || is_trend
}

/// The side of 1 on which a stated ratio lies.
struct StatedSide {
    /// Whether the ratio is below 1; otherwise it is above.
    is_below_one: bool,
    /// Whether the statement says no more than this: a bound of 1.
    is_whole_statement: bool,
}

/// Returns the side of 1 of a statement on a ratio; `None` for neither side.
fn stated_side(statement: Statement) -> Option<StatedSide> {
    let (is_on_one_side, is_below_one, is_whole_statement) = match statement {
        Statement::Below(v) => (v <= 1.0, true, v >= 1.0),
        Statement::Above(v) => (v >= 1.0, false, v <= 1.0),
        Statement::About(v) | Statement::Largest(v) | Statement::Smallest(v) => ((v - 1.0).abs() > 0.0, v < 1.0, false),
        Statement::Between(low, high) => (high < 1.0 || low > 1.0, high < 1.0, false),
        Statement::Constant | Statement::Falls | Statement::Rises => return None,
    };
    is_on_one_side.then_some(StatedSide {
        is_below_one,
        is_whole_statement,
    })
}

/// Lists the policies with a stated order to `claim`'s policy at `n`, and whether `claim`'s policy is the lower. The
/// order follows from a stated order or ratio, or from ranges that all exclude each other. A claim on a ratio concerns
/// only its own policies.
fn policies_with_stated_order(topic: &ClaimTopic, claim: &Claim, n: u32) -> Vec<(&'static str, bool)> {
    if let (ClaimQuantity::Ratio(others), Some(side)) = (claim.quantity, stated_side(claim.statement)) {
        return others.iter().map(|other| (*other, side.is_below_one)).collect();
    }
    let mut ordered: Vec<(&'static str, bool)> = Vec::new();
    let mut add_if_new = |other: &'static str, is_lower: bool| {
        if !ordered.iter().any(|(known, _)| *known == other) {
            ordered.push((other, is_lower));
        }
    };
    for order_claim in topic.claims.iter().filter(|c| c.device_counts.contains(n)) {
        // "Up to" refers to one N, which the paper does not name.
        let is_at_each_n = order_claim.statement.range().is_some();
        let (ClaimQuantity::Ratio(others), Some(side), true) =
            (order_claim.quantity, stated_side(order_claim.statement), is_at_each_n)
        else {
            continue;
        };
        if order_claim.policy == claim.policy {
            for other in others {
                add_if_new(other, side.is_below_one);
            }
        } else if others.contains(&claim.policy) {
            add_if_new(order_claim.policy, !side.is_below_one);
        }
    }
    let ranges = ranges_of_policy(topic, claim.policy, n);
    for other_policy in topic.claims.iter().map(|c| c.policy).filter(|p| *p != claim.policy) {
        let other_ranges = ranges_of_policy(topic, other_policy, n);
        let all_pairs = |holds: fn((f64, f64), (f64, f64)) -> bool| {
            ranges.iter().all(|a| other_ranges.iter().all(|b| holds(*a, *b)))
        };
        let (is_lower, is_higher) = (all_pairs(|a, b| a.1 < b.0), all_pairs(|a, b| b.1 < a.0));
        if !ranges.is_empty() && !other_ranges.is_empty() && is_lower != is_higher {
            add_if_new(other_policy, is_lower);
        }
    }
    ordered
}

/// Ranges that the paper states for `policy` at `n`. Claims on exactly this N take precedence over claims on several N.
fn ranges_of_policy(topic: &ClaimTopic, policy: &str, n: u32) -> Vec<(f64, f64)> {
    let claims_at_n = || {
        topic
            .claims
            .iter()
            .filter(|c| c.policy == policy && c.device_counts.contains(n))
    };
    let stated = |claims: &mut dyn Iterator<Item = &'static Claim>| -> Vec<(f64, f64)> {
        claims.flat_map(|claim| ranges_of_claim(topic, claim, n)).collect()
    };
    let exactly_at_n = stated(&mut claims_at_n().filter(|c| c.device_counts == DeviceCounts::At(n)));
    if exactly_at_n.is_empty() {
        stated(&mut claims_at_n())
    } else {
        exactly_at_n
    }
}

/// Ranges that `claim` states for its policy at `n`; a ratio multiplies the ranges stated for the other policy.
fn ranges_of_claim(topic: &ClaimTopic, claim: &Claim, n: u32) -> Vec<(f64, f64)> {
    let Some((from, to)) = claim.statement.range() else {
        return Vec::new();
    };
    match claim.quantity {
        ClaimQuantity::Mean => vec![(from, to)],
        // A bound on a ratio gives no figure for the policy itself.
        ClaimQuantity::Ratio(_) if !from.is_finite() || !to.is_finite() => Vec::new(),
        ClaimQuantity::Ratio(others) => {
            let bases = topic
                .claims
                .iter()
                .filter(|c| c.quantity == ClaimQuantity::Mean && c.device_counts.contains(n));
            let bases = bases.filter(|c| others.contains(&c.policy));
            let ranges = bases.filter_map(|c| c.statement.range());
            let multiples = ranges.filter(|(low, high)| low.is_finite() && high.is_finite());
            multiples.map(|(low, high)| (from * low, to * high)).collect()
        }
        ClaimQuantity::Gap(_) | ClaimQuantity::Growth(_) => Vec::new(),
    }
}
