//! Verdicts at the limits of each tier.

use reveille_common::declare::NoFiles;

use super::*;
use crate::claims::ClaimQuantity::{Gap, Growth, Mean, Ratio};
use crate::claims::DeviceCounts::{All, At, Under};
use crate::claims::{ClaimQuantity, DeviceCounts, FIG_8, Statement};
use crate::figures::results::{Results, fixtures};

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

const fn claim(policy: &'static str, sites: DeviceCounts, quantity: ClaimQuantity, statement: Statement) -> Claim {
    Claim::new(policy, sites, quantity, statement, FIG_8)
}

/// Creates a claim on knn at N = 250.
const fn one(statement: Statement) -> Claim {
    claim("knn", At(250), Mean, statement)
}

const fn about(v: f64) -> Claim {
    one(Statement::About(v))
}

fn judged(topic: &ClaimTopic, runs: &[(&str, u32, &[f64])]) -> Judgement {
    let results = Results::new(&[fixtures::table("paper", METRIC, runs)], &NoFiles).expect("runs");
    judge(topic, &topic.claims[0], &results.conditions[0])
}

/// Judges the first of `claims` for runs with these values of the metric.
fn verdict(claims: &'static [Claim], runs: &[(&str, u32, &[f64])]) -> (Verdict, bool) {
    let judgement = judged(&topic(claims), runs);
    (judgement.verdict, judgement.is_firm)
}

#[test]
fn a_value_is_met_within_5_percent_and_near_within_20() {
    const ONE: &[Claim] = &[about(10.0)];
    const TENTH: &[Claim] = &[about(0.1)];
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
        assert_eq!(verdict(ONE, &[("knn", 250, &[value, value])]).0, expected, "{value}");
    }
    // 0.1 · 1.2 is not 0.12 in binary.
    assert_eq!(verdict(TENTH, &[("knn", 250, &[0.12, 0.12])]).0, Verdict::Near);
}

#[test]
fn ranges_have_a_near_margin_and_bounds_have_none() {
    const RANGE: &[Claim] = &[one(Statement::Between(10.0, 20.0))];
    const BELOW: &[Claim] = &[one(Statement::Below(6.0))];
    const ABOVE: &[Claim] = &[one(Statement::Above(6.0))];
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
        let is_met = |claims| verdict(claims, &[("knn", 250, &[value; 2])]).0;
        let of = |met| {
            if met {
                Verdict::Reproduced
            } else {
                Verdict::NotReproduced
            }
        };
        assert_eq!((is_met(BELOW), is_met(ABOVE)), (of(below), of(above)), "{value}");
    }
}

#[test]
fn a_verdict_is_firm_if_the_interval_stays_on_its_side() {
    const ONE: &[Claim] = &[about(10.0)];
    // Two values a and b: the half-width is 12.706 · |a - b| / 2.
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
        assert_eq!(verdict(ONE, &[("knn", 250, &values)]), expected, "{values:?}");
    }
    assert_eq!(
        verdict(ONE, &[("knn", 250, &[10.0])]),
        (Verdict::Reproduced, false),
        "one run tells no interval"
    );
}

#[test]
fn order_counts_where_the_value_does_not_fit() {
    const THREE: &[Claim] = &[
        about(10.0),
        claim("random", At(250), Mean, Statement::About(20.0)),
        claim("genie", At(250), Mean, Statement::Below(3.0)),
    ];
    const EQUALS: &[Claim] = &[about(10.0), claim("random", At(250), Mean, Statement::About(10.0))];
    let of = |knn, random, genie| {
        let runs: [(&str, u32, &[f64]); 3] = [
            ("knn", 250, &[knn; 2]),
            ("random", 250, &[random; 2]),
            ("genie", 250, &[genie; 2]),
        ];
        verdict(THREE, &runs).0
    };
    assert_eq!(of(50.0, 60.0, 40.0), Verdict::OrderReproduced);
    assert_eq!(of(50.0, 45.0, 40.0), Verdict::NotReproduced, "random must be above");
    assert_eq!(of(50.0, 60.0, 55.0), Verdict::NotReproduced, "genie must be below");
    assert_eq!(of(50.0, 50.0, 40.0), Verdict::NotReproduced, "equal is not above");
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
fn a_stated_order_counts_for_the_values_next_to_it() {
    // The paper gives no figure for random, only that it is above knn.
    const STATED: &[Claim] = &[
        about(10.0),
        claim("random", All, Ratio(&["knn"]), Statement::Above(1.0)),
    ];
    let of = |random: f64| {
        let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[50.0; 2]), ("random", 250, &[random; 2])];
        verdict(STATED, &runs).0
    };
    assert_eq!((of(60.0), of(40.0)), (Verdict::OrderReproduced, Verdict::NotReproduced));
}

