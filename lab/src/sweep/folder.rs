//! The folder of a sweep.
//!
//! | file | what |
//! |---|---|
//! | `experiment.toml` | the experiment; `reveille sweep FOLDER/experiment.toml` runs it again |
//! | `experiment.scenario.toml` | its scenario file, if it has one |
//! | `runs.journal` | a line for every finished run; what a sweep that was cut short goes on from |
//! | `results.parquet` or `results.csv` | the table, once all runs are there |
//!
//! The number of seeds in the journal's first line is what counts. When it is raised, it is so first; then the table of
//! fewer seeds goes, and `experiment.toml` is written. A folder that was left in between is one that can be gone on
//! with.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use reveille_common::io::Disk;

use super::draft::Draft;
use super::engine::{CellEnd, SweepProgress, run};
use super::error::SweepError;
use super::experiment::Experiment;
use super::grid::Grid;
use super::journal::{Job, Journal, Keeper as _};
use super::reuse::Known;
use super::shard::Shard;
use crate::io::{read, replace, with_names};
use crate::table::{About, Format, Hash, Row, Table, TableError};

const EXPERIMENT: &str = "experiment.toml";
const SCENARIO: &str = "experiment.scenario.toml";
const JOURNAL: &str = "runs.journal";
const RESULTS: &str = "results";

/// A sweep in its folder, ready to go or to go on.
#[derive(Debug)]
pub struct Sweep<'g> {
    grid: &'g Grid,
    shard: Shard,
    folder: PathBuf,
    journal: Journal,
    found: usize,
}

/// The result of a sweep.
#[derive(Debug)]
pub struct Finished {
    /// The table.
    pub table: Table,
    /// The path of the table.
    pub path: PathBuf,
    /// How each cell ended.
    pub cells: Vec<CellEnd>,
}

impl<'g> Sweep<'g> {
    /// Opens `folder` for `grid`, or makes it. It may hold the same sweep with fewer seeds, whose runs are taken over.
    ///
    /// # Errors
    /// The folder holds something else, another sweep or more seeds, another process is at work in it, it cannot be
    /// used, or shards are asked for together with `until_ci`.
    pub fn open(grid: &'g Grid, shard: Shard, folder: &Path) -> Result<Self, SweepError> {
        grid.check_shard(shard)?;
        let refused = |reason: String| SweepError::Folder {
            folder: folder.to_owned(),
            reason,
        };
        let unusable = |error: std::io::Error| {
            refused(format!(
                "cannot be used: {error}; free some space, mend the permissions, or choose another folder"
            ))
        };
        for name in with_names(folder).map_err(unusable)? {
            let is_ours = name.to_str().is_some_and(|name| {
                let name = name.strip_suffix(".part").unwrap_or(name);
                [EXPERIMENT, SCENARIO, JOURNAL].contains(&name) || name.starts_with(RESULTS)
            });
            if !is_ours && !folder.join(JOURNAL).exists() {
                let name = name.to_string_lossy();
                return Err(refused(format!(
                    "holds `{name}` and no sweep; choose an empty or a new folder"
                )));
            }
        }
        let (cells, seeds) = (grid.cells.len() as u64, grid.experiment.seeds.count);
        let path = folder.join(JOURNAL);
        let is_known = path.exists();
        let journal = Journal::open(&path, &identity(grid, shard), cells, seeds).map_err(refused)?;
        let unwritable = |error: std::io::Error| {
            refused(format!(
                "cannot be written: {error}; its finished runs are kept: free some space or mend the permissions, then \
                 give the same command again"
            ))
        };
        if is_known {
            remove_stale(grid, folder).map_err(unwritable)?;
        }
        describe(grid, folder).map_err(unwritable)?;
        let mut sweep = Self {
            found: 0,
            grid,
            shard,
            folder: folder.to_owned(),
            journal,
        };
        sweep.found = sweep.done();
        Ok(sweep)
    }

    /// Finished runs that the folder held when it was opened.
    pub fn found(&self) -> usize {
        self.found
    }

    /// Lines of the journal that were torn or garbled, and have been taken out when the folder was opened.
    pub fn dropped(&self) -> usize {
        self.journal.dropped()
    }

