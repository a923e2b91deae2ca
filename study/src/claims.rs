//! What the paper reports of its simulations, as data: the text on its Figs. 8 to 12 (Sec. VI-A).
//!
//! Values are read off the text, which says "around", "up to" and "below"; nothing is read off the curves. The
//! statements on λ (Figs. 13 and 14) are in [`crate::analysis::harvest::STATED`].

use self::Relation::{About, Above, Below, Between, Times};
use self::Sites::{At, Everywhere, Under};

/// For which N a claim is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sites {
    /// This N.
    At(u32),
    /// All N below this.
    Under(u32),
    /// All N.
    Everywhere,
}

impl Sites {
    /// Whether the claim is made for `n` devices.
    pub const fn holds(self, n: u32) -> bool {
        match self {
            At(own) => n == own,
            Under(limit) => n < limit,
            Everywhere => true,
        }
    }
}

/// What a claim says of a metric's mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Relation {
    /// The mean is about this value.
    About(f64),
    /// The mean is between these values.
    Between(f64, f64),
    /// The mean is less than this value.
    Below(f64),
    /// The mean is more than this value.
    Above(f64),
    /// The mean is this many times that of another policy.
    Times(f64, &'static str),
}

impl Relation {
    /// The values that the claim allows, from and to, without any tolerance; `None` for a ratio.
    pub const fn range(self) -> Option<(f64, f64)> {
        match self {
            About(v) => Some((v, v)),
            Between(low, high) => Some((low, high)),
            Below(v) => Some((f64::NEG_INFINITY, v)),
            Above(v) => Some((v, f64::INFINITY)),
            Times(..) => None,
        }
    }
}

/// One claim.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Claim {
    /// The policy.
    pub policy: &'static str,
    /// The N for which the claim is made.
    pub sites: Sites,
    /// What it says.
    pub relation: Relation,
    /// Why we should not expect to meet it as written, if the model says so; empty otherwise.
    pub caveat: &'static str,
}

/// The claims on one metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Topic {
    /// The metric's name.
    pub metric: &'static str,
    /// What it is, in words, with its unit.
    pub about: &'static str,
    /// Where the paper says so.
    pub source: &'static str,
    /// What keeps all of them from being met as written, if that is known; empty otherwise.
    pub remark: &'static str,
    /// The claims.
    pub claims: &'static [Claim],
}

const fn claim(policy: &'static str, sites: Sites, relation: Relation) -> Claim {
    Claim {
        policy,
        sites,
        relation,
        caveat: "",
    }
}

const fn doubted(claim: Claim, caveat: &'static str) -> Claim {
    Claim { caveat, ..claim }
}

const CLOSEST: &str = "Under g = max no event gives more than its closest device reports, on a uniform layout of 250 \
    devices 0.55 on the mean, and devices within reach do not add up.";
const WUR_FLOOR: &str = "A device that always listens spends E_WuR = 1/14 = 0.0714 units in every TTI, so 0.055 lies \
    below what the genie's sleepers alone spend.";
const REACH: &str = "Ten devices of d_max = 4 m at random places leave a quarter or so of 20 × 20 m out of everyone's \
    reach: an event there is lost whoever is woken.";
const SPARING: &str = "Of the duty cycles of its grid, adjusted takes the one that spends least among those that reach \
    I_min; the paper states neither its grid nor the cycle it found, and its devices must sense more often.";
const UNSEEN: &str = "A dozen or so devices sense at a time, which leaves part of the area unwatched in any one TTI.";

