//! Scenarios with the policies of this program: [`reveille_common::scenario`] with the registry and the disk wired in.

use std::path::Path;

use reveille_common::io::Disk;
pub use reveille_common::scenario::*;

use crate::policy::registry;

#[cfg(test)]
mod tests;

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` on top.
///
/// # Errors
/// As [`reveille_common::scenario::load`].
pub fn load(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &registry::kinds(), &Disk)
}

/// The scenario of the TOML `text`, as [`reveille_common::scenario::parse`] reads it.
///
/// # Errors
/// As there.
pub fn parse(text: &str, origin: &str, base_dir: &Path, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::parse(text, origin, base_dir, overrides, &registry::kinds(), &Disk)
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
