//! `reveille tune`: Bayesian optimisation of the q-learning weights μ1, μ2 with `lab/src/tuning/`. The history file
//! holds every finished point; an interrupted tuning resumes from it. `training_command` must repeat every option that
//! affects the training of tables. Programs of users read the keys of `--json`. A point is a pair of weights with its
//! evaluation.

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};

use anyhow::{anyhow, bail};
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use indicatif::ProgressBar;
use reveille_common::digits::{decimals_for, format_significant};
use reveille_lab::io::replace;
use reveille_lab::tuning::bayes::{Bayes, surface};
use reveille_lab::tuning::{
    Evaluation, History, Ranges, Tuner, TuningObjective, TuningPlan, TuningPoint, TuningProgress, WeightPair,
};
use reveille_study::figures::{png, svg, tuning as picture};
use serde_json::json;

use super::resolve_scenario::resolve_with_builtin_policy;
use crate::cli::{ImageFormatArg, ObjectiveArg, TuneArgs};
use crate::display::{self, note};
use crate::signals::{SignalMode, Signals};

/// Number of points in the closing table.
const CLOSING_TABLE_POINTS: usize = 5;

/// Starts, resumes or draws a tuning.
pub(crate) fn run(args: &TuneArgs) -> anyhow::Result<ExitCode> {
    let history_path = args.picture_only.as_ref().unwrap_or(&args.out);
    if history_path
        .extension()
        .is_some_and(|extension| extension == "svg" || extension == "png")
    {
        bail!(
            "{}: the history is a CSV file and its picture gets the same name; use a name that ends in .csv",
            history_path.display()
        );
    }
    if let Some(path) = &args.picture_only {
        let (history, _) = History::read(path)?;
        for file in draw_pictures(&history, path, &args.format)? {
            display::print_stdout(&format!("{}\n", file.display()))?;
        }
        return Ok(ExitCode::SUCCESS);
    }
    let mut tuner = Tuner::open(tuning_plan(args)?, &args.out, args.force)?;
    report_found(args, &tuner);
    let threads = args.episodes.threads()?;
    let signals = Signals::install(SignalMode::SavesResults)?;
    let tuning_display = TuningDisplay::start(args, &tuner, signals);
    let started = crate::runtime::now();
    let bayes = Bayes {
        seed: args.episodes.seed,
    };
    let is_finished = tuner.run(args.iterations, threads, &bayes, &tuning_display);
    tuning_display.bar.finish_and_clear();
    let history = tuner.history();
    if !is_finished? {
        note!(
            "reveille: interrupted; the {} are kept in {}: give the same command again to resume",
            display::count_noun(history.points.len(), "finished point"),
            args.out.display()
        );
        return Ok(crate::exit::ExitReason::Interrupted.into());
    }
    let pictures = draw_pictures(history, &args.out, &args.format)?;
    if args.json {
        display::print_stdout(&result_json(args, history, &pictures)?)?;
    } else if args.quiet {
        let [mu1, mu2] = best_point(history)?.weights;
        display::print_stdout(&format!("mu1={mu1} mu2={mu2}\n"))?;
    } else {
        display::print_stdout(&format_summary(args, history, &pictures)?)?;
        note!("tuned in {:.1} s", started.elapsed().as_secs_f64());
    }
    Ok(ExitCode::SUCCESS)
}

/// Checks the command line and returns the tuning plan.
fn tuning_plan(args: &TuneArgs) -> anyhow::Result<TuningPlan> {
    let ranges = Ranges::new(args.mu1, args.mu2)?;
    let plan = TuningPlan {
        scenario: resolve_with_builtin_policy(&args.scenario()?)?,
        ranges,
        objective: match args.objective {
            ObjectiveArg::Balance => TuningObjective::Balance {
                energy_weight: args.energy_weight,
                miss_weight: args.miss_weight,
            },
            ObjectiveArg::Information => TuningObjective::Information,
            ObjectiveArg::Efficiency => TuningObjective::Efficiency,
        },
        design_pairs: args.design,
        training: args.episodes.training_config()?,
        runs: args.seeds,
        ttis: args.ttis,
    };
    plan.check()?;
    Ok(plan)
}

