//! `reveille figures`: figures as SVG and PNG, with their data as CSV. `study/src/figures/` draws; this module reads
//! the input, names the files, and reports figures that cannot be drawn. `docs/drawing-figures.md`,
//! `docs/figures/make.sh` and tests use the file names. A new figure of [`draw_study`] needs its name in
//! `cli::other_figures`; to appear in the report, also an entry in `draw_figures` and `figure_order` of `report`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::anyhow;
use reveille_bs::policy::dt::settings::{DtSettings, ModelSource};
use reveille_bs::policy::q_learning::learned::{LearnedTables, TableSet};
use reveille_bs::policy::registry;
use reveille_common::ids::Tti;
use reveille_common::io::Disk;
use reveille_common::scenario::WakeUpRanking;
use reveille_study::figures::attention::{self, AttentionFigure};
use reveille_study::figures::results::{Results, RunCondition};
use reveille_study::figures::sweep::{
    DEVICES, POLICY, SweepFigure, SweepFigureSpec, SweptNumbers, canonical_field, note_on_several,
};
use reveille_study::figures::timeline::Timeline;
use reveille_study::figures::{
    FigureError, deployment, energy, front, learning, misses, pareto, q_table, robustness, study, timeline,
    to_file_name,
};

use super::figure_files::{read_tables, write_file, write_picture};
use super::resolve_scenario::{resolve_repeated_run, resolve_with_builtin_policy};
use crate::cli::{
    AttentionArgs, AxisArg, DeploymentArgs, FigureOutputArgs, FiguresArgs, FiguresCommand, LearningArgs,
    MissesFigureArgs, QTableArgs, RankingArg, RobustnessArgs, SweepFigureArgs, TimelineArgs, most_similar_name,
    other_figures,
};
use crate::display::note;
use crate::run_reader::RunReader;

/// The metrics that are drawn against a swept field unless `--only` selects figures, whose metrics are drawn instead.
const SWEPT_METRICS: [&str; 2] = ["info_p1", "energy_per_device_tti"];

/// Draws the requested figures.
pub(crate) fn run(args: &FiguresArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(FiguresCommand::Deployment(args)) => draw_deployment(args),
        Some(FiguresCommand::Timeline(args)) => draw_timeline(args),
        Some(FiguresCommand::Misses(args)) => draw_misses(args),
        Some(FiguresCommand::Attention(args)) => draw_attention(args),
        Some(FiguresCommand::Robustness(args)) => draw_robustness(args),
        Some(FiguresCommand::Learning(args)) => draw_learning(args),
        Some(FiguresCommand::QTable(args)) => draw_q_table(args),
        Some(FiguresCommand::Sweep(args)) => draw_sweep(args),
        None => draw_study(args),
    }
}

