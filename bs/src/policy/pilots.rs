//! Pilot runs: what a policy may have tried out on its deployment before a run.

use reveille_common::score::Metrics;

use super::contract::Opaque;
use crate::knowledge::Knowledge;

/// A search among ways to set a policy up, each judged by a pilot run: a run on the same deployment with events and
/// harvests of its own.
pub trait Pilots {
    /// Length of a pilot run, TTIs.
    fn ttis(&self) -> u64;

    /// What the policy is built with in each pilot run, at least one, in the order of the search.
    fn candidates(&self) -> Vec<Opaque>;

    /// What the policy is to be built with, for a base station that knows `known`. `pilots` are the metrics of the
    /// pilot runs, in the order of the candidates.
    fn judge(&self, known: &Knowledge, pilots: &[Metrics]) -> Opaque;
}
