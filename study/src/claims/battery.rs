//! Claims on batteries: the share of devices with low energy (Fig. 10) and the mean level (Fig. 11). Numbers are
//! transcribed from the cited sentences, which a test checks. `metric` and `paper_figure` are the keys by which figures
//! find claims ([`super::claims_on`]). The order of the claims numbers them for [`crate::report::search`], so a claim
//! in the middle moves later ones to the other half of the search. An empty `metric_reason` means that the paper's
//! words allow no other metric. Texts appear in docs/reproduction.md.

use super::citation::FIGS_10_11;
use super::claim::ClaimQuantity::{Growth, Mean};
use super::claim::DeviceCounts::{All, At};
use super::claim::Statement::{About, Above, Between, Constant, Falls, Rises};
use super::claim::{Claim, ClaimTopic, RARE_SENSING};

const SAME_OVER_N: &str = "The same level is read as the same over N, for each of the two methods.";

/// Claims on Fig. 10.
pub(super) const LOW_ENERGY: ClaimTopic = ClaimTopic {
    metric: "low_energy_pct",
    is_per_device: false,
    metric_description: "devices with B < E_Tx, %",
    paper_figure: "Fig. 10",
    metric_reason: "",
    claims: &[
        Claim::new("random", All, Mean, Constant, FIGS_10_11.sentence(3)).interpreted_as(SAME_OVER_N),
        Claim::new("genie", All, Mean, Constant, FIGS_10_11.sentence(3)).interpreted_as(SAME_OVER_N),
        Claim::new("knn", All, Mean, Falls, FIGS_10_11.sentence(4)),
        Claim::new("q-learning", All, Mean, Falls, FIGS_10_11.sentence(4)),
        Claim::new("knn", At(10), Mean, About(67.0), FIGS_10_11.sentence(4)),
        Claim::new("q-learning", At(10), Mean, About(67.0), FIGS_10_11.sentence(4)),
        Claim::new("knn", At(250), Mean, Between(8.0, 13.0), FIGS_10_11.sentence(4)),
        Claim::new("q-learning", At(250), Mean, Between(8.0, 13.0), FIGS_10_11.sentence(4)),
        Claim::new("adjusted", All, Mean, Between(30.0, 45.0), FIGS_10_11.sentence(6)).with_caveat(RARE_SENSING),
        Claim::new("dt", At(250), Growth(10), About(0.5), FIGS_10_11.sentence(7)).interpreted_as(
            "\"Also decrease\" is read as a fall over N, as the 4th sentence states for knn and q-learning: to half of \
             the value at N = 10. Half of the value of q-learning would be another reading.",
        ),
    ],
};

/// Claims on Fig. 11.
pub(super) const MEAN_BATTERY: ClaimTopic = ClaimTopic {
    metric: "mean_battery",
    is_per_device: false,
    metric_description: "mean battery, units",
    paper_figure: "Fig. 11",
    metric_reason: "",
    claims: &[
        Claim::new("random", All, Mean, Constant, FIGS_10_11.sentence(3)).interpreted_as(SAME_OVER_N),
        Claim::new("genie", All, Mean, Constant, FIGS_10_11.sentence(3)).interpreted_as(SAME_OVER_N),
        Claim::new("knn", All, Mean, Rises, FIGS_10_11.sentence(5)),
        Claim::new("q-learning", All, Mean, Rises, FIGS_10_11.sentence(5)),
        Claim::new("knn", At(10), Mean, About(10.0), FIGS_10_11.sentence(5)),
        Claim::new("q-learning", At(10), Mean, About(10.0), FIGS_10_11.sentence(5)),
        Claim::new("knn", At(250), Mean, Between(72.0, 86.0), FIGS_10_11.sentence(5)),
        Claim::new("q-learning", At(250), Mean, Between(72.0, 86.0), FIGS_10_11.sentence(5)),
        Claim::new("adjusted", All, Mean, Between(31.0, 54.0), FIGS_10_11.sentence(6)).with_caveat(RARE_SENSING),
        Claim::new("dt", All, Mean, Above(40.0), FIGS_10_11.sentence(7)),
        Claim::new("dt", At(250), Mean, About(88.0), FIGS_10_11.sentence(7)),
    ],
};
