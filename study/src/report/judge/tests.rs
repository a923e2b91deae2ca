//! Tests of [`judge`] at the limits of each verdict, by the rule in [`super`]. A table holds the tested values in
//! [`METRIC`]; the paper's claims are not used. The tests in `finding` cover bounds of rare cases.

use reveille_common::declare::NoFiles;

use super::*;
use crate::claims::ClaimQuantity::{Gap, Growth, Mean, Ratio};
use crate::claims::DeviceCounts::{All, At, Under};
use crate::claims::{ClaimQuantity, DeviceCounts, FIG_8, Statement};
use crate::figures::results::{Results, fixtures};

/// Any metric without a count of cases.
const METRIC: &str = "mean_battery";

const fn topic(claims: &'static [Claim]) -> ClaimTopic {
    ClaimTopic {
        metric: METRIC,
        is_per_device: false,
        metric_description: "",
        paper_figure: "",
        metric_reason: "",
        claims,
    }
}

const fn claim(
    policy: &'static str,
    device_counts: DeviceCounts,
    quantity: ClaimQuantity,
    statement: Statement,
) -> Claim {
    Claim::new(policy, device_counts, quantity, statement, FIG_8)
}

/// Creates a claim on the mean of knn at N = 250.
const fn knn_claim(statement: Statement) -> Claim {
    claim("knn", At(250), Mean, statement)
}

const fn knn_is_about(v: f64) -> Claim {
    knn_claim(Statement::About(v))
}

fn judgement_of(topic: &ClaimTopic, runs: &[(&str, u32, &[f64])]) -> Judgement {
    let results = Results::new(&[fixtures::table("paper", METRIC, runs)], &NoFiles).expect("runs");
    judge(topic, &topic.claims[0], &results.conditions[0])
}

/// Returns the verdict on the first of `claims` and whether it is firm, for runs with these values of the metric. The
/// other claims only state an order.
fn verdict(claims: &'static [Claim], runs: &[(&str, u32, &[f64])]) -> (Verdict, bool) {
    let judgement = judgement_of(&topic(claims), runs);
    (judgement.verdict, judgement.is_firm)
}

#[test]
fn a_value_is_met_within_5_percent_and_near_within_20() {
    const ABOUT_TEN: &[Claim] = &[knn_is_about(10.0)];
    const ABOUT_A_TENTH: &[Claim] = &[knn_is_about(0.1)];
    for (value, expected) in [
        (10.5, Verdict::Reproduced),
        (9.5, Verdict::Reproduced),
        (10.500_01, Verdict::Near),
        (9.499_99, Verdict::Near),
        (12.0, Verdict::Near),
        (8.0, Verdict::Near),
        (12.000_01, Verdict::NotReproduced),
        (7.999_99, Verdict::NotReproduced),
    ] {
        assert_eq!(
            verdict(ABOUT_TEN, &[("knn", 250, &[value, value])]).0,
            expected,
            "{value}"
        );
    }
    // The limit itself is near, although 0.1 · 1.2 is not 0.12 in binary.
    assert_eq!(verdict(ABOUT_A_TENTH, &[("knn", 250, &[0.12, 0.12])]).0, Verdict::Near);
}

#[test]
fn ranges_have_a_near_margin_and_bounds_have_none() {
    const RANGE: &[Claim] = &[knn_claim(Statement::Between(10.0, 20.0))];
    const BELOW: &[Claim] = &[knn_claim(Statement::Below(6.0))];
    const ABOVE: &[Claim] = &[knn_claim(Statement::Above(6.0))];
    for (value, expected) in [
        (10.0, Verdict::Reproduced),
        (15.0, Verdict::Reproduced),
        (20.0, Verdict::Reproduced),
        (9.99, Verdict::Near),
        (8.0, Verdict::Near),
        (24.0, Verdict::Near),
        (7.9, Verdict::NotReproduced),
        (24.1, Verdict::NotReproduced),
    ] {
        assert_eq!(verdict(RANGE, &[("knn", 250, &[value; 2])]).0, expected, "{value}");
    }
    for (value, below, above) in [(5.99, true, false), (6.0, false, false), (6.01, false, true)] {
        let verdict_on = |claims| verdict(claims, &[("knn", 250, &[value; 2])]).0;
        let verdict_if = |is_met| {
            if is_met {
                Verdict::Reproduced
            } else {
                Verdict::NotReproduced
            }
        };
        assert_eq!(
            (verdict_on(BELOW), verdict_on(ABOVE)),
            (verdict_if(below), verdict_if(above)),
            "{value}"
        );
    }
}

