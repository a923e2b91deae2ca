//! `reveille train record`: trajectories of many runs in memory.

use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::bail;
use reveille_bs::scenario::load;
use reveille_common::io::Disk;
use reveille_lab::sweep::{Grid, Shard};
use reveille_lab::training::checkpoint;
use reveille_lab::trajectories::{Chunk, HORIZON, Recording, Trajectories, record, record_again, write};

use super::q_learning::Interrupted;
use crate::claim::{Standing, standing};
use crate::cli::RecordArgs;
use crate::commands::experiment::experiment;
use crate::display::{self, note};
use crate::paths::check_place;
use crate::results::{SCENARIO, SUMMARY};

/// Records the runs that are asked for.
pub fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let recording = recording(args)?;
    if args.out.exists() && !args.force {
        bail!("{}: is there already; --force replaces it", args.out.display());
    }
    check_place(&args.out, "the trajectories")?;
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let stop = || stop.load(Ordering::Relaxed);
    let trajectories = if args.from.is_empty() {
        of_grid(args, &recording, &stop)?
    } else {
        of_folders(args, &recording, &stop)?
    };
    let Some(trajectories) = trajectories else {
        // There is no checkpoint: a recording is begun anew.
        bail!(Interrupted(checkpoint(&args.out)));
    };
    if trajectories.chunks.is_empty() {
        bail!(
            "nothing was recorded: runs must be longer than --chunk {} and the {HORIZON} TTIs of a return, and the \
             genie decides by what no base station knows",
            args.chunk
        );
    }
    if let Err(error) = write(&args.out, &trajectories) {
        bail!("{}: {error}", args.out.display());
    }
    if !args.quiet {
        let rows: usize = trajectories.chunks.iter().map(Chunk::device_ttis).sum();
        note!(
            "{} of {rows} device-TTIs",
            display::count(trajectories.chunks.len(), "chunk")
        );
    }
    display::out(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// The runs of a grid.
fn of_grid(
    args: &RecordArgs,
    recording: &Recording,
    stop: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<Option<Trajectories>> {
    let grid = Grid::new(experiment(args.experiment.as_deref(), &args.grid)?, &Disk)?;
    if grid.experiment.until_ci.is_some() {
        bail!("--until-ci: a recording makes all of its runs; leave it out");
    }
    let bar = display::bar(grid.share(Shard::WHOLE), "{bar:24} {pos}/{len} runs", args.quiet);
    let trajectories = record(&grid, recording, stop, &|| bar.inc(1));
    bar.finish_and_clear();
    Ok(trajectories)
}

/// Runs that were made before, from their folders.
fn of_folders(
    args: &RecordArgs,
    recording: &Recording,
    stop: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<Option<Trajectories>> {
    let (mut chunks, mut runs) = (Vec::new(), String::new());
    for (run, folder) in (0..).zip(&args.from) {
        let path = folder.join(SCENARIO);
        if !path.exists() {
            bail!("{}: is no run folder: it has no {SCENARIO}", folder.display());
        }
        let scenario = load(&path.to_string_lossy(), &[])?;
        let digest = digest(folder)?;
        let Some((found, of_run)) = record_again(&scenario, run, recording, stop) else {
            return Ok(None);
        };
        let Some(found) = found else {
            bail!(
                "{}: a run of the genie, which decides by what no base station knows: nothing can be learned from it",
                folder.display()
            );
        };
        if found.to_string() != digest {
            bail!(
                "{}: the scenario there gives the digest {found}, and its summary has {digest}: the run was cut short, \
                 made by another version, or one of the files was changed",
                folder.display()
            );
        }
        chunks.extend(of_run);
        let _ = writeln!(runs, "{digest}");
    }
    let about = vec![
        ("runs".to_owned(), runs),
        ("recording".to_owned(), format!("{recording:?}")),
    ];
    Ok(Some(Trajectories { about, chunks }))
}

/// The digest in the summary of the run folder.
fn digest(folder: &Path) -> anyhow::Result<String> {
    let path = folder.join(SUMMARY);
    let refuse = |why: String| anyhow::anyhow!("{}: {why}", path.display());
    match standing(folder) {
        Standing::Ended => {}
        Standing::Alive(_) => bail!(
            "{}: its run is still going on; wait until it has ended",
            folder.display()
        ),
        Standing::Killed => bail!("{}: its run was killed, so it has no digest", folder.display()),
    }
    let text = std::fs::read_to_string(&path).map_err(|error| refuse(error.to_string()))?;
    let summary: serde_json::Value = serde_json::from_str(&text).map_err(|error| refuse(error.to_string()))?;
    let digest = summary["digest"].as_str().map(str::to_owned);
    digest.ok_or_else(|| refuse("has no digest".to_owned()))
}

fn recording(args: &RecordArgs) -> anyhow::Result<Recording> {
    if args.every <= args.chunk {
        bail!(
            "--every {}: must be more than --chunk, {}, or one chunk would run into the next",
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
        told: args.told,
    })
}
