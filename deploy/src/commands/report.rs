//! `reveille report`: the paper's claims beside the tables, as HTML and as Markdown; and the settings that meet most of
//! them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use reveille_lab::io::replace;
use reveille_study::figures::results::Condition;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{energy, pareto, study, svg};
use reveille_study::report::page::page;
use reveille_study::report::parts::{Part, fill};
use reveille_study::report::search::{Search, markdown};
use reveille_study::report::{Report, markdown as pages};

use super::pictures::{read, save};
use crate::cli::{ReportArgs, ReportCommand, SearchArgs};
use crate::display::{self, note};

/// Judges what is asked for.
pub fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(ReportCommand::Search(args)) => search(args),
        None => write_report(args),
    }
}

/// Ranks the settings of the tables by the claims that they meet.
fn search(args: &SearchArgs) -> anyhow::Result<ExitCode> {
    let results = read(&args.tables)?;
    let search = Search::new(Report::new(&results));
    let heads = markdown::heads(&search);
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED).set_header(&heads);
    for setting in search.shown(args.top) {
        table.add_row(markdown::row(&search, setting));
    }
    display::out(&format!("{table}\n"))?;
    for sentence in markdown::summary(&search) {
        display::out(&format!("{sentence}\n"))?;
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
    let report = Report::new(&results);
    let mut pictures = Vec::new();
    let mut files = Vec::new();
    for preset in report.missing() {
        note!("report: no table of preset {preset}, so that there is no column of it");
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
    // A figure under one preset stands beside itself under the other.
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

/// All figures of a condition, with their names.
fn scenes(condition: &Condition) -> anyhow::Result<Vec<(&'static str, Scene)>> {
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

/// Where a picture stands among the others: the paper's order, then what the paper does not have.
fn order(title: &str) -> usize {
    let titles = study::FIGURES.iter().map(|figure| figure.title);
    let trades = pareto::TRADES.iter().map(|trade| trade.title);
    let mut titles = titles.chain(["Harvest", "Net"]).chain(trades);
    let known = titles.position(|known| title.starts_with(known));
    known.unwrap_or(usize::MAX)
}

/// The command line that makes this report again.
fn command(args: &ReportArgs) -> String {
    format!("reveille report {} --out {}", named(&args.tables), args.out.display())
}

/// Puts `parts` between their marks in the page, if there is one.
fn into_page(page: Option<&Path>, parts: &[Part]) -> anyhow::Result<()> {
    let Some(path) = page else { return Ok(()) };
    let text = fs::read_to_string(path).with_context(|| format!("{}: cannot be read", path.display()))?;
    let filled = fill(&text, parts).with_context(|| path.display().to_string())?;
    replace(path, filled.as_bytes()).with_context(|| format!("{}: cannot be written", path.display()))?;
    display::out(&format!("{}\n", path.display()))?;
    Ok(())
}

/// The tables as the command line names them.
fn named(tables: &[PathBuf]) -> String {
    let tables: Vec<String> = tables.iter().map(|path| path.display().to_string()).collect();
    tables.join(" ")
}
