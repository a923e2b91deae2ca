//! Preparation of a run before its first TTI: the deployed devices, and the pilot runs that its policy requests. Runs
//! in memory and over the bus use it; `PreparedRun::without_pilots` is enough for policies that request none.
//!
//! The `adjusted` policy (Sec. V-A, P2) evaluates each duty cycle of its grid in a pilot run of the same machines on
//! the same deployment. All duty cycles see the same events and harvests, drawn with another seed than the run's. A
//! pilot run does not see the future of the run: it harvests the mean of a recorded trace in each TTI. Seed offset and
//! warm-up of pilot runs are part of all results of `adjusted`; `tests/src/reference/search.rs` repeats them, and the
//! help of `pilot_ttis` (`bs/src/policy/adjusted/settings.rs`) states the warm-up.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use reveille_bs::bounds_cache::BoundsCache;
use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::policy::factory::{PilotRuns, PilotSearch, SearchOutcome};
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;

use crate::run::{Run, RunOptions};

/// The difference between the seeds of a run and of its pilot runs.
const PILOT_SEED_OFFSET: u64 = 0x5EED_0F91_1070_0500;
/// The share of a pilot run that its metrics leave out.
const PILOT_WARM_UP: f64 = 0.25;
/// The largest number of search results that a preparer keeps; the oldest is dropped first.
const MAX_CACHED_PILOT_SEARCHES: usize = 1024;

/// Prepares runs and caches their shared data. Sharing a preparer does not change results.
#[derive(Debug, Default)]
pub struct RunPreparer {
    bounds_cache: Arc<BoundsCache>,
    /// The search results by the hash of the pilot scenario: runs that differ only in length or warm-up
    /// share a search. The result must depend on nothing else.
    cached_searches: Mutex<VecDeque<([u8; 32], SearchOutcome)>>,
}

impl RunPreparer {
    /// Deploys `scenario` and makes the pilot runs that its policy requests.
    pub fn prepare(&self, scenario: &Scenario) -> PreparedRun {
        let mut prepared = PreparedRun {
            correlation_bounds: Arc::clone(&self.bounds_cache),
            ..PreparedRun::without_pilots(scenario)
        };
        if let Some(pilots) = scenario.policy.settings().pilot_search() {
            let (choice, warnings) = self.search(&prepared, &pilots);
            (prepared.pilot_choice, prepared.warnings) = (Some(choice), warnings);
        }
        prepared
    }

    fn search(&self, prepared: &PreparedRun, pilots: &PilotSearch) -> SearchOutcome {
        let key = pilot_scenario(&prepared.scenario, pilots.initial_ttis).hash();
        if let Some(outcome) = self.cached_search(&key) {
            return outcome;
        }
        // No lock is held during the pilot runs. Two threads may search for the same deployment, with the same result.
        let runs = pilot_runs(prepared, pilots);
        let outcome = (pilots.judge)(&prepared.knowledge(), &runs);
        self.cache_search(key, outcome.clone());
        outcome
    }

    fn cached_search(&self, key: &[u8; 32]) -> Option<SearchOutcome> {
        let searches = self.cached_searches.lock().unwrap_or_else(PoisonError::into_inner);
        searches
            .iter()
            .find(|(cached_key, _)| cached_key == key)
            .map(|(_, outcome)| outcome.clone())
    }

    /// Caches a search result. Two threads that searched for the same deployment have equal results.
    fn cache_search(&self, key: [u8; 32], outcome: SearchOutcome) {
        let mut searches = self.cached_searches.lock().unwrap_or_else(PoisonError::into_inner);
        if searches.len() == MAX_CACHED_PILOT_SEARCHES {
            searches.pop_front();
        }
        searches.push_back((key, outcome));
    }
}

/// Prepares `scenario` without a shared cache.
pub fn prepare(scenario: &Scenario) -> PreparedRun {
    RunPreparer::default().prepare(scenario)
}

/// Creates a run of `scenario` before TTI 0, without a shared cache.
pub fn start(scenario: &Scenario, options: RunOptions) -> Run {
    Run::new(&prepare(scenario), options)
}

/// Runs `scenario` from its first TTI to its last, without a shared cache.
pub fn run(scenario: &Scenario) -> RunOutcome {
    start(scenario, RunOptions::default()).finish(&mut ())
}