/// Prints the number of points found in the history.
fn report_found(args: &TuneArgs, tuner: &Tuner) {
    let (found, file) = (tuner.history().points.len(), args.out.display());
    if tuner.is_torn() {
        tracing::warn!("{file}: the last line is truncated; its point is repeated");
    }
    if found > 0 && !args.quiet {
        note!(
            "{} found in {file}, {} left",
            display::count_noun(found, "finished point"),
            tuner.pairs_left(args.iterations)
        );
    }
}

/// Draws `history` next to its file, in the given formats.
fn draw_pictures(history: &History, path: &Path, formats: &[ImageFormatArg]) -> anyhow::Result<Vec<PathBuf>> {
    // The ranges of the history apply: --picture-only draws points of an earlier command line.
    let (Some(mu1), Some(mu2)) = (history.range("mu1"), history.range("mu2")) else {
        bail!(
            "{}: the ranges of the weights are missing; use a history that `reveille tune` wrote",
            path.display()
        );
    };
    if history.points.len() < reveille_lab::tuning::MIN_DESIGN_PAIRS {
        bail!(
            "{}: holds {}, but a picture needs {}; continue the tuning first",
            path.display(),
            display::count_noun(history.points.len(), "point"),
            reveille_lab::tuning::MIN_DESIGN_PAIRS
        );
    }
    let ranges = Ranges::new(mu1, mu2)?;
    let scene = picture::scene(history, &ranges, &surface(&ranges, history)?);
    let name = path.file_stem().unwrap_or(OsStr::new("tuning")).to_string_lossy();
    let mut files = Vec::new();
    for format in formats {
        let (extension, bytes) = match format {
            ImageFormatArg::Svg => ("svg", svg::svg(&scene, &name).into_bytes()),
            ImageFormatArg::Png => ("png", png::png(&scene)),
        };
        let file = path.with_extension(extension);
        replace(&file, &bytes).map_err(|error| anyhow!("{}: cannot write the picture: {error}", file.display()))?;
        files.push(file);
    }
    Ok(files)
}

/// Returns the best point, the first of equal ones.
///
/// # Errors
/// If the history is empty.
fn best_point(history: &History) -> anyhow::Result<&TuningPoint> {
    let best_index = history.ranked().first().copied();
    best_index
        .map(|index| &history.points[index])
        .ok_or_else(|| anyhow!("the history holds no points"))
}

/// The command line that trains tables with the best weights, with the settings of this tuning.
fn training_command(args: &TuneArgs, [mu1, mu2]: WeightPair) -> String {
    let mut text = format!("reveille train q-learning --devices {}", args.devices);
    // The default of `train q-learning` in `cli/train.rs`.
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
    // `EpisodeArgs::training_config` has checked that `epsilon` holds two shares.
    let training_args = &args.episodes;
    let _ = write!(
        text,
        " --set policy.q-learning.mu1={mu1} --set policy.q-learning.mu2={mu2} --episodes {} --episode-ttis {} \
         --epsilon {},{} --seed {} --out tuned.json",
        training_args.episodes,
        training_args.episode_ttis,
        training_args.epsilon[0],
        training_args.epsilon[1],
        training_args.seed
    );
    text
}

/// Formats the setup, the closing table of the best points, and the command that trains with the best weights.
fn format_summary(args: &TuneArgs, history: &History, pictures: &[PathBuf]) -> anyhow::Result<String> {
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
    let format_with_half_width = |mean: f64, half_width: f64| {
        if half_width.is_nan() {
            format_significant(mean, 4)
        } else {
            let decimals = decimals_for(half_width, 2);
            format!("{mean:.decimals$} ± {half_width:.decimals$}")
        }
    };
    for index in history.ranked().into_iter().take(CLOSING_TABLE_POINTS) {
        let TuningPoint {
            weights: [mu1, mu2],
            evaluation,
        } = &history.points[index];
        table.add_row([
            (index + 1).to_string(),
            mu1.to_string(),
            mu2.to_string(),
            format_with_half_width(evaluation.objective, evaluation.objective_half_width),
            format_with_half_width(evaluation.information, evaluation.information_half_width),
            format_significant(evaluation.misdetection_pct, 4),
            format_significant(evaluation.energy, 4),
            format_significant(evaluation.wake_ups, 4),
        ]);
    }
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let TuningPoint {
        weights: [mu1, mu2], ..
    } = *best_point(history)?;
    let pictures: Vec<String> = pictures.iter().map(|path| path.display().to_string()).collect();
    Ok(format!(
        "{} · N = {} · {} · seed {}\n{table}\nbest: μ1 = {mu1}, μ2 = {mu2}\nto train with them:\n  {}\n\
         history in {}, pictures in {}\n",
        history.header_value("objective"),
        args.devices,
        display::count_noun(history.points.len(), "point"),
        args.episodes.seed,
        training_command(args, [mu1, mu2]),
        args.out.display(),
        pictures.join(", ")
    ))
}

