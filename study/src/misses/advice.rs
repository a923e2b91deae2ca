//! The change of the scenario that the main cause of missed events suggests. A test compares the named fields with the
//! declaration of the scenario.

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

/// Returns how the base station's policy senses more.
fn sense_more(policy: &str) -> &'static str {
    match policy {
        "knn" => "choose policy age-index with a low policy.age-index.price, or raise devices",
        "adjusted" => "raise policy.adjusted.t_on, or choose policy age-index",
        "q-learning" => "raise policy.q-learning.mu1, which needs tables of `reveille train q-learning`",
        "random" => "choose policy age-index, or shorten policy.random.t_drx",
        "age-index" => "lower policy.age-index.price",
        "dt" => "lower policy.dt.price",
        _ => "let the policy keep more devices in S1",
    }
}

/// Returns how the base station's policy senses less.
fn sense_less(policy: &str) -> &'static str {
    match policy {
        "adjusted" => "choose policy age-index, or lengthen policy.adjusted.t_drx",
        "q-learning" => "lengthen policy.q-learning.window",
        "random" => "choose policy age-index, or lengthen policy.random.t_drx",
        "age-index" => "raise policy.age-index.price",
        "dt" => "raise policy.dt.price",
        _ => "choose policy age-index with a higher policy.age-index.price",
    }
}

/// Returns the changes that give the devices more energy. A larger battery is among them only if batteries overflowed.
fn harvest_more(scenario: &Scenario, energy: Option<RunEnergy>) -> String {
    let is_trace = |class: &DeviceClass| matches!(class.harvest, Harvest::Trace(_));
    let has_rare_arrivals = |class: &DeviceClass| match class.harvest {
        Harvest::Eq5(Arrivals { lambda, .. }) => lambda * scenario.run.tau < 0.5,
        Harvest::ExpMinusLambda(_) | Harvest::Mpp(_) | Harvest::Diurnal(_) | Harvest::Trace(_) => false,
    };
    let source = if scenario.classes.iter().any(is_trace) {
        "raise harvest.trace.scale (the panel's area_cm2 with irradiance)"
    } else if scenario.classes.iter().any(has_rare_arrivals) {
        "raise harvest.lambda or harvest.e_b"
    } else {
        "raise harvest.e_b"
    };
    let overflowed = energy.is_some_and(|energy| energy.overflow_per_device_tti > 0.0);
    format!("{source}{}", if overflowed { ", or energy.e_max" } else { "" })
}

/// Returns a sentence with the expected harvest and the costs of a device.
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

/// Returns `text` with a capital letter.
fn capitalise(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().collect::<String>() + letters.as_str()
    })
}

/// Returns the advice against `cause`, which explains `count` of `missed` events, most of them near `place`. In a run
/// with many device-TTIs of low energy, devices sleep to save energy, and more sensing would only empty them.
pub(super) fn advice(
    scenario: &Scenario,
    cause: MissCause,
    (count, missed): (u64, usize),
    place: Point,
    energy: Option<RunEnergy>,
) -> String {
    let (policy, d_max) = (scenario.policy.name(), scenario.sensing.d_max);
    let most = format!("near x = {:.1} m, y = {:.1} m", place.x, place.y);
    let spent = scenario
        .classes
        .first()
        .map_or(f64::NAN, |class| class.energy.e_tx.units());
    let (finding, change) = match cause {
        MissCause::OutOfReach => (
            format!("more than sensing.d_max = {d_max} m from every device, most {most}"),
            "Place a device there with layout.file, raise devices, or raise sensing.d_max".to_owned(),
        ),
        MissCause::Removed => (
            format!("near devices that were removed with their process, most {most}"),
            "Run with --on-loss wait, so that another process takes over lost devices".to_owned(),
        ),
        MissCause::Undetected => (
            format!("not detected by any device within sensing.d_max = {d_max} m, most {most}"),
            "Lower sensing.eta, or raise devices so that events are closer to a device".to_owned(),
        ),
        MissCause::Asleep => (
            format!("within reach of devices that slept by plan, most {most}"),
            match energy
                .map(|energy| energy.low_energy_pct)
                .filter(|low| *low >= LOW_ENERGY_PCT)
            {
                Some(low) => format!(
                    "Batteries were below energy.e_tx in {low:.0} % of device-TTIs, so more sensing would empty them. \
                     {}: {}",
                    balance(scenario),
                    harvest_more(scenario, energy)
                ),
                None => format!("To sense more, {}", sense_more(policy)),
            },
        ),
        MissCause::Unpowered => (
            format!("near devices that were told to sense and had no power, most {most}"),
            format!(
                "{}: {}, or {}",
                balance(scenario),
                harvest_more(scenario, energy),
                sense_less(policy)
            ),
        ),
        MissCause::WakeMissed => (
            format!("not reported because no woken device received its wake-up, most {most}"),
            if scenario.radio.wake_miss > 0.0 {
                format!(
                    "Lower radio.wake_miss = {}, or raise devices so that more of them can be woken",
                    scenario.radio.wake_miss
                )
            } else {
                format!(
                    "The wake-up radios had no power: {}, or lower energy.e_wur",
                    harvest_more(scenario, energy)
                )
            },
        ),
        MissCause::NoEnergy => (
            format!("detected by devices that could not pay energy.e_tx = {spent} for a report, most {most}"),
            format!(
                "{}, lower energy.e_tx, or sense less: {}",
                capitalise(&harvest_more(scenario, energy)),
                sense_less(policy)
            ),
        ),
        MissCause::Lost => (
            format!("reported, and the radio lost every report, most {most}"),
            format!(
                "Lower {}, or raise devices so that several of them report an event",
                if scenario.radio.bursts.is_some() {
                    "radio.bursts.loss"
                } else {
                    "radio.uplink_loss"
                }
            ),
        ),
    };
    let verb = if count == 1 { "was" } else { "were" };
    format!("{count} of {missed} missed events {verb} {finding}. {change}.")
}
