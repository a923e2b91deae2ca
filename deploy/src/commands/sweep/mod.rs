//! `reveille sweep`: many runs in memory.

mod progress;
mod report;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::bail;
use reveille_common::io::Disk;
use reveille_lab::sweep::{ReusableRuns, Shard, Sweep, SweepGrid, hash, seeds_in};
use reveille_lab::table::Table;

use super::experiment::experiment;
use crate::cli::SweepArgs;
use crate::display::{self, note};
use crate::exit::Interrupted;
use crate::signals::{Manner, Signals};
use progress::SweepDisplay;
use report::SweepSummary;

/// Runs or resumes a sweep.
pub(crate) fn run(args: &SweepArgs) -> anyhow::Result<ExitCode> {
    let mut grid = SweepGrid::new(experiment(args.experiment.as_deref(), &args.grid)?, &Disk)?;
    let shard = args.shard.unwrap_or(Shard::WHOLE);
    grid.check_shard(shard)?;
    let folder = folder(args, &mut grid, shard);
    warn(&grid);
    if args.dry_run {
        display::print(&report::dry_run(args, &grid, shard, &folder)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    let threads = threads(args)?;
    let known = known(&args.reuse)?;
    let signals = Signals::install(Manner::Keeps)?;
    let mut sweep = Sweep::open(&grid, shard, &folder)?;
    announce(args, &sweep, &folder);
    // Before the progress starts, since reused runs count as found.
    let taken = sweep.reuse(&known)?;
    if taken > 0 && !args.quiet {
        note!("{} taken over by --reuse", display::count(taken, "run"));
    }
    let progress = SweepDisplay::start(&grid, shard, threads, sweep.found(), &signals, args.quiet);
    let progress = Arc::new(progress);
    let insistence = signals.insist(last_words(Arc::clone(&progress), sweep.found(), folder.clone()))?;
    let started = crate::runtime::now();
    let ended = sweep.run(threads, args.format.into(), &*progress);
    drop(insistence);
    let seconds = started.elapsed().as_secs_f64();
    let device_ttis = progress.finish();
    let Some(finished) = ended? else {
        bail!(interrupted(sweep.done(), &folder));
    };
    let report = SweepSummary {
        grid: &grid,
        finished: &finished,
        folder: &folder,
        found: sweep.found(),
        seconds,
        device_ttis,
        threads,
    };
    if args.json {
        display::print(&report.to_json()?)?;
    } else if args.quiet {
        display::print(&format!("{}\n", finished.path.display()))?;
    } else {
        display::print(&report.to_text())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads the runs in the tables of `--reuse`.
fn known(tables: &[PathBuf]) -> anyhow::Result<ReusableRuns> {
    let read = |given: &PathBuf| {
        let path = crate::paths::table_of(given)?;
        let table = Table::read(&path)?;
        anyhow::Ok((path, table))
    };
    let tables: Vec<(PathBuf, Table)> = tables.iter().map(read).collect::<Result<_, _>>()?;
    Ok(ReusableRuns::from_tables(&tables)?)
}

/// Prints each distinct warning of all cells.
fn warn(grid: &SweepGrid) {
    let warnings = grid.cells.iter().flat_map(|cell| &cell.warnings);
    for warning in warnings.collect::<BTreeSet<_>>() {
        tracing::warn!("{warning}");
    }
}

/// Returns the message for a sweep that does not end soon after a signal. A run in set-up does not check for signals,
/// and a million devices or a search can make that long. Finished runs are in the journal.
fn last_words(progress: Arc<SweepDisplay>, found: usize, folder: PathBuf) -> impl FnOnce() -> String {
    move || {
        progress.finish();
        let done = found + progress.runs();
        interrupted(done, &folder).to_string()
    }
}

/// The error of a sweep ended by a signal, with `done` finished runs in `folder`.
fn interrupted(done: usize, folder: &Path) -> Interrupted {
    let are = if done == 1 { "is" } else { "are" };
    let (done, folder) = (display::count(done, "finished run"), folder.display());
    let text = format!("interrupted; the {done} {are} kept in {folder}: give the same command again to resume");
    Interrupted(text.into())
}

/// Reports the content found in the folder on standard error: standard output is for results.
fn announce(args: &SweepArgs, sweep: &Sweep<'_>, folder: &Path) {
    let folder = folder.display();
    if sweep.dropped() > 0 {
        let rows = display::count(sweep.dropped(), "row");
        let (were, have) = if sweep.dropped() == 1 {
            ("was", "has")
        } else {
            ("were", "have")
        };
        tracing::warn!("{folder}/runs.journal: {rows} {were} damaged and {have} been removed; their runs are repeated");
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

/// Returns the folder that the command line names. Otherwise it is the folder of the given experiment file if the sweep
/// resumes there, or a folder named after the experiment.
fn folder(args: &SweepArgs, grid: &mut SweepGrid, shard: Shard) -> PathBuf {
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
            // A kill while seeds were added can leave an experiment.toml with fewer seeds than the journal.
            *seeds = held.max(*seeds);
        }
        if args.out.is_none() {
            // Opening the journal refuses fewer seeds than it holds.
            return own;
        }
    }
    args.out.clone().unwrap_or_else(|| {
        // The hash covers the number of seeds: a short trial gets another folder and cannot block the full sweep.
        let hash = hash(grid);
        let share = if shard == Shard::WHOLE {
            String::new()
        } else {
            format!("-{}of{}", shard.index(), shard.count())
        };
        Path::new("runs").join(format!("sweep-{}{share}", &hash[..12]))
    })
}
