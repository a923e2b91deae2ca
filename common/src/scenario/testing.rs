//! A policy for the tests of this crate, which knows none.

use std::sync::Arc;

use super::{NoSettings, Override, PolicyKind, PolicySettings, Scenario, ScenarioError};
use crate::declare::Reader;

/// A policy without settings.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Idle;

impl PolicyKind for Idle {
    fn name(&self) -> &'static str {
        "knn"
    }

    fn about(&self) -> &'static str {
        "Stands for any policy."
    }

    fn settle(&self, _: &Reader<'_>, _: &Scenario) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(NoSettings))
    }
}

/// [`super::load`] with that policy alone.
pub(crate) fn load(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    super::load(source, overrides, &[&Idle], &crate::io::Disk)
}
