//! The claims on λ (Figs. 13 and 14): the λ from which on a device harvests more than it spends.
//!
//! As in the paper, consumption is held fixed at a policy's spending in the tables (Fig. 8) while λ varies. The
//! policies are those that the paper names at the ends of its ranges, regardless of their rank in our runs.

use reveille_bs::scenario::Scenario;
use reveille_common::harvest::HarvestKind;

use super::causes::NOT_RUN;
use super::claim_rows::{Assessment, ClaimRow, ConditionColumn};
use super::judge::{FitLevel, Verdict, about, verdict_of};
use super::phrasing::{number, plain, plus_minus};
use crate::analysis::harvest::{LambdaReading, STATED, StatedEnd, StatedThreshold, positive_net};
use crate::figures::energy::consumption;
use crate::figures::results::RunCondition;
use reveille_lab::stats::Estimate;

/// Metric that is held fixed.
const SPENT: &str = "energy_per_device_tti";
/// Reading of a single λ.
const LONE: &str = "A single λ, \"as low as\", is read as the λ of the policy that spends least.";

/// All claims on λ.
pub(super) fn lines(columns: &[ConditionColumn<'_>]) -> Vec<ClaimRow> {
    let lines = |stated: &'static StatedThreshold| {
        let own = stated.ends().enumerate();
        own.map(move |(end, value)| line(stated, end == 1, value, columns))
    };
    let mut lines: Vec<ClaimRow> = STATED.iter().flat_map(lines).collect();
    // Sections are made of neighbouring lines, and the statements on Fig. 14 lie between those on Fig. 13.
    lines.sort_by_key(|line| line.source);
    lines
}

/// Whether a claim on λ concerns the runs of `condition`.
pub(super) fn concerns(condition: &RunCondition) -> bool {
    let mut ends = STATED
        .iter()
        .flat_map(|stated| stated.ends().map(|end| (stated.devices, end.policy)));
    ends.any(|(n, policy)| condition.estimate(policy, n, SPENT).is_some())
}

fn line(stated: &'static StatedThreshold, is_most: bool, end: StatedEnd, columns: &[ConditionColumn<'_>]) -> ClaimRow {
    let rank = if is_most { "most" } else { "least" };
    ClaimRow {
        source: stated.source,
        about: format!("λ above which net energy is positive, E_B = {}", stated.e_b),
        policy: format!("{}, spends {rank}", end.policy),
        sites: format!("N = {}", stated.devices),
        paper: format!("≈ {}", plain(end.lambda)),
        place: stated.place,
        again: None,
        judged: "",
        reading: if stated.most.is_none() { LONE } else { "" },
        contradicts: stated.contradicts,
        ours: columns
            .iter()
            .map(|column| ours(stated, is_most, end, column))
            .collect(),
    }
}

fn ours(stated: &StatedThreshold, is_most: bool, end: StatedEnd, column: &ConditionColumn<'_>) -> Assessment {
    let none = |why: String| Assessment {
        found: String::new(),
        verdict: Verdict::NotRun,
        firm: true,
        why,
        off: f64::INFINITY,
    };
    let condition = column.condition;
    let Some(spent) = condition.estimate(end.policy, stated.devices, SPENT) else {
        return none(NOT_RUN.to_owned());
    };
    let Some(tau) = condition.scenario.as_ref().and_then(tau_of_eq5) else {
        return none(
            "Not comparable: the claim is about Eq. (5), but these runs have another energy source, or their table \
             does not name it."
                .to_owned(),
        );
    };
    let mut ours = judge((stated.e_b, tau), end, &spent);
    let place = place(condition, stated.devices, is_most, end.policy);
    if !place.is_empty() {
        let why = format!("{} {place}", ours.why);
        why.trim_start().clone_into(&mut ours.why);
    }
    ours
}

/// τ of a scenario in which all devices harvest by Eq. (5); `None` for any other.
fn tau_of_eq5(scenario: &Scenario) -> Option<f64> {
    let is_eq5 = scenario
        .classes
        .iter()
        .all(|class| class.harvest.kind() == HarvestKind::Eq5);
    is_eq5.then_some(scenario.run.tau)
}

