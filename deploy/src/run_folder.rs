//! The run folder: the files that a run writes. The names and contents are documented in `docs/results.md`. `run`, `up`
//! and `bs` create it, `run_reader` reads it.
//!
//! A new file needs an entry in `RESULT_FILES`. It also needs one in `RunFolder::reopen` if it must not survive the
//! start of a resumed run, and one in `PART_FILES` if `reveille_lab::io::replace` writes it.
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
//! | `inputs.log` | external inputs: removals under `--on-loss continue`, decisions of `external`, actions |
//! | `resume.json` | the resume mark for `--resume`; removed once the run is complete |
//! | `address.json` | the name and the address on the bus, for `--resume`; removed once the run is complete |
//! | `RUNNING` | exists and is locked during the run; left behind by a killed run |
//! | `FAILED` | the reason why a run ended without a summary |

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::Buckets;
use reveille_common::score::WindowRecord;
use reveille_lab::io::replace;
use reveille_lab::training::learned_tables_of;

use crate::cli::OutputArgs;
use crate::exit;
use crate::folder_lock::{FolderLock, RUNNING_FILE};
use crate::input_log::INPUT_LOG_FILE;
use crate::paths::check_output_folder;
use crate::recording::RECORDING_EXTENSION;
use crate::resume_mark::RESUME_MARK_FILE;
use crate::run_tables;
use crate::saved_address::{ADDRESS_FILE, run_name};
use crate::scenario_files::{self, ScenarioFiles};
use crate::summary::Summary;
use crate::table_writer::TableWriter;

/// The reason why a run failed.
const FAILED_FILE: &str = "FAILED";
/// The resolved scenario.
pub(crate) const SCENARIO_FILE: &str = "scenario.toml";
/// The results of the run.
pub(crate) const SUMMARY_FILE: &str = "summary.json";
const LEARNED_FILE: &str = "learned.json";
pub(crate) const DEVICES_FILE: &str = "devices.csv";
pub(crate) const EVENTS_FILE: &str = "events.csv";
pub(crate) const WINDOWS_FILE: &str = "windows.csv";
/// Indices of the two tables in [`TableWriter`], by their order in `begin_tables`.
const EVENTS_TABLE: usize = 0;
const WINDOWS_TABLE: usize = 1;
/// The files of a run, except the scenario and the running mark.
const RESULT_FILES: [&str; 9] = [
    SUMMARY_FILE,
    LEARNED_FILE,
    FAILED_FILE,
    DEVICES_FILE,
    EVENTS_FILE,
    WINDOWS_FILE,
    INPUT_LOG_FILE,
    RESUME_MARK_FILE,
    ADDRESS_FILE,
];
/// Part files that a run killed during a write may have left.
const PART_FILES: [&str; 7] = [
    "address.json.part",
    "inputs.log.part",
    "resume.json.part",
    "scenario.toml.part",
    "summary.json.part",
    "learned.json.part",
    "devices.csv.part",
];

/// The folder of an active run, which ends with [`Self::finish`] or [`Self::fail`]. A drop before that marks the run as
/// failed.
pub(crate) struct RunFolder {
    path: PathBuf,
    /// The lock, until the run has ended.
    lock: Option<FolderLock>,
    tables: TableWriter,
    /// The positions of the devices, in the order of ids.
    positions: Buckets,
    devices: u32,
}

