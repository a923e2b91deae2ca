//! The exhaustive search of the `adjusted` policy (Sec. V-A, P2): the (t_on, t_DRX) of least mean consumption among those
//! that reach I_min in the deployment, or, if none does, the one of most information.
//!
//! Each pair of the grid is judged by a pilot run of the same machines on the same deployment, with events and harvests of
//! a seed of its own: what a BS knows from the positions and from historical data, not what is about to happen. All pairs
//! see the same pilot events and harvests.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use reveille_bs::wakeup::i_min;
use reveille_common::deployment::Deployment;
use reveille_common::metrics::Metrics;
use reveille_common::scenario::{AdjustedSettings, DutyChoice, PolicyConfig, Scenario};

use crate::run::{Options, Run};

/// Added to the seed for the pilot runs.
const PILOT: u64 = 0x5EED_0F91_1070_0500;
/// The share of a pilot run that is left out of its metrics.
const WARM_UP: f64 = 0.25;
/// Searches that are remembered.
const REMEMBERED: usize = 1024;

/// What was found before, by the hash of the pilot scenario: runs that differ in nothing but their length share a search.
static FOUND: Mutex<VecDeque<([u8; 32], DutyChoice)>> = Mutex::new(VecDeque::new());

/// One pair of the grid and how its pilot run went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// t_on, TTIs.
    pub t_on: u32,
    /// t_DRX, TTIs.
    pub t_drx: u32,
    /// Information per event, `[0, Ψ]`; NaN if there was no event.
    pub information: f64,
    /// Units spent per device and TTI.
    pub energy: f64,
}

/// `scenario` ready to run: where its policy is `adjusted`, with a duty cycle found for its deployment.
pub fn resolve(scenario: &Scenario) -> Cow<'_, Scenario> {
    let PolicyConfig::Adjusted(settings) = &scenario.policy else {
        return Cow::Borrowed(scenario);
    };
    if settings.found.is_some() {
        return Cow::Borrowed(scenario);
    }
    let pilot = pilot(scenario, settings);
    let key = pilot.hash();
    let choice = recall(&key).unwrap_or_else(|| {
        let choice = search(scenario, settings);
        remember(key, choice);
        choice
    });
    Cow::Owned(with_choice(scenario, settings, choice))
}

fn recall(key: &[u8; 32]) -> Option<DutyChoice> {
    let found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    found.iter().find(|(known, _)| known == key).map(|(_, choice)| *choice)
}

/// Two threads that searched for the same deployment have found the same.
fn remember(key: [u8; 32], choice: DutyChoice) {
    let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    if found.len() == REMEMBERED {
        found.pop_front();
    }
    found.push_back((key, choice));
}

/// All pairs of the grid with their pilot runs, in the order of the grid.
pub fn candidates(scenario: &Scenario, settings: &AdjustedSettings) -> Vec<Candidate> {
    let deployment = Deployment::new(scenario);
    let pilot = pilot(scenario, settings);
    settings
        .pairs()
        .map(|(t_on, t_drx)| {
            let choice = DutyChoice {
                t_on,
                t_drx,
                reaches_i_min: false,
                pairs: 1,
                device_ttis: 0,
            };
            let run = Run::on(&with_choice(&pilot, settings, choice), &deployment, Options::default());
            let Metrics {
                info_per_event,
                energy_per_device_tti,
                ..
            } = run.finish(&mut ()).metrics;
            Candidate {
                t_on,
                t_drx,
                information: info_per_event,
                energy: energy_per_device_tti,
            }
        })
        .collect()
}

/// The first of the best of `candidates` for the threshold `i_min`, and whether it reaches it.
pub fn choose(candidates: &[Candidate], i_min: f64) -> Option<(Candidate, bool)> {
    let reaching = candidates.iter().filter(|c| c.information >= i_min);
    let least = reaching.min_by(|a, b| a.energy.total_cmp(&b.energy));
    let information = |c: &Candidate| if c.information.is_nan() { -1.0 } else { c.information };
    // Of equals `max_by` takes the last, hence the reversal.
    let most = || {
        let rising = candidates.iter().rev();
        rising.max_by(|a, b| information(a).total_cmp(&information(b)))
    };
    least.map(|c| (*c, true)).or_else(|| most().map(|c| (*c, false)))
}