#[test]
fn a_verdict_is_firm_if_the_interval_stays_on_its_side() {
    const ABOUT_TEN: &[Claim] = &[knn_is_about(10.0)];
    // Two values a and b: the half-width is 12.706 · |a - b| / 2, by Student's t with one degree of freedom.
    for (values, expected) in [
        ([10.1, 10.11], (Verdict::Reproduced, true)),
        ([10.4, 10.43], (Verdict::Reproduced, false)),
        ([10.6, 10.65], (Verdict::Near, false)),
        ([11.9, 11.91], (Verdict::Near, true)),
        ([11.8, 11.9], (Verdict::Near, false)),
        ([12.1, 12.2], (Verdict::NotReproduced, false)),
        ([14.0, 14.1], (Verdict::NotReproduced, true)),
        // The interval includes the whole accepted range around the stated value.
        ([8.0, 14.0], (Verdict::Near, false)),
    ] {
        assert_eq!(verdict(ABOUT_TEN, &[("knn", 250, &values)]), expected, "{values:?}");
    }
    assert_eq!(
        verdict(ABOUT_TEN, &[("knn", 250, &[10.0])]),
        (Verdict::Reproduced, false),
        "one run has no interval"
    );
}

#[test]
fn a_value_far_from_the_stated_one_can_reproduce_the_order() {
    const THREE: &[Claim] = &[
        knn_is_about(10.0),
        claim("random", At(250), Mean, Statement::About(20.0)),
        claim("genie", At(250), Mean, Statement::Below(3.0)),
    ];
    const EQUALS: &[Claim] = &[
        knn_is_about(10.0),
        claim("random", At(250), Mean, Statement::About(10.0)),
    ];
    let verdict_for = |knn, random, genie| {
        let runs: [(&str, u32, &[f64]); 3] = [
            ("knn", 250, &[knn; 2]),
            ("random", 250, &[random; 2]),
            ("genie", 250, &[genie; 2]),
        ];
        verdict(THREE, &runs).0
    };
    assert_eq!(verdict_for(50.0, 60.0, 40.0), Verdict::OrderReproduced);
    assert_eq!(
        verdict_for(50.0, 45.0, 40.0),
        Verdict::NotReproduced,
        "random must be above"
    );
    assert_eq!(
        verdict_for(50.0, 60.0, 55.0),
        Verdict::NotReproduced,
        "genie must be below"
    );
    assert_eq!(
        verdict_for(50.0, 50.0, 40.0),
        Verdict::NotReproduced,
        "equal is not above"
    );
    assert_eq!(
        verdict(THREE, &[("knn", 250, &[50.0; 2])]).0,
        Verdict::NotReproduced,
        "no policy to compare with"
    );
    let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[50.0; 2]), ("random", 250, &[60.0; 2])];
    assert_eq!(
        verdict(EQUALS, &runs).0,
        Verdict::NotReproduced,
        "the paper states no order of equals"
    );
}

#[test]
fn an_order_can_follow_from_a_stated_ratio() {
    // The paper gives no figure for random, only that it is above knn.
    const WITH_RATIO: &[Claim] = &[
        knn_is_about(10.0),
        claim("random", All, Ratio(&["knn"]), Statement::Above(1.0)),
    ];
    let verdict_for = |random: f64| {
        let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[50.0; 2]), ("random", 250, &[random; 2])];
        verdict(WITH_RATIO, &runs).0
    };
    assert_eq!(
        (verdict_for(60.0), verdict_for(40.0)),
        (Verdict::OrderReproduced, Verdict::NotReproduced)
    );
}

