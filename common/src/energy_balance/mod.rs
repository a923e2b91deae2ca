//! The energy balance of a scenario before it runs: expected harvest against the costs of sensing, sleeping and
//! reporting, by device class, and the part of the area out of reach. `reveille scenario` prints it, and
//! `study/src/misses/advice.rs` advises with it; no run depends on it.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use crate::deployment::Deployment;
use crate::digits::format_significant;
use crate::geometry::share_out_of_reach;
use crate::harvest::{Harvest, HarvestGap, HarvestSetup};
use crate::ids::Tti;
use crate::scenario::{DeviceClass, Scenario};

/// Ratio of harvest to consumption from which energy does not limit a run.
const AMPLE_RATIO: f64 = 10.0;
/// Share of TTIs with affordable sensing below which devices can hardly sense.
const SCARCE_SENSING: f64 = 0.05;

/// The energy balance of a scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct EnergyBalance {
    /// Length K of the run, TTIs.
    pub ttis: u64,
    /// Duration τ of a TTI in units of model time.
    pub tau: f64,
    /// Duration of a TTI in seconds by each energy source that defines one, ascending, without repetitions.
    pub tti_seconds: Vec<f64>,
    /// Sensing range d_max, metres.
    pub d_max: f64,
    /// Share of the area that is farther than d_max from every device, `[0, 1]`.
    pub share_out_of_reach: f64,
    /// Reports per device and TTI, on average, if each event brings one report and starts at the scenario's rate.
    pub reports_per_device_tti: f64,
    /// The device classes that have devices, in the order of the scenario.
    pub classes: Vec<ClassBalance>,
}

/// The energy balance of the devices of one class.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassBalance {
    /// Name of the class.
    pub name: String,
    /// Number of its devices, ≥ 1.
    pub devices: u64,
    /// Expected harvest over the run.
    pub harvest: HarvestRange,
    /// Cost of a TTI in S1, units.
    pub sensing_cost: f64,
    /// Expected cost of a TTI in S4, false wake-ups included, units.
    pub sleeping_cost: f64,
    /// Cost of a report, units.
    pub report_cost: f64,
    /// Battery capacity E_max, units.
    pub capacity: f64,
    /// The longest stretch of the run in which some device of the class harvests nothing, the first of equal ones.
    /// `None` if energy can arrive in any TTI.
    pub longest_gap: Option<HarvestGap>,
    /// λτ of a source whose arrivals follow Eq. (5); `None` for other sources.
    pub eq5_rate: Option<f64>,
}

/// Expected harvest of a group of devices, units per TTI, overflow included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarvestRange {
    /// Mean over the devices.
    pub mean: f64,
    /// The smallest of any device.
    pub min: f64,
    /// The largest of any device.
    pub max: f64,
}

impl HarvestRange {
    /// The range over devices: pairs of a device's harvest and the number of such devices, at least one.
    fn new(harvests: &[(f64, u64)]) -> Self {
        let devices: u64 = harvests.iter().map(|(_, devices)| devices).sum();
        let sum: f64 = harvests
            .iter()
            .map(|&(harvest, devices)| harvest * devices as f64)
            .sum();
        let values = || harvests.iter().map(|(harvest, _)| *harvest);
        let (min, max) = (values().fold(f64::INFINITY, f64::min), values().fold(0.0, f64::max));
        Self {
            // Rounding must not move the mean of equal devices.
            mean: (sum / devices as f64).clamp(min, max),
            min,
            max,
        }
    }
}

