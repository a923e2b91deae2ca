//! Pilot runs: what a policy may have tried out on its deployment before a run.

use reveille_common::score::Metrics;

use super::contract::Opaque;
use crate::knowledge::Knowledge;

/// A search among ways to set a policy up, each judged by a pilot run: a run on the same deployment with events and
/// harvests of its own.
pub trait Pilots {
    /// Length of a pilot run, TTIs, ≥ 1, if it holds enough events.
    fn ttis(&self) -> u64;

    /// Counted events that each pilot run has to hold. Where one does not, all are made anew and twice as long.
    fn events(&self) -> u64;

    /// The longest that pilot runs are made for the sake of events, TTIs.
    fn limit(&self) -> u64;

    /// What the policy is built with in each pilot run, at least one, in the order of the search.
    fn candidates(&self) -> Vec<Opaque>;

    /// What the policy is to be built with, for a base station that knows `known`.
    fn judge(&self, known: &Knowledge, trials: &Trials) -> Opaque;

    /// What a user should know of `trials`, a sentence each without its stop.
    fn warnings(&self, _trials: &Trials) -> Vec<String> {
        Vec::new()
    }
}

/// The pilot runs of a search.
#[derive(Clone, Debug, PartialEq)]
pub struct Trials {
    /// Length of each, TTIs.
    pub ttis: u64,
    /// TTIs of all pilot runs together, those that were too short included.
    pub all_ttis: u64,
    /// Their metrics, in the order of the candidates.
    pub metrics: Vec<Metrics>,
}

impl Trials {
    /// Events that the pilot run with the fewest holds.
    pub fn fewest_events(&self) -> u64 {
        self.metrics.iter().map(|metrics| metrics.events).min().unwrap_or(0)
    }
}
