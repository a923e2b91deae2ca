//! Runs of one scenario under many seeds.

use rayon::prelude::*;
use reveille_common::scenario::Scenario;

use super::AnalysisError;

/// The largest number of seeds of a study.
const MOST_SEEDS: u64 = 1_000_000;

/// Checks a number of seeds.
///
/// # Errors
/// If it is none or too many.
pub fn check_seeds(seeds: u64) -> Result<(), AnalysisError> {
    if (1..=MOST_SEEDS).contains(&seeds) {
        return Ok(());
    }
    let allowed = format!("must be a number of runs from 1 to {MOST_SEEDS}, each with a seed of its own");
    Err(AnalysisError::invalid("seeds", &seeds, allowed))
}

/// What `measure` makes of `scenario` under each of `seeds` seeds from its own on, in the order of seeds, on all cores.
pub fn over_seeds<T: Send>(scenario: &Scenario, seeds: u64, measure: impl Fn(&Scenario) -> T + Sync) -> Vec<T> {
    let indices = (0..seeds).into_par_iter();
    indices
        .map(|i| {
            measure(&Scenario {
                seed: scenario.seed.wrapping_add(i),
                ..scenario.clone()
            })
        })
        .collect()
}
