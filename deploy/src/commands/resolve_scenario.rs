//! Resolution of the command line to a scenario: preset or file, options, `--set`, `--policy replay=FILE`, `--resume`.
//! Commands that run or draw a scenario use one of three entry points:
//!
//! | function | commands | policy `external` | `--resume`, `replay=` | run folder |
//! |---|---|---|---|---|
//! | [`resolve_started_run`] | `run`, `up`, `bs` | allowed | yes | no |
//! | [`resolve_repeated_run`] | figures of a run | refused | no | yes |
//! | [`resolve_with_builtin_policy`] | other figures, training, tuning | refused | no | no |
//!
//! All end in [`resolve_options`], except `--resume`, which loads the scenario of the folder. `experiment` and
//! `analyse::lists` read the options of sweeps and studies.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use reveille_bs::policy::{outside, registry};
use reveille_bs::scenario::{Loaded, Override, Scenario, ScenarioError, load, load_with_external};
use reveille_common::energy_balance::EnergyBalance;
use reveille_lab::external_inputs::{ExternalInputs, InputLogError};

use crate::cli::{DEFAULT_SCENARIO, OutputArgs, ScenarioArgs};
use crate::display::note;
use crate::input_log::{self, INPUT_LOG_FILE};
use crate::run_folder::{self, SCENARIO_FILE};

/// The prefix of `--policy` for decisions from a log. The help of `--policy` (`cli/parse.rs`) repeats it.
pub(super) const REPLAY_PREFIX: &str = "replay=";

/// Returns the scenario of the run that `run`, `up` or `bs` starts, from the folder that it resumes in or from the
/// command line; policy `external` is allowed. Also returns the external inputs in the log of `--policy replay=FILE`,
/// if given.
pub(super) fn resolve_started_run(
    args: &ScenarioArgs,
    output: &OutputArgs,
) -> anyhow::Result<(Scenario, Option<ExternalInputs>)> {
    let Some(folder) = &output.resume else {
        return resolve_new_run(args);
    };
    if args.is_given() {
        anyhow::bail!(
            "--resume {}: the folder already holds the scenario; leave out all options that change it",
            folder.display()
        );
    }
    let path = folder.join(SCENARIO_FILE);
    if !path.is_file() {
        anyhow::bail!(
            "--resume {}: the folder holds no run; name a run folder",
            folder.display()
        );
    }
    Ok((load_with_external(&path.to_string_lossy(), &[])?.scenario, None))
}

/// Logs a warning about each device class whose batteries run down under every policy.
pub(super) fn warn_about_depletion(scenario: &Scenario) {
    for warning in EnergyBalance::new(scenario).depletion_warnings() {
        tracing::warn!("{warning}");
    }
}

/// Returns the scenario of a run that does not resume, and the inputs in the log of `--policy replay=FILE`, if given.
fn resolve_new_run(args: &ScenarioArgs) -> anyhow::Result<(Scenario, Option<ExternalInputs>)> {
    let replayed_path = args
        .policy
        .as_ref()
        .and_then(|policy| policy.strip_prefix(REPLAY_PREFIX));
    let Some(replayed_path) = replayed_path.map(Path::new) else {
        return Ok((resolve_options(args, load_with_external)?, None));
    };
    let log_path = find_replay_log(replayed_path)?;
    let own_options = ScenarioArgs {
        policy: None,
        ..args.clone()
    };
    let args = ScenarioArgs {
        policy: Some(outside::EXTERNAL_NAME.to_owned()),
        ..with_scenario_of_log(&own_options, &log_path)
    };
    let scenario = resolve_options(&args, load_with_external)?;
    let inputs = read_log_of_run(&log_path, &scenario, own_options.is_given())
        .map_err(|error| anyhow!("--policy {REPLAY_PREFIX}{}: {error:#}", replayed_path.display()))?;
    Ok((scenario, Some(inputs)))
}

/// Returns `args` with the scenario in the run folder of the input log at `log_path`, if the folder has one and `args`
/// are not given.
pub(super) fn with_scenario_of_log(args: &ScenarioArgs, log_path: &Path) -> ScenarioArgs {
    let mut args = args.clone();
    let log_folder_scenario = log_path.with_file_name(SCENARIO_FILE);
    if !args.is_given() && log_folder_scenario.is_file() {
        args.scenario = log_folder_scenario.to_string_lossy().into_owned();
    }
    args
}

/// Reads the input log at `path` for a run of `scenario`, which the command line changes if it `has_options`.
///
/// # Errors
/// If the log holds no input, cannot be read or belongs to another run. The error then names the options to use.
pub(super) fn read_log_of_run(path: &Path, scenario: &Scenario, has_options: bool) -> anyhow::Result<ExternalInputs> {
    input_log::read_nonempty(path, scenario).map_err(|error| {
        let hint = match error.downcast_ref() {
            Some(InputLogError::Scenario) if has_options && path.with_file_name(SCENARIO_FILE).is_file() => {
                "; leave out the other scenario options to use the scenario in the folder of the log"
            }
            Some(InputLogError::Scenario) => "; use the scenario and seed of the logged run",
            _ => "",
        };
        anyhow!("{error:#}{hint}")
    })
}

