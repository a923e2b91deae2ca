//! `reveille tune`: Bayesian optimisation of the q-learning weights.

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};

use anyhow::{anyhow, bail};
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use indicatif::ProgressBar;
use reveille_lab::io::replace;
use reveille_lab::tuning::bayes::{Bayes, surface};
use reveille_lab::tuning::{
    Evaluation, History, Ranges, Tuner, TuningObjective, TuningPlan, TuningPoint, TuningProgress, WeightPair,
};
use reveille_study::figures::{png, svg, tuning as picture};
use serde_json::json;

use super::resolve_scenario::resolve;
use crate::cli::{ImageFormatArg, ObjectiveArg, TuneArgs};
use crate::display::{self, note};
use crate::signals::{Manner, Signals};

/// Number of points in the closing table.
const SHOWN: usize = 5;

/// Starts, resumes or draws a tuning.
pub(crate) fn run(args: &TuneArgs) -> anyhow::Result<ExitCode> {
    let history = args.picture_only.as_ref().unwrap_or(&args.out);
    if history
        .extension()
        .is_some_and(|ending| ending == "svg" || ending == "png")
    {
        bail!(
            "{}: the history is a CSV file and its picture gets the same name; use a name that ends in .csv",
            history.display()
        );
    }
    if let Some(path) = &args.picture_only {
        let (history, _) = History::read(path)?;
        for file in draw(&history, path, &args.format)? {
            display::print(&format!("{}\n", file.display()))?;
        }
        return Ok(ExitCode::SUCCESS);
    }
    let mut tuner = Tuner::open(plan(args)?, &args.out, args.force)?;
    announce(args, &tuner);
    let threads = args.episodes.threads()?;
    let signals = Signals::install(Manner::Keeps)?;
    let shown = TuningDisplay::start(args, &tuner, signals);
    let started = crate::runtime::now();
    let bayes = Bayes {
        seed: args.episodes.seed,
    };
    let ended = tuner.run(args.iterations, threads, &bayes, &shown);
    shown.bar.finish_and_clear();
    let history = tuner.history();
    if !ended? {
        note!(
            "reveille: interrupted; the {} are kept in {}: give the same command again to resume",
            display::count(history.points.len(), "finished point"),
            args.out.display()
        );
        return Ok(crate::exit::ExitReason::Interrupted.into());
    }
    let pictures = draw(history, &args.out, &args.format)?;
    if args.json {
        display::print(&result(args, history, &pictures)?)?;
    } else if args.quiet {
        let [mu1, mu2] = best(history)?.weights;
        display::print(&format!("mu1={mu1} mu2={mu2}\n"))?;
    } else {
        display::print(&summary(args, history, &pictures)?)?;
        note!("tuned in {:.1} s", started.elapsed().as_secs_f64());
    }
    Ok(ExitCode::SUCCESS)
}

/// Checks the command line and returns the tuning plan.
fn plan(args: &TuneArgs) -> anyhow::Result<TuningPlan> {
    let ends = |name: &str, ends: &[f64]| match ends {
        &[from, to] => Ok((from, to)),
        _ => Err(anyhow!(
            "--{name}: must be the smallest and the largest weight, for example 1,5"
        )),
    };
    let ranges = Ranges::new(ends("mu1", &args.mu1)?, ends("mu2", &args.mu2)?)?;
    let plan = TuningPlan {
        scenario: resolve(&args.scenario()?)?,
        ranges,
        objective: match args.objective {
            ObjectiveArg::Balance => TuningObjective::Balance {
                energy: args.energy_weight,
                miss: args.miss_weight,
            },
            ObjectiveArg::Information => TuningObjective::Information,
            ObjectiveArg::Efficiency => TuningObjective::Efficiency,
        },
        design: args.design,
        training: args.episodes.training()?,
        runs: args.seeds,
        ttis: args.ttis,
    };
    plan.check()?;
    Ok(plan)
}

