//! Tests of [`ConditionRanking`] on sweeps of α whose order of conditions is known: energies as in the paper, close to
//! it and far from it. The energies rely on the claims in `study/src/claims/energy.rs`.

use reveille_common::declare::NoFiles;
use reveille_lab::table::{SweptValue, Table};

use super::*;
use crate::figures::results::{Results, fixtures};
use crate::report::search::markdown::markdown;

/// Creates a sweep of α with energies in the order of [`AS_STATED`], and 0.1 % more in the second run.
fn alpha_sweep(conditions: &[(f64, [f64; 4])]) -> (String, Table) {
    let mut runs: Vec<(&str, u32, SweptValue, Vec<f64>)> = Vec::new();
    for (alpha, [knn_few, knn_many, random_few, random_many]) in conditions {
        for (policy, n, energy) in [
            ("knn", 10, knn_few),
            ("knn", 250, knn_many),
            ("random", 10, random_few),
            ("random", 250, random_many),
        ] {
            runs.push((policy, n, SweptValue::Float(*alpha), vec![*energy, *energy * 1.001]));
        }
    }
    let runs: Vec<(&str, u32, SweptValue, &[f64])> = runs
        .iter()
        .map(|(policy, n, alpha, values)| (*policy, *n, alpha.clone(), values.as_slice()))
        .collect();
    fixtures::swept("paper", "energy_per_device_tti", "events.alpha", &runs)
}

/// Energies of knn at N = 10 and 250 and of random at both: as in the paper, close to it, and far from it.
const AS_STATED: [f64; 4] = [0.5, 0.145, 0.34, 0.19];
const CLOSE: [f64; 4] = [0.5, 0.165, 0.39, 0.25];
const FAR: [f64; 4] = [0.9, 0.95, 0.9, 0.1];

fn results_of(conditions: &[(f64, [f64; 4])]) -> Results {
    Results::new(&[alpha_sweep(conditions)], &NoFiles).expect("runs")
}

fn ranked_alphas(ranking: &ConditionRanking<'_>) -> Vec<String> {
    let values = ranking
        .conditions
        .iter()
        .map(|ranked| ranking.value(ranked.column, "events.alpha"));
    values.map(|value| value.unwrap_or("–").to_owned()).collect()
}

