//! The folder of a sweep, from which an interrupted sweep resumes and another machine can repeat it.
//!
//! | file | content |
//! |---|---|
//! | `experiment.toml` | the experiment; `reveille sweep FOLDER/experiment.toml` runs it again |
//! | `experiment.scenario.toml` | its scenario file, if it has one |
//! | `runs.journal` | a line for every finished run, from which an interrupted sweep resumes |
//! | `results.parquet` or `results.csv` | the table, once all runs are complete |
//!
//! `docs/results.md` shows the folder to users; `deploy/src/commands/sweep/` and `python/src/runs.rs` run sweeps, and
//! `deploy/src/commands/compare/sweep.rs` repeats the names. In `sweep`, only this file and the journal do I/O.
//!
//! The number of seeds in the journal's first line is authoritative. To raise it, the journal changes first; then the
//! table of fewer seeds is removed, and `experiment.toml` is written. An interruption in between leaves a folder that
//! can be resumed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use reveille_common::digits::count_noun;
use reveille_common::io::Disk;

use super::error::SweepError;
use super::executor::{CellSummary, SweepProgress, execute_missing};
use super::experiment::{Experiment, SweepActions, describe_difference};
use super::experiment_builder::ExperimentBuilder;
use super::grid::SweepGrid;
use super::journal::{Journal, JournalEntry, RunIndex, RunStore as _};
use super::shard::Shard;
use crate::io::{create_and_list, read, read_short, replace};
use crate::table::{Format, Hash, ResultRow, Table, TableError, TableMetadata};

const EXPERIMENT_FILE: &str = "experiment.toml";
const SCENARIO_FILE: &str = "experiment.scenario.toml";
const JOURNAL_FILE: &str = "runs.journal";
/// The name of the table without its extension.
const TABLE_STEM: &str = "results";

/// A sweep in its folder that can start or resume.
#[derive(Debug)]
pub struct Sweep<'g> {
    grid: &'g SweepGrid,
    shard: Shard,
    folder: PathBuf,
    journal: Journal,
    /// The runs found on opening, plus the reused ones.
    known_runs: usize,
}

/// The result of a sweep.
#[derive(Debug)]
pub struct SweepResult {
    /// The table.
    pub table: Table,
    /// The path of the table.
    pub path: PathBuf,
    /// The summaries of the cells.
    pub cells: Vec<CellSummary>,
}

impl<'g> Sweep<'g> {
    /// Opens or creates `folder` for `grid`. It may hold the same sweep with fewer seeds, whose runs are reused.
    ///
    /// # Errors
    /// If the folder holds other files, another sweep or more seeds, is used by another process, or cannot be used.
    /// Also if shards are combined with `until_ci`.
    pub fn open(grid: &'g SweepGrid, shard: Shard, folder: &Path) -> Result<Self, SweepError> {
        grid.check_shard(shard)?;
        let refused = |reason: String| SweepError::Folder {
            folder: folder.to_owned(),
            reason,
        };
        let unusable = |error: std::io::Error| {
            refused(format!(
                "cannot be used: {error}; free some space, correct the permissions, or choose another folder"
            ))
        };
        for name in create_and_list(folder).map_err(unusable)? {
            let is_ours = name.to_str().is_some_and(|name| {
                // A process that was killed while writing a file leaves NAME.part.
                let name = name.strip_suffix(".part").unwrap_or(name);
                [EXPERIMENT_FILE, SCENARIO_FILE, JOURNAL_FILE].contains(&name)
            });
            if !is_ours && !folder.join(JOURNAL_FILE).exists() {
                let name = name.to_string_lossy();
                return Err(refused(format!(
                    "holds `{name}` but no sweep; choose an empty or a new folder"
                )));
            }
        }
        let (cells, seeds) = (grid.cells.len() as u64, grid.experiment.seeds.count);
        let path = folder.join(JOURNAL_FILE);
        // Checked first, because `open` creates the journal.
        let is_known = path.exists();
        let journal = Journal::open(&path, &sweep_identity(grid, shard), cells, seeds);
        let journal = journal.map_err(|reason| refused(other_actions(grid, folder).unwrap_or(reason)))?;
        let unwritable = |error: std::io::Error| {
            refused(format!(
                "cannot be written: {error}; its finished runs are kept; free some space or correct the permissions, \
                 then give the same command again"
            ))
        };
        // In this order: a process killed in between leaves a folder that the same command resumes.
        if is_known {
            remove_stale_tables(grid, folder).map_err(unwritable)?;
        }
        write_experiment(grid, folder).map_err(unwritable)?;
        let mut sweep = Self {
            known_runs: 0,
            grid,
            shard,
            folder: folder.to_owned(),
            journal,
        };
        sweep.known_runs = sweep.finished_runs();
        Ok(sweep)
    }