/// Prints the number of points found in the history.
fn announce(args: &TuneArgs, tuner: &Tuner) {
    let (found, file) = (tuner.history().points.len(), args.out.display());
    if tuner.torn() {
        tracing::warn!("{file}: the last line is truncated; its point is repeated");
    }
    if found > 0 && !args.quiet {
        note!(
            "{} found in {file}, {} left",
            display::count(found, "finished point"),
            tuner.left(args.iterations)
        );
    }
}

/// Draws `history` next to its file, in the given formats.
fn draw(history: &History, path: &Path, formats: &[ImageFormatArg]) -> anyhow::Result<Vec<PathBuf>> {
    // The ranges of the history apply: --picture-only draws points of an earlier command line.
    let (Some(mu1), Some(mu2)) = (history.range("mu1"), history.range("mu2")) else {
        bail!(
            "{}: the ranges of the weights are missing; use a history that `reveille tune` wrote",
            path.display()
        );
    };
    if history.points.len() < reveille_lab::tuning::LEAST_DESIGN {
        bail!(
            "{}: holds {}, but a picture needs {}; continue the tuning first",
            path.display(),
            display::count(history.points.len(), "point"),
            reveille_lab::tuning::LEAST_DESIGN
        );
    }
    let ranges = Ranges::new(mu1, mu2)?;
    let scene = picture::scene(history, &ranges, &surface(&ranges, history)?);
    let name = path.file_stem().unwrap_or(OsStr::new("tuning")).to_string_lossy();
    let mut files = Vec::new();
    for format in formats {
        let (ending, bytes) = match format {
            ImageFormatArg::Svg => ("svg", svg::svg(&scene, &name).into_bytes()),
            ImageFormatArg::Png => ("png", png::png(&scene)),
        };
        let file = path.with_extension(ending);
        replace(&file, &bytes).map_err(|error| anyhow!("{}: cannot write this file: {error}", file.display()))?;
        files.push(file);
    }
    Ok(files)
}

fn best(history: &History) -> anyhow::Result<&TuningPoint> {
    let first = history.ranked().first().copied();
    first
        .map(|number| &history.points[number])
        .ok_or_else(|| anyhow!("the history holds no points"))
}

/// The command line that trains tables with the best weights, with the settings of this tuning.
fn command(args: &TuneArgs, [mu1, mu2]: WeightPair) -> String {
    let mut text = format!("reveille train q-learning --devices {}", args.devices);
    if args.scenario != "paper" {
        let _ = write!(text, " --scenario {}", args.scenario);
    }
    // Weights that were set are replaced by the best ones.
    let is_weight = |set: &&String| {
        let name = set.split('=').next().unwrap_or_default().trim();
        matches!(name, "policy.q-learning.mu1" | "policy.q-learning.mu2")
    };
    for set in args.set.iter().filter(|set| !is_weight(set)) {
        let _ = write!(text, " --set {set}");
    }
    let how = &args.episodes;
    let _ = write!(
        text,
        " --set policy.q-learning.mu1={mu1} --set policy.q-learning.mu2={mu2} --episodes {} --episode-ttis {} \
         --epsilon {},{} --seed {} --out tuned.json",
        how.episodes, how.episode_ttis, how.epsilon[0], how.epsilon[1], how.seed
    );
    text
}

