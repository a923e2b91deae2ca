//! Tests of [`TOPICS`]: the claims are compared with the numbers and sentences printed in the paper, the numbers of
//! caveats and contradictions with independent calculations. Not checked: whether a claim is understood correctly.

use std::collections::BTreeSet;

use reveille_common::score::Metrics;

use super::DeviceCounts::{All, At, Over, Under, UpTo};
use super::*;
use crate::analysis::harvest::STATED_THRESHOLDS;

/// The sentences of the paper on results, each with its numbers (`%` as printed) and the N that it names. Transcribed
/// from the text independently of the claims.
const PRINTED: &[(&str, &[f64], &[u32])] = &[
    ("Abstract, 8th sentence", &[], &[]),
    ("Abstract, 9th sentence", &[], &[]),
    ("Sec. I-B, 3rd contribution", &[4.5, 23.0], &[]),
    ("Sec. VI, on the benchmarks, 6th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 1st sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 3rd sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 4th sentence", &[0.4, 0.72], &[]),
    ("Sec. VI-A, on Fig. 7, 5th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 6th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 7th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 7, 8th sentence", &[], &[50]),
    ("Sec. VI-A, on Fig. 8, 2nd sentence", &[0.45, 0.83, 0.34], &[10]),
    ("Sec. VI-A, on Fig. 8, 3rd sentence", &[0.145], &[]),
    ("Sec. VI-A, on Fig. 8, 4th sentence", &[0.18, 29.0], &[]),
    ("Sec. VI-A, on Fig. 8, 5th sentence", &[0.24, 0.32], &[]),
    ("Sec. VI-A, on Fig. 8, 6th sentence", &[], &[180]),
    ("Sec. VI-A, on Fig. 8, 7th sentence", &[40.0, 10.0], &[]),
    ("Sec. VI-A, on Fig. 8, 8th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 8, 9th sentence", &[0.055], &[]),
    ("Sec. VI-A, on Fig. 9, 2nd sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 9, 3rd sentence", &[33.0, 58.0, 77.0], &[10]),
    ("Sec. VI-A, on Fig. 9, 4th sentence", &[0.01], &[]),
    ("Sec. VI-A, on Fig. 9, 5th sentence", &[7.0], &[250]),
    ("Sec. VI-A, on Fig. 9, 6th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 9, 7th sentence", &[200.0, 2.0], &[200]),
    ("Sec. VI-A, on Fig. 9, 8th sentence", &[2.0, 0.003], &[]),
    ("Sec. VI-A, on Fig. 9, 11th sentence", &[0.001], &[]),
    ("Sec. VI-A, on Figs. 10 and 11, 3rd sentence", &[], &[]),
    (
        "Sec. VI-A, on Figs. 10 and 11, 4th sentence",
        &[67.0, 8.0, 13.0],
        &[10, 250],
    ),
    ("Sec. VI-A, on Figs. 10 and 11, 5th sentence", &[10.0, 72.0, 86.0], &[]),
    (
        "Sec. VI-A, on Figs. 10 and 11, 6th sentence",
        &[30.0, 45.0, 31.0, 54.0],
        &[],
    ),
    ("Sec. VI-A, on Figs. 10 and 11, 7th sentence", &[50.0, 40.0, 88.0], &[]),
    ("Sec. VI-A, on Fig. 12, 4th sentence", &[0.0], &[]),
    ("Sec. VI-A, on Fig. 12, 5th sentence", &[], &[]),
    ("Sec. VI-A, on Fig. 12, 6th sentence", &[17.0, 9.5, 6.0], &[]),
    ("Sec. VI-A, on Fig. 12, 7th sentence", &[50.0, 1.5], &[]),
    ("Sec. VI-B, on Fig. 13, 5th sentence", &[], &[10, 250]),
    ("Sec. VI-B, on Fig. 13, 6th sentence", &[0.15, 0.3, 0.4, 0.9], &[]),
    ("Sec. VI-B, on Fig. 13, 7th sentence", &[0.05, 0.02, 0.09, 0.05], &[]),
    ("Sec. VI-B, on Fig. 14, 2nd sentence", &[], &[100]),
    ("Sec. VI-B, on Fig. 14, 4th sentence", &[0.38, 0.23], &[]),
    (
        "Sec. VI-B, on Fig. 14, 5th sentence",
        &[0.052, 0.096, 0.023, 0.048],
        &[],
    ),
    ("Sec. VII, 6th sentence", &[4.5, 23.0], &[]),
];

/// Numbers that we chose for words in a sentence: as much as, and not near.
const NUMBERS_FOR_WORDS: [f64; 2] = [1.0, 0.8];