#[test]
fn a_ratio_enters_an_order_as_its_multiple_of_the_stated_value() {
    const RATIO: &[Claim] = &[
        knn_is_about(0.4),
        claim("random", At(250), Ratio(&["genie"]), Statement::About(0.25)),
        claim("genie", At(250), Mean, Statement::About(0.8)),
    ];
    let verdict_for = |knn: &[f64], random: &[f64]| {
        verdict(
            RATIO,
            &[("knn", 250, knn), ("random", 250, random), ("genie", 250, &[0.8; 2])],
        )
        .0
    };
    assert_eq!(verdict_for(&[0.2; 2], &[0.1; 2]), Verdict::OrderReproduced);
    assert_eq!(
        verdict_for(&[0.2; 2], &[0.3; 2]),
        Verdict::NotReproduced,
        "random, a quarter of genie, must be below"
    );
}

#[test]
fn an_order_is_firm_if_intervals_are_apart_or_a_pair_is_firmly_wrong() {
    const THREE: &[Claim] = &[
        knn_is_about(10.0),
        claim("random", At(250), Mean, Statement::About(20.0)),
        claim("genie", At(250), Mean, Statement::About(1.0)),
    ];
    let verdict_for = |random: &'static [f64], genie: &'static [f64]| {
        verdict(
            THREE,
            &[
                ("knn", 250, &[50.0, 50.1]),
                ("random", 250, random),
                ("genie", 250, genie),
            ],
        )
    };
    assert_eq!(
        verdict_for(&[60.0, 60.1], &[40.0, 40.1]),
        (Verdict::OrderReproduced, true)
    );
    assert_eq!(
        verdict_for(&[50.2, 50.3], &[40.0, 40.1]),
        (Verdict::OrderReproduced, false)
    );
    assert_eq!(
        verdict_for(&[49.9, 50.0], &[40.0, 40.1]),
        (Verdict::NotReproduced, false)
    );
    assert_eq!(
        verdict_for(&[49.9, 50.0], &[60.0, 60.1]),
        (Verdict::NotReproduced, true)
    );
}

#[test]
fn a_ratio_is_computed_from_the_measured_means() {
    const HALF: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::About(0.5))];
    for (knn, expected) in [
        (5.0, Verdict::Reproduced),
        (6.0, Verdict::Near),
        (4.0, Verdict::Near),
        (6.1, Verdict::OrderReproduced),
        (3.9, Verdict::OrderReproduced),
        (10.1, Verdict::NotReproduced),
    ] {
        let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[knn; 2]), ("random", 250, &[10.0; 2])];
        assert_eq!(verdict(HALF, &runs).0, expected, "{knn}");
    }
    assert_eq!(
        verdict(HALF, &[("knn", 250, &[5.0; 2])]).0,
        Verdict::NotRun,
        "no runs of the other policy"
    );
}

#[test]
fn a_bound_of_1_on_a_ratio_must_hold_for_each_policy() {
    const LESS_THAN_BOTH: &[Claim] = &[claim("knn", All, Ratio(&["random", "genie"]), Statement::Below(1.0))];
    const MORE_THAN_RANDOM: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::Above(1.29))];
    let verdicts_for = |knn: f64| {
        let runs: [(&str, u32, &[f64]); 3] = [
            ("knn", 250, &[knn; 2]),
            ("random", 250, &[10.0; 2]),
            ("genie", 250, &[8.0; 2]),
        ];
        (verdict(LESS_THAN_BOTH, &runs).0, verdict(MORE_THAN_RANDOM, &runs).0)
    };
    assert_eq!(verdicts_for(7.0), (Verdict::Reproduced, Verdict::NotReproduced));
    assert_eq!(
        verdicts_for(9.0),
        (Verdict::NotReproduced, Verdict::NotReproduced),
        "above genie"
    );
    assert_eq!(
        verdicts_for(12.0).1,
        Verdict::OrderReproduced,
        "more than random, but not 29 % more"
    );
    assert_eq!(verdicts_for(13.0).1, Verdict::Reproduced);
}

#[test]
fn pairs_of_seeds_make_an_order_firm_despite_the_spread() {
    const LESS: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::Below(1.0))];
    let verdict_for =
        |random: &'static [f64]| verdict(LESS, &[("knn", 250, &[10.0, 20.0, 30.0]), ("random", 250, random)]);
    assert_eq!(verdict_for(&[10.6, 20.7, 30.8]), (Verdict::Reproduced, true));
    assert_eq!(verdict_for(&[30.8, 10.6, 20.7]), (Verdict::Reproduced, false));
}

