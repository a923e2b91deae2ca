//! Settings of the `age-index` policy.

use reveille_common::declare;
use reveille_common::declare::{NOT_NEGATIVE, Reader, ScenarioError, Section, Sink, number};
use reveille_common::scenario::{ClassKnowledge, PolicySettings, Site};

use crate::beliefs::ages::{self, price};
use crate::beliefs::raster::MOST_CELLS;

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
        let cells = ages::cells(site.area, site.sensing.d_max);
        if cells > MOST_CELLS {
            let allowed = format!(
                "is so small against the area that age-index would keep the ages of {cells:.0} cells, more than \
                 {MOST_CELLS}"
            );
            return Err(reader.refuse("sensing.d_max", site.sensing.d_max, allowed));
        }
        let Fields { price } = Fields::read(reader)?;
        if price >= ages::MOST {
            reader.warn(format!(
                "policy.age-index.price is {price}, and what a device looks at is worth at most {}: hardly a device is \
                 told to sense, and events are missed",
                ages::MOST
            ));
        }
        site.classes
            .iter()
            .filter_map(never_senses)
            .for_each(|sentence| reader.warn(sentence));
        Ok(Self { price })
    }
}

/// A class whose batteries cannot hold what a device must have to be told to sense.
fn never_senses(class: &ClassKnowledge<'_>) -> Option<String> {
    let (needed, e_max) = (price::needed(&class.energy), class.energy.e_max);
    (needed > e_max).then(|| {
        format!(
            "age-index tells only devices with {needed} to sense (E_idle, E_Tx and a reserve), and the batteries of \
             class {} hold {e_max}: none of them ever senses",
            class.name
        )
    })
}

impl PolicySettings for AgeIndexSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let fields = Fields { price: self.price };
        fields.visit(sink);
    }
}