/// Formats the closing table.
fn summary(args: &TuneArgs, history: &History, pictures: &[PathBuf]) -> anyhow::Result<String> {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED).set_header([
        "point",
        "mu1",
        "mu2",
        "objective",
        "information",
        "missed, %",
        "energy",
        "wake-ups",
    ]);
    let within = |mean: f64, half: f64| {
        if half.is_nan() {
            format!("{mean:.4}")
        } else {
            format!("{mean:.4} ± {half:.4}")
        }
    };
    for number in history.ranked().into_iter().take(SHOWN) {
        let TuningPoint {
            weights: [mu1, mu2],
            evaluation: e,
        } = &history.points[number];
        table.add_row([
            (number + 1).to_string(),
            mu1.to_string(),
            mu2.to_string(),
            within(e.objective, e.objective_half),
            within(e.information, e.information_half),
            format!("{:.3}", e.misdetection_pct),
            format!("{:.4}", e.energy),
            format!("{:.2}", e.wake_ups),
        ]);
    }
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let TuningPoint {
        weights: [mu1, mu2], ..
    } = *best(history)?;
    let pictures: Vec<String> = pictures.iter().map(|path| path.display().to_string()).collect();
    Ok(format!(
        "{} · N = {} · {} points · seed {}\n{table}\nbest: μ1 = {mu1}, μ2 = {mu2}\nto train with them:\n  {}\n\
         history in {}, pictures in {}\n",
        history.header_value("objective"),
        args.devices,
        history.points.len(),
        args.episodes.seed,
        command(args, [mu1, mu2]),
        args.out.display(),
        pictures.join(", ")
    ))
}

/// Returns the result as JSON.
fn result(args: &TuneArgs, history: &History, pictures: &[PathBuf]) -> anyhow::Result<String> {
    let point = |number: usize| {
        let TuningPoint { weights, evaluation } = history.points[number];
        let mut point = json!({"point": number + 1, "mu1": weights[0], "mu2": weights[1]});
        for (name, value) in Evaluation::NAMES.iter().zip(evaluation.values()) {
            point[name] = json!(value);
        }
        point
    };
    let settings: serde_json::Map<String, serde_json::Value> = history
        .header
        .iter()
        .map(|(name, value)| (name.clone(), json!(value)))
        .collect();
    let first = history.ranked().first().copied();
    let text = serde_json::to_string_pretty(&json!({
        "tuning": settings,
        "best": first.map(point),
        "points": (0..history.points.len()).map(point).collect::<Vec<_>>(),
        "command": command(args, best(history)?.weights),
        "history": args.out,
        "pictures": pictures,
    }))?;
    Ok(text + "\n")
}

/// The progress display.
struct TuningDisplay {
    bar: ProgressBar,
    signals: Signals,
    best: Mutex<Option<(f64, WeightPair)>>,
    runs: u64,
}

impl TuningDisplay {
    fn start(args: &TuneArgs, tuner: &Tuner, signals: Signals) -> Self {
        // A point is trained for all episodes, then evaluated by one run per seed; both advance the bar.
        let steps = args.episodes.episodes + args.seeds;
        let known = tuner.history().ranked().first().copied();
        let points = &tuner.history().points;
        Self {
            bar: display::bar(
                tuner.left(args.iterations) as u64 * steps,
                "{bar:24} {percent} %  {eta} left  {msg}",
                args.quiet,
            ),
            signals,
            best: Mutex::new(known.map(|number| (points[number].evaluation.objective, points[number].weights))),
            runs: args.seeds,
        }
    }

    fn so_far(&self) -> String {
        let best = *self.best.lock().unwrap_or_else(PoisonError::into_inner);
        best.map_or_else(String::new, |(objective, [mu1, mu2])| {
            format!("  best {objective:.4} at μ1 = {mu1:.3}, μ2 = {mu2:.3}")
        })
    }
}

impl TuningProgress for TuningDisplay {
    fn begun(&self, number: usize, [mu1, mu2]: WeightPair) {
        let so_far = self.so_far();
        self.bar.set_message(format!(
            "point {}: μ1 = {mu1:.3}, μ2 = {mu2:.3} ({} runs){so_far}",
            number + 1,
            self.runs
        ));
    }

    fn episode(&self) {
        self.bar.inc(1);
    }

    fn run(&self) {
        self.bar.inc(1);
    }

    fn point(&self, point: &TuningPoint) {
        let mut best = self.best.lock().unwrap_or_else(PoisonError::into_inner);
        let own = (point.evaluation.objective, point.weights);
        if best.is_none_or(|(known, _)| own.0 > known) {
            *best = Some(own);
        }
    }

    fn stop(&self) -> bool {
        self.signals.have_come()
    }
}
