//! The genie-aided bound (Sec. VI): every device sleeps, and the one closest to an event is woken when it starts.

pub mod closest;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError};
use reveille_common::scenario::{NoSettings, PolicyChoice, PolicyKind, PolicySettings, Site};

use self::closest::Genie;
use super::contract::Opaque;
use super::kind::{Profile, Registered};
use super::mind::Mind;
use crate::knowledge::Knowledge;

/// The policy `genie`.
#[derive(Clone, Copy, Debug)]
pub struct GenieKind;

impl PolicyKind for GenieKind {
    fn name(&self) -> &'static str {
        "genie"
    }

    fn about(&self) -> &'static str {
        "Every device sleeps; the one closest to the epicentre, which only this policy is told, is woken (Sec. VI)."
    }

    fn settle(&self, _: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(NoSettings))
    }
}

impl Registered for GenieKind {
    fn profile(&self) -> Profile {
        Profile {
            is_bound: true,
            wakes: true,
            ..Profile::plain(5)
        }
    }

    fn build(&self, _: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::Genie(Box::new(Genie::new(known)))
    }
}
