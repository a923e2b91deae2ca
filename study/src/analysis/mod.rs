//! Analysis of the paper's models: closed forms and chains, compared with runs in memory. `reveille analyse` prints it,
//! and docs/analysis.md quotes it. [`crate::figures`], [`crate::report`] and [`crate::misses`] use [`harvest`] too.
//!
//! - [`battery`]: the battery's Markov chain and Eq. (8) (Sec. III-B).
//! - [`transitions`]: the transition probabilities P_m,n (Sec. IV).
//! - [`imin`]: the mean of I_min (Sec. V-A).
//! - [`runtime`]: the run time against N (Sec. V-D).
//! - [`harvest`]: harvest and net energy against λ (Sec. VI-B), and the paper's statements on λ.
//!
//! Measurements come from runs ([`reveille_lab::run`]), from the device machine itself or, in [`imin`], from
//! deployments; this module adds no second model. Closed forms are evaluated as printed in the paper. Values that are
//! not probabilities are reported, not corrected.

pub mod battery;
pub mod harvest;
pub mod imin;
pub mod runtime;
pub mod transitions;

use rayon::prelude::*;
use reveille_bs::scenario::Scenario;

/// Reason why a study is impossible.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    /// A list of values to study is empty.
    #[error("{list}: the list is empty, so there is nothing to study; give at least one value, for example {example}")]
    EmptyList {
        /// Name of the list, an option of `reveille analyse` without its dashes.
        list: &'static str,
        /// Example of a valid list.
        example: &'static str,
    },
    /// A value is out of its range.
    #[error("{quantity} = {value}: {requirement}")]
    InvalidValue {
        /// Name of the quantity, such as an option of `reveille analyse` without its dashes.
        quantity: &'static str,
        /// Invalid value.
        value: String,
        /// The requirement on the value, such as `must be …`: the rest of the sentence, without a full stop.
        requirement: String,
    },
}

impl AnalysisError {
    /// Creates the error for an invalid `value` of `quantity`.
    pub(crate) fn invalid(quantity: &'static str, value: &impl ToString, requirement: impl Into<String>) -> Self {
        Self::InvalidValue {
            quantity,
            value: value.to_string(),
            requirement: requirement.into(),
        }
    }
}

/// Maximum number of seeds in a study. Functions that call [`check_seeds`] repeat it under `Errors`.
const MAX_SEEDS: u64 = 1_000_000;

/// Checks a number of seeds.
///
/// # Errors
/// If it is 0 or above the limit.
pub(crate) fn check_seeds(seeds: u64) -> Result<(), AnalysisError> {
    if (1..=MAX_SEEDS).contains(&seeds) {
        return Ok(());
    }
    let requirement = format!("must be from 1 to {MAX_SEEDS}: one run per seed");
    Err(AnalysisError::invalid("seeds", &seeds, requirement))
}

/// Applies `measure` to `scenario` under `seeds` consecutive seeds from its own, on all cores. Returns the results in
/// order of seeds.
pub(crate) fn map_seeds<T: Send>(scenario: &Scenario, seeds: u64, measure: impl Fn(&Scenario) -> T + Sync) -> Vec<T> {
    let indices = (0..seeds).into_par_iter();
    indices
        .map(|i| measure(&scenario.with_seed(scenario.run.seed.wrapping_add(i))))
        .collect()
}