/// Draws the figures over the runs of a study: each condition's figures, then the comparisons of several settings.
fn draw_study(args: &FiguresArgs) -> anyhow::Result<ExitCode> {
    let chosen_figures = study::select_figures(&args.only, &other_figures())?;
    let results = read_tables(&args.tables)?;
    let swept = SweptNumbers::of_results(&results);
    // The paper has no figures of a swept field, so its runs are drawn against this field. Figures chosen with --only
    // are also drawn against N, for the preset's own value.
    let swept_texts = swept_texts(&results, &swept);
    let is_swept = |condition: &RunCondition| {
        let mut fields = condition.swept_fields.iter().map(|(path, _)| path.as_str());
        swept.iter().any(|numbers| numbers.is_varied_in(condition)) || fields.any(|path| swept_texts.contains(path))
    };
    let has_own_figures =
        |condition: &RunCondition| condition.is_unchanged_preset() && condition.all_device_counts().len() > 1;
    let with_labels = results.conditions.iter().zip(results.file_labels());
    for (condition, label) in with_labels {
        if is_swept(condition) && (args.only.is_empty() || !has_own_figures(condition)) {
            if has_own_figures(condition) {
                note!(
                    "{}: the figures of the paper are not drawn, as fields vary in the sweep; choose some with --only",
                    condition.label()
                );
            }
            continue;
        }
        for figure in &chosen_figures {
            let name = format!("{}-{label}", figure.name);
            let Some(drawing) = figure.draw(condition) else {
                note!(
                    "{}: not drawn, as no run of {} has a value of {}",
                    figure.name,
                    condition.label(),
                    figure.metric
                );
                continue;
            };
            for policy in &drawing.policies_without_value {
                note!(
                    "{name}: drawn without {policy}, as none of its runs has a value of {}",
                    figure.metric
                );
            }
            write_picture(&args.pictures, &name, &drawing.chart.scene())?;
            write_file(
                &args.pictures.out,
                &format!("{name}.csv"),
                figure.csv(condition, &drawing).as_bytes(),
            )?;
        }
        if condition.swept_fields.is_empty() || condition.is_unchanged_preset() {
            draw_energy(args, &label, condition)?;
        }
        if !args.combine {
            draw_trades(args, &label, &[condition])?;
        }
    }
    for numbers in &swept {
        let axes = (numbers.field.as_str(), POLICY, numbers.is_wide());
        draw_swept_field(args, &results, axes, &chosen_figures)?;
    }
    // With a number too, each combination has its figure above.
    for field in swept_texts.iter().filter(|_| swept.is_empty()) {
        draw_swept_field(args, &results, (DEVICES, field, false), &chosen_figures)?;
    }
    for (label, conditions) in results.by_preset_and_length() {
        if args.combine {
            draw_trades(args, &format!("{label}-together"), &conditions)?;
        }
        draw_fronts(args, &label, &conditions)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Draws the metrics of the `chosen_figures`, by default information and energy, with these axes: the field along x,
/// the field with a line for each value, and whether x is logarithmic. There is a picture for each combination of the
/// other settings.
fn draw_swept_field(
    args: &FiguresArgs,
    results: &Results,
    (x_field, line_field, is_log_x): (&str, &str, bool),
    chosen_figures: &[study::PaperFigure],
) -> anyhow::Result<()> {
    let is_default = |figure: &&study::PaperFigure| SWEPT_METRICS.contains(&figure.metric);
    for figure in chosen_figures
        .iter()
        .filter(|figure| !args.only.is_empty() || is_default(figure))
    {
        let spec = SweepFigureSpec {
            x_field: x_field.to_owned(),
            metric: figure.metric.to_owned(),
            line_field: line_field.to_owned(),
            filter: Vec::new(),
            is_log_x,
            is_log_y: figure.is_log,
        };
        match spec.draw(results) {
            Ok(pictures) => write_sweep_pictures(&args.pictures, &spec, &pictures)?,
            Err(error) => note!("{} against {x_field}: not drawn: {error}", figure.name),
        }
    }
    Ok(())
}

/// Returns the swept fields with several values, except `numeric_fields`.
fn swept_texts<'r>(results: &'r Results, numeric_fields: &[SweptNumbers]) -> BTreeSet<&'r str> {
    let mut values: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (path, value) in results.conditions.iter().flat_map(|condition| &condition.swept_fields) {
        values.entry(path).or_default().insert(value);
    }
    let is_text = |path: &&str| !numeric_fields.iter().any(|numbers| numbers.field == *path);
    let several = values.into_iter().filter(|(_, values)| values.len() > 1);
    several.map(|(path, _)| path).filter(is_text).collect()
}

/// Whether the figure `name` is drawn: without `--only`, every figure is.
fn is_chosen(args: &FiguresArgs, name: &str) -> bool {
    args.only.is_empty() || args.only.iter().any(|chosen| chosen == name)
}

/// Draws information and delay against energy.
fn draw_trades(args: &FiguresArgs, label: &str, conditions: &[&RunCondition]) -> anyhow::Result<()> {
    for trade in pareto::TRADE_OFFS.iter().filter(|trade| is_chosen(args, trade.name)) {
        let name = format!("{}-{label}", trade.name);
        let Some(chart) = trade.chart(conditions) else {
            note!(
                "{name}: not drawn, as no run has both {} and {}",
                trade.metric,
                pareto::ENERGY_METRIC
            );
            continue;
        };
        write_picture(&args.pictures, &name, &chart.scene())?;
        write_file(
            &args.pictures.out,
            &format!("{name}.csv"),
            trade.csv(conditions).as_bytes(),
        )?;
    }
    Ok(())
}