/// All claims, by figure.
pub const TOPICS: &[Topic] = &[
    Topic {
        metric: "info_per_event",
        about: "information per event",
        source: "Fig. 7",
        remark: "",
        claims: &[
            claim("knn", At(250), About(0.4)),
            claim("adjusted", At(250), About(0.4)),
            doubted(claim("q-learning", At(250), About(0.72)), CLOSEST),
            doubted(claim("genie", At(250), About(0.72)), CLOSEST),
            claim("random", At(250), About(0.72 / 4.5)),
        ],
    },
    Topic {
        metric: "energy_per_device_tti",
        about: "energy per device and TTI, units",
        source: "Fig. 8",
        remark: "",
        claims: &[
            claim("knn", At(10), Between(0.45, 0.83)),
            doubted(claim("adjusted", At(10), Between(0.45, 0.83)), SPARING),
            claim("q-learning", At(10), Between(0.45, 0.83)),
            claim("dt", At(10), Between(0.45, 0.83)),
            claim("random", At(10), About(0.34)),
            claim("knn", At(250), About(0.145)),
            claim("random", At(250), Above(0.18)),
            claim("q-learning", At(250), About(0.24)),
            doubted(claim("adjusted", At(250), About(0.32)), SPARING),
            claim("dt", At(250), Times(0.6, "q-learning")),
            claim("dt", At(250), Times(0.9, "knn")),
            doubted(claim("genie", At(250), About(0.055)), WUR_FLOOR),
        ],
    },
    Topic {
        metric: "misdetection_pct",
        about: "misdetections, % of events",
        source: "Fig. 9",
        remark: "",
        claims: &[
            claim("knn", At(10), About(33.0)),
            claim("adjusted", At(10), About(58.0)),
            claim("random", At(10), About(77.0)),
            doubted(claim("genie", At(10), About(2.0)), REACH),
            doubted(claim("knn", At(250), Below(0.01)), UNSEEN),
            doubted(claim("q-learning", At(250), Below(0.01)), UNSEEN),
            claim("random", At(250), About(7.0)),
            claim("genie", At(250), About(0.003)),
            claim("adjusted", Under(200), Above(2.0)),
        ],
    },
    Topic {
        metric: "low_energy_pct",
        about: "devices with B < E_Tx, %",
        source: "Fig. 10",
        remark: "",
        claims: &[
            claim("knn", At(10), About(67.0)),
            claim("q-learning", At(10), About(67.0)),
            claim("knn", At(250), Between(8.0, 13.0)),
            claim("q-learning", At(250), Between(8.0, 13.0)),
            doubted(claim("adjusted", Everywhere, Between(30.0, 45.0)), SPARING),
            claim("dt", At(250), Times(0.5, "q-learning")),
        ],
    },
    Topic {
        metric: "mean_battery",
        about: "mean battery, units",
        source: "Fig. 11",
        remark: "",
        claims: &[
            claim("knn", At(10), About(10.0)),
            claim("q-learning", At(10), About(10.0)),
            claim("knn", At(250), Between(72.0, 86.0)),
            claim("q-learning", At(250), Between(72.0, 86.0)),
            doubted(claim("adjusted", Everywhere, Between(31.0, 54.0)), SPARING),
            claim("dt", At(10), About(40.0)),
            claim("dt", At(250), About(88.0)),
        ],
    },
    Topic {
        metric: "wrong_activations_per_event",
        about: "wrong activations per event, devices",
        source: "Fig. 12a",
        remark: "",
        claims: &[
            claim("adjusted", At(250), About(17.0)),
            claim("q-learning", At(250), About(9.5)),
            claim("knn", At(250), Below(6.0)),
            claim("dt", At(250), Times(0.5, "knn")),
            claim("dt", At(250), Times(0.5, "adjusted")),
            claim("dt", At(250), Times(0.5, "q-learning")),
        ],
    },
    Topic {
        metric: "wasted_energy_per_event",
        about: "energy wasted per event, units",
        source: "Fig. 12b",
        remark: "",
        claims: &[
            claim("genie", Everywhere, About(0.0)),
            claim("dt", Everywhere, Below(1.5)),
        ],
    },
];

/// The claims on the metric of this name.
pub fn topic(metric: &str) -> Option<&'static Topic> {
    TOPICS.iter().find(|topic| topic.metric == metric)
}

/// The policies that the paper names, in the order of tables and legends.
pub const POLICIES: [&str; 6] = ["knn", "adjusted", "q-learning", "dt", "random", "genie"];

#[cfg(test)]
mod tests {
    use reveille_common::score::Metrics;

    use super::*;

    #[test]
    fn every_claim_names_a_metric_and_policies_that_exist() {
        let metrics = Metrics::NAMES;
        for topic in TOPICS {
            assert!(metrics.contains(&topic.metric), "{}", topic.metric);
            for claim in topic.claims {
                assert!(POLICIES.contains(&claim.policy), "{claim:?}");
                if let Times(factor, other) = claim.relation {
                    assert!(POLICIES.contains(&other) && other != claim.policy, "{claim:?}");
                    assert!(factor > 0.0);
                } else {
                    let (low, high) = claim.relation.range().expect("a range");
                    assert!(low <= high, "{claim:?}");
                }
            }
        }
    }

    #[test]
    fn no_claim_is_made_twice() {
        for topic in TOPICS {
            for (i, a) in topic.claims.iter().enumerate() {
                assert!(!topic.claims[..i].contains(a), "{}: {a:?}", topic.metric);
            }
        }
    }

    #[test]
    fn sites_end_where_they_say() {
        assert!(Under(200).holds(199) && !Under(200).holds(200));
        assert!(At(10).holds(10) && !At(10).holds(11) && Everywhere.holds(7));
    }
}
