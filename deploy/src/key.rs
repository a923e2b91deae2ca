//! The key of a run: its file (`--key-file`) and its way to child processes. It allows a client to control the clock,
//! to act on devices and to decide, and to run devices under `up` and `bs --key-file`. `docs/command-line.md` lists the
//! access rules. A key file must not be readable by other users. Policy processes read [`KEY_VARIABLE`] too
//! (`docs/policy-port.md`, `python/reveille/policy_client.py`).

use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use anyhow::{Context, anyhow, bail};
use reveille_common::bus::draw_secret;
use reveille_common::declare::describe_read_error;
use reveille_common::secret::Secret;

/// The environment variable that passes the run's key to device and policy processes.
pub(crate) const KEY_VARIABLE: &str = "REVEILLE_KEY";

/// Reads the key in `path`, which `--key-file` names.
///
/// # Errors
/// If there is no key, or other users may read it.
pub(crate) fn read(path: &Path) -> anyhow::Result<Secret> {
    let option = || format!("--key-file {}", path.display());
    let metadata = fs::metadata(path).map_err(|error| {
        let cause = describe_read_error(
            &error,
            "name the key file of the base station, which `bs --key-file` creates",
        );
        anyhow!("{}: {cause}", option())
    })?;
    let mode = metadata.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        bail!("{}: other users may read it (mode {mode:o}); `chmod 600` it", option());
    }
    let text = fs::read_to_string(path).with_context(option)?;
    text.trim().parse().with_context(option)
}

/// Reads the key in `path`, which `--key-file` of `bs` names; the file is created if missing.
///
/// # Errors
/// If it can neither be read nor created.
pub(crate) fn read_or_create(path: &Path) -> anyhow::Result<Secret> {
    let option = || format!("--key-file {}", path.display());
    if path.exists() {
        return read(path);
    }
    // The key is written under another name, readable by its owner only, and then linked: no process reads half a key,
    // and of several that start together one makes it.
    let draft = path.with_added_extension(format!("{}.draft", std::process::id()));
    let key = draw_secret()?;
    // A new file only: an existing one could belong to another user, who could read it.
    let created = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&draft);
    let mut file = match created {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::NotFound => bail!(
            "{}: its folder does not exist; create it, or name another file",
            option()
        ),
        Err(error) => return Err(error).with_context(option),
    };
    let linked = writeln!(file, "{key}").and_then(|()| fs::hard_link(&draft, path));
    fs::remove_file(&draft).with_context(option)?;
    match linked {
        Ok(()) => Ok(key),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => read(path),
        Err(error) => Err(error).with_context(option),
    }
}

/// The key that the parent process passed to this one; `None` without a key, or if it is invalid.
pub(crate) fn inherited() -> Option<Secret> {
    std::env::var(KEY_VARIABLE).ok()?.parse().ok()
}
