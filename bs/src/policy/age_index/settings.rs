//! Settings of the `age-index` policy.

use reveille_common::declare;
use reveille_common::declare::{NOT_NEGATIVE, Reader, ScenarioError, Section, Sink, number};
use reveille_common::scenario::{PolicySettings, Site};

use crate::beliefs::ages;

declare! {
    /// Settings of the policy `age-index`.
    #[derive(Clone, Debug)]
    struct Fields in "policy.age-index" {
        /// Price θ of a TTI in S1, in reaches: what one device alone looks at. With 0 every place in reach is looked at
        /// in every TTI; the higher, the longer a place is left alone.
        price: f64 = number(NOT_NEGATIVE, 0.35),
    }
}

/// Settings of the `age-index` policy.
#[derive(Clone, Debug, PartialEq)]
pub struct AgeIndexSettings {
    /// The price θ of a TTI in S1, ≥ 0: the worth that a look must have, in reaches of places of age 1.
    pub price: f64,
}

impl AgeIndexSettings {
    /// Its fields as they are declared.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// The settings that `reader` has, for a base station that knows `site`.
    ///
    /// # Errors
    /// A price that may not be, or an area of too many cells.
    pub fn settle(reader: &Reader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        let Fields { price } = Fields::read(reader)?;
        ages::check("age-index", Some(price), reader, site)?;
        Ok(Self { price })
    }
}

impl PolicySettings for AgeIndexSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let fields = Fields { price: self.price };
        fields.visit(sink);
    }
}
