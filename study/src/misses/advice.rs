//! The changes of the scenario that the main cause of missed events suggests, with values to try.
//! [`Misses::advice`](super::Misses::advice) calls it. docs/reading-results.md and `tests/program/misses.rs` contain
//! some of the texts.
//!
//! A test compares the named fields with the declaration of the scenario. No test checks the names of policies, listed
//! in `bs/src/policy/registry.rs`: a policy without an arm gets the advice of the last arm.

use std::fmt::{self, Write as _};

use reveille_bs::scenario::Scenario;
use reveille_common::digits::{count_noun, format_significant};
use reveille_common::energy_balance::{ClassBalance, EnergyBalance};
use reveille_common::geometry::Point;
use reveille_common::harvest::{Arrivals, Harvest};
use reveille_common::scenario::DeviceClass;
use reveille_common::totals::MissCause;

use super::suggestion::{PresentValues, Suggestion};
use crate::analysis::harvest::{LambdaReading, lambdas_with_positive_net};
use crate::first_letter::upper_first;

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
/// Share of the harvest that does not fit into batteries from which the advice mentions it, %.
const OVERFLOW_PCT: f64 = 5.0;
/// A battery that pays for fewer reports than this counts as small.
const SMALL_BATTERY_REPORTS: u64 = 4;

/// Advice about the main cause of missed events.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Advice {
    /// Sentences that name the cause, the place and the energy balance.
    pub finding: String,
    /// Alternative changes of the scenario.
    pub suggestions: Vec<Suggestion>,
}

impl Advice {
    /// Returns the finding with the first suggestion, and the number of further ones, for captions.
    pub fn summary(&self) -> String {
        let mut text = self.finding.clone();
        text.extend(self.suggestions.first().map(sentence));
        let more = self.suggestions.len().saturating_sub(1);
        if more > 0 {
            let _infallible = write!(text, " {more} more: reveille inspect misses.");
        }
        text
    }
}

impl fmt::Display for Advice {
    /// Writes one paragraph, for programs.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.finding)?;
        self.suggestions
            .iter()
            .try_for_each(|suggestion| f.write_str(&sentence(suggestion)))
    }
}

/// Returns a suggestion as a sentence after a space.
fn sentence(suggestion: &Suggestion) -> String {
    format!(" {}.", upper_first(&suggestion.text))
}

/// The main cause of missed events, and their place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct MainCause {
    pub cause: MissCause,
    /// Number of missed events with this cause, and of all missed events.
    pub count: u64,
    pub missed: usize,
    /// The place that has clearly more of them than others.
    pub hot_spot: Option<HotSpot>,
    /// The largest distance of an event with this cause from its nearest device, metres.
    pub farthest_m: f64,
}

/// A place of many missed events.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct HotSpot {
    /// Number of events near the place.
    pub count: usize,
    /// Their mean place.
    pub place: Point,
}

/// Factors to try for a field whose lower values can help, and for a field whose higher values can help.
const LOWER: [f64; 2] = [0.5, 0.25];
const HIGHER: [f64; 2] = [2.0, 4.0];
/// Factors to try for a field where both directions can help.
const BOTH: [f64; 4] = [0.5, 0.25, 2.0, 4.0];
/// Prices to try under `age-index` in place of another policy. Its default is 0.35. If energy is scarce, lower ones
/// only empty batteries.
const ALL_PRICES: [&str; 4] = ["0.1", "0.2", "0.35", "1.0"];
const HIGH_PRICES: [&str; 3] = ["0.35", "0.7", "1.4"];

/// Suggests the policy `age-index` with one of `prices`.
fn choose_age_index(prices: &[&str]) -> Suggestion {
    let prices: Vec<String> = prices.iter().map(|price| (*price).to_owned()).collect();
    Suggestion::with_values(
        "choose policy age-index with policy.age-index.price",
        &[("policy.name", "age-index")],
        "policy.age-index.price",
        &prices,
    )
}

/// Suggests twice as many devices.
fn raise_devices(present: &PresentValues, purpose: &str) -> Option<Suggestion> {
    Some(present.scale("raise", "devices", &[2.0])?.with_purpose(purpose))
}

