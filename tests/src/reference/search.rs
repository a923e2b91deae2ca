//! Search for the adjusted duty cycle (Sec. V-A, P2): every pair of the grid is tried in runs of the reference.
//! `tests/tests/adjusted.rs` compares it with the emulator's search.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::policy::adjusted::search::DutyCycleChoice;
use reveille_bs::policy::adjusted::settings::AdjustedSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::scenario::assign_classes;
use reveille_lab::preparation::prepare;

use super::deployment::ReferenceDeployment;
use super::i_min::least_information;
use super::policy::ReferencePolicy;
use super::world::play;

/// Difference between the seeds of pilot runs and the run, as in `lab/src/preparation.rs`.
const PILOT_SEED_OFFSET: u64 = 0x5EED_0F91_1070_0500;
/// Warm-up share of pilot runs, as in `lab/src/preparation.rs`.
const PILOT_WARM_UP: f64 = 0.25;
/// Information values closer than this can change order with the order of summation.
const INFORMATION_TOLERANCE: f64 = 1e-9;

/// Outcome of the pilot run of a pair, over its measured part.
struct PilotResult {
    /// t_on and t_DRX.
    pair: (u64, u64),
    /// Information per event; `None` without events.
    information: Option<f64>,
    /// Energy spent by all devices, micro-units.
    spent: u64,
    /// Number of counted events.
    events: u64,
}

/// Returns the pair (t_on, t_DRX) of the search, or the emulator's pair if the search is too close to call.
pub(super) fn search_or_emulated_if_close(scenario: &Scenario, positions: &[Point]) -> (u64, u64) {
    reference_search(scenario, positions).unwrap_or_else(|| {
        let emulated = prepare(scenario).pilot_choice.expect("the search finds a pair");
        let choice: &DutyCycleChoice = emulated.downcast_ref().expect("a pair");
        (u64::from(choice.t_on), u64::from(choice.t_drx))
    })
}

/// Returns the pair (t_on, t_DRX) that the reference alone finds; `None` if too close to call.
///
/// # Panics
/// If the policy of `scenario` is not `adjusted`.
pub fn reference_search(scenario: &Scenario, positions: &[Point]) -> Option<(u64, u64)> {
    let settings = scenario
        .policy
        .settings()
        .downcast_ref::<AdjustedSettings>()
        .expect("settings of adjusted");
    let mut pairs = Vec::new();
    for &t_on in &settings.t_on {
        for &t_drx in &settings.t_drx {
            if t_on <= t_drx {
                pairs.push((u64::from(t_on), u64::from(t_drx)));
            }
        }
    }
    let deployment = ReferenceDeployment {
        positions: positions.to_vec(),
        classes: assign_classes(scenario),
        has_known_harvest: true,
    };
    let mut ttis = settings.pilot_ttis;
    let limit = settings.pilot_limit.max(ttis);
    loop {
        let mut pilot_scenario = scenario.with_seed(scenario.run.seed.wrapping_add(PILOT_SEED_OFFSET));
        pilot_scenario.run.ttis = ttis;
        pilot_scenario.run.warm_up = PILOT_WARM_UP;
        let mut pilots = Vec::new();
        for &pair in &pairs {
            // The offsets come from the run itself, not from the pilot.
            let policy = ReferencePolicy::adjusted(scenario, positions, pair);
            let run = play(&pilot_scenario, &deployment, policy, &[]);
            if run.ambiguous.is_some() {
                return None;
            }
            let events = run.totals.events;
            pilots.push(PilotResult {
                pair,
                information: (events > 0).then(|| run.totals.information_pico as f64 * 1e-12 / events as f64),
                spent: run.measured.spent.total().micro(),
                events,
            });
        }
        if ttis == limit || pilots.iter().all(|pilot| pilot.events >= settings.pilot_events) {
            return best_pair(&pilots, least_information(positions, scenario.area, &scenario.sensing));
        }
        ttis = (2 * ttis).min(limit);
    }
}

/// Returns the cheapest pair that reaches `i_min`, or else the pair with the most information, or else the cheapest.
/// `None` if too close to call.
fn best_pair(pilots: &[PilotResult], i_min: f64) -> Option<(u64, u64)> {
    let cheapest_pair = |is_eligible: &dyn Fn(&PilotResult) -> bool| {
        let mut cheapest: Option<&PilotResult> = None;
        for pilot in pilots.iter().filter(|pilot| is_eligible(pilot)) {
            if cheapest.is_none_or(|cheapest| pilot.spent < cheapest.spent) {
                cheapest = Some(pilot);
            }
        }
        cheapest.map(|pilot| pilot.pair)
    };
    let information: Vec<f64> = pilots.iter().filter_map(|pilot| pilot.information).collect();
    if information
        .iter()
        .any(|value| (value - i_min).abs() < INFORMATION_TOLERANCE)
    {
        return None;
    }
    let reaches_i_min = |pilot: &PilotResult| pilot.information.is_some_and(|value| value >= i_min);
    if let Some(pair) = cheapest_pair(&reaches_i_min) {
        return Some(pair);
    }
    let most = information.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut leaders = pilots.iter().filter(|pilot| {
        pilot
            .information
            .is_some_and(|value| value > most - INFORMATION_TOLERANCE)
    });
    match (leaders.next(), leaders.next()) {
        (None, _) => cheapest_pair(&|_| true),
        (Some(leader), None) => Some(leader.pair),
        // Several pairs share the first place, exactly or nearly. Only an exact tie survives another order of
        // summation.
        (Some(first), Some(_)) => {
            let is_exact_tie = information
                .iter()
                .filter(|value| **value > most - INFORMATION_TOLERANCE)
                .all(|value| value.to_bits() == most.to_bits());
            is_exact_tie.then_some(first.pair)
        }
    }
}
