//! Figs. 10 and 11: batteries.

use super::citation::FIG_10;
use super::claim::ClaimQuantity::{Growth, Own};
use super::claim::DeviceCounts::{At, Everywhere};
use super::claim::Statement::{About, Above, Between, Falls, Level, Rises};
use super::claim::{Claim, ClaimTopic, SPARING};

const SAME: &str = "The same level is read as the same over N, for each of the two methods.";

/// Claims on Fig. 10.
pub(super) const LOW: ClaimTopic = ClaimTopic {
    metric: "low_energy_pct",
    is_per_device: false,
    about: "devices with B < E_Tx, %",
    source: "Fig. 10",
    reading: "",
    claims: &[
        Claim::new("random", Everywhere, Own, Level, FIG_10.sentence(3)).interpreted_as(SAME),
        Claim::new("genie", Everywhere, Own, Level, FIG_10.sentence(3)).interpreted_as(SAME),
        Claim::new("knn", Everywhere, Own, Falls, FIG_10.sentence(4)),
        Claim::new("q-learning", Everywhere, Own, Falls, FIG_10.sentence(4)),
        Claim::new("knn", At(10), Own, About(67.0), FIG_10.sentence(4)),
        Claim::new("q-learning", At(10), Own, About(67.0), FIG_10.sentence(4)),
        Claim::new("knn", At(250), Own, Between(8.0, 13.0), FIG_10.sentence(4)),
        Claim::new("q-learning", At(250), Own, Between(8.0, 13.0), FIG_10.sentence(4)),
        Claim::new("adjusted", Everywhere, Own, Between(30.0, 45.0), FIG_10.sentence(6)).with_caveat(SPARING),
        Claim::new("dt", At(250), Growth(10), About(0.5), FIG_10.sentence(7)).interpreted_as(
            "\"Also decrease\" is read as a fall over N, as the 4th sentence states for knn and q-learning: to half of \
             the value at N = 10. Half of the value of q-learning would be another reading.",
        ),
    ],
};

/// Claims on Fig. 11.
pub(super) const LEVEL: ClaimTopic = ClaimTopic {
    metric: "mean_battery",
    is_per_device: false,
    about: "mean battery, units",
    source: "Fig. 11",
    reading: "",
    claims: &[
        Claim::new("random", Everywhere, Own, Level, FIG_10.sentence(3)).interpreted_as(SAME),
        Claim::new("genie", Everywhere, Own, Level, FIG_10.sentence(3)).interpreted_as(SAME),
        Claim::new("knn", Everywhere, Own, Rises, FIG_10.sentence(5)),
        Claim::new("q-learning", Everywhere, Own, Rises, FIG_10.sentence(5)),
        Claim::new("knn", At(10), Own, About(10.0), FIG_10.sentence(5)),
        Claim::new("q-learning", At(10), Own, About(10.0), FIG_10.sentence(5)),
        Claim::new("knn", At(250), Own, Between(72.0, 86.0), FIG_10.sentence(5)),
        Claim::new("q-learning", At(250), Own, Between(72.0, 86.0), FIG_10.sentence(5)),
        Claim::new("adjusted", Everywhere, Own, Between(31.0, 54.0), FIG_10.sentence(6)).with_caveat(SPARING),
        Claim::new("dt", Everywhere, Own, Above(40.0), FIG_10.sentence(7)),
        Claim::new("dt", At(250), Own, About(88.0), FIG_10.sentence(7)),
    ],
};
