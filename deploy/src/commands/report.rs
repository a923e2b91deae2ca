//! `reveille report`: the paper's claims beside the tables, as HTML and as Markdown.

use std::process::ExitCode;

use reveille_study::figures::results::Condition;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{energy, pareto, study, svg};
use reveille_study::report::Report;
use reveille_study::report::markdown::markdown;
use reveille_study::report::page::page;

use super::figures::{read, save};
use crate::cli::ReportArgs;
use crate::display::note;

/// Judges the claims and writes the report.
pub fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
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
    save(&args.out, "report.md", markdown(&report, &files, &command).as_bytes())?;
    save(&args.out, "report.html", page(&report, &pictures, &command).as_bytes())?;
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
    if let Some(chart) = pareto::chart(&[condition]) {
        scenes.push((pareto::NAME, chart.scene()));
    }
    Ok(scenes)
}

/// Where a picture stands among the others: the paper's order, then what the paper does not have.
fn order(title: &str) -> usize {
    let titles = study::FIGURES.iter().map(|figure| figure.title);
    let mut titles = titles.chain(["Harvest", "Net", pareto::TITLE]);
    let known = titles.position(|known| title.starts_with(known));
    known.unwrap_or(usize::MAX)
}

/// The command line that makes this report again.
fn command(args: &ReportArgs) -> String {
    let tables: Vec<String> = args.tables.iter().map(|path| path.display().to_string()).collect();
    format!("reveille report {} --out {}", tables.join(" "), args.out.display())
}