fn all_claims() -> impl Iterator<Item = (&'static ClaimTopic, &'static Claim)> {
    let claims_of = |topic: &'static ClaimTopic| topic.claims.iter().map(move |claim| (topic, claim));
    TOPICS.iter().flat_map(claims_of)
}

/// Returns whether a claim's `value` represents the `printed` number: the number itself, a change in per cent, a share,
/// or a factor for a gain in per cent.
fn represents(value: f64, printed: f64) -> bool {
    let forms = [printed, 1.0 - printed / 100.0, 1.0 + printed / 100.0, printed / 100.0];
    forms.iter().any(|form| (form - value).abs() < 1e-12)
}

/// Returns whether `claim` cites `place`, the text of a citation, as its first or its second place.
fn cites(claim: &Claim, place: &str) -> bool {
    claim.citation.to_string() == place || claim.second_citation.is_some_and(|second| second.to_string() == place)
}

/// Returns the numbers that claims take from the sentence at `place`.
fn numbers_claimed(place: &str) -> Vec<f64> {
    let claims = all_claims().filter(|(_, claim)| cites(claim, place));
    let numbers = claims.flat_map(|(_, claim)| claim.statement.values());
    let lambdas = STATED_THRESHOLDS
        .iter()
        .filter(|stated| stated.citation.to_string() == place);
    let lambdas = lambdas.flat_map(|stated| stated.ends().map(|end| end.lambda));
    numbers.chain(lambdas).collect()
}

#[test]
fn each_number_of_a_claim_is_printed_in_its_sentence() {
    let printed_numbers = |place: &str| {
        let sentence = PRINTED.iter().find(|(printed_place, ..)| *printed_place == place);
        sentence.unwrap_or_else(|| panic!("{place} is not in PRINTED")).1
    };
    for (_, claim) in all_claims() {
        let printed = printed_numbers(&claim.citation.to_string());
        for value in claim.statement.values() {
            let stands_for_words =
                matches!(claim.quantity, ClaimQuantity::Ratio(_)) && NUMBERS_FOR_WORDS.contains(&value);
            assert!(
                stands_for_words || printed.iter().any(|number| represents(value, *number)),
                "{claim:?}"
            );
        }
        // The second place must be transcribed too, but need not contain the number.
        if let Some(second) = claim.second_citation {
            printed_numbers(&second.to_string());
        }
    }
    for stated in &STATED_THRESHOLDS {
        let printed = printed_numbers(&stated.citation.to_string());
        assert!(stated.ends().all(|end| printed.contains(&end.lambda)), "{stated:?}");
    }
}

#[test]
fn each_printed_number_is_in_a_claim() {
    for (place, numbers, device_counts) in PRINTED {
        let claimed = numbers_claimed(place);
        for number in *numbers {
            assert!(
                claimed.iter().any(|value| represents(*value, *number)),
                "{place}: no claim has the number {number}"
            );
        }
        for n in *device_counts {
            let names_n = |claim: &Claim| match claim.device_counts {
                At(limit) | Under(limit) | UpTo(limit) | Over(limit) => limit == *n,
                All => false,
            };
            assert!(
                all_claims().any(|(_, claim)| names_n(claim) && cites(claim, place)),
                "{place}: no claim for N = {n}"
            );
        }
    }
}

#[test]
fn each_sentence_with_results_has_a_claim() {
    for (place, ..) in PRINTED {
        let is_on_lambda = STATED_THRESHOLDS
            .iter()
            .any(|stated| stated.citation.to_string() == *place);
        assert!(
            is_on_lambda || all_claims().any(|(_, claim)| cites(claim, place)),
            "{place}"
        );
    }
}

#[test]
fn claims_name_existing_metrics_and_policies() {
    let is_known = |policy: &str| POLICIES.contains(&policy);
    for (topic, claim) in all_claims() {
        assert!(Metrics::NAMES.contains(&topic.metric), "{}", topic.metric);
        assert!(is_known(claim.policy), "{claim:?}");
        match claim.quantity {
            ClaimQuantity::Mean => {}
            ClaimQuantity::Ratio(others) => {
                let others: BTreeSet<&str> = others.iter().copied().collect();
                assert!(
                    !others.is_empty() && others.iter().all(|other| is_known(other)),
                    "{claim:?}"
                );
                assert!(!others.contains(claim.policy), "{claim:?}");
            }
            ClaimQuantity::Gap(other) => assert!(is_known(other) && other != claim.policy, "{claim:?}"),
            ClaimQuantity::Growth(n) => assert!(claim.device_counts != At(n) && All.contains(n), "{claim:?}"),
        }
        if let Some((low, high)) = claim.statement.range() {
            assert!(low <= high, "{claim:?}");
        }
    }
}

