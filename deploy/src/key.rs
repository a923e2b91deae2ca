//! The key of a run: who has it may command its clock, and carry devices where that is not for everybody.

use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use anyhow::{Context, bail};
use reveille_common::bus::draw_secret;
use reveille_common::secret::Secret;

/// The variable by which device processes are told the key of the run that started them.
pub const VARIABLE: &str = "REVEILLE_KEY";

/// The key in `path`.
///
/// # Errors
/// There is none, or others may read it.
pub fn read(path: &Path) -> anyhow::Result<Secret> {
    let named = || format!("--key-file {}", path.display());
    let mode = fs::metadata(path).with_context(named)?.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        bail!("{}: other users may read it (mode {mode:o}); `chmod 600` it", named());
    }
    let text = fs::read_to_string(path).with_context(named)?;
    text.trim().parse().with_context(named)
}

/// The key in `path`, which is made if it is not there.
///
/// # Errors
/// It can neither be read nor made.
pub fn read_or_make(path: &Path) -> anyhow::Result<Secret> {
    let named = || format!("--key-file {}", path.display());
    let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path);
    match made {
        Ok(mut file) => {
            let key = draw_secret()?;
            writeln!(file, "{key}").with_context(named)?;
            Ok(key)
        }
        Err(error) if error.kind() == ErrorKind::AlreadyExists => read(path),
        Err(error) => Err(error).with_context(named),
    }
}

/// The key that the process which started this one has given it.
pub fn inherited() -> Option<Secret> {
    std::env::var(VARIABLE).ok()?.parse().ok()
}
