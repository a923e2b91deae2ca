//! `reveille bench study`: the time of some seeds of the paper's study, and from it the time of the whole study.
//! `docs/benchmarks.md` quotes the table.

use std::path::Path;
use std::process::ExitCode;

use reveille_common::io::Disk;
use reveille_lab::sweep::{ExperimentBuilder, Shard, Sweep, SweepGrid, SweepProgress};
use reveille_lab::table::Format;

use crate::cli::StudyBenchArgs;
use crate::display;
use crate::runtime::now;

/// Seeds of each policy and number of devices in the whole study (Sec. VI).
const STUDY_SEEDS: u32 = 1000;

/// Runs the benchmark, one row for each policy.
pub(super) fn run(args: &StudyBenchArgs) -> anyhow::Result<ExitCode> {
    let threads = match args.threads {
        Some(threads) => usize::from(threads),
        None => std::thread::available_parallelism()?.get(),
    };
    let seeds = args.seeds;
    let grid = |policy: &String| -> anyhow::Result<SweepGrid> {
        Ok(SweepGrid::new(experiment(policy, seeds)?.build()?, &Disk)?)
    };
    // All of them before the header, since a name may be wrong.
    let grids: Vec<SweepGrid> = args.measured.policies.iter().map(grid).collect::<anyhow::Result<_>>()?;
    display::print_stdout(&format!(
        "preset paper, 10 numbers of devices, 10000 TTIs, {} of {STUDY_SEEDS}, {}\n{:>10} {:>6} {:>9} {:>13}\n",
        display::count_noun(u64::from(seeds), "seed"),
        display::count_noun(threads as u64, "thread"),
        "policy",
        "runs",
        "time, s",
        "all seeds, s"
    ))?;
    let mut study_seconds = 0.0;
    for (policy, grid) in args.measured.policies.iter().zip(&grids) {
        let seconds = sweep_seconds(grid, threads)?;
        let all_seconds = seconds * f64::from(STUDY_SEEDS) / f64::from(seeds);
        study_seconds += all_seconds;
        display::print_stdout(&format!(
            "{policy:>10} {:>6} {seconds:>9.2} {all_seconds:>13.0}\n",
            grid.run_count()
        ))?;
    }
    let minutes = study_seconds / 60.0;
    display::print_stdout(&format!(
        "all {STUDY_SEEDS} seeds of these policies take about {minutes:.1} minutes\n"
    ))?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the study of one policy. `deploy/examples/experiment.toml` has the same numbers of devices, TTIs and seeds.
fn experiment(policy: &str, seeds: u32) -> anyhow::Result<ExperimentBuilder> {
    let text = format!(
        "scenario = \"paper\"\n\
         policies = [\"{policy}\"]\n\
         devices = [10, 20, 40, 60, 80, 100, 130, 160, 200, 250]\n\
         ttis = 10000\n\
         seeds = {seeds}\n"
    );
    Ok(ExperimentBuilder::parse(&text, "the study", Path::new(""))?)
}

/// Runs the sweep and returns its time, the table included.
fn sweep_seconds(grid: &SweepGrid, threads: usize) -> anyhow::Result<f64> {
    let folder = std::env::temp_dir().join(format!("reveille-study-{}", std::process::id()));
    // A killed benchmark leaves its folder, and this process may have the same id. The sweep would resume there.
    let _absent = std::fs::remove_dir_all(&folder).is_err();
    let started = now();
    Sweep::open(grid, Shard::WHOLE, &folder)?.run(threads, Format::Csv, &Unobserved)?;
    let seconds = started.elapsed().as_secs_f64();
    std::fs::remove_dir_all(&folder)?;
    Ok(seconds)
}

/// A sweep that shows no progress and is never stopped.
struct Unobserved;

impl SweepProgress for Unobserved {
    fn planned(&self, _cell: usize, _runs: u64) {}

    fn started(&self, _cell: usize) {}

    fn finished(&self, _cell: usize) {}

    fn should_stop(&self) -> bool {
        false
    }
}
