//! `reveille scenario`.

use std::process::ExitCode;

use reveille_common::scenario::{Override, PRESETS, load};

use crate::cli::ScenarioCommand;
use crate::display;

/// Shows or checks scenarios.
pub fn run(command: &ScenarioCommand) -> anyhow::Result<ExitCode> {
    match command {
        ScenarioCommand::Show { source: None, .. } => {
            display::out("Presets, for --scenario and as `preset = \"…\"` in a file:\n")?;
            for (name, about) in PRESETS {
                display::out(&format!("  {name:<15} {about}\n"))?;
            }
            display::out("`reveille scenario show NAME` prints all fields of one.\n")?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Show {
            source: Some(source),
            set,
        } => {
            display::out(&load(source, &overrides(set)?)?.to_toml())?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Check { sources, set } => check(sources, &overrides(set)?),
    }
}

fn check(sources: &[String], overrides: &[Override]) -> anyhow::Result<ExitCode> {
    let mut code = ExitCode::SUCCESS;
    for source in sources {
        match load(source, overrides) {
            Ok(scenario) => display::out(&format!(
                "{source}: ok. {} devices, {} TTIs, policy {}, hash {}\n",
                scenario.devices,
                scenario.ttis,
                scenario.policy.name(),
                &scenario.hash_hex()[..16]
            ))?,
            Err(error) => {
                eprintln!("{source}: {error}");
                code = ExitCode::FAILURE;
            }
        }
    }
    Ok(code)
}

fn overrides(set: &[String]) -> anyhow::Result<Vec<Override>> {
    Ok(set.iter().map(|text| Override::parse(text)).collect::<Result<_, _>>()?)
}
