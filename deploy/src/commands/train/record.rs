//! `reveille train record`: trajectories of many runs in memory.

use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::bail;
use reveille_common::io::Disk;
use reveille_lab::sweep::{Grid, Shard};
use reveille_lab::training::checkpoint;
use reveille_lab::trajectories::{Recording, record, write};

use super::q_learning::Interrupted;
use crate::cli::RecordArgs;
use crate::commands::experiment::experiment;
use crate::commands::paths::check_place;
use crate::display::{self, note};

/// Records the runs that are asked for.
pub fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let grid = Grid::new(experiment(args.experiment.as_deref(), &args.grid)?, &Disk)?;
    let recording = recording(args)?;
    if grid.experiment.until_ci.is_some() {
        bail!("--until-ci: a recording makes all of its runs; leave it out");
    }
    if args.out.exists() && !args.force {
        bail!("{}: is there already; --force replaces it", args.out.display());
    }
    check_place(&args.out, "the trajectories")?;
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let bar = display::bar(grid.share(Shard::WHOLE), "{bar:24} {pos}/{len} runs", args.quiet);
    let trajectories = record(&grid, &recording, &|| stop.load(Ordering::Relaxed), &|| bar.inc(1));
    bar.finish_and_clear();
    let Some(trajectories) = trajectories else {
        // There is no checkpoint: a recording is begun anew.
        bail!(Interrupted(checkpoint(&args.out)));
    };
    if trajectories.chunks.is_empty() {
        bail!(
            "nothing was recorded: runs must be longer than --chunk {} and the 20 TTIs of a return, and the genie \
             decides by what no base station knows",
            args.chunk
        );
    }
    if let Err(error) = write(&args.out, &trajectories) {
        bail!("{}: {error}", args.out.display());
    }
    if !args.quiet {
        let rows: usize = trajectories
            .chunks
            .iter()
            .map(|chunk| chunk.devices * chunk.steps.len())
            .sum();
        note!(
            "{} of {rows} device-TTIs",
            display::count(trajectories.chunks.len(), "chunk")
        );
    }
    display::out(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

fn recording(args: &RecordArgs) -> anyhow::Result<Recording> {
    if args.every < args.chunk {
        bail!(
            "--every {}: must be at least --chunk, {}, or chunks would overlap",
            args.every,
            args.chunk
        );
    }
    if args.explore.is_empty() {
        bail!("--explore: must be a share or several, such as 0,0.1");
    }
    if let Some(bad) = args.explore.iter().find(|share| !(0.0..1.0).contains(*share)) {
        bail!("--explore {bad}: must be at least 0 and less than 1");
    }
    Ok(Recording {
        length: args.chunk as usize,
        stride: args.every as usize,
        explore: args.explore.clone(),
    })
}
