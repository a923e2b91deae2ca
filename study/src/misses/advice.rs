//! The change of the scenario that the main cause of missed events suggests. A test compares the named fields with the
//! declaration of the scenario.

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::harvest::Harvest;
use reveille_common::totals::MissCause;

/// Share of device-TTIs with B < E_Tx from which devices lack energy, %.
const LOW_ENERGY_PCT: f64 = 5.0;

/// Returns how the base station's policy senses more.
fn sense_more(policy: &str) -> &'static str {
    match policy {
        "knn" => "choose policy age-index with a low policy.age-index.price, or raise devices",
        "adjusted" => "raise policy.adjusted.t_on or shorten policy.adjusted.t_drx",
        "q-learning" => "raise policy.q-learning.mu1, which needs tables of `reveille train q-learning`",
        "random" => "raise policy.random.t_on or shorten policy.random.t_drx",
        "age-index" => "lower policy.age-index.price",
        "dt" => "lower policy.dt.price",
        _ => "let the policy keep more devices in S1",
    }
}

/// Returns how the base station's policy senses less.
fn sense_less(policy: &str) -> &'static str {
    match policy {
        "adjusted" => "lengthen policy.adjusted.t_drx",
        "q-learning" => "lengthen policy.q-learning.window",
        "random" => "lengthen policy.random.t_drx",
        "age-index" => "raise policy.age-index.price",
        "dt" => "raise policy.dt.price",
        _ => "choose policy age-index with a higher policy.age-index.price",
    }
}

/// Returns the fields that give the devices more energy.
fn harvest_more(scenario: &Scenario) -> &'static str {
    let is_trace = scenario
        .classes
        .iter()
        .any(|class| matches!(class.harvest, Harvest::Trace(_)));
    if is_trace {
        "harvest.trace.scale (the panel's area_cm2 with irradiance)"
    } else {
        "harvest.e_b"
    }
}

/// Returns the advice against `cause`, which explains `count` of `missed` events, most of them near `place`. In a run
/// with many device-TTIs of low energy, devices sleep to save energy, and more sensing would only empty them.
pub(super) fn advice(
    scenario: &Scenario,
    cause: MissCause,
    (count, missed): (u64, usize),
    place: Point,
    low_energy_pct: Option<f64>,
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
            match low_energy_pct.filter(|low| *low >= LOW_ENERGY_PCT) {
                Some(low) => format!(
                    "Batteries were below energy.e_tx in {low:.0} % of device-TTIs, so more sensing would empty them: \
                     raise {} or energy.e_max",
                    harvest_more(scenario)
                ),
                None => format!("To sense more, {}", sense_more(policy)),
            },
        ),
        MissCause::Unpowered => (
            format!("near devices that were told to sense and had no power, most {most}"),
            format!(
                "Raise {} or energy.e_max, or sense less: {}",
                harvest_more(scenario),
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
                    "The wake-up radios had no power: raise {} or lower energy.e_wur",
                    harvest_more(scenario)
                )
            },
        ),
        MissCause::NoEnergy => (
            format!("detected by devices that could not pay energy.e_tx = {spent} for a report, most {most}"),
            format!(
                "Raise {} or lower energy.e_tx, or sense less: {}",
                harvest_more(scenario),
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