/// Draws information against energy for each N at which a policy has several settings.
fn draw_fronts(args: &FiguresArgs, label: &str, conditions: &[&RunCondition]) -> anyhow::Result<()> {
    if !is_chosen(args, front::NAME) {
        return Ok(());
    }
    let fronts = front::draw_fronts(conditions);
    // Without a request, sweeps that vary no setting of a policy draw none and need no note.
    if fronts.is_empty() && !args.only.is_empty() {
        note!("{}: not drawn, as no policy has several settings at one N", front::NAME);
    }
    for front in fronts {
        let mut name = format!("{}-{label}", front::NAME);
        for (field, value) in &front.other_changes {
            name = format!("{name}-{field}-{value}");
        }
        let name = to_file_name(&format!("{name}-n{}", front.n));
        write_picture(&args.pictures, &name, &front.chart.scene())?;
        write_file(&args.pictures.out, &format!("{name}.csv"), front.csv.as_bytes())?;
    }
    Ok(())
}

/// Draws Figs. 13 and 14, the harvest and the net energy against λ.
fn draw_energy(args: &FiguresArgs, label: &str, condition: &RunCondition) -> anyhow::Result<()> {
    let [draws_harvest, draws_net] = energy::NAMES.map(|name| is_chosen(args, name));
    if !draws_harvest && !draws_net {
        return Ok(());
    }
    let [harvest_name, net_name] = energy::NAMES.map(|name| format!("{name}-{label}"));
    let points = energy::measure_harvests(&condition.preset)?;
    if draws_harvest {
        write_picture(
            &args.pictures,
            &harvest_name,
            &energy::harvest_chart(condition, &points).scene(),
        )?;
        write_file(
            &args.pictures.out,
            &format!("{harvest_name}.csv"),
            energy::harvest_csv(&points).as_bytes(),
        )?;
    }
    if draws_net {
        if let Some(chart) = energy::net_chart(condition, &points) {
            write_picture(&args.pictures, &net_name, &chart.scene())?;
            write_file(
                &args.pictures.out,
                &format!("{net_name}.csv"),
                energy::net_csv(&chart).as_bytes(),
            )?;
        } else {
            // The policies and N are constants of `energy`.
            note!("{net_name}: not drawn, as it needs runs of adjusted and random with 100 devices");
        }
    }
    Ok(())
}