fn search(scenario: &Scenario, settings: &AdjustedSettings) -> DutyChoice {
    let positions = Deployment::new(scenario).positions();
    let candidates = candidates(scenario, settings);
    let threshold = i_min(&positions, scenario.area, &scenario.sensing);
    let (best, reaches_i_min) = choose(&candidates, threshold).expect("the grid holds a pair");
    let pairs = candidates.len() as u32;
    DutyChoice {
        t_on: best.t_on,
        t_drx: best.t_drx,
        reaches_i_min,
        pairs,
        device_ttis: u64::from(pairs) * u64::from(scenario.devices) * settings.pilot_ttis,
    }
}

/// The scenario of the pilot runs, whose seed is not that of its deployment.
fn pilot(scenario: &Scenario, settings: &AdjustedSettings) -> Scenario {
    Scenario {
        ttis: settings.pilot_ttis,
        seed: scenario.seed.wrapping_add(PILOT),
        warm_up: WARM_UP,
        ..scenario.clone()
    }
}

fn with_choice(scenario: &Scenario, settings: &AdjustedSettings, choice: DutyChoice) -> Scenario {
    let settings = AdjustedSettings {
        found: Some(choice),
        ..settings.clone()
    };
    Scenario {
        policy: PolicyConfig::Adjusted(settings),
        ..scenario.clone()
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::scenario::{Override, load};

    use super::*;

    fn scenario(overrides: &[&str]) -> Scenario {
        let overrides: Vec<Override> = overrides
            .iter()
            .map(|o| Override::parse(o).expect("an override"))
            .collect();
        load("paper", &overrides).expect("a scenario")
    }

    fn settings(scenario: &Scenario) -> &AdjustedSettings {
        let PolicyConfig::Adjusted(settings) = &scenario.policy else {
            panic!("{:?}", scenario.policy)
        };
        settings
    }

    #[test]
    fn the_choice_is_what_the_contract_says() {
        let candidate = |t_on, information, energy| Candidate {
            t_on,
            t_drx: 9,
            information,
            energy,
        };
        let all = [
            candidate(1, 0.2, 0.5),
            candidate(2, 0.4, 0.3),
            candidate(3, 0.6, 0.4),
            candidate(4, 0.6, 0.4),
            candidate(5, f64::NAN, 0.1),
        ];
        let chosen = |i_min| choose(&all, i_min).map(|(c, reaches)| (c.t_on, reaches));
        assert_eq!(chosen(0.3), Some((2, true)));
        assert_eq!(chosen(0.1), Some((2, true)));
        assert_eq!(chosen(0.5), Some((3, true)));
        assert_eq!(chosen(0.7), Some((3, false)));
        assert_eq!(choose(&[], 0.1), None);
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
        let all = candidates(&scenario, settings(&scenario));
        let pairs: Vec<(u32, u32)> = all.iter().map(|c| (c.t_on, c.t_drx)).collect();
        assert_eq!(pairs, [(1, 2), (1, 8), (3, 8)]);
        let resolved = resolve(&scenario);
        let choice = settings(&resolved).found.expect("found");
        let positions = Deployment::new(&scenario).positions();
        let threshold = i_min(&positions, scenario.area, &scenario.sensing);
        let reaching = all.iter().filter(|c| c.information >= threshold);
        let least = reaching.map(|c| c.energy).fold(f64::INFINITY, f64::min);
        let own = all.iter().find(|c| (c.t_on, c.t_drx) == (choice.t_on, choice.t_drx));
        assert!((own.expect("of the grid").energy - least).abs() < 1e-15);
        assert_eq!((choice.pairs, choice.device_ttis), (3, 3 * 60 * 800));
        assert_eq!(
            resolved.hash(),
            scenario.hash(),
            "what was found is no part of the scenario"
        );
    }

    #[test]
    fn the_pilot_stands_on_the_same_ground_and_sees_other_events() {
        let scenario = scenario(&["policy.name=adjusted", "devices=40"]);
        let pilot = pilot(&scenario, settings(&scenario));
        assert_ne!(pilot.seed, scenario.seed);
        let (a, b) = (Deployment::new(&scenario), Deployment::new(&pilot));
        assert_ne!(
            a.positions(),
            b.positions(),
            "which is why the run is given its deployment"
        );
    }
}
