//! What a run needs before its first TTI: its devices on the ground, and the pilot runs that its policy asks for.
//!
//! The `adjusted` policy (Sec. V-A, P2) has each duty cycle of its grid judged by a pilot run of the same machines on
//! the same deployment, with events and harvests of a seed of its own: what a BS knows from the positions and from
//! historical data, not what is about to happen. A recorded trace has no other draw than the one that the run itself
//! will harvest, so in a pilot run its mean comes in each TTI. All pairs see the same pilot events and harvests.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use reveille_bs::grids::Grids;
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::contract::Opaque;
use reveille_bs::policy::pilots::{Pilots, Trials};
use reveille_bs::policy::registry;
use reveille_bs::prepared::Prepared;
use reveille_common::deployment::Deployment;
use reveille_common::scenario::Scenario;

use crate::run::{Options, Run};

/// Added to the seed for the pilot runs.
const PILOT: u64 = 0x5EED_0F91_1070_0500;
/// The share of a pilot run that is left out of its metrics.
const WARM_UP: f64 = 0.25;
/// Searches that are remembered.
const REMEMBERED: usize = 1024;

/// What a search came to: its findings and its warnings.
type Found = (Opaque, Vec<String>);

/// Prepares runs, and remembers what several of them need. Sharing one changes no result.
#[derive(Debug, Default)]
pub struct Workshop {
    grids: Arc<Grids>,
    /// What was found, by the hash of the pilot scenario: runs that differ in nothing but their length share a search.
    found: Mutex<VecDeque<([u8; 32], Found)>>,
}

impl Workshop {
    /// `scenario` on its ground, with the pilot runs made that its policy asks for.
    pub fn prepare(&self, scenario: &Scenario) -> Prepared {
        let mut prepared = Prepared {
            grids: Arc::clone(&self.grids),
            ..Prepared::without_pilots(scenario)
        };
        if let Some(pilots) = registry::pilots(prepared.policies, &scenario.policy) {
            let (findings, warnings) = self.search(&prepared, &*pilots);
            (prepared.findings, prepared.warnings) = (Some(findings), warnings);
        }
        prepared
    }

    fn search(&self, prepared: &Prepared, pilots: &dyn Pilots) -> Found {
        let key = pilot(&prepared.scenario, pilots.ttis()).hash();
        if let Some(known) = self.recall(&key) {
            return known;
        }
        let trials = pilot_runs(prepared, pilots);
        let found = (pilots.judge(&prepared.knowledge(), &trials), pilots.warnings(&trials));
        self.remember(key, found.clone());
        found
    }

    fn recall(&self, key: &[u8; 32]) -> Option<Found> {
        let found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        found
            .iter()
            .find(|(known, _)| known == key)
            .map(|(_, found)| found.clone())
    }

    /// Two threads that searched for the same deployment have found the same.
    fn remember(&self, key: [u8; 32], what: Found) {
        let mut found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        if found.len() == REMEMBERED {
            found.pop_front();
        }
        found.push_back((key, what));
    }
}

/// `scenario` prepared by itself.
pub fn prepare(scenario: &Scenario) -> Prepared {
    Workshop::default().prepare(scenario)
}

/// A run of `scenario` before TTI 0, prepared by itself.
pub fn start(scenario: &Scenario, options: Options) -> Run {
    Run::new(&prepare(scenario), options)
}

/// Runs `scenario`, prepared by itself, from its first TTI to its last.
pub fn run(scenario: &Scenario) -> Outcome {
    start(scenario, Options::default()).finish(&mut ())
}

