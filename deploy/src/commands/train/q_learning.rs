//! `reveille train q-learning`: trains tables in memory. The tables have the same bytes with any number of threads and
//! after any interruption; `docs/training.md` names the checkpoint and its file.

use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use indicatif::ProgressBar;
use reveille_bs::policy::q_learning::learned::{CurvePoint, TableSet};
use reveille_bs::scenario::Scenario;
use reveille_common::digits::format_significant;
use reveille_common::geometry::Layout;
use reveille_lab::io::replace;
use reveille_lab::training::{Trainer, TrainingError, TrainingProgress, checkpoint_path};

use crate::cli::QLearningArgs;
use crate::commands::resolve_scenario::resolve_with_builtin_policy;
use crate::display::{self, count_noun, note};
use crate::exit::Interrupted;
use crate::paths::check_output_path;
use crate::signals::{SignalMode, Signals};

/// The numbers of devices N in the paper (Sec. VI). The help of `--devices` repeats them.
const PAPER_DEVICES: &[u32] = &[10, 20, 40, 60, 80, 100, 130, 160, 200, 250];

/// Trains the requested tables.
pub(super) fn run(args: &QLearningArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve_with_builtin_policy(&args.scenario()?)?;
    let training = args.episodes.training_config()?;
    let devices = training_devices(&args.devices, &scenario)?;
    // The largest N has the lowest limit of TTIs.
    let mut largest_scenario = scenario.clone();
    largest_scenario.run.devices = devices.iter().copied().max().unwrap_or(1).max(1);
    if training.ttis > largest_scenario.max_ttis() {
        bail!(
            "--episode-ttis {}: must be at most {} with {} devices, or their sums of energy overflow",
            training.ttis,
            largest_scenario.max_ttis(),
            largest_scenario.run.devices
        );
    }
    let mut trainer = Trainer::new(&scenario, &devices, &args.windows, &training)?;
    if args.out.exists() && !args.force {
        bail!(TrainingError::FileExists(args.out.clone()));
    }
    check_output_path(&args.out, "the tables")?;
    let checkpoint_path = checkpoint_path(&args.out);
    if trainer.resume(&checkpoint_path)? && !args.quiet {
        note!(
            "resuming the training from the checkpoint {}: {} left",
            checkpoint_path.display(),
            count_noun(trainer.episodes_left(), "episode")
        );
    }
    let threads = args.episodes.threads()?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    let training_display = TrainingDisplay {
        bar: display::new_bar(
            trainer.episodes_left(),
            "{bar:24} {pos}/{len} episodes  {msg}",
            args.quiet,
        ),
        signals,
    };
    let started = crate::runtime::now();
    let is_complete = trainer.train_and_save(threads, &checkpoint_path, &training_display)?;
    training_display.bar.finish_and_clear();
    if !is_complete {
        bail!(interruption_error(&checkpoint_path));
    }
    // Checked again: another process can have written the file during the training.
    if args.out.exists() && !args.force {
        note!("the training so far is kept in {}", checkpoint_path.display());
        bail!(TrainingError::FileExists(args.out.clone()));
    }
    let learned = trainer.learned();
    replace(&args.out, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
        path: args.out.clone(),
        error,
    })?;
    // The finished tables replace the checkpoint.
    let _ = std::fs::remove_file(&checkpoint_path);
    if !args.quiet {
        for table_set in &learned.entries {
            if let Some(CurvePoint {
                reward,
                information,
                energy,
                ..
            }) = table_set.curve.last()
            {
                let [reward, information, energy] = [reward, information, energy].map(|x| format_significant(*x, 4));
                display::print_stdout(&format!(
                    "{:<12} N = {:<5} reward {reward}  info (P1) {information}  energy {energy}\n",
                    table_set.lookback.label(),
                    table_set.devices
                ))?;
            }
        }
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::print_stdout(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the numbers of devices to train for: the `requested` ones, or by default the paper's. A layout from a file
/// has only one.
fn training_devices(requested: &[u32], scenario: &Scenario) -> anyhow::Result<Vec<u32>> {
    if !matches!(scenario.layout, Layout::File(_)) {
        return Ok(if requested.is_empty() { PAPER_DEVICES } else { requested }.to_vec());
    }
    let positions = scenario.run.devices;
    match requested.iter().find(|devices| **devices != positions) {
        Some(devices) => bail!(
            "--devices {devices}: layout.file has {}; leave out --devices",
            count_noun(positions, "position")
        ),
        None => Ok(vec![positions]),
    }
}

/// The error of a training ended by a signal, whose checkpoint would be at `checkpoint_path`. `dt` uses it too.
pub(super) fn interruption_error(checkpoint_path: &Path) -> Interrupted {
    Interrupted(if checkpoint_path.exists() {
        let checkpoint_path = checkpoint_path.display();
        format!("interrupted; the training so far is kept in {checkpoint_path}: give the same command again to resume")
            .into()
    } else {
        "interrupted before the first checkpoint".into()
    })
}

/// The progress bar of a training, which a signal stops.
struct TrainingDisplay {
    bar: ProgressBar,
    signals: Signals,
}

impl TrainingProgress for TrainingDisplay {
    fn episode_ended(&self, table_set: &TableSet, point: &CurvePoint) {
        let CurvePoint {
            reward, information, ..
        } = point;
        self.bar.set_message(format!(
            "{}, N = {}: reward {reward:.3}, info (P1) {information:.3}",
            table_set.lookback.label(),
            table_set.devices
        ));
        self.bar.inc(1);
    }

    fn should_stop(&self) -> bool {
        self.signals.has_arrived()
    }
}
