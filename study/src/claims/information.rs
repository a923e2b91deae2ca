//! Claims on information (Fig. 7): the objective of P1 where the paper compares policies, and information per event.
//! Numbers are transcribed from the cited sentences, which a test checks. `metric` and `paper_figure` are the keys by
//! which figures find claims ([`super::claims_on`]). The order of the claims numbers them for
//! [`crate::report::search`], so a claim in the middle moves later ones to the other half of the search. Texts appear
//! in docs/reproduction.md. Two of them repeat the tolerance of 20 % of [`crate::report::judge`].

use super::citation::{ABSTRACT, BENCHMARKS, CONCLUSIONS, CONTRIBUTION, FIG_7};
use super::claim::ClaimQuantity::{Mean, Ratio};
use super::claim::DeviceCounts::{All, At, Over, UpTo};
use super::claim::Statement::{About, Above, Below, Largest, Rises};
use super::claim::{CLOSEST_DEVICE, Claim, ClaimTopic, RARE_SENSING};

/// Interpretation of "up to" without an N.
const UP_TO_IS_END_OF_AXIS: &str =
    "\"Up to\" is read as the end of the axis, since information rises with N (1st sentence).";
const NOT_NEAR: &str = "Not near is read as below 80 %, beyond the tolerance of this report.";
const ABOVE_50_DEVICES: &str = "Read for N > 50, as the 8th sentence states that all methods are alike up to there. \
    The 7th sentence places q-learning and the genie higher.";
const ALL_METHODS: &str = "The sentence is about all methods together, without an N; read at the end of the axis.";

/// Claims that compare the performance of policies.
pub(super) const P1_OBJECTIVE: ClaimTopic = ClaimTopic {
    metric: "info_p1",
    is_per_device: false,
    metric_description: "information, objective of P1",
    paper_figure: "Fig. 7",
    metric_reason: "The sentences compare the performance of policies, which is the objective of P1: Σ I_i over the \
        expected number of events αK. A late detection leaves less time for other events. It therefore lowers this \
        objective, but not the information per event.",
    claims: &[
        Claim::new("adjusted", All, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)).with_caveat(RARE_SENSING),
        Claim::new("knn", All, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)),
        Claim::new("q-learning", All, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)),
        Claim::new("dt", All, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)),
        Claim::new("q-learning", At(250), Ratio(&["genie"]), About(1.0), FIG_7.sentence(4))
            .also_at(CONCLUSIONS.sentence(6)),
        Claim::new("q-learning", All, Ratio(&["genie"]), Rises, ABSTRACT.sentence(9)),
        Claim::new(
            "genie",
            All,
            Ratio(&["knn", "adjusted", "q-learning", "dt", "random"]),
            Above(1.0),
            BENCHMARKS.sentence(6),
        ),
        Claim::new(
            "dt",
            Over(50),
            Ratio(&["knn", "adjusted", "random"]),
            Above(1.0),
            FIG_7.sentence(6),
        )
        .interpreted_as(ABOVE_50_DEVICES),
        Claim::new(
            "dt",
            Over(50),
            Ratio(&["q-learning", "genie"]),
            Below(1.0),
            FIG_7.sentence(7),
        ),
        Claim::new(
            "q-learning",
            UpTo(50),
            Ratio(&["knn", "adjusted", "dt"]),
            About(1.0),
            FIG_7.sentence(8),
        )
        .interpreted_as("Alike is read as within 20 % of q-learning.")
        .with_caveat(RARE_SENSING),
        Claim::new("knn", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(NOT_NEAR),
        Claim::new("adjusted", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(NOT_NEAR),
        Claim::new("q-learning", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(NOT_NEAR),
        Claim::new("dt", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(NOT_NEAR),
        Claim::new("knn", At(250), Ratio(&["genie"]), About(1.0), CONCLUSIONS.sentence(6))
            .interpreted_as(ALL_METHODS)
            .contradicting(
                FIG_7.sentence(4),
                "There knn reaches about 0.4 where q-learning, near the genie, reaches about 0.72.",
            ),
        Claim::new("dt", At(250), Ratio(&["genie"]), About(1.0), CONCLUSIONS.sentence(6))
            .interpreted_as(ALL_METHODS)
            .contradicting(FIG_7.sentence(7), "There dt falls well short of the genie."),
    ],
};

/// Claims that name information per event.
pub(super) const PER_EVENT: ClaimTopic = ClaimTopic {
    metric: "info_per_event",
    is_per_device: false,
    metric_description: "information per event",
    paper_figure: "Fig. 7",
    metric_reason: "The sentences are about information per event, so they are judged by the actual events. In the \
        paper's model, events do not depend on the base station, so this metric and the objective of P1 have the same \
        mean.",
    claims: &[
        Claim::new("knn", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("adjusted", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("q-learning", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("dt", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("random", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("genie", All, Mean, Rises, FIG_7.sentence(1)),
        Claim::new("knn", At(250), Mean, About(0.4), FIG_7.sentence(4)).interpreted_as(UP_TO_IS_END_OF_AXIS),
        Claim::new("adjusted", At(250), Mean, About(0.4), FIG_7.sentence(4)).interpreted_as(UP_TO_IS_END_OF_AXIS),
        Claim::new("q-learning", At(250), Mean, About(0.72), FIG_7.sentence(4)).with_caveat(CLOSEST_DEVICE),
        Claim::new("genie", At(250), Mean, About(0.72), FIG_7.sentence(4))
            .interpreted_as("Stated for q-learning, which is near the genie.")
            .with_caveat(CLOSEST_DEVICE),
        Claim::new(
            "genie",
            All,
            Ratio(&["knn", "adjusted", "q-learning", "dt", "random"]),
            Above(1.0),
            FIG_7.sentence(5),
        ),
        Claim::new("q-learning", All, Ratio(&["random"]), Largest(4.5), CONTRIBUTION)
            .also_at(CONCLUSIONS.sentence(6))
            .interpreted_as(
                "The largest ratio over N among all methods; in Fig. 7 this is q-learning. \"4.5 times more\" is read \
                 as 4.5 times.",
            ),
    ],
};
