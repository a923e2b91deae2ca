//! The types of a claim of the paper, which `reveille report` compares with runs, and the caveats that several figures
//! share. A [`Claim`] is a [`Statement`] on a [`ClaimQuantity`] of one policy, for some numbers of devices. The
//! neighbouring modules hold the claims themselves, one module for each subject. The report and docs/reproduction.md
//! contain the texts: `reveille report --page` writes them into the page.

use super::citation::Citation;

/// Range of N in the paper's figures (Sec. VI).
const PAPER_N_RANGE: (u32, u32) = (10, 250);

/// The N of a claim, within the paper's 10 to 250.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceCounts {
    /// This N.
    At(u32),
    /// All N below this.
    Under(u32),
    /// All N up to this one.
    UpTo(u32),
    /// All N above this.
    Over(u32),
    /// All N of the paper's figures.
    All,
}

impl DeviceCounts {
    /// Smallest and largest N.
    pub const fn range(self) -> (u32, u32) {
        let (smallest, largest) = PAPER_N_RANGE;
        match self {
            Self::At(n) => (n, n),
            Self::Under(n) => (smallest, n - 1),
            Self::UpTo(n) => (smallest, n),
            Self::Over(n) => (n + 1, largest),
            Self::All => PAPER_N_RANGE,
        }
    }

    /// Whether the claim covers `n` devices.
    pub const fn contains(self, n: u32) -> bool {
        let (from, to) = self.range();
        from <= n && n <= to
    }
}

/// Quantity that a claim is about, at each N.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClaimQuantity {
    /// Mean of the metric.
    Mean,
    /// The mean divided by the mean of each of these policies: every ratio must satisfy the statement. Policies without
    /// runs are left out.
    Ratio(&'static [&'static str]),
    /// Absolute difference between the mean and the mean of this policy.
    Gap(&'static str),
    /// The mean divided by the policy's mean at this N.
    Growth(u32),
}

/// Statement on the quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Statement {
    /// About this value, at each N; [`report::judge`](crate::report::judge) sets the tolerance.
    About(f64),
    /// Within a range, at each N.
    Between(f64, f64),
    /// Less than this value, at each N.
    Below(f64),
    /// More than this value, at each N.
    Above(f64),
    /// The largest over N is about this value: "up to".
    Largest(f64),
    /// The smallest over N is about this value: "down to".
    Smallest(f64),
    /// About equal at every N.
    Constant,
    /// Falls as N rises.
    Falls,
    /// Rises with N.
    Rises,
}

impl Statement {
    /// Range of values that the statement allows at each N, without tolerance; `None` for a statement on several N
    /// together.
    pub const fn range(self) -> Option<(f64, f64)> {
        match self {
            Self::About(v) => Some((v, v)),
            Self::Between(low, high) => Some((low, high)),
            Self::Below(v) => Some((f64::NEG_INFINITY, v)),
            Self::Above(v) => Some((v, f64::INFINITY)),
            Self::Largest(_) | Self::Smallest(_) | Self::Constant | Self::Falls | Self::Rises => None,
        }
    }

    /// Values named in the statement.
    pub fn values(self) -> Vec<f64> {
        match self {
            Self::About(v) | Self::Below(v) | Self::Above(v) | Self::Largest(v) | Self::Smallest(v) => vec![v],
            Self::Between(low, high) => vec![low, high],
            Self::Constant | Self::Falls | Self::Rises => Vec::new(),
        }
    }
}

/// Another statement of the paper that excludes a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contradiction {
    /// Place of the other statement.
    pub other_citation: Citation,
    /// Reason why not both can hold, in full sentences.
    pub reason: &'static str,
}

/// A claim of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Claim {
    /// Policy of the claim.
    pub policy: &'static str,
    /// The N of the claim.
    pub device_counts: DeviceCounts,
    /// Quantity of the claim.
    pub quantity: ClaimQuantity,
    /// Statement on the quantity.
    pub statement: Statement,
    /// Place of the claim in the paper.
    pub citation: Citation,
    /// Second place with the same claim.
    pub second_citation: Option<Citation>,
    /// Chosen reading of an ambiguous sentence, in full sentences; empty otherwise.
    pub interpretation: &'static str,
    /// Reason why the model makes the claim unlikely to be met as written, in full sentences; empty otherwise.
    pub caveat: &'static str,
    /// Contradiction with another statement, if any.
    pub contradicts: Option<Contradiction>,
}

