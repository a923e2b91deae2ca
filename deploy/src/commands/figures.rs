//! `reveille figures`: pictures as SVG and PNG.

use std::fs;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use reveille_lab::figures::scene::Scene;
use reveille_lab::figures::timeline::Timeline;
use reveille_lab::figures::{deployment, png, svg, timeline};

use super::resolve;
use crate::cli::{DeploymentArgs, FiguresArgs, FiguresCommand, FormatArg, PictureArgs, TimelineArgs};
use crate::display;

/// Draws what is asked for.
pub fn run(args: &FiguresArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(FiguresCommand::Deployment(args)) => draw_deployment(args),
        Some(FiguresCommand::Timeline(args)) => draw_timeline(args),
        None => draw_study(args),
    }
}

fn draw_study(_: &FiguresArgs) -> anyhow::Result<ExitCode> {
    anyhow::bail!("not yet")
}

fn draw_deployment(args: &DeploymentArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve(&args.scenario)?;
    let moment = deployment::Moment::of(&scenario, args.event)?;
    let name = format!(
        "deployment-{}-n{}-s{}-e{}",
        scenario.policy.name(),
        scenario.devices,
        scenario.seed,
        moment.event.event.0
    );
    write(&args.pictures, &name, &deployment::scene(&scenario, &moment))?;
    Ok(ExitCode::SUCCESS)
}

fn draw_timeline(args: &TimelineArgs) -> anyhow::Result<ExitCode> {
    let scenario = resolve(&args.scenario)?;
    let from = args.from.unwrap_or(scenario.warm_up_end().0);
    let shown = Timeline::of(&scenario, &args.show, from, args.length)?;
    let name = format!(
        "timeline-{}-n{}-s{}-k{from}",
        scenario.policy.name(),
        scenario.devices,
        scenario.seed
    );
    write(&args.pictures, &name, &timeline::scene(&scenario, &shown))?;
    Ok(ExitCode::SUCCESS)
}

/// Writes a picture in all formats asked for, and says where.
pub fn write(args: &PictureArgs, name: &str, scene: &Scene) -> anyhow::Result<()> {
    for format in &args.format {
        let (ending, bytes) = match format {
            FormatArg::Svg => ("svg", svg::svg(scene, name).into_bytes()),
            FormatArg::Png => ("png", png::png(scene)),
        };
        save(&args.out, &format!("{name}.{ending}"), &bytes)?;
    }
    Ok(())
}

/// Writes a file into `folder`, which is made if need be, and says so.
pub fn save(folder: &Path, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("{}: the folder cannot be made", folder.display()))?;
    let path = folder.join(name);
    fs::write(&path, bytes).with_context(|| format!("{}: cannot be written", path.display()))?;
    display::out(&format!("{}\n", path.display()))?;
    Ok(())
}
