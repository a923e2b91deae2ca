//! `reveille scenario`: shows presets and scenarios, checks files, and writes the schema and the field reference. The
//! reference is `docs/scenario.md`; `bs/src/scenario/` makes it and compares the page in a test. `docs/scenarios.md`
//! and `docs/tutorial.md` show the text of `check`.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use reveille_bs::policy::registry;
use reveille_bs::scenario::{Loaded, Override, PRESETS, Preset, load_with_external, reference, schema};
use reveille_common::energy_balance::EnergyBalance;

use super::energy_balance::format_balance;
use super::resolve_scenario::parse_overrides;
use crate::cli::{ScenarioArgs, ScenarioCommand};
use crate::display::{self, WIDTH, count_noun, note, wrap_text};
use crate::paths::check_output_path;

/// Shows or checks scenarios.
pub(crate) fn run(command: &ScenarioCommand) -> anyhow::Result<ExitCode> {
    match command {
        ScenarioCommand::Show { source: None, .. } => {
            display::print_stdout("Presets, for --scenario and as `preset = \"…\"` in a file:\n")?;
            for Preset { name, about, .. } in PRESETS {
                display::print_stdout(&format!("  {name:<15} {about}\n"))?;
            }
            display::print_stdout("`reveille scenario show NAME` prints all fields of one.\n")?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Show {
            source: Some(source),
            set,
        } => {
            let overrides = parse_overrides(&ScenarioArgs {
                set: set.clone(),
                ..ScenarioArgs::default()
            });
            let Loaded { scenario, warnings } = load_with_external(source, &overrides?)?;
            print_warnings(source, &warnings);
            display::print_stdout(&scenario.to_full_toml(&registry::all_policies()))?;
            Ok(ExitCode::SUCCESS)
        }
        ScenarioCommand::Schema { out } => write_or_print(out.as_deref(), &schema()),
        ScenarioCommand::Reference { out } => write_or_print(out.as_deref(), &reference()),
        ScenarioCommand::Check {
            sources,
            set,
            devices,
            policy,
            ttis,
            seed,
        } => {
            let overrides = parse_overrides(&ScenarioArgs {
                set: set.clone(),
                devices: devices.clone(),
                policy: policy.clone(),
                ttis: ttis.clone(),
                seed: seed.clone(),
                ..ScenarioArgs::default()
            });
            check_sources(sources, &overrides?)
        }
    }
}

/// Checks every source, and prints the energy balance of each valid one. A failed source sets the exit code.
fn check_sources(sources: &[String], overrides: &[Override]) -> anyhow::Result<ExitCode> {
    let mut code = ExitCode::SUCCESS;
    for source in sources {
        match load_with_external(source, overrides) {
            Ok(Loaded { scenario, warnings }) => {
                print_warnings(source, &warnings);
                let line = format!(
                    "{source}: ok. {}, {}, policy {}, hash {}",
                    count_noun(scenario.run.devices, "device"),
                    count_noun(scenario.run.ttis, "TTI"),
                    scenario.policy.name(),
                    &scenario.hash_hex()[..16]
                );
                display::print_stdout(&(wrap_text(&line, WIDTH) + "\n"))?;
                let balance = EnergyBalance::new(&scenario);
                print_warnings(source, &balance.warnings());
                display::print_stdout(&format_balance(&balance))?;
            }
            // Reported without a return, so that the other sources are checked too.
            Err(error) => {
                note!("{}", name_source(source, &error.to_string()));
                code = crate::exit::ExitReason::Failed.into();
            }
        }
    }
    Ok(code)
}

/// Prints the warnings about the scenario `source` on standard error.
fn print_warnings(source: &str, warnings: &[String]) {
    for warning in warnings {
        note!("{}", name_source(source, &format!("warning: {warning}")));
    }
}

/// Returns `message` with the scenario `source` in front, unless the message names the source.
fn name_source(source: &str, message: &str) -> String {
    let starts = [
        format!("{source}, line "),
        format!("{source}: "),
        format!("no scenario `{source}`"),
    ];
    let is_named = starts.iter().any(|start| message.starts_with(start));
    if is_named || message.contains(&format!("set in {source}, line ")) {
        message.to_owned()
    } else {
        format!("{source}: {message}")
    }
}

/// Writes `text` to the file `out`, or prints it.
fn write_or_print(out: Option<&Path>, text: &str) -> anyhow::Result<ExitCode> {
    match out {
        Some(path) => {
            check_output_path(path, "the text")?;
            std::fs::write(path, text).with_context(|| format!("{}: cannot write this file", path.display()))?;
        }
        None => display::print_stdout(text)?,
    }
    Ok(ExitCode::SUCCESS)
}
