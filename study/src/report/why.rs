//! What is known of why a claim is not met, in sentences.

use reveille_bs::policy::registry;

use super::judge::{Judgement, Verdict};
use super::words::{distance, number};
use crate::claims::{Claim, Relation, Topic};
use crate::figures::results::Condition;

/// From which share of devices on, %, batteries count as a reason.
const MOST_ARE_LOW: f64 = 50.0;

/// Why `claim` has this verdict; empty where there is nothing to say.
pub fn why(topic: &Topic, claim: &Claim, judgement: &Judgement, condition: &Condition) -> String {
    let mut reasons: Vec<String> = Vec::new();
    match judgement.verdict {
        Verdict::Reproduced => reasons.extend(outside(claim, judgement)),
        Verdict::NotRun => reasons.push(not_run(claim.policy)),
        Verdict::OrderReproduced | Verdict::NotReproduced => {
            reasons.extend(distance(claim.relation, &judgement.findings));
            reasons.extend(order(judgement));
            let known = known(topic, claim, judgement, condition);
            if known.is_empty() && judgement.verdict == Verdict::NotReproduced {
                reasons.push("We do not know why.".to_owned());
            }
            reasons.extend(known);
        }
    }
    if !judgement.firm {
        reasons.push("Our interval reaches across the border of this verdict: more runs would decide.".to_owned());
    }
    reasons.join(" ")
}

/// That a reproduced range is met by its tolerance alone.
fn outside(claim: &Claim, judgement: &Judgement) -> Option<String> {
    let Relation::Between(low, high) = claim.relation else {
        return None;
    };
    let is_outside = judgement.findings.iter().any(|f| !(low..=high).contains(&f.value));
    is_outside.then(|| "Outside the stated range, within 20 %.".to_owned())
}

/// With which policies the order was compared.
fn order(judgement: &Judgement) -> Vec<String> {
    if judgement.order.is_empty() {
        return vec!["The tables and the paper hold no other figure to compare the order with.".to_owned()];
    }
    let names = |wanted: bool| {
        let own = judgement.order.iter().filter(|(_, _, same)| *same == wanted);
        let names: Vec<String> = own.map(|(n, other, _)| format!("{other} (N = {n})")).collect();
        names.join(", ")
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

/// The reasons that the claims or our own metrics know.
fn known(topic: &Topic, claim: &Claim, judgement: &Judgement, condition: &Condition) -> Vec<String> {
    let mut reasons = Vec::new();
    for text in [claim.caveat, topic.remark] {
        if !text.is_empty() {
            reasons.push(text.to_owned());
        }
    }
    let Some((low, high)) = claim.relation.range() else {
        return reasons;
    };
    let (is_under, is_over) = (
        judgement.findings.iter().find(|f| f.value < low),
        judgement.findings.iter().find(|f| f.value > high),
    );
    let starved = match topic.metric {
        "info_per_event" | "energy_per_device_tti" | "mean_battery" => is_under,
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
    if let Some(lasts) = lasts.filter(|_| topic.metric == "misdetection_pct" && is_under.is_some()) {
        reasons.push(format!(
            "An event lasts {lasts} here and is missed only if no report comes in any of them."
        ));
    }
    reasons
}

/// Why there are no runs of `policy`.
pub(super) fn not_run(policy: &str) -> String {
    if registry::named(policy).is_some() {
        "The tables hold no such runs.".to_owned()
    } else {
        format!("The policy {policy} is not built yet.")
    }
}
