//! `reveille train q-learning`: trains tables in memory.

use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use indicatif::ProgressBar;
use reveille_bs::policy::q_learning::learned::{CurvePoint, TableSet};
use reveille_lab::io::replace;
use reveille_lab::training::{Trainer, TrainingError, TrainingProgress, checkpoint};

use crate::cli::TrainArgs;
use crate::commands::resolve_scenario::resolve;
use crate::display::{self, note};
use crate::exit::Interrupted;
use crate::paths::check_place;
use crate::signals::{Manner, Signals};

/// Trains the requested tables.
pub(super) fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve(&args.scenario()?)?;
    let training = args.episodes.training()?;
    let mut largest = scenario.clone();
    largest.run.devices = args.devices.iter().copied().max().unwrap_or(1).max(1);
    if training.ttis > largest.longest() {
        bail!(
            "--episode-ttis {}: must be at most {} with {} devices, or their sums of energy overflow",
            training.ttis,
            largest.longest(),
            largest.run.devices
        );
    }
    let mut trainer = Trainer::new(&scenario, &args.devices, &args.windows, &training)?;
    if args.out.exists() && !args.force {
        bail!(TrainingError::Taken(args.out.clone()));
    }
    check_place(&args.out, "the tables")?;
    let kept = checkpoint(&args.out);
    if trainer.resume(&kept)? && !args.quiet {
        note!(
            "{} episodes left, resuming from {}",
            trainer.episodes_left(),
            kept.display()
        );
    }
    let threads = args.episodes.threads()?;
    let signals = Signals::install(Manner::Keeps)?;
    let shown = TrainingDisplay {
        bar: display::bar(
            trainer.episodes_left(),
            "{bar:24} {pos}/{len} episodes  {msg}",
            args.quiet,
        ),
        signals,
    };
    let started = crate::runtime::now();
    let complete = trainer.train_keeping(threads, &kept, &shown)?;
    shown.bar.finish_and_clear();
    if !complete {
        bail!(interrupted(&kept));
    }
    // Checked again: another process can have written the file during the training.
    if args.out.exists() && !args.force {
        note!("the training so far is kept in {}", kept.display());
        bail!(TrainingError::Taken(args.out.clone()));
    }
    let learned = trainer.learned();
    replace(&args.out, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
        path: args.out.clone(),
        error,
    })?;
    // The finished tables replace the checkpoint.
    let _ = std::fs::remove_file(&kept);
    if !args.quiet {
        for entry in &learned.entries {
            if let Some(CurvePoint {
                reward,
                information,
                energy,
                ..
            }) = entry.curve.last()
            {
                display::print(&format!(
                    "{:<12} N = {:<5} reward {reward:.4}  info (P1) {information:.4}  energy {energy:.4}\n",
                    entry.lookback.label(),
                    entry.devices
                ))?;
            }
        }
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::print(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// The error of a training ended by a signal, whose checkpoint would be `kept`.
pub(super) fn interrupted(kept: &Path) -> Interrupted {
    Interrupted(if kept.exists() {
        let kept = kept.display();
        format!("interrupted; the training so far is kept in {kept}: give the same command again to resume").into()
    } else {
        "interrupted before the first checkpoint".into()
    })
}

/// The progress display.
struct TrainingDisplay {
    bar: ProgressBar,
    signals: Signals,
}

impl TrainingProgress for TrainingDisplay {
    fn episode(&self, entry: &TableSet, point: &CurvePoint) {
        let CurvePoint {
            reward, information, ..
        } = point;
        self.bar.set_message(format!(
            "{}, N = {}: reward {reward:.3}, info (P1) {information:.3}",
            entry.lookback.label(),
            entry.devices
        ));
        self.bar.inc(1);
    }

    fn stop(&self) -> bool {
        self.signals.have_come()
    }
}