#[test]
fn a_ratio_takes_part_in_the_order_by_the_figure_it_stands_for() {
    const RATIO: &[Claim] = &[
        about(0.4),
        claim("random", At(250), Ratio(&["genie"]), Statement::About(0.25)),
        claim("genie", At(250), Mean, Statement::About(0.8)),
    ];
    let of = |knn: &[f64], random: &[f64]| {
        verdict(
            RATIO,
            &[("knn", 250, knn), ("random", 250, random), ("genie", 250, &[0.8; 2])],
        )
        .0
    };
    assert_eq!(of(&[0.2; 2], &[0.1; 2]), Verdict::OrderReproduced);
    assert_eq!(
        of(&[0.2; 2], &[0.3; 2]),
        Verdict::NotReproduced,
        "random, a quarter of genie, must be below"
    );
}

#[test]
fn an_order_is_firm_if_intervals_are_apart_or_one_pair_is_wrong() {
    const THREE: &[Claim] = &[
        about(10.0),
        claim("random", At(250), Mean, Statement::About(20.0)),
        claim("genie", At(250), Mean, Statement::About(1.0)),
    ];
    let of = |random: &'static [f64], genie: &'static [f64]| {
        verdict(
            THREE,
            &[
                ("knn", 250, &[50.0, 50.1]),
                ("random", 250, random),
                ("genie", 250, genie),
            ],
        )
    };
    assert_eq!(of(&[60.0, 60.1], &[40.0, 40.1]), (Verdict::OrderReproduced, true));
    assert_eq!(of(&[50.2, 50.3], &[40.0, 40.1]), (Verdict::OrderReproduced, false));
    assert_eq!(of(&[49.9, 50.0], &[40.0, 40.1]), (Verdict::NotReproduced, false));
    assert_eq!(of(&[49.9, 50.0], &[60.0, 60.1]), (Verdict::NotReproduced, true));
}

#[test]
fn a_ratio_is_of_our_own_means() {
    const HALF: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::About(0.5))];
    for (own, expected) in [
        (5.0, Verdict::Reproduced),
        (6.0, Verdict::Near),
        (4.0, Verdict::Near),
        (6.1, Verdict::OrderReproduced),
        (3.9, Verdict::OrderReproduced),
        (10.1, Verdict::NotReproduced),
    ] {
        let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[own; 2]), ("random", 250, &[10.0; 2])];
        assert_eq!(verdict(HALF, &runs).0, expected, "{own}");
    }
    assert_eq!(
        verdict(HALF, &[("knn", 250, &[5.0; 2])]).0,
        Verdict::NotRun,
        "no runs of the other policy"
    );
}

#[test]
fn a_bound_on_a_ratio_holds_against_each_and_has_no_order_to_fall_back_to() {
    const LESS: &[Claim] = &[claim("knn", All, Ratio(&["random", "genie"]), Statement::Below(1.0))];
    const MORE: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::Above(1.29))];
    let of = |knn: f64| {
        let runs: [(&str, u32, &[f64]); 3] = [
            ("knn", 250, &[knn; 2]),
            ("random", 250, &[10.0; 2]),
            ("genie", 250, &[8.0; 2]),
        ];
        (verdict(LESS, &runs).0, verdict(MORE, &runs).0)
    };
    assert_eq!(of(7.0), (Verdict::Reproduced, Verdict::NotReproduced));
    assert_eq!(of(9.0), (Verdict::NotReproduced, Verdict::NotReproduced), "above genie");
    assert_eq!(of(12.0).1, Verdict::OrderReproduced, "more, but not 29 % more");
    assert_eq!(of(13.0).1, Verdict::Reproduced);
}

