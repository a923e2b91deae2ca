//! Settings of the `age-index` policy.

use reveille_common::declare;
use reveille_common::declare::{NOT_NEGATIVE, Reader, ScenarioError, Section, Sink, number, whole};
use reveille_common::ids::MAX_TTIS;
use reveille_common::scenario::{PolicySettings, Site};

use crate::beliefs::ages;

declare! {
    /// Settings of the policy `age-index`.
    #[derive(Clone, Debug)]
    struct Fields in "policy.age-index" {
        /// Price θ of a TTI in S1, in reaches: what one device alone looks at. With 0 every place in reach is looked at
        /// in every TTI; the higher, the longer a place is left alone.
        price: f64 = number(NOT_NEGATIVE, 0.35),
        /// How far ahead a battery is reckoned, by what its device is expected to harvest and to spend asleep: the
        /// price goes by the level that it comes to then.
        foresight: Option<u64> = whole(1, MAX_TTIS, 1)
            .unit("TTIs")
            .derived("nothing: the price goes by the level as it is"),
    }
}

/// Settings of the `age-index` policy.
#[derive(Clone, Debug, PartialEq)]
pub struct AgeIndexSettings {
    /// The price θ of a TTI in S1, ≥ 0: the worth that a look must have, in reaches of places of age 1.
    pub price: f64,
    /// TTIs by which batteries are reckoned ahead, ≥ 1; not at all by default.
    pub foresight: Option<u64>,
}

impl AgeIndexSettings {
    /// Its fields as they are declared.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// The settings that `reader` has, for a base station that knows `site`.
    ///
    /// # Errors
    /// A price that may not be, or an area of too many cells.
    pub fn settle(reader: &Reader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        let Fields { price, foresight } = Fields::read(reader)?;
        ages::check("age-index", Some(price), reader, site)?;
        Ok(Self { price, foresight })
    }
}

impl PolicySettings for AgeIndexSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let Self { price, foresight } = *self;
        let fields = Fields { price, foresight };
        fields.visit(sink);
    }
}