impl RunFolder {
    /// Creates the folder that `args` names, or the next free one under `runs/`, and marks it as running. With
    /// `--resume` it reopens the folder of that run instead.
    ///
    /// # Errors
    /// If the folder is not empty (with `--force`: and holds no run), the run to resume has finished, a run is writing
    /// there, or it cannot be written to.
    pub(crate) fn create(args: &OutputArgs, scenario: &Scenario) -> anyhow::Result<Self> {
        // Read before the folder is emptied, since it can hold these files.
        let files = ScenarioFiles::read(scenario)?;
        if let Some(path) = &args.resume {
            return Self::reopen(path, scenario);
        }
        let (path, mut lock) = if let Some(path) = &args.out {
            check_output_folder("--out", path)?;
            (path.clone(), lock_and_clear(path, args.force)?)
        } else {
            let path = create_free_folder(scenario)?;
            let lock = FolderLock::acquire(&path)?;
            (path, lock)
        };
        match write_first_files(&path, &mut lock, &files, scenario) {
            Ok(tables) => Ok(Self {
                path,
                lock: Some(lock),
                tables,
                positions: device_positions(scenario),
                devices: scenario.run.devices,
            }),
            Err(error) => {
                // The files of a run that did not begin would block the next one.
                let _emptied = remove_run(&path).is_ok() && lock.release().is_ok();
                Err(error)
            }
        }
    }

    /// Opens the folder of a run to resume. Its result files are written from the start.
    fn reopen(path: &Path, scenario: &Scenario) -> anyhow::Result<Self> {
        let write_error = || format!("cannot write in the run folder {}", path.display());
        let mut lock = FolderLock::acquire(path)?;
        // Under the lock, so that no other run can complete it meanwhile.
        if is_complete(path) {
            lock.abandon();
            bail!("--resume {}: the run in this folder has finished", path.display());
        }
        lock.mark_running().with_context(write_error)?;
        remove_files(
            path,
            [SUMMARY_FILE, LEARNED_FILE, FAILED_FILE, DEVICES_FILE]
                .into_iter()
                .chain(PART_FILES),
        )?;
        Ok(Self {
            tables: begin_tables(path).with_context(write_error)?,
            path: path.to_owned(),
            lock: Some(lock),
            positions: device_positions(scenario),
            devices: scenario.run.devices,
        })
    }

    /// The path of the folder.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The name of a run in it, see [`run_name`].
    pub(crate) fn name(&self) -> String {
        run_name(&self.path)
    }

    /// Writes the devices and the summary, and removes the running mark. Call [`Self::write_learned`] and close the
    /// recording first: with the summary the folder counts as complete.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub(crate) fn finish(
        mut self,
        scenario: &Scenario,
        outcome: &RunOutcome,
        summary: &Summary<'_>,
    ) -> anyhow::Result<()> {
        let write_error = || format!("cannot write in the run folder {}", self.path.display());
        // The summary comes after all other files.
        self.tables.flush().with_context(write_error)?;
        self.write_devices(scenario, outcome).with_context(write_error)?;
        replace(&self.path.join(SUMMARY_FILE), summary.to_json()?.as_bytes()).with_context(write_error)?;
        if outcome.is_complete {
            remove_files(&self.path, [ADDRESS_FILE].into_iter()).with_context(write_error)?;
        }
        self.lock
            .take()
            .map_or(Ok(()), FolderLock::release)
            .with_context(write_error)
    }

    /// Writes the tables that the policy learned in the run, if it learns. Call it before [`Self::finish`].
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn write_learned(&self, scenario: &Scenario, outcome: &RunOutcome) -> anyhow::Result<()> {
        let Some(learned) = learned_tables_of(scenario, outcome) else {
            return Ok(());
        };
        replace(&self.path.join(LEARNED_FILE), learned.to_json().as_bytes())
            .with_context(|| format!("cannot write in the run folder {}", self.path.display()))
    }

    fn write_devices(&self, scenario: &Scenario, outcome: &RunOutcome) -> anyhow::Result<()> {
        let mut rows = csv::Writer::from_writer(Vec::new());
        rows.write_record(run_tables::DEVICE_COLUMNS)?;
        for device in &outcome.devices {
            rows.write_record(run_tables::device_row(scenario, device))?;
        }
        let rows = rows.into_inner().context("a table in memory")?;
        Ok(replace(&self.path.join(DEVICES_FILE), &rows)?)
    }

    /// Marks the run as failed, with the reason, and removes the running mark.
    pub(crate) fn fail(mut self, reason: &anyhow::Error) {
        self.mark_failed(&format!("{reason:#}\n"));
    }

    fn mark_failed(&mut self, reason: &str) {
        let Some(lock) = self.lock.take() else { return };
        // The run has failed already, so errors in writing about it are ignored.
        let _ = self.tables.flush();
        // Written in place: on a full disk an empty mark is better than none.
        let _ = fs::write(self.path.join(FAILED_FILE), reason);
        let _ = lock.release();
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        let cause = match exit::last_panic() {
            Some(panic) => format!("{panic}; this is a bug in Reveille, please report it"),
            None => "the run failed without a summary; its error is on the standard error of the command".to_owned(),
        };
        self.mark_failed(&format!("{cause}\n"));
    }
}

