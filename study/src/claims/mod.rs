//! What the paper claims of its simulations, as data: the abstract, Sec. I-B, Sec. VI-A (the text on Figs. 7 to 12),
//! the ends of consumption that Sec. VI-B names, and Sec. VII.
//!
//! Values are read off the text, which says "around", "up to" and "below"; nothing is read off the curves. A claim
//! names its sentence, not its words. The statements on λ (Figs. 13 and 14) are in
//! [`crate::analysis::harvest::STATED`].
//!
//! Not here: what the introduction says of the authors' earlier paper (11 times fewer misdetections, half the energy),
//! whose method is not the one simulated; reasons that the text gives for its results; and what has no measure, as that
//! the cost for the devices and the load of the control channel are negligible (Sec. V-D).

mod battery;
mod caveats;
mod claim;
mod energy;
mod information;
mod misdetection;
mod place;
mod wrong;

pub use claim::{Claim, Contradiction, Quantity, Sites, Statement, Topic};
pub use place::{FIG_8, FIG_13, FIG_14, Place};

/// All claims, by figure.
pub const TOPICS: &[Topic] = &[
    information::OVER_TIME,
    information::PER_EVENT,
    energy::ENERGY,
    misdetection::MISSED,
    misdetection::UNABLE,
    battery::LOW,
    battery::LEVEL,
    wrong::ACTIVATIONS,
    wrong::WASTED,
];

/// The policies that the paper names, in the order of tables and legends.
pub const POLICIES: [&str; 6] = ["knn", "adjusted", "q-learning", "dt", "random", "genie"];

/// The claims on the figure `source` of the paper that are judged on `metric`.
pub fn on(source: &str, metric: &str) -> &'static [Claim] {
    let own = |topic: &&Topic| topic.source == source && topic.metric == metric;
    TOPICS.iter().find(own).map_or(&[], |topic| topic.claims)
}

#[cfg(test)]
mod tests;
