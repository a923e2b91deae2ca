//! Checks of scenarios in which a policy by ages selects few or no devices.

use reveille_common::declare::{FieldReader, ScenarioError};
use reveille_common::scenario::{ClassKnowledge, Site};

use super::{MOST, cells, price};
use crate::beliefs::grid::MOST_CELLS;

/// Checks the site for the policy called `policy`, which selects by ages, with `price` per TTI in S1 if it is fixed.
/// Warns if the plan would rarely or never let a device sense.
///
/// # Errors
/// Returns an error if the area has too many cells.
pub fn check_price(
    policy: &str,
    price: Option<f64>,
    reader: &FieldReader<'_>,
    site: &Site<'_>,
) -> Result<(), ScenarioError> {
    check_cells(policy, reader, site)?;
    if let Some(price) = price.filter(|price| *price >= MOST) {
        reader.warn(format!(
            "policy.{policy}.price is {price}, and the area of a device is worth at most {MOST}: almost no device \
             senses, and events are missed; set a lower price"
        ));
    }
    let never = site.classes.iter().filter_map(|class| never_senses(policy, class));
    never.for_each(|sentence| reader.warn(sentence));
    Ok(())
}

/// Checks the site for the policy called `policy`, which keeps ages.
///
/// # Errors
/// Returns an error if the area has too many cells.
pub(crate) fn check_cells(policy: &str, reader: &FieldReader<'_>, site: &Site<'_>) -> Result<(), ScenarioError> {
    let cells = cells(site.area, site.sensing.d_max);
    if cells > MOST_CELLS {
        let allowed = format!(
            "is too small for the area: {policy} would keep the ages of {cells:.0} cells, more than {MOST_CELLS}"
        );
        return Err(reader.invalid_value("sensing.d_max", site.sensing.d_max, allowed));
    }
    Ok(())
}

/// Returns a warning if the batteries of `class` cannot hold the level that sensing requires.
fn never_senses(policy: &str, class: &ClassKnowledge<'_>) -> Option<String> {
    let (needed, e_max) = (price::min_level(&class.energy), class.energy.e_max);
    (needed > e_max).then(|| {
        format!(
            "{policy} selects only devices with {needed} (E_idle, E_Tx and a reserve), and the batteries of class {} \
             hold {e_max}: its devices never sense",
            class.name
        )
    })
}