impl Observer for RunFolder {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::EventEnded(event) = notification {
            self.tables
                .add(EVENTS_TABLE, run_tables::event_row(event, &self.positions));
        }
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        if window.end > window.first {
            self.tables
                .add(WINDOWS_TABLE, run_tables::window_row(self.devices, window));
        }
        self.tables.has_no_error()
    }
}

/// Writes the first files of a run into a folder.
fn write_first_files(
    path: &Path,
    lock: &mut FolderLock,
    files: &ScenarioFiles,
    scenario: &Scenario,
) -> anyhow::Result<TableWriter> {
    let write_error = || format!("cannot write in the run folder {}", path.display());
    lock.mark_running().with_context(write_error)?;
    files.write(path).with_context(write_error)?;
    replace(&path.join(SCENARIO_FILE), files.to_toml(scenario).as_bytes()).with_context(write_error)?;
    files.check(&path.join(SCENARIO_FILE), scenario)?;
    begin_tables(path).with_context(write_error)
}

/// Returns the positions of the devices of `scenario`, for searches by distance.
fn device_positions(scenario: &Scenario) -> Buckets {
    let positions = Deployment::new(scenario).positions();
    Buckets::new(&positions, scenario.area, scenario.sensing.d_max)
}

/// Opens the tables that grow during the run.
fn begin_tables(path: &Path) -> anyhow::Result<TableWriter> {
    let tables = [
        (EVENTS_FILE, run_tables::EVENT_COLUMNS.to_vec()),
        (WINDOWS_FILE, run_tables::window_columns().collect()),
    ];
    TableWriter::begin(path, &tables)
}

/// Whether the run in a folder is complete, by the `status` of its summary ([`Summary::status`]).
pub(crate) fn is_complete(path: &Path) -> bool {
    let text = fs::read_to_string(path.join(SUMMARY_FILE)).unwrap_or_default();
    serde_json::from_str::<serde_json::Value>(&text).is_ok_and(|summary| summary["status"] == "complete")
}

/// Locks a folder, and removes an earlier run from it with `force`.
fn lock_and_clear(path: &Path, force: bool) -> anyhow::Result<FolderLock> {
    // Refused before the lock is acquired, since acquiring it creates RUNNING.
    if !path.join(RUNNING_FILE).exists() {
        check_free(path, force, false)?;
    }
    let lock = FolderLock::acquire(path)?;
    // Checked again under the lock: another run may have used the folder meanwhile.
    if let Err(refusal) = check_free(path, force, lock.was_killed()) {
        lock.abandon();
        return Err(refusal);
    }
    remove_run(path)?;
    Ok(lock)
}

/// Whether a file of this name holds results of a run, its scenario or its inputs.
pub(crate) fn is_result_file(name: &str) -> bool {
    let is_internal = [RESUME_MARK_FILE, ADDRESS_FILE].contains(&name);
    name == SCENARIO_FILE || RESULT_FILES.contains(&name) && !is_internal
}

/// Whether a run writes or locks a file of this name in its folder.
pub(crate) fn is_run_file(name: &str) -> bool {
    let mut names = RESULT_FILES.into_iter().chain(PART_FILES);
    [SCENARIO_FILE, scenario_files::FOLDER, RUNNING_FILE].contains(&name) || names.any(|own| own == name)
}

