//! Fig. 7: information.

use super::citation::{ABSTRACT, BENCHMARKS, CONCLUSIONS, CONTRIBUTION, FIG_7};
use super::claim::ClaimQuantity::{Own, Ratio};
use super::claim::DeviceCounts::{At, Everywhere, Over, UpTo};
use super::claim::Statement::{About, Above, Below, Largest, Rises};
use super::claim::{CLOSEST, Claim, ClaimTopic, SPARING};

const ENDPOINT: &str = "\"Up to\" is read as the end of the axis, since information rises with N (1st sentence).";
const ALIKE: &str = "Not near is read as below 80 %, beyond the tolerance of this report.";
const DENSE: &str = "Read for N > 50, as the 8th sentence states that all methods are alike up to there. The 7th \
    sentence places q-learning and the genie higher.";
const ALL_METHODS: &str = "The sentence is about all methods together, without an N; read at the end of the axis.";

/// Claims that compare the performance of policies.
pub(super) const OVER_TIME: ClaimTopic = ClaimTopic {
    metric: "info_p1",
    is_per_device: false,
    about: "information, objective of P1",
    source: "Fig. 7",
    reading: "The sentences compare the performance of policies, which is the objective of P1: Σ I_i over the expected \
        number of events αK. A late detection leaves less time for other events. It therefore lowers this objective, \
        but not the information per event.",
    claims: &[
        Claim::new(
            "adjusted",
            Everywhere,
            Ratio(&["random"]),
            Above(1.0),
            FIG_7.sentence(3),
        )
        .with_caveat(SPARING),
        Claim::new("knn", Everywhere, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)),
        Claim::new(
            "q-learning",
            Everywhere,
            Ratio(&["random"]),
            Above(1.0),
            FIG_7.sentence(3),
        ),
        Claim::new("dt", Everywhere, Ratio(&["random"]), Above(1.0), FIG_7.sentence(3)),
        Claim::new("q-learning", At(250), Ratio(&["genie"]), About(1.0), FIG_7.sentence(4))
            .also_at(CONCLUSIONS.sentence(6)),
        Claim::new("q-learning", Everywhere, Ratio(&["genie"]), Rises, ABSTRACT.sentence(9)),
        Claim::new(
            "genie",
            Everywhere,
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
        .interpreted_as(DENSE),
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
        .with_caveat(SPARING),
        Claim::new("knn", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(ALIKE),
        Claim::new("adjusted", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(ALIKE),
        Claim::new("q-learning", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(ALIKE),
        Claim::new("dt", UpTo(50), Ratio(&["genie"]), Below(0.8), FIG_7.sentence(8)).interpreted_as(ALIKE),
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
    about: "information per event",
    source: "Fig. 7",
    reading: "The sentences are about information per event, so they are judged by the actual events. In the paper's \
        model, events do not depend on the base station, so this metric and the objective of P1 have the same mean.",
    claims: &[
        Claim::new("knn", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("adjusted", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("q-learning", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("dt", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("random", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("genie", Everywhere, Own, Rises, FIG_7.sentence(1)),
        Claim::new("knn", At(250), Own, About(0.4), FIG_7.sentence(4)).interpreted_as(ENDPOINT),
        Claim::new("adjusted", At(250), Own, About(0.4), FIG_7.sentence(4)).interpreted_as(ENDPOINT),
        Claim::new("q-learning", At(250), Own, About(0.72), FIG_7.sentence(4)).with_caveat(CLOSEST),
        Claim::new("genie", At(250), Own, About(0.72), FIG_7.sentence(4))
            .interpreted_as("Stated for q-learning, which is near the genie.")
            .with_caveat(CLOSEST),
        Claim::new(
            "genie",
            Everywhere,
            Ratio(&["knn", "adjusted", "q-learning", "dt", "random"]),
            Above(1.0),
            FIG_7.sentence(5),
        ),
        Claim::new("q-learning", Everywhere, Ratio(&["random"]), Largest(4.5), CONTRIBUTION)
            .also_at(CONCLUSIONS.sentence(6))
            .interpreted_as(
                "The largest ratio over N among all methods; in Fig. 7 this is q-learning. \"4.5 times more\" is read \
                 as 4.5 times.",
            ),
    ],
};
