//! The change of the scenario that the main cause of missed events suggests. A test compares the named fields with the
//! declaration of the scenario. Policies without an entry below get general advice.

use std::fmt;

use reveille_bs::scenario::Scenario;
use reveille_common::digits::format_significant;
use reveille_common::energy_balance::EnergyBalance;
use reveille_common::geometry::Point;
use reveille_common::harvest::{Arrivals, Harvest};
use reveille_common::scenario::DeviceClass;
use reveille_common::totals::MissCause;

/// Metrics of a finished run about energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunEnergy {
    /// The metric `low_energy_pct`, % of device-TTIs.
    pub low_energy_pct: f64,
    /// The metric `overflow_per_device_tti`, units.
    pub overflow_per_device_tti: f64,
}

/// Share of device-TTIs with B < E_Tx from which devices lack energy, %.
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
fn sense_more(policy: &str) -> Vec<&'static str> {
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
fn sense_less(policy: &str) -> Vec<&'static str> {
    match policy {
        "adjusted" => vec!["choose policy age-index", "lengthen policy.adjusted.t_drx"],
        "q-learning" => vec!["lengthen policy.q-learning.window"],
        "random" => vec!["choose policy age-index", "lengthen policy.random.t_drx"],
        "age-index" => vec!["raise policy.age-index.price"],
        "dt" => vec!["raise policy.dt.price"],
        _ => vec!["choose policy age-index with a high policy.age-index.price"],
    }
}

/// Returns the changes that give the devices more energy. A larger battery is among them only if batteries overflowed.
fn harvest_more(scenario: &Scenario, energy: Option<RunEnergy>) -> Vec<&'static str> {
    let is_trace = |class: &DeviceClass| matches!(class.harvest, Harvest::Trace(_));
    let has_rare_arrivals = |class: &DeviceClass| match class.harvest {
        Harvest::Eq5(Arrivals { lambda, .. }) => lambda * scenario.run.tau < 0.5,
        Harvest::ExpMinusLambda(_) | Harvest::Mpp(_) | Harvest::Diurnal(_) | Harvest::Trace(_) => false,
    };
    let mut changes = if scenario.classes.iter().any(is_trace) {
        vec!["raise harvest.trace.scale (the panel's area_cm2 with irradiance)"]
    } else if scenario.classes.iter().any(has_rare_arrivals) {
        vec!["raise harvest.lambda", "raise harvest.e_b"]
    } else {
        vec!["raise harvest.e_b"]
    };
    if energy.is_some_and(|energy| energy.overflow_per_device_tti > 0.0) {
        changes.push("raise energy.e_max");
    }
    changes
}

/// Returns a sentence with the expected harvest of a device, and with the costs in the first class.
fn balance(scenario: &Scenario) -> String {
    let balance = EnergyBalance::new(scenario);
    let number = |x: f64| format_significant(x, 3);
    let class = balance.classes.first();
    let [sleeping, sensing] = class.map_or([0.0; 2], |class| [class.sleeping_cost, class.sensing_cost]);
    format!(
        "A device harvests {} units per TTI; sleeping costs {}, sensing {}",
        number(balance.harvest().mean),
        number(sleeping),
        number(sensing)
    )
}

/// Returns the advice against `cause`, which explains `count` of `missed` events, most of them near `place`.
pub(super) fn advice(
    scenario: &Scenario,
    cause: MissCause,
    (count, missed): (u64, usize),
    place: Point,
    energy: Option<RunEnergy>,
) -> Advice {
    let (finding, background, suggestions) = explain(scenario, cause, energy);
    let verb = if count == 1 { "was" } else { "were" };
    let background = background.map_or_else(String::new, |text| format!(" {text}"));
    Advice {
        finding: format!(
            "{count} of {missed} missed events {verb} {finding}, most near x = {:.1} m, y = {:.1} m.{background}",
            place.x, place.y
        ),
        suggestions,
    }
}

/// Returns what happened to the events of `cause`, sentences about the energy of the devices, and changes against it.
/// In a run with many device-TTIs of low energy, devices sleep to save energy, and more sensing would only empty them.
fn explain(scenario: &Scenario, cause: MissCause, energy: Option<RunEnergy>) -> (String, Option<String>, Vec<String>) {
    let (policy, d_max) = (scenario.policy.name(), scenario.sensing.d_max);
    let report_cost = scenario
        .classes
        .first()
        .map_or(f64::NAN, |class| class.energy.e_tx.units());
    let harvest_more = || harvest_more(scenario, energy);
    let owned = |changes: Vec<&str>| changes.into_iter().map(str::to_owned).collect::<Vec<_>>();
    let low_energy = energy
        .map(|energy| energy.low_energy_pct)
        .filter(|low| *low >= LOW_ENERGY_PCT);
    let mut background = None;
    let (finding, suggestions) = match cause {
        MissCause::OutOfReach => (
            format!("more than sensing.d_max = {d_max} m from every device"),
            owned(vec![
                "place a device there with layout.file",
                "raise devices",
                "raise sensing.d_max",
            ]),
        ),
        MissCause::Removed => (
            "near devices that were removed with their process, or had failed".to_owned(),
            owned(vec![
                "run with --on-loss wait, so that another process takes over lost devices",
                "revive failed devices earlier, in the script of actions",
            ]),
        ),
        MissCause::Undetected => (
            format!("not detected by any device within sensing.d_max = {d_max} m"),
            owned(vec![
                "lower sensing.eta",
                "raise devices, so that events are closer to a device",
            ]),
        ),
        MissCause::Asleep => (
            "within reach of devices that slept by plan".to_owned(),
            match low_energy {
                Some(low) => {
                    background = Some(format!(
                        "Batteries were below energy.e_tx in {low:.0} % of device-TTIs, so more sensing would empty \
                         them. {}.",
                        balance(scenario)
                    ));
                    owned(harvest_more())
                }
                None => owned(sense_more(policy)),
            },
        ),
        MissCause::Unpowered => {
            background = Some(format!("{}.", balance(scenario)));
            (
                "near devices that were told to sense and had no power".to_owned(),
                owned([harvest_more(), sense_less(policy)].concat()),
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
                background = Some("The wake-up radios had no power.".to_owned());
                owned([harvest_more(), vec!["lower energy.e_wur"]].concat())
            },
        ),
        MissCause::NoEnergy => {
            background = Some(format!("{}.", balance(scenario)));
            (
                format!("detected by devices that could not pay energy.e_tx = {report_cost} for a report"),
                owned([harvest_more(), vec!["lower energy.e_tx"], sense_less(policy)].concat()),
            )
        }
        MissCause::Lost => (
            "reported, and the radio lost every report".to_owned(),
            owned(vec![
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