#[test]
fn claims_are_distinct() {
    for topic in TOPICS {
        for (i, claim) in topic.claims.iter().enumerate() {
            let is_same = |other: &Claim| {
                (claim.policy, claim.device_counts, claim.quantity, claim.statement)
                    == (other.policy, other.device_counts, other.quantity, other.statement)
            };
            assert!(!topic.claims[..i].iter().any(is_same), "{}: {claim:?}", topic.metric);
        }
    }
}

#[test]
fn a_contradiction_cites_an_existing_sentence() {
    for (_, claim) in all_claims() {
        let Some(Contradiction { other_citation, .. }) = claim.contradicts else {
            continue;
        };
        let is_printed = PRINTED.iter().any(|(place, ..)| *place == other_citation.to_string());
        assert!(is_printed || other_citation == citation::PARAMETERS, "{claim:?}");
        assert!(other_citation != claim.citation, "{claim:?}");
    }
}

#[test]
fn device_counts_end_at_their_bounds() {
    assert!(Under(200).contains(199) && !Under(200).contains(200));
    assert!(UpTo(50).contains(50) && !UpTo(50).contains(51));
    assert!(Over(180).contains(181) && !Over(180).contains(180));
    assert!(At(10).contains(10) && !At(10).contains(11));
    for device_counts in [Under(200), UpTo(50), All, Over(180)] {
        assert!(
            !device_counts.contains(9) && !device_counts.contains(251),
            "{device_counts:?} exceeds the axis of the paper's figures"
        );
    }
}

#[test]
fn citations_have_ordinals() {
    let place = |n| FIG_8.sentence(n).to_string();
    for (n, ordinal) in [
        (1, "1st"),
        (2, "2nd"),
        (3, "3rd"),
        (4, "4th"),
        (11, "11th"),
        (22, "22nd"),
    ] {
        assert_eq!(place(n), format!("Sec. VI-A, on Fig. 8, {ordinal} sentence"));
    }
    assert_eq!(FIG_8.to_string(), "Sec. VI-A, on Fig. 8");
}

#[test]
fn numbers_in_caveats_and_contradictions_equal_independent_calculations() {
    // A regular hexagon of 400 / 250 m²: its apothem is √(area / 2√3), and ∫ r e^-r dr from 0 to R is 1 − (1 + R) e^-R.
    let area = 400.0 / 250.0;
    let apothem = libm::sqrt(area / (2.0 * libm::sqrt(3.0)));
    let steps = 10_000;
    let integrals = (0..steps).map(|i| {
        let angle = std::f64::consts::FRAC_PI_6 * (f64::from(i) + 0.5) / f64::from(steps);
        let reach = apothem / libm::cos(angle);
        1.0 - (1.0 + reach) * libm::exp(-reach)
    });
    let sum: f64 = integrals.sum();
    let mean_information = 12.0 * std::f64::consts::FRAC_PI_6 * sum / f64::from(steps) / area;
    assert!(
        claim::CLOSEST_DEVICE.contains(&format!("{mean_information:.2} in the best possible layout")),
        "mean information {mean_information}"
    );
    // t_on of 1 or 2 in t_DRX of 2, 4 or 8, sensing at 1 unit and sleeping at 1/14.
    let shares = [1.0, 2.0].map(|on| [2.0, 4.0, 8.0].map(|cycle| on / cycle));
    let sensing_share = shares.as_flattened().iter().sum::<f64>() / 6.0;
    let consumption = sensing_share + (1.0 - sensing_share) / 14.0;
    assert!(
        claim::FIXED_CYCLE.contains(&format!("sense in {sensing_share:.2} of all TTIs"))
            && claim::FIXED_CYCLE.contains(&format!("about {consumption:.2} units")),
        "share {sensing_share}, consumption {consumption}"
    );
    let reasons = || all_claims().filter_map(|(_, claim)| claim.contradicts.map(|contradiction| contradiction.reason));
    for statement in [
        format!("0.18 is {:.0} % more than 0.145", 100.0 * (0.18 / 0.145 - 1.0)),
        format!("more than {:.3}", 1.29 * 0.145),
        format!("40 % below q-learning's 0.24 is {:.3}", 0.6 * 0.24),
        // 0.1305, rounded up.
        format!("10 % below knn's 0.145 is {:.3}", 0.9 * 0.145 + 1e-6),
        format!("are {:.1}, {:.2} and less than {}", 0.5 * 17.0, 0.5 * 9.5, 0.5 * 6.0),
    ] {
        assert!(reasons().any(|reason| reason.contains(&statement)), "{statement}");
    }
}
