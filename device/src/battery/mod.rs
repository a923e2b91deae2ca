//! The battery of a device: harvest, consumption and overflow. Amounts are integers, so sums do not depend on their
//! order; digests depend on them. [`crate::ledger`] counts the consumption a second time, independently.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

/// A battery of capacity E_max whose level never falls below 0, with an account of the harvest. Consumption is recorded
/// in the ledger of the device. The fields, in this order, are part of a device's checkpoint
/// ([`Machine::checkpoint`](crate::machine::Machine::checkpoint)): a change raises `WIRE_VERSION`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Battery {
    level: Energy,
    /// E_max.
    capacity: Energy,
    /// The total harvest, overflow included.
    harvested: Energy,
    /// The part of the harvest that did not fit.
    overflow: Energy,
    initial: Energy,
}

impl Battery {
    /// Creates the battery of a device at the start of a run.
    ///
    /// # Panics
    /// If the initial level exceeds E_max, which loading a scenario and `HostSetup::validate` rule out.
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

    /// Returns whether this battery, read from a checkpoint, can be a battery of `model`: E_max and the initial level
    /// are the same, and the level is at most E_max. Harvest and overflow are not checked.
    pub fn can_belong_to(&self, model: &EnergyModel) -> bool {
        self.capacity == model.e_max && self.initial == model.initial && self.level <= self.capacity
    }

    /// The level B, `0 ..= E_max`.
    pub const fn level(&self) -> Energy {
        self.level
    }

    /// Adds a harvest, or energy from an operator. The part that does not fit counts as overflow.
    pub fn harvest(&mut self, energy: Energy) {
        let fits = energy.min(self.capacity - self.level);
        self.harvested += energy;
        self.overflow += energy - fits;
        self.level += fits;
    }

    /// Pays `cost` for a span of TTIs that the caller has checked. An action, which can fail, uses [`Self::pay`].
    ///
    /// # Panics
    /// If the battery holds less.
    #[inline]
    pub fn spend(&mut self, cost: Energy) {
        self.level -= cost;
    }

    /// Pays `cost` for an action.
    ///
    /// # Errors
    /// If the battery holds less: it is emptied, the action fails, and the error is the energy that was left.
    pub fn pay(&mut self, cost: Energy) -> Result<(), Energy> {
        let paid = cost.min(self.level);
        self.level -= paid;
        if paid == cost { Ok(()) } else { Err(paid) }
    }

    /// The level at the start of the run.
    pub const fn initial(&self) -> Energy {
        self.initial
    }

    /// The total harvest, overflow included.
    pub const fn harvested(&self) -> Energy {
        self.harvested
    }

    /// The harvest that did not fit.
    pub const fn overflow(&self) -> Energy {
        self.overflow
    }
}

#[cfg(test)]
mod tests;
