//! Claims on misdetections (Fig. 9), and on the events that the genie misses for lack of energy. Numbers are
//! transcribed from the cited sentences, which a test checks. `metric` and `paper_figure` are the keys by which figures
//! find claims ([`super::claims_on`]). The order of the claims numbers them for [`crate::report::search`], as [`super`]
//! explains. An empty `metric_reason` means that the paper's words allow no other metric. Texts appear in
//! docs/reproduction.md.

use super::citation::FIG_9;
use super::claim::ClaimQuantity::{Mean, Ratio};
use super::claim::DeviceCounts::{All, At, Under};
use super::claim::Statement::{About, Above, Below, Constant, Falls, Largest};
use super::claim::{AREA_OUT_OF_REACH, Claim, ClaimTopic, PARTIAL_COVERAGE, RARE_SENSING, TOO_FEW_EVENTS};

/// Claims on Fig. 9.
pub(super) const MISDETECTIONS: ClaimTopic = ClaimTopic {
    metric: "misdetection_pct",
    is_per_device: false,
    metric_description: "misdetections, % of events",
    paper_figure: "Fig. 9",
    metric_reason: "",
    claims: &[
        Claim::new("knn", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("adjusted", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("q-learning", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("dt", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("random", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("genie", All, Mean, Falls, FIG_9.sentence(2)),
        Claim::new("knn", At(10), Mean, About(33.0), FIG_9.sentence(3)),
        Claim::new("adjusted", At(10), Mean, About(58.0), FIG_9.sentence(3)).with_caveat(RARE_SENSING),
        Claim::new("random", At(10), Mean, About(77.0), FIG_9.sentence(3)),
        Claim::new("knn", At(250), Mean, Below(0.01), FIG_9.sentence(4)).with_caveat(PARTIAL_COVERAGE),
        Claim::new("q-learning", At(250), Mean, Below(0.01), FIG_9.sentence(4)),
        Claim::new("random", At(250), Mean, About(7.0), FIG_9.sentence(5)),
        Claim::new(
            "knn",
            All,
            Ratio(&["adjusted", "random"]),
            Below(1.0),
            FIG_9.sentence(6),
        ),
        Claim::new(
            "q-learning",
            All,
            Ratio(&["adjusted", "random"]),
            Below(1.0),
            FIG_9.sentence(6),
        ),
        Claim::new("dt", All, Ratio(&["adjusted", "random"]), Below(1.0), FIG_9.sentence(6)),
        Claim::new("random", All, Ratio(&["adjusted"]), Largest(3.0), FIG_9.sentence(7))
            .interpreted_as("Better by up to 200 % is read as up to three times as many events missed by random.")
            .with_caveat(RARE_SENSING),
        Claim::new("adjusted", Under(200), Mean, Above(2.0), FIG_9.sentence(7)),
        Claim::new("genie", At(10), Mean, About(2.0), FIG_9.sentence(8)).with_caveat(AREA_OUT_OF_REACH),
        Claim::new("genie", At(250), Mean, About(0.003), FIG_9.sentence(8)),
        Claim::new("genie", All, Mean, Above(0.001), FIG_9.sentence(11)).interpreted_as(
            "A lower bound is read as a bound on the genie's misdetections, the subject of the \
                sentence.",
        ),
    ],
};

/// Claims on the events that the genie misses because of an empty battery.
pub(super) const GENIE_WITHOUT_ENERGY: ClaimTopic = ClaimTopic {
    metric: "wrong_activations_per_event",
    is_per_device: false,
    metric_description: "devices per event that detect it and cannot transmit",
    paper_figure: "Fig. 9",
    metric_reason: "The genie wakes the closest device alone, and only one within d_max, so that its wrong activations \
        are the devices that detect and lack the energy to transmit. 0.001 % of events is 0.00001 an event.",
    claims: &[
        Claim::new("genie", All, Mean, About(0.00001), FIG_9.sentence(11)).with_caveat(TOO_FEW_EVENTS),
        Claim::new("genie", All, Mean, Constant, FIG_9.sentence(11)),
    ],
};
