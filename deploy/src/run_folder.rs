//! The run folder.
//!
//! | file | content |
//! |---|---|
//! | `scenario.toml` | the resolved scenario |
//! | `scenario-files/` | copies of the scenario files: layout, traces, learned tables |
//! | `events.csv` | a row per event |
//! | `windows.csv` | a row per window of TTIs |
//! | `devices.csv` | a row per device |
//! | `learned.json` | the tables of a policy that learned in the run |
//! | `summary.json` | metrics, digest, timing, versions |
//! | `inputs.log` | external inputs: outages under `--on-loss continue`, decisions of `external` |
//! | `resume.json` | the resume mark for `--resume`; removed once the run is complete |
//! | `RUNNING` | exists and is locked during the run; left behind by a killed run |
//! | `FAILED` | the reason why a run ended without a summary |

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_bs::cycle::Outcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::io::replace;
use reveille_lab::training::learned_in;

use crate::cli::OutputArgs;
use crate::folder_lock::{FolderLock, RUNNING};
use crate::input_log::INPUTS;
use crate::resume_mark::MARK;
use crate::run_tables;
use crate::scenario_files::{self, ScenarioFiles};
use crate::summary::Summary;
use crate::table_writer::Tables;

const FAILED: &str = "FAILED";
/// The resolved scenario.
pub(crate) const SCENARIO: &str = "scenario.toml";
/// The results of the run.
pub(crate) const SUMMARY: &str = "summary.json";
const LEARNED: &str = "learned.json";
const DEVICES: &str = "devices.csv";
const EVENTS: &str = "events.csv";
const WINDOWS: &str = "windows.csv";
/// Indices of the two tables in [`Tables`].
const EVENT: usize = 0;
const WINDOW: usize = 1;
/// Part files that a run killed during a write may have left.
const PARTS: [&str; 5] = [
    "resume.json.part",
    "scenario.toml.part",
    "summary.json.part",
    "learned.json.part",
    "devices.csv.part",
];

/// The folder of an active run.
pub(crate) struct RunFolder {
    path: PathBuf,
    /// The lock, until the run has ended.
    claim: Option<FolderLock>,
    tables: Tables,
    devices: u32,
}

impl RunFolder {
    /// Creates the folder that `args` names, or the next free one under `runs/`, and marks it as running.
    ///
    /// # Errors
    /// If the folder is not empty, a run is writing there, or it cannot be written to.
    pub(crate) fn create(args: &OutputArgs, scenario: &Scenario) -> anyhow::Result<Self> {
        // Read before the folder is emptied, since it can hold these files.
        let inputs = ScenarioFiles::read(scenario)?;
        if let Some(path) = &args.resume {
            return Self::reopen(path, scenario);
        }
        let (path, mut claim) = if let Some(path) = &args.out {
            (path.clone(), clear(path, args.force)?)
        } else {
            let path = free_name(scenario)?;
            let claim = FolderLock::acquire(&path)?;
            (path, claim)
        };
        match fill(&path, &mut claim, &inputs, scenario) {
            Ok(tables) => Ok(Self {
                path,
                claim: Some(claim),
                tables,
                devices: scenario.run.devices,
            }),
            Err(error) => {
                // The files of a run that did not begin would block the next one.
                let _emptied = empty(&path).is_ok() && claim.release().is_ok();
                Err(error)
            }
        }
    }

    /// Opens the folder of a run to resume. Its result files are written from the start.
    fn reopen(path: &Path, scenario: &Scenario) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write in the run folder {}", path.display());
        let mut claim = FolderLock::acquire(path)?;
        // Under the lock, so that no other run can complete it meanwhile.
        if is_complete(path) {
            claim.abandon();
            bail!("--resume {}: the run in this folder has finished", path.display());
        }
        claim.mark_running().with_context(cannot)?;
        remove(path, [SUMMARY, LEARNED, FAILED, DEVICES].into_iter().chain(PARTS))?;
        Ok(Self {
            tables: tables(path).with_context(cannot)?,
            path: path.to_owned(),
            claim: Some(claim),
            devices: scenario.run.devices,
        })
    }

    /// The path of the folder.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The last part of its path, as a run name.
    pub(crate) fn name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let fits = |c: char| {
            if c.is_ascii_alphanumeric() || c == '-' || c == '_' {
                c
            } else {
                '-'
            }
        };
        // A run name has at most 64 characters and does not begin with `-`.
        let name: String = name.chars().map(fits).skip_while(|&c| c == '-').take(64).collect();
        if name.is_empty() { "run".to_owned() } else { name }
    }

    /// Writes the devices and the summary, and removes the running mark.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub(crate) fn finish(
        mut self,
        scenario: &Scenario,
        outcome: &Outcome,
        summary: &Summary<'_>,
    ) -> anyhow::Result<()> {
        let cannot = || format!("cannot write in the run folder {}", self.path.display());
        // The summary comes after all other files: with it the folder counts as complete.
        self.tables.flush().with_context(cannot)?;
        self.write_devices(scenario, outcome).with_context(cannot)?;
        replace(&self.path.join(SUMMARY), summary.to_json()?.as_bytes()).with_context(cannot)?;
        self.claim
            .take()
            .map_or(Ok(()), FolderLock::release)
            .with_context(cannot)
    }

    /// Writes the tables that the policy learned in the run, if it learns.
    pub(crate) fn write_learned(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let Some(learned) = learned_in(scenario, outcome) else {
            return Ok(());
        };
        replace(&self.path.join(LEARNED), learned.to_json().as_bytes())
            .with_context(|| format!("cannot write in the run folder {}", self.path.display()))
    }

    fn write_devices(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let mut rows = csv::Writer::from_writer(Vec::new());
        rows.write_record(run_tables::DEVICES)?;
        for device in &outcome.devices {
            rows.write_record(run_tables::device(scenario, device))?;
        }
        let rows = rows.into_inner().context("a table in memory")?;
        Ok(replace(&self.path.join(DEVICES), &rows)?)
    }

    /// Marks the run as failed, with the reason.
    pub(crate) fn fail(mut self, why: &anyhow::Error) {
        self.mark(&format!("{why:#}\n"));
    }

    fn mark(&mut self, why: &str) {
        let Some(claim) = self.claim.take() else { return };
        // The run has failed already, so errors in writing about it are ignored.
        let _ = self.tables.flush();
        // Written in place: on a full disk an empty mark is better than none.
        let _ = fs::write(self.path.join(FAILED), why);
        let _ = claim.release();
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        self.mark("the run failed without a summary; its error is on the standard error of the command\n");
    }
}

