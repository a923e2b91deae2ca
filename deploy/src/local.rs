//! The runs on this machine, so that `inspect` and `clock` find them without an address.

use std::fs;
use std::os::unix::fs::DirBuilderExt;
use std::path::PathBuf;

use anyhow::{Context, bail};
use reveille_common::keys::RunName;
use serde::{Deserialize, Serialize};

use crate::cli::TargetArgs;

/// Where a run is to be found.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Entry {
    run: String,
    endpoint: String,
    pid: i32,
}

/// An entry of this process's run, removed when dropped.
pub struct Registered(PathBuf);

impl Drop for Registered {
    fn drop(&mut self) {
        let _gone = fs::remove_file(&self.0).is_err();
    }
}

/// Notes that this process runs the BS of `run` at `endpoint`.
///
/// # Errors
/// If the note cannot be written.
pub fn register(run: &RunName, endpoint: &str) -> anyhow::Result<Registered> {
    let folder = folder();
    let mut builder = fs::DirBuilder::new();
    // What is in it is believed: nobody else may write there.
    let made = builder.recursive(true).mode(0o700).create(&folder);
    made.with_context(|| format!("cannot create {}", folder.display()))?;
    let pid = i32::try_from(std::process::id()).context("process ids are 31 bits")?;
    let path = folder.join(format!("{run}-{pid}.json"));
    let entry = Entry {
        run: run.to_string(),
        endpoint: endpoint.to_owned(),
        pid,
    };
    fs::write(&path, serde_json::to_vec(&entry)?).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Registered(path))
}

/// The endpoint and name of the run that `target` means.
///
/// # Errors
/// If there is none, or more than one.
pub fn find(target: &TargetArgs) -> anyhow::Result<(String, RunName)> {
    if let (Some(endpoint), Some(run)) = (&target.connect, &target.run) {
        return Ok((endpoint.clone(), run.clone()));
    }
    let entries: Vec<Entry> = entries()
        .into_iter()
        .filter(|entry| target.run.as_ref().is_none_or(|run| run.to_string() == entry.run))
        .collect();
    match &entries[..] {
        [entry] => Ok((entry.endpoint.clone(), entry.run.parse()?)),
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

/// The entries of processes that live; those of others are removed.
fn entries() -> Vec<Entry> {
    let Ok(files) = fs::read_dir(folder()) else {
        return Vec::new();
    };
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
    found
}

fn is_alive(pid: i32) -> bool {
    rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
}

fn folder() -> PathBuf {
    let uid = rustix::process::getuid().as_raw();
    std::env::var_os("XDG_RUNTIME_DIR").map_or_else(
        || std::env::temp_dir().join(format!("reveille-{uid}")),
        |folder| PathBuf::from(folder).join("reveille"),
    )
}