impl EnergyBalance {
    /// Computes the balance of `scenario`, with the devices as its seed places them.
    pub fn new<P>(scenario: &Scenario<P>) -> Self {
        let deployment = Deployment::new(scenario);
        let ttis = scenario.run.ttis;
        // Devices of a class differ only in the trace that they read.
        let mut groups: BTreeMap<(u16, u32), (HarvestSetup, u64)> = BTreeMap::new();
        for (device, &class) in deployment.devices.iter().zip(&deployment.classes) {
            let trace = match device.harvest {
                HarvestSetup::Trace(trace) => trace.trace,
                HarvestSetup::Arrivals(_) | HarvestSetup::OnOff(_) | HarvestSetup::Diurnal(_) => 0,
            };
            groups.entry((class, trace)).or_insert((device.harvest, 0)).1 += 1;
        }
        let balance_of = |(index, class): (u16, &DeviceClass)| {
            let harvests: Vec<(f64, u64)> = groups
                .range((index, 0)..=(index, u32::MAX))
                .map(|(_, (setup, devices))| (setup.mean_over_run(&deployment.traces, ttis), *devices))
                .collect();
            let energy = class.energy;
            let false_wake_ups = scenario.radio.false_wake_up * energy.e_idle.units();
            (!harvests.is_empty()).then(|| ClassBalance {
                name: class.name.clone(),
                devices: harvests.iter().map(|(_, devices)| devices).sum(),
                harvest: HarvestRange::new(&harvests),
                sensing_cost: energy.e_idle.units(),
                sleeping_cost: energy.e_wur.units() + false_wake_ups,
                report_cost: energy.e_tx.units(),
                capacity: energy.e_max.units(),
                longest_gap: groups
                    .range((index, 0)..=(index, u32::MAX))
                    .filter_map(|(_, (setup, _))| setup.longest_gap(&deployment.traces, ttis))
                    .max_by_key(|gap| (gap.ttis, Reverse(gap.first))),
                eq5_rate: match &class.harvest {
                    Harvest::Eq5(arrivals) => Some(arrivals.lambda * scenario.run.tau),
                    Harvest::ExpMinusLambda(_) | Harvest::Mpp(_) | Harvest::Diurnal(_) | Harvest::Trace(_) => None,
                },
            })
        };
        let mut tti_seconds: Vec<f64> = scenario
            .classes
            .iter()
            .filter_map(|class| class.harvest.tti_seconds())
            .collect();
        tti_seconds.sort_by(f64::total_cmp);
        tti_seconds.dedup();
        Self {
            ttis,
            tau: scenario.run.tau,
            tti_seconds,
            d_max: scenario.sensing.d_max,
            share_out_of_reach: share_out_of_reach(&deployment.positions(), scenario.area, scenario.sensing.d_max),
            reports_per_device_tti: scenario
                .events
                .mean_start_probability(scenario.run.seed, Tti::ZERO, Tti(ttis))
                / f64::from(scenario.run.devices),
            classes: (0..).zip(&scenario.classes).filter_map(balance_of).collect(),
        }
    }

    /// The expected harvest of all devices.
    pub fn harvest(&self) -> HarvestRange {
        let means: Vec<(f64, u64)> = self
            .classes
            .iter()
            .map(|class| (class.harvest.mean, class.devices))
            .collect();
        let range = HarvestRange::new(&means);
        HarvestRange {
            min: self
                .classes
                .iter()
                .map(|class| class.harvest.min)
                .fold(f64::INFINITY, f64::min),
            max: self.classes.iter().map(|class| class.harvest.max).fold(0.0, f64::max),
            ..range
        }
    }

    /// Warnings about implausible energy settings, each a sentence without its full stop.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = self.class_warnings(|class| class.warning(self));
        for class in &self.classes {
            if let Some(rate) = class.eq5_rate.filter(|rate| *rate > 1.0) {
                warnings.push(format!(
                    "{}the product of harvest.lambda and tau is {}; above 1, the harvest of Eq. (5) falls when \
                     harvest.lambda rises; use a lower harvest.lambda, or raise harvest.e_b",
                    self.subject(class),
                    format_significant(rate, 3)
                ));
            }
        }
        if let [first, .., last] = self.tti_seconds.as_slice() {
            warnings.push(format!(
                "the energy sources disagree on the duration of a TTI, {first} s to {last} s; set \
                 harvest.trace.panel.tti_seconds and harvest.diurnal.ttis_per_day alike"
            ));
        }
        warnings
    }

    /// Warnings about classes whose batteries run down under every policy, each a sentence without its full stop.
    pub fn depletion_warnings(&self) -> Vec<String> {
        self.class_warnings(|class| class.depletion_warning(self))
    }

    /// The `warning` of each class that has one, after the name of the class.
    fn class_warnings(&self, warning: impl Fn(&ClassBalance) -> Option<String>) -> Vec<String> {
        let named = |class: &ClassBalance| Some(format!("{}{}", self.subject(class), warning(class)?));
        self.classes.iter().filter_map(named).collect()
    }

    /// The start of a sentence about `class`; empty if all devices belong to it.
    fn subject(&self, class: &ClassBalance) -> String {
        if self.classes.len() > 1 {
            format!("class `{}`: ", class.name)
        } else {
            String::new()
        }
    }
}

