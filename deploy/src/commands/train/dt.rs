//! `reveille train dt`: a decision transformer from recorded trajectories.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::bail;
use reveille_bs::policy::dt::model::shape::Shape;
use reveille_lab::io::replace;
use reveille_lab::trajectories::{Trajectories, read};
use reveille_lab::transformer::{Progress, Training, train};

use crate::cli::DtArgs;
use crate::commands::paths::check_place;
use crate::display::{self, note};

/// Steps between two looks at what is held out.
const EVERY: u64 = 200;

/// Trains the model that is asked for.
pub fn run(args: &DtArgs) -> anyhow::Result<ExitCode> {
    let training = training(args)?;
    if args.out.exists() && !args.force {
        bail!("{}: is there already; --force replaces it", args.out.display());
    }
    check_place(&args.out, "the model")?;
    let (trajectories, about) = trajectories(args, &training)?;
    let runtime = crate::wall::runtime(1)?;
    let stop = runtime.block_on(async { crate::interrupt::watch() })?;
    let started = crate::wall::now();
    let mut show = |now: Progress| {
        if !args.quiet {
            let best = if now.is_best { "  best" } else { "" };
            note!(
                "step {:>6}  loss {:>8.4}  held out: looks {:.4}, wake-ups {:.4} nats; price off by {:.3}{best}",
                now.step,
                now.loss,
                now.score.looks,
                now.score.wakes,
                now.score.price_error
            );
        }
        !stop.load(Ordering::Relaxed)
    };
    let bytes = train(trajectories, &training, &about, &mut show)?;
    if stop.load(Ordering::Relaxed) {
        note!("interrupted: the best model so far is kept");
    }
    if let Err(error) = replace(&args.out, &bytes) {
        bail!("{}: cannot be written: {error}", args.out.display());
    }
    if !args.quiet {
        note!("trained in {:.1} s", started.elapsed().as_secs_f64());
    }
    display::out(&format!("{}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

fn training(args: &DtArgs) -> anyhow::Result<Training> {
    if !args.width.is_multiple_of(4 * args.heads) {
        bail!(
            "--width {}: must be a multiple of 4 times --heads, {}",
            args.width,
            4 * args.heads
        );
    }
    if !(args.rate > 0.0 && args.rate <= 1.0) {
        bail!("--rate {}: must be above 0 and at most 1", args.rate);
    }
    Ok(Training {
        shape: Shape {
            memory: args.memory as usize,
            width: args.width as usize,
            heads: args.heads as usize,
            has_space: !args.no_space,
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
