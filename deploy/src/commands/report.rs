//! `reveille report`: the paper's claims next to the results, as HTML and Markdown; and the conditions that meet most
//! claims. `figure_order` recognises a figure by the start of its title, which `study/src/figures/` sets.
//!
//! With `--page`, tables and the command line end up in the committed `docs/reproduction.md`. A change of
//! [`report_command`] or of the command in [`search`] changes the page at its next generation; no test compares it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context as _, anyhow};
use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use reveille_common::declare::describe_read_error;
use reveille_lab::io::replace;
use reveille_study::figures::results::RunCondition;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{energy, pareto, study, svg};
use reveille_study::report::page::page as html_page;
use reveille_study::report::page_sections::{PageSection, fill_page};
use reveille_study::report::search::{ConditionRanking, markdown as search_markdown};
use reveille_study::report::{ClaimReport, markdown as report_markdown};

use super::figure_files::{read_tables, write_file};
use crate::cli::{ReportArgs, ReportCommand, SearchArgs};
use crate::display::{self, note};

/// Writes the report or runs the search.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(ReportCommand::Search(args)) => search(args),
        None => write_report(args),
    }
}

/// Ranks the conditions of the tables by the claims that they meet.
fn search(args: &SearchArgs) -> anyhow::Result<ExitCode> {
    let results = read_tables(&args.tables)?;
    let ranking = ConditionRanking::new(ClaimReport::new(&results));
    let headings = search_markdown::ranking_heads(&ranking);
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED).set_header(&headings);
    for ranked in ranking.conditions_to_show(args.top) {
        table.add_row(search_markdown::ranking_row(&ranking, ranked));
    }
    display::print_stdout(&format!("{table}\n"))?;
    for sentence in search_markdown::summary(&ranking) {
        display::print_stdout(&format!("{sentence}\n"))?;
    }
    let command = format!(
        "reveille report search {} --top {} --out {}",
        join_paths(&args.tables),
        args.top,
        args.out.display()
    );
    let markdown = search_markdown::markdown(&ranking, args.top, &command);
    write_file(&args.out, "search.md", markdown.as_bytes())?;
    insert_into_page(
        args.page.as_deref(),
        &search_markdown::search_sections(&ranking, args.top, &command),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Judges the claims and writes the report.
fn write_report(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    let results = read_tables(&args.tables)?;
    let report = ClaimReport::of_presets(&results)?;
    if report.conditions_left_out.count > 0 {
        note!(
            "report: {} left out, on which the paper makes no statement; rank them with `reveille report search`, or \
             draw them with `reveille figures`",
            report.conditions_left_out.describe()
        );
    }
    let without_runs = report.rows.iter().filter(|row| !row.has_runs()).count();
    if without_runs == report.rows.len() {
        note!(
            "report: no claim could be judged: the tables lack runs for all {without_runs} claims of the paper; sweep \
             the policies and numbers of devices that most claims name, such as with `reveille sweep --policies \
             knn,adjusted,q-learning,random,genie --devices 10,50,100,250 --seeds 20 --out paper`"
        );
    }
    let mut pictures = Vec::new();
    let mut titles_and_files = Vec::new();
    for preset in report.missing_presets() {
        note!(
            "report: the tables hold no runs of preset {preset}, so the report has no column for it; add the table of \
             a sweep with this preset"
        );
    }
    for (number, condition) in (1..).zip(report.conditions_to_draw()) {
        for (name, scene) in draw_figures(condition)? {
            let name = format!("{name}-{number}");
            let file = format!("{name}.svg");
            let svg_text = svg::svg(&scene, &name);
            write_file(&args.out, &file, svg_text.as_bytes())?;
            titles_and_files.push((format!("{}, {}", scene.title, condition.label()), file));
            pictures.push((scene.title, number, svg_text));
        }
    }
    // Sorted by figure, so that the pictures of both presets are next to each other.
    pictures.sort_by_key(|(title, number, _)| (figure_order(title), *number));
    let svg_texts: Vec<String> = pictures.into_iter().map(|(_, _, svg_text)| svg_text).collect();
    let command = report_command(args);
    write_file(
        &args.out,
        "report.md",
        report_markdown::markdown(&report, &titles_and_files, &command).as_bytes(),
    )?;
    write_file(
        &args.out,
        "report.html",
        html_page(&report, &svg_texts, &command).as_bytes(),
    )?;
    insert_into_page(
        args.page.as_deref(),
        &report_markdown::report_sections(&report, &command),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Draws all figures of a condition, with their names: as `figures::draw_study` does, without fronts and swept fields.
fn draw_figures(condition: &RunCondition) -> anyhow::Result<Vec<(&'static str, Scene)>> {
    let mut scenes = Vec::new();
    for figure in study::PAPER_FIGURES {
        if let Some(drawing) = figure.draw(condition) {
            scenes.push((figure.name, drawing.chart.scene()));
        }
    }
    let [harvest, net] = energy::NAMES;
    let points = energy::measure_harvests(&condition.preset)?;
    scenes.push((harvest, energy::harvest_chart(condition, &points).scene()));
    if let Some(chart) = energy::net_chart(condition, &points) {
        scenes.push((net, chart.scene()));
    }
    for trade in pareto::TRADE_OFFS {
        if let Some(chart) = trade.chart(&[condition]) {
            scenes.push((trade.name, chart.scene()));
        }
    }
    Ok(scenes)
}

/// The position of a picture: the paper's order first, then figures that the paper does not have. "Harvest" and "Net"
/// begin the titles in `study/src/figures/energy.rs`; an unknown title comes last.
fn figure_order(title: &str) -> usize {
    let titles = study::PAPER_FIGURES.iter().map(|figure| figure.title);
    let trades = pareto::TRADE_OFFS.iter().map(|trade| trade.title);
    let mut titles = titles.chain(["Harvest", "Net"]).chain(trades);
    let position = titles.position(|known| title.starts_with(known));
    position.unwrap_or(usize::MAX)
}

/// The command line that regenerates this report, without `--page`.
fn report_command(args: &ReportArgs) -> String {
    format!(
        "reveille report {} --out {}",
        join_paths(&args.tables),
        args.out.display()
    )
}

/// Inserts `sections` between their marks in the optional page, and prints its path.
fn insert_into_page(page: Option<&Path>, sections: &[PageSection]) -> anyhow::Result<()> {
    let Some(path) = page else { return Ok(()) };
    let text = fs::read_to_string(path).map_err(|error| {
        let cause = describe_read_error(&error, "name the page into which the tables are inserted");
        anyhow!("--page {}: {cause}", path.display())
    })?;
    let filled = fill_page(&text, sections).with_context(|| path.display().to_string())?;
    replace(path, filled.as_bytes()).with_context(|| format!("--page {}: cannot write the page", path.display()))?;
    display::print_stdout(&format!("{}\n", path.display()))?;
    Ok(())
}

/// The tables as given on the command line, without quotes.
fn join_paths(tables: &[PathBuf]) -> String {
    let tables: Vec<String> = tables.iter().map(|path| path.display().to_string()).collect();
    tables.join(" ")
}
