//! Loads scenarios and the files that they name from the local disk, for the policies of this program. Other sources of
//! files use [`load_with_files`](super::load_with_files). Outside `server` this is the only file of the crate that may
//! read the disk, as `tests/tests/tidy/` checks.

use std::path::Path;

use reveille_common::io::Disk;
use reveille_common::scenario::{Override, ScenarioError};

use super::Loaded;
use crate::policy::{outside, registry};

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` applied.
///
/// # Errors
/// See [`reveille_common::scenario::load`].
pub fn load(source: &str, overrides: &[Override]) -> Result<Loaded, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &registry::all_policies(), &Disk)
}

/// Loads a scenario like [`load`], but also accepts the policy `external` of a policy process.
///
/// # Errors
/// See [`load`].
pub fn load_with_external(source: &str, overrides: &[Override]) -> Result<Loaded, ScenarioError> {
    reveille_common::scenario::load(source, overrides, &outside::kinds_with_external(), &Disk)
}

/// Parses a scenario from the TOML `text`. Messages call it `origin`; paths in it are relative to `base_dir`.
///
/// # Errors
/// See [`reveille_common::scenario::parse`].
pub fn parse(text: &str, origin: &str, base_dir: &Path, overrides: &[Override]) -> Result<Loaded, ScenarioError> {
    reveille_common::scenario::parse(text, origin, base_dir, overrides, &registry::all_policies(), &Disk)
}
