//! The claims on λ (Figs. 13 and 14): the λ from which on a device harvests more than it spends. They become rows of
//! the report like the claims of [`crate::claims`], but follow a separate rule. `notes` reads the policy from the text
//! of a row, up to the comma. docs/reproduction.md contains the texts.
//!
//! As in the paper, consumption is held fixed at a policy's spending in the tables (Fig. 8) while λ varies. The
//! policies are those that the paper names at the ends of its ranges, regardless of their rank in our runs.

use reveille_bs::scenario::Scenario;
use reveille_common::harvest::HarvestKind;

use super::causes::{NOT_FIRM, NOT_RUN};
use super::claim_rows::{Assessment, ClaimRow, ConditionColumn};
use super::judge::{AgreementLevel, Verdict, agreement_with_value, verdict_of};
use super::phrasing::{format_exact, format_number, format_plus_minus};
use crate::analysis::harvest::{
    LambdaReading, STATED_THRESHOLDS, StatedEnd, StatedThreshold, lambdas_with_positive_net,
};
use crate::figures::energy::extreme_consumptions;
use crate::figures::results::RunCondition;
use reveille_lab::stats::Estimate;

/// Metric that is held fixed. [`extreme_consumptions`] ranks policies by it too.
const CONSUMPTION_METRIC: &str = "energy_per_device_tti";
/// Reading of a single λ.
const SINGLE_LAMBDA: &str = "A single λ, \"as low as\", is read as the λ of the policy that spends least.";

/// All claims on λ.
pub(super) fn claim_rows(columns: &[ConditionColumn<'_>]) -> Vec<ClaimRow> {
    let rows_of = |stated: &'static StatedThreshold| {
        // The first end has the least consumption, the second the most.
        let ends = stated.ends().enumerate();
        ends.map(move |(index, stated_end)| claim_row(stated, index == 1, stated_end, columns))
    };
    let mut rows: Vec<ClaimRow> = STATED_THRESHOLDS.iter().flat_map(rows_of).collect();
    // The report groups neighbouring rows, and statements on Fig. 14 lie between statements on Fig. 13.
    rows.sort_by_key(|row| row.paper_figure);
    rows
}

/// Whether a claim on λ concerns the runs of `condition`.
pub(super) fn has_claims_on(condition: &RunCondition) -> bool {
    let mut ends = STATED_THRESHOLDS
        .iter()
        .flat_map(|stated| stated.ends().map(|end| (stated.devices, end.policy)));
    ends.any(|(n, policy)| condition.estimate(policy, n, CONSUMPTION_METRIC).is_some())
}

