use reveille_common::declare::NoFiles;

use super::*;
use crate::claims::Sites::{At, Under};
use crate::figures::results::{Results, fixtures};

const METRIC: &str = "mean_battery";

fn claim(policy: &'static str, relation: Relation) -> Claim {
    Claim {
        policy,
        sites: At(250),
        relation,
        caveat: "",
    }
}

/// The verdict on the first of `claims`, for runs with these values of the metric.
fn verdict(claims: &'static [Claim], runs: &[(&str, u32, &[f64])]) -> (Verdict, bool) {
    let topic = Topic {
        metric: METRIC,
        about: "",
        source: "",
        remark: "",
        claims,
    };
    let results = Results::new(&[fixtures::table("paper", METRIC, runs)], &NoFiles).expect("runs");
    let judgement = judge(&topic, &claims[0], &results.conditions[0]);
    (judgement.verdict, judgement.firm)
}

const fn about(v: f64) -> Claim {
    Claim {
        policy: "knn",
        sites: At(250),
        relation: Relation::About(v),
        caveat: "",
    }
}

#[test]
fn twenty_percent_is_within_and_a_hair_more_is_not() {
    const ONE: &[Claim] = &[about(10.0)];
    const TENTH: &[Claim] = &[about(0.1)];
    for (value, expected) in [
        (12.0, Verdict::Reproduced),
        (12.000_01, Verdict::NotReproduced),
        (8.0, Verdict::Reproduced),
        (7.999_99, Verdict::NotReproduced),
    ] {
        assert_eq!(verdict(ONE, &[("knn", 250, &[value, value])]).0, expected, "{value}");
    }
    // 0.1 · 1.2 is not 0.12 in binary.
    assert_eq!(verdict(TENTH, &[("knn", 250, &[0.12, 0.12])]).0, Verdict::Reproduced);
}

#[test]
fn ranges_are_widened_at_both_ends_and_bounds_are_not() {
    const RANGE: &[Claim] = &[Claim {
        relation: Relation::Between(10.0, 20.0),
        ..about(0.0)
    }];
    const BELOW: &[Claim] = &[Claim {
        relation: Relation::Below(6.0),
        ..about(0.0)
    }];
    const ABOVE: &[Claim] = &[Claim {
        relation: Relation::Above(6.0),
        ..about(0.0)
    }];
    for (value, fits) in [(8.0, true), (7.9, false), (24.0, true), (24.1, false), (15.0, true)] {
        assert_eq!(
            verdict(RANGE, &[("knn", 250, &[value; 2])]).0 == Verdict::Reproduced,
            fits,
            "{value}"
        );
    }
    for (value, below, above) in [(5.99, true, false), (6.0, false, false), (6.01, false, true)] {
        assert_eq!(
            verdict(BELOW, &[("knn", 250, &[value; 2])]).0 == Verdict::Reproduced,
            below,
            "{value}"
        );
        assert_eq!(
            verdict(ABOVE, &[("knn", 250, &[value; 2])]).0 == Verdict::Reproduced,
            above,
            "{value}"
        );
    }
}

#[test]
fn a_verdict_is_firm_if_the_interval_stays_on_its_side() {
    const ONE: &[Claim] = &[about(10.0)];
    // Two values a and b: the half-width is 12.706 · |a - b| / 2.
    assert_eq!(
        verdict(ONE, &[("knn", 250, &[11.9, 11.91])]),
        (Verdict::Reproduced, true)
    );
    assert_eq!(
        verdict(ONE, &[("knn", 250, &[11.8, 11.9])]),
        (Verdict::Reproduced, false)
    );
    assert_eq!(
        verdict(ONE, &[("knn", 250, &[12.1, 12.2])]),
        (Verdict::NotReproduced, false)
    );
    assert_eq!(
        verdict(ONE, &[("knn", 250, &[14.0, 14.1])]),
        (Verdict::NotReproduced, true)
    );
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
        Claim {
            policy: "random",
            ..about(20.0)
        },
        Claim {
            policy: "genie",
            relation: Relation::Below(3.0),
            ..about(0.0)
        },
    ];
    const EQUALS: &[Claim] = &[
        about(10.0),
        Claim {
            policy: "random",
            ..about(10.0)
        },
    ];
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
        "nobody to compare with"
    );
    let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[50.0; 2]), ("random", 250, &[60.0; 2])];
    assert_eq!(
        verdict(EQUALS, &runs).0,
        Verdict::NotReproduced,
        "the paper states no order of equals"
    );
}

#[test]
fn a_ratio_takes_part_in_the_order_by_the_figure_it_stands_for() {
    const RATIO: &[Claim] = &[
        about(0.4),
        Claim {
            policy: "random",
            relation: Relation::Times(0.25, "genie"),
            ..about(0.0)
        },
        Claim {
            policy: "genie",
            ..about(0.8)
        },
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
fn an_order_is_firm_if_intervals_are_apart_and_its_lack_if_one_pair_is_surely_wrong() {
    const THREE: &[Claim] = &[
        about(10.0),
        Claim {
            policy: "random",
            ..about(20.0)
        },
        Claim {
            policy: "genie",
            ..about(1.0)
        },
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
    const HALF: &[Claim] = &[Claim {
        relation: Relation::Times(0.5, "random"),
        ..about(0.0)
    }];
    for (own, fits) in [(5.0, true), (6.0, true), (6.1, false), (4.0, true), (3.9, false)] {
        let runs: [(&str, u32, &[f64]); 2] = [("knn", 250, &[own; 2]), ("random", 250, &[10.0; 2])];
        assert_eq!(verdict(HALF, &runs).0 == Verdict::Reproduced, fits, "{own}");
    }
    assert_eq!(
        verdict(HALF, &[("knn", 250, &[5.0; 2])]).0,
        Verdict::NotRun,
        "no runs of the other policy"
    );
}

#[test]
fn a_claim_for_many_n_must_hold_at_each() {
    const MANY: &[Claim] = &[Claim {
        sites: Under(200),
        relation: Relation::Above(2.0),
        ..about(0.0)
    }];
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
fn policies_that_were_not_run_are_said_so() {
    let absent = claim("dt", Relation::About(1.0));
    let results = Results::new(&[fixtures::table("paper", METRIC, &[("knn", 250, &[1.0])])], &NoFiles).expect("runs");
    let topic = Topic {
        metric: METRIC,
        about: "",
        source: "",
        remark: "",
        claims: &[],
    };
    assert_eq!(judge(&topic, &absent, &results.conditions[0]).verdict, Verdict::NotRun);
}