/// Suggests other prices θ. A lower price can empty the batteries and so lead to more missed events.
fn change_price(present: &PresentValues, field: &str) -> Option<Suggestion> {
    let change = present.scale("change", field, &BOTH)?;
    Some(change.with_purpose(" (a lower price senses more unless it empties batteries, a higher one saves energy)"))
}

/// Returns changes of the base station's policy against sleep. A price is tried in both directions, since a lower one
/// can empty batteries.
fn ways_against_sleep(policy: &str, present: &PresentValues) -> Vec<Suggestion> {
    let ways = match policy {
        "knn" => vec![Some(choose_age_index(&ALL_PRICES)), raise_devices(present, "")],
        "adjusted" => vec![
            present.scale("raise", "policy.adjusted.t_on", &HIGHER),
            Some(choose_age_index(&ALL_PRICES)),
        ],
        "q-learning" => vec![Some(Suggestion::without_trials(
            "raise policy.q-learning.mu1, with tables of `reveille train q-learning`",
        ))],
        "random" => {
            // No t_DRX can be shorter than the longest t_on.
            let longest_t_on = present.largest_of_list("policy.random.t_on");
            vec![
                Some(choose_age_index(&ALL_PRICES)),
                present.scale_from("shorten", "policy.random.t_drx", &LOWER, longest_t_on),
            ]
        }
        "age-index" => vec![change_price(present, "policy.age-index.price")],
        "dt" => vec![change_price(present, "policy.dt.price")],
        _ => vec![Some(Suggestion::without_trials(
            "let the policy keep more devices in S1",
        ))],
    };
    ways.into_iter().flatten().collect()
}

/// Returns the ways in which the base station's policy senses less.
fn ways_to_sense_less(policy: &str, present: &PresentValues) -> Vec<Suggestion> {
    let ways = match policy {
        "adjusted" => vec![
            Some(choose_age_index(&HIGH_PRICES)),
            present.scale("lengthen", "policy.adjusted.t_drx", &[2.0]),
        ],
        // The shipped tables cover the windows 1, 2 and 4.
        "q-learning" => vec![
            Some(choose_age_index(&HIGH_PRICES)),
            present.scale("lengthen", "policy.q-learning.window", &HIGHER),
        ],
        "random" => vec![
            Some(choose_age_index(&HIGH_PRICES)),
            present.scale("lengthen", "policy.random.t_drx", &HIGHER),
        ],
        "age-index" => vec![present.scale("raise", "policy.age-index.price", &HIGHER)],
        "dt" => vec![present.scale("raise", "policy.dt.price", &HIGHER)],
        _ => vec![Some(choose_age_index(&HIGH_PRICES))],
    };
    ways.into_iter().flatten().collect()
}

/// Returns changes of the policy against sleep in a run whose batteries are often low.
fn ways_to_sense_with_low_energy(policy: &str, present: &PresentValues) -> Vec<Suggestion> {
    match policy {
        "age-index" | "dt" => ways_against_sleep(policy, present),
        _ => vec![choose_age_index(&HIGH_PRICES)],
    }
}

