//! What a claim is: of a policy, at some N, a statement on a quantity.

use super::place::Place;
use Statement::{Above, Below, Between};

/// The N of the paper's figures, from and to (Sec. VI).
const AXIS: (u32, u32) = (10, 250);

/// For which N a claim is made, within the paper's 10 to 250.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sites {
    /// This N.
    At(u32),
    /// All N below this.
    Under(u32),
    /// All N up to this one.
    UpTo(u32),
    /// All N above this.
    Over(u32),
    /// All N.
    Everywhere,
}

impl Sites {
    /// The least and the largest N.
    pub const fn ends(self) -> (u32, u32) {
        let (least, largest) = AXIS;
        match self {
            Self::At(n) => (n, n),
            Self::Under(n) => (least, n - 1),
            Self::UpTo(n) => (least, n),
            Self::Over(n) => (n + 1, largest),
            Self::Everywhere => AXIS,
        }
    }

    /// Whether the claim is made for `n` devices.
    pub const fn holds(self, n: u32) -> bool {
        let (from, to) = self.ends();
        from <= n && n <= to
    }
}

/// What is looked at, at each N.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// The mean of the metric.
    Own,
    /// It over that of each of these policies. Whoever was not run is left out.
    Ratio(&'static [&'static str]),
    /// How far it is from that of this policy.
    Gap(&'static str),
    /// It over its own at this N.
    Growth(u32),
}

/// What is said of the quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Statement {
    /// It is about this, at each N.
    About(f64),
    /// It is between these, at each N.
    Between(f64, f64),
    /// It is less than this, at each N.
    Below(f64),
    /// It is more than this, at each N.
    Above(f64),
    /// The largest over N is about this: "up to".
    Largest(f64),
    /// The smallest over N is about this: "down to".
    Smallest(f64),
    /// It is about the same at every N.
    Level,
    /// It falls as N rises.
    Falls,
    /// It rises with N.
    Rises,
}

impl Statement {
    /// The values that it allows at each N, from and to, without any tolerance; `None` where it is about several N
    /// together.
    pub const fn range(self) -> Option<(f64, f64)> {
        match self {
            Self::About(v) => Some((v, v)),
            Between(low, high) => Some((low, high)),
            Below(v) => Some((f64::NEG_INFINITY, v)),
            Above(v) => Some((v, f64::INFINITY)),
            Self::Largest(_) | Self::Smallest(_) | Self::Level | Self::Falls | Self::Rises => None,
        }
    }

    /// The values that it names.
    pub fn values(self) -> Vec<f64> {
        match self {
            Self::About(v) | Below(v) | Above(v) | Self::Largest(v) | Self::Smallest(v) => vec![v],
            Between(low, high) => vec![low, high],
            Self::Level | Self::Falls | Self::Rises => Vec::new(),
        }
    }
}

/// Something else that the paper says, with which a claim cannot hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contradiction {
    /// Where it says so.
    pub with: Place,
    /// Why not both can hold.
    pub why: &'static str,
}

/// One claim.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Claim {
    /// The policy.
    pub policy: &'static str,
    /// The N for which the claim is made.
    pub sites: Sites,
    /// What it is about.
    pub quantity: Quantity,
    /// What it says.
    pub statement: Statement,
    /// Where the paper says so.
    pub place: Place,
    /// Where it says so again.
    pub again: Option<Place>,
    /// How the sentence was read, where it can be read in several ways; empty otherwise.
    pub reading: &'static str,
    /// Why we should not expect to meet it as written, if the model says so; empty otherwise.
    pub caveat: &'static str,
    /// What it contradicts.
    pub contradicts: Option<Contradiction>,
}

impl Claim {
    /// A claim without anything to add to it.
    pub const fn new(
        policy: &'static str,
        sites: Sites,
        quantity: Quantity,
        statement: Statement,
        place: Place,
    ) -> Self {
        Self {
            policy,
            sites,
            quantity,
            statement,
            place,
            again: None,
            reading: "",
            caveat: "",
            contradicts: None,
        }
    }

    /// It stands in `again` as well.
    #[must_use]
    pub const fn again(self, again: Place) -> Self {
        Self {
            again: Some(again),
            ..self
        }
    }

    /// It was read as `reading` says.
    #[must_use]
    pub const fn read(self, reading: &'static str) -> Self {
        Self { reading, ..self }
    }

    /// We should not expect to meet it, for the reason of `caveat`.
    #[must_use]
    pub const fn doubted(self, caveat: &'static str) -> Self {
        Self { caveat, ..self }
    }

    /// It contradicts what stands in `with`, for the reason of `why`.
    #[must_use]
    pub const fn against(self, with: Place, why: &'static str) -> Self {
        Self {
            contradicts: Some(Contradiction { with, why }),
            ..self
        }
    }
}

/// The claims on one metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Topic {
    /// The metric's name.
    pub metric: &'static str,
    /// Whether the metric is shared out: divided by N.
    pub is_per_device: bool,
    /// What it is, in words, with its unit.
    pub about: &'static str,
    /// The figure of the paper.
    pub source: &'static str,
    /// Why it is judged on this metric, where the paper's words leave several; empty otherwise.
    pub reading: &'static str,
    /// The claims.
    pub claims: &'static [Claim],
}
