//! Scenarios with the policies of this program: [`reveille_common::scenario`] with the registry wired in.

use reveille_common::declare::Files;
pub use reveille_common::scenario::*;

use crate::policy::registry;

mod disk;
#[cfg(test)]
mod tests;

pub use disk::{load, load_outside, parse};

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` on top; `files` opens
/// what it names.
///
/// # Errors
/// As [`reveille_common::scenario::load`].
pub fn load_with(source: &str, overrides: &[Override], files: &dyn Files) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &registry::kinds(), files)
}

/// What may be said in a scenario file, for the schema, the reference and help.
pub fn declaration() -> Declaration {
    reveille_common::scenario::declaration(&registry::kinds())
}

/// The JSON Schema of scenario files.
pub fn schema() -> String {
    reveille_common::declare::schema(&declaration())
}

/// The reference page of all fields, docs/scenario.md.
pub fn reference() -> String {
    reveille_common::declare::reference(&declaration(), include_str!("scenario/head.md"))
}
