//! Claims on wrong activations (Fig. 12a) and on the energy that they waste (Fig. 12b). Numbers are transcribed from
//! the cited sentences, which a test checks. `metric` and `paper_figure` are the keys by which figures find claims
//! ([`super::claims_on`]). The order of the claims numbers them for [`crate::report::search`], as [`super`] explains.
//! An empty `metric_reason` means that the paper's words allow no other metric. Texts appear in docs/reproduction.md.

use super::citation::{FIG_9, FIG_12};
use super::claim::ClaimQuantity::{Mean, Ratio};
use super::claim::DeviceCounts::{All, At};
use super::claim::Statement::{About, Below, Falls, Rises};
use super::claim::{Claim, ClaimTopic};

const HALF_OF_EACH: &str = "The sentence does not state half of which value; read as half of each of the others, one \
    claim each.";
const THREE_HALVES: &str = "Half of adjusted's 17, of q-learning's 9.5 and of knn's less than 6 are 8.5, 4.75 and less \
    than 3: at most one of the three halves can hold.";

/// Claims on Fig. 12a.
pub(super) const ACTIVATIONS: ClaimTopic = ClaimTopic {
    metric: "wrong_activations_per_event",
    is_per_device: false,
    metric_description: "wrong activations per event, devices",
    paper_figure: "Fig. 12a",
    metric_reason: "",
    claims: &[
        Claim::new("knn", All, Mean, Rises, FIG_12.sentence(5)),
        Claim::new("adjusted", All, Mean, Rises, FIG_12.sentence(5)),
        Claim::new("q-learning", All, Mean, Rises, FIG_12.sentence(5)),
        Claim::new("dt", All, Mean, Rises, FIG_12.sentence(5)),
        Claim::new("adjusted", At(250), Mean, About(17.0), FIG_12.sentence(6)),
        Claim::new("q-learning", At(250), Mean, About(9.5), FIG_12.sentence(6)),
        Claim::new("knn", At(250), Mean, Below(6.0), FIG_12.sentence(6)),
        Claim::new("dt", At(250), Ratio(&["knn"]), About(0.5), FIG_12.sentence(7))
            .interpreted_as(HALF_OF_EACH)
            .contradicting(FIG_12.sentence(6), THREE_HALVES),
        Claim::new("dt", At(250), Ratio(&["adjusted"]), About(0.5), FIG_12.sentence(7))
            .interpreted_as(HALF_OF_EACH)
            .contradicting(FIG_12.sentence(6), THREE_HALVES),
        Claim::new("dt", At(250), Ratio(&["q-learning"]), About(0.5), FIG_12.sentence(7))
            .interpreted_as(HALF_OF_EACH)
            .contradicting(FIG_12.sentence(6), THREE_HALVES),
        Claim::new(
            "dt",
            At(250),
            Ratio(&["knn", "adjusted", "q-learning"]),
            Below(1.0),
            FIG_12.sentence(7),
        ),
    ],
};

/// Claims on Fig. 12b.
pub(super) const WASTED: ClaimTopic = ClaimTopic {
    metric: "wasted_energy_per_event",
    is_per_device: true,
    metric_description: "energy wasted per event and device, units",
    paper_figure: "Fig. 12b",
    metric_reason: "The text states the wasted energy per IoTD, like the consumption: the energy wasted per event, \
        divided by N.",
    claims: &[
        Claim::new("genie", All, Mean, About(0.0), FIG_12.sentence(4)).contradicting(
            FIG_9.sentence(11),
            "There the closest device lacks the energy to transmit at 0.001 % of events, which wastes its remaining \
             energy.",
        ),
        Claim::new("knn", All, Mean, Falls, FIG_12.sentence(5)),
        Claim::new("adjusted", All, Mean, Falls, FIG_12.sentence(5)),
        Claim::new("q-learning", All, Mean, Falls, FIG_12.sentence(5)),
        Claim::new("dt", All, Mean, Falls, FIG_12.sentence(5)),
        Claim::new("dt", All, Mean, Below(1.5), FIG_12.sentence(7)),
    ],
};
