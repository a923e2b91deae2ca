//! Scenarios whose files are on this machine's disk.

use std::path::Path;

use reveille_common::io::Disk;
use reveille_common::scenario::{Override, Scenario, ScenarioError};

use crate::policy::{outside, registry};

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` on top.
///
/// # Errors
/// As [`reveille_common::scenario::load`].
pub fn load(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &registry::kinds(), &Disk)
}

/// As [`load`], of a run that somebody may decide for: its policy can be `external` as well.
///
/// # Errors
/// As [`load`].
pub fn load_outside(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &outside::kinds(), &Disk)
}

/// The scenario of the TOML `text`, as [`reveille_common::scenario::parse`] reads it.
///
/// # Errors
/// As there.
pub fn parse(text: &str, origin: &str, base_dir: &Path, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    reveille_common::scenario::parse(text, origin, base_dir, overrides, &registry::kinds(), &Disk)
}
