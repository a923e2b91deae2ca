//! `reveille scenario`.

use std::process::ExitCode;

use reveille_common::scenario::{Override, PRESETS, load};

use crate::cli::ScenarioCommand;

/// Shows or checks scenarios.
pub fn run(command: &ScenarioCommand) -> anyhow::Result<ExitCode> {
    match command {
        ScenarioCommand::Show { source: None, .. } => {
            println!("Presets, for --scenario and as `preset = \"…\"` in a file:");
            for (name, about) in PRESETS {
                println!("  {name:<15} {about}");
            }
            println!("`reveille scenario show NAME` prints all fields of one.");
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Show {
            source: Some(source),
            set,
        } => {
            print!("{}", load(source, &overrides(set)?)?.to_toml());
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Check { sources, set } => Ok(check(sources, &overrides(set)?)),
    }
}

fn check(sources: &[String], overrides: &[Override]) -> ExitCode {
    let mut code = ExitCode::SUCCESS;
    for source in sources {
        match load(source, overrides) {
            Ok(scenario) => println!(
                "{source}: ok. {} devices, {} TTIs, policy {}, hash {}",
                scenario.devices,
                scenario.ttis,
                scenario.policy.name(),
                &scenario.hash_hex()[..16]
            ),
            Err(error) => {
                eprintln!("{source}: {error}");
                code = ExitCode::FAILURE;
            }
        }
    }
    code
}

fn overrides(set: &[String]) -> anyhow::Result<Vec<Override>> {
    Ok(set.iter().map(|text| Override::parse(text)).collect::<Result<_, _>>()?)
}
