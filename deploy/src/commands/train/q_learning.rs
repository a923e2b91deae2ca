//! `reveille train q-learning`: tables, learned in memory.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::bail;
use indicatif::ProgressBar;
use reveille_bs::policy::q_learning::learned::{CurvePoint, Entry};
use reveille_bs::scenario::Scenario;
use reveille_lab::io::replace;
use reveille_lab::training::{Trainer, TrainingError, TrainingProgress, checkpoint};

use crate::cli::TrainArgs;
use crate::commands::resolution::resolve;
use crate::display::{self, note};
use crate::paths::check_place;

/// Trains the tables that are asked for.
pub fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve(&args.scenario()?)?;
    let training = args.episodes.training()?;
    let largest = Scenario {
        devices: args.devices.iter().copied().max().unwrap_or(1).max(1),
        ..scenario.clone()
    };
    if training.ttis > largest.longest() {
        bail!(
            "--episode-ttis {}: must be at most {} with {} devices and their energies, or sums of energy overflow",
            training.ttis,
            largest.longest(),
            largest.devices
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
            "{} episodes left, going on from {}",
            trainer.episodes_left(),
            kept.display()
        );
    }
    let threads = args.episodes.threads()?;
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let shown = Shown {
        bar: display::bar(
            trainer.episodes_left(),
            "{bar:24} {pos}/{len} episodes  {msg}",
            args.quiet,
        ),
        stop,
    };
    let started = crate::wall::now();
    let complete = trainer.train_keeping(threads, &kept, &shown)?;
    shown.bar.finish_and_clear();
    if !complete {
        bail!(Interrupted(kept));
    }
    if args.out.exists() && !args.force {
        note!("what was learned is kept in {}", kept.display());
        bail!(TrainingError::Taken(args.out.clone()));
    }
    let learned = trainer.learned();
    replace(&args.out, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
        path: args.out.clone(),
        error,
    })?;
    // What is in the file is in the checkpoint's place now.
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
                display::out(&format!(
                    "{:<12} N = {:<5} reward {reward:.4}  info (P1) {information:.4}  energy {energy:.4}\n",
                    entry.lookback.label(),
                    entry.devices
                ))?;
            }
        }
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::out(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Ctrl-C has ended a training; the file is its checkpoint.
#[derive(Debug)]
pub struct Interrupted(pub PathBuf);

impl std::fmt::Display for Interrupted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.0.exists() {
            let kept = self.0.display();
            write!(
                f,
                "interrupted; what was learned is kept in {kept}: give the same command again to go on"
            )
        } else {
            f.write_str("interrupted before there was anything to keep")
        }
    }
}

impl std::error::Error for Interrupted {}

/// Shows the progress.
struct Shown {
    bar: ProgressBar,
    stop: Arc<AtomicBool>,
}

impl TrainingProgress for Shown {
    fn episode(&self, entry: &Entry, point: &CurvePoint) {
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
        self.stop.load(Ordering::Relaxed)
    }
}
