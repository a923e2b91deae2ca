//! The run folder.
//!
//! | file | what |
//! |---|---|
//! | `scenario.toml` | the resolved scenario |
//! | `inputs/` | copies of the files that it names: layout, traces, learned tables |
//! | `events.csv` | a row per event |
//! | `windows.csv` | a row per window of TTIs |
//! | `devices.csv` | a row per device |
//! | `learned.json` | the tables of a policy that has learned in the run |
//! | `summary.json` | metrics, digest, timing, versions |
//! | `inputs.log` | what the run depends on besides: outages under `--on-loss continue`, decisions of `external` |
//! | `mark.json` | how far the run has come, for `--resume`; gone once it is complete |
//! | `RUNNING` | there and locked while the run goes; left behind, the run was killed |
//! | `FAILED` | why a run ended without a summary |

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_common::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::io::replace;
use reveille_lab::training::learned_in;

use crate::claim::{Claim, RUNNING};
use crate::cli::OutputArgs;
use crate::input_log::INPUTS;
use crate::inputs::{self, Inputs};
use crate::marks::MARK;
use crate::rows::Tables;
use crate::series;
use crate::summary::Summary;

const FAILED: &str = "FAILED";
/// The resolved scenario.
pub const SCENARIO: &str = "scenario.toml";
/// What the run came to.
pub const SUMMARY: &str = "summary.json";
const LEARNED: &str = "learned.json";
const DEVICES: &str = "devices.csv";
const EVENTS: &str = "events.csv";
const WINDOWS: &str = "windows.csv";
/// The places of the two in [`Tables`].
const EVENT: usize = 0;
const WINDOW: usize = 1;
/// What a run that was killed while it wrote may have left.
const PARTS: [&str; 5] = [
    "mark.json.part",
    "scenario.toml.part",
    "summary.json.part",
    "learned.json.part",
    "devices.csv.part",
];

/// A run folder that is being filled.
pub struct RunFolder {
    path: PathBuf,
    /// Until the run has ended in the folder.
    claim: Option<Claim>,
    tables: Tables,
    devices: u32,
}

impl RunFolder {
    /// Makes the folder that `args` names, or the next free one under `runs/`, and marks it as running.
    ///
    /// # Errors
    /// If the folder holds something already, a run is writing there, or it cannot be written to.
    pub fn create(args: &OutputArgs, scenario: &Scenario) -> anyhow::Result<Self> {
        // Before a folder is emptied that may hold them.
        let inputs = Inputs::read(scenario)?;
        if let Some(path) = &args.resume {
            return Self::reopen(path, scenario);
        }
        let (path, mut claim) = if let Some(path) = &args.out {
            (path.clone(), clear(path, args.force)?)
        } else {
            let path = free_name(scenario)?;
            let claim = Claim::take(&path)?;
            (path, claim)
        };
        match fill(&path, &mut claim, &inputs, scenario) {
            Ok(tables) => Ok(Self {
                path,
                claim: Some(claim),
                tables,
                devices: scenario.devices,
            }),
            Err(error) => {
                // What is left of a run that has not begun is in the way of the next one.
                let _emptied = empty(&path).is_ok() && claim.release().is_ok();
                Err(error)
            }
        }
    }

    /// Opens the folder of a run that is to go on. What it holds of the run's results is written anew.
    fn reopen(path: &Path, scenario: &Scenario) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write in the run folder {}", path.display());
        let mut claim = Claim::take(path)?;
        if is_complete(path) {
            claim.withdraw();
            bail!("--resume {}: the run in this folder is complete", path.display());
        }
        claim.mark().with_context(cannot)?;
        remove(path, [SUMMARY, LEARNED, FAILED, DEVICES].into_iter().chain(PARTS))?;
        Ok(Self {
            tables: tables(path).with_context(cannot)?,
            path: path.to_owned(),
            claim: Some(claim),
            devices: scenario.devices,
        })
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The last part of its path, as a name for the run.
    pub fn name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let fits = |c: char| {
            if c.is_ascii_alphanumeric() || c == '-' || c == '_' {
                c
            } else {
                '-'
            }
        };
        let name: String = name.chars().map(fits).skip_while(|&c| c == '-').take(64).collect();
        if name.is_empty() { "run".to_owned() } else { name }
    }

    /// Writes the devices and the summary, and takes the running mark away.
    ///
    /// # Errors
    /// If something cannot be written.
    pub fn finish(mut self, scenario: &Scenario, outcome: &Outcome, summary: &Summary<'_>) -> anyhow::Result<()> {
        let cannot = || format!("cannot write in the run folder {}", self.path.display());
        self.tables.flush().with_context(cannot)?;
        self.write_devices(scenario, outcome).with_context(cannot)?;
        replace(&self.path.join(SUMMARY), summary.to_json()?.as_bytes()).with_context(cannot)?;
        self.claim.take().map_or(Ok(()), Claim::release).with_context(cannot)
    }

    /// Keeps what the policy has learned in the run, if it learns.
    pub fn keep_learned(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let Some(learned) = learned_in(scenario, outcome) else {
            return Ok(());
        };
        replace(&self.path.join(LEARNED), learned.to_json().as_bytes())
            .with_context(|| format!("cannot write in the run folder {}", self.path.display()))
    }

    fn write_devices(&self, scenario: &Scenario, outcome: &Outcome) -> anyhow::Result<()> {
        let mut rows = csv::Writer::from_writer(Vec::new());
        rows.write_record(series::DEVICES)?;
        for device in &outcome.devices {
            rows.write_record(series::device(scenario, device))?;
        }
        let rows = rows.into_inner().context("a table in memory")?;
        Ok(replace(&self.path.join(DEVICES), &rows)?)
    }

    /// Marks the run as failed.
    pub fn fail(mut self, why: &anyhow::Error) {
        self.mark(&format!("{why:#}\n"));
    }

    fn mark(&mut self, why: &str) {
        let Some(claim) = self.claim.take() else { return };
        // The run has failed already; what cannot be written about it is not worth another error.
        let _ = self.tables.flush();
        // Written in place: on a full disk an empty mark is better than none.
        let _ = fs::write(self.path.join(FAILED), why);
        let _ = claim.release();
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        self.mark("the run ended without its summary; its error is on the standard error of the command\n");
    }
}