/// Returns the result as JSON. The keys of a point include `Evaluation::NAMES`, which are also columns of the history.
fn result_json(args: &TuneArgs, history: &History, pictures: &[PathBuf]) -> anyhow::Result<String> {
    let point_json = |index: usize| {
        let TuningPoint { weights, evaluation } = history.points[index];
        let mut point = json!({"point": index + 1, "mu1": weights[0], "mu2": weights[1]});
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
    let best_index = history.ranked().first().copied();
    let text = serde_json::to_string_pretty(&json!({
        "tuning": settings,
        "best": best_index.map(point_json),
        "points": (0..history.points.len()).map(point_json).collect::<Vec<_>>(),
        "command": training_command(args, best_point(history)?.weights),
        "history": args.out,
        "pictures": pictures,
    }))?;
    Ok(text + "\n")
}

/// The progress bar of a tuning, which a signal stops.
struct TuningDisplay {
    bar: ProgressBar,
    signals: Signals,
    /// The best objective so far, with its pair.
    best_point: Mutex<Option<(f64, WeightPair)>>,
    /// The number of evaluation runs of each pair.
    runs_per_pair: u64,
}

impl TuningDisplay {
    fn start(args: &TuneArgs, tuner: &Tuner, signals: Signals) -> Self {
        // A point is trained for all episodes, then evaluated by one run per seed; both advance the bar.
        let steps_per_point = args.episodes.episodes + args.seeds;
        let best_index = tuner.history().ranked().first().copied();
        let points = &tuner.history().points;
        Self {
            bar: display::new_bar(
                tuner.pairs_left(args.iterations) as u64 * steps_per_point,
                "{bar:24} {percent} %  {eta} left  {msg}",
                args.quiet,
            ),
            signals,
            best_point: Mutex::new(best_index.map(|index| (points[index].evaluation.objective, points[index].weights))),
            runs_per_pair: args.seeds,
        }
    }

    fn format_best(&self) -> String {
        let best_point = *self.best_point.lock().unwrap_or_else(PoisonError::into_inner);
        best_point.map_or_else(String::new, |(objective, [mu1, mu2])| {
            let [objective, mu1, mu2] = [objective, mu1, mu2].map(|x| format_significant(x, 4));
            format!("  best {objective} at μ1 = {mu1}, μ2 = {mu2}")
        })
    }
}

impl TuningProgress for TuningDisplay {
    fn point_started(&self, number: usize, [mu1, mu2]: WeightPair) {
        let best_text = self.format_best();
        self.bar.set_message(format!(
            "point {}: μ1 = {mu1:.3}, μ2 = {mu2:.3} ({}){best_text}",
            number + 1,
            display::count_noun(self.runs_per_pair, "run")
        ));
    }

    fn episode_ended(&self) {
        self.bar.inc(1);
    }

    fn run_ended(&self) {
        self.bar.inc(1);
    }

    fn point_ended(&self, point: &TuningPoint) {
        let mut best_point = self.best_point.lock().unwrap_or_else(PoisonError::into_inner);
        let candidate = (point.evaluation.objective, point.weights);
        if best_point.is_none_or(|(best_known, _)| candidate.0 > best_known) {
            *best_point = Some(candidate);
        }
    }

    fn should_stop(&self) -> bool {
        self.signals.has_arrived()
    }
}
