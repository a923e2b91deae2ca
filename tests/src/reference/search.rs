//! Search for the adjusted duty cycle (Sec. V-A, P2): every pair of the grid is tried in the reference's own runs.

use reveille_bs::policy::adjusted::search::DutyCycleChoice;
use reveille_bs::policy::adjusted::settings::AdjustedSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::scenario::assign_classes;
use reveille_lab::preparation::prepare;

use super::i_min::least_information;
use super::policy::ReferencePolicy;
use super::world::{ReferenceDeployment, play};

/// Difference between the seeds of pilot runs and the run.
const OTHER_SEED: u64 = 0x5EED_0F91_1070_0500;
/// Information values closer than this can change order with the order of summation.
const CLOSE: f64 = 1e-9;

/// Result of a pair.
struct SearchTrial {
    pair: (u64, u64),
    /// Information per event; `None` without events.
    information: Option<f64>,
    spent: u64,
    events: u64,
}

/// Returns the pair (t_on, t_DRX) of the search, or the emulator's pair if a pilot run is too close to call.
pub(super) fn search(scenario: &Scenario, positions: &[Point]) -> (u64, u64) {
    own_search(scenario, positions).unwrap_or_else(|| {
        let found = prepare(scenario).pilot_choice.expect("the search finds a pair");
        let choice: &DutyCycleChoice = found.downcast_ref().expect("a pair");
        (u64::from(choice.t_on), u64::from(choice.t_drx))
    })
}

/// Runs the search on the reference only; `None` if too close to call.
pub fn own_search(scenario: &Scenario, positions: &[Point]) -> Option<(u64, u64)> {
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
    let ground = ReferenceDeployment {
        positions: positions.to_vec(),
        classes: assign_classes(scenario),
        plays_traces: false,
    };
    let mut ttis = settings.pilot_ttis;
    let limit = settings.pilot_limit.max(ttis);
    loop {
        let mut pilot = scenario.with_seed(scenario.run.seed.wrapping_add(OTHER_SEED));
        pilot.run.ttis = ttis;
        // Same warm-up share as in the emulator's pilot runs.
        pilot.run.warm_up = 0.25;
        let mut tried = Vec::new();
        for &pair in &pairs {
            // The offsets come from the run itself, not from the pilot.
            let run = play(&pilot, &ground, ReferencePolicy::adjusted(scenario, positions, pair));
            if run.ambiguous.is_some() {
                return None;
            }
            let events = run.totals.events;
            tried.push(SearchTrial {
                pair,
                information: (events > 0).then(|| run.totals.information_pico as f64 * 1e-12 / events as f64),
                spent: run.measured.spent.total().micro(),
                events,
            });
        }
        if ttis == limit || tried.iter().all(|one| one.events >= settings.pilot_events) {
            return best(&tried, least_information(positions, scenario.area, &scenario.sensing));
        }
        ttis = (2 * ttis).min(limit);
    }
}

/// Returns the cheapest pair that reaches `enough`, or else the pair with the most information, or else the cheapest.
fn best(tried: &[SearchTrial], enough: f64) -> Option<(u64, u64)> {
    let cheapest = |of: &dyn Fn(&SearchTrial) -> bool| {
        let mut best: Option<&SearchTrial> = None;
        for one in tried.iter().filter(|one| of(one)) {
            if best.is_none_or(|best| one.spent < best.spent) {
                best = Some(one);
            }
        }
        best.map(|one| one.pair)
    };
    let known: Vec<f64> = tried.iter().filter_map(|one| one.information).collect();
    if known.iter().any(|information| (information - enough).abs() < CLOSE) {
        return None;
    }
    let reaches = |one: &SearchTrial| one.information.is_some_and(|information| information >= enough);
    if let Some(pair) = cheapest(&reaches) {
        return Some(pair);
    }
    let most = known.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut of_most = tried
        .iter()
        .filter(|one| one.information.is_some_and(|i| i > most - CLOSE));
    match (of_most.next(), of_most.next()) {
        (None, _) => cheapest(&|_| true),
        (Some(one), None) => Some(one.pair),
        // Several pairs share the first place, exactly or nearly. Only an exact tie survives another order of
        // summation.
        (Some(first), Some(_)) => {
            let same = tried.iter().filter_map(|one| one.information);
            let is_clear = same
                .filter(|i| *i > most - CLOSE)
                .all(|i| i.to_bits() == most.to_bits());
            is_clear.then_some(first.pair)
        }
    }
}