/// Returns a note if `policy` is not at the end of our range that the paper assigns to it; empty otherwise.
fn place(condition: &RunCondition, n: u32, is_most: bool, policy: &str) -> String {
    let Some([least, most]) = consumption(condition, n) else {
        return String::new();
    };
    let (own, other, rank) = if is_most {
        (&most, &least, ["most", "least"])
    } else {
        (&least, &most, ["least", "most"])
    };
    if own.0 == policy {
        return String::new();
    }
    let [rank, opposite] = rank;
    let here = if other.0 == policy {
        format!("it spends {opposite} of all")
    } else {
        "it spends neither the most nor the least".to_owned()
    };
    format!(
        "In the paper {policy} spends {rank}; here {here}, and {} spends {rank}, {} units.",
        own.0,
        number(own.1.mean)
    )
}

fn judge((e_b, tau): (f64, f64), end: StatedEnd, spent: &Estimate) -> Assessment {
    let StatedEnd { lambda: stated, policy } = end;
    // `positive_net` needs a consumption above 0, but the interval may reach below it.
    let threshold =
        |spent: f64| positive_net(LambdaReading::Eq5, e_b, spent.max(f64::MIN_POSITIVE), tau).map(|(from, _)| from);
    // The interval of one run is unknown: its half-width is NaN.
    let is_one_run = spent.half_width.is_nan();
    let (low, high) = (
        threshold(spent.mean - spent.half_width),
        threshold(spent.mean + spent.half_width),
    );
    let Some(found) = threshold(spent.mean) else {
        let most = e_b * LambdaReading::Eq5.probability(1.0 / tau, tau);
        return Assessment {
            found: "never".to_owned(),
            verdict: Verdict::NotReproduced,
            firm: low.is_none() && !is_one_run,
            why: format!(
                "{policy} spends {} units, but under Eq. (5) the harvest is at most E_B/e = {}. The paper's values fit \
                 a harvest of about λ·E_B, to which λ·exp(-λ)·E_B is close for small λ only.",
                number(spent.mean),
                number(most)
            ),
            off: f64::INFINITY,
        };
    };
    let fits = about(found, stated);
    let measured = match (low, high) {
        _ if is_one_run => plus_minus(found, f64::NAN),
        (Some(low), Some(high)) => plus_minus(found, 0.5 * (high - low)),
        (Some(_) | None, None) | (None, Some(_)) => format!("{}, perhaps never", number(found)),
    };
    let firm = !is_one_run
        && low
            .zip(high)
            .is_some_and(|(a, b)| about(a, stated) == fits && about(b, stated) == fits);
    let doubt = if firm {
        ""
    } else {
        " Our interval crosses the limit of this verdict; more runs would decide."
    };
    let why = if fits == FitLevel::Yes {
        doubt.trim_start().to_owned()
    } else {
        let needed = e_b * LambdaReading::Eq5.probability(stated, tau);
        format!(
            "{policy} spends {} units here; the paper's λ corresponds to a consumption of {}.{doubt}",
            number(spent.mean),
            number(needed)
        )
    };
    Assessment {
        found: measured,
        verdict: verdict_of(fits).unwrap_or(Verdict::NotReproduced),
        firm,
        why,
        off: if fits == FitLevel::Yes {
            0.0
        } else {
            libm::log(found / stated).abs()
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_run_decides_nothing() {
        let end = StatedEnd {
            lambda: 0.1,
            policy: "knn",
        };
        // Under Eq. (5), some λ harvests 0.2 units and no λ harvests 5 units.
        for spent in [0.2, 5.0] {
            let ours = |spent: &[f64]| {
                judge(
                    (5.0, 1.0),
                    end,
                    &Estimate::from_values(spent.iter().copied()).expect("a run"),
                )
            };
            let (one, two) = (ours(&[spent]), ours(&[spent, spent * 1.001]));
            assert!(!one.firm && two.firm, "{one:?} {two:?}");
            assert!(!one.found.contains('±'), "{one:?}");
        }
    }
}
