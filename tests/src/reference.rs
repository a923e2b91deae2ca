//! A second implementation of the model, as plain as it can be: every device goes through every TTI, one step after
//! the other. It shares the scenario, the positions, the classes and the random streams with the emulator, and nothing
//! else.
//!
//! Where its own integration rule for `P_4,2` cannot tell two candidates apart, it stops and says in which TTI
//! ([`Run::ambiguous`]).

mod age_index;
mod clusters;
mod device;
mod estimate;
mod events;
mod harvest;
mod least;
mod plane;
mod policy;
mod q_learning;
mod radio;
mod search;
mod world;

use reveille_common::geometry::Point;
use reveille_common::scenario::Scenario;

pub use age_index::AgeIndex;
pub use clusters::clusters;
pub use device::State;
pub use least::least_information;
pub use policy::Policy;
pub use q_learning::{Sequential, choose_by_ages};
pub use search::own_search;
pub use world::Run;
use world::{Ground, play};

/// The reference's run of `scenario`.
pub fn simulate(scenario: &Scenario) -> Run {
    let ground = Ground::of(scenario);
    let policy = policy_of(scenario, &ground.positions);
    play(scenario, &ground, policy)
}

/// The policy of `scenario` for devices at `positions`, with the search made that `adjusted` needs.
pub fn policy_of(scenario: &Scenario, positions: &[Point]) -> Policy {
    match scenario.policy.name() {
        "adjusted" => Policy::adjusted(scenario, positions, search::search(scenario, positions)),
        _ => Policy::new(scenario, positions),
    }
}
