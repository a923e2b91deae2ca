//! The runs on this machine, so that `inspect` and `clock` find them without an address.

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

/// Where a run is to be found.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Entry {
    run: String,
    endpoint: String,
    pid: i32,
    /// The run's key.
    key: Option<String>,
}

/// A run to connect to.
pub struct Found {
    /// Where its BS listens.
    pub endpoint: String,
    /// Its name.
    pub run: RunName,
    /// Its key, if it is to be had.
    pub key: Option<Secret>,
}

/// An entry of this process's run, removed when dropped.
pub struct Registered(PathBuf);

impl Drop for Registered {
    fn drop(&mut self) {
        let _gone = fs::remove_file(&self.0).is_err();
    }
}

/// Notes that this process runs the BS of `run`, with this `key`, at `endpoint`.
///
/// # Errors
/// If the note cannot be written.
pub fn register(run: &RunName, endpoint: &str, key: Option<Secret>) -> anyhow::Result<Registered> {
    let folder = folder();
    // Whatever is in its place is looked at below.
    if folder.symlink_metadata().is_err() {
        let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder);
        made.with_context(|| format!("cannot create {}", folder.display()))?;
    }
    check(&folder)?;
    let pid = i32::try_from(std::process::id()).context("process ids are 31 bits")?;
    let path = folder.join(format!("{run}-{pid}.json"));
    let entry = Entry {
        run: run.to_string(),
        endpoint: endpoint.to_owned(),
        pid,
        key: key.map(|key| key.to_string()),
    };
    write(&path, &serde_json::to_vec(&entry)?).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Registered(path))
}

/// Writes an entry, which nobody else may read.
fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Of a process that had this one's id and was killed.
    if path.symlink_metadata().is_ok() {
        fs::remove_file(path)?;
    }
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    file.write_all(bytes)
}

/// Refuses a folder that others may have written into: what is in it is believed.
fn check(folder: &Path) -> anyhow::Result<()> {
    let own = rustix::process::getuid().as_raw();
    let named = folder.display();
    let found = folder.symlink_metadata().with_context(|| named.to_string())?;
    if !found.is_dir() {
        bail!("{named} is to be a folder, and is a link or a file");
    }
    if found.uid() != own {
        let other = found.uid();
        bail!(
            "{named} belongs to another user ({other}, you are {own}), who could lead you to a run that is not yours"
        );
    }
    let mode = found.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        bail!("{named} is open to other users (mode {mode:o}): make it yours alone with `chmod 700 {named}`");
    }
    Ok(())
}

/// The endpoint for others: a listener on all addresses is reached at one of them.
pub fn reachable(endpoint: &str) -> String {
    endpoint
        .replace("/0.0.0.0:", "/ADDRESS:")
        .replace("/[::]:", "/ADDRESS:")
}

/// The run that `target` means.
///
/// # Errors
/// If there is none, or more than one, or others could have put them there.
pub fn find(target: &TargetArgs) -> anyhow::Result<Found> {
    let key = target.key_file.as_deref().map(key::read).transpose()?;
    if let (Some(endpoint), Some(run)) = (&target.connect, &target.run) {
        return Ok(Found {
            key: key.or_else(|| key_of(endpoint, run)),
            endpoint: endpoint.clone(),
            run: run.clone(),
        });
    }
    let entries: Vec<Entry> = entries()?
        .into_iter()
        .filter(|entry| target.run.as_ref().is_none_or(|run| run.to_string() == entry.run))
        .collect();
    match &entries[..] {
        [entry] => Ok(Found {
            endpoint: entry.endpoint.clone(),
            run: entry.run.parse()?,
            key: key.or_else(|| entry.key()),
        }),
        [] => match &target.run {
            Some(run) => bail!("no run {run} on this machine. For a run elsewhere give --connect too"),
            None => bail!("no run on this machine. Start one with `reveille up`, or give --connect and --run"),
        },
        many => {
            let names: Vec<String> = many.iter().map(|e| format!("{} at {}", e.run, e.endpoint)).collect();
            bail!(
                "there are {} runs on this machine; choose one with --run: {}",
                many.len(),
                names.join(", ")
            )
        }
    }
}

/// The key of a run that is named with its address, if it is one of this machine.
fn key_of(endpoint: &str, run: &RunName) -> Option<Secret> {
    let entries = entries().ok()?;
    let own = entries
        .iter()
        .find(|entry| entry.endpoint == endpoint && entry.run == run.to_string());
    own.and_then(Entry::key)
}

impl Entry {
    fn key(&self) -> Option<Secret> {
        self.key.as_ref()?.parse().ok()
    }
}

/// The entries of processes that live; those of others are removed.
fn entries() -> anyhow::Result<Vec<Entry>> {
    let folder = folder();
    if folder.symlink_metadata().is_err() {
        return Ok(Vec::new());
    }
    check(&folder).map_err(|why| {
        anyhow!("{why:#}; or give --run and --connect, or let XDG_RUNTIME_DIR name a folder of your own")
    })?;
    let files = fs::read_dir(&folder).with_context(|| folder.display().to_string())?;
    let mut found = Vec::new();
    for path in files.flatten().map(|file| file.path()) {
        let entry: Option<Entry> = fs::read(&path)
            .ok()
            .and_then(|bytes| serde_json::from_slice(&bytes).ok());
        match entry {
            Some(entry) if is_alive(entry.pid) => found.push(entry),
            Some(_) => drop(fs::remove_file(&path)),
            None => {}
        }
    }
    found.sort_by(|a, b| a.run.cmp(&b.run));
    Ok(found)
}

fn is_alive(pid: i32) -> bool {
    rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
}

fn folder() -> PathBuf {
    let given = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    // One that depends on where a command is given is to be ignored, says its specification.
    match given.filter(|folder| folder.is_absolute()) {
        Some(folder) => folder.join("reveille"),
        None => std::env::temp_dir().join(format!("reveille-{}", rustix::process::getuid().as_raw())),
    }
}
