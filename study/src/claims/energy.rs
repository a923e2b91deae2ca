//! Claims on consumption: Fig. 8, and the policies with the least and the most consumption by Figs. 13 and 14. Numbers
//! are transcribed from the cited sentences, which a test checks. `metric` and `paper_figure` are the keys by which
//! figures find claims ([`super::claims_on`]). The order of the claims numbers them for [`crate::report::search`], as
//! [`super`] explains. An empty `metric_reason` means that the paper's words allow no other metric. Texts appear in
//! docs/reproduction.md.

use super::citation::{ABSTRACT, CONCLUSIONS, CONTRIBUTION, FIG_8, FIG_13, FIG_14, PARAMETERS};
use super::claim::ClaimQuantity::{Gap, Mean, Ratio};
use super::claim::DeviceCounts::{All, At, Over};
use super::claim::Statement::{About, Above, Below, Between, Falls, Smallest};
use super::claim::{Claim, ClaimTopic, FIXED_CYCLE, HARVEST_LIMIT, RARE_SENSING, WUR_FLOOR};

/// Interpretation of a sentence without an N.
const READ_AT_END_OF_AXIS: &str = "Stated without an N; read at the end of the axis.";
const UPPER_END: &str = "The upper end of the 2nd sentence's range, which the caption and the text of Fig. 13 give to \
    q-learning.";

/// Claims on Fig. 8.
pub(super) const ENERGY: ClaimTopic = ClaimTopic {
    metric: "energy_per_device_tti",
    is_per_device: false,
    metric_description: "energy per device and TTI, units",
    paper_figure: "Fig. 8",
    metric_reason: "",
    claims: &[
        Claim::new("knn", At(10), Mean, Between(0.45, 0.83), FIG_8.sentence(2)),
        Claim::new("adjusted", At(10), Mean, Between(0.45, 0.83), FIG_8.sentence(2)).with_caveat(RARE_SENSING),
        Claim::new("q-learning", At(10), Mean, Between(0.45, 0.83), FIG_8.sentence(2)),
        Claim::new("dt", At(10), Mean, Between(0.45, 0.83), FIG_8.sentence(2)),
        Claim::new("q-learning", At(10), Mean, About(0.83), FIG_8.sentence(2))
            .also_at(FIG_13.sentence(5))
            .interpreted_as(UPPER_END)
            .with_caveat(HARVEST_LIMIT),
        Claim::new("random", At(10), Mean, About(0.34), FIG_8.sentence(2)),
        Claim::new("knn", All, Mean, Falls, FIG_8.sentence(3)),
        Claim::new("knn", At(250), Mean, About(0.145), FIG_8.sentence(3)),
        Claim::new("random", At(250), Mean, Above(0.18), FIG_8.sentence(4)),
        Claim::new("random", At(250), Ratio(&["knn"]), Above(1.29), FIG_8.sentence(4)).contradicting(
            FIG_8.sentence(3),
            "0.18 is 24 % more than 0.145. For 29 %, random would have to spend more than 0.187.",
        ),
        Claim::new("knn", All, Ratio(&["random"]), Smallest(0.77), CONTRIBUTION)
            .also_at(CONCLUSIONS.sentence(6))
            .interpreted_as("Of the named methods, knn spends least in Fig. 8."),
        Claim::new("knn", At(250), Ratio(&["random"]), Below(1.0), ABSTRACT.sentence(8))
            .interpreted_as(READ_AT_END_OF_AXIS),
        Claim::new(
            "q-learning",
            At(250),
            Ratio(&["random"]),
            Below(1.0),
            ABSTRACT.sentence(8),
        )
        .interpreted_as(READ_AT_END_OF_AXIS)
        .contradicting(
            FIG_8.sentence(5),
            "There q-learning spends 0.24 units, and random, 29 % above knn's 0.145, about 0.187.",
        ),
        Claim::new("dt", At(250), Ratio(&["random"]), Below(1.0), ABSTRACT.sentence(8))
            .interpreted_as(READ_AT_END_OF_AXIS),
        Claim::new("q-learning", All, Mean, Falls, FIG_8.sentence(5)),
        Claim::new("q-learning", At(250), Mean, About(0.24), FIG_8.sentence(5)),
        Claim::new("adjusted", All, Mean, Falls, FIG_8.sentence(5)).with_caveat(RARE_SENSING),
        Claim::new("adjusted", At(250), Mean, About(0.32), FIG_8.sentence(5)).with_caveat(RARE_SENSING),
        Claim::new("knn", Over(180), Ratio(&["random"]), Below(1.0), FIG_8.sentence(6)),
        Claim::new("dt", At(250), Ratio(&["q-learning"]), About(0.6), FIG_8.sentence(7))
            .interpreted_as(READ_AT_END_OF_AXIS),
        Claim::new("dt", At(250), Ratio(&["knn"]), About(0.9), FIG_8.sentence(7))
            .interpreted_as(READ_AT_END_OF_AXIS)
            .contradicting(
                FIG_8.sentence(5),
                "40 % below q-learning's 0.24 is 0.144, and 10 % below knn's 0.145 is 0.131.",
            ),
        Claim::new("knn", All, Gap("genie"), Falls, FIG_8.sentence(8)),
        Claim::new("adjusted", All, Gap("genie"), Falls, FIG_8.sentence(8)).with_caveat(RARE_SENSING),
        Claim::new("q-learning", All, Gap("genie"), Falls, FIG_8.sentence(8)),
        Claim::new("dt", All, Gap("genie"), Falls, FIG_8.sentence(8)),
        Claim::new("genie", At(250), Mean, About(0.055), FIG_8.sentence(9))
            .with_caveat(WUR_FLOOR)
            .contradicting(
                PARAMETERS,
                "E_WuR = 1/14 = 0.0714 units a TTI is more than 0.055, and Sec. V-A charges it to every sleeper.",
            ),
        Claim::new(
            "q-learning",
            At(10),
            Ratio(&["knn", "adjusted", "dt", "random"]),
            Above(1.0),
            FIG_13.sentence(5),
        ),
        Claim::new(
            "random",
            At(10),
            Ratio(&["knn", "adjusted", "q-learning", "dt"]),
            Below(1.0),
            FIG_13.sentence(5),
        )
        .with_caveat(RARE_SENSING),
        Claim::new(
            "adjusted",
            At(250),
            Ratio(&["knn", "q-learning", "dt", "random"]),
            Above(1.0),
            FIG_13.sentence(5),
        )
        .with_caveat(RARE_SENSING),
        Claim::new(
            "dt",
            At(250),
            Ratio(&["knn", "adjusted", "q-learning", "random"]),
            Below(1.0),
            FIG_13.sentence(5),
        ),
        Claim::new(
            "adjusted",
            At(100),
            Ratio(&["knn", "q-learning", "dt", "random"]),
            Above(1.0),
            FIG_14.sentence(2),
        )
        .with_caveat(RARE_SENSING),
        Claim::new(
            "random",
            At(100),
            Ratio(&["knn", "adjusted", "q-learning", "dt"]),
            Below(1.0),
            FIG_14.sentence(2),
        )
        .with_caveat(FIXED_CYCLE),
    ],
};
