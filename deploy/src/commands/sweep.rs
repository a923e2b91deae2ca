//! `reveille sweep`: many runs in memory.

mod progress;
mod report;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::bail;
use reveille_common::io::Disk;
use reveille_lab::sweep::{Grid, Known, Shard, Sweep, hash, seeds_in};
use reveille_lab::table::Table;

use super::experiment::experiment;
use crate::cli::SweepArgs;
use crate::display::{self, note};
use progress::Progress;
use report::Report;

/// Time between two looks for a signal.
const LOOK: Duration = Duration::from_millis(50);
/// How long a sweep may take to end by itself after a signal.
const GRACE: Duration = Duration::from_secs(1);

/// Runs a sweep, or goes on with it.
pub fn run(args: &SweepArgs) -> anyhow::Result<ExitCode> {
    let mut grid = Grid::new(experiment(args.experiment.as_deref(), &args.grid)?, &Disk)?;
    let shard = args.shard.unwrap_or(Shard::WHOLE);
    grid.check_shard(shard)?;
    let folder = folder(args, &mut grid, shard);
    warn(&grid);
    if args.dry_run {
        display::out(&report::dry_run(args, &grid, shard, &folder)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    let threads = threads(args)?;
    let known = known(&args.reuse)?;
    let mut sweep = Sweep::open(&grid, shard, &folder)?;
    announce(args, &sweep, &folder);
    let taken = sweep.take_over(&known)?;
    if taken > 0 && !args.quiet {
        note!("{} taken over by --reuse", display::count(taken, "run"));
    }
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let progress = Arc::new(Progress::start(&grid, shard, threads, sweep.found(), &stop, args.quiet));
    let insistent = runtime.spawn(insist(stop, Arc::clone(&progress), sweep.found(), folder.clone()));
    let started = crate::wall::now();
    let ended = sweep.run(threads, args.format.into(), &*progress);
    insistent.abort();
    let seconds = started.elapsed().as_secs_f64();
    let device_ttis = progress.finish();
    let Some(finished) = ended? else {
        bail!(Interrupted {
            done: sweep.done(),
            folder,
        });
    };
    let report = Report {
        grid: &grid,
        finished: &finished,
        folder: &folder,
        found: sweep.found(),
        seconds,
        device_ttis,
        threads,
    };
    if args.json {
        display::out(&report.to_json()?)?;
    } else if args.quiet {
        display::out(&format!("{}\n", finished.path.display()))?;
    } else {
        display::out(&report.to_text())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The runs that the tables of `--reuse` hold.
fn known(tables: &[PathBuf]) -> anyhow::Result<Known> {
    let read = |given: &PathBuf| {
        let path = crate::paths::table_of(given)?;
        let table = Table::read(&path)?;
        anyhow::Ok((path, table))
    };
    let tables: Vec<(PathBuf, Table)> = tables.iter().map(read).collect::<Result<_, _>>()?;
    Ok(Known::of(&tables)?)
}

/// Says what the scenarios of cells warn of, each thing once.
fn warn(grid: &Grid) {
    let warnings = grid.cells.iter().flat_map(|cell| &cell.scenario.warnings);
    for warning in warnings.collect::<BTreeSet<_>>() {
        tracing::warn!("{warning}");
    }
}

/// Ends the program when the sweep has not ended by itself soon after a signal: a run that is being set up does not
/// look for one, and with a million devices or a search before it that takes a while. Finished runs are in the journal.
async fn insist(stop: Arc<AtomicBool>, progress: Arc<Progress>, found: usize, folder: PathBuf) {
    while !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(LOOK).await;
    }
    tokio::time::sleep(GRACE).await;
    progress.finish();
    let done = found + progress.runs();
    note!("reveille: {}", Interrupted { done, folder });
    crate::exit::Exit::Interrupted.now();
}

/// Ctrl-C has ended a sweep.
#[derive(Debug)]
pub struct Interrupted {
    done: usize,
    folder: PathBuf,
}

impl std::fmt::Display for Interrupted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (done, folder) = (display::count(self.done, "finished run"), self.folder.display());
        let are = if self.done == 1 { "is" } else { "are" };
        write!(
            f,
            "interrupted; the {done} {are} kept in {folder}: give the same command again to go on"
        )
    }
}

impl std::error::Error for Interrupted {}

/// Says what was found in the folder, on standard error: standard output is for results.
fn announce(args: &SweepArgs, sweep: &Sweep<'_>, folder: &Path) {
    let folder = folder.display();
    if sweep.dropped() > 0 {
        let rows = display::count(sweep.dropped(), "row");
        let (were, have) = if sweep.dropped() == 1 {
            ("was", "has")
        } else {
            ("were", "have")
        };
        tracing::warn!(
            "{rows} of {folder}/runs.journal {were} torn or garbled and {have} been taken out; \
             runs that are missing are made again"
        );
    }
    if sweep.found() > 0 && !args.quiet {
        note!("{} found in {folder}", display::count(sweep.found(), "finished run"));
    }
}

fn threads(args: &SweepArgs) -> anyhow::Result<usize> {
    Ok(match args.threads {
        Some(threads) => usize::from(threads),
        None => std::thread::available_parallelism()?.get(),
    })
}

/// The folder that the command line names, or that whose own experiment file it names if that goes on there, or one
/// named after the experiment.
fn folder(args: &SweepArgs, grid: &mut Grid, shard: Shard) -> PathBuf {
    let own = args.experiment.as_deref().and_then(|file| {
        let parent = file.parent().filter(|_| file.ends_with("experiment.toml"))?;
        let own = if parent == Path::new("") {
            Path::new(".")
        } else {
            parent
        };
        Some((own.to_owned(), seeds_in(grid, shard, own)?))
    });
    let is_asked_for = |own: &Path| args.out.as_deref().is_none_or(|out| crate::paths::is_same(out, own));
    if let Some((own, held)) = own.filter(|(own, _)| is_asked_for(own)) {
        let seeds = &mut grid.experiment.seeds.count;
        if args.grid.seeds.is_none() {
            // What was killed while it raised the seeds may have left an experiment of fewer.
            *seeds = held.max(*seeds);
        }
        if args.out.is_none() {
            // With fewer seeds it is refused there.
            return own;
        }
    }
    args.out.clone().unwrap_or_else(|| {
        let hash = hash(grid);
        let share = if shard == Shard::WHOLE {
            String::new()
        } else {
            format!("-{}of{}", shard.index(), shard.count())
        };
        Path::new("runs").join(format!("sweep-{}{share}", &hash[..12]))
    })
}
