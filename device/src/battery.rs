//! The battery: what goes in, what comes out, and what does not fit.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

/// A battery of capacity E_max that never holds less than nothing, with the account of all that came in. What goes out
/// is in the books of who took it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Battery {
    level: Energy,
    capacity: Energy,
    harvested: Energy,
    overflow: Energy,
    initial: Energy,
}

impl Battery {
    /// The battery of a device at the start of a run.
    pub fn new(model: &EnergyModel) -> Self {
        assert!(model.initial <= model.e_max, "a battery starts with at most E_max");
        Self {
            level: model.initial,
            capacity: model.e_max,
            harvested: Energy::ZERO,
            overflow: Energy::ZERO,
            initial: model.initial,
        }
    }

    /// Whether this can be a battery of this model.
    pub fn is_of(&self, model: &EnergyModel) -> bool {
        self.capacity == model.e_max && self.initial == model.initial && self.level <= self.capacity
    }

    /// The level B, `0 ..= E_max`.
    pub const fn level(&self) -> Energy {
        self.level
    }

    /// Takes in a harvest; what does not fit is counted as overflow.
    pub fn harvest(&mut self, energy: Energy) {
        let fits = energy.min(self.capacity - self.level);
        self.harvested += energy;
        self.overflow += energy - fits;
        self.level += fits;
    }

    /// Pays `cost`, which the battery is known to hold.
    #[inline]
    pub fn spend(&mut self, cost: Energy) {
        self.level -= cost;
    }

    /// Pays `cost` for an action.
    ///
    /// # Errors
    /// Where the battery holds less: it is emptied, the action fails, and the error is what was in it.
    pub fn pay(&mut self, cost: Energy) -> Result<(), Energy> {
        let paid = cost.min(self.level);
        self.level -= paid;
        if paid == cost { Ok(()) } else { Err(paid) }
    }

    /// The level at the start of the run.
    pub const fn initial(&self) -> Energy {
        self.initial
    }

    /// All that was harvested, overflow included.
    pub const fn harvested(&self) -> Energy {
        self.harvested
    }

    /// Harvest that did not fit.
    pub const fn overflow(&self) -> Energy {
        self.overflow
    }
}

#[cfg(test)]
mod tests;