    /// The number of finished runs found on opening the folder, plus the reused ones.
    pub fn known_runs(&self) -> usize {
        self.known_runs
    }

    /// The number of torn or garbled journal lines that were removed on opening the folder.
    pub fn dropped_lines(&self) -> usize {
        self.journal.dropped_lines()
    }

    /// The number of finished runs of the shard, known and new.
    pub fn finished_runs(&self) -> usize {
        self.journal
            .runs()
            .keys()
            .filter(|run_index| self.is_in_shard(**run_index))
            .count()
    }

    /// Copies missing runs from `reusable` into the journal, and returns their number.
    ///
    /// # Errors
    /// If the journal cannot be written.
    pub fn reuse(&mut self, reusable: &ReusableRuns) -> Result<usize, SweepError> {
        if reusable.is_empty() {
            return Ok(0);
        }
        let seeds = self.grid.experiment.seeds;
        let script = script_of(self.grid.experiment.actions.as_ref());
        let mut reused_runs = 0;
        for (cell_index, cell) in self.grid.cells.iter().enumerate() {
            for seed in self.shard.seed_indices(cell_index as u64, seeds.count) {
                let run_index = RunIndex {
                    cell: cell_index as u32,
                    seed: seed as u32,
                };
                if self.journal.runs().contains_key(&run_index) {
                    continue;
                }
                let scenario = cell.with_seed(seeds.first + seed);
                if let Some(entry) = reusable.find(script, Hash(scenario.hash())) {
                    // No work is at risk, because the table still holds the run: it does not count towards a sync.
                    self.journal.add(run_index, entry.clone(), 0)?;
                    reused_runs += 1;
                }
            }
        }
        self.journal.sync()?;
        self.known_runs += reused_runs;
        Ok(reused_runs)
    }

    fn is_in_shard(&self, run_index: RunIndex) -> bool {
        self.shard
            .contains(u64::from(run_index.cell), u64::from(run_index.seed))
    }

    /// Executes the missing runs on `threads` threads and writes the table. Returns `None` if `progress` has stopped
    /// it.
    ///
    /// # Errors
    /// If the disk is full or fails; finished runs are kept.
    pub fn run(
        &mut self,
        threads: usize,
        format: Format,
        progress: &impl SweepProgress,
    ) -> Result<Option<SweepResult>, SweepError> {
        let Some(cells) = execute_missing(self.grid, self.shard, threads, &mut self.journal, progress)? else {
            return Ok(None);
        };
        let table = self.build_table(&cells);
        let path = table_path(&self.folder, format);
        table.write(&path, format).map_err(|error| match error {
            TableError::Write { .. } => SweepError::Results {
                folder: self.folder.clone(),
                recorded: self.finished_runs(),
                error,
            },
            TableError::Read { .. }
            | TableError::Encode { .. }
            | TableError::NotOurs { .. }
            | TableError::Version { .. }
            | TableError::Columns { .. }
            | TableError::Broken { .. } => error.into(),
        })?;
        Ok(Some(SweepResult { table, path, cells }))
    }

    fn build_table(&self, summaries: &[CellSummary]) -> Table {
        let mut rows = Vec::with_capacity(self.journal.runs().len());
        for (cell_index, (cell, summary)) in self.grid.cells.iter().zip(summaries).enumerate() {
            let index_of_seed = |seed: u64| RunIndex {
                cell: cell_index as u32,
                seed: seed as u32,
            };
            let (preset, policy) = (
                Arc::<str>::from(cell.scenario.run.preset.as_str()),
                Arc::<str>::from(cell.scenario.policy.name()),
            );
            // With `until_ci` the journal may hold runs beyond the check that ended the cell, such as reused ones.
            let runs = self.journal.runs().range(index_of_seed(0)..index_of_seed(summary.runs));
            for (run_index, entry) in runs.filter(|(run_index, _)| self.is_in_shard(**run_index)) {
                rows.push(ResultRow {
                    scenario_hash: entry.scenario_hash,
                    preset: Arc::clone(&preset),
                    policy: Arc::clone(&policy),
                    n: cell.scenario.run.devices,
                    ttis: cell.scenario.run.ttis,
                    seed: self.grid.experiment.seeds.first + u64::from(run_index.seed),
                    swept: Arc::clone(&cell.swept),
                    metrics: entry.metrics,
                    events: entry.events,
                    digest: entry.digest,
                });
            }
        }
        Table {
            metadata: TableMetadata {
                version: env!("CARGO_PKG_VERSION").to_owned(),
                experiment: self.grid.experiment.to_toml(),
                // Only for the names of changed fields, so a file that has disappeared is no error.
                scenario_fields: self.grid.experiment.scenario_fields(&Disk).ok().flatten(),
                grid_hash: self.grid.fingerprint().to_string(),
                shard: (self.shard != Shard::WHOLE).then(|| self.shard.to_string()),
            },
            schema: self.grid.schema.clone(),
            rows,
        }
    }
}

