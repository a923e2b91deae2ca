//! `reveille report`: the paper's claims next to the results, as HTML and Markdown; and the settings that meet most
//! claims.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use reveille_lab::io::replace;
use reveille_study::figures::results::RunCondition;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{energy, pareto, study, svg};
use reveille_study::report::page::page;
use reveille_study::report::page_sections::{PageSection, fill};
use reveille_study::report::search::{SettingSearch, markdown};
use reveille_study::report::{ClaimReport, markdown as pages};

use super::figure_files::{read, save};
use crate::cli::{ReportArgs, ReportCommand, SearchArgs};
use crate::display::{self, note};

/// Writes the report or runs the search.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(ReportCommand::Search(args)) => search(args),
        None => write_report(args),
    }
}

/// Ranks the settings of the tables by the claims that they meet.
fn search(args: &SearchArgs) -> anyhow::Result<ExitCode> {
    let results = read(&args.tables)?;
    let search = SettingSearch::new(ClaimReport::new(&results));
    let heads = markdown::heads(&search);
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED).set_header(&heads);
    for setting in search.shown(args.top) {
        table.add_row(markdown::row(&search, setting));
    }
    display::print(&format!("{table}\n"))?;
    for sentence in markdown::summary(&search) {
        display::print(&format!("{sentence}\n"))?;
    }
    let command = format!(
        "reveille report search {} --top {} --out {}",
        named(&args.tables),
        args.top,
        args.out.display()
    );
    let page = markdown::markdown(&search, args.top, &command);
    save(&args.out, "search.md", page.as_bytes())?;
    into_page(args.page.as_deref(), &markdown::parts(&search, args.top, &command))?;
    Ok(ExitCode::SUCCESS)
}

/// Judges the claims and writes the report.
fn write_report(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    let results = read(&args.tables)?;
    let report = ClaimReport::new(&results);
    let mut pictures = Vec::new();
    let mut files = Vec::new();
    for preset in report.missing() {
        note!("report: no table has runs of preset {preset}; the report has no column for it");
    }
    for (number, condition) in (1..).zip(report.drawn()) {
        for (name, scene) in scenes(condition)? {
            let name = format!("{name}-{number}");
            let file = format!("{name}.svg");
            let picture = svg::svg(&scene, &name);
            save(&args.out, &file, picture.as_bytes())?;
            files.push((format!("{}, {}", scene.title, condition.label()), file));
            pictures.push((scene.title, number, picture));
        }
    }
    // Sorted by figure, so that the pictures of both presets are next to each other.
    pictures.sort_by_key(|(title, number, _)| (order(title), *number));
    let pictures: Vec<String> = pictures.into_iter().map(|(_, _, picture)| picture).collect();
    let command = command(args);
    save(
        &args.out,
        "report.md",
        pages::markdown(&report, &files, &command).as_bytes(),
    )?;
    save(&args.out, "report.html", page(&report, &pictures, &command).as_bytes())?;
    into_page(args.page.as_deref(), &pages::parts(&report, &command))?;
    Ok(ExitCode::SUCCESS)
}

/// Draws all figures of a condition, with their names.
fn scenes(condition: &RunCondition) -> anyhow::Result<Vec<(&'static str, Scene)>> {
    let mut scenes = Vec::new();
    for figure in study::FIGURES {
        if let Some(drawing) = figure.draw(condition) {
            scenes.push((figure.name, drawing.chart.scene()));
        }
    }
    let [harvest, net] = energy::NAMES;
    let points = energy::harvests(&condition.preset)?;
    scenes.push((harvest, energy::harvest_chart(condition, &points).scene()));
    if let Some(chart) = energy::net_chart(condition, &points) {
        scenes.push((net, chart.scene()));
    }
    for trade in pareto::TRADES {
        if let Some(chart) = trade.chart(&[condition]) {
            scenes.push((trade.name, chart.scene()));
        }
    }
    Ok(scenes)
}

/// The position of a picture: the paper's order first, then figures that the paper does not have.
fn order(title: &str) -> usize {
    let titles = study::FIGURES.iter().map(|figure| figure.title);
    let trades = pareto::TRADES.iter().map(|trade| trade.title);
    let mut titles = titles.chain(["Harvest", "Net"]).chain(trades);
    let known = titles.position(|known| title.starts_with(known));
    known.unwrap_or(usize::MAX)
}

/// The command line that regenerates this report.
fn command(args: &ReportArgs) -> String {
    format!("reveille report {} --out {}", named(&args.tables), args.out.display())
}

/// Inserts `parts` between their marks in the optional page.
fn into_page(page: Option<&Path>, parts: &[PageSection]) -> anyhow::Result<()> {
    let Some(path) = page else { return Ok(()) };
    let text = fs::read_to_string(path).with_context(|| format!("{}: cannot read this file", path.display()))?;
    let filled = fill(&text, parts).with_context(|| path.display().to_string())?;
    replace(path, filled.as_bytes()).with_context(|| format!("{}: cannot write this file", path.display()))?;
    display::print(&format!("{}\n", path.display()))?;
    Ok(())
}

/// The tables as given on the command line.
fn named(tables: &[PathBuf]) -> String {
    let tables: Vec<String> = tables.iter().map(|path| path.display().to_string()).collect();
    tables.join(" ")
}