/// Runs each candidate of `pilots` on the deployment of `prepared`. All pilot runs have the same length. It is long
/// enough for each to hold the requested events, up to a limit. `judge` relies on the order of the candidates.
fn pilot_runs(prepared: &PreparedRun, pilots: &PilotSearch) -> PilotRuns {
    let mut pilot_prepared = prepared.clone();
    let Deployment { devices, traces, .. } = &mut pilot_prepared.deployment;
    for device in devices {
        // A trace has only one realisation: replayed in a pilot run, it would show the future of the run itself.
        device.harvest = device.harvest.known_before_run(traces);
    }
    let (mut run_ttis, mut total_ttis) = (pilots.initial_ttis, 0_u64);
    // Beyond `Scenario::max_ttis`, sums of energy would overflow 64 bits.
    let max_ttis = pilots.max_ttis.min(prepared.scenario.max_ttis()).max(run_ttis);
    loop {
        pilot_prepared.scenario = pilot_scenario(&prepared.scenario, run_ttis);
        let (mut metrics, mut is_long_enough) = (Vec::with_capacity(pilots.candidates.len()), true);
        for candidate in &pilots.candidates {
            pilot_prepared.pilot_choice = Some(Arc::clone(candidate));
            let outcome = Run::new(&pilot_prepared, RunOptions::default()).finish(&mut ());
            total_ttis = total_ttis.saturating_add(run_ttis);
            is_long_enough = run_ttis >= max_ttis || outcome.metrics.events >= pilots.min_events;
            // Metrics of runs of different length do not compare, so all candidates run again, twice as long.
            if !is_long_enough {
                break;
            }
            metrics.push(outcome.metrics);
        }
        if is_long_enough {
            return PilotRuns {
                run_ttis,
                total_ttis,
                metrics,
            };
        }
        run_ttis = run_ttis.saturating_mul(2).min(max_ttis);
    }
}

/// Returns the scenario of pilot runs of `ttis` TTIs, whose seed differs from the deployment's seed.
fn pilot_scenario(scenario: &Scenario, ttis: u64) -> Scenario {
    let mut pilot = scenario.with_seed(scenario.run.seed.wrapping_add(PILOT_SEED_OFFSET));
    pilot.run.ttis = ttis;
    pilot.run.warm_up = PILOT_WARM_UP;
    pilot
}

#[cfg(test)]
mod tests {
    use reveille_bs::beliefs::ranking::i_min;
    use reveille_bs::policy::adjusted::search::{DutyCycleChoice, collect_pilot_results};
    use reveille_bs::policy::adjusted::settings::AdjustedSettings;
    use reveille_bs::policy::factory::PolicyFactory;
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn scenario_with(overrides: &[&str]) -> Scenario {
        let overrides: Vec<Override> = overrides
            .iter()
            .map(|text| Override::parse(text).expect("an override"))
            .collect();
        load("paper", &overrides).expect("a scenario").scenario
    }

    #[test]
    fn the_pilot_search_covers_the_grid_and_takes_the_best() {
        let scenario = scenario_with(&[
            "policy.name=adjusted",
            "devices=60",
            "policy.adjusted.t_on=[1,3,9]",
            "policy.adjusted.t_drx=[2,8]",
            "policy.adjusted.pilot_ttis=800",
        ]);
        let prepared = prepare(&scenario);
        let settings = scenario
            .policy
            .settings()
            .downcast_ref::<AdjustedSettings>()
            .expect("adjusted");
        let pilots = settings.pilot_search().expect("a search");
        let results = collect_pilot_results(settings, &pilot_runs(&prepared, &pilots));
        let pairs: Vec<(u32, u32)> = results.iter().map(|result| (result.t_on, result.t_drx)).collect();
        // Only pairs with t_on ≤ t_drx.
        assert_eq!(pairs, [(1, 2), (1, 8), (3, 8)]);
        let chosen = prepared.pilot_choice.as_ref().expect("a choice");
        let choice: &DutyCycleChoice = chosen.downcast_ref().expect("a duty cycle");
        let positions = prepared.deployment.positions();
        let threshold = i_min(&positions, scenario.area, &scenario.sensing);
        let reaching_threshold = results
            .iter()
            .filter(|result| result.information_per_event >= threshold);
        let least_energy = reaching_threshold
            .map(|result| result.energy_per_device_tti)
            .fold(f64::INFINITY, f64::min);
        let chosen_result = results
            .iter()
            .find(|result| (result.t_on, result.t_drx) == (choice.t_on, choice.t_drx));
        let chosen_energy = chosen_result.expect("a pair of the grid").energy_per_device_tti;
        assert!((chosen_energy - least_energy).abs() < 1e-15);
        assert_eq!((choice.searched_pairs, choice.device_ttis), (3, 3 * 60 * 800));
    }

    #[test]
    fn a_pilot_has_another_seed_and_so_needs_the_deployment_of_the_run() {
        let scenario = scenario_with(&["policy.name=adjusted", "devices=40"]);
        let pilot = pilot_scenario(&scenario, 2000);
        assert_ne!(pilot.run.seed, scenario.run.seed);
        assert_ne!(
            Deployment::new(&pilot).positions(),
            Deployment::new(&scenario).positions()
        );
    }
}