    /// Finished runs.
    pub fn done(&self) -> usize {
        self.journal.runs().keys().filter(|job| self.holds(**job)).count()
    }

    /// Takes the runs that are missing here and are in `known`, as if they had been made, and says how many.
    ///
    /// # Errors
    /// The journal cannot be written.
    pub fn take_over(&mut self, known: &Known) -> Result<usize, SweepError> {
        if known.is_empty() {
            return Ok(0);
        }
        let seeds = self.grid.experiment.seeds;
        let mut taken = 0;
        for (number, cell) in self.grid.cells.iter().enumerate() {
            for seed in self.shard.seeds(number as u64, seeds.count) {
                let job = Job {
                    cell: number as u32,
                    seed: seed as u32,
                };
                if self.journal.runs().contains_key(&job) {
                    continue;
                }
                let scenario = cell.with_seed(seeds.first + seed);
                if let Some(entry) = known.run(Hash(scenario.hash())) {
                    self.journal.add(job, entry.clone(), 0)?;
                    taken += 1;
                }
            }
        }
        self.journal.sync()?;
        self.found += taken;
        Ok(taken)
    }

    fn holds(&self, job: Job) -> bool {
        self.shard.holds(u64::from(job.cell), u64::from(job.seed))
    }

    /// Makes the runs that are missing on `threads` threads and writes the table; `None` if the observer has stopped
    /// it.
    ///
    /// # Errors
    /// The disk is full or fails; finished runs are kept.
    pub fn run(
        &mut self,
        threads: usize,
        format: Format,
        observer: &impl SweepProgress,
    ) -> Result<Option<Finished>, SweepError> {
        let Some(cells) = run(self.grid, self.shard, threads, &mut self.journal, observer)? else {
            return Ok(None);
        };
        let table = self.table(&cells);
        let path = results(&self.folder, format);
        table.write(&path, format).map_err(|error| match error {
            TableError::Write { .. } => SweepError::Results {
                folder: self.folder.clone(),
                kept: self.done(),
                error,
            },
            TableError::Read { .. }
            | TableError::Encode { .. }
            | TableError::NotOurs { .. }
            | TableError::Version { .. }
            | TableError::Columns { .. }
            | TableError::Broken { .. } => error.into(),
        })?;
        Ok(Some(Finished { table, path, cells }))
    }

    /// The table of the runs that count.
    fn table(&self, ends: &[CellEnd]) -> Table {
        let mut rows = Vec::with_capacity(self.journal.runs().len());
        for (number, (cell, end)) in self.grid.cells.iter().zip(ends).enumerate() {
            let cell_number = number as u32;
            let place = |seed: u64| Job {
                cell: cell_number,
                seed: seed as u32,
            };
            let (preset, policy) = (
                Arc::<str>::from(cell.scenario.preset.as_str()),
                Arc::<str>::from(cell.scenario.policy.name()),
            );
            let runs = self.journal.runs().range(place(0)..place(end.runs));
            for (job, entry) in runs.filter(|(job, _)| self.holds(**job)) {
                rows.push(Row {
                    scenario_hash: entry.scenario_hash,
                    preset: Arc::clone(&preset),
                    policy: Arc::clone(&policy),
                    n: cell.scenario.devices,
                    ttis: cell.scenario.ttis,
                    seed: self.grid.experiment.seeds.first + u64::from(job.seed),
                    swept: Arc::clone(&cell.swept),
                    metrics: entry.metrics,
                    events: entry.events,
                    digest: entry.digest,
                });
            }
        }
        Table {
            about: About {
                version: env!("CARGO_PKG_VERSION").to_owned(),
                experiment: self.grid.experiment.to_toml(),
                grid: self.grid.fingerprint().to_string(),
                shard: (self.shard != Shard::WHOLE).then(|| self.shard.to_string()),
            },
            schema: self.grid.schema.clone(),
            rows,
        }
    }
}

