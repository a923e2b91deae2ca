//! Checks of scenarios for `age-index`, `dt` and external policies, called by their settings: errors for areas with too
//! many cells, and warnings if few or no devices would sense. `q-learning` has its own copy of the first check in
//! `policy/q_learning/settings.rs`. `tests/tests/age_index.rs` quotes parts of the warnings.

use reveille_common::declare::{FieldReader, ScenarioError};
use reveille_common::scenario::{ClassKnowledge, Site};

use super::{MAX_WORTH, count_cells, price};
use crate::beliefs::grid::MAX_CELLS;

/// Checks the site for the policy called `policy`, which selects by ages. `price` is the price θ, in reaches, if it is
/// fixed. Warns if the plan would rarely or never let a device sense.
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
    if let Some(price) = price.filter(|price| *price >= MAX_WORTH) {
        reader.warn(format!(
            "policy.{policy}.price is {price}, and the area of a device is worth at most {MAX_WORTH}: almost no device \
             senses, and events are missed; set a lower price"
        ));
    }
    let warnings = site
        .classes
        .iter()
        .filter_map(|class| warning_if_never_sensing(policy, class));
    warnings.for_each(|warning| reader.warn(warning));
    Ok(())
}

/// Checks the site for the policy called `policy`, which keeps ages.
///
/// # Errors
/// Returns an error if the area has too many cells.
pub(crate) fn check_cells(policy: &str, reader: &FieldReader<'_>, site: &Site<'_>) -> Result<(), ScenarioError> {
    let cells = count_cells(site.area, site.sensing.d_max);
    if cells > MAX_CELLS {
        let problem = format!(
            "is too small for the area: {policy} would keep the ages of {cells:.0} cells, more than {MAX_CELLS}"
        );
        return Err(reader.invalid_value("sensing.d_max", site.sensing.d_max, problem));
    }
    Ok(())
}

/// Returns a warning if the batteries of `class` cannot hold the level that sensing requires.
fn warning_if_never_sensing(policy: &str, class: &ClassKnowledge<'_>) -> Option<String> {
    let (min_level, e_max) = (price::min_sensing_level(&class.energy), class.energy.e_max);
    (min_level > e_max).then(|| {
        format!(
            "{policy} selects only devices with {min_level} (E_idle, E_Tx and a reserve), and the batteries of class \
             {} hold {e_max}: its devices never sense",
            class.name
        )
    })
}
