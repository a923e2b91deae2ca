//! Fig. 9: misdetections.

use super::citation::FIG_9;
use super::claim::ClaimQuantity::{Own, Ratio};
use super::claim::DeviceCounts::{At, Everywhere, Under};
use super::claim::Statement::{About, Above, Below, Falls, Largest, Level};
use super::claim::{Claim, ClaimTopic, RARE, REACH, SPARING, UNSEEN};

/// Claims on Fig. 9.
pub(super) const MISSED: ClaimTopic = ClaimTopic {
    metric: "misdetection_pct",
    is_per_device: false,
    about: "misdetections, % of events",
    source: "Fig. 9",
    reading: "",
    claims: &[
        Claim::new("knn", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("adjusted", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("q-learning", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("dt", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("random", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("genie", Everywhere, Own, Falls, FIG_9.sentence(2)),
        Claim::new("knn", At(10), Own, About(33.0), FIG_9.sentence(3)),
        Claim::new("adjusted", At(10), Own, About(58.0), FIG_9.sentence(3)).with_caveat(SPARING),
        Claim::new("random", At(10), Own, About(77.0), FIG_9.sentence(3)),
        Claim::new("knn", At(250), Own, Below(0.01), FIG_9.sentence(4)).with_caveat(UNSEEN),
        Claim::new("q-learning", At(250), Own, Below(0.01), FIG_9.sentence(4)),
        Claim::new("random", At(250), Own, About(7.0), FIG_9.sentence(5)),
        Claim::new(
            "knn",
            Everywhere,
            Ratio(&["adjusted", "random"]),
            Below(1.0),
            FIG_9.sentence(6),
        ),
        Claim::new(
            "q-learning",
            Everywhere,
            Ratio(&["adjusted", "random"]),
            Below(1.0),
            FIG_9.sentence(6),
        ),
        Claim::new(
            "dt",
            Everywhere,
            Ratio(&["adjusted", "random"]),
            Below(1.0),
            FIG_9.sentence(6),
        ),
        Claim::new(
            "random",
            Everywhere,
            Ratio(&["adjusted"]),
            Largest(3.0),
            FIG_9.sentence(7),
        )
        .interpreted_as("Better by up to 200 % is read as up to three times as many events missed by random.")
        .with_caveat(SPARING),
        Claim::new("adjusted", Under(200), Own, Above(2.0), FIG_9.sentence(7)),
        Claim::new("genie", At(10), Own, About(2.0), FIG_9.sentence(8)).with_caveat(REACH),
        Claim::new("genie", At(250), Own, About(0.003), FIG_9.sentence(8)),
        Claim::new("genie", Everywhere, Own, Above(0.001), FIG_9.sentence(11)).interpreted_as(
            "A lower bound is read as a bound on the genie's misdetections, the subject of the \
                sentence.",
        ),
    ],
};

/// Claims on the events that the genie misses because of an empty battery.
pub(super) const UNABLE: ClaimTopic = ClaimTopic {
    metric: "wrong_activations_per_event",
    is_per_device: false,
    about: "devices per event that detect it and cannot transmit",
    source: "Fig. 9",
    reading: "The genie wakes the closest device alone, and only one within d_max, so that its wrong activations are \
        the devices that detect and lack the energy to transmit. 0.001 % of events is 0.00001 an event.",
    claims: &[
        Claim::new("genie", Everywhere, Own, About(0.00001), FIG_9.sentence(11)).with_caveat(RARE),
        Claim::new("genie", Everywhere, Own, Level, FIG_9.sentence(11)),
    ],
};
