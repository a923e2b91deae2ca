//! `reveille train dt`: trains a decision transformer on recorded trajectories and writes the model to `--out`.
//!
//! Every evaluation and Ctrl-C save a checkpoint next to `--out`. The same command resumes from it, with the same
//! result, and the finished model replaces it. A checkpoint is refused if the metadata of `read_trajectories` differ.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::ErrorKind;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::bail;
use reveille_bs::policy::dt::model::ModelShape;
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_lab::io::replace;
use reveille_lab::training::checkpoint_path;
use reveille_lab::trajectories::Trajectories;
use reveille_lab::transformer::{DtTrainingConfig, DtTrainingStatus, Trained, TransformerError, train};

use super::q_learning::interruption_error;
use crate::cli::DtArgs;
use crate::commands::resolve_scenario::resolve_with_builtin_policy;
use crate::display::{self, note};
use crate::paths::check_output_path;
use crate::signals::{SignalMode, Signals};

/// Steps between two evaluations on the held-out data. Each one also writes the checkpoint. The help of `--patience`
/// repeats the number.
const EVALUATION_INTERVAL: u64 = 200;

/// Environment variables for a fast training; a variable that is already set keeps its value.
///
/// A training allocates many tensors of a few megabytes. Requesting each from the kernel takes half of the time. A
/// batch is computed on the training's own threads, which the framework's thread pool would only delay.
const ENVIRONMENT: [(&str, &str); 3] = [
    ("MALLOC_MMAP_MAX_", "0"),
    ("MALLOC_TRIM_THRESHOLD_", "4000000000"),
    ("CANDLE_NUM_THREADS", "1"),
];

/// Restarts the command once with [`ENVIRONMENT`], since allocator and framework read it when they start. If that
/// fails, the training is slow. Call it first: the restart repeats the whole command.
fn restart_with_environment() {
    let unset_variables = || {
        ENVIRONMENT
            .into_iter()
            .filter(|(name, _)| std::env::var_os(name).is_none())
    };
    if unset_variables().next().is_some()
        && let Ok(program) = std::env::current_exe()
    {
        let mut restarted = Command::new(program);
        restarted.args(std::env::args_os().skip(1)).envs(unset_variables());
        // Returns only on failure.
        let failed = restarted.exec();
        tracing::debug!(%failed, "cannot restart with the environment for training; training without it");
    }
}