#[test]
fn conditions_that_meet_more_claims_come_first() {
    let results = results_of(&[(0.3, FAR), (0.1, CLOSE), (0.4, AS_STATED)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    assert_eq!(ranked_alphas(&ranking), ["0.4", "0.1", "0.3"]);
    let ranks: Vec<usize> = ranking.conditions.iter().map(|ranked| ranked.rank).collect();
    assert_eq!(ranks, [1, 2, 3]);
    let met: Vec<usize> = ranking.conditions.iter().map(|ranked| ranked.search.met).collect();
    assert!(met[0] > met[1] && met[1] > met[2], "{met:?}");
}

#[test]
fn a_score_counts_the_verdicts_of_its_half_of_the_claims() {
    let results = results_of(&[(0.3, FAR), (0.4, AS_STATED)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    for ranked in &ranking.conditions {
        let (mut even, mut odd) = ([0; 3], [0; 3]);
        for (index, row) in ranking.report.rows.iter().enumerate() {
            // The first claim has number 1, so the second is the first even one.
            let half = if index % 2 == 1 { &mut even } else { &mut odd };
            match row.assessments[ranked.column].verdict {
                Verdict::Reproduced => (half[0], half[2]) = (half[0] + 1, half[2] + 1),
                Verdict::Near => (half[1], half[2]) = (half[1] + 1, half[2] + 1),
                Verdict::OrderReproduced | Verdict::NotReproduced => half[2] += 1,
                Verdict::NotRun => {}
            }
        }
        let HalfScore { met, near, judged } = ranked.search;
        assert_eq!([met, near, judged], even);
        let HalfScore { met, near, judged } = ranked.held_out;
        assert_eq!([met, near, judged], odd);
        // Enough claims to show a wrong half; the limit is chosen freely.
        assert!(
            even[2] > 5 && odd[2] > 5,
            "too few claims with runs: even {even:?}, odd {odd:?}"
        );
    }
}

/// Returns the columns in order of rank, after the verdicts of one half are set to the worst.
fn columns_ranked_without(ranking: &ConditionRanking<'_>, half: ClaimHalf) -> Vec<usize> {
    let mut report = ranking.report.clone();
    for (number, row) in (1..).zip(&mut report.rows) {
        if ClaimHalf::of_number(number) == half {
            for assessment in &mut row.assessments {
                assessment.verdict = Verdict::NotReproduced;
                assessment.deviation = f64::INFINITY;
            }
        }
    }
    let conditions = ConditionRanking::new(report).conditions;
    conditions.into_iter().map(|ranked| ranked.column).collect()
}

#[test]
fn the_held_out_half_does_not_affect_the_ranking() {
    let results = results_of(&[(0.3, FAR), (0.1, CLOSE), (0.4, AS_STATED)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let ranked: Vec<usize> = ranking.conditions.iter().map(|ranked| ranked.column).collect();
    assert_eq!(columns_ranked_without(&ranking, ClaimHalf::HeldOut), ranked);
    let unranked: Vec<usize> = (0..ranking.conditions.len()).collect();
    assert_eq!(
        columns_ranked_without(&ranking, ClaimHalf::Search),
        unranked,
        "the held-out half changed the ranking"
    );
    assert_ne!(ranked, unranked);
}

#[test]
fn equal_scores_share_a_rank_and_presets_are_always_shown() {
    // α = 0.2 is the value of the preset; the two conditions before it are better and equal.
    let results = results_of(&[(0.3, AS_STATED), (0.4, AS_STATED), (0.2, FAR)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let ranks: Vec<usize> = ranking.conditions.iter().map(|ranked| ranked.rank).collect();
    assert_eq!(ranks, [1, 1, 3]);
    assert_eq!(ranking.label(ranking.conditions[2].column), "paper");
    let shown: Vec<usize> = ranking.conditions_to_show(1).map(|ranked| ranked.rank).collect();
    assert_eq!(shown, [1, 3], "the best and the preset");
    let page = markdown(&ranking, 1, "reveille report search a");
    assert!(page.contains("One more condition is not shown"), "{page}");
}

#[test]
fn unmet_claims_have_the_condition_with_the_closest_value() {
    let random_at_0_10 = [0.5, 0.145, 0.34, 0.10];
    let random_at_0_17 = [0.5, 0.145, 0.34, 0.17];
    let results = results_of(&[(0.3, random_at_0_10), (0.4, random_at_0_17)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let unmet = ranking.unmet();
    let random_claim = unmet
        .iter()
        .find(|unmet| unmet.row.policy == "random" && unmet.row.stated == "> 0.18");
    let random_claim = random_claim.expect("0.1 and 0.17 are not above 0.18");
    assert_eq!(ranking.value(random_claim.closest_column, "events.alpha"), Some("0.4"));
    assert!(
        random_claim.row.assessments[random_claim.closest_column]
            .measured
            .starts_with("0.170"),
        "{random_claim:?}"
    );
    assert!(ranking.report.rows[random_claim.number - 1] == *random_claim.row);
    assert!(
        !unmet
            .iter()
            .any(|unmet| unmet.row.stated == "≈ 0.145" && unmet.row.policy == "knn")
    );
    let counts = ranking.counts();
    assert_eq!(counts.met + counts.unmet + counts.not_run, ranking.report.rows.len());
    assert_eq!(counts.unmet, unmet.len());
    let page = markdown(&ranking, 20, "reveille report search a");
    assert!(
        page.contains(&format!("| {} | Fig. 8 | random | N = 250 |", random_claim.number)),
        "{page}"
    );
}

#[test]
fn the_effect_of_a_value_is_the_mean_over_its_conditions() {
    let results = results_of(&[(0.3, FAR), (0.4, AS_STATED)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let effects = ranking.effects();
    let [first, second] = &effects[..] else {
        panic!("{effects:?}")
    };
    assert_eq!(
        (first.field.as_str(), first.value.as_str(), first.condition_count),
        ("events.alpha", "0.3", 1)
    );
    let best = &ranking.conditions[0];
    assert_eq!(
        (second.value.as_str(), second.most_met_search),
        ("0.4", best.search.met)
    );
    assert!((second.mean_met_search - best.search.met as f64).abs() < 1e-12);
    assert!((second.mean_met_held_out - best.held_out.met as f64).abs() < 1e-12);
}

#[test]
fn the_correlation_of_halves_equals_a_calculation_by_hand() {
    let results = results_of(&[(0.3, FAR), (0.1, CLOSE), (0.4, AS_STATED)]);
    let mut ranking = ConditionRanking::new(ClaimReport::new(&results));
    let met_in_halves = [(1, 2), (2, 4), (3, 9)];
    for (ranked, (search, held_out)) in ranking.conditions.iter_mut().zip(met_in_halves) {
        (ranked.search.met, ranked.held_out.met) = (search, held_out);
    }
    // Deviations -1, 0, 1 and -3, -1, 4: 7 / √(2 · 26).
    let correlation = ranking.correlation().expect("different scores");
    assert!(
        (correlation - 7.0 / 52.0_f64.sqrt()).abs() < 1e-12,
        "correlation {correlation}"
    );
    for ranked in &mut ranking.conditions {
        ranked.held_out.met = 5;
    }
    assert_eq!(ranking.correlation(), None);
}

#[test]
fn page_sections_have_the_tables_of_the_whole_page() {
    let results = results_of(&[(0.3, FAR), (0.4, AS_STATED)]);
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let whole_page = markdown(&ranking, 5, "command");
    for section in super::markdown::search_sections(&ranking, 5, "command") {
        let rows = section.body.lines().filter(|line| line.starts_with("| "));
        assert!(rows.clone().all(|row| whole_page.contains(row)), "{}", section.name);
        assert!(
            !section.body.trim().is_empty() && !section.body.contains("\n## "),
            "{}: {}",
            section.name,
            section.body
        );
    }
}
