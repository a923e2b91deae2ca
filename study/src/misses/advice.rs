//! The change of the scenario that the main cause of missed events suggests. [`Misses::advice`](super::Misses::advice)
//! calls it. docs/reading-results.md and `tests/program/misses.rs` contain some of the texts.
//!
//! A test compares the named fields with the declaration of the scenario. No test checks the names of policies, listed
//! in `bs/src/policy/registry.rs`: a policy without an arm gets the advice of the last arm.

use std::fmt;

use reveille_bs::scenario::Scenario;
use reveille_common::digits::format_significant;
use reveille_common::energy_balance::{ClassBalance, EnergyBalance};
use reveille_common::geometry::Point;
use reveille_common::harvest::{Arrivals, Harvest};
use reveille_common::scenario::DeviceClass;
use reveille_common::totals::MissCause;

use crate::analysis::harvest::{LambdaReading, lambdas_with_positive_net};

/// Metrics of a finished run about energy. `deploy/src/run_reader.rs` reads them from `summary.json` by these names.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunEnergy {
    /// The metric `low_energy_pct`, % of device-TTIs.
    pub low_energy_pct: f64,
    /// The metric `overflow_per_device_tti`, units.
    pub overflow_per_device_tti: f64,
}

/// Share of device-TTIs with B < E_Tx from which devices lack energy, %. The report explains its verdicts with another
/// limit, `LOW_ENERGY_CAUSE_PCT`.
const LOW_ENERGY_PCT: f64 = 5.0;

/// Advice about the main cause of missed events.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Advice {
    /// Sentences that name the cause, the place and the energy balance.
    pub finding: String,
    /// Alternative changes of the scenario, each an imperative without a full stop.
    pub suggestions: Vec<String>,
}

impl fmt::Display for Advice {
    /// Writes one paragraph, for captions and programs.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.finding)?;
        for suggestion in &self.suggestions {
            let mut letters = suggestion.chars();
            let first: String = letters.next().into_iter().flat_map(char::to_uppercase).collect();
            write!(f, " {first}{}.", letters.as_str())?;
        }
        Ok(())
    }
}

/// Returns the ways in which the base station's policy senses more.
fn ways_to_sense_more(policy: &str) -> Vec<&'static str> {
    match policy {
        "knn" => vec![
            "choose policy age-index with a low policy.age-index.price",
            "raise devices",
        ],
        "adjusted" => vec!["raise policy.adjusted.t_on", "choose policy age-index"],
        "q-learning" => vec!["raise policy.q-learning.mu1, with tables of `reveille train q-learning`"],
        "random" => vec!["choose policy age-index", "shorten policy.random.t_drx"],
        "age-index" => vec!["lower policy.age-index.price"],
        "dt" => vec!["lower policy.dt.price"],
        _ => vec!["let the policy keep more devices in S1"],
    }
}

/// Returns the ways in which the base station's policy senses less.
fn ways_to_sense_less(policy: &str) -> Vec<&'static str> {
    match policy {
        "adjusted" => vec!["choose policy age-index", "lengthen policy.adjusted.t_drx"],
        "q-learning" => vec!["lengthen policy.q-learning.window"],
        "random" => vec!["choose policy age-index", "lengthen policy.random.t_drx"],
        "age-index" => vec!["raise policy.age-index.price"],
        "dt" => vec!["raise policy.dt.price"],
        _ => vec!["choose policy age-index, with a policy.age-index.price from its default up"],
    }
}

/// The device class whose harvest covers the smallest part of its consumption, and its energy balance.
struct WeakestClass<'s> {
    class: &'s DeviceClass,
    balance: ClassBalance,
    /// Whether other classes have devices too.
    is_one_of_several: bool,
    /// Duration τ of a TTI, in units of model time.
    tau: f64,
}

impl<'s> WeakestClass<'s> {
    /// Returns the weakest class of `scenario`.
    fn new(scenario: &'s Scenario) -> Self {
        let classes = EnergyBalance::new(scenario).classes;
        let is_one_of_several = classes.len() > 1;
        let ratio = |class: &ClassBalance| class.sleeping_ratio().unwrap_or(f64::INFINITY);
        let weakest = classes.into_iter().min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        let balance = weakest.expect("a scenario has devices");
        let class = scenario.classes.iter().find(|class| class.name == balance.name);
        Self {
            class: class.expect("a balance is of a class of the scenario"),
            balance,
            is_one_of_several,
            tau: scenario.run.tau,
        }
    }

