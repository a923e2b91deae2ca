//! Policies: which devices sense, and which to wake.
//!
//! A policy returns a δ plan and the TTI of its next decision; after a report it names the sleeping devices to wake,
//! one by one ([`interface`]). Each policy is a folder or a file with its settings, its algorithm and its entry
//! ([`factory`]). To add a policy, follow docs/writing-a-policy.md: a module here, an entry in [`registry::POLICIES`],
//! generated files. The policy [`external`] sends decision requests to another program; [`outside`] registers it for
//! the programs that can serve them.

pub mod adjusted;
pub mod age_index;
pub mod dt;
pub mod external;
pub mod factory;
pub mod genie;
pub mod interface;
pub mod knn;
pub mod outside;
pub mod q_learning;
pub mod random;
pub mod registry;

use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;

/// Number of decisions so far, and of the devices that sense in them. The fact
/// is per TTI only for policies that decide in every TTI.
#[derive(Clone, Copy, Debug, Default)]
pub struct SensingCount {
    decisions: u64,
    sensing_device_count: u64,
}

impl SensingCount {
    /// Returns the plan for `device_count` devices in which the `chosen` ones sense, each with an id below it. Counts
    /// it.
    pub fn count_and_plan(&mut self, device_count: usize, chosen: &[DeviceId]) -> Plan {
        self.decisions += 1;
        self.sensing_device_count += chosen.len() as u64;
        Plan::from_devices(device_count, chosen)
    }

    /// Returns the mean number of devices that sense per TTI. Its name is part of `summary.json` and docs/age-index.md.
    pub fn summary_fact(&self) -> (&'static str, f64) {
        (
            "sensing_per_tti",
            self.sensing_device_count as f64 / self.decisions.max(1) as f64,
        )
    }
}

/// Names that most policies need: `use reveille_bs::policy::prelude::*`, as in docs/patrol.rs.
pub mod prelude {
    pub use reveille_common::declare;
    pub use reveille_common::ids::{DeviceId, Tti};
    pub use reveille_common::message::Report;
    pub use reveille_common::plan::{DutyCycle, Plan};

    pub use super::factory::{PolicyEntry, PolicyFactory};
    pub use super::interface::Policy;
    pub use crate::knowledge::Knowledge;
    pub use crate::observation::Observation;
}