/// Writes the experiment into the folder, so that the folder alone suffices to repeat it.
fn write_experiment(grid: &SweepGrid, folder: &Path) -> std::io::Result<()> {
    let mut text = grid.experiment.to_toml();
    if let Some(scenario) = grid.experiment.scenario_text(&Disk)? {
        write_if_changed(&folder.join(SCENARIO_FILE), &scenario)?;
        text = format!("scenario_copy = \"{SCENARIO_FILE}\"\n{text}");
    }
    write_if_changed(&folder.join(EXPERIMENT_FILE), &text)
}

/// The lines of a script; empty without actions. [`SweepGrid::new`] has replaced a file by its lines.
fn script_of(actions: Option<&SweepActions>) -> &str {
    match actions {
        Some(SweepActions::Script(text)) => text,
        Some(SweepActions::File(_)) | None => "",
    }
}

/// Explains that the sweep in `folder` has other actions than `grid`; `None` if it has the same ones.
fn other_actions(grid: &SweepGrid, folder: &Path) -> Option<String> {
    let existing = ExperimentBuilder::load(&folder.join(EXPERIMENT_FILE)).ok()?;
    let (own_script, existing_script) = (
        script_of(grid.experiment.actions.as_ref()),
        script_of(existing.actions.as_ref()),
    );
    (own_script != existing_script).then(|| {
        format!(
            "holds the runs of a sweep with other actions: {}; use its script (`action_script` in {EXPERIMENT_FILE} \
             there), or choose another folder",
            describe_difference(own_script, existing_script)
        )
    })
}

/// Writes a file unless it already contains `text`, so that a full disk does no harm to a complete one.
fn write_if_changed(path: &Path, text: &str) -> std::io::Result<()> {
    if read(path).is_ok_and(|bytes| bytes == text.as_bytes()) {
        return Ok(());
    }
    replace(path, text.as_bytes())
}

fn table_path(folder: &Path, format: Format) -> PathBuf {
    folder.join(format!("{TABLE_STEM}.{}", format.extension()))
}

/// Removes tables that lack runs of `grid`, because they have fewer seeds.
fn remove_stale_tables(grid: &SweepGrid, folder: &Path) -> std::io::Result<()> {
    let experiment = grid.experiment.to_toml();
    for format in [Format::Parquet, Format::Csv] {
        let path = table_path(folder, format);
        let is_own = || TableMetadata::read(&path).is_ok_and(|metadata| metadata.experiment == experiment);
        if path.exists() && !is_own() {
            Table::remove(&path, format)?;
        }
    }
    Ok(())
}

/// Returns the path of the table of the sweep in `folder`.
///
/// # Errors
/// If the folder has no table, or the table has another number of seeds than the folder's experiment.
pub fn find_table(folder: &Path) -> Result<PathBuf, SweepError> {
    let refused = |reason: String| SweepError::NoTable {
        folder: folder.to_owned(),
        reason,
    };
    let paths = [Format::Parquet, Format::Csv].map(|format| table_path(folder, format));
    let Some(table) = paths.into_iter().find(|path| path.exists()) else {
        return Err(refused(if folder.join(JOURNAL_FILE).exists() {
            "its sweep is not finished; give its command again to resume it".to_owned()
        } else {
            "it is not the folder of a sweep; name the --out folder of `reveille sweep`".to_owned()
        }));
    };
    let seed_count = |draft: ExperimentBuilder| draft.build().map(|experiment| experiment.seeds.count);
    let requested_seeds = ExperimentBuilder::load(&folder.join(EXPERIMENT_FILE))
        .and_then(seed_count)
        .ok();
    // An unreadable table is not refused here: its reader reports the cause.
    let metadata = TableMetadata::read(&table)
        .ok()
        .filter(|metadata| !metadata.experiment.is_empty());
    let table_seeds = metadata.and_then(|metadata| {
        let draft = ExperimentBuilder::parse(&metadata.experiment, "its experiment", Path::new(""));
        draft.and_then(seed_count).ok()
    });
    if let (Some(requested_seeds), Some(table_seeds)) = (requested_seeds, table_seeds)
        && requested_seeds != table_seeds
    {
        let name = table.file_name().unwrap_or_default().to_string_lossy();
        return Err(refused(format!(
            "its {EXPERIMENT_FILE} asks for {} a cell, but {name} holds {table_seeds}; repeat the \
             command of its sweep, or name the table itself",
            count_noun(requested_seeds, "seed")
        )));
    }
    Ok(table)
}

