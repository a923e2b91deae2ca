//! The registry of runs on this machine, so that `inspect`, `dashboard` and `clock` find a run without an address. `bs`
//! and `up` register; a registered key is only for the same user, so the folder must belong to that user alone.
//! `python/reveille/policy_client.py` repeats the rules for the folder, its checks, and the fields of
//! [`RegistryEntry`].

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use reveille_common::bus::{Bus, Endpoint, Role};
use reveille_common::keys::RunName;
use reveille_common::secret::Secret;
use serde::{Deserialize, Serialize};

use crate::cli::TargetArgs;
use crate::display::shell_word;
use crate::run_folder::{SCENARIO_FILE, SUMMARY_FILE};
use crate::{key, tls};

/// The content of an entry: a JSON file that holds the address of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct RegistryEntry {
    run: String,
    endpoint: String,
    /// The process of the base station, which tells whether the entry is stale.
    pid: i32,
    /// When that process started, in clock ticks since the machine's start, because pids are reused; other versions do
    /// not write it.
    start_ticks: Option<u64>,
    /// The run's key.
    key: Option<String>,
    /// The folder of certificates, if the endpoint needs one.
    tls: Option<PathBuf>,
    /// The run folder; other versions do not write it.
    folder: Option<PathBuf>,
    /// The file of `--key-file`; other versions do not write it.
    key_file: Option<PathBuf>,
    /// The subcommand of the base station, `up` or `bs`; other versions do not write it.
    command: Option<String>,
}

/// The entries in the registry.
#[derive(Default)]
struct RegistryEntries {
    /// Entries of live processes, sorted by run.
    live: Vec<RegistryEntry>,
    /// Entries of base stations that have ended in a run that can be resumed, in no order.
    ended: Vec<RegistryEntry>,
}

/// The address of a run to connect to.
pub(crate) struct RunAddress {
    /// Endpoint of its base station.
    pub endpoint: String,
    /// Its name.
    pub run: RunName,
    /// Its key, if known.
    pub key: Option<Secret>,
    /// The folder of certificates, if known.
    pub tls: Option<PathBuf>,
    /// Tells that the base station has ended on this machine, if it has.
    end: Option<String>,
}

impl RunAddress {
    /// Connects to the base station within `patience`, over TLS with the certificate of the first of `roles` that the
    /// folder has.
    ///
    /// # Errors
    /// If the certificate cannot be used, no base station answers, or it has ended.
    pub(crate) async fn connect(self, roles: &[Role], patience: Duration) -> anyhow::Result<Bus> {
        let files = tls::files_of_role(self.tls.as_deref(), roles)?;
        let endpoint = Endpoint {
            address: &self.endpoint,
            tls: files.as_ref(),
        };
        match (Bus::connect(endpoint, self.run, patience).await, self.end) {
            (Ok(bus), _) => Ok(bus.with_key(self.key)),
            (Err(_), Some(end)) => bail!(end),
            (Err(err), None) => Err(err.into()),
        }
    }
}

/// The registry entry of this process's run; removed when dropped.
pub(crate) struct Registration(PathBuf);

impl Drop for Registration {
    fn drop(&mut self) {
        let _gone = fs::remove_file(&self.0).is_err();
    }
}

/// The base station of a run, to be registered.
pub(crate) struct RegisteredRun<'a> {
    /// The name of the run.
    pub run: &'a RunName,
    /// The address of the base station.
    pub endpoint: &'a str,
    /// The run's key.
    pub key: Option<Secret>,
    /// The subcommand, `up` or `bs`.
    pub command: &'static str,
    /// The folder of certificates.
    pub tls: Option<&'a Path>,
    /// The file of `--key-file`.
    pub key_file: Option<&'a Path>,
    /// The run folder.
    pub folder: &'a Path,
}

