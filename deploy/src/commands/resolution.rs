//! From the command line to the scenario that it means.

use std::path::PathBuf;

use anyhow::Context;
use reveille_bs::policy::{outside, registry};
use reveille_bs::scenario::{Override, Scenario, ScenarioError, load, load_outside};
use reveille_lab::inputs::Inputs;

use crate::cli::{OutputArgs, ScenarioArgs};
use crate::input_log::{self, INPUTS};
use crate::results::SCENARIO;

/// What `--policy` begins with where decisions come from a log.
const REPLAY: &str = "replay=";

/// The scenario of a run: that of the folder in which it is taken up, or what the command line means. With it come the
/// decisions that `--policy replay=FILE` names, where it does.
pub fn resolve_run(args: &ScenarioArgs, output: &OutputArgs) -> anyhow::Result<(Scenario, Option<Inputs>)> {
    let Some(folder) = &output.resume else {
        return resolve_new(args);
    };
    if args.is_given() {
        anyhow::bail!(
            "--resume {}: the scenario is the one in the folder; leave out the options that choose one",
            folder.display()
        );
    }
    let path = folder.join(SCENARIO);
    if !path.is_file() {
        anyhow::bail!("--resume {}: there is no run in this folder", folder.display());
    }
    Ok((load_outside(&path.to_string_lossy(), &[])?, None))
}

fn resolve_new(args: &ScenarioArgs) -> anyhow::Result<(Scenario, Option<Inputs>)> {
    let log = args.policy.as_ref().and_then(|policy| policy.strip_prefix(REPLAY));
    let Some(log) = log.map(PathBuf::from) else {
        return Ok((resolve_by(args, load_outside)?, None));
    };
    anyhow::ensure!(
        !log.as_os_str().is_empty(),
        "--policy {REPLAY}FILE: name the {INPUTS} of a run, or its folder"
    );
    let log = if log.is_dir() { log.join(INPUTS) } else { log };
    let mut args = ScenarioArgs {
        policy: None,
        ..args.clone()
    };
    // What the run folder of the log says, where nobody says otherwise.
    let beside = log.with_file_name(SCENARIO);
    if !args.is_given() && beside.is_file() {
        args.scenario = beside.to_string_lossy().into_owned();
    }
    args.policy = Some(outside::NAME.to_owned());
    let scenario = resolve_by(&args, load_outside)?;
    let inputs = input_log::read_named(&log, &scenario).with_context(|| {
        let beside = if beside.is_file() {
            ", which needs no other option: its scenario is beside it"
        } else {
            ""
        };
        format!("--policy {REPLAY}{}{beside}", log.display())
    })?;
    Ok((scenario, Some(inputs)))
}

/// The scenario that the command line means, with a policy of this program.
pub fn resolve(args: &ScenarioArgs) -> anyhow::Result<Scenario> {
    let resolved = resolve_by(args, load);
    if resolved.is_err() && resolve_by(args, load_outside).is_ok() {
        anyhow::bail!(
            "the policy external decides nothing itself: another program does, for `reveille up` and `reveille bs`. \
             Choose one of this program here with --policy"
        );
    }
    resolved
}

fn resolve_by(
    args: &ScenarioArgs,
    load: impl Fn(&str, &[Override]) -> Result<Scenario, ScenarioError>,
) -> anyhow::Result<Scenario> {
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
            give_once(args, flag, field)?;
            overrides.push(Override::flag(flag, field, value)?);
        }
    }
    if args.learn {
        for name in registry::POLICIES
            .iter()
            .filter(|policy| policy.profile().learns)
            .map(|policy| policy.name())
        {
            let field = format!("policy.{name}.learn");
            give_once(args, "--learn", &field)?;
            overrides.push(Override::flag("--learn", &field, "true")?);
        }
    }
    let scenario = load(&args.scenario, &overrides)?;
    let name = scenario.policy.name();
    let learns = registry::named(name).is_some_and(|policy| policy.profile().learns);
    if args.learn && !learns {
        anyhow::bail!(
            "--learn: the policy {name} does not learn; add --policy {}",
            registry::list(|profile| profile.learns)
        );
    }
    for warning in &scenario.warnings {
        tracing::warn!("{warning}");
    }
    Ok(scenario)
}

/// Refuses a field that both an option of its own and `--set` give: one of them would have no effect.
fn give_once(args: &ScenarioArgs, flag: &str, field: &str) -> anyhow::Result<()> {
    let named = |text: &&String| text.split_once('=').is_some_and(|(name, _)| name.trim() == field);
    match args.set.iter().find(named) {
        Some(text) => anyhow::bail!("{flag} and --set {text} both give {field}; leave one of them out"),
        None => Ok(()),
    }
}