impl Observer for RunFolder {
    fn see(&mut self, happening: &Happening<'_>) {
        if let Happening::EventEnded(event) = happening {
            self.tables.add(EVENT, series::event(event));
        }
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        if window.end > window.first {
            self.tables.add(WINDOW, series::window(self.devices, window));
        }
        self.tables.is_well()
    }
}

/// Puts what a run begins with into a folder.
fn fill(path: &Path, claim: &mut Claim, inputs: &Inputs, scenario: &Scenario) -> anyhow::Result<Tables> {
    let cannot = || format!("cannot write in the run folder {}", path.display());
    claim.mark().with_context(cannot)?;
    inputs.write(path).with_context(cannot)?;
    replace(&path.join(SCENARIO), inputs.to_toml(scenario).as_bytes()).with_context(cannot)?;
    inputs.check(&path.join(SCENARIO), scenario)?;
    tables(path).with_context(cannot)
}

/// The tables that are filled as the run goes.
fn tables(path: &Path) -> anyhow::Result<Tables> {
    let tables = [
        (EVENTS, series::EVENTS.to_vec()),
        (WINDOWS, series::window_columns().collect()),
    ];
    Tables::begin(path, &tables)
}

/// Whether the run in a folder has come to its end.
fn is_complete(path: &Path) -> bool {
    let text = fs::read_to_string(path.join(SUMMARY)).unwrap_or_default();
    serde_json::from_str::<serde_json::Value>(&text).is_ok_and(|summary| summary["status"] == "complete")
}

/// Claims a folder, and empties it of the run that it held, if that is wanted.
fn clear(path: &Path, force: bool) -> anyhow::Result<Claim> {
    // A folder that is no run is not written into.
    if !path.join(RUNNING).exists() {
        check_free(path, force, false)?;
    }
    let claim = Claim::take(path)?;
    // A run may have come and gone meanwhile.
    if let Err(refusal) = check_free(path, force, claim.was_killed()) {
        claim.withdraw();
        return Err(refusal);
    }
    empty(path)?;
    Ok(claim)
}

/// Takes out of a folder what a run has left there, all but its mark.
fn empty(path: &Path) -> anyhow::Result<()> {
    let files = [SUMMARY, LEARNED, FAILED, DEVICES, EVENTS, WINDOWS, INPUTS, MARK];
    // What makes it a run goes last: a folder that could not be emptied can still be replaced.
    remove(path, files.into_iter().chain(PARTS).chain([SCENARIO]))?;
    let inputs = path.join(inputs::FOLDER);
    inputs::remove(path).with_context(|| format!("cannot replace {}", inputs.display()))
}

/// Removes files of a folder, those that are there.
fn remove(path: &Path, names: impl Iterator<Item = &'static str>) -> anyhow::Result<()> {
    for name in names {
        let file = path.join(name);
        if file.exists() {
            fs::remove_file(&file).with_context(|| format!("cannot replace {}", file.display()))?;
        }
    }
    Ok(())
}

/// Refuses a folder that holds something, unless it is a run that may be replaced.
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
        (false, _) => "the folder is not empty; and it is not a run: choose another",
        (true, false) => "the folder is not empty; choose another, or add --force to replace it",
        (true, true) => "the folder holds a run that was killed; choose another, or add --force to replace it",
    };
    bail!("--out {}: {hint}", path.display())
}

/// A folder under `runs/` that does not exist yet. It is made here, so that two runs never share one.
fn free_name(scenario: &Scenario) -> anyhow::Result<PathBuf> {
    fs::create_dir_all("runs").context("cannot create the folder runs here; name another with --out")?;
    let stem = format!("{}-n{}-s{}", scenario.policy.name(), scenario.devices, scenario.seed);
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
    bail!("no free name under runs/")
}