    /// Whether the harvest pays for sleeping. Otherwise batteries run down under every policy.
    fn can_sleep(&self) -> bool {
        self.balance.sleeping_ratio().is_none_or(|ratio| ratio >= 1.0)
    }

    /// Describes the expected harvest and the costs of a device, in sentences.
    fn describe(&self) -> String {
        let number = |x: f64| format_significant(x, 3);
        let class = if self.is_one_of_several {
            format!(" of class {}", self.class.name)
        } else {
            String::new()
        };
        let text = format!(
            "A device{class} harvests {} units per TTI; sleeping costs {}, sensing {}.",
            number(self.balance.harvest.mean),
            number(self.balance.sleeping_cost),
            number(self.balance.sensing_cost)
        );
        if self.can_sleep() {
            text
        } else {
            text + " The harvest does not pay for sleeping, so batteries run down under every policy."
        }
    }

    /// Completes `change` with the value of its field at which the harvest pays for sensing in every TTI, if it does
    /// not do so already and some value does. `value_for` returns the value at which the harvest equals a consumption
    /// in units per TTI; `None` if no value suffices.
    fn with_sufficient_value(&self, change: String, value_for: impl Fn(f64) -> Option<f64>) -> String {
        let (cost, mean) = (self.balance.sensing_cost, self.balance.harvest.mean);
        match value_for(cost).filter(|_| cost > mean) {
            Some(value) => format!(
                "{change}: {} pays for sensing in every TTI",
                format_significant(value, 3)
            ),
            None => change,
        }
    }

    /// Returns the changes that give the devices more energy. A larger battery is among them only if batteries
    /// overflowed.
    fn ways_to_harvest_more(&self, energy: Option<RunEnergy>) -> Vec<String> {
        let mean = self.balance.harvest.mean;
        // A device that harvests nothing in this run has no amount to scale.
        let factor_for = |cost: f64| (mean > 0.0).then(|| cost / mean);
        let mut changes = Vec::new();
        let battery = energy.filter(|energy| energy.overflow_per_device_tti > 0.0);
        let battery = battery.map(|_| "raise energy.e_max".to_owned());
        // In a gap such as a night, only the battery helps.
        let is_gap_first = self.balance.longest_gap.is_some();
        changes.extend(battery.clone().filter(|_| is_gap_first));
        if let Harvest::Trace(_) = self.class.harvest {
            changes.push(self.with_sufficient_value(
                "raise harvest.trace.scale (the panel's area_cm2 with irradiance) by a factor".to_owned(),
                factor_for,
            ));
        } else {
            // Every source except a trace has the field `harvest.e_b`, which `max_per_tti` returns.
            let e_b = self.class.harvest.max_per_tti().units();
            // λτ·exp(-λτ) is largest at λτ = 1. From 0.5 on, a larger λ adds at most 22 %.
            if let Harvest::Eq5(Arrivals { lambda, .. }) = self.class.harvest
                && lambda * self.tau < 0.5
            {
                let lambda_for =
                    |cost: f64| Some(lambdas_with_positive_net(LambdaReading::Eq5, e_b, cost, self.tau)?.0);
                // Without enough energy to sleep, a λ that pays for little more leaves devices unable to sense.
                if self.can_sleep() || lambda_for(self.balance.sensing_cost).is_some() {
                    let change = format!("raise harvest.lambda = {}", format_significant(lambda, 3));
                    changes.push(self.with_sufficient_value(change, lambda_for));
                }
            }
            let change = format!("raise harvest.e_b = {}", format_significant(e_b, 3));
            changes.push(self.with_sufficient_value(change, |cost| Some(e_b * factor_for(cost)?)));
        }
        changes.extend(battery.filter(|_| !is_gap_first));
        changes
    }

    /// Returns the changes that help devices without enough energy: more energy, and less consumption by the policy or
    /// by the changes in `spend_less` if the harvest pays for sleeping.
    fn ways_to_save_energy(&self, energy: Option<RunEnergy>, policy: &str, spend_less: &[&str]) -> Vec<String> {
        let mut changes = self.ways_to_harvest_more(energy);
        if self.can_sleep() {
            let savings = spend_less.iter().copied().chain(ways_to_sense_less(policy));
            changes.extend(savings.map(str::to_owned));
        }
        changes
    }
}