impl Observer for RunFolder {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::EventEnded(event) = notification {
            self.tables.add(EVENT, run_tables::event(event));
        }
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        if window.end > window.first {
            self.tables.add(WINDOW, run_tables::window(self.devices, window));
        }
        self.tables.has_no_error()
    }
}

/// Writes the first files of a run into a folder.
fn fill(path: &Path, claim: &mut FolderLock, inputs: &ScenarioFiles, scenario: &Scenario) -> anyhow::Result<Tables> {
    let cannot = || format!("cannot write in the run folder {}", path.display());
    claim.mark_running().with_context(cannot)?;
    inputs.write(path).with_context(cannot)?;
    replace(&path.join(SCENARIO), inputs.to_toml(scenario).as_bytes()).with_context(cannot)?;
    inputs.check(&path.join(SCENARIO), scenario)?;
    tables(path).with_context(cannot)
}

/// Opens the tables that grow during the run.
fn tables(path: &Path) -> anyhow::Result<Tables> {
    let tables = [
        (EVENTS, run_tables::EVENTS.to_vec()),
        (WINDOWS, run_tables::window_columns().collect()),
    ];
    Tables::begin(path, &tables)
}

/// Whether the run in a folder is complete.
fn is_complete(path: &Path) -> bool {
    let text = fs::read_to_string(path.join(SUMMARY)).unwrap_or_default();
    serde_json::from_str::<serde_json::Value>(&text).is_ok_and(|summary| summary["status"] == "complete")
}

/// Locks a folder, and removes an earlier run from it with `force`.
fn clear(path: &Path, force: bool) -> anyhow::Result<FolderLock> {
    // A folder without a run gets no RUNNING file.
    if !path.join(RUNNING).exists() {
        check_free(path, force, false)?;
    }
    let claim = FolderLock::acquire(path)?;
    // Checked again under the lock: another run may have used the folder meanwhile.
    if let Err(refusal) = check_free(path, force, claim.was_killed()) {
        claim.abandon();
        return Err(refusal);
    }
    empty(path)?;
    Ok(claim)
}

/// Removes the files of a run from a folder, except the running mark.
fn empty(path: &Path) -> anyhow::Result<()> {
    let files = [SUMMARY, LEARNED, FAILED, DEVICES, EVENTS, WINDOWS, INPUTS, MARK];
    // scenario.toml goes last: a half-emptied folder must still count as a run, which --force may replace.
    remove(path, files.into_iter().chain(PARTS).chain([SCENARIO]))?;
    let inputs = path.join(scenario_files::FOLDER);
    scenario_files::remove(path).with_context(|| format!("cannot replace {}", inputs.display()))
}

/// Removes the files that exist from a folder.
fn remove(path: &Path, names: impl Iterator<Item = &'static str>) -> anyhow::Result<()> {
    for name in names {
        let file = path.join(name);
        if file.exists() {
            fs::remove_file(&file).with_context(|| format!("cannot replace {}", file.display()))?;
        }
    }
    Ok(())
}

/// Returns an error for a folder with content, unless it holds a run that may be replaced.
fn check_free(path: &Path, force: bool, was_killed: bool) -> anyhow::Result<()> {
    let Ok(files) = fs::read_dir(path) else {
        return Ok(());
    };
    let is_mark = |file: &fs::DirEntry| file.file_name() == RUNNING;
    if files.flatten().all(|file| is_mark(&file)) {
        return Ok(());
    }
    let is_run = was_killed || path.join(SCENARIO).exists();
    if force && is_run {
        return Ok(());
    }
    let hint = match (is_run, was_killed) {
        (false, _) => "the folder is not empty and holds no run; choose another folder",
        (true, false) => "the folder is not empty; choose another folder, or add --force to replace it",
        (true, true) => {
            "the folder holds a killed run; choose another folder, resume it with --resume, or add --force \
            to replace it"
        }
    };
    bail!("--out {}: {hint}", path.display())
}

/// Creates a new folder under `runs/`. It is created here, so that two runs never share one.
fn free_name(scenario: &Scenario) -> anyhow::Result<PathBuf> {
    fs::create_dir_all("runs").context("cannot create the folder runs here; name another folder with --out")?;
    let stem = format!(
        "{}-n{}-s{}",
        scenario.policy.name(),
        scenario.run.devices,
        scenario.run.seed
    );
    for number in 1.. {
        let name = if number == 1 {
            stem.clone()
        } else {
            format!("{stem}-{number}")
        };
        let path = Path::new("runs").join(name);
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error).with_context(|| format!("cannot create {}", path.display())),
        }
    }
    bail!("no free name under runs/; name a folder with --out")
}
