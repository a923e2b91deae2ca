//! Known causes of unmet claims, as sentences.

use super::finding_text::distance;
use super::judge::{Judgement, Verdict};
use super::phrasing::number;
use crate::claims::{Claim, ClaimQuantity, ClaimTopic};
use crate::figures::results::RunCondition;

/// Share of devices with low energy, %, from which on batteries count as a cause.
const MOST_ARE_LOW: f64 = 50.0;

/// Explains the verdict on `claim`; empty without a known cause.
pub(super) fn why(topic: &ClaimTopic, claim: &Claim, judgement: &Judgement, condition: &RunCondition) -> String {
    let mut reasons: Vec<String> = Vec::new();
    match judgement.verdict {
        Verdict::Reproduced => {}
        Verdict::Near => reasons.extend(distance(claim, &judgement.findings)),
        Verdict::NotRun => reasons.push(NOT_RUN.to_owned()),
        Verdict::OrderReproduced | Verdict::NotReproduced => {
            reasons.extend(distance(claim, &judgement.findings));
            reasons.extend(order(judgement));
            let known = known(topic, claim, judgement, condition);
            if known.is_empty() && judgement.verdict == Verdict::NotReproduced {
                reasons.push("Cause unknown.".to_owned());
            }
            reasons.extend(known);
        }
    }
    reasons.extend(absent(claim, judgement));
    if !judgement.firm {
        reasons.push("Our interval crosses the limit of this verdict; more runs would decide.".to_owned());
    }
    reasons.join(" ")
}

/// Lists the policies in the comparison of the order.
fn order(judgement: &Judgement) -> Vec<String> {
    let names = |wanted: bool| {
        let mut places: Vec<(&str, Vec<String>)> = Vec::new();
        for (n, other, _) in judgement.order.iter().filter(|(_, _, same)| *same == wanted) {
            match places.iter_mut().find(|(known, _)| known == other) {
                Some((_, sizes)) => sizes.push(n.to_string()),
                None => places.push((*other, vec![n.to_string()])),
            }
        }
        let names = places
            .iter()
            .map(|(other, sizes)| format!("{other} (N = {})", sizes.join(", ")));
        names.collect::<Vec<_>>().join(", ")
    };
    let mut sentences = Vec::new();
    for (wanted, side) in [(true, "On"), (false, "Not on")] {
        let names = names(wanted);
        if !names.is_empty() {
            sentences.push(format!("{side} the paper's side of {names}."));
        }
    }
    sentences
}

/// Lists the policies of the claim's comparison that were not run; `None` if none or all of them were run.
fn absent(claim: &Claim, judgement: &Judgement) -> Option<String> {
    let ClaimQuantity::Ratio(others) = claim.quantity else {
        return None;
    };
    let is_absent = |other: &&&str| !judgement.findings.iter().any(|f| f.other == Some(**other));
    let absent: Vec<&str> = others.iter().filter(is_absent).copied().collect();
    let is_told = !absent.is_empty() && judgement.verdict != Verdict::NotRun;
    is_told.then(|| format!("Without {} (not run here).", absent.join(", ")))
}

/// Lists the causes known from the claims or from our own metrics.
fn known(topic: &ClaimTopic, claim: &Claim, judgement: &Judgement, condition: &RunCondition) -> Vec<String> {
    let mut reasons = Vec::new();
    if !claim.caveat.is_empty() {
        reasons.push(claim.caveat.to_owned());
    }
    let (Some((low, high)), ClaimQuantity::Own | ClaimQuantity::Ratio(_)) = (claim.statement.range(), claim.quantity)
    else {
        return reasons;
    };
    let (is_under, is_over) = (
        judgement.findings.iter().find(|f| f.value < low),
        judgement.findings.iter().find(|f| f.value > high),
    );
    // Empty batteries explain too little information or energy and too many misses, never the opposite.
    let starved = match topic.metric {
        "info_p1" | "info_per_event" | "energy_per_device_tti" | "mean_battery" => is_under,
        "misdetection_pct" | "wrong_activations_per_event" => is_over,
        _ => None,
    };
    let low_energy = starved.and_then(|f| Some((f.n, condition.estimate(claim.policy, f.n, "low_energy_pct")?.mean)));
    if let Some((n, share)) = low_energy.filter(|(_, share)| *share >= MOST_ARE_LOW) {
        reasons.push(format!(
            "Batteries are empty: at N = {n}, {} % of the devices are below E_Tx at the end of a TTI.",
            number(share)
        ));
    }
    let events = condition.scenario.as_ref().map(|scenario| &scenario.events);
    let lasts = events.and_then(|events| match events.longest() {
        Some(1) => None,
        Some(longest) => Some(format!("up to {longest} TTIs")),
        None => Some(format!("{} TTIs on average", events.duration)),
    });
    let is_missed = topic.metric == "misdetection_pct" && claim.quantity == ClaimQuantity::Own && is_under.is_some();
    if let Some(lasts) = lasts.filter(|_| is_missed) {
        reasons.push(format!(
            "An event lasts {lasts} here and is missed only if none of them brings a report."
        ));
    }
    reasons
}

/// Cause for a policy without runs.
pub(super) const NOT_RUN: &str = "The tables hold no such runs.";