#[test]
fn runs_with_the_same_seeds_tell_an_order_that_their_spread_would_hide() {
    const LESS: &[Claim] = &[claim("knn", At(250), Ratio(&["random"]), Statement::Below(1.0))];
    let of = |random: &'static [f64]| verdict(LESS, &[("knn", 250, &[10.0, 20.0, 30.0]), ("random", 250, random)]);
    assert_eq!(of(&[10.6, 20.7, 30.8]), (Verdict::Reproduced, true));
    assert_eq!(of(&[30.8, 10.6, 20.7]), (Verdict::Reproduced, false));
}

#[test]
fn up_to_means_the_largest_over_n() {
    const MOST: &[Claim] = &[claim("knn", All, Ratio(&["random"]), Statement::Largest(4.5))];
    const LEAST: &[Claim] = &[claim("knn", All, Ratio(&["random"]), Statement::Smallest(0.5))];
    let of = |claims, ratios: [f64; 3]| {
        let [a, b, c] = ratios.map(|ratio| [10.0 * ratio; 2]);
        let runs: [(&str, u32, &[f64]); 6] = [
            ("knn", 10, &a),
            ("knn", 50, &b),
            ("knn", 250, &c),
            ("random", 10, &[10.0; 2]),
            ("random", 50, &[10.0; 2]),
            ("random", 250, &[10.0; 2]),
        ];
        verdict(claims, &runs).0
    };
    assert_eq!(of(MOST, [1.2, 4.4, 2.0]), Verdict::Reproduced);
    assert_eq!(of(MOST, [1.2, 3.7, 2.0]), Verdict::Near);
    assert_eq!(
        of(MOST, [0.9, 2.2, 2.0]),
        Verdict::OrderReproduced,
        "more at its largest"
    );
    assert_eq!(of(MOST, [0.9, 0.8, 0.7]), Verdict::NotReproduced);
    assert_eq!(of(LEAST, [0.9, 0.7, 0.51]), Verdict::Reproduced);
    assert_eq!(of(LEAST, [0.9, 0.7, 0.3]), Verdict::OrderReproduced);
    let lone: [(&str, u32, &[f64]); 2] = [("knn", 50, &[45.0; 2]), ("random", 50, &[10.0; 2])];
    assert_eq!(verdict(MOST, &lone).0, Verdict::NotRun, "one N has no largest");
}

#[test]
fn what_falls_may_rise_by_a_tenth_of_its_range() {
    const FALLS: &[Claim] = &[claim("knn", All, Mean, Statement::Falls)];
    const RISES: &[Claim] = &[claim("knn", All, Mean, Statement::Rises)];
    let of = |claims, values: [f64; 4]| {
        let [a, b, c, d] = values.map(|value| [value - 0.001, value + 0.001]);
        let runs: [(&str, u32, &[f64]); 4] = [("knn", 10, &a), ("knn", 50, &b), ("knn", 100, &c), ("knn", 250, &d)];
        verdict(claims, &runs)
    };
    assert_eq!(of(FALLS, [10.0, 5.0, 3.0, 2.0]), (Verdict::Reproduced, true));
    assert_eq!(of(FALLS, [10.0, 2.0, 2.5, 2.7]), (Verdict::Reproduced, true));
    assert_eq!(of(FALLS, [10.0, 2.0, 2.5, 2.9]), (Verdict::NotReproduced, true));
    assert_eq!(of(FALLS, [10.0, 2.0, 2.5, 2.795]), (Verdict::Reproduced, false));
    assert_eq!(of(FALLS, [2.0, 3.0, 5.0, 10.0]), (Verdict::NotReproduced, true));
    assert_eq!(of(RISES, [2.0, 3.0, 5.0, 10.0]), (Verdict::Reproduced, true));
    assert_eq!(of(RISES, [10.0, 5.0, 3.0, 2.0]), (Verdict::NotReproduced, true));
    assert_eq!(of(FALLS, [5.0; 4]), (Verdict::NotReproduced, false), "nothing falls");
    assert_eq!(verdict(FALLS, &[("knn", 10, &[1.0; 2])]).0, Verdict::NotRun);
}

