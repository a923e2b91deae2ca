//! The folder of a sweep.
//!
//! | file | what |
//! |---|---|
//! | `experiment.toml` | the experiment; `reveille sweep FOLDER/experiment.toml` runs it again |
//! | `experiment.scenario.toml` | its scenario file, if it has one |
//! | `runs.journal` | a line for every finished run; what a sweep that was cut short goes on from |
//! | `results.parquet` or `results.csv` | the table, once all runs are there |

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::engine::{CellEnd, Observer, run};
use super::error::SweepError;
use super::grid::Grid;
use super::journal::{Job, Journal};
use super::shard::Shard;
use crate::table::{About, Format, Row, Table, replace};

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

/// What a sweep came to.
#[derive(Debug)]
pub struct Finished {
    /// The table.
    pub table: Table,
    /// Where it was written.
    pub path: PathBuf,
    /// How each cell ended.
    pub cells: Vec<CellEnd>,
}

impl<'g> Sweep<'g> {
    /// Opens `folder` for `grid`, or makes it. It may hold the same sweep with fewer seeds, whose runs are taken over.
    ///
    /// # Errors
    /// The folder holds something else, another sweep or more seeds, another process is at work in it, it cannot be used, or shards are
    /// asked for together with `until_ci`.
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
        fs::create_dir_all(folder).map_err(unusable)?;
        for entry in fs::read_dir(folder).map_err(unusable)? {
            let name = entry.map_err(unusable)?.file_name();
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
        let identity = format!("{} {} {shard}", env!("CARGO_PKG_VERSION"), identity(grid));
        let (cells, seeds) = (grid.cells.len() as u64, grid.experiment.seeds.count);
        let journal = Journal::open(&folder.join(JOURNAL), &identity, cells, seeds).map_err(refused)?;
        describe(grid, folder).map_err(unusable)?;
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

    /// Finished runs. Those that fell to another shard when seeds were added do not count.
    pub fn done(&self) -> usize {
        self.journal.runs().keys().filter(|job| self.holds(job)).count()
    }

    fn holds(&self, job: &Job) -> bool {
        self.shard.holds(u64::from(job.cell), u64::from(job.seed))
    }

    /// Makes the runs that are missing on `threads` threads and writes the table; `None` if the observer has stopped it.
    ///
    /// # Errors
    /// The disk is full or fails; finished runs are kept.
    pub fn run(
        &mut self,
        threads: usize,
        format: Format,
        observer: &impl Observer,
    ) -> Result<Option<Finished>, SweepError> {
        let Some(cells) = run(self.grid, self.shard, threads, &mut self.journal, observer)? else {
            return Ok(None);
        };
        let table = self.table(&cells);
        let path = self.folder.join(format!("{RESULTS}.{}", format.ending()));
        table.write(&path, format)?;
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
            for (job, entry) in runs.filter(|(job, _)| self.holds(job)) {
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
    if let Some(scenario) = grid.experiment.scenario_text()? {
        replace(&folder.join(SCENARIO), scenario.as_bytes())?;
        text = format!("scenario_copy = \"{SCENARIO}\"\n{text}");
    }
    replace(&folder.join(EXPERIMENT), text.as_bytes())
}

/// What tells sweeps apart, hexadecimal: the experiment and the scenarios that it comes to, but for how many seeds a cell
/// has, which may be raised.
pub fn identity(grid: &Grid) -> String {
    use sha2::{Digest, Sha256};
    let mut experiment = grid.experiment.clone();
    experiment.seeds.count = 0;
    let mut sum = Sha256::new();
    sum.update(grid.fingerprint().0);
    sum.update(experiment.to_toml());
    crate::table::Hash(sum.finalize().into()).to_string()
}
