//! The registry entry of the policy [`external`](super::external), for programs that can serve decision requests.
//! [`POLICIES`](super::registry::POLICIES) leaves it out: no list or sweep contains it, and it cannot run by its name
//! alone. `bs/src/scenario/disk.rs` and the Python package load scenarios with it.

use std::sync::Arc;

use reveille_common::declare::{FieldSink, Visit};
use reveille_common::scenario::PolicyChoice;

use super::external::External;
use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use super::registry;
use crate::beliefs::ages;
use crate::knowledge::Knowledge;

/// Name of the policy in a scenario, in run folders and in figures.
pub const EXTERNAL_NAME: &str = "external";

/// The policy `external`.
pub(crate) const EXTERNAL: PolicyEntry = PolicyEntry::without_settings(
    EXTERNAL_NAME,
    "Makes no decisions itself: each decision request goes to a policy process.",
    |reader, site| {
        ages::check_cells(EXTERNAL_NAME, reader, site)?;
        Ok(Arc::new(ExternalFactory))
    },
);

/// Whether `choice` is `external`.
pub fn is_external(choice: &PolicyChoice<PolicyEntry>) -> bool {
    choice.name() == EXTERNAL_NAME
}

/// Returns the policies of this program and `external`, as a scenario names them.
pub fn kinds_with_external() -> Vec<&'static PolicyEntry> {
    let mut all_policies = registry::all_policies();
    all_policies.push(&EXTERNAL);
    all_policies
}

/// Builds the policy.
#[derive(Debug)]
struct ExternalFactory;

impl Visit for ExternalFactory {
    fn visit(&self, _: &mut dyn FieldSink) {}
}

impl PolicyFactory for ExternalFactory {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(External::new(known))
    }
}
