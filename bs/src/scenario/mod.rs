//! Scenarios with the policies of this program: [`reveille_common::scenario`] with the policy registry.
//!
//! [`load`] is the usual start. [`schema`] and [`reference()`] describe all fields; docs/scenario.md is the output of
//! [`reference()`], so a change of a field or of head.md changes it too. tests/fuzz/scenario.dict lists the names of
//! fields and policies; `tests::pages` compares both files.

use reveille_common::declare::{Files, NoFiles};
// The items below, such as `Scenario` and `load`, replace the generic ones of the same name.
pub use reveille_common::scenario::*;

use crate::policy::factory::PolicyEntry;
use crate::policy::{outside, registry};

mod differences;
mod disk;
#[cfg(test)]
pub(crate) mod tests;

pub use differences::{FieldDifference, compare_scenarios, flatten};
pub use disk::{load, load_with_external, parse};

/// A policy of this program with its settings.
pub type PolicyChoice = reveille_common::scenario::PolicyChoice<PolicyEntry>;

/// A scenario with a policy of this program.
pub type Scenario = reveille_common::scenario::Scenario<PolicyChoice>;

/// A loaded scenario with a policy of this program.
pub type Loaded = reveille_common::scenario::LoadedScenario<PolicyChoice>;

/// Loads the scenario `source` with `overrides` applied. `source` is a preset's name or the path of a scenario file;
/// `files` opens the scenario files that it names.
///
/// # Errors
/// See [`reveille_common::scenario::load`].
pub fn load_with_files(source: &str, overrides: &[Override], files: &dyn Files) -> Result<Loaded, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &registry::all_policies(), files)
}

/// Names the preset of `scenario` for titles, for example `paper`, or `paper with changes` if the run differs from it
/// in more than its size, length, seed and the name of its policy.
pub fn preset_label(scenario: &Scenario) -> String {
    let run = &scenario.run;
    let assignments = [
        format!("devices={}", run.devices),
        format!("ttis={}", run.ttis),
        format!("seed={}", run.seed),
        format!("policy.name={}", scenario.policy.name()),
    ];
    let overrides: Result<Vec<Override>, _> = assignments.iter().map(|text| Override::parse(text)).collect();
    let policies = outside::kinds_with_external();
    let preset =
        overrides.and_then(|overrides| reveille_common::scenario::load(&run.preset, &overrides, &policies, &NoFiles));
    match preset {
        Ok(preset) if preset.scenario.hash() == scenario.hash() => run.preset.clone(),
        _ => format!("{} with changes", run.preset),
    }
}

/// Returns the declaration of all scenario fields, for the schema, the reference and the help.
pub fn declaration() -> Declaration {
    reveille_common::scenario::declaration(&registry::all_policies())
}

/// Returns today's path of the scenario field at `path`, which may be a former path; any other text stays as it is.
pub fn current_field(path: &str) -> String {
    declaration().current_path(path)
}

/// Returns the JSON Schema of scenario files.
pub fn schema() -> String {
    reveille_common::declare::json_schema(&declaration())
}

/// Returns the reference page of all fields, docs/scenario.md.
pub fn reference() -> String {
    reveille_common::declare::reference_page(&declaration(), include_str!("head.md"))
}