impl ClassBalance {
    /// The mean harvest divided by the cost of always sensing; `None` if sensing costs nothing.
    pub fn sensing_ratio(&self) -> Option<f64> {
        ratio(self.harvest.mean, self.sensing_cost)
    }

    /// The mean harvest divided by the cost of always sleeping; `None` if sleeping costs nothing.
    pub fn sleeping_ratio(&self) -> Option<f64> {
        ratio(self.harvest.mean, self.sleeping_cost)
    }

    /// The expected consumption of sleeping through [`Self::longest_gap`], in full batteries.
    pub fn batteries_of_longest_gap(&self) -> Option<f64> {
        self.longest_gap
            .map(|gap| gap.ttis as f64 * self.sleeping_cost / self.capacity)
    }

    /// The number of actions of this `cost` in units that a full battery pays without harvest; `None` if it is
    /// unlimited.
    pub fn actions_per_battery(&self, cost: f64) -> Option<u64> {
        // A quotient that rounding leaves just below a whole number counts as that number.
        ratio(self.capacity, cost).map(|actions| (actions * (1.0 + 1e-12)).floor() as u64)
    }

    /// The share of TTIs in S1 that the harvest pays for, if a device sleeps in all others and sends this number of
    /// reports per TTI. Negative if the harvest does not pay for sleeping and the reports; 1 or more if it pays for
    /// sensing in every TTI. If sensing is as cheap as sleeping, the share is infinite, with the sign of the harvest
    /// that is left.
    pub fn affordable_sensing(&self, reports_per_tti: f64) -> f64 {
        let left = self.harvest.mean - self.sleeping_cost - reports_per_tti * self.report_cost;
        let extra_cost = self.sensing_cost - self.sleeping_cost;
        if extra_cost > 0.0 {
            left / extra_cost
        } else {
            left.signum() * f64::INFINITY
        }
    }

    /// A warning if the class harvests nothing, or too little to pay for sleeping, in a run with `balance`.
    fn depletion_warning(&self, balance: &EnergyBalance) -> Option<String> {
        let mean = self.harvest.mean;
        if mean == 0.0 {
            return Some(format!(
                "no energy is harvested in the {} TTIs of the run; change the fields of harvest, or run longer",
                balance.ttis
            ));
        }
        self.sleeping_ratio().filter(|ratio| *ratio < 1.0).map(|_| {
            format!(
                "the harvest of {} units per TTI does not pay for sleeping ({}), so batteries run down under every \
                 policy; change the fields of harvest, or lower energy.e_wur",
                format_significant(mean, 3),
                format_significant(self.sleeping_cost, 3)
            )
        })
    }

    /// A warning about the harvest of the class in a run with `balance`.
    fn warning(&self, balance: &EnergyBalance) -> Option<String> {
        if let Some(warning) = self.depletion_warning(balance) {
            return Some(warning);
        }
        let mean = self.harvest.mean;
        let sensing_share = self.affordable_sensing(balance.reports_per_device_tti);
        if sensing_share < SCARCE_SENSING {
            let affordable = if sensing_share > 0.0 {
                format!(
                    "sensing in only {} % of TTIs",
                    format_significant(100.0 * sensing_share, 2)
                )
            } else {
                "no sensing".to_owned()
            };
            return Some(format!(
                "after sleeping and one report per event, the harvest of {} units per TTI pays for {affordable}, so \
                 devices are often without power unless the policy seldom uses them; change the fields of harvest, \
                 lower energy.e_tx, or raise devices",
                format_significant(mean, 3)
            ));
        }
        let (action, consumption) = if self.sensing_cost >= self.sleeping_cost {
            ("sensing", self.sensing_cost)
        } else {
            ("sleeping", self.sleeping_cost)
        };
        let ratio = ratio(mean, consumption);
        if ratio.is_some_and(|ratio| ratio < AMPLE_RATIO) {
            return None;
        }
        let comparison = match ratio {
            Some(ratio) => format!("{} times the consumption", format_significant(ratio, 3)),
            None => "above 0 and the consumption 0".to_owned(),
        };
        Some(format!(
            "the harvest is {comparison} of a device that is always {action}, so energy hardly limits it; compare the \
             units of the harvest and of energy.e_idle"
        ))
    }
}

/// Returns `amount / cost`; `None` without a cost.
fn ratio(amount: f64, cost: f64) -> Option<f64> {
    (cost > 0.0).then(|| amount / cost)
}

#[cfg(test)]
mod tests;
