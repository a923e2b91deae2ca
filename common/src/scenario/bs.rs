//! Settings of the base station.

use crate::declare;
use crate::declare::{choice, choices, whole};
use crate::ids::MAX_TTIS;

choices! {
    /// How wake-up candidates are ranked.
    pub enum WakeUpRanking {
        /// By `P_4,2`, the probability that a device senses what another has reported (Sec. III).
        P42 = "p42",
        /// By the expected gain of information under a belief over the epicentre, which every report and every silent
        /// device in S1 narrows down.
        Posterior = "posterior",
    }
}

choices! {
    /// What the base station knows of batteries.
    pub enum BatteryKnowledge {
        /// The true levels, as in the paper's state 𝒯(k).
        Oracle = "oracle",
        /// The level that each report carries, carried forward by what was commanded and the mean harvest.
        Reported = "reported",
    }
}

declare! {
    /// The base station.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct BsSettings in "bs" {
        /// Time between two synchronisation broadcasts of the δ plan, far longer than a TTI.
        pub sync_interval: u64 = whole(1, MAX_TTIS, 1000).unit("TTIs").source("Sec. V-D"),
        /// How wake-up candidates are ranked.
        pub ranking: WakeUpRanking = choice::<WakeUpRanking>("p42").source("Sec. III"),
        /// What a policy that looks at batteries is told of them.
        pub battery_knowledge: BatteryKnowledge = choice::<BatteryKnowledge>("oracle").source("Sec. V-B"),
    }
}