/// Returns the input log that `--policy replay=PATH` names, a file or the log in a run folder.
fn find_replay_log(path: &Path) -> anyhow::Result<PathBuf> {
    let refuse = |cause: &str| {
        let advice = format!("name the {INPUT_LOG_FILE} of a run with --policy external, or its folder");
        Err(anyhow!("--policy {REPLAY_PREFIX}{}: {cause}; {advice}", path.display()))
    };
    if path.as_os_str().is_empty() {
        return refuse("the file is missing");
    }
    // Links count even if they are dangling: reading them returns the cause.
    if path.symlink_metadata().is_err() {
        return refuse("no such file or folder");
    }
    let log_path = path.join(INPUT_LOG_FILE);
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    if log_path.symlink_metadata().is_ok() {
        return Ok(log_path);
    }
    if !path.join(SCENARIO_FILE).is_file() {
        return refuse("the folder holds no run");
    }
    let failure = run_folder::failure(path).map(|reason| format!(": the run failed ({reason})"));
    refuse(&format!(
        "the folder holds no {INPUT_LOG_FILE}{}",
        failure.unwrap_or_default()
    ))
}

/// Returns the scenario of the run folder or scenario file `run`, which a figure repeats, changed by the other options.
/// Without `run`, returns the command line's scenario. The policy must be one of this program.
pub(super) fn resolve_repeated_run(run: Option<&Path>, args: &ScenarioArgs) -> anyhow::Result<Scenario> {
    let Some(run) = run else {
        if args.scenario != DEFAULT_SCENARIO {
            note!("--scenario NAME is now the argument RUN; the option will be removed in a later version");
        }
        return resolve_with_builtin_policy(args);
    };
    let run = run_folder::of_recording(run);
    let mut scenario_file = run.clone();
    if run.is_dir() {
        scenario_file = run.join(SCENARIO_FILE);
        anyhow::ensure!(
            scenario_file.is_file(),
            "{}: the folder holds no run; name a run folder or a scenario file",
            run.display()
        );
        if run.join(INPUT_LOG_FILE).exists() {
            note!(
                "{}: the scenario is repeated without the removals, decisions and actions in {INPUT_LOG_FILE}",
                run.display()
            );
        }
    }
    resolve_with_builtin_policy(&ScenarioArgs {
        scenario: scenario_file.to_string_lossy().into_owned(),
        ..args.clone()
    })
}

/// Returns the command line's scenario. Its policy must be one of this program.
pub(super) fn resolve_with_builtin_policy(args: &ScenarioArgs) -> anyhow::Result<Scenario> {
    let resolved = resolve_options(args, load);
    // Loads the scenario again to find out whether the policy `external` is the only problem.
    if resolved.is_err() && resolve_options(args, load_with_external).is_ok() {
        anyhow::bail!(
            "policy external: only `reveille up` and `reveille bs` can ask a policy process; choose a built-in policy \
             with --policy"
        );
    }
    resolved
}

/// Returns the scenario of the options, loaded with `load_scenario`, which decides whether policy `external` is valid.
/// Logs the warnings.
///
/// # Errors
/// If an option is invalid or contradicts `--set`, or the scenario is invalid.
fn resolve_options(
    args: &ScenarioArgs,
    load_scenario: impl Fn(&str, &[Override]) -> Result<Loaded, ScenarioError>,
) -> anyhow::Result<Scenario> {
    let Loaded { scenario, warnings } = load_scenario(&args.scenario, &parse_overrides(args)?)?;
    let name = scenario.policy.name();
    let learns = registry::named(name).is_some_and(|policy| policy.learns);
    if args.learn && !learns {
        anyhow::bail!(
            "--learn: policy {name} does not learn; add --policy {}",
            registry::comma_separated_names(|policy| policy.learns)
        );
    }
    for warning in &warnings {
        tracing::warn!("{warning}");
    }
    Ok(scenario)
}

/// Refuses a list of policies in `--policy`.
pub(super) fn check_single_policy(policy: Option<&str>) -> anyhow::Result<()> {
    match policy.filter(|policy| policy.contains(',')) {
        Some(list) => {
            anyhow::bail!(
                "--policy {list}: a run has one policy; compare several with `reveille sweep --policies {list}`"
            )
        }
        None => Ok(()),
    }
}

/// Returns the fields that `--set` and the other options override.
///
/// # Errors
/// If an option is invalid or contradicts `--set`.
pub(super) fn parse_overrides(args: &ScenarioArgs) -> anyhow::Result<Vec<Override>> {
    check_single_policy(args.policy.as_deref())?;
    let mut overrides = args
        .set
        .iter()
        .map(|text| Override::parse(text))
        .collect::<Result<Vec<_>, _>>()?;
    let flags = [
        ("--devices", "devices", &args.devices),
        ("--policy", "policy.name", &args.policy),
        ("--ttis", "ttis", &args.ttis),
        ("--seed", "seed", &args.seed),
    ];
    for (flag, field, value) in flags {
        if let Some(value) = value {
            check_set_once(args, flag, field)?;
            overrides.push(Override::from_flag(flag, field, value)?);
        }
    }
    // The scenario file can choose the policy, so the field is set for every policy that learns.
    if args.learn {
        for name in registry::POLICIES
            .iter()
            .filter(|policy| policy.learns)
            .map(|policy| policy.name)
        {
            let field = format!("policy.{name}.learn");
            check_set_once(args, "--learn", &field)?;
            overrides.push(Override::from_flag("--learn", &field, "true")?);
        }
    }
    Ok(overrides)
}

/// Returns an error for a field set both by its own option and by `--set`: one of them would have no effect.
fn check_set_once(args: &ScenarioArgs, flag: &str, field: &str) -> anyhow::Result<()> {
    let sets_field = |text: &&String| text.split_once('=').is_some_and(|(name, _)| name.trim() == field);
    match args.set.iter().find(sets_field) {
        Some(text) => anyhow::bail!("{flag} and --set {text} both set {field}; leave one of them out"),
        None => Ok(()),
    }
}
