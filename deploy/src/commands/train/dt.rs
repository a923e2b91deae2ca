//! `reveille train dt`: a decision transformer from recorded trajectories.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::ErrorKind;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::atomic::Ordering;

use anyhow::bail;
use reveille_bs::policy::dt::model::shape::Shape;
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_lab::io::replace;
use reveille_lab::training::checkpoint;
use reveille_lab::trajectories::{Trajectories, read};
use reveille_lab::transformer::{Progress, Training, TransformerError, train};

use super::q_learning::Interrupted;
use crate::cli::DtArgs;
use crate::commands::resolution::resolve;
use crate::display::{self, note};
use crate::paths::check_place;

/// Steps between two looks at what is held out.
const EVERY: u64 = 200;

/// What the environment has to say for a training to be fast, where it does not say otherwise.
///
/// A training makes many tensors of a few megabytes and drops them again: to ask the kernel for each takes half of the
/// time. And it computes the parts of a batch on threads of its own, which the framework's pool would only keep waiting
/// for each other.
const ENVIRONMENT: [(&str, &str); 3] = [
    ("MALLOC_MMAP_MAX_", "0"),
    ("MALLOC_TRIM_THRESHOLD_", "4000000000"),
    ("CANDLE_NUM_THREADS", "1"),
];

/// Becomes the same command in an environment that suits it, once: allocator and framework look at theirs when they
/// start. Where that cannot be done the training is slow.
fn settle_in() {
    let unset = || {
        ENVIRONMENT
            .into_iter()
            .filter(|(name, _)| std::env::var_os(name).is_none())
    };
    if unset().next().is_some()
        && let Ok(program) = std::env::current_exe()
    {
        let mut again = Command::new(program);
        again.args(std::env::args_os().skip(1)).envs(unset());
        let failed = again.exec();
        tracing::debug!(%failed, "trains as it is");
    }
}

/// Trains the model that is asked for.
pub fn run(args: &DtArgs) -> anyhow::Result<ExitCode> {
    settle_in();
    let training = training(args)?;
    if args.out.exists() && !args.force {
        bail!("{}: is there already; --force replaces it", args.out.display());
    }
    check_place(&args.out, "the model")?;
    let (trajectories, about) = trajectories(args, &training)?;
    let kept = checkpoint(&args.out);
    let from = kept_bytes(&kept)?;
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let started = crate::wall::now();
    let (mut unwritten, mut complete) = (None, true);
    let mut goes_on = from.is_some();
    let mut show = |now: Progress, bytes: &[u8]| {
        if !args.quiet {
            if std::mem::take(&mut goes_on) {
                note!("going on from {}", kept.display());
            }
            show(&now);
        }
        unwritten = replace(&kept, bytes).err();
        complete = unwritten.is_none() && !stop.load(Ordering::Relaxed);
        complete
    };
    let bytes = match train(trajectories, &training, &about, from.as_deref(), &mut show) {
        Err(error @ TransformerError::Checkpoint(_)) => bail!(
            "{}: {error}; finish that, remove the file, or use another --out",
            kept.display()
        ),
        trained => trained?,
    };
    if let Some(error) = unwritten {
        bail!("{}: cannot be written: {error}", kept.display());
    }
    if !complete {
        bail!(Interrupted(kept));
    }
    if let Err(error) = replace(&args.out, &bytes) {
        bail!("{}: cannot be written: {error}", args.out.display());
    }
    // What is in the file is in the checkpoint's place now.
    let _ = std::fs::remove_file(&kept);
    if !args.quiet {
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::out(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// The bytes of the checkpoint, if there is one.
fn kept_bytes(kept: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    match std::fs::read(kept) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => bail!("{}: {error}", kept.display()),
    }
}

fn show(now: &Progress) {
    let best = if now.is_best { "  best" } else { "" };
    let score = &now.score;
    note!(
        "step {:>6}  loss {:>8.4}  held out: {:.4} nats, in order {:.1} % (by age {:.1} %), wake-ups {:.4} nats, price \
         off by {:.3}{best}",
        now.step,
        now.loss,
        score.looks,
        100.0 * score.accuracy,
        100.0 * score.plain_accuracy,
        score.wakes,
        score.price_error
    );
}

fn training(args: &DtArgs) -> anyhow::Result<Training> {
    if !(args.rate > 0.0 && args.rate <= 1.0) {
        bail!("--rate {}: must be above 0 and at most 1", args.rate);
    }
    let scenario = resolve(&args.scenario())?;
    let settings: &DtSettings = scenario.policy.settings().expect("a scenario of the policy dt");
    Ok(Training {
        shape: Shape {
            has_space: !args.no_space,
            objective: args.objective(),
            ..settings.weights.shape()
        },
        steps: args.steps,
        batch: args.batch as usize,
        rate: args.rate,
        every: EVERY,
        patience: args.patience,
        seed: args.seed,
    })
}

/// The trajectories, and what the model's file is to say of them.
fn trajectories(args: &DtArgs, training: &Training) -> anyhow::Result<(Vec<Trajectories>, BTreeMap<String, String>)> {
    let (mut all, mut about) = (Vec::new(), BTreeMap::new());
    let mut data = String::new();
    for path in &args.trajectories {
        let (trajectories, hash) = match read(path) {
            Ok(read) => read,
            Err(error) => bail!("{}: {error}", path.display()),
        };
        let _ = writeln!(data, "sha256 {hash}");
        for (key, value) in &trajectories.about {
            let _ = writeln!(data, "{key}: {value}");
        }
        all.push(trajectories);
    }
    about.insert("data".to_owned(), data);
    about.insert("training".to_owned(), format!("{training:?}"));
    about.insert(
        "made_by".to_owned(),
        concat!("reveille ", env!("CARGO_PKG_VERSION")).to_owned(),
    );
    Ok((all, about))
}
