//! A second, deliberately plain implementation of the model: every device steps through every TTI. It shares with the
//! emulator only data types, the scenario, positions, classes, and random streams with their distributions. It draws
//! from the streams in the same order. A change of results in the emulator needs the same change here. `tests/tests/`
//! compares both.
//!
//! [`simulate`] runs whole scenarios under `knn`, `random`, `genie` and `adjusted` with `bs.ranking = p42`. It has
//! operator actions, but no external decisions and no lost processes. Of `age-index` and `q-learning` only the choice
//! of sensing devices is implemented ([`ReferenceAgeIndex`], [`ReferenceDutySelector`], [`choose_by_ages`]).
//!
//! If rounding or its own integration rule for `P_4,2` could change a decision, it stops and reports the TTI
//! ([`ReferenceRun::ambiguous`]).

mod active_event;
mod age_index;
mod clusters;
mod deployment;
mod detection;
mod device;
mod estimate;
mod events;
mod harvest;
mod i_min;
mod policy;
mod q_learning;
mod radio;
mod run;
mod search;
mod world;

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::message::OperatorAction;

pub use age_index::ReferenceAgeIndex;
pub use clusters::clusters;
use deployment::ReferenceDeployment;
pub use device::ReferenceState;
pub use i_min::least_information;
pub use policy::ReferencePolicy;
pub use q_learning::{ReferenceDutySelector, choose_by_ages};
pub use run::ReferenceRun;
pub use search::reference_search;
use world::play;

/// Runs `scenario` on the reference implementation.
///
/// # Panics
/// If its policy is not `knn`, `random`, `genie` or `adjusted`.
pub fn simulate(scenario: &Scenario) -> ReferenceRun {
    simulate_with_actions(scenario, &[])
}

/// Runs `scenario` on the reference implementation, with the `actions` of operators in the order of TTIs.
///
/// # Panics
/// As [`simulate`].
pub fn simulate_with_actions(scenario: &Scenario, actions: &[OperatorAction]) -> ReferenceRun {
    let deployment = ReferenceDeployment::of(scenario);
    let policy = build_policy(scenario, &deployment.positions);
    play(scenario, &deployment, policy, actions)
}

/// Creates the policy of `scenario` for devices at `positions`, including the search that `adjusted` needs. If that
/// search is too close to call, takes over the emulator's pair.
///
/// # Panics
/// As [`simulate`].
pub fn build_policy(scenario: &Scenario, positions: &[Point]) -> ReferencePolicy {
    match scenario.policy.name() {
        "adjusted" => ReferencePolicy::adjusted(
            scenario,
            positions,
            search::search_or_emulated_if_close(scenario, positions),
        ),
        _ => ReferencePolicy::new(scenario, positions),
    }
}
