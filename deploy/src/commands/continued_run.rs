//! `--continue`: the same command starts a run, resumes it after a failure, and does nothing once it is complete. A
//! container or a job that its engine restarts can therefore keep its command line.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use reveille_bs::scenario::compare_scenarios;

use super::resolve_scenario::resolve_started_run;
use crate::cli::{OutputArgs, ScenarioArgs};
use crate::display::{note, print_stdout};
use crate::exit::ExitReason;
use crate::folder_lock::RUNNING_FILE;
use crate::run_folder::{self, SCENARIO_FILE, SUMMARY_FILE};
use crate::scenario_files::ScenarioFiles;

/// Replaces `--continue` in `output` by `--resume` if the folder holds an unfinished run, and then clears the options
/// `input_files`, because the folder has the inputs of the first start. Returns the exit code if the run is complete.
///
/// # Errors
/// If the folder holds a run of another scenario or cannot be read, or the scenario is invalid.
pub(crate) fn resolve(
    scenario_args: &mut ScenarioArgs,
    output: &mut OutputArgs,
    input_files: &mut [&mut Option<PathBuf>],
) -> anyhow::Result<Option<ExitCode>> {
    if !output.continues {
        return Ok(None);
    }
    let folder = output.out.clone().context("--continue needs --out")?;
    let path = folder.join(SCENARIO_FILE);
    let stored = match std::fs::read_to_string(&path) {
        Ok(stored) => stored,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            // A run that was killed before it wrote its scenario left only its mark behind.
            output.force = folder.join(RUNNING_FILE).exists();
            return Ok(None);
        }
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
    };
    let (scenario, _) = resolve_started_run(scenario_args, output)?;
    let given = ScenarioFiles::read(&scenario)?.to_toml(&scenario);
    if given != stored {
        let differences = compare_scenarios(&stored, &given)?.into_iter();
        let fields: Vec<String> = differences
            .map(|(field, stored, given)| format!("{field} is {stored} there and {given} here"))
            .collect();
        bail!(
            "--continue: {} holds a run of another scenario: {}; name another folder, or replace the run with --force",
            folder.display(),
            fields.join(", ")
        );
    }
    if run_folder::is_complete(&folder) {
        return report_complete(output).map(Some);
    }
    // `force` replaces only the recording: the resumed run records all its messages again.
    (output.resume, output.out, output.force) = (output.out.take(), None, true);
    for file in input_files {
        **file = None;
    }
    *scenario_args = ScenarioArgs::default();
    Ok(None)
}

/// Reports that the run in the folder of `output` is complete.
fn report_complete(output: &OutputArgs) -> anyhow::Result<ExitCode> {
    let folder = output.out.as_deref().unwrap_or_else(|| std::path::Path::new(""));
    let text = std::fs::read_to_string(folder.join(SUMMARY_FILE))?;
    if output.json {
        print_stdout(&text)?;
    } else {
        let summary: serde_json::Value = serde_json::from_str(&text)?;
        print_stdout(&format!("digest {}\n", summary["digest"].as_str().unwrap_or_default()))?;
        if !output.quiet {
            note!("the run in {} is already complete", folder.display());
        }
    }
    Ok(ExitReason::Done.into())
}
