//! What settings and grounds let nobody choose by ages, or hardly.

use reveille_common::declare::{Reader, ScenarioError};
use reveille_common::scenario::{ClassKnowledge, Site};

use super::{MOST, cells, price};
use crate::beliefs::raster::MOST_CELLS;

/// Looks at the ground on which the policy called `policy` chooses by ages, at `price` a TTI in S1 where that is fixed,
/// and warns where hardly a device would be told to sense.
///
/// # Errors
/// An area of too many cells.
pub fn check(policy: &str, price: Option<f64>, reader: &Reader<'_>, site: &Site<'_>) -> Result<(), ScenarioError> {
    check_cells(policy, reader, site)?;
    if let Some(price) = price.filter(|price| *price >= MOST) {
        reader.warn(format!(
            "policy.{policy}.price is {price}, and what a device looks at is worth at most {MOST}: hardly a device is \
             told to sense, and events are missed"
        ));
    }
    let never = site.classes.iter().filter_map(|class| never_senses(policy, class));
    never.for_each(|sentence| reader.warn(sentence));
    Ok(())
}

/// Looks at the ground on which the policy called `policy` keeps ages.
///
/// # Errors
/// An area of too many cells.
pub fn check_cells(policy: &str, reader: &Reader<'_>, site: &Site<'_>) -> Result<(), ScenarioError> {
    let cells = cells(site.area, site.sensing.d_max);
    if cells > MOST_CELLS {
        let allowed = format!(
            "is so small against the area that {policy} would keep the ages of {cells:.0} cells, more than {MOST_CELLS}"
        );
        return Err(reader.refuse("sensing.d_max", site.sensing.d_max, allowed));
    }
    Ok(())
}

/// A class whose batteries cannot hold what a device must have to be told to sense.
fn never_senses(policy: &str, class: &ClassKnowledge<'_>) -> Option<String> {
    let (needed, e_max) = (price::needed(&class.energy), class.energy.e_max);
    (needed > e_max).then(|| {
        format!(
            "{policy} tells only devices with {needed} to sense (E_idle, E_Tx and a reserve), and the batteries of \
             class {} hold {e_max}: none of them ever senses",
            class.name
        )
    })
}
