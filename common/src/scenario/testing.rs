//! A test policy for this crate, which defines no policies, and loaders of scenarios with it.

use std::sync::Arc;

use super::{Override, PolicyChoice, PolicyKind, Scenario, ScenarioError, Site};
use crate::declare::{FieldReader, FieldSink, Section, Visit};

/// A policy for tests that has no settings and stands for any policy.
#[derive(Debug)]
pub(crate) struct StubPolicy {
    /// Called when the settings are read; a test can access fields of the scenario here.
    read_fields: fn(&FieldReader<'_>) -> Result<(), ScenarioError>,
}

/// The stub that reads no fields.
static STUB: StubPolicy = StubPolicy {
    read_fields: |_| Ok(()),
};

/// The empty settings of [`StubPolicy`].
#[derive(Debug)]
pub(crate) struct NoSettings;

impl Visit for NoSettings {
    fn visit(&self, _: &mut dyn FieldSink) {}
}

impl PolicyKind for StubPolicy {
    type Settings = NoSettings;

    // The default of `policy.name` in `run.rs`: the presets name no policy.
    fn name(&self) -> &'static str {
        "knn"
    }

    fn about(&self) -> &'static str {
        "Stands for any policy."
    }

    fn section(&self) -> Option<&'static Section> {
        None
    }

    fn read_settings(&self, reader: &FieldReader<'_>, _: &Site<'_>) -> Result<Arc<NoSettings>, ScenarioError> {
        (self.read_fields)(reader)?;
        Ok(Arc::new(NoSettings))
    }

    fn delay_budget(_: &NoSettings) -> Option<(&'static str, u64)> {
        None
    }

    fn pilot_ttis(_: &NoSettings) -> Option<(&'static str, u64)> {
        None
    }
}

/// A scenario with [`StubPolicy`].
pub(crate) type TestScenario = Scenario<PolicyChoice<StubPolicy>>;

/// Loads the paper's scenario with changes such as `devices=10`.
pub(crate) fn load_with(changes: &[impl AsRef<str>]) -> Result<TestScenario, ScenarioError> {
    let overrides: Vec<Override> = changes
        .iter()
        .map(|text| Override::parse(text.as_ref()).expect("FIELD=VALUE"))
        .collect();
    load("paper", &overrides)
}

/// Loads the paper's scenario with valid changes.
pub(crate) fn scenario_with(changes: &[impl AsRef<str>]) -> TestScenario {
    load_with(changes).expect("a scenario")
}

/// Loads a scenario as [`super::load`] does, with [`StubPolicy`] as the only policy.
pub(crate) fn load(source: &str, overrides: &[Override]) -> Result<TestScenario, ScenarioError> {
    super::load(source, overrides, &[&STUB], &crate::io::Disk).map(|loaded| loaded.scenario)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::event_settings::EventSettings;

    /// A policy that reads the event process, which is forbidden.
    static PEEKING: StubPolicy = StubPolicy {
        read_fields: |reader| EventSettings::from_fields(reader).map(drop),
    };

    #[test]
    #[should_panic(expected = "a policy may read only its own fields, not events.process")]
    fn a_policy_cannot_read_the_event_process() {
        let _unreachable = super::super::load("paper", &[], &[&PEEKING], &crate::io::Disk);
    }
}