/// What each candidate of `pilots` came to in a pilot run on the ground of `prepared`. All runs are equally long, and
/// as long as it takes for each to hold the events that are asked for, if that is not too long.
fn pilot_runs(prepared: &Prepared, pilots: &dyn Pilots) -> Trials {
    let candidates = pilots.candidates();
    let mut ground = prepared.clone();
    let Deployment { devices, traces, .. } = &mut ground.deployment;
    for device in devices {
        device.harvest = device.harvest.as_known(traces);
    }
    let (mut ttis, mut all_ttis) = (pilots.ttis(), 0_u64);
    let limit = pilots.limit().min(prepared.scenario.longest()).max(ttis);
    loop {
        ground.scenario = pilot(&prepared.scenario, ttis);
        let (mut metrics, mut is_long_enough) = (Vec::with_capacity(candidates.len()), true);
        for candidate in &candidates {
            ground.findings = Some(candidate.clone());
            let outcome = Run::new(&ground, Options::default()).finish(&mut ());
            all_ttis = all_ttis.saturating_add(ttis);
            is_long_enough = ttis >= limit || outcome.metrics.events >= pilots.events();
            if !is_long_enough {
                break;
            }
            metrics.push(outcome.metrics);
        }
        if is_long_enough {
            return Trials {
                ttis,
                all_ttis,
                metrics,
            };
        }
        ttis = ttis.saturating_mul(2).min(limit);
    }
}

/// The scenario of pilot runs of `ttis` TTIs, whose seed is not that of its deployment.
fn pilot(scenario: &Scenario, ttis: u64) -> Scenario {
    Scenario {
        ttis,
        seed: scenario.seed.wrapping_add(PILOT),
        warm_up: WARM_UP,
        ..scenario.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use reveille_bs::beliefs::ranking::i_min;
    use reveille_bs::policy::adjusted::search::{DutyChoice, Search};
    use reveille_bs::policy::adjusted::settings::AdjustedSettings;
    use reveille_bs::scenario::{Override, load};

    fn scenario(overrides: &[&str]) -> Scenario {
        let overrides: Vec<Override> = overrides
            .iter()
            .map(|o| Override::parse(o).expect("an override"))
            .collect();
        load("paper", &overrides).expect("a scenario")
    }

    fn search(scenario: &Scenario) -> Search {
        Search(
            scenario
                .policy
                .settings::<AdjustedSettings>()
                .expect("adjusted")
                .clone(),
        )
    }

    #[test]
    fn the_search_covers_the_grid_and_takes_the_best() {
        let scenario = scenario(&[
            "policy.name=adjusted",
            "devices=60",
            "policy.adjusted.t_on=[1,3,9]",
            "policy.adjusted.t_drx=[2,8]",
            "policy.adjusted.pilot_ttis=800",
        ]);
        let prepared = prepare(&scenario);
        let search = search(&scenario);
        let all = search.judged(&pilot_runs(&prepared, &search));
        let pairs: Vec<(u32, u32)> = all.iter().map(|c| (c.t_on, c.t_drx)).collect();
        assert_eq!(pairs, [(1, 2), (1, 8), (3, 8)]);
        let choice = prepared
            .findings
            .as_ref()
            .and_then(Opaque::get::<DutyChoice>)
            .expect("found");
        let positions = prepared.deployment.positions();
        let threshold = i_min(&positions, scenario.area, &scenario.sensing);
        let reaching = all.iter().filter(|c| c.information >= threshold);
        let least = reaching.map(|c| c.energy).fold(f64::INFINITY, f64::min);
        let own = all.iter().find(|c| (c.t_on, c.t_drx) == (choice.t_on, choice.t_drx));
        assert!((own.expect("of the grid").energy - least).abs() < 1e-15);
        assert_eq!((choice.pairs, choice.device_ttis), (3, 3 * 60 * 800));
    }

    #[test]
    fn the_pilot_stands_on_the_same_ground_and_sees_other_events() {
        let scenario = scenario(&["policy.name=adjusted", "devices=40"]);
        let pilot = pilot(&scenario, 2000);
        assert_ne!(pilot.seed, scenario.seed);
        let (a, b) = (Deployment::new(&scenario), Deployment::new(&pilot));
        assert_ne!(
            a.positions(),
            b.positions(),
            "which is why the run is given its deployment"
        );
    }
}
