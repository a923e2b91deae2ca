//! The files of `--tls FOLDER`: every command that connects takes the folder of its role in FOLDER. `commands/tls.rs`
//! writes them. A key file must not be readable by other users, as for `key`.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::{Context, anyhow, bail};
use reveille_common::bus::{Role, TlsFiles};

use crate::child_process;
use crate::exit::InvalidUsage;

/// Returns the error of a command that needs TLS in a build without it.
pub(crate) fn missing_feature() -> InvalidUsage {
    InvalidUsage(
        "this build has no TLS, which needs the cargo feature tls; build it with `cargo build --release --features tls`"
            .to_owned(),
    )
}

/// Returns the files of the first of `roles` that has a folder in `folder`, or `None` without a folder. Restarts the
/// process if TLS needs that, so call it before anything else.
///
/// # Errors
/// If a file is missing, a key is readable by other users, the certificate has expired, or this build has no TLS.
pub(crate) fn files_of_role(folder: Option<&Path>, roles: &[Role]) -> anyhow::Result<Option<TlsFiles>> {
    let Some(folder) = folder else { return Ok(None) };
    if !cfg!(feature = "tls") {
        bail!(missing_feature());
    }
    let option = || format!("--tls {}", folder.display());
    let role = roles.iter().find(|role| folder.join(role.name()).is_dir());
    let Some(role) = role.or(roles.first()) else {
        return Ok(None);
    };
    let files = TlsFiles::new(&std::path::absolute(folder)?.join(role.name()));
    for file in [&files.ca, &files.certificate, &files.key] {
        let metadata = fs::metadata(file).map_err(|error| {
            let place = file.display();
            if error.kind() == ErrorKind::NotFound {
                let role = role.name();
                return anyhow!(
                    "{place} is missing; copy the folder {role:?} that `reveille tls init` makes, with its three files"
                );
            }
            anyhow!(error).context(place.to_string())
        });
        let metadata = metadata.with_context(option)?;
        let mode = metadata.permissions().mode() & 0o777;
        if file == &files.key && mode & 0o077 != 0 {
            bail!(
                "{}: other users may read it (mode {mode:o}); `chmod 600` it",
                file.display()
            );
        }
    }
    check_certificate(&files).with_context(option)?;
    child_process::ensure_one_zenoh_thread()?;
    Ok(Some(files))
}

#[cfg(feature = "tls")]
fn check_certificate(files: &TlsFiles) -> anyhow::Result<()> {
    crate::certificate::Certificate::read(&files.certificate)?.check_validity(&files.certificate)
}

#[cfg(not(feature = "tls"))]
#[expect(clippy::unnecessary_wraps, reason = "as with the feature")]
fn check_certificate(_: &TlsFiles) -> anyhow::Result<()> {
    Ok(())
}
