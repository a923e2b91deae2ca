//! `reveille sweep`: many runs in memory, one per combination of values and seed. `lab/src/sweep/` runs them and keeps
//! the journal; this module chooses the folder and shows progress and results. A repeated command finds its journal by
//! the default folder, `runs/sweep-HASH` (`docs/sweeps.md`), so a change of the name or the hash loses it.

mod progress;
mod report;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::bail;
use reveille_common::io::Disk;
use reveille_lab::sweep::{ReusableRuns, Shard, Sweep, SweepActions, SweepGrid, experiment_hash, read_seed_count};
use reveille_lab::table::Table;

use super::experiment::build_experiment;
use crate::cli::SweepArgs;
use crate::display::{self, note};
use crate::exit::Interrupted;
use crate::paths::check_output_folder;
use crate::signals::{SignalMode, Signals};
use progress::SweepDisplay;
use report::SweepSummary;

/// Runs or resumes a sweep.
pub(crate) fn run(args: &SweepArgs) -> anyhow::Result<ExitCode> {
    let mut experiment = build_experiment(args.experiment.as_deref(), &args.grid)?;
    if let Some(script) = &args.actions {
        experiment.actions = Some(SweepActions::File(script.clone()));
    }
    let mut grid = SweepGrid::new(experiment, &Disk)?;
    let shard = args.shard.unwrap_or(Shard::WHOLE);
    grid.check_shard(shard)?;
    // First, since it can raise the number of seeds in `grid`.
    let folder = choose_folder(args, &mut grid, shard);
    check_output_folder("--out", &folder)?;
    log_warnings(&grid);
    if args.dry_run {
        display::print_stdout(&report::dry_run(args, &grid, shard, &folder)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    let threads = thread_count(args)?;
    let reusable_runs = read_reusable_runs(&args.reuse)?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    let mut sweep = Sweep::open(&grid, shard, &folder)?;
    report_found(args, &sweep, &folder);
    // Before the progress starts, since reused runs count as found.
    let reused = sweep.reuse(&reusable_runs)?;
    if reused > 0 && !args.quiet {
        note!("{} taken over by --reuse", display::count_noun(reused, "run"));
    }
    let progress = SweepDisplay::start(&grid, shard, threads, sweep.known_runs(), &signals, args.quiet);
    let progress = Arc::new(progress);
    let forced_exit =
        signals.force_exit_after_signal(exit_message(Arc::clone(&progress), sweep.known_runs(), folder.clone()))?;
    let started = crate::runtime::now();
    let outcome = sweep.run(threads, args.format.into(), &*progress);
    drop(forced_exit);
    let seconds = started.elapsed().as_secs_f64();
    let device_ttis = progress.finish();
    let Some(sweep_result) = outcome? else {
        bail!(interrupted(sweep.finished_runs(), &folder));
    };
    let summary = SweepSummary {
        grid: &grid,
        result: &sweep_result,
        folder: &folder,
        known_runs: sweep.known_runs(),
        seconds,
        device_ttis,
        threads,
    };
    if args.json {
        display::print_stdout(&summary.to_json()?)?;
    } else if args.quiet {
        display::print_stdout(&format!("{}\n", sweep_result.path.display()))?;
    } else {
        display::print_stdout(&summary.to_text())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads the runs in the tables of `--reuse`.
fn read_reusable_runs(tables: &[PathBuf]) -> anyhow::Result<ReusableRuns> {
    let read = |given: &PathBuf| {
        let path = crate::paths::resolve_table(given)?;
        let table = Table::read(&path)?;
        anyhow::Ok((path, table))
    };
    let tables: Vec<(PathBuf, Table)> = tables.iter().map(read).collect::<Result<_, _>>()?;
    Ok(ReusableRuns::from_tables(&tables)?)
}

/// Prints each distinct warning of all cells.
pub(super) fn log_warnings(grid: &SweepGrid) {
    let warnings = grid.cells.iter().flat_map(|cell| &cell.warnings);
    for warning in warnings.collect::<BTreeSet<_>>() {
        tracing::warn!("{warning}");
    }
}

/// Returns the message for a sweep that does not end soon after a signal. A run in set-up does not check for signals,
/// and a million devices or a search can make that long. Finished runs are in the journal.
fn exit_message(progress: Arc<SweepDisplay>, known_runs: usize, folder: PathBuf) -> impl FnOnce() -> String {
    move || {
        progress.finish();
        let finished_runs = known_runs + progress.finished_runs();
        interrupted(finished_runs, &folder).to_string()
    }
}

/// The error of a sweep ended by a signal, with this number of finished runs in `folder`.
fn interrupted(finished_runs: usize, folder: &Path) -> Interrupted {
    let verb = if finished_runs == 1 { "is" } else { "are" };
    let (runs, folder) = (display::count_noun(finished_runs, "finished run"), folder.display());
    let text = format!("interrupted; the {runs} {verb} kept in {folder}: give the same command again to resume");
    Interrupted(text.into())
}

/// Reports the content found in the folder on standard error: standard output is for results.
fn report_found(args: &SweepArgs, sweep: &Sweep<'_>, folder: &Path) {
    let folder = folder.display();
    if sweep.dropped_lines() > 0 {
        let rows = display::count_noun(sweep.dropped_lines(), "row");
        let (were, have) = if sweep.dropped_lines() == 1 {
            ("was", "has")
        } else {
            ("were", "have")
        };
        tracing::warn!("{folder}/runs.journal: {rows} {were} damaged and {have} been removed; their runs are repeated");
    }
    if sweep.known_runs() > 0 && !args.quiet {
        note!(
            "{} found in {folder}",
            display::count_noun(sweep.known_runs(), "finished run")
        );
    }
}

fn thread_count(args: &SweepArgs) -> anyhow::Result<usize> {
    Ok(match args.threads {
        Some(threads) => usize::from(threads),
        None => std::thread::available_parallelism()?.get(),
    })
}

/// Returns the folder that the command line names. Otherwise it is the folder of the given experiment file if the sweep
/// resumes there, or a folder named after the experiment. If the sweep resumes in the folder of the file without
/// `--seeds`, the seeds of `grid` are raised to the number in the journal.
fn choose_folder(args: &SweepArgs, grid: &mut SweepGrid, shard: Shard) -> PathBuf {
    // The folder of the file, with the seeds in its journal, if it is the folder of this sweep.
    // `lab/src/sweep/folder.rs` names the file.
    let resumable_folder = args.experiment.as_deref().and_then(|file| {
        let parent = file.parent().filter(|_| file.ends_with("experiment.toml"))?;
        let experiment_folder = if parent == Path::new("") {
            Path::new(".")
        } else {
            parent
        };
        Some((
            experiment_folder.to_owned(),
            read_seed_count(grid, shard, experiment_folder)?,
        ))
    });
    let is_requested = |folder: &Path| {
        args.out
            .as_deref()
            .is_none_or(|out| crate::paths::is_same_path(out, folder))
    };
    if let Some((experiment_folder, journal_seeds)) = resumable_folder.filter(|(folder, _)| is_requested(folder)) {
        let seed_count = &mut grid.experiment.seeds.count;
        if args.grid.seeds.is_none() {
            // A kill while seeds were added can leave an experiment.toml with fewer seeds than the journal.
            *seed_count = journal_seeds.max(*seed_count);
        }
        if args.out.is_none() {
            // Opening the journal refuses fewer seeds than it holds.
            return experiment_folder;
        }
    }
    args.out.clone().unwrap_or_else(|| {
        // The hash covers the number of seeds: a short trial gets another folder and cannot block the full sweep.
        let hash = experiment_hash(grid);
        let shard_suffix = if shard == Shard::WHOLE {
            String::new()
        } else {
            format!("-{}of{}", shard.index(), shard.count())
        };
        Path::new("runs").join(format!("sweep-{}{shard_suffix}", &hash[..12]))
    })
}