/// Registers the base station `registered` of this process.
///
/// # Errors
/// If the entry cannot be written.
pub(crate) fn register(registered: &RegisteredRun<'_>) -> anyhow::Result<Registration> {
    let &RegisteredRun {
        run,
        endpoint,
        key,
        command,
        tls,
        key_file,
        folder,
    } = registered;
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
        endpoint: local_endpoint(endpoint),
        pid,
        start_ticks: running_process_start(pid),
        key: key.map(|key| key.to_string()),
        tls: tls.map(std::path::absolute).transpose()?,
        key_file: key_file.map(std::path::absolute).transpose()?,
        folder: Some(std::path::absolute(folder)?),
        command: Some(command.to_owned()),
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

/// The endpoint for this machine: a listener on all addresses is reached at the loopback address, which certificates
/// name.
pub(crate) fn local_endpoint(endpoint: &str) -> String {
    endpoint
        .replace("/0.0.0.0:", "/127.0.0.1:")
        .replace("/[::]:", "/[::1]:")
}

/// Finds the run that `target` selects.
///
/// # Errors
/// If there is no such run, its base station has ended, several match, or other users may have written the registry.
pub(crate) fn find(target: &TargetArgs) -> anyhow::Result<RunAddress> {
    let key = target.key_file.as_deref().map(key::read).transpose()?;
    if let (Some(endpoint), Some(run)) = (&target.connect, &target.run) {
        // An unreadable registry has no entries.
        let entries = read_entries().unwrap_or_default();
        let is_target = |entry: &&RegistryEntry| entry.endpoint == *endpoint && entry.run == run.to_string();
        let live = entries.live.iter().find(is_target);
        return Ok(RunAddress {
            key: key.or_else(|| live?.key()),
            endpoint: endpoint.clone(),
            run: run.clone(),
            tls: target.tls.clone(),
            end: entries.ended.iter().find(is_target).map(RegistryEntry::describe_end),
        });
    }
    let is_target = |entry: &RegistryEntry| target.run.as_ref().is_none_or(|run| run.to_string() == entry.run);
    let RegistryEntries { mut live, mut ended } = read_entries()?;
    live.retain(is_target);
    ended.retain(is_target);
    match &live[..] {
        [entry] => Ok(RunAddress {
            endpoint: entry.endpoint.clone(),
            run: entry.run.parse()?,
            key: key.or_else(|| entry.key()),
            tls: target.tls.as_ref().or(entry.tls.as_ref()).cloned(),
            end: None,
        }),
        [] if ended.len() == 1 => bail!("{}", ended[0].describe_end()),
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

impl RegistryEntry {
    /// Describes the end of the base station, with the command that resumes the run.
    fn describe_end(&self) -> String {
        let folder = shell_word(self.folder.as_deref().unwrap_or(Path::new("FOLDER")));
        let command = self.command.as_deref().unwrap_or("up");
        let option = |name: &str, path: &Option<PathBuf>| {
            let path = path.as_deref();
            path.map_or_else(String::new, |path| format!(" --{name} {}", shell_word(path)))
        };
        let options = option("tls", &self.tls) + &option("key-file", &self.key_file);
        format!(
            "run {}: its base station (pid {}) has ended; resume the run with `reveille {command} --resume \
             {folder}{options}`",
            self.run, self.pid,
        )
    }

    /// Whether the base station's process runs.
    fn is_live(&self) -> bool {
        let start_ticks = running_process_start(self.pid);
        start_ticks.is_some() && (self.start_ticks.is_none() || self.start_ticks == start_ticks)
    }

    /// Whether the run has a folder without results.
    fn is_resumable(&self) -> bool {
        let folder = self.folder.as_deref();
        folder.is_some_and(|folder| folder.join(SCENARIO_FILE).is_file() && !folder.join(SUMMARY_FILE).exists())
    }

    fn key(&self) -> Option<Secret> {
        self.key.as_ref()?.parse().ok()
    }
}

/// Reads the entries. Removes the entry of an ended process, unless its run can be resumed.
fn read_entries() -> anyhow::Result<RegistryEntries> {
    let registry_folder = registry_folder();
    if registry_folder.symlink_metadata().is_err() {
        return Ok(RegistryEntries::default());
    }
    check_folder(&registry_folder).map_err(|why| {
        anyhow!("{why:#}; or give --run and --connect, or set XDG_RUNTIME_DIR to a folder that only you can write to")
    })?;
    let files = fs::read_dir(&registry_folder).with_context(|| registry_folder.display().to_string())?;
    let mut entries = RegistryEntries::default();
    for path in files.flatten().map(|file| file.path()) {
        let entry: Option<RegistryEntry> = fs::read(&path)
            .ok()
            .and_then(|bytes| serde_json::from_slice(&bytes).ok());
        match entry {
            Some(entry) if entry.is_live() => entries.live.push(entry),
            // A killed process leaves its entry behind.
            Some(entry) if entry.is_resumable() => entries.ended.push(entry),
            Some(_) => drop(fs::remove_file(&path)),
            // A run that registers now may still be writing its entry.
            None => {}
        }
    }
    entries.live.sort_by(|a, b| a.run.cmp(&b.run));
    Ok(entries)
}

/// When the process started, in clock ticks since the machine's start; `None` unless it runs. A zombie, which has ended
/// and whose parent has not asked for its exit code, does not.
fn running_process_start(pid: i32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The fields from the third on follow the name in parentheses, which can contain any characters.
    let mut fields = stat.rsplit_once(')')?.1.split_ascii_whitespace();
    let state = fields.next()?;
    // The start time is field 22.
    let start_ticks = fields.nth(18)?.parse().ok()?;
    (!state.starts_with(['Z', 'X'])).then_some(start_ticks)
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
