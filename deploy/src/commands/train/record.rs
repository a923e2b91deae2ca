//! `reveille train record`: trajectories for the training of `dt`, from the runs of a grid, or from a repetition in
//! memory of the runs in folders, which must have the same digest. The file stores the entries of `about`, and `dt`
//! copies them into its checkpoint and model; the entry `recording` is the `Debug` text of [`RecordingConfig`], so a
//! renamed field changes it.

use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use reveille_bs::scenario::load;
use reveille_common::io::Disk;
use reveille_lab::sweep::{Shard, SweepGrid};
use reveille_lab::trajectories::{Chunk, HORIZON, RecordingConfig, Trajectories, record, record_from_scenario};

use crate::cli::RecordArgs;
use crate::commands::experiment::build_experiment;
use crate::commands::sweep::log_warnings;
use crate::display::{self, note};
use crate::exit::Interrupted;
use crate::folder_lock::{FolderStatus, status};
use crate::paths::check_output_path;
use crate::run_folder::{SCENARIO_FILE, SUMMARY_FILE};
use crate::signals::{SignalMode, Signals};

/// The error of a recording ended by a signal.
const INTERRUPTED: &str = "interrupted; no trajectories were written";

/// Records the requested runs.
pub(super) fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let config = recording_config(args)?;
    if args.out.exists() && !args.force {
        bail!("{}: file exists; use --force to replace it", args.out.display());
    }
    check_output_path(&args.out, "the trajectories")?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    // A run in set-up does not check for signals, and a search before it may take hours.
    let forced_exit = signals.force_exit_after_signal(|| INTERRUPTED.to_owned())?;
    let stop = || signals.has_arrived();
    let trajectories = if args.from.is_empty() {
        record_grid(args, &config, &stop)?
    } else {
        record_folders(args, &config, &stop)?
    };
    // From here on the file is written, and must not be cut short.
    drop(forced_exit);
    let Some(trajectories) = trajectories else {
        bail!(Interrupted(INTERRUPTED.into()));
    };
    if trajectories.chunks.is_empty() {
        bail!(
            "no chunks recorded: use runs longer than --chunk {} plus the {HORIZON} TTIs of a return, and a policy \
             other than genie, which uses ground truth",
            args.chunk
        );
    }
    if let Err(error) = trajectories.write(&args.out) {
        bail!("{}: {error}", args.out.display());
    }
    if !args.quiet {
        let device_ttis: usize = trajectories.chunks.iter().map(Chunk::device_ttis).sum();
        note!(
            "{} of {device_ttis} device-TTIs",
            display::count_noun(trajectories.chunks.len(), "chunk")
        );
    }
    display::print_stdout(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Records the runs of a grid. Returns `None` once `should_stop` is true.
fn record_grid(
    args: &RecordArgs,
    config: &RecordingConfig,
    should_stop: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<Option<Trajectories>> {
    let grid = SweepGrid::new(build_experiment(args.experiment.as_deref(), &args.grid)?, &Disk)?;
    log_warnings(&grid);
    if grid.experiment.until_ci.is_some() {
        bail!("--until-ci: a recording always makes all runs; leave it out");
    }
    if grid.experiment.actions.is_some() {
        bail!("actions: trajectories have no actions of operators; remove them from the experiment");
    }
    let bar = display::new_bar(
        grid.shard_run_count(Shard::WHOLE),
        "{bar:24} {pos}/{len} runs",
        args.quiet,
    );
    let trajectories = record(&grid, config, should_stop, &|| bar.inc(1));
    bar.finish_and_clear();
    Ok(trajectories)
}

/// Records earlier runs from their folders. Returns `None` once `should_stop` is true.
///
/// # Errors
/// If a folder holds no finished run, or the repeated run has another digest.
fn record_folders(
    args: &RecordArgs,
    config: &RecordingConfig,
    should_stop: &(dyn Fn() -> bool + Sync),
) -> anyhow::Result<Option<Trajectories>> {
    let (mut chunks, mut digest_lines) = (Vec::new(), String::new());
    for (run_index, folder) in (0..).zip(&args.from) {
        let path = folder.join(SCENARIO_FILE);
        if !path.exists() {
            bail!(
                "{}: not a run folder: {SCENARIO_FILE} is missing; name the folder of a run",
                folder.display()
            );
        }
        let scenario = load(&path.to_string_lossy(), &[])?.scenario;
        let digest = read_digest(folder)?;
        let Some((repeated_digest, run_chunks)) = record_from_scenario(&scenario, run_index, config, should_stop)
        else {
            return Ok(None);
        };
        let Some(repeated_digest) = repeated_digest else {
            bail!(
                "{}: a run of genie, which decides by ground truth, cannot be learned from; use a run of another \
                 policy",
                folder.display()
            );
        };
        if repeated_digest.to_string() != digest {
            bail!(
                "{}: the scenario has the digest {repeated_digest}, but the summary has {digest}; use a complete, \
                 unchanged run folder of this version",
                folder.display()
            );
        }
        chunks.extend(run_chunks);
        let _ = writeln!(digest_lines, "{digest}");
    }
    let about = vec![
        ("runs".to_owned(), digest_lines),
        ("recording".to_owned(), format!("{config:?}")),
    ];
    Ok(Some(Trajectories { about, chunks }))
}

/// Reads the digest from the summary of the run folder.
fn read_digest(folder: &Path) -> anyhow::Result<String> {
    let path = folder.join(SUMMARY_FILE);
    let read_error = |cause: String| anyhow::anyhow!("{}: {cause}", path.display());
    match status(folder) {
        FolderStatus::Finished => {}
        FolderStatus::Running(_) => bail!(
            "{}: the run is still running; wait until it has finished",
            folder.display()
        ),
        FolderStatus::Killed => bail!(
            "{}: the run was killed and has no digest; resume it with --resume \
            first",
            folder.display()
        ),
    }
    let text = std::fs::read_to_string(&path).map_err(|error| read_error(error.to_string()))?;
    let summary: serde_json::Value = serde_json::from_str(&text).map_err(|error| read_error(error.to_string()))?;
    let digest = summary["digest"].as_str().map(str::to_owned);
    digest.ok_or_else(|| read_error("the digest is missing".to_owned()))
}

fn recording_config(args: &RecordArgs) -> anyhow::Result<RecordingConfig> {
    if args.stride <= args.chunk {
        bail!(
            "--stride {}: must be more than --chunk {}, so that a gap separates the chunks",
            args.stride,
            args.chunk
        );
    }
    if args.explore.is_empty() {
        bail!("--explore: the list is empty; give one or more shares, such as 0,0.1");
    }
    if let Some(bad) = args.explore.iter().find(|share| !(0.0..1.0).contains(*share)) {
        bail!("--explore {bad}: must be at least 0 and less than 1");
    }
    Ok(RecordingConfig {
        length: args.chunk as usize,
        stride: args.stride as usize,
        explore: args.explore.clone(),
        true_batteries: args.true_batteries,
    })
}