/// Returns the advice against `cause`, which explains `count` of `missed` events, `near` of them near `place`.
pub(super) fn advise(
    scenario: &Scenario,
    cause: MissCause,
    (count, missed): (u64, usize),
    (near, place): (usize, Point),
    energy: Option<RunEnergy>,
) -> Advice {
    let (finding, background, suggestions) = explain(scenario, cause, energy);
    let verb = if count == 1 { "was" } else { "were" };
    let background = background.map_or_else(String::new, |text| format!(" {text}"));
    Advice {
        finding: format!(
            "{count} of {missed} missed events {verb} {finding}, {near} of them near x = {:.1} m, y = {:.1} \
             m.{background}",
            place.x, place.y
        ),
        suggestions,
    }
}

/// Returns, in this order, the part of a sentence that follows "missed events were", sentences about the energy of the
/// devices, and the changes against `cause`. In a run with many device-TTIs of low energy, devices sleep to save
/// energy, and more sensing would only empty them.
fn explain(scenario: &Scenario, cause: MissCause, energy: Option<RunEnergy>) -> (String, Option<String>, Vec<String>) {
    let (policy, d_max) = (scenario.policy.name(), scenario.sensing.d_max);
    let weakest = WeakestClass::new(scenario);
    let save_energy = |spend_less: &[&str]| weakest.ways_to_save_energy(energy, policy, spend_less);
    let balance = || weakest.describe();
    let to_strings = |changes: Vec<&str>| changes.into_iter().map(str::to_owned).collect::<Vec<_>>();
    let low_energy = energy
        .map(|energy| energy.low_energy_pct)
        .filter(|low_energy_pct| *low_energy_pct >= LOW_ENERGY_PCT);
    let mut background = None;
    let (finding, suggestions) = match cause {
        MissCause::OutOfReach => (
            format!("more than sensing.d_max = {d_max} m from every device"),
            to_strings(vec![
                "place a device there with layout.file",
                "raise devices",
                "raise sensing.d_max",
            ]),
        ),
        MissCause::Removed => (
            "near devices that were removed with their process, or had failed".to_owned(),
            to_strings(vec![
                "run with --on-loss wait, so that another process takes over lost devices",
                "revive failed devices earlier, in the script of actions",
            ]),
        ),
        MissCause::Undetected => (
            format!("not detected by any device within sensing.d_max = {d_max} m"),
            to_strings(vec![
                "lower sensing.eta",
                "raise devices, so that events are closer to a device",
            ]),
        ),
        MissCause::Asleep => (
            "within reach of devices that slept by plan".to_owned(),
            match low_energy {
                Some(low_energy_pct) => {
                    background = Some(format!(
                        "Batteries were below energy.e_tx in {low_energy_pct:.0} % of device-TTIs, so more sensing \
                         would empty them. {}",
                        balance()
                    ));
                    weakest.ways_to_harvest_more(energy)
                }
                None => to_strings(ways_to_sense_more(policy)),
            },
        ),
        MissCause::Unpowered => {
            background = Some(balance());
            (
                "near devices that had no power to sense in their TTIs of δ = 1".to_owned(),
                save_energy(&[]),
            )
        }
        MissCause::WakeMissed => (
            "not reported because no woken device received its wake-up".to_owned(),
            if scenario.radio.wake_miss > 0.0 {
                vec![
                    format!("lower radio.wake_miss = {}", scenario.radio.wake_miss),
                    "raise devices, so that more of them can be woken".to_owned(),
                ]
            } else {
                background = Some(format!("The wake-up radios had no power. {}", balance()));
                save_energy(&["lower energy.e_wur"])
            },
        ),
        MissCause::NoEnergy => {
            background = Some(balance());
            (
                "detected by devices that could not pay energy.e_tx for a report".to_owned(),
                save_energy(&["lower energy.e_tx"]),
            )
        }
        MissCause::Lost => (
            "reported, and the radio lost every report".to_owned(),
            to_strings(vec![
                if scenario.radio.bursts.is_some() {
                    "lower radio.bursts.loss"
                } else {
                    "lower radio.uplink_loss"
                },
                "raise devices, so that several of them report an event",
            ]),
        ),
    };
    (finding, background, suggestions)
}