#[test]
fn up_to_is_the_largest_value_over_n() {
    const MOST: &[Claim] = &[claim("knn", All, Ratio(&["random"]), Statement::Largest(4.5))];
    const LEAST: &[Claim] = &[claim("knn", All, Ratio(&["random"]), Statement::Smallest(0.5))];
    let verdict_for = |claims, ratios: [f64; 3]| {
        let [knn_10, knn_50, knn_250] = ratios.map(|ratio| [10.0 * ratio; 2]);
        let runs: [(&str, u32, &[f64]); 6] = [
            ("knn", 10, &knn_10),
            ("knn", 50, &knn_50),
            ("knn", 250, &knn_250),
            ("random", 10, &[10.0; 2]),
            ("random", 50, &[10.0; 2]),
            ("random", 250, &[10.0; 2]),
        ];
        verdict(claims, &runs).0
    };
    assert_eq!(verdict_for(MOST, [1.2, 4.4, 2.0]), Verdict::Reproduced);
    assert_eq!(verdict_for(MOST, [1.2, 3.7, 2.0]), Verdict::Near);
    assert_eq!(
        verdict_for(MOST, [0.9, 2.2, 2.0]),
        Verdict::OrderReproduced,
        "the largest ratio is above 1"
    );
    assert_eq!(verdict_for(MOST, [0.9, 0.8, 0.7]), Verdict::NotReproduced);
    assert_eq!(verdict_for(LEAST, [0.9, 0.7, 0.51]), Verdict::Reproduced);
    assert_eq!(verdict_for(LEAST, [0.9, 0.7, 0.3]), Verdict::OrderReproduced);
    let one_n: [(&str, u32, &[f64]); 2] = [("knn", 50, &[45.0; 2]), ("random", 50, &[10.0; 2])];
    assert_eq!(verdict(MOST, &one_n).0, Verdict::NotRun, "one N has no largest");
}

#[test]
fn a_falling_trend_may_rise_by_a_tenth_of_its_range() {
    const FALLS: &[Claim] = &[claim("knn", All, Mean, Statement::Falls)];
    const RISES: &[Claim] = &[claim("knn", All, Mean, Statement::Rises)];
    let verdict_for = |claims, values: [f64; 4]| {
        let [at_10, at_50, at_100, at_250] = values.map(|value| [value - 0.001, value + 0.001]);
        let runs: [(&str, u32, &[f64]); 4] = [
            ("knn", 10, &at_10),
            ("knn", 50, &at_50),
            ("knn", 100, &at_100),
            ("knn", 250, &at_250),
        ];
        verdict(claims, &runs)
    };
    assert_eq!(verdict_for(FALLS, [10.0, 5.0, 3.0, 2.0]), (Verdict::Reproduced, true));
    assert_eq!(verdict_for(FALLS, [10.0, 2.0, 2.5, 2.7]), (Verdict::Reproduced, true));
    assert_eq!(
        verdict_for(FALLS, [10.0, 2.0, 2.5, 2.9]),
        (Verdict::NotReproduced, true)
    );
    assert_eq!(
        verdict_for(FALLS, [10.0, 2.0, 2.5, 2.795]),
        (Verdict::Reproduced, false)
    );
    assert_eq!(
        verdict_for(FALLS, [2.0, 3.0, 5.0, 10.0]),
        (Verdict::NotReproduced, true)
    );
    assert_eq!(verdict_for(RISES, [2.0, 3.0, 5.0, 10.0]), (Verdict::Reproduced, true));
    assert_eq!(
        verdict_for(RISES, [10.0, 5.0, 3.0, 2.0]),
        (Verdict::NotReproduced, true)
    );
    assert_eq!(
        verdict_for(FALLS, [5.0; 4]),
        (Verdict::NotReproduced, false),
        "nothing falls"
    );
    assert_eq!(verdict(FALLS, &[("knn", 10, &[1.0; 2])]).0, Verdict::NotRun);
}

