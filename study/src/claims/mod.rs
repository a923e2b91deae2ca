//! The paper's claims on its simulations, as data: the abstract, Sec. I-B, Sec. VI-A (the text on Figs. 7 to 12), the
//! extremes of consumption in Sec. VI-B, and Sec. VII.
//!
//! Values come from the text, which says "around", "up to" and "below"; none are read off the curves. A claim cites its
//! sentence without quoting it. The statements on λ (Figs. 13 and 14) are in [`crate::analysis::harvest::STATED`].
//!
//! Three kinds of statement are excluded. The first concerns the authors' earlier paper (11 times fewer misdetections,
//! half the energy), whose method is not simulated here. The second is reasons given for results. The third has no
//! measure, such as the negligible cost for devices and load of the control channel (Sec. V-D).

mod battery;
mod citation;
mod claim;
mod energy;
mod information;
mod misdetection;
mod wrong_activations;

pub use citation::Citation;
pub(crate) use citation::{FIG_8, FIG_13, FIG_14};
pub use claim::{Claim, ClaimQuantity, ClaimTopic, Contradiction, DeviceCounts, Statement};

/// All claims, by figure.
pub(crate) const TOPICS: &[ClaimTopic] = &[
    information::OVER_TIME,
    information::PER_EVENT,
    energy::ENERGY,
    misdetection::MISSED,
    misdetection::UNABLE,
    battery::LOW,
    battery::LEVEL,
    wrong_activations::ACTIVATIONS,
    wrong_activations::WASTED,
];

/// The policies that the paper names, in the order of tables and legends.
pub const POLICIES: [&str; 6] = ["knn", "adjusted", "q-learning", "dt", "random", "genie"];

/// Returns the claims on the figure `source` of the paper that are judged on `metric`.
pub fn on(source: &str, metric: &str) -> &'static [Claim] {
    let own = |topic: &&ClaimTopic| topic.source == source && topic.metric == metric;
    TOPICS.iter().find(own).map_or(&[], |topic| topic.claims)
}

#[cfg(test)]
mod tests;