/// Returns the seeds per cell of the sweep in `folder`, if it belongs to `grid` and `shard`, regardless of their
/// number.
pub fn read_seed_count(grid: &SweepGrid, shard: Shard, folder: &Path) -> Option<u64> {
    Journal::read_seed_count(&folder.join(JOURNAL_FILE), &sweep_identity(grid, shard))
}

/// Returns the identity of a sweep: everything except the seeds per cell, which may be raised. It is part of the
/// journal's first line: after a change, older sweeps cannot be resumed.
fn sweep_identity(grid: &SweepGrid, shard: Shard) -> String {
    let mut experiment = grid.experiment.clone();
    experiment.seeds.count = 0;
    let hash = sweep_hash(grid, &experiment);
    format!("{} {hash} {shard}", env!("CARGO_PKG_VERSION"))
}

/// Returns a SHA-256 over the experiment, its number of seeds included, and the scenarios of its cells; hexadecimal.
/// The default folder of a sweep is named after it: after a change, the same command starts again in another folder.
pub fn experiment_hash(grid: &SweepGrid) -> String {
    sweep_hash(grid, &grid.experiment)
}

fn sweep_hash(grid: &SweepGrid, experiment: &Experiment) -> String {
    use sha2::{Digest, Sha256};
    let mut hasher = Sha256::new();
    hasher.update(grid.fingerprint().0);
    hasher.update(experiment.to_toml());
    Hash(hasher.finalize().into()).to_string()
}

/// The runs of some tables, by the script of actions, empty without one, then by the hash of the scenario, seed
/// included. Both determine a run.
#[derive(Debug, Default)]
pub struct ReusableRuns(BTreeMap<String, BTreeMap<Hash, JournalEntry>>);

impl ReusableRuns {
    /// Collects the runs of `tables`, each with the path it was read from.
    ///
    /// # Errors
    /// If a table was written by another version of the program, whose runs may have other results.
    pub fn from_tables(tables: &[(PathBuf, Table)]) -> Result<Self, SweepError> {
        let mut runs = BTreeMap::<String, BTreeMap<_, _>>::new();
        for (path, table) in tables {
            if table.metadata.version != env!("CARGO_PKG_VERSION") {
                return Err(SweepError::Reuse {
                    path: path.clone(),
                    version: table.metadata.version.clone(),
                });
            }
            let script = table.metadata.action_script().unwrap_or_default();
            let rows = table.rows.iter();
            let entries = rows.map(|row| (row.scenario_hash, JournalEntry::from(row)));
            runs.entry(script).or_default().extend(entries);
        }
        Ok(Self(runs))
    }

    /// Whether there are no runs.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn find(&self, script: &str, hash: Hash) -> Option<&JournalEntry> {
        self.0.get(script)?.get(&hash)
    }
}

/// Length limit of an experiment file, bytes. A script of actions has its own limit; in TOML it can be longer.
const MAX_EXPERIMENT_BYTES: u64 = 8 << 20;

// Here and not with the other methods, because `experiment_builder.rs` does no I/O.
impl ExperimentBuilder {
    /// Reads the experiment file at `path`.
    ///
    /// # Errors
    /// If the file cannot be read, or as for [`ExperimentBuilder::parse`].
    pub fn load(path: &Path) -> Result<Self, SweepError> {
        let text = read_short(path, MAX_EXPERIMENT_BYTES).map_err(|error| SweepError::Read {
            path: path.to_owned(),
            error,
        })?;
        Self::parse(&text, &path.to_string_lossy(), path.parent().unwrap_or(Path::new("")))
    }
}