#[test]
fn a_constant_level_stays_within_20_percent_of_the_middle() {
    const LEVEL: &[Claim] = &[claim("knn", All, Mean, Statement::Constant)];
    let verdict_for = |low: f64, high: f64, genie: f64| {
        let (low, high) = ([low - 0.001, low + 0.001], [high - 0.001, high + 0.001]);
        let runs: [(&str, u32, &[f64]); 4] = [
            ("knn", 10, &low),
            ("knn", 250, &high),
            ("genie", 10, &[genie; 2]),
            ("genie", 250, &[genie; 2]),
        ];
        verdict(LEVEL, &runs)
    };
    assert_eq!(verdict_for(8.1, 11.9, 0.0), (Verdict::Reproduced, true));
    assert_eq!(verdict_for(7.9, 12.1, 0.0), (Verdict::NotReproduced, true));
    assert_eq!(verdict_for(8.005, 12.0, 0.0), (Verdict::Reproduced, false));
    assert_eq!(
        verdict_for(0.01, 0.05, 10.0).0,
        Verdict::Reproduced,
        "almost zero compared with the genie"
    );
    assert_eq!(verdict_for(0.01, 0.05, 1.0).0, Verdict::NotReproduced);
}

#[test]
fn a_gap_is_absolute_and_growth_is_relative_to_the_first_value() {
    const CLOSES: &[Claim] = &[claim("knn", All, Gap("genie"), Statement::Falls)];
    const HALVES: &[Claim] = &[claim("knn", At(250), Growth(10), Statement::About(0.5))];
    let verdict_for = |claims, last: f64| {
        let runs: [(&str, u32, &[f64]); 4] = [
            ("knn", 10, &[8.0; 2]),
            ("knn", 250, &[last; 2]),
            ("genie", 10, &[2.0; 2]),
            ("genie", 250, &[3.0; 2]),
        ];
        verdict(claims, &runs)
    };
    assert_eq!(verdict_for(CLOSES, 7.0), (Verdict::Reproduced, true));
    assert_eq!(verdict_for(CLOSES, 10.0), (Verdict::NotReproduced, true));
    assert_eq!(
        verdict_for(CLOSES, 0.5),
        (Verdict::Reproduced, true),
        "close to the genie, below it"
    );
    assert_eq!(verdict_for(HALVES, 4.0), (Verdict::Reproduced, true));
    assert_eq!(verdict_for(HALVES, 4.7).0, Verdict::Near);
    assert_eq!(verdict_for(HALVES, 8.0).0, Verdict::NotReproduced);
    assert_eq!(
        verdict(HALVES, &[("knn", 250, &[4.0; 2])]).0,
        Verdict::NotRun,
        "no runs with 10 devices"
    );
}

#[test]
fn a_metric_per_device_is_divided_by_n() {
    const BELOW: &[Claim] = &[knn_claim(Statement::Below(0.04))];
    let topic = ClaimTopic {
        is_per_device: true,
        ..topic(BELOW)
    };
    for (value, expected) in [(9.0, Verdict::Reproduced), (11.0, Verdict::NotReproduced)] {
        let judgement = judgement_of(&topic, &[("knn", 250, &[value; 2])]);
        assert_eq!(judgement.verdict, expected);
        assert!((judgement.findings[0].value - value / 250.0).abs() < 1e-12);
    }
}

#[test]
fn a_claim_on_several_n_must_hold_at_each() {
    const MANY: &[Claim] = &[claim("knn", Under(200), Mean, Statement::Above(2.0))];
    let verdict_for = |at_10: f64, at_199: f64| {
        verdict(
            MANY,
            &[
                ("knn", 10, &[at_10; 2]),
                ("knn", 199, &[at_199; 2]),
                ("knn", 200, &[0.0; 2]),
            ],
        )
        .0
    };
    assert_eq!(verdict_for(9.0, 3.0), Verdict::Reproduced);
    assert_eq!(verdict_for(9.0, 1.0), Verdict::NotReproduced);
    assert_eq!(verdict(MANY, &[("knn", 200, &[9.0; 2])]).0, Verdict::NotRun);
}

#[test]
fn a_claim_on_a_policy_without_runs_is_not_run() {
    const ABSENT: &[Claim] = &[claim("dt", At(250), Mean, Statement::About(1.0))];
    let judgement = judgement_of(&topic(ABSENT), &[("knn", 250, &[1.0])]);
    assert_eq!(judgement.verdict, Verdict::NotRun);
    assert!(judgement.findings.is_empty());
}