/// Returns the ways in which failed devices lead to fewer missed events.
fn ways_to_tolerate_failures(present: &PresentValues) -> Vec<Suggestion> {
    let raised = raise_devices(present, ", so that others detect an event near a failed one");
    let revived = Suggestion::without_trials("revive failed devices earlier, in the script of actions");
    raised.into_iter().chain([revived]).collect()
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

    /// Number of reports that a full battery pays for.
    fn reports_per_battery(&self) -> u64 {
        (self.balance.capacity / self.balance.report_cost).floor() as u64
    }

    /// Whether a full battery pays for so few reports that it limits them, and not only the harvest.
    fn has_small_battery(&self) -> bool {
        self.reports_per_battery() < SMALL_BATTERY_REPORTS
    }

    /// Describes the expected harvest and the costs of a device in a run with this `energy`, in sentences.
    fn describe(&self, energy: Option<RunEnergy>) -> String {
        let number = |x: f64| format_significant(x, 3);
        let class = if self.is_one_of_several {
            format!(" of class {}", self.class.name)
        } else {
            String::new()
        };
        let mut sentences = vec![format!(
            "A device{class} is expected to harvest {} units per TTI; sleeping costs {}, sensing {}.",
            number(self.balance.harvest.mean),
            number(self.balance.sleeping_cost),
            number(self.balance.sensing_cost)
        )];
        if self.has_small_battery() {
            let reports = count_noun(self.reports_per_battery(), "report");
            sentences.push(format!("A full battery pays for {reports}."));
        }
        let lost_pct = energy.map_or(0.0, |energy| {
            100.0 * energy.overflow_per_device_tti / self.balance.harvest.mean
        });
        if !self.is_one_of_several && lost_pct >= OVERFLOW_PCT {
            sentences.push(format!(
                "Of the harvest, {lost_pct:.0} % did not fit into full batteries."
            ));
        }
        if !self.can_sleep() {
            let sentence = "The harvest does not pay for sleeping, so batteries run down under every policy.";
            sentences.push(sentence.to_owned());
        }
        sentences.join(" ")
    }

    /// The path of an energy or harvest field of this class.
    fn field(&self, present: &PresentValues, field: &str) -> String {
        present.class_field(&self.class.name, field)
    }

    /// Returns a consumption in units per TTI between sleeping, or the present harvest, and sensing in every TTI.
    fn middle_cost(&self) -> f64 {
        let low = (2.0 * self.balance.sleeping_cost).max(self.balance.harvest.mean);
        (low * self.balance.sensing_cost).sqrt()
    }

    /// Suggests to raise `field` to values between the present one and the one that pays for sensing in every TTI; to
    /// twice its value if it pays already or no such value exists. `value_for` returns the value at which the harvest
    /// equals a consumption in units per TTI; `None` if no value suffices.
    fn raise_harvest(
        &self,
        present: &PresentValues,
        field: &str,
        value_for: impl Fn(f64) -> Option<f64>,
    ) -> Option<Suggestion> {
        let field = self.field(present, field);
        let (sensing, mean) = (self.balance.sensing_cost, self.balance.harvest.mean);
        let twice_sleep = 2.0 * self.balance.sleeping_cost;
        let costs = [
            (twice_sleep, Some("pays twice the cost of sleeping")),
            (self.middle_cost(), None),
            (sensing, Some("pays for sensing in every TTI")),
        ];
        let in_preset = present.larger_in_preset(&field).map(|value| (value, None));
        let mut values: Vec<(f64, Option<&str>)> = costs
            .into_iter()
            .filter(|(cost, _)| *cost > mean && *cost <= sensing)
            .filter_map(|(cost, purpose)| Some((value_for(cost)?, purpose)))
            .chain(in_preset)
            .collect();
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut payable: Vec<(String, Option<&str>)> = values
            .into_iter()
            .map(|(value, purpose)| (format_significant(value, 3), purpose))
            .collect();
        payable.dedup_by(|later, earlier| {
            let is_equal = later.0 == earlier.0;
            earlier.1 = if is_equal { later.1.or(earlier.1) } else { earlier.1 };
            is_equal
        });
        if payable.is_empty() {
            return present.scale("raise", &field, &[2.0]);
        }
        let purposes: Vec<String> = payable
            .iter()
            .filter_map(|(value, purpose)| Some(format!("{value} {}", (*purpose)?)))
            .collect();
        let values: Vec<String> = payable.iter().map(|(value, _)| value.clone()).collect();
        let suggestion = present.choose("raise", &field, &values);
        let purpose = format!(" (on average, {})", purposes.join(" and "));
        Some(if purposes.is_empty() {
            suggestion
        } else {
            suggestion.with_purpose(&purpose)
        })
    }

    /// Suggests a larger battery: one that lasts through the longest stretch without harvest, if the present one does
    /// not, or else twice the capacity.
    fn raise_capacity(&self, present: &PresentValues) -> Option<Suggestion> {
        let field = self.field(present, "energy.e_max");
        let ClassBalance {
            sleeping_cost,
            report_cost,
            capacity,
            longest_gap,
            ..
        } = &self.balance;
        let needed = longest_gap.map(|gap| gap.ttis as f64 * sleeping_cost + report_cost);
        match needed.filter(|needed| needed > capacity) {
            Some(needed) => {
                let effect = "pays for sleep and a report in the longest time without harvest";
                let value = format_significant(needed.ceil(), 3);
                Some(present.replace("raise", &field, &value, effect))
            }
            None if self.has_small_battery() => present.scale("raise", &field, &[2.0, 4.0, 8.0]),
            None => present.scale("raise", &field, &[2.0]),
        }
    }

    /// Returns the changes that give the devices more energy. A larger battery is among them only if batteries
    /// overflowed.
    fn ways_to_harvest_more(&self, present: &PresentValues, energy: Option<RunEnergy>) -> Vec<Suggestion> {
        let mean = self.balance.harvest.mean;
        // A device that harvests nothing in this run has no amount to scale.
        let factor_for = |cost: f64| (mean > 0.0).then(|| cost / mean);
        let mut changes = Vec::new();
        let has_overflow = energy.is_some_and(|energy| energy.overflow_per_device_tti > 0.0);
        let battery = has_overflow.then(|| self.raise_capacity(present)).flatten();
        // In a gap such as a night, only the battery helps. A small battery also loses an additional harvest.
        let is_battery_first = self.balance.longest_gap.is_some() || self.has_small_battery();
        changes.extend(battery.clone().filter(|_| is_battery_first));
        if let Harvest::Trace(trace) = &self.class.harvest {
            // Irradiance becomes energy in proportion to the area of the panel.
            let (field, value) = match &trace.panel {
                Some(panel) => ("harvest.trace.panel.area_cm2", panel.area_cm2),
                None => ("harvest.trace.scale", trace.scale),
            };
            changes.extend(self.raise_harvest(present, field, |cost| Some(value * factor_for(cost)?)));
        } else {
            // Every source except a trace has the field `harvest.e_b`, which `max_per_tti` returns.
            let e_b = self.class.harvest.max_per_tti().units();
            changes.extend(self.raise_harvest(present, "harvest.e_b", |cost| Some(e_b * factor_for(cost)?)));
            // λτ·exp(-λτ) is largest at λτ = 1. From 0.5 on, a larger λ adds at most 22 %.
            if let Harvest::Eq5(Arrivals { lambda, .. }) = self.class.harvest
                && lambda * self.tau < 0.5
            {
                let lambda_for =
                    |cost: f64| Some(lambdas_with_positive_net(LambdaReading::Eq5, e_b, cost, self.tau)?.0);
                // A λ that pays for little more than sleeping leaves devices unable to sense.
                if lambda_for(self.middle_cost()).is_some() {
                    changes.extend(self.raise_harvest(present, "harvest.lambda", lambda_for));
                }
            }
        }
        changes.extend(battery.filter(|_| !is_battery_first));
        changes
    }

    /// Returns the changes that help devices without enough energy: more energy, and less consumption by the policy or
    /// by a lower cost `spend_less`, a field, if the harvest pays for sleeping.
    fn ways_to_save_energy(
        &self,
        present: &PresentValues,
        energy: Option<RunEnergy>,
        policy: &str,
        spend_less: Option<&str>,
    ) -> Vec<Suggestion> {
        let mut changes = self.ways_to_harvest_more(present, energy);
        // If the harvest does not pay for sleeping, batteries run down under every policy.
        if self.can_sleep() {
            let lower_cost = spend_less.map(|field| present.scale("lower", &self.field(present, field), &LOWER));
            changes.extend(lower_cost.flatten());
            changes.extend(ways_to_sense_less(policy, present));
        }
        changes
    }
}