/// Trains the requested model.
pub(super) fn run(args: &DtArgs) -> anyhow::Result<ExitCode> {
    restart_with_environment();
    let training = training_config(args)?;
    if args.out.exists() && !args.force {
        bail!("{}: file exists; use --force to replace it", args.out.display());
    }
    check_output_path(&args.out, "the model")?;
    let (trajectories, metadata) = read_trajectories(args, &training)?;
    let checkpoint_path = checkpoint_path(&args.out);
    let checkpoint_bytes = read_checkpoint(&checkpoint_path)?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    let started = crate::runtime::now();
    let (mut write_error, mut may_continue) = (None, true);
    let mut must_report_resume = checkpoint_bytes.is_some();
    // Returns whether the training continues.
    let mut on_checkpoint = |status: DtTrainingStatus, bytes: &[u8]| {
        if !args.quiet {
            if std::mem::take(&mut must_report_resume) {
                note!("resuming from {}", checkpoint_path.display());
            }
            print_status(&status);
        }
        write_error = replace(&checkpoint_path, bytes).err();
        may_continue = write_error.is_none() && !signals.has_arrived();
        may_continue
    };
    let stop = || signals.has_arrived();
    let trained = match train(
        trajectories,
        &training,
        &metadata,
        checkpoint_bytes.as_deref(),
        &mut on_checkpoint,
        &stop,
    ) {
        Err(error @ TransformerError::Checkpoint(_)) => bail!(
            "{}: {error}; finish that training, remove the file, or use another --out",
            checkpoint_path.display()
        ),
        trained => trained?,
    };
    // Stopped between two checkpoints: the steps since the last one are saved as well.
    if let Trained::Stopped(bytes) = &trained {
        write_error = replace(&checkpoint_path, bytes).err();
    }
    if let Some(error) = write_error {
        bail!("{}: cannot write this file: {error}", checkpoint_path.display());
    }
    let bytes = match trained {
        Trained::Model(bytes) if may_continue => bytes,
        // An interrupted training also returns its best model so far. It is discarded: the checkpoint contains it.
        Trained::Model(_) | Trained::Stopped(_) => bail!(interruption_error(&checkpoint_path)),
    };
    if let Err(error) = replace(&args.out, &bytes) {
        bail!("{}: cannot write this file: {error}", args.out.display());
    }
    // The finished model replaces the checkpoint.
    let _ = std::fs::remove_file(&checkpoint_path);
    if !args.quiet {
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::print_stdout(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Reads the bytes of the checkpoint, if it exists.
fn read_checkpoint(checkpoint_path: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    match std::fs::read(checkpoint_path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => bail!("{}: {error}", checkpoint_path.display()),
    }
}

/// Prints an evaluation. "In order" is the share of pairs of looks, one that found an event and one that did not, whose
/// expectations are in this order; "by age" is the same share for the baseline of age and α alone.
fn print_status(status: &DtTrainingStatus) {
    let best = if status.is_best { "  best" } else { "" };
    let score = &status.score;
    note!(
        "step {:>6}  loss {:>8.4}  held out: {:.4} nats, in order {:.1} % (by age {:.1} %), wake-ups {:.4} nats, price \
         off by {:.3}{best}",
        status.step,
        status.loss,
        score.look_gain,
        100.0 * score.accuracy,
        100.0 * score.plain_accuracy,
        score.wake_gain,
        score.price_error
    );
}

fn training_config(args: &DtArgs) -> anyhow::Result<DtTrainingConfig> {
    if !(args.rate > 0.0 && args.rate <= 1.0) {
        bail!("--rate {}: must be above 0 and at most 1", args.rate);
    }
    let scenario = resolve_with_builtin_policy(&args.scenario())?;
    // `DtArgs::scenario` sets the policy.
    let settings: &DtSettings = scenario
        .policy
        .settings()
        .downcast_ref()
        .expect("a scenario of the policy dt");
    Ok(DtTrainingConfig {
        shape: ModelShape {
            attends_to_devices: args.attend_to_devices,
            objective: args.objective(),
            ..settings.weights.shape()
        },
        steps: args.steps,
        batch_device_ttis: args.batch as usize,
        learning_rate: args.rate,
        evaluation_interval: EVALUATION_INTERVAL,
        patience: args.patience,
        seed: args.seed,
    })
}

/// Reads the trajectories and returns them with the metadata for the model's file. The metadata also identify a
/// checkpoint, so a change of a text here makes all older checkpoints invalid.
fn read_trajectories(
    args: &DtArgs,
    training: &DtTrainingConfig,
) -> anyhow::Result<(Vec<Trajectories>, BTreeMap<String, String>)> {
    let (mut all_trajectories, mut metadata) = (Vec::new(), BTreeMap::new());
    let mut data_text = String::new();
    for path in &args.trajectories {
        let (trajectories, hash) = match Trajectories::read(path) {
            Ok(read) => read,
            Err(error) => bail!("{}: {error}", path.display()),
        };
        let _ = writeln!(data_text, "sha256 {hash}");
        for (key, value) in &trajectories.about {
            let _ = writeln!(data_text, "{key}: {value}");
        }
        all_trajectories.push(trajectories);
    }
    metadata.insert("data".to_owned(), data_text);
    // With the version in the metadata, another version cannot resume the checkpoint.
    metadata.insert("training".to_owned(), training.to_json());
    metadata.insert(
        "made_by".to_owned(),
        concat!("reveille ", env!("CARGO_PKG_VERSION")).to_owned(),
    );
    Ok((all_trajectories, metadata))
}