fn claim_row(
    stated: &'static StatedThreshold,
    spends_most: bool,
    stated_end: StatedEnd,
    columns: &[ConditionColumn<'_>],
) -> ClaimRow {
    let rank = if spends_most { "most" } else { "least" };
    ClaimRow {
        paper_figure: stated.paper_figure,
        metric_description: format!("λ above which net energy is positive, E_B = {}", stated.e_b),
        policy: format!("{}, spends {rank}", stated_end.policy),
        device_counts: format!("N = {}", stated.devices),
        stated: format!("≈ {}", format_exact(stated_end.lambda)),
        citation: stated.citation,
        second_citation: None,
        metric_reason: "",
        interpretation: if stated.most_consumption.is_none() {
            SINGLE_LAMBDA
        } else {
            ""
        },
        contradicts: stated.contradicts,
        assessments: columns
            .iter()
            .map(|column| assess(stated, spends_most, stated_end, column))
            .collect(),
    }
}

fn assess(
    stated: &StatedThreshold,
    spends_most: bool,
    stated_end: StatedEnd,
    column: &ConditionColumn<'_>,
) -> Assessment {
    let not_run = |explanation: String| Assessment {
        measured: String::new(),
        verdict: Verdict::NotRun,
        is_firm: true,
        explanation,
        deviation: f64::INFINITY,
    };
    let condition = column.condition;
    let Some(spent) = condition.estimate(stated_end.policy, stated.devices, CONSUMPTION_METRIC) else {
        return not_run(NOT_RUN.to_owned());
    };
    let Some(tau) = condition.scenario.as_ref().and_then(tau_of_eq5) else {
        return not_run(
            "Not comparable: the claim is about Eq. (5), but these runs have another energy source, or their table \
             does not name it."
                .to_owned(),
        );
    };
    let mut assessment = judge_threshold((stated.e_b, tau), stated_end, &spent);
    let note = rank_note(condition, stated.devices, spends_most, stated_end.policy);
    if !note.is_empty() {
        let explanation = format!("{} {note}", assessment.explanation);
        explanation.trim_start().clone_into(&mut assessment.explanation);
    }
    assessment
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
fn rank_note(condition: &RunCondition, n: u32, spends_most: bool, policy: &str) -> String {
    let Some([least, most]) = extreme_consumptions(condition, n) else {
        return String::new();
    };
    let (expected, other, [rank, opposite]) = if spends_most {
        (&most, &least, ["most", "least"])
    } else {
        (&least, &most, ["least", "most"])
    };
    if expected.0 == policy {
        return String::new();
    }
    let actual = if other.0 == policy {
        format!("it spends {opposite} of all")
    } else {
        "it spends neither the most nor the least".to_owned()
    };
    format!(
        "In the paper {policy} spends {rank}; here {actual}, and {} spends {rank}, {} units.",
        expected.0,
        format_number(expected.1.mean)
    )
}

/// Judges the λ that `stated_end` states by the λ from which on the harvest under Eq. (5) exceeds `spent`, units per
/// device and TTI. The sentences about E_B/e and λ·exp(-λ) hold for τ = 1, as in the paper.
fn judge_threshold((e_b, tau): (f64, f64), stated_end: StatedEnd, spent: &Estimate) -> Assessment {
    let StatedEnd {
        lambda: stated_lambda,
        policy,
    } = stated_end;
    // `lambdas_with_positive_net` needs a consumption above 0, but the interval may reach below it.
    let threshold = |units: f64| {
        lambdas_with_positive_net(LambdaReading::Eq5, e_b, units.max(f64::MIN_POSITIVE), tau).map(|(from, _)| from)
    };
    // The interval of one run is unknown: its half-width is NaN.
    let is_one_run = spent.half_width.is_nan();
    let (low, high) = (
        threshold(spent.mean - spent.half_width),
        threshold(spent.mean + spent.half_width),
    );
    let Some(lambda) = threshold(spent.mean) else {
        let max_harvest = e_b * LambdaReading::Eq5.probability(1.0 / tau, tau);
        return Assessment {
            measured: "never".to_owned(),
            verdict: Verdict::NotReproduced,
            is_firm: low.is_none() && !is_one_run,
            explanation: format!(
                "{policy} spends {} units, but under Eq. (5) the harvest is at most E_B/e = {}. The paper's values fit \
                 a harvest of about λ·E_B, to which λ·exp(-λ)·E_B is close for small λ only.",
                format_number(spent.mean),
                format_number(max_harvest)
            ),
            deviation: f64::INFINITY,
        };
    };
    let agreement = agreement_with_value(lambda, stated_lambda);
    let measured = match (low, high) {
        _ if is_one_run => format_plus_minus(lambda, f64::NAN),
        (Some(low), Some(high)) => format_plus_minus(lambda, 0.5 * (high - low)),
        (Some(_) | None, None) | (None, Some(_)) => format!("{}, perhaps never", format_number(lambda)),
    };
    let is_firm = !is_one_run
        && low.zip(high).is_some_and(|(a, b)| {
            agreement_with_value(a, stated_lambda) == agreement && agreement_with_value(b, stated_lambda) == agreement
        });
    let doubt = if is_firm { "" } else { NOT_FIRM };
    let explanation = if agreement == AgreementLevel::Yes {
        doubt.to_owned()
    } else {
        let stated_consumption = e_b * LambdaReading::Eq5.probability(stated_lambda, tau);
        let text = format!(
            "{policy} spends {} units here; the paper's λ corresponds to a consumption of {}. {doubt}",
            format_number(spent.mean),
            format_number(stated_consumption)
        );
        text.trim_end().to_owned()
    };
    Assessment {
        measured,
        verdict: verdict_of(agreement).unwrap_or(Verdict::NotReproduced),
        is_firm,
        explanation,
        deviation: if agreement == AgreementLevel::Yes {
            0.0
        } else {
            libm::log(lambda / stated_lambda).abs()
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_run_gives_no_firm_verdict() {
        let end = StatedEnd {
            lambda: 0.1,
            policy: "knn",
        };
        let (e_b, tau) = (5.0, 1.0);
        // Under Eq. (5), some λ harvests 0.2 units and no λ harvests 5 units.
        for spent in [0.2, 5.0] {
            let judge_with = |spent: &[f64]| {
                let spent = Estimate::from_values(spent.iter().copied()).expect("a run");
                judge_threshold((e_b, tau), end, &spent)
            };
            let (one_run, two_runs) = (judge_with(&[spent]), judge_with(&[spent, spent * 1.001]));
            assert!(!one_run.is_firm && two_runs.is_firm, "{one_run:?} {two_runs:?}");
            assert!(!one_run.measured.contains('±'), "{one_run:?}");
        }
    }
}
