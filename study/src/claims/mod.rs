//! The paper's claims on its simulations, as data: the abstract, Sec. I-B, Sec. VI-A (the text on Figs. 7 to 12), the
//! extremes of consumption in Sec. VI-B, and Sec. VII. [`crate::report`] judges them, and [`crate::figures`] draws
//! them.
//!
//! Values come from the text, which says "around", "up to" and "below"; none are read off the curves. A claim cites its
//! sentence without quoting it. The statements on λ (Figs. 13 and 14) are in
//! [`crate::analysis::harvest::STATED_THRESHOLDS`]. A test compares all numbers with a transcript of the sentences.
//!
//! The order of the claims numbers them for [`crate::report::search`]: a claim added in the middle moves all later ones
//! to the other half of that search. A change of a claim or text also changes docs/reproduction.md, which
//! `reveille report --page` writes from result tables.
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

/// All claims, in the order of the paper's figures. Topics of one figure must be neighbours: the report groups
/// neighbouring rows.
pub(crate) const TOPICS: &[ClaimTopic] = &[
    information::P1_OBJECTIVE,
    information::PER_EVENT,
    energy::ENERGY,
    misdetection::MISDETECTIONS,
    misdetection::GENIE_WITHOUT_ENERGY,
    battery::LOW_ENERGY,
    battery::MEAN_BATTERY,
    wrong_activations::ACTIVATIONS,
    wrong_activations::WASTED,
];

/// The policies that the paper names, in the order of tables and legends.
pub const POLICIES: [&str; 6] = ["knn", "adjusted", "q-learning", "dt", "random", "genie"];

/// Returns the claims on the figure `paper_figure` of the paper that are judged on `metric`; empty without a topic.
pub fn claims_on(paper_figure: &str, metric: &str) -> &'static [Claim] {
    let is_requested = |topic: &&ClaimTopic| topic.paper_figure == paper_figure && topic.metric == metric;
    TOPICS.iter().find(is_requested).map_or(&[], |topic| topic.claims)
}

#[cfg(test)]
mod tests;
