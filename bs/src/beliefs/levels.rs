//! What the base station knows of batteries.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::scenario::{BatteryKnowledge, EnergyModel};
use reveille_common::units::Energy;

use crate::knowledge::Knowledge;

/// The battery level of every device, as it was at the end of the last TTI: told, or estimated.
#[derive(Clone, Debug)]
pub struct Levels {
    knowledge: BatteryKnowledge,
    of: Vec<Energy>,
    devices: Vec<(EnergyModel, Energy)>,
}

impl Levels {
    /// The levels at the start of a run, which are known.
    pub fn new(known: &Knowledge) -> Self {
        let devices = known.devices.iter();
        Self {
            knowledge: known.bs.battery_knowledge,
            of: devices.clone().map(|d| d.energy.initial).collect(),
            devices: devices.map(|d| (d.energy, d.mean_harvest)).collect(),
        }
    }

    /// The levels, in the order of ids.
    pub fn all(&self) -> &[Energy] {
        &self.of
    }

    /// Whether the true levels have to be told before each decision.
    pub fn are_told(&self) -> bool {
        self.knowledge == BatteryKnowledge::Oracle
    }

    /// Takes in the true levels.
    pub fn tell(&mut self, levels: impl IntoIterator<Item = Energy>) {
        self.of.clear();
        self.of.extend(levels);
        assert_eq!(self.of.len(), self.devices.len(), "a level for each device");
    }

    /// `device` has reported `level`.
    pub fn heard(&mut self, device: DeviceId, level: Energy) {
        self.of[device.index()] = level.min(self.devices[device.index()].0.e_max);
    }

    /// `device` was woken and is silent: it could not transmit, and its battery is empty now.
    pub fn silent(&mut self, device: DeviceId) {
        self.of[device.index()] = Energy::ZERO;
    }

    /// TTI `k` has passed under `plan`: where levels are estimated, everyone has harvested as much as is to be expected
    /// and paid for what it was told to do. Reports of TTI `k` come after this, as they come after δ(k) has been paid
    /// for.
    pub fn pass(&mut self, k: Tti, plan: &Plan) {
        if self.are_told() {
            return;
        }
        for ((level, (energy, harvest)), j) in self.of.iter_mut().zip(&self.devices).zip(0..) {
            let is_on = plan.duty_cycle(DeviceId(j)).is_on(k);
            let cost = if is_on { energy.e_idle } else { energy.e_wur };
            *level = (*level + *harvest).min(energy.e_max).saturating_sub(cost);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use reveille_common::deployment::Deployment;

    use crate::scenario::{Override, load};

    use super::*;

    #[test]
    fn estimates_follow_what_was_commanded_and_heard() {
        let set = Override::parse("bs.battery_knowledge=reported").expect("an override");
        let scenario = load("paper", &[set]).expect("a preset");
        let known = Knowledge::of(&scenario, &Deployment::new(&scenario), Arc::default());
        let mut levels = Levels::new(&known);
        let plan = Plan::from_bits((0..50).map(|j| j == 3));
        for k in 0..10 {
            levels.pass(Tti(k), &plan);
        }
        // eq5: λτ·exp(−λτ)·E_B = 0.1·e^-0.1·5.
        let harvest = 0.5 * libm::exp(-0.1);
        let expected = |cost: f64| 50.0 + 10.0 * (harvest - cost);
        assert!((levels.all()[3].units() - expected(1.0)).abs() < 1e-4);
        assert!((levels.all()[4].units() - expected(1.0 / 14.0)).abs() < 1e-4);
        levels.heard(DeviceId(4), Energy::from_micro(7));
        levels.silent(DeviceId(5));
        assert_eq!(levels.all()[4..6], [Energy::from_micro(7), Energy::ZERO]);
        assert!(!levels.are_told());
    }
}
