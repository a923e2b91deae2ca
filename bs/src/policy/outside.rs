//! The policy `external`, which those bring who can answer for it. It is none of
//! [`POLICIES`](super::registry::POLICIES): nobody lists it, sweeps over it or runs it by its name alone.

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError};
use reveille_common::scenario::{NoSettings, PolicyChoice, PolicyKind, PolicySettings, Site};

use super::contract::Opaque;
use super::external::External;
use super::kind::{Profile, Registered};
use super::mind::Mind;
use super::registry::{self, Registry};
use crate::beliefs::ages;
use crate::knowledge::Knowledge;

/// Its name in a scenario.
pub const NAME: &str = "external";

/// The registry of those who can answer.
pub const EXTERNAL: Registry = &[&ExternalKind];

/// Whether `choice` is `external`.
pub fn is_external(choice: &PolicyChoice) -> bool {
    choice.name() == NAME
}

/// The registry with the policy that `choice` names.
pub fn registry_of(choice: &PolicyChoice) -> Registry {
    if is_external(choice) {
        EXTERNAL
    } else {
        registry::POLICIES
    }
}

/// The policies of this program and `external`, as a scenario names them.
pub fn kinds() -> Vec<&'static dyn PolicyKind> {
    let mut kinds = registry::kinds();
    kinds.push(&ExternalKind);
    kinds
}

/// The policy `external`.
#[derive(Clone, Copy, Debug)]
pub struct ExternalKind;

impl PolicyKind for ExternalKind {
    fn name(&self) -> &'static str {
        NAME
    }

    fn about(&self) -> &'static str {
        "Decides nothing itself: another program is asked for each decision."
    }

    fn settle(&self, reader: &Reader<'_>, site: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        ages::check_cells(self.name(), reader, site)?;
        Ok(Arc::new(NoSettings))
    }
}

impl Registered for ExternalKind {
    fn profile(&self) -> Profile {
        Profile {
            wakes: true,
            ..Profile::plain(7)
        }
    }

    fn build(&self, _: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::External(Box::new(External::new(known)))
    }
}