/// Draws an event on the map of the devices.
fn draw_deployment(args: &DeploymentArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve_repeated_run(args.run.as_deref(), &args.scenario)?;
    let choice = args.event.unwrap_or(deployment::EventChoice::Automatic);
    let event_scene = deployment::EventScene::from_scenario(&scenario, choice)?;
    let name = deployment::file_name(&scenario, &event_scene);
    write_picture(&args.pictures, &name, &deployment::scene(&scenario, &event_scene))?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the attention of a decision of `dt`.
fn draw_attention(args: &AttentionArgs) -> anyhow::Result<ExitCode> {
    let mut scenario_args = args.scenario.clone();
    // The only policy with an attention.
    scenario_args.policy.get_or_insert_with(|| "dt".to_owned());
    let mut scenario = resolve_with_builtin_policy(&scenario_args)?;
    let settings: Option<&DtSettings> = scenario.policy.settings().downcast_ref();
    let is_model_given = args
        .scenario
        .set
        .iter()
        .any(|field| field.starts_with("policy.dt.model="));
    // The default model has no attention.
    if settings.is_some_and(|dt| dt.model_source == ModelSource::Shipped) && !is_model_given {
        scenario_args.set.push("policy.dt.model=attention".to_owned());
        scenario = resolve_with_builtin_policy(&scenario_args)?;
    }
    let tti = args.tti.map_or_else(|| scenario.warm_up_end(), Tti);
    let attention = AttentionFigure::from_scenario(&scenario, tti, &args.show)?;
    let name = format!("attention-n{}-s{}-t{tti}", scenario.run.devices, scenario.run.seed);
    write_picture(&args.pictures, &name, &attention::scene(&scenario, &attention))?;
    write_file(&args.pictures.out, &format!("{name}.csv"), attention.csv().as_bytes())?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the cost of an imperfect radio.
fn draw_robustness(args: &RobustnessArgs) -> anyhow::Result<ExitCode> {
    let policies: Vec<String> = match (&args.policies[..], &args.scenario.policy) {
        ([], None) => registry::names().map(str::to_owned).collect(),
        ([], Some(list)) => list.split(',').map(|name| name.trim().to_owned()).collect(),
        (policies, _) => policies.to_vec(),
    };
    let scenario_of = |policy: &String| {
        let mut scenario_args = args.scenario.clone();
        scenario_args.policy = Some(policy.clone());
        resolve_with_builtin_policy(&scenario_args)
    };
    // At least one, since all registered policies are used without --policies: `scenarios[0]` below exists.
    let scenarios = policies.iter().map(scenario_of).collect::<anyhow::Result<Vec<_>>>()?;
    let is_requested = |name: &str| args.only.is_empty() || args.only.iter().any(|requested| requested == name);
    let all_impairments = robustness::IMPAIRMENTS.iter();
    let impairments: Vec<_> = all_impairments
        .filter(|impairment| is_requested(impairment.name))
        .collect();
    let points = robustness::measure(&scenarios, &impairments, args.seeds);
    let name = format!("{}-n{}", robustness::NAME, scenarios[0].run.devices);
    let grid = robustness::grid(&points, &impairments, &scenarios[0]);
    write_picture(&args.pictures, &name, &grid.scene())?;
    write_file(
        &args.pictures.out,
        &format!("{name}.csv"),
        robustness::csv(&points).as_bytes(),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the states and batteries of some devices over time.
fn draw_timeline(args: &TimelineArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve_repeated_run(args.run.as_deref(), &args.scenario)?;
    let from = args.from.unwrap_or(scenario.warm_up_end().0);
    let timeline_data = Timeline::from_scenario(&scenario, &args.show, from, args.length)?;
    let name = timeline::file_name(&scenario, &timeline_data);
    write_picture(&args.pictures, &name, &timeline::scene(&scenario, &timeline_data))?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the missed events of a run folder by place and cause.
fn draw_misses(args: &MissesFigureArgs) -> anyhow::Result<ExitCode> {
    let run_misses = RunReader::open(&args.run)?.misses()?;
    write_picture(
        &args.pictures,
        &misses::file_name(&run_misses),
        &misses::scene(&run_misses),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the learning curves in files of learned tables.
fn draw_learning(args: &LearningArgs) -> anyhow::Result<ExitCode> {
    let read = |path: &PathBuf| Ok((path.display().to_string(), read_learned(path)?));
    let sources = args.files.iter().map(read).collect::<anyhow::Result<Vec<_>>>()?;
    let scene = learning::scene(&sources)?;
    let stems: Vec<String> = args.files.iter().map(|path| file_stem(path)).collect();
    let name = format!("learning-{}", stems.join("-"));
    write_picture(&args.pictures, &name, &scene)?;
    write_file(
        &args.pictures.out,
        &format!("{name}.csv"),
        learning::csv(&sources).as_bytes(),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Draws the tables for the requested numbers of devices: duty cycles, or wake-ups with `--wake`.
fn draw_q_table(args: &QTableArgs) -> anyhow::Result<ExitCode> {
    let (file, learned) = (args.file.display().to_string(), read_learned(&args.file)?);
    let find_table_set = |devices: &u32| q_table::find_table_set(&file, &learned, *devices, args.window);
    let table_sets = args
        .devices
        .iter()
        .map(find_table_set)
        .collect::<Result<Vec<&TableSet>, _>>()?;
    for table_set in table_sets {
        let window_suffix = args.window.map_or_else(String::new, |window| format!("-w{window}"));
        let name = format!(
            "q-table-{}-n{}{window_suffix}",
            file_stem(&args.file),
            table_set.devices
        );
        let Some(ranking) = args.wake else {
            write_picture(&args.pictures, &name, &q_table::duty_scene(&learned, table_set))?;
            for (name, csv) in [
                (format!("{name}.csv"), q_table::duty_csv(&learned, table_set)),
                (format!("{name}-value.csv"), q_table::value_csv(&learned, table_set)),
            ] {
                write_file(&args.pictures.out, &name, csv.as_bytes())?;
            }
            continue;
        };
        let ranking = match ranking {
            RankingArg::P42 => WakeUpRanking::P42,
            RankingArg::Posterior => WakeUpRanking::Posterior,
        };
        let name = format!("{name}-wake-{}", ranking.name());
        write_picture(
            &args.pictures,
            &name,
            &q_table::wake_scene(&learned, table_set, ranking),
        )?;
        write_file(
            &args.pictures.out,
            &format!("{name}.csv"),
            q_table::wake_csv(table_set, ranking).as_bytes(),
        )?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads the learned tables of the file at `path`, or the shipped ones of that name.
fn read_learned(path: &Path) -> anyhow::Result<LearnedTables> {
    // A file on the disk comes before shipped tables of the same name.
    let shipped = path
        .to_str()
        .filter(|_| !path.exists())
        .and_then(LearnedTables::shipped_named);
    if let Some(tables) = shipped {
        return Ok(tables);
    }
    LearnedTables::read(&Disk, path).map_err(|error| anyhow!("{}: {error}", path.display()))
}

/// The name of a file without its extension, as part of another name.
fn file_stem(path: &Path) -> String {
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
    stem.unwrap_or_default()
}

/// Adds the most similar known field to the error about an unknown one.
fn with_suggestion(error: FigureError) -> anyhow::Error {
    let FigureError::UnvariedField { name, known } = &error else {
        return error.into();
    };
    // Leaked, since clap keeps only static names; the program ends after this error.
    let hint = most_similar_name(name, known.clone().leak().split(", "));
    let hint = hint.map_or_else(String::new, |similar| format!("; did you mean `{similar}`?"));
    anyhow!("{error}{hint}")
}

/// Draws metrics against a field, with a picture for each metric and each combination of the other fields.
fn draw_sweep(args: &SweepFigureArgs) -> anyhow::Result<ExitCode> {
    let results = read_tables(&args.tables)?;
    let filter = args.filter.iter();
    let filter: Vec<_> = filter
        .map(|(field, value)| (canonical_field(field), value.clone()))
        .collect();
    let draw = |metric: &String| {
        let spec = SweepFigureSpec {
            x_field: canonical_field(&args.x),
            metric: metric.clone(),
            line_field: canonical_field(&args.by),
            filter: filter.clone(),
            is_log_x: args.log.contains(&AxisArg::X),
            is_log_y: args.log.contains(&AxisArg::Y),
        };
        let pictures = spec.draw(&results).map_err(with_suggestion)?;
        Ok((spec, pictures))
    };
    // A refused metric must not leave the pictures of the others.
    let drawn = args.y.iter().map(draw).collect::<anyhow::Result<Vec<_>>>()?;
    // All metrics have the same pictures, except undefined ones.
    if let Some((_, pictures)) = drawn.first() {
        let first_field = pictures.first().and_then(|picture| picture.facet.first());
        if let (Some(differences), Some((field, value))) = (note_on_several(pictures), first_field) {
            note!("{differences}; use --where to choose, for example --where {field}={value}");
        }
    }
    for (spec, pictures) in &drawn {
        write_sweep_pictures(&args.pictures, spec, pictures)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Writes the `pictures` of `spec` with their data, and notes the lines that have no value.
fn write_sweep_pictures(
    args: &FigureOutputArgs,
    spec: &SweepFigureSpec,
    pictures: &[SweepFigure],
) -> anyhow::Result<()> {
    for picture in pictures {
        let name = spec.file_name(&picture.facet);
        for line in &picture.lines_without_value {
            note!(
                "{name}: drawn without {line}, as none of its runs has a value of {}",
                spec.metric
            );
        }
        write_picture(args, &name, &picture.chart.scene())?;
        write_file(&args.out, &format!("{name}.csv"), picture.csv.as_bytes())?;
    }
    Ok(())
}