/// Writes the experiment into its folder, so that it can be run again from there alone.
fn describe(grid: &Grid, folder: &Path) -> std::io::Result<()> {
    let mut text = grid.experiment.to_toml();
    if let Some(scenario) = grid.experiment.scenario_text(&Disk)? {
        describe_in(&folder.join(SCENARIO), &scenario)?;
        text = format!("scenario_copy = \"{SCENARIO}\"\n{text}");
    }
    describe_in(&folder.join(EXPERIMENT), &text)
}

/// Writes a file that does not say `text` yet: a full disk is no harm to one that does.
fn describe_in(path: &Path, text: &str) -> std::io::Result<()> {
    if read(path).is_ok_and(|found| found == text.as_bytes()) {
        return Ok(());
    }
    replace(path, text.as_bytes())
}

/// Where the table of the sweep in `folder` is.
fn results(folder: &Path, format: Format) -> PathBuf {
    folder.join(format!("{RESULTS}.{}", format.ending()))
}

/// Takes tables away that are not of all the runs of `grid`: those of fewer seeds.
fn remove_stale(grid: &Grid, folder: &Path) -> std::io::Result<()> {
    let experiment = grid.experiment.to_toml();
    for format in [Format::Parquet, Format::Csv] {
        let path = results(folder, format);
        let is_own = || About::read(&path).is_ok_and(|about| about.experiment == experiment);
        if path.exists() && !is_own() {
            Table::remove(&path, format)?;
        }
    }
    Ok(())
}

/// The table of the sweep in `folder`.
///
/// # Errors
/// There is none, or it is of fewer seeds than the folder's experiment asks for.
pub fn table_in(folder: &Path) -> Result<PathBuf, SweepError> {
    let refused = |reason: String| SweepError::NoTable {
        folder: folder.to_owned(),
        reason,
    };
    let found = [Format::Parquet, Format::Csv].map(|format| results(folder, format));
    let Some(table) = found.into_iter().find(|path| path.exists()) else {
        return Err(refused(if folder.join(JOURNAL).exists() {
            "its sweep is not finished; give its command again to go on with it".to_owned()
        } else {
            "the folder holds no table of a sweep".to_owned()
        }));
    };
    let seeds = |draft: Draft| draft.finish().map(|experiment| experiment.seeds.count);
    let asked = Draft::load(&folder.join(EXPERIMENT)).and_then(seeds).ok();
    // If the table cannot be read, who reads it says so.
    let about = About::read(&table).ok().filter(|about| !about.experiment.is_empty());
    let held = about.and_then(|about| {
        let draft = Draft::parse(&about.experiment, "its experiment", Path::new(""));
        draft.and_then(seeds).ok()
    });
    if let (Some(asked), Some(held)) = (asked, held)
        && asked != held
    {
        let name = table.file_name().unwrap_or_default().to_string_lossy();
        return Err(refused(format!(
            "its {EXPERIMENT} asks for {asked} seeds a cell, but {name} holds {held}; give the command of its sweep \
             again, or name the table itself"
        )));
    }
    Ok(table)
}

/// Seeds of each cell that the sweep in `folder` is for, if it is that of `grid` and `shard`, with any number of them.
pub fn seeds_in(grid: &Grid, shard: Shard, folder: &Path) -> Option<u64> {
    Journal::seeds(&folder.join(JOURNAL), &identity(grid, shard))
}

/// What tells the sweeps of folders apart: all but how many seeds a cell has, which may be raised.
fn identity(grid: &Grid, shard: Shard) -> String {
    let mut experiment = grid.experiment.clone();
    experiment.seeds.count = 0;
    let hash = hash_of(grid, &experiment);
    format!("{} {hash} {shard}", env!("CARGO_PKG_VERSION"))
}

/// SHA-256 over the experiment, its number of seeds included, and the scenarios of its cells; hexadecimal.
pub fn hash(grid: &Grid) -> String {
    hash_of(grid, &grid.experiment)
}

fn hash_of(grid: &Grid, experiment: &Experiment) -> String {
    use sha2::{Digest, Sha256};
    let mut sum = Sha256::new();
    sum.update(grid.fingerprint().0);
    sum.update(experiment.to_toml());
    crate::table::Hash(sum.finalize().into()).to_string()
}
