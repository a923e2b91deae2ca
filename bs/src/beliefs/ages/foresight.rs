//! Expected future battery levels, from which `age-index` with the field `foresight` computes prices.
//!
//! A battery that will be full soon loses later harvest, so its energy is cheap now; energy before a night is scarce.
//! Both follow from the mean harvest of a device and, where known, from its course over the day. Digests depend on the
//! levels, which are whole micro-units and thus the same on every machine. docs/age-index.md states the formula.

use reveille_common::ids::DeviceId;
use reveille_common::units::Energy;

use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Predicts battery levels a fixed time ahead.
#[derive(Clone, Debug)]
pub(crate) struct Foresight {
    horizon_ttis: u64,
    expected_levels: Vec<Energy>,
}

impl Foresight {
    /// Creates the prediction for the devices in `known`, `horizon_ttis` TTIs ahead.
    pub(crate) fn new(known: &Knowledge, horizon_ttis: u64) -> Self {
        Self {
            horizon_ttis,
            expected_levels: vec![Energy::ZERO; known.n()],
        }
    }

    /// Returns the expected battery levels by device id, if all devices sleep until then and harvest as expected.
    /// Levels are between 0 and E_max. `seen` must hold the batteries of all devices.
    pub(crate) fn expected_levels(&mut self, seen: &Observation<'_>) -> &[Energy] {
        let target_tti = seen.now.saturating_add(self.horizon_ttis);
        for (j, (expected, &level)) in (0..).zip(self.expected_levels.iter_mut().zip(seen.batteries)) {
            let energy = &seen.known.devices[j as usize].energy;
            let harvest = seen.known.expected_harvest(DeviceId(j), seen.now, target_tti);
            let sleep_cost = Energy::from_micro(energy.e_wur.micro().saturating_mul(self.horizon_ttis));
            *expected = (level + harvest).saturating_sub(sleep_cost).min(energy.e_max);
        }
        &self.expected_levels
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use reveille_common::deployment::Deployment;
    use reveille_common::ids::Tti;
    use reveille_common::plan::Plan;

    use super::*;
    use crate::beliefs::ages::price::Prices;
    use crate::scenario::tests::load_paper;

    fn load_knowledge(fields: &[&str]) -> Knowledge {
        let scenario = load_paper(fields);
        Knowledge::from_scenario(&scenario, &Deployment::new(&scenario), Arc::default())
    }

    /// Returns the expected level, in units, `horizon_ttis` after TTI `now` with `level` units.
    fn expected_level(known: &Knowledge, level: u64, now: u64, horizon_ttis: u64) -> f64 {
        let plan = Plan::from_bits((0..known.n()).map(|_| false));
        let batteries = vec![Energy::from_micro(level * 1_000_000); known.n()];
        let observation = Observation {
            now: Tti(now),
            known,
            plan: &plan,
            information: 0.0,
            batteries: &batteries,
            battery_estimator: None,
        };
        let mut foresight = Foresight::new(known, horizon_ttis);
        let levels = foresight.expected_levels(&observation);
        assert!(
            levels.iter().all(|level| *level == levels[0]),
            "equal devices have equal levels"
        );
        levels[0].units()
    }

    #[test]
    fn a_steady_source_yields_its_mean_less_the_cost_of_sleep() {
        let known = load_knowledge(&["devices=9"]);
        // Mean harvest and cost of a TTI in S4 in the preset `paper`.
        let net_gain = 0.5 * libm::exp(-0.1) - 1.0 / 14.0;
        assert!((expected_level(&known, 20, 77, 50) - (20.0 + 50.0 * net_gain)).abs() < 1e-4);
        assert_eq!(
            expected_level(&known, 95, 77, 50).to_bits(),
            100.0_f64.to_bits(),
            "at most E_max"
        );
        let without_harvest = load_knowledge(&["devices=9", "harvest.lambda=0"]);
        assert_eq!(
            expected_level(&without_harvest, 2, 0, 50).to_bits(),
            0.0_f64.to_bits(),
            "at least 0"
        );
    }

    /// A day of 100 TTIs at an equinox, the default date, with light from TTI 25 to 74.
    #[test]
    fn expected_harvest_depends_on_the_time_of_day() {
        let day = ["devices=9", "harvest.kind=diurnal", "harvest.diurnal.ttis_per_day=100"];
        let known = load_knowledge(&day);
        let (harvest_per_day, sleep_cost) = (100.0 * 0.5 * libm::exp(-0.1), 1.0 / 14.0);
        for (now, horizon_ttis, day_share) in [
            (0, 25_u32, 0.0),
            (25, 50, 1.0),
            (25, 25, 0.5),
            (80, 45, 0.0),
            (200, 75, 1.0),
        ] {
            let expected = 20.0 + day_share * harvest_per_day - f64::from(horizon_ttis) * sleep_cost;
            let level = expected_level(&known, 20, now, u64::from(horizon_ttis));
            assert!(
                (level - expected).abs() < 0.05,
                "{horizon_ttis} TTIs from TTI {now}: {level}, not {expected}"
            );
        }
        let mean_only = load_knowledge(&[&day[..], &["harvest.diurnal.known=mean"]].concat());
        assert!(
            (expected_level(&mean_only, 20, 0, 25) - (20.0 + 25.0 * (harvest_per_day / 100.0 - sleep_cost))).abs()
                < 1e-4
        );
    }

    #[test]
    fn surcharges_follow_expected_levels_and_permissions_current_ones() {
        let known = load_knowledge(&["devices=3"]);
        let units = |levels: [u64; 3]| levels.map(|level| Energy::from_micro(level * 1_000_000));
        let (current, expected) = (units([50, 50, 5]), units([100, 0, 100]));
        let mut prices = Prices::new(&known, 2.0);
        // Full, then empty: the surcharge is 3 times the price. The third device is below the lowest sensing level now.
        assert_eq!(
            prices.for_expected_levels(&current, &expected),
            [2.0, 8.0, f64::INFINITY]
        );
        assert_eq!(
            prices.for_expected_levels(&current, &current),
            Prices::new(&known, 2.0).for_levels(&current)
        );
    }
}
