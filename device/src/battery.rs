//! The battery and its ledger.

use reveille_common::scenario::EnergyModel;
use reveille_common::totals::DeviceTotals;
use reveille_common::units::Energy;

/// A battery of capacity E_max that never holds less than nothing, with the account of all that went in and out.
#[derive(Clone, Debug)]
pub struct Battery {
    level: Energy,
    capacity: Energy,
    harvested: Energy,
    spent: Energy,
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
            spent: Energy::ZERO,
            overflow: Energy::ZERO,
            initial: model.initial,
        }
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
        self.spent += cost;
    }

    /// Pays `cost` for an action.
    ///
    /// # Errors
    /// Where the battery holds less: it is emptied, the action fails, and the error is what was in it.
    pub fn pay(&mut self, cost: Energy) -> Result<(), Energy> {
        let paid = cost.min(self.level);
        self.level -= paid;
        self.spent += paid;
        if paid == cost { Ok(()) } else { Err(paid) }
    }

    /// The ledger, without the per-TTI sums.
    pub fn ledger(&self) -> DeviceTotals {
        DeviceTotals {
            initial: self.initial,
            harvested: self.harvested,
            spent: self.spent,
            overflow: self.overflow,
            battery: self.level,
            battery_sum: 0,
            low_ttis: 0,
        }
    }
}

#[cfg(test)]
mod tests;