impl Claim {
    /// Creates a claim without further notes.
    pub const fn new(
        policy: &'static str,
        device_counts: DeviceCounts,
        quantity: ClaimQuantity,
        statement: Statement,
        citation: Citation,
    ) -> Self {
        Self {
            policy,
            device_counts,
            quantity,
            statement,
            citation,
            second_citation: None,
            interpretation: "",
            caveat: "",
            contradicts: None,
        }
    }

    /// Adds the second place with the same claim.
    #[must_use]
    pub const fn also_at(self, second_citation: Citation) -> Self {
        Self {
            second_citation: Some(second_citation),
            ..self
        }
    }

    /// Adds the chosen reading of the sentence.
    #[must_use]
    pub const fn interpreted_as(self, interpretation: &'static str) -> Self {
        Self { interpretation, ..self }
    }

    /// Adds `caveat`, the reason why the claim is unlikely to be met.
    #[must_use]
    pub(crate) const fn with_caveat(self, caveat: &'static str) -> Self {
        Self { caveat, ..self }
    }

    /// Adds a contradiction with the statement at `other_citation`.
    #[must_use]
    pub const fn contradicting(self, other_citation: Citation, reason: &'static str) -> Self {
        Self {
            contradicts: Some(Contradiction { other_citation, reason }),
            ..self
        }
    }
}

/// The claims on one metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClaimTopic {
    /// Name of the metric, from `Metrics::NAMES`. Together with `paper_figure` it is the key of [`super::claims_on`].
    pub metric: &'static str,
    /// Whether the metric is divided by N.
    pub is_per_device: bool,
    /// Description of the metric, with its unit.
    pub metric_description: &'static str,
    /// Figure of the paper, for example `Fig. 12a`: the heading of the topic's rows in the report.
    pub paper_figure: &'static str,
    /// Reason for the choice of metric, if the paper's words allow several; empty otherwise.
    pub metric_reason: &'static str,
    /// Claims of the topic.
    pub claims: &'static [Claim],
}

// The numbers in the caveats hold for d_max, η, Ψ, energies and harvest of the presets `paper` and `paper-literal`. The
// tests of `claims` recompute the numbers of the hexagons and the fixed cycles; no test checks the others.

/// Caveat for the 0.72 of q-learning and the genie with 250 devices, Fig. 7.
pub(super) const CLOSEST_DEVICE: &str = "Under g = max an event gives at most the information of its closest device. \
    With 250 devices on 20 × 20 m the mean of that is 0.55 at random positions, 0.59 on a jittered grid, and 0.63 in \
    the best possible layout, a lattice of regular hexagons.";
/// Caveat for the genie's 0.055 units, Fig. 8.
pub(super) const WUR_FLOOR: &str = "A device that always listens spends E_WuR = 1/14 = 0.0714 units in every TTI, so \
    0.055 is less than the consumption of the genie's sleeping devices alone.";
/// Caveat for claims on adjusted, or relative to it: its devices sense too rarely here.
pub(super) const RARE_SENSING: &str = "From its grid, adjusted takes the duty cycle with the lowest consumption that \
    reaches I_min. With few devices I_min is almost 0, because p falls with the distance. The paper states neither its \
    grid nor the chosen cycle; its devices must sense more often.";
/// Caveat for random as the policy with the least consumption at N = 100, Fig. 14.
pub(super) const FIXED_CYCLE: &str = "The duty cycles of Sec. VI, t_on of 1 or 2 in t_DRX of 2, 4 or 8, make a device \
    sense in 0.44 of all TTIs on average, for every N: about 0.48 units where the harvest allows it. This consumption \
    does not fall with N.";
/// Caveat for the genie's 2 % of misdetections with ten devices, Fig. 9.
pub(super) const AREA_OUT_OF_REACH: &str = "Ten discs of d_max = 4 m cannot cover 20 × 20 m in any layout; that needs \
    d_max ≥ 4.36 m. At random positions they leave a third of the area out of reach, on a jittered grid a quarter. No \
    wake-up can report an event there.";
/// Caveat for knn's misdetections with 250 devices, Fig. 9.
pub(super) const PARTIAL_COVERAGE: &str = "One device of each cluster senses, about a dozen in all, so in any TTI part \
    of the area is not covered.";
/// Caveat for the 0.83 units of q-learning with ten devices, which exceed the harvest, Fig. 8.
pub(super) const HARVEST_LIMIT: &str = "In the long run devices cannot spend more than they harvest, 0.45 units under \
    Eq. (5) with λ = 0.1 and E_B = 5 as in the presets.";
/// Caveat for the genie's misdetection of one event in 100 000, Fig. 9.
pub(super) const TOO_FEW_EVENTS: &str = "The genie's devices sleep until they are woken, so their batteries are nearly \
    full. About 400 000 events are needed to distinguish one in 100 000 from none.";
