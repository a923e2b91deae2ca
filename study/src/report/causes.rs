//! Explanations of verdicts: the deviation, policies that were not run, and known causes. Read from the claims' caveats
//! and from the runs' own metrics; [`super`] puts them into the rows. docs/reproduction.md contains the texts.
//!
//! The lists name metrics, and a test checks that they exist. A metric that is in neither list is never explained by
//! empty batteries.

use super::finding_text::describe_deviation;
use super::judge::{Judgement, Verdict};
use super::phrasing::format_number;
use crate::claims::{Claim, ClaimQuantity, ClaimTopic};
use crate::figures::results::RunCondition;

/// Explanation of a claim without runs. `lambda` uses it too, and `notes` compares explanations with it.
pub(super) const NOT_RUN: &str = "The tables hold no such runs.";

/// Explanation of a verdict that is not firm. `lambda` uses it too.
pub(super) const NOT_FIRM: &str = "Our interval crosses the limit of this verdict; more runs would decide.";

/// Share of devices with low energy, %, from which on batteries count as a cause.
const LOW_ENERGY_CAUSE_PCT: f64 = 50.0;

/// Metrics that empty batteries lower.
const LOWERED_BY_LOW_ENERGY: [&str; 4] = ["info_p1", "info_per_event", "energy_per_device_tti", "mean_battery"];

/// Metrics that empty batteries raise.
const RAISED_BY_LOW_ENERGY: [&str; 2] = [MISDETECTION_METRIC, "wrong_activations_per_event"];

/// The metric of missed events.
const MISDETECTION_METRIC: &str = "misdetection_pct";

/// The metric of devices with low energy.
const LOW_ENERGY_METRIC: &str = "low_energy_pct";

/// Explains the verdict on `claim`; empty without a known cause.
pub(super) fn explain(topic: &ClaimTopic, claim: &Claim, judgement: &Judgement, condition: &RunCondition) -> String {
    let mut reasons: Vec<String> = Vec::new();
    match judgement.verdict {
        Verdict::Reproduced => {}
        Verdict::Near => reasons.extend(describe_deviation(claim, &judgement.findings)),
        Verdict::NotRun => reasons.push(NOT_RUN.to_owned()),
        Verdict::OrderReproduced | Verdict::NotReproduced => {
            reasons.extend(describe_deviation(claim, &judgement.findings));
            reasons.extend(order_sentences(judgement));
            let known = known_causes(topic, claim, judgement, condition);
            if known.is_empty() && judgement.verdict == Verdict::NotReproduced {
                reasons.push("Cause unknown.".to_owned());
            }
            reasons.extend(known);
        }
    }
    reasons.extend(sentence_on_missing_policies(claim, judgement));
    if !judgement.is_firm {
        reasons.push(NOT_FIRM.to_owned());
    }
    reasons.join(" ")
}

/// Lists the policies of [`Judgement::order_checks`] with their N: first the ones with the stated order.
fn order_sentences(judgement: &Judgement) -> Vec<String> {
    let list_policies_with = |as_stated: bool| {
        let mut counts_by_policy: Vec<(&str, Vec<String>)> = Vec::new();
        for check in judgement
            .order_checks
            .iter()
            .filter(|check| check.is_as_stated == as_stated)
        {
            match counts_by_policy
                .iter_mut()
                .find(|(policy, _)| *policy == check.other_policy)
            {
                Some((_, device_counts)) => device_counts.push(check.n.to_string()),
                None => counts_by_policy.push((check.other_policy, vec![check.n.to_string()])),
            }
        }
        let names = counts_by_policy
            .iter()
            .map(|(policy, device_counts)| format!("{policy} (N = {})", device_counts.join(", ")));
        names.collect::<Vec<_>>().join(", ")
    };
    let mut sentences = Vec::new();
    for (as_stated, side) in [(true, "On"), (false, "Not on")] {
        let policies = list_policies_with(as_stated);
        if !policies.is_empty() {
            sentences.push(format!("{side} the paper's side of {policies}."));
        }
    }
    sentences
}

/// Lists the policies of the claim's comparison that were not run; `None` if none or all of them were run.
fn sentence_on_missing_policies(claim: &Claim, judgement: &Judgement) -> Option<String> {
    let ClaimQuantity::Ratio(others) = claim.quantity else {
        return None;
    };
    let is_missing = |other: &&&str| !judgement.findings.iter().any(|f| f.other_policy == Some(**other));
    let missing: Vec<&str> = others.iter().filter(is_missing).copied().collect();
    let are_some_missing = !missing.is_empty() && judgement.verdict != Verdict::NotRun;
    are_some_missing.then(|| format!("Without {} (not run here).", missing.join(", ")))
}

/// Lists the causes known from the claims or from our own metrics.
fn known_causes(topic: &ClaimTopic, claim: &Claim, judgement: &Judgement, condition: &RunCondition) -> Vec<String> {
    let mut reasons = Vec::new();
    if !claim.caveat.is_empty() {
        reasons.push(claim.caveat.to_owned());
    }
    let (Some((low, high)), ClaimQuantity::Mean | ClaimQuantity::Ratio(_)) = (claim.statement.range(), claim.quantity)
    else {
        return reasons;
    };
    let (below_range, above_range) = (
        judgement.findings.iter().find(|f| f.value < low),
        judgement.findings.iter().find(|f| f.value > high),
    );
    // Empty batteries explain too little information or energy and too many misses, never the opposite.
    let finding_to_explain = if LOWERED_BY_LOW_ENERGY.contains(&topic.metric) {
        below_range
    } else {
        above_range.filter(|_| RAISED_BY_LOW_ENERGY.contains(&topic.metric))
    };
    let share_with_low_energy =
        finding_to_explain.and_then(|f| Some((f.n, condition.estimate(claim.policy, f.n, LOW_ENERGY_METRIC)?.mean)));
    if let Some((n, share)) = share_with_low_energy.filter(|(_, share)| *share >= LOW_ENERGY_CAUSE_PCT) {
        reasons.push(format!(
            "Batteries are empty: at N = {n}, {} % of the devices are below E_Tx at the end of a TTI.",
            format_number(share)
        ));
    }
    let events = condition.scenario.as_ref().map(|scenario| &scenario.events);
    let duration = events.and_then(|events| match events.max_duration() {
        Some(1) => None,
        Some(longest) => Some(format!("up to {longest} TTIs")),
        None => Some(format!("{} TTIs on average", events.duration)),
    });
    let has_too_few_misses =
        topic.metric == MISDETECTION_METRIC && claim.quantity == ClaimQuantity::Mean && below_range.is_some();
    if let Some(duration) = duration.filter(|_| has_too_few_misses) {
        reasons.push(format!(
            "An event lasts {duration} here and is missed only if none of them brings a report."
        ));
    }
    reasons
}

#[cfg(test)]
mod tests {
    use reveille_common::score::Metrics;

    use super::*;

    #[test]
    fn causes_name_metrics_that_exist() {
        let names = LOWERED_BY_LOW_ENERGY
            .iter()
            .chain(&RAISED_BY_LOW_ENERGY)
            .chain([&LOW_ENERGY_METRIC]);
        for name in names {
            assert!(Metrics::NAMES.contains(name), "{name}");
        }
    }
}
