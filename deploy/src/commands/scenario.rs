//! `reveille scenario`.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use reveille_bs::policy::registry;
use reveille_bs::scenario::{Override, PRESETS, Preset, Scenario, load_outside, reference, schema};

use crate::cli::ScenarioCommand;
use crate::display::{self, note};

/// Shows or checks scenarios.
pub fn run(command: &ScenarioCommand) -> anyhow::Result<ExitCode> {
    match command {
        ScenarioCommand::Show { source: None, .. } => {
            display::out("Presets, for --scenario and as `preset = \"…\"` in a file:\n")?;
            for Preset { name, about, .. } in PRESETS {
                display::out(&format!("  {name:<15} {about}\n"))?;
            }
            display::out("`reveille scenario show NAME` prints all fields of one.\n")?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Show {
            source: Some(source),
            set,
        } => {
            let scenario = load_outside(source, &overrides(set)?)?;
            warn(source, &scenario);
            display::out(&scenario.to_full_toml(&registry::kinds()))?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Schema { out } => write(out.as_deref(), &schema()),
        ScenarioCommand::Reference { out } => write(out.as_deref(), &reference()),
        ScenarioCommand::Check { sources, set } => check(sources, &overrides(set)?),
    }
}

fn check(sources: &[String], overrides: &[Override]) -> anyhow::Result<ExitCode> {
    let mut code = ExitCode::SUCCESS;
    for source in sources {
        match load_outside(source, overrides) {
            Ok(scenario) => {
                warn(source, &scenario);
                display::out(&format!(
                    "{source}: ok. {} devices, {} TTIs, policy {}, hash {}\n",
                    scenario.devices,
                    scenario.ttis,
                    scenario.policy.name(),
                    &scenario.hash_hex()[..16]
                ))?;
            }
            Err(error) => {
                note!("{source}: {error}");
                code = crate::exit::Exit::Failed.into();
            }
        }
    }
    Ok(code)
}

/// Says what the scenario warns of.
fn warn(source: &str, scenario: &Scenario) {
    for warning in &scenario.warnings {
        note!("{source}: warning: {warning}");
    }
}

/// Writes `text` to the file `out`, or prints it.
fn write(out: Option<&Path>, text: &str) -> anyhow::Result<ExitCode> {
    match out {
        Some(path) => std::fs::write(path, text).with_context(|| format!("{}: cannot be written", path.display()))?,
        None => display::out(text)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn overrides(set: &[String]) -> anyhow::Result<Vec<Override>> {
    Ok(set.iter().map(|text| Override::parse(text)).collect::<Result<_, _>>()?)
}