/// Removes the files of a run from a folder, except the running mark.
fn remove_run(path: &Path) -> anyhow::Result<()> {
    // scenario.toml goes last: a half-emptied folder must still count as a run, which --force may replace.
    remove_files(path, RESULT_FILES.into_iter().chain(PART_FILES).chain([SCENARIO_FILE]))?;
    let files_folder = path.join(scenario_files::FOLDER);
    scenario_files::remove(path).with_context(|| format!("cannot replace {}", files_folder.display()))
}

/// Removes the files that exist from a folder.
fn remove_files(path: &Path, names: impl Iterator<Item = &'static str>) -> anyhow::Result<()> {
    for name in names {
        let file = path.join(name);
        if file.exists() {
            fs::remove_file(&file).with_context(|| format!("cannot replace {}", file.display()))?;
        }
    }
    Ok(())
}

/// Returns the run folder that holds the recording `path`; another path unchanged.
pub(crate) fn of_recording(path: &Path) -> PathBuf {
    let is_recording = path.is_file() && path.extension().is_some_and(|end| end == RECORDING_EXTENSION);
    match path
        .parent()
        .filter(|folder| is_recording && folder.join(SCENARIO_FILE).is_file())
    {
        Some(folder) if folder == Path::new("") => PathBuf::from("."),
        Some(folder) => folder.to_owned(),
        None => path.to_owned(),
    }
}

/// Returns the first line of the reason why the run in `folder` failed; `None` without a failed run.
pub(crate) fn failure(folder: &Path) -> Option<String> {
    let text = fs::read_to_string(folder.join(FAILED_FILE)).ok()?;
    text.lines().next().map(str::to_owned)
}

/// Returns an error for a folder with content, unless it holds a run that may be replaced: with `force`, a folder with
/// `scenario.toml`, or with the mark of a run that `was_killed`.
fn check_free(path: &Path, force: bool, was_killed: bool) -> anyhow::Result<()> {
    let Ok(files) = fs::read_dir(path) else {
        return Ok(());
    };
    let is_running_file = |file: &fs::DirEntry| file.file_name() == RUNNING_FILE;
    if files.flatten().all(|file| is_running_file(&file)) {
        return Ok(());
    }
    let is_run = was_killed || path.join(SCENARIO_FILE).exists();
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

/// Creates a new folder under `runs/`, with the name that the help of `--out` states. It is created here, so that two
/// runs never share one.
fn create_free_folder(scenario: &Scenario) -> anyhow::Result<PathBuf> {
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
            Err(error) => {
                return Err(error).with_context(|| format!("cannot create the run folder {}", path.display()));
            }
        }
    }
    bail!("no free name under runs/; name a folder with --out")
}

#[cfg(test)]
mod tests {
    use clap::{Args, FromArgMatches};
    use reveille_bs::scenario::load;

    use super::*;

    #[test]
    fn a_panic_during_a_run_is_the_reason_of_its_failure() {
        exit::keep_panic_messages();
        let base = std::env::temp_dir().join(format!("reveille-panic-{}", std::process::id()));
        let path = base.join("run");
        let args = output_args(&path);
        let scenario = load("quick", &[]).expect("a scenario").scenario;
        let run = std::thread::spawn(move || {
            let _folder = RunFolder::create(&args, &scenario).expect("a folder");
            panic!("the ledger of device 3 is not balanced");
        });
        run.join().expect_err("it panics");
        let reason = fs::read_to_string(path.join(FAILED_FILE)).expect("a reason");
        assert!(reason.starts_with("panicked at deploy/src/run_folder.rs:"), "{reason}");
        assert!(
            reason.contains(": the ledger of device 3 is not balanced; "),
            "{reason}"
        );
        assert_eq!(failure(&path).as_deref(), Some(reason.trim_end()));
        fs::remove_dir_all(base).expect("removed");
    }

    /// Returns the result options of a run in the folder `path`.
    fn output_args(path: &Path) -> OutputArgs {
        let command = OutputArgs::augment_args(clap::Command::new("run"));
        let matches = command.get_matches_from(["run", "--out", &path.to_string_lossy()]);
        OutputArgs::from_arg_matches(&matches).expect("options")
    }
}
