//! The registry of runs on this machine, so that `inspect`, `dashboard` and `clock` find a run without an address. `bs`
//! and `up` register; a registered key is only for the same user, so the folder must belong to that user alone.
//! `python/reveille/policy_client.py` repeats the rules for the folder, its checks, and the fields of
//! [`RegistryEntry`].

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use reveille_common::keys::RunName;
use reveille_common::secret::Secret;
use serde::{Deserialize, Serialize};

use crate::cli::TargetArgs;
use crate::key;

/// The content of an entry: a JSON file that holds the address of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct RegistryEntry {
    run: String,
    endpoint: String,
    /// The process of the base station, which tells whether the entry is stale.
    pid: i32,
    /// The run's key.
    key: Option<String>,
}

/// The address of a run to connect to.
pub(crate) struct RunAddress {
    /// Endpoint of its base station.
    pub endpoint: String,
    /// Its name.
    pub run: RunName,
    /// Its key, if known.
    pub key: Option<Secret>,
}

/// The registry entry of this process's run; removed when dropped.
pub(crate) struct Registration(PathBuf);

impl Drop for Registration {
    fn drop(&mut self) {
        let _gone = fs::remove_file(&self.0).is_err();
    }
}

/// Registers the base station of `run` in this process, with its `key` and `endpoint`.
///
/// # Errors
/// If the entry cannot be written.
pub(crate) fn register(run: &RunName, endpoint: &str, key: Option<Secret>) -> anyhow::Result<Registration> {
    let registry_folder = registry_folder();
    // Anything else at this path, such as a link, is refused by `check_folder`.
    if registry_folder.symlink_metadata().is_err() {
        let made = fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&registry_folder);
        made.with_context(|| format!("cannot create {}", registry_folder.display()))?;
    }
    check_folder(&registry_folder)?;
    let pid = i32::try_from(std::process::id()).context("process ids are 31 bits")?;
    // The pid keeps runs of the same name apart.
    let path = registry_folder.join(format!("{run}-{pid}.json"));
    let entry = RegistryEntry {
        run: run.to_string(),
        endpoint: endpoint.to_owned(),
        pid,
        key: key.map(|key| key.to_string()),
    };
    write_entry(&path, &serde_json::to_vec(&entry)?).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Registration(path))
}

/// Writes an entry that other users cannot read.
fn write_entry(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Left by a killed process with the same pid.
    if path.symlink_metadata().is_ok() {
        fs::remove_file(path)?;
    }
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    file.write_all(bytes)
}

/// Returns an error for a folder that other users may have written to, since its entries are trusted.
fn check_folder(registry_folder: &Path) -> anyhow::Result<()> {
    let own_uid = rustix::process::getuid().as_raw();
    let path = registry_folder.display();
    // Not `metadata`, which follows a link into a folder of another user.
    let metadata = registry_folder.symlink_metadata().with_context(|| path.to_string())?;
    if !metadata.is_dir() {
        bail!("{path} must be a folder, but is a link or a file; remove it");
    }
    if metadata.uid() != own_uid {
        let owner_uid = metadata.uid();
        bail!("{path} belongs to another user ({owner_uid}, you are {own_uid}), whose entries cannot be trusted");
    }
    let mode = metadata.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        bail!("{path} is open to other users (mode {mode:o}); restrict it with `chmod 700 {path}`");
    }
    Ok(())
}

/// The endpoint for other machines: a listener on all addresses gets the placeholder `ADDRESS`.
pub(crate) fn reachable_endpoint(endpoint: &str) -> String {
    endpoint
        .replace("/0.0.0.0:", "/ADDRESS:")
        .replace("/[::]:", "/ADDRESS:")
}

/// Finds the run that `target` selects.
///
/// # Errors
/// If there is no such run, several match, or other users may have written the registry.
pub(crate) fn find(target: &TargetArgs) -> anyhow::Result<RunAddress> {
    let key = target.key_file.as_deref().map(key::read).transpose()?;
    if let (Some(endpoint), Some(run)) = (&target.connect, &target.run) {
        return Ok(RunAddress {
            key: key.or_else(|| key_of(endpoint, run)),
            endpoint: endpoint.clone(),
            run: run.clone(),
        });
    }
    let matching_entries: Vec<RegistryEntry> = live_entries()?
        .into_iter()
        .filter(|entry| target.run.as_ref().is_none_or(|run| run.to_string() == entry.run))
        .collect();
    match &matching_entries[..] {
        [entry] => Ok(RunAddress {
            endpoint: entry.endpoint.clone(),
            run: entry.run.parse()?,
            key: key.or_else(|| entry.key()),
        }),
        [] => match &target.run {
            Some(run) => bail!("no run {run} on this machine; for a run on another machine give --connect as well"),
            None => bail!("no run on this machine; start one with `reveille up`, or give --connect and --run"),
        },
        entries => {
            let names: Vec<String> = entries
                .iter()
                .map(|entry| format!("{} at {}", entry.run, entry.endpoint))
                .collect();
            bail!(
                "there are {} runs on this machine; choose one with --run: {}",
                entries.len(),
                names.join(", ")
            )
        }
    }
}

/// The registered key of a run given by its address, if it runs on this machine. An unreadable registry has no key.
fn key_of(endpoint: &str, run: &RunName) -> Option<Secret> {
    let live_entries = live_entries().ok()?;
    let entry = live_entries
        .iter()
        .find(|entry| entry.endpoint == endpoint && entry.run == run.to_string());
    entry.and_then(RegistryEntry::key)
}

impl RegistryEntry {
    fn key(&self) -> Option<Secret> {
        self.key.as_ref()?.parse().ok()
    }
}

/// Returns the entries of live processes, sorted by run, and removes the entries of ended processes.
fn live_entries() -> anyhow::Result<Vec<RegistryEntry>> {
    let registry_folder = registry_folder();
    if registry_folder.symlink_metadata().is_err() {
        return Ok(Vec::new());
    }
    check_folder(&registry_folder).map_err(|why| {
        anyhow!("{why:#}; or give --run and --connect, or set XDG_RUNTIME_DIR to a folder that only you can write to")
    })?;
    let files = fs::read_dir(&registry_folder).with_context(|| registry_folder.display().to_string())?;
    let mut live = Vec::new();
    for path in files.flatten().map(|file| file.path()) {
        let entry: Option<RegistryEntry> = fs::read(&path)
            .ok()
            .and_then(|bytes| serde_json::from_slice(&bytes).ok());
        match entry {
            Some(entry) if is_alive(entry.pid) => live.push(entry),
            // A killed process leaves its entry behind.
            Some(_) => drop(fs::remove_file(&path)),
            // A run that registers now may still be writing its entry.
            None => {}
        }
    }
    live.sort_by(|a, b| a.run.cmp(&b.run));
    Ok(live)
}

fn is_alive(pid: i32) -> bool {
    rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
}

/// The folder of the entries, which only the current user can write to.
fn registry_folder() -> PathBuf {
    let runtime_dir = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    // The XDG specification asks programs to ignore a relative path.
    match runtime_dir.filter(|folder| folder.is_absolute()) {
        Some(runtime_dir) => runtime_dir.join("reveille"),
        None => std::env::temp_dir().join(format!("reveille-{}", rustix::process::getuid().as_raw())),
    }
}