/// Returns the advice against `main`.
pub(super) fn advise(scenario: &Scenario, main: &MainCause, energy: Option<RunEnergy>) -> Advice {
    let (finding, background, mut suggestions) = explain(scenario, main, energy);
    if suggestions.is_empty() {
        suggestions.extend(raise_devices(&PresentValues::new(scenario), ""));
    }
    let MainCause { count, missed, .. } = main;
    let near = main.hot_spot.map_or_else(String::new, |HotSpot { count, place }| {
        format!(", {count} of them near x = {:.1} m, y = {:.1} m", place.x, place.y)
    });
    let verb = if *count == 1 { "was" } else { "were" };
    let background = background.map_or_else(String::new, |text| format!(" {text}"));
    Advice {
        finding: format!("{count} of {missed} missed events {verb} {finding}{near}.{background}"),
        suggestions,
    }
}

/// Returns the ways to reach the events of `main`, which are out of reach.
fn ways_to_reach(present: &PresentValues, main: &MainCause) -> Vec<Suggestion> {
    // Rounded up to centimetres.
    let range = format_significant((main.farthest_m * 100.0).ceil() / 100.0, 6);
    let place = match main.hot_spot {
        Some(_) => "place a device there with layout.file",
        None => "place devices near them with layout.file",
    };
    let mut ways = vec![Suggestion::without_trials(place)];
    ways.extend(raise_devices(present, ""));
    ways.push(present.replace("raise", "sensing.d_max", &range, "reaches every one of them"));
    ways
}

