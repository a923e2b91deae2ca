//! A policy for the tests of this crate, which knows none.

use std::sync::Arc;

use super::{NoSettings, Override, PolicyKind, PolicySettings, Scenario, ScenarioError, Site};
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

    fn settle(&self, _: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(NoSettings))
    }
}

/// [`super::load`] with that policy alone.
pub(crate) fn load(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    super::load(source, overrides, &[&Idle], &crate::io::Disk)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::settings::Events;

    /// A policy that would like to be set from the event process.
    #[derive(Debug)]
    struct Peeking;

    impl PolicyKind for Peeking {
        fn name(&self) -> &'static str {
            "knn"
        }

        fn about(&self) -> &'static str {
            "Reads what it must not."
        }

        fn settle(&self, reader: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
            Events::settle(reader).map(|_| Arc::new(NoSettings) as Arc<dyn PolicySettings>)
        }
    }

    #[test]
    #[should_panic(expected = "a policy reads its own fields, and not events.process")]
    fn a_policy_cannot_be_set_from_the_event_process() {
        let _unreachable = super::super::load("paper", &[], &[&Peeking], &crate::io::Disk);
    }
}