#[test]
fn what_is_level_stays_within_20_percent_of_the_middle() {
    const LEVEL: &[Claim] = &[claim("knn", All, Mean, Statement::Constant)];
    let of = |low: f64, high: f64, genie: f64| {
        let (low, high) = ([low - 0.001, low + 0.001], [high - 0.001, high + 0.001]);
        let runs: [(&str, u32, &[f64]); 4] = [
            ("knn", 10, &low),
            ("knn", 250, &high),
            ("genie", 10, &[genie; 2]),
            ("genie", 250, &[genie; 2]),
        ];
        verdict(LEVEL, &runs)
    };
    assert_eq!(of(8.1, 11.9, 0.0), (Verdict::Reproduced, true));
    assert_eq!(of(7.9, 12.1, 0.0), (Verdict::NotReproduced, true));
    assert_eq!(of(8.005, 12.0, 0.0), (Verdict::Reproduced, false));
    assert_eq!(of(0.01, 0.05, 10.0).0, Verdict::Reproduced, "both are almost zero");
    assert_eq!(of(0.01, 0.05, 1.0).0, Verdict::NotReproduced);
}

#[test]
fn a_falling_gap_closes_and_growth_is_relative_to_the_first_value() {
    const CLOSES: &[Claim] = &[claim("knn", All, Gap("genie"), Statement::Falls)];
    const HALVES: &[Claim] = &[claim("knn", At(250), Growth(10), Statement::About(0.5))];
    let of = |claims, last: f64| {
        let runs: [(&str, u32, &[f64]); 4] = [
            ("knn", 10, &[8.0; 2]),
            ("knn", 250, &[last; 2]),
            ("genie", 10, &[2.0; 2]),
            ("genie", 250, &[3.0; 2]),
        ];
        verdict(claims, &runs)
    };
    assert_eq!(of(CLOSES, 7.0), (Verdict::Reproduced, true));
    assert_eq!(of(CLOSES, 10.0), (Verdict::NotReproduced, true));
    assert_eq!(
        of(CLOSES, 0.5),
        (Verdict::Reproduced, true),
        "below the genie is near it as well"
    );
    assert_eq!(of(HALVES, 4.0), (Verdict::Reproduced, true));
    assert_eq!(of(HALVES, 4.7).0, Verdict::Near);
    assert_eq!(of(HALVES, 8.0).0, Verdict::NotReproduced);
    assert_eq!(
        verdict(HALVES, &[("knn", 250, &[4.0; 2])]).0,
        Verdict::NotRun,
        "no start"
    );
}

#[test]
fn a_metric_can_be_shared_out_among_the_devices() {
    const BELOW: &[Claim] = &[one(Statement::Below(0.04))];
    let topic = ClaimTopic {
        is_per_device: true,
        ..topic(BELOW)
    };
    for (value, expected) in [(9.0, Verdict::Reproduced), (11.0, Verdict::NotReproduced)] {
        let judgement = judged(&topic, &[("knn", 250, &[value; 2])]);
        assert_eq!(judgement.verdict, expected);
        assert!((judgement.findings[0].value - value / 250.0).abs() < 1e-12);
    }
}

#[test]
fn a_claim_for_many_n_must_hold_at_each() {
    const MANY: &[Claim] = &[claim("knn", Under(200), Mean, Statement::Above(2.0))];
    let runs = |low: f64, high: f64| {
        verdict(
            MANY,
            &[
                ("knn", 10, &[low; 2]),
                ("knn", 199, &[high; 2]),
                ("knn", 200, &[0.0; 2]),
            ],
        )
        .0
    };
    assert_eq!(runs(9.0, 3.0), Verdict::Reproduced);
    assert_eq!(runs(9.0, 1.0), Verdict::NotReproduced);
    assert_eq!(verdict(MANY, &[("knn", 200, &[9.0; 2])]).0, Verdict::NotRun);
}

#[test]
fn policies_without_runs_are_named() {
    const ABSENT: &[Claim] = &[claim("dt", At(250), Mean, Statement::About(1.0))];
    let judgement = judged(&topic(ABSENT), &[("knn", 250, &[1.0])]);
    assert_eq!(judgement.verdict, Verdict::NotRun);
    assert!(judgement.findings.is_empty());
}