/// Returns the ways to lose fewer reports.
fn ways_to_lose_less(scenario: &Scenario, present: &PresentValues) -> Vec<Suggestion> {
    let loss = if scenario.radio.bursts.is_some() {
        "radio.bursts.loss"
    } else {
        "radio.uplink_loss"
    };
    let devices = raise_devices(present, ", so that several of them report an event");
    present
        .scale("lower", loss, &LOWER)
        .into_iter()
        .chain(devices)
        .collect()
}

/// Returns, in this order, the part of a sentence that follows "missed events were", sentences about the energy of the
/// devices, and the changes against the cause. In a run with many device-TTIs of low energy, devices sleep to save
/// energy, and more sensing would only empty them.
fn explain(
    scenario: &Scenario,
    main: &MainCause,
    energy: Option<RunEnergy>,
) -> (String, Option<String>, Vec<Suggestion>) {
    let (policy, d_max) = (scenario.policy.name(), scenario.sensing.d_max);
    let weakest = WeakestClass::new(scenario);
    let present = PresentValues::new(scenario);
    let save_energy = |spend_less: Option<&str>| weakest.ways_to_save_energy(&present, energy, policy, spend_less);
    let balance = || weakest.describe(energy);
    let known = |changes: Vec<Option<Suggestion>>| changes.into_iter().flatten().collect::<Vec<_>>();
    let low_energy = energy
        .map(|energy| energy.low_energy_pct)
        .filter(|low_energy_pct| *low_energy_pct >= LOW_ENERGY_PCT);
    let mut background = None;
    let (finding, suggestions) = match main.cause {
        MissCause::OutOfReach => (
            format!("more than sensing.d_max = {d_max} m from every device"),
            ways_to_reach(&present, main),
        ),
        MissCause::Removed => (
            "near devices that were removed with their process".to_owned(),
            vec![Suggestion::without_trials(
                "run with --on-loss wait, so that another process takes over lost devices",
            )],
        ),
        MissCause::Undetected => (
            format!("not detected by any device within sensing.d_max = {d_max} m"),
            known(vec![
                present.scale("lower", "sensing.eta", &LOWER),
                raise_devices(&present, ", so that events are closer to a device"),
            ]),
        ),
        MissCause::Asleep => (
            "within reach of devices that slept by plan".to_owned(),
            match low_energy {
                Some(low_energy_pct) => {
                    background = Some(format!(
                        "Batteries were below energy.e_tx in {low_energy_pct:.0} % of device-TTIs, so devices sleep \
                         for lack of energy, and more sensing can empty them. {}",
                        balance()
                    ));
                    let mut changes = weakest.ways_to_harvest_more(&present, energy);
                    changes.extend(ways_to_sense_with_low_energy(policy, &present));
                    changes
                }
                None => ways_against_sleep(policy, &present),
            },
        ),
        MissCause::Failed => (
            "near devices that actions had failed".to_owned(),
            ways_to_tolerate_failures(&present),
        ),
        MissCause::Unpowered => {
            background = Some(balance());
            (
                "near devices that had no power to sense in their TTIs of δ = 1".to_owned(),
                save_energy(None),
            )
        }
        MissCause::WakeMissed => (
            "not reported because no woken device received its wake-up".to_owned(),
            if scenario.radio.wake_miss > 0.0 {
                known(vec![
                    present.scale("lower", "radio.wake_miss", &LOWER),
                    raise_devices(&present, ", so that more of them can be woken"),
                ])
            } else {
                background = Some(format!("The wake-up radios had no power. {}", balance()));
                save_energy(Some("energy.e_wur"))
            },
        ),
        MissCause::NoEnergy => {
            background = Some(balance());
            (
                "detected by devices that could not pay energy.e_tx for a report".to_owned(),
                save_energy(Some("energy.e_tx")),
            )
        }
        MissCause::Lost => (
            "reported, and the radio lost every report".to_owned(),
            ways_to_lose_less(scenario, &present),
        ),
    };
    (finding, background, suggestions)
}
